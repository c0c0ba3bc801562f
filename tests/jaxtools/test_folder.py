"""The folder of compiled programs: what is read, what is refused, what is dropped."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lagjax.jaxtools import folder

DIGEST, OTHER = "ab" * 32, "0c" * 32
PROGRAM = bytes(range(256)) * 40
posix = pytest.mark.skipif(os.name != "posix", reason="rights are those of POSIX")
not_root = pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder of programs, with one in it."""
    monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path / "programs"))
    path = folder.place().path
    assert path is not None and folder.write(path, DIGEST, {"name": "motion"}, PROGRAM)
    return path


def file_of(path: Path) -> Path:
    """The file of the one program."""
    return path / (DIGEST + folder.SUFFIX)


def found(path: Path):
    """What is read of it."""
    entry = folder.read(path, DIGEST)
    return None if entry is None else (entry[0]["name"], bytes(entry[1]))


def test_what_was_written_is_read(place):
    """A program comes back, byte for byte, and is the owner's alone; twin: another digest has none."""
    assert found(place) == ("motion", PROGRAM) and folder.read(place, OTHER) is None
    assert folder.size(place) == (1, file_of(place).stat().st_size)
    if os.name == "posix":
        assert place.stat().st_mode & 0o777 == 0o700 and file_of(place).stat().st_mode & 0o777 == 0o600


def test_a_flipped_bit(place):
    """With any one bit flipped it is as good as none, wherever it is: in front, in the header, in the program."""
    content = file_of(place).read_bytes()
    for at in (0, 3, 17, 30, 50, 56, 60, 90, 120, len(content) // 2, len(content) - 1):
        damaged = bytearray(content)
        damaged[at] ^= 1 << at % 8
        file_of(place).write_bytes(damaged)
        assert found(place) is None, at
    file_of(place).write_bytes(content)
    assert found(place) == ("motion", PROGRAM)


def test_a_shorter_file(place):
    """Cut off anywhere it is as good as none, empty ones and those with something after their end too."""
    content = file_of(place).read_bytes()
    for end in (0, 1, len(folder.MAGIC), 40, 57, 80, len(content) // 2, len(content) - 1):
        file_of(place).write_bytes(content[:end])
        assert found(place) is None, end
    file_of(place).write_bytes(content + b"\0")
    assert found(place) is None


def test_a_foreign_file(place):
    """The program of another digest under this name is none, nor is a folder, nor a link to a program."""
    folder.write(place, OTHER, {"name": "other"}, PROGRAM)
    other = place / (OTHER + folder.SUFFIX)
    file_of(place).write_bytes(other.read_bytes())
    assert found(place) is None
    file_of(place).unlink()
    file_of(place).mkdir()
    assert found(place) is None
    if os.name == "posix":
        folder.write(place, OTHER, {}, PROGRAM)
        file_of(place).rmdir()
        file_of(place).symlink_to(other)
        assert found(place) is None


@posix
def test_rights_of_others(place, monkeypatch):
    """A folder that others may write is not used, nor a file; nor a folder of somebody else's. Each with its twin."""
    for mode, used in ((0o770, False), (0o702, False), (0o755, True), (0o700, True)):
        place.chmod(mode)
        assert (folder.place().path is not None) == used
    place.chmod(0o770)
    assert "may be written by others" in folder.place().why_not
    place.chmod(0o700)
    file_of(place).chmod(0o660)
    assert found(place) is None
    file_of(place).chmod(0o600)
    assert found(place) == ("motion", PROGRAM)
    monkeypatch.setattr(os, "geteuid", lambda: place.stat().st_uid + 1)
    assert folder.place() == (None, f"{place} belongs to somebody else") and found(place) is None


def test_turned_off_and_named(tmp_path, monkeypatch):
    """LAGJAX_CACHE names a folder, or turns it off; without it there is the usual one; a file is no folder."""
    for word in ("off", "OFF", "0"):
        monkeypatch.setenv("LAGJAX_CACHE", word)
        assert folder.place() == (None, f"LAGJAX_CACHE={word}")
    monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path / "a" / "b"))
    assert folder.place().path == tmp_path / "a" / "b"
    (tmp_path / "file").write_text("no folder")
    for name in ("file", "file/inside"):
        monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path / name))
        assert folder.place().path is None and folder.place().why_not
    monkeypatch.delenv("LAGJAX_CACHE")
    usual = folder.wanted()
    assert usual is not None and "lagjax" in usual.parts


@not_root
def test_a_folder_that_may_only_be_read(place):
    """It serves what it has, and nothing is written."""
    place.chmod(0o500)
    assert found(place) == ("motion", PROGRAM) and not folder.write(place, OTHER, {}, PROGRAM)
    place.chmod(0o700)
    assert folder.size(place)[0] == 1


def test_a_full_disk(place, monkeypatch):
    """What cannot be written whole is not there at all; twin: with room it is."""

    def full(*args):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", full)
        assert not folder.write(place, OTHER, {}, PROGRAM)
    assert sorted(x.name for x in place.iterdir()) == [DIGEST + folder.SUFFIX]
    assert folder.write(place, OTHER, {}, PROGRAM) and folder.size(place)[0] == 2


def test_the_longest_unused_go(place):
    """Above the limit those go that were used longest ago, until it is less; reading counts as use."""
    length = file_of(place).stat().st_size
    for i in range(5):
        name = f"{i + 1:064x}"
        assert folder.write(place, name, {"name": "motion"}, PROGRAM)
        os.utime(place / (name + folder.SUFFIX), (1000.0 * i, 1000.0 * i))
    os.utime(file_of(place), (1.0, 1.0))
    folder.drop(place, 6 * length)
    assert folder.size(place)[0] == 6
    assert found(place) is not None
    folder.drop(place, 5 * length)
    left = {x.name.removesuffix(folder.SUFFIX) for x in place.iterdir()}
    assert left == {DIGEST, f"{4:064x}", f"{5:064x}", f"{3:064x}"}


def test_what_a_killed_writer_left(place):
    """A file that was never finished goes after an hour, and is no program; twin: a new one stays."""
    old, new, mine = place / f".x{folder.PARTIAL}", place / f".y{folder.PARTIAL}", place / "notes.txt"
    for file in (old, new, mine):
        file.write_bytes(PROGRAM)
    os.utime(old, (time.time() - 7200, time.time() - 7200))
    os.utime(mine, (0, 0))
    folder.drop(place)
    assert not old.exists() and new.exists() and mine.exists() and folder.size(place)[0] == 1
    folder.clear(place)
    assert [x.name for x in place.iterdir()] == ["notes.txt"]


@posix
def test_a_program_that_ended_a_process(place):
    """A program in whose first run a process ended is dropped; twins: of a running process, and one that ran well."""
    mark = place / (DIGEST + folder.TRYING)
    with folder.tried(place, DIGEST) as entry:
        assert entry is not None and mark.read_text() == str(os.getpid())
        with folder.tried(place, DIGEST) as beside:
            assert beside is not None
        assert mark.exists()
    assert not mark.exists() and found(place) is not None
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    mark.write_text(str(killed.pid))
    with folder.tried(place, DIGEST) as entry:
        assert entry is None
    assert not mark.exists() and found(place) is None


AT_ONCE = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("folder", sys.argv[1])
folder = importlib.util.module_from_spec(spec)
spec.loader.exec_module(folder)
path, digest, program = folder.Path(sys.argv[2]), sys.argv[3], bytes(range(256)) * 40
for turn in range(8):
    with folder.tried(path, digest) as entry:
        if entry is not None and (entry[0]["name"] != "motion" or bytes(entry[1]) != program):
            sys.exit(f"turn {turn}: {entry[0]}")
    if entry is None or turn % 3 == 0:
        folder.write(path, digest, {"name": "motion"}, program)
    if turn == 4:
        folder.drop(path, 0)
"""


@pytest.mark.slow
def test_many_processes_on_one_entry(tmp_path):
    """Two hundred processes read, write and drop one program at once; each reads a whole one, or none."""
    path = tmp_path / "programs"
    path.mkdir(mode=0o700)
    ask = [sys.executable, "-c", AT_ONCE, str(folder.__file__), str(path), DIGEST]
    started = [subprocess.Popen(ask, stderr=subprocess.PIPE, text=True) for _ in range(200)]
    said = [process.communicate()[1] for process in started]
    assert [process.returncode for process in started] == [0] * 200, said
    left = {file.name for file in path.iterdir()}
    assert left <= {DIGEST + folder.SUFFIX} and folder.read(path, DIGEST) is not None
