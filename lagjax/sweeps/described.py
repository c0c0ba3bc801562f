"""What a store may say of itself. A store that is opened may come from anyone: its files and its description are
checked here before they are used.

- A store consists of folders and files, without links, and its names stay inside of it: nothing outside of it is read
  or written.
- Every shape follows from those of the axes, so that no other number decides how much memory is taken; and arrays that
  would need far more memory than the files hold are not read.
"""

import math
import os
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from lagjax.mechanics.files import Explained
from lagjax.sweeps.grids import Blocks
from lagjax.sweeps.lanes import STATUS_TYPES, Status

# Arrays of a store hold truth values and numbers, in the names of zarr and NumPy.
NUMBERS = "bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64 complex64 complex128".split()
# How numbers become bytes, by whether they are compressed: zarr's names, in order.
CODECS = {("bytes", "zstd", "crc32c"): True, ("bytes", "crc32c"): False}
# Arrays that need more than this many bytes, and more than this many times those of all files, are not read.
MOST_BYTES, MOST_EXPANSION = 16_000_000, 1000
MARKS = "lagjax/marks"
# A sweep that continues computes as many points at a time as its store says, but no more than this.
LONGEST_CHUNK = 1 << 24


class Spec(NamedTuple):
    """How an array lies in its files: in chunks of one shape, compressed or not, in the order of their bytes."""

    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: np.dtype
    compressed: bool

    @property
    def bytes(self) -> int:
        """The bytes of the whole array."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def chunk_bytes(self) -> int:
        """The bytes of one chunk, before it is compressed."""
        return math.prod(self.chunk) * self.dtype.itemsize


class Described(NamedTuple):
    """A description that was checked: the arrays by name, and the blocks of the grid."""

    arrays: dict[str, Spec]
    blocks: Blocks


def check_files(path: Path) -> int:
    """The bytes of all files in a store.

    **Raises:** `ValueError` for a link, or anything else that is neither a folder nor a file.
    """
    folders, size = [path], 0
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(Path(entry.path))
                elif entry.is_file(follow_symlinks=False):
                    size += entry.stat(follow_symlinks=False).st_size
                else:
                    what = "a link" if entry.is_symlink() else "not a file"
                    raise Explained(
                        f"{entry.path!r} is {what}, and a store has only files of its own.\n"
                        "Usual cause: a copy made of links; or a store that was changed.\n"
                        "Fix: copy the files themselves (cp -rL), if you trust what they link to."
                    )
    return size


def check_room(path: Path, described: Described, places: dict[str, Any], size: int) -> None:
    """Raise `ValueError` if the arrays need far more memory than the files of a store, `size` bytes, can hold."""
    names = {*places["axes"].values(), *places["values"].values(), *places["status"].values(), places["marks"]}
    needed = sum(described.arrays[name].bytes for name in names)
    if needed > MOST_BYTES and needed > MOST_EXPANSION * size:
        raise Explained(
            f"the arrays of {path} need {needed / 1e9:.3g} GB, and its files have {size / 1e9:.3g} GB.\n"
            "Usual cause: a sweep of which hardly anything has been computed; or a store that was changed.\n"
            "Fix: lj.sweep(run, axes, store=path), which computes what is missing."
        )


def checked(description: dict[str, Any]) -> Described:
    """Check a description.

    **Raises:** `ValueError`, or what Python raises for missing or malformed parts, if it is not as `create` makes it.
    """
    fingerprint, places, names = description["fingerprint"], description["places"], description["names"]
    arrays = {name: spec_of(metadata) for name, metadata in description["arrays"].items() if _is_inside(name)}
    texts = [*names, *fingerprint["values"], fingerprint["layout"], fingerprint["program"], fingerprint["points"]]
    texts += [*fingerprint["versions"], *fingerprint["versions"].values(), *fingerprint["axes"].values()]
    _require(all(isinstance(x, str) and x.isprintable() for x in texts), "its names are not text")
    _require(isinstance(description["paired"], bool) and len(set(names)) == len(names) > 0, "its axes have no names")
    _require(isinstance(description["attributes"], dict), "its attributes are not")
    axes = [arrays[places["axes"][name]] for name in names]
    lengths = tuple(axis.shape[0] for axis in axes)
    _require(all(length > 0 for length in lengths) and set(fingerprint["axes"]) == set(names), "an axis is empty")
    for name, axis in zip(names, axes):
        _require(fingerprint["axes"][name].startswith(f"{axis.dtype}{list(axis.shape)} "), f"axis {name} is another")
    _require(not description["paired"] or len(set(lengths)) == 1, "paired axes have different lengths")
    blocks = Blocks(lengths[:1] if description["paired"] else lengths, tuple(description["block"]))
    shape, block = blocks
    _require(type(fingerprint["chunk"]) is int, "its chunk length is not a number")
    _require(0 < fingerprint["chunk"] <= max(LONGEST_CHUNK, math.prod(shape)), "its chunks are empty or too long")
    _require(len(block) == len(shape), "its blocks have another number of axes")
    _require(all(type(k) is int and 0 < k <= n for n, k in zip(shape, block)), "its blocks are empty or too long")
    splits = (all(k == 1 for k in block[:i]) and block[i + 1 :] == shape[i + 1 :] for i in range(len(shape)))
    _require(any(splits), "its blocks are not in the order of its points")
    for name, dtype in zip(Status._fields, STATUS_TYPES, strict=True):
        _require(arrays[places["status"][name]] == Spec(shape, block, dtype, True), f"the array of {name} is another")
    for name, words in fingerprint["values"].items():
        spec = arrays[places["values"][name]]
        inner = spec.shape[len(shape) :]
        _require(spec.shape[: len(shape)] == shape and words == f"{spec.dtype}{list(inner)}", f"{name} is another")
        _require(spec.chunk == (*block, *(max(1, n) for n in inner)), f"{name} has other blocks")
    files = len(fingerprint["values"]) + len(Status._fields)
    marks = Spec((len(blocks), files, 2), (1, files, 2), np.dtype("uint64"), False)
    _require(places["marks"] == MARKS and arrays[MARKS] == marks, "its marks are another array")
    return Described(arrays, blocks)


def spec_of(metadata: dict[str, Any]) -> Spec:
    """What zarr's metadata of an array say, if they are as lagjax writes them."""
    grid, keys = metadata["chunk_grid"], metadata["chunk_key_encoding"]
    shape, chunk = tuple(metadata["shape"]), tuple(grid["configuration"]["chunk_shape"])
    _require(metadata["zarr_format"] == 3 and metadata["node_type"] == "array", "an array is not one of zarr 3")
    _require(all(type(n) is int and n >= 0 for n in shape) and len(chunk) == len(shape), "an array has no shape")
    _require(all(type(k) is int and k > 0 for k in chunk) and grid["name"] == "regular", "an array has no chunks")
    _require(metadata["data_type"] in NUMBERS, "an array does not hold numbers")
    _require(keys == {"name": "default", "configuration": {"separator": "/"}}, "its files have other names")
    _require(not metadata.get("storage_transformers"), "its files are transformed")
    names = tuple(codec["name"] for codec in metadata["codecs"])
    endian = metadata["codecs"][0].get("configuration", {}).get("endian", "little")
    _require(names in CODECS and endian == "little", "its numbers are written in another way")
    return Spec(shape, chunk, np.dtype(metadata["data_type"]), CODECS[names])


def _is_inside(name: str) -> bool:
    """True for the name of an array that stays inside its store; raises `ValueError` for any other."""
    parts = name.split("/")
    inside = not PureWindowsPath(name).anchor and "\\" not in name and name.isprintable() and len(name) < 1000
    _require(inside and not {"", ".", "..", "zarr.json"} & {*parts}, f"the array {name!r:.80} is not inside of it")
    return True


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise ValueError(f"{otherwise}.")
