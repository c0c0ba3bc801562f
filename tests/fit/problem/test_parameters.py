"""Single numbers of any parameters are fitted, the others stay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.fit import unknowns


def found_priors(params, priors={}, error=1.0):
    """The names of all numbers with a prior, with its mean and standard deviation, and the entries with weak ones."""
    found = unknowns.find(params, None, {}, priors, np.dtype(float), error)
    rows = zip(found.names, found.mean, found.sd)
    return {name: (float(mean), float(sd)) for name, mean, sd in rows if np.isfinite(sd)}, found.weak


def test_which_numbers_have_weak_priors():
    """Weights beside a mass, about their guesses and three times as wide as these are large; twins have none."""
    net = {"b": jnp.zeros(2), "w": jnp.array([[3.0, -4.0]])}
    weak, entries = found_priors({"m": 2.0, "net": net})
    sd = 3 * np.sqrt(25 / 4)
    assert entries == ("net",)
    assert weak == {"net.b[0]": (0, sd), "net.b[1]": (0, sd), "net.w[0, 0]": (3, sd), "net.w[0, 1]": (-4, sd)}
    # Without sigma residuals are in units of the data's spread, and an error is a small part of it.
    assert found_priors({"m": 2.0, "net": net}, error=0.1)[0]["net.b[0]"] == (0, pytest.approx(10 * sd))
    assert found_priors({"m": 2.0, "net": jax.tree.map(jnp.zeros_like, net)})[0]["net.b[1]"] == (0, 3.0)
    # Its own prior counts, and the others stay.
    own, _ = found_priors({"m": 2.0, "net": net}, {"net.b": (0.5, 0.1), "m": (2.0, 0.3)})
    assert own["net.b[1]"] == (0.5, 0.1) and own["m"] == (2.0, 0.3) and own["net.w[0, 0]"] == (3, 3 * np.sqrt(25 / 2))
    for params, priors in (
        ({"net": net}, {}),
        ({"m": 2.0, "net": net}, {"net": None}),
        ({"m": 2.0, "stiffness": net["w"]}, {}),
        ({"m": 2.0, "arm": {"length": 1.0, "offset": jnp.ones(3)}}, {}),
    ):
        assert found_priors(params, priors) == ({}, ())


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lagjax.FitWarning")
def test_weights_beside_a_spring(sigma=0.01):
    """The stiffness beside a network of friction is right to its standard error, and no weight runs away; twin: they do
    without the weak priors."""
    friction = lambda v, of: -0.1 * v * jax.nn.softplus(of(v**2))
    system = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * q**2, force=lambda t, q, v, p: friction(v, p["net"])
    )
    truth = lj.System(lambda t, q, v, p: 0.5 * v**2 - 2.0 * q**2, force=lambda t, q, v, p: -0.1 * v - 0.1 * v**3)
    ts, random = np.linspace(0.0, 6.0, 61), np.random.default_rng(0)
    records = []
    for q0, v0 in ((1.0, 0.0), (0.5, -0.5)):
        q = lj.integrate(truth, q0, v0, ts=ts).q + sigma * random.normal(size=len(ts))
        records.append(lj.Record(ts, q=q, sigma=sigma))

    def moved(priors):
        guess = {"k": 3.0, "net": lj.learned.Network(1.0, key=jax.random.key(2), width=8, depth=1)}
        found = lj.fit(system, records, guess, priors=priors, rtol=1e-7, atol=1e-7)
        k = found.names.index("k")
        return found, abs(found.values[k] - 4.0) / found.sd[k], np.max(np.abs(found.values - found.problem.found.start))

    found, errors, largest = moved(None)
    assert found.converged and errors < 3 and largest < 2.0
    assert "weak priors about their guesses for the weights of 'net'; none: priors={\"net\": None}" in repr(found)
    without, _, ran = moved({"net": None})
    assert ran > 10 * largest and "weak" not in repr(without)
