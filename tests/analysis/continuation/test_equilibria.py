"""Branches of equilibria: folds, crossings and the loss of stability, against closed forms, with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import bead_on_hoop, cross_rails
from tests.analysis.steady_systems import BUCKLING, COLUMN, EXCHANGE, column, exchange  # fmt: skip

BEAD = bead_on_hoop.PARAMS
CRITICAL = 1e-10
SLOPE = 1e-8


def bead(first, start, last):
    """Branches along the speed of the hoop."""
    return lj.continue_equilibria(bead_on_hoop.system, BEAD | {"omega": first}, start, along="omega", to=last)


def check(critical, exact, params, along):
    """The critical parameter and its derivatives by all others; twin: an error of a millionth is detected."""
    value = float(exact(params))
    assert abs(float(critical.parameter) / value - 1) < CRITICAL < abs((1 + 1e-6) * value / value - 1)
    slopes = jax.grad(exact)(params)
    for name, slope in slopes.items():
        expected = 0.0 if name == along else float(slope)
        assert abs(float(critical.derivative[name]) - expected) < SLOPE * max(1.0, abs(expected)), name


# One coordinate.


@pytest.mark.parametrize("from_the_side", [False, True])
def test_bead(from_the_side):
    """ω_c = √(g/a), dω_c/da = -½ √(g/a³), along the bottom, or the tilt, whose eigenvalue only touches zero."""
    found = bead(8.0, 1.3, 1.0) if from_the_side else bead(1.0, 0.0, 8.0)
    (critical,) = found.critical
    assert critical.kind == "pitchfork" and critical.branches == (0, 1) and len(found) == 2
    check(critical, lambda p: jnp.sqrt(p["g"] / p["a"]) + 0 * p["m"], BEAD, "omega")
    np.testing.assert_allclose(critical.derivative["a"], -0.5 * np.sqrt(BEAD["g"] / BEAD["a"] ** 3), rtol=1e-10)
    side, bottom = (found[0], found[1]) if from_the_side else (found[1], found[0])
    below = bottom.parameter < float(critical.parameter) * (1 - 1e-9)
    above = bottom.parameter > float(critical.parameter) * (1 + 1e-9)
    assert bottom.stable[below].all() and not bottom.stable[above].any() and side.stable.all()
    tilt = np.arccos(np.minimum(1.0, BEAD["g"] / (BEAD["a"] * side.parameter**2)))
    np.testing.assert_allclose(np.abs(side.q), tilt, atol=1e-7)
    away = side.parameter > 1.001 * float(critical.parameter)
    np.testing.assert_allclose(np.abs(side.q)[away], tilt[away], rtol=1e-12)
    # Both halves of the pitchfork, and its tip.
    assert side.q.min() < -1 and side.q.max() > 1 and np.min(np.abs(side.q)) < 1e-9
    np.testing.assert_allclose([found.first, found.last], [8.0, 1.0] if from_the_side else [1.0, 8.0])


# Several coordinates.


@pytest.mark.slow
def test_column():
    """It buckles at P l = c (3 ∓ √5)/2, each a pitchfork with its own branch; only the first branch is stable."""
    found = lj.continue_equilibria(column, COLUMN, np.zeros(2), along="P", to=6.0)
    assert [c.kind for c in found.critical] == ["pitchfork", "pitchfork"] and len(found) == 3
    for critical, factor in zip(found.critical, BUCKLING):
        check(critical, lambda p, factor=factor: factor * p["c"] / p["l"] + 0 * p["P"], COLUMN, "P")
    stable = [b.stable for b in found.branches]
    assert stable[1].all() and not stable[2].any()
    assert lj.continue_equilibria(column, COLUMN, np.zeros(2), along="P", to=6.0, crossings=False).status != ""


@pytest.mark.slow
def test_cross_rails():
    """ω² = k/m: a line of equilibria; ω² = K/m: the equilibrium goes to infinity, from both sides."""
    params = cross_rails.PARAMS
    system = cross_rails.rotating_system

    def root(name):
        return lambda p: jnp.sqrt(p[name] / p["m"]) + 0 * (p["omega"] + p["R0"] + p["K"] + p["k"])

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


def test_no_start_and_no_program():
    """Without an equilibrium there is no branch; and inside a compiled program its points cannot be counted."""
    with pytest.raises(ValueError, match="no equilibrium was found from the start"):
        lj.continue_equilibria(exchange, EXCHANGE | {"mu": 1.0, "d": 0.0, "c": np.nan}, 0.5, along="mu", to=2.0)
    with pytest.raises(TypeError, match="JAX is tracing"):
        jax.jit(lambda g: bead(g, 0.0, 8.0).critical[0].parameter)(1.0)
