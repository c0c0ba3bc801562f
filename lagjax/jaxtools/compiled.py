"""Compile programs that Python calls: equinox's wrapper of `jit` takes longer than a short motion or fit.

On a CPU the XLA of jax 0.10 has two ways to write the kernels of fused operations, with its newer emitters and without
them. Our programs are one machine function, or hundreds of small kernels, and run as fast either way; the older way
compiles them in two thirds of the time (processor time of the hoop until it leaves: 6.3 s in place of 9.5; of a first
fit: 3.4 s in place of 5.3). Lanes of a sweep, in arrays, run up to a quarter slower that way, and so are compiled the
newer way. The XLA of jax 0.11 has one way, and no such option. `LAGJAX_PLAIN=1` leaves the option out.
"""

from collections.abc import Callable, Sequence
from functools import partial, wraps

import jax
import jax.tree_util as jtu
import numpy as np

from lagjax.jaxtools.cache import hashable_partition, once, program_of
from lagjax.jaxtools.plain import is_plain
from lagjax.jaxtools.tracing import as_usual, is_eager, is_traced
from lagjax.jaxtools.without_lapack_batches import jitted, one_by_one

WITHOUT_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


@once
def compiler_options() -> dict | None:
    """Options for `jax.jit` of a top-level program; None if XLA does not know them, which a tiny program tests once."""
    if is_plain() or jax.default_backend() != "cpu":
        return None
    return WITHOUT_EMITTERS if are_known(WITHOUT_EMITTERS) else None


def are_known(options: dict) -> bool:
    """Whether this XLA has these options."""
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def compiled(function: Callable, in_numpy: bool = False) -> Callable:
    """Compile `function` for the structure and shapes of its pytrees; inside another program it becomes part of that.

    With `in_numpy`, a call from Python returns NumPy arrays.
    """
    as_part = jitted(function)
    finish = partial(jtu.tree_map, np.asarray) if in_numpy else jax.block_until_ready

    @wraps(function)
    @as_usual
    def program(*args):
        if not is_eager() or is_traced(args):
            return as_part(*args)
        arrays, static = hashable_partition(args)
        try:
            return finish(program_of((function, static), lambda: _jitted(function, static))(arrays))
        except jax.errors.JaxRuntimeError:
            # Equinox's wrapper has a better message for the checks that equinox puts into a program.
            return finish(as_part(*args))

    return program


def _jitted(function: Callable, static):
    return jax.jit(partial(_of_arrays, function, static), compiler_options=compiler_options())


def _of_arrays(function: Callable, static, arrays: Sequence):
    return one_by_one(function)(*static.combine(arrays))
