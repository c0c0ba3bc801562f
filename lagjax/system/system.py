"""A mechanical system: a Lagrangian, its constraints, and the forces that do not come from a potential.

Check that functions can be pickled, and explain it where they cannot, before pickle fails with its own message.

Pickle writes down where a function is found, its module and name, not what it does. A lambda has no name, and a
function inside another one cannot be reached by its name.
"""

import copy
import pickle
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import FrameType, FunctionType
from typing import Any, ClassVar

import equinox as eqx
import jax
from jaxtyping import PyTree

from lagjax.display import by_line
from lagjax.jaxtools import kinds, same, without_init
from lagjax.system.constraints import Element, Elements, Held, Holonomic, Nonholonomic, SampledControl
from lagjax.system.traced import OF_STATE, WITH_FORCE, Traced

# Packages that pickle any function, whatever its name: they write down what it does.
TAKES_ANY_FUNCTION = ("cloudpickle", "dill")


def check_functions(functions: Mapping[str, Callable | None]) -> None:
    """Raise `pickle.PicklingError` if one of these functions, given by role, cannot be found by its name."""
    for role, function in functions.items():
        function = function.function if isinstance(function, Traced) else function
        if isinstance(function, FunctionType) and not _is_found(function) and not _any_function_is_taken():
            code, name = function.__code__, function.__name__
            raise pickle.PicklingError(
                f"{role} cannot be pickled: {_why(function)} "
                f"({code.co_filename.rsplit('/', 1)[-1]}, line {code.co_firstlineno}).\n"
                "Usual cause: pickle, or a pool of processes, which finds functions by their module and name.\n"
                f"Fix: define it with def at the top of a module, as def {'f' if name == '<lambda>' else name}(...); "
                "or save a trajectory or a fit alone with .save(path), which needs no functions."
            )


def _is_found(function: Callable):
    found = sys.modules.get(function.__module__)
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is function


def _why(function: Callable):
    if function.__name__ == "<lambda>":
        return "it is a lambda"
    if "<locals>" in function.__qualname__:
        return f"{function.__name__} is defined inside of another function"
    return f"{function.__module__}.{function.__qualname__} names another function now"


def _any_function_is_taken():
    """Whether a caller takes any function: `copy`, which keeps functions, or one of `TAKES_ANY_FUNCTION`."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module == copy.__name__ or any(part in TAKES_ANY_FUNCTION for part in module.split(".")):
            return True
        frame = frame.f_back
    return False


FIELDS = "lagrangian", "constraints", "force", "dissipation", "states", "elements", "forward_dynamics"


class System(eqx.Module):
    """Describe a mechanical system by its Lagrangian.

    >>> import jax.numpy as jnp
    >>> def pendulum(t, q, v, params):
    ...     return 0.5 * v**2 + params["g"] / params["length"] * jnp.cos(q)
    >>> System(pendulum)
    System(pendulum)

    **Arguments:**

    - `lagrangian`: `L(t, q, v, params)` -> scalar, `[energy]` (any unit: L may be scaled). Any JAX
      function: explicit time, velocity-dependent potentials and non-quadratic kinetic terms included.
      `q` and `v` arrive in the structure of the initial state, `params` as it was given.
    - `constraints`: by name, `Holonomic(g)` or `Nonholonomic(phi)`. The name is the key of its multiplier.
    - `force`: `Q(t, q, v, params)` -> like `q`, the generalized force that L does not contain,
      `[L]/[q]`. It does the work `Q·v` per unit of time. A force on a contact, as Coulomb's friction, is
      `Q(t, q, v, multipliers, params)`, linear in the multipliers: it enters the equations that determine them.
    - `dissipation`: Rayleigh's function `R(t, q, v, params)` -> scalar; its force is `-∂R/∂v`, so
      `R = ½ c v²` gives `-c v`. A velocity that L does not contain, as of a massless point on a damper, is what makes
      the forces on its coordinate zero, if they are linear in it.
    - `states`: by name, `f(t, q, v, params)` -> like `q[name]`, the rate of something without inertia: a bristle, an
      actuator, a thermostat, a running cost, the memory of a controller. `q` is then a dict, and every function reads
      the state as `q[name]`; the force and events also its rate, as `v[name]`. No force acts on it. See
      `docs/states.md`.

    - `elements`: by name, contacts, friction and sampled control (`lj.Contact`, `lj.CompliantContact`, `lj.Stop`,
      `lj.Friction`, `lj.SampledControl`); or `lj.Elements` of them.
    - `forward_dynamics`: `f(t, q, v, force, params)` -> like `q`, the accelerations that solve the equations of this L
      under a generalized force, if you have a faster way than its mass matrix. Where a motion starts and at each call
      from Python, M a = F is checked with L; from then on accelerations, and multipliers by M⁻¹ = ∂f/∂force, are f's.

    Systems with the same functions are equal, and can be static arguments of `jax.jit`. They can be pickled if their
    functions can, that is if these are defined with `def` in a module.

    **Raises:** `TypeError` where one of these is not a function or a constraint has no kind.

    Source: Goldstein, *Classical Mechanics*, §1.5 (Lagrange's equations with R, Eq. 1.70) and §2.4.
    """

    lagrangian: Callable
    constraints: dict[str, Holonomic | Nonholonomic]
    force: Callable | None
    dissipation: Callable | None
    states: dict[str, Callable]
    elements: Elements | None
    forward_dynamics: Callable | None

    def __init__(
        self,
        lagrangian: Callable,
        constraints: Mapping[str, Holonomic | Nonholonomic] | None = None,
        force: Callable | None = None,
        dissipation: Callable | None = None,
        states: Mapping[str, Callable] | None = None,
        elements: Elements | Mapping[str, Element] | None = None,
        forward_dynamics: Callable | None = None,
    ):
        if isinstance(lagrangian, System):
            raise TypeError("this is a lj.System already.\nFix: system, in place of lj.System(system).")
        functions = {
            "lagrangian": lagrangian, "force": force, "dissipation": dissipation, "forward_dynamics": forward_dynamics,
        }  # fmt: skip
        for role, function in functions.items():
            takes = ", ".join(WITH_FORCE if role == "forward_dynamics" else OF_STATE)
            if function is not None and not callable(function):
                raise TypeError(
                    f"{role} must be a function of ({takes}), not {type(function).__name__}.\n"
                    f"Fix: pass the function itself, {role}=f, not its value f(...)."
                )
        if constraints is not None and not isinstance(constraints, Mapping):
            raise TypeError(
                f"constraints must be given by name, not as {type(constraints).__name__}.\n"
                + ("Usual cause: kinetic and potential energy given separately.\n" if callable(constraints) else "")
                + 'Fix: constraints={"rod": lj.Holonomic(g)}'
                + ("; L is one function, return kinetic - potential." if callable(constraints) else ".")
            )
        for name, constraint in (constraints or {}).items():
            if not isinstance(name, str):
                raise TypeError(
                    f'a constraint is named {name!r}, but its name must be text.\nFix: "{name}": lj.Holonomic(g).'
                )
            if isinstance(constraint, float | int):
                raise TypeError(
                    f"constraint '{name}' is a number.\n"
                    "Usual cause: params in the place of constraints.\n"
                    "Fix: lj.System(lagrangian); each call takes them, lj.integrate(system, q0, v0, params, ts=ts)."
                )
            if not isinstance(constraint, (Holonomic, Nonholonomic)):
                raise TypeError(
                    f"constraint '{name}' is {type(constraint).__name__}; its kind is missing.\n"
                    f'Fix: "{name}": lj.Holonomic(g) for g(t, q, params) = 0, or '
                    f"lj.Nonholonomic(phi) for phi(t, q, v, params) = 0."
                )
        states = {} if states is None else states
        by_name = isinstance(states, Mapping) and all(isinstance(name, str) for name in states)
        if not by_name or not all(map(callable, states.values())):
            raise TypeError(
                f"states must be functions by name, not {states!r:.60}.\n"
                "Usual cause: a start value in the place of the function that is its rate.\n"
                'Fix: states={"z": lambda t, q, v, params: ...}; its start value is q0["z"].'
            )
        self.lagrangian = lagrangian
        # JAX sorts a dict whenever it passes through a transformation; the order of equations must not depend on that.
        self.constraints = dict(sorted((constraints or {}).items()))
        self.force = force
        self.dissipation = dissipation
        # None where there are none, so that nothing else has to ask.
        self.elements = (elements if isinstance(elements, Elements) else Elements(elements)) if elements else None
        self.forward_dynamics = forward_dynamics
        self.states = dict(sorted({**states, **_held(self.elements or {}, states)}.items()))

    def map(self, change: Callable[[Callable, str], Callable]) -> "System":
        """The system with `change(function, role)` in place of each of its functions, unchecked.

        Roles: "lagrangian", "force", "dissipation", "forward_dynamics", `rate_of` a state, and those of constraints,
        "g" and "phi".
        """

        def change_if(function: Callable | None, role: str) -> Any:
            return None if function is None else change(function, role)

        return unchecked(
            change(self.lagrangian, "lagrangian"),
            {name: type(c)(change(c.function, c.role)) for name, c in self.constraints.items()},
            change_if(self.force, "force"),
            change_if(self.dissipation, "dissipation"),
            {name: change(f, rate_of(name)) for name, f in self.states.items()},
            self.elements,
            change_if(self.forward_dynamics, "forward_dynamics"),
        )

    in_phases: ClassVar[bool] = False

    @property
    def phases(self) -> "tuple[System, ...]":
        """The system itself: the only phase of its motions. A `Hybrid` has several."""
        return (self,)

    @property
    def first_phase(self) -> "System":
        """The system itself, without its elements."""
        return self if self.elements is None else replace(self, elements=None)

    def starting(self, start, argument: str = "start") -> "System":
        """The system itself; raise if `start` names a phase."""
        if start is not None and self.elements is not None:
            raise ValueError(
                f"{argument}= names the first phase of a lj.Hybrid; the modes in which a motion with elements starts "
                "follow from q0 and v0.\n"
                "Usual cause: a contact that should be closed, or slide, from the start on.\n"
                "Fix: leave it out; a gap of zero in q0 is closed, and a sliding velocity in v0 slides to its side."
            )
        if start is not None:
            raise ValueError(
                f"{argument}= names the first phase of a lj.Hybrid, and this is one lj.System.\nFix: leave it out."
            )
        return self

    @property
    def is_forced(self) -> bool:
        """Whether the motion is that of more than L and the constraints."""
        return self.force is not None or self.dissipation is not None or bool(self.states)

    @property
    def is_holonomic(self) -> bool:
        """Whether no constraint restricts velocities alone."""
        return all(c.of_positions for c in self.constraints.values())

    def functions(self) -> dict[str, Callable | None]:
        """The user's functions by role."""
        of_constraints = {f"{c.role} of constraint '{name}'": c.function for name, c in self.constraints.items()}
        others = {
            "the force": self.force, "the dissipation": self.dissipation, "the forward dynamics": self.forward_dynamics,
        }  # fmt: skip
        of_states = {f"the {rate_of(name)}": f for name, f in self.states.items()}
        return {"the Lagrangian": self.lagrangian, **of_constraints, **others, **of_states}

    def __hash__(self):
        return hash(kinds(untraced(self)))

    def __eq__(self, other):
        # A trajectory has its system as it was traced.
        return isinstance(other, System) and same(untraced(self), untraced(other))

    def __reduce_ex__(self, protocol: int):
        check_functions(self.functions())
        return super().__reduce_ex__(protocol)

    def __repr__(self):
        parts = [_name(self.lagrangian)]
        if self.constraints:
            parts.append("constraints: " + ", ".join(f"{k} ({c.kind})" for k, c in self.constraints.items()))
        if self.force is not None:
            parts.append(f"force: {_name(self.force)}")
        if self.dissipation is not None:
            parts.append(f"dissipation: {_name(self.dissipation)}")
        states = [name for name, rate in self.states.items() if not isinstance(rate, Held)]
        if states:
            parts.append("states: " + ", ".join(states))
        if self.elements is not None:
            parts.append("elements: " + ", ".join(f"{k} ({type(x).__name__})" for k, x in self.elements.items()))
        return by_line(f"System({'; '.join(parts)})")


def _held(elements: Mapping, states: Mapping) -> dict[str, Held]:
    """The outputs of sampled controls, as states that are constant."""
    found = {name: Held(name) for name, element in elements.items() if isinstance(element, SampledControl)}
    for name in found:
        # A copy of a system has its held outputs already.
        if not isinstance(states.get(name, found[name]), Held):
            raise ValueError(
                f"'{name}' is the name of a state and of a lj.SampledControl, whose output is a state of its name.\n"
                "Fix: another name for one of them; the controller reads both from q."
            )
    return found


def rate_of(state: str) -> str:
    """The role of the function that is the rate of a state."""
    return f"rate of state '{state}'"


def untraced(tree: PyTree):
    """A system with the user's functions in place of their jaxprs."""

    def traced(x: Any) -> bool:
        return isinstance(x, Traced)

    return jax.tree.map(lambda x: x.function if traced(x) else x, tree, is_leaf=traced)


def unchecked(
    lagrangian: Callable,
    constraints: dict,
    force: Callable | None,
    dissipation,
    states: dict,
    elements: Elements | None = None,
    forward_dynamics: Callable | None = None,
) -> System:
    """A system of these functions, which have been checked: to make a module the usual way takes long."""
    given = lagrangian, constraints, force, dissipation, states, elements, forward_dynamics
    return without_init(System, dict(zip(FIELDS, given)))


def _name(function: Callable):
    return getattr(function, "__name__", type(function).__name__)
