"""What steps of equal length keep: symplecticity, reversibility, orders on motions of every kind, derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.equal_steps import loop
from lagjax.numerics import tableau
from lagjax.scenes import cross_rails
from tests.behaviour.test_orders import ROD_SWING
from tests.integrate.equal_steps.test_equal_steps import TURN, ellipse, kepler, of_momenta
from tests.systems import DOUBLE_PARAMS, DOUBLE_SWING, double_pendulum, double_rods, rods_from_angles

# Steps that are too long for the tolerance are meant.
pytestmark = pytest.mark.filterwarnings("ignore::lagjax.AccuracyWarning")
J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])


def departs(change, x0):
    """‖DᵀJD - J‖, with D the derivative of a change of (q, p)."""
    D = np.asarray(jax.jit(jax.jacfwd(change))(x0))
    return np.max(np.abs(D.T @ J @ D - J))


def motion(system, start, params, ts, method, dt):
    """A motion whose program serves all lengths of steps."""
    options = {"method": method, "dt0": jnp.asarray(dt), "estimate_error": False}
    return lj.integrate(system, *start, params, ts=np.asarray(ts), **options)


def angles_and_momenta(x, span):
    """(angles, their momenta) after a span of the rods' motion, of those before."""
    mass = lambda q: jax.jacfwd(lambda v: momentum(q, v))(jnp.zeros_like(q))
    momentum = lambda q, v: jax.grad(lambda v: double_pendulum.lagrangian(0.0, q, v, DOUBLE_PARAMS))(v)
    q, p = jnp.split(x, 2)
    start = rods_from_angles(q, jnp.linalg.solve(mass(q), p), DOUBLE_PARAMS)
    end = motion(double_rods, start, DOUBLE_PARAMS, [0.0, span], lj.Gauss(3), 0.05).end
    rods = jnp.stack([end.q["first"], end.q["second"] - end.q["first"]])
    moves = jnp.stack([end.v["first"], end.v["second"] - end.v["first"]])
    angles = jnp.arctan2(rods[:, 0], -rods[:, 1])
    rates = jnp.sum(moves * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1), axis=1)
    rates /= jnp.stack([DOUBLE_PARAMS["l1"], DOUBLE_PARAMS["l2"]])
    return jnp.concatenate([angles, momentum(angles, rates)])


def at_swing():
    """The double pendulum's start as (q, p)."""
    q0, v0 = DOUBLE_SWING
    return jnp.concatenate([q0, jax.grad(lambda v: double_pendulum.lagrangian(0.0, q0, v, DOUBLE_PARAMS))(v0)])


@pytest.mark.exhaustive
@pytest.mark.parametrize("stages", [2, 3, 4])
def test_gauss_is_symplectic(stages):
    """One step and thirty of a double pendulum by angles. Twin: `test_equal_steps.test_steps_are_symplectic`."""
    for span in (0.1, 3.0):
        change = lambda x: of_momenta(x, double_pendulum, DOUBLE_PARAMS, lj.Gauss(stages), span)
        assert departs(change, at_swing()) < 1e-12


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_splitting_is_symplectic(order):
    """One step and sixty of an ellipse."""
    for span in (0.1, 6.0):
        change = lambda x: of_momenta(x, kepler, 1.0, lj.Splitting(order), span)
        assert departs(change, jnp.concatenate(ellipse(0.3))) < 1e-12


@pytest.mark.exhaustive
def test_constrained_steps_are_symplectic_where_they_move():
    """Rods, seen by their angles and momenta: one step and twenty. Twin: the angles with the rates of the rods."""
    for span in (0.05, 1.0):
        assert departs(lambda x: angles_and_momenta(x, span), at_swing()) < 1e-12
    rates = lambda x: angles_and_momenta(x, 1.0).at[2:].divide(jnp.array([1.0, 1.1]))
    assert departs(rates, at_swing()) > 1e-2


def way_back(system, start, params, method):
    """How far the start is, after a hundred steps, the velocities turned round, and a hundred steps."""
    there = motion(system, start, params, [0.0, 2.0], method, 0.02).end
    back = motion(system, (there.q, jax.tree.map(jnp.negative, there.v)), params, [0.0, 2.0], method, 0.02).end
    return max(float(np.max(np.abs(a - b))) for a, b in zip(jax.tree.leaves(back.q), jax.tree.leaves(start[0])))


@pytest.mark.exhaustive
def test_the_way_back():
    """A motion returns to its start, by angles, by rods, on an ellipse. Twin: with friction it does not."""
    assert way_back(double_pendulum, DOUBLE_SWING, DOUBLE_PARAMS, lj.Gauss(3)) < 1e-11
    assert way_back(double_rods, ROD_SWING, DOUBLE_PARAMS, lj.Gauss(3)) < 1e-11
    assert way_back(kepler, ellipse(0.6), 1.0, lj.Splitting(6)) < 1e-11
    braked = lj.System(kepler.lagrangian, dissipation=lambda t, q, v, params: 0.01 * jnp.sum(v**2))
    assert way_back(braked, ellipse(0.6), 1.0, lj.Gauss(3)) > 1e-3


def slope(system, start, params, ts, method, steps, exact):
    """The order, from the error in positions with so many steps per unit of time."""
    found = [motion(system, start, params, ts, method, 1 / n).q for n in steps]
    leaves = lambda tree: np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])
    errors = [np.linalg.norm(leaves(q) - leaves(exact)) for q in found]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


# A pendulum, and the same with a force and friction, and explicit time.
SWING = lj.System(lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q))
DRIVEN = lj.System(
    lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q) + 0.3 * q * jnp.sin(2 * t),
    dissipation=lambda t, q, v, k: 0.1 * v**2 + 0.02 * v**4,
)
SPAN = np.linspace(0.0, 6.0, 7)


def swing_by_scipy(driven):
    """Both by their textbook equations."""
    force = lambda t, y: 0.3 * np.sin(2 * t) - 0.2 * y[1] - 0.08 * y[1] ** 3 if driven else 0.0
    rates = lambda t, y: [y[1], -np.sin(y[0]) + force(t, y)]
    return solve_ivp(rates, (0, 6), [1.0, 0.5], "DOP853", SPAN, rtol=2.5e-14, atol=1e-15).y[0]


@pytest.mark.exhaustive
def test_a_wrong_order_is_seen_on_a_pendulum(monkeypatch):
    """Order 4 of Gauss(2). Failing twin: nodes that are a little off, by which it would still be symplectic."""
    exact, steps = swing_by_scipy(False), (4, 6, 8)
    right = slope(SWING, (1.0, 0.5), 1.0, SPAN, lj.Gauss(2), steps, exact)
    off = tableau(2)._replace(mixed=tableau(2).mixed + np.array([[0.0, 0.05], [-0.05, 0.0]]))
    monkeypatch.setattr(loop, "tableau", lambda stages: off)
    method = dataclasses.replace(lj.Gauss(2), newton=True)
    wrong = slope(SWING, (1.0, 0.5), 1.0, SPAN, method, steps, exact)
    assert abs(right - 4) < 0.35 < abs(wrong - 4)


@pytest.mark.exhaustive
@pytest.mark.parametrize("driven", [False, True])
def test_orders_on_a_pendulum(driven):
    """Orders 2, 4, 6, 8 of both methods, the second also with explicit time and friction (`lj.Splitting` without)."""
    exact, system = swing_by_scipy(driven), DRIVEN if driven else SWING
    for stages, steps in {1: (20, 30, 40), 2: (6, 8, 12), 3: (3, 4, 6), 4: (2, 3, 4)}.items():
        assert abs(slope(system, (1.0, 0.5), 1.0, SPAN, lj.Gauss(stages), steps, exact) - 2 * stages) < 0.35
    if not driven:
        for order, steps in {2: (20, 30, 40), 4: (4, 6, 8), 6: (4, 6, 8), 8: (4, 5, 6)}.items():
            assert abs(slope(system, (1.0, 0.5), 1.0, SPAN, lj.Splitting(order), steps, exact) - order) < 0.35


@pytest.mark.exhaustive
def test_orders_on_cross_rails():
    """The carriage in the laboratory, where L depends on time, against its closed form."""
    params, ts = cross_rails.PARAMS, np.linspace(0.0, 4.0, 5)
    rotating = jax.vmap(lambda t: cross_rails.exact_motion(params, cross_rails.Q0, cross_rails.V0, t))(ts)
    exact = jax.vmap(lambda t, q, v: cross_rails.to_lab(params, t, q, v)[0])(ts, *rotating)
    start = cross_rails.to_lab(params, 0.0, cross_rails.Q0, cross_rails.V0)
    for stages, steps in {2: (20, 30, 40), 3: (8, 12, 16), 4: (6, 8, 10)}.items():
        found = slope(cross_rails.lab_system, start, params, ts, lj.Gauss(stages), steps, exact)
        assert abs(found - 2 * stages) < 0.35, (stages, found)


@pytest.mark.exhaustive
def test_orders_on_a_knife_edge():
    """A knife edge on a slope: with v = (a/ω) sin ωt along it, its path is a cycloid (Neimark & Fufaev)."""
    edge = lj.System(
        lambda t, q, v, a: 0.5 * jnp.sum(v**2) + a * q[0],
        constraints={"edge": lj.Nonholonomic(lambda t, q, v, a: jnp.sin(q[2]) * v[0] - jnp.cos(q[2]) * v[1])},
    )
    a, w, ts = 1.5, 2.0, np.linspace(0.0, 4.0, 5)
    exact = np.stack(
        [a / (2 * w**2) * np.sin(w * ts) ** 2, a / (2 * w**2) * (w * ts - np.sin(2 * w * ts) / 2), w * ts], 1
    )
    start = np.zeros(3), np.array([0.0, 0.0, w])
    for stages, steps in {1: (20, 30, 40), 2: (6, 8, 12), 3: (4, 5, 6)}.items():
        found = slope(edge, start, a, ts, lj.Gauss(stages), steps, exact)
        assert abs(found - 2 * stages) < 0.35, (stages, found)


@pytest.mark.exhaustive
def test_derivatives_through_a_hundred_thousand_steps():
    """d(end)/d(sun) in both modes to 1e-8; reverse mode's memory is that of outputs and of some steps, not of all.

    The sun is in thirty parts: with up to 24 numbers reverse mode would push tangents forward.
    """
    parts = lj.System(lambda t, q, v, k: 0.5 * jnp.sum(v**2) + jnp.sum(k) / jnp.sqrt(jnp.sum(q**2)))
    sun, more, sizes = jnp.full(30, 1 / 30), jnp.arange(30.0), []

    def end(k, steps):
        span = np.linspace(0.0, steps * TURN / 200, 11)
        return motion(parts, ellipse(0.6), k, span, lj.Gauss(2), TURN / 200).q[-1, 0]

    for steps in (1000, 100_000):
        reverse = jax.jit(jax.grad(lambda k: end(k, steps))).lower(sun).compile()
        sizes.append(reverse.memory_analysis().temp_size_in_bytes)
    forward = jax.jit(lambda k: jax.jvp(lambda k: end(k, 100_000), (k,), (more,))[1])(sun)
    np.testing.assert_allclose(reverse(sun) @ more, forward, rtol=1e-8)
    assert sizes[1] < 2 * sizes[0] and sizes[1] < 2**23
