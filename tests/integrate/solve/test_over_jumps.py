"""Motions over the jumps of their forces: closed forms, their derivatives of first and second order, and sliding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

kinetic = lambda t, q, v, params: 0.5 * v**2
# A brake of 3 from q = edge on: with the start at q = 0 and s = t - edge/v0, q = edge + v0 s - 3/2 s².
brake = lj.System(kinetic, force=lambda t, q, v, p: jnp.where(q > p["edge"], -p["by"], 0.0))
ONE = jnp.array([0.0, 1.0])


def braked(v0, edge=1.0, by=3.0, **options):
    """The velocity at t = 1: v0 - by (1 - edge/v0)."""
    return lj.integrate(brake, 0.0, v0, {"edge": edge, "by": by}, ts=ONE, **options).v[-1]


def test_a_brake():
    """The velocity, and twin: a brake of another strength."""
    np.testing.assert_allclose(braked(2.0), 0.5, rtol=1e-13)
    np.testing.assert_allclose(braked(2.0, by=1.0), 1.5, rtol=1e-13)


# A push from one time to another, of a mass on a spring.
pushed = lj.System(
    lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * (q - p["rest"]) ** 2,
    force=lambda t, q, v, p: jnp.where((t > p["lo"]) & (t < p["hi"]), p["F"], 0.0),
)


def push(ts, F, lo, hi, k=0.0, rest=0.0, **options):
    """The motion from rest."""
    params = {"k": k, "rest": rest, "F": F, "lo": lo, "hi": hi}
    return lj.integrate(pushed, rest, 0.0, params, ts=np.array(ts), **options)


def test_a_push_in_time():
    """A push shorter than a step is seen, and followed to round-off in any unit; the error of the motion is small.

    An output a round-off after its end does not stop the second run.
    """
    for unit in (1e-6, 1.0, 1e6):
        traj = push([0.0, 4.0, np.nextafter(4.1, 5.0), 10.0], unit, 4.0, 4.1)
        # The time of a jump is resolved to several round-offs.
        np.testing.assert_allclose(np.asarray(traj.q)[-1] / unit, 0.595, rtol=1e-12)
        assert np.asarray(traj.error.q)[-1] < 1e-12 * unit and float(traj.scaled_error) < 1e-2


@pytest.mark.parametrize("rest", [0.0, 1.0])
def test_at_rest_until_a_force_sets_in(rest):
    """The size of a motion whose force sets in later is unknown at the start: it is computed without a warning."""
    traj = push([0.0, 6.0], 10.0, 5.25, 9.0, k=1.0, rest=rest)
    np.testing.assert_allclose(np.asarray(traj.q)[-1] - rest, 10 * (1 - np.cos(0.75)), rtol=1e-7)


def after_a_wall(v0, **options):
    """The velocity after a spring with a damper that pushes only, which is linear in that before."""
    m, k, c = 0.5, 800.0, 8.0
    force = lambda t, q, v, p: jnp.where(q > 0, -jnp.maximum(k * q + c * v, 0.0), 0.0)
    wall = lj.System(lambda t, q, v, p: 0.5 * m * v**2, force=force)
    return lj.integrate(wall, -0.5, v0, ts=ONE, **options).v[-1]


def after_a_push(lo, hi, **options):
    """Where a push between two times, shorter than a step, has moved a mass."""
    return push([0.0, 10.0], 1.0, lo, hi, **options).q[-1]


def flown(off, **options):
    """Where a rocket is that is switched off."""
    rocket = lj.System(lambda t, q, v, p: v**2, force=lambda t, q, v, p: jnp.where(t < p, 3.0, 0.0))
    return lj.integrate(rocket, 0.0, 0.0, off, ts=FLIGHT, **options).q


FLIGHT = np.array([0.0, 0.5, 0.98, 1.5, 2.0])
velocity = lambda v0, edge, by: v0 - by * (1 - edge / v0)
pushed_by = lambda lo, hi: (hi - lo) * (10.0 - (lo + hi) / 2)
# Functions over a jump, their inputs, and the derivatives by these; and those where jumps are ignored.
SLOPES = {
    "brake": (braked, (2.0, 1.0, 3.0), jax.grad(velocity, argnums=(0, 1, 2)), (1.0, 0.0, None)),
    "wall": (after_a_wall, (2.0,), lambda v0: (after_a_wall(v0) / v0,), (None,)),
    "push": (after_a_push, (4.0, 4.05), jax.grad(pushed_by, argnums=(0, 1)), (0.0, 0.0)),
    "rocket": (flown, (0.98,), lambda off: (1.5 * np.maximum(FLIGHT - 0.98, 0.0),), (0.0,)),
}  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("name", SLOPES)
def test_derivatives_over_jumps(name, mode):
    """Derivatives by all numbers agree with the closed form, in both modes."""
    function, at, right, _ = SLOPES[name]
    for found, expected in zip(mode(function, argnums=tuple(range(len(at))))(*at), right(*at)):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-13)


@pytest.mark.exhaustive
def test_more_derivatives_of_a_brake():
    """In lanes, and the second ones; twin: the first one in another lane."""
    lanes = jnp.array([1.8, 2.0, 2.3])
    found = jax.jit(jax.vmap(jax.grad(braked)))(lanes)
    np.testing.assert_allclose(found, jax.vmap(jax.grad(lambda v: velocity(v, 1.0, 3.0)))(lanes), rtol=1e-9)
    assert abs(found[0] - found[1]) > 0.1
    # 2 by edge/v0³
    np.testing.assert_allclose(jax.grad(jax.grad(braked))(2.0), 0.75, rtol=1e-6)


MASS, SPRING, GRAVITY = 1.0, 100.0, 9.81


@pytest.mark.exhaustive
def test_many_numbers():
    """A gradient by thirty numbers, which replays the steps of each leg; twin: one more number than counted."""
    rubbed = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, force=lambda t, q, v, p: -jnp.sum(p) * jnp.sign(v))
    end = lambda p: lj.integrate(rubbed, 1.0, 0.0, p, ts=jnp.array([0.0, 2.0])).q[-1]
    # Rest at the far turning point of a half swing would be at -1 + 2 p; here q = p - (1 - p) cos t until pi.
    found = jax.grad(end)(jnp.full(30, 0.1 / 30))
    np.testing.assert_allclose(found, 1 - np.cos(2.0), rtol=1e-9)


@pytest.mark.exhaustive
def test_events_and_constraints():
    """Events are recorded over all legs; a bead on a rod with friction comes to rest where friction holds it."""
    rod = lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - 1)
    bead = lj.System(
        lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - GRAVITY * q["y"],
        {"rod": rod},
        force=lambda t, q, v, p: {"x": -0.9 * jnp.sign(v["x"]), "y": 0.0 * v["y"]},
    )
    start = {"x": 0.5, "y": -np.sqrt(0.75)}, {"x": 0.0, "y": 0.0}
    passes = {"low": lj.Crossing(lambda t, q, v, p: q["x"], terminal=False)}
    traj = lj.integrate(bead, *start, ts=[0.0, 1.0, 5.0], events=passes)
    # Friction along x holds the bead where |tan| of its angle is at most 0.9/g.
    assert abs(traj.q["x"][-1] / traj.q["y"][-1]) < 0.9 / GRAVITY and abs(traj.v["x"][-1]) < 1e-12
    assert int(traj.events["low"].count) == 2 and np.all(np.diff(traj.events["low"].found().t) > 0)
    np.testing.assert_allclose(traj.events["low"].found().q["x"], 0.0, atol=1e-9)


@pytest.mark.exhaustive
def test_a_state_on_a_jump_throughout():
    """A guard that stays at zero costs no steps and changes nothing; twin: that the motion is there at all."""
    flat = lj.System(
        lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * q["x"] ** 2,
        force=lambda t, q, v, p: {"x": 0.0 * q["x"], "y": -10 * jnp.maximum(q["y"], 0.0)},
    )
    traj = lj.integrate(flat, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, ts=[0.0, 20.0])
    np.testing.assert_allclose(traj.q["x"][-1], np.cos(20.0), rtol=1e-9)
    assert traj.stats["num_steps"] < 40


@pytest.mark.exhaustive
def test_what_cannot_be_followed_is_said():
    """A comparison in a loop, and more jumps than are followed."""
    loop = lj.System(kinetic, force=lambda t, q, v, p: jax.lax.fori_loop(0, 2, lambda i, x: jnp.where(x > 0, -x, x), q))
    with pytest.warns(lj.JumpWarning, match="a comparison inside a loop"):
        lj.integrate(loop, 1.0, 0.0, ts=[0.0, 1.0])
    ringing = lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, force=lambda t, q, v, p: -0.01 * jnp.where(q > 0, 1.0, 0.3)
    )
    with pytest.warns(lj.JumpWarning, match="after 1000 jumps"):
        traj = lj.integrate(ringing, 1.0, 0.0, ts=[0.0, 4000.0], estimate_error=False)
    assert traj.stats["num_jumps"] == 1000 and np.isfinite(traj.q[-1])
