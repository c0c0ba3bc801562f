"""Tolerances, numbers of steps and times that cannot be meant are refused in words."""

import numpy as np
import pytest

import lagjax as lj

spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"rtol": np.inf}, "rtol is infinite"),
        ({"atol": np.inf}, "atol is infinite"),
        ({"rtol": (1e-9, np.inf)}, "rtol is infinite"),
        ({"max_steps": 2**70}, "more than can be counted.*2,147,483,647"),
        ({"max_steps": 2**31}, "more than can be counted"),
        ({"ts": [1e16, 1e16 + 2]}, "no room for steps"),
        ({"ts": [1e16 + 400, 1e16]}, "no room for steps"),
    ],
)
def test_refused(options, words):
    """Each is a ValueError that says what is wrong; twin: its neighbour that can be meant passes the same check."""
    with pytest.raises(ValueError, match=f"(?s){words}.*Fix:"):
        lj.integrate(spring, 1.0, 0.0, **({"ts": [0.0, 1.0]} | options))


def test_what_can_be_meant():
    """The largest countable number of steps, and a loose tolerance, are taken."""
    traj = lj.integrate(spring, 1.0, 0.0, ts=[0.0, 1.0], rtol=1e-6, max_steps=2**31 - 1)
    np.testing.assert_allclose(traj.q[-1], np.cos(1.0), rtol=1e-4)
