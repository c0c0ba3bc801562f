"""Gears, belts and racks: one equation between the rates at which two bodies turn, or one turns and one slides.

    n_a·(Ω_a - Ω_c) = i n_b·(Ω_b - Ω_c),      e·(v_b - v_a - Ω_c × (r_b - r_a)) = R n_a·(Ω_a - Ω_c)

c is the carrier, in which the axes of both are held: rates are those that are seen from there (Willis). The angles of
bodies in space are no coordinates, so the equations are ones of velocities.

Source: Müller, *Epicyclic Drive Trains*, §2.2 (Willis' equation).
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Body, Ground, Marker, SystemFunction, check_takes_params, ground, valued
from lagjax.bodies.joints import check_two
from lagjax.display import Shape
from lagjax.jaxtools import is_traced
from lagjax.shapes import axis
from lagjax.system import Nonholonomic


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
    if not isinstance(carrier, Body | Ground):
        raise TypeError(
            f"the carrier of {whose} is a body, and {type(carrier).__name__} is none.\n"
            "Fix: carrier=arm, the lj.bodies.Body itself and no place on it; lj.bodies.ground, the default, where it "
            "does not turn."
        )
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
    if number.shape or not np.isfinite(number) or number == 0:
        raise ValueError(
            f"the {role} of {whose} must be a number that is not 0, and is {given}.\n"
            "Usual cause: numbers of teeth divided as whole numbers, 20 // 60.\n"
            f"Fix: {role}=-60 / 20; a body that does not turn is held by lj.bodies.fixed or lj.bodies.prismatic."
        )
