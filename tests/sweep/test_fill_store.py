"""How stores are filled: what is missing is computed again, also by other versions."""

import numpy as np
import pytest

import lagjax as lj
from lagjax.sweep import metadata
from lagjax.sweep.store import Store
from tests.sweep import worker
from tests.sweep.small_stores import AXES, remove, rewrite, run, same, swept
from tests.sweep.test_store import same as same_sweep
from tests.sweep.test_store import swept as swept_points


def by_another_version(description):
    """Pretend that another version, which traced another program, wrote the store."""
    description["fingerprint"] |= {"versions": metadata.versions() | {"jax": "0.9.0"}, "program": "0" * 16}


def test_other_versions(store):
    """Their stores can always be read, and continued on request; a different run is detected by its values."""
    rewrite(store, by_another_version)
    remove(store / "lagjax/marks/c/4/0/0")
    opened = lj.open_sweep(store)
    assert opened.counts() == {"successful": 32, "not run": 8} and "written by lagjax" in opened.how
    with pytest.raises(ValueError, match="written by other versions(.|\n)*jax: 0.9.0 there(.|\n)*accept_versions=True"):
        swept(store)
    with pytest.warns(UserWarning, match="of 8 points computed again, 'y' differs by 1.0e"):
        swept(store, lambda point: {"n": run(point)["n"], "y": 2 * run(point)["y"]}, accept_versions=True, part=(0, 9))
    continued = swept(store, accept_versions=True)
    assert continued.ran == 8
    same(continued.values)
    with pytest.raises(ValueError, match="axis 'x' has other values"):
        swept(store, axes=AXES | {"x": AXES["x"] + 1}, accept_versions=True)
    rewrite(store, lambda description: description["fingerprint"].update(format=99))
    with pytest.raises(ValueError, match="which is newer"):
        lj.open_sweep(store)


def test_only_what_is_missing(tmp_path):
    """Unmarked blocks are computed again, whatever values they contain."""
    import zarr

    path, whole = tmp_path / "sweep", swept_points(worker.quick)
    swept_points(worker.quick, path)
    store = Store(path)
    store.unmark([1])
    zarr.open_group(str(path))["value"][store.blocks.region(1)] = -1.0
    again = swept_points(worker.quick, path)
    assert again.ran == len(np.r_[store.blocks.points(1)])
    same_sweep(again, whole)
