"""Rigid bodies and joints, against closed forms of textbooks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies.rotation import about, conjugate, product, rotation_matrix, spin_in_space

G = 9.81


def angular_acceleration(body, q, a):
    """Ω' in space: of ė e* + ... only 2 vec(ë e*) has a vector part."""
    return spin_in_space(body.pose(q).quaternion, body.rates(a).quaternion)


def test_rotations():
    """R is a rotation about its axis by its angle; a product turns as both; Ω is the axis times the rate."""
    e, f = about((0.0, 0.0, 2.0), 0.5), about((1.0, 2.0, -1.0), 1.2)
    expected = [[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(rotation_matrix(e), expected, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix(product(e, f)), rotation_matrix(e) @ rotation_matrix(f), atol=1e-15)
    assert np.abs(rotation_matrix(product(f, e)) - rotation_matrix(e) @ rotation_matrix(f)).max() > 0.1
    np.testing.assert_allclose(rotation_matrix(conjugate(f)), rotation_matrix(f).T, atol=1e-15)
    rate = jax.jvp(lambda angle: about((1.0, 2.0, -1.0), angle), (jnp.asarray(1.2),), (jnp.asarray(3.0),))[1]
    np.testing.assert_allclose(spin_in_space(f, rate), 3.0 * np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0), atol=1e-15)


def test_poses_and_points():
    """A turning body: velocity v + Ω × r of its points, Euler's T, one spin along both kinds of axes."""
    body = lj.Body("b", 2.0, (1.0, 2.0, 2.5))
    pose = lj.Pose.at((1.0, 0.0, 0.0), (0.0, 1.0, 1.0), 0.7).turned((1.0, 0.0, 0.0), 0.4)
    velocity, spin, r = np.array([0.1, 0.2, 0.3]), np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    q, v = {"b": pose}, {"b": pose.moving(velocity, spin)}
    np.testing.assert_allclose(body.spin(q, v), spin, atol=1e-15)
    rotation = np.asarray(rotation_matrix(pose.quaternion))
    np.testing.assert_allclose(body.spin_in_body(q, v), rotation.T @ spin, atol=1e-15)
    np.testing.assert_allclose(body.velocity(q, v, r), velocity + np.cross(spin, rotation @ r), atol=1e-15)
    moved = jax.jvp(lambda q: body.point(q, r), (q,), (v,))[1]
    np.testing.assert_allclose(moved, velocity + np.cross(spin, rotation @ r), atol=1e-15)
    inertia = rotation @ np.diag([1.0, 2.0, 2.5]) @ rotation.T
    np.testing.assert_allclose(body.kinetic(q, v), velocity @ velocity + spin @ inertia @ spin / 2, rtol=1e-14)
    np.testing.assert_allclose(body.angular_momentum(q, v), inertia @ spin, rtol=1e-14)
    of_params = lj.Body("b", lambda p: p["m"], lambda p: jnp.diag(p["I"]))
    params = {"m": 2.0, "I": jnp.array([1.0, 2.0, 2.5])}
    np.testing.assert_allclose(of_params.kinetic(q, v, params), body.kinetic(q, v), rtol=1e-14)


def hinged(joint):
    """A bar, its hinge at (0, 0, 1) of its axes, turned by 0.6 about y with a rate of 2, under its weight."""
    bar = lj.Body("bar", 3.0, (0.5, 0.6, 0.2))
    at, on = lj.ground.at((0.1, 0.2, 0.3), axis=(0.0, 1.0, 0.0)), bar.at((0.0, 0.0, 1.0), axis=(0.0, 1.0, 0.0))
    system = lj.multibody([bar], {"hinge": joint(at, on)}, [lj.weight([bar])])
    pose = lj.Pose.at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.6)
    arm = -bar.direction({"bar": pose}, (0.0, 0.0, 1.0))
    pose = pose._replace(position=jnp.array([0.1, 0.2, 0.3]) + arm)
    spin = jnp.array([0.0, 2.0, 0.0])
    return bar, system, {"bar": pose}, {"bar": pose.moving(jnp.cross(spin, arm), spin)}


@pytest.mark.slow
def test_a_hinge():
    """A bar on a hinge is a physical pendulum: θ'' = -m g l sin θ/(I + m l²); the hinge carries what is left."""
    bar, system, q, v = hinged(lj.revolute)
    a, _ = lj.accelerations(system, 0.0, q, v, None)
    expected = -3.0 * G * np.sin(0.6) / (0.6 + 3.0)
    np.testing.assert_allclose(angular_acceleration(bar, q, a), [0.0, expected, 0.0], atol=1e-12)
    # The force of the hinge on the bar, by Newton's law for its centre of mass.
    force = lj.constraint_force(system, 0.0, q, v, None)["hinge"]["bar"].position
    np.testing.assert_allclose(force, 3.0 * (a["bar"].position + jnp.array([0.0, 0.0, G])), atol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("joint", [lj.spherical, lj.cylindrical])
def test_joints_of_a_plane_motion(joint):
    """A ball joint and a sleeve leave more freedoms, which a motion in the plane does not use."""
    bar, system, q, v = hinged(joint)
    a, _ = lj.accelerations(system, 0.0, q, v, None)
    np.testing.assert_allclose(angular_acceleration(bar, q, a)[1], -3.0 * G * np.sin(0.6) / 3.6, atol=1e-12)


@pytest.mark.slow
def test_a_slide_with_a_spring_a_damper_and_a_motor():
    """A slider on a spring: m x'' = F - k (x - l) - c x'; the same body on a hinge turns by torque over inertia."""
    slider = lj.Body("slider", 2.0, (1.0, 1.0, 1.0))
    along = (1.0, 0.0, 0.0)
    rail = lj.prismatic(lj.ground.at(axis=along), slider.at(axis=along))
    spring = lj.spring(lj.ground.at((-1.0, 0.0, 0.0)), slider.at(), stiffness=lambda p: p["k"], length=0.7, damping=0.4)
    push = lj.applied(slider.at((0.0, 0.0, 0.1)), (3.0, 5.0, 0.0))
    system = lj.multibody([slider], {"rail": rail}, [spring, push])
    pose = lj.Pose.at((0.5, 0.0, 0.0))
    a, _ = lj.accelerations(system, 0.0, {"slider": pose}, {"slider": pose.moving((0.2, 0.0, 0.0))}, {"k": 7.0})
    np.testing.assert_allclose(a["slider"].position, [(3.0 - 7.0 * 0.8 - 0.4 * 0.2) / 2.0, 0.0, 0.0], atol=1e-12)
    assert np.abs(a["slider"].quaternion).max() < 1e-12
    wheel = lj.Body("slider", 2.0, (1.0, 1.0, 1.5))
    torque = lj.motor(lj.ground.at(), wheel.at(), lambda t, q, v, p: 3.0 - wheel.spin(q, v)[2])
    turning = lj.multibody([wheel], {"axle": lj.revolute(lj.ground.at(), wheel.at())}, [torque])
    pose = lj.Pose.at(angle=0.3)
    q, v = {"slider": pose}, {"slider": pose.moving(spin=(0.0, 0.0, 0.5))}
    a, _ = lj.accelerations(turning, 0.0, q, v, None)
    np.testing.assert_allclose(angular_acceleration(wheel, q, a), [0.0, 0.0, 2.5 / 1.5], atol=1e-12)


@pytest.mark.slow
def test_rolling_down():
    """Down a plane at an angle α a ball accelerates by 5/7, a disk by 2/3 of g sin α, and slipping by all of it."""
    tilt, radius = 0.3, 0.4
    normal, down = np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    floor = lj.ground.at((0.0, 0.0, 0.0), axis=normal)
    for roll, inertia, share in (
        (lj.rolling_sphere, 0.4 * radius**2 * np.ones(3), 5 / 7),
        (lj.rolling, np.array([0.25, 0.5, 0.25]) * radius**2, 2 / 3),
    ):
        wheel = lj.Body("wheel", 1.0, tuple(inertia))
        contact = roll(wheel.at(axis=(0.0, 1.0, 0.0)), floor, radius)
        system = lj.multibody([wheel], {"wheel": contact}, [lj.weight([wheel])])
        assert set(system.constraints) == {"wheel is turned", "wheel touches", "wheel rolls"}
        pose = lj.Pose.at(radius * normal, (0.0, 1.0, 0.0), 1.1)
        q, v = {"wheel": pose}, {"wheel": pose.moving(2.0 * down, (0.0, 2.0 / radius, 0.0))}
        for residual in lj.constraint_residual(system, 0.0, q, v, None).values():
            np.testing.assert_allclose(residual, 0.0, atol=1e-13)
        a, _ = lj.accelerations(system, 0.0, q, v, None)
        np.testing.assert_allclose(a["wheel"].position, share * G * np.sin(tilt) * down, atol=1e-12)
        slipping = lj.multibody([wheel], {"wheel": contact["touches"]}, [lj.weight([wheel])])
        a, _ = lj.accelerations(slipping, 0.0, q, v, None)
        np.testing.assert_allclose(a["wheel"].position, G * np.sin(tilt) * down, atol=1e-12)


@pytest.mark.slow
def test_a_cardan_joint_and_a_weld():
    """The cross of a Cardan joint ties two shafts, tan θ2 = cos β tan θ1; a weld has no freedom left."""
    bend = 0.5
    tilted = (np.sin(bend), 0.0, np.cos(bend))
    first, second = lj.Body("first", 1.0, (1.0, 1.0, 1.0)), lj.Body("second", 1.0, (1.0, 1.0, 1.0))
    joint = lj.universal(first.at(axis=(0.0, 1.0, 0.0)), second.at(axis=(1.0, 0.0, 0.0)))

    def cross(angle_1, angle_2):
        start = lj.Pose.at(axis=(0.0, 1.0, 0.0), angle=bend)
        q = {"first": lj.Pose.at(angle=angle_1), "second": start.turned(tilted, angle_2)}
        return joint.g(0.0, q, None)

    angle = 0.8
    np.testing.assert_allclose(cross(angle, np.arctan(np.tan(angle) * np.cos(bend))), 0.0, atol=1e-15)
    assert abs(cross(angle, angle)[3]) > 0.01
    weld = lj.fixed(first.at((1.0, 0.0, 0.0)), second.at((-1.0, 0.0, 0.0)))
    system = lj.multibody([first, second], {"weld": weld})
    left, right = lj.Pose.at((-1.0, 0.0, 0.0)), lj.Pose.at((1.0, 0.0, 0.0))
    q = {"first": left, "second": right}
    spin = (0.0, 0.0, 2.0)
    v = {"first": left.moving((0.0, -2.0, 0.0), spin), "second": right.moving((0.0, 2.0, 0.0), spin)}
    force = lj.constraint_force(system, 0.0, q, v, None)["weld"]["first"]
    # Each half is held on its circle of radius 1.
    np.testing.assert_allclose(force.position, [4.0, 0.0, 0.0], atol=1e-12)


def test_single_precision():
    """In float32 all that bodies, joints and loads give is float32, though markers hold Python's numbers."""
    rod = lj.Body("rod", 1, (1, 1, 2))
    a, b = lj.ground.at((0.1, 0.0, 0.0), (1.0, 1.0, 0.0)), rod.at(lambda params: (0.0, params, 0.0))
    loads = lj.weight([rod]), lj.spring(a, b, 2), lj.torsion(a, b, 2)
    damper, drive = lj.spring(a, b, 2, damping=1).dissipation, lj.motor(a, b, 2).power
    assert damper is not None and drive is not None

    def given(place, turn, half):
        pose = lj.Pose(place, turn).turned((1.0, 0.0, 0.0), 0.5)
        q, v = {"rod": pose}, {"rod": pose.moving((1.0, 0.0, 0.0), (0.0, 2.0, 0.0))}
        found = [rod.kinetic(q, v), lj.fixed(a, b).g(0.0, q, half), lj.prismatic(a, b).g(0.0, q, half)]
        found += [load.potential(0.0, q, v, half) for load in loads if load.potential is not None]
        found += [damper(0.0, q, v, half), drive(0.0, q, v, v, half), q, v, rod.angular_momentum(q, v)]
        return jax.tree.map(jnp.asarray, found)

    shapes = jax.eval_shape(given, *(np.ones(shape, np.float32) for shape in (3, 4, ())))
    assert {x.dtype for x in jax.tree.leaves(shapes)} == {np.dtype("float32")}


def test_bad_bodies_and_joints():
    """What no body has, and joints that join nothing, are refused by name."""
    with pytest.raises(ValueError, match="no body has the moments of inertia of 'rod', 1, 1, 3: each is at most"):
        lj.Body("rod", 1.0, (3.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="three principal moments or a symmetric matrix"):
        lj.Body("rod", 1.0, ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match="mass of 'rod' must be a positive number"):
        lj.Body("rod", 0.0, (1.0, 1.0, 1.0))
    rod = lj.Body("rod", 1.0, (1.0, 1.0, 2.0))
    with pytest.raises(ValueError, match="both places are on 'rod'"):
        lj.spherical(rod.at((1.0, 0.0, 0.0)), rod.at((-1.0, 0.0, 0.0)))
    with pytest.raises(TypeError, match="Body is none.\nFix: lj.spherical"):
        lj.revolute(rod, lj.ground.at())
    with pytest.raises(ValueError, match="axis of a marker on 'rod'"):
        rod.at(axis=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="a point of 'rod' must be three numbers"):
        rod.at((1.0, 0.0))
    with pytest.raises(
        TypeError, match="entry 'rod' of q and v must be a lj.Pose, and is tuple.\nFix: q0 = {'rod': pose}"
    ):
        rod.spin({"rod": lj.Pose.at()}, {"rod": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))})
    with pytest.raises(TypeError, match="entry 'rod' of q and v must be a lj.Pose, and is missing beside 'rods'"):
        rod.point({"rods": lj.Pose.at()}, (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="two bodies or constraints are called 'rod'"):
        lj.multibody([rod, lj.Body("rod", 2.0, (1.0, 1.0, 1.0))])


def test_bad_systems_of_bodies():
    """Lists that are none, loads among joints, functions by themselves and unknown keywords, in the user's words."""
    rod = lj.Body("rod", 1.0, (1.0, 1.0, 2.0))
    hinge, pull = lj.revolute(lj.ground.at(), rod.at()), lj.weight([rod])
    with pytest.raises(TypeError, match=r"lj.weight takes a list of lj.Body, and was given Body.\nFix: lj.weight\(\["):
        lj.weight(rod)
    with pytest.raises(TypeError, match="lj.multibody takes a list of lj.Body, and was given Body, Marker"):
        lj.multibody([rod, rod.at()])
    with pytest.raises(TypeError, match="one load was given"):
        lj.multibody([rod], {"hinge": hinge}, pull)
    with pytest.raises(TypeError, match="load 1 of lj.multibody is no lj.Load, but function"):
        lj.multibody([rod], {"hinge": hinge}, [pull, lambda t, q, v, params: 0.0])
    with pytest.raises(TypeError, match="joint 'hinge' of lj.multibody is no constraint, but Load"):
        lj.multibody([rod], {"hinge": pull})
    with pytest.raises(TypeError, match="joints of lj.multibody are a dict by name, and list was given"):
        lj.multibody([rod], [hinge])
    with pytest.raises(TypeError, match="lj.multibody has no argument 'forces'.\nFix: .*force, dissipation"):
        lj.multibody([rod], {"hinge": hinge}, forces=lambda t, q, v, params: q)
    for load in (lj.spring, lj.torsion, lj.motor):
        with pytest.raises(TypeError, match="held at two places on bodies, and Body is none"):
            load(lj.ground.at(), rod, 1.0)
    with pytest.raises(TypeError, match="a force acts at a place on a body, and Body is none"):
        lj.applied(rod, (1.0, 0.0, 0.0))


def test_functions_of_other_arguments():
    """Numbers are functions of params, forces of the state: the other one is refused where it is given."""
    rod = lj.Body("rod", 1.0, lambda params: params["I"])
    of_state, of_params = lambda t, q, v, params: 1.0, lambda params: params["torque"]
    with pytest.raises(
        TypeError, match=r"mass\(params\) of 'beam' is called with 1 argument, but .*f\(t, q, v, params\)"
    ):
        lj.Body("beam", of_state, (1.0, 1.0, 2.0))
    with pytest.raises(TypeError, match=r"a point\(params\) of 'rod' is called with 1 argument"):
        rod.at(of_state)
    with pytest.raises(TypeError, match=r"g\(params\) of lj.weight"):
        lj.weight([rod], of_state)
    for load, role in ((lj.spring, "length"), (lj.torsion, "damping")):
        with pytest.raises(TypeError, match=rf"{role}\(params\) of lj.{load.__name__}"):
            load(lj.ground.at(), rod.at(), of_params, **{role: of_state})
    with pytest.raises(TypeError, match=r"torque\(t, q, v, params\) of lj.motor is .*\n.*a function of params alone"):
        lj.motor(lj.ground.at(), rod.at(), of_params)
    with pytest.raises(TypeError, match=r"force\(t, q, v, params\) of lj.applied"):
        lj.applied(rod.at(), of_params)


def test_a_torsion_spring():
    """A turn by 2.5 about a tilted axis with a rate of 3: V = ½ k (θ - α)², the power lost c times the rate squared."""
    axis, point = np.array([1.0, 2.0, -0.5]), (0.2, 0.0, 0.0)
    flap = lj.Body("flap", 1.0, (1.0, 1.0, 1.0))
    for angle in (2.5, -2.5):
        pose = lj.Pose.at(axis=axis, angle=angle)
        q, v = {"flap": pose}, {"flap": pose.moving(spin=3.0 * axis / np.linalg.norm(axis))}
        closer = lj.torsion(lj.ground.at(axis=axis), flap.at(point, axis), 4.0, lambda p: p["rest"], damping=0.5)
        assert closer.potential is not None and closer.dissipation is not None
        params = {"rest": 0.3}
        np.testing.assert_allclose(closer.potential(0.0, q, v, params), 2.0 * (angle - 0.3) ** 2, rtol=1e-14)
        np.testing.assert_allclose(closer.dissipation(0.0, q, v, params), 0.25 * 9.0, rtol=1e-14)
    assert lj.torsion(lj.ground.at(axis=axis), flap.at(point, axis), 4.0).dissipation is None


def arm(count):
    """Bodies on hinges in turn about y and z: bodies, hinges, weight, a position and a velocity of the hinges."""
    links = [lj.Body(f"link {i}", 1.0 + 0.1 * i, (0.1, 0.11, 0.05)) for i in range(count)]
    axes = [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)] * count
    places = [lj.ground.at(axis=axes[0])] + [link.at((0.0, 0.0, 0.5), axis) for link, axis in zip(links, axes[1:])]
    hinges = {
        f"hinge {i}": lj.revolute(place, link.at((0.0, 0.0, -0.5), axis))
        for i, (place, link, axis) in enumerate(zip(places, links, axes))
    }
    q = {name: jnp.asarray(0.3 + 0.1 * i) for i, name in enumerate(hinges)}
    v = {name: jnp.asarray(0.2 - 0.1 * i) for i, name in enumerate(hinges)}
    return links, hinges, [lj.weight(links)], q, v


def on_bodies(tree, q, v):
    """The poses of the bodies of a tree and their rates, q and v of `lj.multibody`."""
    return [{name: lj.Pose(*x[:2]) for name, x in both.items()} for both in (tree.poses(q), tree.rates(q, v))]


@pytest.mark.exhaustive
def test_an_arm_in_space():
    """Seven jointed bodies in maximal coordinates, 49 numbers and 42 equations: accelerations and motion of their tree.

    Twin: without the velocities' terms.
    """
    links, hinges, weight, q, v = arm(7)
    tree, system = lj.Tree(links, hinges), lj.multibody(links, hinges, weight)
    in_angles, _ = lj.accelerations(tree.system(weight), 0.0, q, v, None)
    expected = jax.jvp(lambda q, v: on_bodies(tree, q, v)[1], (q, v), (v, in_angles))[1]
    without = jax.jvp(lambda q, v: on_bodies(tree, q, v)[1], (q, v), (jax.tree.map(jnp.zeros_like, v), in_angles))[1]
    a, multipliers = lj.accelerations(system, 0.0, *on_bodies(tree, q, v), None)
    assert all(multipliers[name].shape == (5,) for name in hinges)
    for link in links:
        np.testing.assert_allclose(a[link.name].position, expected[link.name].position, atol=1e-11)
        np.testing.assert_allclose(a[link.name].quaternion, expected[link.name].quaternion, atol=1e-11)
    assert np.abs(a[links[6].name].position - without[links[6].name].position).max() > 0.01
    ts, tolerances = np.linspace(0.0, 0.5, 3), {"rtol": 1e-12, "atol": 1e-12}
    of_angles = lj.integrate(tree.system(weight), q, v, None, ts=ts, **tolerances)
    traj = lj.integrate(system, *on_bodies(tree, q, v), None, ts=ts, **tolerances)
    places = jax.vmap(tree.poses)(of_angles.q)
    for link in links:
        np.testing.assert_allclose(traj.q[link.name].position, places[link.name].position, atol=1e-10)


def test_poses_of_a_tree_are_refused():
    """Those of a tree have a matrix beside them, and are none of `lj.multibody`."""
    links, hinges, weight, q, v = arm(2)
    tree, system = lj.Tree(links, hinges), lj.multibody(links, hinges, weight)
    with pytest.raises(
        TypeError, match="'link 0' of q and v of lj.multibody must be a lj.Pose, and is that of a lj.Tree"
    ):
        of_poses = lambda q, v: lj.accelerations(system, 0.0, tree.poses(q), tree.rates(q, v), None)
        jax.eval_shape(of_poses, q, v)


@pytest.mark.exhaustive
def test_a_loop_that_cannot_close():
    """A rod of length 1 between places 1.5 apart misses them by 0.5, in lengths: it is not stretched."""
    rod = lj.Body("rod", 2.0, (0.2, 0.2, 0.01))
    left = lj.spherical(lj.ground.at((0.0, 0.0, 0.0)), rod.at((0.0, 0.0, -0.5)))
    right = lj.spherical(lj.ground.at((1.5, 0.0, 0.0)), rod.at((0.0, 0.0, 0.5)))
    system = lj.multibody([rod], {"left": left, "right": right})
    pose = lj.Pose.at((0.7, 0.0, 0.1), (0.0, 1.0, 0.0), 1.4)
    with pytest.raises(ValueError, match="no consistent state was found") as found:
        lj.consistent_state(system, 0.0, {"rod": pose}, {"rod": pose.moving()}, None)
    said = str(found.value).split("reached, constraint ")[1].split("\n")[0]
    missed = [(part.split("'")[1], float(part.split("=")[1].rstrip(". "))) for part in said.split(", ")]
    by = {side: np.sqrt(sum(x**2 for name, x in missed if name.startswith(side))) for side in ("left", "right")}
    np.testing.assert_allclose(by["left"] + by["right"], 0.5, rtol=5e-3)
    assert all(abs(x) < 1e-5 for name, x in missed if name == "rod is turned")


def test_numbers_that_no_body_has():
    """Numbers of another kind or shape are refused in words where they were passed on, as NaN or to JAX. Twin: ints and
    other lengths of the axis are taken."""
    made = lambda mass=1.0, inertia=(1.0, 1.0, 1.0): lj.Body("b", mass, inertia)
    for inertia in ((1.0, np.nan, 1.0), (np.inf,) * 3, 1.0, (1.0, 2.0)):
        with pytest.raises(ValueError, match="three principal moments"):
            made(inertia=inertia)
    for mass in (np.inf, "1", np.ones(1)):
        with pytest.raises(ValueError, match="mass of 'b' must be a positive number"):
            made(mass)
    with pytest.raises(TypeError, match=r"mass=lambda params: params\['mass'\]"):
        jax.jit(lambda x: made(x).kinetic({}, {}))(2.0)
    with pytest.raises(TypeError, match="JAX is tracing"):
        jax.jit(lambda x: made(inertia=(x, x, x)).kinetic({}, {}))(2.0)
    with pytest.raises(TypeError, match=r"point=lambda params: params\['point'\]"):
        jax.jit(lambda x: made().at((x, 0.0, 0.0)).position({}))(2.0)
    with pytest.raises(ValueError, match="a point of 'b'"):
        made().at((0.0, 0.0, np.nan))
    with pytest.raises(ValueError, match="position of a pose must be three numbers"):
        lj.Pose.at((1.0, 2.0))
    with pytest.raises(ValueError, match="axis of a pose must be finite and not zero"):
        lj.Pose.at(axis=(0.0, 0.0, 0.0), angle=1.0)
    pose = lj.Pose.at((0, 0, 1), axis=(0, 0, 10), angle=1)
    for rates in ({"velocity": 3.0}, {"spin": 3.0}, {"spin": (1.0, 2.0)}):
        with pytest.raises(ValueError, match="must be three numbers, and has shape"):
            pose.moving(**rates)
    np.testing.assert_allclose(pose.quaternion, [np.cos(0.5), 0.0, 0.0, np.sin(0.5)], atol=1e-15)
    np.testing.assert_allclose(pose.spin(pose.moving(spin=(0, 0, 2))), [0.0, 0.0, 2.0], atol=1e-15)
    assert made(1, (1, 1, 1)).kinetic({"b": pose}, {"b": pose.moving((1, 0, 0), (0, 0, 2))}) == 2.5


NAN, ROUND = float("nan"), lj.Body("round", 1.0, (1.0, 1.0, 1.0))
NO_NUMBERS = {
    "field": (lambda: lj.weight([ROUND], (0.0, 0.0, NAN)), "the field g of lj.weight must be 3 finite numbers"),
    "one number": (lambda: lj.weight([ROUND], 9.81), "the field g of lj.weight must be 3 finite numbers, and is 9.81"),
    "spring": (
        lambda: lj.spring(lj.ground.at(), ROUND.at(), NAN),
        "the stiffness of lj.spring must be a finite number",
    ),
    "radius": (lambda: lj.rolling_sphere(ROUND.at(), lj.ground.at(), -1.0), "the radius of .* above zero, and is -1.0"),
    "rim": (lambda: lj.rolling(ROUND.at(), lj.ground.at(), NAN), "the radius of lj.rolling .* above zero, and is nan"),
    "half axis": (
        lambda: lj.rolling_ellipsoid(ROUND.at(), lj.ground.at(), (1.0, 0.0, 1.0)),
        "a half axis of .*, and is 0",
    ),
    "axis": (lambda: ROUND.at(axis=(np.inf, 0.0, 0.0)), "the axis of a marker on 'round' must be three numbers"),
    "pose": (lambda: lj.Pose.at(axis=(NAN, 0.0, 0.0)), "the axis of a pose must be finite and not zero"),
}


@pytest.mark.parametrize("name", NO_NUMBERS)
def test_numbers_that_are_none(name):
    """NaN, infinite, of the wrong sign or shape: refused by name where they are given."""
    make, words = NO_NUMBERS[name]
    with pytest.raises(ValueError, match=words):
        make()


def test_axes_of_any_length():
    """A direction may have the largest and the least numbers; a function of params is checked by nobody here."""
    for size in (1e-200, 1.0, 1e200):
        np.testing.assert_allclose(ROUND.at(axis=(0.0, 3 * size, 4 * size)).frame[2], [0.0, 0.6, 0.8], rtol=1e-15)
    lj.rolling(ROUND.at(), lj.ground.at(), lambda params: params["r"])
