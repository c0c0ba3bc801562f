"""Integers as coordinates, velocities and times become floats in every function: bit for bit, without recompiling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import coordinates
from tests.counting import compiles
from tests.systems import TS as FOUR
from tests.systems import rod_pendulum
from tests.tiers import exhaustive_but

PARAMS = {"g": 3.0, "k": 2.0}
Q, V, REST = {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 2.0}, {"x": 0.0, "y": 0.0}
TS = np.linspace(0.0, 1.0, 3)
T = np.linspace(0.0, 1.0, 12)
AS = {
    "Python's": lambda tree: jax.tree.map(int, tree),
    "NumPy's": lambda tree: jax.tree.map(np.int32, tree),
    "arrays": lambda tree: jax.tree.map(lambda x: np.asarray(x, np.int16), tree),
    "JAX's": lambda tree: jax.tree.map(lambda x: jnp.asarray(x, int), tree),
    "one of them": lambda tree: tree | {"x": int(tree["x"])},
}


def springs(t, q, v, params):
    """A point between springs, with a weight."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"] - 0.5 * params["k"] * (q["x"] ** 2 + q["y"] ** 2)


system = lj.System(springs)
rod = lj.System(springs, {"rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - 1.0)})
turning = lj.Generator(lambda t, q, params: {"x": -q["y"], "y": q["x"]}, name="L_z")
by_name = lambda name, of=system: lambda q, v: getattr(lj, name)(of, 0, q, v, PARAMS)
QUICK = {
    "momentum": by_name("momentum"),
    "mass_matrix": by_name("mass_matrix"),
    "jacobi_integral": by_name("jacobi_integral"),
    "accelerations": by_name("accelerations"),
    "constraint_residual": by_name("constraint_residual", rod),
    "inverse_dynamics": lambda q, v: lj.inverse_dynamics(system, 0, q, v, q, PARAMS)[0],
    "noether_charge": lambda q, v: lj.noether_charge(system, turning)(0, q, v, PARAMS),
    "integrate": lambda q, v: lj.integrate(rod_pendulum, q, v, {"g": 3.0, "l": 1.0}, ts=FOUR).q,
    "in a program": lambda q, v: jax.jit(lambda q, v: lj.momentum(system, 0, q, v, PARAMS))(q, v),
}
LONG = {
    "action": lambda q, v: lj.action(system, lambda t: {"x": t, "y": q["y"]}, PARAMS, 0, 1),
    "constraint_force": by_name("constraint_force", rod),
    "consistent_state": by_name("consistent_state", rod),
    "explain": lambda q, v: lj.explain(rod, 0, q, v, PARAMS).degrees_of_freedom,
    "on a rod": lambda q, v: lj.integrate(rod, q, v, PARAMS, ts=[0, 1]).multipliers,
    "in phases": lambda q, v: lj.integrate(lj.Hybrid({"a": system}), q, v, PARAMS, ts=[0, 1]).q,
    "poincare": lambda q, v: lj.poincare(system, q, v, PARAMS, section=lambda t, q, v, params: q["x"], ts=[0, 5]).v,
    "in lanes": lambda q, v: jax.vmap(lambda x: lj.integrate(system, {"x": x, "y": 0}, v, PARAMS, ts=TS).q)(
        jnp.stack([jnp.asarray(q["x"])] * 2)),
    "a derivative": lambda q, v: jax.grad(
        lambda k: lj.integrate(system, q, v, PARAMS | {"k": k}, ts=TS).q["y"][-1])(2.0),
    "an axis": lambda q, v: lj.sweep(
        lambda point: lj.integrate(system, {"x": point["x"], "y": 0}, {"x": 0, "y": 0}, PARAMS, ts=TS).q["x"][-1],
        {"x": np.stack([np.asarray(q["x"])] * 2)}, progress=False).values,
    "is_symmetry": lambda q, v: lj.is_symmetry(system, turning, q, v, PARAMS).residual,
    "symmetries": lambda q, v: len(lj.symmetries(system, q, v, PARAMS)),
    "hamiltonian": lambda q, v: lj.hamiltonian(system)(0, q, v, PARAMS),
    "equilibria": lambda q, v: lj.equilibria(system, PARAMS, starts=[q]).q,
    "continue_equilibria": lambda q, v: lj.continue_equilibria(system, PARAMS, q, along="k", to=3)[0].q,
    "linearise": lambda q, v: lj.linearise(system, 0, {"x": q["y"], "y": -1.5}, {"x": 0, "y": 0}, PARAMS).stiffness,
    "normal_modes": lambda q, v: lj.normal_modes(system, 0, {"x": q["y"], "y": -1.5}, {"x": 0, "y": 0}, PARAMS).roots,
    "periodic_orbit": lambda q, v: lj.periodic_orbit(system, (q, v), 4.44, PARAMS).period,
    "lyapunov_exponents": lambda q, v: lj.lyapunov_exponents(system, q, v, PARAMS, ts=range(30)).exponents,
    "a fit": lambda q, v: lj.fit(system, lj.Record(T, q={"x": np.cos(T), "y": T}, q0=q, v0=v, hold_q=True), PARAMS,
                                 free="k", progress=False).params["k"],
}  # fmt: skip


def agree(act, kinds):
    """Compare results for integers with those for floats."""
    expected = jax.tree.map(np.asarray, act(Q, V))
    assert jax.tree.leaves(expected)
    for kind in kinds:
        found = jax.tree.map(np.asarray, act(AS[kind](Q), AS[kind](V)))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        assert jax.tree.map(lambda x: x.dtype, found) == jax.tree.map(lambda x: x.dtype, expected)


@pytest.mark.parametrize("door", QUICK)
def test_at_one_state(door):
    """Integers of Python, NumPy and JAX, alone or together with a float."""
    agree(QUICK[door], AS)


# One program of each kind; the others compile for long.
KEPT = ("action", "constraint_force", "on a rod", "equilibria", "linearise", "normal_modes", "symmetries")


@pytest.mark.slow
@pytest.mark.parametrize("door", exhaustive_but(KEPT, LONG))
def test_at_every_door(door):
    """Motions, lanes, derivatives, sweeps, fits, and analyses of a system."""
    agree(LONG[door], ("Python's", "JAX's"))


def test_the_comparison_can_fail():
    """Twin: another number, and a function that keeps integers, are detected."""
    with pytest.raises(AssertionError):
        agree(lambda q, v: q["x"] + isinstance(q["x"], int), ("Python's",))
    with pytest.raises(AssertionError):
        agree(lambda q, v: q["x"], ("NumPy's",))


def test_nothing_is_compiled_anew():
    """The program compiled for floats is used for integers."""
    QUICK["integrate"](Q, V)
    with compiles() as found:
        QUICK["integrate"](AS["Python's"](Q), AS["NumPy's"](V))
    assert found == []


def test_the_dtype_is_that_of_the_floats():
    """Integers become float32 next to float32, else the default, also beyond int64. Booleans are refused."""
    of = lambda q: coordinates.state(0, q, jax.tree.map(np.zeros_like, q), None).q
    assert {x.dtype for x in of({"x": np.float32(1.0), "y": np.int64(2)}).values()} == {np.dtype("float32")}
    assert of({"x": 1, "y": np.int8(2)})["y"].dtype == np.float64
    assert float(coordinates.state(0, 10**30, 0, None).q) == 1e30
    for q in (True, np.array(True), jnp.array([True])):
        with pytest.raises(TypeError, match="is bool"):
            of(q)


def test_whole_parameters_stay():
    """An integer in params stays an integer: it may set a shape."""
    counted = lj.System(lambda t, q, v, params: 0.5 * v**2 - sum(q**i for i in range(1, params["n"])))
    assert float(lj.accelerations(counted, 0, 1, 0, {"n": 3})[0]) == -3.0
