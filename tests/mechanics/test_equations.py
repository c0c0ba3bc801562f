"""One object holds the equations: its three ways give the same results, and one place chooses between them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.explain import _how_solved
from lagjax.jaxtools import kept_as_call
from lagjax.jaxtools.jaxpr import equations as equations_in
from lagjax.mechanics import equations, sparse_saddle_point
from lagjax.mechanics.constrained_state import to_manifold
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.saddle_point import Dense
from lagjax.mechanics.sparse_saddle_point import Banded
from lagjax.mechanics.structure import structure
from lagjax.system import coordinates
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import in_numpy
from tests.large_systems import chain
from tests.plain import not_plain
from tests.systems import HORIZONTAL, PARAMS, rod_pendulum

# Two links: small enough to be written out, and a band where that is allowed.
SYSTEM, Q, V, OF_CHAIN = chain(2)


def in_three_ways(monkeypatch):
    """The equations of the chain in one matrix, as a band, and number by number; and its state."""
    s = coordinates.state(0.0, Q, V, OF_CHAIN)
    dense, written = equations_of(model_of(SYSTEM, *s)), equations_of(model_of(SYSTEM, *s), fast=True, fallback=False)
    monkeypatch.setattr(sparse_saddle_point, "UNKNOWNS_AT_LEAST", 2)
    monkeypatch.setattr(sparse_saddle_point, "BAND_AT_MOST", 1.0)
    banded = equations_of(model_of(SYSTEM, *s))
    assert isinstance(dense.form, Dense) and isinstance(banded.form, Banded)
    assert written.are_taken_for_regular and not dense.are_written
    return dense, banded, written, s


def flat(tree):
    """All numbers of a tree."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


@not_plain
@pytest.mark.slow
def test_the_three_ways_say_the_same(monkeypatch):
    """They agree on accelerations, multipliers, verdicts, slopes and displacements; twin: another state differs."""
    dense, banded, written, s = in_three_ways(monkeypatch)
    r = np.array([1e-3, -2e-3])

    def said(one, t, q, v):
        slopes, moved = one.row_sizes(t, q, v), one.displacement(t, q, v)(r)
        return one.accelerations(t, q, v), slopes, moved, one.independent(t, q, v), one.verdict(t, q, v)[2:5]

    @jax.jit
    def everything(t, q, v):
        numbers = t, written.inside(q), written.inside(v)
        a, multipliers = written.rates(*numbers)
        fast = (written.outside(a), multipliers), written.verdict(*numbers)[2:5]
        return said(dense, t, q, v), said(banded, t, q, v), fast

    expected, found, fast = everything(*s[:3])
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(flat(fast[0]), flat(expected[0]), rtol=1e-11, atol=1e-11)
    assert list(map(bool, fast[1])) == list(map(bool, expected[-1])) == [True, False, False]
    elsewhere, *_ = everything(s.t, jax.tree.map(lambda x: 1.001 * x, s.q), s.v)
    assert np.max(np.abs(flat(elsewhere[0]) - flat(expected[0]))) > 1e-4
    assert np.max(np.abs(elsewhere[2] - expected[2])) > 1e-9


@not_plain
def test_the_robust_way_is_there_unless_they_are_taken_for_regular():
    """Where the written-out equations give NaN the fallback solves them; without it NaN stays, as the verdict says."""
    same = lambda t, q, params: jnp.stack([q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2] * 2)
    twice = lj.System(rod_pendulum.lagrangian, {"rod": lj.Holonomic(same)})
    s = coordinates.state(0.0, *HORIZONTAL, PARAMS)
    robust, regular = (equations_of(model_of(twice, *s), fast=True, fallback=fallback) for fallback in (True, False))
    numbers = s.t, robust.inside(s.q), robust.inside(s.v)
    of = lambda one: in_numpy(lambda t, q, v: (one.rates(t, q, v), one.verdict(t, q, v).finite))(*numbers)
    ((a, multipliers), finite), ((unknown, _), nowhere) = of(robust), of(regular)
    assert np.all(np.isfinite(flat(a))) and np.all(np.isnan(flat(unknown)))
    assert bool(finite) and not bool(nowhere)
    # Dependent equations share the force equally.
    np.testing.assert_allclose(*multipliers["rod"], rtol=1e-12)


def test_a_long_program_is_differentiated_in_arrays(monkeypatch):
    """Equations that are to be differentiated are written out only if they are short, and say the same either way."""
    s = coordinates.state(0.0, *HORIZONTAL, PARAMS)
    model = model_of(rod_pendulum, *s)
    short = equations_of(model, fast=True, differentiated=True)
    monkeypatch.setattr(equations, "LONG_TO_DIFFERENTIATE", short.operations(*s[:1], *map(short.inside, s[1:3])) - 1)
    long, kept = equations_of(model, fast=True, differentiated=True), equations_of(model, fast=True)
    assert short.are_written and kept.are_written and not long.are_written
    a, multipliers = in_numpy(kept.rates)(s.t, kept.inside(s.q), kept.inside(s.v))
    expected = in_numpy(long.rates)(*s[:3])
    np.testing.assert_allclose(flat((kept.outside(a), multipliers)), flat(expected), rtol=1e-14)


def test_in_arrays_they_are_the_same_or_nan():
    """Taken for regular, all equations are solved with: where the robust way leaves one out, the results are NaN.

    The third constraint is the first link's and a little more, by as much as it turns the row. At a turn of one the
    start is returned to where the robust way returns it.
    """

    def more(t, q, p):
        return (jnp.sum(q[0] ** 2) - p["l"] ** 2 + p["turn"] * (q[1, 0] - Q[1, 0]))[None]

    system = lj.System(SYSTEM.lagrangian, SYSTEM.constraints | {"more": lj.Holonomic(more)})
    s = coordinates.state(0.0, Q, 0.0 * V, OF_CHAIN | {"turn": 1.0})

    @in_numpy
    def both(turn, shift):
        model, q = model_of(system, *s).of(s.params | {"turn": turn}), s.q + shift * np.array([[1.0, 2.0], [3.0, 4.0]])
        robust, regular = equations_of(model), equations_of(model, fallback=False)
        assert regular.are_taken_for_regular and not robust.are_taken_for_regular and not regular.are_written
        of = lambda one: (one.accelerations(s.t, q, s.v), one.displacement(s.t, q, s.v)(jnp.ones(3)))
        (begun, verdict), moved = regular.begin(s.t, q, s.v, True), to_manifold(robust, s.t, q, s.v, 1e-12, 1e-12)
        valid = verdict.finite & ~verdict.singular
        return of(regular), of(robust), robust.independent(s.t, q, s.v), (begun, valid), moved

    for turn in (1.0, 1e-5):
        found, expected, independent, (_, valid), _ = both(turn, 0.0)
        np.testing.assert_allclose(flat(found), flat(expected), rtol=1e-9)
        assert np.all(independent) and valid
    found, expected, independent, (_, valid), _ = both(1e-7, 0.0)
    assert np.all(np.isnan(flat(found))) and np.all(np.isfinite(flat(expected)))
    assert np.sum(independent) == 2 and not valid
    *_, (begun, valid), moved = both(1.0, 1e-5)
    np.testing.assert_allclose(flat(begun), flat(moved[:2]), atol=1e-9)
    assert valid and moved.holds and np.max(np.abs(flat(begun[0]) - np.ravel(Q))) > 1e-6
    assert not both(1.0, 3.0)[3][1]


@not_plain
def test_a_start_is_returned_and_judged_in_one_loop():
    """A start is moved to the nearest point of the circle, and along its tangent; the equations are there once.

    Twins: what is not to be projected stays, what is far off is not called finite, and two verdicts have two copies.
    """
    s = coordinates.state(0.0, {"x": 0.6, "y": -0.8}, {"x": 1.0, "y": 2.0}, PARAMS | {"l": 1.003})
    regular = equations_of(model_of(rod_pendulum, *s), fast=True, fallback=False)

    @in_numpy
    def begun(factor):
        x, y = jnp.asarray(s.q["x"]) * factor, jnp.asarray(s.q["y"]) * factor
        return [regular.begin(s.t, (x, y), regular.inside(s.v), project) for project in (True, False)]

    ((q, v), moved), (still, as_given) = begun(1.0)
    np.testing.assert_allclose(q, [0.6 * 1.003, -0.8 * 1.003], rtol=1e-15)
    np.testing.assert_allclose(v, [1.6, 1.2], rtol=1e-14)
    assert moved.finite and as_given.finite and not moved.singular
    np.testing.assert_allclose(moved.given[0], [[1.0 - 1.003**2], [-2.0]], rtol=1e-12)
    assert still == ((s.q["x"], s.q["y"]), (s.v["x"], s.v["y"]))
    assert not begun(8.0)[0][1].finite

    lagrangian = lambda t, q, v, p: rod_pendulum.lagrangian(t, q, v, p) + jnp.arctan2(q["y"], q["x"])
    turned = equations_of(model_of(lj.System(lagrangian, rod_pendulum.constraints), *s), fast=True, fallback=False)

    def arctangents(function):
        program = jax.make_jaxpr(function)(s.t, turned.inside(s.q), turned.inside(s.v))
        return sum(equation.primitive.name == "atan2" for equation in equations_in(program))

    assert arctangents(lambda *state: turned.begin(*state, project=True)) == 1
    assert arctangents(lambda *state: (turned.begin(*state, project=True), turned.verdict(*state))) == 2


@not_plain
def test_equations_are_written_out_once_for_all_traces():
    """Another program, lanes and a derivative reuse them; another function has its own."""
    s = coordinates.state(0.0, *HORIZONTAL, PARAMS)
    written = []

    def put_down(x):
        q = {"x": x, "y": s.q["y"]}
        written.append(equations_of(model_of(rod_pendulum, s.t, q, s.v, s.params), fast=True).written)
        return x

    x = s.q["x"]
    jax.make_jaxpr(put_down)(x)
    jax.make_jaxpr(jax.grad(put_down))(x)
    jax.make_jaxpr(jax.vmap(put_down))(x[None])
    assert len({id(found) for found in written}) == 1 and written[0] is not None
    another = lj.System(lambda *state: 2.0 * rod_pendulum.lagrangian(*state), rod_pendulum.constraints)
    assert equations_of(model_of(another, *s), fast=True).written is not written[0]


@pytest.mark.parametrize("change", ["closed over", "given"])
def test_what_is_written_does_not_outlive_a_value(change):
    """A traced value that L closes over, and that changes between traces, is the one of the present trace."""
    held = {"g": 9.81}

    def lagrangian(t, q, v, params):
        return 0.5 * v**2 - (held["g"] if change == "closed over" else params["g"]) * q

    system = lj.System(lagrangian)

    def falls(g):
        held["g"] = g
        return lj.accelerations(system, 0.0, 1.0, 0.0, {"g": 0.0 if change == "closed over" else g})[0]

    slope = jax.grad(falls)
    assert float(jax.jit(falls)(2.0)) == -2.0 and float(jax.jit(lambda g: falls(2 * g))(2.0)) == -4.0
    assert float(slope(1.0)) == -1.0 and float(jax.vmap(falls)(jnp.array([5.0, 7.0]))[1]) == -7.0


@not_plain
def test_the_choice_in_words(monkeypatch):
    """What is written out is said to be, and the form of the others."""
    s = coordinates.state(0.0, *HORIZONTAL, PARAMS)
    model = model_of(rod_pendulum, *s)
    said = lambda: _how_solved(equations_of(model, fast=True), structure(model))
    assert said() == "2 accelerations and 1 multiplier by elimination without the zeros"
    monkeypatch.setattr(equations, "is_small", lambda *problem: False)
    assert "3 equations by elimination" in said()


@not_plain
@pytest.mark.slow
def test_accelerations_alone_leave_out_the_multipliers(monkeypatch):
    """In a loop over steps there is no search for the shortest multipliers; twin: as one call with them there is."""
    _, banded, _, (t, q, v, _) = in_three_ways(monkeypatch)

    def steps(rates):
        def step(state):
            return state[0] + 1, rates(t, state[1], v)

        return jax.jit(lambda q: jax.lax.while_loop(lambda state: state[0] < 3, step, (0, q)))

    alone, both = (
        steps(rates).lower(q).compile()
        for rates in (lambda *x: banded.accelerations_alone(*x), lambda *x: kept_as_call(banded.accelerations(*x))[0])
    )
    np.testing.assert_array_equal(flat(alone(q)), flat(both(q)))
    assert " conditional(" in str(both.as_text()) and " conditional(" not in str(alone.as_text())
