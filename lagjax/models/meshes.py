"""Meshes that a file names and that lie beside it: STL, in bytes or as text, and OBJ. They are for pictures alone."""

import re
from pathlib import Path

import numpy as np

from lagjax.display import Faces, triangles
from lagjax.models.links_and_joints import is_file

CORNER = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


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


READERS = {".stl": _stl, ".obj": _obj}
