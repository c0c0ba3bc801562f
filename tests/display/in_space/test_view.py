"""What is in the box is in the picture, at one scale, the near larger than the far; the nearest is painted last."""

import numpy as np
import pytest

from lagjax.display import CUBE, SPHERE, Anchor, InSpace, Shape
from lagjax.display.painting import WIDTH, grid_under, labelled, marks, view_of

RANDOM = np.random.default_rng(5)
LOW, HIGH = np.array([-1.0, -2.0, 0.5]), np.array([3.0, 1.0, 2.5])


@pytest.mark.parametrize("azimuth, elevation", [(-60.0, 22.0), (0.0, 90.0), (130.0, -30.0), (45.0, 0.0)])
def test_everything_is_in_the_picture(azimuth, elevation):
    """Random points of the box are inside of it; along right and up a unit has as many pixels, at any depth as said."""
    view, _ = view_of(LOW, HIGH, azimuth, elevation)
    found, near, pixels = view.seen(RANDOM.uniform(LOW, HIGH, (200, 3)))
    assert np.all((found > 0) & (found < [WIDTH, view.height]))
    assert np.ptp(near) > 1 and np.all(np.diff(pixels[np.argsort(near)]) >= 0)
    at, axes = RANDOM.uniform(LOW, HIGH), view.axes()
    here, _, scale = view.seen(at)
    for axis, way in zip(axes, ([1, 0], [0, -1])):
        np.testing.assert_allclose(view.seen(at + 0.1 * axis)[0] - here, 0.1 * scale * np.array(way), atol=1e-9)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-14)


def test_z_is_up():
    """From any place but straight above, what is higher is drawn higher. Twin: from below, upside down, it is not."""
    point = RANDOM.uniform(LOW, HIGH)
    for elevation in (-60.0, 0.0, 80.0):
        view, _ = view_of(LOW, HIGH, 33.0, elevation)
        assert view.seen(point + [0.0, 0.0, 0.1])[0][1] < view.seen(point)[0][1]
    turned = view._replace(elevation=180.0 - 20.0)
    assert turned.seen(point + [0.0, 0.0, 0.1])[0][1] > turned.seen(point)[0][1]


@pytest.mark.parametrize("size", [0.0, 1e-9, 1.0, 1e12])
def test_grids(size):
    """The floor is at the lowest height, its lines enclose the box, and have labels that differ."""
    grid = grid_under(size * LOW, size * HIGH)
    assert grid.floor == size * LOW[2]
    for lines, low, high in ((grid.x, LOW[0], HIGH[0]), (grid.y, LOW[1], HIGH[1])):
        assert lines[0] <= size * low + 1e-6 * grid.step and lines[-1] >= size * high - 1e-6 * grid.step
        assert 3 <= len(lines) <= 9 and len(set(labelled(lines, grid.step))) == len(lines)
    # A height that cannot be told from a line has its label; others have three digits.
    assert labelled(np.array([2e-6, 0.1, 0.0123]), 0.1) == ["0.0", "0.1", "0.0123"]


def box(name, half):
    """A cube about the centre of a body."""
    return Shape("solid", (Anchor(name, np.zeros(3)),), CUBE, 2.0 * half * np.ones(3))


def test_the_nearest_is_painted_last():
    """Of two boxes in a row, all faces of the nearer come after those of the other, from either side."""
    rest = [1.0, 0.0, 0.0, 0.0]
    frame = InSpace(
        (box("a", 0.5), box("b", 0.5)), {"a": np.array([-2.0, 0, 0, *rest]), "b": np.array([2.0, 0, 0, *rest])}, {}
    )
    for azimuth, last in ((0.0, 1), (180.0, 0)):
        view, _ = view_of(*frame.extent(), azimuth, 10.0)
        order = [marks(InSpace((shape,), frame.poses, {}), view) for shape in frame.shapes]
        assert max(m.nearness for m in order[1 - last]) < min(m.nearness for m in order[last])


def test_what_looks_away_is_hidden():
    """Of a cube seen from an edge's side three of six sides are painted, a sphere's silhouette is its outline."""
    frame = InSpace((box("a", 0.5),), {"a": np.array([0.0, 0, 0, 1, 0, 0, 0])}, {})
    view, _ = view_of(*frame.extent(), -60.0, 22.0)
    assert len(marks(frame, view)) == len(CUBE.faces) // 2
    ball = InSpace((Shape("solid", (Anchor("a", np.zeros(3)),), SPHERE, np.ones(3)),), frame.poses, {})
    painted = marks(ball, view)
    assert 0.3 * len(SPHERE.faces) < len(painted) < 0.5 * len(SPHERE.faces)
    assert min(mark.nearness for mark in painted) > 0
