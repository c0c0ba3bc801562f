"""`integrate`: accuracy, constraints, derivatives, batches, events, float32."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.solve.phases import traced_phases
from lagjax.system import coordinates
from tests.systems import DRIVEN_PARAMS, HORIZONTAL, PARAMS, TS, driven, pendulum, rod_pendulum

# A wide swing, from 2 rad at 3 rad/s: nonlinear, and without a symmetry that would raise an order.
SWING = (2.0, 3.0)
SWING_TS = np.array([0.0, 0.26, 0.77, 1.01])


def test_against_scipy():
    """The angle agrees with SciPy's DOP853 on the hand-derived equation."""
    exact = lj.integrate(pendulum, *SWING, PARAMS, ts=SWING_TS, rtol=1e-13)
    k = PARAMS["g"] / PARAMS["l"]
    by_hand = lambda t, y: [y[1], -k * np.sin(y[0])]
    y = solve_ivp(by_hand, (0, 1.01), SWING, "DOP853", SWING_TS, rtol=1e-13, atol=1e-13).y
    np.testing.assert_allclose(exact.q, y[0], atol=2e-12)
    np.testing.assert_allclose(exact.v, y[1], atol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "adjoint", [diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint(), diffrax.BacksolveAdjoint()]
)
def test_diffrax_adjoints_are_accepted(adjoint):
    """Each adjoint gives the derivative of an oscillator's cos(2t) by its stiffness."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params * q**2)
    mode = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.grad
    final = lambda k: lj.integrate(
        system, 1.0, 0.0, k, ts=np.array([0.0, 1.0]), rtol=1e-10, atol=1e-10, adjoint=adjoint
    ).q[-1]
    np.testing.assert_allclose(mode(final)(4.0), -np.sin(2.0) / 4.0, rtol=1e-7)


@pytest.mark.optimised
@pytest.mark.slow
def test_lanes_agree_with_single_runs_and_keep_their_own_failure():
    """vmap gives each lane its own result; a lane with NaN parameters fails alone, with its reason."""
    lengths = jnp.array([0.5, 1.25, jnp.nan, 2.0])
    run = lambda l: lj.integrate(pendulum, 1.0, 0.0, {"g": 9.8125, "l": l}, ts=TS, throw=False)
    batch = jax.vmap(run)(lengths)
    alone = run(1.25)
    np.testing.assert_allclose(batch.q[1], alone.q, rtol=1e-9)
    # Not of the second lane: for three lengths of eleven round-off decides over one step more.
    for lane in (0, 3):
        assert int(batch.stats["num_steps"][lane]) == int(run(lengths[lane]).stats["num_steps"])
    good = np.asarray(batch.result == lj.RESULTS.successful)
    assert good.tolist() == [True, True, False, True]
    assert bool((batch.result == lj.RESULTS.start_not_finite)[2])
    assert np.all(np.isnan(batch.q[2]))
    assert "3 successful" in repr(batch) and "not finite" in repr(batch)


def oscillator(k):
    """A spring whose L closes over its stiffness."""
    return lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * k * q**2)


def test_a_closed_over_value_is_a_number_of_the_system():
    """What L closes over inside a program is lifted into the system, by which a motion is differentiated."""
    state = coordinates.prepared(0.0, 1.0, 0.0, None)
    lifted = lambda k: jax.tree.leaves(eqx.filter(traced_phases(oscillator(k), state), eqx.is_inexact_array))
    for k in (4.0, 9.0):
        assert [*map(float, jax.jit(lifted)(k))] == [k]
        assert jax.jit(jax.grad(lambda k: sum(lifted(k))))(k) == 1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", [None, lj.Dopri8(), lj.Tsit5()], ids=["default", "8", "5"])
def test_float32_with_explicit_time(method):
    """Stages at intermediate times stay in float32 even if JAX has float64 enabled."""
    driven = lj.System(lambda t, q, v, params: 0.5 * v**2 + params * q * jnp.sin(3 * t))
    ts = np.array([0.0, 1.0, 2.0], np.float32)
    traj = lj.integrate(driven, np.float32(0.0), np.float32(0.0), np.float32(2.0), ts=ts, method=method)
    assert traj.q.dtype == jnp.float32
    np.testing.assert_allclose(traj.q, 2 * (ts / 3 - np.sin(3 * ts) / 9), atol=1e-4)


@pytest.mark.slow
def test_float32_says_what_it_is():
    """float32 runs in float32 at its own default tolerance, keeps the constraint to its round-off and says so."""
    single = lambda tree: jax.tree.map(np.float32, tree)
    traj = lj.integrate(rod_pendulum, *single(HORIZONTAL), single(PARAMS), ts=TS)
    assert traj.q["x"].dtype == traj.t.dtype == traj.multipliers["rod"].dtype == jnp.float32
    assert float(traj.residual()) < 1e-6
    assert "float32" in repr(traj) and "rtol 1e-05" in repr(traj)
    np.testing.assert_allclose(
        traj.q["x"], 1.25 * np.sin(lj.integrate(pendulum, np.pi / 2, 0.0, PARAMS, ts=TS).q), atol=1e-3
    )


def test_dissipation_and_force_in_motion():
    """A driven, damped oscillator follows its exact solution."""
    m, k, c, pull, rate = DRIVEN_PARAMS.values()
    # Steady state: amplitude and phase of pull / (k - m rate² + i c rate).
    response, ts = pull / (k - m * rate**2 + 1j * c * rate), np.array([0.0, 1.0, 5.0])
    traj = lj.integrate(driven, response.real, (1j * rate * response).real, DRIVEN_PARAMS, ts=ts, rtol=1e-11)
    np.testing.assert_allclose(traj.q, (response * np.exp(1j * rate * ts)).real, atol=1e-9)


@pytest.mark.exhaustive
def test_an_empty_batch():
    """A batch without lanes gives no motions: with every kind of method, constraints, events, derivatives, printed."""
    nobody = jnp.zeros(0)
    run = lambda q, **options: lj.integrate(pendulum, q, 0.0, PARAMS, ts=TS, **options)
    fell = diffrax.Event(lambda t, y, params, **kwargs: y[0] - 0.9)
    for options in ({}, {"method": lj.Radau5()}, {"method": diffrax.Tsit5()}, {"event": fell}):
        assert jax.vmap(lambda q: run(q, **options).q)(nobody).shape == (0, 4)
    assert "lanes         0" in repr(jax.jit(jax.vmap(run))(nobody))
    rods = jax.vmap(lambda x: lj.integrate(rod_pendulum, {"x": x, "y": 0.0}, HORIZONTAL[1], PARAMS, ts=TS).q["y"])
    assert rods(nobody).shape == (0, 4)
    assert jax.vmap(jax.grad(lambda q: run(q).q[-1]))(nobody).shape == (0,)
    assert jax.grad(lambda q: jnp.sum(jax.vmap(lambda q: run(q).q[-1])(q)))(nobody).shape == (0,)
    # The failure of one lane among others is still raised.
    with pytest.raises(RuntimeError, match="not finite"):
        jax.block_until_ready(jax.vmap(lambda q: run(q).q[-1])(jnp.array([1.0, jnp.nan])))


@pytest.mark.exhaustive
def test_calls_of_the_host_are_the_users():
    """A force from Python in one branch works in a motion and in a sweep; so does a check of the user's own."""
    free = lambda t, q, v, p: 0.5 * v**2
    shape = jax.ShapeDtypeStruct((), jnp.float64)

    def push(t, q, v, p):
        python = lambda t: jax.pure_callback(lambda t: np.ones_like(t), shape, t, vmap_method="expand_dims")
        return jax.lax.cond(t < 0.5, python, lambda t: 0.0 * t, t)

    ts = np.array([0.0, 0.5, 1.0])
    pushed = lj.System(free, force=push)
    np.testing.assert_allclose(lj.integrate(pushed, 0.0, 0.0, ts=ts).q, [0.0, 0.125, 0.375], atol=1e-9)
    run = lambda point: lj.integrate(pushed, point["q"], 0.0, ts=ts).q[-1]
    np.testing.assert_allclose(lj.sweep(run, {"q": [0.0, 1.0]}, progress=False).values, [0.375, 1.375], atol=1e-9)

    checked = lj.System(free, force=lambda t, q, v, p: eqx.error_if(0 * q, q < -0.2, "through the wall"))
    np.testing.assert_allclose(lj.integrate(checked, 0.0, 1.0, ts=ts).q, ts, rtol=1e-12)
    with pytest.raises(Exception, match="through the wall"):
        lj.integrate(checked, 0.0, -1.0, ts=ts)
