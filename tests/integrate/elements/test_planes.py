"""Friction in a plane: a sliding velocity of two components."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from lagjax.integrate.complementarity import ContactProblem, solved
from tests.integrate.elements.test_motions import moved

G, M, R = 9.81, 1.3, 0.4
INERTIA = 0.4 * M * R**2
V0, TS = [2.0, 1.5], np.array([0.0, 3.0])


def test_forces_in_planes():
    """Forces of random contacts obey Coulomb's law in the plane: |λ_T| ≤ μ N, against the acceleration where it slides.
    Twin: for another μ they do not."""
    count, mu, rng = 2, 0.8, np.random.default_rng(5)
    # W and b of contacts that slide in planes, normal rows first, one system in each lane.
    rows = rng.normal(size=(60, 3 * count, 3 * count + 1))
    matrix, free = rows @ np.swapaxes(rows, 1, 2), rng.normal(size=(60, 3 * count))

    @jax.jit
    @jax.vmap
    def forces_of(matrix, free):
        of_forces = jnp.repeat(jnp.eye(count, 3 * count), 2, axis=0)
        zero = jnp.zeros(2 * count)
        may_push, partners = jnp.ones(count, bool), np.arange(2 * count) ^ 1
        return solved(ContactProblem(matrix, free, may_push, of_forces, zero, zero + mu, zero, partners))

    forces, well = map(np.asarray, forces_of(matrix, free))
    a = np.einsum("lij,lj->li", matrix, forces) + free
    normal, along = forces[:, :count], forces[:, count:].reshape(-1, count, 2)
    a_normal, a_along = a[:, :count], a[:, count:].reshape(-1, count, 2)
    scale = 1 + np.max(np.abs(forces), axis=1, keepdims=True)

    def obeys(mu):
        size, speed = np.linalg.norm(along, axis=-1), np.linalg.norm(a_along, axis=-1)
        against = np.linalg.norm(along * speed[..., None] + mu * normal[..., None] * a_along, axis=-1)
        off = np.minimum(normal, a_normal), np.maximum(size - mu * normal, 0.0), against
        return np.max(np.abs(off), axis=0).max(axis=1, keepdims=True) / scale**2 < 1e-8

    assert np.mean(well) > 0.8 and np.all(obeys(mu)[well])
    slides = (np.linalg.norm(a_along, axis=-1) > 1e-6) & (normal > 1e-6)
    sticks = (np.linalg.norm(a_along, axis=-1) < 1e-9) & (normal > 1e-6)
    assert slides.sum() > 5 and sticks.sum() > 5
    assert not np.any(obeys(0.9 * mu)[well[:, None] & slides.any(axis=1, keepdims=True)])


falls = lambda speed, p: p["mu"] * (1 - p["falls"] * (1 - jnp.exp(-speed)))
# A block on a tilted plane, uphill along y, with unit mass and g cos α = 9.81.
on_a_tilt = lj.System(
    lambda t, q, v, p: 0.5 * jnp.sum(v**2) - G * p["tan"] * q[1],
    elements={"floor": lj.Friction(lambda t, q, v, p: v, falls, normal=G, static=lambda p: p["static"])},
)


def by_scipy(v0, mu, tan, falls=0.0):
    """Its last place by SciPy."""

    def rates(t, y):
        speed = np.hypot(*y[2:])
        return [*y[2:], *(-mu * (1 - falls * (1 - np.exp(-speed))) * G * y[2:] / speed - [0.0, tan * G])]

    stops = lambda t, y: np.hypot(*y[2:]) - 1e-9
    setattr(stops, "terminal", True)
    found = solve_ivp(rates, (0, TS[-1]), [0, 0, *v0], rtol=1e-12, atol=1e-14, events=stops, method="DOP853")
    return found.y[:2, -1]


def thrown(v0, mu, tan, *, falls=0.0, static=0.5, dtype=float, rtol=1e-11) -> HybridTrajectory:
    """The block thrown at the origin."""
    given = {name: jnp.asarray(x, dtype) for name, x in zip(("mu", "tan", "falls", "static"), (mu, tan, falls, static))}
    return moved(on_a_tilt, np.zeros(2, dtype), np.asarray(v0, dtype), given, ts=np.asarray(TS, dtype), rtol=rtol)


@pytest.mark.exhaustive
def test_thrown_obliquely_on_a_tilted_plane():
    """Stops, or turns downhill and slides on, as by SciPy, also with μ that falls with the speed; its stop, when the
    rate -(μ² - tan²) g of μ |s| - tan s_y has taken that, is as precise as the steps. Twins: with another μ it rests
    somewhere else; with longer steps it stops earlier."""
    found = {}
    for mu, tan, falls in ((0.4, 0.2, 0.0), (0.41, 0.2, 0.0), (0.2, 0.4, 0.0), (0.4, 0.0, 0.4)):
        traj = found[mu, tan] = thrown(V0, mu, tan, falls=falls)
        np.testing.assert_allclose(traj.q[-1], by_scipy(V0, mu, tan, falls), atol=1e-10)
        if mu > tan > 0:
            stops = (mu * np.hypot(*V0) - tan * V0[1]) / ((mu**2 - tan**2) * G)
            np.testing.assert_allclose(traj.switches.t[0], stops, atol=1e-10)
            assert thrown(V0, mu, tan, rtol=1e-7).switches.t[0] < stops - 1e-7
    assert [np.asarray(traj.modes)[-1].tolist() for traj in found.values()] == [[2, 2], [2, 2], [1, 1], [2, 2]]
    assert np.linalg.norm(found[0.41, 0.2].q[-1] - found[0.4, 0.2].q[-1]) > 1e-3


@pytest.mark.exhaustive
def test_at_rest_on_a_tilt():
    """It stays below the static coefficient, and above it slides by the kinetic one. Twin: both tilts."""
    stays, goes = (thrown([0.0, 0.0], 0.4, tan) for tan in (0.45, 0.55))
    assert not np.any(stays.q[-1])
    np.testing.assert_allclose(goes.q[-1], [0.0, -0.5 * 0.15 * G * 9.0], atol=1e-7)


@pytest.mark.exhaustive
def test_two_blocks_in_planes():
    """Each of two blocks, (k, 2) velocities with k normal forces, slides straight with μ N and stops after |v|/(μ N).
    Twin: with the other's normal force."""
    throw, normal, mu = np.array([[3.0, 4.0], [-1.0, 2.0]]), np.array([1.0, 2.0]), 0.3
    floor = lj.Friction(lambda t, q, v, p: v, mu, normal=normal)
    blocks = lj.System(lambda t, q, v, p: jnp.sum(v**2) / 2, elements={"floor": floor})
    ts = np.linspace(0.0, 20.0, 5)
    traj = moved(blocks, np.zeros((2, 2)), throw, None, ts=ts, rtol=1e-10)
    assert traj.multipliers["floor"].shape == (5, 2, 2)
    speed = np.linalg.norm(throw, axis=1)
    np.testing.assert_allclose(traj.switches.t[:2], np.sort(speed / (mu * normal)), rtol=1e-8)

    def places(normal):
        slides = np.minimum(ts[:, None], speed / (mu * normal))[:, :, None]
        return throw * slides - (mu * normal / speed)[:, None] * throw * slides**2 / 2

    np.testing.assert_allclose(traj.q, places(normal), atol=1e-9)
    assert np.abs(places(normal) - places(normal[::-1])).max() > 1.0


@pytest.mark.exhaustive
def test_derivatives_of_a_place_of_rest():
    """The derivative of the place of rest by μ, in both modes, against differences of SciPy's."""
    last = lambda mu: thrown(V0, mu, 0.2).q[-1]
    slope = (by_scipy(V0, 0.4 + 1e-5, 0.2) - by_scipy(V0, 0.4 - 1e-5, 0.2)) / 2e-5
    np.testing.assert_allclose(jax.jvp(last, (jnp.asarray(0.4),), (jnp.asarray(1.0),))[1], slope, atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(last)(jnp.asarray(0.4)), slope, atol=1e-6)


@pytest.mark.exhaustive
def test_a_sphere_with_spin():
    """Thrown sliding, it rolls from 2 |s| / (7 μ g) on with v - 2 s/7, and until then moves on a parabola. Dropped, it
    loses μ of the normal impulse in an impact, or 2 s/7 where that stops the sliding. Twin: another spin, another way.
    """

    # Its spin is the rates of three coordinates that nothing depends on: for equal moments of inertia the equations of
    # motion are those of angular velocities.
    def lagrangian(t, q, v, p):
        return 0.5 * M * jnp.sum(v["x"] ** 2) + 0.5 * INERTIA * jnp.sum(v["spin"] ** 2) - M * G * q["x"][2]

    sliding = lambda t, q, v, p: v["x"][:2] + R * jnp.stack([-v["spin"][1], v["spin"][0]])
    table = lj.Contact(lambda t, q, p: q["x"][2] - R, 0.5, friction=lambda p: p, sliding=sliding, slower_than=1e-3)
    system = lj.System(lagrangian, elements={"table": table})

    def rolled(height, spin, mu):
        q, v = {"x": jnp.array([0.0, 0.0, R + height]), "spin": jnp.zeros(3)}, {"x": jnp.array(v0), "spin": spin}
        traj = moved(system, q, v, mu, ts=jnp.array([0.0, 0.25, 2.0]))
        return traj.q["x"], traj.v["x"], traj.switches.t[0], traj.switches.v_after["x"][0], traj.modes

    v0, w0, mu = np.array([2.0, 0.5, 0.0]), np.array([3.0, -4.0, 1.0]), 0.2
    lanes = (0.0, w0, mu), (0.5, w0, mu), (0.5, w0, 5.0), (0.0, np.array([3.0, 4.0, -5.0]), mu)
    x, v, when, after, modes = (np.stack(values) for values in zip(*(rolled(h, jnp.array(w), m) for h, w, m in lanes)))
    s0 = np.array([v0[0] - R * w0[1], v0[1] + R * w0[0]])
    rolls, side = 2 * np.linalg.norm(s0) / (7 * mu * G), s0 / np.linalg.norm(s0)
    np.testing.assert_allclose(when[0], rolls, atol=1e-8)
    np.testing.assert_allclose(v[0, 2, :2], v0[:2] - 2 / 7 * s0, atol=1e-13)
    np.testing.assert_allclose(x[0, 1, :2], v0[:2] * 0.25 - 0.5 * mu * G * side * 0.25**2, atol=1e-12)
    way = v0[:2] * rolls - 0.5 * mu * G * side * rolls**2 + (v0[:2] - 2 / 7 * s0) * (2.0 - rolls)
    np.testing.assert_allclose(x[0, 2, :2], way, atol=1e-12)
    assert modes[0].tolist() == [[1, 1, 1], [1, 1, 1], [1, 2, 2]]
    down = np.sqrt(2 * G * 0.5)
    np.testing.assert_allclose(when[1:3], down / G, rtol=1e-12)
    np.testing.assert_allclose(after[1], [*(v0[:2] - mu * 1.5 * down * side), 0.5 * down], atol=1e-12)
    np.testing.assert_allclose(after[2], [*(v0[:2] - 2 / 7 * s0), 0.5 * down], atol=1e-12)
    assert np.linalg.norm(v[3, 2] - v[0, 2]) > 0.5


@pytest.mark.exhaustive
def test_float32_in_a_plane():
    """In float32 it stops where it does in float64, within that precision. Twin: another μ, another place."""
    found = [thrown(V0, mu, 0.2, dtype=np.float32, rtol=None) for mu in (0.4, 0.41)]
    assert all(traj.q.dtype == np.float32 for traj in found)
    np.testing.assert_allclose(found[0].q[-1], by_scipy(V0, 0.4, 0.2), atol=2e-5)
    assert np.linalg.norm(found[1].q[-1] - found[0].q[-1]) > 1e-3
