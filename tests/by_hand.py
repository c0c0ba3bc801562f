"""Finished motions made of given numbers, without an integration: for what prints, draws, writes and judges them."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from scipy.special import ellipj, ellipk

import lagjax as lj
from lagjax.integrate import Trajectory
from lagjax.integrate.results import Errors, Snapshot, SolveInfo, SolveOptions, pack
from lagjax.integrate.solve.programs import trajectory_of

ASKED = SolveOptions(None, None, None, np.asarray(np.inf), None, "project")
HOW = SolveInfo("Dopri8", 8, 13, "tolerance")


def by_hand(
    system, t, q, v, params=None, *, off=None, steps=100, more=200, asked=ASKED, how=HOW, solve: Any = trajectory_of,
    tolerance=(1e-9, 1e-9), **fields,
) -> Trajectory:  # fmt: skip
    """A motion through q, v at the times t, in so many steps; `off`: their estimated errors, by `more` steps."""
    t, of_end = np.asarray(t, np.result_type(*jax.tree.leaves(q))), jax.tree.map(lambda x: np.asarray(x)[-1], (q, v))
    none, many = fields.get("multipliers", {}), np.asarray(steps)
    arrays, static = pack((system, params, asked), how, solve)
    error = None if off is None else Errors(*off, none, {}, lj.RESULTS.successful, np.asarray(more))
    end = Snapshot(t[-1], *of_end, jax.tree.map(lambda x: x[-1], none))
    usual = {
        "multipliers": none, "end": end, "scaled_error": np.asarray(0.0), "result": lj.RESULTS.successful, "events": {},
        "stats": {"num_steps": many, "num_accepted_steps": many, "num_rejected_steps": np.asarray(0)},
        "tolerance": tuple(np.full(2, x) for x in tolerance), "error": error,
    }  # fmt: skip
    return Trajectory(t=t, q=q, v=v, arrays=arrays, static=static, **(usual | fields))


def with_problem(traj, system=None, params=None, **asked):
    """The same numbers as a motion of another system, with other parameters, asked for otherwise."""
    problem = system or traj.system, traj.params if params is None else params, traj.asked._replace(**asked)
    arrays, static = pack(problem, traj.static.how, traj.static.integrate)
    return replace(traj, arrays=arrays, static=static)


def swing(t, amplitude: float, rate=1.0):
    """A pendulum's angle and its rate after a release: Landau & Lifshitz, *Mechanics*, §11."""
    k = np.sin(amplitude / 2)
    sn, cn, dn, _ = ellipj(ellipk(k**2) - rate * np.asarray(t), k**2)
    return 2 * np.arcsin(k * sn), -2 * k * rate * cn * dn / np.sqrt(1 - (k * sn) ** 2)


def kepler(t, e):
    """Places and velocities (..., 2) on an orbit with k = a = 1 from its pericentre, where M = E - e sin E.

    Kepler's equation is solved by halving, as E lies within e of M.
    """
    M = np.mod(np.asarray(t) + np.pi, 2 * np.pi) - np.pi
    E, low, high = M, M - e, M + e
    for _ in range(60):
        E = (low + high) / 2
        late = E - e * np.sin(E) > M
        low, high = np.where(late, low, E), np.where(late, E, high)
    b, rate = np.sqrt(1 - e**2), 1 / (1 - e * np.cos(E))
    places, ways = ([np.cos(E) - e, b * np.sin(E)], [-rate * np.sin(E), b * rate * np.cos(E)])
    return np.stack(places, axis=-1), np.stack(ways, axis=-1)
