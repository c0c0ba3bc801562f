"""What is wrong with constraints at a state, in the user's names: which depend on each other, which contradict."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.diagnosis import explain_failure
from lagjax.system import coordinates, model_of
from tests.behaviour.test_bad_input import refusal, sphere
from tests.mechanics.test_saddle_point import DOOR_STATE, STATE, door, twice
from tests.systems import HORIZONTAL, PARAMS, TS, cartesian_lagrangian, rod, rod_pendulum
from tests.tiers import exhaustive_but


def rod_square(q):
    """The squared distance from the pivot."""
    return q["x"] ** 2 + q["y"] ** 2


@pytest.mark.exhaustive
def test_report_names_dependent_constraints_and_counts_freedoms():
    """`explain`: a pendulum on two rods has one degree of freedom, and both rods are named."""
    pair = lj.explain(twice(2.0), *STATE)
    assert pair.degrees_of_freedom == 1
    assert set(pair.dependent[0]) == {"rod", "again"}
    assert lj.explain(rod_pendulum, *STATE).dependent == ()


@pytest.mark.exhaustive
def test_report_of_a_rounded_state():
    """The door has one degree of freedom and seven dependent equations, also at a state typed with six digits.

    Such a state is moved onto the constraints first.
    """
    report = lj.explain(door, *DOOR_STATE)
    assert report.degrees_of_freedom == report.position_freedoms == 1
    assert len(report.dependent) == 7
    assert "18, of which 11 independent" in repr(report)
    rounded = {"corner": np.round(DOOR_STATE[1]["corner"], 6)}
    assert lj.explain(door, 0.0, rounded, DOOR_STATE[2], DOOR_STATE[3]).degrees_of_freedom == 1


@pytest.mark.exhaustive
def test_report_of_a_state_with_other_velocities():
    """Velocities off the constraints are reported first, and the nearest state on them is judged: no contradiction.

    `accelerations` takes the state as it is, and its error says so too. If no state is on them, that is the problem.
    """
    length = lj.Holonomic(lambda t, q, params: jnp.sqrt(rod_square(q)) - params["l"])
    pair = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "length": length})
    along = {"x": STATE[2]["x"] + np.sin(2.0), "y": STATE[2]["y"] - np.cos(2.0)}
    report = lj.explain(pair, 0.0, STATE[1], along, PARAMS)
    assert report.problem is None and report.degrees_of_freedom == 1
    labels = [label for label, _ in report.rows]
    assert labels[:2] == ["at", "off the constraints"]
    assert "d/dt 'length' = 1" in dict(report.rows)["off the constraints"]
    words = r"(?s)is off them: d/dt 'length' = 1, .* instead of 0\..*Fix: q, v = lj.consistent_state"
    with pytest.raises(ValueError, match=words):
        lj.accelerations(pair, 0.0, STATE[1], along, PARAMS)
    longer = lj.Holonomic(lambda t, q, params: rod_square(q) - 4.0 * params["l"] ** 2)
    torn = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "longer": longer})
    report = lj.explain(torn, *STATE)
    assert "no state near it is on them" in repr(report) and "no consistent state" in str(report.problem)
    # The velocities satisfy both, but only one of them can be followed: these do contradict each other.
    moved = lj.Holonomic(lambda t, q, params: rod_square(q) - (params["l"] + t**2) ** 2)
    against = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "moved": moved})
    assert "contradict each other" in str(lj.explain(against, *STATE).problem)


@pytest.mark.exhaustive
def test_contradictory_accelerations_are_named():
    """One coordinate driven by two motions that agree in position and velocity only: no acceleration satisfies both."""
    drive = lambda rate: lj.Holonomic(lambda t, q, params: q["x"] - 0.5 * rate * t**2)
    system = lj.System(cartesian_lagrangian, {"slow": drive(1.0), "fast": drive(2.0)})
    at_rest = {"x": 0.0, "y": 0.0}
    with pytest.raises(ValueError, match="(?s)'slow' and 'fast' contradict each other.*Fix:"):
        lj.accelerations(system, 0.0, at_rest, at_rest, PARAMS)
    with pytest.raises(ValueError, match="(?s)'slow' and 'fast' contradict each other.*Fix:"):
        lj.integrate(system, at_rest, at_rest, PARAMS, ts=[0.0, 1.0])
    traced = jax.jit(lambda x: lj.accelerations(system, 0.0, {"x": x, "y": 0.0}, at_rest, PARAMS))(0.0)
    assert np.isnan(traced[0]["x"])
    agreeing = lj.System(cartesian_lagrangian, {"slow": drive(1.0), "fast": drive(1.0)})
    assert float(lj.accelerations(agreeing, 0.0, at_rest, at_rest, PARAMS)[0]["x"]) == pytest.approx(1.0, rel=1e-15)


kinetic = lambda t, q, v, params: 0.5 * (v["a"] ** 2 + v["b"] ** 2)
ZERO = {"a": 0.0, "b": 0.0}
WRONG = {
    "L itself": (lambda t, q, v, params: 0.5 * v**2 + jnp.log(q), -1.0, 1.0, ("L is nan", "q = -1")),
    "a derivative": (lambda *s: kinetic(*s) - jnp.sqrt(s[1]["b"]), ZERO | {"a": 1.0}, ZERO, ("coordinate 'b'", "sqrt")),
    "a pole": (sphere.lagrangian, {"psi": 0.0, "theta": 0.0}, {"psi": 1.0, "theta": 0.0},
               ("singular in coordinate 'theta'", "Cartesian")),
    "no velocity": (lambda t, q, v, params: 0.5 * v["a"] ** 2 - q["b"] ** 2, ZERO | {"b": 0.5}, ZERO,
                    ("singular in coordinate 'b'",)),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_no_accelerations(name):
    """NaN in L or in its slope alone, an azimuth at its pole, a coordinate without kinetic energy: all are named."""
    lagrangian, q, v, words = WRONG[name]
    s = coordinates.state(0.0, q, v, None)
    said = explain_failure(model_of(lj.System(lagrangian), *s), s)
    assert said is not None and all(word in said for word in words)


def test_accelerations_say_so():
    """The message is that of the call; twin: away from the pole there is no error."""
    with refusal(ValueError, "singular in coordinate 'theta'", "Cartesian"):
        lj.accelerations(sphere, 0.0, {"psi": 0.0, "theta": 0.0}, {"psi": 1.0, "theta": 0.0}, None)
    lj.accelerations(sphere, 0.0, {"psi": 1.0, "theta": 0.0}, {"psi": 1.0, "theta": 0.0}, None)


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(["a derivative"], WRONG))
def test_no_motion(name):
    """The same is said where a motion would start."""
    lagrangian, q, v, words = WRONG[name]
    with refusal(ValueError, *words):
        lj.integrate(lj.System(lagrangian), q, v, ts=TS)


@pytest.mark.exhaustive
def test_constraint_without_a_derivative():
    """A squared constraint has no derivative where it holds: it is named, and does not count as redundant."""
    rod = rod_pendulum.constraints["rod"]
    assert isinstance(rod, lj.Holonomic)
    squared = lj.Holonomic(lambda t, q, params: rod.g(t, q, params) ** 2)
    system = lj.System(rod_pendulum.lagrangian, {"rod": rod, "squared": squared})
    with refusal(ValueError, "constraint 'squared' does not act independently"):
        lj.accelerations(system, 0.0, *HORIZONTAL, PARAMS)
    alone = lj.System(rod_pendulum.lagrangian, {"squared": squared})
    with refusal(ValueError, "constraint 'squared' does not act independently"):
        lj.integrate(alone, *HORIZONTAL, PARAMS, ts=TS)
