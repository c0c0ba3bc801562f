"""The equations of a branch of cycles: motions that close, with one parameter free.

The unknowns are the states z_j at K equal parts of the period T, in units of the motion's size, `log T` and the
parameter μ. With the flow Φ of `flow.py`,

    Φ(z_j, T/K; μ) - z_{j+1} = 0,      z_K = z_0 + turns        the motion closes
    c(t_j, z_j; μ) = 0                                          its states satisfy the constraints
    f·(z_0 - z_0') = 0                                          the phase is that of the last point of the branch
    H(z_0; μ) = H_0, or a coordinate, or T                      the held quantity selects a member of a family
    V·(y - y_0) = 0                                             directions still free at the branch's start are fixed

f and z_0' belong to the last point of the branch (Poincaré's condition). A drive sets the period: T is the time after
which the accelerations at some times, for a state off the motion, repeat:

    Σ_i d_i·(a(t_i + T; μ) - a(t_i; μ)) = 0,       t_i = t_0 + c_i T,      d_i = ∂a/∂t at the start

There are more equations than unknowns if a conserved quantity makes some of them redundant. The flow carries tangents
with respect to μ and `log T` together with those with respect to the state.

Of a motion with switches the flow is that of `flow.py`: the branch ends where other switches occur in its
cycles. A drive is then seen in the accelerations of the first phase, and c are the constraints of that phase.

Along a branch two functions of the monodromy matrix N are monitored. With the rows Q of its trivial
directions and P = 1 - QᵀQ,

    χ₊ = det (P (N - 1) P + QᵀQ),      χ₋ = det (P (N + 1) P + QᵀQ)

are the products of μ - 1 and μ + 1 over the nontrivial multipliers. χ₊ is zero at a fold and where other cycles branch
off, χ₋ where cycles of twice the period branch off. Where multipliers meet, both remain as smooth as N.

Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.4-7.6; Doedel, Keller & Kernévez, Int. J. Bifurcation
Chaos 1 (1991) 745; Muñoz-Almaraz et al., *Physica D* 181 (2003) 1 (families of conservative systems); Kuznetsov,
*Elements of Applied Bifurcation Theory*, §10.2.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lagjax.analysis.arclength import (
    Along,
    BranchPoint,
    BranchProblem,
    CriticalPoint,
    Monitor,
    count_changes,
    sign_changes,
    zero,
)
from lagjax.analysis.flow import Changes, Flow, SwitchingFlow
from lagjax.analysis.monodromy import Reasons, directions, orthonormal, without
from lagjax.analysis.shooting import (
    SAMPLED_AT,
    TURN,
    Goal,
    OrbitRequest,
    change_in_a_period,
    closing_rows,
    comes_back,
    held_off,
    in_parts,
    integral_at,
    left_open,
    slope_of_integral,
    times_of,
)
from lagjax.integrate import Switches
from lagjax.jaxtools import compiled

# The number of points between which the extreme coordinates are interpolated, and of short steps to each point.
POINTS, SUBSTEPS = 96, 8
# The parameter is a number in `params`, the energy, the period, or an entry of the first state.
ENERGY, PERIOD, ENTRY = "energy", "period", "entry"


class Drive(eqx.Module):
    """A state z at which accelerations are sampled, and their time derivatives `slopes` (i, n) at the start."""

    z: Float[Array, " 2n"]
    slopes: Float[Array, "i n"]


class Guide(NamedTuple):
    """The last point of the branch: the first state of its motion, and the direction of its rate there."""

    z: Float[Array, " 2n"]
    rate: Float[Array, " 2n"]


class OrbitFrame(eqx.Module):
    """The data that stay the same along a branch: the flow at its start, units, and held quantities.

    - `scale` (2n,): the size of each coordinate and velocity; `period`: its unit; `unit`: that of the parameter.
    - `turns` (n,): whole turns of each coordinate; `goal`: the energy and the state at the start, which may be held.
    - `slope`: the size of the energy's gradient; `sizes` (c,): the sizes of the constraints' gradients.
    - `drive`: None unless a drive sets the period and makes it change with the parameter.
    - `free` (d, N), `reference` (N,): V and y_0, the fixed combinations of unknowns and the point they refer to.
    """

    flow: Flow | SwitchingFlow
    t: Float[Array, ""]
    scale: Float[Array, " 2n"]
    period: Float[Array, ""]
    unit: Float[Array, ""]
    turns: Float[Array, " n"]
    goal: Goal
    slope: Float[Array, ""]
    sizes: Float[Array, " c"]
    drive: Drive | None
    free: Float[Array, "d N"]
    reference: Float[Array, " N"]
    along: Along
    asked: OrbitRequest = eqx.field(static=True)
    reasons: Reasons = eqx.field(static=True)
    parts: int = eqx.field(static=True)

    def split(self, z) -> tuple[Flow | SwitchingFlow, Float[Array, "K 2n"], Float[Array, ""]]:
        """The flow at a point, the nodes and the period."""
        flow, value = self.flow, z[-1] * self.unit
        if self.along.number is not None:
            flow = flow.of(self.along.number.put(flow.model.params, value))
        nodes = z[:-2].reshape(self.parts, -1) * self.scale[None]
        return flow, nodes, self.period * jnp.exp(z[-2])


class Evaluated(NamedTuple):
    """The equations evaluated at a point: E, its Jacobian, the largest entry of E, and the monodromy matrix.

    - `whole` (k, k): the monodromy matrix in tangent coordinates; `trivial` (r, k): orthonormal rows of its trivial
      directions; `there` (r,): which of these exist.
    - `guide`: the guide for the next point. `amplified`: the largest entry of a tangent frame. `apart`: how much a
      driven system has changed after the period. `ways` (S,): the switches in a period; None without phases.
    """

    value: Float[Array, " R"]
    jacobian: Float[Array, "R N+1"]
    largest: Float[Array, ""]
    whole: Float[Array, "k k"]
    trivial: Float[Array, "r k"]
    there: Bool[Array, " r"]
    guide: Guide
    amplified: Float[Array, ""]
    apart: Float[Array, ""]
    ways: Int[Array, " S"] | None


@compiled
def orbit_at(frame: OrbitFrame, z, guide: Guide) -> Evaluated:
    """Follow the flow through all parts, with tangents."""
    flow, nodes, period = frame.split(z)
    count, size, scale = frame.parts, frame.scale.size, frame.scale
    times, span = times_of(frame.t, period, count), period / count
    columns = jnp.concatenate([jnp.eye(size, dtype=z.dtype), jnp.zeros((size, 2), z.dtype)], axis=1)

    def part(j, t, node):
        return flow.passage(t, node, span, columns, scale, changes=_changes(frame, flow, z, j, span))

    passed = in_parts(part, jnp.arange(count), times, nodes)
    closing = left_open(frame.asked, nodes, passed.z, frame.turns, scale)
    bases = jnp.broadcast_to(jnp.eye(size, dtype=z.dtype), (count, size, size))
    slopes = closing_rows(passed.frame, bases).at[-size:].multiply(comes_back(frame.asked, z.dtype)[:, None])

    def others(z: Array):
        return _others(frame, z, guide)

    value = jnp.concatenate([closing.reshape(-1), others(z)])
    jacobian = jnp.concatenate([slopes, jax.jacfwd(others)(z)])

    good = jnp.all(passed.ended) & jnp.all(jnp.isfinite(jacobian))
    if passed.returns is not None:
        good = good & jnp.all(passed.returns)
    rate = flow.rates(times, nodes, passed, span)[0]
    whole, trivial, there = _monodromy(frame, flow, times[0], nodes[0], passed.frame[:, :, :size], rate * period)
    rate = rate * period / scale
    length = jnp.linalg.norm(rate)
    return Evaluated(
        jnp.where(good, value, jnp.nan), jacobian, jnp.max(jnp.abs(value)), whole, trivial, there,
        Guide(nodes[0] / scale, rate / jnp.where(length > 0, length, 1.0)),
        jnp.max(jnp.abs(passed.frame)), _apart(frame, flow.start, period), _ways(passed.switches),
    )  # fmt: skip


def _ways(switches: Switches | None):
    """Which switches occur, and into which modes of elements they lead."""
    if switches is None:
        return None
    ways = switches.way[-1]
    return ways if switches.modes is None else jnp.concatenate([ways[:, None], switches.modes[-1]], axis=1)


def _changes(frame, flow, z, j, span) -> Changes:
    """How parameters and times change with the frame columns: with μ, with log T, and not at all with the state."""
    last = jnp.eye(z.size, dtype=z.dtype)[-1]

    def floats(z: Array):
        return eqx.filter(frame.split(z)[0].model.params, eqx.is_inexact_array)

    if frame.along.number is None:
        by_number = jax.tree.map(jnp.zeros_like, floats(z))
    else:
        by_number = jax.jvp(floats, (z,), (last,))[1]

    def rows(x: Array):
        return jnp.concatenate([jnp.zeros((frame.scale.size + 1, *x.shape), x.dtype), x[None]])

    def by_log_period(x: Array):
        return jnp.zeros(frame.scale.size + 2, z.dtype).at[-2].set(x)

    return Changes(jax.tree.map(rows, by_number), by_log_period(j * span), by_log_period(span))


def _others(frame: OrbitFrame, z, guide):
    """All equations except those that close the motion."""
    flow, nodes, period = frame.split(z)
    along, asked, value = frame.along, frame.asked, z[-1] * frame.unit
    parts = []
    if flow.dimension < frame.scale.size:
        off = jax.vmap(flow.start.residual)(times_of(frame.t, period, frame.parts), nodes)
        parts.append((off / frame.sizes[None]).reshape(-1))
    first = nodes[0] / frame.scale
    if asked.moves:
        parts.append((guide.rate @ (first - guide.z))[None])
    if along.kind == PERIOD:
        parts.append((period - value)[None] / frame.period)
    elif frame.drive is not None:
        parts.append(drive_off(frame, flow.start, period)[None])
    elif not asked.free:
        parts.append(z[-2:-1])
    goal = frame.goal
    if along.kind == ENERGY:
        goal = goal._replace(integral=value)
    elif along.kind == ENTRY:
        goal = goal._replace(z=jnp.asarray(goal.z).at[along.entry].set(value))
    held = held_off(flow.start, frame.t, nodes[0], asked, goal, frame.slope, frame.scale)
    parts += [off[None] for off in held]
    return jnp.concatenate([*parts, frame.free @ (z[:-1] - frame.reference)])


def drive_off(frame: OrbitFrame, flow, period):
    """The mismatch between T and the time after which the driven system repeats, as a fraction of the period."""
    drive = frame.drive
    assert drive is not None
    square = jnp.sum(drive.slopes**2)
    return jnp.sum(drive.slopes * _changed(frame, flow, period)) / (square * frame.period)


def _changed(frame, flow, period):
    """The change of the accelerations after a period, at the sampled times."""
    drive = frame.drive

    def at(t: Array):
        return flow.rate(t, drive.z)[flow.size :] / frame.scale[flow.size :]

    return change_in_a_period(at, frame.t, period)


def drive_of(flow: Flow, t, z, period, scale) -> Drive:
    """The drive at the branch's start, at a state off the motion: on it a parametric drive may have no effect."""
    displaced = z + scale * jnp.cos(jnp.arange(1.0, z.size + 1.0, dtype=z.dtype))
    times = t + period * jnp.asarray(SAMPLED_AT, t.dtype)

    def at(t: Array):
        return flow.rate(t, displaced)[flow.size :] / scale[flow.size :]

    slopes = jax.vmap(lambda t: jax.jvp(at, (t,), (jnp.ones_like(t),))[1])(times + period)
    return Drive(displaced, slopes)


def _apart(frame, flow, period):
    if frame.drive is None:
        return jnp.zeros_like(period)
    size = jnp.max(jnp.abs(frame.drive.slopes)) * period
    return jnp.max(jnp.abs(_changed(frame, flow, period))) / jnp.where(size > 0, size, 1.0)


def _monodromy(frame, flow, t, z, frames, rate):
    """The monodromy matrix in tangent coordinates, and the orthonormal rows of its trivial directions."""
    basis, whole = flow.tangent_space(t, z, frame.scale), jnp.eye(z.size, dtype=z.dtype)
    for part in frames:
        whole = part @ whole
    rows = directions(flow, frame.reasons, t, z, rate, frame.scale, basis)
    length = jnp.linalg.norm(rate / frame.scale)
    trivial, there = orthonormal(frame.reasons, rows, jnp.maximum(TURN, 1e-3 * length))
    return basis.T @ whole @ basis, trivial, there


@compiled
def path_at(frame: OrbitFrame, z):
    """Times from the start (P,) and the states at them (P, 2n), computed with a few fixed steps for plots.

    Of a motion with switches by `integrate`, with NaN in spare rows.
    """
    flow, nodes, period = frame.split(z)
    if isinstance(flow, SwitchingFlow):
        return flow.path(frame.t, nodes[0], period, POINTS)
    each, span = -(-POINTS // frame.parts), period / frame.parts
    states = jax.vmap(lambda t, node: flow.path(t, node, span, each, SUBSTEPS))(
        times_of(frame.t, period, frame.parts), nodes
    )
    states = jnp.concatenate([states[:, :-1].reshape(-1, frame.scale.size), states[-1, -1:]])
    return period * jnp.arange(len(states), dtype=z.dtype) / (len(states) - 1), states


@compiled
def sizes_at(flow: Flow, t, z, period, scale):
    """The energy, the sizes of its gradient and of the constraints' gradients, in units of `scale`; and the drive."""
    rows = jnp.zeros(0, z.dtype)
    if flow.dimension < z.size:
        rows = jnp.linalg.norm(flow.normals(t, z, scale), axis=1)
    size = slope_of_integral(flow, t, z, scale)[1]
    return integral_at(flow, t, z), size, jnp.where(rows > 0, rows, 1.0), drive_of(flow, t, z, period, scale)


@compiled
def drive_by_parameter(frame: OrbitFrame, z):
    """d log T/dμ of a drive: the change of the logarithm of its period per unit of the scaled parameter."""

    def off(z):
        flow, _, period = frame.split(z)
        return drive_off(frame, flow.start, period)

    by_all = jax.grad(off)(z)
    return -by_all[-1] / by_all[-2]


# A driven system repeats if it changes by less than this from one period to the next, relative to its change in a
# period.
SAME = 1e-5
# Fractions of the largest motion: the branch ends at rest below the first; below the second, a start that passes an
# equilibrium is a state of rest too. A period of so many times the first one grows without end.
AT_REST, HALF, ENDLESS = 1e-3, 0.5, 1e3
# How often a branch is bisected where a pair leaves the unit circle, but nothing smooth shows it.
HALVINGS = 40
# A multiplier within this many square roots of the error of N is on the unit circle: a double one is off by that much.
ON_CIRCLE = 3.0


class OrbitOutputs(NamedTuple):
    """The outputs of a point, and the monitored functions: χ₊, χ₋, and `pairs`, which is zero where a pair leaves.

    - `multipliers` (k,): the trivial ones first.
    - `low`, `high` (n,): the smallest and largest value of each coordinate; `moves`: their largest distance, scaled.
    """

    parameter: float
    period: float
    nodes: np.ndarray
    multipliers: np.ndarray
    low: np.ndarray
    high: np.ndarray
    plus: float
    minus: float
    pairs: float
    moves: float


def _turn(problem, a, b) -> CriticalPoint | None:
    """Where the parameter turns."""
    # At a pitchfork it turns along the side branch, where the multiplier only touches 1.
    kind = "fold" if a.sign * b.sign < 0 or not problem.isolated else "branch point"
    return zero(kind, lambda p: p.tangent[-1], problem, a, b)


def _torus(problem, a, b) -> CriticalPoint | None:
    """The point where a pair leaves the unit circle; None if what begins to grow is not a pair."""
    many = a if a.growing > b.growing else b
    outside = [x for x in many.outputs.multipliers if abs(x) > 1]
    slowest = min(outside, key=abs, default=1.0)
    if abs(np.imag(slowest)) < 1e-3 * abs(slowest):
        return None
    found = zero("torus", lambda p: p.outputs.pairs, problem, a, b)
    if found is not None:
        return found
    left, right = problem.halved(a, b, lambda p: p.growing, HALVINGS)
    if left is a and right is b:
        return None
    point = right if left is a else left
    return CriticalPoint("torus", point.z, abs(float(right.z[-1] - left.z[-1])), point=point)


def _zero_of(kind: str, name: str, alone: bool) -> Monitor:
    """A smooth function of the multipliers, which is zero at critical points of a kind."""
    value = lambda point: getattr(point.outputs, name)
    return Monitor(value, sign_changes, partial(zero, kind, value), alone, smooth=True)


# The direction of the parameter, χ₊, χ₋, and the multipliers outside the unit circle.
MONITORS = (
    Monitor(lambda point: point.tangent[-1], sign_changes, _turn),
    _zero_of("branch point", "plus", alone=True),
    _zero_of("period doubling", "minus", alone=False),
    Monitor(lambda point: point.growing, count_changes, _torus),
)


class CycleProblem(BranchProblem):
    """Cycles of an `OrbitFrame`.

    `guide`: the last point of the branch. `isolated`: whether only trivial directions lead from a cycle to others at
    the same parameter; if not, χ₊ is zero everywhere and shows nothing.
    """

    monitors = MONITORS

    def __init__(self, frame: OrbitFrame, low: float, high: float, guide: Guide, isolated: bool):
        super().__init__(low, high)
        self.frame, self.along, self.guide, self.isolated = frame, frame.along, guide, isolated
        nodes = frame.parts * frame.scale.size
        self.positions = nodes
        self.weights = np.append(np.full(nodes, 1 / frame.parts), [1.0, 1.0])
        self.dtype = np.dtype(frame.scale.dtype)
        self.unit = float(frame.unit)
        self.amplified = 1.0
        self.cached: tuple[bytes, Evaluated] | None = None
        # The switches in the cycle of the last point.
        self.ways: np.ndarray | None = None

    @property
    def noise(self) -> float:
        return max(self.eps, float(self.frame.flow.rtol) * max(1.0, self.amplified))

    def repeats(self, z) -> tuple[bool, bool]:
        """Whether a driven motion with switches that begins a period later is the same, and its change with μ too."""
        evaluation = self.evaluated(z)
        if self.frame.reasons.autonomous or evaluation.ways is None:
            return True, True
        period = np.asarray(float(self.frame.period) * np.exp(z[-2]), self.dtype)
        later = orbit_at(replace(self.frame, t=self.frame.t + period), z.astype(self.dtype), self.guide)
        rows, same = slice(self.positions), max(SAME, 1e3 * self.eps)
        value, change = (np.asarray(x) for x in (later.value - evaluation.value, later.jacobian - evaluation.jacobian))
        largest = max(1.0, np.max(np.abs(evaluation.jacobian[rows, -1])))
        return bool(np.max(np.abs(value[rows])) <= same), bool(np.max(np.abs(change[rows, -1])) <= same * largest)

    def evaluated(self, z) -> Evaluated:
        """The equations evaluated at a point; the result for the last point is cached."""
        z = z.astype(self.dtype)
        key = b"".join(np.asarray(x).tobytes() for x in (z, *self.guide))
        if self.cached is None or self.cached[0] != key:
            self.cached = key, jax.tree.map(np.asarray, orbit_at(self.frame, z, self.guide))
        return self.cached[1]

    def residual(self, z):
        evaluation = self.evaluated(z)
        if np.isfinite(evaluation.amplified):
            self.amplified = float(evaluation.amplified)
        return evaluation.value, evaluation.jacobian, float(evaluation.largest)

    def moved_to(self, point):
        evaluation = self.evaluated(point.z)
        self.guide = evaluation.guide
        self.ways = None if evaluation.ways is None else np.asarray(evaluation.ways)

    def described(self, z, jacobian, tangent) -> BranchPoint | str:
        evaluation = self.evaluated(z)
        if float(evaluation.apart) > max(SAME, 1e3 * self.eps):
            return "the system is not the same after any period near the last one: its drive has no common period"
        if self.ways is not None and not np.array_equal(self.ways, evaluation.ways):
            return (
                f"other switches, near {self.value_of(z)}: the start comes to a switch (another state of the cycle as "
                "the start of lj.periodic_orbit goes on), or the motion grazes, or a phase begins or ends"
            )
        if not self.repeats(z)[0]:
            return "the period of the drive changes, which only accelerations of the first phase show"
        multipliers, left = self._multipliers(evaluation)
        plus, minus = (self._product(evaluation, shift) for shift in (-1.0, 1.0))
        times, states = path_at(self.frame, z.astype(self.dtype))
        low, high = extent(np.asarray(times), np.asarray(states))
        size = np.abs(left)
        within = ON_CIRCLE * np.sqrt(self.noise)
        growing = int(np.sum(size > 1 + within)) if np.all(np.isfinite(size)) else None
        period = float(self.frame.period) * np.exp(z[-2])
        nodes = z[:-2].reshape(self.frame.parts, -1) * np.asarray(self.frame.scale)
        outputs = OrbitOutputs(
            z[-1] * self.unit, period, nodes, multipliers, low, high, plus if self.isolated else 1.0, minus,
            self._pairs(left), float(np.max((high - low) / np.asarray(self.frame.scale)[: len(low)])),
        )  # fmt: skip
        return BranchPoint(z, jacobian, tangent, float(np.sign(outputs.plus)), outputs, growing)

    def ends(self, points, after, origin) -> str | None:
        before, name = points[-1], self.along.name
        if self.frame.asked.moves:
            largest = max(point.outputs.moves for point in points)
            shrinks = after.outputs.moves < AT_REST * largest
            if shrinks or self.guide.rate @ self.evaluated(after.z).guide.rate < 0:
                if before.outputs.moves < HALF * largest:
                    return f"a state of rest, near {name} = {self._at_rest(points):.6g}"
                # The orbit now begins and ends at an equilibrium, which takes infinitely long.
                return f"a period that grows without end, near {self.value_of(before.z)}"
        if after.outputs.period > ENDLESS * float(self.frame.period):
            return f"a period that grows without end, near {self.value_of(after.z)}"
        return None

    def _at_rest(self, points) -> float:
        """The parameter, extrapolated to a motion of size zero.

        It is linear in the square of the size; a coordinate of the start, in the size. A value that is negligible
        compared with the range is round-off.
        """
        b, power = points[-1].outputs, 1 if self.along.kind == ENTRY else 2
        parameter = b.parameter
        if len(points) > 1:
            a = points[-2].outputs
            m, n = a.moves**power, b.moves**power
            parameter = b.parameter + (b.parameter - a.parameter) * n / (m - n) if m > n else parameter
        return 0.0 if abs(parameter) < 1e-9 * self.unit else parameter

    def _multipliers(self, evaluation: Evaluated) -> tuple[np.ndarray, np.ndarray]:
        """All multipliers, the trivial ones first as exactly 1; and the nontrivial ones alone, by falling size."""
        count = int(np.sum(evaluation.there))
        left = np.linalg.eigvals(without(evaluation.trivial, evaluation.whole))
        left = left[np.argsort(np.abs(left - 1), kind="stable")][count:]
        left = left[
            np.lexsort((-left.imag, -np.round(np.abs(left) / max(np.max(np.abs(left), initial=0.0), 1e-300), 9)))
        ]
        return np.concatenate([np.ones(count, complex), left.astype(complex)]), left.astype(complex)

    def _product(self, evaluation, shift):
        shifted = evaluation.whole + shift * np.eye(len(evaluation.whole))
        return float(np.linalg.det(without(evaluation.trivial, shifted)))

    def _pairs(self, left):
        """A function that changes its sign where a pair leaves the unit circle.

        Without damping two pairs meet there, and the function is the product of (ρ_i - ρ_j)² with ρ = μ + 1/μ.
        Otherwise it is the logarithm of the size of the pair nearest to the circle.
        """
        upper = left[left.imag > 0]
        if not self.frame.reasons.momenta:
            slowest = np.abs(upper)[np.argmin(np.abs(np.log(np.abs(upper))))] if upper.size else 0.0
            return float(np.log(slowest)) if slowest else np.nan
        if left.size < 4:
            return np.nan
        rho, rest = [], list(left + 1 / left)
        while len(rest) > 1:
            # μ and 1/μ have the same ρ, so each value occurs twice.
            rho.append(rest.pop())
            rest.pop(int(np.argmin(np.abs(np.array(rest) - rho[-1]))))
        apart = np.array([(a - b) ** 2 for i, a in enumerate(rho) for b in rho[i + 1 :]])
        return float(np.prod(apart).real)


def extent(times, states):
    """The smallest and largest value of each coordinate on a path, with cubic interpolation between its points."""
    known = np.isfinite(times)
    times, states = times[known], states[known]
    x, u = np.split(states, 2, axis=1)
    h = np.diff(times)[:, None]
    x0, x1, m0, m1 = x[:-1], x[1:], h * u[:-1], h * u[1:]
    a, b, c = 2 * (x0 - x1) + m0 + m1, 3 * (x1 - x0) - 2 * m0 - m1, m0
    # The extrema of a cubic: 3 a s² + 2 b s + c = 0.
    root = np.sqrt(np.maximum(b**2 - 3 * a * c, 0.0))
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = [q / (3 * a), c / q]
    candidates = [x0, x1]
    for s in roots:
        inside = np.isfinite(s) & (s > 0) & (s < 1)
        s = np.where(inside, s, 0.0)
        candidates.append(((a * s + b) * s + c) * s + x0)
    return np.min(candidates, axis=(0, 1)), np.max(candidates, axis=(0, 1))
