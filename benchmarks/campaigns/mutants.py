"""Would the tests notice? The source is broken in one place at a time, and its tests run until one of them fails.

A mutant changes one place of `lagjax/`: a sign, a dropped term, a constant, `<` for `<=` or `==` for `!=`, two swapped
arguments, a removed refusal. Places are chosen at random, each kind as often as the others. `map` runs the fast tests
once and writes which functions each of them calls and how long it takes; `try` breaks each place in a copy of the tree
and runs the tests that call its function: those of its own file first, then those of its room, then the others, the
quick before the slow, for some seconds. What takes longer is "out of time", which is no verdict. The mutants of an
earlier result are tried again by `--same`, where their line is still there, so two states of the tests can be compared.

    python -m benchmarks.campaigns.mutants map WHERE.json
    python -m benchmarks.campaigns.mutants try WHERE.json [--count 150] [--seed 0] [--same FILE] [--json FILE]
"""

import argparse
import ast
import builtins
import importlib.abc
import importlib.machinery
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

# Whatever lagjax imports is imported here, once, and no backend of JAX: copies of this process run the tests.
import diffrax  # noqa: F401
import optimistix  # noqa: F401
import pytest
import scipy.optimize  # noqa: F401

ROOT = Path(__file__).parents[2]
CALLED: set[str] = set()
CAUGHT, SURVIVED, OUT_OF_TIME, NO_VERDICT = "caught", "survived", "out of time", "no verdict"
# By pytest's exit status: all passed, some failed, an error on the way to the tests, such as of an import.
VERDICTS = {0: SURVIVED, 1: CAUGHT, 2: CAUGHT, 3: CAUGHT}
SWAPPED = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="),
}  # fmt: skip


class Mutant(NamedTuple):
    """A place and what stands there instead; `line` is the whole text of the statement's first line, to find it by."""

    kind: str
    path: str
    function: str
    lineno: int
    line: str
    start: int
    end: int
    old: str
    new: str


# Places.


def mutants_of(path: str, source: str) -> list[Mutant]:
    """All mutants of a file."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for text in lines:
        starts.append(starts[-1] + len(text.encode()))
    raw, found = source.encode(), []

    def span(node):
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    def add(kind, function, node, start, end, new):
        old, line = raw[start:end].decode(), lines[node.lineno - 1]
        found.append(Mutant(kind, path, function, node.lineno, line, start, end, old, new))

    def visit(node, names):
        function = ".".join(names)
        if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
            (_, left_end), (right, _), (start, end) = span(node.left), span(node.right), span(node)
            between = raw[left_end:right].decode()
            swapped = between.translate({ord("+"): "-", ord("-"): "+"})
            add("sign", function, node, left_end, right, swapped)
            add("dropped term", function, node, start, end, raw[start:left_end].decode() + ")" * between.count(")"))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            add("sign", function, node, *span(node), raw[slice(*span(node.operand))].decode())
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            new = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + (node.value == 0)
            add("constant", function, node, *span(node), repr(new))
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
            (_, start), (end, _) = span(node.left), span(node.comparators[0])
            old, new = SWAPPED[type(node.ops[0])]
            add("comparison", function, node, start, end, raw[start:end].decode().replace(old, new, 1))
        elif isinstance(node, ast.Call) and len(node.args) > 1 and ast.Starred not in map(type, node.args):
            (start, a), (b, end) = span(node.args[0]), span(node.args[1])
            one, other = raw[start:a].decode(), raw[b:end].decode()
            if one != other:
                add("arguments", function, node, start, end, other + raw[a:b].decode() + one)
        elif isinstance(node, ast.Raise):
            add("refusal", function, node, *span(node), "pass")
        for child in ast.iter_child_nodes(node):
            if not isinstance(node, ast.arguments | ast.JoinedStr):
                inner = isinstance(child, ast.FunctionDef | ast.ClassDef)
                visit(child, (*names, child.name) if inner else names)

    visit(ast.parse(source), ())
    return found


def mutated(source: str, mutant: Mutant) -> str:
    """The broken source."""
    raw = source.encode()
    return (raw[: mutant.start] + mutant.new.encode() + raw[mutant.end :]).decode()


def compiles(source: str) -> bool:
    """Whether a source is Python."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def chosen(count: int, seed: int) -> list[Mutant]:
    """Mutants at random, as many of each kind."""
    by_kind: dict[str, list[Mutant]] = {}
    for path in sorted((ROOT / "lagjax").rglob("*.py")):
        for mutant in mutants_of(path.relative_to(ROOT).as_posix(), path.read_text()):
            by_kind.setdefault(mutant.kind, []).append(mutant)
    rng = random.Random(seed)
    for mutants in by_kind.values():
        rng.shuffle(mutants)
    drawn = [
        [m for m in mutants[: 2 * count] if compiles(mutated((ROOT / m.path).read_text(), m))]
        for _, mutants in sorted(by_kind.items())
    ]
    return [mutant for of_each in zip(*drawn) for mutant in of_each][:count]


def found_again(mutant: Mutant) -> Mutant | None:
    """The same mutant in today's source, of several the nearest; None where its line is not there."""
    path = ROOT / mutant.path
    if not path.exists():
        return None
    wanted = mutant.kind, mutant.function, mutant.line, mutant.old, mutant.new
    same = [
        other for other in mutants_of(mutant.path, path.read_text())
        if (other.kind, other.function, other.line, other.old, other.new) == wanted
    ]  # fmt: skip
    return min(same, key=lambda other: abs(other.start - mutant.start), default=None)


# Which tests call what: a plugin of pytest.


class Listening(importlib.machinery.SourceFileLoader):
    """Adds to each function of lagjax a line that says it was called."""

    def get_code(self, fullname):
        path = self.get_filename(fullname)
        tree, name = ast.parse(self.get_data(path)), Path(path).relative_to(ROOT).as_posix()

        def visit(node, names):
            for child in ast.iter_child_nodes(node):
                inner = (*names, child.name) if isinstance(child, ast.FunctionDef | ast.ClassDef) else names
                visit(child, inner)
                if isinstance(child, ast.FunctionDef):
                    said = ast.parse(f"__called__.add({name + ':' + '.'.join(inner)!r})").body[0]
                    for part in ast.walk(said):
                        ast.copy_location(part, child)
                    child.body.insert(int(ast.get_docstring(child) is not None), said)

        visit(tree, ())
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)


class Finder(importlib.abc.MetaPathFinder):
    """Loads lagjax by `Listening`."""

    def find_spec(self, fullname, path, target=None):
        spec = importlib.machinery.PathFinder.find_spec(fullname, path) if fullname.split(".")[0] == "lagjax" else None
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = Listening(spec.loader.name, spec.loader.path)
        return spec


# What a fixture calls belongs to every test that asks for it.
OF_FIXTURES: dict[str, set[str]] = {}


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef, request):
    """Keep what a shared fixture calls."""
    before = set(CALLED)
    CALLED.clear()
    yield
    if fixturedef.scope != "function":
        OF_FIXTURES.setdefault(f"{fixturedef.baseid}:{fixturedef.argname}", set()).update(CALLED)
    CALLED.update(before)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Write what a test calls, and its seconds."""
    CALLED.clear()
    started = time.process_time()
    yield
    names = getattr(item, "fixturenames", ())
    shared = [called for key, called in OF_FIXTURES.items() if key.rpartition(":")[2] in names]
    row = {"test": item.nodeid, "seconds": time.process_time() - started, "calls": sorted(CALLED.union(*shared))}
    with open(f"{os.environ['LAGJAX_CALLED']}.{os.getpid()}", "a") as file:
        file.write(json.dumps(row) + "\n")


def listen():
    """Listen to lagjax from here on."""
    builtins.__called__ = CALLED
    sys.meta_path.insert(0, Finder())


if os.environ.get("LAGJAX_CALLED") and "lagjax" not in sys.modules:
    listen()


def write_map(where: Path):
    """Run the fast tests and write what each calls."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"LAGJAX_CALLED": f"{folder}/called"}
        subprocess.run([sys.executable, "-m", "pytest", "-p", __spec__.name], cwd=ROOT, env=environment)
        rows = [json.loads(line) for file in Path(folder).iterdir() for line in file.read_text().splitlines()]
    where.write_text("\n".join(json.dumps(row) for row in rows))


# Trials.


def tests_for(mutant: Mutant, rows: list[dict]) -> list[str]:
    """The tests that call the mutant's function, in the order in which they are tried; for a module's own code, which
    nobody calls, those of its room."""
    _, room, *rest = Path(mutant.path).with_suffix("").parts
    own = f"tests/{'/'.join([room, *rest[:-1]])}/test_{rest[-1]}.py" if rest else f"tests/test_{room}.py"
    called = f"{mutant.path}:{mutant.function}"
    of_room = f"tests/{room}/", f"lagjax/{room}/"
    inside = [row for row in rows if called in row["calls"]]
    if not inside:
        inside = [row for row in rows if row["test"].startswith((own, *of_room))]
    rank = lambda row: (not row["test"].startswith(own), not row["test"].startswith(of_room), row["seconds"])
    return [row["test"] for row in sorted(inside, key=rank)]


def run_tests(folder: Path, tests: list[str], said: Path):
    """In a process of its own: pytest over some tests; what it prints goes to a file."""
    os.setsid()
    os.chdir(folder)
    with open(said, "w") as file:
        os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)
    os.environ.update(PYTHONDONTWRITEBYTECODE="1", OPENBLAS_NUM_THREADS="1")
    sys.path[:0] = [str(folder)]
    sys.modules.pop("benchmarks", None)
    # Some of what was imported above is a plugin too.
    quiet = "-W", "ignore::pytest.PytestAssertRewriteWarning"
    os._exit(int(pytest.main(["-x", "-n", "0", "--tb=line", *quiet, *tests])))


def in_words(mutant: Mutant) -> str:
    """Where it is, and what is changed."""
    return f"{mutant.path}:{mutant.lineno}  {mutant.old!r} -> {mutant.new!r}"


def identity(row: dict) -> tuple:
    """By what a mutant is known in another result."""
    return tuple(row[name] for name in ("path", "function", "line", "kind", "old", "new"))


def tried(mutant: Mutant, folder: Path, rows: list[dict], seconds: float) -> dict:
    """The verdict on a mutant, and the test that caught it."""
    tests, started = tests_for(mutant, rows), time.perf_counter()
    said, target = folder.with_suffix(".txt"), folder / mutant.path
    whole = target.read_text()
    verdict, by = SURVIVED, ""
    target.write_text(mutated(whole, mutant))
    try:
        if tests:
            child = multiprocessing.get_context("fork").Process(target=run_tests, args=(folder, tests[:400], said))
            child.start()
            child.join(seconds)
            verdict = OUT_OF_TIME if child.is_alive() else VERDICTS.get(child.exitcode, NO_VERDICT)
            if child.is_alive():
                os.killpg(child.pid, signal.SIGKILL)
                child.join()
            if verdict in (CAUGHT, NO_VERDICT):
                failed = [line for line in said.read_text().splitlines() if line.startswith(("FAILED", "ERROR"))]
                by = failed[0][:200] if failed else said.read_text()[-200:]
                verdict = CAUGHT if failed else NO_VERDICT
    finally:
        target.write_text(whole)
    took = time.perf_counter() - started
    print(f"{verdict:12} {took:5.0f} s  {mutant.kind:13} {in_words(mutant)}", flush=True)
    return {**mutant._asdict(), "verdict": verdict, "by": by, "tests": len(tests), "seconds": round(took, 1)}


def try_all(mutants: list[Mutant], rows: list[dict], seconds: float, at_once: int, written: Path | None) -> list[dict]:
    """All verdicts, each written at once; each worker has a copy of the tree."""
    with tempfile.TemporaryDirectory() as home:
        free: Queue = Queue()
        for i in range(at_once):
            left_out = shutil.ignore_patterns(".git", ".venv", "lagjax-report", "_build", "__pycache__", "*.ipynb")
            shutil.copytree(ROOT, Path(home) / f"tree{i}", ignore=left_out)
            free.put(Path(home) / f"tree{i}")

        found: list[dict] = []

        def one(mutant):
            folder = free.get()
            try:
                found.append(tried(mutant, folder, rows, seconds))
            finally:
                free.put(folder)
            if written:
                written.write_text(json.dumps(found, indent=1))

        with ThreadPoolExecutor(at_once) as pool:
            list(pool.map(one, mutants))
        return found


def main():
    """Map, or try."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("map", "try"))
    parser.add_argument("where", type=Path)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--same", type=Path, help="a result whose mutants are tried again")
    parser.add_argument("--seconds", type=float, default=90.0, help="for the tests of one mutant")
    parser.add_argument("--at-once", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.what == "map":
        return write_map(options.where)
    rows = [json.loads(line) for line in options.where.read_text().splitlines()]
    rows = [row | {"calls": set(row["calls"])} for row in rows]
    if options.same:
        earlier = json.loads(options.same.read_text())
        known = [Mutant(**{name: row[name] for name in Mutant._fields}) for row in earlier]
        mutants = [mutant for mutant in map(found_again, known) if mutant is not None]
        print(f"{len(mutants)} of {len(known)} mutants are still there")
    else:
        mutants = chosen(options.count, options.seed)
    found = try_all(mutants, rows, options.seconds, options.at_once, options.json)
    print(Counter(row["verdict"] for row in found))
    if options.same:
        before = {identity(row): row["verdict"] for row in earlier}
        for row in found:
            if (was := before[identity(row)]) != row["verdict"]:
                print(f"{was} before, {row['verdict']} now: {in_words(Mutant(*list(row.values())[:9]))}")


if __name__ == "__main__":
    sys.exit(main())
