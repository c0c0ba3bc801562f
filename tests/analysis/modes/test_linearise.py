"""Small motions about a steady one: where there is none the error says why."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.analysis import small_systems as small
from tests.analysis.modes.test_normal_modes import BEAD, EQUAL
from tests.systems import rod_pendulum


def test_what_is_free_and_what_is_held():
    """A free mass at any speed has one zero mode; a mass held by a constraint has no motion, which is an error."""
    free = lj.System(lambda t, q, v, params: 0.5 * v**2)
    modes = lj.normal_modes(free, 0.0, 1.0, 2.0, None)
    assert modes.verdict == "stable" and "any q and any speed" in repr(modes)
    held = lj.System(free.lagrangian, {"wall": lj.Holonomic(lambda t, q, params: q - 1.0)})
    with pytest.raises(ValueError, match="leave no motion at all"):
        lj.normal_modes(held, 0.0, 1.0, 0.0, None)


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


def test_programs_never_hold_nan():
    """In a program, states off equilibrium and NaN inputs give codes and residuals, never NaN."""
    codes = jax.jit(jax.vmap(lambda at, omega: lj.normal_modes(small.bead, 0.0, at, 0.0, BEAD | {"omega": omega})))
    modes = codes(np.array([0.0, 0.5, np.nan, 0.0]), np.array([1.0, 1.0, 1.0, np.nan]))
    assert all(np.isfinite(x).all() for x in (modes.roots, modes.shapes, modes.code))
    assert [lj.NormalModes.VERDICTS[code] for code in modes.code] == ["stable", *["no steady motion"] * 3]
    assert modes.linearisation.residual[0] < 1e-12 < 0.1 < modes.linearisation.residual[1]
    assert list(modes.stable) == [True, False, False, False]


def test_messages():
    """No equilibrium, no mass, explicit time, a violated constraint, wrong types: each error is clear."""
    with pytest.raises(ValueError, match="not an equilibrium: 'q' accelerates by"):
        lj.linearise(small.bead, 0.0, 0.3, 0.0, BEAD)
    massless = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - 0.5 * (q["a"] ** 2 + q["b"] ** 2))
    with pytest.raises(ValueError, match="mass matrix is singular in coordinate 'b'"):
        lj.linearise(massless, 0.0, {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, None)
    parametric = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (1 + 0.1 * jnp.cos(t)) * q**2)
    with pytest.raises(ValueError, match="change along the motion: the matrix of positions"):
        lj.linearise(parametric, 0.0, 0.0, 0.0, None)
    with pytest.raises(ValueError, match="constraint 'rod'"):
        lj.linearise(rod_pendulum, 0.0, {"x": 0.0, "y": -1.0}, {"x": 0.0, "y": 0.0}, {"g": 9.8125, "l": 1.25})
    with pytest.raises(TypeError, match="bool"):
        lj.linearise(small.bead, 0.0, True, 0, BEAD)
    with pytest.raises(IndexError, match="there are 1 modes"):
        lj.normal_modes(small.bead, 0.0, 0.0, 0.0, BEAD)[1]
