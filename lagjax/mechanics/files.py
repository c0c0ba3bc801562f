"""Files of the library: an npz of NumPy, whose first entry says in JSON what the arrays are.

Each entry has a checksum, which zip files have anyway. A file is written under another name beside its own and then
renamed: who is killed leaves the file of before. `numpy.load(path)` reads the arrays, by their names, without lagjax.
"""

import io
import json
import os
import uuid
import zipfile
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

FORMAT = 1
HEADER = "lagjax.json"
# The kinds of files, with the function that reads each.
KINDS = {"trajectory": "lj.load_trajectory", "fit": "lj.load_fit"}
# What zip, zlib, JSON and NumPy raise for files that are not what they were.
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError, NotImplementedError, OSError)


def write(path: str | os.PathLike, kind: str, said: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write a file, or leave the one that is there."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f'{path} is a folder.\nFix: a name in it, "{path / (kind + ".npz")}".')
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent}.\nFix: make it first: os.makedirs(...).")
    header = {"format": FORMAT, "kind": kind, "versions": _versions(), **said}
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        with open(partial, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as entries:
                entries.writestr(HEADER, json.dumps(header, allow_nan=False))
                for name, x in arrays.items():
                    with entries.open(f"{name}.npy", "w", force_zip64=True) as entry:
                        np.lib.format.write_array(entry, np.asanyarray(x), allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read(path: str | os.PathLike, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(what a file says, its arrays).

    **Raises:** `FileNotFoundError` where there is none; `ValueError`, in words, for a file that is damaged, of another
    kind, of something else, or of a newer lagjax.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.\nFix: the path that was given to .save(path).")
    try:
        return _read(path, kind)
    except _Told as told:
        raise ValueError(str(told)) from None


def _read(path, kind):
    if not zipfile.is_zipfile(path):
        with open(path, "rb") as file:
            if file.read(2) != b"PK":
                _raise_foreign(path, kind)
        raise_damaged(path, "its end is missing")
    try:
        with zipfile.ZipFile(path) as entries:
            if HEADER not in entries.namelist():
                _raise_foreign(path, kind)
            header = json.loads(entries.read(HEADER))
            _check_header(path, header, kind)
            arrays = {name.removesuffix(".npy"): _array(entries, name) for name in entries.namelist() if name != HEADER}
    except _Told:
        raise
    except DAMAGED as error:
        raise_damaged(path, str(error) or type(error).__name__, error)
    return header, arrays


class _Told(ValueError):
    """What is said already."""


def _array(entries, name):
    # At once: NumPy reads a compressed entry, or one of a zip, in small pieces.
    return np.lib.format.read_array(io.BytesIO(entries.read(name)), allow_pickle=False)


def _check_header(path, header, kind):
    if header["format"] > FORMAT:
        raise _Told(
            f"{path} was written by lagjax {header['versions']['lagjax']}, whose files this one, "
            f"{version('lagjax')}, does not read.\nFix: pip install -U lagjax."
        )
    if header["kind"] != kind:
        raise _Told(f"{path} holds a {header['kind']}, not a {kind}.\nFix: {KINDS[header['kind']]}(path).")


def _raise_foreign(path, kind) -> NoReturn:
    raise _Told(f"{path} is no {kind} of lagjax's.\nFix: the path that was given to .save(path).")


def raise_damaged(path, why: str, error: Exception | None = None) -> NoReturn:
    """Raise `ValueError` for a file that is not what it was."""
    raise ValueError(
        f"{path} is damaged: {why}.\n"
        "Usual cause: a copy that was cut short, or a disk that failed.\n"
        "Fix: copy it again, or compute it again."
    ) from error


def _versions():
    return {name: version(name) for name in ("lagjax", "jax", "diffrax")}
