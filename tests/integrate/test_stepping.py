"""Tolerances from a motion's own size: the same motion in any units, and numbers without a size of their own.

Outputs are ends of steps: they are exact, and cost only the steps that they shorten.

Steps end on the constraints; without projection they drift.
"""

from dataclasses import replace
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.results import message
from lagjax.integrate.stepping import (
    WHOLE_STEPS,
    Forced,
    PerCoordinateTolerance,
    StepToOutputs,
    Tolerances,
    rounding,
    scales_of,
    shared,
    tolerances_at,
)
from tests.by_hand import by_hand, swing
from tests.by_numpy import by_numpy
from tests.systems import HORIZONTAL, PARAMS, TS, driven, motion, pendulum, rod_pendulum

# The units of length and of time are powers of four, so that scaling by them is exact, also in square roots.
UNITS = {"nanometres": (2.0**-30, 1.0), "light years": (2.0**54, 1.0), "years": (1.0, 2.0**-24)}
SPAN = np.linspace(0.0, 20.0, 8)


def on_rod(length=1.0, time=1.0, **options):
    """Swings of a pendulum in Cartesian coordinates, in these units of length and time; x and y in one array."""
    q0, v0 = {"x": length * np.sin(1.25), "y": -length * np.cos(1.25)}, {"x": 0.0, "y": 0.0}
    params = {"g": length / time**2, "l": length}
    traj = lj.integrate(rod_pendulum, q0, v0, params, ts=SPAN * time, **options)
    return traj, [np.stack([*tree.values()]) for tree in (traj.q, traj.v, traj.error.q)]


@pytest.mark.filterwarnings("ignore::lagjax.AccuracyWarning")
def test_any_units():
    """Any units give the same digits and steps."""
    usual, (q, v, error) = on_rod()
    for name, (length, time) in UNITS.items():
        other, (r, u, off) = on_rod(length, time)
        assert int(other.stats["num_steps"]) == int(usual.stats["num_steps"]), name
        np.testing.assert_allclose(r / length, q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(u * time / length, v, rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.max(off) / length, np.max(error), rtol=1e-3)
        assert float(other.scaled_error) < 1e-3


@pytest.mark.parametrize("start", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)], ids=["extent", "speed", "push"])
def test_small_motions(start):
    """Motions of a nanometre by extent, speed or force agree with the closed form to nine digits."""
    (q0, v0, push), t = 1e-9 * np.array(start), np.linspace(0.0, 20.0, 8)
    params = {"m": 1.0, "k": 1.0, "c": 0.0, "pull": push, "rate": 0.0}
    traj = lj.integrate(driven, q0, v0, params, ts=t)
    expected = push + (q0 - push) * np.cos(t) + v0 * np.sin(t)
    np.testing.assert_allclose(traj.q, expected, rtol=0, atol=1e-9 * 1e-9)
    np.testing.assert_allclose(traj.q, expected, rtol=0, atol=5 * float(np.max(traj.error.q)))


def test_given_tolerances_stay():
    """A given atol stays in the user's units; the print tells it from tolerances by size."""
    given, own = by_hand(pendulum, TS, TS, TS, PARAMS), motion("pendulum")
    assert given.tolerance[1].shape == (2,) and own.tolerance[1].shape == (2, 1)
    assert "atol 1e-09" in str(given) and "atol by size" in str(own)
    settings = SimpleNamespace(by_size=False, rtol=np.full(2, 1e-9), atol=np.full(2, 1e-6))
    start = SimpleNamespace(q=np.array([3.0, -4.0]), v=np.array([0.0, 7.0]))
    kept = tolerances_at(start, np.array([0.0, 2.0]), settings)
    assert kept.rtol is settings.rtol and kept.atol is settings.atol
    settings = SimpleNamespace(by_size=True, forced=None, rtol=np.full(2, 1e-9))
    by_size = by_numpy(lambda q, v, ts: tolerances_at(SimpleNamespace(q=q, v=v), ts, settings).atol)
    np.testing.assert_allclose(by_size(start.q, start.v, np.array([0.0, 2.0])), [4e-9, 7e-9])


EVEN = np.ones((2, 2))


@by_numpy
def weighed(size, error, mass, sizes_so_far):
    """The weighed error, (2, 2), of one step of length 1 from and to coordinates and velocities of this size."""
    pid, both = diffrax.PIDController(rtol=1e-9, atol=1e-9), jnp.full(2, 1e-9)
    scales = scales_of(mass, *size, jnp.zeros(2), 1.0)
    largest = jnp.maximum(scales.first, sizes_so_far)
    weighing = PerCoordinateTolerance(pid, Tolerances(both, both), scales._replace(first=largest), (False, False))
    found, _ = weighing._weighed(jnp.asarray(0.0), jnp.asarray(1.0), (*size,), (*size,), (*error,), largest)
    return jnp.stack(found).reshape(2, 2) / (1e-9 * (1 + jnp.abs(size)))


def test_each_by_its_own_size():
    """An error of rtol |y| counts as one whatever |y| is; |y| is at least a thousandth of the largest so far."""
    size = np.array([[1e-12, 1e9], [3e-12, 2e9]])
    np.testing.assert_allclose(weighed(size, 1e-9 * size, np.array([1e18, 1e-24]), 0 * EVEN), 1.0, rtol=1e-2)
    died_out = weighed(1e-6 * EVEN, 1e-12 * EVEN, EVEN[0], EVEN)
    np.testing.assert_allclose(died_out, 1.0, rtol=1e-2)


def test_what_others_round_off():
    """A coordinate at round-off has the others' round-off as its tolerance, scaled by the masses."""
    size, nothing = np.array([[1e3, 1e-16], [1.0, 1e-19]]), 0 * EVEN
    assert np.all(weighed(size, np.array([[0.0, 1e-13], [0.0, 1e-16]]), EVEN[0], nothing) < 1)
    # With 1e12 times the mass, a millionth of the other's motion is as much to it.
    assert weighed(size, np.array([[0.0, 1e-13], [0.0, 0.0]]), np.array([1.0, 1e12]), nothing)[0, 1] > 1


def test_scales_have_units():
    """Scales follow the units of length and time; twin: changing one coordinate's unit does not affect the others."""
    mass, q, v, a = np.array([4.0, 0.25]), np.array([3.0, 0.0]), np.array([0.0, 0.5]), np.array([1.0, 2.0])

    @by_numpy
    def of(mass, q, v, a, span):
        scales = scales_of(mass, q, v, a, span)
        others = shared(scales, scales.first)
        return jax.tree.map(jnp.asarray, (scales.time, scales.first, others, rounding(others)))

    usual, length, time = of(mass, q, v, a, 10.0), 2.0**-20, 2.0**12
    other = of(mass / length**2 * time**2, length * q, length / time * v, length / time**2 * a, 10.0 * time)
    rates = np.array([[length], [length / time]])
    for found, known, unit in zip(other, usual, (time, rates, rates, rates)):
        np.testing.assert_allclose(found, unit * np.asarray(known), rtol=1e-14)
    unit = np.array([1.0, 2.0**20])
    mixed = of(mass / unit**2, unit * q, unit * v, unit * a, 10.0)
    np.testing.assert_allclose(mixed[0], usual[0], rtol=1e-14)
    np.testing.assert_allclose(np.asarray(mixed[2])[:, 0], np.asarray(usual[2])[:, 0], rtol=1e-14)


def test_regular_in_any_units():
    """A mass of a gram on a rod of a light year is not singular; twin: a coordinate without mass is."""
    rod = lj.System(
        lambda t, q, v, p: 0.5 * p["m"] * v @ v - p["m"] * p["g"] * q[1],
        constraints={"rod": lj.Holonomic(lambda t, q, p: q @ q - p["l"] ** 2)},
    )
    q0 = 2.0**54 * np.array([np.sin(1.25), -np.cos(1.25)])
    a, _ = lj.accelerations(rod, 0.0, q0, np.zeros(2), {"m": 1e-3, "l": 2.0**54, "g": 1.0})
    np.testing.assert_allclose(a @ q0 / 2.0**54, 0.0, atol=1e-14)
    with pytest.raises(ValueError, match="singular"):
        lj.accelerations(rod, 0.0, q0, np.zeros(2), {"m": 0.0, "l": 2.0**54, "g": 1.0})


@pytest.mark.exhaustive
def test_at_round_off_without_mass():
    """A coordinate that is zero within round-off and has no mass to compare it by does not stop the motion."""
    beside = lj.Holonomic(lambda t, q, p: q[2] - 3.0 * (q[0] ** 2 + q[1] ** 2 - 1.0))
    massless = lj.System(
        lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2) - q[1],
        constraints={"rod": lj.Holonomic(lambda t, q, p: q[0] ** 2 + q[1] ** 2 - 1.0), "beside": beside},
    )
    q0 = np.array([np.sin(1.25), -np.cos(1.25), 0.0])
    traj = lj.integrate(massless, q0, np.zeros(3), ts=SPAN)
    np.testing.assert_allclose(traj.q[:, :2].T, on_rod()[1][0], rtol=0, atol=1e-8)


@pytest.mark.exhaustive
def test_rest_at_zero_in_any_units():
    """From rest at zero, where only the forces to come have a size, any unit of length gives the same steps."""
    late = lj.System(
        lambda t, q, v, p: 0.5 * v**2,
        force=lambda t, q, v, p: p["unit"] * t**3 - 100 * q - 50 * v - 1e3 * q**3 / p["unit"] ** 2,
    )

    def of(unit):
        traj = lj.integrate(late, 0.0, 0.0, {"unit": unit}, ts=np.array([0.0, 2.0]), method=lj.Radau5(), rtol=1e-6)
        return float(traj.q[-1]) / unit, int(traj.stats["num_steps"])

    q, steps = of(1.0)
    for unit in (2.0**-30, 2.0**54):
        found, count = of(unit)
        assert count == steps
        np.testing.assert_allclose(found, q, rtol=1e-13)


@pytest.mark.slow
def test_off_a_constraint_at_zero_in_any_units():
    """How far a start at zero may be off a constraint follows from its acceleration, in any unit of length.

    Twin: without a force there is no size, and what is refused in metres is not in nanometres.
    """
    pair = lj.System(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) + p["push"] * q[0],
        constraints={"bar": lj.Holonomic(lambda t, q, p: q[0] - q[1] - p["gap"])},
    )

    def accepted(gap, push, unit):
        params = {"gap": gap * unit, "push": push * unit}
        traj = lj.integrate(pair, np.zeros(2), np.zeros(2), params, ts=np.array([0.0, 1.0]), throw=False)
        return bool(traj.result == lj.RESULTS.successful)

    units = (1.0, *(length for length, _ in UNITS.values()))
    assert all(accepted(1e-8, 1.0, unit) and not accepted(1e-6, 1.0, unit) for unit in units)
    assert accepted(1e-6, 0.0, UNITS["nanometres"][0]) and not accepted(1e-6, 0.0, 1.0)
    with pytest.raises(ValueError, match="off the constraints: 'bar' = -9.31e-16"):
        params = {"gap": 1e-6 * 2.0**-30, "push": 2.0**-30}
        lj.integrate(pair, np.zeros(2), np.zeros(2), params, ts=np.array([0.0, 1.0]))


def test_forces_that_cancel():
    """Round-off of accelerations a in a step h leaves 8 ε a h² and 8 ε a h, of the larger a beside a time; a start that
    is no more than that is at rest. Twin: a start a thousand times farther is none."""
    forced, eps = Forced(np.array([0.0, 1.0, 3.0]), np.array([[0.0, 2.0], [4.0, 2.0], [1.0, 0.0]])), np.finfo(float).eps
    near, left_over = by_numpy(Forced.near), by_numpy(Forced.left_over)
    np.testing.assert_array_equal([near(forced, t) for t in (0.0, 2.0, 3.0)], [[4.0, 2.0]] * 3)
    found = left_over(forced, np.array([4.0, 2.0]), 0.1)
    np.testing.assert_allclose(found, 8 * eps * np.array([[0.04, 0.02], [0.4, 0.2]]))
    scales = by_numpy(lambda q, forced: scales_of(1.0 + 0.0 * q, q, 0.0 * q, 0.0 * q, 3.0, forced=forced))
    assert [bool(scales(size * np.ones(2), forced).unknown) for size in (1e-16, 1e-9)] == [True, False]


def run(ts):
    """The pendulum over 8 units of time."""
    return lj.integrate(pendulum, 2.0, 0.0, PARAMS, ts=ts, rtol=1e-10)


def test_outputs_are_those_of_one_solve():
    """Eight uneven outputs, two of them close together, are on the exact motion; the first is the start."""
    ts = np.concatenate([[0.0, 1e-9], np.sort(np.random.default_rng(1).uniform(0.0, 8.0, 5)), [8.0]])
    found = np.asarray(run(ts).q)
    np.testing.assert_allclose(found, swing(ts, 2.0, np.sqrt(PARAMS["g"] / PARAMS["l"]))[0], atol=3e-9)
    assert found[0] == 2.0


@pytest.mark.parametrize("counts", [(2, 6), pytest.param((2, 6, 101), marks=pytest.mark.slow)])
def test_outputs_shorten_few_steps(counts):
    """Each output adds at most one step, whether there are few or many of them."""
    alone, *more = (int(run(np.linspace(0.0, 8.0, count)).stats["num_steps"]) for count in counts)
    for steps, count in zip(more, counts[1:]):
        assert count - 1 <= steps <= alone + count - 1


ONE = np.asarray(1.0)


def stepping(ts, **limits):
    """A controller that ends steps at `ts`, and its choice, compiled, after a step from t0 to t1 with some error."""
    pid = diffrax.PIDController(rtol=1e-6, atol=1e-6, **limits)
    controller = StepToOutputs(pid, jnp.array(ts), jnp.array(WHOLE_STEPS))
    choose = lambda t0, t1, error, state: controller.adapt_step_size(t0, t1, ONE, ONE, None, error, 5, state)
    return controller, jax.jit(choose)


def test_the_size_proposed_before_is_kept():
    """After a step shortened to an output, the next one is as long as was proposed before."""
    (controller, choose), before = stepping([0.0, 1.0, 1.001, 5.0]), 0.4
    inner = controller.controller.init(None, 0.0, 5.0, 1.0, 0.4, None, lambda *a: 0.0, 5)[1]
    state = inner, np.asarray(2), np.asarray(before), np.asarray(0)
    keep, t0, t1, _, (_, index, proposed, _), _ = choose(*map(np.asarray, (1.0, 1.001, 1e-9)), state)
    assert keep and index == 3 and proposed >= before
    np.testing.assert_allclose(np.asarray(t1) - np.asarray(t0), proposed)
    assert 10 * (1.001 - 1.0) < 0.05 * before  # what the shortened step alone would have allowed


@pytest.mark.parametrize("first", [1.5e-3, 0.9e-3])
def test_a_rejected_step_is_not_tried_again(first):
    """Steps between one and two least steps that are rejected shrink until the least step ends the motion."""
    controller, choose = stepping([0.0, 5.0], dtmin=1e-3, force_dtmin=False)
    begin = jax.jit(lambda dt0: controller.init(None, jnp.zeros(()), 5.0, ONE, dt0, None, lambda *a: 0.0, 5))
    (t1, state), result = begin(first), None
    for _ in range(20):
        keep, _, t1, _, state, result = choose(np.asarray(0.0), t1, np.asarray(2e-6 * 1.01), state)
        assert not keep
        if result == diffrax.RESULTS.dt_min_reached:
            break
    assert result == diffrax.RESULTS.dt_min_reached and t1 < first


# Oscillations faster and faster: infinitely many before t = 1.
ENDLESS = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2 / (1 - t) ** (2 * params))


@pytest.mark.slow
def test_steps_that_have_collapsed_end_a_motion():
    """A lane that does not arrive ends within 10,000 steps, and says it; the lane beside it, and alone, arrives."""
    ts = np.linspace(0.0, 10.0, 11)
    both = jax.jit(jax.vmap(lambda p: lj.integrate(ENDLESS, 1.0, 0.0, p, ts=ts, rtol=1e-5, throw=False)))
    found = both(jnp.array([2.0, 0.0]))
    assert [int(code) for code in found.result._value] == [int(lj.RESULTS.no_progress._value), 0]
    assert found.stats["num_steps"][0] < 10_000 and 0.99 < found.end.t[0] < 1.0
    np.testing.assert_allclose(found.q[1], np.cos(ts), atol=1e-3)
    assert "a hundred times max_steps would not be enough" in message(lj.RESULTS.no_progress)


@pytest.mark.exhaustive
def test_long_honest_motions_go_on():
    """Steps that stay short for long, but arrive: strong damping by an explicit method, at the edge of its stability;
    outputs that crowd together over twelve decades; a comet that passes its sun at 2e-6, there and back."""
    damped = lj.System(lambda t, q, v, p: 0.5 * v**2 - q, dissipation=lambda t, q, v, p: 0.5 * 2e4 * v**2)
    end = lj.integrate(damped, 0.0, 0.0, ts=np.array([0.0, 10.0]), rtol=1e-6, estimate_error=False)
    assert end.stats["num_steps"] > 20_000
    np.testing.assert_allclose(end.v[-1], -1 / 2e4, rtol=1e-3)
    ts = np.concatenate([[0.0], np.logspace(-9, 3, 24_000)])
    found = lj.integrate(pendulum, 1e-3, 0.0, PARAMS, ts=ts, estimate_error=False)
    assert found.result == lj.RESULTS.successful
    comet = lj.System(lambda t, q, v, p: 0.5 * v @ v + 1 / jnp.sqrt(q @ q))
    far, speed = np.array([2.0, 0.0]), np.array([0.0, np.sqrt(1e-6)])
    back = lj.integrate(comet, far, speed, ts=np.array([0.0, 2 * np.pi]), max_steps=2**14, estimate_error=False)
    np.testing.assert_allclose(back.q[-1], far, atol=1e-4)


def test_constraints_hold_at_every_output():
    """Position and velocity residuals are at round-off at a loose tolerance; twin: off by a little they are not."""
    traj = lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=5 * TS, rtol=1e-6)
    assert float(traj.residual()) < 1e-14
    for name in ("q", "v"):
        of = getattr(traj, name)
        assert float(replace(traj, **{name: of | {"x": of["x"] + 1e-7}}).residual()) > 1e-8


def test_multipliers_belong_to_the_projected_states():
    """λ at every output is the tension of the state there: -3 g cos(angle) / (2 l) for a release at 90 degrees."""
    traj = motion("rod pendulum")
    tension = 3 * PARAMS["g"] * np.asarray(traj.q["y"]) / PARAMS["l"] / (2 * PARAMS["l"])
    np.testing.assert_allclose(traj.multipliers["rod"], tension, atol=1e-7)
