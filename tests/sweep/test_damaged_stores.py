"""Damaged stores: damaged points are never returned as good, all damage is reported, and the same call repairs it."""

import json
import shutil
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

import lagjax as lj
from lagjax.sweep import metadata
from lagjax.sweep import store as store_module
from lagjax.sweep.batch_program import LOST
from lagjax.sweep.chunks import Spec, chunk_file, nothing, read_chunk, write_chunk
from lagjax.sweep.store import Store
from tests.mutated import describe

AXES = {"k": np.arange(1, 6), "x": np.linspace(0.1, 1.0, 8)}
EXACT = {
    "n": 10 + AXES["k"][:, None] * np.ones(8, int),
    "y": np.stack([AXES["k"][:, None] * AXES["x"]] * 2, -1),
}


def run(point):
    """An integer and two floats, in closed form."""
    return {"n": 10 + point["k"], "y": jnp.stack([point["x"] * point["k"]] * 2)}


def swept(path, of=run, axes=AXES, **settings):
    """The sweep in a store of five blocks with eight points each."""
    return lj.sweep(of, axes, store=path, chunk=8, workers=1, progress=False, **settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An intact store."""
    path = tmp_path_factory.mktemp("whole") / "store"
    assert swept(path).ran == 40 and Store(path).blocks.block == (1, 8)
    return path


@pytest.fixture
def store(whole, tmp_path):
    """A copy of the intact store, to be damaged."""
    return shutil.copytree(whole, tmp_path / "store")


def with_warnings(call):
    """(what a call returns, its warnings)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return call(), "\n".join(str(x.message) for x in caught)


def same(values, where=...):
    """Check values against the closed form."""
    for name, exact in EXACT.items():
        np.testing.assert_allclose(values[name][where], exact[where], rtol=1e-15)


def remove(file):
    """Remove a file or a folder."""
    if file.is_dir():
        shutil.rmtree(file)
    else:
        file.unlink()


def cut(file):
    """Cut a file to its first half."""
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file):
    """Empty a file, as after a power cut."""
    file.write_bytes(b"")


def flip_bit(at):
    """A function that flips one bit."""

    def flip(file):
        data = bytearray(file.read_bytes())
        data[at] ^= 4
        file.write_bytes(data)

    return flip


def exchange(file):
    """Replace the file by that of another block."""
    shutil.copy(str(file).replace("/c/1/", "/c/3/"), file)


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
    assert swept(store).ran == 8


METADATA = {
    "the group's": ("zarr.json", lambda file: file.write_text("{")),
    "the group's gone": ("zarr.json", remove),
    "what xarray reads": ("zarr.json", lambda file: file.write_text(file.read_text().replace("5,", "6,", 1))),
    "an array's": ("y/zarr.json", lambda file: file.write_text('{"zarr_format": 3')),
    "an array's gone": ("n/zarr.json", remove),
    "an array's empty": ("result/zarr.json", empty),
    "a shape": ("n/zarr.json", lambda file: file.write_text(file.read_text().replace("5,", "6,", 1))),
    "of marks": ("lagjax/marks/zarr.json", cut),
}


@pytest.mark.parametrize("case", METADATA)
def test_damaged_metadata_are_put_back(store, case):
    """The store is read all the same, unchanged; the same sweep restores them, and no value is lost."""
    name, damage = METADATA[case]
    damage(store / name)
    before = {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    opened, words = with_warnings(lambda: lj.open_sweep(store))
    assert opened.ok.all() and str(store / name) in words and "which restores it" in words
    same(opened.values)
    assert before == {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    mended, words = with_warnings(lambda: swept(store))
    assert mended.ran == 0 and str(store / name) in words and "It has been restored" in words
    assert swept(store).ran == 0 and lj.open_sweep(store).ok.all()


def wrong_copies(whole, to, seed):
    """In how many copies of a store, each of which ends after another file, a point is good with other values."""
    wrong, files = 0, sorted(x for x in whole.rglob("*") if x.is_file())
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
        wrong += any(np.any(values[name][opened.ok] != exact[opened.ok]) for name, exact in EXACT.items())
    return wrong


@pytest.mark.parametrize("seed", [None, 0])
def test_a_copy_cut_short(whole, tmp_path, monkeypatch, seed):
    """Wherever a copy ends, no lost point is good. Twin: a reader that takes missing files as zeros, as zarr does."""
    assert wrong_copies(whole, tmp_path / "one", seed) == 0 and lj.open_sweep(tmp_path / "one").ok.all()

    def zeros(file, spec):
        return read_chunk(file, spec) if file.exists() else np.zeros(spec.chunk, spec.dtype)

    monkeypatch.setattr(store_module, "read_chunk", zeros)
    monkeypatch.setattr(Store, "damage", lambda *args: {})
    assert wrong_copies(whole, tmp_path / "other", seed) > 0


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


DESCRIPTION = {
    "cut": cut,
    "gone": remove,
    "empty": empty,
    "changed": lambda file: file.write_text(file.read_text().replace('"paired": false', '"paired": true')),
}


@pytest.mark.parametrize("case", DESCRIPTION)
def test_a_damaged_description(store, case):
    """Such a store is refused in words, unchanged, by both. Twin: the file copied again from the original."""
    file = store / "lagjax/zarr.json"
    content = file.read_bytes()
    DESCRIPTION[case](file)
    before = {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    for call in (swept, lj.open_sweep):
        with pytest.raises(ValueError, match="lagjax/zarr.json is damaged(.|\n)*Fix: copy that file again"):
            call(store)
    assert before == {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    file.write_bytes(content)
    assert swept(store).ran == 0 and lj.open_sweep(store).ok.all()


def test_no_store(tmp_path):
    """Errors if there is no store, or something else."""
    with pytest.raises(ValueError, match="there is no .*nowhere"):
        lj.open_sweep(tmp_path / "nowhere")
    (tmp_path / "other" / "lagjax").mkdir(parents=True)
    with pytest.raises(ValueError, match="exists, but is not the store of a sweep"):
        lj.open_sweep(tmp_path / "other")


def test_parts_look_after_their_own(store):
    """Lost blocks of another part are reported, and are lost in what a part returns."""
    remove(store / "y/c/1/0/0")
    part, words = with_warnings(lambda: swept(store, part=(0, 2)))
    assert part.ran == 0 and np.sum(part.status.result == LOST) == 8 and "this call without part" in words
    assert with_warnings(lambda: swept(store, part=(1, 2)))[0].ran == 8
    assert swept(store).ok.all()


NAMES = [
    (lambda x: {"a": {"b": x}, "a.b": x}, r"2 values named 'a.b': \['a'\]\['b'\], \['a.b'\]"),
    (lambda x: {"a/b/c": x, "a/b_c": x, "a_b/c": x}, "two of the values are named 'a_b_c'"),
    (lambda x: {"zarr.json": x}, "value 'zarr.json' cannot be kept in a store"),
    (lambda x: {"__x": x}, "cannot be kept in a store"),
    (lambda x: x.astype(jnp.bfloat16), "the value 'value' is bfloat16"),
]


@pytest.mark.parametrize("values, words", NAMES)
def test_a_failed_creation_leaves_nothing(tmp_path, values, words):
    """Colliding names, and dtypes that zarr cannot store."""
    with pytest.raises((ValueError, TypeError), match=words):
        swept(tmp_path / "new" / "store", lambda point: values(point["x"]))
    assert not list(tmp_path.iterdir())


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


def test_what_killed_processes_left(store):
    """Temporary folders of a killed process are removed; other files next to them are not."""
    leftover, other = store.with_name(".store.0123abcd"), store.with_name(".store.notes")
    for folder in (leftover, other):
        folder.mkdir()
    (store / "n/c/1/0.0123.partial").write_bytes(b"half")
    assert swept(store).ran == 0 and not leftover.exists() and other.exists()


def rewrite(path, change):
    """Change the description of a store."""
    describe(path, lambda description: change(description) or description)


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


def test_stores_of_earlier_formats(store, tmp_path):
    """They are refused in words, by their place of the description or by their number."""
    (tmp_path / "flat" / "done").mkdir(parents=True)
    with pytest.raises(ValueError, match="flat exists, but is not the store(.|\n)*of lagjax 0.1"):
        lj.open_sweep(tmp_path / "flat")
    for number in (2, 3):
        rewrite(store, lambda description: description["fingerprint"].update(format=number))
        for call in (lj.open_sweep, swept):
            with pytest.raises(ValueError, match=f"its format is {number}, not 4(.|\n)*Fix: compute it again"):
                call(store)


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint64", "float16", "float32", "complex128"])
@pytest.mark.parametrize("compressed", [True, False])
def test_zarr_would_write_the_same(tmp_path, dtype, compressed):
    """Metadata and files are those that zarr writes, in meaning; zarr reads them, and detects a flipped bit."""
    x = np.arange(15).reshape(5, 3).astype(dtype)
    spec = Spec((5, 3), (2, 3), x.dtype, nothing(x.dtype), ["a", "b"], compressed)
    codecs = [ZstdCodec(level=0)] * compressed + [Crc32cCodec()]
    zarr.create_array(
        tmp_path / "zarr", shape=x.shape, chunks=spec.chunk, dtype=dtype, compressors=codecs,
        fill_value=spec.fill, dimension_names=spec.dims, attributes={"about": "x"},
    )[:] = x  # fmt: skip
    theirs = json.loads((tmp_path / "zarr/zarr.json").read_text())
    assert spec.metadata({"about": "x"}) == theirs
    for i in range(3):
        file = chunk_file(tmp_path / "ours", spec, (i,))
        length, checksum = write_chunk(file, spec, x[2 * i : 2 * i + 2])
        assert length == file.stat().st_size and file.read_bytes()[-4:] == checksum.to_bytes(4, "little")
        here = chunk_file(tmp_path / "zarr", spec, (i,))
        np.testing.assert_array_equal(read_chunk(here, spec)[: len(x) - 2 * i], x[2 * i : 2 * i + 2])
        shutil.copy(file, here)
    np.testing.assert_array_equal(zarr.open_array(tmp_path / "zarr")[:], x)
    flip_bit(0)(chunk_file(tmp_path / "zarr", spec, (0,)))
    with pytest.raises(ValueError, match="checksum"):
        zarr.open_array(tmp_path / "zarr")[:]


@pytest.mark.parametrize("structure", [3, {}, {"arrays": {}, "tree": None}, {"arrays": {}, "trajectories": []}])
def test_a_structure_that_is_none(store, structure):
    """Values whose structure is not described as lagjax does are a dictionary by name, with a warning."""
    rewrite(store, lambda description: description.update(structure=structure))
    with pytest.warns(UserWarning, match="are a dictionary by name: its structure is not one"):
        same(lj.open_sweep(store).values)


def test_checksums_stand_in_every_array(whole):
    """Anyone who reads a store with zarr can detect damage."""
    files = list(whole.rglob("zarr.json"))
    arrays = [x for x in (json.loads(file.read_text()) for file in files) if x["node_type"] == "array"]
    assert len(arrays) == 2 + 2 + 4 + 1
    assert all(array["codecs"][-1]["name"] == "crc32c" for array in arrays)
