"""What `fit` minimises as a function: against the fit, formulas and finite differences."""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import formula, in_closed_form

T = np.linspace(0.0, 3.0, 31)
EXACTLY = {"rtol": 1e-9, "atol": 1e-9}
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
        return lj.fit(*args, **{"progress": False} | EXACTLY | options)


def oscillation(t, q, v, params):
    """The motion of the spring."""
    w = jnp.sqrt(params["k"])
    return q * jnp.cos(w * t) + v / w * jnp.sin(w * t), v * jnp.cos(w * t) - q * w * jnp.sin(w * t)


@pytest.mark.parametrize("system", [formula, pytest.param(spring, marks=pytest.mark.exhaustive)])
def test_the_loss_of_a_step_is_the_formula(monkeypatch, system):
    """At known starts: half the sum of squares, its slope by k, the prior's part, and what a batch stands for."""
    if system is formula:
        in_closed_form(monkeypatch, oscillation)
    records, prior = [record(), record(1, amplitude=0.5)], (5.0, 0.5)
    loss = lj.fit_loss(system, records, {"k": 3.9}, priors={"k": prior}, **EXACTLY)
    bare = lj.fit_loss(system, records, {"k": 3.9}, **EXACTLY)
    w, at = np.sqrt(3.9), {"params": {"k": np.array(3.9)}, "starts": np.zeros((2, 0))}
    assert loss.windows == 2
    off = [a * np.cos(w * T) - r.measured["q"] for a, r in zip((1.0, 0.5), records)]
    slope = [-a * T * np.sin(w * T) / (2 * w) for a in (1.0, 0.5)]
    of_prior = (3.9 - prior[0]) / prior[1]

    @jax.jit
    def program(at):
        return jax.value_and_grad(loss)(at), [loss(at, [i]) for i in (0, 1)], bare(at), (loss.guess, loss.params(at))

    (value, by), alone, without, (guess, params) = program(at)
    assert eqx.tree_equal(jax.tree.map(np.asarray, guess), at) and params == {"k": 3.9}
    np.testing.assert_allclose(value, 0.5 * (np.sum(np.square(off)) / 0.01**2 + of_prior**2), rtol=1e-6)
    np.testing.assert_allclose(by["params"]["k"], np.sum(np.multiply(off, slope)) / 0.01**2 + of_prior / prior[1], 1e-5)
    np.testing.assert_allclose(alone, [np.sum(x**2) / 0.01**2 + 0.5 * of_prior**2 for x in off], rtol=1e-6)
    np.testing.assert_allclose(np.mean(alone), value, rtol=1e-12)
    # Twin: without the prior it is another function.
    assert abs(without - value) > 1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"window": 1.0, "joined": False},
        {"window": 1.0},
        {"priors": {"k": (4.1, 0.05)}, "bounds": {"k": (0.0, None)}},
        {"loss": "huber"},
    ],
    ids=["whole", "windows", "joined", "prior and bound", "robust"],
)
def test_a_fit_ends_at_its_minimum(options):
    """At the end of a fit the loss is its cost, half the sum of squares, without a slope; twin: the guess."""
    records = [record(i, known=False) for i in range(2)]
    found = quietly(spring, records, {"k": 3.8}, **options)
    loss = lj.fit_loss(spring, records, found.params, **options, **EXACTLY)
    residuals = lj.fit_residuals(spring, records, found.params, **options, **EXACTLY)
    end = loss.guess | {"starts": found.sampling["starts"]}
    np.testing.assert_allclose(loss(end), found.cost, rtol=1e-7)
    np.testing.assert_allclose(0.5 * np.sum(residuals(end) ** 2), found.cost, rtol=1e-7)
    size = lambda tree: float(jnp.max(jnp.abs(jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)]))))
    nearby = jax.tree.map(lambda x: x + 0.01, end)
    assert size(jax.grad(loss)(end)) < 1e-4 * size(jax.grad(loss)(nearby))


class Layer(eqx.Module):
    """A network of one layer."""

    weights: np.ndarray
    activation: Callable

    def __call__(self, x):
        return jnp.sum(self.activation(self.weights * x))


def test_unknowns_have_the_structure_of_params():
    """None for what is not free, a vector for some entries of an array, a module; and back within the bounds."""
    params = {"m": np.array([1.0, 2.0]), "potential": Layer(np.array([0.5, -0.25]), jnp.tanh), "k": 4.0, "g": 9.8}
    system = lj.System(lambda t, q, v, p: 0.5 * p["m"][0] * v**2 - p["potential"](q) - 0.5 * p["k"] * q**2)
    loss = lj.fit_loss(system, record(), params, free=["potential", "m[1]", "k"], bounds={"k": (0.0, None)})
    at = jax.tree.map(np.asarray, eqx.filter_jit(lambda: loss.guess)()["params"])
    assert at["m"].shape == (1,) and at["potential"].activation is None and at["g"] is None
    assert len(jax.tree.leaves(at)) == 3
    np.testing.assert_allclose(at["k"], np.log(4.0), rtol=1e-12)
    again = eqx.filter_jit(loss.params)({"params": at | {"m": at["m"] + 1.0}})
    np.testing.assert_array_equal(again["m"], [1.0, 3.0])
    np.testing.assert_allclose(again["k"], 4.0, rtol=1e-12)
    np.testing.assert_array_equal(again["potential"].weights, params["potential"].weights)
    assert again["potential"].activation is jnp.tanh and again["g"] == 9.8
    assert "loss" in repr(loss) and "1 starts" in repr(loss)


def test_what_does_not_go_together():
    """A batch of joined windows; optax or arguments of a training in `fit`, which name the recipe."""
    import optax

    residuals = lj.fit_residuals(spring, record(known=False), {"k": 3.9}, window=1.0)
    with pytest.raises(ValueError, match="continue each other and make no batches.\nFix: joined=False"):
        residuals({}, [0])
    with pytest.raises(ValueError, match="free names 'c'"):
        lj.fit_loss(spring, record(), {"k": 3.9}, free="c")
    with pytest.raises(ValueError, match="the motion has no such name|the motion has"):
        lj.fit_loss(spring, lj.Record(T, q={"x": T}, q0=1.0, v0=0.0), {"k": 3.9})
    for options, words in (
        ({"optimiser": optax.sgd(0.1)}, "an optimiser of optax was given"),
        ({"batch": 3, "patience": 2}, "'batch' and 'patience', of a training, was given"),
    ):
        with pytest.raises(TypeError, match=words) as refused:
            lj.fit(spring, record(), {"k": 3.0}, **options)
        assert "Fix: loss = lj.fit_loss(" in str(refused.value) and "docs/learned.md" in str(refused.value)
    with pytest.raises(TypeError, match="optimistix's least-squares solvers or minimisers"):
        lj.fit(spring, record(), {"k": 3.0}, optimiser=optax.sgd)


@pytest.mark.exhaustive
def test_what_fails_moves_nothing():
    """A motion with NaN has a constant loss without a slope, and the others keep theirs; a fit then tells."""
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * (p["k"] + 0.0 * jnp.sqrt(p["sane"])) * q**2)
    records = [record(i, params={"sane": sane}) for i, sane in enumerate((1.0, -1.0, 1.0))]
    loss = lj.fit_loss(system, records, {"k": 3.0, "sane": 1.0}, free="k", **EXACTLY)
    value, slopes = jax.value_and_grad(loss)(loss.guess, [1])
    # Ten spreads of the data, at each sample but the first.
    assert value > 3 * 0.5 * 30 * (10 * 0.5 / 0.01) ** 2 and slopes["params"]["k"] == 0.0
    all_of_them, others = (jax.grad(loss)(loss.guess, which)["params"]["k"] for which in (None, [0, 2]))
    np.testing.assert_allclose(all_of_them, others * 2 / 3, rtol=1e-9)
    with pytest.raises(ValueError, match="from the guess the motion|record 1"):
        quietly(system, record(1, known=False, params={"sane": -1.0}), {"k": 4.0, "sane": 1.0}, free=[])


learned = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["potential"](q))


def test_the_share_of_motions_that_fail_in_closed_form(monkeypatch):
    """Motions of amplitudes beyond 1/p fail: the share stands beside the loss, in which they count ten spreads each and
    have no slope."""
    in_closed_form(monkeypatch, lambda t, q, v, p: (jnp.where(p["p"] * q < 1, p["p"] * q * t, jnp.nan), v + 0 * t))
    t, amplitudes = np.linspace(0.0, 1.0, 11), np.arange(1.0, 5.0)
    held = dict(v0=0.0, hold_q=True, hold_v=True, sigma=0.1)
    records = [lj.Record(t, q=0 * t, q0=a, **held) for a in amplitudes[:-1]] + [lj.Record(t, q=t, q0=4.0, **held)]
    loss = lj.fit_loss(formula, records, {"p": 0.1})
    unknowns = lambda p: {"params": {"p": p}, "starts": np.zeros((4, 0))}
    judged = jax.jit(jax.vmap(jax.value_and_grad(lambda p: loss.with_failed(unknowns(p)), has_aux=True)))
    p = np.array([0.2, 0.3, 0.4, 0.6])
    (value, failed), slope = map(np.asarray, judged(p)[0]), np.asarray(judged(p)[1])
    np.testing.assert_array_equal(failed, [0.0, 0.25, 0.5, 0.75])
    spread = np.std(np.concatenate([np.zeros(33), t]))
    for i, share in enumerate(p):
        goes, off = share * amplitudes < 1, np.array([0.0, 0.0, 0.0, 1.0])
        reached = (share * amplitudes - off)[goes, None] * t / 0.1
        failing = 11 * np.sum(~goes) * (10 * spread / 0.1) ** 2
        assert value[i] == pytest.approx(0.5 * (np.sum(reached**2) + failing), rel=1e-9)
        assert slope[i] == pytest.approx(np.sum(reached * amplitudes[goes, None] * t / 0.1), rel=1e-9)


@pytest.mark.exhaustive
def test_a_fit_says_the_share_of_motions_that_fail():
    """Beyond a wall at 1/p nothing is defined; twin: the loss, which says the same share."""
    walled = lj.System(lambda t, q, v, params: 0.5 * v**2 + 0.1 * jnp.log(1 - params["p"] * q))
    t = np.linspace(0.0, 1.0, 11)
    records = [lj.Record(t, q=a * np.cos(t), q0=a, v0=0.0, hold_q=True, sigma=0.1) for a in (1.0, 2.0, 3.0, 4.0)]
    with pytest.warns(lj.FitWarning) as told:
        lj.fit(walled, records, {"p": 0.4}, free=[])
    words = "2 of 4 motions (50 %), the first of them of record 2, stop early"
    assert any(words in str(warning.message) for warning in told)
    loss = lj.fit_loss(walled, records, {"p": 0.4})
    (_, failed), slopes = jax.jit(jax.value_and_grad(loss.with_failed, has_aux=True))(loss.guess)
    assert failed == 0.5 and np.isfinite(slopes["params"]["p"])
