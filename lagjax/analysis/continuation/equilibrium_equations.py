"""The equations of a branch: those of steady motion with one parameter free, made square and scaled to order one.

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
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.analysis.continuation.arclength import BranchPoint, Tracer
from lagjax.analysis.equilibria import balance as equations
from lagjax.analysis.equilibria.balance import Steady
from lagjax.analysis.equilibria.equilibria import GROWS_ABOVE
from lagjax.analysis.params_by_name import Number, no_such_number, numbers_in
from lagjax.jaxtools import compiled
from lagjax.numerics import independent_rows

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
