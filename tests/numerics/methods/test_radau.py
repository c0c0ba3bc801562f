"""Radau IIA and its Newton iteration: order, stability, published stiff end states, derivatives, failures."""

from functools import cache
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from lagjax.numerics import radau
from lagjax.numerics.radau import Radau5, SimplifiedNewton, with_tolerances
from tests.numerics.methods.driven_pendulum import in_numpy
from tests.tiers import exhaustive_but

EXACT = SimplifiedNewton(rtol=1e-12, atol=1e-14)
OF_CONTROLLER = diffrax.with_stepsize_controller_tols(SimplifiedNewton)


def solve(field, y0, args=None, *, tol=1e-8, atol=None, t1=1.0, ts=None, method=None, **options):
    """An adaptive solve by plain diffrax."""
    control = diffrax.PIDController(rtol=tol, atol=tol if atol is None else atol)
    saveat = diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), Radau5() if method is None else method, 0.0, t1, options.pop("dt0", 1e-6), y0, args,
        saveat=saveat, stepsize_controller=control, max_steps=2**14, throw=False, **options,
    )  # fmt: skip


# The method ----------------------------------------------------------------------------------------------------------


def test_tableau():
    """The simplifying assumptions B(5) and C(3) hold, B(6) and C(4) do not, and gamma has its closed form."""
    moments = lambda k: radau.A @ radau.C ** (k - 1) - radau.C**k / k
    for k in range(1, 6):
        assert abs(moments(k)[2]) < 1e-15
    assert abs(moments(6)[2]) > 1e-3
    assert np.max(np.abs([moments(k) for k in (1, 2, 3)])) < 1e-15
    assert np.max(np.abs(moments(4))) > 1e-3
    assert abs(radau.GAMMA - (3 + np.cbrt(9.0) - np.cbrt(3.0))) < 1e-13


def turning(t, y, args):
    """y' = z y in the complex plane, and another term that makes it blow up."""
    along, across, explodes = args
    return jnp.stack([along * y[0] - across * y[1] + explodes * (1 + y[0] ** 2), across * y[0] + along * y[1]])


def a_step(length, y0, args):
    """The end of a step from 0, its error, whether it succeeded, and the stages."""
    method, term = Radau5(root_finder=EXACT), diffrax.ODETerm(turning)
    state = method.init(term, 0.0 * length, length, y0, args)
    y1, error, dense, _, result = method.step(term, 0.0 * length, length, y0, args, state, False)
    return y1, error, result == diffrax.RESULTS.successful, dense["stages"]


Z = np.array([-1e6, -1e2, -3.0, 0.5, 1e-3j, 1j, 30j, 1e6j, -1 + 2j, -50 + 1e4j])
# Length of the step, start, z, and whether it explodes: into tan(0.1) and beyond its pole.
CASES = np.array([*((1, 1, z, 0) for z in Z), (0.1, 0, 0, 1), (30, 0, 0, 1), (1, 1, np.nan, 0)])


@cache
def steps():
    """All these steps, in lanes: y, its derivative by the real part of z, and the rest of `a_step`."""

    @jax.jit
    @jax.vmap
    def both(length, start, along, across, explodes):
        step = lambda along: a_step(length, jnp.stack([start, 0.0]), (along, across, explodes))
        (y1, *others), (slope, *_) = jax.jvp(step, (along,), (jnp.ones(()),))
        return y1, slope, *others

    length, start, z, explodes = CASES.T
    return jax.tree.map(np.asarray, both(length.real, start.real, z.real, z.imag, explodes.real))


def stages_of(z):
    """The stages of y' = z y from 1, less 1: (1 - z A)^-1 - 1."""
    return np.linalg.solve(np.eye(3) - z * radau.A, np.ones(3)) - 1


def test_stability():
    """One step is R(z) of Hairer & Wanner II, table IV.3.3 in all of the left half-plane; R(-1e6) = 3e-6 (L-stable)."""
    y1, slope, *_ = (x[: len(Z)] for x in steps())
    above, below = 1 + 2 * Z / 5 + Z**2 / 20, 1 - 3 * Z / 5 + 3 * Z**2 / 20 - Z**3 / 60
    found = y1 @ [1, 1j]
    np.testing.assert_allclose(found, above / below, rtol=1e-9, atol=1e-13)
    assert np.max(np.abs(found[np.real(Z) <= 0])) <= 1 + 1e-15
    assert abs(found[0]) < 4e-6
    rates = ((2 / 5 + Z / 10) * below - above * (-3 / 5 + 3 * Z / 10 - Z**2 / 20)) / below**2
    np.testing.assert_allclose(slope @ [1, 1j], rates, rtol=1e-8, atol=1e-13)


def test_error_estimate():
    """It is that of Hairer & Wanner II, (8.19), and where that rejects the step (8.20); twin: (8.19) everywhere."""
    s6, gamma = np.sqrt(6.0), 1 / radau.GAMMA
    weighted = [gamma / 3 * np.dot([-13 - 7 * s6, -13 + 7 * s6, -1.0], stages_of(z)) for z in Z]
    once = (gamma * Z + weighted) / (1 - gamma * Z)
    twice = (gamma * Z * (1 + once) + weighted) / (1 - gamma * Z)
    rejected = np.abs(once) > 1e-12
    assert 0 < rejected.sum() < len(Z) and np.max(np.abs(twice - once)) > 0.1
    np.testing.assert_allclose(steps()[2][: len(Z)] @ [1, 1j], np.where(rejected, twice, once), rtol=1e-7, atol=1e-15)


def test_dense_output():
    """Within a step it is the polynomial through its stages, of degree 3."""
    i = int(np.flatnonzero(Z == -3.0)[0])
    dense = radau.Collocation(0.0, 1.0, np.ones(1), steps()[4][i, :, :1])
    at = in_numpy(dense.at, 0.0)
    np.testing.assert_allclose([at(t)[0] for t in (0.0, *radau.C)], [1.0, *(1 + stages_of(-3.0))], rtol=1e-10)


def test_unsolvable_step():
    """A step whose equations have no solution, or of NaN, says so, has infinite error, and is finite itself."""
    y1, slope, error, success, _ = (x[-3:] for x in steps())
    np.testing.assert_array_equal(success, [True, False, False])
    assert abs(y1[0, 0] - np.tan(0.1)) < 1e-6 and np.isfinite(error[0]).all()
    assert np.isfinite(y1[1:]).all() and np.isinf(error[1:]).all() and np.isfinite(slope[:2]).all()


# Stiff equations -----------------------------------------------------------------------------------------------------


def reaction(t, y, args):
    """Robertson's."""
    slow, fast = -0.04 * y[0] + 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return jnp.stack([slow, -slow - fast, fast])


def van_der_pol(t, y, epsilon):
    """Van der Pol's equation in Liénard's time."""
    return jnp.stack([y[1], ((1 - y[0] ** 2) * y[1] - y[0]) / epsilon])


PROBLEMS = {
    "ROBER": (reaction, [1.0, 0, 0], None, 1e11, [0.2083340149701255e-7, 0.8333360770334713e-13, 0.999999979166505]),
    "VDPOL": (van_der_pol, [2.0, 0.0], 1e-6, 2.0, [0.1706167732170483e1, -0.8928097010247975]),
}


@pytest.mark.slow
@pytest.mark.parametrize("problem", exhaustive_but(("ROBER",), PROBLEMS))
def test_published_values(problem):
    """Stiff problems of the IVP test set, to 10 rtol of their published end states."""
    field, y0, args, t1, published = PROBLEMS[problem]
    end = jax.jit(lambda tol: solve(field, jnp.array(y0), args, tol=tol, atol=1e-8 * tol, t1=t1))
    for tol in (1e-6, 1e-8):
        found = end(jnp.asarray(tol))
        np.testing.assert_allclose(found.ys[0], published, rtol=10 * tol)
        assert found.stats["num_steps"] < 2000


def spring_pendulum(t, y, k):
    """A unit mass on a spring of unit length."""
    q, v = y
    r = jnp.sqrt(q @ q)
    return v, -k * (1 - 1 / r) * q - jnp.array([0.0, 9.8125])


def rod_like(k):
    """A start on the slow motion of the spring pendulum: at angle 0.9, turning by 2."""
    angle, rate, g = 0.9, 2.0, 9.8125
    along, across = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    r = (k + g * np.cos(angle)) / (k - rate**2)
    return r * along, r * rate * across - 3 * g * np.sin(angle) * rate / k * along


@pytest.mark.slow
def test_stiff_springs_cost_no_steps():
    """With velocity errors weighted by h, k = 1e6 and 1e10 take under 300 steps; error below 1e-7 + 100/k."""
    integrate = pytest.importorskip("scipy.integrate")
    swing = lambda t, y: [y[1], -9.8125 * np.sin(y[0])]
    angle = integrate.solve_ivp(swing, (0, 2), [0.9, 2.0], "DOP853", rtol=2.5e-14, atol=1e-15).y[0, -1]
    method = Radau5(step_powers=(0, 1))
    end = jax.jit(lambda k, *y: solve(spring_pendulum, y, k, t1=2.0, method=method))
    for k in (1e6, 1e8, 1e10):
        found = end(k, *rod_like(k))
        assert found.stats["num_steps"] < 300
        np.testing.assert_allclose(found.ys[0][0], [np.sin(angle), -np.cos(angle)], atol=1e-7 + 100 / k)


# Derivatives ---------------------------------------------------------------------------------------------------------


# Lanes, precision, failure -------------------------------------------------------------------------------------------


def towards(t, y, k):
    """Decay onto a cosine."""
    return -k * (y - jnp.cos(t))


@pytest.mark.slow
def test_lanes_in_float32():
    """Lanes of stiffness 1 to 1e7 in single precision: the NaN lane fails, the others are correct."""
    k = np.array([1.0, 1e3, 1e5, 1e7, np.nan], np.float32)
    end = lambda k: solve(towards, jnp.zeros((), k.dtype), k, tol=1e-4, dt0=np.float32(0.01))
    found = jax.jit(jax.vmap(end))(k)
    assert found.ys.dtype == np.float32
    exact = (k**2 * np.cos(1) + k * np.sin(1) - k**2 * np.exp(-k)) / (1 + k**2)
    np.testing.assert_allclose(found.ys[:4, 0], exact[:4], atol=5e-4)
    np.testing.assert_array_equal(found.result == diffrax.RESULTS.successful, [True, True, True, True, False])


# The root finder -----------------------------------------------------------------------------------------------------


def test_jacobian_is_renewed_where_it_fails():
    """From a start with the wrong slope the kept Jacobian diverges with that result; recomputed, it finds the root."""

    def roots(slow):
        finder = SimplifiedNewton(rtol=1e-12, atol=1e-12, slow=slow)
        find = lambda y: optx.root_find(lambda y, a: y**3 + y - a, finder, y, 2.0, throw=False, max_steps=40)
        found = jax.vmap(find)(np.array([[0.0], [1.2]]))
        codes = (optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence)
        return found.value[:, 0], *(found.result == code for code in codes)

    y, well, diverged = map(np.concatenate, zip(*jax.jit(lambda: (roots(0.3), roots(np.inf)))()))
    good = np.array([True, True, False, True])
    np.testing.assert_array_equal([well, diverged], [good, ~good])
    np.testing.assert_allclose(y[good], 1.0, rtol=1e-12)


def test_tolerances_for_constant_steps():
    """A root finder without a controller gets the given tolerances; an implicit Euler step is then y/(1 + h k)."""
    method: Any = with_tolerances(diffrax.ImplicitEuler(root_finder=OF_CONTROLLER()), 1e-10, 1e-12)
    assert method.root_finder.rtol == 1e-10 and method.root_finder.atol == 1e-12
    term = diffrax.ODETerm(lambda t, y, k: -k * y)
    y1 = jax.jit(lambda y: method.step(term, 0.0, 0.25, y, 1e3, method.init(term, 0.0, 0.25, y, 1e3), False)[0])(1.0)
    assert abs(y1 * 251.0 - 1) < 1e-9
    explicit = diffrax.Tsit5()
    assert with_tolerances(explicit, 1e-10, 1e-12) is explicit
