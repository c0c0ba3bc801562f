"""Equations in LaTeX agree with textbooks and with the program that computes them."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis import expressions, typeset
from lagjax.analysis.expressions import function, number, symbol, tidy
from lagjax.scenes import cross_rails, sliding_wedge
from tests.systems import DOUBLE_PARAMS, double_pendulum

X, Y = symbol("x", "x", 1), symbol("y", "y", 2)


def test_algebra():
    """Products are expanded, cancelling terms vanish, powers of a root recombine; each is compared with numbers."""
    at = {"x": 0.75, "y": -1.25}
    root = (X * X + number(3.0)).power(0.5)
    cases = [
        ((X + Y) * (X - Y) - X * X, -(at["y"] ** 2)),
        (root * root * root, (0.75**2 + 3) ** 1.5),
        (root.power(-3) * root, 1 / (0.75**2 + 3)),
        (function("sin", -X) + function("sin", X), 0.0),
        ((X * Y).power(-2), (0.75 * 1.25) ** -2.0),
        (function("exp", X + Y).power(2), np.exp(-1.0)),
    ]
    for formula, value in cases:
        np.testing.assert_allclose(formula.value(at), value, rtol=1e-14, atol=1e-15)
    assert (X + Y) * (X - Y) - X * X == -(Y * Y) and (function("sin", -X) + function("sin", X)).terms == {}
    sine, cosine = function("sin", X), function("cos", X)
    assert tidy(Y * sine * sine + Y * cosine * cosine) == Y
    assert tidy(Y * sine * sine + number(2.0) * Y * cosine * cosine) != Y
    assert tidy(sine.power(4) + sine.power(2) * cosine.power(2)) == sine.power(2)


def test_typesetting():
    """Numbers are typeset as fractions and names as letters, with the right signs and brackets."""
    assert typeset.latex(number(0.5) * X * Y - number(1.25) * Y.power(-1)) in (
        r"\frac{x y}{2} - \frac{5}{4 y}",
        r"-\frac{5}{4 y} + \frac{x y}{2}",
    )
    assert typeset.latex(number(0.0)) == "0" and typeset.latex(number(9.8125)) == r"\frac{157}{16}"
    assert typeset.latex(function("log", X + Y)) == r"\ln(x + y)"
    assert typeset.latex((X + Y).power(0.5)) == r"\sqrt{x + y}" and typeset.latex(X.power(-1)) == r"\frac{1}{x}"


def test_textbook_equations():
    """The equations of Goldstein's wedge, and of the rails with the Coriolis factor 2, are those in print."""
    found = lj.latex(sliding_wedge.system, sliding_wedge.Q0, sliding_wedge.V0, sliding_wedge.PARAMS)
    assert found.lines[:3] == (
        r"M \ddot{X} = -\sin(\alpha) \lambda_{\mathrm{incline}}",
        r"m \ddot{x} = \sin(\alpha) \lambda_{\mathrm{incline}}",
        r"m \ddot{y} = g m - \cos(\alpha) \lambda_{\mathrm{incline}}",
    )
    assert found.lines[3].endswith("= 0") and found.error < 1e-14
    rails = lj.latex(cross_rails.rotating_system, cross_rails.Q0, cross_rails.V0, cross_rails.PARAMS)
    assert r"+ 2 m \omega \dot{r}" in rails.lines[0] and r"- 2 m \omega \dot{R}" in rails.lines[1]
    assert "$$" in rails._repr_latex_() and "verified to" in repr(rails) and "aligned" in str(rails)


def test_others():
    """Also for a double pendulum in an array, velocity constraints with dissipation, and a scalar with a root."""
    found = lj.latex(double_pendulum, np.array([0.25, 0.5]), np.array([0.5, 0.25]), DOUBLE_PARAMS)
    assert r"l_{1} l_{2} m_{2} \cos(q_{0} - q_{1}) \ddot{q_{1}}" in found.lines[0]
    rolling = lj.Nonholonomic(lambda t, q, v, p: v["x"] - p["R"] * v["phi"])
    wheel = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2 + 0.25 * v["phi"] ** 2,
        {"rolling": rolling},
        dissipation=lambda t, q, v, p: 0.125 * v["x"] ** 2,
    )
    state = {"phi": 0.5, "x": 0.25}, {"phi": 2.0, "x": 1.5}
    assert lj.latex(wheel, *state, {"R": 0.75}).lines == (
        r"\frac{1}{2} \ddot{\phi} = -R \lambda_{\mathrm{rolling}}",
        r"\ddot{x} = -\frac{\dot{x}}{4} + \lambda_{\mathrm{rolling}}",
        r"-R \dot{\phi} + \dot{x} = 0",
    )
    fast = lj.System(lambda t, q, v, p: -p["m"] * jnp.sqrt(1 - v**2) - 0.5 * p["k"] * q**2)
    assert lj.latex(fast, 0.25, 0.5, {"m": 1.5, "k": 2.0}).lines[0].endswith("= -k q")


def test_what_cannot_be_written(monkeypatch):
    """Refused: a branch, which has no formula; nine coordinates; equations that are too long; wrong formulas."""
    branch = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.where(q > 0, q**2, q**4))
    with pytest.raises(ValueError, match="the equations contain"):
        lj.latex(branch, 0.25, 0.5)
    with pytest.raises(ValueError, match="the system has 9 coordinates"):
        lj.latex(lj.System(lambda t, q, v, p: 0.5 * v @ v), np.ones(9), np.ones(9))
    long = lj.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sum(q) ** 12)
    with pytest.raises(ValueError, match="the equations are too long to be read"):
        lj.latex(long, np.ones(6), np.ones(6))
    monkeypatch.setitem(expressions.FUNCTIONS, "cos", np.sin)
    with pytest.raises(ValueError, match="the formulas differ from the program"):
        lj.latex(lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.sin(q)), 0.25, 0.5)
