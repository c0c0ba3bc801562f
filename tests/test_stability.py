"""The stability report: its verdicts, their basis, and that no row is silently wrong."""

import json
from dataclasses import replace

import pytest

from lagjax import job, stability
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, Outcome

OUTCOME = Outcome("family", "name", "Dopri8", "3 steps", error=1e-9, allowed=1e-8)


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
    """`stability` runs the full report, the default job a part of it, and --quick only a few rows."""
    asked = []
    monkeypatch.setattr(stability, "trials", lambda tier: asked.append(tier) or [])
    monkeypatch.setattr(job, "SCENES", {})
    for arguments in (["stability"], ["--quick"], [], ["--full"]):
        job.main([*arguments, "-o", str(tmp_path), "-j", "1"])
    assert asked == [stability.FULL, stability.QUICK, stability.MAIN, stability.FULL]


def test_the_main_report_has_all_three_kinds():
    """The main job's report expects a definite verdict of every row, and contains each kind of verdict."""
    assert {row.expected for row in stability.trials(stability.MAIN)} == {ACCURATE, DEGRADED, REFUSED}
