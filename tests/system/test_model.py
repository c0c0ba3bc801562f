"""A model of a system: names, counts and vectors of its states, and its functions of vectors."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system.model import model_of


def friction(t, q, v, multipliers, params):
    """A force that reads a multiplier."""
    return {"place": -params["mu"] * multipliers["table"] * jnp.ones(2), "turn": t * v["turn"]}


SYSTEM = lj.System(
    lambda t, q, v, params: 0.5 * params["m"] * v["place"] @ v["place"] + v["turn"] * q["turn"] + t,
    {
        "table": lj.Holonomic(lambda t, q, params: q["place"][1]),
        "pins": lj.Nonholonomic(lambda t, q, v, params: v["place"] - q["turn"]),
    },
    force=friction,
    dissipation=lambda t, q, v, params: params["m"] * v["turn"] ** 2,
)
Q, V = {"place": np.array([1.0, 2.0]), "turn": np.array(3.0)}, {"place": np.array([4.0, 5.0]), "turn": np.array(6.0)}
PARAMS = {"m": 2.0, "mu": 0.25}
MODEL = model_of(SYSTEM, np.float64(0.5), Q, V, PARAMS)
X, U = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])


def test_counts_and_names():
    """Coordinates in the order of their vector, equations in that of their constraints' names."""
    assert (MODEL.n, MODEL.m) == (3, 3) and MODEL.names == ["place[0]", "place[1]", "turn"]
    assert MODEL.equation_names == ["pins[0]", "pins[1]", "table"] and MODEL.holonomic.tolist() == [False, False, True]
    assert MODEL.belongs_to("pins").tolist() == [True, True, False] and MODEL.phases == (MODEL,)
    alone = MODEL.alone("table")
    assert alone.equation_names == ["table"] and alone.m == 1 and list(alone.system.constraints) == ["table"]


def test_equations_in_rows():
    """What slides at several points in a plane has an equation for each component; twin: as many as there are rows."""
    rows = lj.Nonholonomic(lambda t, q, v, params: jnp.outer(v["place"], v["place"]))
    model = model_of(lj.System(SYSTEM.lagrangian, {"rows": rows}), np.float64(0.5), Q, V, PARAMS)
    assert model.m == 4 and model.equation_names == ["rows[0, 0]", "rows[0, 1]", "rows[1, 0]", "rows[1, 1]"]
    assert model.split(np.arange(4.0))["rows"].tolist() == [[0.0, 1.0], [2.0, 3.0]]


def test_there_and_back():
    """States and multipliers become vectors and the same again, also in batches; twin: another order would not."""
    for found, expected in zip(MODEL.vectors(Q, V), (X, U)):
        np.testing.assert_array_equal(found, expected)
    assert MODEL.tree(X)["place"].tolist() == [1.0, 2.0] and MODEL.tree(X)["turn"] == 3.0
    assert MODEL.tree(np.stack([X, U]))["place"].shape == (2, 2) and MODEL.tree(np.stack([X, U]))["turn"].shape == (2,)
    parts = MODEL.split(X)
    assert parts["pins"].tolist() == [1.0, 2.0] and parts["table"] == 3.0
    np.testing.assert_array_equal(MODEL.stacked(parts), X)
    assert MODEL.stacked(parts).tolist() != MODEL.stacked(MODEL.split(X[::-1])).tolist()
    assert {name: x.shape for name, x in MODEL.zero_multipliers().items()} == {"pins": (2,), "table": ()}


def test_functions_of_vectors():
    """L, R and Q at a state are the user's; other parameters give other values."""
    assert float(MODEL.lagrangian(0.5, X, U)) == 0.5 * 2.0 * 41.0 + 18.0 + 0.5
    assert float(MODEL.of({"m": 4.0, "mu": 0.0}).lagrangian(0.5, X, U)) == 0.5 * 4.0 * 41.0 + 18.0 + 0.5
    assert float(MODEL.dissipation(0.5, X, U)) == 2.0 * 36.0
    assert MODEL.reacts and MODEL.force(0.5, X, U).tolist() == [0.0, 0.0, 3.0]
    assert MODEL.force(0.5, X, U, jnp.array([0.0, 0.0, 8.0])).tolist() == [-2.0, -2.0, 3.0]
    doubled = MODEL.mapped(lambda f, role: f if role != "lagrangian" else lambda *state: 2 * f(*state))
    assert float(doubled.lagrangian(0.5, X, U)) == 2 * float(MODEL.lagrangian(0.5, X, U))


def test_the_form_is_that_of_the_state():
    """Another dtype or structure is another form; another value is not."""
    assert MODEL.form == model_of(SYSTEM, np.float64(7.0), V, Q, PARAMS).form
    assert MODEL.form != model_of(SYSTEM, np.float32(0.5), Q, V, PARAMS).form
    t, q, v = MODEL.form.example
    assert t.shape == () and q["place"].shape == (2,) and v["turn"].dtype == np.float64
    with pytest.raises((KeyError, TypeError, IndexError)):
        model_of(SYSTEM, np.float64(0.5), [1.0, 2.0], [1.0, 2.0], PARAMS)
