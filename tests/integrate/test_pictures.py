"""Films and figures: interpolation is exact at outputs, of fourth order between, and refused if too coarse; bodies.

One state as a picture: what is there, what is open, the frames, surfaces; as a page and as a figure.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display import Anchor, InSpace, Shape
from lagjax.integrate import Snapshot
from lagjax.integrate.pictures import hermite
from tests.by_hand import by_hand, swing
from tests.systems import PARAMS, pendulum

DENSE = np.linspace(0.0, 2.0, 41)
RATE = np.sqrt(PARAMS["g"] / PARAMS["l"])


def swung_at(t):
    """A pendulum's exact motion, with outputs at these times."""
    return by_hand(pendulum, t, *swing(t, 1.0, RATE), PARAMS)


@pytest.fixture(scope="module")
def traj():
    """A pendulum for a period, densely."""
    return swung_at(DENSE)


def bob(t, q, params):
    """The rod from its pivot to its bob, in NumPy."""
    return {"rod": [(0.0, 0.0), (params["l"] * np.sin(q), -params["l"] * np.cos(q))]}


def refused(*parts):
    """Expect an error that contains all parts and a fix."""
    return pytest.raises(ValueError, match="(?s)" + "".join(f"(?=.*{part})" for part in (*parts, "Fix:")))


def test_exact_at_outputs_and_for_cubics():
    """At outputs the values are those given, bit for bit; a cubic is reproduced everywhere, in any pytree."""
    t = np.array([0.0, 0.3, 1.0, 1.1])
    q, v = (
        {"a": np.stack([t**3, 1 - t], axis=1), "b": t**2},
        {"a": np.stack([3 * t**2, -np.ones(4)], axis=1), "b": 2 * t},
    )
    same = hermite(t, q, v, t)
    assert np.array_equal(same["a"], q["a"]) and np.array_equal(same["b"], q["b"])
    at = np.linspace(0.0, 1.1, 23)
    np.testing.assert_allclose(hermite(t, q, v, at)["a"], np.stack([at**3, 1 - at], axis=1), atol=1e-15)
    # Twin: with wrong slopes the cubic is not reproduced.
    assert np.max(np.abs(hermite(t, q, {"a": v["a"], "b": 0 * t}, at)["b"] - at**2)) > 1e-2


def test_fourth_order():
    """The error between outputs falls with the fourth power of their distance."""
    at, counts = np.linspace(0.0, 2.0, 501), np.array([11, 21, 41])
    errors = [np.max(np.abs(hermite(t, np.sin(3 * t), 3 * np.cos(3 * t), at) - np.sin(3 * at)))
              for t in (np.linspace(0.0, 2.0, n) for n in counts)]  # fmt: skip
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4) < 0.35), orders


def test_frames_follow_the_motion(traj):
    """Frames are equally far apart, the rod keeps its length, and frames at outputs show the outputs."""
    film = traj.animate(bob, seconds=4.0, rate=20.0)
    np.testing.assert_allclose(film.t, np.linspace(0.0, 2.0, 81), atol=1e-15)
    ends = film.points["rod"]
    assert ends.shape == (81, 2, 2) and not ends[:, 0].any()
    np.testing.assert_allclose(np.hypot(*ends[:, 1].T), PARAMS["l"], atol=1e-14)
    np.testing.assert_allclose(ends[::2, 1, 0], PARAMS["l"] * np.sin(traj.q), atol=1e-14)
    np.testing.assert_allclose(ends[:, 1, 0], PARAMS["l"] * np.sin(swing(film.t, 1.0, RATE)[0]), atol=1e-4)


def test_a_backward_motion_is_drawn(traj):
    """The film of a backward motion is the film of the forward motion, reversed."""
    back = by_hand(pendulum, DENSE[::-1], traj.q[::-1], traj.v[::-1], PARAMS)
    films = [motion.animate(bob).points["rod"] for motion in (back, traj)]
    np.testing.assert_allclose(films[0], films[1][::-1], atol=1e-14)


def ended(at, result):
    """The motion until some time, with NaN after it."""
    (q, v), end = swing(DENSE, 1.0, RATE), Snapshot(np.asarray(at), *map(np.asarray, swing(at, 1.0, RATE)), {})
    q, v = (np.where(at >= DENSE, x, np.nan) for x in (q, v))
    return by_hand(pendulum, DENSE, q, v, PARAMS, end=end, result=result)


def test_ends_with_the_motion():
    """NaN after an event are cut off, and the last frame is the event; of a motion that failed, the last output.

    One that never began is refused.
    """
    film = ended(0.52, lj.RESULTS.event_occurred).animate(bob)
    angle, _ = swing(0.52, 1.0, RATE)
    np.testing.assert_allclose(film.points["rod"][-1, 1], PARAMS["l"] * np.array([np.sin(angle), -np.cos(angle)]))
    assert film.t[-1] == 0.52
    np.testing.assert_allclose(ended(0.52, lj.RESULTS.not_finite).animate(bob).t[-1], 0.5, atol=1e-15)
    with refused("0 states", "failed at its start"):
        ended(-1.0, lj.RESULTS.start_not_finite).animate(bob)


def test_a_batch_is_animated_lane_by_lane():
    """The error for a batch says how to take one lane of it, and the lane can be animated."""
    lanes = jax.tree.map(lambda *x: np.stack(x), *(by_hand(pendulum, DENSE, *swing(DENSE, a, RATE)) for a in (0.5, 1)))
    with refused("batch of shape", r"traj\).animate\(positions\)"):
        lanes.animate(bob)
    assert len(jax.tree.map(lambda x: x[0], lanes).animate(lambda t, q, params: (q, 0.0)).t) == 51


SWUNG = lj.bodies.Body("rod", 1.0, (0.1, 0.1, 0.01))
SHAPES = [
    lj.shapes.box(SWUNG, (0.1, 0.1, 1.0)),
    lj.shapes.trail(SWUNG.at((0.0, 0.0, -0.5))),
    lj.shapes.line(lj.bodies.ground, SWUNG),
]


def swung(t, q, params):
    """The rod of a pendulum in the plane y = 0: down at q = 0, turned about -y."""
    return {"rod": lj.bodies.Pose.at((0.5 * jnp.sin(q), 0.0, -0.5 * jnp.cos(q)), axis=(0.0, -1.0, 0.0), angle=q)}


WRONG_POINTS = {
    "four coordinates": (lambda t, q, params: {"bob": (q, q, q, q)}, r"shape \(4,\) for 'bob'", "Usual cause"),
    "of plane and space": (
        lambda t, q, params: {"bob": (q, q, q), "pin": (q, q)}, "of the plane or points of space"),
    "a number": (lambda t, q, params: q, r"shape \(\)"),
    "words": (lambda t, q, params: "here", "a str"),
    "a changing number": (lambda t, q, params: [(q, q)] * (1 + (t > 1)), "the same points"),
    "none": (lambda t, q, params: {}, "the same points"),
    "not finite": (
        lambda t, q, params: {"bob": (jnp.sqrt(q), q)}, "NaN or infinity for 'bob' at t = ", "Usual cause"),
    "unknown poses": (SHAPES, "where the body 'rod' is", "lj.shapes.Drawing"),
    "nothing": (None, "nothing says how this system is drawn"),
    "what does not move": (lj.shapes.sphere(lj.bodies.ground, 1.0), "fixed in space"),
    "the plane beside space": (lj.shapes.Drawing([*SHAPES, bob], swung), "some in space"),
}  # fmt: skip
WRONG_SHAPES = {
    "NaN": (ValueError,
            lj.shapes.Drawing(SHAPES, lambda t, q, params: {"rod": lj.bodies.Pose.at((jnp.nan * q, 0.0, 0.0))}),
            "'rod' is NaN or infinite at t = 0"),
    "no pose": (ValueError, lj.shapes.Drawing(SHAPES, lambda t, q, params: {"rod": (q, q)}),
                r"has the shapes \(\) and \(\)"),
    "one size": (ValueError, lj.shapes.Drawing([lj.shapes.box(SWUNG, 0.3)], swung),
                 "the size of a shape must be three finite numbers, not 0.3"),
    "a negative size": (ValueError, lj.shapes.Drawing([lj.shapes.sphere(SWUNG, lambda p: -0.3)], swung), "zero on"),
    "a body": (TypeError, SWUNG, "not Body"),
    "bodies": (TypeError, [SWUNG], "list of Body"),
    "an empty list": (TypeError, [], "not list"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_POINTS)
def test_positions_that_are_no_points(name, traj):
    """What are no points, poses that are not known, and nothing that moves are refused by name, with a fix."""
    wrong, *words = WRONG_POINTS[name]
    with refused(*words):
        traj.animate(wrong)


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_shapes_that_cannot_be_drawn(name, traj):
    """Wrong poses and sizes, and bodies for shapes: each says what it is."""
    kind, wrong, words = WRONG_SHAPES[name]
    with pytest.raises(kind, match=words):
        traj.animate(wrong)


def test_outputs_too_far_apart():
    """A motion with too few outputs for interpolation is refused."""
    with refused("7 outputs are too few", "% of the picture", r"jnp.linspace\(0, 6, 57\)"):
        swung_at(np.linspace(0.0, 6.0, 7)).animate(bob)
    with refused("2 states"):
        swung_at(DENSE[:2]).animate(bob)


def test_no_time_to_play(traj):
    """A film of no length, or without an end, is refused; each says its frames, seconds and size."""
    for wrong in ({"seconds": 0.0}, {"seconds": -1.0}, {"seconds": np.inf}, {"seconds": np.nan}, {"trail": -1.0}):
        with refused("is not a film"):
            traj.animate(bob, **wrong)
    assert repr(traj.animate(bob)).startswith("Animation of 51 frames, 2 s, ")


def test_bodies_by_their_poses(traj):
    """Poses are those of the interpolated angle, in the order of shapes; the rod's end is where the function says."""
    tip = lambda t, q, params: {"tip": (np.sin(q), 0.0, -np.cos(q))}
    film = traj.animate(lj.shapes.Drawing([*SHAPES, tip], swung), seconds=4.0, rate=20.0)
    drawn = film.points
    assert len(drawn.shapes) == 3 and list(drawn.poses) == ["rod"] and drawn.poses["rod"].shape == (81, 7)
    end = drawn.place(drawn.shapes[1].anchors[0])
    np.testing.assert_allclose(end, drawn.points["tip"][:, 0], atol=1e-12)
    # Twin: turned the other way it is elsewhere.
    other = traj.animate(lj.shapes.Drawing(SHAPES, lambda t, q, params: swung(t, -q, params)), seconds=4.0, rate=20.0)
    assert np.abs(other.points.place(drawn.shapes[1].anchors[0]) - drawn.points["tip"][:, 0]).max() > 0.1


def test_sizes_by_params(traj):
    """Lengths and points that are functions of params have their values."""
    disk = lj.shapes.disk(SWUNG.at(lambda params: (0.0, 0.0, -params["l"])), radius=lambda params: 0.1 * params["l"])
    drawn = traj.animate(lj.shapes.Drawing(lambda params: [disk], swung)).points
    np.testing.assert_allclose(drawn.shapes[0].size, 0.1 * PARAMS["l"])
    np.testing.assert_allclose(drawn.shapes[0].anchors[0].point, [0.0, 0.0, -PARAMS["l"]])


def test_figures(traj):
    """Instants by number or by time, in the plane and in space, of one state too; times outside are refused."""
    for what in (bob, lj.shapes.Drawing(SHAPES, swung), lambda t, q, params: (q, q, q)):
        assert len(traj.draw(what, times=[0.0, 0.7]).axes) == 1
    (axis,) = traj.draw(bob, times=4).axes
    drawn = [line.get_xydata() for line in axis.lines[1:]]
    known = [bob(t, q, PARAMS)["rod"] for t, q in zip(traj.t, traj.q)]
    np.testing.assert_allclose([drawn[0], drawn[-1]], [known[0], known[-1]], atol=1e-12)
    assert len(drawn) == 4 and axis.get_aspect() == 1.0
    for times in ([2.1], -0.1, 0, []):
        with refused("between 0 and 2"):
            traj.draw(bob, times=times)
    assert swung_at(DENSE[:2]).draw(bob, times=1).axes


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
    with pytest.raises(TypeError, match="(?s)is tracing.*Fix:"):
        jax.jit(lambda q: lj.draw(pendulum, q, PARAMS) or q)(jnp.array(1.0))
    with pytest.raises(ValueError, match="nothing says how this system is drawn"):
        lj.draw(pendulum, 1.0, PARAMS)
