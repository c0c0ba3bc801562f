"""Candidate measurements: the formulas for one time after the other, and the best set of times."""

from itertools import combinations

import numpy as np
import pytest

from lagjax.fit.next_measurement import assess, eliminate_unknowns, sd_after_each, sd_of
from tests.fit.uncertainty.test_next_measurement import SIGMA, parabola, sds

LEAST = 1e-7


@pytest.mark.parametrize("rank", [5, 3, 2])
@pytest.mark.parametrize("m", [1, 3])
def test_one_time_after_the_other(rank, m):
    """The formula for single times agrees with solving all equations, even if something is not determined."""
    random = np.random.default_rng(rank + m)
    known = random.normal(size=(7, rank)) @ random.normal(size=(rank, 5))
    rows = random.normal(size=(40, m, 5))
    for direction in (np.eye(5)[0], known[0], known[0] + rows[0, 0]):
        found = sd_after_each(direction, known, rows, LEAST)
        each = [sd_of(direction, np.concatenate([known, block]), LEAST) for block in rows]
        np.testing.assert_allclose(found, each, rtol=1e-8)
        # Twin: with fewer known equations.
        assert np.isinf(each).all() or not np.allclose(
            sd_after_each(direction, known[1:], rows, LEAST), each, rtol=1e-3
        )
    assert np.all(np.isfinite(sd_after_each(known[0], known, rows, LEAST)))
    one = sd_after_each(known[0] + rows[0, 0], known, rows, LEAST)
    assert np.isfinite(one[0]) and (np.isinf(one[1:]).all() == (rank + m < 5))


def test_unknowns_of_no_interest_are_eliminated():
    """Elimination keeps all information on the other unknowns; a column of zeros does not count as an unknown."""
    random = np.random.default_rng(0)
    of, others = random.normal(size=(20, 2)), random.normal(size=(20, 3))
    left = eliminate_unknowns(of, np.concatenate([others, np.zeros((20, 1)), others[:, :1]], axis=1))
    both = np.concatenate([of, others], axis=1)
    np.testing.assert_allclose(sds(left), sds(both)[:2], rtol=1e-10)
    # Twin: with the eliminated unknowns known.
    assert np.all(sds(of) < 0.99 * sds(both)[:2])


@pytest.mark.parametrize("count", [3, 4])
def test_best_times_against_all_choices(count):
    """Exchanges find the best of all sets of times, for random slopes and for a parabola (its ends and middle)."""
    along = np.array([1.0, 0.0, 0.0])
    random = np.random.default_rng(1)
    cases = [parabola(np.linspace(0.0, 2.0, 11)), *(random.normal(size=(11, 3)) for _ in range(6))]
    for i, rows in enumerate(cases):
        candidate = assess(
            "a run", np.linspace(0.0, 2.0, 11), rows[:, None], np.zeros((1, 3)), along, np.ones(3), {}, LEAST
        )
        times, sd = candidate.at_best(count)
        all_of_them = [sd_of(along, rows[list(places)], LEAST) for places in combinations(range(11), count)]
        assert sd <= 1.02 * min(all_of_them) and sd < np.median(all_of_them)
        if i == 0:
            # (q(0) - 2 q(1) + q(2)) / 1² has the error √6 σ; a fourth time lies near the middle, which weighs most.
            np.testing.assert_allclose(times[[0, 1, -1]], [0.0, 1.0 if count == 3 else 0.8, 2.0], atol=0.21)
            if count == 3:
                np.testing.assert_allclose(sd, np.sqrt(6) * SIGMA, rtol=1e-10)
        with pytest.raises(ValueError, match="from 1 to 11, not 12"):
            candidate.at_best(12)
