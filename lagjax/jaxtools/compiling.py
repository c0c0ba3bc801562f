"""The options with which XLA compiles the programs that lagjax itself calls.

On a CPU the XLA of jax 0.10 has two ways to write the kernels of fused operations, with its newer emitters and without
them. Our programs are one machine function, or hundreds of small kernels, and run as fast either way; the older way
compiles them in two thirds of the time (processor time of the hoop until it leaves: 6.3 s in place of 9.5; of a first
fit: 3.4 s in place of 5.3). Lanes of a sweep, in arrays, run up to a quarter slower that way, and so are compiled the
newer way. The XLA of jax 0.12 has one way, and no such option. `LAGJAX_PLAIN=1` leaves the option out.
"""

from functools import lru_cache

import jax

from lagjax.jaxtools.plain import is_plain

WITHOUT_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


@lru_cache
def compiler_options() -> dict | None:
    """Options for `jax.jit` of a top-level program; None if XLA does not know them, which a tiny program tests once."""
    if is_plain() or jax.default_backend() != "cpu":
        return None
    return WITHOUT_EMITTERS if _are_known(WITHOUT_EMITTERS) else None


def _are_known(options):
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
