"""Phases of a solve, their guards, and the resets of the state by switches; and time that runs backward.

A motion that runs backward in time is that of the reflected system, which runs forward.

With τ = -t and w = dq/dτ = -v the action of L(t, q, v) is that of L(-τ, q, -w), and Lagrange's equations keep their
form, with the same accelerations and multipliers, for

    L'(τ, q, w) = L(-τ, q, -w)        Q'(τ, q, w) = Q(-τ, q, -w)        R'(τ, q, w) = -R(-τ, q, -w)
    g'(τ, q)    = g(-τ, q)          phi'(τ, q, w) = -phi(-τ, q, -w)

(R and phi change their sign so that ∂R'/∂w = ∂R/∂v and ∂phi'/∂w = ∂phi/∂v.) The code that steps, projects and locates
events then only needs one direction of time, and forward motions cost nothing extra. Times and velocities are reflected
on the way in and on the way out, both exactly.

The direction is part of the program: it has to be known when the program is traced. A sign as an argument would slow
down every motion whose times pass through `jit` (a pendulum of mass 1 takes 1.25 times as long with a mass that is the
square of a sign).

Source: Lamb & Roberts, Physica D 112 (1998) 1, §2 (reversing symmetries).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.integrate.elements import InElements, OneGuard, assembled
from lagjax.integrate.events.event import Crossing, EventKind, Guards, guards_of, left_to_diffrax, traced_guard
from lagjax.integrate.jumps import OfParams
from lagjax.integrate.meeting import Meeting
from lagjax.integrate.problem import Problem
from lagjax.integrate.results import Snapshot, pack
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.programs import trajectory_of
from lagjax.integrate.solve.segments import Phase
from lagjax.integrate.trajectory import SWITCHES, Trajectory
from lagjax.mechanics import velocity_change
from lagjax.numerics import EqualSteps
from lagjax.refusals import must_differ
from lagjax.system import (
    OF_STATE,
    Call,
    Hybrid,
    State,
    Switch,
    System,
    constraints,
    is_traced,
    model_of,
    replace_fields,
    takes_of,
    traced_call,
    traced_system,
)

# The guard of all modes of the elements of a phase.
MODES = EventKind("modes", -1, terminal=True, most=1, takes_multipliers=True, long=True, holds=True)


class Reset(eqx.Module):
    """The effect of a switch: (t, q, v, multipliers, params) -> (q, v), and whether the motion comes to rest there.

    `function` gives velocities, or the whole state; without one the state is kept. If `settle` is given and the guard
    `when` opens at no more than `slower_than` after the reset, the motion comes to rest, with the velocities of
    `settle`.
    """

    function: Callable | None
    takes: tuple[str, ...] = eqx.field(static=True)
    settle: Callable | None = None
    when: Callable | None = None
    slower_than: Array | np.ndarray | None = None

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree):
        q, v = self._reset(t, q, v, multipliers, params)
        if self.settle is None:
            return q, v, jnp.asarray(False)
        assert self.when is not None
        when = self.when
        _, opening = jax.jvp(lambda t, q: when(t, q, v, params), (t, q), (jnp.ones_like(t), v))
        rests = opening <= self.slower_than
        at_rest = self.settle(t, q, v, params)
        return q, jtu.tree_map(lambda x, y: jnp.where(rests, x, y), at_rest, v), rests

    def changes_positions(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree) -> bool:
        """Whether the whole state is reset, not the velocities alone; found on shapes."""
        if self.function is None:
            return False
        given = {"t": t, "q": q, "v": v, "multipliers": multipliers, "params": params}
        return not _alike(jax.eval_shape(self.function, *(given[name] for name in self.takes)), v)

    def _reset(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree):
        if self.function is None:
            return q, v
        given = {"t": t, "q": q, "v": v, "multipliers": multipliers, "params": params}
        found = self.function(*(given[name] for name in self.takes))
        found = (q, found) if _alike(found, v) else found
        return jtu.tree_map(lambda new, old: new + 0 * old, found, (q, v))


def traced_phases(system: System | Hybrid, start: State, ts: Array | np.ndarray | None = None) -> Any:
    """The system, or hybrid with its switches, with all its functions checked and traced for such states.

    `ts`: the times of the motion, so that there is room for the instants of sampled controls.
    """
    if isinstance(system, InElements):
        return traced_phases(system.user, start, ts)
    if not system.in_phases and system.elements is None:
        return traced_system(system, start)
    if system.elements is not None:
        hybrid: Any = assembled(system, start, ts)
    else:
        hybrid = replace_fields(system, systems=tuple(traced_system(phase, start) for phase in system.phases))
    return replace_fields(hybrid, switches=tuple(_traced_switch(hybrid, k, start) for k in range(len(hybrid.switches))))


def check_phases(hybrid: Hybrid, start: State):
    """Raise if constraints of the same name have different shapes in two phases."""
    first: dict[str, tuple[tuple, str]] = {}
    for name, model in zip(hybrid.names, model_of(hybrid, *start).phases):
        for constraint, shape, _ in model.form.residuals:
            other, phase = first.setdefault(constraint, (shape, name))
            if other != shape:
                raise ValueError(
                    f"constraint '{constraint}' has shape {other} in phase '{phase}', but {shape} in '{name}'.\n"
                    "Fix: give one of them another name."
                )


def refuse_beside_switches(hybrid: Hybrid, start: State, ts: Array, adjoint: Any, event: Any):
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
                "Fix: lj.Switch(..., when=lj.guards.releases(name)) if a contact lets go; or traj.multipliers at "
                "outputs."
            )
    must_differ([SWITCHES, *events], "an event in events= and the switches in traj.events", "another name")
    return tuple(_phase(hybrid, i, start, events) for i in range(len(hybrid.systems)))


def _phase(hybrid: Hybrid, i: int, start: State, events: Mapping[str, Crossing]):
    numbers, system = hybrid.leaving(i), hybrid.systems[i]
    laws = hybrid.laws[i] if isinstance(hybrid, InElements) else None
    names = {_name(hybrid, k): hybrid.switches[k] for k in numbers}
    crossings = {name: Crossing(switch.when, direction=-1) for name, switch in names.items()}
    parts = [guards_of(crossings, system, start, True, hybrid.given(start.params, phase=i))] if crossings else []
    if laws is not None and laws.guarded:
        parts.append(Guards((OneGuard(laws),), (MODES,)))
    if events:
        parts.append(guards_of(events, system if laws is None else system_alone(hybrid, i, start), start))
    functions = tuple(
        f if laws is None or isinstance(f, OneGuard) else OfParams(f) for part in parts for f in part.functions
    )
    guards = Guards(functions, tuple(kind for part in parts for kind in part.kinds)) if parts else None
    meeting = None if laws is None else Meeting(system, laws)
    places = hybrid.places[i] if isinstance(hybrid, InElements) else (0, 0)
    resets = tuple(_reset(hybrid.switches[k], hybrid, i, start) for k in numbers)
    return Phase(guards, tuple(numbers), hybrid.targets[numbers], resets, tuple(events), meeting, places)


def system_alone(hybrid: Hybrid, i: int, start: State) -> System:
    """The system of a phase without its elements, with its functions as programs."""
    if not isinstance(hybrid, InElements) or hybrid.laws[i] is None:
        return hybrid.systems[i]
    return traced_system(hybrid.user.phases[i].first_phase, start)


def _name(hybrid: Hybrid, k: int):
    return f"{hybrid.switches[k].in_words()}, number {k}"


def _reset(switch: Switch, hybrid: Hybrid, i: int, start: State) -> Reset:
    function, before = switch.reset, system_alone(hybrid, i, start)
    if isinstance(function, OfPhases):
        function = function.between(before, system_alone(hybrid, hybrid.names.index(switch.to), start))
    takes = OF_STATE if function is None else takes_of(function)
    if switch.rest is None:
        return Reset(function, takes)
    if takes_of(switch.when) != OF_STATE:
        raise ValueError(
            f"the switch {switch.in_words()} has rest=, and its guard takes multipliers: velocities do not tell how "
            "fast it opens.\nFix: rest= only with lj.guards.touches(gap)."
        )
    settle = Plastic().between(before, system_alone(hybrid, hybrid.names.index(switch.rest), start))
    return Reset(function, takes, settle, switch.when, switch.slower_than)


def _traced_switch(hybrid: Hybrid, k: int, start: State):
    switch = hybrid.switches[k]
    system = hybrid.systems[hybrid.names.index(switch.phase)]
    here = hybrid.given(start.params, phase=hybrid.names.index(switch.phase))
    multipliers = model_of(system, *start[:3], here).zero_multipliers()
    given: dict[str, Any] = start._asdict() | {"multipliers": multipliers, "speed": start.t}
    when, reset = traced_guard(_name(hybrid, k), switch.when, given), switch.reset
    of_switch = f" of the switch {switch.in_words()}"
    if isinstance(reset, OfPhases):
        reset = reset.mapped(lambda role, f, takes: traced_call(Call(role, f, takes, of_switch), given, _is_anything))
    elif reset is not None:
        call = Call("reset", reset, takes_of(reset), of_switch)
        reset = traced_call(
            call, given, partial(_check_reset, start=start), "the arguments of a guard without the parameters"
        )
    return switch.with_functions(when, reset)


def _is_anything(call: Call, value):
    """The parts of a contact are checked where they are used."""


def _check_reset(call: Call, found, start: State):
    if not (_alike(found, start.v) or _alike(found, (start.q, start.v))):
        raise ValueError(
            f"{call} must return velocities like v, or a pair (q, v).\n"
            f"  v has shapes {jax.tree.map(jnp.shape, start.v)}\n"
            f"  it returned {jax.tree.map(jnp.shape, found)}\n"
            "Usual cause: only the velocity that jumps was returned.\n"
            'Fix: return v | {"y": -v["y"]}.'
        )


class OfPhases(eqx.Module):
    """A reset that depends on the systems before and after a switch."""

    def mapped(self, on: Callable) -> "OfPhases":
        """The same with `on(role, function, takes)` in place of each function of the user's in it."""
        return self

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

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        model = model_of(self.system, t, q, v, params)
        if not model.m:
            return v
        off = constraints.velocity_residual(model, t, *model.vectors(q, v))
        return jtu.tree_map(jnp.add, v, velocity_change(model, t, q, v, -off))


def _alike(found, wanted: Sequence):
    same = jtu.tree_structure(found) == jtu.tree_structure(wanted)
    return same and jtu.tree_map(jnp.shape, found) == jtu.tree_map(jnp.shape, wanted)


class Reflected(eqx.Module):
    """A function of (t, q, v, ...), or of (t, q, ...), evaluated at the reflected time and velocities."""

    function: Callable
    of_velocities: bool = eqx.field(static=True, default=True)
    odd: bool = eqx.field(static=True, default=False)

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, t, q: PyTree, *rest):
        if self.of_velocities:
            v, *rest = rest
            rest = (_negative(v), *rest)
        value = self.function(-t, q, *rest)
        return _negative(value) if self.odd else value


class ReflectedCondition(eqx.Module):
    """The condition of a `diffrax.Event`, evaluated at the reflected time and velocities."""

    condition: Callable

    def __call__(self, t, y: PyTree, args: PyTree, **kwargs):
        q, v = y
        return self.condition(-t, (q, _negative(v)), args, **kwargs)


def run(problem: Problem) -> Trajectory:
    """The trajectory of a motion in either direction of time; a failure is recorded in its result."""
    return (backward_trajectory_of if runs_backward(problem.ts) else trajectory_of)(problem)


def backward_trajectory_of(problem: Problem) -> Trajectory:
    """What `trajectory_of` is for increasing times, for decreasing ones."""
    system, q0, v0, params, ts, guards, settings = problem
    if guards is not None:
        # Directions of crossings stay: they are meant along the run of the motion, as in SciPy.
        guards = replace(guards, functions=tuple(map(Reflected, guards.functions)))
    start = reflect_system(system), q0, _negative(v0), params
    reflected = trajectory_of(Problem(*start, -ts, guards, _reflect_settings(settings)))
    asked = reflected.asked._replace(stepsize_controller=settings.controller, jump_ts=settings.jump_ts)
    if isinstance(settings.method, EqualSteps):
        asked = asked._replace(method=settings.method)
    how = reflected.static.how._replace(backward=True)
    arrays, static = pack((system, params, asked), how, backward_trajectory_of)
    events = {name: replace(found, t=-found.t, v=_negative(found.v)) for name, found in reflected.events.items()}
    v, end = _negative(reflected.v), reflect_snapshot(reflected.end)
    return replace(reflected, t=ts, v=v, end=end, events=events, arrays=arrays, static=static)


def runs_backward(ts) -> bool:
    """Whether times decrease; while JAX is tracing them they are assumed to increase."""
    ts = ts if is_traced(ts) else np.asarray(ts)
    try:
        return bool(ts[-1] < ts[0])
    except jax.errors.TracerBoolConversionError:
        return False


def reflect_system(system: System) -> System:
    """Return the system whose forward motion is the backward motion of `system`."""

    def odd(role: str) -> bool:
        return role in ("phi", "dissipation") or role.startswith("rate")

    return system.map(lambda f, role: Reflected(f, of_velocities=role != "g", odd=odd(role)))


def reflect_snapshot(snapshot: Snapshot) -> Snapshot:
    """Turn one or several instants of the reflected motion into instants of the motion itself."""
    return snapshot._replace(t=-snapshot.t, v=_negative(snapshot.v))


def _reflect_settings(settings: Settings):
    controller, event, jump_ts = settings.controller, settings.event, settings.jump_ts
    method = settings.method
    if isinstance(method, EqualSteps) and method.pace is not None:
        method = replace(method, pace=Reflected(method.pace, of_velocities=False))
    return replace(
        settings,
        method=method,
        controller=None if controller is None else controller.wrap(-1),
        event=None if event is None else _reflect_event(event),
        jump_ts=None if jump_ts is None else -jump_ts,
    )


def _reflect_event(event):
    conditions = jax.tree.map(ReflectedCondition, event.cond_fn, is_leaf=callable)
    return diffrax.Event(conditions)


def _negative(tree: PyTree):
    return jax.tree.map(lambda x: -x, tree)
