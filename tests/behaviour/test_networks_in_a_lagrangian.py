"""Networks inside L: a potential learned from motion, tested on states that it was not trained on."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.fit.problem.arguments import problem_of
from lagjax.fit.problem.residuals import WHOLE, equations
from lagjax.fit.search.search import linearised
from lagjax.numerics.windowed_least_squares import Unknowns

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


@pytest.mark.exhaustive
def test_a_learned_friction():
    """A force -v f(v²) other than viscous friction is learned for the velocities of the motions."""
    restoring = lambda t, q, v, params: 0.5 * v**2 + 9.0 * jnp.cos(q)
    rubs = lambda v: -(0.3 * jnp.tanh(3 * v) + 0.1 * v**3)
    truth = lj.System(restoring, force=lambda t, q, v, params: rubs(v))
    learned = lambda t, q, v, params: -v * params["friction"](v**2 / 4)
    system = lj.System(restoring, force=learned)
    rng, noise, ts = np.random.default_rng(0), 0.001, np.linspace(0.0, 6.0, 120)
    runs = [np.asarray(lj.integrate(truth, q0, 0.0, ts=ts).q) for q0 in (2.5, 1.5, -2.0)]
    measured = [lj.Record(ts, q=q + noise * rng.normal(size=len(ts)), sigma=noise) for q in runs]
    net = eqx.nn.MLP("scalar", "scalar", 6, 1, jnp.tanh, key=jax.random.key(0))
    options = {"priors": {"friction": (0.0, 10.0)}, "window": 2.0, "joined": False, "rtol": 1e-7, "atol": 1e-7}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.FitWarning)
        found = lj.fit(system, measured, {"friction": net}, **options)
    v = jnp.linspace(-3.5, 3.5, 71)
    of = lambda params: jax.vmap(lambda v: learned(0.0, 0.0, v, params))(v)
    off = lambda params: float(jnp.max(jnp.abs(of(params) - rubs(v)))) / float(jnp.max(jnp.abs(rubs(v))))
    assert off(found.params) < 0.03 < 0.5 < off({"friction": net})
    # Twin: viscous friction does not fit.
    viscous = lj.System(restoring, force=lambda t, q, v, params: -params["c"] * v)
    with pytest.warns(lj.FitWarning, match="times as large as sigma"):
        assert float(lj.fit(viscous, measured, {"c": 0.5}).rms()["q"]) > 10 * noise


@pytest.mark.exhaustive
def test_slopes_of_a_network_in_reverse():
    """The gradient of the cost by 193 weights is the same in one reverse pass and in forward mode along each."""
    net = eqx.nn.MLP("scalar", "scalar", 12, 2, jnp.tanh, key=jax.random.key(0))
    params, priors = {"potential": net}, {"potential": (0.0, 10.0)}
    options = {"rtol": 1e-9, "atol": 1e-9}
    problem = problem_of(learned, list(records()), params, None, None, None, priors, "squares", None, options)
    u = problem.start

    def cost(x):
        return 0.5 * sum(jnp.sum(part**2) for part in equations(problem, Unknowns(x, u.local), WHOLE))

    pulled = jax.jit(jax.grad(cost))(u.shared)
    values, slopes, _ = linearised(problem, u, WHOLE, "squares")
    pushed = jnp.einsum("wmp,wm->p", slopes.rows_by_shared, values.rows) + slopes.shared.T @ values.shared
    assert pushed.shape == (193,)
    np.testing.assert_allclose(pulled, pushed, atol=1e-6 * float(jnp.max(jnp.abs(pushed))))
