"""A film that plays in a notebook or a browser, and what one state looks like.

Of points in the plane a film is one SVG, its numbers, and a short script. It needs no network, no encoder and no other
file. If scripts do not run (an untrusted notebook, a preview), the first frame is shown. Coordinates are integers in
tenths of a pixel, with two bytes each. A film may have several lanes; the page shows one of them. Films in space are
those of `painting.py`.
"""

import html
import math
from pathlib import Path
from typing import Any

import numpy as np

from lagjax.display import films, plots
from lagjax.display.page import as_page, encoded_once, fragment, in_bytes, whole
from lagjax.display.painting import film_in_space, stills_in_space
from lagjax.display.plots import COLOURS
from lagjax.display.scenery import InSpace

# The largest field of the picture in tenths of a pixel, and its margins: left, top, right, bottom.
FIELD = (4200, 3600)
MARGINS = (520, 80, 160, 440)
# A direction with little motion is shown at least as wide as this fraction of the other direction.
NARROWEST = 0.3
# Points of longer lines are not marked: such lines are outlines.
MARKED_UP_TO = 8
# The coordinate that marks a lane without a motion for the script.
NOWHERE = -32768


class Animation:
    """A motion that plays in a notebook, and in a browser from the page that `save` writes.

    - `t` (F,): the time of each frame; `points`: the points drawn, by name, (F, k, 2), or (F, k, 3) in space; or an
      `InSpace`, what is drawn of bodies.
    - `rate`: frames per second; `trail`: the length of a trail in frames.

    >>> import numpy as np
    >>> t = np.linspace(0.0, 1.0, 5)
    >>> points = {"ball": np.stack([t, t * (1.0 - t)], axis=1)[:, None]}
    >>> print(Animation(t, points, rate=25.0, trail=3).t[-1])
    1.0
    """

    def __init__(self, t: np.ndarray, points: dict[str, np.ndarray] | InSpace, rate: float, trail: int):
        self.t, self.points, self.rate, self.trail = t, points, rate, trail

    def save(self, path) -> None:
        """Write a page (`.html`) that plays in any browser, without Python or a network; or the film (`.gif`, `.mp4`).

        A GIF or MP4 is painted by matplotlib, a few frames a second; MP4 needs ffmpeg, of the system or by
        `pip install imageio-ffmpeg`. In space it is seen from where the page shows it first.

        **Raises:** `ValueError` for another kind of file, and for MP4 without ffmpeg; `ImportError` for a GIF or MP4
        without matplotlib.
        """
        path = Path(path)
        if path.suffix.lower() in films.SUFFIXES:
            return films.write(path, self.t, self.points, self.rate, self.trail)
        page = as_page(path, '; .save("{}.gif") and .save("{}.mp4") are films, too')
        page.write_text(whole("Motion", self._repr_html_()), encoding="utf-8")

    def _repr_html_(self):
        points = self.points
        one = points.at(None) if isinstance(points, InSpace) else {name: x[None] for name, x in points.items()}
        body, spec = film(self.t, one, self.rate, self.trail)
        return fragment(body, spec, film_scripts(spec), "film(root, spec);")

    def __repr__(self):
        seconds = (len(self.t) - 1) / self.rate
        return (
            f"Animation of {len(self.t)} frames, {seconds:.3g} s, {in_bytes(len(self._repr_html_()))}: "
            'plays in a notebook, and with .save("motion.html") in a browser'
        )


def film_scripts(spec: dict[str, Any]) -> tuple[str, ...]:
    """The scripts that play a film with this data, as `film(root, spec)`."""
    return "decode.js", "player.js", "space.js" if "view" in spec else "film.js"


def film(t: np.ndarray, points: dict[str, np.ndarray] | InSpace, rate: float, trail: int) -> tuple[str, dict[str, Any]]:
    """A film as HTML with its first frame, and the data from which `film_scripts` play it.

    **Arguments:** `t` (F,), two times or more; `points` by name, (N, F, k, 2) for N lanes, NaN in a lane without a
    motion; or (N, F, k, 3); or an `InSpace` with lanes; `rate`, `trail` as in `Animation`.
    """
    if not isinstance(points, InSpace) and next(iter(points.values())).shape[-1] == 3:
        points = InSpace((), {}, points)
    if isinstance(points, InSpace):
        return film_in_space(t, points, rate, trail)
    low, size, scale = _field(points)
    parts = {name: _in_tenths_of_pixels(x, low, size, scale) for name, x in points.items()}
    step = float(t[1] - t[0])
    digits = max(0, math.ceil(-math.log10(abs(step))))
    about = "Motion" + "".join(f" of {name}" for name in [", ".join(filter(None, parts))] if name)
    spec = {"rate": rate, "trail": trail, "start": float(t[0]), "step": step, "digits": digits, "frames": len(t)}
    coded = [{"points": x.shape[2], "xy": encoded_once(x, "i2", NOWHERE)} for x in parts.values()]
    spec |= {"about": about, "parts": coded}
    start = f"t = {float(t[0]):.{digits}f}"
    body = (
        f'<div data-film=""><div class="parts">{_legend(parts)}</div>\n'
        f"{_picture(parts, low, size, scale, html.escape(f'{about}, {start}'))}\n"
        '<div class="row" style="max-width:520px"><button type="button" aria-label="play">&#9654;</button>'
        f'<input type="range" aria-label="time" min="0" max="{len(t) - 1}" value="0"><output>{start}</output>'
        "</div></div>"
    )
    return body, spec


def still_in_plane(points: dict[str, np.ndarray]) -> str:
    """One instant of points in the plane, (1, k, 2) by name, as HTML."""
    lanes = {name: x[None] for name, x in points.items()}
    low, size, scale = _field(lanes)
    parts = {name: _in_tenths_of_pixels(x, low, size, scale) for name, x in lanes.items()}
    named = ", ".join(filter(None, parts))
    words = html.escape("Picture" + (f" of {named}" if named else ""))
    return f'<div class="parts">{_legend(parts)}</div>\n{_picture(parts, low, size, scale, words)}'


def _legend(parts):
    dot = '<span><span style="color:{}" aria-hidden="true">&#9679;</span> {}</span>'
    return "".join(dot.format(_colour(i), html.escape(str(x))) for i, x in enumerate(parts) if len(parts) > 1)


def _field(points):
    """The lower left corner and the size of the field, and tenths of a pixel per unit, the same in both directions."""
    all_points = np.concatenate([x.reshape(-1, 2) for x in points.values()])
    all_points = all_points[np.isfinite(all_points).all(axis=1)]
    low, high = all_points.min(axis=0), all_points.max(axis=0)
    size = high - low
    size = np.maximum(size, NARROWEST * size.max())
    size = 1.1 * np.where(size > 0, size, 1.0)
    return (low + high - size) / 2, size, float(np.min(np.array(FIELD) / size))


def _in_tenths_of_pixels(x, low, size, scale):
    left, top, *_ = MARGINS
    across, up = np.moveaxis((x - low) * scale, -1, 0)
    drawn = np.rint(np.stack([left + across, top + size[1] * scale - up], axis=-1))
    return np.where(np.isfinite(drawn), drawn, NOWHERE).astype(np.int16)


def _picture(parts, low, size, scale, words):
    """The SVG: frame, ticks, and the first frame's points."""
    left, top, right, bottom = MARGINS
    width, height = np.rint(size * scale).astype(int)
    drawn = [
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#999" stroke-width="8"/>'
    ]
    text = '<text x="{}" y="{}" text-anchor="{}" style="font-size:125px" fill="#222">{}</text>'
    grid = '<path d="{}" stroke="#ddd" stroke-width="5"/>'
    for value, label in _ticks(low[0], low[0] + size[0]):
        x = round(left + (value - low[0]) * scale)
        drawn += [grid.format(f"M{x} {top}v{height}"), text.format(x, top + height + 150, "middle", label)]
    for value, label in _ticks(low[1], low[1] + size[1]):
        y = round(top + height - (value - low[1]) * scale)
        drawn += [grid.format(f"M{left} {y}h{width}"), text.format(left - 50, y + 40, "end", label)]
    drawn.append(text.format(left + width // 2, top + height + 330, "middle", "x"))
    drawn.append(text.format(70, top + height // 2, "middle", "y"))
    drawn += [_part(i, x[0, 0]) for i, x in enumerate(parts.values())]
    whole = (left + width + right, top + height + bottom)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{words}" '
        f'viewBox="0 0 {whole[0]} {whole[1]}" width="{whole[0] // 10}" font-family="sans-serif" '
        f'style="max-width:100%;background:#fff">{"".join(drawn)}</svg>'
    )


def _part(i, points):
    """A trail, a line and its dots, which the script moves."""
    colour = _colour(i)
    shown = [(x, y) for x, y in points.tolist() if x != NOWHERE]
    line = " ".join(f"{x} {y}" for x, y in shown)
    dots = "".join(f"M{x} {y}h0" for x, y in shown)
    marks = f'<path d="{dots}" stroke="{colour}" stroke-width="110" stroke-linecap="round"/>'
    return (
        f'<g data-part="" fill="none" stroke="{colour}" stroke-linejoin="round">'
        f'<polyline points="" stroke-width="16" stroke-opacity="0.45"/><polyline points="{line}" stroke-width="24"/>'
        f"{marks if len(points) <= MARKED_UP_TO else ''}</g>"
    )


def _colour(i):
    return COLOURS[i % len(COLOURS)]


def _ticks(low, high):
    """Three to six round numbers between `low` and `high`, and their labels."""
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = min((m * power for m in (1, 2, 5, 10)), key=lambda step: abs(math.log(step / rough)))
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    values = [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [(value, f"{value:.{places}f}" if 1e-4 <= step < 1e6 else f"{value:.3g}") for value in values]


# Dots per inch of a picture in pixels.
DPI = 200


class Still:
    """A state as it looks, from `lj.draw`: in a notebook, as a page, or as a figure for a paper.

    In space it can be turned, moved and zoomed in a notebook and on the page that `save("arm.html")` writes.

    >>> import lagjax as lj
    >>> arm = lj.bodies.Body("arm", 1.0, (0.1, 0.1, 0.01))
    >>> pivot = lj.bodies.spherical(lj.bodies.ground.at(), arm.at((0.0, 0.0, 0.5)))
    >>> print(lj.draw(lj.bodies.multibody([arm], {"pivot": pivot}), {"arm": lj.bodies.Pose.at((0.0, 0.0, -0.7))}))
    Picture of 'arm': turns in a notebook, and with .save("picture.html") in a browser; .figure() is for papers
      apart: 'arm' from the ground by 0.2

    - `points`: what is drawn, by name, (1, k, 2) or (1, k, 3), or of bodies in space an `InSpace` of one frame; `eye`:
      azimuth and elevation from where it is seen, in degrees.
    """

    def __init__(self, points: dict[str, np.ndarray] | InSpace, eye: tuple[float, float]):
        in_space = not isinstance(points, InSpace) and next(iter(points.values())).shape[-1] == 3
        self.points, self.eye = InSpace((), {}, points) if in_space else points, eye

    def figure(self):
        """Return a matplotlib `Figure`. Needs matplotlib (`pip install "lagjax[plot]"`)."""
        if isinstance(self.points, InSpace):
            return stills_in_space(self.points, self.points, *self.eye)
        return plots.stills(self.points, self.points)

    def save(self, path) -> None:
        """Write a page (`.html`), which needs no network, or the figure (`.pdf`, `.svg`, `.png`)."""
        path = Path(path)
        if path.suffix.lower() in (".html", ".htm"):
            path.write_text(whole("Picture", self._repr_html_()), encoding="utf-8")
        else:
            self.figure().savefig(path, dpi=DPI, bbox_inches="tight")

    def apart(self) -> dict[tuple[str, str], float]:
        """Which pairs of bodies a joint should hold together at a point, and does not: how far that is, `[length]`."""
        points, found = self.points, {}
        if isinstance(points, InSpace):
            for shape in (x for x in points.shapes if x.kind == "gap"):
                a, b = ("the ground" if x.body is None else f"'{x.body}'" for x in shape.anchors)
                found[b, a] = max(points.apart(shape), found.get((b, a), 0.0))
        return found

    def _repr_html_(self):
        if isinstance(self.points, InSpace):
            body, spec = film_in_space(np.zeros(1), self.points.at(None), 1.0, 0, self.eye)
            return fragment(body, spec, film_scripts(spec), "film(root, spec);")
        return fragment(still_in_plane(self.points), {}, ())

    def __repr__(self):
        points = self.points
        names = [*points.poses, *points.points] if isinstance(points, InSpace) else points
        named = ", ".join(f"'{name}'" for name in names if name)
        first = f"Picture{f' of {named}' if named else ''}"
        turns = "turns in a notebook" if isinstance(points, InSpace) else "shown in a notebook"
        lines = [f'{first}: {turns}, and with .save("picture.html") in a browser; .figure() is for papers']
        lines += [f"  apart: {end} from {start} by {far:.3g}" for (end, start), far in self.apart().items()]
        return "\n".join(lines)
