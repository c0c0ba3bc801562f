"""Where the search for a path begins: the straight line, random waves on it, or paths and motions that are given."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.interpolate import CubicHermiteSpline

from lagjax.integrate import Trajectory
from lagjax.jaxtools import compiled, numpy_of
from lagjax.system import Model, coordinates
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import Ends

# The degree of elements.
DEGREE = 8
# Random waves on a straight start, in units of each coordinate's size.
WAVES, AMPLITUDES = 3, (1.0, 0.5, 0.25)
# Where along the straight line masses and forces are looked at; a change by which L shows what it depends on.
PLACES, ELSEWHERE = np.array([0.1, 0.37, 0.61, 0.93]), 1.3
TURN = 2 * np.pi


class Nodes(NamedTuple):
    """The nodes (K, s, n) of elements of equal length."""

    x: np.ndarray


class PathGuess(NamedTuple):
    """A start by name: a path q(t), a motion, nodes, or the waves (w, n) on the straight line; None for the line."""

    name: str
    path: Any = None


# How many starts, or which ones.
Starts = int | Callable | Trajectory | Sequence[Callable | Trajectory | PathGuess]


def guesses_of(model: Model, starts: Starts) -> list[PathGuess]:
    """The starts that are asked for."""
    if callable(starts) or isinstance(starts, Trajectory):
        return [PathGuess("the given path", starts)]
    if not isinstance(starts, int | np.integer | Sequence):
        raise TypeError(
            f"starts is a number of starts, a path q(t), a motion of integrate, or a list of these, not "
            f"{type(starts).__name__}.\nFix: starts=8."
        )
    if not isinstance(starts, int | np.integer):
        named = enumerate(starts, start=1)
        return [start if isinstance(start, PathGuess) else PathGuess(f"given path {i}", start) for i, start in named]
    if starts < 1:
        raise ValueError(f"starts={starts}: there must be one at least.\nFix: starts=1, the straight line.")
    random = np.random.default_rng(0)
    falling = 1 / np.arange(1, WAVES + 1)[:, None]
    waves = [AMPLITUDES[i % 3] * falling * random.normal(size=(WAVES, model.n)) for i in range(starts - 1)]
    return [PathGuess("straight line"), *(PathGuess(f"random start {i + 1}", wave) for i, wave in enumerate(waves))]


def nodes_of(model: Model, ends: Ends, guess: PathGuess, count: int, degree: int):
    """The nodes (K, s, n) of a start, and where its elements meet."""
    xp, dtype = numpy_of((ends.x_a, ends.x_b, ends.duration)), ends.x_a.dtype
    parts = np.linspace(0.0, 1.0, count + 1)
    at = parts[:-1, None] + np.diff(parts)[:, None] * rule_of_degree(degree).nodes[1:]
    parts = parts.astype(dtype)
    if isinstance(guess.path, Nodes):
        return guess.path.x.astype(dtype), parts
    if isinstance(guess.path, Trajectory):
        motion = guess.path
        known = CubicHermiteSpline(motion.t, *(np.asarray(x) for x in jax.vmap(model.vectors)(motion.q, motion.v)))
        return known(np.asarray(ends.t_a + ends.duration * at)).astype(dtype), parts
    if callable(guess.path):
        t = ends.t_a + ends.duration * at.astype(dtype)
        return jax.vmap(jax.vmap(lambda t: model.vector(coordinates.as_floats(guess.path(t)))))(t), parts
    x_a, x_b = xp.asarray(ends.x_a), xp.asarray(ends.x_b)
    x = x_a[None, None] + at.astype(dtype)[..., None] * (x_b - x_a)[None, None]
    if guess.path is None:
        return x, parts
    shape = np.sin(np.pi * at[..., None] * np.arange(1, WAVES + 1))
    return x + (sizes_of(model, ends).sizes * (shape @ guess.path)).astype(dtype), parts


class Sizes(NamedTuple):
    """How far each coordinate may go (n,), and the mass matrix (n, n) that makes them comparable."""

    sizes: np.ndarray
    mass: np.ndarray


def sizes_of(model: Model, ends: Ends) -> Sizes:
    """The sizes of waves: that of the straight line in kinetic energy, D = √(Δᵀ M Δ), is D / √M_ii in each coordinate.

    Where forces lead farther in the time, D is the length that they lead, but no more than that of the coordinates
    themselves. An angle on whose turns by 2π L depends, and not on whole ones, has the size π.
    """
    masses, forces, steps = (np.asarray(x, float) for x in _probed(model, ends))
    x_a, x_b, time = (np.asarray(x, float) for x in (ends.x_a, ends.x_b, ends.duration))
    finite = np.all(np.isfinite(masses), axis=(1, 2))
    mass = np.mean(masses[finite], axis=0) if finite.any() else np.eye(len(x_a))
    diagonal = np.diag(mass)
    diagonal = np.where(diagonal > 0, diagonal, max(np.max(diagonal), 0.0) or 1.0)
    roots = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh((mass + mass.T) / 2 / roots[:, None] / roots[None])
    # A massless coordinate is moved like the others.
    mass = (vectors * np.maximum(values, 1e-3)) @ vectors.T * roots[:, None] * roots[None]
    length = np.linalg.norm(roots * (x_b - x_a))
    with np.errstate(all="ignore"):
        forced = np.nanmax(np.where(np.isfinite(forces), np.abs(forces), 0.0) / roots, axis=0) * time**2 / 8
    largest = np.maximum(np.abs(x_a), np.abs(x_b)) * roots
    length = max(length, np.max(np.minimum(forced, largest)))
    length = length or np.max(largest) or float(np.max(roots))
    whole, elsewhere = np.max(np.abs(steps), axis=1)
    turns = np.isfinite(elsewhere) & (elsewhere > 0) & (whole <= 1e-6 * elsewhere)
    return Sizes(np.where(turns, TURN / 2, length / roots), mass)


@compiled
def _probed(model: Model, ends: Ends):
    """Masses and forces on the straight line; by how much L changes with a turn of each coordinate, and elsewhere."""
    u = (ends.x_b - ends.x_a) / ends.duration
    more = jnp.asarray([TURN, ELSEWHERE], u.dtype)[:, None, None] * jnp.eye(len(u), dtype=u.dtype)[None]

    def at(share: Array):
        t, x = ends.t_a + share * ends.duration, ends.x_a + share * (ends.x_b - ends.x_a)
        mass = jax.jacfwd(jax.grad(model.lagrangian, argnums=2), argnums=2)(t, x, u)
        # A speed that no coordinate lacks, so that an angle on which inertias depend counts.
        fast = u + 1.0 / ends.duration
        value = jax.vmap(jax.vmap(lambda d: model.lagrangian(t, x + d, fast)))(more)
        return mass, jax.grad(model.lagrangian, argnums=1)(t, x, u), value - model.lagrangian(t, x, fast)

    masses, forces, steps = jax.vmap(at)(jnp.asarray(PLACES, u.dtype))
    return masses, forces, jnp.moveaxis(steps, 0, 1)
