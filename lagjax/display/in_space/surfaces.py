"""Surfaces of solids as flat faces: those of unit size, which shapes scale along three axes, and those of a user.

Large faces are cut into pieces: faces are painted one after the other, the farthest first, which is right where each is
small beside its distance from the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

# Pieces along the edge of a cube and the length of a cylinder; sides of a cylinder; circles of latitude of a sphere.
PIECES, SIDES, BELTS = 3, 20, 10
# Sectors that are light and dark by turns, so that turning is seen.
SECTORS = 4
# Faces up to which a mesh is drawn as it is; cells of the grid along its longest side by which larger ones get fewer.
MOST, CELLS_OF_MESH = 2000, 24


class Faces(NamedTuple):
    """Flat faces: `vertices` (n, 3); `faces` (m, 4), the last two equal for a triangle, anticlockwise from outside;
    `light` (m,), from 0 to 1: how much lighter a face is; `closed`: whether those that look away are hidden.
    """

    vertices: np.ndarray
    faces: np.ndarray
    light: np.ndarray
    closed: bool


def surface(vertices: ArrayLike, faces: Sequence[Sequence[int]]) -> Faces:
    """The surface with these vertices (n, 3) and faces, each of three or more indices of its corners in order.

    >>> print(surface([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]).faces)
    [[0 1 2 2]]

    **Raises:** `ValueError` for vertices that are not finite points of space, and faces that are not of their indices.
    """
    points = np.asarray(vertices, float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.all(np.isfinite(points)):
        raise ValueError(f"vertices must be finite points of space, (n, 3), and have the shape {points.shape}.")
    corners = [np.asarray(face) for face in faces]
    for face in corners:
        whole = face.ndim == 1 and len(face) >= 3 and np.issubdtype(face.dtype, np.integer)
        if not whole or face.min() < 0 or face.max() >= len(points):
            raise ValueError(
                f"a face is {face.tolist()}, but must be three or more of the indices 0 to {len(points) - 1} of "
                "vertices.\n"
                "Usual cause: indices that begin at 1, as in an OBJ file.\nFix: faces - 1."
            )
    # A polygon of more than four corners becomes a fan of triangles.
    fans = [_fan(face) if len(face) > 4 else np.resize(np.append(face, face[-1]), 4)[None] for face in corners]
    found = np.concatenate(fans) if fans else np.zeros((0, 4), int)
    return Faces(points, found, np.zeros(len(found)), closed=False)


def triangles(vertices: np.ndarray, faces: np.ndarray) -> Faces:
    """A closed surface of triangles (m, 3), anticlockwise from outside; of many, one of fewer."""
    return fewer(Faces(vertices, np.concatenate([faces, faces[:, -1:]], axis=1), np.zeros(len(faces)), closed=True))


def fewer(of: Faces) -> Faces:
    """The surface itself up to `MOST` faces; of more, one whose vertices are the means of those in cells of a grid.

    Source: Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes" (1993), §3.
    """
    if len(of.faces) <= MOST:
        return of
    low = of.vertices.min(axis=0)
    cells = np.floor((of.vertices - low) * (CELLS_OF_MESH / np.ptp(of.vertices, axis=0).max())).astype(int)
    _, member, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    member = member.reshape(-1)
    means = np.stack([np.bincount(member, x) / count for x in of.vertices.T], axis=1)
    faces = member[of.faces]
    # What became a line or a point is left out, of equal faces all but one.
    corners = np.sort(faces, axis=1)
    flat = (np.diff(corners, axis=1) > 0).sum(axis=1) < 2
    kept = np.setdiff1d(np.unique(corners, axis=0, return_index=True)[1], np.flatnonzero(flat))
    return Faces(means, faces[kept], of.light[kept], of.closed)


def _fan(face: np.ndarray):
    return np.stack([np.full(len(face) - 2, face[0]), face[1:-1], face[2:], face[2:]], axis=1)


def _patch(count_u: int, count_v: int, point):
    """Vertices and faces of a grid over the unit square; `point(u, v)` -> (..., 3)."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, count_u + 1), np.linspace(0.0, 1.0, count_v + 1), indexing="ij")
    i, j = (x.reshape(-1) for x in np.meshgrid(np.arange(count_u), np.arange(count_v), indexing="ij"))
    at = lambda a, b: a * (count_v + 1) + b
    faces = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], axis=1)
    return np.asarray(point(u.reshape(-1), v.reshape(-1)), float).T, faces, i, j


def _together(parts, closed: bool) -> Faces:
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
    return Faces(
        np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([faces + start for (_, faces, _), start in zip(parts, starts)]),
        np.concatenate([light for _, _, light in parts]),
        closed,
    )


def _cube() -> Faces:
    """Edges of length one about the origin."""
    parts = []
    for axis in range(3):
        for sign in (1, -1):

            def side(u: np.ndarray, v: np.ndarray, axis=axis, sign=sign):
                # In cyclic order the two others and this one are right-handed.
                found = np.empty((3, len(u)))
                found[axis], found[(axis + 1) % 3], found[(axis + 2) % 3] = sign / 2, sign * (u - 0.5), v - 0.5
                return found

            vertices, faces, *_ = _patch(PIECES, PIECES, side)
            # Neighbours differ also where they have the same light.
            parts.append((vertices, faces, np.full(len(faces), axis / 2)))
    return _together(parts, closed=True)


def _ring(z0: float, z1: float, r0: float, r1: float, pieces: int):
    """A band about the z axis between two circles, and which of its faces are light."""

    def band(u: np.ndarray, v: np.ndarray):
        r = r0 + v * (r1 - r0)
        return r * np.cos(2 * np.pi * u), r * np.sin(2 * np.pi * u), z0 + v * (z1 - z0)

    vertices, faces, i, _ = _patch(SIDES, pieces, band)
    return vertices, faces, i * SECTORS // SIDES % 2


def _cylinder(caps: bool) -> Faces:
    """Of radius one and length one about the z axis."""
    tops = [_ring(0.5, 0.5, 1.0, 0.0, 1), _ring(-0.5, -0.5, 0.0, 1.0, 1)]
    side = _ring(-0.5, 0.5, 1.0, 1.0, PIECES)
    if caps:
        return _together([side, *tops], closed=True)
    return _together([(vertices, faces, 0 * light) for vertices, faces, light in (side, *tops)], closed=True)


def _sphere() -> Faces:
    """Of radius one."""

    def point(u: np.ndarray, v: np.ndarray):
        r = np.sin(np.pi * v)
        return r * np.cos(2 * np.pi * u), r * np.sin(2 * np.pi * u), -np.cos(np.pi * v)

    vertices, faces, i, j = _patch(SIDES, BELTS, point)
    return Faces(vertices, faces, (i * SECTORS // SIDES + j * 2 // BELTS) % 2, closed=True)


def _disk() -> Faces:
    """Of radius one in the plane z = 0, seen from both sides."""
    vertices, faces, light = _ring(0.0, 0.0, 1.0, 0.0, 2)
    return Faces(vertices, faces, light, closed=False)


CUBE, CYLINDER, TUBE, SPHERE, DISK = _cube(), _cylinder(caps=True), _cylinder(caps=False), _sphere(), _disk()
