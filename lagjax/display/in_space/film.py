"""A film in space as HTML: its first frame as an SVG, and the numbers from which `space.js` paints all on a canvas."""

import html
import math
from typing import Any

import numpy as np

from lagjax.display.in_space import painting
from lagjax.display.in_space.painting import Mark, colour_of, marks, surroundings
from lagjax.display.in_space.scenery import InSpace
from lagjax.display.in_space.shapes import Shape
from lagjax.display.in_space.view import WIDTH, View, labelled, view_of
from lagjax.display.plots import COLOURS
from lagjax.display.web_page.page import encoded

# From where a film is seen first, in degrees: from the right of -y, x to the right.
AZIMUTH, ELEVATION = -60.0, 22.0
# Names of more bodies than this are not listed: their colours repeat.
MOST_NAMES = 12
LOOK = {
    "light": painting.LIGHT.tolist(), "darkest": painting.DARKEST, "lighter": painting.LIGHTER,
    "trail": painting.TRAIL, "piece": painting.PIECE, "pieces": painting.MOST_PIECES, "line": painting.LINE,
    "thin": painting.THIN, "dot": painting.DOT, "marked": painting.MARKED_UP_TO, "out": painting.OUT,
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
    colours = {name: _rgb(COLOURS[i % len(COLOURS)]) for i, name in enumerate(motion.points, start=len(bodies))}
    spec = {
        "rate": rate, "trail": trail, "start": float(t[0]), "step": step, "digits": digits, "frames": len(t),
        "about": about, "view": _plain(view), "look": LOOK, "bodies": len(bodies),
        "grid": {"floor": grid.floor, "x": lines(grid.x), "y": lines(grid.y), "z": lines(grid.z)},
        "poses": encoded(_poses(motion), "f4"),
        "surfaces": [
            {"vertices": encoded(s.vertices, "f4"), "light": encoded(s.light, "f4"), "closed": s.closed,
             "faces": encoded(s.faces, "i2" if len(s.vertices) < 2**15 else "i4")} for s in surfaces
        ],
        "shapes": [_shape(shape, bodies, surfaces) for shape in motion.shapes],
        "parts": [{"points": x.shape[-2], "xyz": encoded(x, "f4"), "color": colours[name]}
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
    color = _rgb(colour_of(shape, bodies))
    return {"kind": shape.kind, "anchors": anchors, "surface": index, "size": np.asarray(shape.size).tolist(),
            "color": color}  # fmt: skip


def _rgb(color: str) -> list[int]:
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
