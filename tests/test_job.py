"""The main job: tables, pictures, numbers, exit status."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lagjax import job, report, stability
from lagjax.display import plots
from tests.systems import PARAMS, pendulum

TS = np.array([0.0, 0.5])


def swing(error):
    """A run whose error is prescribed."""
    return report.Run("swing", pendulum, PARAMS, 1.0, 0.0, TS, lambda trajectory: error, "a given number")


SCENE = report.Scene(
    name="tiny",
    title="A tiny scene",
    source="nowhere",
    misprints=("prints 1 for 2.",),
    runs=lambda: [swing(1e-12)],
    cases=lambda: [report.Case("easy", "went well", 0.0, 0.0)],
    picture=lambda: plots.figure()[0],
)


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Run the job on one scene; returns the exit status, what was printed, and the folder."""

    def with_scene(scene, *options):
        monkeypatch.setattr(job, "SCENES", {"tiny": scene})
        monkeypatch.setattr(stability, "trials", lambda tier: [])
        status = job.main(["-o", str(tmp_path), "-j", "1", *options])
        return status, capsys.readouterr().out, tmp_path

    return with_scene


def test_tables_pictures_and_numbers(run, monkeypatch):
    """Both tables are printed, the pictures and the numbers written, and the status is 0."""
    monkeypatch.setattr(job, "FULL", job.QUICK)
    status, printed, folder = run(SCENE, "tiny")
    assert status == 0
    for part in (
        "tol",
        "error",
        "compile/s",
        "first answer: ",
        "Dopri8",
        "1e-10",
        "easy",
        "went well",
        "prints 1 for 2.",
        "a given number",
    ):
        assert part in printed, part
    assert {path.name for path in folder.iterdir()} == {"tiny.png", "tiny_work_precision.png", "report.json"}
    rows = json.loads((folder / "report.json").read_text())["scenes"]["tiny"]["runs"]
    assert [row["tolerance"] for row in rows] == [1e-6, 1e-10]
    assert all(row["seconds"] > 0 and row["steps"] > 0 for row in rows)


def test_what_compiles_for_long_is_not_quick(run):
    """A scene marked `long` is left out of `--quick`, unless it is named."""
    long = replace(SCENE, long=True, runs=tuple)
    assert "went well" not in run(long, "--quick")[1] and "went well" in run(long, "tiny", "--quick")[1]
    assert "went well" in run(replace(long, long=False), "--quick")[1]


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        (replace(SCENE, runs=lambda: [swing(1e-8)]), "tiny: swing"),
        (replace(SCENE, runs=lambda: [swing(float("nan"))]), "tiny: swing"),
        (replace(SCENE, cases=lambda: [report.Case("hard", "went wrong", 1.0, 0.1)]), "tiny: hard"),
    ],
)
def test_a_miss_is_named_and_fails(run, scene, named):
    """An error that is too large, or NaN, in a run or a case: exit status 1 and its name."""
    status, printed, folder = run(scene, "--quick")
    assert {path.name for path in folder.iterdir()} == {"tiny_work_precision.png", "report.json", "stability.json"}
    assert status == 1
    assert f"MISSED  {named}" in printed


def test_unknown_scene(run, capsys):
    """A misspelt scene lists those that exist."""
    with pytest.raises(SystemExit):
        run(SCENE, "tinny")
    assert "no scene named tinny; there are: tiny, and stability" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_side_by_side_prints_the_same_in_order(tmp_path, capsys, monkeypatch):
    """Two scenes in separate processes print and save the same as one after the other, except for times."""
    monkeypatch.setattr(job, "_machine", lambda: "here")
    names = ["bead_on_hoop", "sliding_wedge"]

    def done(jobs):
        folder = tmp_path / jobs
        status = job.main([*names, "--quick", "-o", str(folder), "-j", jobs])
        report = json.loads((folder / "report.json").read_text())
        rows = [row for name in names for row in report["scenes"][name]["runs"]]
        titles = [line for line in capsys.readouterr().out.splitlines() if line and set(line) == {"="}]
        return status, [(row["run"], row["method"], row["error"]) for row in rows], titles

    assert done("2") == done("1")
