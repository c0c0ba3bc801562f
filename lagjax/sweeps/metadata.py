"""What a store says about itself, kept twice: making a store, opening it, and putting back metadata that are damaged.

Zarr describes each array in a `zarr.json` of its own. All of them stand in what a store says about itself, too, with
what it belongs to: in the attributes of the group `lagjax` and of its array of marks. A store is made under another
name and then renamed, so that several processes may open one at the same time.
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
from lagjax.sweeps.labels import KEPT_FREE, labels_of, status_attributes
from lagjax.sweeps.lanes import NOT_RUN, STATUS_TYPES, Program, Status

META = "zarr.json"
MARKS = f"{KEPT_FREE}/marks"
GROUP = {"zarr_format": 3, "node_type": "group"}
# The dimensions of an array that nothing shows.
UNSEEN = "lagjax_{}"


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
    """What a store says about itself, from the first of its two copies that is whole, in today's words.

    **Raises:** `ValueError` where there is none, in words.
    """
    if not path.exists():
        raise ValueError(f"there is no {path}.\nFix: the path that was given as store= to lj.sweep.")
    of_today = (path / KEPT_FREE / META).exists() or (path / MARKS).exists()
    copies = [path / KEPT_FREE, path / MARKS] if of_today else [path, path / "done"]
    for folder in copies:
        said = _said(folder / META)
        if said is not None:
            break
    else:
        if not of_today and not (path / "status").exists():
            raise ValueError(
                f"{path} exists, and is no store of a sweep.\nFix: another path, or remove it if it is not needed."
            )
        one, other = (folder / META for folder in copies)
        raise ValueError(
            f"{one} and {other} are both damaged: what this store belongs to is not known.\n"
            f"Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: put back one of the two from where it was copied; or remove {path} and compute it again."
        )
    if said["fingerprint"]["format"] > FORMAT:
        raise ValueError(
            f"{path} was written by lagjax {said['fingerprint']['versions']['lagjax']}, which is newer.\n"
            "Fix: pip install -U lagjax."
        )
    return brought_up_to_date(said)


def _said(file):
    try:
        said = json.loads(file.read_text())["attributes"]["lagjax"]
        # Before there were two copies there was no digest.
        whole = said["fingerprint"]["format"] == 1 or said["digest"] == digest_of(said)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return said if whole else None


def digest_of(said: dict) -> str:
    """The digest of what a store says, but for this."""
    return digest(json.dumps({key: x for key, x in said.items() if key != "digest"}, sort_keys=True).encode())


def restore(path: Path) -> list[str]:
    """Put back the metadata that are damaged; returns what they were.

    **Raises:** `ValueError` where that is not possible, in words.
    """
    said, put_back = about(path), []
    if "arrays" not in said:
        _check_readable(path, said)
        return []
    for name, wanted in _wanted(said).items():
        file = path / name / META
        if not _as_wanted(file, wanted):
            put_back.append(f"{file} was {'damaged' if file.exists() else 'missing'}")
            try:
                _write(file, wanted)
            except OSError as error:
                raise ValueError(f"{put_back[-1]}, and cannot be put back: {error.strerror}.") from error
    return put_back


def _wanted(said):
    """The metadata of every group and array of a store, by its name."""
    arrays, itself = said["arrays"], {"attributes": {"lagjax": said["itself"]}}
    if said["fingerprint"]["format"] < FORMAT:
        groups = {name: GROUP for name in ("", "axes", "values", "status")}
        return groups | {"": GROUP | itself} | arrays | {"done": arrays["done"] | itself}
    inside = {name for array in arrays for name in _folders(array)}
    groups = {name: GROUP for name in sorted(inside)} | {KEPT_FREE: GROUP | itself}
    # What xarray reads instead of the metadata of each array.
    shown = {name: x for name, x in arrays.items() if not name.startswith(f"{KEPT_FREE}/")}
    together = {"kind": "inline", "must_understand": False, "metadata": shown}
    whole = GROUP | {"attributes": said["attributes"], "consolidated_metadata": together}
    return {"": whole} | groups | arrays | {MARKS: arrays[MARKS] | itself}


def _folders(name):
    parts = name.split("/")[:-1]
    return ["/".join(parts[: i + 1]) for i in range(len(parts))]


def _as_wanted(file, wanted):
    """Whether metadata are what they were; attributes may be added to them, and more may be consolidated."""
    try:
        there = json.loads(file.read_text())
        both = {"attributes", "consolidated_metadata"}
        alike = all(there.get(key) == x for key, x in wanted.items() if key not in both)
        if not alike or "lagjax" in wanted.get("attributes", {}) and _said(file) is None:
            return False
        if "consolidated_metadata" in wanted:
            metadata = there["consolidated_metadata"]["metadata"]
            return all(
                metadata[name].get(key) == x
                for name, array in wanted["consolidated_metadata"]["metadata"].items()
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


def _check_readable(path, said):
    """Of a store that has no copies of its metadata."""
    places = said["places"]
    names = [*places["axes"].values(), *places["values"].values(), *places["status"].values(), places["marks"]]
    for name in names:
        file = path / name / META
        if not _as_wanted(file, {"zarr_format": 3, "node_type": "array"}):
            how = "damaged" if file.exists() else "missing"
            raise ValueError(
                f"{file} is {how}, and this store, of format 1, has no copy of it.\n"
                "Fix: put it back from where it was copied, or from a store of the same sweep with few points, with "
                "this one's 'shape' and 'chunk_shape'."
            )


def create(
    path: Path,
    axes: Axes,
    program: Program,
    wanted: dict,
    blocks: Blocks,
    times: dict[str, np.ndarray],
    structure: dict | None,
) -> None:
    """Make a store; where another process was first, its own stays. A failure leaves nothing behind.

    `times`: of trajectories, those that all points share, by leaf. `structure`: of values (`structures`).
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
        said = {
            "fingerprint": wanted,
            "block": blocks.block,
            "names": list(axes.values),
            "paired": axes.paired,
            "places": places,
            "structure": structure,
            "attributes": {"about": "a sweep, which lagjax.open_sweep reads with its checksums"},
            "arrays": {name: metadata for name, metadata in arrays.items() if metadata["node_type"] == "array"},
        }
        if coordinates:
            said["attributes"]["coordinates"] = " ".join(coordinates)
        said = json.loads(json.dumps(said))
        said["digest"] = digest_of(said)
        for name, metadata in _wanted(said | {"itself": said}).items():
            _write(temporary / name / META, metadata)
        os.rename(temporary, path)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        # Another process was first; whether its store is of this sweep is seen next.
        if path.exists() and isinstance(error, Exception):
            return
        for folder in made:
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()
        raise


def _create_arrays(zarr, group, axes, program, blocks, times):
    """(the arrays by what they have, the names of those that are coordinates beside the dimensions)."""
    whole = [zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec()]
    labels, lead = labels_of(axes, program.values), list(axes.dims)
    for name, x in axes.values.items():
        label = labels.axes[name]
        group.create_array(label.name, data=x, dimension_names=list(label.dims), compressors=whole)
    coordinates = [label.name for label in labels.axes.values() if label.dims != (label.name,)]
    places = {"axes": {name: label.name for name, label in labels.axes.items()}, "values": {}, "marks": MARKS}
    leaves = named_leaves(program.values)
    for key, x in leaves:
        if x.dtype.kind == "V":
            raise TypeError(
                f"the value '{key}' is {x.dtype}, for which zarr has no place.\nFix: return it as jnp.float32(...)."
            )
        label = labels.values.get(key)
        if label is not None and key in times:
            # Each point has its times all the same: what is read back is what was computed.
            t = label.dims[-1]
            group.create_array(t, data=times[key], dimension_names=[t], compressors=whole)
            label = None
        inner = [UNSEEN.format(i) for i in range(len(x.shape))] if label is None else list(label.dims)
        places["values"][key] = _unseen(key, places["values"].values()) if label is None else label.name
        group.create_array(
            places["values"][key], shape=(*blocks.shape, *x.shape), dtype=x.dtype,
            chunks=(*blocks.block, *(max(1, n) for n in x.shape)),
            fill_value=np.nan if np.issubdtype(x.dtype, np.inexact) else 0,
            dimension_names=[*lead, *inner], compressors=whole,
        )  # fmt: skip
    for name, dtype, fill in zip(Status._fields, STATUS_TYPES, (NOT_RUN, 0, np.nan, np.nan)):
        group.create_array(
            labels.status[name].name, shape=blocks.shape, chunks=blocks.block, dtype=dtype, fill_value=fill,
            dimension_names=lead, compressors=whole, attributes=status_attributes(name),
        )  # fmt: skip
    places["status"] = {name: label.name for name, label in labels.status.items()}
    files = len(leaves) + len(Status._fields)
    group.create_array(
        MARKS, shape=(len(blocks), files, 2), chunks=(1, files, 2), dtype="uint64", fill_value=0,
        compressors=whole[-1:],
    )  # fmt: skip
    return places, coordinates


def _unseen(key, taken):
    name = f"{KEPT_FREE}/values/{key.replace('/', '_')}"
    while name in taken:
        name += "_"
    return name


def remove_leftovers(path: Path) -> None:
    """Remove what processes that were killed while they made this store have left: it is there without them."""
    left = re.compile(re.escape(f".{path.name}.") + "[0-9a-f]{8}")
    for beside in path.parent.iterdir():
        if left.fullmatch(beside.name):
            shutil.rmtree(beside, ignore_errors=True)
