"""Files that are not whole are refused, and writing that fails leaves the file of before."""

import json
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest

import lagjax as lj
from lagjax.files import npz
from tests.systems import motion, pendulum


def test_files_that_are_not_whole(tmp_path):
    """Files that are missing, cut off, changed, of another kind or a newer version are refused with the reason."""
    path, traj = tmp_path / "x.npz", motion("pendulum")
    traj.save(path)
    whole = path.read_bytes()
    place = whole.index(np.asarray(traj.q).tobytes())
    changed = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
    for content, words in (
        (changed, "is damaged: Bad CRC-32"),
        (whole[: len(whole) // 2], "is damaged: its end is missing"),
        (b"", "is not a trajectory saved by lagjax"),
        (b"t,x\n0,1\n", "is not a trajectory saved by lagjax"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path)
    np.savez(path, x=np.ones(3))
    with pytest.raises(ValueError, match="is not a trajectory saved by lagjax"):
        lj.load_trajectory(path)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        lj.load_trajectory(tmp_path / "other.npz")
    for header, words in (
        ({"format": npz.FORMAT + 1, "versions": {"lagjax": "9.0"}}, "written by lagjax 9.0, .*\nFix: pip install -U"),
        ({"format": npz.FORMAT, "kind": "fit"}, r"holds a fit, not a trajectory.\nFix: lj.load_fit\(path\)"),
        ({"format": npz.FORMAT, "kind": "trajectory", "trajectory": {}}, "is damaged: its description is incomplete"),
    ):
        with zipfile.ZipFile(path, "w") as entries:
            entries.writestr(npz.HEADER, json.dumps(header))
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path)
    path.write_bytes(whole)
    assert lj.load_trajectory(path, pendulum).q[0] == 1.0


def test_a_failure_leaves_the_file_of_before(tmp_path, monkeypatch):
    """If writing fails, the new file leaves nothing and the old one is intact; folders that do not exist are named."""
    path, traj = tmp_path / "x.npz", motion("pendulum")
    traj.save(path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array", full)
        with pytest.raises(OSError, match="No space left"):
            traj.save(path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["x.npz"]
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        traj.save(tmp_path / "none" / "x.npz")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        traj.save(tmp_path)


KILLED = """
import os, signal, sys
import numpy as np
from lagjax.files import npz as files
write_array = np.lib.format.write_array
def killed(entry, x, **kwargs):
    write_array(entry, x, **kwargs)
    if x.size > 1:
        os.kill(os.getpid(), signal.SIGKILL)
np.lib.format.write_array = killed
files.write(sys.argv[1], "trajectory", {}, {"a": np.zeros(1), "b": np.zeros(1000), "c": np.zeros(1000)})
"""


@pytest.mark.slow
def test_a_killed_process_leaves_the_file_of_before(tmp_path):
    """A process killed while writing leaves the previous file, and the next write succeeds."""
    path, traj = tmp_path / "x.npz", motion("pendulum")
    traj.save(path)
    before = path.read_bytes()
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)]).returncode == -9
    assert path.read_bytes() == before and len(os.listdir(tmp_path)) == 2
    traj.save(path)
    assert lj.load_trajectory(path, pendulum).q[0] == 1.0
