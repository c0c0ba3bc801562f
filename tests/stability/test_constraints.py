"""The swing on a rod given twice obeys the equations with both rods, in closed form."""

import numpy as np

from lagjax.stability.constraints import _on_the_rod, redundant, twice
from tests.stability.closed_forms import defect

TIMES = np.array([0.3, 0.9, 2.0])


def test_the_swing_on_two_rods():
    """Elliptic functions are a motion on the redundant rods; twin: not under another gravity."""
    row = redundant()[0]
    assert defect(twice, _on_the_rod, row.q0, row.v0, row.params, TIMES) < 1e-8

    def heavier(q0, v0, params, ts):
        return _on_the_rod(q0, v0, params | {"g": 10.0}, ts)

    assert defect(twice, heavier, row.q0, row.v0, row.params, TIMES) > 1e-2
