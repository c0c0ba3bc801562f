"""The fallback to plain JAX: when it is taken."""

import subprocess
import sys
import warnings

import jaxlib.version
import pytest

from lagjax.jaxtools import tracing


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    """A process that has decided nothing, and an unknown jaxlib."""
    monkeypatch.setattr(tracing, "_decided", [])
    monkeypatch.setattr(tracing, "_WANTED", "")
    monkeypatch.setattr(tracing, "KNOWN", {"0.0"})


@pytest.mark.parametrize(
    ("wanted", "known", "expected"), [("1", "0.0", True), ("0", "0.0", False), ("", jaxlib.version.__version__, False)]
)
def test_in_silence(monkeypatch, wanted, known, expected):
    """With the variable set, or a known version, which is compiled for speed, there is no warning."""
    monkeypatch.setattr(tracing, "_WANTED", wanted)
    monkeypatch.setattr(tracing, "KNOWN", {known})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tracing.is_plain() is expected


def test_an_unknown_version_is_plain():
    """With one warning, which names it."""
    with pytest.warns(UserWarning, match=f"jaxlib {jaxlib.version.__version__}(?s:.*)slower(?s:.*)LAGJAX_PLAIN=0"):
        assert tracing.is_plain() is True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tracing.is_plain() is True


def test_import_decides_nothing():
    """The first program decides; and the version that the tests run with is in the table."""
    code = (
        "import lagjax, jaxlib.version; from lagjax.jaxtools import tracing\n"
        "assert not tracing._decided and jaxlib.version.__version__ in tracing.KNOWN"
    )
    subprocess.run([sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}"], check=True)
