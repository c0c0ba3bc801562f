"""The force that a motion needs: by hand, against MuJoCo, and back by the accelerations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.models.test_readers import arm, drawn_at_random, mujoco
from tests.systems import HORIZONTAL, PARAMS, double_pendulum, driven, reference, rod_pendulum


def test_by_hand():
    """A driven mass on a spring: m a + c v + k q - Q(t); twin: without the damper it is another."""
    t, q, v, a = 0.4, 0.7, -1.3, 2.1
    params = {"m": 1.25, "k": 5.0, "c": 0.5, "pull": 2.0, "rate": 1.5}
    force, multipliers = lj.inverse_dynamics(driven, t, q, v, a, params)
    expected = [1.25 * a + c * v + 5.0 * q - 2.0 * np.cos(1.5 * t) for c in (0.5, 0.0)]
    np.testing.assert_allclose(force, expected[0], rtol=1e-14)
    assert multipliers == {} and abs(force - expected[1]) > 0.1


def test_on_a_rod():
    """The force along the path alone, while the rod keeps its load; accelerations that it forbids are refused."""
    angle, rate, faster = 0.4, 1.5, 0.7
    (sin, cos), l = (np.sin(angle), np.cos(angle)), PARAMS["l"]
    q, v = {"x": l * sin, "y": -l * cos}, {"x": l * rate * cos, "y": l * rate * sin}
    a = {"x": l * (faster * cos - rate**2 * sin), "y": l * (faster * sin + rate**2 * cos)}
    force, multipliers = lj.inverse_dynamics(rod_pendulum, 0.0, q, v, a, PARAMS)
    along = l * faster + PARAMS["g"] * sin
    np.testing.assert_allclose([force["x"], force["y"]], [along * cos, along * sin], rtol=1e-13)
    tension = l * rate**2 + PARAMS["g"] * cos
    np.testing.assert_allclose(multipliers["rod"], -tension / (2 * l), rtol=1e-13)
    with pytest.raises(ValueError, match="do not allow these accelerations.*'rod' by 3.12"):
        lj.inverse_dynamics(rod_pendulum, 0.0, q, v, a | {"x": a["x"] + 3.125 / (2 * l * sin)}, PARAMS)
    with pytest.raises(ValueError, match="a must be like q: it has x, and q has x, y"):
        lj.inverse_dynamics(rod_pendulum, 0.0, q, v, {"x": 0.0}, PARAMS)
    # In equilibrium the accelerations are round-off, and no motion that the rod forbids.
    hanging, noise = {"x": 0.0, "y": -l}, {"x": 1e-16, "y": 1e-16}
    force, _ = lj.inverse_dynamics(rod_pendulum, 0.0, hanging, {"x": 0.0, "y": 0.0}, noise, PARAMS)
    np.testing.assert_allclose(list(force.values()), 0.0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double pendulum", "double rods", "disk"])
def test_there_and_back(name):
    """Given as the force it gives the accelerations, which need none without it, with the same multipliers."""
    system, q, v, params = reference(name)
    free, loaded = lj.accelerations(system, 0.0, q, v, params)
    extra = jax.tree.map(lambda x: jnp.sin(3.0 + jnp.arange(x.size)).reshape(x.shape), free)

    def pushed(t, q, v, p):
        return jax.tree.map(lambda x: p[1] * x, extra)

    driven = lj.System(lambda t, q, v, p: system.lagrangian(t, q, v, p[0]), {
        key: type(c)((lambda c: lambda t, *rest: c.function(t, *rest[:-1], rest[-1][0]))(c))
        for key, c in system.constraints.items()
    }, force=pushed)  # fmt: skip
    a, _ = lj.accelerations(driven, 0.0, q, v, (params, 1.0))
    force, multipliers = lj.inverse_dynamics(system, 0.0, q, v, a, params)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13), multipliers, loaded)
    # The same force again: of the pushes that give these accelerations it is the one without a part along constraints.
    driven = lj.System(driven.lagrangian, driven.constraints, force=lambda t, q, v, p: p[1])
    back, same = lj.accelerations(driven, 0.0, q, v, (params, force))
    for found, asked in ((back, a), (same, loaded)):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13), found, asked)
    force, _ = lj.inverse_dynamics(system, 0.0, q, v, free, params)
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in jax.tree.leaves(force)]), 0.0, atol=1e-13)


@pytest.mark.slow
def test_against_mujoco():
    """An arm of seven joints with dampers, at 1e-12; the slope in a is the mass matrix, in both modes."""
    model, theirs = lj.read_urdf(arm()), mujoco.MjModel.from_xml_string(arm())
    data, rng = mujoco.MjData(theirs), np.random.default_rng(1)
    q, v, a, force = {}, {}, {}, {}
    theirs.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    system, names = model.joint_system(), [theirs.joint(i).name for i in range(theirs.njnt)]

    def needed(a):
        return lj.inverse_dynamics(system, 0.0, q, v, a, None)[0]

    for seed in range(3):
        given, rates = drawn_at_random(model, seed)
        a = {name: rng.normal() for name in names}
        q, v = model.joint_state(given, rates)
        data.qpos[:], data.qvel[:], data.qacc[:] = ([x[name] for name in names] for x in (given, rates, a))
        mujoco.mj_inverse(theirs, data)
        force = needed(a)
        np.testing.assert_allclose([force[name] for name in names], data.qfrc_inverse, rtol=1e-12, atol=1e-12)
    mass = lj.mass_matrix(system, 0.0, q, v, None)
    for slope in (jax.jacfwd, jax.jacrev):
        rows = jax.jit(slope(needed))(a)
        np.testing.assert_allclose([[rows[i][j] for j in sorted(names)] for i in sorted(names)], mass, atol=1e-13)
    many = jax.vmap(needed)({name: np.array([x, 0.0]) for name, x in a.items()})
    np.testing.assert_allclose([many[name][0] for name in names], [force[name] for name in names], rtol=1e-12)


@pytest.mark.slow
def test_slopes_and_lanes_with_constraints():
    """Both modes agree with the differences of a constrained force; in lanes, forbidden accelerations are NaN alone."""
    system, q, v, params = reference("double rods")

    def needed(scale):
        pulled = params | {"g": scale * params["g"]}
        return lj.inverse_dynamics(system, 0.0, q, v, a, pulled)[0]["first"]

    a, _ = lj.accelerations(system, 0.0, q, v, params)
    forward, reverse = jax.jacfwd(needed)(1.0), jax.jacrev(needed)(1.0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    np.testing.assert_allclose(forward, (needed(1.5) - needed(0.5)) / 1.0, rtol=1e-10)
    lanes = jax.tree.map(lambda x: jnp.stack([x, x + 1.0]), a)
    force, _ = jax.vmap(lambda a: lj.inverse_dynamics(system, 0.0, q, v, a, params))(lanes)
    assert np.isfinite(force["first"][0]).all() and np.isnan(force["first"][1]).all()


@pytest.mark.slow
def test_what_has_no_mass():
    """A massless point needs the force that gives it its velocity; a state needs none, and acts by its rate."""
    dashpot = lj.System(
        lambda t, q, v, p: 0.5 * v["body"] ** 2 - 2.0 * (q["body"] - q["end"]) ** 2,
        dissipation=lambda t, q, v, p: 1.5 * v["end"] ** 2,
        states={"z": lambda t, q, v, p: -q["z"]},
        force=lambda t, q, v, p: {"body": v["z"], "end": 0.0 * v["z"], "z": 0.0},
    )
    q, v = {"body": 1.0, "end": 0.25, "z": 3.0}, {"body": 0.5, "end": 0.75}
    force, _ = lj.inverse_dynamics(dashpot, 0.0, q, v, {"body": 2.0, "end": 9.0}, None)
    np.testing.assert_allclose([force[name] for name in ("body", "end", "z")], [2.0 + 3.0 + 3.0, 2.25 - 3.0, 0.0])


def test_elements_are_refused():
    """Contacts that open and close have no one form of equations: the error says what to take."""
    system = lj.System(double_pendulum.lagrangian, elements={"stop": lj.Stop(lambda t, q, p: q[0], low=0.0)})
    with pytest.raises(TypeError, match="with a lj.Holonomic for a contact that is closed"):
        lj.inverse_dynamics(system, 0.0, *HORIZONTAL, HORIZONTAL[1], PARAMS)
