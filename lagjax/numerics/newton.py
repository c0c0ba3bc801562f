"""Newton's method for `r(y) = 0`, kept from going astray in three ways, and least squares for a chain of windows.

`newton` takes steps that its caller solves for, and shortens them where they overshoot; `damped_newton` repeats a step
that did not reduce the residual with more damping; `newton_in_python` starts near the solution and gives up where steps
do not shrink. Derivatives of the solution are those of one more step with a constant matrix (`last_step`), or of the
implicit function, to any order (`differentiable`).

A step of Levenberg and Marquardt is, with the singular value decomposition of the scaled Jacobian `J = U Σ Vᵀ`,

    d = -V Σ (Σ² + δ)⁻¹ Uᵀ r

For δ → 0 it is Newton's step, the shortest if there are many; so redundant equations do no harm, and a family of
solutions is reached at its nearest point. A step that does not reduce `|r|` is taken back and δ is increased.

Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Nielsen, IMM-REP-1999-05 (how δ changes).

*Its linear steps* in least squares for a chain of windows, with unknowns shared by all windows and unknowns of each.

    rows of window w        R_w s_w + P_w p                = r_w
    the seam to the next    O_w s_w + N_w s_{w+1} + S_w p  = d_w
    on the shared unknowns                      Q p        = h

A QR factorisation of one window at a time eliminates s_w and passes the remaining equations in s_{w+1} and p to the
next window, so the cost grows linearly with the number of windows, not with its cube, and no matrix is squared. A
backward pass through the same factors gives the covariance. This is the square-root information filter and smoother.

Source: Bierman, *Factorization Methods for Discrete Sequential Estimation*, §§V-VII and X.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.numerics import lapack

# Singular values below this many round-offs of the largest count as zero.
ZERO_BELOW = 1e3
# The largest number of steps. A stiff system is followed along a narrow valley; a hopeless start ends much earlier.
MOST = 600
# Steps with less damping than this are Newton's.
NEWTON_BELOW = 1e-9


def largest(r: Array) -> Array:
    """The largest entry."""
    return jnp.max(jnp.abs(r))


def newton(
    residual: Callable[[Array], Array],
    step: Callable[[Array, Array, Array], Array],
    y0: Float[Array, "*levels n"],
    most: int,
    *,
    size: Callable[[Array], Array] = largest,
    enough: float = 0.0,
    falls: float | None = None,
    fractions: np.ndarray | None = None,
) -> Float[Array, "*levels n"]:
    """Repeat `y - f step(y, r, i)` with `r = residual(y)`, at most `most` times. Not differentiable in reverse mode.

    >>> print(newton(lambda y: y**2 - 2.0, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 6).round(6))
    [1.414214]

    **Arguments:** f is the first of the `fractions` for which `size(r)` is least, or 1. The iteration ends when
    `size(r)`, of each of several levels, is zero, or at most `enough` times the size of y or the first one; or, with
    `falls`, when it is no longer below `falls` times the one before. The program contains `residual` and `step` once.
    """

    def iterate(state):
        i, y, whole, first, before, _ = state
        if fractions is None:
            y = y - whole
            r = residual(y)
        else:
            trials = y[None] - fractions.astype(y.dtype)[:, None] * whole[None]
            residuals = jax.vmap(residual)(trials)
            sizes = jax.vmap(size)(residuals)
            best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
            y, r = trials[best], residuals[best]
        now = size(r)
        first = jnp.where(i == 0, now, first)
        going = jnp.any(now > (enough * jnp.maximum(jnp.max(jnp.abs(y), axis=-1), first) if enough else 0.0))
        going = going if falls is None else going & (now < falls * before)
        return i + 1, y, step(y, r, i), first, now, going

    def unfinished(state):
        return (state[0] <= most) & state[-1]

    unknown = jnp.full(y0.shape[:-1], jnp.inf, y0.dtype)
    return lax.while_loop(unfinished, iterate, (0, y0, jnp.zeros_like(y0), unknown, unknown, jnp.asarray(True)))[1]


def last_step(near: Array, y0: Array, step: Callable[[Array], Array]) -> Array:
    """One more step from `near`, with the first derivatives of the solution that was found from y0.

    The matrix in `step(y)` is constant: where the residual vanishes, its derivative does not contribute.
    """
    y = near + (y0 - lax.stop_gradient(y0))
    return y - step(y)


class Search(NamedTuple):
    """A damped search: the best `y`, its evaluation `at`, what the next step depends on, and the evaluations so far."""

    y: PyTree
    at: PyTree
    memory: Any
    steps: Int[Array, ""]


def damped_newton(
    evaluate: Callable[[PyTree], PyTree],
    propose: Callable[[Search], PyTree],
    judge: Callable[[Search, PyTree, PyTree], tuple[Bool[Array, ""], Any]],
    unfinished: Callable[[Search], Bool[Array, ""]],
    y0: PyTree,
    at: PyTree,
    memory: Any,
    loop: Callable = lax.while_loop,
) -> Search:
    """Repeat `trial = propose(search)`, and keep it where it is better.

    `judge(search, trial, evaluate(trial))` says whether it is, and gives the next memory. The first trial is to be y0,
    whose evaluation `at` is unknown: so the program contains one evaluation. `loop`: `while_in_python`, if that is a
    program of its own.
    """

    def iterate(search):
        trial = propose(search)
        there = evaluate(trial)
        better, memory = judge(search, trial, there)
        y, at = jax.tree.map(lambda new, old: jnp.where(better, new, old), (trial, there), (search.y, search.at))
        return Search(y, at, memory, search.steps + 1)

    return loop(unfinished, iterate, Search(y0, at, memory, jnp.zeros((), int)))


def while_in_python(unfinished: Callable[[Any], Bool[Array, ""]], iterate: Callable[[Any], Any], state: Any) -> Any:
    """What `lax.while_loop` does, with nothing traced."""
    while bool(unfinished(state)):
        state = iterate(state)
    return state


class Ended(NamedTuple):
    """Where `newton_in_python` ended, its last step, the relative lengths of all, and whether they ended small."""

    y: np.ndarray
    step: np.ndarray
    lengths: list[float]
    converged: bool


def newton_in_python(
    step: Callable[[np.ndarray], np.ndarray | None],
    y: np.ndarray,
    most: int,
    *,
    enough: float = 0.0,
    free: int | None = None,
    shrinks: float = 1.0,
    noise: float = np.inf,
) -> Ended | None:
    """Repeat `y - step(y)` until a step is at most `enough`, or, after `free` steps, not shorter than the one before.

    None where `step(y)` is None, or where a step after `free` ones is above `noise` and above `shrinks` times the one
    before. A length is the largest entry of a step, relative to that of y if this is above 1.
    """
    lengths, change = [np.inf], np.zeros_like(y)
    for i in range(most):
        change = step(y)
        if change is None:
            return None
        length = float(np.max(np.abs(change))) / max(1.0, float(np.max(np.abs(y))))
        settled = free is not None and i >= free
        if settled and length > shrinks * lengths[-1] and length > noise:
            return None
        y = y - change
        if length <= enough or settled and length >= lengths[-1]:
            return Ended(y, change, [*lengths[1:], length], True)
        lengths.append(length)
    return Ended(y, change, lengths[1:], False)


class Root(NamedTuple):
    """`y` (n,) with residuals `r` (m,) and the `jacobian` there; `rows`: largest entries of its rows at the start."""

    y: Float[Array, " n"]
    r: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    rows: Float[Array, " m"]
    steps: Int[Array, ""]


class Damping(NamedTuple):
    """What a step of Levenberg and Marquardt depends on; the search ends when no tries are left."""

    rows: Float[Array, " m"]
    columns: Float[Array, " n"]
    damping: Float[Array, ""]
    grow: Float[Array, ""]
    tries_left: Int[Array, ""]


def zero_below(dtype: DTypeLike) -> float:
    """Singular values up to this part of the largest are round-off."""
    return ZERO_BELOW * float(jnp.finfo(dtype).eps)


def least_squares_root(residual: Callable, y0: Float[Array, " n"], linear: np.ndarray | None = None) -> Root:
    """Find a root of `residual(y)` near y0, or a minimum of its size. Not differentiable: see `differentiable`.

    >>> found = least_squares_root(lambda y: jnp.stack([y[0] * y[1] - 2.0]), jnp.array([2.0, 2.0]))
    >>> print(found.y.round(6), abs(found.r[0]) < 1e-6)
    [1.414214 1.414214] True

    **Arguments:** `residual(y)` -> (m,), of any units; y0 (n,); `linear` (n,): which unknowns enter linearly;
    these are solved for first, with the others as in y0.
    """
    eps, tiny = jnp.finfo(y0.dtype).eps, jnp.finfo(y0.dtype).tiny
    linear = np.zeros(y0.size, bool) if linear is None else linear

    def positive(x: Array):
        return jnp.where(x > 0, x, 1.0)

    def size(r: Array, rows):
        squared = jnp.sum((r / rows) ** 2)
        return jnp.where(jnp.isfinite(squared), squared, jnp.inf)

    def propose(search):
        (r, jacobian), memory = search.at, search.memory
        only_linear = (search.steps == 1) & linear.any()
        columns = positive(memory.columns)
        reduced = jnp.where(only_linear & ~linear[None, :], 0.0, jacobian)
        damping = jnp.where((memory.damping < NEWTON_BELOW) | only_linear, 0.0, memory.damping)
        u, s, vt = lapack.decomposed(reduced / memory.rows[:, None] / columns[None, :])
        kept = s > zero_below(y0.dtype) * jnp.maximum(s[0], tiny)
        gain = jnp.where(kept, s / jnp.where(kept, s**2 + damping, 1.0), 0.0)
        step = (vt.T @ (gain * (u.T @ (r / memory.rows)))) / columns
        return search.y - jnp.where(search.steps == 0, 0.0, step)

    def judge(search, trial, there):
        (new_r, new_jacobian), (r, jacobian), (rows, columns, damping, grow, _) = there, search.at, search.memory
        # The start, and the step of the linear unknowns.
        always_accepted = (search.steps == 0) | (linear.any() & (search.steps == 1))
        # Rows are scaled at the start, and again after the step of the linear unknowns.
        rows = jnp.where(search.steps <= 1, positive(jnp.max(jnp.abs(new_jacobian), axis=1)), rows)
        old, new = size(r, rows), size(new_r, rows)
        better = jnp.all(jnp.isfinite(new_jacobian)) & (always_accepted | (new < old))
        expected = old - size(r + jacobian @ (trial - search.y), rows)
        gain_ratio = jnp.where(expected > 0, (old - new) / positive(expected), 0.0)
        less = damping * jnp.maximum(1e-3, 1 - (2 * gain_ratio - 1) ** 3)
        more = jnp.maximum(damping, 1e-12) * grow
        damping = jnp.where(always_accepted, damping, jnp.where(better, less, more)).astype(trial.dtype)
        grow = jnp.where(better, 2.0, 2 * grow).astype(trial.dtype)
        moved = largest(trial - search.y) > 4 * eps * largest(trial)
        columns = jnp.where(always_accepted, 0.0, columns)
        jacobian = jnp.where(better, new_jacobian, jacobian)
        columns = jnp.maximum(columns, jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0))
        # The last steps are Newton's, as long as they reduce the residual.
        in_vain = (damping < NEWTON_BELOW) & ~better & ~always_accepted
        tries_left = search.memory.tries_left - in_vain.astype(search.memory.tries_left.dtype)
        left = jnp.where(better, new, old)
        going = jnp.where(always_accepted, better, moved) & (left > 0) & (damping < 1e12)
        return better, Damping(rows, columns, damping, grow, jnp.where(going, tries_left, 0))

    def unfinished(search):
        return (search.steps < MOST) & (search.memory.tries_left > 0)

    m = jax.eval_shape(residual, y0).shape[0]
    none, one = jnp.zeros((m, y0.size), y0.dtype), jnp.ones((), y0.dtype)
    memory = Damping(none[:, 0] + 1, jnp.zeros_like(y0), 1e-3 * one, 2 * one, jnp.asarray(2))
    found = damped_newton(
        partial(with_value, residual), propose, judge, unfinished, y0, (none[:, 0] * jnp.nan, none), memory
    )
    return Root(found.y, *found.at, found.memory.rows, found.steps)


def with_value(residual: Callable, y: PyTree):
    """A residual and its Jacobian, by one linearisation."""
    r, push = jax.linearize(residual, y)
    return r, jax.vmap(push, out_axes=1)(jnp.eye(y.size, dtype=y.dtype))


def differentiable(residual: Callable, root: Root) -> Float[Array, " n"]:
    """The root with derivatives of any order, by the implicit function theorem.

    The derivatives are with respect to everything that `residual` depends on. If there is a family of roots, they
    follow its nearest member.
    """
    y, jacobian = lax.stop_gradient((root.y, root.jacobian))

    def size(axis: int) -> Array:
        return jnp.where((s := jnp.max(jnp.abs(jacobian), axis=axis)) > 0, s, 1.0)

    rows = size(1)
    columns = jnp.where((s := jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0)) > 0, s, 1.0)
    inverted = jnp.linalg.pinv(jacobian / rows[:, None] / columns[None, :], rtol=zero_below(y.dtype))
    inverted = inverted / columns[:, None] / rows[None, :]
    free = jnp.eye(y.size, dtype=y.dtype) - inverted @ jacobian

    def linear_solve(function: Callable, known: Array):
        matrix = jax.jacfwd(function)(jnp.zeros_like(known))
        return jnp.linalg.solve(matrix + free, known)

    return lax.custom_root(lambda y: inverted @ residual(y), y, lambda _, y: y, linear_solve)


class Unknowns(NamedTuple):
    """The unknowns shared by all windows, and those of each window."""

    shared: Float[Array, " p"]
    local: Float[Array, "windows k"]


class WindowedEquations(NamedTuple):
    """Residuals of the samples and the seam of each window, and of prior knowledge about the shared unknowns."""

    rows: Float[Array, "windows m"]
    seams: Float[Array, "windows j"]
    shared: Float[Array, " h"]


class Slopes(NamedTuple):
    """The derivatives of `WindowedEquations` that are not zero by structure."""

    rows_by_shared: Float[Array, "windows m p"]
    rows_by_local: Float[Array, "windows m k"]
    seams_by_shared: Float[Array, "windows j p"]
    seams_by_local: Float[Array, "windows j k"]
    seams_by_next: Float[Array, "windows j k"]
    shared: Float[Array, "h p"]

    def along(self, d: Unknowns) -> WindowedEquations:
        """The change of the equations along a change of the unknowns."""
        following = jnp.concatenate([d.local[1:], jnp.zeros_like(d.local[:1])])
        return WindowedEquations(
            self.rows_by_shared @ d.shared + _each(self.rows_by_local, d.local),
            self.seams_by_shared @ d.shared
            + _each(self.seams_by_local, d.local)
            + _each(self.seams_by_next, following),
            self.shared @ d.shared,
        )

    def sizes(self) -> Unknowns:
        """The norm of the slopes with respect to each unknown."""

        def squares(blocks: Array) -> Array:
            return jnp.sum(blocks**2, axis=1)

        shared = jnp.sum(squares(self.rows_by_shared) + squares(self.seams_by_shared), axis=0)
        shared = shared + jnp.sum(self.shared**2, axis=0)
        # The unknowns of a window also enter the seam before it.
        local = (
            squares(self.rows_by_local)
            + squares(self.seams_by_local)
            + jnp.roll(squares(self.seams_by_next), 1, axis=0)
        )
        return Unknowns(jnp.sqrt(shared), jnp.sqrt(local))

    def scaled(self, by_shared: Float[Array, " p"]) -> "Slopes":
        """The slopes after a change of units of the shared unknowns."""
        return self._replace(
            rows_by_shared=self.rows_by_shared * by_shared[None, None],
            seams_by_shared=self.seams_by_shared * by_shared[None, None],
            shared=self.shared * by_shared[None],
        )


def filled(sizes: Unknowns) -> Unknowns:
    """Sizes in which zeros are replaced by the largest size, so that undetermined unknowns are damped and stay put."""
    return jax.tree.map(lambda size: jnp.where(size > 0, size, jnp.maximum(jnp.max(size, initial=0.0), 1.0)), sizes)


def _each(blocks, vectors):
    return jnp.einsum("wij,wj->wi", blocks, vectors)


def _directions(u: Unknowns) -> Unknowns:
    """Directions whose derivatives contain all slopes: every other window at a time, since a seam involves two."""
    (p,), (windows, k) = u.shared.shape, u.local.shape
    parities = min(windows, 2)
    alternating = (jnp.arange(windows)[None, :] % 2 == jnp.arange(parities)[:, None]).astype(u.local.dtype)
    local = alternating[:, None, :, None] * jnp.eye(k, dtype=u.local.dtype)[None, :, None, :]
    local = local.reshape(parities * k, windows, k)
    zeros = jnp.zeros((p, windows, k), u.local.dtype), jnp.zeros((parities * k, p), u.shared.dtype)
    return Unknowns(jnp.concatenate([jnp.eye(p, dtype=u.shared.dtype), zeros[1]]), jnp.concatenate([zeros[0], local]))


def _slopes(along: WindowedEquations, u: Unknowns) -> Slopes:
    """The slopes from the derivatives along `_directions(u)`, which are the leading axis."""
    (p,), (windows, k) = u.shared.shape, u.local.shape
    by_shared, by_local = (jax.tree.map(lambda x: x[part], along) for part in (slice(None, p), slice(p, None)))

    def last(x: Array) -> Array:
        return jnp.moveaxis(x, 0, -1)

    w, parities = jnp.arange(windows), min(windows, 2)
    # Axes: parity, k, windows, equations.
    rows, seams = (x.reshape(parities, k, *x.shape[1:]) for x in (by_local.rows, by_local.seams))

    def chosen(x: Array, parity: Array) -> Array:
        return jnp.moveaxis(x, 1, -1)[parity % parities, w]

    return Slopes(
        last(by_shared.rows),
        chosen(rows, w),
        last(by_shared.seams),
        chosen(seams, w),
        chosen(seams, w + 1),
        last(by_shared.shared),
    )


class Factors(NamedTuple):
    """The triangular equations after elimination: `R s_w + next s_{w+1} + P p = rhs`, and `S p = rhs`."""

    local: Float[Array, "windows k k"]
    following: Float[Array, "windows k k"]
    local_by_shared: Float[Array, "windows k p"]
    local_rhs: Float[Array, "windows k"]
    shared: Float[Array, "p p"]
    shared_rhs: Float[Array, " p"]


def eliminate(a: Slopes, rhs: WindowedEquations, damping: Unknowns) -> Factors:
    """Factorise the equations together with `damping * unknown = 0`."""
    windows, _, k = a.rows_by_local.shape
    p = a.shared.shape[1]
    width = k + p + 1

    def one_window(carried, x: Array):
        a, r, seam, damped = x
        blocks = [
            [carried[:, :k], jnp.zeros((width, k)), carried[:, k:]],
            [a.rows_by_local, jnp.zeros_like(a.rows_by_local), a.rows_by_shared, r[:, None]],
            [a.seams_by_local, a.seams_by_next, a.seams_by_shared, seam[:, None]],
            [jnp.diag(damped), jnp.zeros((k, k)), jnp.zeros((k, p + 1))],
        ]
        triangle = _triangle(jnp.concatenate([jnp.concatenate(row, axis=1) for row in blocks]))
        return triangle[k:, k:], triangle[:k]

    each = a._replace(shared=jnp.zeros((windows, 0)))
    start = jnp.zeros((width, width), a.rows_by_local.dtype)
    left, found = lax.scan(one_window, start, (each, rhs.rows, rhs.seams, damping.local))
    on_shared = [
        left[:, k:],
        jnp.concatenate([a.shared, rhs.shared[:, None]], axis=1),
        jnp.concatenate([jnp.diag(damping.shared), jnp.zeros((p, 1))], axis=1),
    ]
    shared = _triangle(jnp.concatenate(on_shared))
    return Factors(
        found[:, :, :k],
        found[:, :, k : 2 * k],
        found[:, :, 2 * k : -1],
        found[:, :, -1],
        shared[:p, :p],
        shared[:p, -1],
    )


def _triangle(matrix: Array):
    """The square triangular factor; rows of zeros are added if there are fewer rows than columns."""
    rows, columns = matrix.shape
    short = max(columns - rows, 0)
    return jnp.linalg.qr(jnp.concatenate([matrix, jnp.zeros((short, columns), matrix.dtype)]), mode="r")


def solution(f: Factors) -> Unknowns:
    """The least-squares solution."""
    shared = _upper(f.shared, f.shared_rhs)

    def back(following: Array, x: Array):
        local, by_next, by_shared, rhs = x
        found = _upper(local, rhs - by_next @ following - by_shared @ shared)
        return found, found

    each = f.local, f.following, f.local_by_shared, f.local_rhs
    _, local = lax.scan(back, jnp.zeros_like(f.local_rhs[0]), each, reverse=True)
    return Unknowns(shared, local)


class Covariance(NamedTuple):
    """The covariance of the shared unknowns, of each window's unknowns, and between the two."""

    shared: Float[Array, "p p"]
    local: Float[Array, "windows k k"]
    local_shared: Float[Array, "windows k p"]


def covariance(f: Factors, inverse: Float[Array, "p p"]) -> Covariance:
    """The covariance of the unknowns if the errors of the equations are independent with unit variance.

    `inverse` of the shared factor: a generalised inverse leaves out undetermined directions.
    """
    k, of_shared = f.local.shape[-1], inverse @ inverse.T

    def back(joint, x: Array):
        local, by_next, by_shared = x
        inverse = _upper(local, jnp.eye(k, dtype=local.dtype))
        # s_w = R⁻¹ (noise - [next, P] (s_{w+1}, p)).
        gain = -inverse @ jnp.concatenate([by_next, by_shared], axis=1)
        with_rest = gain @ joint
        of_local, local_shared = inverse @ inverse.T + with_rest @ gain.T, with_rest[:, k:]
        joint = jnp.block([[of_local, local_shared], [local_shared.T, of_shared]])
        return joint, (of_local, local_shared)

    last = jnp.zeros((k + len(inverse),) * 2, f.shared.dtype).at[k:, k:].set(of_shared)
    _, (local, local_shared) = lax.scan(back, last, (f.local, f.following, f.local_by_shared), reverse=True)
    return Covariance(of_shared, local, local_shared)


def _upper(triangle, rhs: Array):
    if triangle.shape[-1] == 0:
        return rhs
    return jax.scipy.linalg.solve_triangular(triangle, rhs)


def slopes_of(product: Callable[[Unknowns], WindowedEquations], u: Unknowns) -> Slopes:
    """The slopes of equations from their products with a few directions; `u` gives the shapes."""
    return _slopes(jax.vmap(product)(_directions(u)), u)


class ByWindows(lx.AbstractLinearSolver):
    """Solve the damped equations of Levenberg-Marquardt's step window by window, as a lineax solver.

    Damping is relative to the slopes of each unknown (Marquardt's choice), so that units of the unknowns do not matter;
    it starts at `tau` of them.
    """

    tau: float = 1e-3

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        """The slopes and the damping, found by applying the operator along a few directions."""
        u = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), operator.in_structure())
        found = slopes_of(lambda d: operator.mv(d)[0], u)
        _, damped = operator.mv(jax.tree.map(jnp.ones_like, u))
        # The damping is one number on the diagonal.
        damping = jnp.max(jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(damped)]))
        return found, jax.tree.map(lambda size: jnp.sqrt(self.tau) * damping * size, filled(found.sizes()))

    def compute(self, state, vector, options: dict[str, Any]):
        """The step, lineax's result, and no statistics."""
        found, damping = state
        return solution(eliminate(found, vector[0], damping)), lx.RESULTS.successful, {}

    def transpose(self, state, options: dict[str, Any]):
        """Not implemented: steps are not differentiated."""
        raise NotImplementedError

    def conj(self, state, options: dict[str, Any]):
        """The unchanged state: all numbers are real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """True: damping makes the matrix full rank."""
        return True
