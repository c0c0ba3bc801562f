"""`lj.connect` through phases and contacts: throws that reach their target with and without a bounce."""

import jax
import numpy as np
import pytest

import lagjax as lj

pytestmark = pytest.mark.slow

E, START, TARGET = 0.5, {"x": 0.0, "y": 1.0}, {"x": 2.0, "y": 0.3}


def thrown(t, q, v, p):
    """A ball in a plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p * q["y"]


above = lambda t, q, p: q["y"]
in_elements = lj.System(thrown, elements={"floor": lj.Contact(above, E)})
bounce = lj.Switch("flying", to="flying", when=lj.guards.touches(above, E))
in_a_phase = lj.Hybrid({"flying": lj.System(thrown)}, [bounce])


def height(up, g):
    """The height after a time of one of what is thrown upward at this speed from one, with its bounce if it has one."""
    w = np.sqrt(up**2 + 2 * g)
    hits = (up + w) / g
    if hits > 1:
        return 1 + up - g / 2
    return E * w * (1 - hits) - g / 2 * (1 - hits) ** 2


@pytest.mark.parametrize("system", [in_elements, in_a_phase], ids=["contact", "phase"])
def test_throws(system):
    """All three are found: over, and down onto the floor and up, with one bounce early or late. Twin: at another g."""
    found = lj.connect(system, START, TARGET, 0.0, 1.0, 10.0, starts=6)
    ups = [float(x.start_velocity["y"]) for x in (found, *found.others)]
    np.testing.assert_allclose([height(up, 10.0) for up in ups], 0.3, atol=1e-12)
    assert sorted(len(getattr(x.trajectory, "switches")) for x in (found, *found.others)) == [0, 1, 1]
    assert abs(height(ups[1], 10.1) - 0.3) > 1e-3
    assert found.converged and "there are" in found.kind and np.isnan(found.action)


@pytest.mark.exhaustive
def test_derivatives_of_a_throw():
    """Over the floor: up = 0.3 - 1 + g/2; and in lanes, each of which finds one of the throws."""

    def up(g):
        return lj.connect(in_a_phase, START, TARGET, 0.0, 1.0, g).start_velocity["y"]

    np.testing.assert_allclose(jax.grad(up)(10.0), 0.5, rtol=1e-9)
    weights = np.array([9.0, 10.0])
    found = jax.vmap(up)(weights)
    np.testing.assert_allclose([height(u, g) for u, g in zip(found, weights)], 0.3, atol=1e-11)
