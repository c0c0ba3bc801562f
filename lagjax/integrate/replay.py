"""Reverse mode by replay: the accepted steps are pulled back one by one, from the last to the first.

A motion is a chain of steps, y_{i+1} = Phi(t_i, t_{i+1}, y_i, p). With the cotangents c_i of the requested states, and
l_N = c_N at its end,

    (dp_i, l_i) = (∂Phi/∂(p, y))ᵀ l_{i+1},    l_i += c_i,    dp = Σ dp_i

differentiates one step at a time, at its start state: the same step, with its return to the constraints and with the
constraint equations chosen at its start; what the method keeps from step to step is computed again. The controller, the
steps that it rejected and the search for events do not take part. The ends of steps are constants, as in forward mode;
but outputs and jumps are ends of steps, and the cotangents of these ends belong to the times of outputs and jumps. The
ends of steps of a fixed length move with the first time, except for the last one, and outputs are steps of their own.

`step_record.py` records the steps. The loop forward is a primitive, the loop back the transpose of its linear
derivative; both have rules for lanes.

The loop back goes through the steps in pieces of as many steps as there are rows. The rows of the last piece, which
comes first, are at hand; earlier pieces are run again, each from a checkpoint. In a batch one step of all lanes is
pulled back at once, so that the cotangents of shared arrays are summed inside matrix products. Lanes have different
numbers of steps: each begins with its own last one, and idles when it has finished.

With steps of a fixed length each output is a shorter step of its own, from the start y_k of the step around it: it is
pulled back before that step, and its cotangent of y_k waits until the step itself has been pulled back.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jaxtyping import Array, Int, PyTree

from lagjax.integrate.step_record import (
    Recorded,
    RecordRows,
    StepProblem,
    StepRecord,
    outputs_within,
    recorded,
    recorded_again,
)
from lagjax.integrate.stepping import ProjectedSolver
from lagjax.jaxtools import (
    PRODUCT,
    ad,
    filled,
    front,
    is_float,
    length,
    like,
    linear_map_primitive,
    no_tangent,
    one_function,
    primitive,
    split,
)
from lagjax.numerics import ExplicitRungeKutta, Nystrom, evaluations_a_step
from lagjax.refusals import must

# Up to so many operations of a step pulled back, each stage gets a copy of the right-hand side instead of a loop. What
# is not one machine function goes through memory at each turn of a loop, large matrices and their cotangents included:
# with copies, gradients by a network of twenty thousand numbers, or in 64 lanes, take a fifth less. Compiling takes
# longer.
COPIES = 1000


class Lanes(NamedTuple):
    """A batch: the number of lanes, and which operands have one row per lane."""

    count: int
    batched: tuple[bool, ...]

    def each(self, function: Callable, more=0):
        """Map `function` over the lanes; it takes the operands and `more` arguments that are all batched."""
        return jax.vmap(function, [0 if b else None for b in self.batched] + [0] * more, axis_size=self.count)


@dataclass(frozen=True, eq=False)
class BackwardMotion:
    """A motion as a function of its arrays, each of which occurs once; everything else is stored here."""

    structure: Any
    places: tuple[int, ...]
    static: PyTree
    max_steps: int | None
    checked: bool
    bent: bool
    results: Callable
    # The structure of the record, filled when it has been traced.
    found: list

    def problem(self, leaves: Sequence) -> StepProblem:
        """The problem with these arrays."""
        return eqx.combine(jtu.tree_unflatten(self.structure, [leaves[i] for i in self.places]), self.static)

    def recorded(self, arrays) -> Recorded:
        """The record with these arrays."""
        structure, others = self.found[0]
        return eqx.combine(jtu.tree_unflatten(structure, arrays), others)

    @property
    def size(self) -> int:
        """How many arrays there are."""
        return max(self.places) + 1

    @property
    def robust(self) -> bool:
        """Whether some steps may have used the robust solve instead of the written-out equations."""
        solver = self.static.solver
        return solver.fast is not None and solver.equations.fallback

    @property
    def where(self) -> StepProblem:
        """The problem with the index of each array in its place."""
        return jtu.tree_unflatten(self.structure, self.places)


class BackwardSweep(NamedTuple):
    """The state of the loop back: the next step `k`, and the rows of the piece `number`.

    `y`: the cotangent of the state at the end of step k, without that of an output there; `moved`: the cotangents of
    the arrays so far; `output`: the last output not passed yet; `aside`: the cotangent of the state at the start of
    step k from outputs inside it; None if these are no steps of their own.
    """

    k: Int[Array, ""]
    number: Int[Array, ""]
    rows: RecordRows
    y: PyTree
    moved: list
    output: Int[Array, ""]
    aside: PyTree = None


def swept_back(
    leaves: Sequence, found: Recorded, asked, *, motion: BackwardMotion, moved: Sequence, lanes: Lanes | None
):
    """The cotangents of the arrays with indices `moved`, from those of the outputs, the last time and the last state.

    The first of several outputs at one time has the cotangents of all of them: see `together`.
    """
    of_outputs, of_t, of_y = asked
    way = _Way(leaves, motion, moved, lanes, found.record, of_outputs)
    total = [jnp.zeros_like(leaves[i]) for i in moved]
    if way.of_times:
        total = way.added_at(total, found.t, of_t)
    k = found.record.count - 1
    output = way.at(way.first, found.record.saved - 1)
    aside = jax.tree.map(jnp.zeros_like, of_y) if motion.static.aside else None
    s = BackwardSweep(k, jnp.where(k >= 0, k // way.many, -1), way.safe(found.record.rows), of_y, total, output, aside)
    s = lax.while_loop(lambda s: eqxi.unvmap_any(s.k >= 0), way.piece, s)
    # Outputs at the start are the first state.
    y, total = jax.tree.map(jnp.add, s.y, way.at(of_outputs, jnp.zeros_like(k))), s.moved
    for i, ct in zip(jtu.tree_leaves(way.where.y0), jtu.tree_leaves(y)):
        total = way.added(total, i, ct)
    return total


def together(leaves: Sequence, motion: BackwardMotion, lanes: Lanes | None, of_outputs):
    """The cotangents of outputs, with those of all outputs at one time added to the first of these."""
    _, first = _outputs(leaves, motion, lanes)

    def summed(first, ct):
        return jnp.zeros_like(ct).at[first].add(ct)

    summed = summed if lanes is None else jax.vmap(summed)
    return jax.tree.map(lambda ct: summed(first, ct), of_outputs)


@dataclass(frozen=True, eq=False)
class _Way:
    """The constants of the way back, for one lane or for all lanes."""

    leaves: list
    motion: BackwardMotion
    moved: tuple[int, ...]
    lanes: Lanes | None
    record: StepRecord
    of_outputs: PyTree

    @cached_property
    def where(self) -> Any:
        return self.motion.where

    @cached_property
    def of_times(self) -> bool:
        """Whether the cotangents of times are wanted."""
        ends = (self.where.t1, self.where.ts) if self.motion.static.fixed else (self.where.controller.ts,)
        return bool({self.where.t0, *ends} & set(self.moved))

    @property
    def many(self) -> int:
        """The number of rows."""
        return self.record.rows.t0.shape[-1]

    @property
    def ts(self):
        return _outputs(self.leaves, self.motion, self.lanes)[0]

    @property
    def first(self):
        return _outputs(self.leaves, self.motion, self.lanes)[1]

    def is_lane(self, i) -> bool:
        """Whether the i-th array has a row for each lane."""
        return self.lanes is not None and self.lanes.batched[i]

    def at(self, tree: PyTree, i):
        """The i-th rows."""

        def of(tree: PyTree, i):
            return jax.tree.map(lambda x: x[i], tree)

        return of(tree, i) if self.lanes is None else jax.vmap(of)(tree, i)

    def each(self, function: Callable, more: int) -> Callable:
        """Turn `function(problem, ...)` into one of the arrays and `more` arguments, mapped over the lanes."""

        def of(*x):
            return function(self.motion.problem(x[: len(x) - more]), *x[len(x) - more :])

        return of if self.lanes is None else self.lanes.each(of, more)

    def safe(self, tree: PyTree):
        """Values per lane; lanes without steps get the longest lane's, since zero times their own may be NaN."""
        if self.lanes is None:
            return tree
        idle, longest = self.record.count == 0, jnp.argmax(self.record.count)
        return jax.tree.map(lambda x: jnp.where(like(idle, x), x[longest][None], x), tree)

    def added(self, total, i, ct):
        """The cotangents of the arrays, with `ct` added to that of the i-th, if it is wanted."""
        if i not in self.moved:
            return total
        ct = jnp.sum(ct, axis=0) if self.lanes is not None and not self.is_lane(i) else ct
        return [x + ct if j == i else x for j, x in zip(self.moved, total)]

    def added_at(self, total: list, t: Array, ct):
        """The cotangents of the arrays, with that of the time t, which is an end of a step."""
        if not self.motion.static.fixed:
            return self.added(total, self.where.controller.ts, self.at_time(self.where.controller.ts, t, ct))
        last = t == self.leaves[self.where.t1]
        total = self.added(total, self.where.t1, jnp.where(last, ct, 0.0))
        return self.added(total, self.where.t0, jnp.where(last, 0.0, ct))

    def at_time(self, ends: int, t: Array, ct):
        """The cotangent of a time as that of the equal one of the times in the array `ends`."""

        def of(ts: Array, t: Array, ct):
            return jnp.where((jnp.arange(ts.size) == jnp.sum(ts < t)) & (ts == t), ct, 0.0)

        of = of if self.lanes is None else jax.vmap(of, (0 if self.is_lane(ends) else None, 0, 0))
        return of(self.leaves[ends], t, ct)

    def pulled(self, t0: Array, t1: Array, y: PyTree, ct, of_outputs):
        """The cotangents of the arrays, of both times (None if not wanted) and of the state at a step's start.

        `of_outputs`: the cotangents of outputs inside the step and elsewhere; None if outputs are ends of steps.
        """
        leaves = [self.safe(x) if self.is_lane(i) else x for i, x in enumerate(self.leaves)]
        chosen = [leaves[i] for i in self.moved]
        start = (chosen, t0, t1, y) if self.of_times else (chosen, y)

        def end(by, chosen, *start):
            start = start if self.of_times else (t0, t1, *start)
            step = self.each(partial(ended, by), 4)
            return step(*filled(leaves, self.moved, chosen), *start, of_outputs)

        def ended(by, problem: StepProblem, t0: Array, t1: Array, y: PyTree, of_outputs):
            (y1, rates), valid = by(self.copied(problem.solver, t0, t1, y), t0, t1, y)
            if rates is None:
                return (y1, None), valid
            inside, states = outputs_within(problem, t0, t1, y, y1, *rates)
            of_inside = jax.tree.map(
                lambda x, ct: jnp.sum(x * jnp.where(like(inside, ct), ct, 0.0)), states, of_outputs
            )
            return (y1, sum(jtu.tree_leaves(of_inside))), valid

        (_, weighed), pull, valid = jax.vjp(partial(end, ProjectedSolver.again), *start, has_aux=True)
        ct = ct, None if weighed is None else jnp.ones_like(weighed)
        if self.motion.robust:
            # Choose between pulls, not between ends: the derivative of an invalid end is NaN, and zero times it too.
            robustly = partial(end, ProjectedSolver.again_robustly)
            pull = partial(
                lax.cond, eqxi.unvmap_all(valid), pull, lambda ct: jax.vjp(robustly, *start, has_aux=True)[1](ct)
            )
        of_arrays, *of_start = pull(ct)
        return (of_arrays, *of_start) if self.of_times else (of_arrays, None, None, *of_start)

    def copied(self, solver: ProjectedSolver, t0: Array, t1: Array, y: PyTree) -> ProjectedSolver:
        """The solver with its right-hand side copied to each stage, if that is worthwhile."""
        method = solver.solver
        if solver.fast is not None or not isinstance(method, Nystrom | ExplicitRungeKutta):
            return solver
        if self.lanes is None and all(x.size <= PRODUCT for x in self.leaves):
            return solver
        program = jax.make_jaxpr(lambda t, y: solver.terms.vf(t, y, None))(t0, y)
        if length(program.jaxpr) * (evaluations_a_step(method) or 0) > COPIES:
            return solver
        return replace(solver, solver=replace(method, in_a_loop=False))

    def is_on(self, s: BackwardSweep):
        """Whether the next step belongs to this piece."""
        return (s.k >= s.number * self.many) & (s.k >= 0)

    def turn(self, s: BackwardSweep) -> BackwardSweep:
        """Pull back one step."""
        on = self.is_on(s)
        t0, t1, y0 = self.at(s.rows, jnp.maximum(s.k, 0) % self.many)
        here = on & (t1 > t0)
        ct, output, inside, aside = s.y, s.output, None, None
        if self.motion.static.solver.between:
            inside = only(here, self.of_outputs)
        else:
            at = jnp.maximum(output, 0)
            time, of_output = self.at(self.ts, at), self.at(self.of_outputs, at)
            hit = here & (output >= 0) & (time > t0) & (time <= t1)
            output = jnp.where(hit, self.at(self.first, at - 1), output)
            if self.motion.static.aside:
                aside, t1 = hit, jnp.where(hit, time, t1)
                ct = jax.tree.map(lambda y, x: jnp.where(like(hit, x), x, y), ct, of_output)
            else:
                ct = jax.tree.map(jnp.add, ct, only(hit, of_output))
        of_arrays, of_t0, of_t1, of_y = self.pulled(t0, t1, y0, only(here, ct), inside)
        total = [x + (only(here, d) if self.is_lane(i) else d) for x, d, i in zip(s.moved, of_arrays, self.moved)]
        if self.of_times:
            of_t0, of_t1, first = only(here, of_t0), only(here, of_t1), s.k == 0
            if aside is not None:
                total = self.added(total, self.where.ts, self.at_time(self.where.ts, t1, only(aside, of_t1)))
                of_t1 = only(~aside, of_t1)
            total = self.added(total, self.where.t0, only(first, of_t0))
            total = self.added_at(total, t1, of_t1)
            total = self.added_at(total, t0, only(~first, of_t0))
        if aside is None:
            y = jax.tree.map(lambda x, ct: jnp.where(like(here, x), x, ct), of_y, ct)
            return BackwardSweep(s.k - on, s.number, s.rows, y, total, output)
        waiting = jax.tree.map(jnp.add, s.aside, only(here, of_y))
        y = jax.tree.map(lambda x, y: jnp.where(like(here & ~aside, x), x, y), waiting, s.y)
        return BackwardSweep(s.k - (on & ~aside), s.number, s.rows, y, total, output, only(aside, waiting))

    def piece(self, s: BackwardSweep) -> BackwardSweep:
        """Pull back one piece."""
        number = jnp.where(s.k >= 0, s.k // self.many, -1)
        # The piece before this one ends where this one begins.
        end, further = self.at(s.rows.t0, jnp.zeros_like(number)), number < s.number

        def again():
            rows = self.safe(self.each(recorded_again, 3)(*self.leaves, self.record, number, end))
            return jax.tree.map(lambda x, old: jnp.where(like(further, x), x, old), rows, s.rows)

        rows = lax.cond(eqxi.unvmap_any(further), again, lambda: s.rows)
        return lax.while_loop(lambda s: eqxi.unvmap_any(self.is_on(s)), self.turn, s._replace(number=number, rows=rows))


def only(condition: Array, tree: PyTree):
    """The tree, with zeros where the condition does not hold."""
    return jax.tree.map(lambda x: jnp.where(like(condition, x), x, 0.0), tree)


def _outputs(leaves: Sequence, motion, lanes):
    """The output times, and the first output at each of them, for one lane or for all."""

    def of(*leaves):
        return motion.problem(leaves).ts, motion.problem(leaves).first

    return of(*leaves) if lanes is None else lanes.each(of)(*leaves)


@dataclass(frozen=True)
class Replay:
    """Reverse mode by a replay of the motion's steps, within a budget of memory, for `lj.integrate(adjoint=...)`.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.sum(p) * jnp.cos(q))
    >>> ts, few = jnp.array([0.0, 1.0]), lj.Replay(memory=20e3)
    >>> end = lambda p: lj.integrate(swing, 1e-3, 0.0, p, ts=ts, adjoint=few).q[-1]
    >>> print(f"{1e3 * jax.grad(end)(jnp.full(30, 1 / 30))[0]:.3f}")
    -0.421

    - `memory`: the size of one motion's record in bytes, all of which is allocated; by default room for 512 steps and
      64 checkpoints. Steps that do not fit are computed again on the way back: with room for r steps and p checkpoints,
      a motion of up to r steps is not computed again, one of up to r p steps once. Each motion of a batch has its own
      record, and a program needs other memory too: for outputs, and for a step itself.

    `adjoint=None` does the same. `record` and `bent` are for internal use.

    **Raises:** `ValueError` if `memory` is not a positive number or is too small for the motion, and where steps are
    not recorded (a controller of one's own except fixed steps, a condition for diffrax, `progress`).

    Source: Griewank & Walther, *Evaluating Derivatives*, ch. 12 (reversal by checkpoints).
    """

    memory: float | None = None
    # The record of an earlier call at the same point; the motion is then not integrated again.
    record: Recorded | None = None
    # Whether this reverse derivative is itself differentiated in forward mode.
    bent: bool = False

    def __post_init__(self):
        well = self.memory is None or isinstance(self.memory, int | float) and self.memory > 0
        must(well, "memory must be a positive number of bytes", self.memory, "lj.Replay(memory=50e6)")


def replayed(problem: StepProblem, max_steps: int | None, checked: bool, adjoint: Replay) -> Recorded:
    """Integrate a motion such that its reverse derivative replays it; return the values in `adjoint.record` if there.

    Compiled a second time, a motion may take other steps. Its reverse derivative needs the recorded steps; if that is
    differentiated forward, it also needs the tangents of their start states, which must come from the same run.
    """
    arrays, static = eqx.partition(problem, eqx.is_array)
    given, structure = jtu.tree_flatten(arrays)
    # An array that occurs twice, as in a solver and in the controller that holds it, is one operand.
    leaves = list({id(x): x for x in given}.values())
    number = {id(x): i for i, x in enumerate(leaves)}

    def results(*leaves):
        found = one_function(recorded, motion.problem(leaves), max_steps, checked=checked, in_blocks=True)
        arrays, others = eqx.partition(found, eqx.is_array)
        motion.found.append((jtu.tree_structure(arrays), others))
        return jtu.tree_leaves(arrays)

    # Jitted, so that it is traced once.
    places = tuple(number[id(x)] for x in given)
    motion = BackwardMotion(structure, places, static, max_steps, checked, adjoint.bent, jax.jit(results), [])
    if adjoint.record is None or adjoint.bent:
        return motion.recorded(_run_p.bind(*leaves, motion=motion, lanes=None, same_run=False))
    values, rest = eqx.partition(adjoint.record, eqx.is_array)
    values, structure = jtu.tree_flatten(values)
    motion.found.append((structure, rest))
    return motion.recorded(_known_p.bind(*leaves, *values, motion=motion, lanes=None))


# The operands of the first primitive are the arrays of the problem, its results the arrays of the record. `same_run`:
# values and tangents must come from one run. The operands of its derivative are both, and the tangents of the arrays
# with indices `moved`; its results are the tangents of the floating-point arrays of the record.


def _run(*leaves, motion: BackwardMotion, lanes, same_run: bool = False):
    return motion.results(*leaves) if lanes is None else lanes.each(motion.results)(*leaves)


def _run_shapes(*leaves, motion: BackwardMotion, lanes, same_run: bool):
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    found = jax.eval_shape(lambda *leaves: _run(*leaves, motion=motion, lanes=lanes), *like)
    return [ShapedArray(x.shape, x.dtype) for x in found]


def _known(*operands, motion: BackwardMotion, lanes):
    return list(operands[motion.size :])


def _known_jvp(primals: Sequence, tangents: Sequence, *, motion: BackwardMotion, lanes):
    # The known values belong to the given arrays, so only the tangents of these matter, not those of the values.
    values, leaves = _known_p.bind(*primals, motion=motion, lanes=lanes), primals[: motion.size]
    return values, _derivative(leaves, values, tangents[: motion.size], motion, lanes)


def _known_batched(operands: Sequence, axes: Sequence, *, motion: BackwardMotion, lanes):
    operands, batched, count = front(operands, axes)
    leaves, values = operands[: motion.size], operands[motion.size :]
    values = [x if b else jnp.broadcast_to(x, (count, *x.shape)) for x, b in zip(values, batched[motion.size :])]
    if lanes is None:
        both = Lanes(count, batched[: motion.size])
    else:
        leaves, both = _lanes_of_lanes(leaves, batched, lanes, count)
        values = [x.reshape(count * lanes.count, *x.shape[2:]) for x in values]
    found = _known_p.bind(*leaves, *values, motion=motion, lanes=both)
    found = found if lanes is None else [x.reshape(count, lanes.count, *x.shape[1:]) for x in found]
    return found, [0] * len(found)


def _run_jvp(primals: Sequence, tangents: Sequence, *, motion: BackwardMotion, lanes, same_run: bool):
    if same_run:
        return _pushed(primals, tangents, motion, lanes)
    values = _run_p.bind(*primals, motion=motion, lanes=lanes, same_run=motion.bent)
    return values, _derivative(primals, values, tangents, motion, lanes)


def _pushed(leaves: Sequence, tangents: Sequence, motion: BackwardMotion, lanes):
    """Values and tangents of one run; it is no linear map, so it cannot be transposed."""
    moved, moving = _moving(tangents)
    run = partial(_run, motion=motion, lanes=lanes)
    start = tuple(leaves[i] for i in moved)
    values, found = jax.jvp(lambda *chosen: run(*filled(leaves, moved, chosen)), start, tuple(moving))
    return values, [d if is_float(x) else no_tangent(x) for x, d in zip(values, found)]


def _derivative(leaves: Sequence, values, tangents: Sequence, motion: BackwardMotion, lanes):
    moved, moving = _moving(tangents)
    if not moved:
        return [no_tangent(x) for x in values]
    found = iter(_moved_p.bind(*leaves, *values, *moving, motion=motion, lanes=lanes, moved=moved))
    return [next(found) if is_float(x) else no_tangent(x) for x in values]


def _moving(tangents: Sequence):
    """The indices of the operands that have tangents, and these tangents."""
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero))
    return moved, [tangents[i] for i in moved]


def _run_batched(operands: Sequence, axes: Sequence, *, motion: BackwardMotion, lanes, same_run: bool):
    operands, batched, count = front(operands, axes)
    if lanes is None:
        found = _run_p.bind(*operands, motion=motion, lanes=Lanes(count, batched), same_run=same_run)
        return found, [0] * len(found)
    flat, both = _lanes_of_lanes(operands, batched, lanes, count)
    found = _run_p.bind(*flat, motion=motion, lanes=both, same_run=same_run)
    return [x.reshape(count, lanes.count, *x.shape[1:]) for x in found], [0] * len(found)


def _lanes_of_lanes(leaves: Sequence, batched, lanes, count: int):
    """Flatten a batch of batches into one batch."""
    flat = []
    for x, b, inner in zip(leaves, batched, lanes.batched):
        if b or inner:
            x = x if b else jnp.broadcast_to(x, (count, *x.shape))
            x = x if inner else jnp.broadcast_to(x[:, None], (count, lanes.count, *x.shape[1:]))
            x = x.reshape(count * lanes.count, *x.shape[2:])
        flat.append(x)
    return flat, Lanes(count * lanes.count, tuple(b or inner for b, inner in zip(batched, lanes.batched)))


# The points are the arrays of the problem and those of the record.
def _moved(points: Sequence, moving: Sequence, *, motion: BackwardMotion, lanes, moved: Sequence):
    leaves = points[: motion.size]

    def of_moved(*chosen):
        found = _run(*filled(leaves, moved, chosen), motion=motion, lanes=lanes)
        return [x for x in found if is_float(x)]

    return jax.jvp(of_moved, tuple(leaves[i] for i in moved), tuple(moving))[1]


def _moved_shapes(*operands, motion: BackwardMotion, lanes, moved: Sequence):
    values = split(operands, len(moved))[0][motion.size :]
    return [ShapedArray(x.shape, x.dtype) for x in values if is_float(x)]


def _moved_jvp(primals: Sequence, tangents: Sequence, **params):
    # Forward over forward: the result cannot be transposed.
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    return jax.jvp(partial(_moved_at, **params), primals, tuple(tangents))


def _moved_at(*operands, moved: Sequence, **params):
    return _moved(*split(operands, len(moved)), moved=moved, **params)


def _moved_batched(operands: Sequence, axes: Sequence, **params):
    # Many directions at once, in forward mode.
    count = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    found = jax.vmap(partial(_moved_at, **params), axes, axis_size=count)(*operands)
    return found, [0] * len(found)


def _moved_transpose(
    points: Sequence, moving: Sequence, wanted: Sequence, cotangents: Sequence, *, motion: BackwardMotion, lanes,
    moved: Sequence,
):  # fmt: skip
    leaves, values = points[: motion.size], points[motion.size :]
    given = iter(cotangents)
    given = jtu.tree_unflatten(motion.found[0][0], [next(given) if is_float(x) else None for x in values])
    of_record = jtu.tree_leaves(given.record, is_leaf=_is_zero)
    if any(eqx.is_array(ct) for ct in of_record):
        raise NotImplementedError(
            "a reverse derivative of the record of a motion's steps is not available.\n"
            "Usual cause: reverse mode over a derivative that was itself taken in reverse.\n"
            "Fix: jax.jvp of it, along each direction that is wanted."
        )
    asked = given.outputs, given.t, given.y
    asked = jax.tree.map(ad.instantiate_zeros, asked, is_leaf=_is_zero)
    asked = together(leaves, motion, lanes, asked[0]), *asked[1:]
    swept = partial(swept_back, motion=motion, moved=moved, lanes=lanes)
    if lanes is None:
        return one_function(swept, leaves, motion.recorded(values), asked, checked=motion.checked, in_blocks=True)
    return swept(leaves, motion.recorded(values), asked)


def _is_zero(x):
    return isinstance(x, ad.Zero)


_run_p = primitive("lagjax_recorded", _run, _run_shapes, several=True, jvp=_run_jvp, batched=_run_batched)
_known_p = primitive(
    "lagjax_recorded_before", _known, lambda *operands, motion, lanes: list(operands[motion.size :]),
    several=True, jvp=_known_jvp, batched=_known_batched,
)  # fmt: skip
_moved_p = linear_map_primitive(
    "lagjax_recorded_tangent", _moved, _moved_transpose, _moved_shapes, lambda params: len(params["moved"]),
    jvp=_moved_jvp, batched=_moved_batched,
)  # fmt: skip
