"""The order of every method, measured; and gradients through a thousand constrained steps.

One motion in two forms: a double pendulum by its angles (its mass matrix depends on them), and as two masses on rods
(the constraints' multipliers are the tensions). The reference is the textbook equation by SciPy, good to 2e-13.
Small angles, so that a step of order eight is already in its asymptotic range while its error is far above round-off;
many outputs, all between steps, so that no single phase of a step decides.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.3-II.5 (orders of the methods).
"""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import lagjax as lj
from lagjax.numerics.radau import SimplifiedNewton
from tests.systems import DOUBLE_PARAMS, DOUBLE_SWING, double_pendulum, double_rods, rods_from_angles
from tests.tiers import exhaustive_but

pytestmark = pytest.mark.optimised
CLAIM = 0.35
OUTPUTS = np.concatenate([[0.0], np.linspace(0.3, 8.0, 28) + 0.013 * np.sin(7 * np.arange(28.0))])


def tension_multipliers(q, v):
    """The multipliers (T, 2) of states: each rod keeps its length, `r·a = -v²`, under gravity and both rods' pull."""
    m1, m2, g = (DOUBLE_PARAMS[name] for name in ("m1", "m2", "g"))
    r, d = q["first"], q["second"] - q["first"]
    u, w = v["first"], v["second"] - v["first"]
    dot = lambda a, b: np.sum(a * b, axis=-1)
    coupling = -2 * dot(r, d) / m1
    matrix = np.array([[2 * dot(r, r) / m1, coupling], [coupling, 2 * dot(d, d) * (1 / m1 + 1 / m2)]])
    right = np.array([g * r[:, 1] - dot(u, u), -dot(w, w)])
    return np.linalg.solve(np.moveaxis(matrix, -1, 0), right.T[:, :, None])[:, :, 0]


def states(q, v):
    """Positions and velocities as plain arrays, and the multipliers that belong to them."""
    stacked = lambda tree: np.stack([tree["first"], tree["second"]], axis=1)
    return {"q": stacked(q), "v": stacked(v), "multipliers": tension_multipliers(q, v)}


def double_pendulum_equation(t, y):
    """The textbook's two equations of the double pendulum, solved for the angular accelerations."""
    m1, m2, l1, l2, g = (DOUBLE_PARAMS[name] for name in ("m1", "m2", "l1", "l2", "g"))
    first, second, u, w = y
    c, s = np.cos(first - second), np.sin(first - second)
    mass = np.array([[(m1 + m2) * l1, m2 * l2 * c], [l1 * c, l2]])
    force = [-m2 * l2 * w**2 * s - (m1 + m2) * g * np.sin(first), l1 * u**2 * s - g * np.sin(second)]
    return [u, w, *np.linalg.solve(mass, force)]


@pytest.fixture(scope="module")
def exact():
    """Angles, and positions with multipliers, at OUTPUTS."""
    integrate = pytest.importorskip("scipy.integrate")
    solution = integrate.solve_ivp(
        double_pendulum_equation, (0, OUTPUTS[-1]), np.concatenate(DOUBLE_SWING), "DOP853", OUTPUTS,
        rtol=2.5e-14, atol=1e-15,
    )  # fmt: skip
    angles, rates = solution.y.T[:, :2], solution.y.T[:, 2:]
    rods = jax.vmap(lambda angles, rates: rods_from_angles(angles, rates, DOUBLE_PARAMS))(angles, rates)
    return {"free": {"q": angles, "v": rates}, "constrained": states(*jax.tree.map(np.asarray, rods))}


def run(form, method, dt, ts=OUTPUTS):
    """The motion in one of its forms at a constant step; one compile serves all steps."""
    rods = lambda: jax.tree.map(np.asarray, rods_from_angles(*DOUBLE_SWING, DOUBLE_PARAMS))
    system, start = (double_pendulum, DOUBLE_SWING) if form == "free" else (double_rods, rods())
    return lj.integrate(
        system, *start, DOUBLE_PARAMS, ts=ts, method=method, dt0=jnp.asarray(dt),
        stepsize_controller=diffrax.ConstantStepSize(),
    )  # fmt: skip


def computed(form, traj):
    """The values of a trajectory, in the layout of `exact`."""
    if form == "free":
        return {"q": traj.q, "v": traj.v}
    multipliers = np.stack([traj.multipliers["inner"], traj.multipliers["outer"]], axis=-1)
    return states(*jax.tree.map(np.asarray, (traj.q, traj.v))) | {"multipliers": multipliers}


def orders(exact, steps, values):
    """The order in q, v and the multipliers: slope of log error against log step, errors over all outputs."""
    errors = [{name: np.linalg.norm(found[name] - exact[name]) for name in exact} for found in map(values, steps)]
    fit = lambda name: np.polyfit(np.log(steps), [-np.log(e[name]) for e in errors], 1)[0]
    return {name: float(fit(name)) for name in exact}


def within(order, measured):
    """Which of the measured orders are the claimed one."""
    return [abs(found - order) < CLAIM for found in measured.values()]


# A constant step leaves an implicit method no error estimate to take its root finder's tolerance from.
NEWTON = optx.Newton(rtol=1e-10, atol=1e-12, norm=optx.max_norm)

# Steps per unit of time: errors from 1e-1 (Euler) down to 7e-12 (Tsit5, free), 50 times the reference's.
FAST = [(lj.Tsit5(), 5, (112, 160, 224)), (lj.Dopri8(), 8, (18, 22, 28))]


class ShippedDopri8(diffrax.Dopri8):
    """diffrax's own Dopri8: an instance of the original class would run in our form."""


SLOW = [(lj.Radau5(root_finder=SimplifiedNewton(rtol=1e-12, atol=1e-12)), 5, (28, 40, 56))]
# One of each kind that diffrax has: the others differ only in their coefficients.
OTHERS = [
    (ShippedDopri8(), 8, (18, 22, 28)),
    (diffrax.Kvaerno5(root_finder=NEWTON), 5, (28, 40, 56)),
    (diffrax.Euler(), 1, (800, 1600, 3200)),
    (diffrax.LeapfrogMidpoint(), 2, (200, 400, 800)),
    (diffrax.ReversibleHeun(), 2, (200, 400, 800)),
    (diffrax.HalfSolver(diffrax.Heun()), 2, (100, 200, 400)),
]
name_of = lambda value: type(value).__name__ if isinstance(value, diffrax.AbstractSolver) else None
TIERS = {("Tsit5", "free"): pytest.mark.slow}


def cases():
    """Every method, free and projected, in its tier."""
    for method, order, steps in FAST + SLOW + OTHERS:
        for form in ("free", "constrained"):
            case = name_of(method), form
            marks = TIERS.get(case, pytest.mark.exhaustive)
            yield pytest.param(form, method, order, steps, marks=marks, id="-".join(case))


@pytest.mark.parametrize(("form", "method", "order", "steps"), list(cases()))
def test_order(exact, form, method, order, steps):
    """Each method has its order in positions, velocities and multipliers, free and projected, between its steps."""
    measured = orders(exact[form], steps, lambda n: computed(form, run(form, method, 1 / n)))
    assert all(within(order, measured)), measured


def with_lower_weights(method):
    """The same stages, but stepping with the weights of the embedded method, one order lower."""
    tableau = method.tableau
    lower = dataclasses.replace(tableau, b_sol=tableau.b_sol - tableau.b_error)
    return type("LowerWeights", (type(method),), {"tableau": lower})()


@pytest.mark.slow
@pytest.mark.parametrize("form", exhaustive_but(("free",), ("free", "constrained")))
@pytest.mark.parametrize(
    ("method", "order", "steps"), [FAST[0], pytest.param(*FAST[1], marks=pytest.mark.exhaustive)], ids=name_of
)
def test_a_lower_order_would_be_seen(exact, form, method, order, steps):
    """Failing twin: with the embedded weights no quantity passes."""
    lower = with_lower_weights(method)
    measured = orders(exact[form], steps, lambda n: computed(form, run(form, lower, 1 / n)))
    assert not any(within(order, measured)), measured
