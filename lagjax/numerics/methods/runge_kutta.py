"""Explicit Runge-Kutta methods with unrolled stages.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),    y1 = y + h sum_i b_i k_i,    error = h sum_i e_i k_i

diffrax runs the stages in a loop over a buffer of k. Here they are unrolled on the leaves of y, without terms for zero
coefficients: for a state of single numbers XLA keeps all of them in registers. The cost of a step on one coordinate is
measured in `benchmarks/accuracy/work_precision.py` and `benchmarks/speed/against_peers.py`.

The tableaus and the dense output are diffrax's.

Dense output of diffrax steps, given by the state at a time.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from equinox import AbstractClassVar
from jax import lax
from jaxtyping import Array, PyTree


class Interpolation(diffrax.AbstractLocalInterpolation):
    """A dense output given by the state `at` a time; the change over an interval is the difference of two states."""

    @abc.abstractmethod
    def at(self, t: Array):
        """The state at t."""

    def evaluate(self, t0: Array, t1: Array | None = None, left=True):
        """The state at t0, or its change from t0 to t1."""
        if t1 is None:
            return self.at(t0)
        return jtu.tree_map(lambda b, a: b - a, self.at(t1), self.at(t0))


class ExplicitRungeKutta(diffrax.AbstractAdaptiveSolver):
    """An embedded explicit method for `diffrax.diffeqsolve`, with the tableau of its subclass.

    `shipped` is diffrax's implementation of it, for vector fields that are too large to be copied into each stage.
    `in_a_loop` also compiles the vector field once for all stages, in a loop that can be differentiated in both modes.
    """

    tableau: AbstractClassVar[diffrax.ButcherTableau]
    shipped: AbstractClassVar[diffrax.AbstractERK]
    term_structure: ClassVar = diffrax.AbstractTerm

    in_a_loop: bool = eqx.field(default=False, static=True)

    def func(self, terms: diffrax.AbstractTerm, t0: Array, y0: PyTree, args: PyTree):
        """The vector field."""
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree):
        """The first stage, if the last stage of a step is the first of the next."""
        return terms.vf(t0, y0, args) if self.tableau.fsal else None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Array,
        t1: Array,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Array,
    ):
        """One step, its error and the data for the dense output."""
        tableau, control = self.tableau, terms.contr(t0, t1)
        first = solver_state
        if self.in_a_loop:
            return self._in_a_loop(terms, t0, t1, y0, args, first if made_jump is False else None)
        if first is None or made_jump is not False:
            first = terms.vf(t0, y0, args)
        increments, rate = [terms.prod(first, control)], first
        for weights, c in zip(tableau.a_lower, tableau.c):
            # Exactly t1, since the last stage must be at the same time as the first stage of the next step.
            t = t1 if c == 1 else t0 + float(c) * (t1 - t0)
            rate = terms.vf(t, weighted_sum(y0, weights, increments), args)
            increments.append(terms.prod(rate, control))
        y1 = weighted_sum(y0, tableau.b_sol, increments)
        error = weighted_sum(None, tableau.b_error, increments)
        stages = jtu.tree_map(lambda *k: jnp.stack(k), *increments)
        return y1, error, {"y0": y0, "y1": y1, "k": stages}, rate if tableau.fsal else None, diffrax.RESULTS.successful

    def _in_a_loop(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree, first: PyTree):
        """Like `step`, with the vector field compiled once; the loop includes the first stage unless it is given."""
        tableau, control, count = self.tableau, terms.contr(t0, t1), len(self.tableau.b_sol)
        rows = np.zeros((count, count))
        for i, row in enumerate(tableau.a_lower, start=1):
            rows[i, :i] = row
        nodes, rows = jnp.asarray(np.append(0.0, tableau.c), jnp.result_type(t0)), jnp.asarray(rows)

        def by(weights: Any, ks: PyTree) -> PyTree:
            return jtu.tree_map(lambda k: jnp.tensordot(weights.astype(k.dtype), k, 1), ks)

        def stage(i: Array, ks):
            t = jnp.where(nodes[i] == 1, t1, t0 + nodes[i] * (t1 - t0))
            y = jtu.tree_map(jnp.add, y0, terms.prod(by(rows[i], ks), control))
            return jtu.tree_map(lambda ks, k: ks.at[i].set(k), ks, terms.vf(t, y, args))

        ks = jtu.tree_map(lambda y: jnp.zeros((count, *jnp.shape(y)), jnp.result_type(y)), y0)
        if first is not None:
            ks = jtu.tree_map(lambda ks, k: ks.at[0].set(k), ks, first)
        ks = lax.fori_loop(0 if first is None else 1, count, stage, ks)

        def of(weights: Any) -> PyTree:
            return terms.prod(by(jnp.asarray(np.asarray(weights)), ks), control)

        y1 = jtu.tree_map(jnp.add, y0, of(tableau.b_sol))
        last = jtu.tree_map(lambda k: k[-1], ks) if tableau.fsal else None
        dense = {"y0": y0, "y1": y1, "k": terms.prod(ks, control)}
        return y1, of(tableau.b_error), dense, last, diffrax.RESULTS.successful


def weighted_sum(start: PyTree, weights: Array, increments):
    """`start + sum_i weights_i increments_i`, leaf by leaf."""
    chosen = [(w, k) for w, k in zip(weights, increments) if w != 0]

    def of_leaves(*leaves):
        # lax instead of jnp, which takes three times as long to trace.
        terms = [lax.mul(k, lax.full_like(k, w)) for (w, _), k in zip(chosen, leaves)]
        return functools.reduce(lax.add, terms)

    total = jtu.tree_map(of_leaves, *(k for _, k in chosen))
    return total if start is None else jtu.tree_map(lax.add, start, total)


# With a stage at the end of the step, which is the first one of the next step.
KUTTA = diffrax.ButcherTableau(
    c=np.array([1 / 2, 1 / 2, 1, 1]),
    b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6, 0]),
    b_error=np.array([0, 0, 0, 1 / 6, -1 / 6]),
    a_lower=(np.array([1 / 2]), np.array([0, 1 / 2]), np.array([0, 0, 1.0]), np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])),
)


class _KuttaInArrays(diffrax.AbstractERK):
    """Kutta's method as diffrax steps it."""

    tableau: ClassVar = KUTTA
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: diffrax.AbstractTerm):
        return 4


class RK4(ExplicitRungeKutta):
    """Kutta's method of order 4, "the" Runge-Kutta method: four evaluations per step.

    The default of `lj.step` and `lj.rollout`. With the rate of change k₅ at the end of a step, which the next step
    begins with, `k₁/6 + k₂/3 + k₃/3 + k₅/6` is of order 3, so that `h (k₄ - k₅)/6` estimates the error.

    >>> import diffrax
    >>> growth = diffrax.ODETerm(lambda t, y, args: y)
    >>> print(RK4().step(growth, 0.0, 1.0, 24.0, None, None, True)[0])  # 24 (1 + 1 + 1/2 + 1/6 + 1/24)
    65.0

    Source: Kutta, Z. Math. Phys. 46 (1901) 435; Hairer, Nørsett & Wanner, *Solving ODEs I*, Table II.1.2, and the
    conditions of order 3, Eq. (II.1.11).
    """

    shipped: ClassVar = _KuttaInArrays()
    tableau: ClassVar = KUTTA
    interpolation_cls: ClassVar[Callable] = _KuttaInArrays.interpolation_cls

    def order(self, terms: diffrax.AbstractTerm):
        """4."""
        return 4


class Tsit5(ExplicitRungeKutta):
    """Tsitouras' method of order 5, with an embedded one of order 4: six evaluations per step.

    >>> import diffrax
    >>> decay = diffrax.ODETerm(lambda t, y, args: -y)
    >>> controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    >>> solution = diffrax.diffeqsolve(decay, Tsit5(), 0.0, 1.0, None, 1.0, stepsize_controller=controller)
    >>> print(solution.ys.round(5))
    [0.36788]

    Source: Tsitouras, Comput. Math. Appl. 62 (2011) 770.
    """

    shipped: ClassVar = diffrax.Tsit5()
    tableau: ClassVar = diffrax.Tsit5.tableau
    interpolation_cls: ClassVar[Callable] = diffrax.Tsit5.interpolation_cls

    def order(self, terms: diffrax.AbstractTerm):
        """5."""
        return 5


class Dopri8(ExplicitRungeKutta):
    """Prince and Dormand's method of order 8, with an embedded one of order 7: thirteen evaluations per step.

    The default of `lj.integrate`; in `diffrax.diffeqsolve` it is used like `Tsit5`.

    >>> method = Dopri8()
    >>> print(method.order(None), method.error_order(None))
    8 8

    Source: Prince & Dormand, J. Comput. Appl. Math. 7 (1981) 67, RK8(7)13M.
    """

    shipped: ClassVar = diffrax.Dopri8()
    tableau: ClassVar = diffrax.Dopri8.tableau
    interpolation_cls: ClassVar[Callable] = diffrax.Dopri8.interpolation_cls

    def order(self, terms: diffrax.AbstractTerm):
        """8."""
        return 8


def in_our_form(method: diffrax.AbstractSolver) -> ExplicitRungeKutta | None:
    """The class here for one of diffrax's methods with default options; None for all others.

    >>> import diffrax
    >>> type(in_our_form(diffrax.Tsit5())) is Tsit5, in_our_form(diffrax.Heun())
    (True, None)
    """
    return next((kind() for kind in (Tsit5, Dopri8) if eqx.tree_equal(kind.shipped, method) is True), None)
