"""Residuals and their slopes: three ways, and the samples that count."""

import diffrax
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from lagjax.fit.residuals import WHOLE, _counts, equations
from lagjax.fit.search import linearised
from tests.fit.cases import CASES


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ("pendulum", "pendulum on a rod", "rolling hoop"))
def test_slopes_three_ways(name):
    """Slopes of all residuals, including measured multipliers: forward, reverse, and by differences.

    The steps do not depend on the varied unknowns, so the differenced function is smooth. For times of events, see the
    rolling hoop.
    """
    case = CASES[name]
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(0.01)}
    p = case.problem(case.measured(case.truth()), **fixed)
    u = p.start
    flat, back = ravel_pytree(u)
    slopes = linearised(p, u, WHOLE, "squares").slopes
    forward = np.concatenate([slopes.rows_by_shared[0], slopes.rows_by_local[0]], axis=1)
    rows = lambda x: equations(p, back(x), WHOLE).rows[0]
    direction = np.random.default_rng(0).normal(size=forward.shape[0])
    pulled = jax.jit(jax.grad(lambda x: direction @ rows(x)))(flat)
    np.testing.assert_allclose(pulled, direction @ forward, rtol=1e-9, atol=1e-9 * np.max(np.abs(direction @ forward)))
    at = jax.jit(rows)
    for i in range(len(flat)):
        step = np.zeros(len(flat))
        step[i] = 1e-3 * max(abs(float(flat[i])), 0.1)
        two = lambda h: (np.asarray(at(flat + h * step)) - np.asarray(at(flat - h * step))) / (2 * h * step[i])
        difference = (4 * two(0.5) - two(1.0)) / 3
        scale = max(np.max(np.abs(forward[:, i])), 1e-3 * np.max(np.abs(forward)))
        np.testing.assert_allclose(difference, forward[:, i], atol=1e-7 * scale, rtol=0)


def test_all_samples_of_a_whole_record_count():
    """The last sample counts even if first time plus length is rounded to less than its time. Twin: the sum."""
    random = np.random.default_rng(0)
    times = [np.sort(random.uniform(0.1, 10.0, 5)) for _ in range(100)]
    assert all(np.all(_counts(t, 3, 1.0) == (t <= t[3])) for t in times)
    assert not all(np.all((t <= t[0] + 1.0 * (t[3] - t[0])) == (t <= t[3])) for t in times)
