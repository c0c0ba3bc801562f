"""The motion between outputs: its order, its constraints, its derivatives, and where it is not available."""

import copy

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj, ellipk

import lagjax as lj
from lagjax.integrate.trajectory.films import hermite
from tests.counting import compiles

TS = np.linspace(0.0, 4.0, 9)
AMPLITUDE = 2.0
BETWEEN = np.array([3.3, 0.1, 1.7, 2.6])


def pendulum(t, q, v, params):
    """A pendulum of length and mass 1."""
    return 0.5 * v**2 + params["g"] * jnp.cos(q)


def swing(q0=AMPLITUDE, g=1.0, ts=TS, **settings):
    """The pendulum released at `q0`."""
    return lj.integrate(lj.System(pendulum), q0, 0.0, {"g": g}, ts=ts, **settings)


def exact(t):
    """The angle and its rate: Landau & Lifshitz, *Mechanics*, §11."""
    k = np.sin(AMPLITUDE / 2)
    sn, cn, dn, _ = ellipj(ellipk(k**2) - np.asarray(t), k**2)
    return 2 * np.arcsin(k * sn), -2 * k * cn * dn / np.sqrt(1 - (k * sn) ** 2)


def on_a_circle(t, q, v, params):
    """The pendulum in Cartesian coordinates."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


circle = lj.System(
    on_a_circle, {"rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)}
)
START = {"x": np.sin(AMPLITUDE), "y": -np.cos(AMPLITUDE)}, {"x": 0.0, "y": 0.0}


def rotate(ts=TS, g=1.0, **settings):
    """The same motion on the circle."""
    return lj.integrate(circle, *START, {"g": g, "length": 1.0}, ts=ts, **settings)


def test_times_of_any_shape():
    """Within the tolerance of the exact motion, in the requested order and shape; at outputs bit for bit."""
    traj = swing()
    for t in (BETWEEN, BETWEEN.reshape(2, 2), 1.25, 2, [0.5, 0.75], np.zeros((0, 3))):
        found, (q, v) = traj.at(t), exact(t)
        assert isinstance(found, lj.Snapshot) and found.t.shape == found.q.shape == np.shape(t)
        np.testing.assert_allclose(found.q, q, atol=1e-9)
        np.testing.assert_allclose(found.v, v, atol=1e-9)
    np.testing.assert_array_equal(traj.at(TS[::-1]).q, traj.q[::-1])


def errors_at_step(h):
    """The largest errors halfway between outputs that are one step apart: by `at`, and by a cubic with slopes v."""
    ts = np.arange(0.0, 4.0 + h / 2, h)
    traj = swing(ts=ts, method=diffrax.Dopri5(), stepsize_controller=diffrax.ConstantStepSize(), dt0=h)
    t = (ts[:-1] + h / 2)[:: len(ts) // 40]
    cubic = hermite(*map(np.asarray, (traj.t, traj.q, traj.v)), t)
    return [np.max(np.abs(found - exact(t)[0])) for found in (traj.at(t).q, cubic)]


@pytest.mark.slow
def test_order_of_the_method():
    """With Dopri5 it has order 5 on a nonlinear motion; twin: the cubic through the outputs has order 4."""
    steps = 0.1 / 2.0 ** np.arange(3)
    of_at, of_cubic = np.polyfit(np.log(steps), np.log([errors_at_step(h) for h in steps]), 1)[0]
    assert abs(of_at - 5.0) < 0.35 and abs(of_cubic - 4.0) < 0.35


def test_constraints_hold():
    """States are projected and have multipliers: Newton's law along the rod, 2 λ = -(v² - g y) for g = x² + y² - 1."""
    found = rotate().at(BETWEEN)
    q, v = exact(BETWEEN)
    np.testing.assert_allclose(found.q["x"], np.sin(q), atol=1e-8)
    np.testing.assert_allclose(found.q["x"] ** 2 + found.q["y"] ** 2, 1.0, atol=1e-14)
    np.testing.assert_allclose(found.q["x"] * found.v["x"] + found.q["y"] * found.v["y"], 0.0, atol=1e-14)
    np.testing.assert_allclose(-2 * found.multipliers["rod"], v**2 + np.cos(q), atol=1e-7)


def test_backward():
    """A motion that runs backward in time is continued backward, even from a copy of the trajectory."""
    end_q, end_v = map(float, exact(4.0))
    traj = lj.integrate(lj.System(pendulum), end_q, end_v, {"g": 1.0}, ts=TS[::-1])
    np.testing.assert_allclose(traj.at(BETWEEN).q, exact(BETWEEN)[0], atol=1e-8)
    np.testing.assert_array_equal(copy.deepcopy(traj).at(BETWEEN).q, traj.at(BETWEEN).q)
    with pytest.raises(ValueError, match="known from t = 0 to 4"):
        traj.at(4.1)


def test_where_there_is_no_motion():
    """Times outside, or after an event, are refused with the reason, NaN in a program; the event itself is known."""
    lowest = lj.Crossing(lambda t, q, v, params: q)
    traj = swing(events={"lowest": lowest})
    end = float(ellipk(np.sin(AMPLITUDE / 2) ** 2))
    assert abs(float(traj.at(traj.end.t).q)) < 1e-9 and abs(float(traj.end.t) - end) < 1e-8
    np.testing.assert_allclose(traj.at(end - 0.01).q, exact(end - 0.01)[0], atol=1e-9)
    for t, words in ((3.0, "ended by its event"), (-0.1, "outside of the motion"), (np.nan, "outside of the motion")):
        with pytest.raises(ValueError, match=words):
            traj.at(t)
    with pytest.raises(TypeError, match="a time or an array of times, not 'noon'"):
        traj.at("noon")
    inside = jax.jit(lambda traj, t: traj.at(t).q)(traj, np.array([-0.1, 1.0, 3.0]))
    assert list(np.isnan(inside)) == [True, False, True] and abs(inside[1] - exact(1.0)[0]) < 1e-9


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
    """Outputs off the constraints and planned steps cannot be continued."""
    with pytest.raises(ValueError, match="outputs are off the constraints"):
        rotate(drift="none").at(0.3)
    planned = dict(method=lj.Tsit5(), stepsize_controller=diffrax.StepTo(TS))
    with pytest.raises(ValueError, match="StepTo plans the steps"):
        swing(**planned, throw=False).at(0.3)


@pytest.mark.exhaustive
@pytest.mark.parametrize("of", [swing, rotate])
def test_derivatives(of):
    """The derivative by t is the velocity, also at outputs and ends; that by a parameter is the central difference."""
    x = lambda moment: jnp.sin(moment.q) if of is swing else moment.q["x"]
    place = lambda g, t: x(of(g=g).at(t))
    both, gradient = jax.jit(jax.jacfwd(place, argnums=(0, 1))), jax.jit(jax.grad(place))
    for t in (0.0, 0.3, float(TS[3]), 4.0):
        _, v = exact(t)
        (forward, by_t), reverse = both(1.0, t), gradient(1.0, t)
        h = 1e-4
        central = (place(1.0 + h, t) - place(1.0 - h, t)) / (2 * h)
        np.testing.assert_allclose((forward, reverse), central, atol=1e-6)
        np.testing.assert_allclose(by_t, np.cos(exact(t)[0]) * v, atol=1e-8)


@pytest.mark.exhaustive
def test_second_derivative_at_an_output():
    """The second derivative by t at an output, where no step is taken, is the acceleration -g sin q, not zero."""
    traj = swing()
    for t in (0.0, float(TS[3])):
        twice = jax.grad(jax.grad(lambda t: traj.at(t).q))(t)
        np.testing.assert_allclose(twice, -np.sin(exact(t)[0]), atol=1e-8)
    assert abs(np.sin(exact(TS[3])[0])) > 0.1


def test_one_program_for_all_times():
    """Another motion of the system at other times compiles nothing; twin: many more times do."""
    swing().at([0.3, 0.5])
    other = swing(q0=1.0, g=2.0)
    with compiles() as again:
        other.at([0.7, 2.9])
    with compiles() as of_many:
        other.at(np.linspace(0.1, 3.9, 20))
    assert not again and of_many
