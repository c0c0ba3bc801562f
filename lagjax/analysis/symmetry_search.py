"""Find all symmetries of a system within a basis of motions, as a numerical null space.

At each state every motion of the basis changes its charge at some rate, and the constraints forbid part of its
displacement (`symmetry_test.py`). These numbers form rows with one column per motion. Gauge functions add columns, of
which only the span matters; it is projected out. A combination that vanishes in all rows is a Noether symmetry.
Symmetries without t are found first, so that a momentum across a uniform force is not hidden in two that grow with
time.

Scalings x to s^a x, t to s^b t that multiply L by a factor map motions to motions, and conserve nothing; they are found
separately. Under a combined scaling, L dt changes at a rate that is linear in the exponents. If this rate is c L dt at
every state, L is multiplied by s^(c - b). With c = 0 the scaling is a Noether symmetry and listed among these instead.

A combination that vanishes is a vector of the null space of a matrix with round-off. Singular values below a tolerance
count as zero, and the gap to the next one shows how reliable that is. A null space has no preferred basis; the one with
the most zeros is the most readable, and elimination finds it: each vector gets an entry that is zero in all others,
starting with the first entries. Small entries are not used as pivots, so that round-off is not magnified. Each vector
is then computed again from the columns of its nonzero entries alone.

Source: Noether, Nachr. Ges. Wiss. Göttingen (1918) 235, §2; Olver, *Applications of Lie Groups to Differential
Equations*, §4.4; Landau & Lifshitz, *Mechanics*, §10 (scalings); Golub & Van Loan, *Matrix Computations*, §5.5.8
(numerical rank), §3.4 (elimination).
"""

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.symmetry_result import (
    Basis,
    Clock,
    Combination,
    Found,
    Gauge,
    Ratios,
    Scaling,
    Symmetries,
    Words,
    gauges,
    in_words,
    motions,
    named_parameters,
)
from lagjax.analysis.symmetry_test import (
    AT_LEAST,
    STATES,
    Affine,
    Precision,
    Rates,
    draws,
    precision_of,
    rates,
    too_few,
)
from lagjax.jaxtools import filled_up, remembered
from lagjax.mechanics import Generator, NoetherCharge, as_generator, conserved_momenta, describe
from lagjax.refusals import must_have_values
from lagjax.system import Model, check_system, coordinates, model_of, traced_system

PIVOT_ABOVE = 1e-2


class NullSpace(NamedTuple):
    """Reduced vectors (d, K); all singular values (K,), falling; the smallest nonzero one over the largest zero one."""

    vectors: np.ndarray
    singular_values: np.ndarray
    gap: float


def null_space(columns: np.ndarray, precision: Precision) -> NullSpace:
    """The combinations of columns (N, K) that vanish; singular values are relative to the square root of N."""
    count, columns = columns.shape[1], np.asarray(columns, float)
    if count == 0:
        return NullSpace(np.zeros((0, 0)), np.zeros(0), np.inf)
    if len(columns) > count:
        columns = np.asarray(np.linalg.qr(columns, mode="r"))
    _, nonzero, directions = np.linalg.svd(columns)
    sizes = np.zeros(count)
    sizes[: len(nonzero)] = nonzero
    rank = int(np.sum(sizes > precision.null))
    least = max(float(sizes[rank]) if rank < count else 0.0, precision.exact / 1e3)
    gap = float(sizes[rank - 1]) / least if rank else np.inf
    vectors = reduced(directions[rank:], precision)
    return NullSpace(
        np.stack([_from_support(columns, v, precision.null) for v in vectors]) if len(vectors) else vectors, sizes, gap
    )


def reduced(vectors: np.ndarray, precision: Precision) -> np.ndarray:
    """A basis of the same space with as many zeros as elimination finds, with pivots from the first entries on."""
    rows, free = vectors.copy(), list(range(len(vectors)))
    pivots = []
    for least in (PIVOT_ABOVE, precision.zero):
        for k in range(rows.shape[1]):
            if not free or k in pivots:
                continue
            chosen = max(free, key=lambda i: abs(rows[i, k]))
            if abs(rows[chosen, k]) <= least:
                continue
            rows[chosen] /= rows[chosen, k]
            others = np.arange(len(rows)) != chosen
            rows[others] -= np.outer(rows[others, k], rows[chosen])
            pivots.append(k)
            free.remove(chosen)
            # Rescaled so that entries are compared with one.
            for i in free:
                rows[i] /= max(np.max(np.abs(rows[i])), np.finfo(rows.dtype).tiny)
    rows = np.stack([_cleaned(row, precision.zero) for row in rows]) if len(rows) else rows
    order = sorted(range(len(rows)), key=lambda i: tuple(np.flatnonzero(rows[i])[:1]))
    return rows[order]


def beyond(vectors: np.ndarray, known: np.ndarray, precision: Precision) -> np.ndarray:
    """A reduced basis of the part of a space (d, K) that is not in another one (k, K)."""
    if len(known) == 0 or len(vectors) == 0:
        return reduced(vectors, precision)
    first = np.linalg.qr(known.T)[0]
    rest = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rest = rest - (rest @ first) @ first.T
    _, sizes, directions = np.linalg.svd(rest)
    directions = directions[: int(np.sum(sizes > 100 * precision.zero))]
    # Elimination removes the pivot entries of the known vectors.
    together = reduced(np.concatenate([known, directions]), precision)
    leading = {int(np.flatnonzero(v)[0]) for v in reduced(known, precision)}
    return np.stack([v for v in together if int(np.flatnonzero(v)[0]) not in leading]) if len(directions) else rest[:0]


def independent(columns: np.ndarray, precision: Precision) -> np.ndarray:
    """Which columns (N, K) are linearly independent of those before them, (K,) booleans."""
    kept, basis = np.zeros(columns.shape[1], bool), np.zeros((len(columns), 0))
    for k, column in enumerate(columns.T):
        size = np.linalg.norm(column)
        rest = column / size if size > 0 else column
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > precision.zero:
            kept[k] = True
            basis = np.concatenate([basis, (rest / length)[:, None]], axis=1)
    return kept


def _from_support(columns, vector, tolerance):
    """The vector computed again from the columns of its nonzero entries, if their null space has one dimension."""
    support = np.flatnonzero(vector)
    if len(support) == 1:
        return vector
    _, sizes, directions = np.linalg.svd(columns[:, support])
    if len(sizes) < len(support) or (len(sizes) > 1 and sizes[-2] <= tolerance):
        return vector
    result = np.zeros_like(vector)
    result[support] = directions[-1] / directions[-1][0] * vector[support[0]]
    return result


def _cleaned(row, zero_below):
    return np.where(np.abs(row) > zero_below * np.max(np.abs(row)), row, 0.0)


def scalings_of(model: Model, tried: Basis, sampled: Rates, precision: Precision) -> tuple[Scaling, ...]:
    """The scalings that multiply L by a factor."""
    if model.system.is_forced:
        return ()
    chosen = np.flatnonzero(np.array(tried.kinds) == "scaling")
    columns = [np.append(tried.affine.matrix[i].ravel(), tried.affine.clock_rate[i]) for i in chosen]
    chosen = chosen[independent(np.stack(columns, axis=1), precision)]
    size = sampled.size[chosen]
    holonomic = model.holonomic
    root = np.sqrt(len(sampled.value))

    def rows(y: np.ndarray):
        return y.reshape(-1, y.shape[-1])

    # The set g = 0 and the velocity constraints must be preserved.
    kept = np.concatenate([rows(sampled.displacement[:, holonomic]), rows(sampled.invariance[:, ~holonomic])])[
        :, chosen
    ]
    changed = np.concatenate([sampled.charge[:, chosen], -sampled.value[:, None]], axis=1)
    kept = np.concatenate([kept, np.zeros((len(kept), 1))], axis=1)
    found = null_space(np.concatenate([changed, kept]) / root, precision)
    scalings = []
    known = model.names
    for vector in found.vectors:
        if abs(vector[-1]) <= precision.zero * 100 * np.max(np.abs(vector)):
            continue
        weights = vector[:-1] / size
        of_q = np.diagonal(np.tensordot(weights, tried.affine.matrix[chosen], 1))
        exponents = dict(zip(known, of_q)) | {"t": weights @ tried.affine.clock_rate[chosen]}
        # L dt is multiplied by s^c, hence L by s^(c - b).
        scalings.append(_tidied(exponents, float(vector[-1]), _worst(changed, kept, vector), 10 * precision.null))
    return tuple(scalings)


def _worst(changed, kept, vector):
    left = max(np.max(np.abs(rows @ vector), initial=0.0) for rows in (changed, kept))
    return float(left / np.max(np.abs(vector)))


def _tidied(exponents, action, residual, agrees) -> Scaling:
    unit = next((x for x in exponents.values() if abs(x) > agrees), 1.0)

    def nice(x):
        plain = Fraction(float(x)).limit_denominator(12)
        return float(plain) if abs(x - plain) < agrees else float(x)

    shown = {name: nice(x / unit) for name, x in exponents.items()}
    factor = nice((action - exponents["t"]) / unit)
    return Scaling({name: x for name, x in shown.items() if x}, factor, residual)


def symmetries(
    system, q: PyTree, v: PyTree, params: PyTree = None, *, basis: Iterable | Mapping | None = None, t=0.0
) -> Symmetries:
    """Find the symmetries of a system within a basis of motions, and what they conserve.

    >>> import lagjax as lj
    >>> def kepler(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) + params["k"] / (q["x"] ** 2 + q["y"] ** 2) ** 0.5
    >>> found = symmetries(lj.System(kepler), {"x": 1.0, "y": 0.5}, {"x": 0.25, "y": 1.0}, {"k": 2.0})
    >>> print(list(found))
    ['L_z', 'Jacobi integral']
    >>> print(found.scalings[0])
    x → s x, y → s y, t → s^(3/2) t: L → s^-1 L

    **Arguments:**

    - `system`, `q`, `v`, `params`, `t`: a state. Others, the same at each call, are drawn around it on the constraints,
      on the scale of its size.
    - `basis`: further generators, or functions `delta(t, q, params)`, in a list or by name. The search includes these,
      the shift of each coordinate, translations, rotations and boosts of all points and of each point (coordinates
      named x, y, z, or arrays of 2 or 3), time, scalings, and all combinations, such as screws; each up to a gauge
      function that is a polynomial of low degree.

    **Returns:** `Symmetries`: a mapping from names such as `"h p_z + 2π L_z with h = 0.5"` to charges. Conserved
    quantities that belong to no motion of points, such as the Runge-Lenz vector, are not found.

    **Raises:** `TypeError` while JAX is tracing; `ValueError` if no states are found that satisfy the constraints; as
    `noether_charge` for a generator of the wrong structure.

    Source: Olver, *Applications of Lie Groups to Differential Equations*, §4.4.
    """
    check_system(system, q, v, params, states=False)
    s = coordinates.state(t, q, v, params)
    fix = "call it outside of jax.jit, jax.vmap and sweeps; lj.is_symmetry(...).holds tests one symmetry inside"
    must_have_values(s, "symmetries are found from values", fix)
    model = model_of(traced_system(system, s), *s)
    own = _given(basis, s)
    tried = motions(s.q)
    gauge = gauges(s.q)
    count = filled_up(max(STATES, 4 * (len(tried.names) + len(own)) + 2 * len(gauge.names)))

    def columns_at(s) -> tuple[Rates, _Columns]:
        model = model_of(traced_system(system, s), *s)
        sampled = _those_found(rates(model, tried.affine, own, s, draws(count, model.n)))
        if len(sampled.value) < AT_LEAST:
            raise ValueError(too_few(model.system, s, len(sampled.value)))
        return sampled, _columns(tried, own, gauge, sampled)

    return _found(model, s, tried, own, gauge, columns_at)


def _given(basis, s) -> tuple[Generator, ...]:
    if basis is None:
        return ()
    if isinstance(basis, Generator) or callable(basis):
        basis = [basis]
    pairs = basis.items() if isinstance(basis, Mapping) else [(None, generator) for generator in basis]
    own = []
    for name, generator in pairs:
        generator = as_generator(generator)
        generator.check(s)
        own.append(Generator(generator.delta, generator.time, generator.gauge, name or generator.name))
    return tuple(own)


def _those_found(sampled: Rates) -> Rates:
    """The entries of the states that are on the constraints and finite, in NumPy."""
    kept = np.asarray(sampled.states.found)
    of_states = sampled._asdict()
    states = type(sampled.states)(*(np.asarray(y)[kept] for y in of_states.pop("states")))
    stateless = {"size", "first", "pushed"}
    return Rates(states, **{name: y if name in stateless else y[kept] for name, y in of_states.items()})


# Its multiples are spread evenly between 0 and 1.
GOLDEN = 0.6180339887498949
# A combination whose residual exceeds this many times the null tolerance is an artefact of round-off.
DOUBTFUL = 100.0


class _Columns(NamedTuple):
    """The rates of the motions, scaled to unit size: one column per motion, with the user's own generators first.

    `charge`: the rates of the charges; `forbidden`: how much constraints forbid the displacements; `gauge`: the rates
    of gauge functions. `moves`: the displacements of each motion at some states; `order`: the index of each motion in
    `Rates`.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    order: np.ndarray
    size: np.ndarray
    charge: np.ndarray
    forbidden: np.ndarray
    gauge: np.ndarray
    moves: np.ndarray


class _Spaces(NamedTuple):
    """The symmetries without t, and further ones with t, (d, K) in the columns `every`; `gap`: how clear this is."""

    every: np.ndarray
    steady: np.ndarray
    timed: np.ndarray
    singular_values: tuple[np.ndarray, np.ndarray]
    gap: float


def _elsewhere(s, columns_at: Callable) -> tuple[dict[str, float], _Columns] | None:
    """Other values of the parameters, each changed in another way, and the columns there; None if there are none."""
    leaves, structure = jax.tree.flatten(s.params)
    count = 0

    def changed(x: np.ndarray) -> np.ndarray:
        nonlocal count
        numbers = np.arange(count + 1, count + 1 + x.size).reshape(x.shape)
        count += x.size
        if np.issubdtype(x.dtype, np.floating):
            return x * (1 + 0.1 * np.modf(GOLDEN * numbers)[0]).astype(x.dtype)
        return x + numbers.astype(x.dtype) if np.issubdtype(x.dtype, np.integer) else x

    other = s._replace(params=jax.tree.unflatten(structure, [changed(np.asarray(x)) for x in leaves]))
    try:
        return named_parameters(other.params), columns_at(other)[1]
    except (ValueError, TypeError, IndexError):
        # A length that no constraint allows, a whole number that counts something.
        return None


def _found(model: Model, s, tried: Basis, own, gauge: Gauge, columns_at: Callable) -> Symmetries:
    precision = precision_of(s.t.dtype)
    sampled, columns = columns_at(s)
    others = cache(lambda: _elsewhere(s, columns_at))
    spaces = _spaces(columns, gauge, precision)
    parameters = named_parameters(s.params)
    shown = remembered(model, conserved_momenta, lambda: conserved_momenta(model))
    cyclic = {f"p_{name}" for name in shown}
    # Motions in time come last, as energies do in a list of constants.
    clocks = [kind == "time" for kind in columns.kinds]
    steady = sorted(spaces.steady, key=lambda vector: bool(np.any(vector[np.array(clocks)[spaces.every]])))
    details: dict[str, Found] = {}
    for vector, timed in [*((v, False) for v in steady), *((v, True) for v in spaces.timed)]:
        whole = np.zeros(len(columns.order))
        whole[spaces.every] = vector
        weights = _gauge_of(columns, whole, gauge, timed, _shifted(whole[len(own) :], tried.affine), precision)
        residual = _residual(columns, whole, weights)
        if residual > DOUBTFUL * precision.null:
            continue
        words = _words(whole / columns.size, columns.names, weights, gauge, parameters, precision, others)
        physical = whole / columns.size * words.factor
        generator = _generator(physical, weights * words.factor, tried, own, gauge, words.text)
        single = len(np.flatnonzero(whole)) == 1 and not np.any(weights)
        is_cyclic = single and columns.names[int(np.flatnonzero(whole)[0])] in cyclic
        details[words.text] = Found(NoetherCharge(model.system, generator), residual, timed, physical, is_cyclic)
    return Symmetries(
        details, scalings_of(model, tried, sampled, precision), columns.names, len(sampled.value),
        spaces.singular_values, spaces.gap if len(sampled.value) > len(columns.names) + len(gauge.names) else 0.0,
        f"t = {float(s.t):.6g}, q = {describe(s.q)}, v = {describe(s.v)}", repr(model.system),
    )  # fmt: skip


def _columns(tried: Basis, own, gauge: Gauge, sampled: Rates) -> _Columns:
    count, n_own, states = len(tried.names), len(own), len(sampled.value)
    order = np.concatenate([np.arange(count, count + n_own), np.arange(count)]).astype(int)

    def rows(y: np.ndarray):
        return y.reshape(-1, y.shape[-1])[:, order] / np.sqrt(states)

    of_gauge = gauge.rates(*map(np.asarray, sampled.states[:3])) / sampled.energy[:, None]

    def unit(y: np.ndarray):
        return y / np.maximum(np.std(y, axis=(0, 1)), np.finfo(float).tiny)

    # A few states are enough to tell motions apart.
    few = slice(0, 16 + 4 * (count + n_own) // sampled.xi.shape[2])
    moves = np.concatenate(
        [np.moveaxis(unit(sampled.xi[few]), 1, 0).reshape(count + n_own, -1), unit(sampled.tau[few]).T], axis=1
    )
    return _Columns(
        (*(generator.name for generator in own), *tried.names), (*("own" for _ in own), *tried.kinds),
        order, sampled.size[order], rows(sampled.charge), rows(sampled.displacement), of_gauge / np.sqrt(states),
        moves[order].T,
    )  # fmt: skip


def _spaces(columns: _Columns, gauge: Gauge, precision: Precision) -> _Spaces:
    """The null spaces, first of the motions without t, then of all motions."""
    steady = np.array([kind in ("own", "space", "time") for kind in columns.kinds])
    first = np.flatnonzero(steady)
    first = first[independent(columns.moves[:, first], precision)]
    every = np.concatenate([first, np.flatnonzero(~steady)])
    every = every[independent(columns.moves[:, every], precision)]
    without_t = null_space(_up_to(columns, first, ~gauge.timed), precision)
    with_t = null_space(_up_to(columns, every, np.ones(len(gauge.timed), bool)), precision)
    embedded = np.zeros((len(without_t.vectors), len(every)))
    embedded[:, _where(every, first)] = without_t.vectors
    boosted = _with_t(embedded, every, columns.names, columns, gauge, precision.null)
    later = beyond(with_t.vectors, np.concatenate([embedded, boosted]), precision)
    return _Spaces(
        every, embedded, np.concatenate([boosted, later]),
        (without_t.singular_values, with_t.singular_values), min(without_t.gap, with_t.gap),
    )  # fmt: skip


def _where(every, some):
    return np.array([int(np.flatnonzero(every == i)[0]) for i in some], int)


def _with_t(steady, every, names, columns: _Columns, gauge: Gauge, tolerance):
    """For each symmetry, the same motion times t, if that is a symmetry too: a boost for a translation."""
    boosts, places = [np.zeros((0, steady.shape[1]))], {names[i]: k for k, i in enumerate(every)}
    for vector in steady:
        moved = np.zeros_like(vector)
        for k in np.flatnonzero(vector):
            if (with_t := places.get(f"t {names[every[k]]}")) is None:
                break
            moved[with_t] = vector[k]
        else:
            left = _up_to(columns, every, np.ones(len(gauge.timed), bool)) @ moved
            boosts += [moved[None]] if np.linalg.norm(left) <= tolerance * np.linalg.norm(moved) else []
    return np.concatenate(boosts)


def _up_to(columns: _Columns, chosen, of_gauge):
    """The rows of the chosen motions, minus the part that gauge functions can compensate."""
    span = _span(columns.gauge[:, of_gauge])
    charge = columns.charge[:, chosen]
    charge = charge - span @ (span.T @ charge)
    return np.concatenate([charge, columns.forbidden[:, chosen]])


def _span(columns):
    size = np.linalg.norm(columns, axis=0)
    left, sizes, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return left[:, sizes > 1e-10 * max(1.0, float(sizes[0]))] if len(sizes) else left


def _shifted(weights, affine: Affine) -> set[int]:
    """The coordinates that a motion shifts."""
    amounts = np.abs(weights) @ (np.abs(affine.shift) + np.abs(affine.drift))
    return set(np.flatnonzero(amounts).tolist())


def _gauge_of(columns: _Columns, whole, gauge: Gauge, timed, shifted, precision: Precision):
    """The weights of the gauge functions of a symmetry: as few nonzero ones as possible."""
    rate, weights = columns.charge @ whole, np.zeros(len(gauge.names))
    if np.max(np.abs(rate), initial=0.0) <= precision.exact * np.max(np.abs(whole)) / np.sqrt(len(rate)):
        return weights
    size = np.linalg.norm(columns.gauge, axis=0)
    scaled = columns.gauge / np.where(size > 0, size, 1.0)

    def fitted(chosen):
        solution = np.linalg.lstsq(scaled[:, chosen], rate, rcond=precision.exact * 1e3)[0]
        return solution, np.linalg.norm(scaled[:, chosen] @ solution - rate)

    # On constraints some functions are equal. Those of shifted coordinates, of low degree and without t are preferred.
    def degree(k: int):
        return len(gauge.factors[k]) + gauge.powers[k]

    kept = sorted(
        np.flatnonzero((size > 0) & (timed | ~gauge.timed)),
        key=lambda k: (shifted.issuperset(gauge.factors[k]), -degree(k), not gauge.timed[k]),
    )
    few = [k for k in kept if shifted.issuperset(gauge.factors[k]) and degree(k) == 1]
    if few and fitted(few)[1] <= 1e3 * precision.exact * np.linalg.norm(rate):
        kept = few
    allowed = max(2 * fitted(kept)[1], 1e3 * precision.exact * np.linalg.norm(rate))
    for k in list(kept):
        without = [other for other in kept if other != k]
        if fitted(without)[1] <= allowed:
            kept = without
    weights[kept] = fitted(kept)[0] / size[kept]
    return weights


def _residual(columns: _Columns, whole, weights) -> float:
    left = columns.charge @ whole - columns.gauge @ weights
    root = np.sqrt(len(columns.charge))
    worst = max(np.max(np.abs(left), initial=0.0), np.max(np.abs(columns.forbidden @ whole), initial=0.0))
    return float(worst * root / np.max(np.abs(whole)))


def _words(physical, names, weights, gauge: Gauge, parameters, precision: Precision, others: Callable) -> Words:
    chosen = np.flatnonzero(physical)
    of_gauge = np.flatnonzero(weights)
    named = [names[i] for i in chosen] + [gauge.names[i] for i in of_gauge]
    numbers = [*physical[chosen], *(-weights[of_gauge])]
    elsewhere = None
    if len(named) > 1 and parameters and (other := others()) is not None:
        values = _ratios(other[1], chosen, of_gauge, precision)
        elsewhere = None if values is None else Ratios(values, other[0])
    return in_words(
        numbers, named, parameters, precision.agrees, first=[gauge.names[i] for i in of_gauge], elsewhere=elsewhere
    )


def _ratios(columns: _Columns, chosen, of_gauge, precision: Precision) -> np.ndarray | None:
    """The coefficients of the one combination of these motions and gauge functions that is conserved, relative to the
    first; None if there is not just one."""
    charge = np.concatenate([columns.charge[:, chosen], columns.gauge[:, of_gauge]], axis=1)
    forbidden = np.pad(columns.forbidden[:, chosen], ((0, 0), (0, len(of_gauge))))
    rows = np.concatenate([charge, forbidden])
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > precision.null, size, 1.0)
    _, sizes, directions = np.linalg.svd(rows / size, full_matrices=False)
    if len(sizes) < len(size) or sizes[-1] > 10 * precision.null or sizes[-2] <= 10 * precision.null:
        return None
    numbers = directions[-1] / size
    numbers[: len(chosen)] /= columns.size[chosen]
    return numbers / numbers[0] if numbers[0] else None


def _generator(physical, weights, tried: Basis, own, gauge, name: str) -> Generator:
    """The combination as one generator."""
    n_own = len(own)
    affine = physical[n_own:]
    total = Affine(*(np.tensordot(affine, getattr(tried.affine, f), 1) for f in Affine.__annotations__))
    moves = any(np.any(x) for x in (total.shift, total.matrix, total.drift))
    sets_clock = bool(total.clock or total.clock_rate)
    delta = Combination(total.shift, total.matrix, total.drift) if moves or not sets_clock else None
    time = Clock(float(total.clock), float(total.clock_rate)) if sets_clock else None
    generator = Generator(delta, time, gauge.combined(weights) if np.any(weights) else None, name)
    for weight, one in zip(physical[:n_own], own):
        generator = generator + float(weight) * one if weight else generator
    return Generator(generator.delta, generator.time, generator.gauge, name)
