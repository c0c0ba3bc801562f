"""Long motions are watched, saved and gone on from."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.equal_steps.test_equal_steps import TURN, ellipse, kepler, run

START = ellipse(0.6)


def turns(q0, v0, first, last, **options):
    """The ellipse of e = 0.6 at each of so many turns."""
    ts = TURN * np.arange(first, last + 1.0)
    return run(kepler, (q0, v0), 1.0, ts, lj.Splitting(6), TURN / 200, **options)


@pytest.mark.slow
def test_a_meter_that_moves(capfd):
    """`progress=True` shows parts of the way, and changes no digit. Twin: without it nothing is shown."""
    silent = turns(*START, 0, 2)
    jax.effects_barrier()
    assert "%" not in capfd.readouterr().err
    watched = turns(*START, 0, 2, progress=True)
    jax.effects_barrier()
    shown = capfd.readouterr().err
    assert all(part in shown for part in ("25.00%", "50.00%", "100.00%"))
    np.testing.assert_array_equal(watched.q, silent.q)
    assert int(watched.stats["num_steps"]) == 400
