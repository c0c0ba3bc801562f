"""The equations of a small system, written out number by number.

Accelerations, multipliers and the return to the constraints of `saddle_point.py` and `consistency.py`, for systems of a
few coordinates, as straight code on single numbers. The matrix

    [M  Aᵀ] [ a]   [  F  ]
    [A  0 ] [-λ] = [gamma]

is eliminated in the order in which it is written, coordinates before constraints, so that its zeros, which are known
before anything runs, cost nothing. That is as accurate as pivoting where M is definite; where it is not, where
constraints depend on each other, and where a state is too far from the constraints to be returned in two iterations,
the results are NaN: a caller then does it the careful way.

Source: Golub & Van Loan, *Matrix Computations*, §4.1.2 (L D Lᵀ), §4.2.7 (without pivoting where definite).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.constraints import Holonomic, Nonholonomic
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.system import System
from lagjax.numerics import dense
from lagjax.numerics.scalars import written_out

# Coordinates and constraint equations together: beyond, the code grows with their cube.
UP_TO = 8
# Two iterations are enough where the second one moves the state by less than this part of its size.
SMALL_CORRECTION = 1e-7


class InNumbers(eqx.Module):
    """A function of (t, q, v, params) or (t, q, params), taking each state as a tuple of numbers."""

    function: Callable
    unflatten: Callable = eqx.field(static=True)
    returns_coordinates: bool = eqx.field(static=True, default=False)

    def __call__(self, t, *states_and_params):
        *states, params = states_and_params
        result = self.function(t, *(self.unflatten(jnp.stack(state)) for state in states), params)
        return coordinates.numbers(result) if self.returns_coordinates else result


def in_numbers(system: System, unflatten: Callable) -> System:
    """The same system, with a tuple of numbers for q and for v."""
    wrap = lambda function, **kw: None if function is None else InNumbers(function, unflatten, **kw)
    return System(
        wrap(system.lagrangian),
        {
            name: Holonomic(wrap(c.g)) if isinstance(c, Holonomic) else Nonholonomic(wrap(c.phi))
            for name, c in system.constraints.items()
        },
        force=wrap(system.force, returns_coordinates=True),
        dissipation=wrap(system.dissipation),
    )


class WrittenOut(NamedTuple):
    """`equations(system, t, q, v, params)` -> (a, multipliers stacked); `project(same)` -> (q, v).

    `careful` says whether either may give NaN where the careful way does not.
    """

    equations: Callable
    project: Callable | None
    careful: bool


def is_small(system, t, q, v, params) -> bool:
    """Whether the equations of a system are to be written out."""
    size = sum(leaf.size for leaf in jtu.tree_leaves(q))
    return size + constraints.count(system, t, q, v, params) <= UP_TO


def write_out(system, t, q, v, params) -> WrittenOut:
    """The equations of a small system near a state, of which only shapes count."""
    count = constraints.count(system, t, q, v, params)
    args = (system, t, q, v, params)
    diagonal = count == 0 and _is_diagonal(*args)
    project = Numbers(_projected, args) if count else None
    return WrittenOut(Numbers(_equations, args), project, careful=not diagonal)


class Numbers:
    """A function of (system, t, q, v, params), traced once and written out."""

    def __init__(self, function, args):
        arrays, static = eqx.partition(args, eqx.is_array)
        self.shapes = []

        def of_leaves(*leaves):
            args = eqx.combine(jtu.tree_unflatten(jtu.tree_structure(arrays), leaves), static)
            result, shape = jtu.tree_flatten(function(*args))
            self.shapes.append(shape)
            return result

        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jtu.tree_leaves(arrays)]
        program = jax.make_jaxpr(of_leaves)(*like)
        self.program = jax.make_jaxpr(lambda *leaves: written_out(program, *leaves))(*like)
        self.call = jax.jit(jaxpr_as_fun(self.program))

    def __call__(self, *args):
        """The function's result."""
        found = self.call(*jtu.tree_leaves(eqx.filter(args, eqx.is_array)))
        return jtu.tree_unflatten(self.shapes[0], found)


def _equations(system, t, q, v, params):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    if x.size == 1 and not system.constraints:
        return unflatten(linear.forcing / linear.mass[0]), jnp.zeros(0, x.dtype)
    rows = constraints.acceleration_rows(system, t, x, u, params, unflatten)
    solver = dense.Saddle(linear.mass, rows.jacobian)
    a, multipliers = solver.solve(linear.forcing, rows.gamma)
    a = jnp.where(solver.believed, a, jnp.nan)
    return unflatten(a), multipliers


def _projected(system, t, q, v, params):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    mass = mass_and_forcing(system, t, x, u, params, unflatten).mass
    jacobian = constraints.jacobian(system, t, x, u, params, unflatten)
    # Where the residual vanishes, the derivative of the matrix does not count.
    solver = dense.Saddle(*map(lax.stop_gradient, (mass, jacobian)))
    holonomic = constraints.holonomic_equations(system, t, q, v, params)
    still = jnp.zeros_like(x)
    last_x = last_u = still
    if holonomic.any():
        for _ in range(2):
            position = constraints.position_residual(system, t, x, params, unflatten)
            wanted = jnp.zeros(holonomic.size, x.dtype).at[np.flatnonzero(holonomic)].set(-position)
            last_x, _ = solver.solve(still, wanted, refine=False)
            x = x + last_x
    for _ in range(2):
        last_u, _ = solver.solve(still, -constraints.velocity_residual(system, t, x, u, params, unflatten), refine=False)
        u = u + last_u
    near = solver.believed & _tiny(last_x, x) & _tiny(last_u, u)
    return unflatten(jnp.where(near, x, jnp.nan)), unflatten(u)


def _tiny(correction, y) -> Array:
    largest = lambda z: jnp.sum(jnp.abs(z))
    return largest(correction) <= SMALL_CORRECTION * largest(y) + 1e-300


def _is_diagonal(system, t, q, v, params):
    mass = Numbers(lambda *args: _mass(*args), (system, t, q, v, params)).program
    return mass is not None and known_zeros(mass)


def _mass(system, t, q, v, params):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    mass = mass_and_forcing(system, t, x, u, params, unflatten).mass
    return [mass[i, j] for i in range(x.size) for j in range(x.size) if i != j]


def known_zeros(program) -> bool:
    """Whether all results of a written-out program are zeros that are written in it."""
    return all(hasattr(x, "val") and x.val == 0 for x in program.jaxpr.outvars)
