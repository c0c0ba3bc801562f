"""What the estimated errors of a motion mean: how many digits are left, from when on they are lost, and to what.

An error of up to ten thousand tolerances is as expected of many steps, as long as three digits are left. What exceeds
that is in `scaled_error`, in units of it.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from lagjax.mechanics.signature import UnknownSystem
from lagjax.mechanics.structure import angles
from lagjax.motion.tolerances import TURN

# An error is as expected up to so many tolerances, as long as this share of the number is not lost.
EXPECTED, DIGITS_LEFT = 1e4, 5e-4
# A coordinate that stays within so many tolerances of zero, and at this share of the others, has no digits to lose.
NOTHING, SMALL = 100.0, 1e-6
# Steps to an output from which on outputs are far from each other, and those of a motion to and fro.
SPARSE, TO_AND_FRO = 1.5, 10.0
# Velocities at outputs of less than this part of that are there by the choice of the outputs.
TURNING = 1e-3
# Errors that a motion has made this many times what the steps' errors add up to are amplified.
AMPLIFIED = 100.0


class Errors(NamedTuple):
    """Estimates of the errors of a motion: how far each number may be from the true one, in its own unit.

    - `q`, `v`, `multipliers`: like those of the trajectory; NaN where that is NaN.
    - `events`: by name, those of the crossings' times, (K,); infinite for a crossing that only one of two runs found.
    - `result`: `lj.RESULTS.successful`, or why there is no estimate, which is then NaN.
    - `steps`: how many steps the second run accepted.
    """

    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    events: dict[str, Array]
    result: Any
    steps: Int[Array, ""]


def columns(xp, tree, rows) -> Any:
    """The leaves of a tree beside each other."""
    return xp.concatenate([xp.asarray(x).reshape(rows, -1) for x in jax.tree.leaves(tree)], axis=1)


def sizes_of(xp, seen, is_angle, span, steps, outputs):
    """How large coordinates and velocities are, (2, n), by the largest of them that were `seen` at outputs, (2, n).

    Outputs that are far from each other may all be where a velocity is zero, or a coordinate: it is then at least what
    the other makes of it in a step, or in ten: of a velocity, if it is next to nothing beside that at all outputs, as
    steps of a stiff motion are much shorter. `is_angle` (n,) or one truth for all.
    """
    q, v = xp.where(is_angle, xp.minimum(seen[0], TURN), seen[0]), seen[1]
    step = xp.where(steps > SPARSE * outputs, span / (1.0 + steps), 0.0)
    between = xp.where(step > 0, q / xp.where(step > 0, TO_AND_FRO * step, 1.0), 0.0)
    return xp.stack([xp.maximum(q, v * step), xp.where(v > TURNING * between, v, between)])


def of_a_step(size, tolerance):
    """The tolerances of a step for coordinates and velocities of these sizes, (2, n); `atol` is (2,) or (2, n)."""
    rtol, atol = tolerance
    return (atol[:, None] if atol.ndim == 1 else atol) + rtol[:, None] * size


def allowed(xp, size, span, tolerance):
    """What errors of coordinates and velocities may be, (2, n), by their sizes; `tolerance` is (rtol, atol)."""
    tolerances = of_a_step(size, tolerance)
    largest = xp.max(size, axis=1, keepdims=True)
    others = xp.maximum(largest, largest[::-1] * xp.asarray([[span], [1 / span]]))
    nothing = (size <= NOTHING * tolerances) & (size <= SMALL * others)
    return xp.minimum(EXPECTED * tolerances, xp.where(nothing, np.inf, DIGITS_LEFT * size))


def scaled_error(xp, worst, seen, trajectory, ts, tolerance):
    """The worst errors, (2, n), in units of what is allowed; what it was before where there is no estimate."""
    span, steps = abs(ts[-1] - ts[0]), xp.asarray(trajectory.stats["num_accepted_steps"])

    def by(is_angle):
        limit = allowed(xp, sizes_of(xp, seen, is_angle, span, steps, len(ts)), span, tolerance)
        # A number that is zero throughout has an error of zero.
        share = worst / xp.where(limit > 0, limit, 1.0)
        unknown = xp.isnan(share)
        return xp.where(unknown.all(), trajectory.scaled_error, xp.where(unknown, 0.0, share).max()).astype(ts.dtype)

    # Which coordinates are angles takes long to say, and counts only where much is lost.
    at_most = by(True) if xp is np else np.inf
    return at_most if at_most <= 1 else by(angle_mask(trajectory))


def angle_mask(trajectory) -> np.ndarray:
    """Which coordinates are angles, (n,)."""
    if isinstance(trajectory.any_system, UnknownSystem):
        return np.array(trajectory.any_system.angles, bool)
    first = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
    found = angles(trajectory.system, *first, trajectory.params)
    return np.concatenate([np.full(np.size(x), yes) for yes, x in zip(*map(jax.tree.leaves, (found, first[1])))])
