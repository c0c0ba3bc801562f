"""Trees with friction in joints, places that slide and driven joints, against the same L by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from lagjax.integrate.elements import check_linear
from lagjax.integrate.jumps import found as jumps_found
from lagjax.system import prepare

Y, G = (0.0, 1.0, 0.0), 9.81
UPPER, LOWER = RODS = [
    lj.bodies.Body(name, lambda params: params["m"], (1 / 12, 1 / 12, 0.0)) for name in ("upper", "lower")
]
JOINTS = {
    "a": lj.bodies.revolute(lj.bodies.ground.at(axis=Y), UPPER.at((0.0, 0.0, 0.5), Y)),
    "b": lj.bodies.revolute(UPPER.at((0.0, 0.0, -0.5), Y), LOWER.at((0.0, 0.0, 0.5), Y)),
}
TREE, TIP = lj.bodies.Tree(RODS, JOINTS), LOWER.at((0.0, 0.0, -0.5))
PARAMS = {"m": 1.3}
Q, V = {"a": 0.9, "b": 0.3}, {"a": 0.0, "b": 0.0}


def by_hand(t, q, v, params):
    """Two rods of length one in the angles of their joints."""
    a, b = q["a"], q["a"] + q["b"]
    da, db = v["a"], v["a"] + v["b"]
    turning = da**2 + db**2
    moving = da**2 / 4 + da**2 + db**2 / 4 + da * db * jnp.cos(a - b)
    return turning / 24 + params["m"] * (moving / 2 + G * (1.5 * jnp.cos(a) + jnp.cos(b) / 2))


def slides(t, q, v, params):
    """How fast the tip moves along x, by the tree."""
    return TIP.velocity(TREE.poses(q, params), TREE.rates(q, v, params), params)[0]


def slides_by_hand(t, q, v, params):
    """How fast the tip moves along x."""
    return -jnp.cos(q["a"]) * v["a"] - jnp.cos(q["a"] + q["b"]) * (v["a"] + v["b"])


def apart(one, other):
    """By how much two motions differ."""
    assert jax.tree.structure(one.q) == jax.tree.structure(other.q)
    return max(np.max(np.abs(x - y)) for x, y in zip(*(jax.tree.leaves((traj.q, traj.v)) for traj in (one, other))))


@pytest.mark.slow
def test_sliding_of_a_place_on_a_tree():
    """The velocity of a place, by rates from a loop over bodies, is seen to be linear; its square is not."""
    q, v, params = jax.tree.map(jnp.asarray, (Q, {"a": 0.7, "b": -0.2}, PARAMS))
    check_linear(slides, jnp.zeros(()), q, v, params)
    np.testing.assert_allclose(jax.jit(slides)(0.0, q, v, params), slides_by_hand(0.0, q, v, params), rtol=1e-13)
    with pytest.raises(ValueError, match="must be linear in v"):
        check_linear(lambda *state: slides(*state) ** 2, jnp.zeros(()), q, v, params)


@pytest.mark.slow
def test_forces_on_a_tree_have_no_jumps():
    """A motor and a damper, which read poses, are smooth; a motor that compares is not."""
    damped = lj.bodies.spring(lj.bodies.ground.at((1.0, 0.0, 0.0)), TIP, 3.0, 0.1, damping=0.2)
    for torque, smooth in ((lambda t, q, v, params: -v["a"], True), (lambda t, q, v, params: -jnp.sign(v["a"]), False)):
        driven = TREE.system([damped, lj.bodies.motor(LOWER.at(axis=Y), UPPER.at(axis=Y), torque)])
        model, start = prepare(driven, 0.0, Q, V, PARAMS)
        assert (jumps_found(model, start) is None) == smooth


@pytest.mark.exhaustive
def test_friction_in_a_joint():
    """Dry friction in a joint of a tree, as with L by hand; a wrong recursion is refused."""
    joint = {"joint": lj.Friction(lambda t, q, v, params: v["b"], 0.5, normal=1.0)}
    tree, hand = TREE.system([lj.bodies.weight(RODS)], elements=joint), lj.System(by_hand, elements=joint)
    ts = jnp.linspace(0.0, 1.5, 7)
    ours, theirs = (lj.integrate(x, Q, V, PARAMS, ts=ts, rtol=1e-10, estimate_error=False) for x in (tree, hand))
    assert isinstance(ours, HybridTrajectory) and isinstance(theirs, HybridTrajectory)
    assert len(ours.switches) == len(theirs.switches) >= 1
    np.testing.assert_array_equal(ours.modes, theirs.modes)
    assert apart(ours, theirs) < 1e-8
    np.testing.assert_allclose(ours.multipliers["joint"], theirs.multipliers["joint"], atol=1e-7)
    wrong = replace(tree, forward_dynamics=lambda t, q, v, force, params: force)
    with pytest.raises(ValueError, match="do not solve the equations of L"):
        lj.integrate(wrong, Q, V, PARAMS, ts=ts)
