"""The error of a motion, judged and in words: its cause, and sizes that are not known."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.trajectory.error_report import in_units_of, warning_of
from tests.integrate.solve.test_error_estimate import orbit


def test_passing_a_singularity():
    """The warning says that digits were lost near the singularity."""
    traj = orbit(np.linspace(0.0, 125.0, 201), e=0.999)
    assert traj.scaled_error > 1 and "near a singularity" in warning_of(traj)


def test_a_cause_is_tested():
    """A motion that is fast at first and ends on a hilltop loses its digits at the top, not where it is fast.

    Twin: with two outputs it is not known where they were lost, and the causes are called possible.
    """
    hill = lj.System(lambda t, q, v, p: 0.5 * v**2 + 0.5 * q**2)
    run = lambda count: lj.integrate(hill, 1.0, -1.0, ts=np.linspace(0.0, 30.0, count))
    with pytest.warns(lj.AccuracyWarning, match="Cause: the motion itself amplifies errors, here"):
        assert np.ptp(np.log(abs(run(31).v))) > np.log(1e3)
    with pytest.warns(lj.AccuracyWarning, match="between t = 0 and 30 .* possible causes: the motion amplifies errors"):
        run(2)


pulse = lj.System(
    lambda t, q, v, p: 0.5 * v**2 + q * p["F"] * jnp.where((t > p["lo"]) & (t < p["hi"]), 1.0, 0.0),
)


@pytest.mark.filterwarnings("ignore::lagjax.AccuracyWarning")
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_number_that_is_zero_throughout(unit):
    """A run that steps over a pulse is zero throughout; the error, 0.595, is then its size, in any unit of length.

    Twin: with max_step the pulse is seen, and the same verdict says that all is well, in any unit.
    """
    params = {"F": unit, "lo": 4.0, "hi": 4.1}
    # With `jump_ts` elsewhere, only the times that are named are steps' ends.
    options = {"ts": [0.0, 10.0], "throw": False}
    missed = lj.integrate(pulse, 0.0, 0.0, params, **options)
    if float(missed.q[-1]) == 0.0:
        np.testing.assert_allclose(missed.error.q[-1] / unit, 0.595, rtol=1e-6)
        np.testing.assert_allclose(missed.scaled_error, 2000.0)
    found = lj.integrate(pulse, 0.0, 0.0, params, max_step=0.05, **options)
    np.testing.assert_allclose(found.q[-1] / unit, 0.595, rtol=1e-6)
    assert float(found.scaled_error) < 1e-2


def test_errors_of_zero_have_no_unit():
    """Where a size is unknown the error is the size, in NumPy and in JAX; twin: an error of zero is none."""
    for xp in (np, jnp):
        found = in_units_of(xp, xp.asarray([0.595, 0.595e-6, 0.595e6, 0.0, 2.0]), xp.asarray([0.0, 0, 0, 0, 1]))
        np.testing.assert_allclose(found, [2000, 2000, 2000, 0, 2])
