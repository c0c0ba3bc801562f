"""The structure of a tree as data: what JSON can hold, and what puts the tree's leaves in place again.

Classes are those of a list that whoever reads the outline passes, and whole parts can be `given`: those of the user's
own classes, which are in the problem, and those that hold functions.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import jax.tree_util as jtu
from jaxtyping import PyTree

from lagjax.jaxtools.tracing import without_init

PLAIN = (str, int, bool, type(None))


class NoOutline(TypeError):
    """A tree with something in it that is neither known nor given."""


def outlined(tree: PyTree, classes: Iterable[type], given: Mapping[str, Any]) -> Any:
    """The outline of a tree; what is one of `given`, or has the structure of one, is named only.

    >>> outlined({"t": 1.0, "q": [2.0, (3.0, None)]}, [], {"q": [0.0, (0.0, None)]})
    {'dict': [['t', 0], ['q', {'given': 'q'}]]}
    """
    structures = {name: jtu.tree_structure(x) for name, x in given.items()}

    def of(x: Any) -> Any:
        for name, known in given.items():
            if x is known:
                return {"given": name}
        if x is None:
            return None
        if jtu.all_leaves([x]):
            return 0
        structure = jtu.tree_structure(x)
        for name, known in structures.items():
            if structure == known:
                return {"given": name}
        if type(x) is dict and all(type(key) is str for key in x):
            return {"dict": [[key, of(value)] for key, value in x.items()]}
        if type(x) in (list, tuple):
            return {type(x).__name__: [of(part) for part in x]}
        if type(x) not in classes:
            raise NoOutline(f"a {type(x).__module__}.{type(x).__qualname__}")
        if isinstance(x, tuple):
            return {"named tuple": type(x).__name__, "fields": [of(part) for part in x]}
        fields = {f.name: f.metadata.get("static", False) for f in dataclasses.fields(x) if hasattr(x, f.name)}
        said = {name: _plain(getattr(x, name), given) for name, static in fields.items() if static}
        inside = {name: of(getattr(x, name)) for name, static in fields.items() if not static}
        return {"object": type(x).__name__, "said": said, "fields": inside}

    return of(tree)


def rebuilt(outline: Any, classes: Iterable[type], given: Mapping[str, Any]) -> PyTree:
    """The tree of an outline, with 0 for each leaf.

    >>> rebuilt({"dict": [["t", 0], ["q", {"given": "q"}]]}, [], {"q": [0.0, (0.0, None)]})
    {'t': 0, 'q': [0, (0, None)]}
    """
    by_name = {cls.__name__: cls for cls in classes}

    def of(node: Any) -> Any:
        if node is None or node == 0:
            return node
        if "given" in node:
            return jtu.tree_map(lambda _: 0, given[node["given"]])
        if "dict" in node:
            return {key: of(x) for key, x in node["dict"]}
        for kind in (list, tuple):
            if kind.__name__ in node:
                return kind(of(x) for x in node[kind.__name__])
        if "named tuple" in node:
            return by_name[node["named tuple"]](*map(of, node["fields"]))
        said = {name: _value(x, given) for name, x in node["said"].items()}
        return without_init(by_name[node["object"]], said | {name: of(x) for name, x in node["fields"].items()})

    return of(outline)


def _plain(x: Any, given: Mapping[str, Any]) -> Any:
    for name, known in given.items():
        if x is known:
            return {"given": name}
    if type(x) is tuple:
        return {"tuple": [_plain(part, given) for part in x]}
    if type(x) not in PLAIN:
        raise NoOutline(f"a {type(x).__module__}.{type(x).__qualname__}")
    return x


def _value(node: Any, given: Mapping[str, Any]) -> Any:
    if not isinstance(node, dict):
        return node
    return given[node["given"]] if "given" in node else tuple(_value(part, given) for part in node["tuple"])
