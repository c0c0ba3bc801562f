"""Contacts whose forces are not unique: the shortest ones that obey the laws, against statics by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.elements.complementarity import ContactProblem, lengths
from lagjax.integrate.elements.in_modes import in_modes
from lagjax.integrate.elements.redundant import HeldRows, within_laws
from lagjax.system import State
from tests.integrate.elements.test_motions import moved

G, MU, BOX = 9.81, 0.5, (1.0, 1.0, 2 / 3)


def resting(rows, of_normals, mass, load, mu=MU, partners=None):
    """The forces of contacts that are all at rest under a load, with what is at its bound; normal rows first."""
    rows, of_normals = np.asarray(rows), np.asarray(of_normals)
    gaps, slips = len(rows) - len(of_normals), len(of_normals)
    partners = np.arange(slips) if partners is None else partners
    response = rows / np.asarray(mass)
    problem = ContactProblem(
        jnp.asarray(response @ rows.T), jnp.asarray(response @ np.asarray(load)), jnp.ones(gaps, bool),
        jnp.asarray(of_normals), jnp.zeros(slips), jnp.full(slips, mu), jnp.zeros(slips), partners,
    )  # fmt: skip
    held = HeldRows(jnp.asarray(rows), jnp.zeros((0, rows.shape[1])), jnp.zeros(0), jnp.zeros((len(rows), 0)))

    def holds(bound, solution):
        return jnp.concatenate([~bound.lifted, lengths(bound.leans, partners) == 0]), jnp.full(len(rows), 1e-9)

    bound, solution = within_laws(problem, held, holds)
    forces, excess = held.excess(bound.on(problem), holds(bound, solution)[0])
    assert solution.found and np.all(excess < 1e-9)
    return bound, forces


def beam(x: float):
    """The forces of supports at -1, 0 and 1 under a weight of one at x, of a beam with (y, angle)."""
    return resting(np.array([[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]), np.zeros((0, 3)), [1.0, 1.0], [-1.0, -x])


def test_a_beam_on_three_supports():
    """The shortest forces, 1/3 + s x/2 at the support s, until one of them would pull at x = 2/3: then the other two
    carry the beam. Twin: the shortest ones there."""
    bound, forces = beam(0.5)
    np.testing.assert_allclose(forces, np.array([1 / 12, 4 / 12, 7 / 12]), atol=1e-12)
    assert not np.any(bound.lifted)
    bound, forces = beam(0.9)
    np.testing.assert_allclose(forces, [0.0, 0.1, 0.9], atol=1e-12)
    assert np.asarray(bound.lifted).tolist() == [True, False, False] and 1 / 3 - 0.9 / 2 < -0.1


def corners(push: float, mu: float = MU):
    """The forces of a box on its corners at (±1, -1), pushed at its centre by a part of its weight."""
    rows = [[0.0, 1.0, -1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]
    return resting(rows, np.eye(2, 4), BOX, [push, -1.0, 0.0], mu)


def test_a_box_on_two_corners():
    """Each corner has half of the friction until the one that the push unloads, N = (1 - push)/2, has all that it can:
    μ N, and the other one the rest. Twin: half, which it cannot have."""
    for push, fraction in ((0.1, 0.05), (0.4, MU * 0.3)):
        bound, forces = corners(push)
        np.testing.assert_allclose(forces, [(1 - push) / 2, (1 + push) / 2, -fraction, fraction - push], atol=1e-12)
        assert bool(bound.leans[0]) == (fraction < push / 2)


def test_a_table_on_four_legs():
    """A table whose weight is off its centre, pushed obliquely, in a plane: forces obey Coulomb's law at each leg, and
    add up. Twin: without bounds a leg has more friction than it can."""
    legs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    still, every = np.zeros((4, 3)), np.ones(4)
    up = np.stack([every, legs[:, 1], -legs[:, 0]], axis=1)
    along = np.array([[[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in legs]).reshape(8, 3)
    rows = np.block([[up, still], [np.zeros((8, 3)), along]])
    presses, partners = np.repeat(np.eye(4, 12), 2, axis=0), np.arange(8) ^ 1
    load = np.array([-1.0, -0.3, 0.45, 0.25, 0.3, 0.0])
    bound, forces = resting(rows, presses, np.ones(6), load, partners=partners)
    normal, friction = np.asarray(forces[:4]), np.linalg.norm(np.reshape(forces[4:], (4, 2)), axis=1)
    np.testing.assert_allclose(rows.T @ forces, -load, atol=1e-9)
    assert np.all(normal > -1e-12) and np.all(friction < MU * normal + 1e-9)
    _, free = resting(rows, presses, np.ones(6), load, 100.0, partners)
    free = np.linalg.norm(np.reshape(free[4:], (4, 2)), axis=1)
    assert np.any(free > MU * normal + 1e-3) and np.any(lengths(bound.leans, partners) > 0)


LENGTH, HEIGHT = 1.0, 0.5
LOWEST = -np.arcsin(HEIGHT / LENGTH)


def rod() -> lj.System:
    """A pivoted rod above a floor below its pivot, which a torque that grows with time lifts."""

    def energy(t, q, v, p):
        return LENGTH**2 / 6 * v**2 - G * LENGTH / 2 * jnp.sin(q) + p["torque"] * t * q

    tip = lj.Contact(
        lambda t, q, p: HEIGHT + LENGTH * jnp.sin(q), friction=lambda p: p["mu"],
        sliding=lambda t, q, v, p: -LENGTH * jnp.sin(q) * v,
    )  # fmt: skip
    return lj.System(energy, elements=lj.Elements({"floor": tip}, most_switches=8))


def swung(p) -> lj.HybridTrajectory:
    """The rod let fall."""
    return moved(rod(), 0.5, 0.0, p, ts=jnp.array([0.0, 1.0, 4.0, 4.4]))


@pytest.mark.slow
def test_modes_of_an_arm_at_rest():
    """Two forces for one freedom: the shortest have the friction tan 30° N, which sticks, or is at its bound where that
    is above μ N. Twin: both coefficients."""
    for mu, mode in ((0.3, "is held by others"), (1.0, "sticks")):
        found = lj.explain(rod(), 0.0, LOWEST, 0.0, {"mu": mu, "torque": 1.0})
        assert dict(found.modes) == {"floor": "closed", "floor friction": mode}


@pytest.mark.exhaustive
def test_an_arm_of_one_freedom():
    """It rests from its first touch on, as its tip can neither slide nor lift, with N cos + μ N sin = (weight - torque)
    at the bound of friction, until the torque outweighs the weight. Twin: without friction N cos alone is that."""
    weight, up, across = G * LENGTH / 2 * np.cos(LOWEST), LENGTH * np.cos(LOWEST), -LENGTH * np.sin(LOWEST)
    found = {mu: swung({"mu": mu, "torque": 1.0}) for mu in (0.3, 0.0)}
    for mu, traj in found.items():
        assert len(traj.switches) == 2
        np.testing.assert_allclose(traj.q[1:3], LOWEST, atol=1e-12)
        np.testing.assert_allclose(traj.multipliers["floor"][1], (weight - 1.0) / (up + mu * across), rtol=1e-9)
        np.testing.assert_allclose(traj.switches.t[1], weight, rtol=1e-9)
    assert found[0.3].multipliers["floor"][1] < 0.9 * found[0.0].multipliers["floor"][1]
    # Where sticking needs less than μ N it has the shortest forces, along (up, across).
    traj = swung({"mu": 1.0, "torque": 1.0})
    both = [float(traj.multipliers[name][1]) for name in ("floor", "floor friction")]
    np.testing.assert_allclose(both, (weight - 1.0) / (up**2 + across**2) * np.array([up, across]), rtol=1e-9)


def pushed(p) -> lj.HybridTrajectory:
    """A box of edge 2 on its lower corners, pushed at its centre by p["push"] + p["rate"] t of its weight."""
    at = np.array([[-1.0, -1.0], [1.0, -1.0]])

    def places(q):
        c, s = jnp.cos(q["angle"]), jnp.sin(q["angle"])
        return q["x"] + c * at[:, 0] - s * at[:, 1], q["y"] + s * at[:, 0] + c * at[:, 1]

    def energy(t, q, v, p):
        kinetic = (v["x"] ** 2 + v["y"] ** 2 + BOX[2] * v["angle"] ** 2) / 2
        return kinetic - G * q["y"] + (p["push"] + p["rate"] * t) * G * q["x"]

    floor = lj.Contact(
        lambda t, q, p: places(q)[1], friction=MU,
        sliding=lambda t, q, v, p: jax.jvp(lambda q: places(q)[0], (q,), (v,))[1],
    )  # fmt: skip
    box = lj.System(energy, elements=lj.Elements({"floor": floor}, most_switches=8))
    still = {name: 0.0 for name in ("x", "y", "angle")}
    return moved(box, still | {"y": 1.0}, still, p, ts=jnp.array([0.0, 1.0, 1.9, 3.0]))


@pytest.mark.exhaustive
def test_a_box_that_is_pushed():
    """It slides where the push exceeds μ of the weight, at t = 2, and not before, whatever corner has all the friction
    that it can, from t = 4/3 on; or at t = 3.8 to the other side. Twin: a corner with half of the friction."""
    traj = pushed({"push": 0.0, "rate": 0.25})
    np.testing.assert_allclose(traj.switches.t[:2], [4 / 3, 2.0], rtol=1e-9)
    np.testing.assert_allclose(traj.q["x"], [0.0, 0.0, 0.0, 0.25 * G / 6], atol=1e-12)
    carried = float(jnp.sum(traj.multipliers["floor friction"][2])) - MU * float(traj.multipliers["floor"][2, 0])
    np.testing.assert_allclose(carried, -1.9 * 0.25 * G, rtol=1e-9)
    back = pushed({"push": 0.45, "rate": -0.25})
    assert np.asarray(back.modes[0])[2:].tolist() == [3, 2] and float(back.q["x"][-1]) == 0.0
    np.testing.assert_allclose(back.multipliers["floor"][0], G * np.array([0.55, 1.45]) / 2, rtol=1e-9)


def brake() -> lj.System:
    """A block on a rail along y, pushed across it, with a brake along a line that turns from across to along it."""

    def energy(t, q, v, p):
        return (v[0] ** 2 + v[1] ** 2) / 2 + p["across"] * q[0] + p["along"] * q[1]

    turning = lj.Friction(lambda t, q, v, p: jnp.cos(t) * v[0] + jnp.sin(t) * v[1], 0.3, normal=1.0)
    rail = {"rail": lj.Holonomic(lambda t, q, p: q[0])}
    return lj.System(energy, rail, elements=lj.Elements({"brake": turning}, most_switches=8))


def test_what_others_hold_lasts_while_it_is_still():
    """Its guard is above zero up to its slack's size, whatever the direction of that, and below zero beyond twice it.
    Twin: in mode 2, 0.3 less the force, of which the velocity is no part."""
    start = State(jnp.asarray(0.3), jnp.zeros(2), jnp.zeros(2), {"across": 1.0, "along": 0.0})
    _, laws = in_modes(brake(), start)
    given = {mode: laws.given(start.params, jnp.array([mode]), jnp.array([-0.1])) for mode in (2, 3)}
    force = {"rail": jnp.zeros(()), "brake": jnp.asarray(0.05)}

    def guard(mode, slip):
        v = jnp.array([0.0, slip / np.sin(0.3)])
        return float((laws.last(start.t, start.q, v, force, given[mode]) + laws.slack(given[mode]))[0])

    np.testing.assert_allclose([guard(3, slip) for slip in (0.0, 0.1, -0.3)], [0.2, 0.1, -0.1], atol=1e-12)
    np.testing.assert_allclose([guard(2, slip) for slip in (0.0, -0.3)], 0.3 - 0.05 - 0.1, atol=1e-12)


@pytest.mark.exhaustive
def test_what_others_hold_no_more():
    """The rail holds the brake at first; as that turns, it sticks, or slides where it is pushed, with the force
    μ sin t: v = push t - μ (1 - cos t) until sin t = push/μ. Twin: the brake drives the block with μ sin t.

    Between outputs `traj.at` has no forces while others hold it.
    """
    system, ts, zero = brake(), jnp.array([0.0, 0.5, 1.5]), np.zeros(2)
    for across, along in ((1.0, 0.0), (-1.0, 0.0), (1.0, 0.1), (-1.0, 0.1)):
        given = {"across": across, "along": along}
        traj = lj.integrate(system, zero, zero, given, ts=ts, rtol=1e-10, estimate_error=False)
        assert isinstance(traj, lj.HybridTrajectory)
        assert np.ravel(traj.modes).tolist() == [3, 1 if along else 2, 2]
        slid = along * 0.5 - 0.3 * (1 - np.cos(0.5)) if along else 0.0
        np.testing.assert_allclose(traj.v[:, 1], [0.0, slid, 0.0], atol=1e-7)
        np.testing.assert_allclose(traj.multipliers["rail"][0], -across + 0.3 * np.sign(across), atol=1e-9)
        assert np.isnan(traj.at(1e-6).multipliers["rail"]) and np.isfinite(traj.at(0.4).multipliers["rail"])
    assert 0.3 * (1 - np.cos(0.5)) > 0.01
