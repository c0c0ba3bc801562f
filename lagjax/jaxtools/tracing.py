"""Whether JAX is tracing here and now, and in which context; and the traces that it keeps."""

from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state

from lagjax.jaxtools.plain import is_plain

# A new thread traces nothing, also where this module is imported inside a program.
with ThreadPoolExecutor(1) as _thread:
    _EAGER = _thread.submit(get_opaque_trace_state).result()

# Whether a caller watches the course of motions, lane by lane. A JAX context: inside it, functions that the user has
# jitted are traced again.
WATCHED = jax.make_user_context(default_value=False)
# Whether failures are reported by their codes alone, in a program that cannot raise an error to anybody.
SILENT = jax.make_user_context(default_value=False)
# Whether the caller solves again with the robust method when equations assumed regular turn out singular.
REGULAR_FIRST = jax.make_user_context(default_value=False)


def takes_for_regular() -> bool:
    """Whether equations are assumed regular in what JAX traces here and now."""
    return WATCHED.value and REGULAR_FIRST.value


# Caches whose keys hold what a program was traced for: the traces without a limit, the others up to 4,096 entries each.
TRACES = (
    ("jax._src.interpreters.partial_eval", "trace_to_jaxpr"),
    ("jax._src.api_util", "donation_vector"),
    ("jax._src.pjit", "_process_in_axis_resources"),
    ("jax._src.pjit", "_check_and_canonicalize_out_shardings"),
)


def is_eager() -> bool:
    """Whether JAX is tracing nothing here and now, not even a function without traced arguments."""
    return get_opaque_trace_state() == _EAGER


def forget_traces() -> None:
    """Drop JAX's traces of functions; compiled programs stay. Does nothing with `LAGJAX_PLAIN=1`.

    JAX keeps traces by function; a function such as diffrax's `diffeqsolve` has one for each system ever used. With a
    JAX that has other names for these caches, more is kept.
    """
    if is_plain():
        return
    for module, name in TRACES:
        if find_spec(module) is not None:
            getattr(getattr(import_module(module), name, None), "cache_clear", _do_nothing)()
    # The entries that lead to the traces: a method that every program has drops all of them as a side effect.
    getattr(jax.jit(_do_nothing), "clear_cache", _do_nothing)()


def _do_nothing():
    pass


def numpy_of(tree):
    """NumPy where the values of `tree` are known, so that nothing is compiled; else `jax.numpy`."""
    return jnp if is_traced(tree) else np


def is_traced(tree) -> bool:
    """Whether JAX is tracing through `tree`, so that its values are not known."""
    return any(isinstance(leaf, Tracer) for leaf in jtu.tree_leaves(tree))
