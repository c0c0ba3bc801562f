"""Other forms of the same mechanics: Hamilton's function, Routh's function, and the action of a path.

**The Hamiltonian of any regular Lagrangian**, by the Legendre transform, and Hamilton's equations.

    H(t, q, p) = p·v - L(t, q, v)        with v from p = ∂L/∂v
    q̇ = ∂H/∂p,    ṗ = -∂H/∂q + Q - ∂R/∂v

H is the Jacobi integral as a function of momenta. p = ∂L/∂v is solved for v numerically, for any regular L: if L is
quadratic in the velocities, p is linear in them and one solve with M = ∂²L/∂v∂v is exact; the program of L shows
whether this is so. Otherwise Newton's method finds v, with steps shortened until L is finite and the residual falls.
The derivatives of v, of any order and in both modes, are those of the implicit function: dv = M⁻¹ (dp - d(∂L/∂v) at
fixed v).

Source: Goldstein, *Classical Mechanics*, Eq. (8.15)-(8.18); Arnold, *Mathematical Methods of Classical Mechanics*, §14.

**Routh's function**: a system without its cyclic coordinates, whose momenta are parameters.

The momentum p_c = ∂L/∂v_c of a cyclic coordinate c is constant. With v_c found from it, the function

    R(t, q, v) = L(t, q, v, v_c) - p_c·v_c

is a Lagrangian for the other coordinates: ∂R/∂q = ∂L/∂q and ∂R/∂v = ∂L/∂v at the v_c given by p_c, because the terms
with dv_c cancel. (Goldstein's R has the opposite sign.) Forces on the other coordinates are unchanged, with v_c given
by p_c, but must not depend on the cyclic coordinate; no force may act on the cyclic coordinate itself.

Source: Goldstein, *Classical Mechanics*, §8.3; Landau & Lifshitz, *Mechanics*, §41.

**Hamilton's action** of a path: S = ∫ L(t, q, dq/dt) dt, stationary on true motions among paths with the same ends.

A path is a trajectory, or a function of time whose derivative is the velocity. A trajectory is integrated again, at the
nodes of a quadrature, so that it does not matter how far apart its outputs lie. The quadrature is refined until it is
as accurate as the motion (`analysis/energy.py`); while JAX traces, its nodes must be known beforehand.

Source: Goldstein, *Classical Mechanics*, Eq. (2.1), (2.2).
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.analysis.energy import Motion
from lagjax.integrate import Trajectory, in_one_solve
from lagjax.jaxtools import compiled, depends, is_eager, is_traced, judging, remembered
from lagjax.mechanics import SINGULAR_BELOW, applied_force, describe, forced_by, listed, what_changes_momentum
from lagjax.numerics import dense, newton, quadrature
from lagjax.refusals import must_be_function, must_be_like, must_be_single
from lagjax.system import (
    WITH_MULTIPLIERS,
    Holonomic,
    Model,
    System,
    check_system,
    coordinates,
    model_of,
    takes_of,
    traced_system,
)

ITERATIONS = 60
# The line search takes the best of these fractions of a Newton step, or none.
FRACTIONS = np.append(0.5 ** np.arange(16.0), 0.0)
# The momentum counts as reached if the residual is below this many round-offs of its terms.
ROUND_OFFS = 1e3


class SolvedVelocity(NamedTuple):
    """The velocity for a given momentum, whether M is regular there, and whether the momentum was reached."""

    v: Float[Array, " n"]
    mass: Float[Array, "n n"]
    regular: Bool[Array, ""]
    reached: Bool[Array, ""]


def velocity_of(momentum: Callable, p: Float[Array, " n"]) -> SolvedVelocity:
    """Solve `momentum(v) = p`, the gradient of a function of v, in vector form."""
    zero = jnp.zeros_like(p)
    mass = jax.jacfwd(momentum)
    if is_linear(momentum, zero):
        matrix = mass(zero)
        v = dense.solve(matrix, p - momentum(zero))
        reached = jnp.all(jnp.isfinite(v))
        return SolvedVelocity(v, matrix, _regular(matrix), reached)
    v = lax.custom_root(lambda v: momentum(v) - p, zero, _newton, _tangent)
    at, target = lax.stop_gradient(v), lax.stop_gradient(p)
    matrix = mass(at)
    return SolvedVelocity(v, matrix, _regular(matrix), _reached(momentum(at), target, matrix, at))


def is_linear(momentum: Callable, like) -> bool:
    """Whether ∂p/∂v is known not to depend on the velocities."""
    program = jax.make_jaxpr(jax.jacfwd(momentum))(like).jaxpr
    return not depends(program, program.invars)


@judging
def _regular(matrix):
    return dense.reciprocal_condition(lax.stop_gradient(matrix)) > SINGULAR_BELOW[np.dtype(matrix.dtype)]


@judging
def _reached(found, target, matrix, v: PyTree):
    terms = jnp.abs(target) + jnp.abs(matrix) @ jnp.abs(v)
    return jnp.max(jnp.abs(found - target)) <= ROUND_OFFS * jnp.finfo(v.dtype).eps * jnp.max(terms)


def _newton(residual, start):
    def step(v: PyTree, r, i):
        return dense.solve(jax.jacfwd(residual)(v), r)

    # Round-off ends the quadratic convergence: the residual no longer falls.
    return newton(residual, step, start, ITERATIONS, falls=1.0, fractions=FRACTIONS)


def _tangent(linear, y):
    return dense.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)


class Hamiltonian(eqx.Module):
    """The Hamiltonian `H(t, q, p, params)` of a system, returned by `lj.hamiltonian`."""

    system: System

    def __call__(self, t, q: PyTree, p, params: PyTree) -> Float[Array, ""]:
        """H at a position and a momentum, `[L]`."""
        return self._at(t, q, p, params)[0]

    def velocity(self, t, q: PyTree, p, params: PyTree) -> PyTree[Float[Array, "..."]]:
        """The velocity that belongs to a momentum, like q, `[q]/[t]`."""
        return self._at(t, q, p, params)[1]

    def rates(self, t, q: PyTree, p, params: PyTree) -> tuple[PyTree[Array], PyTree[Array]]:
        """Hamilton's equations: `(q̇, ṗ)`, each like q, including the forces that L does not contain."""
        if self.system.constraints:
            raise ValueError(
                f"Hamilton's equations need free coordinates, but {self.system} has constraints, whose forces "
                "H does not contain.\n"
                "Fix: lj.accelerations(system, t, q, v, params) with v = H.velocity(t, q, p, params), or coordinates "
                "that satisfy the constraints by themselves."
            )
        _, v, momentum_rate = self._at(t, q, p, params)
        return v, momentum_rate

    def _at(self, t, q: PyTree, p, params: PyTree):
        must_be_like(p, q, "p", "q", "p = lj.momentum(system, t, q, v, params)")
        s = coordinates.state(t, q, p, params)
        system = traced_system(self.system, s)
        value, v, momentum_rate, mass, regular, reached = _hamiltonian(system, *s)
        if is_traced((value, regular)):
            known = regular & reached
            return jax.tree.map(lambda x: jnp.where(known, x, jnp.nan), (value, v, momentum_rate))
        if not (regular and reached):
            raise ValueError(_no_velocity(s, np.asarray(mass), bool(regular)))
        return value, v, momentum_rate

    def __repr__(self):
        return f"Hamiltonian of {self.system}"


def hamiltonian(system: System) -> Hamiltonian:
    """Return the Hamiltonian of a system, by a numerical Legendre transform of any regular L.

    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2 - params["k"] * q**2 / 2)
    >>> H = hamiltonian(pendulum)
    >>> print(H(0.0, 1.0, 6.0, {"m": 2.0, "k": 10.0}), H.velocity(0.0, 1.0, 6.0, {"m": 2.0, "k": 10.0}))
    14.0 3.0

    **Arguments:** `system`, whose L is transformed. Constraints and forces are not part of H.

    **Returns:** `H(t, q, p, params)` -> scalar, `[L]`, with p like q, `[L] [t]/[q]`. `H.velocity` with the same
    arguments gives v, and `H.rates` the pair (q̇, ṗ) of Hamilton's equations. All three have derivatives of any order
    in both modes, and work in batches. They take one linear solve where L is quadratic in v, else Newton's method.

    **Raises:** when H is called: `ValueError` where L is degenerate, naming the coordinate whose velocity the momenta
    do not determine, or where no velocity has this momentum (while JAX is tracing the values are NaN instead);
    `TypeError`, `ValueError` for a state of the wrong dtype or shape.

    Source: Goldstein, Eq. (8.15), (8.18).
    """
    check_system(system, states=False)
    return Hamiltonian(system)


@compiled
def _hamiltonian(system, t, q: PyTree, p, params: PyTree):
    model = model_of(system, t, q, q, params)
    x, momentum = model.vectors(q, p)

    def lagrangian_of(x: Array, u: Array):
        return model.lagrangian(t, x, u)

    found = velocity_of(lambda u: jax.grad(lagrangian_of, argnums=1)(x, u), momentum)
    value, slope = jax.value_and_grad(lagrangian_of)(x, found.v)
    # -∂H/∂q at constant p equals ∂L/∂q at constant v.
    if not model.m:
        slope = slope + applied_force(model, t, x, found.v)
    return momentum @ found.v - value, model.tree(found.v), model.tree(slope), found.mass, found.regular, found.reached


def _no_velocity(s, mass, regular):
    names = coordinates.names(s.q)
    at = f"at t = {float(s.t):.6g}, q = {describe(s.q)}, p = {describe(s.v)}"
    if regular:
        return (
            f"no velocity was found that has this momentum, {at}.\n"
            "Usual cause: a momentum outside the range of ∂L/∂v, or an L that is not finite at rest.\n"
            "Fix: take p from a velocity, p = lj.momentum(system, t, q, v, params)."
        )
    name = names[degenerate(mass)] if np.all(np.isfinite(mass)) else names[0]
    return (
        f"L is degenerate in '{name}', {at}: the momenta do not determine its velocity, so there is no Hamiltonian.\n"
        "Usual cause: a coordinate whose velocity is missing from L, or enters it only linearly; a zero mass; a "
        "coordinate singularity (an azimuth at the pole).\n"
        f"Fix: give '{name}' a kinetic energy, or leave it out of q; lj.explain(system, t, q, v, params) shows the "
        "masses."
    )


def degenerate(mass: np.ndarray) -> int:
    """The coordinate with the largest component in the null direction of a singular mass matrix."""
    scale = np.sqrt(np.max(np.abs(mass), axis=1))
    if not np.all(scale):
        return int(np.argmin(scale))
    return int(np.argmax(np.abs(np.linalg.svd(mass / np.outer(scale, scale))[2][-1])))


class Routhian(eqx.Module):
    """Routh's function `R(t, q, v, params)` of the remaining coordinates: the Lagrangian of their system."""

    system: System
    cyclic: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        """R at a state of the remaining coordinates, `[L]`."""
        q, v = jax.tree.map(jnp.asarray, coordinates.as_floats((q, v)))
        return self._at(t, q, v, params)[0]

    def velocities(self, t, q: PyTree, v: PyTree, params: PyTree) -> dict[str, Array]:
        """The velocities of the cyclic coordinates, by name, `[q]/[t]`; integrate them to get the coordinates."""
        s = coordinates.state(t, q, v, params)
        return dict(zip(self.cyclic, self._at(*s)[1]))

    def full(self, q: PyTree, of_cyclic: Mapping):
        """The positions or velocities of all coordinates, from those of the remaining and of the cyclic ones."""
        return _together(q, self.cyclic, [of_cyclic[name] for name in self.cyclic])

    def force(self, t, q: PyTree, v: PyTree, params: PyTree):
        """The generalised forces on the remaining coordinates, in the structure of `q`."""
        force = self.system.force
        assert force is not None
        forces = force(t, *self._state(t, q, v, params), self._split(params)[0])
        if isinstance(forces, Mapping):
            return {name: forces[name] for name in q}
        indices = [_index(name) for name in self.cyclic]
        return jnp.stack([x for i, x in enumerate(jnp.asarray(forces)) if i not in indices])

    def dissipation(self, t, q: PyTree, v: PyTree, params: PyTree):
        """Rayleigh's function of the remaining coordinates."""
        dissipation = self.system.dissipation
        assert dissipation is not None
        return dissipation(t, *self._state(t, q, v, params), self._split(params)[0])

    def _state(self, t, q: PyTree, v: PyTree, params: PyTree):
        """The positions (zero for cyclic coordinates) and velocities of all coordinates."""
        u = self._at(t, q, v, params)[1]
        return _together(q, self.cyclic, [jnp.zeros_like(x) for x in u]), _together(v, self.cyclic, list(u))

    def _at(self, t, q: PyTree, v: PyTree, params: PyTree):
        params, momenta = self._split(params)
        shaped = coordinates.flatten(v)[0]
        zeros = [jnp.zeros_like(shaped[0])] * len(self.cyclic)
        q = _together(q, self.cyclic, zeros)
        model = model_of(self.system, t, q, q, params)
        remembered(model, (Routhian, self.cyclic), lambda: self._check(model))

        def of(u: Array):
            return self.system.lagrangian(t, q, _together(v, self.cyclic, list(u)), params)

        p = jnp.stack([jnp.asarray(momenta[name], shaped.dtype) for name in self.cyclic])
        found = velocity_of(jax.grad(of), p)
        u = jnp.where(found.regular & found.reached, found.v, jnp.nan)
        return of(u) - p @ u, u

    def _split(self, params: PyTree):
        if not isinstance(params, Mapping) or set(params) != {"params", "momenta"}:
            raise ValueError(
                "the parameters of a Routhian are those of the system and the momenta.\n"
                f'Fix: {{"params": params, "momenta": {{{", ".join(f"{name!r}: 1.0" for name in self.cyclic)}}}}}.'
            )
        missing = [name for name in self.cyclic if name not in params["momenta"]]
        if missing:
            raise ValueError(
                f"the momentum of {listed(missing)} is missing.\n"
                f'Fix: "momenta": {{..., "{missing[0]}": lj.momentum(system, t, q, v, params)["{missing[0]}"]}}.'
            )
        return params["params"], params["momenta"]

    def _check(self, model: Model):
        for name in self.cyclic:
            reason = next(what_changes_momentum(model, name), None)
            depends = next(forced_by(model, name), None)
            if reason is None and depends is not None:
                raise ValueError(
                    f"'{name}' cannot be eliminated: {depends}, so the motion of the others depends on where it is.\n"
                    f"Fix: leave '{name}' out of cyclic."
                )
            if reason is not None:
                raise ValueError(
                    f"'{name}' is not cyclic: {reason}, so its momentum need not be constant.\n"
                    f"Fix: leave '{name}' out of cyclic; lj.explain(system, t, q, v, params).structure.cyclic lists "
                    "those that L does not contain."
                )
        return True


def routhian(system: System, cyclic: str | Iterable[str]) -> System:
    """Return the system of the coordinates that remain when cyclic ones are eliminated by their momenta.

    >>> import lagjax as lj
    >>> def kepler(t, q, v, params):
    ...     return 0.5 * (v["r"] ** 2 + (q["r"] * v["angle"]) ** 2) + params["k"] / q["r"]
    >>> radial = routhian(lj.System(kepler), "angle")
    >>> params = {"params": {"k": 1.0}, "momenta": {"angle": 2.0}}
    >>> a, _ = lj.accelerations(radial, 0.0, {"r": 2.0}, {"r": 0.0}, params)
    >>> print(a["r"])
    0.25

    **Arguments:**

    - `system`: with q a dict, or an array (n,).
    - `cyclic`: which coordinates to eliminate, by name: a key of the dict that is a number, or `"q[1]"`.

    **Returns:** a `System` in the remaining coordinates, the dict without these keys, or the shorter array. Its
    parameters are `{"params": those of the system, "momenta": {name: p}}`, with p as `lj.momentum` gives it.
    Its constraints, forces and dissipation are those of the system. `routhian(...).lagrangian.velocities(t, q, v,
    params)` gives the cyclic velocities, by name.

    **Raises:** `ValueError`, when L is called, for a coordinate that is not cyclic, on which a force or constraint
    acts, or on which the forces on others depend; for parameters without the momenta. `ValueError`, at once, if a force
    depends on multipliers. The values are NaN where the momenta do not determine the cyclic velocities.

    Source: Goldstein, §8.3, with the opposite sign; Landau & Lifshitz, *Mechanics*, §41.
    """
    check_system(system, cyclic, states=False)
    names = (cyclic,) if isinstance(cyclic, str) else tuple(cyclic)
    if not names or len(set(names)) < len(names):
        raise ValueError('cyclic must name at least one coordinate, and each only once.\nFix: cyclic=["phi", "psi"].')
    if system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS and system.constraints:
        raise ValueError(
            "the force depends on multipliers, which a Routhian does not support.\n"
            "Fix: lj.routhian of a system whose force is a function of (t, q, v, params)."
        )
    reduced = Routhian(system, names)

    def constraint(g):
        def of_rest(t, q: PyTree, params: PyTree):
            rest, _ = reduced._split(params)
            zero = jnp.zeros_like(coordinates.flatten(q)[0][0])
            return g(t, _together(q, names, [zero] * len(names)), rest)

        return of_rest

    left = {name: Holonomic(constraint(c.function)) for name, c in system.constraints.items() if c.of_positions}
    return System(
        reduced, left, force=None if system.force is None else reduced.force,
        dissipation=None if system.dissipation is None else reduced.dissipation,
    )  # fmt: skip


def _together(rest, names, values):
    """All coordinates, from the remaining ones `rest` and the `values` of the cyclic ones `names`."""
    if isinstance(rest, Mapping):
        duplicates = [name for name in names if name in rest]
        if duplicates:
            raise ValueError(
                f"{listed(duplicates)} is eliminated, but still among the coordinates.\nFix: leave it out of q0 and v0."
            )
        return {**rest, **dict(zip(names, values))}
    if jnp.ndim(rest) == 1:
        cyclic = dict(zip([_index(name) for name in names], values))
        remaining, count = iter([rest[i] for i in range(len(rest))]), len(rest) + len(names)
        return jnp.stack([cyclic[i] if i in cyclic else next(remaining) for i in range(count)])
    raise ValueError(
        'a Routhian needs coordinates by name, or in an array with one axis.\nFix: q = {"r": ..., "angle": ...}.'
    )


def _index(name: str):
    start, _, number = name.rstrip("]").rpartition("[")
    if start != "q" or not number.isdigit():
        raise ValueError(f"'{name}' is not an entry of an array q.\nFix: \"q[1]\".")
    return int(number)


# Points of Gauss's rule on each piece, which is exact up to degree 15.
POINTS = 8
PIECES = 32


def action(
    system,
    path: Trajectory | Callable,
    params: PyTree = None,
    t0=None,
    t1=None,
    *,
    pieces: int = PIECES,
    error: bool = False,
) -> Float[Array, ""] | tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the action `S = ∫ L dt` of a path, differentiable in everything that the path and L depend on.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> print(action(fall, lambda t: 2.0 * t - 5.0 * t**2, {"g": 10.0}, 0.0, 1.0).round(12))
    15.333333333333

    **Arguments:**

    - `path`: `q(t)` -> coordinates, smooth between t0 and t1, or a `Trajectory`.
    - `params`: as L takes it; by default those of the trajectory.
    - `t0`, `t1`: the ends, `[t]`; by default those of the trajectory.
    - `pieces`: the number of equal parts of the time span, each integrated by a rule of degree 15. A trajectory is
      integrated again, however far apart its outputs lie, in parts as short as it takes; while JAX traces (under `jit`,
      `grad`, `vmap`) in this number of parts, or one for each output if these are more: `error` tells whether they
      suffice.
    - `error`: return the estimated error of the integral as well; that of the motion itself is `traj.error`.

    **Returns:** S, scalar, `[L] [t]`; NaN for a trajectory that failed. With `error=True` (S, its estimated error).

    **Raises:** `TypeError` for a path that is neither a function nor a trajectory; `ValueError` for a function without
    t0 and t1, a batch of trajectories, or one that ends before t1; `TypeError` for a motion in phases while JAX traces.

    Source: Goldstein, Eq. (2.1).
    """
    check_system(system, path, params, states=False)
    if isinstance(path, Trajectory):
        found = _action_of_trajectory(system, path, params, t0, t1, pieces)
        return found if error else found[0]
    must_be_function(path, "a path", "t, or a Trajectory", 'lambda t: {"x": 2.0 * t, "y": 0.0 * t}')
    if t0 is None or t1 is None:
        raise ValueError("a path that is a function needs its ends.\nFix: lj.action(system, path, params, 0.0, 1.0).")
    t0, t1 = (jnp.asarray(t, jnp.result_type(float)) for t in (t0, t1))

    def edges(pieces: int):
        return t0 + (t1 - t0) * jnp.arange(pieces + 1) / pieces

    q, v = _position_and_velocity(path, t0)
    s = coordinates.state(t0, q, v, params)
    system = traced_system(system, s)

    def at(t: Array):
        return system.lagrangian(t, *_position_and_velocity(path, t), s.params)

    whole, halves = (_integral(at, edges(n)[:-1], edges(n)[1:]) for n in (pieces, 2 * pieces))
    return (whole, jnp.abs(halves - whole)) if error else whole


def _action_of_trajectory(system, path, params: PyTree, t0, t1, pieces):
    must_be_single(path.t.shape[:-1], "this trajectory", "jax.vmap(lambda traj: lj.action(system, traj))(trajectories)")
    params = path.params if params is None else params
    t, q, v = path.t, path.q, path.v
    s = coordinates.state(t[0], *jax.tree.map(lambda x: x[0], (q, v)), params)
    system = traced_system(system, s)
    t0, t1 = (t[0] if t0 is None else t0), (t[-1] if t1 is None else t1)
    if not is_traced((t, t0, t1)):
        low, high = float(np.min(t)), float(np.max(t))
        if not (low <= float(t0) <= high and low <= float(t1) <= high):
            raise ValueError(
                f"the trajectory goes from t = {low:.6g} to {high:.6g}, but the action is asked from "
                f"{float(t0):.6g} to {float(t1):.6g}.\nFix: a trajectory with outputs at or beyond these times."
            )
    if is_eager() and not is_traced((path, t0, t1, s.params, eqx.filter(system, eqx.is_array))):
        return _along_the_steps(system, path, s.params, float(t0), float(t1))
    ends = jnp.stack([jnp.asarray(end, t.dtype) for end in (t0, t1)])
    return _in_one_solve(system, path, s.params, ends, pieces)


@partial(compiled, in_line=True)
def _in_one_solve(system, path, params: PyTree, ends: Array, pieces: int):
    """The action between two times of a trajectory, and its error, in a program."""
    t, q, v = path.t, path.q, path.v
    # From the earlier end, as the motion runs, to the later one.
    runs = -1 if path.static.how.backward else 1
    turned = runs * ends[0] > runs * ends[1]
    first, last = jnp.where(turned, ends[::-1], ends)
    edges = first + (last - first) * jnp.linspace(0.0, 1.0, max(pieces, len(t) - 1) + 1, dtype=t.dtype)
    nodes = quadrature.nodes(edges[:-1], edges[1:]).ravel()
    at = in_one_solve(path, nodes)
    values = jax.vmap(lambda t, q, v: system.lagrangian(t, q, v, params))(nodes, at.q, at.v)
    values = values.reshape(-1, quadrature.NODES.size)
    # NaN for a motion that failed, also where the nodes lie before that.
    complete = jnp.all(jnp.isfinite(jnp.concatenate([x.ravel() for x in jax.tree.leaves((q, v))])))
    values = jnp.where(complete, jnp.where(turned, -values, values), jnp.nan)

    def integral(weights: Array):
        return jnp.sum(0.5 * jnp.diff(edges) * (values @ weights.astype(t.dtype)))

    found = integral(quadrature.KRONROD)
    return found, jnp.abs(found - integral(quadrature.GAUSS))


def _along_the_steps(system, path, params: PyTree, t0, t1):
    """The action of a motion that is integrated again, and the error of the quadrature."""
    states = np.concatenate([np.ravel(y) for y in jax.tree.leaves((path.q, path.v))])
    dtype = np.asarray(path.t).dtype
    if not np.all(np.isfinite(states)):
        return jnp.asarray(np.nan, dtype), jnp.asarray(np.nan, dtype)
    if t0 == t1:
        return jnp.zeros((), dtype), jnp.zeros((), dtype)
    motion = Motion(path, path.system)
    knots = motion.between(t0, t1)

    def at_nodes(a, b):
        _, t, q, v, _ = motion.again(a, b)
        return np.asarray(_lagrangians(system, params, t, q, v))[:, None]

    size = float(np.max(np.abs(at_nodes(knots[:-1], knots[1:]))))
    rtol = max(float(np.max(np.asarray(path.tolerance[0]))), float(np.finfo(dtype).eps))
    _, sums, errors = motion.integrals(knots, at_nodes, rtol * size * abs(t1 - t0))
    return jnp.asarray(np.sum(sums), dtype), jnp.asarray(np.sum(np.abs(errors)), dtype)


@compiled
def _lagrangians(system: System, params: PyTree, t: Array, q: PyTree, v: PyTree) -> Array:
    return jax.vmap(lambda t, q, v: system.lagrangian(t, q, v, params))(t, q, v)


def _position_and_velocity(path, t):
    """The position and velocity of a path at time t."""
    q, v = jax.jvp(lambda t: coordinates.as_floats(path(t)), (t,), (jnp.ones_like(t),))

    def as_array(x: Array):
        return jnp.asarray(x, jnp.result_type(t))

    return jax.tree.map(as_array, q), jax.tree.map(as_array, v)


def _integral(function, a, b):
    """The integral of a function of time over all pieces, from a (m,) to b (m,)."""
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    half = 0.5 * (b - a)
    times = (0.5 * (a + b))[:, None] + half[:, None] * nodes.astype(half.dtype)[None]
    values = jax.vmap(jax.vmap(function))(times)
    return jnp.sum(half * (values @ weights.astype(values.dtype)))
