"""The overhead of a call: nothing is traced twice, and the robust solve is compiled only if it is needed."""

import operator
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.jaxtools import hashable_partition
from lagjax.jaxtools.cache import PROGRAMS
from lagjax.system import coordinates
from tests.counting import compiles
from tests.systems import (
    HORIZONTAL,
    PARAMS,
    TS,
    cartesian_lagrangian,
    pendulum,
    pendulum_lagrangian,
    rod,
    rod_pendulum,
)

SIGN = operator.pos
traced = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **kw: traced.append(name) if "jaxpr_trace" in name else None
)
by_a_global = lj.System(lambda t, q, v, p: pendulum_lagrangian(t, q, v, p | {"g": SIGN(p["g"])}))


def traces(call):
    """Return the result of a call, and how often JAX traced something in it."""
    before = len(traced)
    found = call()
    return found, len(traced) - before


def test_a_second_call_traces_nothing():
    """Numbers of any type, times and tolerances compile nothing; called again they trace at most an L with a global.

    Twin: after the global has changed, all is traced again.
    """
    swing = lambda system, q0, params, ts, rtol=1e-9: lj.integrate(system, q0, 0.0, params, ts=ts, rtol=rtol)
    known = swing(pendulum, 0.5, PARAMS, TS)
    of_all_types = (
        (0.5, PARAMS, TS, 1e-7),
        (np.float64(0.5), {name: np.array(x) for name, x in PARAMS.items()}, tuple(TS)),
        (jnp.asarray(0.5, float), {name: jnp.asarray(x, float) for name, x in PARAMS.items()}, jnp.array(TS)),
    )
    with compiles() as found:
        for numbers in of_all_types:
            # Of all tests of a worker, this may be the first with these types.
            assert traces(lambda: swing(pendulum, *numbers))[1] <= 1
            assert traces(lambda: swing(pendulum, *numbers))[1] == 0
            traj, count = traces(lambda: swing(by_a_global, *numbers))
            np.testing.assert_allclose(traj.q, known.q, atol=1e-6)
            assert count <= 1
    assert not found
    globals()["SIGN"] = operator.neg
    traj, count = traces(lambda: swing(by_a_global, 0.5, PARAMS, TS))
    np.testing.assert_allclose(traj.q, swing(pendulum, 0.5, PARAMS | {"g": -PARAMS["g"]}, TS).q, atol=1e-8)
    assert count > 1 and np.max(np.abs(traj.q - known.q)) > 1


def falling():
    """Return a system of newly made functions, which also close over a list."""
    kept = [9.81]
    return lj.System(lambda t, q, v, p: 0.5 * p["m"] * v**2 - p["m"] * kept[0] * q)


@pytest.mark.exhaustive
def test_the_same_program_serves():
    """One program serves any number of outputs, and functions that mean the same. Twin: of another level, no other."""
    at = np.linspace(0.0, 1.0, 100)
    fall = lambda system, ts=at, **kw: lj.integrate(system, 1.0, 0.0, {"m": 2.0}, ts=ts, **kw)
    first, again = falling(), falling()
    floor = lambda level=0.0: {"floor": lj.Crossing(lambda t, q, v, p: q - level)}
    expected, with_event = fall(first).q, fall(first, events=floor()).q
    with compiles() as count:
        more = np.asarray(fall(first, ts=np.linspace(0.0, 1.0, 101)).q)
        np.testing.assert_allclose(more[[0, -1]], np.asarray(expected)[[0, -1]], atol=1e-9)
        np.testing.assert_array_equal(fall(again).q, expected)
        np.testing.assert_array_equal(fall(again, events=floor()).q, with_event)
    assert not count and not np.isfinite(with_event[-1])
    assert float(fall(again, events=floor(0.5)).end.t) == pytest.approx(np.sqrt(1 / 9.81))


def test_a_whole_number_that_counts_stays_whole():
    """A whole number in params stays whole, as an index must; one of the start becomes a float.

    Twin: the program of another kind of number is another one.
    """
    given = lambda k: coordinates.prepared(0, 1, 0, {"k": k, "which": 2})
    for k, kind in ((1.0, "f"), (1, "i"), (np.array([1, 2]), "i")):
        found = given(k)
        assert [np.result_type(x).kind for x in (*found[:3], found.params["k"], found.params["which"])] == [
            *"fff", kind, "i"]  # fmt: skip
    of = lambda k: hashable_partition(given(k))[1]
    assert of(1.0) == of(2.5) != of(1)


def test_another_function_is_looked_at():
    """That shapes were once found correct says nothing about another start."""
    lj.integrate(pendulum, 0.5, 0.0, PARAMS, ts=TS)
    with pytest.raises(ValueError, match="energies left unsummed"):
        lj.integrate(pendulum, np.array([0.5, 0.5]), np.zeros(2), PARAMS, ts=TS)


@pytest.mark.exhaustive
def test_equations_are_taken_for_regular_first():
    """A rod is regular; a rod given twice is not, and the robust solve finds the same motion."""
    once = lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS)
    irregular = lambda: sum(getattr(program, "regular", True) is None for program in PROGRAMS.values())
    before = irregular()
    twice = lj.System(cartesian_lagrangian, {name: lj.Holonomic(rod) for name in ("rod", "spare")})
    both, again = (lj.integrate(twice, *HORIZONTAL, PARAMS, ts=TS) for _ in range(2))
    assert irregular() == before + 1 and np.array_equal(both.q["x"], again.q["x"])
    np.testing.assert_allclose(both.q["x"], once.q["x"], atol=1e-8)
    np.testing.assert_allclose(both.multipliers["rod"], 0.5 * once.multipliers["rod"], atol=1e-7)


# In a process of its own, since memory maps come and go for other reasons, too.
MANY = """
import gc, sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import lagjax as lj
from lagjax.integrate.solve.programs import method_of
from lagjax.jaxtools import hashable_partition
from lagjax.jaxtools.cache import PROGRAMS
from lagjax.system import coordinates, model_of
PROGRAMS.most = int(sys.argv[1])
used = []
for i in [*range(6), 0]:
    system = lj.System(lambda t, q, v, p, g=1.0 + i: 0.5 * p["m"] * v**2 - p["m"] * g * q)
    last = lj.integrate(system, 1.0, 0.0, {"m": 2.0}, ts=np.linspace(0.0, 1.0, 8)).q[-1]
    # A dropped program is compiled again.
    assert abs(float(last) - (1.0 - (1.0 + i) / 2)) < 1e-8
    gc.collect()
    used.append(open("/proc/self/maps").read().count("\\n"))
print(used[5] - used[2])
"""


@pytest.mark.exhaustive
def test_programs_of_many_systems_are_dropped():
    """The number of memory maps stays constant; the twin, which keeps all programs, needs more for each."""
    grown = lambda kept: float(subprocess.check_output([sys.executable, "-c", MANY, kept], text=True))
    assert grown("2") < 40 and grown("100") > 60


@pytest.mark.exhaustive
def test_lanes_of_what_functions_close_over():
    """Batched numbers that L and a guard close over, without `jit`: each lane uses its own. Twin: its neighbour's."""

    def falls(g, level):
        stone = lj.System(lambda t, q, v, p: 0.5 * v**2 - g * q)
        events = {"level": lj.Crossing(lambda t, q, v, p: q - level)}
        return lj.integrate(stone, 2.0, 0.0, ts=np.array([0.0, 9.0]), events=events, throw=False).end.t

    g, level = jnp.array([1.0, 4.0, 16.0]), jnp.array([1.0, 0.5, -1.0])
    found, expected = jax.vmap(falls)(g, level), np.sqrt(2 * (2.0 - level) / g)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert np.all(np.abs(found - np.roll(expected, 1)) > 0.1)
