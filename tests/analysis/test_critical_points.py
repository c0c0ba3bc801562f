"""Critical points of branches, by kind, with their derivatives; and branches whose rates the equations find."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import bead_on_hoop
from tests.analysis import steady_systems as steady
from tests.analysis.test_branches import check

UPRIGHT, STILL = steady.UPRIGHT, np.zeros(2)
TURNING, DRIVEN = {"omega": 0.2, "g": 4.0}, bead_on_hoop.PARAMS | {"omega": 1.0}
STRAIGHT = {name: 8.0 * rate for name, rate in steady.straight_on(steady.UPRIGHT_DISK, steady.DISK).items()}
HOOP = {"psi": 0.0, "theta": 0.0}
# The system, parameters and start; along what to where, with what else; the kind, and the critical value.
CASES = {
    # Where the sleeping top wakes two frequencies meet, at half of I3 ω/I1, along the held spin.
    "sleeping top": (
        steady.top, steady.TOP, UPRIGHT, "v.spin", 2.0, {"velocity": UPRIGHT | {"spin": 12.0}}, "flutter",
        steady.slowest_sleeping_spin,
    ),
    # Ziegler, *Ing.-Archiv* 20 (1952) 49: a little damping halves the load.
    "column": (steady.ziegler, steady.ZIEGLER, STILL, "P", 10.0, {}, "flutter", steady.flutter_load),
    "damped column": (
        steady.damped_ziegler, steady.ZIEGLER, STILL, "P", 10.0, {}, "flutter", steady.damped_flutter_load,
    ),
    # At ω² = g/l the stiffness vanishes in all directions, but the pendulum stays stable.
    "spherical pendulum": (
        steady.turning_pendulum, TURNING, STILL, "omega", 3.0, {}, "multiple zero", lambda p: jnp.sqrt(p["g"]),
    ),
    # Rolling straight ahead: one of many zero roots grows, and no branch crosses.
    "rolling disk": (
        steady.disk, steady.DISK, steady.UPRIGHT_DISK, "v[0]", 0.5,
        {"velocity": STRAIGHT, "cyclic": steady.straight_on}, "divergence", steady.slowest_rolling,
    ),
    # A constraint drives the hoop, and the equations find its rate.
    "driven hoop": (
        bead_on_hoop.driven_system, DRIVEN, HOOP, "omega", 8.0,
        {"velocity": HOOP | {"theta": 1.0}, "cyclic": "theta", "hold": None}, "pitchfork",
        lambda p: jnp.sqrt(p["g"] / p["a"]),
    ),
}  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CASES)
def test_critical_points(name):
    """There is one, of its kind, with its derivatives by all parameters; stability changes there, if at all."""
    system, params, start, along, to, settings, kind, exact = CASES[name]
    found = lj.continue_equilibria(system, params, start, along=along, to=to, **settings)
    (critical,) = found.critical
    assert critical.kind == kind
    check(critical, exact, params, along)
    branch = found[0]
    off = np.abs(branch.parameter - float(critical.parameter)) > 1e-9
    rising = branch.parameter[-1] > branch.parameter[0]
    before = (branch.parameter < float(critical.parameter)) == rising
    np.testing.assert_array_equal(branch.stable[off], before[off] | (kind == "multiple zero"))
    if name == "sleeping top":
        rate = params["I3"] * critical.parameter / (2 * params["I1"])
        np.testing.assert_allclose(critical.frequency, rate, rtol=1e-10)
    if name == "driven hoop":
        np.testing.assert_allclose(found[1].v["theta"], found[1].parameter, rtol=1e-12)
        np.testing.assert_allclose(found[1].multipliers["motor"], 0.0, atol=1e-10)
