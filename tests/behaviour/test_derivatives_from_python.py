"""Derivatives and lanes from Python are right at once, and again without compiling, of functions written anew too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.counting import compiles
from tests.tiers import exhaustive_but

TS = np.linspace(0.0, 1.0, 5)


def spring():
    """A mass of 2 on a spring, whose motion from 1 at rest is cos(w t) with w² = k / 2."""
    return lj.System(lambda t, q, v, params: v**2 - 0.5 * params["k"] * q**2)


def on_a_rod():
    """A mass on a rod of length 2, level and at rest: the rod holds nothing yet."""
    rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - 4.0)
    kinetic = lambda v: 0.75 * (v["x"] ** 2 + v["y"] ** 2)
    return lj.System(lambda t, q, v, params: kinetic(v) - 1.5 * params["k"] * q["y"], constraints={"rod": rod})


def plane():
    """The plane, with another unit along b: from corner to corner it is √(1 + k)."""
    return lj.System(lambda t, q, v, params: 0.5 * (v["a"] ** 2 + params["k"] * v["b"] ** 2))


def motion(k):
    """The spring's motion by its stiffness."""
    return lj.integrate(spring(), 1.0, 0.0, {"k": k}, ts=TS, rtol=1e-10, atol=1e-10)


LEVEL, REST = {"x": 2.0, "y": 0.0}, {"x": 0.0, "y": 0.0}
# A function of k, its value and its slope.
ASKED = {
    "accelerations": (lambda k: lj.accelerations(on_a_rod(), 0.0, LEVEL, REST, {"k": k})[0]["y"], lambda k: (-k, -1.0)),
    "between outputs": (
        lambda k: motion(k).at(0.3).q,
        lambda k: (np.cos(0.3 * np.sqrt(k / 2)), -0.3 * np.sin(0.3 * np.sqrt(k / 2)) / np.sqrt(8 * k)),
    ),
    "the period of an orbit": (
        lambda k: lj.periodic_orbit(spring(), (1.0, 0.0), 3.2, {"k": k}).period,
        lambda k: (2 * np.pi * np.sqrt(2 / k), -np.pi * np.sqrt(2 / k**3)),
    ),
    "the length of a geodesic": (
        lambda k: lj.geodesic(plane(), {"a": 0.0, "b": 0.0}, {"a": 1.0, "b": 1.0}, {"k": k}).length,
        lambda k: (np.sqrt(1 + k), 0.5 / np.sqrt(1 + k)),
    ),
    "an action": (
        lambda k: lj.action(spring(), motion(k)),
        # L = -cos(2 w t) w²
        lambda k: (
            -np.sqrt(k / 2) * np.sin(np.sqrt(2 * k)) / 2,
            -np.sin(np.sqrt(2 * k)) / (4 * np.sqrt(2 * k)) - np.cos(np.sqrt(2 * k)) / 4,
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", exhaustive_but(("accelerations",), ASKED))
def test_values_and_slopes(what):
    """As in closed form, of one k and of lanes; another k compiles nothing."""
    function, exact = ASKED[what]
    of_one, of_lanes = jax.value_and_grad(function), lambda k: jax.vmap(function)(jnp.stack([k, k + 0.5]))
    of_one(jnp.asarray(7.0)), of_lanes(jnp.asarray(7.0))
    with compiles() as found:
        one, lanes = of_one(jnp.asarray(8.0)), of_lanes(jnp.asarray(8.0))
    assert found == []
    np.testing.assert_allclose(one, exact(8.0), rtol=1e-7)
    np.testing.assert_allclose(lanes, [exact(k)[0] for k in (8.0, 8.5)], rtol=1e-7)
