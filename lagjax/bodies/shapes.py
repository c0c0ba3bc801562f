"""What bodies look like, for `traj.animate` and `traj.draw`, and how a system of bodies is drawn by itself.

A place is a body, a marker `body.at(point, axis)`, whose axis is the z axis of what sits there, `lj.ground`, or a point
of space. Lengths, sizes and points may be functions of params.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from lagjax.bodies.body import Body, Ground, Marker, valued
from lagjax.display import CUBE, CYLINDER, DISK, SPHERE, TUBE, Anchor, Shape, surface
from lagjax.jaxtools import compiled

Place = Body | Ground | Marker | ArrayLike
# The least thickness of a body's box beside its length.
THIN = 0.04
# The colours of what a joint leaves open, and of surfaces to roll on.
OPEN, GROUND = "#E6007E", "#B8B8B8"


def box(place: Place, size: Any, color: str | None = None) -> Shape:
    """A box about a place, with its edges `size` (3,) along the body's axes (for a marker, along its own).

    >>> import lagjax as lj
    >>> door = lj.Body("door", 20.0, (1.0, 2.0, 1.0))
    >>> lj.box(door, (1.0, 0.05, 2.0))
    Shape(a solid on 'door')

    **Raises:** `TypeError` for a place that is none; `ValueError` for a color that is not "#rrggbb", and, when it is
    drawn, for a size that is not three numbers, or negative.
    """
    return Shape("solid", (_anchor(place),), CUBE, size, color)


def cylinder(place: Place, radius: Any, length: Any, color: str | None = None) -> Shape:
    """A cylinder about the z axis of a place, half of it on either side. Its sectors show its turning.

    >>> import lagjax as lj
    >>> wheel = lj.Body("wheel", 1.0, (0.3, 0.5, 0.3))
    >>> lj.cylinder(wheel.at(axis=(0.0, 1.0, 0.0)), radius=1.0, length=0.1)
    Shape(a solid on 'wheel')

    **Raises:** as `lj.box` does.
    """
    return Shape("solid", (_anchor(place),), CYLINDER, _sizes(radius, radius, length), color)


def sphere(place: Place, radius: Any, color: str | None = None) -> Shape:
    """A sphere about a place, in eight light and dark parts that show its turning.

    >>> import lagjax as lj
    >>> ball = lj.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> lj.sphere(ball, radius=1.0)
    Shape(a solid on 'ball')

    **Raises:** as `lj.box` does.
    """
    return ellipsoid(place, (radius, radius, radius), color)


def ellipsoid(place: Place, half_axes: Sequence, color: str | None = None) -> Shape:
    """An ellipsoid about a place, its axes along those of the place."""
    return Shape("solid", (_anchor(place),), SPHERE, _sizes(*half_axes), color)


def disk(place: Place, radius: Any, color: str | None = None) -> Shape:
    """A thin disk at a place, at right angles to its z axis.

    >>> import lagjax as lj
    >>> coin = lj.Body("coin", 1.0, (1.0, 1.0, 2.0))
    >>> lj.disk(coin, radius=2.0)
    Shape(a solid on 'coin')

    **Raises:** as `lj.box` does.
    """
    return Shape("solid", (_anchor(place),), DISK, _sizes(radius, radius, radius), color)


def mesh(place: Place, vertices: ArrayLike, faces: Sequence[Sequence[int]], color: str | None = None) -> Shape:
    """Faces fixed in a body: `vertices` (n, 3) from the place, and for each face the indices of its corners in order.

    >>> import lagjax as lj
    >>> fin = lj.Body("fin", 1.0, (1.0, 1.0, 1.0))
    >>> lj.mesh(fin, [(0, 0, 0), (1, 0, 0), (0, 0, 1)], [(0, 1, 2)])
    Shape(a solid on 'fin')

    **Raises:** `ValueError` for indices that `vertices` lacks, vertices that are not points of space, and a color that
    is not "#rrggbb".
    """
    return Shape("solid", (_anchor(place),), surface(vertices, faces), (1.0, 1.0, 1.0), color)


def rod(a: Place, b: Place, radius: Any, color: str | None = None) -> Shape:
    """A round rod from one place to another, of the same body or of two.

    >>> import lagjax as lj
    >>> bob = lj.Body("bob", 1.0, (0.1, 0.1, 0.1))
    >>> lj.rod(lj.ground, bob, radius=0.02)
    Shape(a rod on the ground, 'bob')

    **Raises:** as `lj.box` does.
    """
    return Shape("rod", (_anchor(a), _anchor(b)), TUBE, _sizes(radius, radius, 1.0), color)


def line(*places: Place, color: str | None = None) -> Shape:
    """A line through places; with a single one, a dot.

    >>> import lagjax as lj
    >>> kite = lj.Body("kite", 1.0, (0.1, 0.1, 0.1))
    >>> lj.line((0.0, 0.0, 0.0), kite.at((0.0, 0.0, -0.5)))
    Shape(a line on the ground, 'kite')

    **Raises:** `ValueError` for no places and for a color that is not "#rrggbb".
    """
    if not places:
        raise ValueError("a line needs places.\nFix: lj.line(lj.ground, body).")
    return Shape("line" if len(places) > 1 else "dot", tuple(map(_anchor, places)), color=color)


def trail(place: Place, color: str | None = None) -> Shape:
    """The path that a place leaves behind; in a film, its last part.

    >>> import lagjax as lj
    >>> pen = lj.Body("pen", 1.0, (0.1, 0.1, 0.1))
    >>> lj.trail(pen.at((0.0, 0.0, -0.1)))
    Shape(a trail on 'pen')

    **Raises:** as `lj.box` does.
    """
    return Shape("trail", (_anchor(place),), color=color)


def gap(a: Place, b: Place) -> Shape:
    """A magenta line between two places that a joint holds together; where it does, nothing is seen of it."""
    return Shape("gap", (_anchor(a), _anchor(b)), color=OPEN)


def axis(place: Marker) -> Shape:
    """The axis of a joint, which pictures show where they are asked for frames."""
    return Shape("axis", (_anchor(place),))


def level(place: Marker, f: Callable) -> Shape:
    """The surface f = 0 about all else that is drawn, seen from where f > 0; `f(r, params)` in a marker's frame."""
    return Shape("level", (_anchor(place),), color=GROUND, level=partial(_values, f))


def _values(f: Callable, points: np.ndarray, params: PyTree) -> np.ndarray:
    return _at_points(f, points, params)


@partial(compiled, in_numpy=True)
def _at_points(f: Callable, points: np.ndarray, params: PyTree):
    return jax.vmap(lambda r: jnp.asarray(f(r, params), float))(points)


def usual_shapes(bodies: Iterable[Body], functions: Iterable[Callable | None], params: PyTree) -> tuple[Shape, ...]:
    """What is drawn of a system if nothing is given: what its functions look like, and bodies as boxes.

    A box of mass m has I_1 = m (b² + c²)/12 and so on, so that a² = 6 (I_2 + I_3 - I_1)/m. A wheel that rolls is a disk
    instead.
    """
    # Several wheels have one surface.
    found = list(dict.fromkeys(shape for function in functions for shape in getattr(function, "drawing", ())))
    solid = {shape.owner for shape in found if shape.kind == "solid"}
    return (*(_equal_box(body, params) for body in bodies if body.name not in solid), *found)


def _equal_box(body: Body, params: PyTree) -> Shape:
    inertia = np.asarray(valued(body.inertia, params), float)
    moments, axes = (inertia, np.eye(3)) if inertia.ndim == 1 else np.linalg.eigh(inertia)
    # Columns that are right-handed: a mirrored box would be seen from inside.
    axes = axes * np.sign(np.linalg.det(axes))
    edges = np.sqrt(np.maximum(6 * (np.sum(moments) - 2 * moments) / float(valued(body.mass, params)), 0.0))
    if not edges.max() > 0:
        return line(body)
    anchor = Anchor(body.name, (0.0, 0.0, 0.0), tuple(map(tuple, axes.T.tolist())))
    return Shape("solid", (anchor,), CUBE, tuple(np.maximum(edges, THIN * edges.max()).tolist()))


def _anchor(place: Any) -> Anchor:
    if isinstance(place, Ground):
        return Anchor(None, (0.0, 0.0, 0.0))
    if isinstance(place, Body):
        return Anchor(place.name, (0.0, 0.0, 0.0))
    if isinstance(place, Marker):
        return Anchor(None if isinstance(place.body, Ground) else place.body.name, place.place, place.frame)
    if np.shape(place) != (3,):
        raise TypeError(
            f"a place must be a body, body.at(point), lj.ground or a point (x, y, z), not {type(place).__name__}.\n"
            'Usual cause: the name of a body in place of the body.\nFix: lj.sphere(lj.Body("ball", ...), 0.5).'
        )
    return Anchor(None, tuple(np.asarray(place, float).tolist()))


def _sizes(*lengths: Any) -> Any:
    """Three lengths; a function of params if one of them is."""
    if not any(map(callable, lengths)):
        return tuple(map(float, lengths))
    return _of_params(lengths)


def _of_params(lengths: tuple) -> Callable:
    def size(params):
        return jnp.stack([jnp.asarray(valued(length, params), float) for length in lengths])

    return size
