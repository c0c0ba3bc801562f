"""A fit prints and draws itself, and is a density of its parameters."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import FREE, GUESS, PENDULUM, TS, noisy, pendulum


@pytest.mark.exhaustive
def test_log_likelihood(swinging):
    """The likelihood is largest at the estimates, and falls by a half at one standard deviation."""
    record = lj.Record(TS, q=swinging[0], sigma=0.01, q0=1.0, v0=0.0, hold_q=True, hold_v=True)
    found = lj.fit(pendulum, record, PENDULUM | {"l": 1.3}, free="l")
    density = jax.jit(found.log_likelihood)
    best = float(density(found.sampling))
    assert best == pytest.approx(-0.5 * float(found.chi2), abs=1e-9)
    moved = float(density({"l": found.values[0] + found.sd[0]}))
    assert moved - best == pytest.approx(-0.5, rel=0.01)
    slope = jax.grad(lambda l: found.log_likelihood({"l": l}))(found.values[0] + found.sd[0])
    assert float(slope * found.sd[0]) == pytest.approx(-1.0, rel=0.02)


def test_prints_and_plots(swinging):
    """The table has estimates with uncertainties in the user's units; the figure has one row per channel."""
    found = lj.fit(pendulum, lj.Record(TS, q=noisy(swinging[0])), GUESS, free=FREE, units={"l": "m"})
    lines = repr(found).splitlines()
    assert lines[0].startswith("Fit: converged")
    assert any(line.split()[:1] == ["l"] and "±" in line and line.endswith("m") for line in lines)
    assert "96 degrees of freedom" in repr(found) and "NOT white" not in repr(found)
    assert abs(found.whiteness()["q"]) < 0.3 and found.rms()["q"] == pytest.approx(0.01, rel=0.2)
    assert len(found.plot().axes) == 2
    assert np.max(np.abs(np.asarray(found.motion().q) - (noisy(swinging[0]) + found.residuals()["q"]))) < 1e-8
    # Twin: a slow error is not white.
    slow = lj.fit(pendulum, lj.Record(TS, q=swinging[0] + 0.02 * np.sin(TS)), GUESS, free=FREE)
    assert "NOT white" in repr(slow) and slow.whiteness()["q"] > 0.5


@pytest.mark.exhaustive
def test_log_likelihood_of_several_runs(swinging):
    """With two records, the likelihood at the estimates is that of the sum of squares of both."""
    records = [lj.Record(TS, q=noisy(swinging[0], seed=i), q0=1.0, v0=0.0, sigma=0.01) for i in (1, 2)]
    found = lj.fit(pendulum, records, GUESS, free=FREE)
    assert float(found.log_likelihood(found.sampling)) == pytest.approx(-0.5 * float(found.chi2), rel=1e-9)
