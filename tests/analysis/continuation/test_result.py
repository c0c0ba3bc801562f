"""Branches of equilibria: folds, crossings and the loss of stability, against closed forms, with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import bead_on_hoop, cross_rails
from tests.analysis.steady_systems import (
    BUCKLING,
    COLUMN,
    DISK,
    EXCHANGE,
    TOP,
    TRUSS,
    UPRIGHT,
    UPRIGHT_DISK,
    ZIEGLER,
    column,
    damped_flutter_load,
    damped_ziegler,
    disk,
    exchange,
    flutter_load,
    slowest_rolling,
    slowest_sleeping_spin,
    snap_through,
    straight_on,
    top,
    truss,
    turning_pendulum,
    ziegler,
)  # fmt: skip

BEAD = bead_on_hoop.PARAMS
CRITICAL = 1e-10
SLOPE = 1e-8


def bead(first, start, last):
    """Branches along the speed of the hoop."""
    return lj.continue_equilibria(bead_on_hoop.system, BEAD | {"omega": first}, start, along="omega", to=last)


def check(critical, exact, params, along):
    """The critical parameter and its derivatives by all others; twin: an error of a millionth is detected."""
    value = float(exact(params))
    assert abs(float(critical.parameter) / value - 1) < CRITICAL < abs((1 + 1e-6) * value / value - 1)
    slopes = jax.grad(exact)(params)
    for name, slope in slopes.items():
        expected = 0.0 if name == along else float(slope)
        assert abs(float(critical.derivative[name]) - expected) < SLOPE * max(1.0, abs(expected)), name


# One coordinate.


@pytest.mark.parametrize("from_the_side", [False, True])
def test_bead(from_the_side):
    """ω_c = √(g/a), dω_c/da = -½ √(g/a³), along the bottom, or the tilt, whose eigenvalue only touches zero."""
    found = bead(8.0, 1.3, 1.0) if from_the_side else bead(1.0, 0.0, 8.0)
    (critical,) = found.critical
    assert critical.kind == "pitchfork" and critical.branches == (0, 1) and len(found) == 2
    check(critical, lambda p: jnp.sqrt(p["g"] / p["a"]) + 0 * p["m"], BEAD, "omega")
    np.testing.assert_allclose(critical.derivative["a"], -0.5 * np.sqrt(BEAD["g"] / BEAD["a"] ** 3), rtol=1e-10)
    side, bottom = (found[0], found[1]) if from_the_side else (found[1], found[0])
    below = bottom.parameter < float(critical.parameter) * (1 - 1e-9)
    above = bottom.parameter > float(critical.parameter) * (1 + 1e-9)
    assert bottom.stable[below].all() and not bottom.stable[above].any() and side.stable.all()
    tilt = np.arccos(np.minimum(1.0, BEAD["g"] / (BEAD["a"] * side.parameter**2)))
    np.testing.assert_allclose(np.abs(side.q), tilt, atol=1e-7)
    away = side.parameter > 1.001 * float(critical.parameter)
    np.testing.assert_allclose(np.abs(side.q)[away], tilt[away], rtol=1e-12)
    # Both halves of the pitchfork, and its tip.
    assert side.q.min() < -1 and side.q.max() > 1 and np.min(np.abs(side.q)) < 1e-9
    np.testing.assert_allclose([found.first, found.last], [8.0, 1.0] if from_the_side else [1.0, 8.0])


def test_truss():
    """It snaps through at folds in both directions, at the load of the closed form; between them it is unstable."""
    found = lj.continue_equilibria(truss, TRUSS, 0.6, along="P", to=6.0)
    assert [c.kind for c in found.critical] == ["fold", "fold"] and len(found) == 1
    lower, upper = sorted(found.critical, key=lambda c: c.parameter)
    check(upper, snap_through, TRUSS, "P")
    check(lower, lambda p: -snap_through(p), TRUSS, "P")
    branch = found[0]
    between = (branch.q < float(upper.q) - 1e-6) & (branch.q > float(lower.q) + 1e-6)
    outside = (branch.q > float(upper.q) + 1e-6) | (branch.q < float(lower.q) - 1e-6)
    assert not branch.stable[between].any() and branch.stable[outside].all()
    rest = np.hypot(TRUSS["a"], TRUSS["h"])
    load = -2 * TRUSS["k"] * (1 - rest / np.hypot(TRUSS["a"], branch.q)) * branch.q
    np.testing.assert_allclose(branch.parameter, load, rtol=1e-11, atol=1e-11)
    assert "ends at the end of the range" in repr(found) and "fold" in repr(found)


def test_exchange_of_stability():
    """Two branches cross transcritically at mu = c, and neither folds."""
    found = lj.continue_equilibria(exchange, EXCHANGE, 0.0, along="mu", to=1.0)
    (critical,) = found.critical
    assert critical.kind == "transcritical"
    check(critical, lambda p: p["c"] + 0 * p["d"] + 0 * p["mu"], EXCHANGE, "mu")
    other = found[1]
    np.testing.assert_allclose(other.q, (other.parameter - EXCHANGE["c"]) / EXCHANGE["d"], atol=1e-13)
    off = np.abs(other.parameter - EXCHANGE["c"]) > 1e-6
    np.testing.assert_array_equal(other.stable[off], other.parameter[off] > EXCHANGE["c"])


# Several coordinates.


@pytest.mark.slow
def test_column():
    """It buckles at P l = c (3 ∓ √5)/2, each a pitchfork with its own branch; only the first branch is stable."""
    found = lj.continue_equilibria(column, COLUMN, np.zeros(2), along="P", to=6.0)
    assert [c.kind for c in found.critical] == ["pitchfork", "pitchfork"] and len(found) == 3
    for critical, factor in zip(found.critical, BUCKLING):
        check(critical, lambda p, factor=factor: factor * p["c"] / p["l"] + 0 * p["P"], COLUMN, "P")
    stable = [b.stable for b in found.branches]
    assert stable[1].all() and not stable[2].any()
    assert lj.continue_equilibria(column, COLUMN, np.zeros(2), along="P", to=6.0, crossings=False).status != ""


@pytest.mark.slow
def test_cross_rails():
    """ω² = k/m: a line of equilibria; ω² = K/m: the equilibrium goes to infinity, from both sides."""
    params = cross_rails.PARAMS
    system = cross_rails.rotating_system

    def root(name):
        return lambda p: jnp.sqrt(p[name] / p["m"]) + 0 * (p["omega"] + p["R0"] + p["K"] + p["k"])

    found = lj.continue_equilibria(system, params | {"omega": 1.0}, {"R": 0.8, "r": 0.0}, along="omega", to=9.0)
    assert [c.kind for c in found.critical] == ["line of equilibria", "escape"]
    check(found.critical[0], root("k"), params, "omega")
    check(found.critical[1], root("K"), params, "omega")
    main, line = found[0], found[1]
    inner = main.parameter < 0.999 * np.sqrt(params["K"] / params["m"])
    exact = np.asarray(cross_rails.equilibrium_length(params | {"omega": main.parameter}))
    np.testing.assert_allclose(main.q["R"][inner], exact[inner], rtol=1e-11)
    np.testing.assert_array_equal(main.stable[1:-1], cross_rails.is_stable(params | {"omega": main.parameter[1:-1]}))
    assert np.ptp(line.parameter) < 1e-12 and np.ptp(line.q["r"]) > 0.5 and "infinity" in main.status
    above = lj.continue_equilibria(system, params | {"omega": 9.0}, {"R": -0.8, "r": 0.0}, along="omega", to=1.0)
    check(above.critical[0], root("K"), params, "omega")
    assert above[0].stable.all() and above[0].q["R"].max() < 0


@pytest.mark.slow
def test_sleeping_top():
    """Two frequencies meet at ω_c = 2 √(M g l I1)/I3, where the sleeping top wakes, along the held spin."""
    start = UPRIGHT | {"spin": 12.0}
    found = lj.continue_equilibria(top, TOP, UPRIGHT, velocity=start, along="v.spin", to=2.0)
    (critical,) = found.critical
    assert critical.kind == "flutter"
    check(critical, slowest_sleeping_spin, TOP, "v.spin")
    # They meet at half of I3 ω / I1.
    np.testing.assert_allclose(critical.frequency, TOP["I3"] * critical.parameter / (2 * TOP["I1"]), rtol=1e-10)
    branch = found[0]
    off = np.abs(branch.parameter - float(critical.parameter)) > 1e-9
    np.testing.assert_array_equal(branch.stable[off], branch.parameter[off] > float(critical.parameter))


@pytest.mark.exhaustive
def test_flutter_of_a_column():
    """Ziegler's: P l/c = 7/2 - √2 without damping, 41/28 + b²/(2 m l² c) with it (Ziegler, Ing.-Arch. 20 (1952) 49)."""
    for system, exact in ((ziegler, flutter_load), (damped_ziegler, damped_flutter_load)):
        found = lj.continue_equilibria(system, ZIEGLER, np.zeros(2), along="P", to=10.0)
        (critical,) = found.critical
        assert critical.kind == "flutter" and critical.frequency > 0
        check(critical, lambda p, exact=exact: exact(p) + 0 * (p["m"] + p["b"] + p["P"]), ZIEGLER, "P")
    assert flutter_load(ZIEGLER) > 1.3 * damped_flutter_load(ZIEGLER)


@pytest.mark.slow
def test_several_zeros_together():
    """A rotating spherical pendulum: at ω² = g/l its stiffness vanishes in all directions, but it stays stable."""
    params = {"omega": 0.2, "g": 4.0}
    found = lj.continue_equilibria(turning_pendulum, params, np.zeros(2), along="omega", to=3.0)
    (critical,) = found.critical
    assert critical.kind == "multiple zero" and found[0].stable.all()
    check(critical, lambda p: jnp.sqrt(p["g"]) + 0 * p["omega"], params, "omega")


@pytest.mark.exhaustive
def test_a_moving_constraint():
    """A constraint drives the hoop, and the equations find its rate: the same pitchfork, with the motor's torque."""
    start = {"psi": 0.0, "theta": 0.0}
    settings = {"velocity": start | {"theta": 1.0}, "cyclic": "theta", "hold": None}
    params = BEAD | {"omega": 1.0}
    found = lj.continue_equilibria(bead_on_hoop.driven_system, params, start, along="omega", to=8.0, **settings)
    (critical,) = found.critical
    assert critical.kind == "pitchfork"
    check(critical, lambda p: jnp.sqrt(p["g"] / p["a"]) + 0 * p["m"], BEAD, "omega")
    np.testing.assert_allclose(found[1].v["theta"], found[1].parameter, rtol=1e-12)
    np.testing.assert_allclose(found[1].multipliers["motor"], 0.0, atol=1e-10)


@pytest.mark.slow
def test_rolling_disk():
    """Rolling straight ahead it is stable above √(g/(3 r)): one of many zero roots grows; no branch crosses."""
    velocity = {name: 8.0 * rate for name, rate in straight_on(UPRIGHT_DISK, DISK).items()}
    settings = {"velocity": velocity, "cyclic": straight_on, "along": "v[0]", "to": 0.5}
    (critical,) = lj.continue_equilibria(disk, DISK, UPRIGHT_DISK, **settings).critical
    assert critical.kind == "divergence"
    check(critical, lambda p: slowest_rolling(p) + 0 * p["m"], DISK, "v[0]")


@pytest.mark.slow
def test_closed_curve_and_folds_of_a_side_branch():
    """A circle that crosses the first branch at both ends; a subcritical pitchfork whose branch folds at mu = -1/4."""
    one = lambda potential: lj.System(lambda t, q, v, p: 0.5 * v**2 - potential(q, p["mu"]))
    circle = one(lambda q, mu: 0.25 * q**4 - 0.5 * (1 - mu**2) * q**2)
    found = lj.continue_equilibria(circle, {"mu": -2.0}, 0.0, along="mu", to=2.0)
    assert [c.kind for c in found.critical] == ["pitchfork", "pitchfork"] and len(found) == 2
    np.testing.assert_allclose([c.parameter for c in found.critical], [-1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(found[1].parameter ** 2 + found[1].q ** 2, 1.0, rtol=1e-12)
    sudden = one(lambda q, mu: q**6 / 6 - 0.25 * q**4 - 0.5 * mu * q**2)
    found = lj.continue_equilibria(sudden, {"mu": -1.0}, 0.0, along="mu", to=1.0)
    np.testing.assert_allclose([c.parameter for c in found.of_kind("fold")], [-0.25, -0.25], rtol=1e-12)
    np.testing.assert_allclose(sorted(float(c.q) for c in found.of_kind("fold")), [-(0.5**0.5), 0.5**0.5], rtol=1e-9)
    assert float(found.of_kind("pitchfork")[0].parameter) == pytest.approx(0.0, abs=1e-13)


@pytest.mark.exhaustive
def test_folds_of_random_curves():
    """Branches that are graphs mu(q): exactly the folds between their ends are found, by a fine grid of mu'."""

    def potential(t, q, v, p):
        waves = p["a"] * jnp.cos(q) + p["b"] * jnp.cos(2 * q + p["shift"]) / 2 + p["d"] * jnp.cos(5 * q) / 5
        return 0.5 * v**2 + p["mu"] * q + waves - 0.5 * p["c"] * q**2

    system, rng, start, counted = lj.System(potential), np.random.default_rng(5), -20.0, 0
    for _ in range(12):
        p = dict(zip("abd", rng.normal(size=3) * [2, 2, 0.5])) | {"c": 0.3 + 0.5 * rng.uniform(), "shift": rng.normal()}
        mu = lambda q, p=p: (
            p["a"] * np.sin(q) + p["b"] * np.sin(2 * q + p["shift"]) + p["d"] * np.sin(5 * q) + p["c"] * q
        )
        first = mu(start)
        found = lj.continue_equilibria(system, p | {"mu": first}, start, along="mu", to=first + 12.0)
        towards = np.sign(mu(start + 1e-6) - first)
        values = mu(start + towards * np.linspace(1e-9, 80.0, 400001))
        outside = np.flatnonzero((values < first - 1e-12) | (values > first + 12.0))
        slopes = np.diff(values[: outside[0] if len(outside) else None])
        turns = values[1:-1][: len(slopes) - 1][slopes[1:] * slopes[:-1] < 0]
        folds = [float(c.parameter) for c in found.critical]
        assert {c.kind for c in found.critical} <= {"fold"} and found[0].status == "the end of the range"
        np.testing.assert_allclose(np.sort(folds), np.sort(turns), atol=1e-6)
        counted += len(folds)
    assert counted > 20


@pytest.mark.slow
@pytest.mark.parametrize("e", [1e-3, 1e-6])
def test_nearly_a_pitchfork(e):
    """With a small push there is no crossing, steps do not jump to the other branch, and the branch stays stable."""
    pushed = lj.System(lambda t, q, v, p: 0.5 * v**2 + 0.5 * p["mu"] * q**2 - 0.25 * q**4 + p["e"] * q)
    found = lj.continue_equilibria(pushed, {"mu": -1.0, "e": e}, 0.0, along="mu", to=1.0)
    assert len(found) == 1 and not found.critical and found[0].stable.all() and found[0].q[-1] > 0.9
    back = lj.continue_equilibria(pushed, {"mu": 1.0, "e": e}, -1.0, along="mu", to=-1.0)
    # The other branch folds where mu³ = 27 e²/4.
    (critical,) = back.critical
    assert critical.kind == "fold"
    np.testing.assert_allclose(critical.parameter, np.cbrt(6.75 * e**2), rtol=1e-10)
    np.testing.assert_allclose(critical.derivative["e"], 2 / 3 * np.cbrt(6.75 / e), rtol=1e-8)


# Printed results and messages.


def test_derivatives_are_those_of_other_runs():
    """Twin of the derivatives: a step in g moves the critical speed as predicted; a wrong sign would be detected."""
    at = lambda g: float(
        lj.continue_equilibria(bead_on_hoop.system, BEAD | {"omega": 1.0, "g": g}, 0.0, along="omega", to=8.0)
        .critical[0]
        .parameter
    )
    slope = (at(BEAD["g"] + 1e-3) - at(BEAD["g"] - 1e-3)) / 2e-3
    critical = bead(1.0, 0.0, 8.0).critical[0]
    np.testing.assert_allclose(critical.derivative["g"], slope, rtol=1e-7)
    assert abs(float(critical.derivative["g"]) + slope) > 0.1


def test_what_is_drawn():
    """Stable parts are solid, unstable dashed, the pitchfork is marked, axes are named; unknown names are refused."""
    found = bead(1.0, 0.0, 8.0)
    (axis,) = found.plot().axes
    dashes = {line.get_linestyle() for line in axis.get_lines() if len(line.get_xdata()) > 2}
    assert dashes == {"-", "--"} and axis.get_xlabel() == "omega" and axis.get_ylabel() == "q"
    labels = axis.get_legend_handles_labels()[1]
    assert {"stable", "unstable", "pitchfork"} <= set(labels)
    with pytest.raises(ValueError, match="names no coordinate"):
        found.plot("theta")


@pytest.mark.parametrize(
    "change, words",
    [
        ({"along": "speed"}, "along='speed' is no number in params; there are 'a', 'g', 'm' and 'omega'"),
        ({"to": 6.0}, "leaves the parameter 'omega' no range: it starts at 6"),
        ({"velocity": 1.0}, "L depends on 'q'"),
    ],
)
def test_bad_input(change, words):
    """Errors name what is wrong."""
    settings = {"along": "omega", "to": 8.0} | change
    with pytest.raises(ValueError, match=words):
        lj.continue_equilibria(bead_on_hoop.system, BEAD, 1.0, **settings)


def test_no_start_and_no_program():
    """Without an equilibrium there is no branch; and inside a compiled program its points cannot be counted."""
    with pytest.raises(ValueError, match="no equilibrium was found from the start"):
        lj.continue_equilibria(exchange, EXCHANGE | {"mu": 1.0, "d": 0.0, "c": np.nan}, 0.5, along="mu", to=2.0)
    with pytest.raises(TypeError, match="JAX is tracing"):
        jax.jit(lambda g: bead(g, 0.0, 8.0).critical[0].parameter)(1.0)


def test_a_branch_that_stalls():
    """It stops where L is undefined, says so, and returns its points so far; twin: a shorter range is completed."""
    edge = lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2 - p["s"] * jnp.sqrt(1.0 - q) ** 3 + p["f"] * q
    system, params = lj.System(edge), {"f": 0.0, "s": 0.1}
    found = lj.continue_equilibria(system, params, 0.0, along="f", to=3.0)
    assert len(found[0]) > 10 and "Newton's method does not converge" in found[0].status
    np.testing.assert_allclose([found[0].parameter[-1], found[0].q[-1]], 1.0, atol=1e-2)
    assert lj.continue_equilibria(system, params, 0.0, along="f", to=0.9)[0].status == "the end of the range"
