"""Second derivatives in every order of the modes; by many parameters: `tests/behaviour/test_compositions.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events import event_times

TS = np.array([0.0, 0.9])
spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (params * q) ** 2)


def end(x):
    """The square of q = q0 cos(k T), integrated."""
    return lj.integrate(spring, x[0], 0.0, x[1], ts=TS, rtol=1e-11, atol=1e-11).q[-1] ** 2


def exact(x):
    """The same by its formula."""
    return (x[0] * jnp.cos(0.9 * x[1])) ** 2


@pytest.mark.exhaustive
@pytest.mark.parametrize("inner", (jax.jacfwd, jax.jacrev))
@pytest.mark.parametrize("outer", (jax.jacfwd, jax.jacrev))
def test_modes_in_any_order(inner, outer):
    """The Hessian of a motion whose formula is known, with the modes nested in all four ways."""
    x = jnp.array([0.75, 1.25])
    np.testing.assert_allclose(outer(inner(end))(x), jax.hessian(exact)(x), atol=1e-8)


falling = lj.System(lambda t, q, v, p: 0.5 * v**2 - p[0] * q)
FLOOR = lj.Crossing(lambda t, q, v, p: q, direction=-1)
BOUNCE = lj.Switch("falling", to="falling", when=lambda t, q, v, p: q, reset=lambda t, q, v, p: -p[1] * v)
bouncing = lj.Hybrid({"falling": falling}, [BOUNCE], most_switches=4)


def landed(p):
    """When and how fast a stone, thrown upward from 0.5 at speed 0.2, hits the floor."""
    end = lj.integrate(falling, 0.5, 0.2, p, ts=TS, events={"floor": FLOOR}).end
    return jnp.stack([end.t, end.v])


def landed_by_formula(p):
    """The same by its formula."""
    speed = jnp.sqrt(0.04 + p[0])
    return jnp.stack([(0.2 + speed) / p[0], -speed])


def bounced(p):
    """The position of the stone some time after it bounced."""
    return lj.integrate(bouncing, 0.5, 0.2, p, ts=TS).q[-1]


def bounced_by_formula(p):
    """The same by its formula."""
    t, v = landed_by_formula(p)
    return -p[1] * v * (TS[-1] - t) - 0.5 * p[0] * (TS[-1] - t) ** 2


@pytest.mark.exhaustive
@pytest.mark.parametrize("found, exact", [(landed, landed_by_formula), (bounced, bounced_by_formula)])
def test_at_a_crossing_that_moves(found, exact, monkeypatch):
    """Second derivatives of, and through, the time and state of a crossing; twin: with the crossing time held fixed."""
    p = jnp.array([4.0, 0.7])
    second = lambda: jax.jacfwd(jax.jacfwd(found))(p)
    np.testing.assert_allclose(second(), jax.jacfwd(jax.jacfwd(exact))(p), atol=1e-9)
    jax.clear_caches()
    monkeypatch.setattr(event_times, "_flow", lambda live, tau, z, *, rate: (z[0] + tau, z[1]))
    assert not np.max(np.abs(second() - jax.jacfwd(jax.jacfwd(exact))(p))) < 1e-3
