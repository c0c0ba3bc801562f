"""Critical points of a branch of equilibria: its equations, extended systems solved by Newton's method, derivatives.

`balance.py` gives more equations than unknowns where some are redundant (redundant constraints, a symmetry), and fewer
independent ones where the solutions form a family. At a start with Jacobian `J = U Σ Vᵀ` of rank r, the r combinations
`U_rᵀ r(y)` are kept, and the n - r directions V_0 of the null space, in which y is free, are held fixed:

    E(y, μ) = (U_rᵀ r(y, μ), V_0ᵀ (y - y_0)) = 0,    as many equations as unknowns

z = (y, μ) is measured in units in which the entries of the Jacobian and the range of μ are of order one.

Critical points are regular solutions of extended systems. With ψ, the left null vector of E_y,

    fold            E = 0,         E_yᵀ ψ = 0,                ψ·ψ = 1
    branch point    E + β ψ = 0,   E_yᵀ ψ = 0,   E_μ·ψ = 0,   ψ·ψ = 1          (β = 0 where the branches do meet)
    multiple zero   E = 0,         E_y φ = 0,                 φ·φ₀ = 1
    flutter         E = 0,         D(iω) w = 0,               w₀*·w = 1
    collision       flutter, and   D(iω) w₂ + D'(iω) w = 0,   w₀*·w₂ = 0

where `D(s) = K + s C + s² M`, bordered by the constraints, is the matrix of departures e^(st). A collision of two
frequencies without damping has two more equations than unknowns; they are consistent because D is symmetric.

Source: Moore & Spence, SIAM J. Numer. Anal. 17 (1980) 567 (folds); Moore, *Numer. Funct. Anal. Optim.* 2 (1980) 441
(branch points); Govaerts, *Numerical Methods for Bifurcations of Dynamical Equilibria*, ch. 3-5.

Along a branch of steady motions, monitored from point to point are the sign of `det (J; τ)`, which changes where
another branch crosses (also where this one only touches the critical parameter, as the side branch of a pitchfork
does); the sign of τ_μ, which changes at a fold; the number of growing roots; and the number of negative eigenvalues of
E_y, which changes by two where two vanish together.

Source: Allgower & Georg, *Introduction to Numerical Continuation Methods*, §8.1 (the determinant).

**Between two points of a branch** the extended systems are solved, and what is found is classified. At a branch point
the two directions are the roots of the algebraic bifurcation equation: with b₁, b₂ a basis of the null space of `(E_y,
E_μ)`, and τ = α b₁ + β b₂,

    ψ·D²E[τ, τ] = a α² + 2 b α β + c β² = 0

If one of them leaves the parameter constant (τ_μ = 0), the point is a pitchfork or a line of equilibria; otherwise it
is transcritical.

Source: Keller, *Lectures on Numerical Methods in Bifurcation Problems* (1987), §5.20-5.26; Govaerts, ch. 3.
"""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.analysis import balance as equations
from lagjax.analysis.arclength import BranchPoint, Number, Tracer, no_such_number, numbers_in
from lagjax.analysis.balance import Steady
from lagjax.analysis.equilibria import GROWS_ABOVE
from lagjax.jaxtools import compiled
from lagjax.numerics import independent_rows, newton_in_python

FOLD, BRANCH, MULTIPLE, FLUTTER, COLLISION, ESCAPE = "fold", "branch", "multiple", "flutter", "collision", "escape"


class ParameterPlace(eqx.Module):
    """The location of a branch's parameter: a number in `params`, or a held rate or momentum (`of_params` is None)."""

    name: str = eqx.field(static=True)
    of_params: Number | None
    entry: int = eqx.field(static=True, default=0)

    def put(self, s: Steady, value) -> Steady:
        """The problem with this value of the parameter."""
        if self.of_params is None:
            return replace(s, held=s.held.at[self.entry].set(value))
        return s.of(self.of_params.put(s.params, value))

    def get(self, s: Steady):
        """The value of the parameter in the problem."""
        return s.held[self.entry] if self.of_params is None else self.of_params.get(s.params)


class Frame(eqx.Module):
    """What is constant along all branches: the problem, its units, and the combinations of equations that are solved.

    `combinations` (r, R) is U_rᵀ, `free` (N - r, N) is V_0ᵀ, `reference` (N,) is y_0; `rows` (R,) and `columns` (N,)
    are the units of equations and unknowns, `unit` that of the parameter.
    """

    steady: Steady
    combinations: Float[Array, "r R"]
    free: Float[Array, "d N"]
    reference: Float[Array, " N"]
    rows: Float[Array, " R"]
    columns: Float[Array, " N"]
    unit: Float[Array, ""]
    place: ParameterPlace

    def split(self, z):
        """The problem at a point, and its unknowns in the user's units."""
        return self.place.put(self.steady, z[-1] * self.unit), z[:-1] * self.columns

    def residual(self, z):
        """E(y, μ)."""
        s, y = self.split(z)
        full = equations.balance(s, y) / self.rows
        return jnp.concatenate([self.combinations @ full, self.free @ (z[:-1] - self.reference)])


def place_of(steady: Steady, along: str) -> ParameterPlace:
    """Find a parameter by name, `"omega"`, `"spring.k"`, `"k[1]"`; or a held rate `"v.psi"` or momentum `"p.psi"`."""
    names = steady.model.names
    for kind, hold in (("v", equations.VELOCITY), ("p", equations.MOMENTUM)):
        held_names = [f"{kind}.{names[i]}" if names[i] != "q" else kind for i in steady.symmetries.places]
        held_names = held_names or [f"{kind}[{i}]" for i in range(steady.symmetries.count)]
        if along in held_names and steady.symmetries.hold == hold:
            return ParameterPlace(along, None, held_names.index(along))
    numbers = numbers_in(steady.params)
    if along not in numbers:
        more = 'and "v.psi" for the velocity of a cyclic coordinate psi that is held (with hold="momentum": "p.psi")'
        raise no_such_number(along, steady.params, more)
    return ParameterPlace(along, numbers[along])


@compiled
def evaluated(frame: Frame, z):
    """E, its Jacobian with respect to z, and the largest scaled residual of all equations."""
    jacobian = jax.jacfwd(frame.residual)(z)
    s, y = frame.split(z)
    full = equations.balance(s, y) / frame.rows
    return frame.residual(z), jacobian, jnp.max(jnp.abs(full), initial=0.0)


@compiled
def full_jacobian(steady: Steady, y):
    """The residuals of all equations at a point, and their Jacobian."""
    return equations.balance(steady, y), jax.jacfwd(lambda y: equations.balance(steady, y))(y)


@compiled
def outputs_at(frame: Frame, z):
    """The outputs of a point: parameter, q, v, multipliers, and the characteristic roots of its small motions."""
    s, y = frame.split(z)
    x, rates, multipliers = s.parts(y)
    u = s.velocity(x, rates)
    if s.m > 1:
        pushes = equations.forces(s, s.t, x, u)
        multipliers = equations.shortest_multipliers(pushes, multipliers @ pushes)
    by_name = s.model.split(multipliers) if s.m else {}
    jacobian = jax.jacfwd(lambda y: equations.balance(s, y))(y)
    roots = equations.characteristic_roots(s, y, jacobian, derivatives=False)
    return z[-1] * frame.unit, s.model.tree(x), s.model.tree(u), by_name, roots


@compiled
def curvature(frame: Frame, z, a, b):
    """The second derivative `D²E[a, b]`."""
    return jax.jvp(lambda z: jax.jvp(frame.residual, (z,), (a,))[1], (z,), (b,))[1]


def dynamic(frame: Frame, z):
    """K, C, M of `D(s)`, bordered by the independent constraints."""
    s, y = frame.split(z)
    d = equations.departures(s, y, jax.jacfwd(lambda y: equations.balance(s, y))(y))
    m = d.rows.shape[0]
    kept = independent_rows(d.rows) & jnp.any(d.rows != 0, axis=1) if m else jnp.zeros(0, bool)

    def keep(rows: Array):
        return jnp.where(kept[:, None], rows, 0.0)

    holonomic = s.model.holonomic[:, None]
    rows, slopes, none = keep(d.rows), keep(d.slopes), jnp.zeros((s.n, m), d.rows.dtype)
    corner = jnp.diag(jnp.where(kept, 0.0, 1.0)).astype(d.rows.dtype)
    stiffness = jnp.block([[d.stiffness, -keep(d.pushes).T], [jnp.where(holonomic, rows, slopes), corner]])
    damping = jnp.block([[d.damping, none], [jnp.where(holonomic, 0.0, rows), 0 * corner]])
    mass = jnp.block([[d.mass, none], [0 * rows, 0 * corner]])
    return stiffness, damping, mass


dynamic_at = compiled(dynamic)


def extended(kind: str, frame: Frame, big, guide):
    """The extended system whose regular solution is a critical point; `guide` normalises its null vectors."""
    n = frame.columns.size
    z, rest = big[: n + 1], big[n + 1 :]
    if kind in (FOLD, BRANCH, ESCAPE):
        psi = rest[:n]
        value, pull = jax.vjp(frame.residual, z)
        slopes = pull(psi)[0]
        norm = psi @ psi - 1
        if kind == FOLD:
            return jnp.concatenate([value, slopes[:n], norm[None]])
        if kind == ESCAPE:
            # The equations are linear and their solution is at infinity, so only its direction matters.
            return jnp.concatenate([z[:-1] - guide[:n], slopes[:n], norm[None]])
        return jnp.concatenate([value + rest[n] * psi, slopes, norm[None]])
    if kind == MULTIPLE:
        value, push = jax.linearize(frame.residual, z)
        return jnp.concatenate([value, push(jnp.append(rest, 0.0)), (rest @ guide - 1)[None]])
    value = frame.residual(z)
    stiffness, damping, mass = dynamic(frame, z)
    size = stiffness.shape[0]
    omega, (re, im, re2, im2) = rest[0], jnp.split(jnp.append(rest[1:], jnp.zeros(4 * size - rest.size + 1)), 4)
    rows = lax.stop_gradient(jnp.max(jnp.abs(stiffness) + jnp.abs(omega * damping) + omega**2 * jnp.abs(mass), axis=1))
    rows = jnp.where(rows > 0, rows, 1.0)
    real, imaginary = (stiffness - omega**2 * mass) / rows[:, None], omega * damping / rows[:, None]

    def times(a: Array, b: Array):
        return (real @ a - imaginary @ b, real @ b + imaginary @ a)

    def unit(a: Array, b: Array, one: Array):
        return jnp.stack([guide[:size] @ a + guide[size:] @ b - one, guide[:size] @ b - guide[size:] @ a])

    parts = [value, *times(re, im), unit(re, im, 1.0)]
    if kind == COLLISION:
        # ω D'(iω), with D' = C + 2 i ω M.
        slope, turn = omega * damping / rows[:, None], 2 * omega**2 * mass / rows[:, None]
        first, second = times(re2, im2)
        parts += [first + slope @ re - turn @ im, second + slope @ im + turn @ re, unit(re2, im2, 0.0)]
    return jnp.concatenate(parts)


@compiled
def extended_at(kind: str, frame: Frame, big, guide):
    """The extended system and its Jacobian."""

    def residual(big: Array):
        return extended(kind, frame, big, guide)

    return residual(big), jax.jacfwd(residual)(big)


@compiled
def extended_by_params(kind: str, frame: Frame, big, guide):
    """The derivative of the extended system by each number in `params`, a tree like `params` of (rows, ...)."""
    floats, rest = eqx.partition(frame.steady.params, eqx.is_inexact_array)

    def residual(floats):
        steady = frame.steady.of(eqx.combine(floats, rest))
        return extended(kind, replace(frame, steady=steady), big, guide)

    return jax.jacfwd(residual)(floats)


class SteadyTracer(Tracer):
    """Steady motions of a `Frame`. `fastest`: the size of the fastest root so far, the unit of the roots' round-off."""

    def __init__(self, frame: Frame, low: float, high: float):
        super().__init__(low, high)
        self.frame, self.fastest = frame, 0.0
        size, self.positions = frame.columns.size, frame.steady.n
        self.weights = np.zeros(size + 1)
        self.weights[: self.positions] = 1.0
        self.weights[-1] = 1.0
        self.dtype = np.dtype(frame.columns.dtype)
        self.unit = float(frame.unit)

    def at(self, z):
        value, jacobian, largest = jax.tree.map(np.asarray, evaluated(self.frame, z.astype(self.dtype)))
        return value, jacobian, float(largest)

    def described(self, z, jacobian, tangent) -> BranchPoint:
        outputs = jax.tree.map(np.asarray, outputs_at(self.frame, z.astype(self.dtype)))
        sign = np.linalg.slogdet(np.concatenate([jacobian, (self.weights * tangent)[None]]))[0]
        negative = int(np.sum(np.linalg.eigvals(jacobian[:, :-1]).real < 0))
        return BranchPoint(z, jacobian, tangent, float(sign), outputs, self._growing(outputs[-1]), negative)

    def _growing(self, roots) -> int | None:
        """The number of growing roots; None if the roots are not known."""
        known = roots[np.isfinite(roots)]
        if not known.size:
            return None
        self.fastest = max(self.fastest, float(np.max(np.abs(known))))
        return int(np.sum(known.real > GROWS_ABOVE[self.dtype] * self.fastest))


NEWTON = 12
# A direction whose component along the parameter is smaller leaves the parameter constant.
ACROSS = 1e-5
# Changes of the parameter below this fraction of its range count as none.
CONSTANT = 1e-9
# Branches meet where the unfolding β of a branch point is smaller; the equations are scaled to order one.
MEETS = 1e-8


@dataclass
class CriticalPoint:
    """A critical point: its kind, z, the tangents of crossing branches, a frequency, the parameter's derivatives."""

    kind: str
    z: np.ndarray
    directions: list[np.ndarray]
    frequency: float
    derivative: Any
    accuracy: float
    used: list[np.ndarray]
    located: bool = True


def between(tracer: SteadyTracer, a: BranchPoint, b: BranchPoint) -> list[CriticalPoint]:
    """All critical points between two neighbouring points of a branch."""
    found = []
    if max(abs(b.z[-1] - a.z[-1]), abs(a.tangent[-1]), abs(b.tangent[-1])) < CONSTANT:
        # On a line of equilibria only round-off changes.
        return []
    crosses, folds = a.sign * b.sign < 0, a.tangent[-1] * b.tangent[-1] < 0
    if crosses and (point := _branch_point(tracer, a, b)):
        found.append(point)
    if folds and not found:
        found.append(_fold(tracer, a, b))
    known = a.growing is not None and b.growing is not None
    if known and a.growing != b.growing and not found and (point := _loses_stability(tracer, a, b)):
        found.append(point)
    if not found and (a.negative - b.negative) % 2 == 0 and a.negative != b.negative:
        point = _multiple_zero(tracer, *_halved(tracer, a, b, lambda p: p.negative))
        found += [point] if point else []
    return found


def _halved(tracer, a, b, count_of):
    """Bisect a branch between a and b, where a count changes: two points much nearer to the change."""
    low, high, left, right = 0.0, 1.0, a, b
    for _ in range(14):
        share = 0.5 * (low + high)
        middle = tracer.between(a, b, share)
        if middle is None or count_of(middle) is None:
            break
        if count_of(middle) == count_of(left):
            low, left = share, middle
        else:
            high, right = share, middle
    return left, right


def _null_vectors(jacobian):
    """Approximate left and right null vectors of E_y."""
    u, _, vt = np.linalg.svd(jacobian[:, :-1])
    return u[:, -1], vt[-1]


def _guess_between(tracer, a, b, share):
    """A first guess for z between two points."""
    share = float(np.clip(share, 0.02, 0.98))
    point = tracer.between(a, b, share)
    return point.z if point else a.z + share * (b.z - a.z)


def _inside(tracer, a, b, z):
    """Whether a solution lies between the points, or nearly so."""
    step = b.z - a.z
    length = np.sqrt(tracer.weights @ step**2)
    share = (tracer.weights * step) @ (z - a.z) / length**2
    aside = z - a.z - share * step
    return -0.2 < share < 1.2 and np.sqrt(tracer.weights @ aside**2) < 0.5 * length


def _branch_point(tracer, a, b):
    sizes = [np.linalg.slogdet(np.concatenate([p.jacobian, (tracer.weights * p.tangent)[None]]))[1] for p in (a, b)]
    share = 1 / (1 + np.exp(np.clip(sizes[1] - sizes[0], -50, 50)))
    z = _guess_between(tracer, a, b, share)
    psi, _ = _null_vectors(tracer.at(z)[1])
    big = _newton(tracer, BRANCH, np.concatenate([z, psi, [0.0]]), np.zeros(1))
    if big is None or not _inside(tracer, a, b, big[0][: z.size]):
        return None
    big, accuracy = big
    if abs(big[-1]) > MEETS:
        return None
    directions = _directions(tracer, big)
    if not directions:
        return None
    kind = "pitchfork" if any(abs(t[-1]) < ACROSS for t in directions) else "transcritical"
    return CriticalPoint(
        kind, big[: z.size], directions, 0.0, _derivative(tracer, BRANCH, big, np.zeros(1)), accuracy, []
    )


def _directions(tracer, big):
    """The unit tangents of both branches through a branch point."""
    n = tracer.frame.columns.size
    z, psi = big[: n + 1], big[n + 1 : 2 * n + 1]
    jacobian = tracer.at(z)[1]
    basis = np.linalg.svd(jacobian)[2][-2:]

    def form(i: int, j: int) -> float:
        return float(psi @ np.asarray(curvature(tracer.frame, *tracer.cast(z, basis[i], basis[j]))))

    a, b, c = form(0, 0), form(0, 1), form(1, 1)
    disc, size = b * b - a * c, max(abs(a), abs(b), abs(c))
    if not np.isfinite(size) or size == 0 or disc <= 1e-9 * size**2:
        return []
    # This form gives both roots without cancellation.
    root = -(b + np.copysign(np.sqrt(disc), b))
    pairs = [(root, a), (c, root)]
    tangents = []
    for alpha, beta in pairs:
        t = alpha * basis[0] + beta * basis[1]
        tangents.append(t / np.sqrt(tracer.weights @ t**2))
    return tangents


def _fold(tracer, a, b):
    share = a.tangent[-1] / (a.tangent[-1] - b.tangent[-1])
    z = _guess_between(tracer, a, b, share)
    psi, phi = _null_vectors(tracer.at(z)[1])
    solved = _newton(tracer, FOLD, np.concatenate([z, psi]), np.zeros(1))
    if solved is None or not _inside(tracer, a, b, solved[0][: z.size]):
        off = np.sqrt(tracer.weights @ (b.z - a.z) ** 2) * max(abs(a.tangent[-1]), abs(b.tangent[-1]))
        return CriticalPoint("fold", z, [], 0.0, None, float(off), [], located=False)
    big, accuracy = solved
    return CriticalPoint("fold", big[: z.size], [], 0.0, _derivative(tracer, FOLD, big, np.zeros(1)), accuracy, [])


def escape(tracer: SteadyTracer, point: BranchPoint) -> CriticalPoint | None:
    """The critical point where the solution of linear equations goes to infinity, from a point far out."""
    n = tracer.frame.columns.size
    half, here = point.z.copy(), tracer.at(point.z)[1][:, :-1]
    half[:n] *= 0.5
    # The equations are linear if the Jacobian is the same halfway.
    if np.max(np.abs(tracer.at(half)[1][:, :-1] - here)) > 1e-9 * np.max(np.abs(here)):
        return None
    psi = np.linalg.svd(here)[0][:, -1]
    guide = np.append(np.zeros(n), 0.0)
    start = np.concatenate([np.zeros(n), point.z[-1:], psi])
    solved = _newton(tracer, ESCAPE, start, guide)
    if solved is None:
        return None
    big, accuracy = solved
    z = np.concatenate([point.z[:n], big[n : n + 1]])
    return CriticalPoint("escape", z, [], 0.0, _derivative(tracer, ESCAPE, big, guide), accuracy, [])


def _loses_stability(tracer, a, b):
    """Where the number of growing roots changes without a crossing branch or a fold: flutter, or several zeros."""
    left, right = _halved(tracer, a, b, lambda p: p.growing)
    few, many = (left, right) if left.growing < right.growing else (right, left)
    root = _newly_growing_root(few, many)
    size = np.nanmax(np.abs(many.outputs[-1]))
    if abs(root.imag) < 1e-3 * abs(size) and abs(root.imag) <= 30 * abs(root.real):
        return _multiple_zero(tracer, few, many) or _divergence(tracer, a, b, few, many)
    return _flutter(tracer, few, many, root)


def _newly_growing_root(few, many):
    """The root that grows at `many` but not at `few`."""
    known = many.outputs[-1][np.isfinite(many.outputs[-1])]
    grows = known[np.argsort(-known.real)][: many.growing]
    # Of several growing roots the slowest is the one that has just begun to grow.
    root = grows[np.argmin(grows.real)]
    return complex(root.real, abs(root.imag))


def _multiple_zero(tracer, few, many):
    z, n = few.z, tracer.frame.columns.size
    _, phi = _null_vectors(few.jacobian)
    solved = _newton(tracer, MULTIPLE, np.concatenate([z, phi]), phi)
    if solved is None or not _near(tracer, few, many, solved[0][: n + 1]):
        return None
    big, accuracy = solved
    derivative = _derivative(tracer, MULTIPLE, big, phi)
    return CriticalPoint("multiple zero", big[: n + 1], [], 0.0, derivative, accuracy, [])


def _divergence(tracer, a, b, few, many):
    """Where a root leaves zero while other roots are always zero.

    With k roots that are always zero the characteristic polynomial begins with `c s^k`, and c changes its sign. Its
    coefficients, computed from the roots, are accurate to round-off, although a zero of multiplicity k is off by the
    k-th root of round-off.
    """
    fastest = tracer.fastest

    def count_zeros(point: BranchPoint) -> int:
        return int(np.sum(np.abs(point.outputs[-1]) < 1e-5 * fastest))

    zeros = min(count_zeros(a), count_zeros(b))

    def product(roots):
        known = roots[np.isfinite(roots)]
        return float(np.poly(known / fastest)[known.size - zeros].real)

    best, off = tracer.zero_between(a, b, lambda point: product(point.outputs[-1])) or (many, np.inf)
    if off > tracer.eps**0.6 * tracer.size(best.z):
        return CriticalPoint("divergence", many.z, [], 0.0, None, float(np.max(np.abs(few.z - many.z))), [])
    derivative = _slopes(tracer, best, lambda z, other: product(other.point(z, best.tangent).outputs[-1]))
    return CriticalPoint("divergence", best.z, [], 0.0, derivative, off, [])


def _slopes(tracer, point, value):
    """Derivatives of the parameter at which `value(z, tracer)` is zero along a branch, by central differences."""
    number, steady = tracer.frame.place.of_params, tracer.frame.steady
    row = np.zeros_like(point.z)
    row[-1] = 1.0
    h = tracer.eps ** (1 / 3)

    def at(other, z, parameter):
        corrected = other.corrected(z, row, parameter)
        return np.nan if corrected is None else value(corrected, other)

    here = point.z[-1]
    by_parameter = (at(tracer, point.z, here + h) - at(tracer, point.z, here - h)) / (2 * h)
    floats, rest = eqx.partition(steady.params, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(floats)

    def by(i, entry):
        step = h * max(abs(float(np.ravel(leaves[i])[entry])), h)

        def moved(sign):
            leaf = np.array(leaves[i])
            leaf.reshape(-1)[entry] += sign * step
            params = eqx.combine(structure.unflatten([*leaves[:i], jnp.asarray(leaf), *leaves[i + 1 :]]), rest)
            frame = replace(tracer.frame, steady=steady.of(params))
            return at(SteadyTracer(frame, tracer.low, tracer.high), point.z, here)

        return -tracer.unit * (moved(1) - moved(-1)) / (2 * step) / by_parameter

    def is_parameter(i: int, entry: int) -> bool:
        return number is not None and leaves[i] is jax.tree.leaves(steady.params)[number.leaf] and entry == number.entry

    slopes = [np.reshape([0.0 if is_parameter(i, j) else by(i, j) for j in range(np.size(x))], np.shape(x))
             for i, x in enumerate(leaves)]  # fmt: skip
    return structure.unflatten(slopes)


def _near(tracer, a, b, z):
    return np.max(np.abs(tracer.weights * (z - a.z))) < 1e-2 + 10 * np.max(np.abs(b.z - a.z))


def _flutter(tracer, few, many, root):
    """The onset of flutter: a pair of roots that crosses the imaginary axis, or two pairs that meet on it."""
    n = tracer.frame.columns.size
    roots = many.outputs[-1][np.isfinite(many.outputs[-1])]
    omega = abs(root.imag)
    # Without damping the mirror image of a growing root decays, so two roots are near this point of the axis.
    roots_nearby = np.sum(np.abs(roots - 1j * omega) < max(4 * abs(root.real), 1e-9 * omega))
    kind = COLLISION if roots_nearby > 1 else FLUTTER
    stiffness, damping, mass = (np.asarray(x, float) for x in dynamic_at(tracer.frame, few.z.astype(tracer.dtype)))
    matrix = stiffness + 1j * omega * damping - omega**2 * mass
    size = np.max(np.abs(stiffness) + omega * np.abs(damping) + omega**2 * np.abs(mass), axis=1)
    matrix = matrix / np.where(size > 0, size, 1.0)[:, None]
    w = np.conj(np.linalg.svd(matrix)[2][-1])
    guide = np.concatenate([w.real, w.imag])
    start = [few.z, [omega], w.real, w.imag]
    if kind == COLLISION:
        slope = omega * (damping + 2j * omega * mass) / np.where(size > 0, size, 1.0)[:, None]
        second = -np.linalg.pinv(matrix, rcond=1e-5) @ (slope @ w)
        second = second - w * (np.conj(w) @ second)
        start += [second.real, second.imag]
    solved = _newton(tracer, kind, np.concatenate(start), guide)
    if solved is None or not _near(tracer, few, many, solved[0][: n + 1]):
        return CriticalPoint("flutter", few.z, [], omega, None, float(np.max(np.abs(few.z - many.z))), [])
    big, accuracy = solved
    return CriticalPoint(
        "flutter", big[: n + 1], [], abs(float(big[n + 1])), _derivative(tracer, kind, big, guide), accuracy, []
    )


def _newton(tracer, kind, big, guide):
    """Solve the extended system by Newton's method with steps of least norm; also returns the parameter's last step."""

    def step(big):
        value, jacobian = (np.asarray(x, float) for x in extended_at(kind, tracer.frame, *tracer.cast(big, guide)))
        finite = np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))
        return _least_squares(jacobian, value) if finite else None

    found = newton_in_python(step, big, NEWTON, enough=4 * tracer.eps, free=4, noise=tracer.eps**0.5)
    if found is None or not found.lengths[-1] < tracer.eps**0.6:
        return None
    return found.y, abs(float(found.step[tracer.frame.columns.size]))


def _least_squares(matrix, known):
    """The least-squares solution of least norm, with rows and columns scaled to one."""
    columns = np.max(np.abs(matrix), axis=0)
    columns = np.where(columns > 0, columns, 1.0)
    rows = np.max(np.abs(matrix / columns), axis=1)
    rows = np.where(rows > 0, rows, 1.0)
    scaled = matrix / columns / rows[:, None]
    known = (known.T / rows).T
    return (np.linalg.lstsq(scaled, known, rcond=1e-10)[0].T / columns).T


def _derivative(tracer, kind, big, guide):
    """The derivatives of the critical parameter by every number in `params`, a tree like `params`."""
    _, jacobian = extended_at(kind, tracer.frame, *tracer.cast(big, guide))
    by_params = extended_by_params(kind, tracer.frame, *tracer.cast(big, guide))
    n, unit = tracer.frame.columns.size, tracer.unit
    leaves, structure = jax.tree.flatten(by_params)
    if not leaves:
        return by_params
    flat = np.concatenate([np.asarray(x, float).reshape(np.shape(x)[0], -1) for x in leaves], axis=1)
    slopes = -unit * _least_squares(np.asarray(jacobian, float), flat)[n]
    places = np.cumsum([0, *(np.asarray(x)[0].size for x in leaves)])
    parts = [slopes[i:j].reshape(np.shape(x)[1:]) for i, j, x in zip(places, places[1:], leaves)]
    return jax.tree.unflatten(structure, parts)
