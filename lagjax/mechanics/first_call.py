"""The first call of the user's functions: on shapes alone, before anything is computed or compiled.

What goes wrong in there is said in the user's names, with the line where it happened. What is not recognized is raised
as it came: it is then between the user and the function.
"""

import difflib
import inspect
import re
import traceback
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from lagjax.jax_internals.programs import depends
from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import coordinates
from lagjax.mechanics.arguments import OF_POSITION, OF_STATE, takes_of
from lagjax.mechanics.constraints import Holonomic, count, zero_multipliers
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.hybrid import Hybrid
from lagjax.mechanics.memory import kinds, remembered, shape_of
from lagjax.mechanics.outside import first_alike, up_to_date
from lagjax.mechanics.reactions import force_at, reacts
from lagjax.mechanics.system import System


def looked_at(system: System, s: State) -> System:
    """The system as its functions are now, which `check_functions` found to be in order; the first one of its kind."""
    if isinstance(system, Hybrid):
        raise TypeError(
            "this is of one system, and a lj.Hybrid has one for each of its phases.\n"
            f"Fix: hybrid.systems[{len(system.names) - 1}] for '{system.names[-1]}'; print(hybrid) shows how "
            "the phases follow each other."
        )
    now = up_to_date(system)
    remembered(system, (check_functions, now.read, kinds(s)), lambda: check_functions(now, *s))
    return first_alike(system, now) if is_eager() else now


def with_known_kinds(system: System, s: State) -> State:
    """The state with whole numbers in `params` as floats, where the system was given floats there before.

    `g=10` after `g=9.81` is another number, not another program. A function for which it matters that a number is whole
    (an index, a count) has refused the float.
    """
    seen: dict = remembered(system, with_known_kinds, dict)
    mine = kinds(s.params)
    if mine not in seen and (places := _whole_numbers(s.params)):
        leaves, structure = jtu.tree_flatten(s.params)
        for known in seen:
            asked = [i for i, (a, b) in enumerate(zip(known[1:], mine[1:])) if a != b]
            if known[0] != structure or not places.issuperset(asked):
                continue
            changed = [np.asarray(x, s.t.dtype) if i in asked else x for i, x in enumerate(leaves)]
            if kinds(changed)[1:] == known[1:]:
                return s._replace(params=jtu.tree_unflatten(structure, changed))
    seen[mine] = True
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
        # After the constraints, which say what multipliers there are.
        given |= {"multipliers": zero_multipliers(system, State(t, q, v, params))}
        _check_force(Call("force", system.force, takes_of(system.force)), given)
        if reacts(system):
            _check_linear(system, t, q, v, params)


class Call(NamedTuple):
    """A function of the user's, what it is called here, the arguments that it gets, and to what it belongs."""

    role: str
    function: Callable
    takes: tuple[str, ...]
    owner: str = ""

    def __str__(self):
        return f"{self.role}({', '.join(self.takes)}){self.owner}"


def _check_energy(call, given):
    value = _shapes(call, given)
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is None and isinstance(value, (int, float)):
        return
    if value is None:
        raise ValueError(
            f"{call} must return one real number, and returned None.\n"
            "Usual cause: a function without return.\n"
            "Fix: return kinetic - potential."
        )
    if shape != () or not jnp.issubdtype(dtype, jnp.floating):
        got = f"shape {shape}, {dtype}" if shape is not None else f"a {type(value).__name__}"
        raise ValueError(
            f"{call} must return one real number, and returned {got}.\n"
            "Usual cause: energies left unsummed, as in 0.5 * m * v**2 with v a vector, be it of one.\n"
            "Fix: 0.5 * m * jnp.sum(v**2), or jnp.dot(v, v); for one coordinate q0 = 0.1, not q0 = [0.1]."
        )


def _check_force(call, given):
    force, expected = _shapes(call, given), jax.tree.map(jnp.shape, given["q"])
    if jax.tree.map(jnp.shape, force) != expected:
        raise ValueError(
            f"{call} must return one force a coordinate, like q.\n"
            f"  q has shapes {expected}\n  the force has {jax.tree.map(jnp.shape, force)}\n"
            "Usual cause: a force for one of the coordinates alone.\n"
            "Fix: return the structure of q, with 0.0 where no force acts."
        )


def _check_linear(system, t, q, v, params):
    """Raise where the force is not linear in the multipliers: its slope depends on them."""
    arrays, static = eqx.partition((t, q, v, params), eqx.is_array_like)

    def slope(multipliers, arrays):
        state = eqx.combine(arrays, static)
        force = lambda multipliers: coordinates.flatten(force_at(system, *state, multipliers))[0]
        return jax.jacfwd(force)(multipliers)

    zero = np.zeros(count(system, t, q, v, params), coordinates.flatten(q)[0].dtype)
    program = jax.make_jaxpr(slope)(zero, arrays).jaxpr
    if depends(program, program.invars[:1]):
        raise ValueError(
            "force(t, q, v, multipliers, params) must be linear in the multipliers, and its slope depends on them.\n"
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
            "Usual cause: a list of joints that is empty.\n"
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
    check_arguments(call, "an argument left out that the function does not need, or one too many: positions are "
                    "constrained without v")  # fmt: skip
    with in_words(call, given):
        return shape_of(call.function, *(given[name] for name in call.takes))


def check_arguments(call: Call, usual_cause: str):
    """Raise where the function cannot be called with so many arguments."""
    try:
        signature = inspect.signature(call.function)
    except ValueError:
        return  # A built-in without a signature.
    try:
        signature.bind(*call.takes)
    except TypeError as error:
        name = getattr(call.function, "__name__", "f")
        name = "f" if name == "<lambda>" else name
        count = f"{len(call.takes)} argument{'s' * (len(call.takes) > 1)}"
        raise TypeError(
            f"{call} is called with {count}, and the function is {name}{signature}.\n"
            f"Usual cause: {usual_cause}.\n"
            f"Fix: def {name}({', '.join(call.takes)})."
        ) from error


@contextmanager
def in_words(call: Call, given: Mapping[str, Any]):
    """What goes wrong inside, while the function is called with what is `given`, is raised in the user's words."""
    try:
        yield
    except KeyError as error:
        raise ValueError(_missing(call, given, error)) from error
    except (TypeError, AttributeError) as error:
        words = _in_words(call, given, error)
        if words is None:
            raise
        raise TypeError(words) from error


def _missing(call, given, error):
    """A key that is not there: where it was looked for, what is there, and what may have been meant."""
    key, line = error.args[0], _line(call, error)
    there = {name: list(x) for name, x in given.items() if isinstance(x, Mapping) and name in call.takes}
    asked = re.search(rf"(\w+)\[[\"']{re.escape(str(key))}[\"']\]", line)
    parameters = list(inspect.signature(call.function).parameters)
    if asked and asked[1] in parameters[: len(call.takes)]:
        source = call.takes[parameters.index(asked[1])]
        there = {source: there[source]} if source in there else there
    has = "; ".join(f"{name} has {', '.join(map(repr, keys))}" for name, keys in there.items())
    meant = difflib.get_close_matches(str(key), [str(k) for keys in there.values() for k in keys], 1)
    if "point" in there:
        fix = f'axes = {{..., "{key}": jnp.linspace(0.0, 1.0, 11)}}'
    elif set(there) & {"q", "v"} and "params" not in there:
        fix = f'q0 = {{"{key}": 0.1}} and v0 = {{"{key}": 0.0}}'
    else:
        fix = f'params = {{..., "{key}": 1.0}}'
    return (
        f"{call} asks for '{key}', and there is none{': ' + has if has else ''}.{_quoted(line)}\n"
        "Usual cause: a name written in two ways, or left out.\n"
        f"Fix: {fix}" + (f", or write '{meant[0]}'." if meant else ".")
    )


def _in_words(call, given, error):
    """What a TypeError or AttributeError means; None where that is not known."""
    line, said = _line(call, error), str(error)
    where = _quoted(line)
    if isinstance(error, jax.errors.TracerArrayConversionError):
        used = re.search(r"\b(?:np|numpy)\.([\w.]+)", line)
        name = used[1] if used else "cos"
        return (
            f"{call} hands a coordinate, velocity or parameter to NumPy, and NumPy cannot be differentiated.{where}\n"
            "Usual cause: np in place of jnp.\n"
            f"Fix: import jax.numpy as jnp, and jnp.{name} in place of np.{name}."
        )
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            f"{call} decides by the value of a coordinate, velocity or parameter, and has none while JAX traces.{where}"
            "\nUsual cause: if, and, or, not, min or max.\n"
            "Fix: jnp.where(condition, a, b), jnp.minimum(a, b), or jnp.maximum(a, b)."
        )
    if isinstance(error, jax.errors.ConcretizationTypeError):
        used = re.search(r"\bmath\.(\w+)", line)
        instead = f"jnp.{used[1]} in place of math.{used[1]}" if used else "leave out float(...) and int(...)"
        return (
            f"{call} makes a Python number of a coordinate, velocity or parameter, and such a number cannot be "
            f"differentiated.{where}\n"
            "Usual cause: a function of the module math, float(...), int(...), or range(...).\n"
            f"Fix: {instead}."
        )
    if "params" in given and given["params"] is None and "NoneType" in said:
        return (
            f"{call} uses params, and none were given.{where}\n"
            "Usual cause: params left out of the call, where they follow q and v.\n"
            'Fix: lj.integrate(system, q0, v0, {"m": 1.0, "g": 9.81}, ts=ts).'
        )
    if missing := re.match(r"'dict' object has no attribute '(\w+)'", said):
        used = re.search(rf"(\w+)\.{missing[1]}\b", line)
        of = used[1] if used else "q"
        return (
            f"{call} asks for .{missing[1]} of a dict.{where}\n"
            "Usual cause: names are looked up in brackets.\n"
            f'Fix: {of}["{missing[1]}"] in place of {of}.{missing[1]}.'
        )
    dicts = [name for name in call.takes if isinstance(given[name], Mapping) and given[name]]
    if dicts and "'dict'" in said and "unsupported operand" in said:
        return (
            f"{call} calculates with a dict.{where}\n"
            "Usual cause: all of what has names taken for one of them.\n"
            f"Fix: look a name up in it, as in {dicts[-1]}[{next(iter(given[dicts[-1]]))!r}]."
        )
    if odd := [name for name, kind in _no_numbers(given.get("params")) if re.search(kind, said)]:
        return (
            f"{call} calculates with '{odd[0]}' of params, which is no number.{where}\n"
            "Usual cause: a number read as text, or left to be filled in.\n"
            f'Fix: params = {{..., "{odd[0]}": 1.0}}.'
        )
    if asked := re.search(r"string indexing; got idx='(.*)'", said):
        return (
            f"{call} asks for '{asked[1]}' of an array, which has no names.{where}\n"
            "Usual cause: a start that is a number or an array, and a function that is written for a dict.\n"
            f'Fix: q0 = {{"{asked[1]}": 0.1}} and v0 = {{"{asked[1]}": 0.0}}.'
        )
    if kind := re.search(r"'(list|tuple)'", said):
        return (
            f"{call} calculates with a {kind[1]}.{where}\n"
            f"Usual cause: a start or a parameter that is a {kind[1]} of numbers, as q0 = [0.1, 0.2].\n"
            "Fix: make it an array, q0 = jnp.array([0.1, 0.2])."
        )
    return None


def _no_numbers(tree):
    """The leaves that are None or text, by name, with what is said of such a one in a calculation."""
    for path, x in jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: x is None):
        if path and (x is None or isinstance(x, str)):
            said = "NoneType" if x is None else "str|sequence|scalar index"
            yield jax.tree_util.keystr(path, simple=True, separator="."), said


def _line(call, error):
    """The line of the user's file in which it happened, or ""."""
    code = getattr(inspect.unwrap(call.function), "__code__", None)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if code and f.filename == code.co_filename]
    return (frames[-1].line or "") if frames else ""


def _quoted(line):
    return f"\n    {line.strip()}" if line else ""
