"""Joint positions, counted from the file's drawing, and the way back to them from the markers that joints join.

    revolute     an angle about the axis
    prismatic    a length along the axis
    planar       two lengths along the first two vectors of the joint's frame and the angle about its axis
    spherical    the unit quaternion of the child's axes in the joint's

The position of a floating joint is the `lj.bodies.Pose` of its body in space, as in q.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.spatial.transform import Rotation

from lagjax.bodies import Body, Ground, Marker, Pose, conjugate, product, rotation_matrix
from lagjax.models.parts import Placement, RobotJoint

UNTURNED = (1.0, 0.0, 0.0, 0.0)
# Axes that are meant to be parallel, at right angles, or to meet.
ALIKE = 1e-9


def drawn(joint: RobotJoint, centre: np.ndarray) -> PyTree:
    """The position of a joint in the file's drawing; `centre` is the centre of mass of its child."""
    if joint.kind == "floating":
        where = joint.placement
        return Pose(jnp.asarray(where.point(centre), float), jnp.asarray(quaternion_of(where.axes), float))
    return {"planar": jnp.zeros(3), "spherical": jnp.array(UNTURNED)}.get(joint.kind, jnp.zeros(()))


def moved(joint: RobotJoint, s: PyTree, centre: np.ndarray) -> Placement:
    """Where the child's frame is at a position of its joint, in its frame in the drawing; floating, in space."""
    s = jax.tree.map(np.asarray, s)
    if joint.kind == "prismatic":
        return Placement(joint.axis * s, np.eye(3))
    if joint.kind == "revolute":
        return Placement(np.zeros(3), Rotation.from_rotvec(joint.axis * s).as_matrix())
    if joint.kind == "planar":
        return Placement(s[:2] @ frame_of(joint.axis)[:2], Rotation.from_rotvec(joint.axis * s[2]).as_matrix())
    axes = Rotation.from_quat(s if joint.kind == "spherical" else s.quaternion, scalar_first=True).as_matrix()
    return Placement(np.zeros(3) if joint.kind == "spherical" else s.position - axes @ centre, axes)


def frame_of(axis: np.ndarray) -> np.ndarray:
    """Three unit vectors as rows, the last of which is the axis: those of `lj.bodies.Marker`."""
    return np.array(Marker.on(Ground(), (0.0, 0.0, 0.0), axis if axis.any() else (0.0, 0.0, 1.0)).frame)


def quaternion_of(axes: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix."""
    return Rotation.from_matrix(axes).as_quat(scalar_first=True)


class BodyJoint(NamedTuple):
    """What joins a body to one before it, or to the ground: one joint, or several with massless links between them.

    `a` is on the body before, `b` on the body. Where all positions are zero their frames are alike, but those of a
    "universal", whose first vector is the other's axis. `along` holds the slides of a "planar" or "cylindrical" one, in
    the frame of a, as columns.
    """

    kind: str
    joints: tuple[RobotJoint, ...]
    a: Marker
    b: Marker
    along: np.ndarray


def connected(joints: tuple[RobotJoint, ...], bodies: tuple, centres: tuple) -> BodyJoint | None:
    """What joins two bodies by joints in a row, None where no joint of `lj` leaves just these motions.

    `bodies` and `centres` are those of the body before and of the body, the latter from their links' frames.
    """
    frames = [joints[0].placement]
    for joint in joints[1:]:
        frames.append(frames[-1].then(joint.placement))
    axes = [frame.axes @ joint.axis for frame, joint in zip(frames, joints)]
    kind, pivot = _kind(joints, frames, axes)
    if kind is None:
        return None
    rows = frame_of(joints[pivot].axis) @ frames[pivot].axes.T
    of_a = of_b = rows
    if kind == "universal":
        of_a = np.stack([axes[1], np.cross(axes[0], axes[1]), axes[0]])
        of_b = np.stack([axes[0], np.cross(axes[1], axes[0]), axes[1]])
    slides = [axis for axis, joint in zip(axes, joints) if joint.kind == "prismatic"]
    along = of_a @ np.stack(slides, axis=1) if slides else np.zeros((3, 0))
    last = frames[-1]
    in_child = last.axes.T @ (frames[pivot].origin - last.origin)
    a = _marker(bodies[0], frames[pivot].origin - centres[0], of_a)
    return BodyJoint(kind, joints, a, _marker(bodies[1], in_child - centres[1], of_b @ last.axes), along)


def _kind(joints, frames, axes) -> tuple[str | None, int]:
    """What joints in a row are together, and which of them has the place and the axis."""
    kinds = [joint.kind for joint in joints]
    if len(kinds) == 1:
        return kinds[0], 0
    apart = frames[-1].origin - frames[0].origin
    if kinds == ["revolute", "revolute"]:
        if abs(np.dot(*axes)) < ALIKE and np.abs(apart).max() < ALIKE:
            return "universal", 0
    if sorted(kinds) == ["prismatic", "revolute"] and abs(abs(np.dot(*axes)) - 1) < ALIKE:
        return "cylindrical", kinds.index("revolute")
    if kinds == ["prismatic", "prismatic", "revolute"]:
        flat = max(abs(axes[0] @ axes[2]), abs(axes[1] @ axes[2])) < ALIKE
        if flat and abs(np.dot(*axes[:2])) < 1 - ALIKE:
            return "planar", 2
    return None, 0


def _marker(body: Body | Ground, point: np.ndarray, rows: np.ndarray) -> Marker:
    return Marker(body, tuple(point.tolist()), tuple(map(tuple, rows.tolist())))


def _turned(e: Float[Array, "4"], r: Float[Array, "3"]) -> Float[Array, "3"]:
    return rotation_matrix(e) @ r


class Seen(NamedTuple):
    """The frame of b as seen from that of a: the quaternion that turns it, and where its origin is."""

    turn: Float[Array, "4"]
    apart: Float[Array, "3"]


def seen(joined: Sequence[BodyJoint], q: PyTree) -> Seen:
    """What each body is as seen from the one before it, stacked; all at once, so that it compiles as fast for many."""
    a, b = ([getattr(x, end) for x in joined] for end in ("a", "b"))
    poses = [jax.tree.map(lambda *x: jnp.stack(x), *(x.body.pose(q) for x in ends)) for ends in (a, b)]
    turns, places = ([form(x) for x in (a, b)] for form in (_turns, _places))

    def one(poses, turns, places):
        frames = [product(pose.quaternion, turn) for pose, turn in zip(poses, turns)]
        origins = [pose.position + _turned(pose.quaternion, place) for pose, place in zip(poses, places)]
        back = conjugate(frames[0])
        return Seen(product(back, frames[1]), _turned(back, origins[1] - origins[0]))

    return jax.vmap(one)(poses, turns, places)


def _turns(markers: Sequence[Marker]) -> np.ndarray:
    return quaternion_of(np.array([x.frame for x in markers]).transpose(0, 2, 1))


def _places(markers: Sequence[Marker]) -> np.ndarray:
    return np.array([x.place for x in markers])


def positions(joined: BodyJoint, seen: Seen, q: PyTree) -> dict[str, PyTree]:
    """The positions of the joints of a body, where they hold."""
    names, (turn, apart) = [joint.name for joint in joined.joints], seen
    if joined.kind == "universal":
        matrix = rotation_matrix(turn)
        return dict(zip(names, (jnp.arctan2(matrix[1, 2], matrix[0, 2]), jnp.arctan2(-matrix[2, 1], matrix[2, 0]))))
    if joined.kind in ("spherical", "floating"):
        return {names[0]: turn if joined.kind == "spherical" else joined.b.body.pose(q)}
    # The axis is the third vector of both frames.
    angle = jnp.arctan2(2 * turn[0] * turn[3], turn[0] ** 2 - turn[3] ** 2)
    if joined.kind == "planar" and len(names) == 1:
        return {names[0]: jnp.append(apart[:2], angle)}
    slid = iter(jnp.asarray(np.linalg.pinv(joined.along), apart.dtype) @ apart)
    return {joint.name: angle if joint.kind == "revolute" else next(slid) for joint in joined.joints}


def all_positions(joined: Sequence[BodyJoint], q: PyTree) -> dict[str, PyTree]:
    """The positions of the joints of some bodies, where they hold."""
    together = seen(joined, q)
    each = [jax.tree.map(lambda x: x[i], together) for i in range(len(joined))]
    return {name: s for x, one in zip(joined, each) for name, s in positions(x, one, q).items()}


def rate_squared(joined: BodyJoint, name: str, q: PyTree, v: PyTree) -> Float[Array, ""]:
    """The square of a joint's rate: of a spherical one, of its angular velocity."""
    kind, _, a, b, _ = joined
    if kind == "revolute":
        return jnp.dot(a.axis(q), b.body.spin(q, v) - a.body.spin(q, v)) ** 2
    if kind == "prismatic":
        return jnp.dot(a.axis(q), b.velocity(q, v) - a.velocity(q, v)) ** 2
    if kind == "spherical":
        return jnp.sum((b.body.spin(q, v) - a.body.spin(q, v)) ** 2)
    return jax.jvp(lambda q: all_positions([joined], q)[name], (q,), (v,))[1] ** 2
