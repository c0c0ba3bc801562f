"""How large the house is, and how far a system travels in it: figures of the source, without any of its results.

    lines, files            all lines of `lagjax/`, those of code alone (no docstring, comment or blank), and its files
    one importer            files under 60 lines that one other file imports
    across                  imports from another package of `lagjax`
    kinds asked             `isinstance` with a constraint's class, or with `Hybrid`
    five arguments          functions that take (system, t, q, v, params), each overloaded one once
    flatten, shapes         calls of `coordinates.flatten`; of `constraints.shapes`, `count` and `split`
    class names twice       names of classes that two files define
    annotated               per cent of the arguments that have a type
    lambdas                 lambdas that get a name
    tested                  per cent of the files that have a test file of their name

A walk counts the functions that are called with the system, or its model, at the first call from Python: `stays`
distinct functions, `files` in which they lie, `returns` to a file that had been left (stays less files), `climbs` from
a file to one of a package above it. `calls to diffeqsolve`, and `files`: the functions that are running, `integrate`
first, when it calls diffrax; closures count with the function that makes them, wrappers of `jaxtools` do not count.

    python -m benchmarks.house [--json FILE]
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from itertools import chain
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.measure import main, row
from lagjax.system.model import Model

jax.config.update("jax_enable_x64", True)

ROOT = Path(lj.__file__).parent
FILES = {path.relative_to(ROOT): path.read_text() for path in sorted(ROOT.rglob("*.py"))}
TREES = {path: ast.parse(source) for path, source in FILES.items()}
FLOORS = ("jaxtools", "numerics", "system", "mechanics", "integrate", "analysis", "fit", "sweep")
STATE = ["system", "t", "q", "v", "params"]
SHORT = 60
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef


def nodes(kind):
    """All nodes of a kind."""
    return [node for tree in TREES.values() for node in ast.walk(tree) if isinstance(node, kind)]


def lines_of_code(source):
    """How many lines hold code."""
    tree, docs = ast.parse(source), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTIONS) and ast.get_docstring(node) is not None:
            docs.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    found = {i for x in tokens if x.type not in skipped for i in range(x.start[0], x.end[0] + 1)}
    return len(found - docs)


def imports():
    """(file, imported file) for each pair within lagjax."""
    found = set()
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lagjax"):
                for alias in node.names:
                    for name in (f"{node.module}.{alias.name}", node.module):
                        place = Path(*name.split(".")[1:])
                        target = next(
                            (p for p in (place.with_suffix(".py"), place / "__init__.py") if p in FILES), None
                        )
                        if target is not None and place.parts:
                            found.add((path, target))
                            break
    return found


def calls(pattern):
    """How often the source calls what a pattern describes, definitions left out."""
    return sum(len(re.findall(rf"(?<!def )\b{pattern}\(", source)) for source in FILES.values())


def arguments():
    """All arguments of functions but `self`."""
    for function in nodes(FUNCTIONS):
        a = function.args
        yield from (x for x in [*a.posonlyargs, *a.args, *a.kwonlyargs] if x.arg not in ("self", "cls"))


def asked(kind):
    """How many `isinstance` ask for a class."""
    found = [n for n in nodes(ast.Call) if isinstance(n.func, ast.Name) and n.func.id == "isinstance"]
    return sum(kind in {x.id for x in ast.walk(n.args[1]) if isinstance(x, ast.Name)} for n in found)


def source():
    """Rows about the source."""
    pairs = imports()
    importers = Counter(target for _, target in pairs)
    lone = [p for p, text in FILES.items() if importers[p] == 1 and text.count("\n") < SHORT and p.stem[0] != "_"]
    room = lambda path: path.parts[0]
    classes = Counter(node.name for node in nodes(ast.ClassDef))
    taking = [f for f in nodes(FUNCTIONS) if [x.arg for x in f.args.args if x.arg not in ("self", "_")][:5] == STATE]
    taking = [f for f in taking if "overload" not in map(ast.unparse, f.decorator_list)]
    given = list(arguments())
    own = [path for path in FILES if path.stem[0] != "_"]
    tests = {path.stem.removeprefix("test_") for path in (ROOT.parent / "tests").rglob("test_*.py")}
    yield row("lines", sum(text.count("\n") for text in FILES.values()), 39_000)
    yield row("lines of code", sum(map(lines_of_code, FILES.values())), 25_500)
    yield row("files", len(FILES), 200)
    yield row("short files with one importer", len(lone), 20)
    yield row("imports across packages", sum(room(a) != room(b) for a, b in pairs), 850)
    yield row("kinds of constraints asked", asked("Holonomic"), 3)
    yield row("hybrids asked", asked("Hybrid"), 5)
    yield row("functions of five arguments", len(taking), 15)
    yield row("calls of flatten", calls(r"coordinates\.flatten"))
    yield row("calls of shapes, count, split", calls(r"constraints\.(?:shapes|count|split)"))
    yield row("class names given twice", sum(n > 1 for n in classes.values()), 5)
    yield row("arguments annotated, %", round(100 * np.mean([x.annotation is not None for x in given]), 1), 60, "more")
    lambdas = [n for n in nodes(ast.Assign) if isinstance(n.value, ast.Lambda)]
    yield row("lambdas with a name", len(lambdas), 80)
    yield row("files with a test of their name, %", round(100 * np.mean([p.stem in tests for p in own]), 1), 90, "more")


def running(frame):
    """(file, function) of all that is running here, from `integrate` on."""
    found = []
    while frame is not None and frame.f_code.co_name != "checked":
        if frame.f_code.co_filename.startswith(str(ROOT)):
            path = Path(frame.f_code.co_filename).relative_to(ROOT)
            found.append((path, frame.f_code.co_qualname.split(".<locals>")[0]))
        frame = frame.f_back
    return {place for place in found if place[0].parts[0] != "jaxtools"}


def walk(call):
    """(stays, files, climbs) of the system, or hybrid, during a call; and what runs when diffrax is called."""
    found, root, to_loop = {}, str(ROOT), set()

    def seen(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_name == "diffeqsolve" and not to_loop:
            to_loop.update(running(frame))
        if event != "call" or not code.co_filename.startswith(root):
            return
        for name in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]:
            if isinstance(frame.f_locals.get(name), lj.System | lj.Hybrid | Model):
                found.setdefault((Path(code.co_filename).relative_to(ROOT), code.co_name))

    sys.setprofile(seen)
    try:
        call()
    finally:
        sys.setprofile(None)
    files = [path for path, _ in found]
    floor = lambda path: FLOORS.index(path.parts[0]) if path.parts[0] in FLOORS else len(FLOORS)
    climbs = sum(floor(b) > floor(a) for a, b in zip(files, files[1:]))
    return len(found), len(set(files)), climbs, to_loop


def walks(wanted):
    """Rows about the ways of a system through the house: a mass on a rod, a pendulum, a ball on a floor."""
    rod = {"rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2)}
    of_mass = lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]
    mass, params, ts = lj.System(of_mass, rod), {"g": 9.81, "l": 1.0}, np.linspace(0.0, 1.0, 11)
    start, at_rest = {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}
    swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    floor = {"floor": lj.Contact(lambda t, q, params: q, restitution=0.5)}
    ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q, elements=floor)
    swung = lambda point: lj.integrate(swing, point["angle"], 0.0, params, ts=ts).q[-1]
    angles = {"angle": np.linspace(0.1, 1.0, 8)}
    measured = lj.Record(ts, q={"x": np.cos(2 * ts)}, q0=start, v0=at_rest)
    doors = {
        "integrate": (lambda: lj.integrate(mass, start, at_rest, params, ts=ts), 35, 6, 15),
        "fit": (lambda: lj.fit(mass, measured, params, free="g", progress=False), 60, None, 30),
        "sweep": (lambda: lj.sweep(swung, angles, progress=False), None, None, None),
        "contact": (lambda: lj.integrate(ball, 1.0, 0.0, params, ts=ts), None, None, None),
        "connect": (lambda: lj.connect(swing, 0.0, 1.0, 0.0, 1.0, params), None, None, None),
        "normal modes": (lambda: lj.normal_modes(mass, 0.0, {"x": 0.0, "y": -1.0}, at_rest, params), 35, None, 20),
        "periodic orbit": (lambda: lj.periodic_orbit(swing, (1.0, 0.0), 2.1, params), None, None, None),
    }
    for name, (call, most, most_climbs, most_returns) in doors.items():
        if not wanted(name):
            continue
        stays, files, climbs, to_loop = walk(call)
        yield row(f"{name}: stays", stays, most)
        yield row(f"{name}: climbs", climbs, most_climbs)
        yield row(f"{name}: returns", stays - files, most_returns)
        if name == "integrate":
            yield row("integrate: calls to diffeqsolve", len(to_loop), 8)
            yield row("integrate: files to diffeqsolve", len({path for path, _ in to_loop}), 4)


if __name__ == "__main__":
    main(lambda wanted: chain((line for line in source() if wanted(line["what"])), walks(wanted)), __doc__)
