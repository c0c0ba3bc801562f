"""Lanes that start in different phases.

Decreasing times: compared with SciPy and with the forward motion, through events, derivatives and batches.
"""

from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.solve.phases import backward_trajectory_of, phases_in, reflect_system, traced_phases
from lagjax.integrate.solve.segments import _first
from lagjax.system import coordinates
from tests.by_numpy import by_numpy
from tests.systems import DRIVEN_PARAMS, HORIZONTAL, PARAMS, driven, pendulum, rod_pendulum

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


DOWN, SHORT = np.linspace(2.0, 0.0, 9), np.array([2.0, 1.5, 0.25, 0.0])
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def sledge_lagrangian(t, q, v, params):
    """A sledge on a slope, pushed along x periodically in t."""
    kinetic = 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * v["angle"] ** 2
    return kinetic + (params["m"] * params["g"] + params["push"] * jnp.sin(3.0 * t)) * q["x"]


def edge(t, q, v, params):
    """The blade does not move sideways."""
    return v["x"] * jnp.sin(q["angle"]) - v["y"] * jnp.cos(q["angle"])


def drag(t, q, v, params):
    """Rayleigh's function, of the motion and of the turning; it grows with time."""
    return 0.5 * params["c"] * (1.0 + t) * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * 0.3 * v["angle"] ** 2


def wind(t, q, v, params):
    """A torque that depends on time and velocity."""
    return {"x": 0.0, "y": 0.0, "angle": 0.4 * jnp.cos(t + 1.0) + 0.1 * v["angle"] ** 2}


sledge = lj.System(sledge_lagrangian, {"edge": lj.Nonholonomic(edge)}, force=wind, dissipation=drag)
SLEDGE = {"m": 1.5, "g": 2.0, "push": 0.75, "c": 0.5}
SLEDGE_START = (
    {"x": 0.3, "y": -0.2, "angle": 0.4}, {"x": 1.25 * np.cos(0.4), "y": 1.25 * np.sin(0.4), "angle": 0.8}
)  # fmt: skip


def test_a_driven_and_damped_spring():
    """Backward in time damping adds energy: states agree with SciPy's from the far end; twin: forward from there.

    Time runs down in the result, and its system is the user's.
    """
    m, k, c, pull, rate = DRIVEN_PARAMS.values()
    by_hand = lambda t, y: [y[1], (pull * np.cos(rate * t) - k * y[0] - c * y[1]) / m]
    y = solve_ivp(by_hand, (2, 0), [0.3, 0.7], "DOP853", SHORT, rtol=1e-12, atol=1e-12).y
    back = lj.integrate(driven, 0.3, 0.7, DRIVEN_PARAMS, ts=SHORT, rtol=1e-11)
    np.testing.assert_allclose([back.q, back.v], y, atol=1e-9)
    np.testing.assert_array_equal(back.t, SHORT)
    np.testing.assert_array_equal([back.end.t, back.end.v], [0.0, np.asarray(back.v)[-1]])
    assert "(at t" not in repr(back) and back.system is not driven and back.system == driven
    assert back.static.how.backward and back.static.integrate is backward_trajectory_of
    assert abs(solve_ivp(by_hand, (2, 4), [0.3, 0.7], rtol=1e-9).y[0, -1] - y[0, -1]) > 0.1


def test_each_part_is_reflected():
    """L and forces of the reflected system at -t and -v are the system's; R and velocity constraints their opposites.

    Twin: at t and v they are not.
    """
    q, v = {"x": 0.1, "y": 0.2, "angle": 0.7}, {"x": 0.4, "y": 0.9, "angle": 0.6}
    negative = {name: -x for name, x in v.items()}
    reflected = reflect_system(sledge)
    parts = lambda s: (s.lagrangian, s.constraints["edge"].residual, s.force, s.dissipation)
    for sign, ours, theirs in zip((1, -1, 1, -1), parts(reflected), parts(sledge)):
        there, here, not_reflected = (
            np.array(jax.tree.leaves(by_numpy(of)(*state, SLEDGE)))
            for of, state in ((ours, (-1.3, q, negative)), (theirs, (1.3, q, v)), (ours, (1.3, q, v)))
        )
        np.testing.assert_allclose(there, sign * here, rtol=1e-15)
        assert np.max(np.abs(not_reflected - sign * here)) > 0.1


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("motion", "options"),
    [
        ("rod", {"dt0": 0.01, "max_step": 0.1}), ("rod", {"drift": "baumgarte"}), ("rod", {"method": lj.Radau5()}),
        ("sledge", {}),
    ],
    ids=str,
)  # fmt: skip
def test_there_and_back(motion, options):
    """A motion runs forward, and from its end backward to its start, with the same multipliers."""
    system, start, params = (rod_pendulum, HORIZONTAL, PARAMS) if motion == "rod" else (sledge, SLEDGE_START, SLEDGE)
    there = lj.integrate(system, *start, params, ts=DOWN[::-1], rtol=1e-9, atol=1e-9, **options)
    back = lj.integrate(system, there.end.q, there.end.v, params, ts=DOWN, rtol=1e-9, atol=1e-9, **options)
    motions = ((traj.q, traj.v, traj.multipliers) for traj in (there, back))
    for a, b in zip(*map(jax.tree.leaves, motions)):
        np.testing.assert_allclose(a[::-1], b, atol=1e-6)
    assert float(back.residual()) < (1e-6 if "drift" in options else 1e-14)
    assert motion == "sledge" or float(back.drift()) < 1e-6


@pytest.mark.exhaustive
def test_events_backward():
    """Thrown up to 0 at t = 2 with v = -10: backward it rises to 3.75 at t = 1.5; the direction is that of the run."""
    stone = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    level = lambda direction: diffrax.Event(lambda t, y, params, **kwargs: y[0] - 3.75, direction=direction)
    run = lambda event: lj.integrate(stone, 0.0, -10.0, ts=DOWN, event=event, max_step=0.05).end
    up, down = run(level(True)), run(level(False))
    np.testing.assert_allclose([up.t, up.q, up.v], [1.5, 3.75, -5.0], atol=1e-12)
    np.testing.assert_allclose([down.t, down.q, down.v], [0.5, 3.75, 5.0], atol=1e-12)
    late = diffrax.Event(lambda t, y, params, **kwargs: (t - 1.75) + 0.0 * y[1])
    np.testing.assert_allclose(run(late).t, 1.75, atol=1e-12)
    moving = diffrax.Event(lambda t, y, params, **kwargs: y[1] + 4.0)
    np.testing.assert_allclose(run(moving).t, 1.4, atol=1e-12)


@pytest.mark.exhaustive
def test_derivatives_and_lanes_backward():
    """By all numbers and the times, in both modes, twice, in lanes: q = q2 cos(k (t - t2)) + v2/k sin(k (t - t2))."""
    spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (params["k"] * q) ** 2)

    def first(x, t=2.0):
        ts = t * np.linspace(1.0, 0.25, 4)
        return lj.integrate(spring, x["q"], x["v"], {"k": x["k"]}, ts=ts, **TIGHT).q[-1]

    def exact(x, t=2.0):
        turned = -0.75 * x["k"] * t
        return x["q"] * jnp.cos(turned) + x["v"] / x["k"] * jnp.sin(turned)

    x = {"q": 0.75, "v": -0.5, "k": 1.25}
    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
        found, expected = derivative(first)(x), derivative(exact)(x)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-8), found, expected)
    np.testing.assert_allclose(jax.grad(first, 1)(x, 2.0), jax.grad(exact, 1)(x, 2.0), atol=1e-9)
    found, expected = (jax.vmap(lambda q: f(x | {"q": q}))(jnp.linspace(0.0, 1.0, 5)) for f in (first, exact))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.exhaustive
def test_times_closed_over_inside_jit():
    """The direction of JAX arrays that a traced function closes over is known while tracing."""
    for ts in (jnp.asarray(DOWN), jnp.asarray(DOWN[::-1])):
        run = lambda q: lj.integrate(pendulum, q, 1.0, PARAMS, ts=ts).q
        np.testing.assert_allclose(jax.jit(run)(0.5), run(0.5), atol=1e-9)
