"""The fallback: `LAGJAX_PLAIN=1` in the environment runs every program as plain JAX.

Nothing is then written out number by number and nothing compiled as one function: the same results to round-off,
several times slower. It serves for comparison, and in case a new XLA mishandles one of these programs. That case is
detected: with an unknown XLA, `trial.py` first tries marked programs in a process of their own, once, and if that fails
the fallback is taken, with a warning. `LAGJAX_PLAIN=0` skips the trial.
"""

import os
import warnings

import jaxlib.version

from lagjax.jax_internals.trial import survives

# Run with 0.10.2: all tests; with 0.10.1: the fast ones; with 0.12.0.1: those of this package, a pendulum and a rod.
KNOWN = {"0.10.1", "0.10.2", "0.12.0.1"}
# Read once: compiled programs are kept, and the two kinds must not mix.
_WANTED = os.environ.get("LAGJAX_PLAIN", "")
_decided: list[bool] = []


def is_plain() -> bool:
    """Whether every program runs as plain JAX; decided when the first one is made."""
    if not _decided:
        _decided.append(_WANTED != "0" if _WANTED else jaxlib.version.__version__ not in KNOWN and not _is_trusted())
    return _decided[0]


def _is_trusted():
    trusted = survives()
    if not trusted:
        warnings.warn(
            f"lagjax does not know jaxlib {jaxlib.version.__version__}, and small programs compiled as lagjax compiles "
            "them did not run, or gave wrong answers. Motions are therefore compiled as plain JAX programs: the same "
            "results, several times slower.\n"
            f"Fix: a known jaxlib ({', '.join(sorted(KNOWN))}), or a newer lagjax; LAGJAX_PLAIN=1 in the "
            "environment for no warning, LAGJAX_PLAIN=0 for no trial.",
            stacklevel=2,
        )
    return trusted
