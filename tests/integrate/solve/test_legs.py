"""What one loop of legs lets stand side by side: jumps of forces and elements, phases, sampled controls."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.elements.test_motions import moved

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error::lagjax.JumpWarning")]

G, E, T = 10.0, 0.5, 0.8


def falling(t, q, v, p):
    """A mass of one."""
    return 0.5 * v**2 - G * q


def downdraft(t, q, v, p):
    """A push of p["a"] downward above p["H"]."""
    return jnp.where(q > p["H"], -p["a"], 0.0)


floor = {"floor": lj.Contact(lambda t, q, p: q, restitution=E)}
in_elements = lj.System(falling, force=downdraft, elements=floor)
bounce = lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, p: q, E))
in_a_phase = lj.Hybrid({"flying": lj.System(falling, force=downdraft)}, [bounce], most_switches=3)


def bounced(h, H, a):
    """The height at T of a ball dropped at h, after one bounce that stays below H."""
    v1 = jnp.sqrt(2 * (G + a) * (h - H))
    v2 = jnp.sqrt(v1**2 + 2 * G * H)
    s = T - v1 / (G + a) - (v2 - v1) / G
    return E * v2 * s - G / 2 * s**2


@pytest.mark.parametrize("system", [in_elements, in_a_phase], ids=["contact", "phase"])
def test_a_bounce_through_a_downdraft(system):
    """A ball that falls out of a downdraft onto a floor; one jump is followed. Twin: in another it ends elsewhere."""
    p = {"H": np.array(0.5), "a": np.array(2.0)}
    traj: Any = lj.integrate(system, 1.0, 0.0, p, ts=np.array([0.0, 0.3, T]))
    np.testing.assert_allclose(traj.q[-1], bounced(1.0, 0.5, 2.0), rtol=1e-13)
    assert len(traj.switches) == 1 and traj.stats["num_jumps"] == 1
    assert abs(traj.q[-1] - bounced(1.0, 0.5, 2.1)) > 1e-4


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("system", [in_elements, in_a_phase], ids=["contact", "phase"])
def test_derivatives_of_both(system, mode):
    """By the place and the size of the jump and by the height, through the bounce; also in lanes."""

    def height(h, H, a):
        ts = np.array([0.0, T])
        return lj.integrate(system, h, 0.0, {"H": H, "a": a}, ts=ts, estimate_error=False, throw=False).q[-1]

    found, right = (mode(f, (0, 1, 2))(1.0, 0.5, 2.0) for f in (height, bounced))
    np.testing.assert_allclose(found, right, rtol=1e-10)
    lanes = np.array([1.0, 1.05, 0.95])
    found: Any = jax.vmap(height, (0, None, None))(lanes, 0.5, 2.0)
    np.testing.assert_allclose(found, bounced(lanes, 0.5, 2.0), rtol=1e-12)


@pytest.mark.parametrize("system", [in_elements, in_a_phase], ids=["contact", "phase"])
def test_lanes_that_are_not_in_step(system):
    """One lane has a jump and then a bounce, while the other bounces twice: each has its own switches."""
    p, ts = {"H": np.array(0.5), "a": np.array(2.0)}, np.array([0.0, 0.7])
    run = jax.vmap(lambda h: lj.integrate(system, h, 0.0, p, ts=ts, estimate_error=False, throw=False))
    found: Any = run(np.array([1.0, 0.45]))
    v1 = np.sqrt(2 * (G + 2.0) * 0.5)
    v2 = np.sqrt([v1**2 + 2 * G * 0.5, 2 * G * 0.45])
    first, second = v1 / (G + 2.0) + (v2[0] - v1) / G, v2[1] / G
    np.testing.assert_array_equal(found.switches.count, [1, 2])
    np.testing.assert_array_equal(found.stats["num_jumps"], [1, 0])
    np.testing.assert_allclose(found.switches.t[:, :2], [[first, np.nan], [second, 2 * second]], rtol=1e-12)
    s, up = np.array([0.7 - first, 0.7 - 2 * second]), [E * v2[0], E**2 * v2[1]]
    np.testing.assert_allclose(found.q[:, -1], up * s - G / 2 * s**2, rtol=1e-11)


@pytest.mark.exhaustive
def test_friction_over_a_jump():
    """A block is braked by friction 2, and from 0.3 on pushed by 1: it stops after 0.3 + 2.8/2. Twin: a push of 1.1."""
    rub = {"rub": lj.Friction(lambda t, q, v, p: v, 0.2, normal=10.0)}
    kinetic = lambda t, q, v, p: 0.5 * v**2
    system = lj.System(kinetic, force=lambda t, q, v, p: jnp.where(q > 0.3, p, 0.0), elements=rub)
    ts = np.array([0.0, 0.2, 2.5])
    stops = [moved(system, 0.0, 2.0, push, ts=ts).q[-1] for push in (1.0, 1.1)]
    np.testing.assert_allclose(stops, [0.3 + 1.4, 0.3 + 1.4 / 0.9], rtol=1e-13)


def test_pulses_and_jumps_in_two_phases():
    """Fields of -1 above zero, with a pulse of 1 from 0.3 to 0.4, and of 2 below, of 5 below -0.2: up and down again.

    Each phase has its own jumps, which are found again where it begins.
    """
    above = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - q, force=lambda t, q, v, p: jnp.where((t > 0.3) & (t < 0.4), 1.0, 0.0)
    )
    below = lj.System(lambda t, q, v, p: 0.5 * v**2 + 2 * q, force=lambda t, q, v, p: jnp.where(q < -0.2, 3.0, 0.0))
    leaves = [
        lj.Switch("above", to="below", when=lambda t, q, v, p: q),
        lj.Switch("below", to="above", when=lambda t, q, v, p: -q),
    ]
    system = lj.Hybrid({"above": above, "below": below}, leaves, most_switches=4)
    traj: Any = lj.integrate(system, 1.0, 0.0, ts=np.array([0.0, 1.0, 3.0]))
    # It coasts for 0.1 at -0.3, falls to zero, to -0.2, turns, and comes back as fast.
    v0 = np.sqrt(0.3**2 + 2 * (1 - 0.3**2 / 2 - 0.03))
    v1 = np.sqrt(v0**2 - 2 * 2 * 0.2)
    down = 0.4 + v0 - 0.3
    up = down + 2 * ((v0 - v1) / 2 + v1 / 5)
    np.testing.assert_allclose(np.asarray(traj.switches.t)[:2], [down, up], rtol=1e-13)
    np.testing.assert_allclose(traj.q[-1], v0 * (3 - up) - (3 - up) ** 2 / 2, rtol=1e-12)
    assert traj.stats["num_jumps"] == 2


@pytest.mark.exhaustive
def test_a_sampled_control_over_a_jump():
    """A control holds x' for 0.5 at a time, u = -x', and beyond 0.6 the ground pushes by 1."""
    brake = lj.SampledControl(lambda t, q, v, p: -v["x"], every=0.5)
    force = lambda t, q, v, p: {"x": q["u"] + jnp.where(q["x"] > 0.6, 1.0, 0.0), "u": 0.0}
    system = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2, force=force, elements={"u": brake})
    traj = moved(system, {"x": 0.0, "u": 0.0}, {"x": 1.0, "u": 0.0}, None, ts=np.array([0.0, 0.5, 0.9]))
    # From 0.5 on v = 0.5 and u = -0.5, from x = 0.375; at 0.6 the speed is √(0.25 - 0.225).
    v = np.sqrt(0.25 - 0.225)
    s = 0.4 - (0.5 - v) / 0.5
    x = 0.6 + v * s + 0.25 * s**2 if s > 0 else 0.375 + 0.5 * 0.4 - 0.25 * 0.4**2
    np.testing.assert_allclose(traj.q["x"], [0.0, 0.375, x], atol=1e-13)


@pytest.mark.exhaustive
def test_what_could_slide_beside_springs_is_said():
    """Friction written with the sign of a velocity, beside a spring among the elements: the motion is that of the
    comparison as it is, and this is said."""
    mat = {"mat": lj.CompliantContact(lambda t, q, p: q["y"], 400.0)}
    energy = lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"]
    force = lambda t, q, v, p: {"x": -jnp.sign(v["x"]), "y": 0.0}
    system = lj.System(energy, force=force, elements=mat)
    with pytest.warns(lj.JumpWarning, match="could slide, beside friction or springs"):
        traj: Any = lj.integrate(system, {"x": 0.0, "y": 1.0}, {"x": 2.0, "y": 0.0}, ts=np.array([0.0, 0.4]))
    np.testing.assert_allclose(traj.q["x"][-1], 2 * 0.4 - 0.08, rtol=1e-9)
