"""Alternatives to lagjax: bare diffrax and SciPy, with accelerations derived by hand.

Each function takes `acceleration(t, q, v, params)` and a motion, and returns a function of a tolerance that integrates
the motion and returns the states at `ts` and the number of evaluations: an entry of `others` of `lj.work_precision`.
SciPy calls the compiled acceleration from Python.
"""

import warnings
from collections.abc import Callable
from typing import cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, PyTree

MAX_STEPS = 2**20


def usual_others(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray) -> dict[str, Callable]:
    """All alternatives by name."""
    motion = acceleration, q0, v0, params, np.asarray(ts)
    return {
        "diffrax, by hand": bare_diffrax(*motion),
        "DOP853, by hand": dop853(*motion),
        "LSODA, by hand": lsoda(*motion),
    }


def bare_diffrax(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """diffrax's Dopri8 and its own loop, compiled once."""
    start, params = jax.tree.map(lambda x: jnp.asarray(x, float), ((q0, v0), params))
    method = diffrax.Dopri8()
    stages = method.tableau.num_stages - method.tableau.fsal

    @jax.jit
    def solve(tolerance: float, start: Array, params: PyTree):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, params: (y[1], acceleration(t, *y, params))),
            method,
            ts[0],
            ts[-1],
            None,
            start,
            params,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=MAX_STEPS,
            throw=False,
        )
        q, v = cast(tuple, solution.ys)
        return q, v, stages * solution.stats["num_steps"]

    return lambda tolerance: solve(jnp.asarray(tolerance), start, params)


def dop853(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """`scipy.integrate.solve_ivp` with DOP853."""
    field, y0, as_states = _flat_problem(acceleration, q0, v0, params)

    def solve(tolerance: float):
        solution = scipy.integrate.solve_ivp(
            field, (ts[0], ts[-1]), y0, method="DOP853", t_eval=ts, rtol=tolerance, atol=tolerance
        )
        return *as_states(solution.y.T if solution.success else np.full((len(ts), len(y0)), np.nan)), solution.nfev

    return solve


def lsoda(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """`scipy.integrate.odeint`, which is LSODA."""
    field, y0, as_states = _flat_problem(acceleration, q0, v0, params)

    def solve(tolerance: float):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
            options = {"tfirst": True, "rtol": tolerance, "atol": tolerance, "mxstep": MAX_STEPS}
            y, info = scipy.integrate.odeint(field, y0, ts, full_output=True, **options)
        well = info["message"] == "Integration successful."
        return *as_states(y if well else np.full_like(y, np.nan)), int(info["nfe"][-1])

    return solve


def _flat_problem(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree):
    """The vector field for flat vectors, the start as a vector, and a function from rows of vectors to (q, v)."""
    y0, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, float), (q0, v0)))

    @jax.jit
    def rates(t: ArrayLike, y: Array):
        q, v = unravel(y)
        return ravel_pytree((v, acceleration(t, q, v, params)))[0]

    return lambda t, y: np.asarray(rates(t, y)), np.asarray(y0), jax.jit(jax.vmap(unravel))
