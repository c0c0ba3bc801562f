"""The equations of a branch of cycles: relative ones, on constraints, and multipliers that meet."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import lagjax as lj
from tests.analysis.closed_forms import swinging
from tests.analysis.continuation.test_orbits import UNIT
from tests.systems import rod_pendulum


@pytest.mark.exhaustive
@pytest.mark.parametrize("along, to", [("energy", 0.9), ("l", 3.0)])
def test_pendulum_on_a_rod(along, to):
    """With a constraint: along the energy, and along the rod's length at constant energy; the rod keeps its length."""
    start = {"x": np.sin(1.0), "y": -np.cos(1.0)}, {"x": 0.0, "y": 0.0}
    orbit = lj.periodic_orbit(rod_pendulum, start, 6.7, UNIT | {"m": 1.0})
    branch = lj.continue_orbits(orbit, along=along, to=to)
    energy, length = (branch.parameter, 1.0) if along == "energy" else (-np.cos(1.0), branch.parameter)
    np.testing.assert_allclose(branch.period, swinging(np.arccos(-energy / length), UNIT | {"l": length}), rtol=1e-10)
    np.testing.assert_allclose(np.hypot(branch.q["x"], branch.q["y"]), length, rtol=1e-12)
    assert branch.status == "the end of the range" and branch.stable.all()


@pytest.mark.exhaustive
def test_relative_orbits():
    """In a central force, along the exponent of its law: the harmonic oscillator, at r², has the period π in r."""

    def lagrangian(t, q, v, p):
        return 0.5 * (v["r"] ** 2 + (q["r"] * v["phi"]) ** 2) - q["r"] ** p["power"] / p["power"]

    start = {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 0.5}
    orbit = lj.periodic_orbit(lj.System(lagrangian), start, 1.8, {"power": 1.0}, relative="phi")
    branch = lj.continue_orbits(orbit, along="power", to=2.0)
    np.testing.assert_allclose(branch.period[-1], np.pi, rtol=1e-11)
    assert abs(branch.period[0] - np.pi) > 0.03


@pytest.mark.exhaustive
def test_combination_resonance():
    """Two oscillators coupled by a drive near the sum of their frequencies: two pairs meet, by SciPy's multipliers."""

    def lagrangian(t, q, v, p):
        springs = 0.5 * (q[0] ** 2 + p["k"] * q[1] ** 2)
        return 0.5 * v @ v - springs - p["e"] * jnp.cos(p["omega"] * t) * q[0] * q[1]

    params = {"k": 2.0, "e": 0.25, "omega": 2.1}
    orbit = lj.periodic_orbit(lj.System(lagrangian), (np.zeros(2), np.zeros(2)), 2 * np.pi / 2.1, params)
    branch = lj.continue_orbits(orbit, along="omega", to=2.7)
    assert [c.kind for c in branch.critical] == ["torus", "torus"]

    def growth(omega):
        coupling = lambda t: params["e"] * np.cos(omega * t)
        rate = lambda t, y: [y[2], y[3], -y[0] - coupling(t) * y[1], -params["k"] * y[1] - coupling(t) * y[0]]
        columns = [integrate.solve_ivp(rate, [0, 2 * np.pi / omega], e, rtol=1e-12, atol=1e-13).y[:, -1]
                   for e in np.eye(4)]  # fmt: skip
        return np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max() - 1

    first, second = (float(c.parameter) for c in branch.critical)
    assert first < 1 + np.sqrt(2.0) < second
    for edge, out in ((first, -1), (second, 1)):
        assert growth(edge + out * 1e-6) < 1e-5 < growth(edge - out * 1e-6) < 1e-2
    assert "a pair at ±" in repr(branch)
