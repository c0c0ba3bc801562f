"""What a fit finds, and what it says about what it cannot find."""

from importlib import import_module
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import lagjax as lj
from lagjax.fit.result import caveats
from lagjax.scenes import rolling_hoop
from tests import systems
from tests.counting import compiles
from tests.fit.cases import CASES, FREE, GUESS, HUNG, PENDULUM, TS, hung, noisy, pendulum, swing, swung

# The room hands out a function of this name.
engine = import_module("lagjax.fit.fit")


def measured(q, guess=GUESS, **more):
    """A fit of friction and length that shows its steps; all such fits share one program."""
    return lj.fit(pendulum, lj.Record(TS[: len(q)], q=q), guess, free=FREE, progress=True, **more)


def test_finds_parameters_and_start(swinging, capsys):
    """Without errors or a guess of the start: parameters and start to 1e-8. The fit shows its steps."""
    found = measured(swinging[0])
    shown = capsys.readouterr().err
    assert f"{int(found.steps)} steps" in shown and "stage 3 of 3, cost" in shown
    assert bool(found.converged) and found.names == ("c", "l")
    np.testing.assert_allclose(found.values, [0.05, 1.25], rtol=1e-8)
    np.testing.assert_allclose([found.q0[0], found.v0[0]], [1.0, 0.0], atol=1e-8)
    assert found.params["l"] == found.values[1] and found.params["m"] == 1.0
    # Twin: what the system leaves out does not fit, and no residuals are white; and steps are shown only if wanted.
    with pytest.warns(lj.FitWarning, match="residuals of 'q' are not measurement errors"):
        stuck = measured(swinging[0] + 0.1 * np.sin(9 * TS))
    assert stuck.rms()["q"] > 5e-2 and not bool(stuck.converged) and stuck.result == lj.RESULTS.misfit
    assert "NOT white" in repr(stuck) and stuck.whiteness()["q"] > 0.5 and np.all(np.isfinite(stuck.costs))
    course = engine._course(found.problem, True, False, np.zeros((0, 2)), False)
    with engine._step_meter(found.problem, course, False) as tell:
        assert not tell


@pytest.mark.slow
def test_the_curve_goes_across_gaps():
    """Without samples in the middle, as NaN or left out, the curve is the motion there; twin: not the chord."""
    ts = np.linspace(0.0, 6.0, 61)
    system, params = systems.pendulum, systems.PARAMS
    q = np.array(lj.integrate(system, 1.0, 0.0, params, ts=ts).q)
    missing, full = (ts > 2.0) & (ts < 4.0), q.copy()
    q[missing] = np.nan
    for record in (lj.Record(ts, q=q), lj.Record(ts[~missing], q=q[~missing])):
        found = lj.fit(system, record, params | {"g": 9.0}, free="g", progress=False)
        _, line, *_ = found.plot().axes[0].lines
        t, drawn = np.asarray(line.get_data())[:, :-1]
        np.testing.assert_allclose(np.interp(ts, t, drawn)[missing], full[missing], atol=1e-3)
    assert np.max(np.abs(np.interp(ts, ts[~missing], full[~missing]) - full)) > 0.5


def test_prints_and_plots(swinging, monkeypatch):
    """The table has estimates with uncertainties in the user's units; the figure has one row per channel."""
    data = noisy(swinging[0])
    found = measured(data, units={"l": "m"})
    lines = repr(found).splitlines()
    assert lines[0].startswith("Fit: converged")
    assert any(line.split()[:1] == ["l"] and "±" in line and line.endswith("m") for line in lines)
    assert "96 degrees of freedom" in repr(found) and "NOT white" not in repr(found)
    assert abs(found.whiteness()["q"]) < 0.3 and found.rms()["q"] == pytest.approx(0.01, rel=0.2)
    assert len(found.plot().axes) == 2
    # Its motion starts where the fit does, at the record's times.
    monkeypatch.setattr(import_module("lagjax.fit.result"), "integrate", lambda *state, ts, throw: (*state, ts))
    system, q0, v0, params, ts = cast(tuple, found.motion())
    assert (system, q0, v0) == (pendulum, found.q0[0], found.v0[0]) and params == found.params
    np.testing.assert_array_equal(ts, TS)


def test_called_again_it_compiles_nothing(swinging):
    """A second fit compiles nothing, even with fewer samples, another guess or other data; padding does not count.

    Printing compiles nothing, either, except one program for the starts and their slopes the first time.
    """
    found = measured(swinging[0])
    with compiles() as programs:
        repr(found)
    assert len(programs) <= 1
    with compiles() as programs:
        again = {n: measured(swinging[0][:n], GUESS | {"l": 1.5 - n / 1000}) for n in (100, 97)}
        assert all("freedom" in repr(found) and len(found.plot().axes) == 2 for found in again.values())
    assert programs == []
    for n, found in again.items():
        assert bool(found.converged) and found.residuals()["q"].shape == (n,) and float(found.freedom) == n - 4
        np.testing.assert_allclose(found.values, [0.05, 1.25], rtol=1e-8)
    # Twin: a compilation is counted.
    with compiles() as programs:
        jax.jit(lambda x: x + np.pi)(1.0)
    assert len(programs) == 1


@pytest.mark.exhaustive
def test_against_scipy(swinging):
    """Estimates and covariance agree with SciPy's least squares with numerical slopes, and with other optimisers."""
    data = noisy(swinging[0])
    found = lj.fit(pendulum, lj.Record(TS, q=data, sigma=0.01), GUESS, free=FREE, bounds={"l": (0.0, None)})
    solve = jax.jit(
        lambda x: lj.integrate(pendulum, x[2], x[3], PENDULUM | {"c": x[0], "l": x[1]}, ts=TS, throw=False).q
    )
    theirs = least_squares(
        lambda x: (np.asarray(solve(x)) - data) / 0.01, [0.1, 1.3, 1.0, 0.0], x_scale=[0.1, 1, 1, 1], xtol=1e-12,
        ftol=1e-12,
    )  # fmt: skip
    ours = np.array([*found.values, found.q0[0], found.v0[0]])
    np.testing.assert_allclose(ours, theirs.x, atol=1e-6)
    covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)
    np.testing.assert_allclose(found.covariance, covariance[:2, :2], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(float(found.start_sd[0][0]), np.sqrt(covariance[2, 2]), rtol=1e-3)
    np.testing.assert_allclose(found.chi2, 2 * theirs.cost, rtol=1e-8)
    assert abs(float(found.correlation[0, 1])) < 1 and float(found.correlation[1, 1]) == pytest.approx(1)
    assert int(found.freedom) == 96
    # Another least-squares solver, and a minimiser with reverse-mode derivatives, end at the same point.
    again = lambda optimiser, **more: lj.fit(
        pendulum, lj.Record(TS, q=data, sigma=0.01), GUESS, free=FREE, optimiser=optimiser, **more
    )
    dogleg, bfgs = again(optx.Dogleg(rtol=1e-9, atol=1e-9)), again(optx.BFGS(rtol=1e-6, atol=1e-6), iterations=300)
    np.testing.assert_allclose(dogleg.values, found.values, rtol=1e-5)
    np.testing.assert_allclose(bfgs.values, found.values, rtol=1e-3)
    np.testing.assert_allclose(bfgs.sd, found.sd, rtol=1e-2)
    # Without sigma, errors estimated from the residuals give nearly the same. Residuals: what is left to the motion.
    alone = lj.fit(pendulum, lj.Record(TS, q=data), GUESS, free=FREE, bounds={"l": (0.0, None)})
    np.testing.assert_allclose(alone.values, found.values, rtol=1e-6)
    np.testing.assert_allclose(float(alone.noise), np.sqrt(float(found.chi2) / 96) * 0.01, rtol=1e-4)
    np.testing.assert_allclose(alone.motion().q, data + alone.residuals()["q"], atol=1e-8)


@pytest.mark.slow
def test_gaps_and_several_runs(swinging):
    """Only missing values are left out; another run may have its own start, length and mass."""
    angle = swinging[0].copy()
    angle[10:20] = np.nan
    other = swung(TS[:60], -0.4, 1.0, PENDULUM | {"m": 2.0})[0]
    records = [lj.Record(TS, q=angle), lj.Record(TS[:60], q=other, params={"m": 2.0})]
    found = lj.fit(pendulum, records, GUESS, free=FREE)
    np.testing.assert_allclose(found.values, [0.05, 1.25], rtol=1e-8)
    np.testing.assert_allclose(np.array(found.q0), [1.0, -0.4], atol=1e-8)
    assert int(found.freedom) == 90 + 60 - 6
    residuals = found.residuals(0)["q"]
    assert residuals.shape == (100,) and np.isnan(residuals[10:20]).all() and np.isfinite(residuals).sum() == 90
    assert "record 1" in repr(found)
    # Twin: with another mass of the other run it does not fit.
    wrong = lj.fit(pendulum, [records[0], lj.Record(TS[:60], q=other, params={"m": 1.0})], GUESS, free=FREE)
    assert wrong.rms()["q"] > 1e-3


@pytest.mark.exhaustive
def test_a_start_on_constraints_is_as_uncertain_as_they_are():
    """A bob released at the rod's side is as uncertain as the rod's length; the angle gives exactly the same."""
    case = CASES["pendulum on a rod"]
    data = case.noisy({"q": case.truth().q}, jax.random.key(1))["q"]
    # Only a guess of y is given, which is off the rod.
    record = lj.Record(case.ts, q={"x": data["x"]}, q0={"x": 1.9, "y": 0.1}, sigma=0.02)
    found = lj.fit(hung, record, HUNG | {"l": 2.1}, free=["g", "l"])
    (q_sd,), (v_sd,) = found.start_sd
    x = lambda t, q, v, params: params["l"] * jnp.sin(q)
    swung = lj.Record(case.ts, observed=data["x"], q0=1.4, v0=0.0, sigma=0.02)
    angle = lj.fit(lj.System(swing), swung, {"m": 1.5, "g": 9.81, "l": 2.1}, free=["g", "l"], observe=x)
    np.testing.assert_allclose(found.values, angle.values, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, angle.covariance, rtol=1e-3, atol=1e-9)
    of = angle.evaluation.covariance
    joint = np.block([[of.shared, of.local_shared[0].T], [of.local_shared[0], of.local[0]]])
    state = lambda l, q, v: jnp.stack([l * jnp.sin(q), -l * jnp.cos(q), l * jnp.cos(q) * v, l * jnp.sin(q) * v])
    slope = jnp.stack(jax.jacfwd(state, (0, 1, 2))(angle.values[1], angle.q0[0], angle.v0[0]), axis=1)
    slope = np.concatenate([np.zeros((4, 1)), slope], axis=1)
    expected = np.sqrt(np.diag(slope @ joint @ slope.T))
    np.testing.assert_allclose([q_sd["x"], q_sd["y"], v_sd["x"], v_sd["y"]], expected, rtol=1e-2)
    # Twin: if the length were known, so would be the distance.
    slope[:, 1] = 0
    assert np.sqrt(slope[0] @ joint @ slope[0]) < 0.2 * expected[0]


@pytest.mark.exhaustive
def test_observation_velocity_and_end():
    """Fits to observed positions, to velocities and to a time of departure find what these determine."""
    measured = lambda t, q, v, params: {"x": params["l"] * jnp.sin(q), "y": -params["l"] * jnp.cos(q)}
    traj = lj.integrate(pendulum, 1.0, 0.0, PENDULUM, ts=TS)
    seen = jax.vmap(lambda t, q, v: measured(t, q, v, PENDULUM))(traj.t, traj.q, traj.v)
    record = lj.Record(TS, observed=seen, q0=0.9, v0=0.1)
    found = lj.fit(pendulum, record, GUESS, free=["c", "g", "l"], observe=measured)
    np.testing.assert_allclose(found.values, [0.05, 9.81, 1.25], rtol=1e-8)
    record = lj.Record(TS, v=traj.v, q0=0.9, v0=0.0, hold_v=True)
    found = lj.fit(pendulum, record, GUESS, free=FREE)
    np.testing.assert_allclose(found.values, [0.05, 1.25], rtol=1e-8)
    assert float(found.v0[0]) == 0.0 and float(found.start_sd[1][0]) == 0.0

    q0, v0 = rolling_hoop.start(rolling_hoop.PARAMS, 1.3)
    until = np.array([0.0, 3.0])
    left = lj.integrate(rolling_hoop.system, q0, v0, rolling_hoop.PARAMS, ts=until, events=rolling_hoop.DEPARTURE)
    record = lj.Record(until, end={"t": left.end.t}, q0=q0, v0=v0, hold_q=True, hold_v=True, sigma=1e-3)
    guess = rolling_hoop.PARAMS | {"g": 8.0}
    found = lj.fit(rolling_hoop.system, record, guess, free="g", events=rolling_hoop.DEPARTURE)
    np.testing.assert_allclose(found.values, [rolling_hoop.PARAMS["g"]], rtol=1e-8)
    # The time scales as 1/sqrt(g): its slope is -t/2g, and so is the uncertainty.
    np.testing.assert_allclose(found.sd, 1e-3 * 2 * rolling_hoop.PARAMS["g"] / float(left.end.t), rtol=1e-6)


@pytest.mark.exhaustive
def test_a_long_record_wants_a_growing_horizon():
    """A fit of 27 periods at once ends in a wrong minimum; growing parts and joined windows do not."""
    ts = np.linspace(0.0, 60.0, 1500)
    known = PENDULUM | {"c": 0.01}
    truth = lj.integrate(pendulum, 1.0, 0.0, known, ts=ts)
    record = lj.Record(ts, q=noisy(np.asarray(truth.q)))
    fit = lambda guess, **more: lj.fit(pendulum, record, known | {"l": guess}, free="l", **more)
    found = fit(0.9)
    np.testing.assert_allclose(found.values, [1.25], rtol=1e-3)
    joined = fit(0.9, window=5.0)
    np.testing.assert_allclose(joined.values, found.values, rtol=1e-5)
    np.testing.assert_allclose(joined.sd, found.sd, rtol=0.02)
    assert joined.freedom == found.freedom
    # Twin: at once and without restarts the search fails.
    with pytest.warns(lj.FitWarning, match="residuals of 'q' are not measurement errors"):
        lost = fit(0.9, grow=False, restarts=0)
    assert lost.rms()["q"] > 0.1


@pytest.mark.exhaustive
def test_outliers_priors_and_bounds(swinging):
    """A robust loss tolerates outliers; a prior counts as a measurement; a reached bound is named."""
    data = noisy(swinging[0])
    wild = data.copy()
    wild[::10] += 1.5
    record = lambda x: lj.Record(TS, q=x, q0=1.0, v0=0.0, sigma=0.01)
    fit = lambda x, **more: lj.fit(pendulum, record(x), GUESS, free=FREE, **more)
    clean, robust = fit(data), fit(wild, loss="cauchy")
    with pytest.warns(lj.FitWarning, match="times as large as sigma says"):
        plain = fit(wild)
    off = lambda found: np.max(np.abs(found.values - clean.values) / clean.sd)
    assert off(plain) > 10 and off(robust) < 2
    assert np.all(robust.sd > clean.sd) and np.all(robust.sd < 2 * clean.sd)
    astray = eqx.tree_at(lambda found: found.unknowns.shared, clean, jnp.array([0.05, 1e9]))
    assert "'l' was guessed to be 1.4, and ended at 1e+09" in caveats(astray)[0] and not caveats(clean)

    known = fit(data, priors={"l": (1.248, 0.0005)})
    weights = np.array([1 / clean.sd[1] ** 2, 1 / 0.0005**2])
    expected = np.average([clean.values[1], 1.248], weights=weights)
    assert float(known.values[1]) == pytest.approx(expected, abs=2e-5)
    assert abs(float(clean.values[1]) - expected) > 2e-4
    assert float(known.sd[1]) < 0.0005
    with pytest.warns(lj.FitWarning) as told:
        held = fit(data, bounds={"l": (1.3, 2.0)})
    assert any("'l' ended at a bound" in str(warning.message) for warning in told)
    assert float(held.values[1]) == pytest.approx(1.3, abs=1e-5) and held.at_bounds() == ["l"]


@pytest.mark.exhaustive
def test_a_fit_sees_what_has_changed():
    """A fit uses the current value of a number that L reads from outside: w² = k times that number."""
    strength, t = np.array([1.0]), np.linspace(0.0, 4.0, 30)
    spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * strength[0] * params["k"] * q**2)
    of = lambda: lj.fit(spring, lj.Record(t, q=np.cos(2.0 * t)), {"k": 3.0}).values[0]
    np.testing.assert_allclose(of(), 4.0, rtol=1e-7)
    strength[0] = 2.0
    np.testing.assert_allclose(of(), 2.0, rtol=1e-7)
