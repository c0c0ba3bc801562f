"""Outputs between the ends of steps: as accurate as the steps, on the constraints, differentiable in both modes.

The pendulum's exact motion, in Jacobi's elliptic functions, is the oracle.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import lagjax as lj
from lagjax.numerics import Quintic
from tests.behaviour.test_bad_input import refusal
from tests.by_hand import swing
from tests.by_numpy import by_numpy
from tests.systems import pendulum

PARAMS = {"g": 1.0, "l": 1.0}
HALF, MANY, FEW = np.sin(0.6), np.linspace(0.0, 6.0, 121), np.array([0.0, 6.0])
# As many numbers as reverse mode replays for; their sum is one.
shared = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.sum(p) * jnp.cos(q))
SHARES = np.full(40, 1 / 40)
rod = lj.System(
    lambda t, q, v, p: 0.5 * (v @ v) - jnp.sum(p) * q[1], {"rod": lj.Holonomic(lambda t, q, p: q @ q - 1.0)}
)
between = {"outputs": "interpolated", "estimate_error": False}


def exact(t, half=HALF):
    """The angle and its rate, from rest at 1.2, or where the sine of half the angle is another."""
    return swing(t, 2 * np.arcsin(half))


def worst(traj):
    """The largest errors of q and v at the outputs."""
    return [np.max(np.abs(x - y)) for x, y in zip((traj.q, traj.v), exact(MANY))]


@pytest.mark.parametrize(("end_rate", "orders"), [(1.0, (6, 5)), (1.01, (1, 0))])
def test_order_of_the_polynomial(end_rate, orders):
    """Sixth in q and fifth in v between exact ends; first with a wrong velocity at an end."""

    between = by_numpy(lambda ends, x: Quintic(**ends).at(x))

    def error(h):
        worst = np.zeros(2)
        for t0 in (0.0, 0.5, 1.0, 1.5):
            (q0, q1), (v0, v1) = (x.tolist() for x in exact(np.array([t0, t0 + h])))
            ends = dict(t0=t0, t1=t0 + h, y0=(q0, v0), y1=(q1, end_rate * v1), a0=-np.sin(q0), a1=-np.sin(q1))
            t = t0 + h * np.linspace(0.1, 0.9, 9)
            found = [between(ends, x) for x in t]
            worst = np.maximum(worst, [np.max(np.abs(np.array(x) - y)) for x, y in zip(zip(*found), exact(t))])
        return worst

    coarse, fine = error(0.4), error(0.2)
    for order, a, b in zip(orders, coarse, fine):
        assert np.log2(a / b) == pytest.approx(order, abs=0.35)


def swung(ts, rtol, **how):
    """The pendulum released at 1.2."""
    return lj.integrate(pendulum, 1.2, 0.0, PARAMS, ts=ts, rtol=rtol, **how)


@pytest.mark.parametrize("rtol", [1e-3, 1e-6])
def test_as_accurate_as_the_steps(rtol):
    """Of 121 outputs none is much further off than the end, and no step is added for them."""
    found = swung(MANY, rtol, **between)
    # As many outputs, all but the last in the first step.
    early = swung(np.append(1e-9 * MANY[:-1], 6.0), rtol, **between)
    assert found.stats["num_steps"] == early.stats["num_steps"] < 60 and found.end.q == early.end.q
    assert found.static.method == "Tsit5, outputs interpolated"
    # The phase error of 1e-3 is larger than that of the polynomial; q and v are of order one.
    reached = np.max(np.abs(np.array(exact(6.0)) - [found.end.q, found.end.v]))
    assert max(worst(found)) < 3 * reached + 15 * rtol
    assert "outputs interpolated" in repr(found)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::lagjax.AccuracyWarning")
def test_as_those_of_plain_steps():
    """The same steps as those of Tsit5 alone, and errors that the estimate covers."""
    for rtol in (1e-3, 1e-6):
        plain = swung(FEW, rtol, method=lj.Tsit5(), estimate_error=False)
        judged = swung(MANY, rtol, outputs="interpolated")
        assert judged.stats["num_steps"] == plain.stats["num_steps"] and judged.end.q == plain.end.q
        assert "the outputs: fewer" not in repr(judged) and max(worst(judged)) < 3 * float(np.nanmax(judged.error.v))


def loss(p, q0, ts, **how):
    """A function of all outputs."""
    traj = lj.integrate(shared, q0, 0.0, p, ts=ts, throw=False, **how)
    return jnp.sum(traj.q**2) + jnp.sum(jnp.sin(traj.v))


@pytest.mark.exhaustive
def test_derivatives():
    """The gradient by parameters, start and times, which replays the steps, is right, and the forward one; in lanes."""
    point = SHARES, jnp.asarray(1.2), jnp.asarray(MANY)
    gradient = jax.jit(jax.grad(lambda *x: loss(*x, rtol=1e-5, **between), (0, 1, 2)))
    loose = gradient(*point)
    angle, rate = exact(MANY)
    by_angle, by_rate = 2 * angle, np.cos(rate)
    # At another sum g of the parameters the motion is as fast as √g, and the rate √g as large.
    by_sum = by_angle @ (0.5 * MANY * rate) + by_rate @ (0.5 * rate - 0.5 * MANY * np.sin(angle))
    h = 1e-5
    above, below = (np.array(exact(MANY, np.sin(0.6 + s * h / 2))) for s in (1, -1))
    by_start = np.sum(np.array([by_angle, by_rate]) * (above - below) / (2 * h))
    by_times = by_angle * rate - by_rate * np.sin(angle)
    # A later start delays all of the motion.
    by_times[0] = -np.sum(by_times[1:])
    for a, b in zip(loose, (by_sum * np.ones(40), by_start, by_times)):
        assert np.max(np.abs(a - b)) < 2e-3 * np.max(np.abs(b))
    along = jnp.arange(40.0) / 40, jnp.asarray(0.3)
    pushed = jax.jvp(lambda *x: loss(*x, MANY, rtol=1e-5, **between), point[:2], along)[1]
    assert sum(jnp.sum(a * b) for a, b in zip(loose, along)) == pytest.approx(float(pushed), rel=1e-10)
    # Lanes of different numbers of steps.
    starts = jnp.array([0.2, 1.2, 3.0])
    each = sum(gradient(SHARES, q0, point[2])[0] for q0 in starts)
    together = jax.grad(lambda p: jnp.sum(jax.vmap(lambda q0: loss(p, q0, MANY, rtol=1e-5, **between))(starts)))(SHARES)
    assert jnp.max(jnp.abs(together - each)) < 1e-9 * jnp.max(jnp.abs(together))


@pytest.mark.exhaustive
def test_on_the_constraints():
    """Outputs satisfy them to round-off, with the multiplier there."""
    start = np.array([np.sin(1.2), -np.cos(1.2)]), np.zeros(2)
    traj = lj.integrate(rod, *start, SHARES, ts=MANY, rtol=1e-4, throw=False, **between)
    assert np.max(np.abs(np.sum(traj.q**2, 1) - 1)) < 1e-13 and np.max(np.abs(np.sum(traj.q * traj.v, 1))) < 1e-13
    angle, rate = exact(MANY)
    assert np.max(np.abs(traj.q[:, 0] - np.sin(angle))) < 2e-3
    # 2 λ = -(cos(angle) + rate²) pulls the mass inwards; g = 1.
    assert np.max(np.abs(2 * traj.multipliers["rod"] + np.cos(angle) + rate**2)) < 1e-2


DOWN = {"down": lj.Crossing(lambda t, q, v, m, p: q, terminal=True)}
QUARTER = special.ellipk(HALF**2)


@pytest.mark.slow
def test_beside_events_and_in_float32():
    """An event is found where it is, and ends the outputs; float32 stays float32."""
    traj = lj.integrate(shared, 1.2, 0.0, SHARES, ts=MANY, rtol=1e-6, events=DOWN, throw=False, **between)
    assert traj.events["down"].t[0] == pytest.approx(QUARTER, abs=1e-5)
    assert np.array_equal(np.isnan(traj.q), MANY > QUARTER)
    assert np.nanmax(np.abs(traj.q - exact(MANY)[0])) < 2e-5
    single = lj.integrate(pendulum, np.float32(1.2), np.float32(0.0), PARAMS, ts=MANY.astype(np.float32), **between)
    assert single.q.dtype == np.float32 and max(worst(single)) < 3e-4


def test_refused():
    """Unknown words, and methods whose steps are too long for the polynomial."""
    with refusal(ValueError, "outputs must be 'exact', 'interpolated' or None", 'outputs="exact"'):
        lj.integrate(pendulum, 1.2, 0.0, PARAMS, ts=FEW, outputs="linear")
    with refusal(ValueError, "which Dopri8 does not go with", r"method=lj.Tsit5\(\)"):
        lj.integrate(pendulum, 1.2, 0.0, PARAMS, ts=FEW, outputs="interpolated", method=lj.Dopri8())
