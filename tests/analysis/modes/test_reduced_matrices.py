"""Matrices on the constraint surface: the constraints' own stiffness, and redundant ones."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.modes.test_normal_modes import EQUAL
from tests.systems import DOUBLE_PARAMS, double_pendulum, double_rods, rod_pendulum


def test_the_force_of_a_constraint_is_in_the_stiffness():
    """A rod pendulum in Cartesian coordinates gets g/l from λ·∂²g alone; L itself has no stiffness."""
    params = {"g": 9.8125, "l": 1.25}
    modes = lj.normal_modes(rod_pendulum, 0.0, {"x": 0.0, "y": -1.25}, {"x": 0.0, "y": 0.0}, params)
    found = modes.linearisation
    np.testing.assert_allclose(modes.frequency, [np.sqrt(params["g"] / params["l"])], **EQUAL)
    np.testing.assert_allclose(found.stiffness[0, 0], -2 * found.multipliers["rod"], rtol=1e-13)
    assert len(modes) == 1 and np.abs(modes.shapes["y"][0]) < 1e-12


@pytest.mark.exhaustive
def test_the_double_pendulum_by_angles_and_by_rods():
    """The roots of det(K - ω² M), in angles, with two constraints, and with one constraint given twice."""
    m1, m2, l1, l2, g = (DOUBLE_PARAMS[name] for name in ("m1", "m2", "l1", "l2", "g"))
    M = np.array([[(m1 + m2) * l1**2, m2 * l1 * l2], [m2 * l1 * l2, m2 * l2**2]])
    K = np.diag([(m1 + m2) * g * l1, m2 * g * l2])
    exact = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real))
    by_angles = lj.normal_modes(double_pendulum, 0.0, np.zeros(2), np.zeros(2), DOUBLE_PARAMS)
    hanging = {"first": np.array([0.0, -l1]), "second": np.array([0.0, -l1 - l2])}
    at = 0.0, hanging, jax.tree.map(np.zeros_like, hanging), DOUBLE_PARAMS
    twice = lj.System(double_rods.lagrangian, {**double_rods.constraints, "again": double_rods.constraints["inner"]})
    for modes in (by_angles, lj.normal_modes(double_rods, *at), lj.normal_modes(twice, *at)):
        np.testing.assert_allclose(modes.frequency, exact, **EQUAL)
        assert modes.verdict == "stable"
