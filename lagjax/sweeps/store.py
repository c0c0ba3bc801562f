"""A sweep on disk: a zarr group, written block by block, each of them marked when all of it is there.

    axes/NAME     the values of the axes
    values/NAME   (points, ...) in blocks along the flat index, by name of what `run` returns
    status/NAME   result, steps, departure, residual
    done          one byte a block, written last

A block that is not marked is computed again, whatever of it was written. The group is made under another name and then
renamed, so that several processes may open one store at the same time. Needs zarr (`pip install "lagjax[data]"`).
"""

import hashlib
import json
import os
import re
import shutil
import uuid
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr

from lagjax.numerics.programs import bodies
from lagjax.sweeps.axes import Axes
from lagjax.sweeps.lanes import NOT_RUN, STATUS_TYPES, Program, Status

FORMAT = 1


def import_zarr():
    """Import zarr, or say how to get it."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            'stores need zarr, which is an optional extra.\nFix: pip install "lagjax[data]", or leave store out.'
        ) from error
    return zarr


def fingerprint(axes: Axes, program: Program, layout: str) -> dict[str, Any]:
    """What must be the same for two runs to belong to one store, in words where that is possible."""
    return {
        "format": FORMAT,
        "points": ", ".join(f"{name}: {n}" for name, n in axes.dims.items()),
        "axes": {name: f"{x.dtype}{list(x.shape)} {_digest(x.tobytes())}" for name, x in axes.values.items()},
        "values": {name: f"{x.dtype}{list(x.shape)}" for name, x in named_leaves(program.values)},
        "chunk": program.chunk,
        "layout": layout,
        "program": _digest(_text(program.traced.jaxpr).encode()),
        "versions": {name: version(name) for name in ("lagjax", "jax", "diffrax")},
    }


def named_leaves(tree) -> list[tuple[str, Any]]:
    """The leaves of what `run` returns, each with a name: its path, or "value" where it is alone."""
    key = lambda path: jax.tree_util.keystr(path, simple=True, separator=".").lstrip(".") or "value"
    return [(key(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _digest(data):
    return hashlib.sha256(data).hexdigest()[:16]


def _text(closed: ClosedJaxpr):
    """A program as text that is the same in every process: without addresses, with the constants of its parts."""
    constants = "".join(_digest(np.asarray(x).tobytes()) for x in closed.consts if not isinstance(x, Tracer))
    return re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr)) + constants + "".join(_constants(closed.jaxpr))


def _constants(jaxpr):
    for equation in jaxpr.eqns:
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                if isinstance(part, ClosedJaxpr):
                    yield from (_digest(np.asarray(x).tobytes()) for x in part.consts)
        for body in bodies(equation):
            yield from _constants(body)


class Store:
    """A sweep's store, open."""

    def __init__(self, path):
        self.path = Path(path)
        self.group: Any = import_zarr().open_group(str(path), mode="r+")
        self.about: dict[str, Any] = dict(self.group.attrs["lagjax"])

    @property
    def block(self) -> int:
        """How many points are written together."""
        return self.about["block"]

    def missing(self) -> np.ndarray:
        """The numbers of the blocks that are not there."""
        return np.flatnonzero(np.asarray(self.group["done"][:]) == 0)

    def write(self, number: int, values, status: Status):
        """Write a block, and then mark it."""
        here = slice(number * self.block, number * self.block + len(status.result))
        for name, x in named_leaves(values):
            self.group[f"values/{name}"][here] = x
        for name, x in zip(Status._fields, status):
            self.group[f"status/{name}"][here] = x
        self.group["done"][number] = 1

    def axes(self) -> Axes:
        """The axes as they were written."""
        read = lambda name: np.asarray(self.group[f"axes/{name}"][...])
        names = tuple(self.about["names"])
        return Axes(names, tuple(map(read, names)), self.about["zipped"])

    def values(self, like=None):
        """The values of all points (points, ...): in the structure of `like`, or in a dictionary by name."""
        names = list(self.about["fingerprint"]["values"])
        found = {name: np.asarray(self.group[f"values/{name}"][...]) for name in names}
        if like is None:
            return found
        return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name, _ in named_leaves(like)])

    def one(self) -> dict[str, jax.ShapeDtypeStruct]:
        """The shapes of one point's values by name, without reading any."""
        arrays = {name: self.group[f"values/{name}"] for name in self.about["fingerprint"]["values"]}
        return {name: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for name, x in arrays.items()}

    def status(self) -> Status:
        """The statuses of all points."""
        return Status(*(np.asarray(self.group[f"status/{name}"][...]) for name in Status._fields))


def chunk_of(path) -> int:
    """The points of a call of the program that a store was begun with."""
    return _existing(path).about["fingerprint"]["chunk"]


def _existing(path):
    try:
        return Store(path)
    except (KeyError, FileNotFoundError, ValueError) as error:
        raise ValueError(
            f"{path} exists, and is no store of a sweep.\nFix: another path, or remove it if it is not needed."
        ) from error


def open_store(path, axes: Axes, program: Program, layout: str, block: int) -> Store:
    """Open the store of a sweep, made where there is none; refuse one that belongs to another sweep."""
    wanted = fingerprint(axes, program, layout)
    if not Path(path).exists():
        _create(Path(path), axes, program, wanted, block)
    store = _existing(path)
    if differences := _differences(store.about["fingerprint"], wanted):
        raise ValueError(
            f"{path} belongs to another sweep, and is left as it is:\n"
            + "\n".join(f"    {line}" for line in differences)
            + "\nUsual cause: run, the axes or a setting has changed since it was begun.\n"
            "Fix: another path; or change back what differs, to go on with this one."
        )
    return store


def _differences(there, here, under=""):
    found = []
    for key in dict.fromkeys((*there, *here)):
        a, b, name = there.get(key), here.get(key), f"{under}{key}"
        if isinstance(a, dict) and isinstance(b, dict):
            found += _differences(a, b, f"{name} ")
        elif name == "program" and a != b:
            found.append("run is another function")
        elif (
            a != b and under == "axes " and isinstance(a, str) and isinstance(b, str) and a.split()[:1] == b.split()[:1]
        ):
            found.append(f"axis '{key}' has other values")
        elif a != b:
            found.append(f"{name}: {a} there, {b} here")
    return found


def _create(path, axes, program, wanted, block):
    zarr = import_zarr()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    group = zarr.create_group(str(temporary))
    for name, x in axes.values.items():
        group.create_array(f"axes/{name}", data=x)
    size, inner = axes.size, lambda n: [f"dim_{i}" for i in range(n)]
    for name, x in named_leaves(program.values):
        fill = np.nan if np.issubdtype(x.dtype, np.inexact) else 0
        group.create_array(
            f"values/{name}", shape=(size, *x.shape), chunks=(block, *(max(1, n) for n in x.shape)), dtype=x.dtype,
            fill_value=fill, dimension_names=["index", *inner(len(x.shape))],
        )  # fmt: skip
    for name, dtype, fill in zip(Status._fields, STATUS_TYPES, (NOT_RUN, 0, np.nan, np.nan)):
        group.create_array(f"status/{name}", shape=(size,), chunks=(block,), dtype=dtype, fill_value=fill)
    group.create_array("done", shape=(-(-size // block),), chunks=(1,), dtype="uint8", fill_value=0, compressors=None)
    about = {"fingerprint": wanted, "block": block, "names": list(axes.values), "zipped": axes.zipped}
    group.attrs["lagjax"] = json.loads(json.dumps(about))
    try:
        os.rename(temporary, path)
    except OSError:
        # Another process was first; the check of the fingerprint follows.
        shutil.rmtree(temporary)
