"""The equations of a system: everything asked of them at a state, and the one place that knows how to solve them.

There are three ways. The robust way works in arrays: one matrix (`saddle_point.py`), or a band where the system is
large and its parts touch few others (`sparse_saddle_point.py`). It exchanges rows, leaves dependent constraints out and
says what is wrong. The fast way is for small systems: their equations are also written out number by number
(`written_out.py`), which is many times as fast, and gives NaN where it fails.

A caller has an `Equations` and does not choose between them.
"""

from collections.abc import Callable
from functools import lru_cache

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jax_internals.one_by_one import jitted
from lagjax.jax_internals.one_function import kept_as_call
from lagjax.jax_internals.tracing import WATCHED
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.in_numbers import in_numbers
from lagjax.mechanics.saddle_point import Dense, is_regular
from lagjax.mechanics.sparse_plan import plan
from lagjax.mechanics.sparse_saddle_point import Banded
from lagjax.mechanics.structure import is_diagonal
from lagjax.mechanics.system import System
from lagjax.mechanics.verdict import Verdict
from lagjax.mechanics.written_out import UP_TO, WrittenOut, has_networks, is_small, write_out


class Equations(eqx.Module):
    """The equations of a system with its parameters, for states of one shape.

    `form` solves them in arrays. `written` solves them number by number, given the part that does not depend on the
    state, `prepared`; it is None for a system that is not small. `fallback`: whether programs contain the robust way,
    for states where `written` fails. `unflatten` puts the coordinates of a small system, which come one by one, back
    into the user's structure.
    """

    system: System
    params: PyTree
    prepared: tuple[tuple | None, tuple | None]
    form: Dense | Banded = eqx.field(static=True)
    written: WrittenOut | None = eqx.field(static=True)
    fallback: bool = eqx.field(static=True)
    unflatten: Callable | None = eqx.field(static=True)

    @property
    def are_written(self) -> bool:
        """Whether the fast way exists."""
        return self.written is not None

    @property
    def are_taken_for_regular(self) -> bool:
        """Whether the equations are assumed regular: the result is NaN, unexplained, where the fast way fails."""
        return self.written is not None and self.written.may_fail and not self.fallback

    def inside(self, y):
        """Convert the user's position or velocity to the form that these equations take."""
        return y if self.unflatten is None else coordinates.numbers(y)

    def outside(self, y):
        """Convert a position, velocity or acceleration back to the user's structure."""
        return y if self.unflatten is None else self.unflatten(jnp.stack(y))

    def rates(self, t, q, v) -> tuple[PyTree[Array], dict[str, Array]]:
        """The accelerations, and the multipliers by name."""
        if self.written is None:
            return self.accelerations(t, q, v)
        a, stacked = self.fast(t, q, v)
        fast = a, constraints.split(self.system, stacked, t, q, v, self.params)
        if not self.fallback:
            return fast
        # `unvmap_all` keeps it a branch in a batch, taken for all lanes or for none.
        return lax.cond(eqxi.unvmap_all(all_finite(fast)), lambda: fast, lambda: self.accelerations(t, q, v))

    def multipliers(self, t, q, v) -> dict[str, Array]:
        """The multipliers by name, solved the same way for all states of a batch: derivatives flow through them."""
        if not self.system.constraints:
            return {}
        return self.rates(t, q, v)[1] if self.are_taken_for_regular else self.accelerations(t, q, v)[1]

    def solution_or_nan(self, t, q, v) -> tuple[PyTree[Array], dict[str, Array]]:
        """Accelerations and multipliers, NaN where they are not valid."""
        if self.written is None:
            return _solution_or_nan(self.form, self.system, t, q, v, self.params)
        a, stacked = self.fast(t, q, v)
        fast = a, constraints.split(self.system, stacked, t, q, v, self.params)
        if not self.written.may_fail:
            return fast
        robustly = lambda: _solution_or_nan(self.form, self.system, t, q, v, self.params)
        return lax.cond(eqxi.unvmap_all(all_finite(a)), lambda: fast, robustly)

    def verdict(self, t, q, v) -> Verdict:
        """Solve the equations at one state, and say whether the solution is valid."""
        if not self.are_taken_for_regular:
            return _verdict(self.form, self.system, t, q, v, self.params)
        # The different ways of not being regular are not told apart here.
        a, multipliers = self.rates(t, q, v)
        lagrangian = self.system.lagrangian(t, q, v, self.params)
        finite = jnp.all(jnp.isfinite(coordinates.flatten((a, multipliers, lagrangian))[0]))
        state = _vectors(self.system, t, q, v, self.params)
        regular, mass = is_regular(*state)
        return Verdict(a, multipliers, finite, ~regular, jnp.asarray(False), mass)

    def fast(self, t, q, v):
        """The accelerations, and the multipliers in one vector, by the written-out equations."""
        assert self.written is not None
        return kept_as_call(self.written.equations.at(self.prepared[0], t, q, v))

    def projected(self, t, q, v):
        """The state returned to the constraints, by the written-out equations; NaN where it is not near them."""
        assert self.written is not None and self.written.project is not None
        return kept_as_call(self.written.project.at(self.prepared[1], t, q, v))

    def accelerations(self, t, q, v, baumgarte_rate=None, independent=None):
        """The accelerations, and the multipliers by name, the robust way.

        `independent` (m,) says which constraint equations to solve with; chosen at this state if None.
        """
        return _accelerations(self.form, self.system, t, q, v, self.params, baumgarte_rate, independent)

    def independent(self, t, q, v, dependent_below=None) -> Bool[Array, " m"] | None:
        """Which constraint equations to solve with near a state; None where fewer than two leave no choice."""
        if constraints.count(self.system, t, q, v, self.params) < 2:
            return None
        return _independent(self.form, self.system, t, q, v, self.params, dependent_below)

    def displacement(self, t, q, v):
        """`displacement(which, r)`: the shortest one, in the metric of M, that changes the residuals `which` by r."""
        return self.form.displacement(*_vectors(self.system, t, q, v, self.params))

    def row_sizes(self, t, q, v) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation."""
        return self.form.row_sizes(*_vectors(self.system, t, q, v, self.params))


def equations_of(system, t, q, v, params, *, fast=False, fallback=True) -> Equations:
    """The equations of a system, for states with the shapes and dtypes of this one; its values do not count.

    With `fast` the equations of a small system are also written out, and take states number by number
    (`Equations.inside`). Without `fallback` they are assumed regular; the caller deals with states where they are not.
    """
    written, unflatten = None, None
    if fast and is_small(system, t, q, v, params):
        _, unflatten = coordinates.flatten(q)
        system, q, v = in_numbers(system, unflatten), coordinates.numbers(q), coordinates.numbers(v)
        written = _written_for(system, t, q, v, params)
    prepared = (None, None) if written is None else written.prepare(system, params)
    fallback = fallback and written is not None and written.may_fail
    return Equations(system, params, prepared, _form(system, t, q, v, params), written, fallback, unflatten)


def _form(system, t, q, v, params):
    unknowns = sum(jnp.size(x) for x in jtu.tree_leaves(q)) + constraints.count(system, t, q, v, params)
    sparse = plan(system, t, q, v, params)
    if sparse is not None:
        return Banded(sparse)
    # Other small systems are written out, where zeros cost nothing.
    may_divide = has_networks(system, params) and not system.constraints and unknowns <= UP_TO
    return Dense(unknowns, may_divide and is_diagonal(system, t, q, v, params))


def _written_for(*problem) -> WrittenOut | None:
    leaves, structure = jtu.tree_flatten(problem)
    leaves = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    # In a watched motion a failed check of the user's becomes NaN in the equations.
    key = structure, leaves, WATCHED.value
    try:
        hash(key)
    except TypeError:
        return _written.__wrapped__(*key)
    return _written(*key)


# A motion is traced several times (with and without the robust way, for derivatives, in lanes) with these equations.
@lru_cache(maxsize=64)
def _written(structure, leaves, watched) -> WrittenOut | None:
    found = []

    def at(arrays):
        filled = [leaf if x is None else x for x, leaf in zip(arrays, leaves)]
        found.append(write_out(*jtu.tree_unflatten(structure, filled)))

    jax.eval_shape(at, [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves])
    return found[0]


# Jitted, so that JAX traces L once for all the places of a compiled trajectory that need it.
@jitted
def _accelerations(form, system, t, q, v, params, baumgarte_rate, independent):
    state = _vectors(system, t, q, v, params)
    a, multipliers = form.accelerations(*state, baumgarte_rate, independent)
    return state[-1](a), constraints.split(system, multipliers, t, q, v, params)


@jitted
def _independent(form, system, t, q, v, params, dependent_below):
    return form.independent(*_vectors(system, t, q, v, params), dependent_below)


@compiled
def _verdict(form, system, t, q, v, params) -> Verdict:
    state = _vectors(system, t, q, v, params)
    found = form.verdict(*state)
    by_name = constraints.split(system, found.multipliers, t, q, v, params)
    return found._replace(a=state[-1](found.a), multipliers=by_name)


def _solution_or_nan(form, system, t, q, v, params):
    state = _vectors(system, t, q, v, params)
    a, multipliers = form.solution_or_nan(*state)
    return state[-1](a), constraints.split(system, multipliers, t, q, v, params)


def _vectors(system, t, q, v, params):
    """A state in vector form, as `Dense` and `Banded` take it."""
    x, unflatten = coordinates.flatten(q)
    return system, t, x, coordinates.flatten(v)[0], params, unflatten


def all_finite(tree) -> Bool[Array, ""]:
    """Whether nothing in a tree of floats is NaN or infinite."""
    # One sum instead of a reduction per leaf: zero times NaN or infinity is NaN.
    return jnp.asarray(sum(jnp.sum(0 * x) for x in jtu.tree_leaves(tree)) == 0)
