"""Names of values and axes as labels: kept apart where they clash, one dimension for paired axes."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.sweep.small_stores import AXES, run, swept
from tests.sweep.test_tables import swept as swept_in_blocks


def test_names_that_look_like_folders(tmp_path):
    """Names with a common prefix before a slash are kept apart; so are an axis and a value of one name in xarray."""
    both = swept(tmp_path / "store", lambda point: {"a/b": point["x"], "a/c": point["k"], "x": 2 * point["x"]})
    opened = lj.open_sweep(tmp_path / "store")
    np.testing.assert_array_equal(opened.values["a/c"], both.values["a/c"])
    np.testing.assert_allclose(opened.to_xarray()["value_x"][0], 2 * AXES["x"])
    with pytest.raises(ValueError, match="2 values named 'a.b'"):
        lj.sweep(lambda point: {"a": {"b": point["x"]}, "a.b": 1.0}, AXES, progress=False).to_xarray()
    with pytest.raises(ValueError, match="two axes are named '1'"):
        lj.sweep(run, {1: AXES["x"], "1": AXES["x"]}, progress=False)


def test_axes_with_names_that_are_taken(tmp_path):
    """A value named like a dimension, axes named like a status, and axis names that a store cannot keep."""
    import xarray

    axes = {"steps": np.arange(3.0), "y_0": np.arange(2.0)}
    of = lambda point: {"y": point["y_0"] * jnp.ones(4), "result": point["steps"]}
    data = swept_in_blocks(tmp_path / "store", of, axes).to_xarray()
    assert data["status_steps"].dims == data["result"].dims == ("steps", "y_0") and "status_result" in data
    assert data["y"].dims[:2] == ("steps", "y_0") and data["y"].shape == (3, 2, 4)
    xarray.testing.assert_equal(data, xarray.open_zarr(tmp_path / "store").load())
    for name in ("lagjax", "a/b"):
        with pytest.raises(ValueError, match=f"axis '{name}' cannot be kept in a store"):
            swept_in_blocks(tmp_path / "other", lambda point: 1.0, {name: np.arange(2.0)})
    assert not (tmp_path / "other").exists()
