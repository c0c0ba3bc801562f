"""The equations that a fit solves, the predicted against the measured values; whether a motion can be compared.

    r = (predicted - measured) / sigma        at each measured number,
    d = (end of window w - start of window w + 1) times a weight, where windows are joined,
    h = (x - mean) / sd                       for the priors of the parameters.

If a motion does not reach a sample, the residual is a large constant, so that a bad guess still has a cost.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.fit.records import PADDING, Windows, channel_name
from lagjax.fit.unknowns import FreeNumbers, Starts, leaf_name
from lagjax.integrate import Trajectory, ended_well, integrate
from lagjax.jaxtools import compiled
from lagjax.numerics import Slopes, Unknowns, WindowedEquations
from lagjax.refusals import must_name
from lagjax.system import model_of

# The residual of a sample that the motion does not reach, in spreads of its data.
NOT_REACHED = 10.0
# The largest number of steps of a motion, per output and in addition: a bad guess may make the motion stiff.
STEPS_EACH, STEPS = 16, 10_000
# The cost of a jump between joined windows, stage by stage, relative to the cost of an equal distance from the data.
# (With larger weights the round-off of chaotic motions in the jumps keeps a search from converging.)
JOINING = (0.1, 1.0, 10.0, 100.0, 1e3)
# The scale (in sigmas) for 95 % efficiency with normal errors, and the loss divided by the squared scaled residual.
LOSSES = {
    "squares": (1.0, lambda z2: jnp.ones_like(z2)),
    "soft_l1": (1.345, lambda z2: 2 / (1 + jnp.sqrt(1 + z2))),
    "huber": (1.345, lambda z2: jnp.where(z2 > 1, (2 * jnp.sqrt(jnp.maximum(z2, 1)) - 1) / jnp.maximum(z2, 1), 1.0)),
    "cauchy": (2.385, lambda z2: jnp.where(z2 > 1e-6, jnp.log1p(z2) / jnp.maximum(z2, 1e-6), 1 - z2 / 2)),
}


class Stage(NamedTuple):
    """A stage of a search: the fraction of each window's time that counts (W,), the weight of jumps between joined
    windows, and the size of an ordinary error, in sigmas, for a robust loss.

    While only a part counts, shared unknowns are held `around` (p,) the values where the search began: a change of a
    number by its whole size costs `held`, in units of a residual.
    """

    part: Float[Array, "*W"]
    joined: Float[Array, ""]
    ordinary: Float[Array, ""]
    held: Float[Array, ""] | None = None
    around: Float[Array, " p"] | None = None


# The whole record, with independent windows.
WHOLE = Stage(np.asarray(1.0), np.asarray(0.0), np.asarray(1.0))


# Not an `eqx.Module`: creating one and looking up its methods would cost each fit half a millisecond.
@jtu.register_dataclass
@dataclass(frozen=True, eq=False)
class FitProblem:
    """The whole task of a fit, as arrays of one shape for all windows.

    `measured` and `sigma` have leaves (W, T, ...), those of `end` (W, ...); `spread` has one number per leaf, and
    `spread_in_sigmas` is the largest ratio of a spread to its sigma. `unit` is the spread of the starts. `absolute`:
    sigmas were given.
    """

    system: Any
    # The system at the starts: for a motion in phases, the first phase.
    first: Any
    found: FreeNumbers
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

    def params(self, x: Array, w: Int[Array, ""] | int) -> PyTree:
        """The parameters of window w."""
        params = self.found.into(x)
        if not self.overrides:
            return params
        return replace(params, {name: value[w] for name, value in self.overrides.items()})

    def part(self, w: Int[Array, ""] | int, stage: Stage) -> Float[Array, ""]:
        """The part of window w that counts."""
        return jnp.broadcast_to(stage.part, (self.windows.count,))[w]

    def setting(self, x: Array, s: Array, w: Int[Array, ""] | int, stage: Stage):
        """Times, parameters, start and options of the motion of window w; times that do not count are squeezed."""
        ts = _squeezed(jnp.asarray(self.windows.ts)[w], jnp.asarray(self.windows.last)[w], self.part(w, stage))
        return ts, self.params(x, w), self.state(x, s, w), self.options

    def state(self, x: Array, s: Array, w: Int[Array, ""] | int):
        """(q, v) from which the motion of window w starts."""
        starts, t = jax.tree.map(lambda a: a[w], self.starts), jnp.asarray(self.windows.ts)[w, 0]
        like = self.unflatten(starts.q.guess)
        model = model_of(self.first, t, like, like, self.params(x, w))
        return tuple(map(self.unflatten, starts.vectors(s, s, model, t)))

    def motion(self, x: Array, s: Array, w: Int[Array, ""] | int, stage: Stage, adjoint: Any = None):
        """The motion of window w, and the state it starts from."""
        ts, params, (q, v), options = self.setting(x, s, w, stage)
        options = {"max_steps": STEPS_EACH * ts.shape[0] + STEPS, "adjoint": adjoint} | options
        return integrate(self.system, q, v, params, ts=ts, throw=False, **options), (q, v)

    def measurable(self, motion: Trajectory) -> dict[str, PyTree]:
        """Everything in a motion that can be measured."""
        values = {"q": motion.q, "v": motion.v, "multipliers": motion.multipliers, "end": motion.end._asdict()}
        observe = self.observe
        if observe is not None:
            values["observed"] = jax.vmap(lambda t, q, v: observe(t, q, v, motion.params))(motion.t, motion.q, motion.v)
        return values

    def predicted(self, motion: Trajectory) -> dict[str, PyTree]:
        """The measured quantities of a motion, in the structure of the measurements."""
        return selected(self.measurable(motion), self.measured)


def selected(values: PyTree, wanted: PyTree) -> PyTree:
    """The parts of `values` that `wanted` has: of dictionaries only its keys."""
    if isinstance(wanted, dict) and isinstance(values, dict):
        return {name: selected(values[name], part) for name, part in wanted.items()}
    return values


@partial(compiled, in_numpy=True)
def starts_at(problem: FitProblem, u: Unknowns, windows: Int[Array, " R"]):
    """(q, v) at the starts of some windows, and their slopes by the shared unknowns and by those of each window."""
    p = u.shared.size

    def at(w: Int[Array, ""] | int):
        def state(both: Array):
            return problem.state(both[:p], both[p:], w)

        both = jnp.concatenate([u.shared, u.local[w]])
        return state(both), jax.jacfwd(state)(both)

    return jax.vmap(at)(windows)


def replace(params: PyTree, values: Mapping[str, Any]):
    """`params` with some leaves replaced, by name; a leaf of an inner dictionary is called 'arm.length'."""
    return jtu.tree_map_with_path(lambda path, x: values.get(leaf_name(path), x), params)


class WindowPart(NamedTuple):
    """The contribution of one window: residuals of its samples, the state it starts from, and the state it ends in."""

    rows: Float[Array, " m"]
    begin: Float[Array, " 2n"]
    end: Float[Array, " 2n"]


def window_part(
    problem: FitProblem,
    x: Array,
    s: Array,
    w: Int[Array, ""] | int,
    stage: Stage,
    adjoint: Any = None,
    loss: str | None = None,
):
    """The contribution of window `w` at natural shared and local unknowns, and whether its motion ended well."""
    motion, start = problem.motion(x, s, w, stage, adjoint)
    rows = residuals(problem, motion, w, stage, problem.loss if loss is None else loss)
    well = ended_well(motion.result)
    if problem.windows.count == 1:
        nothing = jnp.zeros(0, rows.dtype)
        return WindowPart(rows, nothing, nothing), well
    last = problem.windows.last[w]
    end = _vector(jax.tree.map(lambda y: y[last], (motion.q, motion.v)))
    reached = jnp.isfinite(end)
    return WindowPart(rows, _vector(start) / problem.unit, jnp.where(reached, end, NOT_REACHED) / problem.unit), well


def _vector(tree: PyTree):
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])


def assemble(problem: FitProblem, u: Unknowns, parts: WindowPart, stage: Stage) -> WindowedEquations:
    """All equations, from the contributions of the windows (leading axis W)."""
    gap = jnp.where(_seam_weights(problem, stage) > 0, parts.end - jnp.roll(parts.begin, -1, axis=0), 0.0)
    known, weight = prior_and_hold(problem, stage)
    return WindowedEquations(parts.rows, _seam_weights(problem, stage) * gap, weight * (u.shared - known))


def assemble_slopes(problem: FitProblem, by_shared: WindowPart, by_local: WindowPart, stage: Stage) -> Slopes:
    """The slopes of all equations, from the slopes (W, ..., p) and (W, ..., k) of the windows' contributions."""
    seam_weights = _seam_weights(problem, stage)[:, :, None]
    following = partial(jnp.roll, shift=-1, axis=0)
    return Slopes(
        by_shared.rows,
        by_local.rows,
        seam_weights * (by_shared.end - following(by_shared.begin)),
        seam_weights * by_local.end,
        -seam_weights * following(by_local.begin),
        jnp.diag(prior_and_hold(problem, stage)[1]),
    )


def prior_and_hold(problem: FitProblem, stage: Stage):
    """The prior and the hold on the shared unknowns together: a mean, and the inverse of its standard deviation.

    The sum of their two squares is one square and a constant.
    """
    found = problem.found
    if stage.around is None:
        return found.mean, 1 / found.sd
    held = hold_weights(problem, stage) ** 2
    both = 1 / found.sd**2 + held
    mean = (found.mean / found.sd**2 + held * stage.around) / jnp.where(both > 0, both, 1.0)
    return mean, jnp.sqrt(both)


def hold_weights(problem: FitProblem, stage: Stage):
    """The cost of a change of each shared unknown by the hold; 0 for a guess of 0, which has no size to be held by."""
    start = problem.found.start
    if stage.held is None:
        return jnp.zeros_like(start)
    return jnp.where(start != 0, stage.held / jnp.abs(jnp.where(start != 0, start, 1.0)), 0.0)


def _seam_weights(problem: FitProblem, stage: Stage):
    return jnp.where(problem.windows.seam, stage.joined, 0.0)[:, None]


def equations(problem: FitProblem, u: Unknowns, stage: Stage) -> WindowedEquations:
    """The residuals at unknowns in natural numbers, in units of their sigmas."""
    # NumPy's arrays cannot be indexed by a window's traced number.
    live, static = eqx.partition(problem, eqx.is_array)
    problem = eqx.combine(jax.tree.map(jnp.asarray, live), static)
    parts = over_windows(lambda w, s: window_part(problem, u.shared, s, w, stage)[0], problem, u)
    return assemble(problem, u, parts, stage)


def over_windows(function: Callable, problem: FitProblem, u: Unknowns):
    """`function(w, s)` of every window."""
    if problem.windows.count == 1:
        return jax.tree.map(lambda x: x[None], function(0, u.local[0]))
    return one_by_one(lambda x: function(*x), (jnp.arange(problem.windows.count), u.local))


def one_by_one(function: Callable, xs: PyTree):
    """`jax.vmap(function)(xs)`; on a CPU a loop, which compiles and runs faster than lanes."""
    return lax.map(function, xs) if jax.default_backend() == "cpu" else jax.vmap(function)(xs)


def residuals(problem: FitProblem, motion: Trajectory, w: Int[Array, ""] | int, stage: Stage, loss: str):
    """The residuals of one window in one vector; zero where nothing was measured or the sample does not count yet."""
    last = problem.windows.last[w]
    part = problem.part(w, stage)
    counts = _counts(problem.windows.ts[w], last, part)
    predicted = problem.predicted(motion)
    parts = []
    for kind, tree in problem.measured.items():
        given = zip(*(jax.tree.leaves(part) for part in (tree, problem.sigma[kind], problem.spread[kind])))
        for value, (measured, sigma, spread) in zip(jax.tree.leaves(predicted[kind]), given):
            measured, sigma = measured[w], sigma[w]
            known = jnp.isfinite(measured) & jnp.isfinite(sigma)
            if kind == "end":
                known = known & (part >= 1)
            else:
                known = known & counts.reshape(-1, *(1,) * (measured.ndim - 1))
            sigma = jnp.where(known, sigma, 1.0)
            r = jnp.where(known, (value - jnp.where(known, measured, 0.0)) / sigma, 0.0)
            r = jnp.where(jnp.isfinite(r), r, NOT_REACHED * spread / sigma)
            parts.append(jnp.ravel(dampened(r, loss, stage.ordinary)))
    return jnp.concatenate(parts)


def dampened(r, loss: str, ordinary: ArrayLike = 1.0):
    """The residual whose square is the loss; `ordinary` is the size of an ordinary error."""
    constant, ratio = LOSSES[loss]
    return r * jnp.sqrt(ratio((r / (constant * ordinary)) ** 2))


def _counts(t: Array, last: Int[Array, ""], part: Array):
    """Which times count; for the whole window the last one is compared exactly, since rounding might exclude it."""
    return t <= jnp.where(part < 1, t[0] + part * (t[last] - t[0]), t[last])


def _squeezed(t: Array, last: Int[Array, ""], part: Array):
    """The times of a window; those beyond the part that counts are squeezed together, to cost next to nothing."""
    kept = jnp.sum(_counts(t, last, part))
    closest = jnp.maximum(PADDING * (t[1] - t[0]), 8 * jnp.finfo(t.dtype).eps * jnp.max(jnp.abs(t)))
    beyond = jnp.arange(t.shape[0]) - (kept - 1)
    return jnp.where(beyond <= 0, t, t[kept - 1] + beyond.astype(t.dtype) * closest)


def check_predicted(problem: FitProblem):
    """Raise if the measurements do not have the shapes of the motion's predictions."""
    begin = jax.tree.map(lambda x: x[0], (problem.starts.q.guess, problem.starts.v.guess))
    q, v = (jax.eval_shape(problem.unflatten, x) for x in begin)
    t, params = jax.ShapeDtypeStruct((), problem.windows.ts.dtype), problem.found.params

    def one_time(t: Array, q: PyTree, v: PyTree, params: PyTree):
        phases = model_of(problem.system, t, q, v, params).phases
        multipliers = {name: jnp.asarray(x) for phase in phases for name, x in phase.zero_multipliers().items()}
        values = {"q": q, "v": v, "multipliers": multipliers}
        if problem.observe is not None:
            values["observed"] = problem.observe(t, q, v, params)
        return values | {"end": {"t": t, **values}}

    predicted = eqx.filter_eval_shape(one_time, t, q, v, params)
    for kind, tree in problem.measured.items():
        _check_match(kind, predicted[kind], tree, 1 if kind == "end" else 2)


def _check_match(kind: str, predicted: Any, measured: Any, axes: int, path: tuple[Any, ...] = ()):
    if isinstance(measured, dict) and isinstance(predicted, dict):
        fix = f"the motion's names, {kind}={{'{{}}': ...}}"
        must_name(measured, predicted, f"what was measured as {kind} has", "name of the motion", fix)
        for name, part in measured.items():
            _check_match(kind, predicted[name], part, axes, (*path, jtu.DictKey(name)))
        return
    structure, wanted = jtu.tree_structure(predicted), jtu.tree_structure(measured)
    if structure != wanted:
        raise ValueError(
            f"{kind} was measured as {wanted}, but the motion has {structure}.\nFix: give it in that structure."
        )
    for x, y in zip(jtu.tree_leaves(predicted), jtu.tree_leaves(measured)):
        if x.shape != y.shape[axes:]:
            raise ValueError(
                f"'{channel_name(kind, path)}' was measured with the shape {y.shape[axes:]} at each time, but the "
                f"motion has {x.shape}.\nUsual cause: an array of one entry in place of a number."
            )


def check_motion(problem: FitProblem, well: Bool[Array, " W"], u: Unknowns):
    """Raise if a motion fails, with the message of `integrate`."""
    failed = np.flatnonzero(~np.asarray(well))
    if not failed.size:
        return
    w = int(failed[0])
    ts, params, (q, v), options = problem.setting(u.shared, u.local[w], w, WHOLE)
    reason = "it stops early"
    try:
        integrate(problem.system, q, v, params, ts=ts, **(options | {"throw": True}))
    except (ValueError, RuntimeError) as error:
        reason = str(error)
    raise ValueError(
        f"from the guess the motion of record {int(problem.windows.record[w])} fails: {reason}\n"
        "Fix: better guesses of params, q0 and v0; try them with lj.integrate first."
    )
