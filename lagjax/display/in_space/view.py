"""How a picture is seen: from where, how large, and on which grid.

With the unit vectors to the right, up, and towards the eye, and the eye at the distance D from the centre c of what is
drawn,

    w = (p - c)·toward,      s = scale D / (D - w),      across = left + s (p - c)·right,      down = top - s (p - c)·up
"""

import math
from typing import NamedTuple

import numpy as np

# The width of a picture, its least and largest height, and its margins for labels: left, top, right, bottom.
WIDTH, LOWEST, HIGHEST = 520.0, 260.0, 460.0
MARGINS = (52.0, 14.0, 34.0, 34.0)
# The eye's distance from the centre in half diagonals of what is drawn.
FAR = 4.0


class Grid(NamedTuple):
    """The floor under everything: its lines along x and y, and the heights that are marked beside it."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    floor: float
    step: float


class View(NamedTuple):
    """From where a picture is seen; `azimuth` and `elevation` of the eye in degrees; lengths in pixels."""

    centre: np.ndarray
    distance: float
    azimuth: float
    elevation: float
    scale: float
    left: float
    top: float
    height: float

    def axes(self) -> np.ndarray:
        """The unit vectors to the right, up, and towards the eye, as rows."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        toward = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        return np.stack([right, np.cross(toward, right), toward])

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where points (..., 3) are in the picture, (..., 2); how near they are (...); and pixels per unit there."""
        x, y, w = np.moveaxis((points - self.centre) @ self.axes().T, -1, 0)
        pixels = self.scale * self.distance / (self.distance - w)
        return np.stack([self.left + pixels * x, self.top - pixels * y], axis=-1), w, pixels


def grid_under(low: np.ndarray, high: np.ndarray) -> Grid:
    """A floor at the lowest height, with three to six squares along its longer side."""
    size = np.max(high - low)
    size = size if size > 0 else max(1.0, float(np.max(np.abs(high))))
    wide = max(float(np.max((high - low)[:2])), 0.4 * size)
    power = 10.0 ** math.floor(math.log10(wide / 4))
    step = min((m * power for m in (1, 2, 5, 10)), key=lambda step: abs(math.log(4 * step / wide)))
    lines = []
    for axis in range(2):
        first, last = math.floor(low[axis] / step + 1e-6), math.ceil(high[axis] / step - 1e-6)
        if last == first:
            first, last = first - 1, last + 1
        lines.append(step * np.arange(first, last + 1))
    # A label just above the floor would touch the floor's own.
    heights = step * np.arange(math.ceil(low[2] / step + 0.25), math.floor(high[2] / step + 1e-6) + 1)
    return Grid(*lines, heights if len(heights) else low[2:], float(low[2]), step)


def view_of(low: np.ndarray, high: np.ndarray, azimuth: float, elevation: float) -> tuple[View, Grid]:
    """The view in which the box between two corners, and the floor under it, fill the picture."""
    grid = grid_under(low, high)
    low = np.array([min(low[0], grid.x[0]), min(low[1], grid.y[0]), grid.floor])
    high = np.array([max(high[0], grid.x[-1]), max(high[1], grid.y[-1]), high[2]])
    centre, distance = (low + high) / 2, FAR * float(np.linalg.norm(high - low)) / 2
    plain = View(centre, distance, azimuth, elevation, 1.0, 0.0, 0.0, 0.0)
    ends = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    found = plain.seen(ends)[0]
    least, size = found.min(axis=0), np.ptp(found, axis=0)
    left, top, right, bottom = MARGINS
    scale = min((WIDTH - left - right) / size[0], (HIGHEST - top - bottom) / size[1])
    height = max(LOWEST, scale * size[1] + top + bottom)
    across = left + (WIDTH - left - right - scale * size[0]) / 2 - scale * least[0]
    down = top + (height - top - bottom - scale * size[1]) / 2 - scale * least[1]
    return View(centre, distance, azimuth, elevation, scale, across, down, height), grid


def labelled(values: np.ndarray, step: float) -> list[str]:
    """Numbers on a grid whose lines are `step` apart."""
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    # What is nearer than a thousandth of a square cannot be told apart.
    on_grid = np.abs(values / step - np.rint(values / step)) < 1e-3
    plain = on_grid & (1e-4 <= step < 1e6)
    return [f"{value:.{places}f}" if short else f"{value:.3g}" for value, short in zip(values, plain)]
