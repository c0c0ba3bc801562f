"""Where the links of a tree are and how they move: outward from the ground, each from its parent.

    R = R_p E,      r = r_p + R_p o + R b',      ω = ω_p + R_p ω_j,      ṙ = ṙ_p + ω_p × R_p o + R_p v_j + ω × R b'

E turns a link's axes into its parent's, o leads from the parent's centre of mass to the joint, b' from the joint to the
link's centre; ω_j and v_j are what the joint adds. Everything but R and these sums is computed for all links at once.

Unit quaternions e of balls and free bodies are read as e / |e|, so that their length is a coordinate that nothing sees,
and no constraint holds it:

    Ω = 2 vec(ė e*) / |e|²,      ṡ = 2 e·ė / |e|²,      ė = ½ (Ω + ṡ) e,      ë = ½ (Ω̇ + s̈) e + ½ (Ω + ṡ) ė

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §4.4 and Table 5.1.
"""

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Pose
from lagjax.bodies.rotation import conjugate, product, rotation_matrix
from lagjax.bodies.tree.geometry import FixedNumbers, Geometry, LinkNumbers

# So few links are written out, one by one; more of them in a loop.
FEW = 3


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
