"""Geodesics on the sphere, in both forms, against great circles and the reference values of source §1.

Formulas are evaluated in NumPy; `python -m lagjax` integrates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.mechanics.lagrangian import jacobi_integral
from lagjax.scenes import sphere_geodesic as geodesic
from tests.by_numpy import by_numpy, equations
from tests.references import keys, reference, reference_inputs

PARAMS, R = geodesic.PARAMS, geodesic.PARAMS["R"]
PAIRS = [key.removesuffix(".inputs") for key in keys("s1") if key.endswith(".inputs")]
NAMES = {
    "A": "A",
    "B": "B",
    "clairaut_cos_i": "clairaut",
    "mid_colat": "mid_colatitude",
    "mid_az": "mid_azimuth",
    "vertex_colat": "vertex_colatitude",
    "vertex_az": "vertex_azimuth",
}


plane_and_arc = by_numpy(geodesic.plane_and_arc)
over_azimuth = by_numpy(geodesic.exact_over_azimuth)


def ends_of(pair):
    """ψ₁, θ₁, ψ₂, θ₂ of a pair of points in the references."""
    return tuple(reference_inputs(pair + ".inputs"))


def single_evaluations():
    """Every key with the scene's value; the inputs are used, not checked."""
    got = {}
    for pair in PAIRS:
        circle = plane_and_arc(*ends_of(pair))
        got[pair + ".length"] = R * circle.angle
        # Meridians have no A and B; the vertex is listed for one pair only.
        got |= {f"{pair}.{key}": getattr(circle, name) for key, name in NAMES.items() if f"{pair}.{key}" in keys(pair)}
    circle = plane_and_arc(*ends_of("s1.generic"))
    got["s1.generic.A2+B2"] = circle.A**2 + circle.B**2
    along = over_azimuth(circle.A, circle.B, 1.25)
    got["s1.generic.psi_at_theta=1.25"], got["s1.generic.dpsi/dtheta_at_1.25"] = along
    near = ends_of("s1.near_pole")
    got["s1.near_pole.planar_limit"] = 2 * R * near[0] * np.sin(0.5)
    major = 2 * np.pi - plane_and_arc(*ends_of("s1.dtheta>pi")).angle
    got["s1.dtheta>pi.major_arc_length"] = R * major
    got["s1.dtheta>pi.second_variation_coeff"] = geodesic.second_variation(major)
    return got


def test_great_circles_match_the_references():
    """Plane, length, middle and vertex agree to 1e-12 for all pairs: the formulas handle ill-conditioned inputs.

    No key of §1 is omitted: keys that are not compared are inputs.
    """
    found = single_evaluations()
    for key, value in found.items():
        assert float(value) == pytest.approx(reference(key), rel=1e-12, abs=0), key
    assert set(found) | {pair + ".inputs" for pair in PAIRS} == set(keys("s1"))


@pytest.mark.parametrize(
    ("how", "length", "ends"),
    [
        ("coincide", 0.0, (1.0, 0.5, 1.0, 0.5)),
        ("coincide", 0.0, (1.0, 0.5, 1.0, 0.5 + 2 * np.pi)),
        ("coincide", 0.0, (0.0, 0.25, 0.0, 2.0)),
        ("are antipodal", np.pi * R, (0.0, 0.0, np.pi, 1.0)),
        ("are antipodal", np.pi * R, (0.75, 0.25, np.pi - 0.75, 0.25 + np.pi)),
    ],
)
def test_points_without_a_plane(how, length, ends):
    """The same point twice, once around, or the pole with two azimuths, and antipodal points: only a length."""
    with pytest.raises(ValueError, match=f"{how}: the plane.*not determined"):
        geodesic.great_circle(*ends)
    assert float(geodesic.distance(PARAMS, *ends)) == pytest.approx(length, rel=1e-15, abs=1e-14)


def test_lagranges_equation_of_the_arc_length():
    """ψ'' sin²ψ = 2 ψ'² sin ψ cos ψ + sin³ψ cos ψ, M = sin²ψ/f³ and h = -cos i at random states, from L alone."""
    rng = np.random.default_rng(1)
    constant = by_numpy(lambda q, v: jacobi_integral(geodesic.over_azimuth, 0.0, q, v, PARAMS))
    for psi, slope in zip(rng.uniform(0.2, 2.9, 5), rng.normal(size=5)):
        s, c = np.sin(psi), np.cos(psi)
        f = np.hypot(s, slope)
        found = equations(geodesic.over_azimuth, 0.0, psi, slope, PARAMS)
        assert float(found.a) == pytest.approx((2 * slope**2 * s * c + s**3 * c) / s**2, rel=1e-11)
        assert float(found.a) != pytest.approx((2 * slope**2 * s * c - s**3 * c) / s**2, rel=1e-3)
        assert float(found.mass[0, 0]) == pytest.approx(s**2 / f**3, rel=1e-12)
        assert float(constant(psi, slope)) == pytest.approx(-(s**2) / f, rel=1e-12)


def test_over_the_azimuth():
    """ψ(θ) of a great circle is a motion, with Clairaut's constant, and runs between the points; no other plane's."""
    psi1, theta1, psi2, theta2 = ends_of("s1.generic")
    A, B = reference("s1.generic.A"), reference("s1.generic.B")
    moving = by_numpy(
        lambda A, B, theta: jax.jvp(lambda x: geodesic.exact_over_azimuth(A, B, x), (theta,), (jnp.ones_like(theta),))
    )
    (psi, slope), (rate, second) = moving(A, B, 1.25)
    assert float(rate) == pytest.approx(float(slope), rel=1e-13)
    assert float(second) == pytest.approx(
        float(equations(geodesic.over_azimuth, 1.25, psi, slope, PARAMS).a), rel=1e-11
    )
    assert np.sin(psi) ** 2 / np.hypot(np.sin(psi), slope) == pytest.approx(reference("s1.generic.clairaut_cos_i"))
    np.testing.assert_allclose(over_azimuth(A, B, np.array([theta1, theta2]))[0], [psi1, psi2], rtol=1e-13)
    assert not np.allclose(over_azimuth(A, -B, theta2)[0], psi2, rtol=1e-2)


def test_embedded_path_and_multiplier():
    """The circle over both poles starts towards its end, and is a motion on the sphere with λ = -1/(2R²)."""
    q0, v0 = map(np.asarray, geodesic.start_towards(PARAMS, 0.5, 0.0, 0.25, np.pi))
    np.testing.assert_allclose(q0, [R * np.sin(0.5), 0.0, R * np.cos(0.5)], atol=1e-15)
    np.testing.assert_allclose(v0, [-np.cos(0.5), 0.0, np.sin(0.5)], atol=1e-15)
    path = lambda s: geodesic.exact_embedded(q0, v0, s)
    (q, v), (rate, second) = by_numpy(lambda s: jax.jvp(path, (s,), (jnp.ones_like(s),)))(
        np.array([0.0, 0.75, 3.0]) * R
    )
    np.testing.assert_allclose([q[0], v[0], q[1]], [q0, v0, [R * np.sin(-0.25), 0, R * np.cos(0.25)]], atol=1e-14)
    np.testing.assert_allclose(rate, v, atol=1e-15)
    assert np.ptp(np.sum(q**2, 1)) < 1e-14 and np.ptp(np.sum(v**2, 1)) < 1e-14
    found = equations(geodesic.embedded, 0.0, q[2], v[2], PARAMS)
    np.testing.assert_allclose(found.a, second[2], atol=1e-15)
    # With the sign of the constraint flipped, or |r| instead of |r|², λ would be +1/(2R²) or -1/R.
    multiplier = geodesic.exact_multiplier(PARAMS)
    assert found.multipliers["sphere"] == pytest.approx(multiplier, rel=1e-14) and multiplier == -0.5 / R**2


def test_refused_cases():
    """Over the azimuth the pole is refused with the coordinate's name; a missing refusal fails."""
    case = geodesic._at_the_pole()
    assert case.passed and "'q'" in case.happened
    assert not geodesic._undetermined("", geodesic.ENDS).passed


def test_the_major_arc_is_a_saddle():
    """A displaced arc of more than half a turn is shorter, by the second variation; a displaced minor arc is longer."""
    major, varied = reference("s1.dtheta>pi.major_arc_length") / R, by_numpy(geodesic.varied_length)
    second = by_numpy(jax.hessian(lambda x: geodesic.varied_length(major, x)))(0.0)
    assert float(second) == pytest.approx(reference("s1.dtheta>pi.second_variation_coeff"), rel=1e-12)
    assert varied(major, 0.1) < major - 0.005
    assert varied(2 * np.pi - major, 0.1) > 2 * np.pi - major + 0.005
    assert float(varied(np.pi, 0.1)) == pytest.approx(np.pi, abs=1e-4)


def test_the_distance_has_the_exact_gradient():
    """∂l/∂(ψ₁, θ₁, ψ₂, θ₂) is R times the unit tangents' components, by Clairaut's constant."""
    psi1, theta1, psi2, theta2 = ends = ends_of("s1.generic")
    got = by_numpy(jax.grad(lambda ends: geodesic.distance(PARAMS, *ends)))(ends)
    circle = plane_and_arc(*ends)
    # dl/dθ = R cos i, and dl/dψ = R ψ'/f, along the path at either end.
    slopes = [over_azimuth(circle.A, circle.B, theta)[1] for theta in (theta1, theta2)]
    along = [R * s / np.hypot(s, np.sin(psi)) for s, psi in zip(slopes, (psi1, psi2))]
    cos_i = R * circle.clairaut
    np.testing.assert_allclose(got, [-along[0], -cos_i, along[1], cos_i], rtol=1e-12)
