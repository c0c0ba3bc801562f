"""Generators that are tried: gauge terms of tilted and magnetic fields, waves that travel, scalings."""

import jax.numpy as jnp
import numpy as np

import lagjax as lj
from tests.symmetric_systems import IN_SPACE, KEPLER, OF_KEPLER


def test_kepler_and_what_is_no_motion_of_points():
    """Only L and E are found, not the Runge-Lenz vector; the scaling of Kepler's third law is listed separately."""
    found = lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER)
    assert list(found) == ["L_x", "L_y", "L_z", "Jacobi integral"]
    (third,) = found.scalings
    assert third.exponents == {"q[0]": 1.0, "q[1]": 1.0, "q[2]": 1.0, "t": 1.5} and third.factor == -1.0
    rubbed = lj.System(KEPLER.lagrangian, dissipation=lambda t, q, v, params: 0.05 * v @ v)
    assert len(lj.symmetries(rubbed, *IN_SPACE, OF_KEPLER)) == 0
    # For an inverse square potential the scaling leaves the action unchanged, so it is a symmetry: x·p - 2 t E.
    square = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v @ v - p["k"] / (q @ q))
    found = lj.symmetries(square, *IN_SPACE, OF_KEPLER)
    assert found.timed == ("q·p - 2 t (Jacobi integral)",) and not found.scalings
    charge, (q, v), t = found[found.timed[0]], IN_SPACE, 0.25
    energy = lj.jacobi_integral(square, t, q, v, OF_KEPLER)
    np.testing.assert_allclose(charge(t, q, v, OF_KEPLER), OF_KEPLER["m"] * q @ v - 2 * t * energy, rtol=1e-12)


def test_fields_that_are_tilted():
    """The momentum across a tilted uniform force is conserved; a magnetic field allows shifts up to a gauge."""
    tilted = lj.System(lambda t, q, v, p: 0.5 * v @ v + 3 * q[0] + 4 * q[1])
    found = lj.symmetries(tilted, np.array([1.0, 2.0]), np.array([0.25, 0.5]))
    assert found.steady == ("4 p_q[0] - 3 p_q[1]", "Jacobi integral")
    magnetic = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v @ v + p["B"] * q[0] * v[1])
    found = lj.symmetries(magnetic, *IN_SPACE, {"m": 1.3, "B": 2.5})
    words = "p_q[0] - B q[1] with B = 2.5", "2 L_z - B q[0]^2 + B q[1]^2 with B = 2.5"
    assert set(found.steady) == {"p_q[1]", "p_q[2]", "Jacobi integral", *words}
    # p_x - B y and p_y are the centres of the circles: their rates of change vanish.
    np.testing.assert_allclose([found[w].rate(0.0, *IN_SPACE, {"m": 1.3, "B": 2.5}) for w in words], 0.0, atol=1e-13)


def test_a_wave_that_travels():
    """In a travelling wave neither p nor E is conserved, but ω p - k E is."""
    wave = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.cos(p["k"] * q - p["w"] * t))
    found = lj.symmetries(wave, 0.3, 0.5, {"k": 2.1, "w": 3.3})
    assert list(found) == ["w p_q - k Jacobi integral with w = 3.3, k = 2.1"]


def test_a_weak_disturbance_is_seen():
    """A field of 1e-6 breaks rotations, and the gap shows that it is small."""
    disturbed = lambda size: lj.System(lambda t, q, v, p: KEPLER.lagrangian(t, q, v, p) + size * q[0])
    found = lj.symmetries(disturbed(1e-6), *IN_SPACE, OF_KEPLER)
    assert list(found) == ["L_x", "Jacobi integral"] and found.gap < 1e10
