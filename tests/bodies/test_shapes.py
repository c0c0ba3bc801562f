"""What systems of bodies look like by themselves: boxes with the bodies' inertia, joints, springs and wheels."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display import CUBE, DISK, SPHERE, InSpace
from lagjax.integrate.pictures import subject_of

A, B = (
    lj.bodies.Body("a", 2.0, (0.1, 0.2, 0.25)),
    lj.bodies.Body("b", lambda params: params["m"], lambda params: (1.0, 1.0, 0.0)),
)
# Turned by 0.7 about (1, 1, 0), as by `lj.bodies.Pose.at`, which would compute.
POSE = lj.bodies.Pose(np.array([1.0, 2.0, 3.0]), np.array([np.cos(0.35), *np.sin(0.35) * np.sqrt([0.5, 0.5, 0.0])]))


def drawn(system, params=None, **poses):
    """What is drawn of a system at one state."""
    q = {name: lj.bodies.Pose(*(x[None] for x in pose)) for name, pose in poses.items()}
    frame = subject_of(None, system, params).frames(np.zeros(1), q)
    assert isinstance(frame, InSpace)
    return frame


def test_boxes_have_the_inertia():
    """Edges whose m (b² + c²)/12 are the moments, along principal axes. Twin: edges in another order are not."""
    frame = drawn(lj.bodies.multibody([A]), a=POSE)
    (box,) = frame.shapes
    x, y, z = box.size**2
    np.testing.assert_allclose([2 * (y + z) / 12, 2 * (x + z) / 12, 2 * (x + y) / 12], A.inertia, rtol=1e-12)
    # With other axes of the body the box is turned in it: its second moments turn with the inertia.
    rows = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    tilted = lj.bodies.Body("a", 2.0, rows @ np.diag(A.inertia) @ rows.T)
    (found,) = drawn(lj.bodies.multibody([tilted]), a=POSE).shapes
    axes = np.asarray(found.anchors[0].axes)
    second = axes.T @ np.diag(found.size**2) @ axes
    np.testing.assert_allclose(second, rows @ np.diag(box.size**2) @ rows.T, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-12)
    assert np.abs(second - np.diag(box.size**2)).max() > 0.1


def test_joints_springs_and_params():
    """A dot and arms at a joint, a line for a spring; mass and inertia by params; a thin rod keeps a thickness."""
    joint = lj.bodies.spherical(A.at((0.0, 0.0, 1.0)), B.at((1.0, 0.0, 0.0)))
    spring = lj.bodies.spring(lj.bodies.ground.at(), B.at(), stiffness=1.0)
    frame = drawn(lj.bodies.multibody([A, B], {"joint": joint}, [spring]), {"m": 12.0}, a=POSE, b=POSE)
    assert [shape.kind for shape in frame.shapes] == ["solid", "solid", "dot", "line", "line", "gap", "line"]
    np.testing.assert_allclose(frame.shapes[1].size, [0.04, 0.04, 1.0], rtol=1e-12)
    np.testing.assert_allclose(
        frame.place(frame.shapes[2].anchors[0])[0], A.point({"a": POSE}, (0.0, 0.0, 1.0)), atol=1e-12
    )


def test_wheels():
    """What rolls is drawn as a disk across its axis, or a sphere, in the place of a box."""
    wheel = lj.bodies.rolling(A.at(axis=(0.0, 1.0, 0.0)), lj.bodies.ground.at(), radius=0.3)
    (found,) = drawn(lj.bodies.multibody([A], {"wheel": wheel}), a=POSE).shapes
    assert found.surface is DISK and found.size[0] == 0.3 and found.anchors[0].axes[2] == (0.0, 1.0, 0.0)
    ball = lj.bodies.rolling_sphere(B.at(), lj.bodies.ground.at(), radius=lambda params: params["m"])
    shapes = drawn(lj.bodies.multibody([A, B], {"ball": ball}), {"m": 0.5}, a=POSE, b=POSE).shapes
    assert [shape.surface for shape in shapes] == [CUBE, SPHERE] and shapes[1].size[0] == 0.5


def test_shapes_stand_where_bodies_are():
    """The corners of a box on a marker are the points of the body; a mesh's are those given."""
    marker = A.at((0.1, 0.2, 0.3), axis=(0.0, 1.0, 0.0))
    box = lj.shapes.box(marker, (0.5, 0.6, 0.7))
    mesh = lj.shapes.mesh(A, [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    frame = subject_of([box, mesh], lj.bodies.multibody([A]), None).frames(
        np.zeros(1), {"a": lj.bodies.Pose(*(x[None] for x in POSE))}
    )
    assert isinstance(frame, InSpace)
    corner = jnp.array([0.5, 0.6, 0.7]) / 2 @ jnp.array(marker.frame) + jnp.array([0.1, 0.2, 0.3])
    known = np.asarray(A.point({"a": POSE}, corner))
    found = frame.corners(frame.shapes[0])[0][0]
    assert np.abs(found - known).max(axis=1).min() < 1e-12
    np.testing.assert_allclose(
        frame.corners(frame.shapes[1])[0][0, 1], A.point({"a": POSE}, (1.0, 0.0, 0.0)), atol=1e-12
    )


def test_what_is_no_place():
    """Names in place of bodies, colours by name, radii of NaN, and lines through nothing are refused."""
    with pytest.raises(TypeError, match="(?s)not 'a'.*Fix: lj.shapes.sphere"):
        lj.shapes.sphere("a", 1.0)
    with pytest.raises(ValueError, match="six hexadecimal digits, not 'red'"):
        lj.shapes.sphere(A, 1.0, color="red")
    for radius in (np.nan, np.inf, -1.0):
        with pytest.raises(ValueError, match=f"must be a finite number from zero on, not {radius}"):
            lj.shapes.rod(A, (0.0, 0.0, 1.0), radius)
    with pytest.raises(ValueError, match="needs places"):
        lj.shapes.line()
    assert repr(lj.shapes.line((0.0, 0.0, 1.0), A)) == "Shape(a line on the ground, 'a')"
