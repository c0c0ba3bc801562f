"""Stiff springs and mechanisms, and the limits of a fixed step."""

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanisms import car_axis, governor
from lagjax.numerics import Dopri8, Radau5
from lagjax.report import FULL, MAIN
from lagjax.stability import oscillator
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, Trial, zeros
from lagjax.system import System, coordinates


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
    return [*rows, *(_mechanism(m.MECHANISM) for m in (car_axis, governor)), *_fixed_steps()]


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
        h = step / oscillator.OMEGA
        rows.append(
            Trial(
                "fixed step", f"{step:g}/omega on an oscillator", oscillator.oscillator, 1.0, 0.0,
                {"omega": oscillator.OMEGA}, np.linspace(0.0, 1000 * h, 5), oscillator.exact, tolerance=1e-9,
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
    return [oscillator.StableStep(method) for method in methods]
