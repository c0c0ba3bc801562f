"""A tree of bodies in joint coordinates: its Lagrangian, and its accelerations without a mass matrix."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from lagjax.bodies.assemble import usual_shapes
from lagjax.bodies.body import (
    Body,
    OfPlaced,
    Pose,
    PoseOnTree,
    SystemFunction,
    check_bodies,
    conjugate,
    floats,
    product,
)
from lagjax.bodies.joints import named
from lagjax.bodies.links import Geometry, LinkNumbers, check_armature, links_of
from lagjax.bodies.loads import Acting, Load, check_loads
from lagjax.bodies.motion import (
    Coordinates,
    LinkMotion,
    Placed,
    accelerated,
    applied,
    flat,
    forced,
    growth,
    joint_rates,
    moments,
    moving,
    numbers_of_links,
    of_links,
    placing,
    poses_of,
    potential,
    spins,
    unflat,
    wrenches,
)
from lagjax.display import Drawing, Shape
from lagjax.jaxtools import to_jax
from lagjax.refusals import must_be, must_differ
from lagjax.system import Holonomic, Nonholonomic, System


class Tree:
    """Bodies and the joints from which they hang, each on one: chains, arms, walking machines, in joint coordinates.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> rod = lj.bodies.Body("rod", mass=1.0, inertia=(1 / 12, 1 / 12, 0.0))
    >>> y = (0.0, 1.0, 0.0)
    >>> hinge = lj.bodies.revolute(lj.bodies.ground.at(axis=y), rod.at((0.0, 0.0, 0.5), axis=y))
    >>> pendulum = Tree([rod], {"hinge": hinge})
    >>> print(jax.jit(pendulum.poses)({"hinge": jnp.pi / 2})["rod"].position.round(6) + 0.0)
    [-0.5  0.   0. ]
    >>> system = pendulum.system([lj.bodies.weight([rod])])
    >>> a, _ = lj.accelerations(system, 0.0, {"hinge": jnp.pi / 2}, {"hinge": 0.0}, None)
    >>> print(a["hinge"].round(6))
    -14.715

    **Arguments:**

    - `bodies`: `lj.bodies.Body`s of different names.
    - `joints`: by name, `lj.bodies.revolute`, `lj.bodies.prismatic`, `lj.bodies.cylindrical`, `lj.bodies.universal`,
      `lj.bodies.planar`, `lj.bodies.spherical` or `lj.bodies.fixed`, from a place on the parent (or `lj.bodies.ground`)
      to one on the body that hangs there; or a list of joints of one kind.
    - `armature`: by the name of a joint, the inertia of rotors that turn with it, behind gears by the square of their
      ratio: it adds ½ armature v² to the kinetic energy, `[L] [t]²/[q]²`. A number, or an array with one for each
      number of q (for each quaternion), or a function of params.

    Coordinates, zero where the two frames (`lj.bodies.Marker`) are alike:

    | joint | `q[name]` |
    |---|---|
    | revolute, prismatic | an angle, a length |
    | cylindrical | (2,): the length, the angle |
    | planar | (3,): lengths along the first two vectors of the parent's frame, the angle |
    | universal | (2,): angles about both axes; at zero the frames' first vectors lie along each other's axes |
    | spherical | a quaternion (4,), then (1, 0, 0, 0), of any length: read as e / abs(e), and no constraint holds it |
    | fixed | none |

    An array of these for a list. A body on which no joint ends is free, and `q[body.name]` its `lj.bodies.Pose`.

    Bodies without mass and inertia are frames, for joints that follow on each other at one place. A body with a
    `motion` moves as given and has no coordinates; what hangs on it is carried along. No joint ends on it.

    >>> turning = lj.bodies.Body("turning", motion=lambda t, params: lj.bodies.Pose.at(angle=3.0 * t))
    >>> slide = lj.bodies.prismatic(turning.at(axis=(1.0, 0.0, 0.0)), rod.at(axis=(1.0, 0.0, 0.0)))
    >>> away = Tree([turning, rod], {"slide": slide})
    >>> print(jax.jit(away.rates)({"slide": 0.5}, {"slide": 2.0}, None, 0.0)["rod"].position)
    [2.  1.5 0. ]

    **Raises:** `TypeError` for what is no body or joint of these kinds; `ValueError` for a body on two joints, a ring,
    two things of one name, armature of no joint, a joint that ends on a body whose motion is given, and for a body
    without mass that moves and carries none.

    `tree.bodies` and `tree.joints` are what it was made of.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 4 (trees), ch. 7 (the recursion), §9.6 (rotors).
    """

    def __init__(
        self,
        bodies: Iterable[Body],
        joints: Mapping[str, Holonomic | Sequence[Holonomic]] | None = None,
        armature: Mapping[str, ArrayLike | Callable] | None = None,
    ):
        bodies = check_bodies("lj.bodies.Tree", bodies)
        must_differ([body.name for body in bodies], "two bodies")
        example = "{'hinge': lj.bodies.revolute(lj.bodies.ground.at(), door.at())}, or {'links': [...]} for a list"
        must_be(Mapping, joints or {}, "the joints of lj.bodies.Tree must be a dict by name", example)
        self.bodies = bodies
        links, entries = links_of(bodies, joints or {})
        self._geometry = Geometry(links, entries, check_armature(entries, armature or {}))
        self.joints = dict(joints or {})

    def __repr__(self):
        entries = ", ".join(entry.name for entry in self._geometry.entries)
        return f"Tree({len(self.bodies)} bodies; {entries})"

    def reference(self) -> dict[str, PyTree[Array]]:
        """q where all joints are at zero, and free bodies at the origin, unturned."""
        geometry = self._geometry
        count = len(geometry.links_of_quaternions)
        numbers, e = np.zeros(len(geometry.links_of_numbers)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        return jax.tree.map(to_jax, unflat(geometry, Coordinates(numbers, e, np.zeros((count, 3)))))

    def poses(self, q: PyTree, params: PyTree = None, t: Any = None) -> dict[str, PoseOnTree]:
        """The poses of all bodies by name, `position`, `quaternion` and the rotation's `matrix`; `params` where places
        of joints are functions of them, `t` where a body moves as given."""
        if t is None and self._geometry.driven.any():
            raise TypeError(
                "a body of this tree moves as given, and where it is depends on the time.\n"
                "Fix: tree.poses(q, params, t), tree.rates(q, v, params, t)."
            )
        q = jax.tree.map(jnp.asarray, q)
        placed = _placed(self._geometry, t, q, params)
        return {body.name: placed[body.name] for body in self.bodies}

    def rates(self, q: PyTree, v: PyTree, params: PyTree = None, t: Any = None) -> dict[str, PoseOnTree]:
        """The rates of their poses by name, for `body.velocity(q, v)` and the like."""
        # As the derivative of the poses, which shows that it is linear in v; 0.0 makes whole numbers floats.
        q, v = (jax.tree.map(lambda x: jnp.asarray(x) + 0.0, x) for x in (q, v))
        if t is None:
            return jax.jvp(lambda q: self.poses(q, params), (q,), (v,))[1]
        t = jnp.asarray(t) + 0.0
        return jax.jvp(lambda t, q: self.poses(q, params, t), (t, q), (jnp.ones_like(t), v))[1]

    def system(
        self,
        loads: Iterable[Load] = (),
        closures: Mapping[str, Holonomic | Nonholonomic | Mapping] | None = None,
        potential: Callable | None = None,
        **others,
    ) -> System:
        """Return the system of these bodies in joint coordinates, whose accelerations come by the recursion.

        >>> import lagjax as lj
        >>> cart, rail = lj.bodies.Body("cart", 2.0, (1.0, 1.0, 1.0)), lj.bodies.ground.at(axis=(1.0, 0.0, 0.0))
        >>> tree = Tree([cart], {"slide": lj.bodies.prismatic(rail, cart.at(axis=(1.0, 0.0, 0.0)))})
        >>> system = tree.system(potential=lambda t, q, params: 4.0 * q["slide"] ** 2)
        >>> print(lj.accelerations(system, 0.0, {"slide": 1.0}, {"slide": 0.0}, None)[0]["slide"])
        -4.0

        **Arguments:**

        - `loads`: `lj.bodies.weight`, `lj.bodies.spring`, `lj.bodies.motor`, `lj.bodies.applied`, as for
          `lj.bodies.multibody`.
        - `closures`: joints, or constraints written by hand, that close loops; they read `q[body.name]` as a pose.
        - `potential`: what V has besides, a function V(t, q, params) of the joint coordinates.
        - `others`: `force`, `dissipation`, `states` and `elements` of `lj.System`, in joint coordinates.

        **Raises:** `TypeError` for a load that is none, or an argument that `lj.System` has not.
        """
        loads = check_loads("tree.system", loads)
        dynamics = Dynamics(self._geometry, loads, potential)
        beside = Acting(others.pop("force", None), others.pop("dissipation", None))
        acting = beside.with_loads(loads, dynamics.placed)

        rows = [[x] if isinstance(x, Holonomic) else x for x in self.joints.values()]
        joined = [*(joint for row in rows for joint in row), *named(closures or {}).values()]
        looks_like = (*(joint.function for joint in joined), *(load.potential for load in loads))
        return System(
            TreeLagrangian(self, dynamics, looks_like),
            {name: _closure(dynamics, c) for name, c in named(closures or {}).items()},
            force=acting.force,
            dissipation=acting.dissipation,
            forward_dynamics=dynamics.articulated_body_recursion,
            **others,
        )


@dataclass(frozen=True, eq=False)
class TreeLagrangian(SystemFunction):
    """L of a tree in joint coordinates; `looks_like`: what says by its `drawing` how joints and loads look."""

    tree: Tree
    dynamics: "Dynamics"
    looks_like: tuple[Callable | None, ...]
    drawn: Drawing | None = None

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        return self.dynamics.lagrangian(t, q, v, params)

    @property
    def drawing(self) -> Drawing:
        """How the system is drawn: as given, or bodies as boxes between their joints."""
        return self.drawn or Drawing(self._shapes, self._poses)

    def _shapes(self, params: PyTree) -> tuple[Shape, ...]:
        bodies = [body for body in self.tree.bodies if body.motion is None]
        return usual_shapes(bodies, self.looks_like, params)

    def _poses(self, t: Any, q: PyTree, params: PyTree) -> dict[str, Pose]:
        return {name: Pose(pose.position, pose.quaternion) for name, pose in self.tree.poses(q, params, t).items()}


class Dynamics(NamedTuple):
    """The functions of a system of links: L, the accelerations that follow from it, and what else acts."""

    geometry: Geometry
    loads: tuple[Load, ...]
    potential: Callable | None

    def lagrangian(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Array:
        """T - V. The growth of quaternions has an inertia, for a regular mass matrix, and no part in the rest."""
        geometry = self.geometry
        given, motion = _moving(geometry, t, q, v, params)
        kinetic = _kinetic(geometry, given, motion, flat(geometry, q), flat(geometry, v))
        total = kinetic
        if self.loads:
            total = total - potential(geometry, given, self.loads, motion, (t, q, v, params))
        return total if self.potential is None else total - self.potential(t, q, params)

    def articulated_body_recursion(self, t: Array, q: PyTree, v: PyTree, force: PyTree, params: PyTree) -> PyTree:
        """The accelerations of this L under a generalized force, by the recursion."""
        geometry = self.geometry
        if self.potential is not None:
            slope = jax.grad(self.potential, argnums=1)(t, q, params)
            force = jax.tree.map(lambda x, y: x - y, force, slope)
        given, motion, wrench = self._loaded(t, q, v, params)
        a = _accelerations(geometry, given, motion, wrench, *(flat(geometry, x) for x in (q, v, force)))
        return {name: jax.tree.map(jnp.zeros_like, y) for name, y in q.items()} | unflat(geometry, a)

    def newton_euler_recursion(self, t: Array, q: PyTree, v: PyTree, a: PyTree, params: PyTree) -> PyTree:
        """The generalized force under which this L has these accelerations, by the recursion."""
        geometry = self.geometry
        given, motion, wrench = self._loaded(t, q, v, params)
        force = _forces(geometry, given, motion, wrench, *(flat(geometry, x) for x in (q, v, a)))
        force = {name: jax.tree.map(jnp.zeros_like, y) for name, y in q.items()} | unflat(geometry, force)
        if self.potential is None:
            return force
        return jax.tree.map(lambda x, y: x + y, force, jax.grad(self.potential, argnums=1)(t, q, params))

    def _loaded(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> tuple[LinkNumbers, LinkMotion, Array]:
        """The links, and the moments and forces of the loads' potentials on them."""
        given, motion = _moving(self.geometry, t, q, v, params)
        if all(load.potential is None for load in self.loads):
            return given, motion, jnp.zeros_like(motion.turn[:, :2].reshape(-1, 6))
        return given, motion, wrenches(self.geometry, given, self.loads, motion, (t, q, v, params))

    def placed(self, t, q: PyTree, v: PyTree, params: PyTree) -> tuple[Placed, Any]:
        """q and v as loads and closures read them; with no rates at all, q alone."""
        if not v:
            return _placed(self.geometry, t, q, params), v
        if not self.geometry.driven.any():
            return jax.jvp(lambda q: _placed(self.geometry, t, q, params), (q,), (v,))
        t = jnp.asarray(t, floats(q))
        return jax.jvp(lambda t, q: _placed(self.geometry, t, q, params), (t, q), (jnp.ones_like(t), v))


def _placed(geometry: Geometry, t: Any, q: PyTree, params: PyTree) -> Placed:
    """Where bodies are."""
    x = flat(geometry, q)
    return Placed(geometry, poses_of(*placing(geometry, geometry.at(t, params, x.numbers.dtype), x)), q)


def _moving(geometry: Geometry, t: Any, q: PyTree, v: PyTree, params: PyTree) -> tuple[LinkNumbers, LinkMotion]:
    x, u = flat(geometry, q), flat(geometry, v)
    given = geometry.at(t, params, x.numbers.dtype)
    return given, moving(geometry, given, x, u)


# Jitted, as all that calls no function of the user's, so that it is traced once.
@partial(jax.jit, static_argnums=0)
def _kinetic(geometry: Geometry, given: LinkNumbers, motion: LinkMotion, q: Coordinates, v: Coordinates) -> Array:
    in_body = applied(jnp.swapaxes(motion.turn, 1, 2), motion.spin)
    twice = jnp.sum(in_body * applied(given.inertia, in_body)) + jnp.sum(given.mass[:, None] * motion.velocity**2)
    if geometry.armature:
        twice = twice + jnp.sum(given.armature * joint_rates(geometry, q, v) ** 2)
    if len(geometry.links_of_quaternions):
        twice = twice + jnp.sum(_of_growth(geometry, given) * growth(q.quaternions, v.quaternions) ** 2)
    return twice / 2


@partial(jax.jit, static_argnums=0)
def _accelerations(
    geometry: Geometry,
    given: LinkNumbers,
    motion: LinkMotion,
    wrench: Array,
    q: Coordinates,
    v: Coordinates,
    force: Coordinates,
) -> Coordinates:
    """The accelerations of coordinates under moments and forces on links, and a generalized force."""
    torque = numbers_of_links(geometry, force.numbers)
    if len(geometry.links_of_quaternions):
        moment = of_links(moments(q.quaternions, force.quaternions), geometry.quaternions)
        if geometry.k == 3:
            torque = jnp.where(geometry.ball[:, None], moment, torque)
        on_free = jnp.concatenate([moment, of_links(force.positions, geometry.quaternions)], axis=1)
        wrench = wrench + jnp.where(geometry.free[:, None], on_free, 0.0)
    found = accelerated(geometry, given, motion, torque, wrench)
    numbers = of_links(found.joints[:, 0], geometry.links_of_numbers)
    if not len(geometry.links_of_quaternions):
        return Coordinates(numbers, q.quaternions, q.positions)
    links = geometry.links_of_quaternions
    turning = found.links[links, :3]
    if geometry.k == 3:
        turning = jnp.where(geometry.free[links, None], turning, found.joints[links])
    e, rate = q.quaternions, v.quaternions
    grows = jnp.sum(e * force.quaternions, axis=1) / 2 / _of_growth(geometry, given)
    both = jnp.concatenate([growth(e, rate)[:, None], spins(e, rate)], axis=1)
    faster = jnp.concatenate([grows[:, None], turning], axis=1)
    bent = (jax.vmap(product)(faster, e) + jax.vmap(product)(both, rate)) / 2
    return Coordinates(numbers, bent, found.links[links, 3:])


@partial(jax.jit, static_argnums=0)
def _forces(
    geometry: Geometry,
    given: LinkNumbers,
    motion: LinkMotion,
    wrench: Array,
    q: Coordinates,
    v: Coordinates,
    a: Coordinates,
) -> Coordinates:
    """The generalized force that these accelerations of coordinates need, with moments and forces on links."""
    joints, free = numbers_of_links(geometry, a.numbers), jnp.zeros_like(wrench)
    e, rate, links = q.quaternions, v.quaternions, geometry.links_of_quaternions
    faster, size = jnp.zeros_like(e), jnp.sum(e**2, axis=1)[:, None]
    if len(links):
        both = jnp.concatenate([growth(e, rate)[:, None], spins(e, rate)], axis=1)
        # s̈ + Ω̇, of ë = ½ (Ω̇ + s̈) e + ½ (Ω + ṡ) ė.
        faster = jax.vmap(product)(2 * a.quaternions - jax.vmap(product)(both, rate), jax.vmap(conjugate)(e)) / size
        turning = of_links(faster[:, 1:], geometry.quaternions)
        if geometry.k == 3:
            joints = jnp.where(geometry.ball[:, None], turning, joints)
        both = jnp.concatenate([turning, of_links(a.positions, geometry.quaternions)], axis=1)
        free = jnp.where(geometry.free[:, None], both, 0.0)
    found = forced(geometry, given, motion, joints, free, wrench)
    numbers = of_links(found.joints[:, 0], geometry.links_of_numbers)
    if not len(links):
        return Coordinates(numbers, q.quaternions, q.positions)
    moment = found.links[links, :3]
    if geometry.k == 3:
        moment = jnp.where(geometry.free[links, None], moment, found.joints[links])
    grows = (_of_growth(geometry, given) * faster[:, 0])[:, None]
    slope = 2 * jax.vmap(product)(jnp.concatenate([grows, moment], axis=1), e) / size
    return Coordinates(numbers, slope, found.links[links, 3:])


def _of_growth(geometry: Geometry, given: LinkNumbers) -> Array:
    """The inertia of the growth of each quaternion; any will do for one of a frame."""
    own = jnp.trace(given.inertia, axis1=1, axis2=2)[geometry.links_of_quaternions] / 3
    return jnp.where(own > 0, own, 1.0)


def _closure(dynamics: Dynamics, constraint: Holonomic | Nonholonomic) -> Holonomic | Nonholonomic:
    """A constraint of poses as one of joint coordinates."""
    seen = OfPlaced(constraint.function, dynamics.placed)
    return Holonomic(seen.of_positions) if isinstance(constraint, Holonomic) else Nonholonomic(seen)
