"""Floquet multipliers: by Mathieu's characteristic values, Liouville's formula, and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

import lagjax as lj
from tests.systems import PARAMS, pendulum, rod_pendulum


def mathieu_lagrangian(t, q, v, p):
    """x'' + (a - 2 q cos 2t) x = 0."""
    return 0.5 * v**2 - 0.5 * (p["a"] - 2 * p["q"] * jnp.cos(2 * t)) * q**2


mathieu = lj.System(mathieu_lagrangian)


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


def kapitza_lagrangian(t, q, v, p):
    """A pendulum by its angle from the upward vertical, its pivot moving up and down as A cos Ωt."""
    at = lambda t, q: jnp.stack([p["l"] * jnp.sin(q), p["A"] * jnp.cos(p["Omega"] * t) + p["l"] * jnp.cos(q)])
    place, speed = jax.jvp(at, (t, q), (jnp.ones_like(t), v))
    return 0.5 * speed @ speed - p["g"] * place[1]


kapitza = lj.System(kapitza_lagrangian)


def free_lagrangian(t, q, v, p):
    """A unit mass in a vertical plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["g"] * q["y"]


def moving_rod(t, q, p):
    """The rod from the moving pivot."""
    return q["x"] ** 2 + (q["y"] - p["A"] * jnp.cos(p["Omega"] * t)) ** 2 - p["l"] ** 2


kapitza_rod = lj.System(free_lagrangian, {"rod": lj.Holonomic(moving_rod)})
SHAKEN = {"g": 9.8125, "l": 0.25, "A": 0.025}


def upright(Omega, system=kapitza):
    """The pendulum at rest on its moving pivot, upright."""
    params = {**SHAKEN, "Omega": Omega}
    start = (0.0, 0.0)
    if system is kapitza_rod:
        start = {"x": 0.0, "y": SHAKEN["A"] + SHAKEN["l"]}, {"x": 0.0, "y": 0.0}
    return lj.floquet(system, 0.0, *start, params, 2 * jnp.pi / Omega)


@pytest.mark.slow
def test_kapitza():
    """Upright it is stable exactly where a > a_0(q), a = -4g/(lΩ²), q = 2A/l, near A²Ω² = 2gl; twin: not just below."""
    edge = np.sqrt(-4 * SHAKEN["g"] / SHAKEN["l"] / special.mathieu_a(0, 2 * SHAKEN["A"] / SHAKEN["l"]))
    found = jax.jit(jax.vmap(upright))(edge * np.array([1 - 1e-7, 1 + 1e-7]))
    assert list(found.stable) == [False, True]
    # The boundary is near the limit of fast drives from the averaged equations.
    assert abs((SHAKEN["A"] * edge) ** 2 / (2 * SHAKEN["g"] * SHAKEN["l"]) - 1) < 0.01


@pytest.mark.exhaustive
def test_kapitza_on_a_moving_constraint():
    """In Cartesian coordinates, on a rod with a moving pivot, the two multipliers are the same."""
    for Omega in (60.0, 100.0):
        rod, angle = upright(Omega, kapitza_rod), upright(Omega)
        np.testing.assert_allclose(np.sort_complex(rod.multipliers), np.sort_complex(angle.multipliers), rtol=1e-7)
        assert bool(rod.stable) == (Omega == 100.0)


def elliptic(amplitude, params):
    """The pendulum's period, 4 √(l/g) K(sin²(amplitude/2))."""
    return 4 * np.sqrt(params["l"] / params["g"]) * special.ellipk(np.sin(amplitude / 2) ** 2)


def test_pendulum():
    """M = 1 + (dT/dE) f dEᵀ in closed form, and both multipliers are 1 for a known reason."""
    amplitude = 2.0
    found = lj.floquet(pendulum, 0.0, amplitude, 0.0, PARAMS, elliptic(amplitude, PARAMS))
    g_over_l = PARAMS["g"] / PARAMS["l"]
    m = np.sin(amplitude / 2) ** 2
    k, e = special.ellipk(m), special.ellipe(m)
    slope = 4 / np.sqrt(g_over_l) * (e - (1 - m) * k) / (2 * m * (1 - m)) * np.sin(amplitude) / 2
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


def kepler_lagrangian(t, q, v, p):
    """A unit mass attracted by -μ/r."""
    return 0.5 * v @ v + p["mu"] / jnp.sqrt(q @ q)


@pytest.mark.exhaustive
def test_kepler():
    """All four multipliers are 1, two of them for known reasons, the others to 1e-5; and M is not the identity."""
    mu, speed = 1.25, 1.25
    period = 2 * np.pi / np.sqrt(mu) * (2 - speed**2 / mu) ** -1.5
    found = lj.floquet(
        lj.System(kepler_lagrangian), 0.0, jnp.array([1.0, 0.0]), jnp.array([0.0, speed]), {"mu": mu}, period
    )
    np.testing.assert_allclose(found.multipliers, 1.0, atol=1e-5)
    assert found.trivial.sum() == 2 and bool(found.stable)
    # All orbits of an energy have one period: M - 1 has rank one, f times the slope of the energy.
    np.testing.assert_allclose(np.linalg.svd(found.monodromy - np.eye(4))[1][1:], 0.0, atol=1e-8)
    assert np.abs(found.monodromy - np.eye(4)).max() > 1


def on_a_sphere(t, q, v, p):
    """A unit mass under gravity in three dimensions."""
    return 0.5 * v @ v - p["g"] * q[2]


@pytest.mark.slow
def test_conical_pendulum():
    """Circling at an angle θ it swings about that √(1 + 3 cos² θ) times in a turn, with a constraint given twice.

    Landau & Lifshitz, *Mechanics*, §14, problem 1: by the effective potential. The rotation is a symmetry that the
    coordinates do not show, and here it is the motion itself.
    """
    rod = lj.Holonomic(lambda t, q, p: q @ q - p["l"] ** 2)
    again = lj.Holonomic(lambda t, q, p: 1.0 - q @ q / p["l"] ** 2)
    theta, g, l = 1.0, 9.8125, 1.25
    rate = np.sqrt(g / (l * np.cos(theta)))
    start = l * np.array([np.sin(theta), 0.0, -np.cos(theta)]), rate * l * np.array([0.0, np.sin(theta), 0.0])
    system = lj.System(on_a_sphere, {"rod": rod, "again": again})
    found = lj.floquet(system, 0.0, *start, {"g": g, "l": l}, 2 * np.pi / rate)
    phase = 2 * np.pi * np.sqrt(1 + 3 * np.cos(theta) ** 2)
    assert found.multipliers.shape == (4,) and found.trivial.tolist() == [True, True, False, False]
    np.testing.assert_allclose(
        found.multipliers[2:], np.cos(phase) + 1j * np.abs(np.sin(phase)) * np.array([1, -1]), atol=1e-9
    )
    assert bool(found.stable) and not bool(found.attracts)
    with pytest.raises(ValueError, match="nothing is left to move.*\n.*depend on each other"):
        jax.jit(lambda g: lj.floquet(doubled(3), 0.0, *start, {"g": g, "l": l}, 1.0).multipliers)(g)


def doubled(count):
    """The same rod several times."""
    rod = lj.Holonomic(lambda t, q, p: q @ q - p["l"] ** 2)
    return lj.System(on_a_sphere, {f"rod {i}": rod for i in range(count)})


def van_der_pol_lagrangian(t, q, v, p):
    """A unit mass on a unit spring."""
    return 0.5 * v**2 - 0.5 * q**2


van_der_pol = lj.System(van_der_pol_lagrangian, force=lambda t, q, v, p: p["mu"] * (1 - q**2) * v)
# To 16 digits in Andersen & Geer, SIAM J. Appl. Math. 42 (1982) 678; and Amore et al., 2018.
PERIOD_AT_1 = 6.663286859323130


def test_van_der_pol():
    """The cycle attracts; the multiplier is e^∮μ(1-q²)dt by SciPy; twin: under the other sign of μ it repels."""
    orbit = lj.periodic_orbit(van_der_pol, (2.0, 0.0), 6.5, {"mu": 1.0})
    found = lj.floquet(van_der_pol, 0.0, orbit.q, orbit.v, {"mu": 1.0}, orbit.period)
    np.testing.assert_allclose(orbit.period, PERIOD_AT_1, rtol=1e-12)

    def rate(t, y):
        return [y[1], (1 - y[0] ** 2) * y[1] - y[0], 1 - y[0] ** 2]

    end = integrate.solve_ivp(rate, [0, PERIOD_AT_1], [orbit.q, orbit.v, 0.0], rtol=1e-12, atol=1e-13).y[2, -1]
    assert found.trivial.tolist() == [True, False] and bool(found.attracts)
    np.testing.assert_allclose(found.multipliers[1], np.exp(end), rtol=1e-8)
    np.testing.assert_allclose(found.product, found.liouville, rtol=1e-7)
    # Backward in time the cycle is the same, but repels.
    away = lj.floquet(van_der_pol, 0.0, orbit.q, -orbit.v, {"mu": -1.0}, orbit.period)
    np.testing.assert_allclose(away.multipliers[1], np.exp(-end), rtol=1e-8)
    assert not bool(away.stable) and "above 1" in away.verdict


@pytest.mark.slow
def test_liouville_with_damping():
    """With and without a rod, R = ½ c v² gives the product e^(-cT) for each freedom; twin: 2R gives its square."""
    c, period = 0.375, 1.25
    for factor in (1.0, 2.0):
        damped = lj.System(
            pendulum.lagrangian, dissipation=lambda t, q, v, p, factor=factor: 0.5 * factor * p["c"] * v**2
        )
        found = lj.floquet(damped, 0.0, 0.0, 0.0, PARAMS | {"c": c}, period)
        np.testing.assert_allclose(found.liouville, np.exp(-factor * c * period), rtol=1e-11)
        np.testing.assert_allclose(found.product, found.liouville, rtol=1e-10)
    start = {"x": 0.0, "y": -PARAMS["l"]}, {"x": 0.0, "y": 0.0}
    drag = lambda t, q, v, p: 0.5 * p["c"] * (v["x"] ** 2 + v["y"] ** 2)
    rod = lj.System(rod_pendulum.lagrangian, dict(rod_pendulum.constraints), dissipation=drag)
    on_rod = lj.floquet(rod, 0.0, *start, PARAMS | {"c": c}, period)
    assert on_rod.multipliers.shape == (2,)
    np.testing.assert_allclose(on_rod.liouville, np.exp(-c * period), rtol=1e-11)
    np.testing.assert_allclose(on_rod.product, np.exp(-c * period), rtol=1e-10)


@pytest.mark.exhaustive
def test_derivatives():
    """The derivative of Mathieu's largest multiplier by a, both modes, against the discriminant D: μ + 1/μ = D."""
    largest = lambda a: lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": a, "q": 0.25}, jnp.pi).largest
    value, slope, _ = swing(np.append(1.0, A[1:]), np.append(0.25, Q[1:]))
    mu = float(jax.jit(largest)(1.0))
    # Here μ < -1, so `largest` is -μ.
    exact = -float(jnp.trace(slope[0])) / (1 - mu**-2)
    np.testing.assert_allclose(-mu - 1 / mu, jnp.trace(value[0]), rtol=1e-11)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(largest))(1.0), exact, rtol=1e-9)


@pytest.mark.slow
def test_sweep_of_stability():
    """A map of the tongues by `lj.sweep`: at each point the verdict is that of Mathieu's characteristic values."""

    def run(point):
        found = lj.floquet(mathieu, 0.0, 0.0, 0.0, point, jnp.pi)
        return {"stable": found.stable, "growth": jnp.max(found.exponents.real)}

    a, q = np.linspace(-1.0, 9.0, 41), np.linspace(0.05, 4.0, 21)
    swept = lj.sweep(run, {"a": jnp.asarray(a), "q": jnp.asarray(q)}, progress=False)
    stable = np.asarray(swept.values["stable"])
    edges = [lambda q: special.mathieu_a(0, q)]
    for order in range(1, 5):
        edges += [lambda q, n=order: special.mathieu_b(n, q), lambda q, n=order: special.mathieu_a(n, q)]
    above = sum((a[:, None] > np.array([edge(x) for x in q])[None]).astype(int) for edge in edges)
    np.testing.assert_array_equal(stable, above % 2 == 1)
    assert (np.asarray(swept.values["growth"])[~stable] > 0).all() and 0.2 < stable.mean() < 0.9


@pytest.mark.slow
def test_what_is_printed_and_drawn():
    """The summary has multipliers, verdict, Liouville's product and error; a flip and a pair are named."""
    found = lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": 1.0, "q": 0.25}, jnp.pi)
    words = repr(found)
    assert "below -1; what grows has twice the period" in words and "by Liouville's formula 1" in words
    assert len(found.plot().axes[0].lines) >= 2
    assert "1 ± " not in words and "±" in repr(lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": 2.0, "q": 0.25}, jnp.pi))
    lanes = jax.vmap(lambda a: lj.floquet(mathieu, 0.0, 0.0, 0.0, {"a": a, "q": 0.25}, jnp.pi))(jnp.array([1.0, 2.0]))
    assert "2 lanes, 1 of them stable" in repr(lanes)


def test_refused_in_words():
    """Refused: a state that does not come back, a missing argument, neither a system nor an orbit."""
    with pytest.raises(ValueError, match="does not come back after period = 1: it is off by"):
        lj.floquet(pendulum, 0.0, 2.0, 0.0, PARAMS, 1.0)
    with pytest.raises(TypeError, match="needs period with a system"):
        lj.floquet(pendulum, 0.0, 2.0, 0.0, PARAMS)
    with pytest.raises(TypeError, match="a lj.System or a periodic orbit, not dict"):
        lj.floquet(PARAMS)


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
