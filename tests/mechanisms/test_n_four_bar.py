"""The ladder of four-bars against elliptic functions, up to its singular position and after it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.mechanisms import n_four_bar
from tests.behaviour.test_end_states import TOLERANCES, WITHIN, relative_errors
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_reference
from tests.tiers import exhaustive_but


def test_ladder():
    """Jacobi's elliptic functions give the stored end, and solve the pendulum's equation."""
    mechanism = n_four_bar.MECHANISM
    assert_reference(mechanism, *published.ladder_end(2, mechanism.end, mechanism.params))
    k = (2 + 1.5) * 9.81 / (2 + 1.0)
    angle = solve_ivp(lambda t, y: [y[1], -k * np.cos(y[0])], (0, 2), [np.pi / 2, -1], "DOP853", rtol=1e-13, atol=1e-13)
    q, _ = published.ladder_end(2, 2.0, mechanism.params)
    np.testing.assert_allclose(q[0], [np.cos(angle.y[0, -1]), np.sin(angle.y[0, -1])], atol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize("rtol", exhaustive_but((1e-8,), (*TOLERANCES, 1e-12)))
def test_singular_position_is_passed_or_reported(rtol):
    """After the first singular position the end is right, or the integration reports that it failed."""
    mechanism = n_four_bar.MECHANISM
    traj = lj.integrate(
        mechanism.system, mechanism.q0, mechanism.v0, mechanism.params,
        ts=np.array([0.0, 1.0]), rtol=rtol, atol=rtol, throw=False,
    )  # fmt: skip
    right = np.all(relative_errors(traj, published.ladder_end(2, 1.0, mechanism.params)) <= WITHIN * rtol)
    assert right or not bool(traj.result == lj.RESULTS.successful)
