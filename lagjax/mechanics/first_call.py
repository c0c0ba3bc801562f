"""The first call of the user's functions: on shapes alone, before anything is computed or compiled.

`in_words.py` explains the errors that occur inside them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import coordinates
from lagjax.mechanics.arguments import OF_POSITION, OF_STATE, takes_of
from lagjax.mechanics.constraints import Holonomic, count, zero_multipliers
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.in_words import Call, check_arguments, in_words
from lagjax.mechanics.linear_in import is_linear
from lagjax.mechanics.memory import kinds, remembered, shape_of
from lagjax.mechanics.outside import first_alike, up_to_date
from lagjax.mechanics.reactions import force_at, reacts
from lagjax.mechanics.refusals import check_system
from lagjax.mechanics.system import System


def looked_at(system: System, s: State) -> System:
    """Check a system's functions; return it with what they read from outside now, or an earlier system like it."""
    check_system(system)
    now = up_to_date(system)
    remembered(system, (check_functions, now.read, kinds(s)), lambda: check_functions(now, *s))
    return first_alike(system, now) if is_eager() else now


def with_known_kinds(system: System, s: State) -> State:
    """The state with whole numbers in `params` as floats, where the system was given floats there before.

    `g=10` after `g=9.81` must not compile another program. A function that needs a whole number (an index, a count) has
    already refused the float.
    """
    known_kinds: dict = remembered(system, with_known_kinds, dict)
    kind = kinds(s.params)
    if kind not in known_kinds and (places := _whole_numbers(s.params)):
        leaves, structure = jtu.tree_flatten(s.params)
        for known in known_kinds:
            differing = [i for i, (a, b) in enumerate(zip(known[1:], kind[1:])) if a != b]
            if known[0] != structure or not places.issuperset(differing):
                continue
            changed = [np.asarray(x, s.t.dtype) if i in differing else x for i, x in enumerate(leaves)]
            if kinds(changed)[1:] == known[1:]:
                return s._replace(params=jtu.tree_unflatten(structure, changed))
    known_kinds[kind] = True
    return s


def _whole_numbers(params):
    """Which of the leaves are whole numbers."""
    is_whole = lambda x: type(x) is int or isinstance(x, np.ndarray) and np.issubdtype(x.dtype, np.integer)
    return {i for i, x in enumerate(jtu.tree_leaves(params)) if is_whole(x)}


def check_functions(system, t, q, v, params):
    """Raise where L, R, Q or a constraint cannot be called, or returns something of the wrong kind or shape."""
    given = {"t": t, "q": q, "v": v, "params": params}
    for role, function in (("L", system.lagrangian), ("dissipation", system.dissipation)):
        if function is not None:
            _check_energy(Call(role, function, OF_STATE), given)
    for name, constraint in system.constraints.items():
        if isinstance(constraint, Holonomic):
            _check_constraint(Call("g", constraint.g, OF_POSITION, f" of constraint '{name}'"), given)
        else:
            _check_constraint(Call("phi", constraint.phi, OF_STATE, f" of constraint '{name}'"), given)
    if system.force is not None:
        # After the constraints, which determine the multipliers.
        given |= {"multipliers": zero_multipliers(system, State(t, q, v, params))}
        _check_force(Call("force", system.force, takes_of(system.force)), given)
        if reacts(system):
            _check_linear(system, t, q, v, params)


def _check_energy(call, given):
    value = _shapes(call, given)
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(value, float) or shape == () and jnp.issubdtype(dtype, jnp.floating):
        return
    cause = "energies left unsummed, as in 0.5 * m * v**2 with v a vector, even one of length 1"
    fix = "0.5 * m * jnp.sum(v**2), or jnp.dot(v, v); for one coordinate q0 = 0.1, not q0 = [0.1]"
    got = f"shape {shape}, {dtype}" if shape is not None else f"a {type(value).__name__}"
    if value is None:
        got, cause, fix = "None", "a function without return", "return kinetic - potential"
    elif isinstance(value, tuple | list | dict):
        cause, fix = "the energies returned one by one", "return kinetic - potential"
    elif shape is None and isinstance(value, bool | int) or shape == () and not _is_complex(dtype):
        got = f"{value!r}, a {type(value).__name__}" if shape is None else got
        cause, fix = "a condition or a whole number in place of an energy", "return kinetic - potential"
    elif shape == ():
        cause, fix = "a complex parameter, or the root of a negative number", "jnp.real(...)"
    raise ValueError(f"{call} must return one real number, and returned {got}.\nUsual cause: {cause}.\nFix: {fix}.")


def _is_complex(dtype):
    return jnp.issubdtype(dtype, jnp.complexfloating)


def _check_force(call, given):
    force, expected = _shapes(call, given), jax.tree.map(jnp.shape, given["q"])
    if force is None:
        raise ValueError(
            f"{call} must return one force per coordinate, like q, and returned None.\n"
            "Usual cause: a function without return.\n"
            "Fix: return the structure of q, with 0.0 where no force acts."
        )
    if jax.tree.map(jnp.shape, force) != expected:
        raise ValueError(
            f"{call} must return one force per coordinate, like q.\n"
            f"  q has shapes {expected}\n  the force has {jax.tree.map(jnp.shape, force)}\n"
            "Usual cause: a force for only one of the coordinates.\n"
            "Fix: return the structure of q, with 0.0 where no force acts."
        )


def _check_linear(system, t, q, v, params):
    """Raise where the force is not linear in the multipliers."""
    arrays, static = eqx.partition((t, q, v, params), eqx.is_array_like)

    def force(multipliers, arrays):
        return coordinates.flatten(force_at(system, *eqx.combine(arrays, static), multipliers))[0]

    if not is_linear(force, count(system, t, q, v, params), coordinates.flatten(q)[0].dtype, arrays):
        raise ValueError(
            "force(t, q, v, multipliers, params) must be linear in the multipliers, and is not.\n"
            "Usual cause: the size of a normal force, jnp.abs(multipliers[...]) or jnp.maximum(multipliers[...], 0).\n"
            'Fix: the multiplier itself, -mu * multipliers["contact"]: a phase ends where it reaches zero '
            '(lj.releases("contact")).'
        )


def _check_constraint(call, given):
    value = _shapes(call, given)
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is None or len(shape) > 1:
        got = f"an array of shape {shape}" if shape is not None else f"a {type(value).__name__}"
        raise ValueError(
            f"{call} must return a scalar or a vector, and returned {got}.\n"
            "Usual cause: several equations in a tuple or a matrix, or a function without return.\n"
            "Fix: return jnp.stack([...]) of the equations, or give each a name of its own."
        )
    if 0 in shape:
        raise ValueError(
            f"{call} must return a scalar or a vector, and returned no equation at all, shape {shape}.\n"
            "Usual cause: an empty list of joints.\n"
            "Fix: leave the constraint out where it has none."
        )
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(
            f"{call} must return real numbers that vanish where it holds, and returned {dtype}.\n"
            "Usual cause: an equation in place of its residual, x**2 + y**2 == l**2.\n"
            "Fix: return x**2 + y**2 - l**2."
        )


def _shapes(call, given):
    """The shapes and dtypes that the function returns, or an error in the user's words."""
    check_arguments(call, "an argument left out as the function does not need it, or one too many: a constraint of "
                    "positions takes no v")  # fmt: skip
    with in_words(call, given):
        return shape_of(call.function, *(given[name] for name in call.takes))
