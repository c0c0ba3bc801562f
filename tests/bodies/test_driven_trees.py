"""Trees on bodies that move as given, against closed forms in frames that move, and Lagrange's equations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display import InSpace
from tests.bodies.test_tree import a_body, a_place, every_joint, like, missed


def shaken(t, params):
    """The motion of a table that turns faster and faster about its normal, which is z, and is shaken."""
    angle = params["rate"] * t + 0.3 * t**2
    return lj.bodies.Pose.at((jnp.sin(2.0 * t), 0.5 * t**2, jnp.cos(t)), angle=angle)


TABLE, PLATE = lj.bodies.Body("table", motion=shaken), lj.bodies.Body("plate", 2.0, (1.0, 1.0, 1.5))


@pytest.mark.slow
def test_a_plate_on_a_table_that_turns_and_is_shaken():
    """r'' = -R^T p'' - 2 w x r' - w x (w x r) - w' x r in the table's frame, to 1e-12; without Coriolis it is not."""
    tree = lj.bodies.Tree([TABLE, PLATE], {"on": lj.bodies.planar(TABLE.at((0.0, 0.0, 0.2)), PLATE.at())})
    recursion = tree.system().forward_dynamics
    assert recursion is not None
    t, params = 0.7, {"rate": 1.1}
    q, v = {"on": jnp.array([0.4, -0.3, 0.2])}, {"on": jnp.array([0.5, 0.8, -0.1])}
    a = jax.jit(recursion)(t, q, v, {"on": jnp.zeros(3)}, params)["on"]
    angle, spin, faster = 1.1 * t + 0.3 * t**2, 1.1 + 0.6 * t, 0.6
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shake = np.array([-4.0 * np.sin(2.0 * t), 1.0])
    # w x (x, y) = w (-y, x).
    across = lambda r: np.array([-r[1], r[0]])
    r, rate = np.asarray(q["on"][:2]), np.asarray(v["on"][:2])
    coriolis = -2.0 * spin * across(rate)
    expected = -turn.T @ shake + coriolis + spin**2 * r - faster * across(r)
    np.testing.assert_allclose(a, [*expected, -faster], atol=1e-12)
    assert np.abs(a[:2] - (expected - coriolis)).max() > 0.1
    # Where the plate is, and how it moves: p + R r, and its derivative.
    place = tree.poses(q, params, t)["plate"].position
    np.testing.assert_allclose(
        place, [*(np.array([np.sin(2 * t), 0.5 * t**2]) + turn @ r), np.cos(t) + 0.2], atol=1e-14
    )
    moving = np.array([2.0 * np.cos(2.0 * t), t]) + turn @ (rate + spin * across(r))
    np.testing.assert_allclose(tree.rates(q, v, params, t)["plate"].position, [*moving, -np.sin(t)], atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["every joint", "few links"])
def test_the_two_recursions_undo_each_other(which):
    """Accelerations under the force that these accelerations need are these; twin: the force somewhere else."""
    if which == "every joint":
        rng, tree, system, params = every_joint()
    else:
        rng, params = np.random.default_rng(5), {"rate": 1.1}
        # Links are written out.
        tree = lj.bodies.Tree([TABLE, PLATE], {"on": lj.bodies.revolute(a_place(rng, TABLE), a_place(rng, PLATE))})
        system = tree.system([lj.bodies.weight([PLATE])])
    q, elsewhere, v, a = (like(rng, tree.reference()) for _ in range(4))
    forward: Any = system.forward_dynamics

    @jax.jit
    def off(of_force):
        force = forward.__self__.newton_euler_recursion(0.7, of_force, v, a, params)
        found = forward(0.7, q, v, force, params)
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x - y)) for x, y in zip(*map(jax.tree.leaves, (found, a)))]))

    assert off(q) < 1e-11 and off(elsewhere) > 1e-2


def test_refused_trees_on_driven_bodies():
    """A joint that ends on what moves as given, poses without a time."""
    hinge = lj.bodies.revolute(TABLE.at(), PLATE.at())
    tree = lj.bodies.Tree([PLATE, TABLE], {"hinge": hinge})
    assert repr(tree) == "Tree(2 bodies; hinge)" and list(tree.reference()) == ["hinge"]
    with pytest.raises(TypeError, match="a body of this tree moves as given"):
        tree.poses({"hinge": 0.1}, {"rate": 1.0})
    with pytest.raises(ValueError, match="body 'table' moves as given, and hangs on the joint 'hinge'"):
        lj.bodies.Tree([PLATE, TABLE], {"hinge": lj.bodies.revolute(PLATE.at(), TABLE.at())})


def test_driven_bodies_in_pictures():
    """What is fixed in a turning table is drawn where it is at the time of the picture."""
    hinge = lj.bodies.revolute(TABLE.at((1.0, 0.0, 0.0)), PLATE.at())
    expected = [np.sin(1.0) + np.cos(0.625), 0.125 + np.sin(0.625), np.cos(0.5)]
    pose = lj.bodies.Pose.at(expected)
    for system, q in (
        (lj.bodies.Tree([TABLE, PLATE], {"hinge": hinge}).system(), {"hinge": 0.0}),
        (lj.bodies.multibody([TABLE, PLATE], {"hinge": hinge}), {"plate": pose}),
    ):
        picture = lj.draw(system, q, {"rate": 1.1}, t=0.5)
        assert isinstance(picture.points, InSpace)
        (dot,) = (shape for shape in picture.points.shapes if shape.kind == "dot")
        assert dot.anchors[0].body == "table"
        np.testing.assert_allclose(np.atleast_2d(picture.points.place(dot.anchors[0]))[0], expected, atol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", [2, 4], ids=["written out", "in a loop"])
def test_the_recursion_solves_lagranges_equations(count):
    """d/dt dL/dv - dL/dq = Q - dR/dv on a base that moves and tumbles, with loads; with the base at rest it is not."""
    rng = np.random.default_rng(5)

    def tumbling(t, params):
        turned = lj.bodies.Pose.at((jnp.sin(params["w"] * t), 0.3 * t**2, 0.2), (1.0, 2.0, 0.5), jnp.cos(2.0 * t))
        return turned.turned((0.0, 0.3, 1.0), params["w"] * t)

    base, bodies = lj.bodies.Body("base", motion=tumbling), [a_body(rng, f"b{i}") for i in range(count)]
    kinds = lj.bodies.revolute, lj.bodies.prismatic, lj.bodies.spherical, lj.bodies.universal
    parents = base, bodies[0], base, *bodies[2:3]
    joints = {f"j{i}": kinds[i](a_place(rng, parents[i]), a_place(rng, body)) for i, body in enumerate(bodies)}
    free = [a_body(rng, "free")] if count == 4 else []
    tree = lj.bodies.Tree([*bodies, base, *free], joints)
    loads = [
        lj.bodies.weight(bodies),
        lj.bodies.spring(a_place(rng, base), a_place(rng, bodies[-1]), 3.0, 0.2, damping=0.4),
        lj.bodies.motor(a_place(rng, base), a_place(rng, bodies[0]), 0.7),
    ]
    off = missed(tree.system(loads))
    q = like(rng, tree.reference())
    v, t = like(rng, q), jnp.asarray(0.6)
    moves, rests = {"w": jnp.asarray(1.7)}, {"w": jnp.asarray(0.0)}
    assert off(t, q, v, moves, v, moves) < 1e-11
    assert off(t, q, v, moves, v, rests) > 0.1


@pytest.mark.exhaustive
def test_a_bead_on_a_turning_rod():
    """x = x0 cosh wt + v0/w sinh wt, its gradient by w in both modes, lanes, and h = T2 + V that stays."""
    bead = lj.bodies.Body("bead", 2.0, (1.0, 1.0, 1.0))
    rod = lj.bodies.Body("rod", motion=lambda t, params: lj.bodies.Pose.at(angle=params * t))
    along = (1.0, 0.0, 0.0)
    system = lj.bodies.Tree([rod, bead], {"x": lj.bodies.prismatic(rod.at(axis=along), bead.at(axis=along))}).system()
    q, v = {"x": jnp.asarray(0.5)}, {"x": jnp.asarray(0.2)}
    end = lambda w: lj.integrate(system, q, v, w, ts=jnp.array([0.0, 1.0]), rtol=1e-12, atol=1e-12).q["x"][-1]
    exact = lambda w: 0.5 * jnp.cosh(w) + 0.2 / w * jnp.sinh(w)
    rates = jnp.array([1.0, 3.0])
    np.testing.assert_allclose(jax.vmap(end)(rates), exact(rates), rtol=1e-11)
    slope = jax.grad(exact)(3.0)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(mode(end)(3.0), slope, rtol=1e-10)
    start, later = ((0.5, 0.2), (exact(3.0), 1.5 * np.sinh(3.0) + 0.2 * np.cosh(3.0)))
    h = [lj.jacobi_integral(system, 0.3, {"x": x}, {"x": rate}, 3.0) for x, rate in (start, later)]
    # Of unit inertia, the bead turns with the rod.
    np.testing.assert_allclose(h, [0.2**2 - 9.0 * 0.5**2 - 9.0 / 2] * 2, rtol=1e-11)
