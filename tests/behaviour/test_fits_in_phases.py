"""Fits of motions in phases: the coefficient of restitution, and the phase in which a motion starts."""

import numpy as np
import pytest

import lagjax as lj

falling = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
bounce = lj.Switch("flies", to="flies", when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -params["e"] * v)
ball = lj.Hybrid({"flies": falling}, [bounce], most_switches=8)
TS = np.linspace(0.0, 2.0, 41)


def bounced(g, e):
    """Heights of a ball that falls from a height of 1, in closed form."""
    fall = np.sqrt(2 / g)
    q, begins, up = 1 - 0.5 * g * TS**2, fall, e * g * fall
    for _ in range(8):
        since = TS - begins
        q = np.where(since > 0, up * since - 0.5 * g * since**2, q)
        begins, up = begins + 2 * up / g, e * up
    return q


@pytest.mark.exhaustive
def test_what_a_bounce_leaves():
    """A fit to heights finds gravity, restitution and the start through three impacts."""
    found = lj.fit(ball, lj.Record(TS, q=bounced(9.81, 0.8)), {"g": 9.5, "e": 0.75}, progress=False)
    assert found.converged
    np.testing.assert_allclose([found.params["g"], found.params["e"]], [9.81, 0.8], rtol=1e-7)
    np.testing.assert_allclose([found.q0[0], found.v0[0]], [1.0, 0.0], atol=1e-7)
    assert found.motion().events["switches"].count == 3


def test_refused_in_words():
    """Windows, which would start in unknown phases, and an unknown phase are refused."""
    record = lj.Record(TS, q=bounced(9.81, 0.8))
    with pytest.raises(ValueError, match=r"(?s)lj\.Hybrid the phase in which each window would start is.*Fix:"):
        lj.fit(ball, record, {"g": 9.5, "e": 0.75}, window=0.5)
    with pytest.raises(ValueError, match="'lies', which is no phase.*'flies'"):
        lj.fit(ball, record, {"g": 9.5, "e": 0.75}, start="lies")
