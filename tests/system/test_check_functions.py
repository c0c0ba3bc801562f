"""Functions that return something of the wrong kind or shape are refused in the user's words."""

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from tests.behaviour.test_bad_input import refusal
from tests.systems import TS


def test_lagrangian_not_scalar():
    """Energies left unsummed."""
    with refusal(ValueError, "one real number", r"\(2,\)", "jnp.sum"):
        lj.integrate(lj.System(lambda t, q, v, params: 0.5 * v**2), np.zeros(2), np.zeros(2), ts=TS)


def test_force_of_another_structure():
    """A force with another structure than q."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: jnp.zeros(3))
    with refusal(ValueError, "like q"):
        lj.integrate(system, 0.0, 1.0, ts=TS)


def test_not_hashable_in_params():
    """A set in params is named, in a call and in a compiled one; twin: a frozenset is fine."""
    choice = lambda kind: {"rules": {"axes": kind(["psi"])}}
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - (2.0 * q if "psi" in p["rules"]["axes"] else 0.0))
    calls = (
        lambda kind: lj.accelerations(system, 0.0, 0.0, 0.0, choice(kind))[0],
        lambda kind: jax.jit(lambda q: lj.accelerations(system, 0.0, q, 0.0, choice(kind))[0])(0.0),
        lambda kind: 2 * lj.integrate(system, 0.0, 0.0, choice(kind), ts=[0.0, 1.0]).q[-1],
    )
    for call in calls:
        np.testing.assert_allclose(call(frozenset), -2.0, rtol=1e-9)
        with refusal(TypeError, r"'rules\.axes' of params is \{'psi'\}", "frozenset"):
            call(set)
