"""Find operations of a compiled program that need the host: they stall a GPU, and some devices do not support them.

They are read from the text of the optimised program: custom calls into Python, and transfers to and from the host.
"""

import re

import jax

# XLA's names for a host callback: "xla_ffi_python_gpu_callback", formerly "xla_python_gpu_callback".
CALL = re.compile(r'custom_call_target="([^"]*)"')
PYTHON = re.compile(r"callback|ffi_python|CallbackTo", re.IGNORECASE)
# On devices without custom calls into Python a callback is a transfer; its name follows the type of its result.
TRANSFER = re.compile(r"= [^=]*?\s(infeed|outfeed|send|recv)\(")


def host_operations(program):
    """The names of a program's operations that need the host, in order; ideally an empty list.

    >>> import jax
    >>> host_operations(jax.jit(lambda x: 2 * x).lower(1.0).compile().as_text())
    []

    Args:
      program: the text of a compiled program, `jax.jit(f).lower(...).compile().as_text()`.
    """
    found = []
    for line in program.splitlines():
        found += [name for name in CALL.findall(line) if PYTHON.search(name)]
        found += TRANSFER.findall(line)
    return found


def with_a_look(function):
    """The function with a `jax.debug.callback` on the first number of its first result, which a check must find."""

    def looked_at(*arguments):
        results = function(*arguments)
        jax.debug.callback(lambda x: None, jax.tree.leaves(results)[0])
        return results

    return looked_at
