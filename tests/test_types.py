"""The annotations are correct: the type checker finds no errors in the package and its tests."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CHECKED = ("lagjax", "tests")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("basedpyright") is None,
        reason='the type checker is not installed. Fix: pip install "lagjax[test]"',
    ),
]


def checked(root):
    """The result of the checker for a project: the number of files read, and its errors, one line each."""
    root = root.resolve()
    # Without --pythonpath it uses the first interpreter on the path, which may have another version of JAX, or none.
    told = subprocess.run(
        [sys.executable, "-m", "basedpyright", "--level", "error", "--outputjson", "--pythonpath", sys.executable],
        cwd=root, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode in (0, 1), told.stdout + told.stderr
    found = json.loads(told.stdout)
    errors = []
    for error in found["generalDiagnostics"]:
        path = Path(error["file"]).relative_to(root).as_posix()
        # Errors about a whole file, such as import cycles, have no range.
        line = error["range"]["start"]["line"] + 1 if "range" in error else 1
        errors.append(f"{path}:{line}: {error['message']} ({error.get('rule', 'syntax')})")
    return found["summary"]["filesAnalyzed"], errors


def test_no_type_errors():
    """Every file of the package and of its tests is read, and none has an error."""
    count, errors = checked(ROOT)
    assert errors == [], "\n".join(errors)
    assert count == sum(len(list((ROOT / folder).rglob(kind))) for folder in CHECKED for kind in ("*.py", "*.pyi"))


def test_the_type_check_can_fail(tmp_path):
    """Twin: with the same settings a wrong return type in either folder, and a missing module, are found."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for folder in CHECKED:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "right.py").write_text("def length() -> float:\n    return 1.0\n")
        (tmp_path / folder / "wrong.py").write_text('import nowhere\n\ndef length() -> float:\n    return "1.0"\n')
    count, errors = checked(tmp_path)
    assert count == 4
    for folder in CHECKED:
        about = [error for error in errors if error.startswith(f"{folder}/wrong.py")]
        assert len(about) == 2 and "nowhere" in about[0] and "reportReturnType" in about[1], errors
    assert len(errors) == 4
