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
from jaxtyping import Array, Float

from lagjax.integrate import ENDED_WELL, Trajectory, ended_well, integrate, is_among
from lagjax.jaxtools import compiled, numpy_of
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.newton import FoundPath
from lagjax.two_points.path import NATURAL, Ends, end_rows

# Corrections at most, and how much each has to shrink.
SHOTS, SHRINKS = 8, 0.5
# A correction of this size, in units of the start velocity, is small enough for an answer.
CLOSE = 1e-6
# A larger one leads away: the ends are conjugate, and W is round-off.
FAR = 1.0
# So many round-offs of the end count as none.
ROUND_OFF = 1e4


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


class Shot(NamedTuple):
    """The unknowns, the size of the next correction in units of the start velocity, and the motion."""

    aim: Aim
    size: Float[Array, ""]
    trajectory: Trajectory


def shot(model: Model, ends: Ends, aim: Aim, response: Array, outputs: int, rtol) -> Shot | None:
    """Correct until the motion meets the end; None where its corrections do not shrink."""
    eps = float(np.finfo(np.asarray(aim.u).dtype).eps)
    best, least, before = None, np.inf, 1.0
    for _ in range(SHOTS):
        rho = _missed_from(model, ends, aim, rtol)
        if rho is None or not (off := float(np.max(np.abs(rho)))) < SHRINKS * least:
            break
        size = _size(aim, np.asarray(response) @ rho)
        best, least = (aim, size), off
        if not size < FAR:
            break
        aim = corrected(ends, aim, response, rho)
        # W is as good as the path: the next correction is smaller by as much again. Below round-off it says nothing.
        if size * min(size / before, 1.0) < eps:
            best = aim, size * min(size / before, 1.0)
            break
        before = size
    blur = ROUND_OFF * eps * max(1.0, float(np.max(np.abs(ends.x_b))))
    if best is None or not (best[1] < CLOSE or least < blur):
        return None
    aim = best[0]
    trajectory = motion(model, ends, aim, outputs, rtol)
    rho = np.asarray(missed(model, ends, aim, *last_of(trajectory)))
    return Shot(aim, np.asarray(_size(aim, np.asarray(response) @ rho)), trajectory)


def _missed_from(model: Model, ends: Ends, aim: Aim, rtol) -> np.ndarray | None:
    """By how much a motion misses the end; None where there is no motion."""
    try:
        trajectory = motion(model, ends, aim, 2, rtol, throw=False, estimate_error=False)
    except ValueError:
        # A start at which L or its equations are singular: there is a path, and no motion.
        return None
    well = is_among(trajectory.result, ENDED_WELL)
    return np.asarray(missed(model, ends, aim, *last_of(trajectory))) if well else None


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


def shot_inside(model: Model, ends: Ends, aim: Aim, response: Array, outputs: int, rtol: Array) -> Shot:
    """The same in a program."""
    run = partial(motion, model, ends, outputs=outputs, rtol=rtol, throw=False, estimate_error=False)
    blank = eqx.filter_eval_shape(run, aim)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, blank)
    start, static = eqx.partition(blank, eqx.is_array)

    def once(shots: _Shots) -> _Shots:
        trajectory = run(shots.aim)
        rho = missed(model, ends, shots.aim, *last_of(trajectory))
        off, size = jnp.max(jnp.abs(rho)), _size(shots.aim, response @ rho)
        better = ended_well(trajectory.result) & (off < SHRINKS * shots.least)
        new = Shot(shots.aim, size, eqx.filter(trajectory, eqx.is_array))
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, shots.best)
        count, useful = shots.count + 1, (size > 16 * jnp.finfo(size.dtype).eps) & (size < FAR)
        going = better & useful & (count < SHOTS)
        return _Shots(
            corrected(ends, shots.aim, response, rho), best, jnp.where(better, off, shots.least), count, going
        )

    infinite = jnp.full((), jnp.inf, aim.u.dtype)
    shots = _Shots(aim, Shot(aim, infinite, start), infinite, jnp.zeros((), int), jnp.asarray(True))
    best = lax.while_loop(lambda shots: shots.going, once, shots).best
    return best._replace(trajectory=eqx.combine(best.trajectory, static))


def implicit(model: Model, ends: Ends, aim: Aim, response: Array, rtol: Array) -> Aim:
    """The unknowns of an answer, as the equations of the end define them: with derivatives by everything."""
    # W is that of the path: one correction has derivatives as good as the path, the second one squares their error.
    for _ in range(2):
        trajectory = motion(model, ends, aim, 2, rtol, throw=False, estimate_error=False)
        aim = corrected(ends, aim, response, missed(model, ends, aim, *last_of(trajectory)))
    return aim
