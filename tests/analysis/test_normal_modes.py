"""Small motions and their modes against closed forms, published values, and roots in high precision."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.normal_modes import NormalModes
from lagjax.scenes import cross_rails
from tests.analysis import small_systems as small
from tests.analysis.steady_systems import DISK, TOP, UPRIGHT, UPRIGHT_DISK, disk, straight_on, top
from tests.by_numpy import by_numpy
from tests.systems import DOUBLE_PARAMS, double_pendulum, double_rods, rod_pendulum

BEAD = {"a": 1.25, "g": 9.8125, "omega": 2.0}
STILL = {"x": 0.0, "y": 0.0}
EQUAL = {"rtol": 1e-10, "atol": 0.0}


def rails(params):
    """The modes of the carriage at rest on its rails."""
    at = {"R": cross_rails.equilibrium_length(params), "r": 0.0}
    return lj.normal_modes(cross_rails.rotating_system, 0.0, at, {"R": 0.0, "r": 0.0}, params)


# One degree of freedom.

SQUARED = BEAD["g"] / BEAD["a"]
BELOW, ABOVE = np.array([0.5, 2.0, 2.7]), np.array([2.9, 4.0, 9.0])
ALPHA = np.arccos(SQUARED / ABOVE**2)
# At the bottom below the critical speed and on the side above it; and where there is no steady motion.
POINTS = np.array([
    *((0.0, x) for x in BELOW), *zip(ALPHA, ABOVE), (0.0, 3.0), (np.pi, 2.0), (0.5, 1.0), (np.nan, 1.0), (0.0, np.nan)
])  # fmt: skip
VERDICTS = ["stable"] * 6 + ["divergence"] * 2 + ["no steady motion"] * 3


@cache
def beads():
    """The modes at these points, and the derivatives of the frequency by angle and speed, from one program."""

    def at(point):
        modes = lj.normal_modes(small.bead, 0.0, point[0], 0.0, BEAD | {"omega": point[1]})
        return modes.frequency[0], modes

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.grad(at, has_aux=True)))(POINTS))


def test_the_bead():
    """√(ω0² - ω²) below, ω sin α above, and derivatives by ω, to 1e-10 and 1e-8; twin: not the other formula."""
    slope, modes = beads()
    got = modes.frequency[:, 0]
    np.testing.assert_allclose(got[:3], np.sqrt(SQUARED - BELOW**2), **EQUAL)
    np.testing.assert_allclose(slope[:3, 1], -BELOW / np.sqrt(SQUARED - BELOW**2), rtol=1e-8)
    np.testing.assert_allclose(got[3:6], ABOVE * np.sin(ALPHA), **EQUAL)
    # The equilibrium moves with ω, dα/dω = 2 cos α / (ω sin α); the frequency is ω sin α = √(ω² - ω0⁴/ω²).
    whole = slope[3:6, 1] + slope[3:6, 0] * 2 * np.cos(ALPHA) / (ABOVE * np.sin(ALPHA))
    np.testing.assert_allclose(whole, (ABOVE + SQUARED**2 / ABOVE**3) / got[3:6], rtol=1e-8)
    assert np.min(np.abs(got[3:6] / np.sqrt(ABOVE**2 - SQUARED) - 1)) > 1e-3


def test_verdicts_in_a_program():
    """Stable below the critical speed and beside, else divergent; off equilibrium and of NaN codes, and never NaN."""
    _, modes = beads()
    assert all(np.isfinite(x).all() for x in (modes.roots, modes.shapes, modes.code))
    assert [NormalModes.VERDICTS[code] for code in modes.code] == VERDICTS
    assert np.all(modes.linearisation.residual[:8] < 1e-12) and modes.linearisation.residual[8] > 0.1
    assert modes.stable.tolist() == [verdict == "stable" for verdict in VERDICTS]


# Many degrees of freedom.


@pytest.mark.slow
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


@pytest.mark.exhaustive
def test_a_free_chain():
    """The rigid motion of a free chain is a named zero mode, not an instability."""
    modes = lj.normal_modes(small.free_chain, 0.0, np.zeros(4), np.zeros(4), {"m": 2.0, "k": 3.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, False, False, False]
    np.testing.assert_allclose(modes.shapes[0], np.ones(4), atol=1e-12)
    np.testing.assert_allclose(modes.frequency, 2 * np.sqrt(1.5) * np.sin(np.arange(4) * np.pi / 8), rtol=1e-10)
    assert "zero: along" in repr(modes)


# Gyroscopic forces.


def test_cross_rails():
    """Both frequencies; stable, divergent, then stabilised with rising speed, with the signs of the energies."""
    np.testing.assert_allclose(rails(cross_rails.PARAMS).frequency, rails_by_hand(2.5), **EQUAL)
    verdicts = {omega: rails(cross_rails.PARAMS | {"omega": omega}).verdict for omega in (2.5, 5.0, 8.0)}
    assert verdicts == {2.5: "stable", 5.0: "divergence", 8.0: "gyroscopically stabilised"}
    above = rails(cross_rails.PARAMS | {"omega": 8.0})
    assert list(above.energy) == [-1, 1] and bool(above.stable)
    check_shapes(above)
    with pytest.raises(IndexError, match="there are 2 modes"):
        above[2]


def check_shapes(modes):
    """Each mode solves M s² + (G + D) s + K + N = 0, and the largest entry of its shape is one; twin: without G."""
    of, twin = jax.tree.map(np.asarray, modes.linearisation), []
    position = of.stiffness + of.circulatory
    for root, shape in zip(np.asarray(modes.roots), np.stack(list(modes.shapes.values()), axis=1)):
        velocity = lambda gyroscopic: (of.mass * root + of.damping + gyroscopic) * root + position
        w = np.linalg.lstsq(of.positions, shape)[0]
        np.testing.assert_allclose(velocity(of.gyroscopic) @ w, 0.0, atol=1e-10 * np.max(np.abs(position)))
        np.testing.assert_allclose(np.max(np.abs(shape)), 1.0, rtol=1e-12)
        twin.append(np.max(np.abs(velocity(0.0 * of.gyroscopic) @ w)))
    assert max(twin) > 1.0


def rails_by_hand(omega):
    """Both frequencies of the carriage, ascending, from its characteristic equation."""
    return np.sqrt(np.stack(by_numpy(cross_rails.mode_squares)(cross_rails.PARAMS | {"omega": omega}))[::-1])


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


# Steady motions.


@pytest.mark.slow
def test_a_sleeping_top():
    """(I₃ω ± √(I₃²ω² - 4 M g l I₁)) / 2 I₁: stable above ω_c = 2 √(M g l I₁) / I₃, flutter below."""
    I1, I3, Mgl = TOP.values()
    critical = 2 * np.sqrt(Mgl * I1) / I3
    asleep = lambda omega: lj.normal_modes(top, 0.0, UPRIGHT, UPRIGHT | {"spin": omega}, TOP)
    verdicts = [asleep(x * critical).verdict for x in (0.999, 1.0, 1.001)]
    assert verdicts == ["flutter", "undecided", "gyroscopically stabilised"]
    spin = I3 * 1.1 * critical
    root = np.sqrt(spin**2 - 4 * Mgl * I1)
    frequency = asleep(1.1 * critical).frequency[1:]
    np.testing.assert_allclose(frequency, [(spin - root) / (2 * I1), (spin + root) / (2 * I1)], **EQUAL)


@pytest.mark.slow
def test_a_rolling_disk():
    """λ² (A + m r²) = m g r - C (C + m r²) Ω² / A of its lean; above Ω² = g/(3r) a thin disk stays upright."""
    m, r, g = DISK.values()
    A, C, critical = 0.25 * m * r**2, 0.5 * m * r**2, np.sqrt(g / (3 * r))
    for omega, stable in ((0.999 * critical, False), (1.001 * critical, True)):
        velocity = {name: omega * rate for name, rate in straight_on(UPRIGHT_DISK, DISK).items()}
        modes = lj.normal_modes(disk, 0.0, UPRIGHT_DISK, velocity, DISK)
        squared = (m * g * r - C * (C + m * r**2) * omega**2 / A) / (A + m * r**2)
        got = -(max(modes.frequency) ** 2) if stable else max(modes.growth) ** 2
        np.testing.assert_allclose(got, squared, rtol=1e-10)
        assert bool(modes.stable) == stable and (stable or modes.verdict == "divergence")
    assert modes.linearisation.shifts == ("spin", "x", "y")
    words = repr(modes)
    assert "other speeds in" in words and "shift of heading, which the velocity constraints leave free" in words


def test_it_draws_itself():
    """Roots and shapes are drawn, and a mode is animated."""
    modes = rails(cross_rails.PARAMS)
    assert modes.plot().axes and modes[1].plot().axes
    film = modes[0].animate(lambda t, q, params: (q["R"], q["r"]), amplitude=0.1)
    moved = film.points[""][:, 0] - [float(cross_rails.equilibrium_length(cross_rails.PARAMS)), 0.0]
    assert 0.09 < np.max(np.abs(moved)) <= 0.1 + 1e-12
    with pytest.raises(ValueError, match="not a film"):
        modes[0].animate(lambda t, q, params: (q["R"], q["r"]), seconds=0.0)
    # Side by side, each in its own time, the slower one first.
    film = modes.animate(lambda t, q, params: (q["R"], q["r"]), amplitude=0.1)
    assert isinstance(film.points, dict) and film.t[-1] == pytest.approx(6 * np.pi / float(modes.frequency[0]))
    for i, (name, points) in enumerate(film.points.items()):
        off = points[:, 0] - points[:, 0].mean(axis=0)
        most = off[:, np.argmax(np.ptp(off, axis=0))]
        swing = np.cos(float(modes.frequency[i]) * film.t)
        swing -= swing.mean()
        assert name.startswith(f"{i}: frequency ") and abs(np.corrcoef(most, swing)[0, 1]) > 0.999
    slow, fast = film.points.values()
    assert np.max(slow[:, 0, 0]) < np.min(fast[:, 0, 0])


# Matrices on the constraint surface; verdicts of forces that are not conservative.


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


@pytest.mark.slow
def test_where_a_stiffness_vanishes_the_next_term_decides():
    """q⁴ is stable, which a zero mode says; twin: -q⁴ is not."""
    quartic = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["c"] * q["x"] ** 4 - q["y"] ** 2)
    modes = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": 1.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, False]
    hill = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": -1.0})
    assert hill.verdict == "divergence" and "first term that does not vanish" in repr(hill)


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
