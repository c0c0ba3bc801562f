"""What a store says about itself, kept twice: making a store, opening it, and putting back metadata that are damaged.

Zarr describes each array in a `zarr.json` of its own; all of them stand in the attributes of the group and of `done`
too,
with what the store belongs to. A store is made under another name and then renamed, so that several processes may open
one at the same time.
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
from lagjax.sweeps.fingerprint import FORMAT, digest, named_leaves
from lagjax.sweeps.lanes import NOT_RUN, STATUS_TYPES, Program, Status

DONE, META = "done", "zarr.json"


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
    """What a store says about itself, from the first of its two copies that is whole.

    **Raises:** `ValueError` where there is none, in words.
    """
    if not path.exists():
        raise ValueError(f"there is no {path}.\nFix: the path that was given as store= to lj.sweep.")
    for folder in (path, path / DONE):
        said = _said(folder / META)
        if said is not None:
            break
    else:
        if not (path / "status").exists():
            raise ValueError(
                f"{path} exists, and is no store of a sweep.\nFix: another path, or remove it if it is not needed."
            )
        raise ValueError(
            f"{path / META} and {path / DONE / META} are both damaged: what this store belongs to is not known.\n"
            f"Usual cause: a copy that was cut short, or a disk that failed.\n"
            f"Fix: put back one of the two from where it was copied; or remove {path} and compute it again."
        )
    if said["fingerprint"]["format"] > FORMAT:
        raise ValueError(
            f"{path} was written by lagjax {said['fingerprint']['versions']['lagjax']}, which is newer.\n"
            "Fix: pip install -U lagjax."
        )
    return said


def _said(file):
    try:
        said = json.loads(file.read_text())["attributes"]["lagjax"]
        # Before there were two copies there was no digest.
        whole = said["fingerprint"]["format"] == 1 or said["digest"] == _digest(said)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return said if whole else None


def _digest(said):
    return digest(json.dumps({key: x for key, x in said.items() if key != "digest"}, sort_keys=True).encode())


def restore(path: Path) -> list[str]:
    """Put back the metadata that are damaged; returns what they were.

    **Raises:** `ValueError` where that is not possible, in words.
    """
    said, put_back = about(path), []
    if "arrays" not in said:
        _check_readable(path, said)
        return []
    for name in ("", "axes", "values", "status", *said["arrays"]):
        file = path / name / META
        attributes = {"lagjax": said} if name in ("", DONE) else {}
        wanted = said["arrays"].get(name, {"zarr_format": 3, "node_type": "group"})
        if _as_wanted(file, wanted) and (not attributes or _said(file) is not None):
            continue
        put_back.append(f"{file} was {'damaged' if file.exists() else 'missing'}")
        try:
            file.parent.mkdir(exist_ok=True)
            partial = file.with_suffix(f".{uuid.uuid4().hex[:8]}.partial")
            partial.write_text(json.dumps(wanted | {"attributes": attributes}, indent=2))
            partial.replace(file)
        except OSError as error:
            raise ValueError(f"{put_back[-1]}, and cannot be put back: {error.strerror}.") from error
    return put_back


def _as_wanted(file, wanted):
    """Whether metadata are what they were; attributes may be added to them."""
    try:
        there = json.loads(file.read_text())
        return {key: there.get(key) for key in wanted} == wanted
    except (OSError, ValueError, AttributeError):
        return False


def _check_readable(path, said):
    """Of a store that has no copies of its metadata."""
    names = [f"axes/{name}" for name in said["names"]] + [f"values/{name}" for name in said["fingerprint"]["values"]]
    for name in (*names, *(f"status/{name}" for name in Status._fields), DONE):
        file = path / name / META
        if not _as_wanted(file, {"zarr_format": 3, "node_type": "array"}):
            how = "damaged" if file.exists() else "missing"
            raise ValueError(
                f"{file} is {how}, and this store, of format 1, has no copy of it.\n"
                "Fix: put it back from where it was copied, or from a store of the same sweep with few points, with "
                "this one's 'shape' and 'chunk_shape'."
            )


def create(path: Path, axes: Axes, program: Program, wanted: dict, block: int) -> None:
    """Make a store; where another process was first, its own stays. A failure leaves nothing behind."""
    zarr = import_zarr()
    made = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    try:
        group = zarr.create_group(str(temporary))
        _create_arrays(zarr, group, axes, program, block)
        names = [str(file.parent.relative_to(temporary).as_posix()) for file in temporary.rglob(META)]
        arrays = {name: json.loads((temporary / name / META).read_text()) for name in names}
        for metadata in arrays.values():
            metadata.pop("attributes", None)
        arrays = {name: metadata for name, metadata in arrays.items() if metadata["node_type"] == "array"}
        said = {"fingerprint": wanted, "block": block, "names": list(axes.values), "paired": axes.paired}
        said = json.loads(json.dumps(said | {"arrays": arrays}))
        said["digest"] = _digest(said)
        for node in (group, group[DONE]):
            node.attrs["lagjax"] = said
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


def _create_arrays(zarr, group, axes, program, block):
    whole = [zarr.codecs.ZstdCodec(level=0), zarr.codecs.Crc32cCodec()]
    for name, x in axes.values.items():
        group.create_array(f"axes/{name}", data=x, compressors=whole)
    size, inner = axes.size, lambda n: [f"dim_{i}" for i in range(n)]
    leaves = named_leaves(program.values)
    for name, x in leaves:
        if x.dtype.kind == "V":
            raise TypeError(
                f"the value '{name}' is {x.dtype}, for which zarr has no place.\nFix: return it as jnp.float32(...)."
            )
        fill = np.nan if np.issubdtype(x.dtype, np.inexact) else 0
        group.create_array(
            f"values/{name}", shape=(size, *x.shape), chunks=(block, *(max(1, n) for n in x.shape)), dtype=x.dtype,
            fill_value=fill, dimension_names=["index", *inner(len(x.shape))], compressors=whole,
        )  # fmt: skip
    for name, dtype, fill in zip(Status._fields, STATUS_TYPES, (NOT_RUN, 0, np.nan, np.nan)):
        group.create_array(
            f"status/{name}", shape=(size,), chunks=(block,), dtype=dtype, fill_value=fill, compressors=whole
        )
    files = len(leaves) + len(Status._fields)
    group.create_array(
        DONE, shape=(-(-size // block), files, 2), chunks=(1, files, 2), dtype="uint64", fill_value=0,
        compressors=whole[-1:],
    )  # fmt: skip


def remove_leftovers(path: Path) -> None:
    """Remove what processes that were killed while they made this store have left: it is there without them."""
    left = re.compile(re.escape(f".{path.name}.") + "[0-9a-f]{8}")
    for beside in path.parent.iterdir():
        if left.fullmatch(beside.name):
            shutil.rmtree(beside, ignore_errors=True)
