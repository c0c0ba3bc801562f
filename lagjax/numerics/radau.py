"""Radau IIA of order 5: a fully implicit Runge-Kutta method for stiff equations, as a diffrax solver.

The stages Y_i = y0 + z_i, i = 1..3, solve  z = (A x I) h F(Y),  and y1 = y0 + z_3, as the last stage is at the step's
end. With A^-1 = T diag(lambda) T^-1, and hJ the Jacobian of h f at the step's start, the Newton iteration

    (A^-1 x I - I x hJ) dz = h F(Y) - (A^-1 x I) z

splits into one real system (gamma I - hJ) and one complex one (lambda I - hJ) for T^-1 dz, both inverted once per step.
If that does not contract, `SimplifiedNewton` continues with the Jacobian of the stages themselves, of order 3n.

The embedded formula of order 3 also uses f at the start of the step, and is filtered so that it stays bounded for stiff
equations:

    err = (I - h gamma0 J)^-1 (gamma0 h f(t0, y0) + e1 z1 + e2 z2 + e3 z3),     gamma0 = 1/gamma

The derivative of a step follows from the implicit function theorem, with the Jacobians of the three stages:

    (A^-1 x I - diag(hJ_i)) dz = d(h F) at constant z.

Source: Hairer & Wanner, *Solving ODEs II*, §IV.5 (the method), §IV.8 (its implementation).

Simplified Newton iteration: one Jacobian, inverted once, for all iterations of an implicit step.

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
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

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

from lagjax.numerics import dense
from lagjax.numerics.runge_kutta import Interpolation

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
    `tests/numerics/methods/test_radau.py` counts steps and compares with diffrax's root finder.

    Source: Hairer & Wanner, *Solving ODEs II*, §IV.8, (8.9)-(8.11).
    """

    rtol: float
    atol: ArrayLike | Callable[[Array], Array]
    norm: Callable[[PyTree], Array] = optx.max_norm
    kappa: float | None = None
    slow: float = eqx.field(static=True, default=0.3)

    def init(
        self, fn: Callable, y: PyTree, args: PyTree, options, f_struct: PyTree, aux_struct, tags: frozenset
    ) -> Iteration:
        if "init_state" in options:
            return options["init_state"]
        return Iteration.first(_inverse_at(fn, y, args, options), y, here=True)

    def step(
        self, fn: Callable, y: PyTree, args: PyTree, options, state, tags: frozenset
    ) -> tuple[PyTree, Iteration, Any]:
        # A branch also under `vmap`: no Jacobian is computed unless a lane needs it.
        inverse = lax.cond(
            eqxi.unvmap_any(state.stale),
            lambda: jtu.tree_map(
                lambda new, old: jnp.where(state.stale, new, old), _inverse_at(fn, y, args, options), state.inverse
            ),
            lambda: state.inverse,
        )
        residual, aux = fn(y, args)
        correction = inverse(residual)
        new = jtu.tree_map(lambda y, d: y - d, y, correction)
        full = jtu.tree_map(jnp.add, new, options["offset"]) if "offset" in options else new

        def known(allowed: Array) -> Array:
            return jnp.where(allowed > 0, allowed, 1.0)

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

    def terminate(
        self, fn: Callable, y: PyTree, args: PyTree, options: dict | None, state, tags: frozenset
    ) -> tuple[Array, optx.RESULTS]:
        converged = self._converged(state)
        # An old Jacobian is recomputed first. Growth after that leads to another root as often as back.
        grows = (jnp.isfinite(state.previous) & ~(state.rate() < 1)) | ~jnp.isfinite(state.size)
        renewable = np.isfinite(self.slow)
        diverged = ~converged & (state.count > 0) & grows & (state.renewed if renewable else True)
        failure = optx.RESULTS.where(diverged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return converged | diverged, failure

    def postprocess(
        self, fn: Callable, y: PyTree, aux, args: PyTree, options: dict | None, state, tags: frozenset, result
    ):
        # A failed step is discarded by multiplying its derivative by zero, so it must be finite.
        return jtu.tree_map(lambda x: jnp.where(jnp.isfinite(x), x, 0), y), aux, {}


def _inverse_at(fn: Callable, y: PyTree, args: PyTree, options):
    if "inverse_at" in options:
        return options["inverse_at"](y)
    vector, unravel = ravel_pytree(y)
    return Inverse(dense.inverse(jax.jacfwd(lambda vector: ravel_pytree(fn(unravel(vector), args)[0])[0])(vector)))


def tolerance_of_the_controller():
    """The placeholder of diffrax for tolerances taken from the step-size controller."""
    return diffrax.with_stepsize_controller_tols(SimplifiedNewton)().rtol


# diffrax compares it by identity, which must survive copying and pickling a method.
copyreg.pickle(type(tolerance_of_the_controller()), lambda _: (tolerance_of_the_controller, ()))


def with_tolerances(
    solver: diffrax.AbstractSolver, rtol, atol, norm: Callable = optx.max_norm
) -> diffrax.AbstractSolver:
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
    return eqx.tree_at(
        lambda solver: [getattr(solver.root_finder, name) for name in missing],
        solver,
        [tolerances[name] for name in missing],
    )


# Hairer & Wanner II, table IV.5.6.
S6 = np.sqrt(6.0)
C = np.array([(4 - S6) / 10, (4 + S6) / 10, 1.0])
A = np.array(
    [
        [(88 - 7 * S6) / 360, (296 - 169 * S6) / 1800, (-2 + 3 * S6) / 225],
        [(296 + 169 * S6) / 1800, (88 + 7 * S6) / 360, (-2 - 3 * S6) / 225],
        [(16 - S6) / 36, (16 + S6) / 36, 1 / 9],
    ]
)
A_INVERSE = np.linalg.inv(A)


def _real_and_complex(matrix: Array):
    """(eigenvalue, right, left eigenvector) of a real 3 x 3 matrix: of the real one, and of one of the complex pair."""
    values, right = np.linalg.eig(matrix)
    left = np.linalg.inv(right)
    real, pair = np.argmin(np.abs(np.imag(values))), np.argmax(np.imag(values))
    # The scale of an eigenvector is free; it is chosen to make the first one real.
    phase = right[0, real] / abs(right[0, real])
    as_real = values[real].real, (right[:, real] / phase).real, (left[real] * phase).real
    return as_real, (values[pair], right[:, pair], left[pair])


(GAMMA, T_REAL, T_INVERSE_REAL), (LAMBDA, T_PAIR, T_INVERSE_PAIR) = _real_and_complex(A_INVERSE)
# gamma times the e of (8.19): as I - h gamma0 J = (gamma I - hJ)/gamma, err = (gamma I - hJ)^-1 (h f + E z).
E = np.array([-13 - 7 * S6, -13 + 7 * S6, -1.0]) / 3
# z(s) = (s, s^2, s^3) @ TO_POWERS @ z is the collocation polynomial: 0 at s = 0, and z_i at s = c_i.
TO_POWERS = np.linalg.inv(C[:, None] ** np.arange(1, 4))


class Radau5(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
    """Radau IIA, three stages: order 5, stage order 3, L-stable. For stiff equations and stiff springs.

    >>> import diffrax
    >>> import jax.numpy as jnp
    >>> decay = diffrax.ODETerm(lambda t, y, args: -1e6 * (y - jnp.cos(t)))
    >>> control = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    >>> sol = diffrax.diffeqsolve(decay, Radau5(), 0.0, 1.0, 0.1, jnp.array(0.0), stepsize_controller=control)
    >>> bool(jnp.abs(sol.ys[-1] - jnp.cos(1.0)) < 1e-5), int(sol.stats["num_steps"]) < 100
    (True, True)

    The state is any pytree of real arrays. Newton's iteration takes its tolerances from the step-size controller; with
    constant steps, pass them: `Radau5(root_finder=SimplifiedNewton(rtol=1e-10, atol=1e-12))`.

    `step_powers` (a prefix of the state; 0 by default) multiplies the error of each leaf by that power of h before it
    is compared with the tolerance: 1 for velocities, `Radau5(step_powers=(0, 1))`, as RADAU5 does for variables of
    index 2. In the limit of infinite stiffness velocities are such variables, and the number of steps is then
    independent of the stiffness: a pendulum on a spring of 1e8 takes 520 steps instead of 3,400 at rtol 1e-6, and 2,000
    instead of 62,000 at 1e-9. It is not the default: the weight depends on the unit of time, and it tolerates too large
    errors of fast velocities that no spring corrects: at the same tolerance dry friction (`tanh(v / 1e-3)`) is 40 to
    750 times less accurate.

    **Order** 5 at the ends of steps, 3 (with a uniform error of h^4) in `diffrax`'s interpolation between them;
    `lagjax.integrate` makes steps of order 5 there instead. The error estimate is of order 3. **Stability**: A- and
    L-stable, stiffly accurate: infinitely fast decay is damped in one step, and constraints that stiff forces
    approximate hold at the ends of steps. **Conserves** linear invariants only: it damps unresolved oscillations, and
    the energy of resolved ones by O(h^5) (a Gauss method does not). **Derivatives** of a step are exact in both modes.
    `tests/numerics/methods/test_radau.py` measures order, stability, step counts and derivatives.

    Source: Hairer & Wanner, *Solving ODEs II*, table IV.5.6 (the method), §IV.8, (8.2)-(8.5) (the Newton systems),
    (8.9)-(8.11) (its end), (8.17)-(8.20) (the error estimate).
    """

    root_finder: optx.AbstractRootFinder = diffrax.with_stepsize_controller_tols(SimplifiedNewton)()
    root_find_max_steps: int = 10
    step_powers: PyTree[int] = eqx.field(static=True, default=0)

    term_structure: ClassVar = diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable:
        return Collocation

    def order(self, terms: diffrax.AbstractTerm):
        return 5

    def error_order(self, terms: diffrax.AbstractTerm):
        return 4

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree) -> "LastStep":
        vector, _ = ravel_pytree(y0)
        return LastStep(jnp.zeros((3, *vector.shape), vector.dtype), t0, jnp.ones_like(t1 - t0), jnp.asarray(False))

    def func(self, terms: diffrax.AbstractTerm, t0: Array, y0: PyTree, args: PyTree):
        return terms.vf(t0, y0, args)

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
        # After a jump the last polynomial is a poor initial guess, but for a short step it tends to z = 0.
        del made_jump
        control = terms.contr(t0, t1)
        vector, unravel = ravel_pytree(y0)
        field = eqx.filter_closure_convert(terms.vf_prod, t0, y0, args, control)
        equations = Stages(field, t0, t1, control, vector, args, unravel)

        fixed = _frozen(equations)
        rate, jacobian = fixed.rate_and_jacobian()
        to_error, to_stages = _inverses(jacobian)
        finder = eqx.tree_at(lambda f: f.norm, self.root_finder, LargestOfStages(self.root_finder.norm, unravel))
        # Without a previous step: the first iteration from z = 0, where the Jacobian of the stages is already known.
        linear = to_stages(jnp.broadcast_to(rate, (3, rate.size)))
        start = jnp.where(solver_state.known, _initial_guess(solver_state, t0, t1 - t0), linear)
        z, result = _solved(equations, fixed=_frozen((start, to_stages, finder)), max_steps=self.root_find_max_steps)
        result = diffrax.RESULTS.promote(result)
        success = result == diffrax.RESULTS.successful

        y1 = unravel(vector + z[2])
        weights = jnp.abs(fixed.t1 - fixed.t0) ** self._powers_of_step(y0)
        error = weights * _error(fixed, _frozen(z), rate, to_error, _frozen(self.root_finder), weights)
        error = unravel(jnp.where(success, error, jnp.inf))
        dense_info = {"y0": y0, "stages": jax.vmap(unravel)(z)}
        return y1, error, dense_info, LastStep(_frozen(z), *_frozen((t0, t1 - t0)), jnp.asarray(True)), result

    def _powers_of_step(self, y: PyTree):
        leaves = jtu.tree_map(
            lambda power, y: jtu.tree_map(lambda x: np.full(np.shape(x), power, x.dtype), y), self.step_powers, y
        )
        return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(leaves)])


class LastStep(NamedTuple):
    """The stages of the last accepted step, its start and its length: they give the next initial guess."""

    z: Float[Array, "3 n"]
    t0: Float[Array, ""]
    dt: Float[Array, ""]
    known: Bool[Array, ""]


class Stages(eqx.Module):
    """The equations of the stages, with everything that they depend on."""

    field: Callable
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    control: PyTree
    y0: Float[Array, " n"]
    args: PyTree
    unravel: Callable

    def increment(self, t: Array, y: PyTree) -> Float[Array, " n"]:
        """h f(t, y)."""
        return ravel_pytree(self.field(t, self.unravel(y), self.args, self.control))[0]

    def increments(self, z: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        """h f at the stages."""
        return jax.vmap(self.increment)(self._times(), self.y0[None] + z)

    def _jacobians(self, z: Array):
        return jax.vmap(jax.jacfwd(self.increment, argnums=1))(self._times(), self.y0[None] + z)

    def matrix(self, z: Float[Array, "3 n"]) -> Float[Array, "3n 3n"]:
        """The Jacobian of the stages' equations: A^-1 x I - diag(h J_i)."""
        unit = jnp.eye(z.shape[1], dtype=z.dtype)
        return jnp.kron(jnp.asarray(A_INVERSE, z.dtype), unit) - jax.scipy.linalg.block_diag(*self._jacobians(z))

    def rate_and_jacobian(self):
        """h f and h J at the start of the step."""
        basis = jnp.eye(self.y0.size, dtype=self.y0.dtype)
        return jax.vmap(
            lambda dy: jax.jvp(lambda y: self.increment(self.t0, y), (self.y0,), (dy,)), out_axes=(None, 1)
        )(basis)

    def _times(self):
        # The last stage is exactly at the end of the step.
        inner = self.t0 + jnp.asarray(C[:2], self.t0.dtype) * (self.t1 - self.t0)
        return jnp.append(inner, self.t1)


def _inverses(jacobian: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Inverse]:
    """(gamma I - hJ)^-1, and (A^-1 x I - I x hJ)^-1 from that and one complex inverse."""
    unit = jnp.eye(jacobian.shape[0], dtype=jacobian.dtype)
    of_pair = {4: np.complex64, 8: np.complex128}[jacobian.dtype.itemsize]
    real = dense.inverse(float(GAMMA) * unit - jacobian)
    pair = dense.inverse(complex(LAMBDA) * unit.astype(of_pair) - jacobian.astype(of_pair))

    def outer(right: Any, left: Any, like: Array) -> Array:
        return jnp.asarray(np.outer(right, left), like.dtype)

    both = jnp.kron(outer(T_REAL, T_INVERSE_REAL, real), real)
    return real, Inverse(both + 2 * jnp.kron(outer(T_PAIR, T_INVERSE_PAIR, pair), pair).real)


class LargestOfStages(eqx.Module):
    """The largest norm of the three stages."""

    norm: Callable
    unravel: Callable

    def __call__(self, z: Float[Array, "3 n"]) -> Float[Array, ""]:
        """The norm of z."""
        return jnp.max(jax.vmap(lambda z: self.norm(self.unravel(z)))(z))


class Collocation(Interpolation):
    """The collocation polynomial, of degree 3: through the step's start and its three stages."""

    t0: Any
    t1: Any
    y0: PyTree
    stages: PyTree

    def at(self, t: Array):
        """The state at t."""
        length = self.t1 - self.t0
        s = jnp.where(length == 0, 0.0, (t - self.t0) / jnp.where(length == 0, 1.0, length))
        weights = _powers(s) @ TO_POWERS
        return jtu.tree_map(lambda y, z: y + jnp.tensordot(weights.astype(z.dtype), z, 1), self.y0, self.stages)


def _powers(s: Array):
    return jnp.stack([s, s**2, s**3], axis=-1)


def _initial_guess(last, t0: Array, dt: Array):
    """z of a step from t0 by the polynomial of the last step, extrapolated or evaluated inside it."""
    begin = (t0 - last.t0) / last.dt
    weights = (_powers(begin + C * (dt / last.dt)) - _powers(begin)[None]) @ TO_POWERS
    return weights.astype(last.z.dtype) @ last.z


def _frozen(tree: PyTree):
    return jtu.tree_map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _error(equations, z: Array, rate: PyTree, to_error: Array, finder, weights: Array):
    """The estimate of the local error; filtered again if it would reject the step."""
    weighted = jnp.asarray(E, z.dtype) @ z
    error = to_error @ (rate + weighted)
    y0 = equations.y0
    largest = jnp.maximum(jnp.abs(y0), jnp.abs(y0 + z[2]))
    scale = (finder.atol(largest) if callable(finder.atol) else finder.atol) + finder.rtol * largest
    rejects = finder.norm(equations.unravel(weights * error / jnp.where(scale > 0, scale, 1.0))) >= 1
    # (8.20): for a fast component that has already decayed, the estimate (8.19) is completely wrong.
    return lax.cond(
        rejects,
        lambda error: to_error @ (equations.increment(equations.t0, y0 + error) + weighted),
        lambda error: error,
        error,
    )


@eqx.filter_custom_jvp
def _solved(equations, *, fixed, max_steps: int | None):
    """The stages z, and the result of their iteration."""
    start, inverse, finder = fixed
    options = {
        "init_state": Iteration.first(inverse, start),
        "offset": equations.y0[None],
        "inverse_at": lambda z: Inverse(dense.inverse(equations.matrix(z))),
    }
    found = optx.root_find(
        lambda z, equations: jnp.asarray(A_INVERSE, z.dtype) @ z - equations.increments(z),
        finder,
        start,
        equations,
        options,
        max_steps=max_steps,
        throw=False,
    )
    # A failed step is discarded by multiplying its derivative by zero, so its Jacobians must be finite.
    success = found.result == optx.RESULTS.successful
    return jnp.where(success, found.value, 0.0), found.result


@_solved.def_jvp
def _solved_jvp(primals: Sequence, tangents: Sequence, *, fixed, max_steps: int | None):
    (equations,), (tangent,) = primals, tangents
    z, result = _solved(equations, fixed=fixed, max_steps=max_steps)
    _, forced = eqx.filter_jvp(lambda equations: equations.increments(z), (equations,), (tangent,))
    dz = dense.solve(equations.matrix(z), forced.reshape(-1)).reshape(z.shape)
    return (z, result), (dz, jtu.tree_map(lambda _: None, result))
