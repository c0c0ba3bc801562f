"""NUTS on a fit's density, in standardised coordinates, against known posteriors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

import lagjax as lj
from tests.fit.uncertainty.test_laplace import swing

pytestmark = pytest.mark.slow
DRAWS = 3000
# A large swing from rest, measured at four times: frequency and amplitude can compensate for each other.
TS, ROUGH, PRIOR = np.array([0.5, 1.0, 3.6, 3.8]), 0.2, (4.0, 1.5)


def nuts(density, n, key):
    """Draws (DRAWS, n) of a nearly standard normal density of z, started at its peak; the first 200 are discarded."""
    import blackjax

    kernel = blackjax.nuts(density, step_size=0.5, inverse_mass_matrix=jnp.ones(n))

    @jax.jit
    def chain(key):
        step = lambda state, key: (kernel.step(key, state)[0],) * 2
        return jax.lax.scan(step, kernel.init(jnp.zeros(n)), jax.random.split(key, DRAWS + 200))[1].position[200:]

    return chain(key)


def errors(x, mean, sd, quantile):
    """The deviations of mean, variance and the share below the 90 % quantile, in Monte-Carlo errors."""
    import blackjax

    size = lambda y: float(blackjax.diagnostics.effective_sample_size(jnp.asarray(y)[None]))
    x = np.asarray(x)
    squares, below = (x - mean) ** 2, (x < quantile).astype(float)
    return [
        (x.mean() - mean) / (sd / np.sqrt(size(x))),
        (squares.mean() - sd**2) / (squares.std() / np.sqrt(size(squares))),
        (below.mean() - 0.9) / (0.3 / np.sqrt(size(below))),
    ]


def angle(t, w2, amplitude):
    """The exact motion from rest, 2 arcsin(k cd(w t, k)) with k the sine of half the amplitude."""
    m = np.sin(amplitude / 2) ** 2
    _, cn, dn, _ = ellipj(np.sqrt(w2) * t, m)
    return 2 * np.arcsin(np.sqrt(m) * cn / dn)


def on_a_grid(data):
    """Mean, standard deviation and 90 % quantile of w2 and of the amplitude, by quadrature."""
    axes = np.linspace(0.5, 11.0, 900), np.linspace(0.3, 3.1, 800)
    w2, amplitude = np.meshgrid(*axes, indexing="ij")
    off = np.stack([(angle(t, w2, amplitude) - y) / ROUGH for t, y in zip(TS, data)] + [(w2 - PRIOR[0]) / PRIOR[1]])
    density = np.exp(-0.5 * np.sum(off**2, axis=0))
    density = density / density.sum()
    found = []
    for x, p in zip(axes, (density.sum(axis=1), density.sum(axis=0))):
        # The mass beyond the grid is negligible.
        assert max(p[:3].max(), p[-3:].max()) < 1e-8
        mean = x @ p
        found.append((mean, np.sqrt((x - mean) ** 2 @ p), np.interp(0.9, np.cumsum(p) - p / 2, x)))
    return found


@pytest.mark.exhaustive
def test_a_bent_posterior():
    """Draws for a large swing of unknown frequency and amplitude agree with quadrature of Jacobi's functions."""
    data = angle(TS, 4.0, 2.2) + ROUGH * np.random.default_rng(0).normal(size=4)
    # The run starts at its first time, where nothing is measured.
    times, angles = np.append(0.0, TS), np.append(np.nan, data)
    record = lj.Record(times, q=angles, q0=2.0, v0=0.0, hold_v=True, sigma=ROUGH)
    found = lj.fit(swing, record, {"w2": 4.0}, priors={"w2": PRIOR}, bounds={"w2": (0.0, None)})
    told = found.laplace()
    draws = told.unknowns(nuts(told.standardised(found.log_posterior), 2, jax.random.key(1)))
    normal = told.sample(jax.random.key(2), 10 * DRAWS)
    offset = told.mean[1] - float(found.sampling["starts"][0, 0])
    known = on_a_grid(data)
    both = lambda draws: (draws["w2"], draws["starts"][:, 0, 0] + offset)
    for x, exactly in zip(both(draws), known):
        assert np.max(np.abs(errors(x, *exactly))) < 4
    # Twin: Laplace's normal distribution does not agree, since the posterior is bent.
    assert all(np.max(np.abs(errors(x, *exactly))) > 8 for x, exactly in zip(both(normal), known))
