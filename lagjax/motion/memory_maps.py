"""A process's memory maps, of which Linux allows 65,530: each compiled program keeps some, and at the limit it dies.

XLA maps the machine code of each of its kernels by itself: a system integrated for the first time takes 50 to 500 maps.
`integrate` drops the programs that were used longest ago; those of the user's own `jax.jit` stay in JAX's caches, and
`jax.clear_caches()` gives them back.
"""

import warnings
from pathlib import Path

MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Of the limit: what is left is enough for some tens of systems.
TELL_FROM = 0.75


def maps_used() -> float:
    """The share of the limit that is used. It counts lines, 1 ms a thousand: for calls that compile."""
    there, limit = _counted()
    return there / limit


def warn_of_memory_maps(stacklevel: int = 2) -> None:
    """Warn where a process comes near the limit."""
    there, limit = _counted()
    if there > TELL_FROM * limit:
        warnings.warn(
            f"this process has {there:,} of the {limit:,} memory maps that the system allows; at the limit it dies.\n"
            "Usual cause: many systems, or functions made anew in a loop, each of which is compiled and kept.\n"
            "Fix: jax.clear_caches() from time to time, which frees them (what is used again is compiled again); or "
            "what differs into params, so that one compiled program serves all.",
            stacklevel=stacklevel + 1,
        )


def _counted():
    """How many there are, and may be; none of one where the system does not tell, which is not Linux."""
    try:
        with open(MAPS, "rb") as maps:
            return sum(1 for _ in maps), int(LIMIT.read_text())
    except OSError:
        return 0, 1
