"""Explicit Runge-Kutta methods, and Nyström's for accelerations that do not depend on the velocities.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),    y1 = y + h sum_i b_i k_i,    error = h sum_i e_i k_i

diffrax runs the stages in a loop over a buffer of k. Here they are unrolled on the leaves of y, without terms for zero
coefficients: for a state of single numbers XLA keeps all of them in registers. The cost of a step on one coordinate is
measured in `benchmarks/accuracy/work_precision.py` and `benchmarks/speed/against_peers.py`.

The tableaus and the dense output are diffrax's.

Dense output of diffrax steps, given by the state at a time.

Runge-Kutta-Nyström methods: for accelerations that do not depend on the velocities.

    k_i = a(t + c_i h, q + c_i h v + h² sum_j a_ij k_j)
    q1 = q + h v + h² sum_i b_i k_i,    v1 = v + h sum_i b'_i k_i

A stage needs no velocity, so fewer stages are needed for an order than for a general system: nine for order 8, of which
the last is the first of the next step, compared with thirteen in Prince and Dormand's method. On a bead and on a
pendulum, at equal error, these methods take a half to a third of its evaluations.

Source: Dormand, El-Mikkawy & Prince, *High-order embedded Runge-Kutta-Nyström formulae*, IMA J. Numer. Anal. 7 (1987)
423: RKN8(6)9FM and RKN12(10)17M.

The cost of a step of a method.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

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


class NystromTableau(NamedTuple):
    """The coefficients of a method, for s stages: nodes, rows of `a` from the second stage on, and weights.

    `embedded_...` are the weights of the method of lower order; the difference of both results is the error estimate.
    """

    c: tuple[float, ...]
    a: tuple[tuple[float, ...], ...]
    b_position: tuple[float, ...]
    b_velocity: tuple[float, ...]
    embedded_position: tuple[float, ...]
    embedded_velocity: tuple[float, ...]


class Nystrom(diffrax.AbstractAdaptiveSolver):
    """An embedded method for `diffrax.diffeqsolve`, with the tableau of its subclass.

    The state is a pair (q, v) of pytrees of the same structure. The vector field returns (v, a), where a must not
    depend on v: `lj.integrate` checks this, it is not checked here. `in_a_loop` compiles the vector field once for all
    stages, which suits large ones; otherwise it is copied into each stage.
    """

    tableau: AbstractClassVar[NystromTableau]
    highest: AbstractClassVar[int]
    embedded: AbstractClassVar[int]
    term_structure: ClassVar = diffrax.AbstractTerm

    in_a_loop: bool = eqx.field(default=False, static=True)

    @property
    def interpolation_cls(self) -> Callable:
        """The dense output."""
        return Quintic

    def order(self, terms: diffrax.AbstractTerm):
        """The order of the accepted solution."""
        return self.highest

    def error_order(self, terms: diffrax.AbstractTerm):
        """One more than the order of the embedded method."""
        return self.embedded + 1

    def func(self, terms: diffrax.AbstractTerm, t0: Array, y0: PyTree, args: PyTree):
        """The vector field."""
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree):
        """The acceleration at the start: the last stage of a step is the first of the next."""
        return terms.vf(t0, y0, args)[1]

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
        tableau, h = self.tableau, terms.contr(t0, t1)
        first = solver_state if made_jump is False else None
        stages = _in_a_loop if self.in_a_loop else _one_by_one
        first, last, combined = stages(tableau, lambda t, q: terms.vf(t, (q, y0[1]), args)[1], t0, t1, h, y0, first)
        q1 = _position(y0, h, 1, combined(tableau.b_position))
        v1 = jtu.tree_map(lambda v, k: v + h * k, y0[1], combined(tableau.b_velocity))
        dq, dv = (
            combined(tuple(x - y for x, y in zip(*weights)))
            for weights in (
                (tableau.b_position, tableau.embedded_position),
                (tableau.b_velocity, tableau.embedded_velocity),
            )
        )
        error = (jtu.tree_map(lambda k: h * (h * k), dq), jtu.tree_map(lambda k: h * k, dv))
        if tableau.a[-1] != tableau.b_position[:-1]:
            last = terms.vf(t1, (q1, v1), args)[1]
        dense = {"y0": y0, "y1": (q1, v1), "a0": first, "a1": last}
        return (q1, v1), error, dense, last, diffrax.RESULTS.successful


def _position(y0: PyTree, h: Array, c, combined: Callable):
    """`q + c h v + h² (sum a k)`."""
    return jtu.tree_map(lambda q, v, k: q + h * (c * v + h * k), *y0, combined)


def _one_by_one(tableau, acceleration: Callable, t0: Array, t1: Array, h: Array, y0: PyTree, first: PyTree):
    """The first and last stage, and a function for weighted sums of all stages; zero weights cost nothing."""
    found = [acceleration(t0, y0[0]) if first is None else first]

    def combined(weights: Any) -> Any:
        return weighted_sum(None, weights, found)

    for c, row in zip(tableau.c[1:], tableau.a):
        # Exactly t1, since the last stage must be at the same time as the first stage of the next step.
        t = t1 if c == 1 else t0 + c * (t1 - t0)
        found.append(acceleration(t, _position(y0, h, c, combined(row))))
    return found[0], found[-1], combined


def _in_a_loop(tableau, acceleration: Callable, t0: Array, t1: Array, h: Array, y0: PyTree, first: PyTree):
    """Like `_one_by_one`, with the acceleration compiled once."""
    count = len(tableau.c)
    rows = np.zeros((count, count))
    for i, row in enumerate(tableau.a, start=1):
        rows[i, :i] = row

    def weighted(weights: Array, found: PyTree) -> PyTree:
        return jtu.tree_map(lambda ks: jnp.tensordot(jnp.asarray(weights, ks.dtype), ks, 1), found)

    rows, nodes = jnp.asarray(rows), jnp.asarray(tableau.c, jnp.result_type(t0))

    def stage(i: Array, found: PyTree):
        t = jnp.where(nodes[i] == 1, t1, t0 + nodes[i] * (t1 - t0))
        q = _position(y0, h, nodes[i], weighted(rows[i], found))
        return jtu.tree_map(lambda ks, k: ks.at[i].set(k), found, acceleration(t, q))

    start = jtu.tree_map(lambda q: jnp.zeros((count, *jnp.shape(q)), jnp.result_type(q)), y0[0])
    if first is not None:
        start = jtu.tree_map(lambda ks, k: ks.at[0].set(k), start, first)
    found = lax.fori_loop(0 if first is None else 1, count, stage, start)
    first, last = (jtu.tree_map(lambda ks: ks[i], found) for i in (0, -1))
    return first, last, lambda weights: weighted(weights, found)


class Quintic(Interpolation):
    """The polynomial through q, v and a at both ends of a step, of order 5; v is its derivative."""

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree
    a0: PyTree
    a1: PyTree

    def at(self, t: Array):
        """(q, v) at t."""
        h = self.t1 - self.t0
        step = jnp.where(h == 0, 1.0, h)
        s = (t - self.t0) / step

        def coefficients(q0: Array, v0: Array, a0: Array, q1: Array, v1: Array, a1: Array):
            of_q = q1 - q0 - h * v0 - h * h * a0 / 2
            of_v, of_a = h * (v1 - v0) - h * h * a0, h * h * (a1 - a0)
            rest = (10 * of_q - 4 * of_v + of_a / 2, -15 * of_q + 7 * of_v - of_a, 6 * of_q - 3 * of_v + of_a / 2)
            return [q0, h * v0, h * h * a0 / 2, *rest]

        ends = (*self.y0, self.a0, *self.y1, self.a1)

        def position(*ends: Array) -> Any:
            return sum(c * s**k for k, c in enumerate(coefficients(*ends)))

        def slope(*ends: Array) -> Any:
            return sum(k * c * s ** (k - 1) for k, c in enumerate(coefficients(*ends)) if k) / step

        return jtu.tree_map(position, *ends), jtu.tree_map(slope, *ends)


# fmt: off
RKN86 = NystromTableau(
    c=(
        0, 1 / 20, 1 / 10, 3 / 10, 1 / 2, 7 / 10, 9 / 10, 1, 1,
    ),
    a=(
        (1 / 800,),
        (1 / 600, 1 / 300),
        (9 / 200, -9 / 100, 9 / 100),
        (-66701 / 197352, 28325 / 32892, -2665 / 5482, 2170 / 24669),
        (227015747 / 304251000, -54897451 / 30425100, 12942349 / 10141700, -9499 / 304251, 539 / 9250),
        (-1131891597 / 901789000, 41964921 / 12882700, -6663147 / 3220675, 270954 / 644135, -108 / 5875, 114 / 1645),
        (
            13836959 / 3667458, -17731450 / 1833729, 1063919505 / 156478208, -33213845 / 39119552, 13335 /
            28544, -705 / 14272, 1645 / 57088,
        ),
        (223 / 7938, 0, 1175 / 8064, 925 / 6048, 41 / 448, 925 / 14112, 1175 / 72576, 0),
    ),
    b_position=(
        223 / 7938, 0, 1175 / 8064, 925 / 6048, 41 / 448, 925 / 14112, 1175 / 72576, 0, 0,
    ),
    b_velocity=(
        223 / 7938, 0, 5875 / 36288, 4625 / 21168, 41 / 224, 4625 / 21168, 5875 / 36288, 223 / 7938, 0,
    ),
    embedded_position=(
        7987313 / 109941300, 0, 1610737 / 44674560, 10023263 / 33505920, -497221 / 12409600, 10023263 /
        78180480, 1610737 / 402071040, 0, 0,
    ),
    embedded_velocity=(
        7987313 / 109941300, 0, 1610737 / 40207104, 10023263 / 23454144, -497221 / 6204800, 10023263 /
        23454144, 1610737 / 40207104, -4251941 / 54970650, 3 / 20,
    ),
)

# The source gives rational numbers, some with sixty digits; these are the nearest double-precision numbers.
RKN1210 = NystromTableau(
    c=(
        0, 1 / 50, 1 / 25, 1 / 10, 2 / 15, 4 / 25, 1 / 20, 1 / 5, 1 / 4, 1 / 3, 1 / 2, 5 / 9, 3 / 4, 6 / 7,
        8437 / 8926, 1, 1,
    ),
    a=(
        (1 / 5000,),
        (1 / 3750, 1 / 1875),
        (7 / 2400, -1 / 240, 1 / 160),
        (2 / 1215, 0, 4 / 729, 32 / 18225),
        (152 / 78125, 0, 0.007151746031746032, 0.0029127111111111113, 0.0007899428571428571),
        (
            29 / 51200, 0, 0.0008809730489417989, -0.0004369212962962963, 0.00033900669642857143,
            -9.946469907407407e-05,
        ),
        (37 / 12000, 0, 0, 2 / 1125, 27 / 10000, 5 / 3168, 224 / 20625),
        (
            0.00365183937480113, 0, 0.003965171714072343, 0.0031972582629306284, 0.008221467306855435,
            -0.0013130926959572379, 0.009771586968064868, 0.003755769069232834,
        ),
        (
            0.003707241068718501, 0, 0.005082045854555286, 0.001174708002175412, -0.021147629915126993,
            0.06010463698107881, 0.02010573476850619, -0.02835075012293358, 0.014879568918581932,
        ),
        (
            0.03512537656073344, 0, -0.008615749195138479, -0.005791448051007917, 1.945554823782616,
            -3.4351238674565137, -0.10930701107475221, 2.3496383118995166, -0.7560094086870229,
            0.10952897222156927,
        ),
        (
            0.020527792537482496, 0, -0.00728644676448018, -0.0021153556079618403, 0.9275807968723522,
            -1.6522824844257367, -0.02107956300568657, 1.2065364326207872, -0.4137144770010661,
            0.09079873982809654, 0.005355552600533985,
        ),
        (
            -0.14324078875545515, 0, 0.012528703773091817, 0.006826019163969827, -4.799555395574387,
            5.6986250439519415, 0.7553430369523645, -0.12755487858281084, -1.9605926051117384,
            0.9185609056635262, -0.23880085505284432, 0.15911081357234216,
        ),
        (
            0.8045019205520489, 0, -0.016658527067011247, -0.021415834042629735, 16.827235928962466,
            -11.172835357176098, -3.377159297226324, -15.243326655360846, 17.179835738215417,
            -5.437719239823995, 1.3878671618364655, -0.5925827732652812, 0.029603873171297354,
        ),
        (
            -0.913296766697358, 0, 0.0024112725757805178, 0.01765812269386174, -14.851649779720384,
            2.1589708670045757, 3.99791558311788, 28.434151800232232, -25.2593643549416,
            7.733878542362238, -1.8913028948478674, 1.0014845070224718, 0.004641199599109052,
            0.011218755022148957,
        ),
        (
            -0.27519629720559396, 0, 0.03661188877915492, 0.009789519688231562, -12.293062345886211,
            14.207226453937903, 1.5866476906789537, 2.4577735327595946, -8.935193694403273,
            4.373672731613407, -1.8347181765449492, 1.1592085289061491, -0.017290253165383924,
            0.019325977904460768, 0.005204442937554993,
        ),
        (
            1.3076391847404059, 0, 0.017364109189745843, -0.018544456454265796, 14.811522032867726,
            9.38317630848247, -5.2284261999445425, -48.95128052584765, 38.297096034337926,
            -10.58738133697598, 2.4332304376226275, -1.0453406042575444, 0.0717732095086726,
            0.0021622109708082783, 0.007009595759602514, 0,
        ),
    ),
    b_position=(
        0.012127868517185414, 0, 0, 0, 0, 0, 0.08629746251568875, 0.2525469581187147, -0.1974186799326823,
        0.2031869190789726, -0.020775808077714918, 0.10967804874502014, 0.038065132526466504,
        0.01163406880432423, 0.0046580297040248785, 0, 0,
    ),
    b_velocity=(
        0.012127868517185414, 0, 0, 0, 0, 0, 0.09083943422704079, 0.3156836976483934, -0.2632249065769097,
        0.3047803786184589, -0.041551616155429835, 0.2467756096762953, 0.15226053010586602,
        0.08143848163026961, 0.08502571193890811, -0.009155189630077963, 1 / 40,
    ),
    embedded_position=(
        0.01700870190700699, 0, 0, 0, 0, 0, 0.0722593359308314, 0.372026177326753, -0.40182114500930355,
        0.3354550683013517, -0.13130650107533182, 0.18943190661604864, 0.026840802040029046,
        0.016305665605917924, 0.0037999883566965944, 0, 0,
    ),
    embedded_velocity=(
        0.01700870190700699, 0, 0, 0, 0, 0, 0.07606245887455937, 0.4650327216584413, -0.5357615266790714,
        0.5031826024520275, -0.26261300215066363, 0.4262217898861095, 0.10736320816011619,
        0.11413965924142547, 0.06936338665004868, 1 / 50, 0,
    ),
)
# fmt: on


class Nystrom8(Nystrom):
    """Order 8 with an embedded method of order 6: eight accelerations per step.

    For costly accelerations with many outputs, since each output is the end of a step.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> swing = diffrax.ODETerm(lambda t, y, args: (y[1], -y[0]))
    >>> controller = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    >>> start = (jnp.asarray(1.0), jnp.asarray(0.0))
    >>> q, v = diffrax.diffeqsolve(swing, Nystrom8(), 0.0, jnp.pi, None, start, stepsize_controller=controller).ys
    >>> print(q.round(7))
    [-1.]
    """

    tableau: ClassVar = RKN86
    highest: ClassVar = 8
    embedded: ClassVar = 6


class Nystrom12(Nystrom):
    """Order 12 with an embedded method of order 10: seventeen accelerations per step.

    The default of `lj.integrate` if accelerations do not depend on velocities and there are no constraints: the fastest
    of all methods here for any error below 1e-4 on a bead and a pendulum. Used like `Nystrom8`.

    >>> print(Nystrom12().order(None))
    12

    If a stiff spring limits its steps (`print(traj)` says "stability"), derivatives of the motion can lose all digits
    while the motion itself does not, since only the motion controls the steps: `lj.Dopri8()` keeps both accurate.
    """

    tableau: ClassVar = RKN1210
    highest: ClassVar = 12
    embedded: ClassVar = 10


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
