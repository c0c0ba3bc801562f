"""One motion to its end or its event, which is located by the method; in lanes, with derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.solve import one_motion
from lagjax.mechanics import equations_of
from lagjax.system import coordinates, model_of
from tests.systems import HORIZONTAL, PARAMS, pendulum, rod_pendulum


@pytest.mark.exhaustive
def test_event_is_located_by_the_method():
    """The rod pendulum passes the vertical at its quarter period, 1e-9 from the elliptic integral, and NaN follows."""
    special = pytest.importorskip("scipy.special")
    quarter = special.ellipk(0.5) * np.sqrt(PARAMS["l"] / PARAMS["g"])
    event = diffrax.Event(lambda t, y, params, **kwargs: y[0]["x"])
    traj = lj.integrate(
        rod_pendulum, *HORIZONTAL, PARAMS, ts=np.array([0.0, 0.25, 2.0]), rtol=1e-11, atol=1e-11, event=event
    )
    assert abs(float(traj.end.t) - quarter) < 1e-9 * quarter
    assert float(traj.end.q["x"]) == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(traj.end.multipliers["rod"], -3 * PARAMS["g"] / PARAMS["l"] / 2, rtol=1e-9)
    assert np.isfinite(traj.q["x"]).tolist() == [True, True, False]
    assert bool(traj.result == lj.RESULTS.event_occurred)


@pytest.mark.exhaustive
def test_a_long_loop_in_parts(monkeypatch):
    """A mass on a rod whose angle has no mass of its own, 1e-9 from the elliptic function, its loop compiled in parts.

    Twin: below the limit the same loop is one function.
    """
    special = pytest.importorskip("scipy.special")
    in_parts, made = [], one_motion._solver

    def seen(*given):
        in_parts.append(made(*given).in_parts)
        return made(*given)

    def hangs(t, q, params):
        return q["at"] - params["l"] * jnp.stack([jnp.sin(q["angle"]), -jnp.cos(q["angle"])])

    def lagrangian(t, q, v, params):
        return 0.5 * v["at"] @ v["at"] - params["g"] * q["at"][1]

    hanging = lj.System(lagrangian, {"rod": lj.Holonomic(hangs)})
    q0 = {"at": PARAMS["l"] * np.array([np.sin(0.9), -np.cos(0.9)]), "angle": np.array(0.9)}
    v0 = {"at": np.zeros(2), "angle": np.array(0.0)}
    ts, rate, k = np.linspace(0.0, 1.0, 4), np.sqrt(PARAMS["g"] / PARAMS["l"]), np.sin(0.45)
    monkeypatch.setattr(one_motion, "_solver", seen)
    monkeypatch.setattr(one_motion, "IN_PARTS_FROM", 0)
    traj = lj.integrate(hanging, q0, v0, PARAMS, ts=ts, rtol=1e-11, atol=1e-11)
    _, cn, dn, _ = special.ellipj(rate * ts, k**2)
    np.testing.assert_allclose(traj.q["angle"], 2 * np.arcsin(k * cn / dn), atol=1e-9)
    assert in_parts and all(in_parts)
    equations = equations_of(model_of(hanging, *coordinates.state(0.0, q0, v0, PARAMS)), fast=True)
    assert one_motion._is_long(equations)
    monkeypatch.setattr(one_motion, "IN_PARTS_FROM", 1000)
    assert not one_motion._is_long(equations)


@pytest.mark.exhaustive
def test_lanes_with_and_without_an_event():
    """A batch may mix lanes that reach the event, that do not, and that fail; a true-or-false condition works too."""
    event = diffrax.Event({"bottom": lambda t, y, p, **kwargs: y[0], "late": lambda t, y, p, **kwargs: t > 1.5})
    run = lambda q0, end: lj.integrate(
        pendulum, q0, 0.0, PARAMS, ts=jnp.stack([jnp.zeros_like(end), end]), event=event, throw=False
    )
    batch = jax.jit(jax.vmap(run))(jnp.array([0.5, 0.5, jnp.nan, 3.14]), jnp.array([2.0, 0.25, 1.0, 2.0]))
    results = [
        batch.result == r for r in (lj.RESULTS.event_occurred, lj.RESULTS.successful, lj.RESULTS.start_not_finite)
    ]
    assert np.array(results).T.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]]
    assert abs(float(batch.end.q[0])) < 1e-12
    assert float(batch.end.t[1]) == 0.25
    assert float(batch.end.t[3]) == pytest.approx(1.5, abs=1e-12)
