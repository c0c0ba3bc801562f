"""Bad input raises an error in the user's terms: what happened, the usual cause, the fix."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.systems import PARAMS, TS, pendulum, rod_pendulum

sphere = lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2))


def refusal(kind, *parts):
    """Expect an error whose message holds all `parts` and a fix."""
    pattern = "(?s)" + "".join(f"(?=.*{part})" for part in (*parts, "Fix:"))
    return pytest.raises(kind, match=pattern)


UPRIGHT, REST = {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0}
# Others, which are mistakes of beginners, are in `test_first_minutes.py`: the call, the error and parts of its message.
REFUSED = {
    "another shape": (rod_pendulum, UPRIGHT | {"y": np.zeros(2)}, REST, ValueError, "'y'", r"\(2,\)"),
    "a function": (sphere, {"psi": lambda: 1.0, "theta": 0.0}, {"psi": 0.0, "theta": 1.0}, TypeError, "a function"),
    "a set": (sphere, {"psi": {1.0}, "theta": 0.0}, {"psi": 0.0, "theta": 1.0}, TypeError, "{1.0}", "Usual cause"),
    **{f"nothing, {x!r}": (pendulum, x, x, ValueError, "q has no coordinates") for x in (None, {}, [], np.zeros(0))},
    "NaN": (rod_pendulum, UPRIGHT, REST | {"y": np.nan}, ValueError, "'y' of v0 is nan"),
    "off the rod": (
        rod_pendulum, {"x": 1.3, "y": 0.1}, {"x": 0.2, "y": -1.0}, ValueError, "off the constraints", "'rod' = 0.138",
        "d/dt 'rod'", "consistent_state",
    ),
    "the Lagrangian alone": (pendulum.lagrangian, 1.0, 0.0, TypeError, "lj.System"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    """A start that is none, or is off the constraints, is named with a fix."""
    system, q, v, kind, *parts = REFUSED[case]
    with refusal(kind, *parts):
        lj.integrate(system, q, v, PARAMS, ts=TS)


@pytest.mark.exhaustive
def test_the_remedy_for_a_start_off_the_constraint():
    """The advised remedy works; twin: without it the same start is refused, above."""
    q0, v0 = {"x": 1.3, "y": 0.1}, {"x": 0.2, "y": -1.0}
    traj = lj.integrate(rod_pendulum, *lj.consistent_state(rod_pendulum, 0.0, q0, v0, PARAMS), PARAMS, ts=TS)
    assert float(traj.residual()) < 1e-14


@pytest.mark.slow
def test_a_constraint_may_have_any_name():
    """A constraint's name that contains a bracket is not mistaken for an index."""
    system = lj.System(rod_pendulum.lagrangian, {"rod[left]": rod_pendulum.constraints["rod"]})
    with refusal(ValueError, r"d/dt 'rod\[left\]' = 1"):
        lj.integrate(system, {"x": 1.25, "y": 0.0}, {"x": 0.4, "y": 0.0}, PARAMS, ts=TS)


@pytest.mark.exhaustive
def test_unreachable_constraint():
    """No consistent state exists: the error gives the residual by name."""
    system = lj.System(rod_pendulum.lagrangian, {"ghost": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + 1.0)})
    with refusal(ValueError, "no consistent state", "'ghost'"):
        lj.consistent_state(system, 0.0, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, PARAMS)
