"""Reference motions, integrated in long double by an integrator that has nothing in common with lagjax's.

Gragg, Bulirsch and Stoer's extrapolation of the modified midpoint rule, with 2, 4, ..., 2 k substeps (order 2 k), in
NumPy's long double, of 64 bits of mantissa on x86. It checks its own results: it runs once with k = 8 and once with k =
10 and other steps. Their difference shows, output by output, how accurate the result is, however much the motion
amplifies errors.

The equations `field(t, y)` are written by hand, and all numbers are exactly those of the double precision problem.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.9.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

LONG = np.longdouble
COLUMNS = (8, 10)
# The round-off of a step's increment is amplified by about the sum of the absolute weights of the last column.
TOLERANCE = LONG(2e-18)
MOST_STEPS = 200_000


def exactly(numbers):
    """A tree of doubles as long doubles of the same values."""
    return jax.tree.map(lambda x: LONG(x) if np.ndim(x) == 0 else np.asarray(x, LONG), numbers)


def step(field, t, y, length, columns):
    """The increment of one step, and the difference of the last two columns."""
    slope, above = field(t, y), []
    for j in range(1, columns + 1):
        count = 2 * j
        h = length / count
        # Increments, not states: their round-off is smaller.
        before, now = 0 * y, h * slope
        for i in range(1, count):
            before, now = now, before + 2 * h * field(t + i * h, y + now)
        row = [now]
        for i in range(1, j):
            fewer = 2 * (j - i)
            row.append(row[-1] + (row[-1] - above[i - 1]) * LONG(fewer**2) / LONG(count**2 - fewer**2))
        above = row
    return row[-1], row[-1] - row[-2]


def integrated(field, start, ts, columns):
    """States at `ts`, (T, n), from `start` at ts[0]; forward or backward in time."""
    ts, y = np.asarray(ts, LONG), np.asarray(start, LONG)
    t, scale, length = ts[0], np.abs(y), (ts[-1] - ts[0]) * LONG(1e-3)
    found = [y]
    for end in ts[1:]:
        length = np.copysign(length, end - t)
        while t != end:
            if abs(length) < 1e-15 * abs(ts[-1] - ts[0]):
                raise RuntimeError(f"the reference cannot integrate beyond t = {float(t)}")
            last = abs(length) >= abs(end - t)
            h = end - t if last else length
            change, error = step(field, t, y, h, columns)
            scale = np.maximum(scale, np.abs(y + change))
            off = np.max(np.abs(error)) / np.max(scale) / TOLERANCE
            if off <= 1:
                t, y = (end if last else t + h), y + change
            # A step shortened by an output says little about the next step.
            proposed = h * min(LONG(3), LONG(0.8) * max(off, LONG(1e-30)) ** LONG(-1 / (2 * columns - 1)))
            if off > 1 or not last or abs(proposed) > abs(length):
                length = proposed
        found.append(y)
    return np.stack(found)


class Integrated(NamedTuple):
    """A reference motion: `exact(ts)` -> (q, v), and `known(ts)`, its own error at each time.

    `field(t, y)` in long double; `start` (n,), its state at ts[0]; `to_qv(y)`: states (T, n) to (q, v).
    """

    field: Callable
    start: Any
    to_qv: Callable
    computed: dict

    def at(self, ts, columns):
        key = (columns, np.asarray(ts).tobytes())
        if key not in self.computed:
            self.computed[key] = self.to_qv(integrated(self.field, self.start, ts, columns))
        return self.computed[key]

    def exact(self, ts):
        """Coordinates and velocities at the times, leaves (T, ...)."""
        return self.at(ts, COLUMNS[1])

    def known(self, ts):
        """The difference of two settings at each time, (T,), relative to each number's largest value."""
        one, other = (jax.tree.leaves(self.at(ts, columns)) for columns in COLUMNS)
        return worst(one, other, [largest(leaf) for leaf in other])


def reference(field, start, to_qv):
    """An `Integrated` from numbers in double precision."""
    return Integrated(field, np.asarray(start, LONG), to_qv, {})


def largest(leaf):
    """The largest value of each number of a leaf (T, ...) over time, 1 if it is always zero."""
    top = np.max(np.abs(leaf), axis=0)
    return np.where(top > 0, top, 1)


def worst(one, other, scales):
    """The largest relative difference of two lists of leaves at each time, (T,)."""
    apart = [np.abs(a - b) / scale for a, b, scale in zip(one, other, scales, strict=True)]
    return np.max([x.reshape(len(x), -1).max(axis=1) for x in apart], axis=0)
