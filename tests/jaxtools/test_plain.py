"""The fallback to plain JAX: when it is taken."""

import subprocess
import sys
import warnings

import jaxlib.version
import pytest

from lagjax.jaxtools import plain


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    """A process that has decided nothing, and an unknown jaxlib."""
    monkeypatch.setattr(plain, "_decided", [])
    monkeypatch.setattr(plain, "_WANTED", "")
    monkeypatch.setattr(plain, "KNOWN", {"0.0"})


@pytest.mark.parametrize(("wanted", "expected"), [("1", True), ("0", False)])
def test_the_variable_decides(monkeypatch, wanted, expected):
    """With the variable set there is no warning."""
    monkeypatch.setattr(plain, "_WANTED", wanted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plain.is_plain() is expected


def test_a_known_version_is_compiled_for_speed(monkeypatch):
    """In silence."""
    monkeypatch.setattr(plain, "KNOWN", {jaxlib.version.__version__})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plain.is_plain() is False


def test_an_unknown_version_is_plain():
    """With one warning, which names it."""
    with pytest.warns(UserWarning, match=f"jaxlib {jaxlib.version.__version__}(?s:.*)slower(?s:.*)LAGJAX_PLAIN=0"):
        assert plain.is_plain() is True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plain.is_plain() is True


def test_import_decides_nothing():
    """The first program decides; and the version that the tests run with is in the table."""
    code = (
        "import lagjax, jaxlib.version; from lagjax.jaxtools import plain\n"
        "assert not plain._decided and jaxlib.version.__version__ in plain.KNOWN"
    )
    subprocess.run([sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}"], check=True)
