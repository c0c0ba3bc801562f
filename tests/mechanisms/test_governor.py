"""The governor: its stored end against the two equations of its angle and its height."""

import numpy as np

from lagjax.mechanisms import governor
from tests.by_numpy import equations
from tests.mechanisms import published


def test_its_accelerations():
    """At a state off its start, and in motion, slider and balls accelerate as the two equations have it."""
    p, parts = governor.PARAMS | {"k": 50.0, "c": 3.0}, governor.GovernorParts
    tree = lambda x: parts(x[0], x[1], x[2:5], x[5:])
    field, y = published.governor_field(p), np.array([0.4, 0.7, 0.45, 1.5, -0.8])
    found = equations(governor.system, 0.0, *map(tree, published.governor_state(p, field, y)), p).a
    step = 2.0**-20 * np.array(field(0.0, y))
    (_, more), (_, less) = (published.governor_state(p, field, y + way * step) for way in (1, -1))
    exact = tree((more - less) * 2.0**19)
    for ours, right in zip(found, exact):
        np.testing.assert_allclose(ours, right, rtol=1e-7, atol=1e-7)
