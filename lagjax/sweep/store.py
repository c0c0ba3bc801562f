"""A sweep on disk: a group of zarr that xarray reads directly, written block by block; complete blocks are marked.

    NAME                (*axes,) + a point's shape: values by `labels`, result, steps, scaled_error, residual; the axes
    lagjax              the description of the store, and
    lagjax/values/NAME  the arrays of trajectories without a label: their ends, statistics, parameters
    lagjax/marks        (blocks, arrays, 2): the length and checksum of each file of a block; written last

A block is a box of the grid with consecutive flat indices (`axes`). A block that is not marked is computed again, even
if parts of it were written. Zarr reads a missing file as a block of fill values, so the marks must record which files
belong there. Files are compared with their marks in two ways:

- a quick check, whenever a store is opened: each file exists and has its length, by a listing of all files;
- a full check when a sweep continues, of this process's part: each file is read and its checksum (crc32c) computed.

Any other damage is detected when values are read. Zarr makes the bytes of blocks and reads them (`objects`), and
nothing outside of the store is read or written, whatever its description says (`metadata`); opening a store writes
nothing.

Needs zarr (`pip install "lagjax[data]"`). A transactional store made for object stores (icechunk 1.1) was tried: of 64
blocks that 8 processes had committed on a file system, 16 were lost, as its documentation warns.

**The structure of what `run` returned** is described in JSON. Leaves are named, and trajectories are described as in
their own files, without the functions of their systems. Values that contain a function, or an object of a class that
cannot be described in JSON, have no such description: they are read as a dictionary by name.
"""

import base64
import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.display import by_line, printable
from lagjax.files import KINDS_OF_ARRAY, MALFORMED, NotWritable, Reader, Table, Writer
from lagjax.integrate import (
    check_is_system,
    described,
    described_system,
    parts,
    same_system,
    trajectory_from,
)
from lagjax.sweep.axes import Axes, Blocks
from lagjax.sweep.engine import LOST, NOT_RUN, Program, Status, is_motion, nothing
from lagjax.sweep.labels import flags, motions_in, named_leaves, shapes_of
from lagjax.sweep.metadata import (
    ANOTHER_FUNCTION,
    MARKS,
    axis_files,
    check_room,
    checked,
    create,
    description_at,
    differences,
    fingerprint,
    is_begun,
    metadata_of,
    of_axis,
    restore,
)
from lagjax.sweep.objects import Damaged, Encoder, Files, Spec, decoded, ending, most_of
from lagjax.system import UnknownSystem

# The largest number of files that a message names.
SHOWN = 5
# The bytes of files that are read together.
BYTES_TOGETHER = 64e6


class Marks(NamedTuple):
    """What tells which blocks of a store are finished.

    `sizes`: the lengths of all files of the store; `of_files` (blocks, arrays, 2): the length and checksum of each file
    of a block, 0 if it is not marked; `damaged`: the blocks whose mark is damaged.
    """

    sizes: dict[str, int]
    of_files: np.ndarray
    damaged: list[int]

    @property
    def marked(self) -> np.ndarray:
        """Which blocks are marked."""
        return np.any(self.of_files > 0, axis=(1, 2))


class Store:
    """An open store of a sweep.

    `of_own_sweep`: the caller knows its axes, which decide how much memory it takes; otherwise arrays far larger than
    its files are refused. `about`: its description, if that was read before.
    """

    def __init__(self, files: Files, of_own_sweep: bool = False, about: dict[str, Any] | None = None):
        self.files, self.about = files, about or {}
        sizes = {} if about else files.sizes()
        if about:
            described = checked(about)
        else:
            self.about, described = description_at(files, sizes)
        if not of_own_sweep:
            check_room(files.place, described, sum(sizes.values()))
        self._specs, self.blocks = described
        # The array of each leaf of the values, and of each field of the status.
        places = self.about["places"]
        self._values: dict[str, str] = {name: places["values"][name] for name in self.about["fingerprint"]["values"]}
        self._status: dict[str, str] = {name: places["status"][name] for name in Status._fields}
        names = *self._values.values(), *self._status.values()
        self.arrays: dict[str, Spec] = {name: self._specs[name] for name in names}
        self._encoders: dict[str, Encoder] = {}

    @property
    def place(self) -> Any:
        """Where it is: a path or a URL."""
        return self.files.place

    @property
    def size(self) -> int:
        """The number of points."""
        return math.prod(self.blocks.shape)

    def missing(self) -> np.ndarray:
        """The numbers of the blocks that are not marked."""
        return np.flatnonzero(~self._marks(self.files.sizes(again=True)).marked)

    def _marks(self, sizes: dict[str, int]):
        spec, damaged = self._specs[MARKS], []
        of_files, names = np.zeros(spec.shape, np.uint64), [self._file(MARKS, i) for i in range(len(self.blocks))]
        contents = self.files.read(name for name in names if 0 < sizes.get(name, 0) <= most_of(spec))
        for number, name in enumerate(names):
            try:
                of_files[number] = decoded(contents.get(name, b""), spec)[0] if name in sizes else 0
            except Damaged:
                damaged.append(number)
        return Marks(sizes, of_files, damaged)

    def write(self, number: int, values: PyTree, status: Status) -> np.ndarray:
        """Write a block, and then mark it; returns the lengths and checksums of its files."""
        shape = tuple(x.stop - x.start for x in self.blocks.region(number))
        contents, marks = {}, []
        for name, x in zip(self.arrays, [x for _, x in named_leaves(values)] + list(status)):
            content = self._encoder(name)(self.blocks.place(number), x.reshape(shape + x.shape[1:]))
            marks.append((len(content), ending(content)))
            if content:
                contents[self._file(name, number)] = content
        self.files.write(contents)
        return self._mark(number, np.asarray(marks, np.uint64))

    def _mark(self, number: int, marks: np.ndarray):
        content = self._encoder(MARKS)((number, 0, 0), marks[None])
        self.files.write({self._file(MARKS, number): content})
        return marks

    def _encoder(self, name: str):
        if name not in self._encoders:
            self._encoders[name] = Encoder(self._specs[name])
        return self._encoders[name]

    def unmark(self, numbers: Iterable[int]):
        """Mark some blocks as not written."""
        for number in numbers:
            self._mark(number, np.zeros((len(self.arrays), 2), np.uint64))

    def damage(self, numbers: Iterable[int], read: bool, marks: "Marks | None" = None) -> dict[int, str]:
        """The damage of some blocks: by the block's number, the file and what is wrong with it.

        A quick check, or a full check if `read`. Blocks that are not marked are skipped.
        """
        marks, found = self._marks(self.files.sizes()) if marks is None else marks, {}
        numbers = set(numbers)
        for number in sorted(numbers & {*marks.damaged}):
            found[number] = f"{self.files.at(self._file(MARKS, number))} is damaged"
        for name in self.arrays:
            for number, _, wrong in self._contents(name, sorted(numbers), marks, read):
                if wrong:
                    found.setdefault(number, wrong)
        return dict(sorted(found.items()))

    def _contents(self, name: str, numbers: Iterable[int], marks: "Marks", read: bool = True):
        """Yield (number, chunk, what is wrong) of an array's files in marked blocks; without `read` of no good ones."""
        spec, which = self._specs[name], [*self.arrays].index(name)
        there, files = [], {i: self._file(name, i) for i in numbers if marks.of_files[i, which, 0] > 0}
        for number, file in files.items():
            length = int(marks.of_files[number, which, 0])
            if file not in marks.sizes:
                yield number, None, f"{self.files.at(file)} is missing"
            elif marks.sizes[file] != length:
                yield number, None, f"{self.files.at(file)} has {marks.sizes[file]:,} bytes of {length:,}"
            elif length > most_of(spec):
                yield number, None, f"{self.files.at(file)} is not as it was written"
            else:
                there.append(number)
        together = max(1, int(BYTES_TOGETHER / most_of(spec)))
        for start in range(0, len(there) if read else 0, together):
            some = there[start : start + together]
            contents = self.files.read(files[i] for i in some)
            for number in some:
                try:
                    chunk, wrong = decoded(contents[files[number]], spec), ""
                    if ending(contents[files[number]]) != marks.of_files[number, which, 1]:
                        wrong = "is not as it was written"
                except Damaged as error:
                    chunk, wrong = None, str(error)
                yield number, chunk, wrong and f"{self.files.at(files[number])} {wrong}"

    def _file(self, name: str, number: int):
        """The file of a block; "" for an empty array."""
        key = self._specs[name].key((number,) if name == MARKS else self.blocks.place(number))
        return key and f"{name}/{key}"

    def first(self) -> int | None:
        """The number of the first marked block that is intact."""
        marks = self._marks(self.files.sizes())
        there = np.flatnonzero(marks.marked).tolist()
        return next((number for number in there if not self.damage([number], True, marks)), None)

    def read(self, number: int) -> list[np.ndarray]:
        """The values of a block, each (points, ...)."""
        found, shape = [], tuple(x.stop - x.start for x in self.blocks.region(number))
        for name in self._values.values():
            spec, file = self._specs[name], self._file(name, number)
            x = decoded(self.files.read([file])[file], spec) if file else np.zeros(spec.chunk, spec.dtype)
            x = x[tuple(map(slice, (*shape, *spec.shape[len(shape) :])))]
            found.append(x.reshape(math.prod(shape), *x.shape[len(shape) :]))
        return found

    def axes(self) -> Axes:
        """The axes.

        **Raises:** `ValueError` if their values are damaged.
        """
        names = tuple(self.about["names"])
        return Axes(names, tuple(map(self._axis, names)), self.about["paired"])

    def _axis(self, name: str):
        place = self.about["places"]["axes"][name]
        spec, x = self._specs[place], None
        file = f"{place}/{spec.key()}"
        try:
            x = decoded(self.files.read([file])[file], spec)
        except Damaged:
            x = None
        if x is None or of_axis(x) != self.about["fingerprint"]["axes"][name]:
            raise ValueError(
                f"the values of the axis '{name}' in {self.files.at(place)} are damaged.\n"
                "Usual cause: a file that was lost in a copy.\n"
                f"Fix: lj.sweep(run, axes, store='{self.place}'), which writes them again."
            )
        return x

    def write_axes(self, axes: Axes) -> list[str]:
        """Write damaged axes again; returns a line about each."""
        damaged = []
        for name, x in axes.values.items():
            try:
                self._axis(name)
            except ValueError:
                place = self.about["places"]["axes"][name]
                self.files.write(axis_files(self._specs, {place: x}))
                damaged.append(f"{self.files.at(place)} was damaged")
        return damaged

    def values(self, like: PyTree = None) -> tuple[Any, dict[int, str]]:
        """(the values of all points; the lost blocks: by number, what is wrong).

        Values are (points, ...), in the structure of `like` or in a dictionary by name; NaN or 0 in missing blocks.
        """
        self.files.sizes(again=True)
        named, _, lost = self._read(self._values)
        if like is not None:
            named = jax.tree.unflatten(jax.tree.structure(like), [named[name] for name, _ in named_leaves(like)])
        return named, lost

    def _read(self, places: dict[str, str]):
        """(the arrays at some places, each (points, ...); the unmarked blocks; the lost blocks with what is wrong).

        Arrays have nothing in blocks that are unmarked or cannot be read.
        """
        marks = self._marks(self.files.sizes())
        everywhere = range(len(self.blocks))
        arrays, lost = {}, self.damage(everywhere, False, marks)
        for name, place in places.items():
            spec = self.arrays[place]
            found, inner = np.full(spec.shape, nothing(spec.dtype), spec.dtype), spec.shape[len(self.blocks.shape) :]
            for number, chunk, wrong in self._contents(place, everywhere, marks):
                if chunk is None or wrong:
                    lost.setdefault(number, wrong)
                else:
                    # Blocks at the end of an axis are filled up to their whole shape.
                    region = self.blocks.region(number)
                    found[region] = chunk[tuple(slice(x.stop - x.start) for x in region) + tuple(map(slice, inner))]
            arrays[name] = found.reshape(self.size, *inner)
        missing = set(np.flatnonzero(~marks.marked).tolist()) - {*marks.damaged}
        return arrays, missing, lost

    def one(self) -> dict[str, jax.ShapeDtypeStruct]:
        """The shapes of one point's values by name, without reading any values."""
        arrays, lead = {name: self.arrays[place] for name, place in self._values.items()}, len(self.blocks.shape)
        return {name: jax.ShapeDtypeStruct(x.shape[lead:], x.dtype) for name, x in arrays.items()}

    def status(self) -> tuple[Status, set[int], dict[int, str]]:
        """(the statuses of all points, the unmarked blocks, the lost blocks with what is wrong)."""
        found, missing, lost = self._read(self._status)
        status = Status(**found)
        if unknown := sorted({*np.unique(status.result).tolist()} - {*flags()["flag_values"]}):
            raise ValueError(
                f"{self.place} has results with the number {unknown[0]}, which this version of lagjax does not know.\n"
                "Fix: pip install -U lagjax."
            )
        for numbers, code in ((missing, NOT_RUN), (lost, LOST)):
            for number in numbers:
                for x, fill in zip(status, (code, 0, np.nan, np.nan)):
                    x[self.blocks.points(number)] = fill
        return status, missing, lost


def indented(lines: Iterable[str]) -> str:
    """Lines of a message, each indented."""
    return "".join(f"    {line}\n" for line in lines)


def warn_of_damage(place: object, wrong: Iterable[str], then: str, stacklevel: int):
    """Warn of damage in a store."""
    wrong = list(wrong)
    more = [f"and {len(wrong) - SHOWN:,} more"] if len(wrong) > SHOWN else []
    warnings.warn(
        f"the store {place} is damaged or incomplete:\n{indented([*wrong[:SHOWN], *more])}"
        "Usual cause: a copy that was cut short, files removed, a disk or its network that failed.\n" + then,
        stacklevel=stacklevel + 1,
    )


def chunk_of(files: Files) -> int | None:
    """The chunk length that a store was begun with; None if there is none."""
    sizes = files.sizes()
    return description_at(files, sizes)[0]["fingerprint"]["chunk"] if is_begun(sizes) else None


def open_store(
    files: Files,
    axes: Axes,
    program: Program,
    layout: str,
    part: tuple[int, int],
    accept: bool,
    new_store: Callable[[], tuple[Blocks, dict, dict | None]],
) -> Store:
    """Open the store of a sweep, or make it if there is none; refuse one that belongs to another sweep.

    `new_store()`: the blocks of a new store, the times of trajectories that all points share, the structure of values.
    Damage causes a warning; metadata and axes are restored, and damaged blocks of this part are marked as missing.
    """
    wanted, place = fingerprint(axes, program, layout), files.place
    if not is_begun(files.sizes()):
        create(files, axes, program, wanted, *new_store())
        files.sizes(again=True)
    store = Store(files, of_own_sweep=True)
    _check_belongs(place, store.about["fingerprint"], wanted, accept)
    wrong = restore(files, files.sizes(), metadata_of(store.about))
    wrong += store.write_axes(axes)
    lost = store.damage(range(part[0], len(store.blocks), part[1]), read=True)
    if wrong or lost:
        recomputed = f"Blocks that are computed again: {len(lost):,} of {len(store.blocks):,}"
        outcome = recomputed if lost else "It has been restored"
        warn_of_damage(place, [*wrong, *lost.values()], f"{outcome}; nothing needs to be done.", stacklevel=4)
    store.unmark(lost)
    return store


def _check_belongs(place: object, stored: dict, here: dict, accept: bool):
    found = differences(stored, here)
    older = [line for line in found if line.startswith(("versions", "format"))]
    # Other versions may trace another program from the same function.
    other = [line for line in found if line not in older and not (older and line == ANOTHER_FUNCTION)]
    if other:
        raise ValueError(
            f"{place} belongs to another sweep, and is left unchanged:\n{indented(found)}"
            "Usual cause: run, the axes or a setting has changed since it was begun.\n"
            "Fix: another path; or undo the differences, to continue this one."
        )
    if older and not accept:
        raise ValueError(
            f"{place} was written by other versions, and is left unchanged:\n{indented(older)}"
            "Its contents can be read: lj.open_sweep(path).\n"
            "Fix: lj.sweep(..., accept_versions=True) continues it if run is still the same function, which "
            "cannot be checked across versions; or another path."
        )


LEAF, MOTION = "leaf", "trajectory"


class _Marker:
    """A marker in a described tree, in place of a leaf or a trajectory, which are stored separately."""

    def __init__(self, role: str):
        self.role = role


def description_of(like: PyTree, one: PyTree | None) -> dict[str, Any] | None:
    """The description of values like these, or None. Systems are described from `one`, a point with numbers."""
    names = iter([name for name, _ in named_leaves(like)])
    named = jax.tree.map(lambda x: _Marker(f"{LEAF} {next(names)}"), like)
    motions, found = motions_in(named), []
    examples = motions if one is None else motions_in(one)
    writer = Writer(lambda value: value.role if isinstance(value, _Marker) else None)
    count = iter(range(len(motions)))
    tree = jax.tree.map(lambda x: _Marker(f"{MOTION} {next(count)}") if is_motion(x) else x, named, is_leaf=is_motion)
    try:
        for motion, numbered in zip(motions, examples):
            system = described(numbered) if one is not None else UnknownSystem(repr(motion.any_system), (), {}, None)
            # NumPy arrays, so that a process that works in float32 can read them, too.
            fields = jax.tree.map(_in_numpy, {name: getattr(system, name) for name in system.__dataclass_fields__})
            nodes = parts(motion, lambda result: {"codes": result._value, "names": {}}) | {"system": fields}
            found.append({name: writer.down(x, name) for name, x in nodes.items()})
        description = {"tree": writer.down(tree, "values"), "trajectories": found}
    except NotWritable:
        return None
    return description | {"arrays": {name: _in_json(x) for name, x in writer.arrays.items()}}


def tree_of(description: dict[str, Any], system: Any, path: Any, table: Table) -> PyTree:
    """The described tree, with meaningless small arrays for leaves. Systems other than `system` stay unknown.

    **Raises:** `ValueError` if none of its trajectories was integrated with `system`, a class was not passed, or the
    description is malformed.
    """
    if system is not None:
        check_is_system(system)
    arrays, motions, mismatches, matching = {}, {}, [], []

    def marked_value(role: str):
        kind, _, number = role.partition(" ")
        if kind == LEAF:
            return jnp.zeros(())
        if kind != MOTION:
            raise ValueError(f"a value of kind '{printable(kind)[:80]}' is not known.")
        # Each is described once, and used once.
        found = {name: reader.up(node) for name, node in motions.pop(int(number)).items()}
        about = described_system(found["system"])
        kept = UnknownSystem(about.words, about.angles, {}, None)
        if system is not None:
            try:
                kept = same_system(system, about, path)
                matching.append(kept)
            except ValueError as error:
                mismatches.append(error)
        return trajectory_from(found, kept)

    reader = Reader(lambda name: _from_json(arrays.pop(name)), marked_value, table)
    try:
        arrays.update(description["arrays"])
        motions.update(enumerate(description["trajectories"]))
        tree = reader.up(description["tree"])
    except MALFORMED as error:
        raise ValueError(f"its structure is not one that lagjax writes ({type(error).__name__}).") from error
    if mismatches and not matching:
        raise mismatches[0]
    return tree


def as_stored(store: Store, system: Any, table: Table) -> PyTree:
    """The shapes of one point's values, as the store describes them, or by name: without description or a class.

    **Raises:** `ValueError` if no trajectory has this `system`, or there are no trajectories.
    """
    description = store.about.get("structure")
    if system is not None and (not isinstance(description, dict) or not description.get("trajectories")):
        raise ValueError(
            f"{store.place} has no trajectories that need a system.\n"
            "Usual cause: run returned numbers.\nFix: leave system out, or pass run=."
        )
    one = store.one()
    if description is None:
        return one
    try:
        tree = tree_of(description, system, store.place, table)
        # A store also has the arrays of a system, which is not known here.
        if not {name for name, _ in named_leaves(tree)} <= {*one}:
            raise ValueError("its structure has other values than its arrays.")
    except ValueError as error:
        if system is not None:
            raise
        warnings.warn(
            by_line(f"the values of {store.place} are a dictionary by name: {error}")
            + "\nIn any case: lj.open_sweep(path, run=run), with the function that was swept.",
            stacklevel=3,
        )
        return one
    names = iter([name for name, _ in named_leaves(tree)])
    return jax.tree.map(lambda _: one[next(names)], tree)


def as_run_returns(run: Callable, axes: Axes, store: Store) -> PyTree:
    """The shapes of one point's values, as `run` would return them.

    **Raises:** `ValueError` if the store has other values.
    """
    like = jax.eval_shape(run, {name: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for name, x in axes.values.items()})
    stored, here = shapes_of(store.one(), 0), shapes_of(like, 0)
    if stored != here:
        raise ValueError(
            f"run returns {here}, but {store.place} has {stored}.\nFix: the function that was swept; or leave run out."
        )
    return like


def _in_numpy(x: Any):
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _in_json(x: Any):
    return {"dtype": x.dtype.str, "shape": list(x.shape), "base64": base64.b64encode(x.tobytes()).decode()}


def _from_json(stored: dict):
    dtype, data = np.dtype(stored["dtype"]), base64.b64decode(stored["base64"], validate=True)
    expected = math.prod(stored["shape"]) * dtype.itemsize
    if dtype.kind not in KINDS_OF_ARRAY or dtype.itemsize == 0 or expected != len(data):
        raise ValueError(f"an array of its structure is said to be {dtype}, and has {len(data):,} bytes.")
    return np.frombuffer(data, dtype).reshape(stored["shape"]).copy()
