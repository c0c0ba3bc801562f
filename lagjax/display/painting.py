"""One frame as flat marks, the farthest first: faces of solids with their light, pieces of lines, dots, labels."""

from typing import NamedTuple

import numpy as np

from lagjax.display.in_space.scenery import InSpace
from lagjax.display.in_space.shapes import Shape
from lagjax.display.in_space.surfaces import Faces
from lagjax.display.in_space.view import Grid, View, labelled
from lagjax.display.plots import COLOURS

# The light comes from here, in space.
LIGHT = np.array([0.35, -0.45, 0.82])
# A face turned away from it has this share of the brightness of one that faces it; the lightest tone and trails have
# these shares of white.
DARKEST, LIGHTER, TRAIL = 0.5, 0.38, 0.55
# Lines are painted in pieces of at most this share of the view's distance, so that bodies can be in front of a part.
PIECE, MOST_PIECES = 0.02, 24
LINE, THIN, DOT = 2.2, 1.2, 7.0
# How far labels stand from the floor, as a share of its longer side.
OUT = 0.055
# Points of longer lines are not marked: such lines are outlines.
MARKED_UP_TO = 8
GRID, INK, NO_NAME = (0.82, 0.82, 0.82), (0.2, 0.2, 0.2), "#666666"


class Mark(NamedTuple):
    """A face (three or four corners), a piece of a line (two ends) or a dot (one place), in pixels; or a text there."""

    nearness: float
    at: np.ndarray
    color: tuple[float, float, float]
    width: float
    text: str = ""
    align: str = "center"


def colour_of(shape: Shape, bodies: list[str]) -> str:
    """The colour of a shape: its own, or that of its body."""
    if shape.color is not None:
        return shape.color
    return COLOURS[bodies.index(shape.owner) % (len(COLOURS) - 1)] if shape.owner in bodies else NO_NAME


def marks(frame: InSpace, view: View, paler: float = 0.0) -> list[Mark]:
    """What is painted of one frame (poses (7,), points (k, 3)), unordered; `paler`: how much white is mixed in."""
    found: list[Mark] = []
    bodies = list(frame.poses)
    for shape in frame.shapes:
        color = _rgb(colour_of(shape, bodies))
        if shape.surface is not None:
            found += _faces(frame.corners(shape)[0], shape.surface, color, view)
        elif shape.kind != "trail":
            places = np.stack([frame.place(anchor) for anchor in shape.anchors])
            ahead = view.distance if shape.kind in ("mark", "gap") else 0.0
            drawn = _line(places, color, view, shape.kind == "dot")
            found += [mark._replace(nearness=mark.nearness + ahead) for mark in drawn]
    for i, points in enumerate(frame.points.values(), start=len(bodies)):
        found += _line(points, _rgb(COLOURS[i % len(COLOURS)]), view, len(points) <= MARKED_UP_TO)
    return [mark._replace(color=_mixed(mark.color, paler)) for mark in found]


def trails(motion: InSpace, view: View) -> list[Mark]:
    """The paths of the points that leave trails, over all frames."""
    bodies, found = list(motion.poses), []
    for shape in motion.shapes:
        if shape.kind == "trail":
            path = np.atleast_2d(motion.place(shape.anchors[0]))
            found += _pieces(path, _mixed(_rgb(colour_of(shape, bodies)), TRAIL), THIN, view)
    for i, points in enumerate(motion.points.values(), start=len(bodies)):
        found += _pieces(points[:, -1], _mixed(_rgb(COLOURS[i % len(COLOURS)]), TRAIL), THIN, view)
    return found


def _faces(vertices: np.ndarray, surface: Faces, color, view: View):
    at, near, _ = view.seen(vertices)
    faces, p = surface.faces, vertices[surface.faces]
    normal = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    size = np.linalg.norm(normal, axis=1)
    eye = view.centre + view.distance * view.axes()[2]
    facing = np.sum(normal * (eye - p.mean(axis=1)), axis=1)
    normal = normal * (np.sign(facing) / np.where(size > 0, size, 1.0))[:, None]
    bright = DARKEST + (1 - DARKEST) * (1 + normal @ LIGHT) / 2
    shown = (facing > 0) if surface.closed else (facing != 0)
    nearness = near[faces].mean(axis=1)
    for k in np.flatnonzero(shown):
        base = np.asarray(_mixed(color, LIGHTER * surface.light[k]))
        yield Mark(nearness[k], at[faces[k]], _mixed(bright[k] * base, 0.0), 0.0)


def _line(points: np.ndarray, color, view: View, dots: bool):
    found = _pieces(points, color, LINE, view)
    if dots:
        at, near, _ = view.seen(points)
        # A dot is in front of the lines that end in it.
        found += [Mark(w + 0.01 * view.distance, x[None], color, DOT) for x, w in zip(at, near)]
    return found


def _pieces(points: np.ndarray, color, width: float, view: View):
    found = []
    for start, end in zip(points, points[1:]):
        count = np.linalg.norm(end - start) / (PIECE * view.distance)
        if not np.isfinite(count):
            continue
        cut = np.linspace(0.0, 1.0, int(np.clip(np.ceil(count), 1, MOST_PIECES)) + 1)
        at, near, _ = view.seen(start + cut[:, None] * (end - start))
        found += [Mark((near[k] + near[k + 1]) / 2, at[k : k + 2], color, width) for k in range(len(cut) - 1)]
    return found


def surroundings(grid: Grid, view: View) -> list[Mark]:
    """The floor's lines, the height beside it, and their labels."""
    toward = view.axes()[2]
    x, y, z = grid.x, grid.y, grid.floor
    segments = [[(a, y[0], z), (a, y[-1], z)] for a in x] + [[(x[0], b, z), (x[-1], b, z)] for b in y]
    found = [Mark(0.0, view.seen(np.array(s))[0], GRID, 0.8) for s in segments]
    # Labels stand at the edges nearer to the eye; the heights at the corner farthest to the left.
    out = OUT * max(np.ptp(x), np.ptp(y))
    side = [np.where(toward[i] > 0, e[-1], e[0]) + out * np.where(toward[i] > 0, 1, -1) for i, e in enumerate((x, y))]
    beyond = [s + out * np.where(toward[i] > 0, 1.2, -1.2) for i, s in enumerate(side)]
    for values, place, name, middle in (
        (x, lambda a: (a, side[1], z), "x", (x.mean(), beyond[1], z)),
        (y, lambda b: (side[0], b, z), "y", (beyond[0], y.mean(), z)),
    ):
        texts = labelled(values, grid.step)
        found += [_text(text, place(value), view) for text, value in zip(texts, values)]
        found.append(_text(name, middle, view))
    if abs(toward[2]) < 0.97:
        corners = np.array([(a, b, z) for a in (x[0], x[-1]) for b in (y[0], y[-1])])
        a, b, _ = corners[np.argmin(view.seen(corners)[0][:, 0])]
        found.append(Mark(0.0, view.seen(np.array([(a, b, z), (a, b, grid.z[-1])]))[0], GRID, 0.8))
        texts = labelled(grid.z, grid.step)
        found += [_text(f"{text} –", (a, b, height), view, "right") for text, height in zip(texts, grid.z)]
        top = view.seen(np.array([(a, b, grid.z[-1])]))[0]
        found.append(Mark(0.0, top - [0.0, 14.0], INK, 0.0, "z"))
    return found


def _text(text: str, place, view: View, align: str = "center"):
    return Mark(0.0, view.seen(np.array([place], float))[0], INK, 0.0, text, align)


def _rgb(color: str) -> tuple[float, float, float]:
    r, g, b = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return r, g, b


def _mixed(color, white: float) -> tuple[float, float, float]:
    r, g, b = (float(x + white * (1 - x)) for x in color)
    return r, g, b
