"""A motion to be computed: what `prepare` has checked and traced, and what `run` takes."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, PyTree

from lagjax.integrate.settings import Settings
from lagjax.system import State


class Problem(NamedTuple):
    """The system with its functions as programs, the start, the outputs, what is watched, and how to integrate.

    `guards`: those of the user's events; of a motion in phases its `Phase`s, with these in them; None without any.
    """

    system: Any
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    params: PyTree
    ts: Float[Array, " T"]
    guards: Any
    settings: Settings

    @property
    def start(self) -> State:
        """The first state, with the parameters."""
        return State(self.ts[0], self.q, self.v, self.params)
