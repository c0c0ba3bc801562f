"""Reverse mode by replay: equal to forward mode on all kinds of motion, finite where it must be, in bounded memory."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.tiers import exhaustive_but

TS = np.linspace(0.0, 2.0, 9)
PARAMS = {"g": 9.81, "l": 2.0}


pytestmark = pytest.mark.usefixtures("in_reverse")


def pendulum(drag=0.05):
    """A pendulum described by its angle."""
    lagrangian = lambda t, q, v, p: 0.5 * p["l"] ** 2 * v**2 + p["g"] * p["l"] * jnp.cos(q)
    return lj.System(lagrangian, dissipation=lambda t, q, v, p: 0.5 * drag * v**2)


def rod(copies=1):
    """The same pendulum in the plane on a rod, or on several equivalent constraints."""
    lagrangian = lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["g"] * q["y"]
    hold = lambda c: lj.Holonomic(lambda t, q, p: c * (q["x"] ** 2 + q["y"] ** 2 - p["l"] ** 2))
    return lj.System(lagrangian, {f"rod {i}": hold(i + 1.0) for i in range(copies)})


def end(system, q0, v0, params, ts=TS, **options):
    """A number that depends on all outputs, with different weights; NaN does not count."""
    traj = lj.integrate(system, q0, v0, params, ts=ts, rtol=1e-10, throw=False, **options)
    weights = np.linspace(1.0, 2.0, len(ts))
    rows = jax.tree.leaves((traj.q, traj.v, traj.multipliers))
    total = lambda x: jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0) * weights.reshape(-1, *[1] * (x.ndim - 1)))
    return sum(total(x) ** 2 for x in rows)


def modes_agree(function, x, rtol=1e-8):
    """Check that both modes agree; return the derivatives."""
    reverse, forward = jax.jit(jax.grad(function))(x), jax.jit(jax.jacfwd(function))(x)
    largest = max(float(jnp.max(jnp.abs(d))) for d in jax.tree.leaves(forward))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * largest), reverse, forward)
    return reverse


def test_a_pendulum_by_parameters_state_and_times():
    """The modes agree on derivatives by g, l, the first state and all output times."""
    system = pendulum()
    modes_agree(lambda x: end(system, *x[:2], x[2], x[3]), (0.75, 0.25, PARAMS, jnp.asarray(TS)))


@pytest.mark.exhaustive
def test_differences_on_the_same_steps():
    """If each step goes from one output to the next, a difference quotient of whole motions uses the same steps."""
    system, ts = pendulum(), np.linspace(0.0, 2.0, 41)
    function = jax.jit(lambda l: end(system, 0.75, 0.25, PARAMS | {"l": l}, ts, dt0=0.05))
    assert lj.integrate(system, 0.75, 0.25, PARAMS, ts=ts, rtol=1e-10, dt0=0.05).stats["num_steps"] == len(ts) - 1
    h = 1e-4
    quotient = (8 * (function(2.0 + h) - function(2.0 - h)) - function(2.0 + 2 * h) + function(2.0 - 2 * h)) / (12 * h)
    np.testing.assert_allclose(jax.grad(function)(2.0), quotient, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("copies", exhaustive_but((2,), (1, 2)))
def test_constraints_and_their_multipliers(copies):
    """A rod, and two equivalent ones, whose steps use the robust solve; in a batch, and from a turning point."""
    system, q0 = rod(copies), {"x": 2.0, "y": 0.0}
    one = lambda vy, p: end(system, q0, {"x": 0.0, "y": vy}, p)
    modes_agree(lambda x: jnp.sum(jax.vmap(one, (0, None))(*x)), (jnp.array([0.0, 0.5]), PARAMS))


@pytest.mark.slow
def test_at_rest():
    """For a pendulum hanging still the derivatives are finite, and equal those of the linear equation."""
    system = pendulum(drag=0.0)
    by_q = jax.grad(lambda q: lj.integrate(system, q, 0.0, PARAMS, ts=TS, rtol=1e-10, atol=1e-10).q[-1])(0.0)
    np.testing.assert_allclose(by_q, np.cos(np.sqrt(9.81 / 2.0) * TS[-1]), rtol=1e-8)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", exhaustive_but((None,), (None, diffrax.Kvaerno5())))
def test_implicit_methods(method):
    """A stiff spring: derivatives by the implicit function theorem at each step."""
    system = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * q**2, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v**2
    )
    modes_agree(lambda p: end(system, 1.0, 0.0, p, method=method or lj.Radau5()), {"k": 1e3, "c": 2e2})


@pytest.mark.slow
def test_a_force_that_jumps():
    """The modes agree on the derivative by the time of the jump, which is the end of a step."""
    system = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, force=lambda t, q, v, p: jnp.where(t > p["s"], p["f"], 0.0)
    )
    modes_agree(lambda p: end(system, 1.0, 0.0, p, jump_ts=p["s"][None]), {"s": jnp.asarray(0.77), "f": 2.0})


def falling():
    """A falling stone, described by its height."""
    return lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)


@pytest.mark.exhaustive
def test_an_event():
    """Derivatives of the end time, the end velocity and the outputs of a fall to the floor."""
    stone, floor = falling(), lj.Crossing(lambda t, q, v, p: q, direction=-1)

    def function(x):
        traj = lj.integrate(stone, x["h"], x["u"], x, ts=TS, rtol=1e-10, events={"floor": floor})
        return traj.end.t**2 + traj.end.v + jnp.sum(jnp.where(jnp.isfinite(traj.q), traj.q, 0.0))

    found = modes_agree(function, {"g": 9.81, "h": 1.0, "u": 0.0})
    # T = √(2 h / g), v = -√(2 g h), q = h - g t²/2 at the outputs before it.
    by_g = -2 / 9.81**2 - 1 / np.sqrt(2 * 9.81) - np.sum(TS[TS < 0.451] ** 2) / 2
    np.testing.assert_allclose(found["g"], by_g, rtol=1e-9)


@pytest.mark.exhaustive
def test_two_switches():
    """The modes agree on a ball that bounces twice."""
    bounce = lj.Switch("up", to="up", when=lambda t, q, v, p: q, reset=lambda t, q, v, p: -p["e"] * v)
    bouncing = lj.Hybrid({"up": falling()}, [bounce], most_switches=3)
    at = np.array([0.0, 0.25, 0.75, 1.0])
    function = lambda p: jnp.sum(lj.integrate(bouncing, p["h"], 0.0, p, ts=at, rtol=1e-10).q ** 2)
    modes_agree(function, {"g": 9.81, "e": 0.5, "h": 1.0})
