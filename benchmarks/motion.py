"""A motion, what is known of it, and how it is to be integrated: what `error_estimates.py` goes through."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from long_double import Integrated, reference

import lagjax as lj

DIGITS = 1e-13
# Of the span: how far an exact crossing may be from one that was found.
NEAR = 0.02


class Motion(NamedTuple):
    """A motion from (q0, v0) at ts[0], and its reference.

    - `exact(ts)` -> (q, v), leaves (T, ...); `source` says what it is; `known(ts)` (T,), how far, relative.
    - `tolerances`: rtol and atol; with fixed steps (`options` has a `dt0`) one only.
    - `order`: of the method. `events`: what `lj.integrate` takes; `when`: by name, the exact times next to found ones.
    - `floor`: what is below it, relative, is round-off.
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
        """The same with events by name, of guards that read arrays of states as well; their times are roots."""
        when = {name: lambda times, guard=event.guard: roots(self, guard, times) for name, event in events.items()}
        return self._replace(events=events, when=when)


def by_long_double(name, system, q0, v0, params, ts, field, start, seen, **how):
    """A motion whose reference is integrated in long double, by equations derived by hand."""
    found: Integrated = reference(field, start, seen)
    return Motion(name, system, q0, v0, params, ts, found.exact, "long double", found.known, **how)


def roots(motion, guard, times):
    """The zeros of a guard on the exact motion next to some times, by secants."""
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
        # What is left of a difference that is next to nothing is round-off.
        done = (abs(apart) < DIGITS * room) | (of_now == of_before)
        slope = np.where(done, np.inf, (of_now - of_before) / np.where(done, 1, apart))
        # A crossing that the exact motion does not have must not lead far away.
        before, of_before, now = now, of_now, np.clip(now - of_now / slope, earliest, latest)
    return now[np.argsort(order)]


def _rest(tree):
    if isinstance(tree, dict):
        return {name: _rest(part) for name, part in tree.items()}
    return np.asarray(tree)[1:]
