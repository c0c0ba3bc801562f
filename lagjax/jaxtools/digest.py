"""A digest of what a program means, by which another process finds it again.

Python objects are written as bytes from which they could be told apart: each with its kind, and containers with their
lengths, so that two different things are never written alike. No pickle, no `repr` and no addresses. A class or a
function of a library counts by its name, since versions and the source of lagjax are in each digest; an object of one
by its fields; a user's function by its jaxpr (`Meaning`). What cannot be written so, as a Python function that a
program calls while it runs, raises `NotKept`: its program belongs to this process alone.

A user's own class counts by its name and its fields where it holds numbers in a state or in parameters: JAX takes it
apart and puts it together, and what its methods compute is in jaxprs. Anywhere else it raises `NotKept`.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib
import os
import platform
import struct
import sys
import types
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import diffrax
import equinox
import jax
import jax.extend.core.primitives as of_jax
import jax.tree_util as jtu
import jaxlib.version
import lineax
import numpy as np
import optimistix
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive

from lagjax.jaxtools.cache import HashablePart, once
from lagjax.jaxtools.jaxpr import Meaning, content_of
from lagjax.jaxtools.primitives import LapackCall
from lagjax.jaxtools.tracing import is_plain

try:
    # Private to JAX: all that tracing depends on here and now, contexts included.
    from jax._src.config import trace_context
except ImportError:
    trace_context = None

# Classes and functions of these count by their names.
LIBRARIES = {
    "builtins", "collections", "diffrax", "enum", "equinox", "functools", "jax", "jaxlib", "jaxtyping", "lagjax",
    "lineax", "math", "ml_dtypes", "numpy", "operator", "optimistix",
}  # fmt: skip
# JAX's settings that change no program: where it looks, what it prints, what it refuses.
HARMLESS = (
    "jax_compilation_cache", "jax_persistent_cache", "jax_enable_compilation_cache", "jax_log_", "jax_logging",
    "jax_explain_", "jax_traceback_", "jax_tracer_", "jax_transfer_guard", "jax_debug_log", "jax_pprint",
    "jax_compiler_detailed", "jax_raise_persistent", "jax_include_full", "jax_source_url", "jax_hlo_source",
    "jax_send_traceback", "jax_captured_constants_warn", "jax_dump_ir",
)  # fmt: skip
# Of the environment, what these read when they trace and compile.
READ = "XLA_", "LIBTPU_", "EQX_", "LAGJAX_", "TF_XLA", "TF_CPU", "TF_CUDNN", "TF_DETERMINISTIC", "NVIDIA_", "CUDA_"
NOT_READ = {"LAGJAX_CACHE", "XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_PYTHON_CLIENT_MEM_FRACTION"}


class NotKept(Exception):
    """A program that cannot be kept; says why."""


def digest_of(parts: Iterable[tuple[Any, bool]], around: bytes | None = None) -> str:
    """The digest of some things, each with whether it may hold numbers in classes of the user's own.

    `around`: the digest of surroundings that was made outside of JAX's contexts, for something inside them.

    **Raises:** `NotKept`.
    """
    writer = _Writer()
    if around is None:
        writer.add(b"surroundings", surroundings())
    else:
        writer.add(b"around", around)
        writer.all(b"context", filter(_can_be_written, _context()))
    try:
        for part, of_user in parts:
            writer.of_user = of_user
            writer.write(part)
    except RecursionError:
        raise NotKept("it is nested too deeply") from None
    return writer.hash.hexdigest()


class _Writer:
    """Writes things into a hash."""

    def __init__(self):
        self.hash, self.of_user = hashlib.sha256(), False

    def add(self, kind: bytes, content: bytes = b"") -> None:
        """A kind and its content, each with its length in front."""
        self.hash.update(struct.pack("<BQ", len(kind), len(content)) + kind + content)

    def all(self, kind: bytes, items: Iterable) -> None:
        """Several things of one whole."""
        items = tuple(items)
        self.add(kind, struct.pack("<Q", len(items)))
        for x in items:
            self.write(x)

    def write(self, x: Any) -> None:
        """Anything at all, or `NotKept`."""
        write = WRITERS.get(type(x))
        if write is None:
            self._object(x)
        else:
            write(self, x)

    def _object(self, x: Any) -> None:
        meaning = getattr(x, "meaning", None)
        if isinstance(x, Meaning):
            self.add(b"meaning", _of_meaning(x))
        elif isinstance(meaning, Meaning):
            self.add(b"program", _of_meaning(meaning))
        elif isinstance(x, Tracer):
            raise NotKept("it depends on what JAX is tracing")
        elif isinstance(x, jtu.PyTreeDef):
            self._structure(x)
        elif isinstance(x, HashablePart):
            self._structure(x.structure)
            self.all(b"leaves", x.leaves)
        elif isinstance(x, (jax.Array, np.ndarray, np.generic)):
            self.all(b"numbers", (str(x.dtype), getattr(x, "weak_type", False), content_of(x)))
        elif isinstance(x, np.dtype):
            if x.hasobject or x.fields is not None:
                raise NotKept(f"an array of {x}")
            self.add(b"dtype", f"{x.name} {x.str}".encode())
        elif isinstance(x, ShapedArray):
            # Nothing but these: no mesh of devices.
            if type(x) is not ShapedArray or x != ShapedArray(x.shape, x.dtype, weak_type=x.weak_type):
                raise NotKept("it is for several devices")
            self.all(b"aval", (x.shape, x.dtype, x.weak_type))
        elif isinstance(x, jax.ShapeDtypeStruct):
            if x.sharding is not None:
                raise NotKept("it is for several devices")
            self.all(b"shape", (x.shape, x.dtype, bool(x.weak_type)))
        elif isinstance(x, (jax.sharding.Mesh, jax.sharding.AbstractMesh)):
            if not x.empty:
                raise NotKept("it is for several devices")
            self.all(b"no mesh", (type(x),))
        elif isinstance(x, jax.sharding.NamedSharding):
            self.all(b"sharding", (x.mesh, tuple(x.spec), x.memory_kind))
        elif isinstance(x, LapackCall):
            self.all(b"call", (x.primitive, *sorted(x.params.items())))
        elif isinstance(x, Primitive):
            self.add(b"primitive", _name_of_primitive(x).encode())
        elif isinstance(x, enum.Enum):
            self.all(b"enum", (type(x), x.name))
        elif isinstance(x, functools.partial):
            self.all(b"partial", (x.func, x.args, x.keywords))
        elif name_in_library(type(x)) == "jax._src.util:HashablePartial":
            # In what `ravel_pytree` returns.
            self.all(b"partial", (x.f, x.args, x.kwargs))
        elif type(x).__module__ == "jax._src.flattree":
            # In the loops of jax 0.11 and later.
            self.all(b"flat tree", (*self._named(type(x)), *sorted(vars(x).items())))
        elif (name := name_in_library(x)) is not None:
            self.add(b"library", name.encode())
        elif isinstance(x, types.FunctionType):
            self._function(x)
        elif isinstance(x, types.MethodType):
            self.all(b"method", (x.__self__, x.__func__))
        elif not isinstance(x, type):
            self._of_fields(x)
        else:
            raise NotKept(f"class {x.__module__}.{x.__qualname__}")

    def _of_fields(self, x: Any) -> None:
        cls = type(x)
        if not self._may_hold(cls):
            raise NotKept(f"a {cls.__module__}.{cls.__qualname__}")
        if isinstance(x, tuple) and hasattr(cls, "_fields"):
            self.all(b"named tuple", (*self._named(cls), *x))
        elif dataclasses.is_dataclass(x):
            fields = [f.name for f in dataclasses.fields(x) if hasattr(x, f.name)]
            self.all(b"object", (*self._named(cls), tuple(fields), *(getattr(x, name) for name in fields)))
        elif _is_bare(x):
            self.all(b"bare", self._named(cls))
        else:
            raise NotKept(f"a {cls.__module__}.{cls.__qualname__}")

    def _structure(self, x: Any) -> None:
        data, children = x.node_data(), x.children()
        if data is None:
            self.add(b"leaf", struct.pack("<Q", x.num_leaves))
            return
        cls, own = data
        if not self._may_hold(cls):
            raise NotKept(f"class {cls.__module__}.{cls.__qualname__}")
        self.add(b"node", struct.pack("<Q", len(children)))
        for part in (*self._named(cls), own):
            self.write(part)
        for child in children:
            self._structure(child)

    def _may_hold(self, cls: type) -> bool:
        return self.of_user or name_in_library(cls) is not None

    def _named(self, cls: type) -> tuple:
        """A class by its name, and by the names of its fields where it is the user's."""
        name = name_in_library(cls)
        if name is not None:
            return (name,)
        fields = [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else ()
        return "of the user", cls.__module__, cls.__qualname__, tuple(getattr(cls, "_fields", fields))

    def _function(self, x: types.FunctionType) -> None:
        """A function that a library's function makes: by its place there, and what it holds."""
        of = sys.modules.get(x.__globals__.get("__name__", ""))
        name = getattr(of, "__name__", "")
        if name.partition(".")[0] not in LIBRARIES or vars(of) is not x.__globals__:
            raise NotKept(f"the function {x.__qualname__}")
        code, cells = x.__code__, [cell.cell_contents for cell in x.__closure__ or ()]
        place = name, code.co_qualname, code.co_firstlineno, code.co_code
        self.all(b"function", (*place, tuple(cells), x.__defaults__, x.__kwdefaults__, vars(x)))


def _of_dict(writer: _Writer, x: dict) -> None:
    writer.all(b"dict", (part for item in x.items() for part in item))


def _of_set(writer: _Writer, x: frozenset | set) -> None:
    found = []
    for part in x:
        one = _Writer()
        one.of_user = writer.of_user
        one.write(part)
        found.append(one.hash.digest())
    writer.all(b"set", sorted(found))


WRITERS: dict[type, Callable[[_Writer, Any], None]] = {
    type(None): lambda w, x: w.add(b"none"),
    type(...): lambda w, x: w.add(b"..."),
    bool: lambda w, x: w.add(b"bool", b"1" if x else b"0"),
    int: lambda w, x: w.add(b"int", str(x).encode()),
    float: lambda w, x: w.add(b"float", struct.pack("<d", x)),
    complex: lambda w, x: w.add(b"complex", struct.pack("<dd", x.real, x.imag)),
    str: lambda w, x: w.add(b"str", x.encode("utf-8", "surrogatepass")),
    bytes: lambda w, x: w.add(b"bytes", x),
    tuple: lambda w, x: w.all(b"tuple", x),
    list: lambda w, x: w.all(b"list", x),
    slice: lambda w, x: w.all(b"slice", (x.start, x.stop, x.step)),
    range: lambda w, x: w.all(b"range", (x.start, x.stop, x.step)),
    dict: _of_dict,
    types.MappingProxyType: _of_dict,
    set: _of_set,
    frozenset: _of_set,
}


def _of_meaning(x: Meaning) -> bytes:
    """The digest of a meaning, found once: the programs inside of others are often the same."""
    if x.digest is None:
        writer = _Writer()
        writer.of_user = True
        writer.write(x.parts)
        x.digest = writer.hash.digest()
    return x.digest


def name_in_library(x: Any) -> str | None:
    """The name under which a library has this very object, a class or a function; None if none has."""
    if x is types.NoneType:
        return "types:NoneType"
    module, name = getattr(x, "__module__", None), getattr(x, "__qualname__", None)
    if isinstance(x, types.BuiltinFunctionType) and module is None:
        module = getattr(x.__self__, "__name__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module.partition(".")[0] not in LIBRARIES:
        return None
    place = f"{module}:{name}"
    found: Any = _at(place)
    if found is x:
        return place
    # The function under its decorators.
    return f"{place}:wrapped" if getattr(found, "__wrapped__", None) is x else None


def named_in_library(name: str) -> Any:
    """What a library has under this name, of those that `name_in_library` gives."""
    module, _, _ = name.partition(":")
    if module.partition(".")[0] not in LIBRARIES:
        raise LookupError(name)
    importlib.import_module(module)
    return _at(name)


def _at(name: str) -> Any:
    module, path = name.split(":")[:2]
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    return found


def _is_bare(x: Any) -> bool:
    """Whether an object of a Python class holds nothing, as a marker."""
    classes = [cls for cls in type(x).__mro__ if cls is not object]
    files = [getattr(sys.modules.get(cls.__module__), "__file__", None) or "" for cls in classes]
    empty = not getattr(x, "__dict__", True) and all(not vars(cls).get("__slots__") for cls in classes)
    return empty and all(file.endswith(".py") for file in files)


@once
def _name_of_primitive(primitive: Primitive) -> str:
    """The name of a primitive where a library has it."""
    for name, x in vars(of_jax).items():
        if x is primitive:
            return name
    for name, module in sorted(sys.modules.items()):
        if name.partition(".")[0] in LIBRARIES - {"numpy", "builtins"}:
            for own, x in vars(module).items():
                if x is primitive:
                    return f"{name}:{own}"
    raise NotKept(f"the primitive {primitive.name}")


def surroundings() -> bytes:
    """The digest of what tracing and compiling depend on besides the program itself: here and now."""
    writer = _Writer()
    config: Any = jax.config
    # A new thread is in no context. Those of whoever made one come last, in the order of imports.
    with ThreadPoolExecutor(1) as thread:
        here, outside = _context(), thread.submit(_context).result()
    written = [_can_be_written(x) for x in here]
    if len(here) != len(outside) or not all(x is y or known for x, y, known in zip(here, outside, written)):
        raise NotKept("it is in a context of JAX's")
    writer.all(b"context", [x for x, known in zip(here, written) if known])
    settings = {name: x for name, x in sorted(config.values.items()) if not name.startswith(HARMLESS)}
    if settings.get("jax_default_device") is not None:
        raise NotKept("jax_default_device is set")
    writer.write(settings)
    environment = {x: os.environ[x] for x in sorted(os.environ) if x.startswith(READ) and x not in NOT_READ}
    writer.write((environment, [x for x in sys.argv if x.startswith("--xla")]))
    writer.write((is_plain(), versions(), source(), machine(), *devices()))
    return writer.hash.digest()


def _context() -> tuple:
    if trace_context is None:
        raise NotKept("this JAX does not say what tracing depends on")
    return trace_context()


def _can_be_written(x: Any) -> bool:
    return type(x) in WRITERS or isinstance(x, enum.Enum)


@functools.cache
def versions() -> dict[str, str]:
    """The versions of all that traces and compiles."""
    modules = diffrax, equinox, jax, jaxlib.version, lineax, np, optimistix
    return {"python": sys.version, **{x.__name__: x.__version__ for x in modules}}


@functools.cache
def source() -> str:
    """The digest of lagjax's own source: of what is there, not of what it says of itself."""
    root, found = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content = path.read_bytes()
        found.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return found.hexdigest()


@functools.cache
def machine() -> tuple[str, ...]:
    """The processor with its features, by which XLA compiles; where they cannot be read, this one machine."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    known = platform.system(), platform.machine(), str(usable)
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return *known, platform.processor(), platform.node(), platform.version()
    # Of x86 and of ARM; "cpu MHz" and the like change.
    names = "vendor_id", "cpu family", "model", "model name", "stepping", "flags", "Features", "CPU"
    told = [line for line in lines if line.split(":")[0].strip().startswith(names) and "MHz" not in line]
    return (*known, *told) if told else (*known, platform.processor(), platform.node(), platform.version())


def devices() -> tuple[str, ...]:
    """The kinds of devices, and what drives them."""
    found = jax.devices()
    client: Any = found[0].client
    return client.platform, str(client.platform_version), *(x.device_kind for x in found)
