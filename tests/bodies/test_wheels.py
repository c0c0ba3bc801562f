"""What rolls on surfaces f = 0, against closed forms (Routh, *Advanced Rigid Dynamics*, §§ 214-224)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies.wheels import least_of, searched, tangents
from tests.by_numpy import by_numpy
from tests.jaxtools.in_numpy import accelerations, evaluated

G, SMALL, LARGE, SHARE = 9.81, 0.3, 2.0, 0.4
MASS = 1.3


def quadric(r, params):
    """c + b·r + Σ d_i r_i², a sphere, a cylinder or a plane by its numbers."""
    return params["c"] + jnp.dot(params["b"], r) + jnp.sum(params["d"] * r**2)


def rolling_ball():
    """A solid ball on a quadric, under its weight."""
    ball = lj.bodies.Body("ball", MASS, (SHARE * MASS * SMALL**2,) * 3)
    contact = lj.bodies.rolling_sphere(ball.at(), lj.bodies.Surface(quadric), SMALL)
    return lj.bodies.multibody([ball], {"wall": contact}, [lj.bodies.weight([ball])])


def numbers(c, b, d):
    """Parameters of a quadric."""
    return {"c": jnp.asarray(c), "b": jnp.asarray(b), "d": jnp.asarray(d)}


IN_CYLINDER = numbers(LARGE**2, (0.0, 0.0, 0.0), (-1.0, -1.0, 0.0))


def in_the_cylinder(turning, upwards, about_radius):
    """A ball that rolls inside a vertical cylinder: v + ω × a e_r = 0."""
    angle, path = 0.7, LARGE - SMALL
    radial, across, up = np.array(
        [[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0, 0, 1]]
    )
    spin = about_radius * radial + upwards / SMALL * across - path * turning / SMALL * up
    pose = lj.bodies.Pose.at(path * radial, (1.0, 2.0, 0.0), 0.4)
    return {"ball": pose}, {"ball": pose.moving(path * turning * across + upwards * up, spin)}


def on_a_slope(path, angle, speed):
    """Place, direction and velocity of a ball on a circle about the origin, at an angle from the upward vertical."""
    place = np.array([path * np.sin(angle), 0.0, path * np.cos(angle)])
    along = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    return place, along, speed * along


@pytest.mark.slow
def test_a_ball_in_a_cylinder_in_a_bowl_on_a_globe_and_on_a_plane():
    """Its acceleration: z'' (1 + k) = -g - k a Ω ω_r in a vertical cylinder; g sin θ/(1 + k) along a slope."""
    system, sphere = rolling_ball(), (1.0, 1.0, 1.0)
    turning, about_radius = 3.0, 2.0
    q, v = in_the_cylinder(turning, 0.5, about_radius)
    for residual in lj.constraint_residual(system, 0.0, q, v, IN_CYLINDER).values():
        np.testing.assert_allclose(residual, 0.0, atol=1e-14)
    a, _ = accelerations(system, 0.0, q, v, IN_CYLINDER)
    expected = -(G + SHARE * SMALL * turning * about_radius) / (1 + SHARE)
    np.testing.assert_allclose(a["ball"].position[2], expected, rtol=1e-12)
    radial = q["ball"].position * np.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(a["ball"].position[:2], -(turning**2) * radial[:2], rtol=1e-12)

    zero = (0.0, 0.0, 0.0)
    for path, side, params in (
        (LARGE - SMALL, 1.0, numbers(LARGE**2, zero, tuple(-x for x in sphere))),
        (LARGE + SMALL, -1.0, numbers(-(LARGE**2), zero, sphere)),
    ):
        angle, speed = (2.6 if side > 0 else 0.4), 0.7
        place, along, velocity = on_a_slope(path, angle, speed)
        # v + ω × arm = 0: the point of contact lies outwards of the centre in a bowl, and inwards on a globe.
        spin = np.cross(velocity, side * place / path) / SMALL
        pose = lj.bodies.Pose.at(place)
        q, v = {"ball": pose}, {"ball": pose.moving(velocity, spin)}
        for residual in lj.constraint_residual(system, 0.0, q, v, params).values():
            np.testing.assert_allclose(residual, 0.0, atol=1e-14)
        a, _ = accelerations(system, 0.0, q, v, params)
        expected = G * np.sin(angle) / (1 + SHARE) * along - speed**2 / path * place / path
        np.testing.assert_allclose(a["ball"].position, expected, atol=1e-12)


def turntable():
    """A solid ball on a table that turns about the vertical, a given motion."""
    ball = lj.bodies.Body("ball", MASS, (SHARE * MASS * SMALL**2,) * 3)
    table = lj.bodies.Body("table", motion=lambda t, params: lj.bodies.Pose.at(angle=params["rate"] * t))
    return lj.bodies.multibody([ball, table], {"table": lj.bodies.rolling_sphere(ball.at(), table.at(), SMALL)})


def on_the_table(rate, place, velocity):
    """A ball that rolls: v + ω × (-a e_z) = Ω e_z × r, without spin about the vertical."""
    slip = np.asarray(velocity) - rate * np.array([-place[1], place[0], 0.0])
    spin = np.array([-slip[1], slip[0], 0.0]) / SMALL
    pose = lj.bodies.Pose.at((*place[:2], SMALL), (1.0, 2.0, 0.0), 0.4)
    return {"ball": pose}, {"ball": pose.moving(velocity, spin)}


@pytest.mark.slow
def test_a_ball_on_a_turntable():
    """Its velocity turns at 2/7 of the table's rate, whatever that is; it stands still for one that does not turn."""
    system, velocity = turntable(), np.array([0.4, -0.3, 0.0])
    q, v = on_the_table(1.5, (0.7, 0.2), velocity)
    for t in (0.0, 0.8):
        for residual in lj.constraint_residual(system, t, q, v, {"rate": 1.5}).values():
            np.testing.assert_allclose(residual, 0.0, atol=1e-15)
        a, multipliers = accelerations(system, t, q, v, {"rate": 1.5})
        expected = SHARE / (1 + SHARE) * 1.5 * np.cross([0.0, 0.0, 1.0], velocity)
        np.testing.assert_allclose(a["ball"].position, expected, atol=1e-13)
        # Nothing but the table pushes it, along the table.
        pushed = np.linalg.norm(multipliers["table rolls"])
        np.testing.assert_allclose(pushed, MASS * np.linalg.norm(expected), rtol=1e-12)
    # Twin: the state of a ball on the turning table slips on one that stands.
    still = lj.constraint_residual(system, 0.0, q, v, {"rate": 0.0})["table rolls"]
    np.testing.assert_allclose(np.linalg.norm(still), 1.5 * np.hypot(0.7, 0.2), rtol=1e-13)


def test_bad_motions():
    """What is no motion, and coordinates of a body whose motion is given, are refused with the fix."""
    with pytest.raises(TypeError, match="motion.t, params. of 'table' is called with 2 arguments"):
        lj.bodies.Body("table", motion=lambda t: lj.bodies.Pose.at())
    ball, q, v = (
        lj.bodies.Body("ball", 1.0, (1.0, 1.0, 1.0)),
        {"ball": lj.bodies.Pose.at()},
        {"ball": lj.bodies.Pose.at().moving()},
    )
    table = lj.bodies.Body("table", motion=lambda t, params: (0.0, 0.0, 0.0))
    with pytest.raises(TypeError, match="must return a lj.bodies.Pose, not \\("):
        lj.accelerations(lj.bodies.multibody([ball, table]), 0.0, q, v, None)
    table = lj.bodies.Body("table", motion=lambda t, params: lj.bodies.Pose.at(angle=t))
    with pytest.raises(ValueError, match="'table' moves as given, and has no coordinates"):
        lj.accelerations(
            lj.bodies.multibody([ball, table]), 0.0, q | {"table": q["ball"]}, v | {"table": v["ball"]}, None
        )
    with pytest.raises(TypeError, match="'table' moves as given, and has no entry in q"):
        table.point(q, (1.0, 0.0, 0.0))


@pytest.mark.slow
def test_the_point_of_contact():
    """In an ellipsoid balls, wheels and ellipsoids touch where f is least on them: g = 0 there, and grows as the
    distance."""
    squares = np.array([4.0, 2.0, 1.0])
    inside = lj.bodies.Surface(lambda r, params: 1.0 - jnp.sum(r**2 / squares))
    place = np.sqrt(squares) * np.array([0.48, 0.6, 0.64])
    normal = -place / squares / np.linalg.norm(place / squares)
    body = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 1.0))
    ball, wheel = lj.bodies.rolling_sphere(body.at(), inside, 0.1), lj.bodies.rolling(body.at(), inside, 0.1)
    turned = lj.bodies.Pose.at(axis=(1.0, 2.0, 0.5), angle=0.8)
    axis = np.asarray(body.direction({"wheel": turned}, (0.0, 0.0, 1.0)))
    to_rim = normal - (normal @ axis) * axis
    half_axes = 0.1 * np.array([1.0, 0.7, 0.4])
    stone = lj.bodies.rolling_ellipsoid(body.at(), inside, half_axes)
    stretched = np.asarray(turned.matrix) @ np.diag(half_axes**2) @ np.asarray(turned.matrix).T @ normal
    for contact, arm in (
        (ball, 0.1 * normal),
        (wheel, 0.1 * to_rim / np.linalg.norm(to_rim)),
        (stone, stretched / np.sqrt(normal @ stretched)),
    ):

        def gap(height, contact=contact, arm=arm):
            return contact["touches"].function(
                0.0, {"wheel": turned._replace(position=place + arm + height * normal)}, None
            )

        value, slope = jax.jit(lambda x, gap=gap: jax.jvp(gap, (x,), (jnp.ones_like(x),)))(jnp.asarray(0.0))
        np.testing.assert_allclose(value, 0.0, atol=1e-15)
        np.testing.assert_allclose(slope, 1.0, rtol=1e-13)
    # Straight below the centre is not where it touches.
    centre = place + 0.1 * normal
    down = -centre / squares / np.linalg.norm(centre / squares)
    assert abs(1.0 - np.sum((centre - 0.1 * down) ** 2 / squares)) > 5e-5


def test_the_normal_is_that_of_the_place_of_contact():
    """On a globe an ellipsoid touches along the globe's radius at that place, not along that of its own centre."""
    place, half_axes = 2.0 * np.array([0.48, 0.6, 0.64]), np.diag([0.3, 0.2, 0.1])
    normal = place / 2.0
    arm = -half_axes @ half_axes @ normal / np.linalg.norm(half_axes @ normal)
    distance = lambda r: jnp.sqrt(jnp.sum(r**2)) - 2.0
    found = by_numpy(lambda centre, shape: searched(distance, centre, shape))(place - arm, half_axes)
    np.testing.assert_allclose(np.stack([found.point, found.normal]), [place, normal], rtol=1e-12)
    np.testing.assert_allclose([found.height, found.slope], [0.0, 1.0], atol=1e-14)
    # Twin: from the centre the radius points elsewhere.
    assert np.max(np.abs((place - arm) / np.linalg.norm(place - arm) - normal)) > 1e-2


def test_tangents():
    """Two unit vectors at right angles to each other and to the normal, whatever it is."""
    for seed in range(5):
        normal = np.random.default_rng(seed).normal(size=3)
        normal = normal / np.linalg.norm(normal)
        both = by_numpy(tangents)(normal)
        np.testing.assert_allclose(both @ both.T, np.eye(2), atol=1e-14)
        np.testing.assert_allclose(both @ normal, 0.0, atol=1e-14)


WHEEL, RIM, AXIAL, ACROSS = 0.8, 0.5, 0.11, 0.06


def rolling_wheel():
    """A wheel on a quadric, under its weight."""
    wheel = lj.bodies.Body("wheel", WHEEL, (ACROSS, ACROSS, AXIAL))
    contact = lj.bodies.rolling(wheel.at(), lj.bodies.Surface(quadric), RIM)
    return lj.bodies.multibody([wheel], {"rim": contact}, [lj.bodies.weight([wheel])])


IN_BOWL = numbers(LARGE**2, (0.0, 0.0, 0.0), (-1.0, -1.0, -1.0))


def moment(spin, axis):
    """The wheel's angular momentum."""
    return ACROSS * spin + (AXIAL - ACROSS) * (spin @ axis) * axis


def in_a_bowl(place, axis, spin):
    """Rates of a wheel's place, axis and spin in a spherical bowl, by Newton and Euler.

    The rim touches where it is farthest from the bowl's centre: e = w/|w| with w = c - (c·a) a. There v + ω × R e = 0,
    and m (v̇ - g) is the force.
    """
    turning = np.cross(spin, axis)
    off = place - (place @ axis) * axis
    to_rim = off / np.linalg.norm(off)
    velocity = -RIM * np.cross(spin, to_rim)
    change = velocity - (velocity @ axis + place @ turning) * axis - (place @ axis) * turning
    turns = (change - (change @ to_rim) * to_rim) / np.linalg.norm(off)
    # L̇ = R e × m (v̇ - g) with v̇ = -R (ω̇ × e + ω × ė), linear in ω̇.
    gravity = np.array([0.0, 0.0, -G])
    known = RIM * WHEEL * np.cross(to_rim, -RIM * np.cross(spin, turns) - gravity)
    known = known - (AXIAL - ACROSS) * ((spin @ turning) * axis + (spin @ axis) * turning)
    matrix = np.stack(
        [moment(x, axis) + RIM**2 * WHEEL * np.cross(to_rim, np.cross(x, to_rim)) for x in np.eye(3)], axis=1
    )
    rate = np.linalg.solve(matrix, known)
    return velocity, turning, rate, -RIM * (np.cross(rate, to_rim) + np.cross(spin, turns))


def start_in_a_bowl(spin, aside=0.4):
    """A wheel that touches the bowl."""
    pose = lj.bodies.Pose.at(axis=(1.0, 0.4, -0.3), angle=1.3)
    axis = np.asarray(pose.matrix)[:, 2]
    down = np.array([0.3, 0.2, -1.0])
    down = down - (down @ axis) * axis
    place = aside * axis + (np.sqrt(LARGE**2 - aside**2) - RIM) * down / np.linalg.norm(down)
    pose = pose._replace(position=jnp.asarray(place))
    velocity = in_a_bowl(place, axis, np.asarray(spin))[0]
    return {"wheel": pose}, {"wheel": pose.moving(velocity, spin)}


@pytest.mark.slow
def test_a_wheel_in_a_bowl():
    """It accelerates as Newton and Euler have it. Twin: farther aside it does not."""
    for spin in ((0.3, -0.8, 4.0), (2.0, 1.0, -1.5)):
        q, v = start_in_a_bowl(spin)
        place, axis = np.asarray(q["wheel"].position), np.asarray(q["wheel"].matrix)[:, 2]
        a, _ = accelerations(rolling_wheel(), 0.0, q, v, IN_BOWL)
        np.testing.assert_allclose(a["wheel"].position, in_a_bowl(place, axis, np.asarray(spin))[3], atol=1e-11)
        assert np.abs(a["wheel"].position - in_a_bowl(place + 0.1 * axis, axis, np.asarray(spin))[3]).max() > 0.01


HALF_AXES, STONE = (0.2, 0.03, 0.02), 1.1
TILT = np.array([[np.cos(0.3), -np.sin(0.3), 0.0], [np.sin(0.3), np.cos(0.3), 0.0], [0.0, 0.0, 1.0]])
INERTIA = TILT @ np.diag([2e-4, 1.6e-3, 1.7e-3]) @ TILT.T


def rattling(axes, spin):
    """The velocity and acceleration of an ellipsoid's centre on a plane, by Newton and Euler.

    It touches at r = -R S² n/|S n|, with n = Rᵀ e_z, where v + ω × r = 0 and the force is m (v̇ + g e_z).
    """
    up, squares = np.array([0.0, 0.0, 1.0]), np.square(HALF_AXES)
    n = axes.T @ up
    n_dot, size = np.cross(n, axes.T @ spin), np.sqrt(n @ (squares * n))
    r = -axes @ (squares * n) / size
    r_dot = np.cross(spin, r) - axes @ (squares * (n_dot - n * (n @ (squares * n_dot)) / size**2)) / size
    inertia = axes @ INERTIA @ axes.T
    # I ω̇ + ω × I ω = r × m (v̇ + g e_z) with v̇ = -(ω̇ × r + ω × ṙ), linear in ω̇.
    known = np.cross(r, STONE * (G * up - np.cross(spin, r_dot))) - np.cross(spin, inertia @ spin)
    matrix = inertia + STONE * np.stack([np.cross(r, np.cross(x, r)) for x in np.eye(3)], axis=1)
    rate = np.linalg.solve(matrix, known)
    return r, -np.cross(spin, r), -(np.cross(rate, r) + np.cross(spin, r_dot))


@pytest.mark.slow
def test_a_rattleback():
    """An ellipsoid whose inertia is turned against its shape, as Newton and Euler have it. Twin: another half axis."""
    stone = lj.bodies.Body("stone", STONE, INERTIA)
    half_axes = tuple(lambda params, i=i: params[i] for i in range(3))
    contact = lj.bodies.rolling_ellipsoid(stone.at(), lj.bodies.ground.at(), half_axes)
    system = lj.bodies.multibody([stone], {"rolls": contact}, [lj.bodies.weight([stone])])
    found = lambda q, v, params: accelerations(system, 0.0, q, v, params)[0]["stone"].position
    for axis, angle, spin in (((1.0, 0.4, -0.3), 0.3, (0.3, -0.8, 4.0)), ((0.2, 1.0, 0.1), 1.2, (2.0, 1.0, -1.5))):
        pose = lj.bodies.Pose.at(axis=axis, angle=angle)
        r, velocity, expected = rattling(np.asarray(pose.matrix), np.asarray(spin))
        pose = pose._replace(position=jnp.array([0.7, -0.4, -r[2]]))
        q, v = {"stone": pose}, {"stone": pose.moving(velocity, spin)}
        for residual in lj.constraint_residual(system, 0.0, q, v, HALF_AXES).values():
            np.testing.assert_allclose(residual, 0.0, atol=1e-15)
        np.testing.assert_allclose(found(q, v, HALF_AXES), expected, atol=1e-11)
        assert np.linalg.norm(found(q, v, (0.2, 0.032, 0.02)) - expected) > 1e-3


def derivatives(f):
    """A function and its first three derivatives, compiled."""
    first = jax.jacfwd(f)
    second = jax.jacfwd(jax.jacrev(f))
    return jax.jit(lambda x: (f(x), first(x), second(x), jax.jacfwd(second)(x)))


@pytest.mark.exhaustive
def test_derivatives_of_the_point_of_contact():
    """In a spherical bowl it lies outwards, c/|c|, on a rim along c in its plane: derivatives up to the third."""
    place, axes = jnp.array([0.5, -1.2, 0.9]), lj.bodies.Pose.at(axis=(1.0, 0.4, -0.3), angle=1.3).matrix.T

    def unit(x):
        return x / jnp.sqrt(jnp.sum(x**2))

    for rows in (jnp.eye(3), axes[:2]):

        def found(c, rows=rows):
            start = jax.lax.stop_gradient(unit(unit(rows @ c) + 0.1))
            return jnp.append(*least_of(lambda u: LARGE**2 - jnp.sum((c + SMALL * u @ rows) ** 2), start))

        def known(c, rows=rows):
            u = unit(rows @ c)
            return jnp.append(u, LARGE**2 - jnp.sum((c + SMALL * u @ rows) ** 2))

        for x, y in zip(derivatives(found)(place), derivatives(known)(place)):
            np.testing.assert_allclose(x, y, atol=1e-12)
    # Too far to be found from here.
    assert np.isnan(least_of(lambda u: -jnp.dot(u, place), -unit(place + 0.3))[1])


def test_distances():
    """Straight below its centre a ball touches as the search finds it; what is no distance has no gap."""
    ball = lj.bodies.Body("ball", 1.0, (1.0, 1.0, 1.0))
    q = {"ball": lj.bodies.Pose.at((1.0, -0.8, 0.3))}

    def gap(f, is_distance):
        touches = lj.bodies.rolling_sphere(ball.at(), lj.bodies.Surface(f, is_distance=is_distance), SMALL)["touches"]
        assert isinstance(touches, lj.Holonomic)
        return evaluated(lambda q: touches.g(0.0, q, None), q)[0]

    def pipe(r, params):
        return LARGE - jnp.sqrt(r[0] ** 2 + r[1] ** 2)

    expected = LARGE - SMALL - np.hypot(1.0, 0.8)
    np.testing.assert_allclose([gap(pipe, True), gap(pipe, False)], expected, rtol=1e-14)
    assert np.isnan(gap(lambda r, params: LARGE**2 - r[0] ** 2 - r[1] ** 2, True))


def test_what_is_no_surface():
    """Surfaces that are none are refused with the way to write one."""
    ball, surface, flat = lj.bodies.Body("ball", 1.0, (1.0, 1.0, 1.0)), lj.bodies.Surface, lambda r, params: r[2]
    place, ground = ball.at(), lj.bodies.ground.at()
    for call, kind, words in (
        (lambda: surface(1.0), TypeError, "must be a function of .r, params., not 1.0.\nFix: lj.bodies.Surface"),
        (lambda: surface(lambda x, y, z: z), TypeError, "of lj.bodies.Surface"),
        (lambda: surface(flat, on=ball), TypeError, "must be on a marker, not a Body"),
        (
            lambda: lj.bodies.rolling_sphere(place, surface(flat, on=place), 1.0),
            ValueError,
            "both places are on 'ball'",
        ),
        (lambda: lj.bodies.rolling_ellipsoid(place, ground, 1.0), ValueError, "three half axes, not 1.0"),
    ):
        with pytest.raises(kind, match=words):
            call()
