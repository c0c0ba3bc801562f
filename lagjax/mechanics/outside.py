"""What the user's functions read from outside: globals, closed-over values, defaults, the attributes of objects.

A compiled program holds the values that these had when it was traced. So each public call reads them again, and a
change makes another `System`, which is traced again. The reading follows a function into those that it calls, but not
into installed packages, whose globals are constants, and a class into its methods. Values that JAX is tracing are left
to `closures.py`.

There are two ways of reading. `read_by` is fast, since every call uses it: arrays of more than `WHOLE` bytes are
compared by identity and a sample, objects by their attributes one level deep. `meaning_of` compares everything by
content, so that two functions that do the same have the same meaning, or says that it cannot.
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

# Arrays of up to so many bytes are compared whole (10 microseconds), larger ones by a sample of so many entries.
WHOLE, SAMPLE = 2**14, 256
# Lists and dictionaries of up to so many entries are read.
SHORT = 64
# The same limits where everything is compared, and the most objects that are read.
WHOLE_IN_FULL, SHORT_IN_FULL, MOST = 2**26, 2**13, 2**14
MISSING = object()
INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
LAGJAX = __file__.rsplit("mechanics", 1)[0]
# Modules and functions that may return another value each time.
VARYING_MODULES = ("datetime", "importlib", "io", "numpy.random", "os", "random", "secrets", "time")
VARYING = {"open", "input", "eval", "exec", "globals", "locals", "vars", "__import__"}
FUNCTIONS = (types.FunctionType, types.MethodType, types.BuiltinFunctionType, partial)
# The flag of a class made by Python code, or created at run time like one (Py_TPFLAGS_HEAPTYPE).
HEAP_TYPE = 1 << 9
# Descriptors that Python itself puts into a class.
AUTOMATIC_DESCRIPTORS = (types.MemberDescriptorType, types.GetSetDescriptorType, types.WrapperDescriptorType)


def up_to_date(system: System) -> System:
    """The system with the values that its functions read from outside now; the same object if they read none."""
    functions = [system.lagrangian, system.force, system.dissipation]
    functions += [c.g if isinstance(c, Holonomic) else c.phi for c in system.constraints.values()]
    found = tuple(read_by(function) for function in functions)
    return system.reading(found) if any(found) else system


def first_alike(system: System, now: System) -> System:
    """The first system with the meaning of `system`, whose present form is `now`: its programs may be compiled already.

    Running a notebook cell again makes new functions that do the same.
    """
    of = (now.lagrangian, now.force, now.dissipation, *now.constraints.values())
    meaning = remembered(system, (first_alike, now.read), lambda: _meaning_of_all(of, tuple(now.constraints)))
    return _first_of(_systems, meaning, now, lambda first: up_to_date(first).read == first.read)


def first_guard_alike(guard: Callable) -> tuple[Callable, Hashable]:
    """The first function or callable module with the meaning of `guard`, and what it reads."""
    read = read_by(guard)
    reading = lambda: meaning_of(guard) if isinstance(guard, types.FunctionType | eqx.Module) else None
    meaning = remembered(guard, (first_guard_alike, read), reading)
    return _first_of(_guards, meaning, (guard, read), lambda first: read_by(first[0]) == first[1])


# The first system and the first guard of each meaning.
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


def _first_of(known, meaning, present, is_unchanged):
    if meaning is None:
        return present
    first = known.get(meaning, present)
    # What the first one reads may have changed since.
    if first is not present and not is_unchanged(first):
        first = present
    with _one_thread:
        known[meaning] = first
        known.move_to_end(meaning)
        if len(known) > AT_MOST:
            known.popitem(last=False)
    return first


def read_by(function: Callable | None) -> Hashable:
    """The values that a function reads from outside, in a form to compare; () if there are none."""
    reading = _Reading(whole=False)
    if isinstance(function, eqx.Module):
        # The arrays of a module are arguments of each program, and need no reading.
        inside = [x for x in jax.tree.leaves(function) if callable(x)]
        found = tuple(reading.function(f) for f in (inspect.unwrap(type(function).__call__), *inside))
    else:
        found = reading.function(function)
    return found if reading.changing else ()


def meaning_of(function: Callable) -> Hashable | None:
    """Everything that decides what a function computes, its code included, in a form to compare by content.

    None if that cannot be determined: for traced values, random generators, open files, very large or foreign objects,
    and for functions whose result varies from call to call, with the clock or a file.
    """
    reading = _Reading(whole=True)
    try:
        found = reading.function(function)
    except RecursionError:
        return None
    return found if reading.complete else None


class _Reading:
    """One reading. Afterwards `changing` says whether anything read can change, `complete` whether all was read."""

    def __init__(self, whole: bool):
        self.whole, self.changing, self.complete = whole, False, True
        self._numbers, self._kept = {}, []

    def _back_reference(self, value):
        """A reference to an object met before; None the first time."""
        if id(value) in self._numbers:
            return ("again", self._numbers[id(value)])
        self._numbers[id(value)] = len(self._numbers)
        # Kept alive: another object could get its address otherwise.
        self._kept.append(value)
        if len(self._kept) > MOST:
            return self._unknown("...")
        return None

    def _unknown(self, *found):
        self.complete = False
        return found

    def function(self, function):
        """Read a function or a callable object."""
        if function is None:
            return ()
        if isinstance(function, type):
            return self._class(function)
        if (reference := self._back_reference(function)) is not None:
            return reference
        if isinstance(function, partial):
            return ("partial", *map(self.token, (function.func, function.args, function.keywords)))
        if isinstance(function, types.MethodType):
            return ("method", self.token(function.__func__), self.token(function.__self__))
        if isinstance(function, types.FunctionType):
            return self._python_function(function)
        if isinstance(function, types.BuiltinFunctionType):
            return (function.__qualname__, self.token(function.__self__))
        return self._object(function, self._class(type(function)), True)

    def _python_function(self, function):
        code = function.__code__
        digest, read = _digest_and_globals(code)
        found = [digest]
        if not _is_installed(code.co_filename):
            found += [self._global(function.__globals__, *names) for names in read]
        # A function that a library made from another one holds that one in its closure.
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
        # A missing global may be defined later, or may have been deleted.
        built_in = hasattr(builtins, name)
        self.changing |= not built_in
        return ("missing", built_in)

    def token(self, value, deep=True):
        """A value in a form to compare."""
        if value is None:
            return None
        if isinstance(value, types.ModuleType):
            known = _is_library(value) and not _varies(value)
            return ("module", value.__name__) if known else self._unknown("module", value.__name__)
        if isinstance(value, FUNCTIONS):
            # The user may define another function under its name.
            is_users = isinstance(value, types.FunctionType) and not _is_installed(value.__code__.co_filename)
            self.changing |= is_users
            return self.function(value)
        if isinstance(value, type):
            return self.function(value)
        kind = self._class(type(value))
        if isinstance(value, (int, str, bytes)):
            self.changing = True
            return (kind, value)
        if isinstance(value, (float, complex)):
            self.changing = True
            return (kind, repr(value))  # NaN is not equal to itself.
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return (kind, *self._array(value))
        if (reference := self._back_reference(value)) is not None:
            return reference
        if isinstance(value, (list, tuple, set, frozenset, Mapping)):
            self.changing = True
            if not deep or len(value) > (SHORT_IN_FULL if self.whole else SHORT):
                return self._unknown(kind, id(value), len(value))
            parts = value.items() if isinstance(value, Mapping) else value
            attributes = [self.token(x) for x in (getattr(value, "__dict__", None),) if x]
            return (kind, *map(self.token, parts), *attributes)
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
            return self._unknown(*found, id(x))  # It cannot change, and the program that holds it keeps it alive.
        sample = x.reshape(-1)[:: x.size // SAMPLE] if x.flags.c_contiguous else x[:1]
        return self._unknown(*found, id(x), hash(sample.tobytes()))

    def _class(self, cls):
        named = (cls.__module__, cls.__qualname__)
        if _is_library(sys.modules.get(cls.__module__, MISSING)):
            return named
        if (reference := self._back_reference(cls)) is not None:
            return reference
        self.changing = True
        found = []
        for name, value in vars(cls).items():
            if isinstance(value, (staticmethod, classmethod)):
                value = value.__func__
            elif isinstance(value, property):
                value = (value.fget, value.fset)
            elif isinstance(value, cached_property):
                value = value.func
            automatic = name.startswith("__") or name == "_abc_impl"
            if isinstance(value, types.FunctionType) or not (automatic or isinstance(value, AUTOMATIC_DESCRIPTORS)):
                found.append((name, self.token(value)))
        return (*named, *map(self._class, cls.__bases__), *found)

    def _object(self, value, kind, deep):
        """Read any other object by its class and attributes."""
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
            # A function with a rule for derivatives: read its functions; names that begin with _ are internal to JAX.
            rest = {name: x for name, x in attributes.items() if name[:1] != "_"} if self.whole else {}
            return (kind, self.function(wrapped), *((name, self.token(x)) for name, x in rest.items()))
        if cls is object:
            return kind  # A bare object() has no content.
        if not self.whole and (not attributes or library or not deep):
            self.changing |= bool(attributes)
            return (kind, id(value)) if attributes else kind
        # An object of a class written in C has more content than its attributes.
        opaque = any(not base.__flags__ & HEAP_TYPE for base in cls.__mro__[:-1]) and cls is not types.SimpleNamespace
        if library and (opaque or not attributes):
            return self._by_value(kind, value)
        self.changing = True
        self.complete &= not opaque
        return (kind, *((name, self.token(x, deep=self.whole)) for name, x in attributes.items()))

    def _by_value(self, kind, value):
        """Read an object of a library: one that it compares by value cannot change, one compared by identity may."""
        if type(value).__hash__ in (None, object.__hash__):
            return self._unknown(kind, id(value))
        try:
            hash(value)
        except TypeError:
            return self._unknown(kind, id(value))
        return (kind, value)


# By code object; weak, since the code goes with its function.
_DIGESTS = weakref.WeakKeyDictionary()


def _digest_and_globals(code):
    """Return a digest of a function's code, and the globals that it and the functions inside it read.

    A global comes with the attributes looked up on it. The hash of a code object does not tell -1 from -2.
    """
    if (known := _DIGESTS.get(code)) is not None:
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
            digest, inside = _digest_and_globals(constant)
            constants.append(digest)
            read.update(dict.fromkeys(inside))
        else:
            constants.append(repr(constant))
    parts = (code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars,
             code.co_argcount, code.co_kwonlyargcount, code.co_flags, code.co_exceptiontable)  # fmt: skip
    found = hashlib.sha256(repr(parts).encode()).hexdigest()[:32], tuple(read)
    _DIGESTS[code] = found
    return found


def _varies(module):
    return any(f"{module.__name__}.".startswith(f"{name}.") for name in VARYING_MODULES)


@lru_cache(maxsize=4096)
def _is_installed(filename):
    return filename.startswith((*INSTALLED, LAGJAX)) or "site-packages" in filename


def _is_library(module):
    if module is MISSING or module.__name__ == "__main__":
        return False
    return _is_installed(getattr(module, "__file__", None) or sys.prefix + "site-packages")
