"""Surfaces f = 0 as faces: on the surface, of its area, seen from where f > 0, as far as the box and f go."""

import numpy as np
import pytest

from lagjax.display.scenery import CELLS, MOST, Faces, fewer, level_set

LOW, HIGH = -1.3 * np.ones(3), np.array([1.2, 1.5, 1.4])


def sphere(points):
    """The distance from the unit sphere."""
    return np.linalg.norm(points, axis=1) - 1


def normals(of):
    """Twice the areas of faces, along their normals."""
    p = of.vertices[of.faces]
    return np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])


def test_a_sphere():
    """Vertices on it to second order, one closed sheet, its area, normals outward where f grows.

    Twin: with the other sign of f the normals point inward.
    """
    found = level_set(sphere, LOW, HIGH)
    step = (HIGH - LOW).max() / CELLS
    assert np.abs(sphere(found.vertices)).max() < 0.5 * step**2
    edges = np.sort(np.concatenate([found.faces[:, [i, (i + 1) % 4]] for i in range(4)]), axis=1)
    # Euler: V - E + F = 2, each edge between two faces.
    kinds, count = np.unique(edges, axis=0, return_counts=True)
    assert np.all(count == 2) and len(found.vertices) - len(kinds) + len(found.faces) == 2
    np.testing.assert_allclose(np.linalg.norm(normals(found), axis=1).sum() / 2, 4 * np.pi, rtol=0.02)
    outward = lambda of: np.sum(normals(of) * of.vertices[of.faces].mean(axis=1), axis=1)
    assert np.all(outward(found) > 0) and found.closed
    assert np.all(outward(level_set(lambda points: -sphere(points), LOW, HIGH)) < 0)


def test_a_plane_in_a_flat_box():
    """f linear along the edges: a tilted plane is met exactly, in a box of any proportions."""
    n = np.array([0.1, -0.2, 1.0])
    found = level_set(lambda points: points @ n - 0.05, np.array([0.0, 0.0, -0.6]), np.array([4.0, 1.0, 0.6]))
    assert np.abs(found.vertices @ n - 0.05).max() < 1e-14 and len(found.faces) > 50
    # To less than a cell, 0.2, from the box's sides.
    missed = np.array([4.0, 1.0]) - np.ptp(found.vertices, axis=0)[:2]
    assert np.all((missed >= 0) & (missed < 0.4))


def test_where_there_is_none():
    """No change of sign, no faces; where f is NaN or infinite, none either."""
    assert level_set(lambda points: np.ones(len(points)), LOW, HIGH).faces.shape == (0, 4)
    half = lambda points: np.where(points[:, 0] > 0, sphere(points), np.nan)
    with np.errstate(all="raise"):
        found = level_set(half, LOW, HIGH)
    assert found.vertices[:, 0].min() > -0.2 and np.isfinite(found.vertices).all()


@pytest.mark.parametrize("count", [40, 200])
def test_fewer_faces(count):
    """A mesh of few faces stays; one of many gets fewer, near where it was, and keeps its area."""
    u, v = (x.reshape(-1) for x in np.meshgrid(*2 * [np.linspace(0, 1, count)], indexing="ij"))
    i, j = (x.reshape(-1) for x in np.meshgrid(*2 * [np.arange(count - 1)], indexing="ij"))
    at = lambda a, b: a * count + b
    faces = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], axis=1)
    full = Faces(np.stack([u, v, 0.2 * u**2], axis=1), faces, np.zeros(len(faces)), closed=False)
    found = fewer(full)
    if len(faces) <= MOST:
        assert found is full
    else:
        assert len(found.faces) <= MOST and np.abs(found.vertices[:, 2] - 0.2 * found.vertices[:, 0] ** 2).max() < 1e-3
        areas = [np.linalg.norm(normals(x), axis=1).sum() / 2 for x in (full, found)]
        np.testing.assert_allclose(areas[1], areas[0], rtol=0.1)
