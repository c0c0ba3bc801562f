"""Progress is shown: the wait for the compiler once, and a meter."""

import importlib.util
from contextlib import nullcontext

import jax
import pytest

import lagjax as lj
from lagjax.integrate.solve import one_motion, programs
from tests.systems import PARAMS, TS, pendulum


@pytest.mark.slow
def test_the_wait_for_the_compiler_is_told_once(monkeypatch):
    """The first motion of a kind announces its compilation, as `progress` says; the next one compiles nothing."""
    told = []
    monkeypatch.setattr(programs, "waiting", lambda *said: told.append(said) or nullcontext())
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    for g in (1.0, 2.0):
        lj.integrate(system, 1.0, 0.0, {"g": g}, ts=TS, estimate_error=False)
    assert told == [(None, "compiling")]
    # Not showing progress uses the same program; another system needs a new one.
    lj.integrate(system, 1.0, 0.0, {"g": 1.0}, ts=TS, estimate_error=False, progress=False)
    assert len(told) == 1
    lj.integrate(lj.System(lambda t, q, v, params: v**2), 1.0, 0.0, ts=TS, estimate_error=False, progress=False)
    assert told[1:] == [(False, "compiling")]


def test_meters(monkeypatch):
    """A meter of tqdm, or of text without it; twin: none is shown without being asked for."""
    kinds = lambda: [type(one_motion._progress_meter(progress)).__name__ for progress in (True, False, None)]
    assert kinds() == ["TqdmProgressMeter", "NoProgressMeter", "NoProgressMeter"]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert kinds() == ["TextProgressMeter", "NoProgressMeter", "NoProgressMeter"]


@pytest.mark.slow
def test_progress_is_shown(capfd):
    """`progress=True` shows a meter."""
    jax.block_until_ready(lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, progress=True))
    jax.effects_barrier()
    shown = capfd.readouterr()
    assert "100.00%" in shown.out + shown.err
