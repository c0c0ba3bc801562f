"""A system in single numbers: coordinates one by one, programs as operations on single numbers.

`in_numbers` gives the same system with a tuple of numbers in place of the user's q and v. `Numbers` traces a function
of the system and its state, writes it out, and splits it into a part that depends on the parameters alone and the rest.
"""

import math
from collections.abc import Callable
from itertools import islice

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jaxtools import (
    WATCHED,
    calls_host,
    length,
    needed,
    one_by_one,
    outputs_of,
    poisoned,
    run,
    staged,
    varies,
    written_out,
)
from lagjax.system import Form, Model, coordinates, takes_of, unchecked

# The most operations that are written out, before it is known which are needed. Writing a hundred thousand, as for an L
# with tables or a quadrature in it, only to discard them takes 15 s.
WRITTEN = 6000


class InNumbers(eqx.Module):
    """A function of (t, q, v, params) or (t, q, params), taking each state as a tuple of numbers."""

    function: Callable
    form: Form = eqx.field(static=True)
    returns_coordinates: bool = eqx.field(static=True, default=False)

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, t: Array, *states_and_params):
        *states, params = states_and_params
        # Multipliers come by name, and pass unchanged.
        states = [self.form.tree(jnp.stack(state)) if isinstance(state, tuple) else state for state in states]
        result = self.function(t, *states, params)
        return coordinates.numbers(result) if self.returns_coordinates else result


def in_numbers(model: Model) -> Model:
    """The same system, with a tuple of numbers for q and for v."""
    structure = jtu.tree_structure((0,) * model.n)
    form = model.form._replace(structure=structure, shapes=((),) * model.n)

    def change(function: Callable, role: str) -> InNumbers:
        return InNumbers(function, model.form, returns_coordinates=role in ("force", "forward_dynamics"))

    return unchecked(model.system.map(change), model.params, form)


class Numbers:
    """A function of (model, t, q, v), traced once and written out; q and v are tuples of numbers (`in_numbers`).

    What depends on the model alone is computed by `prepare`, once; `at` does the rest. `calls_host` says whether a
    user's function calls Python at run time. Beyond about `most` operations it raises `TooLong`.

    A function that `has_more` returns its result and what else it knows, which only `with_more_at` returns.
    """

    def __init__(self, function: Callable, model: Model, most=math.inf, has_more: bool = False):
        arrays, static = eqx.partition((model, *model.form.example), varies)
        self.shapes = []

        def of_leaves(*leaves):
            args = eqx.combine(jtu.tree_unflatten(jtu.tree_structure(arrays), leaves), static)
            found = function(*args)
            self.shapes += map(jtu.tree_structure, found if has_more else (found,))
            return jtu.tree_leaves(found)

        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jtu.tree_leaves(arrays)]
        program = jax.make_jaxpr(of_leaves)(*like)
        self.calls_host = calls_host(program.jaxpr)
        if WATCHED.value:
            program = poisoned(program)
        program = _without_unused(program)
        full = jax.make_jaxpr(lambda *leaves: written_out(program, *leaves, most=most))(*like)
        self.program = _without_unused(full)
        of_problem, of_state = _leaves_of(arrays, (0,)), _leaves_of(arrays, (1, 2, 3))
        self.state_variables = [self.program.jaxpr.invars[i] for i in of_state]
        early, late = staged(self.program, of_problem, of_state)
        count = self.shapes[0].num_leaves

        def result_alone(*given):
            return late(*given)[:count]

        self._early, self._late = jax.jit(one_by_one(early)), jax.jit(one_by_one(result_alone))
        self._late_with_more = jax.jit(one_by_one(late))

    @property
    def length(self) -> int:
        """How many operations its result consists of."""
        return length(outputs_of(self.program, range(self.shapes[0].num_leaves)).jaxpr)

    def prepare(self, model: Model) -> tuple | None:
        """What does not depend on the state; None if there is nothing, since equinox mishandles `()`."""
        return tuple(self._early(*jtu.tree_leaves(eqx.filter(model, varies)))) or None

    def at(self, prepared, t: Array, q: PyTree, v: PyTree):
        """The function's result at a state."""
        return jtu.tree_unflatten(self.shapes[0], self._late(prepared or (), *jtu.tree_leaves((t, q, v))))

    def with_more_at(self, prepared, t: Array, q: PyTree, v: PyTree) -> list:
        """The function's result and what else it returns, at a state."""
        found = iter(self._late_with_more(prepared or (), *jtu.tree_leaves((t, q, v))))
        return [jtu.tree_unflatten(shape, islice(found, shape.num_leaves)) for shape in self.shapes]

    def more(self, model: Model, t: Array, q: PyTree, v: PyTree):
        """What else the function returns."""
        alone = outputs_of(self.program, range(self.shapes[0].num_leaves, len(self.program.out_avals)))
        return jtu.tree_unflatten(self.shapes[1], run(alone, jtu.tree_leaves(eqx.filter((model, t, q, v), varies))))

    def __call__(self, model: Model, t: Array, q: PyTree, v: PyTree):
        """The function's result."""
        return self.at(self.prepare(model), t, q, v)


def _without_unused(program):
    return program.replace(jaxpr=program.jaxpr.replace(eqns=needed(program.jaxpr)))


def _leaves_of(arguments, places):
    """The places of some arguments' leaves among the leaves of all."""
    sizes = [len(jtu.tree_leaves(x)) for x in arguments]
    starts = np.cumsum([0, *sizes])
    return [i for place in places for i in range(starts[place], starts[place + 1])]
