"""The balance of forces in a steady motion, and the linear equations of small departures; the table of steady motions.

A steady motion follows a symmetry at constant rates Ω: its velocity is `u = V(x) = Σ Ω_k G_k(x)`, with one field G_k
for each symmetry. For a cyclic coordinate G_k is the unit vector of that coordinate, and Ω = 0 means rest. The
acceleration is `a = (∂V/∂x) u`, zero for cyclic coordinates, so Lagrange's equations become a balance,

    r(x, Ω, λ) = M a - F(t, x, u) - Aᵀ λ - B λ = 0,    g(t, x) = 0,    phi(t, x, u) = 0

(B λ: the part of a force that depends on multipliers). Either the rates or the momenta `p·G_k` are held fixed.

In the frame that moves along the symmetry a neighbouring motion is `x + ξ(t)`, with the velocity `V + ξ'` and the
acceleration `(∂V/∂x) V + 2 (∂V/∂x) ξ' + ξ''`. Substituting this into r and linearising gives

    K ξ + C ξ' + M ξ'' = Aᵀ δλ + B δλ

where `K = ∂r/∂ξ` contains the multipliers' -λ·∂²g.

Source: Marsden & Ratiu, *Introduction to Mechanics and Symmetry*, §8.9 (relative equilibria).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from lagjax.display import by_line, columns
from lagjax.jaxtools import is_traced, jitted
from lagjax.mechanics import describe, forcing_and_inertia, response
from lagjax.numerics import dense, independent_rows, lapack, reciprocal_condition, roots_beside_zeros
from lagjax.system import Model, System, constraints, coordinates

# The equations of motion count as singular below this reciprocal condition number.
SINGULAR_BELOW = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}
# The quantity held fixed for each symmetry.
VELOCITY, MOMENTUM = "velocity", "momentum"


class SteadySymmetries(eqx.Module):
    """The symmetries of a steady motion: cyclic coordinates by index, or fields `field(q, params)` shaped like v."""

    places: tuple[int, ...] = eqx.field(static=True, default=())
    fields: tuple[Callable, ...] = eqx.field(static=True, default=())
    hold: str | None = eqx.field(static=True, default=VELOCITY)

    @property
    def count(self) -> int:
        return len(self.places) + len(self.fields)


class Steady(eqx.Module):
    """The equations of steady motion near the positions `x0`; `held` (k,) are the held rates or momenta."""

    model: Model
    t: Float[Array, ""]
    held: Float[Array, " k"]
    x0: Float[Array, " n"]
    symmetries: SteadySymmetries = eqx.field(static=True)

    @property
    def system(self) -> System:
        return self.model.system

    @property
    def params(self) -> PyTree:
        return self.model.params

    @property
    def n(self) -> int:
        return self.model.n

    @property
    def m(self) -> int:
        return self.model.m

    def of(self, params: PyTree) -> "Steady":
        """The same with other parameters."""
        return Steady(self.model.of(params), self.t, self.held, self.x0, self.symmetries)

    @property
    def conservative(self) -> bool:
        """Whether there is neither a force nor dissipation."""
        return not self.system.is_forced

    def parts(self, y):
        """Split a vector of unknowns into positions, rates and multipliers."""
        k = self.symmetries.count
        return y[: self.n], y[self.n : self.n + k], y[self.n + k : self.n + k + self.m]

    def fields(self, x) -> Float[Array, "k n"]:
        """The velocity along each symmetry at unit rate."""
        rows = [jnp.asarray(np.eye(self.n)[i], x.dtype) for i in self.symmetries.places]
        q = self.model.tree(x)
        rows += [self.model.vector(field(q, self.params)).astype(x.dtype) for field in self.symmetries.fields]
        return jnp.stack(rows) if rows else jnp.zeros((0, self.n), x.dtype)

    def velocity(self, x, rates):
        return rates @ self.fields(x)

    def velocity_and_acceleration(self, x, rates):
        """The velocity u and acceleration a of the steady motion through x."""
        u = self.velocity(x, rates)
        if not self.symmetries.fields:
            return u, jnp.zeros_like(u)
        return jax.jvp(lambda x: self.velocity(x, rates), (x,), (u,))

    def momenta(self, x, u) -> Float[Array, " k"]:
        """The conserved momenta `p·G_k`, one for each symmetry."""
        return self.fields(x) @ jax.grad(self.model.lagrangian, argnums=2)(self.t, x, u)


# Jitted so that a Lagrangian is traced only once, however often its balance is evaluated.
@jitted
def imbalance(s: Steady, t, x, u, a, multipliers: PyTree):
    """The residual `M a - F - Aᵀ λ - B λ` for any velocity and acceleration."""
    forcing, inertia = forcing_and_inertia(s.model, t, x, u)
    residual = inertia(a) - forcing
    if multipliers.size:
        residual = residual - multipliers @ forces(s, t, x, u)
    return residual.astype(x.dtype)


@jitted
def forces(s: Steady, t, x, u) -> Float[Array, "m n"]:
    """The force per unit of each multiplier: the rows of A, plus the response of forces that depend on multipliers."""
    rows, reaction = constraints.jacobian(s.model, t, x, u), response(s.model, t, x, u)
    return rows if reaction is None else rows + reaction.T


@jitted
def constraint_residuals(s: Steady, t, x, u):
    """The residuals `g` or `phi` of all constraints, stacked in the order of their names."""
    q, v = s.model.tree(x), s.model.tree(u)
    residuals = [c.residual(t, q, v, s.params) for c in s.system.constraints.values()]
    return (
        jnp.concatenate([jnp.atleast_1d(r).astype(x.dtype) for r in residuals]) if residuals else jnp.zeros(0, x.dtype)
    )


def held_residual(s: Steady, x, rates):
    """The residual of the held rates or momenta: their values minus those at which they are held."""
    if s.symmetries.hold is None or not s.symmetries.count:
        return jnp.zeros(0, x.dtype)
    values = rates if s.symmetries.hold == VELOCITY else s.momenta(x, s.velocity(x, rates))
    return (values - s.held).astype(x.dtype)


def balance(s: Steady, y):
    """All equations of a steady motion as one residual; there are more than unknowns where some are redundant."""
    x, rates, multipliers = s.parts(y)
    u, a = s.velocity_and_acceleration(x, rates)
    residuals = [
        imbalance(s, s.t, x, u, a, multipliers),
        constraint_residuals(s, s.t, x, u),
        held_residual(s, x, rates),
    ]
    if s.symmetries.hold is None and s.symmetries.count:
        # A moving constraint may determine rates that are free.
        residuals.append(holonomic_rates(s, x, u))
    return jnp.concatenate(residuals)


def holonomic_rates(s: Steady, x, u):
    """The residual `dg/dt` of the holonomic constraints, which a velocity must satisfy as well; 0 for the others."""
    return jnp.where(s.model.holonomic, constraints.velocity_residual(s.model, s.t, x, u), 0.0)


def drift_rates(s: Steady, y):
    """The rates at which the balance and each constraint change along the steady motion; zero if the motion lasts."""
    x, rates, multipliers = s.parts(y)
    u, a = s.velocity_and_acceleration(x, rates)
    if s.symmetries.fields:
        # Force components rotate with the motion as the symmetry prescribes, so only the constraints are checked.
        return jnp.concatenate([jnp.zeros_like(x), holonomic_rates(s, x, u)])

    def along(t, x):
        return jnp.concatenate([imbalance(s, t, x, u, a, multipliers), constraint_residuals(s, t, x, u)])

    return jax.jvp(along, (s.t, x), (jnp.ones_like(s.t), u))[1]


class Departures(NamedTuple):
    """`K ξ + C ξ' + M ξ'' = Wᵀ δλ`, with `g_x ξ = 0` and `phi_x ξ + phi_v ξ' = 0`: `rows` (m, n) and `slopes` (m, n).

    `rows` is A; `slopes` is `∂phi/∂x` in the moving frame, and zero for holonomic constraints. `pushes` (m, n) is W.
    """

    stiffness: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    mass: Float[Array, "n n"]
    rows: Float[Array, "m n"]
    slopes: Float[Array, "m n"]
    pushes: Float[Array, "m n"]

    def independent(self) -> "tuple[Departures, Bool[Array, ' m']]":
        """The same with zeros in place of constraints that depend on others; and which are kept."""
        kept = independent_and_not_zero(self.rows)
        rows, slopes, pushes = (jnp.where(kept[:, None], x, 0.0) for x in (self.rows, self.slopes, self.pushes))
        return self._replace(rows=rows, slopes=slopes, pushes=pushes), kept


def independent_and_not_zero(rows: Float[Array, "m n"]) -> Bool[Array, " m"]:
    """Which rows are independent of those before; a row of zeros never is."""
    return independent_rows(rows) & jnp.any(rows != 0, axis=1) if rows.shape[0] else jnp.zeros(0, bool)


def departures(s: Steady, y, jacobian) -> Departures:
    """The linear equations of small departures from a steady motion; `jacobian` is the Jacobian of `balance` at y."""
    x, rates, multipliers = s.parts(y)
    n, k, m = s.n, s.symmetries.count, s.m
    u, a = s.velocity_and_acceleration(x, rates)

    # The dependence on positions is in the Jacobian already; only ξ' and ξ'' are missing.
    def residual(rate, acceleration):
        total = a + acceleration
        if s.symmetries.fields:
            total = total + 2 * jax.jvp(lambda x: s.velocity(x, rates), (x,), (rate,))[1]
        return imbalance(s, s.t, x, u + rate, total, multipliers)

    damping, mass = jax.jacfwd(residual, argnums=(0, 1))(jnp.zeros_like(x), jnp.zeros_like(x))
    by_position, is_holonomic = jacobian[n : n + m, :n], s.model.holonomic[:, None]
    rows = by_position
    if not s.model.holonomic.all():
        rows = constraints.jacobian(s.model, s.t, x, u)
    slopes = jnp.where(is_holonomic, 0.0, by_position)
    return Departures(jacobian[:n, :n], damping, mass, rows, slopes, -jacobian[:n, n + k : n + k + m].T)


def directions(s: Steady, d: Departures, y):
    """The projector (2n, 2n) onto allowed departures (ξ, ξ') that leave the steady motion; and its rank."""
    n, rows, restricts_positions = s.n, d.rows, s.model.holonomic
    zero = jnp.zeros_like(rows)
    of_positions = jnp.where(restricts_positions[:, None], rows, 0.0)
    along = s.fields(s.parts(y)[0])
    excluded = [jnp.concatenate([of_positions, zero], axis=1), jnp.concatenate([d.slopes, rows], axis=1)]
    excluded.append(jnp.concatenate([along, jnp.zeros_like(along)], axis=1))
    excluded = jnp.concatenate(excluded)
    if not excluded.shape[0]:
        return jnp.eye(2 * n, dtype=rows.dtype), jnp.asarray(2 * n)
    kept = independent_and_not_zero(excluded)
    used = jnp.where(kept[:, None], excluded, 0.0)
    gram = used @ used.T + jnp.diag(jnp.where(kept, 0.0, 1.0))
    return jnp.eye(2 * n, dtype=rows.dtype) - used.T @ _solved(gram, used), 2 * n - jnp.sum(kept)


def _solved(matrix, rhs):
    """`matrix⁻¹ rhs` by LAPACK, refined once; the refinement carries the derivatives."""
    return dense.refined(lapack.solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype)), matrix, rhs)


def characteristic_roots(s: Steady, y, jacobian, derivatives: bool):
    """All roots s of departures e^(st), (2n,), with NaN in place of the roots that constraints remove.

    Departures along the symmetry are left out: they lead to the same motion. All roots are NaN where the equations of
    motion are singular. Derivatives are those of `numerics/lapack.py`. `lj.normal_modes` reports more about
    one state; this function serves many states inside compiled programs, and any symmetry.
    """
    d, n = departures(s, y, jacobian), s.n
    project, count = directions(s, d, y)
    d, kept = d.independent()
    rows = d.rows
    matrix = jnp.block([[d.mass, -d.pushes.T], [rows, jnp.diag(jnp.where(kept, 0.0, 1.0))]])
    known = jnp.block([[-d.stiffness, -d.damping], [jnp.zeros_like(rows), -d.slopes]])
    # A coordinate without inertia, such as an azimuth at the pole, has no equation for its small motions.
    sizes = jnp.maximum(jnp.max(jnp.abs(d.mass), axis=1), jnp.max(jnp.abs(rows), axis=0, initial=0.0))
    regular = reciprocal_condition(matrix) > SINGULAR_BELOW[np.dtype(matrix.dtype)]
    regular = regular & (jnp.min(sizes) > jnp.finfo(sizes.dtype).eps ** 1.3 * jnp.max(sizes))
    accelerations = _solved(jnp.where(regular, matrix, jnp.eye(len(matrix), dtype=matrix.dtype)), known)[:n]
    unit = jnp.eye(n, dtype=rows.dtype)
    whole = jnp.concatenate([jnp.concatenate([jnp.zeros_like(unit), unit], axis=1), accelerations])
    unit = jnp.eye(2 * n, dtype=rows.dtype)
    roots = roots_beside_zeros(project @ whole @ project, unit, derivatives)[0].values
    # Ranked by comparisons because sorting is slow to compile; the roots nearest to zero belong to removed directions.
    size, order = lax.stop_gradient(jnp.abs(roots)), np.arange(2 * n)
    before = (size[None, :] < size[:, None]) | (size[None, :] == size[:, None]) & (order[None, :] < order[:, None])
    return jnp.where(regular & (jnp.sum(before, axis=1) >= 2 * n - count), roots, jnp.nan)


def shortest_multipliers(pushes, known):
    """The shortest λ with `Wᵀ λ = known`, W (m, n) of any rank; differentiable where the rank does not change."""
    if not pushes.shape[0]:
        return jnp.zeros(0, pushes.dtype)
    kept = independent_and_not_zero(pushes)
    base = jnp.where(kept[:, None], pushes, 0.0)
    unit = jnp.diag(jnp.where(kept, 0.0, 1.0)).astype(pushes.dtype)
    inverted = jnp.linalg.inv(base @ base.T + unit)
    # W = T W_kept, and the shortest λ with Tᵀ λ = c is T (TᵀT)⁻¹ c.
    shares = pushes @ base.T @ inverted
    shares = jnp.where(kept[None, :], shares, 0.0)
    c = jnp.where(kept, inverted @ (base @ known), 0.0)
    return shares @ jnp.linalg.solve(shares.T @ shares + unit, c)


OK, NO_BALANCE, CONSTRAINED, NOT_FINITE, NOT_LASTING, UNFINISHED = range(6)
WORDS = (
    "found",
    "no equilibrium near it: the imbalance of forces has a nonzero minimum there, or fades far away",
    "the constraints cannot be met there: they contradict each other, or the held velocity",
    "L, a force or a constraint is not finite on the way, or the search goes to infinity",
    "a balance at this instant only: it depends on t, or the motion leaves it",
    "the search has not finished: start again from where it stopped, `last`",
)
# Coordinates that agree to this fraction of the largest are the same.
SAME = 1e-6


class EquilibriumRow(NamedTuple):
    """The result of one start; the names are those of `Equilibria`."""

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    multipliers: dict[str, Float[Array, "..."]]
    rates: Float[Array, " k"]
    momenta: Float[Array, " k"]
    stable: Bool[Array, ""]
    undecided: Bool[Array, ""]
    eigenvalues: Complex[Array, " s"]
    found: Bool[Array, ""]
    zero_modes: Int[Array, ""]
    soft: Int[Array, ""]
    imbalance: Float[Array, ""]
    status: Int[Array, ""]
    last: PyTree[Float[Array, "..."]]


class Equilibria(eqx.Module):
    """States of rest and of steady motion, one row each (E,), and the outcome of each start (S,); print it for a table.

    - `t`; `q`, `v`: the states, each leaf with a leading axis E, `[q]`, `[q]/[t]`.
    - `multipliers`: by constraint name, (E, ...), `[L]/[g]`; with dependent constraints those of least norm.
    - `rates`, `momenta` (E, k): those of each cyclic motion, `1/[t]` (`[q]/[t]` for a coordinate) and `[L][t]`.
    - `stable` (E,): no small departure grows. (If none decays either, as without friction, and forces are gyroscopic or
      circulatory, this holds for the linear equations only: roots on the imaginary axis are the limit of stability.)
      At a point with a zero mode that is no family, the first term that does not vanish along it decides.
    - `undecided` (E,): neither stable nor unstable for what the library can show: several zero modes, velocity
      constraints, or forces beside a zero mode that neither conserve nor lose energy; while JAX traces, any zero mode
      but those of coordinates that nothing depends on.
    - `eigenvalues` (E, 2n): the roots s of departures e^(st), `1/[t]`, padded with NaN; the derivative of a double root
      is that of the mean.
    - `zero_modes` (E,): in how many directions, besides the cyclic ones, the balance holds to first order: the
      equilibrium is the member of a family nearest to its start, or a critical point where branches meet.
      `soft` (E,): the same for directions whose stiffness is so small that the root may be a multiple one.
    - `imbalance` (E,): the imbalance, relative to the effect of a displacement as large as the coordinates.
    - `found` (E,): whether the row is an equilibrium; `status` (S,): 0 where a start led to one, and
      `describe(status)` says what another number means.
    - `of_start` (S,): the row to which each start led, -1 for none. `starts`, `last`: leaves with a leading axis S,
      where each search began and ended, including those that found nothing.

    While JAX traces, E is S and rows that are not equilibria are NaN.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "E ..."]]
    v: PyTree[Float[Array, "E ..."]]
    multipliers: dict[str, Float[Array, "E ..."]]
    rates: Float[Array, "E k"]
    momenta: Float[Array, "E k"]
    stable: Bool[Array, " E"]
    undecided: Bool[Array, " E"]
    eigenvalues: Complex[Array, "E s"]
    found: Bool[Array, " E"]
    zero_modes: Int[Array, " E"]
    soft: Int[Array, " E"]
    imbalance: Float[Array, " E"]
    status: Int[Array, " S"]
    last: PyTree[Float[Array, "S ..."]]
    starts: PyTree[Float[Array, "S ..."]]
    params: PyTree
    symmetries: SteadySymmetries = eqx.field(static=True)
    of_start: Int[Array, " S"] | None = None

    def __len__(self):
        return self.found.shape[0]

    def describe(self, status: int) -> str:
        """The meaning of a status in words."""
        return WORDS[int(status)]

    def __getitem__(self, i: int) -> tuple:
        """The state (t, q, v, params) of one equilibrium, as other functions take it."""
        q, v = jax.tree.map(lambda x: x[i], (self.q, self.v))
        return self.t, q, v, self.params

    def __repr__(self):
        if is_traced((self.q, self.found)):
            return f"Equilibria, being traced, of {self.found.shape[-1]} starts"
        if self.found.ndim > 1:
            shape = " x ".join(map(str, self.found.shape[:-1]))
            return (
                f"Equilibria, {int(np.sum(self.found))} from a batch of {shape} with {self.found.shape[-1]} starts each"
            )
        return by_line("\n".join(_lines(self)))


def merged(rows: Equilibria, angle: np.ndarray, radii: np.ndarray) -> Equilibria:
    """Merge duplicates; equilibria keep the order in which starts led to them.

    `angle` (n,): which coordinates are angles. `radii` (S,): how far from each other searches may end at the same
    multiple root; 0 at simple ones.
    """
    found_rows = np.flatnonzero(np.asarray(rows.found))
    angle = angle & ~np.isin(np.arange(angle.size), rows.symmetries.places)
    x, u = side_by_side(rows.q), side_by_side(rows.v)
    x[:, list(rows.symmetries.places)] = 0.0
    other = np.concatenate([u, side_by_side(rows.multipliers)], axis=1) if rows.multipliers else u
    roots = np.asarray(rows.eigenvalues)
    kept: list[int] = []
    of_start = np.full(len(x), -1)
    for i in found_rows:
        for place, j in enumerate(kept):
            off = x[i] - x[j]
            off = np.where(angle, off - 2 * np.pi * np.round(off / (2 * np.pi)), off)
            radius = max(radii[i], radii[j])
            same = _close(off, np.maximum(np.abs(x[i]), np.abs(x[j])), angle) or np.max(np.abs(off)) <= radius
            # With half an angle in L, for example, states a whole turn apart can differ.
            alike = _close(other[i] - other[j], np.abs(other[i]), np.zeros(other.shape[1], bool))
            verdicts = rows.stable[i] == rows.stable[j] and rows.undecided[i] == rows.undecided[j]
            # Roots near zero are the root of a stiffness that is round-off.
            if same and alike and verdicts and (radius > 0 or _same_roots(roots[i], roots[j])):
                of_start[i] = place
                break
        else:
            of_start[i] = len(kept)
            kept.append(i)
    row_fields = [name for name in EquilibriumRow._fields if name not in ("status", "last")]
    return replace(
        rows,
        **{name: jax.tree.map(lambda x: x[np.array(kept, int)], getattr(rows, name)) for name in row_fields},
        of_start=of_start,
    )


def _close(off, size, angle):
    largest = max(np.max(size, initial=0.0), 1e-300)
    return bool(np.all(np.abs(off) <= SAME * np.where(angle, 1.0, largest)))


def _same_roots(a, b):
    a, b = (np.sort_complex(x[np.isfinite(x)]) for x in (a, b))
    return a.size == b.size and np.all(np.abs(np.abs(a) - np.abs(b)) <= 1e-3 * max(np.abs(a).max(initial=0.0), 1e-300))


def side_by_side(tree: PyTree) -> np.ndarray:
    """The leaves of a tree as columns of one matrix, with the leading axis that all of them have."""
    return np.concatenate([np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)], axis=1)


def _lines(found: Equilibria):
    count, starts = int(np.sum(found.found)), found.status.shape[0]
    kind = "steady motions" if found.symmetries.count else "equilibria"
    yield f"{kind.capitalize()}: {count} from {starts} start{'s' * (starts != 1)}"
    rows = [_row(found, i) for i in range(len(found)) if found.found[i]]
    if rows:
        heads = list(rows[0])
        yield from (f"  {line}" for line in columns([heads, *([row[head] for head in heads] for row in rows)], ">"))
    if any(found.zero_modes[i] for i in range(len(found)) if found.found[i]):
        yield "  A zero mode: one of a family of equilibria, the nearest to its start; or branches meet there."
    status = np.asarray(found.status)
    for code in range(1, len(WORDS)):
        lost = np.flatnonzero(status == code)
        if lost.size:
            yield f"  {lost.size} start{'s' * (lost.size > 1)} led to none: {WORDS[code]}"
            for i in lost[:3]:

                def at(tree: PyTree, i: int = i):
                    return describe(jax.tree.map(lambda x: x[i], tree))

                yield f"    from {at(found.starts)} as far as {at(found.last)}"
            if lost.size > 3:
                yield "    ..."


def _row(found, i):
    """One row of the table, by the heads of its columns."""

    def pick(tree: PyTree):
        return jax.tree.map(lambda x: x[i], tree)

    q, v = pick(found.q), pick(found.v)
    x = np.asarray(coordinates.flatten(q)[0])
    row = {name: _number(x, np.abs(x).max()) for name, x in zip(coordinates.names(q), x)}
    moves = np.any(side_by_side(found.v), axis=0)
    u = coordinates.flatten(v)[0]
    for name, x, shown in zip(coordinates.names(v), u, moves):
        if shown:
            row[f"v{name[1:]}" if name == "q" or name.startswith("q[") else f"v.{name}"] = _number(x)
    for name, value in pick(found.multipliers).items():
        entries = np.ravel(value)
        for j, x in enumerate(entries):
            row[f"λ {name}" + (f"[{j}]" if np.ndim(value) else "")] = _number(x)
    roots = np.asarray(found.eigenvalues[i])
    known = np.any(np.isfinite(roots))
    verdict = "stable" if found.stable[i] else "undecided" if found.undecided[i] else "unstable"
    row[""] = verdict if known else "stability not known"
    if found.zero_modes[i]:
        count = int(found.zero_modes[i])
        row[""] += f", {count} zero mode{'s' * (count > 1)}"
    return row


def _number(x, largest=0.0):
    # A value that is negligible compared with the others, and with one radian, is round-off.
    return "0" if abs(x) < 1e-12 * max(largest, 1.0) else f"{float(x):.6g}"
