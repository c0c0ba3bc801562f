"""Impacts with friction: closed forms of a ball, all laws at random states, energy, derivatives, invalid friction.

Contacts beside constraints of any name; coefficients that cannot be are refused.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from tests.by_numpy import by_numpy
from tests.system.test_system import G, in_phases

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
    return lj.guards.touches(above, restitution, friction=friction, sliding=sliding)


def impacts(guard, system):
    """One program for the velocities after many impacts: of lanes of q, v, params and restitution."""
    return jax.jit(jax.vmap(lambda q, v, p, e: guard(e).reset.between(system, system)(0.0, q, v, p)))


def after(x, y, phi, mu=0.2, e=0.5, disk=0.4):
    """The velocities after an impact in closed form, and whether the contact sticks."""
    slip, share = x + R * phi, disk / (1 + disk)
    holds = abs(slip) * share <= mu * (1 + e) * abs(y)
    push = -share * slip if holds else -np.sign(slip) * mu * (1 + e) * abs(y)
    return [x + push, -e * y, phi + push / (disk * R)], holds


LANES = 40
balls = impacts(lambda e: bounce(restitution=e), flying)


def bounced(velocities, mu, disk=0.4):
    """The velocities x, y and φ of balls after an impact; rows are repeated to as many as the program has."""
    lanes, names = lambda x: np.resize(x, LANES), ("x", "y", "phi")
    q, p = jax.tree.map(lanes, (dict(zip(names, (0.0, R, 0.3))), PARAMS | {"mu": mu, "disk": disk}))
    found = balls(q, dict(zip(names, np.resize(velocities, (LANES, 3)).T)), p, lanes(0.5))
    return np.stack([found[name] for name in names], axis=1)[: len(velocities)]


def test_a_ball_slides_or_sticks():
    """Spheres and disks slide or stick on either side of the boundary; a sticking sphere has v' = (5 v - 2 R ω)/7."""
    edge = 0.2 * 1.5 * 2.0 * 7 / 2 - R * 1.6
    near = (edge - 1e-9, 0.4), (edge + 1e-9, 0.4)
    cases = np.array([(9.0, 0.4), (-9.0, 0.4), (1.0, 0.4), (0.5, 0.5), (9.0, 0.5), *near])
    velocities = lambda x, y=-2.0: np.stack([x, np.full(x.size, y), np.full(x.size, 1.6)], axis=1)
    found = bounced(velocities(cases[:, 0]), 0.2, cases[:, 1])
    for (x, disk), got in zip(cases, found):
        expected, holds = after(x, -2.0, 1.6, disk=disk)
        np.testing.assert_allclose(got, expected, rtol=1e-14, atol=1e-14, err_msg=f"{x}, {disk}")
        assert (abs(got[0] + R * got[2]) < 1e-14) == holds, (x, disk)
    np.testing.assert_allclose(found[[0, 2], 0], [9.0 - 0.2 * 1.5 * 2.0, (5 - 2 * R * 1.6) / 7], rtol=1e-14)
    np.testing.assert_allclose(found[5, 2], found[6, 2], rtol=0, atol=3e-8, err_msg="at the boundary")
    opening = velocities(np.array([1.0]), 2.0)
    np.testing.assert_allclose(bounced(opening, 0.2), opening, err_msg="what opens gets no impulse")
    # Twin: no friction.
    assert abs(bounced(velocities(np.array([9.0])), 0.0)[0, 0] - found[0, 0]) > 0.1


ANY = lj.System(lambda t, q, v, p: 0.5 * v @ p["M"] @ v, {"held": lj.Nonholonomic(lambda t, q, v, p: p["held"] @ v)})
along = lambda t, q, v, p: p["along"] @ v
# The restitution as a function of the closing speed.
any_impacts = impacts(
    lambda e: lj.guards.touches(lambda t, q, p: p["normal"] @ q, lambda speed: e + 0.0 * speed, coefficient, along), ANY
)
MANY = 200


def anything(seed, n=4):
    """Random metrics, contacts and constraints, and velocities before the impact that agree with them, in lanes."""
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=(MANY, n, n))
    p = {"M": shape @ np.swapaxes(shape, 1, 2) + 0.1 * np.eye(n), "mu": np.abs(rng.normal(size=MANY))}
    p |= {name: rng.normal(size=(MANY, n)) for name in ("normal", "along", "held")}
    dot = lambda a, b: np.sum(a * b, axis=1, keepdims=True)
    v = rng.normal(size=(MANY, n))
    v = v - p["held"] * dot(p["held"], v) / dot(p["held"], p["held"])
    return p, v * -np.sign(dot(p["normal"], v))


def after_any(p, v, e=0.0):
    """The velocities after these impacts."""
    return np.asarray(any_impacts(np.zeros((MANY, 4)), v, p, np.full(MANY, e)))


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


def energy_and_sliding(p, v):
    """Twice the energy, and the sliding velocity, of each lane."""
    return np.einsum("li,lij,lj->l", v, p["M"], v), np.sum(p["along"] * v, axis=1)


@pytest.mark.parametrize("e", [0.0, 0.9])
def test_all_laws_at_random_states(e):
    """In 200 random metrics with one more constraint the only solution is found. No energy is gained without
    restitution; with it, by Newton's law, friction that reverses the sliding can gain, as the source says.

    Twin: impulses in the metric of the coordinates differ.
    """
    p, v = anything(int(e > 0))
    u, sizes = after_any(p, v, e), np.max(np.abs(v), axis=1) * np.linalg.cond(p["M"])
    solutions = [all_solutions({name: x[k] for name, x in p.items()}, v[k], e) for k in range(MANY)]
    assert [len(of) for of in solutions] == MANY * [1]
    assert np.all(np.max(np.abs(u - np.array(solutions)[:, 0]), axis=1) < 1e-9 * sizes)
    (before, slid), (energy, slides) = energy_and_sliding(p, v), energy_and_sliding(p, u)
    gains = energy > before * (1 + 1e-9)
    assert np.any(gains) == (e > 0) and np.all(slides[gains] * slid[gains] <= 1e-9)
    assert e > 0 or np.all(energy <= before * (1 + 1e-12))
    assert 20 < np.sum(np.abs(slides) < 1e-9) < 180
    other = after_any(p | {"M": np.broadcast_to(np.eye(4), (MANY, 4, 4))}, v, e)
    assert np.min(np.max(np.abs(other - u), axis=1)) > 1e-6


def test_sliding_that_is_settled():
    """A contact that cannot slide keeps its constraints; if friction jams one that must slide, there is no impulse."""
    p, v = anything(2)
    fixed = after_any(p | {"along": 3.0 * p["held"]}, v)
    smooth = after_any(p | {"mu": np.zeros(MANY)}, v)
    assert np.all(np.max(np.abs(fixed - smooth), axis=1) < 1e-9 * np.linalg.cond(p["M"]))
    # γ_T' = 2 γ_N' > 0 pulls with 2 μ of what pushes.
    rising = impacts(
        lambda e: lj.guards.touches(lambda t, q, p: q, e, lambda mu: mu, lambda t, q, v, p: 2.0 * v),
        lj.System(lambda t, q, v, p: 0.5 * v**2),
    )
    found = rising(np.zeros(2), -np.ones(2), np.array([0.4, 0.6]), np.full(2, 0.5))
    np.testing.assert_array_equal(found, [0.5, np.nan])


def on_wire(name):
    """A bead that slides down a wire, x = 2 y, to a floor with friction."""
    falls = lj.System(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 9.81 * q[1], {name: lj.Holonomic(lambda t, q, p: q[0] - 2.0 * q[1])}
    )
    floor = lj.guards.touches(lambda t, q, p: q[1], 0.5, coefficient, lambda t, q, v, p: v[0])
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
FALL, SPEED = np.sqrt(2 * HEIGHT / G), np.sqrt(2 * HEIGHT * G)


def thrown(system, x, phi, mu=0.2, ts=(0.0, UNTIL), **options) -> HybridTrajectory:
    """A ball thrown from a height with given x and φ velocities and friction."""
    q0, v0 = {"x": 0.0, "y": R + HEIGHT, "phi": 0.0}, {"x": x, "y": 0.0, "phi": phi}
    return in_phases(system, q0, v0, PARAMS | {"mu": mu}, ts=np.array(ts), **options)


def thrown_exactly(x, phi, mu):
    """The final position and angle of the ball, in closed form."""
    (u, _, spin), _ = after(x, -SPEED, phi, mu=mu)
    return np.array([x * FALL + u * (UNTIL - FALL), phi * FALL + spin * (UNTIL - FALL)])


@pytest.mark.exhaustive
def test_thrown_on_a_floor():
    """Position after the impact, impulse, and derivatives in both modes, for lanes that slide and that stick."""
    members = np.array([[9.0, 1.0, 0.2], [1.0, 1.0, 0.2], [-9.0, 4.0, 0.1]])

    def ends(given):
        q = thrown(hopping, *given, estimate_error=False).q
        return jnp.stack([q["x"][-1], q["phi"][-1]])

    exactly = lambda given: np.stack([thrown_exactly(*row) for row in given])
    np.testing.assert_allclose(jax.jit(jax.vmap(ends))(members), exactly(members), rtol=1e-10)
    slopes = [(exactly(members + off) - exactly(members - off)) / 2e-5 for off in 1e-5 * np.eye(3)]
    assert slopes[2][0, 0] != 0 and slopes[2][1, 0] == 0
    for mode in (jax.jacfwd, jax.jacrev):
        found = jax.jit(jax.vmap(mode(ends)))(members)
        np.testing.assert_allclose(found, np.stack(slopes, axis=-1), rtol=1e-8, atol=1e-8)
    impulse, normal = thrown(hopping, 9.0, 1.0).switches.impulse, 2.0 * 1.5 * SPEED
    found = [impulse[name][0] for name in ("x", "y", "phi")]
    np.testing.assert_allclose(found, normal * np.array([-0.2, 1.0, -0.2 * R]), rtol=1e-10)


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
        lj.Switch("slides", to="rolls", when=lj.guards.sticks(sliding)),
        lj.Switch("rolls", to="slides", when=lj.guards.slips("grip", on="floor", coefficient=coefficient, side=-1)),
    ],
    most_switches=4,
)


@pytest.mark.exhaustive
def test_it_lands_sliding_or_rolling():
    """A ball that sticks at the impact rolls at once, one that slides rolls later."""
    # Sliding at 9 + R decreases at the rate 3.5 μ g; the impact takes off 3.5 μ times the speed of the fall.
    for x, phases, times in (
        (1.0, ["flying", "rolls", "rolls"], [FALL, FALL]),
        (9.0, ["flying", "slides", "rolls"], [FALL, (9.0 + R) / (3.5 * 0.2 * G)]),
    ):
        traj = thrown(landing, x, 1.0, ts=(0.0, UNTIL, 3.0))
        assert list(traj.named_phases()) == phases
        np.testing.assert_allclose(traj.switches.t[:2], times, rtol=1e-9)
        np.testing.assert_allclose(traj.v["x"][-1], (5 * x - 2 * R) / 7, rtol=1e-9)


def after_impact(guard, system, *state):
    """The velocities after an impact."""
    return guard.reset.between(system, system)(0.0, *state)


def test_what_holds_goes_by_any_name():
    """A bead stays on its wire and halves its speed, whether the constraint's name sorts before the gap's or after."""

    @by_numpy
    def both(q, v, p):
        wires = [on_wire(name) for name in ("a wire", "wire")]
        return jnp.stack([after_impact(wire.switches[0].when, *wire.systems, q, v, p) for wire in wires])

    found = both(np.zeros(2), np.array([-8.0, -4.0]), {"mu": 0.1})
    np.testing.assert_allclose(found, [[4.0, 2.0]] * 2, rtol=1e-13)


def test_said_by_name():
    """Invalid friction is refused by name."""
    for restitution, friction, slides, kind, said in (
        (0.5, 0.2, None, ValueError, "friction is given, but sliding is not"),
        (0.5, None, sliding, ValueError, "sliding is given, but friction is not"),
        (None, 0.2, sliding, ValueError, "(?s)needs a restitution.*restitution=0.0"),
        (0.5, 0.2, 1.0, TypeError, "sliding must be a function"),
    ):
        with pytest.raises(kind, match=said):
            lj.guards.touches(above, restitution, friction, slides)  # pyright: ignore
    q, v = {"x": 0.0, "y": R, "phi": 0.0}, {"x": 1.0, "y": -1.0, "phi": 0.0}
    for wrong, said in (
        (lambda t, q, v, p: jnp.stack([v["x"], v["y"]]), r"one number, and returned shape \(2,\)"),
        (lambda t, q, v, p: jnp.abs(v["x"]), "linear in v, but its slope depends on v"),
    ):
        guard = lj.guards.touches(above, 0.5, friction=0.2, sliding=wrong)
        with pytest.raises(ValueError, match=said):
            jax.eval_shape(partial(after_impact, guard, flying), q, v, PARAMS)
