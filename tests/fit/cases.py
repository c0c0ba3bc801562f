"""Systems to be fitted, with the truth: the free parameters, their guesses, the measurements and their errors."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.fit import residuals
from lagjax.fit.arguments import problem_of
from lagjax.scenes import rolling_hoop, sliding_wedge, sphere_geodesic


class Case(NamedTuple):
    """`sigma` by kind of measurement that `measured(traj)` returns; `free` has the factors of the guesses."""

    system: Any
    params: dict
    free: dict[str, float]
    q0: Any
    v0: Any
    ts: np.ndarray
    measured: Any
    sigma: dict

    def problem(self, measured, **options):
        """The arrays of a fit."""
        record = lj.Record(self.ts, **measured, q0=self.q0, v0=self.v0, sigma=self.sigma)
        nothing = dict(observe=None, bounds=None, priors=None, loss="squares", window=None)
        return problem_of(self.system, record, self.guess(), sorted(self.free), **nothing, options=options)

    def truth(self):
        """The true motion."""
        return lj.integrate(self.system, self.q0, self.v0, self.params, ts=self.ts)

    def guess(self):
        """Parameters with the guesses of the free ones."""
        return {**self.params, **{name: self.params[name] * off for name, off in self.free.items()}}

    def fit(self, measured, **options):
        """A fit to some measurements."""
        record = lj.Record(self.ts, **measured, q0=self.q0, v0=self.v0, sigma=self.sigma)
        return lj.fit(self.system, record, self.guess(), free=sorted(self.free), **options)

    def noisy(self, measured, key):
        """Measurements with errors of the sizes `sigma`."""
        leaves, structure = jax.tree.flatten(measured)
        like = lambda kind: jax.tree.map(lambda _: self.sigma[kind], measured[kind])
        sigmas = jax.tree.leaves({kind: like(kind) for kind in measured})
        keys = jax.random.split(key, len(leaves))
        noisy = [x + s * jax.random.normal(k, x.shape) for x, s, k in zip(leaves, sigmas, keys)]
        return jax.tree.unflatten(structure, noisy)


# Fits of it take their motions from a formula, `in_closed_form`; integrated it would be NaN.
formula = lj.System(lambda t, q, v, params: np.nan * sum(jax.tree.leaves(v)))
Motion = NamedTuple("Motion", [(name, Any) for name in ("t", "q", "v", "multipliers", "end", "result", "params")])
End = NamedTuple("End", [(name, Any) for name in "tqv"])


def in_closed_form(monkeypatch, motion):
    """Let the fits of `formula` take q and v from `motion(t, q0, v0, params)`: no solver is compiled.

    A motion with NaN has failed.
    """

    def solved(system, q0, v0, params, *, ts, **options):
        q, v = motion(ts, q0, v0, params)
        well = jnp.all(jnp.isfinite(jnp.stack(jax.tree.leaves(q))))
        ended = lj.RESULTS.where(well, lj.RESULTS.successful, lj.RESULTS.not_finite)
        return Motion(ts, q, v, {}, End(ts[-1], *jax.tree.map(lambda x: x[-1], (q, v))), ended, params)

    monkeypatch.setattr(residuals, "integrate", solved)


def noisy(x, sigma=0.01, seed=0):
    """Values with normal errors."""
    return x + sigma * np.random.default_rng(seed).normal(size=x.shape)


def swing(t, q, v, params):
    """L of a pendulum in its angle."""
    return 0.5 * params["m"] * params["l"] ** 2 * v**2 + params["m"] * params["g"] * params["l"] * jnp.cos(q)


def air(t, q, v, params):
    """Viscous friction."""
    return 0.5 * params["c"] * v**2


pendulum = lj.System(swing, dissipation=air)
PENDULUM = {"m": 1.0, "l": 1.25, "g": 9.81, "c": 0.05}


def swung(ts, q0, v0, params):
    """Its angle and rate at times, by SciPy."""
    m, l, g, c = (params[name] for name in "mlgc")
    field = lambda t, y: [y[1], -g / l * np.sin(y[0]) - c / (m * l**2) * y[1]]
    return solve_ivp(field, ts[[0, -1]], [q0, v0], "DOP853", ts, rtol=1e-13, atol=1e-14).y


# Measurements of the pendulum, and what is not known of it.
TS = np.linspace(0.0, 5.0, 100)
GUESS = PENDULUM | {"l": 1.4, "c": 0.1}
FREE = ["c", "l"]


def hanging(t, q, v, params):
    """L of a pendulum in Cartesian coordinates."""
    return 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) - params["m"] * params["g"] * q["y"]


rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2)
hung = lj.System(hanging, {"rod": rod})
HUNG = {"m": 1.5, "g": 9.81, "l": 2.0}

of_q = lambda traj: {"q": traj.q}
with_forces = lambda traj: {"q": traj.q, "multipliers": traj.multipliers}
WEDGE = sliding_wedge.PARAMS
ON_WEDGE = sliding_wedge.start_on_incline(WEDGE, X=0.25, X_rate=0.5, along=0.125, along_rate=-0.75)
R = sphere_geodesic.PARAMS["R"]

CASES = {
    "pendulum": Case(
        pendulum, PENDULUM, {"l": 1.1, "c": 1.5}, 1.0, 0.0, np.linspace(0.0, 5.0, 100), of_q, {"q": 0.01}
    ),
    "pendulum on a rod": Case(
        hung, HUNG, {"l": 1.1, "m": 0.8}, {"x": 2.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, np.linspace(0.0, 4.0, 60),
        with_forces, {"q": 0.02, "multipliers": 0.1},
    ),
    "sphere": Case(
        sphere_geodesic.embedded, {"R": R}, {"R": 1.1}, R * np.array([0.6, 0.0, 0.8]), np.array([0.5, 1.0, -0.375]),
        np.linspace(0.0, 6.0, 40), of_q, {"q": 0.02},
    ),
    "rolling hoop": Case(
        rolling_hoop.system, rolling_hoop.PARAMS, {"g": 1.1, "m": 0.9}, *rolling_hoop.start(rolling_hoop.PARAMS, 1.2),
        np.linspace(0.0, 0.6, 60),
        lambda traj: {"q": {"theta": traj.q["theta"]}, "multipliers": {"contact": traj.multipliers["contact"]}},
        {"q": 0.005, "multipliers": 0.1},
    ),
    "wedge": Case(
        sliding_wedge.system, WEDGE, {"M": 1.1, "alpha": 0.9}, *ON_WEDGE,
        np.linspace(0.0, 2.0, 50), of_q, {"q": 0.005},
    ),
}  # fmt: skip
