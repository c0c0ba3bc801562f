"""Coordinates of first order: what determines their velocities, not their accelerations.

A row of Lagrange's equations without an acceleration in it is an equation for a velocity. There are two kinds:

    a state z:           v_z = f(t, q, v)                     what the user says of a bristle, an actuator, a cost
    a damped s:          ∂L/∂q_s + Q_s - ∂R/∂v_s = 0          L has no v_s, and this is linear in it

Either way v_first = φ(t, q, v), where φ sees only the other velocities, and along the motion

    a_first = ∂φ/∂t + (∂φ/∂q) v + (∂φ/∂v) a

so that the state stays (q, v), for outputs, events and derivatives. In `M a = F` the rows of these coordinates become
1 a = 0: M stays symmetric, and diagonal or definite if it was for the others. F takes φ for their velocities, whatever
the given ones are, and a_first is put in afterwards.

Source: Hairer & Wanner, *Solving ODEs II*, §VI.1 (index 1); Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995)
419 (a bristle).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from lagjax.jaxtools import Literal, TooLong, depends, once
from lagjax.mechanics.scalar_form import WRITTEN, Numbers, in_numbers
from lagjax.numerics import dense, solve_without_exchanges
from lagjax.system import FirstOrder, Model, unchecked

# Damped coordinates are looked for in systems of up to so many; up to eight are solved for number by number.
UP_TO, ONE_BY_ONE = 24, 8


def with_first_order(model: Model) -> Model:
    """The model that knows which of its coordinates are of first order."""
    system = model.system
    if model.form.first_order is not None or not (system.states or system.force or system.dissipation):
        return model
    leaves, structure = jtu.tree_flatten(model)
    found = _found(structure, tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves))
    return _with(model, found) if found.states or found.damped else model


def of_states(model: Model) -> np.ndarray:
    """Which coordinates are states, (n,) booleans."""
    first = with_first_order(model).form.first_order
    return np.zeros(model.n, bool) if first is None else first._replace(damped=()).mask(model.n)


def _with(model: Model, found: FirstOrder) -> Model:
    return unchecked(model.system, model.params, model.form._replace(first_order=found))


# The equations are traced at several places of one program.
@once
def _found(structure, leaves: tuple) -> FirstOrder:
    model = jtu.tree_unflatten(structure, leaves)
    places = model.tree(np.arange(model.n))
    states = tuple((name, tuple(np.ravel(places[name]).tolist())) for name in model.system.states)
    try:
        return FirstOrder(states, _damped(model, [i for _, among in states for i in among]))
    except TooLong:
        return FirstOrder(states, ())


def _damped(model: Model, states: list[int]) -> tuple[int, ...]:
    """The coordinates without inertia whose velocities force and dissipation determine, by linear equations."""
    system, n = model.system, model.n
    if n > UP_TO or model.reacts or not (system.force or system.dissipation):
        return ()

    def lagrangian(model: Model, *state):
        return model.system.lagrangian(*state, model.params)

    def residuals(model: Model, *state):
        return [c.residual(*state, model.params) for c in model.system.constraints.values()]

    in_lagrangian, in_constraints = (Numbers(f, in_numbers(model), WRITTEN) for f in (lagrangian, residuals))

    def free(i: int) -> bool:
        _, *y = in_constraints.state_variables
        return not _depends(in_lagrangian, 1 + n + i) and not depends(in_constraints.program.jaxpr, [y[i], y[n + i]])

    found = tuple(i for i in range(n) if i not in states and free(i))
    while found:
        slope = Numbers(_slope, in_numbers(_with(model, FirstOrder((), found))), WRITTEN)
        own = np.array(slope.program.jaxpr.outvars, object).reshape(len(found), -1).diagonal()
        left = tuple(i for i, x in zip(found, own) if not (isinstance(x, Literal) and x.val == 0))
        if left == found:
            return () if any(_depends(slope, 1 + n + i) for i in found) else found
        found = left
    return ()


def _depends(numbers: Numbers, place: int) -> bool:
    return depends(numbers.program.jaxpr, [numbers.state_variables[place]])


def _slope(model: Model, t: Array, q: tuple, v: tuple):
    balance, w = _balance(model, t, *model.vectors(q, v))
    return [x for row in jax.jacfwd(balance)(w) for x in row]


def _balance(model: Model, t: Array, x: Array, u: Array):
    """The equations of the damped velocities, as a function of these, and the given ones."""
    first = model.form.first_order
    assert first is not None
    damped = np.array(first.damped)
    chosen = np.eye(model.n, dtype=x.dtype)[damped]
    along_x = jax.grad(model.lagrangian, argnums=1)(t, x, u)

    def balance(w: Array) -> Array:
        v = jnp.where(chosen.sum(0) > 0, w @ chosen, u)
        force = along_x
        if model.system.force is not None:
            force = force + model.force(t, x, v)
        if model.system.dissipation is not None:
            force = force - jax.grad(model.dissipation, argnums=2)(t, x, v)
        return chosen @ force

    return balance, chosen @ u


def resolved(model: Model, t: Array, x: Array, u: Array) -> Float[Array, " n"]:
    """The velocities u, with those of first-order coordinates as they are determined, whatever u says of them."""
    first = model.form.first_order
    if first is None:
        return u
    if first.damped:
        balance, w = _balance(model, t, x, jnp.where(first.mask(model.n), 0.0, u))
        w = _solved(jax.jacfwd(balance)(w), -balance(w))
        u = _put(u, np.array(first.damped), w)
    q, v = model.tree(x), model.tree(u)
    rates = [jnp.ravel(model.system.states[name](t, q, v, model.params)) for name, _ in first.states]
    return _put(u, np.array([i for _, places in first.states for i in places]), jnp.concatenate(rates)) if rates else u


def _put(u: Array, places: np.ndarray, values: Array):
    # A scatter has no form in single numbers.
    to = np.eye(u.size, dtype=u.dtype)[places]
    return jnp.where(to.sum(0) > 0, values.astype(u.dtype) @ to, u)


def _solved(matrix: Array, known: Array):
    if known.size > ONE_BY_ONE:
        return dense.solve(matrix, known)
    x, pivots = solve_without_exchanges([list(row) for row in matrix], list(known))
    # A product, so that derivatives are not numbers either.
    return jnp.stack(x) * jnp.where(jnp.stack(pivots) != 0, 1.0, jnp.nan)


def completed(model: Model, t: Array, x: Array, u: Array, a: Array) -> Float[Array, " n"]:
    """The accelerations a, with those of first-order coordinates."""
    first = model.form.first_order
    if first is None:
        return a
    mask = first.mask(model.n)
    along = jnp.ones_like(t), resolved(model, t, x, u), jnp.where(mask, 0.0, a)
    return jnp.where(mask, jax.jvp(lambda *state: resolved(model, *state), (t, x, u), along)[1], a)
