"""lagjax's files: NumPy npz files whose first entry says in JSON what the arrays are.

The zip format gives each entry a checksum. A file is written under a temporary name in the same folder, and then
renamed: if the process is killed, the previous file remains. `numpy.load(path)` reads the arrays without lagjax.

A file that is read may come from anyone. Its entries are not compressed, and each array fills its entry and is read
once: so reading takes as much memory as the file has bytes, besides one array at a time.
"""

import json
import math
import os
import uuid
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from tokenize import TokenError
from typing import Any, NoReturn

import numpy as np

from lagjax.display import by_line
from lagjax.files.tree_json import KINDS_OF_ARRAY

FORMAT = 1
HEADER = "lagjax.json"
# The kinds of files, with the function that reads each.
KINDS = {"trajectory": "lj.load_trajectory", "fit": "lj.load_fit"}
# A description has at most this many bytes: numbers in bulk belong in arrays. Arrays are read in pieces.
MOST_DESCRIPTION, PIECE = 4_000_000, 1 << 20
# What zip, zlib, NumPy and the operating system raise for damaged files, and Python for a malformed description.
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, SyntaxError, MemoryError, TokenError)
MALFORMED = (LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, StopIteration, AssertionError)


def write(path: str | os.PathLike, kind: str, description: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write a file; if that fails, an existing file stays as it was."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f'{path} is a folder.\nFix: give the name of a file in it, "{path / (kind + ".npz")}".')
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent}.\nFix: make it first: os.makedirs(...).")
    versions = {name: version(name) for name in ("lagjax", "jax", "diffrax")}
    header = {"format": FORMAT, "kind": kind, "versions": versions, **description}
    said = json.dumps(header, allow_nan=False)
    if len(said) > MOST_DESCRIPTION:
        raise ValueError(
            f"the description of this {kind} has {len(said):,} bytes, and may have {MOST_DESCRIPTION:,}.\n"
            "Usual cause: very many single numbers in params.\nFix: arrays of them."
        )
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        with open(partial, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as entries:
                entries.writestr(HEADER, said)
                for name, x in arrays.items():
                    with entries.open(f"{name}.npy", "w", force_zip64=True) as entry:
                        np.lib.format.write_array(entry, np.asanyarray(x), allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def opened(path: str | os.PathLike, kind: str) -> Iterator[tuple[dict[str, Any], Callable[[str], np.ndarray]]]:
    """Open a file: its header, and a function that reads an array by name, once.

    **Raises:** `FileNotFoundError` where there is none; `ValueError` for a file that is damaged, not lagjax's, of
    another kind, or written by a newer lagjax. In the same words, for whatever goes wrong inside of `with`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}.\nFix: the path that was given to .save(path).")
    try:
        if not zipfile.is_zipfile(path):
            with open(path, "rb") as file:
                if file.read(2) != b"PK":
                    _raise_foreign(path, kind)
            raise_damaged(path, "its end is missing")
        with zipfile.ZipFile(path) as entries:
            if HEADER not in entries.namelist():
                _raise_foreign(path, kind)
            left = _entries(entries, path)
            if left[HEADER].file_size > MOST_DESCRIPTION:
                raise ValueError(f"its description has {left[HEADER].file_size:,} bytes.")
            header = parsed(entries.read(left.pop(HEADER)))
            _check_header(path, header, kind)

            def array(name: str) -> np.ndarray:
                if f"{name}.npy" not in left:
                    raise ValueError(f"there is no array {name[:80]}, or it is used twice.")
                return _array(entries, left.pop(f"{name}.npy"))

            yield header, array
    except Explained as error:
        raise ValueError(by_line(error)) from None
    except ValueError as error:
        raise ValueError(by_line(f"{path} cannot be read: {str(error)[:2000]}")) from error
    except DAMAGED as error:
        raise ValueError(by_line(_damaged(path, str(error)[:200] or type(error).__name__))) from error
    except MALFORMED as error:
        why = f"its description is incomplete, or not lagjax's ({type(error).__name__}: {str(error)[:200]})"
        raise ValueError(by_line(_damaged(path, why))) from error


class Explained(ValueError):
    """An error whose message is complete."""


def parsed(text: bytes, most: int = MOST_DESCRIPTION) -> Any:
    """What a JSON text says.

    **Raises:** `ValueError` also for one that is longer than `most` bytes, or nested too deeply.
    """
    if len(text) > most:
        raise ValueError(f"its description has {len(text):,} bytes, and may have {most:,}.")
    try:
        return json.loads(text.decode())
    except RecursionError:
        raise ValueError("its description is nested too deeply.") from None


def _entries(entries, path) -> dict[str, zipfile.ZipInfo]:
    """The entries of a zip file by name: each once, as it is, and together no longer than the file."""
    found = entries.infolist()
    named = {entry.filename: entry for entry in found}
    as_it_is = all(x.compress_type == zipfile.ZIP_STORED and x.compress_size == x.file_size for x in found)
    if len(named) < len(found):
        raise_damaged(path, "it has two entries of one name")
    if not as_it_is or sum(x.file_size for x in found) > path.stat().st_size:
        raise Explained(
            f"{path} has compressed entries, and lagjax's files have none.\n"
            "Usual cause: a file that was packed again.\nFix: the file as .save(path) wrote it."
        )
    return named


def _array(entries, info) -> np.ndarray:
    """An array, which has to fill its entry."""
    with entries.open(info) as entry:
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, by_columns, dtype = read_header[np.lib.format.read_magic(entry)](entry)
        stored, expected = info.file_size - entry.tell(), math.prod(shape) * dtype.itemsize
        if dtype.kind not in KINDS_OF_ARRAY or dtype.itemsize == 0 or min(shape, default=0) < 0 or stored != expected:
            raise ValueError(f"{info.filename[:80]} is said to be {dtype}{list(shape)}, and has {stored:,} bytes.")
        data = np.empty(stored, np.uint8)
        for start in range(0, stored, PIECE):
            piece = data[start : start + PIECE]
            piece[:] = np.frombuffer(entry.read(len(piece)), np.uint8)
        # The checksum is compared at the end of the entry.
        entry.read(1)
    if dtype.kind == "b" and data.max(initial=0) > 1:
        raise ValueError(f"{info.filename[:80]} has truth values that are neither true nor false.")
    found = data.view(dtype)
    if dtype.kind == "U" and found.view(f"{dtype.str[0]}u4").max(initial=0) > 0x10FFFF:
        raise ValueError(f"{info.filename[:80]} has characters that do not exist.")
    return found.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order="F" if by_columns else "C")


def _check_header(path, header, kind):
    number = header["format"]
    if type(number) is not int or number < 1 or not isinstance(header["kind"] if number <= FORMAT else "", str):
        raise ValueError("its header has no format and kind.")
    if number > FORMAT:
        raise Explained(
            f"{path} was written by lagjax {str(header['versions']['lagjax'])[:20]}, and this one, "
            f"{version('lagjax')}, cannot read it.\nFix: pip install -U lagjax."
        )
    if header["kind"] != kind:
        raise Explained(f"{path} holds a {header['kind'][:20]}, not a {kind}.\nFix: {KINDS[header['kind']]}(path).")


def _raise_foreign(path, kind) -> NoReturn:
    raise Explained(f"{path} is not a {kind} saved by lagjax.\nFix: the path that was given to .save(path).")


def raise_damaged(path, why: str) -> NoReturn:
    """Raise `ValueError` for a damaged file."""
    raise _damaged(path, why)


def _damaged(path, why):
    return Explained(
        f"{path} is damaged: {why}.\n"
        "Usual cause: a copy that was cut short, or a disk that failed.\n"
        "Fix: copy it again, or compute it again."
    )
