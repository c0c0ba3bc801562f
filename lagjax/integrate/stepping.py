"""Steps on the constraints, and their sizes: the error allowed in each, ends where outputs are wanted and forces jump.

*A solver of diffrax's, kept on the constraints and accurate between its steps.* `ProjectedSolver` wraps a diffrax
solver. After each step it returns the state to the constraint manifold, and its dense output is a step of the solver
itself: the state at t inside a step from t0 is one step from t0 to t. Outputs and event times therefore have the order
of the method (Kvaerno5's own interpolant is cubic, Dopri8's is of order six) and satisfy the constraints, at the cost
of one step per output.

*The error allowed.* An absolute tolerance in the user's units is far too coarse for a motion of nanometres and far too
fine for one of light years. If `atol` is not given, each coordinate and each velocity is therefore judged by its own
size alone:

    rtol max(|y|, a thousandth of the largest |y| so far),        for velocities also of √(|a| |q|)

|y| is taken at the end of the step where it is larger, so that passing through zero costs nothing; a motion that dies
out is followed over three decades; √(|a| |q|) is the velocity that goes with an extent and an acceleration, which is
all there is at rest when a force sets in. To this is added only the round-off from the other coordinates: a motion in a
plane leaves the third dimension at round-off, which no step can follow. Sizes are compared as √M_ii q_i and √M_ii v_i,
which have the same unit for all coordinates. If everything is zero at the start, the size is a part of what the
acceleration there yields in the whole time, or, if that is zero too, the acceleration of the step.

Where forces a and -a cancel, as those of contacts do at rest, ε a is left: a step of length h makes velocities ε a h of
it, and ways ε a h², whatever the sizes are. `Forced` are such a.

*Ends of steps.* An output inside a step costs a step of its own, or a polynomial of lower order than the method. Here
the step before an output is shortened to end there, or the last two are made equal; the size proposed before is kept
for the step after it. Outputs then cost nothing apart from the steps that they shorten.

Times at which a force jumps are ends of steps, too, and each step stays on its own side of them: it begins and ends a
few units of round-off away from a jump, so that the force is never evaluated at the jump itself.

A motion whose steps have collapsed is not stepped until `max_steps`: it ends after `TRIES` attempts in a row, accepted
or rejected, after each of which the proposed step was so short that a hundred times `max_steps` of such steps would not
reach the last time. Attempts that end at an output do not count, so that outputs which crowd together end nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.settings import Settings
from lagjax.jaxtools import one_function, stop_gradient
from lagjax.mechanics import Equations, all_finite, to_manifold
from lagjax.numerics import Interpolation, Quintic, Radau5

# The size of an angle counts up to this: a tolerance relative to a thousand turns would mean nothing.
TURN = 2 * np.pi
# The size of a number is at least this part of the largest value that it has had.
DIED_OUT = 1e-3
# The round-off that one number causes in another, in units of the last digit.
ROUNDED = 8.0
# A first step that is too short costs one more step, one that is too long several; it may also miss an event.
FIRST = 0.1
# The root of a mass counts as at least this part of the largest one: round-off also comes through constraints.
LIGHT = 1e-6
# A coordinate at rest at zero counts as at least this part of the extent of all others when a force sets in.
OF_OTHERS = 1e-6
# Nothing accelerates below so many round-offs of the forces: guards of contacts end modes at hundreds of them.
AT_REST = 1e3
# For a start from zero: parts of the coordinates and velocities that its acceleration yields in the whole time.
FROM_NOTHING = 1e-6, 1e-3


class Tolerances(NamedTuple):
    """Tolerances of coordinates and of velocities, each (2,)."""

    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]


class Forced(NamedTuple):
    """The accelerations, of forces that may cancel, at times over the motion."""

    t: Float[Array, " K"]
    a: Float[Array, "K n"]

    def near(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """The larger ones of the times beside t: a force that passes zero is none for an instant only."""
        at = jnp.clip(jnp.searchsorted(self.t, t, side="right"), 1, self.t.size - 1)
        return jnp.maximum(self.a[at - 1], self.a[at])

    def around(self, t: Float[Array, ""]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """Those, and the time that the motion takes."""
        return self.near(t), self.t[-1] - self.t[0]

    def left_over(self, a: Float[Array, " n"], h: Float[Array, ""]) -> Float[Array, "2 n"]:
        """What the round-off of accelerations makes of coordinates and velocities in a time h."""
        return rounding(a[None] * jnp.stack([h**2, h])[:, None])


class Scales(NamedTuple):
    """The size of a motion as told by its start; rows are coordinates and velocities.

    - `root_mass`: √M_ii; `over_root_mass`: one over it, bounded.
    - `reach`: the largest of √M_ii times the numbers.
    - `time`: the time in which they change. `first`: the sizes of the numbers; if all are zero, a substitute.
    - `unknown`: whether all of this is zero, since nothing accelerates at the start either.
    - `forced`: the accelerations of forces that cancel, where they are known.
    """

    root_mass: Float[Array, "1 n"]
    over_root_mass: Float[Array, "1 n"]
    reach: Float[Array, "2 1"]
    time: Float[Array, ""]
    first: Float[Array, "2 n"]
    unknown: Bool[Array, ""]
    forced: Forced | None = None


def tolerances_at(start, ts: Array, settings: Settings, sizes_so_far=None, a=None) -> Tolerances:
    """The tolerances of the whole state, as given or from the start's size; for constraints, which mix coordinates.

    `sizes_so_far` (2, n): the largest coordinates and velocities before it; `a`: the accelerations there, which are its
    size where all of the state is zero. Where nothing accelerates either there is none, and it counts as one.
    """
    if not settings.by_size:
        return Tolerances(settings.rtol, settings.atol)
    sizes, span = jnp.abs(_rows(start.q, start.v)), span_of(ts)
    of_q, of_v = jnp.max(sizes if sizes_so_far is None else jnp.maximum(sizes, sizes_so_far), axis=1)
    if (forced := settings.forced) is not None:
        # Below this it is round-off, however it is told apart.
        of_q = jnp.maximum(of_q, FROM_NOTHING[0] * jnp.max(forced.a) * span**2)
    of_a = 0.0 if a is None else jnp.max(jnp.abs(jnp.nan_to_num(_rows(a), posinf=0.0, neginf=0.0)))
    of_q = jnp.where(of_q > 0, of_q, jnp.where(of_v > 0, of_v * span, jnp.where(of_a > 0, of_a * span**2, 1.0)))
    return Tolerances(settings.rtol, stop_gradient(settings.rtol * jnp.stack([of_q, jnp.maximum(of_v, of_q / span)])))


def span_of(ts: Array):
    """The time that a motion takes; positive even if the motion is refused."""
    return jnp.maximum(jnp.abs(ts[-1] - ts[0]), jnp.finfo(ts.dtype).tiny)


def scales_of(
    mass, q: PyTree, v: PyTree, a, span, without_mass: np.ndarray | np.bool = np.False_, forced: Forced | None = None
) -> Scales:
    """The scales of a motion, from its first state and the accelerations there, which need not be finite.

    `without_mass` (n,): the coordinates of first order, in units of their own: they set no scale for others, and the
    round-off in them is that of the largest mass.
    """
    root_mass, sizes = (
        jnp.sqrt(jnp.nan_to_num(mass[None], posinf=0.0)),
        jnp.abs(jnp.nan_to_num(_rows(q, v, a), posinf=0.0)),
    )
    if forced is not None:
        # What the round-off of forces that cancel makes in the whole time says nothing.
        most = jnp.max(forced.a, axis=0)
        least = jnp.concatenate([forced.left_over(most, span), AT_REST * rounding(most)[None]])
        sizes = jnp.where(sizes <= least, 0.0, sizes)
    root_mass = jnp.where(without_mass, 0.0, root_mass)
    heaviest = jnp.max(root_mass)
    over_root_mass = 1 / jnp.maximum(root_mass, LIGHT * jnp.where(heaviest > 0, heaviest, 1.0))
    over_root_mass = jnp.where(without_mass, jnp.min(over_root_mass), over_root_mass)
    of_q, of_v, of_a = jnp.max(root_mass * sizes, axis=1)
    nothing = (of_q == 0) & (of_v == 0)
    # Zero sizes follow from the others: a velocity from extent and acceleration, otherwise from the time scale.
    of_v = jnp.maximum(of_v, jnp.sqrt(of_a * of_q))
    larger, smaller = jnp.stack([of_q, of_v]), jnp.stack([of_v, of_a])
    known = (larger > 0) & (smaller > 0)
    time = jnp.minimum(span, jnp.min(jnp.where(known, larger / jnp.where(known, smaller, 1.0), span)))
    of_v = jnp.maximum(of_v, jnp.where(of_a > 0, of_a * time, of_q / span))
    of_q = jnp.maximum(of_q, of_v * time)
    reach = jnp.stack([of_q, of_v])[:, None]
    least = np.array(FROM_NOTHING, reach.dtype)[:, None] * reach * over_root_mass / DIED_OUT
    first = jnp.where(nothing & ~without_mass, least, sizes[:2])
    return Scales(root_mass, over_root_mass, reach, time, first, nothing & (of_a == 0), forced)


def shared(scales: Scales, sizes) -> Float[Array, "2 n"]:
    """For each number the value as large, in √M_ii times it, as the largest of all `sizes` (2, n)."""
    return jnp.max(scales.root_mass * sizes, axis=1, keepdims=True) * scales.over_root_mass


def rounding(others: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """The round-off in numbers that are zero while the others are as large as this."""
    return ROUNDED * jnp.finfo(others.dtype).eps * others


def rounded(nothing: Float[Array, "..."]) -> Float[Array, "..."]:
    """How large the others are, where this is the round-off in numbers that are zero."""
    return nothing / (ROUNDED * jnp.finfo(nothing.dtype).eps)


class AsNothing(eqx.Module):
    """The `atol` of each coordinate and each velocity for iterations inside a step, from the start alone.

    If that says nothing, since all is at rest at zero, it follows the unknown, (..., 2n), as in
    `PerCoordinateTolerance`.
    """

    scales: Scales
    rtol: Float[Array, " 2"]

    def __call__(self, y: Float[Array, "..."]) -> Float[Array, " 2n"]:
        """The tolerances beside those relative to each number."""
        scales = self.scales
        now = jnp.max(jnp.abs(y).reshape(-1, *scales.first.shape), axis=0)
        others = jnp.where(scales.unknown, shared(scales, now), scales.reach * scales.over_root_mass)
        own_size = jnp.where(scales.first > 0, scales.first, others)
        return jnp.ravel(DIED_OUT * self.rtol[:, None] * own_size + rounding(others))


class PerCoordinateTolerance(diffrax.AbstractAdaptiveStepSizeController):
    """Wrap `controller`, which has a single tolerance: each number's error is weighed by its own allowed error.

    That follows the number's own size if `scales` are given, otherwise `tolerances`, of coordinates and of velocities.
    At most a turn counts of coordinates that are `angles`, (n,). The state holds the largest numbers so far, (2, n).
    """

    controller: diffrax.PIDController
    tolerances: Tolerances
    scales: Scales | None
    angles: tuple[bool, ...] = eqx.field(static=True)

    @property
    def rtol(self):
        return self.controller.rtol

    @property
    def atol(self):
        return self.controller.atol

    @property
    def norm(self):
        return self.controller.norm

    @property
    def dtmin(self):
        return self.controller.dtmin

    def wrap(self, direction):
        """Return this controller: time always runs forward."""
        return self

    def init(
        self, terms: diffrax.AbstractTerm, t0: Array, t1, y0: PyTree, dt0: Any, args: PyTree, func: Callable,
        error_order: Any,
    ):  # fmt: skip
        """The first step."""
        if self.scales is not None and dt0 is None:
            dt0 = FIRST * stop_gradient(self.scales.time * self.rtol ** (1.0 / float(error_order or 1.0)))
        t1, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return t1, (state, None if self.scales is None else self.scales.first)

    def adapt_step_size(
        self, t0: Array, t1, y0: PyTree, y1_candidate: PyTree, args: PyTree, y_error: PyTree, error_order: Any,
        controller_state: PyTree,
    ):  # fmt: skip
        """Whether to keep a step, and the next one."""
        state, largest = controller_state
        weighed, now = self._weighed(t0, t1, y0, y1_candidate, y_error, largest)
        keep, *rest, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, weighed, error_order, state
        )
        largest = None if now is None else jnp.where(keep, now, largest)
        return keep, *rest, (state, largest), result

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def _weighed(self, t0: Array, t1: Array, y0: PyTree, y1: PyTree, error, largest):
        """The error in the controller's units, and the largest numbers including this step."""
        error, unravel = ravel_pytree(error)
        before, after, t0, h = stop_gradient((_rows(*y0), _rows(*y1), t0, t1 - t0))
        size = jnp.maximum(jnp.abs(before), jnp.abs(after))
        if largest is None:
            allowed = self.tolerances.atol[:, None] + self.tolerances.rtol[:, None] * self._capped_angles(size)
            now = None
        else:
            now = jnp.maximum(size, largest)
            allowed = self._allowed_by_size(size, now, jnp.abs(after - before)[1] / h)
            if self.scales is not None and (forced := self.scales.forced) is not None:
                allowed = allowed + forced.left_over(forced.near(t0), h)
        # Where nothing is allowed nothing may be off: zero stays zero.
        weights = (self.atol + self.rtol * size) / jnp.where(allowed > 0, allowed, jnp.finfo(size.dtype).tiny)
        return unravel(error * weights.ravel()), now

    def _allowed_by_size(self, size: int, largest, rate):
        scales = self.scales
        assert scales is not None
        others = shared(scales, largest)
        q, v = self._capped_angles(jnp.maximum(size, DIED_OUT * largest))
        own_size = jnp.stack([q, jnp.maximum(v, jnp.sqrt(rate * (q + OF_OTHERS * others[0])))])
        # The same substitute as at the start, from the first acceleration that there is.
        reach = jnp.max(scales.root_mass[0] * rate) * jnp.stack([scales.time**2, scales.time])[:, None]
        from_nothing = np.array(FROM_NOTHING, own_size.dtype)[:, None] * reach * scales.over_root_mass
        own_size = jnp.where(scales.unknown, jnp.maximum(own_size, from_nothing), own_size)
        if any(self.angles):
            others = jnp.maximum(others, np.stack([self.angles, np.zeros(len(self.angles))]).astype(others.dtype))
        # At rest velocities are the round-off of forces that cancel, whose size only the start tells.
        others = jnp.maximum(others, stop_gradient(scales.reach * scales.over_root_mass))
        return self.tolerances.rtol[:, None] * own_size + rounding(others)

    def _capped_angles(self, sizes):
        if not any(self.angles):
            return sizes
        most = np.stack([np.where(self.angles, TURN, np.inf), np.full(len(self.angles), np.inf)])
        return jnp.minimum(sizes, most.astype(sizes.dtype))


def _rows(*trees):
    """The numbers of trees of the same structure, one row per tree."""
    return ravel_pytree(trees)[0].reshape(len(trees), -1)


# `shares` with the first step as proposed, and no longest one; an infinite share of an empty interval would be NaN.
WHOLE_STEPS = 1.0, 1e30
# The distance kept from a jump, in round-offs of the time: a user may compute the same time in two ways.
MARGIN = 4
# So many attempts take a few seconds in large systems; a collision that passes takes a few hundred.
TRIES, TIMES = 4096, 100


class StepToOutputs(diffrax.AbstractStepSizeController):
    """Wrap `controller`: each of the increasing times `ts` is the end of a step.

    `shares`: the part of the proposed first step that is taken; and the longest step, as a part of the interval between
    two of `ts`. `max_steps`: None if a motion may take as many as it wants.
    """

    controller: diffrax.PIDController | PerCoordinateTolerance
    ts: Float[Array, " T"]
    shares: Float[Array, " 2"]
    max_steps: int | None = eqx.field(static=True, default=None)

    def wrap(self, direction):
        """Wrap the inner controller likewise; `ts` stay, since time always runs forward here."""
        return StepToOutputs(self.controller.wrap(direction), self.ts, self.shares, self.max_steps)

    def init(
        self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, dt0: Any, args: PyTree, func: Callable,
        error_order: Any,
    ):  # fmt: skip
        """Choose the first step."""
        proposed, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index, step = jnp.minimum(1, self.ts.size - 1), self.shares[0] * (proposed - t0)
        return self._toward(index, t0, step), (state, index, step, jnp.asarray(0))

    def adapt_step_size(
        self, t0: Array, t1: Array, y0: PyTree, y1_candidate: PyTree, args: PyTree, y_error: PyTree, error_order: Any,
        controller_state: PyTree,
    ):  # fmt: skip
        """Decide whether to keep a step, and choose the next one."""
        state, index, before, short = controller_state
        # Output times may be closer together than the least step; that must not end the solve.
        least = self.controller.dtmin
        judged = t1 if least is None else jnp.maximum(t1, t0 + 2 * least)
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, judged, y0, y1_candidate, args, y_error, error_order, state
        )
        proposed = next_t1 - next_t0
        if least is not None:
            # The step itself was rejected, not the longer one that was judged, or it would be tried again for ever.
            proposed = jnp.where(keep, proposed, proposed * ((t1 - t0) / (judged - t0)))
            result = diffrax.RESULTS.where(~keep & (proposed < least), diffrax.RESULTS.dt_min_reached, result)
        next_t0 = next_t0 if least is None else jnp.where(keep, t1, t0)
        # That a step was shortened is no reason to reduce the size proposed before it.
        proposed = jnp.where(keep, jnp.maximum(proposed, jnp.where(t1 - t0 < before, before, 0.0)), proposed)
        if self.max_steps is not None:
            longer = TIMES * self.max_steps * proposed > self.ts[-1] - next_t0
            short = jnp.where(longer, 0, jnp.where(t1 < self.ts[index], short + 1, short))
            result = diffrax.RESULTS.where(short >= TRIES, diffrax.RESULTS.max_steps_rejected, result)
        index = jnp.where(keep & (t1 >= self.ts[index]), jnp.minimum(index + 1, self.ts.size - 1), index)
        return keep, next_t0, self._toward(index, next_t0, proposed), jumped, (state, index, proposed, short), result

    def _toward(self, index, t: Array, step):
        left = self.ts[index] - t
        step = jnp.minimum(step, self.shares[1] * (self.ts[index] - self.ts[index - 1]))
        halfway = t + jnp.where(step < 0.5 * left, step, 0.5 * left)
        # At the last time there is nothing left, and diffrax ends the solve. Times a round-off apart cannot be parted.
        partly = (step < left) & (halfway > t)
        return jnp.where(partly | (left <= 0), jnp.where(left > 0, halfway, t + step), self.ts[index])


def together(ts: Float[Array, " T"], jump_ts: Float[Array, " J"]) -> Float[Array, " T+J"]:
    """Merge the increasing times `ts` and the jumps between the first and last, each once; pad with the last time."""
    # If a jump and one of `ts` are equal, the jump is kept, for the derivative with respect to it.
    # Not `clip`, whose derivative is one half for a jump at the first or the last time.
    within = jnp.where(jump_ts < ts[0], ts[0], jnp.where(jump_ts > ts[-1], ts[-1], jump_ts))
    times = jnp.sort(jnp.concatenate([within, ts]), stable=True)
    repeated = jnp.concatenate([jnp.zeros_like(times[:1], bool), times[1:] == times[:-1]])
    return jnp.sort(jnp.where(repeated, ts[-1], times), stable=True)


def between_jumps(t0: Array, t1: Array, jump_ts, made_jump: Any):
    """Return the ends of the step from t0 to t1, moved off any jump, and whether it starts at one."""
    margin = _round_off(jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    starts, ends, room = jnp.any(t0 == jump_ts), jnp.any(t1 == jump_ts), t1 - t0 > 4 * margin
    t1 = jnp.where(ends & room, t1 - margin, t1)
    return jnp.where(starts & room, t0 + margin, t0), t1, starts | made_jump


def apart_from_jumps(equations: Equations, ts: Array, jump_ts, q: PyTree, v: PyTree):
    """Return the outputs; one at the time of a jump must not move with the jump, although the end of its step does.

    `late` is zero, but its derivative is that of the difference of the two times.
    """
    # The first and the last time are those of the motion itself, and never move with a jump.
    same = (ts[:, None] == jump_ts[None, :]) & ((ts > ts[0]) & (ts < ts[-1]))[:, None]
    late = jnp.where(jnp.any(same, axis=1), ts - jump_ts[jnp.argmax(same, axis=1)], 0.0)
    before = ts - _round_off(jnp.abs(ts))
    a = jax.vmap(lambda t, q, v: equations.accelerations(t, q, v)[0])(before, q, v)

    def along(x, rate):
        return x + late.reshape(-1, *[1] * (x.ndim - 1)) * lax.stop_gradient(rate)

    return jax.tree.map(along, q, v), jax.tree.map(along, v, a)


def _round_off(t: Array):
    return MARGIN * np.finfo(t.dtype).eps * t


# Without projection a state drifts off its constraints, and dependent ones then disagree by that much.
DEPENDENT_BELOW_WHILE_DRIFTING = 1e-3
# An output is a shorter step than the accepted one around it: its error should be smaller, not this much larger.
OUTPUT_TOLERANCES = 100.0
# A fixed step whose error is this share of the state is beyond the method's stability.
LOST = 0.3
NOT_FINITE = diffrax.RESULTS.nonfinite_input


class StageConstraints(NamedTuple):
    """The constraint equations that the vector field solves with, the same in all stages of one step."""

    independent: Bool[Array, " m"] | None


class Field(eqx.Module):
    """d(q, v)/dt = (v, a) by the robust solve; with Baumgarte's feedback, if its rate is given."""

    equations: Equations
    feedback: Float[Array, ""] | None = None

    def __call__(self, t: Array, y: PyTree, args: PyTree):
        independent = args.independent if isinstance(args, StageConstraints) else None
        a = self.equations.accelerations_alone(t, *y, self.feedback, independent)
        return self.equations.velocities(t, *y), a


class FastField(eqx.Module):
    """The same by the fast, written-out equations, which may give NaN where the robust solve does not."""

    equations: Equations

    def __call__(self, t: Array, y: PyTree, args: PyTree):
        return self.equations.velocities(t, *y), self.equations.fast(t, *y)[0]


class ProjectedSolver(diffrax.AbstractWrappedSolver):
    """Wrap `solver`: project after each step (if `project`), and compute dense output by steps.

    A step that cannot be returned to the constraints is rejected; with fixed steps the solve ends there. `controlled`:
    the tolerances choose the steps. `arriving`: outputs are wanted only at the ends of steps; `between`: inside them,
    from a polynomial. The controller makes steps end at `jump_ts`; here each step is kept on its side of them.

    The solver holds the equations, since diffrax gives an interpolation only times and states; `fast`: the same method,
    for steps with the written-out equations. `feedback`: the rate of Baumgarte's feedback. If `refused`, and if a step
    is not finite, its error is infinite: an adaptive solve ends within a few steps at the smallest step size, one with
    fixed steps at once. `in_parts`: the robust step and the return to the constraints are machine functions of their
    own (`one_function`), which have no reverse mode.
    """

    solver: diffrax.AbstractSolver
    equations: Equations
    fast: diffrax.AbstractSolver | None
    feedback: Float[Array, ""] | None
    refused: Bool[Array, ""]
    tolerances: Tolerances
    controlled: bool = eqx.field(static=True)
    project: bool = eqx.field(static=True)
    arriving: bool = eqx.field(static=True)
    between: bool = eqx.field(static=True)
    jump_ts: Float[Array, " J"] | None = None
    in_parts: bool = eqx.field(static=True, default=False)

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    # diffrax reads the next three only if the wrapped solver is of the kind that has them.
    @property
    def scan_kind(self):
        return cast(diffrax.AbstractRungeKutta, self.solver).scan_kind

    @property
    def root_finder(self):
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_finder

    @property
    def root_find_max_steps(self):
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_find_max_steps

    @property
    def interpolation_cls(self) -> Callable:
        return self._between

    @property
    def terms(self) -> diffrax.AbstractTerm:
        """The vector field by the robust solve."""
        return diffrax.ODETerm(Field(self.equations, self.feedback))

    @property
    def fast_terms(self) -> diffrax.AbstractTerm:
        """The vector field by the written-out equations."""
        return diffrax.ODETerm(FastField(self.equations))

    def _between(self, *, t0: Array, t1: Array, y0: PyTree, y1: PyTree = None, state=None, a0=None, a1=None):
        if self.between:
            return Quintic(t0=t0, t1=t1, y0=y0, y1=y1, a0=a0, a1=a1)
        if self.arriving:
            return Arrived(t0=t0, t1=t1, y0=y0, y1=y1)
        return SteppedTo(t0=t0, t1=t1, y0=y0, state=state, solver=self)

    def order(self, terms: diffrax.AbstractTerm):
        return self.solver.order(terms)

    def strong_order(self, terms: diffrax.AbstractTerm):
        return self.solver.strong_order(terms)

    def error_order(self, terms: diffrax.AbstractTerm):
        return self.solver.error_order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree):
        if self.fast is not None:
            return self.fast.init(self.fast_terms, t0, t1, y0, args)
        return self.solver.init(self.terms, t0, t1, y0, self._stages(t0, y0))

    def func(self, terms: diffrax.AbstractTerm, t0: Array, y0: PyTree, args: PyTree):
        # Only used to choose the first step, which has to be finite even where the motion is refused.
        if self.fast is not None:
            rate = self.fast_terms.vf(t0, y0, args)
        else:
            rate = self.solver.func(self.terms, t0, y0, self._stages(t0, y0))
        return jtu.tree_map(lambda f: jnp.where(self.refused | ~jnp.isfinite(f), 0.0, f), rate)

    def step(
        self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree, solver_state: PyTree,
        made_jump: Any,
    ):  # fmt: skip
        if self.jump_ts is not None:
            t0, t1, made_jump = between_jumps(t0, t1, self.jump_ts, made_jump)
        if self.fast is None:
            y1, error, rates, solver_state, result = self._robust_step(t0, t1, y0, solver_state, made_jump)
        else:
            y1, error, rates, solver_state, result = self._fast_step(t0, t1, y0, solver_state, made_jump)
        # An infinite state would make its error relative to it zero.
        failed = self.refused | ~all_finite((y1, error))
        y1 = jtu.tree_map(lambda y1, y0: jnp.where(failed, y0, y1), y1, y0)
        error = jtu.tree_map(lambda x: jnp.where(failed, jnp.inf, x), error)
        result = diffrax.RESULTS.where(failed & (result == diffrax.RESULTS.successful), NOT_FINITE, result)
        if rates is not None:
            return y1, error, {"y0": y0, "y1": y1, "a0": rates[0], "a1": rates[1]}, solver_state, result
        if self.arriving:
            return y1, error, {"y0": y0, "y1": y1}, solver_state, result
        # Newton's iteration for an output starts from the polynomial of the step around it.
        continued = solver_state if isinstance(self.solver, Radau5) else None
        return y1, error, {"y0": y0, "state": continued}, solver_state, result

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def _fast_step(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, made_jump: Any):
        fast, terms = self.fast, self.fast_terms
        assert fast is not None
        jumped = True if self.project else made_jump
        y1, error, dense, solver_state, result = fast.step(terms, t0, t1, y0, None, solver_state, jumped)
        rates = self._rates(dense, t1 - t0)
        if self.project:
            y1 = self.equations.projected(t1, *y1)
        if not self.equations.fallback:
            return y1, error, rates, solver_state, result
        valid = all_finite((y1, error))

        def again():
            y1, error, rates, _, result = self._robust_step(t0, t1, y0, None, True)
            return y1, error, rates, fast.init(terms, t1, t1, y1, None), result

        # A branch also in a batch, where all lanes take it or none.
        return lax.cond(eqxi.unvmap_all(valid), lambda: (y1, error, rates, solver_state, result), again)

    def _robust_step(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, made_jump: Any):
        call = one_function if self.in_parts else _called
        # The projection moves the state, so a derivative kept from the last step's end is stale.
        jumped = True if self.project else made_jump
        moved = call(ProjectedSolver._unprojected, self, t0, t1, y0, solver_state, jumped)
        y1, error, dense, solver_state, result = moved
        rates = self._rates(dense, t1 - t0)
        if self.project:
            projected = call(to_manifold, self.equations, t1, *y1, *self.tolerances)
            y1 = (projected.q, projected.v)
            error = jtu.tree_map(lambda x: jnp.where(projected.holds, x, jnp.inf), error)
            result = diffrax.RESULTS.where(projected.holds, result, diffrax.RESULTS.nonlinear_divergence)
        return y1, error, rates, solver_state, result

    def _unprojected(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, jumped: Any):
        """The wrapped solver's step by the robust solve."""
        terms, stages = self.terms, self._stages(t0, y0)
        if solver_state is None:
            solver_state = self.solver.init(terms, t0, t1, y0, stages)
        return self.solver.step(terms, t0, t1, y0, stages, solver_state, jumped)

    def _rates(self, dense: dict, h: Array):
        """The accelerations at both ends of a step, which are its first and last stages; None if not needed."""
        if not self.between:
            return None
        step = jnp.where(h == 0, 1.0, h)
        return tuple(jtu.tree_map(lambda k, i=i: k[i] / step, dense["k"][1]) for i in (0, -1))

    def again(self, t0: Array, t1: Array, y0: PyTree):
        """Repeat an accepted step from its start, fast if possible.

        Return its end and the accelerations at both ends (None if not `between`), and whether that is finite.
        """
        if self.fast is None:
            return self.again_robustly(t0, t1, y0)
        if self.jump_ts is not None:
            t0, t1, _ = between_jumps(t0, t1, self.jump_ts, True)
        y1, error, dense, *_ = self.fast.step(self.fast_terms, t0, t1, y0, None, None, True)
        y1 = self.equations.projected(t1, *y1) if self.project else y1
        return (y1, self._rates(dense, t1 - t0)), all_finite((y1, error))

    def again_robustly(self, t0: Array, t1: Array, y0: PyTree):
        """The same with the robust solve."""
        if self.jump_ts is not None:
            t0, t1, _ = between_jumps(t0, t1, self.jump_ts, True)
        y1, _, rates, *_ = self._robust_step(t0, t1, y0, None, True)
        return (y1, rates), jnp.asarray(True)

    def acceptable(self, y0: PyTree, y1: PyTree, error):
        """Whether an output's error is not far above the tolerance; the controller does not check steps to outputs.

        With fixed steps there is no tolerance; beyond a method's limit of stability the error is as large as the state.
        """
        if error is None:
            return True
        rtol, atol = (self.tolerances.rtol[0], self.tolerances.atol[0]) if self.controlled else (0.0, 0.0)
        share = OUTPUT_TOLERANCES * rtol if self.controlled else LOST

        def largest(tree: PyTree):
            return jnp.max(jnp.abs(ravel_pytree(tree)[0]))

        of_parts = [largest(e) <= OUTPUT_TOLERANCES * atol + share * largest((a, b)) for a, b, e in zip(y0, y1, error)]
        return of_parts[0] & of_parts[1]

    def _stages(self, t: Array, y: PyTree):
        threshold = None if self.project else DEPENDENT_BELOW_WHILE_DRIFTING
        return StageConstraints(self.equations.independent(t, *y, threshold))


def _called(function: Callable, *args):
    return function(*args)


class Arrived(Interpolation):
    """The state at the ends of a step, where all outputs are; only the first output is at a start."""

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree

    def at(self, t: Array):
        return jtu.tree_map(lambda y0, y1: jnp.where(t <= self.t0, y0, y1), self.y0, self.y1)


class SteppedTo(Interpolation):
    """The state inside a step, by one step of the solver from the step's start; NaN if that step fails."""

    t0: PyTree
    t1: PyTree
    y0: PyTree
    state: PyTree
    solver: ProjectedSolver

    def at(self, t: Array):
        s = self.solver
        # diffrax's program contains this three times, each compiled: the robust step alone compiles in a third of the
        # time of both, and costs little at run time, since most outputs are ends of steps.
        t0, made_jump = self.t0, False
        if s.jump_ts is not None:
            t0, t, made_jump = between_jumps(t0, t, s.jump_ts, made_jump)
        y, error, *_, result = s._robust_step(t0, t, self.y0, self.state, made_jump)
        valid = (result == diffrax.RESULTS.successful) & s.acceptable(self.y0, y, error)
        return jtu.tree_map(lambda x: jnp.where(valid, x, jnp.nan), y)


def forward_differentiable(method: diffrax.AbstractSolver):
    """A method whose stage loop can be differentiated forward even inside a reverse-mode solve.

    An event time is an implicit function of the step, and its derivative needs ∂y/∂t forward. Such a loop also
    traces in half the time of a checkpointed one, and runs backwards as fast.
    """
    if not isinstance(method, diffrax.AbstractRungeKutta) or method.scan_kind is not None:
        return method
    return eqx.tree_at(lambda s: s.scan_kind, method, "bounded", is_leaf=lambda x: x is None)
