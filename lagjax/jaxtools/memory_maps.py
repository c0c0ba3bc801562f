"""The memory maps of a process: each compiled program keeps some, and at Linux's limit of 65,530 the process dies.

XLA maps the machine code of each kernel separately: a system integrated for the first time takes 50 to 500 maps.
"""

import warnings
from pathlib import Path

MAPS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# The share of the limit from which on to warn: the rest is enough for some tens of systems.
WARN_FROM = 0.75


def share_used(stacklevel: int = 2) -> float:
    """The share of the limit in use, with a warning near the limit; to be called where something new is compiled.

    Counting takes 1 ms per thousand maps.
    """
    used, limit = _count_maps()
    if used > WARN_FROM * limit:
        warnings.warn(
            f"this process has {used:,} of the {limit:,} memory maps that the operating system allows; at the limit it "
            "dies.\n"
            "Usual cause: many systems, or functions defined again in a loop, each of which is compiled and kept.\n"
            "Fix: jax.clear_caches() from time to time, which frees them (what is used again is compiled again); or "
            "move what differs into params, so that one compiled program serves all.",
            stacklevel=stacklevel + 1,
        )
    return used / limit


def _count_maps():
    """How many maps there are and may be; 0 and 1 where the operating system does not tell (not Linux)."""
    try:
        with open(MAPS, "rb") as maps:
            return sum(1 for _ in maps), int(LIMIT.read_text())
    except OSError:
        return 0, 1
