"""First-order states in periodic orbits: multipliers by matrix exponentials and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg

import lagjax as lj
from tests.analysis.test_flow import BELT, stick_slip

# A driven oscillator that a filter of its own position pulls, and the integral of its square.
FILTERED = {"k": 0.3, "tau": 0.7, "c": 0.2, "f": 0.5, "omega": 1.3}
PERIOD = 2 * np.pi / FILTERED["omega"]
START = {"x": 0.1, "z": 0.0, "cost": 0.0}, {"x": 0.0}


def driven(t, q, v, p):
    """A unit mass on a spring, with a drive."""
    return 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2 + q["x"] * p["f"] * jnp.cos(p["omega"] * t)


def lagging(t, q, v, p):
    """A filter of first order."""
    return (q["x"] - q["z"]) / p["tau"]


filtered = lj.System(
    driven,
    force=lambda t, q, v, p: {"x": p["k"] * q["z"], "z": 0.0, "cost": 0.0},
    dissipation=lambda t, q, v, p: 0.5 * p["c"] * v["x"] ** 2,
    states={"z": lagging, "cost": lambda t, q, v, p: q["x"] ** 2},
)


def matrix_of(p):
    """x, z and the velocity of x obey y' = A y + drive."""
    return np.array([[0, 0, 1], [1 / p["tau"], -1 / p["tau"], 0], [-1, p["k"], -p["c"]]])


def response(p):
    """Their complex amplitudes."""
    return np.linalg.solve(1j * p["omega"] * np.eye(3) - matrix_of(p), [0, 0, p["f"]])


def test_a_quadrature_has_no_periodic_value():
    """It is named, with its remedy."""
    with pytest.raises(ValueError, match="state 'cost' has no periodic value.*\n.*\nFix: relative=\"cost\""):
        lj.periodic_orbit(filtered, START, PERIOD, FILTERED)


@pytest.mark.exhaustive
def test_linear():
    """M = exp(A T) whatever v says of z, multipliers and exponents are those of A, the orbit its resonance, ∫x² known.

    Twin: without the filter's pull M is another.
    """
    p, matrix = FILTERED, matrix_of(FILTERED)
    find = lambda f: lj.periodic_orbit(filtered, START, PERIOD, p | {"f": f}, relative="cost")
    orbit, exact = find(p["f"]), linalg.expm(matrix * PERIOD)
    np.testing.assert_allclose([orbit.q["x"], orbit.q["z"], orbit.v["x"]], response(p).real, atol=1e-11)
    # The rate of z is that of its function.
    np.testing.assert_allclose(orbit.v["z"], (orbit.q["x"] - orbit.q["z"]) / p["tau"], rtol=1e-12)
    spent = 0.5 * abs(response(p)[0]) ** 2 * PERIOD
    np.testing.assert_allclose(orbit.shift["cost"], spent, rtol=1e-10)
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(mode(lambda f: find(f).shift["cost"])(p["f"]), 2 * spent / p["f"], rtol=1e-8)
    found = lj.floquet(orbit)
    assert found.words == ("shift of cost",) and found.trivial.tolist() == [True, False, False, False]
    # In the order cost, x, z and their rates.
    np.testing.assert_allclose(found.monodromy[np.ix_([1, 2, 4], [1, 2, 4])], exact, atol=1e-11)
    np.testing.assert_array_equal(found.monodromy[:, [3, 5]], 0.0)
    of = lambda m: np.sort_complex(np.exp(np.linalg.eigvals(m) * PERIOD))
    np.testing.assert_allclose(np.sort_complex(np.asarray(found.multipliers[1:])), of(matrix), rtol=1e-10)
    np.testing.assert_allclose([found.product, found.liouville], np.exp(np.trace(matrix) * PERIOD), rtol=1e-9)
    assert np.abs(of(matrix_of(p | {"k": 0.0})) - of(matrix)).max() > 0.05
    branch = lj.continue_orbits(orbit, along="k", to=0.5)
    np.testing.assert_allclose(branch.q["z"][-1], response(p | {"k": 0.5})[1].real, rtol=1e-9)
    grown = lj.lyapunov_exponents(filtered, orbit.q, orbit.v, p, ts=np.linspace(0.0, 30 * PERIOD, 301), count=4)
    rates = np.sort([0.0, *np.linalg.eigvals(matrix).real])[::-1]
    np.testing.assert_allclose(grown.exponents, rates, atol=0.02)
    np.testing.assert_allclose([np.sum(grown.exponents), grown.liouville], np.trace(matrix), atol=1e-7)


@pytest.mark.exhaustive
def test_stick_slip_beside_a_filter():
    """A filter of the block's place has its own multiplier e^(-T/τ) beside the cycle's 1 and 0, of the same period."""
    block = lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * p["k"] * q["x"] ** 2
    rubbing = lj.Friction(
        lambda t, q, v, p: v["x"] - p["V"], lambda p: p["mu"], normal=1.0, static=lambda p: p["static"]
    )
    on_belt = lj.System(block, states={"z": lagging}, elements={"belt": rubbing})
    period = stick_slip(BELT)
    orbit = lj.periodic_orbit(on_belt, ({"x": 0.1, "z": 0.1}, {"x": 0.25}), 1.1 * period, BELT | {"tau": 5.0})
    np.testing.assert_allclose(orbit.period, period, rtol=1e-10)
    found = lj.floquet(orbit)
    np.testing.assert_allclose(found.multipliers, [1.0, np.exp(-period / 5.0), 0.0], atol=1e-9)
    assert found.trivial.tolist() == [True, False, False]
