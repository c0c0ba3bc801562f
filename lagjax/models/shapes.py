"""What the shapes of a file look like, for `traj.animate` and `traj.draw`."""

from collections.abc import Collection, Iterable

import numpy as np

from lagjax.bodies import Body, usual_shapes
from lagjax.display import CUBE, CYLINDER, SPHERE, Anchor, Shape
from lagjax.models.links_and_joints import LinkShape


def looks_of(shapes: Iterable[LinkShape], bodies: Collection[Body]) -> tuple[Shape, ...]:
    """How bodies are drawn: by their shapes in the file; those that have none there as boxes with their inertia.

    Shapes for the eye are taken, those for contacts where a body has no others that are drawn; meshes that were read,
    no planes. A body with shapes that are not drawn gets no box: inertias of files are often made up, and a large box
    would hide the rest.
    """
    shapes = tuple(shapes)
    seen = {x.body for x in shapes if x.role != "collision" and _parts(x)}
    own = tuple(part for x in shapes if x.role != "collision" or x.body not in seen for part in _parts(x))
    without = {body.name for body in bodies} - {x.body for x in shapes}
    return *usual_shapes((body for body in bodies if body.name in without), (), None), *own


def not_drawn(shapes: Iterable[LinkShape]) -> dict[str, list[str]]:
    """By kind, which links have shapes for the eye that no picture shows, and the names of their meshes."""
    found: dict[str, list[str]] = {}
    for x in shapes:
        if x.role != "collision" and not _parts(x):
            whose = f"'{x.link}'" + f" ({x.mesh})" * bool(x.mesh)
            found.setdefault({"mesh": "meshes", "plane": "planes"}.get(x.kind, x.kind), []).append(whose)
    return found


def _parts(x: LinkShape) -> tuple[Shape, ...]:
    """One solid, or three for a capsule; none for what is not drawn."""
    body, rows = None if x.body == "ground" else x.body, tuple(map(tuple, np.asarray(x.axes).T.tolist()))

    def solid(surface, size, ahead: float = 0.0):
        place = np.asarray(x.origin) + ahead * np.asarray(x.axes)[:, 2]
        return Shape("solid", (Anchor(body, tuple(place.tolist()), rows),), surface, tuple(map(float, size)))

    if x.kind in ("box", "ellipsoid"):
        return (solid(CUBE if x.kind == "box" else SPHERE, x.size),)
    if x.faces is not None:
        return (solid(x.faces, x.size),)
    if x.kind == "sphere":
        return (solid(SPHERE, (x.size[0],) * 3),)
    if x.kind not in ("cylinder", "capsule"):
        return ()
    radius, length = x.size[:2]
    side = solid(CYLINDER, (radius, radius, length))
    caps = [solid(SPHERE, (radius,) * 3, end * length / 2) for end in (-1, 1)] if x.kind == "capsule" else []
    return side, *caps
