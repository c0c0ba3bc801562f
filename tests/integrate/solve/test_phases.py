"""Lanes that start in different phases."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.solve.phases import phases_in, traced_phases
from lagjax.integrate.solve.segments import _first
from lagjax.system import coordinates

ball = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)
lying = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q, {"floor": lj.Holonomic(lambda t, q, p: q)})
bounce = lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, p: q, restitution=0.5))
hybrid = lj.Hybrid({"flying": ball, "lying": lying}, [bounce])
TS = np.array([0.0, 0.5])


def run(q, start):
    """Half a second from rest at height q."""
    return lj.integrate(hybrid, q, 0.0, {"g": 10.0}, ts=TS, start=start, throw=False, estimate_error=False)


def test_a_number_that_no_phase_has():
    """Lanes begin in their own phases; a number that no phase has is a failure there, and nothing is finite."""
    settings = SimpleNamespace(by_size=True)

    @jax.jit
    @jax.vmap
    def begin(q, start):
        state = coordinates.state(0.0, q, 0.0, {"g": 10.0})
        system = traced_phases(hybrid.starting(start), state)
        way = _first(system, *state[1:], TS, phases_in(system, state, {}), settings)
        return way.mode.phase, way.continues, way.result._value, way.end.q, way.q

    phase, continues, result, end, _ = begin(np.array([5.0, 0.0, 5.0, 5.0]), np.array([0, 1, 7, -1]))
    np.testing.assert_array_equal(phase, [0, 1, 1, 0])
    np.testing.assert_array_equal(continues, [True, True, False, False])
    unknown = int(lj.RESULTS.no_such_phase._value)
    np.testing.assert_array_equal(result, [0, 0, unknown, unknown])
    np.testing.assert_array_equal(end, [5.0, 0.0, np.nan, np.nan])
    by_name = [int(hybrid.starting(start).first) for start in ("flying", "lying", 1, np.int64(1))]
    assert by_name == [0, 1, 1, 1]


@pytest.mark.exhaustive
def test_lanes_start_in_their_own_phases():
    """A ball falls from 5 to 3.75 while another lies; a number that no phase has is a failure, and nothing is finite.

    Twin: in the other phase the lying one falls through, or rather bounces for ever: it is a failure.
    """
    together = jax.jit(jax.vmap(run))(np.array([5.0, 0.0, 5.0, 0.0]), np.array([0, 1, 7, 0]))
    np.testing.assert_allclose(together.q[:2, -1], [3.75, 0.0], atol=1e-12)
    np.testing.assert_allclose(together.multipliers["floor"][1, -1], 10.0)
    np.testing.assert_array_equal(together.phase[:, -1], [0, 1, -1, -1])
    assert np.isnan(together.q[2:, -1]).all() and np.isnan(together.end.q[2])
    codes = [int(lj.RESULTS.no_such_phase._value), int(lj.RESULTS.too_many_switches._value)]
    np.testing.assert_array_equal(np.asarray(together.result._value)[2:], codes)


@pytest.mark.parametrize("start", [2, -1, 0.0, True, np.array([0, 1]), "sliding"])
def test_said_by_name(start):
    """Numbers that no phase has, and what is no number, are refused in words."""
    with pytest.raises(ValueError, match="phase"):
        run(0.0, start)
