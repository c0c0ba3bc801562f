"""Accuracy, speed and orders, from `benchmarks/results/*.json`: everything measured, missed targets included."""

import ast
import importlib.util
import json
from pathlib import Path

from written import clear, write

ROOT = Path(__file__).parents[2]
RESULTS, FOLDER = ROOT / "benchmarks" / "results", Path(__file__).parent.parent / "generated" / "measured"
INTRO = """# Accuracy and speed

All numbers come from `benchmarks/results/`, which the scripts in `benchmarks/` write; this page and those below it are
made from these files. Targets were set before measuring. Missed targets are listed here too.

## Error against run time

Milliseconds to reach an error; motions over tens of periods, default method, one core; errors of the last state against
closed forms (for the helix: against SciPy).

"""
ORDERS = """# Orders, as measured

The order of each method with constant steps, on outputs between its steps, from `benchmarks/results/orders.json`. The
slow tests assert the same, and must fail for tableaus with misprints: `tests/behaviour/test_orders.py`, and
`test_explicit.py` and `test_radau.py` in `tests/numerics/methods`.

| method | motion | claimed | measured | least error |
|---|---|---|---|---|
"""


def quote():
    """The module that makes the README's tables."""
    spec = importlib.util.spec_from_file_location("quote", ROOT / "benchmarks" / "quote.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def plain(text) -> str:
    """Text as a cell of a table in Markdown."""
    text = str(text)
    for mark in "\\|*_<>[]$`":
        text = text.replace(mark, "\\" + mark)
    return text


def line(row: dict) -> str:
    """One row of results as a row of a table."""
    if row["value"] is None:
        return f"| {plain(row['what'])} | not measured: {plain(row.get('skipped', ''))} | | |"
    target = row.get("target")
    asked = "" if target is None else f"{'≥' if row.get('better') == 'more' else '≤'} {target:.3g}"
    met = {None: "", True: "met", False: "**missed**"}[row.get("met")]
    return f"| {plain(row['what'])} | {row['value']:.3g} | {asked} | {met} |"


def table(rows: list[dict]) -> str:
    """Rows of results as a table."""
    return "\n".join(["| what | value | target | |", "|---|---|---|---|", *map(line, rows)]) + "\n"


def one_file(name: str, found: dict) -> str:
    """The page of one file of results, with the question of the script that wrote it as its title."""
    script = next((ROOT / "benchmarks").rglob(f"{name}.py"), None)
    question = ast.get_docstring(ast.parse(script.read_text())) or "" if script else ""
    versions = ", ".join(f"{package} {version}" for package, version in found.get("versions", {}).items())
    measured = f"Measured on {found['machine']}" + (f", {found['clock']}" if "clock" in found else "")
    title = question.split("\n")[0].rstrip(".") or name
    author = f" Written by `{script.relative_to(ROOT).as_posix()}`." if script else ""
    note = f" Note: {plain(found['note'].rstrip('.'))}." if "note" in found else ""
    later = f" Measured later than the rest: {plain(', '.join(found['later']))}." if "later" in found else ""
    said = f"{measured}{'; ' + versions if versions else ''}.{author}{note}{later}\n"
    return f"# {plain(title)}\n\n{said}\n{table(found['rows'])}"


def generate(app):
    """Write the pages."""
    files = {path.stem: json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))}
    for name, found in files.items():
        write(FOLDER / f"{name}.md", one_file(name, found))
    missed = {name: [row for row in found["rows"] if row.get("met") is False] for name, found in files.items()}
    quoted = quote()
    parts = [
        INTRO,
        quoted.accuracy(),
        "\n## Speed compared with others\n\nRatios of run times (of rates if the target is ≥) at",
    ]
    parts += [" equal error, one core, medians.\n\n", quoted.speed(), "\n## Missed targets\n\n"]
    total = sum(len(found["rows"]) for found in files.values())
    parts.append(f"{sum(map(len, missed.values()))} of {total} rows miss their target.\n\n")
    for name, rows in missed.items():
        if rows:
            parts.append(f"From [`{name}.json`]({name}.md):\n\n{table(rows)}\n")
    parts.append("## All measurements\n\n```{toctree}\n:maxdepth: 1\n\n" + "\n".join(files) + "\n```\n")
    write(FOLDER / "index.md", "".join(parts))
    clear(FOLDER, {"index.md"} | {f"{name}.md" for name in files})
    rows = files["orders"]["rows"] if "orders" in files else []
    body = [
        f"| `{r['method']}` | {r['form']} | {r['claimed']} | {r['order']:.2f} | {r['least_error']:.0e} |" for r in rows
    ]
    write(FOLDER.parent / "orders.md", ORDERS + "\n".join(body) + "\n")


def setup(app):
    """Generate before the sources are read."""
    app.connect("builder-inited", generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
