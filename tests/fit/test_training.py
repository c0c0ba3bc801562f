"""Training with optimisers of optax: steps against formulas, held-back records, failing motions."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import least_squares

import lagjax as lj
from lagjax.fit.problem.arguments import problem_of
from lagjax.fit.problem.parameters import find
from lagjax.fit.training import training as trained
from lagjax.fit.training.rounds import (
    Optimiser,
    Task,
    as_params,
    as_vector,
    fit_starts,
    initial_state,
    is_of_optax,
    round_of,
)
from lagjax.fit.training.training import split_records
from tests.counting import compiles

T = np.linspace(0.0, 3.0, 31)
spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)


def record(seed=0, known=True, amplitude=1.0, t=T, **of_run):
    """The spring with k = 4, released at an amplitude, with errors of 0.01."""
    q = amplitude * np.cos(2 * t) + 0.01 * np.random.default_rng(seed).normal(size=len(t))
    held = dict(q0=amplitude, v0=0.0, hold_q=True, hold_v=True) if known else {}
    return lj.Record(t, q=q, sigma=0.01, **held, **of_run)


def quietly(*args, **options):
    """A fit without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.FitWarning)
        return lj.fit(*args, **{"progress": False, "rtol": 1e-9, "atol": 1e-9} | options)


def test_optimisers_by_what_they_mean():
    """Two equal optimisers compare equal, so nothing is compiled again; twin: another rate differs."""
    found = find({"a": 1.0, "b": np.ones(3)}, None, {}, {}, np.dtype(float))
    made = lambda rate: Optimiser(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate)), found)
    assert made(1e-2) == made(1e-2) and hash(made(1e-2)) == hash(made(1e-2))
    assert made(1e-2) != made(1e-3)
    assert is_of_optax(optax.sgd(0.1)) and not is_of_optax(optax.sgd) and not is_of_optax((1, 2))


def test_optimisers_see_params():
    """Fitted numbers in the structure of params, None for the rest, and back."""
    params = {"a": 1.0, "net": {"w": np.ones((2, 3)), "f": jnp.tanh}, "m": np.arange(3.0)}
    found = find(params, ["net", "m[1]"], {}, {}, np.dtype(float))
    y = jnp.arange(7.0)
    tree = as_params(found, y)
    assert tree["a"] is None and tree["net"]["f"] is None
    assert tree["net"]["w"].shape == (2, 3) and tree["m"].shape == (1,)
    np.testing.assert_array_equal(as_vector(tree, y), y)


def test_which_records_are_held_back():
    """A fraction by seed, at least one record, never all; given ones; none."""
    records = [record(i) for i in range(5)]
    kept, held = split_records(records, 0.4, 0)
    assert len(kept) == 3 and len(held) == 2 and all(any(r is s for s in records) for r in kept + held)
    assert [len(x) for x in split_records(records, 0.99, 0)] == [4, 1] or len(split_records(records, 0.99, 0)[0]) >= 1
    assert [len(x) for x in split_records(records, [], 0)] == [5, 0]
    assert [len(x) for x in split_records(records, None, 0)] == [5, 0]
    assert split_records(records[0], records[1], 0)[1] == [records[1]]
    for wrong, words in ((1.5, "between 0 and 1"), (-0.1, "between 0 and 1")):
        with pytest.raises(ValueError, match=words):
            split_records(records, wrong, 0)
    with pytest.raises(ValueError, match="one record cannot be divided"):
        split_records(records[0], 0.5, 0)


def test_what_does_not_go_together():
    """Joined windows, restarts, an optimiser that was not called, or training arguments without one are refused."""
    for options, error, words in (
        ({"optimiser": optax.sgd(0.1), "window": 1.0}, ValueError, "joined=False"),
        ({"optimiser": optax.sgd(0.1), "restarts": 3}, ValueError, "trains once"),
        ({"optimiser": optax.sgd}, TypeError, "called with its learning rate"),
        ({"batch": 3}, ValueError, "'batch' is for training"),
        ({"optimiser": optax.sgd(0.1), "batch": 0}, ValueError, "batch must be a whole number"),
        ({"optimiser": optax.sgd(0.1), "iterations": 2.5}, ValueError, "iterations must be a whole number"),
    ):
        with pytest.raises(error, match=words):
            lj.fit(spring, record(), {"k": 3.0}, **options)


def problem_with(records, **options):
    """The problem of a fit of the spring."""
    settings = {"rtol": np.asarray(1e-9), "atol": np.asarray(1e-9)}
    return problem_of(spring, records, {"k": 3.0}, None, None, None, None, "squares", options.get("window"), settings)


@pytest.mark.exhaustive
def test_starts_of_their_own():
    """Each window's start, for a wrong k, is that of SciPy's least squares with cos and sin."""
    records = [record(i, known=False, amplitude=a) for i, a in enumerate((1.0, 0.5))]
    problem = problem_with(records)
    problem = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, problem)
    own, at = jax.jit(lambda x, own: fit_starts(problem, x, own, 20, 1e-14))(
        jnp.array([3.0]), jnp.asarray(problem.start.local)
    )
    w = np.sqrt(3.0)
    for i, r in enumerate(records):
        q = r.measured["q"]
        off = lambda s, q=q: (s[0] * np.cos(w * T) + s[1] / w * np.sin(w * T) - q) / 0.01
        exact = least_squares(off, [1.0, 0.0], xtol=1e-15)
        start = np.array([problem.starts.q.guess[i, 0], problem.starts.v.guess[i, 0]]) + own[i]
        np.testing.assert_allclose(start, exact.x, atol=1e-6)
        np.testing.assert_allclose(at.sums[i], 2 * exact.cost, rtol=1e-6)


@pytest.mark.exhaustive
def test_a_step_is_the_formula():
    """One step of gradient descent from known starts: k minus the rate times the slope of the mean square."""
    r, prior, rate = record(), (5.0, 0.5), 1e-3
    found = quietly(spring, [r], {"k": 3.9}, priors={"k": prior}, optimiser=optax.sgd(rate), iterations=1)
    w = np.sqrt(3.9)
    off, slope = np.cos(w * T) - r.measured["q"], -T * np.sin(w * T) / (2 * w)
    exact = (np.sum(off * slope) / 0.01**2 + (3.9 - prior[0]) / prior[1] ** 2) / len(T)
    np.testing.assert_allclose((3.9 - found.params["k"]) / rate, exact, rtol=1e-6)
    # Twin: without the prior the step differs.
    assert abs(np.sum(off * slope) / 0.01**2 / len(T) - exact) > 1e-3 * abs(exact)


@pytest.mark.exhaustive
def test_only_what_is_in_a_batch_moves():
    """A round of one step moves the start of one window, and leaves the others unchanged bit for bit."""
    problem = problem_with([record(i, known=False) for i in range(4)])
    numbers = (np.asarray(x) for x in (0, 10, 10))
    task = Task(problem, None, Optimiser(optax.adam(0.1), problem.found), 1, 1, *numbers)
    # Inaccurate starts, so that they can move.
    state = initial_state(task)
    state = state._replace(local=np.asarray(state.local) + 0.01)
    seen = []
    for _ in range(4):
        after, told = round_of(task, state)
        moved = np.flatnonzero(np.any(after.local != state.local, axis=1))
        assert len(moved) == 1 and after.y != state.y and np.isfinite(told.losses).all()
        seen.append(int(moved[0]))
        state = after
    assert sorted(seen) == [0, 1, 2, 3]


@pytest.mark.exhaustive
def test_what_fails_moves_nothing():
    """A motion with NaN is counted and reported, and the others are still fitted."""
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * (p["k"] + 0.0 * jnp.sqrt(p["sane"])) * q**2)
    records = [record(0, params={"sane": 1.0}), record(1, params={"sane": -1.0}), record(2, params={"sane": 1.0})]
    options = dict(free=["k"], optimiser=optax.adam(0.05), iterations=100, progress=False)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = lj.fit(system, records, {"k": 3.0, "sane": 1.0}, **options)
    assert any("100 of 300 motions stopped early" in str(w.message) for w in told)
    assert abs(found.params["k"] - 4.0) < 0.05 and int(found.training.failed) == 100
    # Twin: if all fail, the fit is refused.
    with pytest.raises(ValueError, match="from the guess the motion"):
        quietly(system, records[1:2], {"k": 3.0, "sane": 1.0}, **options)


def well(q):
    """A double well."""
    return 0.25 * (q**2 - 1) ** 2


learned = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["potential"](q))


def records_of_well():
    """Eight motions with errors of 0.002."""
    true, rng = lj.System(lambda t, q, v, params: 0.5 * v**2 - well(q)), np.random.default_rng(0)
    ts = np.linspace(0.0, 6.0, 121)
    for q0, v0 in rng.uniform([-1.6, -0.4], [1.6, 0.4], (8, 2)):
        q = np.asarray(lj.integrate(true, q0, v0, ts=ts).q)
        yield lj.Record(ts, q=q + 0.002 * rng.normal(size=len(ts)), sigma=0.002)


@pytest.mark.exhaustive
def test_a_potential_is_learned(monkeypatch):
    """With batches, held-back residuals fall to sigma and the best parameters count; a seed is reproducible; nothing is
    compiled a second time, even after an interrupt.
    """
    records, net = list(records_of_well()), lj.learned.Network(1.0, key=jax.random.key(0))
    steps = 1000
    train = lambda seed=0: quietly(
        learned, records, {"potential": net}, window=1.0, joined=False, batch=16, held_back=0.25, seed=seed,
        optimiser=optax.adam(optax.cosine_decay_schedule(2e-2, steps)), iterations=steps, rtol=1e-6, atol=1e-6,
    )  # fmt: skip
    found = train()
    course = found.training
    assert np.nanmin(course.scores) < 2 < 20 < course.scores[0]
    assert course.judged[np.nanargmin(course.scores)] == course.best
    assert course.held_back.names == () and 0.001 < course.held_back.rms()["q"] < 0.004
    q = jnp.linspace(-1.3, 1.3, 27)
    off = jax.vmap(found.params["potential"])(q) - well(q)
    assert float(jnp.max(jnp.abs(off - jnp.mean(off)))) < 0.1
    assert "held-back" in repr(found) and course.plot().axes
    assert 0.001 < found.rms()["q"] < 0.004

    calls = []

    def interrupted(*args):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return round_of(*args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(trained, "round_of", interrupted)
        train()
    with compiles() as count:
        again = train()
    assert count == []
    np.testing.assert_array_equal(again.values, found.values)
    assert np.any(train(1).values != found.values)


@pytest.mark.exhaustive
def test_patience():
    """Training with too large a rate ends early, with the guess; twin: with more patience it continues."""
    options = dict(optimiser=optax.sgd(10.0), iterations=200, held_back=[record(5)])
    found = quietly(spring, [record()], {"k": 4.0}, patience=2, **options)
    assert bool(found.training.early) and int(found.steps) == 20 < 200
    assert found.params["k"] == 4.0 and int(found.training.best) == 0
    assert int(quietly(spring, [record()], {"k": 4.0}, patience=4, **options).steps) == 40


@pytest.mark.exhaustive
def test_inside_of_a_program():
    """Under jit and in lanes, a training gives the same as a single call."""

    def trained(q):
        held = lj.Record(T, q=np.cos(2 * T), q0=1.0, v0=0.0, sigma=0.01)
        options = dict(optimiser=optax.adam(0.05), iterations=60, held_back=held, progress=False)
        found = lj.fit(spring, lj.Record(T, q=q, q0=1.0, v0=0.0, sigma=0.01), {"k": 3.5}, **options)
        return found.params["k"], found.training.scores

    measured = np.stack([record(i).measured["q"] for i in range(2)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lj.FitWarning)
        alone = [trained(q) for q in measured]
    k, scores = jax.jit(jax.vmap(trained))(measured)
    np.testing.assert_allclose(k, [x for x, _ in alone], rtol=1e-8)
    np.testing.assert_allclose(scores, np.stack([s for _, s in alone]), rtol=1e-6)


@pytest.mark.exhaustive
def test_bounds_forgiveness_and_modules():
    """Bounds hold, a Huber loss tolerates outliers, and a module in params can be fitted by name."""
    rng = np.random.default_rng(1)
    r = record(3)
    wild = np.where(rng.random(len(T)) < 0.1, 1.0, 0.0)
    dirty = lj.Record(T, q=r.measured["q"] + wild, q0=1.0, v0=0.0, hold_q=True, hold_v=True, sigma=0.01)
    options = dict(bounds={"k": (0.0, None)}, optimiser=optax.adam(0.02), iterations=300)
    robust = quietly(spring, dirty, {"k": 3.5}, loss="huber", **options)
    plain = quietly(spring, dirty, {"k": 3.5}, **options)
    assert abs(robust.params["k"] - 4) < 0.05 < abs(plain.params["k"] - 4)
    net = eqx.nn.MLP("scalar", "scalar", 4, 1, jnp.tanh, key=jax.random.key(0))
    system = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v**2 - p["potential"](q))
    found = quietly(
        system, record(), {"m": 1.0, "potential": net}, free="potential", optimiser=optax.adam(1e-4), iterations=3
    )
    assert found.params["m"] == 1.0 and len(found.names) == 13
    assert np.any(found.params["potential"].layers[0].weight != net.layers[0].weight)
