"""Contacts solved together against all cases tried one by one.

Contacts whose forces are not unique: the shortest ones that obey the laws, against statics by hand.
"""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.complementarity import ContactProblem, HeldRows, solved, within_laws
from lagjax.integrate.elements import in_modes
from lagjax.integrate.laws import lengths
from lagjax.system import State
from tests.integrate.elements.test_motions import moved


def by_cases(matrix, free, mu):
    """All solutions of contacts that slide along one line each, tangential forces last: every case is solved."""
    count = len(mu)
    found = []
    for case in product(("open", "stick", 1.0, -1.0), repeat=count):
        rows, known = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
        for i, mode in enumerate(case):
            n, t = i, count + i
            if mode == "open":
                rows[n, n] = rows[t, t] = 1.0
                continue
            rows[n], known[n] = matrix[n], -free[n]
            if mode == "stick":
                rows[t], known[t] = matrix[t], -free[t]
            else:
                rows[t, t], rows[t, n] = 1.0, mode * mu[i]
        forces = np.linalg.solve(rows, known)
        a, tol = matrix @ forces + free, 1e-9
        obeys = []
        for i, mode in enumerate(case):
            n, t = i, count + i
            obeys.append(a[n] > -tol if mode == "open" else forces[n] > -tol)
            if mode == "stick":
                obeys.append(abs(forces[t]) <= mu[i] * forces[n] + tol)
            elif mode != "open":
                obeys.append(mode * a[t] > -tol)
        if all(obeys):
            found.append(forces)
    return found


def random_problems(count: int, lanes: int, mu: float):
    """W, b and μ of random contacts, one system in each lane."""
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(lanes, 2 * count, 2 * count + 1))
    matrix = rows @ np.swapaxes(rows, 1, 2)
    return matrix, rng.normal(size=(lanes, 2 * count)), np.full((lanes, count), mu)


@jax.jit
@jax.vmap
def forces_of(matrix, free, mu, slides):
    """The forces of contacts that may all push, and whether they are found."""
    count = mu.size
    may_push, none = jnp.ones(count, bool), jnp.zeros(count)
    problem = ContactProblem(matrix, free, may_push, jnp.eye(count, 2 * count), none, mu, slides, np.arange(count))
    return solved(problem)


LANES = 40


@pytest.mark.parametrize("count", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_against_all_cases(count):
    """Forces of random contacts with friction are one of the solutions that exist. Twin: with less friction, not."""
    matrix, free, mu = random_problems(count, LANES, 0.3)
    forces, well = map(np.asarray, forces_of(matrix, free, mu, 0.0 * mu))
    pushed = 0
    for k in range(LANES):
        cases = by_cases(matrix[k], free[k], mu[k])
        assert well[k] == bool(cases), k
        if not cases:
            continue
        scale = 1 + np.max(np.abs(cases[0]))
        assert min(np.max(np.abs(forces[k] - case)) for case in cases) < 1e-8 * scale, k
        other = by_cases(matrix[k], free[k], 0.5 * mu[k])
        pushed += np.any(np.abs(cases[0]) > 1e-9) and all(np.max(np.abs(forces[k] - x)) > 1e-6 * scale for x in other)
    assert pushed > 5


def test_dependent_contacts():
    """A beam on three smooth supports: forces that carry it, of many."""
    arms, load = np.array([[1.0, 1.0], [1.0, 0.0], [1.0, -1.0]]), np.array([-9.81, 2.0])
    matrix, free = np.zeros((LANES, 6, 6)), np.zeros((LANES, 6))
    matrix[:, :3, :3], free[:, :3] = arms @ arms.T, arms @ load
    forces, well = forces_of(matrix, free, np.zeros((LANES, 3)), np.zeros((LANES, 3)))
    assert np.all(well)
    np.testing.assert_allclose(np.asarray(forces)[0, :3] @ arms, -load, atol=1e-10)


def test_no_solution():
    """Friction that pushes a contact together harder than it pushes apart: no forces are found (Painlevé), beside two
    contacts that are open. Twin: less friction."""
    matrix, free = np.tile(np.eye(6), (LANES, 1, 1)), np.tile([-1.0, 1.0, 1.0, 0.0, 0.0, 0.0], (LANES, 1))
    matrix[:, [0, 0, 3, 3], [0, 3, 0, 3]] = [1.0, -2.0, -2.0, 5.0]
    mu, slides = np.tile([1.0, 0.0, 0.0], (LANES, 1)), np.tile([-1.0, 0.0, 0.0], (LANES, 1))
    mu[1:, 0] = 0.3
    assert np.asarray(forces_of(matrix, free, mu, slides)[1]).tolist() == [False] + 39 * [True]


def test_excess_by_round_off():
    """Friction that would have to exceed μ N by 1e-13 of it slides: it has μ N to the last digits. Twin: what it would
    have to be."""
    matrix, _, mu = random_problems(3, LANES, 0.3)
    wanted = np.tile([1.0, 2.0, 1.5, 0.3 * (1 + 1e-13), 0.1, -0.2], (LANES, 1))
    forces, well = map(np.asarray, forces_of(matrix, -np.einsum("kij,kj->ki", matrix, wanted), mu, 0.0 * mu))
    beyond = forces[:, 3] / (0.3 * forces[:, 0]) - 1
    assert np.sum(well) > LANES / 2 and np.all(beyond[well] < 2e-15) and wanted[0, 3] / 0.3 - 1 > 5e-14


def test_a_gap_beside_friction_at_its_most():
    """What rubs gives by a part of 1e-16 to 1e-9 of μ N, and a gap opens: it has no force at all, of whatever size the
    others are. Twin: the force that would hold both pulls."""
    matrix, beyond = np.tile(np.eye(6), (LANES, 1, 1)), 10.0 ** np.linspace(-16, -9, LANES)
    # Two bodies of masses 1 and 0.2 that touch; the first is pulled off, and rubs under the third gap.
    matrix[:, [0, 0, 5, 5], [0, 5, 0, 5]] = [6.0, 1.0, 1.0, 1.0]
    free = np.zeros((LANES, 6))
    pull = 0.3 * (1 + beyond)
    free[:, 2], free[:, [0, 5]] = -1.0, pull[:, None]
    for size in (1.0, 1e7, 1e-255):
        forces, well = map(np.asarray, forces_of(matrix, size * free, np.full((LANES, 3), 0.3), np.zeros((LANES, 3))))
        assert np.all(well) and np.all(forces[:, 0] == 0) and np.all(forces[:, 2] == size)
        np.testing.assert_allclose(forces[:, 5] / size, -0.3, rtol=4e-16)
    assert np.all(0.3 - pull[-30:] < 0)


G, MU, BOX = 9.81, 0.5, (1.0, 1.0, 2 / 3)


@partial(jax.jit, static_argnums=5)
def in_bounds(matrix, free, rows, of_normals, mu, partners):
    """Of contacts that are all at rest: what is at its bound, whether forces are found, these, and how they exceed."""
    partners, (slips, k) = np.array(partners, int), of_normals.shape
    may_push, zero = jnp.ones(k - slips, bool), jnp.zeros(slips)
    problem = ContactProblem(matrix, free, may_push, of_normals, zero, zero + mu, zero, partners)
    held = HeldRows(rows, jnp.zeros((0, rows.shape[1])), jnp.zeros(0), jnp.zeros((k, 0)))

    def holds(bound, solution):
        a, leans = matrix @ solution.forces + free, lengths(bound.leans, partners) > 0
        gaps, slides = k - slips, jnp.where(jnp.abs(a) > 1e-12, jnp.sign(a), 0.0)[k - slips :]
        on = jnp.concatenate([~bound.lifted, ~leans & (slides == 0)])
        return on, jnp.array([1e-10] * gaps + [1e-9] * slips), bound.lifted & (a < -1e-12)[:gaps], slides

    bound, solution = within_laws(problem, held, holds)
    leans = lengths(bound.leans, partners) > 0
    return bound.lifted, leans, solution.found, *held.excess(bound.on(problem), holds(bound, solution)[0])


def resting(rows, of_normals, load, mass=1.0, mu=MU, partners=()):
    """The forces under a load, which gaps are lifted, and which frictions are at their bound; normal rows first."""
    rows = np.asarray(rows)
    found = in_bounds(rows / mass @ rows.T, rows / mass @ np.asarray(load), rows, of_normals, mu, partners)
    lifted, leans, solved, forces, excess = map(np.asarray, found)
    assert solved and np.all(excess < 1e-9)
    return forces, lifted, leans


def test_a_beam_on_three_supports():
    """The shortest forces, 1/3 + s x/2 at the support s, until one of them would pull at x = 2/3: then the other two
    carry the beam. Twin: the shortest ones there."""
    supports = [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    for x, wanted, up in ((0.5, [1 / 12, 4 / 12, 7 / 12], [False] * 3), (0.9, [0.0, 0.1, 0.9], [True, False, False])):
        forces, lifted, _ = resting(supports, np.zeros((0, 3)), [-1.0, -x])
        np.testing.assert_allclose(forces, wanted, atol=1e-12)
        assert lifted.tolist() == up and (1 / 3 - x / 2 < 0) == any(up)


def test_a_box_on_two_corners():
    """Each corner has half of the friction until the one that the push unloads, N = (1 - push)/2, has all that it can:
    μ N, and the other one the rest. Twin: half, which it cannot have."""
    corners = [[0.0, 1.0, -1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]
    for push, fraction in ((0.1, 0.05), (0.4, MU * 0.3)):
        forces, _, leans = resting(corners, np.eye(2, 4), [push, -1.0, 0.0], np.array(BOX), partners=(0, 1))
        np.testing.assert_allclose(forces, [(1 - push) / 2, (1 + push) / 2, -fraction, fraction - push], atol=1e-12)
        assert leans[0] == (fraction < push / 2)


def test_a_gap_that_would_close():
    """Two blocks side by side, each on its own normal force, of which the first is pulled to the second by a little
    more than its friction holds: the gap between them carries that, though among the shortest forces it pulls. Twin:
    a little less, and nothing is at its bound but the gap, which has no force."""
    first, between, second = [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    rows = [first, between, second, [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    presses = np.eye(5)[[0, 2]]
    for over in (1e-10, -1e-10):
        forces, lifted, leans = resting(rows, presses, [MU + over, -1.0, 2.0, -8.0], partners=(0, 1))
        held = max(over, 0.0)
        np.testing.assert_allclose(forces, [1.0, held, 8.0, held - MU - over, -2.0 - held], atol=1e-12)
        assert lifted.tolist() == [False, over < 0, False] and leans.tolist() == [over > 0, False]


def test_a_table_on_four_legs():
    """A table whose weight is off its centre, pushed obliquely, in a plane: forces obey Coulomb's law at each leg, and
    add up. Twin: without bounds a leg has more friction than it can."""
    legs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    up = np.stack([np.ones(4), legs[:, 1], -legs[:, 0]], axis=1)
    along = np.array([[[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in legs]).reshape(8, 3)
    rows = np.block([[up, np.zeros((4, 3))], [np.zeros((8, 3)), along]])
    presses, partners = np.repeat(np.eye(4, 12), 2, axis=0), tuple(np.arange(8) ^ 1)
    load = np.array([-1.0, -0.3, 0.45, 0.25, 0.3, 0.0])
    (forces, _, leans), (free, *_) = (resting(rows, presses, load, 1.0, mu, partners) for mu in (MU, 100.0))
    normal, friction, unbound = forces[:4], *(np.linalg.norm(x[4:].reshape(4, 2), axis=1) for x in (forces, free))
    np.testing.assert_allclose(rows.T @ forces, -load, atol=1e-9)
    assert np.all(normal > -1e-12) and np.all(friction < MU * normal + 1e-9)
    assert np.any(unbound > MU * normal + 1e-3) and np.any(leans)


LENGTH, HEIGHT = 1.0, 0.5
LOWEST = -np.arcsin(HEIGHT / LENGTH)


tip = lj.Contact(
    lambda t, q, p: HEIGHT + LENGTH * jnp.sin(q), friction=lambda p: p["mu"],
    sliding=lambda t, q, v, p: -LENGTH * jnp.sin(q) * v,
)  # fmt: skip
# A pivoted rod above a floor below its pivot, which a torque that grows with time lifts.
rod = lj.System(
    lambda t, q, v, p: LENGTH**2 / 6 * v**2 - G * LENGTH / 2 * jnp.sin(q) + p["torque"] * t * q,
    elements=lj.Elements({"floor": tip}, most_switches=8),
)


@pytest.mark.exhaustive
def test_modes_of_an_arm_at_rest():
    """Two forces for one freedom: the shortest have the friction tan 30° N, which sticks, or is at its bound where that
    is above μ N. Twin: both coefficients."""
    for mu, mode in ((0.3, "is held by others"), (1.0, "sticks")):
        found = lj.explain(rod, 0.0, LOWEST, 0.0, {"mu": mu, "torque": 1.0})
        assert dict(found.modes) == {"floor": "closed", "floor friction": mode}


@pytest.mark.exhaustive
def test_an_arm_of_one_freedom():
    """It rests from its first touch on, as its tip can neither slide nor lift, with N cos + μ N sin = (weight - torque)
    at the bound of friction, until the torque outweighs the weight. Twin: without friction N cos alone is that."""
    weight, up, across = G * LENGTH / 2 * np.cos(LOWEST), LENGTH * np.cos(LOWEST), -LENGTH * np.sin(LOWEST)
    ts, rests = jnp.array([0.0, 1.0, 4.0, 4.4]), {}
    swung = lambda mu: moved(rod, 0.5, 0.0, {"mu": mu, "torque": 1.0}, ts=ts)
    for mu in (0.3, 0.0):
        traj = rests[mu] = swung(mu)
        assert len(traj.switches) == 2
        np.testing.assert_allclose(traj.q[1:3], LOWEST, atol=1e-12)
        np.testing.assert_allclose(traj.multipliers["floor"][1], (weight - 1.0) / (up + mu * across), rtol=1e-9)
        np.testing.assert_allclose(traj.switches.t[1], weight, rtol=1e-9)
    assert rests[0.3].multipliers["floor"][1] < 0.9 * rests[0.0].multipliers["floor"][1]
    # Where sticking needs less than μ N it has the shortest forces, along (up, across).
    traj = swung(1.0)
    both = [float(traj.multipliers[name][1]) for name in ("floor", "floor friction")]
    np.testing.assert_allclose(both, (weight - 1.0) / (up**2 + across**2) * np.array([up, across]), rtol=1e-9)


@pytest.mark.exhaustive
def test_a_box_that_is_pushed():
    """A box of edge 2 on its lower corners, pushed at its centre by a growing part of its weight, slides where that
    exceeds μ, at t = 2, and not before, whatever corner has all the friction that it can, from t = 4/3 on; or at
    t = 3.8 to the other side. Twin: a corner with half of the friction."""

    def corners(q):
        c, s = jnp.cos(q["angle"]), jnp.sin(q["angle"])
        return q["x"] + c * jnp.array([-1.0, 1.0]) + s, q["y"] + s * jnp.array([-1.0, 1.0]) - c

    def energy(t, q, v, p):
        kinetic = (v["x"] ** 2 + v["y"] ** 2 + BOX[2] * v["angle"] ** 2) / 2
        return kinetic - G * q["y"] + (p["push"] + p["rate"] * t) * G * q["x"]

    floor = lj.Contact(
        lambda t, q, p: corners(q)[1], friction=MU,
        sliding=lambda t, q, v, p: jax.jvp(lambda q: corners(q)[0], (q,), (v,))[1],
    )  # fmt: skip
    box = lj.System(energy, elements=lj.Elements({"floor": floor}, most_switches=8))
    still, ts = {"x": 0.0, "y": 0.0, "angle": 0.0}, jnp.array([0.0, 1.0, 1.9, 3.0])
    pushed = lambda push, rate: moved(box, still | {"y": 1.0}, still, {"push": push, "rate": rate}, ts=ts)
    traj = pushed(0.0, 0.25)
    np.testing.assert_allclose(traj.switches.t[:2], [4 / 3, 2.0], rtol=1e-9)
    np.testing.assert_allclose(traj.q["x"], [0.0, 0.0, 0.0, 0.25 * G / 6], atol=1e-12)
    carried = float(jnp.sum(traj.multipliers["floor friction"][2])) - MU * float(traj.multipliers["floor"][2, 0])
    np.testing.assert_allclose(carried, -1.9 * 0.25 * G, rtol=1e-9)
    back = pushed(0.45, -0.25)
    assert np.asarray(back.modes[0])[2:].tolist() == [3, 2] and float(back.q["x"][-1]) == 0.0
    np.testing.assert_allclose(back.multipliers["floor"][0], G * np.array([0.55, 1.45]) / 2, rtol=1e-9)


# A block on a rail along y, pushed across it, with a brake along a line that turns from across to along it.
turning = lj.Friction(lambda t, q, v, p: jnp.cos(t) * v[0] + jnp.sin(t) * v[1], 0.3, normal=1.0)
brake = lj.System(
    lambda t, q, v, p: (v[0] ** 2 + v[1] ** 2) / 2 + p["across"] * q[0] + p["along"] * q[1],
    {"rail": lj.Holonomic(lambda t, q, p: q[0])},
    elements=lj.Elements({"brake": turning}, most_switches=8),
)


def test_what_others_hold_lasts_while_it_is_still():
    """Its guard is above zero up to its slack's size, whatever the direction of that, and below zero beyond twice it.
    Twin: in mode 2, 0.3 less the force, of which the velocity is no part."""
    given, still = {"across": np.array(1.0), "along": np.array(0.0)}, np.zeros(2)
    start = State(np.array(0.3), still, still, given)
    _, laws = in_modes(brake, start)
    force = {"rail": np.zeros(()), "brake": np.array(0.05)}

    @jax.jit
    @jax.vmap
    def guards(mode, slip):
        here = laws.given(given, jnp.array([mode]), jnp.array([-0.1]))
        v = jnp.stack([0.0 * slip, slip / jnp.sin(0.3)])
        return (laws.last(start.t, start.q, v, force, here) + laws.slack(here))[0]

    found = guards(np.array([3, 3, 3, 2, 2]), np.array([0.0, 0.1, -0.3, 0.0, -0.3]))
    np.testing.assert_allclose(found, [0.2, 0.1, -0.1, 0.15, 0.15], atol=1e-12)


@pytest.mark.exhaustive
def test_what_others_hold_no_more():
    """The rail holds the brake at first; as that turns, it sticks, or slides where it is pushed, with the force
    μ sin t: v = push t - μ (1 - cos t) until sin t = push/μ. Twin: the brake drives the block with μ sin t.

    Between outputs `traj.at` has no forces while others hold it.
    """
    for across, along in ((1.0, 0.0), (-1.0, 0.0), (1.0, 0.1), (-1.0, 0.1)):
        given, ts = {"across": across, "along": along}, jnp.array([0.0, 0.5, 1.5])
        traj = moved(brake, np.zeros(2), np.zeros(2), given, ts=ts, rtol=1e-10)
        assert np.ravel(traj.modes).tolist() == [3, 1 if along else 2, 2]
        slid = along * 0.5 - 0.3 * (1 - np.cos(0.5)) if along else 0.0
        np.testing.assert_allclose(traj.v[:, 1], [0.0, slid, 0.0], atol=1e-7)
        np.testing.assert_allclose(traj.multipliers["rail"][0], -across + 0.3 * np.sign(across), atol=1e-9)
        assert np.isnan(traj.at(1e-6).multipliers["rail"]) and np.isfinite(traj.at(0.4).multipliers["rail"])
    assert 0.3 * (1 - np.cos(0.5)) > 0.01
