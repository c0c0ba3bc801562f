"""The architecture: rooms, cycles, file sizes, docstrings, exports."""

import ast
import doctest
import importlib
import importlib.util
import inspect
import pkgutil
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import jax.numpy as np

import lagjax

ROOT = Path(lagjax.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
# From the ground up: a module imports only from its own room or from those before it.
ROOMS = (
    "jaxtools", "numerics", "display", "files", "system", "mechanics", "learned", "steps", "integrate", "exchange",
    "analysis", "work_precision", "sweep", "sliders", "fit", "two_points", "report", "bodies", "models", "mechanisms",
    "scenes", "stability",
)  # fmt: skip
TOP = {"__init__", "__main__", "job"}
FINDER = doctest.DocTestFinder()
PRIVATE = ("jax._src", "jax.experimental", "jax.extend", "jax.interpreters", "jaxlib")
OPTIONAL = {"PIL", "google_crc32c", "ipywidgets", "matplotlib", "numcodecs", "pandas", "sympy", "tqdm", "xarray"}
OPTIONAL |= {"casadi", "mujoco", "zarr"}


@cache
def tree_of(source):
    """The syntax tree of a source, parsed once for all tests."""
    return ast.parse(source)


@cache
def nodes_of(source):
    """All nodes of a source."""
    return tuple(ast.walk(tree_of(source)))


def room(module):
    """The room of a dotted module name, `lagjax.integrate.solve.programs` -> "integrate"."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def module_name(path):
    """The dotted name of a file."""
    parts = ("lagjax", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


@cache
def internal_imports(source):
    """Every `lagjax.*` module that a source imports; names of modules imported from packages included."""
    found = set()
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "lagjax"}
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "lagjax":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                path = ROOT.parent / Path(*inner.split("."))
                found.add(inner if path.is_dir() or path.with_suffix(".py").exists() else node.module)
    return found


def upward_imports(name, source):
    """The imports of a module from higher rooms."""
    if room(name) in TOP:
        return []
    rank = ROOMS.index(room(name))
    return [target for target in internal_imports(source) if room(target) in TOP or ROOMS.index(room(target)) > rank]


def nested_imports(source):
    """Imports inside functions, except of optional extras."""
    found = []
    for function in nodes_of(source):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for node in ast.walk(function):
                if isinstance(node, (ast.Import, ast.ImportFrom)):
                    names = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                    found += [name for name in names if name.split(".")[0] not in OPTIONAL]
    return found


def test_imports_point_down():
    """No module imports from a room above its own, and none imports inside a function."""
    for path in FILES:
        source = path.read_text()
        assert upward_imports(module_name(path), source) == [], module_name(path)
        assert nested_imports(source) == [], module_name(path)


def test_the_import_checks_can_fail():
    """Twin: an upward import and an import inside a function are found."""
    assert upward_imports("lagjax.system.system", "from lagjax.integrate import integrate") != []
    assert upward_imports("lagjax.system.system", "import lagjax") != []
    assert nested_imports("def f():\n    import numpy") == ["numpy"]


def door(module):
    """The package through which what lies in a module is handed out; each part of `analysis` has its own."""
    parts = module.split(".")
    return ".".join(parts[: 3 if parts[1] == "analysis" and (ROOT / Path(*parts[1:3])).is_dir() else 2])


@cache
def handed_out(package):
    """The names that the `__init__` of a package imports or assigns."""
    tree = tree_of((ROOT.parent / Path(*package.split(".")) / "__init__.py").read_text())
    imported = [alias.asname or alias.name for x in tree.body if isinstance(x, ast.ImportFrom) for alias in x.names]
    targets = [target for x in tree.body if isinstance(x, ast.Assign) for target in x.targets]
    assigned = [target.id for target in targets if isinstance(target, ast.Name)]
    return {*imported, *assigned}


def past_the_door(name, source):
    """The imports of a module from other rooms that these do not hand out."""
    found = []
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names if alias.name.startswith("lagjax.")]
            found += [module for module in modules if room(module) != room(name) and module != door(module)]
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("lagjax."):
            if room(node.module) != room(name) and (ROOT / room(node.module)).is_dir():
                names = handed_out(node.module) if node.module == door(node.module) else set()
                found += [f"{node.module}: {alias.name}" for alias in node.names if alias.name not in names]
    return found


def test_rooms_have_doors():
    """What a module imports from another room is handed out by the `__init__` of that room."""
    for path in FILES:
        assert past_the_door(module_name(path), path.read_text()) == [], module_name(path)


def test_the_check_of_doors_can_fail():
    """Twin: a module inside another room, and a name that its door does not hand out, are found."""
    inside = "from lagjax.system.model import Model"
    assert past_the_door("lagjax.fit.fit", inside) and not past_the_door("lagjax.system.system", inside)
    assert past_the_door("lagjax.fit.fit", "from lagjax.system import unknown_name")
    assert past_the_door("lagjax.fit.fit", "import lagjax.system.model as model")
    assert not past_the_door("lagjax.fit.fit", "from lagjax.system import Model")


def circles_of_packages(imports):
    """The packages that import one another, at any depth; `imports`: by module, the modules that it imports."""
    graph = {}
    for name, targets in imports.items():
        for target in targets:
            mine, theirs = name.split("."), target.split(".")
            depth = next((i for i, (a, b) in enumerate(zip(mine, theirs)) if a != b), None)
            if depth is not None:
                graph.setdefault(tuple(mine[: depth + 1]), set()).add(tuple(theirs[: depth + 1]))

    def reached(start):
        seen, open_ = set(), [start]
        while open_:
            new = graph.get(open_.pop(), set()) - seen
            seen |= new
            open_ += new
        return seen

    return [".".join(package) for package in graph if package in reached(package)]


def test_no_circles_of_packages():
    """No two packages import from each other, at any depth. Twin: with one import turned round they do."""
    imports = {module_name(path): internal_imports(path.read_text()) for path in FILES if path.name != "__init__.py"}
    assert circles_of_packages(imports) == []
    turned = imports | {"lagjax.system.model": {"lagjax.mechanics.structure"}}
    assert set(circles_of_packages(turned)) >= {"lagjax.system", "lagjax.mechanics"}


PAGE = ROOT.parent / "docs" / "architecture.md"
STATION = re.compile(r"^\| `lagjax/(\S+\.py)` \| `(\w+)` \|", re.MULTILINE)


def calls_of_first_integrate():
    """(file, function) of each call inside lagjax by an `integrate` of a system never seen before, in order."""
    found = []

    def seen(frame, event, _):
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(str(ROOT)):
            found.append((Path(path).relative_to(ROOT).as_posix(), frame.f_code.co_name))

    swing = lagjax.System(lambda t, q, v, params: 0.5 * v**2 + 1.2345 * params["g"] * np.cos(q))
    sys.setprofile(seen)
    try:
        lagjax.integrate(swing, 1.0, 0.0, {"g": 9.81}, ts=np.linspace(0.0, 1.0, 3))
    finally:
        sys.setprofile(None)
    return found


def in_order(stations, calls):
    """Whether all stations are among the calls, in this order."""
    calls = iter(calls)
    return all(station in calls for station in stations)


def test_the_page_of_the_house():
    """One call passes the stations of the page, in its order; every room and file that it names exists. Twin: turned
    round it does not."""
    text, stations = PAGE.read_text(), STATION.findall(PAGE.read_text())
    calls = calls_of_first_integrate()
    assert len(stations) > 10 and in_order(stations, calls) and not in_order(stations[::-1], calls)
    assert all((ROOT.parent / path).exists() for path in re.findall(r"`(lagjax/\S+\.py)`", text))
    named = re.findall(r"^([a-z_]+(?:, [a-z_]+)*)  ", text, re.MULTILINE)
    assert {room for rooms in named for room in rooms.split(", ")} == set(ROOMS) - {"learned", "report"}


def private_imports(source):
    """The modules of JAX without a stability guarantee that a source imports."""
    found = set()
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return sorted(name for name in found if name.startswith(PRIVATE))


def test_private_modules_stay_in_one_package():
    """Only `lagjax.jaxtools` imports undocumented modules of JAX and XLA."""
    for path in FILES:
        if room(module_name(path)) != "jaxtools":
            assert private_imports(path.read_text()) == [], path


def test_the_check_of_private_modules_can_fail():
    """Twin: each way of importing one is found, anywhere in a file; a public module is not."""
    for source in (
        "import jax._src.core",
        "from jax import interpreters",
        "def f():\n    from jax.extend.core import Var",
    ):
        assert len(private_imports(source)) == 1
    assert private_imports("from jax import lax\nimport jax.numpy as jnp") == []


def test_no_import_cycles():
    """The import graph has no cycle."""
    graph = {module_name(path): internal_imports(path.read_text()) for path in FILES}
    finished, open_ = set(), []

    def visit(name):
        assert name not in open_, f"cycle: {' -> '.join([*open_, name])}"
        if name in finished or name not in graph:
            return
        open_.append(name)
        for target in graph[name]:
            visit(target)
        finished.add(open_.pop())

    for name in graph:
        visit(name)


def test_files_are_small():
    """A file stays under 600 lines, the front door under 250."""
    lines = {path: len(path.read_text().splitlines()) for path in FILES}
    limit = lambda path: 250 if path.name == "integrate.py" else 600
    assert {module_name(path): count for path, count in lines.items() if count > limit(path)} == {}


def test_modules_and_public_names_have_docstrings():
    """Every module, and every public function and class in it, has a docstring."""
    for path in FILES:
        tree = tree_of(path.read_text())
        assert ast.get_docstring(tree), module_name(path)
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{module_name(path)}: {node.name} has no docstring"


def test_exports():
    """Each name in `__all__` exists, says what it is, and gives an example or its fields."""
    for name in lagjax.__all__:
        doc = inspect.getdoc(getattr(lagjax, name))
        assert doc and len(doc.splitlines()) > 0, name
    for name in (
        "momentum",
        "mass_matrix",
        "accelerations",
        "jacobi_integral",
        "integrate",
        "consistent_state",
        "explain",
    ):
        doc = inspect.getdoc(getattr(lagjax, name))
        for part in (">>>", "**Returns:**", "**Raises:**", "Source:"):
            assert part in doc, f"{name} lacks {part}"


def written_examples(source):
    """The names of everything whose docstring has an example; "" for the module."""
    documented = (ast.FunctionDef, ast.ClassDef, ast.Module)
    nodes = [node for node in nodes_of(source) if isinstance(node, documented)]
    return {getattr(node, "name", "") for node in nodes if ">>>" in (ast.get_docstring(node) or "")}


def test_every_example_is_executed():
    """Doctest finds, and so runs, all examples: wrappers may hide a docstring from it."""
    for path in FILES:
        if path.stem != "__main__":
            module = importlib.import_module(module_name(path))
            tests = [test for test in FINDER.find(module) if test.examples]
            found = {test.name.removeprefix(module.__name__).split(".")[-1] for test in tests}
            assert found == written_examples(path.read_text()), module_name(path)


def test_the_example_check_can_fail():
    """Twin: examples are listed by class, function and method."""
    source = 'class A:\n    def f(self):\n        """One.\n\n        >>> 1\n        1\n        """\n'
    assert written_examples(source) == {"f"} != written_examples(source.replace(">>>", ""))


def test_types_are_shipped():
    """The marker file for type checkers is in the package."""
    assert (ROOT / "py.typed").exists()


def absent(source: str) -> list[str]:
    """What a file reads from modules of lagjax that these do not have, such as `balance.holonomic` after a renaming."""
    nodes = nodes_of(source)
    modules = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lagjax"):
            for alias in node.names:
                if importlib.util.find_spec(node.module).submodule_search_locations is None:
                    continue
                name = f"{node.module}.{alias.name}"
                if importlib.util.find_spec(name) is not None:
                    modules[alias.asname or alias.name] = importlib.import_module(name)
    reads = {(x.value.id, x.attr) for x in nodes if isinstance(x, ast.Attribute) and isinstance(x.value, ast.Name)}
    return sorted(f"{name}.{attr}" for name, attr in reads if name in modules and not hasattr(modules[name], attr))


def test_what_is_read_from_a_module_is_there():
    """No function, however rarely it is called, reads a name that another module no longer has; twin: one that does."""
    files = [*FILES, *(ROOT.parent / "benchmarks").rglob("*.py")]
    assert {str(path): found for path in files if (found := absent(path.read_text()))} == {}
    assert absent("from lagjax.mechanics import projection as p\ndef f(x): return p.projectd(x)") == ["p.projectd"]


def test_import_computes_nothing():
    """No module holds a JAX array at its top level, and importing changes no JAX setting."""
    import jax

    for info in pkgutil.walk_packages(lagjax.__path__, "lagjax."):
        if info.name.endswith("__main__"):
            continue
        module = importlib.import_module(info.name)
        arrays = [name for name, value in vars(module).items() if isinstance(value, jax.Array)]
        assert arrays == [], f"{info.name}: {arrays}"
    for path in FILES:
        if path.name != "job.py":
            assert "jax.config.update" not in path.read_text().replace(
                'jax.config.update("jax_enable_x64", True) before', ""
            )


def test_import_waits_for_nothing_that_few_need():
    """Scenes, and packages used only by fits and scenes, are imported on first access; twin: then they are."""
    tell = "print(*sorted({'.'.join(m.split('.')[:2]) for m in set(sys.modules) - before}))"
    start = "import sys, jax, diffrax; before = set(sys.modules); import lagjax as lj; assert 'scenes' in dir(lj); "
    ask = f"{start}{tell}; lj.scenes; {tell}"
    printed = subprocess.run([sys.executable, "-c", ask], check=True, capture_output=True, text=True).stdout
    at_once, asked = map(str.split, printed.splitlines())
    late = {"lagjax.scenes", "scipy.special", "scipy.linalg", "matplotlib.pyplot"}
    assert not late & set(at_once)
    assert {"lagjax.scenes", "scipy.special"} <= set(asked)
