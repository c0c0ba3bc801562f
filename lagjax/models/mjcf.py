"""MJCF files, compiled by MuJoCo itself: defaults, includes, units and inertias from shapes are its work.

Bodies, joints with their springs, dampers and rotors, equalities that close loops and shapes are taken from its
`mjModel`, lines from its `MjSpec`. A body with several joints becomes a row of massless links with a joint each.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lagjax.display import Faces, triangles
from lagjax.models.links_and_joints import (
    LinkShape,
    Loop,
    MergedLinks,
    Placement,
    RobotJoint,
    RobotLink,
    inertia_along,
    made_up,
    merged,
)
from lagjax.models.robot_model import BEFORE_TEXT, NotTaken, RobotModel, file_of

KIND = {"mjJNT_HINGE": "revolute", "mjJNT_SLIDE": "prismatic", "mjJNT_BALL": "spherical", "mjJNT_FREE": "floating"}
# What is listed as not taken, by the names of MuJoCo's lists.
BESIDE = {"actuators": "actuators", "tendons": "tendons", "sensors": "sensors", "pairs": "contact pairs",
          "flexes": "flexes", "plugins": "plugins"}  # fmt: skip
# MuJoCo's sizes are halves of lengths; how many a kind has.
WHOLE = {"box": (2.0, 2.0, 2.0), "cylinder": (1.0, 2.0, 0.0), "capsule": (1.0, 2.0, 0.0)}
COUNT = {"sphere": 1, "cylinder": 2, "capsule": 2}


def mujoco_itself() -> Any:
    """Import MuJoCo, or say how to get it."""
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("lj.read_mjcf needs MuJoCo.\nFix: pip install 'lagjax[models]'.") from error
    return mujoco


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
    path, mujoco = file_of(source, "lj.read_mjcf"), mujoco_itself()
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
        for what, field in (("non-linear springs", "jnt_stiffnesspoly"), ("non-linear damping", "dof_dampingpoly")):
            numbers = getattr(m, field, None)
            left[what] = numbers is not None and np.any(numbers[first if field.startswith("dof") else k])
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
        for field, what in BESIDE.items():
            self.not_taken += [NotTaken(what, x.name, x.info) for x in getattr(self.spec, field, ())]
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
