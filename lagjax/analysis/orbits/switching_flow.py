"""The flow of a motion in phases, or with elements: `lj.integrate` over a period, with its derivatives.

A tangent that passes a switch jumps with the state and with the time of the switch (the saltation matrix), which the
forward derivatives of `integrate` contain. So the end Φ of a period T from a state z gives, by one `jvp` for each
column, what a smooth flow gets from its variational equation:

    a frame B becomes (∂Φ/∂z) B,        the rate at the end is ∂Φ/∂T.

Where a motion sticks, or is struck without restitution, neighbouring states meet: ∂Φ/∂z is singular, with a multiplier
0 for each direction that is lost. The volume of a frame is not known independently.

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204; di Bernardo et al., *Piecewise-smooth Dynamical
Systems*, §2.5.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.analysis.orbits.flow import Changes, Flow, Passage, flow_of
from lagjax.integrate import HybridTrajectory, Switches, ended_well, integrate, switches_before_any
from lagjax.jaxtools import WATCHED, compiled
from lagjax.system import Hybrid, Model, State, System, model_of


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
