"""Independent rows are chosen by their angle to the others, whatever their scale."""

from functools import cache

import jax
import numpy as np

from lagjax.jaxtools import length
from lagjax.numerics.dense import DEPENDENT_BELOW, independent_rows, unit_rows
from tests.numerics.methods.driven_pendulum import in_numpy

RNG = np.random.default_rng(11)
THRESHOLD = DEPENDENT_BELOW[np.dtype("float64")]


def random_rows(rank, width=7):
    """Six rows of a rank in `width` columns, and the same with rows of other lengths."""
    rows = np.zeros((6, 7))
    rows[:, :width] = RNG.normal(size=(6, rank)) @ RNG.normal(size=(rank, width))
    return rows, np.exp(RNG.uniform(-20, 20, (6, 1))) * rows


def beside_units(first, second):
    """Two rows of two numbers, and four that have nothing to do with them."""
    rows = np.eye(6, 7)
    rows[:2, :2] = first, second
    return rows


RANKS = [(1, 7), (6, 7), (4, 7), (3, 3)]
OF_RANKS = [rows for rank in RANKS for rows in random_rows(*rank)]
TWO = [beside_units([1.0, 0.0], [1.0, angle * THRESHOLD]) for angle in (0.5, 2.0, 1e4)]
KEPT = [beside_units([1.0, 2.0], [0.0, 0.0]), beside_units([1.0, 2.0], [2.0, np.nan])]


@cache
def chosen():
    """The rows chosen of all these, in lanes."""
    found = np.asarray(jax.jit(jax.vmap(independent_rows))(np.stack([*OF_RANKS, *TWO, *KEPT])))
    return np.split(found, [len(OF_RANKS), len(OF_RANKS) + len(TWO)])


def test_rank_of_random_rows():
    """As many rows are chosen as NumPy's SVD counts, they span the rest, and scaling rows changes nothing."""
    for rows, found, (rank, _) in zip(OF_RANKS[::2], chosen()[0][::2], RANKS):
        assert found.sum() == np.linalg.matrix_rank(rows[found]) == np.linalg.matrix_rank(rows) == rank
    for (rank, _), rows, found in zip(RANKS, OF_RANKS[::2], chosen()[0][1::2]):
        assert found.sum() == np.linalg.matrix_rank(rows[found]) == rank


def test_the_program_does_not_grow_with_the_rows():
    """Three rows and eight make one loop of the same length; twin: written out, each round is in the program."""

    def operations(m: int) -> int:
        return length(jax.make_jaxpr(independent_rows)(np.ones((m, 9))).jaxpr)

    assert operations(3) == operations(8)
    assert operations(2) != operations(3)


def test_threshold_is_an_angle():
    """Two rows at an angle above the threshold are independent, below it they are not; lanes decide for themselves."""
    assert chosen()[1][:, :2].sum(axis=1).tolist() == [1, 2, 2] and chosen()[1][:, 2:].all()


def test_rows_that_are_zero_or_not_finite_are_kept():
    """A constraint without a derivative must not count as redundant."""
    assert chosen()[2].all()


def test_a_row_of_zeros_has_derivatives():
    """Lengths and unit rows of zeros do not change; beside them those of (3, 4) do. Twin: a rate that is not zero."""
    rows, rates = np.array([[0.0, 0.0], [3.0, 4.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    along = in_numpy(lambda rows, rates: jax.jvp(unit_rows, (rows,), (rates,)), rows, rates)
    (units, lengths), (_, grow) = along(rows, rates)
    np.testing.assert_allclose(units, [[0.0, 0.0], [0.6, 0.8]])
    np.testing.assert_allclose(lengths, [0.0, 5.0])
    np.testing.assert_allclose(grow, [0.0, 0.6])
