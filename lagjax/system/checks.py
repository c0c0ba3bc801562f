"""The first call of the user's functions: on shapes alone, before anything is computed or compiled.

Each is checked, and becomes its jaxpr (`traced_functions.py`). `user_errors.py` explains the errors that occur inside
them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import is_linear, kinds, length, once, remembered, without_repeats
from lagjax.system import coordinates
from lagjax.system.argument_checks import check_system
from lagjax.system.coordinates import State
from lagjax.system.function_arguments import OF_STATE, WITH_FORCE, takes_of
from lagjax.system.model import Model, model_of
from lagjax.system.states import check_rate, check_starts, check_use, with_rates
from lagjax.system.system import System, unchecked
from lagjax.system.traced_functions import Traced, TracedProgram, traced
from lagjax.system.user_errors import Call, check_arguments, in_words
from lagjax.system.warn import warn

CAUSE = "an argument left out as the function does not need it, or one too many: a constraint of positions takes no v"
# A vehicle written by hand has 260 operations in L, 32 links in a loop 580; what they cost is measured on these.
MANY, SECONDS_EACH = 500, 0.05
OF_STATES = "the state as an argument of its own: it is q['z'], by its name"


def prepare(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> tuple[Model, State]:
    """The model of a system and a state of it, all checked: what a front door does first."""
    check_system(system, t, q, v, params)
    s = coordinates.state(t, q, with_rates(system, q, v), params)
    return model_of(traced_system(system, s), *s), s


def checked(system: System, given: State) -> tuple[System, State]:
    """The checked system and its state; integers in `params` become floats if the functions accept them."""
    floats = jax.tree.map(lambda x: float(x) if type(x) is int else x, given.params)
    if any(type(x) is int for x in jax.tree.leaves(given.params)):
        with suppress(TypeError, ValueError, IndexError):
            s = coordinates.state(*given[:3], floats)
            return traced_system(system, s), s
    # A count or an index must stay an integer.
    s = coordinates.state(*given)
    return traced_system(system, s), s


def traced_system(system: System, s: State) -> System:
    """The system with each of its functions checked and traced for such states: what it computes, and no more.

    Raises if L, R, Q or a constraint cannot be called, or returns something of the wrong kind or shape.
    """
    check_system(system)
    check_starts(system.states, s.q)
    given = dict(zip(OF_STATE, s))

    def energy(role: str, f: Callable | None) -> Any:
        return None if f is None else traced_call(Call(role, f, OF_STATE), given, _check_energy)

    lagrangian, dissipation = energy("L", system.lagrangian), energy("dissipation", system.dissipation)
    constraints = {}
    for name, c in system.constraints.items():
        call = Call(c.role, c.function, c.takes, f" of constraint '{name}'")
        constraints[name] = type(c)(traced_call(call, given, _check_constraint))
    states = {}
    for name, f in system.states.items():
        call = Call("rate", f, OF_STATE, f" of state '{name}'")
        states[name] = traced_call(call, given, partial(check_rate, of=s.q[name]), OF_STATES)
    found = unchecked(lagrangian, constraints, None, dissipation, states)
    solved = None
    if system.forward_dynamics is not None:
        call = Call("forward_dynamics", system.forward_dynamics, WITH_FORCE)
        check = partial(_check_force, q=s.q, what="acceleration")
        solved = traced_call(call, given | {"force": s.q}, check)
        found = unchecked(lagrangian, constraints, None, dissipation, states, None, solved)
    if system.force is None:
        check_use(found)
        return found
    # After the constraints, which determine the multipliers.
    given["multipliers"] = model_of(found, *s).zero_multipliers()
    call = Call("force", system.force, takes_of(system.force))
    force = traced_call(call, given, partial(_check_force, q=s.q))
    found = unchecked(lagrangian, constraints, force, dissipation, states, None, solved)
    check_use(found)
    model = model_of(found, *s)
    if model.reacts:
        remembered(found, (_check_linear, kinds(s)), lambda: _check_linear(model, s))
    return found


def traced_call(call: Call, given: Mapping[str, Any], check: Callable, usual_cause: str = CAUSE) -> Traced:
    """A function traced on the `given` arguments; raises in the user's words, or if `check` refuses its result."""
    args = tuple(given[name] for name in call.takes)

    def make():
        check_arguments(call, usual_cause)
        with in_words(call, given):
            program = TracedProgram(call.function, call.takes, args)
        check(call, program.value)
        if length(program.jaxpr) > MANY:
            _warn_of_length(str(call), program)
        return program

    return traced(call.function, args, make)


@once
def _warn_of_length(call: str, program: TracedProgram) -> None:
    """Warn, once, of a function that a loop in Python has written term by term; those of the library have no loops."""
    count = length(without_repeats(program.jaxpr))
    owner = getattr(program.function, "__self__", program.function)
    if count <= MANY or type(owner).__module__.startswith("lagjax."):
        return
    seconds = float(f"{SECONDS_EACH * count:.1g}")
    warn(
        f"{call} consists of {count:,} operations, which are all differentiated and compiled: some {seconds:g} s of "
        "processor time until a first answer, to a factor of 2.\n"
        "Usual cause: a loop in Python, which writes the terms of each body anew.\n"
        "Fix: one term, for JAX to repeat: jnp.sum(jax.vmap(energy_of_one)(q, v)); jnp.cumsum(...) for sums along a "
        "chain.",
        UserWarning,
    )


def _check_energy(call: Call, value):
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(value, float) or shape == () and jnp.issubdtype(dtype, jnp.floating):
        return
    cause = "energies left unsummed, as in 0.5 * m * v**2 with v a vector, even one of length 1"
    fix = "0.5 * m * jnp.sum(v**2), or jnp.dot(v, v); for one coordinate q0 = 0.1, not q0 = [0.1]"
    got = f"shape {shape}, {dtype}" if shape is not None else f"a {type(value).__name__}"
    if value is None:
        got, cause, fix = "None", "a function without return", "return kinetic - potential"
    elif isinstance(value, tuple | list | dict):
        cause, fix = "the energies returned one by one", "return kinetic - potential"
    elif shape is None and isinstance(value, bool | int) or shape == () and not _is_complex(dtype):
        got = f"{value!r}, a {type(value).__name__}" if shape is None else got
        cause, fix = "a condition or a whole number in place of an energy", "return kinetic - potential"
    elif shape == ():
        cause, fix = "a complex parameter, or the root of a negative number", "jnp.real(...)"
    raise ValueError(f"{call} must return one real number, and returned {got}.\nUsual cause: {cause}.\nFix: {fix}.")


def _is_complex(dtype: DTypeLike):
    return jnp.issubdtype(dtype, jnp.complexfloating)


def _check_force(call: Call, force: PyTree, q: PyTree, what: str = "force"):
    expected = jax.tree.map(jnp.shape, q)
    if force is None:
        raise ValueError(
            f"{call} must return one {what} per coordinate, like q, and returned None.\n"
            "Usual cause: a function without return.\n"
            f"Fix: return the structure of q, with 0.0 where there is no {what}."
        )
    if jax.tree.map(jnp.shape, force) != expected:
        raise ValueError(
            f"{call} must return one {what} per coordinate, like q.\n"
            f"  q has shapes {expected}\n  the {what} has {jax.tree.map(jnp.shape, force)}\n"
            f"Usual cause: a {what} for only one of the coordinates.\n"
            f"Fix: return the structure of q, with 0.0 where there is no {what}."
        )


def _check_linear(model: Model, s: State):
    """Raise where the force is not linear in the multipliers."""
    arrays, static = eqx.partition((model, s), eqx.is_array_like)

    def force(multipliers: Array, arrays: Sequence):
        model, s = eqx.combine(arrays, static)
        return model.vector(model.force_at(s.t, s.q, s.v, multipliers))

    if not is_linear(force, model.m, model.form.dtype, arrays):
        raise ValueError(
            "force(t, q, v, multipliers, params) must be linear in the multipliers, and is not.\n"
            "Usual cause: the size of a normal force, jnp.abs(multipliers[...]) or jnp.maximum(multipliers[...], 0).\n"
            'Fix: the multiplier itself, -mu * multipliers["contact"]: a phase ends where it reaches zero '
            '(lj.releases("contact")).'
        )


def _check_constraint(call: Call, value):
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is None or len(shape) > 1:
        got = f"an array of shape {shape}" if shape is not None else f"a {type(value).__name__}"
        raise ValueError(
            f"{call} must return a scalar or a vector, and returned {got}.\n"
            "Usual cause: several equations in a tuple or a matrix, or a function without return.\n"
            "Fix: return jnp.stack([...]) of the equations, or give each a name of its own."
        )
    if 0 in shape:
        raise ValueError(
            f"{call} must return a scalar or a vector, and returned no equation at all, shape {shape}.\n"
            "Usual cause: an empty list of joints.\n"
            "Fix: leave the constraint out where it has none."
        )
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(
            f"{call} must return real numbers that vanish where it holds, and returned {dtype}.\n"
            "Usual cause: an equation in place of its residual, x**2 + y**2 == l**2.\n"
            "Fix: return x**2 + y**2 - l**2."
        )
