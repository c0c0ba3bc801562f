"""A path between two ends: the equations of its nodes, their elimination, Newton's method, and the way to a solution.

The unknowns are positions and multipliers y = (x, λ) at the nodes of K elements (`elements.py`), group by group: inner
nodes and last node of an element. A group is coupled to the next by its last node alone, so the matrix is
block-tridiagonal, and is eliminated from the start,

    Δ₁ = A₁,    Δ_{e+1} = A_{e+1} - L_e (Δ_e⁻¹)_{last, last} U_e.

At the end stand the end conditions, and beside the groups a border: the duration T where it is free, and the
multipliers ν of conditions g(t, q) = 0 on a free end,

    fixed:      x_b is given
    natural:    g(t_b, x_b) = 0 and p + (∂g/∂q)ᵀ ν = 0 (transversality); with T free also h = ν·∂g/∂t
    complete:   as many conditions on (t_b, x_b, v_b) as there are unknowns; with a fixed end, h = 0 for a free T

Source: Ascher, Mattheij & Russell, *Numerical Solution of Boundary Value Problems for ODEs* (1995), §7.2, §9.1.

**Newton's method.** A step is shortened until the step after it is shorter than itself: a test that knows no units but
those of positions.

Source: Deuflhard, *Newton Methods for Nonlinear Problems* (2011), §3.3 (the test, with the new matrix in place of the
old).

**The way to a solution.** The shorter a motion is, the straighter it is: where Newton's method fails, a path is
followed from a short time to the whole one. Then it is solved for on elements laid anew (`mesh.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from lagjax.jaxtools import compiled, numpy_of
from lagjax.numerics import dense
from lagjax.system import Model, constraints
from lagjax.two_points import elements, mesh
from lagjax.two_points.elements import Defects, Rule, basis, rule_of_degree

FIXED, NATURAL, COMPLETE = "fixed", "natural", "complete"


class Ends(eqx.Module):
    """The ends of a path. `condition(t, x, u)` -> conditions on the end, in vector form; None for a fixed one.

    `x_b`: the fixed end, or a guess. `duration`: T, or a guess. `switching`: the hybrid, or system with elements, whose
    motion it is, where the model is that of its first phase.
    """

    t_a: Float[Array, ""]
    x_a: Float[Array, " n"]
    x_b: Float[Array, " n"]
    duration: Float[Array, ""]
    condition: Callable | None
    kind: str = eqx.field(static=True)
    free_time: bool = eqx.field(static=True)
    conditions: int = eqx.field(static=True)
    switching: Any = None

    @property
    def border(self) -> int:
        """The number of unknowns beside the nodes."""
        return (self.conditions if self.kind == NATURAL else 0) + self.free_time


class Path(NamedTuple):
    """The nodes of K elements, and what stands beside them; the first node is the given start.

    - `parts` (K + 1,): where elements meet, as parts of the duration, from 0 to 1.
    - `y` (K, s, n + m): positions and multipliers of the holonomic constraints at all nodes but the first.
    - `border`: ν and T, as far as they are unknown.
    """

    parts: Float[Array, " K+1"]
    y: Float[Array, "K s N"]
    border: Float[Array, " b"]

    def duration(self, ends: Ends) -> Float[Array, ""]:
        """T."""
        return self.border[-1] if ends.free_time else ends.duration

    def nodes(self, ends: Ends) -> Float[Array, "K s+1 N"]:
        """All nodes of each element, the first one included."""
        xp: Any = numpy_of((self, ends))
        y, none = xp.asarray(self.y), np.zeros(self.y.shape[2] - ends.x_a.size, self.y.dtype)
        first = xp.concatenate([xp.asarray(ends.x_a), none])
        before = xp.concatenate([first[None], y[:-1, -1]])
        return xp.concatenate([before[:, None], y], axis=1)

    def times(self, ends: Ends) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
        """The start and the length of each element."""
        duration = self.duration(ends)
        return ends.t_a + duration * self.parts[:-1], duration * jnp.diff(self.parts)

    def rule(self) -> Rule:
        """The elements, which have one degree."""
        return rule_of_degree(self.y.shape[1])

    def at(self, ends: Ends, t: Float[Array, " T"]) -> Float[Array, "T n"]:
        """The positions at any times."""
        xp = numpy_of((self, ends, t))
        t_a, duration, parts = (xp.asarray(x) for x in (ends.t_a, self.duration(ends), self.parts))
        x = self.nodes(ends)[..., : ends.x_a.size]
        return mesh.between(parts, self.rule().nodes, x, (xp.asarray(t) - t_a) / duration)

    def action(self, model: Model, ends: Ends) -> Float[Array, ""]:
        """The sum of the discrete actions of the elements."""
        of_element = lambda t, h, nodes: elements.discrete_action(model, self.rule(), t, h, nodes)
        return jnp.sum(jax.vmap(of_element)(*self.times(ends), self.nodes(ends)))

    def errors(self, ends: Ends) -> Float[Array, " K"]:
        """The highest coefficient on each element, in units of the path's extent."""
        c = mesh.highest(self.nodes(ends)[..., : ends.x_a.size])
        return jnp.max(jnp.abs(c) / extent(ends, self)[None], axis=1)


class PathEquations(NamedTuple):
    """Residuals r and their derivatives at a path, by groups; `before` is L, `after` is U of the docstring above."""

    r: Float[Array, "K sN"]
    of_border: Float[Array, " b"]
    diagonal: Float[Array, "K sN sN"]
    before: Float[Array, "K-1 sN N"]
    after: Float[Array, "K-1 N sN"]
    columns: Float[Array, "K sN b"]
    rows: Float[Array, "b s+1 N"]
    corner: Float[Array, "b b"]


def _weighted(rule: Rule, h: Array, found: Defects) -> Float[Array, "s+1 N"]:
    """R, and g multiplied by h b_j: so the derivative is symmetric where there is an action."""
    weights = h * rule.node_weights.astype(found.work.dtype)
    return jnp.concatenate([found.work, weights[:, None] * found.g], axis=1)


def momentum_matrix(model: Model, rule: Rule, t: Array, h: Array, nodes: Array):
    """R and the constraints of an element, (s + 1, N), and the derivative by its nodes, (s + 1, N, s + 1, N)."""
    n, dtype, none = model.n, nodes.dtype, jnp.zeros(0, nodes.dtype)
    t_i, x_i, u_i = elements.at_points(rule, t, h, nodes[:, :n])

    def at_point(t: Array, state: Array) -> Array:
        return jnp.concatenate(elements.force_and_momentum(model, t, state[:n], state[n:], none))

    def with_jacobian(t: Array, state: Array):
        value, push = jax.linearize(lambda state: at_point(t, state), state)
        return value, jax.vmap(push, out_axes=1)(jnp.eye(2 * n, dtype=dtype))

    values, slopes = jax.vmap(with_jacobian)(t_i, jnp.concatenate([x_i, u_i], axis=1))
    found = elements.defects(model, rule, t, h, nodes, values[:, :n], values[:, n:])
    # Values at the points by the nodes: rows h P and D for f and p, columns P and D/h for x and u.
    p_i, d_i, w = (a.astype(dtype) for a in (rule.interpolation, rule.derivative, rule.weights))
    tests, trials = jnp.stack([h * p_i, d_i]), jnp.stack([p_i, d_i / h])
    slopes = slopes.reshape(-1, 2, n, 2, n) * w[:, None, None, None, None]
    matrix = jnp.einsum("aij,iaxby,bik->jxky", tests, slopes, trials)
    m = nodes.shape[1] - n
    if not m:
        return found.work, matrix

    def at_node(t: Array, weight: Array, node: Array) -> Array:
        return weight * jnp.concatenate(elements.of_constraints(model, t, node))

    times, weights = t + h * rule.nodes.astype(dtype), h * rule.node_weights.astype(dtype)
    by_node = jax.vmap(jax.jacfwd(at_node, argnums=2))(times, weights, nodes)
    places = np.arange(rule.degree + 1)
    whole = jnp.zeros((len(places), n + m, len(places), n + m), dtype).at[:, :n, :, :n].set(matrix)
    return _weighted(rule, h, found), whole.at[places, :, places, :].add(by_node)


def end_rows(model: Model, ends: Ends, t_b: Array, x: Array, u: Array, multipliers: Array, p: Array, nu: Array):
    """The equations of the end: N of the last node (to be added to R where the end is natural), then the border's."""
    m, border = multipliers.size, []
    if ends.condition is None:
        at_node, by_t = x - ends.x_b, 0.0
    elif ends.kind == NATURAL:
        condition = ends.condition
        value, back = jax.vjp(lambda t, x: condition(t, x, u), t_b, x)
        by_t, at_node = back(nu)
        border = [value]
    else:
        conditions = ends.condition(t_b, x, u)
        at_node = jnp.concatenate([conditions[: x.size - m], constraints.position_residual(model, t_b, x)])
        return jnp.concatenate([at_node, multipliers, conditions[x.size - m :]])
    if ends.free_time:
        border.append((u @ p - model.lagrangian(t_b, x, u) - by_t)[None])
    # Where the end is given, nothing determines the impulse of the constraints there.
    of_multipliers = jnp.zeros_like(multipliers) if ends.kind == NATURAL else multipliers
    return jnp.concatenate([at_node, of_multipliers, *border])


def equations(model: Model, ends: Ends, path: Path) -> PathEquations:
    """The equations of a path and their derivatives."""
    count, s, size = path.y.shape
    rule, n = rule_of_degree(s), model.n
    nodes, (t, h) = path.nodes(ends), path.times(ends)
    r, matrix = jax.vmap(lambda t, h, nodes: momentum_matrix(model, rule, t, h, nodes))(t, h, nodes)

    def last(nodes: Array, border: Array) -> Array:
        moved = path._replace(border=border)
        t, h = moved.times(ends)
        x, t_b = nodes[-1, :n], ends.t_a + moved.duration(ends)
        u = rule.node_derivative[-1].astype(x.dtype) @ nodes[:, :n] / h[-1]
        p = jax.grad(model.lagrangian, argnums=2)(t_b, x, u) if ends.free_time and ends.kind != COMPLETE else u
        return end_rows(model, ends, t_b, x, u, nodes[-1, n:], p, border[: border.size - ends.free_time])

    at_end = last(nodes[-1], path.border)
    by_nodes, by_border = jax.jacfwd(last, argnums=(0, 1))(nodes[-1], path.border)
    columns = jnp.zeros((count, s, size, path.border.size), r.dtype)
    if ends.free_time:

        def of_duration(duration: Array) -> Array:
            t, h = path._replace(border=duration[None]).times(ends)
            missed = jax.vmap(lambda t, h, nodes: elements.residual(model, rule, t, h, nodes))(t, h, nodes)
            return jax.vmap(lambda h, missed: _weighted(rule, h, missed))(h, missed)

        by_duration = jax.jvp(of_duration, (path.border[-1],), (jnp.ones_like(path.border[-1]),))[1]
        columns = columns.at[..., -1].set(_assembled(by_duration))
    total, diagonal = _assembled(r), matrix[:, 1:, :, 1:, :]
    diagonal = diagonal.at[:-1, -1, :, -1, :].add(matrix[1:, 0, :, 0, :])
    before, after = matrix[1:, 1:, :, 0, :], matrix[1:, 0, :, 1:, :]
    keep = 1.0 if ends.kind == NATURAL else 0.0
    total = total.at[-1, -1].set(keep * total[-1, -1] + at_end[:size])
    diagonal = diagonal.at[-1, -1].set(keep * diagonal[-1, -1] + by_nodes[:size, 1:])
    if count > 1:
        before = before.at[-1, -1].set(keep * before[-1, -1] + by_nodes[:size, 0])
    columns = columns.at[-1, -1].set(keep * columns[-1, -1] + by_border[:size])
    flat = s * size
    return PathEquations(
        total.reshape(count, flat), at_end[size:], diagonal.reshape(count, flat, flat),
        before.reshape(count - 1, flat, size), after.reshape(count - 1, size, flat),
        columns.reshape(count, flat, path.border.size), by_nodes[size:], by_border[size:],
    )  # fmt: skip


def _assembled(r: Float[Array, "K s+1 N"]) -> Float[Array, "K s N"]:
    """The sum of both elements' parts at the nodes that they share."""
    return r[:, 1:].at[:-1, -1].add(r[1:, 0])


class Pivots(NamedTuple):
    """Δ of each group, and its inverse."""

    deltas: Float[Array, "K sN sN"]
    inverses: Float[Array, "K sN sN"]


def eliminated(found: PathEquations) -> Pivots:
    """The block elimination from the start to the end."""
    size = found.diagonal.shape[1] if found.before.shape[0] == 0 else found.before.shape[2]

    def next_group(above: Array, blocks: tuple):
        before, after, diagonal = blocks
        delta = diagonal - before @ above @ after
        inverted = dense.inverse(delta)
        return inverted[-size:, -size:], (delta, inverted)

    none = _padded_front(found.before), _padded_front(found.after), found.diagonal
    return Pivots(*lax.scan(next_group, jnp.zeros((size, size), found.r.dtype), none)[1])


def _padded_front(blocks: Array) -> Array:
    return jnp.concatenate([jnp.zeros((1, *blocks.shape[1:]), blocks.dtype), blocks])


class Solved(NamedTuple):
    """A solution, by groups and on the border; each with a column for each right-hand side."""

    y: Float[Array, "K sN c"]
    border: Float[Array, "b c"]


def solve(found: PathEquations, inverses: Float[Array, "K sN sN"], r: Float[Array, "K sN"], of_border: Array) -> Solved:
    """The step for residuals r, in the first column, and the response to a unit of each equation of the end."""
    size, b = found.before.shape[2], found.corner.shape[0]
    count, flat = r.shape
    units = jnp.zeros((count, flat, size), r.dtype).at[-1, -size:].set(jnp.eye(size, dtype=r.dtype))
    known = jnp.concatenate([r[..., None], units, jnp.zeros((count, flat, b), r.dtype), found.columns], axis=2)

    def forward(above: Array, blocks: tuple):
        before, inverted, known = blocks
        y = inverted @ (known - before @ above)
        return y[-size:], y

    first = jnp.zeros((size, known.shape[2]), r.dtype)
    _, w = lax.scan(forward, first, (_padded_front(found.before), inverses, known))

    def backward(below: Array, blocks: tuple):
        after, inverted, w = blocks
        y = w - inverted[:, -size:] @ (after @ below)
        return y, y

    after = jnp.concatenate([found.after, jnp.zeros((1, *found.after.shape[1:]), r.dtype)])
    _, y = lax.scan(backward, jnp.zeros_like(w[0]), (after, inverses, w), reverse=True)
    own, columns = y[..., : 1 + size + b], y[..., 1 + size + b :]
    if not b:
        return Solved(own, jnp.zeros((0, 1 + size), r.dtype))
    known = jnp.concatenate([of_border[:, None], jnp.zeros((b, size), r.dtype), jnp.eye(b, dtype=r.dtype)], axis=1)
    rows, last = found.rows.reshape(b, -1), jnp.concatenate([y[-2, -size:] if count > 1 else 0 * y[0, -size:], y[-1]])
    matrix = found.corner - rows @ last[:, 1 + size + b :]
    border = dense.inverse(matrix) @ (known - rows @ last[:, : 1 + size + b])
    return Solved(own - columns @ border, border)


# Newton's steps at most.
MOST = 30
# A step of this size, in units of the path's extent, ends the search; one below the second that is no longer reduced.
SMALL, SETTLED = 1e-13, 1e-9
# A path has converged whose last step is below this.
CONVERGED = 1e-7
# From this size on, in units of what the end changes, the next step is judged from the last two.
QUADRATIC = 1e-3
# The shortest part of a step that is tried.
SHORTEST = 2.0**-6


class FoundPath(NamedTuple):
    """A path after Newton's method.

    - `size`: the largest entry of the step after the last, in units of the path's extent, as far as it is known;
      `small`: what counts as zero, 1e-7 or more, where positions have fewer digits. `iterations`: the steps tried.
    - `deltas`: the pivots of the elimination; `response`: what a unit of each equation of the end changes.
    """

    path: Path
    size: Float[Array, ""]
    small: Float[Array, ""]
    iterations: Int[Array, ""]
    deltas: Float[Array, "K sN sN"]
    response: Solved

    @property
    def converged(self) -> Bool[Array, ""]:
        return self.size < self.small


class _Search(NamedTuple):
    path: Path
    solved: Solved
    deltas: Array
    size: Array
    next_size: Array
    share: Array
    iterations: Array
    going: Array


def extent(ends: Ends, path: Path) -> Float[Array, " n"]:
    """The size of each coordinate on a path; one that hardly moves has a thousandth of the largest."""
    x = path.nodes(ends)[..., : ends.x_a.size].reshape(-1, ends.x_a.size)
    moved = jnp.max(x, axis=0) - jnp.min(x, axis=0)
    moved = jnp.maximum(moved, 1e-3 * jnp.max(moved))
    floor = 1e3 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))
    return jnp.where(moved > floor, moved, jnp.maximum(jnp.max(jnp.abs(x), axis=0), 1.0))


def newton(model: Model, ends: Ends, start: Path, enough: ArrayLike = 0.0) -> FoundPath:
    """Newton's method, shortened where steps do not shrink, until the next one is smaller than `enough`: they shrink
    quadratically, s' = C s², so the one after s' is s' (s' / s)²."""
    n, scale = ends.x_a.size, extent(ends, start)
    eps = float(jnp.finfo(scale.dtype).eps)
    # Positions have round-off of their own size, which may be far above that of their differences.
    blur = 4 * eps * jnp.max(jnp.max(jnp.abs(start.nodes(ends)[..., :n]), axis=(0, 1)) / scale)
    small = jnp.maximum(jnp.maximum(SMALL, blur), enough)

    def after(path: Path, step: Solved, share: ArrayLike) -> Path:
        y = path.y - share * step.y[..., 0].reshape(start.y.shape)
        return path._replace(y=y, border=path.border - share * step.border[:, 0])

    def amplification(solved: Solved) -> Array:
        """What a change of the end becomes on the path; near a conjugate end much."""
        if ends.kind != FIXED:
            return jnp.ones_like(blur)
        units = solved.y[..., 1 : 1 + n].reshape(*start.y.shape, n)[:, :, :n]
        most = jnp.max(jnp.abs(units) * scale[None, None, None] / scale[None, None, :, None])
        return jnp.where(most > 1.0, most, 1.0)

    def amplified(solved: Solved) -> Array:
        """How much round-off becomes in a step."""
        return jnp.minimum(blur * amplification(solved), 1e-5)

    def size_of(solved: Solved) -> Array:
        x = solved.y[..., 0].reshape(start.y.shape)[..., :n]
        size = jnp.max(jnp.abs(x) / scale[None, None])
        size = jnp.maximum(size, jnp.abs(solved.border[-1, 0] / ends.duration)) if ends.free_time else size
        return jnp.where(jnp.isfinite(size), size, jnp.inf)

    def iterate(search: _Search) -> _Search:
        share = search.share
        trial = after(search.path, search.solved, share)
        found = equations(model, ends, trial)
        pivots = eliminated(found)
        solved = solve(found, pivots.inverses, found.r, found.of_border)
        size, first = size_of(solved), search.iterations == 0
        accepted = first | (size <= (1 - share / 4) * search.size) & jnp.isfinite(size)
        # At round-off steps no longer shrink: the trial is as good as what is there.
        settled = jnp.maximum(SETTLED, 1e3 * amplified(search.solved))
        at_round_off = (search.size < settled) & jnp.isfinite(size)
        accepted = accepted | at_round_off
        # Near a conjugate end the matrix itself is not known well enough before.
        quadratic = (share == 1.0) & (size * amplification(solved) < QUADRATIC)
        next_size = jnp.where(quadratic, size * (size / search.size) ** 2, size)
        ended = (
            accepted & (next_size <= small) | at_round_off & (size > 0.25 * search.size) | ~jnp.isfinite(size) & first
        )
        share = jnp.where(first, 1.0, jnp.where(accepted, jnp.minimum(1.0, 4 * share), share / 4))
        iterations = search.iterations + 1
        new = (trial, solved, pivots.deltas, size, next_size)
        kept = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, search[:5])
        return _Search(*kept, share, iterations, ~ended & (iterations < MOST) & (share > SHORTEST))

    nothing, zero = unfound(start), jnp.zeros((), scale.dtype)
    columns = jax.tree.map(lambda x: jnp.concatenate([x[..., :1], x], axis=-1), nothing.response)
    size = nothing.size
    search = _Search(start, columns, nothing.deltas, size, size, zero, jnp.zeros((), int), jnp.asarray(True))
    ended = lax.while_loop(lambda search: search.going, iterate, search)
    response = jax.tree.map(lambda x: x[..., 1:], ended.solved)
    zero_below = jnp.maximum(jnp.maximum(CONVERGED, 1e3 * amplified(ended.solved)), enough)
    last = jnp.where(ended.next_size < zero_below, 1.0, 0.0)
    return FoundPath(
        after(ended.path, ended.solved, last), ended.next_size, zero_below, ended.iterations, ended.deltas, response
    )


def unfound(start: Path) -> FoundPath:
    """What is known before Newton's method."""
    count, s, size = start.y.shape
    b, dtype, infinite = start.border.size, start.y.dtype, jnp.full((), jnp.inf, start.y.dtype)
    response = Solved(jnp.zeros((count, s * size, size + b), dtype), jnp.zeros((b, size + b), dtype))
    deltas = jnp.zeros((count, s * size, s * size), dtype)
    return FoundPath(start, infinite, 0 * infinite + CONVERGED, jnp.zeros((), int), deltas, response)


def states(ends: Ends, path: Path, t: Float[Array, " T"]) -> tuple[Float[Array, "T N"], Float[Array, "T n"]]:
    """Positions with multipliers, and velocities, at any times on the path."""
    rule, nodes = path.rule(), _with_end_multipliers(ends, path)
    slopes = jnp.einsum("kj,ejn->ekn", jnp.asarray(rule.node_derivative, nodes.dtype), nodes[..., : ends.x_a.size])
    i, length, inside = mesh.located(path.parts, (t - ends.t_a) / path.duration(ends))
    y, slope = (jnp.einsum("tj,tjn->tn", basis(rule.nodes, inside), values[i]) for values in (nodes, slopes))
    return y, slope / (length * path.duration(ends))[:, None]


def _with_end_multipliers(ends: Ends, path: Path) -> Float[Array, "K s+1 N"]:
    """All nodes; multipliers at given ends, which nothing determines, continued from the other nodes."""
    nodes, n = path.nodes(ends), ends.x_a.size
    if nodes.shape[2] == n:
        return nodes
    inner = path.rule().nodes[1:]
    weights = jnp.asarray(basis(inner, np.zeros(())), nodes.dtype)
    nodes = nodes.at[0, 0, n:].set(weights @ nodes[0, 1:, n:])
    if ends.kind == NATURAL:
        return nodes
    return nodes.at[-1, -1, n:].set(weights[::-1] @ nodes[-1, :-1, n:])


# Newton's steps onto the constraints for the nodes of a straight start.
ONTO = 60
# How often a path is solved for, the elements laid anew in between; how many parts of the way are tried at most, and
# the shortest. A path that is lost on other elements ends the search as well, after some tries: it is good enough.
ROUNDS, ATTEMPTS, SHORTEST_PART = 3, 24, 1e-2
# A path is followed where the highest coefficients on its elements are below this.
FINE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# Elements of the same number are laid anew for this part of it: a conjugate point is as good as the path.
LAID = 0.01
# A start ends elsewhere that misses the end by more than this part of its extent.
ELSEWHERE = 1e-6
# On the way, steps of this size are small enough.
ON_THE_WAY = 1e-4


def onto_constraints(model: Model, t: Array, x: Array) -> Array:
    """The point near x that satisfies the holonomic constraints, by Gauss and Newton's shortest steps."""

    def step(x: Array, _):
        g = constraints.position_residual(model, t, x)
        slope = jax.jacfwd(lambda x: constraints.position_residual(model, t, x))(x)
        return x - slope.T @ (dense.inverse(slope @ slope.T) @ g), None

    if not model.holonomic.any():
        return x
    near = lax.scan(step, x, None, ONTO)[0]
    return jnp.where(jnp.all(jnp.isfinite(near)), near, x)


def path_through(model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"]) -> Path:
    """The path through given nodes, moved onto the constraints."""
    m = int(model.holonomic.sum())
    nu = jnp.zeros(ends.border - ends.free_time, x.dtype)
    border = jnp.concatenate([nu, ends.duration[None]]) if ends.free_time else nu
    empty = Path(parts, x, border)
    t = ends.t_a + empty.duration(ends) * mesh.after_first(parts, x.shape[1])
    onto = jax.vmap(lambda t, x: onto_constraints(model, t, x))
    x = onto(t.ravel(), x.reshape(-1, x.shape[2])).reshape(x.shape)
    return empty._replace(y=jnp.concatenate([x, jnp.zeros((*x.shape[:2], m), x.dtype)], axis=2))


class Attempt(NamedTuple):
    """The last path that converged, for a part of the ends' distance and time, the errors of its elements; and the next
    part to try."""

    found: FoundPath
    errors: Float[Array, " K"]
    part: Float[Array, ""]
    step: Float[Array, ""]
    rounds: Int[Array, ""]
    attempts: Int[Array, ""]


def found_path(model: Model, ends: Ends, start: Path) -> Attempt:
    """Newton's method at once; where it fails, along the start from a short time to the whole one, since the shorter a
    motion is, the straighter it is; for a start with another end, such as a motion, over the whole time from its own
    end to the given one. Then on elements laid anew, where they do not follow the path."""
    n, fine = model.n, FINE.get(np.dtype(start.y.dtype), 1e-3)
    off = ends.x_b - start.y[-1, -1, :n] if ends.kind == FIXED else jnp.zeros_like(ends.x_b)
    elsewhere = jnp.any(jnp.abs(off) > ELSEWHERE * extent(ends, start))

    def attempt(last: Attempt) -> Attempt:
        there, path = last.part >= 1.0, last.found.path
        part = jnp.minimum(1.0, last.part + last.step)
        # Once there: the path itself on other elements. On the way: the start up to this part of its time.
        source = jax.tree.map(lambda a, b: jnp.where(there, a, b), path, start)
        parts = jnp.where(there, mesh.laid_anew(path.parts, path.errors(ends), path.y.shape[1]), path.parts)
        shares = mesh.after_first(parts, path.y.shape[1])
        reached = jnp.where(elsewhere, 1.0, part)
        known, _ = states(ends, source, ends.t_a + reached * source.duration(ends) * shares.ravel())
        known = known.reshape(path.y.shape)
        x_b = jnp.where(part >= 1.0, ends.x_b, known[-1, -1, :n] + part * off)
        aim = eqx.tree_at(lambda ends: (ends.x_b, ends.duration), ends, (x_b, reached * ends.duration))
        stretched = path.y[..., :n] + shares[..., None] * (x_b - path.y[-1, -1, :n])[None, None]
        x = jnp.where(there | (last.part == 0), known[..., :n], stretched)
        trial = path_through(model, aim, x, parts)
        y = trial.y.at[..., n:].set(jnp.where(there, known, path.y)[..., n:])
        trial = Path(parts, y, jnp.where(last.part > 0, path.border, trial.border))
        found = newton(model, aim, trial, jnp.where(part < 1.0, ON_THE_WAY, 0.0))
        well = found.converged
        kept = jax.tree.map(lambda a, b: jnp.where(well, a, b), found, last.found)
        step = jnp.where(well, 1.5 * last.step, last.step / 3)
        return Attempt(
            kept, kept.path.errors(ends), jnp.where(well, part, last.part), step,
            last.rounds + (well & (part >= 1.0)), last.attempts + 1,
        )  # fmt: skip

    def unfinished(last: Attempt):
        coarse = (last.rounds == 0) | (jnp.max(last.errors) > LAID * fine)
        return coarse & (last.rounds < ROUNDS) & (last.attempts < ATTEMPTS) & (last.step > SHORTEST_PART)

    zero, none = jnp.zeros_like(ends.duration), jnp.zeros((), int)
    first = Attempt(unfound(start), jnp.zeros_like(start.parts[1:]), zero, zero + 1, none, none)
    return lax.while_loop(unfinished, attempt, first)


@compiled
def halved(ends: Ends, path: Path) -> tuple[Float[Array, "K2 s n"], Float[Array, " K2+1"]]:
    """The nodes on elements of half the length, and where these meet."""
    parts = mesh.cut(path.parts)
    t = ends.t_a + path.duration(ends) * mesh.after_first(parts, path.y.shape[1])
    return path.at(ends, t.ravel()).reshape(*t.shape, -1), parts
