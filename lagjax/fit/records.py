"""The measurements of one run, and records cut into windows of equal shape, so that one program serves them all."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.jaxtools import filled_up, is_traced, numpy_of
from lagjax.refusals import must, must_be_finite, must_have_values

# The kinds of measurement: `end` once per run, the others at each of its times.
KINDS = ("q", "v", "multipliers", "observed", "end")
# The interval between times of padding, relative to the shortest interval of a record.
PADDING = 1e-3


class Record(eqx.Module):
    """The measurements of one run.

    >>> import jax.numpy as jnp
    >>> t = jnp.linspace(0.0, 1.0, 50)
    >>> Record(t, q={"theta": 0.1 * jnp.cos(3.0 * t)}, v0={"theta": 0.0}, hold_v=True, sigma=0.001)
    Record(50 times from 0 to 1, q: theta)

    **Arguments,** T times and one or more kinds of measurement, each leaf (T, ...), NaN where a value is missing:

    - `t` (T,): increasing times, `[t]`. The run starts at `t[0]`, from a state that is an unknown of the fit.
    - `q`, `v`: coordinates and velocities, in the structure of the state; a dictionary may have only some of the names.
    - `multipliers`: by constraint name, some or all: a measured normal force, for example.
    - `observed`: in the structure that `observe(t, q, v, params)` of the fit returns.
    - `end`: measurements of the event that ended the motion, some of `{"t": ..., "q": ..., "v": ...,
      "multipliers": ...}`, without a time axis. The fit's `events` define what ends it.

    **Of the run:**

    - `q0`, `v0`: a guess of the state at `t[0]`. By default it is read off measured coordinates and velocities; if some
      were not measured, `q0` must be given, and their velocities are guessed to be zero.
    - `hold_q`, `hold_v`: which of them are known exactly, not guessed: `True` for all, or names of coordinates.
    - `params`: parameters that have another value in this run, by name: `{"omega": 3.0}`.
    - `sigma`: the standard deviation of the measurement errors, one number, or by kind, `{"q": 0.01, "end":
      {"t": 1e-3}}`; also arrays like the measurements: an infinite entry leaves a value out. Without it all errors are
      assumed to have the same size, which is estimated from the residuals.

    **Raises:** `ValueError` for times that do not increase, measurements of another length, infinite numbers, or a held
    start that is not given.
    """

    t: np.ndarray
    measured: dict[str, PyTree]
    q0: PyTree
    v0: PyTree
    hold_q: bool | tuple[str, ...] = eqx.field(static=True)
    hold_v: bool | tuple[str, ...] = eqx.field(static=True)
    params: dict[str, Any]
    sigma: Any

    def __init__(
        self,
        t: ArrayLike,
        q: PyTree = None,
        v: PyTree = None,
        multipliers: Mapping[str, ArrayLike] | None = None,
        observed: PyTree = None,
        end: Mapping[str, PyTree] | None = None,
        *,
        q0: PyTree = None,
        v0: PyTree = None,
        hold_q: bool | str | Iterable[str] = False,
        hold_v: bool | str | Iterable[str] = False,
        params: Mapping[str, ArrayLike] | None = None,
        sigma: PyTree = None,
    ):
        must_have_values(t, "the times of a record determine its shape", "times that are numbers")
        self.t = _times(t)
        given = zip(KINDS, (q, v, multipliers, observed, end))
        # Sorted as JAX sorts dictionaries: residuals are in this order.
        given = sorted(((kind, tree) for kind, tree in given if tree is not None), key=lambda pair: pair[0])
        self.measured = {kind: jax.tree.map(_as_floats, tree, is_leaf=_is_list_of_numbers) for kind, tree in given}
        if not jax.tree.leaves(self.measured):
            raise ValueError(
                'a record holds no measurement.\nFix: lj.Record(t, q={"theta": angles}), or v=, multipliers=, '
                "observed=, end=."
            )
        for name, x in channels(self.measured):
            _check(name, x, len(self.t))
        self.q0, self.v0 = q0, v0
        self.hold_q, self.hold_v = _held(hold_q), _held(hold_v)
        for which, held, known in (("q", self.hold_q, q0), ("v", self.hold_v, v0)):
            if held and known is None:
                raise ValueError(
                    f"hold_{which} says that {which}0 is known, but it is not given.\n"
                    f"Fix: lj.Record(..., {which}0=..., hold_{which}=...)."
                )
        self.params, self.sigma = dict(params or {}), sigma

    def channels(self) -> list[tuple[str, Array]]:
        """The measured quantities by name: `theta`, `v.theta`, `contact`, ..."""
        return channels(self.measured)

    def __repr__(self):
        names = {kind: ", ".join(jtu.keystr(p, simple=True, separator=".") for p, _ in jtu.tree_leaves_with_path(tree))
                 for kind, tree in self.measured.items()}  # fmt: skip
        kinds = "; ".join(f"{kind}: {of_kind}" if of_kind else kind for kind, of_kind in names.items())
        return f"Record({len(self.t)} times from {self.t[0]:.6g} to {self.t[-1]:.6g}, {kinds})"


def channels(measured: Mapping[str, PyTree]) -> list[tuple[str, Array]]:
    """The measured quantities by name."""
    leaves = [(kind, *leaf) for kind, tree in measured.items() for leaf in jtu.tree_leaves_with_path(tree)]
    return [(channel_name(kind, path), x) for kind, path, x in leaves]


def channel_name(kind: str, path: tuple[Any, ...]) -> str:
    """The name of a measured quantity as a user writes it."""
    name = jtu.keystr(path, simple=True, separator=".")
    if kind in ("q", "multipliers", "observed"):
        return name or kind
    return f"{kind}.{name}" if name else kind


def spread(x: Array):
    """The standard deviation of the values that are not missing; 0 if all are."""
    xp, known = numpy_of(x), ~numpy_of(x).isnan(x)
    count = xp.maximum(xp.sum(known), 1)
    mean = xp.sum(xp.where(known, x, 0.0)) / count
    return xp.sqrt(xp.sum(xp.where(known, (x - mean) ** 2, 0.0)) / count)


def _is_list_of_numbers(x: Any):
    return isinstance(x, list) and all(isinstance(y, int | float | np.number) for y in jax.tree.leaves(x))


def _as_floats(x: ArrayLike):
    return numpy_of(x).asarray(x, jnp.result_type(float))


def _held(hold: Any):
    if isinstance(hold, bool):
        return hold
    return (hold,) if isinstance(hold, str) else tuple(hold)


def _times(t: ArrayLike):
    t = np.asarray(t, np.result_type(np.asarray(t).dtype, np.float32))
    must(t.ndim == 1 and len(t) >= 2, "the times of a record must be a vector of two or more", t)
    must_be_finite(t, "the times of a record", "drop these samples")
    late = np.flatnonzero(np.diff(t) <= 0)
    if late.size:
        i = int(late[0])
        raise ValueError(
            f"the times of a record must increase, but t[{i + 1}] = {t[i + 1]:.9g} follows t[{i}] = {t[i]:.9g}.\n"
            "Usual cause: two records in one file, or a repeated time.\n"
            "Fix: order = np.argsort(t); sort the measurements with it; for several runs, one lj.Record each."
        )
    return t


def _check(name: str, x: Array, count: int):
    if not name.startswith("end") and (x.ndim == 0 or len(x) != count):
        raise ValueError(
            f"'{name}' has the shape {x.shape}, but the record has {count} times.\n"
            "Usual cause: time as the second axis, or samples dropped from one of the two.\n"
            "Fix: the first axis is time; write NaN where a value is missing."
        )
    if not is_traced(x) and np.any(np.isinf(x)):
        raise ValueError(f"'{name}' contains infinity.\nFix: write NaN where a value is missing.")


class Windows(NamedTuple):
    """All records, cut into windows with the same number of times.

    - `ts` (W, T): times; a window that the next one continues ends with the next one's first time.
    - `real` (W, T): which are times of the record, not padding and not that last time.
    - `sample` (W, T): their indices in their record.
    - `last` (W,): the index of the last time that is not padding. `seam` (W,): whether the next window continues there.
    - `record` (W,): the record that a window belongs to.
    """

    ts: Float[np.ndarray, "W T"]
    real: Bool[np.ndarray, "W T"]
    sample: Int[np.ndarray, "W T"]
    last: Int[np.ndarray, " W"]
    seam: Bool[np.ndarray, " W"]
    record: Int[np.ndarray, " W"]

    @property
    def count(self) -> int:
        """How many windows there are."""
        return len(self.record)

    @property
    def longest(self) -> int:
        """The number of times in the longest window, without padding."""
        return int(np.max(self.last)) + 1

    @property
    def first(self) -> np.ndarray:
        """The first window of each record."""
        return np.flatnonzero(np.diff(self.record, prepend=-1))

    def gather(self, of_records: Sequence[Array]) -> Array | np.ndarray:
        """Samples (T_r, ...) of each record as (W, T, ...), NaN where there are none."""
        rows, xp = [], numpy_of(of_records)
        for w, r in enumerate(self.record):
            x = of_records[r]
            where = self.real[w].reshape(-1, *(1,) * (x.ndim - 1))
            rows.append(xp.where(where, x[self.sample[w]], np.nan))
        return xp.stack(rows)


def closest(t: Float[np.ndarray, " n"], dtype: Any) -> float:
    """The interval of padding times, which costs next to nothing and is above round-off."""
    return max(PADDING * np.min(np.diff(t)), 8 * np.finfo(dtype).eps * np.max(np.abs(t)))


def padded(t: Float[np.ndarray, " n"], length: int, step: float) -> Float[np.ndarray, " length"]:
    """Times filled up to a length by others, at intervals of `step`."""
    return np.concatenate([t, t[-1] + step * (1 + np.arange(length - len(t)))])


def cut(records: Sequence[Record], window: float | None, dtype: Any) -> Windows:
    """Cut records into windows of a given length in time, or into one window each."""
    pieces = []
    for r, record in enumerate(records):
        t, span = record.t, record.t[-1] - record.t[0]
        must(window is None or window > 0, "window must be a positive length of time", window)
        longest = np.max(np.diff(t))
        if window is not None and window < 2 * longest:
            # Rounded to three digits it is still long enough.
            enough = max(20 * np.median(np.diff(t)), 2.1 * longest)
            raise ValueError(
                f"window = {window:.6g} is shorter than two intervals of a record, of {longest:.6g}.\n"
                f"Fix: a window with several samples, such as window={enough:.3g}."
            )
        count = 1 if window is None else max(1, math.ceil(span / window * (1 - 1e-9)))
        edges = np.searchsorted(t, t[0] + span / count * np.arange(count) * (1 - 1e-12))
        edges = np.append(edges, len(t))
        pieces += [(r, edges[i], edges[i + 1], i + 1 < count) for i in range(count)]
    length = filled_up(int(max(stop - start + seamed for _, start, stop, seamed in pieces)))
    ts, sample = np.zeros((len(pieces), length)), np.zeros((len(pieces), length), int)
    real = np.zeros((len(pieces), length), bool)
    for w, (r, start, stop, seamed) in enumerate(pieces):
        t, n = records[r].t, stop - start
        ts[w] = padded(t[start : stop + seamed], length, closest(t, dtype))
        sample[w, :n], real[w, :n] = np.arange(start, stop), True
    last = np.array([stop - start + seamed - 1 for _, start, stop, seamed in pieces])
    return Windows(
        np.asarray(ts, dtype),
        real,
        sample,
        last,
        np.array([seamed for *_, seamed in pieces]),
        np.array([r for r, *_ in pieces]),
    )
