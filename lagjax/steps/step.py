"""One step of a fixed length: what a training or control loop is made of.

    (q, v) at t   ->   an explicit Runge-Kutta step of d(q, v)/dt = (v, a)   ->   returned to the constraints at t + dt

The accelerations and the return to the constraints are those of `lj.integrate`: written out number by number for a
small system, and in arrays otherwise or where those fail. Nothing controls the step, and nothing estimates its error.
"""

from typing import Any

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import compiled, is_traced, kept_as_call, numpy_of, one_function_in_both_modes
from lagjax.mechanics import Equations, all_finite, equations_of, to_manifold
from lagjax.numerics import RK4, ExplicitRungeKutta, in_our_form
from lagjax.system import Model, State, System, check_system, coordinates, model_of, traced_system, with_rates

# A state counts as returned to the constraints within so many units of round-off; else it is NaN.
ROUND_OFFS = 1e4
DEFAULT = RK4()


def step(
    system: System,
    t: ArrayLike,
    q: PyTree[ArrayLike],
    v: PyTree[ArrayLike],
    params: PyTree,
    dt: ArrayLike,
    *,
    method: diffrax.AbstractSolver | None = None,
) -> tuple[Array, PyTree[Array], PyTree[Array]]:
    """Make one step of the length `dt`, and return the next state (t + dt, q, v).

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t, q, v = step(fall, 0.0, 0.0, 3.0, {"g": 10.0}, 0.5)  # q = 3 t - 5 t², v = 3 - 10 t
    >>> print(t, q.round(9), v.round(9))
    0.5 0.25 -2.0

    One compiled program; inside `jit`, `vmap`, `jax.grad`, `jacfwd` or a `lax.scan` it is part of that. For many steps
    in a row `lj.rollout` is faster.

    **Arguments:**

    - `system`: the `System`. Its forces may depend on t and v; where they jump (`jnp.where`), a step does not stop.
    - `t` scalar, `q` and `v` alike: a state that satisfies the constraints; `params` as L takes it. A control is
      whatever the force reads from `params`, held in the step.
    - `dt`: the length of the step, `[t]`; negative to step back. It may be traced.
    - `method`: `lj.RK4()` (the default, four evaluations), `lj.Tsit5()` or `lj.Dopri8()`. With constraints each step is
      followed by the return of q and v to them (`mechanics/consistent_state.py`), at which they hold to round-off.

    **Returns:** the time, the position and the velocity, in the dtype of the state; NaN where the mass
    matrix is singular (or, without constraints, neither definite nor dominated by its diagonal), or a step is too long
    to be returned to the constraints. Nothing is raised at run time.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind, shape or dtype; for a `Hybrid`, whose steps would have
      to end at its switches, as those of `lj.integrate` do.

    Order: that of the method, with constraints too; `tests/steps/test_step.py` measures it. Derivatives are those of
    the step; with constraints the change of the matrix that returns it is left out, an error of the method's order.

    Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.1; Hairer, Lubich & Wanner, *Geometric Numerical
    Integration*, §IV.4 (projection).
    """
    check_system(system, t, q, v, params)
    method = explicit_method(method)
    s = coordinates.prepared(t, q, with_rates(system, q, v), params)
    return _stepped(traced_system(system, s), s, step_length(dt, s.t.dtype), method)


@compiled
def _stepped(system: System, s: State, dt: Array, method: ExplicitRungeKutta):
    return one_function_in_both_modes(_step, system, s, dt, method)


def _step(system: System, s: State, dt: Array, method: ExplicitRungeKutta):
    equations = equations_for_steps(model_of(system, *s))
    return s.t + dt, *advanced(equations, method, s.t, (s.q, s.v), dt)


def equations_for_steps(model: Model) -> Equations:
    """The equations of a model; with constraints, which may depend on each other, also those of the robust way."""
    # Without the robust way a program compiles in a third of the time, and a definite mass matrix does not need it.
    return equations_of(model, fast=True, fallback=bool(model.m))


def advanced(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array) -> tuple:
    """The state (q, v) after a step from t to t + dt."""
    y0 = tuple(map(equations.inside, y))
    if equations.written is None:
        y1 = _robust(equations, method, t, y0, dt)
    else:
        y1 = _fast(equations, method, t, y0, dt)
    return jax.tree.map(lambda x, old: x.astype(old.dtype), tuple(map(equations.outside, y1)), tuple(y))


def _fast(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array):
    y1 = _explicit(method, lambda t, y: (equations.velocities(t, *y), equations.fast(t, *y)[0]), t, y, dt)
    if equations.model.is_returned:
        y1 = equations.projected(t + dt, *y1)
    if not equations.fallback:
        return y1
    # A branch also in a batch, where all lanes take it or none.
    valid = eqxi.unvmap_all(all_finite(y1))
    return lax.cond(valid, lambda: y1, lambda: _robust(equations, method, t, y, dt))


def _robust(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array):
    independent = equations.independent(t, *y)

    def rates(t: Array, y: tuple):
        return equations.velocities(t, *y), kept_as_call(equations.accelerations(t, *y, None, independent))[0]

    y1 = _explicit(method, rates, t, y, dt)
    if not equations.model.is_returned:
        return y1
    round_off = jnp.asarray(ROUND_OFFS * jnp.finfo(dt.dtype).eps, dt.dtype)
    found = to_manifold(equations, t + dt, *y1, round_off, round_off)
    return jax.tree.map(lambda x: jnp.where(found.holds, x, jnp.nan), (found.q, found.v))


class _Rate(diffrax.AbstractTerm):
    """d(q, v)/dt, for steps of the length dt: the difference of two times would be rounded."""

    rates: Any
    dt: Array

    def vf(self, t: Array, y: tuple, args: Any):
        return self.rates(t, y)

    def contr(self, t0: Array, t1: Array, **kwargs):
        return self.dt

    def prod(self, vf: PyTree, control: Array):
        return jax.tree.map(lambda k: k * control, vf)


def _explicit(method: ExplicitRungeKutta, rates: Any, t: Array, y: tuple, dt: Array):
    return method.step(_Rate(rates, dt), t, t + dt, y, None, None, True)[0]


def explicit_method(method: Any) -> ExplicitRungeKutta:
    """The method for steps of a fixed length, `RK4` by default; raise unless it is one of lagjax's explicit ones."""
    ours = DEFAULT if method is None else method if isinstance(method, ExplicitRungeKutta) else None
    if ours is None and isinstance(method, diffrax.AbstractSolver):
        ours = in_our_form(method)
    if ours is None:
        given = f"the class {method.__name__}" if isinstance(method, type) else f"a {type(method).__name__}"
        raise TypeError(
            f"method must be lj.RK4(), lj.Tsit5() or lj.Dopri8() for steps of a fixed length, and is {given}.\n"
            "Usual cause: an implicit method, one of diffrax's that lagjax has no form of, or missing brackets.\n"
            "Fix: leave method out (lj.RK4()); or lj.integrate(..., method=method, "
            "stepsize_controller=diffrax.ConstantStepSize(), dt0=dt)."
        )
    return ours


def step_length(dt: Any, dtype: DTypeLike):
    """`dt` as an array of one number; raise unless it is a finite one."""
    number = isinstance(dt, int | float | np.ndarray | np.generic | jax.Array) and not isinstance(dt, bool)
    if not number or np.ndim(dt) or not (is_traced(dt) or np.isfinite(dt)):
        raise ValueError(
            f"dt must be one finite number, the length of each step, not {dt!r:.60}.\n"
            "Usual cause: the output times in its place, or arguments in another order.\n"
            "Fix: dt=0.01."
        )
    return numpy_of(dt).asarray(dt, dtype)
