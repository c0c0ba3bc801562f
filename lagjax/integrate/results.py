"""The results of a motion or a fit, with their messages."""

from typing import Any

import diffrax
import equinox as eqx
from jaxtyping import Array, Bool

from lagjax.jaxtools import to_jax


# Type checkers take equinox's enumerations for Python's, which cannot have more items than their parent.
class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How an integration or a fit ended: diffrax's results, and those that diffrax does not have.

    >>> import lagjax as lj
    >>> print(lj.RESULTS[lj.RESULTS.event_occurred])
    Terminating differential equation solve because an event occurred.
    """

    start_off_constraints = "The initial state does not satisfy the constraints."
    contradictory = "Constraints that depend on each other ask for different accelerations at the initial state."
    start_not_finite = "L, the accelerations or the multipliers are not finite at the initial state."
    start_singular = "The accelerations are not determined at the initial state: the equations are singular there."
    not_finite = "The state became NaN or infinite."
    unsolved_step = (
        "A step could not be solved, could not be returned to the constraints, or has an error comparable to the state."
    )
    tolerance_too_small = "The tolerance is below the round-off of the state's dtype."
    unordered = (
        "The times do not increase throughout, or dt0 or max_step is not positive. (Decreasing times are "
        "accepted if they are known while JAX is tracing: a NumPy array.)"
    )
    drifted = (
        "The motion was computed, but its error, or the change of what must stay constant, is above what is allowed."
    )
    not_converged = "The search of a fit, or of a periodic orbit, did not converge."
    not_estimated = (
        "The error was not estimated: it was not asked for, and the motion takes more than 20,000 steps; or "
        "lagjax does not know how to shorten the steps of its controller."
    )
    misfit = "The residuals of a fit are not measurement errors: they contradict sigma, or follow a curve."
    too_many_switches = "There were more switches than most_switches."
    guard_not_seen = "A guard is below zero, and was not seen to cross it: the phase began on it, and hardly left it."
    guard_below_zero = "A guard of the first phase is below zero at the start."
    reset_not_finite = "The state after a switch is NaN or infinite."
    no_contact_forces = "No forces, or impulses, obey the laws of contact and friction together (Painlevé's paradox)."
    element_refused = (
        "A number of an element is NaN, or not what its law allows: friction, stiffness and damping below zero, a "
        "restitution that is not 0 to 1, a time between instants that is not above zero."
    )
    normal_below_zero = (
        "A normal force of friction, which presses from one side, fell below zero: nothing says what friction is then."
    )
    no_such_phase = "start= is not the number of a phase."
    raised = "A function that is called in Python, by a callback, raised an exception."
    no_progress = (
        "The steps became so short, for thousands of them in a row, that a hundred times max_steps would not be enough."
    )


# diffrax has no message for a success, and equinox has no public way to set one.
RESULTS._index_to_message[int(RESULTS.successful._value)] = "successful"
# Its own advice, a larger max_steps, helps only if the motion is long; from inside a program nothing else can be said.
RESULTS._index_to_message[int(RESULTS.max_steps_reached._value)] = (
    "The maximum number of solver steps was reached: a long motion, a stiff one, or one that cannot go on. "
    "lj.integrate outside of jit, vmap and grad tells which."
)
ENDED_WELL = RESULTS.successful, RESULTS.event_occurred


def ended_well(result: Any) -> Bool[Array, "..."]:
    """Whether a motion was computed to its end or its event."""
    return (result == RESULTS.successful) | (result == RESULTS.event_occurred)


def is_among(result: Any, others: Any) -> bool:
    """Whether a result with a known value is one of `others`; without JAX, which takes ten times as long."""
    return int(result._value) in [int(other._value) for other in others]


def message(result: Any) -> str:
    """The message of a result."""
    if is_among(result, [RESULTS.event_occurred]):
        return "ended by its event"
    # `RESULTS[result]` cannot look up a NumPy number, which a lane of a sweep has.
    return RESULTS._index_to_message[int(result._value)]


def in_words(code: Any) -> str:
    """The message of a result, from its number."""
    return message(item(RESULTS.successful, code))


def item(result: Any, value: Any):
    """The result with the number `value`; `result`: any known one."""
    return eqx.tree_at(lambda r: r._value, result, to_jax(value))
