"""Ordering, coloured products, banded solves and independent rows, against dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.numerics import banded
from lagjax.numerics.dense import independent_rows
from tests.tiers import exhaustive_but


def shuffled(m, half_bandwidth, seed=0):
    """A random symmetric definite matrix of this half bandwidth, its rows in random order."""
    rng = np.random.default_rng(seed)
    i, j = np.indices((m, m))
    a = np.where(np.abs(i - j) <= half_bandwidth, rng.normal(size=(m, m)), 0.0)
    a = a + a.T + (4 * half_bandwidth + 4) * np.eye(m)
    order = rng.permutation(m)
    return a[np.ix_(order, order)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "size",
    exhaustive_but(((1, 0), (20, 2)), ((1, 0), (2, 1), (3, 1), (20, 0), (20, 1), (20, 2), (30, 5), (5, 4))),
    ids=str,
)
def test_solves_as_lapack(size):
    """A band in random row order is ordered, coloured and solved to round-off, with some rows left out."""
    m, half_bandwidth = size
    a = shuffled(m, half_bandwidth)
    where = banded.band(a != 0)
    assert where.order.half_bandwidth == half_bandwidth
    rows = where.order.rows
    entries = banded.entries(lambda x: jnp.asarray(a) @ x, where, jnp.float64)
    rng = np.random.default_rng(1)
    r, kept = rng.normal(size=m), rng.uniform(size=m) > 0.2
    sorted_a = a[np.ix_(rows, rows)]
    np.testing.assert_allclose(banded.solver(entries)(jnp.asarray(r)), np.linalg.solve(sorted_a, r), rtol=1e-11)
    left = np.where(np.outer(kept, kept), sorted_a, np.diag(1.0 - kept))
    solve = banded.solver(banded.keep(entries, jnp.asarray(kept)))
    np.testing.assert_allclose(solve(jnp.asarray(r)), np.linalg.solve(left, r), rtol=1e-11)


@pytest.mark.parametrize("wider", [0, 1])
def test_ill_conditioned_and_singular(wider):
    """Alternating masses of ratio 1e6: residuals no larger than LAPACK's; a singular band gives no plausible number."""
    m = 64
    inverse_mass = np.where(np.arange(m + 1) % 2, 1e6, 1.0)
    a = np.diag(inverse_mass[:-1] + inverse_mass[1:]) - np.diag(inverse_mass[1:-1], 1) - np.diag(inverse_mass[1:-1], -1)
    r = np.random.default_rng(0).normal(size=m)
    bands = np.zeros((2, m, 2 + wider))
    bands[0, :, 0], bands[0, 1:, 1] = np.diag(a), np.diag(a, 1)
    bands[1, :, 0], bands[1, 1, 1] = 1.0, 1.0
    good, singular = np.asarray(jax.jit(jax.vmap(lambda band: banded.solver(band)(r)))(bands))

    def backward_error(x):
        return np.max(np.abs(a @ x - r) / (np.abs(a) @ np.abs(x) + np.abs(r)))

    assert backward_error(good) <= max(4 * backward_error(np.linalg.solve(a, r)), 1e-15)
    assert not np.all(np.abs(singular) < 1e12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", exhaustive_but((2,), range(3)))
def test_independent_rows_by_pivots(seed):
    """As many independent rows as the rank are kept; without dependent rows all are kept."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((24, 20))
    for k in range(24):
        first = min(k * 20 // 24, 17)
        rows[k, first : first + 3] = rng.normal(size=3)
        if k in (5, 11, 12, 20):
            rows[k] = -2 * rows[k - 1] if k != 12 else rows[10] + rows[9]
    full = np.delete(rows, [5, 11, 12, 20], axis=0)
    for a in (rows, full):
        gram = a @ a.T
        where = banded.band(np.abs(gram) > 0)
        entries = banded.entries(lambda x, gram=gram: jnp.asarray(gram) @ x, where, jnp.float64)
        kept = np.asarray(banded.independent(entries, 1e-5))[np.argsort(where.order.rows)]
        assert kept.sum() == np.linalg.matrix_rank(a) == np.linalg.matrix_rank(a[kept])
        assert kept.sum() == independent_rows(jnp.asarray(a)).sum()


def test_colours_separate_columns():
    """No two columns of one colour share a row; an arrow needs one for each column of its full row."""
    found = np.random.default_rng(0).uniform(size=(30, 40)) < 0.05
    coloured = banded.colours(found)
    for colour in range(coloured.count):
        assert np.all(found[:, coloured.of_column == colour].sum(axis=1) <= 1)
    assert coloured.count < 12
    full_row = np.zeros((3, 5), bool)
    full_row[1] = True
    assert banded.colours(full_row).count == 5
