"""The structure of a tree as data: what JSON can hold, and what puts the tree's leaves in place again.

A class or a function of a library is named; parts of what a program was called with are `given`, as the user's own
classes and functions.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax.tree_util as jtu
from jaxtyping import PyTree

from lagjax.jaxtools.digest import name_in_library, named_in_library
from lagjax.jaxtools.tracing import without_init

PLAIN = (str, int, float, bool, type(None))


class NoOutline(TypeError):
    """A tree with something in it that is neither known nor given."""


def outlined(tree: PyTree, given: Mapping[str, Any]) -> Any:
    """The outline of a tree; what is one of `given`, or has the structure of one, is named only.

    >>> outlined({"t": 1.0, "q": [2.0, (3.0, None)], "place": 3 + 4j}, {})
    {'dict': [['t', 0], ['q', {'list': [0, {'tuple': [0, None]}]}], ['place', 0]]}
    """
    structures = [(name, jtu.tree_structure(x)) for name, x in given.items() if not jtu.all_leaves([x])]

    def of(x: Any) -> Any:
        if x is None:
            return None
        if jtu.all_leaves([x]):
            return 0
        structure = jtu.tree_structure(x)
        for name, known in structures:
            if structure == known:
                return {"given": name}
        if type(x) is dict and all(type(key) is str for key in x):
            return {"dict": [[key, of(value)] for key, value in x.items()]}
        if type(x) in (list, tuple):
            return {type(x).__name__: [of(part) for part in x]}
        cls = name_in_library(type(x))
        if cls is None:
            raise NoOutline(f"a {type(x).__module__}.{type(x).__qualname__}")
        if isinstance(x, tuple):
            return {"named tuple": cls, "fields": [of(part) for part in x]}
        if not dataclasses.is_dataclass(x):
            raise NoOutline(f"a {cls}")
        fields = {f.name: f.metadata.get("static", False) for f in dataclasses.fields(x) if hasattr(x, f.name)}
        said = {name: _plain(getattr(x, name), given) for name, static in fields.items() if static}
        inside = {name: of(getattr(x, name)) for name, static in fields.items() if not static}
        return {"object": cls, "said": said, "fields": inside}

    return of(tree)


def rebuilt(outline: Any, given: Mapping[str, Any]) -> PyTree:
    """The tree of an outline, with 0 for each leaf.

    >>> rebuilt({"dict": [["t", 0], ["q", {"given": "q"}]]}, {"q": [0.0, (0.0, None)]})
    {'t': 0, 'q': [0, (0, None)]}
    """

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
            return named_in_library(node["named tuple"])(*map(of, node["fields"]))
        said = {name: _value(x, given) for name, x in node["said"].items()}
        return without_init(
            named_in_library(node["object"]), said | {name: of(x) for name, x in node["fields"].items()}
        )

    return of(outline)


def parts_of(tree: Any) -> dict[str, Any]:
    """All parts of a tree by their places in it, what its classes hold beside arrays included.

    >>> print(parts_of([{"q": 1.0}, "free"]))
    {'': [{'q': 1.0}, 'free'], '.0': {'q': 1.0}, '.0.q': 1.0, '.1': 'free'}
    """

    def of(place: str, x: Any) -> Iterator[tuple[str, Any]]:
        yield place, x
        if isinstance(x, dict):
            inside = x.items()
        elif isinstance(x, (list, tuple)):
            inside = enumerate(x)
        elif dataclasses.is_dataclass(x) and not isinstance(x, type):
            inside = [(f.name, getattr(x, f.name)) for f in dataclasses.fields(x) if hasattr(x, f.name)]
        else:
            return
        for name, part in inside:
            yield from of(f"{place}.{name}", part)

    return dict(of("", tree))


def _plain(x: Any, given: Mapping[str, Any]) -> Any:
    if type(x) in PLAIN:
        return x
    for name, known in given.items():
        if x is known:
            return {"given": name}
    if isinstance(x, tuple) and (cls := name_in_library(type(x))) is not None:
        return {"tuple": [_plain(part, given) for part in x], "class": cls}
    if (name := name_in_library(x)) is not None:
        return {"named": name}
    raise NoOutline(f"a {type(x).__module__}.{type(x).__qualname__}")


def _value(node: Any, given: Mapping[str, Any]) -> Any:
    if not isinstance(node, dict):
        return node
    if "given" in node:
        return given[node["given"]]
    if "named" in node:
        return named_in_library(node["named"])
    parts = [_value(part, given) for part in node["tuple"]]
    cls = named_in_library(node["class"])
    return tuple(parts) if cls is tuple else cls(*parts)
