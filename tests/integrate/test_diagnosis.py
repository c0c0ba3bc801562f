"""Messages when `max_steps` is used up or steps collapse: each cause by its own words, and none by another's.

A guard that cannot be followed, or that stops a motion, is named, with the number that shows why; and soon.
"""

import re
import warnings
from types import SimpleNamespace

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import Snapshot
from lagjax.integrate.diagnosis import Steps, _fast, _rounded_up, _singularity, stopped_early
from tests.by_hand import by_hand
from tests.systems import PARAMS, pendulum


def free(t, q, v, params):
    """A particle on a line."""
    return 0.5 * v**2


def spring(t, q, v, params):
    """A particle on a spring."""
    return 0.5 * v**2 - 0.5 * q**2


def stiff_rod(t, q, v, params):
    """A pendulum whose rod is a spring of 1e8."""
    length = jnp.sqrt(q["x"] ** 2 + q["y"] ** 2)
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 9.81 * q["y"] - 0.5e8 * (length - 1.0) ** 2


def force(function, lagrangian=free):
    """A system with a force."""
    return lj.System(lagrangian, force=function)


KINDS = {
    "friction": ("with sign of v in the force", 'jumps="found"'),
    "switched": ("with t in the force", 'jumps="found"'),
    "stop": ("with max of q in the Lagrangian", 'jumps="found"'),
    "singularity": ("a singularity of the motion: .* grows without bound as t -> 1.1107", "ts that end before 1.1107"),
    "stiff": ("a stiff system", r"method=lj.Radau5\(\), whose"),
    "spring": ("a stiff spring", r"a constraint in place.*Radau5\(step_powers=\(0, 1\)\)"),
    "span": ("an oscillation of period 2", r"a looser rtol and atol; else max_steps=\d+"),
}
CASES = {
    "dry friction that sticks": (
        force(lambda t, q, v, params: -2 * jnp.sign(v - 0.5)), (0.0, 1.0), 10.0, {"friction"}),
    "a force that is switched": (
        force(lambda t, q, v, params: jnp.sign(jnp.sin(300 * t)), spring), (0.0, 1.0), 10.0, {"switched"}),
    "an end stop": (
        lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2 - 1e4 * jnp.maximum(-q, 0.0) ** 2), (1.0, 0.0), 400.0,
        {"stop"}),
    "a collision": (lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q), (1.0, 0.0), 2.0, {"singularity"}),
    "strong damping": (
        lj.System(spring, dissipation=lambda t, q, v, params: 0.5e6 * v**2), (1.0, 0.0), 10.0, {"stiff"}),
    "a stiff spring": (
        lj.System(stiff_rod), ({"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}), 10.0, {"spring"}),
    "many periods": (pendulum, (1.0, 0.0), 3000.0, {"span"}),
    # Twins: what is smooth, does not decay, or stays away from its singularity gets another message.
    "friction with a slope": (
        force(lambda t, q, v, params: -2 * jnp.tanh((v - 0.5) / 0.5) - jnp.sin(4 * q)), (0.0, 1.0), 3000.0, set()),
    "a repulsion": (lj.System(lambda t, q, v, params: 0.5 * v**2 - 1 / q - 0.5 * q**2), (1.0, -3.0), 3000.0, set()),
}  # fmt: skip


GEOMETRIC = 0.5 ** np.arange(10.0)


def stepped(h, rejected=0, left=100.0):
    """Steps of these lengths from t = 0, after some rejected ones of the first length, of a motion with q = v = t."""
    h, accepted = np.append(np.full(rejected, h[0]), h), np.arange(len(h) + rejected) >= rejected
    t = np.cumsum(h * accepted) - h * accepted
    return Steps(t, [*zip(t, t)], h, accepted, left)


def along(velocity, rates=(), usual=(1.0, 1.0)):
    """A path with these velocities and accelerations at each time, and eigenvalues."""
    return SimpleNamespace(
        names=["q", "r"], in_dict=False, usual=usual, velocity=lambda y: np.array([0.0, velocity(y[0])]),
        at=lambda t, y, s: np.zeros(2), rates=lambda t, y: np.array(rates),
    )  # fmt: skip


def test_how_many_steps_are_missing():
    """By the progress of the last steps, rejected ones counted; advice in two digits, rounded up."""
    steps = stepped(np.full(30, 0.5), rejected=10, left=60.0)
    assert steps.rate == 15.0 / 40 and steps.missing == 40 + 60.0 / steps.rate
    np.testing.assert_array_equal(steps.kept, np.arange(11, 40))
    # Of many steps the first, which only find their length, do not count.
    assert stepped(np.append(np.full(40, 1e-9), np.full(120, 0.5))).rate == 0.5
    assert [_rounded_up(n) for n in (7, 123, 120, 4567.0)] == [7, 130, 120, 4600]


def test_a_singularity_by_its_numbers():
    """A velocity that grows while steps shrink, toward the limit of their series; twins: steady, or long steps."""
    to_two = along(lambda t: 1 / (2 - t))
    cause, fix = _singularity(to_two, stepped(GEOMETRIC), None) or ("", "")
    assert "the velocity of 'r' grows without bound as t -> 2;" in cause and "ts that end before 2" in fix
    assert _singularity(along(lambda t: 1.0), stepped(GEOMETRIC), None) is None
    assert _singularity(along(lambda t: np.exp(t)), stepped(np.full(20, 0.1)), None) is None
    cause, _ = _singularity(along(lambda t: 1e5 * t), stepped(np.full(100, 0.01)), None) or ("", "")
    assert "it is 9.9e+04 already, where the start and the way so far have 1" in cause


RATES = {
    "a stiff system: something decays at a rate of 8": ((-8.0, -1.0), False),
    "a motion that grows at a rate of 9": ((9.0, 1.0), False),
    "an oscillation of period 1.26, of which 80 are left": ((5j, -5j), False),
    "80 are left: a stiff spring, or another high frequency": ((5j, -5j, 0.1j, -0.1j), False),
    "": ((-8.0, -1.0), True),
    "nothing": ((0.1j, -0.1j), False),
}


@pytest.mark.parametrize("words", RATES)
def test_what_is_fast_by_its_eigenvalues(words):
    """Decay, growth and oscillations are told apart; decay does not limit an implicit method, nor what is slow."""
    rates, implicit = RATES[words]
    found = _fast(along(lambda t: 1.0, rates), stepped(np.full(20, 0.5)), implicit)
    assert found is None if words in ("", "nothing") else words in found[0], found


IN_SLOW = "a collision", "strong damping", "a repulsion"


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.slow if case in IN_SLOW else pytest.mark.exhaustive) for case in CASES],
)
def test_each_cause_is_told_apart(case):
    """The message has the words of the right cause with its remedy, and of no other."""
    system, start, span, kinds = CASES[case]
    params = PARAMS if system is pendulum else None
    limit = 90 if case == "a collision" else 500
    with pytest.raises(RuntimeError, match=f"max_steps = {limit} is used up") as raised:
        lj.integrate(system, *start, params, ts=np.array([0.0, span]), max_steps=limit, jumps="ignored")
    said = str(raised.value)
    found = {kind for kind, words in KINDS.items() if re.search(words[0], said)}
    assert found - {"span"} == kinds - {"span"}, said
    assert all(re.search(KINDS[kind][1], said) for kind in kinds), said


def test_a_short_fixed_step():
    """It is said where a motion stopped; the number of fixed steps that it needs is known: 10,000 of 0.01."""
    ts, fixed = np.array([0.0, 100.0]), {"controller": diffrax.ConstantStepSize(), "method": None, "dt0": 0.01}
    end = Snapshot(*map(np.asarray, (2.0, 2.0, 1.0)), {})
    used_up = lj.RESULTS.max_steps_reached
    stopped = by_hand(lj.System(free), ts, ts, 0 * ts + 1, end=end, result=used_up, steps=200)
    said = stopped_early(stopped, SimpleNamespace(max_steps=200, **fixed), "")
    assert "stopped at t = 2, 2 % of the way to 100, after 200 accepted and 0 rejected steps" in said
    assert "max_steps = 200 is used up. The last state is (q = 2), v = (q = 1)." in said
    assert re.search(r"it needs 9.8e\+03 more.\nFix: max_steps=15000, or longer steps", said), said


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
