"""A page for each public name, in the sections of `lagjax/__init__.pyi`: signature, docstring, example, errors.

A name is written here as it is after `lj.`, `integrate` or `bodies.Body`; a result, which is imported from where it is
defined, by its own name alone.

The docstrings are Markdown with doctest examples, which `pytest lagjax` runs.
"""

import ast
import functools
import importlib
import inspect
import re
import typing
from operator import attrgetter
from pathlib import Path

from written import clear, write

import lagjax

FOLDER = Path(__file__).parent.parent / "api"
INIT = Path(lagjax.__file__).with_suffix(".pyi")
# The function whose example shows an object that no function is annotated to return.
SHOWN_BY = {
    "Crossings": "Crossing", "Snapshot": "integrate", "Explanation": "explain", "Switches": "guards.touches",
    "Routhian": "routhian", "Branch": "continue_equilibria", "Critical": "continue_equilibria", "Mode": "normal_modes",
    "CriticalOrbit": "continue_orbits",
    "Status": "sweep", "Knobs": "interact", "HybridTrajectory": "guards.touches",
}  # fmt: skip
# Code that begins with a name in `lj.`, or in a part of it.
NAME = re.compile(r"lj\.(?P<part>\w+)(?:\.(?P<inner>\w+))?")
# What has names of its own in `lj.`.
PARTS = ("bodies", "guards", "shapes")
# Where results are imported from.
RESULTS = {name: place for place, names in lagjax.MOVED.items() if place.startswith("lagjax") for name in names.split()}
# Examples for names whose docstring has no room for one.
EXAMPLES = {
    "scenes": """
>>> import lagjax as lj
>>> hoop = lj.scenes.bead_on_hoop
>>> print(f"{hoop.equilibrium_angle(hoop.PARAMS):.3f}")
1.199
""",
}
RAISE_IT = """
>>> import warnings
>>> import lagjax as lj
>>> with warnings.catch_warnings():
...     warnings.simplefilter("error", lj.{name})  # raise it instead of showing it
...     warnings.warn("for example", lj.{name})
Traceback (most recent call last):
{module}.{name}: for example
"""


def sections() -> dict[str, list[str]]:
    """The public names under the comments above their imports, in the order of the map; each part after its section."""
    found: dict[str, list[str]] = {}
    # What stands above the first comment belongs to no section, nor does what is no import.
    for comment in re.split("^# (?!isort)", INIT.read_text(), flags=re.MULTILINE)[1:]:
        title, _, text = comment.partition("\n")
        if names := re.findall(r"(\w+) as \1\b", text):
            found[title.strip(" .")] = names
            for part in (name for name in names if name in PARTS):
                found[f"In lj.{part}"] = [f"{part}.{name}" for name in getattr(lagjax, part).__all__]
    return found | {"Results": sorted(RESULTS)}


@functools.cache
def public_names() -> tuple[str, ...]:
    """All names that have a page."""
    return tuple(name for names in sections().values() for name in names)


def named(name: str):
    """What has this name."""
    return getattr(importlib.import_module(RESULTS[name]), name) if name in RESULTS else attrgetter(name)(lagjax)


def written(name: str) -> str:
    """The name as it is in code and texts."""
    return name if name in RESULTS else f"lj.{name}"


def name_in(code: str) -> str | None:
    """The public name with which a piece of code begins, the longest; a result only where it stands alone."""
    if code in RESULTS:
        return code
    found = NAME.match(code)
    names = [f"{found['part']}.{found['inner']}", found["part"]] if found else []
    return next((name for name in names if name in public_names() and name not in RESULTS), None)


def page_of(name: str) -> str:
    """The file name of a page: `fit` and `Fit` must differ on file systems that ignore case."""
    twins = [other for other in public_names() if other.lower() == name.lower()]
    return name if len(twins) == 1 or name.islower() else f"{name.lower()}-class"


def markdown(docstring: str) -> str:
    """A docstring as Markdown, with its examples fenced."""
    lines, inside = [], False
    for line in inspect.cleandoc(docstring).splitlines():
        if line.lstrip().startswith(">>>") and not inside:
            lines.append("```pycon")
            inside = True
        elif inside and not line.strip():
            lines.append("```")
            inside = False
        lines.append(line)
    return "\n".join(lines + ["```"] * inside)


def example(docstring: str) -> str:
    """The first example of a docstring."""
    found = re.search(r"```pycon\n.*?```", markdown(docstring), re.DOTALL)
    return found[0] if found else ""


def signature(thing, name: str, method: bool = False) -> str:
    """`name(arguments)` with defaults, without types: the docstring says more than the types."""
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return name
    kept = [p.replace(annotation=p.empty) for p in found.parameters.values()]
    if method and kept and kept[0].name in ("self", "cls"):
        kept = kept[1:]
    # Keep a default only if its repr is short and without a memory address, so that a reader could type it.
    kept = [
        p if len(repr(p.default)) < 40 and " at 0x" not in repr(p.default) else p.replace(default=...) for p in kept
    ]
    return name + str(found.replace(parameters=kept, return_annotation=inspect.Signature.empty)).replace(
        "Ellipsis", "..."
    )


def makers(cls: type) -> list[str]:
    """The public functions that are annotated to return this class."""
    found = []
    for name in public_names():
        function = named(name)
        if inspect.isfunction(inspect.unwrap(function)):
            returned = inspect.unwrap(function).__annotations__.get("return")
            if returned is cls or cls in typing.get_args(returned):
                found.append(name)
    return found


def members(cls: type) -> list[str]:
    """Directives for the documented methods and properties that a lagjax class defines or inherits from one."""
    parts = []
    for name, member in inspect.getmembers_static(cls):
        owner = next((base for base in cls.__mro__ if name in vars(base)), object)
        if name.startswith("_") or not owner.__module__.startswith("lagjax"):
            continue
        function = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
        doc = inspect.getdoc(function) if inspect.isroutine(function) or isinstance(function, property) else None
        if not doc:
            continue
        if isinstance(function, property):
            parts.append(f":::{{py:property}} {name}\n{markdown(doc)}\n:::\n")
        else:
            parts.append(f":::{{py:method}} {signature(function, name, True)}\n{markdown(doc)}\n:::\n")
    return parts


def added_example(thing, name: str) -> str:
    """An example that is not in a docstring; a test runs it."""
    if inspect.isclass(thing) and issubclass(thing, Warning):
        return RAISE_IT.format(name=name, module=thing.__module__)
    return EXAMPLES.get(name, "")


def entry(name: str) -> str:
    """A line of a list: a link to the page of a name, and the first line of its docstring."""
    first = (inspect.getdoc(named(name)) or "").split("\n\n")[0].replace("\n", " ")
    return f"- [`{written(name)}`]({page_of(name)}.md): {first}"


def borrowed(thing, name: str) -> str:
    """The example of the function that returns such an object, or one added here."""
    if added := added_example(thing, name):
        return f"\n{markdown(added)}\n"
    maker = SHOWN_BY.get(name) or next(iter(makers(thing)), None)
    if maker is None:
        return ""
    return f"\nAn example, that of `lj.{maker}`:\n\n{example(inspect.getdoc(named(maker)) or '')}\n"


def described(thing, name: str) -> str:
    """The directive of a function or class."""
    doc = markdown(inspect.getdoc(thing) or "")
    if inspect.isclass(thing):
        kind = "exception" if issubclass(thing, BaseException) else "class"
        head = name if kind == "exception" or issubclass(thing, tuple) else signature(thing, name)
        shown = "" if "```pycon" in doc else borrowed(thing, name)
        inner = "\n".join(members(thing)) if kind == "class" else ""
        return f"::::{{py:{kind}}} {head}\n{doc}\n{shown}\n{inner}::::\n"
    if callable(thing):
        return f"::::{{py:function}} {signature(thing, name)}\n{doc}\n::::\n"
    return f"::::{{py:data}} {name}\n{doc}\n::::\n"


def page(name: str) -> str:
    """The whole page of a public name."""
    thing = named(name)
    if not inspect.ismodule(thing):
        part, _, last = name.rpartition(".")
        module = RESULTS.get(name) or f"lagjax.{part}".strip(".")
        imported = f"```python\nfrom {module} import {name}\n```\n\n" if name in RESULTS else ""
        head = f"# {written(name)}\n\n{imported}:::{{py:currentmodule}} {module}\n:::\n\n"
        return head + described(thing, last)
    if name in PARTS:
        entries = [entry(f"{name}.{inner}") for inner in thing.__all__]
        head = f"# lj.{name}\n\n:::{{py:currentmodule}} lagjax.{name}\n:::\n"
        return "\n".join([head, markdown(inspect.getdoc(thing) or ""), "", *entries, ""])
    parts = [
        f"# lj.{name}\n",
        markdown(inspect.getdoc(thing) or ""),
        markdown(EXAMPLES.get(name, "")),
        f"\n:::{{py:currentmodule}} lagjax.{name}\n:::\n",
    ]
    if hasattr(thing, "__path__"):
        inner = {key: value for key, value in vars(thing).items() if inspect.ismodule(value) and key in thing.__all__}
        lines = [
            f"- `lagjax.{name}.{key}`: {(inspect.getdoc(value) or '').splitlines()[0]}" for key, value in inner.items()
        ]
        parts += ["", *lines, "\nThe [gallery](../gallery.md) has a picture and a closed form of each.\n"]
    defined = ast.parse(Path(thing.__file__).read_text()).body
    for node in defined:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            parts.append(f"## {node.name}\n\n{described(getattr(thing, node.name), node.name)}")
    return "\n".join(parts)


def index(groups: dict[str, list[str]]) -> str:
    """The list of all names with the first line of each docstring."""
    parts = ["# Reference\n", "`import lagjax as lj`; the names are in the order of the physics.\n"]
    for title, names in groups.items():
        parts.append(f"## {title}\n")
        parts += map(entry, names)
        parts.append(f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n" + "\n".join(map(page_of, names)) + "\n```\n")
    return "\n".join(parts)


def generate(app):
    """Write all pages."""
    groups = sections()
    for name in public_names():
        write(FOLDER / f"{page_of(name)}.md", page(name))
    write(FOLDER / "index.md", index(groups))
    clear(FOLDER, {"index.md"} | {f"{page_of(name)}.md" for name in public_names()})


def setup(app):
    """Generate before the sources are read."""
    app.connect("builder-inited", generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
