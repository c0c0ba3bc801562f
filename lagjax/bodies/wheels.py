"""Wheels and balls that roll without slipping, on planes and on surfaces f = 0.

The point of contact is where f is least on the rim, or on the sphere. It lies from the centre along a unit vector,

    e = (e0 + x T)/|e0 + x T|,        ∂f/∂x = 0,

where e0 leads down the gradient at the centre, and T are one direction (rim) or two (sphere) at right angles to e0.
On a plane x = 0, and for a ball where f is the distance to the surface. Elsewhere x is found by a few steps of
Newton's, without loops, so that the equations are written out in single numbers.

Source: Bloch, *Nonholonomic Mechanics and Control*, §1.4; Routh, *Advanced Rigid Dynamics*, §§ 214-224 (spheres on
surfaces).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Ground, Marker, SystemFunction, ground, valued
from lagjax.bodies.joints import check_two
from lagjax.bodies.shapes import disk, level, sphere
from lagjax.display import Shape
from lagjax.system import Call, Holonomic, Nonholonomic, check_arguments

# Steps of Newton's to the point of contact from the one below the centre, of which the last turns the way there by less
# than `SETTLED`: some 1e-6 is left, which each of those for derivatives multiplies by that.
STEPS, SETTLED = 3, 1e-3
# Derivatives of the point of contact are exact up to this order: accelerations have the first, and so these leave two.
ORDERS = 3
# By how much the slope of a distance may differ from one.
NOT_ONE = 1e-3


@dataclass(frozen=True)
class Surface:
    """A surface to roll on, f = 0, on the side where f > 0.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> bowl = lj.Surface(lambda r, params: params["radius"] ** 2 - jnp.sum(r**2))
    >>> ball = lj.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> contact = lj.rolling_sphere(ball.at(), bowl, radius=1.0)
    >>> print(contact["touches"].g(0.0, {"ball": lj.Pose.at((0.0, 0.0, -3.5))}, {"radius": 5.0}).round(6))
    0.527778

    **Arguments:** `f`, a function of (r, params) with r (3,) a point; twice differentiable, of any unit, its gradient
    not zero near the surface nor at the centre of what rolls. `on`: the marker in whose frame r is, on a body that may
    move, or `lj.ground`. `is_distance`: whether f is the distance to the surface, |∇f| = 1. A ball then touches
    straight below its centre, and nothing is searched, which compiles in a fraction of the time.

    >>> pipe = lj.Surface(lambda r, params: 5.0 - jnp.sqrt(r[0] ** 2 + r[1] ** 2), is_distance=True)
    >>> contact = lj.rolling_sphere(ball.at(), pipe, radius=1.0)
    >>> print(contact["touches"].g(0.0, {"ball": lj.Pose.at((0.0, 3.5, 0.0))}, None))
    0.5

    What rolls must be less curved inward than the surface, so that it touches in one point: a ball in a bowl is smaller
    than the bowl.

    **Raises:** `TypeError` for an `f` that is not a function, and for an `on` that is no marker. Where `is_distance`
    and |∇f| is not one, and where three steps of Newton's from straight below the centre do not reach the point of
    contact (what rolls is nearly as large as the surface is curved, or far from it), "touches" is NaN.
    """

    f: Callable[[Float[Array, "3"], Any], Any]
    on: Any = ground
    is_distance: bool = False

    def __post_init__(self):
        if not callable(self.f):
            raise TypeError(
                f"a lj.Surface takes a function f(r, params), not {type(self.f).__name__}.\n"
                "Fix: lj.Surface(lambda r, params: r[2] - r[0] ** 2)."
            )
        check_arguments(Call("f", self.f, ("r", "params"), " of lj.Surface"), "x, y and z as three arguments")
        if isinstance(self.on, Ground):
            object.__setattr__(self, "on", self.on.at())
        if not isinstance(self.on, Marker):
            raise TypeError(
                f"a lj.Surface is on a marker, and {type(self.on).__name__} is none.\n"
                "Fix: lj.Surface(f, on=table.at())."
            )

    @cached_property
    def drawing(self) -> tuple[Shape]:
        """What it looks like, for lists of shapes: the part of it about everything else."""
        return (level(self.on, self.f),)


def rolling(wheel: Marker, floor: "Marker | Surface", radius) -> dict[str, Holonomic | Nonholonomic]:
    """Let the rim of a thin wheel roll without slipping: one equation for positions, two for velocities.

    `wheel` is its centre and its axis, `floor` a point of a plane and the normal, or a `lj.Surface`, `radius` a number
    or a function of params. On a plane the rim's lowest point lies from the centre along d, the part of the normal at
    right angles to the axis a:

        d = n - (n·a) a,      g = (c - p)·n - R |d|,      phi = (velocity of the wheel - that of the floor, there)

    Not for a wheel that lies flat, where d = 0. On a surface f = 0 it is the point of the rim where f is least, found
    by Newton's method from there, and g = f/|∇f|, a length.

    >>> import lagjax as lj
    >>> wheel = lj.Body("wheel", 1.0, (1.0, 2.0, 1.0))
    >>> upright = lj.Pose.at((0.0, 0.0, 0.5))
    >>> q, v = {"wheel": upright}, {"wheel": upright.moving((2.0, 0.0, 0.0), spin=(0.0, 4.0, 0.0))}
    >>> contact = rolling(wheel.at(axis=(0.0, 1.0, 0.0)), lj.ground.at(), radius=0.5)
    >>> print(contact["touches"].g(0.0, q, None), contact["rolls"].phi(0.0, q, v, None))
    0.0 [0. 0.]

    **Returns:** {"touches": `Holonomic`, "rolls": `Nonholonomic`}.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.

    Source: Bloch, *Nonholonomic Mechanics and Control*, §1.4 (the rolling disk).
    """
    return _contact(wheel, floor, radius, is_rim=True)


def rolling_sphere(ball: Marker, floor: "Marker | Surface", radius) -> dict[str, Holonomic | Nonholonomic]:
    """Let a sphere roll without slipping; `ball` is its centre, the rest as in `lj.rolling`.

    >>> import lagjax as lj
    >>> ball = lj.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> contact = rolling_sphere(ball.at(), lj.ground.at(), radius=1.0)
    >>> print(contact["touches"].g(0.0, {"ball": lj.Pose.at((3.0, 0.0, 1.25))}, None))
    0.25

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    return _contact(ball, floor, radius, is_rim=False)


def _contact(wheel: Marker, floor: "Marker | Surface", radius: Any, is_rim: bool):
    touches = Touching(wheel, floor, radius, is_rim)
    check_two(wheel, touches.at)
    return {"touches": Holonomic(touches), "rolls": Nonholonomic(touches.slip)}


@dataclass(frozen=True, eq=False)
class Touching(SystemFunction):
    """The gap between a wheel, or a ball, and the floor, a function of (t, q, params); `slip` one of (t, q, v, params).

    >>> import lagjax as lj
    >>> ball = lj.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> print(Touching(ball.at(), lj.ground.at(), 1.0, False)(0.0, {"ball": lj.Pose.at((3.0, 0.0, 1.25))}, None))
    0.25
    """

    wheel: Marker
    floor: Any
    radius: Any
    is_rim: bool

    def __call__(self, t, q: PyTree, params: PyTree) -> Float[Array, ""]:
        point, _ = self._meeting(q, params)
        if self._is_plane:
            return self._height(point, params)
        value, gradient = jax.value_and_grad(self._height)(point, params)
        length = jnp.sqrt(jnp.sum(gradient**2))
        if self.floor.is_distance:
            return jnp.where(jnp.abs(lax.stop_gradient(length) - 1) < NOT_ONE, value, jnp.nan)
        return value / length

    def slip(self, t, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, "2"]:
        """The velocity of the wheel at the point of contact, less that of the floor there, along the floor."""
        (point, arm), at, wheel = self._meeting(q, params), self.at, self.wheel
        axes = at.axes(q)
        of_wheel = wheel.velocity(q, v, params) + jnp.cross(wheel.body.spin(q, v), arm @ axes)
        of_floor = at.velocity(q, v, params) + jnp.cross(at.body.spin(q, v), point @ axes)
        slip = axes @ (of_wheel - of_floor)
        return slip[:2] if self._is_plane else tangents(self._normal(point, params)) @ slip

    @property
    def at(self) -> Marker:
        """The place in whose frame the floor is given."""
        return self.floor if self._is_plane else self.floor.on

    @property
    def drawing(self) -> tuple[Shape, ...]:
        """What it looks like: a disk or a sphere, and the surface."""
        solid = disk if self.is_rim else sphere
        return solid(self.wheel, self.radius), *getattr(self.floor, "drawing", ())

    @property
    def _is_plane(self) -> bool:
        return not isinstance(self.floor, Surface)

    def _height(self, r: Array, params: PyTree) -> Array:
        """f at a point that is given in the frame of the floor."""
        return r[2] if self._is_plane else jnp.asarray(self.floor.f(r, params))

    def _normal(self, r: Array, params: PyTree) -> Array:
        return _unit(jax.grad(self._height)(r, params))

    def _meeting(self, q: PyTree, params: PyTree) -> tuple[Array, Array]:
        """The point of contact and the way there from the centre, in the frame of the floor."""
        size, axes = valued(self.radius, params), self.at.axes(q)
        centre = axes @ (self.wheel.position(q, params) - self.at.position(q, params))
        axis = axes @ self.wheel.axis(q) if self.is_rim else None
        if self._is_plane or self.floor.is_distance and not self.is_rim:
            e = -self._normal(centre, params)
            arm = size * (e if axis is None else _unit(_off(axis, e)))
        else:
            arm = size * _towards(self._height, centre, axis, size, params)
        return centre + arm, arm


def _towards(f: Callable, centre: Array, axis: Array | None, size: Any, params: PyTree) -> Array:
    """The unit vector to the point of contact: where f is least on the rim about an axis or, without one, on a sphere.

    It is found for numbers alone. Its derivatives are those of further steps of Newton's from there with the matrix
    held, each of which adds an order (the first is the implicit function theorem).
    """

    def on_it(e: Array, axis: Array | None) -> Array:
        return _unit(e if axis is None else _off(axis, e))

    def slope(e: Array, centre: Array, axis: Array | None, size: Any, params: PyTree) -> Array:
        """∂f/∂x in the directions in which the point may move."""
        across = _off(e, jax.grad(f)(centre + size * e, params))
        return across if axis is None else _off(axis, across)

    def inverse(e: Array, centre: Array, axis: Array | None, size: Any, params: PyTree) -> Array:
        """The inverse of the derivative of `slope` by these directions."""
        point = centre + size * e
        gradient, hessian = jax.grad(f)(point, params), jax.jacfwd(jax.grad(f))(point, params)
        turns = tangents(e) if axis is None else jnp.cross(axis, e)[None]
        inner = size * turns @ hessian @ turns.T - jnp.dot(e, gradient) * np.eye(len(turns), dtype=e.dtype)
        return turns.T @ _inverted(inner) @ turns

    given = (centre, axis, size, params)
    held = lax.stop_gradient(given)
    found = before = on_it(-jax.grad(f)(held[0], held[3]), held[1])
    for _ in range(STEPS):
        before, found = found, on_it(found - inverse(found, *held) @ slope(found, *held), held[1])
    found = jnp.where(jnp.sum((found - before) ** 2) < SETTLED**2, found, jnp.nan)
    chord, e = inverse(found, *held), on_it(found, axis)
    for _ in range(ORDERS):
        e = on_it(e - chord @ slope(e, *given), axis)
    return e


def tangents(normal: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """The first two coordinate axes, turned by the shortest way that takes the third, or where that is far, back, to n.

    >>> print(tangents(jnp.array([0.0, 0.0, -1.0])))
    [[1. 0. 0.]
     [0. 1. 0.]]
    """
    side = jnp.where(normal[2] < -0.9, -1.0, 1.0).astype(normal.dtype)
    axis = jnp.stack([jnp.zeros_like(side), jnp.zeros_like(side), side])
    along = normal[:2] / (1 + side * normal[2])
    return jnp.eye(2, 3, dtype=normal.dtype) - along[:, None] * (axis + normal)[None]


def _unit(x: Array) -> Array:
    return x / jnp.sqrt(jnp.sum(x**2))


def _off(e: Array, x: Array) -> Array:
    """The part of x at right angles to a unit vector."""
    return x - jnp.dot(e, x) * e


def _inverted(a: Array) -> Array:
    """The inverse of one number or of four: what has a rule of differentiation of its own is traced several times."""
    if len(a) == 1:
        return 1 / a
    (p, q), (r, s) = a
    return jnp.array([[s, -q], [-r, p]]) / (p * s - q * r)
