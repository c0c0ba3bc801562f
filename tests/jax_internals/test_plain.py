"""The fallback to plain JAX: when it is taken, what is tried before, and what is remembered of that."""

import subprocess
import sys

import jax
import jaxlib.version
import pytest

from lagjax.jax_internals import plain, trial, trial_programs


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """A cache directory of this test, an undecided process, and an unknown jaxlib."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(plain, "_decided", [])
    monkeypatch.setattr(plain, "_WANTED", "")
    monkeypatch.setattr(plain, "KNOWN", {"0.0"})
    return tmp_path / "lagjax"


def test_this_version_is_known():
    """The tests run with a version that needs no trial: it is in the list of known ones."""
    assert jaxlib.version.__version__ in plain.KNOWN


@pytest.mark.parametrize(("wanted", "expected"), [("1", True), ("0", False)])
def test_the_variable_decides(monkeypatch, cache, wanted, expected):
    """With the variable set there is no trial."""
    monkeypatch.setattr(plain, "_WANTED", wanted)
    monkeypatch.setattr(subprocess, "run", None)
    assert plain.is_plain() is expected


def test_a_known_version_costs_nothing(monkeypatch, cache):
    """A known version starts no process and reads no file."""
    monkeypatch.setattr(plain, "KNOWN", {jaxlib.version.__version__})
    monkeypatch.setattr(plain, "survives", None)
    assert plain.is_plain() is False and not cache.exists()


def test_an_unknown_version_is_tried_once(monkeypatch, cache):
    """The trial passes with this XLA, in a process of its own; afterwards the remembered outcome is enough."""
    assert plain.is_plain() is False
    assert [path.read_text() for path in cache.iterdir()] == ["passed"]
    monkeypatch.setattr(plain, "_decided", [])
    monkeypatch.setattr(subprocess, "run", None)
    assert plain.is_plain() is False


def test_a_trial_that_ends_the_process(monkeypatch, cache):
    """The fallback is taken with one warning, now and in the next process, which does not try again."""
    monkeypatch.setattr(trial, "CODE", "import os, sys; {path!r}; os.abort()")
    with pytest.warns(
        UserWarning, match=f"does not know jaxlib {jaxlib.version.__version__}(?s:.*)several times slower"
    ):
        assert plain.is_plain() is True
    assert plain.is_plain() is True
    monkeypatch.setattr(plain, "_decided", [])
    monkeypatch.setattr(subprocess, "run", None)
    with pytest.warns(UserWarning, match="LAGJAX_PLAIN=0 for no trial"):
        assert plain.is_plain() is True


def test_no_trial_is_not_remembered(monkeypatch, cache):
    """If no process can be started, the fallback is taken this time only."""
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.warns(UserWarning, match="does not know jaxlib"):
        assert plain.is_plain() is True
    assert not cache.exists()


def test_a_disk_that_cannot_be_written_to(monkeypatch, cache):
    """There is no error, and the trial counts."""
    cache.write_text("a file in the place of the directory")
    monkeypatch.setattr(trial, "_run_trial", lambda: trial.PASSED)
    assert plain.is_plain() is False


def test_half_a_file_is_no_answer(monkeypatch, cache):
    """The content of the file counts only if it is one of the two outcomes."""
    told = iter([trial.PASSED, trial.FAILED])
    monkeypatch.setattr(trial, "_run_trial", lambda: next(told))
    assert trial.survives()
    (file,) = cache.iterdir()
    file.write_text("pas")
    assert not trial.survives() and file.read_text() == "failed"


def test_import_decides_nothing():
    """Importing lagjax reads no outcome and starts no process: the first program decides."""
    code = "import lagjax; from lagjax.jax_internals import plain; assert not plain._decided"
    subprocess.run([sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}"], check=True)


def test_the_programs_of_the_trial_can_fail():
    """Twin: a wrong answer raises, which ends the process of the trial with an error."""
    with pytest.raises(AssertionError):
        trial_programs._agree(lambda x: 2 * x, 5.0, jax.numpy.asarray(2.0))
