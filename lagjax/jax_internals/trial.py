"""Whether programs that are compiled as one machine function survive with this XLA, and are right.

XLA does not check what its marks promise: where it takes one amiss it ends the process. So the trial runs in a process
of its own. What came of it is remembered, a file for each version, in the user's cache directory.
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

# The number of the trial below; another one is not what was remembered.
TRIAL = 1
SECONDS = 300.0
PASSED, FAILED = "passed", "failed"
CODE = "import sys; sys.path[:] = {path!r}; from lagjax.jax_internals.trial_programs import main; main()"


def survives() -> bool:
    """Whether marked programs survive and are right: as remembered, or by a trial of a few seconds."""
    place = _remembered_at()
    with contextlib.suppress(OSError, UnicodeError):
        if (told := place.read_text()) in (PASSED, FAILED):
            return told == PASSED
    outcome = _tried()
    if outcome is not None:
        _remember(place, outcome)
    return outcome == PASSED


def _tried():
    """What came of a trial; None where none could be held, which the next process may find otherwise."""
    # The marks are for CPUs, and another device may be taken by this process.
    env = os.environ | {"LAGJAX_PLAIN": "0", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CODE.format(path=sys.path)]
    try:
        done = subprocess.run(command, env=env, capture_output=True, timeout=SECONDS, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return PASSED if done.returncode == 0 else FAILED


def _remembered_at():
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
    """Write it beside and rename, so that nobody reads half of it; a disk that cannot be written to is no matter."""
    with contextlib.suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        number, path = tempfile.mkstemp(dir=place.parent)
        with os.fdopen(number, "w") as file:
            file.write(outcome)
        os.replace(path, place)
