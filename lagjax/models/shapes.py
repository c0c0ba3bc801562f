"""Shapes on the links of a file, the meshes that it names, and what they look like in `traj.animate` and `traj.draw`.

Meshes are read for pictures alone: STL, in bytes or as text, and OBJ.
"""

import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lagjax.bodies import Body, usual_shapes
from lagjax.display import CUBE, CYLINDER, SPHERE, Anchor, Faces, Shape, triangles

CORNER = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


class LinkShape(NamedTuple):
    """A shape on a body, for pictures and contacts written by hand.

    - `body`: the body's name, "ground" for what does not move; `link`: the link of the file.
    - `kind` and `size`: "box" (three edges), "cylinder" and "capsule" (radius, length without caps), "sphere" (radius),
      "ellipsoid" (three radii), "mesh" (scale along its axes), "plane" and others as in the file.
    - `origin` and `axes`: its frame, from the body's centre of mass along the body's axes.
    - `mesh`: the name of the mesh's file, as it stands there (in MJCF, of the mesh); `role`: "visual", "collision" or
      "both". `faces`: the mesh itself, where it was read, in its frame.
    """

    body: str
    link: str
    kind: str
    size: tuple[float, ...]
    origin: np.ndarray
    axes: np.ndarray
    mesh: str
    role: str
    faces: Faces | None = None


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


def mesh_of(name: str, folder: Path | None) -> Faces | None:
    """The mesh of this name, seen from the folder of the file that names it; None if it is not there or is no mesh.

    `package://arm/hand.stl` is looked for as `arm/hand.stl` and as `hand.stl` in this folder and in those above it.
    """
    path = _found(name, folder)
    read = None if path is None else READERS.get(path.suffix.lower())
    if path is None or read is None:
        return None
    try:
        vertices, faces = read(path.read_bytes())
        if not np.all(np.isfinite(vertices)) or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            return None
        return triangles(vertices, faces)
    # Numbers that are none, too few, too many digits; a file that may not be read.
    except (ValueError, IndexError, OverflowError, OSError):
        return None


def _found(name: str, folder: Path | None) -> Path | None:
    scheme, _, rest = name.rpartition("://")
    if scheme == "package":
        places = (
            [above / x for above in (folder, *folder.parents) for x in (rest, rest.partition("/")[2])] if folder else []
        )
    else:
        places = [Path(rest) if folder is None else folder / rest]
    return next((place for place in places if is_file(place)), None)


def _stl(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    # Files in bytes may begin with "solid", too: their length decides.
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(data, facet, offset=84)["corners"].astype(float).reshape(-1, 3)
    else:
        corners = np.array(CORNER.findall(data), float).reshape(-1, 3)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


def _obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    rows = [row.split() for row in data.decode("utf-8", "replace").splitlines()]
    vertices = np.array([row[1:4] for row in rows if row[:1] == ["v"]], float)
    faces = [[int(x.partition("/")[0]) for x in row[1:]] for row in rows if row[:1] == ["f"]]
    # A polygon becomes a fan; indices begin at one.
    fans = [(face[0], *pair) for face in faces for pair in zip(face[1:], face[2:])]
    return vertices, np.array(fans, int).reshape(-1, 3) - 1


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that the system cannot have is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


READERS = {".stl": _stl, ".obj": _obj}
