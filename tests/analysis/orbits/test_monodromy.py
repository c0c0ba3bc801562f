"""The monodromy matrix on constraints and without, and the multipliers that are one for a known reason."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.closed_forms import slope_of_swinging, swinging
from tests.analysis.steady_systems import conical
from tests.systems import PARAMS, pendulum


def test_pendulum():
    """M = 1 + (dT/dE) f dEᵀ in closed form, and both multipliers are 1 for a known reason."""
    amplitude = 2.0
    found = lj.floquet(pendulum, 0.0, amplitude, 0.0, PARAMS, swinging(amplitude))
    g_over_l = PARAMS["g"] / PARAMS["l"]
    slope = slope_of_swinging(amplitude)
    # With v = 0, f = (0, -g/l sin q). A start shifted by dq returns after T + T'dq, so after T it is off by -f T' dq.
    exact = np.array([[1.0, 0.0], [slope * g_over_l * np.sin(amplitude), 1.0]])
    np.testing.assert_allclose(found.monodromy, exact, atol=1e-9)
    np.testing.assert_array_equal(found.multipliers, [1.0, 1.0])
    assert found.trivial.all() and "1 (along the motion), 1 (across energies)" in repr(found)
    assert bool(found.stable) and "linearly stable" in found.verdict
    # Twin: at the equilibrium no multiplier is trivial; they are e^{±i ω T}.
    rest = lj.floquet(pendulum, 0.0, 0.0, 0.0, PARAMS, 1.0)
    np.testing.assert_allclose(rest.multipliers, np.exp([1j * np.sqrt(g_over_l), -1j * np.sqrt(g_over_l)]), rtol=1e-9)
    assert not rest.trivial.any()


@pytest.mark.exhaustive
def test_conical_pendulum():
    """Circling at an angle θ it swings about that √(1 + 3 cos² θ) times in a turn, with a constraint given twice.

    Landau & Lifshitz, *Mechanics*, §14, problem 1: by the effective potential. The rotation is a symmetry that the
    coordinates do not show, and here it is the motion itself.
    """
    again = lj.Holonomic(lambda t, q, p: 1.0 - q["r"] @ q["r"] / p["l"] ** 2)
    theta, g, l = 1.0, 9.8125, 1.25
    rate = np.sqrt(g / (l * np.cos(theta)))
    place, speed = np.array([np.sin(theta), 0.0, -np.cos(theta)]), np.array([0.0, np.sin(theta), 0.0])
    start = {"r": l * place}, {"r": rate * l * speed}
    system = lj.System(conical.lagrangian, {"rod": conical.constraints["rod"], "again": again})
    found = lj.floquet(system, 0.0, *start, {"g": g, "l": l}, 2 * np.pi / rate)
    phase = 2 * np.pi * np.sqrt(1 + 3 * np.cos(theta) ** 2)
    assert found.multipliers.shape == (4,) and found.trivial.tolist() == [True, True, False, False]
    np.testing.assert_allclose(
        found.multipliers[2:], np.cos(phase) + 1j * np.abs(np.sin(phase)) * np.array([1, -1]), atol=1e-9
    )
    assert bool(found.stable) and not bool(found.attracts)
    held = lj.System(conical.lagrangian, dict.fromkeys(("one", "two", "three"), conical.constraints["rod"]))
    with pytest.raises(ValueError, match="nothing is left to move.*\n.*depend on each other"):
        jax.jit(lambda g: lj.floquet(held, 0.0, *start, {"g": g, "l": l}, 1.0).multipliers)(g)
