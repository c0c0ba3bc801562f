"""Hamilton's function and equations against closed forms and Lagrange's equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

Q = np.array([0.25, 0.5, -0.125])


P = np.array([3.0, 1.0, -2.0])


def relativistic(t, q, v, params):
    """A relativistic particle on a spring whose stiffness grows with time."""
    m, c = params["m"], params["c"]
    return -m * c**2 * jnp.sqrt(1 - v @ v / c**2) - 0.5 * params["k"] * (1 + t) * q @ q


def magnetic(t, q, v, params):
    """A charge in a uniform magnetic field along z and an oscillating electric field along x."""
    B, m = params["B"], params["m"]
    return 0.5 * m * v @ v + 0.5 * B * (q[0] * v[1] - q[1] * v[0]) + jnp.cos(t) * q[0]


FAST, CHARGE = lj.System(relativistic), lj.System(magnetic)
OF_FAST, OF_CHARGE = {"m": 1.25, "c": 2.0, "k": 0.75}, {"m": 1.5, "B": 2.5}


def exact_fast(q, p, t, params):
    """√(p²c² + m²c⁴) + V."""
    m, c = params["m"], params["c"]
    return jnp.sqrt(p @ p * c**2 + m**2 * c**4) + 0.5 * params["k"] * (1 + t) * q @ q


def exact_charge(q, p, t, params):
    """(p - A)²/2m + V, with A = B/2 (-y, x, 0)."""
    A = 0.5 * params["B"] * jnp.stack([-q[1], q[0], 0.0 * q[2]])
    return (p - A) @ (p - A) / (2 * params["m"]) - jnp.cos(t) * q[0]


@pytest.mark.parametrize(
    "system, exact, params, order",
    [(CHARGE, exact_charge, OF_CHARGE, 1),
     *(pytest.param(*x, 2, marks=pytest.mark.exhaustive)
       for x in ((FAST, exact_fast, OF_FAST), (CHARGE, exact_charge, OF_CHARGE)))],
    ids=["charge", "fast", "more of the charge"],
)  # fmt: skip
def test_hamiltonians_in_closed_form(system, exact, params, order):
    """H and its first and second derivatives; Hamilton's equations agree with Lagrange's. Twin: a wrong sign."""
    H, t = lj.hamiltonian(system), 0.5

    @jax.jit
    def both(q, p):
        first = lambda f: jax.value_and_grad(f, argnums=(0, 1))(q, p)
        second = lambda f: jax.jacfwd(jax.grad(f, argnums=1), argnums=(0, 1))(q, p)
        at = lambda f: (*first(f), second(f) if order > 1 else None)
        mass = lambda f: jax.grad(lambda m: f(params | {"m": m}))(params["m"]) if order > 1 else None
        found = at(lambda q, p: H(t, q, p, params)), mass(lambda params: H(t, q, p, params))
        known = at(lambda q, p: exact(q, p, t, params)), mass(lambda params: exact(q, p, t, params))
        v = H.velocity(t, q, p, params)
        a = lj.accelerations(system, t, q, v, params)[0]
        momentum = lambda t, q, v: lj.momentum(system, t, q, v, params)
        p_again, p_rate = jax.jvp(momentum, (jnp.asarray(t), q, v), (jnp.ones(()), v, a))
        return found, known, (p_again, (v, p_rate), H.rates(t, q, p, params), found[0][1])

    found, known, (p_again, lagrange, hamilton, slopes) = both(Q, P)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(known)):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(p_again, P, rtol=1e-13)
    for one, other, slope in zip(lagrange, hamilton, (slopes[1], -slopes[0])):
        np.testing.assert_allclose(one, other, atol=1e-12)
        np.testing.assert_allclose(one, slope, atol=1e-12)
    assert np.max(np.abs(lagrange[1] - slopes[0])) > 0.1


@pytest.mark.slow
def test_forces_and_batches():
    """In a dict with friction ṗ is Lagrange's, lane by lane in a batch; NaN if no velocity has the momentum."""
    friction = lambda t, q, v, params: 0.25 * (v["x"] ** 2 + v["y"] ** 2)
    cosh = lambda t, q, v, params: jnp.log(jnp.cosh(v["x"])) + 0.5 * v["y"] ** 2 - q["x"] * q["y"]
    H = lj.hamiltonian(lj.System(cosh, dissipation=friction))
    q = {"x": 0.5, "y": 0.25}
    rates = jax.jit(jax.vmap(lambda x: H.rates(0.0, q, {"x": x, "y": 1.0}, None)))(np.array([0.5, -0.9, 1.5]))
    exact = np.arctanh([0.5, -0.9])
    np.testing.assert_allclose(rates[0]["x"][:2], exact, rtol=1e-12)
    np.testing.assert_allclose(rates[1]["x"][:2], -0.25 - 0.5 * exact, rtol=1e-12)
    assert np.isnan(rates[0]["x"][2])
    with pytest.raises(ValueError, match="no velocity was found that has this momentum"):
        H(0.0, q, {"x": 1.5, "y": 1.0}, None)


def test_a_degenerate_lagrangian_is_named():
    """The error names the coordinate whose velocity is undetermined; systems with constraints are refused."""
    linear = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 + q["x"] * v["y"])
    state = 0.0, {"x": 1.0, "y": 1.0}, {"x": 1.0, "y": 1.0}, None
    with pytest.raises(ValueError, match="L is degenerate in 'y'"):
        lj.hamiltonian(linear)(*state)
    assert np.isnan(jax.jit(lambda x: lj.hamiltonian(linear)(0.0, {"x": x, "y": 1.0}, *state[2:]))(1.0))
    free = lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2)
    held = lj.System(free, {"line": lj.Holonomic(lambda t, q, params: q["x"] - q["y"])})
    with pytest.raises(ValueError, match="Hamilton's equations need free coordinates"):
        lj.hamiltonian(held).rates(*state)
    with pytest.raises(TypeError, match="first argument must be a lj.System"):
        lj.hamiltonian(free)
