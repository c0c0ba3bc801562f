"""Branches of cycles: against elliptic integrals, Mathieu's boundaries, SciPy's shooting and averaging."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, special

import lagjax as lj
from lagjax.analysis.arclength import BranchPoint, zero
from lagjax.analysis.cycle_equations import extent
from lagjax.analysis.cycles import CriticalOrbit
from tests.analysis import closed_forms as known
from tests.analysis.test_flow import BELT, FLIPS, block, bounce_of, bouncing, stick_slip
from tests.systems import PARAMS, pendulum, rod_pendulum

UNIT = {"g": 1.0, "l": 1.0}


def after_a_period(rate, period, z):
    """The state of SciPy's motion after a period."""
    return integrate.solve_ivp(rate, [0, period], z, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def monodromy(rate, period, z, step=1e-5):
    """The derivative of `after_a_period` by the start, by central differences."""
    return np.stack([(after_a_period(rate, period, z + e) - after_a_period(rate, period, z - e)) / (2 * step)
                     for e in step * np.eye(len(z))], axis=1)  # fmt: skip


def shot(rate, period, z):
    """A periodic state near another one, by SciPy's motions only, and its multipliers."""
    z = optimize.fsolve(lambda z: after_a_period(rate, period, z) - z, z, xtol=1e-9)
    matrix = monodromy(rate, period, z)
    return z - np.linalg.solve(matrix - np.eye(len(z)), after_a_period(rate, period, z) - z), np.linalg.eigvals(matrix)


# Families of a conservative system.


def test_how_far_a_path_goes():
    """x = t³ - t turns at -2/√27 between points at which it is known; what rests, and times that are not there, say
    nothing more. Twin: the points alone see less."""
    t = np.array([-0.4, 0.2, 1.1, np.nan])
    cubic, still = t**3 - t, 0 * t + 0.3
    states = np.stack([cubic, still, 3 * t**2 - 1, 0 * t], axis=1)
    low, high = extent(t, states)
    np.testing.assert_allclose([low[0], high[0]], [-2 / np.sqrt(27), 0.4 - 0.4**3], rtol=1e-14)
    np.testing.assert_array_equal([low[1], high[1]], 0.3)
    assert np.nanmin(cubic) > low[0] + 0.1


@pytest.mark.exhaustive
def test_pendulum_by_its_amplitude():
    """The period is 4 K(k) √(l/g) at every point; twin: that of small swings is different."""
    orbit = lj.periodic_orbit(pendulum, (1.0, 0.0), 6.7, UNIT)
    branch = lj.continue_orbits(orbit, along="q", to=3.0)
    np.testing.assert_allclose(branch.period, known.swinging(branch.q, UNIT), rtol=1e-11)
    assert len(branch) > 20 and float(branch.q[-1]) == pytest.approx(3.0, abs=1e-13) and branch.stable.all()
    assert np.max(np.abs(branch.period / (2 * np.pi) - 1)) > 1
    np.testing.assert_allclose(branch.high, branch.q, atol=1e-6)
    np.testing.assert_allclose(branch.low, -branch.q, atol=1e-6)
    # A point of the branch is an orbit, and its motion closes.
    middle = branch[len(branch) // 2]
    end = middle.trajectory.q[-1]
    np.testing.assert_allclose(end, middle.q, atol=1e-9)
    assert lj.floquet(middle).trivial.all()
    smaller = lj.continue_orbits(orbit, along="q", to=-1.0)
    assert smaller.status.startswith("a state of rest, near q = ") and abs(smaller.q[-1]) < 0.05
    by_energy = lj.continue_orbits(orbit, along="energy", to=2.0)
    assert by_energy.status.startswith("a period that grows without end, near energy = 1")
    by_period = lj.continue_orbits(orbit, along="period", to=9.0)
    np.testing.assert_allclose(by_period.period, by_period.parameter, rtol=1e-12)
    np.testing.assert_allclose(by_period.period, known.swinging(by_period.q, UNIT), rtol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize("along, to", [("energy", 0.9), ("l", 3.0)])
def test_pendulum_on_a_rod(along, to):
    """With a constraint: along the energy, and along the rod's length at constant energy; the rod keeps its length."""
    start = {"x": np.sin(1.0), "y": -np.cos(1.0)}, {"x": 0.0, "y": 0.0}
    orbit = lj.periodic_orbit(rod_pendulum, start, 6.7, UNIT | {"m": 1.0})
    branch = lj.continue_orbits(orbit, along=along, to=to)
    energy, length = (branch.parameter, 1.0) if along == "energy" else (-np.cos(1.0), branch.parameter)
    np.testing.assert_allclose(
        branch.period, known.swinging(np.arccos(-energy / length), UNIT | {"l": length}), rtol=1e-10
    )
    np.testing.assert_allclose(np.hypot(branch.q["x"], branch.q["y"]), length, rtol=1e-12)
    assert branch.status == "the end of the range" and branch.stable.all()


@pytest.mark.exhaustive
def test_a_branch_that_turns():
    """Halo orbits (mass ratio 0.04) end where z = 0 and turn there: a critical point, and the range that was reached.

    Published: the first row, and that x turns at 0.723719.
    """

    def rotating(t, q, v, p):
        x, y, z = q["x"], q["y"], q["z"]
        kinetic = 0.5 * ((v["x"] - y) ** 2 + (v["y"] + x) ** 2 + v["z"] ** 2)
        far, near = (x + p["mu"]) ** 2 + y**2 + z**2, (x - 1 + p["mu"]) ** 2 + y**2 + z**2
        return kinetic + (1 - p["mu"]) / jnp.sqrt(far) + p["mu"] / jnp.sqrt(near)

    start = {"x": 0.723268, "y": 0.0, "z": 0.04}, {"x": 0.0, "y": 0.198019, "z": 0.0}
    orbit = lj.periodic_orbit(lj.System(rotating), start, 2.600354, {"mu": 0.04}, hold="x")
    branch = lj.continue_orbits(orbit, along="x", to=0.817724)
    (turn,) = branch.critical
    np.testing.assert_allclose(turn.parameter, 0.723719, atol=1e-6)
    assert float(turn.accuracy) < 1e-6 and abs(float(branch.q["z"][turn.index])) < 0.01
    assert float(branch.q["z"][-1]) < -0.03, "it comes back with z turned round"
    assert "from 0.723268 to 0.723719" in repr(branch) and "(asked to 0.817724)" in repr(branch)
    assert "the end of the range, x = 0.723268" in repr(branch)


class Nearby:
    """A branch between points whose zero cannot be refined."""

    def length(self, step):
        return np.linalg.norm(step)

    def zero_between(self, a, b, of):
        return b, np.inf

    def between(self, a, b, share):
        return None


def test_a_candidate_that_is_not_located():
    """It is listed beside the nearer point, with what is known of its parameter."""
    points = [BranchPoint(np.array(z), np.eye(2), np.array(along), 1.0, None, 0, 0)
              for z, along in (([0.0, 1.0], [1.0, 0.3]), ([0.6, 1.0], [1.0, -0.1]))]  # fmt: skip
    found = zero("fold", lambda p: p.tangent[-1], Nearby(), *points)
    assert found is not None and not found.located
    np.testing.assert_array_equal(found.point.z, points[1].z)
    np.testing.assert_allclose(found.accuracy, 0.6 * 0.3)
    off = np.asarray(2.0 * found.accuracy)
    listed = CriticalOrbit("fold", np.asarray(2.0), off, 1, np.ones(2, complex), found.located)
    assert repr(listed) == "fold at 2 (to 4e-01)"


# Driven systems.


DRIVEN = known.DUFFING | {"omega": 0.5}


@pytest.mark.exhaustive
def test_resonance_curve():
    """Both folds, every orbit and its stability agree with SciPy's shooting; it is drawn. Twin: a millionth off."""
    orbit = lj.periodic_orbit(known.duffing, (0.4, 0.0), 2 * np.pi / DRIVEN["omega"], DRIVEN)
    branch = lj.continue_orbits(orbit, along="omega", to=3.0)
    assert [c.kind for c in branch.critical] == ["fold", "fold"] and branch.status == "the end of the range"
    np.testing.assert_allclose(branch.period * branch.parameter, 2 * np.pi, rtol=1e-12)
    upper, lower = branch.critical
    for i in [*range(5, len(branch), 37), upper.index - 6, lower.index + 6]:
        omega = float(branch.parameter[i])
        rate, period = known.duffing_rate(DRIVEN | {"omega": omega}), 2 * np.pi / omega
        z = np.array([branch.q[i], branch.v[i]])
        exact, found = shot(rate, period, z + 1e-4)
        np.testing.assert_allclose(z, exact, atol=1e-8)
        assert np.abs(z + 1e-6 - exact).max() > 1e-8
        assert bool(branch.stable[i]) == bool(np.abs(found).max() < 1)
        np.testing.assert_allclose(np.sort(np.abs(found)), np.sort(np.abs(branch.multipliers[i])), rtol=1e-6)
    # SciPy's orbits at the folds have the double multiplier 1, which is off by the root of the orbits' error.
    for fold in branch.critical:
        omega = float(fold.parameter)
        z = np.array([branch.q[fold.index], branch.v[fold.index]])
        found = np.linalg.eigvals(monodromy(known.duffing_rate(DRIVEN | {"omega": omega}), 2 * np.pi / omega, z))
        assert np.abs(found - 1).min() < 1e-6 and np.abs(found - 1).max() > 0.1
    (axis,) = branch.plot().axes
    dashes = {line.get_linestyle() for line in axis.get_lines() if len(line.get_xdata()) > 2}
    assert dashes == {"-", "--"} and axis.get_ylabel() == "largest q" and axis.get_xlabel() == "omega"
    assert {"stable", "unstable", "fold"} <= set(axis.get_legend_handles_labels()[1])
    assert branch.plot("period").axes[0].get_ylabel() == "period" and "fold" in repr(branch)
    short = lj.continue_orbits(orbit, along="omega", to=1.7, most_points=5)
    assert short.status == "the limit of 5 points" and len(short) == 5
    along = lambda name, to=1.0: lj.continue_orbits(orbit, along=name, to=to)
    for act, error, words in (
        (lambda: branch.plot("theta"), ValueError, "names no coordinate; there are q, and 'period'"),
        (lambda: along("speed"), ValueError, "along='speed' is no number in params; there are 'b', 'c', 'f' and"),
        (lambda: along("period"), ValueError, "along='period': the system depends on time"),
        (lambda: along("omega", 0.5), ValueError, "leaves the parameter 'omega' no range: it starts at 0.5"),
        (lambda: jax.jit(lambda x: lj.continue_orbits(x, along="omega", to=1.0).period)(orbit), TypeError, "JAX is"),
        (lambda: branch[len(branch)], IndexError, "branch\\[0\\] to branch"),
    ):
        with pytest.raises(error, match=words):
            act()


@pytest.mark.slow
def test_tongues_of_a_parametric_pendulum():
    """At rest its multiplier passes -1 and 1 at Mathieu's characteristic values, also at a tongue of width 5e-4.

    Twin: the characteristic values of another q differ.
    """
    system, q = known.mathieu, 0.25
    orbit = lj.periodic_orbit(system, (0.0, 0.0), np.pi, {"a": 0.1, "q": q})
    branch = lj.continue_orbits(orbit, along="a", to=10.0)
    edges = lambda q: np.array([edge(n, q) for n in (1, 2, 3) for edge in (special.mathieu_b, special.mathieu_a)])
    found = np.array([c.parameter for c in branch.critical])
    assert [c.kind for c in branch.critical] == ["period doubling"] * 2 + ["branch point"] * 2 + ["period doubling"] * 2
    np.testing.assert_allclose(found, edges(q), atol=1e-10)
    assert np.abs(found - edges(q + 1e-3)).max() > 1e-6
    assert all(float(c.accuracy) < 1e-10 for c in branch.critical)
    inside = np.sum(branch.parameter[:, None] > edges(q)[None], axis=1) % 2 == 1
    off = np.min(np.abs(branch.parameter[:, None] - edges(q)[None]), axis=1) > 1e-9
    np.testing.assert_array_equal(branch.stable[off], ~inside[off])


# Cycles of autonomous systems.


@pytest.mark.exhaustive
def test_a_cycle_that_shrinks_and_one_that_folds():
    """x'' + x = (μ + a² - a⁴) x' on average: it folds at μ = -1/4, and shrinks to rest at μ = 0 (Hopf), or 2 √μ."""
    small = lj.System(known.spring_lagrangian, force=lambda t, q, v, p: (p["mu"] - q**2) * v)
    branch = lj.continue_orbits(lj.periodic_orbit(small, (1.0, 0.0), 6.5, {"mu": 0.25}), along="mu", to=-0.5)
    assert branch.status == "a state of rest, near mu = 0" and not branch.critical
    # By energy: r' = ε r (μ + 2 r² - r⁴) has circles r² = 1 ± √(1 + μ).
    push = lambda t, q, v, p: 0.01 * (p["mu"] + 2 * (q**2 + v**2) - (q**2 + v**2) ** 2) * v
    folds = lj.System(known.spring_lagrangian, force=push)
    orbit = lj.periodic_orbit(folds, (np.sqrt(2.0), 0.0), 6.3, {"mu": 0.0})
    branch = lj.continue_orbits(orbit, along="mu", to=-2.0)
    (fold,) = branch.critical
    assert fold.kind == "fold"
    np.testing.assert_allclose(fold.parameter, -1.0, atol=1e-10)
    circles = branch.q**2 + branch.v**2
    np.testing.assert_allclose((circles - 1) ** 2, 1 + branch.parameter, atol=1e-9)
    np.testing.assert_array_equal(branch.stable[: fold.index], True)
    assert not branch.stable[fold.index + 1 :].any() and branch.status.startswith("a state of rest, near mu = ")


@pytest.mark.exhaustive
def test_combination_resonance():
    """Two oscillators coupled by a drive near the sum of their frequencies: two pairs meet, by SciPy's multipliers."""

    def lagrangian(t, q, v, p):
        springs = 0.5 * (q[0] ** 2 + p["k"] * q[1] ** 2)
        return 0.5 * v @ v - springs - p["e"] * jnp.cos(p["omega"] * t) * q[0] * q[1]

    params = {"k": 2.0, "e": 0.25, "omega": 2.1}
    orbit = lj.periodic_orbit(lj.System(lagrangian), (np.zeros(2), np.zeros(2)), 2 * np.pi / 2.1, params)
    branch = lj.continue_orbits(orbit, along="omega", to=2.7)
    assert [c.kind for c in branch.critical] == ["torus", "torus"]

    def growth(omega):
        coupling = lambda t: params["e"] * np.cos(omega * t)
        rate = lambda t, y: [y[2], y[3], -y[0] - coupling(t) * y[1], -params["k"] * y[1] - coupling(t) * y[0]]
        return np.abs(np.linalg.eigvals(monodromy(rate, 2 * np.pi / omega, np.zeros(4), 1.0))).max() - 1

    first, second = (float(c.parameter) for c in branch.critical)
    assert first < 1 + np.sqrt(2.0) < second
    for edge, out in ((first, -1), (second, 1)):
        assert growth(edge + out * 1e-6) < 1e-5 < growth(edge - out * 1e-6) < 1e-2
    assert "a pair at ±" in repr(branch)


# Plots and messages.


def test_no_orbit_to_begin_with():
    """A system is not an orbit."""
    with pytest.raises(TypeError, match="must be a periodic orbit, not a System") as raised:
        lj.continue_orbits(pendulum, along="g", to=2.0)  # type: ignore
    assert "Fix: orbit = lj.periodic_orbit" in str(raised.value) and PARAMS["g"] > 0


# With switches: sticking, slipping and bouncing.


@pytest.mark.exhaustive
def test_stick_slip():
    """The period along the belt's speed, and along μ until the start comes to a switch.

    The block sticks from x = (2μ - μ_s)/k on, which is the start's x, 0.1, at μ = 0.575. Twin: the period moves.
    """
    orbit = lj.periodic_orbit(block, (0.1, 0.25), 1.1 * stick_slip(BELT), BELT)
    branch = lj.continue_orbits(orbit, along="V", to=0.6)
    assert branch.status == "the end of the range" and branch.stable.all()
    exact = [stick_slip(BELT | {"V": V}) for V in branch.parameter]
    np.testing.assert_allclose(branch.period, exact, rtol=1e-10)
    np.testing.assert_allclose(branch.multipliers, np.tile([1.0, 0.0], (len(branch), 1)), atol=1e-9)
    assert np.ptp(exact) > 0.5 and branch[1].switches is None
    ended = lj.continue_orbits(orbit, along="mu", to=0.7)
    exact = [stick_slip(BELT | {"mu": mu}) for mu in ended.parameter]
    np.testing.assert_allclose(ended.period, exact, rtol=1e-10)
    np.testing.assert_allclose(ended.parameter[-1], 0.575, atol=1e-3)
    assert "the start comes to a switch" in ended.status
    # The largest x is that of the slip, about x = μ/k with the amplitude of its start.
    k, V, mu, static = BELT.values()
    at, reach = mu / k, np.hypot((static - mu) / k, V / k**0.5)
    np.testing.assert_allclose([ended.high[0], ended.low[0]], [at + reach, at - reach], atol=1e-5)


@pytest.mark.exhaustive
def test_bouncing_ball():
    """A multiplier passes -1 at the amplitude of the closed form; a drive that only the guard sees is refused."""
    orbit, _ = bounce_of(bouncing, 0.07)
    branch = lj.continue_orbits(orbit, along="A", to=1.02 * FLIPS)
    (flip,) = branch.of_kind("period doubling")
    np.testing.assert_allclose(flip.parameter, FLIPS, rtol=1e-9)
    assert branch.stable[0] and not branch.stable[-1]
    with pytest.raises(ValueError, match="the period of the drive changes with it"):
        lj.continue_orbits(orbit, along="omega", to=8.5)
