"""Sweeps first assume regular motions: lanes that are not settled are computed entirely with the robust program."""

import threading
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lagjax as lj
from lagjax.contexts import REGULAR_FIRST, WATCHED
from lagjax.integrate import in_turn
from lagjax.integrate.solve import reports
from lagjax.jaxtools.cache import PROGRAMS
from lagjax.jaxtools.tracing import takes_for_regular
from lagjax.sweep import engine
from lagjax.sweep.axes import axes_of
from tests.plain import not_plain
from tests.tiers import exhaustive_but

# The mass matrix [[k, 1], [1, k]] is definite for k > 1; for k < 1 it needs pivots.
saddle = lj.System(
    lambda t, q, v, p: v[0] * v[1] + 0.5 * p["k"] * (v[0] ** 2 + v[1] ** 2) - 0.5 * (q[0] ** 2 + q[1] ** 2)
)
BOTH = {"k": np.array([0.0, 0.5, 2.0, 3.0, 4.0, 5.0])}
DEFINITE = {"k": np.array([2.0, 3.0, 4.0, 5.0])}


def saddle_motion(k):
    """From (1, 1/2) at rest to t = 1."""
    return lj.integrate(saddle, jnp.array([1.0, 0.5]), jnp.zeros(2), {"k": k}, ts=jnp.array([0.0, 1.0]))


def first_coordinate(point):
    """The first coordinate at t = 1."""
    return saddle_motion(point["k"]).q[-1, 0]


def exact(k):
    """(1 + k) s'' = -s for the sum of the coordinates, (k - 1) d'' = -d for their difference."""
    rate = 1 / np.sqrt(np.abs(k - 1))
    difference = np.where(k < 1, np.cosh(rate), np.cos(rate))
    return 0.5 * (1.5 * np.cos(1 / np.sqrt(1 + k)) + 0.5 * difference)


def quiet(run, axes=BOTH, **settings):
    """A sweep without a progress bar."""
    return lj.sweep(run, axes, progress=False, **settings)


def regular_alone(run, axes=BOTH):
    """(values, status, settled) of only the program that assumes regular motions."""
    grid = axes_of(axes, False)
    program, _ = engine.program_for(run, grid, grid.size, jax.local_devices()[:1], "vmap", robust=False)
    return program.call(grid.at(np.arange(grid.size)), grid.size)


@pytest.fixture(autouse=True)
def compiled(monkeypatch, request):
    """Count the compiled programs of each kind, starting with an empty cache."""
    count, compiled = Counter(), engine.compiled
    if not request.node.get_closest_marker("exhaustive"):
        return count

    def counted(*args):
        count["robust" if args[-1] else "regular"] += 1
        return compiled(*args)

    monkeypatch.setattr(engine, "compiled", counted)
    PROGRAMS.clear()
    return count


@pytest.mark.exhaustive
@not_plain
def test_lanes_that_are_not_regular(compiled):
    """All lanes have their exact values. Twin: without the robust program the irregular ones fail."""
    swept = quiet(first_coordinate)
    assert swept.ok.all() and compiled == {"regular": 1, "robust": 1}
    np.testing.assert_allclose(swept.values, exact(BOTH["k"]), rtol=1e-7)
    values, status, settled = regular_alone(first_coordinate)
    np.testing.assert_array_equal(settled, BOTH["k"] > 1)
    np.testing.assert_array_equal(np.isnan(values), ~settled)
    assert not np.isin(status.result[~settled], engine.TRUSTED).any()


@pytest.mark.parametrize(("axes", "kinds"), [(DEFINITE, {"regular": 1}), (BOTH, {"regular": 1, "robust": 1})])
def test_which_lanes_need_the_robust_program(axes, kinds, compiled, monkeypatch):
    """Lanes that a first program does not settle are those of a robust one, which is compiled only for them."""
    monkeypatch.setattr(engine, "program_of", lambda key, make: make())

    def made(run, axes, chunk, devices, layout, patience, robust, point, compiles=True):
        compiled["robust" if robust else "regular"] += 1

        def call(point, count):
            k = point["k"][:count]
            settled = None if robust else k > 1
            values = exact(k) if robust else np.where(settled, exact(k), np.nan)
            result = np.where(np.isnan(values), lj.RESULTS.not_finite._value, lj.RESULTS.successful._value)
            return values, engine.Status(result, *3 * [np.zeros(count)]), settled

        value = jax.ShapeDtypeStruct((), float)
        return engine.Program(call, chunk, value, 0, "", threading.Event(), not robust)

    monkeypatch.setattr(engine, "compiled", made)
    swept = quiet(lambda point: point["k"], axes)
    assert swept.ok.all() and compiled == kinds
    np.testing.assert_array_equal(swept.values, exact(axes["k"]))


@pytest.mark.exhaustive
@not_plain
def test_what_run_makes_of_a_failure():
    """A run that replaces NaN and reads `result`: the whole lane is computed again. Twin: the first program alone."""

    def run(point):
        traj = saddle_motion(point["k"])
        went_well = traj.result == lj.RESULTS.successful
        return {"q": jnp.where(jnp.isfinite(traj.q[-1, 0]), traj.q[-1, 0], 7.0), "went well": went_well}

    swept, (values, *_) = quiet(run), regular_alone(run)
    np.testing.assert_allclose(swept.values["q"], exact(BOTH["k"]), rtol=1e-7)
    assert swept.values["went well"].all()
    # The values are not even NaN: only the report says that the lane failed.
    assert not values["went well"][:2].any() and not np.allclose(values["q"][:2], swept.values["q"][:2])


# Functions that hide an integration at k.
HIDDEN = {
    "a map": lambda k: lax.map(lambda k: saddle_motion(k).q[-1, 0], jnp.stack([k]))[0],
    "a branch": lambda k: lax.cond(k < 9.0, lambda k: saddle_motion(k).q[-1, 0], lambda k: k, k),
    "a loop": lambda k: lax.while_loop(lambda x: x[1] < 1, lambda x: (saddle_motion(k).q[-1, 0], 1), (k, 0))[0],
    "a branch, jitted": lambda k: jax.jit(lambda k: HIDDEN["a branch"](k))(k),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("what", exhaustive_but(("a map",), HIDDEN))
def test_motions_that_nobody_is_told_of(what, compiled, monkeypatch):
    """In a loop or a branch no motion is assumed regular. Twin: failures there would go unnoticed."""
    run = lambda point: HIDDEN[what](point["k"])
    np.testing.assert_allclose(quiet(run).values, exact(BOTH["k"]), rtol=1e-7)
    assert regular_alone(run)[2] is None and compiled["robust"] == 0
    monkeypatch.setattr(reports, "_hides", lambda jaxpr: False)
    PROGRAMS.clear()
    np.testing.assert_array_equal(np.isnan(quiet(run).values), BOTH["k"] < 1)


@pytest.mark.exhaustive
def test_derivatives(compiled):
    """In lanes inside of `run` they are exact. Twin: the first program alone gives NaN."""
    run = lambda point: jax.vmap(jax.grad(lambda k: saddle_motion(k).q[-1, 0]))(jnp.stack([point["k"], 2.5]))[0]
    step = 1e-5
    slopes = (exact(BOTH["k"] + step) - exact(BOTH["k"] - step)) / (2 * step)
    np.testing.assert_allclose(quiet(run).values, slopes, rtol=1e-5)
    assert compiled == {"regular": 1, "robust": 1}
    np.testing.assert_array_equal(np.isnan(regular_alone(run)[0]), BOTH["k"] < 1)


def irregular_programs():
    """The programs of sweeps in the cache that turned out not to be regular."""
    return [x for x in PROGRAMS.values() if isinstance(x, engine.Program) and x.irregular.is_set()]


@pytest.mark.exhaustive
def test_many_chunks_and_workers(compiled):
    """All chunks share one robust program; after a mostly irregular chunk the first program is not called again."""
    many = {"k": np.tile(BOTH["k"][:2], 40)}
    swept = quiet(first_coordinate, many, chunk=4, workers=4)
    np.testing.assert_allclose(swept.values, exact(many["k"]), rtol=1e-7)
    assert compiled == {"regular": 1, "robust": 1} and swept.compiling > 0
    (program,) = irregular_programs()
    calls = Counter()
    remembered_program = program._replace(call=lambda *args: calls.update(["regular"]) or program.call(*args))
    for key, kept in list(PROGRAMS.items()):
        if kept is program:
            PROGRAMS[key] = remembered_program
    again = quiet(first_coordinate, many, chunk=4, workers=4)
    np.testing.assert_array_equal(again.values, swept.values)
    assert again.compiling == 0 and not calls
    # Twin: with the flag cleared it is called.
    program.irregular.clear()
    quiet(first_coordinate, many, chunk=4, workers=1)
    assert calls["regular"] == 1


def test_a_fit_takes_nothing_for_regular():
    """Motions that a search tries are not assumed regular and not reported to a sweep of fits."""
    with WATCHED(True), REGULAR_FIRST(True):
        assert takes_for_regular()
        inside = []
        in_turn(lambda x: inside.append(takes_for_regular()) or x, jnp.asarray(1.0))
    assert inside == [False]
