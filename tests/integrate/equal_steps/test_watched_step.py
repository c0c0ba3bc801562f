"""Crossings found by steps of equal length: against closed forms, and against the motion without them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import lagjax as lj
from lagjax.integrate.equal_steps import loop
from tests.by_numpy import by_numpy as in_numpy

oscillator = lj.System(lambda t, q, v, k: 0.5 * v**2 - 0.5 * k * q**2)
swing = lj.System(lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q))
# Under the sum of forty numbers: reverse mode is then a second pass.
fall = lj.System(lambda t, q, v, g: 0.5 * v**2 - jnp.sum(g) * q)
FLOOR = {"floor": lj.Crossing(lambda t, q, v, g: q)}
G = 9.81
PACED = lj.Splitting(4, pace=lambda t, q, g: 1.0 + 0.1 * q)
EVEN, UNEVEN = np.linspace(0.0, 2.0, 9), np.array([0.0, 0.13, 0.31, 0.4517, 1.3, 2.0])


def run(system, q0, v0, params, ts, method, dt=0.1, **options):
    """A motion whose program serves all lengths of steps."""
    given = {"method": method, "dt0": jnp.asarray(dt), "estimate_error": False} | options
    return lj.integrate(system, q0, v0, params, ts=ts, **given)


def recorded(guard, direction=0):
    """An event that does not end the motion."""
    return lj.Crossing(guard, direction, terminal=False)


LEVELS = {
    "down": recorded(lambda t, q, v, k: q - 0.5, -1),
    "top": recorded(lambda t, q, v, k: q - 0.999),
    "end of a step": recorded(lambda t, q, v, k: t - 5.0),
    "turn": recorded(lambda t, q, v, k: v),
}
NEAR = np.arccos(0.999)


IN_A_STEP = [["down", "top"], pytest.param(list(LEVELS), marks=pytest.mark.exhaustive)]


@pytest.mark.parametrize("names", IN_A_STEP, ids=len)
def test_what_a_step_may_hold(names):
    """Crossings from above only, two in one step, at the end of a step, and turns, where the start is not one."""
    ts, events = np.linspace(0.0, 10.0, 5), {name: LEVELS[name] for name in names}
    traj = run(oscillator, 1.0, 0.0, 1.0, ts, lj.Splitting(8), 0.25, events=events)
    exact = {
        "down": [np.pi / 3, 7 * np.pi / 3],
        "top": [NEAR, 2 * np.pi - NEAR, 2 * np.pi + NEAR],
        "end of a step": [5.0],
        "turn": [np.pi, 2 * np.pi, 3 * np.pi],
    }
    for name in names:
        found = traj.events[name].found()
        np.testing.assert_allclose(found.t, exact[name], atol=1e-9, err_msg=name)
        assert int(found.count) == len(exact[name]) and not bool(found.uncertain)
    # Each state is on its guard, which a polynomial through the ends of the step would miss.
    np.testing.assert_allclose(traj.events["down"].found().q, 0.5, atol=1e-15)


def test_steps_between_other_outputs():
    """The rows of a motion in steps of 1/3, with outputs inside them and before its end."""
    of = in_numpy(lambda ts, wanted: loop.between(loop.spans(ts, 0.4, None), ts, wanted)[:4])
    found = of(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.5, 1.0, 1.1, 1.1]))
    np.testing.assert_allclose(found[0], [0.0, 1 / 3, 1.0, 1.0])
    np.testing.assert_array_equal(found[2], [1, 2, 0, 0])
    np.testing.assert_allclose(found[3], [1 / 6, 0.0, 0.1, 0.0], atol=1e-15)


@pytest.mark.exhaustive
@pytest.mark.parametrize("ts", [np.linspace(0.0, 100.0, 11), np.array([0.0, 0.77, 1.03, 1.0471, 99.9])], ids=len)
@pytest.mark.parametrize(
    "method", [lj.Gauss(2), lj.Splitting(4), lj.Splitting(4, pace=lambda t, q, k: 1.0 + 0.3 * q**2)]
)
def test_steps_stay_the_same(method, ts):
    """Outputs, the end and energy as without events; a splitting's to the last digit."""
    plain, watched = (run(swing, 1.0, 0.0, 1.0, ts, method, events=events) for events in (None, LEVELS))
    if method.pace is None:
        # At a pace a motion without events also counts the outputs that fill up an array.
        assert watched.stats["num_steps"] == plain.stats["num_steps"]
    within = 1e-14 if isinstance(method, lj.Gauss) else 0.0
    for a, b in ((watched.q, plain.q), (watched.v, plain.v), (watched.end.q, plain.end.q)):
        np.testing.assert_allclose(a, b, rtol=0, atol=within)
    assert watched.end.q == watched.q[-1]


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("method", "order"), [(lj.Gauss(1), 2), (lj.Gauss(2), 4), (lj.Splitting(2), 2), (lj.Splitting(4), 4)]
)
def test_order_of_a_crossing(method, order):
    """The time at which a pendulum turns, a quarter of its period by an elliptic integral: the order of the method."""
    level = {"low": lj.Crossing(lambda t, q, v, k: q)}
    exact = float(ellipk(np.sin(0.5) ** 2))
    off = [
        abs(float(run(swing, 1.0, 0.0, 1.0, [0.0, 2.0], method, h, events=level).end.t) - exact)
        for h in (0.2, 0.1, 0.05)
    ]
    np.testing.assert_allclose(np.log2(np.divide(off[:-1], off[1:])), order, atol=0.35)


@pytest.mark.exhaustive
def test_the_end_at_a_floor():
    """t = √(2h/g) and v = -√(2gh) there; outputs after it are not reached, and lanes end each at their own time."""
    heights = np.array([0.5, 1.0, 2.0, 40.0])
    traj = jax.jit(jax.vmap(lambda h: run(fall, h, 0.0, G, EVEN, lj.Gauss(2), events=FLOOR)))(heights)
    times = np.minimum(np.sqrt(2 * heights / G), 2.0)
    np.testing.assert_allclose(traj.end.t, times, rtol=1e-14)
    np.testing.assert_allclose(traj.end.v, -G * times, rtol=1e-13)
    np.testing.assert_array_equal(np.isfinite(traj.q), EVEN[None] <= times[:, None])
    np.testing.assert_array_equal(traj.events["floor"].count, [1, 1, 1, 0])
    slopes = jax.jit(jax.vmap(jax.grad(lambda h: run(fall, h, 0.0, G, EVEN, lj.Gauss(2), events=FLOOR).end.t)))(heights)
    np.testing.assert_allclose(slopes[:3], 1 / np.sqrt(2 * G * heights[:3]), rtol=1e-12)
    assert slopes[3] == 0.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("ts", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("method", [lj.Gauss(2), lj.Splitting(4), PACED], ids=str)
def test_reverse_mode_by_many_numbers(method, ts):
    """A second pass, whose crossings are outputs inside its steps: the slopes of closed forms, and of forward mode."""
    weights = jnp.full(40, G / 40)

    def both(w):
        traj = run(fall, 1.0, 0.0, w, ts, method, events=FLOOR)
        return jnp.stack([traj.end.t, traj.end.v, traj.q[1]])

    reverse, forward = jax.jit(lambda w: (jax.jacrev(both)(w), jax.jacfwd(both)(w)))(weights)
    exact = -0.5 * np.sqrt(2) / G**1.5, -0.5 * np.sqrt(2 / G), -(ts[1] ** 2) / 2
    np.testing.assert_allclose(reverse, np.array(exact)[:, None] * np.ones(40), rtol=1e-4 if method is PACED else 1e-11)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)


@pytest.mark.exhaustive
def test_slopes_of_an_angle():
    """d(time)/dk of a pendulum's crossing, K(sin²)/√k: forward, in reverse, by differences, and twice."""
    time = lambda k: (
        run(swing, 1.0, 0.0, k, [0.0, 3.0], lj.Gauss(4), events={"low": lj.Crossing(lambda t, q, v, k: q)}).end.t
    )
    exact, of = float(ellipk(np.sin(0.5) ** 2)), jax.jit(lambda k: (time(k), jax.grad(time)(k), jax.jacfwd(time)(k)))
    value, reverse, forward = of(1.0)
    np.testing.assert_allclose([value, reverse, forward], [exact, -exact / 2, -exact / 2], rtol=1e-9)
    np.testing.assert_allclose((of(1.0 + 1e-5)[0] - of(1.0 - 1e-5)[0]) / 2e-5, forward, rtol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(time)))(1.0), 0.75 * exact, rtol=1e-8)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", [lj.Gauss(4), lj.Splitting(8)], ids=str)
def test_where_a_step_ends(method):
    """Time as a guard, on the grid of steps and next to it, at the start, the end, backward; in single precision."""
    for at in (0.0, 0.1, 0.1 + 1e-12, 0.5, np.nextafter(0.5, 1), 1.0, 2.0):
        traj = run(
            oscillator,
            1.0,
            0.0,
            at,
            np.linspace(0.0, 2.0, 5),
            method,
            events={"t": lj.Crossing(lambda t, q, v, p: t - p)},
        )
        ended = 0.0 < at < 2.0
        np.testing.assert_allclose(traj.end.t, at if ended else 2.0, atol=1e-14)
        assert int(traj.events["t"].count) == ended
    half = {"half": lj.Crossing(lambda t, q, v, k: q - 0.5)}
    back = run(oscillator, 1.0, 0.0, 1.0, np.linspace(0.0, -5.0, 6), method, events=half)
    np.testing.assert_allclose(back.end.t, -np.pi / 3, atol=1e-9)
    # In the last step, which is shorter than the others and goes to an output aside.
    last = run(oscillator, 1.0, 0.0, 1.0, np.array([0.0, 0.97, 1.06]), method, events=half)
    np.testing.assert_allclose([last.end.t, last.end.q], [np.pi / 3, 0.5], atol=1e-9)
    single = lambda x: np.asarray(x, np.float32)
    traj = run(oscillator, single(1), single(0), single(1), single([0, 10]), method, single(0.1), events=LEVELS)
    np.testing.assert_allclose(traj.events["down"].found().t, [np.pi / 3, 7 * np.pi / 3], rtol=1e-5)


@pytest.mark.exhaustive
def test_guards_of_multipliers_and_without_sense():
    """A mass on a rod by its place, whose tension changes its sign; and a guard that is NaN, which stops nothing."""
    rod = lj.System(
        lambda t, q, v, g: 0.5 * v @ v - g * q[1], constraints={"rod": lj.Holonomic(lambda t, q, g: q @ q - 1.0)}
    )
    slack = {"slack": lj.Crossing(lambda t, q, v, multipliers, g: multipliers["rod"])}
    start = np.array([0.0, -1.0]), np.array([np.sqrt(3.5 * G), 0.0])
    for method in (lj.Gauss(4), lj.Splitting(8)):
        end = run(rod, *start, G, [0.0, 5.0], method, 0.01, events=slack).end
        # At the height y where v² = -λ-free g y, and v² = v0² - 2 g (y + 1).
        np.testing.assert_allclose(end.q[1], 0.5, rtol=1e-7)
    nan = {"nan": recorded(lambda t, q, v, k: jnp.where(t > 0.45, jnp.nan, q + 10.0))}
    with pytest.warns(UserWarning, match="crossings of event 'nan' may be missing"):
        found = run(oscillator, 1.0, 0.0, 1.0, [0.0, 5.0], lj.Splitting(4), events=nan)
    assert int(found.events["nan"].count) == 0 and bool(found.events["nan"].uncertain)
    assert int(found.stats["num_steps"]) == 50
