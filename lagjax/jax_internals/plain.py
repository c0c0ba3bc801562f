"""The way out: `LAGJAX_PLAIN=1` in the environment runs every program as JAX makes it.

Nothing is then written out number by number and nothing compiled as one function: the same results to round-off,
several times slower. It is for comparison, and for the day on which a new XLA takes one of these programs amiss. That
day is looked out for: with an XLA that is not known, `trial.py` first tries marked programs in a process of their own,
once, and where that fails the way out is taken, with a warning. `LAGJAX_PLAIN=0` does without the trial.
"""

import os
import warnings

import jaxlib.version

from lagjax.jax_internals.trial import survives

# With 0.10.2 all tests run; with 0.10.1 the fast ones; with 0.12.0.1 those of this package, a pendulum and a rod.
KNOWN = {"0.10.1", "0.10.2", "0.12.0.1"}
# Read once: compiled programs are kept, and must not mix.
_WANTED = os.environ.get("LAGJAX_PLAIN", "")
_decided: list[bool] = []


def is_plain() -> bool:
    """Whether every program runs as JAX makes it; decided when the first one is made."""
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
            f"Fix: a jaxlib that is known ({', '.join(sorted(KNOWN))}), or a newer lagjax; LAGJAX_PLAIN=1 in the "
            "environment for no warning, LAGJAX_PLAIN=0 for no trial.",
            stacklevel=2,
        )
    return trusted
