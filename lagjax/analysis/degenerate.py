"""Stability where a stiffness is zero: the first term decides that does not vanish along the zero mode.

With the reduced force b(s) of `reduced_force.py`, which is c s^k near the equilibrium s = 0:

- b = 0 at all amplitudes: the equilibrium is one of a family, as along a symmetry. The linear terms decide the rest.
- With friction along the mode, d = ψ·Cφ ≠ 0, the motion on the centre manifold is d s' = -b(s) to leading order.
- Without, it is that of a mass, m s'' = -b(s), if energy is conserved or lost and all other stiffness is positive.

Either way the equilibrium is stable if b pushes back on both sides, and unstable otherwise, at whatever order k. What
satisfies neither premise is undecided. With several zero modes a conservative system is stable if b·s > 0 on all rays,
and unstable if b·s < 0 on one and nothing turns.

Source: Carr, *Applications of Centre Manifold Theory* (1981), §2; Kozlov & Furta, *Asymptotic Solutions of Strongly
Nonlinear Systems of Differential Equations* (2013), ch. 4 (inverses of Lagrange's theorem).
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from lagjax.analysis.equilibria import balance as equations
from lagjax.analysis.equilibria.balance import MOMENTUM, Steady
from lagjax.analysis.equilibria.reduced_force import (
    SAMPLES,
    WINDOW,
    Bordered,
    between,
    bordered_at,
    fields_at,
    first_term,
    padded,
    reduced,
    reduced_force,
    values_at,
)
from lagjax.jaxtools import compiled
from lagjax.mechanics import applied_force
from lagjax.numerics import null_space

STABLE, UNSTABLE, UNDECIDED, AS_LINEAR = range(4)
# Rays of several zero modes; the smallest resistance of a minimum, relative to the largest.
RAYS, SMALLEST_RESISTANCE = 64, 1e-3


class Decision(NamedTuple):
    """The verdict; at a degenerate point its unknowns y, the distance that Newton's method leaves, and zero modes."""

    verdict: int
    y: np.ndarray | None = None
    radius: float = 0.0
    zero_modes: int = 0


@compiled
def _velocity_terms(steady: Steady, y, jacobian):
    d = equations.departures(steady, y, jacobian)
    return d.damping, d.mass


@compiled
def _pushes(steady: Steady, x, u):
    """The force Q - ∂R/∂v that L does not contain, at many states (B, n)."""
    return jax.vmap(partial(applied_force, steady.model, steady.t))(x, u)


def decide(steady: Steady, y, size: float, roots, unseen: np.ndarray) -> Decision:
    """Decide about an equilibrium or steady motion `y` whose balance has almost a null vector.

    `size`: of the positions, zero if it is not known; `roots`: its characteristic roots; `unseen` (n,): coordinates
    that nothing depends on.
    """
    system, conservative = steady.system, steady.conservative
    dtype, n, k = np.dtype(steady.t.dtype), steady.n, steady.symmetries.count
    if not system.is_holonomic:
        return Decision(UNDECIDED)
    bordered = bordered_at(steady, y, size, np.flatnonzero(unseen))
    z = zeros = bordered.right.shape[1]
    if z == 0:
        return Decision(AS_LINEAR)
    if bordered.left.shape[1] != z:
        return Decision(UNDECIDED)
    if _is_flat(bordered):
        return Decision(AS_LINEAR)
    if z > 1:
        bordered, z = _only_active(bordered) if conservative else (bordered, z)
    if z > 1:
        return _of_rays(bordered, dtype) if conservative and not k else Decision(UNDECIDED)
    amplitudes, b = reduced_force(bordered, size)
    behind, ahead = first_term(amplitudes[::-1], b[: SAMPLES // 2]), first_term(amplitudes, b[SAMPLES // 2 :])
    if behind is None or ahead is None:
        return Decision(UNDECIDED)
    if behind.exponent < 1.5 and ahead.exponent < 1.5:
        return Decision(AS_LINEAR)
    y = between(bordered, ahead)
    length = float(np.max(np.abs(bordered.columns * bordered.right[:, 0])[:n]))
    radius = 4 * max(behind.amplitude, ahead.amplitude) * length
    r, jacobian = (np.asarray(x)[0] for x in values_at(steady, padded(y[None], dtype)))
    damping, mass = (np.asarray(x) for x in _velocity_terms(steady, y.astype(dtype), jacobian))
    phi, psi = (bordered.columns * bordered.right[:, 0])[:n], (bordered.left[:, 0] / bordered.rows)[:n]
    inertia, friction = float(psi @ mass @ phi), float(psi @ damping @ phi)
    largest = np.max(np.abs(roots), initial=0.0, where=np.isfinite(roots))
    scale = np.sqrt(np.abs(psi) @ np.abs(mass) @ np.abs(phi)) * largest
    rubs = abs(friction) > 1e-8 * max(np.abs(psi) @ np.abs(damping) @ np.abs(phi), scale * abs(inertia) ** 0.5 * 1e-4)
    pushes_back = ahead.sign > 0 > behind.sign
    if np.sign(friction if rubs else inertia) < 0:
        pushes_back = ahead.sign < 0 < behind.sign
    rest = np.sort_complex(roots[np.isfinite(roots)])
    rest = rest[np.argsort(np.abs(rest), kind="stable")]
    # Without the roots of the zero modes, of unseen coordinates, and of other speeds along the symmetries.
    rest = rest[min(rest.size, (1 if rubs else 2) + 2 * (zeros - 1 + int(np.sum(unseen))) + k) :]
    margin = 1e-6 * np.max(np.abs(rest), initial=0.0)

    def decision(verdict: int) -> Decision:
        return Decision(verdict, y, radius, 1)

    if np.any(rest.real > margin):
        return decision(UNSTABLE)
    loses = system.force is None and (conservative or _only_loses(steady, y, size))
    holds = loses and _stiffness_is_positive(steady, y, jacobian, mass, zeros + int(np.sum(unseen)))
    if rubs and not k:
        decays = np.all(rest.real < -margin)
        return decision(UNSTABLE if not pushes_back else STABLE if decays or holds else UNDECIDED)
    if not loses and n == 1 and not steady.m:
        # A single coordinate under a force that does not see its velocity has a potential.
        x, u = _states_nearby(steady, y, size)
        holds = bool(np.all(np.asarray(_pushes(steady, x, u)) == np.asarray(_pushes(steady, x, 0 * u))))
    if not holds:
        return decision(UNDECIDED)
    return decision(STABLE if pushes_back else UNSTABLE)


def without_zeros(roots: np.ndarray, decision: Decision) -> np.ndarray:
    """The characteristic roots, with that of the zero mode nearest to zero set to zero."""
    known = np.flatnonzero(np.isfinite(roots))
    order = known[np.argsort(np.abs(roots[known]), kind="stable")]
    cleaned, largest = np.array(roots), np.max(np.abs(roots[known]), initial=0.0)
    tiny = order[: 2 * decision.zero_modes]
    small = (np.abs(roots[tiny]) <= 1e-3 * largest) | (known.size <= 2 * decision.zero_modes)
    # A pair ±√stiffness of round-off, or one root beside the friction's.
    if tiny.size == 2 and known.size == 2 and np.abs(roots[tiny[0]]) < 0.5 * np.abs(roots[tiny[1]]):
        small = np.array([True, False])
    cleaned[tiny[small]] = 0.0
    return cleaned


def _is_flat(bordered) -> bool:
    """Whether the reduced force is round-off in all directions: the equilibrium is one of a family."""
    z, eps = bordered.right.shape[1], np.finfo(bordered.steady.t.dtype).eps
    directions = np.random.default_rng(1).normal(size=(SAMPLES // 8, z)) if z > 1 else np.ones((SAMPLES // 8, 1))
    directions /= np.max(np.abs(directions), axis=1, keepdims=True)
    sizes = np.array([0.25, -0.25, 0.11, -0.11, 0.03, -0.03, 0.004, -0.004])
    b, _ = reduced(bordered, np.concatenate([directions * size for size in sizes]))
    known = np.all(np.isfinite(b), axis=1)
    largest = np.max(np.abs(bordered.y / bordered.columns), initial=1.0)
    return bool(np.mean(known) > 0.5 and np.all(np.abs(b[known]) <= 1e4 * eps * largest))


def _only_active(bordered) -> tuple[Bordered, int]:
    """The equations with the one zero mode that is no symmetry, if the reduced force has a single direction."""
    z = bordered.right.shape[1]
    directions = np.random.default_rng(2).normal(size=(SAMPLES, z)) * 0.02
    b, _ = reduced(bordered, directions)
    b = b[np.all(np.isfinite(b), axis=1)]
    if len(b) < SAMPLES // 2:
        return bordered, z
    _, sizes, directions = np.linalg.svd(b)
    if sizes[1] > 1e-6 * sizes[0]:
        return bordered, z
    left = bordered.left @ directions[0]
    # In a conservative system force and displacement have the same directions.
    n, work = bordered.steady.n, left / bordered.rows
    weights = (bordered.columns[:, None] * bordered.right)[:n].T @ work[:n]
    return bordered._replace(
        right=(bordered.right @ (weights / np.linalg.norm(weights)))[:, None], left=left[:, None]
    ), 1


def _of_rays(bordered, dtype) -> Decision:
    """The verdict of several zero modes of a conservative system at rest, from the work b·s on rays."""
    z = bordered.right.shape[1]
    random = np.random.default_rng(3).normal(size=(RAYS - 2 * z, z))
    rays = np.concatenate([np.eye(z), -np.eye(z), random / np.linalg.norm(random, axis=1, keepdims=True)])
    # Displacements and forces in one basis: the work is b·s for it only.
    n = bordered.steady.n
    to_work = (bordered.left / bordered.rows[:, None])[:n].T @ (bordered.columns[:, None] * bordered.right)[:n]
    amplitudes = 2.0 ** -np.arange(4.0, 4.0 + WINDOW + 3)
    work = np.stack([np.sum((reduced(bordered, s * rays)[0] @ to_work) * rays, axis=1) for s in amplitudes], axis=1)
    terms = [first_term(amplitudes, row) for row in work]
    known = [term.exponent for term in terms if term is not None]
    radius = (
        4 * (1e2 * float(np.finfo(dtype).eps)) ** (1 / max(known, default=2.0)) * float(np.max(bordered.columns[:n]))
    )

    def decision(verdict: int) -> Decision:
        return Decision(verdict, None, radius, z)

    if any(term is not None and term.sign < 0 and term.exponent > 1.5 for term in terms):
        # Gyroscopic forces may hold what the potential does not.
        turns = np.any(np.asarray(_velocity_terms(bordered.steady, bordered.y.astype(dtype), _at(bordered))[0]))
        return decision(UNDECIDED if turns else UNSTABLE)
    exponents = [term.exponent for term in terms if term is not None]
    if len(exponents) < len(terms) or np.ptp(exponents) > 0.5:
        return decision(UNDECIDED)
    smallest = np.min(work[:, -1]) / np.max(work[:, -1])
    return decision(STABLE if smallest > SMALLEST_RESISTANCE else UNDECIDED)


def _at(bordered):
    """The Jacobian at the equilibrium."""
    return np.asarray(values_at(bordered.steady, padded(bordered.y[None], np.dtype(bordered.steady.t.dtype)))[1])[0]


def _states_nearby(steady, y, size):
    """Random states, large and small departures from rest at y."""
    random, n, dtype, unit = np.random.default_rng(4), steady.n, np.dtype(steady.t.dtype), size or 1.0
    x, u = random.normal(size=(2, SAMPLES, n)) * 10.0 ** -random.uniform(0.5, 4.0, (2, SAMPLES, 1))
    return (y[:n] + unit * x).astype(dtype), (unit * u).astype(dtype)


def _only_loses(steady, y, size) -> bool:
    """Whether the dissipation takes energy out at all states nearby that are tried."""
    x, u = _states_nearby(steady, y, size)
    return bool(np.all(np.sum(np.asarray(_pushes(steady, x, u)) * u, axis=1) <= 0))


def _stiffness_is_positive(steady, y, jacobian, mass, zeros) -> bool:
    """Whether all stiffness but that of the zero modes is positive, with the symmetries' momenta held."""
    n, k, m = steady.n, steady.symmetries.count, steady.m
    jacobian = np.asarray(jacobian, float)
    stiffness = jacobian[:n, :n]
    if k:
        if steady.symmetries.hold != MOMENTUM:
            return False
        stiffness = stiffness - jacobian[:n, n : n + k] @ np.linalg.solve(
            jacobian[n + m :, n : n + k], jacobian[n + m :, :n]
        )
    fixed = np.concatenate(
        [jacobian[n : n + m, :n], np.asarray(fields_at(steady, y[:n].astype(steady.t.dtype)), float)]
    )
    tangent = null_space(fixed, 1e-9) if len(fixed) else np.eye(n)
    inner = tangent.T @ mass @ tangent
    if np.linalg.eigvalsh(inner)[0] <= 0:
        return False
    lower = np.linalg.inv(np.linalg.cholesky(inner))
    symmetric = lower @ tangent.T @ ((stiffness + stiffness.T) / 2) @ tangent @ lower.T
    squares = np.sort(np.linalg.eigvalsh(symmetric))
    zero = np.argsort(np.abs(squares), kind="stable")[: max(zeros, 0)]
    rest = np.delete(squares, zero)
    return bool(np.all(rest > 1e-6 * np.max(np.abs(rest), initial=0.0)))


def held_by_momentum(steady: Steady, x, rates) -> Steady:
    """The same steady motion with the symmetries' momenta held, which is what is conserved."""
    if not steady.symmetries.count or steady.symmetries.hold is None or not steady.conservative:
        return steady
    held = np.asarray(_momenta(steady, x, rates))
    symmetries = equations.SteadySymmetries(steady.symmetries.places, steady.symmetries.fields, MOMENTUM)
    return Steady(steady.model, steady.t, held, steady.x0, symmetries)


@compiled
def _momenta(steady, x, rates):
    return steady.momenta(x, steady.velocity(x, rates))


def unknowns(row) -> np.ndarray:
    """The unknowns y of a row of `Equilibria`: positions, rates, multipliers."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves((row.q, row.rates, row.multipliers))])
