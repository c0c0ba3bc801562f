"""The two attributes of a call by which XLA compiles it as one machine function on a CPU.

`inlineable="false"` keeps the call a call, and `xla_cpu_small_call="true"` is XLA's own mark for loops that its pass
`small-while-loop-hoisting` has chosen. An XLA that does not know them ignores them. What they buy, measured on a
pendulum on a rod: with jax 0.10.2 a solve takes 0.3 ms, 4 without the second mark, and 5 without both, when it takes
six times as long to compile. The XLA of jax 0.12 chooses such loops by itself: 0.4 ms, the same without the second
mark, and 1.1 without both; code outside loops still is one kernel only with both. `tests/jaxtools/test_xla_marks.py`
counts kernels.

JAX has no public call for such attributes, up to 0.12; the experimental one puts them on the operation that makes
a result.
"""

from typing import cast

import jax
from jax.experimental.xla_metadata import set_xla_metadata

STAYS_A_CALL = {"inlineable": "false"}
ONE_KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}


def marked(result: jax.Array, marks: dict[str, str]) -> jax.Array:
    """Put marks on the call of a jitted function, given its first result; return that."""
    return cast(jax.Array, set_xla_metadata(result, **marks))
