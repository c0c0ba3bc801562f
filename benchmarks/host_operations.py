"""Which operations of a compiled program need the host: they stall a GPU, and some machines cannot do them at all.

Read off the text of the optimised program: custom calls into Python, and what moves numbers to and from the host.
"""

import re

import jax

# A host callback's name is XLA's own: "xla_ffi_python_gpu_callback", before that "xla_python_gpu_callback".
CALL = re.compile(r'custom_call_target="([^"]*)"')
PYTHON = re.compile(r"callback|ffi_python|CallbackTo", re.IGNORECASE)
# On devices without custom calls into Python a callback is a transfer; the name stands behind the type of its result.
TRANSFER = re.compile(r"= [^=]*?\s(infeed|outfeed|send|recv)\(")


def host_operations(program):
    """The names of a program's operations that need the host, in their order: an empty list is what one hopes for.

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
    """The function with a `jax.debug.callback` on the first number of its first result: what a check has to find."""

    def looked_at(*arguments):
        results = function(*arguments)
        jax.debug.callback(lambda x: None, jax.tree.leaves(results)[0])
        return results

    return looked_at
