"""Random systems of `benchmarks/campaigns/fuzz.py` that once crashed, raised or were wrong; and a failing twin."""

import subprocess
import sys

import pytest

from tests.tiers import exhaustive_but


def fuzzed(*options):
    """The fuzzer's output and status."""
    run = [sys.executable, "-m", "benchmarks.campaigns.fuzz", "--seconds", 800, "--cases", 1, *options]
    return subprocess.run(list(map(str, run)), capture_output=True, text=True, timeout=900)


@pytest.mark.exhaustive
@pytest.mark.parametrize("seeds", exhaustive_but(((4, 257),), ((4, 257), (2, 70, 97, 147, 187), (196, 210, 219, 288))))
def test_what_once_failed(seeds):
    """Systems with tables over 10 kB, a known 1/0, mixed dtypes, and 4,096 multiplications (257)."""
    # One command, which forks a process for each system.
    ended = fuzzed("--quick", "--only", *seeds)
    assert ended.returncode == 0 and ended.stdout.count(" ok: ") == len(seeds), ended.stdout + ended.stderr


@pytest.mark.exhaustive
def test_what_once_came_out_wrong_on_the_way():
    """Integer division by a parameter, 29 // 7, which once silently became 29 / 7."""
    ended = fuzzed("--seed", 704)
    assert ended.returncode == 0 and " ok: " in ended.stdout, ended.stdout


@pytest.mark.slow
def test_the_fuzzer_can_fail():
    """Accelerations that are wrong by a millionth are found."""
    script = (
        "import jax\n"
        "from benchmarks.campaigns import fuzz\n"
        "kept = fuzz.lj.accelerations\n"
        "fuzz.lj.accelerations = lambda *x: jax.tree.map(lambda a: 1.000001 * a, kept(*x))\n"
        "print(fuzz.in_a_process(fuzz.run_quickly, 97, False))\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=900)
    assert ended.stdout.startswith("WRONG"), ended.stdout + ended.stderr
