"""First-order states in periodic orbits: multipliers by matrix exponentials and by SciPy's variational equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, linalg, optimize

import lagjax as lj
from tests.analysis.orbits.test_switching_flow import BELT, stick_slip

# A driven oscillator that a filter of its own position pulls.
FILTERED = {"k": 0.3, "tau": 0.7, "c": 0.2, "f": 0.5, "omega": 1.3}


def driven(t, q, v, p):
    """A unit mass on a spring, with a drive."""
    return 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2 + q["x"] * p["f"] * jnp.cos(p["omega"] * t)


def pulled(t, q, v, p):
    """The pull of the filter."""
    return {"x": p["k"] * q["z"], "z": 0.0}


def damping(t, q, v, p):
    """R of a damper."""
    return 0.5 * p["c"] * v["x"] ** 2


def lagging(t, q, v, p):
    """A filter of first order."""
    return (q["x"] - q["z"]) / p["tau"]


filtered = lj.System(driven, force=pulled, dissipation=damping, states={"z": lagging})


def filtered_matrix(p):
    """x, z and the velocity of x obey y' = A y + drive."""
    return np.array([[0, 0, 1], [1 / p["tau"], -1 / p["tau"], 0], [-1, p["k"], -p["c"]]])


@pytest.mark.exhaustive
def test_linear():
    """M = exp(A T) of 3 x 3 whatever v says of z, with three multipliers; the orbit is the resonance of A.

    Twin: without the filter's pull M is another.
    """
    p, period = FILTERED, 2 * np.pi / FILTERED["omega"]
    matrix = filtered_matrix(p)
    exact = linalg.expm(matrix * period)
    orbit = lj.periodic_orbit(filtered, ({"x": 0.1, "z": 0.0}, {"x": 0.0}), period, p)
    response = np.linalg.solve(1j * p["omega"] * np.eye(3) - matrix, [0, 0, p["f"]]).real
    np.testing.assert_allclose([orbit.q["x"], orbit.q["z"], orbit.v["x"]], response, atol=1e-11)
    # The rate of z is that of its function.
    np.testing.assert_allclose(orbit.v["z"], (orbit.q["x"] - orbit.q["z"]) / p["tau"], rtol=1e-12)
    found = lj.floquet(orbit)
    assert found.multipliers.shape == (3,) and not found.trivial.any()
    np.testing.assert_allclose(found.monodromy[:3, :3], exact, atol=1e-11)
    np.testing.assert_array_equal(found.monodromy[:, 3], 0.0)
    of = lambda m: np.sort_complex(np.exp(np.linalg.eigvals(m) * period))
    np.testing.assert_allclose(np.sort_complex(np.asarray(found.multipliers)), of(matrix), rtol=1e-10)
    np.testing.assert_allclose([found.product, found.liouville], np.exp(np.trace(matrix) * period), rtol=1e-9)
    assert np.abs(of(filtered_matrix(p | {"k": 0.0})) - of(matrix)).max() > 0.05


# Van der Pol's oscillator, driven by an actuator that lags, and what the actuator spends.
LAGS = {"mu": 0.8, "tau": 0.5}


def spring(t, q, v, p):
    """A unit mass on a spring."""
    return 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2


def actuated(t, q, v, p):
    """The force of the actuator."""
    return {"x": q["u"], "u": 0.0, "cost": 0.0}


def actuator(t, q, v, p):
    """The actuator follows van der Pol's force."""
    return (p["mu"] * (1 - q["x"] ** 2) * v["x"] - q["u"]) / p["tau"]


def cost(t, q, v, p):
    """What is spent in a unit of time."""
    return q["u"] ** 2


van_der_pol = lj.System(spring, force=actuated, states={"u": actuator, "cost": cost})
START = {"x": 2.0, "u": 0.0, "cost": 0.0}, {"x": 0.0}


def test_a_quadrature_has_no_periodic_value():
    """It is named, with its remedy."""
    with pytest.raises(ValueError, match="state 'cost' has no periodic value.*\n.*\nFix: relative=\"cost\""):
        lj.periodic_orbit(van_der_pol, START, 6.3, LAGS)


def variational(state, p, period):
    """By SciPy: (x, v, u) after a period, the matrix of its derivatives, and what was spent."""

    def rate(t, y):
        x, v, u = y[:3]
        push = np.array([-2 * p["mu"] * x * v, p["mu"] * (1 - x * x), -1]) / p["tau"]
        jacobian = np.array([[0, 1, 0], [-1, 0, 1], push])
        pushed = (p["mu"] * (1 - x * x) * v - u) / p["tau"]
        return [v, -x + u, pushed, *(jacobian @ y[3:12].reshape(3, 3)).ravel(), u * u]

    y0 = np.concatenate([state, np.eye(3).ravel(), [0.0]])
    y = integrate.solve_ivp(rate, [0, period], y0, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return y[:3], y[3:12].reshape(3, 3), y[12]


def by_scipy(orbit, p):
    """v, u and the period with the orbit's x at the start."""
    x = float(orbit.q["x"])

    def left(unknown):
        v, u, period = unknown
        return variational([x, v, u], p, period)[0] - [x, v, u]

    return optimize.root(left, [float(orbit.v["x"]), float(orbit.q["u"]), float(orbit.period)], tol=1e-14).x


@pytest.mark.exhaustive
def test_an_actuator_that_lags():
    """The period and the multipliers to 1e-9 of SciPy's, and the cost of a period; derivatives; a branch; exponents.

    Twin: without the lag the period is another.
    """
    find = lambda mu: lj.periodic_orbit(van_der_pol, START, 6.3, LAGS | {"mu": mu}, relative="cost")
    orbit = find(LAGS["mu"])
    v, u, period = by_scipy(orbit, LAGS)
    np.testing.assert_allclose(orbit.period, period, rtol=1e-11)
    _, matrix, spent = variational([float(orbit.q["x"]), v, u], LAGS, period)
    np.testing.assert_allclose(orbit.shift["cost"], spent, rtol=1e-10)
    found = lj.floquet(orbit)
    assert found.words == ("along the motion", "shift of cost") and found.trivial.sum() == 2
    exact = np.sort(np.linalg.eigvals(matrix).real)[::-1]
    np.testing.assert_allclose(found.multipliers[1:], exact, atol=1e-9)
    lagless = 6.286  # That of van der Pol's own oscillator is 6.2869 at mu = 0.8, to a digit.
    assert abs(period - lagless) > 0.05

    h = 1e-5
    ends = [by_scipy(orbit, LAGS | {"mu": LAGS["mu"] + side * h})[2] for side in (1, -1)]
    slope = (ends[0] - ends[1]) / (2 * h)
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(mode(lambda mu: find(mu).period)(LAGS["mu"]), slope, rtol=1e-7)
    branch = lj.continue_orbits(orbit, along="mu", to=1.0)
    np.testing.assert_allclose(branch.period[-1], by_scipy(orbit, LAGS | {"mu": 1.0})[2], rtol=1e-10)
    ts = np.linspace(0.0, 30 * period, 301)
    exponents = lj.lyapunov_exponents(van_der_pol, orbit.q, orbit.v, LAGS, ts=ts, count=4)
    np.testing.assert_allclose(exponents.exponents, np.log(np.abs([1.0, 1.0, *exact[1:]])) / period, atol=1e-7)
    np.testing.assert_allclose(exponents.liouville, -1 / LAGS["tau"], rtol=1e-9)


@pytest.mark.exhaustive
def test_without_mass():
    """Two equal vortices, whose coordinates are all of first order: four multipliers, and M in closed form.

    At the distance d they turn at 1/(π d²), so that a larger distance turns them back by 2π a length in a turn.
    Twin: a period off by a part in 1000 does not bring them back.
    """

    def vortices(t, q, v, p):
        """Two vortices of strength 1 (Kirchhoff)."""
        return 0.5 * jnp.sum(q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]) + jnp.log(jnp.sum((q[0] - q[1]) ** 2)) / (4 * np.pi)

    place, period = np.array([[1.0, 0.0], [-1.0, 0.0]]), 2 * np.pi * np.pi * 4
    found = lj.floquet(lj.System(vortices), 0.0, place, 0 * place, None, period)
    exact, turned = np.eye(8)[:, :4], 2 * np.pi * np.array([1, 0, -1, 0])
    exact[1, :4] += turned
    exact[3, :4] -= turned
    np.testing.assert_allclose(found.monodromy[:4, :4], exact[:4], atol=1e-8)
    assert found.multipliers.shape == (4,)
    np.testing.assert_allclose(found.multipliers, 1.0, atol=1e-4)
    with pytest.raises(ValueError, match="does not come back"):
        lj.floquet(lj.System(vortices), 0.0, place, 0 * place, None, 1.001 * period)


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
