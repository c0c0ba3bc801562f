"""Where the search for a path begins: the straight line, random waves on it, or paths and motions that are given."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from lagjax.integrate import Trajectory
from lagjax.jaxtools import numpy_of
from lagjax.system import Model, coordinates
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import Ends

# Random waves on a straight start, in units of its length.
WAVES, AMPLITUDES = 3, (1.0, 0.5, 0.25)


class PathGuess(NamedTuple):
    """A start by name: a path q(t), a motion, or the waves (w, n) on the straight line; None for the line itself."""

    name: str
    path: Any = None


# How many starts, or which ones.
Starts = int | Callable | Trajectory | Sequence[Callable | Trajectory | PathGuess]


def guesses_of(model: Model, starts: Starts) -> list[PathGuess]:
    """The starts that are asked for."""
    if callable(starts) or isinstance(starts, Trajectory):
        return [PathGuess("the given path", starts)]
    if not isinstance(starts, int):
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
    size = xp.max(xp.abs(x_b - x_a))
    size = xp.where(size > 0, size, xp.maximum(xp.max(xp.abs(x_a)), 1.0))
    shape = np.sin(np.pi * at[..., None] * np.arange(1, WAVES + 1))
    return x + size * (shape @ guess.path).astype(dtype), parts
