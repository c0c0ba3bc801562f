"""Closed forms of the bead and the wedge in their extreme cases obey the equations."""

import numpy as np
import pytest

from lagjax.scenes import bead_on_hoop, sliding_wedge
from lagjax.stability.hoop_and_wedge import _bead_motion, _wedge_motion, single
from tests.stability.closed_forms import defect

BEAD = {"m": 0.5, "a": 0.75, "g": 9.8125, "omega": 0.0}


@pytest.mark.parametrize("ratio", [1e-12, 1.0, 1e6])
def test_the_wedge(ratio):
    """Uniform accelerations at any ratio of the masses; twin: those at another angle are none."""
    params = sliding_wedge.PARAMS | {"m": ratio, "M": 1.0}
    start, times = (sliding_wedge.Q0, sliding_wedge.V0), np.array([0.1, 0.5])
    assert defect(sliding_wedge.system, _wedge_motion, *start, params, times) < 1e-10

    def steeper(q0, v0, params, ts):
        return _wedge_motion(q0, v0, params | {"alpha": params["alpha"] + 0.01}, ts)

    assert defect(sliding_wedge.system, steeper, *start, params, times) > 1e-3


@pytest.mark.parametrize("omega", [0.0, 2.0])
def test_the_bead(omega):
    """Elliptic functions swing from rest at any angle; twin: with another radius they do not."""
    params, times = BEAD | {"omega": omega}, np.array([0.2, 0.6, 1.0])
    assert defect(bead_on_hoop.system, _bead_motion, 1.0, 0.0, params, times) < 1e-8

    def larger(q0, v0, params, ts):
        return _bead_motion(q0, v0, params | {"a": 0.8}, ts)

    assert defect(bead_on_hoop.system, larger, 1.0, 0.0, params, times) > 1e-2


def test_a_tree_in_single_precision():
    """All numbers become float32."""
    found = single({"a": 0.1, "b": np.array([1.0, 2.0])})
    assert found["a"].dtype == found["b"].dtype == np.float32 and found["a"] == np.float32(0.1)
