"""Seven potentials: Poisson's equation, scaling, converged quadratures, special points; and elliptic functions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from lagjax.scenes import mass_distributions as scene
from lagjax.scenes.potentials import agm, jacobi_elliptic
from tests.by_numpy import by_numpy
from tests.scenes.test_mass_distributions import in_field


@pytest.mark.parametrize(
    ("name", "at", "fine", "enough", "too_few", "off"),
    [
        ("finite cylinder", (1.0, 0.875, 0.5), (500, 1e-6), (), (24,), 1e-8),
        ("helix", (0.75, 0.5, 0.25), (500, 0.05), (), (24,), 1e-8),
        # At 0.001 a from the wire the nodes must gather.
        ("helix", (1.001, 0.0, 0.0), (1200, 1e-6), (256, 1e-4), (256, None), 1e-3),
    ],
)
def test_more_nodes_change_nothing_and_few_are_not_enough(name, at, fine, enough, too_few, off):
    """The periodic integrals have converged with the default number of nodes, but not with 24, nor with even ones."""
    value = lambda nodes: by_numpy(lambda q, params: scene.POTENTIALS[name](q, params, *nodes))(
        scene.vector(*at), scene.PARAMS[name]
    )
    right = value(fine)
    assert abs(value(enough) / right - 1) < 1e-12
    assert abs(value(too_few) / right - 1) > off


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
    laplacian = lambda x: jnp.trace(jax.hessian(lambda x: scene.POTENTIALS[name](scene.vector(*x), params))(x))
    outside = {"helix": (0.0, 0.0, 0.25)}.get(name, (0.0, -2.0, 2.5))
    points = np.array([outside, (1.75, 1.5, 0.5), inside or outside, (0.0, 0.0, 0.25 if name == "helix" else 3.0)])
    density = params.get("rho", 0.75 * params.get("M1", 0.0) / (np.pi * 0.5**3))
    infinite = name in ("cylinder", "elliptic cylinder")
    expected = 4 * np.pi * density * np.array([0.0, 0.0, inside is not None, infinite])
    np.testing.assert_allclose(by_numpy(jax.vmap(laplacian))(points), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "degree", "lengths"),
    [
        ("plane", 1, ()),
        ("cylinder", 2, ("a",)),
        ("finite cylinder", 2, ("a", "b")),
        ("elliptic cylinder", 2, ("a", "b")),
        ("dumbbell", -1, ("radius", "c", "length")),
        ("helix", 0, ("a", "h")),
    ],
)
def test_homogeneous_in_all_lengths(name, degree, lengths):
    """First and second derivatives along a scaling of q and all lengths: n Φ and n² Φ (Euler's theorem)."""

    def scaled(tau):
        size = jnp.exp(tau)
        params = {k: x * size if k in lengths else x for k, x in scene.PARAMS[name].items()}
        return scene.POTENTIALS[name](scene.vector(1.75 * size, 1.25 * size, 0.5 * size), params)

    slope = lambda tau: jax.jvp(scaled, (tau,), (1.0,))
    (value, first), (_, second) = by_numpy(lambda tau: jax.jvp(slope, (tau,), (1.0,)))(0.0)
    np.testing.assert_allclose([first, second], [degree * value, degree**2 * value], rtol=1e-11, atol=1e-11)


SPECIAL = {
    "plane": [(0.5, 0.5, 0.0)],
    "half plane": [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)],
    "cylinder": [(0.0, 0.0, 0.0), (1.25, 0.0, 0.0)],
    "finite cylinder": [(0.0, 0.0, 0.0), (1.25, 0.0, 0.75), (0.0, 0.0, 0.75), (1e100, 0.0, 0.0)],
    "elliptic cylinder": [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0)],
    "dumbbell": [(0.0, 0.0, 1.5)],
    "helix": [(0.0, 0.0, 0.0)],
}


@pytest.mark.parametrize("name", SPECIAL)
def test_no_nan_at_special_points(name):
    """Gradients are finite on sheets, edges, axes and in the centre of a ball, and zero where all is symmetric."""
    fields = [np.array(list(in_field(name, *q)[1].values())) for q in SPECIAL[name]]
    assert np.isfinite(fields).all()
    assert name in ("half plane", "dumbbell", "helix") or np.max(np.abs(fields[0])) < 1e-13


def test_jacobi_functions_against_scipy():
    """sn, cn, dn and K agree with scipy's, also for m near 1 given by its complement, and for m < 0."""
    m1 = np.array([0.5, 1e-3, 1.0, 1e-12, 1e-30])
    u = np.linspace(-3.0, 3.0, 13)[:, None]
    got = by_numpy(jacobi_elliptic)(u, (1 - m1)[None], m1[None])
    for a, b in zip(got, special.ellipj(u, (1 - m1)[None])):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-14)
    mean = by_numpy(partial(agm, 1.0))(np.sqrt(m1))
    np.testing.assert_allclose(0.5 * np.pi / mean, special.ellipkm1(m1), rtol=1e-15)
    # dn(u | -n) = 1 / dn(√(1 + n) u | n / (1 + n))
    negative = by_numpy(jacobi_elliptic)(u[:, 0], -3.0, 4.0)[2]
    np.testing.assert_allclose(negative, 1 / special.ellipj(2 * u[:, 0], 0.75)[2], rtol=1e-13)
