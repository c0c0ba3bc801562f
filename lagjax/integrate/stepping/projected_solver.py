"""Any diffrax solver, kept on the constraints and accurate between its steps.

`ProjectedSolver` wraps a diffrax solver. After each step it returns the state to the constraint manifold, and
its dense output is a step of the solver itself: the state at t inside a step from t0 is one step from t0
to t. Outputs and event times therefore have the order of the method (Kvaerno5's own interpolant is cubic,
Dopri8's is of order six) and satisfy the constraints, at the cost of one step per output.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.stepping.step_to_outputs import between_jumps
from lagjax.integrate.stepping.tolerances import Tolerances
from lagjax.jaxtools import kept_as_call, one_function
from lagjax.mechanics import Equations, all_finite, to_manifold
from lagjax.numerics import Interpolation, Quintic, Radau5

# Without projection a state drifts off its constraints, and dependent ones then disagree by that much.
DEPENDENT_BELOW_WHILE_DRIFTING = 1e-3
# An output is a shorter step than the accepted one around it: its error should be smaller, not this much larger.
OUTPUT_TOLERANCES = 100.0
# A fixed step whose error is this share of the state is beyond the method's stability.
LOST = 0.3
NOT_FINITE = diffrax.RESULTS.nonfinite_input


class StageConstraints(NamedTuple):
    """The constraint equations that the vector field solves with, the same in all stages of one step."""

    independent: Bool[Array, " m"] | None


class Field(eqx.Module):
    """d(q, v)/dt = (v, a) by the robust solve; with Baumgarte's feedback, if its rate is given."""

    equations: Equations
    feedback: Float[Array, ""] | None = None

    def __call__(self, t: Array, y: PyTree, args: PyTree):
        independent = args.independent if isinstance(args, StageConstraints) else None
        a, _ = kept_as_call(self.equations.accelerations(t, *y, self.feedback, independent))
        return self.equations.velocities(t, *y), a


class FastField(eqx.Module):
    """The same by the fast, written-out equations, which may give NaN where the robust solve does not."""

    equations: Equations

    def __call__(self, t: Array, y: PyTree, args: PyTree):
        return self.equations.velocities(t, *y), self.equations.fast(t, *y)[0]


class ProjectedSolver(diffrax.AbstractWrappedSolver):
    """Wrap `solver`: project after each step (if `project`), and compute dense output by steps.

    A step that cannot be returned to the constraints is rejected; with fixed steps the solve ends there. `controlled`:
    the tolerances choose the steps. `arriving`: outputs are wanted only at the ends of steps; `between`: inside them,
    from a polynomial. The controller makes steps end at `jump_ts`; here each step is kept on its side of them.

    The solver holds the equations, since diffrax gives an interpolation only times and states; `fast`: the same method,
    for steps with the written-out equations. `feedback`: the rate of Baumgarte's feedback. If `refused`, and if a step
    is not finite, its error is infinite: an adaptive solve ends within a few steps at the smallest step size, one with
    fixed steps at once. `in_parts`: the robust step and the return to the constraints are machine functions of their
    own (`one_function`), which have no reverse mode.
    """

    solver: diffrax.AbstractSolver
    equations: Equations
    fast: diffrax.AbstractSolver | None
    feedback: Float[Array, ""] | None
    refused: Bool[Array, ""]
    tolerances: Tolerances
    controlled: bool = eqx.field(static=True)
    project: bool = eqx.field(static=True)
    arriving: bool = eqx.field(static=True)
    between: bool = eqx.field(static=True)
    jump_ts: Float[Array, " J"] | None = None
    in_parts: bool = eqx.field(static=True, default=False)

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    # diffrax reads the next three only if the wrapped solver is of the kind that has them.
    @property
    def scan_kind(self):
        return cast(diffrax.AbstractRungeKutta, self.solver).scan_kind

    @property
    def root_finder(self):
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_finder

    @property
    def root_find_max_steps(self):
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_find_max_steps

    @property
    def interpolation_cls(self) -> Callable:
        return self._between

    @property
    def terms(self) -> diffrax.AbstractTerm:
        """The vector field by the robust solve."""
        return diffrax.ODETerm(Field(self.equations, self.feedback))

    @property
    def fast_terms(self) -> diffrax.AbstractTerm:
        """The vector field by the written-out equations."""
        return diffrax.ODETerm(FastField(self.equations))

    def _between(self, *, t0: Array, t1: Array, y0: PyTree, y1: PyTree = None, state=None, a0=None, a1=None):
        if self.between:
            return Quintic(t0=t0, t1=t1, y0=y0, y1=y1, a0=a0, a1=a1)
        if self.arriving:
            return Arrived(t0=t0, t1=t1, y0=y0, y1=y1)
        return SteppedTo(t0=t0, t1=t1, y0=y0, state=state, solver=self)

    def order(self, terms: diffrax.AbstractTerm):
        return self.solver.order(terms)

    def strong_order(self, terms: diffrax.AbstractTerm):
        return self.solver.strong_order(terms)

    def error_order(self, terms: diffrax.AbstractTerm):
        return self.solver.error_order(terms)

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree):
        if self.fast is not None:
            return self.fast.init(self.fast_terms, t0, t1, y0, args)
        return self.solver.init(self.terms, t0, t1, y0, self._stages(t0, y0))

    def func(self, terms: diffrax.AbstractTerm, t0: Array, y0: PyTree, args: PyTree):
        # Only used to choose the first step, which has to be finite even where the motion is refused.
        if self.fast is not None:
            rate = self.fast_terms.vf(t0, y0, args)
        else:
            rate = self.solver.func(self.terms, t0, y0, self._stages(t0, y0))
        return jtu.tree_map(lambda f: jnp.where(self.refused | ~jnp.isfinite(f), 0.0, f), rate)

    def step(
        self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, args: PyTree, solver_state: PyTree,
        made_jump: Any,
    ):  # fmt: skip
        if self.jump_ts is not None:
            t0, t1, made_jump = between_jumps(t0, t1, self.jump_ts, made_jump)
        if self.fast is None:
            y1, error, rates, solver_state, result = self._robust_step(t0, t1, y0, solver_state, made_jump)
        else:
            y1, error, rates, solver_state, result = self._fast_step(t0, t1, y0, solver_state, made_jump)
        # An infinite state would make its error relative to it zero.
        failed = self.refused | ~all_finite((y1, error))
        y1 = jtu.tree_map(lambda y1, y0: jnp.where(failed, y0, y1), y1, y0)
        error = jtu.tree_map(lambda x: jnp.where(failed, jnp.inf, x), error)
        result = diffrax.RESULTS.where(failed & (result == diffrax.RESULTS.successful), NOT_FINITE, result)
        if rates is not None:
            return y1, error, {"y0": y0, "y1": y1, "a0": rates[0], "a1": rates[1]}, solver_state, result
        if self.arriving:
            return y1, error, {"y0": y0, "y1": y1}, solver_state, result
        # Newton's iteration for an output starts from the polynomial of the step around it.
        continued = solver_state if isinstance(self.solver, Radau5) else None
        return y1, error, {"y0": y0, "state": continued}, solver_state, result

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def _fast_step(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, made_jump: Any):
        fast, terms = self.fast, self.fast_terms
        assert fast is not None
        jumped = True if self.project else made_jump
        y1, error, dense, solver_state, result = fast.step(terms, t0, t1, y0, None, solver_state, jumped)
        rates = self._rates(dense, t1 - t0)
        if self.project:
            y1 = self.equations.projected(t1, *y1)
        if not self.equations.fallback:
            return y1, error, rates, solver_state, result
        valid = all_finite((y1, error))

        def again():
            y1, error, rates, _, result = self._robust_step(t0, t1, y0, None, True)
            return y1, error, rates, fast.init(terms, t1, t1, y1, None), result

        # A branch also in a batch, where all lanes take it or none.
        return lax.cond(eqxi.unvmap_all(valid), lambda: (y1, error, rates, solver_state, result), again)

    def _robust_step(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, made_jump: Any):
        call = one_function if self.in_parts else _called
        # The projection moves the state, so a derivative kept from the last step's end is stale.
        jumped = True if self.project else made_jump
        moved = call(ProjectedSolver._unprojected, self, t0, t1, y0, solver_state, jumped)
        y1, error, dense, solver_state, result = moved
        rates = self._rates(dense, t1 - t0)
        if self.project:
            projected = call(to_manifold, self.equations, t1, *y1, *self.tolerances)
            y1 = (projected.q, projected.v)
            error = jtu.tree_map(lambda x: jnp.where(projected.holds, x, jnp.inf), error)
            result = diffrax.RESULTS.where(projected.holds, result, diffrax.RESULTS.nonlinear_divergence)
        return y1, error, rates, solver_state, result

    def _unprojected(self, t0: Array, t1: Array, y0: PyTree, solver_state: PyTree, jumped: Any):
        """The wrapped solver's step by the robust solve."""
        terms, stages = self.terms, self._stages(t0, y0)
        if solver_state is None:
            solver_state = self.solver.init(terms, t0, t1, y0, stages)
        return self.solver.step(terms, t0, t1, y0, stages, solver_state, jumped)

    def _rates(self, dense: dict, h: Array):
        """The accelerations at both ends of a step, which are its first and last stages; None if not needed."""
        if not self.between:
            return None
        step = jnp.where(h == 0, 1.0, h)
        return tuple(jtu.tree_map(lambda k, i=i: k[i] / step, dense["k"][1]) for i in (0, -1))

    def again(self, t0: Array, t1: Array, y0: PyTree):
        """Repeat an accepted step from its start, fast if possible.

        Return its end and the accelerations at both ends (None if not `between`), and whether that is finite.
        """
        if self.fast is None:
            return self.again_robustly(t0, t1, y0)
        if self.jump_ts is not None:
            t0, t1, _ = between_jumps(t0, t1, self.jump_ts, True)
        y1, error, dense, *_ = self.fast.step(self.fast_terms, t0, t1, y0, None, None, True)
        y1 = self.equations.projected(t1, *y1) if self.project else y1
        return (y1, self._rates(dense, t1 - t0)), all_finite((y1, error))

    def again_robustly(self, t0: Array, t1: Array, y0: PyTree):
        """The same with the robust solve."""
        if self.jump_ts is not None:
            t0, t1, _ = between_jumps(t0, t1, self.jump_ts, True)
        y1, _, rates, *_ = self._robust_step(t0, t1, y0, None, True)
        return (y1, rates), jnp.asarray(True)

    def acceptable(self, y0: PyTree, y1: PyTree, error):
        """Whether an output's error is not far above the tolerance; the controller does not check steps to outputs.

        With fixed steps there is no tolerance; beyond a method's limit of stability the error is as large as the state.
        """
        if error is None:
            return True
        rtol, atol = (self.tolerances.rtol[0], self.tolerances.atol[0]) if self.controlled else (0.0, 0.0)
        share = OUTPUT_TOLERANCES * rtol if self.controlled else LOST

        def largest(tree: PyTree):
            return jnp.max(jnp.abs(ravel_pytree(tree)[0]))

        of_parts = [largest(e) <= OUTPUT_TOLERANCES * atol + share * largest((a, b)) for a, b, e in zip(y0, y1, error)]
        return of_parts[0] & of_parts[1]

    def _stages(self, t: Array, y: PyTree):
        threshold = None if self.project else DEPENDENT_BELOW_WHILE_DRIFTING
        return StageConstraints(self.equations.independent(t, *y, threshold))


def _called(function: Callable, *args):
    return function(*args)


class Arrived(Interpolation):
    """The state at the ends of a step, where all outputs are; only the first output is at a start."""

    t0: PyTree
    t1: PyTree
    y0: PyTree
    y1: PyTree

    def at(self, t: Array):
        return jtu.tree_map(lambda y0, y1: jnp.where(t <= self.t0, y0, y1), self.y0, self.y1)


class SteppedTo(Interpolation):
    """The state inside a step, by one step of the solver from the step's start; NaN if that step fails."""

    t0: PyTree
    t1: PyTree
    y0: PyTree
    state: PyTree
    solver: ProjectedSolver

    def at(self, t: Array):
        s = self.solver
        # diffrax's program contains this three times, each compiled: the robust step alone compiles in a third of the
        # time of both, and costs little at run time, since most outputs are ends of steps.
        t0, made_jump = self.t0, False
        if s.jump_ts is not None:
            t0, t, made_jump = between_jumps(t0, t, s.jump_ts, made_jump)
        y, error, *_, result = s._robust_step(t0, t, self.y0, self.state, made_jump)
        valid = (result == diffrax.RESULTS.successful) & s.acceptable(self.y0, y, error)
        return jtu.tree_map(lambda x: jnp.where(valid, x, jnp.nan), y)


def forward_differentiable(method: diffrax.AbstractSolver):
    """A method whose stage loop can be differentiated forward even inside a reverse-mode solve.

    An event time is an implicit function of the step, and its derivative needs ∂y/∂t forward. Such a loop also
    traces in half the time of a checkpointed one, and runs backwards as fast.
    """
    if not isinstance(method, diffrax.AbstractRungeKutta) or method.scan_kind is not None:
        return method
    return eqx.tree_at(lambda s: s.scan_kind, method, "bounded", is_leaf=lambda x: x is None)
