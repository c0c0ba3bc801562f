"""Reverse mode by replay equals forward mode on the scenes and the mechanisms, and in batches of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanisms import MECHANISMS
from lagjax.scenes import SCENES
from tests.integrate.adjoint.test_replay import modes_agree

OUTPUTS = 7


pytestmark = pytest.mark.usefixtures("in_reverse")


def modes_of_motion_agree(system, q0, v0, params, ts, lanes=0, **options):
    """The modes agree along a direction of all parameters, of one motion or of lanes."""
    random = np.random.default_rng(0)
    floats = jax.tree.map(lambda x: jnp.asarray(x, float), (params, q0, v0))
    # Starts stay on the constraints.
    moved = lambda x: jnp.asarray(0.1 * np.abs(x) * random.normal(size=np.shape(x)))
    direction = (jax.tree.map(moved, floats[0]), *jax.tree.map(jnp.zeros_like, floats[1:]))
    weigh = lambda x: jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0) * np.cos(np.arange(x.size).reshape(x.shape)))

    def total(at, scale):
        params, q0, v0 = at
        params = jax.tree.map(lambda x: x * scale, params) if lanes else params
        traj = lj.integrate(system, q0, v0, params, ts=ts, rtol=1e-10, atol=1e-10, throw=False, **options)
        return sum(map(weigh, jax.tree.leaves((traj.q, traj.v, traj.multipliers))))

    of_lanes = lambda at: jnp.sum(jax.vmap(total, (None, 0))(at, jnp.linspace(1.0, 1.01, lanes)))
    modes_agree(of_lanes if lanes else lambda at: total(at, 1.0), floats, direction)


def of_run(run, share):
    """A run's start and parameters, and times over this share of it."""
    return run.system, run.q0, run.v0, run.params, run.ts[0] + np.linspace(0.0, share, OUTPUTS) * np.ptp(run.ts)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    """The modes agree over a fifth of each run's time, or up to the event that ends the run."""
    for run in SCENES[name].runs():
        modes_of_motion_agree(*of_run(run, 1.0 if run.events else 0.2), events=run.events)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms(name):
    """The modes agree over a short time; redundant mechanisms use the robust solve."""
    m = MECHANISMS[name]
    modes_of_motion_agree(m.system, m.q0, m.v0, m.params, np.linspace(0.0, min(m.end, 0.02), OUTPUTS))


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "name, of", [("bead_on_hoop", "driven about the tilt, omega = 6"), ("mass_distributions", "around the helix")]
)
def test_lanes_of_scenes(name, of):
    """The modes agree on derivatives of three lanes with different parameters by what they share."""
    (run,) = (run for run in SCENES[name].runs() if run.name == of)
    modes_of_motion_agree(*of_run(run, 0.2), lanes=3)
