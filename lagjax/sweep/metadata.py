"""What a store says of itself, from which the metadata of all of its arrays follow.

The description stands in the attributes of the group `lagjax`, with a digest: the fingerprint of the sweep, its blocks,
and the places of its arrays. What zarr and xarray need, a `zarr.json` for each array, zarr makes from it; lagjax reads
none of them, and a sweep that continues writes them again where they are damaged. Of several processes that begin a
store at the same time one writes the description, last of all: there the store begins, for all of them. The
fingerprint, of axes, values, program and versions, is what two runs must share to use one store.

A store may come from anyone, and opening it writes nothing:

- it consists of folders and files, without links, and its names stay inside of it;
- every shape follows from those of the axes, so that no other number decides how much memory is taken; and arrays that
  would need far more memory than the files hold are not read.
"""

import json
import math
import re
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from lagjax.display import by_line, printable
from lagjax.files import MALFORMED, Explained, parsed
from lagjax.sweep.axes import Axes, Blocks
from lagjax.sweep.engine import NOT_RUN, STATUS_TYPES, Program, Status, digest, nothing
from lagjax.sweep.labels import STORE_GROUP, labels_of, named_leaves, status_attributes
from lagjax.sweep.objects import Encoder, Files, Spec, consolidated, needed

META = "zarr.json"
# Stores of other formats are not read.
FORMAT = 4
ANOTHER_FUNCTION = "run is another function"
# Names reserved by zarr or by a store.
RESERVED = ("", ".", "..", META, STORE_GROUP)
MARKS = f"{STORE_GROUP}/marks"
DESCRIPTION = f"{STORE_GROUP}/{META}"
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


def is_begun(sizes: dict[str, int]) -> bool:
    """Whether there is a store, or anything else, among these files; not what a process left that began one."""
    of_marks = [name for name in sizes if name.startswith(f"{MARKS}/")]
    return bool(sizes) and (DESCRIPTION in sizes or of_marks != [f"{MARKS}/{META}"])


def description_at(files: Files, sizes: dict[str, int]) -> tuple[dict[str, Any], Described]:
    """The description of a store, and what it says; `sizes` are those of its files.

    **Raises:** `ValueError` if there is no such store, or its description is damaged or not as lagjax writes it.
    """
    place = files.place
    if not sizes:
        raise ValueError(f"there is no {place}.\nFix: the path that was passed to lj.sweep as store=.")
    if DESCRIPTION not in sizes and not any(name.startswith(f"{MARKS}/") for name in sizes):
        raise ValueError(
            f"{place} exists, but is not the store of a sweep that this version reads.\n"
            "Usual cause: another folder; or a store of lagjax 0.1.\n"
            "Fix: another path, or remove it if it is not needed."
        )
    try:
        if sizes[DESCRIPTION] > MOST_METADATA:
            raise ValueError("it is too long.")
        content = files.read([DESCRIPTION])[DESCRIPTION]
        description = parsed(content, MOST_METADATA)["attributes"]["lagjax"]
        _require(description["digest"] == digest_of(description), "its digest is that of another")
    except (OSError, ValueError, *MALFORMED) as error:
        raise ValueError(
            f"{files.at(DESCRIPTION)} is damaged: the sweep of this store is unknown.\n"
            "Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: copy that file again from the original; or remove {place} and compute it again."
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
        raise ValueError(by_line(f"{place} cannot be read: {why}")) from error


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


def check_room(place: object, described: Described, size: int) -> None:
    """Raise `ValueError` if the arrays need far more memory than the files of a store, `size` bytes, can hold."""
    needed = sum(spec.bytes for spec in described.arrays.values())
    if needed > MOST_BYTES and needed > MOST_EXPANSION * size:
        raise Explained(
            f"the arrays of {place} need {needed / 1e9:.3g} GB, and its files have {size / 1e9:.3g} GB.\n"
            "Usual cause: a sweep of which hardly anything has been computed; or a store that was changed.\n"
            "Fix: lj.sweep(run, axes, store=path), which computes what is missing."
        )


def create(
    files: Files,
    axes: Axes,
    program: Program,
    fingerprint: dict,
    blocks: Blocks,
    times: dict[str, np.ndarray],
    structure: dict | None,
) -> None:
    """Make a store; if another process was first, its description is kept.

    `times`: the times of trajectories that all points share, by leaf. `structure`: the description of the values
    (`structures`).
    """
    description = {"fingerprint": fingerprint, "block": blocks.block, "names": list(axes.values)}
    description |= {"paired": axes.paired, "structure": structure} | _places(axes, program, times)
    description = json.loads(json.dumps(description))
    description["digest"] = digest_of(description)
    arrays, texts = checked(description).arrays, metadata_of(description)
    if max(map(len, texts.values())) > MOST_METADATA:
        raise ValueError(
            f"run returns {len(fingerprint['values']):,} arrays, whose description is longer than a store's may be."
            "\nFix: return fewer and larger arrays."
        )
    whole = {description["places"]["axes"][name]: x for name, x in axes.values.items()}
    whole |= {place: times[key] for place, key in description["times"].items()}
    begun = texts.pop(DESCRIPTION)
    # First what tells it from the folder of anything else (`is_begun`).
    files.write({f"{MARKS}/{META}": texts.pop(f"{MARKS}/{META}")})
    files.write(texts | axis_files(arrays, whole))
    files.write_once(DESCRIPTION, begun)


def axis_files(arrays: dict[str, Spec], whole: dict[str, np.ndarray]) -> dict[str, bytes]:
    """The files of arrays of one chunk each, given by the places of the arrays."""
    given = {place: (arrays[place], x) for place, x in whole.items() if arrays[place].key()}
    return {f"{place}/{spec.key()}": Encoder(spec)((0,) * x.ndim, x) for place, (spec, x) in given.items()}


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


def metadata_of(description: dict[str, Any]) -> dict[str, bytes]:
    """The `zarr.json` of every group and array of a store, by their names, as zarr makes them."""
    status = {place: status_attributes(name) for name, place in description["places"]["status"].items()}
    arrays, zarr, files = checked(description).arrays, needed(), {}
    # Of the axes, xarray knows as coordinates those that are named like their dimension.
    axes, dims = description["places"]["axes"].values(), description["dims"]
    attributes = {"about": "a sweep, which lagjax.open_sweep reads with its checksums"}
    if others := [place for place in axes if dims[place] != [place]]:
        attributes["coordinates"] = " ".join(others)
    store = zarr.storage.MemoryStore(files)
    zarr.create_group(store, attributes=attributes)
    hidden = {place: spec for place, spec in arrays.items() if place.startswith(f"{STORE_GROUP}/")}
    for place, spec in arrays.items():
        if place not in hidden:
            spec.made(files, place, status.get(place))
    # xarray reads these instead of the metadata of each array.
    consolidated(files)
    zarr.create_group(store, path=STORE_GROUP, attributes={"lagjax": description})
    zarr.create_group(store, path=f"{STORE_GROUP}/values")
    for place, spec in hidden.items():
        spec.made(files, place)
    return {name: content.to_bytes() for name, content in files.items()}


def damaged(files: Files, sizes: dict[str, int], texts: dict[str, bytes]) -> dict[str, str]:
    """The names of the `zarr.json` in a store that are damaged or missing, each with a line about it."""
    contents = files.read(name for name in texts if name in sizes and sizes[name] <= MOST_METADATA)
    found = {}
    for name, text in texts.items():
        try:
            intact = name == DESCRIPTION or _holds(parsed(contents[name], MOST_METADATA), json.loads(text))
        except (ValueError, *MALFORMED):
            intact = False
        if not intact:
            found[name] = f"{files.at(name)} was {'damaged' if name in sizes else 'missing'}"
    return found


def _holds(found: Any, expected: Any):
    """Whether metadata are unchanged; users may add attributes and consolidate more arrays."""
    if not isinstance(expected, dict):
        return found == expected
    return all(key == "attributes" or _holds(found[key], x) for key, x in expected.items())


def restore(files: Files, sizes: dict[str, int], texts: dict[str, bytes]) -> list[str]:
    """Write each `zarr.json` again that is damaged or missing; returns a line about each.

    **Raises:** `ValueError` if they cannot be written.
    """
    found = damaged(files, sizes, texts)
    for name, line in found.items():
        try:
            files.write({name: texts[name]})
        except OSError as error:
            raise ValueError(f"{line}, and cannot be restored: {error.strerror}.") from error
    return list(found.values())
