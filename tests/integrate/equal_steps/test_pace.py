"""Steps that follow a pace: close encounters without drift, there and back, and outputs that change nothing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lagjax as lj
from lagjax.integrate.equal_steps.gauss_step import GaussStep
from lagjax.integrate.equal_steps.pace import Pace, PacedSteps
from lagjax.integrate.equal_steps.splitting_step import SplittingStep
from lagjax.numerics import tableau
from lagjax.system import prepare
from tests.by_hand import kepler as on_ellipse
from tests.integrate.equal_steps.test_equal_steps import TURN, ellipse, kepler
from tests.integrate.equal_steps.test_equal_steps import run as of_any


def pace(t, q, params):
    """The distance to the power 3/2, in proportion to the time that the motion takes there."""
    return jnp.sum(q**2) ** 0.75


def run(method, ts, e=0.99, dt0=0.06):
    """An ellipse, with about 160 steps in a turn where the pace is as above."""
    return of_any(kepler, ellipse(e), 1.0, ts, method, dt0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "dt"),
    [(lj.Splitting(8, pace=pace), 0.06), pytest.param(lj.Gauss(6, pace=pace), 0.1, marks=pytest.mark.exhaustive)],
)
def test_a_hundred_turns_of_a_long_ellipse(method, dt):
    """Energy, momentum and places at e = 0.99; other outputs change none of them."""
    ts = TURN * np.linspace(0.0, 100.0, 301) + 0.3 * (np.arange(301) > 0)
    traj = run(method, ts, dt0=dt)
    h = np.asarray(traj.jacobi_integral())
    assert np.max(np.abs(h + 0.5)) < 2e-8 and abs(np.polyfit(ts, h, 1)[0]) * ts[-1] < 1e-9
    momentum = np.asarray(traj.q[:, 0] * traj.v[:, 1] - traj.q[:, 1] * traj.v[:, 0])
    np.testing.assert_allclose(momentum / momentum[0], 1.0, atol=1e-11)
    # A phase error grows with the time; as a share of a turn it is 1e-8 of these.
    np.testing.assert_allclose(traj.q, on_ellipse(ts, 0.99)[0], atol=2e-5)
    assert int(traj.stats["num_steps"]) < 100 * 200
    fewer = run(method, np.append(ts[::2][:-1], np.linspace(ts[-1] - 1.0, ts[-1], 151)), dt0=dt)
    np.testing.assert_array_equal(fewer.q[:150], traj.q[::2][:150])


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", [lj.Splitting(n, pace=pace) for n in (2, 4, 6, 8)] + [lj.Gauss(2, pace=pace)])
def test_order(method):
    """The order of the method, at e = 0.9. Twin: each order is told from the others by itself."""
    order = method.error_order()
    ts, (exact, _) = np.array([0.0, 5.0, 9.0]), on_ellipse(np.array([5.0, 9.0]), 0.9)
    h = {2: 0.01, 4: 0.04, 6: 0.06, 8: 0.12}[order]
    errors = [np.max(np.abs(run(method, ts, 0.9, dt0=jnp.asarray(dt)).q[1:] - exact)) for dt in (h, h / 1.5)]
    assert abs(np.log(errors[0] / errors[1]) / np.log(1.5) - order) < 0.5, errors


@pytest.mark.parametrize(
    "kind", [pytest.param("splitting", marks=pytest.mark.slow), pytest.param("gauss", marks=pytest.mark.exhaustive)]
)
def test_there_and_back(kind):
    """Velocities turned round: the same 150 steps lead back. Twin: with the next step's length they do not."""
    model, s = prepare(kepler, 0.0, *ellipse(0.9), 1.0)
    x, u = model.vectors(s.q, s.v)
    step = SplittingStep.of(model, 2, s.t, x, u) if kind == "splitting" else GaussStep(model, tableau(2), False, False)
    steps = PacedSteps(step, Pace(pace, model.form, model.params), jnp.asarray(0.1), lax.while_loop, None)

    many = partial(lax.fori_loop, 0, 150, lambda _, line: steps._one((0, line))[1])

    @jax.jit
    def back(line, share):
        there = many(line)
        # The step that lies before the state now is the one that led there: log ρ goes back over dσ/dt.
        u = step.velocity(there.way, there.t)
        rate = steps.pace.rate(there.t, there.way.x, u)
        turned = steps.first(there.t, there.way.x, -u)._replace(log_pace=there.log_pace - share * steps.dt * rate)
        home = many(turned)
        return there.way.x, home.way.x, -step.velocity(home.way, home.t)

    place, home, velocity = back(steps.first(s.t, x, u), 1.0)
    assert jnp.linalg.norm(place - x) > 0.2
    np.testing.assert_allclose(home, x, atol=1e-11)
    np.testing.assert_allclose(velocity, u, atol=1e-10)
    assert jnp.linalg.norm(back(steps.first(s.t, x, u), 0.0)[1] - x) > 1e-6


def test_what_a_pace_refuses():
    """Bad input, in words."""
    refused = partial(run, ts=[0.0, 1.0])
    with pytest.raises(TypeError, match=r"pace must be a function of \(t, q, params\), not 0.1"):
        lj.Gauss(3, pace=0.1)
    with pytest.raises(ValueError, match=r"pace\(t, q, params\) of lj.Splitting must return one .* shape \(2,\)"):
        refused(lj.Splitting(4, pace=lambda t, q, params: q))
    with pytest.raises(TypeError, match=r"(?s)pace.* of lj.Gauss is called with 3 arguments.*f\(t, q\)"):
        refused(lj.Gauss(2, pace=lambda t, q: 1.0))


@pytest.mark.exhaustive
def test_a_pace_that_is_not_positive():
    """It ends the motion there, and says what it is."""
    with pytest.raises(RuntimeError, match=r"stopped at t = [\d.]+, (?s:.*)a pace that is positive and finite: there"):
        run(lj.Splitting(4, pace=lambda t, q, params: q[0] + 0.5), [0.0, 10.0], e=0.3)


@pytest.mark.slow
def test_steps_that_get_nowhere():
    """A pace that is too small ends at `max_steps`, and says so."""
    swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
    given = {"ts": [0.0, 1.0, 2.0], "method": lj.Gauss(1, pace=lambda t, q, params: 1e-300), "dt0": 0.1}
    found = lj.integrate(swing, 1.0, 0.0, max_steps=1000, throw=False, **given)
    assert bool(found.result == lj.RESULTS.max_steps_reached) and np.isnan(np.asarray(found.q[1:])).all()
    assert int(found.stats["num_steps"]) == 1000
    with pytest.raises(RuntimeError, match="max_steps = 1000 is used up"):
        lj.integrate(swing, 1.0, 0.0, max_steps=1000, **given)
