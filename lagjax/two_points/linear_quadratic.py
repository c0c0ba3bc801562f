"""What both regulators take from a system and a cost: derivatives of accelerations, and second derivatives."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lagjax.jaxtools import compiled
from lagjax.mechanics import accelerations_at
from lagjax.system import Form, State, coordinates, unchecked
from lagjax.two_points.question import Controlled


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
    return a(x, u, w), jax.jacfwd(a, argnums=(0, 1, 2))(x, u, w), jax.grad(of_all)(y), jax.hessian(of_all)(y)


def check_weights(weights: np.ndarray, names: list[str]):
    """Raise for a control that costs nothing."""
    values, vectors = np.linalg.eigh(weights)
    if values[0] <= 1e-12 * max(values[-1], 0.0):
        name = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise ValueError(
            f"the control '{name}' costs nothing, and the least cost would take it without limit.\n"
            f'Fix: + 1e-3 * u["{name}"] ** 2 in the cost.'
        )
