"""Evaluate programs in NumPy, one operation after the other: nothing is compiled but what NumPy does not have."""

import string
from functools import partial

import jax
import numpy as np

from lagjax.jaxtools.jaxpr import IN_NUMPY, applied, interpreted
from lagjax.mechanics.equations import equations_of
from lagjax.system import coordinates
from lagjax.system.model import model_of


def _product(x, y, dimension_numbers, **_):
    """A product of two arrays, summed over the axes that are contracted."""
    (of_x, of_y), (lanes_x, lanes_y) = dimension_numbers
    names, others = string.ascii_letters[: x.ndim], list(string.ascii_uppercase[: y.ndim])
    for i, j in zip((*lanes_x, *of_x), (*lanes_y, *of_y)):
        others[j] = names[i]
    lanes = [names[i] for i in lanes_x]
    free = [a for i, a in enumerate(names) if i not in (*lanes_x, *of_x)]
    free += [a for j, a in enumerate(others) if j not in (*lanes_y, *of_y)]
    return np.einsum(f"{names},{''.join(others)}->{''.join(lanes + free)}", x, y)


def _spread(x, shape, broadcast_dimensions, **_):
    new = np.ones(len(shape), int)
    new[list(broadcast_dimensions)] = x.shape
    return np.broadcast_to(x.reshape(new), shape)


def _padded(x, value, padding_config):
    for axis, (low, high, inside) in enumerate(padding_config):
        places = low + np.arange(x.shape[axis]) * (inside + 1)
        length = low + high + max((x.shape[axis] - 1) * (inside + 1) + 1, 0)
        wide, kept = np.full((*x.shape[:axis], length, *x.shape[axis + 1 :]), value), (places >= 0) & (places < length)
        np.moveaxis(wide, axis, 0)[places[kept]] = np.moveaxis(x, axis, 0)[kept]
        x = wide
    return x


def _windows(array, places, sizes, along, batching, mode):
    """For each place where in an array its window is, and whether it lies inside or is moved there."""
    of_array, of_places = map(list, batching)
    for place in np.ndindex(places.shape[:-1]):
        corner = np.zeros(array.ndim, int)
        corner[list(along)], corner[of_array] = places[place], np.array(place, int)[of_places]
        inside = np.clip(corner, 0, np.subtract(array.shape, sizes))
        yield place, tuple(map(slice, inside, inside + sizes)), mode.name == "CLIP" or np.array_equal(inside, corner)


def _gathered(x, places, dimension_numbers, slice_sizes, mode, **_):
    of = dimension_numbers
    single = *of.collapsed_slice_dims, *of.operand_batching_dims
    shape = [n for i, n in enumerate(slice_sizes) if i not in single]
    found = np.zeros((*places.shape[:-1], *shape), x.dtype)
    batching = of.operand_batching_dims, of.start_indices_batching_dims
    for place, window, fits in _windows(x, places, slice_sizes, of.start_index_map, batching, mode):
        found[place] = x[window].reshape(shape) if fits else np.nan
    return np.moveaxis(found, range(found.ndim - len(shape), found.ndim), of.offset_dims)


def _slid(x, corner, sizes):
    corner = np.clip(corner, 0, np.subtract(x.shape, sizes))
    return x[tuple(map(slice, corner, corner + sizes))]


def _scattered(adds, x, places, new, dimension_numbers, mode, **_):
    of, found = dimension_numbers, x.copy()
    single, count = (*of.inserted_window_dims, *of.operand_batching_dims), len(of.update_window_dims)
    new = np.moveaxis(new, of.update_window_dims, range(new.ndim - count, new.ndim))
    rest = iter(new.shape[new.ndim - count :])
    sizes = [1 if i in single else next(rest) for i in range(x.ndim)]
    batching = of.operand_batching_dims, of.scatter_indices_batching_dims
    for place, window, fits in _windows(x, places, sizes, of.scatter_dims_to_operand_dims, batching, mode):
        if fits:
            found[window] = new[place].reshape(sizes) + adds * found[window]
    return found


def _inverted(matrix, eliminate):
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def _counted(dimension, shape, **_):
    return np.indices(shape)[dimension]


def _summed_up(x, axis, reverse):
    return np.flip(np.cumsum(np.flip(x, axis), axis), axis) if reverse else np.cumsum(x, axis)


def _rounded(x, rounding_method):
    return np.rint(x) if rounding_method.name == "TO_NEAREST_EVEN" else np.trunc(x + np.copysign(0.5, x))


OF_SLICES = "start_indices", "limit_indices", "strides"
PLAIN = IN_NUMPY | {
    "atan2": np.arctan2, "ceil": np.ceil, "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "cos": np.cos, "div": lambda x, y: x / y if np.issubdtype(x.dtype, np.inexact) else np.trunc(x / y),
    "add_any": np.add, "exp": np.exp, "floor": np.floor, "is_finite": np.isfinite, "log": np.log, "log1p": np.log1p,
    "pow": np.power, "rem": np.fmod, "sign": np.sign, "sin": np.sin, "sincos": lambda x: [np.sin(x), np.cos(x)],
    "sqrt": np.sqrt, "stop_gradient": np.copy,
    "acos": np.arccos, "asin": np.arcsin, "atan": np.arctan, "copy": np.copy, "cosh": np.cosh, "sinh": np.sinh,
    "tan": np.tan, "tanh": np.tanh, "acosh": np.arccosh, "asinh": np.arcsinh, "atanh": np.arctanh, "expm1": np.expm1,
}  # fmt: skip
WITH_PARAMETERS = {
    "argmax": lambda x, axes, index_dtype: np.argmax(x, axes[0]),
    "broadcast_in_dim": _spread,
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "convert_element_type": lambda x, new_dtype, **_: x.astype(new_dtype),
    "cumsum": _summed_up,
    "dot_general": _product,
    "dynamic_slice": lambda x, *corner, slice_sizes: _slid(x, np.array(corner), slice_sizes),
    "gather": _gathered,
    "integer_pow": lambda x, y: x**y,
    "inverse": _inverted,
    "iota": _counted,
    "pad": _padded,
    "reduce_and": lambda x, axes, **_: np.all(x, tuple(axes)),
    "reduce_max": lambda x, axes, **_: np.max(x, tuple(axes)),
    "reduce_min": lambda x, axes, **_: np.min(x, tuple(axes)),
    "reduce_or": lambda x, axes, **_: np.any(x, tuple(axes)),
    "reduce_sum": lambda x, axes, **_: np.sum(x, tuple(axes)),
    "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
    "xla_metadata_value": lambda x, **_: x,
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "round": _rounded,
    "scatter": partial(_scattered, 0),
    "scatter-add": partial(_scattered, 1),
    "slice": lambda x, **params: x[tuple(map(slice, *(params[name] or [1] * x.ndim for name in OF_SLICES)))],
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: np.squeeze(x, tuple(dimensions)),
    "stack": lambda *x, axis: np.stack(x, axis),
    "transpose": lambda x, permutation: np.transpose(x, permutation),
    "unstack": lambda x, axis: list(np.moveaxis(x, axis, 0)),
}


def run(closed, *args):
    """The results of a program on NumPy arrays, as a list of them."""

    def rule(equation, operands):
        name, results, params = equation.primitive.name, equation.outvars, equation.params
        if name == "cond":
            return run(params["branches"][int(operands[0])], *operands[1:])
        if name == "one_function":
            return run(params["jaxpr"], *operands)
        if name == "while":
            found = _repeated(*operands, **params)
        elif name == "scan" and "num_consts" in params:
            found = _in_turn(*operands, **params)
        elif name in PLAIN:
            found = PLAIN[name](*operands)
        elif name in WITH_PARAMETERS:
            found = WITH_PARAMETERS[name](*operands, **params)
        else:
            found = applied(closed.jaxpr, equation, operands)
        found = found if equation.primitive.multiple_results or isinstance(found, list) else [found]
        return [np.asarray(x, like.aval.dtype) for x, like in zip(found, results)]

    inputs = [np.asarray(x, like.dtype) for x, like in zip(args, closed.in_avals, strict=True)]
    with np.errstate(all="ignore"):
        return interpreted(closed, inputs, rule, lambda x, aval: np.asarray(x, aval.dtype))


def _repeated(*operands, cond_jaxpr, body_jaxpr, cond_nconsts, body_nconsts):
    of_test, of_body = operands[:cond_nconsts], operands[cond_nconsts : cond_nconsts + body_nconsts]
    carried = operands[cond_nconsts + body_nconsts :]
    while run(cond_jaxpr, *of_test, *carried)[0]:
        carried = run(body_jaxpr, *of_body, *carried)
    return list(carried)


def _in_turn(*operands, jaxpr, num_consts, num_carry, length, reverse, **_):
    fixed, carried = operands[:num_consts], operands[num_consts : num_consts + num_carry]
    rows = {}
    for i in range(length)[::-1] if reverse else range(length):
        found = run(jaxpr, *fixed, *carried, *(x[i] for x in operands[num_consts + num_carry :]))
        carried, rows[i] = found[:num_carry], found[num_carry:]
    return [*carried, *(np.stack(x) for x in zip(*(rows[i] for i in range(length))))]


def evaluated(function, *args):
    """The result of a function of arrays, its leaves in a list."""
    return run(jax.make_jaxpr(function)(*args), *jax.tree.leaves(args))


def in_numpy(function):
    """The same function of trees, traced once for each kind of arguments."""
    programs = {}

    def computed(*args):
        leaves, structure = jax.tree.flatten(args)
        kind = structure, *((np.shape(x), getattr(x, "dtype", type(x))) for x in leaves)
        if kind not in programs:
            program, like = jax.make_jaxpr(function, return_shape=True)(*args)
            programs[kind] = program, jax.tree.structure(like)
        program, structure = programs[kind]
        return jax.tree.unflatten(structure, run(program, *leaves))

    return computed


def accelerations(system, t, q, v, params):
    """The accelerations and the multipliers of a system, by its equations in one matrix."""
    solved = lambda *state: equations_of(model_of(system, *state)).accelerations(*state[:3])
    return in_numpy(solved)(*coordinates.state(t, q, v, params))


def along(function):
    """The values of a function and their derivative, from a point and a direction."""
    return lambda x, dx: jax.jvp(function, (x,), (dx,))
