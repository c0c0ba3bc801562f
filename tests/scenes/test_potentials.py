"""Seven potentials: Poisson's equation, scaling, converged quadratures, special points; and elliptic functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from lagjax.scenes import mass_distributions as scene
from lagjax.scenes import potentials
from lagjax.scenes.potentials import agm, jacobi_elliptic
from tests.scenes.test_mass_distributions import _cylindrical, value_and_gradient


def test_more_nodes_change_nothing_and_few_are_not_enough():
    """The periodic integrals have converged with the default number of nodes, but not with 24."""
    for name, q, near in (
        ("finite cylinder", scene.vector(1.0, 0.875, 0.5), 1e-6),
        ("helix", scene.vector(0.75, 0.5, 0.25), 0.05),
    ):
        at, params = jax.jit(scene.POTENTIALS[name], static_argnums=(2, 3)), scene.PARAMS[name]
        fine = at(q, params, 500, near)
        assert abs(at(q, params) / fine - 1) < 1e-12
        assert abs(at(q, params, 24) / fine - 1) > 1e-8


def test_close_to_the_wire_the_nodes_must_gather():
    """At 0.001 a from the wire 256 clustered nodes agree with 1200; the same number of equidistant ones does not."""
    at = jax.jit(potentials.helix, static_argnums=(2, 3))
    q, params = scene.vector(1.001, 0.0, 0.0), scene.PARAMS["helix"]
    fine = at(q, params, 1200, 1e-6)
    assert abs(at(q, params, 256, 1e-4) / fine - 1) < 1e-12
    assert abs(at(q, params, 256, None) / fine - 1) > 1e-3


def _laplacian(name):
    def at(x, params):
        return jnp.trace(jax.hessian(lambda x: scene.POTENTIALS[name](scene.vector(*x), params))(x))

    return jax.jit(jax.vmap(at, in_axes=(0, None)))


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("half plane", None),
        ("cylinder", (0.5, -0.75, 1.0)),
        ("finite cylinder", (0.5, -0.75, 0.25)),
        ("elliptic cylinder", (1.0, -0.375, 1.0)),
        ("dumbbell", (0.125, -0.25, 1.5)),
        ("helix", None),
    ],
)
def test_poisson(name, inside):
    """∇²Φ is 4πGρ inside the masses and vanishes outside; on an axis too, where √(x² + y²) has no derivative."""
    params = scene.PARAMS[name]
    outside = {"helix": (0.0, 0.0, 0.25)}.get(name, (0.0, -2.0, 2.5))
    points = np.array([outside, (1.75, 1.5, 0.5), inside or outside, (0.0, 0.0, 0.25 if name == "helix" else 3.0)])
    density = params.get("rho", 0.75 * params.get("M1", 0.0) / (np.pi * 0.5**3))
    infinite = name in ("cylinder", "elliptic cylinder")
    expected = 4 * np.pi * density * np.array([0.0, 0.0, inside is not None, infinite])
    np.testing.assert_allclose(_laplacian(name)(points, params), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "degree", "lengths"),
    [
        ("plane", 1, ()),
        ("cylinder", 2, ("a",)),
        pytest.param("finite cylinder", 2, ("a", "b"), marks=pytest.mark.slow),
        ("elliptic cylinder", 2, ("a", "b")),
        ("dumbbell", -1, ("radius", "c", "length")),
        pytest.param("helix", 0, ("a", "h"), marks=pytest.mark.slow),
    ],
)
def test_homogeneous_in_all_lengths(name, degree, lengths):
    """First and second derivatives along a scaling of q and all lengths: n Φ and n² Φ (Euler's theorem)."""

    def scaled(tau):
        size = jnp.exp(tau)
        params = {k: x * size if k in lengths else x for k, x in scene.PARAMS[name].items()}
        return scene.POTENTIALS[name](scene.vector(1.75 * size, 1.25 * size, 0.5 * size), params)

    first, second = jax.grad(scaled), jax.grad(jax.grad(scaled))
    value, slope, bend = jax.jit(lambda tau: (scaled(tau), first(tau), second(tau)))(0.0)
    np.testing.assert_allclose([slope, bend], [degree * value, degree**2 * value], rtol=1e-11, atol=1e-11)


def test_no_nan_at_special_points():
    """Gradients are finite, and zero by symmetry, on the sheet, the axes and in the centre of a ball."""
    for name, q in (
        ("plane", scene.vector(0.5, 0.5, 0.0)),
        ("cylinder", scene.vector(0.0, 0.0, 0.0)),
        ("finite cylinder", scene.vector(0.0, 0.0, 0.0)),
        ("elliptic cylinder", scene.vector(0.0, 0.0, 0.0)),
    ):
        force = value_and_gradient(name, q, scene.PARAMS[name])[1]
        assert max(abs(float(x)) for x in force.values()) < 1e-13, name
    for name, q in (
        ("half plane", scene.vector(0.0, 1.0, 0.0)),
        ("half plane", scene.vector(0.0, -1.0, 0.0)),
        ("cylinder", scene.vector(1.25, 0.0, 0.0)),
        ("finite cylinder", scene.vector(1.25, 0.0, 0.75)),
        ("finite cylinder", scene.vector(0.0, 0.0, 0.75)),
        ("finite cylinder", scene.vector(1e100, 0.0, 0.0)),
        ("elliptic cylinder", scene.vector(2.0, 0.0, 0.0)),
        ("dumbbell", scene.vector(0.0, 0.0, 1.5)),
        ("helix", scene.vector(0.0, 0.0, 0.0)),
    ):
        assert all(np.isfinite(x) for x in value_and_gradient(name, q, scene.PARAMS[name])[1].values()), name


def test_field_through_the_lid():
    """g_z = -∂Φ/∂z passes the lid z = b without a jump, for s inside and outside."""
    for s in (0.5, 2.0):
        below, on, above = (
            _cylindrical("finite cylinder", s, 0.75 + dz, scene.PARAMS["finite cylinder"])[2] for dz in (-1e-9, 0, 1e-9)
        )
        assert abs(on - below) < 2e-8 and abs(on - above) < 2e-8


def test_screw_symmetry_of_the_potential():
    """Φ is unchanged by z + hε/2π with φ + ε, at every ε; not by z + hε with φ + ε, which h p_z + L_z generates."""
    params, potential = scene.PARAMS["helix"], jax.jit(potentials.helix)
    h, (x, y, z) = params["h"], (1.5, 0.375, 0.25)
    start = float(potential(scene.vector(x, y, z), params))
    for angle in (0.1, 1.0, 2.5):
        c, s = np.cos(angle), np.sin(angle)
        moved = c * x - s * y, s * x + c * y
        assert abs(potential(scene.vector(*moved, z + h * angle / (2 * np.pi)), params) - start) < 1e-13
        assert abs(potential(scene.vector(*moved, z + h * angle), params) - start) > 1e-2


def test_jacobi_functions_against_scipy():
    """sn, cn, dn and K agree with scipy's, also for m near 1 given by its complement, and for m < 0."""
    m1 = np.array([0.5, 1e-3, 1.0, 1e-12, 1e-30])
    u = np.linspace(-3.0, 3.0, 13)[:, None]
    got = jacobi_elliptic(u, (1 - m1)[None], m1[None])
    expected = special.ellipj(u, (1 - m1)[None])[:3]
    for a, b in zip(got, expected):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(0.5 * np.pi / agm(1.0, np.sqrt(m1)), special.ellipkm1(m1), rtol=1e-15)
    # dn(u | -n) = 1 / dn(√(1 + n) u | n / (1 + n))
    negative = jacobi_elliptic(u[:, 0], -3.0, 4.0)[2]
    np.testing.assert_allclose(negative, 1 / special.ellipj(2 * u[:, 0], 0.75)[2], rtol=1e-13)
