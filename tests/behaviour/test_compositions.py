"""Combinations of JAX's transformations around a motion: each agrees with pushing tangents forward.

All but one are `exhaustive`: each compiles for 10 to 40 s.

The small network in L has thirty-three numbers, too many to be pushed forward in reverse mode, so that these are the
derivatives that learned Lagrangians have. Each combination is reduced to one number along directions
u and w, which stay the same: a slope g·u, or a curvature u·H·w, which two pushes give.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lagjax as lj
from lagjax.integrate import step_record
from lagjax.integrate.replay import Replay

TS, NODES = np.array([0.0, 0.4, 0.9]), 11
P = 0.3 * np.sin(np.arange(1.0, 3 * NODES + 1))
U, W = np.cos(np.arange(3.0 * NODES)), np.sin(0.5 + np.arange(3.0 * NODES))


def network(p, x):
    """A potential."""
    a, b, c = p.reshape(3, NODES)
    return jnp.sum(c * jnp.tanh(a * x + b))


free = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2 - network(p, q))
held = lj.System(
    lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - q["y"] - network(p, q["x"]),
    {"rod": lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - 1.0)},
)
stiff = lj.System(free.lagrangian, dissipation=lambda t, q, v, p: 50.0 * v**2)
falling = lj.System(lambda t, q, v, p: 0.5 * v**2 - 4.0 * q - network(p, q))
floor = lj.Crossing(lambda t, q, v, p: q, direction=-1)


def of_free(p):
    """All outputs of one coordinate contribute."""
    return jnp.sum(lj.integrate(free, 0.5, 0.0, p, ts=TS, rtol=1e-10).q ** 2)


def of_held(p):
    """The multipliers contribute, too."""
    traj = lj.integrate(held, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.5}, p, ts=TS, rtol=1e-10)
    return jnp.sum(traj.q["x"] ** 2) + jnp.sum(traj.multipliers["rod"])


def of_stiff(p):
    """An implicit method."""
    return jnp.sum(lj.integrate(stiff, 0.5, 0.0, p, ts=TS, rtol=1e-9, method=lj.Radau5()).q ** 2)


def of_event(p):
    """Time and velocity at an event that ends the motion."""
    traj = lj.integrate(falling, 0.5, 0.2, p, ts=TS, rtol=1e-10, events={"floor": floor})
    return traj.end.t**2 + traj.end.v


MOTIONS = {"free": of_free, "held": of_held, "stiff": of_stiff, "event": of_event}
# Two lanes each: at p, and at 1.1 p.
LANES = np.array([1.0, 1.1])
SLOPES = {
    "grad": lambda f: jax.grad(f)(P) @ U,
    "jacfwd": lambda f: jax.jacfwd(f)(P) @ U,
    "jacrev": lambda f: jax.jacrev(f)(P) @ U,
    "vjp": lambda f: jax.vjp(f, P)[1](jnp.ones(()))[0] @ U,
    "jit of grad": lambda f: jax.jit(jax.grad(f))(P) @ U,
    "grad of checkpoint": lambda f: jax.grad(jax.checkpoint(f))(P) @ U,
    "grad of cond": lambda f: jax.grad(lambda p: lax.cond(p[0] > 0, f, jnp.sum, p))(P) @ U,
    "grad of scan": lambda f: jax.grad(lambda p: lax.scan(lambda s, _: (s + f(p), None), 0.0, None, 2)[0])(P) @ U / 2,
}
OF_LANES = {
    "vmap of grad": lambda f: jnp.sum(jax.vmap(lambda s: jax.grad(f)(s * P) @ U)(LANES) * LANES),
    "grad of vmap": lambda f: jax.grad(lambda p: jnp.sum(jax.vmap(lambda s: f(s * p))(LANES)))(P) @ U,
}
CURVATURES = {
    "jvp of grad": lambda f: jax.jvp(jax.grad(f), (P,), (W,))[1] @ U,
    "grad of jvp": lambda f: jax.grad(lambda p: jax.jvp(f, (p,), (U,))[1])(P) @ W,
    "grad of grad": lambda f: jax.grad(lambda p: jax.grad(f)(p) @ U)(P) @ W,
    "hessian": lambda f: U @ jax.hessian(f)(P) @ W,
    "jacrev of jacrev": lambda f: U @ jax.jacrev(jax.jacrev(f))(P) @ W,
    "jit of jvp of grad": lambda f: jax.jit(lambda p: jax.jvp(jax.grad(f), (p,), (W,))[1])(P) @ U,
}
OF_LANES_TWICE = {
    "vmap of jvp of grad": lambda f: jnp.sum(
        jax.vmap(lambda s: jax.jvp(jax.grad(f), (s * P,), (W,))[1] @ U)(LANES) * LANES**2
    ),
    "jvp of grad of vmap": lambda f: (
        jax.jvp(jax.grad(lambda p: jnp.sum(jax.vmap(lambda s: f(s * p))(LANES))), (P,), (W,))[1] @ U
    ),
}
ALL = {**SLOPES, **OF_LANES, **CURVATURES, **OF_LANES_TWICE}


def pushed(function, composition):
    """Return the same number by pushing tangents forward."""
    at = lambda s: lambda p: jax.jvp(function, (s * p,), (s * U,))[1]
    points = LANES if composition in OF_LANES or composition in OF_LANES_TWICE else [1.0]
    if composition in SLOPES or composition in OF_LANES:
        return sum(at(s)(P) for s in points)
    return sum(jax.jvp(at(s), (P,), (W,))[1] for s in points)


@pytest.mark.exhaustive
@pytest.mark.parametrize("composition", ALL)
@pytest.mark.parametrize("motion", MOTIONS)
def test_compositions(motion, composition):
    """Each combination agrees with forward mode along the same directions."""
    function = MOTIONS[motion]
    found, expected = ALL[composition](function), pushed(function, composition)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.exhaustive
def test_third_derivatives_are_refused():
    """A third derivative is refused with a clear message; twin: second derivatives work, above."""
    twice = lambda p: jax.jvp(jax.grad(of_free), (p,), (W,))[1] @ U
    with pytest.raises(NotImplementedError, match="(?s)a third derivative.*Fix: jax.jvp of jax.jvp"):
        jax.jvp(twice, (P,), (U,))


@pytest.mark.exhaustive
def test_a_second_derivative_is_of_one_run(monkeypatch):
    """Values and tangents are of one run, even if each compilation takes other steps, as here. Twin: of two runs."""
    first, traced = step_record._first, []

    def other_each_time(problem):
        place = first(problem)
        traced.append(None)
        return place._replace(t1=place.t + (place.t1 - place.t) / (1 + len(traced) % 3))

    monkeypatch.setattr(step_record, "_first", other_each_time)
    curvature = lambda: jax.jvp(jax.grad(of_free), (P,), (W,))[1] @ U
    expected = pushed(of_free, "jvp of grad")
    np.testing.assert_allclose(curvature(), expected, rtol=1e-7)
    jax.clear_caches()
    monkeypatch.setattr(second_order, "Replay", lambda bent: Replay())
    assert abs(curvature() / expected - 1) > 1e-6
