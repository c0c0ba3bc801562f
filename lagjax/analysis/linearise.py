"""Small motions about an equilibrium or a steady motion: the linear equations, on the constraint surface.

With `x = x₀ + u₀ t + ξ` and f = F + (A + B)ᵀ λ, the total force with constraint forces for fixed multipliers,

    M ξ̈ + C ξ̇ + K ξ = Aᵀ δλ,    C = -∂f/∂u,    K = -∂f/∂x        (K contains λ·∂²g)

Holonomic constraints allow the positions ξ = P η, with A_h P = 0. Velocity constraints, A_v ξ̇ + B_v ξ = 0 with
B_v = ∂phi/∂q, allow fewer velocities, and a displacement ξ may require a nonzero one:

    ξ̇ = V w + W ξ,    A V = 0,    A W = -B_v (zero in the rows of holonomic constraints)

Multiplying from the left by Lᵀ with Lᵀ Aᵀ = 0 eliminates the constraint forces (L = V unless there is friction):

    (Lᵀ M V) ẇ + Lᵀ (M W + C) V w + Lᵀ ((M W + C) W + K) P η = 0,    η̇ = P⁺ (V w + W P η)

A coordinate that nothing depends on does not appear in these equations: it follows from ξ̇ and is left out of η.

A null space basis N₀ is computed without derivatives and then projected onto the null space of A: `N = (1 - A⁺ A) N₀`
is a smooth function of A with correct derivatives.

Source: Goldstein, *Classical Mechanics*, §6.1-6.2; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. V;
Meijaard, Papadopoulos, Ruina & Schwab, *Proc. R. Soc. A* 463 (2007) 1955, Appendix B (linearised velocity constraints).

*Kinds of forces.* The matrix that multiplies velocities has an antisymmetric part,
which is gyroscopic and does no work, and a symmetric part, which damps. The matrix that multiplies positions has a
symmetric part, the stiffness, and an antisymmetric part, the circulatory one, whose forces can feed in energy without
limit.

In a steady motion x = x₀ + u₀ t without acceleration, and the matrices of small motions do not depend on t. Both are
checked numerically: the accelerations at the state, and the matrices there and some way along the motion.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.analysis.balance import SINGULAR_BELOW
from lagjax.jaxtools import compiled, is_eager, is_traced, remembered
from lagjax.mechanics import explain_failure, forcing_and_inertia, invariance, response, where
from lagjax.numerics import DEPENDENT_BELOW, dense, independent_rows, lapack
from lagjax.system import Model, State, check_system, constraints, coordinates, prepare


class LinearisationKind(NamedTuple):
    """The static part of a linearisation, known before its numbers are; hashable.

    - `unseen` (n,): coordinates that nothing depends on. `holonomic` (m,): which constraint equations are holonomic.
    - `independent` (m,): which constraint equations are used.
    - `conservative`: there is no force, no dissipation and no velocity constraint; `at_rest`: velocities are zero and L
      has no terms linear in them.
    - `timeless`: nothing depends on time.
    """

    unseen: tuple[bool, ...]
    holonomic: tuple[bool, ...]
    independent: tuple[bool, ...]
    conservative: bool
    at_rest: bool
    timeless: bool


class Raw(NamedTuple):
    """The matrices in the original coordinates, which must not change along a steady motion."""

    mass: Float[Array, "n n"]
    velocity: Float[Array, "n n"]
    position: Float[Array, "n n"]
    rows: Float[Array, "m n"]
    slopes: Float[Array, "m n"]


class LinearParts(NamedTuple):
    """The reduced equations, `mass ẇ + velocity w + position η = 0` and `η̇ = drift η + transfer w`.

    - `positions` (n, n_p): P, with zero rows for coordinates that nothing depends on; `velocities`: V; `turning`: W P.
    - `a`: the accelerations at the state itself, zero in a steady motion; `off`: the residuals of the constraints on
      positions and velocities; `forces`: the size of the balancing forces in each coordinate, divided by its inertia.
    - `sound`: the reduced mass matrix is regular and all entries are finite; `independent` (m,): which constraint
      equations are independent.
    """

    mass: Float[Array, "k k"]
    velocity: Float[Array, "k k"]
    position: Float[Array, "k p"]
    drift: Float[Array, "p p"]
    transfer: Float[Array, "p k"]
    positions: Float[Array, "n p"]
    velocities: Float[Array, "n k"]
    turning: Float[Array, "n p"]
    multipliers: PyTree[Array]
    a: Float[Array, " n"]
    off: Float[Array, " r"]
    forces: Float[Array, " n"]
    sound: Bool[Array, ""]
    independent: Bool[Array, " m"]
    raw: Raw


def pencil(parts: LinearParts, xp: Any = jnp):
    """E and A of `E ẏ = A y`, y = (η, w): the pair of matrices from which all roots and shapes come."""
    eye, corner = xp.eye(parts.drift.shape[0], dtype=parts.mass.dtype), xp.zeros_like(parts.transfer)
    return (
        xp.block([[eye, corner], [corner.T, parts.mass]]),
        xp.block([[parts.drift, parts.transfer], [-parts.position, -parts.velocity]]),
    )


def parts_of(kind: LinearisationKind, model: Model, s: State) -> LinearParts:
    """The reduced equations at one state."""
    t, (x, u) = s.t, model.vectors(s.q, s.v)
    n, m = model.n, len(kind.holonomic)
    unseen, holonomic = np.array(kind.unseen, bool), np.array(kind.holonomic, bool)
    chosen = np.array(kind.independent, bool)

    mass = jax.jacfwd(lambda u: jax.grad(model.lagrangian, argnums=2)(t, x, u))(u).astype(x.dtype)
    mass = (mass + mass.T) / 2
    velocity, position, forcing = _forces(kind, model, t, x, u)
    rows, gamma = constraints.acceleration_rows(model, t, x, u)
    slopes = jax.jacfwd(lambda x: constraints.velocity_residual(model, t, x, u))(x)
    slopes = jnp.where(holonomic[:, None], 0.0, slopes).astype(x.dtype)
    friction = response(model, t, x, u)
    pushing = rows.T if friction is None else rows.T + friction

    all_independent = independent_rows(rows) if m else jnp.zeros(0, bool)
    live, positions_live = rows[chosen], rows[chosen & holonomic][:, ~unseen]
    velocities, lift = _null_space(live, all_independent[chosen])
    kept, _ = _null_space(positions_live, all_independent[chosen & holonomic])
    positions = jnp.zeros((n, kept.shape[1]), x.dtype).at[~unseen].set(kept)
    if holonomic.all():
        # Positions and velocities share their directions; coordinates that nothing depends on come first.
        velocities = jnp.concatenate([jnp.eye(n, dtype=x.dtype)[:, unseen], positions], axis=1)
    left = velocities if friction is None else _null_space(pushing.T[chosen], all_independent[chosen])[0]

    # The multipliers that balance the force in a steady motion, a = 0.
    stacked = _spread(rows, live, lift, chosen, -_least_squares(pushing[:, chosen], forcing))

    if m:

        def force_of_constraints(x: Array, u: Array) -> Array:
            return jax.grad(lambda u: stacked @ constraints.velocity_residual(model, t, x, u))(u)

        by_position, by_velocity = jax.jacfwd(force_of_constraints, argnums=(0, 1))(x, u)
        velocity, position = velocity - by_velocity.astype(x.dtype), position - by_position.astype(x.dtype)
    if friction is not None:

        def friction_force(x, u):
            by_multipliers = response(model, t, x, u)
            assert by_multipliers is not None
            return by_multipliers @ stacked

        by_position, by_velocity = jax.jacfwd(friction_force, argnums=(0, 1))(x, u)
        velocity, position = velocity - by_velocity.astype(x.dtype), position - by_position.astype(x.dtype)
    if kind.at_rest:
        velocity = jnp.zeros_like(velocity)
    elif kind.conservative:
        velocity = (velocity - velocity.T) / 2
    if kind.conservative:
        position = (position + position.T) / 2

    reduced_mass = left.T @ mass @ velocities
    if holonomic.all():
        turning = jnp.zeros((n, n), x.dtype)
        shifts = int(unseen.sum())
        drift, transfer = (
            jnp.zeros((kept.shape[1],) * 2, x.dtype),
            jnp.eye(n - int(chosen.sum()), dtype=x.dtype)[shifts:],
        )
    else:
        turning = -lift @ slopes[chosen]
        # P⁺ of the nearly orthonormal P, without the rows of coordinates that nothing depends on.
        back = _left_inverse(kept)
        drift, transfer = back @ (turning @ positions)[~unseen], back @ velocities[~unseen]
    moved = mass @ turning + velocity
    parts = (
        reduced_mass,
        left.T @ moved @ velocities,
        left.T @ (moved @ turning + position) @ positions,
        drift,
        transfer,
    )
    onto = lift @ gamma[chosen] if m else jnp.zeros_like(x)
    sound = jnp.asarray(True)
    for part in parts:
        sound = sound & jnp.all(jnp.isfinite(part))
    sound = sound & (_reciprocal_condition(reduced_mass) > SINGULAR_BELOW[np.dtype(x.dtype)])
    safe = jnp.where(sound, reduced_mass, jnp.eye(reduced_mass.shape[0], dtype=x.dtype))
    a = onto + velocities @ lapack.solve(safe, (left.T @ (forcing - mass @ onto))[:, None])[:, 0]
    off = [constraints.position_residual(model, t, x)] if holonomic.any() else []
    off += [constraints.velocity_residual(model, t, x, u)] if m else []
    constraint_force = pushing @ stacked if m else jnp.zeros_like(x)
    diagonal = jnp.abs(jnp.diag(mass))
    forces = (jnp.abs(forcing) + jnp.abs(constraint_force)) / jnp.where(diagonal > 0, diagonal, 1.0)
    return LinearParts(
        *parts, positions, velocities, turning @ positions,
        model.split(stacked), a,
        jnp.concatenate(off) if off else jnp.zeros(0, x.dtype), forces, sound, all_independent,
        Raw(mass, velocity, position, rows, slopes),
    )  # fmt: skip


def _forces(kind: LinearisationKind, model: Model, t, x, u):
    """-∂F/∂u, -∂F/∂x and F, without constraint forces."""
    if kind.at_rest:
        # At rest there is no momentum, so the force is that of the potential.
        slope = jax.grad(model.lagrangian, argnums=1)
        position, forcing = jax.jacfwd(lambda x: 2 * (slope(t, x, jnp.zeros_like(u)),), has_aux=True)(x)
        return jnp.zeros((x.size, x.size), x.dtype), -position.astype(x.dtype), forcing.astype(x.dtype)

    def force(x, u):
        forcing, _ = forcing_and_inertia(model, t, x, u)
        return forcing, forcing

    (position, velocity), forcing = jax.jacfwd(force, argnums=(0, 1), has_aux=True)(x, u)
    return -velocity.astype(x.dtype), -position.astype(x.dtype), forcing


def _null_space(rows, independent):
    """A basis (n, n - r) of the null space of rows (r, n), and their right inverse (n, r); smooth in the rows."""
    r, n = rows.shape
    if r == 0:
        return jnp.eye(n, dtype=rows.dtype), jnp.zeros((n, 0), rows.dtype)
    # Dependent rows are left out to avoid NaN here; `Parts.independent` reports them to the caller.
    rows = jnp.where(independent[:, None], rows, 0.0)
    start = lapack.complement(rows.T)
    gram = rows @ rows.T + jnp.diag(jnp.where(independent, 0.0, 1.0).astype(rows.dtype))
    lift = dense.solved(gram, rows).T
    return start - lift @ (rows @ start), lift


def _left_inverse(basis):
    return dense.solved(basis.T @ basis, basis.T) if basis.shape[1] else basis.T


def _least_squares(columns, target):
    """The least-squares solution y of `columns y = target`, for independent columns."""
    if columns.shape[1] == 0:
        return jnp.zeros(0, target.dtype)
    gram = columns.T @ columns
    size = jnp.diag(gram)
    return dense.solved(gram + jnp.diag(jnp.where(size > 0, 0.0, 1.0)), columns.T @ target)


def _spread(rows, live, lift, chosen, multipliers: PyTree):
    """The shortest multipliers of all equations that exert the same force as the chosen ones."""
    if chosen.all():
        return multipliers
    # Each row is a combination of the chosen ones.
    combination = rows @ lift
    return combination @ dense.solved(combination.T @ combination, multipliers)


def _reciprocal_condition(matrix):
    """The reciprocal condition of a matrix after its rows and columns are scaled by their largest entries."""
    matrix = jnp.where(jnp.isfinite(matrix), lax.stop_gradient(matrix), 0.0)
    largest = jnp.sqrt(jnp.maximum(jnp.max(jnp.abs(matrix), axis=0), jnp.max(jnp.abs(matrix), axis=1)))
    scale = jnp.where(largest > 0, largest, 1.0)
    sizes = lapack.singular_values(matrix / (scale[:, None] * scale[None, :]))
    return sizes[-1] / jnp.where(sizes[0] > 0, sizes[0], 1.0)


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

    def largest(y: Array):
        return jnp.max(jnp.abs(y), initial=0.0)

    size = largest(jnp.where(np.array(kind.unseen), 0.0, x))
    size, speed = jnp.where(size > 0, size, 1.0), largest(u)

    def row_sum(matrix: Array):
        return jnp.max(jnp.sum(jnp.abs(matrix), axis=1), initial=0.0)

    mass = jnp.where(parts.sound, parts.mass, jnp.eye(parts.mass.shape[0], dtype=x.dtype))

    def per_mass(matrix: Array):
        return row_sum(lapack.solve(mass, jnp.nan_to_num(matrix)))

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


def check_steady(
    linearisation: "Linearisation", steadiness: Steadiness, equations: list[str], linearised: Callable
) -> None:
    """Raise if a state is not in steady motion, or its linear equations change with time.

    `equations`: the name of each constraint equation; `linearised(t, q, v, params)`: the `Linearisation` at another
    state.
    """
    kind, s, parts = linearisation.kind, linearisation.state, linearisation.parts
    relative, a = np.asarray(steadiness.relative), np.asarray(parts.a)
    dtype, n, names = relative.dtype, len(kind.unseen), linearisation.names
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
    _check_time(linearisation, equations, linearised)


def _singular(parts: LinearParts, s: State) -> str:
    names = coordinates.names(s.q)
    _, _, right = np.linalg.svd(np.nan_to_num(np.asarray(parts.mass)))
    i = int(np.argmax(np.abs(np.asarray(parts.velocities) @ right[-1])))
    return (
        f"the mass matrix is singular in coordinate '{names[i]}' {where(s)}: small motions along it have no equation.\n"
        "Usual cause: a coordinate singularity (an azimuth at the pole), or a coordinate without kinetic energy.\n"
        f"Fix: other coordinates there (Cartesian ones), or give '{names[i]}' a mass."
    )


def _check_time(linearisation: "Linearisation", equations: list[str], linearised: Callable) -> None:
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
        names = linearisation.names
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

    def largest(x: np.ndarray):
        return float(np.max(np.abs(x), initial=0.0))

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


# Matrices with more rows than this are not printed.
PRINTED_ROWS = 6


class Linearisation(eqx.Module):
    """The linear equations of small motions, `mass ẇ + (gyroscopic + damping) w + (stiffness + circulatory) η = 0`.

    w (n,) are the velocities that all constraints allow, along the columns of `velocities`, and η the positions along
    the same directions. With velocity constraints, positions have more freedoms than velocities:

    - `mass`, `gyroscopic`, `damping`, `circulatory`, `stiffness` (n, n).
    - `positions` (N, p): a basis of the displacements of the N coordinates that holonomic constraints allow;
      `velocities` (N, n): a basis of the velocities that all constraints allow.
    - `multipliers`: by constraint name, at the state itself; `stiffness` contains the change of the constraint forces'
      directions along the surface.
    - `residual`: how far the state is from a steady motion: its accelerations, relative to those of small motions of
      its own size, or the violation of a constraint. `lj.linearise` raises if it is large, but not while JAX is
      tracing.
    - `state`: the linearised state, (t, q, v, params). `sound`: whether the mass matrix is regular and all constraint
      equations are independent; if not, everything else here is meaningless.
    """

    mass: Float[Array, "n n"]
    gyroscopic: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    circulatory: Float[Array, "n n"]
    stiffness: Float[Array, "n n"]
    positions: Float[Array, "N p"]
    velocities: Float[Array, "N n"]
    multipliers: dict[str, Array]
    residual: Float[Array, ""]
    sound: Bool[Array, ""]
    state: State
    parts: LinearParts
    kind: LinearisationKind = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def shifts(self) -> tuple[str, ...]:
        """The coordinates that nothing depends on: shifting them changes nothing."""
        return tuple(name for name, unseen in zip(self.names, self.kind.unseen) if unseen)

    def first_order(self) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
        """Return E and A of `E ẏ = A y`, y = (positions, velocities), without positions that nothing depends on."""
        return pencil(self.parts)

    def eigenvalues(self) -> Complex[Array, " k"]:
        """Return all characteristic roots, `[1/t]`; a zero for each coordinate that nothing depends on."""
        E, A = self.first_order()
        safe = jnp.where(self.sound, E, jnp.eye(E.shape[0], dtype=E.dtype))
        A = jnp.where(self.sound, dense.solved(safe, A), 0.0)
        roots = jnp.linalg.eigvals(A)
        return jnp.concatenate([roots, jnp.zeros(len(self.shifts), roots.dtype)])

    def __repr__(self):
        n, p = self.mass.shape[-1], self.positions.shape[-1]
        title = f"Linearisation of {len(self.names)} coordinates: {n} freedoms of velocity, {p} of position"
        if is_traced(self.mass) or self.mass.ndim > 2:
            return title
        rows = [title]
        scale = max(float(np.max(np.abs(x), initial=0.0)) for x in (self.mass, self.stiffness, self.gyroscopic))
        for name in ("mass", "gyroscopic", "damping", "circulatory", "stiffness"):
            matrix = np.asarray(getattr(self, name))
            if not np.any(np.abs(matrix) > 1e-14 * scale):
                rows.append(f"  {name:<12}0")
            elif n <= PRINTED_ROWS:
                lines = np.array2string(matrix + 0.0, precision=6, suppress_small=True).split("\n")
                rows += [f"  {name:<12}{lines[0]}", *(f"  {'':<12}{line}" for line in lines[1:])]
            else:
                rows.append(f"  {name:<12}{n} x {n}, the largest entry {np.max(np.abs(matrix)):.6g}")
        if self.shifts:
            rows.append(f"  nothing depends on {', '.join(self.shifts)}")
        rows.append(f"  steady to {float(self.residual):.1e}" + ("" if self.sound else ", but singular"))
        return "\n".join(rows)


def linearise(system, t, q: PyTree, v: PyTree, params: PyTree) -> Linearisation:
    """Return the linear equations of small motions about an equilibrium or a steady motion.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def bead(t, q, v, params):
    ...     turning = 0.5 * (params["omega"] * jnp.sin(q)) ** 2
    ...     return 0.5 * v**2 + turning + params["g"] * jnp.cos(q)
    >>> small = linearise(lj.System(bead), 0.0, 0.0, 0.0, {"omega": 2.0, "g": 9.0})
    >>> print(small.mass, small.stiffness)
    [[1.]] [[5.]]

    **Arguments:** `t` scalar, `q` and `v` of the same structure, `params` as L takes it: an equilibrium, or a state of
    a motion that continues with these velocities while nothing else changes, as along coordinates that L does not
    contain.

    **Returns:** a `Linearisation`, differentiable with respect to the state and `params`.

    **Raises:**

    - `ValueError` if the state is neither an equilibrium nor a steady motion, naming the coordinate that accelerates or
      the constraint that is violated; if the equations change along the motion; if a mass matrix is singular. While JAX
      is tracing nothing is raised: see `residual` and `sound`.
    - `TypeError`, `ValueError` for a state of the wrong shape or dtype.

    Source: Goldstein, *Classical Mechanics*, §6.1-6.2; Meijaard et al., *Proc. R. Soc. A* 463 (2007) 1955, Appendix B.
    """
    check_system(system, t, q, v, params, states=False)
    model, s = prepare(system, t, q, v, params)
    traced = not is_eager() or is_traced((s, eqx.filter(model, eqx.is_array)))
    kind = _kind(model, s)
    n, m = len(kind.unseen), len(kind.holonomic)
    if m >= n:
        # With so many equations some may depend on others, and only their values show which.
        kind = kind._replace(independent=_chosen(kind, model, s, traced))
    if sum(kind.independent) >= n:
        raise ValueError(
            f"{sum(kind.independent)} independent constraint equations on {n} coordinates leave no motion at all.\n"
            "Usual cause: a constraint on every coordinate, or one given in two forms.\n"
            "Fix: leave out the constraint on what should move; print(lj.explain(system, t, q, v, params)) lists them."
        )
    if traced:
        return _linearised(kind, model, s)[0]
    linearisation, steadiness = _linearised(kind, model, s)
    if not np.all(np.asarray(linearisation.parts.independent)[list(kind.independent)]):
        kind = kind._replace(independent=_chosen(kind, model, s, traced))
        linearisation, steadiness = _linearised(kind, model, s)
    if not linearisation.sound:
        raise ValueError(explain_failure(model, s) or _singular(linearisation.parts, s))
    check_steady(linearisation, steadiness, model.equation_names, lambda *state: linearised(kind, model, State(*state)))
    return linearisation


def _kind(model: Model, s: State) -> LinearisationKind:
    """The static part of the linearisation."""
    system, holonomic = model.system, tuple(model.holonomic.tolist())
    known = remembered(model, invariance, lambda: invariance(model))
    at_rest = not is_traced(s.v) and not any(np.any(x) for x in jax.tree.leaves(s.v))
    conservative = not system.is_forced and all(holonomic)
    at_rest = conservative and at_rest and known.even
    return LinearisationKind(known.unseen, holonomic, (True,) * len(holonomic), conservative, at_rest, known.timeless)


def _chosen(kind, model: Model, s, traced) -> tuple[bool, ...]:
    """A largest set of independent constraint equations, preferring those on positions."""
    if traced:
        raise ValueError(
            f"{len(kind.holonomic)} constraint equations on {len(kind.unseen)} coordinates: some depend on others, and "
            "which ones cannot be determined while JAX is tracing.\n"
            "Fix: leave out the dependent ones; print(lj.explain(system, t, q, v, params)) names them."
        )
    rest = np.array(compiled(constraints.jacobian)(model, s.t, *model.vectors(s.q, s.v)))
    size = np.linalg.norm(rest, axis=1)
    rest /= np.where(size > 0, size, 1.0)[:, None]
    holonomic, chosen = np.array(kind.holonomic, bool), np.zeros(len(size), bool)
    for kept in (holonomic, ~holonomic):
        for _ in range(np.sum(kept)):
            left = np.where(kept & ~chosen, np.linalg.norm(rest, axis=1), 0.0)
            farthest = int(np.argmax(left))
            if left[farthest] <= DEPENDENT_BELOW[rest.dtype]:
                break
            chosen[farthest] = True
            direction = rest[farthest] / left[farthest]
            rest = rest - np.outer(rest @ direction, direction)
    return tuple(bool(x) for x in chosen)


def linearised(kind: LinearisationKind, model: Model, s: State) -> Linearisation:
    """The linear equations at another state of the same kind, steady or not."""
    return _linearised(kind, model, s)[0]


def _linearised(kind: LinearisationKind, model: Model, s: State) -> tuple[Linearisation, Steadiness]:
    """The linearisation, and how far the state is from a steady motion."""
    linearisation, steadiness = _without_state(kind, model, s)
    return replace(linearisation, state=linearisation.state._replace(params=s.params)), steadiness


# The parameters may hold functions, as networks do, and a program returns arrays only.
@compiled
def _without_state(kind: LinearisationKind, model: Model, s: State) -> tuple[Linearisation, Steadiness]:
    parts = parts_of(kind, model, s)
    # `transfer` is P⁺ V: the positions η of displacements along the velocity directions.
    along = parts.position @ parts.transfer

    def half(matrix: Array, sign: int):
        return (matrix + sign * matrix.T) / 2

    shifts = jnp.eye(model.n, dtype=s.t.dtype)[:, np.array(kind.unseen, bool)]
    steadiness = steadiness_of(kind, s, parts)
    sound = parts.sound
    if all(kind.independent) and kind.independent:
        sound = sound & jnp.all(parts.independent)
    linearisation = Linearisation(
        mass=parts.mass,
        gyroscopic=half(parts.velocity, -1),
        damping=half(parts.velocity, 1),
        circulatory=half(along, -1),
        stiffness=half(along, 1),
        positions=jnp.concatenate([shifts, parts.positions], axis=1),
        velocities=parts.velocities,
        multipliers=parts.multipliers,
        residual=steadiness.residual,
        sound=sound,
        state=s._replace(params=None),
        parts=parts,
        kind=kind,
        names=tuple(coordinates.names(s.q)),
    )
    return linearisation, steadiness
