"""References: how far they can be trusted, and those that are wrong or do not fit."""

import numpy as np
import pytest

import lagjax as lj
from tests.work_precision.test_work_precision import RATE, compared, swing


@pytest.mark.parametrize("off", [0.0, 1e-5])
def test_a_wrong_reference_is_found_out(made_up, off):
    """If solves agree with each other but not with the reference, its error is reported; twin: the right reference."""
    wrong = lambda ts: swing(ts, (1 + off) * RATE)
    found = compared(methods=[lj.Dopri8()], tolerances=(1e-6, 1e-9, 1e-10), reference=wrong)
    if off:
        assert not found.reference.agrees and 1e-5 < found.reference.error < 1e-3
        assert not any(point.trusted for point in found["Dopri8"].points[1:])
        assert "WARNING" in repr(found) and "not to be trusted" in repr(found)
    else:
        assert found.reference.agrees and found.reference.error < 1e-9
        assert found["Dopri8"].points[0].trusted and "WARNING" not in repr(found)
        with pytest.raises(ValueError, match="no method stays within 1e-16: the nearest is Dopri8"):
            found.best(error=1e-16)


def test_a_motion_that_amplifies_is_said_to(made_up):
    """From 1e-9 next to the top, two methods no longer agree after 25 s."""
    found = compared(np.pi - 1e-9, np.array([0.0, 25.0]), methods=[lj.Dopri8()], tolerances=(1e-6, 1e-12))
    assert not found.reference.agrees and found.reference.digits <= 7
    assert "WARNING" in repr(found)


@pytest.mark.parametrize(
    ("reference", "error", "words"),
    [
        ((np.zeros(4),), TypeError, "two things"),
        ((np.zeros(4), {"theta": np.zeros(4)}), ValueError, "velocities are not in the structure of v0"),
        ((np.zeros(2), np.zeros(4)), ValueError, r"shape \(2,\) at 'q', but \(4,\) is needed"),
    ],
)
def test_a_reference_that_does_not_fit(made_up, reference, error, words):
    """The reference must have the structure and shapes of the motion at its times."""
    with pytest.raises(error, match=words):
        compared(methods=[lj.Tsit5()], tolerances=(1e-3,), reference=reference)
