"""What every door asks of its arguments, in the user's words: a system, a start, and functions that can be called.

The user's functions are called first on shapes alone, before anything is computed or compiled. Each is checked, and
becomes its jaxpr (`traced.py`). `user_errors.py` explains the errors that occur inside them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial, wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import depends, is_linear, kinds, length, numpy_of, once, remembered, varies, without_repeats
from lagjax.refusals import must_be_like, must_return, shown
from lagjax.system import coordinates
from lagjax.system.constraints import Held, Holonomic, Nonholonomic
from lagjax.system.coordinates import State
from lagjax.system.model import Model, known_system, model_of
from lagjax.system.system import Hybrid, System, unchecked
from lagjax.system.traced import OF_STATE, WITH_FORCE, Traced, TracedProgram, takes_of, traced
from lagjax.system.user_errors import Call, check_arguments, in_words, warn

P = ParamSpec("P")
R = TypeVar("R")
CONSTRAINTS = (Holonomic, Nonholonomic)
SYSTEMS = (System, Hybrid)


def check_system(system: Any, *others: Any, phases: bool = False, states: bool = True, elements: bool = False) -> None:
    """Raise if the first argument of a function is not a `System`, or with `phases` a `Hybrid`.

    `others`: the following arguments, among which the system may be. `states`, `elements`: whether it may have them.
    """
    if not states and isinstance(system, System) and system.states:
        raise ValueError(
            f"this is not done for systems with states, as '{next(iter(system.states))}' here: only coordinates obey "
            "Lagrange's equations.\nFix: lj.integrate for their motions; here the system without them."
        )
    if type(system) is System or isinstance(system, SYSTEMS if phases else System):
        if not elements and getattr(system, "elements", None) is not None:
            raise TypeError(
                f"this takes a system with one form of equations, and the elements of this one "
                f"({', '.join(map(repr, system.elements))}) change them.\n"
                "Fix: lj.System(...) without elements=, with a lj.Holonomic for a contact that is closed; "
                "lj.integrate takes elements."
            )
        return
    known_system(system)
    if isinstance(system, Hybrid):
        raise TypeError(
            "this takes one system, and a lj.Hybrid has one for each of its phases.\n"
            f"Fix: hybrid.systems[{len(system.names) - 1}] for '{system.names[-1]}'; print(hybrid) shows how "
            "the phases follow each other."
        )
    raise TypeError(f"the first argument must be a lj.System, not {shown(system)}.\n{_remedy(system, others)}")


def _remedy(system, others):
    places = [i for i, x in enumerate(others, 2) if isinstance(x, SYSTEMS)]
    if places:
        return (
            f"Usual cause: arguments in another order; the system is argument {places[0]} here.\n"
            "Fix: lj.integrate(system, q0, v0, params, ts=ts); and (system, t, q, v, params) at one state."
        )
    if system is System:
        return "Usual cause: the class in place of a system.\nFix: system = lj.System(lagrangian)."
    if isinstance(system, CONSTRAINTS):
        return (
            "Usual cause: a constraint without its system.\n"
            'Fix: system = lj.System(lagrangian, constraints={"rod": constraint}).'
        )
    if isinstance(getattr(system, "system", None), SYSTEMS):
        return "Usual cause: a result of a system in place of the system.\nFix: its .system."
    name = getattr(system, "__name__", "lagrangian") if callable(system) else "lagrangian"
    name = "lagrangian" if name == "<lambda>" else name
    cause = "the Lagrangian in place of its system" if callable(system) else "arguments in another order"
    return f"Usual cause: {cause}.\nFix: system = lj.System({name}), and the system as the first argument."


def by_name(call: str, *required: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function explain a call without its `required` keyword arguments; `call`: a correct call."""

    def decorate(function: Callable):
        parameters = signature(function).parameters
        most_positional = sum(x.kind is Parameter.POSITIONAL_OR_KEYWORD for x in parameters.values())
        needed = frozenset(required)

        @wraps(function)
        def checked(*args, **kwargs):
            # Unknown keywords are left to Python's own error.
            if (len(args) > most_positional or not kwargs.keys() >= needed) and kwargs.keys() <= parameters.keys():
                missing = [name for name in required if name not in kwargs]
                raise TypeError(_wrong_call(function.__name__, len(args) - most_positional, missing, call))
            return function(*args, **kwargs)

        return checked

    return decorate


def _wrong_call(name: str, excess, missing, call):
    words = [f"without {', '.join(f'{x}=' for x in missing)}"] if missing else []
    words += [f"with {excess} positional argument{'s' * (excess > 1)} too many"] if excess > 0 else []
    which = " and ".join(missing) or "further arguments"
    return (
        f"lj.{name} was called {' and '.join(words)}.\n"
        f"Usual cause: {which} given by position, or left out.\n"
        f"Fix: {call}, by name."
    )


def with_rates(system: Any, q: PyTree, v: PyTree) -> PyTree:
    """v with zeros for the states that it leaves out: their velocities are determined."""
    if not (isinstance(q, Mapping) and isinstance(v, Mapping)):
        return v
    left_out = {name for phase in system.phases for name in phase.states if name in q and name not in v}
    return {**v, **{name: jtu.tree_map(_zeros_like, q[name]) for name in sorted(left_out)}} if left_out else v


def _zeros_like(x: Any):
    return 0.0 if isinstance(x, float | int) else numpy_of(x).zeros_like(x)


def check_starts(states: Mapping, q: PyTree):
    """Raise where q is not a dict, or has no array of numbers by the name of a state."""
    for name, rate in states.items():
        if isinstance(rate, Held) and isinstance(q, Mapping) and name not in q:
            raise ValueError(
                f"q0 has no entry '{name}', the output of the lj.SampledControl of that name before its first instant; "
                f"q has {', '.join(map(repr, q))}.\nFix: q0 = {{..., '{name}': 0.0}}; v0 may leave it out."
            )
        if not isinstance(q, Mapping):
            raise ValueError(
                f"state '{name}' has a name, and q has none: it is {'a number' if not np.ndim(q) else 'an array'}.\n"
                f"Fix: names for all, q0 = {{'x': ..., '{name}': 0.0}}, and q['x'] in L."
            )
        if name not in q or not jtu.treedef_is_leaf(jtu.tree_structure(q[name])):
            has = "no start value" if name not in q else "a start value that is no number or array"
            raise ValueError(
                f"state '{name}' has {has}; q has {', '.join(map(repr, q))}.\n"
                f"Fix: q0 = {{..., '{name}': 0.0}}; v0 may leave it out."
            )


def check_rate(call: Call, rate: Any, of: Array):
    """Raise where the rate of a state is not like the state."""
    shape, dtype = getattr(rate, "shape", None), getattr(rate, "dtype", None)
    number = isinstance(rate, float) and not isinstance(rate, bool)
    holds = number and not of.shape or shape == of.shape and np.issubdtype(dtype, np.floating)
    cause = "an array of one entry for a number, a missing return, or several rates in one function"
    fix = "the rate of this state alone, in the shape of its start value in q0"
    must_return(holds, call, f"real numbers like the state, of shape {of.shape}", rate, fix, cause)


def check_use(system: System):
    """Raise where a function reads of a state what it must not: a state has no inertia, and no force acts on it."""
    energies = {"L": system.lagrangian, "dissipation": system.dissipation}
    for name in system.states:
        for role, f in energies.items():
            if f is not None and _reads(f, "v", name):
                raise ValueError(
                    f"{role} contains the velocity of '{name}', which is a state: its rate is said to be a function.\n"
                    "Usual cause: a coordinate by the same name, or a kinetic energy of all of v.\n"
                    f"Fix: another name for the state, or v['{name}'] left out of {role}."
                )
        for other, f in system.states.items():
            if _reads(f, "v", name):
                raise ValueError(
                    f"the rate of state '{other}' contains v['{name}'], the rate of a state, which is not known before "
                    f"it.\nFix: write the rate of '{name}' out in its place."
                )
        for constraint, c in system.constraints.items():
            if _reads(c.function, "q", name) or _reads(c.function, "v", name):
                raise ValueError(
                    f"constraint '{constraint}' contains state '{name}', and its force would have to act on it.\n"
                    "Usual cause: an actuator that moves a point by a constraint.\n"
                    f"Fix: a stiff spring to q['{name}'] in L; or a coordinate with lj.Nonholonomic for its rate."
                )
        if system.force is not None and _acts_on(system.force, name):
            raise ValueError(
                f"force acts on state '{name}', which has no inertia: its rate is what its function returns.\n"
                f"Fix: '{name}': 0.0 in what force returns, and the term in the function of the state."
            )


def _reads(f: Traced, argument: str, name: str) -> bool:
    """Whether a function depends on an entry of one of its arguments."""
    return depends(f.program.jaxpr, [x for path, x in _inputs(f) if path[:2] == (argument, name)])


def depends_on(f: Traced, *arguments: str) -> bool:
    """Whether a function depends on any of these of its arguments."""
    return depends(f.program.jaxpr, [x for (argument, _), x in _inputs(f) if argument in arguments])


def _acts_on(force: Traced, name: str) -> bool:
    """Whether an entry of the force depends on anything."""
    program, places = force.program, {}
    for i, (path, _) in enumerate(jtu.tree_leaves_with_path(program.value)):
        places[getattr(path[0], "key", None) if path else None] = i
    jaxpr = program.jaxpr.replace(outvars=[program.jaxpr.outvars[places[name]]])
    return depends(jaxpr, jaxpr.invars)


def _inputs(f: Traced) -> Iterator[tuple[tuple, Any]]:
    """The variables of a function's program, each with the name of its argument and of its entry there."""
    found = []
    for argument, tree in zip(f.takes, f.program.like):
        for path, leaf in jtu.tree_leaves_with_path(tree):
            if varies(leaf):
                found.append((argument, getattr(path[0], "key", None) if path else None))
    variables = f.program.jaxpr.invars
    return zip(found, variables[len(variables) - len(found) :])


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
    cause = "a function without return" if force is None else f"a {what} for only one of the coordinates"
    fix = f"return the structure of q, with 0.0 where there is no {what}"
    must_be_like(force, q, f"what {call} returns, one {what} per coordinate,", "q", fix, cause)


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
            '(lj.guards.releases("contact")).'
        )


def _check_constraint(call: Call, value):
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    cause = "several equations in a tuple or a matrix, or a function without return"
    fix = "return jnp.stack([...]) of the equations, or give each a name of its own"
    must_return(shape is not None and len(shape) <= 1, call, "a scalar or a vector", value, fix, cause)
    wanted, fix = "a scalar or a vector with at least one equation", "leave the constraint out where it has none"
    must_return(0 not in (shape or ()), call, wanted, value, fix, "an empty list of joints")
    cause, fix = "an equation in place of its residual, x**2 + y**2 == l**2", "return x**2 + y**2 - l**2"
    must_return(jnp.issubdtype(dtype, jnp.floating), call, "real numbers that vanish where it holds", value, fix, cause)
