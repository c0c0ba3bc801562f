"""First-order states as the user gives them: what is wrong with them, in his words, and their start velocities."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jaxtools import depends, numpy_of, varies
from lagjax.system.elements import Held
from lagjax.system.system import System
from lagjax.system.traced_functions import Traced
from lagjax.system.user_errors import Call


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
    if not (number and not of.shape or shape == of.shape and np.issubdtype(dtype, np.floating)):
        got = f"shape {shape}, {dtype}" if shape is not None else f"a {type(rate).__name__}"
        raise ValueError(
            f"{call} must return real numbers like the state, of shape {of.shape}, and returned {got}.\n"
            "Usual cause: an array of one entry for a number, a missing return, or several rates in one function.\n"
            "Fix: the rate of this state alone, in the shape of its start value in q0."
        )


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
