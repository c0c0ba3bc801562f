"""What a scene is, read off its jaxpr: never from values, so that it holds at every state.

A coordinate is an *angle* where L, R, Q and the constraints see it only through sines and cosines of expressions
linear in it. Its size then means nothing: after a thousand turns an error counts as it did in the first.

The jaxpr is walked once for each leaf of q. Every intermediate value is, as a function of that leaf, constant, linear,
periodic (made of sines and cosines), or anything else; what a primitive makes of its operands follows from these.
"""

from enum import IntEnum

import equinox as eqx
import jax
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import PyTree

from lagjax.mechanics.constraints import Holonomic


class Depends(IntEnum):
    """How a value depends on one leaf of q."""

    NOT = 0
    LINEARLY = 1
    PERIODICALLY = 2
    OTHERWISE = 3


ADDITIVE = {
    "add", "add_any", "sub", "neg", "reduce_sum", "cumsum", "concatenate", "reshape", "squeeze", "expand_dims", "slice",
    "broadcast_in_dim", "transpose", "rev", "pad", "copy", "stack", "convert_element_type", "stop_gradient", "split",
}  # fmt: skip
# Linear in the first operand; the others only choose or scale, and must not depend on the leaf.
BY_FIRST = {"div", "dynamic_slice", "gather"}
BILINEAR = {"mul", "dot_general"}
PERIODIC = {"sin", "cos"}


def angles(system, t, q, v, params) -> PyTree[bool]:
    """Which leaves of q are angles, in the structure of q."""
    leaves, structure = jtu.tree_flatten(q)
    found = []
    for i in range(len(leaves)):
        kinds = {
            _dependence(f, (t, q, v, params), lambda args, i=i: jtu.tree_leaves(args[1])[i]) for f in _seen(system)
        }
        found.append(kinds - {Depends.NOT} == {Depends.PERIODICALLY})
    return jtu.tree_unflatten(structure, found)


def conserves_jacobi_integral(system, t, q, v, params) -> bool:
    """Whether the Jacobi integral is known to be constant: no explicit time, no force, only positions constrained."""
    if system.force is not None or system.dissipation is not None:
        return False
    if not all(isinstance(c, Holonomic) for c in system.constraints.values()):
        return False
    of_time = [_dependence(f, (t, q, v, params), lambda args: args[0]) for f in _seen(system)]
    return all(kind == Depends.NOT for kind in of_time)


def _seen(system):
    """All functions that the motion depends on, of (t, q, v, params)."""
    functions = [system.lagrangian, system.force, system.dissipation]
    for c in system.constraints.values():
        functions.append((lambda t, q, v, params, g=c.g: g(t, q, params)) if isinstance(c, Holonomic) else c.phi)
    return [f for f in functions if f is not None]


def _dependence(function, args, leaf_of):
    """How the outputs of a function of (t, q, v, params) depend on one leaf of these."""
    arrays, static = eqx.partition(args, eqx.is_array)

    def of_arrays(arrays):
        return eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array)

    jaxpr = jax.make_jaxpr(of_arrays)(arrays).jaxpr
    count, structure = len(jaxpr.invars), jtu.tree_structure(arrays)
    chosen = leaf_of(jtu.tree_unflatten(structure, range(count)))
    kinds = [Depends.LINEARLY if i == chosen else Depends.NOT for i in range(count)]
    return max(_walk(jaxpr, kinds), default=Depends.NOT)


def _walk(jaxpr: Jaxpr, kinds):
    known = dict(zip(jaxpr.invars, kinds))
    kind_of = lambda x: Depends.NOT if isinstance(x, Literal) else known.get(x, Depends.NOT)
    for equation in jaxpr.eqns:
        result = _apply(equation, [kind_of(x) for x in equation.invars])
        known.update(zip(equation.outvars, result))
    return [kind_of(x) for x in jaxpr.outvars]


def _apply(equation, kinds):
    """What a primitive makes of operands of these kinds, one for each of its results."""
    name, worst, count = equation.primitive.name, max(kinds, default=Depends.NOT), len(equation.outvars)
    inner = [p for p in equation.params.values() if isinstance(p, (ClosedJaxpr, Jaxpr))]
    if len(inner) == 1 and name not in ("while", "scan"):
        jaxpr = getattr(inner[0], "jaxpr", inner[0])
        if len(jaxpr.invars) == len(kinds):
            return _walk(jaxpr, kinds)
    if worst in (Depends.NOT, Depends.OTHERWISE):
        return [worst] * count
    linear = Depends.LINEARLY in kinds
    if name in PERIODIC or not linear:
        return [Depends.PERIODICALLY] * count
    # From here on something is linear; beside it something periodic makes neither.
    pure = Depends.PERIODICALLY not in kinds
    if name in ADDITIVE and pure:
        return [Depends.LINEARLY] * count
    if name in BY_FIRST and pure and worst == kinds[0] and max(kinds[1:], default=Depends.NOT) == Depends.NOT:
        return [Depends.LINEARLY] * count
    if name in BILINEAR and pure and kinds.count(Depends.LINEARLY) == 1:
        return [Depends.LINEARLY] * count
    return [Depends.OTHERWISE] * count
