"""The structure of what `run` returned, described in JSON for values that are read from a store.

Leaves are named, and trajectories are described as in their own files, without the functions of their systems. Values
that contain a function, or an object of a class that cannot be described in JSON, have no such description: they are
read as a dictionary by name.
"""

import base64
import math
import warnings
from collections.abc import Callable
from typing import Any

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
from lagjax.sweep.axes import Axes
from lagjax.sweep.batch_program import is_motion
from lagjax.sweep.labels import motions_in, named_leaves, shapes_of
from lagjax.sweep.store import Store
from lagjax.system import UnknownSystem

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
            f"{store.path} has no trajectories that need a system.\n"
            "Usual cause: run returned numbers.\nFix: leave system out, or pass run=."
        )
    one = store.one()
    if description is None:
        return one
    try:
        tree = tree_of(description, system, store.path, table)
        # A store also has the arrays of a system, which is not known here.
        if not {name for name, _ in named_leaves(tree)} <= {*one}:
            raise ValueError("its structure has other values than its arrays.")
    except ValueError as error:
        if system is not None:
            raise
        warnings.warn(
            by_line(f"the values of {store.path} are a dictionary by name: {error}")
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
            f"run returns {here}, but {store.path} has {stored}.\nFix: the function that was swept; or leave run out."
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
