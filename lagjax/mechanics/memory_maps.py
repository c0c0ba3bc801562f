"""A process's memory maps, of which Linux allows 65,530: each compiled program keeps some, and at the limit it dies.

XLA maps the machine code of each of its kernels by itself: a system integrated for the first time takes 50 to 500 maps.
"""

import warnings
from pathlib import Path

MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Of the limit: what is left is enough for some tens of systems.
TELL_FROM = 0.75


def share_used(stacklevel: int = 2) -> float:
    """The share of the limit that is used, with a warning where it is near: for calls that compile something new.

    It counts lines, 1 ms a thousand.
    """
    there, limit = _counted()
    if there > TELL_FROM * limit:
        warnings.warn(
            f"this process has {there:,} of the {limit:,} memory maps that the system allows; at the limit it dies.\n"
            "Usual cause: many systems, or functions made anew in a loop, each of which is compiled and kept.\n"
            "Fix: jax.clear_caches() from time to time, which frees them (what is used again is compiled again); or "
            "what differs into params, so that one compiled program serves all.",
            stacklevel=stacklevel + 1,
        )
    return there / limit


def _counted():
    """How many there are, and may be; none of one where the system does not tell, which is not Linux."""
    try:
        with open(MAPS, "rb") as maps:
            return sum(1 for _ in maps), int(LIMIT.read_text())
    except OSError:
        return 0, 1
