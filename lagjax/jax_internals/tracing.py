"""Whether JAX is tracing, here and now, and for whom."""

from concurrent.futures import ThreadPoolExecutor

import jax
from jax.extend.core import get_opaque_trace_state

# A new thread traces nothing, also where this module is imported inside a program.
with ThreadPoolExecutor(1) as _thread:
    _EAGER = _thread.submit(get_opaque_trace_state).result()

# Whether somebody watches how motions go, lane by lane. A context of JAX's: under it what the user has jitted is traced
# again.
WATCHED = jax.make_user_context(default_value=False)


def is_eager() -> bool:
    """Whether JAX traces nothing here and now, not even in a function that closes over it."""
    return get_opaque_trace_state() == _EAGER
