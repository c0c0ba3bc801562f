"""The programs that were compiled for calls from Python: bounded together, whatever they compute.

A program keeps the functions of the user that it was compiled for, and 1 to 130 MB and up to 500 memory maps with them,
for as long as it is here. Weak references would not help, as it is the program itself that holds the functions; so one
that is not used any more goes when enough others have been used after it. What is dropped and called again is compiled
again.

That frees a program if nothing else keeps it: each has a `jax.jit` of its own, and what JAX keeps of functions that it
traced inside of it is forgotten, too (3 MB of each motion). The programs of the user's own `jax.jit` stay in JAX's
caches; `jax.clear_caches()` gives them back.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

from lagjax.jax_internals.tracing import forget_traces
from lagjax.mechanics.memory_maps import share_used

T = TypeVar("T")
# Programs; a motion's take 10 to 130 MB, one evaluation's 1 to 20.
AT_MOST = 150
# Where more of the memory maps is used than this, by whomever, older programs go; the last ones stay even then.
MAPS_SHARE, AT_LEAST = 0.25, 8

# What was used last at the end.
_programs: OrderedDict = OrderedDict()
_one_thread = threading.Lock()


def kept(key: Hashable, make: Callable[[], T]) -> T:
    """The program of this key, made where there is none."""
    with _one_thread:
        found = _programs.get(key)
        if found is not None:
            _programs.move_to_end(key)
            return found
        scarce = share_used() > MAPS_SHARE
        if len(_programs) >= (AT_LEAST if scarce else AT_MOST):
            # Several at once: to count again after each takes long, and to forget traces makes others be traced again.
            few = max(AT_LEAST, len(_programs) // 2) if scarce else AT_MOST * 15 // 16
            while len(_programs) > few:
                _programs.popitem(last=False)
            forget_traces()
        found = _programs[key] = make()
        return found
