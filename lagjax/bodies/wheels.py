"""Wheels and balls that roll without slipping, on planes and on surfaces f = 0.

The point of contact is where f is least on the rim, or on the sphere. It lies from the centre along a unit vector,

    e = (e0 + x T)/|e0 + x T|,        ∂f/∂x = 0,

where e0 leads down the gradient at the centre, and T are one direction (rim) or two (sphere) at right angles to e0.
On a plane x = 0, and for a ball where f is the distance to the surface. Elsewhere x is found by Newton's method, with
the derivatives of the implicit function.

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

from lagjax.bodies.body import Ground, Marker, ground, valued
from lagjax.bodies.joints import check_two
from lagjax.bodies.shapes import disk, level, looks, sphere
from lagjax.display import Shape
from lagjax.numerics import dense, newton
from lagjax.system import Call, Holonomic, Nonholonomic, check_arguments

# The most steps of Newton's to the point of contact; from the one below the centre it takes some five.
MOST = 20
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
    and |∇f| is not one, "touches" is NaN.
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

    def ways(n: Array, a: Array):
        along = jnp.cross(n, a)
        return jnp.cross(a, along), along[None]

    contact = _contact(wheel, floor, radius, ways)
    looks(contact["touches"].function, disk(wheel, radius), *getattr(floor, "drawing", ()))
    return contact


def rolling_sphere(ball: Marker, floor: "Marker | Surface", radius) -> dict[str, Holonomic | Nonholonomic]:
    """Let a sphere roll without slipping; `ball` is its centre, the rest as in `lj.rolling`.

    >>> import lagjax as lj
    >>> ball = lj.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> contact = rolling_sphere(ball.at(), lj.ground.at(), radius=1.0)
    >>> print(contact["touches"].g(0.0, {"ball": lj.Pose.at((3.0, 0.0, 1.25))}, None))
    0.25

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    straight = isinstance(floor, Surface) and floor.is_distance

    def ways(n: Array, a: Array):
        return n, None if straight else tangents(n, np.eye(3, dtype=n.dtype))

    contact = _contact(ball, floor, radius, ways)
    looks(contact["touches"].function, sphere(ball, radius), *getattr(floor, "drawing", ()))
    return contact


def _contact(wheel: Marker, floor: Any, radius: Any, ways: Callable) -> dict[str, Holonomic | Nonholonomic]:
    """`ways(n, a)`: the way up from the point of contact on a plane, and the directions in which it may move else.

    There are no such directions (None) where it lies straight below on a surface too.
    """
    is_plane = not isinstance(floor, Surface)
    at = floor if is_plane else floor.on
    check_two(wheel, at)

    def height(r: Array, q: PyTree, params: PyTree) -> Array:
        """f at a point of space."""
        place = r - at.position(q, params)
        return jnp.dot(place, at.axis(q)) if is_plane else jnp.asarray(floor.f(at.axes(q) @ place, params))

    def meeting(q: PyTree, params: PyTree) -> tuple[Array, Array]:
        """The way from the centre to the point of contact, and the surface's normal there."""
        centre, size = wheel.position(q, params), valued(radius, params)
        up = at.axis(q) if is_plane else _unit(jax.grad(height)(centre, q, params))
        d, turns = ways(up, wheel.axis(q))
        if is_plane or turns is None:
            return -size * _unit(d), up

        def arm_at(x: Array) -> Array:
            return size * _unit(x @ turns - d)

        arm = arm_at(_least(lambda x: height(centre + arm_at(x), q, params), len(turns), d.dtype))
        return arm, _unit(jax.grad(height)(centre + arm, q, params))

    def touches(t, q, params):
        arm, normal = meeting(q, params)
        lowest = wheel.position(q, params) + arm
        if is_plane:
            return height(lowest, q, params)
        value, slope = jax.value_and_grad(height)(lowest, q, params)
        length = jnp.dot(slope, normal)
        if floor.is_distance:
            return jnp.where(jnp.abs(lax.stop_gradient(length) - 1) < NOT_ONE, value, jnp.nan)
        return value / length

    def rolls(t, q, v, params):
        arm, normal = meeting(q, params)
        of_wheel = wheel.velocity(q, v, params) + jnp.cross(wheel.body.spin(q, v), arm)
        from_floor = wheel.position(q, params) + arm - at.position(q, params)
        of_floor = at.velocity(q, v, params) + jnp.cross(at.body.spin(q, v), from_floor)
        across = at.axes(q)[:2] if is_plane else tangents(normal, at.axes(q))
        return across @ (of_wheel - of_floor)

    return {"touches": Holonomic(touches), "rolls": Nonholonomic(rolls)}


def tangents(normal: Float[Array, "3"], frame: Float[Array, "3 3"]) -> Float[Array, "2 3"]:
    """The frame's first two vectors, turned by the shortest way that takes its axis, or where that is far, back, to n.

    >>> print(tangents(jnp.array([0.0, 0.0, -1.0]), jnp.eye(3)))
    [[1. 0. 0.]
     [0. 1. 0.]]
    """
    axis = jnp.where(jnp.dot(frame[2], normal) < -0.9, -frame[2], frame[2])
    along = frame[:2] @ normal / (1 + jnp.dot(axis, normal))
    return frame[:2] - along[:, None] * (axis + normal)[None]


def _unit(x: Array) -> Array:
    return x / jnp.sqrt(jnp.sum(x**2))


def _least(f: Callable[[Array], Array], count: int, dtype) -> Array:
    """Where f of `count` numbers is stationary, near zero."""
    slope = jax.grad(f)

    def solve(slope: Callable, start: Array):
        def step(x: Array, r: Array, i: Array) -> Array:
            return dense.solve(jax.jacfwd(slope)(x), r)

        return newton(slope, step, start, MOST, falls=0.9)

    def tangent(push: Callable, known: Array):
        return dense.solve(jax.jacfwd(push)(jnp.zeros_like(known)), known)

    return lax.custom_root(slope, jnp.zeros(count, dtype), solve, tangent)
