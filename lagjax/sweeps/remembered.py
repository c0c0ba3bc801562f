"""The programs of the sweeps before, for another sweep of the same function over axes of the same kinds.

Two functions are the same where their code and all that they read from outside is (`meaning_of`): a lambda that is
written anew is, and one that reads another number is not. So a program is never a stale one. A function whose meaning
cannot be told is compiled for each sweep.
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

# Programs that are kept, those used last.
KEPT = 32
# (the code of the function, weakly; the program), by what they were compiled for.
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
    """The program, and the seconds that compiling it took; 0 where there was one."""
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
            # Of two codes that are the same the one that came last stays longer.
            _PROGRAMS[key] = weakref.ref(code, lambda gone: _drop(key, gone)), program
            _PROGRAMS.move_to_end(key)
            while len(_PROGRAMS) > KEPT:
                _PROGRAMS.popitem(last=False)
    return program, seconds


def _drop(key, gone):
    # Without the lock: a collection may come while this thread holds it.
    if _PROGRAMS.get(key, (None,))[0] is gone:
        _PROGRAMS.pop(key, None)


def _key(run, axes, chunk, devices, layout, patience, robust):
    """What a program is compiled for; None where that cannot be told."""
    meaning = meaning_of(run)
    if meaning is None:
        return None
    kinds = tuple((name, x.shape[1:], str(x.dtype)) for name, x in axes.values.items())
    settings = (tuple(jax.config.values.items()), jax.sharding.get_abstract_mesh())
    return meaning, kinds, chunk, tuple(devices), layout, patience, robust, settings


def _code(run):
    """The code of a function, which is gone when nothing is left that could make the function again."""
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
