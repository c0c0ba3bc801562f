"""Networks inside L: a potential learned from motion, tested on states that it was not trained on."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

TS = np.linspace(0.0, 6.0, 60)
STARTS = [(-1.6, 0.0), (-0.2, 0.1), (0.3, 0.0), (1.5, 0.2)]


def well(q):
    """A double well."""
    return 0.25 * (q**2 - 1) ** 2


true = lj.System(lambda t, q, v, params: 0.5 * v**2 - well(q))
learned = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["potential"](q))


def records():
    """Four motions with errors of 0.002."""
    rng = np.random.default_rng(0)
    for q0, v0 in STARTS:
        q = np.asarray(lj.integrate(true, q0, v0, ts=TS).q)
        yield lj.Record(TS, q=q + 0.002 * rng.normal(size=len(TS)), q0=q0, v0=v0, sigma=0.002)


def error(potential):
    """The largest difference from the true potential in the range of the motions, up to a constant."""
    q = jnp.linspace(-1.6, 1.6, 33)
    difference = jax.vmap(potential)(q) - well(q)
    return float(jnp.max(jnp.abs(difference - jnp.mean(difference))))


def train(width, depth, **options):
    """A fit of all weights, without the warning that single ones are not determined."""
    net = eqx.nn.MLP("scalar", "scalar", width, depth, jnp.tanh, key=jax.random.key(0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.FitWarning)
        options = dict(priors={"potential": (0.0, 10.0)}, window=1.0, joined=False, rtol=1e-7, atol=1e-7) | options
        return net, lj.fit(learned, list(records()), {"potential": net}, **options)


@pytest.mark.exhaustive
def test_a_learned_potential():
    """From four noisy motions by Levenberg-Marquardt: the potential, and a motion that was not trained on."""
    net, found = train(10, 1)
    potential = found.params["potential"]
    assert error(potential) < 0.1 < 0.5 < error(net)
    assert float(found.chi2 / found.freedom) < 2
    ts = np.linspace(0.0, 10.0, 50)
    there = [lj.integrate(s, 0.9, 0.5, p, ts=ts).q for s, p in ((true, None), (learned, found.params))]
    assert float(jnp.max(jnp.abs(there[0] - there[1]))) < 0.1
    assert "31 numbers" in repr(found.identifiability)
