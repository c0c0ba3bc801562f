"""Axes of a sweep: order, pairing, slices, and invalid axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.sweep.axes import axes_of

GRID = {"a": np.array([1.0, 2.0]), "b": np.array([10.0, 20.0, 30.0]), "c": np.arange(8.0).reshape(4, 2)}


def test_the_last_axis_is_the_fastest():
    """Indices follow nested loops, for one point and several; an axis of vectors gives slices."""
    axes = axes_of(GRID, paired=False)
    assert axes.shape == (2, 3, 4) and axes.size == 24
    points = [(a, b, c) for a in GRID["a"] for b in GRID["b"] for c in GRID["c"]]
    several = axes.at(np.array([0, 7, 23]))
    for n, index in enumerate((0, 7, 23)):
        for point in (axes.at(index), {name: x[n] for name, x in several.items()}):
            assert (point["a"], point["b"]) == points[index][:2]
            assert np.array_equal(point["c"], points[index][2])


def test_paired_axes_move_together():
    """Paired axes have a single dimension, the point."""
    axes = axes_of({"a": jnp.arange(3.0), "b": 2 * jnp.arange(3.0)}, paired=True)
    assert axes.dims == {"point": 3}
    assert axes.at(2) == {"a": 2.0, "b": 4.0}
    assert axes.words(1) == "a = 1, b = 2"


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
