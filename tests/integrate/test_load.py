"""Trajectories from files: with the system passed again or not, and with the user's classes."""

from collections import namedtuple
from dataclasses import replace

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events.event import Crossings
from tests.integrate.test_data import Pair, Place, check, of_springs, springs
from tests.systems import PARAMS, motion, rod_pendulum


def test_system_given_again(tmp_path):
    """With its system a trajectory works as before; without, it has the computed values and says what is missing."""
    path, traj = tmp_path / "swing.npz", motion("rod pendulum")
    row = jax.tree.map(lambda x: np.asarray(x)[1:2], (traj.t, traj.q, traj.v, traj.multipliers))
    traj = replace(traj, events={"low": Crossings(*row, np.asarray(1), np.asarray(False))})
    again = check(traj, rod_pendulum, path)
    assert again.drift() == traj.drift() and again.residual() == traj.residual() and repr(again) == repr(traj)
    np.testing.assert_array_equal(again.jacobi_integral(), traj.jacobi_integral())
    without = lj.load_trajectory(path)
    assert "System(cartesian_lagrangian; constraints: rod (holonomic)), not given" in repr(without)
    assert without.params["g"] == PARAMS["g"] and without.events["low"].t[0] == 0.25
    assert len(without.plot().axes) == len(traj.plot().axes)
    for ask in (without.drift, without.residual, without.jacobi_integral, lambda: lj.energy_ledger(without)):
        with pytest.raises(ValueError, match=r"needs the functions of the system .*\n.*load_trajectory\(path, system="):
            ask()
    # A trajectory read without its system is written again with all that is known of the system.
    check(without, None, path)
    assert repr(lj.load_trajectory(path, rod_pendulum)) == repr(traj)


def test_classes_of_the_user_are_passed(tmp_path):
    """An object comes back if its class is passed; twins: without it, with another of other fields, with no class."""
    of_springs(Pair(1.0, 2.0)).save(tmp_path / "pair.npz")
    of_springs(Place(np.array(1.0), "here")).save(tmp_path / "place.npz")
    for name, cls in (("pair", Pair), ("place", Place)):
        path = tmp_path / f"{name}.npz"
        assert type(lj.load_trajectory(path, springs, classes=[cls]).q) is cls
        words = rf"of class {cls.__module__}.{cls.__name__}(.|\n)*Fix: classes=\[{cls.__name__}\]"
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path)
    for wrong, kind, words in (
        (namedtuple("Pair", ["x", "z"]), ValueError, "class Pair has no field y"),
        ((1, 2), TypeError, r"classes holds \(1, 2\), which is not the class of a named tuple"),
    ):
        with pytest.raises(kind, match=words):
            lj.load_trajectory(tmp_path / "pair.npz", classes=[wrong])


def test_float64_where_jax_works_in_float32(tmp_path):
    """It is refused, rather than silently losing half of the digits."""
    motion("pendulum").save(tmp_path / "x.npz")
    with jax.enable_x64(False), pytest.raises(ValueError, match="holds float64 arrays, and JAX works in 32 bits"):
        lj.load_trajectory(tmp_path / "x.npz")
