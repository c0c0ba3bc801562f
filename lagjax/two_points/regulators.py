"""The linear-quadratic regulators, the feedback that costs least: near an equilibrium, and about a trajectory.

*Near an equilibrium.* With δx = (δq, δv) and δu about an equilibrium, the equations of motion and the cost are, to the
lowest order,

    δẋ = A δx + B δu,    J = ∫ δxᵀ Q δx + δuᵀ R δu + 2 δxᵀ N δu dt

and the least J from δx is δxᵀ S δx, by δu = -K δx with K = R⁻¹ (Bᵀ S + Nᵀ), where S is the stabilising solution of

    Aᵀ S + S A - (S B + N) R⁻¹ (Bᵀ S + Nᵀ) + Q = 0

A and B are derivatives of the accelerations, Q, R and N halves of second derivatives of the cost. On holonomic
constraints δq and δv are the displacements that these allow, T η and T ω with Tᵀ T = 1; at rest T does not change. A
slope of the cost along their normals then has a part in Q.

Source: Kwakernaak & Sivan, *Linear Optimal Control Systems*, §3.4; SciPy's `solve_continuous_are`.

*About a trajectory*: the feedback that brings a motion back to it.

With δx = (δq, δv) and δu about a motion x₀(t) under controls u₀(t), and A, B, Q, R, N along it as at an equilibrium,
the least of ∫ δxᵀ Q δx + δuᵀ R δu + 2 δxᵀ N δu dt + δx_bᵀ F δx_b from δx on is δxᵀ S(t) δx, by

    δu = -K δx,    K = R⁻¹ (Bᵀ S + Nᵀ),    -Ṡ = Aᵀ S + S A - (S B + N) R⁻¹ (Bᵀ S + Nᵀ) + Q,    S(t_b) = F

S = Y X⁻¹ for solutions of Hamilton's equations of the deviations, which are linear:

    Ẋ = (A - B R⁻¹ Nᵀ) X - B R⁻¹ Bᵀ Y,    Ẏ = -(Q - N R⁻¹ Nᵀ) X - (A - B R⁻¹ Nᵀ)ᵀ Y

They are solved by Gauss's collocation, of order 2s for s points, from each element's end, X = 1, Y = S, to its start.
What constraints allow is kept by the accelerations that A and B are derivatives of, and so the other directions do not
enter; the weights have what a deviation bends by on them.

Source: Kwakernaak & Sivan, *Linear Optimal Control Systems*, §3.3; Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, §II.1.3 (Gauss's collocation).

*What both take from a system and a cost*: derivatives of accelerations, and second derivatives.

On constraints a deviation is no straight line. With G = ∂g/∂q and its pseudoinverse G⁺, what g = 0 bends it by is

    q = q₀ + δq + q₂,    q₂ = -½ G⁺ g''(δq, δq),    v = v₀ + δv + v₂,    v₂ = dq₂/dt

to the second order, and by A⁺ as much more of v₂ as velocity constraints with A = ∂phi/∂v ask for. A cost with slopes
c_q, c_v has second derivatives to which those of c_q·q₂ + c_v·v₂ are added; for a slope along the normal, c_q = Gᵀ λ,
they are -λ·g'', as everywhere on a manifold.

Source: Nocedal & Wright, *Numerical Optimization*, §12.5 (the second-order condition).
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, PyTree
from scipy.linalg import block_diag, solve_continuous_are

from lagjax.integrate import ENDED_WELL, Trajectory, is_among
from lagjax.jaxtools import compiled, to_jax
from lagjax.mechanics import accelerations_at
from lagjax.numerics import null_space
from lagjax.refusals import must_be_function
from lagjax.system import (
    OF_STATE,
    Call,
    Form,
    State,
    System,
    check_system,
    constraints,
    coordinates,
    traced_call,
    unchecked,
)
from lagjax.two_points.control_problem import Controlled, check_number, checked_cost, controlled, velocity_name
from lagjax.two_points.elements import linear_motion, rule_of_degree
from lagjax.two_points.mesh import cut, in_groups, places, stacked
from lagjax.two_points.steering import Plan, plan_of

# Rows of constraints with smaller singular values, relative, say nothing that others do not.
DEPENDENT = 1e-10


@compiled
def linear(given: Controlled, cost: Callable, x: Array, u: Array, w: Array):
    """The accelerations with their derivatives, and the first and second derivatives of the cost."""
    form: Form = given.form

    def a(x: Array, u: Array, w: Array):
        model = unchecked(given.system, given.merge(given.state.params, coordinates.like(given.controls, w)), form)
        s = State(given.state.t, form.tree(x), form.tree(u), model.params)
        return coordinates.flatten(accelerations_at(model, s)[0])[0]

    def of_all(y: Array):
        x, u, w = jnp.split(y, (form.n, 2 * form.n))
        s = given.state
        return cost(s.t, form.tree(x), form.tree(u), coordinates.like(given.controls, w), s.params)

    y = jnp.concatenate([x, u, w])
    slope, curvature = jax.grad(of_all)(y), jax.hessian(of_all)(y)
    if form.m:
        states = 2 * form.n
        more = bent(given, x, u, w, slope[:states])
        curvature = curvature.at[:states, :states].add(more)
    return a(x, u, w), jax.jacfwd(a, argnums=(0, 1, 2))(x, u, w), slope, curvature


def bent(given: Controlled, x: Array, u: Array, w: Array, slope: Array) -> Float[Array, "m m"]:
    """What constraints add to the second derivatives (2n, 2n) of a cost with this slope (2n,) in x and u."""
    model = unchecked(given.system, given.merge(given.state.params, coordinates.like(given.controls, w)), given.form)
    t, n = given.state.t, given.form.n

    def g(t: Array, x: Array) -> Array:
        return constraints.position_residual(model, t, x)

    def second(t: Array, x: Array, dx: Array) -> Array:
        """q₂."""
        rows = jax.jacfwd(g, argnums=1)(t, x)
        bends = jax.jvp(lambda x: jax.jvp(lambda x: g(t, x), (x,), (dx,))[1], (x,), (dx,))[1]
        return -0.5 * jnp.linalg.pinv(rows, rtol=DEPENDENT) @ bends

    def rates(x: Array, u: Array) -> Array:
        return constraints.velocity_residual(model, t, x, u)

    def of_deviation(d: Array) -> Array:
        dx, du = d[:n], d[n:]
        q_2, v_2 = jnp.zeros_like(x), jnp.zeros_like(x)
        if model.holonomic.any():
            q_2, v_2 = jax.jvp(second, (t, x, dx), (jnp.ones_like(t), u, du))
        if not model.holonomic.all():
            along = jax.jvp(lambda x, u: jax.jvp(rates, (x, u), (dx, du))[1], (x, u), (dx, du))[1]
            off = 0.5 * along + jax.jvp(rates, (x, u), (q_2, v_2))[1]
            v_2 = v_2 - jnp.linalg.pinv(jax.jacfwd(rates, argnums=1)(x, u), rtol=DEPENDENT) @ off
        return slope[:n] @ q_2 + slope[n:] @ v_2

    return jax.hessian(of_deviation)(jnp.zeros_like(slope))


class Deviations(NamedTuple):
    """δẋ = A δx + B δu, and the weights Q, N, R of their cost; of one state, or (..., m, m) of several."""

    a: np.ndarray
    b: np.ndarray
    q: np.ndarray
    cross: np.ndarray
    r: np.ndarray

    def gain(self, s: np.ndarray) -> np.ndarray:
        """K = R⁻¹ (Bᵀ S + Nᵀ)."""
        return np.linalg.solve(self.r, self.b.mT @ s + self.cross.mT)


def deviations(slopes: tuple, curvature: Array, controls: list[str]) -> Deviations:
    """From the derivatives of accelerations by q, v and u, and second derivatives of the cost, of one or more states.

    Raises for a control that costs nothing.
    """
    by_q, by_v, by_w = (np.asarray(x) for x in slopes)
    n, weights = by_q.shape[-1], np.asarray(curvature) / 2
    a = np.block([[np.zeros_like(by_q), np.zeros_like(by_q) + np.eye(n)], [by_q, by_v]])
    q, cross, r = weights[..., : 2 * n, : 2 * n], weights[..., : 2 * n, 2 * n :], weights[..., 2 * n :, 2 * n :]
    for matrix in r.reshape(-1, *r.shape[-2:]):
        values, vectors = np.linalg.eigh(matrix)
        if values[0] <= 1e-12 * max(values[-1], 0.0):
            name = controls[int(np.argmax(np.abs(vectors[:, 0])))]
            raise ValueError(
                f"the control '{name}' costs nothing, and the least cost would take it without limit.\n"
                f'Fix: + 1e-3 * u["{name}"] ** 2 in the cost.'
            )
    return Deviations(a, np.block([[np.zeros_like(by_w)], [by_w]]), q, cross, r)


def _names_of_state(given: Controlled) -> tuple[str, ...]:
    names = coordinates.names(given.state.q)
    return (*names, *(velocity_name(name) for name in names))


def _controls(held: PyTree, gain: Array, state: Array, q: PyTree, v: PyTree) -> PyTree:
    """u₀ - K (x - x₀), in the structure of u₀."""
    held, back = ravel_pytree(jax.tree.map(jnp.asarray, held))
    x = jnp.concatenate([coordinates.flatten(q)[0], coordinates.flatten(v)[0]])
    return back(held - gain @ (x - state))


# Points on an element; elements at first and at most; and the change of S by which halving them ends, relative.
POINTS, FIRST, MOST, SETTLED = 4, 32, 1024, 1e-8
# Points that are treated together.
TOGETHER = 128


class TrackingLQR(eqx.Module):
    """The feedback u = u₀(t) - K(t) (x - x₀(t)) about a motion, x = (q, v).

    >>> import lagjax as lj
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["push"] + 0.0 * v)
    >>> rolling = lj.integrate(cart, 0.0, 1.0, {"push": 0.0}, ts=[0.0, 20.0])
    >>> held = lj.lqr(cart, lambda t: {"push": 0.0}, rolling, lambda t, q, v, u, p: q**2 + u["push"] ** 2)
    >>> print(held.control(0.0, 1.0, 1.0)["push"].round(6))  # 1 ahead, long before the end
    -1.0

    - `control(t, q, v)`: the controls at a time and state, by name, also inside JAX programs; after the end with x₀,
      u₀ and K of the end.
    - `gain(t)` K (k, 2n): rows in the order of the controls, columns in that of `names`, coordinates, then velocities.
    - `cost_to_go` S (2n, 2n) at the start: δxᵀ S δx is the cost of a deviation, to the lowest order.
    - `knots`: the times between which gains are one polynomial, `[t]`; `change`: the change of S by halving them last,
      relative.
    """

    pieces: Plan
    controls: Callable
    cost_to_go: Float[Array, "m m"]
    change: float
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def knots(self) -> np.ndarray:
        return self.pieces.knots

    def gain(self, t: ArrayLike) -> Float[Array, "k m"]:
        """K at a time."""
        return self.pieces(self._within(t))["gain"]

    def control(self, t: ArrayLike, q: PyTree, v: PyTree) -> PyTree:
        """The controls at a time and a state, in the structure of those that are given."""
        t = self._within(t)
        along = self.pieces(t)
        return _controls(self.controls(t), along["gain"], along["state"], q, v)

    def _within(self, t: ArrayLike) -> Array:
        return jnp.clip(jnp.asarray(t, self.pieces.starts.dtype), self.knots[0], self.knots[-1])

    def __repr__(self):
        return (
            f"TrackingLQR of {', '.join(self.names)} from t = {self.knots[0]:.6g} to {self.knots[-1]:.6g}; "
            f"{len(self.knots) - 1} pieces, and S changed by {self.change:.0e} when they were halved"
        )


def about_trajectory(
    given: Controlled, controls: Callable, trajectory: Trajectory, cost: Callable, end_cost: Callable | None
) -> TrackingLQR:
    """The regulator about a motion, on elements halved until S at its start no longer changes."""
    end = _end_weights(given, controls, trajectory, end_cost)
    first, last = float(trajectory.t[0]), float(trajectory.end.t)
    knots = np.unique(np.clip([first, *np.asarray(getattr(controls, "knots", ())), last], first, last))
    knots = cut(knots, max(1, -(-FIRST // (len(knots) - 1))))
    before, change = None, np.inf
    while True:
        pieces, s = _regulated(given, controls, trajectory, cost, knots, end)
        if before is not None:
            change = float(np.max(np.abs(s - before)) / max(np.max(np.abs(s)), np.finfo(float).tiny))
        if not np.all(np.isfinite(s)):
            raise ValueError(
                "the cost of deviations has no least value: it grows without limit toward the start.\n"
                "Usual cause: a cost that rewards to depart, as -q**2 or a cosine about its maximum.\n"
                "Fix: squares of q, v and u; the gradient of the cost along the motion does not matter."
            )
        if change < SETTLED or 2 * (len(knots) - 1) > MOST:
            return TrackingLQR(pieces, controls, jnp.asarray(s), change, _names_of_state(given))
        before, knots = s, cut(knots)


def _regulated(given: Controlled, controls: Callable, trajectory: Trajectory, cost: Callable, knots: np.ndarray, end):
    """K and x₀ on elements between knots, and S at the start."""
    rule, t = rule_of_degree(POINTS), places(knots, rule_of_degree(POINTS).points)
    x, u = in_groups(partial(_states, trajectory), TOGETHER, t)
    w = np.stack([coordinates.vector(controls(t)) for t in t])
    about = deviations(
        *in_groups(partial(_derivatives, given, cost), TOGETHER, t, x, u, w), coordinates.names(given.controls)
    )
    a, b, q, cross, r = about
    m, by_cross, by_b = a.shape[1], np.linalg.solve(r, cross.mT), np.linalg.solve(r, b.mT)
    a_less = a - b @ by_cross
    hamiltonian = np.block([[a_less, -b @ by_b], [-(q - cross @ by_cross), -a_less.mT]])
    costs, s = np.empty_like(a), end
    for e in reversed(range(len(knots) - 1)):
        at = slice(e * POINTS, (e + 1) * POINTS)
        y = np.concatenate([np.eye(m), s])
        inside, start = linear_motion(rule, knots[e + 1] - knots[e], hamiltonian[at], y, backward=True)
        costs[at], s = _cost_to_go(inside), _cost_to_go(start)
        s = (s + s.T) / 2
    gains, count = about.gain(costs), len(knots) - 1
    example = {"gain": np.zeros(gains.shape[1:]), "state": np.zeros(m)}
    rows = np.concatenate([gains.reshape(len(t), -1), x, u], axis=1).reshape(count, POINTS, -1)
    limits = np.full((2, rows.shape[2]), np.inf) * np.array([[-1.0], [1.0]])
    return plan_of(knots, rows, limits, example, rule.points, count), s


def _cost_to_go(y: np.ndarray) -> np.ndarray:
    """S = Y X⁻¹, by its transpose."""
    x, y = np.split(y, 2, axis=-2)
    return np.linalg.solve(x.mT, y.mT)


def _states(trajectory: Trajectory, t: np.ndarray) -> list[Array]:
    now = trajectory.at(t)
    return [stacked(now.q), stacked(now.v)]


@compiled
def _derivatives(given: Controlled, cost: Callable, t: Array, x: Array, u: Array, w: Array):
    def at(t: Array, x: Array, u: Array, w: Array):
        now = eqx.tree_at(lambda given: given.state.t, given, t)
        _, slopes, _, weights = linear(now, cost, x, u, w)
        return slopes, weights

    return jax.vmap(at)(t, x, u, w)


def _end_weights(
    given: Controlled, controls: Callable, trajectory: Trajectory, end_cost: Callable | None
) -> np.ndarray:
    """F."""
    n, end = given.form.n, trajectory.end
    if end_cost is None:
        return np.zeros((2 * n, 2 * n))
    call = traced_call(Call("end_cost", end_cost, OF_STATE), given.state._asdict(), check_number)
    y = jnp.concatenate([coordinates.flatten(end.q)[0], coordinates.flatten(end.v)[0]])
    w = jnp.asarray(coordinates.vector(controls(end.t)))
    now = eqx.tree_at(lambda given: given.state.t, given, jnp.asarray(end.t))
    return np.asarray(_of_end(now, call, y, w)) / 2


@compiled
def _of_end(given: Controlled, cost: Callable, y: Array, w: Array) -> Float[Array, "m m"]:
    form, s, n = given.form, given.state, given.form.n

    def of_state(y: Array) -> Array:
        return cost(s.t, form.tree(y[:n]), form.tree(y[n:]), s.params)

    found = jax.hessian(of_state)(y)
    return found + bent(given, y[:n], y[n:], w, jax.grad(of_state)(y)) if form.m else found


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
        return _controls(self.controls, self.gain, self.state, q, v)

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
        return _along_trajectory(system, controls, state, cost, params, end_cost, with_control)
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
    names, tangent = _names_of_state(given), np.eye(x.size)
    if given.form.m:
        model = unchecked(given.system, given.merge(given.state.params, given.controls), given.form)
        tangent = null_space(np.asarray(compiled(constraints.jacobian)(model, given.state.t, x, u)))
    still, slopes, slope, curvature = jax.tree.map(np.asarray, linear(given, cost, x, u, w))
    size = max(1.0, float(np.max(np.abs(slopes[0]))))
    worst = int(np.argmax(np.abs(still)))
    if not abs(still[worst]) <= STEADY_BELOW * size or np.any(u):
        raise ValueError(
            f"not an equilibrium: '{names[worst]}' accelerates by {float(still[worst]):.3g} under these controls"
            f"{', and the velocities are not zero' if np.any(u) else ''}.\n"
            "Usual cause: controls of zero where a force has to hold the system.\n"
            'Fix: controls={"torque": ...} that balance the forces; lj.equilibria finds the state for given controls.'
        )
    both = block_diag(tangent, tangent)
    lift = block_diag(both, np.eye(w.size))
    if np.max(np.abs(lift.T @ slope)) > STEADY_BELOW * max(1.0, float(np.max(np.abs(curvature)))):
        raise ValueError(
            "the cost is not least at the equilibrium: its derivatives there are not zero.\n"
            "Usual cause: u**2 where the control that holds the system is not zero, or a target elsewhere.\n"
            'Fix: squares of differences from the equilibrium, (q["angle"] - jnp.pi) ** 2.'
        )
    slopes = (tangent.T @ slopes[0] @ tangent, tangent.T @ slopes[1] @ tangent, tangent.T @ slopes[2])
    about = deviations(slopes, lift.T @ curvature @ lift, coordinates.names(given.controls))
    a, b = about.a, about.b
    try:
        s = solve_continuous_are(a, b, about.q, about.r, s=about.cross)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(_unreached(a, b, both, names)) from error
    gain = about.gain(s)
    values = np.linalg.eigvals(a - b @ gain)
    if not np.max(values.real) < 0:
        raise ValueError(_unreached(a, b, both, names))
    found = map(to_jax, (gain @ both.T, both @ s @ both.T))
    return LQR(*found, values, to_jax(np.concatenate([x, u])), given.controls, names)


def _along_trajectory(system, controls, trajectory, cost, params, end_cost, with_control) -> TrackingLQR:
    """The regulator about a trajectory."""
    fix = 'controls=found.controls of lj.steer, or lambda t: {"push": ...}'
    must_be_function(controls, "controls about a trajectory", "time", fix)
    if jnp.ndim(trajectory.end.t) or not is_among(trajectory.result, ENDED_WELL):
        raise ValueError(
            "the trajectory failed, or is a batch: there is no motion to keep to.\n"
            "Fix: one motion that reaches its end."
        )
    t, q, v = trajectory.t[0], *jax.tree.map(lambda x: x[0], (trajectory.q, trajectory.v))
    given = controlled(system, controls(t), coordinates.prepared(t, q, v, params), with_control)
    return about_trajectory(given, controls, trajectory, checked_cost(cost, given), end_cost)


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
