"""Times and states of crossings, with their derivatives, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.systems import PARAMS, rod_pendulum


@pytest.mark.exhaustive
def test_multipliers_in_a_guard():
    """A mass on a string goes slack where its tension vanishes, at the height that the energy gives; with its slope."""
    tension = {"slack": lj.Crossing(lambda t, q, v, multipliers, p: multipliers["rod"])}
    l, g = PARAMS["l"], PARAMS["g"]

    def slack(v0):
        start = {"x": 0.0 * v0, "y": -l + 0.0 * v0}, {"x": v0, "y": 0.0 * v0}
        return lj.integrate(rod_pendulum, *start, PARAMS, ts=jnp.array([0.0, 5.0]), events=tension, rtol=1e-11).end

    # At the height y where v² = g y, and v² = v0² - 2 g (y + l).
    v0 = np.sqrt(3.5 * g * l)
    end, slope = slack(v0), jax.jacfwd(lambda v0: slack(v0).q["y"])(v0)
    np.testing.assert_allclose([end.q["y"], slope], [(v0**2 - 2 * g * l) / (3 * g), 2 * v0 / (3 * g)], rtol=1e-7)
    assert abs(float(end.multipliers["rod"])) < 1e-12


@pytest.mark.exhaustive
def test_derivative_by_many_numbers():
    """Reverse mode through a recorded crossing, with a guard and L that read forty numbers."""
    weights = jnp.linspace(0.5, 1.5, 40) / 40
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * jnp.sum(p) * q**2)
    events = {"level": lj.Crossing(lambda t, q, v, p: q - 0.5 * jnp.sum(p), terminal=False)}

    def second(p, dt0=None):
        return lj.integrate(system, 0.0, 1.0, p, ts=[0.0, 3.0], events=events, dt0=dt0).events["level"].t[1]

    # At Σp = 1: t = (π - arcsin(w · w²/2)) / w with w² = Σp.
    by_sum = lambda s: (jnp.pi - jnp.arcsin(0.5 * s**1.5)) / jnp.sqrt(s)
    np.testing.assert_allclose(second(weights), by_sum(jnp.sum(weights)), rtol=1e-8)
    # The state there is computed by other steps than the time, and is on the level only to the tolerance.
    for dt0 in (None, 0.05, 0.3):
        np.testing.assert_allclose(jax.grad(second)(weights, dt0), np.full(40, jax.grad(by_sum)(1.0)), rtol=1e-6)


@pytest.mark.exhaustive
def test_lanes_with_and_without_a_crossing():
    """By many numbers, in reverse mode: one ball reaches a height, t = (v - √(v² - 2 g h)) / g; the other one does not,
    q = v T - g T²/2, and its derivative is not that of a crossing at NaN, times zero."""
    ball = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.sum(p) * q)
    up = lj.Crossing(lambda t, q, v, p: q - 1.0)
    height, last, g, v0 = 1.0, 1.0, 9.8, np.array([6.0, 3.0])

    def end(p, v0):
        found = lj.integrate(ball, 0.0, v0, p, ts=[0.0, last], events={"up": up}).end
        return found.t + 10.0 * found.q

    slopes = jax.jit(jax.vmap(jax.grad(end), (None, 0)))(jnp.full(40, g / 40), v0)
    root = np.sqrt(v0[0] ** 2 - 2 * g * height)
    of_time = height / (g * root) - (v0[0] - root) / g**2
    np.testing.assert_allclose(slopes, np.array([of_time, -10.0 * last**2 / 2])[:, None] * np.ones(40), rtol=1e-8)
