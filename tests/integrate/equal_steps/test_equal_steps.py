"""Methods of equal steps: what they keep over long motions, their derivatives, and what they refuse."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.equal_steps import loop
from lagjax.system import prepare
from tests.by_numpy import by_numpy as in_numpy

TURN = 2 * np.pi
G = 9.81
kepler = lj.System(lambda t, q, v, params: 0.5 * v @ v + params / jnp.sqrt(q @ q))
# A mass of one on a rod of length one, and where it swings from.
fall = lambda t, q, v, g: 0.5 * v @ v - g * q[1]
length = lambda t, q, g: q @ q - 1.0
rod = lj.System(fall, constraints={"rod": lj.Holonomic(length)})
RAISED = np.array([np.sin(1.5), -np.cos(1.5)]), np.zeros(2)
swing = lj.System(lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q))


def ellipse(eccentricity):
    """The pericentre of an orbit with the period 2π."""
    e = eccentricity
    return np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])


def run(system, start, params, ts, method, dt, **options):
    """A motion whose program serves all lengths of steps."""
    given = {"method": method, "dt0": jnp.asarray(dt), "estimate_error": False} | options
    return lj.integrate(system, *start, params, ts=np.asarray(ts), **given)


def adaptive(system, start, params, ts, **options):
    """The same by steps that adapt."""
    return lj.integrate(system, *start, params, ts=np.asarray(ts), **{"rtol": 1e-12, "estimate_error": False} | options)


def slope_of_energy(traj):
    """By how much the Jacobi integral drifts over the motion, by the line through its values, and its range."""
    h = np.asarray(traj.jacobi_integral())
    return abs(np.polyfit(traj.t, h, 1)[0]) * float(traj.t[-1]), np.ptp(h)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("method", "bound"), [(lj.Gauss(3), 1e-8), (lj.Splitting(4), 1e-6)], ids=str)
def test_half_a_million_steps_on_a_rod(method, bound):
    """The rod's length to round-off, the energy, its tension, and the way back."""
    traj = run(rod, RAISED, G, np.linspace(0.0, 5000.0, 51), method, 0.01)
    assert int(traj.stats["num_steps"]) == 500_000
    q, v = np.asarray(traj.q), np.asarray(traj.v)
    np.testing.assert_allclose(np.sum(q**2, axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(np.sum(q * v, axis=1), 0.0, atol=1e-12)
    slope, rest = slope_of_energy(traj)
    assert rest < bound and slope < bound / 100 and "drifts by" in repr(traj)
    # The force 2 λ q turns v, against g = 9.81 along -y.
    np.testing.assert_allclose(traj.multipliers["rod"], -(np.sum(v**2, axis=1) - G * q[:, 1]) / 2, rtol=1e-9)
    short = np.linspace(0.0, 100.0, 51)
    there = run(rod, RAISED, G, short, method, 0.01)
    back = run(rod, (there.q[-1], -there.v[-1]), G, short, method, 0.01)
    np.testing.assert_allclose(back.q[-1], RAISED[0], atol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize("method", [lj.Gauss(3), lj.Splitting(4)], ids=str)
def test_a_rod_given_three_times(method):
    """Constraints that depend on each other: the motion of one rod, its tension shared by the shortest multipliers."""
    again = {
        "rod": lj.Holonomic(length),
        "half": lj.Holonomic(lambda t, q, g: (q @ q - 1.0) / 2),
        "root": lj.Holonomic(lambda t, q, g: jnp.sqrt(q @ q) - 1.0),
    }
    ts = np.linspace(0.0, 10.0, 51)
    one, three = (run(system, RAISED, G, ts, method, 0.01) for system in (rod, lj.System(fall, constraints=again)))
    np.testing.assert_allclose(three.q, one.q, atol=1e-13)
    # Rows 1, 1/2 and 1/2 of the first one: the shortest is in proportion to them.
    for name, share in zip(again, (1.0, 0.5, 0.5)):
        np.testing.assert_allclose(three.multipliers[name] / one.multipliers["rod"], share / 1.5, rtol=1e-10)


def scaled_pace(t, q, params):
    """A pace by the distance, and by the sun."""
    return (q @ q) ** 0.75 / jnp.sqrt(params)


# Motions as functions of a number, with a method of equal steps, their length, the end, and its error.
BY_A_NUMBER = {
    "angle": (lambda k: (swing, (1.0, 0.0), k), lj.Gauss(4), 0.1, 20.0, 1e-9),
    "rod": (lambda g: (rod, RAISED, g), lj.Splitting(8), 0.02, 3.0, 1e-9),
    "orbit": (lambda k: (kepler, (ellipse(0.6)[0], ellipse(0.6)[1] * jnp.sqrt(k)), k),
              lj.Splitting(4, pace=scaled_pace), 0.02, 8.0, 1e-5),
}  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", BY_A_NUMBER)
def test_derivatives_in_both_modes(name):
    """d(end)/d(parameter), forward and in reverse, and as by steps that adapt."""
    motion, method, dt, last, error = BY_A_NUMBER[name]
    end = lambda traj: jnp.ravel(traj.q[-1])[0]
    equal = lambda k: end(run(*motion(k), [0.0, last], method, dt))
    forward, reverse = jax.jit(lambda k: (jax.jvp(equal, (k,), (1.0,))[1], jax.grad(equal)(k)))(1.0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    value = jax.jit(jax.grad(lambda k: end(adaptive(*motion(k), [0.0, last]))))(1.0)
    np.testing.assert_allclose(forward, value, rtol=error)


POLAR = lj.System(lambda t, q, v, p: 0.5 * (v["r"] ** 2 + (q["r"] * v["a"]) ** 2) + 1 / q["r"])
COST = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2 - q["x"] ** 2, states={"z": lambda t, q, v, p: q["x"]})
KNIFE = {"knife": lj.Nonholonomic(lambda t, q, v, p: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))}
SLED = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2), constraints=KNIFE)
REFUSED = {
    "no length": (kepler, ellipse(0.3), lj.Gauss(2), {"dt0": None},
                  "makes steps of equal length, which is not given.*dt0=0.01"),
    "rest": (kepler, ellipse(0.3), lj.Splitting(), {"event": diffrax.Event(diffrax.steady_state_event())},
             r"event and lj.Splitting\(4\) exclude each other"),
    "phases": (lj.Hybrid({"up": kepler, "down": kepler}, [lj.Switch("up", to="down", when=lambda t, q, v, p: q[0])]),
               ellipse(0.3), lj.Splitting(), {}, "a motion in phases has steps that end at switches"),
    "mass": (POLAR, ({"r": 1.0, "a": 0.0}, {"r": 0.0, "a": 1.0}), lj.Splitting(), {},
             r"the mass matrix depends on r.*lj.Gauss\(3\)"),
    "state": (COST, ({"x": 1.0, "z": 0.0}, {"x": 0.0}), lj.Splitting(), {}, r"'z' have none.*method=lj.Gauss\(3\)"),
    "velocities": (SLED, (np.zeros(3), np.array([1.0, 0, 1])), lj.Splitting(2), {},
                   r"'knife' restricts velocities.*lj.Gauss\(3\)"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_they_refuse(name):
    """What has no meaning for steps of equal length, or for the splitting, in words."""
    system, start, method, options, words = REFUSED[name]
    with pytest.raises(ValueError, match=f"(?s){words}"):
        lj.integrate(system, *start, 1.0, ts=[0.0, 1.0], method=method, **{"dt0": 0.1} | options)


@pytest.mark.parametrize("method", [lj.Splitting(4), lj.Gauss(2)], ids=str)
def test_a_step(method):
    """A step from the top of a swing, in NumPy: the motion of SciPy, whose error falls with the fifth power."""
    model, s = prepare(swing, 0.0, 1.0, 0.3, 2.0)

    def after(t, x, u, h):
        step = loop._step_of(method, model, t, x, u, False)
        way = step.advanced(step.first(t, x, u), t, h)
        return jnp.concatenate([way.x, step.velocity(way, t + h)])

    def error(h):
        exact = solve_ivp(lambda t, y: [y[1], -2 * np.sin(y[0])], (0.0, h), [1.0, 0.3], rtol=1e-12, atol=1e-13).y[:, -1]
        return np.max(np.abs(in_numpy(after)(0.0, np.array([1.0]), np.array([0.3]), h) - exact))

    assert 15 * error(0.1) < error(0.2) < 2e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "method"),
    [
        ((kepler, ellipse(0.6), 1.0), lj.Splitting(4)),
        pytest.param((kepler, ellipse(0.6), 1.0), lj.Gauss(2), marks=pytest.mark.exhaustive),
        pytest.param((rod, RAISED, G), lj.Splitting(4), marks=pytest.mark.exhaustive),
    ],
    ids=["splitting", "gauss", "rattle"],
)
def test_outputs_leave_the_steps_alone(motion, method):
    """Outputs at random times change nothing in the motion, and lie on it; too many steps are said."""
    dt, every = 1 / 64, np.arange(257) / 4
    whole = run(*motion, every, method, dt)
    others = np.random.default_rng(0).uniform(0.0, 64.0, 257)
    mixed = np.sort(np.concatenate([every, others]))
    found, exact = run(*motion, mixed, method, dt), adaptive(*motion, mixed)
    np.testing.assert_allclose(found.q[np.isin(mixed, every)], whole.q, atol=1e-12)
    error = np.abs(np.asarray(found.q) - np.asarray(exact.q)).max(axis=1)
    between = ~np.isin(mixed, every)
    assert 0 < error[between].max() < 3 * error[~between].max() < 3e-2
    assert int(found.stats["num_steps"]) == 64 * 64 + 257
    # Twin: divided anew in each interval, the motion is another one.
    anew = run(*motion, [0.0, 0.23, 0.25], method, dt), run(*motion, [0.0, 0.23], method, dt)
    np.testing.assert_array_equal(anew[0].q[2], whole.q[1])
    assert np.max(np.abs(anew[1].q[1] - anew[0].q[1])) > 1e-12
    stopped = run(*motion, mixed, method, dt, max_steps=1000, throw=False)
    assert bool(stopped.result == lj.RESULTS.max_steps_reached) and np.isnan(np.asarray(stopped.q[-1])).all()
    assert np.isfinite(np.asarray(stopped.q[mixed < 15])).all()


def test_methods_that_do_not_exist():
    """Numbers of stages and orders that there are not."""
    with pytest.raises(ValueError, match="stages must be a whole number from 1 to 8"):
        lj.Gauss(9)
    with pytest.raises(ValueError, match=r"order must be 2, 4, 6 or 8"):
        lj.Splitting(5)


@pytest.mark.exhaustive
def test_a_step_that_is_too_long():
    """A stiff spring: the iteration fails and says which step would do; Newton's method takes the long one.

    A rod cannot be followed through more than a turn in a step of the splitting.
    """
    spring = lj.System(lambda t, q, v, k: 0.5 * v @ v - G * q[1] - 0.5 * k * (jnp.sqrt(q @ q) - 1) ** 2)
    start = np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2)
    on_spring = lambda method, **options: run(spring, start, 1e6, np.linspace(0.0, 2.0, 6), method, 0.01, **options)
    with pytest.raises(RuntimeError, match=r"(?s)stopped at t = 0, .*dt0=0\.00\d+, with which a step is solved there"):
        on_spring(lj.Gauss(2))
    stopped = on_spring(lj.Gauss(2), throw=False)
    assert bool(stopped.result == lj.RESULTS.unsolved_step) and np.isnan(np.asarray(stopped.q[1:])).all()
    slow = on_spring(lj.Gauss(2, newton=True))
    # The motion on a rigid rod, which the stiff one stays within the stretch g/k of.
    angle = solve_ivp(lambda t, y: [y[1], -G * np.sin(y[0])], (0, 2), [1.0, 0.0], t_eval=slow.t, rtol=1e-10).y[0]
    np.testing.assert_allclose(slow.q, np.stack([np.sin(angle), -np.cos(angle)], 1), atol=2e-3)
    with pytest.raises(RuntimeError, match=r"(?s)stopped at t = 0, .*dt0=0\.\d+, with which a step is solved there"):
        run(rod, RAISED, G, [0.0, 8.0], lj.Splitting(4), 1.5)


@pytest.mark.exhaustive
def test_newtons_iteration_ends_at_every_length_of_a_step():
    """A stiff spring pendulum by long and short steps, against adaptive ones: an early end was taken for a failure."""
    spring = lj.System(lambda t, q, v, params: 0.5 * v @ v - 500.0 * (jnp.sqrt(q @ q) - 1.0) ** 2)
    given = spring, (np.array([1.1, 0.0]), np.array([0.0, 1.0])), None, [0.0, 5.0, 10.0]
    exact = adaptive(*given).q[-1]
    for dt, error in ((0.005, 1e-7), (0.01, 1e-6), (0.02, 3e-5)):
        found = run(*given, lj.Gauss(3, newton=True), dt).q[-1]
        np.testing.assert_allclose(found, exact, atol=error)
        assert np.abs(found - exact).max() > error / 1000
