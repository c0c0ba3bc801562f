"""Pickled and copied sweeps: what is included, and what errors say about the rest."""

import copy
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lagjax as lj

AXES = {"x": np.linspace(0.0, 1.0, 4), "k": np.arange(1, 4)}
EXACT = AXES["x"][:, None] * AXES["k"]
WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "pickle twice": lambda x: pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(x)))),
}


def product(point):
    """A function that pickle finds by name."""
    return {"y": point["x"] * point["k"], "n": point["k"]}


def swept(run, store=None):
    """A sweep without a progress bar."""
    return lj.sweep(run, AXES, store=store, chunk=4, progress=False)


@pytest.fixture(scope="module")
def named():
    """A sweep of a function that pickle finds."""
    return swept(product)


def same(found, whole):
    """Compare everything that a sweep has."""
    assert repr(found) == repr(whole) and found.counts() == whole.counts() == {"successful": 12}
    assert found.dims == whole.dims and found.ok.all()
    for name, x in found.axes.values.items():
        np.testing.assert_array_equal(x, AXES[name])
    np.testing.assert_array_equal(found.values["y"], EXACT)
    assert found.to_xarray().identical(whole.to_xarray()) and found.to_pandas().equals(whole.to_pandas())
    assert len(found.plot("y").axes) == 1


@pytest.mark.parametrize("way", WAYS)
def test_all_goes_along_but_the_function(named, way):
    """Values, axes, statuses and exports work in the copy; a pickle takes the function again; the original stays."""
    found = WAYS[way](named)
    same(found, named)
    some = np.eye(4, 3, dtype=bool)
    again = found.resweep(lambda point: {"y": -point["x"], "n": 0 * point["k"]}, where=some)
    assert again.ran == 3
    np.testing.assert_array_equal(again.values["y"], np.where(some, -AXES["x"][:, None], EXACT))
    if "pickle" in way:
        with pytest.raises(
            ValueError, match=r"unpickled does not know the function that ran it.\nFix: swept.resweep\("
        ):
            found.resweep(where=some)
    else:
        assert found.resweep(where=some).ran == 3
    assert found.resweep(product, where=some).ran == 3
    assert found.resweep() is found, "there is nothing to run"
    np.testing.assert_array_equal(named.values["y"], EXACT)
    if way != "copy":
        found.values["y"][:] = 0.0
        np.testing.assert_array_equal(named.values["y"], EXACT)
    with pytest.raises(ValueError, match="returns another structure than the sweep: y float64, not n int64, y"):
        found.resweep(lambda point: {"y": point["x"]}, where=some)


@pytest.mark.parametrize("way", WAYS)
def test_a_sweep_in_a_store(way, tmp_path):
    """The values stay in the store, not in the pickle."""
    whole = swept(product, tmp_path / "store")
    data = pickle.dumps(whole)
    assert len(data) < len(pickle.dumps(swept(product))) + 5000
    same(WAYS[way](whole), whole)
    with pytest.raises(ValueError, match="the values in a store belong to the run that it was begun with"):
        WAYS[way](whole).resweep(where=True)
    opened = WAYS[way](lj.open_sweep(tmp_path / "store"))
    same(opened, lj.open_sweep(tmp_path / "store"))
    with pytest.raises(ValueError, match="opened from its store does not know the function that ran it"):
        opened.resweep(where=True)


PROGRAM = """
import jax, pickle, sys
jax.config.update("jax_enable_x64", True)
found = pickle.loads(open(sys.argv[1], "rb").read())
assert found.resweep(lambda point: {"y": point["x"] * point["k"], "n": point["k"]}, where=True).ran == 12
print(found, found.values["y"].sum())
"""


@pytest.mark.slow
def test_in_another_process(named, tmp_path):
    """A sweep unpickled in another process compiles its program there."""
    (tmp_path / "swept").write_bytes(pickle.dumps(named))
    root = Path(lj.__file__).parents[1]
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, tmp_path / "swept"], cwd=root, check=True, capture_output=True, text=True
    )
    assert found.stdout.strip() == f"{named} {EXACT.sum()}"
