"""Systems that users of this and other libraries reported, each with its right value."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj

ONE = np.array([0.0, 1.0])
kinetic = lambda t, q, v, p: 0.5 * v**2

# Whose numbers: what a function reads from outside.


@pytest.mark.slow
def test_a_new_model_has_its_own_numbers():
    """A model made after one of the same code has changed: h(1) = g and x(1) = -g/2. Twin: the one that has changed."""
    weighed = lambda model: lj.System(lambda t, q, v, p: kinetic(t, q, v, p) - model["g"] * q)
    integral = lambda s: lj.jacobi_integral(s, 0.0, 1.0, 0.0, None)
    fallen = lambda s: -2 * lj.integrate(s, 0.0, 0.0, ts=ONE, method=lj.Tsit5(), estimate_error=False).q[-1]
    first = {"g": 9.81}
    for of in (integral, fallen):
        np.testing.assert_allclose(of(weighed(first)), 9.81, rtol=1e-12)
    first["g"] = 4.0
    for of in (integral, fallen):
        np.testing.assert_allclose([of(weighed({"g": 9.81})), of(weighed(first))], [9.81, 4.0], rtol=1e-12)


OUTSIDE = types.SimpleNamespace(level=1.0, push=1.0)


def when_reached(level):
    """The time at which q = 2 t reaches a level that the guard reads from outside."""
    OUTSIDE.level = level
    at_level = {"level": lj.Crossing(lambda t, q, v, p: q - OUTSIDE.level)}
    return lj.integrate(lj.System(kinetic), 0.0, 2.0, ts=10 * ONE, events=at_level).end.t


def pushed(push):
    """Where a force that is read from outside has moved a unit mass at t = 1."""
    OUTSIDE.push = push
    return lj.integrate(lj.System(kinetic, force=lambda t, q, v, p: OUTSIDE.push), 0.0, 0.0, ts=ONE).q[-1]


@pytest.mark.slow
@pytest.mark.parametrize("function", [when_reached, pushed])
def test_a_guard_and_a_force_read_traced_numbers(function):
    """level/2 and push/2, and their derivatives, compiled, at two numbers."""
    compiled = jax.jit(jax.value_and_grad(function))
    np.testing.assert_allclose([compiled(3.0), compiled(4.0)], [[1.5, 0.5], [2.0, 0.5]], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("nan", [3.0, 2.0])
def test_a_lagrangian_that_asks_for_nan(nan):
    """V = c q² with c where 0 · ∞ gives NaN: a = -2 c and q(1) = cos(sqrt(2 c)), for two c."""
    asked = lj.System(
        lambda t, q, v, p: kinetic(t, q, v, p) - jnp.nan_to_num(0.0 * (1 / jnp.array(0.0)), nan=nan) * q**2
    )
    np.testing.assert_allclose(lj.accelerations(asked, 0.0, 1.0, 0.0, None)[0], -2 * nan, rtol=1e-14)
    np.testing.assert_allclose(lj.integrate(asked, 1.0, 0.0, ts=ONE).q[-1], np.cos(np.sqrt(2 * nan)), rtol=1e-9)


# Advice.


@pytest.mark.slow
def test_no_advice_to_take_what_is_there():
    """In float64 at 1e-13 neither float64 nor a tighter rtol is advised, but a shorter span. Twin: that one helps."""
    lagrangian = lambda t, q, v, p: (
        0.5 * v @ v + 0.5 * v[0] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1]) + 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    )
    until = lambda t: lj.integrate(lj.System(lagrangian), np.array([2.0, 2.5]), np.zeros(2), ts=[0.0, t], rtol=1e-13)
    with pytest.warns(lj.AccuracyWarning, match="(?s)amplifies errors.*\nFix: a shorter span") as said:
        until(30.0)
    fix = str(said[0].message).split("Fix:")[1]
    assert "float64" not in fix and "rtol" not in fix
    assert until(5.0).scaled_error < 1


# Dry friction in phases.


SIDES = {"left": 1, "right": -1}


@pytest.mark.exhaustive
def test_a_block_slides_and_sticks_in_phases():
    """Each half swing of a block on a spring loses 2 μ m g / k, until it sticks: where, when, and dx/dμ.

    Twin: with half the friction it sticks elsewhere, after more half swings.
    """
    k, g = 100.0, 9.81
    spring = lambda t, q, v, mu: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * k * q["x"] ** 2 - g * q["y"]
    floor, grip = lj.Holonomic(lambda t, q, mu: q["y"]), lj.Nonholonomic(lambda t, q, v, mu: v["x"])
    rubbed = lambda side: lambda t, q, v, lam, mu: {"x": side * mu * lam["floor"], "y": 0.0 * lam["floor"]}
    slides = {name: lj.System(spring, {"floor": floor}, force=rubbed(side)) for name, side in SIDES.items()}
    stays = lambda side: lj.slips("grip", on="floor", coefficient=lambda mu: mu, side=side)
    switches = [
        *(
            lj.Switch(name, to="stuck", when=lj.sticks(lambda t, q, v, mu, side=side: -side * v["x"]))
            for name, side in SIDES.items()
        ),
        *(lj.Switch("stuck", to=name, when=stays(side)) for name, side in SIDES.items()),
    ]
    phases = slides | {"stuck": lj.System(spring, {"floor": floor, "grip": grip})}
    hybrid = lj.Hybrid(phases, switches, most_switches=40)
    start, rest = {"x": 0.1, "y": 0.0}, {"x": 0.0, "y": 0.0}

    def end(mu):
        motion = lj.integrate(hybrid, start, rest, mu, ts=2 * ONE, start="left", estimate_error=False)
        at = motion.switches.t  # type: ignore[attr-defined]
        return motion.q["x"][-1], jnp.nanmax(jnp.where(at < jnp.inf, at, jnp.nan))

    for mu in (0.3, 0.15):
        lost = mu * g / k
        swings = np.ceil((0.1 / lost - 1) / 2)
        (x, t), (slope, _) = jax.jvp(end, (mu,), (1.0,))
        sign = (-1) ** swings
        right = sign * (0.1 - 2 * swings * lost), swings * np.pi / np.sqrt(k), -sign * 2 * swings * g / k
        np.testing.assert_allclose([x, t, slope], right, rtol=1e-7)


# Mechanisms and chains.

BARS = ("crank", "coupler", "rocker")
FOUR_BAR = {"l": np.array([0.2, 0.6, 0.5]), "m": np.array([1.0, 2.0, 1.5]), "d": 0.7, "g": 9.81, "torque": 2.0}


def bars(t, q, v, p):
    """Three uniform bars by their centres and angles."""
    x, u = (jnp.stack([tree[name] for name in BARS]) for tree in (q, v))
    turning = p["l"] ** 2 / 12 * u[:, 2] ** 2
    return p["m"] @ (0.5 * (jnp.sum(u[:, :2] ** 2, axis=1) + turning) - p["g"] * x[:, 1])


def joints(t, q, p):
    """The four joints: the ground and the crank, crank and coupler, coupler and rocker, rocker and ground."""
    half = {name: 0.5 * l * jnp.array([jnp.cos(q[name][2]), jnp.sin(q[name][2])]) for name, l in zip(BARS, p["l"])}
    low, high = ({name: q[name][:2] + sign * half[name] for name in BARS} for sign in (-1, 1))
    ground = jnp.array([p["d"], 0.0])
    gaps = low["crank"], high["crank"] - low["coupler"], high["coupler"] - high["rocker"], low["rocker"] - ground
    return jnp.concatenate(gaps)


@pytest.mark.exhaustive
def test_the_ledger_of_a_four_bar():
    """Nine coordinates, eight equations: the ledger ends, closes, and the bars gain the torque times its angle."""
    torque = lambda t, q, v, p: {name: jnp.zeros(3).at[2].set(p["torque"] * (name == "crank")) for name in BARS}
    driven = lj.System(bars, {"joints": lj.Holonomic(joints)}, force=torque)
    guess = {"crank": np.array([0.05, 0.08, 1.0]), "coupler": np.array([0.4, 0.3, 0.5])}
    guess["rocker"] = np.array([0.65, 0.25, 1.8])
    q, v = lj.consistent_state(driven, 0.0, guess, {name: np.zeros(3) for name in BARS}, FOUR_BAR, hold="crank[2]")
    motion = lj.integrate(driven, q, v, FOUR_BAR, ts=np.linspace(0.0, 0.3, 4))
    ledger = lj.energy_ledger(motion)
    turned = motion.q["crank"][-1, 2] - motion.q["crank"][0, 2]
    assert ledger.closes and abs(turned) > 0.1
    gained = ledger.jacobi_integral[-1] - ledger.jacobi_integral[0]
    np.testing.assert_allclose([ledger.works["force"].total[-1], gained], 2.0 * turned, rtol=1e-8)


LINKS = 3
LENGTH = MASS = 1.0 / LINKS
# I_ij of Σ_j I_ij (cos(θ_i - θ_j) θ_j'' + sin(θ_i - θ_j) θ_j'²) = -W_i sin θ_i: of points at the ends of massless
# links, and of uniform links.
after = LINKS - np.maximum.outer(np.arange(LINKS), np.arange(LINKS))
OF_POINTS = MASS * LENGTH**2 * after, MASS * 9.81 * LENGTH * np.diag(after)
OF_BARS = MASS * LENGTH**2 * (after - 0.5 - np.eye(LINKS) / 6), MASS * 9.81 * LENGTH * (np.diag(after) - 0.5)


def angles_by_hand(inertia, weight, start, end):
    """The angles of a chain from rest at a time, by SciPy."""

    def rate(t, y):
        q, w = np.split(y, 2)
        apart = q[:, None] - q
        force = -(inertia * np.sin(apart)) @ w**2 - weight * np.sin(q)
        return np.concatenate([w, np.linalg.solve(inertia * np.cos(apart), force)])

    return solve_ivp(rate, (0, end), [*start, *0 * start], "DOP853", rtol=1e-12, atol=1e-12).y[:LINKS, -1]


def chain_of_bars(t, q, v, p):
    """Uniform links by their angles, from the places and speeds of their centres."""
    centre = lambda x: jnp.cumsum(x) - 0.5 * x
    x, y = centre(LENGTH * jnp.cos(q) * v), centre(LENGTH * jnp.sin(q) * v)
    turning = LENGTH**2 / 12 * v @ v
    return MASS * (0.5 * (x @ x + y @ y + turning) + 9.81 * jnp.sum(centre(LENGTH * jnp.cos(q))))


def points(t, q, v, p):
    """Points by their places; the angles of the links between them have no mass."""
    return MASS * (0.5 * (v["x"] @ v["x"] + v["y"] @ v["y"]) - 9.81 * jnp.sum(q["y"]))


def links(t, q, p):
    """Massless links, which define their angles."""
    along = lambda x: jnp.diff(x, prepend=0.0)
    across, down = along(q["x"]) - LENGTH * jnp.sin(q["angle"]), along(q["y"]) + LENGTH * jnp.cos(q["angle"])
    return jnp.concatenate([across, down])


@pytest.mark.exhaustive
def test_chains():
    """A folded chain of bars by angles, and one of points on massless links; twin: the inertia of the other."""
    start, end = np.array([0.02, 0.03, 3.0]), np.array([0.0, 0.4])
    by_angles = lj.integrate(lj.System(chain_of_bars), start, 0 * start, ts=end, estimate_error=False).q[-1]
    place = {"x": np.cumsum(LENGTH * np.sin(start)), "y": -np.cumsum(LENGTH * np.cos(start)), "angle": start}
    massless = lj.System(points, {"links": lj.Holonomic(links)})
    still = {name: 0 * start for name in place}
    by_places = lj.integrate(massless, place, still, ts=end, estimate_error=False).q["angle"][-1]
    of_bars, of_points = (angles_by_hand(*of, start, 0.4) for of in (OF_BARS, OF_POINTS))
    np.testing.assert_allclose(by_angles, of_bars, atol=1e-7)
    np.testing.assert_allclose(by_places, of_points, atol=1e-7)
    assert np.max(np.abs(of_bars - of_points)) > 1e-2


# States of first order beside mechanics: coordinates without mass, whose velocities are constraints.

springs = lambda t, q, v, p: 0.5 * v["x"] ** 2 - 1.5 * q["s"] ** 2 - 3.0 * (q["x"] - q["s"]) ** 2
BETWEEN = {"x": 1.0, "s": 2 / 3}, {"x": 0.0, "s": 0.0}


@pytest.mark.slow
def test_a_massless_point_between_springs():
    """Springs of 3 and 6 in series are one of 2. The point's place must be said: without it, it is refused by name."""
    with pytest.raises(ValueError, match="(?s)singular in coordinate 's'.*or a constraint that determines it"):
        lj.accelerations(lj.System(springs), 0.0, *BETWEEN, None)
    balanced = lj.Holonomic(lambda t, q, p: 6.0 * (q["x"] - q["s"]) - 3.0 * q["s"])
    motion = lj.integrate(lj.System(springs, {"balanced": balanced}), *BETWEEN, ts=ONE)
    np.testing.assert_allclose(motion.q["x"][-1], np.cos(np.sqrt(2.0)), rtol=1e-9)


STIFF, VISCOUS, SLIDING, HOLDING, STRIBECK, SPRING, PULLED = 1e5, 0.4, 1.0, 1.5, 1e-3, 2.0, 0.1


def bristle_rate(xp, v, z):
    """z' of LuGre's bristles."""
    return v - STIFF * xp.abs(v) / (SLIDING + (HOLDING - SLIDING) * xp.exp(-((v / STRIBECK) ** 2))) * z


def friction(xp, v, z):
    """LuGre's friction."""
    return STIFF * z + np.sqrt(STIFF) * bristle_rate(xp, v, z) + VISCOUS * v


@pytest.mark.exhaustive
def test_stick_and_slip_of_bristles():
    """A block that a spring pulls over LuGre's bristles: as by SciPy's Radau. Twin: it sticks first, then slips."""

    def rate(t, y):
        x, v, z = y
        return [v, SPRING * (PULLED * t - x) - friction(np, v, z), bristle_rate(np, v, z)]

    ts = np.linspace(0.0, 12.0, 13)
    right = solve_ivp(rate, (0.0, 12.0), np.zeros(3), "Radau", rtol=1e-12, atol=1e-15, t_eval=ts).y[0]
    block = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * SPRING * (PULLED * t - q["x"]) ** 2,
        states={"z": lambda t, q, v, p: bristle_rate(jnp, v["x"], q["z"])},
        force=lambda t, q, v, p: {"x": -friction(jnp, v["x"], q["z"]), "z": 0.0},
    )
    found = lj.integrate(block, {"x": 0.0, "z": 0.0}, {"x": 0.0}, ts=ts, method=lj.Radau5(), rtol=1e-10).q["x"]
    np.testing.assert_allclose(found, right, atol=1e-8)
    assert right[7] < 1e-3 and right[-1] > 0.1
