"""What a Lagrangian says about one state: momentum, mass matrix, forcing, Jacobi integral.

With `p = ∂L/∂v`, Lagrange's equations `dp/dt = ∂L/∂q + Q - ∂R/∂v` become linear in the acceleration a:

    M a = F,    M = ∂²L/∂v∂v,    F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v

because `dp/dt = ∂p/∂t + (∂p/∂q) v + M a`. One linearization of `p(t, q, v)` gives all of it: pushed along
`(1, v, 0)` the middle terms of F (Coriolis and gyroscopic terms live there), pushed along the unit
velocities the columns of M. The mixed second derivatives are never formed as an array.

Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (1.70), (2.53).

*Coordinates of first order:* what determines their velocities, not their accelerations. A row of Lagrange's equations
without an acceleration in it is an equation for a velocity. There are two kinds:

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

*Forces that depend on multipliers*, as Coulomb's friction does on the normal force. A force Q = Q₀ + B λ acts in
addition to the constraints' own, Aᵀ λ:

    M a - Aᵀ λ = F + B λ,    A a = gamma

The equations without B λ have the same matrix, and their solution, which is linear in the force, solves these too. With
(a₀, λ₀) for F, (a_j, λ_j) for each column of B alone, and R the matrix with the columns λ_j,

    (I - R) λ = λ₀,    a = a₀ + Σ_j λ_j a_j

Where a pivot of I - R is below zero there is no motion, or there are two: friction pushes a contact together harder
than the contact pushes it apart (Painlevé's paradox). This counts as singular.

Source: Painlevé, *Leçons sur le frottement* (1895); Génot & Brogliato, Eur. J. Mech. A/Solids 18 (1999) 653, §2.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, once, pattern
from lagjax.numerics import SINGULAR_BELOW, dense, reciprocal_condition, solve_without_exchanges
from lagjax.system import FirstOrder, Model, State, System, constraints, prepare, unchecked


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


def with_states(model: Model) -> Model:
    """The model that knows its states, and takes massless coordinates as all others."""
    first = with_first_order(model).form.first_order
    return _with(model, first._replace(massless=())) if first is not None and first.states else model


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


# The pivots of I - R must be above this; without friction they are one.
PIVOT_ABOVE = 1e-10


class Reactions(NamedTuple):
    """The solution of the equations, and whether it is the only one."""

    a: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    unique: Bool[Array, ""]


def force_with_ones(model: Model) -> Callable:
    """The force with all multipliers one: a function of the state alone that depends on the same arguments."""
    return lambda t, q, v, params: model.of(params).force_at(t, q, v, jnp.ones(model.m, jnp.result_type(t)))


def response(model: Model, t: Array, x: Array, u: Array) -> Float[Array, "n m"] | None:
    """B, the change of the force with each multiplier; None if it does not depend on them."""
    if not model.reacts:
        return None
    return jax.jacfwd(lambda multipliers: model.force(t, x, u, multipliers))(jnp.zeros(model.m, x.dtype))


def one_by_one(solve: Callable, loads: list[tuple]) -> list[tuple]:
    """(a, λ) for each of these (forcing, gamma)."""
    return [solve(*load) for load in loads]


def at_once(solve: Callable, loads: list[tuple]) -> list[tuple]:
    """The same in lanes, which share what does not depend on them: the inverse of the matrix."""
    forcing, gamma = (jnp.stack(x) for x in zip(*loads))
    return list(zip(*jax.vmap(solve)(forcing, gamma)))


def with_reactions(
    solve: Callable, forcing: Array, gamma: Array, response: Array | None, each: Callable = one_by_one
) -> Reactions:
    """Solve the equations with the force B λ, given `solve(forcing, gamma)` -> (a, λ) for those without it."""
    if response is None:
        return Reactions(*solve(forcing, gamma), jnp.asarray(True))
    count, still = response.shape[1], jnp.zeros_like(gamma)
    (a, multipliers), *columns = each(solve, [(forcing, gamma), *((response[:, j], still) for j in range(count))])
    # The rows of I - R, and λ₀ as the right-hand side.
    rows = [[(1.0 if i == j else 0.0) - columns[j][1][i] for j in range(count)] for i in range(count)]
    known, pivots = solve_without_exchanges(rows, [multipliers[i] for i in range(count)])
    unique = jnp.all(jnp.stack(pivots) > PIVOT_ABOVE)
    for (along, _), size in zip(columns, known):
        a = a + size * along
    return Reactions(a, jnp.stack(known), unique)


class LinearEquation(NamedTuple):
    """The equation `M a = F` at one state, in vector form.

    `response`: B of a force F + B λ that depends on multipliers; None where it does not.
    """

    mass: Float[Array, "n n"]
    forcing: Float[Array, " n"]
    response: Float[Array, "n m"] | None


def mass_and_forcing(model: Model, t: Array, x: Array, u: Array) -> LinearEquation:
    """M and F at the state with position vector `x` and velocity vector `u`."""
    forcing, inertia = forcing_and_inertia(model, t, x, u)
    if x.size == 1:
        mass = inertia(jnp.ones_like(u))[None]
    else:
        # One column of M for each velocity, stacked as rows: M is symmetric.
        mass = jax.vmap(inertia)(jnp.eye(x.size, dtype=x.dtype))
    return LinearEquation(mass.astype(x.dtype), forcing, response(model, t, x, u) if model.reacts else None)


def forcing_and_inertia(model: Model, t: Array, x: Array, u: Array):
    """F at a state without the part of the multipliers, and the function that multiplies an acceleration by M."""
    u = resolved(model, t, x, u)

    def momentum_and_gradient(t: Array, x: Array, u: Array):
        gradient, p = jax.grad(model.lagrangian, argnums=(1, 2))(t, x, u)
        return p, gradient

    _, push, gradient = jax.linearize(momentum_and_gradient, t, x, u, has_aux=True)
    zero_t, zero = jnp.zeros_like(t), jnp.zeros_like(x)
    # ∂p/∂t + (∂p/∂q) v: the part of dp/dt that does not involve the acceleration.
    forcing = gradient - push(jnp.ones_like(t), u, zero) + applied_force(model, t, x, u)
    first = model.form.first_order
    if first is None:
        return forcing.astype(x.dtype), lambda a: push(zero_t, zero, a)
    mask = first.mask(model.n)
    return jnp.where(mask, 0.0, forcing).astype(x.dtype), lambda a: push(zero_t, zero, a) + mask.astype(x.dtype) * a


def applied_force(model: Model, t: Array, x: Array, u: Array, multipliers: Array | None = None) -> Float[Array, " n"]:
    """`Q - ∂R/∂v`; without `multipliers` for those of zero."""
    force = jnp.zeros_like(x)
    if model.system.force is not None:
        force = force + model.force(t, x, u, multipliers)
    if model.system.dissipation is not None:
        force = force - jax.grad(model.dissipation, argnums=2)(t, x, u)
    return force


def momentum(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> PyTree[Float[Array, "..."]]:
    """Return the canonical momentum `p = ∂L/∂v`.

    >>> import lagjax as lj
    >>> free = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2)
    >>> print(momentum(free, 0.0, 0.0, 3.0, {"m": 2.0}))
    6.0

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as L takes it.

    **Returns:** p with the structure of `q`, `[L] [t]/[q]`.

    **Raises:** `TypeError`, `ValueError` for a state of the wrong dtype or shape, or an L that is not scalar.

    Source: Goldstein, Eq. (2.44).
    """
    model, s = prepare(system, t, q, v, params)
    return _momentum(model, s)


def mass_matrix(
    system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree, *, by_name: bool = False
) -> PyTree[Float[Array, "..."]]:
    """Return the mass matrix `M = ∂²L/∂v∂v`.

    >>> import lagjax as lj
    >>> bead = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v["angle"] ** 2 * params["radius"] ** 2)
    >>> print(mass_matrix(bead, 0.0, {"angle": 0.0}, {"angle": 0.0}, {"m": 2.0, "radius": 3.0}))
    [[18.]]

    Of several coordinates, by their names:

    >>> cart = lj.System(lambda t, q, v, p: 1.5 * v["x"] ** 2 + v["x"] * v["angle"] + 0.5 * v["angle"] ** 2)
    >>> mass = mass_matrix(cart, 0.0, {"x": 0.0, "angle": 0.0}, {"x": 0.0, "angle": 0.0}, None, by_name=True)
    >>> print(mass["x"]["x"], mass["x"]["angle"], mass["angle"]["angle"])
    3.0 1.0 1.0

    **Arguments:** as for `momentum`; `by_name`: whether in blocks by name, `M[row][column]`, as `jax.hessian` returns
    them: like `q`, and in it for each coordinate again like `q`.

    **Returns:** M (n, n), symmetric, rows and columns in the order of `jax.tree.leaves(q)` (the entries of a dict by
    the alphabet: "angle", then "x" above), `[L] [t]²/([q][q])`. It may be singular or indefinite.

    **Raises:** as for `momentum`.

    Source: Goldstein, Eq. (1.71).
    """
    model, s = prepare(system, t, q, v, params)
    return _mass_blocks(model, s) if by_name else _mass_matrix(model, s)


def jacobi_integral(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
    """Return the Jacobi integral `h = v·p - L`.

    It is constant where L does not depend on time, no force or dissipation acts and no constraint moves;
    it equals T + V only for natural, time-independent coordinates.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> print(jacobi_integral(fall, 0.0, 1.0, 2.0, {"g": 10.0}))
    12.0

    **Arguments:** as for `momentum`.

    **Returns:** h, scalar, `[L]`.

    **Raises:** as for `momentum`.

    Source: Goldstein, Eq. (2.53).
    """
    model, s = prepare(system, t, q, v, params)
    return _jacobi_integral(model, s)


@compiled
def _momentum(model: Model, s: State):
    return model.tree(jax.grad(model.lagrangian, argnums=2)(s.t, *model.vectors(s.q, s.v)))


@compiled
def _mass_matrix(model: Model, s: State):
    return mass_and_forcing(model, s.t, *model.vectors(s.q, s.v)).mass


@compiled
def _mass_blocks(model: Model, s: State):
    mass = mass_and_forcing(model, s.t, *model.vectors(s.q, s.v)).mass
    return jtu.tree_map(lambda rows: model.tree(jnp.moveaxis(rows, 0, -1)), model.tree(mass.T))


@compiled
def _jacobi_integral(model: Model, s: State):
    x, u = model.vectors(s.q, s.v)
    value, p = jax.value_and_grad(model.lagrangian, argnums=2)(s.t, x, u)
    return u @ p - value
