"""The parts of a test problem."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lagjax.system.system import System


@dataclass(frozen=True)
class Mechanism:
    """A mechanism with a known motion: what to integrate, and where it must end.

    - `name`, `title`, `source`: its names and its origin.
    - `system`, `params`, `q0`, `v0`, `end`: the motion from (q0, v0) at t = 0 to t = `end`.
    - `reference`: (q, v) at `end`, with the structure of (q0, v0), or None; `origin`: who computed it, and how;
      `digits`: how many of its digits are reliable, relative to the largest coordinate and the largest velocity.
    - `freedom`: degrees of freedom away from singular positions. Constraints beyond the number of coordinates minus
      this are redundant.
    """

    name: str
    title: str
    source: str
    system: System
    params: Mapping[str, Any]
    q0: Any
    v0: Any
    end: float
    freedom: int
    reference: tuple[Any, Any] | None = None
    origin: str = ""
    digits: int = 0
