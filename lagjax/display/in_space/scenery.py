"""What is drawn, in numbers: poses of bodies and points at each frame, and the box that holds them all.

x = r + R(e) p,      R(e) as in Diebel, *Representing Attitude* (2006), Eq. 125
"""

from typing import NamedTuple

import numpy as np

from lagjax.display.in_space.shapes import Anchor, Shape


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
        found = [x.reshape(-1, 3) for x in self.points.values()]
        for shape in self.shapes:
            for x in self.corners(shape):
                found.append(x.reshape(-1, 3))
        x = np.concatenate(found)
        x = x[np.isfinite(x).all(axis=1)]
        return x.min(axis=0), x.max(axis=0)

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


def _reach(shape: Shape, body: str):
    """How far a shape extends from the centre of a body."""
    if shape.surface is not None and shape.kind == "solid" and shape.anchors[0].body == body:
        size = np.linalg.norm(shape.surface.vertices * shape.size, axis=1).max()
        return size + np.linalg.norm(shape.anchors[0].point)
    return max((float(np.linalg.norm(a.point)) for a in shape.anchors if a.body == body), default=0.0)
