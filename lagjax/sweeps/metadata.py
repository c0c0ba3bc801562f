"""The description of a store, kept twice: making a store, opening it, and restoring damaged metadata.

Zarr describes each array in a `zarr.json` of its own. The description of a store contains copies of all of them and the
fingerprint of its sweep. It is kept in the attributes of the group `lagjax` and of its array of marks. A store is made
under a temporary name and then renamed, so that several processes may open it at the same time. What a description says
is checked before it is used (`described`), and only a sweep that continues restores metadata: opening never writes.
"""

import json
import os
import re
import shutil
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from lagjax.mechanics.files import MALFORMED, parsed
from lagjax.mechanics.printable import by_line, printable
from lagjax.sweeps.axes import Axes
from lagjax.sweeps.described import MARKS, checked
from lagjax.sweeps.fingerprint import FORMAT, digest, named_leaves
from lagjax.sweeps.grids import Blocks
from lagjax.sweeps.labels import STORE_GROUP, labels_of, status_attributes
from lagjax.sweeps.lanes import NOT_RUN, STATUS_TYPES, Program, Status

META = "zarr.json"
# Metadata have at most this many bytes.
MOST_METADATA = 16_000_000
GROUP = {"zarr_format": 3, "node_type": "group"}
# The dimensions of an array without a label.
HIDDEN_DIMENSION = "lagjax_{}"


def import_zarr():
    """Import zarr, or say how to get it."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            'stores need zarr, which is an optional extra.\nFix: pip install "lagjax[data]", or leave store out.'
        ) from error
    return zarr


def about(path: Path) -> dict[str, Any]:
    """The description of a store, from the first of its two copies that is intact.

    **Raises:** `ValueError` if there is no such store, no intact copy, or one that is not as lagjax writes it.
    """
    if not path.exists():
        raise ValueError(f"there is no {path}.\nFix: the path that was passed to lj.sweep as store=.")
    copies = [path / STORE_GROUP, path / MARKS]
    if not any((folder / META).exists() for folder in copies) and not copies[1].exists():
        if (path / "done").exists():
            _raise_earlier(path, "an earlier format")
        raise ValueError(
            f"{path} exists, but is not the store of a sweep.\nFix: another path, or remove it if it is not needed."
        )
    description = next((found for found in map(_read_description, copies) if found is not None), None)
    if description is None:
        one, other = (folder / META for folder in copies)
        raise ValueError(
            f"{one} and {other} are both damaged: the sweep of this store is unknown.\n"
            f"Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: copy one of the two files again from the original; or remove {path} and compute it again."
        )
    try:
        number = description["fingerprint"]["format"]
        if type(number) is int and number > FORMAT:
            raise ValueError(
                f"it was written by lagjax {description['fingerprint']['versions']['lagjax']!r:.20}, which is newer.\n"
                "Fix: pip install -U lagjax."
            )
        if number != FORMAT:
            raise ValueError(f"its format is {number!r:.20}, not {FORMAT}.")
        return description | {"checked": checked(description)}
    except (ValueError, *MALFORMED) as error:
        why = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {printable(error)[:200]}"
        raise ValueError(by_line(f"{path} cannot be read: {why}")) from error


def _raise_earlier(path, which):
    raise ValueError(
        f"{path} is a store in {which}, of lagjax 0.1, which this version does not read.\n"
        'Fix: compute it again; or read it with that version, pip install "lagjax<0.3", and save what you need of it.'
    )


def _read_description(folder):
    try:
        description = read_metadata(folder / META)["attributes"]["lagjax"]
        return description if description["digest"] == digest_of(description) else None
    except (OSError, ValueError, *MALFORMED):
        return None


def read_metadata(file: Path) -> Any:
    """What a file of metadata says.

    **Raises:** `OSError` or `ValueError` if it cannot be read.
    """
    if file.stat().st_size > MOST_METADATA:
        raise ValueError(f"{file} is longer than {MOST_METADATA:,} bytes.")
    return parsed(file.read_bytes(), MOST_METADATA)


def digest_of(description: dict) -> str:
    """The digest of a store's description, without the digest itself."""
    return digest(json.dumps({key: x for key, x in description.items() if key != "digest"}, sort_keys=True).encode())


def damaged(path: Path, description: dict[str, Any]) -> dict[str, str]:
    """The groups and arrays of a store whose metadata are damaged or missing, each with a line about it."""
    found = {}
    for name, expected in _expected_metadata(description).items():
        file = path / name / META
        if not _is_as_expected(file, expected):
            found[name] = f"{file} was {'damaged' if file.exists() else 'missing'}"
    return found


def restore(path: Path, description: dict[str, Any]) -> list[str]:
    """Restore damaged metadata; returns a line about each file that was damaged or missing.

    **Raises:** `ValueError` if they cannot be restored.
    """
    found, expected = damaged(path, description), _expected_metadata(description)
    for name, line in found.items():
        try:
            _write(path / name / META, expected[name])
        except OSError as error:
            raise ValueError(f"{line}, and cannot be restored: {error.strerror}.") from error
    return list(found.values())


def _expected_metadata(description):
    """The expected metadata of every group and array of a store, by name."""
    written = {key: x for key, x in description.items() if key != "checked"}
    arrays, own_attribute = description["arrays"], {"attributes": {"lagjax": written}}
    inside = {name for array in arrays for name in _folders(array)}
    groups = {name: GROUP for name in sorted(inside)} | {STORE_GROUP: GROUP | own_attribute}
    # xarray reads these instead of the metadata of each array.
    shown = {name: x for name, x in arrays.items() if not name.startswith(f"{STORE_GROUP}/")}
    consolidated = {"kind": "inline", "must_understand": False, "metadata": shown}
    root = GROUP | {"attributes": description["attributes"], "consolidated_metadata": consolidated}
    return {"": root} | groups | arrays | {MARKS: arrays[MARKS] | own_attribute}


def _folders(name):
    parts = name.split("/")[:-1]
    return ["/".join(parts[: i + 1]) for i in range(len(parts))]


def _is_as_expected(file, expected):
    """Whether metadata are unchanged; users may add attributes and consolidate more arrays."""
    try:
        found = read_metadata(file)
        mutable = {"attributes", "consolidated_metadata"}
        same = all(found.get(key) == x for key, x in expected.items() if key not in mutable)
        if not same or "lagjax" in expected.get("attributes", {}) and _read_description(file.parent) is None:
            return False
        if "consolidated_metadata" in expected:
            metadata = found["consolidated_metadata"]["metadata"]
            return all(
                metadata[name].get(key) == x
                for name, array in expected["consolidated_metadata"]["metadata"].items()
                for key, x in array.items()
                if key != "attributes"
            )
        return True
    except (OSError, ValueError, *MALFORMED):
        return False


def _write(file, metadata):
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{uuid.uuid4().hex[:8]}.partial")
    partial.write_text(json.dumps({"attributes": {}} | metadata, indent=2))
    partial.replace(file)


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
    zarr = import_zarr()
    made = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    try:
        group = zarr.create_group(str(temporary))
        places, coordinates = _create_arrays(zarr, group, axes, program, blocks, times)
        names = [str(file.parent.relative_to(temporary).as_posix()) for file in temporary.rglob(META)]
        arrays = {name: json.loads((temporary / name / META).read_text()) for name in sorted(names)}
        description = {
            "fingerprint": fingerprint,
            "block": blocks.block,
            "names": list(axes.values),
            "paired": axes.paired,
            "places": places,
            "structure": structure,
            "attributes": {"about": "a sweep, which lagjax.open_sweep reads with its checksums"},
            "arrays": {name: metadata for name, metadata in arrays.items() if metadata["node_type"] == "array"},
        }
        if coordinates:
            description["attributes"]["coordinates"] = " ".join(coordinates)
        description = json.loads(json.dumps(description))
        description["digest"] = digest_of(description)
        checked(description)
        _check_length(description)
        for name, metadata in _expected_metadata(description).items():
            _write(temporary / name / META, metadata)
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


def _check_length(description):
    # Metadata contain the description once, and copies of all arrays with line ends and spaces.
    if 4 * len(json.dumps(description)) > MOST_METADATA:
        raise ValueError(
            f"run returns {len(description['arrays']):,} arrays, whose description is longer than a store's may be.\n"
            "Fix: return fewer and larger arrays."
        )


def _create_arrays(zarr, group, axes, program, blocks, times):
    """(the paths of the arrays by content, the names of the coordinates that are not dimensions)."""
    codecs = [zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec()]
    labels, lead = labels_of(axes, program.values), list(axes.dims)
    for name, x in axes.values.items():
        label = labels.axes[name]
        group.create_array(label.name, data=x, dimension_names=list(label.dims), compressors=codecs)
    coordinates = [label.name for label in labels.axes.values() if label.dims != (label.name,)]
    places = {"axes": {name: label.name for name, label in labels.axes.items()}, "values": {}, "marks": MARKS}
    leaves = named_leaves(program.values)
    for key, x in leaves:
        if x.dtype.kind == "V":
            raise TypeError(
                f"the value '{key}' is {x.dtype}, which zarr cannot store.\nFix: return it as jnp.float32(...)."
            )
        label = labels.values.get(key)
        if label is not None and key in times:
            # The points still store their own times, so that values are read back exactly as computed.
            t = label.dims[-1]
            group.create_array(t, data=times[key], dimension_names=[t], compressors=codecs)
            label = None
        inner = [HIDDEN_DIMENSION.format(i) for i in range(len(x.shape))] if label is None else list(label.dims)
        places["values"][key] = _hidden_name(key, places["values"].values()) if label is None else label.name
        group.create_array(
            places["values"][key], shape=(*blocks.shape, *x.shape), dtype=x.dtype,
            chunks=(*blocks.block, *(max(1, n) for n in x.shape)),
            fill_value=np.nan if np.issubdtype(x.dtype, np.inexact) else 0,
            dimension_names=[*lead, *inner], compressors=codecs,
        )  # fmt: skip
    for name, dtype, fill in zip(Status._fields, STATUS_TYPES, (NOT_RUN, 0, np.nan, np.nan)):
        group.create_array(
            labels.status[name].name, shape=blocks.shape, chunks=blocks.block, dtype=dtype, fill_value=fill,
            dimension_names=lead, compressors=codecs, attributes=status_attributes(name),
        )  # fmt: skip
    places["status"] = {name: label.name for name, label in labels.status.items()}
    files = len(leaves) + len(Status._fields)
    group.create_array(
        MARKS, shape=(len(blocks), files, 2), chunks=(1, files, 2), dtype="uint64", fill_value=0,
        compressors=codecs[-1:],
    )  # fmt: skip
    return places, coordinates


def _hidden_name(key, taken):
    name = f"{STORE_GROUP}/values/{key.replace('/', '_')}"
    while name in taken:
        name += "_"
    return name


def remove_leftovers(path: Path) -> None:
    """Remove the temporary folders of processes that were killed while they made this store."""
    leftover = re.compile(re.escape(f".{path.name}.") + "[0-9a-f]{8}")
    for other in path.parent.iterdir():
        if leftover.fullmatch(other.name):
            shutil.rmtree(other, ignore_errors=True)
