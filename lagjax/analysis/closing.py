"""Newton's method for motions that close.

The unknowns are the states z_j at K equal parts of the period T and, where it is free, T itself; a motion closes where

    Φ(z_j, T/K) - z_{j+1} = 0,        z_K = z_0 + turns + shifts.

In tangent coordinates w_j, z_j + B_j w_j, and with θ = log T, the linear equations of a step are

    Y_j w_j - B_{j+1} w_{j+1} + f(z_{j+1}) (T/K) θ = -residual

with the frames Y_j that the flow makes of B_j. They do not fix where on the orbit it begins, and of a family of orbits
not which one it is. The first is settled by a step that is orthogonal to the motion, f·w = 0, the second by what is held
(an energy, a coordinate), one row each; of what is then left free, as a rotation of the whole, the shortest step is
taken.

The step is Levenberg's and Marquardt's with a damping that shrinks with the residual: it converges quadratically also to
orbits that are not isolated (Yamashita & Fukushima, *Computing Suppl.* 15 (2001) 239). One that makes the residual no
smaller is tried again with more of it.

Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.4-7.5; Muñoz-Almaraz et al., *Physica D* 181 (2003) 1
(families of conservative systems); Stoer & Bulirsch, §7.3.5 (multiple shooting).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.analysis.flow import Flow, flow_of, scale_of
from lagjax.mechanics import coordinates
from lagjax.mechanics.compiled import compiled

MOST = 40
# The damping in units of the residual: least, at first, more where a step failed, and where to give up.
LEAST, FIRST_DAMPING, MORE, TOO_MUCH = 0.01, 0.03, 8.0, 1e4
# Residuals, in tolerances: where to stop at once, and what counts as an orbit.
AIM, ENOUGH = 10.0, 1e3
# Singular values below this many tolerances, and so small at least, do not count.
NOTHING, SMALL = 1e4, 1e-8
# No step changes the logarithm of the period, or the state in units of its size, by more than this.
FARTHEST = 0.5
# The weight of what is held, and of the phase, beside coming back: far away both cannot be had.
FIRST = 100.0
TURN = 2 * np.pi


class Asked(NamedTuple):
    """What an orbit is to be, all static.

    - `free`: whether the period is unknown; `moves`: whether the start on the orbit is.
    - `energy`: whether the Jacobi integral is held; `held`: which entries of (q, v).
    - `relative` (n,): coordinates that need not come back; `angles` (n,): those that do up to whole turns.
    """

    free: bool
    moves: bool
    energy: bool
    held: tuple[int, ...]
    relative: tuple[bool, ...]
    angles: tuple[bool, ...]


class Place(NamedTuple):
    """States (K, 2n) and a period."""

    nodes: Float[Array, "K 2n"]
    period: Float[Array, ""]


class Seen(NamedTuple):
    """What the flow says at a place: the residual, its size, the matrix of a Newton step from there, and the end.

    The rows of `matrix` are in units of `measure`, its columns in those of `scale`, along the `bases`.
    """

    size: Float[Array, ""]
    residual: Float[Array, " r"]
    matrix: Float[Array, "r c"]
    bases: Float[Array, "K 2n k"]
    amplified: Float[Array, ""]
    end: Float[Array, " 2n"]
    measure: Float[Array, " 2n"]
    scale: Float[Array, " 2n"]


class Found(NamedTuple):
    """The best place, and how it went; `apart`: how much the system of a driven orbit changed from period to period."""

    place: Place
    turns: Float[Array, " n"]
    seen: Seen
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    apart: Float[Array, ""]


class Search(NamedTuple):
    """The state of the iteration: the best place so far with what was seen, and the damping to try next."""

    best: Place
    seen: Seen
    damping: Float[Array, ""]
    scale: Float[Array, " 2n"]
    turns: Float[Array, " n"]
    iterations: Int[Array, ""]


class Goal(NamedTuple):
    """What is held: the Jacobi integral and the state of the guess."""

    integral: Float[Array, ""]
    z: Float[Array, " 2n"]


@compiled
def closed(system, t, q, v, params, period, rtol, asked: Asked, rows, parts, turns, most) -> Found:
    """Search for an orbit near a state; `turns` (n,) of the angles, or None for those of the guess."""
    flow = flow_of(system, t, q, v, params, rtol, rows)
    z, scale = flow.vector(q, v), scale_of(flow.vector(q, v), period)
    z = flow.onto_constraints(t, z, scale)
    goal = Goal(_integral(flow, t, z), z)
    nodes = _nodes(flow, t, z, period, parts, scale)
    zero = jnp.zeros((), t.dtype)
    rows_of = parts * 2 * flow.size + asked.moves + asked.energy + len(asked.held)
    matrix = jnp.zeros((rows_of, parts * (2 * flow.size - len(flow.rows)) + 1), t.dtype)
    bases = jax.vmap(lambda z: flow.tangent_space(t, z, scale))(nodes)
    unseen = Seen(zero + jnp.inf, matrix[:, 0], matrix, bases, zero + 1, z, scale, scale)
    begin = Search(Place(nodes, period), unseen, zero + FIRST_DAMPING, scale, jnp.zeros(flow.size, t.dtype), jnp.zeros((), int))

    def unfinished(search):
        limit = rtol * jnp.maximum(1.0, search.seen.amplified)
        going = (search.seen.size > AIM * limit) & (search.damping < TOO_MUCH)
        near = (search.seen.size <= ENOUGH * limit) & (search.damping > FIRST_DAMPING)
        return ((search.iterations == 0) | (going & ~near)) & (search.iterations < most)

    def iterate(search):
        begins = search.iterations == 0
        place = _moved(flow, t, search, asked)
        scale_here = jnp.where(begins, scale, search.scale)
        passed, bases = _passed(flow, t, place, scale_here)
        # A guess that is all zero, as of a driven system, shows its size at its end only.
        size = jnp.maximum(scale_of(place.nodes[0], place.period), scale_of(passed.z[-1], place.period))
        measure = jnp.where(begins, jnp.where(jnp.any(place.nodes != 0), size, scale_of(passed.z[-1], period)), search.scale)
        gone = passed.z[-1][: flow.size] - place.nodes[0][: flow.size]
        around = np.array(asked.angles) & ~np.array(asked.relative)
        own = jnp.where(around, jnp.round(gone / TURN), 0.0) if turns is None else jnp.asarray(turns)
        own = jnp.where(begins, own, search.turns)
        seen = _seen(flow, t, place, passed, bases, scale_here, measure, asked, goal, own)
        better = seen.size < search.seen.size
        pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        damping = jnp.where(better, jnp.maximum(LEAST, search.damping / MORE), MORE * search.damping)
        return Search(
            pick(place, search.best), pick(seen, search.seen), damping, measure, own, search.iterations + 1
        )

    search = lax.while_loop(unfinished, iterate, begin)
    enough = ENOUGH * rtol * jnp.maximum(1.0, search.seen.amplified)
    converged = search.seen.size <= enough
    if asked.moves:
        # A state of rest comes back after any time.
        moves = jnp.max(jnp.abs(flow.rate(t, search.best.nodes[0]) * search.best.period / search.scale))
        converged = converged & (moves > jnp.sqrt(rtol))
    apart = zero if asked.moves else _changed(flow, t, search.best, search.scale)
    return Found(search.best, search.turns, search.seen, converged, search.iterations, apart)


def implicit(system, t, q, v, params, rtol, asked: Asked, rows, found: Found) -> Found:
    """The same orbit with its derivatives by the system, the parameters and what is held: one Newton step more."""
    flow = flow_of(system, t, q, v, params, rtol, rows)
    found = lax.stop_gradient(found)
    seen, scale = found.seen, found.seen.scale
    goal_z = flow.onto_constraints(t, flow.vector(q, v), scale)
    goal = Goal(_integral(flow, t, goal_z), goal_z)
    nodes = jax.vmap(lambda z: flow.onto_constraints(t, z, scale))(found.place.nodes)
    place = Place(nodes, found.place.period)
    none = jnp.zeros((flow.size * 2, 0), nodes.dtype)
    part = lambda t, z: flow.passage(t, z, found.place.period / len(nodes), none, scale, True).z
    ends = jnp.stack([part(t, z) for t, z in zip(_times(t, place), nodes)])
    residual = _residual(flow, t, place, ends, seen.measure, asked, goal, found.turns)
    # The value is that of the search, the derivative that of the step.
    change = residual - lax.stop_gradient(residual)
    moves, log_period = _step(seen.matrix, change, seen.bases, asked, lax.stop_gradient(flow.rtol), 0.0)
    z = nodes + scale[None] * moves
    period = place.period * (1 + log_period)
    end = ends[-1] + (z[0] - nodes[0])
    return found._replace(place=Place(z, period), seen=seen._replace(end=end))


def _nodes(flow, t, z, period, parts, scale):
    """The states at equal parts of a period of the guess."""
    if parts == 1:
        return z[None]
    none = jnp.zeros((z.size, 0), z.dtype)

    def onward(z, t):
        return flow.onto_constraints(t, flow.passage(t, z, period / parts, none, scale).z, scale), z

    return lax.scan(onward, z, t + period * jnp.arange(parts, dtype=z.dtype) / parts)[1]


def _times(t, place):
    count = len(place.nodes)
    return t + place.period * jnp.arange(count, dtype=t.dtype) / count


def _moved(flow, t, search, asked):
    """Where the next step leads."""
    seen, best = search.seen, search.best
    damping = jnp.where(search.iterations == 0, 0.0, search.damping * seen.size)
    moves, log_period = _step(seen.matrix, seen.residual, seen.bases, asked, flow.rtol, damping)
    farthest = jnp.maximum(jnp.max(jnp.abs(moves)), jnp.abs(log_period))
    part = jnp.minimum(1.0, FARTHEST / jnp.where(farthest > 0, farthest, 1.0))
    period = best.period * jnp.exp(part * log_period)
    nodes = best.nodes + part * seen.scale[None] * moves
    times = _times(t, Place(nodes, period))
    return Place(jax.vmap(lambda t, z: flow.onto_constraints(t, z, search.scale))(times, nodes), period)


def _passed(flow, t, place, scale):
    """Where the nodes go, and the bases of the tangent spaces at them."""
    times, span = _times(t, place), place.period / len(place.nodes)
    bases = jax.vmap(lambda t, z: flow.tangent_space(t, z, scale))(times, place.nodes)
    part = lambda t, z, basis: flow.passage(t, z, span, basis, scale)
    if len(place.nodes) == 1:
        return jax.tree.map(lambda x: x[None], part(times[0], place.nodes[0], bases[0])), bases
    return jax.vmap(part)(times, place.nodes, bases), bases


def _seen(flow, t, place, passed, bases, scale, measure, asked, goal, turns) -> Seen:
    matrix, residual = _equations(flow, t, place, passed, bases, scale, measure, asked, goal, turns)
    # Not the largest entry: a step lessens the sum of squares.
    size = jnp.sqrt(jnp.mean(residual**2))
    good = jnp.all(passed.ended) & jnp.isfinite(size) & jnp.all(jnp.isfinite(matrix))
    clean = lambda x: jnp.where(good, x, 0.0)
    amplified = clean(jnp.max(jnp.abs(passed.frame)))
    size = jnp.where(good, size, jnp.inf)
    return Seen(size, clean(residual), clean(matrix), bases, amplified, passed.z[-1], measure, scale)


def _equations(flow, t, place, passed, bases, scale, measure, asked, goal, turns):
    """The matrix (rows, K k + 1) of a Newton step, and the residual, in units of `measure`."""
    count, size, k = len(place.nodes), 2 * flow.size, bases.shape[2]
    ratio = scale / measure
    comes_back = 1.0 - np.concatenate([np.array(asked.relative, float), np.zeros(flow.size)])
    rates = jax.vmap(flow.rate)(_times(t, place) + place.period / count, passed.z) * place.period / count / measure
    blocks = []
    for j in range(count):
        after, mask = (j + 1) % count, comes_back if j == count - 1 else np.ones(size)
        row = jnp.zeros((size, count * k + 1), t.dtype)
        row = row.at[:, j * k : (j + 1) * k].add(ratio[:, None] * passed.frame[j])
        row = row.at[:, after * k : (after + 1) * k].add(-ratio[:, None] * bases[after])
        row = row.at[:, -1].set(rates[j] if asked.free else 0.0)
        blocks.append(row * mask[:, None].astype(t.dtype))
    own = lambda gradient: jnp.concatenate([gradient @ bases[0], jnp.zeros((count - 1) * k + 1, t.dtype)])[None]
    unit = lambda row: row / jnp.where(jnp.any(row != 0), jnp.linalg.norm(row), 1.0)
    if asked.moves:
        blocks.append(own(unit(flow.rate(t, place.nodes[0]) / scale)))
    # What is asked comes before what is to be made small.
    blocks = [*blocks[:count], *(FIRST * row for row in blocks[count:])]
    blocks += [FIRST * own(row) for row in _held_slopes(flow, t, place, scale, asked)]
    residual = _residual(flow, t, place, passed.z, measure, asked, goal, turns)
    return jnp.concatenate(blocks), residual


def _residual(flow, t, place, ends, measure, asked, goal, turns):
    """What is left, in the order of the rows."""
    comes_back = 1.0 - np.concatenate([np.array(asked.relative, float), np.zeros(flow.size)])
    first = place.nodes[0] + jnp.concatenate([TURN * turns, jnp.zeros_like(turns)])
    after = jnp.concatenate([place.nodes[1:], first[None]])
    left = (ends - after) / measure
    left = left.at[-1].multiply(comes_back.astype(left.dtype))
    parts = [left.reshape(-1)]
    if asked.moves:
        parts.append(jnp.zeros(1, left.dtype))
    if asked.energy:
        slope = jax.grad(lambda z: _integral(flow, t, z))(lax.stop_gradient(place.nodes[0])) * measure
        size = lax.stop_gradient(jnp.linalg.norm(slope))
        off = _integral(flow, t, place.nodes[0]) - goal.integral
        parts.append(FIRST * (off / jnp.where(size > 0, size, 1.0))[None])
    parts += [(FIRST * (place.nodes[0][i] - goal.z[i]) / measure[i])[None] for i in asked.held]
    return jnp.concatenate(parts)


def _held_slopes(flow, t, place, scale, asked):
    """The gradients of what is held, of size one, in units of `scale`."""
    if asked.energy:
        slope = jax.grad(lambda z: _integral(flow, t, z))(place.nodes[0]) * scale
        size = jnp.linalg.norm(slope)
        yield slope / jnp.where(size > 0, size, 1.0)
    for i in asked.held:
        yield jnp.eye(2 * flow.size, dtype=scale.dtype)[i]


def _step(matrix, residual, bases, asked, rtol, damping):
    """The step that lessens the residual, in units of the state and in the logarithm of the period."""
    left, sizes, right = jnp.linalg.svd(matrix, full_matrices=False)
    nothing = jnp.maximum(NOTHING * rtol, SMALL) * jnp.maximum(1.0, sizes[0] / FIRST)
    counts = sizes > nothing
    inverse = jnp.where(counts, sizes / jnp.where(counts, sizes**2 + damping**2, 1.0), 0.0)
    solved = -right.T @ (inverse * (left.T @ residual))
    moves = solved[:-1].reshape(bases.shape[0], bases.shape[2])
    return jnp.einsum("jik,jk->ji", bases, moves), solved[-1] if asked.free else jnp.zeros_like(rtol)


def _integral(flow, t, z):
    """The Jacobi integral v·p - L."""
    q, v = flow.state(z)
    value, p = jax.value_and_grad(flow.system.lagrangian, argnums=2)(t, q, v, flow.params)
    return z[flow.size :] @ coordinates.flatten(p)[0] - value


def _changed(flow: Flow, t, place, scale):
    """How much the accelerations at one state differ a period later, at some times, relative to what a period makes."""
    times = t + place.period * jnp.asarray([0.0, 0.137, 0.291, 0.443, 0.618, 0.787, 0.912], t.dtype)
    rate = jax.vmap(lambda t: flow.rate(t, place.nodes[0]) / scale)
    return jnp.max(jnp.abs(rate(times) - rate(times + place.period))) * place.period
