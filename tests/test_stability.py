"""The stability report: its verdicts, their basis, and that no row is silently wrong."""

import json
from dataclasses import replace

import diffrax
import jax
import numpy as np
import pytest

from lagjax import job, stability
from lagjax.numerics.methods.runge_kutta import Dopri8
from lagjax.stability import oscillator
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, SILENTLY_WRONG, Outcome, Trial

OUTCOME = Outcome("family", "name", "Dopri8", "3 steps", error=1e-9, allowed=1e-8)


def fixed(step):
    """A thousand fixed steps of length `step` divided by the oscillator's frequency."""
    options = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(step / oscillator.OMEGA)}
    ts = np.linspace(0.0, 1000 * step / oscillator.OMEGA, 3)
    params = {"omega": oscillator.OMEGA}
    return Trial(
        "test", f"{step}", oscillator.oscillator, 1.0, 0.0, params, ts, oscillator.exact, tolerance=1e-9,
        method=Dopri8(), options=options, periods=1000 * step / (2 * np.pi), expected=None,
    )  # fmt: skip


def detuned(q0, v0, params, ts):
    """A wrong reference: the frequency is off by 1e-6, and the phase by 2.5e-4."""
    return oscillator.exact(q0, v0, {"omega": (1 + 1e-6) * params["omega"]}, ts)


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


def test_stability_function():
    """R of Bogacki & Shampine's method is 1 + z + z²/2 + z³/6, stable up to √3 on the imaginary axis."""
    z = np.array([0.3 - 2.0j, 1.5j])
    np.testing.assert_allclose(oscillator.amplification(diffrax.Bosh3(), z), 1 + z + z**2 / 2 + z**3 / 6, rtol=1e-14)
    assert oscillator.stable_limit(diffrax.Bosh3()) == pytest.approx(3**0.5, rel=1e-3)
    assert oscillator.stable_limit(diffrax.Kvaerno5()) == np.inf


class Known:
    """A row with a given outcome."""

    def __init__(self, outcome):
        self.outcome = outcome

    def attempt(self):
        """Return the outcome without integrating."""
        return self.outcome


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        (OUTCOME, 0),
        (replace(OUTCOME, said="poor", error=1.0), 0),
        (replace(OUTCOME, raised=True, said="impossible", error=float("inf")), 0),
        (replace(OUTCOME, error=1.0), 1),
        (replace(OUTCOME, expected=DEGRADED), 1),
    ],
)
def test_exit_status(outcome, status, monkeypatch, tmp_path, capsys):
    """`python -m lagjax stability` fails if a row is silently wrong or unexpected, and names it."""
    monkeypatch.setattr(stability, "trials", lambda tier: [Known(outcome)])
    assert job.main(["stability", "-o", str(tmp_path)]) == status
    printed = capsys.readouterr().out
    assert f"1 {outcome.verdict}" in printed and outcome.said in printed
    assert ("MISSED  stability: family, name" in printed) == bool(status)
    (row,) = json.loads((tmp_path / "stability.json").read_text())["rows"]
    assert row["verdict"] == outcome.verdict


def test_tiers(monkeypatch, tmp_path):
    """`stability` runs the full report, the default job a reduced one, and --quick only a few rows."""
    asked = []
    monkeypatch.setattr(stability, "trials", lambda tier: asked.append(tier) or [])
    monkeypatch.setattr(job, "SCENES", {})
    for arguments in (["stability"], ["--quick"], []):
        job.main([*arguments, "-o", str(tmp_path), "-j", "1"])
    assert asked == [stability.FULL, stability.QUICK, stability.REDUCED]


@pytest.mark.exhaustive
def test_a_wrong_derivative_is_found():
    """The derivative by the frequency is checked; twin: a reference that ignores ω is silently wrong."""
    by_frequency = replace(fixed(0.25), along=(0.0, 0.0, {"omega": 1.0}))
    right = by_frequency.attempt()
    assert right.verdict == ACCURATE and right.gradient is not None and right.gradient < 1e-6
    ignorant = lambda q0, v0, params, ts: oscillator.exact(q0, v0, jax.lax.stop_gradient(params), ts)
    wrong = replace(by_frequency, exact=ignorant).attempt()
    assert wrong.verdict == SILENTLY_WRONG and wrong.error == right.error


def test_the_reduced_report_has_all_three_kinds():
    """The reduced report expects a definite verdict of every row, and contains each kind of verdict."""
    assert {row.expected for row in stability.trials(stability.REDUCED)} == {ACCURATE, DEGRADED, REFUSED}
