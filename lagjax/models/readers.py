"""Readers of URDF and MJCF files: links with inertias and shapes, joints, and what is not taken.

*URDF*, each element by its line. The elements are those of `wiki.ros.org/urdf/XML`. A rotation `rpy="r p y"` turns
about the fixed axes x, y, z in this order, R = Rz(y) Ry(p) Rx(r). Numbers are in the file's units, which are meant to
be SI, angles in radians.

Why MuJoCo, which reads MJCF here, does not read URDF as well: the numbers of what both read are the same, but it has
no lines of elements, passes over what it does not know (a misspelt <origin>, quat_xyzw=, a second root) without a word,
and does not take massless links that move, floating joints below the root, rows of more than 1,024 links, and meshes
that are not there (`tests/models/test_both_readers.py`). To know all this beforehand is to read the file.

*MJCF*, compiled by MuJoCo itself: defaults, includes, units and inertias from shapes are its work. Bodies, joints with
their springs, dampers and rotors, equalities that close loops and shapes are taken from its `mjModel`, lines from its
`MjSpec`. A body with several joints becomes a row of massless links with a joint each.
"""

import codecs
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from lagjax.bodies import unit_vector
from lagjax.display import Faces, triangles
from lagjax.models.links_and_joints import (
    LinkShape,
    Loop,
    MergedLinks,
    Placement,
    RobotJoint,
    RobotLink,
    fault_of_inertia,
    inertia_along,
    made_up,
    merged,
    mesh_of,
    unmoved,
)
from lagjax.models.robot_model import BEFORE_TEXT, NotTaken, RobotModel, file_of
from lagjax.refusals import installed, must_be_among, must_name

# What an element may have inside, and in which words what the model leaves out is listed; "" where nothing is.
LEFT_OUT = {
    "robot": dict.fromkeys(("link", "joint", "material"), "")
    | {x: f"<{x}>" for x in ("gazebo", "transmission", "sensor", "ros2_control", "mujoco", "plugin", "force_torque")},
    "link": {"inertial": "", "visual": "", "collision": "contacts of <collision>"}
    | {x: f"<{x}>" for x in ("sensor", "self_collision_checking", "contact", "type")},
    "inertial": dict.fromkeys(("origin", "mass", "inertia"), ""),
    "joint": dict.fromkeys(("origin", "parent", "child", "axis", "dynamics", "mimic"), "")
    | {"limit": "limits", "safety_controller": "safety controllers", "calibration": "calibrations"},
}
TYPES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "planar": "planar",
         "floating": "floating", "fixed": "fixed"}  # fmt: skip
SIZES = {"box": ("size",), "cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",)}


@dataclass
class XMLElement:
    """An element of a file, with its line."""

    tag: str
    attributes: dict[str, str]
    line: int
    inside: list["XMLElement"] = field(default_factory=list)

    def all(self, tag: str) -> Iterator["XMLElement"]:
        """What is inside under a name."""
        return (x for x in self.inside if x.tag == tag)

    def one(self, tag: str) -> "XMLElement | None":
        """What is inside under a name, at most once."""
        found = list(self.all(tag))
        if len(found) > 1:
            raise ValueError(f"line {found[1].line}: <{self.tag}> has a second <{tag}>.\nFix: leave one of them.")
        return found[0] if found else None

    def needed(self, tag: str) -> "XMLElement":
        """What must be inside."""
        found = self.one(tag)
        if found is None:
            raise ValueError(f"line {self.line}: {self.called} has no <{tag}>.\nFix: add it.")
        return found

    @property
    def called(self) -> str:
        """Its name for messages."""
        name = self.attributes.get("name")
        return f"<{self.tag}>" if name is None else f"<{self.tag}> '{name}'"

    def text(self, attribute: str) -> str:
        """An attribute that must be there."""
        if attribute not in self.attributes:
            raise ValueError(f"line {self.line}: {self.called} has no {attribute}=.\nFix: add it.")
        return self.attributes[attribute]

    def numbers(self, attribute: str, count: int, default=None) -> np.ndarray:
        """An attribute of some numbers."""
        if default is not None and attribute not in self.attributes:
            return np.asarray(default, float)
        words = self.text(attribute).split()
        try:
            found = np.array([float(word) for word in words])
        except ValueError:
            found = np.full(0, np.nan)
        if found.shape != (count,) or not np.isfinite(found).all():
            wanted = "a number" if count == 1 else f"{count} numbers"
            raise ValueError(
                f"line {self.line}: {attribute}= of {self.called} must be {wanted}, and is "
                f"'{self.attributes[attribute]}'.\nUsual cause: a xacro expression that was not evaluated.\n"
                "Fix: xacro robot.urdf.xacro > robot.urdf."
            )
        return found

    def number(self, attribute: str, default=None) -> float:
        """An attribute that is a number."""
        return float(self.numbers(attribute, 1, None if default is None else [default])[0])

    def left_out(self, name: str | None = None) -> list[NotTaken]:
        """What is inside and not taken, under this name or its own; what is not known is refused."""
        found = []
        for x in self.inside:
            what = LEFT_OUT[self.tag].get(x.tag)
            # A prefix is that of an extension of some program.
            if what is None and ":" not in x.tag:
                raise _unknown(x, self)
            if what != "":
                whose = x.attributes.get("name", "") if name is None else name
                found.append(NotTaken(what or f"<{x.tag}>", whose, f"line {x.line}"))
        return found

    def only(self, *attributes: str):
        """Refuse attributes that would be left out silently."""
        for name in self.attributes.keys() - set(attributes):
            raise ValueError(
                f"line {self.line}: {name}= of {self.called} is not supported.\nFix: one of {', '.join(attributes)}."
            )


def read_urdf(source, base: str = "fixed", gravity=(0.0, 0.0, -9.81)) -> RobotModel:
    """Read a mechanism from a URDF file.

    >>> rod = '''<robot name="pendulum">
    ...   <link name="post"/>
    ...   <link name="rod">
    ...     <inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
    ...       <inertia ixx="0.2" iyy="0.2" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    ...   </link>
    ...   <joint name="hinge" type="revolute">
    ...     <parent link="post"/><child link="rod"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/>
    ...   </joint>
    ... </robot>'''
    >>> model = read_urdf(rod)
    >>> model
    pendulum: 1 body, 1 joint (hinge: revolute)
      not taken: limits of 'hinge' (line 8)
    >>> q, v = model.state({"hinge": 0.3}, {"hinge": 2.0})
    >>> print(model.bodies["rod"].kinetic(q, v).round(12))  # (0.2 + 2.0 * 0.25) * 4 / 2
    1.4

    **Arguments:**

    - `source`: the path of a file, or its text.
    - `base`: "fixed", the root link is part of the ground; or "free", it flies, and its pose goes by the name of the
      root link among the positions of joints.
    - `gravity`: (3,), `[length]/[t]²`.

    Links without freedom between them become one body of the name of the one that is nearest the root: a fixed joint
    would cost seven coordinates and six equations. What changes which motions there are (a type of joint that is not
    known, `<mimic>`, a loop) is refused, by its line; limits, friction, transmissions, contacts, sensors, plugins are
    left out, and listed in `model.not_taken`.

    **Returns:** a `RobotModel`.

    **Raises:** `FileNotFoundError`; `ValueError` for what is not URDF or not supported, for inertias that no body has,
    for links with two parents, in a circle or without a way to the root: with the line of each.

    Source: the URDF specification, `wiki.ros.org/urdf/XML`.
    """
    must_be_among(("fixed", "free"), base, "base")
    path = file_of(source, "lj.read_urdf")
    robot = _parsed(source, "the text") if path is None else _parsed(path.read_bytes(), path.name)
    not_taken = robot.left_out()
    links = {x.text("name"): _link(x, not_taken) for x in _named_once(robot, "link")}
    joints = [_joint(x, links, not_taken) for x in _named_once(robot, "joint")]
    ordered = _from_the_root(links, joints, base)
    tree = merged(links, ordered)
    on_ground = {name for name, (head, _) in tree.frames.items() if head is None}
    faults = [f"{link.line}: '{link.name}' {fault}" for link in links.values()
              if link.name not in on_ground and (fault := fault_of_inertia(link))]  # fmt: skip
    if faults:
        raise ValueError(
            "no body has the inertia of " + ("this link" if len(faults) == 1 else "these links") + ":\n  "
            + "\n  ".join(faults) + "\nUsual cause: moments about the link's origin in place of its centre of mass, "
            "products of inertia with the other sign, or numbers made up or rounded.\n"
            "Fix: in the file, moments about the centre of mass, as the drawing program gives them."
        )  # fmt: skip
    folder = None if path is None else path.resolve().parent
    shapes = [shape for x in robot.all("link") for shape in _shapes(x, folder)]
    return RobotModel.of(robot.attributes.get("name", "robot"), tree, shapes, (), gravity, not_taken)


def _parsed(text: str | bytes, called: str) -> XMLElement:
    parser = expat.ParserCreate()
    top = XMLElement("", {}, 0)
    open_ = [top]
    # A declaration must stand at the very beginning.
    begun = text.lstrip(BEFORE_TEXT) if isinstance(text, str) else text.removeprefix(codecs.BOM_UTF8).lstrip()
    left_out = text[: len(text) - len(begun)]
    above = left_out.count("\n") if isinstance(left_out, str) else left_out.count(b"\n")

    def start(tag, attributes):
        element = XMLElement(tag, attributes, parser.CurrentLineNumber + above)
        open_[-1].inside.append(element)
        open_.append(element)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: open_.pop()
    try:
        parser.Parse(begun, True)
    except expat.ExpatError as error:
        raise ValueError(f"{called} is not XML: {error}.") from error
    robot = top.inside[0]
    if robot.tag != "robot":
        other = {"mujoco": "lj.read_mjcf(...) reads MJCF", "sdf": "SDF is not supported"}
        raise ValueError(
            f"line {robot.line} of {called}: URDF begins with <robot>, and this with <{robot.tag}>.\n"
            f"Fix: {other.get(robot.tag, 'give the URDF file')}."
        )
    macros = [x for x in robot.inside if x.tag.startswith("xacro:")]
    if macros:
        raise ValueError(
            f"line {macros[0].line} of {called}: <{macros[0].tag}> is a macro, which xacro must expand first.\n"
            "Fix: xacro robot.urdf.xacro > robot.urdf, and lj.read_urdf('robot.urdf')."
        )
    return robot


def _unknown(x: XMLElement, where: XMLElement) -> ValueError:
    return ValueError(
        f"line {x.line}: <{x.tag}> in {where.called} is not supported.\n"
        "Usual cause: a misspelt name, or an extension of some program.\nFix: remove it, or write what URDF has for it."
    )


def _named_once(robot: XMLElement, tag: str) -> list[XMLElement]:
    found: dict[str, XMLElement] = {}
    for x in robot.all(tag):
        before = found.setdefault(x.text("name"), x)
        if before is not x:
            raise ValueError(f"line {x.line}: {x.called} is there already, in line {before.line}.\nFix: rename one.")
    return list(found.values())


def _placement(x: XMLElement | None) -> Placement:
    if x is None:
        return unmoved()
    x.only("xyz", "rpy", "quat_xyzw")
    axes = Rotation.from_euler("xyz", x.numbers("rpy", 3, np.zeros(3)))
    if "quat_xyzw" in x.attributes:
        if "rpy" in x.attributes:
            raise ValueError(f"line {x.line}: <origin> has rpy= and quat_xyzw=.\nFix: leave one of them.")
        quaternion = unit_vector(x.numbers("quat_xyzw", 4))
        if not quaternion.any():
            raise ValueError(f"line {x.line}: quat_xyzw= of <origin> is zero, which is no rotation.\nFix: 0 0 0 1.")
        axes = Rotation.from_quat(quaternion)
    return Placement(x.numbers("xyz", 3, np.zeros(3)), axes.as_matrix())


def _link(x: XMLElement, not_taken: list[NotTaken]) -> RobotLink:
    name, inertial = x.text("name"), x.one("inertial")
    not_taken += x.left_out(name)
    if inertial is None:
        return RobotLink.frame(name, f"line {x.line}")
    not_taken += inertial.left_out(name)
    frame, mass, given = _placement(inertial.one("origin")), inertial.needed("mass"), inertial.needed("inertia")
    given.only("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    xx, yy, zz = (given.number(key) for key in ("ixx", "iyy", "izz"))
    xy, xz, yz = (given.number(key, 0.0) for key in ("ixy", "ixz", "iyz"))
    inertia = inertia_along(frame.axes, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return RobotLink(name, mass.number("value"), frame.origin, inertia, f"line {inertial.line}")


def _joint(x: XMLElement, links: dict[str, RobotLink], not_taken: list[NotTaken]) -> RobotJoint:
    name, line, kind = x.text("name"), f"line {x.line}", x.text("type")
    must_name(kind, sorted(TYPES), f"{line}: type= of {x.called} is", "type that is supported")
    if (mimic := x.one("mimic")) is not None:
        raise ValueError(
            f"line {mimic.line}: <mimic> of {x.called} is not supported: without it the joint would move freely.\n"
            "Fix: remove it, and tie the joints in joint coordinates: model.joint_system(closures={'mimic': "
            f"lj.Holonomic(lambda t, q, params: q['{name}'] - q['{mimic.attributes.get('joint', 'other')}'])}})."
        )
    not_taken += x.left_out(name)
    ends = [x.needed(tag).text("link") for tag in ("parent", "child")]
    for tag, end in zip(("parent", "child"), ends):
        must_name(end, links, f"line {x.needed(tag).line}: {x.called} names", "link")
    if ends[0] == ends[1]:
        raise ValueError(f"line {x.line}: {x.called} joins '{ends[0]}' to itself.")
    given = x.one("axis")
    told, axis = f"line {(given or x).line}", np.array([1.0, 0.0, 0.0]) if given is None else given.numbers("xyz", 3)
    with np.errstate(over="ignore"):
        size = np.hypot.reduce(axis)
    if kind not in ("fixed", "floating"):
        if not size > 0:
            raise ValueError(f"{told}: the axis of {x.called} is zero.")
        if abs(size - 1) > 1e-3:
            not_taken.append(NotTaken("length of the axis", name, told))
    dynamics, damping = x.one("dynamics"), 0.0
    if dynamics is not None:
        damping = dynamics.number("damping", 0.0)
        if dynamics.number("friction", 0.0) != 0:
            not_taken.append(NotTaken("dry friction", name, f"line {dynamics.line}"))
        if damping and kind not in ("revolute", "continuous", "prismatic"):
            not_taken.append(NotTaken("damping", name, f"line {dynamics.line}"))
            damping = 0.0
    return RobotJoint(name, TYPES[kind], *ends, _placement(x.one("origin")), unit_vector(axis), line, damping)


def _from_the_root(links: dict[str, RobotLink], joints: list[RobotJoint], base: str) -> list[RobotJoint]:
    """The joints, parents first, the first of which holds the root on the ground or lets it fly."""
    above: dict[str, RobotJoint] = {}
    for joint in joints:
        before = above.setdefault(joint.child, joint)
        if before is not joint:
            raise ValueError(
                f"{joint.line}: '{joint.child}' is the child of '{joint.name}' and of '{before.name}' ({before.line}), "
                "and URDF has trees only.\n"
                "Fix: one of the joints as lj.bodies.revolute(*...) in model.system(joints={...})."
            )
    roots = [name for name in links if name not in above]
    if len(roots) != 1:
        if not links:
            raise ValueError("there is no <link>.")
        if not roots:
            listed = ", ".join(f"'{joint.name}' ({joint.line})" for joint in joints)
            raise ValueError(f"the joints go in a circle, and no link is the root: {listed}.")
        listed = ", ".join(f"'{name}' ({links[name].line})" for name in roots)
        raise ValueError(
            f"there must be one root, and no joint holds {listed}.\n"
            "Usual cause: a joint that is missing.\nFix: a <joint> that has all but one of them as its <child>."
        )
    kind = "fixed" if base == "fixed" else "floating"
    ordered = [RobotJoint(roots[0], kind, None, roots[0], unmoved(), np.zeros(3), links[roots[0]].line)]
    below: dict[str | None, list[RobotJoint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    # It grows while it is gone through.
    for joint in ordered:
        ordered += below.get(joint.child, [])
    held = {joint.child for joint in ordered}
    if len(held) < len(links):
        lost = [joint for joint in joints if joint.child not in held]
        listed = ", ".join(f"'{joint.name}' ({joint.line})" for joint in lost)
        raise ValueError(f"these joints go in a circle that nothing joins to the root: {listed}.")
    return ordered


def _shapes(x: XMLElement, folder: Path | None) -> Iterator[LinkShape]:
    for role in ("visual", "collision"):
        for part in x.all(role):
            for geometry in part.needed("geometry").inside:
                if geometry.tag == "mesh":
                    size = geometry.numbers("scale", 3, np.ones(3))
                elif geometry.tag in SIZES:
                    sizes = SIZES[geometry.tag]
                    size = np.concatenate([geometry.numbers(key, 3 if key == "size" else 1) for key in sizes])
                else:
                    raise _unknown(geometry, part)
                frame, mesh = _placement(part.one("origin")), geometry.attributes.get("filename", "")
                faces = mesh_of(mesh, folder) if geometry.tag == "mesh" else None
                yield LinkShape("", x.text("name"), geometry.tag, tuple(size.tolist()), *frame, mesh, role, faces)


KIND = {"mjJNT_HINGE": "revolute", "mjJNT_SLIDE": "prismatic", "mjJNT_BALL": "spherical", "mjJNT_FREE": "floating"}
# What is listed as not taken, by the names of MuJoCo's lists.
BESIDE = {"actuators": "actuators", "tendons": "tendons", "sensors": "sensors", "pairs": "contact pairs",
          "flexes": "flexes", "plugins": "plugins"}  # fmt: skip
# MuJoCo's sizes are halves of lengths; how many a kind has.
WHOLE = {"box": (2.0, 2.0, 2.0), "cylinder": (1.0, 2.0, 0.0), "capsule": (1.0, 2.0, 0.0)}
COUNT = {"sphere": 1, "cylinder": 2, "capsule": 2}


def read_mjcf(source: str | Path) -> RobotModel:
    """Read a mechanism from an MJCF file, which MuJoCo compiles (extra `models`).

    >>> model = read_mjcf('''<mujoco model="pendulum"><worldbody>
    ...   <body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1" range="-60 60"/>
    ...     <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.02" mass="1"/></body>
    ... </worldbody></mujoco>''')
    >>> model
    pendulum: 1 body, 1 joint (hinge: revolute), 1 shape
      not taken: limits of 'hinge' (line 2)
      not taken: contacts of 'geom 0' (line 3)

    **Arguments:** `source`: the path of a file, whose `<include>`s and meshes MuJoCo looks for, or its text.

    Taken are masses and inertias, joints (also several of a body), their stiffness, damping and armature, `connect`
    and `weld`, which hold exactly here, the weight, and shapes. What changes which motions there are (a coupling of
    joints or tendons) is refused, by its line; limits, dry friction, contacts, actuators, tendons, sensors, drag are
    left out, and listed in `model.not_taken`.

    Positions of joints count from the file's drawing: MuJoCo's `qpos` minus its `qpos0`. That of a free joint is the
    `lj.bodies.Pose` of its body, and goes by the body's name.

    **Returns:** a `RobotModel`.

    **Raises:** `ImportError` without MuJoCo; `FileNotFoundError`; `ValueError` for what MuJoCo refuses, in its words,
    and for equalities that are not supported.

    Source: the MJCF reference, `mujoco.readthedocs.io/en/stable/XMLreference.html`.
    """
    path, mujoco = file_of(source, "lj.read_mjcf"), installed("mujoco", "lj.read_mjcf", "models")
    try:
        spec = (
            mujoco.MjSpec.from_string(str(source).lstrip(BEFORE_TEXT))
            if path is None
            else mujoco.MjSpec.from_file(str(path))
        )
        compiled = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo does not take {'the text' if path is None else path.name}: {error}") from error
    return _Reading(mujoco, spec, compiled).model()


class _Reading:
    """A compiled file on its way to a model."""

    def __init__(self, mujoco, spec, compiled):
        self.mujoco, self.spec, self.m = mujoco, spec, compiled
        self.not_taken: list[NotTaken] = []
        lists = {"body": spec.bodies, "joint": spec.joints, "geom": spec.geoms, "equality": spec.equalities}
        self.lines = {(kind, x.id): x.info for kind, found in lists.items() for x in found}
        self.known = {x.name for kind in ("body", "joint", "equality") for x in lists[kind]}
        self.bodies = [compiled.body(i).name or self._made_up(f"body {i}") for i in range(compiled.nbody)]
        self.joints = [compiled.joint(k).name or self._made_up(f"joint {k}") for k in range(compiled.njnt)]

    def model(self) -> RobotModel:
        links: dict[str, RobotLink] = {}
        joints: list[RobotJoint] = []
        # Where the frame of each body's link is in the body: at its last joint.
        shift = np.zeros((self.m.nbody, 3))
        for i in range(self.m.nbody):
            shift[i] = self._body(i, shift[self.m.body_parentid[i]], links, joints)
        tree = merged(links, joints)
        back = {self.bodies[i]: Placement(-shift[i], np.eye(3)) for i in range(self.m.nbody) if self.m.body_jntnum[i]}
        frames = {name: (head, back.get(name, frame)) for name, (head, frame) in tree.frames.items()}
        tree = MergedLinks(tree.links, tree.joints, {name: frames[name] for name in self.bodies})
        loops = [loop for i in range(self.m.neq) if (loop := self._loop(i, tree)) is not None]
        shapes = [self._shape(i) for i in range(self.m.ngeom)]
        self._beside()
        gravity = np.zeros(3) if self._disabled("GRAVITY") else self.m.opt.gravity
        return RobotModel.of(self.spec.modelname, tree, shapes, loops, gravity, self.not_taken)

    def _made_up(self, name: str) -> str:
        name = made_up(name, self.known)
        self.known.add(name)
        return name

    def _body(self, i: int, shift: np.ndarray, links: dict[str, RobotLink], joints: list[RobotJoint]) -> np.ndarray:
        """Add a body's links and joints; return where its link's frame is in the body."""
        m, name, line = self.m, self.bodies[i], self.lines.get(("body", i), "")
        parent = None if i == 0 else self.bodies[m.body_parentid[i]]
        told = np.concatenate([m.body_pos[i], m.body_quat[i], m.body_ipos[i], m.body_iquat[i], m.body_inertia[i]])
        if not (np.isfinite(told).all() and np.isfinite(m.body_mass[i]) and m.body_quat[i].any()):
            raise ValueError(
                f"{line}: place, mass or inertia of '{name}' are no finite numbers.\n"
                "Usual cause: a misprinted exponent.\nFix: its numbers in the file."
            )
        frame = Placement(m.body_pos[i] - shift, _matrix(m.body_quat[i]))
        numbers = range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i])
        at = np.zeros(3)
        for k in numbers:
            # MuJoCo ignores the place of a free joint.
            pivot = np.zeros(3) if self._kind(k) == "floating" else m.jnt_pos[k]
            child = name if k == numbers[-1] else self._made_up(f"{name} before {self.joints[k + 1]}")
            joints.append(self._joint(k, parent, child, frame.then(Placement(pivot - at, np.eye(3)))))
            links[child] = RobotLink.frame(child, line)
            parent, frame, at = child, Placement(np.zeros(3), np.eye(3)), pivot
        if not numbers:
            joints.append(RobotJoint(f"{name} is fixed", "fixed", parent, name, frame, np.zeros(3), line))
        inertia = inertia_along(_matrix(m.body_iquat[i]), np.diag(m.body_inertia[i]))
        links[name] = RobotLink(name, float(m.body_mass[i]), m.body_ipos[i] - at, inertia, line)
        return at

    def _kind(self, k: int) -> str:
        return KIND[self.mujoco.mjtJoint(self.m.jnt_type[k]).name]

    def _joint(self, k: int, parent: str | None, child: str, placement: Placement) -> RobotJoint:
        m, kind, name, line = self.m, self._kind(k), self.joints[k], self.lines.get(("joint", k), "")
        first, at = m.jnt_dofadr[k], m.jnt_qposadr[k]
        stiffness, damping = float(m.jnt_stiffness[k]), float(m.dof_damping[first])
        armature, rest = float(m.dof_armature[first]), 0.0
        stiffness = 0.0 if self._disabled("SPRING", "PASSIVE") else stiffness
        damping = 0.0 if self._disabled("DAMPER", "PASSIVE") else damping
        left = {"limits": m.jnt_limited[k], "dry friction": m.dof_frictionloss[first]}
        for what, entry in (("non-linear springs", "jnt_stiffnesspoly"), ("non-linear damping", "dof_dampingpoly")):
            numbers = getattr(m, entry, None)
            left[what] = numbers is not None and np.any(numbers[first if entry.startswith("dof") else k])
        if kind in ("spherical", "floating"):
            left["stiffness"], stiffness = stiffness, 0.0
        else:
            rest = float(m.qpos_spring[at] - m.qpos0[at])
        if kind == "floating":
            left |= {"damping": damping, "armature": armature}
            damping = armature = 0.0
        self.not_taken += [NotTaken(what, name, line) for what, there in left.items() if there]
        axis = m.jnt_axis[k] if kind in ("revolute", "prismatic") else np.zeros(3)
        if kind in ("revolute", "prismatic") and not 0 < np.abs(axis).max() < np.inf:
            raise ValueError(
                f"{line}: the axis of '{name}' has no direction that numbers can hold.\nFix: a unit vector."
            )
        return RobotJoint(name, kind, parent, child, placement, axis.copy(), line, damping, stiffness, rest, armature)

    def _loop(self, i: int, tree: MergedLinks) -> Loop | None:
        m, mujoco, line = self.m, self.mujoco, self.lines.get(("equality", i), "")
        # A loop and a joint of one name would be one constraint.
        name = m.equality(i).name or self._made_up(f"equality {i}")
        name = self._made_up(f"equality {name}") if name in self.joints else name
        if not m.eq_active0[i] or self._disabled("EQUALITY"):
            self.not_taken.append(NotTaken("inactive equalities", name, line))
            return None
        kind = mujoco.mjtEq(m.eq_type[i]).name.removeprefix("mjEQ_").lower()
        if kind not in ("connect", "weld"):
            raise ValueError(
                f"{line}: the equality '{name}' couples by '{kind}', which is not supported: without it the parts "
                "would move freely.\nFix: remove it, and tie the joints in joint coordinates: model.joint_system("
                "closures={'gear': lj.Holonomic(lambda t, q, params: q['a'] - 2 * q['b'])})."
            )
        ends, data = (m.eq_obj1id[i], m.eq_obj2id[i]), m.eq_data[i]
        if m.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
            inner = [(m.site_bodyid[x], Placement(m.site_pos[x], _matrix(m.site_quat[x]))) for x in ends]
        elif kind == "connect":
            inner = [(x, Placement(data[3 * j : 3 * j + 3], np.eye(3))) for j, x in enumerate(ends)]
        else:
            # A point of the second body, and where it and the second body's axes are in the first.
            inner = [(ends[0], Placement(data[3:6], _matrix(data[6:10]))), (ends[1], Placement(data[:3], np.eye(3)))]
        places = []
        for body, place in inner:
            head, frame = tree.frames[self.bodies[body]]
            places.append((head, frame.then(place)))
        return Loop(name, "spherical" if kind == "connect" else "fixed", (places[0], places[1]), line)

    def _shape(self, i: int) -> LinkShape:
        m, collides = self.m, bool(self.m.geom_contype[i] or self.m.geom_conaffinity[i])
        kind = self.mujoco.mjtGeom(m.geom_type[i]).name.removeprefix("mjGEOM_").lower()
        mesh, faces = self._mesh(m.geom_dataid[i]) if kind == "mesh" else ("", None)
        if collides and not self._disabled("CONTACT"):
            self.not_taken.append(NotTaken("contacts", m.geom(i).name or f"geom {i}", self.lines.get(("geom", i), "")))
        axes, role = _matrix(m.geom_quat[i]), "both" if collides else "visual"
        size = np.ones(3) if kind == "mesh" else m.geom_size[i] * np.array(WHOLE.get(kind, (1.0, 1.0, 1.0)))
        size = tuple(size[: COUNT.get(kind, 3)].tolist())
        return LinkShape("", self.bodies[m.geom_bodyid[i]], kind, size, m.geom_pos[i].copy(), axes, mesh, role, faces)

    def _mesh(self, k: int) -> tuple[str, Faces]:
        m = self.m
        vertices = m.mesh_vert[m.mesh_vertadr[k] :][: m.mesh_vertnum[k]]
        faces = m.mesh_face[m.mesh_faceadr[k] :][: m.mesh_facenum[k]]
        return m.mesh(k).name, triangles(vertices.astype(float), faces.astype(int))

    def _beside(self):
        """List what else is not taken."""
        for entry, what in BESIDE.items():
            self.not_taken += [NotTaken(what, x.name, x.info) for x in getattr(self.spec, entry, ())]
        for i, name in enumerate(self.bodies):
            if self.m.body_gravcomp[i]:
                self.not_taken.append(NotTaken("gravity compensation", name, self.lines.get(("body", i), "")))
        if self.m.opt.density or self.m.opt.viscosity:
            self.not_taken.append(NotTaken("drag of the medium", "", ""))

    def _disabled(self, *names: str) -> bool:
        flags = [getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{name}", 0) for name in names]
        return any(self.m.opt.disableflags & int(flag) for flag in flags)


def _matrix(quaternion) -> np.ndarray:
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
