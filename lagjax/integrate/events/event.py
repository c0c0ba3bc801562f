"""Events: functions of the state that cross zero, and the record of each crossing.

A guard `g(t, q, v, params)` says where something happens: an apex (`v["y"]`), a floor (`q["y"]`), a section of phase
space, a contact that lets go (its multiplier). `detect.py` follows its sign along the motion.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.jaxtools import length, without_init
from lagjax.refusals import must, must_be, must_be_function, must_be_whole, must_differ, must_return
from lagjax.system import (
    OF_STATE,
    WITH_MULTIPLIERS,
    Call,
    State,
    System,
    Traced,
    check_functions,
    model_of,
    takes_of,
    traced_call,
)

# A guard of more operations is compiled once for all places where it is evaluated.
LONG = 100
DIRECTIONS = {None: 0, 0: 0, 1: 1, -1: -1}


class Crossing(eqx.Module):
    """An event: the motion crosses the surface where a guard is zero.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> stone = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    >>> floor = Crossing(lambda t, q, v, params: q, direction=-1)
    >>> apex = Crossing(lambda t, q, v, params: v, terminal=False)
    >>> ts = jnp.array([0.0, 10.0])
    >>> traj = lj.integrate(stone, 0.0, 5.0, ts=ts, events={"floor": floor, "apex": apex})
    >>> print(traj.end.t.round(9), traj.events["apex"].t[0].round(9), traj.events["apex"].q[0].round(9))
    1.0 0.5 1.25

    **Arguments:**

    - `guard`: `guard(t, q, v, params)` -> a number, of any unit, or true and false; or, if it takes five arguments,
      `guard(t, q, v, multipliers, params)`, with the multipliers by constraint name. What it closes over is
      differentiated too.
    - `direction`: 1 for crossings from below zero to above, -1 for those from above, 0 for both; along the run of the
      motion, even if that runs backward.
    - `terminal`: end the motion at the first one (`traj.end`, and NaN in the outputs after it).
    - `most`: how many crossings are kept; further ones are counted, with a warning. A terminal event keeps one.

    A start on the surface is not a crossing; leaving it and coming back is one.

    **Raises:** `TypeError`, `ValueError` for a guard that cannot be called like this, and for other directions.
    """

    guard: Callable
    direction: int = eqx.field(static=True)
    terminal: bool = eqx.field(static=True)
    most: int = eqx.field(static=True)

    def __init__(self, guard: Callable, direction: int | None = 0, terminal: bool = True, most: int = 32):
        must_be_function(guard, "a guard", "(t, q, v, params)", 'lj.Crossing(lambda t, q, v, params: q["y"])')
        # True is 1; what False means, diffrax and NumPy do not agree on.
        wanted = "direction must be 1 (from below), -1 (from above) or 0 (both)"
        well = direction in DIRECTIONS and direction is not False
        must(well, wanted, direction, "one of them, as direction=-1 for crossings from above")
        must_be_whole(most, "most", fix="most=1000")
        self.guard = guard
        self.direction = DIRECTIONS[direction]
        self.terminal = bool(terminal)
        self.most = 1 if terminal else most

    def with_guard(self, guard: Callable) -> "Crossing":
        """Return the same crossing with another guard, unchecked."""
        return without_init(Crossing, vars(self) | {"guard": guard})

    def __reduce_ex__(self, protocol):
        check_functions({"the guard of a crossing": self.guard})
        return super().__reduce_ex__(protocol)


class Crossings(eqx.Module):
    """The crossings of one guard in a motion, in order of time; it prints itself.

    - `t` (K,): their times, `[t]`; NaN beyond the last one. K is `most` of the `Crossing`.
    - `q`, `v`: the states there, each leaf with a leading axis K; `multipliers` by constraint name, likewise.
    - `count`: how many there were, including those that were not kept.
    - `uncertain`: whether some may be missing: the guard touched zero within round-off, or changed too fast between
      steps to be followed.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, " K"]
    q: PyTree[Float[Array, "K ..."]]
    v: PyTree[Float[Array, "K ..."]]
    multipliers: dict[str, Array]
    count: Int[Array, ""]
    uncertain: Bool[Array, ""]

    def with_states(self, q: PyTree, v: PyTree) -> "Crossings":
        """Return the same with q and v in another structure."""
        return Crossings(self.t, q, v, self.multipliers, self.count, self.uncertain)

    def none_where(self, condition: Callable) -> "Crossings":
        """Return the same without any crossing where `condition` holds."""
        rows = self.t, self.q, self.v, self.multipliers
        rows = jax.tree.map(lambda x: jnp.where(condition, jnp.nan, x), rows)
        return Crossings(*rows, jnp.where(condition, 0, self.count), self.uncertain)

    def found(self) -> "Crossings":
        """Return the same without the unused places, in NumPy. Not while JAX is tracing."""
        kept = np.isfinite(np.asarray(self.t))
        of_rows = (self.t, self.q, self.v, self.multipliers)
        return Crossings(*jax.tree.map(lambda x: np.asarray(x)[kept], of_rows), self.count, self.uncertain)

    def __repr__(self):
        if not eqx.is_array(self.t) and not isinstance(self.t, np.ndarray) or isinstance(self.t, Tracer):
            return "Crossings, being traced"
        if np.ndim(self.count):
            low, high = int(np.min(self.count)), int(np.max(self.count))
            return f"Crossings of {np.size(self.count)} lanes, {low} to {high} each"
        return f"Crossings: {self.in_words()}"

    def in_words(self) -> str:
        """Return the number of crossings and the first of their times, on one line."""
        times = np.asarray(self.t)[np.isfinite(np.asarray(self.t))]
        shown = ", ".join(f"{t:.9g}" for t in times[:4]) + (", ..." if len(times) > 4 else "")
        count = int(self.count)
        kept = f", of which the first {len(times)} are kept" if count > len(times) else ""
        doubt = "; some may be missing" if bool(self.uncertain) else ""
        return f"{count}{kept}{f', at t = {shown}' if shown else ''}{doubt}"


class EventKind(NamedTuple):
    """The static properties of a guard: see `Crossing`. `long`: it takes long to compile.

    `holds`: it is assumed to be above zero at the start; if it is not, it counts as crossed there. `may_rest`: it may
    be zero for a while, which is not in doubt.
    """

    name: str
    direction: int
    terminal: bool
    most: int
    takes_multipliers: bool
    long: bool
    holds: bool
    may_rest: bool = False


class Guards(eqx.Module):
    """All guards of a motion as one function that returns a number for each."""

    functions: tuple[Callable, ...]
    kinds: tuple[EventKind, ...] = eqx.field(static=True)
    # For states that are tuples of numbers: puts q, or v, back into the user's structure.
    together: Callable | None = eqx.field(static=True, default=None)

    @property
    def take_multipliers(self) -> bool:
        return any(kind.takes_multipliers for kind in self.kinds)

    @property
    def long(self) -> bool:
        return any(kind.long for kind in self.kinds)

    @property
    def terminal(self) -> np.ndarray:
        return np.array([kind.terminal for kind in self.kinds])

    @property
    def direction(self) -> np.ndarray:
        return np.array([kind.direction for kind in self.kinds])

    @property
    def owners(self) -> np.ndarray:
        """The index of the guard for each place where a crossing is kept."""
        return np.repeat(np.arange(len(self.kinds)), [kind.most for kind in self.kinds])

    @property
    def ranks(self) -> np.ndarray:
        """For each of these places, which of its guard's crossings is kept there, counted from zero."""
        return np.concatenate([np.arange(kind.most) for kind in self.kinds])

    def in_numbers(self, tree: Callable) -> "Guards":
        """Return the same for states that are tuples of numbers."""
        return Guards(self.functions, self.kinds, lambda numbers: tree(jnp.stack(numbers)))

    def __call__(
        self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree
    ) -> tuple[Float[Array, ""], ...]:
        """Return the value of each guard; true counts as one, false as minus one."""
        q, v = (q, v) if self.together is None else (self.together(q), self.together(v))
        more = [(multipliers, params) if kind.takes_multipliers else (params,) for kind in self.kinds]
        return tuple(_number(f(t, q, v, *rest), t) for f, rest in zip(self.functions, more))


class Condition(eqx.Module):
    """The condition of a `diffrax.Event` as a guard."""

    condition: Callable

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        return self.condition(t, (q, v), params)


def _number(value: Any, t: Array):
    value = jnp.asarray(value)
    value = jnp.where(value, 1.0, -1.0) if jnp.issubdtype(value.dtype, jnp.bool_) else value
    return value.astype(t.dtype)


def crossings_of(events: Any, event: Any) -> dict[str, Crossing]:
    """Return the crossings in `events` and those for the conditions of `event`, by name; raise for anything else."""
    example = 'events={"apex": lj.Crossing(lambda t, q, v, params: v["y"])}'
    must_be(Mapping | None, events, "events must be given by name", example)
    for name, crossing in (events or {}).items():
        must_be(Crossing, crossing, f"event '{name}' must be a lj.Crossing", example)
    found = dict(sorted((events or {}).items()))
    if event is None:
        return found
    must_be(diffrax.Event, event, "event must be a diffrax.Event", example, "its condition was passed instead")
    of_diffrax = {None: 0, True: 1, False: -1}
    conditions = jtu.tree_leaves_with_path(event.cond_fn, is_leaf=callable)
    directions = jtu.tree_leaves(event.direction, is_leaf=lambda x: x is None)
    for (path, condition), direction in zip(conditions, directions):
        if not asks_diffrax(condition):
            name = "event" + jtu.keystr(path)
            fix = "another name in events=, or both there, as lj.Crossing"
            must_differ([name, *found], "two events, one of them by lagjax as it is a diffrax.Event,", fix)
            found[name] = Crossing(Condition(condition), of_diffrax[direction])
    return found


def asks_diffrax(condition: Callable) -> bool:
    """Whether the condition of a `diffrax.Event` needs arguments that only diffrax has (`steady_state_event`)."""
    parameters = inspect.signature(condition).parameters.values()
    return any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in parameters)


def left_to_diffrax(event: diffrax.Event | None) -> diffrax.Event | None:
    """Return the event of the conditions that only diffrax can evaluate, at ends of steps; None if there are none."""
    if event is None:
        return None
    asking = [condition for condition in jtu.tree_leaves(event.cond_fn, is_leaf=callable) if asks_diffrax(condition)]
    return diffrax.Event(asking) if asking else None


def guards_of(
    crossings: Mapping[str, Crossing], system: System, start: State, holds: bool = False, given: Any = None
) -> Guards:
    """Return the guards of one or more crossings, called once on shapes. `start`: the first state; `given`: what the
    functions of the system take as `params`, where guards take less."""
    functions, of_guards = [], []
    model = model_of(system, *start[:3], start.params if given is None else given)
    arguments = dict(zip(OF_STATE, start)) | {"multipliers": model.zero_multipliers()}
    for name, crossing in crossings.items():
        guard = traced_guard(name, crossing.guard, arguments)
        takes_multipliers = guard.takes == WITH_MULTIPLIERS
        # Multipliers require the equations, which take long to compile.
        long = takes_multipliers or length(guard.program.jaxpr) > LONG
        functions.append(guard)
        of_crossing = crossing.direction, crossing.terminal, crossing.most
        of_guards.append(EventKind(name, *of_crossing, takes_multipliers, long, holds))
    return Guards(tuple(functions), tuple(of_guards))


def traced_guard(name: str, guard: Callable, given: Mapping[str, Any]) -> Traced:
    """A guard checked and traced at a given state; raises if it is no guard."""
    call = Call("guard", guard, takes_of(guard), f" of event '{name}'")
    return traced_call(call, given, _check, "the arguments of a condition of diffrax, (t, y, args)")


def _check(call: Call, value: Any):
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", np.dtype(type(value)))
    well = jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.bool_)
    cause = "a whole vector, or a function without return"
    fix = "return one coordinate of it; several coordinates need an event each"
    must_return(shape == () and well, call, "one real number, or true or false", value, fix, cause)


class EventWarning(UserWarning):
    """Crossings of a guard may be missing, or were not kept."""
