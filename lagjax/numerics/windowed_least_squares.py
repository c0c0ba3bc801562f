"""Linear least squares for a chain of windows, with unknowns shared by all windows and unknowns of each window.

    rows of window w        R_w s_w + P_w p                = r_w
    the seam to the next    O_w s_w + N_w s_{w+1} + S_w p  = d_w
    on the shared unknowns                      Q p        = h

A QR factorisation of one window at a time eliminates s_w and passes the remaining equations in s_{w+1} and p to the
next window, so the cost grows linearly with the number of windows, not with its cube, and no matrix is squared. A
backward pass through the same factors gives the covariance. This is the square-root information filter and smoother.

Source: Bierman, *Factorization Methods for Discrete Sequential Estimation*, §§V-VII and X.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jax import lax
from jaxtyping import Array, Float


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
