"""Fekete points: the published state is at rest, with equal multipliers."""

import numpy as np

from lagjax.mechanisms import fekete


def test_fekete():
    """The published rest state is one: no tangential force on any particle, and λ = -19/4; the start is not."""
    mechanism = fekete.MECHANISM

    def forces(points):
        apart = points[:, None] - points[None]
        squares = np.sum(apart**2, axis=2) + np.eye(20)
        return np.sum(apart / squares[..., None], axis=1)

    assert np.max(np.abs(forces(fekete.REST) - 2 * 19 / 4 * fekete.REST)) < 1e-10
    assert np.max(np.abs(forces(mechanism.q0) - 2 * 19 / 4 * mechanism.q0)) > 0.1
