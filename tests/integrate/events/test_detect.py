"""Crossings as ends of steps: each once, also from a start on the guard, at the last time, by any method."""

import warnings

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.events.test_event import EVENTS, SPRING, doubt, fall, oscillator, plant, swing, times
from tests.tiers import exhaustive_but


def test_the_first_of_two_crossings_in_a_step_ends_the_motion():
    """q = sin t passes 0.9 at arcsin 0.9 and comes back within a step; outputs are NaN from there on."""
    falling = SPRING | {"by_q": -1.0, "by_v": 0.0, "level": 0.95, "stop": -0.9}
    traj = lj.integrate(plant, 0.0, 1.0, falling, ts=[0.0, 1.0, 1.2], events=EVENTS, rtol=1e-9, atol=1e-9)
    assert float(traj.end.t) == pytest.approx(np.arcsin(0.9), abs=1e-9)
    assert np.isfinite(traj.q).tolist() == [True, True, False]
    assert len(times(traj)) == 0


@pytest.mark.slow
def test_an_event_of_diffrax():
    """The same by a `diffrax.Event`, with many outputs."""
    level = diffrax.Event(lambda t, y, p, **kwargs: y[0] - 0.9)
    ts = np.linspace(0.0, 20.0, 401)
    traj = lj.integrate(oscillator, 0.0, 1.0, ts=ts, event=level)
    assert float(traj.end.t) == pytest.approx(np.arcsin(0.9), abs=1e-9)
    assert np.array_equal(np.isfinite(traj.q), ts <= np.arcsin(0.9))
    assert traj.events["event"].found().t.shape == (1,)


def test_a_start_on_the_guard_does_not_fire():
    """A start within round-off of the guard, or at a top, is no crossing; coming back through the guard is one."""
    for hair in (0.0, 1e-16, -1e-16, 1e-15, -1e-15):
        traj = swing(0.5 * (1 + hair), np.sqrt(0.75), 0.5, [0.0, 3.0, 6.5])
        np.testing.assert_allclose(times(traj), [2 * np.pi / 3, 2 * np.pi], atol=1e-8)
        np.testing.assert_allclose(times(traj, "up"), [2 * np.pi], atol=1e-8)
        assert len(times(swing(1.0 + hair, 0.0, 1.0, [0.0, 3.0, 6.0]))) == 0
    with doubt:
        swing(1.0, 0.0, 1.0, [0.0, 3.0, 7.0])
    # Twin: a start that is off by more lies before the guard and crosses it.
    assert len(times(swing(0.5 * (1 - 1e-9), np.sqrt(0.75), 0.5, [0.0, 3.0, 6.5]))) == 3


SAID = {
    "zero": lambda t, q, v, p: 0.0 * q,
    "conserved": lambda t, q, v, p: 0.5 * v**2 + 0.5 * q**2 - 0.5,
    "a touch": lambda t, q, v, p: q - 1.0,
    "a square": lambda t, q, v, p: (q - 0.5) ** 2,
    "not a number": lambda t, q, v, p: jnp.sqrt(q - 0.5),
    "far above": lambda t, q, v, p: jnp.sin(3e3 * t),
    "by the state": lambda t, q, v, p: jnp.sin(1e3 * q) + 0.5,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(("a touch", "by the state"), SAID))
def test_found_or_said(name):
    """Crossings that cannot be resolved are either found after all, or a warning is given."""
    exact = {"far above": 3e3 * 6 // np.pi}.get(name)
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        traj = lj.integrate(
            oscillator, 0.0, 1.0, ts=[0.0, 6.0], events={"guard": lj.Crossing(SAID[name], terminal=False)}
        )
    found = traj.events["guard"]
    said = bool(found.uncertain)
    assert said == any("may be missing" in str(warning.message) for warning in raised)
    if name == "by the state":
        t = np.linspace(0.0, 6.0, 10**6)
        exact = np.count_nonzero(np.diff(np.sign(np.sin(1e3 * np.sin(t)) + 0.5)))
    assert said or int(found.count) == exact, found


OPTIONS = {
    "fixed steps": {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.2},
    "a controller": {"stepsize_controller": diffrax.PIDController(rtol=1e-8, atol=1e-8, pcoeff=0.2, icoeff=0.4)},
    "Tsit5": {"method": lj.Tsit5()},
    "Radau5": {"method": lj.Radau5()},
    "diffrax": {"method": diffrax.Dopri5()},
    "implicit": {"method": diffrax.Kvaerno5()},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(("Radau5",), OPTIONS))
def test_methods_and_controllers(name):
    """Any method or controller finds two crossings near the top, and then the one that ends the motion."""
    traj = swing(0.0, 1.0, 0.9999, [0.0, 1.2, 12.0], np.cos(2.5), rtol=1e-8, **OPTIONS[name])
    top = np.arcsin(0.9999)
    np.testing.assert_allclose(times(traj), [top, np.pi - top], atol=2e-5)
    np.testing.assert_allclose(traj.end.t, 2.5, atol=1e-6)
    assert np.isfinite(traj.q).tolist() == [True, True, False]


@pytest.mark.parametrize("level", [0.0, 1e-15, -1e-15, 1e-14, 1e-12, -1e-11])
def test_at_the_last_time(level):
    """A crossing at `ts[-1]` is found once, there or when continuing from there: q = 5 (1 - t²) is zero at 1."""
    first = fall(5.0, 0.0, [0.0, 0.5, 1.0], level)
    found, end = int(first.events["stop"].count), first.end
    if not found:
        found = int(fall(end.q, end.v, [1.0, 1.5, 2.0], level).events["stop"].count)
    assert found == 1
    assert float(fall(5.0, 0.0, [0.0, 0.5, 2.0], level).end.t) == pytest.approx(np.sqrt(1.0 - level / 5.0), abs=1e-14)
