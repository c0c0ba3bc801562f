"""The unknowns of a fit: which numbers among the parameters are fitted, and the starts of runs and windows.

A fitted number x is searched as an unbounded one, z:

    x = z                         without bounds
    x = low + exp z               above `low`      (positive numbers: z is the logarithm)
    x = high - exp(-z)            below `high`
    x = low + (high - low) / (1 + exp(-z))         between

Weights of a network that the data hardly determine run away beside physical numbers, which then mean nothing. An entry
of `params` that is more than one array, a matrix among them, counts as a network; if other numbers are free too, each
of its weights gets a weak prior, normal about its guess.

**The start of each run, or window of a run**: a guess, and the directions in which the start may differ from it.

Without constraints a start is the guess plus unknown deviations. With constraints it is written in coordinates of the
tangent space at the guess,

    q = q_guess + N s + C c(s, params),        g(t, q, params) = 0,

with the columns of N along the constraints, those of C across them, and c found by Newton's method; neither changes a
known coordinate. Velocities likewise, with `phi(t, q, v, params) = 0`.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §IV.5.3 (tangent space parametrization).
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, compress
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.fit.records import Record, Windows, spread
from lagjax.integrate import integrate
from lagjax.jaxtools import at_once, compiled, is_traced, kinds, numpy_of, once, stop_gradient
from lagjax.mechanics import departures, equations_of, free_coordinates, listed, with_first_order, within
from lagjax.numerics import last_step, newton, null_space
from lagjax.refusals import must
from lagjax.system import Model, State, System, constraints, coordinates, model_of, traced_system, with_rates

# The standard deviation of a weak prior, relative to the root mean square of the guesses of a network's weights. With
# ten times a search takes three times as many steps (a spring and a friction network, from three keys).
WEAK = 3.0


class Leaf(NamedTuple):
    """A leaf of `params` by its index, and the indices of its fitted entries; None stands for all."""

    number: int
    places: tuple[int, ...] | None


@jtu.register_dataclass
@dataclass(frozen=True, eq=False)
class FreeNumbers:
    """The numbers among `params` that a fit finds.

    - `start` (p,): where the search starts. `low`, `high` (p,): bounds, infinite where there are none.
    - `mean`, `sd` (p,): the priors; `sd` is infinite where there is none.
    - `names`: the name of each number, as the user writes it. `weak`: the entries whose weights have weak priors.
    """

    params: PyTree
    start: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    mean: Float[Array, " p"]
    sd: Float[Array, " p"]
    names: tuple[str, ...] = eqx.field(static=True)
    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    weak: tuple[str, ...] = eqx.field(static=True, default=())

    def into(self, x: Float[Array, " p"]) -> PyTree:
        """`params` with the numbers `x` inserted."""
        leaves, structure = jtu.tree_flatten(self.params)
        at = 0
        for number, places in self.leaves:
            old = leaves[number]
            size = old.size if places is None else len(places)
            new = x[at : at + size].astype(old.dtype)
            if places is not None:
                new = _replace_entries(old, np.array(places), new)
            leaves[number] = new.reshape(old.shape)
            at += size
        return jtu.tree_unflatten(structure, leaves)

    def tree(self, y: Float[Array, " p"]) -> PyTree:
        """Numbers in the structure of `params`, with None in place of what is not fitted."""
        leaves, structure = jtu.tree_flatten(self.params)
        chosen: list[Any] = [None] * len(leaves)
        at = 0
        for number, places in self.leaves:
            shape = leaves[number].shape if places is None else (len(places),)
            size = math.prod(shape)
            chosen[number] = y[at : at + size].reshape(shape)
            at += size
        return jtu.tree_unflatten(structure, chosen)

    def vector(self, tree: PyTree) -> Float[Array, " p"]:
        """The inverse of `tree`."""
        parts = [jnp.ravel(x).astype(self.start.dtype) for x in jax.tree.leaves(tree)]
        return jnp.concatenate(parts or [jnp.zeros(0, self.start.dtype)])

    def natural(self, z: Array):
        """Numbers within their bounds from unbounded ones."""
        low, high = jnp.isfinite(self.low), jnp.isfinite(self.high)
        below, above = jnp.where(low, self.low, 0.0), jnp.where(high, self.high, 0.0)

        def z_if(taken: Bool[Array, " p"]):
            # Zeros in branches that are not taken: an overflow there would make derivatives NaN.
            return jnp.where(taken, z, 0.0)

        x = jnp.where(low & ~high, below + jnp.exp(z_if(low & ~high)), z)
        x = jnp.where(high & ~low, above - jnp.exp(-z_if(high & ~low)), x)
        return jnp.where(high & low, below + (above - below) * jax.nn.sigmoid(z_if(high & low)), x)

    def free(self, x: Array):
        """The inverse of `natural`."""
        low, high = jnp.isfinite(self.low), jnp.isfinite(self.high)
        share = (x - self.low) / jnp.where(low & high, self.high - self.low, 1.0)
        z = jnp.where(low & ~high, jnp.log(jnp.where(low & ~high, x - self.low, 1.0)), x)
        z = jnp.where(high & ~low, -jnp.log(jnp.where(high & ~low, self.high - x, 1.0)), z)
        return jnp.where(high & low, jax.scipy.special.logit(jnp.where(high & low, share, 0.5)), z)


def _replace_entries(old: Array, places: np.ndarray, new: Array):
    """All entries of `old` as a vector, some of them replaced."""
    if is_traced((old, new)):
        return jnp.ravel(old).at[places].set(new)
    row = np.array(old).ravel()
    row[places] = new
    return row


def find(
    params: PyTree,
    free: str | Iterable[str] | None,
    bounds: Mapping[str, tuple[float | None, float | None]],
    priors: Mapping[str, tuple[float, float] | None],
    dtype: Any,
    error: float = 0.0,
) -> FreeNumbers:
    """Determine the numbers to be fitted from `params`, names, bounds and priors.

    `error`: that of a measurement as residuals have it, against which weak priors are set; 0: there are none.
    """
    if not is_traced(params):
        with at_once():
            params = coordinates.given_params(params, dtype)
    named = [(leaf_name(path), x) for path, x in jtu.tree_leaves_with_path(params)]
    floating = {name: x for name, x in named if eqx.is_inexact_array(x)}
    chosen = {name: np.full(x.size, free is None) for name, x in floating.items()}
    for wanted in [free] if isinstance(free, str) else free or ():
        for name, places in _matching(wanted, floating, "free").items():
            chosen[name][places] = True
    chosen = {name: places for name, places in chosen.items() if places.any()}
    entries = [entry for name, places in chosen.items() for entry in compress(_entries(name, floating[name]), places)]
    xp = numpy_of(params)
    values = [xp.ravel(floating[name])[places].astype(dtype) for name, places in chosen.items()]
    start = xp.concatenate(values or [xp.zeros(0, dtype)])

    def spread(given: Mapping[str, tuple], default: tuple[float, float], what: str):
        by_leaf = [{name: np.full(len(places), value) for name, places in chosen.items()} for value in default]
        among = {name: floating[name] for name in chosen}
        for wanted, pair in given.items():
            _check_pair(wanted, pair, what)
            for name, places in _matching(wanted, among, what, chosen).items():
                shape = floating[name].shape if isinstance(places, slice) else (1,)
                for numbers, new in zip(by_leaf, pair):
                    if new is not None:
                        numbers[name][places] = np.broadcast_to(np.asarray(new, float), shape).ravel()
        return [np.concatenate([numbers[name][places] for name, places in chosen.items()] or [np.zeros(0)])
                for numbers in by_leaf]  # fmt: skip

    low, high = spread(bounds, (-np.inf, np.inf), "bounds")
    mean, sd = spread({name: pair for name, pair in priors.items() if pair is not None}, (0.0, np.inf), "priors")
    must(np.all(sd > 0), "the standard deviation of a prior must be positive", sd, 'priors={"g": (9.81, 0.01)}')
    # Which network each number belongs to, counted from 1; 0 for one with a prior of its own, or with None for it.
    networks = _networks(params, chosen) if error else []
    of = spread({name: (i + 1, None) for i, name in enumerate(networks)}, (0, 0), "priors")[0]
    physical = np.any(of == 0)
    of = np.where(spread(dict.fromkeys(priors, (1, None)), (0, 0), "priors")[0], 0, of)
    weak = tuple(name for i, name in enumerate(networks) if physical and np.any(of == i + 1))
    for i, name in enumerate(networks):
        if name in weak:
            size = xp.sqrt(xp.mean(start[of == i + 1] ** 2))
            width = WEAK * xp.where(size > 0, size, 1.0) / error
            mean, sd = xp.where(of == i + 1, start, mean), xp.where(of == i + 1, width, sd)
    numbers = {name: i for i, (name, _) in enumerate(named)}
    leaves = tuple(
        Leaf(numbers[name], None if places.all() else tuple(map(int, np.flatnonzero(places))))
        for name, places in chosen.items()
    )
    found = FreeNumbers(params, start, *(x.astype(dtype) for x in (low, high, mean, sd)), tuple(entries), leaves, weak)
    _check_start(found, low, high)
    return found


def leaf_name(path: tuple[Any, ...]) -> str:
    """The name of a leaf of `params` as a user writes it."""
    return jtu.keystr(path, simple=True, separator=".") or "params"


def _networks(params: PyTree, chosen: Mapping[str, np.ndarray]) -> list[str]:
    """The entries of `params` that are more than one array, a matrix among them, and have free numbers."""
    found = []
    for path, entry in jtu.tree_leaves_with_path(params, is_leaf=lambda x: x is not params):
        name, arrays = leaf_name(path), [x for x in jax.tree.leaves(entry) if eqx.is_inexact_array(x)]
        if len(arrays) > 1 and any(x.ndim > 1 for x in arrays) and any(leaf.startswith(f"{name}.") for leaf in chosen):
            found.append(name)
    return found


def _entries(name: str, x: Array):
    return [name + ("[" + ", ".join(map(str, i)) + "]" if i else "") for i in np.ndindex(x.shape)]


def _matching(
    name: Any, among: Mapping[str, Array], argument: str, chosen: Mapping[str, np.ndarray] | None = None
) -> dict[str, Any]:
    """The leaves that a name stands for, each with the places of its entries: all, or that of one element, 'm[1]'."""
    found: dict[str, Any] = {leaf: slice(None) for leaf in among if leaf == name or leaf.startswith(f"{name}.")}
    leaf = str(name).partition("[")[0]
    if not found and leaf in among:
        places = [i for i, entry in enumerate(_entries(leaf, among[leaf])) if entry == name]
        found = {leaf: [i] for i in places if chosen is None or chosen[leaf][i]}
    if not found:
        raise ValueError(
            f"{argument} names {name!r}, which is not a floating-point number of params that can be fitted: "
            f"{listed(list(among))}.\n"
            'Usual cause: a misspelled name, or a whole number written without a decimal point ("m": 1).\n'
            "Fix: use the names in params; leaves of a dict in a dict as 'arm.length', elements as 'm[1]'."
        )
    return found


def _check_pair(name: str, pair: Any, what: str):
    example = '{"m": (0.0, None)}' if what == "bounds" else '{"g": (9.81, 0.01)}, mean and standard deviation'
    well = isinstance(pair, tuple | list) and len(pair) == 2
    must(well, f"{what} of '{name}' must be a pair", pair, f"{what}={example}")


def _check_start(found: FreeNumbers, low: np.ndarray, high: np.ndarray):
    if np.any(low >= high):
        i = int(np.argmax(low >= high))
        raise ValueError(f"the bounds of '{found.names[i]}' are ({low[i]}, {high[i]}): low must be below high.")
    if is_traced(found.start):
        return
    x = np.asarray(found.start)
    if not np.all(np.isfinite(x)):
        raise ValueError(f"'{found.names[int(np.argmin(np.isfinite(x)))]}' starts at {x[~np.isfinite(x)][0]}.")
    outside = (x <= low) | (x >= high)
    if outside.any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"'{found.names[i]}' starts at {x[i]:.6g}, but must start inside its bounds, from {low[i]:.6g} to "
            f"{high[i]:.6g}.\nFix: start a positive number at its order of magnitude, such as 1e-3, not at 0."
        )


# Position and velocity are read off a parabola through this many samples.
SAMPLES = 7
# This many of them must agree; a sample is an outlier if it deviates this many times more than these, and by this
# fraction of the data's spread. (Samples far apart on a curve that is not a parabola reach 30 times.)
MOST, FAR_OFF, OF_SPREAD = 5, 100.0, 0.3
# The largest number of Newton iterations for c; they end when the residual no longer falls.
ITERATIONS = 12
# The largest violation of the constraints after that, in displacements relative to the state.
OFF = 1e-6


class Chart(NamedTuple):
    """Directions at a guess: `along` the constraints (n, k), one for each unknown, and `across` them (n, r)."""

    guess: Float[Array, " n"]
    along: Float[Array, "n k"]
    across: Float[Array, "n r"]

    def at(self, s: Float[Array, " k"], residual: Callable, problem: PyTree):
        """The vector y with `residual(problem, y) = 0`, which is differentiable in `s` and in `problem`."""
        y = self.guess + self.along @ s
        if self.across.shape[-1] == 0:
            return y

        fixed = stop_gradient(problem)

        def step(at, r):
            """A step towards the constraints; of least squares if there are more equations than directions."""
            rows = jax.jacfwd(partial(residual, fixed))(at) @ self.across
            return self.across @ jnp.linalg.solve(rows.T @ rows, rows.T @ r)

        of_y = partial(residual, fixed)
        near = newton(of_y, lambda y, r, i: step(y, r), stop_gradient(y), ITERATIONS, falls=0.5)
        return last_step(near, y, lambda y: step(near, residual(problem, y)))


class Starts(NamedTuple):
    """The starts of all windows: charts of coordinates and of velocities, each with a leading axis W."""

    q: Chart
    v: Chart

    @property
    def unknowns(self) -> int:
        """The number of unknowns in a window's start."""
        return self.q.along.shape[-1]

    def vectors(self, s: Float[Array, " k"], r: Float[Array, " k"], model: Model, t: Array):
        """Coordinates at `s` and velocities at `r` of one window, where `self` holds this window's entries."""
        x = self.q.at(s, lambda problem, x: constraints.position_residual(*problem, x), (model, t))
        return x, self.v.at(r, lambda problem, u: constraints.velocity_residual(*problem, u), (model, t, x))


def starts(
    system: System, records: Sequence[Record], windows: Windows, params: Sequence[PyTree], options: dict[str, Any]
) -> tuple[Starts, Callable, State]:
    """The guessed starts of all windows, the function from a vector of coordinates to a pytree, and one start."""
    guesses = []
    for r, record in enumerate(records):
        here = np.flatnonzero(windows.record == r)
        first = _guess(system, record, r, params[r])
        guesses.append(first)
        read = [_state_from_samples(record, windows.sample[w][windows.real[w]]) for w in here[1:]]
        structure = jax.tree.structure((first.q, first.v))
        later = [state for state in read if jax.tree.structure(state) == structure]
        if len(later) < len(read):
            later = _states_along_motion(system, first, windows.ts[here, 0], options)
        for w, (q, v) in zip(here[1:], later):
            guesses.append(_state(windows.ts[w, 0], q, v, first.params))
    system, charts = traced_system(system, guesses[0]), []
    for w, (r, guess) in enumerate(zip(windows.record, guesses)):
        held = (records[r].hold_q, records[r].hold_v) if w in windows.first else (False, False)
        free_q, free_v = (_free(guess.q, hold) for hold in held)
        if w in windows.first:
            # No motion depends on the given velocity of a coordinate of first order; at later windows it must agree.
            first = with_first_order(model_of(system, *guess)).form.first_order
            free_v = free_v if first is None else free_v & ~first.mask(len(free_v))
        charts.append(_charts(system, guess, free_q, free_v, r))
    q, v = zip(*charts)
    k = max(chart.along.shape[1] for chart in q), max(chart.along.shape[1] for chart in v)
    return Starts(_stacked(q, 0, sum(k)), _stacked(v, k[0], sum(k))), unflatten_of(kinds(guesses[0].q)), guesses[0]


def _stacked(charts: Sequence[Chart], before: int, k: int) -> Chart:
    """Charts stacked to one shape; `before` other unknowns precede those of this kind."""
    guesses, n = [chart.guess for chart in charts], len(charts[0].guess)
    along = np.zeros((len(charts), n, k), charts[0].along.dtype)
    across = np.zeros((len(charts), n, max(chart.across.shape[1] for chart in charts)), along.dtype)
    for w, chart in enumerate(charts):
        along[w, :, before : before + chart.along.shape[1]] = chart.along
        across[w, :, : chart.across.shape[1]] = chart.across
    return Chart(numpy_of(guesses).stack(guesses), along, across)


def _state(t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> State:
    """A state; one made of numbers stays numbers, even while a program is traced."""
    if is_traced((q, v, params)):
        return coordinates.given_state(t, q, v, params)
    with at_once():
        s = coordinates.given_state(t, q, v, params)
    return s._replace(q=jax.tree.map(np.asarray, s.q), v=jax.tree.map(np.asarray, s.v))


def _vector(tree: PyTree):
    """All coordinates in one vector, a NumPy array unless they are traced."""
    xp = numpy_of(tree)
    return xp.concatenate([xp.ravel(x) for x in jax.tree.leaves(tree)])


@once
def unflatten_of(of_kinds: tuple) -> Callable:
    """The function that turns a vector into coordinates of these `kinds`."""
    structure, *arrays = of_kinds
    with at_once():
        return coordinates.flatten(jax.tree.unflatten(structure, [np.zeros(*array) for array in arrays]))[1]


def _guess(system: System, record: Record, r: int, params: PyTree) -> State:
    q, v = record.q0, record.v0
    if q is None or v is None:
        read_q, read_v = _state_from_samples(record, np.arange(len(record.t)))
        q, v = (read_q if q is None else q), (read_v if v is None else v)
        if q is None or v is None:
            raise ValueError(
                f"record {r} has no guess of its start, and no measured coordinates to read it from.\n"
                "Fix: lj.Record(..., q0=..., v0=...), in the structure that lj.integrate takes."
            )
        if record.v0 is None and isinstance(q, dict) and isinstance(v, dict):
            v = jax.tree.map(lambda x: np.zeros(np.shape(x), jnp.result_type(float)), q) | v
    v = with_rates(system, q, v)
    if is_traced((q, v, params)):
        if system.constraints:
            raise TypeError(
                "the start of a constrained system is being traced, but its free directions depend on its values.\n"
                "Fix: give q0 and v0 of the record, and params, as numbers; measurements may be traced."
            )
        return _state(record.t[0], q, v, params)
    guess = _state(record.t[0], q, v, params)
    if record.q0 is None and isinstance(q, dict):
        try:
            traced_system(system, guess)
        except ValueError as error:
            raise ValueError(
                f"{error}\nThe start of record {r} was read off what it measures, {listed(list(q))}; give "
                "a guess of all coordinates with lj.Record(..., q0=..., v0=...)."
            ) from error
    return guess


def _state_from_samples(record: Record, samples: Int[np.ndarray, " m"]):
    """(q, v) at the first of some samples, from parabolas through the first measured ones; None if not measured."""
    t = record.t[samples] - record.t[samples[0]]

    def parabolas(kind: str):
        tree = record.measured.get(kind)
        pairs = jax.tree.map(lambda x: _parabola(t.astype(x.dtype), x, samples), tree)
        return [jax.tree.map(lambda x, pair, i=i: pair[i], tree, pairs) for i in (0, 1)]

    (q, slopes), (v, _) = parabolas("q"), parabolas("v")
    if isinstance(slopes, dict) and isinstance(v, dict):
        return q, slopes | v
    return q, slopes if v is None else v


def _parabola(t: Any, x: Array, samples: Int[np.ndarray, " m"]):
    """Value and slope at the first of some samples, at t = 0, of a parabola through the first that are not missing.

    Outliers do not count: among the parabolas through three samples each, the one nearest to most other samples decides
    which samples agree, and a parabola is fitted to these.

    Source: Rousseeuw, *J. Am. Stat. Assoc.* 79 (1984) 871 (least median of squares).
    """
    xp, shape = numpy_of(x), x.shape[1:]
    t = xp.asarray(t)
    count = min(SAMPLES, len(t))
    threes = _threes(count)
    values, slopes = [], []
    for column in x.reshape(len(x), -1).T:
        far_off, column = OF_SPREAD * spread(column), column[samples]
        first = xp.argsort(~xp.isfinite(column), stable=True)[:count]
        y, known = column[first], xp.isfinite(column[first])
        scale = xp.max(xp.where(known, t[first], 0.0))
        scale = xp.where(scale > 0, scale, 1.0)
        powers = (t[first] / scale)[:, None] ** np.arange(3)[None]
        near, y = known, xp.where(known, y, 0.0)
        # Not while tracing, where it would be compiled for each window.
        if count == SAMPLES and xp is np:
            through = xp.linalg.solve(powers[threes], y[threes][..., None])
            off = xp.abs(y - (powers @ through)[..., 0])
            typical = xp.sort(off, axis=1)[:, MOST - 1]
            best = xp.argmin(typical)
            near = known & (~xp.all(known) | (off[best] <= xp.maximum(FAR_OFF * typical[best], far_off)))
        coefficients = xp.linalg.lstsq(powers * near[:, None], xp.where(near, y, 0.0))[0]
        values.append(coefficients[0])
        slopes.append(coefficients[1] / scale)
    return tuple(xp.stack(part).reshape(shape) for part in (values, slopes))


@once
def _threes(count: int):
    """All choices of three among `count` samples."""
    return np.array(list(combinations(range(count), 3)))


def _states_along_motion(system: System, first: State, ts: Array, options: dict[str, Any]):
    """The states at the starts of a record's later windows, along the motion from its guessed start."""
    known = {name: value for name, value in options.items() if name not in ("event", "events")}
    motion = integrate(system, first.q, first.v, first.params, ts=ts, **(known | {"throw": False}))
    # If the motion from the guess does not reach a window, the start replaces the missing state.
    xp = numpy_of((motion.q, motion.v, first.q, first.v))
    reached, start = (motion.q, motion.v), (first.q, first.v)
    q, v = jax.tree.map(lambda x, x0: xp.where(xp.isfinite(x), x, x0[None]), reached, start)
    return [jax.tree.map(lambda x, i=i: x[i], (q, v)) for i in range(1, len(ts))]


def _free(q: PyTree, hold: bool | tuple[str, ...]):
    if isinstance(hold, bool):
        return np.full(len(coordinates.names(q)), not hold)
    return free_coordinates(q, hold)


def _charts(system: System, s: State, free_q: Bool[np.ndarray, " n"], free_v: Bool[np.ndarray, " n"], r: int) -> Starts:
    x, u = _vector(s.q), _vector(s.v)
    if not system.constraints:
        nothing = np.zeros((len(free_q), 0))
        return Starts(*(Chart(y, np.eye(len(f))[:, f], nothing) for y, f in ((x, free_q), (u, free_v))))
    with at_once():
        model = model_of(system, *s)

        def charts(x: Array, u: Array, of_q: Array, of_v: Array):
            return Starts(_chart(x, of_q, free_q), _chart(u, of_v, free_v))

        near = charts(x, u, *_rows(model, s.t, x, u))
        moved = _move_onto_constraints(near, model, s.t)
        if not moved.holds:
            nearest = State(s.t, model.tree(moved.x), model.tree(moved.u), s.params)
            raise ValueError(
                f"the start of record {r} cannot be moved onto the constraints: at the nearest state found, "
                f"{departures(model, nearest, OFF, OFF)}.\n"
                "Usual cause: a guess too far off, or too many coordinates held.\n"
                "Fix: q0, v0 = lj.consistent_state(system, t[0], q0, v0, params), and hold less."
            )
        # The directions at the guess after it was moved onto the constraints.
        return charts(moved.x, moved.u, moved.of_q, moved.of_v)


def _chart(y: Array, rows: Any, free: Bool[np.ndarray, " n"]):
    """The chart at y of equations with these rows; only free entries of y change."""
    rows = np.asarray(rows)[:, free]
    along, across = np.zeros((len(free), int(free.sum()))), np.zeros((len(free), 0))
    if len(rows) and free.any():
        inner = null_space(rows, 1e-9)
        normal = null_space(inner.T) if inner.shape[1] else np.eye(len(inner))
        along, across = np.zeros((len(free), inner.shape[1])), np.zeros((len(free), normal.shape[1]))
        along[free], across[free] = inner, normal
    elif free.any():
        along[free] = np.eye(int(free.sum()))
    return Chart(np.asarray(y), along.astype(y.dtype), across.astype(y.dtype))


class Moved(NamedTuple):
    """A guess moved onto the constraints, their rows there, and whether it satisfies them."""

    x: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    of_q: Float[np.ndarray, "p n"]
    of_v: Float[np.ndarray, "m n"]
    holds: Bool[np.ndarray, ""]


@partial(compiled, in_numpy=True)
def _move_onto_constraints(near: Starts, model: Model, t: Array) -> Moved:
    nothing = (jnp.zeros(chart.along.shape[1], t.dtype) for chart in near)
    x, u = near.vectors(*nothing, model, t)
    holds = within(equations_of(model), t, model.tree(x), model.tree(u), OFF, OFF)
    return Moved(x, u, *_rows(model, t, x, u), holds)


@partial(compiled, in_numpy=True)
def _rows(model: Model, t: Array, x: Array, u: Array):
    of_q = jax.jacfwd(lambda x: constraints.position_residual(model, t, x))(x)
    of_v = jax.jacfwd(lambda u: constraints.velocity_residual(model, t, x, u))(u)
    return of_q, of_v
