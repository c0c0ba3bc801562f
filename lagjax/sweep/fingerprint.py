"""The fingerprint of the sweep in a store: axes, names and dtypes of values, program, and versions that wrote it."""

from collections.abc import Iterable
from importlib.metadata import version
from pathlib import PureWindowsPath
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.display.printable import printable
from lagjax.sweep.axes import Axes
from lagjax.sweep.batch_program import Program, digest

# Stores of other formats are not read.
FORMAT = 4
ANOTHER_FUNCTION = "run is another function"
# Names reserved by zarr or by a store.
RESERVED = ("", ".", "..", "zarr.json", "lagjax")


def fingerprint(axes: Axes, program: Program, layout: str) -> dict[str, Any]:
    """The properties that two runs must share to use one store, readable where possible."""
    return {
        "format": FORMAT,
        "points": ", ".join(f"{name}: {n}" for name, n in axes.dims.items()),
        "axes": {name: of_axis(x) for name, x in axes.values.items()},
        "values": {name: f"{x.dtype}{list(x.shape)}" for name, x in named_leaves(program.values)},
        "chunk": program.chunk,
        "layout": layout,
        "program": program.digest,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """The versions of the packages that write a store."""
    return {name: version(name) for name in ("lagjax", "jax", "diffrax")}


def in_words(of_versions: dict[str, str]) -> str:
    """Versions as text."""
    return ", ".join(f"{name} {number}" for name, number in of_versions.items())


def of_axis(x: np.ndarray) -> str:
    """The dtype and shape of an axis and a digest of its values."""
    return f"{x.dtype}{list(x.shape)} {digest(x.tobytes())}"


def named_leaves(tree) -> list[tuple[str, Any]]:
    """The leaves of what `run` returns, each with a name: its path, or "value" for a single leaf.

    **Raises:** `ValueError` if two have the same name.
    """
    key = lambda path: jax.tree_util.keystr(path, simple=True, separator=".").lstrip(".") or "value"
    found = [(key(path), path, leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]
    paths = {}
    for name, path, _ in found:
        paths.setdefault(name, []).append(jax.tree_util.keystr(path) or "the value itself")
    for name, same_name in paths.items():
        if len(same_name) > 1:
            raise ValueError(
                f"run returns {len(same_name)} values named '{name}': {', '.join(same_name)}.\n"
                f"Usual cause: a key with a dot in it. Fix: another key, such as '{name.replace('.', '_')}'."
            )
    return [(name, leaf) for name, _, leaf in found]


def check_file_names(kind: str, names: Iterable[str]) -> None:
    """Raise `ValueError` for names that cannot be folder names in a store."""
    for name in names:
        reserved = name in RESERVED or name.startswith("__") or "/" in name or "\\" in name
        if reserved or not name.isprintable() or PureWindowsPath(name).anchor:
            raise ValueError(
                f"{kind} '{printable(name)}' cannot be kept in a store: it is reserved or not a valid folder name.\n"
                "Fix: another key, of letters, digits and underscores."
            )


def differences(there: dict, here: dict, under: str = "") -> list[str]:
    """The differences between two fingerprints, one line each."""
    found = []
    for key in dict.fromkeys((*there, *here)):
        a, b, name = there.get(key), here.get(key), f"{under}{key}"
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, f"{name} ")
        elif name == "program" and a != b:
            found.append(ANOTHER_FUNCTION)
        elif (
            a != b and under == "axes " and isinstance(a, str) and isinstance(b, str) and a.split()[:1] == b.split()[:1]
        ):
            found.append(f"axis '{key}' has other values")
        elif a != b:
            found.append(f"{name}: {a} there, {b} here")
    return found


def shapes_of(values: PyTree, lead: int) -> str:
    """The names and shapes of a point's values as text; the first `lead` dimensions are those of the sweep."""
    of_one = lambda x: f"{x.dtype}{list(np.shape(x)[lead:]) or ''}"
    return ", ".join(sorted(f"{name} {of_one(x)}" for name, x in named_leaves(values)))
