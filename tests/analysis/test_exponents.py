"""Floquet multipliers: by Mathieu's characteristic values, Liouville's formula, and closed forms.

Lyapunov exponents against closed forms of linear systems, sums from damping, published chaos; through switches.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, special

import lagjax as lj
from lagjax.analysis.exponents import LyapunovExponents, _estimates
from tests.analysis.closed_forms import mathieu, slope_of_swinging, swinging
from tests.analysis.test_flow import BELT, FLIPS, PERIOD, E, block, bounce, bouncing, stick_slip
from tests.by_numpy import by_numpy
from tests.systems import DRIVEN_PARAMS, PARAMS, cartesian_lagrangian, driven, pendulum, rod_pendulum


@jax.jit
@jax.vmap
def swing(a, q):
    """M over half a turn of the drive's phase, its derivative by a, and whether it is stable."""

    def half_turn(a):
        found = lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": a, "q": q}, jnp.pi)
        return found.monodromy, found.stable

    (value, stable), (slope, _) = jax.jvp(half_turn, (a,), (jnp.ones_like(a),))
    return value, slope, stable


def boundaries():
    """(a, q, row, column, width): an even periodic solution has M_10 = 0, an odd one M_01 = 0; the tongue's width."""
    for q in (0.25, 1.0, 2.5, 5.0):
        yield special.mathieu_a(0, q), q, 1, 0, np.inf
        for order in range(1, 5):
            even, odd = special.mathieu_a(order, q), special.mathieu_b(order, q)
            yield even, q, 1, 0, even - odd
            yield odd, q, 0, 1, odd - even


BOUNDARIES = np.array(list(boundaries()))
A, Q, ROW, COLUMN, WIDTH = BOUNDARIES.T


def off(value, slope, row, column):
    """The distance of a from a zero of each entry of M."""
    at = np.arange(len(A)), row.astype(int), column.astype(int)
    return np.asarray(value)[at] / np.asarray(slope)[at]


@pytest.mark.slow
def test_boundaries_of_mathieu():
    """M has its zero at each boundary to 1e-9 in a; twins: a shift by 1e-7 is detected; the other entry has no zero."""
    value, slope, _ = swing(A, Q)
    np.testing.assert_array_less(np.abs(off(value, slope, ROW, COLUMN)), 1e-9)
    np.testing.assert_allclose(np.trace(value, axis1=1, axis2=2) ** 2, 4.0, rtol=1e-9)
    np.testing.assert_allclose(off(*swing(A + 1e-7, Q)[:2], ROW, COLUMN), 1e-7, rtol=1e-2)
    assert np.abs(off(value, slope, COLUMN, ROW)).min() > 1e-7


@pytest.mark.slow
def test_verdict_across_boundaries():
    """Unstable 1e-8 inside a tongue and stable 1e-8 outside, except in tongues too narrow for growth."""
    wide = np.abs(WIDTH) > 1e-2
    inside = -np.sign(WIDTH) * 1e-8
    assert not swing(A + inside, Q)[2][wide].any() and swing(A - inside, Q)[2][wide].all()
    # Twin: in the middle of a narrower tongue states grow, by 1e-4 in each period.
    narrow = (np.abs(WIDTH) < 1e-2) & (np.abs(WIDTH) > 1e-4)
    assert narrow.sum() == 4 and not swing(np.where(narrow, A - WIDTH / 2, A), Q)[2][narrow].any()


def moving_rod(t, q, p):
    """The rod from the moving pivot."""
    return q["x"] ** 2 + (q["y"] - p["A"] * jnp.cos(p["Omega"] * t)) ** 2 - p["l"] ** 2


SHAKEN = {"g": 9.8125, "l": 0.25, "A": 0.025}


@pytest.mark.exhaustive
def test_kapitza_on_a_rod():
    """Upright it is stable exactly where a > a_0(q), a = -4g/(lΩ²), q = 2A/l, near A²Ω² = 2gl; twin: not just below."""
    shaken = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(moving_rod)})
    start = {"x": 0.0, "y": SHAKEN["A"] + SHAKEN["l"]}, {"x": 0.0, "y": 0.0}
    edge = np.sqrt(-4 * SHAKEN["g"] / SHAKEN["l"] / special.mathieu_a(0, 2 * SHAKEN["A"] / SHAKEN["l"]))
    at = lambda Omega: lj.floquet(shaken, 0.0, *start, SHAKEN | {"Omega": Omega}, 2 * jnp.pi / Omega)
    assert list(jax.jit(jax.vmap(at))(edge * np.array([1 - 1e-6, 1 + 1e-6])).stable) == [False, True]
    # The boundary is near the limit of fast drives from the averaged equations.
    assert abs((SHAKEN["A"] * edge) ** 2 / (2 * SHAKEN["g"] * SHAKEN["l"]) - 1) < 0.01


@pytest.mark.exhaustive
def test_what_is_printed_and_drawn():
    """The summary has multipliers, verdict, Liouville's product and error; a flip and a pair are named."""
    found = lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": 1.0, "q": 0.25}, jnp.pi)
    words = repr(found)
    assert "below -1; what grows has twice the period" in words and "by Liouville's formula 1" in words
    assert len(found.plot().axes[0].lines) >= 2
    assert "1 ± " not in words and "±" in repr(lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": 2.0, "q": 0.25}, jnp.pi))
    lanes = jax.vmap(lambda a: lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": a, "q": 0.25}, jnp.pi))(jnp.array([1.0, 2.0]))
    assert "2 lanes, 1 of them stable" in repr(lanes)


def test_damped_and_driven():
    """M is the exponential of the linear system's matrix, and its volume is Liouville's; twin: with half the damping.

    The motion is q = Re(F exp(iωt)), F = pull / (k - m ω² + i c ω).
    """
    m, k, c, pull, rate = DRIVEN_PARAMS.values()
    response, period = pull / (k - m * rate**2 + 1j * c * rate), 2 * np.pi / rate
    found = lj.floquet(driven, 0.0, response.real, (1j * rate * response).real, DRIVEN_PARAMS, period)
    exact = lambda c: linalg.expm(period * np.array([[0.0, 1.0], [-k / m, -c / m]]))
    np.testing.assert_allclose(found.monodromy, exact(c), atol=1e-10)
    volumes, judged = jax.jit(lambda found: ((found.product, found.liouville), (found.attracts, found.stable)))(found)
    np.testing.assert_allclose(volumes, np.exp(-c / m * period), rtol=1e-9)
    np.testing.assert_allclose(np.abs(found.multipliers), np.exp(-c / m * period / 2), rtol=1e-9)
    assert all(map(bool, judged)) and not np.any(found.trivial)
    assert np.max(np.abs(exact(c / 2) - exact(c))) > 0.1


def test_refused_in_words():
    """Refused: a state that does not come back, a missing argument, neither a system nor an orbit."""
    with pytest.raises(ValueError, match="does not come back after period = 1: it is off by"):
        lj.floquet(pendulum, 0.0, 2.0, 0.0, PARAMS, 1.0)
    with pytest.raises(TypeError, match="needs period with a system"):
        lj.floquet(pendulum, 0.0, 2.0, 0.0, PARAMS)
    with pytest.raises(TypeError, match="a lj.System or a periodic orbit, not {'g'"):
        lj.floquet(PARAMS)


@pytest.mark.exhaustive
def test_liouville_on_a_rod():
    """R = ½ c v² gives the product e^(-cT) of the one freedom (without a rod: `test_damped_and_driven`)."""
    c, period = 0.375, 1.25
    start = {"x": 0.0, "y": -PARAMS["l"]}, {"x": 0.0, "y": 0.0}
    drag = lambda t, q, v, p: 0.5 * p["c"] * (v["x"] ** 2 + v["y"] ** 2)
    rod = lj.System(rod_pendulum.lagrangian, dict(rod_pendulum.constraints), dissipation=drag)
    on_rod = lj.floquet(rod, 0.0, *start, PARAMS | {"c": c}, period)
    assert on_rod.multipliers.shape == (2,)
    np.testing.assert_allclose(on_rod.liouville, np.exp(-c * period), rtol=1e-11)
    np.testing.assert_allclose(on_rod.product, np.exp(-c * period), rtol=1e-10)


@pytest.mark.exhaustive
def test_equations_that_fail():
    """A degenerate L and a NaN parameter are named in the message, also in the search for an orbit."""
    massless = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2 - q["x"] ** 2 - (q["y"] - q["x"]) ** 2)
    start = {"x": 1.0, "y": 1.0}, {"x": 0.0, "y": 0.0}
    with pytest.raises(ValueError, match="the mass matrix is singular in coordinate 'y'"):
        lj.floquet(massless, 0.0, *start, None, 1.0)
    with pytest.raises(ValueError, match="the mass matrix is singular in coordinate 'y'"):
        lj.periodic_orbit(massless, start, 4.0)
    with pytest.raises(ValueError, match="L is nan at t = 0"):
        lj.periodic_orbit(pendulum, (1.0, 0.0), 2.0, PARAMS | {"g": np.nan})


def test_pendulum():
    """M = 1 + (dT/dE) f dEᵀ in closed form, and both multipliers are 1 for a known reason."""
    amplitude = 2.0
    found = lj.floquet(pendulum, 0.0, amplitude, 0.0, PARAMS, swinging(amplitude))
    g_over_l = PARAMS["g"] / PARAMS["l"]
    slope = slope_of_swinging(amplitude)
    # With v = 0, f = (0, -g/l sin q). A start shifted by dq returns after T + T'dq, so after T it is off by -f T' dq.
    exact = np.array([[1.0, 0.0], [slope * g_over_l * np.sin(amplitude), 1.0]])
    np.testing.assert_allclose(found.monodromy, exact, atol=1e-9)
    np.testing.assert_array_equal(found.multipliers, [1.0, 1.0])
    assert found.trivial.all() and "1 (along the motion), 1 (across energies)" in repr(found)
    assert bool(found.stable) and "linearly stable" in found.verdict
    # Twin: at the equilibrium no multiplier is trivial; they are e^{±i ω T}.
    rest = lj.floquet(pendulum, 0.0, 0.0, 0.0, PARAMS, 1.0)
    np.testing.assert_allclose(rest.multipliers, np.exp([1j * np.sqrt(g_over_l), -1j * np.sqrt(g_over_l)]), rtol=1e-9)
    assert not rest.trivial.any()


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
