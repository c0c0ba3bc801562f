"""How a motion is integrated: all that is asked for but the system, the state and the times."""

from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from lagjax.contexts import PATIENCE
from lagjax.numerics import EqualSteps

# A right-hand side of up to this many operations is copied to each of a method's stages; a longer one is compiled once,
# in a loop. In batches of a rod or a double pendulum copies are twice as fast. A single motion's step is a fifth slower
# in a loop, but a rod's first answer comes an eighth sooner, that of eight coupled masses in half the time. Derivatives
# are taken without copies: the first takes two thirds of the time, each of the next ones a fifth more.
UNROLL_UP_TO, UNROLL_AT_ONCE_UP_TO = 250, 30


# Making an equinox module takes longer than computing a short motion.
@jtu.register_dataclass
@dataclass(frozen=True)
class Settings:
    """How to integrate: everything but the system, the state and the times."""

    method: diffrax.AbstractSolver | EqualSteps | None
    controller: diffrax.AbstractStepSizeController | None
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint | None
    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]
    dt0: Float[Array, ""] | None
    # Infinite if the length of steps is not limited.
    max_step: Float[Array, ""]
    jump_ts: Float[Array, " J"] | None
    # Shares of the proposed first step, and of the time between outputs for the longest step: see `StepToOutputs`.
    shares: Float[Array, " 2"]
    # Motions of up to this many steps are integrated again for an error estimate.
    repeated_up_to: Int[Array, ""]
    # Whether `atol` was not given and follows the motion's own size; the value above is then a placeholder.
    by_size: bool = eqx.field(static=True)
    apart: bool = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True)
    drift: str = eqx.field(static=True)
    progress: bool | None = eqx.field(static=True)
    # The accelerations of forces that may cancel, where they are known: `Forced` of `stepping.py`.
    forced: Any = None
    # The size of the record for reverse mode, in bytes; None for the usual one.
    memory: float | None = eqx.field(static=True, default=None)
    # False if the equations are assumed regular, until that turns out to be wrong.
    robust: bool = eqx.field(static=True, default=True)
    # Whether jumps of forces are found and followed.
    jumps: str = eqx.field(static=True, default="found")
    # Whether outputs are ends of steps or lie inside them, on a polynomial; None if it follows from the method.
    outputs: str | None = eqx.field(static=True, default="exact")
    # Whether the tolerance is loose, as far as it is known while JAX traces.
    loose: bool = eqx.field(static=True, default=False)
    # Whether this solve is for a derivative.
    differentiated: bool = eqx.field(static=True, default=False)
    # A right-hand side of up to this many operations is copied to each of a method's stages.
    unroll_up_to: int = eqx.field(static=True, default=UNROLL_UP_TO)


def is_recorded(controller: Any, event: Any, progress: Any) -> bool:
    """Whether reverse mode may use a record of the steps; other controllers may depend on more than is recorded."""
    fixed = isinstance(controller, diffrax.ConstantStepSize)
    return not progress and event is None and (controller is None or fixed)


def patient(max_steps: int | None) -> int | None:
    """The number of steps that a motion may take, within `PATIENCE`."""
    limits = [limit for limit in (max_steps, PATIENCE.value) if limit is not None]
    return min(limits, default=None)
