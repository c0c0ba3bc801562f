"""Branches of equilibria: folds, crossings and the loss of stability, against closed forms, with derivatives."""

from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.following import BranchPath, closes
from lagjax.scenes import bead_on_hoop, cross_rails
from tests.analysis.steady_systems import (  # fmt: skip  # fmt: skip
    BUCKLING,
    COLUMN,
    ENDS,
    EXCHANGE,
    FOLDS,
    FORMS,
    PITCHFORK,
    column,
    forms,
)
from tests.by_numpy import by_numpy

CRITICAL = 1e-10
SLOPE = 1e-8


@cache
def branches(kind, to=0.75):
    """Branches of a normal form along μ."""
    params, start = {
        "pitchfork": (PITCHFORK, 0.0), "from the side": (PITCHFORK | {"mu": 1.0}, 0.6), "exchange": (EXCHANGE, 0.0),
        "folds": (FOLDS, -0.9),
    }[kind]  # fmt: skip
    return lj.continue_equilibria(forms, params, start, along="mu", to=-1.0 if kind == "from the side" else to)


def check(critical, exact, params, along, names=None):
    """The critical parameter and its derivatives by all others; twin: an error of a millionth is detected."""
    value, slopes = by_numpy(jax.value_and_grad(exact))(params)
    assert abs(float(critical.parameter) / value - 1) < CRITICAL < abs((1 + 1e-6) * value / value - 1)
    for name in names or params:
        expected = 0.0 if name == along else float(slopes[name])
        assert abs(float(critical.derivative[name]) - expected) < SLOPE * max(1.0, abs(expected)), name


# One coordinate.


@pytest.mark.parametrize("kind", ["pitchfork", "from the side"])
def test_pitchfork(kind):
    """μ_c = c/a, along the branch that loses its stability, or that at ±√((a μ - c)/h), which only touches zero."""
    found, (a, c, h) = branches(kind), (PITCHFORK[name] for name in "ach")
    (critical,) = found.critical
    assert critical.kind == "pitchfork" and critical.branches == (0, 1) and len(found) == 2
    check(critical, lambda p: p["c"] / p["a"], PITCHFORK, "mu", names=("mu", "a", "c", "h"))
    side, middle = (found[0], found[1]) if kind == "from the side" else (found[1], found[0])
    below, above = middle.parameter < c / a - 1e-9, middle.parameter > c / a + 1e-9
    np.testing.assert_allclose(middle.q, 0.0, atol=1e-12)
    assert middle.stable[below].all() and not middle.stable[above].any() and side.stable.all()
    exact = np.sqrt(np.maximum(0.0, (a * side.parameter - c) / h))
    np.testing.assert_allclose(np.abs(side.q), exact, atol=1e-7)
    away = exact > 0.03
    np.testing.assert_allclose(np.abs(side.q)[away], exact[away], rtol=1e-12)
    # Both halves of the pitchfork, and its tip.
    assert side.q.min() < -0.4 and side.q.max() > 0.4 and np.min(np.abs(side.q)) < 1e-9
    np.testing.assert_allclose([found.first, found.last], [1.0, -1.0] if kind == "from the side" else [-1.0, 0.75])


def test_exchange_of_stability():
    """Two branches cross transcritically at μ = c/a, and neither folds."""
    found, (a, c, d) = branches("exchange"), (EXCHANGE[name] for name in "acd")
    (critical,) = found.critical
    assert critical.kind == "transcritical"
    check(critical, lambda p: p["c"] / p["a"], EXCHANGE, "mu", names=("mu", "a", "c", "d"))
    other = found[1]
    np.testing.assert_allclose(other.q, (a * other.parameter - c) / d, atol=1e-13)
    off = np.abs(other.parameter - c / a) > 1e-6
    np.testing.assert_array_equal(other.stable[off], other.parameter[off] > c / a)


# Several coordinates.


@pytest.mark.slow
def test_column():
    """It buckles at P l = c (3 ∓ √5)/2, each a pitchfork with its own branch; only the first branch is stable."""
    found = lj.continue_equilibria(column, COLUMN, np.zeros(2), along="P", to=6.0)
    assert [c.kind for c in found.critical] == ["pitchfork", "pitchfork"] and len(found) == 3
    for critical, factor in zip(found.critical, BUCKLING):
        check(critical, lambda p, factor=factor: factor * p["c"] / p["l"], COLUMN, "P")
    assert found[1].stable.all() and not found[2].stable.any()


@pytest.mark.exhaustive
def test_cross_rails():
    """ω² = k/m: a line of equilibria; ω² = K/m: the equilibrium goes to infinity, from both sides."""
    params = cross_rails.PARAMS
    system = cross_rails.rotating_system

    root = lambda name: lambda p: jnp.sqrt(p[name] / p["m"])
    found = lj.continue_equilibria(system, params | {"omega": 1.0}, {"R": 0.8, "r": 0.0}, along="omega", to=9.0)
    assert [c.kind for c in found.critical] == ["line of equilibria", "escape"]
    check(found.critical[0], root("k"), params, "omega")
    check(found.critical[1], root("K"), params, "omega")
    main, line = found[0], found[1]
    inner = main.parameter < 0.999 * np.sqrt(params["K"] / params["m"])
    exact = np.asarray(cross_rails.equilibrium_length(params | {"omega": main.parameter}))
    np.testing.assert_allclose(main.q["R"][inner], exact[inner], rtol=1e-11)
    np.testing.assert_array_equal(main.stable[1:-1], cross_rails.is_stable(params | {"omega": main.parameter[1:-1]}))
    assert np.ptp(line.parameter) < 1e-12 and np.ptp(line.q["r"]) > 0.5 and "infinity" in main.status
    above = lj.continue_equilibria(system, params | {"omega": 9.0}, {"R": -0.8, "r": 0.0}, along="omega", to=1.0)
    check(above.critical[0], root("K"), params, "omega")
    assert above[0].stable.all() and above[0].q["R"].max() < 0


@pytest.mark.exhaustive
def test_closed_curve_and_folds_of_a_side_branch():
    """A circle that crosses the first branch at both ends; a subcritical pitchfork whose branch folds at mu = -1/4."""
    one = lambda potential: lj.System(lambda t, q, v, p: 0.5 * v**2 - potential(q, p["mu"]))
    circle = one(lambda q, mu: 0.25 * q**4 - 0.5 * (1 - mu**2) * q**2)
    found = lj.continue_equilibria(circle, {"mu": -2.0}, 0.0, along="mu", to=2.0)
    assert [c.kind for c in found.critical] == ["pitchfork", "pitchfork"] and len(found) == 2
    np.testing.assert_allclose([c.parameter for c in found.critical], [-1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(found[1].parameter ** 2 + found[1].q ** 2, 1.0, rtol=1e-12)
    sudden = one(lambda q, mu: q**6 / 6 - 0.25 * q**4 - 0.5 * mu * q**2)
    found = lj.continue_equilibria(sudden, {"mu": -1.0}, 0.0, along="mu", to=1.0)
    np.testing.assert_allclose([c.parameter for c in found.of_kind("fold")], [-0.25, -0.25], rtol=1e-12)
    np.testing.assert_allclose(sorted(float(c.q) for c in found.of_kind("fold")), [-(0.5**0.5), 0.5**0.5], rtol=1e-9)
    assert float(found.of_kind("pitchfork")[0].parameter) == pytest.approx(0.0, abs=1e-13)


# Printed results and messages.


BEAD = lambda **change: lj.continue_equilibria(
    bead_on_hoop.system, bead_on_hoop.PARAMS, 1.0, **{"along": "omega", "to": 8.0} | change
)
NOWHERE = EXCHANGE | {"mu": 1.0, "d": 0.0, "c": np.nan}


@pytest.mark.parametrize(
    "act, words",
    [
        (lambda: BEAD(along="speed"), "along='speed' is no number in params; there are 'a', 'g', 'm' and 'omega'"),
        (lambda: BEAD(to=6.0), "leaves the parameter 'omega' no range: it starts at 6"),
        (lambda: BEAD(velocity=1.0), "L depends on 'q'"),
        (
            lambda: lj.continue_equilibria(forms, NOWHERE, 0.5, along="mu", to=2.0),
            "no equilibrium was found from the start",
        ),
    ],
)
def test_bad_input(act, words):
    """Errors name what is wrong."""
    with pytest.raises(ValueError, match=words):
        act()


def test_not_in_a_program():
    """Inside a compiled program the points of a branch cannot be counted."""
    with pytest.raises(TypeError, match="JAX is tracing"):
        jax.eval_shape(lambda mu: lj.continue_equilibria(forms, EXCHANGE | {"mu": mu}, 0.0, along="mu", to=2.0), 1.0)


def test_what_is_drawn():
    """Stable parts are solid, unstable dashed, the pitchfork is marked, axes are named; unknown names are refused."""
    found = branches("pitchfork")
    (axis,) = found.plot().axes
    dashes = {line.get_linestyle() for line in axis.get_lines() if len(line.get_xdata()) > 2}
    assert dashes == {"-", "--"} and axis.get_xlabel() == "mu" and axis.get_ylabel() == "q"
    assert {"stable", "unstable", "pitchfork"} <= set(axis.get_legend_handles_labels()[1])
    with pytest.raises(ValueError, match="which is no coordinate"):
        found.plot("theta")


# Folds, none missed; no jump to another branch; where a branch stalls.


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
    plane = SimpleNamespace(weights=np.ones(2), length=np.linalg.norm)

    def comes_back(angles, turned=1.0, step=0.2):
        along = [np.array([-np.sin(a), np.cos(a)]) for a in angles]
        along[-1] = turned * along[-1]
        points = [SimpleNamespace(z=5.0 + np.array([np.cos(a), np.sin(a)]), tangent=v) for a, v in zip(angles, along)]
        return closes(plane, BranchPath(points), step)

    assert comes_back(circle) and comes_back(circle[:-1], step=0.16)
    assert not (comes_back(circle, -1.0) or comes_back(circle[:-1], step=0.15) or comes_back(circle[::8]))
