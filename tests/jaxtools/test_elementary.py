"""Sine and cosine by arithmetic: errors below a unit in the last place; and programs that use them."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax

from lagjax.jaxtools import scalarize
from lagjax.jaxtools.scalarize import ARITHMETIC, sincos, sincos_in_lanes
from tests.jaxtools.in_numpy import evaluated

rng = np.random.default_rng(19)
LIMIT = ARITHMETIC[np.dtype("float64")].limit
WORST = 0.85  # units in the last place; the C library's worst here is 0.55


def neighbours(x):
    """Numbers, those next to them, and all of them negated."""
    x = np.concatenate([np.nextafter(x, -np.inf, dtype=x.dtype), x, np.nextafter(x, np.inf, dtype=x.dtype)])
    return np.concatenate([x, -x])


def multiples(of, up_to, count, dtype):
    """The floating-point numbers next to multiples of an angle: the first few hundred, and some up to the limit."""
    with mpmath.workprec(200):
        angle = of(mpmath.pi)
        ks = np.unique(np.concatenate([np.arange(1, 200), rng.integers(1, int(up_to / float(angle)), count)]))
        return neighbours(np.array([float(int(k) * angle) for k in ks]).astype(dtype))


ARGUMENTS = {
    "one turn": lambda: rng.uniform(-7, 7, 4000),
    "the whole range": lambda: rng.uniform(-LIMIT, LIMIT, 4000),
    "every exponent": lambda: 10 ** rng.uniform(-307, 5, 4000) * rng.choice([-1, 1], 4000),
    "multiples of pi/2": lambda: multiples(lambda pi: pi / 2, LIMIT, 1500, float),
    "odd multiples of pi/4": lambda: multiples(lambda pi: pi / 4, LIMIT, 1500, float),
    "next to what is special": lambda: neighbours(np.array([0.0, 1e-320, 1e-300, 2.0**-27, 1e-5, LIMIT - 1e-9])),
}


def ulps(found, exact, x):
    """The largest error in units in the last place of the exact value, which mpmath computes with 100 extra bits."""
    with mpmath.workprec(160):
        values = [exact(mpmath.mpf(float(a))) for a in x]
        units = np.spacing(np.abs(np.array([float(v) for v in values])))
        errors = [abs(mpmath.mpf(float(f)) - v) / mpmath.mpf(u) for f, v, u in zip(found, values, units)]
        return float(max(errors))


def fused(x):
    """Sine and cosine compiled as one program, in which XLA may fuse products and sums."""
    return jax.jit(lambda x: scalarize._by_arithmetic(x))(x)


def apart(x):
    """Sine and cosine with every operation rounded separately."""
    return evaluated(scalarize._by_arithmetic, x)


@pytest.mark.optimised
@pytest.mark.slow
@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_error_is_below_a_unit_in_the_last_place(arguments):
    """Errors against mpmath, fused by the compiler or not; the public function gives the same values."""
    x = ARGUMENTS[arguments]()
    x = x[np.abs(x) <= LIMIT]
    for pair in (fused, apart, sincos):
        for found, exact in zip(pair(x), (mpmath.sin, mpmath.cos)):
            assert ulps(np.asarray(found), exact, x) < WORST


@pytest.mark.parametrize("parts", [1, 2])
def test_fewer_parts_are_found_out(parts, monkeypatch):
    """Twin: with pi/2 in fewer parts the same arguments show errors of more than a unit."""
    ours = ARITHMETIC[np.dtype("float64")]
    rest = float(np.pi / 2) if parts == 1 else ours.parts[1]
    kept = (rest, 0.0) if parts == 1 else (ours.parts[0], rest)
    monkeypatch.setitem(ARITHMETIC, np.dtype("float64"), ours._replace(parts=kept))
    x = multiples(lambda pi: pi / 2, LIMIT, 200, float)
    assert max(ulps(np.asarray(found), exact, x) for found, exact in zip(fused(x), (mpmath.sin, mpmath.cos))) > 100


def test_beyond_the_limit_the_library_takes_over():
    """With one large argument all values are those of jnp.sin, bit for bit."""
    large = np.concatenate([10 ** rng.uniform(5.001, 308, 500), [1e300, 5.319372648326541e255]])
    mixed = np.append(rng.uniform(-3, 3, 501), 2 * LIMIT)
    both = jax.jit(lambda x: (sincos(x), (jnp.sin(x), jnp.cos(x))))
    for x in (large, -large, mixed):
        assert np.array_equal(*both(x))
    assert ulps(np.asarray(both(large)[0][0]), mpmath.sin, large) < WORST
    # Twin: the arithmetic is wrong there.
    assert not np.allclose(apart(large)[0], np.sin(large))


def test_what_is_not_an_ordinary_number():
    """Infinities and NaN give NaN; zeros keep their sign, and subnormal numbers are their own sines."""
    for pair in (jax.jit(sincos), fused):
        assert np.all(np.isnan(pair(np.array([np.inf, -np.inf, np.nan]))))
        small = np.array([0.0, -0.0, 5e-324, -1e-310])
        sine, cosine = pair(small)
        assert np.array_equal(sine, small) and np.array_equal(np.signbit(sine), np.signbit(small))
        assert np.array_equal(cosine, np.ones(4))


def test_float32():
    """Below a unit in the last place in single precision too, next to multiples of pi/2 and within the range."""
    limit = ARITHMETIC[np.dtype("float32")].limit
    every = multiples(lambda pi: pi / 4, limit, 20000, np.float32)
    drawn = [rng.uniform(-limit, limit, 100000), 10 ** rng.uniform(-37, 3, 100000)]
    x = np.concatenate([every, *drawn]).astype(np.float32)
    x = x[np.abs(x) <= limit]
    for pair in (fused, apart, sincos):
        for found, exact in zip(pair(x), (np.sin, np.cos)):
            assert found.dtype == np.float32
            exact = exact(x.astype(float))
            units = np.spacing(np.abs(exact).astype(np.float32)).astype(float)
            assert np.max(np.abs(np.asarray(found, float) - exact) / units) < WORST


@pytest.mark.slow
def test_derivatives():
    """First and second derivatives, both modes, alone and in lanes, within and beyond the limit, equal those of jnp."""
    near = rng.uniform(-3, 3, 5)
    for derive in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f)), lambda f: jax.grad(jax.grad(f))):
        for i, library in enumerate((jnp.sin, jnp.cos)):
            ours = derive(lambda x: sincos(x)[i])
            lanes, expected = jax.jit(jax.vmap(ours)), jax.vmap(derive(library))
            for x in (near, 10 * LIMIT * near):
                assert np.allclose(lanes(x), expected(x), rtol=0, atol=1e-15)
            assert np.isclose(jax.jit(ours)(near[0]), expected(near)[0], rtol=0, atol=1e-15)


def equations(jaxpr, name):
    """The number of equations of a name in a jaxpr, including its calls but not its branches."""
    inner = [p.jaxpr for eqn in jaxpr.eqns if eqn.primitive.name != "cond" for p in eqn.params.values()
             if hasattr(p, "jaxpr")]  # fmt: skip
    return sum(eqn.primitive.name == name for eqn in jaxpr.eqns) + sum(equations(j, name) for j in inner)


def count(function, name, *args):
    """The number of equations of a name in a function."""
    return equations(jax.make_jaxpr(function)(*args).jaxpr, name)


def test_in_lanes_the_branch_stays_a_branch():
    """Under vmap the library is called only in a branch, chosen for all lanes together."""
    x = rng.uniform(-3, 3, 6)
    assert count(jax.vmap(lambda x: sincos(x)[0]), "sin", x) == 0
    # Twin: a branch on a lane's own argument becomes a select that computes both.
    alone = lambda x: lax.cond(x > LIMIT, jnp.sin, lambda x: sincos(x)[0], x)
    assert count(jax.vmap(alone), "sin", x) == 1


@pytest.mark.slow
def test_by_the_library_alone_by_arithmetic_in_lanes():
    """A single number has libm's values; lanes agree to round-off, with first and second derivatives in both modes."""
    x = rng.uniform(-9, 9, 50)
    assert tuple(jax.jit(sincos_in_lanes)(x[0])) == tuple(jax.jit(lambda x: (jnp.sin(x), jnp.cos(x)))(x[0]))
    for change in (lambda f: f, jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        ours, libm = (jax.vmap(change(f))(x) for f in (lambda x: sincos_in_lanes(x)[0] ** 2, lambda x: jnp.sin(x) ** 2))
        np.testing.assert_allclose(ours, libm, atol=1e-15)
    assert not np.array_equal(jax.vmap(lambda x: sincos_in_lanes(x)[0])(x), np.sin(x))
