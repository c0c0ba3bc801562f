"""Small motions about a steady one: where there is none the error says why."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.linearise import Raw, _changed, _least_squares, _singular
from lagjax.scenes import cross_rails
from lagjax.system import coordinates
from tests.analysis import small_systems as small
from tests.analysis.test_normal_modes import EQUAL
from tests.by_numpy import by_numpy
from tests.systems import rod_pendulum

FREE = lj.System(lambda t, q, v, params: 0.5 * v**2)


def test_forces_that_balance():
    """Multipliers by least squares, as NumPy's; a row that exerts no force has none. Twin: it would be NaN."""
    columns, target = np.array([[1.0, 0.0, 2.0], [2.0, 0.0, -1.0], [0.5, 0.0, 1.0]]), np.array([1.0, 2.0, 3.0])
    found = by_numpy(_least_squares)(columns, target)
    np.testing.assert_allclose(found, np.linalg.lstsq(columns, target, rcond=None)[0], rtol=1e-12, atol=1e-14)
    assert np.linalg.matrix_rank(columns.T @ columns) < 3


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


HELD = lj.System(FREE.lagrangian, {"wall": lj.Holonomic(lambda t, q, params: q - 1.0)})
SWAYING = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (1 + 0.1 * jnp.cos(t)) * q**2)
MASSLESS = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - 0.5 * (q["a"] ** 2 + q["b"] ** 2))
OFF, STILL, NONE = {"x": 0.0, "y": -1.0}, {"x": 0.0, "y": 0.0}, {"a": 0.0, "b": 0.0}
RAILS = cross_rails.rotating_system, {"R": 1.0, "r": 0.0}, {"R": 0.0, "r": 0.0}, cross_rails.PARAMS


@pytest.mark.parametrize(
    "system, q, v, params, error, words",
    [
        (HELD, 1.0, 0.0, None, ValueError, "leave no motion at all"),
        (rod_pendulum, OFF, STILL, {"g": 9.8125, "l": 1.25}, ValueError, "constraint 'rod'"),
        (*RAILS, ValueError, "not an equilibrium: 'R' accelerates by"),
        (small.bead, True, 0, None, TypeError, "bool"),
        pytest.param(MASSLESS, NONE, NONE, None, ValueError, "singular in coordinate 'b'", marks=pytest.mark.slow),
        pytest.param(
            SWAYING, 0.0, 0.0, None, ValueError, "change along the motion: the matrix of pos", marks=pytest.mark.slow
        ),
    ],
    ids=["held", "off the rod", "no equilibrium", "a truth", "without mass", "explicit time"],
)
def test_what_is_refused(system, q, v, params, error, words):
    """Where there is no steady motion the error says why."""
    with pytest.raises(error, match=words):
        lj.linearise(system, 0.0, q, v, params)
