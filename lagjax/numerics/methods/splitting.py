"""Explicit symplectic methods: the motion is split into drifts, x += a h v, and kicks, v += b h F(x)/M.

    order 2     Störmer and Verlet
    order 4, 6  Runge-Kutta-Nyström splittings with 6 and 11 kicks per step, made for F that does not depend on v
    order 8     17 steps of order 2 after each other

Each is symmetric, begins and ends with a kick, whose force serves two steps. The cost is that of its kicks. With
constraints on positions a step of order 2 is one of RATTLE, and those of higher orders are 5, 9 and 17 of these.

Source: Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313, Table 3 (orders 4 and 6); Kahan & Li, Math. Comput. 66
(1997) 1089, s17odr8a (order 8) and s9odr6a (order 6 with constraints); Suzuki, Phys. Lett. A 146 (1990) 319 (order 4
with constraints).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from lagjax.numerics.methods.gauss import EqualSteps, check_pace

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
        if self.order not in ORDERS:
            raise ValueError(f"order must be one of {ORDERS}, not {self.order!r}.\nFix: lj.Splitting(4).")

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
