"""A system of bodies: the sum of their kinetic energies, and the constraints of their joints."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import (
    Body,
    Driven,
    Pose,
    PoseOnTree,
    SystemFunction,
    check_bodies,
    floats,
    kinetic_energy,
    together,
    valued,
)
from lagjax.bodies.joints import named
from lagjax.bodies.loads import Acting, Load, check_loads
from lagjax.display import CUBE, Anchor, Drawing, Shape
from lagjax.jaxtools import numpy_of
from lagjax.refusals import must_be, must_differ, must_name
from lagjax.shapes import line
from lagjax.system import Holonomic, Nonholonomic, System

# What else a system may have: arguments of `lj.System` that are passed on.
OTHERS = ("force", "dissipation", "states", "elements")
# The least thickness of a body's box beside its length.
THIN = 0.04


def multibody(
    bodies: Iterable[Body],
    joints: Mapping[str, Holonomic | Nonholonomic | Mapping] | None = None,
    loads: Iterable[Load] = (),
    lagrangian: Callable | None = None,
    **others,
) -> System:
    """Return the system of some bodies, their joints and what acts on them.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> bob = lj.bodies.Body("bob", mass=1.0, inertia=(0.1, 0.1, 0.1))
    >>> pendulum = multibody(
    ...     [bob],
    ...     {"pivot": lj.bodies.spherical(lj.bodies.ground.at(), bob.at((0.0, 0.0, 1.0)))},
    ...     [lj.bodies.weight([bob])],
    ... )
    >>> pose = lj.bodies.Pose.at((0.0, 0.0, -1.0))
    >>> force = lj.constraint_force(pendulum, 0.0, {"bob": pose}, {"bob": pose.moving()}, None)
    >>> print(round(float(force["pivot"]["bob"].position[2]), 6))
    9.81

    **Arguments:**

    - `bodies`: `lj.bodies.Body`s of different names; q and v are dicts of `lj.bodies.Pose` by these names, without
      those whose motion is given. That their quaternions are unit ones is a constraint of the system, of the body's
      name.
    - `joints`: constraints by name, `lj.bodies.spherical(...)` and the like, or written by hand.
    - `loads`: `lj.bodies.weight`, `lj.bodies.spring`, `lj.bodies.motor`, `lj.bodies.applied`.
    - `lagrangian`: what L has besides, a function of (t, q, v, params); q may have further entries.
    - `others`: `force`, `dissipation`, `states` and `elements` of `lj.System`.

    Coordinates of a rough drawing become ones that joints allow by `lj.consistent_state`.

    **Raises:** `ValueError` for two bodies or constraints of one name; `TypeError` for a body, joint or load that is
    none, and for a keyword that is not among `others`.
    """
    bodies, loads = check_bodies("lj.bodies.multibody", bodies), check_loads("lj.bodies.multibody", loads)
    _check_joints(joints)
    fix = "bodies, joints, loads, lagrangian, or one of lj.System's, as {}="
    must_name(others, OTHERS, "lj.bodies.multibody was given", "argument of it", fix, error=TypeError)
    driven, bodies = Driven.among(bodies), tuple(body for body in bodies if body.motion is None)
    units = {f"{body.name} is turned": body.unit for body in bodies}
    joints = named(joints or {})
    names = [body.name for body in (*bodies, *driven.bodies)]
    must_differ(names, "two bodies")
    must_differ([*units, *joints], "two constraints")
    beside = Acting(*(driven.seen_by_all(others.pop(name, None)) for name in ("force", "dissipation")))
    acting = beside.with_loads(loads, driven.placed)

    looks_like = (*(joint.function for joint in joints.values()), *(load.potential for load in loads))
    potentials = tuple(load.potential for load in loads if load.potential is not None)
    joints = {name: driven.seen_by(joint) for name, joint in joints.items()}
    total = BodiesLagrangian(bodies, driven, potentials, lagrangian, looks_like)
    return System(total, units | joints, force=acting.force, dissipation=acting.dissipation, **others)


@dataclass(frozen=True, eq=False)
class BodiesLagrangian(SystemFunction):
    """The kinetic energy of bodies less the potentials of loads, and what L has `beside`.

    `looks_like`: functions whose `drawing` says what joints and loads look like.

    >>> import jax
    >>> import lagjax as lj
    >>> bob, pose = lj.bodies.Body("bob", 2.0, (1.0, 1.0, 1.0)), lj.bodies.Pose.at()
    >>> free = BodiesLagrangian((bob,), Driven(()), (), None, ())
    >>> print(jax.jit(free)(0.0, {"bob": pose}, {"bob": pose.moving((3.0, 0.0, 0.0))}, None))
    9.0
    """

    bodies: tuple[Body, ...]
    driven: Driven
    potentials: tuple[Callable, ...]
    beside: Callable | None
    looks_like: tuple[Callable | None, ...]
    drawn: Drawing | None = None

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        q, v = self.driven.placed(t, q, v, params)
        total = _kinetic(self.bodies, q, v, params) - sum(x(t, q, v, params) for x in self.potentials)
        return total + (0.0 if self.beside is None else self.beside(t, q, v, params))

    @property
    def drawing(self) -> Drawing:
        """How the system is drawn: as given, or bodies as boxes between their joints."""
        return self.drawn or (Drawing(self._shapes, self._poses) if self.driven.bodies else Drawing(self._shapes))

    def _shapes(self, params: PyTree) -> tuple[Shape, ...]:
        return usual_shapes(self.bodies, self.looks_like, params)

    def _poses(self, t: Any, q: PyTree, params: PyTree) -> PyTree:
        return self.driven.placed(t, q, {}, params)[0]


def _kinetic(bodies: tuple[Body, ...], q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
    """The kinetic energy of all bodies, in lanes: a program as long for many as for one."""
    dtype = floats(q)
    masses, inertias = zip(*(body.given(params, dtype) for body in bodies))
    of = numpy_of((masses, inertias))
    masses, inertias = of.asarray(masses, dtype), of.stack(inertias)
    poses, rates = [body.pose(q) for body in bodies], [body.rates(v) for body in bodies]
    for body, pose in zip((*bodies, *bodies), (*poses, *rates)):
        _check_pose(body, pose)
    poses, rates = together(poses), together(rates)
    return jnp.sum(jax.vmap(kinetic_energy)(masses, inertias, poses, rates))


def _check_pose(body: Body, given: Pose | PoseOnTree):
    if isinstance(given, PoseOnTree):
        raise TypeError(
            f"the entry '{body.name}' of q and v of lj.bodies.multibody must be a lj.bodies.Pose, and is that of a "
            "lj.bodies.Tree, with its rotation matrix.\n"
            "Fix: q = {name: lj.bodies.Pose(*pose[:2]) for name, pose in tree.poses(q).items()}, and v in the same way."
        )


def _check_joints(joints: Mapping | None):
    example = "{'hinge': lj.bodies.revolute(lj.bodies.ground.at(), door.at())}"
    must_be(Mapping, joints or {}, "the joints of lj.bodies.multibody must be a dict by name", example)
    for name, joint in (joints or {}).items():
        parts = joint.values() if isinstance(joint, Mapping) else (joint,)
        for part in parts:
            claim = f"joint '{name}' of lj.bodies.multibody must be a constraint"
            fix = "lj.bodies.revolute(a, b), lj.Holonomic(g) or lj.Nonholonomic(phi); loads are the third argument"
            cause = "a load among the joints, or a function without its kind"
            must_be(Holonomic | Nonholonomic, part, claim, fix, cause)


def usual_shapes(bodies: Iterable[Body], functions: Iterable[Callable | None], params: PyTree) -> tuple[Shape, ...]:
    """What is drawn of a system if nothing is given: what its functions look like, and bodies as boxes.

    A box of mass m has I_1 = m (b² + c²)/12 and so on, so that a² = 6 (I_2 + I_3 - I_1)/m. A wheel that rolls is a disk
    instead.
    """
    # Several wheels have one surface.
    found = list(dict.fromkeys(shape for function in functions for shape in getattr(function, "drawing", ())))
    solid = {shape.owner for shape in found if shape.kind == "solid"}
    return (*(_equal_box(body, params) for body in bodies if body.name not in solid), *found)


def _equal_box(body: Body, params: PyTree) -> Shape:
    inertia = np.asarray(valued(body.inertia, params), float)
    moments, axes = (inertia, np.eye(3)) if inertia.ndim == 1 else np.linalg.eigh(inertia)
    # Columns that are right-handed: a mirrored box would be seen from inside.
    axes = axes * np.sign(np.linalg.det(axes))
    edges = np.sqrt(np.maximum(6 * (np.sum(moments) - 2 * moments) / float(valued(body.mass, params)), 0.0))
    if not edges.max() > 0:
        return line(body)
    anchor = Anchor(body.name, (0.0, 0.0, 0.0), tuple(map(tuple, axes.T.tolist())))
    return Shape("solid", (anchor,), CUBE, tuple(np.maximum(edges, THIN * edges.max()).tolist()))
