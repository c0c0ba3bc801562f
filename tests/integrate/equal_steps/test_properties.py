"""What steps of equal length keep: symplecticity, reversibility, orders on motions of every kind, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from tests import by_hand
from tests.behaviour.test_orders import computed, double_pendulum_equation, orders, states, within
from tests.integrate.equal_steps.test_equal_steps import TURN, G, adaptive, ellipse, fall, kepler, length, rod, run
from tests.systems import DOUBLE_PARAMS, DOUBLE_SWING, double_pendulum, reference, rods_from_angles

# Steps that are too long for the tolerance are meant.
pytestmark = pytest.mark.filterwarnings("ignore::lagjax.AccuracyWarning")
TS = np.linspace(0.0, 8.0, 9)
STEPS = {
    lj.Gauss(1): (80, 160, 320), lj.Gauss(2): (24, 34, 48), lj.Gauss(3): (16, 22, 30), lj.Gauss(4): (10, 14, 18),
    lj.Splitting(2): (160, 226, 320), lj.Splitting(4): (40, 56, 80), lj.Splitting(6): (20, 28, 40),
    lj.Splitting(8): (16, 20, 26),
}  # fmt: skip
IN_SLOW = ("constrained", lj.Gauss(3)), ("constrained", lj.Splitting(8))
FORMS = {"free": "double pendulum", "constrained": "double rods"}


@pytest.fixture(scope="module")
def exact():
    """The double pendulum by angles and by rods, by SciPy."""
    y0 = np.concatenate(DOUBLE_SWING)
    y = solve_ivp(double_pendulum_equation, (0, TS[-1]), y0, "DOP853", TS, rtol=2.5e-14, atol=1e-15).y.T
    rods = jax.vmap(lambda angles, rates: rods_from_angles(angles, rates, DOUBLE_PARAMS))(y[:, :2], y[:, 2:])
    return {"free": {"q": y[:, :2], "v": y[:, 2:]}, "constrained": states(*jax.tree.map(np.asarray, rods))}


def measured(exact, form, method, steps):
    """Its order in q, v and multipliers."""
    system, *start, params = reference(FORMS[form])
    return orders(exact[form], steps, lambda n: computed(form, run(system, start, params, TS, method, 1 / n)))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("form", "method"),
    [
        pytest.param(form, method, marks=pytest.mark.slow if (form, method) in IN_SLOW else pytest.mark.exhaustive)
        for form in FORMS
        for method in STEPS
        if form == "constrained" or isinstance(method, lj.Gauss)
    ],
)
def test_order_of_a_double_pendulum(exact, form, method):
    """Its order in places, velocities and multipliers, by angles and by rods; each order is the others' twin."""
    found = measured(exact, form, method, STEPS[method])
    assert all(within(method.error_order(), found)), found


def momenta(v, q):
    """Those of the double pendulum's angles."""
    return jax.grad(lambda v: double_pendulum.lagrangian(0.0, q, v, DOUBLE_PARAMS))(v)


def rates(p, q):
    """The other way round."""
    return jnp.linalg.solve(jax.jacfwd(lambda v: momenta(v, q))(jnp.zeros_like(q)), p)


def by_angles(x, method, span, **options):
    """(angles, their momenta) after a span of the double pendulum, of those before."""
    q, p = jnp.split(x, 2)
    end = run(double_pendulum, (q, rates(p, q)), DOUBLE_PARAMS, [0.0, span], method, 0.1, **options).end
    return jnp.concatenate([end.q, momenta(end.v, end.q)])


def on_orbit(x, method, span):
    """(place, velocity) after a span of an orbit."""
    end = run(kepler, jnp.split(x, 2), 1.0, [0.0, span], method, 0.1).end
    return jnp.concatenate([end.q, end.v])


def on_rod(x, method, **options):
    """(angle, momentum) after a hundred steps on a rod."""
    angle, rate = x
    start = jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    end = run(rod, start, G, [0.0, 2.0], method, 0.02, **options).end
    return jnp.stack([jnp.arctan2(end.q[0], -end.q[1]), -end.q[1] * end.v[0] + end.q[0] * end.v[1]])


FIXED = {"stepsize_controller": diffrax.ConstantStepSize()}
at_swing = lambda: jnp.concatenate([DOUBLE_SWING[0], momenta(DOUBLE_SWING[1], DOUBLE_SWING[0])])
at_pericentre, at_side = lambda: jnp.concatenate(ellipse(0.3)), lambda: jnp.array([1.5, 0.3])
# Changes of (q, p), where from, and whether they are symplectic.
CHANGES = {
    **{f"angles {s} {span}": (lambda x, s=s, span=span: by_angles(x, lj.Gauss(s), span), at_swing, True)
       for s in (2, 3, 4) for span in (0.1, 3.0)},
    **{f"orbit {n} {span}": (lambda x, n=n, span=span: on_orbit(x, lj.Splitting(n), span), at_pericentre, True)
       for n in (2, 4, 6, 8) for span in (0.1, 6.0)},
    **{f"rod {method}": (lambda x, method=method: on_rod(x, method), at_side, True)
       for method in (lj.Splitting(2), lj.Splitting(6), lj.Gauss(2), lj.Gauss(3))},
    "angles, Heun": (lambda x: by_angles(x, diffrax.Heun(), 2.0, **FIXED), at_swing, False),
    "rod, Tsit5": (lambda x: on_rod(x, lj.Tsit5(), dt0=None, rtol=1e-4), at_side, False),
}  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CHANGES)
def test_steps_are_symplectic(name):
    """Dᵀ J D = J for one step and many of equal length. Twins: other methods."""
    change, start, symplectic = CHANGES[name]
    D = np.asarray(jax.jit(jax.jacfwd(change))(start()))
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(len(D) // 2))
    departs = np.max(np.abs(D.T @ J @ D - J))
    assert departs < 1e-12 if symplectic else departs > 1e-7


def slope(motion, method, steps):
    """The order, from the errors in positions with so many steps per unit of time; `motion()`: a problem, its q."""
    *problem, exact = motion()
    leaves = lambda tree: np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])
    errors = [np.linalg.norm(leaves(run(*problem, method, 1 / n).q) - leaves(exact)) for n in steps]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


SPAN = np.linspace(0.0, 6.0, 7)
TEN = np.linspace(0.0, 10.0, 11)


def on_pendulum():
    """A pendulum with a force, friction and explicit time, against SciPy."""
    pulled = lj.System(
        lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q) + 0.3 * q * jnp.sin(2 * t),
        dissipation=lambda t, q, v, k: 0.1 * v**2 + 0.02 * v**4,
    )
    rates = lambda t, y: [y[1], -np.sin(y[0]) + 0.3 * np.sin(2 * t) - 0.2 * y[1] - 0.08 * y[1] ** 3]
    y = solve_ivp(rates, (0, 6), [1.0, 0.5], "DOP853", SPAN, rtol=2.5e-14, atol=1e-15).y[0]
    return pulled, (1.0, 0.5), 1.0, SPAN, y


def on_long_ellipse():
    """Two turns and a part of an ellipse, against Kepler's equation."""
    ts = np.array([0.0, 2 * TURN + 2.0])
    return kepler, ellipse(0.6), 1.0, ts, by_hand.kepler(ts, 0.6)[0]


def on_knife_edge():
    """A knife edge on a slope: with v = (a/ω) sin ωt along it, its path is a cycloid (Neimark & Fufaev)."""
    across = lj.Nonholonomic(lambda t, q, v, a: jnp.sin(q[2]) * v[0] - jnp.cos(q[2]) * v[1])
    edge = lj.System(lambda t, q, v, a: 0.5 * v @ v + a * q[0], constraints={"edge": across})
    a, w, ts = 1.5, 2.0, np.linspace(0.0, 4.0, 5)
    along = a / (2 * w**2) * np.sin(w * ts) ** 2, a / (2 * w**2) * (w * ts - np.sin(2 * w * ts) / 2)
    return edge, (np.zeros(3), np.array([0.0, 0.0, w])), a, ts, np.stack([*along, w * ts], 1)


def on_heavy_top():
    """By a quaternion: the mass matrix is singular without the constraint, and depends on q."""

    def lagrangian(t, q, v, params):
        w, r = q[0], q[1:]
        turn = 2 * (w * v[1:] - r * v[0] - jnp.cross(r, v[1:]))
        return 0.5 * jnp.sum(np.array([1.0, 1.0, 0.5]) * turn**2) - params * (w**2 - r[0] ** 2 - r[1] ** 2 + r[2] ** 2)

    top = lj.System(lagrangian, constraints={"unit": lj.Holonomic(lambda t, q, params: q @ q - 1.0)})
    q0, turn = np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0]), np.array([0.3, 0.0, 6.0])
    v0 = 0.5 * np.array([-q0[1] * turn[0], q0[0] * turn[0], -q0[1] * turn[2], q0[0] * turn[2]])
    return top, (q0, v0), 3.0, TEN, adaptive(top, (q0, v0), 3.0, TEN).q


def on_a_moving_pivot():
    """A rod whose pivot moves, x = 0.2 sin 3t, against the equation of its angle."""
    pivot = lambda t: jnp.array([0.2, 0.0]) * jnp.sin(3 * t)
    moving = lj.System(fall, constraints={"rod": lj.Holonomic(lambda t, q, g: length(t, q - pivot(t), g))})
    # Without what depends on t alone.
    angle = lj.System(lambda t, q, v, g: 0.5 * v**2 + 0.6 * jnp.cos(3 * t) * v * jnp.cos(q) + g * jnp.cos(q))
    q = adaptive(angle, (0.6, 0.0), G, TS, rtol=1e-13).q
    places = np.stack([0.2 * np.sin(3 * TS) + np.sin(q), -np.cos(q)], axis=1)
    return moving, (np.array([np.sin(0.6), -np.cos(0.6)]), np.array([0.6, 0.0])), G, TS, places


def on_a_thermostat():
    """A state beside a mass, against SciPy."""
    hoover = lj.System(
        lambda t, q, v, Q: 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2,
        force=lambda t, q, v, Q: {"x": -q["z"] * v["x"], "z": 0.0},
        states={"z": lambda t, q, v, Q: (v["x"] ** 2 - 1.0) / Q},
    )
    rate = lambda t, y: [y[1], -y[0] - y[2] * y[1], (y[1] ** 2 - 1.0) / 0.5]
    y = solve_ivp(rate, (0, 10), [1.0, 0.0, 0.2], "DOP853", TS, rtol=1e-13, atol=1e-13).y
    return hoover, ({"x": 1.0, "z": 0.2}, {"x": 0.0}), 0.5, TS, {"x": y[0], "z": y[2]}


def on_relativistic_spring():
    """An oscillator whose L has a largest velocity."""
    rel = lj.System(lambda t, q, v, params: -jnp.sqrt(1 - v**2) - 0.5 * q**2)
    return rel, (0.5, 0.0), None, TEN, adaptive(rel, (0.5, 0.0), None, TEN).q


# Each order of Gauss's method is measured on the double pendulum, each of the splitting on the ellipse.
ORDERS = [
    *((on_long_ellipse, lj.Splitting(n), steps) for n, steps in
      {2: (137, 274), 4: (55, 110), 6: (34, 48), 8: (20.5, 27.4)}.items()),
    (on_pendulum, lj.Gauss(2), (6, 8, 12)),
    (on_knife_edge, lj.Gauss(1), (20, 30, 40)),
    (on_knife_edge, lj.Gauss(3), (4, 5, 6)),
    (on_heavy_top, lj.Gauss(3), (10, 20)),
    (on_a_thermostat, lj.Gauss(3), (5, 10)),
    (on_relativistic_spring, lj.Gauss(2), (8, 12, 16)),
    (on_a_moving_pivot, lj.Splitting(4), (50, 100)),
]  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize(("motion", "method", "steps"), ORDERS)
def test_orders(motion, method, steps):
    """The order of each method on each motion. Twin: each order is told from the others by itself."""
    assert abs(slope(motion, method, steps) - method.error_order()) < 0.35


@pytest.mark.exhaustive
def test_derivatives_through_a_hundred_thousand_steps():
    """d(end)/d(sun) in both modes to 1e-8; reverse mode's memory is that of outputs and of some steps, not of all.

    The sun is in thirty parts: with up to 24 numbers reverse mode would push tangents forward.
    """
    parts = lj.System(lambda t, q, v, k: 0.5 * v @ v + jnp.sum(k) / jnp.sqrt(q @ q))
    sun, more, sizes = jnp.full(30, 1 / 30), jnp.arange(30.0), []

    def end(k, steps):
        span = np.linspace(0.0, steps * TURN / 200, 11)
        return run(parts, ellipse(0.6), k, span, lj.Gauss(2), TURN / 200).q[-1, 0]

    for steps in (1000, 100_000):
        reverse = jax.jit(jax.grad(lambda k: end(k, steps))).lower(sun).compile()
        sizes.append(reverse.memory_analysis().temp_size_in_bytes)
    forward = jax.jit(lambda k: jax.jvp(lambda k: end(k, 100_000), (k,), (more,))[1])(sun)
    np.testing.assert_allclose(reverse(sun) @ more, forward, rtol=1e-8)
    assert sizes[1] < 2 * sizes[0] and sizes[1] < 2**23
