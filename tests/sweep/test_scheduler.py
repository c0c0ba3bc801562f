"""Points that need a call of their own: long lanes, and those at which a callback of the user's raises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import Report, reported
from lagjax.integrate.solve.reports import Settled
from lagjax.sweep import engine
from tests.sweep.small_stores import scaled
from tests.sweep.test_sweep import AXES, MAX_STEPS, quiet, swing
from tests.systems import motion

free = lj.System(lambda t, q, v, p: 0.5 * v**2 + p["k"] * q)


def table(x):
    """A look-up that refuses what is above 0.75."""
    if np.any(np.asarray(x) > 0.75):
        raise ValueError("outside of the table")
    return np.asarray(2.0 * x)


def looked_up(x):
    """The same inside a program."""
    return jax.pure_callback(table, jax.ShapeDtypeStruct((), jnp.result_type(float)), x, vmap_method="sequential")


def settled(x):
    """What a motion of regular equations reports, as `integrate` does."""
    report = Report(lj.RESULTS.successful._value, jnp.asarray(3), jnp.asarray(0.0), jnp.asarray(0.0))
    return reported(reported(x, lambda _: report), lambda _: Settled(jnp.asarray(True)))


def moved(point):
    """x² for force 2 x over one unit of time is x."""
    traj = lj.integrate(free, 0.0, 0.0, {"k": looked_up(point["x"])}, ts=np.array([0.0, 1.0]))
    return traj.q[-1]


@pytest.mark.parametrize("run", [lambda point: settled(looked_up(point["x"]) / 2),
                                 pytest.param(moved, marks=pytest.mark.exhaustive)])  # fmt: skip
@pytest.mark.parametrize("workers", [1, 2])
def test_the_rest_keeps_its_results(workers, run):
    """Points where a callback raises are NaN, one is named, and the others have their values."""
    xs = np.linspace(0.0, 1.0, 41)
    with pytest.warns(UserWarning, match="at x = .* raised: .*outside of the table"):
        swept = lj.sweep(run, {"x": xs}, workers=workers, chunk=16, progress=False)
    good = xs <= 0.75
    np.testing.assert_allclose(swept.values[good], xs[good], rtol=1e-9)
    assert np.isnan(swept.values[~good]).all()
    assert swept.counts() == {"successful": 31, "A function that is called in Python, by a callback, raised an "
                              "exception.": 10}  # fmt: skip


def test_a_trajectory_knows():
    """Where whole trajectories are returned, that of the point has the reason as its result."""
    traj = motion("pendulum")
    run = lambda point: scaled(traj, looked_up(point["x"]))
    with pytest.warns(UserWarning, match="outside of the table"):
        swept = lj.sweep(run, {"x": np.array([0.5, 1.0])}, progress=False)
    assert np.isnan(swept.values.q[1]).all()
    np.testing.assert_array_equal(swept.values.q[0], traj.q)
    results = np.asarray(swept.values.result._value)
    assert results.tolist() == [lj.RESULTS.successful._value, lj.RESULTS.raised._value]


@pytest.mark.exhaustive
def test_long_lanes_are_run_alone(monkeypatch):
    """Other lanes do not wait for them; lanes that hit the user's own step limit are not run again."""
    monkeypatch.setattr(engine, "STEPS_TOGETHER", 30)
    run = lambda limit: jax.jit(lambda point: swing(point, max_steps=limit).q[-1])
    alone = run(2**16)
    swept = quiet(alone)
    assert swept.ok.all() and 0 < np.sum(swept.status.steps > 30) < 10
    # A function jitted by the user and traced in the sweep has no step limit outside the sweep.
    for i, j in np.argwhere(swept.status.steps > 30):
        np.testing.assert_allclose(
            swept.values[i, j], alone({"g": AXES["g"][i], "angle": AXES["angle"][j]}), rtol=1e-14
        )
    few = quiet(run(28))
    assert few.status.steps.max() == 28 and np.any(few.status.result == MAX_STEPS)
