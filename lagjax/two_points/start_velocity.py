"""`connect` by shooting alone, where the ends do not complete the equations of a path.

With velocity constraints, or forces that depend on multipliers, Newton's method looks for the start velocity v_a and a
free time T by `integrate` itself. For z = (v_a, T)

    ρ(z) = (conditions on the end of the motion; what v_a misses of the constraints) = 0

With m constraint equations, of positions and velocities together, n - m start velocities are free, and there are as
many conditions. The start of the search satisfies them less what its motion misses of them, ρ₀, so that

    ρ(z) = (1 - ε) (ρ₀; 0)

leads from there to the motion as ε grows from 0 to 1: at once if Newton's method goes so far, else in parts.

Source: Deuflhard, *Newton Methods for Nonlinear Problems* (2011), §5.1 (continuation); Neimark & Fufaev, *Dynamics of
Nonholonomic Systems* (1972), ch. 1 (how many velocities are free).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.integrate import Trajectory
from lagjax.jaxtools import compiled, is_eager, is_traced, stop_gradient
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points import path_mesh, shoot
from lagjax.two_points.newton import unfound
from lagjax.two_points.path import Ends
from lagjax.two_points.shoot import Aim

# A step of this size, relative, ends the search, the second one a part of the way; one below the third that no longer
# shrinks is round-off.
SMALL, SMALL_PART, SETTLED = 1e-14, 1e-6, 1e-7
# Newton's steps for a part of the way, how much each has to shrink, the shortest part, and motions in all.
STEPS, SHRINKS, SHORTEST, MOST = 8, 0.5, 1e-3, 120

# Numbers differ by this, relative, for the derivatives of ρ: an exact derivative of a motion compiles twice as long.
DIFFERENCE = {np.dtype("float64"): 1e-5, np.dtype("float32"): 3e-3}


def shoots_alone(model: Model) -> bool:
    """Whether the ends do not complete the equations of a path."""
    return model.reacts or not bool(model.holonomic.all())


class Place(NamedTuple):
    """The last z found, for a part ε of the way, with the Jacobian and the size of the last step, relative."""

    z: Float[Array, " z"]
    jacobian: Float[Array, "r z"]
    part: Float[Array, ""]
    size: Float[Array, ""]


class _VelocitySearch(NamedTuple):
    """From a place to the next: the trial z, by how much ε grows, the size of the last step, and steps and motions."""

    place: Place
    z: Float[Array, " z"]
    defect: Float[Array, " r"]
    more: Float[Array, ""]
    size: Float[Array, ""]
    steps: Int[Array, ""]
    motions: Int[Array, ""]
    going: Bool[Array, ""]


class FoundVelocity(NamedTuple):
    """The start velocity and the time, for a part of the way: all of it, where they were found; the last step."""

    aim: Aim
    part: Float[Array, ""]
    size: Float[Array, ""]


@compiled
def _start(model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"]) -> Float[Array, " z"]:
    """z of the path through given nodes."""
    path = path_mesh.path_through(model, ends, x, parts)
    return jnp.concatenate(shoot.start_of(model, ends, unfound(path)))


@compiled
def _aim(model: Model, ends: Ends, z: Float[Array, " z"]) -> Aim:
    return Aim(shoot.tangent(model, ends.t_a, ends.x_a, z[: model.n]), z[model.n :])


@compiled
def _misses(model: Model, ends: Ends, z: Float[Array, " z"], q, v) -> Float[Array, " r"]:
    """ρ, where the motion from z ends at (q, v)."""
    (x_b, u_b), u = model.vectors(q, v), z[: model.n]
    t_b = ends.t_a + shoot.duration(ends, Aim(u, z[model.n :]))
    at_end = x_b - ends.x_b if ends.condition is None else ends.condition(t_b, x_b, u_b)
    return jnp.concatenate([at_end, constraints.velocity_residual(model, ends.t_a, ends.x_a, u)])


def missed(model: Model, ends: Ends, outputs: int, rtol, z: Float[Array, " z"]) -> Float[Array, " r"]:
    """ρ; the last m rows are what v_a misses of the constraints."""
    motion = shoot.motion(model, ends, _aim(model, ends, z), outputs, rtol, throw=False, estimate_error=False)
    return _misses(model, ends, z, *shoot.last_of(motion))


@compiled
def _sizes_of_rows(model: Model, ends: Ends, z: Float[Array, " z"], sizes: Array, speeds: Array, q, v):
    """What each row of ρ changes by along a motion of these sizes and speeds."""

    def rows(x: Array, u: Array, u_a: Array) -> Array:
        return _misses(model, ends, jnp.concatenate([u_a, z[model.n :]]), model.tree(x), model.tree(u))

    x, u = model.vectors(q, v)
    by_x, by_u, by_start = jax.jacfwd(rows, argnums=(0, 1, 2))(x, u, z[: model.n])
    found = jnp.abs(by_x) @ sizes + (jnp.abs(by_u) + jnp.abs(by_start)) @ speeds
    return jnp.where(found > 0, found, 1.0)


def misses_of(model: Model, ends: Ends, found: "FoundVelocity", trajectory: Trajectory) -> Float[Array, ""]:
    """By how much a motion misses what is asked, in units of what that changes by along it; without derivatives."""
    model, ends, found, trajectory = stop_gradient((model, ends, found, trajectory))
    x, u = (
        jnp.concatenate([jnp.reshape(y, (len(trajectory.t), -1)) for y in jax.tree.leaves(tree)], axis=1)
        for tree in (trajectory.q, trajectory.v)
    )
    z, last = jnp.concatenate(found.aim), shoot.last_of(trajectory)
    time = shoot.duration(ends, found.aim)
    moved = jnp.maximum(jnp.max(jnp.abs(x - x[:1]), axis=0), jnp.max(jnp.abs(u), axis=0) * time)
    still = jnp.max(moved) <= 0
    moved = jnp.where(still, 1.0, jnp.maximum(moved, 1e-3 * jnp.max(moved)))
    sizes = _sizes_of_rows(model, ends, z, moved, moved / time, *last)
    return jnp.max(jnp.abs(_misses(model, ends, z, *last)) / sizes)


def _step(jacobian: Float[Array, "r z"], rho: Float[Array, " r"]) -> Float[Array, " z"]:
    """Newton's step by least squares: an end on constraints says some things twice."""
    unit = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    unit = jnp.where(unit > 0, unit, 1.0)
    scaled = jacobian / unit[None]
    return dense.inverse(scaled.T @ scaled) @ (scaled.T @ rho) / unit


@compiled
def _around(z: Float[Array, " z"], units: Float[Array, " z"]) -> Float[Array, "2z+1 z"]:
    """z, and what differs from it by a little in one number."""
    little = jnp.diag(DIFFERENCE[z.dtype] * units)
    return jnp.concatenate([z[None], z[None] + little, z[None] - little])


@compiled
def _next(
    model: Model, units: Float[Array, " z"], search: _VelocitySearch, rho: Float[Array, "2z+1 r"]
) -> _VelocitySearch:
    """A step of Newton's method, or the next part of the way."""
    before, first, count = search.place, search.motions == 0, len(units)
    jacobian = (rho[1 : 1 + count] - rho[1 + count :]).T / (2 * DIFFERENCE[units.dtype] * units)[None]
    rho = rho[0]
    defect = jnp.where(first, rho.at[len(rho) - model.m :].set(0.0), search.defect)
    part = jnp.minimum(1.0, before.part + search.more)
    step = _step(jacobian, rho - (1 - part) * defect)
    size = jnp.max(jnp.abs(step) / units)
    fine = jnp.isfinite(size) & jnp.all((search.z - step)[model.n :] > 0)
    at_round_off = (search.size < SETTLED) & (size > SHRINKS / 2 * search.size)
    there = fine & ((size < jnp.where(part < 1.0, SMALL_PART, SMALL)) | at_round_off)
    lost = ~there & ~(fine & (size < SHRINKS * search.size) & (search.steps < STEPS))
    place = jax.tree.map(lambda new, old: jnp.where(there, new, old), Place(search.z, jacobian, part, size), before)
    z = jnp.where(lost | there, place.z, search.z - step)
    more = jnp.where(lost, search.more / 3, jnp.where(there, 1.5 * search.more, search.more))
    again, motions = lost | there, search.motions + 1
    going = (place.part < 1.0) & (more > SHORTEST) & (motions < MOST) & (fine | ~first)
    steps, size = jnp.where(again, 0, search.steps + 1), jnp.where(again, jnp.inf, size)
    return _VelocitySearch(place, z, defect, more, size, steps, motions, going)


def found_by_shooting(
    model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"], outputs: int, rtol
) -> FoundVelocity:
    """The start velocity, from that of the path through given nodes; in a program differentiable in both modes."""
    eager = is_eager() and not is_traced((model, ends, x))
    still, fixed = stop_gradient((model, ends))
    start = stop_gradient(_start(still, fixed, x, parts))
    n, count, rows = model.n, start.size, model.m + (ends.x_a.size if ends.condition is None else ends.conditions)
    speed = jnp.maximum(jnp.max(jnp.abs(ends.x_b - ends.x_a)) / ends.duration, jnp.max(jnp.abs(start[:n])))
    units = jnp.concatenate([jnp.full(n, jnp.where(speed > 0, speed, 1.0)), 0 * start[n:] + ends.duration])
    units = stop_gradient(units)
    zero, none = jnp.zeros((), start.dtype), jnp.zeros((), int)
    place = Place(start, jnp.zeros((rows, count), start.dtype), zero, zero + jnp.inf)
    search = _VelocitySearch(
        place, start, jnp.zeros(rows, start.dtype), zero + 1, zero + jnp.inf, none, none, jnp.asarray(True)
    )

    def at(z: Array) -> Array:
        return missed(still, fixed, outputs, rtol, z)

    def iterate(search: _VelocitySearch) -> _VelocitySearch:
        trials = _around(search.z, units)
        rho = jnp.stack([at(z) for z in trials]) if eager else lax.map(at, trials)
        return _next(still, units, search, rho)

    if eager:
        while search.going:
            search = iterate(search)
        return FoundVelocity(_aim(model, ends, search.place.z), search.place.part, search.place.size)
    place = stop_gradient(lax.while_loop(lambda search: search.going, iterate, search).place)
    z = place.z
    # Two more steps, as in `shot_inside`: the second squares the error that differences leave in the first one.
    for _ in range(2):
        moved = z - _step(place.jacobian, missed(model, ends, outputs, rtol, z))
        z = jnp.where(place.part < 1.0, z, moved)
    return FoundVelocity(_aim(model, ends, z), place.part, place.size)
