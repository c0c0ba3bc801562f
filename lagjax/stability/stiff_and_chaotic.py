"""Motions that amplify errors more than any method causes: close encounters, tumbling and chaos.

The end of a chaotic motion depends on the last digit of a number, so the only correct answer is a warning. The
reference end states were extrapolated in long double, from equations derived by hand
(`benchmarks/accuracy/amplifying.py`).
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.report import MAIN
from lagjax.stability.trial import DEGRADED, Trial
from lagjax.system import System


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
