"""What is drawn, in numbers: poses of bodies and points at each frame, and the box that holds them all.

x = r + R(e) p,      R(e) as in Diebel, *Representing Attitude* (2006), Eq. 125
"""

from typing import NamedTuple

import numpy as np

from lagjax.display.in_space.level_set import level_set
from lagjax.display.in_space.shapes import Anchor, Shape

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
