"""The default method ends within ten tolerances of the reference and on the constraints, at three tolerances.

Slow: each mechanism compiles its own program (4 to 12 s), used for all tolerances and parameters.
"""

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanisms import MECHANISMS, andrews, car_axis
from lagjax.mechanisms.planar import ANDREWS_MULTIPLIERS, CAR_AXIS_MULTIPLIERS
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import stacked
from tests.tiers import exhaustive_but

pytestmark = pytest.mark.slow

TOLERANCES = (1e-6, 1e-8, 1e-10)
WITHIN = 10.0
# Measured errors above ten tolerances. At the looser two the ladder's errors belong to the problem itself: the single
# pendulum in its angle is off by 420 and 180 rtol there.
MISSED = {
    ("car_axis", 1e-6): "velocity 23 rtol: an oscillation of 45 rad/s, whose velocity error is 45 position errors",
    ("n_four_bar", 1e-6): "position 17 rtol, velocity 67 rtol after ten singular positions",
    ("n_four_bar", 1e-8): "position 14 rtol, velocity 57 rtol after ten singular positions",
    ("n_four_bar", 1e-10): "position 530 rtol, velocity 2200 rtol after ten singular positions",
}
# No drive, no dissipation: the Jacobi integral is constant.
CONSERVATIVE = ("andrews", "bricard", "double_pendulum", "n_four_bar", "slider_crank")


def run(mechanism, rtol, params=None, end=None):
    """The trajectory to the mechanism's end, by the default method."""
    ts = np.array([0.0, mechanism.end if end is None else end])
    return lj.integrate(
        mechanism.system, mechanism.q0, mechanism.v0, mechanism.params if params is None else params,
        ts=ts, rtol=rtol, atol=rtol, max_steps=200_000,
    )  # fmt: skip


def relative_errors(traj, reference):
    """The errors of the final positions and velocities, each relative to the largest; absolute if all are at rest."""
    last = [stacked(jax.tree.map(lambda x: x[-1], part)) for part in (traj.q, traj.v)]
    wanted = [np.ravel(part) if isinstance(part, np.ndarray) else stacked(part) for part in reference]
    return np.array([np.max(np.abs(x - y)) / (np.max(np.abs(y)) or 1.0) for x, y in zip(last, wanted)])


def reference_of(mechanism):
    """The stored end; for Andrews' mechanism at 1e-10 the recomputed one, since the published one has nine digits."""
    if mechanism is andrews:
        start = stacked(mechanism.q0), stacked(mechanism.v0)
        return published.andrews_end(*start, mechanism.end, mechanism.params)
    return mechanism.reference


# The others take longer to compile.
IN_SECONDS = ("double_pendulum",)


@pytest.mark.parametrize("name", exhaustive_but(IN_SECONDS, sorted(MECHANISMS)))
def test_end_state(name):
    """Positions and velocities at the end are within ten tolerances, or known to miss; constraints and energy hold.

    A known miss that is now within ten tolerances fails too, and must be removed from the list.
    """
    mechanism, missed = MECHANISMS[name], {}
    for rtol in TOLERANCES:
        traj = run(mechanism, rtol)
        assert float(traj.residual()) <= 1e-12
        assert name not in CONSERVATIVE or (name, rtol) in MISSED or float(traj.drift()) <= 10 * rtol
        errors = relative_errors(traj, reference_of(mechanism)) / rtol
        if not np.all(errors <= WITHIN):
            missed[name, rtol] = errors
    assert missed.keys() == {key for key in MISSED if key[0] == name}, missed


@pytest.mark.parametrize(
    ("mechanism", "theirs", "sign", "names", "digits"),
    [
        pytest.param(andrews, ANDREWS_MULTIPLIERS[-1], -1.0, ("loops",), 1e-6, marks=pytest.mark.exhaustive),
        (car_axis, CAR_AXIS_MULTIPLIERS, 1.0, ("upright", "axle"), 1e-8),
    ],
)
def test_multipliers_of_the_source(mechanism, theirs, sign, names, digits):
    """λ at the end is the source's: for Andrews (six digits) with the sign reversed, for the car axis unchanged."""
    traj = run(mechanism, 1e-10)
    ours = np.concatenate([np.ravel(traj.multipliers[name][-1]) for name in names])
    assert np.max(np.abs(ours - sign * np.array(theirs))) <= digits * np.max(np.abs(theirs))
