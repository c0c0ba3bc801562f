"""What is drawn, described: solids and lines that are fixed in bodies, and where bodies are."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import PyTree

from lagjax.display.in_space.surfaces import Faces

COLOUR = re.compile(r"#[0-9a-fA-F]{6}")


class Anchor(NamedTuple):
    """A place fixed in a body: its name, None for space itself; a point (3,), or a function of params; and three unit
    vectors of the body as rows, of which the last is the axis.
    """

    body: str | None
    point: Any
    axes: tuple = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Shape:
    """Something to draw that moves with bodies: `lj.shapes.box` and its like make them.

    - `kind`: "solid" at one anchor; "rod", a solid from one to another; "line" through two or more; "dot" or "trail" at
      one; "level", the surface on which `level` vanishes, in one's frame. "mark", a line in front of everything. Of
      joints: "gap", a mark between two places that should be one, and "axis", drawn where frames are.
    - `surface`: that of a solid or rod, of unit size; `size` (3,), or a function of params: its scale along the
      anchor's axes. `color`: "#rrggbb", or None for the colour of its body.
    - `level`: `level(points, params)`, (n, 3) -> (n,).

    >>> import lagjax as lj
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> print(lj.shapes.sphere(ball, radius=0.5))
    Shape(a solid on 'ball')
    """

    kind: str
    anchors: tuple[Anchor, ...]
    surface: Faces | None = None
    size: Any = (1.0, 1.0, 1.0)
    color: str | None = None
    level: Callable | None = None

    def __post_init__(self):
        if self.color is not None and not (isinstance(self.color, str) and COLOUR.fullmatch(self.color)):
            raise ValueError(
                f"a color must be six hexadecimal digits, and is {self.color!r}.\n"
                'Fix: color="#D55E00", or leave it out.'
            )

    def __repr__(self):
        names = dict.fromkeys("the ground" if anchor.body is None else f"'{anchor.body}'" for anchor in self.anchors)
        return f"Shape(a {self.kind} on {', '.join(names)})"

    def with_params(self, params: PyTree) -> "Shape":
        """The same with numbers in the place of functions of params."""
        anchors = tuple(Anchor(a.body, _three(a.point, params, "a point"), a.axes) for a in self.anchors)
        size = _three(self.size, params, "the size")
        if not np.all(size >= 0):
            raise ValueError(f"the size of a shape is negative: {size.tolist()}.\nFix: lengths from zero on.")
        level = None if self.level is None else partial(self.level, params=params)
        return Shape(self.kind, anchors, self.surface, size, self.color, level)

    @property
    def owner(self) -> str | None:
        """The body whose colour it has."""
        return next((anchor.body for anchor in self.anchors if anchor.body is not None), None)


def poses_in_q(t: Any, q: PyTree, params: PyTree) -> Any:
    """Where bodies are whose entries in q are their poses."""
    return q


class Drawing(NamedTuple):
    """What is drawn of a motion: shapes, and where the bodies are that carry them.

    - `shapes`: `lj.shapes.box(...)` and the like, or a function of params that gives them. Functions
      `positions(t, q, params)` may be among them.
    - `poses`: `poses(t, q, params)` -> by the names of bodies, the centre of mass (3,) and the unit quaternion
      (w, x, y, z); by default they are the entries of q.

    A system is drawn by itself if its Lagrangian has one as the attribute `drawing`.

    >>> import lagjax as lj
    >>> import jax.numpy as jnp
    >>> arm = lj.bodies.Body("arm", 1.0, (0.1, 0.1, 0.01))
    >>> def poses(t, q, params):
    ...     return {"arm": lj.bodies.Pose.at((0.0, 0.0, -0.5)).turned((1.0, 0.0, 0.0), q)}
    >>> Drawing([lj.shapes.box(arm, (0.1, 0.1, 1.0))], poses).shapes
    [Shape(a solid on 'arm')]
    """

    shapes: Sequence[Shape | Callable] | Callable[[PyTree], Sequence[Shape | Callable]]
    poses: Callable[[Any, PyTree, PyTree], Any] = poses_in_q


def _three(x: Any, params: PyTree, what: str) -> np.ndarray:
    found = np.asarray(x(params) if callable(x) else x, float)
    if found.shape != (3,) or not np.all(np.isfinite(found)):
        raise ValueError(f"{what} of a shape must be three finite numbers, and is {found.tolist()}.")
    return found
