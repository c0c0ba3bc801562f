"""lagjax's files: NumPy npz files whose first entry says in JSON what the arrays are, and the trees that they are in.

The zip format gives each entry a checksum. A file is written under a temporary name in the same folder, and then
renamed: if the process is killed, the previous file remains. `numpy.load(path)` reads the arrays without lagjax.

A file that is read may come from anyone. Its entries are not compressed, and each array fills its entry and is read
once: so reading takes as much memory as the file has bytes, besides one array at a time.

**Trees**: a structure that JSON can hold, and arrays by name; no pickle, and no functions. Numbers, text, dicts, lists,
tuples and named tuples are written as they are, dataclass objects (equinox modules among them) as the name of their
class and the values of their fields. Classes and functions are those of a closed table (`file_table`) and the user's
classes that he passes again. Reading imports nothing and calls nothing that a file names.
"""

import dataclasses
import inspect
import json
import math
import os
import types
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from tokenize import TokenError
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.display import by_line, is_plain, printable
from lagjax.files.table import Table, check_field, fields_of, listed, name_of_function
from lagjax.jaxtools import to_jax, without_init
from lagjax.numerics import tolerance_of_the_controller

# Structures are nested no deeper than this.
DEEPEST = 100
# Arrays hold truth values, numbers and text.
KINDS_OF_ARRAY = "biufcSU"
# Types of numbers for which NumPy's files have no name, and the kinds of JAX's random keys.
_SMALL = "bfloat16 float8_e4m3fn float8_e5m2 float8_e4m3b11fnuz float8_e4m3fnuz float8_e5m2fnuz int4 uint4"
SMALL_NUMBERS = {name: jnp.dtype(getattr(jnp, name)) for name in _SMALL.split() if hasattr(jnp, name)}
RANDOM_KEYS = ("threefry2x32", "rbg", "unsafe_rbg")
# What the nodes of a written tree consist of, by their first entry.
NODES = {
    "float": {"float"},
    "complex": {"complex"},
    "tolerance": {"tolerance"},
    "given": {"given"},
    "array": {"array", "of", "dtype"},
    "key": {"key", "impl"},
    "dict": {"dict"},
    "list": {"list"},
    "tuple": {"tuple"},
    "namedtuple": {"namedtuple", "fields"},
    "object": {"object", "fields"},
    "function": {"function"},
}


class NotWritable(TypeError):
    """A value that is not data, and cannot be written down."""


class NotGiven:
    """A placeholder for a function that is not in a file and was not given again."""

    def __init__(self, role: str):
        self.role = role

    def __repr__(self):
        return f"{self.role}, not given"

    def __eq__(self, other):
        return isinstance(other, NotGiven) and self.role == other.role

    def __hash__(self):
        return hash(self.role)

    def __call__(self, *args, **kwargs):
        raise ValueError(
            f"this needs {self.role}, a function, which a file does not contain.\n"
            f"Fix: lj.load_fit(path, system, {self.role}=...)."
        )


class Writer:
    """Writes trees down; `arrays` are the arrays of everything written, by name, `classes` those of the objects.

    `given(value)`: the role of a value that is not written but given again by the user, or None.
    """

    def __init__(self, given: Callable[[Any], str | None] = lambda value: None):
        self.arrays: dict[str, np.ndarray] = {}
        self.classes: list[type] = []
        self._given = given
        self._taken: set[str] = set()

    def down(self, value, path: str, depth: int = 0):
        """A value in a form for JSON; `path` is how the user would write it."""
        if depth > DEEPEST:
            raise NotWritable(f"{path[:80]}... is nested deeper than {DEEPEST} levels.\nFix: a flatter structure.")

        def inside(x: Any, name: str):
            return self.down(x, name, depth + 1)

        if isinstance(value, str) and not is_plain(value):
            raise NotWritable(f"{printable(path)} is text with control characters.\nFix: leave them out.")
        if value is None or isinstance(value, (bool, str)) or type(value) is int:
            return value
        if type(value) is float:
            return {"float": value.hex() if math.isfinite(value) else repr(value)}
        if type(value) is complex:
            return {"complex": [inside(value.real, path), inside(value.imag, path)]}
        if value is tolerance_of_the_controller():
            return {"tolerance": "of the controller"}
        if (role := self._given(value)) is not None:
            return {"given": role}
        if isinstance(value, (jax.Array, np.ndarray, np.generic)):
            return self._array(value, path)
        if type(value) is dict:
            return {"dict": [[self._key(k, path), inside(x, _under(path, k))] for k, x in value.items()]}
        if type(value) in (list, tuple):
            return {type(value).__name__: [inside(x, f"{path}[{i}]") for i, x in enumerate(value)]}
        if (function := name_of_function(value)) is not None:
            return {"function": function}
        if not isinstance(value, type) and (fields := fields_of(type(value))) is not None:
            return self._object(value, fields, path, inside)
        if any(cls.__module__.split(".")[0] == "flax" for cls in inspect.getmro(type(value))):
            raise NotWritable(
                f"{path} is a {type(value).__name__} of flax, and files do not hold flax's objects.\n"
                "Fix: graphdef, state = nnx.split(model); nnx.to_pure_dict(state) in params, dictionaries of arrays; "
                "nnx.merge(graphdef, ...) of them in the Lagrangian."
            )
        if ".pace" in path and callable(value):
            raise NotWritable(
                f"{path.split('.pace')[0]} has a pace, which is a function, and functions are not data.\n"
                "Fix: np.savez of traj.t, traj.q and traj.v."
            )
        if isinstance(value, types.FunctionType) or callable(value):
            raise NotWritable(
                f"{path} is a function ({getattr(value, '__name__', type(value).__name__)}), and functions are not "
                "data.\nUsual cause: a function in params.\n"
                "Fix: write it into the Lagrangian, and leave its numbers in params."
            )
        raise NotWritable(
            f"{path} is a {type(value).__name__}, which cannot be written down.\n"
            "Fix: use numbers, arrays, text, dicts, lists, tuples, named tuples and dataclasses of these."
        )

    def _object(self, value, fields, path, inside):
        cls = type(value)
        of_table = listed(cls.__module__, cls.__qualname__)
        if of_table is not None:
            # A field that another version of a package has added is left out, if it is as by default.
            added = set(fields) - set(of_table[1])
            if of_table[0] is not cls or any(getattr(value, name) is not getattr(cls, name, 0) for name in added):
                raise NotWritable(f"{path} is a {cls.__module__}.{cls.__qualname__}, which files do not hold.")
            fields = of_table[1]
        parts = {name: inside(getattr(value, name), _under(path, name)) for name in fields if hasattr(value, name)}
        self.classes.append(cls)
        kind = "namedtuple" if issubclass(cls, tuple) else "object"
        return {kind: {"module": cls.__module__, "name": cls.__qualname__}, "fields": parts}

    def _key(self, key, path):
        if not isinstance(key, (str, int, float, bool)) and key is not None:
            raise NotWritable(f"a key of {path} is a {type(key).__name__}.\nFix: names or numbers as keys.")
        return self.down(key, path)

    def _array(self, value, path):
        name = self._free(path)
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            self.arrays[name] = np.asarray(jax.random.key_data(value))
            return {"key": name, "impl": str(jax.random.key_impl(value))}
        x = np.asarray(value)
        of = "jax" if isinstance(value, jax.Array) else "numpy" if isinstance(value, np.ndarray) else "number"
        node = {"array": name, "of": of}
        if x.dtype.name in SMALL_NUMBERS:
            node["dtype"] = x.dtype.name
            x = x.view(f"u{x.dtype.itemsize}")
        if x.dtype.kind not in KINDS_OF_ARRAY:
            what = "Python objects" if x.dtype == object else str(x.dtype)
            raise NotWritable(f"{path} is an array of {what}.\nFix: an array of numbers.")
        self.arrays[name] = x
        return node

    def _free(self, path):
        wanted = "".join(c if c.isalnum() or c in "._-[]" else "_" for c in path) or "value"
        name, number = wanted, 1
        # Names must differ by more than case: somebody may unpack the file on a file system that ignores it.
        while name.lower() in self._taken:
            name, number = f"{wanted}.{number}", number + 1
        self._taken.add(name.lower())
        return name


class Reader:
    """Reads trees; each array is read once, by `array(name)`.

    `given(role)` returns the user's value for one that was not written; `table`: what the tree may name.
    """

    def __init__(
        self,
        array: Callable[[str], np.ndarray],
        given: Callable[[str], Any] | None = None,
        table: Table | None = None,
    ):
        self.array, self.given, self._table = array, given, table or Table()

    def up(self, node, depth: int = 0) -> Any:
        """The value that a node stands for.

        **Raises:** `ValueError`, and what Python raises for a node that is not as `Writer` makes it.
        """
        if isinstance(node, str) and not is_plain(node):
            raise ValueError(f"it holds text with control characters, {printable(node)[:80]!r}.")
        if node is None or isinstance(node, (bool, int, str)):
            return node
        kind = next(iter(node))
        if not node.keys() <= NODES[kind]:
            raise ValueError(f"a node of kind '{kind}' has entries that are not known.")
        if depth > DEEPEST:
            raise ValueError(f"it is nested deeper than {DEEPEST} levels.")

        def inside(x: Any):
            return self.up(x, depth + 1)

        if kind == "float":
            text = node["float"]
            return float.fromhex(text) if "x" in text else float(text)
        if kind == "complex":
            real, imaginary = map(inside, node["complex"])
            return complex(real, imaginary)
        if kind == "tolerance":
            return tolerance_of_the_controller()
        if kind == "given" and self.given is not None:
            return self.given(node["given"])
        if kind == "array":
            return self._array(node)
        if kind == "key" and node["impl"] in RANDOM_KEYS:
            return jax.random.wrap_key_data(jnp.asarray(self.array(node["key"])), impl=node["impl"])
        if kind == "dict":
            found = {inside(key): inside(x) for key, x in node["dict"]}
            if len(found) < len(node["dict"]):
                raise ValueError("a dictionary has one key twice.")
            return found
        if kind in ("list", "tuple") and isinstance(node[kind], list):
            return (list if kind == "list" else tuple)(map(inside, node[kind]))
        if kind == "function":
            return self._table.function_of(**node["function"])
        if kind in ("namedtuple", "object"):
            return self._object(kind, node, inside)
        raise ValueError(f"a node of kind '{kind}' cannot be read here.")

    def _array(self, node):
        x = self.array(node["array"])
        if "dtype" in node:
            x = x.view(SMALL_NUMBERS[node["dtype"]])
        if node["of"] == "number":
            return x[()] if x.ndim == 0 else _raise_shape(node["array"])
        if node["of"] == "numpy":
            return x
        if node["of"] != "jax":
            raise ValueError(f"an array is not of {node['of']!r:.20}.")
        if jax.dtypes.canonicalize_dtype(x.dtype) != x.dtype:
            raise ValueError(
                f"it holds {x.dtype} arrays, and JAX works in 32 bits here, which would lose half of their digits.\n"
                'Fix: jax.config.update("jax_enable_x64", True) before the first array.'
            )
        return to_jax(x)

    def _object(self, kind, node, inside):
        cls, allowed, of_table = self._table.class_of(**node[kind])
        fields, is_tuple = node["fields"], issubclass(cls, tuple)
        if is_tuple != (kind == "namedtuple"):
            raise ValueError(f"class {cls.__name__} is{'' if is_tuple else ' not'} a named tuple.")
        if unknown := sorted(set(fields) - set(allowed)):
            raise ValueError(f"class {cls.__name__} has no field {', '.join(unknown)[:200]}.")
        values = _defaults(cls) | {name: inside(x) for name, x in fields.items()}
        if missing := [name for name in fields_of(cls) or () if name not in values]:
            raise ValueError(f"class {cls.__name__} needs the field {', '.join(missing)}.")
        if of_table:
            for name in fields:
                check_field(cls, name, values[name])
        # Neither `__new__` nor `__init__` of a class is called: these may change what was written.
        if is_tuple:
            return tuple.__new__(cls, [values[name] for name in cls._fields])
        return without_init(cls, values)


def _defaults(cls) -> dict[str, Any]:
    if issubclass(cls, tuple):
        return dict(getattr(cls, "_field_defaults"))
    fields, missing = dataclasses.fields(cls), dataclasses.MISSING
    found = {x.name: x.default for x in fields if x.default is not missing}
    return found | {x.name: x.default_factory() for x in fields if x.default_factory is not missing}


def _raise_shape(name):
    raise ValueError(f"{name[:80]} has to be one number, and is an array.")


def _under(path, key):
    return f"{path}.{key}" if path else str(key)


FORMAT = 1
HEADER = "lagjax.json"
# The kinds of files, with the function that reads each.
KINDS = {"trajectory": "lj.load_trajectory", "fit": "lj.load_fit"}
# A description has at most this many bytes: numbers in bulk belong in arrays. Arrays are read in pieces.
MOST_DESCRIPTION, PIECE = 4_000_000, 1 << 20
# What zip, zlib, NumPy and the operating system raise for damaged files, and Python for a malformed description.
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, SyntaxError, MemoryError, TokenError)
MALFORMED = (LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, StopIteration, AssertionError)


def write(path: str | os.PathLike, kind: str, description: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write a file; if that fails, an existing file stays as it was."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f'{path} is a folder.\nFix: give the name of a file in it, "{path / (kind + ".npz")}".')
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent}.\nFix: make it first: os.makedirs(...).")
    versions = {name: version(name) for name in ("lagjax", "jax", "diffrax")}
    header = {"format": FORMAT, "kind": kind, "versions": versions, **description}
    said = json.dumps(header, allow_nan=False)
    if len(said) > MOST_DESCRIPTION:
        raise ValueError(
            f"the description of this {kind} has {len(said):,} bytes, and may have {MOST_DESCRIPTION:,}.\n"
            "Usual cause: very many single numbers in params.\nFix: arrays of them."
        )
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        with open(partial, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as entries:
                entries.writestr(HEADER, said)
                for name, x in arrays.items():
                    with entries.open(f"{name}.npy", "w", force_zip64=True) as entry:
                        np.lib.format.write_array(entry, np.asanyarray(x), allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def opened(path: str | os.PathLike, kind: str) -> Iterator[tuple[dict[str, Any], Callable[[str], np.ndarray]]]:
    """Open a file: its header, and a function that reads an array by name, once.

    **Raises:** `FileNotFoundError` where there is none; `ValueError` for a file that is damaged, not lagjax's, of
    another kind, or written by a newer lagjax. In the same words, for whatever goes wrong inside of `with`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.\nFix: the path that was given to .save(path).")
    try:
        if not zipfile.is_zipfile(path):
            with open(path, "rb") as file:
                if file.read(2) != b"PK":
                    _raise_foreign(path, kind)
            raise_damaged(path, "its end is missing")
        with zipfile.ZipFile(path) as entries:
            if HEADER not in entries.namelist():
                _raise_foreign(path, kind)
            left = _entries(entries, path)
            if left[HEADER].file_size > MOST_DESCRIPTION:
                raise ValueError(f"its description has {left[HEADER].file_size:,} bytes.")
            header = parsed(entries.read(left.pop(HEADER)))
            _check_header(path, header, kind)

            def array(name: str) -> np.ndarray:
                if f"{name}.npy" not in left:
                    raise ValueError(f"there is no array {name[:80]}, or it is used twice.")
                return _array(entries, left.pop(f"{name}.npy"))

            yield header, array
    except Explained as error:
        raise ValueError(by_line(error)) from None
    except ValueError as error:
        raise ValueError(by_line(f"{path} cannot be read: {str(error)[:2000]}")) from error
    except DAMAGED as error:
        raise ValueError(by_line(_damaged(path, str(error)[:200] or type(error).__name__))) from error
    except MALFORMED as error:
        why = f"its description is incomplete, or not lagjax's ({type(error).__name__}: {str(error)[:200]})"
        raise ValueError(by_line(_damaged(path, why))) from error


class Explained(ValueError):
    """An error whose message is complete."""


def parsed(text: bytes, most: int = MOST_DESCRIPTION) -> Any:
    """What a JSON text says.

    **Raises:** `ValueError` also for one that is longer than `most` bytes, or nested too deeply.
    """
    if len(text) > most:
        raise ValueError(f"its description has {len(text):,} bytes, and may have {most:,}.")
    try:
        return json.loads(text.decode())
    except RecursionError:
        raise ValueError("its description is nested too deeply.") from None


def _entries(entries, path) -> dict[str, zipfile.ZipInfo]:
    """The entries of a zip file by name: each once, as it is, and together no longer than the file."""
    found = entries.infolist()
    named = {entry.filename: entry for entry in found}
    as_it_is = all(x.compress_type == zipfile.ZIP_STORED and x.compress_size == x.file_size for x in found)
    if len(named) < len(found):
        raise_damaged(path, "it has two entries of one name")
    if not as_it_is or sum(x.file_size for x in found) > path.stat().st_size:
        raise Explained(
            f"{path} has compressed entries, and lagjax's files have none.\n"
            "Usual cause: a file that was packed again.\nFix: the file as .save(path) wrote it."
        )
    return named


def _array(entries, info) -> np.ndarray:
    """An array, which has to fill its entry."""
    with entries.open(info) as entry:
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, by_columns, dtype = read_header[np.lib.format.read_magic(entry)](entry)
        stored, expected = info.file_size - entry.tell(), math.prod(shape) * dtype.itemsize
        if dtype.kind not in KINDS_OF_ARRAY or dtype.itemsize == 0 or min(shape, default=0) < 0 or stored != expected:
            raise ValueError(f"{info.filename[:80]} is said to be {dtype}{list(shape)}, and has {stored:,} bytes.")
        data = np.empty(stored, np.uint8)
        for start in range(0, stored, PIECE):
            piece = data[start : start + PIECE]
            piece[:] = np.frombuffer(entry.read(len(piece)), np.uint8)
        # The checksum is compared at the end of the entry.
        entry.read(1)
    if dtype.kind == "b" and data.max(initial=0) > 1:
        raise ValueError(f"{info.filename[:80]} has truth values that are neither true nor false.")
    found = data.view(dtype)
    if dtype.kind == "U" and found.view(f"{dtype.str[0]}u4").max(initial=0) > 0x10FFFF:
        raise ValueError(f"{info.filename[:80]} has characters that do not exist.")
    return found.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order="F" if by_columns else "C")


def _check_header(path, header, kind):
    number = header["format"]
    if type(number) is not int or number < 1 or not isinstance(header["kind"] if number <= FORMAT else "", str):
        raise ValueError("its header has no format and kind.")
    if number > FORMAT:
        raise Explained(
            f"{path} was written by lagjax {str(header['versions']['lagjax'])[:20]}, and this one, "
            f"{version('lagjax')}, cannot read it.\nFix: pip install -U lagjax."
        )
    if header["kind"] != kind:
        raise Explained(f"{path} holds a {header['kind'][:20]}, not a {kind}.\nFix: {KINDS[header['kind']]}(path).")


def _raise_foreign(path, kind) -> NoReturn:
    raise Explained(f"{path} is not a {kind} saved by lagjax.\nFix: the path that was given to .save(path).")


def raise_damaged(path, why: str) -> NoReturn:
    """Raise `ValueError` for a damaged file."""
    raise _damaged(path, why)


def _damaged(path, why):
    return Explained(
        f"{path} is damaged: {why}.\n"
        "Usual cause: a copy that was cut short, or a disk that failed.\n"
        "Fix: copy it again, or compute it again."
    )
