"""The programs compiled for calls from Python, whatever they compute, with one limit on their number.

As long as a program is kept here, it holds the user's functions that it was compiled for, and with them 1 to 130 MB and
up to 500 memory maps. Weak references would not help, since the program itself holds the functions; so a program is
dropped when enough others have been used after it. When it is called again, it is compiled again.

Dropping a program frees it if nothing else keeps it: each has a `jax.jit` of its own, and JAX's traces of the functions
inside it are dropped too (3 MB for each motion). The programs of the user's own `jax.jit` stay in JAX's caches;
`jax.clear_caches()` frees them.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

from lagjax.jaxtools.memory_maps import share_used
from lagjax.jaxtools.tracing import forget_traces

T = TypeVar("T")
# The most programs kept; those of a motion take 10 to 130 MB, those of one evaluation 1 to 20.
AT_MOST = 150
# Where more than this share of the memory maps is in use, by any code, all but the last few programs may be dropped.
MAPS_SHARE, AT_LEAST = 0.25, 8

# The most recently used program is the last one.
_programs: OrderedDict = OrderedDict()
_one_thread = threading.Lock()


def kept(key: Hashable, make: Callable[[], T]) -> T:
    """The program of this key, made if there is none yet."""
    with _one_thread:
        found = _programs.get(key)
        if found is not None:
            _programs.move_to_end(key)
            return found
        scarce = share_used() > MAPS_SHARE
        if len(_programs) >= (AT_LEAST if scarce else AT_MOST):
            # Drop several at once: counting the maps again takes long, and forgetting traces makes others trace again.
            target = max(AT_LEAST, len(_programs) // 2) if scarce else AT_MOST * 15 // 16
            while len(_programs) > target:
                _programs.popitem(last=False)
            forget_traces()
        found = _programs[key] = make()
        return found
