"""Stiff springs, the largest stable step, and motions that amplify errors more than any method causes.

**The largest stable fixed step** is found by trial and compared with the method's stability function. One step of a
Runge-Kutta method (A, b) on y' = λ y multiplies y by R(z) = 1 + z bᵀ (I - z A)⁻¹ 1, z = h λ. On the oscillator q̈ = -ω²
q the eigenvalues are λ = ±iω: the step is stable as long as |R(ihω)| <= 1.

Source: Hairer & Wanner, *Solving ODEs II*, §IV.2.

**Amplifying motions**: close encounters, tumbling and chaos. The end of a chaotic motion depends on the last digit of a
number, so the only correct answer is a warning. The reference end states were extrapolated in long double, from
equations derived by hand (`benchmarks/accuracy/amplifying.py`).
"""

from dataclasses import dataclass, field
from functools import partial

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import integrate
from lagjax.mechanisms import car_axis, governor
from lagjax.numerics import Dopri8, Radau5
from lagjax.report import FULL, MAIN
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, Outcome, Trial, zeros
from lagjax.system import System, coordinates

# A step is stable if the amplitude grows by less than GROWTH in STEPS steps; |R| of Dopri8 crosses 1 steeply.
STEPS, GROWTH = 4000, 1.01
OMEGA = 1e5
HALVINGS = 20


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ v² - ½ ω² q²."""
    return 0.5 * v**2 - 0.5 * params["omega"] ** 2 * q**2


oscillator = System(lagrangian)


def exact(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """The exact q and its rate."""
    w = params["omega"]
    return q0 * jnp.cos(w * ts) + v0 / w * jnp.sin(w * ts), v0 * jnp.cos(w * ts) - w * q0 * jnp.sin(w * ts)


def amplification(method, z):
    """R(z) for an array of z, computed stage by stage from the method's lower triangular tableau."""
    tableau, z = method.tableau, np.asarray(z)
    diagonal = np.zeros(len(tableau.b_sol)) if tableau.a_diagonal is None else tableau.a_diagonal
    stages = []
    for row, on_diagonal in zip([[], *tableau.a_lower], diagonal):
        stages.append((1 + z * sum((a * k for a, k in zip(row, stages)), 0 * z)) / (1 - z * on_diagonal))
    return 1 + z * sum(b * k for b, k in zip(tableau.b_sol, stages))


def stable_limit(method, growth=GROWTH, steps=STEPS) -> float:
    """The smallest hω at which the amplitude grows by more than `growth` in `steps` steps; infinite if none does."""
    y = np.concatenate([np.linspace(1e-4, 20.0, 200_000), np.logspace(np.log10(20.0), 6, 1000)])
    unstable = y[steps * np.log(np.abs(amplification(method, 1j * y))) > np.log(growth)]
    return unstable[0] if unstable.size else np.inf


@dataclass(frozen=True)
class StableStep:
    """The largest stable step of a method on a stiff oscillator, by bisection."""

    method: diffrax.AbstractSolver
    expected: str | None = ACCURATE
    tier: int = FULL
    family: str = field(default="stable step", init=False)

    def attempt(self) -> Outcome:
        """Bisect between a stable and an unstable step."""
        low, high = 0.05, 40.0
        limit = stable_limit(self.method)
        if self._stable(1e6):
            measured, effort = np.inf, "any h"
        else:
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if self._stable(middle) else (low, middle)
            measured, effort = low, f"h = {low:.4f}/omega"
        same = np.isinf(limit) and np.isinf(measured)
        return Outcome(
            family=self.family,
            name=f"oscillator of omega = {OMEGA:g}, against |R(ihω)| = 1",
            method=type(self.method).__name__,
            effort=effort,
            error=0.0 if same else abs(measured / limit - 1),
            allowed=1e-3,
            expected=self.expected,
        )

    def _stable(self, step):
        h = step / OMEGA
        motion = integrate(
            oscillator, 1.0, 0.0, {"omega": OMEGA}, ts=np.array([0.0, STEPS * h]), method=self.method, throw=False,
            dt0=h, stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
        amplitude = np.hypot(float(motion.end.q), float(motion.end.v) / OMEGA)
        return bool(amplitude <= GROWTH)


def spring(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ |ṙ|² - ½ k (|r| - 1)²."""
    return 0.5 * jnp.sum(v**2) - 0.5 * params["k"] * (jnp.sqrt(jnp.sum(q**2)) - 1.0) ** 2


whirled = System(spring)


def _whirl(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """The circle at the rate ω, on which the spring balances at the radius k / (k - ω²)."""
    rate = v0[1] / q0[0]
    radius = params["k"] / (params["k"] - rate**2)
    cos, sin = jnp.cos(rate * ts), jnp.sin(rate * ts)
    return radius * jnp.stack([cos, sin], axis=-1), radius * rate * jnp.stack([-sin, cos], axis=-1)


def stiff():
    """A mass whirled on a spring of stiffness k, up to 1e5 times faster than the motion; mechanisms; fixed steps."""
    # At its stability limit the method of order 12 amplifies a derivative more than the motion, which alone the step
    # size controls; hence `derived` only up to k < 1e7.
    rows = [_spring(k, None, derived=k < 1e7) for k in (1e4, 1e6, 1e8, 1e10)]
    rows += [_spring(k, Dopri8(), derived=True) for k in (1e4, 1e6, 1e8)]
    rows += [_spring(k, Radau5(), expected=None) for k in (1e4, 1e6, 1e8, 1e10)]
    return [*rows, *(_mechanism(m) for m in (car_axis, governor)), *_fixed_steps()]


def _spring(k, method, derived=False, **what):
    radius = k / (k - 1.0)
    q0, v0, params = np.array([radius, 0.0]), np.array([0.0, radius]), {"k": k}
    # The derivative along the family of circles: dr/dω = 2 k ω / (k - ω²)².
    slope = 2 * k / (k - 1.0) ** 2
    along = np.array([slope, 0.0]), np.array([0.0, radius + slope]), zeros(params)
    return Trial(
        "stiff spring", f"k = {k:.0e}", whirled, q0, v0, params, np.linspace(0.0, 5.0, 6), _whirl,
        along if derived else None, tolerance=1e-8, method=method, **what,
    )  # fmt: skip


def _mechanism(mechanism):
    def vectors(q: PyTree, v: PyTree):
        return (coordinates.flatten(q)[0], coordinates.flatten(v)[0])

    return Trial(
        "stiff mechanism", mechanism.name.replace("_", " "), mechanism.system, mechanism.q0, mechanism.v0,
        dict(mechanism.params), np.array([0.0, mechanism.end]), lambda *_: vectors(*mechanism.reference),
        observed=lambda trajectory: vectors(trajectory.end.q, trajectory.end.v), tolerance=1e-8,
    )  # fmt: skip


def friction(t, q: PyTree, v: PyTree, params: PyTree):
    """R = ½ c v²."""
    return 0.5 * params["c"] * v**2


def free(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ v²."""
    return 0.5 * v**2


braked = System(free, dissipation=friction)


def _braking(q0: PyTree, v0: PyTree, params: PyTree, ts):
    decay = jnp.exp(-params["c"] * ts)
    return q0 + v0 / params["c"] * (1 - decay), v0 * decay


def _fixed_steps():
    """Fixed steps below and above the largest stable one, 3.70/ω on an oscillator and 5.17/c on a brake (Dopri8)."""

    def constant(h: float):
        return {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(h)}

    rows = []
    for step, expected in ((0.25, ACCURATE), (3.9, DEGRADED), (8.0, REFUSED)):
        h = step / OMEGA
        rows.append(
            Trial(
                "fixed step", f"{step:g}/omega on an oscillator", oscillator, 1.0, 0.0,
                {"omega": OMEGA}, np.linspace(0.0, 1000 * h, 5), exact, tolerance=1e-9,
                method=Dopri8(), options=constant(h), periods=1000 * step / (2 * np.pi), expected=expected,
                tier=MAIN if expected == DEGRADED else FULL,
            )
        )  # fmt: skip
    for step in (0.25, 6.0):
        h = step / 1e3
        rows.append(
            Trial(
                "fixed step", f"{step:g}/c on a brake", braked, 0.0, 1.0, {"c": 1e3}, np.linspace(0.0, 100 * h, 5),
                _braking, tolerance=1e-9, method=Dopri8(), options=constant(h),
                expected=ACCURATE if step < 1 else REFUSED,
            )
        )  # fmt: skip
    return rows


def stable_steps():
    """The largest stable step of each kind of method."""
    chord = diffrax.VeryChord(rtol=1e-10, atol=1e-10)
    methods = (diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Kvaerno5(root_finder=chord))
    return [StableStep(method) for method in methods]


def attracted(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ |ṙ|² + k / r."""
    return 0.5 * jnp.sum(v**2) + params["k"] / jnp.sqrt(jnp.sum(q**2))


def henon_heiles(t, q: PyTree, v: PyTree, params: PyTree):
    """Two coordinates, coupled by a cubic (Hénon & Heiles 1964)."""
    x, y = q["x"], q["y"]
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3


def two_rods(t, q: PyTree, v: PyTree, params: PyTree):
    """A double pendulum, angles from the vertical."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    kinetic = 0.5 * (m1 + m2) * (l1 * v["one"]) ** 2 + 0.5 * m2 * (l2 * v["two"]) ** 2
    kinetic += m2 * l1 * l2 * v["one"] * v["two"] * jnp.cos(q["one"] - q["two"])
    return kinetic + (m1 + m2) * g * l1 * jnp.cos(q["one"]) + m2 * g * l2 * jnp.cos(q["two"])


def rigid_body(t, q: PyTree, v: PyTree, params: PyTree):
    """A free rigid body in Euler's angles z-x-z."""
    s, c = jnp.sin(q["theta"]), jnp.cos(q["theta"])
    one = v["phi"] * s * jnp.sin(q["psi"]) + v["theta"] * jnp.cos(q["psi"])
    two = v["phi"] * s * jnp.cos(q["psi"]) - v["theta"] * jnp.sin(q["psi"])
    three = v["phi"] * c + v["psi"]
    return 0.5 * (params["A"] * one**2 + params["B"] * two**2 + params["C"] * three**2)


kepler, cubic, pendulum, body = map(System, (attracted, henon_heiles, two_rods, rigid_body))


def _on_ellipse(eccentricity, q0: PyTree, v0: PyTree, params: PyTree, ts):
    """Motion from the pericentre of an ellipse with k = a = 1, by Newton's method for Kepler's equation."""
    mean = jnp.mod(ts, 2 * jnp.pi)
    anomaly = mean + eccentricity * jnp.sin(mean)
    for _ in range(40):
        excess = anomaly - eccentricity * jnp.sin(anomaly) - mean
        anomaly = anomaly - excess / (1 - eccentricity * jnp.cos(anomaly))
    b, rate = jnp.sqrt(1 - eccentricity**2), 1 / (1 - eccentricity * jnp.cos(anomaly))
    q = jnp.stack([jnp.cos(anomaly) - eccentricity, b * jnp.sin(anomaly)], axis=-1)
    return q, jnp.stack([-jnp.sin(anomaly) * rate, b * jnp.cos(anomaly) * rate], axis=-1)


def _turns(eccentricity, **what):
    """Ten turns: an energy error becomes a time error, which matters most next to the pericentre."""
    turns = np.array([0.0, 0.25, 5.0 + 1e-4, 10.0 + 1e-4])
    exact = partial(_on_ellipse, eccentricity)
    q0 = np.array([1 - eccentricity, 0.0])
    v0 = np.array([0.0, np.sqrt((1 + eccentricity) / (1 - eccentricity))])
    return Trial(
        "amplifying", f"ten turns about a centre, e = {eccentricity:g}", kepler, q0, v0, {"k": 1.0}, 2 * np.pi * turns,
        exact, periods=10.0, amplification=(1 - eccentricity) ** -1.5, **what,
    )  # fmt: skip


def _to(name: str, system, params: PyTree, span, start, end, **what):
    """A motion with a known last state."""
    both = [{key: np.array([first[key], last[key]]) for key in first} for first, last in zip(start, end)]
    ts = np.array([0.0, span])
    return Trial("amplifying", name, system, *start, params, ts, lambda *_: tuple(both), **what)


def amplifying():
    """Eccentric orbits, a body turning about its middle axis, and chaos, after which no digit is correct."""
    zero = {"x": 0.0, "y": 0.0}
    return [
        _turns(0.9, expected=None),
        # The velocity error at the pericentre is more than 10,000 tolerances.
        _turns(0.99, expected=DEGRADED, tier=MAIN),
        _turns(0.999, expected=DEGRADED),
        _to(
            "a body about its middle axis, 20", body, {"A": 1.0, "B": 2.0, "C": 3.0}, 20.0,
            ({"phi": 0.0, "theta": 1.25, "psi": 0.5},
             {"phi": 1.8500123995428526, "theta": -0.95799406298781, "psi": -0.581397155284392}),
            ({"phi": 42.28618406310, "theta": 1.298803365342, "psi": -3.463190102555},
             {"phi": 1.653286413778, "theta": -1.209926215267, "psi": 0.509198556507}),
            periods=6.0, amplification=1e4, expected=None,
        ),
        _to(
            "Henon and Heiles, chaotic, 250", cubic, {}, 250.0, (zero, {"x": 0.5, "y": 0.28125}),
            ({"x": 0.744825, "y": -0.449279}, {"x": -0.101729, "y": -0.012898}), expected=DEGRADED, tier=MAIN,
        ),
        _to(
            "double pendulum, wide, 20", pendulum, {"m1": 1.0, "m2": 1.5, "l1": 1.0, "l2": 0.75, "g": 9.81}, 20.0,
            ({"one": 2.5, "two": 2.0}, {"one": 0.0, "two": 0.0}),
            ({"one": -4.973, "two": 0.344}, {"one": -5.074, "two": -2.118}), expected=DEGRADED,
        ),
        _to(
            "Henon and Heiles, regular, 50", cubic, {}, 50.0, ({"x": 0.25, "y": 0.125}, {"x": 0.125, "y": 0.0}),
            ({"x": -0.1989109610708, "y": 0.216591380111}, {"x": 0.105826332904, "y": -0.0055662042923}), periods=8.0,
        ),
    ]  # fmt: skip
