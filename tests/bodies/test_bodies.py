"""Rigid bodies and joints, against closed forms of textbooks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies.body import about, conjugate, product, rotation_matrix, spin_in_space
from tests.by_numpy import by_numpy
from tests.jaxtools.in_numpy import accelerations, along

G = 9.81


def angular_acceleration(body, q, a):
    """Ω' in space: of ė e* + ... only 2 vec(ë e*) has a vector part."""
    return by_numpy(spin_in_space)(body.pose(q).quaternion, body.rates(a).quaternion)


def test_rotations():
    """R is a rotation about its axis by its angle; a product turns as both; Ω is the axis times the rate."""
    axis = np.array([1.0, 2.0, -1.0])
    e, f = about((0.0, 0.0, 2.0), 0.5), about(axis, 1.2)
    # Traced, the two that know their numbers are other programs.
    np.testing.assert_allclose(by_numpy(about)(axis, 1.2), f, atol=1e-15)
    np.testing.assert_allclose(by_numpy(product)(e, f), product(e, f), atol=1e-15)
    of, spin = by_numpy(rotation_matrix), by_numpy(spin_in_space)
    expected = [[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(of(e), expected, atol=1e-15)
    np.testing.assert_allclose(of(product(e, f)), of(e) @ of(f), atol=1e-15)
    assert np.abs(of(product(f, e)) - of(e) @ of(f)).max() > 0.1
    np.testing.assert_allclose(of(by_numpy(conjugate)(f)), of(f).T, atol=1e-15)
    _, rate = by_numpy(along(lambda angle: about(axis, angle)))(1.2, 3.0)
    np.testing.assert_allclose(spin(f, rate), 3.0 * axis / np.sqrt(6.0), atol=1e-15)


def test_poses_and_points():
    """A turning body: velocity v + Ω × r of its points, Euler's T, one spin along both kinds of axes."""
    body = lj.bodies.Body("b", 2.0, (1.0, 2.0, 2.5))
    pose = lj.bodies.Pose.at((1.0, 0.0, 0.0), (0.0, 1.0, 1.0), 0.7).turned((1.0, 0.0, 0.0), 0.4)
    velocity, spin, r = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    q, v = {"b": pose}, {"b": pose.moving(velocity, spin)}
    np.testing.assert_allclose(by_numpy(body.spin)(q, v), spin, atol=1e-15)
    rotation = by_numpy(rotation_matrix)(pose.quaternion)
    np.testing.assert_allclose(by_numpy(body.spin_in_body)(q, v), rotation.T @ spin, atol=1e-15)
    np.testing.assert_allclose(by_numpy(body.velocity)(q, v, r), velocity + np.cross(spin, rotation @ r), atol=1e-15)
    _, moved = by_numpy(along(lambda q: body.point(q, r)))(q, v)
    np.testing.assert_allclose(moved, velocity + np.cross(spin, rotation @ r), atol=1e-15)
    inertia = rotation @ np.diag([1.0, 2.0, 2.5]) @ rotation.T
    energy = by_numpy(body.kinetic)(q, v)
    np.testing.assert_allclose(energy, velocity @ velocity + spin @ inertia @ spin / 2, rtol=1e-14)
    np.testing.assert_allclose(by_numpy(body.angular_momentum)(q, v), inertia @ spin, rtol=1e-14)
    of_params = lj.bodies.Body("b", lambda p: p["m"], lambda p: jnp.diag(p["I"]))
    params = {"m": 2.0, "I": np.array([1.0, 2.0, 2.5])}
    np.testing.assert_allclose(by_numpy(of_params.kinetic)(q, v, params), energy, rtol=1e-14)


def hinged(joint):
    """A bar, its hinge at (0, 0, 1) of its axes, turned by 0.6 about y with a rate of 2, under its weight."""
    bar = lj.bodies.Body("bar", 3.0, (0.5, 0.6, 0.2))
    at, on = lj.bodies.ground.at((0.1, 0.2, 0.3), axis=(0.0, 1.0, 0.0)), bar.at((0.0, 0.0, 1.0), axis=(0.0, 1.0, 0.0))
    system = lj.bodies.multibody([bar], {"hinge": joint(at, on)}, [lj.bodies.weight([bar])])
    pose = lj.bodies.Pose.at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.6)
    arm = -bar.direction({"bar": pose}, (0.0, 0.0, 1.0))
    pose = pose._replace(position=jnp.array([0.1, 0.2, 0.3]) + arm)
    spin = jnp.array([0.0, 2.0, 0.0])
    return bar, system, {"bar": pose}, {"bar": pose.moving(jnp.cross(spin, arm), spin)}


@pytest.mark.slow
def test_a_hinge():
    """A bar on a hinge is a physical pendulum: θ'' = -m g l sin θ/(I + m l²); the hinge carries what is left.

    A ball joint and a sleeve leave more freedoms, which a motion in the plane does not use.
    """
    expected = -3.0 * G * np.sin(0.6) / (0.6 + 3.0)
    for joint, count in ((lj.bodies.spherical, 3), (lj.bodies.cylindrical, 4), (lj.bodies.revolute, 5)):
        bar, system, q, v = hinged(joint)
        held = system.constraints["hinge"]
        assert isinstance(held, lj.Holonomic)
        np.testing.assert_allclose(held.g(0.0, q, None), np.zeros(count), atol=1e-14)
        a, _ = accelerations(system, 0.0, q, v, None)
        np.testing.assert_allclose(angular_acceleration(bar, q, a)[1], expected, atol=1e-12)
    bar, system, q, v = hinged(lj.bodies.revolute)
    a, _ = lj.accelerations(system, 0.0, q, v, None)
    np.testing.assert_allclose(angular_acceleration(bar, q, a), [0.0, expected, 0.0], atol=1e-12)
    # The force of the hinge on the bar, by Newton's law for its centre of mass.
    force = lj.constraint_force(system, 0.0, q, v, None)["hinge"]["bar"].position
    np.testing.assert_allclose(force, 3.0 * (a["bar"].position + jnp.array([0.0, 0.0, G])), atol=1e-12)


def test_a_top_precesses():
    """On its tip, with C ω3 Ω = m g l + A Ω² cos θ, its axis goes round without nodding: the spin turns with it.

    Twin: with a tenth less spin it nods. Goldstein, §5.7.
    """
    across, C, length, tilt, turn = 0.1, 0.05, 0.5, 0.7, 2.0
    A, axis, up = across + length**2, np.array([0.0, -np.sin(tilt), np.cos(tilt)]), np.array([0.0, 0.0, 1.0])
    top = lj.bodies.Body("top", 1.0, (across, across, C))
    tip = lj.bodies.spherical(lj.bodies.ground.at(), top.at((0.0, 0.0, -length)))
    system = lj.bodies.multibody([top], {"tip": tip}, [lj.bodies.weight([top])])
    pose = lj.bodies.Pose.at(length * axis, axis=(1.0, 0.0, 0.0), angle=tilt)
    for share in (1.0, 0.9):
        own = share * (G * length + A * turn**2 * np.cos(tilt)) / (C * turn) - turn * np.cos(tilt)
        spin, q = own * axis + turn * up, {"top": pose}
        a, _ = accelerations(system, 0.0, q, {"top": pose.moving(np.cross(spin, length * axis), spin)}, None)
        off = np.abs(angular_acceleration(top, q, a) - np.cross(turn * up, spin)).max()
        assert off < 1e-11 if share == 1.0 else off > 1.0


@pytest.mark.slow
def test_a_slide_with_a_spring_a_damper_and_a_motor():
    """A slider on a spring: m x'' = F - k (x - l) - c x'; the same body on a hinge turns by torque over inertia."""
    slider = lj.bodies.Body("slider", 2.0, (1.0, 1.0, 1.0))
    along = (1.0, 0.0, 0.0)
    rail = lj.bodies.prismatic(lj.bodies.ground.at(axis=along), slider.at(axis=along))
    spring = lj.bodies.spring(
        lj.bodies.ground.at((-1.0, 0.0, 0.0)), slider.at(), stiffness=lambda p: p["k"], length=0.7, damping=0.4
    )
    push = lj.bodies.applied(slider.at((0.0, 0.0, 0.1)), (3.0, 5.0, 0.0))
    system = lj.bodies.multibody([slider], {"rail": rail}, [spring, push])
    pose = lj.bodies.Pose.at((0.5, 0.0, 0.0))
    a, _ = lj.accelerations(system, 0.0, {"slider": pose}, {"slider": pose.moving((0.2, 0.0, 0.0))}, {"k": 7.0})
    np.testing.assert_allclose(a["slider"].position, [(3.0 - 7.0 * 0.8 - 0.4 * 0.2) / 2.0, 0.0, 0.0], atol=1e-12)
    assert np.abs(a["slider"].quaternion).max() < 1e-12
    wheel = lj.bodies.Body("slider", 2.0, (1.0, 1.0, 1.5))
    torque = lj.bodies.motor(lj.bodies.ground.at(), wheel.at(), lambda t, q, v, p: 3.0 - wheel.spin(q, v)[2])
    turning = lj.bodies.multibody([wheel], {"axle": lj.bodies.revolute(lj.bodies.ground.at(), wheel.at())}, [torque])
    pose = lj.bodies.Pose.at(angle=0.3)
    q, v = {"slider": pose}, {"slider": pose.moving(spin=(0.0, 0.0, 0.5))}
    a, _ = lj.accelerations(turning, 0.0, q, v, None)
    np.testing.assert_allclose(angular_acceleration(wheel, q, a), [0.0, 0.0, 2.5 / 1.5], atol=1e-12)


@pytest.mark.slow
def test_rolling_down():
    """Down a plane at an angle α a ball accelerates by 5/7, a disk by 2/3 of g sin α, and slipping by all of it."""
    tilt, radius = 0.3, 0.4
    normal, down = np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    floor = lj.bodies.ground.at((0.0, 0.0, 0.0), axis=normal)
    for roll, inertia, share in (
        (lj.bodies.rolling_sphere, 0.4 * radius**2 * np.ones(3), 5 / 7),
        (lj.bodies.rolling, np.array([0.25, 0.5, 0.25]) * radius**2, 2 / 3),
    ):
        wheel = lj.bodies.Body("wheel", 1.0, tuple(inertia))
        contact = roll(wheel.at(axis=(0.0, 1.0, 0.0)), floor, radius)
        system = lj.bodies.multibody([wheel], {"wheel": contact}, [lj.bodies.weight([wheel])])
        assert set(system.constraints) == {"wheel is turned", "wheel touches", "wheel rolls"}
        pose = lj.bodies.Pose.at(radius * normal, (0.0, 1.0, 0.0), 1.1)
        q, v = {"wheel": pose}, {"wheel": pose.moving(2.0 * down, (0.0, 2.0 / radius, 0.0))}
        for residual in lj.constraint_residual(system, 0.0, q, v, None).values():
            np.testing.assert_allclose(residual, 0.0, atol=1e-13)
        a, _ = lj.accelerations(system, 0.0, q, v, None)
        np.testing.assert_allclose(a["wheel"].position, share * G * np.sin(tilt) * down, atol=1e-12)
        slipping = lj.bodies.multibody([wheel], {"wheel": contact["touches"]}, [lj.bodies.weight([wheel])])
        a, _ = lj.accelerations(slipping, 0.0, q, v, None)
        np.testing.assert_allclose(a["wheel"].position, G * np.sin(tilt) * down, atol=1e-12)


@pytest.mark.slow
def test_a_cardan_joint_and_a_weld():
    """The cross of a Cardan joint ties two shafts, tan θ2 = cos β tan θ1; a weld has no freedom left."""
    bend = 0.5
    tilted = (np.sin(bend), 0.0, np.cos(bend))
    first, second = lj.bodies.Body("first", 1.0, (1.0, 1.0, 1.0)), lj.bodies.Body("second", 1.0, (1.0, 1.0, 1.0))
    joint = lj.bodies.universal(first.at(axis=(0.0, 1.0, 0.0)), second.at(axis=(1.0, 0.0, 0.0)))

    def cross(angle_1, angle_2):
        start = lj.bodies.Pose.at(axis=(0.0, 1.0, 0.0), angle=bend)
        q = {"first": lj.bodies.Pose.at(angle=angle_1), "second": start.turned(tilted, angle_2)}
        return joint.g(0.0, q, None)

    angle = 0.8
    np.testing.assert_allclose(cross(angle, np.arctan(np.tan(angle) * np.cos(bend))), 0.0, atol=1e-15)
    assert abs(cross(angle, angle)[3]) > 0.01
    weld = lj.bodies.fixed(first.at((1.0, 0.0, 0.0)), second.at((-1.0, 0.0, 0.0)))
    system = lj.bodies.multibody([first, second], {"weld": weld})
    left, right = lj.bodies.Pose.at((-1.0, 0.0, 0.0)), lj.bodies.Pose.at((1.0, 0.0, 0.0))
    q = {"first": left, "second": right}
    spin = (0.0, 0.0, 2.0)
    v = {"first": left.moving((0.0, -2.0, 0.0), spin), "second": right.moving((0.0, 2.0, 0.0), spin)}
    force = lj.constraint_force(system, 0.0, q, v, None)["weld"]["first"]
    # Each half is held on its circle of radius 1.
    np.testing.assert_allclose(force.position, [4.0, 0.0, 0.0], atol=1e-12)


def test_single_precision():
    """In float32 all that bodies, joints and loads give is float32, though markers hold Python's numbers."""
    rod = lj.bodies.Body("rod", 1, (1, 1, 2))
    a, b = lj.bodies.ground.at((0.1, 0.0, 0.0), (1.0, 1.0, 0.0)), rod.at(lambda params: (0.0, params, 0.0))
    loads = lj.bodies.weight([rod]), lj.bodies.spring(a, b, 2), lj.bodies.torsion(a, b, 2)
    damper, drive = lj.bodies.spring(a, b, 2, damping=1).dissipation, lj.bodies.motor(a, b, 2).power
    assert damper is not None and drive is not None

    def given(place, turn, half):
        pose = lj.bodies.Pose(place, turn).turned((1.0, 0.0, 0.0), 0.5)
        q, v = {"rod": pose}, {"rod": pose.moving((1.0, 0.0, 0.0), (0.0, 2.0, 0.0))}
        found = [rod.kinetic(q, v), lj.bodies.fixed(a, b).g(0.0, q, half), lj.bodies.prismatic(a, b).g(0.0, q, half)]
        found += [load.potential(0.0, q, v, half) for load in loads if load.potential is not None]
        found += [damper(0.0, q, v, half), drive(0.0, q, v, v, half), q, v, rod.angular_momentum(q, v)]
        return jax.tree.map(jnp.asarray, found)

    shapes = jax.eval_shape(given, *(np.ones(shape, np.float32) for shape in (3, 4, ())))
    assert {x.dtype for x in jax.tree.leaves(shapes)} == {np.dtype("float32")}


ROD, GROUND, NAN = lj.bodies.Body("rod", 1.0, (1.0, 1.0, 2.0)), lj.bodies.ground.at(), float("nan")
HINGE, PULL = lj.bodies.revolute(GROUND, ROD.at()), lj.bodies.weight([ROD])
a_rod = lambda mass=1.0, inertia=(1.0, 1.0, 1.0): lj.bodies.Body("rod", mass, inertia)
of_state, of_params = lambda t, q, v, params: 1.0, lambda params: params["torque"]
NO_POSE = {"rod": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))}
WRONG_VALUES = [
    (lambda: a_rod(inertia=(3.0, 1.0, 1.0)), "no body has the moments of inertia of 'rod', 1, 1, 3: each is at most"),
    (lambda: a_rod(inertia=((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))), "three .* moments or a symmetric mat"),
    *((lambda x=x: a_rod(inertia=x), "three principal moments") for x in ((1, NAN, 1), (np.inf,) * 3, 1.0, (1.0, 2.0))),
    *((lambda x=x: a_rod(x), "mass of 'rod' must be a positive number") for x in (0.0, np.inf, "1", np.ones(1))),
    (lambda: lj.bodies.spherical(ROD.at((1.0, 0.0, 0.0)), ROD.at((-1.0, 0.0, 0.0))), "both places are on 'rod'"),
    (lambda: lj.bodies.multibody([ROD, a_rod(2.0)]), "two bodies are called 'rod'"),
    *((lambda x=x: ROD.at(x), "a point of 'rod' must be three numbers") for x in ((1.0, 0.0), (0.0, 0.0, NAN))),
    *((lambda x=x: ROD.at(axis=x), "the axis of a marker on 'rod'") for x in ((0.0, 0.0, 0.0), (np.inf, 0.0, 0.0))),
    (lambda: lj.bodies.Pose.at((1.0, 2.0)), "position of a pose must be three numbers"),
    *((lambda x=x: lj.bodies.Pose.at(axis=x), "axis of a pose must be finite and not zero")
      for x in ((0, 0, 0), (NAN, 0, 0))),
    *((lambda x=x: lj.bodies.Pose.at().moving(**x), "must be three numbers, not ")
      for x in ({"velocity": 3.0}, {"spin": 3.0}, {"spin": (1.0, 2.0)})),
    (lambda: lj.bodies.weight([ROD], (0.0, 0.0, NAN)), "the field g of lj.bodies.weight must be 3 finite numbers"),
    (lambda: lj.bodies.weight([ROD], 9.81), "the field g of lj.bodies.weight must be 3 finite numbers, not 9.81"),
    (lambda: lj.bodies.spring(GROUND, ROD.at(), NAN), "the stiffness of lj.bodies.spring must be a finite number"),
    (lambda: lj.bodies.rolling_sphere(ROD.at(), GROUND, -1.0), "the radius of .* above zero, not -1.0"),
    (lambda: lj.bodies.rolling(ROD.at(), GROUND, NAN), "the radius of lj.bodies.rolling .* above zero, not nan"),
    (lambda: lj.bodies.rolling_ellipsoid(ROD.at(), GROUND, (1.0, 0.0, 1.0)), "a half axis of .*, not 0"),
    (lambda: lj.bodies.multibody(body for body in ()), "lj.bodies.multibody was given no bodies.\nUsual cause: a gen"),
]  # fmt: skip
WRONG_KINDS = [
    (lambda: lj.bodies.revolute(ROD, GROUND), "not a Body.\nFix: lj.bodies.spherical"),
    (lambda: ROD.spin({"rod": lj.bodies.Pose.at()}, NO_POSE),
     "'rod' of q and v must be a lj.bodies.Pose, and is tuple.\nFix: q0 ="),
    (lambda: ROD.point({"rods": lj.bodies.Pose.at()}, (1.0, 0.0, 0.0)),
     "'rod' of q and v .*, and is missing beside 'rods'"),
    (lambda: lj.bodies.weight(ROD),
     r"lj.bodies.weight takes a list of lj.bodies.Body, and was given Body.\nFix: lj.bodies.weight\(\["),
    (lambda: lj.bodies.multibody([ROD, ROD.at()]),
     "lj.bodies.multibody takes a list of lj.bodies.Body, and was given Body, Marker"),
    (lambda: lj.bodies.multibody([ROD], {"hinge": HINGE}, PULL), "one load was given"),
    (lambda: lj.bodies.multibody([ROD], {}, [PULL, of_state]),
     "load 1 of lj.bodies.multibody must be a lj.bodies.Load, not a function"),
    (lambda: lj.bodies.multibody([ROD], {"hinge": PULL}),
     "joint 'hinge' of lj.bodies.multibody must be a constraint, not a Load"),
    (lambda: lj.bodies.multibody([ROD], [HINGE]),
     "joints of lj.bodies.multibody must be a dict by name, not ."),
    (lambda: lj.bodies.multibody([ROD], forces=of_state), "'forces', which is no argument .*'force', 'dissipation'"),
    *((lambda load=load: load(GROUND, ROD, 1.0), "held at two places on bodies: a lj.bodies.Marker, not a Body")
      for load in (lj.bodies.spring, lj.bodies.torsion, lj.bodies.motor)),
    (lambda: lj.bodies.applied(ROD, (1.0, 0.0, 0.0)), "acts at a place on a body: a lj.bodies.Marker, not a Body"),
    # Numbers are functions of params, forces of the state; JAX's own are neither.
    (lambda: a_rod(of_state), r"mass\(params\) of 'rod' is called with 1 argument, but .*f\(t, q, v, params\)"),
    (lambda: ROD.at(of_state), r"a point\(params\) of 'rod' is called with 1 argument"),
    (lambda: lj.bodies.weight([ROD], of_state), r"g\(params\) of lj.bodies.weight"),
    (lambda: lj.bodies.spring(GROUND, ROD.at(), of_params, length=of_state), r"length\(params\) of lj.bodies.spring"),
    (lambda: lj.bodies.torsion(GROUND, ROD.at(), of_params, damping=of_state),
     r"damping\(params\) of lj.bodies.torsion"),
    (lambda: lj.bodies.motor(GROUND, ROD.at(), of_params),
     r"torque\(t, q, v, params\) of lj.bodies.motor is .*\n.*of params alone"),
    (lambda: lj.bodies.applied(ROD.at(), of_params), r"force\(t, q, v, params\) of lj.bodies.applied"),
    (lambda: jax.jit(lambda x: a_rod(x).kinetic({}, {}))(2.0), r"mass=lambda params: params\['mass'\]"),
    (lambda: jax.jit(lambda x: a_rod(inertia=(x, x, x)).kinetic({}, {}))(2.0), "JAX is tracing"),
    (lambda: jax.jit(lambda x: ROD.at((x, 0.0, 0.0)).position({}))(2.0), r"point=lambda params: params\['point'\]"),
]  # fmt: skip
REFUSED = [*((*row, ValueError) for row in WRONG_VALUES), *((*row, TypeError) for row in WRONG_KINDS)]


@pytest.mark.parametrize(("call", "words", "error"), REFUSED)
def test_refused(call, words, error):
    """What no body, joint or load has, or is given as: in the user's words, where it is given."""
    with pytest.raises(error, match=words):
        call()


def test_a_torsion_spring():
    """A turn by 2.5 about a tilted axis with a rate of 3: V = ½ k (θ - α)², the power lost c times the rate squared."""
    axis, point = np.array([1.0, 2.0, -0.5]), (0.2, 0.0, 0.0)
    flap = lj.bodies.Body("flap", 1.0, (1.0, 1.0, 1.0))
    for angle in (2.5, -2.5):
        pose = lj.bodies.Pose.at(axis=axis, angle=angle)
        q, v = {"flap": pose}, {"flap": pose.moving(spin=3.0 * axis / np.linalg.norm(axis))}
        closer = lj.bodies.torsion(
            lj.bodies.ground.at(axis=axis), flap.at(point, axis), 4.0, lambda p: p["rest"], damping=0.5
        )
        assert closer.potential is not None and closer.dissipation is not None
        params = {"rest": 0.3}
        stored, lost = by_numpy(closer.potential), by_numpy(closer.dissipation)
        np.testing.assert_allclose(stored(0.0, q, v, params), 2.0 * (angle - 0.3) ** 2, rtol=1e-14)
        np.testing.assert_allclose(lost(0.0, q, v, params), 0.25 * 9.0, rtol=1e-14)
    assert lj.bodies.torsion(lj.bodies.ground.at(axis=axis), flap.at(point, axis), 4.0).dissipation is None


def arm(count):
    """Bodies on hinges in turn about y and z: bodies, hinges, weight, a position and a velocity of the hinges."""
    links = [lj.bodies.Body(f"link {i}", 1.0 + 0.1 * i, (0.1, 0.11, 0.05)) for i in range(count)]
    axes = [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)] * count
    places = [lj.bodies.ground.at(axis=axes[0])] + [
        link.at((0.0, 0.0, 0.5), axis) for link, axis in zip(links, axes[1:])
    ]
    hinges = {
        f"hinge {i}": lj.bodies.revolute(place, link.at((0.0, 0.0, -0.5), axis))
        for i, (place, link, axis) in enumerate(zip(places, links, axes))
    }
    q = {name: jnp.asarray(0.3 + 0.1 * i) for i, name in enumerate(hinges)}
    v = {name: jnp.asarray(0.2 - 0.1 * i) for i, name in enumerate(hinges)}
    return links, hinges, [lj.bodies.weight(links)], q, v


def test_poses_of_a_tree_are_refused():
    """Those of a tree have a matrix beside them, and are none of `lj.bodies.multibody`."""
    links, hinges, weight, q, v = arm(2)
    tree, system = lj.bodies.Tree(links, hinges), lj.bodies.multibody(links, hinges, weight)
    with pytest.raises(
        TypeError,
        match="'link 0' of q and v of lj.bodies.multibody must be a lj.bodies.Pose, and is that of a lj.bodies.Tree",
    ):
        of_poses = lambda q, v: lj.accelerations(system, 0.0, tree.poses(q), tree.rates(q, v), None)
        jax.eval_shape(of_poses, q, v)


def test_numbers_of_other_kinds():
    """Integers, and axes of any length, are taken; a function of params is checked by nobody here."""
    pose = lj.bodies.Pose.at((0, 0, 1), axis=(0, 0, 10), angle=1)
    np.testing.assert_allclose(pose.quaternion, [np.cos(0.5), 0.0, 0.0, np.sin(0.5)], atol=1e-15)
    spin, energy = by_numpy(lj.bodies.Pose.spin), by_numpy(a_rod(1, (1, 1, 1)).kinetic)
    np.testing.assert_allclose(spin(pose, pose.moving(spin=(0, 0, 2))), [0.0, 0.0, 2.0], atol=1e-15)
    assert energy({"rod": pose}, {"rod": pose.moving((1, 0, 0), (0, 0, 2))}) == 2.5
    for size in (1e-200, 1.0, 1e200):
        np.testing.assert_allclose(ROD.at(axis=(0.0, 3 * size, 4 * size)).frame[2], [0.0, 0.6, 0.8], rtol=1e-15)
    lj.bodies.rolling(ROD.at(), GROUND, lambda params: params["r"])
