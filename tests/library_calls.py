"""Read off a program which calls of LAPACK it makes for several matrices at once."""

import re

import jax

CALL = re.compile(r"custom_call @(lapack_\w+)\(.*?: \((.*?)\) ->")
# The axes of the first operand for one matrix.
AXES = {"gtsv": 1}


def calls_in(text):
    """(target, shape of the first operand) of each call of LAPACK in a program's StableHLO."""
    found = []
    for target, operands in CALL.findall(text):
        *shape, _ = re.search(r"tensor<([^>]*?)(?:complex<\w+>)?>", operands)[1].rstrip("x").split("x") + [""]
        found.append((target, tuple(int(x) for x in shape if x.isdigit())))
    return found


def batches_in(text):
    """Those of them that are for several matrices."""
    found = []
    for target, shape in calls_in(text):
        axes = next((n for name, n in AXES.items() if name in target), 2)
        many = 1
        for size in shape[:-axes]:
            many *= size
        found += [(target, shape)] if many > 1 else []
    return found


def text_of(function, *args):
    """The program of a function, lowered and not compiled."""
    return jax.jit(function).lower(*args).as_text()
