"""Write pytrees as a structure that JSON can hold and arrays by name: no pickle, and no functions.

Numbers, text, dicts, lists, tuples and named tuples are written as they are, dataclass objects (equinox modules among
them) as the name of their class and the values of their fields. Functions are only named, and only those of lagjax and
the packages that it depends on. Reading runs no code: a class of the user's must have been imported before; in place of
a named tuple that has not, one with the same fields is made.
"""

import dataclasses
import importlib
import math
import sys
import types
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.numerics.simplified_newton import tolerance_of_the_controller

# Packages whose modules may be imported by name, and whose functions may be named.
KNOWN = ("lagjax", "diffrax", "optimistix", "lineax", "equinox", "jax", "numpy")


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
    """Writes trees down; `arrays` are the arrays of everything written, by name.

    `given(value)`: the role of a value that is not written but given again by the user, or None.
    """

    def __init__(self, given: Callable[[Any], str | None] = lambda value: None):
        self.arrays: dict[str, np.ndarray] = {}
        self._given = given

    def down(self, value, path: str):
        """A value in a form for JSON; `path` is how the user would write it."""
        if value is None or isinstance(value, (bool, str)) or type(value) is int:
            return value
        if type(value) is float:
            return {"float": value.hex() if math.isfinite(value) else repr(value)}
        if type(value) is complex:
            return {"complex": [self.down(value.real, path), self.down(value.imag, path)]}
        if value is tolerance_of_the_controller():
            return {"tolerance": "of the controller"}
        if (role := self._given(value)) is not None:
            return {"given": role}
        if isinstance(value, (jax.Array, np.ndarray, np.generic)):
            return self._array(value, path)
        if type(value) is dict:
            return {"dict": [[self._key(k, path), self.down(x, _under(path, k))] for k, x in value.items()]}
        if type(value) in (list, tuple):
            return {type(value).__name__: [self.down(x, f"{path}[{i}]") for i, x in enumerate(value)]}
        if isinstance(value, tuple) and (names := getattr(value, "_fields", None)) is not None:
            parts = {name: self.down(getattr(value, name), _under(path, name)) for name in names}
            return {"namedtuple": _name_of(type(value)), "fields": parts}
        if isinstance(value, types.FunctionType) or callable(value) and not dataclasses.is_dataclass(value):
            return self._function(value, path)
        if dataclasses.is_dataclass(value):
            names = [f.name for f in dataclasses.fields(value) if hasattr(value, f.name)]
            parts = {name: self.down(getattr(value, name), _under(path, name)) for name in names}
            return {"object": _name_of(type(value)), "fields": parts}
        raise NotWritable(
            f"{path} is a {type(value).__name__}, which cannot be written down.\n"
            "Fix: use numbers, arrays, text, dicts, lists, tuples, named tuples and dataclasses of these."
        )

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
        if x.dtype == object:
            raise NotWritable(f"{path} is an array of Python objects.\nFix: an array of numbers.")
        of = "jax" if isinstance(value, jax.Array) else "numpy" if isinstance(value, np.ndarray) else "number"
        node = {"array": name, "of": of}
        if x.dtype.kind == "V":
            # NumPy's files have no name for bfloat16 and its like.
            node["dtype"] = x.dtype.name
            x = x.view(f"u{x.dtype.itemsize}")
        self.arrays[name] = x
        return node

    def _free(self, path):
        wanted = "".join(c if c.isalnum() or c in "._-[]" else "_" for c in path) or "value"
        name, number = wanted, 1
        # Names must differ by more than case: somebody may unpack the file on a file system that ignores it.
        while name.lower() in {other.lower() for other in self.arrays}:
            name, number = f"{wanted}.{number}", number + 1
        return name

    def _function(self, value, path):
        module = getattr(value, "__module__", None) or ""
        if _is_known(module):
            # By its own name, or the name under which its module keeps it.
            kept_as = [name for name, x in vars(sys.modules.get(module, sys)).items() if x is value]
            for name in (getattr(value, "__qualname__", ""), *kept_as):
                if name and _find(module, name) is value:
                    return {"function": {"module": module, "name": name}}
        raise NotWritable(
            f"{path} is a function ({getattr(value, '__name__', type(value).__name__)}), and functions are not data.\n"
            "Usual cause: a function in params.\n"
            "Fix: write it into the Lagrangian, and leave its numbers in params."
        )


class Reader:
    """Reads trees; `given(role)` returns the user's value for one that was not written."""

    def __init__(self, arrays: dict[str, np.ndarray], given: Callable[[str], Any] | None = None):
        self._arrays, self._given = arrays, given

    def up(self, node) -> Any:
        """The value that a node stands for."""
        if not isinstance(node, dict):
            return node
        kind = next(iter(node))
        if kind == "float":
            text = node["float"]
            return float.fromhex(text) if "x" in text else float(text)
        if kind == "complex":
            return complex(*map(self.up, node["complex"]))
        if kind == "tolerance":
            return tolerance_of_the_controller()
        if kind == "given" and self._given is not None:
            return self._given(node["given"])
        if kind == "array":
            return self._array(node)
        if kind == "key":
            return jax.random.wrap_key_data(jnp.asarray(self._arrays[node["key"]]), impl=node["impl"])
        if kind == "dict":
            return {self.up(key): self.up(x) for key, x in node["dict"]}
        if kind in ("list", "tuple"):
            return (list if kind == "list" else tuple)(self.up(x) for x in node[kind])
        if kind == "namedtuple":
            return self._named_tuple(node)
        if kind == "function":
            return self._function(node["function"])
        if kind == "object":
            return self._object(node)
        raise ValueError(f"a node of kind '{kind}' is not known.")

    def _array(self, node):
        x = self._arrays[node["array"]]
        if "dtype" in node:
            x = x.view(jnp.dtype(node["dtype"]))
        if node["of"] != "jax":
            return x if node["of"] == "numpy" else x[()]
        if jax.dtypes.canonicalize_dtype(x.dtype) != x.dtype:
            raise ValueError(
                f"it holds {x.dtype} arrays, and JAX works in 32 bits here, which would lose half of their digits.\n"
                'Fix: jax.config.update("jax_enable_x64", True) before the first array.'
            )
        return jnp.asarray(x)

    def _named_tuple(self, node):
        cls, fields = _find(**node["namedtuple"]), node["fields"]
        if not (isinstance(cls, type) and issubclass(cls, tuple) and getattr(cls, "_fields", None) == tuple(fields)):
            cls: Any = namedtuple(node["namedtuple"]["name"].rsplit(".", 1)[-1], list(fields))
        return cls(**{name: self.up(x) for name, x in fields.items()})

    def _function(self, named):
        found = _find(**named) if _is_known(named["module"]) else None
        if not callable(found):
            raise ValueError(f"there is no function {named['module']}.{named['name']} any more.")
        return found

    def _object(self, node):
        module, name = node["object"]["module"], node["object"]["name"]
        cls = _find(module, name)
        if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
            fix = f"import {module} before this" if not _is_known(module) else "the version that wrote it"
            raise ValueError(f"it holds an object of class {module}.{name}, which is not known here.\nFix: {fix}.")
        found = object.__new__(cls)
        if unknown := set(node["fields"]) - {field.name for field in dataclasses.fields(cls)}:
            raise ValueError(f"class {module}.{name} has no field {', '.join(sorted(unknown))} any more.")
        for field, x in node["fields"].items():
            object.__setattr__(found, field, self.up(x))
        return found


def _under(path, key):
    return f"{path}.{key}" if path else str(key)


def _is_known(module):
    return module.split(".")[0] in KNOWN


def _name_of(cls):
    # By its public name, which stays the same when its file moves.
    public = getattr(sys.modules.get("lagjax"), cls.__name__, None) is cls
    module, name = ("lagjax", cls.__name__) if public else (cls.__module__, cls.__qualname__)
    return {"module": module, "name": name}


def _find(module: str, name: str):
    """Look up a name in a module; a module of the user's must have been imported already."""
    if _is_known(module) and module not in sys.modules:
        try:
            importlib.import_module(module)
        except ImportError:
            return None
    found = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found
