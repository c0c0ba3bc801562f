"""Methods compared on a user's own motion: errors, orders, marks, choices, and refused arguments."""

from importlib import import_module

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import lagjax as lj
from lagjax.work_precision.result import Curve, Point
from tests import by_hand
from tests.systems import PARAMS, pendulum, rod_pendulum

# The room hands out a function of this name.
module = import_module("lagjax.work_precision.work_precision")
TS = np.array([0.0, 7.0, 12.0, 20.0])
RATE = np.sqrt(PARAMS["g"] / PARAMS["l"])


def swing(t, rate=RATE):
    """A pendulum released at rest from the horizontal."""
    return by_hand.swing(t, np.pi / 2, rate)


def compared(start=np.pi / 2, ts=TS, **options):
    """A comparison on the pendulum, released at rest."""
    return lj.work_precision(pendulum, start, 0.0, PARAMS, ts=ts, repeats=2, **options)


@pytest.mark.parametrize("power", [4, 9])
def test_order_is_the_slope_above_round_off(power):
    """The slope of error over evaluations where it falls: large, stalled, failed and untrusted errors do not count."""
    point = lambda n, error, trusted=True: Point("m", 1e-3, error, trusted, 1.0, 1.0, n, n, "")
    falling = [point(n, 0.02 * (100.0 / n) ** power) for n in (100, 200, 400, 800)]
    around = [point(90, 0.5), point(95, np.inf)], [point(1600, falling[-1].error), point(3200, 1e-30, trusted=False)]
    curve = Curve("m", None, 0.0, (*around[0], *falling, *around[1]))
    assert curve.order == pytest.approx(power)
    assert np.isnan(Curve("m", None, 0.0, tuple(falling[:2])).order)


def test_a_lucky_tolerance_is_not_taken():
    """A tolerance within the error does not count if a tighter one is outside."""
    point = lambda tolerance, error: Point("m", tolerance, error, True, -np.log(tolerance), 1.0, 1, 1, "")
    lucky, out, fast, slow = point(1e-3, 1e-8), point(1e-4, 1e-5), point(1e-5, 1e-7), point(1e-6, 1e-8)
    assert Curve("m", None, 0.0, (lucky, out, fast, slow)).within(1e-6) is fast
    assert Curve("m", None, 0.0, (lucky, fast, slow)).within(1e-6) is lucky
    assert Curve("m", None, 0.0, (lucky, out)).within(1e-6) is None


def test_evaluations_are_steps_times_stages(found, solved):
    """Sixteen, thirteen and six per step: the last evaluation is the first of the next step."""
    for name, stages in (("Nystrom12", 16), ("Dopri8", 13), ("Tsit5", 6)):
        assert all(point.evaluations == stages * point.steps for point in found[name].points)
    points = solved["Tsit5"].points
    assert all(point.evaluations == 6 * point.steps for point in points)
    assert all(a.steps < b.steps for a, b in zip(points, points[1:]))


def test_errors_are_those_against_the_closed_form(solved):
    """Errors relative to each leaf's largest value agree with those against Jacobi's functions."""
    largest = np.pi / 2, np.sqrt(2) * RATE
    for point in solved["Tsit5"].points:
        got = point.trajectory.q, point.trajectory.v
        error = max(np.max(np.abs(x - y)) / scale for x, y, scale in zip(got, swing(TS), largest))
        assert point.error == pytest.approx(error, rel=1e-2) and point.ended_well
    # Twin: another pendulum's motion has a much larger distance.
    other = np.max(np.abs(solved["Tsit5"].points[-1].trajectory.q - swing(TS, 1.001 * RATE)[0]))
    assert other > 1e3 * solved["Tsit5"].points[-1].error


def test_made_up_errors_are_found(found):
    """A comparison finds the orders, errors and steps of its programs; the default of `integrate` comes first."""
    assert list(found.curves) == ["Nystrom12", "Dopri8", "Tsit5"] and found.call_seconds == 1e-7
    for name, order in (("Nystrom12", 12), ("Dopri8", 8), ("Tsit5", 5)):
        assert found[name].order == pytest.approx(order, rel=0.05)
        for point in found[name].points:
            assert point.error == pytest.approx(0.02 * (100 / point.steps) ** order, rel=0.01, abs=1e-13)
            assert point.ended_well and point.seconds > 0
    assert all(curve.compile_seconds == 0.5 for curve in found.curves.values())


def test_best_says_what_to_take(found):
    """The fastest point of each method within the error, fastest first; an error below the reference's is refused."""
    best = found.best(error=1e-6)
    assert {choice.name for choice in best} == set(found.curves)
    assert all(choice.error <= 1e-6 for choice in best)
    assert [c.seconds for c in best] == sorted(c.seconds for c in best)
    assert f"method=lj.{best[0].name}(), rtol={best[0].tolerance:.0e}" in repr(best)
    for choice in best:
        tighter = [p for p in found[choice.name].points if p.tolerance <= choice.tolerance]
        assert all(point.error <= 1e-6 for point in tighter)
    with pytest.raises(ValueError, match="below the possible error of the reference"):
        found.best(error=1e-17)


def test_table_and_picture(found):
    """The table has a line for each point; the figure has two panels with an order next to each curve."""
    printed = repr(found)
    for part in ("Nystrom12 and Dopri8 at 1e-13", "digits can be trusted", "1e-12", "evaluations", "compile/s"):
        assert part in printed, part
    assert len(printed.splitlines()) == 4 + 3 + sum(len(curve.points) for curve in found.curves.values())
    panels = found.plot("pendulum").axes
    assert [axis.get_xlabel() for axis in panels] == ["run time / ms", "evaluations of the accelerations"]
    for axis in panels:
        assert {text.get_text() for text in axis.texts} >= {f"{curve.order:.1f}" for curve in found.curves.values()}


@pytest.mark.exhaustive
def test_errors_of_an_event_are_those_of_its_time_and_state():
    """The quarter period is K(1/2)/ω; a loose tolerance misses it by the stated error, relative to the span."""
    down = {"down": lj.Crossing(lambda t, q, v, params: q, direction=-1)}
    found = compared(ts=np.array([0.0, 2.0]), methods=[lj.Dopri8()], tolerances=(1e-4, 1e-8), events=down)
    exact, largest = special.ellipk(0.5) / RATE, np.sqrt(2) * RATE
    for point in found["Dopri8"].points:
        end = point.trajectory.end
        off = abs(float(end.t) - exact) / 2.0, abs(float(end.q)) / (np.pi / 2), abs(float(end.v) + largest) / largest
        assert point.error == pytest.approx(max(off), rel=0.05, abs=2 * found.reference.error)
    loose, tight = found["Dopri8"].points
    assert loose.error > 100 * tight.error
    assert found.measured.startswith("coordinates and velocities at the end, and times of 'down'")


def test_a_failing_point_keeps_its_reason_and_the_others_go_on(made_up):
    """Too few steps at tight tolerances, or a failing other tool, give failed points; twin: loose tolerances."""
    other = lambda tolerance: (*swing(TS), 77) if tolerance > 1e-7 else (np.full(4, np.nan), np.zeros(4), None)
    found = compared(
        methods={"fifth": lj.Tsit5()}, tolerances=(1e-3, 1e-11), reference=swing, max_steps=500, others={"exact": other}
    )
    loose, tight = found["fifth"].points
    assert loose.ended_well and not tight.ended_well and "step" in tight.result
    assert tight.result in repr(found)
    assert found["exact"].points[0].error < 1e-12 and found["exact"].points[0].evaluations == 77
    assert found["exact"].points[1].result == "failed"


def test_nothing_in_reach_is_said(made_up, monkeypatch):
    """If every solve fails, the error contains the message of `integrate`, if that fails, too."""
    for fails, words in ((True, r"no method reached the end(.|\n)*Tsit5(.|\n)*at 1e-06: so it is"), (False, "Tsit5")):

        def integrate(*state, ts, rtol, **options):
            if fails:
                raise RuntimeError("so it is")

        monkeypatch.setattr(module, "integrate", integrate)
        with pytest.raises(RuntimeError, match=words):
            compared(methods=[lj.Tsit5()], tolerances=(1e-6,), reference=swing, max_steps=3)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"methods": "Dopri8"}, TypeError, "methods must be a sequence of solvers"),
        ({"methods": lj.Dopri8()}, TypeError, r"Fix: methods=\[lj.Dopri8\(\)\]"),
        ({"methods": []}, ValueError, "methods must hold something"),
        ({"methods": [lj.Dopri8]}, TypeError, r"the class.*\n.*\n.*lj.Dopri8\(\)"),
        ({"methods": [lj.Dopri8(), "RK45"]}, TypeError, "method 'str'.*not 'RK45'"),
        ({"methods": [diffrax.Euler()]}, TypeError, r"does not estimate its error(.*\n)*.*HalfSolver\(diffrax.Euler"),
        ({"methods": {"s": diffrax.SemiImplicitEuler()}}, TypeError, "method 's'.*does not estimate its error"),
        ({"tolerances": (1e-6, 0.0)}, ValueError, "positive numbers, not .1e-06, 0.0"),
        ({"tolerances": (1e-6, -1e-8)}, ValueError, "positive"),
        ({"tolerances": (1e-17,)}, ValueError, "below what float64 can reach"),
        ({"tolerances": ()}, ValueError, "sequence of positive numbers"),
        ({"rtol": 1e-6}, TypeError, "'rtol', which is no argument(.*\n)*.*tolerances="),
        ({"reference": "exact"}, TypeError, "something to compare with, not 'exact'"),
        ({"reference": swing, "error": len}, ValueError, "two ways to define the error"),
    ],
)
def test_bad_input(options, error, words):
    """Each is refused before anything is compiled, with a fix as code."""
    with pytest.raises(error, match=words):
        compared(**options)


def test_it_is_called_outside_of_programs():
    """Under `jit` there are no times to measure."""
    with pytest.raises(TypeError, match="measures times"):
        jax.jit(lambda q: compared(q).call_seconds)(jnp.asarray(1.0))


def test_the_reference_of_its_own_says_how_far_it_can_be_trusted(found):
    """Two methods agree to ten digits or more; only errors below that are marked."""
    assert found.reference.agrees and 10 <= found.reference.digits <= 14
    for point in found.points:
        assert point.trusted == (point.error > 2 * found.reference.error)
    assert "WARNING" not in repr(found)


@pytest.mark.slow
@pytest.mark.optimised
def test_default_methods_and_their_orders():
    """The default of `integrate` comes first; each method shows its order; Tsit5's is not Dopri8's; all agree."""
    found = compared()
    assert list(found.curves) == ["Nystrom12", "Dopri8", "Tsit5"]
    # The error of an oscillation's amplitude has one order more.
    for name, order in (("Tsit5", 5), ("Dopri8", 8), ("Nystrom12", 12)):
        assert order - 1 < found[name].order < order + 2.5
    assert all(point.ended_well and point.seconds > 0 for point in found.points)
    assert all(curve.compile_seconds > 0 for curve in found.curves.values()) and found.call_seconds > 0
    assert found.reference.agrees and 10 <= found.reference.digits <= 14 and "WARNING" not in repr(found)


def test_nystrom_methods_are_for_accelerations_without_velocities():
    """With constraints a Nyström method is refused."""
    start = {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0}
    with pytest.raises(ValueError, match="method 'Nystrom12' is for accelerations.*there are constraints"):
        lj.work_precision(rod_pendulum, *start, PARAMS, ts=TS, methods=[lj.Nystrom12()])


@pytest.mark.parametrize("off", [0.0, 1e-5])
def test_a_wrong_reference_is_found_out(made_up, off):
    """If solves agree with each other but not with the reference, its error is reported; twin: the right reference."""
    wrong = lambda ts: swing(ts, (1 + off) * RATE)
    found = compared(methods=[lj.Dopri8()], tolerances=(1e-6, 1e-9, 1e-10), reference=wrong)
    if off:
        assert not found.reference.agrees and 1e-5 < found.reference.error < 1e-3
        assert not any(point.trusted for point in found["Dopri8"].points[1:])
        assert "WARNING" in repr(found) and "not to be trusted" in repr(found)
    else:
        assert found.reference.agrees and found.reference.error < 1e-9
        assert found["Dopri8"].points[0].trusted and "WARNING" not in repr(found)
        with pytest.raises(ValueError, match="no method stays within 1e-16: the nearest is Dopri8"):
            found.best(error=1e-16)


def test_a_motion_that_amplifies_is_said_to(made_up):
    """From 1e-9 next to the top, two methods no longer agree after 25 s."""
    found = compared(np.pi - 1e-9, np.array([0.0, 25.0]), methods=[lj.Dopri8()], tolerances=(1e-6, 1e-12))
    assert not found.reference.agrees and found.reference.digits <= 7
    assert "WARNING" in repr(found)


@pytest.mark.parametrize(
    ("reference", "error", "words"),
    [
        ((np.zeros(4),), TypeError, "must give coordinates and velocities, not "),
        ((np.zeros(4), {"theta": np.zeros(4)}), ValueError, "velocities are not in the structure of v0"),
        ((np.zeros(2), np.zeros(4)), ValueError, r"shape \(2,\) at 'q', but \(4,\) is needed"),
    ],
)
def test_a_reference_that_does_not_fit(made_up, reference, error, words):
    """The reference must have the structure and shapes of the motion at its times."""
    with pytest.raises(error, match=words):
        compared(methods=[lj.Tsit5()], tolerances=(1e-3,), reference=reference)
