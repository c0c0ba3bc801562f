"""What a store says of itself, from which the metadata of all of its arrays follow; and the files of its arrays.

The description stands in the attributes of the group `lagjax`, with a digest: the fingerprint of the sweep, its blocks,
and the places of its arrays. What zarr and xarray need, a `zarr.json` for each array, is made from it and read by them
only; a sweep that continues writes it again where it is damaged. A store is made under a temporary name and then
renamed, so that several processes may open it at the same time. The fingerprint, of axes, values, program and versions,
is what two runs must share to use one store.

A store may come from anyone, and opening it writes nothing:

- it consists of folders and files, without links, and its names stay inside of it;
- every shape follows from those of the axes, so that no other number decides how much memory is taken; and arrays that
  would need far more memory than the files hold are not read.

**The files of its arrays**, one for each block: numbers, compressed by zstd, then their checksum (crc32c). They are
those that zarr writes and reads. A file may come from anyone: no more bytes are made of one than its block has numbers
for.
"""

import json
import math
import os
import re
import shutil
import uuid
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from lagjax.display import by_line, printable
from lagjax.files import MALFORMED, Explained, parsed
from lagjax.sweep.axes import Axes, Blocks
from lagjax.sweep.engine import NOT_RUN, STATUS_TYPES, Program, Status, digest, nothing
from lagjax.sweep.labels import STORE_GROUP, labels_of, named_leaves, status_attributes

# The length of a checksum in bytes.
CHECKSUM = 4
NEEDS_ZARR = 'stores need zarr, which is an optional extra.\nFix: pip install "lagjax[data]", or leave store out.'
# The exceptions for files that are missing or damaged.
UNREADABLE = (ValueError, RuntimeError, TypeError, OSError)
# The first bytes of a zstd frame, and the lengths of the fields after them.
ZSTD, DICTIONARY, CONTENT = b"\x28\xb5\x2f\xfd", (0, 1, 2, 4), (0, 2, 4, 8)


class Spec(NamedTuple):
    """How an array lies in its files: in chunks of one shape, compressed or not, in the order of their bytes."""

    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: np.dtype
    fill: float
    dims: list[str] | None
    compressed: bool = True

    @property
    def bytes(self) -> int:
        """The bytes of the whole array."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def chunk_bytes(self) -> int:
        """The bytes of one chunk, before it is compressed."""
        return math.prod(self.chunk) * self.dtype.itemsize

    def metadata(self, attributes: dict[str, Any]) -> dict[str, Any]:
        """What zarr 3 says of such an array in its `zarr.json`."""
        fill = "NaN" if self.fill != self.fill else self.dtype.type(self.fill).item()
        order = {} if self.dtype.itemsize == 1 else {"configuration": {"endian": "little"}}
        zstd = [{"name": "zstd", "configuration": {"level": 0, "checksum": False}}] if self.compressed else []
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": str(self.dtype),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunk)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": [fill, 0.0] if self.dtype.kind == "c" else fill,
            "codecs": [{"name": "bytes"} | order, *zstd, {"name": "crc32c"}],
            "attributes": attributes,
            **({} if self.dims is None else {"dimension_names": self.dims}),
            "storage_transformers": [],
        }


def chunk_file(folder: Path, spec: Spec, place: tuple[int, ...] = ()) -> Path | None:
    """The file of a chunk, the first along the dimensions that `place` does not name; None for an empty array."""
    inner = "0" * (len(spec.shape) - len(place))
    return None if math.prod(spec.shape) == 0 else folder.joinpath("c", *map(str, place), *inner)


def read_bytes(file: Path, spec: Spec) -> bytes:
    """The bytes of one file, which are those of its chunk, compressed.

    **Raises:** one of `UNREADABLE` if there is no such file, or it holds anything else.
    """
    with open(file, "rb") as content:
        # Numbers that cannot be compressed take little more than they are.
        if os.fstat(content.fileno()).st_size > spec.chunk_bytes + spec.chunk_bytes // 64 + 1024:
            raise ValueError(f"{file} is longer than its numbers.")
        data = content.read()
    body = data[:-CHECKSUM]
    if checksum_of(body) != as_number(data[-CHECKSUM:]):
        raise ValueError(f"{file} is not as it was written.")
    if (content_size(body) if spec.compressed else len(body)) != spec.chunk_bytes:
        raise ValueError(f"{file} does not hold {spec.chunk_bytes:,} bytes.")
    return body


def read_chunk(file: Path | None, spec: Spec) -> np.ndarray:
    """The numbers of one file, in the shape of a chunk; zeros for an empty array (None).

    **Raises:** as `read_bytes`.
    """
    if file is None:
        return np.zeros(spec.chunk, spec.dtype)
    data = read_bytes(file, spec)
    body = np.empty(spec.chunk_bytes, np.uint8) if spec.compressed else np.frombuffer(data, np.uint8)
    if spec.compressed:
        _zstd().decode(data, out=body)
    if spec.dtype.kind == "b" and body.max(initial=0) > 1:
        raise ValueError(f"{file} has truth values that are neither true nor false.")
    return body.view(spec.dtype.newbyteorder("<")).reshape(spec.chunk)


def write_chunk(file: Path | None, spec: Spec, x: np.ndarray) -> tuple[int, int]:
    """Write the numbers of one file, (n, ...) up to the shape of a chunk; returns its length and its checksum.

    There is no file (None), of length 0, for an empty array.
    """
    if file is None:
        return 0, 0
    whole = np.zeros(spec.chunk, spec.dtype.newbyteorder("<"))
    whole[tuple(map(slice, x.shape))] = x
    body = bytes(_zstd().encode(whole)) if spec.compressed else whole.tobytes()
    checksum = checksum_of(body)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f"{file.name}.{uuid.uuid4().hex[:8]}.partial")
    partial.write_bytes(body + checksum.to_bytes(CHECKSUM, "little"))
    partial.replace(file)
    return len(body) + CHECKSUM, checksum


def content_size(frame: bytes) -> int | None:
    """How many bytes a zstd frame says that it holds; None if it does not say it (RFC 8878, 3.1.1.1)."""
    if frame[:4] != ZSTD or len(frame) < 5:
        return None
    single, length = frame[4] >> 5 & 1, CONTENT[frame[4] >> 6]
    length = 1 if single and length == 0 else length
    start = 5 + (1 - single) + DICTIONARY[frame[4] & 3]
    return as_number(frame[start : start + length]) + (256 if length == 2 else 0) if length else None


def as_number(data: bytes) -> int:
    """Bytes as a number, the lowest first."""
    return int.from_bytes(data, "little")


def checksum_of(data: bytes) -> int:
    """The checksum of some bytes."""
    try:
        # A dependency of zarr, which uses it for the same checksums.
        from google_crc32c import value
    except ImportError as error:
        raise ImportError(NEEDS_ZARR) from error
    return value(data)


def _zstd():
    try:
        # A dependency of zarr, which compresses with it.
        from numcodecs.zstd import Zstd
    except ImportError as error:
        raise ImportError(NEEDS_ZARR) from error
    return Zstd(level=0)


META = "zarr.json"
# Stores of other formats are not read.
FORMAT = 4
ANOTHER_FUNCTION = "run is another function"
# Names reserved by zarr or by a store.
RESERVED = ("", ".", "..", META, STORE_GROUP)
MARKS = f"{STORE_GROUP}/marks"
GROUP = {"zarr_format": 3, "node_type": "group", "attributes": {}}
# Arrays of a store hold truth values and numbers, in the names of zarr and NumPy.
NUMBERS = "bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64 complex64 complex128".split()
# A file of metadata has at most this many bytes.
MOST_METADATA = 16_000_000
# Arrays that need more than this many bytes, and more than this many times those of all files, are not read.
MOST_BYTES, MOST_EXPANSION = 16_000_000, 1000
# A sweep that continues computes as many points at a time as its store says, but no more than this.
LONGEST_CHUNK = 1 << 24


def fingerprint(axes: Axes, program: Program, layout: str) -> dict[str, Any]:
    """The properties that two runs must share to use one store, readable where possible."""
    return {
        "format": FORMAT,
        "points": ", ".join(f"{name}: {n}" for name, n in axes.dims.items()),
        "axes": {name: of_axis(x) for name, x in axes.values.items()},
        "values": {name: f"{x.dtype}{list(x.shape)}" for name, x in named_leaves(program.values)},
        "chunk": program.chunk,
        "layout": layout,
        "program": program.digest,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """The versions of the packages that write a store."""
    return {name: version(name) for name in ("lagjax", "jax", "diffrax")}


def in_words(of_versions: dict[str, str]) -> str:
    """Versions as text."""
    return ", ".join(f"{name} {number}" for name, number in of_versions.items())


def of_axis(x: np.ndarray) -> str:
    """The dtype and shape of an axis and a digest of its values."""
    return f"{x.dtype}{list(x.shape)} {digest(x.tobytes())}"


def check_file_names(kind: str, names: Iterable[str]) -> None:
    """Raise `ValueError` for names that cannot be folder names in a store."""
    for name in names:
        reserved = name in RESERVED or name.startswith("__") or "/" in name or "\\" in name
        if reserved or not name.isprintable() or PureWindowsPath(name).anchor:
            raise ValueError(
                f"{kind} '{printable(name)}' cannot be kept in a store: it is reserved or not a valid folder name.\n"
                "Fix: another key, of letters, digits and underscores."
            )


def differences(there: dict, here: dict, under: str = "") -> list[str]:
    """The differences between two fingerprints, one line each."""
    found = []
    for key in dict.fromkeys((*there, *here)):
        a, b, name = there.get(key), here.get(key), f"{under}{key}"
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, f"{name} ")
        elif name == "program" and a != b:
            found.append(ANOTHER_FUNCTION)
        elif (
            a != b and under == "axes " and isinstance(a, str) and isinstance(b, str) and a.split()[:1] == b.split()[:1]
        ):
            found.append(f"axis '{key}' has other values")
        elif a != b:
            found.append(f"{name}: {a} there, {b} here")
    return found


class Described(NamedTuple):
    """What a description says, checked: the arrays by their places, and the blocks of the grid."""

    arrays: dict[str, Spec]
    blocks: Blocks


def description_at(path: Path) -> tuple[dict[str, Any], Described]:
    """The description of a store, and what it says.

    **Raises:** `ValueError` if there is no such store, or its description is damaged or not as lagjax writes it.
    """
    if not path.exists():
        raise ValueError(f"there is no {path}.\nFix: the path that was passed to lj.sweep as store=.")
    file = path / STORE_GROUP / META
    if not file.exists() and not (path / MARKS).exists():
        raise ValueError(
            f"{path} exists, but is not the store of a sweep that this version reads.\n"
            "Usual cause: another folder; or a store of lagjax 0.1.\n"
            "Fix: another path, or remove it if it is not needed."
        )
    try:
        description = _read_metadata(file)["attributes"]["lagjax"]
        _require(description["digest"] == digest_of(description), "its digest is that of another")
    except (OSError, ValueError, *MALFORMED) as error:
        raise ValueError(
            f"{file} is damaged: the sweep of this store is unknown.\n"
            "Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: copy that file again from the original; or remove {path} and compute it again."
        ) from error
    try:
        number = description["fingerprint"]["format"]
        if type(number) is int and number > FORMAT:
            raise ValueError(
                f"it was written by lagjax {description['fingerprint']['versions']['lagjax']!r:.20}, which is newer.\n"
                "Fix: pip install -U lagjax."
            )
        if number != FORMAT:
            raise ValueError(
                f"its format is {number!r:.20}, not {FORMAT}.\n"
                "Usual cause: an earlier lagjax wrote it.\nFix: compute it again, or read it with that version."
            )
        return description, checked(description)
    except (ValueError, *MALFORMED) as error:
        why = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {printable(error)[:200]}"
        raise ValueError(by_line(f"{path} cannot be read: {why}")) from error


def digest_of(description: dict) -> str:
    """The digest of a store's description, without the digest itself."""
    return digest(json.dumps({key: x for key, x in description.items() if key != "digest"}, sort_keys=True).encode())


def checked(description: dict[str, Any]) -> Described:
    """Check a description.

    **Raises:** `ValueError`, or what Python raises for missing or malformed parts, if it is not as `create` makes it.
    """
    said, places, names, dims = (description[name] for name in ("fingerprint", "places", "names", "dims"))
    texts = [*names, *said["values"], said["layout"], said["program"], said["points"], *said["versions"]]
    texts += [*said["versions"].values(), *said["axes"].values(), *description["times"], *sum(dims.values(), [])]
    _require(all(isinstance(x, str) and x.isprintable() for x in texts), "its names are not text")
    _require(isinstance(description["paired"], bool) and len(set(names)) == len(names) > 0, "its axes have no names")
    _require(set(said["axes"]) == set(names), "its axes have other names")

    arrays = {}

    def add(
        place: str,
        of_axes: tuple[int, ...],
        inner: tuple[int, ...],
        dtype: np.dtype,
        fill: float,
        chunk: tuple[int, ...] | None = None,
    ):
        shape = *of_axes, *inner
        chunk = (*(chunk or of_axes), *(max(1, n) for n in inner))
        _require(_is_inside(place) and place not in arrays, f"two arrays are at {place}")
        _require(len(dims[place]) == len(shape), f"{place} has no names of its dimensions")
        arrays[place] = Spec(shape, chunk, dtype, fill, dims[place])

    axes = [_dtype_and_shape(said["axes"][name]) for name in names]
    _require(all(shape and shape[0] > 0 for _, shape in axes), "an axis is empty")
    for name, (dtype, shape) in zip(names, axes):
        add(places["axes"][name], shape[:1], shape[1:], dtype, nothing(dtype))
    lengths = tuple(shape[0] for _, shape in axes)
    _require(not description["paired"] or len(set(lengths)) == 1, "paired axes have different lengths")
    blocks = Blocks(lengths[:1] if description["paired"] else lengths, tuple(description["block"]))
    shape, block = blocks
    _require(type(said["chunk"]) is int, "its chunk length is not a number")
    _require(0 < said["chunk"] <= max(LONGEST_CHUNK, math.prod(shape)), "its chunks are empty or too long")
    _require(len(block) == len(shape), "its blocks have another number of axes")
    _require(all(type(k) is int and 0 < k <= n for n, k in zip(shape, block)), "its blocks are empty or too long")
    splits = (all(k == 1 for k in block[:i]) and block[i + 1 :] == shape[i + 1 :] for i in range(len(shape)))
    _require(any(splits), "its blocks are not in the order of its points")
    values = {name: _dtype_and_shape(words) for name, words in said["values"].items()}
    for name, (dtype, inner) in values.items():
        add(places["values"][name], shape, inner, dtype, nothing(dtype), block)
    for name, dtype, fill in zip(Status._fields, STATUS_TYPES, (NOT_RUN, 0, np.nan, np.nan)):
        add(places["status"][name], shape, (), dtype, fill, block)
    for place, name in description["times"].items():
        add(place, (), values[name][1], values[name][0], nothing(values[name][0]))
    _require(MARKS not in arrays and {*arrays} == {*dims}, "it names other arrays")
    marks = (len(values) + len(Status._fields), 2)
    arrays[MARKS] = Spec((len(blocks), *marks), (1, *marks), np.dtype("uint64"), 0, None, compressed=False)
    return Described(arrays, blocks)


def _dtype_and_shape(words: str):
    """The dtype and shape at the beginning of words such as "float64[2, 3]"."""
    found = re.match(r"(\w+)\[([\d, ]*)\]", words)
    if found is None or found[1] not in NUMBERS:
        raise ValueError("an array does not hold numbers.")
    dtype, shape = np.dtype(found[1]), tuple(int(n) for n in found[2].split(", ") if found[2])
    _require(words.startswith(f"{dtype}{list(shape)}"), "an array has no shape")
    return dtype, shape


def _is_inside(name: str):
    """True for the name of an array that stays inside its store; raises `ValueError` for any other."""
    parts = name.split("/")
    inside = not PureWindowsPath(name).anchor and "\\" not in name and name.isprintable() and len(name) < 1000
    _require(inside and not {"", ".", "..", META} & {*parts}, f"the array {name!r:.80} is not inside of it")
    return True


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise ValueError(f"{otherwise}.")


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


def check_room(path: Path, described: Described, size: int) -> None:
    """Raise `ValueError` if the arrays need far more memory than the files of a store, `size` bytes, can hold."""
    needed = sum(spec.bytes for spec in described.arrays.values())
    if needed > MOST_BYTES and needed > MOST_EXPANSION * size:
        raise Explained(
            f"the arrays of {path} need {needed / 1e9:.3g} GB, and its files have {size / 1e9:.3g} GB.\n"
            "Usual cause: a sweep of which hardly anything has been computed; or a store that was changed.\n"
            "Fix: lj.sweep(run, axes, store=path), which computes what is missing."
        )


def create(
    path: Path,
    axes: Axes,
    program: Program,
    fingerprint: dict,
    blocks: Blocks,
    times: dict[str, np.ndarray],
    structure: dict | None,
) -> None:
    """Make a store; if another process was first, its store is kept. A failure leaves nothing behind.

    `times`: the times of trajectories that all points share, by leaf. `structure`: the description of the values
    (`structures`).
    """
    made = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    try:
        description = {"fingerprint": fingerprint, "block": blocks.block, "names": list(axes.values)}
        description |= {"paired": axes.paired, "structure": structure} | _places(axes, program, times)
        description = json.loads(json.dumps(description))
        description["digest"] = digest_of(description)
        arrays, texts = checked(description).arrays, _metadata_of(description)
        if max(map(len, texts.values())) > MOST_METADATA:
            raise ValueError(
                f"run returns {len(fingerprint['values']):,} arrays, whose description is longer than a store's may be."
                "\nFix: return fewer and larger arrays."
            )
        temporary.mkdir()
        for name, text in texts.items():
            _write(temporary / name / META, text)
        whole = {description["places"]["axes"][name]: x for name, x in axes.values.items()}
        whole |= {place: times[key] for place, key in description["times"].items()}
        for place, x in whole.items():
            write_chunk(chunk_file(temporary / place, arrays[place]), arrays[place], x)
        os.rename(temporary, path)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        # Another process was first; the caller checks next whether its store belongs to this sweep.
        if path.exists() and isinstance(error, Exception):
            return
        for folder in made:
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()
        raise


def _places(axes: Axes, program: Program, times: dict[str, np.ndarray]):
    """Where the arrays are, by content, the names of their dimensions, and the times that are coordinates."""
    labels, lead = labels_of(axes, program.values), list(axes.dims)
    places = {"axes": {name: label.name for name, label in labels.axes.items()}, "values": {}}
    places["status"] = {name: label.name for name, label in labels.status.items()}
    dims = {label.name: list(label.dims) for label in labels.axes.values()}
    dims |= dict.fromkeys(places["status"].values(), lead)
    shared = {}
    for key, x in named_leaves(program.values):
        if str(x.dtype) not in NUMBERS:
            raise TypeError(
                f"the value '{key}' is {x.dtype}, which zarr cannot store.\nFix: return it as jnp.float32(...)."
            )
        label, inner = labels.values.get(key), [f"{STORE_GROUP}_{i}" for i in range(len(x.shape))]
        if label is not None and key in times:
            # The points still store their own times, so that values are read back exactly as computed.
            shared[label.dims[-1]], dims[label.dims[-1]] = key, [label.dims[-1]]
            label = None
        place = _hidden_name(key, places["values"].values()) if label is None else label.name
        places["values"][key], dims[place] = place, [*lead, *(inner if label is None else label.dims)]
    return {"places": places, "dims": dims, "times": shared}


def _hidden_name(key: str, taken: Iterable[str]):
    name = f"{STORE_GROUP}/values/{key.replace('/', '_')}"
    while name in taken:
        name += "_"
    return name


def _metadata_of(description: dict[str, Any]):
    """The text of the `zarr.json` of every group and array of a store, by place."""
    status = {place: status_attributes(name) for name, place in description["places"]["status"].items()}
    arrays = {place: spec.metadata(status.get(place, {})) for place, spec in checked(description).arrays.items()}
    # Of the axes, xarray knows as coordinates those that are named like their dimension.
    axes, dims = description["places"]["axes"].values(), description["dims"]
    attributes = {"about": "a sweep, which lagjax.open_sweep reads with its checksums"}
    if others := [place for place in axes if dims[place] != [place]]:
        attributes["coordinates"] = " ".join(others)
    # xarray reads these instead of the metadata of each array.
    shown = {place: x for place, x in arrays.items() if not place.startswith(f"{STORE_GROUP}/")}
    consolidated = {"kind": "inline", "must_understand": False, "metadata": shown}
    groups = {"": GROUP | {"attributes": attributes, "consolidated_metadata": consolidated}}
    groups[STORE_GROUP] = GROUP | {"attributes": {"lagjax": description}}
    groups[f"{STORE_GROUP}/values"] = GROUP
    return {place: json.dumps(x, indent=2) for place, x in (groups | arrays).items()}


def damaged(path: Path, description: dict[str, Any]) -> dict[str, str]:
    """The places in a store whose `zarr.json` is damaged or missing, each with a line about it."""
    found = {}
    for place, text in _metadata_of(description).items():
        file = path / place / META
        try:
            intact = place == STORE_GROUP or _holds(_read_metadata(file), json.loads(text))
        except (OSError, ValueError, *MALFORMED):
            intact = False
        if not intact:
            found[place] = f"{file} was {'damaged' if file.exists() else 'missing'}"
    return found


def _holds(found: Any, expected: Any):
    """Whether metadata are unchanged; users may add attributes and consolidate more arrays."""
    if not isinstance(expected, dict):
        return found == expected
    return all(key == "attributes" or _holds(found[key], x) for key, x in expected.items())


def restore(path: Path, description: dict[str, Any]) -> list[str]:
    """Write each `zarr.json` again that is damaged or missing; returns a line about each.

    **Raises:** `ValueError` if they cannot be written.
    """
    found, texts = damaged(path, description), _metadata_of(description)
    for place, line in found.items():
        try:
            _write(path / place / META, texts[place])
        except OSError as error:
            raise ValueError(f"{line}, and cannot be restored: {error.strerror}.") from error
    return list(found.values())


def _read_metadata(file: Path):
    if file.stat().st_size > MOST_METADATA:
        raise ValueError(f"{file} is longer than {MOST_METADATA:,} bytes.")
    return parsed(file.read_bytes(), MOST_METADATA)


def _write(file: Path, text: str):
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{uuid.uuid4().hex[:8]}.partial")
    partial.write_text(text)
    partial.replace(file)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary folders of processes that were killed while they made this store."""
    leftover = re.compile(re.escape(f".{path.name}.") + "[0-9a-f]{8}")
    for other in path.parent.iterdir():
        if leftover.fullmatch(other.name):
            shutil.rmtree(other, ignore_errors=True)
