"""Lyapunov exponents against closed forms of linear systems, sums from damping, published chaos; through switches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.exponents import LyapunovExponents, _estimates
from tests.analysis.orbits.test_switching_flow import BELT, FLIPS, PERIOD, E, block, bounce, bouncing, stick_slip
from tests.by_numpy import by_numpy
from tests.systems import PARAMS, pendulum, rod_pendulum

G_OVER_L = PARAMS["g"] / PARAMS["l"]


def hill_lagrangian(t, q, v, p):
    """Two hills of different steepness, in coordinates that mix both."""
    return 0.5 * v @ v + 0.5 * p["k"] @ jnp.stack([q[0] + q[1], q[0] - q[1]]) ** 2 / 2


K = np.array([4.0, 0.5])
hill = lj.System(hill_lagrangian, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v @ v)


@pytest.mark.slow
@pytest.mark.parametrize("c", [0.0, 0.375])
def test_linear(c):
    """λ = -c/2 ± √(k + c²/4) for each k; they sum to -c for each freedom, and to zero without damping."""
    params, ts = {"k": K, "c": c}, np.linspace(0.0, 60.0, 61)
    found = lj.lyapunov_exponents(hill, np.zeros(2), np.zeros(2), params, ts=ts, count=4)
    found = jax.tree.map(np.asarray, found)
    exact = np.sort(np.concatenate([-c / 2 + s * np.sqrt(K + c**2 / 4) for s in (1, -1)]))[::-1]
    np.testing.assert_allclose(found.exponents, exact, atol=1e-7)
    np.testing.assert_array_less(np.abs(found.exponents - exact), found.uncertainty)
    np.testing.assert_allclose(np.sum(found.exponents), -2 * c, atol=1e-8)
    np.testing.assert_allclose(found.liouville, -2 * c, atol=1e-9)
    assert bool(found.sensitive)


def by_hand(ts, growth, volume):
    """The exponents of given growth from time to time."""
    exponents, uncertainty = by_numpy(_estimates)(ts, growth)
    return LyapunovExponents(exponents, uncertainty, ts, growth, volume, ts[len(ts) // 4], np.asarray(True), True)


def test_what_growth_says():
    """Means from a quarter of the times on, with an uncertainty that covers their spread; -inf where a tangent is lost.

    Printed: exponents, uncertainty, Liouville's sum; drawn: running means. Twin: the mean from the start is another.
    """
    ts, rng = np.linspace(0.0, 60.0, 61), np.random.default_rng(0)
    growth = np.array([2.0, -2.5]) + 0.5 * rng.normal(size=(60, 2))
    growth[:15] += 10.0
    found = by_hand(ts, growth, np.full(60, -0.5))
    np.testing.assert_allclose(found.exponents, growth[15:].mean(axis=0), rtol=1e-12)
    assert np.all(np.abs(found.exponents - growth.mean(axis=0)) > 1.0)
    error = 0.5 / np.sqrt(45)
    assert np.all(found.uncertainty > error) and np.all(found.uncertainty < 10 * error)
    assert "±" in repr(found) and "by Liouville's formula -0.5" in repr(found) and bool(found.sensitive)
    assert len(found.plot().axes[0].lines) == 2
    np.testing.assert_allclose(found.running()[-1], growth.sum(axis=0) / 60.0, rtol=1e-12)
    assert "no exponential parting" in repr(by_hand(ts, 0 * growth + 1 / 60, np.zeros(60)))
    growth[40, 1] = -np.inf
    lost = by_hand(ts, growth, np.full(60, np.nan))
    assert lost.exponents[1] == -np.inf and lost.uncertainty[1] == 0 and "neighbours meet" in repr(lost)


@pytest.mark.parametrize("ts, words", [(np.array([0.0, 100.0]), "at least 24 times"), (np.zeros(30), "must increase")])
def test_bad_times(ts, words):
    """Refused: too few or unsorted times."""
    with pytest.raises(ValueError, match=words):
        lj.lyapunov_exponents(pendulum, 2.0, 0.0, PARAMS, ts=ts)


@pytest.mark.exhaustive
def test_on_a_constraint():
    """Neighbours of an inverted rod pendulum separate as e^(±√(g/l) t), two exponents; hanging, they do not."""
    l, ts = PARAMS["l"], np.linspace(0.0, 10.0, 41)
    at = lambda y: ({"x": 0.0, "y": y}, {"x": 0.0, "y": 0.0})
    up = lj.lyapunov_exponents(rod_pendulum, *at(l), PARAMS, ts=ts, count=2)
    np.testing.assert_allclose(up.exponents, np.sqrt(G_OVER_L) * np.array([1, -1]), atol=1e-7)
    down = lj.lyapunov_exponents(rod_pendulum, *at(-l), PARAMS, ts=ts, count=2)
    assert bool(up.sensitive) and not bool(down.sensitive)
    with pytest.raises(ValueError, match="count must be between 1 and 2, not 3"):
        lj.lyapunov_exponents(rod_pendulum, *at(l), PARAMS, ts=ts, count=3)


@pytest.mark.slow
def test_regular():
    """A pendulum's neighbours separate like t: zero within the uncertainty, which shrinks; twin: not within a fifth."""
    run = lambda end: lj.lyapunov_exponents(pendulum, 2.0, 0.0, PARAMS, ts=np.linspace(0.0, end, 401), count=2)
    short, long = run(200.0), run(1000.0)
    for found in (short, long):
        np.testing.assert_array_less(np.abs(found.exponents), found.uncertainty)
        assert not bool(found.sensitive) and "no exponential parting" in repr(found)
        np.testing.assert_allclose(jnp.sum(found.exponents), 0.0, atol=1e-8)
    np.testing.assert_array_less(long.uncertainty, 0.3 * short.uncertainty)
    assert (np.abs(short.exponents) > 0.2 * short.uncertainty).any()


def henon_heiles_lagrangian(t, q, v, p):
    """Hénon & Heiles, U = ½ (x² + y²) + x² y - y³/3."""
    x, y = q[0], q[1]
    return 0.5 * v @ v - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3


henon_heiles = lj.System(henon_heiles_lagrangian)


def thrown(energy, y, vy):
    """A start on x = 0 with the given energy."""
    return np.array([0.0, y]), np.array([np.sqrt(2 * energy - y**2 + 2 * y**3 / 3 - vy**2), vy])


@pytest.mark.exhaustive
def test_henon_heiles():
    """The motion is chaotic at E = 1/6, with the published exponent, and regular at 1/12."""
    ts = np.linspace(0.0, 1500.0, 751)
    for energy, y, vy, sensitive in ((1 / 6, -0.2, 0.1, True), (1 / 12, 0.1, 0.0, False)):
        found = lj.lyapunov_exponents(henon_heiles, *thrown(energy, y, vy), ts=ts, count=4)
        assert bool(found.sensitive) == sensitive
        # Exponents come in pairs; two are zero: along the motion, and across energies.
        pairs = found.exponents + found.exponents[::-1]
        np.testing.assert_allclose(pairs, 0.0, atol=float(np.max(found.uncertainty)))
        assert abs(found.exponents[1]) < found.uncertainty[1]
        np.testing.assert_allclose(jnp.sum(found.exponents), 0.0, atol=1e-8)
        # Benettin, Galgani & Strelcyn, Phys. Rev. A 14 (1976) 2338, fig. 5: about 0.13 at E = 1/6.
        assert not sensitive or abs(found.exponents[0] - 0.13) < found.uncertainty[0]


BALL = {"A": 1.8 * FLIPS, "omega": 8.0, "e": E}


@pytest.mark.exhaustive
def test_ball_on_a_table():
    """Below the flip log|μ|/T of the orbit's multipliers, of which trace and product are known; far above it, chaos.

    At each impact areas shrink by e², which the sum of the exponents shows.
    """
    ts = np.arange(301) * PERIOD
    t, q, v, trace = bounce(0.07)
    regular = lj.lyapunov_exponents(bouncing, q, v, BALL | {"A": 0.07}, ts=t + ts, count=2)
    exact = np.log(np.abs(np.roots([1.0, -trace, E**2]))) / PERIOD
    np.testing.assert_array_less(np.abs(regular.exponents - np.sort(exact)[::-1]), regular.uncertainty)
    np.testing.assert_allclose(jnp.sum(regular.exponents), 2 * np.log(E) / PERIOD, atol=1e-9)
    chaotic = lj.lyapunov_exponents(bouncing, 2 * BALL["A"] + 0.5, 0.3, BALL, ts=ts, count=2)
    assert bool(chaotic.sensitive) and not bool(regular.sensitive)
    assert np.isnan(chaotic.liouville) and "Liouville" not in repr(chaotic)


@pytest.mark.exhaustive
def test_a_block_that_sticks():
    """Along a cycle the exponent is zero; across it neighbours meet, -inf, as the multiplier 0 says."""
    found = lj.lyapunov_exponents(block, 0.1, 0.25, BELT, ts=np.linspace(0.0, 10 * stick_slip(BELT), 101), count=2)
    assert bool(found.ended) and abs(found.exponents[0]) < found.uncertainty[0]
    assert found.exponents[1] == -np.inf and found.uncertainty[1] == 0
    assert "-inf" in repr(found) and "neighbours meet" in repr(found)
    # From the time at which growth is counted to a whole number of periods later, nothing has grown.
    np.testing.assert_allclose(np.sum(found.growth[30:90, 0]), 0.0, atol=1e-7)
    found.plot()
