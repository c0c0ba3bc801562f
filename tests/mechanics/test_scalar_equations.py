"""Written-out equations: the same accelerations, multipliers and projections, without operations for zeros."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.constrained_state import to_manifold
from lagjax.mechanics.equations import equations_of, is_small, write_out
from lagjax.scenes import bead_on_hoop
from lagjax.system import coordinates
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import in_numpy
from tests.systems import HORIZONTAL, PARAMS, double_pendulum_lagrangian, pendulum, rod_pendulum

LIBRARY = {"lu", "cholesky", "triangular_solve", "eigh", "qr", "custom_linear_solve"}
DOUBLE = {"m1": 1.0, "m2": 0.7, "l1": 1.2, "l2": 0.8, "g": 9.81}
diagonal = lj.System(lambda t, q, v, params: 0.5 * (v[0] ** 2 + (jnp.sin(q[0]) * v[1]) ** 2))
double_pendulum = lj.System(double_pendulum_lagrangian)


def states(like, count=5):
    """Random states with the structure of q."""
    rng = np.random.default_rng(3)
    draw = lambda x: rng.normal(size=np.shape(x))
    return [(jax.tree.map(draw, like), jax.tree.map(draw, like)) for _ in range(count)]


def operations(program):
    """How often each primitive occurs in a program, its functions included."""
    count = Counter()
    for equation in program.eqns:
        count[equation.primitive.name] += 1
        for value in equation.params.values():
            if hasattr(value, "jaxpr"):
                count += operations(getattr(value, "jaxpr"))
    return count


SYSTEMS = {
    "rod": (rod_pendulum, HORIZONTAL[0], PARAMS),
    "pendulum": (pendulum, 0.3, PARAMS),
    "double": (double_pendulum, np.ones(2), DOUBLE),
    "motor": (bead_on_hoop.driven_system, {"psi": 1.0, "theta": 0.0}, bead_on_hoop.PARAMS),
    "diagonal": (diagonal, np.ones(2), None),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_same_accelerations(name):
    """The same as by pivoting, at random states (on the constraints or not)."""
    system, like, params = SYSTEMS[name]

    @in_numpy
    def both(*state):
        model = model_of(system, *state)
        return write_out(model).equations(model, *state[:3]), equations_of(model).accelerations(*state[:3])

    for q, v in states(like):
        (a, stacked), (expected, multipliers) = both(*coordinates.state(0.4, q, v, params))
        flat = lambda tree: np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)] or [[]])
        np.testing.assert_allclose(flat(a), flat(expected), rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(stacked, flat(multipliers), rtol=1e-12)


def test_the_same_projection():
    """From 1e-5 off, the same nearest state as by the robust way; from far off, NaN."""
    q, v = {"x": 1.25 + 1e-5, "y": 2e-5}, {"x": 1e-5, "y": 3.0}
    s = coordinates.state(0.0, q, v, PARAMS)
    project = write_out(model_of(rod_pendulum, *s)).project
    assert project is not None
    found = project(model_of(rod_pendulum, *s), *s[:3])
    expected = to_manifold(equations_of(model_of(rod_pendulum, *s)), *s[:3], 1e-9, 1e-9)
    for a, b in zip(found, (expected.q, expected.v)):
        # Two iterations with one matrix leave the third power of the distance, 1e-15, times the speed of 3.
        np.testing.assert_allclose(coordinates.flatten(a)[0], coordinates.flatten(b)[0], rtol=1e-14, atol=1e-14)
    far = coordinates.state(0.0, {"x": 1.4, "y": 0.3}, v, PARAMS)
    assert np.isnan(project(model_of(rod_pendulum, *far), *far[:3])[0]["x"])


def evaluated(name):
    """The program of one evaluation, without the part computed once before the loop."""
    system, like, params = SYSTEMS[name]
    s = coordinates.state(0.4, *states(like, 1)[0], params)
    numbers = write_out(model_of(system, *s)).equations
    prepared = numbers.prepare(model_of(system, *s))
    return operations(jax.make_jaxpr(numbers.at)(prepared, s.t, s.q, s.v).jaxpr)


def test_a_scene_pays_for_what_it_has():
    """One coordinate with a constant mass: no division at all; diagonal masses: one each; two coupled ones: more."""
    found = {name: evaluated(name) for name in SYSTEMS}
    assert found["pendulum"]["div"] == 0
    assert found["pendulum"]["mul"] + found["pendulum"]["sin"] <= 8
    assert found["diagonal"]["div"] == 1 and found["diagonal"]["select_n"] == 0
    assert found["double"]["div"] >= 1 and found["double"]["select_n"] > 0
    assert found["rod"]["div"] > found["pendulum"]["div"]
    for operations in found.values():
        assert not LIBRARY & set(operations) and "dot_general" not in operations and "while" not in operations


def test_what_is_small():
    """Seven coupled coordinates are written out, nine not, nor a network in L; twin: its numbers in a vector are."""
    coupled = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + jnp.sum(v) ** 2 * jnp.cos(q[0]) ** 2)
    small = lambda n, params: is_small(model_of(coupled, *coordinates.state(0.0, np.ones(n), np.ones(n), params)))
    assert small(7, None) and not small(9, None)
    assert not small(7, np.ones((8, 8))) and small(7, np.ones(64))


def test_a_massless_coordinate_is_left_to_arrays():
    """Without pivoting its zero would be divided by at every state; twin: the same angle with a mass."""
    rod = lj.Holonomic(lambda t, q, params: q["at"] - jnp.stack([jnp.sin(q["angle"]), -jnp.cos(q["angle"])]))

    def kinetic(t, q, v, params):
        return 0.5 * v["at"] @ v["at"] + 0.5 * params * v["angle"] ** 2 - q["at"][1]

    q = {"at": np.array([0.0, -1.0]), "angle": 0.0}
    s = coordinates.state(0.0, q, jax.tree.map(np.zeros_like, q), 0.1)
    light = lj.System(lambda t, q, v, params: kinetic(t, q, v, 0.0), {"rod": rod})
    assert not is_small(model_of(light, *s)) and is_small(model_of(lj.System(kinetic, {"rod": rod}), *s))
    assert not np.isfinite(write_out(model_of(light, *s)).equations(model_of(light, *s), *s[:3])[0]["angle"])


def test_a_long_program_is_not_written_out(monkeypatch):
    """Writing out a potential by quadrature of 500 nodes is given up before its end; a short one is written out."""
    monkeypatch.setattr("lagjax.mechanics.equations.LONG", 1_000_000)
    monkeypatch.setattr("lagjax.mechanics.equations.ON_THE_WAY", 6e-3)
    nodes = np.linspace(0.0, 6.0, 500)
    wire = lambda q: jnp.sum(1 / jnp.sqrt((q[0] - jnp.cos(nodes)) ** 2 + (q[1] - jnp.sin(nodes)) ** 2 + q[2] ** 2))
    system = lj.System(lambda t, q, v, params: 0.5 * v @ v + wire(q))
    s = coordinates.state(0.0, np.array([2.0, 0.0, 0.3]), np.zeros(3), None)
    assert write_out(model_of(system, *s)) is None
    short = lj.System(lambda t, q, v, params: 0.5 * v @ v + 1 / jnp.sqrt(q @ q))
    assert write_out(model_of(short, *s)) is not None
