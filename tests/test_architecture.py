"""The architecture: rooms, cycles, file sizes, docstrings, exports."""

import ast
import doctest
import functools
import graphlib
import importlib
import inspect
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import jax
import pytest

import lagjax
from tests.tiers import SLOW_EXAMPLES

ROOT = Path(lagjax.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
# From the ground up: a module imports only from its own room or from those before it.
ROOMS = (
    "contexts", "jaxtools", "refusals", "numerics", "display", "shapes", "files", "system", "mechanics", "learned",
    "steps", "integrate", "guards", "exchange", "analysis", "work_precision", "sweep", "sliders", "fit", "two_points",
    "report", "bodies", "models", "mechanisms", "scenes", "stability",
)  # fmt: skip
TOP = {"__init__", "__main__", "job"}
FINDER = doctest.DocTestFinder()
PRIVATE = ("jax._src", "jax.experimental", "jax.extend", "jax.interpreters", "jaxlib")
OPTIONAL = {"PIL", "google_crc32c", "ipywidgets", "matplotlib", "numcodecs", "pandas", "sympy", "tqdm", "xarray"}
OPTIONAL |= {"casadi", "cloudpickle", "fsspec", "imageio_ffmpeg", "mujoco", "zarr"}
LATE = ("scipy.", "matplotlib")


@functools.cache
def sources():
    """The source of each module."""
    return {module_name(path): path.read_text() for path in FILES}


@functools.cache
def tree_of(source):
    """The syntax tree of a source, parsed once for all tests."""
    return ast.parse(source)


@functools.cache
def statements_of(source):
    """The module and all statements of a source, at any depth: a thirtieth of its nodes."""
    found = [tree_of(source)]
    for node in found:
        for key in ("body", "orelse", "finalbody", "handlers", "cases"):
            found += getattr(node, key, ())
    return tuple(found)


def of_kind(source, *kinds):
    """All statements of a source that are of certain kinds."""
    return [node for node in statements_of(source) if isinstance(node, kinds)]


def room(module):
    """The room of a dotted module name, `lagjax.integrate.solve.programs` -> "integrate"."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def module_name(path):
    """The dotted name of a file."""
    parts = ("lagjax", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


def imports(node):
    """The dotted names of all that an import names: modules, or what is in them."""
    inside = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
    return [inside + alias.name for alias in node.names]


@functools.cache
def all_imports(source):
    """The dotted names of all that a source imports."""
    return [name for node in of_kind(source, ast.Import, ast.ImportFrom) for name in imports(node)]


@functools.cache
def is_module(name):
    """Whether a dotted name is a module of lagjax."""
    path = ROOT.parent / Path(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


def internal_imports(source):
    """Every module of lagjax that a source imports; modules imported from packages included."""
    names = [name for name in all_imports(source) if name.split(".")[0] == "lagjax"]
    return {name if is_module(name) else name.rpartition(".")[0] for name in names}


def upward(name, source):
    """The imports of a module from higher rooms."""
    if room(name) in TOP:
        return []
    rank = ROOMS.index(room(name))
    return [target for target in internal_imports(source) if room(target) in TOP or ROOMS.index(room(target)) > rank]


def nested(name, source):
    """Imports inside functions, except of optional extras."""
    functions = of_kind(source, ast.FunctionDef, ast.AsyncFunctionDef)
    found = []
    for node in of_kind(source, ast.Import, ast.ImportFrom):
        if any(function.lineno <= node.lineno <= (function.end_lineno or 0) for function in functions):
            found += [name for name in imports(node) if name.split(".")[0] not in OPTIONAL]
    return found


def door(module):
    """The package through which what lies in a module is handed out; each part of `analysis` has its own."""
    parts = module.split(".")
    return ".".join(parts[: 3 if parts[1] == "analysis" else 2])


@functools.cache
def handed_out(package):
    """The names that the `__init__` of a package, or a module, imports, assigns or defines."""
    body = tree_of(sources()[package]).body
    imported = [alias.asname or alias.name for x in body if isinstance(x, ast.ImportFrom) for alias in x.names]
    assigned = [ast.unparse(target) for x in body if isinstance(x, ast.Assign) for target in x.targets]
    return {*imported, *assigned, *(x.name for x in body if isinstance(x, (ast.FunctionDef, ast.ClassDef)))}


def past_the_door(name, source):
    """The imports of a module from other rooms that these do not hand out."""
    modules = [x for node in of_kind(source, ast.Import) for x in imports(node) if x.startswith("lagjax.")]
    found = [module for module in modules if room(module) != room(name) and module != door(module)]
    for node in of_kind(source, ast.ImportFrom):
        theirs = room(node.module)
        if node.module.startswith("lagjax.") and theirs != room(name) and (ROOT / theirs).is_dir():
            names = handed_out(node.module) if node.module == door(node.module) else set()
            found += [f"{node.module}: {alias.name}" for alias in node.names if alias.name not in names]
    return found


def private(name, source):
    """The undocumented modules of JAX and XLA that a source imports; only `lagjax.jaxtools` may."""
    return [found for found in all_imports(source) if found.startswith(PRIVATE) and room(name) != "jaxtools"]


@functools.cache
def lines_of_code(source):
    """The number of lines that hold code: no blank ones, no comments, no docstrings."""
    tree, told = tree_of(source), set()
    for node in (tree, *of_kind(source, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
        if ast.get_docstring(node, clean=False) is not None:
            told |= set(range(node.body[0].lineno, int(node.body[0].end_lineno or 0) + 1))
    layout = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    tokens = [x for x in tokenize.generate_tokens(io.StringIO(source).readline) if x.type not in layout]
    return len({line for x in tokens for line in range(x.start[0], x.end[0] + 1)} - told)


def long(name, source):
    """Whether a file is too long: the limit is 450 lines of code, and 120 for the front door."""
    lines = lines_of_code(source)
    return [f"{lines} lines of code"] if lines > (120 if name.endswith("integrate.integrate") else 450) else []


def undocumented(name, source):
    """The module, and the public functions and classes in it, without a docstring."""
    kinds = (ast.Module, ast.FunctionDef, ast.ClassDef)
    nodes = [x for x in (tree_of(source), *tree_of(source).body) if isinstance(x, kinds)]
    named = [(getattr(x, "name", "module"), ast.get_docstring(x)) for x in nodes]
    return [name for name, doc in named if not doc and not name.startswith("_")]


def settings(name, source):
    """Changes of a setting of JAX, apart from the job's own and those that messages advise."""
    left = source.replace('jax.config.update("jax_enable_x64", True) before', "")
    return ["jax.config.update"] * (name != "lagjax.job" and "jax.config.update" in left)


IN = "def f():\n    "
# A check of each module, with sources in which it finds something and those in which it does not, of `lagjax.fit.fit`.
CHECKS = [
    (upward, ["from lagjax.scenes import bead_on_hoop", "import lagjax"], ["from lagjax.system import System"]),
    (nested, [IN + "import numpy", IN + "from numpy import sin"], [IN + "import xarray.core", "import numpy"]),
    (
        past_the_door,
        ["from lagjax.system.model import Model", "from lagjax.system import none", "import lagjax.system.model as x"],
        ["from lagjax.system import Model", "from lagjax.fit.search import x"],
    ),
    (
        private,
        ["import jax._src.core", "from jax import interpreters", IN + "from jax.extend.core import Var"],
        ["from jax import lax\nimport jax.numpy as jnp"],
    ),
    (long, ["x = 1\n" * 451], ["x = 1\n" * 450, "# Words.\n\n" * 451, '"""Words.' + "\n" * 451 + '"""']),
    (undocumented, ["", '"""Words."""\ndef f(): pass'], ['"""Words."""\ndef _f(): pass']),
    (settings, ['jax.config.update("jax_enable_x64", True)'], []),
]


@pytest.mark.parametrize(("check", "bad", "good"), CHECKS, ids=[check.__name__ for check, _, _ in CHECKS])
def test_each_module(check, bad, good):
    """Modules import downward, at their top, from the doors of rooms, what is public; are small, have docstrings."""
    assert {name: found for name, source in sources().items() if (found := check(name, source))} == {}
    assert all(check("lagjax.fit.fit", source) for source in bad)
    assert not any(check("lagjax.fit.fit", source) for source in good)


def graph():
    """By module, the modules of lagjax that it imports."""
    return {name: internal_imports(source) for name, source in sources().items()}


def circles_of_packages(graph_of_modules):
    """The packages that import one another, at any depth."""
    graph = {}
    for name, targets in graph_of_modules.items():
        for target in targets:
            mine, theirs = name.split("."), target.split(".")
            depth = next((i for i, (a, b) in enumerate(zip(mine, theirs)) if a != b), None)
            if depth is not None:
                graph.setdefault(tuple(mine[: depth + 1]), set()).add(tuple(theirs[: depth + 1]))

    return [".".join(package) for package in graph if package in reached(graph, package)]


def reached(graph, start):
    """All that is reached from a node in one step or more."""
    seen, open_ = set(), [start]
    while open_:
        new = set(graph.get(open_.pop(), ())) - seen
        seen |= new
        open_ += new
    return seen


def test_no_circles():
    """No module imports itself in a circle, nor two packages each other, at any depth. Twin: with one turned round."""
    modules = {name: found for name, found in graph().items() if not (ROOT.parent / Path(*name.split("."))).is_dir()}
    turned = {"lagjax.system.model": {"lagjax.mechanics.structure"}}
    assert circles_of_packages(modules) == []
    assert set(circles_of_packages(modules | turned)) >= {"lagjax.system", "lagjax.mechanics"}
    list(graphlib.TopologicalSorter(graph()).static_order())
    with pytest.raises(graphlib.CycleError):
        list(graphlib.TopologicalSorter(graph() | turned).static_order())


def late(start):
    """What is imported with a module, by it or by those that it imports, and the packages around them, of `LATE`."""
    around = lambda name: {".".join(name.split(".")[:i]) for i in range(1, name.count(".") + 1)}
    with_packages = {name: {*found, *around(name)} for name, found in graph().items()}
    loaded = [tree_of(sources()[module]).body for module in reached(with_packages, start) | {start}]
    nodes = [node for body in loaded for node in body if isinstance(node, (ast.Import, ast.ImportFrom))]
    return {name for node in nodes for name in imports(node) if name.startswith(LATE)}


def test_a_motion_waits_for_nothing_that_few_need():
    """No part of SciPy nor a package for pictures is imported with `lj.integrate` or `lj.fit`; twin: with a scene."""
    assert late("lagjax.integrate.integrate") == late("lagjax.fit.fit") == set()
    assert late("lagjax.scenes.rolling_hoop") >= {"scipy.special"}


PAGE = ROOT.parent / "docs" / "architecture.md"
STATION = re.compile(r"^\| `lagjax/(\S+\.py)` \| `(\w+)` \|", re.MULTILINE)


def passed_by_first_integrate(stations, patch):
    """The stations, each a file and a function, that an `integrate` of a system never seen before calls, in order."""
    passed = []
    functions = [getattr(importlib.import_module(module_name(ROOT / path)), name) for path, name in stations]
    modules = [module for name, module in sys.modules.items() if name.startswith("lagjax")]
    for (path, name), function in zip(stations, functions):

        @functools.wraps(function)
        def passing(*args, _function=function, _station=(path, name), **options):
            passed.append(_station)
            return _function(*args, **options)

        for module in modules:
            for key in [key for key, value in vars(module).items() if value is function]:
                patch.setattr(module, key, passing)
    fall = lagjax.System(lambda t, q, v, params: 0.5 * v**2 - 1.2345 * params["g"] * q)
    lagjax.integrate(fall, 1.0, 0.0, {"g": 9.81}, ts=[0.0, 1.0])
    return passed


def in_order(stations, calls):
    """Whether all stations are among the calls, in this order."""
    calls = iter(calls)
    return all(station in calls for station in stations)


def test_the_page_of_the_house(monkeypatch):
    """One call passes the stations of the page, in its order; every room and file that it names exists. Twin: turned
    round it does not."""
    text, stations = PAGE.read_text(), STATION.findall(PAGE.read_text())
    calls = passed_by_first_integrate(stations, monkeypatch)
    assert len(stations) > 10 and in_order(stations, calls) and not in_order(stations[::-1], calls)
    assert all((ROOT.parent / path).exists() for path in re.findall(r"`(lagjax/\S+\.py)`", text))
    named = re.findall(r"^([a-z_]+(?:, [a-z_]+)*)  ", text, re.MULTILINE)
    assert {room for rooms in named for room in rooms.split(", ")} == set(ROOMS) - {"learned", "report"}


def test_exports():
    """Each name in `__all__`, and in that of bodies, guards and shapes, exists and says what it is."""
    parts = [lagjax, lagjax.bodies, lagjax.guards, lagjax.shapes]
    for part, name in ((part, name) for part in parts for name in part.__all__):
        doc = inspect.getdoc(getattr(part, name))
        assert doc and len(doc.splitlines()) > 0, name
    parts = {">>>", "**Returns:**", "**Raises:**", "Source:"}
    names = "momentum mass_matrix accelerations inverse_dynamics jacobi_integral integrate consistent_state explain"
    for name in names.split():
        assert {part for part in parts if part not in (inspect.getdoc(getattr(lagjax, name)) or "")} == set(), name


def written_examples(source):
    """The names of everything whose docstring has an example; "" for the module."""
    nodes = of_kind(source, ast.FunctionDef, ast.ClassDef, ast.Module) if ">>>" in source else []
    return {getattr(node, "name", "") for node in nodes if ">>>" in (ast.get_docstring(node) or "")}


def test_every_example_is_executed():
    """Doctest finds, and so runs, all examples: wrappers may hide a docstring from it. All that are slow exist."""
    executed = set()
    for name, source in sources().items():
        if written := written_examples(source):
            found = {test.name for test in FINDER.find(importlib.import_module(name)) if test.examples}
            assert {test.removeprefix(name).split(".")[-1] for test in found} == written, name
            executed |= found
    assert SLOW_EXAMPLES < executed


def test_the_example_check_can_fail():
    """Twin: examples are listed by class, function and method."""
    source = 'class A:\n    def f(self):\n        """One.\n\n        >>> 1\n        1\n        """\n'
    assert written_examples(source) == {"f"} != written_examples(source.replace(">>>", ""))


def test_types_are_shipped():
    """The marker file for type checkers is in the package."""
    assert (ROOT / "py.typed").exists()


def absent(source: str) -> list[str]:
    """What a file reads from modules of lagjax that these do not have, such as `balance.holonomic` after a renaming."""
    modules = {}
    for node in of_kind(source, ast.ImportFrom):
        if (node.module or "").startswith("lagjax"):
            names = {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            modules |= {name: importlib.import_module(full) for name, full in names.items() if is_module(full)}
    found = [x for x in ast.walk(tree_of(source)) if isinstance(x, ast.Attribute)] if modules else []
    reads = {(x.value.id, x.attr) for x in found if isinstance(x.value, ast.Name) and x.value.id in modules}
    return sorted(f"{name}.{attr}" for name, attr in reads if not hasattr(modules[name], attr))


def test_what_is_read_from_a_module_is_there():
    """No function, however rarely it is called, reads a name that another module no longer has; twin: one that does."""
    files = [*FILES, *(ROOT.parent / "benchmarks").rglob("*.py")]
    assert {str(path): found for path in files if (found := absent(path.read_text()))} == {}
    assert absent("from lagjax.system import coordinates as p\ndef f(x): return p.flaten(x)") == ["p.flaten"]


def test_import_computes_nothing():
    """No module holds a JAX array at its top level."""
    for name in sources():
        if not name.endswith("__main__"):
            values = vars(importlib.import_module(name)).items()
            assert [key for key, value in values if isinstance(value, jax.Array)] == [], name


def told(code):
    """What a new process prints, in lines of words; `new()` are the modules imported since its start."""
    start = "import sys; new = lambda: {'.'.join(m.split('.')[:2]) for m in set(sys.modules) - known}; "
    ask = [sys.executable, "-c", f"{start}known = set(sys.modules); import lagjax as lj; {code}"]
    return map(str.split, subprocess.run(ask, check=True, capture_output=True, text=True).stdout.splitlines())


def test_import_waits_for_everything():
    """`import lagjax` knows its names and imports none of them, nor JAX; twin: what is imported later is seen."""
    names, new, later = told("print(*dir(lj)); print(*new()); import wave; print(*new())")
    assert {"scenes", "System", "fit"} <= set(names) and {"lagjax", "wave"} <= set(later)
    assert {name for name in new if name.startswith("lagjax")} == {"lagjax"} and "jax" not in new
