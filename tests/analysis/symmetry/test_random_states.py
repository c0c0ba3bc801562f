"""States at which symmetries are tested: errors where there are none."""

import jax.numpy as jnp
import pytest

import lagjax as lj
from tests.symmetric_systems import OF_STONE, falling


def test_no_states_no_verdict():
    """An error says that L is finite nowhere."""
    undefined = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.log(-1.0 - q**2))
    with pytest.raises(ValueError, match="where L is not finite"):
        lj.is_symmetry(undefined, lj.Generator.shift("q"), 0.5, 0.5)


@pytest.mark.slow
def test_no_states_on_the_constraints():
    """An error says that no state satisfies the constraints."""
    nowhere = lj.System(falling, {"never": lj.Holonomic(lambda t, q, p: q["x"] ** 2 + 1.0)})
    state = {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}
    with pytest.raises(ValueError, match="only 0 states were found"):
        lj.is_symmetry(nowhere, lj.Generator.shift("y"), *state, OF_STONE)
