"""Whether JAX is tracing, here and now, and for whom; and what it keeps of that."""

from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec

import jax
from jax.extend.core import get_opaque_trace_state

from lagjax.jax_internals.plain import is_plain

# A new thread traces nothing, also where this module is imported inside a program.
with ThreadPoolExecutor(1) as _thread:
    _EAGER = _thread.submit(get_opaque_trace_state).result()

# Whether somebody watches how motions go, lane by lane. A context of JAX's: under it what the user has jitted is traced
# again.
WATCHED = jax.make_user_context(default_value=False)
# Whether failures are told by their codes alone, in a program that has nobody to raise an error to.
SILENT = jax.make_user_context(default_value=False)
# Whether who watches runs again, with the robust way, what was taken for regular and is not.
REGULAR_FIRST = jax.make_user_context(default_value=False)


def takes_for_regular() -> bool:
    """Whether equations are taken for regular where JAX traces here and now."""
    return WATCHED.value and REGULAR_FIRST.value


# Caches whose keys hold what a program was traced for: the traces, without a limit, and 4,096 of each of the others.
TRACES = (
    ("jax._src.interpreters.partial_eval", "trace_to_jaxpr"),
    ("jax._src.api_util", "donation_vector"),
    ("jax._src.pjit", "_process_in_axis_resources"),
    ("jax._src.pjit", "_check_and_canonicalize_out_shardings"),
)


def is_eager() -> bool:
    """Whether JAX traces nothing here and now, not even in a function that closes over it."""
    return get_opaque_trace_state() == _EAGER


def forget_traces() -> None:
    """Drop what JAX keeps of functions that it has traced; what it has compiled stays. Not with `LAGJAX_PLAIN=1`.

    It keeps that by the function, of functions such as diffrax's `diffeqsolve` for each system that ever came by. A JAX
    that calls them otherwise keeps more.
    """
    if is_plain():
        return
    for module, name in TRACES:
        if find_spec(module) is not None:
            getattr(getattr(import_module(module), name, None), "cache_clear", _none)()
    # What leads to the traces: all of it, as a side effect of a method that every program has.
    getattr(jax.jit(_none), "clear_cache", _none)()


def _none():
    pass
