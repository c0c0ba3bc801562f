"""From the linear equations to their modes: roots, shapes, energies, and what they mean together.

A coordinate that nothing depends on has a momentum; without force it is conserved, and at its value of the steady
motion the others have equations of their own (Routh's),

    M_e = M - M_c m⁻¹ M_cᵀ,    G_e = G - M_c m⁻¹ g - (..)ᵀ,    K_e = K + gᵀ m⁻¹ g

with m, M_c, g the parts of M and G of these coordinates. So a conservative system has no roots of zero but those of a
singular K_e. Of at most quadratic energy E₂ = ½ ξ̇ᵀ M ξ̇ + ½ ξᵀ K ξ a mode that oscillates with ω has the sign of
xᴴ (ω² M + K) x: where it is negative, damping makes it grow.

Source: Goldstein, *Classical Mechanics*, §8.3 (Routh); Krein's signature and Kelvin-Tait-Chetaev's theorem: Kirillov,
*Nonconservative Stability Problems of Modern Physics*, ch. 3 and 5; Merkin, *Introduction to the Theory of Stability*,
§6.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from lagjax.analysis.linearised import Linearisation
from lagjax.analysis.roots import Roots, general_roots, roots_beside_zeros, symmetric_roots, zero_count
from lagjax.numerics import dense, lapack

STABLE, ASYMPTOTIC, GYROSCOPIC, DIVERGENCE, FLUTTER, UNDECIDED, UNSTEADY = range(7)
STEADY_BELOW = 1e-5


class Motions(NamedTuple):
    """All that is computed of small motions, sorted; k of them.

    - `roots`, `shapes` (k, N): of all coordinates. `mirrored`: of each two roots that are one motion, the second.
    - `energies`: -1, 0 or 1. `double`: derivatives are those of the mean of a double root, or dropped.
    - `zero`: roots that are zero; `growing`: those that grow by more than round-off.
    - `unexplained`: how many roots of zero no coordinate and no velocity constraint explains.
    """

    roots: Complex[Array, " k"]
    shapes: Complex[Array, "k N"]
    mirrored: Bool[Array, " k"]
    energies: Int[Array, " k"]
    double: Bool[Array, " k"]
    zero: Bool[Array, " k"]
    growing: Bool[Array, " k"]
    unexplained: Int[Array, ""]
    code: Int[Array, ""]


class _Reduced(NamedTuple):
    """Routh's equations of the coordinates that something depends on; `follow`, `with_rate`: what the others do."""

    mass: Float[Array, "d d"]
    velocity: Float[Array, "d d"]
    position: Float[Array, "d d"]
    follow: Float[Array, "c d"]
    with_rate: Float[Array, "c d"]


def motions_of(found: Linearisation, definite: bool = True) -> Motions:
    """The motions of a linearisation; `definite`: take the mass matrix for positive definite."""
    if not found.kind.conservative:
        return _judged(found, _of_first_order(found))
    if definite and (found.kind.at_rest or found.parts.positions.shape[1] < 2):
        return _judged(found, _at_rest(found))
    return _judged(found, _gyroscopic(found))


def _routh(found) -> _Reduced:
    c = len(found.shifts)
    mass = jnp.where(found.sound, found.parts.mass, jnp.eye(found.parts.mass.shape[0], dtype=found.mass.dtype))
    velocity, position = (jnp.where(found.sound, x, 0.0) for x in (found.parts.velocity, found.parts.position))
    M, G, K = mass[c:, c:], velocity[c:, c:], position[c:]
    if not c:
        return _Reduced(M, G, K, M[:0], M[:0])
    inner = mass[:c, :c]
    with_rate = dense.solved(inner, mass[:c, c:])
    follow = dense.solved(inner, velocity[:c, c:])
    reduced = G - mass[c:, :c] @ follow - velocity[c:, :c] @ with_rate
    return _Reduced(
        M - mass[c:, :c] @ with_rate, (reduced - reduced.T) / 2, K - velocity[c:, :c] @ follow, -follow, -with_rate
    )


def _at_rest(found) -> Motions:
    """No gyroscopic forces: squares of frequencies."""
    reduced = _routh(found)
    if reduced.mass.shape[0]:
        roots = symmetric_roots(reduced.position, reduced.mass)
    else:
        none = jnp.zeros(0, found.mass.dtype)
        roots = Roots(none, jnp.zeros((0, 0), found.mass.dtype), none, none > 0, none > 0)
    squares = roots.values
    # What is left of terms that cancel.
    x = lax.stop_gradient(jnp.abs(roots.vectors))
    noise = jnp.sum(x * (jnp.abs(lax.stop_gradient(reduced.position)) @ x), axis=0)
    zero = jnp.abs(squares) <= 1e2 * jnp.finfo(squares.dtype).eps * noise
    squares = jnp.where(zero, 0.0, squares)
    positive = squares > 0
    size = jnp.sqrt(jnp.where(zero, 1.0, jnp.abs(squares)))
    values = jnp.where(zero, 0.0, lax.complex(jnp.where(positive, 0.0, size), jnp.where(positive, size, 0.0)))
    x = roots.vectors.astype(values.dtype)
    energies = jnp.where(positive, 1, 0)
    return _with_shifts(
        found, reduced, values, x, jnp.zeros_like(zero), energies, roots.double, zero, ~positive & ~zero
    )


def _gyroscopic(found) -> Motions:
    """Roots in pairs of λ and -λ: one of each is kept."""
    reduced = _routh(found)
    d = reduced.mass.shape[0]
    scale = _units(reduced.mass)
    M, G, K = (scale[:, None] * m * scale[None, :] for m in reduced[:3])
    rate = _rate(K, G)
    G, K = G / rate, K / rate**2
    eye, nil = jnp.eye(d, dtype=M.dtype), jnp.zeros_like(M)
    A, E = jnp.block([[nil, eye], [-K, -G]]), jnp.block([[eye, nil], [nil, M]])
    roots = general_roots(A, E)
    values, zero = _cleaned(roots, zero_count(A, E, roots.values))
    # On the imaginary axis or off it, what round-off cannot decide is on it.
    real = jnp.where(jnp.abs(values.real) <= roots.round_off, 0.0, values.real)
    values = lax.complex(real, values.imag)
    x = roots.vectors[:d]
    of_mass, of_stiffness = (jnp.real(jnp.sum(x.conj() * (m @ x), axis=0)) for m in (M, K))
    size = lambda m: jnp.sum(jnp.abs(x) * (jnp.abs(m) @ jnp.abs(x)), axis=0)
    energy = values.imag**2 * of_mass + of_stiffness
    noise = 1e-9 * (values.imag**2 * size(M) + size(K))
    swings = (values.imag != 0) & (values.real == 0) & ~zero & (jnp.abs(energy) > noise)
    energies = jnp.where(swings, jnp.sign(energy), 0).astype(int)
    # Of two roots of zero the second is the other's mirror image.
    parity = jnp.cumsum(zero) % 2 == 0
    mirrored = jnp.where(zero, parity, (values.imag < 0) | ((values.imag == 0) & (values.real < 0)))
    growing = values.real > 0
    order = _order(values, mirrored)[:d]
    pick = lambda y: y[order]
    return _with_shifts(
        found, reduced, pick(values) * rate, (scale[:, None] * x)[:, order], pick(mirrored), pick(energies),
        pick(roots.double), pick(zero), pick(growing), pick(roots.defective),
    )  # fmt: skip


def _of_first_order(found) -> Motions:
    """All roots: forces, dissipation, velocity constraints."""
    p = found.parts
    eye = jnp.eye(p.mass.shape[0], dtype=p.mass.dtype)
    mass = jnp.where(found.sound, p.mass, eye)
    velocity, position, drift = (jnp.where(found.sound, x, 0.0) for x in (p.velocity, p.position, p.drift))
    transfer = jnp.where(found.sound, p.transfer, 0.0)
    count = drift.shape[0]
    of_w, of_q = _units(mass), _units(p.positions.T @ p.raw.mass @ p.positions)
    M, C = (of_w[:, None] * m * of_w[None, :] for m in (mass, velocity))
    K, transfer = of_w[:, None] * position * of_q[None, :], transfer * of_w[None, :] / of_q[:, None]
    drift = drift * of_q[None, :] / of_q[:, None]
    rate = _rate(K, C, drift)
    K, C, drift = K / rate**2, C / rate, drift / rate
    nil = jnp.zeros_like(transfer)
    A = jnp.block([[drift, transfer], [-K, -C]])
    E = jnp.block([[jnp.eye(count, dtype=M.dtype), nil], [nil.T, M]])
    roots, zero = roots_beside_zeros(A, E)
    values = jnp.where(zero, 0.0, roots.values)
    # Other speeds of what nothing depends on: no position has a part in them.
    columns = lapack.singular_values(jnp.concatenate([transfer, C]))
    speeds = jnp.sum(columns <= 1e-12 * jnp.max(columns, initial=0.0))
    unexplained = jnp.where(all(found.kind.holonomic), jnp.maximum(jnp.sum(zero) - speeds, 0), 0)
    rho, w = of_q[:, None] * roots.vectors[:count], of_w[:, None] * roots.vectors[count:] * rate
    moving = p.velocities @ w + p.turning @ rho
    still = p.positions @ rho
    nonzero = jnp.where(zero, 1.0, values * rate)
    size = lambda y: jnp.max(jnp.abs(y), axis=0, initial=0.0)
    # A motion with other speeds is drawn by its speeds, a shift by its positions.
    only_speed = size(roots.vectors[:count]) <= 1e-6 * size(roots.vectors)
    unseen = np.array(found.kind.unseen, bool)[:, None]
    drifting = jnp.where(only_speed[None, :], moving, still)
    full = jnp.where(zero[None, :], drifting, jnp.where(unseen, moving / nonzero[None, :], still))
    grow = roots.round_off * rate
    values = values * rate
    # Round-off is no growth; what its derivative is, stays.
    real = values.real
    nothing = (jnp.abs(real) <= grow) & (values.imag != 0)
    values = lax.complex(jnp.where(nothing, real - lax.stop_gradient(real), real), values.imag)
    mirrored = values.imag < 0
    order = _order(values, mirrored)
    code = _unstable_or(values, grow, zero, roots, unexplained)
    return Motions(
        values[order], _normalised(full.T[order]), mirrored[order], jnp.zeros(values.size, int), roots.double[order],
        zero[order], ((values.real > grow) & ~zero)[order], unexplained, code,
    )  # fmt: skip


def _unstable_or(values, allowed, zero, roots: Roots, unexplained):
    """The verdict of roots as they are, without energies."""
    growth = jnp.where(zero, -jnp.inf, values.real - allowed)
    worst = jnp.argmax(growth)
    flutters = jnp.abs(values.imag[worst]) > 0
    decays = jnp.all(zero | (values.real < -allowed))
    touching = jnp.any(roots.defective & ~zero & (values.real >= -allowed))
    settled = jnp.where(touching | (unexplained > 0), UNDECIDED, jnp.where(decays, ASYMPTOTIC, STABLE))
    return jnp.where(growth[worst] > 0, jnp.where(flutters, FLUTTER, DIVERGENCE), settled)


def _units(mass):
    """Units of coordinates in which their masses are one."""
    diagonal = jnp.abs(jnp.diag(lax.stop_gradient(mass)))
    return 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))


def _rate(position, velocity, drift=0.0):
    """The rate, as unit of one over time, by which nothing is larger than one."""
    largest = lambda y: jnp.max(jnp.abs(lax.stop_gradient(y)), initial=0.0)
    rate = jnp.maximum(jnp.sqrt(largest(position)), jnp.maximum(largest(velocity), largest(drift)))
    return jnp.where(rate > 0, rate, 1.0)


def _cleaned(roots: Roots, zeros):
    """The roots with the smallest so many of them zero, and which these are."""
    zero = _rank((jnp.abs(roots.values),)) < zeros
    values = jnp.where(zero, 0.0, roots.values)
    return values, zero


def _order(values, mirrored):
    """By frequency, of equal ones the fastest growing first; mirror images last."""
    rank = _rank((mirrored, values.imag, -values.real))
    return jnp.zeros_like(rank).at[rank].set(jnp.arange(rank.size))


def _rank(keys):
    """The place of each in ascending order, by the first key, and where it is the same by the next ones.

    By comparing all with each other: a sort takes longer to compile than the rest.
    """
    place = jnp.arange(keys[0].size)
    before = jnp.zeros((place.size, place.size), bool)
    same = ~before
    for key in (*map(lax.stop_gradient, keys), place):
        key = key.astype(int) if key.dtype == bool else key
        before = before | (same & (key[:, None] < key[None, :]))
        same = same & (key[:, None] == key[None, :])
    return jnp.sum(before, axis=0)


def _with_shifts(found, reduced, values, x, mirrored, energies, double, zero, growing, defective=None) -> Motions:
    """The motions of the reduced equations, and those in which what nothing depends on is shifted."""
    c, names = len(found.shifts), np.array(found.kind.unseen, bool)
    n = names.size
    full = found.parts.positions.astype(x.dtype) @ x
    if c:
        nonzero = jnp.where(zero, 1.0, values)
        rest = reduced.with_rate.astype(x.dtype) @ x + (reduced.follow.astype(x.dtype) @ x) / nonzero[None, :]
        full = full.at[names].set(jnp.where(zero[None, :], 0.0, rest))
    shapes = jnp.concatenate([jnp.eye(n, dtype=x.dtype)[names], full.T])
    before = lambda fill, y: jnp.concatenate([jnp.full(c, fill, y.dtype), y])
    code = _conservative(values, energies, zero, growing, defective)
    all_values, all_zero = before(0.0, values), before(True, zero)
    order = _order(all_values, before(False, mirrored))
    pick = lambda y: y[order]
    return Motions(
        pick(all_values), _normalised(shapes[order]), pick(before(False, mirrored)), pick(before(0, energies)),
        pick(before(False, double)), pick(all_zero), pick(before(False, growing)), jnp.sum(zero), code,
    )  # fmt: skip


def _conservative(values, energies, zero, growing, defective):
    if not values.size:
        return jnp.asarray(STABLE)
    growth = jnp.where(growing, values.real, -jnp.inf)
    flutters = values.imag[jnp.argmax(growth)] != 0
    settled = jnp.where(jnp.any(energies < 0), GYROSCOPIC, STABLE)
    undecided = jnp.any(zero) if defective is None else jnp.any(zero | defective)
    settled = jnp.where(undecided, UNDECIDED, settled)
    return jnp.where(jnp.any(growing), jnp.where(flutters, FLUTTER, DIVERGENCE), settled)


def _normalised(shapes):
    """Shapes (k, N) whose largest entry is one."""
    if not shapes.size:
        return shapes
    shapes = shapes.astype(jnp.result_type(shapes.dtype, np.complex64))
    # The first of those that are as large but for round-off.
    size = lax.stop_gradient(jnp.abs(shapes))
    first = jnp.argmax(size >= (1 - 1e-6) * jnp.max(size, axis=1, keepdims=True), axis=1)
    at = jnp.take_along_axis(shapes, first[:, None], axis=1)
    return shapes / jnp.where(at != 0, at, 1.0)


def _judged(found, motions: Motions) -> Motions:
    steady = found.sound & (found.residual <= STEADY_BELOW)
    return motions._replace(code=jnp.where(steady, motions.code, UNSTEADY).astype(jnp.int32))
