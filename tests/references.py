"""Reference values to 22 or more digits (mpmath), by key, from `reference.json`."""

import json
from pathlib import Path

_VALUES = json.loads((Path(__file__).parent / "reference.json").read_text())


def reference(key: str) -> float:
    """The value of a key as the nearest double."""
    return float(_VALUES[key]["value"])


def reference_inputs(key: str) -> list[float]:
    """A list of input numbers."""
    return [float(x) for x in _VALUES[key]["value"]]


def keys(prefix: str) -> list[str]:
    """All keys that begin with `prefix`."""
    return [key for key in _VALUES if key.startswith(prefix)]
