"""Warnings that show the user's line, however deep in the library or in JAX's tracing they arise."""

import os
import sys
import warnings
from pathlib import Path

import diffrax
import equinox as eqx
import jax

# The code between the user's line and here: warnings skip it.
PACKAGES = tuple(str(Path(str(module.__file__)).parent) + os.sep for module in (jax, eqx, diffrax))
BETWEEN = (*PACKAGES, __file__.rsplit("system", 1)[0])


def warn(words: str, category: type[Warning]) -> None:
    """Warn at the innermost line outside this library and the libraries that it calls."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(BETWEEN):
        frame = frame.f_back
    module, registry = frame.f_globals.get("__name__", "?"), frame.f_globals.setdefault("__warningregistry__", {})
    warnings.warn_explicit(words, category, frame.f_code.co_filename, frame.f_lineno, module, registry)
