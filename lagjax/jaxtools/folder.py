"""The folder of compiled programs: files found by a digest, written by rename, the longest unused dropped.

It holds machine code, so it is the user's own: made with the rights 0700, and not used where it belongs to somebody
else or others may write into it. Each file has its digest and a checksum in it; one that is damaged, foreign or older
is as good as none. Nothing here raises: a folder that cannot be read or written keeps nothing. There is no lock: files
appear whole or not at all, whoever writes them, and each is written for what it is named after.
"""

import hashlib
import json
import os
import stat
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import platformdirs

# The first bytes of a file, then a checksum of the rest, and the length of the header.
MAGIC, SUFFIX, PARTIAL, TRYING = b"lagjax program 1\n", ".program", ".partial", ".trying"
CHECKSUM, LENGTH = hashlib.sha256().digest_size, 8
# The bytes that all programs may take, the share that stays when it was more, and the longest file that is read.
MOST, STAYS, LONGEST = 1_000_000_000, 0.8, 300_000_000
# After so many seconds a file that was never finished belongs to a process that was killed.
FORGOTTEN = 3600.0
# Rights by which others may write.
OTHERS = stat.S_IWGRP | stat.S_IWOTH


class Folder(NamedTuple):
    """Where programs are kept, or why they are not."""

    path: Path | None
    why_not: str = ""


def wanted() -> Path | None:
    """The folder that LAGJAX_CACHE names, or the usual one of this system; None if it is turned off."""
    named = os.environ.get("LAGJAX_CACHE", "").strip()
    if named.lower() in ("off", "0", "no", "false"):
        return None
    return Path(named).expanduser().absolute() if named else Path(platformdirs.user_cache_dir("lagjax", False))


def place() -> Folder:
    """The folder, made if there is none yet."""
    try:
        path = wanted()
    except (RuntimeError, OSError) as error:
        return Folder(None, f"there is no home folder: {error}")
    if path is None:
        return Folder(None, f"LAGJAX_CACHE={os.environ['LAGJAX_CACHE']}")
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.stat()
    except OSError as error:
        return Folder(None, f"{path}: {error.strerror or error}")
    if not _is_own(found):
        return Folder(None, f"{path} belongs to somebody else")
    if os.name == "posix" and found.st_mode & OTHERS:
        return Folder(None, f"{path} may be written by others (chmod 700 makes it yours)")
    return Folder(path)


def _is_own(found: os.stat_result) -> bool:
    return os.name != "posix" or found.st_uid == os.geteuid()


def read(path: Path, digest: str) -> tuple[dict[str, Any], memoryview] | None:
    """The header and the program of a digest; None if there is none that is whole and the user's own."""
    file = path / (digest + SUFFIX)
    try:
        opened = os.open(file, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0))
        with open(opened, "rb") as stream:
            found = os.fstat(stream.fileno())
            is_own = _is_own(found) and not (os.name == "posix" and found.st_mode & OTHERS)
            if not (stat.S_ISREG(found.st_mode) and is_own and found.st_size <= LONGEST):
                return None
            content = memoryview(stream.read())
    except OSError:
        return None
    start = len(MAGIC) + CHECKSUM
    rest = content[start:]
    if content[: len(MAGIC)] != MAGIC or hashlib.sha256(rest).digest() != content[len(MAGIC) : start]:
        return None
    end = LENGTH + int.from_bytes(rest[:LENGTH], "big")
    try:
        header = json.loads(bytes(rest[LENGTH:end]))
    except ValueError:
        return None
    if not isinstance(header, dict) or header.get("digest") != digest:
        return None
    try:
        os.utime(file)
    except OSError:
        # A folder that may only be read: it serves, and nothing of it is dropped.
        pass
    return header, rest[end:]


@contextmanager
def tried(path: Path, digest: str) -> Iterator[tuple[dict[str, Any], memoryview] | None]:
    """`read`, for a program that is made ready for the first time in this process, inside the context; see `marked`.

    Where a process has ended in there, perhaps by the program, that one is dropped, to be compiled anew.
    """
    mark = path / (digest + TRYING)
    before = _process_of(mark)
    if before is not None and not _is_running(before):
        _remove(path / (digest + SUFFIX))
        _remove(mark)
    found = read(path, digest)
    with nullcontext() if found is None else marked(path, digest):
        yield found


@contextmanager
def marked(path: Path, digest: str) -> Iterator[None]:
    """A context for what may end the process: inside it a file beside the program has the number of this process."""
    mark = path / (digest + TRYING)
    marks = _process_of(mark) is None
    if marks:
        try:
            mark.write_text(str(os.getpid()))
        except OSError:
            pass
    try:
        yield
    finally:
        if marks:
            _remove(mark)


def _process_of(mark: Path) -> int | None:
    try:
        return int(mark.read_text())
    except (OSError, ValueError):
        return None


def _is_running(process: int) -> bool:
    if os.name != "posix":
        # There `os.kill` ends a process.
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass
    return True


def write(path: Path, digest: str, header: dict[str, Any], program: bytes) -> bool:
    """Write a program under its digest; whether that went well. Once in a while the longest unused are dropped."""
    said = json.dumps({"digest": digest, **header}, allow_nan=False).encode()
    rest = len(said).to_bytes(LENGTH, "big") + said + program
    partial = path / f".{digest[:16]}.{uuid.uuid4().hex}{PARTIAL}"
    try:
        opened = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600)
        with open(opened, "wb") as stream:
            stream.write(MAGIC + hashlib.sha256(rest).digest())
            stream.write(rest)
        os.replace(partial, path / (digest + SUFFIX))
    except OSError:
        _remove(partial)
        return False
    # One in sixteen, as digests fall.
    if digest.startswith("0"):
        drop(path)
    return True


def drop(path: Path, most: int = MOST) -> None:
    """Drop the longest unused programs if all take more than `most` bytes, and what killed processes left."""
    now, found = time.time(), []
    for file, seen in _files(path):
        if file.endswith((PARTIAL, TRYING)) and now - seen.st_mtime > FORGOTTEN:
            _remove(Path(file))
        elif file.endswith(SUFFIX):
            found.append((seen.st_mtime, seen.st_size, file))
    size = sum(length for _, length, _ in found)
    if size <= most:
        return
    for _, length, file in sorted(found):
        _remove(Path(file))
        size -= length
        if size <= STAYS * most:
            return


def size(path: Path) -> tuple[int, int]:
    """How many programs there are, and how many bytes they take."""
    sizes = [seen.st_size for file, seen in _files(path) if file.endswith(SUFFIX)]
    return len(sizes), sum(sizes)


def clear(path: Path) -> None:
    """Drop all programs, and nothing else that may be in the folder."""
    for file, _ in _files(path):
        if file.endswith((SUFFIX, PARTIAL, TRYING)):
            _remove(Path(file))


def _files(path: Path) -> Iterator[tuple[str, os.stat_result]]:
    try:
        with os.scandir(path) as entries:
            for entry in entries:
                try:
                    if entry.is_file(follow_symlinks=False):
                        yield entry.path, entry.stat(follow_symlinks=False)
                except OSError:
                    # Another process has just dropped it.
                    continue
    except OSError:
        return


def _remove(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        pass
