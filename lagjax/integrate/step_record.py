"""A loop over steps that records the accepted ones in arrays of fixed size.

Reverse mode needs the accepted steps from the last to the first. Their number is known only when the motion is over,
but arrays need their size before that. So the last steps are kept in full, one row each: its two times and the state
that it starts from. In addition, before the first of every so many steps, all that the loop depends on is kept: a
checkpoint (`RecordPlace`), from which the loop can run again to fill the rows with earlier steps. When the room for
checkpoints is used up, every other one is dropped, and from then on they are kept half as often. A long motion is thus
run again in pieces: each piece once up to rows times checkpoints steps, some pieces more often beyond; memory is fixed.

The loop is diffrax's loop, with its solvers and controllers. Outputs are ends of steps, or lie inside them on a
polynomial; with steps of a fixed length each output is a shorter step of its own, from the start of the step around it.
diffrax's loop keeps a record too (`SaveAt(steps=True)`), with as many rows as there may be steps: a million.
"""

import math
from typing import Any, NamedTuple

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.stepping import ProjectedSolver, StepToOutputs
from lagjax.jaxtools import like, where
from lagjax.numerics import Quintic

# A row of a pendulum takes 40 bytes: in a thousand lanes the rows take 20 MB.
ROWS = 512
PLACES = 64
# The least of both; long motions then take long.
FEWEST_ROWS, FEWEST_PLACES = 16, 4
# diffrax ends a solve this close to its last time, in units of the last digit of that time.
CLIPPED = 100


class Room(NamedTuple):
    """The numbers of rows and of checkpoints."""

    rows: int
    places: int


class StepProblem(NamedTuple):
    """All that a motion is stepped with; the output times `ts` increase, and begin and end with `t0` and `t1`.

    For each output: `first`, the first output at the same time, and `after`, the first output at a later time.
    """

    terms: PyTree[diffrax.AbstractTerm]
    solver: ProjectedSolver
    controller: StepToOutputs | diffrax.ConstantStepSize
    ts: Float[Array, " T"]
    first: Int[Array, " T"]
    after: Int[Array, " T"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    dt0: Float[Array, ""] | None
    y0: PyTree[Float[Array, "..."]]
    args: PyTree
    room: Room = Room(ROWS, PLACES)

    @property
    def fixed(self) -> bool:
        """Whether all steps have one length; their ends then move with the first time, except for the last one."""
        return isinstance(self.controller, diffrax.ConstantStepSize)

    @property
    def aside(self) -> bool:
        """Whether outputs are steps of their own."""
        return self.fixed and not self.solver.between


class RecordPlace(NamedTuple):
    """The position of the loop, and a checkpoint: all that the step from t to t1 and the later ones depend on."""

    t: Float[Array, ""]
    t1: Float[Array, ""]
    y: PyTree[Float[Array, "..."]]
    solver_state: PyTree
    controller_state: PyTree


class RecordRows(NamedTuple):
    """The last accepted steps, step k in row k modulo the number of rows: their times and start states."""

    t0: Float[Array, " R"]
    t1: Float[Array, " R"]
    y0: PyTree[Float[Array, "R ..."]]


class StepRecord(NamedTuple):
    """All that reverse mode needs of a motion.

    `count`: the number of steps; `rows`: the last of them; `places`: the checkpoint at the start of every
    (`ROWS * stride`)-th step; `saved`: the first output that was not reached.
    """

    count: Int[Array, ""]
    rows: RecordRows
    places: RecordPlace
    stride: Int[Array, ""]
    saved: Int[Array, ""]


class Recorded(NamedTuple):
    """The results of the loop, in diffrax's terms, and the record."""

    reached: Bool[Array, " T"]
    outputs: PyTree[Float[Array, "T ..."]]
    t: Float[Array, ""]
    y: PyTree[Float[Array, "..."]]
    stats: dict[str, Array]
    result: Any
    record: StepRecord


class _RecordRun(NamedTuple):
    """The state of the loop. `outputs` and `saved`: as in `Recorded` and `StepRecord`; None when it runs again."""

    place: RecordPlace
    rows: RecordRows
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    result: Any
    outputs: PyTree
    saved: Any


def with_room(problem: StepProblem, memory: float | None) -> StepProblem:
    """The problem with room for a record of `memory` bytes, half of them for rows; None: the usual room."""
    if memory is None:
        return problem._replace(room=Room(ROWS, PLACES))

    def size(tree: PyTree):
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))

    place = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, _first(problem)))
    # On the way back a piece is run again while the later one is held, and its ends are corrected: XLA keeps four.
    of_row, of_place = 4 * size((problem.t0, problem.t1, problem.y0)), size(place)
    rows, places = int(memory / 2 / of_row), 2 * int(memory / 4 / of_place)
    if rows < FEWEST_ROWS or places < FEWEST_PLACES:
        least = 2 * max(FEWEST_ROWS * of_row, FEWEST_PLACES * of_place)
        raise ValueError(
            f"a record of this motion's steps in {memory:.3g} bytes has no room.\n"
            "Usual cause: a budget in megabytes, or for a whole batch; it is in bytes, and for one motion.\n"
            f"Fix: lj.Replay(memory={_rounded_up(least)}) or more."
        )
    return problem._replace(room=Room(rows, places))


def _rounded_up(number):
    return f"{math.ceil(number / 1000)}e3"


def recorded(problem: StepProblem, max_steps: int | None) -> Recorded:
    """Step through a motion, as `diffrax.diffeqsolve` does, and record its steps."""
    p, zero, many = problem, jnp.asarray(0), problem.room.rows
    outputs = jax.tree.map(lambda x: jnp.broadcast_to(x, (p.ts.size, *x.shape)), p.y0)
    place = _first(p)
    places = jax.tree.map(lambda x: jnp.broadcast_to(x, (p.room.places, *jnp.shape(x))), place)
    start = _RecordRun(place, _no_rows(p), zero, zero, _success(), outputs, p.after[0])

    def continues(run):
        return _continues(p, run, max_steps)

    def onward(state):
        run, places, stride = state
        number = run.accepted // many
        full = continues(run) & (number >= p.room.places * stride)
        places = lax.cond(eqxi.unvmap_any(full), lambda: _thinned(places, full), lambda: places)
        stride = jnp.where(full, 2 * stride, stride)
        here = continues(run) & (number % stride == 0)
        places = jax.tree.map(
            lambda all, x: _put(all, jnp.minimum(number // stride, p.room.places - 1), x, here), places, run.place
        )
        return _until(p, run, (number + 1) * many, max_steps), places, stride

    state = start, places, jnp.asarray(1)
    run, places, stride = lax.while_loop(lambda state: eqxi.unvmap_any(continues(state[0])), onward, state)
    result = diffrax.RESULTS.where(continues(run._replace(steps=zero)), diffrax.RESULTS.max_steps_reached, run.result)
    # diffrax saves outputs only at the ends of accepted steps, of which a motion over no time has none.
    reached = (p.first < run.saved) & ((run.accepted > 0) | (p.t0 == p.t1))
    stats = {"num_steps": run.steps, "num_accepted_steps": run.accepted, "num_rejected_steps": run.steps - run.accepted}
    record = StepRecord(run.accepted, run.rows, places, stride, run.saved)
    outputs = jax.tree.map(lambda x: x[p.first], run.outputs)
    return Recorded(reached, outputs, run.place.t, run.place.y, stats, result, record)


def recorded_again(problem: StepProblem, record: StepRecord, number, end) -> RecordRows:
    """The rows of the piece `number`, which ends at the time `end`, by running again from a checkpoint before it.

    The same operations, compiled a second time, round differently, and a step may become longer by a part in 1e8.
    Pieces must still meet: the last step goes to `end`, and missing steps are filled up with steps of no length.
    """
    slot, many = jnp.maximum(number, 0) // record.stride, problem.room.rows
    place, begun = jax.tree.map(lambda x: x[slot], record.places), slot * record.stride * many
    p = problem._replace(t1=jnp.minimum(end, problem.t1))
    run = _RecordRun(place._replace(t1=jnp.minimum(place.t1, p.t1)), record.rows, begun, begun, _success(), None, None)
    count = jnp.minimum((number + 1) * many, record.count)
    run = _until(p, run, count, None)
    k = number * many + np.arange(many)
    taken, place = k < run.accepted, run.place
    t0, t1, y0 = run.rows
    t1 = jnp.where(taken & (k < count - 1), t1, p.t1)
    return RecordRows(
        jnp.where(taken, t0, p.t1), t1, jax.tree.map(lambda x, y: jnp.where(like(taken, x), x, y), y0, place.y)
    )


def _success():
    """The successful result, as an array that may change in a loop."""
    return diffrax.RESULTS.where(jnp.asarray(True), diffrax.RESULTS.successful, diffrax.RESULTS.successful)


def _first(p: StepProblem) -> RecordPlace:
    controller, order = p.controller, p.solver.error_order(p.terms)
    t1, state = controller.init(p.terms, p.t0, p.t1, p.y0, p.dt0, p.args, p.solver.func, order)
    t1 = jnp.minimum(t1, p.t1)
    place = RecordPlace(p.t0, t1, p.y0, p.solver.init(p.terms, p.t0, t1, p.y0, p.args), state)
    return jax.tree.map(jnp.asarray, place)


def _no_rows(p: StepProblem) -> RecordRows:
    # Rows without a step hold the start: they may be evaluated, and must be finite although the result is unused.
    def rows(x):
        return jnp.broadcast_to(x, (p.room.rows, *x.shape))

    return RecordRows(rows(p.t0), rows(p.t0), jax.tree.map(rows, p.y0))


def _thinned(places, full):
    return jax.tree.map(lambda x: jnp.where(full, jnp.concatenate([x[::2], x[len(x) // 2 :]]), x), places)


def _continues(p: StepProblem, run: _RecordRun, max_steps):
    continues = (run.place.t < p.t1) & diffrax.is_successful(run.result)
    return continues if max_steps is None else continues & (run.steps < max_steps)


def _until(p: StepProblem, run: _RecordRun, limit, max_steps) -> _RecordRun:
    """Run the loop up to a number of accepted steps.

    Batched by JAX, a loop selects whole arrays in each turn for lanes that are done; here only changed entries are.
    """

    def continues(run):
        return _continues(p, run, max_steps) & (run.accepted < limit)

    def turn(run: _RecordRun) -> _RecordRun:
        here, place, row = continues(run), run.place, run.accepted % p.room.rows
        further, keep, result, dense = _step(p, place)
        # A rejected step is overwritten by the next one.
        rows = jax.tree.map(lambda all, x: _put(all, row, x, here), run.rows, RecordRows(place.t, place.t1, place.y))
        outputs, saved = run.outputs, run.saved
        if outputs is not None and p.solver.between:
            inside, states = outputs_within(p, place.t, place.t1, **dense)
            hit = here & keep & inside
            outputs = jax.tree.map(lambda all, x: jnp.where(like(hit, x), x, all), outputs, states)
            saved = jnp.where(here & keep, jnp.sum(p.ts <= place.t1, dtype=saved.dtype), saved)
        elif outputs is not None and p.aside:
            outputs, saved = _outputs_aside(p, place, dense, outputs, saved, here & keep)
        elif outputs is not None:
            i = jnp.minimum(saved, p.ts.size - 1)
            hit = here & keep & (saved < p.ts.size) & (place.t1 >= p.ts[i])
            outputs = jax.tree.map(lambda all, x: _put(all, i, x, hit), outputs, further.y)
            saved = jnp.where(hit, p.after[i], saved)
        place, result = where(here, (further, result), (place, run.result))
        return _RecordRun(place, rows, run.steps + here, run.accepted + (here & keep), result, outputs, saved)

    return lax.while_loop(lambda run: eqxi.unvmap_any(continues(run)), turn, run)


def _step(p: StepProblem, place: RecordPlace):
    """One more attempt of a step: the next place, whether the step was accepted, its result, its dense output."""
    order, results = p.solver.error_order(p.terms), diffrax.RESULTS
    y, error, dense, solver_state, solved = p.solver.step(
        p.terms, place.t, place.t1, place.y, p.args, place.solver_state, False
    )
    error = jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error)
    keep, t, t1, _, controller_state, judged = p.controller.adapt_step_size(
        place.t, place.t1, place.y, y, p.args, error, order, place.controller_state
    )
    t = jnp.minimum(t, p.t1)
    nearly = p.t1 - CLIPPED * jnp.finfo(p.t1.dtype).eps * jnp.abs(p.t1)
    t1 = jnp.where(t1 > nearly, jnp.where(keep, p.t1, t + 0.5 * (p.t1 - t)), t1)
    y, solver_state = where(keep, (y, solver_state), (place.y, place.solver_state))
    solved = results.where(keep, solved, results.successful)
    result = results.where(diffrax.is_okay(solved), judged, solved)
    return RecordPlace(t, t1, y, solver_state, controller_state), keep, result, dense


def outputs_within(p: StepProblem, t0: Array, t1: Array, y0: PyTree, y1: PyTree, a0: PyTree, a1: PyTree):
    """Which outputs lie in a step, and the states there, between its ends; elsewhere the state at its end."""
    inside = (p.ts > t0) & (p.ts <= t1)
    between = Quintic(t0=t0, t1=t1, y0=y0, y1=y1, a0=a0, a1=a1)
    return inside, jax.vmap(between.at)(jnp.where(inside, p.ts, t1))


def _outputs_aside(p: StepProblem, place: RecordPlace, dense: dict, outputs: PyTree, saved, here):
    """The outputs with those inside a step, each by a step of its own, and the first that is not reached."""
    step = p.solver.interpolation_cls(t0=place.t, t1=place.t1, **dense)

    def left(state: tuple):
        i = jnp.minimum(state[1], p.ts.size - 1)
        return here & (state[1] < p.ts.size) & (p.ts[i] <= place.t1), i

    def turn(state: tuple):
        (on, i), (outputs, saved) = left(state), state
        outputs = jax.tree.map(lambda all, x: _put(all, i, x, on), outputs, step.evaluate(p.ts[i]))
        return outputs, jnp.where(on, p.after[i], saved)

    return lax.while_loop(lambda state: eqxi.unvmap_any(left(state)[0]), turn, (outputs, saved))


def _put(all, i, x, here):
    return all.at[i].set(jnp.where(here, x, all[i]))
