"""A hybrid system: phases of a motion, each with constraints and forces of its own, and the switches between them.

A ball flies until it touches; a hoop rolls until friction gives way, slips until it leaves, and falls. In each phase
the motion is that of a `System` over the same coordinates. A phase lasts until one of its guards, a function of the
state and of the phase's own multipliers, crosses zero from above; velocities, or the whole state, may then jump.

Source: Brogliato, *Nonsmooth Mechanics*, §1.3; Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*,
§2.8 (event-driven schemes).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Int, PyTree

from lagjax.display import by_line
from lagjax.jaxtools import kinds, same, without_init
from lagjax.system.constraints import Elements
from lagjax.system.coordinates import State
from lagjax.system.system import System, check_functions
from lagjax.system.traced import takes_of

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
        for role, name in (("phase", phase), ("to", to), ("rest", rest)):
            if not isinstance(name, str) and not (role == "rest" and name is None):
                raise TypeError(
                    f"{role} must be the name of a phase, not {type(name).__name__}.\n"
                    'Fix: lj.Switch("flying", to="rolling", when=...).'
                )
        for role, function in (("when", when), ("reset", reset)):
            if not callable(function) and not (role == "reset" and function is None):
                raise TypeError(
                    f"{role} of the switch from '{phase}' to '{to}' must be a function of (t, q, v, params), not "
                    f"{type(function).__name__}.\nFix: {role}=lambda t, q, v, params: ..."
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
        if not isinstance(phases, Mapping) or not phases:
            raise TypeError(
                f"phases must be given by name, not as {type(phases).__name__}.\n"
                'Fix: lj.Hybrid(phases={"flying": system}, switches=[...]).'
            )
        for name, system in phases.items():
            if not isinstance(system, System):
                raise TypeError(f"phase '{name}' is {type(system).__name__}.\nFix: \"{name}\": lj.System(lagrangian).")
        if not (isinstance(most_switches, int) and most_switches > 0):
            raise ValueError(f"most_switches must be a whole number above zero, not {most_switches!r}.\nFix: 100.")
        if isinstance(switches, Switch) or not isinstance(switches, Sequence):
            raise TypeError("switches must be a list of them.\nFix: switches=[lj.Switch(...)].")
        listed = [each for item in switches for each in ([item] if isinstance(item, Switch) else item)]
        for switch in listed:
            if not isinstance(switch, Switch):
                raise TypeError(
                    f"a switch must be a lj.Switch, not a {type(switch).__name__}.\n"
                    'Fix: lj.Switch("flying", to="rolling", when=lambda t, q, v, params: ...).'
                )
            if switch.phase == switch.to and switch.reset is None:
                raise ValueError(
                    f"the switch {switch.in_words()} leads back to its phase and resets nothing: its guard is still "
                    "below zero there.\nFix: reset=, or another phase; to record where something happens, lj.Crossing."
                )
            for name in (switch.phase, switch.to, switch.rest):
                if name is not None and name not in phases:
                    raise ValueError(
                        f"the switch {switch.in_words()} names a phase '{name}', which does not exist.\n"
                        f"The phases are {', '.join(map(repr, phases))}."
                    )
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
        if start not in self.names:
            raise ValueError(
                f"{argument}={start!r} is not a phase.\nThe phases are {', '.join(map(repr, self.names))}; motions "
                "start in the first one by default."
            )
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
