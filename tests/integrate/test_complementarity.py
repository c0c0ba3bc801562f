"""Contacts solved together against all cases tried one by one."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.integrate.complementarity import ContactProblem, solved


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
