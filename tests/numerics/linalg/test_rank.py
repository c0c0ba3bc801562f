"""Independent rows are chosen by their angle to the others, whatever their scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools import length
from lagjax.numerics.linalg.rank import DEPENDENT_BELOW, independent_rows, unit_rows

rng = np.random.default_rng(11)


@pytest.mark.parametrize(("m", "n", "rank"), [(2, 3, 1), (6, 7, 6), (6, 7, 4), (5, 3, 3), (12, 9, 8)])
def test_rank_of_random_rows(m, n, rank):
    """As many rows are chosen as NumPy's SVD counts, they span the rest, and scaling rows changes nothing."""
    rows = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n))
    scaled = np.exp(rng.uniform(-20, 20, (m, 1))) * rows
    for matrix in (rows, scaled):
        chosen = np.asarray(independent_rows(jnp.asarray(matrix)))
        assert chosen.sum() == rank
        assert np.linalg.matrix_rank(rows[chosen]) == np.linalg.matrix_rank(rows) == rank


def test_the_program_does_not_grow_with_the_rows():
    """Three rows and eight make one loop of the same length; twin: written out, each round is in the program."""

    def operations(m: int) -> int:
        return length(jax.make_jaxpr(independent_rows)(jnp.ones((m, 9))).jaxpr)

    assert operations(3) == operations(8)
    assert operations(2) != operations(3)


def test_threshold_is_an_angle():
    """Two rows at an angle above the threshold are independent, below it they are not; lanes decide for themselves."""
    threshold = DEPENDENT_BELOW[np.dtype("float64")]
    angles = jnp.array([0.5, 2.0, 1e4]) * threshold
    rows = jnp.stack([jnp.array([[1.0, 0.0], [1.0, a]]) for a in angles])
    assert jax.vmap(independent_rows)(rows).sum(axis=1).tolist() == [1, 2, 2]


def test_rows_that_are_zero_or_not_finite_are_kept():
    """A constraint without a derivative must not count as redundant."""
    assert independent_rows(jnp.array([[1.0, 2.0], [0.0, 0.0]])).tolist() == [True, True]
    assert independent_rows(jnp.array([[1.0, 2.0], [2.0, jnp.nan]])).tolist() == [True, True]


def test_a_row_of_zeros_has_derivatives():
    """Lengths and unit rows of zeros do not change; beside them those of (3, 4) do. Twin: a rate that is not zero."""
    rows, rates = jnp.array([[0.0, 0.0], [3.0, 4.0]]), jnp.array([[0.0, 0.0], [1.0, 0.0]])
    (units, lengths), (_, grow) = jax.jvp(unit_rows, (rows,), (rates,))
    np.testing.assert_allclose(units, [[0.0, 0.0], [0.6, 0.8]])
    np.testing.assert_allclose(lengths, [0.0, 5.0])
    np.testing.assert_allclose(grow, [0.0, 0.6])
