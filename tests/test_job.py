"""The main job: tables, pictures, numbers, exit status."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lagjax import job, report, stability
from lagjax.display import plots
from lagjax.report import Case, Row, case_table, first_answer, relative_error, work_precision_table
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
    cases=lambda tier: [report.Case("easy", "went well", 0.0, 0.0)],
    picture=lambda tier: plots.figure()[0],
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
    monkeypatch.setitem(job.SETTINGS, job.MAIN, job.SETTINGS[job.QUICK])
    monkeypatch.setattr(report, "usual_methods", lambda *system: job.SETTINGS[job.QUICK]["methods"])
    monkeypatch.setattr(job, "SECONDS", {"tiny": (1, 60)})
    status, printed, folder = run(SCENE, "tiny")
    assert status == 0
    parts = "tol|error|compile/s|first answer: |Dopri8|1e-10|easy|went well|prints 1 for 2.|a given number"
    for part in [*parts.split("|"), "1 part, about 60 s in all"]:
        assert part in printed, part
    # The summary: a line for each part, with its picture, below all else.
    line = next(line for line in printed.splitlines()[-3:] if line.startswith("tiny"))
    assert "1e-12 (<= 1e-09)" in line and "1 of 1" in line and line.rstrip().endswith("tiny.png")
    assert {path.name for path in folder.iterdir()} == {"tiny.png", "tiny_work_precision.png", "report.json"}
    rows = json.loads((folder / "report.json").read_text())["scenes"]["tiny"]["runs"]
    assert [row["tolerance"] for row in rows] == [1e-6, 1e-10]
    assert all(row["seconds"] > 0 and row["steps"] > 0 for row in rows)


def test_variations_are_left_for_full(run):
    """`--quick` makes a scene's first run and one picture; variations are made by `--full` alone."""
    seen = []
    varied = replace(swing(1e-12), tier=report.FULL, name="swing, longer")
    scene = replace(SCENE, runs=lambda: [swing(1e-12), varied], cases=lambda tier: seen.append(tier) or [])
    _, printed, folder = run(scene, "tiny", "--quick")
    assert "swing, longer" not in printed and {path.suffix for path in folder.iterdir()} == {".png", ".json"}
    assert seen == [report.QUICK] and not (folder / "tiny.png").exists()
    assert [r.name for r in scene.runs() if r.tier <= report.MAIN] == ["swing"]


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        (replace(SCENE, runs=lambda: [swing(1e-8)]), "tiny: swing"),
        (replace(SCENE, runs=lambda: [swing(float("nan"))]), "tiny: swing"),
        (replace(SCENE, cases=lambda tier: [report.Case("hard", "went wrong", 1.0, 0.1)]), "tiny: hard"),
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
def test_side_by_side_prints_the_same(tmp_path, capsys, monkeypatch):
    """Two scenes in separate processes print and save the same as one after the other, except for times and order."""
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


ROW = Row("swing", "an angle", "Dopri8", 1e-10, 2e-12, None, 3e-11, 120, None, 0.0025, 1.25, "successful", 1e-9)


def test_relative_errors():
    """Each leaf is measured by its largest exact value, zeros by one; NaN stays, and another structure is no error."""
    exact = {"a": np.array([0.0, -4.0]), "b": np.zeros(2)}
    assert relative_error({"a": np.array([1.0, -4.0]), "b": np.array([0.0, 0.125])}, exact) == 0.25
    assert relative_error(exact, exact) == 0.0 and np.isnan(
        relative_error(exact | {"b": np.array([np.nan, 0.0])}, exact)
    )
    with pytest.raises(ValueError):
        relative_error({"a": exact["a"]}, exact)


def test_a_row_passes_or_not():
    """A required error is met or missed, which the table says; without one nothing is judged. NaN is a miss."""
    assert ROW.passed and "ok (<= 1e-09)" in work_precision_table([ROW])
    for error in (2e-9, float("nan")):
        missed = replace(ROW, error=error)
        assert not missed.passed and "MISSED (> 1e-09)" in work_precision_table([missed])
    assert replace(ROW, error=1.0, required=None).passed
    table = work_precision_table([ROW])
    assert "120" in table and "2.5" in table and "-" in table.splitlines()[-1].split()


def test_lines_below():
    """The first answer's seconds, and cases that went well or did not."""
    assert first_answer([ROW]).startswith("first answer: 1.2 s of tracing and compiling for 'swing' by Dopri8")
    assert "then 2.5 ms per solve" in first_answer([ROW])
    good, bad = Case("easy", "went well", 0.0, 0.1), Case("hard", "went wrong", 1.0, 0.1)
    assert good.passed and not bad.passed
    lines = case_table([good, bad]).splitlines()
    assert "ok" in lines[-2] and "MISSED" in lines[-1] and "went wrong" in lines[-1]
