"""Noether's charges and their rates, in closed form and by accelerations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import mass_distributions
from lagjax.system import coordinates
from tests.by_numpy import by_numpy
from tests.jaxtools.in_numpy import accelerations, evaluated
from tests.symmetric_systems import DISK, IN_SPACE, KEPLER, OF_KEPLER, ON_PLANE, RADIUS, central, rolling

RANDOM = np.random.default_rng(1)


def test_charges_in_closed_form():
    """p, L, E and the screw's charge at random states, under vmap; twins: another pitch, the opposite sign of L."""
    names = list("xyz")
    state = [{k: RANDOM.normal(size=20) for k in names} for _ in range(2)]
    q, v = state
    params = mass_distributions.PARAMS["cylinder"]
    system = mass_distributions.SYSTEMS["cylinder"]
    exact = mass_distributions.charges("cylinder", q, v, params)
    exact["screw"] = 0.5 * exact["p_z"] + 2 * np.pi * exact["L_z"]
    generators = {
        "p_x": lj.Generator.translation("x"),
        "L_z": lj.Generator.rotation("z"),
        "E": lj.Generator.time_translation(),
        "screw": lj.Generator.screw("z", 0.5),
    }
    found = by_numpy(
        jax.vmap(lambda q, v: {name: lj.noether_charge(system, g)(0.0, q, v, params) for name, g in generators.items()})
    )(q, v)
    for name, value in found.items():
        np.testing.assert_allclose(value, exact[name], atol=1e-12)
    assert np.max(np.abs(found["screw"] - found["L_z"])) > 0.1
    assert np.max(np.abs(found["L_z"] + exact["L_z"])) > 0.1


def test_a_charge_has_derivatives():
    """∂L_z/∂m = (q x v)_z, by derivatives in both modes."""
    q, v = IN_SPACE
    charge = lj.noether_charge(KEPLER, lj.Generator.rotation("z"))
    of_m = lambda m: charge(0.0, q, v, OF_KEPLER | {"m": m})
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(by_numpy(derivative(of_m))(1.25), np.cross(q, v)[2], rtol=1e-14)


@pytest.mark.slow
def test_the_rate_of_a_broken_charge_is_that_of_the_motion():
    """dC/dt by the accelerations is `rate` for L, friction, velocity constraints. Twin: without the latter two."""
    squashed = lambda t, q, v, p: central(t, q, v, p) - 0.25 * q[0] ** 2 * jnp.cos(t)
    rubbed = lj.System(squashed, dissipation=lambda t, q, v, params: 0.125 * v @ v)
    turn = lj.Generator.rotation("z") + 0.5 * lj.Generator.time_translation()
    slide = lj.Generator.shift("x") + lj.Generator.shift("phi")
    for system, generator, *of_state, params in (
        (rubbed, turn, *IN_SPACE, OF_KEPLER), (DISK, slide, ON_PLANE, rolling(), RADIUS)
    ):  # fmt: skip
        charge, bare = (lj.noether_charge(of, generator) for of in (system, lj.System(system.lagrangian)))
        *state, params = coordinates.state(0.3, *of_state, params)
        a, _ = accelerations(system, *state, params)

        def rates(t, q, v, charge=charge, bare=bare, a=a, params=params):
            along = jax.jvp(lambda *state: charge(*state, params), (t, q, v), (jnp.ones(()), v, a))[1]
            return along, charge.rate(t, q, v, params), bare.rate(t, q, v, params)

        changed, predicted, other = evaluated(rates, *state)
        np.testing.assert_allclose(predicted, changed, rtol=1e-11)
        assert min(abs(changed), abs(other - changed)) > 1e-2
