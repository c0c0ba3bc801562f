"""Programs that motions share; times of calls, taken in turn, by their median, without the overhead of a call."""

import time
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from lagjax import System, Tsit5
from lagjax.system import coordinates
from lagjax.work_precision import methods
from lagjax.work_precision.methods import (
    RESOLVED,
    VERY_LONG,
    ComparedMotion,
    TimedProgram,
    interleaved_times,
    seconds_of,
    without_overhead,
)

# Integrated it would be NaN.
in_closed_form = System(lambda t, q, v, params: np.nan * v)


class Oscillation(NamedTuple):
    """The part of a trajectory that is looked at."""

    q: Any


def oscillation(system, q, v, params, *, ts, rtol, method, throw, **options):
    """In place of `integrate`: q cos ωt, off by the tolerance."""
    return Oscillation(q * jnp.cos(params["omega"] * ts) + rtol)


def test_motions_that_differ_in_numbers_share_a_program(monkeypatch):
    """Each has its own motion, cos ωt; twin: a jump's time is part of the program, which is then another."""
    monkeypatch.setattr(methods, "integrate", oscillation)

    def program(omega, options):
        start = coordinates.state(0.0, 1.0, 0.0, {"omega": omega})
        return TimedProgram(ComparedMotion(in_closed_form, start, np.array([0.0, 1.0]), options), Tsit5())

    one, other, jumped = program(1.0, {}), program(2.0, {}), program(2.0, {"jump_ts": np.array([0.5])})
    assert one._compiled is other._compiled is not jumped._compiled
    assert one.compile_seconds == other.compile_seconds > 0
    for omega, found in ((1.0, one), (2.0, other), (2.0, jumped)):
        assert float(found(1e-10).q[-1]) == pytest.approx(np.cos(omega), abs=1e-8)
    # At other times, from another start, with another tolerance, by the same program.
    ts = np.array([0.0, 2.0])
    for found in (one.at(ts)(0.25, q=np.array(3.0)), one(0.25, ts, np.array(3.0), np.array(0.0))):
        np.testing.assert_allclose(found.q, 3 * np.cos(ts) + 0.25, rtol=1e-15)
    assert 0 < one.call_seconds() < 1 and float(one.call(0.25)()[0].q[0]) == 1.25


def test_a_call_takes_its_time():
    """A pause of 0.2 s is measured as at least that; twin: a call that does nothing is shorter."""
    assert seconds_of(lambda: time.sleep(0.2)) >= 0.2 > seconds_of(lambda: None)


def test_calls_are_made_in_turn():
    """One after the other, as often as asked; a very long one is not called again, and keeps its first time."""
    made = []
    calls = [lambda name=name: made.append(name) for name in "abc"]
    times = interleaved_times(calls, [0.0, 0.0, 2 * VERY_LONG], 4)
    assert "c" not in made and made.count("a") == made.count("b") >= 4
    assert "".join(made).replace("aa", "a").replace("bb", "b") == "ab" * 4
    assert times[2] == (2 * VERY_LONG, 2 * VERY_LONG)
    assert all(0 <= x.least <= x.median for x in times)


def test_the_overhead_is_subtracted():
    """What is left is the solve; a solve that disappears in the overhead counts as the least that is resolved."""
    assert without_overhead(3.0, 1.0) == 2.0
    assert without_overhead(1.0, 1.0) == without_overhead(0.5, 1.0) == RESOLVED
