"""Where `integrate` uses which method, by what its equations depend on, networks and the tolerance."""

from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.arguments import is_loose, tolerance
from lagjax.integrate.solve.programs import method_of
from lagjax.system import coordinates
from lagjax.system.model import model_of
from tests.systems import pendulum_lagrangian
from tests.tiers import exhaustive_but


def swinging(**more):
    """A pendulum as a system."""
    return lj.System(pendulum_lagrangian, **more)


def layered(p, q):
    """A network of two coordinates."""
    return jnp.sum(jnp.tanh(jnp.tanh(q @ p[0]) @ p[1]))


def structured(t, q, v, p):
    """A mass matrix that depends on q."""
    return 0.5 * (1 + layered(p, q) ** 2) * (v @ v)


RELATIVISTIC = lj.System(lambda t, q, v, params: -jnp.sqrt(1 - v**2) - params["g"] * q**2)
POLAR = lj.System(lambda t, q, v, params: 0.5 * (v["r"] ** 2 + (q["r"] * v["φ"]) ** 2) + params["g"] / q["r"])
STILL = swinging(constraints={"still": lj.Holonomic(lambda t, q, params: q - 1.0)})
IN_LAYERS = lj.System(lambda t, q, v, p: 0.5 * (v @ v) - layered(p, q))
ON_ROD = lj.System(IN_LAYERS.lagrangian, {"rod": lj.Holonomic(lambda t, q, p: q @ q - 1.0)})
BY_MODULE = lj.System(lambda t, q, v, p: 0.5 * (v @ v) - p(q))
LAYERS = [np.ones((2, 8)), np.ones((8, 8))]
# Its shapes alone matter here: random weights would be compiled for seconds, whatever tests are run.
SHAPES = eqx.filter_eval_shape(lambda: eqx.nn.MLP(2, "scalar", 8, 2, jnp.tanh, key=jax.random.key(0)))
MLP = jax.tree.map(lambda x: np.ones(x.shape) if isinstance(x, jax.ShapeDtypeStruct) else x, SHAPES)
SEQUENCE = eqx.nn.Sequential([MLP.layers[0], eqx.nn.Lambda(jnp.tanh), MLP.layers[1], eqx.nn.Lambda(jnp.sum)])
CONSTANTS, PLACE = {"g": 1.0, "l": 1.0}, np.array([1.0, 0.0])
# The system, where it is, its parameters, and the methods at tight and loose tolerances.
CASES = {
    "conservative": (swinging(), 1.0, CONSTANTS, "Nystrom12", "Nystrom12"),
    "driven": (swinging(force=lambda t, q, v, p: 0.1 * jnp.cos(t)), 1.0, CONSTANTS, "Nystrom12", "Nystrom12"),
    "rubbed": (swinging(force=lambda t, q, v, p: -0.1 * v), 1.0, CONSTANTS, "Dopri8", "Dopri8"),
    "damped": (swinging(dissipation=lambda t, q, v, p: 0.05 * v**2), 1.0, CONSTANTS, "Dopri8", "Dopri8"),
    "held": (STILL, 1.0, CONSTANTS, "Dopri8", "Dopri8"),
    "polar": (POLAR, {"r": 1.0, "φ": 0.0}, CONSTANTS, "Dopri8", "Dopri8"),
    "relativistic": (RELATIVISTIC, 0.1, CONSTANTS, "Dopri8", "Dopri8"),
    "matrices": (IN_LAYERS, PLACE, LAYERS, "Nystrom8", "Tsit5"),
    "MLP": (BY_MODULE, PLACE, MLP, "Nystrom8", "Tsit5"),
    "Sequential": (BY_MODULE, PLACE, SEQUENCE, "Nystrom8", "Tsit5"),
    "among others": (lj.System(lambda t, q, v, p: 0.5 * p["m"] * (v @ v) - p["V"](q)), PLACE, {"m": 1.0, "V": MLP},
                     "Nystrom8", "Tsit5"),
    "structured": (lj.System(structured), PLACE, LAYERS, "Dopri8", "Tsit5"),
    "on a rod": (ON_ROD, PLACE, LAYERS, "Dopri8", "Tsit5"),
    "too small": (IN_LAYERS, PLACE, [np.ones((2, 8)), np.ones(8)], "Nystrom12", "Nystrom12"),
}  # fmt: skip

LOOPED = diffrax.Dopri8(scan_kind="lax")
CONDITION = {"event": diffrax.Event(lambda t, y, args, **kwargs: y[0]["x"] < 0)}


def rates(q):
    """A velocity for each coordinate."""
    return jax.tree.map(lambda x: 0.0 * x + 0.125, q)


def chosen(name, loose=False, **asked):
    """The method that is chosen for a case, and what else is asked for."""
    system, q, params, *_ = CASES[name]
    params = jax.tree.map(lambda x: np.asarray(x, float) if eqx.is_inexact_array_like(x) else x, params)
    model = model_of(system, *coordinates.state(0.0, q, rates(q), params))
    settings = {"method": None, "outputs": None, "adjoint": None, "event": None, "loose": loose} | asked
    return method_of(SimpleNamespace(**settings), model)


@pytest.mark.parametrize("name", CASES)
def test_chosen(name):
    """Nyström's only if accelerations do not depend on velocities; for a network of lower order, loosely Tsit5."""
    *_, tight, loose = CASES[name]
    assert [type(chosen(name, loose=at)).__name__ for at in (False, True)] == [tight, loose]


def test_what_else_is_asked_for():
    """Ours in place of diffrax's, but not of others, with an option, or with a condition of its own. An adjoint without
    pairs (q, v) has Dopri8, interpolated outputs have Tsit5; what cannot be is refused."""
    for asked, kind in (
        ({"adjoint": diffrax.BacksolveAdjoint()}, lj.Dopri8),
        ({"outputs": "interpolated"}, lj.Tsit5),
        ({"method": lj.Nystrom8()}, lj.Nystrom8),
        ({"method": diffrax.Dopri8()}, lj.Dopri8),
        ({"method": diffrax.Dopri8(), **CONDITION}, diffrax.Dopri8),
        ({"method": LOOPED}, diffrax.Dopri8),
        ({"method": diffrax.Heun()}, diffrax.Heun),
        *(({"method": diffrax.Tsit5(), "adjoint": adjoint}, lj.Tsit5)
          for adjoint in (diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint(), diffrax.DirectAdjoint())),
    ):  # fmt: skip
        assert type(chosen("conservative", **asked)) is kind
    for name, asked, words in (
        ("relativistic", {"method": lj.Nystrom8()}, r"Nystrom8 is .* these do[\s\S]*method=lj.Dopri8"),
        ("held", {"method": lj.Nystrom8()}, r"Nystrom8 is for accelerations .* there are constraints"),
        ("conservative", {"outputs": "interpolated", "method": lj.Dopri8()}, "which Dopri8 does not go with"),
        ("conservative", {"outputs": "interpolated", "method": lj.Nystrom12()}, "its steps are too long"),
    ):
        with pytest.raises(ValueError, match=words):
            chosen(name, **asked)


def test_which_tolerance_is_loose():
    """The tighter one of several counts, and for a traced one the default of the dtype."""
    double, single = np.dtype("float64"), np.dtype("float32")
    for rtol, dtype, loose in (
        (1e-6, double, True), (9e-7, double, False), ((1e-3, 1e-7), double, False), ((1e-3, 1e-5), double, True),
        (None, double, False), (None, single, True),
    ):  # fmt: skip
        assert is_loose(tolerance(rtol, "rtol", dtype), dtype) is loose, (rtol, dtype)
    said = []
    jax.eval_shape(lambda rtol: said.extend(is_loose(rtol, dtype) for dtype in (double, single)), np.float64(1e-5))
    assert said == [False, True]


def of_a_motion(name, dtype=np.float64, **how):
    """What is said of a motion whose method is chosen."""
    system, q, params, *_ = CASES[name]
    q, v, x = jax.tree.map(lambda x: np.asarray(x, dtype), (q, rates(q), params))
    run = lambda q, v: lj.integrate(system, q, v, x, ts=np.array([0.0, 0.1], dtype), throw=False, **how)
    return jax.eval_shape(run, q, v)


@pytest.mark.slow
def test_of_a_motion():
    """At a loose tolerance a network's outputs are interpolated, and the motion is continued by the same method."""
    found = of_a_motion("matrices", rtol=1e-6)
    assert found.static.method == "Tsit5, outputs interpolated" and type(found.asked.method) is lj.Tsit5


@pytest.mark.slow
def test_how_a_motion_is_asked_for():
    """Interpolated if steps and outputs are not fixed; a method that is not the tolerance's choice is not asked for."""
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.1}
    assert of_a_motion("matrices", **fixed).static.method == "Nystrom8"
    assert of_a_motion("matrices", np.float32, outputs="exact").static.method == "Tsit5"
    tight = of_a_motion("matrices")
    assert tight.static.method == "Nystrom8" and tight.asked.method is None


NETWORKS = ("matrices", "MLP", "Sequential", "among others", "structured", "on a rod", "too small")


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(("matrices", "on a rod", "too small"), NETWORKS))
def test_explained(name):
    """`explain` says which method steps a network, and which at loose tolerances."""
    system, q, params, tight, loose = CASES[name]
    said = repr(lj.explain(system, 0.0, q, rates(q)[::-1], params))
    assert ("by Tsit5 at rtol of 1e-6 and above" in said) == (loose != tight) and f"stepped by {tight}" in said
