"""Axes of a sweep: order, pairing, slices, and invalid axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.sweep.axes import axes_of


def test_numbers_become_those_of_jax():
    """Integers stay integers; floats get JAX's dtype."""
    axes = axes_of({"n": [1, 2], "x": [0.5, 1.0]}, paired=False)
    assert axes.values["n"].dtype == np.int64 and axes.values["x"].dtype == np.float64


@pytest.mark.parametrize(
    ("axes", "paired", "error", "words"),
    [
        ([1.0, 2.0], False, TypeError, "must be a dictionary of arrays by name"),
        ({}, False, TypeError, "must be a dictionary"),
        ({"omega": 3.0}, False, ValueError, "axis 'omega' must be an array of at least one number"),
        ({"omega": []}, False, ValueError, "axis 'omega'"),
        ({"omega": ["fast"]}, False, ValueError, "axis 'omega'"),
        ({"omega": [True, False], "g": [None]}, False, ValueError, "axis 'g'"),
        ({"omega": [1.0, 2.0], "g": [1.0]}, True, ValueError, "'omega' has 2, 'g' has 1"),
    ],
)
def test_what_is_no_axis(axes, paired, error, words):
    """The error names the axis and gives a fix."""
    with pytest.raises(error, match=words) as refusal:
        axes_of(axes, paired)
    assert "Fix:" in str(refusal.value)


def test_inside_a_program():
    """A sweep cannot run inside jit."""
    with pytest.raises(TypeError, match="axis 'x' is being traced"):
        jax.jit(lambda x: axes_of({"x": x}, False).size)(jnp.arange(3.0))
