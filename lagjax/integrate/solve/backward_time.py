"""Motions that run backward in time: the reflected system, which runs forward.

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

from collections.abc import Callable
from dataclasses import replace

import diffrax
import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate.parts import Snapshot, pack
from lagjax.integrate.problem import Problem
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.programs import trajectory_of
from lagjax.integrate.trajectory import Trajectory
from lagjax.numerics import EqualSteps
from lagjax.system import System, is_traced, takes_of


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
