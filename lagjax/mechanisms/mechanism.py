"""What a test problem consists of."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lagjax.mechanics.system import System


@dataclass(frozen=True)
class Mechanism:
    """A mechanism with a known motion: what to integrate, and where it must end.

    - `name`, `title`, `source`: what it is called and where it is from.
    - `system`, `params`, `q0`, `v0`, `end`: the motion from (q0, v0) at t = 0 to t = `end`.
    - `reference`: (q, v) at `end`, like (q0, v0), or None; `origin`: who computed it, and how; `digits`: how many
      of its digits, relative to the largest coordinate and the largest velocity, are trusted.
    - `freedom`: degrees of freedom, away from singular positions. Where more constraints are given than
      coordinates minus this, they are redundant.
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
