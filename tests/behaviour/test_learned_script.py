"""What `benchmarks/learned` learns from is true."""

import jax
import numpy as np
import pytest

import lagjax as lj
from benchmarks.learned import systems as ls


@pytest.mark.slow
def test_what_is_learned_from_is_true():
    """Accelerations by a formula by hand and energies by T + V; smoothed states of known motions; the momenta's M."""
    q, v, a = map(np.asarray, ls.published_states(jax.random.key(0), 50, np.float64))
    s, c = np.sin(q[:, 0] - q[:, 1]), np.cos(q[:, 0] - q[:, 1])
    one = -(v[:, 1] ** 2) * s - 2 * 9.8 * np.sin(q[:, 0])
    two = v[:, 0] ** 2 * s - 9.8 * np.sin(q[:, 1])
    right = np.stack([one - c * two, 2 * two - c * one], 1) / (2 - c**2)[:, None]
    np.testing.assert_allclose(a, right, rtol=1e-9, atol=1e-9)
    # Twin: without the centrifugal terms it is another motion.
    assert np.abs(a - right).max() < 1e-6 < np.abs(v[:, 0] ** 2 * s).max()
    height = -9.8 * (2 * np.cos(q[:, 0]) + np.cos(q[:, 1]))
    kinetic = v[:, 0] ** 2 + 0.5 * v[:, 1] ** 2 + v[:, 0] * v[:, 1] * c
    np.testing.assert_allclose(ls.energy(ls.PUBLISHED, q, v), kinetic + height, rtol=1e-12, atol=1e-10)
    for truth in (ls.PUBLISHED, ls.STARS, ls.DAMPED):
        for k in range(5):
            mass = lj.mass_matrix(truth.system, 0.0, q[k], v[k], truth.params)
            np.testing.assert_allclose(truth.setting.mass(q[k]), mass, atol=1e-12)
    y, speed = ls.STARS.starts(np.random.default_rng(0), 9)
    np.testing.assert_allclose(ls.energy(ls.STARS, y, speed), 1 / 6.05, rtol=1e-12)
    times = np.arange(0.0, 8.0, 0.1)
    wave = np.stack([np.sin(times), np.cos(times)], 1)[None]
    cut = ls.windows(wave, 0.1, 21, 0.002)
    begin = 5 + 20 * np.arange(len(cut.q))
    np.testing.assert_allclose(cut.q[:, 0], wave[0, begin], atol=1e-12)
    rate = np.stack([np.cos(times), -np.sin(times)], 1)
    np.testing.assert_allclose(cut.start[:, 1], rate[begin], atol=2e-5)
    np.testing.assert_allclose(cut.states[2], -cut.states[0], atol=2e-3)
    noisy = ls.windows(wave + 0.002 * np.random.default_rng(0).standard_normal(wave.shape), 0.1, 21, 0.002)
    off = noisy.states[1] - cut.states[1]
    assert 0.7 < off.std() / cut.spread[1, 0] < 1.3
