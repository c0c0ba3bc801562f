"""Noether's charges against closed forms, tests of symmetries, and the rates of broken charges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import cross_rails, sliding_wedge
from tests.symmetric_systems import DISK, IN_SPACE, KEPLER, OF_KEPLER, OF_STONE, ON_PLANE, RADIUS, falling, rolling


@pytest.mark.exhaustive
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


@pytest.mark.slow
def test_in_lanes():
    """A rotation is a symmetry of two springs only at the ratio one, to round-off; else the rate is (k_x - k_y) x y."""
    system = lj.System(lambda t, q, v, p: 0.5 * v @ v - 0.5 * (q[0] ** 2 + p["ratio"] * q[1] ** 2))
    state, ratio = (np.array([1.0, 0.5]), np.array([0.25, 0.125])), np.array([0.5, 1.0, 2.0])
    turned = lambda ratio: lj.is_symmetry(system, lj.Generator.rotation("z"), *state, {"ratio": ratio})
    found = jax.vmap(turned)(ratio)
    assert found.residual[1] < 1e-14 and min(found.residual[0], found.residual[2]) > 0.1
    np.testing.assert_allclose(found.rate, (1.0 - ratio) * 0.5, atol=1e-14)
    assert found.holds.tolist() == [False, True, False] and "1 of 3 lanes" in repr(found)


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


@pytest.mark.slow
def test_float32_and_a_force_that_reacts():
    """In float32 a rotation passes within round-off; Coulomb friction breaks the momentum at the predicted rate."""
    q, v = (x.astype(np.float32) for x in IN_SPACE)
    params = {name: np.float32(x) for name, x in OF_KEPLER.items()}
    found = lj.is_symmetry(KEPLER, lj.Generator.rotation("z"), q, v, params)
    assert found and found.residual.dtype == np.float32
    all_of_them = lj.symmetries(KEPLER, q, v, params)
    assert list(all_of_them) == ["L_x", "L_y", "L_z", "Jacobi integral"] and 1e3 < all_of_them.gap < 1e8
    friction = lambda t, q, v, multipliers, p: {"x": -p["mu"] * multipliers["table"], "y": 0.0}
    table = lj.Holonomic(lambda t, q, p: q["y"])
    box = lj.System(falling, {"table": table}, force=friction)
    slid = lj.is_symmetry(
        box, lj.Generator.shift("x"), {"x": 0.5, "y": 0.0}, {"x": 2.0, "y": 0.0}, OF_STONE | {"mu": 0.25}
    )
    assert not slid and slid.broken_by() == ["the forces"]
    np.testing.assert_allclose(slid.rate, -0.25 * OF_STONE["m"] * OF_STONE["g"], rtol=1e-12)


@pytest.mark.slow
def test_no_states_on_the_constraints():
    """An error says that no state satisfies the constraints."""
    nowhere = lj.System(falling, {"never": lj.Holonomic(lambda t, q, p: q["x"] ** 2 + 1.0)})
    state = {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}
    with pytest.raises(ValueError, match="only 0 states were found"):
        lj.is_symmetry(nowhere, lj.Generator.shift("y"), *state, OF_STONE)
