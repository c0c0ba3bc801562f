"""One state as a picture: what is there, what is open, the frames, surfaces; as a page and as a figure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display import Anchor, InSpace, Shape
from tests.systems import PARAMS, pendulum

Y = (0.0, 1.0, 0.0)
CRANK, ROD = lj.bodies.Body("crank", 1.0, (0.1, 0.1, 0.01)), lj.bodies.Body("rod", 1.0, (0.3, 0.3, 0.01))
JOINTS = {
    "axle": lj.bodies.revolute(lj.bodies.ground.at(axis=Y), CRANK.at((0.0, 0.0, -0.5), Y)),
    "pin": lj.bodies.spherical(CRANK.at((0.0, 0.0, 0.5)), ROD.at((0.0, 0.0, 0.0))),
    "slide": lj.bodies.cylindrical(lj.bodies.ground.at(axis=(1.0, 0.0, 0.0)), ROD.at((0.0, 0.0, 1.0), axis=Y)),
}
LINKAGE = lj.bodies.multibody([CRANK, ROD], JOINTS, [lj.bodies.weight([CRANK, ROD])])
# The crank upright with its pin at z = 1, where the rod's end is 0.3 to the side.
ROUGH = {"crank": lj.bodies.Pose.at((0.0, 0.0, 0.5)), "rod": lj.bodies.Pose.at((0.0, 0.3, 1.0))}


def kinds(picture, kind):
    """The shapes of a kind."""
    assert isinstance(picture.points, InSpace)
    return [shape for shape in picture.points.shapes if shape.kind == kind]


def where(picture, anchor):
    """The place of an anchor in space."""
    return np.atleast_2d(picture.points.place(anchor))[0]


def test_open_joints_are_seen_and_said():
    """The pin is 0.3 open, and a magenta line of that length joins its ends. Twin: closed, there is none."""
    picture = lj.draw(LINKAGE, ROUGH)
    assert picture.apart() == {("'rod'", "'crank'"): pytest.approx(0.3, abs=1e-15)}
    assert str(picture).endswith("\n  apart: 'rod' from 'crank' by 0.3")
    (gap,) = kinds(picture, "gap")
    assert gap.color == "#E6007E"
    np.testing.assert_allclose([where(picture, x) for x in gap.anchors], [[0, 0, 1], [0, 0.3, 1]], atol=1e-15)
    closed = lj.draw(LINKAGE, ROUGH | {"rod": lj.bodies.Pose.at((0.0, 0.0, 1.0))})
    assert not closed.apart() and not kinds(closed, "gap") and "apart" not in str(closed)


def test_frames_of_bodies_and_axes_of_joints():
    """Three marks along each body's axes from its centre, two for each axis of a joint, through its points."""
    turned = lj.bodies.Pose.at((0.0, 0.3, 1.0), axis=(1.0, 0.0, 0.0), angle=np.pi / 2)
    picture = lj.draw(LINKAGE, ROUGH | {"rod": turned}, frames=True)
    marks = kinds(picture, "mark")
    assert len(marks) == 2 * 3 + 2 * 2 and not kinds(picture, "axis")
    ends = lambda mark: np.array([where(picture, x) for x in mark.anchors])
    ways = np.array([np.diff(ends(mark), axis=0)[0] for mark in marks])
    sizes = np.linalg.norm(ways, axis=1)
    # About x by a right angle: y becomes z, and z becomes -y.
    np.testing.assert_allclose((ways / sizes[:, None])[:6], [*np.eye(3), [1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15)
    assert all(np.allclose(ends(mark)[0], [0.0, 0.3, 1.0]) for mark in marks[3:6])
    assert [mark.color for mark in marks[:3]] == ["#D00000", "#008A00", "#0040FF"]
    # The hinge of the crank at the origin, along y, from both sides; the slide along x of space and y of the rod.
    np.testing.assert_allclose((ways / sizes[:, None])[6:], [Y, Y, [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(ends(marks[6]).mean(axis=0), 0.0, atol=1e-15)
    np.testing.assert_allclose(ends(marks[9]).mean(axis=0), [0.0, -0.7, 1.0], atol=1e-15)
    assert not kinds(lj.draw(LINKAGE, ROUGH), "mark")


def test_a_ball_in_its_bowl():
    """The surface is drawn about the ball, on f = 0, by its parameters, from above; once for two balls.

    Twin: with other parameters it is elsewhere.
    """
    bowl = lj.bodies.Surface(lambda r, params: r[2] - params["bend"] * (r[0] ** 2 + r[1] ** 2))
    balls = [lj.bodies.Body(name, 1.0, (0.004, 0.004, 0.004)) for name in "ab"]
    joints = {ball.name: lj.bodies.rolling_sphere(ball.at(), bowl, radius=0.1) for ball in balls}
    q = {"a": lj.bodies.Pose.at((0.0, 0.0, 0.1)), "b": lj.bodies.Pose.at((0.5, 0.0, 0.3))}
    picture = lj.draw(lj.bodies.multibody(balls, joints), q, {"bend": 1.0})
    ground, *solids = sorted(kinds(picture, "solid"), key=lambda shape: shape.owner is not None)
    assert [shape.owner for shape in solids] == ["a", "b"] and ground.surface is not None and ground.surface.closed
    x, y, z = ground.surface.vertices.T
    assert np.abs(z - x**2 - y**2).max() < 2e-3 < 0.05 < np.abs(z - 0.5 * (x**2 + y**2)).max()
    assert x.min() < -0.2 and x.max() > 0.7 and len(ground.surface.faces) > 100
    p = ground.surface.vertices[ground.surface.faces]
    assert np.all(np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])[:, 2] > 0)


def test_a_surface_on_a_body_that_moved():
    """A table's surface is where the table is, turned as it is."""
    table = lj.bodies.Body("table", 1.0, (1.0, 1.0, 1.0))
    ball = lj.bodies.Body("ball", 1.0, (0.004, 0.004, 0.004))
    plane = lj.bodies.Surface(lambda r, params: r[2] + 0.1 * r[0], on=table.at((0.0, 0.0, 0.5)))
    system = lj.bodies.multibody([table, ball], {"rolls": lj.bodies.rolling_sphere(ball.at(), plane, radius=0.1)})
    q = {"table": lj.bodies.Pose.at((1.0, 2.0, 0.0), angle=np.pi / 2), "ball": lj.bodies.Pose.at((1.0, 2.1, 0.6))}
    picture = lj.draw(system, q)
    (ground,) = (shape for shape in kinds(picture, "solid") if shape.color == "#B8B8B8")
    # The table's x axis is y in space.
    assert isinstance(picture.points, InSpace)
    x, y, z = picture.points.corners(ground)[0][0].T
    np.testing.assert_allclose(z, 0.5 - 0.1 * (y - 2.0), atol=1e-12)
    assert x.min() < 1.0 < x.max() and y.min() < 2.1 < y.max()


def test_a_surface_under_a_whole_motion():
    """In a film the surface lies under all places of the ball, and is one and the same for all frames."""
    f = lambda points, params: points[:, 2] - 0.1 * points[:, 0]
    path = np.stack([np.linspace(0.0, 3.0, 5), np.zeros(5), np.linspace(0.1, 0.4, 5)], axis=1)
    poses = {"ball": np.concatenate([path, np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))], axis=1)}
    shapes = [
        lj.shapes.sphere(lj.bodies.Body("ball", 1.0, (0.1, 0.1, 0.1)), 0.1),
        Shape("level", (Anchor(None, np.zeros(3)),), level=f),
    ]
    motion = InSpace(tuple(shape.with_params(None) for shape in shapes), poses, {}).finished()
    assert [shape.kind for shape in motion.shapes] == ["solid", "solid"]
    x, y, z = motion.corners(motion.shapes[1])[0].T
    np.testing.assert_allclose(z, 0.1 * x, atol=1e-14)
    assert x.min() < -0.5 and x.max() > 3.5 and y.min() < -0.5


def test_trees_and_their_closures():
    """A tree is drawn by its joints' positions, an open closure with its gap."""
    links = [lj.bodies.Body(f"link {i}", 1.0, (1 / 12, 1 / 12, 0.0)) for i in range(2)]
    tops = [lj.bodies.ground.at(axis=Y), links[0].at((0.0, 0.0, -0.5), Y)]
    tree = lj.bodies.Tree(
        links, {"angles": [lj.bodies.revolute(a, x.at((0.0, 0.0, 0.5), Y)) for a, x in zip(tops, links)]}
    )
    end = lj.bodies.spherical(lj.bodies.ground.at((0.0, 0.0, -1.5)), links[1].at((0.0, 0.0, -0.5)))
    picture = lj.draw(tree.system(closures={"end": end}), {"angles": np.zeros(2)})
    assert picture.apart() == {("'link 1'", "the ground"): pytest.approx(0.5, abs=1e-12)}


def test_points_in_the_plane_and_in_space(tmp_path):
    """Points by a function, of integers too: where it says; pages and figures of each are written."""
    swing = lambda t, q, params: {"rod": [(t, 0.0), (params["l"] * np.sin(q), -np.cos(q))]}
    flat = lj.draw(pendulum, 1, PARAMS, swing, t=2)
    np.testing.assert_allclose(flat.points["rod"], [[[2.0, 0.0], [PARAMS["l"] * np.sin(1), -np.cos(1)]]], atol=1e-15)
    tip = np.asarray(flat.figure().axes[0].lines[1].get_path().vertices)[1]
    np.testing.assert_allclose(tip, flat.points["rod"][0, 1])
    space = lj.draw(pendulum, 1.0, PARAMS, lambda t, q, params: (q, q, q))
    bodies = lj.draw(LINKAGE, ROUGH)
    for picture, words in ((flat, "shown in a notebook"), (space, "turns in a notebook"), (bodies, "turns")):
        assert words in str(picture) and len(picture.figure().axes) == 1
        picture.save(tmp_path / "page.html")
        page = (tmp_path / "page.html").read_text()
        # A still has nothing to play, and loads nothing.
        assert "<svg" in page and "<input" not in page and "http://" not in page.replace("http://www.w3.org", "")
    assert '"azimuth":-90.0,"elevation":20.0' in lj.draw(LINKAGE, ROUGH, view=(-90.0, 20.0))._repr_html_()
    for name, begins in (("figure.pdf", b"%PDF"), ("figure.png", b"\x89PNG")):
        bodies.save(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(begins)


def test_what_is_no_state():
    """A body that is not in q, words for numbers, a state that is traced: each is said."""
    with pytest.raises(ValueError, match="where the body 'rod' is"):
        lj.draw(LINKAGE, {"crank": ROUGH["crank"]})
    with pytest.raises(TypeError, match="q"):
        lj.draw(pendulum, "down", PARAMS)
    with pytest.raises(TypeError, match="(?s)being traced.*Fix:"):
        jax.jit(lambda q: lj.draw(pendulum, q, PARAMS) or q)(jnp.array(1.0))
    with pytest.raises(ValueError, match="nothing says how this system is drawn"):
        lj.draw(pendulum, 1.0, PARAMS)
