"""The elements of a path: where they meet, how good they are, the path between their nodes, its second variation.

The size of the highest Legendre coefficient of a path on an element, c_s, says how well the polynomial follows it:
it falls as h^s. Elements are laid anew so that it is the same on all, by the density (|c_s|)^(1/s) / h.

Source: Ascher, Mattheij & Russell, *Numerical Solution of Boundary Value Problems for ODEs* (1995), §9.2.

**The second variation** along a path: its index, and the conjugate points.

The matrix of Newton's method is the second variation of the discrete action, bordered by the constraints. Eliminated
from the start, its pivots Δ have together as many negative eigenvalues as the matrix (Haynsworth), one for each
constraint equation, and one for each direction in which the action has a maximum. With the end fixed at a node, this is
the Morse index of the path up to there: the number of conjugate points before, with their multiplicities.

Between two nodes where the index grows, the path is cut at a time inside the element, and the time bisected.

Source: Milnor, *Morse Theory*, §15; Haynsworth, *Linear Algebra Appl.* 1 (1968) 73.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.polynomial import legendre

from lagjax.jaxtools import compiled, numpy_of, once
from lagjax.numerics import dense, lapack
from lagjax.system import Model, constraints
from lagjax.two_points.elements import lagrange, rule_of_degree
from lagjax.two_points.path import FIXED, NATURAL, Ends, FoundPath, Path, extent, momentum_matrix, newton, unfound

# An element is at most so many times longer than the mean would have it.
EVEN = 0.2
# Newton's steps onto the constraints for the nodes of a straight start.
ONTO = 60
# How often a path is solved for, the elements laid anew in between; how many parts of the way are tried at most, and
# the shortest. A path that is lost on other elements ends the search as well, after some tries: it is good enough.
ROUNDS, ATTEMPTS, SHORTEST = 3, 24, 1e-2
# A path is followed where the highest coefficients on its elements are below this.
FINE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# Elements of the same number are laid anew for this part of it: a conjugate point is as good as the path.
LAID = 0.01
# A start ends elsewhere that misses the end by more than this part of its extent.
ELSEWHERE = 1e-6
# On the way, steps of this size are small enough.
ON_THE_WAY = 1e-4


@once
def _to_coefficients(s: int) -> np.ndarray:
    """From values at an element's nodes to Legendre coefficients."""
    return np.linalg.inv(legendre.legvander(2 * rule_of_degree(s).nodes - 1, s))


def errors(ends: Ends, path: Path) -> Float[Array, " K"]:
    """The highest coefficient on each element, in units of the path's extent."""
    n, s = ends.x_a.size, path.y.shape[1]
    highest = jnp.asarray(_to_coefficients(s)[-1], path.y.dtype)
    c = jnp.einsum("j,kjn->kn", highest, path.nodes(ends)[..., :n])
    return jnp.max(jnp.abs(c) / extent(ends, path)[None], axis=1)


def states(ends: Ends, path: Path, t: Float[Array, " T"]) -> tuple[Float[Array, "T N"], Float[Array, "T n"]]:
    """Positions with multipliers, and velocities, at any times on the path."""
    n, s, dtype = ends.x_a.size, path.y.shape[1], path.y.dtype
    part = (t - ends.t_a) / path.duration(ends)
    i = jnp.clip(jnp.searchsorted(path.parts, part, side="right") - 1, 0, len(path.parts) - 2)
    h = jnp.diff(path.parts)[i]
    basis = _basis(s, (part - path.parts[i]) / h)
    nodes = _with_end_multipliers(ends, path)
    slopes = jnp.einsum("kj,ejn->ekn", jnp.asarray(rule_of_degree(s).node_derivative, dtype), nodes[..., :n])
    y, slope = (jnp.einsum("tj,tjn->tn", basis, values[i]) for values in (nodes, slopes))
    return y, slope / (h * path.duration(ends))[:, None]


def positions(ends: Ends, path: Path, t: Float[Array, " T"]) -> Float[Array, "T n"]:
    """The positions alone, in NumPy where all is known."""
    xp, n = numpy_of((ends, path, t)), ends.x_a.size
    y, parts, x_a = (xp.asarray(x) for x in (path.y[..., :n], path.parts, ends.x_a))
    before = xp.concatenate([x_a[None], y[:-1, -1]])
    nodes = xp.concatenate([before[:, None], y], axis=1)
    part = (xp.asarray(t) - xp.asarray(ends.t_a)) / xp.asarray(path.duration(ends))
    i = xp.clip(xp.searchsorted(parts, part, side="right") - 1, 0, len(parts) - 2)
    return xp.einsum("tj,tjn->tn", _basis(y.shape[1], (part - parts[i]) / xp.diff(parts)[i]), nodes[i])


def _basis(s: int, at: Float[Array, " T"]) -> Float[Array, "T s+1"]:
    """Lagrange's polynomials of an element's nodes at points of it."""
    nodes, xp = rule_of_degree(s).nodes, numpy_of(at)
    apart = nodes[:, None] - nodes[None] + np.eye(s + 1)
    factors = xp.where(np.eye(s + 1, dtype=bool)[None], 1.0, (at[:, None, None] - nodes[None, None]) / apart[None])
    return xp.prod(factors, axis=2).astype(at.dtype)


def _with_end_multipliers(ends: Ends, path: Path) -> Float[Array, "K s+1 N"]:
    """All nodes; multipliers at given ends, which nothing determines, continued from the other nodes."""
    nodes, n = path.nodes(ends), ends.x_a.size
    if nodes.shape[2] == n:
        return nodes
    weights = jnp.asarray(_continuation(path.y.shape[1]), nodes.dtype)
    nodes = nodes.at[0, 0, n:].set(weights @ nodes[0, 1:, n:])
    if ends.kind == NATURAL:
        return nodes
    return nodes.at[-1, -1, n:].set(weights[::-1] @ nodes[-1, :-1, n:])


@once
def _continuation(s: int) -> np.ndarray:
    """The weights of all nodes but the first in the polynomial through them, at the first."""
    nodes = rule_of_degree(s).nodes
    return lagrange(nodes[1:], nodes[:1])[0][0]


def node_times(ends: Ends, path: Path) -> Float[Array, "K s"]:
    """The times of all nodes but the first."""
    t, h = path.times(ends)
    nodes = rule_of_degree(path.y.shape[1]).nodes[1:].astype(path.y.dtype)
    return t[:, None] + h[:, None] * nodes[None]


def parts_anew(ends: Ends, path: Path) -> Float[Array, " K+1"]:
    """Where elements of equal quality meet."""
    s, dtype = path.y.shape[1], path.y.dtype
    width = jnp.diff(path.parts)
    density = jnp.maximum(errors(ends, path), jnp.finfo(dtype).eps) ** (1 / s) / width
    density = jnp.maximum(density, EVEN * jnp.sum(density * width))
    whole = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(density * width)])
    parts = jnp.interp(jnp.linspace(0.0, 1.0, len(whole), dtype=dtype) * whole[-1], whole, path.parts)
    return parts.at[0].set(0.0).at[-1].set(1.0)


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
    onto = jax.vmap(lambda t, x: onto_constraints(model, t, x))
    x = onto(node_times(ends, empty).ravel(), x.reshape(-1, x.shape[2])).reshape(x.shape)
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
        parts = jnp.where(there, parts_anew(ends, path), path.parts)
        shares = (node_times(ends, path._replace(parts=parts)) - ends.t_a) / path.duration(ends)
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
            kept, errors(ends, kept.path), jnp.where(well, part, last.part), step,
            last.rounds + (well & (part >= 1.0)), last.attempts + 1,
        )  # fmt: skip

    def unfinished(last: Attempt):
        coarse = (last.rounds == 0) | (jnp.max(last.errors) > LAID * fine)
        return coarse & (last.rounds < ROUNDS) & (last.attempts < ATTEMPTS) & (last.step > SHORTEST)

    zero, none = jnp.zeros_like(ends.duration), jnp.zeros((), int)
    first = Attempt(unfound(start), jnp.zeros_like(start.parts[1:]), zero, zero + 1, none, none)
    return lax.while_loop(unfinished, attempt, first)


@compiled
def halved(ends: Ends, path: Path) -> tuple[Float[Array, "K2 s n"], Float[Array, " K2+1"]]:
    """The nodes on elements of half the length, and where these meet."""
    middles = (path.parts[:-1] + path.parts[1:]) / 2
    finer = path._replace(parts=jnp.sort(jnp.concatenate([path.parts, middles])))
    x, _ = states(ends, path, node_times(ends, finer).ravel())
    return x[:, : ends.x_a.size].reshape(len(middles) * 2, path.y.shape[1], -1), finer.parts


BISECTIONS = 52
# Scalings of rows and columns; each brings their largest entries nearer to one, by a square root (Ruiz).
SCALINGS = 4


def index_at_nodes(model: Model, found: FoundPath, free_end: bool) -> Int[Array, " K"]:
    """The index of the path up to the end of each element, that end fixed; the last one free altogether if so."""
    count, s, size = found.path.y.shape
    m, inner = size - model.n, (s - 1) * size
    # The last node is an end: a maximum in its directions would be one of others, so they have none.
    fixed = np.arange(s * size) >= inner
    cut = jnp.where((fixed[:, None] | fixed)[None], np.eye(s * size, dtype=found.deltas.dtype)[None], found.deltas)
    whole, cut = jax.vmap(_negative)(jnp.concatenate([found.deltas, cut])).reshape(2, count)
    whole, cut = whole - s * m, cut - (s - 1) * m
    cut = cut.at[-1].set(whole[-1]) if free_end else cut
    return jnp.concatenate([jnp.zeros(1, whole.dtype), jnp.cumsum(whole)[:-1]]) + cut


def _negative(matrix: Array) -> Array:
    return jnp.sum(_eigenvalues(_evened(matrix, jnp)) < 0)


def _evened(matrix, xp=np):
    """The symmetric part, with rows and columns scaled alike until their largest entries are one: the signs of its
    eigenvalues are the same (Sylvester), and those of constraints, in other units, are no longer round-off."""
    matrix = (matrix + matrix.T) / 2
    for _ in range(SCALINGS):
        scale = xp.sqrt(xp.max(xp.abs(matrix), axis=0))
        scale = xp.where(scale > 0, scale, 1.0)
        matrix = matrix / scale[:, None] / scale[None]
    return matrix


@lapack.one_by_one
def _eigenvalues(matrix: Array):
    # LAPACK may not return if the matrix is not finite.
    return jnp.linalg.eigvalsh(jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0))


def conjugate_times(model: Model, ends: Ends, found: FoundPath, index: np.ndarray) -> Float[np.ndarray, " c"]:
    """The times of the points conjugate to the start, each as often as its multiplicity; the end itself left out."""
    times, before = [], 0
    for element, after in enumerate(index):
        times += [_bisected(model, ends, found, element, wanted) for wanted in range(before + 1, int(after) + 1)]
        before = max(before, int(after))
    return np.array(times, np.asarray(ends.t_a).dtype)


def _bisected(model: Model, ends: Ends, found: FoundPath, element: int, wanted: int) -> float:
    """The time inside an element at which the index reaches a number."""
    s, size = found.path.y.shape[1:]
    deltas, m = np.asarray(found.deltas), size - model.n
    earlier = sum(int(np.sum(np.linalg.eigvalsh(_evened(d)) < 0)) - s * m for d in deltas[: max(element - 1, 0)])
    t, h = (float(x[element]) for x in found.path.times(ends))

    def index(part: float) -> int:
        # As arrays: a program is compiled for each Python number.
        at = np.asarray(element), np.asarray(part, deltas.dtype)
        whole, cut = (np.asarray(x) for x in _matrices(model, ends, found.path, *at))
        if element:
            matrix = np.zeros((2 * s * size - size,) * 2, cut.dtype)
            matrix[: s * size, : s * size] = deltas[element - 1]
            first = (s - 1) * size
            matrix[first : s * size, first : s * size] -= whole[:size, :size]
            matrix[first:, first:] += cut[:-size, :-size]
            rows = (2 * s - 1) * m
        else:
            matrix, rows = cut[size:-size, size:-size], (s - 1) * m
        return earlier + int(np.sum(np.linalg.eigvalsh(_evened(matrix)) < 0)) - rows

    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if index(middle) >= wanted else (middle, high)
    return t + h * high


@compiled
def _matrices(model: Model, ends: Ends, path: Path, element: Array, part: Array):
    """The second variation of an element and of a part of it, ((s + 1) N, (s + 1) N) each."""
    rule, (t, h) = rule_of_degree(path.y.shape[1]), path.times(ends)
    t, h, size = t[element], h[element], path.y.shape[2] * (path.y.shape[1] + 1)

    def of_part(part: Array) -> Array:
        nodes, _ = states(ends, path, t + part * h * rule.nodes)
        return momentum_matrix(model, rule, t, part * h, nodes)[1].reshape(size, size)

    return jax.vmap(of_part)(jnp.stack([jnp.ones_like(part), part]))
