"""Simplified Newton iteration: one Jacobian, inverted once, for all iterations of an implicit step.

    J (y_{k+1} - y_k) = -f(y_k),        theta_k = |y_{k+1} - y_k| / |y_k - y_{k-1}|

Each iteration contracts by about theta, so the remaining error after iteration k is estimated by
theta/(1 - theta) |y_{k+1} - y_k|. The iteration has converged once that is below a small part of the step's tolerance.
A test of the residual would demand less than round-off in stiff equations, where a residual is multiplied by the
stiffness.

If theta is close to one or above, the Jacobian is computed again. RADAU5 rejects such a step; but the direction of a
stiff spring turns during a step, and theta is then of the order of (stiffness) x (angle), however accurate the step is:
rejecting such steps would limit h to (k omega)^(-1/3).

Source: Hairer & Wanner, *Solving ODEs II*, §IV.8, (8.9)-(8.11).
"""

import copyreg
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.numerics.linalg import dense

# If two corrections in a row are below this part of the tolerance, the rest is round-off.
NOISE = 0.1


class Inverse(eqx.Module):
    """The inverse of a Jacobian, acting on residuals with the structure of the unknown."""

    matrix: Float[Array, "n n"]

    def __call__(self, residual: PyTree) -> PyTree:
        """J^-1 times a residual."""
        vector, unravel = ravel_pytree(residual)
        return unravel(self.matrix @ vector)


class Iteration(eqx.Module):
    """The state of the iteration: the last two corrections by one Jacobian, in units of the tolerance."""

    inverse: Inverse
    here: bool = eqx.field(static=True)
    start: PyTree
    size: Float[Array, ""]
    previous: Float[Array, ""]
    count: Int[Array, ""]
    stale: Bool[Array, ""]  # The next iteration recomputes the Jacobian,
    renewed: Bool[Array, ""]  # and an earlier one has already done so.

    @classmethod
    def first(cls, inverse: Inverse, start: PyTree, here: bool = False) -> "Iteration":
        """The state before the first iteration, with an inverted Jacobian; `here`: whether it is that of the start."""
        unknown = jnp.asarray(jnp.inf, inverse.matrix.dtype)
        no = jnp.asarray(False)
        return cls(inverse, here, start, unknown, unknown, jnp.asarray(0), no, no)

    def rate(self):
        """theta; infinite before there are two corrections."""
        known = jnp.isfinite(self.previous)
        return jnp.where(known, self.size / jnp.where(self.previous > 0, self.previous, 1.0), jnp.inf)


class SimplifiedNewton(optx.AbstractRootFinder):
    """Newton's iteration with a Jacobian that is kept while it contracts, stopped by its rate of convergence.

    For the implicit methods of diffrax, with the tolerances of the step-size controller:

    >>> import diffrax
    >>> kvaerno = diffrax.Kvaerno5(root_finder=diffrax.with_stepsize_controller_tols(SimplifiedNewton)())

    and with its own tolerances for constant steps: `SimplifiedNewton(rtol=1e-10, atol=1e-12)`.

    **Fields:** `rtol`, `atol`: the tolerances of the step (`atol` may be a vector, or a function of the unknown that
    returns one); `norm`: the norm of a correction in units of them; `kappa`: the part of the tolerance that the
    iteration error may take, by default `min(0.03, 0.3 rtol^(1/3))` as in RADAU5; `slow`: the rate above which the
    Jacobian is recomputed (infinite: never, as in RADAU5).

    **Options** of a single solve: `init_state`, the state of another solve, whose Jacobian is used first; `offset`,
    added to the unknown when its size sets the tolerance; `inverse_at`, a function from an unknown to the `Inverse`.

    Converges linearly, by a factor that is proportional to the change of the Jacobian;
    `tests/numerics/test_radau.py` counts steps and compares with diffrax's root finder.

    Source: Hairer & Wanner, *Solving ODEs II*, §IV.8, (8.9)-(8.11).
    """

    rtol: float
    atol: ArrayLike | Callable[[Array], Array]
    norm: Callable[[PyTree], Array] = optx.max_norm
    kappa: float | None = None
    slow: float = eqx.field(static=True, default=0.3)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Iteration:
        if "init_state" in options:
            return options["init_state"]
        return Iteration.first(_inverse_at(fn, y, args, options), y, here=True)

    def step(self, fn, y, args, options, state, tags) -> tuple[PyTree, Iteration, Any]:
        # A branch also under `vmap`: no Jacobian is computed unless a lane needs it.
        renew = lambda: jtu.tree_map(
            lambda new, old: jnp.where(state.stale, new, old), _inverse_at(fn, y, args, options), state.inverse
        )
        inverse = lax.cond(eqxi.unvmap_any(state.stale), renew, lambda: state.inverse)
        residual, aux = fn(y, args)
        correction = inverse(residual)
        new = jtu.tree_map(lambda y, d: y - d, y, correction)
        full = jtu.tree_map(jnp.add, new, options["offset"]) if "offset" in options else new
        known = lambda allowed: jnp.where(allowed > 0, allowed, 1.0)
        units = jtu.tree_map(lambda d, y: d / known(self.allowed(y)), correction, full)
        size = self.norm(units).astype(state.size.dtype)
        first = state.count == 0
        now = Iteration(
            inverse,
            state.here,
            # The Jacobian at the start would not be a new one if `here`: restart from the first correction.
            start=jtu.tree_map(lambda y, old: jnp.where(first, y, old), new if state.here else y, state.start),
            size=size,
            previous=jnp.where(state.stale, jnp.inf, state.size),
            count=state.count + 1,
            stale=jnp.asarray(False),
            renewed=state.renewed | state.stale,
        )
        stale = self._too_slow(now)
        # A Jacobian from another point may have led far away, towards another root: restart.
        restart = stale & ~now.renewed & ~(now.rate() < 1)
        new = jtu.tree_map(lambda x, start: jnp.where(restart, start, x), new, now.start)
        return new, eqx.tree_at(lambda state: state.stale, now, stale), aux

    def allowed(self, y: Array) -> Array:
        """The tolerance of each number of an unknown."""
        return jnp.broadcast_to(self.atol(y) if callable(self.atol) else self.atol, y.shape) + self.rtol * jnp.abs(y)

    def _converged(self, state):
        rate, size, previous = state.rate(), state.size, state.previous
        round_off = 10 * jnp.finfo(size.dtype).eps / jnp.where(self.rtol > 0, self.rtol, 1.0)
        kappa = jnp.minimum(0.03, 0.3 * jnp.cbrt(self.rtol)) if self.kappa is None else self.kappa
        remaining = rate / jnp.where(rate < 1, 1 - rate, 1.0) * size
        contracts = (rate < 1) & (remaining <= jnp.maximum(kappa, round_off))
        # Small corrections that do not shrink with a new Jacobian are the round-off of a stiff residual.
        noise = jnp.where(state.renewed, jnp.maximum(NOISE, round_off), round_off)
        return contracts | ((previous <= noise) & (size <= noise)) | (size == 0)

    def _too_slow(self, state):
        known = jnp.isfinite(state.previous)
        return ~self._converged(state) & ((known & ~(state.rate() <= self.slow)) | ~jnp.isfinite(state.size))

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        converged = self._converged(state)
        # An old Jacobian is recomputed first. Growth after that leads to another root as often as back.
        grows = (jnp.isfinite(state.previous) & ~(state.rate() < 1)) | ~jnp.isfinite(state.size)
        renewable = np.isfinite(self.slow)
        diverged = ~converged & (state.count > 0) & grows & (state.renewed if renewable else True)
        failure = optx.RESULTS.where(diverged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return converged | diverged, failure

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        # A failed step is discarded by multiplying its derivative by zero, so it must be finite.
        return jtu.tree_map(lambda x: jnp.where(jnp.isfinite(x), x, 0), y), aux, {}


def _inverse_at(fn, y, args, options):
    if "inverse_at" in options:
        return options["inverse_at"](y)
    vector, unravel = ravel_pytree(y)
    return Inverse(dense.inverse(jax.jacfwd(lambda vector: ravel_pytree(fn(unravel(vector), args)[0])[0])(vector)))


def tolerance_of_the_controller():
    """The placeholder of diffrax for tolerances taken from the step-size controller."""
    return diffrax.with_stepsize_controller_tols(SimplifiedNewton)().rtol


# diffrax compares it by identity, which must survive copying and pickling a method.
copyreg.pickle(type(tolerance_of_the_controller()), lambda _: (tolerance_of_the_controller, ()))


def with_tolerances(solver: diffrax.AbstractSolver, rtol, atol, norm=optx.max_norm) -> diffrax.AbstractSolver:
    """Give a solver's root finder tolerances, if it would take them from an adaptive step-size controller.

    With constant steps there is no such controller, and diffrax raises an error. Other solvers are returned unchanged.

    >>> import diffrax
    >>> with_tolerances(diffrax.ImplicitEuler(), 1e-10, 1e-12).root_finder.rtol
    1e-10
    """
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    from_controller = tolerance_of_the_controller()
    tolerances = {"rtol": rtol, "atol": atol, "norm": norm}
    missing = [name for name in tolerances if getattr(solver.root_finder, name, None) is from_controller]
    if not missing:
        return solver
    at = lambda solver: [getattr(solver.root_finder, name) for name in missing]
    return eqx.tree_at(at, solver, [tolerances[name] for name in missing])
