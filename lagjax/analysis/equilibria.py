"""Where a system rests, and how it moves steadily: equilibria and relative equilibria.

The equations are those of `balance.py`; `numerics/roots.py` solves them from several starts at once. A solution counts
as an equilibrium if its imbalance is negligible compared with the effect of a displacement as large as the coordinates,

    |r_i| <= ε Σ_j |∂r_i/∂y_j| Y_j

so that neither a minimum of |r| that is not a root nor a far point where forces have merely faded is taken for one.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, PyTree

from lagjax.analysis import balance as equations
from lagjax.analysis.balance import MOMENTUM, VELOCITY, Steady
from lagjax.analysis.found_equilibria import (
    CONSTRAINED,
    NO_BALANCE,
    NOT_FINITE,
    NOT_LASTING,
    OK,
    UNFINISHED,
    Equilibria,
    Row,
    merged,
)  # fmt: skip
from lagjax.analysis.starts import checked, stacked, stacked_one, symmetries_of
from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.refusals import by_name, check_system
from lagjax.mechanics.structure import angles, is_autonomous
from lagjax.motion.consistency import stopped
from lagjax.numerics import lapack
from lagjax.numerics.roots import MOST, differentiable, least_squares_root, zero_below

# The largest imbalance of an equilibrium, relative to the effect of a displacement as large as the coordinates.
BALANCED = {np.dtype("float64"): 1e-7, np.dtype("float32"): 1e-3}
# A search that moves this many times farther out than its start has failed: forces only fade there.
FAR = 1e9
# A growth rate below this fraction of the fastest root is round-off: double roots are off by the root of round-off.
GROWS_ABOVE = {np.dtype("float64"): 1e-7, np.dtype("float32"): 2e-3}


@by_name("lj.equilibria(system, params, starts=[q])", "starts")
def equilibria(
    system,
    params: PyTree = None,
    *,
    starts: PyTree[ArrayLike],
    velocities: PyTree[ArrayLike] | None = None,
    cyclic: str | Callable | Iterable | None = None,
    hold: str | None = VELOCITY,
    t: ArrayLike = 0.0,
) -> Equilibria:
    """Find where a system rests, or moves steadily, near each of the starts.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    >>> found = lj.equilibria(pendulum, {"g": 9.81}, starts=[0.3, 3.0])
    >>> print(found.q.round(6) + 0.0, found.stable)
    [0.       3.141593] [ True False]

    A bead on a hoop that turns freely, at 2 rad/s; the angle's cosine is g/(a ω²):

    >>> hoop = lj.System(lambda t, q, v, params: (0.5 * v["psi"]**2 + 0.5 * (jnp.sin(q["psi"]) * v["turn"])**2
    ...                                           + params["g"] * jnp.cos(q["psi"])))
    >>> steady = lj.equilibria(hoop, {"g": 2.0}, starts={"psi": 1.0, "turn": 0.0},
    ...                        velocities={"psi": 0.0, "turn": 2.0})
    >>> print(jnp.cos(steady.q["psi"]).round(6))
    [0.5]

    **Arguments:**

    - `params`: as the system takes it.
    - `starts`: a list of positions like q, `[q]` for one; or one tree like q whose leaves have a leading axis, with one
      entry for each start.
    - `velocities`: like v, one for all starts or one for each; zero by default. Coordinates with a nonzero velocity
      move steadily.
    - `cyclic`: what moves steadily: names of cyclic coordinates; or functions `motion(q, params)` -> like v, the
      velocity along a symmetry at unit rate, as `{"x": -q["y"], "y": q["x"]}` for a rotation. By default the
      coordinates with a nonzero velocity; while JAX traces `velocities` they must be named.
    - `hold`: `"velocity"` holds the rate of each cyclic motion at that of the start, `"momentum"` its momentum. `None`
      holds neither, where a constraint, or a force that depends on velocities, determines the rate.
    - `t`: the time of the balance; a balance that does not last is reported.

    **Returns:** `Equilibria`: the equilibria found, with duplicates merged (also angles that differ by whole turns),
    differentiable by `params`; and the outcome of each start. Under `jit`, `vmap` and `grad` nothing is merged: there
    is one row for each start, and `found` says which of them are equilibria.

    **Raises:** `TypeError`, `ValueError` for starts of the wrong structure, for an L that depends on a coordinate named
    in `cyclic`, and what `lj.accelerations` raises about functions that cannot be called.

    Source: Marsden & Ratiu, *Introduction to Mechanics and Symmetry*, §8.9; Goldstein, Eq. (6.1); Nocedal & Wright,
    *Numerical Optimization*, §10.3.
    """
    check_system(system, params, starts)
    q = stacked(starts)
    count = jax.tree.leaves(q)[0].shape[0]
    zeros = lambda x: coordinates.numpy_of(x).zeros_like(x)
    v = jax.tree.map(zeros, q) if velocities is None else _velocities(velocities, q, count)
    first = jax.tree.map(lambda x: x[0], (q, v))
    try:
        system, s = checked(system, t, *first, params)
    except (TypeError, ValueError, IndexError):
        if isinstance(starts, list) or velocities is not None or not _is_a_state(system, t, starts, params):
            raise
        return equilibria(system, params, starts=[starts], cyclic=cyclic, hold=hold, t=t)
    moving = None if velocities is None or coordinates.is_traced(v) else _moving(v, count)
    if cyclic is None and velocities is not None and moving is None:
        raise ValueError(
            "JAX is tracing the velocities, so it is not known which coordinates move.\n"
            'Fix: name them, lj.equilibria(..., cyclic=["psi"]).'
        )
    symmetries = symmetries_of(system, s, cyclic, hold, moving)
    # A function may close over traced values although no argument is traced.
    steady = Steady(system, s.t, s.params, np.zeros(symmetries.count, s.t.dtype), s.q, symmetries)
    q, v = jax.tree.map(lambda x: x.astype(s.t.dtype), (q, v))
    lasting = not symmetries.count and is_autonomous(system, *s)
    concrete = is_eager() and not coordinates.is_traced((steady, q, v))
    rows = searched(steady, q, v, lasting, concrete)
    found = Equilibria(t=s.t, params=s.params, symmetries=symmetries, starts=q, **rows._asdict())
    if not concrete:
        return found
    return merged(found, angles(system, *s))


def _is_a_state(system, t, q, params) -> bool:
    """Whether the argument `starts` is a single start."""
    try:
        checked(system, t, *stacked_one(q), params)
    except (TypeError, ValueError, IndexError):
        return False
    return True


def _velocities(velocities, q, count):
    """One velocity for each start."""
    v = stacked([velocities] if _is_one(velocities, q) else velocities, "velocities")
    if jax.tree.structure(v) != jax.tree.structure(q):
        coordinates.state(0.0, jax.tree.map(lambda x: x[0], q), jax.tree.map(lambda x: x[0], v), None)
    return jax.tree.map(lambda x, of: coordinates.numpy_of(x).broadcast_to(x, (count, *of.shape[1:])), v, q)


def _is_one(velocities, q):
    if isinstance(velocities, list) or jax.tree.structure(velocities) != jax.tree.structure(q):
        return False
    return all(jnp.ndim(x) == y.ndim - 1 for x, y in zip(jax.tree.leaves(velocities), jax.tree.leaves(q)))


def _moving(v, count):
    return np.any(np.concatenate([np.asarray(x).reshape(count, -1) for x in jax.tree.leaves(v)], axis=1) != 0, axis=0)


@partial(compiled, in_numpy=True)
def searched(steady: Steady, q, v, lasting, concrete) -> Row:
    """Search from each start; one row each."""
    return jax.vmap(lambda q, v: _search(steady, q, v, lasting, concrete))(q, v)


def held_at(steady: Steady, x, u):
    """The rates of a velocity, and the held rates or momenta."""
    fields, k = steady.fields(x), steady.symmetries.count
    if steady.symmetries.places:
        rates = u[np.array(steady.symmetries.places)]
    else:
        rates = jnp.linalg.lstsq(fields.T, u)[0] if k else jnp.zeros(0, x.dtype)
    return rates, steady.momenta(x, steady.velocity(x, rates)) if steady.symmetries.hold == MOMENTUM and k else rates


def _search(steady: Steady, q, v, lasting, concrete) -> Row:
    x0, u0 = coordinates.flatten(q)[0], coordinates.flatten(v)[0]
    rates, held = held_at(steady, x0, u0)
    steady = Steady(steady.system, steady.t, steady.params, held, steady.like, steady.symmetries)
    y0 = jnp.concatenate([x0, rates, jnp.zeros(steady.m, x0.dtype)])
    fixed, linear = stopped(steady), np.arange(y0.size) >= steady.n + steady.symmetries.count
    root = least_squares_root(lambda y: equations.balance(fixed, y), lax.stop_gradient(y0), linear)
    y = root.y if concrete else differentiable(lambda y: equations.balance(steady, y), root)
    return _row(steady, y, root, y0, lasting, concrete)


def _row(steady: Steady, y, root, y0, lasting, concrete) -> Row:
    """The row of a root: the solution in the user's structure, its stability and its status."""
    x, rates, multipliers = steady.parts(y)
    u, a = steady.velocity_and_acceleration(x, rates)
    by_name: dict[str, Any] = {}
    if steady.m > 1:
        pushes = equations.forces(steady, steady.t, x, u)
        multipliers = equations.shortest_multipliers(pushes, multipliers @ pushes)
    if steady.m:
        problem = steady.system, multipliers, steady.t, steady.like, steady.like, steady.params
        by_name = constraints.split(*problem)
    jacobian = root.jacobian if concrete else jax.jacfwd(lambda y: equations.balance(steady, y))(y)
    roots = equations.characteristic_roots(steady, y, jacobian, derivatives=not concrete)
    status, imbalance, zero_modes = _verdict(steady, root, y0, lasting)
    grows = GROWS_ABOVE[np.dtype(x.dtype)] * jnp.nanmax(jnp.abs(roots))
    stable = ~jnp.any(roots.real > grows) & jnp.any(jnp.isfinite(roots)) & (status == OK)
    momenta = steady.momenta(x, u) if steady.symmetries.count else jnp.zeros(0, x.dtype)
    is_found = status == OK
    fill = lambda tree: jax.tree.map(lambda x: jnp.where(is_found, x, jnp.nan), tree)
    return Row(
        fill(steady.unflatten(x)), fill(steady.unflatten(u)), fill(by_name), fill(rates), fill(momenta),
        stable, fill(roots), is_found, zero_modes, imbalance, status,
        steady.unflatten(root.y[: steady.n]),
    )  # fmt: skip


def _verdict(steady: Steady, root, y0, lasting):
    """The status of a root, its imbalance, and the number of its zero modes."""
    n, k = steady.n, steady.symmetries.count
    limit = BALANCED[np.dtype(y0.dtype)]
    larger = jnp.maximum(jnp.abs(root.y), jnp.abs(lax.stop_gradient(y0)))
    # Coordinates of zero have no size of their own, so all take that of the largest.
    of_x, of_rates, of_multipliers = (jnp.max(part, initial=0.0) for part in steady.parts(larger))
    size = jnp.concatenate([jnp.full(n, of_x), jnp.full(k, of_rates), jnp.full(steady.m, of_multipliers)])
    effect = jnp.abs(root.jacobian) @ size
    off = jnp.abs(root.r) / jnp.where(effect > 0, effect, 1.0)
    imbalance = jnp.max(off)
    at = slice(n, n + steady.m)
    status = jnp.asarray(OK)
    if not lasting:
        lost = jnp.abs(equations.drift_rates(steady, root.y))
        scale = jnp.maximum(effect[: n + steady.m], limit * jnp.max(lost))
        status = jnp.where(jnp.all(lost <= limit * scale), OK, NOT_LASTING)
    # Far away a fading force is almost zero, which is no equilibrium.
    far = of_x > FAR * jnp.max(jnp.abs(y0[:n])) if steady.n else False
    status = jnp.where((imbalance <= limit) & ~(far & (jnp.max(jnp.abs(y0[:n])) > 0)), status, NO_BALANCE)
    if steady.m:
        violated = jnp.max(off[at])
        status = jnp.where((violated > limit) & (violated >= jnp.max(off[:n])), CONSTRAINED, status)
    status = jnp.where((status == NO_BALANCE) & (root.steps >= MOST), UNFINISHED, status)
    status = jnp.where(jnp.isfinite(imbalance) & jnp.all(jnp.isfinite(root.y)), status, NOT_FINITE)
    return lax.stop_gradient((status, imbalance, _zero_modes(steady, root)))


def _zero_modes(steady: Steady, root):
    """In how many directions of positions, apart from the symmetries, the balance holds to first order."""
    n, k, least = steady.n, steady.symmetries.count, 1e3 * zero_below(root.y.dtype)
    matrix = root.jacobian[: n + steady.m]
    along = jnp.concatenate([steady.fields(root.y[:n]), jnp.zeros((k, steady.m), matrix.dtype)], axis=1)
    matrix = jnp.concatenate([jnp.concatenate([matrix[:, :n], matrix[:, n + k :]], axis=1), along])
    positive = lambda x: jnp.where(x > 0, x, 1.0)
    # Rows are compared with those at the start of the search too: a single number has no other scale.
    of_rows = jnp.max(jnp.abs(matrix), axis=1).at[: n + steady.m].max(root.rows[: n + steady.m])
    matrix = matrix / positive(of_rows)[:, None]
    columns = jnp.max(jnp.abs(matrix), axis=0)
    matrix = matrix / jnp.where(columns > least, columns, 1.0)[None, :]
    matrix = jnp.where(jnp.isfinite(matrix), matrix, 0.0)
    rank = lambda matrix: jnp.sum(lapack.singular_values(matrix) > least) if matrix.size else 0
    return n + rank(matrix[:, n:]) - rank(matrix)
