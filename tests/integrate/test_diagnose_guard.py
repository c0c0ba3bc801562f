"""A guard that cannot be followed, or that stops a motion, is named, with the number that shows why; and soon."""

import warnings

import jax.numpy as jnp
import pytest

import lagjax as lj

FREE = lj.System(lambda t, q, v, p: 0.5 * v**2)
ROOT = lambda t, q, v, p: jnp.sqrt(3.0 - q)
NASTY = {
    "root": (ROOT, "is nan at t = 10, where q"),
    "pole": (lambda t, q, v, p: jnp.where(q > 9.0, jnp.inf, 1 / (q - 20.0)), "is inf at t = 10"),
    "noise": (lambda t, q, v, p: 0.5 + jnp.sin(1e17 * q), "where t, q and v change in their last digit"),
    "fast": (lambda t, q, v, p: jnp.sin(1e6 * q), r"changes at a rate of 1e\+06 at t = .*, by its size within"),
    "conserved": (lambda t, q, v, p: v**2 - 1.0, "is zero within round-off all along, at most 0"),
    "infinitely often": (lambda t, q, v, p: jnp.sin(1 / (3.0 - q)), "changes too fast between steps"),
}
TAME = lj.Crossing(lambda t, q, v, p: q - 5.0, terminal=False)
TS = jnp.array([0.0, 10.0])


def moved(events, **options):
    """The free motion q = t until 10."""
    return lj.integrate(FREE, 0.0, 1.0, ts=TS, events=events, **options)


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow if x == "pole" else pytest.mark.exhaustive) for x in NASTY]
)
def test_it_is_named_with_a_number(name):
    """The motion arrives in less than 2000 rejected steps; twin: a tame guard beside it is not named."""
    guard, number = NASTY[name]
    nasty = lj.Crossing(guard, terminal=False, most=64)
    with pytest.warns(lj.EventWarning, match=f"event '{name}' may be missing: its guard .*{number}") as said:
        motion = moved({name: nasty, "tame": TAME})
    assert len(said) == 1 and "'tame'" not in str(said[0].message)
    assert float(motion.q[-1]) == 10.0 and int(motion.stats["num_rejected_steps"]) < 2000
    assert abs(float(motion.events["tame"].t[0]) - 5.0) < 1e-13


@pytest.mark.exhaustive
def test_it_is_named_where_it_uses_up_the_steps():
    """NaN throughout, 293 of 300 steps rejected; twin: with a tame guard the same advice concerns the motion alone."""
    with pytest.raises(
        RuntimeError, match=r"97.7 % of the steps were .* goes on with 0 %. The guard of event 'bad' is"
    ):
        moved({"bad": lj.Crossing(lambda t, q, v, p: jnp.nan * q, terminal=False), "tame": TAME}, max_steps=300)
    with pytest.raises(RuntimeError) as raised:
        moved({"tame": TAME}, max_steps=5, max_step=0.1)
    assert "guard" not in str(raised.value) and "max_steps=" in str(raised.value)


def two_phases(guard):
    """A motion that reflects where the guard crosses."""
    switch = lj.Switch("out", to="back", when=guard, reset=lambda t, q, v, p: -v)
    return lj.Hybrid({"out": FREE, "back": FREE}, [switch])


@pytest.mark.exhaustive
def test_a_switch_is_named():
    """A root that becomes NaN in place of crossing, and a fall to -inf; twin: the line without the root, q(10) = -4."""
    with pytest.warns(
        lj.EventWarning, match=r"the switch 'out' -> 'back', with a reset may be missing: its guard is nan"
    ):
        lj.integrate(two_phases(ROOT), 0.0, 1.0, ts=TS)
    with pytest.raises(RuntimeError, match=r"found: that of 'out' -> 'back', with a reset is -inf, and 1 at the start"):
        lj.integrate(two_phases(lambda t, q, v, p: jnp.where(q < 3.0, 1.0, -jnp.inf)), 0.0, 1.0, ts=TS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = lj.integrate(two_phases(lambda t, q, v, p: 3.0 - q), 0.0, 1.0, ts=TS)
    assert abs(float(motion.q[-1]) + 4.0) < 1e-12


@pytest.mark.exhaustive
def test_an_end_that_only_the_second_motion_sees():
    """A guard that crosses and comes back within one step is named; no error of the motion is invented.

    Twin: with max_step, as advised, the first crossing ends the motion, at 3 - 1 / (k π) with k = 1.
    """
    events = {"end": lj.Crossing(lambda t, q, v, p: (3.0 - q) * jnp.sin(1 / (3.0 - q)))}
    with pytest.warns(lj.EventWarning, match=r"ended at an event that this one did not see \('end'\)"):
        moved(events)
    end = moved(events, max_step=0.1).end.t
    assert abs(float(end) - (3 - 1 / jnp.pi)) < 1e-12
