"""The motion of a path: `integrate` from its start, whose velocity is corrected until the motion meets the end.

The equations of the end are evaluated on the motion's own last state, and the path's linear response to them, which
Newton's method leaves behind, says how the start velocity v_a, a free time T and the multipliers ν must change:

    z = (v_a, ν, T),    z <- z - W ρ(z),    W = dz/dρ of the discrete path

W is as good as the path, so few corrections reach round-off; two of them, with a constant W, give z its derivatives
by the implicit function theorem. Shooting alone ends in the same two, with its own ρ and W.

**Shooting alone**, where the ends do not complete the equations of a path.

With velocity constraints, forces that depend on multipliers, phases or elements, Newton's method looks for the start
velocity v_a and a free time T by `integrate` itself. For z = (v_a, T)

    ρ(z) = (conditions on the end of the motion; what v_a misses of the constraints) = 0

With m constraint equations, of positions and velocities together, n - m start velocities are free, and there are as
many conditions. The start of the search satisfies them less what its motion misses of them, ρ₀, so that

    ρ(z) = (1 - ε) (ρ₀; 0)

leads from there to the motion as ε grows from 0 to 1: at once if Newton's method goes so far, else in parts.

Source: Deuflhard, *Newton Methods for Nonlinear Problems* (2011), §5.1 (continuation); Neimark & Fufaev, *Dynamics of
Nonholonomic Systems* (1972), ch. 1 (how many velocities are free).
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.integrate import ENDED_WELL, Trajectory, ended_well, integrate, is_among
from lagjax.jaxtools import compiled, is_eager, is_traced, numpy_of, stop_gradient
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points.elements import residual
from lagjax.two_points.mesh import stacked
from lagjax.two_points.path import FIXED, NATURAL, Ends, FoundPath, Path, end_rows, path_through, unfound
from lagjax.two_points.starts import PathGuess, sizes_of

# Corrections at most, and how much each has to shrink; and corrections of the motion that is handed out.
SHOTS, SHRINKS, LAST_SHOTS = 8, 0.5, 3
# A larger correction, in units of the start velocity, leads away: the ends are conjugate, and W is round-off.
FAR = 1.0
# A motion meets the end that misses it by less, in units of the path's extent.
MET = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# It is that of the path if it stays nearer to it, beside ten times the error of its elements.
ALONG = 1e-3
# The velocity of the polynomial is off by less, as a part of it: a larger change by the momentum is none.
OF_POLYNOMIAL = 0.1
# Speeds of launches, beside that of the straight line, in units of a coordinate's size in the time; their outputs.
SPEEDS, OUTPUTS = (1.0, 4.0, 10.0), 129
SINGULAR = "L is singular at the start"


class Aim(NamedTuple):
    """The unknowns of a motion to the end: v_a in vector form, and the border (ν, T) of the path."""

    u: Float[Array, " n"]
    border: Float[Array, " b"]


def duration(ends: Ends, aim: Aim) -> Float[Array, ""]:
    """T."""
    return aim.border[-1] if ends.free_time else ends.duration


def tangent(model: Model, t: Array, x: Array, u: Array) -> Float[Array, " n"]:
    """The velocity nearest to u that the constraints allow."""
    if not model.m:
        return u
    rows = constraints.jacobian(model, t, x, u)
    return u - rows.T @ (dense.inverse(rows @ rows.T) @ constraints.velocity_residual(model, t, x, u))


def start_of(model: Model, ends: Ends, found: FoundPath) -> Aim:
    """The unknowns as the path has them."""
    n, row = model.n, jnp.asarray(found.path.rule().node_derivative[0], ends.x_a.dtype)
    _, h = found.path.times(ends)
    u = row @ found.path.nodes(ends)[0, :, :n] / h[0]
    return Aim(tangent(model, ends.t_a, ends.x_a, u), found.path.border)


@compiled
def start_by_momentum(model: Model, ends: Ends, found: FoundPath) -> Aim:
    """The same of a path that is stationary, with the velocity from its momentum -R at the start.

    R is of order 2s, as the action is, and the polynomial's derivative there of order s alone. Where ∂L/∂v does not
    say what the velocity is, this one stays.
    """
    aim, n, x = start_of(model, ends, found), model.n, ends.x_a
    (t, h), nodes = found.path.times(ends), found.path.nodes(ends)[0]
    momentum = -residual(model, found.path.rule(), t[0], h[0], nodes).work[0]
    of_u, u = jax.grad(model.lagrangian, argnums=2), aim.u
    mass, rows = jax.jacfwd(of_u, argnums=2)(ends.t_a, x, u), constraints.jacobian(model, ends.t_a, x, u)
    # What constraints do at the start has no part in the velocity: it is along their rows.
    matrix = jnp.concatenate([
        jnp.concatenate([mass, rows.T], axis=1), jnp.concatenate([rows, jnp.zeros((model.m, model.m), u.dtype)], axis=1)
    ])  # fmt: skip
    inverted = dense.inverse(matrix)
    for _ in range(2):
        off = momentum - of_u(ends.t_a, x, u)
        if model.m:
            off = jnp.concatenate([off, -constraints.velocity_residual(model, ends.t_a, x, u)])
        u = u + (inverted @ off)[:n]
    near = jnp.max(jnp.abs(u - aim.u)) <= OF_POLYNOMIAL * jnp.max(jnp.abs(aim.u))
    return aim._replace(u=jnp.where(near, u, aim.u))


def response_of(model: Model, ends: Ends, found: FoundPath) -> Float[Array, "n+b N+b"]:
    """W: what a unit of each equation of the end changes in (v_a, ν, T)."""
    s, size = found.path.y.shape[1:]
    row = jnp.asarray(found.path.rule().node_derivative[0, 1:], ends.x_a.dtype)
    _, h = found.path.times(ends)
    first = found.response.y[0].reshape(s, size, -1)[:, : model.n]
    of_start = jnp.einsum("j,jnc->nc", row, first) / h[0]
    border = found.response.border
    if ends.free_time:
        u = start_of(model, ends, found).u
        of_start = of_start - u[:, None] * border[-1][None] / found.path.border[-1]
    return jnp.concatenate([of_start, border])


def shoots_alone(model: Model, switching: Any) -> bool:
    """Whether the ends do not complete the equations of a path, or the motion has switches (`Ends.switching`)."""
    return switching is not None or model.reacts or not bool(model.holonomic.all())


@compiled
def missed(model: Model, ends: Ends, aim: Aim, q, v) -> Float[Array, " r"]:
    """ρ: by how much a motion that ends at (q, v) misses the equations of the end; alone, conditions on the end, and in
    the last m rows what v_a misses of the constraints."""
    (x, u), t_b = model.vectors(q, v), ends.t_a + duration(ends, aim)
    if shoots_alone(model, ends.switching):
        at_end = x - ends.x_b if ends.condition is None else ends.condition(t_b, x, u)
        return jnp.concatenate([at_end, constraints.velocity_residual(model, ends.t_a, ends.x_a, aim.u)])
    p = jax.grad(model.lagrangian, argnums=2)(t_b, x, u)
    nu = aim.border[: aim.border.size - ends.free_time]
    rows = end_rows(model, ends, t_b, x, u, jnp.zeros(int(model.holonomic.sum()), x.dtype), p, nu)
    if ends.kind != NATURAL:
        return rows
    across = rows[: model.n] + p
    if model.m:
        slope = jax.jacfwd(lambda x: constraints.position_residual(model, t_b, x))(x)
        across = across - slope.T @ (dense.inverse(slope @ slope.T) @ (slope @ across))
    return rows.at[: model.n].set(across)


@compiled
def corrected(ends: Ends, aim: Aim, response: Array, rho: Array) -> Aim:
    """The unknowns after a correction."""
    change = response @ rho
    return Aim(aim.u - change[: aim.u.size], aim.border - change[aim.u.size :])


def times(ends: Ends, aim: Aim, outputs: int):
    """The output times of a motion."""
    xp = numpy_of((ends.t_a, ends.duration, aim.border))
    return xp.asarray(ends.t_a) + xp.asarray(duration(ends, aim)) * np.linspace(0.0, 1.0, outputs, dtype=aim.u.dtype)


def motion(model: Model, ends: Ends, aim: Aim, outputs: int, rtol, **options) -> Trajectory:
    """The motion from the start."""
    q, v = model.tree(ends.x_a), model.tree(aim.u)
    system = model.system if ends.switching is None else ends.switching
    return integrate(system, q, v, model.params, ts=times(ends, aim, outputs), rtol=rtol, **options)


def last_of(trajectory: Trajectory):
    """The last state (q, v) of a motion."""
    return jax.tree.map(lambda x: x[-1], (trajectory.q, trajectory.v))


def launches_of(model: Model, ends: Ends, count: int, rtol) -> list[PathGuess]:
    """Motions from the start as starts: faster than the straight line by as much as coordinates may go, and more."""
    if ends.kind != FIXED or ends.free_time:
        return []
    sizes, random, found = sizes_of(model, ends).sizes, np.random.default_rng(1), []
    for i in range(count):
        u = (ends.x_b - ends.x_a + SPEEDS[i % len(SPEEDS)] * random.normal(size=sizes.size) * sizes) / ends.duration
        aim = Aim(tangent(model, ends.t_a, ends.x_a, jnp.asarray(u, ends.x_a.dtype)), jnp.zeros(0, ends.x_a.dtype))
        launch = motion(model, ends, aim, OUTPUTS, rtol, throw=False, estimate_error=False)
        if is_among(launch.result, ENDED_WELL):
            found.append(PathGuess(f"launch {i + 1}", launch))
    return found


class ShotCourse(NamedTuple):
    """A path as motions are compared with it: with the sizes of its coordinates, and the largest error of its
    elements."""

    path: Path
    sizes: Float[Array, " n"]
    error: Float[Array, ""]

    def strays(self, ends: Ends, trajectory: Trajectory) -> Float[Array, ""]:
        """How far a motion is from the path at its outputs, in units of the path's sizes."""
        xp = numpy_of((trajectory.t, self, ends))
        off = stacked(trajectory.q) - self.path.at(ends, trajectory.t)
        return xp.max(xp.abs(off) / xp.asarray(self.sizes)[None])

    def allows(self) -> Float[Array, ""]:
        """By how much the motion that it describes may be off it."""
        return ALONG + 10 * self.error


class Shot(NamedTuple):
    """The unknowns, the motion from them, and by how much it misses the end (`relative_miss`)."""

    aim: Aim
    size: Float[Array, ""]
    trajectory: Trajectory


def shot(model: Model, ends: Ends, course: ShotCourse, aim: Aim, response: Array, outputs: int, rtol) -> Shot | str:
    """Correct until the motion meets the end; in words, why it cannot be followed there."""
    dtype = np.asarray(aim.u).dtype
    eps, met, nearest = float(np.finfo(dtype).eps), MET.get(dtype, 1e-3), np.inf
    best, least, before = None, np.inf, 1.0
    for _ in range(SHOTS):
        try:
            last = last_well(motion(model, ends, aim, 2, rtol, throw=False, estimate_error=False))
        except ValueError:
            # L or its equations are singular there: there is a path, and no motion.
            last = None
        if last is None:
            if best is None and not bool(_is_regular(model, ends, aim)):
                return SINGULAR
            break
        rho = np.asarray(missed(model, ends, aim, *last))
        if not (off := float(np.max(np.abs(rho)))) < SHRINKS * least:
            break
        best, least = aim, off
        nearest = float(relative_miss(model, ends, aim, course.sizes, rho, *last))
        size = float(_size(aim, np.asarray(response) @ rho))
        if not size < FAR:
            break
        aim = corrected(ends, aim, response, rho)
        # W is as good as the path: the next correction is smaller by as much again. Below round-off it says nothing.
        shrinks = min(size / before, 1.0)
        if size * shrinks < eps and nearest * shrinks < met * met:
            best = aim
            break
        before = size
    for _ in range(LAST_SHOTS if best is not None else 0):
        # Other outputs may be other round-off, which the motion amplifies: what is handed out is judged.
        trajectory = motion(model, ends, best, outputs, rtol, throw=False)
        if (last := last_well(trajectory)) is None:
            break
        rho = np.asarray(missed(model, ends, best, *last))
        nearest = float(relative_miss(model, ends, best, course.sizes, rho, *last))
        if nearest < met:
            astray = float(course.strays(ends, trajectory))
            if astray < float(course.allows()):
                return Shot(best, np.asarray(nearest, dtype), trajectory)
            return f"the motion that meets the end leaves the path by {astray:.1g} of its extent"
        best = corrected(ends, best, response, rho)
    return (
        f"motions from its start miss the end by {nearest:.1g} of its extent: {_grows(model, ends, course, response)}"
    )


@compiled
def _is_regular(model: Model, ends: Ends, aim: Aim) -> Bool[Array, ""]:
    """Whether ∂L/∂v and constraints say at the start what a velocity and its change are."""
    arguments = ends.t_a, ends.x_a, aim.u
    mass, rows = jax.jacfwd(jax.grad(model.lagrangian, argnums=2), argnums=2)(*arguments), constraints.jacobian
    held = mass + rows(model, *arguments).T @ rows(model, *arguments) * jnp.max(jnp.abs(mass)) if model.m else mass
    forces = jax.grad(model.lagrangian, argnums=1)(*arguments)
    well = jnp.all(jnp.isfinite(held)) & jnp.all(jnp.isfinite(forces))
    return well & (dense.reciprocal_condition(jnp.where(well, held, 0.0)) > 10 * jnp.finfo(mass.dtype).eps)


def last_well(trajectory: Trajectory):
    """The last state (q, v) of a motion that reached its end; else None."""
    return last_of(trajectory) if is_among(trajectory.result, ENDED_WELL) else None


def meets(trajectory: Trajectory, missed: Array | np.ndarray) -> Bool[Array, ""]:
    """Whether a motion reached its end, and misses by little what is asked there."""
    return ended_well(trajectory.result) & (missed < MET.get(np.dtype(missed.dtype), 1e-3))


def relative_miss(model: Model, ends: Ends, aim: Aim, sizes: Array, rho: Array, q, v) -> Float[Array, ""]:
    """The largest of ρ, each in units of what it changes by along the motion: positions by their extent."""
    n, xp = model.n, numpy_of((aim, rho, sizes))
    if ends.condition is None and not ends.free_time:
        return xp.max(xp.abs(rho[:n]) / xp.asarray(sizes))
    return xp.max(xp.abs(rho) / xp.asarray(_row_sizes(model, ends, aim, sizes, q, v)))


@compiled
def _row_sizes(model: Model, ends: Ends, aim: Aim, sizes: Array, q, v) -> Float[Array, " r"]:
    x, u = model.vectors(q, v)
    speeds = jnp.maximum(jnp.maximum(jnp.abs(u), jnp.abs(aim.u)), sizes / duration(ends, aim))

    def rows(x: Array, u: Array, start: Array) -> Array:
        return missed(model, ends, aim._replace(u=start), model.tree(x), model.tree(u))

    by_x, by_u, by_start = jax.jacfwd(rows, argnums=(0, 1, 2))(x, u, aim.u)
    found = jnp.abs(by_x) @ sizes + (jnp.abs(by_u) + jnp.abs(by_start)) @ speeds
    return jnp.where(found > 0, found, 1.0)


def _grows(model: Model, ends: Ends, course: ShotCourse, response: Array) -> str:
    """By how much an error of the start velocity grows up to the end."""
    n, scale = model.n, np.asarray(course.sizes)
    by_end = np.asarray(response)[:n, :n] * scale[None] / scale[:, None] * float(ends.duration)
    least = np.linalg.svd(by_end, compute_uv=False)[n - model.m - 1] if np.all(np.isfinite(by_end)) else 0.0
    return f"an error there is {1 / max(least, 1e-300):.0e} times as large at the end"


def _size(aim: Aim, change: Array | np.ndarray):
    """A correction in units of the start velocity."""
    xp = numpy_of((aim, change))
    unit = xp.maximum(xp.max(xp.abs(aim.u)), np.finfo(aim.u.dtype).tiny)
    return xp.max(xp.abs(change[: aim.u.size])) / unit


class _Shots(NamedTuple):
    aim: Aim
    best: Shot
    least: Array
    count: Array
    going: Array


def shot_inside(
    model: Model, ends: Ends, course: ShotCourse, aim: Aim, response: Array, outputs: int, rtol: Array
) -> Shot:
    """The same in a program; a motion that leaves the path misses by infinity."""
    run = partial(motion, model, ends, outputs=outputs, rtol=rtol, throw=False, estimate_error=False)
    blank = eqx.filter_eval_shape(run, aim)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, blank)
    start, static = eqx.partition(blank, eqx.is_array)

    def once(shots: _Shots) -> _Shots:
        trajectory = run(shots.aim)
        rho = missed(model, ends, shots.aim, *last_of(trajectory))
        off, size = jnp.max(jnp.abs(rho)), _size(shots.aim, response @ rho)
        better = ended_well(trajectory.result) & (off < SHRINKS * shots.least)
        relative = relative_miss(model, ends, shots.aim, course.sizes, rho, *last_of(trajectory))
        new = Shot(shots.aim, relative, eqx.filter(trajectory, eqx.is_array))
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, shots.best)
        count, useful = shots.count + 1, (size > 16 * jnp.finfo(size.dtype).eps) & (size < FAR)
        going = better & useful & (count < SHOTS)
        return _Shots(
            corrected(ends, shots.aim, response, rho), best, jnp.where(better, off, shots.least), count, going
        )

    infinite = jnp.full((), jnp.inf, aim.u.dtype)
    shots = _Shots(aim, Shot(aim, infinite, start), infinite, jnp.zeros((), int), jnp.asarray(True))
    best = lax.while_loop(lambda shots: shots.going, once, shots).best
    trajectory = eqx.combine(best.trajectory, static)
    along = course.strays(ends, trajectory) < course.allows()
    return Shot(best.aim, jnp.where(along, best.size, jnp.inf), trajectory)


def missed_from(model: Model, ends: Ends, aim: Aim, outputs: int, rtol) -> Float[Array, " r"]:
    """ρ of the motion from the start."""
    launched = _on_tangent(model, ends, aim) if shoots_alone(model, ends.switching) else aim
    trajectory = motion(model, ends, launched, outputs, rtol, throw=False, estimate_error=False)
    return missed(model, ends, aim, *last_of(trajectory))


def implicit(model: Model, ends: Ends, aim: Aim, response: Array, outputs: int, rtol) -> Aim:
    """The unknowns of an answer, as the equations of the end define them: with derivatives by everything."""
    # One correction has derivatives as good as W, of the path or by differences; the second one squares their error.
    for _ in range(2):
        aim = corrected(ends, aim, response, missed_from(model, ends, aim, outputs, rtol))
    return aim


@compiled
def _on_tangent(model: Model, ends: Ends, aim: Aim) -> Aim:
    return aim._replace(u=tangent(model, ends.t_a, ends.x_a, aim.u))


# A step of this size, relative, ends the search, the second one a part of the way; one below the third that no longer
# shrinks is round-off.
SMALL, SMALL_PART, SETTLED = 1e-14, 1e-6, 1e-7
# Newton's steps for a part of the way, how much each has to shrink, the shortest part, and motions in all.
STEPS, STEP_SHRINKS, SHORTEST, MOST = 8, 0.5, 1e-3, 120

# Numbers differ by this, relative, for the derivatives of ρ: an exact derivative of a motion compiles twice as long.
DIFFERENCE = {np.dtype("float64"): 1e-5, np.dtype("float32"): 3e-3}


class Place(NamedTuple):
    """The last z found, for a part ε of the way, with its W."""

    z: Float[Array, " z"]
    response: Float[Array, "z r"]
    part: Float[Array, ""]


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
    """The start velocity and the time, for a part of the way: all of it, where they were found."""

    aim: Aim
    part: Float[Array, ""]


@compiled
def _start(model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"]) -> Float[Array, " z"]:
    """z of the path through given nodes."""
    return jnp.concatenate(start_of(model, ends, unfound(path_through(model, ends, x, parts))))


def misses_of(model: Model, ends: Ends, aim: Aim, trajectory: Trajectory) -> Float[Array, ""]:
    """By how much a motion misses what is asked, in units of what that changes by along it; without derivatives."""
    model, ends, aim, trajectory = stop_gradient((model, ends, aim, trajectory))
    x, u = stacked(trajectory.q), stacked(trajectory.v)
    moved = jnp.maximum(jnp.max(jnp.abs(x - x[:1]), axis=0), jnp.max(jnp.abs(u), axis=0) * duration(ends, aim))
    still = jnp.max(moved) <= 0
    moved = jnp.where(still, 1.0, jnp.maximum(moved, 1e-3 * jnp.max(moved)))
    last = last_of(trajectory)
    return relative_miss(model, ends, aim, moved, missed(model, ends, aim, *last), *last)


def _pseudoinverse(jacobian: Float[Array, "r z"]) -> Float[Array, "z r"]:
    """W by least squares: an end on constraints says some things twice."""
    unit = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    unit = jnp.where(unit > 0, unit, 1.0)
    scaled = jacobian / unit[None]
    return dense.inverse(scaled.T @ scaled) @ scaled.T / unit[:, None]


@compiled
def _around(z: Float[Array, " z"], units: Float[Array, " z"], n: int) -> Aim:
    """z (2z + 1 of them), and what differs from it by a little in one number."""
    little = jnp.diag(DIFFERENCE[z.dtype] * units)
    trials = jnp.concatenate([z[None], z[None] + little, z[None] - little])
    return Aim(trials[:, :n], trials[:, n:])


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
    response = _pseudoinverse(jacobian)
    step = response @ (rho - (1 - part) * defect)
    size = jnp.max(jnp.abs(step) / units)
    fine = jnp.isfinite(size) & jnp.all((search.z - step)[model.n :] > 0)
    at_round_off = (search.size < SETTLED) & (size > STEP_SHRINKS / 2 * search.size)
    there = fine & ((size < jnp.where(part < 1.0, SMALL_PART, SMALL)) | at_round_off)
    lost = ~there & ~(fine & (size < STEP_SHRINKS * search.size) & (search.steps < STEPS))
    place = jax.tree.map(lambda new, old: jnp.where(there, new, old), Place(search.z, response, part), before)
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
    place = Place(start, jnp.zeros((count, rows), start.dtype), zero)
    search = _VelocitySearch(
        place, start, jnp.zeros(rows, start.dtype), zero + 1, zero + jnp.inf, none, none, jnp.asarray(True)
    )

    def at(aim: Aim) -> Array:
        return missed_from(still, fixed, aim, outputs, rtol)

    def iterate(search: _VelocitySearch) -> _VelocitySearch:
        trials = _around(search.z, units, n)
        rho = jnp.stack([at(Aim(*aim)) for aim in zip(*trials)]) if eager else lax.map(at, trials)
        return _next(still, units, search, rho)

    if eager:
        while search.going:
            search = iterate(search)
        place, z = search.place, np.asarray(search.place.z)
        return FoundVelocity(_on_tangent(model, ends, Aim(z[:n], z[n:])), place.part)
    place = stop_gradient(lax.while_loop(lambda search: search.going, iterate, search).place)
    last = Aim(place.z[:n], place.z[n:])
    found = implicit(model, ends, last, place.response, outputs, rtol)
    aim = jax.tree.map(lambda old, new: jnp.where(place.part < 1.0, old, new), last, found)
    return FoundVelocity(_on_tangent(model, ends, aim), place.part)
