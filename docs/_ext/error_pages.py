"""The page of every error message and warning of lagjax, read from its code: grouped by theme, with a link to each.

A message has three parts: what happened, the usual cause, the fix. The page shows an ellipsis for numbers and names
that are inserted.
"""

import ast
import inspect
import re
from pathlib import Path

from written import write

import lagjax
from lagjax import refusals

ROOT = Path(lagjax.__file__).parent
PAGE = Path(__file__).parent.parent / "generated" / "errors.md"
# Folder or module, and its theme; the first match counts.
THEMES = {
    "guards": "Phases, contacts and impacts",
    "integrate/solve/phases": "Phases, contacts and impacts",
    "integrate/solve/legs": "Phases, contacts and impacts",
    "integrate/elements": "Phases, contacts and impacts",
    "integrate/meeting": "Phases, contacts and impacts",
    "integrate/solve/segments": "Phases, contacts and impacts",
    "integrate/events": "Events and sections",
    "analysis/poincare": "Events and sections",
    "analysis/energy": "Energy and conserved quantities",
    "mechanics/noether": "Energy and conserved quantities",
    "mechanics/constrained_state": "States and constraints",
    "system/constraints": "States and constraints",
    "system": "A system and its Lagrangian",
    "mechanics": "A system and its Lagrangian",
    "integrate": "Motion",
    "numerics": "Motion",
    "jaxtools": "Motion",
    "analysis": "Analysis of a system",
    "sweep": "Sweeps",
    "fit": "Fits",
    "learned": "Learned models",
    "work_precision": "Error against run time",
    "exchange": "Import and export",
    "files": "Import and export",
    "sliders": "Sliders",
    "display": "Pictures",
}
ORDER = list(dict.fromkeys([*("A system and its Lagrangian", "States and constraints", "Motion"), *THEMES.values()]))
ELSEWHERE = "Elsewhere"
INTRO = """# What went wrong

Every message that lagjax can give, as written in the code: what happened, the usual cause, the fix. Search this page
(or the site) for words of your message; `…` stands for names and numbers of your system. Errors are raised outside of
`jit`, where values are known; in a batch or a sweep a failed motion records its reason in `traj.result` or
`swept.status` instead.

"""


def text_of(node: ast.expr) -> str | None:
    """A string expression as text, with an ellipsis for inserted values; None if it is not a string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or "…" for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return "…"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        parts = [text_of(node.left), text_of(node.right)]
        return None if parts == [None, None] else "".join(part or "…" for part in parts)
    if isinstance(node, ast.IfExp):
        return text_of(node.body) or text_of(node.orelse)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "format":
        found = text_of(node.func.value)
        return found and re.sub(r"\{[^{}]*\}", "…", found)
    return None


# What the rules of `lagjax/refusals.py` say first, of their arguments; cause and fix follow.
RULES = {
    "must": "{claim}, not ….", "must_be": "{claim}, not ….", "must_be_among": "{role} must be one of …, not ….",
    "must_be_function": "{role} must be a function of {takes}, not ….",
    "must_return": "{call} must return {wanted}, and returned ….",
    "must_be_whole": "{role} must be a whole number …, not ….", "must_be_finite": "there is NaN or infinity in {role}.",
    "must_be_like": "{role} must be like {of}, in structure and shapes: {of} has …, and it has ….",
    "must_be_single": "{what} is a batch of shape …: take one lane of it.",
    "must_have_values": "{what}, and JAX is tracing.",
    "must_differ": "{what} are called ….",
    "must_name": "{what} …, which is no {kind}; there are ….", "must_not_meet": "… exclude each other: {why}.",
    "must_go_together": "… is given, but … is not: {why}.", "installed": "{user} needs {module}, an optional extra.",
}  # fmt: skip
TYPE_ERRORS = ("must_be", "must_be_function", "must_have_values")


def refusal(call: ast.Call, tree: ast.Module) -> tuple[str, str]:
    """(kind, text) of a message that a rule gives; texts may be assigned to names before the call."""
    assigned = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and node.lineno < call.lineno:
            target, value = node.targets[0], node.value
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            for name, text in zip(target.elts, value.elts) if several else [(target, value)]:
                assigned[ast.unparse(name)] = max(assigned.get(ast.unparse(name), (0, None)), (node.lineno, text))
    rule = ast.unparse(call.func)
    bound = inspect.signature(getattr(refusals, rule)).bind(*call.args, **{x.arg: x.value for x in call.keywords})
    arguments = {name: assigned.get(ast.unparse(x), (0, x))[1] for name, x in bound.arguments.items()}
    kind = "ImportError" if rule == "installed" else "TypeError" if rule in TYPE_ERRORS else "ValueError"
    kind = ast.unparse(arguments.pop("error")) if "error" in arguments else kind
    texts = {name: text_of(x) or "…" for name, x in arguments.items()}
    parts = (("Usual cause", texts.get("cause")), ("Fix", texts.get("fix")))
    return kind, RULES[rule].format(**texts) + "".join(f"\n{name}: {text}." for name, text in parts if text)


def telling(text: str) -> str:
    """The first line of a message with words of its own, not only inserted text; empty if there is none."""
    lines = [re.sub("^…?(Usual cause|Fix): …?", "", line) for line in text.split("\n")]
    return next((line for line in lines if len(re.findall("[a-z]{3,}", line)) > 1), "").strip()


def kind_of(node: ast.Call) -> str:
    """`ValueError`, or the category of a warning."""
    if isinstance(node.func, ast.Name):
        return node.func.id
    named = [a for a in [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "category")]]
    return ast.unparse(named[0]) if named else "UserWarning"


def messages(source: str) -> list[tuple[str, str]]:
    """(kind, text) of each message in a module: raised, warned of, or built in one function and raised elsewhere."""
    found, known = [], set()

    def add(kind, text):
        text = text and re.sub(r"…(?:\s?…)+", "…", text).strip()
        text = text and text.replace("Usual cause: ….", "Usual cause: one of several, which the message names.")
        if text and telling(text) and text not in known:
            known.add(text)
            found.append((kind, text))

    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {
        id(node.body[0].value) for node in ast.walk(tree) if isinstance(node, documented) and ast.get_docstring(node)
    }
    inside: set[int] = set()
    for node in ast.walk(tree):
        call = node.exc if isinstance(node, ast.Raise) else node
        raised = isinstance(node, ast.Raise) and isinstance(call, ast.Call)
        warned = isinstance(call, ast.Call) and ast.unparse(call.func) in ("warnings.warn", "warn")
        if isinstance(call, ast.Call) and ast.unparse(call.func) in RULES:
            add(*refusal(call, tree))
        if (raised or warned) and call.args:
            add(kind_of(call), text_of(call.args[0]))
            inside |= {id(part) for part in ast.walk(call)}
    for node in ast.walk(tree):
        if (
            id(node) in inside
            or id(node) in docstrings
            or not isinstance(node, (ast.Constant, ast.JoinedStr, ast.BinOp))
        ):
            continue
        text = text_of(node)
        if text and "\nFix:" in text:
            add("", text)
            inside |= {id(part) for part in ast.walk(node)}
    return found


def theme_of(module: str) -> str:
    """The heading above the messages of a module."""
    return next((theme for begin, theme in THEMES.items() if module.startswith(begin)), ELSEWHERE)


def anchor(text: str, taken: set[str]) -> str:
    """An anchor name for a message, which does not change as long as its first words do not."""
    words = re.findall(r"[a-z0-9]+", text.lower())[:7]
    name = base = "-".join(words)
    number = 2
    while name in taken:
        name, number = f"{base}-{number}", number + 1
    taken.add(name)
    return name


def title(line: str) -> str:
    """The first sentence of a message, shortened to a line or two."""
    parts = re.split(r"(?<=[a-z)'…])([.:;] )", line)
    ends = (i for i in range(1, len(parts) + 1, 2) if len(re.findall("[a-z]{3,}", "".join(parts[:i]))) > 2)
    short = "".join(parts[: next(ends, len(parts))]).rstrip(":.")
    return short if len(short) <= 130 else short[:130].rsplit(" ", 1)[0] + " …"


def entry(kind: str, text: str, taken: set[str]) -> str:
    """One message as Markdown: its first line with words of its own is the heading."""
    first = telling(text)
    name = anchor(first, taken)
    # Escape characters that Markdown would read as code or a formula.
    heading = re.sub(r"([\\`*_{}\[\]<>#$|])", r"\\\1", title(first))
    shown = f"```text\n{kind + ': ' if kind else ''}{text}\n```\n"
    return f"({name})=\n### {heading}\n\n{shown}"


def page(files: str = "**/*.py") -> str:
    """The whole page, or its part of some files."""
    by_theme: dict[str, list[tuple[str, str]]] = {}
    for path in sorted(ROOT.glob(files)):
        module = str(path.relative_to(ROOT).with_suffix(""))
        if module.startswith(("scenes", "mechanisms", "stability", "report", "refusals", "job", "__")):
            continue
        by_theme.setdefault(theme_of(module), []).extend(messages(path.read_text()))
    taken: set[str] = set()
    parts = [INTRO]
    for theme in [*ORDER, ELSEWHERE]:
        if found := by_theme.get(theme):
            parts.append(f"## {theme}\n")
            parts += [entry(kind, text, taken) for kind, text in found]
    return "\n".join(parts)


def setup(app):
    """Generate before the sources are read."""
    app.connect("builder-inited", lambda app: write(PAGE, page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
