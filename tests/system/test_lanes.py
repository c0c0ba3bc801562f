"""Functions of one kind in lanes, against the same functions called one by one, and how long their programs are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.jaxtools import length
from lagjax.system import constraints, prepare
from lagjax.system.traced import opened, vectors
from tests.jaxtools.in_numpy import evaluated

RNG = np.random.default_rng(5)
T, PARAMS = np.array(0.4), {"k": np.array(1.5)}
Q = {name: RNG.normal(size=3) for name in "abcd"}
X = np.concatenate(list(Q.values()))


def rod(first, second, size, along):
    """A residual of a dozen operations with numbers, an array and entries of its own; two equations."""

    def g(t, q, params):
        way = q[second] - q[first] - jnp.asarray(along, t.dtype) * t
        return jnp.stack([jnp.dot(way, way) - params["k"] * size**2, jnp.sin(way[0]) * way[1] - size * t])

    return g


def rod_in_numbers(first, second, size, along):
    """The same by hand."""
    way = Q[second] - Q[first] - np.asarray(along) * 0.4
    return [way @ way - 1.5 * size**2, np.sin(way[0]) * way[1] - size * 0.4]


RODS = [("a", "b", 0.5, (1.0, 0.0, 2.0)), ("b", "c", -0.7, (0.0, 3.0, 0.0)), ("d", "a", 2.0, (0.0, 0.0, 0.0))]


def model_of(functions):
    """A system of four points with these constraints."""
    system = lj.System(
        lambda t, q, v, params: 0.5 * sum(jnp.sum(x**2) for x in v.values()),
        {f"c{i}": lj.Holonomic(g) for i, g in enumerate(functions)},
    )
    return prepare(system, T, Q, jax.tree.map(np.ones_like, Q), PARAMS)[0]


def values(functions, *state):
    """The values of functions in lanes at a state."""
    return evaluated(lambda *state: vectors(functions, state), *state)


def functions_of(model):
    """The constraints' functions as the library calls them."""
    return [c.g for c in model.system.constraints.values()]


def test_functions_of_one_kind():
    """Each has the value by hand, in its place beside one of another kind, and they are one program, also in floats
    of four bytes and in lanes of a batch; twin: numbers of another function."""
    other = lambda t, q, params: q["c"][0] ** 3
    model = model_of([*(rod(*x) for x in RODS[:2]), other, rod(*RODS[2])])
    first, second, alone, third = functions_of(model)
    meanings = {opened(f.program.jaxpr).meaning for f in (first, second, third)}
    assert len(meanings) == 1 and opened(alone.program.jaxpr).meaning not in meanings
    found = values([first, second, alone, third], T, Q, model.params)
    expected = [rod_in_numbers(*x) for x in RODS]
    expected.insert(2, [Q["c"][0] ** 3])
    for value, wanted in zip(found, expected):
        np.testing.assert_allclose(value, wanted, rtol=1e-14, atol=1e-14)
    assert np.abs(np.asarray(found[0]) - expected[1]).max() > 0.1

    (batch,) = evaluated(jax.vmap(lambda x: constraints.position_residual(model, T, x)), np.stack([X, 2 * X]))
    np.testing.assert_allclose(batch[0], np.concatenate(expected), rtol=1e-14, atol=1e-14)
    small = jax.tree.map(lambda x: np.asarray(x, np.float32), (T, Q, model.params))
    of_small, _ = prepare(model.system, small[0], *2 * [small[1]], small[2])
    for value, wanted in zip(values(functions_of(of_small), *small), expected):
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, wanted, rtol=1e-5, atol=1e-5)


def test_derivatives():
    """A, gamma and reverse mode of functions in lanes are those of one function of all, written by hand."""
    separate = model_of([rod(*x) for x in RODS])
    whole = model_of([lambda t, q, params: jnp.concatenate([rod(*x)(t, q, params) for x in RODS])])
    u = RNG.normal(size=12)

    def of(model):
        square = lambda x: jnp.sum(constraints.position_residual(model, T, x) ** 2)
        return lambda x, u: (constraints.acceleration_rows(model, T, x, u), jax.grad(square)(x))

    for found, expected in zip(*(evaluated(of(model), X, u) for model in (separate, whole)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_what_stays_alone():
    """Loops and functions with rules of their own; functions with other whole numbers, which may be places, are not of
    one kind, and those that are the same function still have a place each."""

    @jax.custom_jvp
    def with_rule(x):
        return jnp.sin(x) * jnp.cos(x)

    with_rule.defjvp(lambda primals, tangents: (with_rule(*primals), 7.0 * tangents[0]))
    loop = lambda t, q, params: jax.lax.fori_loop(0, 3, lambda i, x: x * q["b"][0], q["a"][0])
    rule = lambda t, q, params: with_rule(q["a"][0] * 2.0) + jnp.sum(q["b"] ** 2 - 3.0)
    for f in functions_of(model_of([loop, rule])):
        assert opened(f.program.jaxpr) is None
    entry = lambda i: lambda t, q, params: jnp.take(q["a"], jnp.asarray([i])) * 3.0 - jnp.sin(t) * jnp.cos(t) / 2.0
    model = model_of([entry(i) for i in (0, 2, 2, 0, 1)])
    found = values(functions_of(model), T, Q, model.params)
    expected = [3.0 * Q["a"][i] - np.sin(0.8) / 4 for i in (0, 2, 2, 0, 1)]
    np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-14)


def chain(count):
    """Bodies that hang on each other by balls in sockets."""
    bodies = [lj.bodies.Body(f"b{i}", 1.0 + 0.1 * i, (0.1, 0.11, 0.02)) for i in range(count)]
    above = [lj.bodies.ground.at(), *(body.at((0.0, 0.0, -0.5)) for body in bodies)]
    joints = {
        f"j{i}": lj.bodies.spherical(a, body.at((0.0, 0.0, 0.5))) for i, (a, body) in enumerate(zip(above, bodies))
    }
    q = {body.name: lj.bodies.Pose.at((0.0, 0.0, -0.5 - i)) for i, body in enumerate(bodies)}
    v = {name: pose.moving() for name, pose in q.items()}
    return prepare(lj.bodies.multibody(bodies, joints, [lj.bodies.weight(bodies)]), 0.0, q, v, None)


@pytest.mark.parametrize("what", ["L", "forcing and mass", "constraints", "A and gamma"])
def test_the_length_of_a_program_of_bodies(what):
    """A chain of eight bodies has a program less than 1.3 times as long as one of three: that of its kinds."""

    def operations(count):
        model, s = chain(count)
        t, (x, u) = s.t, model.vectors(s.q, s.v)
        function = {
            "L": model.lagrangian,
            "forcing and mass": jax.grad(model.lagrangian, argnums=(1, 2)),
            "constraints": lambda t, x, u: constraints.position_residual(model, t, x),
            "A and gamma": lambda t, x, u: constraints.acceleration_rows(model, t, x, u),
        }[what]
        return length(jax.make_jaxpr(function)(t, x, u).jaxpr)

    assert operations(8) < 1.3 * operations(3)
