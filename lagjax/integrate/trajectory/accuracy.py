"""How the estimated errors of a motion are judged.

After many steps an error of up to ten thousand tolerances is expected, as long as three digits are left.
`scaled_error` is the worst error in units of that limit.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from lagjax.integrate.stepping.tolerances import TURN
from lagjax.mechanics.structure import are_angles
from lagjax.system.signature import UnknownSystem

# An error of up to this many tolerances is expected, if it is also below this share of the number.
EXPECTED, DIGITS_LEFT = 1e4, 5e-4
# A coordinate within this many tolerances of zero, and below this share of the others, has no digits to lose.
NOTHING, SMALL = 100.0, 1e-6
# Above this many steps per output, outputs are sparse; an oscillation takes about so many steps.
SPARSE, STEPS_PER_OSCILLATION = 1.5, 10.0
# A velocity below this share of the oscillation's is small at outputs only because these lie at turning points.
TURNING = 1e-3
# A motion has amplified its errors if they exceed the sum of the steps' errors this many times.
AMPLIFIED = 100.0


class Errors(NamedTuple):
    """Estimates of the errors of a motion: how far each number may be from the true one, in its own unit.

    Those of `q`, `v` and `multipliers` are at the outputs: a larger error between two of them is not seen.

    - `q`, `v`, `multipliers`: like those of the trajectory; NaN where the trajectory is NaN.
    - `events`: by name, the errors of the crossings' times, (K,); infinite if the second run did not find the crossing.
    - `result`: `lj.RESULTS.successful`, or why there is no estimate; the errors are then NaN.
    - `steps`: the number of steps that the second run accepted.
    """

    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    events: dict[str, Array]
    result: Any
    steps: Int[Array, ""]


def columns(xp, tree, rows) -> Any:
    """Return the leaves of a tree as the columns of one array."""
    return xp.concatenate([xp.asarray(x).reshape(rows, -1) for x in jax.tree.leaves(tree)], axis=1)


def sizes_of(xp, largest, is_angle, span, steps, outputs):
    """Return the sizes of coordinates and velocities, (2, n), from their largest values at outputs, `largest` (2, n).

    Sparse outputs may all lie where a velocity, or a coordinate, is zero. A coordinate then counts as at least the
    distance that its velocity covers in one step. A velocity counts as the coordinate divided by ten steps, but only
    if it is tiny compared with that at all outputs: steps of a stiff motion are much shorter than its oscillations.
    `is_angle`: (n,), or one truth value for all.
    """
    q, v = xp.where(is_angle, xp.minimum(largest[0], TURN), largest[0]), largest[1]
    step = xp.where(steps > SPARSE * outputs, span / (1.0 + steps), 0.0)
    between = xp.where(step > 0, q / xp.where(step > 0, STEPS_PER_OSCILLATION * step, 1.0), 0.0)
    return xp.stack([xp.maximum(q, v * step), xp.where(v > TURNING * between, v, between)])


def of_a_step(size, tolerance):
    """Return a step's tolerances for coordinates and velocities of these sizes, (2, n); `atol` is (2,) or (2, n)."""
    rtol, atol = tolerance
    return (atol[:, None] if atol.ndim == 1 else atol) + rtol[:, None] * size


def allowed(xp, size, span, tolerance):
    """Return the allowed errors of coordinates and velocities of these sizes, (2, n); `tolerance` is (rtol, atol)."""
    tolerances = of_a_step(size, tolerance)
    largest = xp.max(size, axis=1, keepdims=True)
    others = xp.maximum(largest, largest[::-1] * xp.asarray([[span], [1 / span]]))
    nothing = (size <= NOTHING * tolerances) & (size <= SMALL * others)
    return xp.minimum(EXPECTED * tolerances, xp.where(nothing, np.inf, DIGITS_LEFT * size))


def in_units_of(xp, error, limit):
    """Return errors in units of the allowed ones; where a number is zero throughout, its size is the error itself."""
    known = limit > 0
    return xp.where(known, error / xp.where(known, limit, 1.0), xp.where(error > 0, 1 / DIGITS_LEFT, 0.0 * error))


def scaled_error(xp, worst, largest, trajectory, ts, tolerance):
    """Return the largest of the errors `worst` (2, n) in units of the allowed ones; the former value if all are NaN."""
    span, steps = abs(ts[-1] - ts[0]), xp.asarray(trajectory.stats["num_accepted_steps"])

    def by(is_angle):
        limit = allowed(xp, sizes_of(xp, largest, is_angle, span, steps, len(ts)), span, tolerance)
        share = in_units_of(xp, worst, limit)
        unknown = xp.isnan(share)
        return xp.where(unknown.all(), trajectory.scaled_error, xp.where(unknown, 0.0, share).max()).astype(ts.dtype)

    # Finding out which coordinates are angles takes long, and matters only if much is lost.
    at_most = by(True) if xp is np else np.inf
    return at_most if at_most <= 1 else by(angle_mask(trajectory))


def angle_mask(trajectory) -> np.ndarray:
    """Return which coordinates are angles, (n,) booleans."""
    if isinstance(trajectory.any_system, UnknownSystem):
        return np.array(trajectory.any_system.angles, bool)
    return are_angles(trajectory.model)
