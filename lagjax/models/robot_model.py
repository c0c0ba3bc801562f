"""A mechanism from a file: bodies and joints, its system in either kind of coordinates, and the way between them."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from lagjax.bodies import (
    Body,
    Ground,
    Load,
    Marker,
    Pose,
    Tree,
    cylindrical,
    fixed,
    ground,
    multibody,
    planar,
    prismatic,
    revolute,
    spherical,
    spin_in_body,
    universal,
    weight,
)
from lagjax.display import Drawing, Shape, Still
from lagjax.integrate import still, subject_of
from lagjax.models.links_and_joints import (
    BodyJoint,
    LinkShape,
    Loop,
    MergedLinks,
    Placement,
    RobotJoint,
    RobotLink,
    all_positions,
    connected,
    drawn,
    is_file,
    looks_of,
    made_up,
    moved,
    not_drawn,
    quaternion_of,
    rate_squared,
    unmoved,
)
from lagjax.refusals import must, must_be, must_differ, must_name
from lagjax.shapes import axis, line
from lagjax.system import Holonomic, System

EQUATIONS = {"revolute": revolute, "prismatic": prismatic, "spherical": spherical, "planar": planar,
             "universal": universal, "cylindrical": cylindrical, "fixed": fixed}  # fmt: skip

# The axis of joints that have none.
UPWARD = (0.0, 0.0, 1.0)
# How many of a kind `print` lists.
LISTED = 6
# What may stand before the text of a file: white space and a byte-order mark.
BEFORE_TEXT = " \t\r\n\ufeff"
LONGEST_SHOWN = 200


class NotTaken(NamedTuple):
    """What a file says and the model leaves out: what it is, whose, and its line."""

    what: str
    name: str
    line: str


@dataclass(frozen=True, eq=False, repr=False)
class RobotModel:
    """A mechanism from a file: what `lj.read_urdf` and `lj.read_mjcf` return.

    >>> import lagjax as lj
    >>> model = lj.read_urdf('''<robot name="slide"><link name="rail"/><link name="cart">
    ...   <inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
    ...   <joint name="s" type="prismatic"><parent link="rail"/><child link="cart"/></joint></robot>''')
    >>> q, v = model.state({"s": 0.5}, {"s": 3.0})
    >>> print(q["cart"].position, model.joint_positions(q)["s"], model.joint_rates(q, v)["s"])
    [0.5 0.  0. ] 0.5 3.0

    - `name`: as in the file; `bodies`: `lj.bodies.Body`s by the names of their links, with the links' axes; `shapes`:
      the shapes on them; `gravity`: (3,).
    - `links`, `joints`: what moves, as plain numbers, parents first; `frames`: by each link of the file, the link that
      it is part of (None: the ground) and where its frame is in that; `loops`: what is held together besides.
    - `not_taken`: what the file says and the model leaves out, each with its line; `print(model)` lists it.

    Positions of joints, by name, count from the file's drawing, `[length]` or radians: a number for revolute and
    prismatic joints, (3,) for planar ones (two lengths, an angle), a unit quaternion for spherical ones; for floating
    ones, which go by the name of their body, its `lj.bodies.Pose` in space.
    """

    name: str
    links: dict[str, RobotLink]
    joints: dict[str, RobotJoint]
    frames: dict[str, tuple[str | None, Placement]]
    shapes: tuple[LinkShape, ...]
    loops: tuple[Loop, ...]
    gravity: tuple[float, float, float]
    not_taken: tuple[NotTaken, ...]

    @classmethod
    def of(cls, name: str, merged: MergedLinks, shapes: Iterable[LinkShape], loops: Iterable[Loop], gravity: ArrayLike,
           not_taken: Iterable[NotTaken]) -> "RobotModel":  # fmt: skip
        """The model of a tree; shapes come in the frames of the file's links."""
        field = np.asarray(gravity, float)
        well = field.shape == (3,) and np.all(np.isfinite(field))
        must(well, "gravity must be three finite numbers", gravity, "gravity=(0.0, 0.0, -9.81)")
        placed = tuple(_on_body(shape, merged) for shape in shapes)
        if not merged.joints:
            raise ValueError(
                f"nothing in '{name}' moves: it has no joints but fixed ones.\n"
                'Usual cause: a body that flies.\nFix: lj.read_urdf(..., base="free"), or <freejoint/> in MJCF.'
            )
        empty = [link for link in merged.links.values() if link.mass == 0 and link.inertia.any()]
        if empty:
            raise ValueError(
                f"{empty[0].line}: '{empty[0].name}' has moments of inertia and no mass.\n"
                "Fix: its mass; or all of them zero, if it is a frame."
            )
        loops = tuple(loops)
        told = [(link.line, link.name, (link.mass, *link.centre, *link.inertia.flat)) for link in merged.links.values()]
        told += [(joint.line, joint.name, joint.placement.origin) for joint in merged.joints.values()]
        told += [(loop.line, loop.name, np.concatenate([x.origin for _, x in loop.places])) for loop in loops]
        for where, whose, numbers in told:
            if not np.isfinite(numbers).all():
                raise ValueError(
                    f"{where}: mass, inertia or place of '{whose}', with what is fixed to it, are beyond the largest "
                    "number.\nUsual cause: a misprinted exponent.\nFix: its numbers in the file."
                )
        return cls(name, *merged, placed, loops, tuple(field.tolist()), tuple(not_taken))

    def __reduce__(self):
        # Without what is kept, which has compiled programs.
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

    @cached_property
    def bodies(self) -> dict[str, Body]:
        """The bodies by name; links without mass are none."""
        return {name: Body(name, link.mass, tuple(map(tuple, link.inertia.tolist())))
                for name, link in self.links.items() if link.mass > 0}  # fmt: skip

    def joint_state(self, positions: Mapping | None = None, rates: Mapping | None = None) -> tuple[dict, dict]:
        """Positions and rates of all joints, q and v of `joint_system()`; those not named are as drawn and at rest."""
        q = {name: drawn(joint, self.links[joint.child].centre) for name, joint in self.joints.items()}
        return _given(q, positions), _given(jax.tree.map(jnp.zeros_like, q), rates)

    def state(self, positions: Mapping | None = None, rates: Mapping | None = None) -> tuple[dict, dict]:
        """The poses of all bodies and their rates, q and v of `system()`, by positions and rates of joints.

        Joints that are not named are as drawn and at rest.
        """
        return self._of_joints(*self.joint_state(positions, rates))

    def joint_positions(self, q: PyTree) -> dict:
        """The positions of the joints by q of `system()`; angles from -π to π."""
        return self._of_bodies(q, jax.tree.map(jnp.zeros_like, q))[0]

    def joint_rates(self, q: PyTree, v: PyTree) -> dict:
        """The rates of the joints' positions by q and v of `system()`."""
        return self._of_bodies(q, v)[1]

    def at(self, link: str, point: ArrayLike = (0.0, 0.0, 0.0), axis: ArrayLike = (0.0, 0.0, 1.0)) -> Marker:
        """A place on a link of the file, in its frame there, for loads and further joints: a `lj.bodies.Marker`."""
        must_name(link, self.frames, "a place is asked for on", "link")
        head, frame = self.frames[link]
        return self._marker(head, Placement(frame.point(point), frame.axes), axis)

    def markers(self, joint: str) -> tuple[Marker, Marker]:
        """The two places that a joint joins: `lj.bodies.motor(*model.markers("elbow"), torque)`."""
        for x in self._between.values():
            if [y.name for y in x.joints] == [joint]:
                return x.a, x.b
        must_name(joint, self.joints, "places are asked for of", "joint")
        raise ValueError(f"the joint '{joint}' has a massless link at one end, and no place on a body there.")

    def system(self, loads: Iterable[Load] = (), joints: Mapping | None = None, **others) -> System:
        """Return the system of its bodies: q and v are dicts of `lj.bodies.Pose` by body, joints are constraints.

        Weight, dampers, springs and rotors of joints are in it, and loops; `loads`, `joints` and `others` are further
        ones of `lj.bodies.multibody`. A spring's angle counts from -π to π.

        **Raises:** `ValueError` for a massless link that no joint of `lj` stands for, by its line.
        """
        own, loops = {}, self._loops()
        for x in self._between.values():
            if x.kind != "floating":
                name = " ".join(joint.name for joint in x.joints)
                name = name if len(x.joints) == 1 else made_up(name, own.keys() | self.joints.keys() | loops.keys())
                own[name] = EQUATIONS[x.kind](x.a, x.b)
        own |= loops
        must_differ([*own, *(joints or {})], "a joint of the file and another one", "another name")
        bodies, lagrangian = list(self.bodies.values()), others.pop("lagrangian", None)
        if any(joint.armature for joint in self.joints.values()):
            lagrangian = partial(self._with_rotors, lagrangian)
        every = [weight(bodies, self.gravity), *self._loads(), *loads]
        system = multibody(bodies, own | dict(joints or {}), every, lagrangian, **others)
        return _drawn(system, Drawing(self._looks))

    def joint_system(self, loads: Iterable[Load] = (), closures: Mapping | None = None, **others) -> System:
        """Return the system in joint coordinates: q and v are positions and rates of joints by name.

        It is that of `tree()`, solved at O(n). Springs of joints count whole turns.

        `loads` are those of `lj.bodies.multibody`, `closures` constraints by name; both read `q[body]` as a pose, and
        the position of a joint under any other name. Loops of the file are in it. `others` are `force`, `dissipation`,
        `states` and `elements` of `lj.System`, in joint coordinates.
        """
        dissipation, joints = others.pop("dissipation", None), self.joints.values()
        if any(joint.damping for joint in joints):
            dissipation = partial(self._of_dampers, dissipation)
        system = self.tree().system(
            [weight(self.bodies.values(), self.gravity), *loads],
            self._loops() | dict(closures or {}),
            self._of_springs if any(joint.stiffness for joint in joints) else None,
            dissipation=dissipation,
            **others,
        )
        return _drawn(system, Drawing(self._looks, self._drawn_poses))

    def draw(self, positions: Mapping | None = None, *, frames: bool = False,
             view: tuple[float, float] = (-60.0, 22.0)) -> Still:  # fmt: skip
        """Draw the mechanism where its joints have these positions; those that are not named are as drawn in the file.

        `frames` and `view` are those of `lj.draw`. What the file draws and the picture does not, `print(model)` lists.
        """
        q, _ = self.joint_state(positions)
        placed: dict[str | None, Placement] = {None: unmoved()}
        for name, joint in self.joints.items():
            at = moved(joint, q[name], self.links[joint.child].centre)
            placed[joint.child] = (
                at if joint.kind == "floating" else placed[joint.parent].then(joint.placement).then(at)
            )
        poses = {name: Pose(placed[name].point(self.links[name].centre), quaternion_of(placed[name].axes))
                 for name in self.bodies}  # fmt: skip
        return still(subject_of(Drawing(self._looks), None, None), 0.0, poses, frames, view)

    def tree(self) -> Tree:
        """Return the `lj.bodies.Tree` of its links, with the rotors of joints; without what else acts, and loops.

        **Raises:** `ValueError` for a link without mass that moves and carries none, by its line.
        """
        return self._tree

    @cached_property
    def _tree(self) -> Tree:
        # The mass of a link and of what hangs on it; children come after their parents.
        mass = {name: link.mass for name, link in self.links.items()}
        for joint in reversed(self.joints.values()):
            if joint.parent is not None:
                mass[joint.parent] += mass[joint.child]
        if bare := [joint for joint in self.joints.values() if not mass[joint.child]]:
            raise self._massless(bare[:1])
        frames = {name: Body(name, 0.0, (0.0, 0.0, 0.0)) for name in self.links if name not in self.bodies}
        bodies = {name: frames.get(name) or self.bodies[name] for name in self.links}

        def end(head: str | None, frame: Placement, joint: RobotJoint) -> Marker:
            body, centre = (ground, np.zeros(3)) if head is None else (bodies[head], self.links[head].centre)
            return _marker(body, centre, frame, joint.axis if joint.axis.any() else UPWARD)

        equations = {x.name: EQUATIONS[x.kind](end(x.parent, x.placement, x), end(x.child, unmoved(), x))
                     for x in self.joints.values() if x.kind != "floating"}  # fmt: skip
        armature = {x.name: x.armature for x in self.joints.values() if x.armature}
        return Tree(list(bodies.values()), equations, armature)

    def _drawn_poses(self, t: Any, q: PyTree, params: PyTree) -> dict[str, Pose]:
        return self._poses(q)

    def _looks(self, params: PyTree) -> tuple[Shape, ...]:
        """How it is drawn: bodies, and at each joint a dot with arms to the bodies' centres."""
        found = list(looks_of(self.shapes, self.bodies.values()))
        for joint in self.joints.values():
            for head, frame in ((joint.parent, joint.placement), (joint.child, unmoved())):
                if head is None or head in self.bodies:
                    marker = self._marker(head, frame, UPWARD)
                    found += [line(marker)] if head is None else [line(marker), line(marker.body, marker)]
            ends = (joint.child, unmoved()), (joint.parent, joint.placement)
            held = next(((head, frame) for head, frame in ends if head in self.bodies), None)
            if joint.axis.any() and held is not None:
                found.append(axis(self._marker(*held, joint.axis)))
        for loop in self._loops().values():
            found += getattr(loop.function, "drawing", ())
        return tuple(found)

    def _loops(self) -> dict[str, Holonomic]:
        ends = [[self._marker(head, frame, (0.0, 0.0, 1.0)) for head, frame in loop.places] for loop in self.loops]
        return {loop.name: EQUATIONS[loop.kind](*places) for loop, places in zip(self.loops, ends)}

    def _loads(self) -> list[Load]:
        """Springs and dampers of joints, by the poses of bodies."""
        springs = [Load(potential=partial(self._spring, x)) for x in self.joints.values() if x.stiffness]
        return springs + [Load(dissipation=partial(self._damper, x)) for x in self.joints.values() if x.damping]

    # Functions of systems are methods, which can be pickled, and no closures.
    def _spring(self, joint: RobotJoint, t, q: PyTree, v: PyTree, params: PyTree):
        return joint.stiffness * (all_positions([self._of(joint)], q)[joint.name] - joint.rest) ** 2 / 2

    def _damper(self, joint: RobotJoint, t, q: PyTree, v: PyTree, params: PyTree):
        return joint.damping * rate_squared(self._of(joint), joint.name, q, v) / 2

    def _with_rotors(self, lagrangian: Callable | None, t, q: PyTree, v: PyTree, params: PyTree):
        rotors = [joint for joint in self.joints.values() if joint.armature]
        energies = [x.armature * rate_squared(self._of(x), x.name, q, v) / 2 for x in rotors]
        return sum(energies) + (0.0 if lagrangian is None else lagrangian(t, q, v, params))

    def _of_springs(self, t, q: PyTree, params: PyTree):
        springs = [joint for joint in self.joints.values() if joint.stiffness]
        return sum(x.stiffness * (q[x.name] - x.rest) ** 2 / 2 for x in springs)

    def _of_dampers(self, dissipation: Callable | None, t, q: PyTree, v: PyTree, params: PyTree):
        own = sum(x.damping * _squared(x, q, v) / 2 for x in self.joints.values() if x.damping)
        return own if dissipation is None else own + dissipation(t, q, v, params)

    def _of(self, joint: RobotJoint) -> BodyJoint:
        return next(x for x in self._between.values() if joint in x.joints)

    def _poses(self, s: Mapping) -> dict[str, Pose]:
        poses = self._tree.poses(s)
        return {name: Pose(poses[name].position, poses[name].quaternion) for name in self.bodies}

    def _moving(self, s: Mapping, w: Mapping) -> tuple[dict[str, Pose], dict[str, Pose]]:
        return jax.jvp(self._poses, (s,), (w,))

    @cached_property
    def _of_joints(self) -> Callable:
        return jax.jit(self._moving)

    @cached_property
    def _of_bodies(self) -> Callable:
        def of_all(q):
            found = all_positions(list(self._between.values()), q)
            return {name: found[name] for name in self.joints}

        return jax.jit(lambda q, v: jax.jvp(of_all, (q,), (v,)))

    def _marker(self, head: str | None, frame: Placement, axis: ArrayLike) -> Marker:
        if head is not None and head not in self.bodies:
            raise ValueError(f"'{head}' has no mass, and no place on it holds anything.\nFix: a place on a body.")
        body, centre = (ground, np.zeros(3)) if head is None else (self.bodies[head], self.links[head].centre)
        return _marker(body, centre, frame, axis)

    @cached_property
    def _between(self) -> dict[str, BodyJoint]:
        """By body, what joins it to the body before it."""
        above = {joint.child: joint for joint in self.joints.values()}
        holds = Counter(joint.parent for joint in self.joints.values())
        found, passed = {}, set()
        for name in self.bodies:
            joints = [above[name]]
            while (parent := joints[0].parent) is not None and parent not in self.bodies:
                joints.insert(0, above[parent])
                passed.add(parent)
            ends = (ground if parent is None else self.bodies[parent], self.bodies[name])
            centres = (np.zeros(3) if parent is None else self.links[parent].centre, self.links[name].centre)
            # A massless link that holds several joints moves them together.
            forks = any(holds[joint.parent] > 1 for joint in joints[1:])
            joined = None if forks else connected(tuple(joints), ends, centres)
            if joined is None:
                raise self._massless(joints)
            found[name] = joined
        for name in self.links.keys() - self.bodies.keys() - passed:
            raise self._massless([above[name]])
        return found

    def _massless(self, joints: list[RobotJoint]) -> ValueError:
        link = self.links[joints[0].child]
        listed = ", ".join(f"'{joint.name}' ({joint.kind})" for joint in joints)
        return ValueError(
            f"{link.line}: the link '{link.name}' moves and has no mass, by {listed}: what moves it has no "
            "acceleration of its own, and no joint of lj stands for these together.\n"
            "Usual cause: a missing <inertial>, or a frame that should be fixed.\nFix: give it a mass and an inertia, "
            'or type="fixed"; between two bodies, model.joint_system() takes it as it is.'
        )

    def __repr__(self):
        joints = ", ".join(f"{name}: {joint.kind}" for name, joint in self.joints.items())
        many = len(self.bodies)
        first = f"{self.name}: {many} {'body' if many == 1 else 'bodies'}, {_count(self.joints, 'joint')}"
        first += f" ({joints})" * bool(joints) + f", {_count(self.shapes, 'shape')}" * bool(self.shapes)
        lines = [first, *(f"  loop: {loop.name} ({loop.kind})" for loop in self.loops)]
        fixed_to = {name: head for name, (head, _) in self.frames.items() if head not in (name, None)}
        if fixed_to:
            lines.append("  merged: " + ", ".join(f"{name} into {head}" for name, head in fixed_to.items()))
        for what, whose in not_drawn(self.shapes).items():
            lines.append(f"  not drawn: {what} of {_listed(whose)}")
        for what in dict.fromkeys(x.what for x in self.not_taken):
            whose = [x for x in self.not_taken if x.what == what]
            listed = _listed([(f"'{x.name}' " * bool(x.name) + f"({x.line})" * bool(x.line)).strip() for x in whose])
            lines.append(f"  not taken: {what} {'of ' * any(x.name for x in whose)}{listed}".rstrip())
        return "\n".join(lines)


def _drawn(system: System, drawing: Drawing) -> System:
    return replace(system, lagrangian=replace(system.lagrangian, drawn=drawing))


def _listed(whose: list[str]) -> str:
    return ", ".join(whose[:LISTED]) + (f" and {len(whose) - LISTED} more" if len(whose) > LISTED else "")


def _count(x, what: str) -> str:
    return f"{len(x)} {what}{'' if len(x) == 1 else 's'}"


def _given(default: dict, given: Mapping | None) -> dict:
    """The default with what was given in its place, of the same shapes."""

    def shaped(name):
        def shape(known, value):
            value = jnp.asarray(value, known.dtype)
            if value.shape != known.shape:
                raise ValueError(
                    f"the position or rate of '{name}' must have the shape {known.shape}, not {value.shape}."
                )
            return value

        return shape

    must_name(given or {}, default, "a position or rate is given of", "joint")
    for name, value in (given or {}).items():
        default[name] = jax.tree.map(shaped(name), default[name], value)
    return default


def _squared(joint: RobotJoint, q: Mapping, v: Mapping) -> Array:
    """The square of a joint's rate: of a spherical one, of its angular velocity."""
    if joint.kind == "spherical":
        # Quaternions of trees may have any length.
        e = q[joint.name]
        return jnp.sum((spin_in_body(e, v[joint.name]) / jnp.sum(e**2)) ** 2)
    return v[joint.name] ** 2


def _marker(body: Body | Ground, centre: np.ndarray, frame: Placement, axis: ArrayLike) -> Marker:
    """A place on a body by a frame in its link, and an axis of that frame; `centre` is the body's, there."""
    rows = np.array(ground.at(axis=axis).frame) @ frame.axes.T
    return Marker(body, tuple((frame.origin - centre).tolist()), tuple(map(tuple, rows.tolist())))


def _on_body(shape: LinkShape, merged: MergedLinks) -> LinkShape:
    head, frame = merged.frames[shape.link]
    frame = frame.then(Placement(shape.origin, shape.axes))
    centre = np.zeros(3) if head is None else merged.links[head].centre
    return shape._replace(body="ground" if head is None else head, origin=frame.origin - centre, axes=frame.axes)


def file_of(source: str | Path, user: str) -> Path | None:
    """The path of an existing file, None where the text itself was given; `user` is the function that asks."""
    if isinstance(source, str) and source.lstrip(BEFORE_TEXT).startswith("<"):
        try:
            source.encode()
        except UnicodeEncodeError as error:
            line = source.count("\n", 0, error.start) + 1
            raise ValueError(
                f"line {line} of the text has the character {source[error.start]!r}, which no file can have.\n"
                "Usual cause: a file that was decoded with errors='surrogateescape'.\n"
                f"Fix: {user}(path), and the file in UTF-8."
            ) from error
        return None
    must_be(str | Path, source, f"{user} takes the path of a file or its text", f'{user}("/path/to/the/file")')
    path = Path(source).expanduser()
    if not is_file(path):
        shown = str(source) if len(str(source)) <= LONGEST_SHOWN else str(source)[:LONGEST_SHOWN] + "..."
        raise FileNotFoundError(
            f"there is no file '{shown}', seen from {Path.cwd()}.\nUsual cause: another working directory, or a "
            f'package:// name, which ROS alone knows.\nFix: {user}("/path/to/the/file"), or the text itself.'
        )
    return path
