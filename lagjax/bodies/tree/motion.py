"""Where the links of a tree are and how they move: outward from the ground, each from its parent.

    R = R_p E,      r = r_p + R_p o + R b',      ω = ω_p + R_p ω_j,      ṙ = ṙ_p + ω_p × R_p o + R_p v_j + ω × R b'

E turns a link's axes into its parent's, o leads from the parent's centre of mass to the joint, b' from the joint to the
link's centre; ω_j and v_j are what the joint adds. Everything but R and these sums is computed for all links at once.

Unit quaternions e of balls and free bodies are read as e / |e|, so that their length is a coordinate that nothing sees,
and no constraint holds it:

    Ω = 2 vec(ė e*) / |e|²,      ṡ = 2 e·ė / |e|²,      ė = ½ (Ω + ṡ) e,      ë = ½ (Ω̇ + s̈) e + ½ (Ω + ṡ) ė

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §4.4 and Table 5.1.
"""

from functools import partial, reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Pose
from lagjax.bodies.rotation import conjugate, product, rotation_matrix
from lagjax.bodies.tree.geometry import Geometry, LinkNumbers


class Coordinates(NamedTuple):
    """q, v, a force or an acceleration: the numbers, the quaternions of balls and free bodies, the latter's places."""

    numbers: Float[Array, " numbers"]
    quaternions: Float[Array, "quaternions 4"]
    positions: Float[Array, "quaternions 3"]


class Joints(NamedTuple):
    """The links as seen from their parents.

    `turn` E, `offset` o and `arm` b' as above, `axes` (n, 3, k) those of the freedoms; `spin` and `slide` are ω_j and
    v_j, all but `arm` along the parent's axes.
    """

    turn: Float[Array, "n 3 3"]
    offset: Float[Array, "n 3"]
    arm: Float[Array, "n 3"]
    axes: Float[Array, "n 3 k"]
    spin: Float[Array, "n 3"]
    slide: Float[Array, "n 3"]


class LinkMotion(NamedTuple):
    """The links in space, along its axes: R, r and their rates, what `Joints` has, and the parent's spin, `before`."""

    turn: Float[Array, "n 3 3"]
    centre: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    offset: Float[Array, "n 3"]
    arm: Float[Array, "n 3"]
    joint_spin: Float[Array, "n 3"]
    joint_slide: Float[Array, "n 3"]
    before: Float[Array, "n 3"]
    axes: Float[Array, "n 3 k"]


def times(a: Array, b: Array) -> Array:
    """a @ b, written out: a product or sum of this many numbers would be a call of a library."""
    return reduce(add, (a[..., :, i, None] * b[..., None, i, :] for i in range(a.shape[-1])))


def applied(a: Array, x: Array) -> Array:
    """a @ x for a vector x, written out."""
    return reduce(add, (a[..., :, i] * x[..., None, i] for i in range(a.shape[-1])))


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
    joined = [jnp.concatenate([jnp.zeros((0, *end), dtype), *row]) for end, row in
              (((), numbers), ((4,), quaternions), ((3,), positions))]  # fmt: skip
    return Coordinates(*joined)


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


def seen_from_parents(geometry: Geometry, given: LinkNumbers, q: Coordinates, v: Coordinates) -> Joints:
    """The links as seen from their parents."""
    dtype = q.numbers.dtype
    s, rates = numbers_of_links(geometry, q.numbers)[:, 0], joint_rates(geometry, q, v)
    turns, slides = (jnp.asarray(x, dtype) for x in (geometry.turns, geometry.slides))
    half = s * turns[:, 0] / 2
    nothing = jnp.zeros_like(half)
    e = jnp.stack([jnp.cos(half), nothing, nothing, jnp.sin(half)], axis=1)
    axes = jnp.swapaxes(jnp.asarray(geometry.frame_a, dtype), 1, 2)
    used = axes if geometry.k == 3 else axes[:, :, 2:]
    if geometry.k == 3:
        # The axis of a hinge or slide comes first.
        used = jnp.where(geometry.ball[:, None, None], axes, axes[:, :, ::-1])
    used = used * (turns + slides)[:, None, :]
    offset, free = given.a, geometry.free[:, None]
    base_spin = base_velocity = jnp.zeros((geometry.n, 3), dtype)
    if len(q.quaternions):
        unit = q.quaternions / jnp.sqrt(_dot(q.quaternions, q.quaternions))[:, None]
        spin = of_links(spins(q.quaternions, v.quaternions), geometry.quaternions)
        e = jnp.where((geometry.ball | geometry.free)[:, None], of_links(unit, geometry.quaternions), e)
        base_spin = jnp.where(free, spin, 0.0)
        base_velocity = jnp.where(free, of_links(v.positions, geometry.quaternions), 0.0)
        offset = jnp.where(free, of_links(q.positions, geometry.quaternions), offset)
    slid = applied(used, slides * s[:, None])
    joint = times(axes, times(jax.vmap(rotation_matrix)(e), jnp.asarray(geometry.frame_b, dtype)))
    return Joints(
        joint, offset + slid, -given.b, used,
        applied(used, turns * rates) + base_spin, applied(used, slides * rates) + base_velocity,
    )  # fmt: skip


def in_space(geometry: Geometry, joints: Joints) -> LinkMotion:
    """The links in space, one after the other."""
    dtype = joints.turn.dtype
    read, write = (jnp.asarray(x, dtype) for x in geometry.slots)
    ground = jnp.zeros((3, 6), dtype).at[:, :3].set(jnp.eye(3, dtype=dtype))
    columns = [joints.turn, joints.offset[:, :, None], joints.spin[:, :, None], joints.slide[:, :, None], joints.axes]

    def outward(slots: Array, x: tuple) -> tuple[Array, tuple[Array, Array]]:
        columns, arm, read, write, root = x
        before = root * ground + taken(slots, read)
        moved = times(before[:, :3], columns)
        offset, spin, slide = moved[:, 3], moved[:, 4], moved[:, 5]
        arm = applied(moved[:, :3], arm)
        turned = before[:, 4] + spin
        centre = before[:, 3] + offset + arm
        velocity = before[:, 5] + jnp.cross(before[:, 4], offset) + slide + jnp.cross(turned, arm)
        link = jnp.concatenate([moved[:, :3], jnp.stack([centre, turned, velocity], axis=1)], axis=1)
        return left(slots, write, link), (
            link,
            jnp.concatenate([jnp.stack([arm, before[:, 4]], axis=1), moved[:, 3:]], axis=1),
        )

    start = jnp.zeros((read.shape[1], 3, 6), dtype)
    root = jnp.asarray(geometry.root, dtype)
    given = jnp.concatenate(columns, axis=2), joints.arm, read, write, root
    _, (link, rest) = lax.scan(outward, start, given)
    return LinkMotion(
        link[:, :, :3], link[:, :, 3], link[:, :, 4], link[:, :, 5], rest[:, :, 2], rest[:, :, 0], rest[:, :, 3],
        rest[:, :, 4], rest[:, :, 1], rest[:, :, 5:],
    )  # fmt: skip


@partial(jax.jit, static_argnums=0)
def moving(geometry: Geometry, given: LinkNumbers, q: Coordinates, v: Coordinates) -> LinkMotion:
    """Where the links are and how they move. Jitted, so that it is traced once."""
    return in_space(geometry, seen_from_parents(geometry, given, q, v))
