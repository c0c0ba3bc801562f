"""The benchmark of reported failures is correct: it passes reported failures and catches unreported ones."""

import dataclasses

import jax
import numpy as np
import pytest

from benchmarks.campaigns import fails_safely


def family(name):
    """A family of the benchmark by its name."""
    return next(family for family in fails_safely.FAMILIES if family.name == name)


few = family("too few steps")


def test_names_are_different():
    """Each family has its own name, and together they draw 300 systems."""
    assert len({family.name for family in fails_safely.FAMILIES}) == len(fails_safely.FAMILIES)
    assert len(fails_safely.FAMILIES) * fails_safely.COUNT >= 300


@pytest.mark.slow
def test_broken_systems_are_reported_and_healthy_ones_are_not():
    """Too few steps are reported alone and in lanes; the twins are accurate to 100 tolerances."""
    broken, healthy = fails_safely.judge(few, np.random.default_rng(0), 3)
    row = fails_safely.rates(few, broken, healthy)
    assert (row["cases"], row["alone"], row["lanes"], row["named"], row["false"]) == (3, 1.0, 1.0, "3/3", 0)
    assert row["worst"] < 1


@pytest.mark.slow
def test_silence_and_false_alarms_are_caught():
    """With broken and healthy systems exchanged every verdict is reversed."""

    def exchanged(rng, broken):
        case = few.draw(rng, not broken)
        case.error = None if broken else case.error
        return case

    twisted = dataclasses.replace(few, draw=exchanged)
    broken, healthy = fails_safely.judge(twisted, np.random.default_rng(0), 3)
    row = fails_safely.rates(twisted, broken, healthy)
    assert (row["alone"], row["lanes"], row["false"]) == (0.0, 0.0, 6)
    assert "alone(few_steps, Case(" in fails_safely.reproduction(twisted, broken[0])


def test_a_wrong_answer_is_no_good_one():
    """An error above the limit counts as unreported unless there was a warning; a crash always does."""
    case = few.draw(np.random.default_rng(0), False)
    line = fails_safely.WRONG * case.tolerance
    verdict = fails_safely.Verdict(case, "alone", None, 2 * line, False, 0.0)
    assert verdict.unreported and verdict.false_alarm
    assert not dataclasses.replace(verdict, error=0.5 * line).unreported
    assert not dataclasses.replace(verdict, report="a warning").unreported
    assert dataclasses.replace(verdict, report="a KeyError", crashed=True).unreported
    assert dataclasses.replace(verdict, error=np.nan).unreported


def test_every_family_draws_both_twins():
    """Each generator is reproducible, and its numbers are finite where the system is healthy."""
    for family in fails_safely.FAMILIES:
        for broken in (True, False):
            once, again = (family.draw(np.random.default_rng(5), broken).arrays() for _ in range(2))
            np.testing.assert_equal(once, again)
        assert all(np.all(np.isfinite(value)) for value in jax.tree.leaves(once)), family.name
