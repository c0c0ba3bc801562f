"""Unit surfaces are closed and face outwards: their volumes are known; a user's faces are checked."""

import numpy as np
import pytest

from lagjax.display import CUBE, CYLINDER, DISK, SPHERE, TUBE, surface
from lagjax.display.scenery import SIDES

# The area of a regular polygon in the unit circle.
POLYGON = SIDES / 2 * np.sin(2 * np.pi / SIDES)


def volume(vertices, faces):
    """By the divergence theorem: a sum over the two triangles of each face."""
    p = vertices[faces]
    halves = [(p[:, 0], p[:, 1], p[:, 2]), (p[:, 0], p[:, 2], p[:, 3])]
    return sum(np.sum(np.cross(b, c) * a) for a, b, c in halves) / 6


@pytest.mark.parametrize("of, known", [(CUBE, 1.0), (CYLINDER, POLYGON), (TUBE, POLYGON)])
def test_volumes(of, known):
    """Twin: faces in the other order have the negative volume."""
    np.testing.assert_allclose(volume(of.vertices, of.faces), known, rtol=1e-14)
    np.testing.assert_allclose(volume(of.vertices, of.faces[:, ::-1]), -known, rtol=1e-14)
    assert of.closed and len(of.light) == len(of.faces)


def test_spheres_and_disks():
    """Vertices lie on the unit sphere, its volume is a little less; a disk is flat and seen from both sides."""
    np.testing.assert_allclose(np.linalg.norm(SPHERE.vertices, axis=1), 1.0, rtol=1e-14)
    assert 0.92 * 4 * np.pi / 3 < volume(SPHERE.vertices, SPHERE.faces) < 4 * np.pi / 3
    assert not DISK.closed and not DISK.vertices[:, 2].any() and set(DISK.light) == {0, 1}


def test_faces_of_a_user():
    """Triangles repeat their last corner, larger polygons become fans; wrong indices are refused with a reason."""
    square = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (-1, 0.5, 0)]
    found = surface(square, [(0, 1, 2), (0, 1, 2, 3), (0, 1, 2, 3, 4)]).faces.tolist()
    assert found == [[0, 1, 2, 2], [0, 1, 2, 3], [0, 1, 2, 2], [0, 2, 3, 3], [0, 3, 4, 4]]
    for faces in ([(3, 4, 5)], [(0, 1)], [(0.0, 1.0, 2.0)], [(-1, 0, 1)]):
        with pytest.raises(ValueError, match="(?s)indices 0 to 4.*begin at 1"):
            surface(square, faces)
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        surface([(0.0, 0.0)], [])
