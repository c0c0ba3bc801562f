"""Symplectic methods in equal steps: Gauss' collocation, and splitting into drifts and kicks.

Gauss' collocation as the integrator that an action gives.

In a step the path is a polynomial of degree s, through q0, whose action by Gauss' quadrature, with s nodes, is
stationary. With a_ij = ∫_0^{c_i} ℓ_j and the momenta P_i = ∂L/∂v (Q_i, V_i):

    Q_i = q0 + h Σ a_ij V_j        q1 = q0 + h Σ b_j V_j
    P_i = p0 + h Σ a_ij F_j        p1 = p0 + h Σ b_j F_j        F_j = ∂L/∂q (Q_j, V_j) + other forces

Where positions are constrained, the action gets Σ b̃_j λ_j g(Q̃_j) by Lobatto's quadrature with s + 1 nodes, c̃_0 = 0
to c̃_s = 1, so that g = 0 holds at the ends of each step:

    Q̃_i = q0 + h Σ ā_ij V_j        P_i gets h Σ ã_ij Aᵀ(Q̃_j) λ_j        ã_ij = b̃_j (1 - ā_ji / b_i)

It is symplectic since b_i a_ij + b_j a_ji = b_i b_j, which rounded coefficients do not satisfy: energy would drift. So
steps are computed from h b_j V_j, h b_j F_j and h b̃_j λ_j with a_ij / b_j = μ_ij, where μ_ij + μ_ji = 1 to the last
digit, and with ā_ij / b_j = ν_ij in both places.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §II.1.3, §VI.6 (Thm. 6.1); Jay, SIAM J. Numer. Anal.
45 (2007) 1814 (constraints at Lobatto's nodes: the (s, s)-Gauss-Lobatto SPARK methods); Antonana, Makazaga & Murua,
Numer. Algorithms 76 (2017) 861 (μ).

Explicit symplectic methods: the motion is split into drifts, x += a h v, and kicks, v += b h F(x)/M.

    order 2     Störmer and Verlet
    order 4, 6  Runge-Kutta-Nyström splittings with 6 and 11 kicks per step, made for F that does not depend on v
    order 8     17 steps of order 2 after each other

Each is symmetric, begins and ends with a kick, whose force serves two steps. The cost is that of its kicks. With
constraints on positions a step of order 2 is one of RATTLE, and those of higher orders are 5, 9 and 17 of these.

Source: Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313, Table 3 (orders 4 and 6); Kahan & Li, Math. Comput. 66
(1997) 1089, s17odr8a (order 8) and s9odr6a (order 6 with constraints); Suzuki, Phys. Lett. A 146 (1990) 319 (order 4
with constraints).
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from numpy.polynomial import Polynomial, legendre

from lagjax.refusals import must_be_among, must_be_function, must_be_whole

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
    fix = f"lj.{type(method).__name__}(pace=lambda t, q, params: jnp.sum(q**2) ** 0.75)"
    cause = "a length, which is dt0 of lj.integrate"
    must_be_function(method.pace, "pace", "(t, q, params)", fix, cause, optional=True)


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
        must_be_whole(self.stages, "stages", most=MOST_STAGES, fix="lj.Gauss(3) for order 6: it is twice the stages")

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


# The first coefficients, kicks and drifts; the others follow from symmetry, those in the middle from their sums, 1.
KICKS = {
    2: (),
    4: (0.0829844064174052, 0.396309801498368, -0.0390563049223486),
    6: (
        0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879
    ),
}  # fmt: skip
DRIFTS = {
    2: (),
    4: (0.245298957184271, 0.604872665711080),
    6: (
        0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928
    ),
}  # fmt: skip
# The first lengths of steps of order 2 after each other.
SIX = (
    0.39216144400731413927925056, 0.33259913678935943859974864, -0.70624617255763935980996482,
    0.08221359629355080023149045,
)  # fmt: skip
EIGHT = (
    0.13020248308889008087881763, 0.56116298177510838456196441, -0.38947496264484728640807860,
    0.15884190655515560089621075, -0.39590389413323757733623154, 0.18453964097831570709183254,
    0.25837438768632204729397911, 0.29501172360931029887096624,
)  # fmt: skip
ORDERS = 2, 4, 6, 8


class Splitting(EqualSteps):
    """An explicit symplectic method of order 2, 4, 6 or 8, for L = T(v) - V(q) with a constant mass matrix, also with
    constraints on positions.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> kepler = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + 1.0 / jnp.sqrt(jnp.sum(q**2)))
    >>> ts = 2 * jnp.pi * jnp.arange(0.0, 101.0, 10.0)
    >>> start = jnp.array([0.8, 0.0]), jnp.array([0.0, 1.5**0.5])
    >>> traj = lj.integrate(kepler, *start, ts=ts, method=Splitting(6), dt0=0.1)
    >>> print(bool(jnp.max(jnp.abs(traj.jacobi_integral() + 0.5)) < 1e-6))
    True

    It keeps the energy to about the error of one step, however long the motion is, and momenta of linear symmetries to
    round-off. `dt0` is the length of its steps, as for `lj.Gauss`. Forces and
    constraints may depend on time. With constraints a step consists of steps of RATTLE; they hold at the ends of all
    steps to round-off, and may depend on each other.

    **Arguments:** `order`: 2, 4, 6 or 8, with 1, 6, 11 or 17 forces per step, and with constraints 1, 5, 9 or 17;
    `pace`: as for `lj.Gauss`.

    Source: Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313; Kahan & Li, Math. Comput. 66 (1997) 1089; Andersen,
    J. Comput. Phys. 52 (1983) 24 (RATTLE).
    """

    order: int = eqx.field(static=True, default=4)
    pace: Callable | None = None

    @property
    def label(self) -> str:
        return f"Splitting({self.order}{', pace' if self.pace else ''})"

    def __check_init__(self):
        check_pace(self)
        must_be_among(ORDERS, self.order, "order", "lj.Splitting(4)")

    def error_order(self, terms: Any = None) -> int:
        """The order."""
        return self.order


class Sequence(NamedTuple):
    """What a step is made of: a kick, a drift, a kick, ..., a kick."""

    kicks: np.ndarray
    drifts: np.ndarray


def lengths(order: int) -> np.ndarray:
    """The lengths of symmetric steps of order 2, as parts of a step, that are of this order after each other.

    >>> [len(lengths(order)) for order in ORDERS], abs(float((lengths(6) ** 3).sum())) < 1e-15
    ([1, 5, 9, 17], True)
    """
    suzuki = 1 / (4 - 4 ** (1 / 3))
    first = {2: (), 4: (suzuki, suzuki), 6: SIX, 8: EIGHT}[order]
    return np.array([*first, 1 - 2 * sum(first), *first[::-1]])


def sequence(order: int) -> Sequence:
    """The kicks and drifts of a step.

    >>> [(len(x.kicks), float(x.kicks.sum().round(12)), float(x.drifts.sum().round(12))) for x in map(sequence, ORDERS)]
    [(2, 1.0, 1.0), (7, 1.0, 1.0), (12, 1.0, 1.0), (18, 1.0, 1.0)]
    """
    if order == 8:
        drifts = lengths(8)
        return Sequence((np.append(0.0, drifts) + np.append(drifts, 0.0)) / 2, drifts)
    kicks, drifts = KICKS[order], DRIFTS[order]
    if len(kicks) > len(drifts):
        # A kick in the middle.
        middle = 1 - 2 * sum(kicks)
        drift = 0.5 - sum(drifts)
        return Sequence(
            np.array([*kicks, middle, *kicks[::-1]]), np.array([*drifts, drift, drift, *drifts[::-1]])
        )  # fmt: skip
    kick, drift = 0.5 - sum(kicks), 1 - 2 * sum(drifts)
    return Sequence(np.array([*kicks, kick, kick, *kicks[::-1]]), np.array([*drifts, drift, *drifts[::-1]]))
