"""Gauss' collocation as the integrator that an action gives.

In a step the path is a polynomial of degree s, through q0, whose action by Gauss' quadrature, with s nodes, is
stationary. With a_ij = ∫_0^{c_i} ℓ_j and the momenta P_i = ∂L/∂v (Q_i, V_i):

    Q_i = q0 + h Σ a_ij V_j        q1 = q0 + h Σ b_j V_j
    P_i = p0 + h Σ a_ij F_j        p1 = p0 + h Σ b_j F_j        F_j = ∂L/∂q (Q_j, V_j) + other forces

Where positions are constrained, the action gets Σ b̃_j λ_j g(Q̃_j) by Lobatto's quadrature with s + 1 nodes, c̃_0 = 0 to
c̃_s = 1, so that g = 0 holds at the ends of each step:

    Q̃_i = q0 + h Σ ā_ij V_j        P_i gets h Σ ã_ij Aᵀ(Q̃_j) λ_j        ã_ij = b̃_j (1 - ā_ji / b_i)

It is symplectic since b_i a_ij + b_j a_ji = b_i b_j, which rounded coefficients do not satisfy: energy would drift. So
steps are computed from h b_j V_j, h b_j F_j and h b̃_j λ_j with a_ij / b_j = μ_ij, where μ_ij + μ_ji = 1 to the last
digit, and with ā_ij / b_j = ν_ij in both places.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §II.1.3, §VI.6 (Thm. 6.1); Jay, SIAM J. Numer. Anal.
45 (2007) 1814 (constraints at Lobatto's nodes: the (s, s)-Gauss-Lobatto SPARK methods); Antonana, Makazaga & Murua,
Numer. Algorithms 76 (2017) 861 (μ).
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from numpy.polynomial import Polynomial, legendre

# With more stages the coefficients of Lagrange's polynomials lose digits.
MOST_STAGES = 8


class EqualSteps(eqx.Module):
    """A method that makes steps of equal length, or of one that follows a pace, and keeps what only such steps keep."""

    pace: eqx.AbstractVar[Callable | None]

    @property
    def label(self) -> str:
        """What is printed for it."""
        return type(self).__name__

    def __repr__(self):
        return self.label


def check_pace(method: EqualSteps):
    """Raise unless the pace is None or a function."""
    if method.pace is not None and not callable(method.pace):
        raise TypeError(
            f"pace must be a function of (t, q, params), not {type(method.pace).__name__}.\n"
            "Usual cause: a length, which is dt0 of lj.integrate.\n"
            f"Fix: lj.{type(method).__name__}(pace=lambda t, q, params: jnp.sum(q**2) ** 0.75)."
        )


class Gauss(EqualSteps):
    """The variational integrator of order 2 `stages` from the action of L itself, by Gauss' quadrature.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
    >>> ts = jnp.linspace(0.0, 1000.0, 11)
    >>> traj = lj.integrate(pendulum, 1.0, 0.0, ts=ts, method=Gauss(3), dt0=0.1)
    >>> print(bool(jnp.max(jnp.abs(traj.jacobi_integral() - traj.jacobi_integral()[0])) < 1e-7))
    True

    It is symplectic and symmetric, keeps momenta of symmetries that are linear or quadratic, and the energy to about
    the error of one step, however long the motion is. `dt0` is the length of its steps; those between two outputs are
    equally long, the fewest that are no longer than `dt0`. Constraints on positions hold at the ends of all steps to
    round-off; forces, dissipation and velocity constraints act by the principle of Lagrange and d'Alembert.

    **Arguments:**

    - `stages`: 1 to 8.
    - `newton`: False solves a step by iteration with the mass matrix at its start, which fails where the fastest
      oscillation turns by more than about two radians in a step. True takes Newton's method, for stiff springs: a step
      costs several times as much, and may be of any length.
    - `pace`: None for steps of equal length; or `pace(t, q, params)`, a positive number that says by what to multiply
      `dt0` where the motion is, as r^(3/2) on an eccentric orbit. Steps follow it so that a motion backward makes the
      same ones (Hairer & Söderlind), and energy stays where it was; outputs then do not change the steps. What a pace
      closes over is not differentiated: what it takes from `params` is.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §VI.6; Hairer & Söderlind, SIAM J. Sci. Comput.
    26 (2005) 1838 (pace).
    """

    stages: int = eqx.field(static=True, default=3)
    newton: bool = eqx.field(static=True, default=False)
    pace: Callable | None = None

    @property
    def label(self) -> str:
        return f"Gauss({self.stages}{', newton' if self.newton else ''}{', pace' if self.pace else ''})"

    def __check_init__(self):
        check_pace(self)
        if not (isinstance(self.stages, int) and 1 <= self.stages <= MOST_STAGES):
            raise ValueError(
                f"stages must be a whole number from 1 to {MOST_STAGES}, not {self.stages!r}: the order is twice "
                "that.\nFix: lj.Gauss(3) for order 6."
            )

    def error_order(self, terms: Any = None) -> int:
        """The order."""
        return 2 * self.stages


class Tableau(NamedTuple):
    """The coefficients of the method with s stages, as in the text above.

    `nodes`, `weights` (s,): c, b; `mixed` (s, s): μ; `lobatto_nodes`, `lobatto_weights` (s + 1,): c̃, b̃; `to_nodes`
    (s + 1, s): ν. From values at the nodes of a step, `ahead` (s, s) leads to those of the polynomial through them at
    the nodes of the next step, `at_end` (s,) to that at its end, and `to_middle` (s,) from velocities to half the way;
    `ahead_of_two` (s, 2 s) is `ahead` from two steps.
    """

    nodes: np.ndarray
    weights: np.ndarray
    mixed: np.ndarray
    lobatto_nodes: np.ndarray
    lobatto_weights: np.ndarray
    to_nodes: np.ndarray
    ahead: np.ndarray
    ahead_of_two: np.ndarray
    at_end: np.ndarray
    to_middle: np.ndarray

    @property
    def inner(self) -> np.ndarray:
        """a."""
        return self.mixed * self.weights

    @property
    def inner_to_nodes(self) -> np.ndarray:
        """ā at the nodes after the first, (s, s)."""
        return self.to_nodes[1:] * self.weights

    @property
    def of_forces(self) -> np.ndarray:
        """ã of the nodes before the last, (s, s)."""
        return (1 - self.to_nodes[:-1].T) * self.lobatto_weights[:-1]


@cache
def tableau(stages: int) -> Tableau:
    """The coefficients.

    >>> print(tableau(1).inner, tableau(1).lobatto_weights)
    [[0.5]] [0.5 0.5]
    """
    x, w = legendre.leggauss(stages)
    nodes, weights = (x + 1) / 2, w / 2
    last = legendre.Legendre.basis(stages)
    ends = np.concatenate([[-1.0], np.sort(np.real(last.deriv().roots())), [1.0]])
    lobatto = (ends + 1) / 2
    basis, both = [_lagrange(nodes, j) for j in range(stages)], np.concatenate([nodes - 1, nodes])
    integrals = [ell.integ(lbnd=0.0) for ell in basis]
    mixed = np.stack([p(nodes) for p in integrals], axis=1) / weights
    lower = np.tril_indices(stages, -1)
    mixed[lower] = 1 - mixed.T[lower]
    np.fill_diagonal(mixed, 0.5)
    return Tableau(
        nodes, weights, mixed, lobatto, 1 / (stages * (stages + 1) * last(ends) ** 2),
        to_nodes=np.stack([p(lobatto) for p in integrals], axis=1) / weights,
        ahead=np.stack([ell(1 + nodes) for ell in basis], axis=1),
        ahead_of_two=np.stack([_lagrange(both, j)(1 + nodes) for j in range(2 * stages)], axis=1),
        at_end=np.array([ell(1.0) for ell in basis]), to_middle=np.array([p(0.5) for p in integrals]),
    )  # fmt: skip


def _lagrange(nodes: np.ndarray, j: int) -> Polynomial:
    others = np.delete(nodes, j)
    return math.prod((Polynomial([-x, 1.0]) for x in others), start=Polynomial([1.0])) / np.prod(nodes[j] - others)
