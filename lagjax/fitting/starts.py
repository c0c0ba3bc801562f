"""Where each run, or window of a run, starts: a guess, and the directions in which the guess may be wrong.

A start is written as `q = q_guess + N s`, with the columns of N along the constraints and not along what is known;
after that it is returned to the constraints, which other parameters may have moved.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Bool, Float

from lagjax.fitting.records import Record, Windows
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.coordinates import State
from lagjax.motion.consistent_state import consistent_state, free_coordinates, nearest_state
from lagjax.motion.integrate import integrate

# Samples from whose parabola position and velocity are read.
SAMPLES = 7


class Starts(eqx.Module):
    """Guessed starts of all windows (W, n), and the directions (W, n, k) in which they are unknown."""

    q: Float[Array, "W n"]
    v: Float[Array, "W n"]
    along_q: Float[Array, "W n k"]
    along_v: Float[Array, "W n k"]
    free_q: Bool[Array, "W n"]
    free_v: Bool[Array, "W n"]

    def state(self, s: Float[Array, " k"], system, t, params, unflatten):
        """(q, v) of one window, where `self` holds this window's entries and `s` its unknowns."""
        q, v = unflatten(self.q + self.along_q @ s), unflatten(self.v + self.along_v @ s)
        if not system.constraints:
            return q, v
        # What is not reached stays where it is: the integration then says that it is off the constraints.
        return nearest_state(system, t, q, v, params, self.free_q, self.free_v)[:2]


def starts(
    system, records: Sequence[Record], windows: Windows, params_of: Callable, options
) -> tuple[Starts, Callable]:
    """The guessed starts of all windows, and the function that makes a pytree of a vector of coordinates."""
    found, unflatten = [], None
    for r, record in enumerate(records):
        here = np.flatnonzero(windows.record == r)
        first = _guess(system, record, r, params_of(r))
        (x, unflatten), (u, _) = coordinates.flatten(first.q), coordinates.flatten(first.v)
        found.append((x, u))
        later = [_read_off(record, windows.sample[w][windows.real[w]]) for w in here[1:]]
        if len(here) > 1 and (None in later or coordinates.flatten(later[0][0])[0].size != x.size):
            later = _along_the_motion(system, first, windows.ts[here, 0], options)
        for q, v in later:
            s = coordinates.state(record.t[0], q, v, first.params)
            found.append((coordinates.flatten(s.q)[0], coordinates.flatten(s.v)[0]))
    q, v = (_stacked(part) for part in zip(*found))
    bases, free = [], []
    for w, r in enumerate(windows.record):
        here = State(windows.ts[w, 0], unflatten(q[w]), unflatten(v[w]), params_of(r))
        held = (records[r].hold_q, records[r].hold_v) if w in windows.first else (False, False)
        free.append([_free(here.q, hold) for hold in held])
        bases.append(_directions(system, here, *free[-1]))
    of_q, of_v = (max(basis[i].shape[1] for basis in bases) for i in (0, 1))
    wide = lambda basis, before, after: np.pad(basis, ((0, 0), (before, after)))
    along_q = np.stack([wide(a, 0, of_q + of_v - a.shape[1]) for a, _ in bases])
    along_v = np.stack([wide(b, of_q, of_v - b.shape[1]) for _, b in bases])
    free_q, free_v = (np.stack(part) for part in zip(*free))
    return Starts(q, v, along_q.astype(q.dtype), along_v.astype(q.dtype), free_q, free_v), unflatten


def _stacked(vectors):
    return coordinates.numpy_of(vectors).stack(vectors)


def _guess(system, record, r, params) -> State:
    q, v = record.q0, record.v0
    if q is None or v is None:
        read = _read_off(record, np.arange(len(record.t)))
        if read is None:
            raise ValueError(
                f"record {r} has no guess of its start, and no measured coordinates to read it from.\n"
                "Fix: lj.Record(..., q0=..., v0=...), alike to the state of lj.integrate."
            )
        q, v = (read[0] if q is None else q), (read[1] if v is None else v)
    s = coordinates.state(record.t[0], q, v, params)
    if not system.constraints:
        return s
    if coordinates.is_traced(s):
        raise TypeError(
            "the start of a constrained system is being traced, and its free directions are read off its values.\n"
            "Fix: give q0 and v0 of the record, and params, as numbers; measurements may be traced."
        )
    return State(s.t, *consistent_state(system, *s), s.params)


def _read_off(record, samples):
    """(q, v) at the first of some samples, from the parabola through the first measured coordinates; None without."""
    q = record.measured.get("q")
    if q is None:
        return None
    t = record.t[samples] - record.t[samples[0]]
    pairs = jax.tree.map(lambda x: _parabola(t.astype(x.dtype), x[samples]), q)
    return tuple(jax.tree.map(lambda x, pair, i=i: pair[i], q, pairs) for i in (0, 1))


def _parabola(t, x):
    """Value and slope at t = 0 of a parabola through the first samples that are not missing."""
    xp, shape = coordinates.numpy_of(x), x.shape[1:]
    values, slopes = [], []
    for column in x.reshape(len(t), -1).T:
        known = xp.isfinite(column)
        weight = known & (xp.cumsum(known) <= SAMPLES)
        scale = xp.max(xp.where(weight, t, 0.0))
        scale = xp.where(scale > 0, scale, 1.0)
        powers = (t / scale)[:, None] ** np.arange(3)
        found = xp.linalg.lstsq(powers * weight[:, None], xp.where(weight, column, 0.0))[0]
        values.append(found[0])
        slopes.append(found[1] / scale)
    return tuple(xp.stack(part).reshape(shape) for part in (values, slopes))


def _along_the_motion(system, first, ts, options):
    """The states at the starts of a record's later windows, along the motion from its guessed start."""
    known = {name: value for name, value in options.items() if name != "event"}
    motion = integrate(system, first.q, first.v, first.params, ts=ts, **(known | {"throw": False}))
    # Where the guess does not get so far, the start serves as well as anything.
    fill = lambda x: jnp.where(jnp.isfinite(x), x, x[:1])
    q, v = jax.tree.map(fill, (motion.q, motion.v))
    return [jax.tree.map(lambda x, i=i: x[i], (q, v)) for i in range(1, len(ts))]


def _free(q, hold):
    if isinstance(hold, bool):
        return np.full(len(coordinates.names(q)), not hold)
    return free_coordinates(q, hold)


def _directions(system, s: State, free_q, free_v):
    """Orthonormal directions, (n, k) of positions and of velocities, along the constraints and not of what is held."""
    if not system.constraints:
        return np.eye(len(free_q))[:, free_q], np.eye(len(free_v))[:, free_v]
    x, unflatten = coordinates.flatten(s.q)
    u, _ = coordinates.flatten(s.v)
    of_q = jax.jacfwd(lambda x: constraints.position_residual(system, s.t, x, s.params, unflatten))(x)
    of_v = jax.jacfwd(lambda u: constraints.velocity_residual(system, s.t, x, u, s.params, unflatten))(u)
    return _along(np.asarray(of_q), free_q), _along(np.asarray(of_v), free_v)


def _along(rows, free):
    basis = np.zeros((len(free), 0))
    if free.any():
        inner = scipy.linalg.null_space(rows[:, free], rcond=1e-9) if len(rows) else np.eye(int(free.sum()))
        basis = np.zeros((len(free), inner.shape[1]))
        basis[free] = inner
    return basis
