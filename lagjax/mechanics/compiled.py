"""Programs that are called from Python: equinox's wrapper of `jit` takes longer than a short motion or fit."""

from collections.abc import Callable
from functools import partial, wraps

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from lagjax.jax_internals.compiling import compiler_options
from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import coordinates
from lagjax.mechanics.kept import kept
from lagjax.mechanics.memory import parted


def compiled(function: Callable, in_numpy: bool = False) -> Callable:
    """`function` of pytrees as a program, compiled for their structure and shapes; inside of another it is a part.

    Where it is called by itself, it may return NumPy's arrays.
    """
    inside, done = eqx.filter_jit(function), partial(jtu.tree_map, np.asarray) if in_numpy else jax.block_until_ready

    @wraps(function)
    def program(*args):
        if not is_eager() or coordinates.is_traced(args):
            return inside(*args)
        static, arrays = parted(args)
        try:
            return done(kept((function, static), lambda: _jitted(function, static))(arrays))
        except jax.errors.JaxRuntimeError:
            # Equinox has better words for the checks that it puts into a program.
            return done(inside(*args))

    return program


def _jitted(function, static):
    return jax.jit(partial(_of_arrays, function, static), compiler_options=compiler_options())


def _of_arrays(function, static, arrays):
    return function(*static.together(arrays))
