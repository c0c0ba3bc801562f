"""States under constraints: the return of a step, the nearest state; accelerations, constraint forces, residuals.

*The return of a step.* A step of any integrator leaves the manifold by its local error, and the error
accumulates: the constraint drifts. The nearest state on it, nearest in the metric of the mass matrix, is the stationary
point of

    ½ (q* - q)ᵀ M (q* - q) + μᵀ g(t, q*)        then        ½ (v* - v)ᵀ M (v* - v) + νᵀ phi(t, q*, v*)

One Newton step of either is a saddle-point solve with the matrix that also gives the accelerations, so a
massless coordinate (M singular) is no obstacle. Positions are moved only where positions are constrained.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §IV.4 and §VII.1.2.

*From any distance, with chosen coordinates held.* Nearest in the metric of the mass matrix M of the given state: the
stationary point of

    ½ (x - x0)ᵀ M (x - x0) + μᵀ g(t, x)        then        ½ (u - u0)ᵀ M (u - u0) + νᵀ phi(t, x, u)

for positions x and velocities u; `g` and `phi` are called `r(y)` below. Held coordinates leave the problem: their rows
and columns become those of the unit matrix. A constraint whose row vanishes then depends only on held coordinates: it
is not an equation for the others, and at the end it holds or it does not.

Newton's method for a stationary point finds one nearby, which may be a farthest point instead of a nearest. So the
first step is to find some state that satisfies the constraints, by steps that are shortest in M; it is its own nearest
point, with μ = 0. From there the target is moved to x0 in stages, and the stationary point followed. Where r is linear,
as for velocities under holonomic constraints alone, one Newton step from the start is all of it.

Source: Nocedal & Wright, *Numerical Optimization*, §18.1 (Newton-KKT) and §11.3 (continuation).

*Accelerations, constraint forces, residuals* follow from the multipliers. The equations and their solution are those of
`saddle_point.py`.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, is_differentiated, is_eager, is_traced, jitted, stop_gradient
from lagjax.mechanics.diagnosis import describe, explain_failure, explain_singular, listed, where
from lagjax.mechanics.equations import Equations, equations_of
from lagjax.mechanics.lagrangian import mass_and_forcing, resolved, with_first_order
from lagjax.mechanics.saddle_point import Dense, ForwardDynamics, displacement_map, examined
from lagjax.numerics import DEPENDENT_BELOW, dense, independent_rows, largest, last_step, newton
from lagjax.refusals import must_be_among, must_name
from lagjax.system import (
    Holonomic,
    InModes,
    Model,
    State,
    System,
    check_system,
    constraints,
    coordinates,
    given_in,
    model_of,
    prepare,
    traced_system,
    with_rates,
)

# With a fixed matrix, an iteration multiplies the residual by about the initial one: one iteration is enough if that is
# below 1e-8 of the size of the state; a crude fixed step of 0.1 takes eight.
ITERATIONS = 12
ONE_IS_ENOUGH_BELOW = 1e-8


class Projected(NamedTuple):
    """A state returned to the constraints, and whether it satisfies them to the tolerance."""

    q: PyTree[Array]
    v: PyTree[Array]
    holds: Bool[Array, ""]


def returned(equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array) -> Projected:
    """Return the state moved onto the constraints; NaN if equations assumed regular turn out singular."""
    if equations.are_written and equations.are_taken_for_regular:
        return Projected(*equations.projected(t, q, v), jnp.asarray(True))
    return to_manifold(equations, t, q, v, rtol, atol)


@compiled
def to_manifold(equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array) -> Projected:
    """Return the nearest state that satisfies all constraints, for a state near it: Newton with a fixed matrix.

    `holds` is true if a displacement of `atol + rtol |y|` accounts for what is left of each residual, including those
    of dependent constraints; `rtol` and `atol` are one number, or one for q and one for v.
    """
    model, y = equations.model, jnp.stack(equations.model.vectors(q, v))
    if not model.m:
        return Projected(q, model.tree(resolved(model, t, *y)), jnp.asarray(True))
    # Not differentiated: where the residual vanishes, the derivative of the matrix does not contribute.
    frozen, at, start = stop_gradient((equations, (t, q, v), y))
    # Positions move only in directions that the velocity constraints allow: a rolling body keeps rolling.
    step, slope = jax.vmap(frozen.displacement(*at)), frozen.row_sizes(*at)[None]

    def size(r: Array):
        return jnp.max(jnp.abs(r) / jnp.where(slope > 0, slope, jnp.inf), axis=1)

    def last(y: Array, moves: Array):
        r = _residuals(model, t, y)
        return y - step(jnp.where(moves, r, 0.0)), r

    of_y = partial(_residuals, frozen.model, at[0])
    near = newton(of_y, lambda y, r, i: step(r), start, ITERATIONS, size=size, enough=ONE_IS_ENOUGH_BELOW)
    # Two steps are differentiated, as velocities follow the positions that the first moves, and one moves nothing: the
    # residuals are in the program twice, where four copies made up half of a vehicle's.
    y, residuals = lax.scan(last, near + (y - start), jnp.asarray([True, True, False]))
    holds = jnp.all(jnp.abs(residuals[-1]) <= _allowed(start, rtol, atol) * slope)
    return Projected(model.tree(y[0]), model.tree(resolved(model, t, *y)), lax.stop_gradient(holds))


# Jitted, so that JAX traces it once for all the places of a program that need it.
@jitted
def _residuals(model: Model, t: Array, y: Float[Array, "2 n"]) -> Float[Array, "2 m"]:
    return constraints.residuals(model, t, *y)


def velocity_change(model: Model, t: Array, q: PyTree, v: PyTree, change: Array):
    """Return the least change of v, in the metric of M, that changes the residuals of all constraints by `change`.

    `change` (m,): that of `constraints.velocity_residual`. The result has the structure of v, to be added to it.
    """
    return model.tree(equations_of(model).displacement(t, q, v)(change))


def worst_residual(model: Model, t: Array, q: PyTree, v: PyTree, given: InModes | None = None, least=0.0):
    """Return the largest relative residual along a trajectory, of positions and velocities.

    A residual is taken relative to `Σ_j |A_ij| Q`, with Q the largest coordinate on the trajectory (the largest
    velocity for the velocity level): to the residual that a displacement as large as the motion would cause. `given`:
    for a system with elements, the modes in each row. `least` (2, 1): Q is at least this.
    """
    equations = equations_of(model)

    def at(t: Array, q: PyTree, v: PyTree, row: InModes | None):
        here = equations if row is None else equations_of(model.of(given_in(row, model.params.params)))
        return *residuals_and_slopes(here, t, q, v), jnp.maximum(level_size(jnp.stack(model.vectors(q, v))), least)

    residual, slope, size = jax.vmap(at)(t, q, v, given)
    # Outputs after an event or a failure are NaN and say nothing about the constraints.
    scale = jnp.nanmax(size, axis=0, keepdims=True) * slope
    return jnp.nanmax(jnp.abs(residual) / jnp.where(scale > 0, scale, 1.0))


def level_size(y: Float[Array, "2 n"]) -> Float[Array, "2 1"]:
    """Return the largest coordinate and the largest velocity; a single coordinate may be zero and sets no scale."""
    return jnp.max(jnp.abs(y), axis=1, keepdims=True)


def within(
    equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array, known: tuple | None = None
) -> Bool[Array, ""]:
    """Whether a displacement of `atol + rtol |y|` accounts for every residual, of positions and velocities.

    `known`: the residuals and A at this state, if they have been computed.
    """
    if known is None:
        residual, slope = residuals_and_slopes(equations, t, q, v)
    else:
        residual, slope = known[0], jnp.sum(jnp.abs(known[1]), axis=1)[None]
    return jnp.all(jnp.abs(residual) <= _allowed(jnp.stack(equations.model.vectors(q, v)), rtol, atol) * slope)


def _allowed(y: Float[Array, "2 n"], rtol: Array, atol: Array) -> Float[Array, "2 1"]:
    """Return the displacements of coordinates and of velocities that count as zero at a state."""
    rtol, atol = (jnp.broadcast_to(tolerance, 2)[:, None] for tolerance in (rtol, atol))
    return atol + rtol * level_size(y)


@compiled
def residuals_and_slopes(equations: Equations, t: Array, q: PyTree, v: PyTree):
    """Return the residuals of positions and of velocities (2, m), and the sums of their slopes (1, m).

    ∂(dg/dt)/∂v = ∂g/∂q: the rows of A serve both levels.
    """
    y = jnp.stack(equations.model.vectors(q, v))
    return _residuals(equations.model, t, y), equations.row_sizes(t, q, v)[None]


def departures(model: Model, s: coordinates.State, rtol: Array, atol: Array) -> str:
    """Name the constraints that a state violates by more than a displacement `atol + rtol |y|`; else ''."""
    residual, slope = (np.asarray(part) for part in residuals_and_slopes(equations_of(model), *s[:3]))
    allowed = np.asarray(_allowed(jnp.stack(model.vectors(s.q, s.v)), rtol, atol))
    # NaN is a violation too; constraints of velocities ask nothing of positions.
    off = ~(np.abs(residual) <= allowed * slope) & np.stack([model.holonomic, np.ones_like(model.holonomic)])
    equations = list(zip(model.equation_names, model.holonomic))
    labels = [f"'{name}'" for name, _ in equations]
    labels += [f"d/dt '{name}'" if holonomic else f"'{name}'" for name, holonomic in equations]
    return ", ".join(f"{labels[i]} = {residual.flat[i]:.3g}" for i in np.flatnonzero(off))


TO_REACH = 40
STAGES, PER_STAGE = 16, 3
# Far from the manifold a full step may overshoot: the best of these fractions is taken.
FRACTIONS = np.array([1.0, 0.5, 0.2, 0.05])


def consistent_state(
    system: System,
    t: ArrayLike,
    q: PyTree,
    v: PyTree,
    params: PyTree,
    hold: str | Iterable[str] = (),
    *,
    hold_position: str | Iterable[str] = (),
    hold_velocity: str | Iterable[str] = (),
):
    """Return the state nearest to the given one, in the mass matrix's metric, that satisfies the constraints.

    >>> import lagjax as lj
    >>> rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2), {"rod": rod})
    >>> q, v = consistent_state(
    ...     pendulum, 0.0, {"x": 6.0, "y": 8.0}, {"x": 1.0, "y": 0.0}, {"length": 5.0}
    ... )
    >>> print(q["x"].round(6), q["y"].round(6))
    3.0 4.0
    >>> q, v = consistent_state(
    ...     pendulum, 0.0, {"x": 3.0, "y": 1.0}, {"x": 4.0, "y": 0.0}, {"length": 5.0}, hold="x"
    ... )
    >>> print(q["y"].round(6), v["y"].round(6))
    4.0 -3.0

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as the system takes it; `hold`, the names of coordinates that
    keep the values given for them and for their velocities: `"x"`, `["x", "r[0]"]`, `"r"` for all of a vector or a
    body, or a dict of true and false by name; `hold_position`, `hold_velocity`: for the position alone, as of a crank
    whose speed a motor determines, or for the velocity alone.

    **Returns:** (q, v) in the same structure, differentiable in the state, `t` and `params`: on the constraints to
    round-off, and nearer than all states around it; where constraints fold, one further off may be nearer still.

    **Raises:**

    - `ValueError` if no consistent state is reached, with the residual by constraint name (while JAX is tracing, the
      values are NaN instead).
    - `ValueError` for a name to hold that is not a coordinate.
    - `TypeError`, `ValueError` for a state of the wrong shape or dtype.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, Eq. (IV.4.3).
    """
    model, s = prepare(system, t, q, v, params)
    model = with_first_order(model)
    both = free_coordinates(s.q, hold)
    free = both & free_coordinates(s.q, hold_position, "hold_position")
    free_velocity = both & free_coordinates(s.q, hold_velocity, "hold_velocity")
    if not model.is_returned:
        return s.q, s.v
    q, v, reached = _consistent_state(model, s, jnp.asarray(free), jnp.asarray(free_velocity))
    if is_traced((q, v)):
        return jax.tree.map(lambda x: jnp.where(reached, x, jnp.nan), (q, v))
    if not reached:
        exact = with_exact(system)
        if exact is not system:
            return consistent_state(
                exact, t, q, v, params, hold, hold_position=hold_position, hold_velocity=hold_velocity
            )
        raise ValueError(_unreachable(model, s, q, v, free, free_velocity))
    return q, v


def with_exact(system: System) -> System:
    """The system whose other constraints are evaluated where those that say how hold exactly; itself if none say so.

    The function of a constraint may have an attribute `restored`, q -> q. So a loop that cannot close says by how much,
    of bodies whose quaternions have length one, and not of stretched ones.
    """
    exact = {name: getattr(c.function, "restored", None) for name, c in system.constraints.items()}
    if not any(exact.values()):
        return system

    def restored(q: PyTree) -> PyTree:
        for restore in filter(None, exact.values()):
            q = restore(q)
        return q

    def evaluated(c: Holonomic, where: Callable) -> Holonomic:
        return Holonomic(lambda t, q, params: c.g(t, where(q), params))

    return replace(
        system,
        constraints={
            name: evaluated(c, restored if exact[name] is None else lambda q: q) if isinstance(c, Holonomic) else c
            for name, c in system.constraints.items()
        },
    )


def free_coordinates(q: PyTree, hold, argument: str = "hold") -> np.ndarray:
    """Return which coordinates may move, (n,) booleans."""
    names = coordinates.names(q)
    if isinstance(hold, Mapping):
        hold = [name for name, held in hold.items() if held]
    hold = {hold} if isinstance(hold, str) else set(hold)
    # "crank.position[0]" is held by its own name, by "crank.position" and by "crank".
    known = [{name, *(name[:i] for i, letter in enumerate(name) if letter in ".[")} for name in names]
    held = np.array([bool(hold & whole) for whole in known])
    unknown = hold.difference(*known)
    if unknown:
        must_name(sorted(map(str, unknown)), names, f"{argument} names", "coordinate", f"{argument}='{{}}'")
    return ~held


def _unreachable(model: Model, s: State, q: PyTree, v: PyTree, free: Array, free_velocity: Array):
    best = coordinates.State(s.t, q, v, s.params)
    tolerance, names = _round_off(s.t), np.asarray(model.names)
    both = ~free & ~free_velocity
    kinds = (("", both), ("the position of ", ~free & ~both), ("the velocity of ", ~free_velocity & ~both))
    held = [f"{what}{listed(names[which])}" for what, which in kinds if np.any(which)]
    among = f" with {' and '.join(held)} held" if held else ""
    off = departures(model, best, tolerance, tolerance)
    fix = "hold less, start nearer, or check each constraint with lj.constraint_residual(system, t, q, v, params)"
    if np.any(both) and within(equations_of(model), *best[:3], tolerance, np.array([tolerance, 1e30])):
        fix = f"hold the position alone, hold_position={list(map(str, names[both]))}, if the velocity need not be kept"
    return (
        f"no consistent state was found near q = {describe(s.q)}{among}: at the best state reached, constraint {off}.\n"
        "Usual cause: constraints that contradict each other, too much held, or a start too far from the manifold.\n"
        f"Fix: {fix}."
    )


def _round_off(t: Array):
    return 1e3 * float(jnp.finfo(t.dtype).eps)


@compiled
def _consistent_state(model: Model, s: State, free: Array, free_velocity: Array):
    t, (x0, u0) = s.t, model.vectors(s.q, s.v)
    metric = mass_and_forcing(model, t, x0, u0).mass
    x, live = x0, (model, t)
    if model.holonomic.any():
        x = _nearest(lambda problem, x: constraints.position_residual(*problem, x), live, x0, metric, free)
    u = u0
    if model.m:
        u = _nearest(
            lambda problem, u: constraints.velocity_residual(*problem, u), (*live, x), u, metric, free_velocity,
            is_linear=bool(model.holonomic.all()),
        )  # fmt: skip
    q, v, tolerance = model.tree(x), model.tree(resolved(model, t, x, u)), _round_off(t)
    return q, v, within(equations_of(model), t, q, v, tolerance, tolerance)


def _nearest(residual: Callable, problem: PyTree, y0: Array, metric: Array, free: Array, is_linear: bool = False):
    """Return the stationary point of `½ (y - y0)ᵀ M (y - y0) + μᵀ r(y)` near y0, for r that may be linear in y."""
    metric = jnp.where(free[:, None] & free[None, :], metric, jnp.diag(jnp.where(free, 0.0, 1.0)))
    n, fixed, fixed_metric, start = y0.size, stop_gradient(problem), *stop_gradient((metric, y0))
    residual = _two_or_more(residual)

    def rows_at(problem: PyTree, y: Array):
        rows = jax.jacfwd(lambda y: residual(problem, y))(y)
        left = jnp.where(free[None, :], rows, 0.0)

        def size(rows: Array) -> Array:
            return jnp.max(jnp.abs(lax.stop_gradient(rows)), axis=1)

        return jnp.where((size(left) > DEPENDENT_BELOW[np.dtype(y0.dtype)] * size(rows))[:, None], left, 0.0)

    def usable_rows(rows: Array, dependent_below: float | None = None):
        return independent_rows(rows, dependent_below) & jnp.any(rows != 0, axis=1)

    def to_displacement(y: Array, dependent_below: float | None = None):
        rows = rows_at(fixed, y)
        return displacement_map(fixed_metric, rows, usable_rows(rows, dependent_below))

    def shortest_step(y: Array, r: Array, i):
        # Off the manifold dependent rows disagree by about the distance to it, which is unknown at first.
        dependent_below = jnp.maximum(0.1 * 0.25**i, DEPENDENT_BELOW[np.dtype(y0.dtype)]).astype(y0.dtype)
        return to_displacement(y, dependent_below) @ r

    def some_state():
        slope = jnp.sum(jnp.abs(rows_at(fixed, start)), axis=1)
        slope = jnp.where(slope > 0, slope, 1.0)
        of_y = partial(residual, fixed)
        return newton(of_y, shortest_step, start, TO_REACH, size=lambda r: largest(r / slope), fractions=FRACTIONS)

    def curvature(y: Array, multipliers: Array):
        if is_linear:
            return jnp.zeros_like(fixed_metric)
        bent = jax.jacfwd(lambda y: multipliers @ rows_at(fixed, y))(y)
        return jnp.where(free[:, None] & free[None, :], bent, 0.0)

    def newton_step(target: Array, state: Array):
        """One step towards the stationary point for a target, and the inverse of its matrix.

        What it needs of the constraints is at one place of the program: derivatives of a mechanism are long.
        """
        y, multipliers = state[:n], state[n:]
        rows = rows_at(fixed, y)
        independent = usable_rows(rows)
        left = jnp.where(independent, residual(fixed, y), 0.0)
        left = jnp.concatenate([fixed_metric @ (y - target) + multipliers @ rows, left])
        # The full matrix, even for more equations than coordinates: all multipliers are unknowns.
        rows = jnp.where(independent[:, None], rows, 0.0)
        matrix = fixed_metric + curvature(y, multipliers)
        matrix = jnp.block([[matrix, rows.T], [rows, jnp.diag(jnp.where(independent, 0.0, 1.0))]])
        inverted = dense.inverse(matrix)
        step = dense.refined(inverted, matrix, left)
        step = step.at[n:].set(jnp.where(independent, step[n:], multipliers))
        return jnp.where(jnp.any(left != 0), state - step, state), inverted

    def follow(i: Array, found: tuple):
        share = jnp.minimum(i // PER_STAGE + 1, STAGES) / STAGES
        return newton_step(reached + share.astype(y0.dtype) * (start - reached), found[0])

    reached = start if is_linear else some_state()
    zero = jnp.zeros_like(residual(fixed, start))
    begin = jnp.concatenate([reached, zero])
    if is_linear:
        followed, inverted = newton_step(start, begin)
    else:
        # Once more than the stages have steps: the matrix that remains is that of the point found.
        nothing = jnp.zeros((begin.size, begin.size), y0.dtype)
        followed, inverted = lax.fori_loop(0, STAGES * PER_STAGE + 1, follow, (begin, nothing))
    y, multipliers = followed[:n], followed[n:]
    finite = jnp.all(jnp.isfinite(y)) & jnp.all(jnp.isfinite(inverted))
    y, multipliers = jnp.where(finite, y, reached), jnp.where(finite, multipliers, zero)
    y, multipliers, reached, inverted = stop_gradient((y, multipliers, reached, jnp.where(finite, inverted, 0.0)))
    # One more Newton step gives the nearest point all its derivatives, by the implicit function theorem.
    force = metric @ (y - y0) + multipliers @ rows_at(problem, y)
    nearest = y - (inverted @ jnp.concatenate([force, residual(problem, y)]))[:n]
    # If the path to it was lost, the result is the point reached by shortest steps, with the derivatives of one step.
    back = lax.stop_gradient(to_displacement(reached))
    near = last_step(reached, y0, lambda y: back @ residual(problem, y))

    def length(y: Array) -> Array:
        return (y - start) @ fixed_metric @ (y - start)

    def off(y: Array):
        return jnp.max(jnp.abs(residual(fixed, y)))

    small = jnp.sqrt(jnp.finfo(y0.dtype).eps)
    # Where nothing satisfies the constraints, one more step may lead far away from the best state.
    near = jnp.where(off(near) <= off(reached) + small, near, reached)
    kept = finite & (off(nearest) <= small) & (length(nearest) <= length(near) * (1 + 1e-6))
    return jnp.where(kept, nearest, near)


def _two_or_more(residual: Callable):
    """Pad a single equation with one that restricts nothing: a single equation would never be left out."""

    def padded(problem: PyTree, y: Array):
        found = residual(problem, y)
        return found if found.size > 1 else jnp.concatenate([found, jnp.zeros(2 - found.size, found.dtype)])

    return padded


def unreachable_ahead(trajectory) -> str | None:
    """Explain that the constraints cannot be met a little after the end; None if they can."""
    system, end = trajectory.system, trajectory.end
    if not system.constraints:
        return None
    ahead = 1e-3 * (trajectory.t[-1] - trajectory.t[0])
    q = jax.tree.map(lambda q, v: q + ahead * v, end.q, end.v)
    try:
        consistent_state(system, end.t + ahead, q, end.v, trajectory.params)
    except ValueError as error:
        return (
            f"the constraints cannot be met a little later. {error}\n"
            "(So ends a loop that can close only so far, or one motion that is prescribed twice.)"
        )
    return None


def accelerations(
    system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree
) -> tuple[PyTree[Array], dict[str, Array]]:
    """Solve Lagrange's equations for the accelerations and the multipliers.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def falling(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]
    >>> table = lj.System(falling, constraints={"table": lj.Holonomic(lambda t, q, params: q["y"])})
    >>> a, multipliers = accelerations(table, 0.0, {"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 0.0}, {"g": 10.0})
    >>> print(a["y"], multipliers["table"])
    0.0 10.0

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as L takes it.

    **Returns:** the accelerations, like `q`, `[q]/[t]²`; and the multipliers by constraint name, each of
    its constraint's shape, `[L]/[g]` or `[L]/([phi] [t])`. The force of a constraint is `Aᵀ λ`, so λ > 0
    pushes along +∂g/∂q. Where constraints depend on each other the force does not fix the multipliers: these are
    then the shortest ones. The state is taken as it is: it should satisfy the constraints.

    **Raises:**

    - `TypeError`, `ValueError` for a state of the wrong dtype or shape, or an L that is not scalar.
    - `ValueError` where the equations are singular or not finite at this state, or constraints contradict each
      other, with the coordinate or the constraints by name (not while JAX is tracing: there the values are NaN).

    Source: Goldstein, Eq. (2.24)-(2.27).
    """
    check_system(system, t, q, v, params)
    s = coordinates.prepared(t, q, with_rates(system, q, v), params)
    return accelerations_at(model_of(traced_system(system, s), *s), s)


def accelerations_at(model: Model, s: coordinates.State) -> tuple[PyTree[Array], dict[str, Array]]:
    """The accelerations and the multipliers of a prepared system."""
    # A value that a function closes over may be traced where no argument is.
    given = s, eqx.filter(model, eqx.is_array)
    if not is_eager() or is_traced(given):
        return _accelerations_inside(model, s, is_differentiated(given))
    equations = equations_of(model)
    if not isinstance(equations.form, Dense):
        found = equations.verdict(s.t, s.q, s.v)
        if found.finite and not found.singular and not found.contradictory:
            return found.a, found.multipliers
    if isinstance(equations.form, ForwardDynamics):
        raise ValueError(explain_failure(model, s) or f"the accelerations are not finite {where(s)}.")
    found = examined(model, s)
    solution = found.a, found.multipliers
    finite = all(np.all(np.isfinite(x)) for x in jax.tree.leaves((solution, found.lagrangian)))
    valid = finite and bool(found.unique) and not np.any(np.asarray(found.contradictory))
    if not valid or explain_singular(np.asarray(found.matrix), model, s):
        raise ValueError(explain_failure(model, s) or f"the accelerations are not finite {where(s)}.")
    return solution


@partial(compiled, in_line=True)
def _accelerations_inside(model: Model, s: coordinates.State, differentiated: bool):
    equations = equations_of(model, fast=True, differentiated=differentiated)
    a, multipliers = equations.solution_or_nan(s.t, equations.inside(s.q), equations.inside(s.v))
    return equations.outside(a), multipliers


def constraint_force(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> dict[str, PyTree[Array]]:
    """Return the generalized force `Aᵀ λ` of each constraint.

    >>> import lagjax as lj
    >>> def falling(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]
    >>> table = lj.System(falling, constraints={"table": lj.Holonomic(lambda t, q, params: q["y"])})
    >>> force = constraint_force(table, 0.0, {"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 0.0}, {"g": 10.0})
    >>> print(force["table"]["x"], force["table"]["y"])
    0.0 10.0

    **Arguments:** as for `accelerations`.

    **Returns:** by constraint name, a force with the structure of `q`, `[L]/[q]`.

    **Raises:** as for `accelerations`.

    Source: Goldstein, Eq. (2.26).
    """
    model, s = prepare(system, t, q, v, params)
    return _constraint_force(model, s, accelerations_at(model, s)[1])


def constraint_residual(
    system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree, level: str = "constraint"
) -> dict[str, Array]:
    """Return how far a state is off each constraint.

    >>> import lagjax as lj
    >>> rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2), {"rod": rod})
    >>> print(constraint_residual(pendulum, 0.0, {"x": 3.0, "y": 4.0}, {"x": 0.0, "y": 0.0}, {"length": 4.0}))
    {'rod': Array(9., dtype=float64)}

    **Arguments:** as for `accelerations`, and `level`: `"constraint"` for `g` or `phi` as it was written,
    `"velocity"` for `dg/dt` or `phi`.

    **Returns:** by constraint name, the residual in its constraint's shape, `[g]` or `[g]/[t]` or `[phi]`.

    **Raises:** `ValueError` for another level, or a constraint that returns neither scalar nor vector.
    """
    must_be_among(("constraint", "velocity"), level, "level", 'leave it out, or level="velocity"')
    model, s = prepare(system, t, q, v, params)
    return _constraint_residual(model, s, level)


@compiled
def _constraint_force(model: Model, s: State, multipliers: Array):
    x, u = model.vectors(s.q, s.v)
    rows, stacked = constraints.jacobian(model, s.t, x, u), model.stacked(multipliers)
    return {name: model.tree(jnp.where(model.belongs_to(name), stacked, 0.0) @ rows) for name in multipliers}


@compiled
def _constraint_residual(model: Model, s: State, level: str):
    if level == "velocity":
        return model.split(constraints.velocity_residual(model, s.t, *model.vectors(s.q, s.v)))
    return {name: constraint.residual(*s) for name, constraint in model.system.constraints.items()}
