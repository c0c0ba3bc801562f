"""Records that make no sense are refused."""

import numpy as np
import pytest

import lagjax as lj
from tests.fit.problem.test_arguments import Q, T


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
