"""Values that a user's function closes over, made explicit where JAX is tracing them.

Parameters belong in `params`. A Lagrangian that closes over one still works as long as it is a number; while it is
being differentiated or batched, a solve with a derivative rule of its own would not see it and would silently return
a zero gradient. `lift` turns such values into arrays that the system carries, where every derivative finds them.
"""

import types
from collections.abc import Callable

import equinox as eqx
import jax
from jax.core import Tracer, eval_jaxpr
from jaxtyping import Array

from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics.arguments import takes_of
from lagjax.mechanics.constraints import Holonomic, Nonholonomic, zero_multipliers
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.system import System


class Lifted(eqx.Module):
    """A function together with the values that it closed over."""

    function: Callable
    values: list[Array]
    takes: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __call__(self, *args):
        return self.function(*args, *self.values)


def lift(system: System, s: State) -> System:
    """The system with traced closed-over values lifted; the same object where there are none."""
    if is_eager():
        return system
    of_state, of_position = (s.t, s.q, s.v, s.params), (s.t, s.q, s.params)
    functions = {
        "lagrangian": lift_function(system.lagrangian, of_state),
        "force": _lifted_force(system, s),
        "dissipation": lift_function(system.dissipation, of_state),
    }
    constraints = {
        name: Holonomic(lift_function(c.g, of_position))
        if isinstance(c, Holonomic)
        else Nonholonomic(lift_function(c.phi, of_state))
        for name, c in system.constraints.items()
    }
    lifted = System(constraints=constraints, **functions).reading(system.read)
    return lifted if any(isinstance(f, Lifted) for f in jax.tree.leaves(lifted, is_leaf=_is_lifted)) else system


def lift_function(function: Callable | None, args: tuple):
    """The function with the traced values that it closes over lifted; the same object where there are none."""
    if function is None or is_eager() or (isinstance(function, types.FunctionType) and function.__closure__ is None):
        return function
    arrays, static = eqx.partition(args, eqx.is_array)
    of_arrays = lambda arrays: function(*eqx.combine(arrays, static))
    # JAX's `closure_convert` would lift only values that may be differentiated, not those that are batched.
    program, shapes = jax.make_jaxpr(of_arrays, return_shape=True)(arrays)
    traced = [isinstance(value, Tracer) for value in program.consts]
    if not any(traced):
        return function

    def lifted(*args):
        arrays, values = eqx.filter(args[: len(static)], eqx.is_array), iter(args[len(static) :])
        constants = [next(values) if t else value for value, t in zip(program.consts, traced)]
        results = eval_jaxpr(program.jaxpr, constants, *jax.tree.leaves(arrays))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return Lifted(lifted, [value for value, t in zip(program.consts, traced) if t])


def _lifted_force(system, s):
    if system.force is None:
        return None
    takes = takes_of(system.force)
    given = s._asdict() | {"multipliers": zero_multipliers(system, s)}
    lifted = lift_function(system.force, tuple(given[name] for name in takes))
    return Lifted(lifted.function, lifted.values, takes) if isinstance(lifted, Lifted) else lifted


def _is_lifted(node):
    return isinstance(node, Lifted)
