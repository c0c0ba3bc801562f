"""Generalized coordinates: the user's pytree, its vector form, and its names.

A state is any pytree of float arrays: a scalar, a vector, a dict, a NamedTuple. The equations of motion
are solved in vector form, and every message speaks of the coordinate by the user's own name:

    {"theta": scalar, "r": (2,)}  ->  vector (3,), names ["r[0]", "r[1]", "theta"]

(JAX orders a dict by its keys.) This is the only place where the two forms meet.

Warn once what single precision costs: JAX computes in float32 unless told otherwise.

The warning comes where a state is first made of numbers that the user gave, in whichever function that is. A user who
means float32, on a GPU or for networks, says so in one of the ways of `_is_meant`, or filters the warning by its class.
JAX's own arrays do not show what was meant, nor does an update of its setting to False: both are alike in either case.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, PyTree

from lagjax.display import printable
from lagjax.jaxtools import is_eager, is_traced, numpy_of, to_jax
from lagjax.refusals import shown
from lagjax.system.user_errors import warn

SINGLE = np.dtype("float32")
# Not empty once this process has warned, or float32 is known to be meant.
_settled = []


class PrecisionWarning(UserWarning):
    """JAX computes in single precision, as it does unless told otherwise; issued once per process.

    Where that is intended: initial states or parameters of `np.float32`, `JAX_ENABLE_X64=0` in the environment,
    or `warnings.filterwarnings("ignore", category=lj.PrecisionWarning)`.
    """


def warn_of_float32(dtype: DTypeLike, given) -> None:
    """Warn once per process if JAX is left in single precision, and nothing shows that this is meant."""
    if _settled or dtype != SINGLE or jax.dtypes.canonicalize_dtype(np.float64) != SINGLE:
        return
    if not _is_meant(given):
        warn(
            "JAX computes in float32, as it does unless told otherwise: seven digits at most (1e-7), tolerances of "
            "1e-5 in place of 1e-9 (none below 1e-6), and still fewer digits in derivatives and fits.\n"
            'Fix: jax.config.update("jax_enable_x64", True) before the first array. Where float32 is meant, on a GPU '
            "for example, start from np.float32 arrays, or set JAX_ENABLE_X64=0 in the environment, or ignore "
            "lj.PrecisionWarning. This warning comes once.",
            PrecisionWarning,
        )
    _settled.append(True)


def _is_meant(given):
    """Whether single precision was asked for: by NumPy's float32, in the environment, or in a context."""
    if any(isinstance(x, np.ndarray | np.generic) and x.dtype == SINGLE for x in given):
        return True
    # A new thread has the setting of the process, without the contexts that this one has entered.
    with ThreadPoolExecutor(1) as thread:
        of_process = thread.submit(jax.dtypes.canonicalize_dtype, np.float64).result()
    return of_process != SINGLE or "JAX_ENABLE_X64" in os.environ


FLOAT64 = np.dtype("float64")
# Tuples made once: building a union of types takes one microsecond of a call's twenty.
ARRAYS = (np.ndarray, np.generic, jax.Array)
NUMBERS = (float, int, *ARRAYS)
NUMPY_OR_PYTHON = (bool, int, float, complex, np.ndarray, np.generic)
FLOAT64_TYPES = (np.ndarray, np.float64)


class State(NamedTuple):
    """A time, a position and a velocity, as arrays of one dtype, with the parameters."""

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    params: PyTree


def flatten(tree: PyTree):
    """The vector of all coordinates in `tree`, and the function that puts a vector back."""
    return ravel_pytree(tree)


def vector(tree: PyTree):
    """The vector alone; a NumPy array where the values are known, so that nothing is compiled."""
    xp = numpy_of(tree)
    return xp.concatenate([xp.ravel(xp.asarray(x)) for x in jtu.tree_leaves(tree)])


def like(tree: PyTree, x):
    """Give a vector x (..., n) the structure and shapes of `tree`; a NumPy vector becomes NumPy arrays."""
    leaves, structure = jtu.tree_flatten(tree)
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)])
    parts = [x[..., a:b].reshape(x.shape[:-1] + np.shape(leaf)) for a, b, leaf in zip(ends, ends[1:], leaves)]
    return jtu.tree_unflatten(structure, parts)


def numbers(tree: PyTree) -> tuple:
    """The coordinates one by one, in the order of `flatten(tree)[0]`."""
    vector, _ = flatten(tree)
    return tuple(vector[i] for i in range(vector.size))


def names(tree: PyTree) -> list[str]:
    """The name of each entry of `flatten(tree)[0]`, as the user would write it.

    >>> names({"theta": 0.0, "r": [1.0, 2.0]})
    ['r[0]', 'r[1]', 'theta']
    """
    found = []
    for path, leaf in jtu.tree_flatten_with_path(tree)[0]:
        for index in np.ndindex(np.shape(leaf)):
            suffix = "[" + ", ".join(map(str, index)) + "]" if index else ""
            found.append(_path_name(path) + suffix)
    return found


def _path_name(path: tuple):
    return "".join(_key_name(key, first=i == 0) for i, key in enumerate(path)) or "q"


def _key_name(key, first):
    if isinstance(key, jtu.SequenceKey):
        return f"q[{key.idx}]" if first else f"[{key.idx}]"
    name = key.name if isinstance(key, jtu.GetAttrKey) else str(getattr(key, "key", key))
    return printable(name) if first else f".{printable(name)}"


def state(t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> State:
    """Check a state's shapes and dtypes and make arrays of it.

    Whole numbers among the coordinates become floats. Python floats become arrays of the state's dtype, in `params`
    too: a float that stayed a Python number would be compiled in, and each new value would compile again.

    **Raises:** `TypeError` for a coordinate that is not a real number, for half precision, or for a time that is not
    one number; `ValueError` where `v` does not have the structure and shapes of `q`, or `q` is empty.
    """
    return _as_jax_arrays(given_state(t, q, v, params))


def given_state(t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> State:
    """The same as `state`, but NumPy arrays stay: a compiled program takes them in a tenth of the time."""
    t, given = _time(t), jtu.tree_leaves((q, v))
    q_arrays, v_arrays = _numbers(q, "q"), _numbers(v, "v")
    _check_alike(q_arrays, v_arrays, params)
    if not any(getattr(x, "size", 1) for x in given):
        raise ValueError(
            "q has no coordinates.\n"
            "Usual cause: None, an empty list, or a dict that is filled later.\n"
            "Fix: give at least one, such as q0 = {'theta': 0.1}."
        )
    # A Python float takes the dtype of the other coordinates.
    dtype = _dtype_of(given)
    if dtype != FLOAT64:
        if dtype.itemsize < SINGLE.itemsize:
            raise TypeError(
                f"q and v are {dtype}, and the steps of a motion are lost in its {jnp.finfo(dtype).nmant + 1} bits.\n"
                "Usual cause: the dtype of a network, given to the state, too.\n"
                "Fix: q0 and v0 of np.float32; the network in params may stay as it is."
            )
        warn_of_float32(dtype, [*given, *jtu.tree_leaves(params)])
    q, v = (jtu.tree_map(lambda x: _cast(x, dtype), tree) for tree in (q_arrays, v_arrays))
    return State(_cast(t, dtype), q, v, given_params(params, dtype))


def _dtype_of(given):
    """The common dtype of numbers: JAX's answer, and a shortcut, since asking JAX takes a tenth of a short call."""
    if all(isinstance(x, float) or isinstance(x, FLOAT64_TYPES) and x.dtype == FLOAT64 for x in given):
        return FLOAT64 if jax.config.read("jax_enable_x64") else jnp.result_type(*given)
    # Whole numbers become floats, and do not decide the dtype.
    floats = [x for x in given if not jnp.issubdtype(jnp.result_type(x), jnp.integer)]
    return jnp.result_type(*floats) if floats else jax.dtypes.canonicalize_dtype(FLOAT64)


def prepared(t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> State:
    """A state for a compiled program, in NumPy arrays where JAX is not tracing."""
    return (given_state if is_eager() else state)(t, q, v, params)


def as_arrays(tree: PyTree, dtype: DTypeLike):
    """Make arrays of the Python floats and NumPy arrays in `tree`; leave the rest as it is.

    An array that JAX made from a Python float, as `jnp.array(9.81)`, has a weak type and counts as a Python float.
    """
    return _as_jax_arrays(given_params(tree, dtype))


def _as_jax_arrays(tree: PyTree):
    return jtu.tree_map(lambda x: to_jax(x) if isinstance(x, np.ndarray) else x, tree)


def given_params(params: PyTree, dtype: DTypeLike):
    """The same as `as_arrays`, but NumPy arrays stay."""

    def convert(x):
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.extended):
            raise TypeError(
                f"params holds a typed random key ({x.dtype}), and parameters must be numbers.\n"
                'Fix: "key": jax.random.key_data(key) in params, which functions of jax.random take as it is; or draw '
                "the random numbers first, and pass these."
            )
        is_weak = isinstance(x, jax.Array) and not is_traced(x) and x.weak_type
        if isinstance(x, float) or is_weak and jnp.issubdtype(x.dtype, jnp.floating):
            return np.asarray(x, dtype)
        return _as_array(x) if isinstance(x, (np.ndarray, np.generic)) else x

    converted = jtu.tree_map(convert, params)
    _check_hashable(converted)
    return converted


def _check_hashable(params: PyTree):
    """Raise for an entry of params that is not a number and not hashable: programs are kept by such values."""
    if not any(map(_unhashable, jtu.tree_leaves(params))):
        return
    path, x = next(pair for pair in jtu.tree_leaves_with_path(params) if _unhashable(pair[1]))
    name = jtu.keystr(path, simple=True, separator=".")
    raise TypeError(
        f"{f'entry {name!r} of params' if name else 'params'} is {x!r:.60}, a {type(x).__name__}, which is neither "
        "numbers nor hashable, and a program is kept for the values of all that is not numbers.\n"
        "Usual cause: a set, or an object of a class that defines __eq__ alone, as a dataclass does.\n"
        "Fix: a frozenset or a tuple; for a class @dataclass(frozen=True), or jax.tree_util.register_dataclass."
    )


def _unhashable(x):
    if isinstance(x, NUMBERS):
        return False
    try:
        hash(x)
    except TypeError:
        return True
    return False


def _as_array(x):
    """x as an array in one of JAX's dtypes; NumPy and Python numbers become NumPy arrays."""
    if isinstance(x, jax.Array):
        return x
    if not isinstance(x, NUMPY_OR_PYTHON):
        return jnp.asarray(x)
    x = np.asarray(x)
    return x.astype(jax.dtypes.canonicalize_dtype(x.dtype), copy=False)


def _cast(x, dtype: DTypeLike):
    has_dtype = x.dtype == dtype and not getattr(x, "weak_type", False)
    return x if has_dtype else x.astype(dtype)


def as_floats(tree: PyTree):
    """Convert the whole numbers in `tree` to floats of the default size; leave the rest as it is."""

    def convert(x):
        if not isinstance(x, NUMBERS) or isinstance(x, bool | float):
            return x
        whole = isinstance(x, int) or jnp.issubdtype(x.dtype, jnp.integer)
        return _cast(_as_array(x), jax.dtypes.canonicalize_dtype(FLOAT64)) if whole else x

    return jtu.tree_map(convert, tree)


def _time(t: Array):
    """A time as an array of one number."""
    if type(t) is float:
        return np.asarray(t)
    if isinstance(t, NUMBERS) and not isinstance(t, bool) and np.ndim(t) == 0:
        return _as_array(t)
    raise TypeError(
        f"t must be one number, not {shown(t)}.\n"
        "Usual cause: arguments in another order.\n"
        "Fix: (system, t, q, v, params), as t=0.0."
    )


def _numbers(tree: PyTree, which: str):
    """The coordinates as arrays, whole numbers not yet converted; raises if one is not a real number."""
    try:
        found = jtu.tree_map(_as_number, tree)
    except TypeError:
        _check_real(tree, which)
        raise
    if not all(x.dtype == FLOAT64 or _is_real(x.dtype) for x in jtu.tree_leaves(found)):
        _check_real(tree, which)
    return found


def _as_number(x):
    # float() also takes a whole number too large for an array of integers.
    return _as_array(float(x) if type(x) is int else x)


def _is_real(dtype: DTypeLike):
    return jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)


def _check_real(tree: PyTree, which: str):
    for path, leaf in jtu.tree_leaves_with_path(tree):
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
        if _is_real(dtype):
            continue
        got, cause, fix = str(dtype), "a condition in place of a number", "0.0 or 1.0"
        if jnp.issubdtype(dtype, jnp.complexfloating):
            cause, fix = "the root of a negative number, or an amplitude", "its real part, jnp.real(...)"
        elif callable(leaf):
            got, cause, fix = "a function", "a function in place of what it returns", "f() in place of f"
        elif hasattr(leaf, "magnitude"):
            got, cause = f"{leaf!r:.60}", "a number with its unit"
            fix = "the number, x.magnitude, all in one system of units"
        elif not jnp.issubdtype(dtype, np.bool_):
            got, cause = f"{leaf!r:.60}", "text from a file, or a number that was left to be filled in"
            fix = "a number, as q0 = 0.1, or names, as q0 = {'x': 0.1}"
        raise TypeError(
            f"coordinate '{_path_name(path)}' of {which} is {got}, and the equations of motion need real numbers.\n"
            f"Usual cause: {cause}.\n"
            f"Fix: {fix}."
        )


def _check_alike(q: PyTree, v: PyTree, params: PyTree):
    q_structure, v_structure = jtu.tree_structure(q), jtu.tree_structure(v)
    if q_structure != v_structure:
        has = ["no names" if jtu.treedef_is_leaf(jtu.tree_structure(x)) else ", ".join(names(x)) for x in (q, v)]
        if has[0] == has[1]:
            has = [str(q_structure), str(v_structure)]
        cause = "a coordinate missing from v, or a name written in two ways"
        fix = "start from v = jax.tree.map(jnp.zeros_like, q)"
        if params is not None and jtu.tree_structure(params) in (q_structure, v_structure):
            cause = "arguments in another order, params before q or v; or names in only one of q and v"
            fix = "lj.integrate(system, q0, v0, params, ts=ts); and (system, t, q, v, params) at one state"
        elif isinstance(q, list | tuple) != isinstance(v, list | tuple) and "no names" in has:
            cause, fix = "an array for one and a list of numbers for the other", "arrays, q0 = jnp.array([0.1, 0.2])"
        raise ValueError(
            f"v must have the structure of q.\n  q: {has[0]}\n  v: {has[1]}\nUsual cause: {cause}.\nFix: {fix}."
        )
    for (path, a), b in zip(jtu.tree_flatten_with_path(q)[0], jtu.tree_leaves(v)):
        if a.shape != b.shape:
            raise ValueError(
                f"coordinate '{_path_name(path)}' has shape {a.shape} in q but {b.shape} in v.\n"
                "Usual cause: a scalar in one and an array of one entry in the other.\n"
                "Fix: give both the same shape, for instance v = jax.tree.map(jnp.zeros_like, q)."
            )
