"""The flow of a motion with its tangents: where a state goes, and where neighbouring states go; also over switches.

With z = (q, v) in vector form and f its rate, a tangent δ of the flow z(t) obeys the variational equation

    z' = f(t, z),        δ' = J δ,        J = ∂f/∂z,

and a frame of tangents, one in each column, is integrated along with z. Both together are one state for the method, so
that step sizes suit the tangents too: at rest in a driven system only the tangents move.

With constraints c(t, z) = 0 on positions and velocities the equations have reduced index, and the constraint manifold
is invariant; tangents that begin in its tangent space, C δ = 0 with C = ∂c/∂z, stay there. Coordinates of first order
(states, and what has no mass) have velocities φ(t, q, v) that are determined: v_first - φ = 0 is among the equations c.
So each of them adds one direction, not two. The volume of a frame that spans the tangent space grows by Liouville's
formula, with P the orthogonal projection onto it:

    d/dt log volume = tr P J,        without constraints tr J

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §I.14; Coddington & Levinson, *Theory of ODEs*, Eq. (3.1.5).

**Over switches** the flow is `lj.integrate` over a period, with its derivatives. A tangent that passes a switch jumps
with the state and with the time of the switch (the saltation matrix), which the forward derivatives of `integrate`
contain. So the end Φ of a period T from a state z gives, by one `jvp` for each column, what a smooth flow gets from its
variational equation:

    a frame B becomes (∂Φ/∂z) B,        the rate at the end is ∂Φ/∂T.

Where a motion sticks, or is struck without restitution, neighbouring states meet: ∂Φ/∂z is singular, with a multiplier
0 for each direction that is lost. The volume of a frame is not known independently.

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204; di Bernardo et al., *Piecewise-smooth Dynamical
Systems*, §2.5.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.contexts import WATCHED
from lagjax.integrate import (
    HybridTrajectory,
    Switches,
    ended_well,
    integrate,
    solve_in_both_modes,
    switches_before_any,
)
from lagjax.jaxtools import compiled, is_eager, is_traced, stop_gradient
from lagjax.mechanics import equations_of, resolved, with_first_order
from lagjax.numerics import Dopri8, last_step, newton
from lagjax.system import Hybrid, Model, State, System, constraints, coordinates, model_of

# Tight tolerances, because results about a cycle are differences after a whole period.
TOLERANCE = {np.dtype("float64"): 1e-12, np.dtype("float32"): 1e-5}
MAX_STEPS = 200_000
# For `Flow.path`: steps between output points, and the nodes and weights of the classical method of order 4.
SUBSTEPS, RUNGE_KUTTA = 16, (np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 2.0, 2.0, 1.0]) / 6)
# A step shorter than this fraction of the span means that the motion is singular there, or NaN.
SHORTEST = 1e-10
# The first step as a fraction of the span; the step-size control rejects it if it is too long.
FIRST = 0.02
# A constraint row is dependent if at most this fraction of it is independent of the others.
DEPENDENT_BELOW = 1e-6
ONTO_CONSTRAINTS = 3


class Passage(NamedTuple):
    """The end of a state z (2n,) and of a frame of tangents (2n, k) after a time.

    `growth`: the logarithm of the growth of a complete frame's volume by Liouville's formula; 0 if not requested. The
    other fields are those of a motion with switches: the `rate` at its end, whether it `returns` to the phase of its
    start, and the `phase` in which it ends.
    """

    z: Float[Array, " 2n"]
    frame: Float[Array, "2n k"]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    ended: Bool[Array, ""]
    rate: Float[Array, " 2n"] | None = None
    switches: Switches | None = None
    returns: Bool[Array, ""] | None = None
    phase: Int[Array, ""] | None = None


class Changes(NamedTuple):
    """The change of parameters (a tree of their floats, None elsewhere), start and span with each column, (k, ...)."""

    params: PyTree
    t0: Float[Array, " k"]
    span: Float[Array, " k"]


class Flow(eqx.Module):
    """The motion of a system in vector form; `rows` are the indices of independent constraint equations.

    `model`: one that knows its coordinates of first order.
    """

    model: Model
    rtol: Float[Array, ""]
    rows: tuple[int, ...] = eqx.field(static=True)
    in_a_loop: bool = eqx.field(static=True)

    @property
    def start(self) -> "Flow":
        """The flow near the start, which that of a motion in phases has too."""
        return self

    @property
    def size(self) -> int:
        """The number of coordinates."""
        return self.model.n

    def of(self, params: PyTree) -> "Flow":
        """The same with other parameters."""
        return replace(self, model=self.model.of(params))

    @property
    def determined(self) -> np.ndarray:
        """Which entries of z are velocities of coordinates of first order, (2n,) booleans."""
        first = self.model.form.first_order
        mask = np.zeros(self.size, bool) if first is None else first.mask(self.size)
        return np.concatenate([np.zeros(self.size, bool), mask])

    @property
    def dimension(self) -> int:
        """The dimension of the space of states: 2n without what constraints and determined velocities take away."""
        return 2 * self.size - len(self.rows) - int(self.determined.sum())

    def state(self, z):
        """(q, v) in the user's structure."""
        return self.model.tree(z[: self.size]), self.model.tree(z[self.size :])

    def vector(self, q: PyTree, v: PyTree):
        """The vector z of (q, v)."""
        return jnp.concatenate(self.model.vectors(q, v))

    def rate(self, t, z):
        """f(t, z): the velocities and accelerations."""
        x, u = jnp.split(z, 2)
        u = resolved(self.model, t, x, u)
        a, _ = equations_of(self.model).accelerations(t, self.model.tree(x), self.model.tree(u))
        return jnp.concatenate([u, self.model.vector(a)])

    def rates(self, times, nodes, passed: Passage, span) -> Float[Array, "2K 2n"]:
        """The rates at K nodes, and at the ends of the passages from there."""
        both = jnp.concatenate([times, times + span]), jnp.concatenate([nodes, passed.z])
        return jax.vmap(self.rate)(*both)

    def residual(self, t, z):
        """c(t, z): the independent constraint equations of positions and velocities, and those of determined ones."""
        off = (z - self._resolved(t, z))[np.flatnonzero(self.determined)]
        return jnp.concatenate([self._constrained(t, z), off])

    def _constrained(self, t, z):
        return _residual(self.model, t, z)[np.array(self.rows, int)]

    def _resolved(self, t, z):
        """z with the velocities that are determined."""
        x, u = jnp.split(z, 2)
        return jnp.concatenate([x, resolved(self.model, t, x, u)])

    def normals(self, t, z, scale):
        """C = ∂c/∂z, with z in units of `scale`."""
        return jax.jacfwd(lambda z: self.residual(t, z))(z) * scale[None]

    def onto_constraints(self, t, z, scale):
        """The state near z that satisfies the constraints, nearest in units of `scale`; differentiable.

        Velocities that are determined follow from the rest, whatever z says of them.
        """
        if not self.rows:
            return self._resolved(t, z)
        fixed, fixed_t, fixed_scale = stop_gradient((self, t, scale))

        def step(at, r):
            normals = jax.jacfwd(partial(fixed._constrained, fixed_t))(at) * fixed_scale[None]
            return fixed_scale * _shortest(normals, r)

        residual = partial(fixed._constrained, fixed_t)
        near = newton(residual, lambda z, r, i: step(z, r), lax.stop_gradient(z), ONTO_CONSTRAINTS)
        return self._resolved(t, last_step(near, z, lambda z: step(near, self._constrained(t, z))))

    def tangent_space(self, t, z, scale) -> Float[Array, "2n k"]:
        """An orthonormal basis of the tangent space, in units of `scale`."""
        if self.dimension == z.size:
            return jnp.eye(z.size, dtype=z.dtype)
        normals = self.normals(t, z, scale)
        basis = jnp.linalg.svd(lax.stop_gradient(normals))[2][z.size - self.dimension :].T
        # This gives the derivative of the basis that rotates as little as possible.
        return basis - _shortest(normals, normals @ basis)

    def passage(
        self, t0, z, span, frame, scale, volume=False, differentiable=False, changes: Changes | None = None
    ) -> Passage:
        """The state and the frame after a time; errors and the frame are in units of `scale`, (2n,).

        `volume`: whether to compute its growth. `differentiable`: whether to allow derivatives in both modes.
        `changes`: what else changes with each column of the frame.
        """
        arrays, static = eqx.partition((self, t0, z, span, frame, lax.stop_gradient(scale), changes), eqx.is_array)
        x, fixed = eqx.partition(arrays, eqx.is_inexact_array)

        def solve(x, fixed, adjoint, _):
            flow, *inputs = eqx.combine(x, fixed, static)
            forward = isinstance(adjoint, diffrax.ForwardMode)
            return _passage(flow, *inputs, volume, adjoint if forward else diffrax.RecursiveCheckpointAdjoint()), None

        if not differentiable:
            return solve(x, fixed, diffrax.ForwardMode(), False)[0]
        return solve_in_both_modes(solve, x, fixed, recorded=False)

    def path(self, t0, z, span, count, substeps=SUBSTEPS) -> Float[Array, "count+1 2n"]:
        """States at equal time intervals, by short Runge-Kutta steps: of low accuracy, but quick to compile."""
        h = span / (count * substeps)

        def step(z, t):
            def stage(rates, c_and_b):
                c, b = c_and_b
                rate, total = rates
                rate = self.rate(t + c * h, z + c * h * rate)
                return (rate, total + b * rate), None

            zero_rate = jnp.zeros_like(z)
            (_, total), _ = lax.scan(stage, (zero_rate, zero_rate), tuple(x.astype(z.dtype) for x in RUNGE_KUTTA))
            return z + h * total, z

        times = t0 + h * jnp.arange(count * substeps, dtype=z.dtype)
        last, path = lax.scan(step, z, times)
        return jnp.concatenate([path[::substeps], last[None]])


def flow_of(model: Model, rtol, rows, in_a_loop=True) -> Flow:
    """The flow of a system; `rows` come from `independent_rows_of`; None: all, of positions and of velocities."""
    rows = tuple(range(int(model.holonomic.sum()) + model.m)) if rows is None else rows
    return Flow(with_first_order(model), jnp.asarray(rtol, model.form.dtype), rows, in_a_loop)


def scale_of(z, period):
    """The size of each coordinate and velocity at z for a motion of this period; never zero.

    A coordinate that is zero with its velocity takes the largest size of the others; if all are zero, the user's unit.
    """
    rate = 2 * np.pi / period
    x, u = jnp.split(jnp.abs(lax.stop_gradient(z)), 2)
    sizes = jnp.maximum(x, u / rate)
    largest = jnp.max(sizes)
    sizes = jnp.where(sizes > 1e-6 * largest, sizes, jnp.where(largest > 0, largest, 1.0))
    return lax.stop_gradient(jnp.concatenate([sizes, sizes * rate]))


def independent_rows_of(model: Model, s: coordinates.State) -> tuple[int, ...] | None:
    """The indices of independent constraint equations near a state; None, for all, where JAX is tracing."""
    if not model.m:
        return ()
    if not is_eager() or is_traced(s):
        return None
    rows, chosen = np.asarray(_normals(model, s)), []
    for i, row in enumerate(rows):
        rest = row
        if chosen:
            rest = row - rows[chosen].T @ np.linalg.lstsq(rows[chosen].T, row, rcond=None)[0]
        if np.linalg.norm(rest) > DEPENDENT_BELOW * np.linalg.norm(row):
            chosen.append(i)
    return tuple(chosen)


@compiled
def _normals(model: Model, s):
    return jax.jacfwd(lambda z: _residual(model, s.t, z))(jnp.concatenate(model.vectors(s.q, s.v)))


def _residual(model: Model, t, z):
    x, u = jnp.split(z, 2)
    return jnp.concatenate([constraints.position_residual(model, t, x), constraints.velocity_residual(model, t, x, u)])


def _shortest(rows, residual):
    """The shortest δ with `rows @ δ = residual`."""
    return rows.T @ jnp.linalg.solve(rows @ rows.T, residual)


def _passage(flow, t0, z, span, frame, scale, changes, volume, adjoint) -> Passage:

    # Jitted so that it is traced only once, although diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def field(part, y, args):
        flow, t0, span, scale, changes = args
        t = t0 + span * part

        def rate(z: Array):
            return span * flow.rate(t, z * scale) / scale

        if changes is not None:
            motion, frame_motion = _with_changes(flow, part, y, t0, span, scale, changes)
            return {"z": motion, "frame": frame_motion, "growth": jnp.zeros_like(span)}
        if not frame.size:
            return {"z": rate(y["z"]), "frame": jnp.zeros_like(frame), "growth": jnp.zeros_like(span)}
        motion, push = jax.linearize(rate, y["z"])
        if not volume:
            return {"z": motion, "frame": jax.vmap(push, 1, 1)(y["frame"]), "growth": jnp.zeros_like(span)}
        jacobian = jax.vmap(push, 1, 1)(jnp.eye(z.size, dtype=z.dtype))
        growth = jnp.trace(jacobian)
        if flow.dimension < z.size:
            normal = jnp.linalg.qr(flow.normals(t, y["z"] * scale, scale).T)[0]
            growth = growth - jnp.sum(normal * (jacobian @ normal))
        return {"z": motion, "frame": jacobian @ y["frame"], "growth": growth}

    # The variable is the elapsed fraction of the span, so that the span is differentiated like a parameter.
    y0 = {"z": z / scale, "frame": frame, "growth": jnp.zeros_like(span)}
    zero, one, first = 0.0, 1.0, FIRST
    # Of Python's numbers diffrax sees at once that they are in order; its check of others calls Python in the program.
    if z.dtype != jnp.result_type(float):
        zero, one, first = (jnp.asarray(x, z.dtype) for x in (zero, one, first))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        Dopri8(in_a_loop=flow.in_a_loop),
        zero,
        one,
        first,
        y0,
        (flow, t0, span, scale, changes),
        stepsize_controller=diffrax.PIDController(rtol=flow.rtol, atol=flow.rtol, dtmin=SHORTEST, force_dtmin=False),
        adjoint=adjoint,
        max_steps=MAX_STEPS,
        throw=False,
    )
    y = jax.tree.map(lambda x: x[-1], solution.ys)
    ended = solution.result == diffrax.RESULTS.successful
    return Passage(y["z"] * scale, y["frame"], y["growth"], solution.stats["num_steps"], ended)


def _with_changes(flow, part, y, t0, span, scale, changes):
    """The rates of the state and its frame if parameters and times change with the columns."""
    floats, rest = eqx.partition(flow.model.params, eqx.is_inexact_array)

    def rate(z, floats, t0, span):
        now = flow.of(eqx.combine(floats, rest))
        return span * now.rate(t0 + span * part, z * scale) / scale

    motion, push = jax.linearize(rate, y["z"], floats, t0, span)
    return motion, jax.vmap(push, (1, 0, 0, 0), 1)(y["frame"], *changes)


class SwitchingFlow(eqx.Module):
    """A `Flow` for a hybrid or a system with elements, `system`; `start`: that of the phase in which motions start.

    Near the start it is a `Flow`: constraints, their tangent space, and the form of states are those of its phase.
    """

    system: Any
    start: Flow

    @property
    def model(self) -> Model:
        """The model of the phase in which motions start."""
        return self.start.model

    @property
    def rtol(self) -> Float[Array, ""]:
        """The tolerance of the steps."""
        return self.start.rtol

    @property
    def size(self) -> int:
        """The number of coordinates."""
        return self.start.size

    @property
    def determined(self) -> np.ndarray:
        """Which entries of z are velocities of coordinates of first order."""
        return self.start.determined

    @property
    def dimension(self) -> int:
        """The dimension of the space of states in the first phase."""
        return self.start.dimension

    def of(self, params: PyTree) -> "SwitchingFlow":
        """The same with other parameters."""
        return replace(self, start=self.start.of(params))

    def vector(self, q, v):
        """The vector z of (q, v)."""
        return self.start.vector(q, v)

    def onto_constraints(self, t, z, scale):
        """The state near z that satisfies the constraints of the first phase."""
        return self.start.onto_constraints(t, z, scale)

    def tangent_space(self, t, z, scale) -> Float[Array, "2n k"]:
        """An orthonormal basis of the tangent space of the first phase, in units of `scale`."""
        return self.start.tangent_space(t, z, scale)

    def rates(self, times, nodes, passed: Passage, span) -> Float[Array, "2K 2n"]:
        """The rates at the ends of passages, twice: those at the nodes where the motion is periodic."""
        return jnp.concatenate([passed.rate, passed.rate])

    def motion(self, ts, z, phase=None) -> HybridTrajectory:
        """The motion from z at these times; `phase`: of its start, by default that of the flow."""
        # A search follows motions that fail, of which a sweep must not hear.
        with WATCHED(False):
            motion = integrate(
                self.system.starting(phase), *self.start.state(z), self.model.params, ts=ts, rtol=self.rtol,
                throw=False, estimate_error=False,
            )  # fmt: skip
        assert isinstance(motion, HybridTrajectory)
        return motion

    def end(self, t0, z, span, phase=None) -> "tuple[Float[Array, ' 2n'], SwitchingCourse]":
        """The state after a time, and how the motion came there."""
        motion = self.motion(jnp.stack([t0, t0 + span]), z, phase)
        q, v = jax.tree.map(lambda x: x[-1], (motion.q, motion.v))
        ended = ended_well(motion.result)
        return self.vector(q, v), SwitchingCourse(motion.stats["num_steps"], ended, motion.switches, motion.phase[-1])

    def passage(
        self, t0, z, span, frame, scale, volume=False, differentiable=False, changes: Changes | None = None, phase=None
    ) -> Passage:
        """The state and the frame after a time, as `Flow.passage`; with the rate at the end, and the switches.

        `phase`: in which it starts, by default that of the flow.
        """
        scale = lax.stop_gradient(scale)
        if not frame.shape[1]:
            (last, course), pushed = self.end(t0, z, span, phase), jnp.zeros_like(z)[:, None]
        else:
            last, pushed, course = _pushed(self, t0, z, span, frame, scale, changes, phase)
        unknown = jnp.full_like(span, jnp.nan)
        returns = course.phase == jnp.asarray(self.system.first, course.phase.dtype)
        return Passage(
            last, pushed[:, :-1] / scale[:, None], unknown, course.steps, course.ended,
            pushed[:, -1], course.switches, returns, course.phase,
        )  # fmt: skip

    def path(self, t0, z, span, count) -> "tuple[Float[Array, ' P'], Float[Array, 'P 2n']]":
        """Times from the start and states, at equal intervals and on both sides of each switch; NaN in spare rows."""
        motion = self.motion(t0 + span * jnp.linspace(0.0, 1.0, count + 1, dtype=z.dtype), z)
        found = motion.switches
        vectors = jax.vmap(self.vector)
        states = [vectors(motion.q, motion.v), vectors(found.q, found.v), vectors(found.q_after, found.v_after)]
        times = jnp.concatenate([motion.t, found.t, found.t]) - t0
        order = jnp.argsort(times, stable=True)
        return times[order], jnp.concatenate(states)[order]


class SwitchingCourse(NamedTuple):
    """How a motion went: its steps, whether it came to its end, its switches, and the phase in which it ends."""

    steps: Int[Array, ""]
    ended: Bool[Array, ""]
    switches: Switches
    phase: Int[Array, ""]


@compiled
def _pushed(
    flow: SwitchingFlow, t0, z, span, frame, scale, changes: Changes | None, phase
) -> "tuple[Array, Float[Array, '2n k+1'], SwitchingCourse]":
    """The state after a time, the changes with each column of a frame and with the time, and how the motion went."""
    floats, rest = eqx.partition(flow.model.params, eqx.is_inexact_array)

    def end(moved: Array, later: Array, t0: Array, floats: PyTree):
        now = flow if changes is None else flow.of(eqx.combine(floats, rest))
        return now.end(t0, z + scale * moved, span + later, phase)

    def along(moved: Array, later: Array, also: Changes | None):
        known = jnp.zeros_like(z), jnp.zeros_like(span)
        if also is None:
            return jax.jvp(lambda *x: end(*x, t0, None), known, (moved, later), has_aux=True)
        return jax.jvp(end, (*known, t0, floats), (moved, later + also.span, also.t0, also.params), has_aux=True)

    moved = jnp.concatenate([frame, jnp.zeros_like(z)[:, None]], axis=1)
    later = jnp.zeros(moved.shape[1], z.dtype).at[-1].set(1.0)
    if changes is not None:
        # Nothing else changes with the time.
        changes = jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])]), changes)
    return jax.vmap(along, (1, 0, 0), (None, 1, None))(moved, later, changes)


def any_flow(system: System | Hybrid, s: State, rtol, rows, in_a_loop=True) -> Flow | SwitchingFlow:
    """The flow of a prepared system for states like s; `rows` as for `flow_of`."""
    flow = flow_of(model_of(system.first_phase, *s), rtol, rows, in_a_loop)
    return SwitchingFlow(system, flow) if system.in_phases else flow


def no_switches(system: System | Hybrid, s: State) -> Switches | None:
    """The switches of a motion before any; None for a system without phases."""
    if not system.in_phases:
        return None
    return switches_before_any(system, s.q, s.v)
