"""Whether a state is an equilibrium or in steady motion, and whether its linear equations hold at all times.

In a steady motion x = x₀ + u₀ t without acceleration, and the matrices of small motions do not depend on t. Both are
checked numerically: the accelerations at the state, and the matrices there and some way along the motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax.analysis.modes.reduced_matrices import LinearisationKind, LinearParts
from lagjax.mechanics.diagnosis import explain_failure, where
from lagjax.numerics.linalg import lapack
from lagjax.system import coordinates
from lagjax.system.coordinates import State

# A state given with seven digits is accepted; frequencies are then accurate to about as many.
STEADY_BELOW = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# The distances along the motion at which the matrices are compared, in units of the fastest coordinate, or of time.
ALONG = (0.3719, 1.9173)
SAME_BELOW = {np.dtype("float64"): 1e-7, np.dtype("float32"): 1e-3}


class Steadiness(NamedTuple):
    """How far a state is from steady, by coordinate (n,) and then by constraint residual; and the largest of these."""

    relative: Float[Array, " k"]
    residual: Float[Array, ""]


def steadiness_of(kind: LinearisationKind, s: State, parts: LinearParts) -> Steadiness:
    """Accelerations and constraint residuals, relative to those of small motions of the state's own size."""
    x, u = coordinates.flatten(s.q)[0], coordinates.flatten(s.v)[0]
    eps = jnp.finfo(x.dtype).eps
    largest = lambda y: jnp.max(jnp.abs(y), initial=0.0)
    size = largest(jnp.where(np.array(kind.unseen), 0.0, x))
    size, speed = jnp.where(size > 0, size, 1.0), largest(u)
    row_sum = lambda matrix: jnp.max(jnp.sum(jnp.abs(matrix), axis=1), initial=0.0)
    mass = jnp.where(parts.sound, parts.mass, jnp.eye(parts.mass.shape[0], dtype=x.dtype))
    per_mass = lambda matrix: row_sum(lapack.solve(mass, jnp.nan_to_num(matrix)))
    rate = per_mass(parts.velocity) + row_sum(parts.drift)
    typical = (per_mass(parts.position) + rate**2) * size + rate * speed
    left = jnp.maximum(jnp.abs(parts.a) - 1e4 * eps * (largest(parts.forces) + speed**2 / size), 0.0)
    positive = jnp.where(typical > 0, typical, 1.0)
    relative = jnp.where(left > 0, jnp.where(typical > 0, left / positive, jnp.inf), 0.0)
    slopes = jnp.sum(jnp.abs(parts.raw.rows), axis=1)
    holonomic = slopes[np.array(kind.holonomic, bool)]
    allowed = jnp.concatenate([holonomic * size, slopes * jnp.where(speed > 0, speed, size)])
    off = jnp.abs(parts.off) / jnp.where(allowed > 0, allowed, 1.0)
    # Values that are not finite count as infinitely far off.
    relative = jax.lax.stop_gradient(jnp.concatenate([relative, off]))
    relative = jnp.where(jnp.isfinite(relative) & parts.sound, relative, jnp.inf)
    return Steadiness(relative, jnp.max(relative, initial=0.0))


def check_steady(model, linearisation, steadiness: Steadiness, linearised: Callable) -> None:
    """Raise if a state is not in steady motion, or its linear equations are singular or change with time.

    `linearisation`: the `Linearisation` at the state; `linearised(t, q, v, params)`: the `Linearisation` at another
    state.
    """
    kind, s, parts = linearisation.kind, linearisation.state, linearisation.parts
    relative, a = np.asarray(steadiness.relative), np.asarray(parts.a)
    dtype, n = relative.dtype, len(kind.unseen)
    if not parts.sound:
        raise ValueError(explain_failure(model, s) or _singular(kind, parts, s))
    names, equations = model.names, model.equation_names
    holonomic = [name for name, h in zip(equations, kind.holonomic) if h]
    labels = [f"'{name}'" for name in holonomic]
    labels += [f"d/dt '{name}'" if h else f"'{name}'" for name, h in zip(equations, kind.holonomic)]
    worst = int(np.argmax(relative[n:])) if len(labels) else 0
    if len(labels) and relative[n + worst] > STEADY_BELOW[dtype]:
        raise ValueError(
            f"not a steady motion: constraint {labels[worst]} = {float(parts.off[worst]):.3g}, but must be 0, "
            f"{where(s)}.\n"
            "Fix: q, v = lj.consistent_state(system, t, q, v, params), then find the equilibrium on the constraints."
        )
    worst = int(np.argmax(relative[:n]))
    if relative[worst] > STEADY_BELOW[dtype]:
        moving = np.any(coordinates.flatten(s.v)[0])
        what = "no steady motion" if moving else "not an equilibrium"
        raise ValueError(
            f"{what}: '{names[worst]}' accelerates by {a[worst]:.3g}, {relative[worst]:.2g} of what small motions of "
            f"the size of the state do, {where(s)}.\n"
            f"Usual cause: {'velocities that turn with the motion' if moving else 'a state near an equilibrium'}, or "
            "a state for other parameters.\n"
            + (
                "Fix: coordinates in which the velocities are constant (polar ones for a circle), with the values at "
                "which forces balance."
                if moving
                else "Fix: found = lj.equilibria(system, params, starts=q) gives the equilibrium nearby."
            )
        )
    _check_time(model, linearisation, linearised)


def _singular(kind, parts, s):
    names = coordinates.names(s.q)
    _, _, right = np.linalg.svd(np.nan_to_num(np.asarray(parts.mass)))
    i = int(np.argmax(np.abs(np.asarray(parts.velocities) @ right[-1])))
    return (
        f"the mass matrix is singular in coordinate '{names[i]}' {where(s)}: small motions along it have no equation.\n"
        "Usual cause: a coordinate singularity (an azimuth at the pole), or a coordinate without kinetic energy.\n"
        f"Fix: other coordinates there (Cartesian ones), or give '{names[i]}' a mass."
    )


def _check_time(model, linearisation, linearised):
    """Raise if the matrices differ further along the motion."""
    kind, s, parts = linearisation.kind, linearisation.state, linearisation.parts
    u = np.concatenate([np.ravel(x) for x in jax.tree.leaves(s.v)])
    if kind.timeless and not np.any(u[~np.array(kind.unseen)]):
        return
    speed = float(np.max(np.abs(u)))
    for distance in ALONG:
        # The time in which the fastest coordinate moves this far; if nothing moves, this many units of time.
        time = distance / speed if speed else distance
        q = jax.tree.map(lambda x, v: np.asarray(x + time * np.asarray(v), x.dtype), s.q, s.v)
        t = np.asarray(float(s.t) + time, s.t.dtype)
        later = linearised(t, q, s.v, s.params).parts
        changed = _changed(parts, later)
        if changed is None:
            continue
        what, i, j, before, after = changed
        names, equations = model.names, model.equation_names
        entry = f"'{equations[i]}' by '{names[j]}'" if what.startswith("constraint") else f"'{names[i]}', '{names[j]}'"
        raise ValueError(
            f"the linear equations change along the motion: {what} of {entry} is {before:.6g}, and {time:.3g} later it "
            f"is {after:.6g}. This is {where(s)}.\n"
            "Usual cause: explicit time, or velocities in coordinates that L contains.\n"
            "Fix: coordinates that move along, in which the equations are the same at all times; for a periodic motion "
            "lj.floquet(...) gives the multipliers."
        )


def _changed(parts, later):
    """The first matrix that changes, the entry, and its values before and after; None if none changes."""
    largest = lambda x: float(np.max(np.abs(x), initial=0.0))
    mass, position = largest(parts.raw.mass), largest(parts.raw.position)
    scales = (mass, max(largest(parts.raw.velocity), np.sqrt(mass * position)), position, None, None)
    words = (
        "the mass matrix",
        "the matrix of velocities",
        "the matrix of positions",
        "constraint derivative",
        "constraint derivative by position",
    )
    for what, scale, before, after in zip(words, scales, parts.raw, later.raw):
        before, after = np.asarray(before), np.asarray(after)
        scale = largest(before) if scale is None else scale
        away = np.abs(after - before)
        if away.size and not np.max(away) <= SAME_BELOW[before.dtype] * scale + np.finfo(before.dtype).tiny:
            i, j = np.unravel_index(int(np.argmax(away)), away.shape)
            return what, int(i), int(j), float(before[i, j]), float(after[i, j])
    return None
