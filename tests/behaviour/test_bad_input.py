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


def test_wrong_structure():
    """v lacks one of q's coordinates."""
    with refusal(ValueError, "structure of q", "theta"):
        lj.integrate(sphere, {"psi": 1.0, "theta": 0.0}, {"psi": 0.0}, ts=TS)


def test_wrong_shape():
    """v has another shape than q: the message names the coordinate."""
    with refusal(ValueError, "'y'", r"\(2,\)"):
        lj.integrate(rod_pendulum, {"x": 1.0, "y": np.zeros(2)}, {"x": 0.0, "y": 0.0}, PARAMS, ts=TS)


def test_no_numbers_in_the_start():
    """A condition, text or a function as a coordinate is named, with what may have been meant."""
    for start, words in ((True, "'psi' of q is bool"), ("1.0", "'1.0'"), (lambda: 1.0, "a function"), ({1.0}, "{1.0}")):
        with refusal(TypeError, words, "Usual cause"):
            lj.integrate(sphere, {"psi": start, "theta": 0.0}, {"psi": 0.0, "theta": 1.0}, ts=TS)
    for start in (None, {}, [], np.zeros(0)):
        with refusal(ValueError, "q has no coordinates"):
            lj.integrate(pendulum, start, start, PARAMS, ts=TS)


def test_nan_in_the_start():
    """A NaN coordinate is named."""
    with refusal(ValueError, "'y' of v0 is nan"):
        lj.integrate(rod_pendulum, {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": np.nan}, PARAMS, ts=TS)


def test_start_off_the_constraint():
    """An inconsistent start is refused, with the residuals of positions and velocities and with the remedy."""
    q0, v0 = {"x": 1.3, "y": 0.1}, {"x": 0.2, "y": -1.0}
    with refusal(ValueError, "off the constraints", "'rod' = 0.138", "d/dt 'rod'", "consistent_state"):
        lj.integrate(rod_pendulum, q0, v0, PARAMS, ts=TS)


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


def test_not_a_system():
    """The Lagrangian itself is passed instead of the system."""
    with refusal(TypeError, "lj.System"):
        lj.integrate(pendulum.lagrangian, 1.0, 0.0, PARAMS, ts=TS)
