"""Noether's charges against closed forms, tests of symmetries, and the rates of broken charges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import cross_rails, mass_distributions, sliding_wedge

RANDOM = np.random.default_rng(1)
RADIUS = {"R": 0.75}


def central(t, q, v, params):
    """A particle in a central field, with coordinates in an array of three."""
    return 0.5 * params["m"] * v @ v + params["k"] / jnp.sqrt(q @ q)


def falling(t, q, v, params):
    """A falling stone."""
    return 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) - params["m"] * params["g"] * q["y"]


def rolling_disk():
    """An upright disk that rolls on a plane and is pulled along x, as on a slope."""
    lagrangian = lambda t, q, v, p: (
        0.5 * (v["x"] ** 2 + v["y"] ** 2) + 0.25 * v["phi"] ** 2 + 0.125 * v["theta"] ** 2 + 0.5 * q["x"]
    )
    along = lj.Nonholonomic(lambda t, q, v, p: v["x"] - p["R"] * v["phi"] * jnp.cos(q["theta"]))
    across = lj.Nonholonomic(lambda t, q, v, p: v["y"] - p["R"] * v["phi"] * jnp.sin(q["theta"]))
    return lj.System(lagrangian, {"along": along, "across": across})


STONE, KEPLER, DISK = lj.System(falling), lj.System(central), rolling_disk()
OF_STONE = {"m": 1.5, "g": 9.8125}
OF_KEPLER = {"m": 1.25, "k": 2.0}
IN_SPACE = np.array([1.0, 0.25, 0.5]), np.array([0.125, 1.0, -0.25])
ON_PLANE = {"phi": 0.25, "theta": 0.75, "x": 0.0, "y": 0.5}


def rolling(start=ON_PLANE):
    """A velocity with which the disk rolls."""
    phi = 2.0
    x, y = RADIUS["R"] * phi * np.cos(start["theta"]), RADIUS["R"] * phi * np.sin(start["theta"])
    return {"phi": phi, "theta": 0.5, "x": x, "y": y}


def test_charges_in_closed_form():
    """p, L, E and the screw's charge at random states, under vmap; twins: another pitch, the opposite sign of L."""
    names = list("xyz")
    state = [{k: RANDOM.normal(size=20) for k in names} for _ in range(2)]
    q, v = state
    params = mass_distributions.PARAMS["cylinder"]
    system = mass_distributions.SYSTEMS["cylinder"]
    exact = mass_distributions.charges("cylinder", q, v, params)
    exact["screw"] = 0.5 * exact["p_z"] + 2 * np.pi * exact["L_z"]
    generators = {
        "p_x": lj.Generator.translation("x"),
        "L_z": lj.Generator.rotation("z"),
        "E": lj.Generator.time_translation(),
        "screw": lj.Generator.screw("z", 0.5),
    }
    found = jax.jit(
        jax.vmap(lambda q, v: {name: lj.noether_charge(system, g)(0.0, q, v, params) for name, g in generators.items()})
    )(q, v)
    for name, value in found.items():
        np.testing.assert_allclose(value, exact[name], atol=1e-12)
    assert np.max(np.abs(found["screw"] - found["L_z"])) > 0.1
    assert np.max(np.abs(np.asarray(found["L_z"]) + exact["L_z"])) > 0.1


def test_a_vector_as_axis_and_a_center():
    """n·L about a point c is n·((q - c) x p); translations along n give n·p. Twin: another centre."""
    q, v = IN_SPACE
    axis, center, p = np.array([1.0, 2.0, 2.0]), (0.5, -1.0, 0.25), OF_KEPLER["m"] * v
    charge = lj.noether_charge(KEPLER, lj.Generator.rotation(axis, about=center))(0.0, q, v, OF_KEPLER)
    np.testing.assert_allclose(charge, axis @ np.cross(q - np.array(center), p), rtol=1e-14)
    assert abs(charge - axis @ np.cross(q, p)) > 0.1
    along = lj.noether_charge(KEPLER, lj.Generator.translation(axis))(0.0, q, v, OF_KEPLER)
    np.testing.assert_allclose(along, axis @ p, rtol=1e-14)


def test_a_charge_has_derivatives():
    """∂L_z/∂m = (q x v)_z, by derivatives in both modes."""
    q, v = IN_SPACE
    charge = lj.noether_charge(KEPLER, lj.Generator.rotation("z"))
    of_m = lambda m: charge(0.0, q, v, OF_KEPLER | {"m": m})
    for derivative in (jax.grad(of_m)(1.25), jax.jacfwd(of_m)(1.25)):
        np.testing.assert_allclose(derivative, np.cross(q, v)[2], rtol=1e-14)


def test_a_boost_needs_its_gauge_term():
    """t p - m x is conserved along a free direction; twins: without the gauge term, another mass."""
    start = {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}
    boost = lambda axis, m: lj.Generator.boost(axis, lambda t, q, params: m * q[axis])
    assert lj.is_symmetry(STONE, boost("x", OF_STONE["m"]), *start, OF_STONE)
    bare = lj.Generator(boost("x", 1.0).delta, name="bare")
    for wrong in (bare, boost("x", 1.0)):
        found = lj.is_symmetry(STONE, wrong, *start, OF_STONE)
        assert not found and found.residual > 1e-3, found
    # In free fall L changes by -m g = dF/dt with F = -m g t.
    fall = lj.Generator.shift("y") + lj.Generator(gauge=lambda t, q, p: -p["m"] * p["g"] * t)
    assert lj.is_symmetry(STONE, fall, *start, OF_STONE)


def moved_and_predicted(system, generator, q, v, params):
    """The change of a charge along a motion, the integral of its predicted rate, and the first rate."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    ts = np.concatenate([[0.0], 0.5 * (nodes + 1), [1.0]])
    motion = lj.integrate(system, q, v, params, ts=ts, rtol=1e-11, atol=1e-11)
    charge = lj.noether_charge(system, generator)
    both = lambda t, q, v: (charge(t, q, v, params), charge.rate(t, q, v, params))
    values, rates = (np.asarray(x) for x in jax.jit(jax.vmap(both))(motion.t, motion.q, motion.v))
    return values[-1] - values[0], 0.5 * weights @ rates[1:-1], rates[0]


@pytest.mark.slow
def test_the_rate_of_a_broken_charge_is_that_of_the_motion():
    """dC/dt along motions agrees with `rate` for L, friction, velocity constraints. Twin: without the latter two."""
    squashed = lambda t, q, v, p: central(t, q, v, p) - 0.25 * q[0] ** 2 * jnp.cos(t)
    rubbed = lj.System(squashed, dissipation=lambda t, q, v, params: 0.125 * v @ v)
    turn = lj.Generator.rotation("z") + 0.5 * lj.Generator.time_translation()
    slide = lj.Generator.shift("x") + lj.Generator.shift("phi")
    for case in ((rubbed, turn, *IN_SPACE, OF_KEPLER), (DISK, slide, ON_PLANE, rolling(), RADIUS)):
        changed, predicted, first = moved_and_predicted(*case)
        np.testing.assert_allclose(predicted, changed, atol=1e-9)
        assert abs(changed) > 1e-2
        without = lj.noether_charge(lj.System(case[0].lagrangian), case[1])
        assert abs(without.rate(0.0, *case[2:]) - first) > 1e-2


@pytest.mark.slow
def test_constraints_forbid_and_allow():
    """The wedge allows p_X + p_x; the disk's constraints forbid a shift, although it leaves them unchanged."""
    start = sliding_wedge.start_on_incline(sliding_wedge.PARAMS, along=1.0, along_rate=0.25)
    both = lj.is_symmetry(sliding_wedge.system, lj.Generator.shift({"X": 1, "x": 1}), *start, sliding_wedge.PARAMS)
    np.testing.assert_allclose(both.charge, sliding_wedge.horizontal_momentum(sliding_wedge.PARAMS, start[1]))
    assert both and both.residual < 1e-14
    one = lj.is_symmetry(sliding_wedge.system, lj.Generator.shift("x"), *start, sliding_wedge.PARAMS)
    exact = sliding_wedge.exact_accelerations(sliding_wedge.PARAMS).x * sliding_wedge.PARAMS["m"]
    np.testing.assert_allclose(one.rate, exact, rtol=1e-12)
    assert not one and one.broken_by() == ["constraint 'incline'"]
    moved = lj.is_symmetry(DISK, lj.Generator.shift("y"), ON_PLANE, rolling(), RADIUS)
    assert not moved and moved.invariance["across"] < 1e-12
    assert "forbids it, though it looks the same" in repr(moved)
    assert lj.is_symmetry(DISK, lj.Generator.shift("theta"), ON_PLANE, rolling(), RADIUS).residual < 1e-12


@pytest.mark.slow
def test_a_moving_constraint_does_work():
    """On a hoop that turns at a given rate E is not conserved, but E - ω L_z is; twin: the opposite sign."""
    bead = lambda t, q, v, p: 0.5 * v @ v - p["g"] * q[2]
    sphere = lj.Holonomic(lambda t, q, p: q @ q - 1.0)
    plane = lj.Holonomic(lambda t, q, p: q[1] * jnp.cos(p["w"] * t) - q[0] * jnp.sin(p["w"] * t))
    hoop, params = lj.System(bead, {"sphere": sphere, "plane": plane}), {"g": 9.8125, "w": 2.5}
    state = np.array([0.6, 0.0, -0.8]), np.array([0.8, 1.5, 0.6])
    energy, turn = lj.Generator.time_translation(), lj.Generator.rotation("z")
    assert lj.is_symmetry(hoop, energy - params["w"] * turn, *state, params)
    for wrong in (energy, energy + params["w"] * turn):
        assert lj.is_symmetry(hoop, wrong, *state, params).broken_by() == ["constraint 'plane'"]


@pytest.mark.exhaustive
def test_under_vmap_and_in_a_sweep():
    """A rotation is a symmetry of two springs only at the ratio one, to round-off; else the rate is (k_x - k_y) x y."""
    springs = lambda t, q, v, p: 0.5 * v @ v - 0.5 * (q[0] ** 2 + p["ratio"] * q[1] ** 2)
    system = lj.System(springs)
    q, v = np.array([1.0, 0.5]), np.array([0.25, 0.125])
    test = lambda point: lj.is_symmetry(system, lj.Generator.rotation("z"), q, v, point)
    swept = lj.sweep(lambda p: (test(p).residual, test(p).rate), {"ratio": np.array([0.5, 1.0, 2.0])}, progress=False)
    residual, rate = swept.values
    assert residual[1] < 1e-14 and min(residual[0], residual[2]) > 0.1
    np.testing.assert_allclose(rate, (1.0 - np.array([0.5, 1.0, 2.0])) * q[0] * q[1], atol=1e-14)
    batch = jax.vmap(lambda ratio: test({"ratio": ratio}))(jnp.array([0.5, 1.0]))
    assert batch.holds.tolist() == [False, True] and "1 of 2 lanes" in repr(batch)


def test_energy_in_one_frame_and_not_in_the_other():
    """The rails' h' = E - ω L_z is the Jacobi integral of the rotating frame; in the lab E changes at ω τ."""
    params, time = cross_rails.PARAMS, lj.Generator.time_translation()
    inside = lj.is_symmetry(cross_rails.rotating_system, time, cross_rails.Q0, cross_rails.V0, params)
    balance = cross_rails.balance(params, cross_rails.Q0, cross_rails.V0)
    assert inside
    np.testing.assert_allclose(inside.charge, balance.h, rtol=1e-13)
    state = cross_rails.to_lab(params, 0.0, cross_rails.Q0, cross_rails.V0)
    outside = lj.is_symmetry(cross_rails.lab_system, time, *state, params)
    assert not outside and outside.broken_by() == ["L"]
    np.testing.assert_allclose([outside.charge, outside.rate], [balance.E, balance.power], rtol=1e-12)


def test_a_generator_of_the_wrong_structure_is_named():
    """Each message names the coordinate or the wrong value."""
    state = 0.0, {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}, OF_STONE
    cases = [
        (lambda t, q, params: {"x": 1.0}, ValueError, "it lacks 'y'"),
        (lambda t, q, params: {"x": 1.0, "z": 0.0}, ValueError, "q has no 'z'"),
        (lambda t, q, params: 1.0, ValueError, "where q has 'x' and 'y'"),
        (lambda t, q, params: {"x": jnp.ones(3), "y": 0.0}, ValueError, r"moves 'x', of shape \(\)"),
        (lambda t, q: q, TypeError, "is called with 3 arguments"),
        (lambda t, q, params: {"x": q["r"], "y": 0.0}, ValueError, "asks for 'r'"),
        (lj.Generator.shift("phi"), ValueError, "no coordinate 'phi'; the coordinates are 'x' and 'y'"),
        (lj.Generator(time=lambda t, q, params: jnp.ones(2)), ValueError, "must return one number"),
    ]
    for generator, kind, words in cases:
        with pytest.raises(kind, match=words):
            lj.noether_charge(STONE, generator)(*state)
        with pytest.raises(kind, match=words):
            lj.is_symmetry(STONE, generator, *state[1:])
    with pytest.raises(TypeError, match="a generator is a lj.Generator or a function"):
        lj.noether_charge(STONE, 1.0)
    with pytest.raises(ValueError, match="no points to move in space among the coordinates"):
        lj.noether_charge(lj.System(lambda t, q, v, p: v**2), lj.Generator.rotation("z"))(0.0, 0.5, 0.5, None)
    with pytest.raises(TypeError, match="must move something"):
        lj.Generator()
    with pytest.raises(ValueError, match='an axis is "x", "y", "z" or a vector'):
        lj.Generator.rotation("w")


def test_no_states_no_verdict():
    """An error says that no state satisfies the constraints, or that L is finite nowhere."""
    nowhere = lj.System(falling, {"never": lj.Holonomic(lambda t, q, p: q["x"] ** 2 + 1.0)})
    state = {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}
    with pytest.raises(ValueError, match="only 0 states were found"):
        lj.is_symmetry(nowhere, lj.Generator.shift("y"), *state, OF_STONE)
    undefined = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.log(-1.0 - q**2))
    with pytest.raises(ValueError, match="where L is not finite"):
        lj.is_symmetry(undefined, lj.Generator.shift("q"), 0.5, 0.5)


@pytest.mark.slow
def test_float32_and_a_force_that_reacts():
    """In float32 a rotation passes within round-off; Coulomb friction breaks the momentum at the predicted rate."""
    q, v = (x.astype(np.float32) for x in IN_SPACE)
    found = lj.is_symmetry(KEPLER, lj.Generator.rotation("z"), q, v, {"m": np.float32(1.25), "k": np.float32(2.0)})
    assert found and found.residual.dtype == np.float32
    friction = lambda t, q, v, multipliers, p: {"x": -p["mu"] * multipliers["table"], "y": 0.0}
    table = lj.Holonomic(lambda t, q, p: q["y"])
    box = lj.System(falling, {"table": table}, force=friction)
    slid = lj.is_symmetry(
        box, lj.Generator.shift("x"), {"x": 0.5, "y": 0.0}, {"x": 2.0, "y": 0.0}, OF_STONE | {"mu": 0.25}
    )
    assert not slid and slid.broken_by() == ["the forces"]
    np.testing.assert_allclose(slid.rate, -0.25 * OF_STONE["m"] * OF_STONE["g"], rtol=1e-12)
