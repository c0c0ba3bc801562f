"""Small motions about a steady one: where there is none the error says why."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.modes.linearise import _changed, _singular
from lagjax.analysis.modes.reduced_matrices import Raw
from lagjax.system import coordinates
from tests.analysis import small_systems as small
from tests.analysis.modes.test_normal_modes import EQUAL
from tests.systems import rod_pendulum

FREE = lj.System(lambda t, q, v, params: 0.5 * v**2)


def test_what_is_held():
    """A mass held by a constraint has no motion, which is an error."""
    held = lj.System(FREE.lagrangian, {"wall": lj.Holonomic(lambda t, q, params: q - 1.0)})
    with pytest.raises(ValueError, match="leave no motion at all"):
        lj.normal_modes(held, 0.0, 1.0, 0.0, None)


@pytest.mark.slow
def test_what_is_free():
    """A free mass at any speed has one zero mode."""
    modes = lj.normal_modes(FREE, 0.0, 1.0, 2.0, None)
    assert modes.verdict == "stable" and "any q and any speed" in repr(modes)


@pytest.mark.slow
def test_the_conical_pendulum():
    """It oscillates with Ω √(1 + 3 cos²θ) at any azimuth; twin: at another speed it is not steady."""
    theta, params = 0.7, {"l": 1.25, "g": 9.8125}
    turn = np.sqrt(params["g"] / (params["l"] * np.cos(theta)))
    at = {"theta": theta, "phi": 0.3}
    modes = lj.normal_modes(small.spherical, 0.0, at, {"theta": 0.0, "phi": turn}, params)
    np.testing.assert_allclose(modes.frequency, [0.0, turn * np.sqrt(1 + 3 * np.cos(theta) ** 2)], **EQUAL)
    assert modes.verdict == "stable" and modes.linearisation.shifts == ("phi",)
    with pytest.raises(ValueError, match="no steady motion: 'theta' accelerates"):
        lj.linearise(small.spherical, 0.0, at, {"theta": 0.0, "phi": 1.01 * turn}, params)


MATRICES = dict.fromkeys(Raw._fields, np.eye(2))


def test_what_is_singular_and_what_changes():
    """The coordinate without mass is named; and the matrix that changes along the motion, with its entry."""
    s = coordinates.state(0.0, {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, None)
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    for mass, name in ((np.diag([2.0, 0.0]), "a"), (np.diag([0.0, 2.0]), "b")):
        parts = SimpleNamespace(mass=mass, velocities=turned)
        assert f"mass matrix is singular in coordinate '{name}'" in _singular(parts, s)
    parts = lambda **changed: SimpleNamespace(raw=Raw(**MATRICES | changed))
    later = np.array([[1.0, 0.25], [0.0, 1.0]])
    assert _changed(parts(), parts()) is None
    assert _changed(parts(), parts(position=later)) == ("the matrix of positions", 0, 1, 0.0, 0.25)


def test_off_the_constraints():
    """A violated constraint is named."""
    with pytest.raises(ValueError, match="constraint 'rod'"):
        lj.linearise(rod_pendulum, 0.0, {"x": 0.0, "y": -1.0}, {"x": 0.0, "y": 0.0}, {"g": 9.8125, "l": 1.25})


@pytest.mark.slow
def test_messages():
    """No mass, explicit time: each error is clear."""
    massless = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - 0.5 * (q["a"] ** 2 + q["b"] ** 2))
    with pytest.raises(ValueError, match="mass matrix is singular in coordinate 'b'"):
        lj.linearise(massless, 0.0, {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, None)
    parametric = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (1 + 0.1 * jnp.cos(t)) * q**2)
    with pytest.raises(ValueError, match="change along the motion: the matrix of positions"):
        lj.linearise(parametric, 0.0, 0.0, 0.0, None)
