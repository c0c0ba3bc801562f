"""The parts of a trajectory: one instant, how it was stepped through, what was asked for."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import HashablePart, hashable_partition
from lagjax.numerics import EqualSteps

# The phase of an output that was not reached, and the number in unused places for switches.
NO_PHASE = -1
# The mode of a sliding velocity that rests since others hold it (`complementarity.py`).
HELD_BY_OTHERS = 3


# Those of sliding velocities along a line, and in a plane, in words.
SLIDING = {-1: "slides", 0: "free", 1: "slides", 2: "sticks", HELD_BY_OTHERS: "is held by others"}
# What modes are called, by the kind of what they are modes of.
MODES = {
    "gap": {0: "open", 1: "closed"},
    "sliding velocity": SLIDING,
    "sliding velocity in a plane": SLIDING,
    "side": {1: "presses", -1: "presses from the other side"},
    "spring": {0: "apart", 1: "pressed"},
}


def mode_in_words(kind: str, mode: int) -> str:
    """A mode in a word; nothing of a mode that its phase does not have."""
    if mode == NO_PHASE and kind not in ("sliding velocity", "side"):
        return ""
    return "holds its output" if kind == "control" else MODES[kind][mode]


class Snapshot(NamedTuple):
    """One instant of a motion."""

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    multipliers: dict[str, Array]


class SolveInfo(NamedTuple):
    """How a motion was stepped through.

    `order`: of the error that chooses steps; `evaluations`: of the equations per step, None for an implicit method;
    `steps`: chosen by the "tolerance", by it over several "legs", "fixed", or by the user's "controller"; `backward`:
    whether time decreases; `interpolated`: whether outputs lie inside steps.
    """

    method: str
    order: int
    evaluations: int | None
    steps: str
    backward: bool = False
    interpolated: bool = False


class SolveOptions(NamedTuple):
    """The other arguments of `integrate`, apart from the motion and its tolerances, as it takes them."""

    method: diffrax.AbstractSolver | EqualSteps | None
    stepsize_controller: diffrax.AbstractStepSizeController | None
    dt0: Array | None
    max_step: Array | None
    jump_ts: Array | None
    drift: str
    jumps: str = "found"


class StaticPart(NamedTuple):
    """The parts of a trajectory that are not arrays; they must be hashable, so that JAX can carry them along.

    `integrate`: what continues the motion, `Problem` -> trajectory.
    """

    rest: HashablePart
    how: SolveInfo
    integrate: Callable

    @property
    def method(self) -> str:
        return self.how.method + (", outputs interpolated" if self.how.interpolated else "")


def pack(problem: tuple, how: SolveInfo, integrate: Callable) -> tuple[PyTree, StaticPart]:
    """Split `problem` = (system, params, what was asked for) into arrays and a hashable rest."""
    arrays, rest = hashable_partition(problem)
    return rest.in_place(arrays), StaticPart(rest, how, integrate)
