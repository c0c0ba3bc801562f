"""Starts of a fit: read off the data, on the constraints for any unknowns, and those that the data do not see."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.fit import residuals
from lagjax.fit.residuals import check_predicted, starts_at
from lagjax.fit.unknowns import _guess, _parabola
from lagjax.numerics import Unknowns
from tests.fit.cases import CASES, pendulum


@pytest.mark.exhaustive
def test_a_start_that_the_data_do_not_see():
    """The start of an unmeasured, uncoupled coordinate is not determined; without a guess of it the fit is refused."""
    both = lambda t, q, v, p: 0.5 * (v["a"] ** 2 + v["b"] ** 2) - 0.5 * p["k"] * q["a"] ** 2 - 0.5 * q["b"] ** 2
    ts = np.linspace(0.0, 4.0, 60)
    record = lj.Record(ts, q={"a": np.cos(2 * ts)}, q0={"a": 1.0, "b": 0.5})
    found = lj.fit(lj.System(both), record, {"k": 3.0})
    np.testing.assert_allclose(found.values, [4.0], rtol=1e-8)
    assert np.isnan(found.start_sd[0][0]["b"]) and np.isfinite(found.start_sd[0][0]["a"])
    assert "b(0)    0.5 (not determined)" in repr(found)
    with pytest.raises(ValueError, match="(?s)asks for 'b'.*start of record 0 was read off what it measures, 'a'"):
        lj.fit(lj.System(both), lj.Record(ts, q={"a": np.cos(2 * ts)}), {"k": 3.0})


@pytest.mark.parametrize("wild", [0, 3, 6])
def test_a_start_is_read_off_without_wild_values(wild):
    """An outlier among the first seven samples hardly changes the position and velocity that are read off."""
    t = 0.05 * np.arange(40.0)
    x = 1.0 + 0.5 * t - 2.0 * t**2 + 1e-3 * np.random.default_rng(0).normal(size=40)
    x[wild] += 3.0
    q, v = _parabola(t, x, np.arange(40))
    assert abs(q - 1.0) < 0.01 and abs(v - 0.5) < 0.1
    # Twin: least squares follow the outlier; a parabola through samples far apart keeps them all.
    near = np.polynomial.Polynomial.fit(t[:7], x[:7], 2)
    assert abs(near(0.0) - 1.0) > 0.1 or abs(near.deriv()(0.0) - 0.5) > 1.0
    t, far = np.arange(7.0), np.cos(0.8 * np.arange(7.0))
    near = np.polynomial.Polynomial.fit(t, far, 2)
    np.testing.assert_allclose(_parabola(t, far, np.arange(7))[0], near(0.0))


@pytest.mark.slow
def test_coordinates_of_several_shapes_that_are_not_measured_start_at_rest():
    """A record of the pose of one body gives its velocity too, and another one starts at rest."""
    t = np.linspace(0.0, 1.0, 11)
    pose = lj.bodies.Pose(np.stack([3.0 * t, 0 * t, t**2], axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (11, 1)))
    body = lj.bodies.Body("body", 1.0, (1.0, 1.0, 1.0))
    record = lj.Record(t, q={"body": pose}, v={})
    guess = _guess(lj.bodies.multibody([body]), record, 0, None)
    np.testing.assert_allclose(guess.v["body"].position, [3.0, 0.0, 0.0], atol=1e-12)
    at_rest = _guess(
        lj.bodies.multibody([body]), lj.Record(t, q={"body": pose}, q0={"body": lj.bodies.Pose.at()}), 0, None
    )
    assert jax.tree.map(np.shape, at_rest.v) == {"body": lj.bodies.Pose((3,), (4,))}


@cache
def on_a_rod():
    """A fit of a pendulum on a rod, at its start at the rod's side."""
    zeros = np.zeros(60)
    return CASES["pendulum on a rod"].problem({"q": {"x": zeros, "y": zeros}, "multipliers": {"rod": zeros}})


def test_unknowns_of_a_start_keep_to_the_constraints():
    """A start satisfies the constraints for any unknowns and parameters."""
    p = on_a_rod()
    assert p.start.local.shape == (1, 2)
    for own in ([0.3, -0.5], [-0.5, 1.0]):
        (q, v), _ = starts_at(p, Unknowns(np.array([2.4, 1.0]), np.array([own])), np.array([0]))
        assert abs(q["x"] ** 2 + q["y"] ** 2 - 2.4**2) < 1e-12
        assert abs(q["x"] * v["x"] + q["y"] * v["y"]) < 1e-12


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"q": {"z": np.zeros((1, 60))}}, "as q has 'z', which is no name of the motion; there are 'x' and 'y'"),
        ({"multipliers": {"rope": np.zeros((1, 60))}}, "measured as multipliers has 'rope'(.|\n)*'rod'"),
        ({"q": np.zeros((1, 60))}, "but the motion has(.|\n)*in that structure"),
        ({"q": {"x": np.zeros((1, 60, 1))}}, r"'x' was measured with the shape \(1,\) at each time, but"),
    ],
)
def test_what_the_motion_does_not_have(measured, words):
    """Names, structures and shapes that the motion does not have are refused; twin: those that it has."""
    check_predicted(on_a_rod())
    with pytest.raises(ValueError, match=words):
        check_predicted(replace(on_a_rod(), measured=measured))


def test_a_motion_that_fails(monkeypatch):
    """The record whose motion fails is named, with the message of `integrate`; twin: if all end well nothing is."""

    def integrate(system, q, v, params, *, ts, throw, **options):
        raise ValueError(f"{q} after {v} with {params} at {ts}, {throw}, {options}")

    monkeypatch.setattr(residuals, "integrate", integrate)
    setting = lambda x, s, w, stage: ("ts", x, (s, w), {"throw": False, "rtol": 1e-3})
    problem = SimpleNamespace(system=pendulum, setting=setting, windows=SimpleNamespace(record=np.array([0, 7])))
    residuals.check_motion(problem, np.array([True, True]), Unknowns("x", "ab"))
    words = "the motion of record 7 fails: b after 1 with x at ts, True, {'rtol': 0.001}"
    with pytest.raises(ValueError, match=f"from the guess {words}"):
        residuals.check_motion(problem, np.array([True, False]), Unknowns("x", "ab"))
