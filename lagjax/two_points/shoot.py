"""The motion of a path: `integrate` from its start, whose velocity is corrected until the motion meets the end.

The equations of the end are evaluated on the motion's own last state, and the path's linear response to them, which
Newton's method leaves behind, says how the start velocity v_a, a free time T and the multipliers ν must change:

    z = (v_a, ν, T),    z <- z - W ρ(z),    W = dz/dρ of the discrete path

W is as good as the path, so few corrections reach round-off; two of them, with a constant W, give z its derivatives
by the implicit function theorem.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.integrate import ENDED_WELL, Trajectory, ended_well, integrate, is_among
from lagjax.jaxtools import compiled, numpy_of
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points.elements import residual, rule_of_degree
from lagjax.two_points.newton import FoundPath
from lagjax.two_points.path import FIXED, NATURAL, Ends, Path, end_rows
from lagjax.two_points.path_mesh import positions
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
    n, s = model.n, found.path.y.shape[1]
    row = jnp.asarray(rule_of_degree(s).node_derivative[0], ends.x_a.dtype)
    _, h = found.path.times(ends)
    u = row @ found.path.nodes(ends)[0, :, :n] / h[0]
    return Aim(tangent(model, ends.t_a, ends.x_a, u), found.path.border)


@compiled
def start_by_momentum(model: Model, ends: Ends, found: FoundPath) -> Aim:
    """The same of a path that is stationary, with the velocity from its momentum -R at the start.

    R is of order 2s, as the action is, and the polynomial's derivative there of order s alone. Where ∂L/∂v does not
    say what the velocity is, this one stays.
    """
    aim, n, s = start_of(model, ends, found), model.n, found.path.y.shape[1]
    (t, h), nodes, x = found.path.times(ends), found.path.nodes(ends)[0], ends.x_a
    momentum = -residual(model, rule_of_degree(s), t[0], h[0], nodes[:, :n], nodes[:, n:])[0]
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
    row = jnp.asarray(rule_of_degree(s).node_derivative[0, 1:], ends.x_a.dtype)
    _, h = found.path.times(ends)
    first = found.response.y[0].reshape(s, size, -1)[:, : model.n]
    of_start = jnp.einsum("j,jnc->nc", row, first) / h[0]
    border = found.response.border
    if ends.free_time:
        u = start_of(model, ends, found).u
        of_start = of_start - u[:, None] * border[-1][None] / found.path.border[-1]
    return jnp.concatenate([of_start, border])


@compiled
def missed(model: Model, ends: Ends, aim: Aim, q, v) -> Float[Array, " N+b"]:
    """ρ: by how much a motion that ends at (q, v) misses the equations of the end."""
    (x, u), t_b = model.vectors(q, v), ends.t_a + duration(ends, aim)
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
    return integrate(model.system, q, v, model.params, ts=times(ends, aim, outputs), rtol=rtol, **options)


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
        xp, count = numpy_of((trajectory.t, self, ends)), len(trajectory.t)
        x = [xp.reshape(xp.asarray(q), (count, -1)) for q in jax.tree.leaves(trajectory.q)]
        off = xp.concatenate(x, axis=1) - positions(ends, self.path, trajectory.t)
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


def relative_miss(model: Model, ends: Ends, aim: Aim, sizes: Array, rho: Array, q, v) -> Float[Array, ""]:
    """The largest of ρ, each in units of what it changes by along the motion: positions by their extent."""
    n, xp = model.n, numpy_of((aim, rho, sizes))
    if ends.condition is None and not ends.free_time:
        return xp.max(xp.abs(rho[:n]) / xp.asarray(sizes))
    return xp.max(xp.abs(rho) / xp.asarray(_row_sizes(model, ends, aim, sizes, q, v)))


@compiled
def _row_sizes(model: Model, ends: Ends, aim: Aim, sizes: Array, q, v) -> Float[Array, " N+b"]:
    x, u = model.vectors(q, v)
    speeds = jnp.maximum(jnp.maximum(jnp.abs(u), jnp.abs(aim.u)), sizes / duration(ends, aim))

    def rows(x: Array, u: Array) -> Array:
        return missed(model, ends, aim, model.tree(x), model.tree(u))

    by_x, by_u = jax.jacfwd(rows, argnums=(0, 1))(x, u)
    found = jnp.abs(by_x) @ sizes + jnp.abs(by_u) @ speeds
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


def implicit(model: Model, ends: Ends, aim: Aim, response: Array, rtol: Array) -> Aim:
    """The unknowns of an answer, as the equations of the end define them: with derivatives by everything."""
    # W is that of the path: one correction has derivatives as good as the path, the second one squares their error.
    for _ in range(2):
        trajectory = motion(model, ends, aim, 2, rtol, throw=False, estimate_error=False)
        aim = corrected(ends, aim, response, missed(model, ends, aim, *last_of(trajectory)))
    return aim
