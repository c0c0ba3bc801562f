"""The motion between outputs: its order, its constraints, its derivatives, and where it is not available."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import Snapshot
from tests.by_hand import ASKED, HOW, by_hand, with_problem
from tests.by_hand import swing as exact_swing
from tests.counting import compiles
from tests.systems import motion, pendulum, rod_pendulum

TS = np.linspace(0.0, 4.0, 8)
AMPLITUDE = 2.0
BETWEEN = np.array([3.3, 0.1, 1.7, 2.6])
START = {"x": np.sin(AMPLITUDE), "y": -np.cos(AMPLITUDE)}, {"x": 0.0, "y": 0.0}


def swing(q0=AMPLITUDE, g=1.0, ts=TS, **settings):
    """A pendulum of length 1 released at `q0`."""
    return lj.integrate(pendulum, q0, 0.0, {"g": g, "l": 1.0}, ts=ts, **settings)


def exact(t):
    """The angle and its rate."""
    return exact_swing(t, AMPLITUDE)


def rotate(ts=TS, g=1.0, **settings):
    """The same motion on the circle."""
    return lj.integrate(rod_pendulum, *START, {"g": g, "l": 1.0}, ts=ts, **settings)


def test_times_of_any_shape():
    """Within the tolerance of the exact motion, in the requested order and shape; at outputs bit for bit.

    Another motion of the system at other times compiles nothing; twin: a new function does.
    """
    traj = swing()
    for t in (BETWEEN, BETWEEN.reshape(2, 2), 1.25, 2, [0.5, 0.75], np.zeros((0, 3))):
        found, (q, v) = traj.at(t), exact(t)
        assert isinstance(found, Snapshot) and found.t.shape == found.q.shape == np.shape(t)
        np.testing.assert_allclose(found.q, q, atol=1e-9)
        np.testing.assert_allclose(found.v, v, atol=1e-9)
    np.testing.assert_array_equal(traj.at(TS[::-1]).q, np.asarray(traj.q)[::-1])
    other = swing(q0=1.0, g=2.0)
    with compiles() as again:
        other.at([0.7, 2.9])
    with compiles() as of_another:
        jax.jit(lambda x: x + 1.25)(1.0)
    assert not again and of_another


def straight_on(problem):
    """In place of an integration: on along a line; the multiplier is the time of the output from which it goes on."""
    system, q, v, _, ts, _, settings = problem
    line = jax.tree.map(lambda q, v: q + v * (ts - ts[0]), q, v)
    rows = jax.tree.map(lambda v: v + 0.0 * ts, v)
    if system.constraints:
        ASKED_FOR.append(settings)
    found = {name: ts[0] + 0.0 * ts for name in system.constraints}
    return SimpleNamespace(q=line, v=rows, multipliers=found, result=lj.RESULTS.successful)


ASKED_FOR = []
FREE = lj.System(lambda t, q, v, p: 0.5 * v**2)
NODES = np.array([0.0, 1.0, 3.0]), np.array([10.0, 20.0, 40.0]), np.array([1.0, 2.0, 3.0])


def of_nodes(backward=False, **fields):
    """A motion through three outputs, from each of which it goes straight on."""
    nodes = [x[::-1] for x in NODES] if backward else NODES
    return by_hand(FREE, *nodes, how=HOW._replace(backward=backward), solve=straight_on, **fields)


def test_continued_from_the_output_before():
    """Forward from the earlier output, backward from the later one, also from a copy; in a program NaN elsewhere."""
    between = np.array([2.5, 0.5])
    forward, backward = of_nodes(), of_nodes(backward=True)
    np.testing.assert_array_equal(forward.at(between).q, [23.0, 10.5])
    for traj in (backward, copy.deepcopy(backward)):
        np.testing.assert_array_equal(traj.at(between).q, [38.5, 19.0])
        np.testing.assert_array_equal(traj.at(between).v, [3.0, 2.0])
    for traj in (forward, backward):
        with pytest.raises(ValueError, match="known from t = 0 to 3"):
            traj.at(3.1)
        inside = jax.jit(lambda traj, t: traj.at(t).q)(traj, np.array([-0.1, 2.5, 0.5, 1.0, 3.1]))
        np.testing.assert_array_equal(inside, [np.nan, *np.asarray(traj.at(between).q), 20.0, np.nan])


def test_continued_as_it_was_asked_for():
    """On the constraints, at the motion's tolerances by size, over jumps; each with its multipliers."""
    traj = with_problem(motion("rod pendulum"), max_step=np.asarray(0.5), jumps="ignored")
    static = traj.static._replace(integrate=straight_on)
    found = replace(traj, static=static).at([0.8, 0.125])
    np.testing.assert_array_equal(found.multipliers["rod"], [0.75, 0.0])
    asked = ASKED_FOR[-1]
    assert (asked.drift, asked.by_size, asked.jumps, asked.method) == ("project", True, "ignored", None)


def test_where_there_is_no_motion():
    """Times outside, or after an event, are refused with the reason; the event itself is known."""
    end = Snapshot(2.5, 23.0, 2.0, {})
    ended = of_nodes(end=end, result=lj.RESULTS.event_occurred)
    np.testing.assert_array_equal(ended.at([end.t, 2.0]).q, [end.q, 22.0])
    for t, words in ((2.6, "ended by its event"), (-0.1, "outside of the motion"), (np.nan, "outside of the motion")):
        with pytest.raises(ValueError, match=words):
            ended.at(t)
    with pytest.raises(TypeError, match="a time or an array of times, not 'noon'"):
        ended.at("noon")


@pytest.mark.exhaustive
def test_batches():
    """The lane axis comes first, each lane as in a single run; NaN where a lane has ended."""
    lanes = jax.vmap(lambda q0: swing(q0, events={"up": lj.Crossing(lambda t, q, v, params: q)}))(np.array([2.0, 3.1]))
    found = lanes.at(BETWEEN.reshape(2, 2))
    assert found.q.shape == found.t.shape == (2, 2, 2)
    first, alone = np.asarray(found.q[0]).ravel(), swing().at(BETWEEN).q
    assert np.array_equal(np.isnan(first), BETWEEN > lanes.end.t[0]) and not np.isnan(found.q[1]).any()
    known = ~np.isnan(first)
    np.testing.assert_allclose(first[known], alone[known], atol=1e-9)
    with pytest.raises(ValueError, match="outside of the motion"):
        lanes.at(5.0)


def test_what_cannot_be_continued():
    """Outputs off the constraints and planned steps cannot be continued; twin: without constraints none are off."""
    for drift in ("none", "baumgarte"):
        with pytest.raises(ValueError, match="outputs are off the constraints"):
            with_problem(motion("rod pendulum"), drift=drift).at(0.3)
    with pytest.raises(ValueError, match="StepTo plans the steps"):
        of_nodes(asked=ASKED._replace(stepsize_controller=diffrax.StepTo(TS))).at(0.3)
    assert of_nodes(asked=ASKED._replace(drift="none")).at(0.5).q == 10.5


@pytest.mark.exhaustive
@pytest.mark.parametrize("of", [swing, rotate])
def test_derivatives(of):
    """The derivative by t is the velocity, also at outputs and ends; by g it is t v/2, of a motion in √g t at g = 1."""
    x = lambda moment: jnp.sin(moment.q) if of is swing else moment.q["x"]
    place = lambda g, t: x(of(g=g).at(t))
    both, gradient = jax.jit(jax.jacfwd(place, argnums=(0, 1))), jax.jit(jax.grad(place))
    for t in (0.0, 0.3, float(TS[3]), 4.0):
        q, v = exact(t)
        (forward, by_t), reverse = both(1.0, t), gradient(1.0, t)
        np.testing.assert_allclose([forward, reverse], t / 2 * np.cos(q) * v, atol=1e-7)
        np.testing.assert_allclose(by_t, np.cos(q) * v, atol=1e-8)


@pytest.mark.exhaustive
def test_second_derivative_at_an_output():
    """The second derivative by t at an output, where no step is taken, is the acceleration -g sin q, not zero."""
    traj = swing()
    for t in (0.0, float(TS[3])):
        twice = jax.grad(jax.grad(lambda t: traj.at(t).q))(t)
        np.testing.assert_allclose(twice, -np.sin(exact(t)[0]), atol=1e-8)
    assert abs(np.sin(exact(TS[3])[0])) > 0.1
