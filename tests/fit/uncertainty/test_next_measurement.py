"""What to measure next: predicted standard deviations agree with formulas and with repeated fits."""

from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.fit import next_measurement
from lagjax.fit.arguments import problem_of
from lagjax.fit.next_measurement import Survey, next_measurements
from lagjax.fit.search import LinearisedResiduals
from lagjax.numerics import Slopes
from tests.counting import compiles
from tests.fit.cases import CASES, HUNG, PENDULUM, TS, formula, hung, in_closed_form, noisy, pendulum

T, LONG = np.linspace(0.0, 2.0, 21), np.linspace(0.0, 4.0, 21)
SIGMA = 0.01
fall = lj.System(lambda t, q, v, p: 0.5 * v**2 + p["g"] * q)
fallen = lj.Record(T, q=5.0 * T**2, sigma=SIGMA)
# A spring that a known force may pull: without it only k/m is determined.
pulled = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v["x"] ** 2 - 0.5 * p["k"] * q["x"] ** 2 + p["F"] * q["x"])
PULLED = {"m": 1.0, "k": 4.0, "F": 0.0}


def parabola(t):
    """The slopes of q = q0 + v0 t + g t²/2 by g, q0 and v0."""
    return np.stack([t**2 / 2, np.ones_like(t), t], axis=1) / SIGMA


def sds(rows):
    """Standard deviations from normal equations."""
    return np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))


def two_runs(first, second, held=False):
    """The slopes of two falls with the same g; the start of the second is unknown or held."""
    rows = np.zeros((len(first) + len(second), 3 if held else 5))
    rows[: len(first), :3] = first
    rows[len(first) :, 0] = second[:, 0]
    rows[len(first) :, 3:] = second[:, 1 : 1 if held else 3]
    return rows


def pull(t, q, v, p):
    """The motion of the pulled spring."""
    w, rest = jnp.sqrt(p["k"] / p["m"]), p["F"] / p["k"]
    away = q["x"] - rest
    return {"x": rest + away * jnp.cos(w * t) + v["x"] / w * jnp.sin(w * t)}, {"x": v["x"] * jnp.cos(w * t)}


@pytest.mark.slow
@pytest.mark.parametrize("system", [formula, pytest.param(pulled, marks=pytest.mark.exhaustive)])
def test_what_is_not_determined(monkeypatch, system):
    """A spring determines only k/m; a run with a known force would determine k, as the formula says, another not."""
    if system is formula:
        in_closed_form(monkeypatch, pull)
    t = np.linspace(0.0, 6.0, 40)
    of = lambda force: lj.Record(
        t, q={"x": np.zeros(40)}, q0={"x": 0.5}, v0={"x": 0.0}, sigma=0.01, params={"F": force}
    )
    ask = lambda **more: lj.identifiability(system, of(0.0), PULLED, free=["k", "m"], **more)
    asked = ask(shrink="k", candidates={"free": of(0.0), "pulled": of(2.0)})
    told = asked.next
    assert asked.combined() == ["k/m"] and np.isinf(told.now)
    assert told.best.name == "pulled" and np.isinf(told["free"].sd)
    words = repr(asked)
    assert "'k' is not determined by these data" in words and "not determined" in words.splitlines()[-2]

    def rows(x, start, force):
        return pull(t, {"x": start[0]}, {"x": start[1]}, {"k": x[0], "m": x[1], "F": force})[0]["x"] / 0.01

    x, start = jnp.array([4.0, 1.0]), jnp.array([0.5, 0.0])
    slopes = [jax.jacfwd(rows, (0, 1))(x, start, force) for force in (0.0, 2.0)]
    both = np.zeros((80, 6))
    both[:40, :2], both[:40, 2:4] = slopes[0]
    both[40:, :2], both[40:, 4:] = slopes[1]
    np.testing.assert_allclose(told.best.sd, sds(both)[0], rtol=1e-6)
    # The frequency, a function of the parameters, is determined: it has its own formula, and late times are best.
    w = lambda params: jnp.sqrt(params["k"] / params["m"])
    told = ask(shrink=w).next
    alone = both[:40, [0, 2, 3]]
    np.testing.assert_allclose(told.now, sds(alone)[0] * 0.5 / np.sqrt(4.0), rtol=1e-6)
    assert told.best.times[0] > 8.0 and told.best.sd < 0.7 * told.now
    for wrong, words in ((lambda p: p["F"], "does not depend on the fitted"), (lambda p: jnp.ones(2), "single number")):
        with pytest.raises(ValueError, match=words):
            ask(shrink=wrong)
    # Twin: a candidate with the same force determines the mass no better.
    assert np.isinf(ask(shrink="m", candidates={"free": of(0.0)}).next.best.sd)


@pytest.mark.exhaustive
def test_constraints_forces_and_observations():
    """On a rod only its force determines the mass, also among the combinations of what was measured."""
    case = CASES["pendulum on a rod"]
    start = {"q0": case.q0, "v0": case.v0}
    zeros = {"x": np.zeros(60), "y": np.zeros(60)}
    record = lj.Record(case.ts, q=zeros, **start, sigma=0.02)
    candidates = {
        "motion": lj.Record(case.ts, q=zeros, **start, sigma=0.02),
        "force": lj.Record(case.ts, multipliers={"rod": np.zeros(60)}, **start, sigma=0.1),
    }
    told = lj.identifiability(hung, record, HUNG, free=["g", "l", "m"], shrink="m", candidates=candidates).next
    assert np.isinf(told.now) and told.best.name == "force" and np.isinf(told["motion"].sd)
    further = lj.identifiability(hung, record, HUNG, free=["g", "l"], shrink="g").next
    assert {c.name for c in further.candidates} == {"x", "y", "v.x", "v.y"}
    assert lj.identifiability(hung, record, HUNG, free=["g", "l", "m"]).unseen() == ["m"]


@pytest.mark.exhaustive
def test_windows_runs_without_sigma_and_several():
    """Without sigma results are multiples of an error; records are distinguished; each window has its own start."""
    plain = lj.identifiability(fall, lj.Record(T, q=5.0 * T**2), {"g": 9.81}, shrink="g").next
    scaled = lj.identifiability(fall, fallen, {"g": 9.81}, shrink="g").next
    assert not plain.absolute and {c.name for c in plain.candidates} == {"q"}
    np.testing.assert_allclose([plain.now * SIGMA, plain.best.sd * SIGMA], [scaled.now, scaled["q"].sd], rtol=1e-8)
    assert "errors of a measurement" in repr(plain)
    times, sd = plain["q"].at_best(2)
    np.testing.assert_allclose(sd * SIGMA, scaled["q"].at_best(2)[1], rtol=1e-8)

    records = [fallen, lj.Record(LONG, q=5.0 * LONG**2, sigma=0.1)]
    told = lj.identifiability(fall, records, {"g": 9.81}, shrink="g").next
    np.testing.assert_allclose(told.now, sds(two_runs(parabola(T), parabola(LONG) / 10))[0], rtol=1e-8)
    # Twin: with the error of the other record.
    assert not np.allclose(told["q of record 0"].alone, told["q of record 1"].alone[:42], rtol=1e-3)

    cut = lj.identifiability(fall, fallen, {"g": 9.81}, shrink="g", window=1.0, candidates={"again": fallen}).next
    halves = [parabola(t - t[0])[:, [0, 1, 2]] for t in (T[:10], T[10:])]
    np.testing.assert_allclose(cut.now, sds(two_runs(*halves))[0], rtol=1e-8)
    np.testing.assert_allclose(cut.best.sd, cut.now / np.sqrt(2), rtol=1e-8)


RUN = {"q0": 0.0, "v0": 0.0}


def problem_for(records, free=("g",)):
    """The problem of some falls."""
    return problem_of(fall, records, {"g": 9.81}, list(free), None, None, None, "squares", None, {}, weak=False)


def of_a_fall(problem, u):
    """What `survey` tells of falls, in closed form: their slopes where something is measured."""
    t = problem.windows.ts - problem.windows.ts[:, :1]
    counts = np.arange(t.shape[1]) <= problem.windows.last[:, None]
    by = {"q": np.stack([t**2 / 2, np.ones_like(t), t], axis=2), "v": np.stack([t, 0 * t, np.ones_like(t)], axis=2)}
    known = {kind: np.isfinite(x) & np.isfinite(problem.sigma[kind]) & counts for kind, x in problem.measured.items()}
    rows = [np.where(known[kind], 1 / problem.sigma[kind], 0.0)[..., None] * by[kind] for kind in problem.measured]
    along = np.concatenate([problem.starts.q.along, problem.starts.v.along], axis=1)
    rows, nothing = np.concatenate(rows, axis=1), np.zeros((len(t), 0, 1))
    slopes = Slopes(rows[..., :1], rows[..., 1:] @ along, nothing, nothing, nothing, np.zeros((1, 1)))
    return Survey(LinearisedResiduals(None, slopes, np.ones(len(t), bool)), None)


def asked(candidates=None, shrink="g", records=(fallen,)):
    """What to measure next, with slopes in closed form: nothing is integrated or compiled."""
    problem = problem_for(list(records))
    at = of_a_fall(problem, problem.start)
    return next_measurements(problem, list(records), at, shrink, candidates, problem_for)


def test_further_falls_in_closed_form(monkeypatch):
    """The error of g after another fall, a longer or a known one, one more measurement, and for two records."""
    monkeypatch.setattr(next_measurement, "survey", of_a_fall)
    zeros, first = {"q": np.zeros(21), "sigma": SIGMA, **RUN}, parabola(T)
    told = asked({
        "longer": lj.Record(LONG, **zeros),
        "again": lj.Record(T, **zeros),
        "from a stand": lj.Record(LONG, **zeros, hold_q=True, hold_v=True),
    })  # fmt: skip
    assert [c.name for c in told.candidates] == ["from a stand", "longer", "again"] and told.absolute
    exact = [sds(two_runs(first, parabola(LONG), held=True))[0], sds(two_runs(first, parabola(LONG)))[0]]
    np.testing.assert_allclose([c.sd for c in told.candidates], [*exact, told.now / np.sqrt(2)], rtol=1e-9)
    np.testing.assert_allclose(told.now, sds(first)[0], rtol=1e-9)
    times, sd = told["longer"].at_best(3)
    np.testing.assert_allclose(times, [0.0, 2.0, 4.0])
    np.testing.assert_allclose(sd, sds(two_runs(first, parabola(times)))[0], rtol=1e-9)
    assert "longer" in repr(told) and "(measured: q to 0.01)" in repr(told)
    # Further measurements: of the position or, as exactly, of the velocity; twin: not as if none were made.
    told = asked()
    of_rate = lambda t: np.stack([t, 0 * t, 1 + 0 * t], axis=1) / SIGMA
    assert {c.name for c in told.candidates} == {"q", "v"} and told.best.name == "q" and "q at t = 4.1" in repr(told)
    for name, slopes in (("q", parabola(told["q"].t)), ("v", of_rate(told["v"].t))):
        after = [sds(np.concatenate([first, row[None]]))[0] for row in slopes]
        np.testing.assert_allclose(told[name].alone, after, rtol=1e-8)
        assert told[name].times[0] == told[name].t[-1] == pytest.approx(4.1)
    assert not np.allclose(told["q"].alone, told.now, rtol=0.3)
    # Two records: a measurement in one of them, whose errors are larger.
    told = asked(records=(fallen, lj.Record(LONG, q=5.0 * LONG**2, sigma=0.1)))
    assert {c.name for c in told.candidates} == {f"{x} of record {r}" for x in "qv" for r in (0, 1)}
    rows, second = two_runs(first, parabola(LONG) / 10), told["q of record 1"]
    further = np.zeros((len(second.t), 5))
    further[:, [0, 3, 4]] = parabola(second.t) / 10
    np.testing.assert_allclose(second.alone, [sds(np.concatenate([rows, x[None]]))[0] for x in further], rtol=1e-8)
    assert told.now == pytest.approx(sds(rows)[0], rel=1e-8)


@pytest.mark.exhaustive
def test_falling():
    """The same from motions, for both kinds of candidates; other candidates compile nothing."""
    zeros = {"q": np.zeros(21), "sigma": SIGMA, **RUN}
    ask = lambda **more: lj.identifiability(fall, fallen, {"g": 9.81}, shrink="g", **more).next
    others = {"longer": lj.Record(LONG, **zeros), "known": lj.Record(LONG, **zeros, hold_q=True, hold_v=True)}
    for candidates in (others, None):
        found = ask(candidates=candidates)
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(next_measurement, "survey", of_a_fall)
            exact = asked(candidates)
        assert [c.name for c in found.candidates] == [c.name for c in exact.candidates]
        np.testing.assert_allclose([found.now, found.best.sd], [exact.now, exact.best.sd], rtol=1e-8)
        np.testing.assert_allclose(found.best.alone, exact.best.alone, rtol=1e-8)
    with compiles() as programs:
        ask(candidates={"twice": lj.Record(2 * T, **zeros)})
    assert programs == []


@pytest.mark.parametrize(
    "more, error, words",
    [
        ({"shrink": "h"}, ValueError, "shrink names 'h', which is no fitted parameter; there .*'g'"),
        ({"candidates": {}}, ValueError, "candidates must hold a record"),
        ({"candidates": {"a": T}}, TypeError, "candidate 'a' must be a lj.Record"),
        ({"candidates": {"a": lj.Record(T, q=T, **RUN)}}, ValueError, "'a' has no sigma, and the records"),
        ({"candidates": {"a": lj.Record(T, q=T * np.nan, sigma=1.0, **RUN)}}, ValueError, "are NaN"),
        ({"shrink": lambda p: np.ones(2)}, ValueError, r"a single number, and returned shape \(2,\)"),
        ({"shrink": lambda p: 0.0 * p["g"]}, ValueError, "does not depend on the fitted parameters"),
    ],
)
def test_words(more, error, words):
    """Arguments that make no sense raise errors in the user's words."""
    with pytest.raises(error, match=words):
        asked(**more)


def test_words_elsewhere(monkeypatch):
    """Candidates without a number to compare them by, a number while none is fitted, and inside a program."""
    with pytest.raises(ValueError, match='shrink="g"'):
        lj.identifiability(fall, fallen, {"g": 9.81}, candidates={"a": fallen})
    with pytest.raises(ValueError, match="no parameter is fitted"):
        next_measurement._direction(problem_for([fallen], free=()), "g")
    monkeypatch.setattr(
        import_module("lagjax.fit.uncertainty"), "survey", lambda problem, u: Survey(None, problem.measured)
    )
    of = lambda q: lj.identifiability(fall, lj.Record(T, q=q, sigma=SIGMA), {"g": 9.81}, shrink="g").next.now
    with pytest.raises(TypeError, match="not in jit, vmap or lj.sweep"):
        jax.jit(of)(5.0 * T**2)


@pytest.mark.exhaustive
def test_identifiability_before_and_after(swinging):
    """A swing determines g/l and c/(m l²); what is not determined gets no uncertainty."""
    record = lj.Record(TS, q=noisy(swinging[0]))
    told = lj.identifiability(pendulum, record, PENDULUM)
    assert told.rank == 2 and told.combined()[0] == "g/l"
    assert "g/l" in repr(told)
    with pytest.warns(lj.FitWarning, match="do not determine"):
        found = lj.fit(pendulum, record, PENDULUM)
    assert np.isnan(found.sd).all() and np.isfinite(found.start_sd[0][0])
    assert "not determined" in repr(found)
    np.testing.assert_allclose(found.values[1] / found.values[2], 9.81 / 1.25, rtol=0.01)
    # Twin: with l known, g and c are determined; m and c only as a ratio.
    assert lj.identifiability(pendulum, record, PENDULUM, free=["g", "c"]).rank == 2
    assert lj.identifiability(pendulum, record, PENDULUM, free=["m", "c"]).combined() == ["c/m"]
    # The scale of L is not determined: all but one common factor.
    scaled = lambda t, q, v, p: 0.5 * p["inertia"] * v**2 + p["weight"] * jnp.cos(q)
    rubbed = lj.System(scaled, dissipation=lambda t, q, v, p: 0.5 * p["drag"] * v**2)
    told = lj.identifiability(rubbed, record, {"inertia": 1.0, "weight": 8.0, "drag": 0.1})
    assert "one common factor of all" in repr(told)
    # A parameter that L does not contain.
    more = PENDULUM | {"colour": 3.0}
    assert lj.identifiability(pendulum, record, more, free=["g", "colour"]).unseen() == ["colour"]
