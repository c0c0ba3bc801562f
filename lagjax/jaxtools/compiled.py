"""Programs that Python calls, compiled and kept; inside another program they are parts of it, or names."""

from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.jaxtools.cache import HashablePart, compiler_options, hashable_partition, program_of
from lagjax.jaxtools.columns import from_python
from lagjax.jaxtools.kept import KeptProgram, Said
from lagjax.jaxtools.names import named
from lagjax.jaxtools.outline import outlined, parts_of, rebuilt
from lagjax.jaxtools.primitives import jitted, one_by_one
from lagjax.jaxtools.tracing import as_usual, is_eager, is_traced


def compiled(function: Callable, in_numpy: bool = False, in_line: bool = False) -> Callable:
    """Compile `function` for the structure and shapes of its pytrees; inside another program it becomes part of that.

    Its programs are kept. With `in_numpy`, a call from Python returns NumPy arrays. With `in_line`, it is no call of
    its own in another program.
    """
    as_part = function if in_line else jitted(function)
    finish = partial(jtu.tree_map, np.asarray) if in_numpy else jax.block_until_ready

    @wraps(function)
    @as_usual
    def program(*args):
        arrays, static = hashable_partition(args)
        if not is_eager() or is_traced(args):
            of_arrays, said = partial(_of_arrays, function, static), _said(function, static)
            found = named(of_arrays, said, arrays)
            if found is None:
                found = from_python(of_arrays, said, (function, static), arrays)
            return as_part(*args) if found is None else found
        try:
            return finish(program_of((function, static), lambda: _program(function, static))(arrays))
        except jax.errors.JaxRuntimeError:
            # Equinox's wrapper has a better message for the checks that equinox puts into a program.
            return finish(jitted(function)(*args))

    return program


def _program(function: Callable, static: HashablePart) -> KeptProgram:
    return KeptProgram(partial(_of_arrays, function, static), _said(function, static), compiler_options())


def _said(function: Callable, static: HashablePart) -> Said:
    def outline(results: PyTree):
        return outlined(results, parts_of(static.combine(range(len(static.leaves)))))

    def tree(outline: Any, arrays: list):
        return rebuilt(outline, parts_of(static.combine(arrays)))

    def meant():
        return [((function, compiler_options()), False), (static, False)]

    return Said(meant, outline, tree)


def _of_arrays(function: Callable, static: HashablePart, arrays: Sequence):
    return one_by_one(function)(*static.combine(arrays))
