"""Trajectories that a sweep stored or pickled come back as trajectories, with their system if it is passed again."""

import pickle
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import Trajectory

TS = np.linspace(0.0, 2.0, 5)
AXES = {"k": np.array([1.0, 2.0, 3.0]), "x": np.array([0.5, 1.0])}
# x cos k t; params contain a number and a string, which are not arrays.
spring = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 - 0.5 * params["k"] ** params["power"] * q["x"] ** 2)
EXACT = AXES["x"][:, None] * np.cos(AXES["k"][:, None, None] * TS)


class Pair(NamedTuple):
    """A named tuple among the values."""

    square: jax.Array
    rest: tuple


def swing(point, ts=TS):
    """The spring released from rest."""
    params = {"k": point["k"], "power": 2, "name": "spring"}
    return lj.integrate(spring, {"x": point["x"]}, {"x": 0.0}, params, ts=ts)


def run(point):
    """A trajectory among other values."""
    return {"motion": swing(point), "pair": Pair(point["k"] ** 2, (point["x"], [jnp.ones(2)]))}


def quiet(of, axes=AXES, **settings):
    """A sweep without a progress bar."""
    return lj.sweep(of, axes, progress=False, **settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The sweep in a store."""
    path = tmp_path_factory.mktemp("swept") / "store"
    assert quiet(run, store=path).ok.all()
    return path


def lane(motions, *at):
    """One of the trajectories."""
    return jax.tree.map(lambda x: x[at], motions)


def test_structures_without_trajectories(tmp_path):
    """Tuples, named tuples, lists and None come back unchanged; passing a system is an error."""
    of = lambda point: {"pair": Pair(point["k"] ** 2, (point["x"], [point["k"] * jnp.ones(2), None])), "a.b": 1.0}
    swept = quiet(of, store=tmp_path / "store")
    opened = lj.open_sweep(tmp_path / "store", classes=[Pair])
    assert jax.tree.structure(opened.values) == jax.tree.structure(swept.values)
    assert isinstance(opened.values["pair"], Pair) and repr(opened.values) == repr(swept.values)
    with pytest.raises(ValueError, match="has no trajectories that need a system"):
        lj.open_sweep(tmp_path / "store", system=spring)
    with pytest.raises(ValueError, match="run returns value float64, but .* has a.b float64, pair.rest.0 float64"):
        lj.open_sweep(tmp_path / "store", run=lambda point: point["x"])


def test_what_cannot_be_written_down(tmp_path):
    """Values that contain a function are read as a dictionary by name, or restored if `run` is passed again."""
    of = lambda point: jax.tree_util.Partial(lambda k, x: k * x, point["k"])
    quiet(of, {"k": AXES["k"]}, store=tmp_path / "store")
    values = lj.open_sweep(tmp_path / "store").values
    assert isinstance(values, dict) and [x.tolist() for x in values.values()] == [[1.0, 2.0, 3.0]]
    again = lj.open_sweep(tmp_path / "store", run=of).values
    np.testing.assert_array_equal(again(2.0), 2.0 * AXES["k"])


class Law(eqx.Module):
    """A class of the user."""

    k: jax.Array


def test_a_class_that_is_not_passed(tmp_path):
    """A dictionary and a warning that names it. Twin: with the class the values are restored."""
    quiet(lambda point: Law(point["k"]), {"k": AXES["k"]}, store=tmp_path / "store")
    assert isinstance(lj.open_sweep(tmp_path / "store", classes=[Law]).values, Law)
    with pytest.warns(UserWarning, match=r"are a dictionary by name: it holds an object of class .*Law(.|\n)*=\[Law\]"):
        values = lj.open_sweep(tmp_path / "store").values
    assert list(values) == ["k"] and values["k"].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.exhaustive
def test_a_store_opened(store):
    """Trajectories equal those of the sweep bit for bit; they print, plot and animate without their system."""
    swept, opened = quiet(run, store=store), lj.open_sweep(store, classes=[Pair])
    motions = opened.values["motion"]
    assert swept.ran == 0 and isinstance(motions, Trajectory) and isinstance(opened.values["pair"], Pair)
    np.testing.assert_allclose(motions.q["x"], EXACT, atol=1e-8)
    for name in ("t", "q", "v", "end", "stats", "scaled_error", "result"):
        same = jax.tree.map(np.array_equal, getattr(motions, name), getattr(swept.values["motion"], name))
        assert all(jax.tree.leaves(same))
    one = lane(motions, 1, 1)
    assert one.params == {"k": 2.0, "power": 2, "name": "spring"} and one.tolerance[0][0] == 1e-9
    assert "successful" in repr(one) and "System(<lambda>), not given" in repr(one)
    assert len(one.plot().axes) > 0 and len(one.phase_portrait().axes) > 0
    assert "frames" in repr(one.animate(lambda t, q, params: (q["x"], 0.0)))
    with pytest.raises(ValueError, match="needs the functions of the system(.|\n)*open_sweep"):
        one.drift()
    assert "motion Trajectory at 5 times" in repr(opened)


@pytest.mark.slow
def test_the_system_given_again(store):
    """Passing the system or `run` completes trajectories; twins: another system, and another run."""
    known = lane(quiet(run, store=store).values["motion"], 1, 1)
    for given in ({"system": spring}, {"run": run}):
        one = lane(lj.open_sweep(store, classes=[Pair], **given).values["motion"], 1, 1)
        assert repr(one) == repr(known) and float(one.drift()) == float(known.drift()) < 1e-9
        assert one.system is spring or one.system == spring
    other = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 - 0.6 * params["k"] ** params["power"] * q["x"] ** 2)
    with pytest.raises(ValueError, match="this system is not the one of .*store(.|\n)*the Lagrangian: its"):
        lj.open_sweep(store, system=other, classes=[Pair])
    with pytest.raises(TypeError, match="system must be a lj.System, not 3"):
        lj.open_sweep(store, system=3, classes=[Pair])
    with pytest.raises(ValueError, match="run returns"):
        lj.open_sweep(store, run=swing)


@pytest.mark.slow
def test_labelled_with_the_axes_in_front(store):
    """Labels equal those xarray reads from the store, and those of each trajectory."""
    import xarray

    data, opened = xarray.open_zarr(store).load(), lj.open_sweep(store, classes=[Pair])
    assert data["motion.q.x"].dims == ("k", "x", "motion.t") and np.array_equal(data["motion.t"], TS)
    np.testing.assert_allclose(data["motion.q.x"], EXACT, atol=1e-8)
    np.testing.assert_array_equal(data["motion.params.k"], AXES["k"][:, None] * np.ones(2))
    xarray.testing.assert_equal(data, opened.to_xarray())
    own = lane(opened.values["motion"], 2, 0).to_xarray()
    for name in ("q.x", "v.x", "end"):
        found = data[f"motion.{name}"].isel(k=2, x=0)
        np.testing.assert_array_equal(found, own[name])
        assert tuple(str(dim).removeprefix("motion.") for dim in found.dims) == own[name].dims


@pytest.mark.slow
def test_times_of_their_own(tmp_path):
    """Times that differ between points are a variable; shared times are the coordinate. A single value has no prefix.

    An axis named like the times keeps its name.
    """
    import xarray

    of = lambda point: swing({"k": point["t"], "x": 1.0}, ts=TS * point["t"])
    axes = {"t": AXES["k"]}
    swept = quiet(of, axes, store=tmp_path / "own")
    data = xarray.open_zarr(tmp_path / "own").load()
    assert data["q.x"].dims == ("t", "value_t") and "value_t" not in data.coords
    np.testing.assert_allclose(data["times"], TS * AXES["k"][:, None], rtol=1e-15)
    np.testing.assert_allclose(data["q.x"], np.cos(AXES["k"][:, None] ** 2 * TS), atol=1e-7)
    xarray.testing.assert_equal(data, swept.to_xarray())
    assert isinstance(lj.open_sweep(tmp_path / "own").values, Trajectory)


class Stiff(eqx.Module):
    """A Lagrangian with an array in it."""

    k: jax.Array

    def __call__(self, t, q, v, params):
        return 0.5 * v**2 - 0.5 * self.k * q**2


@pytest.mark.slow
def test_a_system_with_arrays(tmp_path):
    """Its arrays are stored and restored with the system; without the system they are dropped, all else remains."""
    stiff = lj.System(Stiff(jnp.array(4.0)), dissipation=lambda t, q, v, params: 0.0 * v**2)
    of = lambda point: lj.integrate(stiff, point["x"], 0.0, None, ts=TS)
    swept = quiet(of, {"x": AXES["x"]}, store=tmp_path / "store")
    exact = AXES["x"][:, None] * np.cos(2.0 * TS)
    for found in (swept, lj.open_sweep(tmp_path / "store"), pickle.loads(pickle.dumps(swept))):
        np.testing.assert_allclose(found.values.q, exact, atol=1e-8)
        assert found.values.asked.drift == swept.values.asked.drift
    whole = lane(lj.open_sweep(tmp_path / "store", system=stiff).values, 1)
    assert whole.system.lagrangian.function.k == 4.0 and repr(whole) == repr(lane(swept.values, 1))
