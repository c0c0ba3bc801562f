"""Sweeps in xarray and pandas: stores that xarray opens directly, including half-filled and paired ones."""

import json
import shutil
import sys
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store

AXES = {"k": np.arange(1, 4), "x": np.linspace(0.1, 1.0, 7), "w": np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])}
PAIRS = {"x": np.linspace(0.1, 1.0, 9), "n": np.arange(9), "w": np.arange(18.0).reshape(9, 2)}
WAYS = ({}, {"consolidated": True}, {"consolidated": False})


def run(point):
    """Numbers, an array, a nested name, names that are already taken, a complex number."""
    y = point["k"] * point["x"]
    return {"y": y, "x": -y, "steps": 2, "both": {"a/b": y * point["w"], "z": 1j * y}, "lagjax": y > 1.0}


def paired(point):
    """One number."""
    return point["x"] * point["n"] + point["w"][0]


def swept(path, of=run, axes=AXES, **settings):
    """A sweep in a store, in small blocks."""
    return lj.sweep(of, axes, store=path, chunk=4, workers=1, progress=False, **settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A complete store."""
    path = tmp_path_factory.mktemp("whole") / "store"
    swept(path)
    return path


def grid(*names):
    """Axes by name, shaped to broadcast over the grid."""
    shapes = {name: [-1 if other == name else 1 for other in AXES] for name in AXES}
    return [np.asarray(AXES[name]).reshape(shapes[name]) for name in names]


@pytest.mark.parametrize("way", WAYS)
def test_xarray_opens_a_store_as_it_lies(store, way):
    """Names of the axes, values in closed form, no warning (an error here); equal to `to_xarray`."""
    import xarray

    data = xarray.open_zarr(store, **way).load()
    k, x = grid("k", "x")
    y = k * x * np.ones((1, 1, 2))
    assert data["y"].dims == ("k", "x", "w") and dict(data.sizes) == {"k": 3, "x": 7, "w": 2, "w_0": 3, "both.a_b_0": 3}
    np.testing.assert_allclose(data["y"], y, rtol=1e-15)
    np.testing.assert_allclose(data["y"].sel(k=2, x=1.0, w=0), 2.0)
    np.testing.assert_allclose(data["value_x"], -y, rtol=1e-15)
    np.testing.assert_allclose(data["both.z"], 1j * y, rtol=1e-15)
    np.testing.assert_allclose(data["both.a_b"], y[..., None] * AXES["w"], rtol=1e-15)
    np.testing.assert_array_equal(data["value_lagjax"], y > 1.0)
    assert (data["steps"] == 2).all() and (data["status_steps"] == 0).all()
    assert set(data.coords) == {"k", "x", "w_values"} and np.array_equal(data["w_values"], AXES["w"])
    labelled = lj.open_sweep(store).to_xarray()
    xarray.testing.assert_equal(data, labelled)
    assert all(data[name].attrs == labelled[name].attrs for name in data.variables)


def test_half_filled(tmp_path):
    """Points not run are NaN and marked; twin: the others have values, and a complete store has no such points."""
    import xarray

    part = swept(tmp_path / "store", part=(1, 3))
    data = xarray.open_zarr(tmp_path / "store").load()
    meanings = dict(zip(data["result"].attrs["flag_values"], data["result"].attrs["flag_meanings"].split()))
    assert meanings[-1] == "not_run" and meanings[0] == "successful" and meanings[-2] == "lost_from_the_store"
    not_run = data["result"].values == -1
    assert 0 < part.ran == np.sum(~not_run) < not_run.size
    np.testing.assert_array_equal(np.isnan(data["y"]), not_run)
    xarray.testing.assert_equal(data, lj.open_sweep(tmp_path / "store").to_xarray())
    swept(tmp_path / "store")
    data = xarray.open_zarr(tmp_path / "store")
    assert (data["result"] == 0).all() and not np.isnan(data["y"]).any()


def test_paired_axes(tmp_path):
    """One dimension, the point, with all axes as its coordinates."""
    import xarray

    swept(tmp_path / "store", paired, PAIRS, paired=True)
    for way in WAYS:
        data = xarray.open_zarr(tmp_path / "store", **way).load()
        assert data["value"].dims == ("point",) and set(data.coords) == {"x", "n", "w"}
        np.testing.assert_allclose(data["value"], PAIRS["x"] * PAIRS["n"] + PAIRS["w"][:, 0], rtol=1e-15)
        np.testing.assert_array_equal(data["w"], PAIRS["w"])
        xarray.testing.assert_equal(data, lj.open_sweep(tmp_path / "store").to_xarray())


def test_blocks_end_with_the_axes(store):
    """Blocks are boxes with consecutive flat indices that cover the grid once; the last of a row may be shorter."""
    blocks = Store(Files(store)).blocks
    lengths = {x.stop - x.start for x in map(blocks.points, range(len(blocks)))}
    assert blocks.block == (1, 4, 2) and lengths == {6, 8}
    indices = np.arange(42).reshape(blocks.shape)
    for number in range(len(blocks)):
        np.testing.assert_array_equal(indices[blocks.region(number)].reshape(-1), np.r_[blocks.points(number)])
    together = np.concatenate([np.r_[blocks.points(number)] for number in range(len(blocks))])
    np.testing.assert_array_equal(together, np.arange(42))


def test_other_attributes_are_nobodys_harm(store, tmp_path):
    """Attributes added by a user stay and do not count as damage; nor does consolidating the metadata again."""
    import xarray

    copied = shutil.copytree(store, tmp_path / "store")
    file = copied / "y/zarr.json"
    said = json.loads(file.read_text())
    file.write_text(json.dumps(said | {"attributes": {"units": "m"}}))
    with warnings.catch_warnings():
        # Zarr warns that consolidated metadata are not yet part of its third format.
        warnings.simplefilter("ignore")
        __import__("zarr").consolidate_metadata(copied)
    assert lj.open_sweep(copied).ok.all() and swept(copied).ran == 0
    assert xarray.open_zarr(copied)["y"].attrs == {"units": "m"}


def test_pandas():
    """One row per point, bit for bit; one column per number of an array; the result as a category."""
    import pandas

    found = lj.sweep(run, AXES, progress=False)
    table = found.to_pandas()
    assert len(table) == 42 and list(table)[:6] == ["k", "x", "w[0]", "w[1]", "w[2]", "both.a_b[0]"]
    np.testing.assert_array_equal(table["y"].to_numpy().reshape(3, 7, 2), found.values["y"])
    np.testing.assert_array_equal(table["both.a_b[2]"].to_numpy().reshape(3, 7, 2), found.values["both"]["a/b"][..., 2])
    np.testing.assert_array_equal(table["k"] * table["x"], table["y"])
    assert table["k"].dtype == np.int64 and table["value_lagjax"].dtype == bool
    assert isinstance(table["result"].dtype, pandas.CategoricalDtype) and set(table["result"]) == {"successful"}
    failed = lj.sweep(lambda point: jnp.sqrt(point["x"]), {"x": np.array([4.0, -1.0])}, progress=False).to_pandas()
    assert failed["result"].tolist() == ["successful", "The state became NaN or infinite."]
    np.testing.assert_array_equal(failed["value"], [2.0, np.nan])


def test_pandas_of_pairs_and_of_a_choice():
    """Paired axes, a choice of the values, and values that do not fit into a row."""
    pairs = lj.sweep(paired, PAIRS, paired=True, progress=False)
    np.testing.assert_array_equal(pairs.to_pandas()[["x", "n", "w[0]"]].to_numpy()[:, 1], PAIRS["n"])
    many = lj.sweep(lambda point: point["x"] * jnp.arange(101.0), {"x": PAIRS["x"]}, progress=False)
    with pytest.raises(ValueError, match=r"each point has 'value' \(101,\), which does not fit into a row(.|\n)*Fix:"):
        many.to_pandas()
    np.testing.assert_array_equal(many.to_pandas(lambda x: {"last": x[..., -1]})["last"], 100 * PAIRS["x"])
    with pytest.raises(
        ValueError, match=r"'value' has the shape \(\), which does not begin with the shape of the axes"
    ):
        many.to_pandas(lambda x: np.sum(x))


@pytest.mark.parametrize("name, export", [("pandas", "to_pandas"), ("xarray", "to_xarray")])
def test_without_the_extra(monkeypatch, name, export):
    """The error says how to install it."""
    found = lj.sweep(paired, PAIRS, paired=True, progress=False)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf'needs {name}(.|\n)*pip install "lagjax\[data\]"'):
        getattr(found, export)()
