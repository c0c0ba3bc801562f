"""Whether programs compiled as one machine function run with this XLA and give right results.

XLA does not check what its marks promise: where it mishandles one it ends the process. So the trial runs in a process
of its own. Its outcome is remembered in the user's cache directory, in a file for each version.
"""

import contextlib
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jaxlib.version

# The version of the trial; the outcome of another version does not count.
TRIAL = 1
SECONDS = 300.0
PASSED, FAILED = "passed", "failed"
CODE = "import sys; sys.path[:] = {path!r}; from lagjax.jax_internals.trial_programs import main; main()"


def survives() -> bool:
    """Whether marked programs run and give right results: as remembered, or by a trial of a few seconds."""
    place = _outcome_file()
    with contextlib.suppress(OSError, UnicodeError):
        if (remembered := place.read_text()) in (PASSED, FAILED):
            return remembered == PASSED
    outcome = _run_trial()
    if outcome is not None:
        _remember(place, outcome)
    return outcome == PASSED


def _run_trial():
    """The outcome of a trial; None if it could not be run, which may differ in the next process."""
    # The marks are for CPUs, and this process may occupy another device.
    env = os.environ | {"LAGJAX_PLAIN": "0", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CODE.format(path=sys.path)]
    try:
        done = subprocess.run(command, env=env, capture_output=True, timeout=SECONDS, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return PASSED if done.returncode == 0 else FAILED


def _outcome_file():
    name = f"trial-{TRIAL}-jax-{jax.__version__}-jaxlib-{jaxlib.version.__version__}-{platform.machine()}"
    return _cache_directory() / name


def _cache_directory():
    if os.environ.get("XDG_CACHE_HOME"):
        base = Path(os.environ["XDG_CACHE_HOME"])
    elif sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        base = Path(os.environ["LOCALAPPDATA"])
    else:
        base = Path(os.path.expanduser("~/Library/Caches" if sys.platform == "darwin" else "~/.cache"))
    return base / "lagjax"


def _remember(place, outcome):
    """Write a temporary file and rename it, so that nobody reads half of it; ignore a disk that is read-only."""
    with contextlib.suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        number, path = tempfile.mkstemp(dir=place.parent)
        with os.fdopen(number, "w") as file:
            file.write(outcome)
        os.replace(path, place)
