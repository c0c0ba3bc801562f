"""Several devices: each chunk is split between them, and the results are the same."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lagjax as lj
from tests.behaviour.test_regular_first import BOTH, exact
from tests.sweep import worker

PROGRAM = """
import jax, numpy as np, sys
jax.config.update("jax_num_cpu_devices", 2)
import lagjax as lj
from tests.sweep import worker
swept = lj.sweep(worker.run, worker.axes(170), progress=False)
from tests.behaviour.test_regular_first import BOTH, first_coordinate
irregular = lj.sweep(first_coordinate, BOTH, progress=False).values
np.savez(sys.argv[1], values=swept.values, steps=swept.status.steps, how=swept.how, irregular=irregular)
"""


@pytest.mark.exhaustive
def test_two_devices(tmp_path):
    """Through `jax.shard_map`, with a number of points that does not divide by two."""
    environment = os.environ | {"PYTHONPATH": str(Path(lj.__file__).parents[1])}
    subprocess.run([sys.executable, "-c", PROGRAM, tmp_path / "two.npz"], env=environment, check=True)
    two = np.load(tmp_path / "two.npz")
    one = lj.sweep(worker.run, worker.axes(170), progress=False)
    assert str(two["how"]).startswith("2 cpus")
    # The split program is compiled differently; where an error estimate is only round-off, the next step differs.
    np.testing.assert_allclose(two["steps"], one.status.steps, rtol=0.2)
    np.testing.assert_allclose(two["values"], one.values, atol=1e-7)
    # Some of the lanes need the robust program.
    np.testing.assert_allclose(two["irregular"], exact(BOTH["k"]), rtol=1e-7)
