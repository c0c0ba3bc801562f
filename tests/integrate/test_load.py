"""Trajectories from files: with the system passed again or not, and with the user's classes."""

from collections import namedtuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.trajectory.test_save import TS, Pair, Place, check, rod, springs, swing


def test_system_given_again(tmp_path):
    """With its system a trajectory works as before; without, it has the computed values and says what is missing."""
    path = tmp_path / "swing.npz"
    traj = swing(events={"low": lj.Crossing(lambda t, q, v, params: q["y"] + 0.9, terminal=False)})
    again = check(traj, rod, path)
    assert again.drift() == traj.drift() and again.residual() == traj.residual()
    np.testing.assert_array_equal(again.jacobi_integral(), traj.jacobi_integral())
    without = lj.load_trajectory(path)
    assert "System(falling; constraints: rod (holonomic)), not given" in repr(without)
    assert without.params["g"] == 9.81 and without.events["low"].t[0] == traj.events["low"].t[0]
    assert len(without.plot().axes) == len(traj.plot().axes)
    for ask in (without.drift, without.residual, without.jacobi_integral, lambda: lj.energy_ledger(without)):
        with pytest.raises(ValueError, match=r"needs the functions of the system .*\n.*load_trajectory\(path, system="):
            ask()
    # A trajectory read without its system is written again with all that is known of the system.
    check(without, None, path)
    assert repr(lj.load_trajectory(path, rod)) == repr(traj)


def test_classes_of_the_user_are_passed(tmp_path):
    """An object comes back if its class is passed; twins: without it, with another of other fields, with no class."""
    of = lambda q0, v0: lj.integrate(springs, q0, v0, ts=TS)
    of(Pair(1.0, 2.0), Pair(0.0, 0.0)).save(tmp_path / "pair.npz")
    of(Place(jnp.array(1.0), "here"), Place(jnp.array(0.0), "here")).save(tmp_path / "place.npz")
    for name, cls in (("pair", Pair), ("place", Place)):
        assert type(lj.load_trajectory(tmp_path / f"{name}.npz", springs, classes=[cls]).q) is cls
        words = rf"of class {cls.__module__}.{cls.__name__}(.|\n)*Fix: classes=\[{cls.__name__}\]"
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(tmp_path / f"{name}.npz")
    another = namedtuple("Pair", ["x", "z"])
    with pytest.raises(ValueError, match="class Pair has no field y"):
        lj.load_trajectory(tmp_path / "pair.npz", classes=[another])
    with pytest.raises(TypeError, match=r"classes holds \(1, 2\), which is not the class of a named tuple"):
        lj.load_trajectory(tmp_path / "pair.npz", classes=[(1, 2)])


@pytest.mark.slow
def test_float64_where_jax_works_in_float32(tmp_path):
    """It is refused, rather than silently losing half of the digits."""
    lj.integrate(springs, 1.0, 0.0, ts=TS).save(tmp_path / "x.npz")
    with jax.enable_x64(False), pytest.raises(ValueError, match="holds float64 arrays, and JAX works in 32 bits"):
        lj.load_trajectory(tmp_path / "x.npz")
