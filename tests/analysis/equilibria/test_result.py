"""What is printed of equilibria, and of batches of them."""

import jax
import jax.numpy as jnp
import pytest

import lagjax as lj
from tests.systems import PARAMS, pendulum, rod_pendulum


def test_what_is_printed():
    """The table has one line for each equilibrium: state, multipliers, stability."""
    found = lj.equilibria(rod_pendulum, PARAMS, starts=[{"x": 0.3, "y": -1.0}, {"x": 0.3, "y": 1.0}])
    lines = repr(found).splitlines()
    assert lines[0] == "Equilibria: 2 from 2 starts"
    assert lines[1].split() == ["x", "y", "λ", "rod"]
    assert lines[2].split() == ["0", "-1.25", "-3.925", "stable"] and lines[3].endswith("unstable")


@pytest.mark.slow
def test_a_batch():
    """Under `vmap` nothing is merged, and the printed form shows the batch."""
    found = jax.vmap(lambda g: lj.equilibria(pendulum, {"g": g, "l": 1.0}, starts=[0.1, 3.0, -3.0]))(jnp.ones(2))
    assert found.found.shape == (2, 3) and found.found.all() and "a batch of 2 with 3 starts each" in repr(found)
