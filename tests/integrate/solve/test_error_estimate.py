"""Estimated errors compared with true ones: Kepler's motion, whose position is known at any time, and chaos."""

import warnings
from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

ECCENTRICITY = 0.6
kepler = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) + p["k"] / jnp.sqrt(q["x"] ** 2 + q["y"] ** 2))
near_pericentre = lj.Crossing(lambda t, q, v, p: q["y"], direction=1, terminal=False)
swing = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * (1 - jnp.cos(q)))


def exact(t, e=ECCENTRICITY):
    """Position and velocity on an orbit with k = a = 1, by Newton's method for Kepler's equation."""
    mean = np.asarray(t) % (2 * np.pi)
    anomaly = mean + e * np.sin(mean)
    for _ in range(20):
        anomaly -= (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
    b, rate = np.sqrt(1 - e**2), 1 / (1 - e * np.cos(anomaly))
    q = {"x": np.cos(anomaly) - e, "y": b * np.sin(anomaly)}
    return q, {"x": -np.sin(anomaly) * rate, "y": b * np.cos(anomaly) * rate}


def orbit(ts, e=ECCENTRICITY, **settings):
    """Some turns from the pericentre; other tests check the warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.AccuracyWarning)
        return lj.integrate(kepler, *exact(ts[0], e), {"k": 1.0}, ts=ts, **settings)


def ratios(traj, e=ECCENTRICITY):
    """Return true errors in units of the estimated ones: the largest of the coordinates, and of the velocities.

    The first outputs are left out, as they only have round-off.
    """
    found = []
    for got, true, error in zip((traj.q, traj.v), exact(np.asarray(traj.t), e), (traj.error.q, traj.error.v)):
        off = np.max([abs(got[name] - true[name]) for name in got], axis=0)
        found.append((off / np.max([error[name] for name in got], axis=0))[2:])
    return np.concatenate(found)


FEW, MANY = np.linspace(0.0, 40.0, 9), np.linspace(0.0, 20.0, 101)
CASES = {
    "default, loose": (FEW, dict(rtol=1e-5, atol=1e-5)),
    "default": (FEW, dict()),
}
OTHERS = {
    "outputs choose the steps": (MANY, dict(method=lj.Dopri8())),
    "a longest step": (FEW, dict(max_step=0.1, method=lj.Dopri8())),
    "backward": (FEW[::-1], dict(rtol=1e-7, atol=1e-7)),
    "Tsit5": (FEW, dict(method=lj.Tsit5(), rtol=1e-6, atol=1e-6)),
    "implicit": (FEW, dict(method=lj.Radau5(), rtol=1e-7, atol=1e-7)),
    "fixed steps": (FEW, dict(method=diffrax.Heun(), stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01)),
}


marked = lambda mark, *names: [pytest.param(name, marks=mark) for name in names]


@pytest.mark.parametrize(
    "name",
    [
        *CASES,
        *marked(pytest.mark.slow, "outputs choose the steps", "backward", "implicit"),
        *marked(pytest.mark.exhaustive, "a longest step", "Tsit5", "fixed steps"),
    ],
)
def test_estimated_as_they_are(name):
    """Estimates are within a factor of ten of the true errors nearly everywhere; twin: a thousandth of them is not."""
    ts, settings = (CASES | OTHERS)[name]
    found = ratios(orbit(ts, **settings))
    within = lambda x: np.mean((x > 0.1) & (x < 10.0))
    assert within(found) > 0.85 and found.max() < 20.0, found
    assert within(1e3 * found) < 0.1


@pytest.mark.slow
def test_steps_of_another_controller():
    """It is unknown how to shorten another controller's steps: there is no estimate, even if one is requested."""
    given = dict(stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9), estimate_error=True)
    found = orbit(np.array([0.0, 10.0]), **given)
    assert bool(found.error.result == lj.RESULTS.not_estimated) and np.isnan(found.error.q["x"]).all()
    assert "how to shorten the steps of its controller" in repr(found)


@pytest.mark.slow
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


def test_what_chaos_leaves():
    """A warning with coordinate, time and cause appears if no digits are left, but not if all are."""
    lagrangian = lambda t, q, v, p: (
        v["a"] ** 2
        + 0.5 * v["b"] ** 2
        + v["a"] * v["b"] * jnp.cos(q["a"] - q["b"])
        + p["g"] * (2 * jnp.cos(q["a"]) + jnp.cos(q["b"]))
    )
    double, start = lj.System(lagrangian), ({"a": 2.5, "b": 2.0}, {"a": 0.0, "b": 0.0})
    run = lambda end: lj.integrate(double, *start, {"g": 9.81}, ts=np.linspace(0.0, end, 41))
    with pytest.warns(
        lj.AccuracyWarning, match=r"the error of '(v of )?[ab]' grows .* From t = [\s\S]* amplifies errors"
    ):
        long = run(60.0)
    assert (
        long.scaled_error > 1 and long.error.q["b"][-1] > 0.3 and "has cost" in repr(long) and "WARNING" in repr(long)
    )
    short = run(1.0)
    assert short.scaled_error < 0.1 and short.error.q["b"][-1] < 1e-7 and "WARNING" not in repr(short)
    # The Jacobi integral does not reveal this error.
    assert long.drift() < 1e-7


def swung(g, **asked):
    """The swing for 20 seconds."""
    return lj.integrate(swing, 1.0, 0.0, {"g": g}, ts=np.linspace(0.0, 20.0, 5), rtol=1e-6, **asked)


def test_by_default():
    """By default the error is estimated if nothing is traced; it can be switched off; the motion is the same."""
    eager, refused = swung(9.81), swung(9.81, estimate_error=False)
    assert refused.error is None and "  error  " not in repr(refused) and "  error  " in repr(eager)
    np.testing.assert_array_equal(refused.q, eager.q)
    assert jax.eval_shape(swung, 9.81).error is None


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


@pytest.mark.slow
def test_what_cannot_be_estimated():
    """Without an estimate it is NaN, with the reason; the motion itself is kept."""
    ts = np.array([0.0, 10.0])
    steps = int(orbit(ts).stats["num_steps"])
    short = orbit(ts, max_steps=steps + 3)
    assert bool(short.error.result == lj.RESULTS.max_steps_reached) and np.isnan(short.error.q["x"][-1])
    assert bool(short.result == lj.RESULTS.successful) and np.isfinite(short.q["x"]).all()
    assert "maximum number of" in repr(short)
    long = orbit(np.array([0.0, 8e3]))
    assert int(long.stats["num_steps"]) > 20_000 and bool(long.error.result == lj.RESULTS.not_estimated)
    assert np.isnan(long.error.q["x"]).all() and "more than 20,000 steps" in repr(long)
    with pytest.raises(TypeError, match="estimate_error must be True, False or None, not 'yes'"):
        orbit(ts, estimate_error="yes")


@pytest.mark.exhaustive
def test_what_chose_the_steps():
    """Outputs, tolerance, longest step or stability are named; and the number of evaluations."""
    said = lambda traj: next(line for line in repr(traj).splitlines() if "steps chosen by" in line)
    dense = np.linspace(0.0, 2.0, 101)
    assert "the outputs" in said(lj.integrate(swing, 1.0, 0.0, {"g": 9.81}, ts=dense))
    assert "the tolerance" in said(orbit(FEW)) and "max_step" in said(orbit(FEW, max_step=0.05))
    drag = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, dissipation=lambda t, q, v, p: 0.5 * p * v**2)
    assert "stability" in said(lj.integrate(drag, 1.0, 0.0, 1e4, ts=np.array([0.0, 0.5]), method=lj.Tsit5()))
    traj = orbit(FEW, method=lj.Dopri8())
    assert f"{13 * int(traj.stats['num_steps']):,} evaluations" in repr(traj)


def test_outputs_a_round_off_apart():
    """An output a round-off after a jump does not stop the second run; twin: if it fails, the error is not known."""
    pulsed = lj.System(lambda t, q, v, p: 0.5 * v**2 + q * jnp.where((t > p["lo"]) & (t < p["hi"]), 1.0, 0.0))
    ts, params = np.array([0.0, 4.0, np.nextafter(4.1, 5.0), 10.0]), {"lo": 4.0, "hi": 4.1}
    found = lj.integrate(pulsed, 0.0, 0.0, params, ts=ts)
    # The time of a jump is resolved to several round-offs.
    assert abs(found.q[-1] - 0.595) < 1e-12 and found.error.q[-1] < 1e-12
    nothing = np.full(4, np.nan)
    failed = found.error._replace(q=nothing, v=nothing, result=lj.RESULTS.max_steps_reached)
    unknown = replace(found, error=failed)
    assert "not known: of a second, more precise motion" in repr(unknown) and "not known" not in repr(found)
