"""What a store says of itself: damage is put back or refused, names and formats that cannot be are refused."""

import jax.numpy as jnp
import pytest

import lagjax as lj
from tests.sweep.small_stores import cut, empty, remove, rewrite, same, swept, with_warnings

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
    (tmp_path / "other" / "lagjax" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="exists, but is not the store of a sweep"):
        lj.open_sweep(tmp_path / "other")


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


def test_what_killed_processes_left(store):
    """Of a store whose process was killed while it began it, the same call makes a store; half a file is no harm."""
    (store / "n/c/1/0.0123.partial").write_bytes(b"half")
    assert swept(store).ran == 0
    remove(store / "lagjax/zarr.json")
    remove(store / "lagjax/marks/c")
    remove(store / "x")
    again = swept(store)
    assert again.ran == 40 and lj.open_sweep(store).ok.all()
    same(again.values)


def test_stores_of_earlier_formats(store, tmp_path):
    """They are refused in words, by their place of the description or by their number."""
    (tmp_path / "flat" / "done").mkdir(parents=True)
    (tmp_path / "flat" / "done" / "0").write_bytes(b"")
    with pytest.raises(ValueError, match="flat exists, but is not the store(.|\n)*of lagjax 0.1"):
        lj.open_sweep(tmp_path / "flat")
    for number in (2, 3):
        rewrite(store, lambda description: description["fingerprint"].update(format=number))
        for call in (lj.open_sweep, swept):
            with pytest.raises(ValueError, match=f"its format is {number}, not 4(.|\n)*Fix: compute it again"):
                call(store)
