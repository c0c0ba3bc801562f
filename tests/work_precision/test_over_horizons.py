"""Methods compared over longer and longer horizons: what they need, and from when on equal steps win."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import lagjax as lj
from lagjax.work_precision import Horizons
from lagjax.work_precision.work_precision import STEPS, Needed
from tests.by_hand import swing
from tests.systems import PARAMS, pendulum

RATE = np.sqrt(PARAMS["g"] / PARAMS["l"])
# That of a pendulum released at rest from the horizontal.
PERIOD = float(4 * special.ellipk(0.5) / RATE)


@pytest.mark.slow
def test_what_is_needed_is_the_first_that_is_enough():
    """Each method's rtol or dt0 gives the error against the closed form, and the next rougher one does not."""
    methods, motion = [lj.Nystrom12(), lj.Splitting(6)], lambda t: swing(t, np.pi / 2, RATE)
    found = lj.horizons(
        pendulum, np.pi / 2, 0.0, PARAMS, period=PERIOD, periods=(10, 300), methods=methods, reference=motion
    )
    largest = np.pi / 2, np.sqrt(2) * RATE
    ts = np.append(0.0, PERIOD * (299 + np.linspace(0.125, 1.0, 8)))

    def error(method, **options):
        traj = lj.integrate(pendulum, np.pi / 2, 0.0, PARAMS, ts=ts, method=method, estimate_error=False, **options)
        return max(np.max(np.abs(x - y)) / unit for x, y, unit in zip((traj.q, traj.v), motion(ts), largest))

    adapting, equal = found.rows[300.0]["Nystrom12"], found.rows[300.0]["Splitting(6)"]
    assert error(methods[0], rtol=adapting.setting) == pytest.approx(adapting.error, rel=0.05) and adapting.error < 1e-3
    assert error(methods[1], dt0=equal.setting) == pytest.approx(equal.error, rel=0.05) and equal.error < 1e-3
    assert error(methods[0], rtol=adapting.setting * np.sqrt(10)) > 1e-3
    assert error(methods[1], dt0=equal.setting * 2**0.25) > 1e-3
    assert found.rows[10.0]["Splitting(6)"].setting > equal.setting
    assert "300 periods" in repr(found) and f"method=lj.{found.best(300.0)}"[:-3] in repr(found)
    axis = found.plot("pendulum").axes[0]
    assert [line.get_label() for line in axis.lines] == ["Nystrom12", "Splitting(6)"]


def made(adapting, equal):
    """A result with these seconds over 10, 100 and 1000 periods."""
    solvers = {"Dopri8": lj.Dopri8(), "Gauss(4)": lj.Gauss(4)}
    needed = lambda seconds: Needed(0.1, 1e-4, seconds, 10)
    rows = {
        10.0**k: {"Dopri8": needed(a), "Gauss(4)": needed(b)} for k, (a, b) in enumerate(zip(adapting, equal), start=1)
    }
    return Horizons(solvers, rows, 1e-3)


def test_from_when_on_equal_steps_win():
    """Measured: from the first horizon after the last one that was lost. Else where N^(1 + 2/8) crosses N^(1 + 1/8)."""
    win = made((1.0, 10.0, 100.0), (2.0, 9.0, 90.0)).win
    assert win is not None and (win.periods, win.name, win.measured) == (100.0, "Gauss(4)", True)
    win = made((3.0, 10.0, 100.0), (2.0, 11.0, 90.0)).win
    assert win is not None and win.periods == 1000.0
    late = made((1.0, 10.0, 100.0), (2.0, 20.0, 200.0))
    # 2 = (N / 1000)^(1/8).
    assert late.win is not None and not late.win.measured and late.win.periods == pytest.approx(1000 * 2.0**8)
    assert "up to about 3e+05; from there on" in repr(late)
    assert made((1.0, 10.0, 100.0), (np.inf, np.inf, np.inf)).win is None
    assert Horizons({"Gauss(4)": lj.Gauss(4)}, {1.0: {"Gauss(4)": Needed(0.1, 1e-4, 1.0, 10)}}, 1e-3).win is None
    assert "do not win" in repr(made((1.0, 10.0, 100.0), (np.inf, np.inf, np.inf)))


def test_bad_horizons():
    """Horizons, errors, methods and references that say nothing are refused in words."""
    run = lambda **options: lj.horizons(pendulum, 1.0, 0.0, PARAMS, **({"period": 2.0} | options))
    for options, error, words in (
        ({"period": 0.0}, ValueError, "a positive length"),
        ({"periods": (100, 10)}, ValueError, "increasing"),
        ({"periods": 0.5}, ValueError, "increasing"),
        ({"error": 2.0}, ValueError, "between 0 and 1"),
        ({"methods": "Gauss"}, TypeError, "a sequence"),
        ({"methods": [lj.Gauss]}, TypeError, "missing brackets"),
        ({"methods": []}, ValueError, "methods must hold something"),
        ({"reference": (1.0, 2.0)}, TypeError, "a function of times"),
    ):
        with pytest.raises(error, match=words + "(?s:.*)Fix: "):
            run(**options)
    with pytest.raises(TypeError, match="makes steps of equal length(?s:.*)lj.horizons"):
        lj.work_precision(pendulum, 1.0, 0.0, PARAMS, ts=[0.0, 1.0], methods=[lj.Gauss(2)])
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda q: lj.horizons(pendulum, q, 0.0, PARAMS, period=2.0).error)(jnp.asarray(1.0))


def test_steps_are_from_long_to_short():
    """A ladder of steps ends where round-off begins for order 6, at thousands in a period."""
    assert STEPS[0] < 3 and STEPS[-1] > 2000 and all(a < b for a, b in zip(STEPS, STEPS[1:]))
