"""The multipliers and what follows from them: accelerations, constraint forces, residuals at one state.

The equations and their solution are those of `saddle_point.py`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import compiled, is_differentiated, is_eager, is_traced
from lagjax.mechanics.diagnosis import explain_failure, explain_singular, where
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.saddle_point import Dense, ForwardDynamics, examined
from lagjax.system import (
    Model,
    State,
    System,
    check_system,
    constraints,
    coordinates,
    model_of,
    prepare,
    traced_system,
    with_rates,
)


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
        equations = equations_of(model, fast=True, differentiated=is_differentiated(given))
        a, multipliers = equations.solution_or_nan(s.t, equations.inside(s.q), equations.inside(s.v))
        return equations.outside(a), multipliers
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
    if level not in ("constraint", "velocity"):
        raise ValueError(
            f'level must be "constraint" or "velocity", not {level!r}.\nFix: leave it out, or level="velocity".'
        )
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
