"""What is known of a guard within a step: two crossings, a guard that is left without speed. Twins see less."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events import brackets as sampling
from tests.by_numpy import by_numpy
from tests.integrate.events.test_event import oscillator, swing, times


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-4, 1e-9, 1e-12])
def test_levels_just_below_the_extremum(rtol):
    """Two crossings in one step, 0.3 to 1e-8 below the top, are found as precisely as the motion's error allows."""
    for below in 10.0 ** -np.arange(0.5, 8.5, 0.5):
        first = np.arcsin(1 - below)
        with warnings.catch_warnings():
            # Closer than the tolerance it is unknown whether the level is above or below the top.
            warnings.simplefilter("default" if below > 100 * rtol else "ignore", lj.EventWarning)
            traj = swing(0.0, 1.0, 1 - below, [0.0, 3.0, 6.0], rtol=rtol)
        if below > 100 * rtol:
            np.testing.assert_allclose(times(traj), [first, np.pi - first], atol=20 * rtol / np.cos(first))
        elif len(times(traj)) != 2:
            assert bool(traj.events["level"].uncertain)
    assert len(times(swing(0.0, 1.0, 1.001 + 100 * rtol, [0.0, 3.0, 6.0], rtol=rtol))) == 0


@pytest.mark.exhaustive
def test_a_guard_that_is_left_without_speed(monkeypatch):
    """A guard that leaves zero as t³ costs no extra steps. Twin: without the rule for it, bisection does."""

    def steps(guard):
        events = {"cubic": lj.Crossing(guard, direction=-1, terminal=False)}
        traj = lj.integrate(oscillator, 0.0, 1.0, ts=[0.0, 2.0], events=events, estimate_error=False)
        assert int(traj.events["cubic"].count) == 0 and not bool(traj.events["cubic"].uncertain)
        return int(traj.stats["num_steps"])

    assert steps(lambda t, q, v, p: q**3) < 20
    monkeypatch.setattr(sampling, "FLAT", -1.0)
    # Another guard, since an equal one would reuse the first program.
    assert steps(lambda t, q, v, p: 2.0 * q**3) > 40


def test_velocities_over_a_short_step():
    """Between the ends of a step of 1e-12 the interpolants have the velocity to the last digits, and over a long one
    they are the polynomial through q, v and a. Twin: the distance of the positions, over the length, has none."""
    way = np.polynomial.Polynomial([0.7, 1e-8, -0.3, 0.2, 0.1, -0.4])
    one, two = way.deriv(), way.deriv(2)

    @by_numpy
    def sampled(*ends):
        nodes = [sampling.Node(t, ((q,), (v,)), (a,), ()) for t, q, v, a in ends]
        (((q, v), a),), (((_, by_cubic), _),) = sampling.between(*nodes, nodes[1].t)
        return jnp.stack([q[0], v[0], a[0]]), by_cubic[0]

    def inside(h):
        return *sampled(*((t, way(t), one(t), two(t)) for t in (0.0, h))), (way(h) - way(0.0)) / h

    at = sampling.INNER[0]
    long, by_cubic, _ = inside(0.8)
    np.testing.assert_allclose(long, [way(0.8 * at), one(0.8 * at), two(0.8 * at)], rtol=1e-13)
    assert abs(by_cubic - long[1]) > 1e-3
    short, _, by_distance = inside(1e-12)
    np.testing.assert_allclose(short, [0.7, 1e-8, -0.6], rtol=1e-4)
    assert abs(by_distance - 1e-8) > 1e-9


def at_ends_of_steps(*between, pieces=sampling.pieces_of):
    """Return the pieces of a twin that looks only at the ends of steps."""
    found, no = pieces(*between), jnp.asarray(False)
    ends = [0.0 * x for x in found.sign[:-1]] + found.sign[-1:]
    return found._replace(sign=ends, doubt=[no] * len(found.doubt))


@pytest.mark.slow
def test_twin_ends_of_steps(monkeypatch):
    """Looking only at the ends of steps misses two crossings in one step."""
    monkeypatch.setattr(sampling, "pieces_of", at_ends_of_steps)
    # Another guard than elsewhere, since an equal one would reuse its program.
    level = lj.Crossing(lambda t, q, v, p: q - 0.991, terminal=False)
    assert len(times(lj.integrate(oscillator, 0.0, 1.0, ts=[0.0, 6.0], events={"level": level}))) == 0
