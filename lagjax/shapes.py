"""What bodies look like in pictures, `traj.animate`, `traj.draw` and `lj.draw`; what has mass is in `lj.bodies`.

>>> import lagjax as lj
>>> bob = lj.bodies.Body("bob", 1.0, (0.1, 0.1, 0.1))
>>> [lj.shapes.sphere(bob, radius=0.2), lj.shapes.rod(lj.bodies.ground, bob, radius=0.02)]
[Shape(a solid on 'bob'), Shape(a rod on the ground, 'bob')]

A place is a body, a marker `body.at(point, axis)`, whose axis is the z axis of what sits there, `lj.bodies.ground`, or
a point of space. Lengths, sizes and points may be functions of params.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from lagjax.display import CUBE, CYLINDER, DISK, SPHERE, TUBE, Anchor, Drawing, Shape, surface
from lagjax.jaxtools import compiled
from lagjax.refusals import must

__all__ = ["Drawing", "Shape", "box", "cylinder", "disk", "ellipsoid", "line", "mesh", "rod", "sphere", "trail"]

# The colours of what a joint leaves open, and of surfaces to roll on.
OPEN, GROUND = "#E6007E", "#B8B8B8"


class Anchored(Protocol):
    """What shapes hold on to: a body, a marker on one, the ground."""

    @property
    def anchor(self) -> Anchor:
        """The place, in the words of pictures."""
        ...


Place = Anchored | ArrayLike


def box(place: Place, size: Any, color: str | None = None) -> Shape:
    """A box about a place, with its edges `size` (3,) along the body's axes (for a marker, along its own).

    >>> import lagjax as lj
    >>> door = lj.bodies.Body("door", 20.0, (1.0, 2.0, 1.0))
    >>> lj.shapes.box(door, (1.0, 0.05, 2.0))
    Shape(a solid on 'door')

    **Raises:** `TypeError` for a place that is none; `ValueError` for a color that is not "#rrggbb", for lengths that
    are negative or not finite, and, when it is drawn, for a size that is not three numbers, or negative.
    """
    return Shape("solid", (_anchor(place),), CUBE, size, color)


def cylinder(place: Place, radius: Any, length: Any, color: str | None = None) -> Shape:
    """A cylinder about the z axis of a place, half of it on either side. Its sectors show its turning.

    >>> import lagjax as lj
    >>> wheel = lj.bodies.Body("wheel", 1.0, (0.3, 0.5, 0.3))
    >>> lj.shapes.cylinder(wheel.at(axis=(0.0, 1.0, 0.0)), radius=1.0, length=0.1)
    Shape(a solid on 'wheel')

    **Raises:** as `lj.shapes.box` does.
    """
    return Shape("solid", (_anchor(place),), CYLINDER, _sizes(radius, radius, length), color)


def sphere(place: Place, radius: Any, color: str | None = None) -> Shape:
    """A sphere about a place, in eight light and dark parts that show its turning.

    >>> import lagjax as lj
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> lj.shapes.sphere(ball, radius=1.0)
    Shape(a solid on 'ball')

    **Raises:** as `lj.shapes.box` does.
    """
    return ellipsoid(place, (radius, radius, radius), color)


def ellipsoid(place: Place, half_axes: Sequence, color: str | None = None) -> Shape:
    """An ellipsoid about a place, its axes along those of the place.

    >>> import lagjax as lj
    >>> egg = lj.bodies.Body("egg", 1.0, (0.3, 0.4, 0.4))
    >>> lj.shapes.ellipsoid(egg, half_axes=(1.0, 0.7, 0.7))
    Shape(a solid on 'egg')

    **Raises:** as `lj.shapes.box` does.
    """
    return Shape("solid", (_anchor(place),), SPHERE, _sizes(*half_axes), color)


def disk(place: Place, radius: Any, color: str | None = None) -> Shape:
    """A thin disk at a place, at right angles to its z axis.

    >>> import lagjax as lj
    >>> coin = lj.bodies.Body("coin", 1.0, (1.0, 1.0, 2.0))
    >>> lj.shapes.disk(coin, radius=2.0)
    Shape(a solid on 'coin')

    **Raises:** as `lj.shapes.box` does.
    """
    return Shape("solid", (_anchor(place),), DISK, _sizes(radius, radius, radius), color)


def mesh(place: Place, vertices: ArrayLike, faces: Sequence[Sequence[int]], color: str | None = None) -> Shape:
    """Faces fixed in a body: `vertices` (n, 3) from the place, and for each face the indices of its corners in order.

    >>> import lagjax as lj
    >>> fin = lj.bodies.Body("fin", 1.0, (1.0, 1.0, 1.0))
    >>> lj.shapes.mesh(fin, [(0, 0, 0), (1, 0, 0), (0, 0, 1)], [(0, 1, 2)])
    Shape(a solid on 'fin')

    **Raises:** `ValueError` for indices that `vertices` lacks, vertices that are not points of space, and a color that
    is not "#rrggbb".
    """
    return Shape("solid", (_anchor(place),), surface(vertices, faces), (1.0, 1.0, 1.0), color)


def rod(a: Place, b: Place, radius: Any, color: str | None = None) -> Shape:
    """A round rod from one place to another, of the same body or of two.

    >>> import lagjax as lj
    >>> bob = lj.bodies.Body("bob", 1.0, (0.1, 0.1, 0.1))
    >>> lj.shapes.rod(lj.bodies.ground, bob, radius=0.02)
    Shape(a rod on the ground, 'bob')

    **Raises:** as `lj.shapes.box` does.
    """
    return Shape("rod", (_anchor(a), _anchor(b)), TUBE, _sizes(radius, radius, 1.0), color)


def line(*places: Place, color: str | None = None) -> Shape:
    """A line through places; with a single one, a dot.

    >>> import lagjax as lj
    >>> kite = lj.bodies.Body("kite", 1.0, (0.1, 0.1, 0.1))
    >>> lj.shapes.line((0.0, 0.0, 0.0), kite.at((0.0, 0.0, -0.5)))
    Shape(a line on the ground, 'kite')

    **Raises:** `ValueError` for no places and for a color that is not "#rrggbb".
    """
    if not places:
        raise ValueError("a line needs places.\nFix: lj.shapes.line(lj.bodies.ground, body).")
    return Shape("line" if len(places) > 1 else "dot", tuple(map(_anchor, places)), color=color)


def trail(place: Place, color: str | None = None) -> Shape:
    """The path that a place leaves behind; in a film, its last part.

    >>> import lagjax as lj
    >>> pen = lj.bodies.Body("pen", 1.0, (0.1, 0.1, 0.1))
    >>> lj.shapes.trail(pen.at((0.0, 0.0, -0.1)))
    Shape(a trail on 'pen')

    **Raises:** as `lj.shapes.box` does.
    """
    return Shape("trail", (_anchor(place),), color=color)


def gap(a: Place, b: Place) -> Shape:
    """A magenta line between two places that a joint holds together; where it does, nothing is seen of it."""
    return Shape("gap", (_anchor(a), _anchor(b)), color=OPEN)


def axis(place: Anchored) -> Shape:
    """The axis of a joint, which pictures show where they are asked for frames."""
    return Shape("axis", (_anchor(place),))


def level(place: Anchored, f: Callable) -> Shape:
    """The surface f = 0 about all else that is drawn, seen from where f > 0; `f(r, params)` in a marker's frame."""
    return Shape("level", (_anchor(place),), color=GROUND, level=partial(_values, f))


def _values(f: Callable, points: np.ndarray, params: PyTree) -> np.ndarray:
    return _at_points(f, points, params)


@partial(compiled, in_numpy=True)
def _at_points(f: Callable, points: np.ndarray, params: PyTree):
    return jax.vmap(lambda r: jnp.asarray(f(r, params), float))(points)


def _anchor(place: Any) -> Anchor:
    if isinstance(anchor := getattr(place, "anchor", None), Anchor):
        return anchor
    claim = "a place must be a body, body.at(point), lj.bodies.ground or a point (x, y, z)"
    fix, cause = 'lj.shapes.sphere(lj.bodies.Body("ball", ...), 0.5)', "the name of a body in place of the body"
    must(np.shape(place) == (3,), claim, place, fix, cause, TypeError)
    return Anchor(None, tuple(np.asarray(place, float).tolist()))


def _sizes(*lengths: Any) -> Any:
    """Three lengths; a function of params if one of them is."""
    if not any(map(callable, lengths)):
        found = tuple(map(float, lengths))
        claim = "a radius, length or half axis of a shape must be a finite number from zero on"
        fix = "lj.shapes.sphere(ball, 0.5), or a function of params"
        cause = "a division by zero where it was computed, or a difference the wrong way round"
        for x in found:
            must(0 <= x < math.inf, claim, x, fix, cause)
        return found
    return _of_params(lengths)


def _of_params(lengths: tuple) -> Callable:
    def size(params):
        return jnp.stack([jnp.asarray(length(params) if callable(length) else length, float) for length in lengths])

    return size
