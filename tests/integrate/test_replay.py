"""Reverse mode by replay: equal to forward mode on all kinds of motion, finite where it must be, in bounded memory.

The loop back over the steps: no cotangent is dropped, lanes that failed add nothing, networks as matrices.
"""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import step_record

TS = np.linspace(0.0, 2.0, 9)
PARAMS = {"g": 9.81, "l": 2.0}


pytestmark = pytest.mark.usefixtures("in_reverse")


def pendulum(drag=0.05):
    """A pendulum described by its angle."""
    lagrangian = lambda t, q, v, p: 0.5 * p["l"] ** 2 * v**2 + p["g"] * p["l"] * jnp.cos(q)
    return lj.System(lagrangian, dissipation=lambda t, q, v, p: 0.5 * drag * v**2)


def end(system, q0, v0, params, ts=TS, **options):
    """A number that depends on all outputs, with different weights; NaN does not count."""
    traj = lj.integrate(system, q0, v0, params, ts=ts, rtol=1e-10, throw=False, **options)
    weights = np.linspace(1.0, 2.0, len(ts))
    rows = jax.tree.leaves((traj.q, traj.v, traj.multipliers))
    total = lambda x: jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0) * weights.reshape(-1, *[1] * (x.ndim - 1)))
    return sum(total(x) ** 2 for x in rows)


def modes_agree(function, x, direction=None, rtol=1e-8):
    """Check that along a direction, a random one of all x or this, forward mode equals the product of the gradient with
    it; return the gradient."""
    random = np.random.default_rng(0)
    x = jax.tree.map(lambda x: jnp.asarray(x, float), x)
    direction = direction or jax.tree.map(lambda x: jnp.asarray(random.normal(size=np.shape(x))), x)
    gradient, (value, along) = jax.jit(jax.grad(function))(x), jax.jit(partial(jax.jvp, function))((x,), (direction,))
    terms = [np.sum(np.asarray(g) * d) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)]
    assert np.isfinite(value)
    np.testing.assert_allclose(sum(terms), along, rtol=rtol, atol=rtol * np.max(np.abs(terms)))
    return gradient


# q, v, two halves of the stiffness, and four times: a spring that swings, and one at rest.
SWUNG = np.array([[0.75, 0.25, 2.0, 3.0, 0.0, 0.25, 1.5, 2.0], [0.0, 0.0, 2.0, 3.0, 0.0, 0.25, 1.5, 2.0]])
WEIGHTS = np.cos(np.arange(8.0)).reshape(2, 4)


def slopes_found(x, **options):
    """The derivatives, by all of x, of a number that depends on all q and v of a spring's motion."""
    spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * jnp.sum(p) * q**2)

    def number(x):
        traj = lj.integrate(spring, x[0], x[1], x[2:4], ts=x[4:], rtol=1e-11, atol=1e-11, **options)
        return WEIGHTS[0] @ traj.q + WEIGHTS[1] @ traj.v

    return jax.jit(jax.vmap(jax.grad(number)))(x)


def slopes_expected(x, same=(0, 1, 2, 3)):
    """The same by complex steps of the closed form; `same`: the first output at the time of each."""

    def number(x):
        w, s = np.sqrt(x[2] + x[3]), x[4:][list(same)] - x[4]
        q, v = x[0] * np.cos(w * s) + x[1] / w * np.sin(w * s), x[1] * np.cos(w * s) - x[0] * w * np.sin(w * s)
        return WEIGHTS[0] @ q + WEIGHTS[1] @ v

    return np.array([number(x + step).imag for step in 1e-30j * np.eye(x.size)]) / 1e-30


def test_a_spring_by_parameters_state_and_times(monkeypatch):
    """Derivatives by stiffness, first state and all times are those of the closed form, in lanes, one of
    them at rest, from a record with room for few steps, so that most are run again."""
    monkeypatch.setattr(step_record, "ROWS", 1)
    monkeypatch.setattr(step_record, "PLACES", 4)
    for x, found in zip(SWUNG, np.asarray(slopes_found(SWUNG)), strict=True):
        np.testing.assert_allclose(found, slopes_expected(x), rtol=1e-8, atol=1e-8)


def test_fixed_steps():
    """The same by steps of 0.09, which do not end at outputs, of which two are at one time: the second moves with the
    first."""
    x = np.concatenate([SWUNG[0, :4], [0.0, 0.31, 0.31, 1.0]])
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(0.09)}
    found = np.asarray(slopes_found(x[None], **fixed))[0]
    np.testing.assert_allclose(found, slopes_expected(x, (0, 1, 1, 3)), rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_a_force_that_jumps():
    """By the time of the jump, which is the end of a step, and the force: q = cos t + f (1 - cos(t - s)) after it."""
    system = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, force=lambda t, q, v, p: jnp.where(t > p["s"], p["f"], 0.0)
    )

    def of(p):
        return jnp.sum(lj.integrate(system, 1.0, 0.0, p, ts=TS, rtol=1e-11, atol=1e-11, jump_ts=p["s"][None]).q)

    found, after = jax.jit(jax.grad(of))({"s": 0.77, "f": 2.0}), TS[TS > 0.77] - 0.77
    np.testing.assert_allclose(found["s"], -2.0 * np.sum(np.sin(after)), rtol=1e-8)
    np.testing.assert_allclose(found["f"], np.sum(1 - np.cos(after)), rtol=1e-8)


def falling():
    """A falling stone, described by its height."""
    return lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)


@pytest.mark.exhaustive
def test_two_switches():
    """The modes agree on a ball that bounces twice."""
    bounce = lj.Switch("up", to="up", when=lambda t, q, v, p: q, reset=lambda t, q, v, p: -p["e"] * v)
    bouncing = lj.Hybrid({"up": falling()}, [bounce], most_switches=3)
    at = np.array([0.0, 0.25, 0.75, 1.0])
    function = lambda p: jnp.sum(lj.integrate(bouncing, p["h"], 0.0, p, ts=at, rtol=1e-10).q ** 2)
    modes_agree(function, {"g": 9.81, "e": 0.5, "h": 1.0})


@pytest.mark.exhaustive
def test_lanes_that_fail_have_no_part():
    """A lane without mass does not start: it adds nothing to derivatives by shared parameters, and its own are zero."""
    heavy = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2)
    one = lambda k, m: end(heavy, 0.5, 0.0, {"k": k, "m": m})
    derivatives = jax.jit(jax.grad(lambda k, m, w: jnp.sum(w * jax.vmap(one, (None, 0))(k, m)), (0, 1)))
    by_k, by_m = derivatives(2.0, jnp.array([1.0, 0.0, 2.0]), jnp.ones(3))
    k, m = derivatives(2.0, jnp.array([1.0, 1.5, 2.0]), jnp.array([1.0, 0.0, 1.0]))
    np.testing.assert_allclose(by_k, k, rtol=1e-12)
    np.testing.assert_allclose(by_m, m, rtol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ((8, 3), (72, 1), (72, 3), (8, 1)))
def test_networks_as_matrices(kind):
    """Stages in a loop and as copies; two coordinates of different masses; by the weights, the masses and the start."""
    hidden, lanes = kind
    random = np.random.default_rng(0)
    w = [random.normal(size=(2, hidden)), random.normal(size=(hidden, hidden)) / hidden, random.normal(size=hidden)]

    def lagrangian(t, q, v, p):
        w, m = p
        return 0.5 * jnp.sum(m * v**2) - 0.5 * jnp.sum(q**2) - jnp.tanh(jnp.tanh(q @ w[0]) @ w[1]) @ w[2]

    system, q0 = lj.System(lagrangian), random.normal(size=(3, 2))

    def total(x):
        *p, q = x
        of = lambda q: end(system, q, jnp.zeros(2), p)
        return jnp.sum(jax.vmap(of)(q)) if lanes == 3 else of(q[0])

    modes_agree(total, (w, np.array([1.0, 3.0]), q0), rtol=1e-10)
