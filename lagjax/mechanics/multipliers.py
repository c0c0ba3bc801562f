"""Accelerations and multipliers: the saddle-point system.

Lagrange's equations with constraints and the constraints at acceleration level,

    M a = F + Aᵀ λ,    A a = gamma,

are one symmetric linear system in (a, -λ):

    [M  Aᵀ] [ a]   [  F  ]
    [A  0 ] [-λ] = [gamma]

It is regular where M is definite on the directions that the constraints leave free and the rows of A
are independent. M itself may be singular (a massless wedge) or indefinite. Without constraints only
`M a = F` is compiled.

Source: Goldstein, Eq. (2.24)-(2.27); Hairer & Wanner, *Solving ODEs II*, Eq. (VII.1.46).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.lagrangian import Linear, check_scalar, mass_and_forcing
from lagjax.numerics import dense

# Below this ratio of singular values, after scaling, the saddle-point matrix counts as singular.
SINGULAR_BELOW = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}


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
    pushes along +∂g/∂q. The state is taken as it is: it should satisfy the constraints.

    **Raises:**

    - `TypeError`, `ValueError` for a state of the wrong dtype or shape, or an L that is not scalar.
    - `ValueError` where the equations are singular or not finite at this state, with the coordinate or
      constraint by name (not while JAX is tracing: there the values are NaN or infinite).

    Source: Goldstein, Eq. (2.24)-(2.27).
    """
    s = coordinates.state(t, q, v, params)
    check_scalar(system, *s)
    a, multipliers = equations_of_motion(system, *s)
    if not coordinates.is_traced((a, multipliers)):
        if not np.all(np.isfinite(coordinates.flatten((a, multipliers))[0])):
            raise ValueError(explain_failure(system, s) or f"the accelerations are not finite {_where(s)}.")
    return a, multipliers


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
    s = coordinates.state(t, q, v, params)
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
        raise ValueError(f'level must be "constraint" or "velocity", not {level!r}.')
    s = coordinates.state(t, q, v, params)
    return _constraint_residual(system, *s, level)


# Jitted, so that JAX traces L once for all the places of a compiled trajectory that need accelerations.
@eqx.filter_jit
def equations_of_motion(system, t, q, v, params, baumgarte_rate=None):
    """The accelerations, like q, and the multipliers by name; `accelerations` without its checks."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    if not system.constraints:
        return unflatten(dense.solve(linear.mass, linear.forcing)), {}
    jacobian, gamma = constraints.acceleration_rows(system, t, x, u, params, unflatten)
    if baumgarte_rate is not None:
        gamma = gamma + constraints.baumgarte_feedback(system, t, x, u, params, unflatten, baumgarte_rate)
    a, multipliers = saddle_point(linear.mass, jacobian, linear.forcing, gamma)
    return unflatten(a), constraints.split(system, multipliers, t, q, v, params)


def saddle_point(mass, jacobian, forcing, gamma):
    """Solve `M a - Aᵀ λ = F`, `A a = gamma` for (a, λ)."""
    n, m = mass.shape[0], jacobian.shape[0]
    matrix = saddle_point_matrix(mass, jacobian)
    solution = dense.solve(matrix, jnp.concatenate([forcing, gamma]))
    return solution[:n], -solution[n : n + m]


def saddle_point_matrix(mass, jacobian):
    """`[[M, Aᵀ], [A, 0]]`."""
    zero = jnp.zeros((jacobian.shape[0], jacobian.shape[0]), mass.dtype)
    return jnp.block([[mass, jacobian.T], [jacobian, zero]])


@eqx.filter_jit
def linear_system(system, t, q, v, params) -> tuple[Linear, constraints.Rows, Float[Array, ""]]:
    """M, F, A, gamma and L at one state: what a diagnosis needs to look at."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    rows = constraints.acceleration_rows(system, t, x, u, params, unflatten)
    return linear, rows, jnp.asarray(system.lagrangian(t, q, v, params))


def explain_failure(system, s: coordinates.State) -> str | None:
    """Say in the user's names why the equations fail at a state; None where they do not."""
    linear, rows, lagrangian = linear_system(system, *s)
    names = coordinates.names(s.q)
    where = _where(s)
    if not np.isfinite(lagrangian):
        return (
            f"L is {float(lagrangian)} {where}.\n"
            "Usual cause: a division by zero, a root or logarithm of a negative number, or NaN in params.\n"
            "Fix: evaluate lagrangian(t, q, v, params) there, term by term."
        )
    for what, values in (("mass matrix", linear.mass), ("force", linear.forcing)):
        if not np.all(np.isfinite(values)):
            bad = np.argwhere(~np.isfinite(np.asarray(values)))[0]
            return (
                f"L is finite but the {what} of coordinate '{names[bad[0]]}' is not, {where}.\n"
                "Usual cause: a derivative that does not exist there, as of sqrt at 0 or arccos at 1, "
                "also behind a jnp.where whose other branch is taken.\n"
                "Fix: make the argument safe before the function: jnp.sqrt(jnp.where(x > 0, x, 1.0))."
            )
    equations = equation_names(system, s)
    for what, values in (("derivative", rows.jacobian), ("second derivative", rows.gamma)):
        if not np.all(np.isfinite(values)):
            bad = np.argwhere(~np.isfinite(np.asarray(values)))[0]
            return (
                f"the {what} of constraint '{equations[bad[0]]}' is not finite {where}.\n"
                "Usual cause: a distance written with sqrt, which has no derivative at zero.\n"
                "Fix: constrain the square of the distance."
            )
    return explain_singular(np.asarray(saddle_point_matrix(linear.mass, rows.jacobian)), system, s)


def equation_names(system, s: coordinates.State) -> list[str]:
    """The name of each constraint equation, in the order in which they are stacked."""
    return [
        name + (f"[{i}]" if shape else "")
        for name, shape in constraints.shapes(system, *s).items()
        for i in range(shape[0] if shape else 1)
    ]


def describe(tree) -> str:
    """A pytree of numbers on one line, six digits each."""
    values = coordinates.flatten(tree)[0]
    pairs = [f"{name} = {float(x):.6g}" for name, x in zip(coordinates.names(tree), values)]
    shown = pairs if len(pairs) <= 6 else [*pairs[:6], "..."]
    return "(" + ", ".join(shown) + ")"


def explain_singular(matrix, system, s: coordinates.State) -> str | None:
    """Name the coordinate or constraint in which a saddle-point matrix is singular; None if it is not."""
    for i in np.flatnonzero(~np.any(matrix, axis=1)):
        return _singular_message(i, system, s)
    _, values, right = np.linalg.svd(_equilibrate(matrix))
    if values[-1] > SINGULAR_BELOW[matrix.dtype] * values[0]:
        return None
    return _singular_message(int(np.argmax(np.abs(right[-1]))), system, s)


def _equilibrate(matrix):
    """Scale rows and columns alike until each row's largest entry is near one (Ruiz)."""
    scaled = matrix.copy()
    for _ in range(20):
        scale = 1 / np.sqrt(np.max(np.abs(scaled), axis=1))
        scaled = scale[:, None] * scaled * scale[None, :]
    return scaled


def _singular_message(i, system, s):
    names, equations = coordinates.names(s.q), equation_names(system, s)
    n, where = len(names), _where(s)
    if i < n:
        return (
            f"the mass matrix is singular in coordinate '{names[i]}' {where}: its acceleration is not "
            "determined.\nUsual cause: a coordinate singularity (an azimuth at the pole), a coordinate "
            "whose velocity is missing from L, or a zero mass.\n"
            f"Fix: leave the singular point (or use Cartesian coordinates with a constraint), or give "
            f"'{names[i]}' a kinetic energy or a constraint that determines it."
        )
    return (
        f"constraint '{equations[i - n]}' does not act independently of the others {where}: its multiplier is "
        "not determined.\nUsual cause: a constraint given twice or implied by the others, or one whose "
        "derivative vanishes there.\n"
        f"Fix: remove '{equations[i - n]}', or write it so that its derivative does not vanish."
    )


def _where(s):
    return f"at t = {float(s.t):.6g}, q = {describe(s.q)}, v = {describe(s.v)}"


@eqx.filter_jit
def _constraint_force(system, t, q, v, params, multipliers):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    forces = {}
    for name, constraint in system.constraints.items():
        alone = eqx.tree_at(lambda s: s.constraints, system, {name: constraint})
        rows = constraints.acceleration_rows(alone, t, x, u, params, unflatten)
        forces[name] = unflatten(rows.jacobian.T @ jnp.atleast_1d(multipliers[name]))
    return forces


@eqx.filter_jit
def _constraint_residual(system, t, q, v, params, level):
    if level == "velocity":
        x, unflatten = coordinates.flatten(q)
        u, _ = coordinates.flatten(v)
        stacked = constraints.velocity_residual(system, t, x, u, params, unflatten)
        return constraints.split(system, stacked, t, q, v, params)
    return {name: constraints.evaluate(constraint, t, q, v, params) for name, constraint in system.constraints.items()}
