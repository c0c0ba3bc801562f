"""Rates of charges in units of what breaks them: in single precision, and under weak disturbances."""

import numpy as np
import pytest

import lagjax as lj
from tests.symmetric_systems import IN_SPACE, KEPLER, OF_KEPLER


@pytest.mark.slow
def test_float32_is_honest():
    """In float32 the same symmetries are found, with a smaller gap."""
    q, v = (x.astype(np.float32) for x in IN_SPACE)
    params = {name: np.float32(x) for name, x in OF_KEPLER.items()}
    found = lj.symmetries(KEPLER, q, v, params)
    assert list(found) == ["L_x", "L_y", "L_z", "Jacobi integral"] and 1e3 < found.gap < 1e8


def test_a_weak_disturbance_is_seen():
    """A field of 1e-6 breaks rotations, and the gap shows that it is small."""
    disturbed = lambda size: lj.System(lambda t, q, v, p: KEPLER.lagrangian(t, q, v, p) + size * q[0])
    found = lj.symmetries(disturbed(1e-6), *IN_SPACE, OF_KEPLER)
    assert list(found) == ["L_x", "Jacobi integral"] and found.gap < 1e10
