"""What the user's functions read from outside: globals, closed-over values, defaults, the attributes of objects.

A compiled program holds the values that these had when it was traced. So each public call looks at them, and a change
makes another `System`, which is traced anew. Functions are followed into those that they call, but not into installed
packages, whose globals are constants; a class into its methods. Values that JAX is tracing are left to `closures.py`.

There are two looks. `read_by` is fast, as it comes with every call: arrays beyond `WHOLE` bytes are compared by
identity and a sample, what has attributes by those one level deep. `meaning_of` compares everything by its content, so
that two functions that mean the same have the same meaning, or says that it cannot.
"""

import builtins
import dataclasses
import dis
import hashlib
import inspect
import sys
import sysconfig
import threading
import types
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from functools import cached_property, lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.memory import AT_MOST, remembered
from lagjax.mechanics.system import System

# Bytes of an array that is compared whole (10 microseconds); of a larger one so many entries are.
WHOLE, SAMPLE = 2**14, 256
# Entries of a list or a dictionary that is looked into.
SHORT = 64
# The same where everything is compared, and how many objects there may be.
WHOLE_IN_FULL, SHORT_IN_FULL, MOST = 2**26, 2**13, 2**14
MISSING = object()
INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
OWN = __file__.rsplit("mechanics", 1)[0]
# What these return may be another value each time.
VARYING_MODULES = ("datetime", "importlib", "io", "numpy.random", "os", "random", "secrets", "time")
VARYING = {"open", "input", "eval", "exec", "globals", "locals", "vars", "__import__"}
FUNCTIONS = (types.FunctionType, types.MethodType, types.BuiltinFunctionType, partial)
# The flag of a class that is made by Python or lives like one that is.
OF_PYTHON = 1 << 9
# What a class has of its own accord.
OF_EACH_CLASS = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType)


def up_to_date(system: System) -> System:
    """The system, as a new one where what its functions read from outside has changed since it was made."""
    functions = [system.lagrangian, system.force, system.dissipation]
    functions += [c.g if isinstance(c, Holonomic) else c.phi for c in system.constraints.values()]
    found = tuple(read_by(function) for function in functions)
    return system.reading(found) if any(found) else system


def first_alike(system: System, now: System) -> System:
    """The first system that means the same as `system`, which is `now`, and of which programs have been compiled.

    A cell of a notebook that is run again makes the same functions anew.
    """
    of = (now.lagrangian, now.force, now.dissipation, *now.constraints.values())
    meaning = remembered(system, (first_alike, now.read), lambda: _meaning_of_all(of, tuple(now.constraints)))
    return _first_of(_systems, meaning, now, lambda first: up_to_date(first).read == first.read)


def first_guard_alike(guard: Callable) -> tuple[Callable, Hashable]:
    """The first function, or module that can be called, that means the same as `guard`, and what it reads."""
    read = read_by(guard)
    reading = lambda: meaning_of(guard) if isinstance(guard, types.FunctionType | eqx.Module) else None
    meaning = remembered(guard, (first_guard_alike, read), reading)
    return _first_of(_guards, meaning, (guard, read), lambda first: read_by(first[0]) == first[1])


# What was met first, by what it means.
_systems, _guards = OrderedDict(), OrderedDict()
_one_thread = threading.Lock()


def _meaning_of_all(functions, names):
    meanings = [names]
    for function in functions:
        inner = getattr(function, "g", getattr(function, "phi", function))
        meaning = () if inner is None else meaning_of(inner) if isinstance(inner, types.FunctionType) else None
        if meaning is None:
            return None
        meanings.append((type(function).__name__, meaning))
    return tuple(meanings)


def _first_of(known, meaning, mine, is_still):
    if meaning is None:
        return mine
    first = known.get(meaning, mine)
    # What it reads may have changed since.
    if first is not mine and not is_still(first):
        first = mine
    with _one_thread:
        known[meaning] = first
        known.move_to_end(meaning)
        if len(known) > AT_MOST:
            known.popitem(last=False)
    return first


def read_by(function: Callable | None) -> Hashable:
    """The values that a function reads from outside, as something to compare; () where there are none."""
    reading = _Reading(whole=False)
    if isinstance(function, eqx.Module):
        # The arrays of a module are arguments of each program, and need no reading.
        inside = [x for x in jax.tree.leaves(function) if callable(x)]
        found = tuple(reading.function(f) for f in (inspect.unwrap(type(function).__call__), *inside))
    else:
        found = reading.function(function)
    return found if reading.changing else ()


def meaning_of(function: Callable) -> Hashable | None:
    """All that decides what a function computes, its code included, as something to compare by content.

    None where that cannot be told: of what is traced, random generators, open files, very large or foreign objects.
    What a function returns once and another time not, by the clock or by a file, is no meaning either.
    """
    reading = _Reading(whole=True)
    try:
        found = reading.function(function)
    except RecursionError:
        return None
    return found if reading.complete else None


class _Reading:
    """One reading. Afterwards: whether anything of it can change, and whether it is complete."""

    def __init__(self, whole: bool):
        self.whole, self.changing, self.complete = whole, False, True
        self._numbers, self._kept = {}, []

    def _again(self, value):
        """What stands for something met before; None the first time."""
        if id(value) in self._numbers:
            return ("again", self._numbers[id(value)])
        self._numbers[id(value)] = len(self._numbers)
        # Else another one could have its address.
        self._kept.append(value)
        if len(self._kept) > MOST:
            return self._unknown("...")
        return None

    def _unknown(self, *found):
        self.complete = False
        return found

    def function(self, function):
        """A function, or an object that can be called."""
        if function is None:
            return ()
        if isinstance(function, type):
            return self._class(function)
        if (again := self._again(function)) is not None:
            return again
        if isinstance(function, partial):
            return ("partial", *map(self.token, (function.func, function.args, function.keywords)))
        if isinstance(function, types.MethodType):
            return ("method", self.token(function.__func__), self.token(function.__self__))
        if isinstance(function, types.FunctionType):
            return self._plain(function)
        if isinstance(function, types.BuiltinFunctionType):
            return (function.__qualname__, self.token(function.__self__))
        return self._object(function, self._class(type(function)), True)

    def _plain(self, function):
        code = function.__code__
        digest, read = _of_code(code)
        found = [digest]
        if not _is_installed(code.co_filename):
            found += [self._global(function.__globals__, *names) for names in read]
        # A function that a library has made of another one has it in its closure.
        for cell in function.__closure__ or ():
            try:
                found.append(self.token(cell.cell_contents))
            except ValueError:  # Not assigned yet.
                found.append("not assigned")
        if not _is_installed(code.co_filename) or function.__closure__:
            own = {name: x for name, x in vars(function).items() if not name.startswith("__") or name == "__wrapped__"}
            found += [self.token(values) if values else () for values in
                      (function.__defaults__, function.__kwdefaults__, own)]  # fmt: skip
        return tuple(found)

    def _global(self, names, name, *attributes):
        if name in VARYING and name not in names:
            return self._unknown(name)
        value = names.get(name, MISSING)
        for attribute in attributes:
            if not isinstance(value, types.ModuleType):
                break
            if _varies(value):
                return self._unknown(value.__name__)
            inner = getattr(value, attribute, MISSING)
            if _is_library(value) and not isinstance(inner, types.ModuleType) and (callable(inner) or not self.whole):
                return (value.__name__, attribute)
            value = inner
        if value is not MISSING:
            return self.token(value)
        # One that is not there yet may come, and one that was there has gone.
        built_in = hasattr(builtins, name)
        self.changing |= not built_in
        return ("missing", built_in)

    def token(self, value, deep=True):
        """A value as something to compare."""
        if value is None:
            return None
        if isinstance(value, types.ModuleType):
            known = _is_library(value) and not _varies(value)
            return ("module", value.__name__) if known else self._unknown("module", value.__name__)
        if isinstance(value, FUNCTIONS):
            # It may be defined anew under its name.
            users = isinstance(value, types.FunctionType) and not _is_installed(value.__code__.co_filename)
            self.changing |= users
            return self.function(value)
        if isinstance(value, type):
            return self.function(value)
        kind = self._class(type(value))
        if isinstance(value, (int, str, bytes)):
            self.changing = True
            return (kind, value)
        if isinstance(value, (float, complex)):
            self.changing = True
            return (kind, repr(value))  # Not a number is not equal to itself.
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return (kind, *self._array(value))
        if (again := self._again(value)) is not None:
            return again
        if isinstance(value, (list, tuple, set, frozenset, Mapping)):
            self.changing = True
            if not deep or len(value) > (SHORT_IN_FULL if self.whole else SHORT):
                return self._unknown(kind, id(value), len(value))
            parts = value.items() if isinstance(value, Mapping) else value
            beside = [self.token(x) for x in (getattr(value, "__dict__", None),) if x]
            return (kind, *map(self.token, parts), *beside)
        return self._object(value, kind, deep)

    def _array(self, x):
        if isinstance(x, Tracer):
            return self._unknown("traced")
        self.changing = True
        found = (x.shape, str(x.dtype))
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x = jax.random.key_data(x)
        if x.dtype == object or isinstance(x, np.ma.MaskedArray) or not getattr(x, "is_fully_addressable", True):
            return self._unknown(*found, id(x))
        if x.nbytes <= (WHOLE_IN_FULL if self.whole else WHOLE):
            return (*found, hash(np.asarray(x).tobytes()))
        if isinstance(x, jax.Array):
            return self._unknown(*found, id(x))  # It cannot be changed, and the program that holds it keeps it.
        sample = x.reshape(-1)[:: x.size // SAMPLE] if x.flags.c_contiguous else x[:1]
        return self._unknown(*found, id(x), hash(sample.tobytes()))

    def _class(self, cls):
        named = (cls.__module__, cls.__qualname__)
        if _is_library(sys.modules.get(cls.__module__, MISSING)):
            return named
        if (again := self._again(cls)) is not None:
            return again
        self.changing = True
        found = []
        for name, value in vars(cls).items():
            if isinstance(value, (staticmethod, classmethod)):
                value = value.__func__
            elif isinstance(value, property):
                value = (value.fget, value.fset)
            elif isinstance(value, cached_property):
                value = value.func
            own = name.startswith("__") or name == "_abc_impl"
            if isinstance(value, types.FunctionType) or not (own or isinstance(value, OF_EACH_CLASS)):
                found.append((name, self.token(value)))
        return (*named, *map(self._class, cls.__bases__), *found)

    def _object(self, value, kind, deep):
        """Anything else, by its class and its attributes."""
        cls = type(value)
        if isinstance(value, eqx.Module):
            names = [field.name for field in dataclasses.fields(value)]
            return (kind, *((name, self.token(getattr(value, name, "missing"))) for name in names))
        library = _is_library(sys.modules.get(cls.__module__, MISSING)) and cls is not types.SimpleNamespace
        attributes = dict(getattr(value, "__dict__", {}))
        for base in cls.__mro__:
            slots = base.__dict__.get("__slots__", ())
            slots = (slots,) if isinstance(slots, str) else slots
            attributes |= {name: getattr(value, name) for name in slots if hasattr(value, name) and name[:2] != "__"}
        wrapped = attributes.get("__wrapped__")
        if wrapped is not None:
            # Of a rule for derivatives the functions; what begins with _ is for JAX alone.
            rest = {name: x for name, x in attributes.items() if name[:1] != "_"} if self.whole else {}
            return (kind, self.function(wrapped), *((name, self.token(x)) for name, x in rest.items()))
        if cls is object:
            return kind  # It stands for itself alone.
        if not self.whole and (not attributes or library or not deep):
            self.changing |= bool(attributes)
            return (kind, id(value)) if attributes else kind
        # What is written in C has more than its attributes.
        opaque = any(not base.__flags__ & OF_PYTHON for base in cls.__mro__[:-1]) and cls is not types.SimpleNamespace
        if library and (opaque or not attributes):
            return self._by_value(kind, value)
        self.changing = True
        self.complete &= not opaque
        return (kind, *((name, self.token(x, deep=self.whole)) for name, x in attributes.items()))

    def _by_value(self, kind, value):
        """What a library compares by value cannot change; what it compares by identity may."""
        if type(value).__hash__ in (None, object.__hash__):
            return self._unknown(kind, id(value))
        try:
            hash(value)
        except TypeError:
            return self._unknown(kind, id(value))
        return (kind, value)


# By code, which may be gone as its function is.
_OF_CODE = weakref.WeakKeyDictionary()


def _of_code(code):
    """(a digest of what a function does, the globals that it and those written inside it read).

    A global comes with the attributes that are asked of it. Not the hash of a code, to which -1 and -2 are the same.
    """
    if (known := _OF_CODE.get(code)) is not None:
        return known
    read, reading, constants = {}, None, []
    for instruction in dis.get_instructions(code):
        if reading and instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            reading = (*reading, instruction.argval)
            continue
        if reading:
            read[reading], reading = None, None
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
            reading = (instruction.argval,)
        elif instruction.opname == "IMPORT_NAME":
            read["__import__",] = None
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            digest, inside = _of_code(constant)
            constants.append(digest)
            read.update(dict.fromkeys(inside))
        else:
            constants.append(repr(constant))
    parts = (code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars,
             code.co_argcount, code.co_kwonlyargcount, code.co_flags, code.co_exceptiontable)  # fmt: skip
    found = hashlib.sha256(repr(parts).encode()).hexdigest()[:32], tuple(read)
    _OF_CODE[code] = found
    return found


def _varies(module):
    return any(f"{module.__name__}.".startswith(f"{name}.") for name in VARYING_MODULES)


@lru_cache(maxsize=4096)
def _is_installed(filename):
    return filename.startswith((*INSTALLED, OWN)) or "site-packages" in filename


def _is_library(module):
    if module is MISSING or module.__name__ == "__main__":
        return False
    return _is_installed(getattr(module, "__file__", None) or sys.prefix + "site-packages")
