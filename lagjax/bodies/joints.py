"""Joints between bodies, each an ordinary constraint; gears, belts and racks.

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

**Gears, belts and racks**: one equation between the rates at which two bodies turn, or one turns and one slides.

    n_a·(Ω_a - Ω_c) = i n_b·(Ω_b - Ω_c),      e·(v_b - v_a - Ω_c × (r_b - r_a)) = R n_a·(Ω_a - Ω_c)

c is the carrier, in which the axes of both are held: rates are those that are seen from there (Willis). The angles of
bodies in space are no coordinates, so the equations are ones of velocities.

Source: Müller, *Epicyclic Drive Trains*, §2.2 (Willis' equation).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Body, Ground, Marker, SystemFunction, check_markers, check_takes_params, ground, valued
from lagjax.display import Shape
from lagjax.jaxtools import is_traced
from lagjax.refusals import must, must_be
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


def gear(a: Marker, b: Marker, ratio: ArrayLike | Callable, carrier: Body | Ground = ground) -> Nonholonomic:
    """Let a turn `ratio` times as fast as b, each about its own axis: gears, a belt, a chain; one equation.

    `a` and `b` are places whose axes are those of the hinges, `ratio` a number or a function of params. By numbers of
    teeth it is -z_b/z_a where gears mesh outside and their axes point the same way, z_b/z_a where one is in a ring or
    a chain joins them. `carrier` is the body in which both hinges are, if it turns: the arm of a planetary gear, the
    case of a differential. The rates of a and b are those against it.

    >>> import lagjax as lj
    >>> sun, planet, arm = (lj.bodies.Body(name, 1.0, (1.0, 1.0, 1.0)) for name in ("sun", "planet", "arm"))
    >>> mesh = gear(sun.at(), planet.at(), ratio=-20 / 30, carrier=arm)
    >>> q = {name: lj.bodies.Pose.at() for name in ("sun", "planet", "arm")}
    >>> v = {name: q[name].moving(spin=(0.0, 0.0, x)) for name, x in {"sun": 5.0, "planet": -4.0, "arm": 1.0}.items()}
    >>> print(mesh.phi(0.0, q, v, None).round(6))
    0.666667

    **Returns:** a constraint. Its multiplier is the torque on a about a's axis; that on b about b's axis is -`ratio`
    times as large.

    **Raises:** `TypeError` unless both are markers and the carrier is a body; `ValueError` for two places on one body,
    a carrier that is one of the two, and a ratio that is 0 or no number.
    """
    _check_gear("lj.bodies.gear", a, b, carrier)
    _check_number("ratio", "lj.bodies.gear", ratio)
    return Nonholonomic(Geared(a, b, ratio, carrier))


def rack_and_pinion(
    pinion: Marker, rack: Marker, radius: ArrayLike | Callable, carrier: Body | Ground = ground
) -> Nonholonomic:
    """Let a rack slide along its axis by `radius` times the angle by which the pinion turns; one equation.

    `radius` is a number or a function of params, negative where the rack slides against its axis as the pinion turns
    about its. Where both axes are parallel this is a screw and its nut, of lead 2π `radius`. `carrier` as in
    `lj.bodies.gear`; the rack may be fixed and the pinion's centre move.

    >>> import lagjax as lj
    >>> wheel, rail = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 1.0)), lj.bodies.ground.at(axis=(1.0, 0.0, 0.0))
    >>> mesh = rack_and_pinion(wheel.at(axis=(0.0, 1.0, 0.0)), rail, radius=-0.5)
    >>> q, still = {"wheel": lj.bodies.Pose.at((0.0, 0.0, 0.5))}, lj.bodies.Pose.at((0.0, 0.0, 0.5))
    >>> print(mesh.phi(0.0, q, {"wheel": still.moving((2.0, 0.0, 0.0), spin=(0.0, 4.0, 0.0))}, None))
    0.0

    **Returns:** a constraint. Its multiplier is the force on the rack along its axis; the torque on the pinion about
    its axis is -`radius` times as large.

    **Raises:** as `lj.bodies.gear` does.
    """
    _check_gear("lj.bodies.rack_and_pinion", pinion, rack, carrier)
    _check_number("radius", "lj.bodies.rack_and_pinion", radius)
    return Nonholonomic(Racked(pinion, rack, radius, carrier))


@dataclass(frozen=True, eq=False)
class Geared(SystemFunction):
    """By how much a turns faster than `ratio` times b, a function of (t, q, v, params).

    >>> import lagjax as lj
    >>> wheel, pose = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 1.0)), lj.bodies.Pose.at()
    >>> mesh = Geared(wheel.at(), lj.bodies.ground.at(), 2.0, lj.bodies.ground)
    >>> print(mesh(0.0, {"wheel": pose}, {"wheel": pose.moving(spin=(0.0, 0.0, 3.0))}, None))
    3.0
    """

    a: Marker
    b: Marker
    ratio: ArrayLike | Callable
    carrier: Body | Ground

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        a, b = (_turning(x, self.carrier, q, v) for x in (self.a, self.b))
        return a - jnp.asarray(valued(self.ratio, params), b.dtype) * b

    @property
    def drawing(self) -> tuple[Shape, ...]:
        """What it looks like: the axes."""
        return axis(self.a), axis(self.b)


@dataclass(frozen=True, eq=False)
class Racked(SystemFunction):
    """By how much a rack is faster than its pinion, a function of (t, q, v, params).

    >>> import lagjax as lj
    >>> bar, pose = lj.bodies.Body("bar", 1.0, (1.0, 1.0, 1.0)), lj.bodies.Pose.at()
    >>> mesh = Racked(lj.bodies.ground.at(), bar.at(), 2.0, lj.bodies.ground)
    >>> print(mesh(0.0, {"bar": pose}, {"bar": pose.moving((0.0, 0.0, 3.0))}, None))
    3.0
    """

    pinion: Marker
    rack: Marker
    radius: ArrayLike | Callable
    carrier: Body | Ground

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        way = self.rack.position(q, params) - self.pinion.position(q, params)
        moving = self.rack.velocity(q, v, params) - self.pinion.velocity(q, v, params)
        slides = jnp.dot(self.rack.axis(q), moving - jnp.cross(self.carrier.spin(q, v), way))
        radius = jnp.asarray(valued(self.radius, params), slides.dtype)
        return slides - radius * _turning(self.pinion, self.carrier, q, v)

    @property
    def drawing(self) -> tuple[Shape, ...]:
        """What it looks like: the axes."""
        return axis(self.pinion), axis(self.rack)


def _turning(place: Marker, carrier: Body | Ground, q: PyTree, v: PyTree) -> Float[Array, ""]:
    """The rate at which a body turns about an axis of its own, seen from the carrier."""
    return jnp.dot(place.axis(q), place.body.spin(q, v) - carrier.spin(q, v))


def _check_gear(whose: str, a: Marker, b: Marker, carrier: Body | Ground):
    check_two(a, b)
    fix = "carrier=arm, the lj.bodies.Body itself and no place on it; lj.bodies.ground if it does not turn"
    must_be(Body | Ground, carrier, f"the carrier of {whose} must be a body", fix)
    if isinstance(carrier, Body) and carrier in (a.body, b.body):
        raise ValueError(
            f"the carrier of {whose}, '{carrier.name}', is one of the two bodies, which does not turn against itself.\n"
            "Usual cause: the hinge of the other body was meant.\n"
            "Fix: the body that holds both hinges; lj.bodies.ground, the default, where it does not turn."
        )


def _check_number(role: str, whose: str, given: ArrayLike | Callable):
    check_takes_params(role, whose, given)
    if callable(given) or is_traced(given):
        return
    number = np.asarray(given)
    well = not number.shape and np.isfinite(number) and number != 0
    fix = f"{role}=-60 / 20; a body that does not turn is held by lj.bodies.fixed or lj.bodies.prismatic"
    divided = not number.shape and not np.isfinite(number)
    cause = "a division by zero" if divided else "numbers of teeth divided as whole numbers, 20 // 60"
    must(well, f"the {role} of {whose} must be a finite number that is not 0", given, fix, cause)
