"""Following a branch past its folds: none missed, no jump to another branch, and where it stalls."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.continuation.arclength import Path, Tracer
from tests.analysis.continuation.test_equilibria import branches, check
from tests.analysis.steady_systems import ENDS, FOLDS, FORMS, forms  # fmt: skip


def test_folds():
    """Two folds, passed in both directions; between them it is unstable, and on it b μ = c q + h q³ - e."""
    found, (b, c, e, h) = branches("folds"), (FOLDS[name] for name in "bceh")
    assert [critical.kind for critical in found.critical] == ["fold", "fold"] and len(found) == 1
    turn = lambda p, side: (2 / 3 * p["c"] * side * jnp.sqrt(-p["c"] / (3 * p["h"])) - p["e"]) / p["b"]
    for critical, side in zip(found.critical, (1, -1)):
        check(critical, lambda p, side=side: turn(p, side), FOLDS, "mu", names=("mu", *"bceh"))
    branch, edge = found[0], np.sqrt(-c / (3 * h))
    off = np.abs(np.abs(branch.q) - edge) > 1e-6
    np.testing.assert_array_equal(branch.stable[off], np.abs(branch.q[off]) > edge)
    np.testing.assert_allclose(branch.parameter, (c * branch.q + h * branch.q**3 - e) / b, rtol=1e-11, atol=1e-11)
    assert "ends at the end of the range" in repr(found) and "fold" in repr(found)


@pytest.mark.slow
@pytest.mark.parametrize("e", [1e-3, pytest.param(1e-6, marks=pytest.mark.exhaustive)])
def test_nearly_a_pitchfork(e):
    """With a small push there is no crossing, steps do not jump to the other branch, and the branch stays stable."""
    pushed = FORMS | {"a": 1.0, "h": 1.0, "e": e}
    found = lj.continue_equilibria(forms, pushed, 0.0, along="mu", to=0.8)
    assert len(found) == 1 and not found.critical and found[0].stable.all() and found[0].q[-1] > 0.8
    back = lj.continue_equilibria(forms, pushed | {"mu": 0.8}, -0.9, along="mu", to=-1.0)
    # The other branch folds where mu³ = 27 e²/4.
    (critical,) = back.critical
    assert critical.kind == "fold"
    np.testing.assert_allclose(critical.parameter, np.cbrt(6.75 * e**2), rtol=1e-10)
    np.testing.assert_allclose(critical.derivative["e"], 2 / 3 * np.cbrt(6.75 / e), rtol=1e-8)


def test_a_branch_that_stalls():
    """It stops where L is undefined, says so, and returns its points so far; twin: a shorter range is completed."""
    found = lj.continue_equilibria(forms, ENDS, 0.0, along="mu", to=3.0)
    assert len(found[0]) > 10 and "Newton's method does not converge" in found[0].status
    np.testing.assert_allclose([found[0].parameter[-1], found[0].q[-1]], 1.0, atol=1e-2)
    assert lj.continue_equilibria(forms, ENDS, 0.0, along="mu", to=0.9)[0].status == "the end of the range"


def test_a_path_that_comes_back_is_closed():
    """Within a step of its start and in the same direction; twins: the other direction, a step away, too few points."""
    circle = np.linspace(0.0, 2 * np.pi, 41)
    tracer = SimpleNamespace(weights=np.ones(2))

    def closes(angles, turned=1.0, step=0.2):
        along = [np.array([-np.sin(a), np.cos(a)]) for a in angles]
        along[-1] = turned * along[-1]
        points = [SimpleNamespace(z=5.0 + np.array([np.cos(a), np.sin(a)]), tangent=v) for a, v in zip(angles, along)]
        return Tracer.closes(tracer, Path(points), step)

    assert closes(circle) and closes(circle[:-1], step=0.16)
    assert not (closes(circle, -1.0) or closes(circle[:-1], step=0.15) or closes(circle[::8]))
