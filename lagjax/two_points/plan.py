"""Controls as functions of time, and a system that follows them.

A plan is a polynomial on each element, held, linear or through the values at Gauss's points, and stays between its
bounds. It travels in the parameters, so that the steered motion is one of a system like any other, which can be
integrated, differentiated and swept.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.system import System, coordinates, takes_of
from lagjax.two_points.transcription import through


class Plan(eqx.Module):
    """Controls as functions of time: `plan(t)` is a control in the user's structure.

    - `starts` (M,): when each element begins, `[t]`, infinite beyond the last one, so that one program serves plans of
      different lengths. `widths` (M,): how long elements are.
    - `rows` (M, r, n): the controls at `nodes`, parts of an element.
    - `low`, `high` (n,): bounds, at which a polynomial is cut off where it leaves them between its points.
    """

    starts: Float[Array, " M"]
    widths: Float[Array, " M"]
    rows: Float[Array, "M r n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    example: PyTree
    nodes: tuple[float, ...] = eqx.field(static=True)
    cut_off: bool = eqx.field(static=True)

    @property
    def knots(self) -> np.ndarray:
        """The times between which a control is one polynomial, `[t]`."""
        starts = np.asarray(self.starts)
        last = int(np.sum(np.isfinite(starts))) - 1
        return np.append(starts[: last + 1], starts[last] + np.asarray(self.widths)[last])

    def __call__(self, t: ArrayLike) -> PyTree:
        t = jnp.asarray(t, self.starts.dtype)
        place = jnp.searchsorted(self.starts[1:], t, side="right")
        u = lagrange(self.nodes, (t - self.starts[place]) / self.widths[place]) @ self.rows[place]
        return coordinates.like(self.example, jnp.clip(u, self.low, self.high) if self.cut_off else u)

    def at(self, t: ArrayLike) -> np.ndarray:
        """The controls at times (T,), as vectors (T, n)."""
        t, starts = np.asarray(t), np.asarray(self.starts)
        place = np.searchsorted(starts[1:], t, side="right")
        part = (t - starts[place]) / np.asarray(self.widths)[place]
        u = np.einsum("tr,trn->tn", through(np.array(self.nodes), part), np.asarray(self.rows)[place])
        return np.clip(u, self.low, self.high) if self.cut_off else u


def plan_of(knots: np.ndarray, rows: np.ndarray, limits: np.ndarray, example: PyTree, nodes: np.ndarray, room: int):
    """The plan with these knots (K + 1,) and rows (K, r, n) between `limits` (2, n), filled up to `room` elements."""
    more = room - len(rows)
    starts = np.append(knots[:-1], np.full(more, np.inf))
    widths, rows = np.append(np.diff(knots), np.ones(more)), np.concatenate([rows, np.zeros((more, *rows.shape[1:]))])
    # What is linear or constant between its bounds stays there.
    cut_off = len(nodes) > 2 and bool(np.any(np.isfinite(limits)))
    return Plan(*map(jnp.asarray, (starts, widths, rows, *limits)), example, tuple(nodes.tolist()), cut_off)


def lagrange(nodes: tuple[float, ...], x: Array) -> Float[Array, " r"]:
    """The values at x of the polynomials that are one at one of the nodes and zero at the others.

    >>> lagrange((0.0, 1.0), jnp.asarray(0.25))
    Array([0.75, 0.25], dtype=float64)
    """
    values = []
    for i, node in enumerate(nodes):
        others = [(x - other) / (node - other) for j, other in enumerate(nodes) if j != i]
        values.append(jnp.prod(jnp.stack(others)) if others else jnp.ones_like(x))
    return jnp.stack(values)


class Planned(eqx.Module):
    """The parameters of a system that follows a plan."""

    params: PyTree
    plan: Plan

    def controlled(self, t: Array, merge: Callable) -> PyTree:
        """The user's parameters with the controls at a time."""
        return merge(self.params, self.plan(t))


class Follows(eqx.Module):
    """One of the user's functions, whose controls follow the plan in its parameters."""

    function: Callable
    merge: Callable = eqx.field(static=True)

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, *arguments):
        *state, planned = arguments
        return self.function(*state, planned.controlled(state[0], self.merge))


def following(system: System, merge: Callable) -> System:
    """The system as a function of `Planned` in place of its parameters."""
    return system.map(lambda function, role: Follows(function, merge))
