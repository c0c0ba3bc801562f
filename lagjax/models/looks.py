"""What the shapes of a file look like, for `traj.animate` and `traj.draw`."""

from collections.abc import Iterable

import numpy as np

from lagjax.bodies import Body, usual_shapes
from lagjax.display import CUBE, CYLINDER, SPHERE, Anchor, Shape
from lagjax.models.parts import LinkShape


def looks_of(shapes: Iterable[LinkShape], bodies: Iterable[Body]) -> tuple[Shape, ...]:
    """How bodies are drawn: by their shapes in the file, or as boxes with their inertia.

    Shapes for the eye are taken, those for contacts where a body has no others; neither meshes nor planes.
    """
    shapes = tuple(shapes)
    seen = {x.body for x in shapes if x.role != "collision"}
    own = tuple(part for x in shapes if x.role != "collision" or x.body not in seen for part in _parts(x))
    drawn = {shape.owner for shape in own}
    return *usual_shapes((body for body in bodies if body.name not in drawn), (), None), *own


def _parts(x: LinkShape) -> tuple[Shape, ...]:
    """One solid, or three for a capsule; none for what is not drawn."""
    body, rows = None if x.body == "ground" else x.body, tuple(map(tuple, np.asarray(x.axes).T.tolist()))

    def solid(surface, size, ahead: float = 0.0):
        place = np.asarray(x.origin) + ahead * np.asarray(x.axes)[:, 2]
        return Shape("solid", (Anchor(body, tuple(place.tolist()), rows),), surface, tuple(map(float, size)))

    if x.kind in ("box", "ellipsoid"):
        return (solid(CUBE if x.kind == "box" else SPHERE, x.size),)
    if x.kind == "sphere":
        return (solid(SPHERE, (x.size[0],) * 3),)
    if x.kind not in ("cylinder", "capsule"):
        return ()
    radius, length = x.size[:2]
    side = solid(CYLINDER, (radius, radius, length))
    caps = [solid(SPHERE, (radius,) * 3, end * length / 2) for end in (-1, 1)] if x.kind == "capsule" else []
    return side, *caps
