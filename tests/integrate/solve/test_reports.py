"""Estimated errors compared with true ones: Kepler's motion, whose position is known at any time, and chaos.

Reports on the integrations inside programs.
"""

import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.solve.reports import _closer, _of_times, reporting, steps_to_repeat, with_errors
from tests import by_hand
from tests.sweep.test_sweep import swing
from tests.systems import PARAMS, TS, motion, pendulum

ECCENTRICITY = 0.6
kepler = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) + p["k"] / jnp.sqrt(q["x"] ** 2 + q["y"] ** 2))
near_pericentre = lj.Crossing(lambda t, q, v, p: q["y"], direction=1, terminal=False)


def exact(t, e=ECCENTRICITY):
    """Position and velocity on an orbit with k = a = 1."""
    return [{"x": x[..., 0], "y": x[..., 1]} for x in by_hand.kepler(t, e)]


def orbit(ts, e=ECCENTRICITY, **settings):
    """Some turns from the pericentre; other tests check the warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.AccuracyWarning)
        return lj.integrate(kepler, *exact(ts[0], e), {"k": 1.0}, ts=ts, **settings)


def ratios(*pairs):
    """Return true errors in units of the estimated ones, each the largest of several numbers in one unit.

    The first outputs are left out, as they only have round-off.
    """
    largest = [[np.max(np.stack([*numbers]), axis=0)[2:] for numbers in pair] for pair in pairs]
    return np.concatenate([off / error for off, error in largest])


FEW, MANY = np.linspace(0.0, 40.0, 9), np.linspace(0.0, 20.0, 101)
RATE = np.sqrt(PARAMS["g"] / PARAMS["l"])


def check_estimates(found):
    """Within a factor of ten of the true errors nearly everywhere; twin: a thousandth of them is not."""
    within = lambda x: np.mean((x > 0.1) & (x < 10.0))
    assert within(found) > 0.85 and found.max() < 20.0, found
    assert within(1e3 * found) < 0.1


@pytest.mark.parametrize("rtol", [None, 1e-5])
def test_estimated_as_they_are(rtol):
    """Estimates are about the true errors of a pendulum, small and wide, over seven to nine periods."""
    found = []
    for amplitude in (0.5, 1.0, 1.5, 2.0, 2.5):
        ts = np.linspace(0.0, 20.0, 8)
        traj = lj.integrate(pendulum, amplitude, 0.0, PARAMS, ts=ts, rtol=rtol)
        q, v = by_hand.swing(ts, amplitude, RATE)
        off = abs(traj.q - q), abs(traj.v - v) / RATE
        found.append(ratios((off, (traj.error.q, traj.error.v / RATE))))
    check_estimates(np.concatenate(found))


def test_what_is_not_estimated():
    """Steps of another controller, which cannot be shortened, and more steps than are repeated: NaN, and why."""
    first, limit = motion("pendulum"), np.asarray(20_000)
    pid = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    for controller, most in ((pid, limit), (diffrax.ConstantStepSize(), limit), (None, np.asarray(1))):
        settings = SimpleNamespace(controller=controller, dt0=None, repeated_up_to=most)
        found = with_errors(None, first, settings, TS)
        assert bool(found.error.result == lj.RESULTS.not_estimated) and np.isnan(found.error.q).all()
        assert found.q is first.q
    assert "more than 20,000 steps" in repr(found) and "how to shorten the steps of its controller" in repr(found)


@dataclass
class SettingsLike:
    """What a second run changes."""

    controller: Any
    rtol: Any
    atol: Any
    max_step: Any
    dt0: Any = None
    shares: Any = None


def test_the_second_run():
    """Ten times tighter, or looser at round-off; one step more to an output; half of fixed steps and of `max_step`."""
    given = SettingsLike(controller=None, rtol=np.full(2, 1e-9), atol=np.full(2, 1e-6), max_step=np.asarray(np.inf))
    closer = lambda steps=100, **changes: _closer(np, replace(given, **changes), steps, np.asarray(1.0), TS)
    usual = closer()
    np.testing.assert_allclose([usual.rtol[0], usual.atol[0], *usual.shares], [1e-10, 1e-7, 0.7, 1 / 3])
    np.testing.assert_allclose([closer(rtol=np.full(2, 1e-15)).rtol[0], usual.max_step], [1e-14, np.inf])
    # Three outputs after the start in five steps: up to two steps each, and so three.
    np.testing.assert_allclose(closer(5).shares[1], 1 / 3)
    np.testing.assert_allclose([closer(max_step=np.asarray(x)).max_step for x in (0.012, 0.5)], [0.006, 0.5])
    fixed = replace(given, controller=diffrax.ConstantStepSize(), dt0=0.5)
    assert _closer(np, fixed, 100, np.asarray(1.0), TS).dt0 == 0.25


def test_times_of_crossings():
    """The difference of both runs and round-off; infinite for what the second does not find."""
    first, second = np.array([1.0, 2.0, 4.0, np.nan]), np.array([1.0 + 1e-9, np.nan, 4.0, np.nan])
    np.testing.assert_allclose(_of_times(np, first, second, 1e-12), [1.001e-9, np.inf, 4e-12, np.nan], rtol=1e-6)


@pytest.mark.exhaustive
def test_times_of_events():
    """Each crossing's time has an error estimate."""
    traj = orbit(np.array([0.0, 40.0]), rtol=1e-7, atol=1e-7, events={"up": near_pericentre})
    found = traj.events["up"]
    turns = 2 * np.pi * np.arange(1, int(found.count) + 1)
    off, error = abs(np.asarray(found.t)[: len(turns)] - turns), traj.error.events["up"]
    assert len(turns) == 6 and np.isnan(error[6:]).all()
    np.testing.assert_array_less(off, 10 * error[:6])
    np.testing.assert_array_less(error[:6], 100 * off)
    assert "error of 'up'" in repr(traj)


def test_what_the_top_of_a_hill_leaves():
    """A pendulum that comes to rest on its top loses its digits there: a warning with coordinate, time and cause.

    Twins: after a short time none are lost; with two outputs it is not known where, and causes are called possible.
    """
    run = lambda end, count: lj.integrate(pendulum, 0.0, 2 * RATE, PARAMS, ts=np.linspace(0.0, end, count))
    words = r"the error of '(v of )?q' grows .* From t = [\s\S]* Cause: the motion itself amplifies errors, here"
    with pytest.warns(lj.AccuracyWarning, match=words.replace(" Cause", "\nCause")):
        long = run(12.0, 8)
    assert long.scaled_error > 1 and long.error.q[-1] > 0.3 and "has cost" in repr(long) and "WARNING" in repr(long)
    with pytest.warns(lj.AccuracyWarning, match="between t = 0 and 12 .* possible causes: the motion amplifies errors"):
        run(12.0, 2)
    short = run(1.0, 8)
    assert short.scaled_error < 0.1 and short.error.q[-1] < 1e-7 and "WARNING" not in repr(short)
    # The Jacobi integral does not reveal this error.
    assert long.drift() < 1e-7


def swung(g, **asked):
    """The swing for 20 seconds."""
    return lj.integrate(pendulum, 1.0, 0.0, {"g": g, "l": 1.0}, ts=np.linspace(0.0, 20.0, 5), rtol=1e-6, **asked)


def test_by_default():
    """By default the error is estimated if nothing is traced; it can be switched off; the motion is the same."""
    eager, refused = swung(9.81), swung(9.81, estimate_error=False)
    assert refused.error is None and "  error  " not in repr(refused) and "  error  " in repr(eager)
    np.testing.assert_array_equal(refused.q, eager.q)
    asked = {None: 20_000, True: 2**31 - 1, False: 0}
    assert {asked: int(steps_to_repeat(asked, None, False)) for asked in asked} == asked
    # Neither in a program, nor by another controller, nor where the user watches.
    assert "0:i32[]" in str(jax.make_jaxpr(lambda x: steps_to_repeat(None, None, False))(0.0))
    pid = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    assert not steps_to_repeat(None, pid, False) and not steps_to_repeat(None, None, True)
    with pytest.raises(TypeError, match="estimate_error must be True, False or None, not 'yes'"):
        steps_to_repeat("yes", None, False)


@pytest.mark.exhaustive
def test_when_asked():
    """Requested in a program or a batch, the estimate is the same; derivatives are only those of the motion."""
    inside = jax.jit(lambda g: swung(g, estimate_error=True))
    close = lambda found: np.testing.assert_allclose(found, swung(9.81).error.q, rtol=0.3)
    close(inside(9.81).error.q)
    close(jax.vmap(inside)(jnp.array([9.81, 5.0])).error.q[0])
    slope = lambda asked: jax.grad(lambda g: swung(g, estimate_error=asked).q[-1])(9.81)
    assert slope(True) == slope(None)
    assert jax.jacfwd(lambda g: swung(g, estimate_error=True).error.q[-1])(9.81) == 0.0


@pytest.mark.exhaustive
def test_what_chose_the_steps():
    """Outputs, tolerance, longest step or stability are named; and the number of evaluations."""
    said = lambda traj: next(line for line in repr(traj).splitlines() if "steps chosen by" in line)
    dense = np.linspace(0.0, 2.0, 101)
    assert "the outputs" in said(lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=dense))
    assert "the tolerance" in said(orbit(FEW)) and "max_step" in said(orbit(FEW, max_step=0.05))
    drag = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, dissipation=lambda t, q, v, p: 0.5 * p * v**2)
    assert "stability" in said(lj.integrate(drag, 1.0, 0.0, 1e4, ts=np.array([0.0, 0.5]), method=lj.Tsit5()))
    traj = orbit(FEW, method=lj.Dopri8())
    assert f"{13 * int(traj.stats['num_steps']):,} evaluations" in repr(traj)


def test_an_error_that_is_not_known():
    """If the second run fails it says so; twin: as it was."""
    found = motion("pendulum")
    nothing = np.full(4, np.nan)
    failed = found.error._replace(q=nothing, v=nothing, result=lj.RESULTS.max_steps_reached)
    assert "not known: of a second, more precise motion" in repr(replace(found, error=failed))
    assert "not known" not in repr(found)


@pytest.mark.exhaustive
def test_reports_are_found_in_every_kind_of_program():
    """Reports are found in plain, jitted, differentiated and batched programs; the worst of several counts."""
    program = lambda wrap: jax.jit(reporting(lambda point: wrap(lambda g: swing({"g": g, "angle": 1.0}).q[-1])(point)))
    _, alone, _ = program(lambda f: f)(4.0)
    assert int(alone.steps) > 0
    for wrap in (jax.jit, jax.grad, lambda f: jax.jit(jax.jit(f)), jax.value_and_grad):
        assert int(program(wrap)(4.0)[1].steps) == int(alone.steps)
    twice = program(lambda f: lambda g: f(g) + f(g))(4.0)[1]
    assert int(twice.steps) == 2 * int(alone.steps)
    some = program(lambda f: lambda g: jax.vmap(f)(jnp.array([g, jnp.nan])))(4.0)[1]
    assert int(some.result) == int(lj.RESULTS.start_not_finite._value)
    assert jax.jit(reporting(lambda x: 2 * x))(1.0)[1] is None
