"""Our explicit methods in plain diffrax: diffrax's own results, the claimed orders, and zeros that cost nothing."""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax import RK4, Dopri8, Tsit5

ENDS = (0.0, 5.0)
PAIRS = [
    pytest.param(Tsit5(), diffrax.Tsit5(), marks=pytest.mark.exhaustive, id="Tsit5"),
    pytest.param(Dopri8(), diffrax.Dopri8(), id="Dopri8"),
]
name_of = lambda value: type(value).__name__


def swing(t, y, args):
    """A driven pendulum, with its state as a pytree."""
    return {"angle": y["rate"], "rate": -jnp.sin(y["angle"]) + 0.1 * jnp.cos(2 * t)}


def solve(method, controller, ts=None, dt0=None):
    """The pendulum from 1 rad."""
    return diffrax.diffeqsolve(
        diffrax.ODETerm(swing), method, *ENDS, dt0, {"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.0)},
        saveat=diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts), stepsize_controller=controller,
    )  # fmt: skip


@pytest.mark.parametrize("kind", [Tsit5, Dopri8, RK4])
@pytest.mark.parametrize("known", [False, True])
def test_stages_in_a_loop(kind, known):
    """With the vector field in a loop, steps and reverse derivatives are the same, also with a known first stage."""
    terms, y0 = diffrax.ODETerm(swing), {"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.5)}

    def step(method, y0):
        first = swing(0.25, y0, None) if known else None
        y1, error, _, last, _ = method.step(terms, 0.25, 0.75, y0, None, first, not known)
        return y1, error, last

    for find in (step, lambda method, y0: jax.grad(lambda y0: step(method, y0)[0]["angle"])(y0)):
        found, expected = find(kind(in_a_loop=True), y0), find(kind(), y0)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15), found, expected)


@pytest.mark.slow
@pytest.mark.parametrize(("ours", "shipped"), PAIRS)
def test_the_steps_of_diffrax(ours, shipped):
    """The same steps, states and dense output as diffrax's implementation."""
    # At constant steps: adaptive steps would differ where the error is only round-off, as in a first step.
    ts = jnp.linspace(*ENDS, 7)
    a, b = (solve(method, diffrax.ConstantStepSize(), ts, dt0=0.3) for method in (ours, shipped))
    assert a.stats["num_steps"] == b.stats["num_steps"]
    np.testing.assert_allclose(a.ys["angle"], b.ys["angle"], rtol=1e-12)


class Misprinted(Tsit5):
    """Tsitouras' method with one weight of its third stage changed."""

    tableau: ClassVar = diffrax.ButcherTableau(
        c=diffrax.Tsit5.tableau.c,
        b_sol=diffrax.Tsit5.tableau.b_sol,
        b_error=diffrax.Tsit5.tableau.b_error,
        a_lower=(
            diffrax.Tsit5.tableau.a_lower[0],
            diffrax.Tsit5.tableau.a_lower[1] + np.array([0.01, -0.01]),
            *diffrax.Tsit5.tableau.a_lower[2:],
        ),
    )


@pytest.fixture(scope="module")
def exact():
    """The solution by another method with a far smaller error."""
    integrate = pytest.importorskip("scipy.integrate")
    field = lambda t, y: [y[1], -np.sin(y[0]) + 0.1 * np.cos(2 * t)]
    return integrate.solve_ivp(field, ENDS, [1.0, 0.0], "DOP853", rtol=1e-13, atol=1e-15).y[0, -1]


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("method", "steps", "order"),
    [(Tsit5(), (80, 160), 5), (Dopri8(), (10, 20), 8), (RK4(), (80, 160), 4), (Misprinted(), (80, 160), 2)],
    ids=name_of,
)
def test_order(exact, method, steps, order):
    """The order on a nonlinear problem with explicit time; a misprint in the tableau loses it."""
    run = jax.jit(lambda dt: solve(method, diffrax.ConstantStepSize(), dt0=dt).ys["angle"][-1])
    errors = [abs(float(run(jnp.asarray(ENDS[1] / n))) - exact) for n in steps]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.75


def test_kuttas_error_estimate():
    """On y' = y it is h (k₄ - k₅)/6 = h⁴/72 - h⁵/144; twin: not h⁴/144."""
    y1, error, *_ = RK4().step(diffrax.ODETerm(lambda t, y, args: y), 0.0, 1e-2, 1.0, None, None, True)
    np.testing.assert_allclose(y1, np.sum(1e-2 ** np.arange(5) / [1, 1, 2, 6, 24]), rtol=1e-15)
    assert abs(error - 1e-8 / 72 + 1e-10 / 144) < 1e-16 < abs(error - 1e-8 / 144)


def test_zero_weights_cost_nothing():
    """Prince and Dormand's tableau has 35 of its 91 weights at zero: a step multiplies by none of them."""
    term, y = diffrax.ODETerm(lambda t, y, args: jnp.sin(y)), jnp.asarray(1.0)
    step = lambda method: lambda y: method.step(term, 0.0, 0.1, y, None, None, True)[:2]
    operations = [e.primitive.name for e in jax.make_jaxpr(step(Dopri8()))(y).jaxpr.eqns]
    weights = [w for row in diffrax.Dopri8.tableau.a_lower for w in row]
    used = sum(w != 0 for w in [*weights, *diffrax.Dopri8.tableau.b_sol, *diffrax.Dopri8.tableau.b_error])
    assert used < operations.count("mul") <= used + 30
