"""Copies and pickles: what the library returns works as well after `copy`, `pickle` and in another process."""

import copy
import multiprocessing
import pickle

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.systems import motion as motion_of

TS = np.linspace(0.0, 1.0, 4)
WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "tree.map": lambda x: jax.tree.map(lambda leaf: leaf, x),
}


def spring(t, q, v, params):
    """The Lagrangian of a unit mass on a spring, with a number in params that is not an array."""
    return 0.5 * v["x"] ** 2 - 0.5 * params["k"] ** params["power"] * q["x"] ** 2


system = lj.System(spring)


def swing(k):
    """The spring released at 1: x = cos k t."""
    return lj.integrate(system, {"x": 1.0}, {"x": 0.0}, {"k": k, "power": 2}, ts=TS)


def in_float64():
    """Settings as in `conftest.py`, for another process."""
    jax.config.update("jax_enable_x64", True)


def shown(motion):
    """Texts and values of a trajectory that need its system."""
    return repr(motion), float(motion.drift()), float(motion.residual())


def same(found, motion):
    """A copy has the text, structure, numbers and system of the original."""
    assert shown(found) == shown(motion) and found.system == motion.system and found.params == motion.params
    assert jax.tree.structure(found) == jax.tree.structure(motion) and bool(found.result == lj.RESULTS.successful)
    jax.tree.map(np.testing.assert_array_equal, (found.q, found.multipliers), (motion.q, motion.multipliers))


def test_trajectories():
    """A copied trajectory knows its system, and JAX treats both as equal."""
    for copied in WAYS.values():
        same(copied(motion_of("rod pendulum")), motion_of("rod pendulum"))


@pytest.mark.slow
def test_methods():
    """A copied method still takes its tolerances from the step-size controller, and gives the same motion."""
    start = {"x": 1.0}, {"x": 0.0}, {"k": 2.0, "power": 2}
    motion = lambda method: lj.integrate(system, *start, ts=TS, method=method, rtol=1e-6)
    known = motion(lj.Radau5())
    for way, copied in WAYS.items():
        found = motion(copied(lj.Radau5()))
        np.testing.assert_array_equal(found.q["x"], known.q["x"], err_msg=way)
        assert found.asked.method == lj.Radau5()


@pytest.mark.exhaustive
def test_another_process():
    """A trajectory can be sent to another process and back."""
    with multiprocessing.get_context("spawn").Pool(1, initializer=in_float64) as pool:
        motion = pool.apply(swing, (2.0,))
        same(motion, swing(2.0))
        np.testing.assert_allclose(motion.q["x"], np.cos(2.0 * TS), atol=1e-8)
        assert pool.apply(shown, (motion,)) == shown(motion)
