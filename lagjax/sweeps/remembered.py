"""A cache of the programs of earlier sweeps, for another sweep of the same function over axes of the same kinds.

Two functions are the same if their code and everything they read from outside are the same (`meaning_of`): a lambda
that is written again counts as the same, one that reads another number does not. So no stale program is ever used. A
function that cannot be compared in this way is compiled for each sweep.
"""

import inspect
import threading
import time
import types
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial

import jax

from lagjax.mechanics.outside import meaning_of
from lagjax.meter import waiting
from lagjax.sweeps.axes import Axes
from lagjax.sweeps.lanes import Program, compiled

# The number of programs kept, the most recently used ones.
MOST_PROGRAMS = 32
# (weak reference to the code of the function, program), by the key they were compiled for.
_PROGRAMS: OrderedDict = OrderedDict()
_LOCK = threading.Lock()


def program_for(
    run: Callable,
    axes: Axes,
    chunk: int,
    devices: Sequence,
    layout: str,
    patience: int | None = None,
    robust: bool = True,
    progress: bool | None = False,
) -> tuple[Program, float]:
    """The program, and the seconds it took to compile; 0 if it was in the cache."""
    key, code = _key(run, axes, chunk, devices, layout, patience, robust), _code(run)
    with _LOCK:
        _, program = _PROGRAMS.get(key, (None, None))
    seconds = 0.0
    if program is None:
        started = time.perf_counter()
        with waiting(progress, "compiling"):
            program = compiled(run, axes, chunk, devices, layout, patience, robust)
        seconds = time.perf_counter() - started
    if key is not None and code is not None:
        with _LOCK:
            # If two functions have the same code, the entry refers to the later one, which may live longer.
            _PROGRAMS[key] = weakref.ref(code, lambda reference: _drop(key, reference)), program
            _PROGRAMS.move_to_end(key)
            while len(_PROGRAMS) > MOST_PROGRAMS:
                _PROGRAMS.popitem(last=False)
    return program, seconds


def _drop(key, reference):
    # No lock here: garbage collection may run this while the same thread holds the lock.
    if _PROGRAMS.get(key, (None,))[0] is reference:
        _PROGRAMS.pop(key, None)


def _key(run, axes, chunk, devices, layout, patience, robust):
    """The key of a program: everything it is compiled for; None if the function cannot be compared."""
    meaning = meaning_of(run)
    if meaning is None:
        return None
    kinds = tuple((name, x.shape[1:], str(x.dtype)) for name, x in axes.values.items())
    settings = (tuple(jax.config.values.items()), jax.sharding.get_abstract_mesh())
    return meaning, kinds, chunk, tuple(devices), layout, patience, robust, settings


def _code(run):
    """The code object of a function: it is freed once nothing is left that could create the function again."""
    while not isinstance(run, types.FunctionType):
        if isinstance(run, partial):
            run = run.func
        elif isinstance(run, types.MethodType):
            run = run.__func__
        elif hasattr(run, "__wrapped__"):
            run = inspect.unwrap(run)
        else:
            run = getattr(type(run), "__call__", None)
            if not hasattr(run, "__code__") and not hasattr(run, "__wrapped__"):
                return None
    return run.__code__
