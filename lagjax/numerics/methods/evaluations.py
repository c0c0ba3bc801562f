"""The cost of a step of a method."""

import diffrax

from lagjax.numerics.methods.nystrom import Nystrom
from lagjax.numerics.methods.runge_kutta import ExplicitRungeKutta


def evaluations_a_step(method: diffrax.AbstractSolver) -> int | None:
    """How often a step evaluates the accelerations, counting a shared last stage once; None for implicit methods.

    >>> import lagjax as lj
    >>> [evaluations_a_step(method) for method in (lj.Dopri8(), lj.Tsit5(), lj.Radau5())]
    [13, 6, None]
    """
    if isinstance(method, Nystrom):
        return len(method.tableau.c) - 1
    tableau = getattr(method, "tableau", None)
    explicit = isinstance(method, (ExplicitRungeKutta, diffrax.AbstractERK))
    if explicit and isinstance(tableau, diffrax.ButcherTableau):
        return tableau.num_stages - bool(tableau.fsal)
    return None
