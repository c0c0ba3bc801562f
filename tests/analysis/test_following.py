"""Following a branch, on curves in the plane: its ends, its folds, and what only shows between its points."""

from functools import partial

import numpy as np
import pytest

from lagjax.analysis.arclength import NUMBER, Along, BranchPoint, BranchProblem, Monitor, sign_changes, zero
from lagjax.analysis.following import BranchFollower

TURN = lambda point: point.tangent[-1]
FOLDS = Monitor(TURN, sign_changes, partial(zero, "fold", TURN))


class Curve(BranchProblem):
    """The points (y, μ) where a function is zero; it returns its gradient too."""

    def __init__(self, function, low, high, monitors=(FOLDS,)):
        super().__init__(low, high)
        self.function, self.monitors, self.frame = function, monitors, None
        self.along, self.weights, self.positions = Along("mu", NUMBER), np.ones(2), 1
        self.dtype, self.unit = np.dtype(float), 1.0

    def residual(self, z):
        value, gradient = self.function(*z)
        return np.array([value]), np.array([gradient]), abs(value)

    def described(self, z, jacobian, tangent):
        return BranchPoint(z, jacobian, tangent, 1.0, None, 0)


def followed(curve, start, towards, most=1000):
    """The branch from a start, and its critical points."""
    run = BranchFollower(curve, most)
    run.follow(curve.begin(np.array(start), towards))
    return run.paths[0], run.found


PARABOLA = lambda y, mu: (y**2 + mu - 1, [2 * y, 1.0])
CIRCLE = lambda y, mu: (y**2 + mu**2 - 1, [2 * y, 2 * mu])
HYPERBOLA = lambda y, mu: (y * (1 - mu) - 1, [1 - mu, -y])
STRAIGHT = lambda y, mu: (y, [1.0, 0.0])


@pytest.mark.parametrize(
    "curve, start, low, ends, folds",
    [
        (PARABOLA, (-1.0, 0.0), -1.0, "the end of the range", [1.0]),
        (CIRCLE, (-1.0, 0.0), -2.0, "closed", [1.0, -1.0]),
        (HYPERBOLA, (2.0, 0.5), 0.0, "infinity, near mu = 0.9999", []),
        (STRAIGHT, (0.0, 0.0), 0.0, "the end of the range", []),
    ],
)
def test_how_a_branch_ends(curve, start, low, ends, folds):
    """At the end of the range, to round-off; where it began; at infinity. All folds between are found."""
    path, found = followed(Curve(curve, low, 2.0), start, 1.0)
    assert path.status.startswith(ends)
    np.testing.assert_allclose([c.z[-1] for c in found], folds, rtol=1e-12)
    assert [c.kind for c in found] == ["fold"] * len(folds) and path.through == set(range(len(folds)))
    assert [p.critical for p in path.points if p.critical is not None] == list(range(len(folds)))
    np.testing.assert_allclose([curve(*p.z)[0] for p in path.points], 0.0, atol=1e-10)
    if ends == "the end of the range":
        assert np.min(np.abs(path.points[-1].z[-1] - np.array([low, 2.0]))) < 1e-14


def test_so_many_points():
    """A branch has as many points as were asked for, and says so."""
    path, _ = followed(Curve(STRAIGHT, 0.0, 2.0), (0.0, 0.0), 1.0, 7)
    assert len(path.points) == 7 and path.status == "the limit of 7 points"


@pytest.mark.parametrize("off", [-1e-7, 1e-7])
def test_two_zeros_between_two_points(off):
    """A smooth function that is below zero for a thousandth of a step; twin: it only comes as near to zero."""
    of = lambda point: (point.z[-1] - 0.7654) ** 2 + off
    narrow = Monitor(of, sign_changes, partial(zero, "edge", of), smooth=True)
    path, found = followed(Curve(STRAIGHT, 0.0, 2.0, (narrow,)), (0.0, 0.0), 1.0)
    edges = [] if off > 0 else [0.7654 - np.sqrt(-off), 0.7654 + np.sqrt(-off)]
    np.testing.assert_allclose([c.z[-1] for c in found], edges, rtol=1e-12)
    # In order, with a point between the edges.
    parameters = [p.z[-1] for p in path.points]
    assert parameters == sorted(parameters) and any(of(p) < -1e-9 for p in path.points) == (off < 0)


def test_what_is_alone():
    """A monitor that is alone says nothing where one before it has found something; twin: by itself it does."""
    one = Monitor(TURN, sign_changes, partial(zero, "other name", TURN))
    for monitors, kinds in (((FOLDS, one), ["fold"]), ((FOLDS, one._replace(alone=False)), ["fold", "other name"])):
        _, found = followed(Curve(PARABOLA, -1.0, 2.0, monitors), (-1.0, 0.0), 1.0)
        assert [c.kind for c in found] == kinds
