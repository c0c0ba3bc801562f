"""Links, joints and shapes as numbers, whichever file they come from; links that are fixed to each other become one.

A joint is at the origin of its child link and has its axes: where all joint positions are zero, the child's frame in
that of its parent is the joint's `Placement`, as in URDF. Links fixed to each other are one body, whose inertia is
the sum by the parallel-axis theorem,

    c = Σ m_i c_i / m,      I = Σ R_i I_i R_iᵀ + m_i (|d_i|² 1 - d_i d_iᵀ),      d_i = c_i - c.

Source: Featherstone, *Rigid Body Dynamics Algorithms* (2008), §2.13 and Ch. 4.
"""

from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lagjax.display import Faces

# What may stand before the text of a file: white space and a byte-order mark.
BEFORE_TEXT = " \t\r\n\ufeff"
LONGEST_SHOWN = 200
# By how much of their sum principal moments may miss the triangle inequality, as in `lj.bodies.Body`.
ROUNDED = 1e-9


class Placement(NamedTuple):
    """A frame inside another: its origin there, and the matrix whose columns are its axes there."""

    origin: np.ndarray
    axes: np.ndarray

    def point(self, r) -> np.ndarray:
        """A point of the inner frame, in the outer one."""
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

    @property
    def massless(self) -> bool:
        """Whether it is a frame and no body."""
        return self.mass == 0 and not self.inertia.any()


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


class NotTaken(NamedTuple):
    """What a file says and the model leaves out: what it is, whose, and its line."""

    what: str
    name: str
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
            if name in moving:
                raise ValueError(f"{joint.line}: a joint and a free body are both called '{name}'.\nFix: rename one.")
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
    with np.errstate(over="ignore", invalid="ignore"):
        return _summed(head, parts)


def _summed(head: RobotLink, parts: list[tuple[RobotLink, Placement]]) -> RobotLink:
    mass = sum(link.mass for link, _ in parts)
    moment = sum(link.mass * frame.point(link.centre) for link, frame in parts)
    centre = moment / mass if mass else np.zeros(3)
    inertia = np.zeros((3, 3))
    for link, frame in parts:
        d = frame.point(link.centre) - centre
        inertia += frame.axes @ link.inertia @ frame.axes.T + link.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return head._replace(mass=mass, centre=centre, inertia=inertia / 2 + inertia.T / 2)


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


def file_of(source: str | Path, user: str) -> Path | None:
    """The path of an existing file, None where the text itself was given; `user` is the function that asks."""
    if isinstance(source, str) and source.lstrip(BEFORE_TEXT).startswith("<"):
        return None
    if not isinstance(source, (str, Path)):
        raise TypeError(f"{user} takes the path of a file or its text, not {type(source).__name__}.")
    path = Path(source).expanduser()
    if not is_file(path):
        shown = str(source) if len(str(source)) <= LONGEST_SHOWN else str(source)[:LONGEST_SHOWN] + "..."
        raise FileNotFoundError(
            f"there is no file '{shown}', seen from {Path.cwd()}.\nUsual cause: another working directory, or a "
            f'package:// name, which ROS alone knows.\nFix: {user}("/path/to/the/file"), or the text itself.'
        )
    return path


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that is too long for the system is none."""
    try:
        return path.is_file()
    except OSError:
        return False
