"""Noether's charges and their rates, in closed form and along motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import mass_distributions
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
    found = jax.jit(
        jax.vmap(lambda q, v: {name: lj.noether_charge(system, g)(0.0, q, v, params) for name, g in generators.items()})
    )(q, v)
    for name, value in found.items():
        np.testing.assert_allclose(value, exact[name], atol=1e-12)
    assert np.max(np.abs(found["screw"] - found["L_z"])) > 0.1
    assert np.max(np.abs(np.asarray(found["L_z"]) + exact["L_z"])) > 0.1


def test_a_charge_has_derivatives():
    """∂L_z/∂m = (q x v)_z, by derivatives in both modes."""
    q, v = IN_SPACE
    charge = lj.noether_charge(KEPLER, lj.Generator.rotation("z"))
    of_m = lambda m: charge(0.0, q, v, OF_KEPLER | {"m": m})
    for derivative in (jax.grad(of_m)(1.25), jax.jacfwd(of_m)(1.25)):
        np.testing.assert_allclose(derivative, np.cross(q, v)[2], rtol=1e-14)


def moved_and_predicted(system, generator, q, v, params):
    """The change of a charge along a motion, the integral of its predicted rate, and the first rate."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    ts = np.concatenate([[0.0], 0.5 * (nodes + 1), [1.0]])
    motion = lj.integrate(system, q, v, params, ts=ts, rtol=1e-11, atol=1e-11)
    charge = lj.noether_charge(system, generator)
    both = lambda t, q, v: (charge(t, q, v, params), charge.rate(t, q, v, params))
    values, rates = (np.asarray(x) for x in jax.jit(jax.vmap(both))(motion.t, motion.q, motion.v))
    return values[-1] - values[0], 0.5 * weights @ rates[1:-1], rates[0]


@pytest.mark.exhaustive
def test_the_rate_of_a_broken_charge_is_that_of_the_motion():
    """dC/dt along motions agrees with `rate` for L, friction, velocity constraints. Twin: without the latter two."""
    squashed = lambda t, q, v, p: central(t, q, v, p) - 0.25 * q[0] ** 2 * jnp.cos(t)
    rubbed = lj.System(squashed, dissipation=lambda t, q, v, params: 0.125 * v @ v)
    turn = lj.Generator.rotation("z") + 0.5 * lj.Generator.time_translation()
    slide = lj.Generator.shift("x") + lj.Generator.shift("phi")
    for case in ((rubbed, turn, *IN_SPACE, OF_KEPLER), (DISK, slide, ON_PLANE, rolling(), RADIUS)):
        changed, predicted, first = moved_and_predicted(*case)
        np.testing.assert_allclose(predicted, changed, atol=1e-9)
        assert abs(changed) > 1e-2
        without = lj.noether_charge(lj.System(case[0].lagrangian), case[1])
        assert abs(without.rate(0.0, *case[2:]) - first) > 1e-2
