"""Accelerations and multipliers by hand, which other tools integrate, equal those from the Lagrangians."""

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import SCENES


def flat(tree):
    """All numbers of a tree."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SCENES)
def test_by_hand(name):
    """They agree at the start and at a later state; twin: for slightly different states and parameters they differ."""
    for run in (run for run in SCENES[name].runs() if run.by_hand is not None):
        traj = lj.integrate(run.system, run.q0, run.v0, run.params, ts=np.array([0.0, 0.37]) + run.ts[0], rtol=1e-12)
        of_motion = lambda y, i: jax.tree.map(lambda x: np.asarray(x)[i], y)
        for i in (0, 1):
            t, q, v = (of_motion(y, i) for y in (traj.t, traj.q, traj.v))
            expected = lj.accelerations(run.system, t, q, v, run.params)
            got = run.by_hand(t, q, v, run.params)
            size = np.max(np.abs(flat(expected)))
            np.testing.assert_allclose(flat(got), flat(expected), rtol=0, atol=1e-10 * size)
            parts = zip((1.001, 1.002, 0.998), (q, v, run.params))
            off = [jax.tree.map(lambda x, factor=factor: factor * np.asarray(x), part) for factor, part in parts]
            assert np.max(np.abs(flat(run.by_hand(t, *off)) - flat(expected))) > 1e-6 * size
