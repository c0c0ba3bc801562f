"""What both regulators take from a system and a cost: derivatives of accelerations, and second derivatives.

On constraints a deviation is no straight line. With G = ∂g/∂q and its pseudoinverse G⁺, what g = 0 bends it by is

    q = q₀ + δq + q₂,    q₂ = -½ G⁺ g''(δq, δq),    v = v₀ + δv + v₂,    v₂ = dq₂/dt

to the second order, and by A⁺ as much more of v₂ as velocity constraints with A = ∂phi/∂v ask for. A cost with slopes
c_q, c_v has second derivatives to which those of c_q·q₂ + c_v·v₂ are added; for a slope along the normal, c_q = Gᵀ λ,
they are -λ·g'', as everywhere on a manifold.

Source: Nocedal & Wright, *Numerical Optimization*, §12.5 (the second-order condition).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax.jaxtools import compiled
from lagjax.mechanics import accelerations_at
from lagjax.system import Form, State, constraints, coordinates, unchecked
from lagjax.two_points.question import Controlled

# Rows of constraints with smaller singular values, relative, say nothing that others do not.
DEPENDENT = 1e-10


@compiled
def linear(given: Controlled, cost: Callable, x: Array, u: Array, w: Array):
    """The accelerations with their derivatives, and the first and second derivatives of the cost."""
    form: Form = given.form

    def a(x: Array, u: Array, w: Array):
        model = unchecked(given.system, given.merge(given.state.params, coordinates.like(given.controls, w)), form)
        s = State(given.state.t, form.tree(x), form.tree(u), model.params)
        return coordinates.flatten(accelerations_at(model, s)[0])[0]

    def of_all(y: Array):
        x, u, w = jnp.split(y, (form.n, 2 * form.n))
        s = given.state
        return cost(s.t, form.tree(x), form.tree(u), coordinates.like(given.controls, w), s.params)

    y = jnp.concatenate([x, u, w])
    slope, curvature = jax.grad(of_all)(y), jax.hessian(of_all)(y)
    if form.m:
        states = 2 * form.n
        more = bent(given, x, u, w, slope[:states])
        curvature = curvature.at[:states, :states].add(more)
    return a(x, u, w), jax.jacfwd(a, argnums=(0, 1, 2))(x, u, w), slope, curvature


def bent(given: Controlled, x: Array, u: Array, w: Array, slope: Array) -> Float[Array, "m m"]:
    """What constraints add to the second derivatives (2n, 2n) of a cost with this slope (2n,) in x and u."""
    model = unchecked(given.system, given.merge(given.state.params, coordinates.like(given.controls, w)), given.form)
    t, n = given.state.t, given.form.n

    def g(t: Array, x: Array) -> Array:
        return constraints.position_residual(model, t, x)

    def second(t: Array, x: Array, dx: Array) -> Array:
        """q₂."""
        rows = jax.jacfwd(g, argnums=1)(t, x)
        bends = jax.jvp(lambda x: jax.jvp(lambda x: g(t, x), (x,), (dx,))[1], (x,), (dx,))[1]
        return -0.5 * jnp.linalg.pinv(rows, rtol=DEPENDENT) @ bends

    def rates(x: Array, u: Array) -> Array:
        return constraints.velocity_residual(model, t, x, u)

    def of_deviation(d: Array) -> Array:
        dx, du = d[:n], d[n:]
        q_2, v_2 = jnp.zeros_like(x), jnp.zeros_like(x)
        if model.holonomic.any():
            q_2, v_2 = jax.jvp(second, (t, x, dx), (jnp.ones_like(t), u, du))
        if not model.holonomic.all():
            along = jax.jvp(lambda x, u: jax.jvp(rates, (x, u), (dx, du))[1], (x, u), (dx, du))[1]
            off = 0.5 * along + jax.jvp(rates, (x, u), (q_2, v_2))[1]
            v_2 = v_2 - jnp.linalg.pinv(jax.jacfwd(rates, argnums=1)(x, u), rtol=DEPENDENT) @ off
        return slope[:n] @ q_2 + slope[n:] @ v_2

    return jax.hessian(of_deviation)(jnp.zeros_like(slope))


def check_weights(weights: np.ndarray, names: list[str]):
    """Raise for a control that costs nothing."""
    values, vectors = np.linalg.eigh(weights)
    if values[0] <= 1e-12 * max(values[-1], 0.0):
        name = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise ValueError(
            f"the control '{name}' costs nothing, and the least cost would take it without limit.\n"
            f'Fix: + 1e-3 * u["{name}"] ** 2 in the cost.'
        )
