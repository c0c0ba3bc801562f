"""Reverse mode by replay equals forward mode on the scenes and the mechanisms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanisms import MECHANISMS
from lagjax.scenes import SCENES
from tests.integrate.test_replay import modes_agree

pytestmark = [pytest.mark.usefixtures("in_reverse"), pytest.mark.exhaustive]


def modes_of_motion_agree(run, ts, **options):
    """The modes agree along a direction of all parameters of a scene's run or of a mechanism."""
    random = np.random.default_rng(0)
    floats = jax.tree.map(lambda x: jnp.asarray(x, float), (run.params, run.q0, run.v0))
    # Starts stay on the constraints.
    moved = lambda x: jnp.asarray(0.1 * np.abs(x) * random.normal(size=np.shape(x)))
    direction = (jax.tree.map(moved, floats[0]), *jax.tree.map(jnp.zeros_like, floats[1:]))
    weigh = lambda x: jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0) * np.cos(np.arange(x.size).reshape(x.shape)))

    def total(at):
        params, q0, v0 = at
        traj = lj.integrate(run.system, q0, v0, params, ts=ts, rtol=1e-10, atol=1e-10, throw=False, **options)
        return sum(map(weigh, jax.tree.leaves((traj.q, traj.v, traj.multipliers))))

    modes_agree(total, floats, direction)


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    """The modes agree over a fifth of each run's time, or up to the event that ends the run."""
    for run in SCENES[name].runs():
        ts = run.ts[0] + np.linspace(0.0, 1.0 if run.events else 0.2, 7) * np.ptp(run.ts)
        modes_of_motion_agree(run, ts, events=run.events)


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms(name):
    """The modes agree over a short time; redundant mechanisms use the robust solve."""
    modes_of_motion_agree(MECHANISMS[name], np.linspace(0.0, min(MECHANISMS[name].end, 0.02), 7))
