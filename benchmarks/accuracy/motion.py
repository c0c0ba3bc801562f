"""A motion, its reference, and how to integrate it: the cases of `error_estimates.py`."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

import lagjax as lj
from benchmarks.accuracy.long_double import Integrated, reference

DIGITS = 1e-13
# How far an exact crossing may be from one that was found, as a fraction of the span.
NEAR = 0.02


class Motion(NamedTuple):
    """A motion from (q0, v0) at ts[0], and its reference.

    - `exact(ts)` -> (q, v), leaves (T, ...); `source` says what it is; `known(ts)` (T,) is its relative error.
    - `tolerances`: rtol and atol; only one with fixed steps (if `options` has a `dt0`).
    - `order` of the method. `events`: as for `lj.integrate`; `when`: by name, the exact times next to found ones.
    - `floor`: relative errors below it are round-off.
    """

    name: str
    system: lj.System
    q0: Any
    v0: Any
    params: Any
    ts: np.ndarray
    exact: Callable
    source: str
    known: Callable = lambda ts: np.zeros(len(ts))
    tolerances: tuple = (1e-4, 1e-7, 1e-10)
    method: Any = None
    order: int = 8
    options: Mapping = {}
    events: Mapping = {}
    when: Mapping = {}
    floor: float = DIGITS

    def crossing(self, **events):
        """The same with events by name, whose guards also accept arrays of states; their exact times are roots."""
        when = {name: lambda times, guard=event.guard: roots(self, guard, times) for name, event in events.items()}
        return self._replace(events=events, when=when)


def by_long_double(name, system, q0, v0, params, ts, field, start, to_qv, **how):
    """A motion whose reference is integrated in long double from equations derived by hand."""
    found: Integrated = reference(field, start, to_qv)
    return Motion(name, system, q0, v0, params, ts, found.exact, "long double", found.known, **how)


def roots(motion, guard, times):
    """The zeros of a guard on the exact motion next to some times, by the secant method."""
    order = np.argsort(times)
    before, now = np.asarray(times)[order], np.asarray(times)[order] + 1e-6

    room = NEAR * abs(motion.ts[-1] - motion.ts[0])
    earliest, latest = before - room, before + room

    def value(at):
        q, v = motion.exact(np.concatenate([motion.ts[:1], at]))
        return np.asarray(guard(at, *(_rest(part) for part in (q, v)), motion.params), float)

    of_before = value(before)
    for _ in range(5):
        of_now, apart = value(now), now - before
        # A tiny difference consists of round-off.
        done = (abs(apart) < DIGITS * room) | (of_now == of_before)
        slope = np.where(done, np.inf, (of_now - of_before) / np.where(done, 1, apart))
        # If the exact motion lacks a crossing, the search must not move far away.
        before, of_before, now = now, of_now, np.clip(now - of_now / slope, earliest, latest)
    return now[np.argsort(order)]


def _rest(tree):
    if isinstance(tree, dict):
        return {name: _rest(part) for name, part in tree.items()}
    return np.asarray(tree)[1:]
