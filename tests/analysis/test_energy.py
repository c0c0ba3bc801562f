"""The energy ledger: works in closed form, the balance of every scene, and changes that must break it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import SCENES, bead_on_hoop, sliding_wedge
from lagjax.system.function_arguments import WITH_MULTIPLIERS, takes_of
from tests.counting import compiles
from tests.system.test_hybrid import SPHERE, rolls, slides, throw
from tests.tiers import exhaustive_but

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


def flipped(system):
    """The system with forces and dissipation of the opposite sign, and constraints that push the other way."""
    constraints = {
        name: lj.Holonomic(lambda t, q, p, g=c.g: -g(t, q, p))
        if isinstance(c, lj.Holonomic)
        else lj.Nonholonomic(lambda t, q, v, p, phi=c.phi: -phi(t, q, v, p))
        for name, c in system.constraints.items()
    }
    force, dissipation = system.force, system.dissipation
    if system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS:
        force = lambda t, q, v, multipliers, params, f=force: jax.tree.map(
            jnp.negative, f(t, q, v, multipliers, params)
        )
    elif force is not None:
        force = lambda t, q, v, params, f=force: jax.tree.map(jnp.negative, f(t, q, v, params))
    if dissipation is not None:
        dissipation = lambda t, q, v, params, r=dissipation: -r(t, q, v, params)
    return lj.System(system.lagrangian, constraints, force, dissipation)


def test_drag_takes_what_the_closed_form_says():
    """v = -10 (1 - e^-t), whose square is the power; twin: a wrong sign. The end by an event is the last row."""
    exact = lambda t: -100 * (t - 2 * (1 - np.exp(-t)) + 0.5 * (1 - np.exp(-2 * t)))
    floor = lj.Crossing(lambda t, q, v, params: q + 3.0, terminal=True)
    traj = lj.integrate(DRAGGED, 5.0, 0.0, ts=np.array([0.0, 0.5, 0.6, 9.0]), events={"floor": floor})
    ledger = lj.energy_ledger(traj)
    work = ledger.works["dissipation"]
    assert len(ledger.t) == 4 and ledger.t[-1] == traj.end.t
    np.testing.assert_allclose(work.total, exact(ledger.t), atol=1e-9)
    np.testing.assert_allclose(work.power[:3], -(np.asarray(traj.v)[:3] ** 2), rtol=1e-12)
    assert ledger.kinetic is not None and ledger.potential is not None
    np.testing.assert_allclose(ledger.potential[-1], -30.0, rtol=1e-9)
    np.testing.assert_allclose(ledger.kinetic + ledger.potential, ledger.jacobi_integral, rtol=1e-13)
    assert ledger.closes and ledger.relative_closure < 10 * RTOL and ledger.quadrature < RTOL
    wrong = lj.energy_ledger(traj, flipped(DRAGGED))
    assert wrong.relative_closure > 1e4 * max(ledger.relative_closure, RTOL)
    assert "DOES NOT CLOSE" in repr(wrong) and "the dissipation gave" in repr(wrong)
    assert "NOT CLOSE" not in repr(ledger) and "gave" not in repr(ledger)
    axis = ledger.plot().axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["dissipation", "change of h"]


def test_a_motion_of_more_steps_needs_no_other_program():
    """The nodes of a few more steps go into the same program."""
    ts = np.array([0.0, 1.0])
    ledgers = [lj.energy_ledger(lj.integrate(DRAGGED, 5.0, 0.0, ts=ts, max_step=h)) for h in (0.5, 0.1)]
    assert all(ledger.closes for ledger in ledgers)
    with compiles() as programs:
        lj.energy_ledger(lj.integrate(DRAGGED, 5.0, 0.0, ts=ts, max_step=0.07))
    assert not programs
    with compiles() as programs:
        lj.energy_ledger(lj.integrate(DRAGGED, 5.0, 0.0, ts=ts, max_step=1 / 50))
    assert programs


@pytest.mark.slow
def test_the_wedge_takes_what_the_mass_gives():
    """The normal force does -W on the mass and +W on the wedge, W = ½ M Ẋ²; twin: pushing the other way, +W and -W."""
    traj = lj.integrate(
        sliding_wedge.system, sliding_wedge.Q0, sliding_wedge.V0, sliding_wedge.PARAMS, ts=np.linspace(0.0, 1.0, 6)
    )
    ledger = lj.energy_ledger(traj)
    work = ledger.constraints["incline"]
    W = 0.5 * sliding_wedge.PARAMS["M"] * np.asarray(traj.v["X"]) ** 2
    np.testing.assert_allclose(work.work["X"], W, atol=1e-9 * W[-1])
    np.testing.assert_allclose(work.work["x"] + work.work["y"], -W, atol=1e-9 * W[-1])
    np.testing.assert_allclose(work.total, 0.0, atol=1e-12)
    wrong = lj.energy_ledger(traj, flipped(sliding_wedge.system))
    np.testing.assert_allclose(wrong.constraints["incline"].work["X"], -W, atol=1e-9 * W[-1])
    assert "by X" in repr(ledger) and "constraint 'incline'          0" in repr(ledger)


@pytest.mark.slow
def test_the_motor_pays_for_the_hoop():
    """The motor's work is ω ΔL_z, so that E - ω L_z, the Jacobi integral of the bead alone, stays constant."""
    params = bead_on_hoop.PARAMS
    traj = lj.integrate(
        bead_on_hoop.driven_system, *bead_on_hoop.driven_start(params, 1.0), params, ts=np.linspace(0.0, 1.0, 6)
    )
    ledger = lj.energy_ledger(traj)
    spin = params["m"] * (params["a"] * np.sin(traj.q["psi"])) ** 2 * params["omega"]
    paid = params["omega"] * (spin - spin[0])
    assert np.ptp(paid) > 0.1
    np.testing.assert_allclose(ledger.constraints["motor"].total, paid, atol=1e-8 * np.ptp(paid))
    np.testing.assert_allclose(ledger.constraints["motor"].work["psi"], 0.0, atol=1e-12)
    assert ledger.closes and not lj.energy_ledger(traj, flipped(bead_on_hoop.driven_system)).closes


@pytest.mark.slow
def test_time_and_velocities_that_are_prescribed():
    """A charge in a field that grows, x = t³/6: -∂L/∂t does -∫ x dt; a belt that speeds up drags a box along."""
    growing = lj.System(lambda t, q, v, params: 0.5 * v**2 + t * q)
    ledger = lj.energy_ledger(lj.integrate(growing, 0.0, 0.0, ts=np.array([0.0, 1.0, 2.0])))
    t = ledger.t
    np.testing.assert_allclose(ledger.works["explicit time"].total, -(t**4) / 24, atol=1e-9)
    np.testing.assert_allclose(ledger.jacobi_integral, t**4 / 8 - t**4 / 6, atol=1e-9)
    assert ledger.closes and list(ledger.works) == ["explicit time"]
    belt = lj.Nonholonomic(lambda t, q, v, params: v - t)
    box = lj.System(lambda t, q, v, params: 0.5 * v**2, constraints={"belt": belt})
    ledger = lj.energy_ledger(lj.integrate(box, 0.0, 0.0, ts=np.array([0.0, 1.0, 3.0])))
    np.testing.assert_allclose(ledger.constraints["belt"].total, ledger.t**2 / 2, atol=1e-9)
    assert ledger.closes


@pytest.mark.slow
def test_backward():
    """Backward in time works have the opposite sign; an interval between outputs may have any length."""
    there = lj.integrate(DRAGGED, 5.0, 0.0, ts=np.array([0.0, 20.0]))
    back = lj.integrate(DRAGGED, there.q[-1], there.v[-1], ts=np.array([20.0, 17.0]))
    ledgers = [lj.energy_ledger(traj) for traj in (there, back)]
    np.testing.assert_allclose(ledgers[1].works["dissipation"].total[-1], 300.0, rtol=1e-6)
    assert ledgers[0].closes and ledgers[1].closes and "gave" not in repr(ledgers[1])


@pytest.mark.exhaustive
def test_impacts():
    """A ball loses 1 - e² of its energy at each impact, and drag takes the rest; an output may be at an impact."""
    ball = DRAGGED
    floor = lj.Switch("flying", to="flying", when=lj.touches(lambda t, q, params: q, 0.5))
    hybrid = lj.Hybrid({"flying": ball}, [floor], most_switches=4)
    first = lj.integrate(hybrid, 1.0, 0.0, ts=np.array([0.0, 1.0]))
    assert isinstance(first, lj.HybridTrajectory) and len(first.switches) == 2
    at_impact = lj.integrate(hybrid, 1.0, 0.0, ts=np.array([0.0, float(first.switches.t[0]), 1.0]))
    for traj in (first, at_impact):
        assert isinstance(traj, lj.HybridTrajectory)
        ledger = lj.energy_ledger(traj)
        speeds = np.asarray(traj.switches.v)[:2]
        np.testing.assert_allclose(ledger.impacts, -0.5 * (1 - 0.25) * speeds**2, rtol=1e-9)
        assert ledger.closes and ledger.switches == ("flying -> flying",) * 2
        assert not lj.energy_ledger(traj, lj.Hybrid({"flying": flipped(ball)}, [floor], most_switches=4)).closes
    # The velocity tells whether the output is before or after the impact.
    assert (ledger.impact_total[1] == 0) == (at_impact.v[1] < 0) and "2 switches" in repr(ledger)


@pytest.mark.exhaustive
def test_friction_on_a_multiplier():
    """A sphere that slides and then rolls loses two sevenths of its energy; twin: friction of the opposite sign."""
    traj = throw(0.25, estimate_error=False)
    ledger = lj.energy_ledger(traj)
    assert len(traj.switches) == 1 and ledger.relative_closure < 100 * RTOL
    np.testing.assert_allclose(ledger.works["force"].total[-1], -2 / 7 * 0.5 * SPHERE["m"] * 3.0**2, rtol=1e-9)
    wrong = lj.Hybrid({"slides": flipped(slides), "rolls": rolls}, traj.system.switches)
    assert lj.energy_ledger(traj, wrong).relative_closure > 1e4 * max(ledger.relative_closure, RTOL)


@pytest.mark.slow
@pytest.mark.parametrize("scene", exhaustive_but(("sliding_wedge", "cross_rails"), WITH_RUNS))
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
def test_tolerances():
    """The ledger closes to a hundred tolerances also at loose ones, and in float32."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q) * (1 + 0.2 * jnp.sin(3 * t)), dissipation=drag)
    for rtol in (1e-4, 1e-7, 1e-11):
        ledger = lj.energy_ledger(lj.integrate(system, 2.0, 1.0, ts=np.array([0.0, 7.0, 20.0]), rtol=rtol))
        assert ledger.closes and ledger.allowed == pytest.approx(100 * rtol)
    start = np.float32(2.0), np.float32(1.0)
    ledger = lj.energy_ledger(lj.integrate(system, *start, ts=np.array([0.0, 7.0, 20.0], np.float32), rtol=1e-4))
    assert ledger.closes and ledger.t.dtype == np.float32


@pytest.mark.slow
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
    of = lambda q0: lj.integrate(DRAGGED, q0, 0.0, ts=np.array([0.0, 1.0]))
    with pytest.raises(TypeError, match="needs a motion that was computed, not float"):
        lj.energy_ledger(3.0)
    with pytest.raises(TypeError, match="one that JAX is tracing"):
        jax.jit(lambda q0: lj.energy_ledger(of(q0)).closure)(1.0)
    alone = of(1.0)
    with pytest.raises(ValueError, match="account for one lane"):
        lj.energy_ledger(jax.tree.map(lambda x: jnp.stack([x, x]), alone))
    with pytest.raises(TypeError, match="any other one by a lj.System"):
        lj.energy_ledger(alone, lj.Hybrid({"falling": DRAGGED}))
