"""Equations in LaTeX agree with textbooks and with the program that computes them."""

import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

import lagjax as lj
from lagjax.analysis.latex import FORMULAS, jaxpr_to_formula, simplified, typeset, written
from lagjax.scenes import cross_rails, sliding_wedge

X, Y = sympy.symbols("x y", real=True)


def formula(function):
    """The formula of a function of x and y."""
    return simplified(jaxpr_to_formula(jax.make_jaxpr(function)(0.5, 0.5), [X, Y])[0])


def test_algebra():
    """Products are expanded, cancelling terms vanish, powers of a root recombine, and of sines and cosines."""
    root, sine, cosine = lambda x: jnp.sqrt(x * x + 3.0), jnp.sin, jnp.cos
    for function, expected in (
        (lambda x, y: (x + y) * (x - y) - x * x, -(Y**2)),
        (lambda x, y: root(x) * root(x) * root(x), (X**2 + 3) * sympy.sqrt(X**2 + 3)),
        (lambda x, y: root(x) ** -3 * root(x), 1 / (X**2 + 3)),
        (lambda x, y: sine(-x) + sine(x), 0),
        (lambda x, y: (x * y) ** -2, X**-2 * Y**-2),
        (lambda x, y: jnp.exp(x + y) ** 2, sympy.exp(2 * X + 2 * Y)),
        (lambda x, y: (0.1 + 0.2) * x - 0.3 * x + y / 3 - y * (1 / 3), 0),
        (lambda x, y: y * jnp.sqrt(2.0) ** 2 * jnp.arcsinh(0.0), 0),
        (lambda x, y: y * sine(x) ** 2 + y * cosine(x) ** 2, Y),
        (lambda x, y: sine(x) ** 4 + sine(x) ** 2 * cosine(x) ** 2, sympy.sin(X) ** 2),
        (lambda x, y: sine(x) * cosine(y) * y - cosine(x) * sine(y) * y, Y * sympy.sin(X - Y)),
    ):
        assert formula(function) == expected
    assert formula(lambda x, y: y * sine(x) ** 2 + 2.0 * y * cosine(x) ** 2) != Y


def test_every_primitive():
    """Each primitive in the table is computed by its formula; twin: in the formula of another the numbers differ."""
    of_two = {"add", "add_any", "sub", "mul", "div", "pow"}

    def named(name):
        primitive, argument = getattr(jax.lax, name), (lambda x: 1 + x) if name == "acosh" else (lambda x: x)
        return lambda x, y: primitive(argument(x), y) if name in of_two else primitive(argument(x))

    functions = {name: named(name) for name in set(FORMULAS) - {"add_any", "neg"}}
    at = np.array([[0.25, 0.75], [0.625, -0.5]])
    values = jax.jit(jax.vmap(lambda at: {name: function(*at) for name, function in functions.items()}))(at)
    for name, function in functions.items():
        found = sympy.lambdify((X, Y), formula(function))
        np.testing.assert_allclose([found(*x) for x in at], values[name], rtol=1e-14, err_msg=name)
    assert abs(float(formula(lambda x, y: jax.lax.sinh(x)).subs(X, 0.25)) - np.sin(0.25)) > 1e-3


def test_typesetting():
    """Numbers are typeset as fractions or with their digits, with the right signs and brackets."""
    show = lambda function: typeset(formula(function), {X: "x", Y: "y"})
    assert show(lambda x, y: 0.5 * x * y - 1.25 / y) == r"\frac{x y}{2} - \frac{5}{4 y}"
    assert show(lambda x, y: 0.0 * x) == "0" and show(lambda x, y: 9.8125 + 0 * x) == r"\frac{157}{16}"
    assert show(lambda x, y: jnp.log(x + y)) == r"\ln{\left(x + y \right)}"
    assert show(lambda x, y: jnp.arcsin(x)) == r"\arcsin{\left(x \right)}"
    assert show(lambda x, y: jnp.sqrt(x + y)) == r"\sqrt{x + y}" and show(lambda x, y: 1 / x) == r"\frac{1}{x}"
    digits = {
        9.81: "9.81 x", -0.3 * 9.81 * 1.1: "- 3.2373 x", 1 / 3: r"\frac{x}{3}", 1e7: "10000000 x",
        6.02e23: r"6.02 \cdot 10^{23} x", -4e-9: r"- 4.0 \cdot 10^{-9} x", 1.2345678901234567: "1.2345678901234567 x",
    }  # fmt: skip
    for number, text in digits.items():
        assert show(lambda x, y: number * x) == text
    of_float32 = jax.make_jaxpr(lambda x: np.float32(0.123) * x)(jnp.float32(1.0))
    assert typeset(jaxpr_to_formula(of_float32, [X])[0], {X: "x"}) == "0.123 x"


def test_names():
    """Only letters and digits of the names of coordinates, parameters and constraints reach the equations."""
    bad = "a$\\frac$\x1b[2J</script>}{"
    L = lambda t, q, v, p: 0.5 * p[bad] * v[bad] ** 2 - q[bad]
    system = lj.System(L, {bad: lj.Holonomic(lambda t, q, p: q[bad] - t)})
    found = lj.latex(system, {bad: 0.0}, {bad: 1.0}, {bad: 2.0})
    body = re.sub(r"\\(mathrm|d?dot|lambda|square)(?![a-z])", "", "".join(found.lines))
    assert re.fullmatch(r"[\w{},=+\- ]+", body) and body.count("{") == body.count("}")
    # One name for three things: the symbols stay apart.
    assert re.match(r"(a\S+) \\ddot\{a\}\S+ = \\lambda_\{a\S+\} - 1", found.lines[0])
    assert written("body.mass") == r"\mathrm{body}_{\mathrm{mass}}" and written("Omega2") == r"\Omega_{2}"
    assert written("vertical") == r"\mathrm{vertical}" and written("$") == r"\square"


def test_textbook_equations():
    """The equations of Goldstein's wedge, and of the rails with the Coriolis factor 2, are those in print."""
    found = lj.latex(sliding_wedge.system, sliding_wedge.Q0, sliding_wedge.V0, sliding_wedge.PARAMS)
    assert found.lines[:3] == (
        r"M \ddot{X} = - \lambda_{\mathrm{incline}} \sin{\left(\alpha \right)}",
        r"m \ddot{x} = \lambda_{\mathrm{incline}} \sin{\left(\alpha \right)}",
        r"m \ddot{y} = g m - \lambda_{\mathrm{incline}} \cos{\left(\alpha \right)}",
    )
    assert found.lines[3].endswith("= 0") and found.error < 1e-14
    rails = lj.latex(cross_rails.rotating_system, cross_rails.Q0, cross_rails.V0, cross_rails.PARAMS)
    assert r"+ 2 m \omega \dot{r}" in rails.lines[0] and r"- 2 m \omega \dot{R}" in rails.lines[1]
    assert "$$" in rails._repr_latex_() and "verified to" in repr(rails) and "aligned" in str(rails)


def test_others():
    """Also for velocity constraints with dissipation, and a scalar with a root."""
    rolling = lj.Nonholonomic(lambda t, q, v, p: v["x"] - p["R"] * v["phi"])
    wheel = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2 + 0.25 * v["phi"] ** 2,
        {"rolling": rolling},
        dissipation=lambda t, q, v, p: 0.125 * v["x"] ** 2,
    )
    state = {"phi": 0.5, "x": 0.25}, {"phi": 2.0, "x": 1.5}
    assert lj.latex(wheel, *state, {"R": 0.75}).lines == (
        r"\frac{\ddot{\phi}}{2} = - R \lambda_{\mathrm{rolling}}",
        r"\ddot{x} = - \frac{\dot{x}}{4} + \lambda_{\mathrm{rolling}}",
        r"- R \dot{\phi} + \dot{x} = 0",
    )
    fast = lj.System(lambda t, q, v, p: -p["m"] * jnp.sqrt(1 - v**2) - 0.5 * p["k"] * q**2)
    relativistic = r"\frac{m \ddot{q}}{\left(1 - \dot{q}^{2}\right)^{\frac{3}{2}}} = - k q"
    assert lj.latex(fast, 0.25, 0.5, {"m": 1.5, "k": 2.0}).lines == (relativistic,)


@pytest.mark.slow
def test_the_double_pendulum_in_cartesian_terms():
    """From the speeds of the masses come the textbook's equations: products of sines and cosines combine."""

    def L(t, q, v, p):
        x, y = p["l"] * jnp.cos(q) * v, p["l"] * jnp.sin(q) * v
        speeds = jnp.stack([x[0] ** 2 + y[0] ** 2, (x[0] + x[1]) ** 2 + (y[0] + y[1]) ** 2])
        drops = p["l"] * jnp.cos(q)
        return 0.5 * p["m"] @ speeds + p["g"] * (p["m"][0] * drops[0] + p["m"][1] * (drops[0] + drops[1]))

    params = {"m": np.array([1.0, 2.0]), "l": np.array([0.5, 0.75]), "g": 9.81}
    assert lj.latex(lj.System(L), np.array([0.5, 0.25]), np.array([0.25, 1.0]), params).lines == (
        r"l_{0}^{2} \ddot{q}_{0} \left(m_{0} + m_{1}\right) + l_{0} l_{1} m_{1} \ddot{q}_{1} "
        r"\cos{\left(q_{0} - q_{1} \right)} = - g l_{0} m_{0} \sin{\left(q_{0} \right)} - g l_{0} m_{1} "
        r"\sin{\left(q_{0} \right)} - l_{0} l_{1} m_{1} \dot{q}_{1}^{2} \sin{\left(q_{0} - q_{1} \right)}",
        r"l_{0} l_{1} m_{1} \ddot{q}_{0} \cos{\left(q_{0} - q_{1} \right)} + l_{1}^{2} m_{1} \ddot{q}_{1} = "
        r"- g l_{1} m_{1} \sin{\left(q_{1} \right)} + l_{0} l_{1} m_{1} \dot{q}_{0}^{2} "
        r"\sin{\left(q_{0} - q_{1} \right)}",
    )
    chain = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(jnp.cumsum(v) ** 2) - q @ q)
    assert lj.latex(chain, np.ones(2), np.ones(2)).lines[1] == r"\ddot{q}_{0} + \ddot{q}_{1} = - 2 q_{1}"


def test_what_cannot_be_written(monkeypatch):
    """Refused: a branch, which has no formula; nine coordinates; equations that are too long; wrong formulas."""
    parts = np.arange(1.0, 400.0)
    for lagrangian, at, words in (
        (lambda t, q, v, p: 0.5 * v**2 - jnp.where(q > 0, q**2, q**4), 0.25, "the equations contain"),
        (lambda t, q, v, p: 0.5 * v @ v, np.ones(9), "the system has 9 coordinates"),
        (lambda t, q, v, p: v @ v - jnp.sum(jnp.sin(jnp.outer(parts, q))), np.ones(6), "are too long to be read"),
    ):
        with pytest.raises(ValueError, match=words):
            lj.latex(lj.System(lagrangian), at, at)
    power = lj.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sum(q) ** 12)
    lines = lj.latex(power, np.ones(6), np.ones(6)).lines
    assert lines[5].endswith(r"= - 12 \left(q_{0} + q_{1} + q_{2} + q_{3} + q_{4} + q_{5}\right)^{11}")
    swings = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.sin(q))
    assert lj.latex(swings, 0.25, 0.5).error < 1e-14
    for wrong in ("cos", lambda x: sympy.log(-1 - sympy.cos(x) ** 2), lambda x: sympy.nan):
        monkeypatch.setitem(FORMULAS, "sin", wrong)
        with pytest.raises(ValueError, match="the formulas differ from the program"):
            lj.latex(swings, 0.25, 0.5)


def test_without_sympy(monkeypatch):
    """SymPy is an extra, and the message says how to install it."""
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(ImportError, match='lj.latex needs sympy(?s:.*)pip install "lagjax.sympy."'):
        lj.latex(lj.System(lambda t, q, v, p: 0.5 * v**2), 0.25, 0.5)
