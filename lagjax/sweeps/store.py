"""A sweep on disk: a zarr group that xarray reads as it lies, written block by block, each marked when it is all there.

    NAME                (*axes,) + what a point has: values by `labels`, result, steps, scaled_error, residual; the axes
    lagjax              what the store says about itself, and
    lagjax/values/NAME  what of trajectories has no label: their ends, statistics, parameters
    lagjax/marks        (blocks, arrays, 2): of each block the length and checksum of its files; written last

A block is a box of the grid, and a run of flat indices (`grids`). One that is not marked is computed again, whatever of
it was written. To zarr a file that is not there is a block of fill values, so that the marks must tell what belongs
there. They are looked at in two ways:

- a glance, whenever a store is opened: each file is there, is as long as it was and ends as it did. It reads 4 bytes a
  file, and sees what is missing, cut off, or of another block;
- a full check, of its own part, when a sweep goes on: each file is read and has its checksum (crc32c).

What neither has seen yet, zarr sees when values are read. In format 1, without checksums, a file that is not there is
lost if there should be numbers in it, and one of fill values looks alike (`earlier`).

Needs zarr (`pip install "lagjax[data]"`). A transactional store made for object stores (icechunk 1.1) was tried: of 64
blocks that 8 processes had committed on a file system 16 were gone, as it warns.
"""

import math
import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lagjax.sweeps.axes import Axes
from lagjax.sweeps.fingerprint import ANOTHER_FUNCTION, differences, fingerprint, named_leaves, of_axis
from lagjax.sweeps.grids import Blocks
from lagjax.sweeps.lanes import GOOD, LOST, NOT_RUN, Program, Status
from lagjax.sweeps.metadata import about, create, import_zarr, remove_leftovers, restore

# What zarr and its codecs raise for files that are not what they were.
UNREADABLE = (ValueError, RuntimeError, TypeError, OSError)
# The bytes of a checksum.
CHECKSUM = 4
# Files that a message names, of many.
SHOWN = 5


class Store:
    """A sweep's store, open. Its metadata are whole: `metadata.restore` comes first."""

    def __init__(self, path: str | os.PathLike, mode: str = "r+"):
        self.path = Path(path)
        self.about: dict[str, Any] = about(self.path)
        self.format: int = self.about["fingerprint"]["format"]
        places = self.about["places"]
        # By the name of a leaf, or of a field.
        self._values: dict[str, str] = {name: places["values"][name] for name in self.about["fingerprint"]["values"]}
        self._status: dict[str, str] = {name: places["status"][name] for name in Status._fields}
        zarr = import_zarr()
        # A block of nothing but fill values has a file like any other.
        with zarr.config.set({"array.write_empty_chunks": True}):
            group: Any = zarr.open_group(str(path), mode=mode, use_consolidated=False)
            self.group = group
            names = (*self._values.values(), *self._status.values())
            self.arrays: dict[str, Any] = {name: group[name] for name in names}
            self._marks_name: str = places["marks"]
            self._marks_array = group[self._marks_name]
        shape = self.arrays[self._status["result"]].shape
        # In earlier formats the grid is a row of all points.
        self.blocks = Blocks(shape, tuple(self.about["block"]))

    @property
    def size(self) -> int:
        """How many points there are."""
        return math.prod(self.blocks.shape)

    def missing(self) -> np.ndarray:
        """The numbers of the blocks that are not marked."""
        return self._missing(self._marks()[0])

    def _marks(self):
        """(the marks of all blocks, 0 where there is none; the numbers of the blocks whose mark is damaged)."""
        return _read(self._marks_array, lambda number: slice(number, number + 1), len(self.blocks))

    def _missing(self, marks):
        return np.flatnonzero(marks.reshape(len(self.blocks), -1).max(axis=1) == 0)

    def write(self, number: int, values, status: Status):
        """Write a block, and then mark it."""
        here = self.blocks.region(number)
        shape = tuple(x.stop - x.start for x in here)
        flat = [x for _, x in named_leaves(values)] + list(status)
        for array, x in zip(self.arrays.values(), flat):
            array[here] = x.reshape(shape + x.shape[1:])
        marks = 1 if self.format == 1 else [_mark(self._file(name, number)) for name in self.arrays]
        self._marks_array[number] = marks

    def unmark(self, numbers: Iterable[int]):
        """Forget that some blocks were written."""
        for number in numbers:
            self._marks_array[number] = 0

    def damage(self, numbers: Iterable[int], read: bool, marks=None) -> dict[int, str]:
        """What of some blocks is not whole: by the block's number the file, and what is wrong with it.

        A glance, or with `read` a full check. Blocks that are not marked are not looked at.
        """
        marks, unreadable = self._marks() if marks is None else marks
        found = {}
        for number in numbers:
            if number in unreadable:
                found[number] = f"{self._file(self.about['places']['marks'], number)} is damaged"
            elif np.any(marks[number]):
                find_damage = self._damage_unchecked if self.format == 1 else self._damage
                wrong = next(find_damage(number, marks[number], read), None)
                if wrong is not None:
                    found[number] = wrong
        return found

    def first(self) -> int | None:
        """The number of the first block that is there."""
        missing = set(self.missing().tolist())
        return next((number for number in range(len(self.blocks)) if number not in missing), None)

    def read(self, number: int) -> list[np.ndarray]:
        """The values of a block, each (points, ...)."""
        here, lead = self.blocks.region(number), len(self.blocks.shape)
        found = [np.asarray(self.arrays[name][here]) for name in self._values.values()]
        return [x.reshape(math.prod(x.shape[:lead]), *x.shape[lead:]) for x in found]

    def _damage(self, number, mark, read):
        for name, (length, checksum) in zip(self.arrays, mark.tolist()):
            if length == 0:
                continue
            file = self._file(name, number)
            try:
                with open(file, "rb") as content:
                    there = os.fstat(content.fileno()).st_size
                    if there != length:
                        yield f"{file} has {there:,} bytes of {length:,}"
                        continue
                    if not read:
                        content.seek(-CHECKSUM, os.SEEK_END)
                    data = content.read()
            except FileNotFoundError:
                yield f"{file} is missing"
            except OSError as error:
                yield f"{file} cannot be read ({error.strerror})"
            else:
                if _number(data[-CHECKSUM:]) != checksum or read and _crc32c()(data[:-CHECKSUM]) != checksum:
                    yield f"{file} is not as it was written"

    def _damage_unchecked(self, number, mark, read):
        result, here = self.arrays[self._status["result"]], self.blocks.region(number)
        for name, array in self.arrays.items():
            file = self._file(name, number)
            if file is not None and not file.exists():
                # Steps and the like that are all 0 had no file; results never were like what fills them.
                if array is result or name in self._values.values() and np.isin(result[here], GOOD).any():
                    yield f"{file} is missing"
            elif read:
                try:
                    array[here]
                except UNREADABLE:
                    yield f"{file} is damaged"

    def _file(self, name, number):
        """The file of a block; None where an array has no numbers."""
        if name == self._marks_name:
            return self.path.joinpath(name, "c", str(number), *"0" * (len(self._marks_array.shape) - 1))
        shape, place = self.arrays[name].shape, self.blocks.place(number)
        inner = "0" * (len(shape) - len(place))
        return None if math.prod(shape) == 0 else self.path.joinpath(name, "c", *map(str, place), *inner)

    def axes(self) -> Axes:
        """The axes as they were written.

        **Raises:** `ValueError` where their values are not.
        """
        names = tuple(self.about["names"])
        return Axes(names, tuple(map(self._axis, names)), self.about["paired"])

    def _axis(self, name):
        place = self.about["places"]["axes"][name]
        folder = self.path / place
        try:
            x = np.asarray(self.group[place][...])
        except UNREADABLE:
            x = None
        if x is None or of_axis(x) != self.about["fingerprint"]["axes"][name]:
            raise ValueError(
                f"the values of the axis '{name}' in {folder} are damaged.\n"
                "Usual cause: a file that was lost in a copy.\n"
                f"Fix: lj.sweep(run, axes, store='{self.path}'), which writes them again."
            )
        return x

    def write_axes(self, axes: Axes) -> list[str]:
        """Write the axes again where they are damaged, which are told, by the folder."""
        damaged = []
        for name, x in axes.values.items():
            try:
                self._axis(name)
            except ValueError:
                place = self.about["places"]["axes"][name]
                self.group[place][...] = x
                damaged.append(f"{self.path / place} was damaged")
        return damaged

    def values(self, like=None) -> tuple[Any, dict[int, str]]:
        """(the values of all points, what is lost: by the block's number, what is wrong with it).

        Each is (points, ...), in the structure of `like` or in a dictionary by name; NaN or 0 where there is no block.
        """
        named, (missing, lost) = {}, self._glance()
        for name, place in self._values.items():
            named[name], unreadable = self._read(place)
            lost.update({number: f"{self._file(place, number)} is damaged" for number in unreadable})
        lost = {number: wrong for number, wrong in lost.items() if number not in missing}
        for number in missing:
            for x in named.values():
                x[self.blocks.points(number)] = nothing(x.dtype)
        if like is not None:
            named = jax.tree.unflatten(jax.tree.structure(like), [named[name] for name, _ in named_leaves(like)])
        return named, lost

    def _read(self, name):
        """(all of an array, each point in a row; the numbers of the blocks that cannot be read)."""
        found, unreadable = _read(self.arrays[name], self.blocks.region, len(self.blocks))
        return found.reshape(self.size, *found.shape[len(self.blocks.shape) :]), unreadable

    def one(self) -> dict[str, jax.ShapeDtypeStruct]:
        """The shapes of one point's values by name, without reading any."""
        arrays, lead = {name: self.arrays[place] for name, place in self._values.items()}, len(self.blocks.shape)
        return {name: jax.ShapeDtypeStruct(x.shape[lead:], x.dtype) for name, x in arrays.items()}

    def status(self) -> tuple[Status, set[int], dict[int, str]]:
        """(the statuses of all points, the blocks that are not marked, what is lost of the others)."""
        status, (missing, lost) = [], self._glance()
        for place in self._status.values():
            x, unreadable = self._read(place)
            status.append(x)
            lost.update({number: f"{self._file(place, number)} is damaged" for number in unreadable})
        lost = {number: wrong for number, wrong in lost.items() if number not in missing}
        for numbers, code in ((missing, NOT_RUN), (lost, LOST)):
            for number in numbers:
                for x, fill in zip(status, (code, 0, np.nan, np.nan)):
                    x[self.blocks.points(number)] = fill
        return Status(*status), missing, lost

    def _glance(self):
        """(the blocks that are not marked, what is lost of the others)."""
        marks, unreadable = self._marks()
        lost = self.damage(range(len(self.blocks)), False, (marks, unreadable))
        return set(self._missing(marks).tolist()) - set(unreadable), lost


def tell(path: Path, wrong: Iterable[str], then: str, stacklevel: int):
    """Warn of what is not whole in a store."""
    wrong = list(wrong)
    more = [f"and {len(wrong) - SHOWN:,} more"] if len(wrong) > SHOWN else []
    lines = "\n".join(f"    {line}" for line in [*wrong[:SHOWN], *more])
    warnings.warn(
        f"the store {path} is not whole:\n{lines}\n"
        "Usual cause: a copy that was cut short, files removed, a disk or its network that failed.\n" + then,
        stacklevel=stacklevel + 1,
    )


def _read(array, region, blocks):
    """(all of an array, the numbers of the blocks that cannot be read)."""
    try:
        return np.asarray(array[...]), []
    except UNREADABLE:
        found, unreadable = np.full(array.shape, nothing(array.dtype), array.dtype), []
        for number in range(blocks):
            try:
                found[region(number)] = array[region(number)]
            except UNREADABLE:
                unreadable.append(number)
        return found, unreadable


def nothing(dtype):
    """What stands where there is no value."""
    return np.nan if np.issubdtype(dtype, np.inexact) else 0


def _mark(file):
    """The length of a file and the checksum at its end."""
    if file is None:
        return 0, 0
    with open(file, "rb") as content:
        length = content.seek(0, os.SEEK_END)
        content.seek(-CHECKSUM, os.SEEK_END)
        return length, _number(content.read())


def _number(data):
    return int.from_bytes(data, "little")


def _crc32c():
    # Zarr has it, for the same use.
    from google_crc32c import value

    return value


def chunk_of(path: str | os.PathLike) -> int:
    """The points of a call of the program that a store was begun with."""
    return about(Path(path))["fingerprint"]["chunk"]


def open_store(
    path: Path,
    axes: Axes,
    program: Program,
    layout: str,
    part: tuple[int, int],
    accept: bool,
    begun: Callable[[], tuple[Blocks, dict, dict | None]],
) -> Store:
    """Open the store of a sweep, made where there is none; refuse one that belongs to another sweep.

    `begun()`: the blocks of a new one, the times of its trajectories that all points share, the structure of values.
    What of a store is not whole is told, put back or, of this part, marked as missing.
    """
    wanted = fingerprint(axes, program, layout)
    if not path.exists():
        create(path, axes, program, wanted, *begun())
    _check_belongs(path, about(path)["fingerprint"], wanted, accept)
    remove_leftovers(path)
    wrong = restore(path)
    store = Store(path)
    wrong += store.write_axes(axes)
    lost = store.damage(range(part[0], len(store.blocks), part[1]), read=True)
    if wrong or lost:
        again = f"Blocks that are computed again: {len(lost):,} of {len(store.blocks):,}" if lost else "It is put back"
        tell(path, [*wrong, *lost.values()], f"{again}; nothing needs to be done.", stacklevel=4)
    store.unmark(lost)
    return store


def _check_belongs(path, there, here, accept):
    found = differences(there, here)
    older = [line for line in found if line.startswith(("versions", "format"))]
    # Another version traces another program of the same function.
    rest = [line for line in found if line not in older and not (older and line == ANOTHER_FUNCTION)]
    shown = lambda lines: "".join(f"    {line}\n" for line in lines)
    if rest:
        raise ValueError(
            f"{path} belongs to another sweep, and is left as it is:\n{shown(found)}"
            "Usual cause: run, the axes or a setting has changed since it was begun.\n"
            "Fix: another path; or change back what differs, to go on with this one."
        )
    if older and not accept:
        raise ValueError(
            f"{path} was written by other versions, and is left as it is:\n{shown(older)}"
            "What it has can be read: lj.open_sweep(path).\n"
            "Fix: lj.sweep(..., accept_versions=True) goes on with it where run is still the same function, which "
            "cannot be told across versions; or another path."
        )
