"""The accelerations of a tree's links by the articulated-body recursion, in time that grows as their number.

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

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §7.3 and Table 7.1, there along the links' axes; §9.6 (rotors).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lagjax.bodies.tree.geometry import Geometry, LinkNumbers
from lagjax.bodies.tree.motion import LinkMotion, applied, cross, inward, outward, times
from lagjax.numerics import dense


class Accelerated(NamedTuple):
    """Accelerations of joints (n, k), zero for freedoms that are not there; of links, angular ones and those of centres
    (n, 6)."""

    joints: Float[Array, "n k"]
    links: Float[Array, "n 6"]


def accelerated(
    geometry: Geometry, given: LinkNumbers, motion: LinkMotion, torque: Float[Array, "n k"], wrench: Float[Array, "n 6"]
) -> Accelerated:
    """The accelerations under forces `torque` of joints, and moments and forces on centres of mass, `wrench`."""
    dtype = motion.turn.dtype
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
    mass = given.mass[:, None, None] * jnp.eye(3, dtype=dtype)[None]
    zero = jnp.zeros_like(inertia)
    own = jnp.concatenate([jnp.concatenate([inertia, zero], axis=2), jnp.concatenate([zero, mass], axis=2)], axis=1)
    # The last column is p.
    load = jnp.concatenate([gyroscopic, jnp.zeros_like(gyroscopic)], axis=1) - wrench
    own = jnp.concatenate([own, load[:, :, None]], axis=2)
    shift = motion.offset + arm
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
