"""Second derivatives at crossings; in every order of the modes: `tests/behaviour/test_compositions.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events import event_times

TS = np.array([0.0, 0.9])


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
