"""Check that functions can be pickled, and explain it where they cannot, before pickle fails with its own message.

Pickle writes down where a function is found, its module and name, not what it does. A lambda has no name, and a
function inside another one cannot be reached by its name.
"""

import copy
import pickle
import sys
from collections.abc import Callable, Mapping
from types import FrameType, FunctionType

from lagjax.system.traced_functions import Traced

# Packages that pickle any function, whatever its name: they write down what it does.
TAKES_ANY_FUNCTION = ("cloudpickle", "dill")


def check_functions(functions: Mapping[str, Callable | None]) -> None:
    """Raise `pickle.PicklingError` if one of these functions, given by role, cannot be found by its name."""
    for role, function in functions.items():
        function = function.function if isinstance(function, Traced) else function
        if isinstance(function, FunctionType) and not _is_found(function) and not _any_function_is_taken():
            code, name = function.__code__, function.__name__
            raise pickle.PicklingError(
                f"{role} cannot be pickled: {_why(function)} "
                f"({code.co_filename.rsplit('/', 1)[-1]}, line {code.co_firstlineno}).\n"
                "Usual cause: pickle, or a pool of processes, which finds functions by their module and name.\n"
                f"Fix: define it with def at the top of a module, as def {'f' if name == '<lambda>' else name}(...); "
                "or save a trajectory or a fit alone with .save(path), which needs no functions."
            )


def _is_found(function):
    found = sys.modules.get(function.__module__)
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is function


def _why(function):
    if function.__name__ == "<lambda>":
        return "it is a lambda"
    if "<locals>" in function.__qualname__:
        return f"{function.__name__} is defined inside of another function"
    return f"{function.__module__}.{function.__qualname__} names another function now"


def _any_function_is_taken():
    """Whether a caller takes any function: `copy`, which keeps functions, or one of `TAKES_ANY_FUNCTION`."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module == copy.__name__ or any(part in TAKES_ANY_FUNCTION for part in module.split(".")):
            return True
        frame = frame.f_back
    return False
