"""Compile programs that Python calls: equinox's wrapper of `jit` takes longer than a short motion or fit."""

from collections.abc import Callable
from functools import partial, wraps

import jax
import jax.tree_util as jtu
import numpy as np

from lagjax.jaxtools.cache import parted
from lagjax.jaxtools.compiling import compiler_options
from lagjax.jaxtools.program_cache import kept
from lagjax.jaxtools.tracing import is_eager, is_traced
from lagjax.jaxtools.without_lapack_batches import jitted, one_by_one


def compiled(function: Callable, in_numpy: bool = False) -> Callable:
    """Compile `function` for the structure and shapes of its pytrees; inside another program it becomes part of that.

    With `in_numpy`, a call from Python returns NumPy arrays.
    """
    as_part = jitted(function)
    finish = partial(jtu.tree_map, np.asarray) if in_numpy else jax.block_until_ready

    @wraps(function)
    def program(*args):
        if not is_eager() or is_traced(args):
            return as_part(*args)
        static, arrays = parted(args)
        try:
            return finish(kept((function, static), lambda: _jitted(function, static))(arrays))
        except jax.errors.JaxRuntimeError:
            # Equinox's wrapper has a better message for the checks that equinox puts into a program.
            return finish(as_part(*args))

    return program


def _jitted(function, static):
    return jax.jit(partial(_of_arrays, function, static), compiler_options=compiler_options())


def _of_arrays(function, static, arrays):
    return one_by_one(function)(*static.together(arrays))
