"""The fallback: `LAGJAX_PLAIN=1` in the environment runs every program as plain JAX.

Nothing is then written out number by number and nothing compiled as one function: the same results to round-off,
several times slower. It serves for comparison, and for versions of XLA with which no test was run: XLA does not check
what our marks promise, and where it mishandles one it ends the process. `LAGJAX_PLAIN=0` compiles as ever with any.
"""

import os
import warnings

import jaxlib.version

# Run with 0.10.2: all tests; with 0.10.1: the fast ones; with the others: those of this package, a pendulum and a rod.
KNOWN = {"0.10.1", "0.10.2", "0.11.0", "0.11.1", "0.11.2", "0.12.0", "0.12.0.1"}
# Read once: compiled programs are kept, and the two kinds must not mix.
_WANTED = os.environ.get("LAGJAX_PLAIN", "")
_decided: list[bool] = []


def is_plain() -> bool:
    """Whether every program runs as plain JAX; decided when the first one is made."""
    if not _decided:
        known = jaxlib.version.__version__ in KNOWN
        _decided.append(_WANTED != "0" if _WANTED else not known)
        if not _WANTED and not known:
            warnings.warn(
                f"lagjax was not tested with jaxlib {jaxlib.version.__version__}, so motions are compiled as plain "
                "JAX programs: the same results, several times slower.\n"
                f"Fix: a tested jaxlib ({', '.join(sorted(KNOWN))}), or a newer lagjax; LAGJAX_PLAIN=1 in the "
                "environment for no warning, LAGJAX_PLAIN=0 to compile for speed all the same.",
                stacklevel=2,
            )
    return _decided[0]
