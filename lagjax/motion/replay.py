"""Reverse mode by replay: the accepted steps from the last to the first, each pulled back by itself.

A motion is a chain of steps, y_{i+1} = Phi(t_i, t_{i+1}, y_i, p). With the cotangents c_i of the states that are asked
for, and l_N = c_N at its end,

    (dp_i, l_i) = (∂Phi/∂(p, y))ᵀ l_{i+1},    l_i += c_i,    dp = Σ dp_i

takes one step at a time, from where it was taken: the step as it was, with its return to the constraints and with the
constraint equations chosen at its start; what the method keeps from step to step is computed anew. The controller, the
steps that it rejected and the search for events are not there. Where steps end is constant, as it is in a solve that is
pushed forward; but outputs and jumps are ends of steps, and the cotangents of these times are theirs.

`recording.py` keeps the steps. Both loops, there and back, are one primitive and its linear derivative with a rule for
lanes: in a batch the cotangents of what all lanes share are added up inside a product of matrices, not lane by lane.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jaxtyping import Array, Int, PyTree

from lagjax.jax_internals.one_function import one_function
from lagjax.jax_internals.primitives import ad, primitive
from lagjax.motion.recording import Problem, Recorded, Rows, recorded, recorded_again
from lagjax.motion.stepping import OnManifold


@dataclass(frozen=True)
class Replay:
    """In place of one of diffrax's adjoints: differentiate the motion by a replay of its steps, where that can be.

    `record`: what an earlier call at the same point found; it is then not stepped through again.
    """

    record: Recorded | None = None


class Lanes(NamedTuple):
    """Of a batch: how many lanes there are, and which operands have one row for each."""

    count: int
    batched: tuple[bool, ...]

    def each(self, function, more=0):
        """`function` of the operands, and of `more` that all are batched, for all lanes."""
        return jax.vmap(function, [0 if b else None for b in self.batched] + [0] * more, axis_size=self.count)


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion as a function of its arrays, each of them once; all else is kept here."""

    structure: jtu.PyTreeDef
    places: tuple[int, ...]
    static: PyTree
    max_steps: int | None
    checked: bool
    results: Callable
    # The structure of the record, once it has been traced.
    found: list

    def problem(self, leaves) -> Problem:
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
    def careful(self) -> bool:
        """Whether some steps may have been taken the careful way, and not as they are written out."""
        solver = self.static.solver
        return solver.quick is not None and solver.equations.fallback

    @property
    def where(self) -> Problem:
        """The problem, in place of each array its number."""
        return jtu.tree_unflatten(self.structure, self.places)


def replayed(problem: Problem, max_steps: int | None, checked: bool, known: Recorded | None = None) -> Recorded:
    """The motion, which is replayed where it is differentiated in reverse; its values, where they are `known`."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    given, structure = jtu.tree_flatten(arrays)
    # What is passed twice, as by a solver and by the controller that asks it, is one operand.
    leaves = list({id(x): x for x in given}.values())
    number = {id(x): i for i, x in enumerate(leaves)}

    def results(*leaves):
        found = one_function(recorded, motion.problem(leaves), max_steps, checked=checked, in_blocks=True)
        arrays, others = eqx.partition(found, eqx.is_array)
        motion.found.append((jtu.tree_structure(arrays), others))
        return jtu.tree_leaves(arrays)

    # Jitted, so that it is traced once.
    places = tuple(number[id(x)] for x in given)
    motion = Motion(structure, places, static, max_steps, checked, jax.jit(results), [])
    if known is None:
        return motion.recorded(_run_p.bind(*leaves, motion=motion, lanes=None))
    values, rest = eqx.partition(known, eqx.is_array)
    values, structure = jtu.tree_flatten(values)
    motion.found.append((structure, rest))
    return motion.recorded(_known_p.bind(*leaves, *values, motion=motion, lanes=None))


# The operands of the first primitive are the arrays of the problem, its results those of the record. Those of its
# derivative are both, and tangents of the arrays that are `moved`; its results the tangents of the floating ones.


def _run(*leaves, motion, lanes):
    return motion.results(*leaves) if lanes is None else lanes.each(motion.results)(*leaves)


def _run_shapes(*leaves, motion, lanes):
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
    found = jax.eval_shape(lambda *leaves: _run(*leaves, motion=motion, lanes=lanes), *like)
    return [ShapedArray(x.shape, x.dtype) for x in found]


def _known(*operands, motion, lanes):
    return list(operands[motion.size :])


def _known_jvp(primals, tangents, *, motion, lanes):
    # The values are those at the arrays that are given, so that what these move by says it all.
    values, leaves = _known_p.bind(*primals, motion=motion, lanes=lanes), primals[: motion.size]
    return values, _derivative(leaves, values, tangents[: motion.size], motion, lanes)


def _known_batched(operands, axes, *, motion, lanes):
    count = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    batched = [axis is not None for axis in axes]
    leaves, values = front[: motion.size], front[motion.size :]
    values = [x if b else jnp.broadcast_to(x, (count, *x.shape)) for x, b in zip(values, batched[motion.size :])]
    if lanes is None:
        both, back = Lanes(count, tuple(batched[: motion.size])), lambda x: x
    else:
        leaves, both = _lanes_of_lanes(leaves, batched, lanes, count)
        values = [x.reshape(count * lanes.count, *x.shape[2:]) for x in values]
        back = lambda x: x.reshape(count, lanes.count, *x.shape[1:])
    found = [back(x) for x in _known_p.bind(*leaves, *values, motion=motion, lanes=both)]
    return found, [0] * len(found)


def _run_jvp(primals, tangents, *, motion, lanes):
    values = _run_p.bind(*primals, motion=motion, lanes=lanes)
    return values, _derivative(primals, values, tangents, motion, lanes)


def _derivative(leaves, values, tangents, motion, lanes):
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero))
    zero = lambda x: ad.Zero(jax.typeof(x).to_tangent_aval())
    if not moved:
        return [zero(x) for x in values]
    moving = [tangents[i] for i in moved]
    found = iter(_moved_p.bind(*leaves, *values, *moving, motion=motion, lanes=lanes, moved=moved))
    return [next(found) if _is_float(x) else zero(x) for x in values]


def _run_batched(operands, axes, *, motion, lanes):
    front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    batched = tuple(axis is not None for axis in axes)
    count = next(x.shape[0] for x, b in zip(front, batched) if b)
    if lanes is None:
        found = _run_p.bind(*front, motion=motion, lanes=Lanes(count, batched))
        return found, [0] * len(found)
    flat, both = _lanes_of_lanes(front, batched, lanes, count)
    found = _run_p.bind(*flat, motion=motion, lanes=both)
    return [x.reshape(count, lanes.count, *x.shape[1:]) for x in found], [0] * len(found)


def _lanes_of_lanes(leaves, batched, lanes, count):
    """Lanes of lanes are lanes."""
    flat = []
    for x, b, inner in zip(leaves, batched, lanes.batched):
        if b or inner:
            x = x if b else jnp.broadcast_to(x, (count, *x.shape))
            x = x if inner else jnp.broadcast_to(x[:, None], (count, lanes.count, *x.shape[1:]))
            x = x.reshape(count * lanes.count, *x.shape[2:])
        flat.append(x)
    return flat, Lanes(count * lanes.count, tuple(b or inner for b, inner in zip(batched, lanes.batched)))


def _operands(operands, motion, moved):
    """The arrays of the problem, those of the record, and the tangents."""
    size = motion.size
    return operands[:size], operands[size : len(operands) - len(moved)], operands[len(operands) - len(moved) :]


def _moved(*operands, motion, lanes, moved):
    leaves, _, moving = _operands(operands, motion, moved)

    def of_moved(*chosen):
        found = _run(*_with(leaves, moved, chosen), motion=motion, lanes=lanes)
        return [x for x in found if _is_float(x)]

    return jax.jvp(of_moved, tuple(leaves[i] for i in moved), tuple(moving))[1]


def _moved_shapes(*operands, motion, lanes, moved):
    return [ShapedArray(x.shape, x.dtype) for x in _operands(operands, motion, moved)[1] if _is_float(x)]


def _moved_jvp(primals, tangents, **params):
    # Only forward: the derivative of what is pushed.
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    return jax.jvp(partial(_moved, **params), primals, tuple(tangents))


def _moved_batched(operands, axes, **params):
    # Many directions, pushed forward.
    count = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    found = jax.vmap(lambda *x: _moved(*x, **params), axes, axis_size=count)(*operands)
    return found, [0] * len(found)


def _moved_transpose(cotangents, *operands, motion, lanes, moved):
    leaves, values, _ = _operands(operands, motion, moved)
    given = iter(cotangents)
    given = jtu.tree_unflatten(motion.found[0][0], [next(given) if _is_float(x) else None for x in values])
    of_record = jtu.tree_leaves(given.record, is_leaf=_is_zero)
    if any(eqx.is_array(ct) for ct in of_record):
        raise NotImplementedError(
            "a reverse derivative of the record of a motion's steps.\n"
            "Usual cause: reverse mode over a derivative that was itself taken in reverse.\n"
            "Fix: jax.jvp of it, along each direction that is wanted."
        )
    asked = given.outputs, given.t, given.y
    asked = jax.tree.map(ad.instantiate_zeros, asked, is_leaf=_is_zero)
    # Of outputs at one time the first has the cotangents of all.
    _, first = _outputs_of(leaves, motion, lanes)
    together = lambda first, ct: jnp.zeros_like(ct).at[first].add(ct)
    together = together if lanes is None else jax.vmap(together)
    asked = jax.tree.map(lambda ct: together(first, ct), asked[0]), *asked[1:]
    swept = partial(swept_back, motion=motion, moved=moved, lanes=lanes)
    if lanes is None:
        found = one_function(swept, leaves, motion.recorded(values), asked, checked=motion.checked, in_blocks=True)
    else:
        found = swept(leaves, motion.recorded(values), asked)
    return [None] * (len(leaves) + len(values)) + found


class Sweep(NamedTuple):
    """How far the way back has come: steps from `k` on are done, those of `number` are in the rows.

    `y`: the cotangent of the state at the start of the last step that was done; `moved`: of the arrays so far;
    `output`: the last output that is not passed yet.
    """

    k: Int[Array, ""]
    number: Int[Array, ""]
    rows: Rows
    y: PyTree
    moved: list
    output: Int[Array, ""]


def swept_back(leaves, found: Recorded, asked, *, motion: Motion, moved, lanes: Lanes | None):
    """The cotangents of the arrays that are `moved`, from those of the outputs, of the last time and the last state."""
    (of_outputs, of_t, of_y), record, where = asked, found.record, motion.where
    many = record.rows.t0.shape[-1]
    alone = lanes is None
    batched = [False] * len(leaves) if alone else lanes.batched
    each = lambda function: function if alone else jax.vmap(function)
    with_leaves = lambda function, more: function if alone else lanes.each(function, more)
    ts, first = _outputs_of(leaves, motion, lanes)
    at = each(lambda tree, i: jax.tree.map(lambda x: x[i], tree))

    # A lane without steps stands in for the longest: its own state may be none, and NaN times zero is NaN.
    steps, rows_of = leaves, lambda rows: rows
    if not alone:
        idle, longest = record.count == 0, jnp.argmax(record.count)
        instead = lambda x: jnp.where(_like(idle, x), x[longest][None], x)
        steps = [instead(x) if b else x for x, b in zip(leaves, batched)]
        rows_of = lambda rows: jax.tree.map(instead, rows)

    of_times = sorted({where.t0, where.controller.ts} & set(moved))
    add = lambda total, i, x: total if i not in moved else _added(total, moved.index(i), x, alone or batched[i])

    def pulled(t0, t1, y, ct):
        """The cotangents of the arrays, of both times and of the state at the start of a step."""
        start = ([steps[i] for i in moved], t0, t1, y) if of_times else ([steps[i] for i in moved], y)

        def ends(by, chosen, *start):
            times_and_state = start if of_times else (t0, t1, *start)
            step = lambda *x: by(motion.problem(x[:-3]).solver, *x[-3:])
            return with_leaves(step, 3)(*_with(steps, moved, chosen), *times_and_state)

        _, pull, believed = jax.vjp(partial(ends, OnManifold.again), *start, has_aux=True)
        carefully = partial(ends, OnManifold.again_carefully)
        if motion.careful:
            # Not a choice between two ends: what is not to be believed has no derivative, and zero times that is NaN.
            pull = partial(lax.cond, eqxi.unvmap_all(believed), pull, lambda ct: jax.vjp(carefully, *start)[1](ct))
        of_arrays, *of_start = pull(ct)
        return of_arrays, *([None, None] if not of_times else []), *of_start

    def at_time(t, ct):
        """The cotangent of a time as that of the end of a step that it is."""
        one = lambda ts, t, ct: jnp.where((jnp.arange(ts.size) == jnp.sum(ts < t)) & (ts == t), ct, 0.0)
        knots = leaves[where.controller.ts]
        return (
            one(knots, t, ct)
            if alone
            else jax.vmap(one, (0 if batched[where.controller.ts] else None, 0, 0))(knots, t, ct)
        )

    def turn(s: Sweep) -> Sweep:
        here = (s.k >= s.number * many) & (s.k >= 0)
        t0, t1, y0 = at(s.rows, jnp.maximum(s.k, 0) % many)
        output = jnp.maximum(s.output, 0)
        time = at(ts, output)
        hit = here & (s.output >= 0) & (time > t0) & (time <= t1)
        ct = jax.tree.map(lambda y, c: y + jnp.where(_like(hit, c), c, 0.0), s.y, at(of_outputs, output))
        on = jax.tree.map(lambda x: jnp.where(_like(here, x), x, 0.0), ct)
        of_arrays, of_t0, of_t1, of_y = pulled(t0, t1, y0, on)
        mine = lambda x, i: jnp.where(_like(here, x), x, 0.0) if not alone and batched[i] else x
        total = [a + mine(b, i) for a, b, i in zip(s.moved, of_arrays, moved)]
        if of_times:
            start = s.k == 0
            total = add(total, where.t0, jnp.where(here & start, of_t0, 0.0))
            total = add(total, where.controller.ts, at_time(t1, jnp.where(here, of_t1, 0.0)))
            total = add(total, where.controller.ts, at_time(t0, jnp.where(here & ~start, of_t0, 0.0)))
        y = jax.tree.map(lambda x, ct: jnp.where(_like(here, x), x, ct), of_y, ct)
        return Sweep(s.k - here, s.number, s.rows, y, total, jnp.where(hit, at(first, output - 1), s.output))

    def piece(s: Sweep) -> Sweep:
        number = jnp.where(s.k >= 0, s.k // many, -1)
        again = lambda: rows_of(
            with_leaves(lambda *x: recorded_again(motion.problem(x[:-2]), *x[-2:]), 2)(*leaves, record, number)
        )
        # The last rows are in hand.
        rows = lax.cond(eqxi.unvmap_any(number < s.number), again, lambda: s.rows)
        is_on = lambda s: eqxi.unvmap_any((s.k >= s.number * many) & (s.k >= 0))
        return lax.while_loop(is_on, turn, s._replace(number=number, rows=rows))

    total = [jnp.zeros_like(leaves[i]) for i in moved]
    if of_times:
        total = add(total, where.controller.ts, at_time(found.t, of_t))
    k = record.count - 1
    last = at(first, record.saved - 1)
    s = Sweep(k, jnp.where(k >= 0, k // many, -1), rows_of(record.rows), of_y, total, last)
    s = lax.while_loop(lambda s: eqxi.unvmap_any(s.k >= 0), piece, s)
    # Outputs at the start are the first state.
    y, total = jax.tree.map(lambda y, c: y + c, s.y, at(of_outputs, jnp.zeros_like(k))), s.moved
    for i, x in zip(jtu.tree_leaves(where.y0), jtu.tree_leaves(y)):
        total = add(total, i, x)
    return total


def _outputs_of(leaves, motion, lanes):
    """The times of the outputs, and the first at each of them, of one lane or of all."""
    of = lambda *leaves: (motion.problem(leaves).ts, motion.problem(leaves).first)
    return of(*leaves) if lanes is None else lanes.each(of)(*leaves)


def _added(total, place, x, as_it_is):
    return [a + (x if as_it_is else jnp.sum(x, axis=0)) if i == place else a for i, a in enumerate(total)]


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (jnp.ndim(x) - jnp.ndim(mask)))


def _is_float(x):
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _is_zero(x):
    return isinstance(x, ad.Zero)


def _with(leaves, moved, chosen):
    filled = list(leaves)
    for i, x in zip(moved, chosen):
        filled[i] = x
    return filled


_run_p = primitive("lagjax_recorded", _run, _run_shapes, several=True, jvp=_run_jvp, batched=_run_batched)
_known_p = primitive(
    "lagjax_recorded_before", _known, lambda *operands, motion, lanes: list(operands[motion.size :]),
    several=True, jvp=_known_jvp, batched=_known_batched,
)  # fmt: skip
_moved_p = primitive(
    "lagjax_recorded_tangent", _moved, _moved_shapes,
    several=True, jvp=_moved_jvp, transpose=_moved_transpose, batched=_moved_batched,
)  # fmt: skip
