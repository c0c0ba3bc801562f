"""Inverse dynamics: the generalized force that gives a motion the accelerations asked for.

Lagrange's equations, read from right to left. With `p = ∂L/∂v`, of any motion through the state (q, v) with the
acceleration a,

    M a = F + Aᵀ λ + τ        τ = dp/dt - ∂L/∂q - Q + ∂R/∂v - Aᵀ λ,        dp/dt = ∂p/∂t + (∂p/∂q) v + (∂p/∂v) a

and dp/dt is one derivative of p along (1, v, a): M is never formed and nothing is solved, so that the work grows as
that of L. Without constraints this is all: Pinocchio's `rnea`, and the `qfrc_inverse` of MuJoCo's `mj_inverse`. A tree
of bodies knows M a - F of its L by the recursion of Newton and Euler (`lagjax/bodies/motion.py`), of a third as many
operations as these derivatives: an arm of three joints has its first answer in 1.5 s of processor time in place of 10.

*With constraints* an acceleration does not say what its force is. A force Aᵀ μ along the constraints changes their
multipliers and no motion: τ + Aᵀ μ with λ - μ is as good. (MuJoCo's constraints are soft: there the acceleration says
how far each gives way, and so what it carries. Hard ones do not give way.) Taken is the τ that leaves all multipliers
as they are without it, those of `accelerations`:

    τ = M (a - a₀),   λ = λ₀        of the motion that nothing drives, M a₀ = F + Aᵀ λ₀

It is what has to be added to the forces that act anyway, and by Gauss's principle the least force, in τᵀ M⁻¹ τ, of all
that give a: since A a = A a₀ = gamma, A M⁻¹ τ = 0, and a part Aᵀ μ would be orthogonal to it. Its power τ·w at any
velocity w that the constraints allow is that of every other choice.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §5.1; Udwadia & Kalaba, *Analytical Dynamics*, §3 (Gauss).
"""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, is_traced, one_function_in_both_modes
from lagjax.mechanics.constrained_state import accelerations_at
from lagjax.mechanics.diagnosis import describe
from lagjax.mechanics.lagrangian import (
    applied_force,
    forcing_and_inertia,
    mass_and_forcing,
    resolved,
    response,
    with_states,
)
from lagjax.system import Call, Model, State, System, Traced, constraints, coordinates, prepare, traced_call, with_rates

# How far an acceleration may miss A a = gamma, as a share of the largest term: it may come from a table or a spline.
ADMISSIBLE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}


def inverse_dynamics(
    system: System, t: ArrayLike, q: PyTree, v: PyTree, a: PyTree, params: PyTree
) -> tuple[PyTree[Array], dict[str, Array]]:
    """Return the generalized force that makes the motion through a state have the accelerations `a`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def arm(t, q, v, params):
    ...     return 0.5 * params["m"] * v["elbow"] ** 2 - params["m"] * params["g"] * jnp.sin(q["elbow"])
    >>> system, level, rest = lj.System(arm), {"elbow": 0.0}, {"elbow": 0.0}
    >>> force, _ = inverse_dynamics(system, 0.0, level, rest, {"elbow": 3.0}, {"m": 2.0, "g": 10.0})
    >>> print(force["elbow"])
    26.0

    At rest, `v = a = 0`, it is what holds the system against gravity:

    >>> print(inverse_dynamics(system, 0.0, level, rest, rest, {"m": 2.0, "g": 10.0})[0]["elbow"])
    20.0

    **Arguments:** `t` scalar; `q`, `v` and `a` alike, `a` in `[q]/[t]²`; `params` as L takes it.

    **Returns:** as `accelerations` does:

    - the force τ, like `q`, `[L]/[q]`, in addition to L, the system's force and its dissipation: given to the system as
      its `force`, the accelerations are `a`. Computed in one derivative of the momentum, without a mass matrix;
    - the multipliers by constraint name, of the equations `M a = F + Aᵀ λ + τ`.

    With constraints many forces give the same accelerations. This one leaves every multiplier, and so every contact
    force, as it is without it, and is the least of them, in τᵀ M⁻¹ τ (Gauss). Its power τ·w at a velocity w that the
    constraints allow is that of every other: of a mechanism with one degree of freedom, driven at `q["crank"]`, the
    motor's torque is τ·w / w["crank"]. A state (`states=`) has no
    force, 0, and may be left out of `v` and `a`.

    **Raises:**

    - `ValueError` if `a` is not like `q`, or is none that the constraints allow, by their names (while JAX is tracing
      the values are NaN).
    - `TypeError`, `ValueError` as for `accelerations`; without constraints, M may be singular.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, Eq. (5.1) (without constraints).
    """
    model, s = prepare(system, t, q, v, params)
    a = _like(s, with_rates(system, q, a))
    own = _recursion(system, s, a)
    if not model.m:
        return _force(model, s, a, {}, own), {}
    multipliers = accelerations_at(model, s)[1]
    off, misses = _departure(model, s, a)
    if is_traced((off, misses)):
        a = jtu.tree_map(lambda x: jnp.where(jnp.any(misses), jnp.nan, x), a)
    elif np.any(misses):
        raise ValueError(_inadmissible(model, s, np.asarray(off), np.asarray(misses)))
    return _force(model, s, a, multipliers, own), multipliers


def _recursion(system: System, s: State, a: PyTree) -> Traced | None:
    """M a - F of L alone by the recursion of a tree of bodies, which has one beside its forward dynamics."""
    recursion = getattr(getattr(system.forward_dynamics, "__self__", None), "newton_euler_recursion", None)
    if recursion is None:
        return None
    call = Call("inverse dynamics", recursion, ("t", "q", "v", "a", "params"))
    return traced_call(call, {"t": s.t, "q": s.q, "v": s.v, "a": a, "params": s.params}, lambda call, value: None)


def _like(s: State, a: PyTree) -> PyTree[Array]:
    """The accelerations as arrays of the state's dtype."""
    same = jtu.tree_structure(a) == jtu.tree_structure(s.q)
    if not same or [np.shape(x) for x in jtu.tree_leaves(a)] != [np.shape(x) for x in jtu.tree_leaves(s.q)]:
        has, needs = (", ".join(coordinates.names(x)) or "nothing" for x in (a, s.q))
        raise ValueError(
            f"a must be like q: it has {has}, and q has {needs}.\n"
            "Usual cause: arguments in another order, or an acceleration left out.\n"
            "Fix: lj.inverse_dynamics(system, t, q, v, a, params), with a = jax.tree.map(jnp.zeros_like, q) at rest."
        )
    return coordinates.state(s.t, s.q, a, None).v


@compiled
def _departure(model: Model, s: State, a: PyTree) -> tuple[Float[Array, " m"], Bool[Array, " m"]]:
    """`A a - gamma` of each constraint equation, and where it is more than the terms of it explain."""
    x, u = model.vectors(s.q, s.v)
    rows, a = constraints.acceleration_rows(model, s.t, x, u), model.vector(a)
    share = ADMISSIBLE[np.dtype(x.dtype)]
    # In equilibrium accelerations are round-off, of those that the forces alone would cause.
    mass, forcing, _ = mass_and_forcing(model, s.t, x, u)
    heavy = jnp.diagonal(mass) > 0
    alone = jnp.where(heavy, jnp.abs(forcing) / jnp.where(heavy, jnp.diagonal(mass), 1.0), 0.0)
    off = rows.jacobian @ a - rows.gamma
    size = jnp.abs(rows.jacobian) @ (jnp.abs(a) + share * alone) + jnp.abs(rows.gamma)
    # NaN misses, too.
    return off, ~(jnp.abs(off) <= share * size)


def _inadmissible(model: Model, s: State, off: np.ndarray, misses: np.ndarray) -> str:
    which = ", ".join(f"'{name}' by {x:.3g}" for name, x, miss in zip(model.equation_names, off, misses) if miss)
    return (
        f"the constraints do not allow these accelerations at q = {describe(s.q)}: A a - gamma is not zero, {which}.\n"
        "Usual cause: accelerations of some coordinates, from a plan or a table, with those of others left at zero; "
        "where a constraint bends, a = 0 takes v = 0.\n"
        "Fix: accelerations of one motion that satisfies the constraints, as lj.accelerations(system, t, q, v, params) "
        "gives them, and derivatives of lj.consistent_state along a path."
    )


@compiled
def _force(model: Model, s: State, a: PyTree, multipliers: dict[str, Array], own: Traced | None):
    return one_function_in_both_modes(_force_of, model, s, a, multipliers, own)


def _force_of(model: Model, s: State, a: PyTree, multipliers: dict[str, Array], own: Traced | None):
    # A massless coordinate has the velocity that is given, and the force that it needs.
    model, (x, u) = with_states(model), model.vectors(s.q, s.v)
    first = model.form.first_order
    if own is None:
        forcing, inertia = forcing_and_inertia(model, s.t, x, u)
        force = inertia(model.vector(a)) - forcing
    else:
        force = model.vector(own(*s[:3], a, s.params)) - applied_force(model, s.t, x, resolved(model, s.t, x, u))
    if model.m:
        stacked = model.stacked(multipliers)
        _, pull = jax.vjp(lambda u: constraints.velocity_residual(model, s.t, x, u), u)
        force = force - pull(stacked)[0]
        if (reaction := response(model, s.t, x, u)) is not None:
            force = force - reaction @ stacked
    return model.tree(force if first is None else jnp.where(first.mask(model.n), 0.0, force))
