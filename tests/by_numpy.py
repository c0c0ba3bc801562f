"""Closed forms, Lagrangians and their derivatives evaluated in NumPy: nothing is compiled."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.system import constraints, coordinates
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import run


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


def network(*sizes, **options):
    """A network of equinox's, of random numbers by NumPy."""
    shaped = eqx.filter_eval_shape(lambda: eqx.nn.MLP(*sizes, **options, key=jax.random.key(0)))
    random = np.random.default_rng(0)
    return jax.tree.map(lambda x: random.normal(size=x.shape) if isinstance(x, jax.ShapeDtypeStruct) else x, shaped)


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
