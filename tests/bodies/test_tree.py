"""Trees in joint coordinates: the recursion against the equations of L and closed forms; refused trees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies.links import slots_of
from lagjax.jaxtools import equations
from lagjax.system.traced import TracedProgram
from tests.by_numpy import by_numpy
from tests.jaxtools.in_numpy import in_numpy

Y = (0.0, 1.0, 0.0)


def a_body(rng, name, mass=None):
    """A body with a mass and an inertia as any body might have."""
    moments = rng.uniform(0.1, 1.0, 3)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    inertia = axes @ np.diag(moments.sum() - moments) @ axes.T
    return lj.bodies.Body(name, rng.uniform(0.5, 2.0) if mass is None else mass, (inertia + inertia.T) / 2)


def a_place(rng, body):
    """A place on a body, with an axis."""
    return body.at(rng.normal(size=3), rng.normal(size=3))


def like(rng, q):
    """Random numbers in the structure of q."""
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=np.shape(x))), q)


def every_joint():
    """A tree with all kinds of joints, forks, a free body, functions of params, and all kinds of loads."""
    rng = np.random.default_rng(1)
    b = [a_body(rng, f"b{i}", mass=(lambda params: params["m"]) if i in (2, 5) else None) for i in range(10)]
    frames = [lj.bodies.Body(name, 0.0, (0.0, 0.0, 0.0)) for name in ("mount", "sight")]
    pairs = [
        (lj.bodies.ground, b[0]),
        (b[0], b[1]),
        (b[0], b[2]),
        (b[1], b[3]),
        (b[1], b[4]),
        (b[4], b[5]),
        (b[2], b[6]),
    ]
    pairs += [(b[3], b[8]), (b[8], frames[0]), (frames[0], b[9]), (b[9], frames[1])]
    places = [(a_place(rng, x), a_place(rng, y)) for x, y in pairs]
    joints = {
        "hinge": lj.bodies.revolute(*places[0]),
        "slide": lj.bodies.prismatic(*places[1]),
        "pair": [lj.bodies.revolute(*places[2]), lj.bodies.revolute(*places[3])],
        "ball": lj.bodies.spherical(*places[4]),
        "ring": lj.bodies.cylindrical(*places[5]),
        "weld": lj.bodies.fixed(*places[6]),
        "cross": lj.bodies.universal(*places[7]),
        "plate": lj.bodies.planar(*places[8]),
        "socket": lj.bodies.spherical(*places[9]),
        "end": lj.bodies.fixed(*places[10]),
    }
    rotors = {"hinge": 0.4, "pair": (0.2, 0.0), "ball": 0.3, "plate": lambda params: params["m"] * jnp.arange(3.0)}
    tree = lj.bodies.Tree([*b, *frames], joints, rotors)
    loads = [
        lj.bodies.weight(b[:5], g=lambda params: jnp.array([0.0, 1.0, -params["g"]])),
        lj.bodies.spring(a_place(rng, b[3]), a_place(rng, b[5]), 2.0, 0.5, damping=0.7),
        lj.bodies.motor(a_place(rng, b[0]), a_place(rng, b[2]), lambda t, q, v, params: 1.3 - v["hinge"]),
        lj.bodies.applied(a_place(rng, b[7]), (1.0, 2.0, 3.0)),
        lj.bodies.spring(a_place(rng, lj.bodies.ground), a_place(rng, b[4]), 1.5, 0.2, damping=0.4),
    ]
    system = tree.system(loads, potential=lambda t, q, params: 2.0 * q["slide"] ** 2 + q["pair"][0] * q["ring"][1])
    return rng, tree, system, {"m": jnp.asarray(1.3), "g": jnp.asarray(9.81)}


def test_shapes_of_coordinates():
    """A joint is a number or a quaternion under its name, a list an array, a cylindrical one two numbers."""
    _, tree, _, _ = every_joint()
    shapes = {name: jax.tree.map(jnp.shape, x) for name, x in tree.reference().items()}
    assert shapes == {
        "hinge": (), "slide": (), "pair": (2,), "ball": (4,), "ring": (2,), "cross": (2,), "plate": (3,),
        "socket": (4,), "b7": lj.bodies.Pose((3,), (4,)),
    }  # fmt: skip
    assert repr(tree) == "Tree(12 bodies; hinge, slide, pair, ball, ring, cross, plate, socket, b7)"


@pytest.mark.exhaustive
def test_poses_and_rates():
    """Poses satisfy the joints as constraints, their rates are derivatives; an angle to the wrong side does not."""
    rng, tree, _, params = every_joint()
    q = like(rng, tree.reference())
    v = like(rng, q)
    poses, moved = jax.jvp(lambda q: tree.poses(q, params), (q,), (v,))
    rates = tree.rates(q, v, params)
    for body in tree.bodies:
        for x, y in zip(rates[body.name], moved[body.name]):
            np.testing.assert_allclose(x, y, atol=1e-13)
    for name in ("cross", "plate", "socket", "end", "ring"):
        joint = tree.joints[name]
        assert isinstance(joint, lj.Holonomic)
        residual = joint.g(0.0, poses, params)
        np.testing.assert_allclose(residual, 0.0, atol=1e-13, err_msg=name)
    a, b = tree.bodies[0].at((0.1, 0.2, 0.3), Y), tree.bodies[1].at((0.0, 0.0, 1.0), Y)
    two = lj.bodies.Tree(
        tree.bodies[:2], {"a": lj.bodies.prismatic(lj.bodies.ground.at(axis=Y), a), "b": lj.bodies.revolute(a, b)}
    )
    poses = two.poses({"a": 0.4, "b": 0.7})
    np.testing.assert_allclose(poses["b0"].position, [-0.1, 0.4 - 0.2, -0.3], atol=1e-15)
    np.testing.assert_allclose(lj.bodies.revolute(a, b).g(0.0, poses, None), 0.0, atol=1e-15)
    turned = [lj.bodies.torsion(a, b, stiffness=2.0, angle=angle).potential for angle in (0.7, -0.7)]
    assert turned[0] is not None and turned[1] is not None
    assert turned[0](0.0, poses, None, None) < 1e-30 < turned[1](0.0, poses, None, None)


def missed(system):
    """By how much d/dt ∂L/∂v - ∂L/∂q = Q - ∂R/∂v is missed by the recursion at a state, which may be given another."""
    dissipation, force, recursion = system.dissipation, system.force, system.forward_dynamics

    @jax.jit
    def found(t, q, v, params, moving, of_recursion):
        def momentum_and_slope(t, q, v):
            slope, momentum = jax.grad(system.lagrangian, argnums=(1, 2))(t, q, v, params)
            return momentum, slope

        lost = jax.grad(dissipation, argnums=2)(t, q, v, params)
        beside = jax.tree.map(lambda x, y: x - y, force(t, q, v, params), lost)
        a = recursion(t, q, moving, beside, of_recursion)
        _, change, slope = jax.jvp(momentum_and_slope, (t, q, v), (jnp.ones_like(t), v, a), has_aux=True)
        left = jax.tree.map(lambda x, y, z: x - y - z, change, slope, beside)
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in jax.tree.leaves(left)]))

    return found


@pytest.mark.exhaustive
def test_the_recursion_solves_lagranges_equations():
    """With all joints and loads, at random states; without Coriolis terms it does not."""
    rng, tree, system, params = every_joint()
    off, t = missed(system), jnp.asarray(0.0)
    for _ in range(6):
        q, v = like(rng, tree.reference()), like(rng, tree.reference())
        assert off(t, q, v, params, v, params) < 1e-11
        assert off(t, q, v, params, jax.tree.map(jnp.zeros_like, v), params) > 0.1


@pytest.mark.parametrize("count", [3, 6], ids=["written out", "in a loop"])
def test_places_on_a_chain(count):
    """Where the end of a chain of rods is, how fast it moves and turns, by sums over its absolute angles; in both forms
    of a pose."""
    rods = [lj.bodies.Body(f"rod {i}", 1.0, (1 / 12, 1 / 12, 0.0)) for i in range(count)]
    above = [lj.bodies.ground.at(axis=Y), *(rod.at((0.0, 0.0, -0.5), Y) for rod in rods)]
    tree = lj.bodies.Tree(
        rods, {"a": [lj.bodies.revolute(a, rod.at((0.0, 0.0, 0.5), Y)) for a, rod in zip(above, rods)]}
    )
    tip, rng = rods[-1].at((0.0, 0.0, -0.5)), np.random.default_rng(2)
    relative, faster = rng.normal(size=(2, count))
    angle, rate = np.cumsum(relative), np.cumsum(faster)

    @by_numpy
    def seen(q, v):
        poses, rates = tree.poses(q), tree.rates(q, v)
        bare = [{name: lj.bodies.Pose(x.position, x.quaternion) for name, x in of.items()} for of in (poses, rates)]
        return [
            [tip.position(q), tip.velocity(q, v), rods[-1].spin(q, v), rods[-1].spin_in_body(q, v)]
            for q, v in ((poses, rates), bare)
        ]

    along = np.stack([-np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    across = np.stack([-np.cos(angle) * rate, 0 * angle, np.sin(angle) * rate], axis=1)
    turning = np.array([0.0, rate[-1], 0.0])
    for found in seen({"a": jnp.asarray(relative)}, {"a": jnp.asarray(faster)}):
        for x, y in zip(found, (along.sum(axis=0), across.sum(axis=0), turning, turning)):
            np.testing.assert_allclose(x, y, atol=1e-13)


def test_a_gap_of_a_place_is_a_short_program():
    """What a contact differentiates twice has no quaternion, unless it reads one, and no loop where links are few."""
    rod = lj.bodies.Body("rod", 1.0, (1 / 12, 1 / 12, 0.0))
    tree = lj.bodies.Tree([rod], {"a": lj.bodies.revolute(lj.bodies.ground.at(axis=Y), rod.at((0.0, 0.0, 0.5), Y))})
    tip = rod.at((0.0, 0.0, -0.5))

    def height(t, q, params):
        return tip.position(tree.poses(q))[2]

    def turned(t, q, params):
        return tree.poses(q)["rod"].quaternion[0]

    like = jnp.zeros(()), {"a": jnp.zeros(())}, None
    found = [TracedProgram(f, ("t", "q", "params"), like).jaxpr for f in (height, turned)]
    names = [[equation.primitive.name for equation in equations(jaxpr)] for jaxpr in found]
    assert ["sqrt" in x for x in names] == [False, True]
    assert "scan" not in names[0] and len(names[0]) < 80 < len(names[1])


def test_slots():
    """A chain needs one slot and a binary tree as many as its depth; reading finds what the parent wrote."""
    assert slots_of(range(-1, 40)).read.shape[1] == 1
    # Each branch in one piece: 0 (1 (2, 3), 4 (5, 6)).
    parents = [-1, 0, 1, 1, 0, 4, 4]
    read, write = slots_of(parents)
    slots = np.zeros(read.shape[1])
    for i, parent in enumerate(parents):
        assert read[i] @ slots == parent + 1
        slots = (1 - write[i]) * slots + write[i] * (i + 1)
    assert read.shape[1] == 2


def test_what_is_no_tree_is_refused():
    """Loops, rings, joints without coordinates, names given twice, by name and with the fix."""
    a, b = (lj.bodies.Body(name, 1.0, (1.0, 1.0, 1.0)) for name in "ab")
    hinge, back = lj.bodies.revolute(lj.bodies.ground.at(), a.at()), lj.bodies.revolute(b.at(), a.at((1.0, 0.0, 0.0)))
    on = lj.bodies.revolute(a.at(), b.at())
    for bodies, joints, said in (
        ([a, b], {"x": hinge, "y": back}, "hangs on two joints, 'x' and 'y'"),
        ([a, b], {"x": on, "y": back}, "'a', 'b' hang on each other in a ring"),
        ([a], {"x": on}, "which is not among the bodies"),
        ([a], {"x": lj.bodies.revolute(a.at(), lj.bodies.ground.at())}, "the parent's first"),
        ([a, b], {"x": [hinge, lj.bodies.prismatic(a.at(), b.at())]}, "several kinds"),
        ([a, b], {"b": hinge}, "called 'b'"),
        ([a, a], {}, "two bodies are called 'a'"),
    ):
        with pytest.raises(ValueError, match=said):
            lj.bodies.Tree(bodies, joints)
    with pytest.raises(TypeError, match="none that a tree has coordinates for"):
        lj.bodies.Tree([a], {"x": lj.Holonomic(lambda t, q, params: q["a"].position)})
    with pytest.raises(TypeError, match="must be a lj.bodies.Load"):
        lj.bodies.Tree([a], {"x": hinge}).system([hinge])


def test_armature_and_frames_that_are_none_are_refused():
    """Rotors of no joint or without an inertia, frames that carry nothing, moments without a mass."""
    frame, rod = lj.bodies.Body("frame", 0.0, (0.0, 0.0, 0.0)), lj.bodies.Body("rod", 1.0, (1.0, 1.0, 1.0))
    hinge, on = lj.bodies.revolute(lj.bodies.ground.at(), rod.at()), lj.bodies.revolute(rod.at(), frame.at())
    for bodies, joints, armature, said in (
        ([rod], {"x": hinge}, {"y": 1.0}, "armature names 'y', which is no joint"),
        ([rod], {}, {"rod": 1.0}, "armature names 'rod', which is no joint"),
        ([rod], {"x": hinge}, {"x": -1.0}, "must be a moment of inertia that is not negative"),
        ([rod], {"x": [hinge]}, {"x": (1.0, 2.0)}, "or \\(1,\\) of them"),
        ([rod, frame], {"x": hinge, "y": on}, {}, "'frame' moves and has no mass"),
        ([frame], {}, {}, "'frame' moves and has no mass"),
    ):
        with pytest.raises(ValueError, match=said):
            lj.bodies.Tree(bodies, joints, armature)
    with pytest.raises(ValueError, match="the mass of 'x' must be a positive number"):
        lj.bodies.Body("x", 0.0, (1.0, 1.0, 1.0))


@pytest.mark.exhaustive
def test_a_singular_tree():
    """Two hinges about one axis with nothing between them are named as singular, not as a wrong recursion."""
    frame, rod = lj.bodies.Body("frame", 0.0, (0.0, 0.0, 0.0)), lj.bodies.Body("rod", 1.0, (1.0, 1.0, 1.0))
    last = lj.bodies.revolute(frame.at(), rod.at((1.0, 0.0, 0.0)))
    twice = lj.bodies.Tree([frame, rod], {"x": lj.bodies.revolute(lj.bodies.ground.at(), frame.at()), "y": last})
    q = {"x": 0.1, "y": 0.2}
    with pytest.raises(ValueError, match="singular"):
        lj.accelerations(twice.system(), 0.0, q, q, None)


def test_one_link_is_a_physical_pendulum():
    """a = -m g l sin φ/(I + m l²), by mass, inertia and place from params, and no warning of loops in Python, which the
    recursion has not. Twin: without I."""
    rod = lj.bodies.Body("rod", lambda p: p["m"], lambda p: (p["I"], p["I"], 0.1 * p["I"]))
    across = (0.0, 1.0, 0.0)
    hinge = lj.bodies.revolute(
        lj.bodies.ground.at(axis=across), rod.at(lambda p: jnp.array([0.0, 0.0, p["l"]]), axis=across)
    )
    pendulum = lj.bodies.Tree([rod], {"hinge": hinge}).system([lj.bodies.weight([rod])])
    p = {"m": 2.0, "I": 0.3, "l": 0.75}
    a, _ = in_numpy(lambda q: lj.accelerations(pendulum, 0.0, q, {"hinge": 0.0}, p))({"hinge": 0.4})
    torque = -2.0 * 9.81 * 0.75 * np.sin(0.4)
    np.testing.assert_allclose(a["hinge"], torque / (0.3 + 2.0 * 0.75**2), rtol=1e-13)
    assert abs(float(a["hinge"]) - torque / (2.0 * 0.75**2)) > 0.5
