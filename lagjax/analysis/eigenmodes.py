"""From the linear equations to their modes: roots, shapes, energies, and the verdict on stability.

In a conservative system the momentum of a coordinate that nothing depends on is conserved. With this momentum fixed at
its value in the steady motion, the other coordinates have equations of their own (Routh's),

    M_e = M - M_c m⁻¹ M_cᵀ,    G_e = G - M_c m⁻¹ g - (..)ᵀ,    K_e = K + gᵀ m⁻¹ g

where m, M_c, g are the blocks of M and G of the eliminated coordinates. A conservative system then has zero roots only
if K_e is singular. A mode that oscillates with ω contributes to the quadratic energy E₂ = ½ ξ̇ᵀ M ξ̇ + ½ ξᵀ K ξ with
the sign of xᴴ (ω² M + K) x; if this is negative, damping makes the mode grow.

The roots are those of `K x = s M x` at rest, and of `A x = λ E x` otherwise (`numerics/lapack.py`).

Source: Goldstein, *Classical Mechanics*, §8.3 (Routh); Krein's signature and Kelvin-Tait-Chetaev's theorem: Kirillov,
*Nonconservative Stability Problems of Modern Physics*, ch. 3 and 5; Merkin, *Introduction to the Theory of Stability*,
§6.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from lagjax.analysis.linearise import Linearisation, pencil
from lagjax.numerics import Roots, dense, general_roots, lapack, roots_beside_zeros, symmetric_roots, zero_count

STABLE, ASYMPTOTIC, GYROSCOPIC, DIVERGENCE, FLUTTER, UNDECIDED, UNSTEADY = range(7)
STEADY_BELOW = 1e-5


class Motions(NamedTuple):
    """The k small motions, sorted.

    - `roots` (k,); `shapes` (k, N): in all coordinates. `mirrored`: the second of two roots that describe one motion.
    - `energies`: -1, 0 or 1. `double`: derivatives are those of the mean of a double root, or dropped.
    - `zero`: roots that are zero; `growing`: roots that grow by more than round-off.
    - `unexplained`: the number of zero roots that no ignorable coordinate and no velocity constraint explains.
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
    """Routh's equations in d coordinates; the rates of the c others are `follow` x + `with_rate` ẋ."""

    mass: Float[Array, "d d"]
    velocity: Float[Array, "d d"]
    position: Float[Array, "d d"]
    follow: Float[Array, "c d"]
    with_rate: Float[Array, "c d"]


def motions_of(linear: Linearisation, definite: bool) -> Motions:
    """The motions of a linearisation; `definite`: assume that the mass matrix is positive definite."""
    if not linear.kind.conservative:
        return _judged(linear, _general(linear))
    if definite and (linear.kind.at_rest or linear.parts.positions.shape[1] < 2):
        return _judged(linear, _at_rest(linear))
    return _judged(linear, _gyroscopic(linear))


def _routh(linear) -> _Reduced:
    c = len(linear.shifts)
    mass = jnp.where(linear.sound, linear.parts.mass, jnp.eye(linear.parts.mass.shape[0], dtype=linear.mass.dtype))
    velocity, position = (jnp.where(linear.sound, x, 0.0) for x in (linear.parts.velocity, linear.parts.position))
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


def _at_rest(linear) -> Motions:
    """Without gyroscopic forces: the eigenvalues are the squares of the frequencies."""
    reduced = _routh(linear)
    if reduced.mass.shape[0]:
        roots = symmetric_roots(reduced.position, reduced.mass)
    else:
        empty = jnp.zeros(0, linear.mass.dtype)
        roots = Roots(empty, jnp.zeros((0, 0), linear.mass.dtype), empty, empty > 0, empty > 0)
    squares = roots.values
    # The round-off that remains when terms cancel.
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
        linear, reduced, values, x, jnp.zeros_like(zero), energies, roots.double, zero, ~positive & ~zero
    )


def _gyroscopic(linear) -> Motions:
    """With gyroscopic forces: roots come in pairs λ and -λ, of which one is kept."""
    reduced = _routh(linear)
    d = reduced.mass.shape[0]
    scale = _units(reduced.mass)
    M, G, K = (scale[:, None] * m * scale[None, :] for m in reduced[:3])
    rate = _rate(K, G)
    G, K = G / rate, K / rate**2
    eye, nil = jnp.eye(d, dtype=M.dtype), jnp.zeros_like(M)
    E, A = pencil(linear.parts._replace(mass=M, velocity=G, position=K, drift=nil, transfer=eye))
    roots = general_roots(A, E)
    values, zero = _cleaned(roots, zero_count(A, E, roots.values))
    # A root within round-off of the imaginary axis is taken to be on it.
    real = jnp.where(jnp.abs(values.real) <= roots.round_off, 0.0, values.real)
    values = lax.complex(real, values.imag)
    x = roots.vectors[:d]
    of_mass, of_stiffness = (jnp.real(jnp.sum(x.conj() * (m @ x), axis=0)) for m in (M, K))

    def size(m: Array):
        return jnp.sum(jnp.abs(x) * (jnp.abs(m) @ jnp.abs(x)), axis=0)

    energy = values.imag**2 * of_mass + of_stiffness
    noise = 1e-9 * (values.imag**2 * size(M) + size(K))
    swings = (values.imag != 0) & (values.real == 0) & ~zero & (jnp.abs(energy) > noise)
    energies = jnp.where(swings, jnp.sign(energy), 0).astype(int)
    # Of two zero roots, the second counts as the mirror image of the first.
    parity = jnp.cumsum(zero) % 2 == 0
    mirrored = jnp.where(zero, parity, (values.imag < 0) | ((values.imag == 0) & (values.real < 0)))
    growing = values.real > 0
    order = _order(values, mirrored)[:d]

    def pick(y: Array):
        return y[order]

    return _with_shifts(
        linear, reduced, pick(values) * rate, (scale[:, None] * x)[:, order], pick(mirrored), pick(energies),
        pick(roots.double), pick(zero), pick(growing), pick(roots.defective),
    )  # fmt: skip


def _general(linear) -> Motions:
    """Systems with forces, dissipation or velocity constraints: all roots."""
    p = linear.parts
    eye = jnp.eye(p.mass.shape[0], dtype=p.mass.dtype)
    mass = jnp.where(linear.sound, p.mass, eye)
    velocity, position, drift = (jnp.where(linear.sound, x, 0.0) for x in (p.velocity, p.position, p.drift))
    transfer = jnp.where(linear.sound, p.transfer, 0.0)
    count = drift.shape[0]
    of_w, of_q = _units(mass), _units(p.positions.T @ p.raw.mass @ p.positions)
    M, C = (of_w[:, None] * m * of_w[None, :] for m in (mass, velocity))
    K, transfer = of_w[:, None] * position * of_q[None, :], transfer * of_w[None, :] / of_q[:, None]
    drift = drift * of_q[None, :] / of_q[:, None]
    rate = _rate(K, C, drift)
    K, C, drift = K / rate**2, C / rate, drift / rate
    E, A = pencil(p._replace(mass=M, velocity=C, position=K, drift=drift, transfer=transfer))
    roots, zero = roots_beside_zeros(A, E)
    values = jnp.where(zero, 0.0, roots.values)
    # Velocity directions that change no position η and cause no force are other speeds of a steady motion.
    columns = lapack.singular_values(jnp.concatenate([transfer, C]))
    speeds = jnp.sum(columns <= 1e-12 * jnp.max(columns, initial=0.0))
    unexplained = jnp.where(all(linear.kind.holonomic), jnp.maximum(jnp.sum(zero) - speeds, 0), 0)
    rho, w = of_q[:, None] * roots.vectors[:count], of_w[:, None] * roots.vectors[count:] * rate
    moving = p.velocities @ w + p.turning @ rho
    still = p.positions @ rho
    nonzero = jnp.where(zero, 1.0, values * rate)

    def size(y: Array):
        return jnp.max(jnp.abs(y), axis=0, initial=0.0)

    # The shape of a zero mode is its velocities if it only changes speeds, and its positions if it is a shift.
    only_speed = size(roots.vectors[:count]) <= 1e-6 * size(roots.vectors)
    unseen = np.array(linear.kind.unseen, bool)[:, None]
    drifting = jnp.where(only_speed[None, :], moving, still)
    full = jnp.where(zero[None, :], drifting, jnp.where(unseen, moving / nonzero[None, :], still))
    grow = roots.round_off * rate
    values = values * rate
    # Growth within round-off is set to zero, but keeps its derivative.
    real = values.real
    negligible = (jnp.abs(real) <= grow) & (values.imag != 0)
    values = lax.complex(jnp.where(negligible, real - lax.stop_gradient(real), real), values.imag)
    mirrored = values.imag < 0
    order = _order(values, mirrored)
    code = _verdict_of_roots(values, grow, zero, roots, unexplained)
    return Motions(
        values[order], _normalised(full.T[order]), mirrored[order], jnp.zeros(values.size, int), roots.double[order],
        zero[order], ((values.real > grow) & ~zero)[order], unexplained, code,
    )  # fmt: skip


def _verdict_of_roots(values, allowed, zero, roots: Roots, unexplained):
    """The verdict from the roots alone, without energies."""
    growth = jnp.where(zero, -jnp.inf, values.real - allowed)
    worst = jnp.argmax(growth)
    flutters = jnp.abs(values.imag[worst]) > 0
    decays = jnp.all(zero | (values.real < -allowed))
    touching = jnp.any(roots.defective & ~zero & (values.real >= -allowed))
    settled = jnp.where(touching | (unexplained > 0), UNDECIDED, jnp.where(decays, ASYMPTOTIC, STABLE))
    return jnp.where(growth[worst] > 0, jnp.where(flutters, FLUTTER, DIVERGENCE), settled)


def _units(mass):
    """Units of the coordinates in which the diagonal of the mass matrix is one."""
    diagonal = jnp.abs(jnp.diag(lax.stop_gradient(mass)))
    return 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))


def _rate(position, velocity, drift=0.0):
    """The unit of inverse time in which no entry is larger than one."""

    def largest(y: Array):
        return jnp.max(jnp.abs(lax.stop_gradient(y)), initial=0.0)

    rate = jnp.maximum(jnp.sqrt(largest(position)), jnp.maximum(largest(velocity), largest(drift)))
    return jnp.where(rate > 0, rate, 1.0)


def _cleaned(roots: Roots, zeros):
    """The roots with the `zeros` smallest of them set to zero, and which these are."""
    zero = _rank((jnp.abs(roots.values),)) < zeros
    values = jnp.where(zero, 0.0, roots.values)
    return values, zero


def _order(values, mirrored):
    """The order by frequency, at equal frequency by falling growth; mirror images last."""
    rank = _rank((mirrored, values.imag, -values.real))
    return jnp.zeros_like(rank).at[rank].set(jnp.arange(rank.size))


def _rank(keys):
    """The place of each entry in ascending order, by the first key; ties are decided by the next keys.

    All entries are compared with each other, because a sort takes longer to compile than everything else here.
    """
    place = jnp.arange(keys[0].size)
    before = jnp.zeros((place.size, place.size), bool)
    same = ~before
    for key in (*map(lax.stop_gradient, keys), place):
        key = key.astype(int) if key.dtype == bool else key
        before = before | (same & (key[:, None] < key[None, :]))
        same = same & (key[:, None] == key[None, :])
    return jnp.sum(before, axis=0)


def _with_shifts(linear, reduced, values, x, mirrored, energies, double, zero, growing, defective=None) -> Motions:
    """The motions of the reduced equations, preceded by the shifts of coordinates that nothing depends on."""
    c, names = len(linear.shifts), np.array(linear.kind.unseen, bool)
    n = names.size
    full = linear.parts.positions.astype(x.dtype) @ x
    if c:
        nonzero = jnp.where(zero, 1.0, values)
        rest = reduced.with_rate.astype(x.dtype) @ x + (reduced.follow.astype(x.dtype) @ x) / nonzero[None, :]
        full = full.at[names].set(jnp.where(zero[None, :], 0.0, rest))
    shapes = jnp.concatenate([jnp.eye(n, dtype=x.dtype)[names], full.T])

    def before(fill: Array, y: Array):
        return jnp.concatenate([jnp.full(c, fill, y.dtype), y])

    code = _conservative_verdict(values, energies, zero, growing, defective)
    all_values, all_zero = before(0.0, values), before(True, zero)
    order = _order(all_values, before(False, mirrored))

    def pick(y: Array):
        return y[order]

    return Motions(
        pick(all_values), _normalised(shapes[order]), pick(before(False, mirrored)), pick(before(0, energies)),
        pick(before(False, double)), pick(all_zero), pick(before(False, growing)), jnp.sum(zero), code,
    )  # fmt: skip


def _conservative_verdict(values, energies, zero, growing, defective):
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
    # The first of the entries that are the largest to within round-off.
    size = lax.stop_gradient(jnp.abs(shapes))
    first = jnp.argmax(size >= (1 - 1e-6) * jnp.max(size, axis=1, keepdims=True), axis=1)
    at = jnp.take_along_axis(shapes, first[:, None], axis=1)
    return shapes / jnp.where(at != 0, at, 1.0)


def _judged(linear, motions: Motions) -> Motions:
    steady = linear.sound & (linear.residual <= STEADY_BELOW)
    return motions._replace(code=jnp.where(steady, motions.code, UNSTEADY).astype(jnp.int32))
