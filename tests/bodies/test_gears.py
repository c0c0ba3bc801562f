"""Gears and racks, against Willis' equation and the equations of motion that follow from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.jaxtools.in_numpy import evaluated

SUN, PLANET, RING = 20, 30, 80
RADIUS, AWAY = 0.1, 0.25
AXIS = np.array([1.0, 2.0, -2.0]) / 3.0
IN_PLANE = np.array([2.0, 1.0, 2.0]) / 3.0
BODIES = sun, planet, ring, arm, rack = [
    lj.bodies.Body(name, mass, (1.0, 1.0, moment))
    for name, mass, moment in (("sun", 1.0, 1.3), ("planet", 2.0, 0.9), ("ring", 3.0, 1.8), ("arm", 4.0, 1.1),
                               ("rack", 5.0, 1.0))
]  # fmt: skip


def joints_and_meshes(inner: float = -PLANET / SUN):
    """A planetary gear about a slanting axis, whose sun drives a rack."""
    axle = lj.bodies.ground.at(axis=AXIS)
    joints = {
        "s": lj.bodies.revolute(axle, sun.at()),
        "c": lj.bodies.revolute(axle, arm.at()),
        "r": lj.bodies.revolute(axle, ring.at()),
        "p": lj.bodies.revolute(arm.at((AWAY, 0.0, 0.0)), planet.at()),
        "x": lj.bodies.prismatic(lj.bodies.ground.at(axis=IN_PLANE), rack.at()),
    }
    meshes = {
        "inner": lj.bodies.gear(sun.at(), planet.at(), inner, carrier=arm),
        "outer": lj.bodies.gear(ring.at(), planet.at(), lambda params: params["outer"], carrier=arm),
        "rack": lj.bodies.rack_and_pinion(sun.at(), rack.at(), -RADIUS),
    }
    return joints, meshes


PARAMS = {"outer": np.array(PLANET / RING)}
TORQUES = np.array([2.0, -0.7])
TREE = lj.bodies.Tree(BODIES, joints_and_meshes()[0])
LOADS = [lj.bodies.motor(lj.bodies.ground.at(axis=AXIS), body.at(), x) for body, x in zip((sun, ring), TORQUES)]


def by_willis(of_sun, of_ring):
    """All rates from two of them: (ω_s - ω_c) / (ω_r - ω_c) = -z_r/z_s, and the planet's from that of the sun."""
    of_arm = (SUN * of_sun + RING * of_ring) / (SUN + RING)
    of_planet = of_arm - SUN / PLANET * (of_sun - of_arm)
    return {"s": of_sun, "r": of_ring, "c": of_arm, "p": of_planet - of_arm, "x": -RADIUS * of_sun}


def slips(tree, meshes, q, v, params):
    """By how much each mesh slips."""
    of = lambda q, v: [mesh.phi(0.0, tree.poses(q), tree.rates(q, v), params) for mesh in meshes]
    return np.abs(evaluated(of, q, v))


def test_willis_equation():
    """Rates by Willis' equation satisfy gears at any angle, in a turning arm too; with a sign wrong they do not."""
    rng = np.random.default_rng(3)
    v = by_willis(*rng.normal(size=2))
    q = {name: float(x) for name, x in zip(v, rng.normal(size=5))}
    *right, wrong = slips(TREE, [*joints_and_meshes()[1].values(), joints_and_meshes(PLANET / SUN)[1]["inner"]],
                          q, v, PARAMS)  # fmt: skip
    assert np.max(right) < 1e-14 and wrong > 0.1
    # A rack that slides along a turning arm, moved by a pinion on it; its place is not where the teeth meet.
    slides = lj.bodies.Tree(
        [arm, planet, rack],
        {"c": lj.bodies.revolute(lj.bodies.ground.at(axis=AXIS), arm.at()),
         "p": lj.bodies.revolute(arm.at((AWAY, 0.0, 0.0)), planet.at()),
         "x": lj.bodies.prismatic(arm.at((AWAY, 0.5, 0.0), axis=(1.0, 0.0, 0.0)), rack.at(axis=(1.0, 0.0, 0.0)))},
    )  # fmt: skip
    v = {"c": 1.3, "p": 0.7, "x": -0.3 * 0.7}
    q = {name: q[name] for name in v}
    teeth = planet.at(), rack.at(axis=(1.0, 0.0, 0.0)), -0.3
    meshes = [lj.bodies.rack_and_pinion(*teeth, carrier=arm), lj.bodies.rack_and_pinion(*teeth)]
    right, wrong = slips(slides, meshes, q, v, None)
    assert right < 1e-14 and wrong > 0.1


def expected():
    """The accelerations of sun and ring, and the torques of the gears and the force of the rack, by Lagrange."""
    # Rates of arm and planet per rate of sun and ring.
    of_arm = np.array([SUN, RING]) / (SUN + RING)
    of_planet = of_arm - SUN / PLANET * (np.array([1.0, 0.0]) - of_arm)
    mass = np.diag([1.3 + 5.0 * RADIUS**2, 1.8])
    mass += (1.1 + 2.0 * AWAY**2) * np.outer(of_arm, of_arm) + 0.9 * np.outer(of_planet, of_planet)
    of_sun, of_ring = np.linalg.solve(mass, TORQUES)
    force = 5.0 * -RADIUS * of_sun
    return (of_sun, of_ring), (1.3 * of_sun - TORQUES[0] - RADIUS * force, 1.8 * of_ring - TORQUES[1], force)


@pytest.mark.exhaustive
def test_a_planetary_gear():
    """A sun and a ring under torques: accelerations and what teeth carry, in joints' and in maximal coordinates."""
    joints, meshes = joints_and_meshes()
    v = {name: jnp.asarray(x) for name, x in by_willis(3.0, 0.5).items()}
    q = {name: jnp.asarray(0.1 * i) for i, name in enumerate(v)}
    a, multipliers = lj.accelerations(TREE.system(LOADS, meshes), 0.0, q, v, PARAMS)
    for name, x in by_willis(*expected()[0]).items():
        np.testing.assert_allclose(a[name], x, rtol=1e-12, err_msg=name)
    np.testing.assert_allclose([multipliers[name] for name in meshes], expected()[1], rtol=1e-12)
    q, v = ({name: lj.bodies.Pose(*x[name][:2]) for name in x} for x in (TREE.poses(q), TREE.rates(q, v)))
    _, multipliers = lj.accelerations(lj.bodies.multibody(BODIES, joints | meshes, LOADS), 0.0, q, v, PARAMS)
    np.testing.assert_allclose([multipliers[name] for name in meshes], expected()[1], rtol=1e-10)


def test_refused_gears():
    """What is no gear is said with its body or number, and how it is written."""
    a, b = sun.at(), planet.at()
    for given, error, words in (
        ((a, b, np.nan), ValueError, "finite number that is not 0, not nan.\nUsual cause: a division by zero"),
        ((a, b, 0), ValueError, "the ratio of lj.bodies.gear must be a finite number that is not 0"),
        ((a, b, (1.0, 2.0)), ValueError, "the ratio of lj.bodies.gear must be a finite number"),
        ((a, sun.at((1.0, 0.0, 0.0)), 2.0), ValueError, "both places are on 'sun'"),
        ((a, planet, 2.0), TypeError, "not a Body"),
        ((a, b, 2.0, arm.at()), TypeError, "the carrier of lj.bodies.gear must be a body, not a Marker"),
        ((a, b, 2.0, sun), ValueError, "the carrier of lj.bodies.gear, 'sun', is one of the two bodies"),
        ((a, b, lambda t, q, v, params: 2.0), TypeError, "ratio"),
    ):
        with pytest.raises(error, match=words):
            lj.bodies.gear(*given)
    with pytest.raises(ValueError, match="the radius of lj.bodies.rack_and_pinion must be a finite number"):
        lj.bodies.rack_and_pinion(a, b, 0.0)
    assert jax.jit(lambda ratio: lj.bodies.gear(a, b, ratio).phi(0.0, *still(), None))(0.0) == 0.0


def still():
    """Sun and planet at rest."""
    at = {name: lj.bodies.Pose.at() for name in ("sun", "planet")}
    return at, {name: pose.moving() for name, pose in at.items()}
