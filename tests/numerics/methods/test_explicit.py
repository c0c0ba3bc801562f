"""Our explicit methods in diffrax's form: the claimed orders, stages in a loop, and zeros that cost nothing."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax import RK4, Dopri8, Nystrom8, Nystrom12, Tsit5
from lagjax.numerics.runge_kutta import RKN86, RKN1210
from tests.numerics.methods.driven_pendulum import errors, in_numpy, swing

ORDERS = [
    (Tsit5, (60, 90), 5), (Dopri8, (12, 18), 8), (RK4, (20, 40), 4), (Nystrom8, (8, 16), 8), (Nystrom12, (4, 6), 12),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "steps", "order"), ORDERS)
def test_order(kind, steps, order):
    """The order of angle and rate on a nonlinear problem with explicit time; each order is the others' twin."""
    few, many = (np.abs(errors(kind(), n)[0]).max() for n in steps)
    assert abs(np.log(few / many) / np.log(steps[1] / steps[0]) - order) < 0.75


def test_dense_output_of_nystrom():
    """Dense output of angle and rate has order 5 or more between the steps."""
    # 1.3 is the middle of a step.
    few, many = (np.abs(errors(Nystrom8(), n)[1]) for n in (25, 75))
    assert np.all(many < 1e-4) and np.all(np.log(few / many) / np.log(3) > 4.7)


@pytest.mark.parametrize("tableau", [RKN86, RKN1210])
def test_weights_are_quadratures(tableau):
    """`sum b' c^k = 1/(k+1)`, `sum b c^k = 1/((k+1)(k+2))`, to the order of each; rows of a sum to c²/2."""
    c = np.array(tableau.c)
    position, velocity = (7, 8) if tableau is RKN86 else (11, 12)
    for k in range(velocity):
        np.testing.assert_allclose(tableau.b_velocity @ c**k, 1 / (k + 1), rtol=1e-13)
    for k in range(position):
        np.testing.assert_allclose(tableau.b_position @ c**k, 1 / (k + 1) / (k + 2), rtol=1e-13)
    np.testing.assert_allclose([sum(row) for row in tableau.a], c[1:] ** 2 / 2, rtol=1e-12)


def a_step(method, known, start):
    """The end of a step, its error and the first stage of the next; `known`: whether its own first stage is."""
    term = diffrax.ODETerm(swing)
    first = method.init(term, 0.25, 0.75, start, None) if known else None
    end, error, _, last, _ = method.step(term, 0.25, 0.75, start, None, first, not known)
    return end, error, last


def in_both_ways(kind, known, order):
    """A step with stages in a loop and one by one; or of order 1, the reverse derivative of its angle."""
    steps = [partial(a_step, kind(in_a_loop=looped), known) for looped in (True, False)]
    return [step if not order else jax.grad(lambda y, step=step: step(y)[0][0]["angle"]) for step in steps]


IN_LOOPS = [(kind, known, order) for kind in (RK4, Dopri8, Nystrom8, Tsit5) for known in (0, 1) for order in (0, 1)]
SOON = [(RK4, 0, 0), (RK4, 1, 1), (Dopri8, 0, 0), (Nystrom8, 1, 0)]


@pytest.mark.parametrize("cases", [SOON, pytest.param(IN_LOOPS, marks=pytest.mark.exhaustive)], ids=["some", "all"])
def test_stages_in_a_loop(cases):
    """With the vector field in a loop, steps and reverse derivatives are the same, also with a known first stage."""
    start = {"angle": np.array(1.0)}, {"angle": np.array(0.5)}
    ways = [in_both_ways(*case) for case in cases]
    for case, pair in zip(cases, jax.jit(lambda y: [[way(y) for way in pair] for pair in ways])(start)):
        check = partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-15, err_msg=str(case))
        jax.tree.map(lambda a, b: check(a, b), *pair)


def test_kuttas_error_estimate():
    """On y' = y it is h (k₄ - k₅)/6 = h⁴/72 - h⁵/144; twin: not h⁴/144."""
    growth = diffrax.ODETerm(lambda t, y, args: y)
    y1, error = in_numpy(lambda y: RK4().step(growth, 0.0, 1e-2, y, None, None, True)[:2], 1.0)(1.0)
    np.testing.assert_allclose(y1, np.sum(1e-2 ** np.arange(5) / [1, 1, 2, 6, 24]), rtol=1e-15)
    assert abs(error - 1e-8 / 72 + 1e-10 / 144) < 1e-16 < abs(error - 1e-8 / 144)


def test_zero_weights_cost_nothing():
    """Prince and Dormand's tableau has 35 of its 91 weights at zero: a step multiplies by none of them."""
    term, y = diffrax.ODETerm(lambda t, y, args: jnp.sin(y)), np.array(1.0)
    step = lambda method: lambda y: method.step(term, 0.0, 0.1, y, None, None, True)[:2]
    operations = [e.primitive.name for e in jax.make_jaxpr(step(Dopri8()))(y).jaxpr.eqns]
    weights = [w for row in diffrax.Dopri8.tableau.a_lower for w in row]
    used = sum(w != 0 for w in [*weights, *diffrax.Dopri8.tableau.b_sol, *diffrax.Dopri8.tableau.b_error])
    assert used < operations.count("mul") <= used + 30
