"""Geodesics: stationary paths of a length, found as motions without forces, L = ½ g(v, v).

With constant speed the energy ∫ ½ g(v, v) dt over a time of one is half the square of the length l, and its stationary
paths are the geodesics, independent of coordinates:

    l = √g(v_a, v_a),    δE = l δl

The index is that of the length: one for each conjugate point between the ends.

Source: Milnor, *Morse Theory*, §12-15; do Carmo, *Riemannian Geometry*, ch. 3, 5, 9.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from lagjax.integrate import Trajectory, integrate
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.mechanics import listed
from lagjax.system import State, System, check_system, coordinates, model_of, prepare
from lagjax.two_points.answer import is_same
from lagjax.two_points.connect import ELEMENTS, connected
from lagjax.two_points.result import Connection
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
        system, s, connection.start_velocity, jax.tree.map(lambda x: x[-1], (connection.q, connection.v)),
        connection.action, moves,
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
    unknown = [name for name in names if name not in model.names]
    if unknown:
        raise ValueError(
            f"angles names '{unknown[0]}', and the coordinates are {listed(model.names)}.\n"
            f'Fix: angles="{model.names[0]}".'
        )
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
