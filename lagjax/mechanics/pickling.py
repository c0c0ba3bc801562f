"""What can be pickled, said before pickle itself says it in words of its own.

Pickle writes down where a function is found, its module and its name, and not what it does. A lambda has no name, and a
function inside another one cannot be reached by it.
"""

import copy
import pickle
import sys
from collections.abc import Callable, Mapping
from types import FrameType, FunctionType

# Who takes functions as they are, whatever their names: copies keep them, and others write down what they do.
TAKES_ANY_FUNCTION = ("cloudpickle", "dill")


def check_functions(functions: Mapping[str, Callable | None]) -> None:
    """Raise `pickle.PicklingError` where one of these functions, each by what it is, cannot be found by its name."""
    for role, function in functions.items():
        if isinstance(function, FunctionType) and not _is_found(function) and not _any_function_will_do():
            code, name = function.__code__, function.__name__
            raise pickle.PicklingError(
                f"{role} cannot be pickled: {_why(function)} "
                f"({code.co_filename.rsplit('/', 1)[-1]}, line {code.co_firstlineno}).\n"
                "Usual cause: pickle, or a pool of processes, which finds functions by their module and name.\n"
                f"Fix: define it with def at the top of a module, as def {'f' if name == '<lambda>' else name}(...); "
                "for a trajectory or a fit alone .save(path), which needs no functions."
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
    return f"{function.__module__}.{function.__qualname__} is another function by now"


def _any_function_will_do():
    """Whether somebody is at work who takes any function."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module == copy.__name__ or any(part in TAKES_ANY_FUNCTION for part in module.split(".")):
            return True
        frame = frame.f_back
    return False
