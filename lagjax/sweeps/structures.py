"""The structure of what `run` returned, for values that are read from a store or a pickle: written down as JSON.

Leaves are named, and trajectories written down as in their own files, without the functions of their systems. What
cannot be written down (a function among the values, an object of a class that JSON has no word for) has no such
description: its values are a dictionary by name.
"""

import base64
import pickle
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanics.signature import UnknownSystem
from lagjax.mechanics.written_trees import NotWritable, Reader, Writer
from lagjax.motion.saved import same_system, trajectory_of
from lagjax.motion.saving import described, parts
from lagjax.motion.trajectory import Trajectory
from lagjax.sweeps.axes import Axes
from lagjax.sweeps.fingerprint import named_leaves
from lagjax.sweeps.store import Store
from lagjax.sweeps.travelling import pickled, shapes_of

LEAF, MOTION = "leaf", "trajectory"


class _Given:
    """In a tree that is written down what is not: the role of a leaf, or of a trajectory."""

    def __init__(self, role: str):
        self.role = role


def written(like: PyTree, one: PyTree | None) -> dict[str, Any] | None:
    """The description of values like these; None where there is none. `one` has numbers, of which systems are asked."""
    names = iter([name for name, _ in named_leaves(like)])
    named = jax.tree.map(lambda x: _Given(f"{LEAF} {next(names)}"), like)
    motions, found = jax.tree.leaves(named, is_leaf=_is_motion), []
    motions = [x for x in motions if _is_motion(x)]
    asked = [x for x in jax.tree.leaves(one, is_leaf=_is_motion) if _is_motion(x)] if one is not None else motions
    writer = Writer(lambda value: value.role if isinstance(value, _Given) else None)
    count = iter(range(len(motions)))
    tree = jax.tree.map(lambda x: _Given(f"{MOTION} {next(count)}") if _is_motion(x) else x, named, is_leaf=_is_motion)
    try:
        for motion, numbers in zip(motions, asked):
            system = described(numbers) if one is not None else UnknownSystem(repr(motion.any_system), (), {}, None)
            # In NumPy: a process that works in float32 can read these, too.
            of = jax.tree.map(_in_numpy, {name: getattr(system, name) for name in system.__dataclass_fields__})
            nodes = parts(motion, lambda result: {"codes": result._value, "names": {}}) | {"system": of}
            found.append({name: writer.down(x, name) for name, x in nodes.items()})
        said = {"tree": writer.down(tree, "values"), "trajectories": found}
    except NotWritable:
        return None
    return said | {"arrays": {name: _in_json(x) for name, x in writer.arrays.items()}}


def read(said: dict[str, Any], system: Any, path: Any) -> PyTree:
    """The tree, with small arrays for leaves, whose values are of no use. Systems other than `system` stay unknown.

    **Raises:** `ValueError` where none of its trajectories was integrated with `system`, and for classes that are not
    found.
    """
    arrays = {name: _from_json(x) for name, x in said["arrays"].items()}
    refused, known = [], []

    def given(role):
        kind, _, which = role.partition(" ")
        if kind == LEAF:
            return jnp.zeros(())
        found = {name: reader.up(node) for name, node in said["trajectories"][int(which)].items()}
        about = UnknownSystem(**found["system"])
        kept = UnknownSystem(about.words, about.angles, {}, None)
        if system is not None:
            try:
                kept = same_system(system, about, path)
                known.append(kept)
            except ValueError as error:
                refused.append(error)
        return trajectory_of(found, kept)

    reader = Reader(arrays, given)
    tree = reader.up(said["tree"])
    if refused and not known:
        raise refused[0]
    return tree


def as_stored(store: Store, system: Any = None) -> PyTree | None:
    """One point's values, as shapes, as the store describes them; None where it does not, or a class is not found.

    **Raises:** `ValueError` where `system` is not the one of any trajectory, or there is none.
    """
    said = store.about.get("structure")
    if system is not None and (said is None or not said["trajectories"]):
        raise ValueError(
            f"{store.path} has no trajectories that ask for a system.\n"
            "Usual cause: run returned numbers; or a store in an earlier format.\nFix: leave system out, or give run=."
        )
    if said is None:
        return None
    try:
        tree = read(said, system, store.path)
    except ValueError as error:
        if system is not None:
            raise
        warnings.warn(
            f"the values of {store.path} are a dictionary by name: {error}\n"
            "Fix, where that does not help: lj.open_sweep(path, run=run), with the function that was swept.",
            stacklevel=3,
        )
        return None
    one = store.one()
    names = iter([name for name, _ in named_leaves(tree)])
    return jax.tree.map(lambda _: one[next(names)], tree)


def as_run_returns(run: Callable, axes: Axes, store: Store) -> PyTree:
    """The same: what `run` would return.

    **Raises:** `ValueError` where the store has others.
    """
    like = jax.eval_shape(run, {name: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for name, x in axes.values.items()})
    there, here = shapes_of(store.one(), 0), shapes_of(like, 0)
    if there != here:
        raise ValueError(
            f"run returns {here}, and {store.path} has {there}.\nFix: the function that was swept; or leave run out."
        )
    return like


class Travelling(NamedTuple):
    """Values in a pickle: their leaves, and their structure, as pickle has it and as JSON has it.

    Functions that pickle does not find, here or where it is read, are left out: then trajectories do not know their
    system.
    """

    leaves: list
    structure: bytes | None
    described: dict[str, Any] | None
    # Of the leaves. A system that is not known has none of those that it had.
    names: list[str]

    @classmethod
    def of(cls, values: PyTree) -> "Travelling":
        """Values, to be pickled."""
        leaves, structure = jax.tree.flatten(values)
        said = written(values, None) if any(map(_is_motion, jax.tree.leaves(values, is_leaf=_is_motion))) else None
        names = [] if said is None else [name for name, _ in named_leaves(values)]
        numbers = jax.tree.unflatten(structure, range(len(leaves)))
        # Where there is no other way, pickle says itself what it does not take.
        return cls(leaves, pickle.dumps(numbers) if said is None else pickled(numbers), said, names)

    def unpacked(self) -> PyTree:
        """The values again."""
        try:
            if self.structure is not None:
                return jax.tree.unflatten(jax.tree.structure(pickle.loads(self.structure)), self.leaves)
        except (AttributeError, ImportError):
            # Where it was written its functions had names.
            pass
        if self.described is not None:
            tree, leaves = read(self.described, None, None), dict(zip(self.names, self.leaves))
            return jax.tree.unflatten(jax.tree.structure(tree), [leaves[name] for name, _ in named_leaves(tree)])
        raise pickle.UnpicklingError(
            "the values of this sweep have functions among them, or objects of a class, that are not found here.\n"
            "Fix: import where they are defined before this; or lj.open_sweep, of a sweep in a store."
        )


def _is_motion(x):
    return isinstance(x, Trajectory)


def _in_numpy(x):
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _in_json(x):
    return {"dtype": x.dtype.str, "shape": list(x.shape), "base64": base64.b64encode(x.tobytes()).decode()}


def _from_json(said):
    data = base64.b64decode(said["base64"])
    return np.frombuffer(data, said["dtype"]).reshape(said["shape"]).copy()
