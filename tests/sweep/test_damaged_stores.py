"""Damaged stores: damaged points are never returned as good, all damage is reported, and the same call repairs it."""

import shutil

import numpy as np
import pytest

import lagjax as lj
from lagjax.sweep.engine import LOST
from lagjax.sweep.store import Store
from tests.sweep.small_stores import (
    AXES,
    EXACT,
    cut,
    empty,
    exchange,
    flip_bit,
    remove,
    rewrite,
    same,
    swept,
    with_warnings,
)

BLOCKS = {
    "values gone": ("y/c/1/0/0", remove),
    "whole numbers gone": ("n/c/1/0", remove),
    "result gone": ("result/c/1/0", remove),
    "values cut": ("y/c/1/0/0", cut),
    "values empty": ("n/c/1/0", empty),
    "a bit of values": ("y/c/1/0/0", flip_bit(8)),
    "a bit of whole numbers": ("n/c/1/0", flip_bit(20)),
    "a bit of the checksum": ("y/c/1/0/0", flip_bit(-1)),
    "a bit of the result": ("result/c/1/0", flip_bit(8)),
    "a bit of the steps": ("steps/c/1/0", flip_bit(8)),
    "another block's": ("y/c/1/0/0", exchange),
    "a bit of the mark": ("lagjax/marks/c/1/0/0", flip_bit(8)),
    "the mark cut": ("lagjax/marks/c/1/0/0", cut),
}


@pytest.mark.parametrize("case", BLOCKS)
def test_a_damaged_block(store, case):
    """Its points are read as lost, never as good; the same call names the file and computes them again."""
    name, damage = BLOCKS[case]
    damage(store / name)
    (opened, values), words = with_warnings(lambda: (opened := lj.open_sweep(store), opened.values))
    lost = np.arange(40).reshape(5, 8) // 8 == 1
    np.testing.assert_array_equal(opened.status.result == LOST, lost)
    np.testing.assert_array_equal(opened.ok, ~lost)
    same(values, ~lost)
    assert np.isnan(values["y"][lost]).all() and opened.counts() == {"successful": 32, "lost from the store": 8}
    assert str(store / name) in words and "lj.sweep(run, axes, store=path)" in words
    mended, words = with_warnings(lambda: swept(store))
    assert mended.ran == 8 and mended.ok.all() and str(store / name) in words and "computed again: 1 of 5" in words
    same(mended.values)


def test_nothing_is_told_of_a_whole_store(whole):
    """Twin: an intact store gives no warning (an error here), and nothing is computed."""
    assert swept(whole).ran == 0 and lj.open_sweep(whole).ok.all()
    same(lj.open_sweep(whole).values)


def test_a_block_without_mark_was_not_run(store):
    """An unmarked block counts as not run, whatever values it has."""
    remove(store / "lagjax/marks/c/1/0/0")
    opened = lj.open_sweep(store)
    assert opened.counts() == {"successful": 32, "not run": 8} and np.isnan(opened.values["y"]).sum() == 16
    again = swept(store)
    assert again.ran == 8
    same(again.values)


def wrong_copies(whole, to, seed):
    """Of copies of a store of two blocks that each end after another file: whether a good point has other values."""
    files = sorted(x for x in whole.rglob("*") if x.is_file())
    # Without these none can be opened.
    files.sort(key=lambda file: str(file.relative_to(whole)) not in ("lagjax/zarr.json", "k/c/0", "x/c/0"))
    if seed is not None:
        files[3:] = np.random.default_rng(seed).permutation(files[3:]).tolist()
    for file in files:
        (to / file.relative_to(whole)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, to / file.relative_to(whole))
        try:
            opened, values = with_warnings(lambda: (opened := lj.open_sweep(to), opened.values))[0]
        except ValueError as error:
            assert "Fix:" in str(error)
            continue
        yield any(np.any(values[name][opened.ok] != exact[:2][opened.ok]) for name, exact in EXACT.items())


@pytest.mark.parametrize("seed", [0, pytest.param(None, marks=pytest.mark.slow)])
def test_a_copy_cut_short(tmp_path, monkeypatch, seed):
    """Wherever a copy ends, no lost point is good. Twin: a reader that takes missing files as fill values, as
    zarr does.
    """
    assert swept(tmp_path / "whole", axes=AXES | {"k": AXES["k"][:2]}).ran == 16
    wrong = list(wrong_copies(tmp_path / "whole", tmp_path / "one", seed))
    assert len(wrong) > 20 and not any(wrong) and lj.open_sweep(tmp_path / "one").ok.all()

    contents = Store._contents

    def fills(self, name, numbers, marks, read=True):
        return (found for found in contents(self, name, numbers, marks, read) if found[2] == "")

    remove(tmp_path / "one/n/c/1/0")
    monkeypatch.setattr(Store, "_contents", fills)
    opened = lj.open_sweep(tmp_path / "one")
    assert opened.ok.all() and (opened.values["n"][1] == 0).all()


@pytest.mark.parametrize("name", ["y", "n", "steps", "result", "lagjax/marks"])
def test_missing_arrays(store, name):
    """A missing array causes all its points to be computed again."""
    remove(store / name)
    opened, words = with_warnings(lambda: lj.open_sweep(store))
    assert not opened.ok.any() and str(store / name) in words
    mended, _ = with_warnings(lambda: swept(store))
    assert mended.ran == 40 and mended.ok.all() and swept(store).ran == 0
    same(mended.values)


@pytest.mark.parametrize("damage", [remove, cut, flip_bit(20)])
def test_damaged_axes(store, damage):
    """Such a store cannot be opened alone; the same sweep writes its axes again."""
    damage(store / "x/c/0")
    with pytest.raises(ValueError, match="values of the axis 'x' in .*/x are damaged"):
        lj.open_sweep(store)
    mended, words = with_warnings(lambda: swept(store))
    assert mended.ran == 0 and "/x was damaged" in words
    np.testing.assert_array_equal(lj.open_sweep(store).axes.values["x"], AXES["x"])


def test_parts_look_after_their_own(store):
    """Lost blocks of another part are reported, and are lost in what a part returns."""
    remove(store / "y/c/1/0/0")
    part, words = with_warnings(lambda: swept(store, part=(0, 2)))
    assert part.ran == 0 and np.sum(part.status.result == LOST) == 8 and "this call without part" in words
    assert with_warnings(lambda: swept(store, part=(1, 2)))[0].ran == 8
    assert swept(store).ok.all()


@pytest.mark.parametrize("structure", [3, {}, {"arrays": {}, "tree": None}, {"arrays": {}, "trajectories": []}])
def test_a_structure_that_is_none(store, structure):
    """Values whose structure is not described as lagjax does are a dictionary by name, with a warning."""
    rewrite(store, lambda description: description.update(structure=structure))
    with pytest.warns(UserWarning, match="are a dictionary by name: its structure is not one"):
        same(lj.open_sweep(store).values)
