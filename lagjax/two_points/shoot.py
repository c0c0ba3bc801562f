"""The motion of a path: `integrate` from its start, whose velocity is corrected until the motion meets the end.

The equations of the end are evaluated on the motion's own last state, and the path's linear response to them, which
Newton's method leaves behind, says how the start velocity v_a, a free time T and the multipliers ν must change:

    z = (v_a, ν, T),    z <- z - W ρ(z),    W = dz/dρ of the discrete path

W is as good as the path, so few corrections reach round-off; two of them, with a constant W, give z its derivatives
by the implicit function theorem.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.integrate import ENDED_WELL, Trajectory, integrate, is_among
from lagjax.jaxtools import compiled, numpy_of, stop_gradient
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import NATURAL, Ends, FoundPath, end_rows

# Corrections at most, from Python and inside a program; and how much each has to shrink.
SHOTS, SHOTS_INSIDE = 8, 1
SHRINKS = 0.5
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
    """The unknowns, and the size of the next correction in units of the start velocity."""

    aim: Aim
    size: Float[Array, ""]


def shot(model: Model, ends: Ends, aim: Aim, response: Array, outputs: int, rtol) -> Shot | None:
    """Correct until the motion meets the end; None where its corrections do not shrink."""
    best, least, unit = None, np.inf, max(float(np.max(np.abs(aim.u))), float(np.finfo(np.asarray(aim.u).dtype).tiny))
    for _ in range(SHOTS):
        try:
            trajectory = motion(model, ends, aim, outputs, rtol, throw=False, estimate_error=False)
        except ValueError:
            # A start at which L or its equations are singular: there is a path, and no motion.
            return None
        if not is_among(trajectory.result, ENDED_WELL):
            return None
        rho = missed(model, ends, aim, *last_of(trajectory))
        off = float(np.max(np.abs(rho)))
        if not off < SHRINKS * least:
            break
        size = float(np.max(np.abs(np.asarray(response @ rho)[: aim.u.size]))) / unit
        best, least = Shot(aim, np.asarray(size)), off
        if size < 1e-15:
            break
        aim = corrected(ends, aim, response, rho)
    blur = ROUND_OFF * float(np.finfo(np.asarray(aim.u).dtype).eps) * max(1.0, float(np.max(np.abs(ends.x_b))))
    return best if best is not None and (best.size < 1e-6 or least < blur) else None


def shot_inside(model: Model, ends: Ends, aim: Aim, response: Array, rtol) -> Shot:
    """The same in a program, with derivatives in both modes."""
    still, fixed, aim, response = stop_gradient((model, ends, aim, response))
    end = partial(motion, outputs=2, rtol=rtol, throw=False, estimate_error=False)

    def once(aim: Aim, _):
        rho = missed(still, fixed, aim, *last_of(end(still, fixed, aim)))
        return corrected(fixed, aim, response, rho), None

    aim, _ = lax.scan(once, aim, None, length=SHOTS_INSIDE)
    aim, size = stop_gradient(aim), jnp.zeros((), aim.u.dtype)
    # W is that of the path: one correction has derivatives as good as the path, the second one squares their error.
    for _ in range(2):
        rho = missed(model, ends, aim, *last_of(end(model, ends, aim)))
        size = jnp.max(jnp.abs(response @ rho)[: aim.u.size]) / jnp.max(jnp.abs(aim.u))
        aim = corrected(ends, aim, response, rho)
    return Shot(aim, lax.stop_gradient(size))
