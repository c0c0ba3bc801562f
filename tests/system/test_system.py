"""Systems as values: equal where their functions are, static arguments of programs, pickled if these can be."""

import copy
import pickle

import jax
import jax.numpy as jnp
import pytest

import lagjax as lj
from tests.behaviour.test_bad_input import refusal
from tests.behaviour.test_copies import spring, system
from tests.systems import PARAMS, pendulum


def rod(t, q, params):
    """A constraint function that can be pickled."""
    return q["x"] - params["k"]


def test_systems_are_static_arguments():
    """As static arguments of `jax.jit`, equal systems share one trace; a different system is traced again."""
    traces = []

    def force(system, x):
        traces.append(system)
        return lj.accelerations(system, 0.0, {"x": x}, {"x": 0.0}, {"k": 2.0, "power": 2})[0]["x"]

    program = jax.jit(force, static_argnums=0)
    for equal in (system, lj.System(spring), copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        assert program(equal, 1.0) == -4.0 and hash(equal) == hash(system) and equal == system
    assert len(traces) == 1
    other = lj.System(lambda t, q, v, params: spring(t, q, v, params) - q["x"])
    assert program(other, 1.0) == -5.0 and len(traces) == 2 and other != system


def test_equal_systems():
    """Systems compare by constraint names and values of arrays in functions; twins: another name, another number."""
    of = lambda name: lj.System(spring, {name: lj.Holonomic(rod)})
    assert of("rod") == of("rod") != of("bar") and hash(of("rod")) == hash(of("rod"))
    carried = lambda x: lj.System(jax.tree_util.Partial(lambda x, *state: x * spring(*state), jnp.asarray(x)))
    one = carried(1.0)
    assert one == jax.tree.map(jnp.array, one) and one != jax.tree.map(lambda x: 2 * x, one)
    phases = lambda: lj.Hybrid({"flying": system}, [lj.Switch("flying", to="flying", when=rod, reset=spring)])
    assert phases() == phases() and hash(phases()) == hash(phases())


def test_functions_that_pickle_cannot_find():
    """The error of pickle names role, place and fix; copies keep any function. Twin: `spring` can be pickled."""

    def nameless(t, q, params):
        return q["x"]

    here = lambda t, q, v, params: q["x"]
    for thing, words in (
        (lj.System(here), "the Lagrangian cannot be pickled: it is a lambda (test_system.py, line "),
        (lj.System(spring, {"rod": lj.Holonomic(nameless)}), "g of constraint 'rod' .*nameless is defined inside of"),
        (lj.System(spring, force=here), "the force cannot be pickled"),
        (lj.Crossing(here), "the guard of a crossing cannot"),
        (lj.Switch("a", to="b", when=here), "when of the switch 'a' -> 'b' cannot"),
    ):
        with pytest.raises(pickle.PicklingError, match=words.replace("(", r"\(")) as raised:
            pickle.dumps(thing)
        assert "Fix: define it with def" in str(raised.value)
        assert copy.deepcopy(thing) == thing
    assert pickle.loads(pickle.dumps(lj.System(spring, {"rod": lj.Holonomic(rod)}))).constraints["rod"].g is rod


def test_called_lagrangian_and_bare_constraint():
    """`System` refuses a value instead of a function, and a constraint without a kind."""
    with refusal(TypeError, "lagrangian must be a function"):
        lj.System(3.0)
    with refusal(TypeError, "'rod'", "lj.Holonomic"):
        lj.System(pendulum.lagrangian, {"rod": lambda t, q, params: q})
    with refusal(TypeError, "kinetic and potential energy given separately", "return kinetic - potential"):
        lj.System(pendulum.lagrangian, pendulum.lagrangian)
    with refusal(TypeError, "params in the place of constraints", "each call takes them"):
        lj.System(pendulum.lagrangian, PARAMS)
    with refusal(TypeError, "named 3, but its name must be text"):
        lj.System(pendulum.lagrangian, {3: lj.Holonomic(lambda t, q, params: q)})
