"""Poincaré sections, periods and turning points against elliptic integrals, Kepler's law and effective potentials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.poincare import _within_half_turns
from lagjax.integrate import Crossings
from tests.analysis.closed_forms import swinging
from tests.by_hand import by_hand
from tests.systems import PARAMS, cartesian_lagrangian, pendulum

TIGHT = {"rtol": 1e-12, "atol": 1e-12}
bottom = lambda t, q, v, p: q
ALSO = {"turn": lj.turning_points()}


def swing(q0, l, span=20.0):
    """The pendulum from rest: its section at the bottom, and its turning points."""
    params = {"g": PARAMS["g"], "l": l}
    return lj.poincare(pendulum, q0, 0.0 * q0, params, section=bottom, ts=[0.0, span], events=ALSO, **TIGHT)


# The pendulum.


@pytest.mark.slow
@pytest.mark.parametrize("q0", [0.5, 2.0, 3.0])
def test_pendulum(q0):
    """Periods are the complete elliptic integral to 1e-9, states follow from the energy, ½ v² = (g/l) (1 - cos q0).

    Turning points are at the release and opposite, half a period apart; the release itself is not one. Twin: the period
    of small swings is off by more.
    """
    section, exact = swing(q0, PARAMS["l"]), swinging(q0)
    count = int(section.count)
    found = np.asarray(lj.periods(section))
    assert count == int(20.0 / exact + 0.25) and found.shape == (499,)
    np.testing.assert_allclose(found[: count - 1], exact, rtol=1e-9)
    assert np.isnan(found[count - 1 :]).all()
    assert abs(2 * np.pi * np.sqrt(PARAMS["l"] / PARAMS["g"]) / exact - 1) > 1e-2
    crossed, turns = section.crossings.found(), section.trajectory.events["turn"].found()
    np.testing.assert_allclose(crossed.q, 0.0, atol=1e-12)
    np.testing.assert_allclose(crossed.v, np.sqrt(2 * PARAMS["g"] / PARAMS["l"] * (1 - np.cos(q0))), rtol=1e-9)
    np.testing.assert_allclose(crossed.t, exact * (0.75 + np.arange(count)), rtol=1e-9)
    np.testing.assert_allclose(turns.q, q0 * (-1.0) ** (1 + np.arange(len(turns.t))), rtol=1e-9)
    np.testing.assert_allclose(turns.v, 0.0, atol=1e-13)
    np.testing.assert_allclose(lj.periods(turns), exact / 2, rtol=1e-9)
    # The print has counts, the mean period and its spread, the times' error and doubts.
    words = " ".join(repr(section).split())
    assert f"crossings {count}, at t = {0.75 * exact:.9g}, " in words
    assert f"period {exact:.9g} on average" in words and "standard deviation" in words
    assert "uncertain no" in words and "error of the times at most" in words


def crossings(t, q=None, v=None, count=None):
    """Crossings at these times."""
    q, v = (t if x is None else x for x in (q, v))
    return Crossings(t, q, v, {}, np.asarray(len(t) if count is None else count), np.asarray(False))


def test_nothing_beyond_the_last_one_is_differentiated():
    """Gradients of a sum of known periods are exact despite NaN times; twin: through a root of squares they are NaN."""
    t = np.array([1.0, 2.5, 4.5, np.nan, np.nan])
    periods = lambda t: lj.periods(crossings(t))
    slope = lambda periods, t: jax.grad(lambda t: jnp.sum(periods(t)[:2]))(t)
    # A motion that runs backward has the same periods, and so have lanes.
    right, wrong, backward, lanes = jax.jit(lambda t: (
        slope(periods, t), slope(lambda t: jnp.sqrt(jnp.diff(t) ** 2), t), periods(-t), jax.vmap(periods)(t[None])
    ))(t)  # fmt: skip
    np.testing.assert_array_equal(right, [-1.0, 0.0, 1.0, 0.0, 0.0])
    assert np.isnan(wrong).any()
    np.testing.assert_array_equal([backward[:2], lanes[0, :2]], [[1.5, 2.0]] * 2)


def in_a_plane(seed=0, count=4):
    """A section x = 0 of given numbers, with room for five, and y and its velocity there."""
    y, vy = numbers = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 5))
    numbers[:, count:] = np.nan
    state = lambda of_y: {"x": 0.0 * of_y, "y": of_y}
    recorded = {"section": crossings(1.0 + np.arange(5) + 0 * y, state(y), state(vy), count)}
    ends = state(np.array([0.5, 0.25])), state(np.array([-1.0, 1.0]))
    made = by_hand(lj.System(cartesian_lagrangian), [0.0, 9.0], *ends, PARAMS, events=recorded)
    return lj.PoincareSection(made), numbers


def test_pictures():
    """One panel per coordinate that the section does not hold fixed, or the requested one; a note if some are lost."""
    section, numbers = in_a_plane()
    (axis,) = section.plot().axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("q.y", "v.y") and section.plot().get_suptitle() == ""
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), numbers.T[:4])
    (axis,) = section.plot(x="t", y="q.x").axes
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), [(t, 0.0) for t in range(1, 5)])
    with pytest.raises(ValueError, match="plot was given 'q.z', which is no column; there are 't', 'q.x', 'q.y'"):
        section.plot(x="q.z", y="v.y")
    with pytest.raises(ValueError, match="x is given, but y is not"):
        section.plot(x="q.y")
    with pytest.raises(ValueError, match="did not cross the section"):
        in_a_plane(count=0)[0].plot()
    lost, _ = in_a_plane(count=19)
    assert "19, of which the first 5 are kept" in repr(lost) and "kept" not in repr(section)
    assert "the first 5 of up to 19 crossings" in lost.plot().get_suptitle()


def test_what_is_printed():
    """One motion: counts, periods and doubts, also while traced; a batch: the range of counts, a colour a lane."""
    section, traced = in_a_plane()[0], []
    words = " ".join(repr(section).split())
    assert "crossings 4, at t = 1, " in words and "period 1 on average, 1 to 1, standard deviation 0" in words
    assert "uncertain no" in words and "error" not in words
    jax.eval_shape(lambda section: traced.append(repr(section)), section)
    assert traced == ["Poincaré section, being traced, room for 5 crossings"]
    lanes = jax.tree.map(lambda *x: np.stack(x), *(in_a_plane(i, count)[0] for i, count in enumerate((4, 3, 2))))
    words = " ".join(repr(lanes).split())
    assert "lanes 3" in words and "2 to 4 a lane" in words and "period 1 on average, 1 to 1" in words
    assert len({line.get_color() for line in lanes.plot().axes[0].lines}) == 3


def test_angles_within_half_turns():
    """Angles are shifted by whole turns, and ±π within round-off is one value; twin: one degree short of it is not."""
    found = _within_half_turns(np.array([7.0, -7.0, np.pi - 1e-9, np.pi + 1e-9, -np.pi, 3.1241]))
    np.testing.assert_allclose(found, [7 - 2 * np.pi, 2 * np.pi - 7, -np.pi, -np.pi, -np.pi, 3.1241], atol=2e-9)


def driven_lagrangian(t, q, v, p):
    """A spring that a force drives."""
    return 0.5 * v**2 - 0.5 * q**2 + p["force"] * q * jnp.cos(p["omega"] * t)


@pytest.mark.slow
def test_once_a_period_of_the_drive():
    """The steady motion q = f cos(ωt) / (1 - ω²) is one point of the section; twin: with free motion added it moves."""
    driven, f, omega = lj.System(driven_lagrangian), 0.5, 0.625
    drive = lambda t, q, v, p: jnp.sin(p["omega"] * t)
    run = lambda q0: lj.poincare(driven, q0, 0.0, {"force": f, "omega": omega}, section=drive, ts=[0.0, 62.0], **TIGHT)
    steady, off = f / (1 - omega**2), 0.25
    for q0 in (steady, steady + off):
        found = run(q0).crossings.found()
        t = 2 * np.pi / omega * (1 + np.arange(6))
        np.testing.assert_allclose(found.t, t, rtol=1e-13)
        np.testing.assert_allclose(found.q, steady + (q0 - steady) * np.cos(t), rtol=1e-9)
        np.testing.assert_allclose(found.v, (steady - q0) * np.sin(t), atol=1e-9)
    assert np.ptp(found.q) > off


# Refused input.

REFUSED = {
    "no function": ({"section": 0.0}, TypeError, "a function of"),
    "terminal": ({"section": lj.Crossing(bottom)}, ValueError, "ends the motion at its first crossing"),
    "a vector": ({"section": lambda t, q, v, p: jnp.stack([q, v])}, ValueError, "event 'section' must return one"),
    "the name": ({"section": bottom, "events": {"section": ALSO["turn"]}}, ValueError, "called 'section'"),
    "no events": ({"section": bottom, "events": [ALSO["turn"]]}, TypeError, "by name"),
    "a coordinate": ({"section": bottom, "events": {"a": lj.turning_points("r")}}, ValueError, "'r', which is no"),
}


@pytest.mark.parametrize("given, error, words", REFUSED.values(), ids=REFUSED)
def test_refused_in_words(given, error, words):
    """Invalid sections are refused before anything is compiled."""
    with pytest.raises(error, match=words) as raised:
        lj.poincare(pendulum, 1.0, 0.0, PARAMS, ts=[0.0, 1.0], **given)
    assert "Fix:" in str(raised.value)


def test_turning_points_by_name():
    """They are of a velocity by name, which several need."""
    velocity = lambda name, v: lj.turning_points(name).guard(0.0, v, v, None)
    assert velocity("r", {"phi": 1.0, "r": 2.0}) == 2.0 and velocity("q[1]", np.array([1.0, 2.0])) == 2.0
    assert [getattr(lj.turning_points("r", direction=1), name) for name in ("direction", "terminal")] == [1, False]
    traj = in_a_plane()[0].trajectory
    for act, error, words in (
        (
            lambda: velocity(None, np.ones(2)),
            ValueError,
            r'There are q\[0\], q\[1\](?s:.*)lj.turning_points\("q\[0\]"\)',
        ),
        (lambda: velocity("x", {"phi": 1.0, "r": 2.0}), ValueError, "'x', which is no coordinate; .* 'phi' and 'r'"),
        (lambda: lj.turning_points(0), TypeError, "by its name, not 0"),
        (lambda: lj.periods(traj), TypeError, "must be crossings, not a Trajectory"),
        (lambda: lj.periods(crossings(np.ones(1))), ValueError, "only one crossing was kept"),
        (
            lambda: lj.PoincareSection(traj, "top"),
            ValueError,
            "'top', which is no event of the trajectory; there is 'section'",
        ),
    ):
        with pytest.raises(error, match=words):
            act()
