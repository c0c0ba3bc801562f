"""Where the links of a tree are, how they move and what acts on them; their accelerations by recursion.

*The motion*: outward from the ground, each link from its parent.

    R = R_p E,      r = r_p + R_p o + R b',      ω = ω_p + R_p ω_j,      ṙ = ṙ_p + ω_p × R_p o + R_p v_j + ω × R b'

E turns a link's axes into its parent's, o leads from the parent's centre of mass to the joint, b' from the joint to the
link's centre; ω_j and v_j are what the joint adds. Everything but R and these sums is computed for all links at once.

Unit quaternions e of balls and free bodies are read as e / |e|, so that their length is a coordinate that nothing sees,
and no constraint holds it:

    Ω = 2 vec(ė e*) / |e|²,      ṡ = 2 e·ė / |e|²,      ė = ½ (Ω + ṡ) e,      ë = ½ (Ω̇ + s̈) e + ½ (Ω + ṡ) ė

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §4.4 and Table 5.1.

**Loads** on the bodies of a tree: functions of joint coordinates, and moments and forces on the bodies' centres.

A load reads `q[body.name]` as the body's pose; here it reads the pose that the joint coordinates give, and any other
name as the joint coordinate of that name. The derivatives of a potential by a body's pose are a force and, by

    N = Σ R_i × ∂V/∂R_i = ∂V/∂Ω,      since Ṙ_i = Ω × R_i for the columns of R,

a moment: so a potential costs its own derivative, not that of the way to the links. By a quaternion it is
½ vec(∂V/∂e e*), since ė = ½ Ω e.

**The accelerations** by the articulated-body recursion, in time that grows as the number of links.

Seen from its parent, a link with all that hangs on it acts as one body, whose force is f = I a + p. Inward, from the
ends of the branches to the ground, the link's own inertia and that of its children are added up, and what its joint
lets go is taken out; outward the accelerations follow:

    D = Sᵀ I S,     u = τ - Sᵀ p,     I_a = I - I S D⁻¹ Sᵀ I,     p_a = p + I_a c + I S D⁻¹ u           (inward)
    I_p += Xᵀ I_a X,     p_p += Xᵀ p_a
    ẇ = D⁻¹ (u - Sᵀ I (X a_p + c)),     a = X a_p + c + S ẇ                                              (outward)

a = (ω̇, r̈) is that of the centre of mass, along the axes of space, so that X is a shift by d = r - r_p, and c what the
velocities alone accelerate:

    X a_p = (ω̇_p, r̈_p + ω̇_p × d),     c = (γ, ω_p × (ω_p × o) + 2 ω_p × v_j + γ × b' + ω × (ω × b')),     γ = ω_p × ω_j

S has a column for each freedom of the joint. A column of zeros stands for one that is not there, with D = 1. A rotor
that turns with a joint has an inertia on its diagonal of D, and no part in what the joint passes on. A free body has
a = -I⁻¹ p; one that moves as given has its acceleration for c.

**The forces** that a motion needs, by the recursion of Newton and Euler: the accelerations outward, the forces inward.

    a = X a_p + c + S ẇ,     f = I a + p + Σ Xᵀ f of the children,     τ = Sᵀ f + armature ẇ

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §7.3 and Table 7.1, there along the links' axes; §9.6 (rotors);
§5.3 and Table 5.1 (Newton and Euler).
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Pose, PoseOnTree, conjugate, product, quaternion_of, rotation_matrix, valued
from lagjax.bodies.links import FixedNumbers, Geometry, LinkNumbers
from lagjax.bodies.loads import Load, Weight
from lagjax.numerics import dense

# So few links are written out, one by one; more of them in a loop. The derivative of a motion of three compiles in 36 s
# of processor time in a loop, written out in 48, and the motion takes 37 ms in place of 48.
FEW = 1


class Coordinates(NamedTuple):
    """q, v, a force or an acceleration: the numbers, the quaternions of balls and free bodies, the latter's places."""

    numbers: Float[Array, " numbers"]
    quaternions: Float[Array, "quaternions 4"]
    positions: Float[Array, "quaternions 3"]


class Joints(NamedTuple):
    """The links as seen from their parents.

    `turn` E, `offset` o and `arm` b' as above; `axes` (n, 3, k) those of the freedoms along the parent's, `turning` and
    `sliding` (n, k) their rates. `spin` and `velocity` are those of free and driven bodies, None without any.
    """

    turn: Float[Array, "n 3 3"]
    offset: Float[Array, "n 3"]
    arm: Float[Array, "n 3"]
    axes: Float[Array, "n 3 k"]
    turning: Float[Array, "n k"]
    sliding: Float[Array, "n k"]
    spin: Float[Array, "n 3"] | None
    velocity: Float[Array, "n 3"] | None


class LinkMotion(NamedTuple):
    """The links in space, along its axes: R, r and their rates, o, R b', ω_j, v_j, and the axes of the freedoms."""

    turn: Float[Array, "n 3 3"]
    centre: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    offset: Float[Array, "n 3"]
    arm: Float[Array, "n 3"]
    joint_spin: Float[Array, "n 3"]
    joint_slide: Float[Array, "n 3"]
    axes: Float[Array, "n 3 k"]


def times(a: Array, b: Array) -> Array:
    """a @ b, written out: a product or sum of this many numbers would be a call of a library."""
    return reduce(add, (a[..., :, i, None] * b[..., None, i, :] for i in range(a.shape[-1])))


def applied(a: Array, x: Array) -> Array:
    """a @ x for a vector x, written out."""
    return reduce(add, (a[..., :, i] * x[..., None, i] for i in range(a.shape[-1])))


def cross(a: Array, b: Array) -> Array:
    """a × b, in fewer operations than `jnp.cross`."""
    return _onward(a * _onward(b) - _onward(a) * b)


def _onward(x: Array) -> Array:
    """(y, z, x)."""
    first, others = lax.split(x, (1, 2), axis=x.ndim - 1)
    return lax.concatenate([others, first], x.ndim - 1)


def outward(geometry: Geometry, fixed: FixedNumbers, link_of: Callable, ground: Array, given: PyTree) -> PyTree:
    """Link after link, each after its parent: `link_of(parent, given)` -> (link, what else there is of it), stacked.

    `parent` is what was returned for that, or `ground`; where links are few, None for the ground.
    """
    if geometry.n <= FEW:
        links, beside = [], []
        for i, link in enumerate(geometry.links):
            parent = None if link.parent < 0 else links[link.parent]
            found, rest = link_of(parent, jax.tree.map(lambda x: x[i], given))
            links.append(found)
            beside.append(rest)
        return jax.tree.map(lambda *x: jnp.stack(x), *zip(links, beside))

    def turn(slots: Array, x: tuple) -> tuple[Array, tuple]:
        given, read, write, root = x
        found = link_of(root * ground + taken(slots, read), given)
        return left(slots, write, found[0]), found

    start = jnp.zeros((fixed.read.shape[1], *ground.shape), ground.dtype)
    return lax.scan(turn, start, (given, fixed.read, fixed.write, fixed.root))[1]


def inward(geometry: Geometry, fixed: FixedNumbers, link_of: Callable, nothing: Array, given: PyTree) -> PyTree:
    """Link after link, each before its parent: `link_of(children, given, at_ground)` -> (what it passes, the rest).

    `children` is the sum of what those pass. Returned is the rest, stacked. Where links are few, nothing passes to the
    ground, and None comes from no children.
    """
    if geometry.n <= FEW:
        passed, rest = {}, []
        for i, link in reversed(list(enumerate(geometry.links))):
            of_link = jax.tree.map(lambda x: x[i], given)
            onto, found = link_of(passed.pop(i, None), of_link, link.parent < 0)
            rest.insert(0, found)
            if link.parent >= 0:
                passed[link.parent] = passed[link.parent] + onto if link.parent in passed else onto
        return jax.tree.map(lambda *x: jnp.stack(x), *rest)

    def turn(slots: Array, x: tuple) -> tuple[Array, PyTree]:
        given, read, write = x
        passed, found = link_of(taken(slots, write), given, False)
        emptied, filled = (y.reshape(-1, *[1] * nothing.ndim) for y in (write, read))
        return (1 - emptied) * slots + filled * passed[None], found

    start = jnp.zeros((fixed.read.shape[1], *nothing.shape), nothing.dtype)
    return lax.scan(turn, start, (given, fixed.read, fixed.write), reverse=True)[1]


def flat(geometry: Geometry, q: PyTree) -> Coordinates:
    """The entries of q, or of what is like q, in one array for each sort."""
    numbers, quaternions, positions = [], [], []
    for entry in geometry.entries:
        x = q[entry.name]
        if entry.kinds == ("free",):
            quaternions.append(x.quaternion[None])
            positions.append(x.position[None])
        elif entry.kinds == ("ball",):
            quaternions.append(jnp.reshape(x, (-1, 4)))
            positions.append(jnp.zeros((quaternions[-1].shape[0], 3), quaternions[-1].dtype))
        else:
            numbers.append(jnp.ravel(x))
    every = [*numbers, *quaternions]
    dtype = jnp.result_type(*every) if every else float

    def joined(row: list, end: tuple[int, ...]) -> Any:
        return jnp.concatenate(row).astype(dtype) if row else np.zeros((0, *end), dtype)

    return Coordinates(joined(numbers, ()), joined(quaternions, (4,)), joined(positions, (3,)))


def unflat(geometry: Geometry, x: Coordinates) -> dict[str, PyTree]:
    """The entries, from the arrays."""
    found, number, quaternion = {}, 0, 0
    for entry in geometry.entries:
        size = int(np.prod(entry.shape))
        if entry.kinds == ("free",):
            found[entry.name] = Pose(x.positions[quaternion], x.quaternions[quaternion])
            quaternion += 1
        elif entry.kinds == ("ball",):
            found[entry.name] = x.quaternions[quaternion : quaternion + size // 4].reshape(entry.shape)
            quaternion += size // 4
        else:
            found[entry.name] = x.numbers[number : number + size].reshape(entry.shape)
            number += size
    return found


def taken(slots: Array, read: Float[Array, " slots"]) -> Array:
    """What was left in the slot that is read; zeros if none is."""
    return reduce(add, (read[i] * slots[i] for i in range(len(slots))))


def left(slots: Array, write: Float[Array, " slots"], link: Array) -> Array:
    """The slots with a link's numbers in the one that is written."""
    here = write.reshape(-1, *[1] * link.ndim)
    return (1 - here) * slots + here * link[None]


def of_links(x: Array, places: np.ndarray) -> Array:
    """The entries of x at some places; nothing moves where they are in order."""
    return x if len(places) == len(x) and np.all(places == np.arange(len(x))) else x[places]


def numbers_of_links(geometry: Geometry, x: Float[Array, " numbers"]) -> Float[Array, "n k"]:
    """The number of each link's hinge or slide, in the first of k columns; zero where there is none."""
    filled = x if len(x) == geometry.n else jnp.concatenate([x, jnp.zeros(1, x.dtype)])
    first = of_links(filled, geometry.numbers)[:, None]
    return jnp.concatenate([first, jnp.zeros((geometry.n, geometry.k - 1), x.dtype)], axis=1)


def growth(e: Float[Array, "m 4"], rate: Float[Array, "m 4"]) -> Float[Array, " m"]:
    """ṡ, the rate at which quaternions grow."""
    return 2 * _dot(e, rate) / _dot(e, e)


def spins(e: Float[Array, "m 4"], rate: Float[Array, "m 4"]) -> Float[Array, "m 3"]:
    """Ω of quaternions."""
    return 2 * jax.vmap(product)(rate, jax.vmap(conjugate)(e))[:, 1:] / _dot(e, e)[:, None]


def _dot(a: Array, b: Array) -> Array:
    return applied(a[..., None, :], b)[..., 0]


def joint_rates(geometry: Geometry, q: Coordinates, v: Coordinates) -> Float[Array, "n k"]:
    """The rate of each freedom: of a hinge or slide that of its number, of a ball its angular velocity."""
    rates = numbers_of_links(geometry, v.numbers)
    if geometry.k == 1:
        return rates
    return jnp.where(geometry.ball[:, None], of_links(spins(q.quaternions, v.quaternions), geometry.quaternions), rates)


def seen_from_parents(geometry: Geometry, given: LinkNumbers, q: Coordinates, v: Coordinates | None) -> Joints:
    """The links as seen from their parents; at rest without v."""
    dtype = q.numbers.dtype
    s = numbers_of_links(geometry, q.numbers)[:, 0]
    rates = None if v is None else joint_rates(geometry, q, v)
    turns, slides, axes, (still, by_cosine, by_sine), *_ = given.fixed
    angle = s[:, None, None]
    turn = still + by_cosine * jnp.cos(angle) + by_sine * jnp.sin(angle)
    offset, free = given.a, geometry.free[:, None]
    if geometry.slides.any():
        offset = offset + applied(axes, slides * s[:, None])
    spin = velocity = None
    if len(q.quaternions):
        unit = q.quaternions / jnp.sqrt(_dot(q.quaternions, q.quaternions))[:, None]
        before, after = (jnp.asarray(x, dtype)[geometry.links_of_quaternions] for x in geometry.frames)
        turned = times(before, times(jax.vmap(rotation_matrix)(unit), after))
        has = (geometry.ball | geometry.free)[:, None, None]
        turn = jnp.where(has, of_links(turned, geometry.quaternions), turn)
        offset = jnp.where(free, of_links(q.positions, geometry.quaternions), offset)
        if v is not None:
            spin = of_links(spins(q.quaternions, v.quaternions), geometry.quaternions)
            spin, velocity = (jnp.where(free, x, 0.0) for x in (spin, of_links(v.positions, geometry.quaternions)))
    if given.driven is not None:
        turn = jnp.where(geometry.driven[:, None, None], given.driven.turn, turn)
        offset = offset + given.driven.centre
        if v is not None:
            spin, velocity = (
                x if y is None else x + y for x, y in zip((given.driven.spin, given.driven.velocity), (spin, velocity))
            )
    still = jnp.zeros_like(turns)
    turning, sliding = (still, still) if rates is None else (turns * rates, slides * rates)
    return Joints(turn, offset, -given.b, axes, turning, sliding, spin, velocity)


def in_space(geometry: Geometry, fixed: FixedNumbers, joints: Joints) -> LinkMotion:
    """The links in space, one after the other."""
    ground = jnp.zeros((3, 6), joints.turn.dtype).at[:, :3].set(jnp.eye(3, dtype=joints.turn.dtype))
    columns = jnp.concatenate([joints.turn, joints.offset[:, :, None], joints.axes], axis=2)
    free = None if joints.spin is None else jnp.stack([joints.spin, joints.velocity], axis=2)

    def link_of(parent: Array | None, x: tuple) -> tuple[Array, Array]:
        columns, arm, turning, sliding, free = x
        moved = columns if parent is None else times(parent[:, :3], columns)
        offset, axes = moved[:, 3], moved[:, 4:]
        arm = applied(moved[:, :3], arm)
        spin, slide = applied(axes, turning), applied(axes, sliding)
        if free is not None:
            spin, slide = spin + free[:, 0], slide + free[:, 1]
        centre, velocity = offset + arm, slide
        if parent is not None:
            centre, velocity = centre + parent[:, 3], velocity + parent[:, 5] + cross(parent[:, 4], offset)
            spin = spin + parent[:, 4]
        velocity = velocity + cross(spin, arm)
        link = jnp.concatenate([moved[:, :3], jnp.stack([centre, spin, velocity], axis=1)], axis=1)
        return link, jnp.concatenate([arm[:, None], moved[:, 3:]], axis=1)

    of_links = columns, joints.arm, joints.turning, joints.sliding, free
    link, beside = outward(geometry, fixed, link_of, ground, of_links)
    axes = beside[:, :, 2:]
    spin, slide = applied(axes, joints.turning), applied(axes, joints.sliding)
    if free is not None:
        spin, slide = spin + free[:, :, 0], slide + free[:, :, 1]
    return LinkMotion(
        link[:, :, :3], link[:, :, 3], link[:, :, 4], link[:, :, 5], beside[:, :, 1], beside[:, :, 0], spin, slide, axes
    )


@partial(jax.jit, static_argnums=0)
def moving(geometry: Geometry, given: LinkNumbers, q: Coordinates, v: Coordinates) -> LinkMotion:
    """Where the links are and how they move. Jitted, so that it is traced once."""
    return in_space(geometry, given.fixed, seen_from_parents(geometry, given, q, v))


@partial(jax.jit, static_argnums=0)
def placing(
    geometry: Geometry, given: LinkNumbers, q: Coordinates
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Where the links are, r and R."""
    joints = seen_from_parents(geometry, given, q, None)
    ground = jnp.zeros((3, 4), joints.turn.dtype).at[:, :3].set(jnp.eye(3, dtype=joints.turn.dtype))

    def link_of(parent: Array | None, x: tuple) -> tuple[Array, None]:
        columns, arm = x
        moved = columns if parent is None else times(parent[:, :3], columns)
        centre = moved[:, 3] + applied(moved[:, :3], arm)
        centre = centre if parent is None else centre + parent[:, 3]
        return jnp.concatenate([moved[:, :3], centre[:, None]], axis=1), None

    columns = jnp.concatenate([joints.turn, joints.offset[:, :, None]], axis=2)
    found, _ = outward(geometry, given.fixed, link_of, ground, (columns, joints.arm))
    return found[:, :, 3], found[:, :, :3]


class Placed(eqx.Module):
    """What loads and closures read as q or v: bodies by name as poses, all else as it is in the tree's own q or v."""

    geometry: Geometry = eqx.field(static=True)
    poses: PoseOnTree
    others: PyTree

    def __getitem__(self, name: str) -> Any:
        place = self.geometry.body_at.get(name)
        return self.others[name] if place is None else jax.tree.map(lambda x: x[place], self.poses)


def poses_of(centre: Float[Array, "n 3"], turn: Float[Array, "n 3 3"]) -> PoseOnTree:
    """The poses of all links, stacked."""
    return PoseOnTree(centre, _quaternions(turn), turn)


# Jitted, as it is traced wherever poses are read, and rarely used.
_quaternions = jax.jit(jax.vmap(quaternion_of))


def potential(geometry: Geometry, given: LinkNumbers, loads: Iterable[Load], motion: LinkMotion, state: tuple) -> Array:
    """V of all loads."""
    weights, others = _sorted(loads)
    total = -jnp.sum(_weights(geometry, given, weights, state[-1]) * motion.centre)
    return total + _of_poses(geometry, others, poses_of(motion.centre, motion.turn), state) if others else total


def wrenches(
    geometry: Geometry, given: LinkNumbers, loads: Iterable[Load], motion: LinkMotion, state: tuple
) -> Float[Array, "n 6"]:
    """Moments and forces of the loads' potentials on the centres of links."""
    weights, others = _sorted(loads)
    force = _weights(geometry, given, weights, state[-1])
    moment = jnp.zeros_like(force)
    if others:
        place = motion.centre, motion.turn
        pull, slope = jax.grad(lambda place: _of_poses(geometry, others, poses_of(*place), state))(place)
        # Their columns as rows.
        columns, slopes = (jnp.swapaxes(x, 1, 2) for x in (motion.turn, slope))
        force, moment = force - pull, moment - jnp.sum(cross(columns, slopes), axis=1)
    return jnp.concatenate([moment, force], axis=1)


def _sorted(loads: Iterable[Load]) -> tuple[list[Weight], list[Callable]]:
    """Weights, whose forces are known without a derivative, and the other potentials."""
    given = [load.potential for load in loads if load.potential is not None]
    return [x for x in given if isinstance(x, Weight)], [x for x in given if not isinstance(x, Weight)]


def _of_poses(geometry: Geometry, potentials: Sequence[Callable], poses: PoseOnTree, state: tuple) -> Array:
    t, q, v, params = state
    return jnp.asarray(sum(x(t, Placed(geometry, poses, q), v, params) for x in potentials))


def moments(e: Float[Array, "m 4"], slope: Float[Array, "m 4"]) -> Float[Array, "m 3"]:
    """½ vec(slope e*): the derivative by Ω of what has this derivative by ė."""
    return jax.vmap(product)(slope, jax.vmap(conjugate)(e))[:, 1:] / 2


def _weights(geometry: Geometry, given: LinkNumbers, weights: Sequence[Weight], params: PyTree) -> Float[Array, "n 3"]:
    total = jnp.zeros((geometry.n, 3), given.mass.dtype)
    for weight in weights:
        field, bodies = jnp.asarray(valued(weight.g, params), total.dtype), set(weight.bodies)
        pulled = np.array([link.body in bodies for link in geometry.links], total.dtype)
        total = total + (pulled * given.mass)[:, None] * field[None]
    return total


class Accelerated(NamedTuple):
    """Accelerations of joints (n, k), zero for freedoms that are not there; of links, angular ones and those of centres
    (n, 6)."""

    joints: Float[Array, "n k"]
    links: Float[Array, "n 6"]


class Inertial(NamedTuple):
    """What the links have of their own: S, the inertia beside D of freedoms, c, I along the axes of space, ω × I ω, and
    the way d from the parent's centre."""

    freedoms: Float[Array, "n 6 k"]
    beside: Float[Array, "n k"]
    bias: Float[Array, "n 6"]
    inertia: Float[Array, "n 3 3"]
    gyroscopic: Float[Array, "n 3"]
    shift: Float[Array, "n 3"]


def inertial(geometry: Geometry, given: LinkNumbers, motion: LinkMotion) -> Inertial:
    """What does not depend on forces and accelerations."""
    turns, slides = (x[:, None, :] for x in (given.fixed.turns, given.fixed.slides))
    spin, arm, joint_spin = motion.spin, motion.arm, motion.joint_spin
    before = spin - joint_spin
    twist = turns * motion.axes
    levered = jnp.swapaxes(cross(jnp.swapaxes(twist, 1, 2), arm[:, None, :]), 1, 2)
    freedoms = jnp.concatenate([twist, levered + slides * motion.axes], axis=1)
    beside = (1 - turns - slides)[:, 0, :] + given.armature
    gamma = cross(before, joint_spin)
    centripetal = cross(gamma, arm) + cross(spin, cross(spin, arm)) + cross(before, cross(before, motion.offset))
    if geometry.slides.any() or geometry.free.any():
        centripetal = centripetal + 2 * cross(before, motion.joint_slide)
    bias = jnp.concatenate([gamma, centripetal], axis=1)
    if given.driven is not None:
        bias = jnp.where(geometry.driven[:, None], given.driven.acceleration, bias)
    inertia = times(times(motion.turn, given.inertia), jnp.swapaxes(motion.turn, 1, 2))
    gyroscopic = cross(spin, applied(inertia, spin))
    return Inertial(freedoms, beside, bias, inertia, gyroscopic, motion.offset + arm)


def accelerated(
    geometry: Geometry, given: LinkNumbers, motion: LinkMotion, torque: Float[Array, "n k"], wrench: Float[Array, "n 6"]
) -> Accelerated:
    """The accelerations under forces `torque` of joints, and moments and forces on centres of mass, `wrench`."""
    dtype = motion.turn.dtype
    freedoms, beside, bias, inertia, gyroscopic, shift = inertial(geometry, given, motion)
    mass = given.mass[:, None, None] * jnp.eye(3, dtype=dtype)[None]
    zero = jnp.zeros_like(inertia)
    own = jnp.concatenate([jnp.concatenate([inertia, zero], axis=2), jnp.concatenate([zero, mass], axis=2)], axis=1)
    # The last column is p.
    load = jnp.concatenate([gyroscopic, jnp.zeros_like(gyroscopic)], axis=1) - wrench
    own = jnp.concatenate([own, load[:, :, None]], axis=2)
    has_free = bool(geometry.free.any())

    def inward_link(children: Array | None, x: tuple, at_ground: bool) -> tuple[Array | None, tuple]:
        own, freedoms, bias, shift, torque, beside = x
        both = own if children is None else own + children
        articulated, load = both[:, :6], both[:, 6]
        pushed = times(articulated, freedoms)
        solve = _inverse(times(freedoms.T, pushed) + jnp.diag(beside))
        force = torque - applied(freedoms.T, load)
        rows = times(solve, pushed.T)
        found = rows, applied(solve, force), both if has_free else ()
        if at_ground:
            return None, found
        passed = articulated - times(pushed, rows)
        along = load + applied(passed, bias) + applied(rows.T, force)
        return _shifted(jnp.concatenate([passed, along[:, None]], axis=1), shift), found

    given_inward = own, freedoms, bias, shift, torque, beside
    rows, force, every = inward(geometry, given.fixed, inward_link, jnp.zeros((6, 7), dtype), given_inward)

    free = jnp.zeros((geometry.n, 6), dtype)
    if has_free:
        places = [i for i in range(geometry.n) if geometry.free[i]]
        for i in places:
            solved = dense.solve(every[i, :, :6], -every[i, :, 6])
            free = free + (jnp.arange(geometry.n) == i)[:, None] * solved[None]

    def outward_link(parent: Array | None, x: tuple) -> tuple[Array, Array]:
        rows, force, freedoms, bias, shift, free = x
        carried = bias + free
        if parent is not None:
            leaning = jnp.concatenate([jnp.zeros(3, dtype), cross(parent[:3], shift)])
            carried = carried + parent + leaning
        joint = force - applied(rows, carried)
        return carried + applied(freedoms, joint), joint

    given_outward = rows, force, freedoms, bias, shift, free
    links, joints = outward(geometry, given.fixed, outward_link, jnp.zeros(6, dtype), given_outward)
    return Accelerated(joints, links)


class Forced(NamedTuple):
    """Forces of joints (n, k), and the moments and forces (n, 6) that links need from their parents."""

    joints: Float[Array, "n k"]
    links: Float[Array, "n 6"]


def forced(
    geometry: Geometry, given: LinkNumbers, motion: LinkMotion, joints: Float[Array, "n k"], free: Float[Array, "n 6"],
    wrench: Float[Array, "n 6"],
) -> Forced:  # fmt: skip
    """The forces of joints under which these accelerate so; `free`: the accelerations of free bodies."""
    dtype = motion.turn.dtype
    freedoms, _, bias, inertia, gyroscopic, shift = inertial(geometry, given, motion)
    carried = bias + free + applied(freedoms, joints)

    def outward_link(parent: Array | None, x: tuple) -> tuple[Array, None]:
        carried, shift = x
        if parent is None:
            return carried, None
        return carried + parent + jnp.concatenate([jnp.zeros(3, dtype), cross(parent[:3], shift)]), None

    links, _ = outward(geometry, given.fixed, outward_link, jnp.zeros(6, dtype), (carried, shift))
    moment, force = applied(inertia, links[:, :3]) + gyroscopic, given.mass[:, None] * links[:, 3:]
    own = jnp.concatenate([moment, force], axis=1) - wrench

    def inward_link(children: Array | None, x: tuple, at_ground: bool) -> tuple[Array, Array]:
        own, shift = x
        both = own if children is None else own + children
        return both + jnp.concatenate([cross(shift, both[3:]), jnp.zeros(3, dtype)]), both

    needed = inward(geometry, given.fixed, inward_link, jnp.zeros(6, dtype), (own, shift))
    return Forced(applied(jnp.swapaxes(freedoms, 1, 2), needed) + given.armature * joints, needed)


def _shifted(body: Float[Array, "6 7"], d: Float[Array, "3"]) -> Float[Array, "6 7"]:
    """Xᵀ I X and Xᵀ p, side by side."""
    x, y, z = d
    zero = jnp.zeros_like(x)
    crossed = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    # Forces at r are, at r_p, the same forces and moments about it; columns of Xᵀ I belong to accelerations at r.
    body = jnp.concatenate([body[:3] + times(crossed, body[3:]), body[3:]], axis=0)
    return jnp.concatenate([body[:, :3] - times(body[:, 3:6], crossed), body[:, 3:]], axis=1)


def _inverse(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    if matrix.shape[0] == 1:
        return 1 / matrix
    rows = jnp.stack(
        [jnp.cross(matrix[1], matrix[2]), jnp.cross(matrix[2], matrix[0]), jnp.cross(matrix[0], matrix[1])]
    )
    return rows.T / applied(matrix[:1], rows[0])[0]
