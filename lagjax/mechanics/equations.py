"""The equations of a system: everything asked of them at a state, and the one place that knows how to solve them.

There are four ways. A system with forward dynamics of its own is solved by these (`saddle_point.py`). The robust
way works in arrays: one matrix (`saddle_point.py`), or a band where the system is large and its parts touch few others
(`sparse_saddle_point.py`). It exchanges rows, leaves dependent constraints out and says what is wrong. The fast way is
for small systems: their equations are also written out number by number (`write_out`), which is many times as
fast, and gives NaN where it fails.

Either may be taken for regular, by callers who solve again if they find NaN: no program then contains the robust way.
In one matrix all constraint equations are solved with, which compiles in two thirds of the time; not where there are
as many as coordinates, as some then depend on others if anything moves.

A caller has an `Equations` and does not choose between them.

*Number by number* the accelerations, multipliers and the return to the constraints of a system of a few coordinates are
straight-line code on single numbers. The matrix

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

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.contexts import WATCHED
from lagjax.jaxtools import (
    TooLong,
    compiled,
    decided,
    depends,
    is_array,
    is_plain,
    jitted,
    kept_as_call,
    length,
    once,
    one_function,
)
from lagjax.mechanics.lagrangian import (
    completed,
    is_determined,
    mass_and_forcing,
    resolved,
    with_first_order,
    with_reactions,
    without_mass,
)
from lagjax.mechanics.saddle_point import (
    Dense,
    ForwardDynamics,
    Verdict,
    corrected,
    is_regular,
    known_at,
    largest_of_rows,
    slightly_off,
)
from lagjax.mechanics.sparse_saddle_point import Banded, plan
from lagjax.mechanics.structure import Numbers, in_numbers, is_diagonal
from lagjax.numerics import dense
from lagjax.system import Form, Model, constraints, coordinates

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

    `may_fail` says whether either may give NaN where the robust way does not. With `force_apart` the force is computed
    in arrays, and is an argument of `equations`.
    """

    equations: Numbers
    project: Numbers | None
    may_fail: bool
    force_apart: bool = False

    @property
    def length(self) -> int:
        """How many operations both programs have."""
        return sum(numbers.length for numbers in (self.equations, self.project) if numbers)


def has_networks(model: Model | PyTree) -> bool:
    """Whether a model, or a system and its parameters, have matrices as large as those of a network."""
    arrays = [x for x in jtu.tree_leaves(model) if is_array(x)]
    return any(x.ndim > 1 and x.size >= MATRIX for x in arrays)


def has_networks_in_force_alone(model: Model) -> bool:
    """Whether nothing but the force of a model takes matrices as large as those of a network."""
    if model.system.force is None or model.reacts or model.form.first_order is not None:
        return False
    arrays, rest = eqx.partition(model, is_array)

    def others(arrays: Model, t: Array, x: Array, u: Array):
        model = eqx.combine(arrays, rest)
        dissipation = None if model.system.dissipation is None else model.dissipation(t, x, u)
        return model.lagrangian(t, x, u), dissipation, constraints.residuals(model, t, x, u)

    t, y = (jax.ShapeDtypeStruct(shape, model.form.dtype) for shape in ((), (model.n,)))
    program = jax.make_jaxpr(others)(arrays, t, y, y).jaxpr
    large = [x for x in program.invars[:-3] if x.aval.ndim > 1 and x.aval.size >= MATRIX]
    return not depends(program, large)


def is_small(model: Model, force_apart: bool = False) -> bool:
    """Whether the equations of a system are to be written out, all of them or with the `force_apart`."""
    if is_plain() or model.solves_itself or has_networks(model) and not force_apart:
        return False
    if model.n + model.m > (CONSTRAINED_UP_TO if model.m else UP_TO):
        return False
    # A pivot that is zero at every state: the robust way would be compiled as well, and be used.
    return not without_mass(model).any()


def write_out(model: Model, force_apart: bool = False) -> WrittenOut | None:
    """Write out the equations of a small system in single numbers. None if L makes them too long."""
    diagonal = model.m == 0 and is_diagonal(model)
    most = CONSTRAINED_LONG if model.m else LONG
    try:
        of_state = partial(_equations, diagonal)
        equations = Numbers(of_state, model, most=ON_THE_WAY * most, has_more=True, force_apart=force_apart)
    except TooLong:
        return None
    if equations.length > most:
        return None
    # M and A, which the return takes from the equations, are the same under any force.
    known_of = partial(equations.more, force=(np.zeros((), model.form.dtype),) * model.n if force_apart else None)
    project = Numbers(partial(_projected, known_of), model) if model.is_returned else None
    return WrittenOut(equations, project, not diagonal, force_apart)


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


# Of Newton's method at a start, where positions and velocities move together, and each squares how far they are off.
ITERATIONS = 4


class Equations(eqx.Module):
    """The equations of a model.

    `form` solves them in arrays. `written` solves them number by number, given the part that does not depend on the
    state, `prepared`; it is None for a system that is not small. `fallback`: whether programs contain the robust way,
    for states where `written` fails. `users`: the user's form of states, if these equations take coordinates one by
    one.
    """

    model: Model
    prepared: tuple[tuple | None, tuple | None]
    form: Dense | Banded | ForwardDynamics = eqx.field(static=True)
    written: WrittenOut | None = eqx.field(static=True)
    fallback: bool = eqx.field(static=True)
    users: Form | None = eqx.field(static=True)

    @property
    def are_written(self) -> bool:
        """Whether the fast way exists."""
        return self.written is not None

    @property
    def are_taken_for_regular(self) -> bool:
        """Whether the equations are assumed regular: the result is NaN, unexplained, where they are not."""
        if self.written is None:
            return isinstance(self.form, Dense) and self.form.regular
        return self.written.may_fail and not self.fallback

    def operations(self, t: Array, q: PyTree, v: PyTree) -> int:
        """How many operations the accelerations have; written out, with those of the return to the constraints."""
        if self.written is not None:
            return self.written.length
        # JAX looks for what it traces among what it has traced: bound methods would compare traced arrays.
        return length(jax.make_jaxpr(lambda *state: self.accelerations(*state))(t, q, v).jaxpr)

    def inside(self, y: Array):
        """Convert the user's position or velocity to the form that these equations take."""
        return y if self.users is None else coordinates.numbers(y)

    def outside(self, y: Array):
        """Convert a position, velocity or acceleration back to the user's structure."""
        return y if self.users is None else self.users.tree(jnp.stack(y))

    def velocities(self, t: Array, q: PyTree, v: PyTree):
        """The velocity v, where coordinates of first order have theirs."""
        model = self.model
        return v if model.form.first_order is None else model.tree(resolved(model, t, *model.vectors(q, v)))

    def rates(self, t: Array, q: PyTree, v: PyTree) -> tuple[PyTree[Array], dict[str, Array]]:
        """The accelerations, and the multipliers by name."""
        if self.written is None:
            return self.accelerations(t, q, v)
        a, stacked = self.fast(t, q, v)
        fast = a, self.model.split(stacked)
        if not self.fallback:
            return fast
        # `unvmap_all` keeps it a branch in a batch, taken for all lanes or for none.
        return lax.cond(eqxi.unvmap_all(all_finite(fast)), lambda: fast, lambda: self.accelerations(t, q, v))

    def multipliers(self, t: Array, q: PyTree, v: PyTree) -> dict[str, Array]:
        """The multipliers by name, solved the same way for all states of a batch: derivatives flow through them."""
        if not self.model.m:
            return {}
        return self.rates(t, q, v)[1] if self.are_taken_for_regular else self.accelerations(t, q, v)[1]

    def multipliers_along(self, t: Float[Array, " T"], q: PyTree, v: PyTree) -> dict[str, Array]:
        """The multipliers by name at many states."""
        if self.are_taken_for_regular and jax.default_backend() == "cpu":
            # One state after the other: for all together XLA compiles hundreds of kernels.
            return one_function(_in_turn, self, t, q, v)
        return jax.vmap(self.multipliers)(t, q, v)

    def solution_or_nan(self, t: Array, q: PyTree, v: PyTree) -> tuple[PyTree[Array], dict[str, Array]]:
        """Accelerations and multipliers, NaN where they are not valid."""
        if self.written is None:
            return _solution_or_nan(self.form, self.model, t, q, v)
        a, stacked = self.fast(t, q, v)
        fast = a, self.model.split(stacked)
        if not self.written.may_fail:
            return fast
        return lax.cond(
            eqxi.unvmap_all(all_finite(a)), lambda: fast, lambda: _solution_or_nan(self.form, self.model, t, q, v)
        )

    def verdict(self, t: Array, q: PyTree, v: PyTree) -> Verdict:
        """Solve the equations at one state, and say whether the solution is valid."""
        if self.are_taken_for_regular:
            return self.begin(t, q, v, project=False)[1]
        return _verdict(self.form, self.model, t, q, v)

    def begin(self, t: Array, q: PyTree, v: PyTree, project: bool) -> tuple[tuple[PyTree, PyTree], Verdict]:
        """The state at a start, returned to the constraints if asked to `project`, and the verdict there.

        For equations taken for regular: all in one loop, in which they are compiled once.
        """
        x, u = self.model.vectors(q, v)
        last = ITERATIONS if project and self.model.is_returned else 0
        states, (results, known) = one_function(_from_given, self, t, jnp.stack([x, u]), last)
        (a, stacked), here = jtu.tree_map(lambda rows: rows[last], (results, known))
        model, multipliers, (x, u) = self.model, self.model.split(stacked), states[last]
        finite = jnp.all(jnp.isfinite(coordinates.flatten((a, multipliers, here.lagrangian))[0]))
        if last:
            finite &= jnp.all(jax.vmap(is_tiny)(states[last] - states[last - 1], states[last]))
        regular = is_regular(model, here.mass, here.jacobian, known.jacobian[-1]) & is_determined(model, t, x, u)
        # The different ways of not being regular are not told apart here.
        verdict = Verdict(
            a, multipliers, finite, ~regular, jnp.asarray(False), largest_of_rows(here.mass),
            (known.residuals[0], known.jacobian[0]), (here.mass, here.jacobian),
        )  # fmt: skip
        return (model.tree(x), model.tree(u)), verdict

    def _known_at(self, t: Array, state: Array):
        if self.written is None:
            assert isinstance(self.form, Dense)
            return self.form.with_more(self.model, t, *state)
        q, v = map(self.model.tree, state)
        return self.written.equations.with_more_at(self.prepared[0], t, q, v)

    def fast(self, t: Array, q: PyTree, v: PyTree):
        """The accelerations, and the multipliers in one vector, by the written-out equations."""
        assert self.written is not None
        force = None
        if self.written.force_apart:
            force = tuple(x.astype(t.dtype) for x in self.model.force_at(t, q, v))
        return kept_as_call(self.written.equations.at(self.prepared[0], t, q, v, force))

    def projected(self, t: Array, q: PyTree, v: PyTree):
        """The state returned to the constraints, by the written-out equations; NaN where it is not near them."""
        assert self.written is not None and self.written.project is not None
        return kept_as_call(self.written.project.at(self.prepared[1], t, q, v))

    def accelerations(
        self, t: Array, q: PyTree, v: PyTree, baumgarte_rate: Array | None = None, independent: Array | None = None
    ):
        """The accelerations, and the multipliers by name, the robust way.

        `independent` (m,) says which constraint equations to solve with; chosen at this state if None.
        """
        return _accelerations(self.form, self.model, t, q, v, baumgarte_rate, independent)

    def accelerations_alone(self, t: Array, q: PyTree, v: PyTree, baumgarte_rate=None, independent=None) -> PyTree:
        """The accelerations the robust way, as a call: the shortest multipliers of dependent constraints take longer
        than these, and XLA leaves out only what no call returns."""
        return kept_as_call(_accelerations_alone(self.form, self.model, t, q, v, baumgarte_rate, independent))

    def independent(
        self, t: Array, q: PyTree, v: PyTree, dependent_below: float | None = None
    ) -> Bool[Array, " m"] | None:
        """Which constraint equations to solve with near a state; None where fewer than two leave no choice."""
        return None if self.model.m < 2 else _independent(self.form, self.model, t, q, v, dependent_below)

    def displacement(self, t: Array, q: PyTree, v: PyTree):
        """`displacement(r)`: the shortest one, in the metric of M, that changes the residuals by r (m,)."""
        return self.form.displacement(self.model, t, *self.model.vectors(q, v))

    def row_sizes(self, t: Array, q: PyTree, v: PyTree) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation."""
        return self.form.row_sizes(self.model, t, *self.model.vectors(q, v))


def equations_of(
    model: Model, *, fast: bool = False, fallback: bool = True, differentiated: bool = False, apart: bool = False
) -> Equations:
    """The equations of a model.

    With `fast` the equations of a small system are also written out, and take states number by number
    (`Equations.inside`); not if they are to be `differentiated` and are long. With `apart` also those with a network in
    the force alone, whose force is an argument. Without `fallback` they are assumed regular; the caller deals with
    states where they are not.
    """
    written, users, prepared = None, None, (None, None)
    model = with_first_order(model)
    apart = apart and has_networks(model) and has_networks_in_force_alone(model)
    if fast and is_small(model, apart):
        numbers = in_numbers(model)
        leaves, structure = jtu.tree_flatten(numbers)
        leaves = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
        # In a watched motion a failed check of the user's becomes NaN in the equations.
        written = _written(structure, leaves, WATCHED.value, apart)
        if differentiated and written is not None and written.length > LONG_TO_DIFFERENTIATE:
            written = None
        else:
            model, users = numbers, model.form
    if written is not None:
        both = written.equations, written.project
        prepared = tuple(None if numbers is None else numbers.prepare(model) for numbers in both)
    regular = not fallback and 0 < model.m < model.n and model.off is None
    fallback = fallback and written is not None and written.may_fail
    if model.solves_itself:
        return Equations(model, prepared, ForwardDynamics(_named(model)), None, False, None)
    sparse, unknowns = plan(model), model.n + model.m
    # Other small systems are written out, where zeros cost nothing.
    may_divide = has_networks(model) and not model.m and unknowns <= UP_TO
    form = Dense(unknowns, may_divide and is_diagonal(model), regular) if sparse is None else Banded(sparse)
    return Equations(model, prepared, form, written, fallback, users)


def _named(model: Model) -> str:
    solves = model.system.forward_dynamics
    return getattr(solves, "__name__", type(solves).__name__).replace("_", " ")


# A motion is traced several times (with and without the robust way, for derivatives, in lanes) with these equations.
@once
def _written(structure, leaves: tuple, watched: bool, apart: bool) -> WrittenOut | None:
    return write_out(jtu.tree_unflatten(structure, leaves), apart)


# Jitted, so that JAX traces L once for all the places of a compiled trajectory that need it.
@jitted
def _accelerations(form, model: Model, t: Array, q: PyTree, v: PyTree, baumgarte_rate: Array, independent: Array):
    state = t, *model.vectors(q, v)
    a, multipliers = form.accelerations(model, *state, baumgarte_rate, independent)
    return model.tree(completed(model, *state, a)), model.split(multipliers)


@jitted
def _accelerations_alone(form, model: Model, *given):
    return _accelerations(form, model, *given)[0]


@jitted
def _independent(form, model: Model, t: Array, q: PyTree, v: PyTree, dependent_below: float):
    return form.independent(model, t, *model.vectors(q, v), dependent_below)


@compiled
def _verdict(form, model: Model, t: Array, q: PyTree, v: PyTree) -> Verdict:
    state = t, *model.vectors(q, v)
    found = form.verdict(model, *state)
    a = completed(model, *state, found.a)
    finite = found.finite & jnp.all(jnp.isfinite(a))
    singular = found.singular | ~is_determined(model, *state)
    return found._replace(a=model.tree(a), multipliers=model.split(found.multipliers), finite=finite, singular=singular)


def _solution_or_nan(form, model: Model, t: Array, q: PyTree, v: PyTree):
    state = t, *model.vectors(q, v)
    a, multipliers = form.solution_or_nan(model, *state)
    return model.tree(completed(model, *state, a)), model.split(multipliers)


def _from_given(equations: Equations, t: Array, given: Float[Array, "2 n"], last: int):
    """The states from a given one to the `last` of Newton's iterations, and one `slightly_off`; what is known there."""

    def step(state: Float[Array, "2 n"], i: Array):
        (results, known) = equations._known_at(t, state)
        moved, off = corrected(equations.model, t, state, known), jax.vmap(slightly_off)(state)
        return jnp.where(i < last, moved, off), (state, (results, known))

    return lax.scan(step, given, jnp.arange(last + 2))[1]


def _in_turn(equations: Equations, t: Float[Array, " T"], q: PyTree, v: PyTree) -> dict[str, Array]:
    return lax.map(lambda state: equations.multipliers(*state), (t, q, v))


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """Whether nothing in a tree of floats is NaN or infinite."""
    # One sum instead of a reduction per leaf: zero times NaN or infinity is NaN.
    return decided(jnp.asarray(sum(jnp.sum(0 * x) for x in jtu.tree_leaves(tree)) == 0))
