"""Reverse mode by replay: the accepted steps are pulled back one by one, from the last to the first.

A motion is a chain of steps, y_{i+1} = Phi(t_i, t_{i+1}, y_i, p). With the cotangents c_i of the requested states, and
l_N = c_N at its end,

    (dp_i, l_i) = (∂Phi/∂(p, y))ᵀ l_{i+1},    l_i += c_i,    dp = Σ dp_i

differentiates one step at a time, at its start state: the same step, with its return to the constraints and with the
constraint equations chosen at its start; what the method keeps from step to step is computed again. The controller, the
steps that it rejected and the search for events do not take part. The ends of steps are constants, as in forward mode;
but outputs and jumps are ends of steps, and the cotangents of these ends belong to the times of outputs and jumps. The
ends of steps of a fixed length move with the first time, except for the last one, and outputs are steps of their own.

`step_record.py` records the steps, `backward_sweep.py` goes back over them. The loop forward is a primitive, the loop
back the transpose of its linear derivative; both have rules for lanes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import ShapedArray

from lagjax.integrate.backward_sweep import BackwardMotion, Lanes, filled, swept_back, together
from lagjax.integrate.step_record import Recorded, StepProblem, recorded
from lagjax.jaxtools import ad, front, is_float, linear_map_primitive, no_tangent, one_function, primitive, split


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
        if self.memory is not None and not (isinstance(self.memory, int | float) and self.memory > 0):
            raise ValueError(
                f"memory must be a positive number of bytes, not {self.memory!r:.40}.\nFix: lj.Replay(memory=50e6)."
            )


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
