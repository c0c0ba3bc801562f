"""The annotations are correct: the type checker finds no errors in the package and its tests."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiers import exhaustive_but

ROOT = Path(__file__).parent.parent
CHECKED = ("lagjax", "tests")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("basedpyright") is None,
        reason='the type checker is not installed. Fix: pip install "lagjax[test]"',
    ),
]


def checked(root, folders=()):
    """The result of the checker for a project or folders of it: the number of files, and errors, one a line."""
    root = root.resolve()
    # Without --pythonpath it uses the first interpreter on the path, which may have another version of JAX, or none.
    told = subprocess.run(
        [sys.executable, "-m", "basedpyright", "--level", "error", "--outputjson", "--pythonpath", sys.executable]
        + list(folders),
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


# The files of the tests take another minute.
@pytest.mark.parametrize("folders", exhaustive_but([CHECKED[:1]], [CHECKED[:1], ()]), ids=["package", "with its tests"])
def test_no_type_errors(folders):
    """Every file of the package, and with no folder given of its tests too, is read, and none has an error."""
    count, errors = checked(ROOT, folders)
    assert errors == [], "\n".join(errors)
    files = (ROOT.joinpath(folder).rglob(kind) for folder in folders or CHECKED for kind in ("*.py", "*.pyi"))
    assert count == sum(len(list(found)) for found in files)


def test_the_type_check_can_fail(tmp_path):
    """Twin: with the same settings a wrong return type in either folder, and a missing module, are found."""
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for folder in CHECKED:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "right.py").write_text("def length() -> float:\n    return 1.0\n")
        (tmp_path / folder / "wrong.py").write_text('import nowhere\n\ndef length() -> float:\n    return "1.0"\n')
    for folders in ((), CHECKED[:1]):
        count, errors = checked(tmp_path, folders)
        for folder in folders or CHECKED:
            about = [error for error in errors if error.startswith(f"{folder}/wrong.py")]
            assert len(about) == 2 and "nowhere" in about[0] and "reportReturnType" in about[1], errors
        assert count == len(errors) == 2 * len(folders or CHECKED)
