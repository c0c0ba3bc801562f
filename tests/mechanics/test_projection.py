"""The way back to the constraints: velocity constraints leave positions, and a rolling body rolls."""

import numpy as np

from lagjax.mechanics.constrained_state import to_manifold
from lagjax.mechanics.equations import equations_of
from lagjax.system.model import model_of
from tests.behaviour.test_nonholonomic import (
    COIN,
    DISK,
    ROUND_OFF,
    coin_state,
    contact_at_rest,
    tilting_disk,
    touches,
    vertical_disk,
)
from tests.by_numpy import by_numpy


def test_returning_to_a_velocity_constraint_leaves_positions():
    """Without a position constraint q is unchanged bit for bit; v moves to the nearest rolling one by the metric M."""
    rng = np.random.default_rng(3)
    x, u = rng.normal(size=(2, 4))
    names = ("angle", "heading", "x", "y")
    q, v = dict(zip(names, x)), dict(zip(names, u))
    state = 0.0, q, v
    projected = to_manifold(equations_of(model_of(vertical_disk, *state, DISK)), *state, 1e-12, 1e-12)
    assert [float(projected.q[name]).hex() for name in names] == [float(q[name]).hex() for name in names]
    mass, radius = np.diag([DISK["I"], DISK["J"], DISK["m"], DISK["m"]]), DISK["R"]
    rows = np.array([[-radius * np.cos(x[1]), 0, 1, 0], [-radius * np.sin(x[1]), 0, 0, 1]])
    nearest = u - np.linalg.solve(mass, rows.T @ np.linalg.solve(rows @ np.linalg.solve(mass, rows.T), rows @ u))
    np.testing.assert_allclose(np.stack(list(projected.v.values())), nearest, atol=1e-14)
    assert np.max(np.abs(nearest - u)) > 0.1


def test_returning_to_the_plane_rolls():
    """With both kinds of constraint, positions move only as rolling allows: a lifted disk does not slide."""
    q, v = coin_state(COIN, 0.25, 1.25, 0.375, 1.5, -6.0)
    lifted = q | {"z": q["z"] + 1e-4}
    state = 0.0, lifted, v
    moved = to_manifold(equations_of(model_of(tilting_disk, *state, COIN)), *state, 1e-12, 1e-12).q
    step = {name: float(moved[name]) - lifted[name] for name in q}
    at_rest = by_numpy(contact_at_rest)
    slid = at_rest(0.0, lifted, step, COIN)
    assert abs(by_numpy(touches)(0.0, moved, COIN)) < ROUND_OFF
    assert np.max(np.abs(slid)) < 1e-14
    # The nearest point of the plane alone, by tilting and lowering in place, would have slid.
    row = np.array([-COIN["R"] * np.cos(q["tilt"]), 1.0])
    in_place = row / np.array([COIN["I1"], COIN["m"]])
    in_place = in_place / (row @ in_place)
    sliding = at_rest(0.0, lifted, {name: 0.0 for name in q} | {"tilt": in_place[0] * -1e-4}, COIN)
    assert np.max(np.abs(sliding)) > 1e-5
