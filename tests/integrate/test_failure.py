"""A motion that fails says where it stopped, why, and what to do; inside programs too."""

import importlib
import re
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import failure
from lagjax.system import coordinates
from tests.systems import PARAMS, TS, motion, pendulum


def test_failure_under_jit_is_not_silent(monkeypatch):
    """Inside jit a failed integration raises at run time; with throw=False it carries its result."""
    done = motion("pendulum")
    coded = lambda code: eqx.tree_at(lambda result: result._value, done.result, code)
    solved = lambda problem: replace(done, result=coded(problem.q.astype(int)))
    monkeypatch.setattr(importlib.import_module("lagjax.integrate.integrate"), "run", solved)
    # In place of a solve, with the start as the number of its result.
    run = jax.jit(
        lambda q0, throw: lj.integrate(pendulum, q0, 0.0, PARAMS, ts=TS, throw=throw).result._value, static_argnums=1
    )
    failed = float(lj.RESULTS.start_not_finite._value)
    with pytest.raises(RuntimeError, match="not finite"):
        jax.block_until_ready(run(failed, True))
    assert run(failed, False) == failed and run(0.0, True) == 0


def test_what_only_a_program_knows():
    """A start, lengths of steps and times that are known at run time alone: each has its result; twin: good ones."""

    def result(q0, dt0, max_step, end):
        ts, options = jnp.stack([0.0, end]), {"dt0": dt0, "max_step": max_step, "throw": False}
        return lj.integrate(pendulum, q0, 0.0, PARAMS, ts=ts, **options).result._value

    run, good = jax.jit(result), {"q0": 0.5, "dt0": 0.1, "max_step": 1.0, "end": 2.0}
    unordered, not_finite = lj.RESULTS.unordered, lj.RESULTS.start_not_finite
    cases = {"end": (-2.0, unordered), "dt0": (-0.1, unordered), "max_step": (-0.1, unordered)}
    for name, (value, expected) in (cases | {"q0": (np.nan, not_finite)}).items():
        assert run(**good | {name: value}) == int(expected._value), name
    assert run(**good) == int(lj.RESULTS.successful._value)
    assert "NumPy array" in lj.RESULTS[unordered]


def test_a_refused_start_says_why(monkeypatch):
    """With a reason where there is one, else in the words of the result; what stopped later is another error."""
    done, settings = motion("pendulum"), None
    start = coordinates.state(0.0, 1.0, 0.0, PARAMS)
    monkeypatch.setattr(failure, "of_guards", lambda *given: "")
    monkeypatch.setattr(failure, "stopped_early", lambda *given: "stopped")
    for reason, words in (("the mass is zero", "the mass is zero"), (None, lj.RESULTS[lj.RESULTS.start_singular])):
        monkeypatch.setattr(failure, "explain_failure", lambda *given, reason=reason: reason)
        with pytest.raises(ValueError, match=re.escape(words)):
            failure.raise_failure(replace(done, result=lj.RESULTS.start_singular), start, settings, None)
    with pytest.raises(RuntimeError, match="stopped"):
        failure.raise_failure(replace(done, result=lj.RESULTS.max_steps_reached), start, settings, None)
