"""Elimination without pivoting: as accurate as LAPACK, or marked as invalid."""

import jax
import numpy as np
import pytest

from lagjax.numerics.linalg.dense import Saddle


@jax.jit
def eliminated(mass, jacobian, forcing, gamma):
    """a, multipliers, and whether they are valid."""
    saddle = Saddle(mass, jacobian)
    return *saddle.solve(forcing, gamma), saddle.valid


def error_of(solution, matrix, known):
    """The backward error entry by entry: |K x - b| / (|K| |x| + |b|)."""
    return np.max(np.abs(matrix @ solution - known) / (np.abs(matrix) @ np.abs(solution) + np.abs(known)))


def whole(mass, jacobian):
    """The matrix of (a, -multipliers)."""
    m = len(jacobian)
    return np.block([[mass, jacobian.T], [jacobian, np.zeros((m, m))]])


RNG = np.random.default_rng(4)
SPREAD = np.diag([1.0, 1e-3, 1e5])
CASES = {
    "plain": (np.diag([1.0, 2.0, 3.0]) + 0.3, RNG.normal(size=(2, 3))),
    "masses from 1e-12 to 1e12": (np.diag([1e-12, 1.0, 1e12]), RNG.normal(size=(1, 3))),
    "units": (SPREAD @ (np.eye(3) + 0.4) @ SPREAD, RNG.normal(size=(2, 3)) @ SPREAD),
    "a light coordinate held": (np.diag([1.0, 1e-9, 1.0]), np.array([[0.0, 1.0, 1e-3]])),
    "negative": (-np.diag([1.0, 2.0, 3.0]) - 0.3, RNG.normal(size=(1, 3))),
    "Hilbert": (1 / (1.0 + np.add.outer(np.arange(3), np.arange(3))), RNG.normal(size=(1, 3))),
}


@pytest.mark.parametrize("name", CASES)
def test_as_accurate_as_lapack(name):
    """Backward error entry by entry: within a few units of round-off, as LAPACK's is, over the extremes."""
    mass, jacobian = CASES[name]
    forcing, gamma = RNG.normal(size=3), RNG.normal(size=len(jacobian))
    a, multipliers, valid = eliminated(mass, jacobian, forcing, gamma)
    matrix, known = whole(mass, jacobian), np.concatenate([forcing, gamma])
    assert valid
    ours = error_of(np.concatenate([a, -multipliers]), matrix, known)
    assert ours < 20 * np.finfo(float).eps + 2 * error_of(np.linalg.solve(matrix, known), matrix, known)


@pytest.mark.parametrize(
    ("mass", "jacobian"),
    [
        (np.diag([0.0, 1.0, 1.0]), np.array([[1.0, 1.0, 0.0]])),
        (np.diag([1.0, -1.0, 1.0]), np.array([[0.0, 1.0, 0.0]])),
        (np.eye(3), np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 1e-6]])),
        (np.eye(3), np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])),
    ],
    ids=["massless", "indefinite", "dependent", "vanishing"],
)
def test_not_believed(mass, jacobian):
    """If pivoting is needed the result is invalid but never NaN, which would spoil derivatives."""
    a, multipliers, valid = eliminated(mass, jacobian, np.ones(3), np.ones(len(jacobian)))
    assert not valid and np.all(np.isfinite(a)) and np.all(np.isfinite(multipliers))
