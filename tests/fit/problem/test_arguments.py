"""Wrong records, names and guesses raise errors in the user's words."""

import numpy as np
import pytest

import lagjax as lj
from lagjax.fit.arguments import problem_of
from lagjax.fit.records import cut
from tests.fit.cases import PENDULUM, pendulum

T = np.linspace(0.0, 1.0, 20)
Q = np.cos(T)


RECORD = lj.Record(T, q=Q)
KNOWN = lj.Record(T, q=Q, q0=1.0, v0=0.0, hold_q=True, hold_v=True)


@pytest.mark.parametrize(
    "arguments, error, words",
    [
        ((RECORD, PENDULUM, {"free": "length"}), ValueError, "free names 'length'.*'l'"),
        ((RECORD, PENDULUM, {"free": "l[0]"}), ValueError, r"free names 'l\[0\]'.*elements as 'm\[1\]'"),
        ((lj.Record(T, q=np.nan * Q), PENDULUM, {}), ValueError, "all measurements are NaN"),
        ((RECORD, PENDULUM | {"m": 1}, {"free": "m"}), ValueError, "whole number"),
        ((RECORD, PENDULUM, {"bounds": {"l": (2.0, None)}}), ValueError, "'l' starts at 1.25.*inside its bounds"),
        ((RECORD, PENDULUM, {"bounds": {"l": 2.0}}), ValueError, "must be a pair"),
        ((RECORD, PENDULUM, {"priors": {"l": (1.0, 0.1)}}), ValueError, "prior must be weighed.*sigma"),
        ((RECORD, PENDULUM, {"loss": "huber"}), ValueError, "how large an ordinary error is"),
        ((RECORD, PENDULUM, {"loss": "cubic"}), ValueError, "'squares'"),
        ((RECORD, PENDULUM, {"observe": lambda t, q, v, params: q}), ValueError, "belong together"),
        ((RECORD, PENDULUM, {"ts": T}), ValueError, "'ts' cannot be given"),
        ((RECORD, PENDULUM, {"optimiser": "adam"}), TypeError, "lj.fit_loss"),
        ((RECORD, PENDULUM, {"window": 0.01}), ValueError, "shorter than two intervals"),
        ((Q, PENDULUM, {}), TypeError, "lj.Record"),
        ((KNOWN, PENDULUM, {"free": []}), ValueError, "nothing is left to find"),
        ((lj.Record(T, q={"theta": Q}, q0=0.1, v0=0.0), PENDULUM, {}), ValueError, "was measured as"),
        ((lj.Record(T, v=Q), PENDULUM, {}), ValueError, "no guess of its start"),
        ((lj.Record(T, q=Q, v=Q), PENDULUM, {}), ValueError, "several kinds.*sigma"),
        ((lj.Record(T, q=Q, sigma={"v": 0.1}), PENDULUM, {}), ValueError, "sigma has no entry 'q'"),
        ((lj.Record(T, q=Q, sigma=-1.0), PENDULUM, {}), ValueError, "sigma must be positive"),
        ((lj.Record(T, q=Q, params={"mass": 2.0}), PENDULUM, {}), ValueError, "'mass', which is no entry of params"),
        ((lj.Record(T, q=Q, params={"m": 2.0}), PENDULUM, {}), ValueError, "which the fit is to find"),
        ((lj.Record(T, end={"t": 1.0}, q0=0.1, v0=0.0), PENDULUM, {}), ValueError, "event"),
        (([RECORD, lj.Record(T, v=Q)], PENDULUM, {}), ValueError, "record 1 holds 'v'"),
        (([RECORD, lj.Record(T, q=Q, sigma=1.0)], PENDULUM, {}), ValueError, "record 0 has no sigma"),
    ],
)
def test_arguments(arguments, error, words):
    """Arguments that do not match are named before anything is compiled."""
    records, params, options = arguments
    with pytest.raises(error, match="(?s)" + words):
        lj.fit(pendulum, records, params, **options)


def test_wrapped_angles():
    """An angle that jumps by a turn gives a warning; twin: unwrapped it gives none (an error here)."""
    angle = np.linspace(0.0, 9.0, 60)
    record = lambda q: lj.Record(np.linspace(0.0, 1.0, 60), q=q, sigma=0.1)
    ask = lambda q: problem_of(pendulum, record(q), PENDULUM, "g", None, None, None, "squares", None, {})
    ask(angle)
    with pytest.warns(lj.FitWarning, match=r"'q' of record 0(.|\n)*np.unwrap"):
        ask((angle + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: lj.Record(T[::-1], q=Q), "must increase, but t"),
        (lambda: lj.Record(np.where(T > 0.5, np.nan, T), q=Q), "NaN"),
        (lambda: lj.Record(T, q=Q[:-1]), r"shape \(19,\), but the record has 20 times"),
        (lambda: lj.Record(T, q={"theta": Q[None]}), "'theta' has the shape"),
        (lambda: lj.Record(T, q=np.where(T > 0.5, np.inf, Q)), "infinity"),
        (lambda: lj.Record(T), "no measurement"),
        (lambda: lj.Record([0.0], q=[1.0]), "two or more"),
        (lambda: lj.Record(T, q=Q, hold_v=True), "v0 is known, but it is not given"),
        (lambda: lj.Record(T, q={"theta": Q}, hold_q="theta"), "q0 is known"),
    ],
)
def test_records(make, words):
    """A record that makes no sense raises an error that says why."""
    with pytest.raises(ValueError, match=words):
        make()


def test_the_window_that_is_proposed_is_taken():
    """With a gap in the record too, where twenty ordinary intervals are not enough."""
    t = np.append(np.linspace(0.0, 1.0, 11), [3.0, 3.1])
    record = lj.Record(t, q=np.cos(t), q0=1.0, v0=0.0)
    with pytest.raises(ValueError) as refused:
        cut([record], 0.5, float)
    proposed = float(str(refused.value).split("window=")[1].rstrip("."))
    assert cut([record], proposed, float).count == 1 and proposed > 20 * 0.1
