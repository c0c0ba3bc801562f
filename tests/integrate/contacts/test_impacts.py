"""Impacts with friction: closed forms of a ball, all laws at random states, energy, derivatives, invalid friction."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.system.test_hybrid import G, in_phases

R = 0.25
PARAMS = {"m": 2.0, "R": R, "g": G, "mu": 0.2, "e": 0.5, "disk": 0.4}


def ball(t, q, v, p):
    """A round body with the moment of inertia `disk` m R²: 2/5 of a sphere, 1/2 of a disk."""
    spin = 0.5 * p["disk"] * p["m"] * p["R"] ** 2 * v["phi"] ** 2
    return 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2) + spin - p["m"] * p["g"] * q["y"]


above = lambda t, q, p: q["y"] - p["R"]
sliding = lambda t, q, v, p: v["x"] + p["R"] * v["phi"]
coefficient = lambda p: p["mu"]
flying = lj.System(ball)


def bounce(friction: Any = coefficient, restitution=0.5):
    """The guard of a floor with friction."""
    return lj.touches(above, restitution, friction=friction, sliding=sliding)


def impact(guard, system):
    """The velocities after an impact, as a function (t, q, v, params) -> like v."""
    found = guard.reset.between(system, system)
    return jax.jit(lambda t, q, v, params: found(t, q, v, params))


def after(x, y, phi, mu=0.2, e=0.5, disk=0.4):
    """The velocities after an impact in closed form, and whether the contact sticks."""
    slip, share = x + R * phi, disk / (1 + disk)
    holds = abs(slip) * share <= mu * (1 + e) * abs(y)
    push = -share * slip if holds else -np.sign(slip) * mu * (1 + e) * abs(y)
    return [x + push, -e * y, phi + push / (disk * R)], holds


def test_a_ball_slides_or_sticks():
    """Spheres and disks slide or stick on either side of the boundary; a sticking sphere has v' = (5 v - 2 R ω)/7."""
    q, found = {"x": 0.0, "y": R, "phi": 0.3}, impact(bounce(), flying)
    velocities = lambda *v, **p: found(0.0, q, dict(zip(("x", "y", "phi"), v)), PARAMS | p)
    edge = 0.2 * 1.5 * 2.0 * 7 / 2
    for x, disk in (
        (9.0, 0.4),
        (-9.0, 0.4),
        (1.0, 0.4),
        (0.5, 0.5),
        (9.0, 0.5),
        (edge - 1e-9, 0.4),
        (edge + 1e-9, 0.4),
    ):
        expected, holds = after(x, -2.0, 1.6, disk=disk)
        got = velocities(x, -2.0, 1.6, disk=disk)
        np.testing.assert_allclose([got["x"], got["y"], got["phi"]], expected, rtol=1e-14, atol=1e-14)
        assert (abs(sliding(0.0, q, got, PARAMS)) < 1e-14) == holds
    v = velocities(1.0, -2.0, 1.6)
    np.testing.assert_allclose(v["x"], (5 * 1.0 - 2 * R * 1.6) / 7, rtol=1e-14)
    np.testing.assert_allclose(velocities(9.0, -2.0, 1.6)["x"], 9.0 - 0.2 * 1.5 * 2.0, rtol=1e-14)
    # At the boundary sliding and sticking agree.
    near = [velocities(edge - R * 1.6 + off, -2.0, 1.6)["phi"] for off in (-1e-9, 1e-9)]
    np.testing.assert_allclose(near[0], near[1], rtol=0, atol=3e-8)
    # A contact that is opening receives no impulse.
    np.testing.assert_allclose(velocities(1.0, 2.0, 1.6)["x"], 1.0)
    # Twins: no friction, and friction that drives the sliding.
    smooth = impact(lj.touches(above, 0.5), flying)(0.0, q, {"x": 9.0, "y": -2.0, "phi": 1.6}, PARAMS)
    assert abs(smooth["x"] - after(9.0, -2.0, 1.6)[0][0]) > 0.1
    driven = impact(bounce(friction=-0.2), flying)(0.0, q, {"x": 9.0, "y": -2.0, "phi": 1.6}, PARAMS)
    assert kinetic(flying, q, driven) > kinetic(flying, q, {"x": 9.0, "y": -2.0, "phi": 1.6})


def kinetic(system, q, v, params=PARAMS):
    """The kinetic energy: L at height zero."""
    return float(system.lagrangian(0.0, jax.tree.map(jnp.zeros_like, q), v, params))


def test_a_ball_never_gains():
    """At any restitution and velocities an impact never increases the energy of a ball."""
    rng = np.random.default_rng(3)
    q, found = {"x": 0.0, "y": R, "phi": 0.3}, impact(bounce(restitution=lambda speed: 0.7 + 0.0 * speed), flying)
    for x, y, phi, mu in rng.normal(size=(40, 4)) * [3.0, 3.0, 20.0, 1.0]:
        v = {"x": x, "y": -abs(y), "phi": phi}
        assert kinetic(flying, q, found(0.0, q, v, PARAMS | {"mu": abs(mu)})) <= kinetic(flying, q, v) * (1 + 1e-14)


ANY = lj.System(lambda t, q, v, p: 0.5 * v @ p["M"] @ v, {"held": lj.Nonholonomic(lambda t, q, v, p: p["held"] @ v)})
along = lambda t, q, v, p: p["along"] @ v
LAWS = lj.touches(lambda t, q, p: p["normal"] @ q, lambda speed: 0.0 * speed, coefficient, along)


def anything(rng, n=4):
    """A random metric, contact and constraint, and velocities before the impact that agree with it."""
    shape = rng.normal(size=(n, n))
    p = {"M": shape @ shape.T + 0.1 * np.eye(n), "mu": abs(rng.normal())}
    p |= {name: rng.normal(size=n) for name in ("normal", "along", "held")}
    v = rng.normal(size=n)
    v = v - p["held"] * (p["held"] @ v) / (p["held"] @ p["held"])
    return p, v * -np.sign(p["normal"] @ v)


def all_solutions(p, v, e=0.0):
    """Every impulse that obeys the laws, by trying each mode; the velocities after each."""
    found, rows = [], np.stack([p["normal"], p["along"], p["held"]])
    delassus = rows @ np.linalg.solve(p["M"], rows.T)
    for mode in ("sticks", 1, -1):
        law = [0.0, 1.0, 0.0] if mode == "sticks" else [mode * p["mu"], 1.0, 0.0]
        wanted = np.array([-(1 + e) * p["normal"] @ v, -p["along"] @ v, 0.0])
        equations = np.stack([delassus[0], delassus[1] if mode == "sticks" else law, delassus[2]])
        impulse = np.linalg.solve(equations, wanted if mode == "sticks" else wanted * [1, 0, 1])
        u = v + np.linalg.solve(p["M"], rows.T @ impulse)
        slides = p["along"] @ u
        if impulse[0] >= 0 and (abs(impulse[1]) <= p["mu"] * impulse[0] if mode == "sticks" else mode * slides > 0):
            found.append(u)
    return found


def test_all_laws_at_random_states():
    """In 200 random metrics with one more constraint the only solution is found, and no energy is gained.

    Twin: impulses in the metric of the coordinates differ.
    """
    rng, found, off, modes = np.random.default_rng(0), impact(LAWS, ANY), [], []
    for _ in range(200):
        p, v = anything(rng)
        solutions = all_solutions(p, v)
        assert len(solutions) == 1
        u = found(0.0, np.zeros(4), v, p)
        np.testing.assert_allclose(u, solutions[0], rtol=0, atol=1e-9 * np.max(np.abs(v)) * np.linalg.cond(p["M"]))
        assert u @ p["M"] @ u <= v @ p["M"] @ v * (1 + 1e-12)
        modes.append(abs(p["along"] @ u) < 1e-9)
        off.append(np.max(np.abs(found(0.0, np.zeros(4), v, p | {"M": np.eye(4)}) - u)))
    assert 20 < sum(modes) < 180 and min(off) > 1e-6


def test_newton_may_gain():
    """Friction that reverses the sliding can, with restitution by Newton's law, gain energy, as the source says."""
    rng, guard = np.random.default_rng(1), lj.touches(LAWS.gap, 0.9, coefficient, along)
    found, gained = impact(guard, ANY), []
    for _ in range(200):
        p, v = anything(rng)
        u = found(0.0, np.zeros(4), v, p)
        np.testing.assert_allclose(u, all_solutions(p, v, 0.9)[0], atol=1e-9 * np.linalg.cond(p["M"]))
        gains = u @ p["M"] @ u > v @ p["M"] @ v * (1 + 1e-9)
        assert not gains or (p["along"] @ u) * (p["along"] @ v) <= 1e-9
        gained.append(gains)
    assert any(gained)


@pytest.mark.slow
def test_sliding_that_is_settled():
    """A contact that cannot slide keeps its constraints; if friction jams one that must slide, there is no impulse."""
    rng = np.random.default_rng(2)
    p, v = anything(rng)
    found, smooth = impact(LAWS, ANY), impact(lj.touches(LAWS.gap, 0.0), ANY)
    u = found(0.0, np.zeros(4), v, p | {"along": 3.0 * p["held"]})
    np.testing.assert_allclose(u, smooth(0.0, np.zeros(4), v, p), rtol=1e-12)
    # γ_T' = 2 γ_N' > 0 pulls with 2 μ of what pushes.
    point = lj.System(lambda t, q, v, p: 0.5 * v**2)
    rising = lj.touches(lambda t, q, p: q, 0.5, coefficient, lambda t, q, v, p: 2.0 * v)
    assert impact(rising, point)(0.0, 0.0, -1.0, {"mu": 0.4}) == 0.5
    assert np.isnan(impact(rising, point)(0.0, 0.0, -1.0, {"mu": 0.6}))


def on_wire(name):
    """A bead that slides down a wire, x = 2 y, to a floor with friction."""
    falls = lj.System(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 9.81 * q[1], {name: lj.Holonomic(lambda t, q, p: q[0] - 2.0 * q[1])}
    )
    floor = lj.touches(lambda t, q, p: q[1], 0.5, coefficient, lambda t, q, v, p: v[0])
    return lj.Hybrid({"falls": falls}, [lj.Switch("falls", to="falls", when=floor)])


@pytest.mark.exhaustive
def test_a_contact_that_jams_is_said():
    """A jammed contact is reported by name and cause; the motion up to it is kept."""
    start, ts = (jnp.array([2.0, 1.0]), jnp.zeros(2), {"mu": 5.0}), np.array([0.0, 1.0, 1.2])
    with pytest.raises(RuntimeError, match="(?s)'falls' -> 'falls'.* at t = 1.00963755 .*not finite.*jams.*Fix: less"):
        lj.integrate(on_wire("wire"), *start, ts=ts)
    traj = lj.integrate(on_wire("wire"), *start, ts=ts, throw=False)
    assert bool(traj.result == lj.RESULTS.reset_not_finite)
    assert np.isfinite(traj.q[:, 0]).tolist() == [True, True, False]


hopping = lj.Hybrid({"flying": flying}, [lj.Switch("flying", to="flying", when=bounce())], most_switches=2)
HEIGHT, UNTIL = 0.8, 0.6


def thrown(given, **options):
    """A ball thrown from a height with given x and φ velocities and friction, through one impact."""
    x, phi, mu = given
    q0, v0 = {"x": 0.0, "y": R + HEIGHT, "phi": 0.0}, {"x": x, "y": 0.0, "phi": phi}
    return lj.integrate(hopping, q0, v0, PARAMS | {"mu": mu}, ts=np.array([0.0, UNTIL]), **options)


def thrown_exactly(x, phi, mu):
    """The final position and angle of the ball, in closed form."""
    fall, speed = np.sqrt(2 * HEIGHT / G), np.sqrt(2 * HEIGHT * G)
    (u, _, spin), _ = after(x, -speed, phi, mu=mu)
    return np.array([x * fall + u * (UNTIL - fall), phi * fall + spin * (UNTIL - fall)])


@pytest.mark.exhaustive
def test_thrown_on_a_floor():
    """Position after the impact, impulse, and derivatives in both modes, for lanes that slide and that stick."""
    members = np.array([[9.0, 1.0, 0.2], [1.0, 1.0, 0.2], [-9.0, 4.0, 0.1]])

    def ends(given):
        q = thrown(given, estimate_error=False).q
        return jnp.stack([q["x"][-1], q["phi"][-1]])

    expected = np.array([thrown_exactly(*given) for given in members])
    np.testing.assert_allclose(jax.jit(jax.vmap(ends))(members), expected, rtol=1e-10)
    step = 1e-5
    slopes = np.zeros((3, 2, 3))
    for i, given in enumerate(members):
        for j, off in enumerate(step * np.eye(3)):
            slopes[i, :, j] = (thrown_exactly(*(given + off)) - thrown_exactly(*(given - off))) / (2 * step)
    assert slopes[0, 0, 2] != 0 and slopes[1, 0, 2] == 0
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(jax.vmap(mode(ends)))(members), slopes, rtol=1e-8, atol=1e-8)
    switches = in_phases(hopping, *start(9.0, 1.0), PARAMS, ts=np.array([0.0, UNTIL])).switches
    normal = 2.0 * 1.5 * np.sqrt(2 * HEIGHT * G)
    np.testing.assert_allclose(switches.impulse["y"][0], normal, rtol=1e-10)
    np.testing.assert_allclose(switches.impulse["x"][0], -0.2 * normal, rtol=1e-10)
    np.testing.assert_allclose(switches.impulse["phi"][0], -0.2 * normal * R, rtol=1e-10)


def start(x, phi):
    """The start of `thrown`."""
    return {"x": 0.0, "y": R + HEIGHT, "phi": 0.0}, {"x": x, "y": 0.0, "phi": phi}


def drag(t, q, v, multipliers, p):
    """Friction against a contact that slides forward."""
    force = -p["mu"] * multipliers["floor"]
    return {"x": force, "y": 0.0, "phi": p["R"] * force}


floor = lj.Holonomic(above)
slides = lj.System(ball, {"floor": floor}, force=drag)
rolls = lj.System(ball, {"floor": floor, "grip": lj.Nonholonomic(sliding)})
landing = lj.Hybrid(
    {"flying": flying, "slides": slides, "rolls": rolls},
    [
        lj.Switch("flying", to="slides", when=bounce(restitution=0.0)),
        lj.Switch("slides", to="rolls", when=lj.sticks(sliding)),
        lj.Switch("rolls", to="slides", when=lj.slips("grip", on="floor", coefficient=coefficient, side=-1)),
    ],
    most_switches=4,
)


@pytest.mark.exhaustive
def test_it_lands_sliding_or_rolling():
    """A ball that sticks at the impact rolls at once, one that slides rolls later."""
    fall, ts = np.sqrt(2 * HEIGHT / G), np.array([0.0, UNTIL, 3.0])
    sticking = in_phases(landing, *start(1.0, 1.0), PARAMS, ts=ts)
    assert list(sticking.named_phases()) == ["flying", "rolls", "rolls"]
    np.testing.assert_allclose(sticking.switches.t[:2], fall, rtol=1e-12)
    np.testing.assert_allclose(sticking.v["x"][-1], (5 - 2 * R) / 7, rtol=1e-9)
    slipping = in_phases(landing, *start(9.0, 1.0), PARAMS, ts=ts)
    assert list(slipping.named_phases()) == ["flying", "slides", "rolls"]
    # Sliding at 9 + R decreases at the rate 3.5 μ g; the impact takes off 3.5 μ times the speed of the fall.
    when = (9.0 + R) / (3.5 * 0.2 * G)
    np.testing.assert_allclose(slipping.switches.t[:2], [fall, when], rtol=1e-9)
    np.testing.assert_allclose(slipping.v["x"][-1], (45 - 2 * R) / 7, rtol=1e-9)


point = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)
