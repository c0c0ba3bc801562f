"""Coordinates of first order: what determines their velocities, not their accelerations.

A row of Lagrange's equations without an acceleration in it is an equation for a velocity. There are two kinds:

    a state z:           v_z = f(t, q, v)                     what the user says of a bristle, an actuator, a cost
    a massless s:        ∂L/∂q_s - dp_s/dt + Q_s - ∂R/∂v_s = 0          p_s does not contain v, this is linear in it

The second is a point on a damper, or a vortex or guiding centre with a term A_s(q) v_s in L, where p_s = A_s and its
row is Σ_r K_sr v_r + ... = 0 with K_sr = ∂A_r/∂q_s - ∂A_s/∂q_r. The rows of all massless coordinates are solved
together. Either way v_first = φ(t, q, v), where φ sees only the other velocities, and along the motion

    a_first = ∂φ/∂t + (∂φ/∂q) v + (∂φ/∂v) a

so that the state stays (q, v), for outputs, events and derivatives. In `M a = F` the rows of these coordinates become
1 a = 0: M stays symmetric, and diagonal or definite if it was for the others. F takes φ for their velocities, whatever
the given ones are, and a_first is put in afterwards.

Source: Hairer & Wanner, *Solving ODEs II*, §VI.1 (index 1); Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995)
419 (a bristle); Faddeev & Jackiw, Phys. Rev. Lett. 60 (1988) 1692 (L linear in velocities).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax.jaxtools import once, pattern
from lagjax.numerics import SINGULAR_BELOW, dense, reciprocal_condition
from lagjax.system import FirstOrder, Model, constraints, unchecked


def with_first_order(model: Model) -> Model:
    """The model that knows which of its coordinates are of first order."""
    system = model.system
    if model.form.first_order is not None or system.in_phases:
        return model
    leaves, structure = jtu.tree_flatten(model)
    found = _found(structure, tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves))
    return _with(model, found) if found.states or found.massless else model


def of_states(model: Model) -> np.ndarray:
    """Which coordinates are states, (n,) booleans."""
    first = with_first_order(model).form.first_order
    return np.zeros(model.n, bool) if first is None else first._replace(massless=()).mask(model.n)


def without_mass(model: Model) -> Bool[np.ndarray, " n"]:
    """Which rows of M are zero at every state: coordinates whose momenta contain no velocity, not of first order."""
    first = model.form.first_order
    leaves, structure = jtu.tree_flatten(model)
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    return ~_heavy(structure, shapes) & ~(np.zeros(model.n, bool) if first is None else first.mask(model.n))


def _with(model: Model, found: FirstOrder) -> Model:
    return unchecked(model.system, model.params, model.form._replace(first_order=found))


# The equations are traced at several places of one program.
@once
def _found(structure, leaves: tuple) -> FirstOrder:
    model = jtu.tree_unflatten(structure, leaves)
    places = model.tree(np.arange(model.n))
    states = tuple((name, tuple(np.ravel(places[name]).tolist())) for name in model.system.states)
    known = [i for _, among in states for i in among]
    return FirstOrder(states, () if model.reacts or model.solves_itself else _massless(structure, leaves, known))


@once
def _heavy(structure, leaves: tuple) -> Bool[np.ndarray, " n"]:
    """The coordinates whose momenta contain velocities."""
    model = jtu.tree_unflatten(structure, leaves)
    t, y = (jax.ShapeDtypeStruct(shape, model.form.dtype) for shape in ((), (model.n,)))

    def momentum(u: Array, x: Array, given: tuple) -> Array:
        arrays, t = given
        model = jtu.tree_unflatten(structure, [leaf if x is None else x for x, leaf in zip(arrays, leaves)])
        return jax.grad(model.lagrangian, argnums=2)(t, x, u)

    given = [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves], t
    return np.asarray(pattern(momentum, y, y, given).any(axis=1))


def _massless(structure, leaves: tuple, states: list[int]) -> tuple[int, ...]:
    """The coordinates whose momenta contain no velocity, and whose equations contain velocities of such coordinates."""
    model = jtu.tree_unflatten(structure, leaves)
    t, y = (jax.ShapeDtypeStruct(shape, model.form.dtype) for shape in ((), (model.n,)))
    given = [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves], t

    def at(given: tuple, first: FirstOrder | None = None) -> tuple[Model, Array]:
        arrays, t = given
        model = jtu.tree_unflatten(structure, [leaf if x is None else x for x, leaf in zip(arrays, leaves)])
        return model if first is None else _with(model, first), t

    def residual(y: Array, given: tuple) -> Array:
        model, t = at(given)
        x, u = jnp.split(y, 2)
        return constraints.velocity_residual(model, t, x, u)

    heavy = _heavy(structure, leaves)
    if heavy.all():
        return ()
    held = np.zeros(2 * model.n, bool)
    if model.m:
        held = pattern(residual, jax.ShapeDtypeStruct(held.shape, y.dtype), given).any(axis=0)
    light = ~(heavy | held.reshape(2, -1).any(axis=0))
    found = tuple(i for i in np.flatnonzero(light).tolist() if i not in states)
    while found:
        first = FirstOrder((), found)
        w = jax.ShapeDtypeStruct((len(found),), y.dtype)

        def row(w: Array, x: Array, u: Array, given: tuple, first: FirstOrder = first) -> Array:
            model, t = at(given, first)
            return _balance(model, t, x, u)[0](w)

        def slope(w: Array, along: Array, *rest, row: Callable = row) -> Array:
            return jax.jvp(lambda w: row(w, *rest), (w,), (along,))[1]

        contain = pattern(row, w, y, y, given).any(axis=1)
        left = tuple(i for i, contains in zip(found, contain) if contains)
        if left == found:
            return () if pattern(slope, w, w, y, y, given).any() else found
        found = left
    return ()


def _balance(model: Model, t: Array, x: Array, u: Array):
    """The equations of the massless velocities, as a function of these, and the given ones."""
    first = model.form.first_order
    assert first is not None
    massless = np.array(first.massless)
    chosen = np.eye(model.n, dtype=x.dtype)[massless]

    def balance(w: Array) -> Array:
        v = jnp.where(chosen.sum(0) > 0, w @ chosen, u)
        along_x = jax.grad(model.lagrangian, argnums=1)(t, x, v)
        momentum = jax.grad(model.lagrangian, argnums=2)
        _, change = jax.jvp(lambda t, x: momentum(t, x, v), (t, x), (jnp.ones_like(t), v))
        force = along_x - change
        if model.system.force is not None:
            force = force + model.force(t, x, v)
        if model.system.dissipation is not None:
            force = force - jax.grad(model.dissipation, argnums=2)(t, x, v)
        return chosen @ force

    return balance, chosen @ u


def balance_matrix(model: Model, t: Array, x: Array, u: Array) -> Float[Array, "k k"]:
    """The matrix of the equations of the massless velocities."""
    balance, w = _balance(model, t, x, u)
    return jax.jacfwd(balance)(w)


def is_determined(model: Model, t: Array, x: Array, u: Array) -> Bool[Array, ""]:
    """Whether the massless velocities are."""
    first = model.form.first_order
    if first is None or not first.massless:
        return jnp.asarray(True)
    return reciprocal_condition(balance_matrix(model, t, x, u)) > SINGULAR_BELOW[np.dtype(x.dtype)]


def resolved(model: Model, t: Array, x: Array, u: Array) -> Float[Array, " n"]:
    """The velocities u, with those of first-order coordinates as they are determined, whatever u says of them."""
    first = model.form.first_order
    if first is None:
        return u
    if first.massless:
        balance, w = _balance(model, t, x, jnp.where(first.mask(model.n), 0.0, u))
        w = dense.solve(jax.jacfwd(balance)(w), -balance(w))
        u = _put(u, np.array(first.massless), w)
    q, v = model.tree(x), model.tree(u)
    rates = [jnp.ravel(model.system.states[name](t, q, v, model.params)) for name, _ in first.states]
    return _put(u, np.array([i for _, places in first.states for i in places]), jnp.concatenate(rates)) if rates else u


def _put(u: Array, places: np.ndarray, values: Array):
    # A scatter has no form in single numbers.
    to = np.eye(u.size, dtype=u.dtype)[places]
    return jnp.where(to.sum(0) > 0, values.astype(u.dtype) @ to, u)


def completed(model: Model, t: Array, x: Array, u: Array, a: Array) -> Float[Array, " n"]:
    """The accelerations a, with those of first-order coordinates."""
    first = model.form.first_order
    if first is None:
        return a
    mask = first.mask(model.n)
    along = jnp.ones_like(t), resolved(model, t, x, u), jnp.where(mask, 0.0, a)
    return jnp.where(mask, jax.jvp(lambda *state: resolved(model, *state), (t, x, u), along)[1], a)
