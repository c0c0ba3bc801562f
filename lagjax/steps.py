"""Many steps of one length, with a control that is held in each of them.

    x_{k+1} = step(x_k, u_k),    k = 0 ... N - 1

Reverse mode goes back over pieces of about √N steps: it keeps the state at the start of each piece, and runs a piece
again with all that its derivative needs. So memory grows with √N times what one step needs, and the steps are made
twice.

Source: Griewank & Walther, *Evaluating Derivatives*, ch. 12 (reversal by checkpoints).
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, PyTree

from lagjax.jaxtools import compiled, is_array, numpy_of, one_function_in_both_modes, shape_of, varies
from lagjax.numerics import ExplicitRungeKutta
from lagjax.steps.step import advanced, equations_for_steps, explicit_method, step_length
from lagjax.system import (
    Call,
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
    k its value is the k-th row of `controls`. It works under `jit`, `vmap`, `jax.grad` (reverse mode keeps √N states
    and runs N steps again), `jacfwd`, and in scans.

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
    run = partial(_run, method=method, count=count)
    states = one_function_in_both_modes(run, system, s, t[:-1], held, merge, dt)
    q, v = jtu.tree_map(lambda x0, x: jnp.concatenate([x0[None], x]), (s.q, s.v), states)
    return t, q, v


def _run(system: System, s: State, t: Array, held: PyTree, merge: Merge | None, dt: Array, method, count: int):
    """The states after each step."""
    inner = piece_length(count)
    outer = -(-count // inner)
    # Steps that fill up the last piece have no length, and repeat the last control.
    dts = jnp.where(np.arange(outer * inner) < count, dt, jnp.zeros_like(dt))
    rows = jtu.tree_map(lambda x: _pieces(x, outer, inner), (t, held))
    rows = *rows, dts.reshape(outer, inner)
    fixed = equations_for_steps(model_of(system, *s)) if merge is None else None

    def one(y: tuple, row: tuple):
        t, u, dt = row
        equations = fixed
        if merge is not None:
            equations = equations_for_steps(model_of(system, t, *y, merge(s.params, u)))
        y = advanced(equations, method, t, y, dt)
        return y, y

    @partial(jax.checkpoint, prevent_cse=False)
    def piece(y: tuple, rows: tuple):
        return lax.scan(one, y, rows)

    _, states = lax.scan(piece, (s.q, s.v), rows)
    return jtu.tree_map(lambda x: x.reshape(outer * inner, *x.shape[2:])[:count], states)


def _pieces(x: Array, outer: int, inner: int):
    missing = outer * inner - x.shape[0]
    x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))]) if missing else x
    return x.reshape(outer, inner, *x.shape[1:])


def piece_length(count: int) -> int:
    """Near √count, such that few steps are missing in the last piece.

    >>> [piece_length(count) for count in (64, 50, 53)]
    [8, 5, 6]
    """
    root = math.isqrt(count)
    near = range(max(1, root * 2 // 3), root * 3 // 2 + 1)
    return min(near, key=lambda length: (-count % length, abs(length - root)))


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
