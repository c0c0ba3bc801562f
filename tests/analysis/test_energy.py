"""The energy ledger: works in closed form, the balance of every scene, and changes that must break it."""

import inspect
from dataclasses import replace
from functools import wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis import energy
from lagjax.integrate import HybridTrajectory
from lagjax.integrate.results import Snapshot
from lagjax.numerics import quadrature
from lagjax.scenes import SCENES
from lagjax.system.model import model_of
from tests.by_hand import ASKED, by_hand
from tests.by_numpy import by_numpy, equations

RTOL = 1e-9
# Not by calling `runs`: their exact solutions would be computed whatever tests are run.
WITH_RUNS = [name for name, scene in SCENES.items() if scene.runs is not tuple]


def falling(t, q, v, params):
    """A fall of unit mass, with g = 10."""
    return 0.5 * v**2 - 10.0 * q


def drag(t, q, v, params):
    """Rayleigh's function of the force -v."""
    return 0.5 * v**2


DRAGGED = lj.System(falling, dissipation=drag)


def negative(function):
    """The function of the same arguments with the opposite sign; None for None."""
    return function and wraps(function)(lambda *args: jax.tree.map(jnp.negative, function(*args)))


def flipped(system):
    """The system with forces and dissipation of the opposite sign, and constraints that push the other way."""
    other = lambda c: lj.Holonomic(negative(c.g)) if isinstance(c, lj.Holonomic) else lj.Nonholonomic(negative(c.phi))
    constraints = {name: other(constraint) for name, constraint in system.constraints.items()}
    return lj.System(system.lagrangian, constraints, negative(system.force), negative(system.dissipation))


class Known(energy.Motion):
    """The motion of `DRAGGED` from (5, 0) at these times, and in closed form between them: nothing is integrated."""

    def __init__(self, ts, end=None, system=DRAGGED, **fields):
        ts = np.asarray(ts)
        reached = np.where(np.abs(ts) > np.inf if end is None else ts > end, np.nan, ts)
        made = by_hand(DRAGGED, ts, *self.states(reached), **fields)
        if end is not None:
            made = replace(made, end=Snapshot(np.asarray(end), *self.states(end), {}))
        super().__init__(made, system)

    def states(self, t):
        """q and v."""
        v = -10.0 * (1 - np.exp(-t))
        return 5.0 - 10.0 * t - v, v

    def again(self, a, b):
        """At the nodes of intervals."""
        t = quadrature.nodes(a, b).ravel()
        assert len(self._with_others(t)) <= self.room
        return self._where(np.repeat(0.5 * (a + b), len(quadrature.NODES))), t, *self.states(t), {}


def taken(t):
    """The work of the drag from 0 on, of the power -v²."""
    return -100 * (t - 2 * (1 - np.exp(-t)) + 0.5 * (1 - np.exp(-2 * t)))


def test_drag_takes_what_the_closed_form_says():
    """v = -10 (1 - e^-t), whose square is the power; twin: a wrong sign. The end by an event is the last row."""
    ts = [0.0, 0.5, 0.6, 9.0]
    known = Known(ts, end=0.75)
    ledger, work = energy._ledger(known), energy._ledger(known).works["dissipation"]
    assert len(ledger.t) == 4 and ledger.t[-1] == 0.75 and ledger.kinetic is not None
    np.testing.assert_allclose(work.total, taken(ledger.t), atol=1e-12)
    np.testing.assert_allclose(work.power, -(known.states(ledger.t)[1] ** 2), rtol=1e-12)
    np.testing.assert_allclose(ledger.potential, 10.0 * known.states(ledger.t)[0], rtol=1e-12)
    np.testing.assert_allclose(ledger.kinetic + ledger.potential, ledger.jacobi_integral, rtol=1e-13)
    assert ledger.closes and ledger.relative_closure < 10 * RTOL and ledger.quadrature < RTOL
    wrong = energy._ledger(Known(ts, end=0.75, system=flipped(DRAGGED)))
    assert wrong.relative_closure > 1e4 * max(ledger.relative_closure, RTOL)
    assert "DOES NOT CLOSE" in repr(wrong) and "the dissipation gave" in repr(wrong)
    assert "NOT CLOSE" not in repr(ledger) and "gave" not in repr(ledger)
    axis = ledger.plot().axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["dissipation", "change of h"]


def test_backward_and_cut():
    """Backward in time works have the opposite sign; an interval has any length, and pieces where forces may jump."""
    back = energy._ledger(Known([20.0, 17.0]))
    np.testing.assert_allclose(back.works["dissipation"].total[-1], taken(17.0) - taken(20.0), rtol=1e-9)
    assert back.closes and "gave" not in repr(back)
    long = energy._ledger(Known([0.0, 20.0], steps=1, asked=ASKED._replace(jump_ts=np.array([1.0, 30.0]))))
    np.testing.assert_allclose(long.works["dissipation"].total[-1], taken(20.0), rtol=1e-9)
    assert long.closes and long.allowed == pytest.approx(1e-7)
    known = Known([0.0, 2.0], steps=3, asked=ASKED._replace(jump_ts=np.array([0.5, 30.0])))
    np.testing.assert_array_equal(known._knots(), [0.0, 0.5, 2.0])
    np.testing.assert_allclose(known._cut(*(np.array(x) for x in ([0.0, 0.5], [0.5, 2.0])))[1], [0.5, 1.0, 1.5, 2.0])


def test_a_motion_of_more_steps_needs_no_other_program():
    """The nodes of a few more steps go into the same program, those of many into another."""
    known, lengths = Known([0.0, 1.0]), []
    for nodes in (30, 150, 210, 300):
        known._with_others(np.linspace(0.001, 0.999, nodes))
        lengths.append(known.room)
    assert lengths == [256, 256, 256, 512]


SLEDGE = lj.System(
    lambda t, q, v, p: (
        0.5 * (v["x"] ** 2 + q["x"] ** 2 * v["y"] ** 2) + v["turn"] ** 2 + (t - q["y"]) * v["x"] + t * q["x"]
    ),
    {
        "edge": lj.Nonholonomic(lambda t, q, v, p: v["y"] - v["x"] * q["turn"] - t),
        "rail": lj.Holonomic(lambda t, q, p: q["x"] - q["turn"] ** 2 - t**2),
    },
    force=lambda t, q, v, p: {"x": v["y"], "y": -q["x"] * v["x"], "turn": jnp.cos(t)},
    dissipation=lambda t, q, v, p: 0.5 * p["c"] * v["x"] ** 2 + v["y"] ** 4,
)


@pytest.mark.parametrize("sign", [1, -1])
def test_powers_are_the_rate_of_h(sign):
    """dh/dt = Q·v - (∂R/∂v)·v + λ·(A v) - ∂L/∂t, of which each term is its source's; twin: with other signs."""
    state = 0.5, {"turn": 0.3, "x": 0.7, "y": -0.4}, {"turn": 0.2, "x": 1.1, "y": 0.6}, {"c": 0.75}
    t, q, v, p = state
    moved, accounted = equations(SLEDGE, *state), SLEDGE if sign == 1 else flipped(SLEDGE)
    lanes = jax.tree.map(lambda x: np.asarray(x)[None], (t, q, v, moved.multipliers))
    found = by_numpy(lambda *lanes: inspect.unwrap(energy._powers)(model_of(accounted, *state), *lanes, None))(*lanes)

    def h(t, q, v):
        at = inspect.unwrap(energy._energies)(model_of(SLEDGE, *state), *jax.tree.map(lambda x: x[None], (t, q, v)))
        return at[0][0]

    start = jax.tree.map(np.asarray, (t, q, v))
    (rate,) = by_numpy(lambda *a: [jax.jvp(h, start, a)[1]])(1.0, v, moved.a)
    total = sum(np.sum(x) for x in found.values())
    assert (abs(total - rate) < 1e-12) == (sign == 1) and abs(rate) > 0.1
    in_order = lambda x: np.array([[x[name] for name in ("turn", "x", "y")]])
    np.testing.assert_allclose(
        found["force"], sign * in_order({"turn": np.cos(t) * 0.2, "x": 0.6 * 1.1, "y": -0.7 * 1.1 * 0.6}), rtol=1e-13
    )
    np.testing.assert_allclose(
        found["dissipation"], -sign * in_order({"turn": 0.0, "x": 0.75 * 1.1**2, "y": 4 * 0.6**4}), atol=1e-13
    )
    np.testing.assert_allclose(found["explicit time"], [[-1.1 - 0.7]], rtol=1e-13)
    edge = moved.multipliers["edge"] * in_order({"turn": 0.0, "x": -0.3 * 1.1, "y": 0.6})
    np.testing.assert_allclose(found["constraint 'edge'"], sign * edge, atol=1e-13)


@pytest.mark.exhaustive
def test_impacts():
    """A ball loses 1 - e² of its energy at each impact, and drag takes the rest; an output may be at an impact."""
    ball = DRAGGED
    floor = lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, params: q, 0.5))
    hybrid = lj.Hybrid({"flying": ball}, [floor], most_switches=4)
    first = lj.integrate(hybrid, 1.0, 0.0, ts=np.array([0.0, 1.0]))
    assert isinstance(first, HybridTrajectory) and len(first.switches) == 2
    at_impact = lj.integrate(hybrid, 1.0, 0.0, ts=np.array([0.0, float(first.switches.t[0]), 1.0]))
    for traj in (first, at_impact):
        assert isinstance(traj, HybridTrajectory)
        ledger = lj.energy_ledger(traj)
        speeds = np.asarray(traj.switches.v)[:2]
        np.testing.assert_allclose(ledger.impacts, -0.5 * (1 - 0.25) * speeds**2, rtol=1e-9)
        assert ledger.closes and ledger.switches == ("flying -> flying",) * 2
        assert not lj.energy_ledger(traj, lj.Hybrid({"flying": flipped(ball)}, [floor], most_switches=4)).closes
    # The velocity tells whether the output is before or after the impact.
    assert (ledger.impact_total[1] == 0) == (at_impact.v[1] < 0) and "2 switches" in repr(ledger)


@pytest.mark.exhaustive
@pytest.mark.parametrize("scene", WITH_RUNS)
def test_every_scene_closes(scene):
    """Every run of a scene closes to a hundred tolerances; twin: with flipped forces it does not."""
    runs = SCENES[scene].runs()
    assert runs
    for run in runs:
        traj = lj.integrate(run.system, run.q0, run.v0, run.params, ts=run.ts, events=run.events, estimate_error=False)
        ledger = lj.energy_ledger(traj)
        assert ledger.relative_closure < 100 * RTOL, run.name
        # The work of explicit time in L has no sign to flip.
        others = [work for name, work in ledger.sources() if name != "explicit time"]
        if any(np.ptp(work.total) > 1e-3 * ledger.scale for work in others):
            wrong = lj.energy_ledger(traj, flipped(run.system))
            assert wrong.relative_closure > 1e4 * max(ledger.relative_closure, RTOL), run.name


@pytest.mark.exhaustive
def test_settings_are_those_of_the_motion():
    """A stiff decay by Radau5, with forces that jump: the motion is integrated again with the same settings."""
    push = lambda t, q, v, params: jnp.where(t < 1.0, 2.0, 0.0)
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, force=push, dissipation=lambda t, q, v, params: 500 * v**2)
    ts = np.array([0.0, 0.7, 3.0])
    traj = lj.integrate(system, 0.0, 0.0, ts=ts, method=lj.Radau5(), jump_ts=[1.0], rtol=1e-7, estimate_error=False)
    ledger = lj.energy_ledger(traj)
    assert ledger.closes and int(traj.stats["num_steps"]) < 300
    # v tends to 2/1000 within a thousandth of the time that the push of 2 lasts.
    np.testing.assert_allclose(ledger.works["force"].total[-1], 2 * 2e-3 * (1 - 1e-3), rtol=1e-5)
    assert traj.asked.method is not None and lj.integrate(system, 0.0, 0.0, ts=ts).asked.method is None


def test_bad_input():
    """Anything but a single computed motion is refused, with a remedy."""
    alone = Known([0.0, 1.0]).trajectory
    with pytest.raises(TypeError, match="needs a motion that was computed, not 3.0"):
        lj.energy_ledger(3.0)
    with pytest.raises(TypeError, match="computed, and JAX is tracing"):
        jax.eval_shape(lambda traj: lj.energy_ledger(traj).closure, alone)
    with pytest.raises(ValueError, match="take one lane"):
        lj.energy_ledger(jax.tree.map(lambda x: np.stack([x, x]), alone))
    with pytest.raises(TypeError, match="any other one by a lj.System"):
        lj.energy_ledger(alone, lj.Hybrid({"falling": DRAGGED}))
    with pytest.raises(ValueError, match="did not get beyond its start"):
        energy.Motion(by_hand(DRAGGED, [0.0, 1.0], *np.full((2, 2), np.nan)), DRAGGED)
