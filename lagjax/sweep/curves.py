"""What can be drawn of the values of several lanes: numbers, and curves against time or against their index."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate.trajectory.trajectory import Trajectory
from lagjax.system import coordinates

# More curves than this in one panel cannot be told apart.
MOST_CURVES = 14
INDEX = "index"


class Panel(NamedTuple):
    """Curves over one axis: `x` (N, T) named `across`, and `curves` by name, (N, T), for N lanes."""

    label: str
    across: str
    x: np.ndarray
    curves: dict[str, np.ndarray]


class Drawn(NamedTuple):
    """`numbers` by name, (N,); `panels`; and, in words, the values `left_out`."""

    numbers: dict[str, np.ndarray]
    panels: list[Panel]
    left_out: list[str]


def drawn(values: PyTree, of_motion: tuple[str, ...] = ("q", "v", "multipliers")) -> Drawn:
    """What can be drawn of values whose leaves have the lanes as first axis, (N, ...).

    A `Trajectory` gives the curves named in `of_motion` against its times. One number per lane stays a number. An array
    gives one curve per column, against the array `t` in the same dictionary if there is one, else against its index.
    """
    found = Drawn({}, [], [])
    leaves = jax.tree_util.tree_leaves_with_path(values, is_leaf=lambda x: isinstance(x, Trajectory))
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    for name, x in named.items():
        if isinstance(x, Trajectory) and np.ndim(x.t) > 2:
            found.left_out.append(f"{name or 'value'}, a batch of trajectories")
            continue
        if isinstance(x, Trajectory):
            found.panels.extend(_of_motion(name, x, of_motion))
            continue
        parent, _, last = name.rpartition(".")
        times = named.get(f"{parent}.t" if parent else "t")
        times = None if isinstance(times, Trajectory) else times
        if last == "t" and np.ndim(x) == 2 and len(named) > 1:
            continue
        for part, x in _real_parts(name or "value", np.asarray(x)):
            _add(found, part, x, times)
    return found


def _of_motion(name, motion, of_motion):
    t, prefix = np.asarray(motion.t), f"{name}: " if name else ""
    parts = {"q": motion.q, "v": motion.v, "multipliers": motion.multipliers}
    for part in of_motion:
        leaves = [np.asarray(x).reshape(*t.shape, -1) for x in jax.tree.leaves(parts[part])]
        if not leaves:
            continue
        one = jax.tree.map(lambda x: np.asarray(x)[0, 0], parts[part])
        columns = np.moveaxis(np.concatenate(leaves, axis=-1), -1, 0)
        curves = dict(zip(coordinates.names(one), columns))
        first = next(iter(curves))
        label = part if len(curves) > 1 or first == "q" else f"{part}: {first}"
        yield Panel(prefix + label, "t", t, curves)


def _real_parts(name, x):
    if np.iscomplexobj(x):
        return [(f"{name} (real)", x.real), (f"{name} (imaginary)", x.imag)]
    return [(name, x.astype(float))]


def _add(found, name, x, times):
    if x.ndim == 1:
        found.numbers[name] = x
        return
    columns = np.moveaxis(x.reshape(*x.shape[:2], -1), -1, 0)
    if len(columns) > MOST_CURVES or x.shape[1] < 2 or len(columns) == 0:
        found.left_out.append(f"{name} of shape {x.shape[1:]}")
        return
    inner = list(np.ndindex(*x.shape[2:]))
    suffixes = ["" if not i else str(list(i)) for i in inner]
    against_times = times is not None and np.shape(times) == x.shape[:2]
    at = np.asarray(times, float) if against_times else np.broadcast_to(np.arange(x.shape[1], dtype=float), x.shape[:2])
    curves = {name + end: column for end, column in zip(suffixes, columns)}
    found.panels.append(Panel(name, "t" if against_times else INDEX, at, curves))
