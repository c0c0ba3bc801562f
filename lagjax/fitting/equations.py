"""The equations that a fit solves: what the motion says against what was measured, window by window.

    r = (predicted - measured) / sigma        at each measured number,
    d = (end of window w - start of window w + 1) times a weight, where windows are joined,
    h = (x - mean) / sd                       for what is known of the parameters before.

Where a motion does not reach a sample its residual is a large constant, so that a bad guess still has a cost.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from lagjax.fitting.parameters import Found, leaf_name
from lagjax.fitting.records import PADDING, Windows
from lagjax.fitting.starts import Starts
from lagjax.mechanics.compiled import compiled
from lagjax.motion.integrate import integrate
from lagjax.motion.results import ended_well
from lagjax.numerics.chained import Equations, Slopes, Unknowns

# A sample that is not reached counts as missed by this many spreads of its data.
NOT_REACHED = 10.0
# A wild guess may be stiff: steps that a motion may take, for each output and besides.
STEPS_EACH, STEPS = 16, 10_000
# The scale (in sigmas) for 95 % efficiency with normal errors, and the loss over the square of a scaled residual.
LOSSES = {
    "squares": (1.0, lambda z2: jnp.ones_like(z2)),
    "soft_l1": (1.345, lambda z2: 2 / (1 + jnp.sqrt(1 + z2))),
    "huber": (1.345, lambda z2: jnp.where(z2 > 1, (2 * jnp.sqrt(jnp.maximum(z2, 1)) - 1) / jnp.maximum(z2, 1), 1.0)),
    "cauchy": (2.385, lambda z2: jnp.where(z2 > 1e-6, jnp.log1p(z2) / jnp.maximum(z2, 1e-6), 1 - z2 / 2)),
}


class Stage(NamedTuple):
    """How a search takes the data: the part of each window's time that counts (W,), how tightly windows are joined, and
    the size of an ordinary error, in sigmas, for a loss that forgives larger ones.

    While only a part counts, shared unknowns are held `around` (p,) the place where the search began: there a change
    by all of a number costs `held`, in units of a residual.
    """

    part: Float[Array, "*W"]
    joined: Float[Array, ""]
    ordinary: Float[Array, ""]
    held: Float[Array, ""] | None = None
    around: Float[Array, " p"] | None = None


# All of the record, windows on their own.
WHOLE = Stage(np.asarray(1.0), np.asarray(0.0), np.asarray(1.0))


# Modules of equinox take half a millisecond of each fit, by what they do when one is made or asked for a method.
@jtu.register_dataclass
@dataclass(frozen=True, eq=False)
class Problem:
    """All that a fit is about, as arrays of one shape for all windows.

    `measured` and `sigma` have leaves (W, T, ...), those of `end` (W, ...); `spread` has one number each, and
    `spread_in_sigmas` is the largest over its sigma. `unit` is the spread of the starts. `absolute`: sigmas were given.
    """

    system: Any
    # What holds at the starts: of a motion in phases the first of them.
    first: Any
    found: Found
    overrides: dict[str, Array]
    windows: Windows
    starts: Starts
    measured: PyTree
    sigma: PyTree
    spread: PyTree
    spread_in_sigmas: Float[Array, ""]
    unit: Float[Array, " 2n"]
    unflatten: Callable = field(metadata={"static": True})
    observe: Callable | None
    options: dict[str, Any]
    loss: str = field(metadata={"static": True})
    absolute: bool = field(metadata={"static": True})

    @property
    def start(self) -> Unknowns:
        """Where the search starts, in natural numbers."""
        return Unknowns(self.found.start, np.zeros((self.windows.count, self.starts.unknowns)))

    @property
    def data(self) -> tuple[PyTree, PyTree]:
        """Measurements and their sigmas."""
        return self.measured, self.sigma

    def params(self, x, w) -> PyTree:
        """The parameters of window w."""
        params = self.found.into(x)
        if not self.overrides:
            return params
        return replace(params, {name: value[w] for name, value in self.overrides.items()})

    def part(self, w, stage: Stage) -> Float[Array, ""]:
        """The part of window w that counts."""
        return jnp.broadcast_to(stage.part, (self.windows.count,))[w]

    def setting(self, x, s, w, stage: Stage):
        """Times, parameters, start and options of the motion of window w, at its times as far as they count."""
        ts = _as_far_as(jnp.asarray(self.windows.ts)[w], jnp.asarray(self.windows.last)[w], self.part(w, stage))
        return ts, self.params(x, w), self.state(x, s, w), self.options

    def state(self, x, s, w):
        """(q, v) from which the motion of window w starts."""
        of_window, t = jax.tree.map(lambda a: a[w], self.starts), jnp.asarray(self.windows.ts)[w, 0]
        return of_window.state(s, self.first, t, self.params(x, w), self.unflatten)

    def motion(self, x, s, w, stage: Stage, adjoint=None):
        """The motion of window w, and the state it starts from."""
        ts, params, (q, v), options = self.setting(x, s, w, stage)
        options = {"max_steps": STEPS_EACH * ts.shape[0] + STEPS, "adjoint": adjoint} | options
        return integrate(self.system, q, v, params, ts=ts, throw=False, **options), (q, v)

    def said(self, motion) -> dict[str, PyTree]:
        """All that can be measured of a motion."""
        said = {"q": motion.q, "v": motion.v, "multipliers": motion.multipliers, "end": motion.end._asdict()}
        observe = self.observe
        if observe is not None:
            at = lambda t, q, v: observe(t, q, v, motion.params)
            said["observed"] = jax.vmap(at)(motion.t, motion.q, motion.v)
        return said

    def predicted(self, motion) -> dict[str, PyTree]:
        """What of a motion was measured, in the structure of the measurements."""
        return among(self.said(motion), self.measured)


def among(said: PyTree, wanted: PyTree) -> PyTree:
    """The parts of `said` that `wanted` has: of dictionaries some of the keys."""
    if isinstance(wanted, dict) and isinstance(said, dict):
        return {name: among(said[name], part) for name, part in wanted.items()}
    return said


@partial(compiled, in_numpy=True)
def starts_at(problem: Problem, u: Unknowns, windows: Int[Array, " R"]):
    """(q, v) at the starts of some windows, and their slopes by the shared unknowns and those of each window."""
    p = u.shared.size

    def at(w):
        state = lambda both: problem.state(both[:p], both[p:], w)
        both = jnp.concatenate([u.shared, u.local[w]])
        return state(both), jax.jacfwd(state)(both)

    return jax.vmap(at)(windows)


def replace(params, values):
    """`params` with some leaves replaced, by name; those of inner dictionaries by 'arm.length'."""
    return jtu.tree_map_with_path(lambda path, x: values.get(leaf_name(path), x), params)


class OfWindow(NamedTuple):
    """What one window contributes: residuals of its samples, the state it starts from, and the state it ends in."""

    rows: Float[Array, " m"]
    begin: Float[Array, " 2n"]
    end: Float[Array, " 2n"]


def of_window(problem: Problem, x, s, w, stage: Stage, adjoint=None, loss: str | None = None):
    """What window `w` contributes at shared and own unknowns in natural numbers, and whether its motion ended well."""
    motion, start = problem.motion(x, s, w, stage, adjoint)
    rows = residuals(problem, motion, w, stage, problem.loss if loss is None else loss)
    well = ended_well(motion.result)
    joined = lambda tree: jnp.concatenate([jnp.ravel(y) for y in jax.tree.leaves(tree)])
    if problem.windows.count == 1:
        nothing = jnp.zeros(0, rows.dtype)
        return OfWindow(rows, nothing, nothing), well
    last = problem.windows.last[w]
    end = joined(jax.tree.map(lambda y: y[last], (motion.q, motion.v)))
    reached = jnp.isfinite(end)
    return OfWindow(rows, joined(start) / problem.unit, jnp.where(reached, end, NOT_REACHED) / problem.unit), well


def together(problem: Problem, u: Unknowns, parts: OfWindow, stage: Stage) -> Equations:
    """All equations, from what the windows contribute (leading axis W)."""
    gap = jnp.where(_seamed(problem, stage) > 0, parts.end - jnp.roll(parts.begin, -1, axis=0), 0.0)
    known, weight = known_before(problem, stage)
    return Equations(parts.rows, _seamed(problem, stage) * gap, weight * (u.shared - known))


def slopes_together(problem: Problem, by_shared: OfWindow, by_local: OfWindow, stage: Stage) -> Slopes:
    """The slopes of all equations from those of the windows' contributions, (W, ..., p) and (W, ..., k)."""
    seamed = _seamed(problem, stage)[:, :, None]
    following = lambda x: jnp.roll(x, -1, axis=0)
    return Slopes(
        by_shared.rows,
        by_local.rows,
        seamed * (by_shared.end - following(by_shared.begin)),
        seamed * by_local.end,
        -seamed * following(by_local.begin),
        jnp.diag(known_before(problem, stage)[1]),
    )


def known_before(problem, stage):
    """What is known of the shared unknowns before the data: a mean, and the inverse of its standard deviation.

    A prior and a hold are two squares of one unknown, which are one square and a constant.
    """
    found = problem.found
    if stage.around is None:
        return found.mean, 1 / found.sd
    held = hold(problem, stage) ** 2
    both = 1 / found.sd**2 + held
    mean = (found.mean / found.sd**2 + held * stage.around) / jnp.where(both > 0, both, 1.0)
    return mean, jnp.sqrt(both)


def hold(problem, stage):
    """What a change of each shared unknown costs by the hold; one guessed to be 0 has no size to be held by."""
    start = problem.found.start
    if stage.held is None:
        return jnp.zeros_like(start)
    return jnp.where(start != 0, stage.held / jnp.abs(jnp.where(start != 0, start, 1.0)), 0.0)


def _seamed(problem, stage):
    return jnp.where(problem.windows.seam, stage.joined, 0.0)[:, None]


def equations(problem: Problem, u: Unknowns, stage: Stage) -> Equations:
    """The residuals at unknowns in natural numbers, in units of their sigmas."""
    # NumPy's arrays cannot be indexed by a window's traced number.
    live, static = eqx.partition(problem, eqx.is_array)
    problem = eqx.combine(jax.tree.map(jnp.asarray, live), static)
    parts = over_windows(lambda w, s: of_window(problem, u.shared, s, w, stage)[0], problem, u)
    return together(problem, u, parts, stage)


def over_windows(function: Callable, problem: Problem, u: Unknowns):
    """`function(w, s)` of every window."""
    if problem.windows.count == 1:
        return jax.tree.map(lambda x: x[None], function(0, u.local[0]))
    return one_by_one(lambda x: function(*x), (jnp.arange(problem.windows.count), u.local))


def one_by_one(function: Callable, xs):
    """`jax.vmap(function)(xs)`; on a CPU one after the other, which compiles and runs faster than lanes."""
    return lax.map(function, xs) if jax.default_backend() == "cpu" else jax.vmap(function)(xs)


def residuals(problem, motion, w, stage, loss):
    """The residuals of one window in one vector; zero where nothing was measured or does not count yet."""
    last = problem.windows.last[w]
    part = problem.part(w, stage)
    counts = _counts(problem.windows.ts[w], last, part)
    predicted = problem.predicted(motion)
    parts = []
    for kind, tree in problem.measured.items():
        told = zip(*(jax.tree.leaves(part) for part in (tree, problem.sigma[kind], problem.spread[kind])))
        for says, (measured, sigma, spread) in zip(jax.tree.leaves(predicted[kind]), told):
            measured, sigma = measured[w], sigma[w]
            known = jnp.isfinite(measured) & jnp.isfinite(sigma)
            if kind == "end":
                known = known & (part >= 1)
            else:
                known = known & counts.reshape(-1, *(1,) * (measured.ndim - 1))
            sigma = jnp.where(known, sigma, 1.0)
            r = jnp.where(known, (says - jnp.where(known, measured, 0.0)) / sigma, 0.0)
            r = jnp.where(jnp.isfinite(r), r, NOT_REACHED * spread / sigma)
            parts.append(jnp.ravel(dampened(r, loss, stage.ordinary)))
    return jnp.concatenate(parts)


def dampened(r, loss, ordinary=1.0):
    """A residual whose square is the loss, where an ordinary one has this size."""
    constant, ratio = LOSSES[loss]
    return r * jnp.sqrt(ratio((r / (constant * ordinary)) ** 2))


def _counts(t, last, part):
    """Which times count; of the whole the last one does, too, which rounding might leave out."""
    return t <= jnp.where(part < 1, t[0] + part * (t[last] - t[0]), t[last])


def _as_far_as(t, last, part):
    """Times of which those beyond a part of the window follow each other closely: they are not wanted."""
    kept = jnp.sum(_counts(t, last, part))
    closest = jnp.maximum(PADDING * (t[1] - t[0]), 8 * jnp.finfo(t.dtype).eps * jnp.max(jnp.abs(t)))
    beyond = jnp.arange(t.shape[0]) - (kept - 1)
    return jnp.where(beyond <= 0, t, t[kept - 1] + beyond * closest)
