"""Mechanical systems: a Lagrangian, constraints, forces without a potential; and hybrid ones, of phases with switches.

Functions are checked: whether they can be pickled is explained before pickle fails with its own message. Pickle writes
down where a function is found, its module and name, not what it does. A lambda has no name, and a function inside
another one cannot be reached by its name.

A hybrid system has phases: a ball flies until it touches; a hoop rolls until friction gives way, slips until it leaves,
and falls. In each phase the motion is that of a `System` over the same coordinates. A phase lasts until one of its
guards, a function of the state and of the phase's own multipliers, crosses zero from above; velocities, or the whole
state, may then jump.

Source: Brogliato, *Nonsmooth Mechanics*, §1.3; Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*,
§2.8 (event-driven schemes).
"""

import copy
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import FrameType, FunctionType
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Int, PyTree

from lagjax.display import by_line
from lagjax.jaxtools import kinds, same, without_init
from lagjax.refusals import must, must_be, must_be_function, must_be_whole, must_name
from lagjax.system.constraints import Element, Elements, Held, Holonomic, Nonholonomic, SampledControl
from lagjax.system.coordinates import State
from lagjax.system.traced import OF_STATE, WITH_FORCE, Traced, takes_of

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
            fix = f"pass the function itself, {role}=f, not its value f(...)"
            must_be_function(function, role, f"({takes})", fix, optional=True)
        if constraints is not None and not isinstance(constraints, Mapping):
            raise TypeError(
                f"constraints must be given by name, not as {type(constraints).__name__}.\n"
                + ("Usual cause: kinetic and potential energy given separately.\n" if callable(constraints) else "")
                + 'Fix: constraints={"rod": lj.Holonomic(g)}'
                + ("; L is one function, return kinetic - potential." if callable(constraints) else ".")
            )
        for name, constraint in (constraints or {}).items():
            must_be(str, name, "the name of a constraint must be text", '"rod": lj.Holonomic(g)')
            if isinstance(constraint, float | int):
                raise TypeError(
                    f"constraint '{name}' is a number.\n"
                    "Usual cause: params in the place of constraints.\n"
                    "Fix: lj.System(lagrangian); each call takes them, lj.integrate(system, q0, v0, params, ts=ts)."
                )
            fix = f'"{name}": lj.Holonomic(g), g(t, q, params) = 0, or lj.Nonholonomic(phi), phi(t, q, v, params) = 0'
            must_be(Holonomic | Nonholonomic, constraint, f"constraint '{name}' must have a kind", fix)
        states = {} if states is None else states
        by_name = isinstance(states, Mapping) and all(isinstance(name, str) for name in states)
        well = by_name and all(map(callable, states.values()))
        cause = "a start value in the place of the function that is its rate"
        fix = 'states={"z": lambda t, q, v, params: ...}; its start value is q0["z"]'
        must(well, "states must be functions by name", states, fix, cause, TypeError)
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


MOST_SWITCHES = 16


class Switch(eqx.Module):
    """One way out of a phase: where a guard crosses zero from above, the motion goes on in another phase.

    >>> import lagjax as lj
    >>> Switch("flying", to="flying", when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -v)
    Switch('flying' -> 'flying', with a reset)

    **Arguments:**

    - `phase`: the name of the phase that it ends; `to`: the name of the next phase, which may be the same.
    - `when`: the guard, `when(t, q, v, params)`, or `when(t, q, v, multipliers, params)` with the phase's own
      multipliers by constraint name; a number of any unit, above zero as long as the phase lasts. Values that it
      closes over are differentiated too.
    - `reset`: the jump, or None: `reset(t, q, v, params)` -> velocities like `v`, or a pair (q, v) for the whole state;
      it may take multipliers, as `when`. Guards such as `lj.guards.touches` have a reset of their own.

    - `rest`: the name of the phase to enter instead of `to` where the guard, after the reset, opens more slowly than
      `slower_than` per unit of time: this ends infinitely many impacts in finite time. The velocities become the
      nearest ones that the constraints of that phase allow. The part of the motion left out is of the size of
      `slower_than` squared.

    **Raises:** `TypeError` for an argument of the wrong type.

    A guard that is at zero where its phase begins and goes up, as after an impact, is not crossed there; one that goes
    down, or is below zero after another switch, ends the phase at once. At the start of a motion such a guard is
    refused.
    """

    phase: str = eqx.field(static=True)
    to: str = eqx.field(static=True)
    when: Callable
    reset: Callable | None
    rest: str | None = eqx.field(static=True)
    slower_than: Array | np.ndarray

    def __init__(
        self,
        phase: str,
        *,
        to: str,
        when: Callable,
        reset: Callable | None = None,
        rest: str | None = None,
        slower_than: ArrayLike = 1e-6,
    ):
        fix = 'lj.Switch("flying", to="rolling", when=...)'
        for role, name in (("phase", phase), ("to", to)):
            must_be(str, name, f"{role} must be the name of a phase", fix)
        must_be(str | None, rest, "rest must be the name of a phase", fix)
        where = f"of the switch from '{phase}' to '{to}'"
        must_be_function(when, f"when {where}", "(t, q, v, params)", "when=lambda t, q, v, params: ...")
        must_be_function(
            reset, f"reset {where}", "(t, q, v, params)", "reset=lambda t, q, v, params: ...", optional=True
        )
        self.phase, self.to, self.when, self.rest = phase, to, when, rest
        self.slower_than = slower_than if isinstance(slower_than, jax.Array) else np.asarray(slower_than, float)
        # A guard such as `lj.guards.touches` has its impact as `reset`.
        self.reset = getattr(when, "reset", None) if reset is None else reset

    def __repr__(self):
        return f"Switch({self.in_words()})"

    def __hash__(self):
        return hash(kinds(self))

    def __eq__(self, other):
        return isinstance(other, Switch) and same(self, other)

    def __reduce_ex__(self, protocol: int):
        functions = {"when": self.when, "reset": self.reset}
        check_functions({f"{role} of the switch {self.in_words()}": f for role, f in functions.items()})
        return super().__reduce_ex__(protocol)

    def with_functions(self, when: Callable, reset: Callable | None) -> "Switch":
        """The same switch with other functions, unchecked."""
        return without_init(Switch, vars(self) | {"when": when, "reset": reset})

    def value(self, t: Array, q: PyTree, v: PyTree, multipliers: Array, params: PyTree):
        """The value of the guard at one state."""
        given = {"t": t, "q": q, "v": v, "multipliers": multipliers, "params": params}
        return self.when(*(given[name] for name in takes_of(self.when)))

    def in_words(self) -> str:
        """The switch in words: from which phase to which."""
        return f"'{self.phase}' -> '{self.to}'" + (", with a reset" if self.reset is not None else "")


class Hybrid(eqx.Module):
    """A motion in phases, with switches between them; `lj.integrate` takes it like a `System`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> floor = Switch("flying", to="flying", when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -0.5 * v)
    >>> bouncing = Hybrid({"flying": ball}, [floor], most_switches=4)
    >>> bouncing
    Hybrid: 1 phase, 1 switch, at most 4 in a motion
      flying -> flying  (resets the state)
    >>> traj = lj.integrate(bouncing, 5.0, 0.0, {"g": 10.0}, ts=jnp.array([0.0, 0.5, 1.5]))
    >>> print(f"{traj.q[-1]:.6f} {traj.switches.t[0]:.6f}")
    1.250000 1.000000

    **Arguments:**

    - `phases`: by name, `System`s over the same coordinates, with or without elements. A constraint of the same name in
      several phases has the same shape in all; so has an element, and each phase has its own. Motions start in the
      first one, or with `lj.integrate(..., start=name)`; `start` may be the phase's number, which can differ from lane
      to lane.
    - `switches`: `Switch`es, or lists of them. Where two guards cross at the same time, the one listed first takes
      effect; the other one does so at once in the next phase, if it belongs to that phase.
    - `most_switches`: the largest number of switches in a motion; memory is reserved for so many.

    **Raises:** `TypeError` for a phase that is not a `System` or a switch that is not a `Switch`; `ValueError` for a
    name that no phase has.
    """

    systems: tuple[System, ...]
    switches: tuple[Switch, ...]
    # The number of the phase in which motions start.
    first: Int[Array, ""] | np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    most_switches: int = eqx.field(static=True)

    def __init__(
        self,
        phases: Mapping[str, System],
        switches: Sequence[Switch | Sequence[Switch]] = (),
        most_switches: int = MOST_SWITCHES,
    ):
        example = 'lj.Hybrid(phases={"flying": system}, switches=[...])'
        must(isinstance(phases, Mapping) and phases, "phases must be given by name", phases, example, error=TypeError)
        for name, system in phases.items():
            must_be(System, system, f"phase '{name}' must be a lj.System", f'"{name}": lj.System(lagrangian)')
        must_be_whole(most_switches, "most_switches", fix="100")
        if isinstance(switches, Switch) or not isinstance(switches, Sequence):
            raise TypeError("switches must be a list of them.\nFix: switches=[lj.Switch(...)].")
        listed = [each for item in switches for each in ([item] if isinstance(item, Switch) else item)]
        for switch in listed:
            fix = 'lj.Switch("flying", to="rolling", when=lambda t, q, v, params: ...)'
            must_be(Switch, switch, "a switch must be a lj.Switch", fix)
            if switch.phase == switch.to and switch.reset is None:
                raise ValueError(
                    f"the switch {switch.in_words()} leads back to its phase and resets nothing: its guard is still "
                    "below zero there.\nFix: reset=, or another phase; to record where something happens, lj.Crossing."
                )
            named = [name for name in (switch.phase, switch.to, switch.rest) if name is not None]
            must_name(named, phases, f"the switch {switch.in_words()} names", "phase")
        self.systems, self.names = tuple(phases.values()), tuple(phases)
        self.switches, self.most_switches = tuple(listed), most_switches
        self.first = np.zeros((), np.int32)

    in_phases: ClassVar[bool] = True

    @property
    def phases(self) -> tuple[System, ...]:
        """The systems of all phases."""
        return self.systems

    @property
    def elements(self) -> Elements | None:
        """The elements of all phases; None without any."""
        found = [system.elements for system in self.systems if system.elements is not None]
        return Elements(dict(item for elements in found for item in elements.items())) if found else None

    @property
    def modes(self) -> list[tuple[str, str]]:
        """The name and the kind of each mode of elements."""
        return []

    def given(self, params: PyTree, modes: Array | None = None, phase: int = 0) -> PyTree:
        """What the functions of a phase take as `params`; `modes`: those of elements, of which there are none."""
        return params

    def cases(self, params: PyTree, phase: int = 0) -> dict[str, PyTree]:
        """The parameters in as many cases, by what is said of them, as it takes to see what every function returns."""
        return {"": params}

    def laws_in_numbers(self, state: State) -> dict[str, np.ndarray]:
        """What tells the laws of elements from others, by role, beside the functions of the phases."""
        return {}

    @property
    def first_phase(self) -> System:
        """The system of the phase in which motions start. Not while JAX is tracing."""
        return self.systems[int(self.first)].first_phase

    def starting(self, start: str | ArrayLike | None, argument: str = "start") -> "Hybrid":
        """The same hybrid with motions that start in this phase, a name or a number; None keeps the present one.

        A number may be traced: one that no phase has is then a failure of the motion.
        """
        if start is None:
            return self
        if not isinstance(start, str):
            return replace_fields(self, first=self._number(start, argument))
        fix = f"{argument}='{{}}'; motions start in the first one by default"
        must_name(start, self.names, f"{argument} names", "phase", fix)
        return replace_fields(self, first=np.asarray(self.names.index(start), np.int32))

    def _number(self, start, argument: str):
        whole = hasattr(start, "dtype") and np.issubdtype(start.dtype, np.integer) or isinstance(start, int)
        if isinstance(start, bool) or not whole or np.ndim(start):
            shape = f" of shape {np.shape(start)}" if np.ndim(start) else ""
            raise ValueError(
                f"{argument} must be the name of a phase, or its number, a whole one, not "
                f"{type(start).__name__}{shape}."
                f'\nFix: {argument}="flying"; or lanes that start in different phases, '
                "jax.vmap(lambda q, start: lj.integrate(..., start=start))(q, jnp.array([0, 1]))."
            )
        if isinstance(start, Tracer):
            return start.astype(np.int32)
        if not 0 <= int(start) < len(self.names):
            raise ValueError(
                f"{argument}={int(start)} is not the number of a phase.\nThe phases are "
                f"{', '.join(f'{i}: {name!r}' for i, name in enumerate(self.names))}."
            )
        return np.asarray(start, np.int32)

    def __hash__(self):
        return hash(kinds(self))

    def __eq__(self, other):
        return isinstance(other, Hybrid) and same(self, other)

    def leaving(self, phase: int) -> list[int]:
        """The numbers of the switches that end a phase."""
        return [i for i, switch in enumerate(self.switches) if switch.phase == self.names[phase]]

    @property
    def targets(self) -> np.ndarray:
        """For each switch the numbers of the next phase and of the phase of rest (the next one if it has none)."""

        def number(name: str | None, other: str) -> int:
            return self.names.index(other if name is None else name)

        return np.array([[number(s.to, s.to), number(s.rest, s.to)] for s in self.switches], np.int32)

    def __repr__(self):
        counts = _count(len(self.names), "phase", "s"), _count(len(self.switches), "switch", "es")
        width = max(map(len, self.names))
        rows = [
            f"  {switch.phase:<{width}} -> {switch.to}"
            + ("  (resets the state)" if switch.reset is not None else "")
            + (f", or {switch.rest} where it comes to rest" if switch.rest is not None else "")
            for switch in self.switches
        ]
        return by_line("\n".join([f"Hybrid: {', '.join(counts)}, at most {self.most_switches} in a motion", *rows]))


def _count(n: int, word: str, plural: str):
    return f"{n} {word}" if n == 1 else f"{n} {word}{plural}"


def replace_fields(hybrid: Hybrid, **fields) -> Hybrid:
    """Replace some fields of a hybrid without checking them again."""
    return without_init(type(hybrid), vars(hybrid) | fields)
