"""Joints between bodies, each an ordinary constraint.

A joint joins two markers, a and b: its rows are what must vanish, said for a place b seen from a place a.

| row | equations | vanishes where |
|---|---|---|
| `apart` | 3 | the points are one |
| `aside` | 2 | the point of b lies on the axis of a |
| `tilt` | 2 | the axes are parallel |
| `cross` | 1 | the axes are at right angles |
| `turn` | 3 | the frames are parallel |
| `above` | 1 | the point of b lies in the plane at right angles to the axis of a |

The multiplier of a point's row is a force along an axis of space (`aside`: of a), of a row of axes a torque.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Ground, Marker, check_markers
from lagjax.display import Shape
from lagjax.shapes import axis, gap, line
from lagjax.system import Holonomic, Nonholonomic


def spherical(a: Marker, b: Marker) -> Holonomic:
    """Hold two points together, as a ball in its socket: three equations.

    >>> import lagjax as lj
    >>> bob = lj.bodies.Body("bob", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"bob": lj.bodies.Pose.at((0.1, 0.0, -1.0))}
    >>> joint = spherical(lj.bodies.ground.at(), bob.at((0.0, 0.0, 1.0)))
    >>> print(joint.g(0.0, q, None))
    [0.1 0.  0. ]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, apart)


def revolute(a: Marker, b: Marker) -> Holonomic:
    """Hold two points and two axes together, as a hinge: five equations.

    >>> import lagjax as lj
    >>> door = lj.bodies.Body("door", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"door": lj.bodies.Pose.at((-0.5, 0.0, 0.1))}
    >>> joint = revolute(lj.bodies.ground.at(), door.at((0.5, 0.0, 0.0)))
    >>> print(joint.g(0.0, q, None))
    [0.  0.  0.1 0.  0. ]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, apart, tilt)


def universal(a: Marker, b: Marker) -> Holonomic:
    """Hold two points together and two axes at right angles, those of the cross of a Cardan joint: four equations.

    >>> import lagjax as lj
    >>> shaft = lj.bodies.Body("shaft", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"shaft": lj.bodies.Pose.at((0.0, 0.0, 1.0))}
    >>> joint = universal(lj.bodies.ground.at(), shaft.at((0.0, 0.0, -1.0), axis=(1.0, 0.0, 0.0)))
    >>> print(joint.g(0.0, q, None))
    [0. 0. 0. 0.]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, apart, cross)


def cylindrical(a: Marker, b: Marker) -> Holonomic:
    """Hold two axes together, along which and about which the bodies move: two equations for points, two for axes.

    >>> import lagjax as lj
    >>> ring = lj.bodies.Body("ring", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"ring": lj.bodies.Pose.at((0.2, 0.0, 3.0))}
    >>> joint = cylindrical(lj.bodies.ground.at(), ring.at())
    >>> print(joint.g(0.0, q, None))
    [0.2 0.  0.  0. ]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, aside, tilt)


def prismatic(a: Marker, b: Marker) -> Holonomic:
    """Let a body slide along the other's axis without turning, the markers' frames alike: five equations.

    >>> import lagjax as lj
    >>> slider = lj.bodies.Body("slider", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"slider": lj.bodies.Pose.at((0.2, 0.0, 3.0))}
    >>> joint = prismatic(lj.bodies.ground.at(), slider.at())
    >>> print(joint.g(0.0, q, None))
    [0.2 0.  0.  0.  0. ]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, aside, turn)


def planar(a: Marker, b: Marker) -> Holonomic:
    """Hold a point in the plane at right angles to an axis, and the axes together: a plate on a table, three equations.

    >>> import lagjax as lj
    >>> plate = lj.bodies.Body("plate", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"plate": lj.bodies.Pose.at((0.2, 0.5, 0.1), angle=1.0)}
    >>> joint = planar(lj.bodies.ground.at(), plate.at())
    >>> print(joint.g(0.0, q, None))
    [0.1 0.  0. ]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, above, tilt)


def fixed(a: Marker, b: Marker) -> Holonomic:
    """Make two bodies one, their markers' points and frames alike: six equations.

    >>> import lagjax as lj
    >>> lid = lj.bodies.Body("lid", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"lid": lj.bodies.Pose.at((0.0, 0.0, 1.0), angle=0.1)}
    >>> joint = fixed(lj.bodies.ground.at((0.0, 0.0, 1.0)), lid.at())
    >>> print(joint.g(0.0, q, None).round(4))
    [0.     0.     0.     0.     0.     0.0998]

    **Returns:** a constraint with the rows of its sentence, in this order.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _joined(a, b, apart, turn)


def named(joints: Mapping[str, Holonomic | Nonholonomic | Mapping]) -> dict[str, Holonomic | Nonholonomic]:
    """Joints by name, those of several parts as "wheel touches", "wheel rolls"."""
    parts = {name: joint if isinstance(joint, Mapping) else {"": joint} for name, joint in joints.items()}
    return {f"{name} {part}".strip(): x for name, joint in parts.items() for part, x in joint.items()}


def apart(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "3"]:
    """The way from the point of a to that of b."""
    return b.position(q, params) - a.position(q, params)


def aside(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "2"]:
    """The parts of that way at right angles to the axis of a."""
    return a.axes(q)[:2] @ apart(a, b, q, params)


def above(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "1"]:
    """The part of that way along the axis of a."""
    return jnp.dot(a.axis(q), apart(a, b, q, params))[None]


def tilt(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "2"]:
    """The parts of the axis of b at right angles to the axis of a."""
    return a.axes(q)[:2] @ b.axis(q)


def cross(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "1"]:
    """The part of the axis of b along the axis of a."""
    return jnp.dot(a.axis(q), b.axis(q))[None]


def turn(a: Marker, b: Marker, q: PyTree, params: PyTree) -> Float[Array, "3"]:
    """What turns the frame of a into that of b: the vector of sin(angle), where the angle is small."""
    return jnp.sum(jnp.cross(a.axes(q), b.axes(q)), axis=0) / 2


@dataclass(frozen=True)
class Joined:
    """The rows of a joint between two markers, as a function of (t, q, params).

    >>> import lagjax as lj
    >>> bob = lj.bodies.Body("bob", 1.0, (1.0, 1.0, 1.0))
    >>> q = {"bob": lj.bodies.Pose.at((0.0, 0.5, 0.0))}
    >>> Joined(lj.bodies.ground.at(), bob.at(), (apart,))(0.0, q, None).tolist()
    [0.0, 0.5, 0.0]
    """

    a: Marker
    b: Marker
    rows: tuple[Callable, ...]

    def __call__(self, t, q: PyTree, params: PyTree) -> Float[Array, " m"]:
        return jnp.concatenate([row(self.a, self.b, q, params) for row in self.rows])

    @property
    def drawing(self) -> tuple[Shape, ...]:
        """What it looks like: a dot where it is, lines to the bodies' centres, its axes, and its gap."""
        ends = (x for x in (self.a, self.b) if not isinstance(x.body, Ground))
        axes = [axis(self.a), axis(self.b)] if {tilt, aside, cross} & {*self.rows} else []
        open_by = [gap(self.a, self.b)] if apart in self.rows else []
        return line(self.a), *(line(x.body, x) for x in ends), *axes, *open_by


def _joined(a: Marker, b: Marker, *rows: Callable) -> Holonomic:
    check_two(a, b)
    return Holonomic(Joined(a, b, rows))


def check_two(a: Marker, b: Marker):
    """Raise a `TypeError` unless both are markers, and a `ValueError` for two on one body."""
    check_markers("a joint joins two places on bodies", a, b)
    if a.body == b.body:
        raise ValueError(
            f"a joint joins two bodies, and both places are on '{a.body.name}'.\n"
            "Usual cause: a name that was copied.\n"
            "Fix: one of the places on the other body, or on lj.bodies.ground."
        )
