"""A system is known by what its functions return at a state."""

import numpy as np
import pytest

import lagjax as lj
from tests.systems import cartesian_lagrangian, motion, rod, rod_pendulum

HELD = rod_pendulum.constraints


def test_another_system_is_told(tmp_path):
    """Another system is refused by what differs at a state; twin: the same functions, redefined, are accepted."""
    path, traj = tmp_path / "swing.npz", motion("rod pendulum")
    traj.save(path)
    pull = lambda t, q, v, params: {"x": 0.0 * q["x"], "y": 0.0 * q["y"]}
    for other, words in (
        (lj.System(cartesian_lagrangian), "the constraint 'rod' is missing"),
        (lj.System(cartesian_lagrangian, {"bar": lj.Holonomic(rod)}), "constraint 'bar' is there, but was not before"),
        (lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(lambda t, q, p: q["x"])}), "'rod': its value was"),
        (lj.System(lambda *s: cartesian_lagrangian(*s) + 0.1 * s[1]["x"], HELD), "Lagrangian: its value was"),
        (lj.System(cartesian_lagrangian, HELD, force=pull), "the force is there, but was not before"),
        (lj.System(lambda t, q, v, params: params["mass"]), "cannot be evaluated at a state of that motion"),
    ):
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path, other)
    with pytest.raises(TypeError, match="system must be a lj.System, not the function 'cartesian_lagrangian'"):
        lj.load_trajectory(path, cartesian_lagrangian)
    made_anew = lj.System(lambda *s: cartesian_lagrangian(*s), {"rod": lj.Holonomic(lambda *at: rod(*at))})
    np.testing.assert_array_equal(lj.load_trajectory(path, made_anew).q["x"], traj.q["x"])
