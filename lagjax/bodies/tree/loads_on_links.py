"""What acts on the bodies of a tree, as functions of joint coordinates, and as moments and forces on their centres.

A load reads `q[body.name]` as the body's pose; here it reads the pose that the joint coordinates give, and any other
name as the joint coordinate of that name. The derivatives of a potential by a body's pose are a force and, by

    N = Σ R_i × ∂V/∂R_i = ∂V/∂Ω,      since Ṙ_i = Ω × R_i for the columns of R,

a moment: so a potential costs its own derivative, not that of the way to the links. By a quaternion it is
½ vec(∂V/∂e e*), since ė = ½ Ω e.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import PoseOnTree, valued
from lagjax.bodies.loads import Load, Weight
from lagjax.bodies.rotation import conjugate, product, quaternion_of
from lagjax.bodies.tree.geometry import Geometry, LinkNumbers
from lagjax.bodies.tree.motion import LinkMotion, cross


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
