"""Lagrangians linear in velocities: vortices, guiding centres, a mass beside a vortex. By closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import lagjax as lj
from lagjax.mechanics import with_first_order
from lagjax.mechanics.lagrangian import resolved
from lagjax.system import model_of
from tests.jaxtools.in_numpy import accelerations, in_numpy


def vortex_lagrangian(t, q, v, params):
    """Kirchhoff's: Γ x' = ∂H/∂y, Γ y' = -∂H/∂x, with H = -Σ Γ_i Γ_j log(r_ij) / 2π over pairs."""
    x, y = q["x"], q["y"]
    i, j = np.triu_indices(x.size, 1)
    squared = (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2
    pairs = params[i] * params[j] * jnp.log(squared)
    return 0.5 * jnp.sum(params * (y * v["x"] - x * v["y"])) + jnp.sum(pairs) / (4 * jnp.pi)


vortices = lj.System(vortex_lagrangian)
PAIR = {"x": np.array([0.3, -0.7]), "y": np.zeros(2)}
G = np.array([2.0, 1.0])


def still(q):
    """Velocities that do not count."""
    return jax.tree.map(np.zeros_like, q)


def plane(motion):
    """The places as complex numbers."""
    return np.asarray(motion.q["x"]) + 1j * np.asarray(motion.q["y"])


def rotated(t, strengths=G):
    """Two vortices turn about their centre at (Γ₁ + Γ₂) / 2π d²."""
    z = PAIR["x"] + 1j * PAIR["y"]
    centre, rate = strengths @ z / np.sum(strengths), np.sum(strengths) / (2 * np.pi * abs(z[0] - z[1]) ** 2)
    return centre + (z - centre) * np.exp(1j * rate * np.asarray(t)[:, None])


def impulses(motion, strengths):
    """The two linear ones and the angular one, at each output."""
    z = plane(motion)
    return np.stack([(z @ strengths).real, (z @ strengths).imag, np.abs(z) ** 2 @ strengths])


def velocities(system, *state):
    """The velocities that follow from a state, whatever is given."""

    def found(*state):
        model = with_first_order(model_of(system, *state))
        return model.tree(resolved(model, state[0], *model.vectors(*state[1:3])))

    return in_numpy(found)(*state)


def test_velocities_and_accelerations_of_two():
    """Both from L at one state, whatever velocity is given: a rotation about the centre. Twin: other circulations."""
    rate, about = 3 / (2 * np.pi), PAIR["x"] - G @ PAIR["x"] / 3
    v = velocities(vortices, 0.0, PAIR, jax.tree.map(lambda x: x + 7.0, PAIR), G)
    np.testing.assert_allclose([v["x"], v["y"]], [np.zeros(2), rate * about], atol=1e-15)
    a, _ = accelerations(vortices, 0.0, PAIR, still(PAIR), G)
    np.testing.assert_allclose([a["x"], a["y"]], [-(rate**2) * about, np.zeros(2)], atol=1e-15)
    assert abs(lj.jacobi_integral(vortices, 0.0, PAIR, v, G)) < 1e-16
    assert np.max(np.abs(rotated([1.0]) - rotated([1.0], np.array([2.0, 1.1])))) > 1e-2


def test_what_has_a_mass_is_not_among_them():
    """A charge in a magnetic field has a mass; a charge without one drifts. Twin: which are found."""

    def charge(mass):
        return lj.System(lambda t, q, v, p: 0.5 * mass * (v @ v) + 0.5 * p * (q[0] * v[1] - q[1] * v[0]) - q[0])

    found = [
        with_first_order(model_of(charge(mass), np.zeros(()), np.ones(2), np.ones(2), 1.0)).form.first_order
        for mass in (1.0, 0.0)
    ]
    assert found[0] is None and found[1] is not None and found[1].massless == (0, 1)
    # E = -1 along x in a field of 3: the drift is E / B along y.
    v = velocities(charge(0.0), 0.0, np.ones(2), np.zeros(2), 3.0)
    np.testing.assert_allclose(v, [0.0, 1 / 3], atol=1e-16)


@pytest.mark.slow
def test_what_is_singular_is_said():
    """A circulation of zero, and an odd number of coordinates, in words."""
    with pytest.raises(
        ValueError, match=r"(?s)velocities of 'x\[1\]' and 'y\[1\]' are not determined.*circulation that vanishes"
    ):
        lj.accelerations(vortices, 0.0, PAIR, still(PAIR), np.array([2.0, 0.0]))
    odd = lj.System(lambda t, q, v, p: q[0] * v[1] + q[1] * v[2] + 0.3 * q[2] * v[0] * q[1] - q @ q)
    start = np.array([1.0, 2.0, 0.3]), np.zeros(3)
    with pytest.raises(ValueError, match=r"(?s)'q\[0\]', 'q\[1\]' and 'q\[2\]' are not determined.*odd number"):
        lj.accelerations(odd, 0.0, *start, None)


@pytest.mark.exhaustive
def test_leapfrogging_pairs():
    """Energy and impulses over 1e5 steps of Gauss."""
    start = {"x": np.zeros(4), "y": np.array([1.0, 0.4, -0.4, -1.0])}
    strengths = np.array([1.0, 1.0, -1.0, -1.0])
    long = lj.integrate(
        vortices, start, still(start), strengths, ts=np.linspace(0.0, 20_000.0, 11), method=lj.Gauss(3), dt0=0.2,
        estimate_error=False,
    )  # fmt: skip
    h = np.asarray(long.jacobi_integral())
    assert int(long.stats["num_steps"]) == 100_000
    assert np.ptp(h) < 2e-9 and abs(np.polyfit(np.asarray(long.t), h, 1)[0]) * 20_000 < 0.5 * np.ptp(h)
    first = impulses(long, strengths)
    assert np.max(np.abs(first[:2] - first[:2, :1])) < 1e-10


@pytest.mark.exhaustive
def test_a_mass_on_a_spring_beside_a_vortex():
    """A vortex bound to a mass by a spring, all linear: the matrix exponential, by adaptive and Gauss' steps."""
    params = {"m": 0.7, "k": 2.0, "G": 1.5}

    def lagrangian(t, q, v, p):
        (x, y), (a, b) = q["vortex"], v["vortex"]
        apart = q["mass"] - q["vortex"]
        return 0.5 * p["G"] * (y * a - x * b) + 0.5 * p["m"] * (v["mass"] @ v["mass"]) - 0.5 * p["k"] * (apart @ apart)

    both = lj.System(lagrangian)
    q0 = {"vortex": np.array([0.0, 0.5]), "mass": np.array([1.0, 0.0])}
    v0 = {"vortex": np.zeros(2), "mass": np.array([0.0, 0.3])}
    # Γ x' = ∂H/∂y: z' = (k / Γ) J (z - r) with J = [[0, 1], [-1, 0]].
    turn, one, none = 2.0 / 1.5 * np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(2), np.zeros((2, 2))
    matrix = np.block([[turn, -turn, none], [none, none, one], [one * 2 / 0.7, -one * 2 / 0.7, none]])
    exact = expm(10 * matrix) @ [0.0, 0.5, 1.0, 0.0, 0.0, 0.3]
    for options in (
        {"rtol": 1e-12},
        {"method": lj.Gauss(4), "dt0": 0.05},
        {"method": lj.Gauss(4, newton=True), "dt0": 0.05},
    ):
        motion = lj.integrate(both, q0, v0, params, ts=np.array([0.0, 10.0]), **options)
        found = [*motion.q["vortex"][-1], *motion.q["mass"][-1], *motion.v["mass"][-1]]
        np.testing.assert_allclose(found, exact, atol=1e-10)
        assert np.ptp(motion.jacobi_integral()) < 1e-10
    assert np.max(np.abs(expm(10.1 * matrix) - expm(10 * matrix))) > 0.1


def dipole(r):
    """A and B of a magnetic dipole along z."""
    x, y, z = r
    d = jnp.sqrt(r @ r)
    return jnp.stack([-y, x, 0.0 * z]) / d**3, (3 * z * r - jnp.array([0.0, 0.0, 1.0]) * d**2) / d**5


def guiding_lagrangian(t, q, v, params):
    """(A / ε + u b) · r' - u² / 2 - μ B (Littlejohn)."""
    A, B = dipole(q["r"])
    size = jnp.sqrt(B @ B)
    return (A / params["eps"] + q["u"] * B / size) @ v["r"] - 0.5 * q["u"] ** 2 - params["mu"] * size


guiding = lj.System(guiding_lagrangian)
SLOW = {"eps": 0.02, "mu": 1.0}


def drift_rate(y):
    """Northrop's equations: r' = (u B* + ε μ b × ∇B) / B*∥, u' = -μ B* · ∇B / B*∥ with B* = B + ε u ∇ × b."""
    r, u, eps, mu = y[:3], y[3], SLOW["eps"], SLOW["mu"]
    size, unit = lambda r: jnp.sqrt(dipole(r)[1] @ dipole(r)[1]), lambda r: dipole(r)[1] / size(r)
    slope, D = jax.grad(size)(r), jax.jacfwd(unit)(r)
    curl = jnp.stack([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    star = dipole(r)[1] + eps * u * curl
    along = unit(r) @ star
    return jnp.append((u * star + eps * mu * jnp.cross(unit(r), slope)) / along, -mu * (star @ slope) / along)


def test_velocities_of_a_guiding_centre():
    """A particle trapped in a dipole's field, in NumPy, as Northrop's equations have it. Twin: another μ."""
    q = {"r": np.array([0.9, 0.2, 0.3]), "u": np.array(0.7)}
    right = in_numpy(drift_rate)(np.append(q["r"], q["u"]))
    found, other = (velocities(guiding, 0.0, q, still(q), SLOW | {"mu": mu}) for mu in (1.0, 1.1))
    np.testing.assert_allclose(np.append(found["r"], found["u"]), right, rtol=1e-11)
    assert abs(other["u"] - right[3]) > 1e-2
