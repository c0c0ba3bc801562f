"""The description of a store, kept twice: making a store, opening it, and restoring damaged metadata.

Zarr describes each array in a `zarr.json` of its own. The description of a store contains copies of all of them and the
fingerprint of its sweep. It is kept in the attributes of the group `lagjax` and of its array of marks. A store is made
under a temporary name and then renamed, so that several processes may open it at the same time.
"""

import json
import os
import re
import shutil
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from lagjax.sweeps.axes import Axes
from lagjax.sweeps.earlier import brought_up_to_date
from lagjax.sweeps.fingerprint import FORMAT, digest, named_leaves
from lagjax.sweeps.grids import Blocks
from lagjax.sweeps.labels import STORE_GROUP, labels_of, status_attributes
from lagjax.sweeps.lanes import NOT_RUN, STATUS_TYPES, Program, Status

META = "zarr.json"
MARKS = f"{STORE_GROUP}/marks"
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
    """The description of a store in today's terms, from the first of its two copies that is intact.

    **Raises:** `ValueError` if there is no such store or no intact copy.
    """
    if not path.exists():
        raise ValueError(f"there is no {path}.\nFix: the path that was passed to lj.sweep as store=.")
    is_current = (path / STORE_GROUP / META).exists() or (path / MARKS).exists()
    copies = [path / STORE_GROUP, path / MARKS] if is_current else [path, path / "done"]
    for folder in copies:
        description = _read_description(folder / META)
        if description is not None:
            break
    else:
        if not is_current and not (path / "status").exists():
            raise ValueError(
                f"{path} exists, but is not the store of a sweep.\nFix: another path, or remove it if it is not needed."
            )
        one, other = (folder / META for folder in copies)
        raise ValueError(
            f"{one} and {other} are both damaged: the sweep of this store is unknown.\n"
            f"Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: copy one of the two files again from the original; or remove {path} and compute it again."
        )
    if description["fingerprint"]["format"] > FORMAT:
        raise ValueError(
            f"{path} was written by lagjax {description['fingerprint']['versions']['lagjax']}, which is newer.\n"
            "Fix: pip install -U lagjax."
        )
    return brought_up_to_date(description)


def _read_description(file):
    try:
        description = json.loads(file.read_text())["attributes"]["lagjax"]
        # Format 1 has one copy and no digest.
        intact = description["fingerprint"]["format"] == 1 or description["digest"] == digest_of(description)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return description if intact else None


def digest_of(description: dict) -> str:
    """The digest of a store's description, without the digest itself."""
    return digest(json.dumps({key: x for key, x in description.items() if key != "digest"}, sort_keys=True).encode())


def restore(path: Path) -> list[str]:
    """Restore damaged metadata; returns a line about each file that was damaged or missing.

    **Raises:** `ValueError` if they cannot be restored.
    """
    description, restored = about(path), []
    if "arrays" not in description:
        _check_readable(path, description)
        return []
    for name, expected in _expected_metadata(description).items():
        file = path / name / META
        if not _is_as_expected(file, expected):
            restored.append(f"{file} was {'damaged' if file.exists() else 'missing'}")
            try:
                _write(file, expected)
            except OSError as error:
                raise ValueError(f"{restored[-1]}, and cannot be restored: {error.strerror}.") from error
    return restored


def _expected_metadata(description):
    """The expected metadata of every group and array of a store, by name."""
    arrays, own_attribute = description["arrays"], {"attributes": {"lagjax": description["as_written"]}}
    if description["fingerprint"]["format"] < FORMAT:
        groups = {name: GROUP for name in ("", "axes", "values", "status")}
        return groups | {"": GROUP | own_attribute} | arrays | {"done": arrays["done"] | own_attribute}
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
        found = json.loads(file.read_text())
        mutable = {"attributes", "consolidated_metadata"}
        same = all(found.get(key) == x for key, x in expected.items() if key not in mutable)
        if not same or "lagjax" in expected.get("attributes", {}) and _read_description(file) is None:
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
    except (OSError, ValueError, AttributeError, KeyError, TypeError):
        return False


def _write(file, metadata):
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{uuid.uuid4().hex[:8]}.partial")
    partial.write_text(json.dumps({"attributes": {}} | metadata, indent=2))
    partial.replace(file)


def _check_readable(path, description):
    """Check the metadata of a store of format 1, which has no copies of them."""
    places = description["places"]
    names = [*places["axes"].values(), *places["values"].values(), *places["status"].values(), places["marks"]]
    for name in names:
        file = path / name / META
        if not _is_as_expected(file, {"zarr_format": 3, "node_type": "array"}):
            how = "damaged" if file.exists() else "missing"
            raise ValueError(
                f"{file} is {how}, and this store, of format 1, has no copy of it.\n"
                "Fix: copy it from the original, or from a store of the same sweep with few points, then enter "
                "this store's 'shape' and 'chunk_shape'."
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
        for name, metadata in _expected_metadata(description | {"as_written": description}).items():
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
