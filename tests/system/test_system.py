"""Systems as values: equal where their functions are, static arguments of programs, pickled if these can be.

Motions in phases: times of switches, states and derivatives across them, impacts, friction, and refusals.
"""

import copy
import pickle
import re
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory, failure
from lagjax.integrate.trajectory import Switches
from lagjax.system import State
from tests.behaviour.test_bad_input import refusal
from tests.behaviour.test_copies import spring, system
from tests.systems import PARAMS, pendulum


def rod(t, q, params):
    """A constraint function that can be pickled."""
    return q["x"] - params["k"]


def test_systems_are_static_arguments():
    """As static arguments of `jax.jit`, equal systems share one trace; a different system is traced again."""
    traces = []

    def force(system, x):
        traces.append(system)
        return lj.accelerations(system, 0.0, {"x": x}, {"x": 0.0}, {"k": 2.0, "power": 2})[0]["x"]

    program = jax.jit(force, static_argnums=0)
    for equal in (system, lj.System(spring), copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        assert program(equal, 1.0) == -4.0 and hash(equal) == hash(system) and equal == system
    assert len(traces) == 1
    other = lj.System(lambda t, q, v, params: spring(t, q, v, params) - q["x"])
    assert program(other, 1.0) == -5.0 and len(traces) == 2 and other != system


def test_equal_systems():
    """Systems compare by constraint names and values of arrays in functions; twins: another name, another number."""
    of = lambda name: lj.System(spring, {name: lj.Holonomic(rod)})
    assert of("rod") == of("rod") != of("bar") and hash(of("rod")) == hash(of("rod"))
    carried = lambda x: lj.System(jax.tree_util.Partial(lambda x, *state: x * spring(*state), jnp.asarray(x)))
    one = carried(1.0)
    assert one == jax.tree.map(jnp.array, one) and one != jax.tree.map(lambda x: 2 * x, one)
    phases = lambda: lj.Hybrid({"flying": system}, [lj.Switch("flying", to="flying", when=rod, reset=spring)])
    assert phases() == phases() and hash(phases()) == hash(phases())


def test_functions_that_pickle_cannot_find():
    """The error of pickle names role, place and fix; copies keep any function. Twin: `spring` can be pickled."""

    def nameless(t, q, params):
        return q["x"]

    here = lambda t, q, v, params: q["x"]
    for thing, words in (
        (lj.System(here), "the Lagrangian cannot be pickled: it is a lambda (test_system.py, line "),
        (lj.System(spring, {"rod": lj.Holonomic(nameless)}), "g of constraint 'rod' .*nameless is defined inside of"),
        (lj.System(spring, force=here), "the force cannot be pickled"),
        (lj.Crossing(here), "the guard of a crossing cannot"),
        (lj.Switch("a", to="b", when=here), "when of the switch 'a' -> 'b' cannot"),
    ):
        with pytest.raises(pickle.PicklingError, match=words.replace("(", r"\(")) as raised:
            pickle.dumps(thing)
        assert "Fix: define it with def" in str(raised.value)
        assert copy.deepcopy(thing) == thing
    assert pickle.loads(pickle.dumps(lj.System(spring, {"rod": lj.Holonomic(rod)}))).constraints["rod"].g is rod


def test_called_lagrangian_and_bare_constraint():
    """`System` refuses a value instead of a function, and a constraint without a kind."""
    with refusal(TypeError, "lagrangian must be a function"):
        lj.System(3.0)
    with refusal(TypeError, "'rod'", "lj.Holonomic"):
        lj.System(pendulum.lagrangian, {"rod": lambda t, q, params: q})
    with refusal(TypeError, "kinetic and potential energy given separately", "return kinetic - potential"):
        lj.System(pendulum.lagrangian, pendulum.lagrangian)
    with refusal(TypeError, "params in the place of constraints", "each call takes them"):
        lj.System(pendulum.lagrangian, PARAMS)
    with refusal(TypeError, "the name of a constraint must be text, not 3"):
        lj.System(pendulum.lagrangian, {3: lj.Holonomic(lambda t, q, params: q)})


G = 9.81
FALL = np.sqrt(2 / G)


def falling(t, q, v, params):
    """A ball in its height."""
    return 0.5 * v**2 - params["g"] * q


height = lambda t, q, params: q
ball = lj.System(falling)
lying = lj.System(falling, {"floor": lj.Holonomic(lambda t, q, params: q)})
bounce = lj.Switch("flying", to="flying", when=lambda t, q, v, p: q, reset=lambda t, q, v, p: -p["e"] * v)
bouncing = lj.Hybrid({"flying": ball}, [bounce], most_switches=4)
HOOP = {"g": G, "e": 0.5}


def in_phases(*args, **options) -> HybridTrajectory:
    """Call `lj.integrate` with a hybrid system."""
    traj = lj.integrate(*args, **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


def bounced(h=1.0, e=0.5, g=G, **options):
    """Two bounces, with an output exactly at the first."""
    ts = np.array([0.0, 0.25, FALL, 0.75, 1.0])
    return in_phases(bouncing, h, 0.0, {"g": g, "e": e}, ts=ts, **options)


def heights(t, h=1.0, e=0.5):
    """The heights of the ball in closed form, for its first two flights after the fall."""
    first, speed = np.sqrt(2 * h / G), np.sqrt(2 * h * G)
    second = first + 2 * e * first
    flight = lambda s, v: v * s - 0.5 * G * s**2
    flights = [flight(t - first, e * speed), flight(t - second, e**2 * speed)]
    return np.select([t <= first, t <= second], [h - 0.5 * G * t**2, flights[0]], flights[1])


@pytest.mark.exhaustive
def test_a_ball_that_bounces():
    """Times, states before and after, impulses; outputs on a switch have the state before it; derivatives both ways."""
    traj = bounced()
    np.testing.assert_allclose(traj.switches.t[:2], [FALL, 2 * FALL], rtol=1e-14)
    np.testing.assert_allclose(traj.q, heights(np.asarray(traj.t)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(traj.v[2], -np.sqrt(2 * G), rtol=1e-13)
    np.testing.assert_allclose(traj.switches.v_after[:2] / traj.switches.v[:2], -0.5, rtol=1e-14)
    np.testing.assert_allclose(traj.switches.impulse[0], 1.5 * np.sqrt(2 * G), rtol=1e-13)
    assert len(traj.switches) == 2 and np.isnan(traj.switches.t[2:]).all() and set(traj.named_phases()) == {"flying"}
    of_times_and_end = lambda h, e: (lambda traj: jnp.append(traj.switches.t[:2], traj.q[-1]))(bounced(h, e))
    by_h, by_e = jax.jacrev(of_times_and_end, argnums=(0, 1))(1.0, 0.5)
    np.testing.assert_allclose(by_h[:2], [0.225761820493, 2 * 0.225761820493], rtol=1e-11)
    np.testing.assert_allclose(by_e[:2], [0.0, 0.903047281972], rtol=1e-11, atol=1e-14)
    slope = lambda h, e: (heights(1.0, 1 + h, 0.5 + e) - heights(1.0, 1 - h, 0.5 - e)) / 2e-6
    np.testing.assert_allclose([by_h[2], by_e[2]], [slope(1e-6, 0.0), slope(0.0, 1e-6)], rtol=1e-8)


def switched(t, v, v_after):
    """A ball whose flights begin with these switches, as far as an error looks at them."""
    few, none = len(t), np.zeros(len(t), int)
    switches = Switches(t, none, none, none, v, none, v_after, none, np.array(few), np.array(False), ("flying",), ())
    return types.SimpleNamespace(switches=switches, system=bouncing)


def test_too_many_switches():
    """Flights that halve come to rest, switches at one time change something or nothing, and others are just many."""
    for t, v_after, words in (
        (2 - 0.5 ** np.arange(14.0), 0.5, "exceeds most_switches = 14(.|\n)*each takes 0.5 of the time(.|\n)*t = 2."),
        (np.arange(1.0, 5.0), 0.5, "until t = 4, and one more exceeds most_switches = 4.\n.*most_switches=40"),
        (np.full(4, 1.0), 0.5, "The last 4 of them, flying -> flying .* change velocities, the last one by 1.5"),
        (np.full(4, 1.0), -1.0, "The last 4 of them, .* changes velocities by 0 only(.|\n)*No phase lasts"),
    ):
        said = failure._too_many(switched(t, -np.ones(len(t)), np.full(len(t), v_after)))
        assert re.search(words, said), said


def test_a_guard_below_zero():
    """A start on the wrong side of a guard is refused with its value; twin: on the other side there is none to name."""
    below = failure._below_zero(bouncing, State(0.0, -1.0, 0.0, HOOP))
    assert re.search("guard of phase 'flying' is below zero at the start: .*is -1.\nUsual cause", below)
    assert "start: .\n" in failure._below_zero(bouncing, State(0.0, 1.0, 0.0, HOOP))


def hybrid(to="flying", **switch):
    """A ball with a switch."""
    return lj.Hybrid({"flying": ball}, [lj.Switch("flying", to=to, **({"when": lambda t, q, v, p: q} | switch))])


def run(system, ts=(0.0, 1.0), **options):
    """Ask for a motion."""
    return lj.integrate(system, 1.0, 0.0, HOOP, ts=np.array(ts), **options)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: hybrid("rolling"), ValueError, "names 'rolling', which is no phase"),
        (lambda: run(bouncing, start="rolling"), ValueError, "start names 'rolling', which is no phase"),
        (lambda: run(ball, start="flying"), ValueError, "start= names the first phase"),
        (lambda: run(bouncing, (1.0, 0.0)), ValueError, "runs forward"),
        (lambda: hybrid(when=lambda t, q, v, p: v), ValueError, "leads back to its phase and resets nothing"),
        (lambda: lj.mass_matrix(bouncing, 0.0, 1.0, 0.0, HOOP), TypeError,
         r"(?s)takes one system.*hybrid.systems\[0\] for 'flying'"),
        (lambda: lj.Hybrid({"a": falling}), TypeError, "phase 'a' must be a lj.System, not the function"),
        (lambda: run(hybrid(reset=lambda t, q, v, p: (v, v, v))), ValueError,
         r"reset\(t, q, v, params\).* must return velocities like v"),
    ],
)  # fmt: skip
def test_said_by_name(call, error, words):
    """Wrong phases, directions of time, resets and kinds are refused before anything runs."""
    with pytest.raises(error, match=words):
        call()


@pytest.mark.exhaustive
def test_it_comes_to_rest():
    """Infinitely many bounces end in the phase of rest, at the time in closed form, √(2h/g)(1+e)/(1-e)."""
    fall = lj.Switch(
        "flying", to="flying", when=lj.guards.touches(height, restitution=0.5), rest="lying", slower_than=1e-8
    )
    both = lj.Hybrid({"flying": ball, "lying": lying}, [fall], most_switches=60)
    traj = in_phases(both, 1.0, 0.0, {"g": G}, ts=np.linspace(0.0, 3.0, 7))
    assert len(traj.switches) == 29 and traj.named_phases()[-1] == "lying"
    np.testing.assert_allclose(traj.switches.t[28], 3 * FALL, rtol=1e-8)
    np.testing.assert_allclose(traj.q[4:], 0.0, atol=1e-14)
    np.testing.assert_allclose(traj.multipliers["floor"][4:], G, rtol=1e-12)
    assert np.isnan(traj.multipliers["floor"][0])


@pytest.mark.exhaustive
def test_between_walls():
    """Without gravity dz_end/dz₀ = -1 after one elastic bounce, 1 after two; a thousand lanes have the closed form."""
    free = lj.System(lambda t, q, v, p: 0.5 * v**2)
    left, right = (lj.guards.touches(gap, restitution=1.0) for gap in (height, lambda t, q, p: p["width"] - q))
    walls = lj.Hybrid({"free": free}, [lj.Switch("free", to="free", when=wall) for wall in (left, right)])
    end = lambda z, v: lj.integrate(walls, z, v, {"width": 1.0}, ts=np.array([0.0, 1.0]), estimate_error=False).q[-1]
    # Batched derivatives, of lanes that bounce once and of lanes that bounce twice.
    slopes = jax.vmap(jax.jacfwd(end))(np.array([0.3, 0.3]), np.array([1.0, 2.0]))
    np.testing.assert_allclose(slopes, [-1.0, 1.0], rtol=1e-12)
    z, v = np.linspace(0.1, 0.9, 1000), np.linspace(1.0, 9.0, 1000)
    found = jax.jit(jax.vmap(end))(z, v)
    np.testing.assert_allclose(found, np.abs((z + v + 1) % 2 - 1), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_two_balls_collide():
    """The impulse is that of the metric of M."""
    balls = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(p["m"] * v**2))
    apart = lj.guards.touches(lambda t, q, p: q[1] - q[0], restitution=lambda speed: 0.5 + 0.0 * speed)
    hybrid = lj.Hybrid({"apart": balls}, [lj.Switch("apart", to="apart", when=apart)])
    m, v0 = np.array([1.0, 3.0]), np.array([2.0, -1.0])

    def ends(v0):
        ts = np.array([0.0, 1.0])
        return lj.integrate(hybrid, np.array([0.0, 1.0]), v0, {"m": m}, ts=ts, estimate_error=False).q[-1]

    when, mean, closing = 1.0 / 3.0, m @ v0 / 4.0, 3.0
    after = mean + 0.5 * closing * np.array([-m[1], m[0]]) / 4.0
    np.testing.assert_allclose(ends(v0), v0[0] * when + after * (1.0 - when), rtol=1e-12)


@pytest.mark.slow
def test_a_body_that_rests_is_not_taken_to_fly():
    """A body in a flying phase that rests on its support would fall through it: this is refused."""
    touching = lj.Hybrid(
        {"flying": ball}, [lj.Switch("flying", to="flying", when=lj.guards.touches(height, restitution=0.0))]
    )
    for v0 in (0.0, 1e-18):
        with pytest.raises(RuntimeError, match="No phase lasts"):
            lj.integrate(touching, 0.0, v0, {"g": G}, ts=np.array([0.0, 1.0]))


@pytest.mark.slow
def test_two_guards_at_once():
    """A ball that hits a corner switches at both walls at one time, one after the other."""
    free = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2))
    walls = [lj.guards.touches(lambda t, q, p, i=i: q[i], restitution=1.0) for i in (0, 1)]
    corner = lj.Hybrid({"free": free}, [lj.Switch("free", to="free", when=wall) for wall in walls])
    traj = in_phases(corner, np.ones(2), -np.ones(2), ts=np.array([0.0, 3.0]))
    np.testing.assert_allclose(traj.q[-1], 2.0, rtol=1e-13)
    np.testing.assert_allclose(traj.switches.t[:2], 1.0, rtol=1e-14)
    assert len(traj.switches) == 2
