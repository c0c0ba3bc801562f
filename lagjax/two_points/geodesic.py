"""Geodesics: stationary paths of a length, found as motions without forces, L = ½ g(v, v); parallel transport.

With constant speed the energy ∫ ½ g(v, v) dt over a time of one is half the square of the length l, and its stationary
paths are the geodesics, independent of coordinates:

    l = √g(v_a, v_a),    δE = l δl

The index is that of the length: one for each conjugate point between the ends.

Source: Milnor, *Morse Theory*, §12-15; do Carmo, *Riemannian Geometry*, ch. 3, 5, 9.

**Parallel transport**: a tangent vector carried along a curve without turning.

Accelerations of motions without forces are a = -Γ(v, v), quadratic in v, so the equation of transport along q(t) is

    ẇ = -Γ(q̇, w) = ½ (∂a/∂v) w    at v = q̇

On a surface in space a is the normal acceleration that keeps the motion on it, and so is ẇ, which keeps w tangent. The
equation is linear, and is solved on elements of the path by Gauss's collocation, of order 2s for s points.

Source: do Carmo, *Riemannian Geometry*, §2.2-2.3; Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §II.1.3.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from lagjax.integrate import Trajectory, integrate
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.mechanics import accelerations_at
from lagjax.refusals import must_be_function, must_name
from lagjax.system import Model, State, System, check_system, constraints, coordinates, model_of, prepare, traced_system
from lagjax.two_points.answer import Connection, is_same
from lagjax.two_points.connect import ELEMENTS, connected
from lagjax.two_points.elements import linear_motion, rule_of_degree
from lagjax.two_points.mesh import even, places
from lagjax.two_points.starts import Starts, guesses_of

TURN = 2 * np.pi
# The tolerance of motions along geodesics that are given.
TOLERANCE = {np.dtype("float64"): 1e-12, np.dtype("float32"): 1e-6}
# Random starts where the straight line leads to a path that is not the shortest.
FURTHER = 7


class Geodesic(eqx.Module):
    """A stationary path between two points; the shortest found, with the others by rising length.

    - `length`; `start_direction`, `end_direction`: velocities of unit length, NaN where the points coincide.
    - `connection`: the motion along it in a time of one. `index`, `kind`: of the length, as of a `Connection`.
    - `conjugate_lengths`: the distances along it of the points conjugate to the start.
    """

    length: Float[Array, ""]
    start_direction: PyTree[Float[Array, "..."]]
    end_direction: PyTree[Float[Array, "..."]]
    connection: Connection
    others: "tuple[Geodesic, ...]" = ()

    @property
    def index(self) -> Int[Array, ""]:
        return self.connection.index

    @property
    def kind(self) -> str:
        return self.connection.kind

    @property
    def trajectory(self) -> Trajectory | None:
        return self.connection.trajectory

    @property
    def conjugate_lengths(self) -> np.ndarray:
        times = self.connection.conjugate_times
        return np.zeros(0) if times is None else times * np.asarray(self.length)

    def __repr__(self):
        if np.ndim(self.length):
            return f"Geodesic({np.size(self.length)} lanes)"
        if self.kind == "not found":
            return "Geodesic(not found)"
        more = f"; {len(self.others)} longer" if self.others else ""
        return f"Geodesic(length {float(self.length):.12g}, {self.kind}{more})"


class LineElement(eqx.Module):
    """½ ds² as a Lagrangian."""

    metric: Callable

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        return 0.5 * self.metric(q, v, params)


def geodesic(
    metric: Callable | System,
    a: PyTree[ArrayLike],
    b: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    starts: Starts = 1,
    angles: str | Iterable[str] = (),
    elements: int = ELEMENTS,
    outputs: int = 33,
    rtol: ArrayLike | None = None,
) -> Geodesic:
    """Find the shortest path between two points, and other stationary ones.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def sphere(q, v, params):
    ...     return v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2
    >>> quarter = geodesic(sphere, {"psi": jnp.pi / 2, "theta": 0.0}, {"psi": jnp.pi / 2, "theta": jnp.pi / 2})
    >>> print(f"{quarter.length:.9f}", quarter.kind)
    1.570796327 minimum

    **Arguments:**

    - `metric`: the square of the line element, `metric(q, v, params)` -> g(v, v), quadratic in v; or a `System` whose
      Lagrangian is ½ g(v, v), with holonomic constraints for a surface in space, such as |r| = R.
    - `a`, `b`: the points, alike.
    - `angles`: the names of coordinates that come back after a turn of 2π: the nearer way round is taken, and for each
      the other way as well.
    - `starts`, `elements`, `outputs`, `rtol`: as for `connect`. Where the straight line leads to nothing but a saddle,
      what lies below it on both sides is looked for, and then seven random starts follow.

    **Returns:** a `Geodesic`: the shortest that was found, longer ones in `others`; where none was, its length is NaN.
    Differentiable in both modes; under `jit` and `vmap` the one from the straight line.

    **Raises:** as `connect`; `ValueError` for a Lagrangian that is not quadratic in v, and a system with a force, a
    dissipation or velocity constraints.

    Source: do Carmo, *Riemannian Geometry*, §9.2.
    """
    system = of_metric(metric)
    check_system(system, a, b, params, states=False)
    model, s = prepare(system, 0.0, a, a, params)
    one = prepare(system, 0.0, b, b, params)[1] if jax.tree.structure(a) == jax.tree.structure(b) else s
    eager = is_eager() and not is_traced((s, one, eqx.filter(system, eqx.is_array)))
    if eager:
        _check_quadratic(model, s)
    if eager and all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(s.q), jax.tree.leaves(one.q))):
        return _point(system, s, outputs)
    many = isinstance(starts, int | np.integer) and starts > 1
    options = dict(starts=starts, elements=elements, outputs=outputs, rtol=rtol, goes_down=many)
    ends = _round_the_other_way(model, s.q, b, angles) if eager and angles else [b]
    found = _different([], system, s, ends, options)
    # The shortest path is no saddle: the straight line was a start on a ridge.
    line, *random = guesses_of(model, 1 + FURTHER)
    for more in ([line], random) if eager and starts == 1 else ():
        if found and all(int(answer.index) > 0 for answer in found):
            found = _different(found, system, s, ends, {**options, "starts": more, "goes_down": True})
    if not found:
        return _of(system, s, _between(system, s, b, **options))
    if eager:
        found.sort(key=lambda answer: float(answer.length))
    return eqx.tree_at(lambda g: g.others, found[0], tuple(found[1:]), is_leaf=lambda x: isinstance(x, tuple))


def of_metric(metric: Callable | System) -> System:
    """The system whose motions are geodesics; raises for what turns motions off them."""
    if not isinstance(metric, System):
        return System(LineElement(metric))
    off = [name for name in ("force", "dissipation") if getattr(metric, name) is not None]
    off += [f"velocity constraint '{name}'" for name, c in metric.constraints.items() if not c.of_positions]
    if off:
        raise ValueError(
            f"the system has a {off[0]}, and its motions are no geodesics.\n"
            "Fix: a lj.System of L = ½ g(v, v) and holonomic constraints alone; for other motions lj.connect."
        )
    return metric


def tolerance_in(s: State) -> float:
    """The tolerance of a motion along a geodesic."""
    return TOLERANCE.get(np.dtype(s.t.dtype), 1e-5)


def exponential_map(metric: Callable | System, a: PyTree[ArrayLike], v: PyTree[ArrayLike], params: PyTree = None):
    """Return where the geodesic from a with the velocity v is after a time of one, and its velocity there.

    >>> import lagjax as lj
    >>> q, v = exponential_map(lambda q, v, params: v**2 / q**2, 1.0, 1.0)
    >>> print(f"{q:.9f}")
    2.718281828

    **Arguments:** as for `geodesic`; `v` like `a`, its length is that of the path.

    **Returns:** (q, v), like `a`; differentiable in both modes.

    **Raises:** as `integrate`; `ValueError` for a system with a force, a dissipation or velocity constraints.

    Source: do Carmo, *Riemannian Geometry*, §3.2.
    """
    system = of_metric(metric)
    s = coordinates.prepared(0.0, a, v, params)
    trajectory = integrate(system, a, v, params, ts=np.array([0.0, 1.0]), rtol=tolerance_in(s))
    return jax.tree.map(lambda x: x[-1], (trajectory.q, trajectory.v))


def _different(found: list[Geodesic], system, s, ends, options) -> list[Geodesic]:
    """The answers that are there, and those to these ends that are others."""
    quiet = bool(found) or len(ends) > 1
    for end in ends:
        first = _between(system, s, end, **options, quiet=quiet)
        # Traced, it is not known whether it converged.
        if not quiet or bool(first.converged) or first.alone:
            answers = [_of(system, s, answer) for answer in (first, *first.others)]
            known = [other.connection for other in found]
            found = [*found, *(x for x in answers if not any(is_same(x.connection, other) for other in known))]
    return found


def _between(system, s, end: PyTree, starts, elements, outputs, rtol, goes_down, quiet=False) -> Connection:
    """The motions to a point in a time of one."""
    return connected(
        system, (s.q, end), (0.0, 1.0), s.params, None, False, starts, elements, outputs, rtol, quiet, goes_down
    )


def _of(system, s, connection: Connection) -> Geodesic:
    known = not is_traced(connection.amplification)
    # Between conjugate ends the start velocity has fewer digits than the action.
    moves = connection.trajectory is not None and not (known and connection.kind.startswith("degenerate"))
    length, starting, ending = _lengths(
        traced_system(system, s), s, connection.start_velocity,
        jax.tree.map(lambda x: x[-1], (connection.q, connection.v)), connection.action, moves,
    )  # fmt: skip
    return Geodesic(length, starting, ending, eqx.tree_at(lambda c: c.others, connection, ()))


@compiled
def _lengths(system: System, s, v: PyTree, last: tuple, action: Array, moves: bool):
    """The length, and both directions."""
    model = model_of(system, *s)
    x, u = model.vectors(s.q, v)
    # Where there is no motion, L may be singular at the start.
    length = jnp.sqrt(2 * model.lagrangian(s.t, x, u)) if moves else jnp.sqrt(2 * action)
    return length, model.tree(u / length), jax.tree.map(lambda v: v / length, last[1])


def _point(system, s, outputs) -> Geodesic:
    """The path of no length."""
    still = jax.tree.map(np.zeros_like, s.q)
    none = jax.tree.map(lambda x: np.full_like(x, np.nan), still)
    trajectory = integrate(system, s.q, still, s.params, ts=np.linspace(0.0, 1.0, outputs), estimate_error=False)
    zero = np.zeros((), s.t.dtype)
    fields = (trajectory.t, trajectory.q, trajectory.v, trajectory.multipliers, trajectory, still, still, zero + 1)
    measures = (zero, np.zeros((), int), zero + 1, zero, zero, np.asarray(True), np.zeros(0))
    return Geodesic(zero, none, none, Connection(*fields, *measures, tried="the points coincide"))


def _round_the_other_way(model, a: PyTree, b: PyTree, angles) -> list[PyTree]:
    """The ends that are the same point: the nearest way round, and for each angle the other way."""
    names = [angles] if isinstance(angles, str) else list(angles)
    must_name(names, model.names, "angles names", "coordinate", "angles='{}'")
    x, y = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(q)]).astype(float) for q in (a, b))
    around = np.array([name in names for name in model.names])
    nearest = np.where(around, y - TURN * np.round((y - x) / TURN), y)
    ends = [nearest]
    for i in np.flatnonzero(around):
        other = nearest.copy()
        other[i] -= TURN * (1.0 if nearest[i] >= x[i] else -1.0)
        ends.append(other)
    return [coordinates.like(b, end.astype(model.form.dtype)) for end in ends]


def _check_quadratic(model, s):
    single, double = (float(x) for x in _at_speeds(model, s))
    if not np.isclose(double, 4 * single, rtol=1e-4, atol=0.0) and np.isfinite(single):
        raise ValueError(
            f"the Lagrangian is not quadratic in the velocities: it is {single:.6g} for one velocity, and "
            f"{double:.6g} for its double.\n"
            "Usual cause: a potential energy, or the length √g(v, v) in place of its square.\n"
            "Fix: return g(v, v); for motions in a potential lj.connect."
        )


@compiled
def _at_speeds(model, s):
    x = model.vectors(s.q, s.q)[0]
    u = jnp.asarray(np.random.default_rng(0).normal(size=model.n), x.dtype)
    at = x + 1e-3 * jnp.maximum(jnp.abs(x), 1.0)
    return jax.vmap(lambda u: model.lagrangian(s.t, at, u))(jnp.stack([u, 2 * u]))


POINTS, CURVE_ELEMENTS = 6, 64
# So much of a vector may be across a constraint, and of a path off it, as parts of their sizes.
OFF = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-4}


def parallel_transport(
    metric: Callable | System,
    path: Callable | Geodesic,
    w: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    t_a: ArrayLike = 0.0,
    t_b: ArrayLike = 1.0,
    elements: int = CURVE_ELEMENTS,
) -> PyTree[Array]:
    """Return the vector w at the start of a path as it arrives at the end, carried parallel to itself.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def sphere(q, v, params):
    ...     return v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2
    >>> def latitude(t):
    ...     return {"psi": jnp.pi / 3, "theta": 2 * jnp.pi * t}
    >>> w = parallel_transport(sphere, latitude, {"psi": 1.0, "theta": 0.0})
    >>> print(w["psi"].round(9))  # once round it has turned by 2π (1 - cos π/3) = π
    -1.0

    **Arguments:**

    - `metric`, `params`: as for `lj.geodesic`.
    - `path`: `q(t)` -> coordinates, smooth between `t_a` and `t_b`, on the constraints; or a `Geodesic`.
    - `w`: a vector at the start, like the coordinates, tangent to the constraints.
    - `elements`: of the path; the error is of order 12 in their length.

    **Returns:** w at the end, like the coordinates; differentiable in both modes.

    **Raises:** `TypeError`, `ValueError` for arguments of the wrong kind or shape; a w that is not tangent to a
    constraint, a path that leaves one; forces and velocity constraints. Under `jit` and `vmap` w at the end is NaN
    where it is not tangent, or the path is off.

    Source: do Carmo, *Riemannian Geometry*, §2.2.
    """
    system = of_metric(metric)
    check_system(system, w, params, states=False)
    fix = 'lambda t: {"psi": 1.0, "theta": 2.0 * t}'
    if not isinstance(path, Geodesic):
        must_be_function(path, "a path", "t, or a Geodesic", fix)
    if isinstance(path, Geodesic):
        start = jax.tree.map(lambda x: x[0], path.connection.q)
        t_a, t_b = np.zeros((), path.length.dtype), np.ones((), path.length.dtype)
    else:
        t_a, t_b = (jnp.asarray(t, jnp.result_type(float)) for t in (t_a, t_b))
        start = path(t_a)
    model, s = prepare(system, t_a, start, w, params)
    dtype, rule = s.t.dtype, rule_of_degree(POINTS)
    t = (t_a + (t_b - t_a) * places(even(elements), rule.points)).astype(dtype)
    if isinstance(path, Geodesic):
        # The first output is the start.
        ts = np.concatenate([t_a[None], t])
        motion = integrate(system, start, path.connection.start_velocity, s.params, ts=ts, rtol=tolerance_in(s))
        x, u = (jax.vmap(model.vector)(y)[1:] for y in (motion.q, motion.v))
    else:

        def at(t: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda t: model.vector(coordinates.as_floats(path(t))), (t,), (jnp.ones_like(t),))

        x, u = jax.vmap(at)(t)
    w, x_a = model.vector(s.v), model.vector(s.q)
    carried = _carried(model, t, x, u, jnp.asarray((t_b - t_a) / elements, dtype), w)
    if not model.m:
        return model.tree(carried)
    bound = OFF.get(np.dtype(dtype), 1e-4)
    across, away = _off(model, jnp.asarray(t_a, dtype), x_a, w, t, x)
    if is_traced((across, away)):
        well = jnp.all(across < bound) & jnp.all(away < bound)
        return model.tree(jnp.where(well, carried, jnp.nan))
    _check(model, np.asarray(across), np.asarray(away), t, bound)
    return model.tree(carried)


def _check(model: Model, across: np.ndarray, away: np.ndarray, t: np.ndarray, bound: float):
    """Raise for a vector that is not tangent, and a path that leaves the constraints."""
    worst = int(np.argmax(np.where(np.isfinite(across), across, np.inf)))
    if not across[worst] < bound:
        raise ValueError(
            f"w is not tangent to the constraint '{model.equation_names[worst]}': {across[worst]:.3g} of it is not.\n"
            "Usual cause: a vector in space that points off the surface.\n"
            "Fix: _, w = lj.consistent_state(system, t_a, q, w, params), its part along the constraints."
        )
    at, worst = np.unravel_index(np.argmax(np.where(np.isfinite(away), away, np.inf)), away.shape)
    if not away[at, worst] < bound:
        raise ValueError(
            f"the path is off the constraint '{model.equation_names[worst]}' at t = {float(t[at]):.6g}, by "
            f"{away[at, worst]:.3g} of the distance from the origin.\n"
            "Usual cause: a path beside the surface, as a straight line between two of its points.\n"
            "Fix: path=lj.geodesic(system, a, b, params), or a function of t that stays on it."
        )


@compiled
def _off(model: Model, t_a: Array, x_a: Float[Array, " n"], w: Array, t: Float[Array, " T"], x: Float[Array, "T n"]):
    """How much of w is across each constraint (m,), and how far the path is from it (T, m), as parts of their sizes."""

    def rows(t: Array, x: Array) -> tuple[Array, Array]:
        slope = jax.jacfwd(lambda x: constraints.position_residual(model, t, x))(x)
        return slope, jnp.sqrt(jnp.sum(slope**2, axis=1))

    def away(t: Array, x: Array) -> Array:
        return jnp.abs(constraints.position_residual(model, t, x)) / (rows(t, x)[1] * largest)

    largest = jnp.maximum(jnp.max(jnp.abs(x)), jnp.finfo(x.dtype).tiny)
    slope, size = rows(t_a, x_a)
    length = jnp.sqrt(jnp.sum(w**2))
    across = jnp.abs(slope @ w) / (size * jnp.where(length > 0, length, 1.0))
    return across, jax.vmap(away)(t, x)


@compiled
def _carried(
    model: Model, t: Float[Array, " T"], x: Float[Array, "T n"], u: Float[Array, "T n"], h: Array, w: Float[Array, " n"]
) -> Float[Array, " n"]:
    """w from element to element, from states at Gauss's points."""
    rule, n = rule_of_degree(POINTS), model.n

    def turning(t: Array, x: Array, u: Array) -> Array:
        """½ ∂a/∂v."""
        q = model.tree(x)
        a = jax.jacfwd(lambda u: model.vector(accelerations_at(model, State(t, q, model.tree(u), model.params))[0]))
        return a(u) / 2

    def across(w: Array, matrices: Array):
        return linear_motion(rule, h, matrices, w[:, None])[1][:, 0], None

    return lax.scan(across, w, jax.vmap(turning)(t, x, u).reshape(-1, POINTS, n, n))[0]
