"""Questions to JAX before a program is run: is it tracing, does the user want plain JAX; and small helpers for trees.

`LAGJAX_PLAIN=1` in the environment runs every program as plain JAX, the fallback: nothing is then written out number by
number and nothing compiled as one function: the same results to round-off, several times slower. It serves for
comparison, and for versions of XLA with which no test was run: XLA does not check what our marks promise, and where it
mishandles one it ends the process. `LAGJAX_PLAIN=0` compiles as ever with any.
"""

import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import jaxlib.version
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Bool, PyTree

from lagjax.contexts import REGULAR_FIRST, WATCHED

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


# A new thread traces nothing, also where this module is imported inside a program.
with ThreadPoolExecutor(1) as _thread:
    _EAGER = _thread.submit(get_opaque_trace_state).result()

# What has happened, and how often, that has to happen in each process: a program that does it while it is traced is
# not kept for another one.
HAPPENED: Counter[str] = Counter()


def takes_for_regular() -> bool:
    """Whether equations are assumed regular in what JAX traces here and now."""
    return WATCHED.value and REGULAR_FIRST.value


def is_eager() -> bool:
    """Whether JAX is tracing nothing here and now, not even a function without traced arguments."""
    return get_opaque_trace_state() == _EAGER


def at_once():
    """A context in which what JAX is not tracing is computed, also while it traces something else.

    In `jax.ensure_compile_time_eval` alone, each constant of a program that is traced there is compiled and computed by
    itself, in thirty milliseconds: where JAX traces nothing, no context is needed.
    """
    return nullcontext() if is_eager() else jax.ensure_compile_time_eval()


def as_usual(function: Callable) -> Callable:
    """The same function, with JAX's settings for finding errors off, whatever the user has set for his own code.

    It compiles: one by one, the operations of a motion take minutes. It does not look for NaN: trial steps, outputs
    that a motion did not reach and slots for events that did not happen are NaN. It may make constants for a program.
    It may add a bool to an integer, or a count to a time: strict promotion is for the user's functions, which are
    traced before.
    """

    @wraps(function)
    def without_debugging(*args, **kwargs):
        config: Any = jax.config
        looks = config.jax_debug_nans or config.jax_debug_infs
        guarded = config.jax_transfer_guard_host_to_device not in (None, "allow")
        strict = config.jax_numpy_dtype_promotion != "standard"
        if not (looks or config.jax_disable_jit or guarded or strict):
            return function(*args, **kwargs)
        with ExitStack() as usual:
            usual.enter_context(jax.numpy_dtype_promotion("standard"))
            usual.enter_context(jax.disable_jit(False))
            usual.enter_context(jax.transfer_guard("allow"))
            if looks:
                # Not otherwise: on leaving, JAX 0.10 stops looking in compiled programs if the user asked by an update.
                usual.enter_context(jax.debug_nans(False))
                usual.enter_context(jax.debug_infs(False))
            return function(*args, **kwargs)

    return without_debugging


def full_products():
    """A context in which products of matrices keep every digit of their dtype, unless the user set how many they keep.

    By default an accelerator keeps three digits in float32: constraints and small tolerances are then out of reach.
    """
    config: Any = jax.config
    return nullcontext() if config.jax_default_matmul_precision else jax.default_matmul_precision("highest")


def numpy_of(tree: PyTree):
    """NumPy where the values of `tree` are known, so that nothing is compiled; else `jax.numpy`."""
    return jnp if is_traced(tree) else np


def to_jax(x: Any) -> Array:
    """A copy of a NumPy array as one of JAX's, which stay: `jnp.asarray` without a dtype compiles for each shape."""
    if isinstance(x, Array):
        return x
    x = np.array(x)
    return jnp.asarray(x, jax.dtypes.canonicalize_dtype(x.dtype))


def is_traced(tree: PyTree) -> bool:
    """Whether JAX is tracing through `tree`, so that its values are not known."""
    return any(isinstance(leaf, Tracer) for leaf in jtu.tree_leaves(tree))


def is_differentiated(tree: PyTree) -> bool:
    """Whether JAX is taking a derivative by something in `tree`; from inside a jitted function that is not seen.

    >>> def seen(x):
    ...     print(is_differentiated({"x": x}))
    ...     return x
    >>> slopes = seen(1.0), jax.grad(seen)(1.0), jax.jit(jax.vmap(jax.grad(seen)))(jnp.ones(2))
    False
    True
    True
    """

    def moves(x: Any) -> bool:
        # The tracers of both modes hold a tangent; one of lanes holds what its lanes are.
        return isinstance(x, Tracer) and (hasattr(x, "tangent") or hasattr(x, "batch_dim") and moves(getattr(x, "val")))

    return any(map(moves, jtu.tree_leaves(tree)))


def stop_gradient(tree: PyTree):
    """The tree without derivatives.

    >>> print(jax.grad(lambda x: x * stop_gradient({"x": x})["x"])(3.0))
    3.0
    """
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def without_init(cls: type, fields: Mapping[str, Any]):
    """An instance with these fields, whose own `__init__` is not called: it would check, or take long.

    >>> print(without_init(type("Pair", (), {}), {"re": 1.0}).re)
    1.0
    """
    made = object.__new__(cls)
    for name, x in fields.items():
        object.__setattr__(made, name, x)
    return made


def where(condition, a, b):
    """The arrays of `a` where the condition holds, else those of `b`, in the dtypes of these."""
    return jax.tree.map(
        lambda x, y: jnp.where(condition, x, y).astype(jnp.result_type(y)) if eqx.is_array(y) else y, a, b
    )


def like(mask, x):
    """A mask of rows or lanes with as many axes as x has."""
    return mask.reshape(mask.shape + (1,) * (jnp.ndim(x) - jnp.ndim(mask)))


def decided(truth: Bool[Array, "..."]) -> Bool[Array, "..."]:
    """The same truth value, behind a quotient.

    On a CPU, XLA copies what a selection depends on into each selection of single numbers, but computes a quotient
    once. A test of all results that decides about each of them would be compiled as often as there are results.
    """
    return 1.0 / jnp.where(truth, 1.0, -1.0) > 0
