"""Compiled programs take memory maps, of which a process has a limited number: a warning comes before the limit."""

import subprocess
import sys
from pathlib import Path

import pytest

import lagjax as lj
from lagjax.jaxtools import memory_maps
from tests.systems import PARAMS, TS


def integrated(system):
    """A motion over one time span."""
    return lj.integrate(system, 1.0, 0.0, PARAMS, ts=TS)


@pytest.fixture
def process(tmp_path, monkeypatch):
    """A process with 751 maps, on an operating system that allows 1,000."""
    maps, limit = tmp_path / "maps", tmp_path / "max_map_count"
    maps.write_text("7f00-7f01 r-xp\n" * 751)
    limit.write_text("1000\n")
    monkeypatch.setattr(memory_maps, "MAPS", maps)
    monkeypatch.setattr(memory_maps, "LIMIT", limit)
    return maps, limit


def test_told_where_something_is_compiled(process):
    """The call that compiles warns and names the remedy; the next call does not count maps."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2)
    with pytest.warns(UserWarning, match=r"751 of the 1,000 memory maps(.|\n)*jax.clear_caches\(\)"):
        integrated(system)
    integrated(system)
    process[0].write_text("7f00-7f01 r-xp\n" * 749)
    memory_maps.share_used()
    for file in process:
        file.unlink()
        memory_maps.share_used()


@pytest.mark.skipif(not memory_maps.MAPS.exists(), reason="only Linux tells")
@pytest.mark.exhaustive
def test_the_remedy_helps():
    """Each system takes maps; after `jax.clear_caches()` there are as many as before the first."""
    code = """
import gc, jax, lagjax as lj, sys
from pathlib import Path
jax.config.update("jax_enable_x64", True)
count = lambda: len(Path("/proc/self/maps").read_text().splitlines())
def one(k):
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - k * q**2)
    lj.integrate(system, 1.0, 0.0, None, ts=jax.numpy.array([0.0, 1.0]))
counts = []
for k in range(4):
    one(1.0 + k)
    counts.append(count())
jax.clear_caches()
gc.collect()
print(*counts, count())
"""
    root = Path(lj.__file__).parents[1]
    found = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    first, *_, last, cleared = map(int, found.stdout.split())
    assert last - first > 3 * 20, "of each system"
    assert cleared < first + 10, "all of them"
