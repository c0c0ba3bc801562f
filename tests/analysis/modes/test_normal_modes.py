"""Small motions and their modes against closed forms, published values, and roots in high precision."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import cross_rails
from tests.analysis import small_systems as small
from tests.systems import DOUBLE_PARAMS, double_pendulum, double_rods, rod_pendulum

BEAD = {"a": 1.25, "g": 9.8125, "omega": 2.0}
STILL = {"x": 0.0, "y": 0.0}
EQUAL = {"rtol": 1e-10, "atol": 0.0}


def rails(params):
    """The modes of the carriage at rest on its rails."""
    at = {"R": cross_rails.equilibrium_length(params), "r": 0.0}
    return lj.normal_modes(cross_rails.rotating_system, 0.0, at, {"R": 0.0, "r": 0.0}, params)


# One degree of freedom.


def bead_frequency(omega):
    """The frequency at the bottom below the critical speed, and at α with cos α = g/(a ω²) above it."""
    ratio = BEAD["g"] / (BEAD["a"] * omega**2)
    at = jnp.arccos(jnp.minimum(ratio, 1.0)) if omega**2 > BEAD["g"] / BEAD["a"] else 0.0
    return lj.normal_modes(small.bead, 0.0, at, 0.0, BEAD | {"omega": omega}).frequency[0]


def test_the_bead():
    """√(ω0² - ω²) below, ω sin α above, and derivatives by ω, to 1e-10 and 1e-8; twin: not the other formula."""
    squared = BEAD["g"] / BEAD["a"]
    frequency = jax.jit(
        jax.vmap(
            jax.value_and_grad(
                lambda at: lj.normal_modes(small.bead, 0.0, at[0], 0.0, BEAD | {"omega": at[1]}).frequency[0]
            )
        )
    )
    below = np.array([0.5, 2.0, 2.7])
    got, slope = frequency(np.stack([0.0 * below, below], axis=1))
    np.testing.assert_allclose(got, np.sqrt(squared - below**2), **EQUAL)
    np.testing.assert_allclose(slope[:, 1], -below / np.sqrt(squared - below**2), rtol=1e-8)
    above = np.array([2.9, 4.0, 9.0])
    alpha = np.arccos(squared / above**2)
    got, slope = frequency(np.stack([alpha, above], axis=1))
    np.testing.assert_allclose(got, above * np.sin(alpha), **EQUAL)
    # The equilibrium moves with ω, dα/dω = 2 cos α / (ω sin α); the frequency is ω sin α = √(ω² - ω0⁴/ω²).
    whole = slope[:, 1] + slope[:, 0] * 2 * np.cos(alpha) / (above * np.sin(alpha))
    np.testing.assert_allclose(whole, (above + squared**2 / above**3) / got, rtol=1e-8)
    assert np.min(np.abs(got / np.sqrt(above**2 - squared) - 1)) > 1e-3


def test_verdicts_of_the_bead():
    """Stable or divergent at the bottom and the top, below and above the critical speed; at it θ⁴ decides."""
    says = lambda at, omega: lj.normal_modes(small.bead, 0.0, at, 0.0, BEAD | {"omega": omega}).verdict
    assert [says(0.0, 2.0), says(0.0, 3.0), says(np.pi, 2.0)] == ["stable", "divergence", "divergence"]
    exactly = BEAD | {"a": 1.0, "g": 4.0, "omega": 2.0}
    modes = lj.normal_modes(small.bead, 0.0, 0.0, 0.0, exactly)
    assert modes.verdict == "stable" and bool(modes.zero[0]) and bool(modes.stable)
    assert np.isfinite(modes.roots).all()


# Constraints.


def test_the_force_of_a_constraint_is_in_the_stiffness():
    """A rod pendulum in Cartesian coordinates gets g/l from λ·∂²g alone; L itself has no stiffness."""
    params = {"g": 9.8125, "l": 1.25}
    modes = lj.normal_modes(rod_pendulum, 0.0, {"x": 0.0, "y": -1.25}, {"x": 0.0, "y": 0.0}, params)
    found = modes.linearisation
    np.testing.assert_allclose(modes.frequency, [np.sqrt(params["g"] / params["l"])], **EQUAL)
    np.testing.assert_allclose(found.stiffness[0, 0], -2 * found.multipliers["rod"], rtol=1e-13)
    assert len(modes) == 1 and np.abs(modes.shapes["y"][0]) < 1e-12


@pytest.mark.exhaustive
def test_the_double_pendulum_by_angles_and_by_rods():
    """The roots of det(K - ω² M), in angles, with two constraints, and with one constraint given twice."""
    m1, m2, l1, l2, g = (DOUBLE_PARAMS[name] for name in ("m1", "m2", "l1", "l2", "g"))
    M = np.array([[(m1 + m2) * l1**2, m2 * l1 * l2], [m2 * l1 * l2, m2 * l2**2]])
    K = np.diag([(m1 + m2) * g * l1, m2 * g * l2])
    exact = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real))
    by_angles = lj.normal_modes(double_pendulum, 0.0, np.zeros(2), np.zeros(2), DOUBLE_PARAMS)
    hanging = {"first": np.array([0.0, -l1]), "second": np.array([0.0, -l1 - l2])}
    at = 0.0, hanging, jax.tree.map(np.zeros_like, hanging), DOUBLE_PARAMS
    twice = lj.System(double_rods.lagrangian, {**double_rods.constraints, "again": double_rods.constraints["inner"]})
    for modes in (by_angles, lj.normal_modes(double_rods, *at), lj.normal_modes(twice, *at)):
        np.testing.assert_allclose(modes.frequency, exact, **EQUAL)
        assert modes.verdict == "stable"


# Many degrees of freedom.


def test_a_chain():
    """Frequencies 2 √(k/m) sin(jπ/(2(n+1))) between walls, and shapes; twin: not those of a free chain."""
    n, params = 6, {"m": 2.0, "k": 3.0}
    modes = lj.normal_modes(small.chain, 0.0, np.zeros(n), np.zeros(n), params)
    j = np.arange(1, n + 1)
    exact = 2 * np.sqrt(params["k"] / params["m"]) * np.sin(j * np.pi / (2 * (n + 1)))
    np.testing.assert_allclose(modes.frequency, exact, **EQUAL)
    shapes = np.sin(np.outer(j, j) * np.pi / (n + 1))
    cosines = np.abs(np.sum(modes.shapes * shapes, axis=1))
    np.testing.assert_allclose(cosines, np.linalg.norm(modes.shapes, axis=1) * np.linalg.norm(shapes, axis=1))
    assert np.max(np.abs(exact - 2 * np.sqrt(1.5) * np.sin((j - 1) * np.pi / (2 * n)))) > 0.1


@pytest.mark.slow
def test_a_free_chain_and_a_hard_one():
    """The rigid motion of a free chain is a named zero mode, not an instability; a hundred masses to 1e-10."""
    modes = lj.normal_modes(small.free_chain, 0.0, np.zeros(4), np.zeros(4), {"m": 2.0, "k": 3.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, False, False, False]
    np.testing.assert_allclose(modes.shapes[0], np.ones(4), atol=1e-12)
    np.testing.assert_allclose(modes.frequency, 2 * np.sqrt(1.5) * np.sin(np.arange(4) * np.pi / 8), rtol=1e-10)
    assert "zero: along" in repr(modes)
    n = 100
    modes = lj.normal_modes(small.chain, 0.0, np.zeros(n), np.zeros(n), {"m": 1.0, "k": 1.0})
    np.testing.assert_allclose(modes.frequency, 2 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))), rtol=1e-10)


@pytest.mark.slow
def test_symmetries_are_told_from_critical_points():
    """A molecule free to move and turn in the plane is stable; so is q⁴, and twin: -q⁴ is not."""

    def spring(t, q, v, params):
        return 0.5 * jnp.sum(v**2) - 0.5 * params["k"] * (jnp.sqrt(jnp.sum((q[0] - q[1]) ** 2)) - 1.0) ** 2

    ends = np.array([[0.0, 0.0], [1.0, 0.0]])
    modes = lj.normal_modes(lj.System(spring), 0.0, ends, 0.0 * ends, {"k": 3.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, True, True, False]
    np.testing.assert_allclose(modes.frequency[3], np.sqrt(6.0), rtol=1e-12)
    quartic = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["c"] * q["x"] ** 4 - q["y"] ** 2)
    modes = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": 1.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, False]
    hill = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": -1.0})
    assert hill.verdict == "divergence" and "first term that does not vanish" in repr(hill)


def test_what_is_free_and_what_is_held():
    """A free mass at any speed has one zero mode; a mass held by a constraint has no motion, which is an error."""
    free = lj.System(lambda t, q, v, params: 0.5 * v**2)
    modes = lj.normal_modes(free, 0.0, 1.0, 2.0, None)
    assert modes.verdict == "stable" and "any q and any speed" in repr(modes)
    held = lj.System(free.lagrangian, {"wall": lj.Holonomic(lambda t, q, params: q - 1.0)})
    with pytest.raises(ValueError, match="leave no motion at all"):
        lj.normal_modes(held, 0.0, 1.0, 0.0, None)


# Gyroscopic forces.


def test_cross_rails():
    """Both frequencies; stable, divergent, then stabilised with rising speed, with the signs of the energies."""
    np.testing.assert_allclose(rails(cross_rails.PARAMS).frequency, rails_by_hand(2.5), **EQUAL)
    verdicts = {omega: rails(cross_rails.PARAMS | {"omega": omega}).verdict for omega in (2.5, 5.0, 8.0)}
    assert verdicts == {2.5: "stable", 5.0: "divergence", 8.0: "gyroscopically stabilised"}
    above = rails(cross_rails.PARAMS | {"omega": 8.0})
    assert list(above.energy) == [-1, 1] and bool(above.stable)


def rails_by_hand(omega):
    """Both frequencies of the carriage, ascending, from its characteristic equation."""
    return jnp.sqrt(jnp.stack(cross_rails.mode_squares(cross_rails.PARAMS | {"omega": omega}))[::-1])


@pytest.mark.exhaustive
def test_derivatives_of_the_rails():
    """First and second derivatives by ω, forward and reverse; those of shapes against finite differences."""
    got = lambda omega: rails(cross_rails.PARAMS | {"omega": omega}).frequency
    exact = jax.jacfwd(rails_by_hand)(2.5)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(got))(2.5), exact, rtol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda omega: got(omega)[0]))(2.5), exact[0], rtol=1e-8)
    second = jax.jit(jax.jacfwd(jax.jacfwd(got)))(2.5)
    np.testing.assert_allclose(second, jax.jacfwd(jax.jacfwd(rails_by_hand))(2.5), rtol=1e-8)
    shape = lambda omega: jnp.imag(rails(cross_rails.PARAMS | {"omega": omega}).shapes["r"])
    by_differences = (shape(2.5 + 1e-5) - shape(2.5 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jacfwd(shape)(2.5), by_differences, atol=1e-8)
    assert np.max(np.abs(by_differences)) > 0.01


@pytest.mark.slow
def test_damping_what_gyroscopic_forces_hold():
    """A little damping makes the mode of negative energy grow, and the other one decay."""
    damped = lj.System(
        cross_rails.rotating_lagrangian, dissipation=lambda t, q, v, p: 0.05 * (v["R"] ** 2 + v["r"] ** 2)
    )
    p = cross_rails.PARAMS | {"omega": 8.0}
    at = {"R": cross_rails.equilibrium_length(p), "r": 0.0}
    modes = lj.normal_modes(damped, 0.0, at, {"R": 0.0, "r": 0.0}, p)
    assert modes.growth[0] > 1e-4 and modes.growth[1] < -1e-4 and modes.verdict == "flutter"


@pytest.mark.slow
def test_stability_of_a_hundred_thousand_rails():
    """Stable exactly if (1 - ω²m/K)(1 - ω²m/k) > 0; twin: with only one factor thousands differ."""
    random, count = np.random.default_rng(0), 100_000
    drawn = {
        "K": random.uniform(0.1, 60, count),
        "k": random.uniform(0.1, 60, count),
        "omega": random.uniform(0, 15, count),
    }
    stable = jax.jit(jax.vmap(lambda some: rails(cross_rails.PARAMS | some).stable))(drawn)
    params = cross_rails.PARAMS | drawn
    assert np.sum(stable != cross_rails.is_stable(params)) == 0
    assert np.sum(stable != (params["m"] * params["omega"] ** 2 < params["K"])) > 10_000


@pytest.mark.slow
def test_small_roots_have_all_digits():
    """Near critical speeds at large ω the small root agrees with mpmath's to 1e-10."""
    m = 1.0
    for omega, over_K, over_k in ((1e4, 1e-3, 0.5), (1e4, 1e-4, 1e-4), (1e6, 0.5, 1e-3), (1e3, -1e-3, -0.5)):
        params = {"m": m, "K": m * omega**2 * (1 + over_K), "k": m * omega**2 * (1 + over_k), "R0": 0.0, "omega": omega}
        with mpmath.workdps(50):
            K, k, squared = (mpmath.mpf(float(x)) for x in (params["K"], params["k"], omega**2))
            half = (K + k) / 2 + squared
            fast = half + mpmath.sqrt(half**2 - (K - squared) * (k - squared))
            exact = mpmath.sqrt((K - squared) * (k - squared) / fast)
        got = np.min(rails(params).frequency)
        # The exact root uses ω² and K as rounded to double precision.
        assert abs(got / float(exact) - 1) < 1e-10, (omega, over_K, over_k)


@pytest.mark.slow
def test_foucault_and_a_charge():
    """ω ± Ω in a rotating frame; the cyclotron frequency of a charge, whose free drift is no instability."""
    modes = lj.normal_modes(small.foucault, 0.0, STILL, STILL, {"turn": 0.25, "omega": 3.0})
    np.testing.assert_allclose(modes.frequency, [2.75, 3.25], **EQUAL)
    fast = lj.normal_modes(small.foucault, 0.0, STILL, STILL, {"turn": 4.0, "omega": 3.0})
    np.testing.assert_allclose(fast.frequency, [1.0, 7.0], **EQUAL)
    assert fast.verdict == "gyroscopically stabilised" and list(fast.energy) == [-1, 1]
    modes = lj.normal_modes(small.charge, 0.0, STILL, STILL, {"B": 2.5})
    np.testing.assert_allclose(modes.frequency, [0.0, 2.5], **EQUAL)
    assert modes.verdict == "stable" and list(modes.zero) == [True, False]


# Steady motions.


def test_the_conical_pendulum():
    """It oscillates with Ω √(1 + 3 cos²θ) at any azimuth; twin: at another speed it is not steady."""
    theta, params = 0.7, {"l": 1.25, "g": 9.8125}
    turn = np.sqrt(params["g"] / (params["l"] * np.cos(theta)))
    at = {"theta": theta, "phi": 0.3}
    modes = lj.normal_modes(small.spherical, 0.0, at, {"theta": 0.0, "phi": turn}, params)
    np.testing.assert_allclose(modes.frequency, [0.0, turn * np.sqrt(1 + 3 * np.cos(theta) ** 2)], **EQUAL)
    assert modes.verdict == "stable" and modes.linearisation.shifts == ("phi",)
    with pytest.raises(ValueError, match="no steady motion: 'theta' accelerates"):
        lj.linearise(small.spherical, 0.0, at, {"theta": 0.0, "phi": 1.01 * turn}, params)


def test_a_sleeping_top():
    """(I₃ω ± √(I₃²ω² - 4 M g l I₁)) / 2 I₁: stable above ω_c = 2 √(M g l I₁) / I₃, flutter below."""
    params = {"I1": 2.0, "I3": 1.5, "Mgl": 3.0}
    critical = 2 * np.sqrt(params["Mgl"] * params["I1"]) / params["I3"]
    upright = {"alpha": 0.0, "beta": 0.0, "spin": 0.0}
    asleep = lambda omega: lj.normal_modes(small.top, 0.0, upright, upright | {"spin": omega}, params)
    verdicts = [asleep(x * critical).verdict for x in (0.999, 1.0, 1.001)]
    assert verdicts == ["flutter", "undecided", "gyroscopically stabilised"]
    spin, root = 1.5 * 1.1 * critical, np.sqrt((1.5 * 1.1 * critical) ** 2 - 24.0)
    np.testing.assert_allclose(asleep(1.1 * critical).frequency[1:], [(spin - root) / 4, (spin + root) / 4], **EQUAL)


def disk_critical(params):
    """The critical spin: C (C + m r²) Ω² = A m g r, from λ² (A + m r²) = m g r - C (C + m r²) Ω² / A."""
    A, C, m, g, r = (params[name] for name in ("A", "C", "m", "g", "r"))
    return np.sqrt(A * m * g * r / (C * (C + m * r**2)))


@pytest.mark.slow
def test_a_rolling_disk():
    """The lean mode has this root at each speed; above Ω² = g/(3r) a thin disk stays upright."""
    m, r, g = 1.5, 0.4, 9.81
    params = {"m": m, "r": r, "g": g, "A": 0.25 * m * r**2, "C": 0.5 * m * r**2}
    critical = disk_critical(params)
    np.testing.assert_allclose(critical**2, g / (3 * r))
    still = dict.fromkeys(("x", "y", "yaw", "lean", "spin"), 0.0)
    rolls = lambda omega: lj.normal_modes(small.disk, 0.0, still, still | {"x": r * omega, "spin": omega}, params)
    slow, fast = rolls(0.999 * critical), rolls(1.001 * critical)
    assert slow.verdict == "divergence" and bool(fast.stable)
    A, C = params["A"], params["C"]
    for modes, omega in ((slow, 0.999 * critical), (fast, 1.001 * critical)):
        squared = (m * g * r - C * (C + m * r**2) * omega**2 / A) / (A + m * r**2)
        got = max(modes.growth) ** 2 if squared > 0 else -(max(modes.frequency) ** 2)
        np.testing.assert_allclose(got, squared, rtol=1e-10)
    assert fast.linearisation.shifts == ("spin", "x", "y")
    words = repr(fast)
    assert "other speeds in" in words and "shift of yaw, which the velocity constraints leave free" in words


# Forces and dissipation.


def test_damping_and_circulation():
    """Damped and overdamped roots; stable up to 2n = |k₁ - k₂| and flutter above it, as Ziegler found."""
    at = lambda **params: lj.normal_modes(small.circulating, 0.0, STILL, STILL, params)
    modes = at(k1=1.0, k2=4.0, n=0.0, c=0.5)
    np.testing.assert_allclose(modes.roots, [-0.25 + 1j * np.sqrt(k - 0.0625) for k in (1.0, 4.0)], rtol=1e-12)
    assert modes.verdict == "asymptotically stable"
    modes = at(k1=1.0, k2=4.0, n=0.0, c=5.0)
    np.testing.assert_allclose(modes.roots, np.sort([*np.roots([1, 5, 1]), *np.roots([1, 5, 4])])[::-1], rtol=1e-10)
    assert at(k1=1.0, k2=1.5, n=0.249, c=0.0).verdict == "stable"
    modes = at(k1=1.0, k2=1.5, n=0.251, c=0.0)
    assert modes.verdict == "flutter"
    np.testing.assert_allclose(modes.linearisation.circulatory, [[0.0, -0.251], [0.251, 0.0]])
    np.testing.assert_allclose(at(k1=1.0, k2=1.5, n=0.0, c=0.5).linearisation.damping, 0.5 * np.eye(2))


# Double roots, and compiled programs.


@pytest.mark.exhaustive
def test_a_double_root_is_reported():
    """An isotropic oscillator has finite derivatives, those of the mean, and is reported as double."""
    at = lambda k1: lj.normal_modes(small.circulating, 0.0, STILL, STILL, {"k1": k1, "k2": 4.0, "n": 0.0, "c": 0.0})
    modes = at(4.0)
    assert list(modes.double) == [True, True] and "double" in repr(modes)
    slope = jax.jacfwd(lambda k1: at(k1).frequency)(4.0)
    assert np.isfinite(slope).all()
    np.testing.assert_allclose(np.sort(np.abs(slope))[-2:], 0.125, rtol=1e-8)
    np.testing.assert_allclose(np.max(jax.jacfwd(lambda k1: at(k1).frequency)(4.1)), 1 / (2 * np.sqrt(4.1)), rtol=1e-8)


def test_programs_never_hold_nan():
    """In a program, states off equilibrium and NaN inputs give codes and residuals, never NaN."""
    codes = jax.jit(jax.vmap(lambda at, omega: lj.normal_modes(small.bead, 0.0, at, 0.0, BEAD | {"omega": omega})))
    modes = codes(np.array([0.0, 0.5, np.nan, 0.0]), np.array([1.0, 1.0, 1.0, np.nan]))
    assert all(np.isfinite(x).all() for x in (modes.roots, modes.shapes, modes.code))
    assert [lj.NormalModes.VERDICTS[code] for code in modes.code] == ["stable", *["no steady motion"] * 3]
    assert modes.linearisation.residual[0] < 1e-12 < 0.1 < modes.linearisation.residual[1]
    assert list(modes.stable) == [True, False, False, False]


# Bad input.


def test_messages():
    """No equilibrium, no mass, explicit time, a violated constraint, wrong types: each error is clear."""
    with pytest.raises(ValueError, match="not an equilibrium: 'q' accelerates by"):
        lj.linearise(small.bead, 0.0, 0.3, 0.0, BEAD)
    massless = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - 0.5 * (q["a"] ** 2 + q["b"] ** 2))
    with pytest.raises(ValueError, match="mass matrix is singular in coordinate 'b'"):
        lj.linearise(massless, 0.0, {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, None)
    parametric = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * (1 + 0.1 * jnp.cos(t)) * q**2)
    with pytest.raises(ValueError, match="change along the motion: the matrix of positions"):
        lj.linearise(parametric, 0.0, 0.0, 0.0, None)
    with pytest.raises(ValueError, match="constraint 'rod'"):
        lj.linearise(rod_pendulum, 0.0, {"x": 0.0, "y": -1.0}, {"x": 0.0, "y": 0.0}, {"g": 9.8125, "l": 1.25})
    with pytest.raises(TypeError, match="bool"):
        lj.linearise(small.bead, 0.0, True, 0, BEAD)
    with pytest.raises(IndexError, match="there are 1 modes"):
        lj.normal_modes(small.bead, 0.0, 0.0, 0.0, BEAD)[1]


def test_it_draws_itself():
    """Roots and shapes are drawn, and a mode is animated."""
    modes = rails(cross_rails.PARAMS)
    assert modes.plot().axes and modes[1].plot().axes
    film = modes[0].animate(lambda t, q, params: (q["R"], q["r"]), amplitude=0.1)
    moved = film.points[""][:, 0] - [float(cross_rails.equilibrium_length(cross_rails.PARAMS)), 0.0]
    assert 0.09 < np.max(np.abs(moved)) <= 0.1 + 1e-12
    with pytest.raises(ValueError, match="not a film"):
        modes[0].animate(lambda t, q, params: (q["R"], q["r"]), seconds=0.0)
