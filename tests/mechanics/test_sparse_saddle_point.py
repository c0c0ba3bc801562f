"""Large systems of small parts: the banded solve agrees with the dense equations, and forms nothing dense."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import lagjax as lj
from lagjax.jaxtools import length
from lagjax.mechanics import sparse_saddle_point
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.system import constraints, coordinates
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import in_numpy
from tests.large_systems import bars, chain, links, loop, net, particles


def dense_equations(system, q, v, params):
    """M, F, A and gamma as arrays."""

    def matrices(*state):
        model = model_of(system, *state)
        t, x, u = state[0], *model.vectors(*state[1:3])
        linear = mass_and_forcing(model, t, x, u)
        return (linear.mass, linear.forcing, *constraints.acceleration_rows(model, t, x, u))

    return matrices(*coordinates.state(0.0, q, v, params))


def dense_solution(system, q, v, params):
    """a and the shortest multipliers, by least squares, refined twice instead of in extended precision."""
    mass, forcing, rows, gamma = in_numpy(lambda *state: dense_equations(system, *state))(q, v, params)
    n, m = len(forcing), len(gamma)
    matrix = np.block([[mass, rows.T], [rows, np.zeros((m, m))]])
    known, inverted = np.concatenate([forcing, gamma]), np.linalg.pinv(matrix, rcond=1e-12)
    solution = np.zeros(n + m)
    for _ in range(3):
        solution = solution + inverted @ (known - (matrix.astype(np.longdouble) @ solution)).astype(float)
    return solution[:n], -solution[n:]


def of_library(system, q, v, params):
    """a and the stacked multipliers of `lj.accelerations`."""
    a, multipliers = lj.accelerations(system, 0.0, q, v, params)
    return np.ravel(a), np.concatenate([np.atleast_1d(x) for x in multipliers.values()])


def planned(system, q, v, params):
    """The plan for a system; None if it is solved densely."""
    return sparse_saddle_point.plan(model_of(system, *coordinates.state(0.0, q, v, params)))


def with_masses(masses):
    """A chain with these masses."""
    system, q, v, params = chain(len(masses))
    return system, q, v, params | {"m": jnp.asarray(masses)}


def wavy_links(t, q, params):
    """The links of a chain whose lengths change with the place, by a function of many operations."""
    waves = sum(1e-3 / k * jnp.sin(k * q[1:, 0]) for k in range(1, 21))
    return jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1) - 1 + waves


def wavy(count):
    """A free chain of such links."""
    place = jnp.arange(float(count))
    q, v = jnp.stack([0.8 * place, 0.6 * place], axis=1), jnp.stack([jnp.sin(place), jnp.zeros(count)], axis=1)
    system = lj.System(particles, {"links": lj.Holonomic(wavy_links)})
    return system, q, v, {"m": jnp.linspace(1.0, 2.0, count), "g": 9.81}


def largest(x):
    """The largest entry."""
    return np.max(np.abs(x))


CASES = {
    "chain": lambda: chain(12),
    "loop": lambda: loop(12),
    "net": lambda: net(4, 3),
    "bars": lambda: bars(8),
    "long links": lambda: wavy(12),
    "mass ratio 1e6": lambda: with_masses(np.where(np.arange(12) % 2, 1.0, 1e-6)),
    "massless between others": lambda: with_masses(np.where(np.arange(12) % 3 == 1, 0.0, 1.0)),
}


RARELY = {"net": "exhaustive", "bars": "exhaustive", "long links": "slow", "loop": "slow"}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=getattr(pytest.mark, RARELY[x])) if x in RARELY else x for x in CASES]
)
def test_same_as_dense(name):
    """Accelerations and multipliers of chain, loop, net and jointed bars are those of the dense equations."""
    case = CASES[name]()
    assert planned(*case) is not None
    expected, found = dense_solution(*case), of_library(*case)
    # One refinement corrects the masses that replace vanishing ones, to this tolerance.
    tolerance = 1e-10 if name.startswith("massless") else 1e-12
    for x, y in zip(found, expected):
        assert largest(x - y) <= tolerance * largest(y)


def doubled(count):
    """A chain whose every other link is given again in another scale, and one more as a sum of two."""
    system, q, v, params = chain(count)
    again = lambda t, q, params: 3 * links(t, q, params)[::2]
    total = lambda t, q, params: links(t, q, params)[2] + 2 * links(t, q, params)[3]
    extra = {"again": lj.Holonomic(again), "total": lj.Holonomic(total)}
    return lj.System(particles, system.constraints | extra), q, v, params


@pytest.mark.exhaustive
def test_redundant_constraints_have_the_shortest_multipliers():
    """With rows that depend on others the accelerations are the same, and the multipliers those of least squares."""
    case = doubled(10)
    assert planned(*case) is not None
    expected, found = dense_solution(*case), of_library(*case)
    for x, y in zip(found, expected):
        assert largest(x - y) <= 1e-10 * largest(y)
    alone, _ = of_library(*chain(10))
    assert largest(found[0] - alone) <= 1e-11 * largest(alone)


def test_undetermined_is_refused():
    """A massless end hangs on one link: its acceleration across it is not determined, and an error says so."""
    system, q, v, params = with_masses(np.append(np.ones(11), 0.0))
    with pytest.raises(ValueError, match="singular"):
        lj.accelerations(system, 0.0, q, v, params)


def acceleration(system, q, v):
    """The sparse solution as a function of gravity and of the length, and the dense one."""

    def sparse(params):
        state = jnp.asarray(0.0), q, v
        a, multipliers = equations_of(model_of(system, *state, params)).accelerations(*state)
        return jnp.concatenate([a.ravel(), multipliers["links"]])

    def dense(params):
        mass, forcing, rows, gamma = dense_equations(system, q, v, params)
        zero = jnp.zeros((gamma.size, gamma.size))
        solution = jnp.linalg.solve(jnp.block([[mass, rows.T], [rows, zero]]), jnp.concatenate([forcing, gamma]))
        return jnp.concatenate([solution[: forcing.size], -solution[forcing.size :]])

    return sparse, dense


@pytest.mark.exhaustive
def test_derivatives_in_both_modes():
    """Derivatives by every mass, forward and reverse, are those of the dense equations."""
    system, q, v, params = chain(8)
    assert planned(system, q, v, params) is not None
    sparse, dense = acceleration(system, q, v)
    of = lambda f: lambda m: f(params | {"m": m})
    expected = jax.jit(jax.jacfwd(of(dense)))(params["m"])
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(
            jax.jit(mode(of(sparse)))(params["m"]), expected, rtol=0, atol=1e-11 * largest(expected)
        )


def largest_array(function, *args):
    """The largest number of entries of any intermediate value of a function."""

    def sizes(jaxpr):
        for equation in jaxpr.eqns:
            yield from (x.aval.size for x in equation.outvars if hasattr(x.aval, "size"))
            for inner in jaxprs_in_params(equation.params):
                yield from sizes(inner)

    return max(sizes(jax.make_jaxpr(function)(*args).jaxpr))


def running(system, q, v, params):
    """One evaluation of the equations of motion, and its arguments."""
    s = coordinates.state(0.0, q, v, params)
    return lambda t, q, v, params: equations_of(model_of(system, t, q, v, params)).accelerations(t, q, v), *s


def test_nothing_dense_is_formed():
    """With 40 links no array has 40 × 40 entries; twin: one has if a loop hides which link touches which."""
    assert largest_array(*running(*chain(40))) < 40 * 40
    system, q, v, params = chain(40)
    hidden = lambda t, q, params: jax.lax.scan(lambda c, x: (c, x + c), 0.0, links(t, q, params))[1]
    scanned = lj.System(particles, {"links": lj.Holonomic(hidden)})
    assert planned(scanned, q, v, params) is None
    assert largest_array(*running(scanned, q, v, params)) >= 80 * 80


def test_small_and_entangled_systems_are_solved_densely():
    """Small systems, a mass matrix that couples all velocities, or multipliers that all touch have no plan."""
    assert planned(*chain(7)) is None and planned(*chain(8)) is not None
    system, q, v, params = chain(12)
    coupled = lambda t, q, v, params: particles(t, q, jnp.cumsum(v, axis=0), params)
    assert planned(lj.System(coupled, system.constraints), q, v, params) is None
    around = lj.Holonomic(lambda t, q, params: jnp.sum((q[1:] - q[:1]) ** 2, axis=1) - 1.0)
    assert planned(lj.System(particles, {"around": around}), q, v, params) is None


def test_without_constraints():
    """Free particles are solved by the diagonal of M, and a vanishing mass raises."""
    _, q, v, params = chain(20)
    free = lj.System(particles)
    assert planned(free, q, v, params).band is None
    a, _ = lj.accelerations(free, 0.0, q, v, params)
    np.testing.assert_allclose(a, np.broadcast_to([0.0, -9.81], (20, 2)), rtol=1e-14)
    with pytest.raises(ValueError, match="singular"):
        lj.accelerations(free, 0.0, q, v, params | {"m": np.where(np.arange(20) == 3, 0.0, params["m"])})


@pytest.mark.slow
def test_long_constraints_are_derived_once(monkeypatch):
    """A and M are numbers where their functions are long: less than half of a program that calls these."""
    system, *state = wavy(12)
    t, q, v, params = coordinates.state(0.0, *state)
    model = model_of(system, t, q, v, params)
    plan = sparse_saddle_point.plan(model)
    assert plan is not None

    def operations():
        def program(*state):
            return sparse_saddle_point.Banded(plan).verdict(model, *state)[:2]

        return length(jax.make_jaxpr(program)(t, *model.vectors(q, v)).jaxpr)

    few = operations()
    monkeypatch.setattr(sparse_saddle_point, "SHORT", 10**9)
    assert 2 * few < operations()
