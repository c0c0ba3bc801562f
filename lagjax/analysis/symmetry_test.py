"""A test of a claimed symmetry, at random states that satisfy the constraints.

A generator conserves its charge if L changes at most by a total derivative, forces do no work along the displacement
ξ - τ v, and every constraint allows this displacement (`mechanics/noether.py`). The last condition is checked on the
constraints and not on their forces, which may vanish by accident; for a holonomic one it means that the set g = 0 is
preserved. A velocity constraint may be invariant and still forbid the displacement: a rolling disk rolls in the same
way everywhere on the table, but its momentum changes.

*The rates of change of the charges* of many generators at many states are computed by one program,

    dC/dt = ρ + (Q - ∂R/∂v)·(ξ - τ v) + λ·A (ξ - τ v)

(`mechanics/noether.py`). The last part vanishes for every λ if the constraints allow the displacement ξ - τ v; its m
numbers per state are kept separately. Rates are given in units of what they would be if nothing were conserved, e times
the size of the generator:

    e = |p|·|v| + |∂L/∂q|·ℓ + |Q - ∂R/∂v|·ℓ,        |ξ|/ℓ + |τ|/T

where ℓ is the size of each coordinate, and T the time in which the velocities cover such lengths.

*The random states.* Positions lie around the given one within several widths, up to one and a half times its size, so
that a symmetry that holds only on one side of a plane is detected. Times and velocities are drawn likewise; some
velocities are zero, so that fast motion does not hide a small force. The size of a coordinate is that of its array or
point; it is 1 if that is at zero, and at least 1 for an angle. Newton's method moves states onto the constraints by
steps that are the shortest in units of these sizes.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.display import labelled
from lagjax.jaxtools import compiled, is_traced, numpy_of, remembered
from lagjax.mechanics import (
    Generator,
    GeneratorFlow,
    accelerations_at,
    applied_force,
    are_angles,
    as_generator,
    describe,
    equations_of,
    flow,
    points,
)
from lagjax.numerics import newton
from lagjax.system import Model, check_system, constraints, coordinates, model_of, traced_system

WIDTHS = np.array([1.5, 1.0, 0.5, 0.1])
VELOCITY_WIDTHS = np.array([1.0, 0.3, 1.0, 0.0])
ITERATIONS = 30
# States off the constraints are tried again, closer by these factors, until more than this fraction is on them.
NEARER, ENOUGH = (0.3, 0.3, 0.3), 0.75
# Constraint rows are dependent if a singular value is below this fraction of the largest.
DEPENDENT_BELOW = 1e-6
# A constraint holds if its residual is below this many round-offs of its terms.
ROUND_OFFS = 1e4


class StateScales(NamedTuple):
    """The size of each coordinate and of each velocity, and the time that relates them."""

    x: Float[Array, " n"]
    u: Float[Array, " n"]
    t: Float[Array, ""]


class States(NamedTuple):
    """States in vector form, and which of them were moved onto the constraints (`found`)."""

    t: Float[Array, " N"]
    x: Float[Array, "N n"]
    u: Float[Array, "N n"]
    found: Bool[Array, " N"]


def draws(count: int, n: int) -> np.ndarray:
    """Relative displacements (count, 2 n + 1) of t, q and v, the same at each call; the first is zero."""
    random = np.random.default_rng(20).standard_normal((count, 2 * n + 1))
    which = np.arange(count) % len(WIDTHS)
    random[:, : n + 1] *= WIDTHS[which, None]
    # Velocity widths change more slowly, so that each width of positions is combined with each of velocities.
    random[:, n + 1 :] *= VELOCITY_WIDTHS[(np.arange(count) // len(WIDTHS)) % len(WIDTHS), None]
    random[0] = 0.0
    return random


def around(model: Model, s: coordinates.State, places) -> tuple[States, StateScales]:
    """The states at the displacements `places` from a given one, moved onto the constraints."""
    # With concrete values only the program that moves states is compiled, and all questions about a system share it.
    xp = numpy_of((s, model))
    x, u = (xp.asarray(coordinates.vector(tree)) for tree in (s.q, s.v))
    n, scales = len(x), sizes(model, s, x, u)
    places = places.astype(x.dtype)
    t = s.t + scales.t * places[:, 0]
    xs, us = x[None] + scales.x[None] * places[:, 1 : n + 1], u[None] + scales.u[None] * places[:, n + 1 :]
    # A velocity width of zero means a state at rest, not the velocity of the given state.
    resting = np.all(places[:, n + 1 :] == 0, axis=1) & (np.arange(len(places)) > 0)
    us = xp.where(resting[:, None], xp.zeros_like(us), us)
    if not model.m:
        return States(t, xs, us, np.ones(len(places), bool)), scales
    states = States(t, *(xp.asarray(y) for y in _onto_constraints(model, scales, t, xs, us)))
    # With concrete values, states that failed to reach the constraints are tried again closer to the given one.
    for nearer in NEARER if xp is np else ():
        if np.mean(states.found) > ENOUGH:
            break
        xs, us = x[None] + nearer * (xs - x[None]), u[None] + nearer * (us - u[None])
        again = [np.asarray(y) for y in _onto_constraints(model, scales, t, xs, us)]
        taken = (~states.found & again[2])[:, None]
        found = states.found | again[2]
        states = States(t, np.where(taken, again[0], states.x), np.where(taken, again[1], states.u), found)
    return states, scales


def sizes(model: Model, s: coordinates.State, x, u) -> StateScales:
    """The size of each coordinate and velocity of a state."""
    xp, same = numpy_of((x, u)), _groups(s.q)

    def together(y: Array):
        return xp.sqrt(same.astype(y.dtype) @ y**2)

    of_x = together(x)
    of_x = xp.where(of_x > 0, of_x, xp.ones_like(x))
    # Angles are at least 1: with small angles only, a pendulum would look like a harmonic oscillator.
    is_angle = remembered(model, are_angles, lambda: are_angles(model))
    of_x = xp.where(is_angle, xp.maximum(of_x, 1.0).astype(of_x.dtype), of_x)
    of_u = together(u)
    # A zero velocity has no size: it gets the pace of the others, or one length per unit of time.
    pace = xp.sqrt(xp.mean((of_u / of_x) ** 2))
    pace = xp.where(pace > 0, pace, xp.ones_like(pace))
    return StateScales(of_x, xp.where(of_u > 0, of_u, pace * of_x), 1 / pace)


def _groups(q: PyTree) -> np.ndarray:
    """Which coordinates share one size, (n, n): those of an array, and those of a point."""
    label = np.zeros(0, int)
    for i, leaf in enumerate(jax.tree.leaves(q)):
        label = np.concatenate([label, np.full(int(np.prod(np.shape(leaf))), i)])
    for point in points(q):
        places = [place for place in point.places if place is not None]
        label[places] = label[places[0]]
    return label[:, None] == label[None, :]


@compiled
def _onto_constraints(model: Model, scales, t, xs, us):
    return jax.vmap(lambda t, x, u: _on_constraints(model, scales, t, x, u))(t, xs, us)


def _on_constraints(model: Model, scales, t, x, u):
    def position(x: Array):
        return constraints.position_residual(model, t, x)

    def velocity(x: Array, u: Array):
        return constraints.velocity_residual(model, t, x, u)

    holds = jnp.asarray(True)
    if model.holonomic.any():
        x = _newton(position, x, scales.x)
        holds = _vanishes(position, x, scales.x)
    u = _newton(lambda u: velocity(x, u), u, scales.u)
    return x, u, holds & _vanishes(lambda u: velocity(x, u), u, scales.u)


def _newton(residual, y, scale):
    def step(y, r, i):
        rows = jax.jacfwd(residual)(y) * scale[None]
        return scale * (jnp.linalg.pinv(rows, rtol=DEPENDENT_BELOW) @ r)

    return newton(residual, step, y, ITERATIONS)


def _vanishes(residual, y, scale):
    terms = jnp.abs(jax.jacfwd(residual)(y)) @ jnp.maximum(scale, jnp.abs(y))
    return jnp.all(jnp.abs(residual(y)) <= ROUND_OFFS * jnp.finfo(y.dtype).eps * terms)


class Precision(NamedTuple):
    """Values up to these, relative to the size that they could have, are round-off.

    `null`: of a rate of change; `zero`: of an entry of a combination; `exact`: of a rate that needs no gauge function;
    `agrees`: of the difference of two numbers that are taken to be equal.
    """

    null: float
    zero: float
    exact: float
    agrees: float


PRECISIONS = {
    np.dtype("float64"): Precision(null=1e-9, zero=1e-8, exact=1e-13, agrees=1e-9),
    np.dtype("float32"): Precision(null=2e-4, zero=1e-3, exact=3e-5, agrees=1e-4),
}


def precision_of(dtype) -> Precision:
    """The tolerances of a dtype."""
    return PRECISIONS[np.dtype(dtype)]


class Affine(eqx.Module):
    """K generators of the form ξ = shift + matrix x + t drift, τ = clock + t clock_rate."""

    shift: np.ndarray
    matrix: np.ndarray
    drift: np.ndarray
    clock: np.ndarray
    clock_rate: np.ndarray

    def at(self, t, x, u) -> GeneratorFlow:
        """The flow of each generator at a state."""

        def to(y: Array):
            return jnp.asarray(y, x.dtype)

        xi = to(self.shift) + to(self.matrix) @ x + t * to(self.drift)
        xi_rate = to(self.matrix) @ u + to(self.drift)
        tau, tau_rate = to(self.clock) + t * to(self.clock_rate), to(self.clock_rate)
        return GeneratorFlow(xi, tau, jnp.zeros_like(tau), xi_rate, tau_rate, jnp.zeros_like(tau))


class Rates(NamedTuple):
    """The rates for N states, m constraint equations and K generators, relative to the size that they could have.

    `charge` (N, K): the rate due to L, force and dissipation together; `lagrangian` and `force`: its two parts.
    `displacement` (N, m, K): how much each constraint equation forbids ξ - τ v. `invariance` (N, m, K): how much the
    motion changes a velocity constraint. `value` (N,): L.

    Not relative: `size` (K,) of each generator; `energy` (N,), the e of each state; `xi` (N, K, n), `tau` (N, K);
    `charges` (N, K), the charges themselves; `first` (K,) and `pushed` (m, K): the rate without constraints and
    A (ξ - τ v), both at the first state.
    """

    states: States
    charge: Float[Array, "N K"]
    lagrangian: Float[Array, "N K"]
    force: Float[Array, "N K"]
    displacement: Float[Array, "N m K"]
    invariance: Float[Array, "N m K"]
    value: Float[Array, " N"]
    size: Float[Array, " K"]
    energy: Float[Array, " N"]
    xi: Float[Array, "N K n"]
    tau: Float[Array, "N K"]
    charges: Float[Array, "N K"]
    first: Float[Array, " K"]
    pushed: Float[Array, "m K"]


class _StateRates(NamedTuple):
    """The quantities at one state, not relative."""

    by_lagrangian: Array
    by_force: Array
    forbidden: Array
    slope: Array
    changed: Array
    size: Array
    energy: Array
    xi: Array
    tau: Array
    value: Array
    charges: Array


def rates(model: Model, affine: Affine, generators: tuple[Generator, ...], s, places) -> Rates:
    """The rates of change of all charges at states around the given one."""
    states, scales = around(model, s, places)
    raw = _rates(model, affine, generators, states, scales)
    xp = numpy_of(raw)
    raw = _StateRates(*(xp.asarray(y) for y in raw))
    finite = xp.isfinite(raw.energy) & xp.all(xp.isfinite(raw.by_lagrangian + raw.by_force), axis=1)
    found = states.found & finite

    def kept(y: Array):
        return xp.where(found.reshape(-1, *[1] * (y.ndim - 1)), y, xp.zeros_like(y))

    count = xp.maximum(xp.sum(found), 1).astype(raw.energy.dtype)
    size = xp.sqrt(xp.sum(kept(raw.size) ** 2, axis=0) / count)
    size = xp.where(size > 0, size, xp.ones_like(size))
    # A state where nothing moves and no force acts has no scale of its own.
    energy = kept(raw.energy) + raw.energy.dtype.type(1e-12) * xp.max(kept(raw.energy))
    energy = xp.where(found & (energy > 0), energy, xp.ones_like(energy))

    def relative(y: Array):
        return kept(y) / (energy[:, None] * size[None])

    slope = xp.where(raw.slope > 0, raw.slope, xp.ones_like(raw.slope))[:, :, None] * size[None, None]
    return Rates(
        states._replace(found=found),
        relative(raw.by_lagrangian + raw.by_force), relative(raw.by_lagrangian), relative(raw.by_force),
        kept(raw.forbidden) / slope, kept(raw.changed) * scales.t / slope, kept(raw.value) / energy,
        size, energy, kept(raw.xi), kept(raw.tau), raw.charges, (raw.by_lagrangian + raw.by_force)[0], raw.forbidden[0],
    )  # fmt: skip


@compiled
def _rates(model: Model, affine, generators, states, scales) -> _StateRates:
    params, equations = model.params, equations_of(model) if model.reacts else None

    def at(t, x, u):
        value, (slope_t, slope, p) = jax.value_and_grad(model.lagrangian, argnums=(0, 1, 2))(t, x, u)
        q, v = model.tree(x), model.tree(u)
        flows = [flow(generator, t, q, v, params) for generator in generators]
        moved = jtu.tree_map(
            lambda first, *rest: jnp.concatenate([first, *(y[None] for y in rest)]), affine.at(t, x, u), *flows
        )
        turned = moved.xi_rate - jnp.outer(moved.tau_rate, u)
        displaced = moved.xi - jnp.outer(moved.tau, u)
        # ρ and C of `noether.py`.
        of_L = moved.tau * slope_t + moved.xi @ slope + turned @ p + value * moved.tau_rate - moved.gauge_rate
        charges = displaced @ p + moved.tau * value - moved.gauge
        multipliers = None if equations is None else model.stacked(equations.accelerations(t, q, v)[1])
        force = applied_force(model, t, x, u, multipliers)
        energy = jnp.abs(p) @ jnp.abs(u) + (jnp.abs(slope) + jnp.abs(force)) @ scales.x
        size = jnp.sqrt(moved.xi**2 @ (1 / scales.x**2)) + jnp.abs(moved.tau) / scales.t
        rows = _constraint_rates(model, scales, (t, x, u), moved, turned, displaced)
        return _StateRates(of_L, displaced @ force, *rows, size, energy, moved.xi, moved.tau, value, charges)

    return jax.vmap(at)(*states[:3])


def _constraint_rates(model: Model, scales, state, moved, turned, displaced):
    """A (ξ - τ v) (m, K), the size of each row of A (m,), and the change of each velocity constraint (m, K)."""
    t, x, u = state
    if not model.m:
        empty = jnp.zeros((0, moved.tau.size), x.dtype)
        return empty, jnp.zeros(0, x.dtype), empty
    of_t, of_x, rows = jax.jacfwd(lambda t, x, u: constraints.velocity_residual(model, t, x, u), argnums=(0, 1, 2))(
        t, x, u
    )
    change = jnp.outer(of_t, moved.tau) + of_x @ moved.xi.T + rows @ turned.T
    return rows @ displaced.T, jnp.abs(rows) @ scales.x, change


STATES, AT_LEAST = 64, 8


class SymmetryTest(eqx.Module):
    """Whether a generator is a symmetry that conserves its charge; `bool(test)` is True if it is. It prints itself.

    Each residual is the largest over `states` states, relative to the size that its terms could have. A broken symmetry
    has a residual of about 1, or as small as the term that breaks it.

    - `residual`: the largest of those below, without `invariance`.
    - `lagrangian`: how much L changes, beyond the gauge term; `force`: the work of force and dissipation along the
      displacement; `charge_rate`: both together, which may cancel; `displacement`: by constraint, how much of the
      displacement is forbidden.
    - `invariance`: by velocity constraint, how much the motion changes the constraint itself.
    - `charge`, `rate`: the charge at the given state, `[L] [t]`, and its predicted rate of change there, `[L]`.
    """

    name: str = eqx.field(static=True)
    residual: Float[Array, ""]
    charge_rate: Float[Array, ""]
    lagrangian: Float[Array, ""]
    force: Float[Array, ""]
    has_forces: bool = eqx.field(static=True)
    displacement: dict[str, Array]
    invariance: dict[str, Array]
    charge: Float[Array, ""]
    rate: Float[Array, ""]
    states: Array
    at: str = eqx.field(static=True)

    @property
    def tolerance(self) -> float:
        """The residual up to which the symmetry counts as unbroken in this dtype."""
        return precision_of(self.residual.dtype).null

    @property
    def holds(self) -> Array:
        """Whether it is a symmetry, as an array; False where the residual is NaN."""
        return self.residual <= self.tolerance

    def __bool__(self):
        return bool(self.holds)

    def broken_by(self) -> list[str]:
        """The parts of the system that break the symmetry, in words."""
        parts = {"L": self.lagrangian, "the forces": self.force} if self.charge_rate > self.tolerance else {}
        forbidden = {f"constraint '{name}'": value for name, value in self.displacement.items()}
        return [name for name, value in (parts | forbidden).items() if not value <= self.tolerance]

    def __repr__(self):
        if is_traced(self.residual):
            return f"SymmetryTest({self.name}, being traced)"
        if np.ndim(self.residual):
            kept = np.asarray(self.holds)
            return f"SymmetryTest({self.name}: a symmetry in {kept.sum()} of {kept.size} lanes)"
        rows = [("L", f"changes by {float(self.lagrangian):.0e} of what it could")]
        if self.has_forces:
            rows.append(("forces", f"do work along it, {float(self.force):.0e} of what they could"))
        for name, value in self.displacement.items():
            allowed = value <= self.tolerance
            words = "allows it" if allowed else "forbids it"
            unchanged = name in self.invariance and self.invariance[name] <= self.tolerance and not allowed
            rows.append((f"constraint '{name}'", words + (", though it looks the same" if unchanged else "")))
        rows.append(("charge", f"{float(self.charge):.9g}" + (f", at {self.at}" if self.at else "")))
        rows.append(("its rate there", "0" if self else f"{float(self.rate):.9g}"))
        verdict = "conserved by a symmetry" if self else f"no symmetry: broken by {' and '.join(self.broken_by())}"
        return labelled(
            f"{self.name}: {verdict}; residual {float(self.residual):.0e} over {int(self.states)} states", rows
        )


def is_symmetry(system, generator, q: PyTree, v: PyTree, params: PyTree = None, *, t=0.0) -> SymmetryTest:
    """Test whether a one-parameter group is a symmetry of a system and conserves its charge.

    >>> import lagjax as lj
    >>> def falling(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]
    >>> start = {"x": 0.0, "y": 1.0}, {"x": 2.0, "y": 0.0}
    >>> print(bool(is_symmetry(lj.System(falling), lj.Generator.shift("x"), *start, {"g": 10.0})))
    True
    >>> is_symmetry(lj.System(falling), lj.Generator.shift("y"), *start, {"g": 10.0})
    p_y: no symmetry: broken by L; residual 1e+00 over 64 states
      L               changes by 1e+00 of what it could
      charge          0, at t = 0, q = (x = 0, y = 1), v = (x = 2, y = 0)
      its rate there  -10

    **Arguments:** `generator` as for `noether_charge`; `q` and `v` of the same structure, `params` as the system takes
    it, `t` scalar: a state. Others, the same at each call, are drawn around it on the constraints, on the scale of its
    size.

    **Returns:** a `SymmetryTest`, true for a symmetry, with the residual, what breaks it, and the rate of change of the
    charge that this predicts. A charge without a symmetry may still be constant, if the constraints happen to exert no
    force. Inside `jit`, `vmap` or a sweep use `.holds` or `.residual`.

    **Raises:** as `noether_charge`; `ValueError` if no states are found that satisfy the constraints and at which L is
    finite (while JAX is tracing the residual is NaN instead).

    Source: Goldstein, *Classical Mechanics*, §13.7; Neĭmark & Fufaev, *Dynamics of Nonholonomic Systems*, §III.6.
    """
    check_system(system, generator, q, v, params, states=False)
    generator = as_generator(generator)
    s = coordinates.state(t, q, v, params)
    model = model_of(traced_system(system, s), *s)
    generator.check(s)
    system, n = model.system, model.n
    empty = np.zeros((0, n))
    affine = Affine(empty, np.zeros((0, n, n)), empty, np.zeros(0), np.zeros(0))
    found = rates(model, affine, (generator,), s, draws(STATES, n))
    xp = numpy_of(found)
    count = xp.sum(found.states.found)
    if xp is np and count < AT_LEAST:
        raise ValueError(too_few(system, s, int(count)))

    def largest(y: Array):
        return xp.max(xp.abs(y))

    def by_name(y: Array):
        return {name: largest(value) for name, value in model.split(xp.max(xp.abs(y[:, :, 0]), axis=0)).items()}

    displacement, invariance = by_name(found.displacement), by_name(found.invariance)
    of_velocities = {name for name, c in system.constraints.items() if not c.of_positions}
    residual = xp.max(xp.stack([largest(found.charge), *displacement.values()]))
    at = s._replace(t=found.states.t[0], q=model.tree(found.states.x[0]), v=model.tree(found.states.u[0]))
    rate = found.first[0]
    if model.m:
        multipliers = accelerations_at(model, at)[1]
        rate = rate + xp.concatenate([xp.ravel(multipliers[name]) for name in system.constraints]) @ found.pushed[:, 0]
    return SymmetryTest(
        generator.name,
        xp.where(count < AT_LEAST, xp.full_like(residual, xp.nan), residual),
        largest(found.charge), largest(found.lagrangian), largest(found.force),
        system.is_forced,
        displacement, {name: invariance[name] for name in sorted(of_velocities)},
        found.charges[0, 0], rate, count,
        "" if xp is not np else f"t = {float(s.t):.6g}, q = {describe(at.q)}, v = {describe(at.v)}",
    )  # fmt: skip


def too_few(system, s, count) -> str:
    """The message that a symmetry could not be tested."""
    cause = "constraints that the given state is far from" if system.constraints else "a state where L is not finite"
    return (
        f"only {count} states were found around q = {describe(s.q)} that satisfy the constraints and where L is finite."
        f"\nUsual cause: {cause}, or a state at the edge of the domain of L.\n"
        "Fix: a state from the middle of the motion; lj.consistent_state(system, t, q, v, params) moves one onto the "
        "constraints."
    )
