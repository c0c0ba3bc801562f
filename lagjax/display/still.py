"""What one state looks like: a page on which it can be turned, or a figure."""

from pathlib import Path

import numpy as np

from lagjax.display import plots
from lagjax.display.animation import film_scripts, still_in_plane
from lagjax.display.in_space.figure import stills_in_space
from lagjax.display.in_space.film import film_in_space
from lagjax.display.in_space.scenery import InSpace
from lagjax.display.web_page import fragment, whole

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
