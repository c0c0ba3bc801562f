"""Functions that return something of the wrong kind or shape are refused in the user's words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import prepare
from tests.behaviour.test_bad_input import refusal
from tests.jaxtools.in_numpy import evaluated
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
    acceleration = lambda q, kind: lj.accelerations(system, 0.0, q, 0.0, choice(kind))[0]
    calls = (
        lambda kind: acceleration(0.0, kind),
        lambda kind: jax.jit(lambda q: acceleration(q, kind))(0.0),
        lambda kind: lj.integrate(system, 0.0, 0.0, choice(kind), ts=TS),
    )
    for call in calls:
        with refusal(TypeError, r"'rules\.axes' of params is \{'psi'\}", "frozenset"):
            call(set)
    np.testing.assert_allclose([call(frozenset) for call in calls[:2]], -2.0, rtol=1e-14)


def chain_in_loops(t, q, v, params):
    """A chain of rods of length and mass one, whose points are summed anew for each rod."""
    found = 0.0
    for i in range(len(q)):
        x = y = height = 0.0
        for j in range(i + 1):
            x, y = x + jnp.cos(q[j]) * v[j], y + jnp.sin(q[j]) * v[j]
            height = height - jnp.cos(q[j])
        found = found + 0.5 * (x**2 + y**2) - params["g"] * height
    return found


def chain_at_once(t, q, v, params):
    """The same, for all rods at once."""
    x, y, height = (jnp.cumsum(z) for z in (jnp.cos(q) * v, jnp.sin(q) * v, -jnp.cos(q)))
    return jnp.sum(0.5 * (x**2 + y**2) - params["g"] * height)


def test_loops_in_python():
    """Of a chain in loops the user is told, once, what its first answer costs; twins: in arrays, and a short one."""
    state = 0.0, np.linspace(0.1, 0.7, 32), np.full(32, 0.3), {"g": 10.0}
    with pytest.warns(
        UserWarning, match=r"L\(t, q, v, params\) consists of 5\d\d operations(.|\n)*some 30 s(.|\n)*vmap"
    ):
        prepare(lj.System(chain_in_loops), *state)
    prepare(lj.System(chain_in_loops), *state)
    prepare(lj.System(chain_at_once), *state)
    # Nor of the library's own recursion, a method.
    bodies = [lj.bodies.Body(f"{i}", 1.0, (1.0, 1.0, 1.0)) for i in range(6)]
    hinges = {
        "a": [lj.bodies.revolute(x.at(), y.at((0.0, 0.0, 1.0))) for x, y in zip([lj.bodies.ground, *bodies], bodies)]
    }
    prepare(
        lj.bodies.Tree(bodies, hinges).system([lj.bodies.weight(bodies)]),
        0.0,
        *[{"a": x[:6]} for x in state[1:3]],
        None,
    )
    prepare(lj.System(chain_in_loops), 0.0, state[1][:8], state[2][:8], state[3])
    short = 0.0, state[1][:5], state[2][:5], state[3]
    in_loops, at_once = (evaluated(chain, *short) for chain in (chain_in_loops, chain_at_once))
    np.testing.assert_allclose(in_loops, at_once, rtol=1e-14)
