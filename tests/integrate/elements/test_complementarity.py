"""Contacts solved together against all cases tried one by one."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.integrate.elements.complementarity import ContactProblem, solved


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


def problem_of(matrix, free, mu):
    """The problem in which all contacts may push."""
    count = mu.size
    return ContactProblem(
        matrix, free, jnp.ones(count, bool), jnp.eye(count, 2 * count), jnp.zeros(count), mu, jnp.zeros(count),
        np.arange(count),
    )  # fmt: skip


@pytest.mark.parametrize("count", [1, 3])
def test_against_all_cases(count):
    """Forces of random contacts with friction are one of the solutions that exist. Twin: with less friction, not."""
    matrix, free, mu = random_problems(count, 40, 0.3)
    forces, well = jax.vmap(lambda *x: solved(problem_of(*x)))(*map(jnp.asarray, (matrix, free, mu)))
    pushed = 0
    for k in range(len(free)):
        cases = by_cases(matrix[k], free[k], mu[k])
        if not cases:
            assert not well[k]
            continue
        assert well[k]
        scale = 1 + np.max(np.abs(cases[0]))
        assert min(np.max(np.abs(forces[k] - case)) for case in cases) < 1e-8 * scale
        if np.any(np.abs(cases[0]) > 1e-9):
            pushed += 1
            other = by_cases(matrix[k], free[k], 0.5 * mu[k])
            differs = [np.max(np.abs(forces[k] - case)) > 1e-6 * scale for case in other]
            pushed -= not all(differs)
    assert pushed > 5


def test_dependent_contacts():
    """A table on four legs: forces that carry it, the shortest ones of many, and their sum."""
    arms = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [1.0, -1.0, -1.0]])
    empty = np.zeros((0, 4))
    problem = ContactProblem(
        jnp.asarray(arms @ arms.T),
        jnp.full(4, -9.81),
        jnp.ones(4, bool),
        jnp.asarray(empty),
        *[jnp.zeros(0)] * 3,
        np.arange(0),
    )
    forces, well = solved(problem)
    assert well
    np.testing.assert_allclose(arms.T @ forces, [9.81, 0.0, 0.0], atol=1e-10)


def test_no_solution():
    """Friction that pushes a contact together harder than it pushes apart: no forces are found (Painlevé)."""
    matrix = jnp.array([[1.0, -2.0], [-2.0, 5.0]])
    sliding = ContactProblem(
        matrix, jnp.array([-1.0, 0.0]), jnp.ones(1, bool), jnp.eye(1, 2), jnp.zeros(1), jnp.array([1.0]),
        jnp.array([-1.0]), np.arange(1),
    )  # fmt: skip
    assert not solved(sliding)[1]
    assert solved(sliding._replace(coefficient=jnp.array([0.3])))[1]
