"""The equations of a small system, written out number by number.

Accelerations, multipliers and the return to the constraints of `saddle_point.py` and `projection.py`, for systems of a
few coordinates, as straight-line code on single numbers. The matrix

    [M  Aᵀ] [ a]   [  F  ]
    [A  0 ] [-λ] = [gamma]

is eliminated in the order in which it is written, coordinates before constraints, so that its zeros, which are known
before anything runs, cost nothing. That is as accurate as pivoting where M is definite; where it is not, where
constraints depend on each other, and where a state is too far from the constraints to be returned in two iterations,
the results are NaN: a caller then takes the robust way.

Source: Golub & Van Loan, *Matrix Computations*, §4.1.2 (L D Lᵀ), §4.2.7 (without pivoting where definite).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from lagjax.jaxtools import TooLong, decided, is_array, is_plain
from lagjax.mechanics.first_order import completed, resolved, without_mass
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.multiplier_forces import with_reactions
from lagjax.mechanics.saddle_point import known_at
from lagjax.mechanics.scalar_form import Numbers
from lagjax.mechanics.structure import is_diagonal
from lagjax.numerics import dense
from lagjax.system import Model, constraints

# Coordinates and constraint equations together. Measured on chains: a full mass matrix of nine is as fast in arrays;
# with constraints, whose matrix is mostly zeros, a step is seven times faster up to here, for twice the compile time.
UP_TO, CONSTRAINED_UP_TO = 8, 16
# Products with matrices of this size, as of a network in L, are left to arrays: two coordinates in a network of a
# thousand numbers take 1.7 microseconds written out and 1.1 in arrays, and in reverse 15 and 0.6.
MATRIX = 64
# A program of more operations goes to arrays. With constraints, first answers in processor seconds, written out and in
# arrays: 15 and 22 of a rattleback (1,600 operations); 56 and 40 of a vehicle (6,200), which is above it.
LONG, CONSTRAINED_LONG = 3000, 6000
# Of a longer one, with its return, XLA compiles the derivative in arrays sooner, as it copies what the lanes of several
# directions share: by one number that of a pendulum of a body (3,700 operations) in 50 s of processor time in place of
# 154, that of a rattleback (2,800) in 90 in place of more than 150; a fit of that pendulum in 70 s, written out in more
# than 16 GB.
LONG_TO_DIFFERENTIATE = 2000
# What is not yet without its zeros may be so many times as long.
ON_THE_WAY = 5
# Two iterations are enough where the second one moves the state by less than this share of its size.
SMALL_CORRECTION = 1e-7


class WrittenOut(NamedTuple):
    """`equations(model, t, q, v)` -> (a, multipliers stacked), with more: `Known`; `project(same)` -> (q, v).

    `may_fail` says whether either may give NaN where the robust way does not.
    """

    equations: Numbers
    project: Numbers | None
    may_fail: bool

    @property
    def length(self) -> int:
        """How many operations both programs have."""
        return sum(numbers.length for numbers in (self.equations, self.project) if numbers)


def has_networks(model: Model | PyTree) -> bool:
    """Whether a model, or a system and its parameters, have matrices as large as those of a network."""
    arrays = [x for x in jtu.tree_leaves(model) if is_array(x)]
    return any(x.ndim > 1 and x.size >= MATRIX for x in arrays)


def is_small(model: Model) -> bool:
    """Whether the equations of a system are to be written out."""
    if is_plain() or has_networks(model) or model.solves_itself:
        return False
    if model.n + model.m > (CONSTRAINED_UP_TO if model.m else UP_TO):
        return False
    # A pivot that is zero at every state: the robust way would be compiled as well, and be used.
    return not without_mass(model).any()


def write_out(model: Model) -> WrittenOut | None:
    """Write out the equations of a small system in single numbers. None if L makes them too long."""
    diagonal = model.m == 0 and is_diagonal(model)
    most = CONSTRAINED_LONG if model.m else LONG
    try:
        equations = Numbers(partial(_equations, diagonal), model, most=ON_THE_WAY * most, has_more=True)
    except TooLong:
        return None
    if equations.length > most:
        return None
    project = Numbers(partial(_projected, equations.more), model) if model.is_returned else None
    return WrittenOut(equations, project, may_fail=not diagonal)


def _equations(diagonal, model: Model, t: Array, q: PyTree, v: PyTree):
    x, u = model.vectors(q, v)
    linear = mass_and_forcing(model, t, x, u)
    if model.n == 1 and not model.m:
        a, known = linear.forcing / linear.mass[0], known_at(model, t, x, u, linear.mass, jnp.zeros((0, 1), x.dtype))
        return (model.tree(completed(model, t, x, u, a)), jnp.zeros(0, x.dtype)), known
    rows = constraints.acceleration_rows(model, t, x, u)
    solver = dense.Saddle(linear.mass, rows.jacobian, diagonal, model.off)
    a, multipliers, unique = with_reactions(solver.solve, linear.forcing, rows.gamma, linear.response)
    a = completed(model, t, x, u, a)
    valid = solver.valid if linear.response is None else solver.valid & unique
    a = a if diagonal else jnp.where(decided(valid), a, jnp.nan)
    return (model.tree(a), multipliers), known_at(model, t, x, u, linear.mass, rows.jacobian)


def _projected(known_of: Callable, model: Model, t: Array, q: PyTree, v: PyTree):
    x, u = model.vectors(q, v)
    if not model.m:
        return q, model.tree(resolved(model, t, x, u))
    # M and A of the equations: differentiating L and the constraints once more would take as long as all the rest.
    _, mass, jacobian, _ = known_of(model, t, q, v)
    # The residual vanishes at the solution, so that the derivative of the matrix does not count.
    solver = dense.Saddle(*map(lax.stop_gradient, (mass, jacobian)), off=model.off)
    no_force = jnp.zeros_like(x)
    last_x = last_u = no_force
    if model.holonomic.any():
        for _ in range(2):
            position = iter(constraints.position_residual(model, t, x))
            wanted = jnp.stack([-next(position) if restored else jnp.zeros_like(x[0]) for restored in model.holonomic])
            last_x, _ = solver.solve(no_force, wanted, refine=False)
            x = x + last_x
    for _ in range(2):
        last_u, _ = solver.solve(no_force, -constraints.velocity_residual(model, t, x, u), refine=False)
        u = u + last_u
    near = solver.valid & is_tiny(last_x, x) & is_tiny(last_u, u)
    return model.tree(jnp.where(decided(near), x, jnp.nan)), model.tree(resolved(model, t, x, u))


def is_tiny(correction: Array, y: Array) -> Bool[Array, ""]:
    """Whether Newton's method has arrived: another iteration would move the state by the square of this one."""

    def norm(z: Array) -> Array:
        return jnp.sum(jnp.abs(z))

    return norm(correction) <= SMALL_CORRECTION * norm(y) + 1e-300
