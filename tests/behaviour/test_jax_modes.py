"""Motions, constraints, events and gradients while JAX's own settings for finding errors are on."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.tiers import exhaustive_but

# A number that stands in each mode's Lagrangian, so that no program of another mode serves it.
MODES = {
    "disable_jit": (jax.disable_jit, 2.0),
    "debug_nans": (partial(jax.debug_nans, True), 3.0),
    "debug_infs": (partial(jax.debug_infs, True), 4.0),
    "strict dtypes": (partial(jax.numpy_dtype_promotion, "strict"), 5.0),
    "enable_checks": (partial(jax.enable_checks, True), 6.0),
}
TS = np.array([0.0, 0.4, 0.9])
TOLERANCE = {"rtol": 1e-8, "atol": 1e-8}


# Each mode compiles programs of its own.
@pytest.fixture(params=exhaustive_but(("debug_nans",), MODES))
def mode(request):
    """Whether JAX is in this mode, in a context of its own, and its number."""
    context, number = MODES[request.param]
    return context, number


def spring(m):
    """A mass m on a spring of stiffness k."""
    return lj.System(lambda t, q, v, params: 0.5 * m * v**2 - 0.5 * params["k"] * q**2)


def raises_in(context, error, act):
    """Twin: the mode is on where the user's own code runs."""
    with context(), pytest.raises(error):
        act()


def test_the_modes_are_on():
    """In each mode that changes what JAX does, something of the user's fails or runs that else does not."""
    zero, one = jnp.zeros(()), jax.device_put(1.0)
    raises_in(MODES["debug_nans"][0], FloatingPointError, lambda: jnp.log(zero - 1.0))
    raises_in(MODES["debug_infs"][0], FloatingPointError, lambda: 1.0 / zero)
    raises_in(MODES["strict dtypes"][0], jax.dtypes.TypePromotionError, lambda: one * jnp.arange(2))
    with jax.disable_jit():
        assert jax.jit(lambda x: 2.0 if x > 0 else 3.0)(one) == 2.0


@pytest.mark.slow
def test_events_in_a_mode(mode):
    """A motion with an event at its known time, and room for others that do not happen; a second call; by steps."""
    context, m = mode
    k, w = 2.0 * m, np.sqrt(2.0)
    zero = lj.Crossing(lambda t, q, v, params: q)
    with context():
        first, again = (lj.integrate(spring(m), 1.0, 0.0, {"k": k}, ts=TS, events={"zero": zero}) for _ in range(2))
        late = lj.integrate(spring(m), 1.0, 0.0, {"k": k}, ts=2 * TS, events={"zero": zero})
        at = first.at(0.6)
    assert np.allclose(first.q, np.cos(w * TS), atol=1e-8) and np.array_equal(first.q, again.q)
    assert first.events["zero"].count == 0 and np.allclose(late.events["zero"].t[:1], np.pi / 2 / w, atol=1e-8)
    assert np.isclose(at.q, np.cos(w * 0.6), atol=1e-8)


@pytest.mark.exhaustive
def test_constraints_and_gradients_in_a_mode(mode):
    """A mass turns on a rod as it must; slopes by stiffness, in a program of the user's and out of it."""
    context, m = mode
    rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - 1.0)
    turning = lj.System(lambda t, q, v, params: 0.5 * m * (v["x"] ** 2 + v["y"] ** 2), constraints={"rod": rod})

    def end(k):
        return lj.integrate(spring(m), 1.0, 0.0, {"k": k}, ts=TS, **TOLERANCE).q[-1]

    one = jax.device_put(jnp.asarray(m))
    with context():
        traj = lj.integrate(turning, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 2.0}, ts=TS, **TOLERANCE)
        outside, inside = jax.grad(end)(one), jax.jit(jax.grad(end))(one)
    assert np.allclose(traj.q["x"], np.cos(2.0 * TS), atol=1e-7)
    exact = -TS[-1] * np.sin(TS[-1]) / (2.0 * m)
    assert np.allclose([outside, inside], exact, atol=1e-7)


@pytest.mark.slow
def test_nothing_is_transferred_by_a_program():
    """A program of the user's is traced and run where transfers are refused; twin: one that he makes is."""
    run = jax.jit(lambda q, k: lj.integrate(spring(7.0), q, 0.0, {"k": k}, ts=TS).q)
    q, k = jax.device_put((1.0, 7.0))
    with jax.transfer_guard("disallow"):
        first, again = run(q, k), run(q, k)
        with pytest.raises(jax.errors.JaxRuntimeError, match="Disallowed"):
            run(q + np.float64(1.0), k)
    assert np.allclose(first, np.cos(TS), atol=1e-8) and np.array_equal(first, again)


@pytest.mark.slow
@pytest.mark.parametrize("mode", exhaustive_but(("debug_nans",), MODES), indirect=True)
def test_failures_sweeps_and_fits_in_a_mode(mode):
    """A motion that fails says why, a sweep has NaN for it alone, a stiff method and a fit do their work."""
    context, m = mode
    pole = lj.System(lambda t, q, v, params: 0.5 * m * v**2 + m * params["c"] / q)
    t = np.linspace(0.0, 2.0, 9)
    measured = lj.Record(t, q=np.cos(1.5 * t), sigma=1e-3)
    with context():
        with pytest.raises((RuntimeError, ValueError), match="Fix"):
            lj.integrate(pole, 1.0, 0.0, {"c": 1.0}, ts=np.array([0.0, 5.0]), max_steps=500)
        run = lambda at: lj.integrate(spring(m), at["q"], 0.0, {"k": m}, ts=TS).q[-1]
        swept = lj.sweep(run, {"q": np.array([1.0, np.nan])}, progress=False)
        stiff = lj.integrate(spring(m), 1.0, 0.0, {"k": m}, ts=TS, method=lj.Radau5())
        found = lj.fit(spring(m), measured, {"k": m}, progress=False)
    assert np.isclose(swept.values[0], np.cos(TS[-1]), atol=1e-8) and np.isnan(swept.values[1])
    assert np.allclose(stiff.q, np.cos(TS), atol=1e-6)
    assert np.isclose(found.params["k"], 1.5**2 * m, rtol=1e-4)


NET = lj.learned.Network(1.0, key=jax.random.key(0), width=16, depth=1)
WITH_NET = lj.System(
    lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2, force=lambda t, q, v, params: params["net"](q)
)
BOUNCING = lj.System(
    lambda t, q, v, params: 0.5 * v**2 - params["g"] * q,
    elements={"floor": lj.Contact(lambda t, q, params: q, restitution=0.5)},
)


def pushed(k):
    """A spring beside a network that is zero, with a control that is held: no push."""
    controls = {"push": np.zeros(40)}
    system = lj.System(WITH_NET.lagrangian, force=lambda t, q, v, params: params["net"](q) + params["push"])
    return lj.rollout(system, 1.0, 0.0, {"k": k, "net": NET}, controls, 0.02)[1]


def test_a_rollout_under_strict_promotion():
    """A step of fixed length counts, and a network's steps too, whatever dtypes may be added where the user works."""
    with jax.numpy_dtype_promotion("strict"):
        q = pushed(4.0)
        raises_in(MODES["strict dtypes"][0], jax.dtypes.TypePromotionError, lambda: jnp.asarray(q) * jnp.arange(41))
    assert np.allclose(q, np.cos(2.0 * 0.02 * np.arange(41)), atol=1e-7)


@pytest.mark.exhaustive
def test_all_doors_under_strict_promotion():
    """Steps, slopes of both modes, sweeps, fits, losses of networks, equilibria, modes, and a contact: closed forms."""
    t = np.linspace(0.0, 2.0, 9)
    with jax.numpy_dtype_promotion("strict"):
        state = lj.step(WITH_NET, 0.0, 1.0, 0.0, {"k": 4.0, "net": NET}, 1e-3)
        a, _ = lj.accelerations(WITH_NET, 0.0, 1.0, 0.0, {"k": 4.0, "net": NET})
        end = lambda k: lj.integrate(WITH_NET, 1.0, 0.0, {"k": k, "net": NET}, ts=TS, rtol=1e-9, atol=1e-9).q[-1]
        slopes = [mode(end)(4.0) for mode in (jax.grad, jax.jacfwd)] + [jax.grad(lambda k: pushed(k)[-1])(4.0)]
        swept = lj.sweep(lambda at: end(at["k"]), {"k": np.array([1.0, 4.0])}, progress=False).values
        records = [lj.Record(t, q=np.cos(2.0 * t), sigma=1e-3)] * 2
        found = lj.fit(WITH_NET, records, {"k": 3.5, "net": NET}, free=["k"], progress=False)
        loss = lj.fit_loss(WITH_NET, records, {"k": 4.0, "net": NET}, window=1.0)
        slope = jax.tree.leaves(jax.grad(loss)(loss.guess))
        rest = lj.equilibria(WITH_NET, {"k": 4.0, "net": NET}, starts=[0.3])
        swings = lj.normal_modes(WITH_NET, 0.0, 0.0, 0.0, {"k": 4.0, "net": NET})
        height = lambda g: lj.integrate(BOUNCING, 1.0, 0.0, {"g": g}, ts=np.array([0.0, 0.6])).q[-1]
        bounced, up = height(9.81), [mode(height)(9.81) for mode in (jax.grad, jax.jacfwd)]
    assert np.allclose([a, state[1]], [-4.0, np.cos(2e-3)], atol=1e-9)
    assert np.allclose(slopes[:2], -0.9 * np.sin(1.8) / 4, rtol=1e-6)
    assert np.allclose(slopes[2], -0.8 * np.sin(1.6) / 4, rtol=1e-6)
    assert np.allclose(swept, np.cos([0.9, 1.8]), atol=1e-7)
    assert np.isclose(found.params["k"], 4.0, rtol=1e-4) and all(np.isfinite(x).all() for x in slope)
    assert np.allclose(rest.q, 0.0, atol=1e-9) and np.allclose(swings.frequency, 2.0)
    # It falls for sqrt(2 / g), and rises at half the speed.
    rise = lambda g: 0.5 * np.sqrt(2 * g) * (0.6 - np.sqrt(2 / g)) - 0.5 * g * (0.6 - np.sqrt(2 / g)) ** 2
    assert np.isclose(bounced, rise(9.81), atol=1e-7)
    assert np.allclose(up, (rise(9.82) - rise(9.80)) / 0.02, rtol=1e-4)
