"""The linear-quadratic regulator: the feedback that costs least near an equilibrium.

With δx = (δq, δv) and δu about an equilibrium, the equations of motion and the cost are, to the lowest order,

    δẋ = A δx + B δu,    J = ∫ δxᵀ Q δx + δuᵀ R δu + 2 δxᵀ N δu dt

and the least J from δx is δxᵀ S δx, by δu = -K δx with K = R⁻¹ (Bᵀ S + Nᵀ), where S is the stabilising solution of

    Aᵀ S + S A - (S B + N) R⁻¹ (Bᵀ S + Nᵀ) + Q = 0

A and B are derivatives of the accelerations, Q, R and N halves of second derivatives of the cost. On holonomic
constraints δq and δv are the displacements that these allow, T η and T ω with Tᵀ T = 1; at rest T does not change. A
slope of the cost along their normals then has a part in Q (`linear_quadratic.py`).

Source: Kwakernaak & Sivan, *Linear Optimal Control Systems*, §3.4; SciPy's `solve_continuous_are`.
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree
from scipy.linalg import solve_continuous_are

from lagjax.integrate import ENDED_WELL, Trajectory, is_among
from lagjax.jaxtools import compiled, to_jax
from lagjax.numerics import null_space
from lagjax.system import System, check_system, constraints, coordinates, unchecked
from lagjax.two_points.linear_quadratic import check_weights, linear
from lagjax.two_points.question import checked_cost, controlled, velocity_name
from lagjax.two_points.tracking import TrackingLQR, about_trajectory

# Accelerations, in units of what a displacement of one brings about, below which a state is an equilibrium.
STEADY_BELOW = 1e-6


class LQR(eqx.Module):
    """The feedback u = u₀ - K (x - x₀) about an equilibrium, x = (q, v).

    >>> import lagjax as lj
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["push"])
    >>> held = lj.lqr(cart, {"push": 0.0}, (0.0, 0.0), lambda t, q, v, u, p: q**2 + u["push"] ** 2)
    >>> print(held.control(1.0, 0.0)["push"].round(9))
    -1.0

    - `gain` K (k, 2n): rows in the order of the controls, columns in that of `names`, coordinates and then velocities.
    - `cost_to_go` S (2n, 2n): (x - x₀)ᵀ S (x - x₀) is the cost from x on.
    - `eigenvalues`: of the motion under the feedback, `[1/t]`; all decay.
    - `control(q, v)`: the controls at a state, by name, also inside JAX programs.
    """

    gain: Float[Array, "k m"]
    cost_to_go: Float[Array, "m m"]
    eigenvalues: np.ndarray
    state: Float[Array, " m"]
    controls: PyTree
    names: tuple[str, ...] = eqx.field(static=True)

    def control(self, q: PyTree, v: PyTree) -> PyTree:
        """The controls at a state, in the structure of the controls at the equilibrium."""
        held, back = ravel_pytree(jax.tree.map(jnp.asarray, self.controls))
        x = jnp.concatenate([coordinates.flatten(q)[0], coordinates.flatten(v)[0]])
        return back(held - self.gain @ (x - self.state))

    def __repr__(self):
        slowest = max(self.eigenvalues, key=lambda x: x.real)
        rows = [f"  {name}: {np.array2string(np.asarray(row), precision=6)}" for name, row in
                zip(coordinates.names(self.controls), self.gain)]  # fmt: skip
        header = f"LQR of {', '.join(self.names)}; the slowest motion decays by exp({slowest.real:.4g} t)"
        return "\n".join([header, *rows])


def lqr(
    system: System,
    controls: Mapping[str, ArrayLike] | Callable,
    state: tuple[PyTree, PyTree] | Trajectory,
    cost: Callable,
    params: PyTree = None,
    *,
    t: ArrayLike = 0.0,
    end_cost: Callable | None = None,
    with_control: Callable[[PyTree, PyTree], PyTree] | None = None,
) -> LQR | TrackingLQR:
    """Return the feedback about an equilibrium or a trajectory that costs least: the linear-quadratic regulator.

    >>> import lagjax as lj
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["push"])
    >>> found = lqr(cart, {"push": 0.0}, (0.0, 0.0), lambda t, q, v, u, p: q**2 + u["push"] ** 2)
    >>> print(found.gain.round(9))  # 1 and √2
    [[1.         1.41421356]]

    **Arguments:**

    - `system`, `params`: as in `lj.steer`; holonomic constraints are kept.
    - `controls`: by name, the controls that hold the system in the equilibrium; or `controls(t)` -> dict, those that
      cause the trajectory, as `lj.steer(...).controls`. Where they jump, at their `knots` if they have any, gains begin
      anew.
    - `state`: the equilibrium (q, v), at rest; or a `Trajectory`, as `lj.steer(...).trajectory`.
    - `cost(t, q, v, u, params)` -> scalar, per unit of time: least at the equilibrium. Its second derivatives there, or
      along the trajectory, are the weights; on constraints those along what these allow, which bends.
    - `t`: the time at which everything is taken; a trajectory has its own.
    - `end_cost(t, q, v, params)` -> scalar: its second derivatives are the weights of the trajectory's end.
    - `with_control`: as in `lj.rollout`.

    **Returns:** an `LQR`: gains, cost to go, eigenvalues and `control(q, v)`. For a trajectory a `TrackingLQR`, whose
    gains depend on time: `control(t, q, v)`; where the controls jump, so does the force (`jump_ts=controls.knots`).

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind or shape; velocity constraints at an equilibrium; a
      state that accelerates, or at which the cost is not least; a trajectory that failed.
    - `ValueError` where no feedback is stable, with the coordinate that the controls do not reach, or where a control
      costs nothing.

    Source: Kwakernaak & Sivan, *Linear Optimal Control Systems*, §3.4.
    """
    check_system(system, states=False)
    if isinstance(state, Trajectory):
        return _along(system, controls, state, cost, params, end_cost, with_control)
    if end_cost is not None:
        raise ValueError("end_cost belongs to a trajectory, and an equilibrium has no end.\nFix: leave it out.")
    q, v = state
    if any(not c.of_positions for c in system.constraints.values()):
        raise ValueError(
            "lj.lqr takes holonomic constraints, and this system restricts velocities alone: no smooth feedback brings "
            "it to one state (Brockett's condition).\nFix: lj.steer from state to state."
        )
    given = controlled(system, controls, coordinates.prepared(t, q, v, params), with_control)
    cost = checked_cost(cost, given)
    x, u, w = (coordinates.vector(y) for y in (given.state.q, given.state.v, given.controls))
    n, names = x.size, coordinates.names(given.state.q)
    names = (*names, *(velocity_name(name) for name in names))
    tangent = np.eye(n)
    if given.form.m:
        model = unchecked(given.system, given.merge(given.state.params, given.controls), given.form)
        tangent = null_space(np.asarray(compiled(constraints.jacobian)(model, given.state.t, x, u)))
    still, (by_q, by_v, by_w), slope, weights = jax.tree.map(np.asarray, linear(given, cost, x, u, w))
    size = max(1.0, float(np.max(np.abs(by_q))))
    worst = int(np.argmax(np.abs(still)))
    if not abs(still[worst]) <= STEADY_BELOW * size or np.any(u):
        raise ValueError(
            f"not an equilibrium: '{names[worst]}' accelerates by {float(still[worst]):.3g} under these controls"
            f"{', and the velocities are not zero' if np.any(u) else ''}.\n"
            "Usual cause: controls of zero where a force has to hold the system.\n"
            'Fix: controls={"torque": ...} that balance the forces; lj.equilibria finds the state for given controls.'
        )
    z = np.zeros_like(tangent)
    both = np.block([[tangent, z], [z, tangent]])
    lift = np.block([[both, np.zeros((2 * n, w.size))], [np.zeros((w.size, both.shape[1])), np.eye(w.size)]])
    if np.max(np.abs(lift.T @ slope)) > STEADY_BELOW * max(1.0, float(np.max(np.abs(weights)))):
        raise ValueError(
            "the cost is not least at the equilibrium: its derivatives there are not zero.\n"
            "Usual cause: u**2 where the control that holds the system is not zero, or a target elsewhere.\n"
            'Fix: squares of differences from the equilibrium, (q["angle"] - jnp.pi) ** 2.'
        )
    a, b = _first_order(tangent, by_q, by_v, by_w)
    weights = lift.T @ weights @ lift / 2
    k = a.shape[0]
    q_weight, cross, r_weight = weights[:k, :k], weights[:k, k:], weights[k:, k:]
    check_weights(r_weight, coordinates.names(given.controls))
    try:
        s = solve_continuous_are(a, b, q_weight, r_weight, s=cross)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(_unreached(a, b, both, names)) from error
    gain = np.linalg.solve(r_weight, b.T @ s + cross.T)
    values = np.linalg.eigvals(a - b @ gain)
    if not np.max(values.real) < 0:
        raise ValueError(_unreached(a, b, both, names))
    found = map(to_jax, (gain @ both.T, both @ s @ both.T))
    return LQR(*found, values, to_jax(np.concatenate([x, u])), given.controls, names)


def _along(system, controls, trajectory, cost, params, end_cost, with_control) -> TrackingLQR:
    """The regulator about a trajectory."""
    if not callable(controls):
        raise TypeError(
            f"about a trajectory controls are a function of time, not {type(controls).__name__}.\n"
            'Fix: controls=found.controls of lj.steer, or lambda t: {"push": ...}.'
        )
    if jnp.ndim(trajectory.end.t) or not is_among(trajectory.result, ENDED_WELL):
        raise ValueError(
            "the trajectory failed, or is a batch: there is no motion to keep to.\n"
            "Fix: one motion that reaches its end."
        )
    t, q, v = trajectory.t[0], *jax.tree.map(lambda x: x[0], (trajectory.q, trajectory.v))
    given = controlled(system, controls(t), coordinates.prepared(t, q, v, params), with_control)
    return about_trajectory(given, controls, trajectory, checked_cost(cost, given), end_cost)


def _first_order(tangent: np.ndarray, by_q: Array, by_v: Array, by_w: Array) -> tuple[np.ndarray, np.ndarray]:
    f, t = tangent.shape[1], tangent
    a = np.block([[np.zeros((f, f)), np.eye(f)], [t.T @ by_q @ t, t.T @ by_v @ t]])
    return a, np.concatenate([np.zeros((f, by_w.shape[1])), t.T @ by_w])


def _unreached(a: np.ndarray, b: np.ndarray, both: np.ndarray, names: tuple[str, ...]) -> str:
    """Which motion neither decays nor is reached by the controls (Popov, Belevitch and Hautus' test)."""
    values, left = np.linalg.eig(a.T)
    size = max(np.linalg.norm(a), np.linalg.norm(b), 1.0)
    for value, vector in zip(values, left.T):
        if value.real > -1e-9 * size and np.linalg.norm(vector @ b) < 1e-9 * size:
            name = names[int(np.argmax(np.abs(both @ vector)))]
            return (
                f"no feedback is stable: the controls do not reach the motion of '{name}', which does not decay "
                f"(eigenvalue {value:.4g}).\nUsual cause: a coordinate that no control and no coupling moves.\n"
                f"Fix: a control that acts on it; leave it out of the system; or damping."
            )
    return (
        "the Riccati equation has no stabilising solution.\n"
        "Usual cause: a motion that does not decay and costs nothing, as a position that the cost leaves out.\n"
        "Fix: a cost on all coordinates, 1e-6 * q**2 where it does not matter."
    )
