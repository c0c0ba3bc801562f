"""Which order does each method have, measured on outputs between its steps?

    python -m benchmarks.accuracy.orders --json benchmarks/results/orders.json

The motions are a double pendulum in its angles, and as two masses on rods, with a projection onto the constraints after
every step. For Nyström methods, which do not allow accelerations that depend on velocities, they are eight orbits of
Hénon and Heiles, judged at their ends: the order of a single orbit scatters by 1. Steps are constant; the order is the
slope of the logarithm of the error (its mean over the orbits) over that of the step, against SciPy's DOP853 at a
tolerance of 2.5e-14. The target is the claimed order within 0.35, or within 1 for Nyström methods, whose steps are a
large part of a period. The slow tests measure the same with misprinted tableaus as twins:
`tests/behaviour/test_orders.py`, `tests/numerics/methods/test_explicit.py`, `tests/numerics/methods/test_radau.py`.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.3-II.5, II.14; Hénon & Heiles, *Astron. J.* 69 (1964) 73.
"""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp

import lagjax as lj
from benchmarks.measure import main, row
from lagjax.mechanisms import double_pendulum
from lagjax.mechanisms.planar import Masses
from lagjax.numerics.radau import SimplifiedNewton

jax.config.update("jax_enable_x64", True)

P = {"m1": 1.0, "m2": 0.625, "l1": 1.25, "l2": 0.875, "g": 9.8125}
ANGLES, RATES = np.array([0.7, 0.8]), np.array([-1.3, -0.4])
OUTPUTS = np.concatenate([[0.0], np.linspace(0.3, 8.0, 28) + 0.013 * np.sin(7 * np.arange(28.0))])
# With constant steps an implicit method has no tolerance from which to derive that of its root finder.
NEWTON = optx.Newton(rtol=1e-10, atol=1e-12, norm=optx.max_norm)
RADAU5 = lj.Radau5(root_finder=SimplifiedNewton(rtol=1e-12, atol=1e-12))
# Name, method, claimed order, steps per unit of time.
GENERAL = [
    ("lj.Tsit5", lj.Tsit5(), 5, (112, 160, 224)),
    ("lj.Dopri8", lj.Dopri8(), 8, (18, 22, 28)),
    ("lj.Radau5", RADAU5, 5, (28, 40, 56)),
    ("diffrax.Kvaerno5", diffrax.Kvaerno5(root_finder=NEWTON), 5, (28, 40, 56)),
    ("diffrax.Heun", diffrax.Heun(), 2, (200, 400, 800)),
    ("diffrax.Euler", diffrax.Euler(), 1, (800, 1600, 3200)),
]
NYSTROM = [
    ("lj.Nystrom8", lj.Nystrom8(), 8, (1.0, 1.5, 2.0, 3.0)),
    ("lj.Nystrom12", lj.Nystrom12(), 12, (0.5, 0.625, 0.75, 1.0, 1.25)),
]


def by_angles(t, q, v, params):
    """Two rods end to end, in their angles from the vertical."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    kinetic = 0.5 * (m1 + m2) * (l1 * v[0]) ** 2 + 0.5 * m2 * (l2 * v[1]) ** 2
    coupling = m2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + coupling + (m1 + m2) * g * l1 * jnp.cos(q[0]) + m2 * g * l2 * jnp.cos(q[1])


def henon_heiles(t, q, v, params):
    """A star in a galaxy's plane: two equal oscillators coupled by cubic terms."""
    x, y = q
    return 0.5 * v @ v - (0.5 * (x**2 + y**2) + x**2 * y - y**3 / 3)


def points(angles, rates):
    """Positions and velocities of the masses from (..., 2) angles and their rates."""
    length = np.array([P["l1"], P["l2"]])[:, None]
    rods = length * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    moves = length * np.stack([np.cos(angles), np.sin(angles)], axis=-1) * rates[..., None]
    return tuple(Masses(x[..., 0, :], x[..., 0, :] + x[..., 1, :]) for x in (rods, moves))


def textbook(t, y):
    """The two equations of the double pendulum, solved for the angular accelerations."""
    m1, m2, l1, l2, g = P.values()
    first, second, u, w = y
    c, s = np.cos(first - second), np.sin(first - second)
    mass = np.array([[(m1 + m2) * l1, m2 * l2 * c], [l1 * c, l2]])
    force = [-m2 * l2 * w**2 * s - (m1 + m2) * g * np.sin(first), l1 * u**2 * s - g * np.sin(second)]
    return [u, w, *np.linalg.solve(mass, force)]


def exact(equation, q, v, ts):
    """SciPy's states (T, 2) at ts."""
    y = solve_ivp(equation, (0, ts[-1]), [*q, *v], "DOP853", ts, rtol=2.5e-14, atol=1e-15).y.T
    return y[:, :2], y[:, 2:]


def measured(system, motions, method, steps, ts):
    """The slope of the error, and the least error, from pairs of an initial state and the exact states at ts."""
    errors = np.zeros((len(steps), len(motions)))
    for i, n in enumerate(steps):
        for j, (start, right) in enumerate(motions):
            traj = lj.integrate(
                system, *start, P, ts=ts, method=method, dt0=jnp.asarray(1 / n),
                stepsize_controller=diffrax.ConstantStepSize(), estimate_error=False,
            )  # fmt: skip
            apart = jax.tree.map(lambda found, known: np.linalg.norm(found - known), (traj.q, traj.v), right)
            errors[i, j] = np.linalg.norm(jax.tree.leaves(apart))
    return -np.polyfit(np.log(steps), np.mean(np.log(errors), axis=1), 1)[0], float(errors.min())


def rows(wanted):
    """The order of each method, on each form of the motion that it supports."""
    angles = exact(textbook, ANGLES, RATES, OUTPUTS)
    rods = points(ANGLES, RATES), points(*angles)
    pull = lambda t, y: [*y[2:], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2]
    end, rng = np.array([0.0, 24.0]), np.random.default_rng(0)
    stars = [tuple(0.2 * rng.normal(size=(2, 2))) for _ in range(8)]
    forms = {
        "in angles": (lj.System(by_angles), [((ANGLES, RATES), angles)], OUTPUTS),
        "on constraints": (double_pendulum.system, [rods], OUTPUTS),
        "Hénon and Heiles": (lj.System(henon_heiles), [(star, exact(pull, *star, end)) for star in stars], end),
    }
    cases = [(form, *case) for case in GENERAL for form in ("in angles", "on constraints")]
    for form, name, method, claimed, steps in cases + [("Hénon and Heiles", *case) for case in NYSTROM]:
        what = f"{name}, {form}: order off its claim"
        if wanted(what):
            system, motions, ts = forms[form]
            found, least = measured(system, motions, method, steps, ts)
            more = {"method": name, "form": form, "claimed": claimed, "order": found, "least_error": least}
            yield row(what, abs(found - claimed), 1.0 if "Nystrom" in name else 0.35, **more)


if __name__ == "__main__":
    warnings.simplefilter("ignore", lj.AccuracyWarning)  # Euler's steps are expected to be inaccurate.
    main(rows, __doc__)
