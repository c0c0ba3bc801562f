"""The verdict on a trial, its basis, and that of its derivative."""

from dataclasses import replace

import diffrax
import jax
import numpy as np
import pytest

from lagjax.numerics.runge_kutta import Dopri8
from lagjax.stability import stiff_and_chaotic
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, SILENTLY_WRONG, Trial
from tests.test_stability import OUTCOME


def fixed(step):
    """A thousand fixed steps of length `step` divided by the oscillator's frequency."""
    options = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(step / stiff_and_chaotic.OMEGA)}
    ts = np.linspace(0.0, 1000 * step / stiff_and_chaotic.OMEGA, 3)
    params = {"omega": stiff_and_chaotic.OMEGA}
    return Trial(
        "test", f"{step}", stiff_and_chaotic.oscillator, 1.0, 0.0, params, ts, stiff_and_chaotic.exact, tolerance=1e-9,
        method=Dopri8(), options=options, periods=1000 * step / (2 * np.pi), expected=None,
    )  # fmt: skip


def detuned(q0, v0, params, ts):
    """A wrong reference: the frequency is off by 1e-6, and the phase by 2.5e-4."""
    return stiff_and_chaotic.exact(q0, v0, {"omega": (1 + 1e-6) * params["omega"]}, ts)


def test_each_verdict():
    """An oscillator gives all four: accurate, degraded with a warning, refused with a reason, silently wrong."""
    accurate = fixed(0.25).attempt()
    assert (accurate.verdict, accurate.said) == (ACCURATE, "")
    # Beyond |R(ihω)| = 1 the amplitude grows: slightly beyond, the Jacobi integral shows it; further, it overflows.
    degraded = fixed(3.9).attempt()
    assert degraded.verdict == DEGRADED and degraded.error > 1.0
    assert "no digits left" in degraded.said and "fixed steps" in str(degraded) or "the error of" in degraded.said
    refused = fixed(8.0).attempt()
    assert refused.verdict == REFUSED and "nan" in refused.said
    unreachable = replace(fixed(0.25), tolerance=1e-20).attempt()
    assert unreachable.verdict == REFUSED and "below what float64 can reach" in unreachable.said
    # Twins: a wrong reference, and an allowed error that nothing can meet.
    assert replace(fixed(0.25), exact=detuned).attempt().verdict == SILENTLY_WRONG
    assert replace(accurate, allowed=1e-30, estimated=None).verdict == SILENTLY_WRONG
    assert [outcome.passed for outcome in (accurate, degraded, refused)] == [True] * 3


def test_verdict_of_numbers():
    """NaN or a wrong derivative is not accurate; a row that expects another verdict does not pass."""
    assert OUTCOME.verdict == ACCURATE
    assert replace(OUTCOME, error=float("nan")).verdict == SILENTLY_WRONG
    # An error near its own estimate is reported, not silent; twin: one that is a hundred times the estimate.
    assert replace(OUTCOME, error=5e-8, estimated=1e-8).verdict == DEGRADED
    assert replace(OUTCOME, error=1e-6, estimated=1e-8).verdict == SILENTLY_WRONG
    assert replace(OUTCOME, lanes=1e-6).verdict == SILENTLY_WRONG
    assert replace(OUTCOME, gradient=1e-6).verdict == SILENTLY_WRONG
    assert replace(OUTCOME, gradient=float("nan")).verdict == SILENTLY_WRONG
    assert not replace(OUTCOME, expected=REFUSED).passed
    assert replace(OUTCOME, error=1.0, said="off").verdict == DEGRADED
    # Two digits must be correct, however long or unstable the motion is.
    assert replace(fixed(0.25), periods=1e30, amplification=1e10).allowed == 1e-2


@pytest.mark.exhaustive
def test_a_wrong_derivative_is_found():
    """The derivative by the frequency is checked; twin: a reference that ignores ω is silently wrong."""
    by_frequency = replace(fixed(0.25), along=(0.0, 0.0, {"omega": 1.0}))
    right = by_frequency.attempt()
    assert right.verdict == ACCURATE and right.gradient is not None and right.gradient < 1e-6
    ignorant = lambda q0, v0, params, ts: stiff_and_chaotic.exact(q0, v0, jax.lax.stop_gradient(params), ts)
    wrong = replace(by_frequency, exact=ignorant).attempt()
    assert wrong.verdict == SILENTLY_WRONG and wrong.error == right.error


def test_stability_function():
    """R of Bogacki & Shampine's method is 1 + z + z²/2 + z³/6, stable up to √3 on the imaginary axis."""
    z = np.array([0.3 - 2.0j, 1.5j])
    np.testing.assert_allclose(
        stiff_and_chaotic.amplification(diffrax.Bosh3(), z), 1 + z + z**2 / 2 + z**3 / 6, rtol=1e-14
    )
    assert stiff_and_chaotic.stable_limit(diffrax.Bosh3()) == pytest.approx(3**0.5, rel=1e-3)
    assert stiff_and_chaotic.stable_limit(diffrax.Kvaerno5()) == np.inf
