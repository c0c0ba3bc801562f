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

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.analysis import balance as equations
from lagjax.analysis.arclength import (
    NUMBER,
    Along,
    BranchPoint,
    BranchProblem,
    CriticalPoint,
    Monitor,
    count_changes,
    no_such_number,
    numbers_in,
    sign_changes,
)
from lagjax.analysis.balance import Steady
from lagjax.analysis.equilibria import GROWS_ABOVE
from lagjax.jaxtools import compiled
from lagjax.numerics import newton_in_python

FOLD, BRANCH, MULTIPLE, FLUTTER, COLLISION, ESCAPE = "fold", "branch", "multiple", "flutter", "collision", "escape"


HELD = "held"


def with_value(steady: Steady, along: Along, value) -> Steady:
    """The problem with this value of the parameter: a number in `params`, or a held rate or momentum."""
    if along.number is None:
        return replace(steady, held=steady.held.at[along.entry].set(value))
    return steady.of(along.number.put(steady.params, value))


def value_in(steady: Steady, along: Along):
    """The value of the parameter in the problem."""
    return steady.held[along.entry] if along.number is None else along.number.get(steady.params)


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
    along: Along

    def split(self, z):
        """The problem at a point, and its unknowns in the user's units."""
        return with_value(self.steady, self.along, z[-1] * self.unit), z[:-1] * self.columns

    def residual(self, z):
        """E(y, μ)."""
        s, y = self.split(z)
        full = equations.balance(s, y) / self.rows
        return jnp.concatenate([self.combinations @ full, self.free @ (z[:-1] - self.reference)])


def along_named(steady: Steady, name: str) -> Along:
    """Find a parameter by name, `"omega"`, `"spring.k"`, `"k[1]"`; or a held rate `"v.psi"` or momentum `"p.psi"`."""
    names = steady.model.names
    for kind, hold in (("v", equations.VELOCITY), ("p", equations.MOMENTUM)):
        held_names = [f"{kind}.{names[i]}" if names[i] != "q" else kind for i in steady.symmetries.places]
        held_names = held_names or [f"{kind}[{i}]" for i in range(steady.symmetries.count)]
        if name in held_names and steady.symmetries.hold == hold:
            return Along(name, HELD, None, held_names.index(name))
    numbers = numbers_in(steady.params)
    if name not in numbers:
        more = 'and "v.psi" for the velocity of a cyclic coordinate psi that is held (with hold="momentum": "p.psi")'
        raise no_such_number(name, steady.params, more)
    return Along(name, NUMBER, numbers[name])


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


class SteadyOutputs(NamedTuple):
    """The outputs of a point: the state, by name its multipliers, and the characteristic roots of its small motions."""

    parameter: Array
    q: PyTree
    v: PyTree
    multipliers: dict[str, Array]
    roots: Array


@compiled
def outputs_at(frame: Frame, z) -> SteadyOutputs:
    """The outputs of a point."""
    s, y = frame.split(z)
    x, rates, multipliers = s.parts(y)
    u = s.velocity(x, rates)
    if s.m > 1:
        pushes = equations.forces(s, s.t, x, u)
        multipliers = equations.shortest_multipliers(pushes, multipliers @ pushes)
    by_name = s.model.split(multipliers) if s.m else {}
    jacobian = jax.jacfwd(lambda y: equations.balance(s, y))(y)
    roots = equations.characteristic_roots(s, y, jacobian, derivatives=False)
    return SteadyOutputs(z[-1] * frame.unit, s.model.tree(x), s.model.tree(u), by_name, roots)


@compiled
def curvature(frame: Frame, z, a, b):
    """The second derivative `D²E[a, b]`."""
    return jax.jvp(lambda z: jax.jvp(frame.residual, (z,), (a,))[1], (z,), (b,))[1]


def dynamic(frame: Frame, z):
    """K, C, M of `D(s)`, bordered by the independent constraints."""
    s, y = frame.split(z)
    d = equations.departures(s, y, jax.jacfwd(lambda y: equations.balance(s, y))(y))
    d, kept = d.independent()
    holonomic, none = s.model.holonomic[:, None], jnp.zeros_like(d.rows.T)
    corner = jnp.diag(jnp.where(kept, 0.0, 1.0)).astype(d.rows.dtype)
    stiffness = jnp.block([[d.stiffness, -d.pushes.T], [jnp.where(holonomic, d.rows, d.slopes), corner]])
    damping = jnp.block([[d.damping, none], [jnp.where(holonomic, 0.0, d.rows), 0 * corner]])
    mass = jnp.block([[d.mass, none], [0 * d.rows, 0 * corner]])
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


# Newton's method for extended systems takes at most so many steps; a count is bisected so often before it begins.
NEWTON, HALVINGS = 12, 14
# A direction whose component along the parameter is smaller leaves the parameter constant.
ACROSS = 1e-5
# Branches meet where the unfolding β of a branch point is smaller; the equations are scaled to order one.
MEETS = 1e-8
# A branch whose last so many points agree in the parameter to this accuracy is a line of equilibria.
LINE, LINE_WITHIN = 40, 1e-9


class _Solution(NamedTuple):
    """A solution `big` of the extended system of a kind: z and null vectors; `accuracy` is the last step of μ."""

    problem: "SteadyProblem"
    kind: str
    big: np.ndarray
    guide: np.ndarray
    accuracy: float

    @property
    def z(self) -> np.ndarray:
        return self.big[: self.problem.frame.columns.size + 1]

    @property
    def rest(self) -> np.ndarray:
        return self.big[self.problem.frame.columns.size + 1 :]

    def named(self, kind: str, **more) -> CriticalPoint:
        """The critical point, with the derivatives of its parameter by every number in `params`."""
        return CriticalPoint(kind, self.z, self.accuracy, derivative=self._derivative(), **more)

    def _derivative(self):
        given = self.kind, self.problem.frame, *self.problem.cast(self.big, self.guide)
        _, jacobian = extended_at(*given)
        by_params = extended_by_params(*given)
        leaves, structure = jax.tree.flatten(by_params)
        if not leaves:
            return by_params
        flat = np.concatenate([np.asarray(x, float).reshape(np.shape(x)[0], -1) for x in leaves], axis=1)
        of_parameter = _least_squares(np.asarray(jacobian, float), flat)[self.z.size - 1]
        slopes = -self.problem.unit * of_parameter
        places = np.cumsum([0, *(np.asarray(x)[0].size for x in leaves)])
        parts = [slopes[i:j].reshape(np.shape(x)[1:]) for i, j, x in zip(places, places[1:], leaves)]
        return jax.tree.unflatten(structure, parts)


def _solved(problem, kind, start, guide=np.zeros(1)) -> _Solution | None:
    """Solve an extended system by Newton's method with steps of least norm; None if it does not converge."""

    def step(big):
        value, jacobian = (np.asarray(x, float) for x in extended_at(kind, problem.frame, *problem.cast(big, guide)))
        finite = np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))
        return _least_squares(jacobian, value) if finite else None

    limits = {"enough": 4 * problem.eps, "noise": problem.eps**0.5}
    found = newton_in_python(step, np.concatenate(start), NEWTON, free=4, **limits)
    if found is None or not found.lengths[-1] < problem.eps**0.6:
        return None
    return _Solution(problem, kind, found.y, guide, abs(float(found.step[problem.frame.columns.size])))


def _least_squares(matrix, known):
    """The least-squares solution of least norm, with rows and columns scaled to one."""
    columns = np.max(np.abs(matrix), axis=0)
    columns = np.where(columns > 0, columns, 1.0)
    rows = np.max(np.abs(matrix / columns), axis=1)
    rows = np.where(rows > 0, rows, 1.0)
    scaled = matrix / columns / rows[:, None]
    known = (known.T / rows).T
    return (np.linalg.lstsq(scaled, known, rcond=1e-10)[0].T / columns).T


def _null_vectors(jacobian):
    """Approximate left and right null vectors of E_y."""
    u, _, vt = np.linalg.svd(jacobian[:, :-1])
    return u[:, -1], vt[-1]


def _guess_between(problem, a, b, share):
    """A first guess for z between two points, and the left null vector there."""
    share = float(np.clip(share, 0.02, 0.98))
    point = problem.between(a, b, share)
    z = point.z if point else a.z + share * (b.z - a.z)
    return z, _null_vectors(problem.residual(z)[1])[0]


def _inside(problem, a, b, z):
    """Whether a solution lies between the points, or nearly so."""
    step, length = b.z - a.z, problem.length(b.z - a.z)
    share = (problem.weights * step) @ (z - a.z) / length**2
    return -0.2 < share < 1.2 and problem.length(z - a.z - share * step) < 0.5 * length


def _near(problem, a, b, z):
    """Whether a solution lies near two points that are close to each other."""
    return np.max(np.abs(problem.weights * (z - a.z))) < 1e-2 + 10 * np.max(np.abs(b.z - a.z))


def _branch_point(problem, a, b) -> CriticalPoint | None:
    """Where another branch crosses; None if there is none."""
    sizes = [np.linalg.slogdet(np.concatenate([p.jacobian, (problem.weights * p.tangent)[None]]))[1] for p in (a, b)]
    share = 1 / (1 + np.exp(np.clip(sizes[1] - sizes[0], -50, 50)))
    solved = _solved(problem, BRANCH, [*_guess_between(problem, a, b, share), [0.0]])
    if solved is None or not _inside(problem, a, b, solved.z) or abs(solved.rest[-1]) > MEETS:
        return None
    directions = _directions(problem, solved.z, solved.rest[:-1])
    if not directions:
        return None
    kind = "pitchfork" if any(abs(t[-1]) < ACROSS for t in directions) else "transcritical"
    return solved.named(kind, directions=directions)


def _directions(problem, z, psi):
    """The unit tangents of both branches through a branch point."""
    basis = np.linalg.svd(problem.residual(z)[1])[2][-2:]

    def form(i: int, j: int) -> float:
        return float(psi @ np.asarray(curvature(problem.frame, *problem.cast(z, basis[i], basis[j]))))

    a, b, c = form(0, 0), form(0, 1), form(1, 1)
    disc, size = b * b - a * c, max(abs(a), abs(b), abs(c))
    if not np.isfinite(size) or size == 0 or disc <= 1e-9 * size**2:
        return []
    # This form gives both roots without cancellation.
    root = -(b + np.copysign(np.sqrt(disc), b))
    tangents = [alpha * basis[0] + beta * basis[1] for alpha, beta in ((root, a), (c, root))]
    return [t / problem.length(t) for t in tangents]


def _fold(problem, a, b) -> CriticalPoint:
    """Where the parameter turns."""
    z, psi = _guess_between(problem, a, b, a.tangent[-1] / (a.tangent[-1] - b.tangent[-1]))
    solved = _solved(problem, FOLD, [z, psi])
    if solved is None or not _inside(problem, a, b, solved.z):
        off = problem.length(b.z - a.z) * max(abs(a.tangent[-1]), abs(b.tangent[-1]))
        return CriticalPoint("fold", z, float(off), located=False)
    return solved.named("fold")


def _loses_stability(problem, a, b) -> CriticalPoint | None:
    """Where the number of growing roots changes without a crossing branch or a fold: flutter, or several zeros."""
    left, right = problem.halved(a, b, lambda p: p.growing, HALVINGS)
    few, many = (left, right) if left.growing < right.growing else (right, left)
    root = _newly_growing_root(many)
    size = np.nanmax(np.abs(many.outputs.roots))
    if abs(root.imag) < 1e-3 * abs(size) and abs(root.imag) <= 30 * abs(root.real):
        return _multiple_zero(problem, few, many) or _divergence(problem, a, b, few, many)
    return _flutter(problem, few, many, root)


def _newly_growing_root(many):
    """The root that has just begun to grow: of several growing ones the slowest."""
    known = many.outputs.roots[np.isfinite(many.outputs.roots)]
    grows = known[np.argsort(-known.real)][: many.growing]
    root = grows[np.argmin(grows.real)]
    return complex(root.real, abs(root.imag))


def _two_zeros(problem, a, b) -> CriticalPoint | None:
    """Where two eigenvalues of E_y vanish together."""
    return _multiple_zero(problem, *problem.halved(a, b, lambda p: p.negative, HALVINGS))


def _multiple_zero(problem, few, many) -> CriticalPoint | None:
    """Where the stiffness vanishes in several directions, next to a point."""
    _, phi = _null_vectors(few.jacobian)
    solved = _solved(problem, MULTIPLE, [few.z, phi], phi)
    return None if solved is None or not _near(problem, few, many, solved.z) else solved.named("multiple zero")


def _divergence(problem, a, b, few, many) -> CriticalPoint:
    """Where a root leaves zero while other roots are always zero.

    With k roots that are always zero the characteristic polynomial begins with `c s^k`, and c changes its sign. Its
    coefficients, computed from the roots, are accurate to round-off, although a zero of multiplicity k is off by the
    k-th root of round-off.
    """
    fastest = problem.fastest
    zeros = min(int(np.sum(np.abs(point.outputs.roots) < 1e-5 * fastest)) for point in (a, b))

    def product(point: BranchPoint) -> float:
        known = point.outputs.roots[np.isfinite(point.outputs.roots)]
        return float(np.poly(known / fastest)[known.size - zeros].real)

    best, off = problem.zero_between(a, b, product) or (many, np.inf)
    if off > problem.eps**0.6 * problem.size(best.z):
        return CriticalPoint("divergence", many.z, float(np.max(np.abs(few.z - many.z))))
    derivative = _slopes(problem, best, lambda z, other: product(other.point(z, best.tangent)))
    return CriticalPoint("divergence", best.z, off, derivative=derivative)


def _slopes(problem, point, value):
    """Derivatives of the parameter at which `value(z, problem)` is zero along a branch, by central differences."""
    number, steady = problem.along.number, problem.frame.steady
    row = np.eye(point.z.size)[-1]
    h = problem.eps ** (1 / 3)

    def at(other, z, parameter):
        corrected = other.corrected(z, row, parameter)
        return np.nan if corrected is None else value(corrected, other)

    here = point.z[-1]
    by_parameter = (at(problem, point.z, here + h) - at(problem, point.z, here - h)) / (2 * h)
    floats, rest = eqx.partition(steady.params, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(floats)

    def by(i, entry):
        step = h * max(abs(float(np.ravel(leaves[i])[entry])), h)

        def moved(sign):
            leaf = np.array(leaves[i])
            leaf.reshape(-1)[entry] += sign * step
            params = eqx.combine(structure.unflatten([*leaves[:i], jnp.asarray(leaf), *leaves[i + 1 :]]), rest)
            frame = replace(problem.frame, steady=steady.of(params))
            return at(SteadyProblem(frame, problem.low, problem.high), point.z, here)

        return -problem.unit * (moved(1) - moved(-1)) / (2 * step) / by_parameter

    def is_parameter(i: int, entry: int) -> bool:
        return number is not None and leaves[i] is jax.tree.leaves(steady.params)[number.leaf] and entry == number.entry

    slopes = [np.reshape([0.0 if is_parameter(i, j) else by(i, j) for j in range(np.size(x))], np.shape(x))
             for i, x in enumerate(leaves)]  # fmt: skip
    return structure.unflatten(slopes)


def _flutter(problem, few, many, root) -> CriticalPoint:
    """The onset of flutter: a pair of roots that crosses the imaginary axis, or two pairs that meet on it."""
    roots = many.outputs.roots[np.isfinite(many.outputs.roots)]
    omega = abs(root.imag)
    # Without damping the mirror image of a growing root decays, so two roots are near this point of the axis.
    roots_nearby = np.sum(np.abs(roots - 1j * omega) < max(4 * abs(root.real), 1e-9 * omega))
    kind = COLLISION if roots_nearby > 1 else FLUTTER
    stiffness, damping, mass = (np.asarray(x, float) for x in dynamic_at(problem.frame, few.z.astype(problem.dtype)))
    matrix = stiffness + 1j * omega * damping - omega**2 * mass
    size = np.max(np.abs(stiffness) + omega * np.abs(damping) + omega**2 * np.abs(mass), axis=1)
    matrix = matrix / np.where(size > 0, size, 1.0)[:, None]
    w = np.conj(np.linalg.svd(matrix)[2][-1])
    start = [few.z, [omega], w.real, w.imag]
    if kind == COLLISION:
        slope = omega * (damping + 2j * omega * mass) / np.where(size > 0, size, 1.0)[:, None]
        second = -np.linalg.pinv(matrix, rcond=1e-5) @ (slope @ w)
        second = second - w * (np.conj(w) @ second)
        start += [second.real, second.imag]
    solved = _solved(problem, kind, start, np.concatenate([w.real, w.imag]))
    if solved is None or not _near(problem, few, many, solved.z):
        return CriticalPoint("flutter", few.z, float(np.max(np.abs(few.z - many.z))), frequency=omega)
    return solved.named("flutter", frequency=abs(float(solved.rest[0])))


# The determinant, the direction of the parameter, the growing roots, and the negative eigenvalues of E_y.
MONITORS = (
    Monitor(lambda point: point.sign, sign_changes, _branch_point),
    Monitor(lambda point: point.tangent[-1], sign_changes, _fold),
    Monitor(lambda point: point.growing, count_changes, _loses_stability),
    Monitor(lambda point: point.negative, lambda a, b: a != b and (a - b) % 2 == 0, _two_zeros),
)


class SteadyProblem(BranchProblem):
    """Steady motions of a `Frame`. `fastest`: the size of the fastest root so far, the unit of the roots' round-off."""

    monitors, crossings = MONITORS, True

    def __init__(self, frame: Frame, low: float, high: float):
        super().__init__(low, high)
        self.frame, self.along, self.fastest = frame, frame.along, 0.0
        size, self.positions = frame.columns.size, frame.steady.n
        self.weights = np.where((np.arange(size + 1) < self.positions) | (np.arange(size + 1) == size), 1.0, 0.0)
        self.dtype = np.dtype(frame.columns.dtype)
        self.unit = float(frame.unit)

    def residual(self, z):
        value, jacobian, largest = jax.tree.map(np.asarray, evaluated(self.frame, z.astype(self.dtype)))
        return value, jacobian, float(largest)

    def described(self, z, jacobian, tangent) -> BranchPoint:
        outputs = jax.tree.map(np.asarray, outputs_at(self.frame, z.astype(self.dtype)))
        sign = np.linalg.slogdet(np.concatenate([jacobian, (self.weights * tangent)[None]]))[0]
        negative = int(np.sum(np.linalg.eigvals(jacobian[:, :-1]).real < 0))
        return BranchPoint(z, jacobian, tangent, float(sign), outputs, self._growing(outputs.roots), negative)

    def _growing(self, roots) -> int | None:
        """The number of growing roots; None if the roots are not known."""
        known = roots[np.isfinite(roots)]
        if not known.size:
            return None
        self.fastest = max(self.fastest, float(np.max(np.abs(known))))
        return int(np.sum(known.real > GROWS_ABOVE[self.dtype] * self.fastest))

    def ends(self, points, after, origin) -> str | None:
        if origin is not None and np.ptp([p.z[-1] for p in points[-LINE:]]) < LINE_WITHIN and len(points) >= LINE:
            origin.kind = "line of equilibria"
            return "a line of equilibria, which goes on"
        return None

    def escape(self, point) -> CriticalPoint | None:
        """Where the solution of linear equations goes to infinity."""
        n = self.frame.columns.size
        half, here = point.z.copy(), self.residual(point.z)[1][:, :-1]
        half[:n] *= 0.5
        # The equations are linear if the Jacobian is the same halfway.
        if np.max(np.abs(self.residual(half)[1][:, :-1] - here)) > 1e-9 * np.max(np.abs(here)):
            return None
        psi = np.linalg.svd(here)[0][:, -1]
        solved = _solved(self, ESCAPE, [np.zeros(n), point.z[-1:], psi], np.zeros(n + 1))
        return solved and replace(solved.named("escape"), z=np.append(point.z[:n], solved.z[-1]))
