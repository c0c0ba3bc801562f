"""Stability where a stiffness is zero: the first term decides that does not vanish along the zero mode.

With the reduced force b(s), which is c s^k near the equilibrium s = 0:

- b = 0 at all amplitudes: the equilibrium is one of a family, as along a symmetry. The linear terms decide the rest.
- With friction along the mode, d = ψ·Cφ ≠ 0, the motion on the centre manifold is d s' = -b(s) to leading order.
- Without, it is that of a mass, m s'' = -b(s), if energy is conserved or lost and all other stiffness is positive.

Either way the equilibrium is stable if b pushes back on both sides, and unstable otherwise, at whatever order k. What
satisfies neither premise is undecided. With several zero modes a conservative system is stable if b·s > 0 on all rays,
and unstable if b·s < 0 on one and nothing turns.

Source: Carr, *Applications of Centre Manifold Theory* (1981), §2; Kozlov & Furta, *Asymptotic Solutions of Strongly
Nonlinear Systems of Differential Equations* (2013), ch. 4 (inverses of Lagrange's theorem).

**The reduced force** along the zero modes of an equilibrium, and the multiple roots that it has. Let J be the Jacobian
of the balance r(y) = 0 at y₀, with almost null right vectors φ and left ones ψ. The bordered equations

    r(y) + β ψ = 0,    φ·(y - y₀) = s

are regular; they eliminate everything but the amplitudes s, and leave the reduced force b(s) = -β(s) with which the
equilibrium resists (Lyapunov-Schmidt). Near a root it is c₊ s^k on one side and c₋ |s|^k on the other. The exponent k
is read off b at amplitudes that shrink by a constant factor, where |b| shrinks by a constant factor too: so round-off,
which does not, is not taken for a force. A k-fold root is found by Newton's method only to ε^(1/k); between its
neighbours it is the simple root of the derivative b^(k-1).

Source: Govaerts, *Numerical Methods for Bifurcations of Dynamical Equilibria* (2000), ch. 3 (bordered systems).
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from lagjax.analysis import balance as equations
from lagjax.analysis.balance import MOMENTUM, Steady
from lagjax.jaxtools import compiled
from lagjax.mechanics import applied_force
from lagjax.numerics import newton_in_python, null_space, with_value

# Amplitudes that are evaluated together, half of them on each side.
SAMPLES = 64
NEWTON_STEPS = 10
# Stiffness, relative to the typical one, along a valley in which a search has stopped short of a multiple root.
CREEPS_BELOW = 1e-2
# Exponents of neighbouring amplitudes agree to this; round-off has no exponent.
SAME_EXPONENT, WINDOW = 0.15, 4


class Side(NamedTuple):
    """The first term on one side: its sign, its exponent, and the smallest amplitude at which it shows."""

    sign: float
    exponent: float
    amplitude: float


class Bordered(NamedTuple):
    """The equations about an equilibrium y₀ (N,): units of rows and columns, and the null vectors in these units."""

    steady: Steady
    y: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    right: np.ndarray
    left: np.ndarray


def soft_below(dtype) -> float:
    """Stiffness below this part of the typical one may be that of a multiple root, which is off by ε^(1/k)."""
    return 1e2 * float(np.sqrt(np.finfo(dtype).eps))


@compiled
def values_at(steady: Steady, points):
    """The imbalance and its Jacobian at many points."""
    return jax.vmap(lambda y: with_value(lambda y: equations.balance(steady, y), y))(points)


def padded(points, dtype):
    """Points (B, N), repeated to the number for which the program is compiled."""
    return np.resize(points, (SAMPLES, points.shape[1])).astype(dtype)


def bordered_at(steady, y, size, unseen, soft=None) -> Bordered:
    """The null vectors of the balance at y: of positions, except the symmetries and the `unseen` coordinates."""
    soft = soft_below(steady.t.dtype) if soft is None else soft
    dtype, n = np.dtype(steady.t.dtype), steady.n
    y = np.asarray(y, float)
    unit = size if size > 0 else 1.0
    # The row of a single number has no scale of its own, so it is taken at displaced points too.
    shifts = np.random.default_rng(0).uniform(-0.5, 0.5, (SAMPLES, y.size)) * unit
    shifts[0], shifts[:, n:] = 0.0, 0.0
    _, jacobians = (np.asarray(x, float) for x in values_at(steady, (y + shifts).astype(dtype)))
    jacobian = jacobians[0]

    def positive(x: np.ndarray):
        return np.where(x > 0, x, 1.0)

    usable = np.where(np.isfinite(jacobians), np.abs(jacobians), 0.0)
    rows = positive(np.max(np.median(usable, axis=0)[:, :n], axis=1) * unit)
    of_columns = np.max(np.abs(jacobian) / rows[:, None], axis=0)
    columns = np.concatenate([np.full(n, unit), 1 / positive(of_columns[n:])])
    matrix = jacobian / rows[:, None] * columns[None, :]
    along = np.asarray(fields_at(steady, y[:n].astype(dtype)), float)
    extra = np.zeros((len(along) + len(unseen), y.size))
    extra[: len(along), :n] = along / positive(np.max(np.abs(along), axis=1, initial=0.0))[:, None]
    extra[np.arange(len(unseen)) + len(along), unseen] = 1.0
    # Multipliers of dependent constraints are no motion, and combinations of constraints are no force.
    right = _with_part(_almost_null(np.concatenate([matrix, extra]), soft), n)
    left = _with_part(_almost_null(matrix.T, soft), n)
    if left.shape[1] > right.shape[1]:
        # Unseen coordinates and symmetries have no reduced force.
        of_extra = extra[:, :n] / rows[:n] if len(extra) else extra[:, :n]
        kept = left.copy()
        for row in np.linalg.qr(of_extra.T)[0].T if len(extra) else ():
            weights = row @ kept[:n]
            if np.linalg.norm(weights) > 1e-8:
                kept = kept @ null_space(weights[None, :])
        left = kept
    return Bordered(steady, y, rows, columns, right, left)


def _almost_null(matrix, below):
    """The right singular vectors (N, r) of the singular values up to `below`."""
    _, sizes, right = np.linalg.svd(matrix)
    return right[np.sum(sizes > below) :].T


def _with_part(vectors, n):
    """Combinations of null vectors (N, r) that have a part among the first n unknowns."""
    if not vectors.shape[1]:
        return vectors
    _, sizes, combine = np.linalg.svd(vectors[:n], full_matrices=False)
    return vectors @ combine[sizes > 1e-8].T


@compiled
def fields_at(steady, x):
    """The velocity along each symmetry at unit rate."""
    return steady.fields(x)


def reduced(bordered: Bordered, amplitudes: np.ndarray):
    """The reduced force b (B, z) at amplitudes s (B, z), and the unknowns there; NaN where there is no solution."""
    steady, y0, rows, columns, right, left = bordered
    dtype, z, count = np.dtype(steady.t.dtype), right.shape[1], len(amplitudes)
    y = y0 + columns * (amplitudes @ right.T)
    units = np.append(columns, np.ones(z))

    def step(both):
        y, beta = both[:, : y0.size], both[:, y0.size :]
        r, jacobian = (np.asarray(x, float)[:count] for x in values_at(steady, padded(y, dtype)))
        matrix = np.zeros((count, len(rows) + z, y0.size + z))
        matrix[:, : len(rows), : y0.size] = jacobian / rows[:, None] * columns
        matrix[:, : len(rows), y0.size :] = left
        matrix[:, len(rows) :, : y0.size] = right.T
        off = np.concatenate([r / rows + beta @ left.T, ((y - y0) / columns) @ right - amplitudes], axis=1)
        usable = np.all(np.isfinite(matrix), axis=(1, 2)) & np.all(np.isfinite(off), axis=1)
        inverse = np.linalg.pinv(np.where(usable[:, None, None], matrix, 0.0), rcond=1e-11)
        return units * np.einsum("bij,bj->bi", inverse, np.where(usable[:, None], off, np.nan))

    with np.errstate(all="ignore"):
        found = newton_in_python(step, np.concatenate([y, np.zeros((count, z))], axis=1), NEWTON_STEPS)
    assert found is not None
    last = np.max(np.abs(found.step[:, : y0.size] / columns), axis=1)
    reached = (last <= 1e-6 * np.max(np.abs(amplitudes), axis=1))[:, None]
    return np.where(reached, -found.y[:, y0.size :], np.nan), np.where(reached, found.y[:, : y0.size], np.nan)


def reduced_force(bordered, size):
    """Amplitudes (A,), ascending, and b at -A ... -a, a ... A."""
    # Where nothing says how large the positions are, a wider range.
    steps = np.arange(2, 2 + SAMPLES // 2)[::-1] * (1.0 if size > 0 else 2.0)
    amplitudes = 2.0**-steps
    return amplitudes, reduced(bordered, np.concatenate([-amplitudes[::-1], amplitudes])[:, None])[0][:, 0]


def first_term(amplitudes, b) -> Side | None:
    """The first term of b on one side: from the smallest amplitude on at which |b| has an exponent."""
    order = np.argsort(amplitudes)
    s, b = np.asarray(amplitudes)[order], np.asarray(b)[order]
    with np.errstate(all="ignore"):
        exponents = np.diff(np.log2(np.abs(b))) / np.diff(np.log2(s))
    for i in range(len(exponents) - WINDOW + 1):
        some = exponents[i : i + WINDOW]
        same_sign = np.all(np.sign(b[i : i + WINDOW + 1]) == np.sign(b[i]))
        if same_sign and np.all(np.isfinite(some)) and np.ptp(some) <= SAME_EXPONENT and np.median(some) > 0.5:
            return Side(float(np.sign(b[i])), float(np.median(some)), float(s[i]))
    return None


def between(bordered, side: Side) -> np.ndarray:
    """The k-fold root to full accuracy: the simple root of the (k-1)-th derivative of b between its neighbours."""
    k = round(side.exponent)
    if abs(k - side.exponent) > SAME_EXPONENT or k < 2 or k > 9:
        return bordered.y
    reach = min(0.2, max(64 * side.amplitude, 0.05))
    s = reach * _nodes()
    b, _ = reduced(bordered, s[:, None])
    if not np.all(np.isfinite(b)):
        return bordered.y
    derivative = np.polynomial.Chebyshev.fit(s, b[:, 0], min(k + 10, 24), domain=(-reach, reach)).deriv(k - 1)
    roots = derivative.roots()
    roots = roots[(np.abs(roots.imag) <= 1e-9 * reach) & (np.abs(roots.real) <= 4 * side.amplitude)].real
    if not roots.size:
        return bordered.y
    _, y = reduced(bordered, np.full((1, 1), roots[np.argmin(np.abs(roots))]))
    y, n = y[0], bordered.steady.n
    # A root at zero has no size that could say what is round-off there; the search has one.
    if np.max(np.abs(y / bordered.columns)[:n]) < np.sqrt(np.finfo(bordered.steady.t.dtype).eps):
        y = np.where(np.arange(y.size) < n, 0.0, y)
    return y if np.all(np.isfinite(y)) else bordered.y


def _nodes():
    """Chebyshev's nodes between -1 and 1."""
    return np.cos(np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES)


def nearest(steady: Steady, x, size: float, unseen: np.ndarray) -> np.ndarray | None:
    """The multiple root of a system at rest to which a search at `x` (n,) creeps along a curved valley, or None."""
    dtype = np.dtype(steady.t.dtype)
    y = np.concatenate([x, np.zeros(steady.m)])
    r, jacobian = (np.asarray(z)[0] for z in values_at(steady, padded(y[None], dtype)))
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(jacobian))):
        return None
    # Multipliers enter linearly.
    y[steady.n :] = -np.linalg.lstsq(jacobian[:, steady.n :], r, rcond=None)[0]
    bordered = bordered_at(steady, y, size, np.flatnonzero(unseen), CREEPS_BELOW)
    if bordered.right.shape[1] != 1 or bordered.left.shape[1] != 1:
        return None
    y = _multiple_root(bordered)
    if y is None:
        return None
    bordered = bordered_at(steady, y, size, np.flatnonzero(unseen))
    if bordered.right.shape[1] != 1 or bordered.left.shape[1] != 1:
        return None
    amplitudes, b = reduced_force(bordered, size)
    term = first_term(amplitudes, b[SAMPLES // 2 :])
    return None if term is None else between(bordered, term)[: steady.n]


def _multiple_root(bordered: Bordered) -> np.ndarray | None:
    """The unknowns at the root of the reduced force nearest to amplitude zero; None beyond a tenth of the size.

    At a k-fold root, b/b' = (s - s₀)/k + ... has a simple one, which is read off where b is larger than round-off.
    """
    s = 0.1 * _nodes()
    b = reduced(bordered, s[:, None])[0][:, 0]
    if not np.all(np.isfinite(b)):
        return None
    slope = np.polynomial.Chebyshev.fit(s, b, 16, domain=(-0.1, 0.1)).deriv()(s)
    seen = (np.abs(b) > 1e-8 * np.max(np.abs(b))) & (slope != 0)
    if np.sum(seen) < SAMPLES // 4:
        return None
    roots = np.polynomial.Chebyshev.fit(s[seen], b[seen] / slope[seen], 7, domain=(-0.1, 0.1)).roots()
    roots = roots[(np.abs(roots.imag) <= 1e-3) & (np.abs(roots.real) <= 0.1)].real
    if not roots.size:
        return None
    _, near = reduced(bordered, np.full((1, 1), roots[np.argmin(np.abs(roots))]))
    return near[0] if np.all(np.isfinite(near)) else None


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
