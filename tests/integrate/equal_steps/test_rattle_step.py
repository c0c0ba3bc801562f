"""The explicit splitting with constraints on positions: RATTLE, and steps of it after each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.equal_steps import rattle_step
from lagjax.numerics import lengths
from tests.behaviour.test_orders import within
from tests.integrate.equal_steps.test_equal_steps import exact as exact  # noqa: PLC0414
from tests.integrate.equal_steps.test_equal_steps import measured

G = 9.81
START = np.array([np.sin(1.5), -np.cos(1.5)])


def fall(t, q, v, g):
    """A mass of one in a vertical plane."""
    return 0.5 * jnp.sum(v**2) - g * q[1]


def length(t, q, g):
    """A rod of length one to the origin."""
    return jnp.sum(q**2) - 1.0


rod = lj.System(fall, constraints={"rod": lj.Holonomic(length)})


def run(system, ts, q0=START, v0=(0.0, 0.0), dt=0.01):
    """By lj.Splitting(4)."""
    return lj.integrate(system, q0, np.asarray(v0), G, ts=ts, method=lj.Splitting(4), dt0=dt, estimate_error=False)


STEPS = {2: (160, 226, 320), 4: (40, 56, 80), 6: (20, 28, 40), 8: (16, 20, 26)}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "order",
    [pytest.param(8, marks=pytest.mark.slow), *(pytest.param(k, marks=pytest.mark.exhaustive) for k in (2, 4, 6))],
)
def test_order_with_rods(exact, order):  # noqa: F811
    """Its order in places, velocities and multipliers of a double pendulum of two rods, against angles by SciPy."""
    found = measured(exact, "constrained", lj.Splitting(order), STEPS[order])
    assert all(within(order, found)), found


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore")
def test_a_wrong_length_would_be_seen(exact, monkeypatch):  # noqa: F811
    """Failing twin: the lengths of Suzuki's steps with another root."""
    part = 1 / (4 - 4 ** (1 / 2.9))
    monkeypatch.setattr(rattle_step, "lengths", lambda order: np.array([part, part, 1 - 4 * part, part, part]))
    # With a pace of one it is a program of its own: programs are kept.
    found = measured(exact, "constrained", lj.Splitting(4, pace=lambda t, q, params: 1.0), STEPS[4])
    assert not any(within(4, found)), found


@pytest.mark.exhaustive
def test_half_a_million_steps_on_a_rod():
    """The rod's length to round-off, the energy, its tension, and the way back."""
    ts = np.linspace(0.0, 5000.0, 51)
    traj = run(rod, ts)
    assert int(traj.stats["num_steps"]) == 500_000
    q, v = np.asarray(traj.q), np.asarray(traj.v)
    np.testing.assert_allclose(np.sum(q**2, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.sum(q * v, axis=1), 0.0, atol=1e-13)
    h = np.asarray(traj.jacobi_integral())
    assert np.ptp(h) < 1e-6 and abs(np.polyfit(ts, h, 1)[0]) * ts[-1] < 1e-9
    # The force 2 λ q turns v, against g = 9.81 along -y.
    np.testing.assert_allclose(traj.multipliers["rod"], -(np.sum(v**2, axis=1) - G * q[:, 1]) / 2, rtol=1e-9)
    short = np.linspace(0.0, 100.0, 51)
    there = run(rod, short)
    back = run(rod, short, q0=np.asarray(there.q[-1]), v0=-np.asarray(there.v[-1]))
    np.testing.assert_allclose(back.q[-1], START, atol=1e-11)


@pytest.mark.exhaustive
def test_a_rod_given_three_times():
    """Constraints that depend on each other: the motion of one rod, its tension shared by the shortest multipliers."""
    again = {
        "rod": lj.Holonomic(length),
        "half": lj.Holonomic(lambda t, q, g: (jnp.sum(q**2) - 1.0) / 2),
        "root": lj.Holonomic(lambda t, q, g: jnp.sqrt(jnp.sum(q**2)) - 1.0),
    }
    ts = np.linspace(0.0, 10.0, 51)
    one, three = run(rod, ts), run(lj.System(fall, constraints=again), ts)
    np.testing.assert_allclose(three.q, one.q, atol=1e-13)
    # Rows 1, 1/2 and 1/2 of the first one: the shortest is in proportion to them.
    shares = [three.multipliers[name] / one.multipliers["rod"] for name in again]
    np.testing.assert_allclose(np.stack(shares), np.array([1.0, 0.5, 0.5])[:, None] / 1.5 * np.ones(51), rtol=1e-10)


@pytest.mark.exhaustive
def test_a_pivot_that_moves():
    """Order 4 where the constraint depends on time, against the equation of the angle by SciPy's tolerances."""
    moving = lj.System(
        fall,
        constraints={"rod": lj.Holonomic(lambda t, q, g: length(t, q - jnp.array([0.2, 0.0]) * jnp.sin(3 * t), g))},
    )
    angle = lj.System(
        lambda t, q, v, g: 0.5 * v**2 + 0.6 * jnp.cos(3 * t) * v * jnp.cos(q) + g * jnp.cos(q)
    )  # x = 0.2 sin 3t + sin q, without what depends on t alone
    ts = np.linspace(0.0, 8.0, 9)
    by_angle = lj.integrate(angle, 0.6, 0.0, G, ts=ts, rtol=1e-13, estimate_error=False).q
    places = np.stack([0.2 * np.sin(3 * ts) + np.sin(by_angle), -np.cos(by_angle)], axis=1)

    def error(dt):
        start = np.array([np.sin(0.6), -np.cos(0.6)]), np.array([0.6, 0.0])
        found = lj.integrate(moving, *start, G, ts=ts, method=lj.Splitting(4), dt0=dt, estimate_error=False)
        return np.max(np.abs(found.q - places))

    assert abs(np.log2(error(jnp.asarray(0.02)) / error(jnp.asarray(0.01))) - 4) < 0.35


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 6])
def test_steps_on_a_rod_are_symplectic(order):
    """The map of (angle, momentum) keeps areas. Twin: that of a method that does not is told apart."""

    def after(y, method):
        """After a hundred steps."""
        (angle, rate), r = y, jnp.array([jnp.sin(y[0]), -jnp.cos(y[0])])
        start = r, rate * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        traj = lj.integrate(
            rod, *start, G, ts=np.array([0.0, 2.0]), method=method, dt0=0.02, estimate_error=False,
            **({} if isinstance(method, lj.Splitting) else {"rtol": 1e-4}),
        )  # fmt: skip
        q, v = traj.q[-1], traj.v[-1]
        return jnp.stack([jnp.arctan2(q[0], -q[1]), -q[1] * v[0] + q[0] * v[1]])

    areas = [
        jnp.linalg.det(jax.jit(jax.jacfwd(lambda y, method=method: after(y, method)))(jnp.array([1.5, 0.3])))
        for method in (lj.Splitting(order), lj.Tsit5())
    ]
    assert abs(areas[0] - 1) < 1e-12 < 1e-7 < abs(areas[1] - 1)


@pytest.mark.exhaustive
def test_derivatives_in_both_modes():
    """d(end)/dg, forward and in reverse, and as by steps that adapt."""

    def end(g, **options):
        options = {"ts": np.array([0.0, 3.0]), "estimate_error": False} | options
        return lj.integrate(rod, START, np.zeros(2), g, **options).q[-1, 0]

    split = lambda g: end(g, method=lj.Splitting(8), dt0=0.02)
    forward, reverse = jax.jit(lambda g: (jax.jvp(split, (g,), (1.0,))[1], jax.grad(split)(g)))(G)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    np.testing.assert_allclose(forward, jax.jit(jax.grad(lambda g: end(g, rtol=1e-12)))(G), rtol=1e-9)


def test_lengths():
    """Conditions of order: sums of the odd powers, of which Kahan and Li's are solved to round-off."""
    for order, powers in ((4, (3,)), (6, (3, 5)), (8, (3, 5, 7))):
        parts = lengths(order)
        np.testing.assert_allclose([np.sum(parts**k) for k in (1, *powers)], [1.0, *(0.0 for _ in powers)], atol=1e-14)
        np.testing.assert_array_equal(parts, parts[::-1])


@pytest.mark.exhaustive
def test_a_step_that_is_too_long():
    """A rod cannot be followed through more than a turn in a step: which one would do is said."""
    with pytest.raises(RuntimeError, match=r"(?s)stopped at t = 0, .*dt0=0\.\d+, with which a step is solved there"):
        run(rod, np.array([0.0, 8.0]), dt=1.5)


@pytest.mark.slow
def test_an_oscillation_that_grows():
    """A spring in steps of three of its radians: which step would do is said."""
    spring = lj.System(lambda t, q, v, k: 0.5 * v**2 - 500.0 * k * q**2)
    with pytest.raises(RuntimeError, match=r"(?s)of the period 0\.0634, turns by 3 radians.*Fix: dt0=0\.01;"):
        lj.integrate(spring, 1.0, 0.0, G, ts=[0.0, 90.0], method=lj.Splitting(2), dt0=0.0303, estimate_error=False)


def test_what_it_refuses():
    """Velocity constraints, in words."""
    knife = lj.Nonholonomic(lambda t, q, v, p: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))
    sled = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2), constraints={"knife": knife})
    with pytest.raises(ValueError, match=r"(?s)'knife' restricts velocities.*lj.Gauss\(3\)"):
        lj.integrate(sled, np.zeros(3), np.array([1.0, 0, 1]), ts=[0.0, 1.0], method=lj.Splitting(2), dt0=0.1)
