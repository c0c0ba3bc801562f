"""Bodies stand where their poses say: against SciPy's rotations; rods reach from one place to another."""

import numpy as np
from scipy.spatial.transform import Rotation

from lagjax.display import CUBE, TUBE, Anchor, InSpace, Shape
from lagjax.display.scenery import along, placed

RANDOM = np.random.default_rng(3)


def poses(count):
    """Random poses, their quaternions up to a thousandth of unit length, and SciPy's rotations."""
    turns = Rotation.random(count, rng=RANDOM)
    places, stretched = RANDOM.normal(size=(count, 3)), RANDOM.uniform(0.999, 1.001, (count, 1))
    return np.concatenate([places, stretched * turns.as_quat(scalar_first=True)], axis=1), turns


def test_poses():
    """x = r + R p. Twin: the rotation back differs."""
    found, turns = poses(7)
    points = RANDOM.normal(size=(4, 3))
    known = np.stack([found[i, :3] + turns[i].apply(points) for i in range(7)])
    np.testing.assert_allclose(placed(found, points), known, atol=1e-14)
    back = found * np.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    assert np.abs(placed(back, points) - known).max() > 0.1


def test_solids_sit_on_their_anchors():
    """The corners of a box on a marker: the marker's point and axes, moved with the body."""
    (pose, turn), axes = poses(1), Rotation.random(rng=RANDOM).as_matrix()
    anchor = Anchor("a", np.array([0.1, 0.2, 0.3]), tuple(map(tuple, axes)))
    shape = Shape("solid", (anchor,), CUBE, np.array([1.0, 2.0, 3.0]))
    (corners,) = InSpace((shape,), {"a": pose}, {}).corners(shape)
    known = pose[0, :3] + turn[0].apply(anchor.point + (CUBE.vertices * [1.0, 2.0, 3.0]) @ axes)
    np.testing.assert_allclose(corners[0], known, atol=1e-14)
    low, high = InSpace((shape,), {"a": pose}, {}).extent()
    np.testing.assert_allclose([low, high], [known.min(axis=0), known.max(axis=0)], atol=1e-14)


def test_rods():
    """All vertices of a rod lie at its radius from the line between its ends, at either end of it; also one without
    length, and one along the x axis, is finite."""
    (pose, _), radius = poses(5), 0.1
    shape = Shape(
        "rod", (Anchor(None, np.array([0.0, 0.0, 2.0])), Anchor("a", np.zeros(3))), TUBE, np.array([radius, radius, 1])
    )
    (vertices,) = InSpace((shape,), {"a": pose}, {}).corners(shape)
    start, d = np.array([0.0, 0.0, 2.0]), pose[:, :3] - [0.0, 0.0, 2.0]
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    ahead = np.einsum("fkx,fx->fk", vertices - start, unit)
    off = np.linalg.norm(vertices - start - ahead[..., None] * unit[:, None], axis=2)
    rim = np.hypot(*TUBE.vertices[:, :2].T) > 0.5
    np.testing.assert_allclose(off[:, rim], radius, rtol=1e-12)
    np.testing.assert_allclose(ahead, (TUBE.vertices[:, 2] + 0.5) * np.linalg.norm(d, axis=1)[:, None], atol=1e-13)
    for direction in ([0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]):
        rows = along(np.array(direction))
        np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(np.linalg.det(rows), 1.0, rtol=1e-14)
