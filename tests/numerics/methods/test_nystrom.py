"""Nyström methods: orders, dense output, and where `integrate` uses them."""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.numerics.methods.nystrom import RKN86, RKN1210, Nystrom, Nystrom8, Nystrom12

ENDS = (0.0, 5.0)
name_of = lambda x: type(x).__name__ + " in a loop" * x.in_a_loop if isinstance(x, Nystrom) else None


def swing(t, y, args):
    """A driven pendulum."""
    q, v = y
    return v, {"angle": -jnp.sin(q["angle"]) + 0.1 * jnp.cos(2 * t)}


def solve(method, controller, ts=None, dt0=None):
    """The pendulum from 1 rad."""
    angle = lambda x: {"angle": jnp.asarray(x)}
    return diffrax.diffeqsolve(
        diffrax.ODETerm(swing), method, *ENDS, dt0, (angle(1.0), angle(0.0)),
        saveat=diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts), stepsize_controller=controller,
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact():
    """Angle and rate at 1.3 and at the end, by another method with a far smaller error."""
    integrate = pytest.importorskip("scipy.integrate")
    field = lambda t, y: [y[1], -np.sin(y[0]) + 0.1 * np.cos(2 * t)]
    ends = [
        integrate.solve_ivp(field, (0.0, t), [1.0, 0.0], "DOP853", rtol=1e-13, atol=1e-15).y[:, -1] for t in (1.3, 5.0)
    ]
    return np.array(ends)


class Misprinted(Nystrom8):
    """A method with one row of `a` changed, which keeps its sum c²/2."""

    tableau: ClassVar = RKN86._replace(
        a=(*RKN86.a[:3], tuple(np.add(RKN86.a[3], (0.01, -0.01, 0.0, 0.0))), *RKN86.a[4:])
    )


@pytest.mark.optimised
@pytest.mark.parametrize(
    ("method", "steps", "order"),
    [
        (Nystrom8(), (8, 16), 8),
        (Nystrom8(in_a_loop=True), (8, 16), 8),
        (Nystrom12(), (4, 6), 12),
        (Misprinted(), (20, 40), 3),
    ],
    ids=name_of,
)
def test_order(exact, method, steps, order):
    """The order of angle and rate on a nonlinear problem with explicit time; a misprint in the tableau loses it."""
    end = lambda y: jnp.stack([y[0]["angle"][-1], y[1]["angle"][-1]])
    run = jax.jit(lambda dt: end(solve(method, diffrax.ConstantStepSize(), dt0=dt).ys))
    errors = [np.abs(run(jnp.asarray(ENDS[1] / n)) - exact[1]).max() for n in steps]
    assert abs(np.log(errors[0] / errors[1]) / np.log(steps[1] / steps[0]) - order) < 1.0


@pytest.mark.parametrize("tableau", [RKN86, RKN1210])
def test_weights_are_quadratures(tableau):
    """`sum b' c^k = 1/(k+1)`, `sum b c^k = 1/((k+1)(k+2))`, to the order of each; rows of a sum to c²/2."""
    c = np.array(tableau.c)
    position, velocity = (7, 8) if tableau is RKN86 else (11, 12)
    for k in range(velocity):
        np.testing.assert_allclose(tableau.b_velocity @ c**k, 1 / (k + 1), rtol=1e-13)
    for k in range(position):
        np.testing.assert_allclose(tableau.b_position @ c**k, 1 / (k + 1) / (k + 2), rtol=1e-13)
    np.testing.assert_allclose([sum(row) for row in tableau.a], c[1:] ** 2 / 2, rtol=1e-12)


@pytest.mark.exhaustive
def test_stages_in_a_loop_are_the_same():
    """Each step agrees with that of unrolled stages."""
    fixed = diffrax.ConstantStepSize()
    for method in (Nystrom8, Nystrom12):
        one_by_one, looped = (solve(method(in_a_loop=loop), fixed, dt0=0.25).ys for loop in (False, True))
        np.testing.assert_allclose(looped[0]["angle"], one_by_one[0]["angle"], rtol=1e-14)


def test_dense_output(exact):
    """Dense output of angle and rate has order 5 or more between the steps."""
    run = jax.jit(lambda dt: solve(Nystrom8(), diffrax.ConstantStepSize(), jnp.array([1.3]), dt).ys)
    errors = []
    for n in (25, 75):  # 1.3 is the middle of a step.
        q, v = run(jnp.asarray(ENDS[1] / n))
        errors.append(np.abs(np.array([q["angle"][0], v["angle"][0]]) - exact[0]))
    assert np.all(errors[1] < 1e-4) and np.all(np.log(errors[0] / errors[1]) / np.log(3) > 4.7)


def swinging(**more):
    """A pendulum as a system."""
    return lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q), **more)


POLAR = lj.System(lambda t, q, v, params: 0.5 * (v["r"] ** 2 + (q["r"] * v["φ"]) ** 2) + params["g"] / q["r"])
NETWORK = lj.System(lambda t, q, v, params: 0.5 * v**2 - jnp.sum(jnp.tanh(params["weights"] * q)))
RELATIVISTIC = lj.System(lambda t, q, v, params: -jnp.sqrt(1 - v**2) - params["g"] * q**2)
CASES = [
    (swinging(), 1.0, "Nystrom12"),
    (swinging(force=lambda t, q, v, params: 0.1 * jnp.cos(t)), 1.0, "Nystrom12"),
    (swinging(force=lambda t, q, v, params: -0.1 * v), 1.0, "Dopri8"),
    (swinging(dissipation=lambda t, q, v, params: 0.05 * v**2), 1.0, "Dopri8"),
    (swinging(constraints={"still": lj.Holonomic(lambda t, q, params: q - 1.0)}), 1.0, "Dopri8"),
    (POLAR, {"r": 1.0, "φ": 0.0}, "Dopri8"),
    (RELATIVISTIC, 0.1, "Dopri8"),
    (NETWORK, 0.1, "Nystrom8"),
]


@pytest.mark.parametrize(("system", "q0", "expected"), CASES)
def test_default(system, q0, expected):
    """Used only if accelerations do not depend on velocities, with lower order for a network."""
    v0 = jax.tree.map(lambda x: 0.0, q0)
    params = {"g": 1.0} | ({"weights": np.ones((8, 8))} if system is NETWORK else {})
    run = lambda q0, v0: lj.integrate(system, q0, v0, params, ts=jnp.array([0.0, 0.1]), throw=False)
    assert jax.eval_shape(run, q0, v0).static.method == expected


def layered(p, q):
    """A network of two coordinates."""
    return jnp.sum(jnp.tanh(jnp.tanh(q @ p[0]) @ p[1]))


def structured(t, q, v, p):
    """A mass matrix that depends on q."""
    return 0.5 * (1 + layered(p, q) ** 2) * (v @ v)


LAYERS = [np.ones((2, 8)), np.ones((8, 8))]
# Its shapes alone matter here: random weights would be compiled for seconds, whatever tests are run.
SHAPES = eqx.filter_eval_shape(lambda: eqx.nn.MLP(2, "scalar", 8, 2, jnp.tanh, key=jax.random.key(0)))
MLP = jax.tree.map(lambda x: np.ones(x.shape) if isinstance(x, jax.ShapeDtypeStruct) else x, SHAPES)
SEQUENCE = eqx.nn.Sequential([MLP.layers[0], eqx.nn.Lambda(jnp.tanh), MLP.layers[1], eqx.nn.Lambda(jnp.sum)])
ON_ROD = {"rod": lj.Holonomic(lambda t, q, p: q @ q - 1.0)}
NETWORKS = {
    "matrices": (lj.System(lambda t, q, v, p: 0.5 * (v @ v) - layered(p, q)), LAYERS, "Nystrom8"),
    "MLP": (lj.System(lambda t, q, v, p: 0.5 * (v @ v) - p(q)), MLP, "Nystrom8"),
    "Sequential": (lj.System(lambda t, q, v, p: 0.5 * (v @ v) - p(q)), SEQUENCE, "Nystrom8"),
    "among others": (
        lj.System(lambda t, q, v, p: 0.5 * p["m"] * (v @ v) - p["V"](q)),
        {"m": 1.0, "V": MLP},
        "Nystrom8",
    ),
    "structured": (lj.System(structured), LAYERS, "Dopri8"),
    "on a rod": (lj.System(lambda t, q, v, p: 0.5 * (v @ v) - layered(p, q), ON_ROD), LAYERS, "Dopri8"),
    "too small": (lj.System(lambda t, q, v, p: 0.5 * (v @ v) - layered(p, q)), [np.ones((2, 8)), np.ones(8)], None),
}


def chosen(name, dtype=np.float64, traced=None, **how):
    """What is said of a motion whose method is chosen; `traced` is a tolerance that is not known."""
    system, params, _ = NETWORKS[name]
    q0, v0 = np.array([1.0, 0.0], dtype), np.array([0.0, 1.0], dtype)
    x = jax.tree.map(lambda x: jnp.asarray(x, dtype) if eqx.is_inexact_array_like(x) else x, params)

    def run(q0, v0, traced):
        tolerance = {} if traced is None else {"rtol": traced}
        return lj.integrate(system, q0, v0, x, ts=np.array([0.0, 0.1], dtype), throw=False, **tolerance, **how)

    return jax.eval_shape(run, q0, v0, traced)


@pytest.mark.parametrize("name", NETWORKS)
def test_of_networks(name):
    """Tsit5 at loose tolerances, constraints or not, where there is a network; `explain` says so."""
    system, params, tight = NETWORKS[name]
    loose = "Tsit5, outputs interpolated" if tight else "Nystrom12"
    tight = tight or "Nystrom12"
    found = chosen(name, rtol=1e-6)
    assert found.static.method == loose and chosen(name).static.method == tight
    # Where the motion is continued, by the same method.
    assert type(found.asked.method).__name__ == ("NoneType" if loose == tight else "Tsit5")
    said = repr(lj.explain(system, 0.0, np.array([1.0, 0.0]), np.array([0.0, 1.0]), params))
    assert ("by Tsit5 at rtol of 1e-6 and above" in said) == (loose != tight) and f"stepped by {tight}" in said


def test_which_tolerance_is_loose():
    """The tighter one of several counts, and for a traced one the default of the dtype; interpolated if not fixed."""
    loose, tight = "Tsit5, outputs interpolated", NETWORKS["matrices"][2]
    for rtol, expected in ((9e-7, tight), ((1e-3, 1e-7), tight), ((1e-3, 1e-5), loose)):
        assert chosen("matrices", rtol=rtol).static.method == expected
    assert chosen("matrices", np.float32).static.method == loose
    fixed = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.1)
    assert chosen("matrices", **fixed).static.method == tight
    assert chosen("matrices", np.float32, outputs="exact").static.method == "Tsit5"
    for dtype, expected in ((np.float64, tight), (np.float32, loose)):
        assert chosen("matrices", dtype, np.asarray(1e-5, dtype)).static.method == expected


def test_refused_where_velocities_count():
    """The error gives the reason and a fix."""
    for system, cause in ((RELATIVISTIC, "these do"), (CASES[4][0], "there are constraints")):
        with pytest.raises(ValueError, match=rf"Nystrom8 is for accelerations .* {cause}[\s\S]*method=lj.Dopri8"):
            lj.integrate(system, 1.0, 0.0, {"g": 1.0}, ts=jnp.array([0.0, 0.1]), method=lj.Nystrom8())


@pytest.mark.exhaustive
def test_many_coordinates_and_derivatives():
    """A lattice of forty masses, with arrays and stages in a loop, agrees with Dopri8; derivatives in both modes."""
    springs = lambda q, params: jnp.sum(0.5 * jnp.diff(q) ** 2 + params["β"] / 4 * jnp.diff(q) ** 4)
    lattice = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) - springs(q, params))
    q0 = jnp.sin(jnp.linspace(0.0, jnp.pi, 40))

    def at_end(params, **settings):
        return jnp.sum(lj.integrate(lattice, q0, 0 * q0, params, ts=jnp.array([0.0, 20.0]), **settings).q[-1] ** 3)

    params = {"β": jnp.asarray(0.5)}
    by_dopri = jax.jit(jax.value_and_grad(lambda params: at_end(params, method=lj.Dopri8(), rtol=1e-11, atol=1e-11)))
    value, slope = by_dopri(params)
    for derivative in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(jax.jit(derivative(at_end))(params)["β"], slope["β"], rtol=1e-6)
    checkpointed = diffrax.RecursiveCheckpointAdjoint()
    np.testing.assert_allclose(
        jax.jit(jax.grad(lambda p: at_end(p, adjoint=checkpointed)))(params)["β"], slope["β"], rtol=1e-6
    )
    np.testing.assert_allclose(at_end(params), value, rtol=1e-7)
