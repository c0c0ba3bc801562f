"""Closed forms, Lagrangians and their derivatives evaluated in NumPy: nothing is compiled."""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.jaxtools.jaxpr import applied, interpreted
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.system import constraints, coordinates
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import PLAIN, WITH_PARAMETERS

# What is not in `tests.jaxtools.in_numpy`.
MORE = {
    "acos": np.arccos, "acosh": np.arccosh, "asin": np.arcsin, "asinh": np.arcsinh, "atan": np.arctan,
    "atanh": np.arctanh, "copy": np.copy, "cosh": np.cosh, "expm1": np.expm1, "sinh": np.sinh, "tan": np.tan,
    "stop_gradient": np.copy,
}  # fmt: skip
MORE_WITH_PARAMETERS = {
    "pad": lambda x, value, padding_config: np.pad(x, [row[:2] for row in padding_config], constant_values=value),
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "stack": lambda *x, axis: np.stack(x, axis),
    "unstack": lambda x, axis: list(np.moveaxis(x, axis, 0)),
}


def numbers(*args):
    """Arguments of any kind as arrays of floats."""
    return jax.tree.map(lambda x: np.asarray(x, float), args)


def by_numpy(function):
    """The same function of trees of numbers, one operation of NumPy's after the other; traced once for each shape."""
    programs = {}

    def evaluated(*args):
        leaves, structure = jax.tree.flatten(numbers(*args))
        kind = structure, *(x.shape for x in leaves)
        if kind not in programs:
            shaped = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(structure, leaves))
            programs[kind] = shaped[0], jax.tree.structure(shaped[1])
        program, results = programs[kind]
        return jax.tree.unflatten(results, run(program, *leaves))

    return evaluated


def run(closed, *args):
    """The results of a program."""

    def rule(equation, operands):
        name, params = equation.primitive.name, equation.params
        if name in (plain := PLAIN | MORE):
            found = plain[name](*operands)
        elif name in (others := WITH_PARAMETERS | MORE_WITH_PARAMETERS | {"scan": _loop}):
            found = others[name](*operands, **params)
        else:
            found = applied(closed.jaxpr, equation, operands)
        found = found if isinstance(found, list) else [found]
        return [np.asarray(x, like.aval.dtype) for x, like in zip(found, equation.outvars)]

    with np.errstate(all="ignore"):
        return interpreted(closed, list(args), rule, lambda x, aval: np.asarray(x, aval.dtype))


def _loop(*operands, jaxpr, length, reverse, num_consts, num_carry, **_):
    last = num_consts + num_carry
    fixed, carry, each, rows = operands[:num_consts], operands[num_consts:last], operands[last:], [None] * length
    for i in range(length)[:: -1 if reverse else 1]:
        found = run(jaxpr, *fixed, *carry, *(x[i] for x in each))
        carry, rows[i] = found[:num_carry], found[num_carry:]
    return [*carry, *map(np.stack, zip(*rows))]


class Equations(NamedTuple):
    """M a = F + Aᵀ λ, A a = gamma at states (n, ...), and what solves them: a like q, λ by name."""

    mass: np.ndarray
    force: np.ndarray
    rows: np.ndarray
    gamma: np.ndarray
    a: dict
    multipliers: dict


# By the id of a system, which is kept so that no other gets it: the system, and its equations in NumPy.
KNOWN: dict = {}


def matrices(system):
    """M, F, A and gamma by lagjax, as a function of a state in NumPy."""

    def at(t, q, v, params):
        model = model_of(system, t, q, v, params)
        x, u = model.vectors(q, v)
        linear, rows = mass_and_forcing(model, t, x, u), constraints.acceleration_rows(model, t, x, u)
        return linear.mass, linear.forcing, rows.jacobian, rows.gamma

    return KNOWN.setdefault(id(system), (system, by_numpy(at)))[1]


def equations(system, t, q, v, params):
    """The equations of motion at one state, by lagjax's derivatives and solved by NumPy's."""
    state = coordinates.state(t, q, v, params)
    mass, force, rows, gamma = matrices(system)(*state)
    zero = np.zeros((len(gamma), len(gamma)))
    both = np.block([[mass, -rows.T], [rows, zero]]), np.concatenate([force, gamma])
    try:
        found = np.linalg.solve(*both)
    except np.linalg.LinAlgError:
        # Of dependent constraints.
        found = np.linalg.lstsq(*both)[0]
    model = model_of(system, *state)
    return Equations(mass, force, rows, gamma, model.tree(found[: len(force)]), model.split(found[len(force) :]))
