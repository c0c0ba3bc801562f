"""Random states around a given one that satisfy the constraints, at which claims about all states are tested.

Positions lie around the given one within several widths, up to one and a half times its size, so that a symmetry that
holds only on one side of a plane is detected. Times and velocities are drawn likewise; some velocities are zero, so
that fast motion does not hide a small force. The size of a coordinate is that of its array or point; it is 1 if that is
at zero, and at least 1 for an angle. Newton's method moves states onto the constraints by steps that are the shortest
in units of these sizes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, numpy_of, remembered
from lagjax.mechanics import are_angles, points
from lagjax.numerics import newton
from lagjax.system import Model, constraints, coordinates

WIDTHS = np.array([1.5, 1.0, 0.5, 0.1])
VELOCITY_WIDTHS = np.array([1.0, 0.3, 1.0, 0.0])
ITERATIONS = 30
# States off the constraints are tried again, closer by these factors, until more than this fraction is on them.
NEARER, ENOUGH = (0.3, 0.3, 0.3), 0.75
# Constraint rows are dependent if a singular value is below this fraction of the largest.
DEPENDENT_BELOW = 1e-6
# A constraint holds if its residual is below this many round-offs of its terms.
ROUND_OFFS = 1e4


class StateScales(NamedTuple):
    """The size of each coordinate and of each velocity, and the time that relates them."""

    x: Float[Array, " n"]
    u: Float[Array, " n"]
    t: Float[Array, ""]


class States(NamedTuple):
    """States in vector form, and which of them were moved onto the constraints (`found`)."""

    t: Float[Array, " N"]
    x: Float[Array, "N n"]
    u: Float[Array, "N n"]
    found: Bool[Array, " N"]


def draws(count: int, n: int) -> np.ndarray:
    """Relative displacements (count, 2 n + 1) of t, q and v, the same at each call; the first is zero."""
    random = np.random.default_rng(20).standard_normal((count, 2 * n + 1))
    which = np.arange(count) % len(WIDTHS)
    random[:, : n + 1] *= WIDTHS[which, None]
    # Velocity widths change more slowly, so that each width of positions is combined with each of velocities.
    random[:, n + 1 :] *= VELOCITY_WIDTHS[(np.arange(count) // len(WIDTHS)) % len(WIDTHS), None]
    random[0] = 0.0
    return random


def around(model: Model, s: coordinates.State, places) -> tuple[States, StateScales]:
    """The states at the displacements `places` from a given one, moved onto the constraints."""
    # With concrete values only the program that moves states is compiled, and all questions about a system share it.
    xp = numpy_of((s, model))
    x, u = (xp.asarray(coordinates.vector(tree)) for tree in (s.q, s.v))
    n, scales = len(x), sizes(model, s, x, u)
    places = places.astype(x.dtype)
    t = s.t + scales.t * places[:, 0]
    xs, us = x[None] + scales.x[None] * places[:, 1 : n + 1], u[None] + scales.u[None] * places[:, n + 1 :]
    # A velocity width of zero means a state at rest, not the velocity of the given state.
    resting = np.all(places[:, n + 1 :] == 0, axis=1) & (np.arange(len(places)) > 0)
    us = xp.where(resting[:, None], xp.zeros_like(us), us)
    if not model.m:
        return States(t, xs, us, np.ones(len(places), bool)), scales
    states = States(t, *(xp.asarray(y) for y in _onto_constraints(model, scales, t, xs, us)))
    # With concrete values, states that failed to reach the constraints are tried again closer to the given one.
    for nearer in NEARER if xp is np else ():
        if np.mean(states.found) > ENOUGH:
            break
        xs, us = x[None] + nearer * (xs - x[None]), u[None] + nearer * (us - u[None])
        again = [np.asarray(y) for y in _onto_constraints(model, scales, t, xs, us)]
        taken = (~states.found & again[2])[:, None]
        found = states.found | again[2]
        states = States(t, np.where(taken, again[0], states.x), np.where(taken, again[1], states.u), found)
    return states, scales


def sizes(model: Model, s: coordinates.State, x, u) -> StateScales:
    """The size of each coordinate and velocity of a state."""
    xp, same = numpy_of((x, u)), _groups(s.q)

    def together(y: Array):
        return xp.sqrt(same.astype(y.dtype) @ y**2)

    of_x = together(x)
    of_x = xp.where(of_x > 0, of_x, xp.ones_like(x))
    # Angles are at least 1: with small angles only, a pendulum would look like a harmonic oscillator.
    is_angle = remembered(model, are_angles, lambda: are_angles(model))
    of_x = xp.where(is_angle, xp.maximum(of_x, 1.0).astype(of_x.dtype), of_x)
    of_u = together(u)
    # A zero velocity has no size: it gets the pace of the others, or one length per unit of time.
    pace = xp.sqrt(xp.mean((of_u / of_x) ** 2))
    pace = xp.where(pace > 0, pace, xp.ones_like(pace))
    return StateScales(of_x, xp.where(of_u > 0, of_u, pace * of_x), 1 / pace)


def _groups(q: PyTree) -> np.ndarray:
    """Which coordinates share one size, (n, n): those of an array, and those of a point."""
    label = np.zeros(0, int)
    for i, leaf in enumerate(jax.tree.leaves(q)):
        label = np.concatenate([label, np.full(int(np.prod(np.shape(leaf))), i)])
    for point in points(q):
        places = [place for place in point.places if place is not None]
        label[places] = label[places[0]]
    return label[:, None] == label[None, :]


@compiled
def _onto_constraints(model: Model, scales, t, xs, us):
    return jax.vmap(lambda t, x, u: _on_constraints(model, scales, t, x, u))(t, xs, us)


def _on_constraints(model: Model, scales, t, x, u):
    def position(x: Array):
        return constraints.position_residual(model, t, x)

    def velocity(x: Array, u: Array):
        return constraints.velocity_residual(model, t, x, u)

    holds = jnp.asarray(True)
    if model.holonomic.any():
        x = _newton(position, x, scales.x)
        holds = _vanishes(position, x, scales.x)
    u = _newton(lambda u: velocity(x, u), u, scales.u)
    return x, u, holds & _vanishes(lambda u: velocity(x, u), u, scales.u)


def _newton(residual, y, scale):
    def step(y, r, i):
        rows = jax.jacfwd(residual)(y) * scale[None]
        return scale * (jnp.linalg.pinv(rows, rtol=DEPENDENT_BELOW) @ r)

    return newton(residual, step, y, ITERATIONS)


def _vanishes(residual, y, scale):
    terms = jnp.abs(jax.jacfwd(residual)(y)) @ jnp.maximum(scale, jnp.abs(y))
    return jnp.all(jnp.abs(residual(y)) <= ROUND_OFFS * jnp.finfo(y.dtype).eps * terms)
