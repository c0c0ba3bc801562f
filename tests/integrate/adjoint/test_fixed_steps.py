"""Fixed steps are replayed: their derivatives are those of the steps, and of one shorter step for each output."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.adjoint import step_record
from tests.integrate.adjoint import test_replay as replayed
from tests.integrate.adjoint.test_replay import PARAMS, SWUNG, TS, end, modes_agree, pendulum, rod

pytestmark = pytest.mark.usefixtures("in_reverse")

# Steps of 0.09 do not end at outputs, 0.25 apart, of which some have two or three steps between them.
FIXED = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(0.09)}


def test_a_spring_by_parameters_state_and_times():
    """Derivatives by stiffness, first state and times inside steps, of which two are the same, in closed form: an
    output at the same time as the one before it moves with that."""
    x = np.concatenate([SWUNG[0, :4], [0.0, 0.31, 0.31, 1.0]])
    found = np.asarray(replayed.slopes_found(x[None], **FIXED))[0]
    np.testing.assert_allclose(found, replayed.slopes_expected(x, (0, 1, 1, 3)), rtol=1e-8, atol=1e-9)


@pytest.mark.exhaustive
def test_rollout(monkeypatch):
    """Where outputs are ends of steps, the gradient is that of `lj.rollout`; long motions are run again in pieces."""
    monkeypatch.setattr(step_record, "ROWS", 4)
    monkeypatch.setattr(step_record, "PLACES", 2)
    system, dt, many = pendulum(), 1 / 64, 40
    ts, fixed = dt * np.arange(many + 1), {**FIXED, "dt0": np.asarray(dt), "method": lj.RK4()}
    weights = np.sin(np.arange(many + 1.0))

    def weighed(q, v):
        return jnp.sum(weights * q) + jnp.sum(weights * v**2)

    def integrated(x):
        traj = lj.integrate(system, *x, ts=ts, **fixed)
        return weighed(traj.q, traj.v)

    expected = jax.grad(lambda x: weighed(*lj.rollout(system, *x, many, dt)[1:]))((0.75, 0.25, PARAMS))
    program = jax.jit(jax.grad(integrated)).trace((0.75, 0.25, PARAMS))
    assert "lagjax_recorded" in str(program.jaxpr)
    found = program.lower().compile()((0.75, 0.25, PARAMS))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11), found, expected)


@pytest.mark.exhaustive
@pytest.mark.parametrize("copies", (1, 2))
def test_constraints_in_lanes(copies):
    """A rod, and two equivalent ones, in lanes of different starts and numbers of steps."""
    system, q0 = rod(copies), {"x": 2.0, "y": 0.0}
    fixed = {**FIXED, "method": lj.Dopri8()}

    def one(vy, last, p):
        return end(system, q0, {"x": 0.0, "y": vy}, p, jnp.linspace(0.0, last, 5), **fixed)

    lanes = jax.vmap(one, (0, 0, None))
    modes_agree(lambda x: jnp.sum(lanes(*x)), (jnp.array([0.0, 0.5]), jnp.array([2.0, 0.7]), PARAMS))


@pytest.mark.exhaustive
def test_an_event():
    """The time and the velocity at which a stone falls to the floor, by its height and by g."""
    stone = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)
    floor = lj.Crossing(lambda t, q, v, p: q, direction=-1)

    def function(p):
        traj = lj.integrate(stone, p["h"], 0.0, p, ts=TS, events={"floor": floor}, **FIXED)
        return traj.end.t + traj.end.v

    found = jax.jit(jax.grad(function))({"g": 9.81, "h": 1.0})
    # T = √(2 h / g), v = -√(2 g h).
    np.testing.assert_allclose(found["h"], 1 / np.sqrt(2 * 9.81) - np.sqrt(9.81 / 2), rtol=1e-9)
    np.testing.assert_allclose(found["g"], -np.sqrt(0.5 / 9.81**3) - np.sqrt(0.5 / 9.81), rtol=1e-9)
