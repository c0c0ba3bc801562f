"""The parts of a solve that a hybrid system defines: phases, their guards, and the resets of the state by switches."""

from collections.abc import Callable, Hashable, Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike

from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.arguments import OF_STATE, takes_of
from lagjax.mechanics.closures import lift_function
from lagjax.mechanics.constraints import zero_multipliers
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.hybrid import Hybrid, Switch, replace_fields
from lagjax.mechanics.in_words import Call, check_arguments, in_words
from lagjax.mechanics.memory import shape_of
from lagjax.mechanics.outside import first_guard_alike, read_by
from lagjax.mechanics.system import System
from lagjax.motion.backward import runs_backward
from lagjax.motion.consistency import velocity_change
from lagjax.motion.crossings import Crossing, Guards, guards_of, left_to_diffrax
from lagjax.motion.hybrid_trajectory import SWITCHES
from lagjax.motion.legs import Phase


class Reset(eqx.Module):
    """The effect of a switch: (t, q, v, multipliers, params) -> (q, v), and whether the motion comes to rest there.

    `function` gives velocities, or the whole state; without one the state is kept. If `settle` is given and the guard
    `when` opens at no more than `slower_than` after the reset, the motion comes to rest, with the velocities of
    `settle`. `read`: the values that the function reads from outside, which tell it from another of the same code.
    """

    function: Callable | None
    takes: tuple[str, ...] = eqx.field(static=True)
    read: Hashable = eqx.field(static=True, default=())
    settle: Callable | None = None
    when: Callable | None = None
    slower_than: Array | np.ndarray | None = None

    def __call__(self, t, q, v, multipliers, params):
        q, v = self._reset(t, q, v, multipliers, params)
        if self.settle is None:
            return q, v, jnp.asarray(False)
        assert self.when is not None
        value = lambda t, q, when=self.when: when(t, q, v, params)
        _, opening = jax.jvp(value, (t, q), (jnp.ones_like(t), v))
        rests = opening <= self.slower_than
        at_rest = self.settle(t, q, v, params)
        return q, jtu.tree_map(lambda x, y: jnp.where(rests, x, y), at_rest, v), rests

    def _reset(self, t, q, v, multipliers, params):
        if self.function is None:
            return q, v
        given = {"t": t, "q": q, "v": v, "multipliers": multipliers, "params": params}
        found = self.function(*(given[name] for name in self.takes))
        found = (q, found) if _alike(found, v) else found
        return jtu.tree_map(lambda new, old: new + 0 * old, found, (q, v))


def each_phase(system: System | Hybrid, function: Callable[[System], System]) -> Any:
    """Apply `function` to the system, or to the system of each phase."""
    if isinstance(system, Hybrid):
        return replace_fields(system, systems=tuple(map(function, system.systems)))
    return function(system)


def check_phases(hybrid: Hybrid, start: State):
    """Raise if constraints of the same name have different shapes in two phases."""
    first: dict[str, tuple[tuple, str]] = {}
    for name, system in zip(hybrid.names, hybrid.systems):
        for constraint, shape in constraints.shapes(system, *start).items():
            other, phase = first.setdefault(constraint, (shape, name))
            if other != shape:
                raise ValueError(
                    f"constraint '{constraint}' has shape {other} in phase '{phase}', but {shape} in '{name}'.\n"
                    "Fix: give one of them another name."
                )


def refuse_beside_switches(hybrid: Hybrid, start: State, ts, adjoint, event):
    """Raise if an argument has no meaning for a motion in phases."""
    check_phases(hybrid, start)
    if runs_backward(ts):
        raise ValueError(
            "a motion in phases runs forward only: what an impact has lost cannot be restored backward in time.\n"
            "Fix: times that increase."
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "BacksolveAdjoint does not go back through switches.\nFix: leave adjoint out (both modes work)."
        )
    if left_to_diffrax(event) is not None:
        raise ValueError(
            "a condition for diffrax, such as diffrax.steady_state_event(), cannot be used with a motion in phases.\n"
            "Fix: events= with a lj.Crossing."
        )


def phases_in(hybrid: Hybrid, start: State, events: Mapping[str, Crossing]) -> tuple[Phase, ...]:
    """The guards that end each phase, called once on shapes, and the recorded events; `start`: the first state."""
    for name, crossing in events.items():
        if takes_of(crossing.guard) != OF_STATE:
            raise ValueError(
                f"event '{name}' takes multipliers, which differ from phase to phase.\n"
                "Fix: lj.Switch(..., when=lj.releases(name)) if a contact lets go; or traj.multipliers at outputs."
            )
    if SWITCHES in events:
        raise ValueError(
            f"an event in events= is named '{SWITCHES}', the name of the switches in traj.events.\nFix: another name."
        )
    return tuple(_phase(hybrid, i, start, events) for i in range(len(hybrid.systems)))


def _phase(hybrid, i, start, events):
    numbers, system = hybrid.leaving(i), hybrid.systems[i]
    listed = [hybrid.switches[k] for k in numbers]
    names = {f"{switch.in_words()}, number {k}": switch for k, switch in zip(numbers, listed)}
    crossings = {name: Crossing(switch.when, direction=-1) for name, switch in names.items()}
    both = [guards_of(crossings, system, start, holds=True), guards_of(events, system, start)]
    given = [guards for guards in both if guards is not None]
    guards = Guards(*(sum((getattr(g, name) for g in given), ()) for name in ("functions", "kinds"))) if given else None
    read = hybrid.read or ((),) * len(hybrid.switches)
    resets = tuple(_reset(hybrid.switches[k], read[k], hybrid, system, start) for k in numbers)
    return Phase(guards, tuple(numbers), hybrid.targets[numbers], resets, tuple(events))


def _reset(switch: Switch, read: Hashable, hybrid, system, start) -> Reset:
    reset = _reset_alone(switch, read, hybrid, system, start)
    if switch.rest is None:
        return reset
    if takes_of(switch.when) != OF_STATE:
        raise ValueError(
            f"the switch {switch.in_words()} has rest=, and its guard takes multipliers: velocities do not tell how "
            "fast it opens.\nFix: rest= only with lj.touches(gap)."
        )
    settle = Plastic().between(system, hybrid.systems[hybrid.names.index(switch.rest)])
    return Reset(reset.function, reset.takes, read, settle, switch.when, switch.slower_than)


def _reset_alone(switch: Switch, read: Hashable, hybrid, system, start) -> Reset:
    function = switch.reset
    if function is None:
        return Reset(None, OF_STATE, read)
    if isinstance(function, OfPhases):
        function = function.between(system, hybrid.systems[hybrid.names.index(switch.to)])
    takes = takes_of(function)
    given: Mapping[str, Any] = start._asdict() | {"multipliers": zero_multipliers(system, start)}
    call = Call("reset", function, takes, f" of the switch {switch.in_words()}")
    check_arguments(call, "the arguments of a guard without the parameters")
    with in_words(call, given):
        found = shape_of(function, *(given[name] for name in takes))
    if not (_alike(found, start.v) or _alike(found, (start.q, start.v))):
        raise ValueError(
            f"{call} must return velocities like v, or a pair (q, v).\n"
            f"  v has shapes {jax.tree.map(jnp.shape, start.v)}\n"
            f"  it returned {jax.tree.map(jnp.shape, found)}\n"
            "Usual cause: only the velocity that jumps was returned.\n"
            'Fix: return v | {"y": -v["y"]}.'
        )
    return Reset(lift_function(function, tuple(given[name] for name in takes)), takes, read)


class OfPhases(eqx.Module):
    """A reset that depends on the systems before and after a switch."""

    def between(self, before: System, after: System) -> Callable:
        """Return `reset(t, q, v, params)` for a switch between these systems."""
        raise NotImplementedError


class Plastic(OfPhases):
    """The nearest velocities in the metric of M that the constraints of the next phase allow."""

    def between(self, before: System, after: System) -> Callable:
        """The reset onto the constraints of `after`."""
        return Nearest(after)


class Nearest(eqx.Module):
    """Velocities moved onto the constraints of a system: `reset(t, q, v, params)`."""

    system: System
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t, q, v, params):
        if not self.system.constraints:
            return v
        x, unflatten = coordinates.flatten(q)
        u, _ = coordinates.flatten(v)
        off = constraints.velocity_residual(self.system, t, x, u, params, unflatten)
        return jtu.tree_map(jnp.add, v, velocity_change(self.system, t, q, v, params, -off))


def _alike(found, wanted):
    same = jtu.tree_structure(found) == jtu.tree_structure(wanted)
    shapes = lambda tree: [jnp.shape(x) for x in jtu.tree_leaves(tree)]
    return same and shapes(found) == shapes(wanted)


def _with_first_alike(switch: Switch):
    """The switch with the first functions seen that mean the same as its own, and the values that these read."""
    functions = switch.when, switch.reset
    if not is_eager():
        return switch, tuple(map(read_by, functions))
    found, read = zip(*((None, ()) if function is None else first_guard_alike(function) for function in functions))
    if any(one is not other for one, other in zip(found, functions)):
        is_function = lambda x: any(x is function for function in functions)
        switch = eqx.tree_at(lambda s: (s.when, s.reset), switch, found, is_leaf=is_function)
    return switch, read


def starting(system, start: str | ArrayLike | None):
    """The system; a hybrid one starts in phase `start`, with the values that its switches read now."""
    if isinstance(system, Hybrid):
        switches, read = zip(*map(_with_first_alike, system.switches)) if system.switches else ((), ())
        return replace_fields(system.starting(start), switches=switches, read=read)
    if start is not None:
        raise ValueError("start= names the first phase of a lj.Hybrid, and this is one lj.System.\nFix: leave it out.")
    return system
