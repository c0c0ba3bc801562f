"""The multipliers and what follows from them: accelerations, constraint forces, residuals at one state.

The equations and their solution are those of `saddle_point.py`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.diagnosis import explain_failure, explain_singular, where
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.first_call import traced_system
from lagjax.mechanics.refusals import check_system
from lagjax.mechanics.saddle_point import examined
from lagjax.mechanics.sparse_saddle_point import Banded


def accelerations(system, t, q, v, params) -> tuple[PyTree[Array], dict[str, Array]]:
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
    s = coordinates.prepared(t, q, v, params)
    system = traced_system(system, s)
    # A value that a function closes over may be traced where no argument is.
    if not is_eager() or coordinates.is_traced((s, eqx.filter(system, eqx.is_array))):
        equations = equations_of(system, *s, fast=True)
        a, multipliers = equations.solution_or_nan(s.t, equations.inside(s.q), equations.inside(s.v))
        return equations.outside(a), multipliers
    equations = equations_of(system, *s)
    if isinstance(equations.form, Banded):
        found = equations.verdict(s.t, s.q, s.v)
        if found.finite and not found.singular and not found.contradictory:
            return found.a, found.multipliers
    found = examined(system, *s)
    solution = found.a, found.multipliers
    finite = all(np.all(np.isfinite(x)) for x in jax.tree.leaves((solution, found.lagrangian)))
    valid = finite and bool(found.unique) and not np.any(np.asarray(found.contradictory))
    if not valid or explain_singular(np.asarray(found.matrix), system, s):
        raise ValueError(explain_failure(system, s) or f"the accelerations are not finite {where(s)}.")
    return solution


def constraint_force(system, t, q, v, params) -> dict[str, PyTree[Array]]:
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
    check_system(system, t, q, v, params)
    s = coordinates.state(t, q, v, params)
    system = traced_system(system, s)
    _, multipliers = accelerations(system, *s)
    return _constraint_force(system, *s, multipliers)


def constraint_residual(system, t, q, v, params, level: str = "constraint") -> dict[str, Array]:
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
    if level not in ("constraint", "velocity"):
        raise ValueError(
            f'level must be "constraint" or "velocity", not {level!r}.\nFix: leave it out, or level="velocity".'
        )
    check_system(system, t, q, v, params)
    s = coordinates.state(t, q, v, params)
    system = traced_system(system, s)
    return _constraint_residual(system, *s, level)


@compiled
def _constraint_force(system, t, q, v, params, multipliers):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    forces = {}
    for name, constraint in system.constraints.items():
        alone = eqx.tree_at(lambda s: s.constraints, system, {name: constraint})
        rows = constraints.acceleration_rows(alone, t, x, u, params, unflatten)
        forces[name] = unflatten(rows.jacobian.T @ jnp.atleast_1d(multipliers[name]))
    return forces


@compiled
def _constraint_residual(system, t, q, v, params, level):
    if level == "velocity":
        x, unflatten = coordinates.flatten(q)
        u, _ = coordinates.flatten(v)
        stacked = constraints.velocity_residual(system, t, x, u, params, unflatten)
        return constraints.split(system, stacked, t, q, v, params)
    return {name: constraint.residual(t, q, v, params) for name, constraint in system.constraints.items()}
