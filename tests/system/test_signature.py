"""A system is known by what its functions return at a state."""

import pytest

import lagjax as lj
from tests.integrate.trajectory.test_save import falling, on_rod, rod, swing


def test_another_system_is_told(tmp_path):
    """Another system is refused by what differs at a state; twin: the same functions, redefined, are accepted."""
    path = tmp_path / "swing.npz"
    swing().save(path)
    pull = lambda t, q, v, params: {"x": 0.0 * q["x"], "y": 0.0 * q["y"]}
    for other, words in (
        (lj.System(falling), "the constraint 'rod' is missing"),
        (lj.System(falling, {"bar": lj.Holonomic(on_rod)}), "the constraint 'bar' is there, but was not before"),
        (lj.System(falling, {"rod": lj.Holonomic(lambda t, q, params: q["x"])}), "the constraint 'rod': its value was"),
        (lj.System(lambda *state: falling(*state) + 0.1 * state[1]["x"], rod.constraints), "Lagrangian: its value was"),
        (lj.System(falling, rod.constraints, force=pull), "the force is there, but was not before"),
        (lj.System(lambda t, q, v, params: params["mass"]), "cannot be evaluated at a state of that motion"),
    ):
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path, other)
    with pytest.raises(TypeError, match="system must be a lj.System, not function"):
        lj.load_trajectory(path, falling)
    made_anew = lj.System(lambda *state: falling(*state), {"rod": lj.Holonomic(lambda *at: on_rod(*at))})
    assert lj.load_trajectory(path, made_anew).drift() < 1e-6
