"""Pictures in space: one frame as flat marks, the farthest first; a film that can be turned; a figure of instants.

How a picture is seen: With the unit vectors to the right, up, and towards the eye, and the eye at the distance D from
the centre c of what is drawn,

    w = (p - c)·toward,      s = scale D / (D - w),      across = left + s (p - c)·right,      down = top - s (p - c)·up
"""

import html
import math
from typing import Any, NamedTuple

import numpy as np

from lagjax.display.page import encoded, encoded_once
from lagjax.display.plots import COLOURS, figure, names_as_they_are
from lagjax.display.scenery import Faces, InSpace, Shape

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


# From where a film is seen first, in degrees: from the right of -y, x to the right.
AZIMUTH, ELEVATION = -60.0, 22.0
# Names of more bodies than this are not listed: their colours repeat.
MOST_NAMES = 12
LOOK = {
    "light": LIGHT.tolist(), "darkest": DARKEST, "lighter": LIGHTER,
    "trail": TRAIL, "piece": PIECE, "pieces": MOST_PIECES, "line": LINE,
    "thin": THIN, "dot": DOT, "marked": MARKED_UP_TO, "out": OUT,
}  # fmt: skip


def film_in_space(
    t: np.ndarray, motion: InSpace, rate: float, trail: int, eye: tuple[float, float] = (AZIMUTH, ELEVATION)
) -> tuple[str, dict[str, Any]]:
    """A film as HTML with its first frame, and the data from which `space.js` plays it; of one frame, a still.

    **Arguments:** `t` (F,); `motion`: poses (N, F, 7) and points (N, F, k, 3) for N lanes, NaN in a lane without a
    motion; `rate`, `trail` as in `Animation`; `eye`: azimuth and elevation from where it is seen first, in degrees.
    """
    view, grid = view_of(*motion.extent(), *eye)
    is_still = len(t) == 1

    def lines(x: np.ndarray):
        return list(zip(x.tolist(), labelled(x, grid.step)))

    step = float(t[1] - t[0]) if len(t) > 1 else 1.0
    digits = max(0, math.ceil(-math.log10(abs(step))))
    bodies, names = list(motion.poses), [name for name in [*motion.poses, *motion.points] if name]
    about = f"{'Picture' if is_still else 'Motion'} in space" + (f" of {', '.join(names)}" if names else "")
    surfaces = list({id(shape.surface): shape.surface for shape in motion.shapes if shape.surface is not None}.values())
    colours = {name: _three_bytes(COLOURS[i % len(COLOURS)]) for i, name in enumerate(motion.points, start=len(bodies))}
    spec = {
        "rate": rate, "trail": trail, "start": float(t[0]), "step": step, "digits": digits, "frames": len(t),
        "about": about, "view": _plain(view), "look": LOOK, "bodies": len(bodies),
        "grid": {"floor": grid.floor, "x": lines(grid.x), "y": lines(grid.y), "z": lines(grid.z)},
        "poses": encoded_once(_poses(motion), "f4"),
        "surfaces": [
            {"vertices": encoded(s.vertices, "f4"), "light": encoded(s.light, "f4"), "closed": s.closed,
             "faces": encoded(s.faces, "i2" if len(s.vertices) < 2**15 else "i4")} for s in surfaces
        ],
        "shapes": [_shape(shape, bodies, surfaces) for shape in motion.shapes],
        "parts": [{"points": x.shape[-2], "xyz": encoded_once(x, "f4"), "color": colours[name]}
                  for name, x in motion.points.items()],
    }  # fmt: skip
    named = [
        f'<span><span style="color:{COLOURS[i % (len(COLOURS) - (i < len(bodies)))]}" aria-hidden="true">&#9679;</span>'
        f" {html.escape(str(name))}</span>"
        for i, name in enumerate([*motion.poses, *motion.points])
        if 1 < len(bodies) + len(motion.points) <= MOST_NAMES
    ]
    start = f"t = {float(t[0]):.{digits}f}"
    picture = _svg(motion, view, grid, html.escape(about if is_still else f"{about}, {start}"))
    film = f'<div data-film=""><div class="parts">{"".join(named)}</div>\n{picture}'
    if is_still:
        return f"{film}</div>", spec
    body = (
        f'{film}\n<div class="row" style="max-width:{WIDTH:.0f}px">'
        '<button type="button" aria-label="play">&#9654;</button>'
        f'<input type="range" aria-label="time" min="0" max="{len(t) - 1}" value="0"><output>{start}</output>'
        "</div></div>"
    )
    return body, spec


def _poses(motion: InSpace) -> np.ndarray:
    """All poses (N, F, bodies, 7), with unit quaternions: those between outputs are a little shorter."""
    if not motion.poses:
        return np.zeros(0)
    poses = np.stack(list(motion.poses.values()), axis=2)
    places, e = poses[..., :3], poses[..., 3:]
    return np.concatenate([places, e / np.linalg.norm(e, axis=-1, keepdims=True)], axis=-1)


def _plain(view: View) -> dict[str, Any]:
    return view._asdict() | {"centre": view.centre.tolist(), "width": WIDTH}


def _shape(shape: Shape, bodies: list[str], surfaces: list) -> dict[str, Any]:
    anchors = [
        {"body": None if a.body is None else bodies.index(a.body), "point": np.asarray(a.point).tolist(),
         "axes": np.asarray(a.axes).tolist()} for a in shape.anchors
    ]  # fmt: skip
    index = next((i for i, s in enumerate(surfaces) if s is shape.surface), None)
    color = _three_bytes(colour_of(shape, bodies))
    return {"kind": shape.kind, "anchors": anchors, "surface": index, "size": np.asarray(shape.size).tolist(),
            "color": color}  # fmt: skip


def _three_bytes(color: str) -> list[int]:
    return [int(color[i : i + 2], 16) for i in (1, 3, 5)]


def _svg(motion: InSpace, view: View, grid, words: str) -> str:
    """The first frame of the first lane, shown where scripts do not run."""
    found = sorted(marks(motion.at(0, 0), view), key=lambda mark: mark.nearness)
    drawn = "".join(map(_drawn, [*surroundings(grid, view), *found]))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" data-space="" role="img" aria-label="{words}" '
        f'viewBox="0 0 {WIDTH:.0f} {view.height:.0f}" width="{WIDTH:.0f}" font-family="sans-serif" '
        f'stroke-linecap="round" stroke-linejoin="round" style="max-width:100%;background:#fff">{drawn}</svg>'
    )


def _drawn(mark: Mark) -> str:
    colour = "#" + "".join(f"{round(255 * min(max(x, 0.0), 1.0)):02x}" for x in mark.color)
    x, y = mark.at[0]
    if mark.text:
        anchor = {"center": "middle", "right": "end"}[mark.align]
        return f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="{anchor}" font-size="11" fill="#333">{mark.text}</text>'
    path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in mark.at)
    if len(mark.at) > 2:
        return f'<path d="{path}z" fill="{colour}" stroke="{colour}" stroke-width=".8"/>'
    return f'<path d="{path}{"h0" * (len(mark.at) == 1)}" stroke="{colour}" stroke-width="{mark.width}"/>'


# Inches per pixel, and points per pixel: the widths of a figure for a column.
INCHES, POINTS = 1 / 96, 0.75
# How much white is mixed into the first of several instants.
PALEST = 0.8
# The width of a face's own edge, which covers the seam to its neighbour.
SEAM = 0.6


@names_as_they_are()
def stills_in_space(motion: InSpace, chosen: InSpace, azimuth: float, elevation: float):
    """Draw some instants of a motion in one figure, earlier ones paler, and the paths of trails over all of it.

    **Arguments:** `motion`: its frames, which are the picture's size; `chosen`: those drawn; `azimuth`, `elevation`: of
    the eye, in degrees.

    **Returns:** a matplotlib `Figure`.
    """
    view, grid = view_of(*motion.extent(), azimuth, elevation)
    fig, axes = figure(size=(WIDTH * INCHES, view.height * INCHES))
    count = len(next(iter((chosen.poses | chosen.points).values())))
    painted = trails(motion, view)
    for i in range(count):
        painted += marks(chosen.at(i), view, PALEST * (1 - i / (count - 1)) if count > 1 else 0.0)
    around, painted = surroundings(grid, view), sorted(painted, key=lambda mark: mark.nearness)
    # Seen from below, the floor is in front.
    painted_in(axes[0, 0], [*around, *painted] if elevation >= 0 else [*painted, *around], view)
    return fig


def painted_in(axis, found: list[Mark], view: View) -> None:
    """Paint marks in this order into a matplotlib axis, with their texts."""
    axis.set(xlim=(0.0, WIDTH), ylim=(view.height, 0.0), aspect="equal")
    axis.set_axis_off()
    _paint(axis, [mark for mark in found if not mark.text])
    for mark in found:
        if mark.text:
            axis.text(*mark.at[0], mark.text, fontsize=8, ha=mark.align, va="center", color=mark.color)


def _paint(axis, found: list[Mark]):
    """All in one collection, which matplotlib draws in the order given."""
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path

    turn = np.linspace(0.0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1) / 2
    paths = [Path(mark.at + mark.width * circle if len(mark.at) == 1 else mark.at) for mark in found]
    axis.add_collection(
        PathCollection(
            paths,
            facecolors=[(*mark.color, 0.0 if len(mark.at) == 2 else 1.0) for mark in found],
            edgecolors=[mark.color for mark in found],
            linewidths=[mark.width * POINTS if len(mark.at) == 2 else SEAM for mark in found],
            capstyle="round",
            joinstyle="round",
        )
    )
