"""Reverse mode by replay equals forward mode on the scenes and the mechanisms, and in batches of them."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanisms import MECHANISMS
from lagjax.scenes import SCENES
from tests.tiers import exhaustive_but

RUNS = {f"{name}, {run.name}": run for name, scene in SCENES.items() for run in scene.runs()}
SHOWN = (
    "bead_on_hoop, driven about the tilt, omega = 6",
    "rolling_hoop, until it leaves",
    "mass_distributions, around the helix",
)
OUTPUTS = 7


pytestmark = pytest.mark.usefixtures("in_reverse")


def modes_agree(system, q0, v0, params, ts, lanes=0, **options):
    """Along one direction of all parameters, forward mode equals the product of the gradient with that direction."""
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
    function = of_lanes if lanes else lambda at: total(at, 1.0)
    value, along = jax.jit(lambda at: jax.jvp(function, (at,), (direction,)))(floats)
    gradient = jax.jit(jax.grad(function))(floats)
    pairs = zip(jtu.tree_leaves(gradient[0]), jtu.tree_leaves(direction[0]))
    terms = np.array([float(jnp.sum(g * d)) for g, d in pairs])
    assert np.isfinite(float(value))
    np.testing.assert_allclose(terms.sum(), along, rtol=1e-8, atol=1e-8 * np.max(np.abs(terms)))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", exhaustive_but(SHOWN[:2], tuple(RUNS)))
def test_scenes(name):
    """The modes agree over a fifth of a run's time, or up to the event that ends the run."""
    run = RUNS[name]
    ts = np.linspace(run.ts[0], run.ts[0] + 0.2 * (run.ts[-1] - run.ts[0]), OUTPUTS)
    ts = np.linspace(run.ts[0], run.ts[-1], OUTPUTS) if run.events else ts
    modes_agree(run.system, run.q0, run.v0, run.params, ts, events=run.events)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", exhaustive_but(("double_pendulum",), tuple(MECHANISMS)))
def test_mechanisms(name):
    """The modes agree over a short time; redundant mechanisms use the robust solve."""
    m = MECHANISMS[name]
    modes_agree(m.system, m.q0, m.v0, m.params, np.linspace(0.0, min(m.end, 0.02), OUTPUTS))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SHOWN[::2])
def test_lanes_of_scenes(name):
    """The modes agree on derivatives of three lanes with different parameters by what they share."""
    run = RUNS[name]
    ts = np.linspace(run.ts[0], run.ts[0] + 0.2 * (run.ts[-1] - run.ts[0]), OUTPUTS)
    modes_agree(run.system, run.q0, run.v0, run.params, ts, lanes=3)
