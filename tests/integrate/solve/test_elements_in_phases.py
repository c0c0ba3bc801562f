"""Elements in phases of a hybrid: contacts, friction and sampled controls that are there in some phases only."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

pytestmark = pytest.mark.slow

ROUGH, G = 0.2 * 10.0, 10.0


def kinetic(t, q, v, p):
    """A mass of one."""
    return 0.5 * v**2


rough = lj.System(kinetic, elements={"rub": lj.Friction(lambda t, q, v, p: v, 0.2, normal=10.0)})
beyond = lambda t, q, v, p: p - q
onto_ice = lj.Hybrid({"rough": rough, "ice": lj.System(kinetic)}, [lj.Switch("rough", to="ice", when=beyond)])
off_ice = lj.Hybrid({"ice": lj.System(kinetic), "rough": rough}, [lj.Switch("ice", to="rough", when=beyond)])


@pytest.mark.exhaustive
def test_a_block_that_leaves_friction():
    """It is braked by 2 until 0.5, and then goes on as fast as it is there. Twin: friction stays."""
    ts = np.array([0.0, 0.1, 2.0])
    traj: Any = lj.integrate(onto_ice, 0.0, 3.0, 0.5, ts=ts)
    fast = np.sqrt(9 - 2 * ROUGH * 0.5)
    leaves = (3 - fast) / ROUGH
    np.testing.assert_allclose(traj.q, [0.0, 0.3 - 0.01, 0.5 + fast * (2 - leaves)], rtol=1e-13)
    np.testing.assert_allclose(traj.multipliers["rub"], [-ROUGH, -ROUGH, np.nan])
    np.testing.assert_array_equal(traj.modes, [[1], [1], [-1]])
    assert abs(lj.integrate(rough, 0.0, 3.0, 0.5, ts=ts).q[-1] - traj.q[-1]) > 1


def test_a_block_that_enters_friction():
    """It slides from 0.5 on, and sticks at 0.5 + v²/4; between outputs, in derivatives and in the ledger too."""
    ts = np.array([0.0, 0.1, 2.0])
    traj: Any = lj.integrate(off_ice, 0.0, 2.0, 0.5, ts=ts)
    np.testing.assert_allclose(traj.q, [0.0, 0.2, 1.5], rtol=1e-13)
    np.testing.assert_allclose(np.asarray(traj.switches.t)[:2], [0.25, 1.25], rtol=1e-13)
    np.testing.assert_array_equal(traj.modes, [[-1], [-1], [2]])
    np.testing.assert_allclose(traj.at(np.array([0.2, 0.65])).q, [0.4, 0.5 + 0.8 - 0.16], rtol=1e-12)
    ledger = lj.energy_ledger(traj)
    assert ledger.closes and abs(ledger.elements["rub"].total[-1] + 2) < 1e-12
    assert "ice -> rough" in repr(traj) and "rub sticks" in repr(traj)

    def end(v):
        return lj.integrate(off_ice, 0.0, v, 0.5, ts=ts, estimate_error=False).q[-1]

    np.testing.assert_allclose([jax.grad(end)(2.0), jax.jvp(end, (2.0,), (1.0,))[1]], 1.0, rtol=1e-12)


def dropped(t, q, v, p):
    """A ball that also moves sideways."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"]


def ground(e):
    """A floor."""
    return lj.Contact(lambda t, q, p: q["y"], e)


two_floors = lj.Hybrid(
    {
        "left": lj.System(dropped, elements={"soft": ground(0.5)}),
        "right": lj.System(dropped, elements={"hard": ground(1.0)}),
    },
    [lj.Switch("left", to="right", when=lambda t, q, v, p: p - q["x"])],
)


def height(t, h, d):
    """The height at t of a ball dropped at h, with a restitution of one half before d and one after it."""
    now, y, v = 0.0, h, 0.0
    while True:
        hits = now + (v + np.sqrt(v * v + 2 * G * y)) / G
        if hits > t:
            return y + v * (t - now) - G / 2 * (t - now) ** 2
        now, y, v = hits, 0.0, (0.5 if hits < d else 1.0) * (G * (hits - now) - v)


def test_two_floors():
    """Each phase has its own contact; in lanes that pass at different times, by number of the first phase too."""
    ts = np.array([0.0, 0.7, 1.5, 2.27])

    @jax.vmap
    def run(d, start):
        given = {"x": 0.0, "y": 0.8}, {"x": 1.0, "y": 0.0}
        return lj.integrate(two_floors, *given, d, ts=ts, start=start, throw=False, estimate_error=False)

    d, start = np.array([0.2, 0.9, 1.05, 1.05]), np.array([0, 0, 0, 1])
    found: Any = run(d, start)
    right = [[height(t, 0.8, x) for t in ts] for x in (*d[:3], 0.0)]
    np.testing.assert_allclose(found.q["y"], right, atol=1e-11)
    np.testing.assert_array_equal(found.phase[:, 1], [1, 0, 0, 1])
    assert abs(height(2.27, 0.8, 0.9) - height(2.27, 0.8, 0.2)) > 0.1


def plant(gain, every):
    """A mass whose speed is measured and braked."""
    control = lj.SampledControl(lambda t, q, v, p: -gain * v["x"], every=every)
    push = lambda t, q, v, p: {"x": q["u"], "u": 0.0}
    return lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2, force=push, elements={"u": control})


two_controls = lj.Hybrid(
    {"slow": plant(0.5, 0.5), "fast": plant(2.0, 0.125)},
    [lj.Switch("slow", to="fast", when=lambda t, q, v, p: p - q["x"])],
)


@pytest.mark.exhaustive
def test_sampled_controls_of_two_phases():
    """The output is held through the switch, until the next instant of the other control. Twin: at a later switch."""

    def exact(T, d):
        t, x, v, u = 0.0, 0.0, 2.0, -1.0
        while True:
            # The first instant acts at the start; the slow control has instants at halves.
            until = np.floor(t / 0.5 + 1e-12) * 0.5 + 0.5
            s = (-v + np.sqrt(v**2 + 2 * u * (d - x))) / u
            if t + s < until:
                break
            t, x, v = until, x + v * (until - t) + u / 2 * (until - t) ** 2, v + u * (until - t)
            u = -0.5 * v
        t, x, v = t + s, d, v + u * s
        while t < T:
            until = min((np.floor(t / 0.125 + 1e-12) + 1) * 0.125, T)
            t, x, v = until, x + v * (until - t) + u / 2 * (until - t) ** 2, v + u * (until - t)
            u = -2.0 * v
        return x

    def end(d):
        return lj.integrate(two_controls, {"x": 0.0, "u": 0.0}, {"x": 2.0}, d, ts=np.array([0.0, 1.5])).q["x"][-1]

    np.testing.assert_allclose([end(1.1), end(0.55)], [exact(1.5, 1.1), exact(1.5, 0.55)], rtol=1e-13)
    assert abs(exact(1.5, 1.1) - exact(1.5, 0.55)) > 0.1


block = lj.System(
    dropped,
    elements={"floor": lj.Contact(lambda t, q, p: q["y"], 0.0, friction=0.3, sliding=lambda t, q, v, p: v["x"])},
)
kicked = lj.Hybrid(
    {"before": block, "after": block},
    [
        lj.Switch(
            "before", to="after", when=lambda t, q, v, p: 0.5 - t,
            reset=lambda t, q, v, p: {"x": v["x"] + 1.5, "y": v["y"] + p},
        )  # fmt: skip
    ],
)  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize(("up", "way"), [(0.0, 1.5**2 / 6), (2.0, 0.6 + 0.9**2 / 6)])
def test_a_kick_of_a_block_that_rests(up, way):
    """A reset on a closed contact: it slides at once; or flies for 2 up/g, and is slowed by μ up as it lands."""
    at_rest = {"x": 0.0, "y": 0.0}
    traj: Any = lj.integrate(kicked, at_rest, at_rest, up, ts=np.array([0.0, 0.4, 0.6, 3.0]))
    np.testing.assert_allclose(traj.q["x"], [0.0, 0.0, 0.15 - 0.015 * (up == 0), way], rtol=1e-12)
    np.testing.assert_array_equal(traj.modes[1:3, 2], [-1, int(up == 0)])


@pytest.mark.exhaustive
def test_derivatives_through_two_floors():
    """By the height of the drop, by difference quotients of the closed form; the place of the switch does not count."""

    def end(h, d):
        given = {"x": 0.0, "y": h}, {"x": 1.0, "y": 0.0}
        return lj.integrate(two_floors, *given, d, ts=np.array([0.0, 2.27]), estimate_error=False).q["y"][-1]

    quotient = (height(2.27, 0.8 + 1e-6, 1.05) - height(2.27, 0.8 - 1e-6, 1.05)) / 2e-6
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(end, (0, 1))(0.8, 1.05), [quotient, 0.0], atol=1e-7)


@pytest.mark.exhaustive
def test_kept_and_said(tmp_path):
    """A file, a table and an explanation know the elements of phases; a coefficient below zero is refused by name."""
    at_rest = {"x": 0.0, "y": 0.0}
    traj: Any = lj.integrate(kicked, at_rest, at_rest, 2.0, ts=np.array([0.0, 0.4, 3.0]))
    traj.save(tmp_path / "kick")
    again = lj.load_trajectory(tmp_path / "kick", system=kicked)
    np.testing.assert_array_equal(again.at(0.7).q["x"], traj.at(0.7).q["x"])
    assert list(traj.to_xarray()["mode"].values) == [
        f"{phase}: floor{of}" for phase in ("before", "after") for of in ("", " friction")
    ]
    assert "floor closed" in repr(lj.explain(kicked, 0.0, at_rest, at_rest, 2.0).phases["after"])
    rub = lj.Contact(lambda t, q, p: q["y"], friction=lambda p: p, sliding=lambda t, q, v, p: v["x"])
    later = lj.Hybrid(
        {"free": lj.System(dropped), "rubs": lj.System(dropped, elements={"floor": rub})},
        [lj.Switch("free", to="rubs", when=lambda t, q, v, p: 0.2 - t)],
    )
    with pytest.raises(ValueError, match="the coefficient of 'floor friction' is -0.1"):
        lj.integrate(later, {"x": 0.0, "y": 1.0}, at_rest, -0.1, ts=jnp.array([0.0, 0.1]))


@pytest.mark.exhaustive
def test_a_cycle_of_both():
    """A ball bounces without loss, in a field of 20 above 1 and of 10 below: the period is that of the four flights."""
    low = lj.System(
        lambda t, q, v, p: kinetic(t, q, v, p) - p * q, elements={"floor": lj.Contact(lambda t, q, p: q, 1.0)}
    )
    high = lj.System(lambda t, q, v, p: kinetic(t, q, v, p) - 2 * p * q)
    ways = [
        lj.Switch("high", to="low", when=lambda t, q, v, p: q - 1),
        lj.Switch("low", to="high", when=lambda t, q, v, p: 1 - q),
    ]
    orbit = lj.periodic_orbit(lj.Hybrid({"high": high, "low": low}, ways), (1.5, 0.0), 0.83, G, hold="q")
    fast = np.sqrt(2 * 2 * G * (orbit.q - 1) + orbit.v**2)
    flights = fast / (2 * G) + (np.sqrt(fast**2 + 2 * G) - fast) / G
    np.testing.assert_allclose(orbit.period, 2 * flights, rtol=1e-9)
    assert len(orbit.switches) == 3
