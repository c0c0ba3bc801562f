"""lagjax's files: NumPy npz files whose first entry says in JSON what the arrays are.

The zip format gives each entry a checksum. A file is written under a temporary name in the same folder, and then
renamed: if the process is killed, the previous file remains. `numpy.load(path)` reads the arrays without lagjax.
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
# What zip, zlib, JSON and NumPy raise for damaged files.
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError, NotImplementedError, OSError)


def write(path: str | os.PathLike, kind: str, description: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write a file; if that fails, an existing file stays as it was."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f'{path} is a folder.\nFix: give the name of a file in it, "{path / (kind + ".npz")}".')
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent}.\nFix: make it first: os.makedirs(...).")
    header = {"format": FORMAT, "kind": kind, "versions": _versions(), **description}
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
    """Return the header of a file and its arrays.

    **Raises:** `FileNotFoundError` where there is none; `ValueError` for a file that is damaged, not lagjax's, of
    another kind, or written by a newer lagjax.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.\nFix: the path that was given to .save(path).")
    try:
        return _read(path, kind)
    except _Explained as explained:
        raise ValueError(str(explained)) from None


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
    except _Explained:
        raise
    except DAMAGED as error:
        raise_damaged(path, str(error) or type(error).__name__, error)
    return header, arrays


class _Explained(ValueError):
    """An error whose message is complete."""


def _array(entries, name):
    # Read the whole entry first: NumPy would read it from the zip in small pieces.
    return np.lib.format.read_array(io.BytesIO(entries.read(name)), allow_pickle=False)


def _check_header(path, header, kind):
    if header["format"] > FORMAT:
        raise _Explained(
            f"{path} was written by lagjax {header['versions']['lagjax']}, and this one, "
            f"{version('lagjax')}, cannot read it.\nFix: pip install -U lagjax."
        )
    if header["kind"] != kind:
        raise _Explained(f"{path} holds a {header['kind']}, not a {kind}.\nFix: {KINDS[header['kind']]}(path).")


def _raise_foreign(path, kind) -> NoReturn:
    raise _Explained(f"{path} is not a {kind} saved by lagjax.\nFix: the path that was given to .save(path).")


def raise_damaged(path, why: str, error: Exception | None = None) -> NoReturn:
    """Raise `ValueError` for a damaged file."""
    raise ValueError(
        f"{path} is damaged: {why}.\n"
        "Usual cause: a copy that was cut short, or a disk that failed.\n"
        "Fix: copy it again, or compute it again."
    ) from error


def _versions():
    return {name: version(name) for name in ("lagjax", "jax", "diffrax")}
