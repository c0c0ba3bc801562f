"""Links and joints as numbers, whichever file they come from; links fixed to each other are one; positions; shapes.

A joint is at the origin of its child link and has its axes: where all joint positions are zero, the child's frame in
that of its parent is the joint's `Placement`, as in URDF. Links fixed to each other are one body, whose inertia is
the sum by the parallel-axis theorem,

    c = Σ m_i c_i / m,      I = Σ R_i I_i R_iᵀ + m_i (|d_i|² 1 - d_i d_iᵀ),      d_i = c_i - c.

Joint positions are counted from the file's drawing, and are read off the markers that joints join:

    revolute     an angle about the axis
    prismatic    a length along the axis
    planar       two lengths along the first two vectors of the joint's frame and the angle about its axis
    spherical    the unit quaternion of the child's axes in the joint's

The position of a floating joint is the `lj.bodies.Pose` of its body in space, as in q.

Source: Featherstone, *Rigid Body Dynamics Algorithms* (2008), §2.13 and Ch. 4.

Shapes on the links of a file, and the meshes that it names, are for `traj.animate` and `traj.draw` alone. Meshes are
read as STL, in bytes or as text, and OBJ.
"""

import re
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.spatial.transform import Rotation

from lagjax.bodies import Body, Ground, Marker, Pose, conjugate, product, rotation_matrix, usual_shapes
from lagjax.display import CUBE, CYLINDER, SPHERE, Anchor, Faces, Shape, triangles
from lagjax.refusals import must_differ

CORNER = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


class LinkShape(NamedTuple):
    """A shape on a body, for pictures and contacts written by hand.

    - `body`: the body's name, "ground" for what does not move; `link`: the link of the file.
    - `kind` and `size`: "box" (three edges), "cylinder" and "capsule" (radius, length without caps), "sphere" (radius),
      "ellipsoid" (three radii), "mesh" (scale along its axes), "plane" and others as in the file.
    - `origin` and `axes`: its frame, from the body's centre of mass along the body's axes.
    - `mesh`: the name of the mesh's file, as it stands there (in MJCF, of the mesh); `role`: "visual", "collision" or
      "both". `faces`: the mesh itself, where it was read, in its frame.
    """

    body: str
    link: str
    kind: str
    size: tuple[float, ...]
    origin: np.ndarray
    axes: np.ndarray
    mesh: str
    role: str
    faces: Faces | None = None


def looks_of(shapes: Iterable[LinkShape], bodies: Collection[Body]) -> tuple[Shape, ...]:
    """How bodies are drawn: by their shapes in the file; those that have none there as boxes with their inertia.

    Shapes for the eye are taken, those for contacts where a body has no others that are drawn; meshes that were read,
    no planes. A body with shapes that are not drawn gets no box: inertias of files are often made up, and a large box
    would hide the rest.
    """
    shapes = tuple(shapes)
    seen = {x.body for x in shapes if x.role != "collision" and _parts(x)}
    own = tuple(part for x in shapes if x.role != "collision" or x.body not in seen for part in _parts(x))
    without = {body.name for body in bodies} - {x.body for x in shapes}
    return *usual_shapes((body for body in bodies if body.name in without), (), None), *own


def not_drawn(shapes: Iterable[LinkShape]) -> dict[str, list[str]]:
    """By kind, which links have shapes for the eye that no picture shows, and the names of their meshes."""
    found: dict[str, list[str]] = {}
    for x in shapes:
        if x.role != "collision" and not _parts(x):
            whose = f"'{x.link}'" + f" ({x.mesh})" * bool(x.mesh)
            found.setdefault({"mesh": "meshes", "plane": "planes"}.get(x.kind, x.kind), []).append(whose)
    return found


def _parts(x: LinkShape) -> tuple[Shape, ...]:
    """One solid, or three for a capsule; none for what is not drawn."""
    body, rows = None if x.body == "ground" else x.body, tuple(map(tuple, np.asarray(x.axes).T.tolist()))

    def solid(surface, size, ahead: float = 0.0):
        place = np.asarray(x.origin) + ahead * np.asarray(x.axes)[:, 2]
        return Shape("solid", (Anchor(body, tuple(place.tolist()), rows),), surface, tuple(map(float, size)))

    if x.kind in ("box", "ellipsoid"):
        return (solid(CUBE if x.kind == "box" else SPHERE, x.size),)
    if x.faces is not None:
        return (solid(x.faces, x.size),)
    if x.kind == "sphere":
        return (solid(SPHERE, (x.size[0],) * 3),)
    if x.kind not in ("cylinder", "capsule"):
        return ()
    radius, length = x.size[:2]
    side = solid(CYLINDER, (radius, radius, length))
    caps = [solid(SPHERE, (radius,) * 3, end * length / 2) for end in (-1, 1)] if x.kind == "capsule" else []
    return side, *caps


def mesh_of(name: str, folder: Path | None) -> Faces | None:
    """The mesh of this name, seen from the folder of the file that names it; None if it is not there or is no mesh.

    `package://arm/hand.stl` is looked for as `arm/hand.stl` and as `hand.stl` in this folder and in those above it.
    """
    path = _found(name, folder)
    read = None if path is None else READERS.get(path.suffix.lower())
    if path is None or read is None:
        return None
    try:
        vertices, faces = read(path.read_bytes())
        if not np.all(np.isfinite(vertices)) or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            return None
        return triangles(vertices, faces)
    # Numbers that are none, too few, too many digits; a file that may not be read.
    except (ValueError, IndexError, OverflowError, OSError):
        return None


def _found(name: str, folder: Path | None) -> Path | None:
    scheme, _, rest = name.rpartition("://")
    if scheme == "package":
        places = (
            [above / x for above in (folder, *folder.parents) for x in (rest, rest.partition("/")[2])] if folder else []
        )
    else:
        places = [Path(rest) if folder is None else folder / rest]
    return next((place for place in places if is_file(place)), None)


def _stl(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    # Files in bytes may begin with "solid", too: their length decides.
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(data, facet, offset=84)["corners"].astype(float).reshape(-1, 3)
    else:
        corners = np.array(CORNER.findall(data), float).reshape(-1, 3)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


def _obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    rows = [row.split() for row in data.decode("utf-8", "replace").splitlines()]
    vertices = np.array([row[1:4] for row in rows if row[:1] == ["v"]], float)
    faces = [[int(x.partition("/")[0]) for x in row[1:]] for row in rows if row[:1] == ["f"]]
    # A polygon becomes a fan; indices begin at one.
    fans = [(face[0], *pair) for face in faces for pair in zip(face[1:], face[2:])]
    return vertices, np.array(fans, int).reshape(-1, 3) - 1


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that the system cannot have is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


READERS = {".stl": _stl, ".obj": _obj}


# By how much of their sum principal moments may miss the triangle inequality, as in `lj.bodies.Body`.
ROUNDED = 1e-9
UNTURNED = (1.0, 0.0, 0.0, 0.0)
# Axes that are meant to be parallel, at right angles, or to meet.
ALIKE = 1e-9


class Placement(NamedTuple):
    """A frame inside another: its origin there, and the matrix whose columns are its axes there."""

    origin: np.ndarray
    axes: np.ndarray

    def point(self, r) -> np.ndarray:
        """A point of the inner frame, in the outer one."""
        # The largest numbers overflow; `RobotModel.of` looks for that.
        with np.errstate(over="ignore", invalid="ignore"):
            return self.origin + self.axes @ np.asarray(r, float)

    def then(self, inner: "Placement") -> "Placement":
        """A frame inside this one, in the outer one."""
        return Placement(self.point(inner.origin), self.axes @ inner.axes)


def unmoved() -> Placement:
    """The frame itself."""
    return Placement(np.zeros(3), np.eye(3))


class RobotLink(NamedTuple):
    """A rigid part: its mass, its centre in its frame, its inertia about the centre along the frame's axes."""

    name: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    line: str

    @classmethod
    def frame(cls, name: str, line: str) -> "RobotLink":
        """One that has no mass."""
        return cls(name, 0.0, np.zeros(3), np.zeros((3, 3)), line)


class RobotJoint(NamedTuple):
    """How a link moves in its parent (None: the ground).

    `kind` is one of `KINDS`, or "fixed" before links are merged; `axis` a unit vector of the child's frame. A torque
    `-stiffness (s - rest) - damping s'` acts along the joint's position s, and its rotor adds `armature s'²/2` to the
    kinetic energy.
    """

    name: str
    kind: str
    parent: str | None
    child: str
    placement: Placement
    axis: np.ndarray
    line: str
    damping: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0


KINDS = ("revolute", "prismatic", "planar", "spherical", "floating")


class Loop(NamedTuple):
    """Two places that are held together besides the tree of joints: "spherical" (a point) or "fixed"."""

    name: str
    kind: str
    places: tuple[tuple[str | None, Placement], tuple[str | None, Placement]]
    line: str


class MergedLinks(NamedTuple):
    """Moving links by name, each with its joint to a link before it, and where the file's links are on them."""

    links: dict[str, RobotLink]
    joints: dict[str, RobotJoint]
    frames: dict[str, tuple[str | None, Placement]]


def merged(links: Mapping[str, RobotLink], joints: Iterable[RobotJoint]) -> MergedLinks:
    """Make one link of those that are fixed to each other; joints come parents first.

    `frames` has, by the name of each link of the file, the moving link that it is part of (None: the ground), and where
    its frame is in that.
    """
    frames: dict[str, tuple[str | None, Placement]] = {}
    moving, parts = {}, {}
    for joint in joints:
        head, frame = (None, unmoved()) if joint.parent is None else frames[joint.parent]
        here = frame.then(joint.placement)
        if joint.kind == "fixed":
            frames[joint.child] = head, here
        else:
            # A floating joint holds nothing: its position is the pose of its body, and goes by the body's name.
            name = joint.child if joint.kind == "floating" else joint.name
            must_differ([name, *moving], f"{joint.line}: a joint and a free body", "rename one")
            moving[name] = joint._replace(name=name, parent=head, placement=here)
            head = joint.child
            frames[head] = head, unmoved()
        parts.setdefault(head, []).append(joint.child)
    heads = {joint.child: links[joint.child] for joint in moving.values()}
    summed = {name: _sum(link, [(links[x], frames[x][1]) for x in parts[name]]) for name, link in heads.items()}
    return MergedLinks(summed, moving, frames)


def _sum(head: RobotLink, parts: list[tuple[RobotLink, Placement]]) -> RobotLink:
    if len(parts) == 1:
        return head
    # The largest numbers overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        mass = sum(link.mass for link, _ in parts)
        moment = sum(link.mass * frame.point(link.centre) for link, frame in parts)
        centre = moment / mass if mass else np.zeros(3)
        inertia = np.zeros((3, 3))
        for link, frame in parts:
            d = frame.point(link.centre) - centre
            inertia += inertia_along(frame.axes, link.inertia) + link.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return head._replace(mass=mass, centre=centre, inertia=inertia)


def inertia_along(axes: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """An inertia along the axes of a frame, along those in which the frame's axes are the columns."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = axes @ inertia @ axes.T
    return found / 2 + found.T / 2


def fault_of_inertia(link: RobotLink) -> str:
    """Why no body has these numbers, "" where one has."""
    if link.mass < 0:
        return f"has the mass {link.mass:.6g}"
    # Sums of the largest numbers overflow, those of the moments by the largest do not.
    size = np.abs(link.inertia).max() or 1.0
    if not np.isfinite(size):
        return "has moments of inertia beyond the largest number"
    moments = np.linalg.eigvalsh(link.inertia / size)
    if moments[0] < -ROUNDED * np.abs(moments).max():
        return f"has a negative principal moment of inertia, {moments[0] * size:.6g}"
    if moments[2] > (moments[0] + moments[1]) * (1 + ROUNDED):
        listed = ", ".join(f"{x:.6g}" for x in moments * size)
        return f"has the principal moments {listed}, of which the last is more than the sum of the others"
    return ""


def made_up(name: str, known: Container[str]) -> str:
    """A name for what has none in the file, that nothing there has."""
    while name in known:
        name += "'"
    return name


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
