"""The linear-quadratic regulator about a trajectory: the feedback that brings a motion back to it at the least cost.

With δx = (δq, δv) and δu about a motion x₀(t) under controls u₀(t), and A, B, Q, R, N along it as in `regulator.py`,
the least of ∫ δxᵀ Q δx + δuᵀ R δu + 2 δxᵀ N δu dt + δx_bᵀ F δx_b from δx on is δxᵀ S(t) δx, by

    δu = -K δx,    K = R⁻¹ (Bᵀ S + Nᵀ),    -Ṡ = Aᵀ S + S A - (S B + N) R⁻¹ (Bᵀ S + Nᵀ) + Q,    S(t_b) = F

S = Y X⁻¹ for solutions of Hamilton's equations of the deviations, which are linear:

    Ẋ = (A - B R⁻¹ Nᵀ) X - B R⁻¹ Bᵀ Y,    Ẏ = -(Q - N R⁻¹ Nᵀ) X - (A - B R⁻¹ Nᵀ)ᵀ Y

They are solved by Gauss's collocation, of order 2s for s points, from each element's end, X = 1, Y = S, to its start.
What constraints allow is kept by the accelerations that A and B are derivatives of, and so the other directions do not
enter; the weights have what a deviation bends by on them (`linear_quadratic.py`).

Source: Kwakernaak & Sivan, *Linear Optimal Control Systems*, §3.3; Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, §II.1.3 (Gauss's collocation).
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.integrate import Trajectory
from lagjax.jaxtools import compiled
from lagjax.system import OF_STATE, Call, coordinates, traced_call
from lagjax.two_points.elements import Rule, integrals, rule_of_degree
from lagjax.two_points.linear_quadratic import bent, check_weights, linear
from lagjax.two_points.plan import Plan, plan_of
from lagjax.two_points.question import Controlled, check_number, velocity_name

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
        along, (held, back) = self.pieces(t), ravel_pytree(jax.tree.map(jnp.asarray, self.controls(t)))
        x = jnp.concatenate([coordinates.flatten(q)[0], coordinates.flatten(v)[0]])
        return back(held - along["gain"] @ (x - along["state"]))

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
    names = coordinates.names(given.state.q)
    names = (*names, *(velocity_name(name) for name in names))
    end = _end_weights(given, controls, trajectory, end_cost)
    first, last = float(trajectory.t[0]), float(trajectory.end.t)
    knots = np.unique(np.clip([first, *np.asarray(getattr(controls, "knots", ())), last], first, last))
    knots = _divided(knots, max(1, -(-FIRST // (len(knots) - 1))))
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
            return TrackingLQR(pieces, controls, jnp.asarray(s), change, names)
        before, knots = s, _divided(knots, 2)


def _divided(knots: np.ndarray, parts: int) -> np.ndarray:
    inner = knots[:-1, None] + np.diff(knots)[:, None] * np.arange(parts) / parts
    return np.append(inner.ravel(), knots[-1])


def _regulated(given: Controlled, controls: Callable, trajectory: Trajectory, cost: Callable, knots: np.ndarray, end):
    """K and x₀ on elements between knots, and S at the start."""
    rule, h = rule_of_degree(POINTS), np.diff(knots)
    t = knots[:-1, None] + h[:, None] * rule.points
    x, u = _together(partial(_states, trajectory), t.ravel())
    w = np.stack([coordinates.vector(controls(t)) for t in t.ravel()])
    a, b, weights = _along(given, cost, t.ravel(), x, u, w)
    k, m = w.shape[1], 2 * x.shape[1]
    q, cross, r = weights[:, :m, :m], weights[:, :m, m:], weights[:, m:, m:]
    for matrix in r:
        check_weights(matrix, coordinates.names(given.controls))
    left = np.linalg.solve(r, np.concatenate([cross.transpose(0, 2, 1), b.transpose(0, 2, 1)], axis=2))
    by_cross, by_b = left[..., :m], left[..., m:]
    a_less = a - b @ by_cross
    hamiltonian = np.block([[a_less, -b @ by_b], [-(q - cross @ by_cross), -a_less.transpose(0, 2, 1)]])
    hamiltonian = hamiltonian.reshape(len(h), POINTS, 2 * m, 2 * m)
    gains, s = np.empty((len(h), POINTS, k, m)), end
    for e in reversed(range(len(h))):
        at_points, start = _back(rule, h[e], hamiltonian[e], np.concatenate([np.eye(m), s]))
        inside = np.linalg.solve(at_points[:, :m].transpose(0, 2, 1), at_points[:, m:].transpose(0, 2, 1))
        gains[e] = by_b.reshape(len(h), POINTS, k, m)[e] @ inside + by_cross.reshape(len(h), POINTS, k, m)[e]
        s = np.linalg.solve(start[:m].T, start[m:].T)
        s = (s + s.T) / 2
    example = {"gain": np.zeros((k, m)), "state": np.zeros(m)}
    rows = np.concatenate([gains.reshape(len(h), POINTS, -1), np.concatenate([x, u], 1).reshape(len(h), POINTS, -1)], 2)
    limits = np.full((2, rows.shape[2]), np.inf) * np.array([[-1.0], [1.0]])
    return plan_of(knots, rows, limits, example, rule.points, len(h)), s


def _back(rule: Rule, h: float, matrices: np.ndarray, end: np.ndarray):
    """The solution of ẏ = H y at Gauss's points and at the start, from the end of an element."""
    size = end.shape[0]
    # y_i = y_b - h Σ_j (∫_{c_i}^{1} l_j) ẏ_j, and ẏ_j = H_j y_j.
    reach = -integrals(rule.points, np.ones(POINTS))
    system = np.eye(len(reach) * size) + h * np.einsum("ij,jab->iajb", reach, matrices).reshape(
        (len(reach) * size,) * 2
    )
    inside = np.linalg.solve(system, np.tile(end, (len(reach), 1))).reshape(len(reach), size, -1)
    return inside, end - h * np.einsum("j,jab,jbc->ac", rule.weights, matrices, inside)


def _together(function: Callable, *arrays: np.ndarray):
    """A function of many points, some at a time: one program serves any number of them."""
    count, found = len(arrays[0]), []
    for i in range(0, count, TOGETHER):
        more = max(0, i + TOGETHER - count)
        part = (np.concatenate([x[i : i + TOGETHER], np.repeat(x[-1:], more, axis=0)]) for x in arrays)
        found.append(jax.tree.map(np.asarray, function(*part)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *found)


def _states(trajectory: Trajectory, t: np.ndarray) -> list[np.ndarray]:
    now = trajectory.at(t)
    return [np.concatenate([np.reshape(y, (len(t), -1)) for y in jax.tree.leaves(x)], axis=1) for x in (now.q, now.v)]


def _along(given: Controlled, cost: Callable, *states: np.ndarray):
    """A (T, 2n, 2n), B (T, 2n, k) and the halves of the cost's second derivatives at times (T,) and states."""
    (by_q, by_v, by_w), weights = _together(partial(_derivatives, given, cost), *states)
    count, n = by_q.shape[:2]
    upper = np.broadcast_to(np.concatenate([np.zeros((n, n)), np.eye(n)], axis=1), (count, n, 2 * n))
    a = np.concatenate([upper, np.concatenate([by_q, by_v], axis=2)], axis=1)
    return a, np.concatenate([np.zeros_like(by_w), by_w], axis=1), weights / 2


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
