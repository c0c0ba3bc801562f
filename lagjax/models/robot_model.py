"""A mechanism from a file: bodies and joints, its system in either kind of coordinates, and the way between them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from lagjax.bodies import (
    Body,
    Load,
    Marker,
    Pose,
    Tree,
    cylindrical,
    fixed,
    generalized_force,
    ground,
    line,
    multibody,
    named,
    prismatic,
    revolute,
    spherical,
    spin_in_body,
    universal,
    weight,
)
from lagjax.display import Drawing, Shape
from lagjax.models.joint_positions import (
    BodyJoint,
    Chains,
    all_positions,
    connected,
    drawn,
    in_a_plane,
    poses,
    rate_squared,
)
from lagjax.models.looks import looks_of
from lagjax.models.parts import LinkShape, Loop, MergedLinks, NotTaken, Placement, RobotJoint, RobotLink
from lagjax.system import Holonomic, Nonholonomic, System

EQUATIONS = {"revolute": revolute, "prismatic": prismatic, "spherical": spherical, "planar": in_a_plane,
             "universal": universal, "cylindrical": cylindrical, "fixed": fixed}  # fmt: skip

# How many of a kind `print` lists.
LISTED = 6


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

    - `name`: as in the file; `bodies`: `lj.Body`s by the names of their links, with the links' axes; `shapes`: the
      shapes on them; `gravity`: (3,).
    - `links`, `joints`: what moves, as plain numbers, parents first; `frames`: by each link of the file, the link that
      it is part of (None: the ground) and where its frame is in that; `loops`: what is held together besides.
    - `not_taken`: what the file says and the model leaves out, each with its line; `print(model)` lists it.

    Positions of joints, by name, count from the file's drawing, `[length]` or radians: a number for revolute and
    prismatic joints, (3,) for planar ones (two lengths, an angle), a unit quaternion for spherical ones; for floating
    ones, which go by the name of their body, its `lj.Pose` in space.
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
        if field.shape != (3,):
            raise ValueError(f"gravity must be three numbers, and is {gravity}.\nFix: gravity=(0.0, 0.0, -9.81).")
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
        return cls(name, *merged, placed, tuple(loops), tuple(field.tolist()), tuple(not_taken))

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
        """A place on a link of the file, in its frame there, for loads and further joints: a `lj.Marker`."""
        if link not in self.frames:
            raise ValueError(f"there is no link '{link}'.\nFix: one of {', '.join(self.frames)}.")
        head, frame = self.frames[link]
        return self._marker(head, Placement(frame.point(point), frame.axes), axis)

    def markers(self, joint: str) -> tuple[Marker, Marker]:
        """The two places that a joint joins: `lj.motor(*model.markers("elbow"), torque)`."""
        for x in self._between.values():
            if [y.name for y in x.joints] == [joint]:
                return x.a, x.b
        if joint in self.joints:
            raise ValueError(f"the joint '{joint}' has a massless link at one end, and no place on a body there.")
        raise ValueError(f"there is no joint '{joint}'.\nFix: one of {', '.join(self.joints)}.")

    def system(self, loads: Iterable[Load] = (), joints: Mapping | None = None, **others) -> System:
        """Return the system of its bodies: q and v are dicts of `lj.Pose` by body, joints are constraints.

        Weight, dampers, springs and rotors of joints are in it, and loops; `loads`, `joints` and `others` are further
        ones of `lj.multibody`. A spring's angle counts from -π to π.

        **Raises:** `ValueError` for a massless link that no joint of `lj` stands for, by its line.
        """
        own = {" ".join(joint.name for joint in x.joints): EQUATIONS[x.kind](x.a, x.b)
               for x in self._between.values() if x.kind != "floating"}  # fmt: skip
        own |= self._loops()
        if both := own.keys() & (joints or {}).keys():
            raise ValueError(f"the file has a joint '{sorted(both)[0]}' already.\nFix: another name.")
        bodies, rotors = list(self.bodies.values()), [joint for joint in self.joints.values() if joint.armature]
        lagrangian = others.pop("lagrangian", None)

        def besides(t, q, v, params):
            energies = [x.armature * rate_squared(self._of(x), x.name, q, v) / 2 for x in rotors]
            return sum(energies) + (0.0 if lagrangian is None else lagrangian(t, q, v, params))

        every = [weight(bodies, self.gravity), *self._loads(), *loads]
        system = multibody(bodies, own | dict(joints or {}), every, besides if rotors else lagrangian, **others)
        setattr(system.lagrangian, "drawing", Drawing(self._looks))
        return system

    def joint_system(self, loads: Iterable[Load] = (), closures: Mapping | None = None, **others) -> System:
        """Return the system in joint coordinates: q and v are positions and rates of joints by name.

        Where all joints turn, slide, are spherical or floating, it is that of a `lj.Tree`, solved at O(n). With rotors,
        planar joints or moving links without mass, L is composed of the poses, its mass matrix is a dense one, and its
        quaternions have constraints. Springs of joints count whole turns.

        `loads` are those of `lj.multibody`, `closures` constraints by name; both read `q[body]` as a pose, and the
        position of a joint under any other name. Loops of the file are in it. `others` are `force`, `dissipation`,
        `states` and `elements` of `lj.System`, in joint coordinates.
        """
        for name in self.links:
            if not self._mass_from(name):
                raise self._massless([joint for joint in self.joints.values() if joint.child == name])
        loads, closing = tuple(loads), self._loops() | dict(closures or {})
        rotors = [joint for joint in self.joints.values() if joint.armature]
        springs = [joint for joint in self.joints.values() if joint.stiffness]
        dampers = [joint for joint in self.joints.values() if joint.damping]
        force, dissipation = others.pop("force", None), others.pop("dissipation", None)

        def of_springs(t, q, params):
            return sum(x.stiffness * (q[x.name] - x.rest) ** 2 / 2 for x in springs)

        def of_dampers(t, q, v, params):
            own = sum(x.damping * _squared(x, q, v) / 2 for x in dampers)
            return own if dissipation is None else own + dissipation(t, q, v, params)

        dissipation_in_joints = of_dampers if dampers else dissipation
        if not rotors and self._is_a_tree:
            system = self.tree().system(
                [weight(self.bodies.values(), self.gravity), *loads],
                closing,
                of_springs if springs else None,
                force=force,
                dissipation=dissipation_in_joints,
                **others,
            )
            setattr(system.lagrangian, "drawing", Drawing(self._looks, self._drawn_poses))
            return system
        losses = [load.dissipation for load in loads if load.dissipation is not None]
        potentials = [load.potential for load in loads if load.potential is not None]

        def lagrangian(t, q, v, params):
            poses, rates = jax.jvp(self._stacked, (q,), (v,))
            of_rotors = sum(x.armature * _squared(x, q, v) / 2 for x in rotors)
            by_name = q | self._named(poses), v | self._named(rates)
            of_loads = sum(potential(t, *by_name, params) for potential in potentials)
            return self._energies(poses, rates) + of_rotors - of_springs(t, q, params) - of_loads

        def friction(t, q, v, params):
            of_loads = sum(loss(t, *self._with_poses(q, v), params) for loss in losses)
            return of_loads if dissipation_in_joints is None else of_loads + dissipation_in_joints(t, q, v, params)

        def driven(t, q, v, params):
            of_loads = generalized_force(loads, t, *self._moving(q, v), params)
            given = jax.vjp(self._poses, q)[1](of_loads)[0]
            return given if force is None else jax.tree.map(jnp.add, given, force(t, q, v, params))

        setattr(lagrangian, "drawing", Drawing(self._looks, self._drawn_poses))
        turning = [x for x in self.joints.values() if x.kind in ("spherical", "floating")]
        return System(
            lagrangian,
            {f"{x.name} is turned": _unit(x) for x in turning}
            | {name: self._through_joints(x) for name, x in named(closing).items()},
            force=driven if any(load.power is not None for load in loads) else force,
            dissipation=friction if losses else dissipation_in_joints,
            **others,
        )

    def tree(self) -> Tree:
        """Return the `lj.Tree` of its bodies: its poses, and systems at O(n); without what acts, and without loops.

        **Raises:** `TypeError` for planar joints; `ValueError` for a link without mass that moves, by its line.
        """
        equations = {x.joints[0].name: EQUATIONS[x.kind](x.a, x.b)
                     for x in self._between.values() if x.kind != "floating"}  # fmt: skip
        return Tree(list(self.bodies.values()), equations)

    @property
    def _is_a_tree(self) -> bool:
        """Whether `lj.Tree` has coordinates for it."""
        kinds = {joint.kind for joint in self.joints.values()}
        return len(self.bodies) == len(self.links) and "planar" not in kinds

    def _drawn_poses(self, q: PyTree, params: PyTree) -> dict[str, Pose]:
        return self._poses(q)

    def _looks(self, params: PyTree) -> tuple[Shape, ...]:
        """How it is drawn: bodies, and at each joint a dot with arms to the bodies' centres."""
        found = list(looks_of(self.shapes, self.bodies.values()))
        for joint in self.joints.values():
            for head, frame in ((joint.parent, joint.placement), self.frames[joint.child]):
                if head is None or head in self.bodies:
                    marker = self._marker(head, frame, joint.axis)
                    found += [line(marker)] if head is None else [line(marker), line(marker.body, marker)]
        return tuple(found)

    def _energies(self, poses: Pose, rates: Pose) -> Array:
        """Kinetic energy minus that in the field of weight, of all bodies at once."""
        dtype = poses.position.dtype
        mass = jnp.array([body.mass for body in self.bodies.values()], dtype)
        inertia = jnp.array([body.inertia for body in self.bodies.values()], dtype)
        one = Body("one", lambda params: params[0], lambda params: params[1])

        def kinetic(pose: Pose, rate: Pose, mass: Array, inertia: Array) -> Array:
            return one.kinetic({"one": pose}, {"one": rate}, (mass, inertia))

        moving = jax.vmap(kinetic)(poses, rates, mass, inertia)
        return jnp.sum(moving) + mass @ poses.position @ jnp.array(self.gravity, dtype)

    def _through_joints(self, constraint: Holonomic | Nonholonomic) -> Holonomic | Nonholonomic:
        """A constraint of poses as one of joint coordinates."""
        if isinstance(constraint, Holonomic):
            return Holonomic(lambda t, q, params: constraint.g(t, q | self._poses(q), params))
        return Nonholonomic(lambda t, q, v, params: constraint.phi(t, *self._with_poses(q, v), params))

    def _loops(self) -> dict[str, Holonomic]:
        ends = [[self._marker(head, frame, (0.0, 0.0, 1.0)) for head, frame in loop.places] for loop in self.loops]
        return {loop.name: EQUATIONS[loop.kind](*places) for loop, places in zip(self.loops, ends)}

    def _loads(self) -> list[Load]:
        """Springs and dampers of joints, by the poses of bodies."""

        def spring(joint: RobotJoint) -> Callable:
            of = self._of(joint)
            return lambda t, q, v, p: joint.stiffness * (all_positions([of], q)[joint.name] - joint.rest) ** 2 / 2

        def damper(joint: RobotJoint) -> Callable:
            return lambda t, q, v, p: joint.damping * rate_squared(self._of(joint), joint.name, q, v) / 2

        springs = [Load(potential=spring(x)) for x in self.joints.values() if x.stiffness]
        return springs + [Load(dissipation=damper(x)) for x in self.joints.values() if x.damping]

    def _of(self, joint: RobotJoint) -> BodyJoint:
        return next(x for x in self._between.values() if joint in x.joints)

    def _stacked(self, s: Mapping) -> Pose:
        """The poses of all bodies as arrays."""
        found = poses(tuple(self.joints.values()), self._chains, s)
        place = {joint.child: i for i, joint in enumerate(self.joints.values())}
        places = np.array([place[name] for name in self.bodies])
        return jax.tree.map(lambda x: x[places], found)

    def _named(self, stacked: Pose) -> dict[str, Pose]:
        return {name: Pose(stacked.position[i], stacked.quaternion[i]) for i, name in enumerate(self.bodies)}

    def _poses(self, s: Mapping) -> dict[str, Pose]:
        return self._named(self._stacked(s))

    @cached_property
    def _chains(self) -> Chains:
        return Chains.of(tuple(self.joints.values()), {name: link.centre for name, link in self.links.items()})

    def _moving(self, s: Mapping, w: Mapping) -> tuple[dict[str, Pose], dict[str, Pose]]:
        return jax.jvp(self._poses, (s,), (w,))

    def _with_poses(self, s: Mapping, w: Mapping) -> tuple[dict, dict]:
        """Positions of joints and poses of bodies by name, and their rates."""
        poses, rates = self._moving(s, w)
        return dict(s) | poses, dict(w) | rates

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
        rows = np.array(ground.at(axis=axis).frame) @ frame.axes.T
        return Marker(body, tuple((frame.origin - centre).tolist()), tuple(map(tuple, rows.tolist())))

    @cached_property
    def _between(self) -> dict[str, BodyJoint]:
        """By body, what joins it to the body before it."""
        above = {joint.child: joint for joint in self.joints.values()}
        holds = [joint.parent for joint in self.joints.values()]
        found, passed = {}, set()
        for name in self.bodies:
            joints = [above[name]]
            while (parent := joints[0].parent) is not None and parent not in self.bodies:
                joints.insert(0, above[parent])
                passed.add(parent)
            ends = (ground if parent is None else self.bodies[parent], self.bodies[name])
            centres = (np.zeros(3) if parent is None else self.links[parent].centre, self.links[name].centre)
            # A massless link that holds several joints moves them together.
            forks = any(holds.count(joint.parent) > 1 for joint in joints[1:])
            joined = None if forks else connected(tuple(joints), ends, centres)
            if joined is None:
                raise self._massless(joints)
            found[name] = joined
        for name in self.links.keys() - self.bodies.keys() - passed:
            raise self._massless([above[name]])
        return found

    def _mass_from(self, name: str) -> float:
        """The mass of a link and of what hangs on it."""
        children = [joint.child for joint in self.joints.values() if joint.parent == name]
        return self.links[name].mass + sum(self._mass_from(child) for child in children)

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
        for what in dict.fromkeys(x.what for x in self.not_taken):
            whose = [x for x in self.not_taken if x.what == what]
            listed = ", ".join(
                (f"'{x.name}' " * bool(x.name) + f"({x.line})" * bool(x.line)).strip() for x in whose[:LISTED]
            )
            more = f" and {len(whose) - LISTED} more" if len(whose) > LISTED else ""
            lines.append(f"  not taken: {what} {'of ' * any(x.name for x in whose)}{listed}{more}".rstrip())
        return "\n".join(lines)


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

    for name, value in (given or {}).items():
        if name not in default:
            raise ValueError(f"there is no joint '{name}'.\nFix: one of {', '.join(default)}.")
        default[name] = jax.tree.map(shaped(name), default[name], value)
    return default


def _squared(joint: RobotJoint, q: Mapping, v: Mapping) -> Array:
    """The square of a joint's rate: of a spherical one, of its angular velocity."""
    if joint.kind == "spherical":
        return jnp.sum(spin_in_body(q[joint.name], v[joint.name]) ** 2)
    return v[joint.name] ** 2


def _unit(joint: RobotJoint) -> Holonomic:
    def unit_quaternion(t, q, params):
        e = q[joint.name] if joint.kind == "spherical" else q[joint.name].quaternion
        return (jnp.sum(e**2) - 1) / 2

    return Holonomic(unit_quaternion)


def _on_body(shape: LinkShape, merged: MergedLinks) -> LinkShape:
    head, frame = merged.frames[shape.link]
    frame = frame.then(Placement(shape.origin, shape.axes))
    centre = np.zeros(3) if head is None else merged.links[head].centre
    return shape._replace(body="ground" if head is None else head, origin=frame.origin - centre, axes=frame.axes)
