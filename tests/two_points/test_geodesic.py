"""Shortest paths against closed forms: the sphere in a chart and in space, the torus's equator, singular metrics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lagjax as lj
from lagjax.scenes import sphere_geodesic as sphere

R = sphere.PARAMS["R"]


def in_chart(q, v, params):
    """The line element of the sphere."""
    return params["R"] ** 2 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2)


def in_space(ends):
    """The geodesic on |r| = R, and the closed form's length and start direction."""
    a, b = (np.asarray(sphere.cartesian(sphere.PARAMS, *end)) for end in (ends[:2], ends[2:]))
    found = lj.geodesic(sphere.embedded, a, b, sphere.PARAMS, outputs=2)
    return found, sphere.distance(sphere.PARAMS, *ends), sphere.start_towards(sphere.PARAMS, *ends)[1]


@pytest.mark.slow
def test_sphere_in_space():
    """Lengths and directions to 1e-12: generic, meridian, over the pole and from it, more than π of azimuth; from
    1e-8 to antipodal the direction to 1e-7. Twin: the straight distance is another length."""
    for name in ("generic", "along a meridian", "over the pole", "from the pole"):
        found, length, direction = in_space(sphere.ARCS[name])
        assert abs(found.length - length) < 1e-12 and found.kind == "minimum", name
        assert np.max(np.abs(found.start_direction - direction)) < 1e-12, name
    found, length, direction = in_space(sphere.WIDE)
    assert abs(found.length - length) < 1e-12 and found.index == 0
    straight = np.linalg.norm(found.connection.q[-1] - found.connection.q[0])
    assert abs(straight - length) > 0.1
    found, length, direction = in_space(sphere.ARCS["antipodal but for 1e-8"])
    assert abs(found.length - length) < 1e-12 and found.connection.amplification > 1e7
    assert np.max(np.abs(found.start_direction - direction)) < 1e-7


@pytest.mark.exhaustive
def test_sphere_in_a_chart():
    """More than π of azimuth: the shorter way first, the longer one with index 1 and its conjugate point at π R."""
    psi_a, theta_a, psi_b, theta_b = sphere.WIDE
    a, b = {"psi": psi_a, "theta": theta_a}, {"psi": psi_b, "theta": theta_b}
    found = lj.geodesic(in_chart, a, b, sphere.PARAMS, angles="theta", outputs=2)
    (longer,), length = found.others, sphere.distance(sphere.PARAMS, *sphere.WIDE)
    assert abs(found.length - length) < 1e-12 and found.kind == "minimum"
    assert abs(longer.length - (2 * np.pi * R - length)) < 1e-12 and longer.kind == "saddle of index 1"
    assert abs(longer.conjugate_lengths[0] - np.pi * R) < 1e-9
    one_way = lj.geodesic(in_chart, a, b | {"theta": theta_b - 2 * np.pi}, sphere.PARAMS, outputs=2)
    assert one_way.others == ()


@pytest.mark.slow
def test_equator_of_a_torus():
    """The outer equator is conjugate after π √(r (R + r)); beyond, one off it is shorter. Twin: before, it is not."""

    def torus(q, v, params):
        return (params["R"] + params["r"] * jnp.cos(q[1])) ** 2 * v[0] ** 2 + params["r"] ** 2 * v[1] ** 2

    params, out = {"R": 2.0, "r": 0.7}, 2.7
    conjugate = np.pi * np.sqrt(0.7 * out)
    near = lj.geodesic(torus, np.zeros(2), np.array([0.99 * conjugate / out, 0.0]), params, outputs=2)
    assert near.kind == "minimum" and abs(near.length - 0.99 * conjugate) < 1e-12 and near.others == ()
    far = lj.geodesic(torus, np.zeros(2), np.array([1.5 * conjugate / out, 0.0]), params, outputs=2)
    assert far.kind == "minimum" and far.length < 1.5 * conjugate - 0.1
    along = far.others[-1]
    assert along.kind == "saddle of index 1" and abs(along.length - 1.5 * conjugate) < 1e-12
    assert abs(along.conjugate_lengths[0] - conjugate) < 1e-9


@pytest.mark.slow
def test_triaxial_ellipsoid():
    """Pairs of points: by SciPy, from the start direction over the length, the end is met. Twin: from another one."""
    axes, random = np.array([1.0, 0.8, 0.6]), np.random.default_rng(0)
    surface = lj.System(
        lambda t, q, v, params: 0.5 * v @ v,
        {"ellipsoid": lj.Holonomic(lambda t, q, axes: jnp.sum((q / axes) ** 2) - 1)},
    )

    def rates(s, y):
        normal = y[:3] / axes**2
        return np.concatenate([y[3:], -normal * np.sum((y[3:] / axes) ** 2) / np.sum(normal**2)])

    def end(a, direction, length):
        return solve_ivp(rates, (0, length), [*a, *direction], method="DOP853", rtol=1e-13, atol=1e-14).y[:3, -1]

    for _ in range(4):
        a, b = (x / np.linalg.norm(x / axes) for x in random.normal(size=(2, 3)))
        found = lj.geodesic(surface, a, b, axes, outputs=2)
        length, direction = float(found.length), np.asarray(found.start_direction)
        assert np.max(np.abs(end(a, direction, length) - b)) < 1e-12 and found.kind == "minimum"
        assert np.max(np.abs(end(a, direction, length + 1e-6) - b)) > 1e-7


@pytest.mark.slow
def test_antipodal_points():
    """A family of shortest paths: said, with their length."""
    found = lj.geodesic(sphere.embedded, np.array([R, 0.0, 0.0]), np.array([-R, 0.0, 0.0]), sphere.PARAMS, outputs=2)
    assert abs(found.length - np.pi * R) < 1e-12 and found.kind == "degenerate: ends are conjugate"


@pytest.mark.slow
def test_coincident_points():
    """Identical points: no length, and no direction."""
    a = np.array([1.0, 2.0])
    found = lj.geodesic(lambda q, v, params: v @ v / q[1] ** 2, a, a.copy(), outputs=2)
    assert found.length == 0 and np.all(np.isnan(found.start_direction)) and found.kind == "minimum"


@pytest.mark.exhaustive
def test_brachistochrone():
    """The time of descent is a length, |dx|² / (2 g depth), with the root of the depth as a coordinate; the metric is
    singular at the start, where nothing is evaluated. The time is the cycloid's. Twin: the time along the guess."""
    g, root = 9.80665, np.sqrt(5.0)

    def falls(q, v, params):
        return (v[0] ** 2 / q[1] ** 2 + 4 * v[1] ** 2) / (2 * params)

    def guess(t):
        return jnp.stack([10 * t**3, root * t])

    found = lj.geodesic(falls, np.zeros(2), np.array([10.0, root]), g, starts=guess, outputs=2)
    assert abs(found.length - 1.801603122453) < 1e-10 and found.trajectory is None
    t = (np.arange(1000) + 0.5) / 1000
    speed = np.sqrt(((30 * t**2 / (root * t)) ** 2 + 4 * root**2) / (2 * g))
    assert np.mean(speed) > 1.81


@pytest.mark.exhaustive
def test_both_catenaries():
    """The surface of a soap film between two rings is a length, y² |dq|²: the upper catenary is a minimum, the lower
    one, which steeper launches find, a saddle of index 1. Twin: the straight line finds the upper one alone."""
    far, film = 0.5, lj.System(lambda t, q, v, params: 0.5 * q[1] ** 2 * (v @ v))
    a, b = np.array([-far, 1.0]), np.array([far, 1.0])
    launches = [
        lj.integrate(film, a, np.array([np.cos(steep), -np.sin(steep)]), ts=np.linspace(0, 1, 40), estimate_error=False)
        for steep in np.deg2rad([0.0, 60.0, 75.0])
    ]
    found = lj.geodesic(film, a, b, starts=launches, outputs=2)
    assert len(found.others) == 1
    for answer, bracket, kind in zip(
        (found, *found.others), ((0.5, 2.0), (0.1, 0.4)), ("minimum", "saddle of index 1"), strict=True
    ):
        neck = float(np.asarray(brentq(lambda neck: neck * np.cosh(far / neck) - 1, *bracket, xtol=1e-15)))
        area = neck * far + neck**2 / 2 * np.sinh(2 * far / neck)
        assert abs(answer.length - area) < 1e-12 and answer.kind == kind
        assert np.max(np.abs(answer.start_direction - np.array([neck, -np.sqrt(1 - neck**2)]))) < 1e-11
    straight = lj.geodesic(film, a, b, outputs=2)
    assert straight.others == () and abs(straight.length - found.length) < 1e-12


def test_refused():
    """A length in place of its square, and an unknown angle, are refused in words."""
    a, b = np.array([1.0, 2.0]), np.array([2.0, 1.0])
    with pytest.raises(ValueError, match="not quadratic in the velocities"):
        lj.geodesic(lambda q, v, params: jnp.sqrt(v @ v), a, b)
    with pytest.raises(ValueError, match="angles names 'phi'"):
        lj.geodesic(lambda q, v, params: v @ v, a, b, angles="phi")


@pytest.mark.exhaustive
def test_lanes_and_derivatives():
    """Distances in the half plane under vmap, and their gradients: those of the closed form. Twin: of other ends."""

    def distance(b):
        return lj.geodesic(lambda q, v, params: v @ v / q[1] ** 2, jnp.array([0.0, 1.0]), b, outputs=2).length

    ends = jnp.array([[1.0, 2.0], [2.0, 0.5], [-1.0, 1.0]])

    def by_hand(b):
        return 2 * jnp.arcsinh(0.5 * jnp.sqrt((b[0] ** 2 + (b[1] - 1) ** 2) / b[1]))

    value, slope = jax.jit(jax.vmap(jax.value_and_grad(distance)))(ends)
    expected, by_end = jax.vmap(jax.value_and_grad(by_hand))(ends)
    assert np.max(np.abs(value - expected)) < 1e-12 and np.max(np.abs(slope - by_end)) < 1e-10
    assert np.max(np.abs(slope - by_end[::-1])) > 0.1


def test_no_geodesics():
    """Forces and velocity constraints turn motions off geodesics, which is refused by name; nothing is compiled."""
    pushed = lj.System(lambda t, q, v, p: 0.5 * v @ v, force=lambda t, q, v, p: -v)
    skate = lj.System(
        lambda t, q, v, p: 0.5 * v @ v, {"edge": lj.Nonholonomic(lambda t, q, v, p: v[0] * jnp.sin(q[2]) - v[1])}
    )
    a, b = np.zeros(3), np.ones(3)
    with pytest.raises(ValueError, match="the system has a force, and its motions are no geodesics"):
        lj.geodesic(pushed, a, b)
    with pytest.raises(ValueError, match="a velocity constraint 'edge'"):
        lj.exponential_map(skate, a, b)
    with pytest.raises(ValueError, match="the system has a force"):
        lj.parallel_transport(pushed, lambda t: a + t * b, b)
