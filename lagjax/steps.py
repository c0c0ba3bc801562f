"""Steps of a fixed length, what a training or control loop is made of: one, or many with held controls.

    (q, v) at t   ->   an explicit Runge-Kutta step of d(q, v)/dt = (v, a)   ->   returned to the constraints at t + dt

The accelerations and the return to the constraints are those of `lj.integrate`: written out number by number for a
small system, and in arrays otherwise or where those fail. Nothing controls the step, and nothing estimates its error.

**Many steps of one length, with a control that is held in each of them.**

    x_{k+1} = step(x_k, u_k),    k = 0 ... N - 1

Reverse mode goes back from one state to the one before, and makes each step again from the state at which it began,
with all that its derivative needs (`jaxtools/many_steps.py`): its memory is that of the states and of one step.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import (
    compiled,
    is_array,
    is_traced,
    numpy_of,
    one_function_in_both_modes,
    shape_of,
    steps_in_both_modes,
    varies,
)
from lagjax.mechanics import Equations, all_finite, equations_of, to_manifold
from lagjax.numerics import RK4, ExplicitRungeKutta, in_our_form
from lagjax.refusals import must, shown
from lagjax.system import (
    Call,
    Model,
    State,
    System,
    Traced,
    check_system,
    coordinates,
    model_of,
    traced_call,
    traced_system,
    with_rates,
)

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
      followed by the return of q and v to them (`mechanics/constrained_state.py`), at which they hold to round-off.

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
    return equations_of(model, fast=True, fallback=bool(model.m), apart=True)


def advanced(
    equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array, way: Callable | None = None
) -> tuple:
    """The state (q, v) after a step from t to t + dt; by one `way` alone, or by the robust one where the fast fails."""
    way = way or (_robust if equations.written is None else _fast_or_robust)
    y1 = way(equations, method, t, tuple(map(equations.inside, y)), dt)
    return jax.tree.map(lambda x, old: x.astype(old.dtype), tuple(map(equations.outside, y1)), tuple(y))


def _fast(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array):
    y1 = _explicit(method, lambda t, y: (equations.velocities(t, *y), equations.fast(t, *y)[0]), t, y, dt)
    return equations.projected(t + dt, *y1) if equations.model.is_returned else y1


def _fast_or_robust(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array):
    y1 = _fast(equations, method, t, y, dt)
    if not equations.fallback:
        return y1
    # A branch also in a batch, where all lanes take it or none.
    valid = eqxi.unvmap_all(all_finite(y1))
    return lax.cond(valid, lambda: y1, lambda: _robust(equations, method, t, y, dt))


def _robust(equations: Equations, method: ExplicitRungeKutta, t: Array, y: tuple, dt: Array):
    independent = equations.independent(t, *y)

    def rates(t: Array, y: tuple):
        return equations.velocities(t, *y), equations.accelerations_alone(t, *y, None, independent)

    # Beside the fast way this one is compiled in vain for nearly all motions: in a loop, with one copy of a network in
    # the force in place of four.
    y1 = _explicit(method, rates, t, y, dt, in_a_loop=equations.written is not None)
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


def _explicit(method: ExplicitRungeKutta, rates: Any, t: Array, y: tuple, dt: Array, in_a_loop: bool = False):
    return replace(method, in_a_loop=in_a_loop).step(_Rate(rates, dt), t, t + dt, y, None, None, True)[0]


def explicit_method(method: Any) -> ExplicitRungeKutta:
    """The method for steps of a fixed length, `RK4` by default; raise unless it is one of lagjax's explicit ones."""
    ours = DEFAULT if method is None else method if isinstance(method, ExplicitRungeKutta) else None
    if ours is None and isinstance(method, diffrax.AbstractSolver):
        ours = in_our_form(method)
    if ours is None:
        raise TypeError(
            f"method must be lj.RK4(), lj.Tsit5() or lj.Dopri8() for steps of a fixed length, not {shown(method)}.\n"
            "Usual cause: an implicit method, one of diffrax's that lagjax has no form of, or missing brackets.\n"
            "Fix: leave method out (lj.RK4()); or lj.integrate(..., method=method, "
            "stepsize_controller=diffrax.ConstantStepSize(), dt0=dt)."
        )
    return ours


def step_length(dt: Any, dtype: DTypeLike):
    """`dt` as an array of one number; raise unless it is a finite one."""
    number = isinstance(dt, int | float | np.ndarray | np.generic | jax.Array) and not isinstance(dt, bool)
    well = number and not np.ndim(dt) and (is_traced(dt) or np.isfinite(dt))
    cause = "the output times in its place, or arguments in another order"
    must(well, "dt must be one finite number, the length of each step", dt, "dt=0.01", cause)
    return numpy_of(dt).asarray(dt, dtype)


def rollout(
    system: System,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree,
    controls: int | PyTree[ArrayLike],
    dt: ArrayLike,
    *,
    t0: ArrayLike = 0.0,
    method: diffrax.AbstractSolver | None = None,
    with_control: Callable[[PyTree, PyTree], PyTree] | None = None,
) -> tuple[Array, PyTree[Array], PyTree[Array]]:
    """Make steps of the length `dt`, with one control in each: N controls, N + 1 states, x₀ ... x_N.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> cart = lj.System(
    ...     lambda t, q, v, params: 0.5 * params["m"] * v**2,
    ...     force=lambda t, q, v, params: params["push"],
    ... )
    >>> push = jnp.array([2.0, 0.0, -2.0])  # for one second each
    >>> t, q, v = rollout(cart, 0.0, 0.0, {"m": 1.0}, {"push": push}, 1.0)
    >>> print(q.round(9), v.round(9))
    [0. 1. 3. 4.] [0. 2. 2. 0.]

    A control is an entry of `params`, which L, the force, the dissipation and the constraints read by its name; in step
    k its value is the k-th row of `controls`. It works under `jit`, `vmap`, `jax.grad` (reverse mode makes each step
    once more), `jacfwd`, and in scans.

    **Main arguments:**

    - `system`: the `System`. Where its forces jump (`jnp.where`), a step does not stop.
    - `q0`, `v0`: the first state x₀, any pytree of numbers and arrays, alike; it has to satisfy the constraints.
    - `params`: what L takes, without the controls; an entry of the same name is replaced.
    - `controls`: a dict of arrays (N, ...) by name; or the number of steps N, if there is nothing to control.
    - `dt`: the length of a step, `[t]`; negative to step back.

    **Other arguments:**

    - `t0`: the time of x₀, `[t]`. Step k begins at `t0 + k dt`.
    - `method`: as in `lj.step`: `lj.RK4()` by default.
    - `with_control(params, u)`: returns the parameters for a step with the control u, in place of
      `{**params, **u}`: for `params` that are no dict, or a control law with parameters of its own. `controls` is then
      any pytree of arrays (N, ...), and u a row of each.

    **Returns:** the times (N + 1,) and the states q, v, each array with a leading axis of N + 1, the start among them;
    in the dtype of the start. `q[1:]` are the states after each step. NaN as in `lj.step`.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind, shape or dtype; controls of different lengths; a
      control that nothing in the system reads; a `Hybrid`.

    Order: that of the method if a control is smooth inside steps, as one that is held is.

    Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.1.
    """
    check_system(system, q0, v0, params)
    method = explicit_method(method)
    s = coordinates.prepared(t0, q0, with_rates(system, q0, v0), params)
    dtype = s.t.dtype
    held, count = _rows(controls, dtype)
    merge, by_name = None, False
    if held is not None:
        by_name = with_control is None
        if by_name:
            check_names(s.params, held)
        first = jtu.tree_map(lambda u: jax.ShapeDtypeStruct(u.shape[1:], u.dtype), held)
        call = Call("with_control", with_control or merge_by_name, ("params", "u"))
        # Checked as it is; what it returns besides arrays, as the functions in a network, is the same in all steps.
        traced_call(call, {"params": s.params, "u": first}, _is_anything, "a function of u alone")
        in_step = shape_of(call.function, s.params, first)
        arrays = call._replace(function=partial(_arrays_of, call.function))
        arrays = traced_call(arrays, {"params": s.params, "u": first}, _is_anything)
        merge = Merge(arrays, eqx.filter(in_step, varies, inverse=True))
        s_in_step = s._replace(params=in_step)
    else:
        s_in_step = s
    found = traced_system(system, s_in_step)
    return _rolled(found, s, held, merge, step_length(dt, dtype), method, count, by_name)


class Merge(eqx.Module):
    """The parameters of a step with the control u: their `arrays`, and the `rest`."""

    arrays: Traced
    rest: PyTree

    def __call__(self, params: PyTree, u: PyTree) -> PyTree:
        return eqx.combine(self.arrays(params, u), self.rest)


@compiled
def _rolled(
    system: System, s: State, held: PyTree, merge: Merge | None, dt: Array, method: ExplicitRungeKutta, count: int,
    by_name: bool,
):  # fmt: skip
    if by_name and count:
        assert merge is not None
        check_read(system, s, held, merge)
    if not count:
        return jtu.tree_map(lambda x: jnp.asarray(x)[None], tuple(s[:3]))
    t = s.t + np.arange(count + 1) * dt
    params = s.params if merge is None else merge(s.params, jtu.tree_map(lambda u: u[0], held))
    equations = equations_for_steps(model_of(system, *s[:3], params))
    if merge is None:
        # What does not depend on the state is prepared once.
        step, fixed = _next, (equations,)
    else:
        step, fixed = _next_with_control, (system, s.params, merge)
    # Many steps are made the fast way, and all once more the robust way if one of them fails: a step of both would be
    # compiled, and differentiated, with a branch.
    ways = (_fast, _robust) if equations.fallback else (_robust if equations.written is None else _fast,)
    steps = [partial(step, method=method, way=way) for way in ways]
    # Each row has the length of its step: one that is known XLA writes into the stages, which it then computes again
    # for each use. Lanes of a double pendulum take 1.7 times as long.
    states = steps_in_both_modes(steps, (s.q, s.v), (t[:-1], jnp.broadcast_to(dt, (count,)), held), fixed)
    q, v = jtu.tree_map(lambda x0, x: jnp.concatenate([x0[None], x]), (s.q, s.v), states)
    return t, q, v


def _next(y: tuple, row: tuple, fixed: tuple, method: ExplicitRungeKutta, way: Callable):
    (t, dt, _), (equations,) = row, fixed
    return advanced(equations, method, t, y, dt, way)


def _next_with_control(y: tuple, row: tuple, fixed: tuple, method: ExplicitRungeKutta, way: Callable):
    (t, dt, u), (system, params, merge) = row, fixed
    return advanced(equations_for_steps(model_of(system, t, *y, merge(params, u))), method, t, y, dt, way)


def _rows(controls: Any, dtype: DTypeLike):
    """The controls as arrays, and the number of steps; None in place of the controls if that alone was given."""
    if isinstance(controls, int | np.integer) and not isinstance(controls, bool) and controls >= 0:
        return None, int(controls)
    found = jtu.tree_map(partial(_as_rows, dtype=dtype), controls)
    lengths = {x.shape[0] if x.ndim else None for x in jtu.tree_leaves(found)}
    if len(lengths) != 1 or None in lengths:
        shapes = jtu.tree_map(np.shape, controls)
        raise ValueError(
            f"controls must be arrays with one row for each step, as many in all, and have shapes {shapes!s:.200}.\n"
            "Usual cause: one value for all steps, which belongs into params; two lengths; or 1e3 steps, a float.\n"
            'Fix: controls={"torque": jnp.zeros(100)} for 100 steps; or controls=100 if there is nothing to control.'
        )
    return found, lengths.pop()


def _as_rows(x: Any, dtype: DTypeLike):
    x = numpy_of(x).asarray(x)
    if x.dtype.kind not in "fiub" and not jnp.issubdtype(x.dtype, jnp.floating):
        raise TypeError(
            f"controls hold {x.dtype}, and must be real numbers, or the number of steps.\n"
            "Usual cause: a number of steps that is no whole number, as 1e3; or text.\nFix: controls=1000."
        )
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def _arrays_of(function: Callable, params: PyTree, u: PyTree):
    return eqx.filter(function(params, u), is_array)


def merge_by_name(params: PyTree, u: PyTree):
    """The parameters with the controls among them."""
    return {**(params or {}), **u}


def check_names(params: PyTree, held: PyTree):
    """Raise if the controls or the parameters have no names."""
    if isinstance(held, Mapping) and (params is None or isinstance(params, Mapping)):
        return
    which = "controls" if not isinstance(held, Mapping) else "params"
    raise TypeError(
        f"a control is an entry of params by its name, and {which} is no dict.\n"
        "Usual cause: an array of controls, or a module in params.\n"
        'Fix: controls={"torque": controls}, with a force that reads params["torque"]; or '
        'with_control=lambda params, u: {**params, "torque": u}.'
    )


def check_read(system: System, s: State, held: PyTree, merge: Callable):
    """Raise if no function of the system reads a control."""

    def functions(u: PyTree):
        model = model_of(system, *s[:3], merge(s.params, u))
        x, v = model.vectors(s.q, s.v)
        values = [model.lagrangian(s.t, x, v)]
        values += [c.residual(*s[:3], model.params) for c in system.constraints.values()]
        values += [] if system.force is None else [model.force(s.t, x, v)]
        return values + ([] if system.dissipation is None else [model.dissipation(s.t, x, v)])

    program = jax.make_jaxpr(functions)(jtu.tree_map(lambda u: u[0], held)).jaxpr
    read = {id(x) for equation in program.eqns for x in equation.invars} | {id(x) for x in program.outvars}
    leaves = jtu.tree_leaves_with_path(held)
    are_read = {jtu.keystr(path[:1], simple=True) for (path, _), x in zip(leaves, program.invars) if id(x) in read}
    for name in sorted({jtu.keystr(path[:1], simple=True) for path, _ in leaves} - are_read):
        raise ValueError(
            f"nothing in the system reads the control '{name}'.\n"
            "Usual cause: a name written in two ways, or a system without its force.\n"
            f'Fix: force=lambda t, q, v, params: params["{name}"], which returns a force for each coordinate.'
        )


def _is_anything(call: Call, value: Any):
    pass
