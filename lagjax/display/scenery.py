"""What is drawn in space, in numbers: surfaces of solids as flat faces, shapes in bodies, and poses at each frame.

Large faces are cut into pieces: faces are painted one after the other, the farthest first, which is right where each is
small beside its distance from the others.

**A surface f = 0 inside a box**, as faces: a surface net. Each cell of a grid in which the sign of f changes has a
vertex, the mean of the places on its edges where f, taken as linear along them, vanishes. Each edge on which the sign
changes has a face, with the four cells about it as corners.

Source: Gibson, "Constrained Elastic Surface Nets", *MICCAI* (1998), §2.

**Poses** of bodies and points at each frame, and the box that holds them all:

    x = r + R(e) p,      R(e) as in Diebel, *Representing Attitude* (2006), Eq. 125
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from lagjax.refusals import must

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
    well = points.ndim == 2 and points.shape[1:] == (3,) and np.all(np.isfinite(points))
    must(well, "vertices must be finite points of space, (n, 3)", points)
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


# Cells along the longest side of the box.
CELLS = 20


def level_set(f: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> Faces:
    """Faces of f = 0 between two corners of a box; `f` takes points (n, 3). They are seen from where f > 0.

    >>> flat = level_set(lambda points: points[:, 2] - 0.3, np.zeros(3), np.ones(3))
    >>> print(np.ptp(flat.vertices, axis=0).round(6), flat.vertices[:, 2].max().round(6))
    [0.95 0.95 0.  ] 0.3

    Where f is NaN or infinite there is no surface.
    """
    step = np.max(high - low) / CELLS
    counts = np.maximum(np.ceil((high - low) / step - 1e-9).astype(int), 1)
    points = np.stack(np.meshgrid(*(a + step * np.arange(n + 1) for a, n in zip(low, counts)), indexing="ij"), axis=-1)
    values = np.asarray(f(points.reshape(-1, 3)), float).reshape(points.shape[:3])
    places, crossings = np.zeros((*counts, 3)), np.zeros(counts)
    index, corners = np.arange(np.prod(counts)).reshape(counts), []
    for axis in range(3):
        # The axis first, the two others in cyclic order; x, y and z of points stay where they are.
        order = (axis, (axis + 1) % 3, (axis + 2) % 3)
        value, place = values.transpose(order), points.transpose(*order, 3)
        start, end = value[:-1], value[1:]
        crosses = ((start > 0) != (end > 0)) & np.isfinite(start) & np.isfinite(end)
        share = np.divide(start, start - end, out=np.zeros_like(start), where=crosses)
        place = np.where(crosses[..., None], place[:-1] + share[..., None] * (place[1:] - place[:-1]), 0.0)
        _, n, m = (counts[i] for i in order)
        # Views: what is added to them is added to the cells.
        sums, number, cells = places.transpose(*order, 3), crossings.transpose(order), index.transpose(order)
        for i, j in product((0, 1), repeat=2):
            sums += place[:, i : n + i, j : m + j]
            number += crosses[:, i : n + i, j : m + j]
        around = np.stack([cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]], axis=-1)
        rises = (end > 0)[:, 1:-1, 1:-1]
        faces = np.where(rises[..., None], around, around[..., ::-1])
        corners.append(faces[crosses[:, 1:-1, 1:-1]])
    used = crossings > 0
    renumbered = np.cumsum(used.reshape(-1)) - 1
    faces = renumbered[np.concatenate(corners)]
    return Faces(places[used] / crossings[used][:, None], faces, np.zeros(len(faces)), closed=True)


COLOUR = re.compile(r"#[0-9a-fA-F]{6}")


class Anchor(NamedTuple):
    """A place fixed in a body: its name, None for space itself; a point (3,), or a function of params; and three unit
    vectors of the body as rows, of which the last is the axis.
    """

    body: str | None
    point: Any
    axes: tuple = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Shape:
    """Something to draw that moves with bodies: `lj.shapes.box` and its like make them.

    - `kind`: "solid" at one anchor; "rod", a solid from one to another; "line" through two or more; "dot" or "trail" at
      one; "level", the surface on which `level` vanishes, in one's frame. "mark", a line in front of everything. Of
      joints: "gap", a mark between two places that should be one, and "axis", drawn where frames are.
    - `surface`: that of a solid or rod, of unit size; `size` (3,), or a function of params: its scale along the
      anchor's axes. `color`: "#rrggbb", or None for the colour of its body.
    - `level`: `level(points, params)`, (n, 3) -> (n,).

    >>> import lagjax as lj
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> print(lj.shapes.sphere(ball, radius=0.5))
    Shape(a solid on 'ball')
    """

    kind: str
    anchors: tuple[Anchor, ...]
    surface: Faces | None = None
    size: Any = (1.0, 1.0, 1.0)
    color: str | None = None
    level: Callable | None = None

    def __post_init__(self):
        well = self.color is None or isinstance(self.color, str) and COLOUR.fullmatch(self.color)
        must(well, "a color must be six hexadecimal digits", self.color, 'color="#D55E00", or leave it out')

    def __repr__(self):
        names = dict.fromkeys("the ground" if anchor.body is None else f"'{anchor.body}'" for anchor in self.anchors)
        return f"Shape(a {self.kind} on {', '.join(names)})"

    def with_params(self, params: PyTree) -> "Shape":
        """The same with numbers in the place of functions of params."""
        anchors = tuple(Anchor(a.body, _three(a.point, params, "a point"), a.axes) for a in self.anchors)
        size = _three(self.size, params, "the size")
        must(np.all(size >= 0), "the size of a shape must be lengths from zero on", size)
        level = None if self.level is None else partial(self.level, params=params)
        return Shape(self.kind, anchors, self.surface, size, self.color, level)

    @property
    def owner(self) -> str | None:
        """The body whose colour it has."""
        return next((anchor.body for anchor in self.anchors if anchor.body is not None), None)


def poses_in_q(t: Any, q: PyTree, params: PyTree) -> Any:
    """Where bodies are whose entries in q are their poses."""
    return q


class Drawing(NamedTuple):
    """What is drawn of a motion: shapes, and where the bodies are that carry them.

    - `shapes`: `lj.shapes.box(...)` and the like, or a function of params that gives them. Functions
      `positions(t, q, params)` may be among them.
    - `poses`: `poses(t, q, params)` -> by the names of bodies, the centre of mass (3,) and the unit quaternion
      (w, x, y, z); by default they are the entries of q.

    A system is drawn by itself if its Lagrangian has one as the attribute `drawing`.

    >>> import lagjax as lj
    >>> import jax.numpy as jnp
    >>> arm = lj.bodies.Body("arm", 1.0, (0.1, 0.1, 0.01))
    >>> def poses(t, q, params):
    ...     return {"arm": lj.bodies.Pose.at((0.0, 0.0, -0.5)).turned((1.0, 0.0, 0.0), q)}
    >>> Drawing([lj.shapes.box(arm, (0.1, 0.1, 1.0))], poses).shapes
    [Shape(a solid on 'arm')]
    """

    shapes: Sequence[Shape | Callable] | Callable[[PyTree], Sequence[Shape | Callable]]
    poses: Callable[[Any, PyTree, PyTree], Any] = poses_in_q


def _three(x: Any, params: PyTree, what: str) -> np.ndarray:
    found = np.asarray(x(params) if callable(x) else x, float)
    must(found.shape == (3,) and np.all(np.isfinite(found)), f"{what} of a shape must be three finite numbers", found)
    return found


# The box in which a surface f = 0 is drawn is larger than what else there is, by this share of its longest side.
BEYOND = 0.3
# The lengths of bodies' axes, and of halves of joints' axes, as shares of the picture's diagonal; their colours.
FRAME, AXIS = 0.1, 0.08
# The places that a joint should hold together are apart from this share of the diagonal on.
APART = 1e-6
RED, GREEN, BLUE, BLACK = "#D00000", "#008A00", "#0040FF", "#000000"


class InSpace(NamedTuple):
    """A motion in space, to be drawn.

    - `shapes`: with numbers alone. `poses`: of each body by name, (..., F, 7), its place and its unit quaternion.
    - `points`: by name, (..., F, k, 3), linked in order; the last one leaves a trail.
    """

    shapes: tuple[Shape, ...]
    poses: dict[str, np.ndarray]
    points: dict[str, np.ndarray]

    def at(self, *frame) -> "InSpace":
        """Some of the frames."""
        poses, points = ({name: x[frame] for name, x in of.items()} for of in (self.poses, self.points))
        return InSpace(self.shapes, poses, points)

    def finished(self, frames: bool = False) -> "InSpace":
        """As it is painted: with faces for surfaces f = 0, the gaps that are open, and frames and axes if asked for."""
        solid = self._replace(shapes=tuple(x for x in self.shapes if x.kind not in ("axis", "level")))
        low, high = solid.extent()
        size = float(np.linalg.norm(high - low))
        found = [solid._faces_of(x) if x.kind == "level" else x for x in self.shapes
                 if x.kind != "axis" and not (x.kind == "gap" and self.apart(x) <= APART * size)]  # fmt: skip
        if frames:
            for name in self.poses:
                found += [_mark(Anchor(name, np.zeros(3)), FRAME * size * e, color)
                          for e, color in zip(np.eye(3), (RED, GREEN, BLUE))]  # fmt: skip
            for anchor in (x.anchors[0] for x in self.shapes if x.kind == "axis"):
                along = AXIS * size * np.asarray(anchor.axes[2])
                found.append(_mark(anchor._replace(point=anchor.point - along), 2 * along, BLACK))
        return self._replace(shapes=tuple(found))

    def apart(self, shape: Shape) -> float:
        """How far the two places of a shape are from each other, at most."""
        start, end = (self.place(anchor) for anchor in shape.anchors)
        return float(np.max(np.linalg.norm(end - start, axis=-1)))

    def _faces_of(self, shape: Shape) -> Shape:
        """The part of a surface f = 0 about everything else, as that is seen from its body."""
        anchor = shape.anchors[0]
        axes = np.asarray(anchor.axes)
        found = []
        for x in self._everything():
            if anchor.body is not None:
                pose = self.poses[anchor.body]
                x = (x - pose[..., None, :3]) @ rotations(pose[..., 3:])
            found.append((x - anchor.point) @ axes.T)
        low, high = _box(found)
        more = BEYOND * np.max(high - low)
        assert shape.level is not None
        return Shape("solid", shape.anchors, level_set(shape.level, low - more, high + more), np.ones(3), shape.color)

    def tracked(self) -> dict[str, np.ndarray]:
        """Points (..., F, k, 3) by name that tell where everything is: three axes of each body, as long as it is."""
        found = dict(self.points)
        for name, pose in self.poses.items():
            reach = max((_reach(shape, name) for shape in self.shapes), default=0.0)
            arms = np.concatenate([np.zeros((1, 3)), reach * np.eye(3)])
            found[f"pose of {name}"] = placed(pose, arms)
        return found

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest coordinates of everything that is drawn, (3,) each."""
        return _box(self._everything())

    def _everything(self) -> list[np.ndarray]:
        return [*self.points.values(), *(x for shape in self.shapes for x in self.corners(shape))]

    def corners(self, shape: Shape) -> list[np.ndarray]:
        """The vertices of a solid, or the anchors of anything else, in space, (..., F, k, 3)."""
        if shape.surface is None:
            return [self.place(anchor)[..., None, :] for anchor in shape.anchors]
        if shape.kind == "rod":
            start, end = (self.place(anchor) for anchor in shape.anchors)
            start, end = np.broadcast_arrays(start, end)
            axes = along(end - start) * np.array([shape.size[0], shape.size[1], 1.0])[:, None]
            axes[..., 2, :] = end - start
            return [((start + end) / 2)[..., None, :] + shape.surface.vertices @ axes]
        anchor = shape.anchors[0]
        in_body = anchor.point + shape.surface.vertices * shape.size @ np.asarray(anchor.axes)
        return [self._moved(anchor.body, in_body)]

    def place(self, anchor: Anchor) -> np.ndarray:
        """Where an anchor is, (..., F, 3), or (3,) for one in space."""
        return self._moved(anchor.body, np.asarray(anchor.point)[None])[..., 0, :]

    def _moved(self, body: str | None, points: np.ndarray):
        return points if body is None else placed(self.poses[body], points)


def placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (k, 3) of a body in space, (..., k, 3), for its poses (..., 7)."""
    return poses[..., None, :3] + points @ np.swapaxes(rotations(poses[..., 3:]), -1, -2)


def rotations(e: np.ndarray) -> np.ndarray:
    """R(e) (..., 3, 3) for quaternions (..., 4) that are nearly unit ones."""
    w, x, y, z = np.moveaxis(e / np.linalg.norm(e, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def along(d: np.ndarray) -> np.ndarray:
    """Three unit vectors as rows, (..., 3, 3), of which the last has the direction of d; any where d is zero."""
    size = np.linalg.norm(d, axis=-1, keepdims=True)
    last = np.where(size > 0, d / np.where(size > 0, size, 1.0), np.array([0.0, 0.0, 1.0]))
    near = np.where(np.abs(last[..., :1]) > 0.9, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    first = near - np.sum(near * last, axis=-1, keepdims=True) * last
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(last, first), last], axis=-2)


def _box(places: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest coordinates, (3,) each, of what is finite."""
    x = np.concatenate([x.reshape(-1, 3) for x in places])
    x = x[np.isfinite(x).all(axis=1)]
    return x.min(axis=0), x.max(axis=0)


def _mark(start: Anchor, way: np.ndarray, color: str) -> Shape:
    return Shape("mark", (start, start._replace(point=start.point + way)), color=color)


def _reach(shape: Shape, body: str):
    """How far a shape extends from the centre of a body."""
    if shape.surface is not None and shape.kind == "solid" and shape.anchors[0].body == body:
        size = np.linalg.norm(shape.surface.vertices * shape.size, axis=1).max()
        return size + np.linalg.norm(shape.anchors[0].point)
    return max((float(np.linalg.norm(a.point)) for a in shape.anchors if a.body == body), default=0.0)
