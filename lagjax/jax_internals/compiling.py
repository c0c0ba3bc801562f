"""How XLA is asked to compile the programs that lagjax calls by itself.

On a CPU the XLA of jax 0.10 has two ways to write the kernels of fused operations, by its newer emitters and without
them. Our programs are one machine function, or hundreds of small kernels, and run as fast either way; the older way
compiles them in two thirds of the time (the hoop until it leaves: 6.3 s of a processor in place of 9.5; a first fit:
3.4 s in place of 5.3). Lanes of a sweep, in arrays, run up to a quarter slower so, and are compiled the newer way. The
XLA of jax 0.12 knows one way, and no such option. `LAGJAX_PLAIN=1` leaves it out.
"""

from functools import lru_cache

import jax

from lagjax.jax_internals.plain import is_plain

WITHOUT_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


@lru_cache
def compiler_options() -> dict | None:
    """For `jax.jit` of a program at the top; None where XLA does not know them, which a tiny program tells once."""
    if is_plain() or jax.default_backend() != "cpu":
        return None
    return WITHOUT_EMITTERS if _are_known(WITHOUT_EMITTERS) else None


def _are_known(options):
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
