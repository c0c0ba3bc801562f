"""Sweeps compared with loops: values, gradients, steps, statuses; printing, plotting and exporting."""

from importlib import import_module

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display.terminal import Silent
from lagjax.integrate import Report, reported
from tests.sweep.small_stores import scaled
from tests.systems import motion

pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
rod = lj.System(
    lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"],
    {"rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - 1.0)},
)
TS = np.linspace(0.0, 6.0, 4)
AXES = {"g": np.array([1.0, 4.0, 9.0]), "angle": np.linspace(0.2, 2.8, 7)}
OK, MAX_STEPS = int(lj.RESULTS.successful._value), int(lj.RESULTS.max_steps_reached._value)


def swing(point, **settings):
    """A pendulum released at rest."""
    return lj.integrate(pendulum, point["angle"], 0.0, {"g": point["g"]}, ts=TS, **settings)


def quiet(run, axes=AXES, **settings):
    """A sweep without a progress bar."""
    return lj.sweep(run, axes, progress=False, **settings)


def slope(point):
    """The derivative of the last angle with respect to g, in a nested jit."""
    return jax.jit(jax.grad(lambda g: swing({"g": g, "angle": point["angle"]}).q[-1]))(point["g"])


def final_angle_and_slope(point):
    """Three values by name."""
    traj = swing(point)
    return {"angle": traj.q[-1], "slope": slope(point), "steps": traj.stats["num_steps"]}


def assert_same(found, expected, rtol, atol):
    """Compare values and gradients."""
    for name in ("angle", "slope"):
        np.testing.assert_allclose(found[name], expected[name], rtol=rtol, atol=atol)


@pytest.mark.exhaustive
def test_same_as_vmap_and_whoever_is_beside():
    """Steps are the same as under `jax.vmap`, in other chunks, sorted, and in another order of lanes."""
    swept = quiet(final_angle_and_slope)
    of_g = lambda g: jax.vmap(lambda angle: final_angle_and_slope({"g": g, "angle": angle}))(AXES["angle"])
    others = [
        jax.jit(jax.vmap(of_g))(AXES["g"]),
        quiet(final_angle_and_slope, chunk=5, sort=True).values,
        jax.tree.map(lambda x: x[::-1], quiet(final_angle_and_slope, AXES | {"g": AXES["g"][::-1]}).values),
    ]
    for other in others:
        np.testing.assert_array_equal(swept.values["steps"], other["steps"])
        assert_same(swept.values, other, 1e-10, 1e-12)


@pytest.mark.exhaustive
def test_a_lane_that_fails_keeps_its_reason():
    """A failed lane is NaN and does not affect the others; running it again with other settings fills it in."""
    few = quiet(lambda point: swing(point, max_steps=22).q[-1])
    failed = few.status.result == MAX_STEPS
    assert 0 < failed.sum() < failed.size and set(np.unique(few.status.result)) == {OK, MAX_STEPS}
    assert np.array_equal(np.isnan(few.values), failed) and np.array_equal(few.ok, ~failed)
    enough = quiet(lambda point: swing(point).q[-1])
    np.testing.assert_array_equal(few.values[few.ok], enough.values[few.ok])
    again = few.resweep(lambda point: swing(point).q[-1])
    assert again.ran == failed.sum() and again.ok.all()
    np.testing.assert_allclose(again.values, enough.values, rtol=1e-12)
    assert np.isnan(few.values).any(), "the first sweep stays as it was"
    with pytest.raises(ValueError, match="another structure"):
        few.resweep(lambda point: (point["g"], point["g"]))


@pytest.mark.exhaustive
def test_starts_that_cannot_be_integrated():
    """Starts off the constraint, or NaN: each lane has its own result, none raises."""
    start = lambda point: ({"x": point["x"], "y": 0.0}, {"x": 0.0, "y": 0.0})
    run = lambda point: lj.integrate(rod, *start(point), {"g": point["g"]}, ts=TS).end.q["x"]
    swept = quiet(run, {"x": np.array([1.0, 1.5]), "g": np.array([1.0, np.nan])})
    code = lambda name: int(getattr(lj.RESULTS, name)._value)
    assert swept.status.result.tolist() == [[OK, code("start_not_finite")], [code("start_off_constraints")] * 2]
    assert np.isfinite(swept.values).tolist() == [[True, False], [False, False]]
    assert 0 < swept.status.residual[0, 0] < 1e-9
    assert "does not satisfy the constraints" in repr(swept)


def spring_to(wall, checked):
    """The end of a spring's motion, which must not pass the wall."""
    check = lambda t, q, v, params: eqx.error_if(0.0 * q, checked & (q < -wall), "through the wall")
    spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2, force=check)
    return lj.integrate(spring, 1.0, 0.0, ts=TS).q[-1]


def steps_to(wall, checked):
    """The same in steps of a quarter, as a loop that reports as `integrate` does."""
    step = lambda x: eqx.error_if(x + 0.25, checked & (x + 0.25 > wall), "through the wall")
    end = jax.lax.while_loop(lambda x: x < 1.0, step, 0.0)
    code = jnp.where(jnp.isfinite(end), OK, lj.RESULTS.not_finite._value)
    return reported(end, lambda _: Report(code, jnp.asarray(4), jnp.asarray(0.0), jnp.asarray(0.0)))


@pytest.mark.parametrize(
    ("end_at", "there"), [(steps_to, 1.0), pytest.param(spring_to, np.cos(6.0), marks=pytest.mark.exhaustive)]
)
def test_a_check_that_fails_ends_its_lane_alone(end_at, there):
    """`error_if` in a force and in `run` gives NaN and a status; twin: without the check the lanes continue."""
    deep = {"checked": np.array([1.0, 0.0]), "wall": np.array([0.5, 0.9, 1.1, 2.0])}

    def run(point):
        checked = point["checked"] > 0.5
        outside = eqx.error_if(point["wall"], checked & (point["wall"] > 1.5), "too far away")
        return end_at(point["wall"], checked), outside

    swept = quiet(run, deep)
    np.testing.assert_allclose(swept.values[0][0], [np.nan, np.nan, there, there], atol=1e-7)
    np.testing.assert_array_equal(swept.values[1][0], [np.nan, np.nan, 1.1, np.nan])
    assert (swept.status.result[0, :2] != OK).all() and swept.status.result[0, 2] == OK
    np.testing.assert_allclose(swept.values[0][1], np.full(4, there), atol=1e-7)
    assert (swept.status.result[1] == OK).all()


def drifted(point):
    """A motion with fixed steps that are too long."""
    settings = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": jnp.asarray(0.5), "method": diffrax.Heun()}
    return swing(point, **settings).q[-1]


def as_drifted(point):
    """What such a motion reports: 3 and 4 steps, an error of 0.5 and of 2 tolerances, residuals of 0.25 and 0."""
    reports = Report(jnp.array([OK, OK]), jnp.array([3, 4]), jnp.array([0.5, 2.0]), jnp.array([0.25, 0.0]))
    return reported(point["angle"], lambda _: reports)


@pytest.mark.parametrize("run", [as_drifted, pytest.param(drifted, marks=pytest.mark.exhaustive)])
def test_a_drifting_motion_is_marked(run):
    """With fixed steps that are too long the values stay, but `ok` is False."""
    swept = quiet(run, {"g": np.array([1.0]), "angle": np.array([2.0])})
    assert not swept.ok.any() and np.isfinite(swept.values).all()
    assert swept.status.scaled_error > 1 and "the change of what must stay constant" in repr(swept)
    if run is as_drifted:
        assert (swept.status.steps, swept.status.scaled_error, swept.status.residual) == (7, 2.0, 0.25)
        assert swept.status.result == lj.RESULTS.drifted._value


def test_without_an_integration():
    """Any function of a point can be swept; values that are not finite count as failed."""
    swept = quiet(lambda point: {"root": jnp.sqrt(point["x"]), "n": 3}, {"x": np.array([4.0, -1.0])})
    assert swept.values["n"].tolist() == [3, 3] and swept.counts() == {
        "successful": 1,
        "The state became NaN or infinite.": 1,
    }


@pytest.fixture(scope="module")
def released():
    """A function of a point to a motion from that angle, as `swing`, but without a solver."""
    traj = motion("pendulum")
    return lambda point: scaled(traj, point["angle"])


def test_whole_trajectories(released):
    """A trajectory is one leaf of `values`, with its times as a dimension."""
    swept = quiet(released)
    assert swept.values.q.shape == (3, 7, 4)
    data, traj = swept.to_xarray(), motion("pendulum")
    assert data["q"].dims == ("g", "angle", "t") and np.array_equal(data["t"], traj.t)
    np.testing.assert_array_equal(data["q"].sel(g=4.0).isel(angle=2), AXES["angle"][2] * np.asarray(traj.q))
    assert (swept.status.steps == traj.stats["num_steps"]).all() and swept.ok.all()
    flags = data["result"].attrs
    assert data["result"].dims == ("g", "angle") and (data["result"] == OK).all()
    assert dict(zip(flags["flag_values"], flags["flag_meanings"].split()))[OK] == "successful"


def test_repr_and_pictures(released):
    """repr shows counts by status and the hardest point; plots are lines, a map or small multiples, or an error."""
    swept = quiet(lambda point: {"end": jnp.sqrt(point["g"] - 2 * point["angle"])})
    shown = repr(swept)
    for part in ("21: g (3) x angle (7)", "successful", "The state became NaN", "first not ok", "points/s"):
        assert part in shown
    (panel,) = swept.plot().axes
    shown = [text.get_text() for text in panel.get_legend().get_texts()]
    assert panel.get_xlabel() == "angle" and shown == ["g = 1", "not ok", "g = 4", "g = 9"]
    np.testing.assert_array_equal(panel.lines[0].get_ydata(), swept.values["end"][0])
    many = quiet(lambda p: p["a"] * p["b"], {"a": np.arange(8.0), "b": np.arange(9.0)})
    assert len(many.plot().axes) == 2
    assert len(quiet(lambda point: point["g"] ** 2, {"g": np.arange(5.0)}).plot().axes) == 1
    three = quiet(lambda p: p["a"] * p["b"] * p["c"], {k: np.arange(1.0, 4.0) for k in "abc"})
    assert len(three.plot().axes) == 4
    with pytest.raises(ValueError, match=r"no value with one number per point; each point has 'q' \(4,\)"):
        quiet(lambda point: {"q": point["g"] * TS}).plot()
    motions = quiet(released, {name: x[:3] for name, x in AXES.items()}, paired=True)
    panel, shades = motions.plot().axes
    assert shades.get_ylabel() == "point" and panel.get_xlabel() == "t" and len(panel.lines) == 3
    np.testing.assert_array_equal(panel.lines[2].get_ydata(), motions.values.q[2])
    with pytest.raises(ValueError, match="(?s)each point has.*'q' .*Fix: choose one"):
        quiet(released).plot()


class Spring(eqx.Module):
    """A result that is also a function, such as a trained network."""

    k: jax.Array

    def __call__(self, x):
        return -self.k * x


def test_what_run_returns_may_be_a_function():
    """A callable module is a pytree like any other."""
    swept = quiet(lambda point: Spring(point["g"]), {"g": AXES["g"]})
    np.testing.assert_array_equal(swept.values(1.0), -AXES["g"])
    assert "k float64" in repr(swept)


def test_interrupted(monkeypatch):
    """Ctrl-C keeps finished points, and `resweep` runs the rest."""

    class Impatient(Silent):
        def update(self, count):
            raise KeyboardInterrupt

    monkeypatch.setattr(import_module("lagjax.sweep.sweep"), "_meter", lambda total, progress: Impatient())
    with pytest.warns(UserWarning, match=r"interrupted: 4 of 21 points are done and kept"):
        swept = quiet(lambda point: point["g"] + point["angle"], chunk=4, workers=1)
    monkeypatch.undo()
    assert swept.ran == 4 and swept.counts()["not run"] == 17
    whole = swept.resweep()
    assert whole.ran == 17 and whole.ok.all()


def test_what_would_not_fit_is_refused():
    """A sweep too large for memory is refused before anything runs, with its size."""
    with pytest.raises(MemoryError, match=r"this sweep needs [\d.e+]+ GB: 1,000,000,000,000 points of \d+ bytes"):
        quiet(lambda point: point["x"] + point["y"] + jnp.zeros(10), {"x": np.zeros(10**6), "y": np.zeros(10**6)})


def test_what_run_must_not_return():
    """The error names the value of a wrong type."""
    with pytest.raises(TypeError, match="run must return numbers and arrays, and returned 'fast', a str"):
        quiet(lambda point: (point["g"], "fast"))


def test_bad_settings():
    """Errors for a wrong layout or part."""
    with pytest.raises(ValueError, match="layout must be one of 'vmap', 'map'"):
        quiet(lambda point: point["g"], layout="sideways")
    with pytest.raises(ValueError, match=r"part must be \(k, n\)"):
        quiet(lambda point: point["g"], part=(2, 2))
    with pytest.raises(ValueError, match="without a store its points would be lost"):
        quiet(lambda point: point["g"], part=(0, 2))
