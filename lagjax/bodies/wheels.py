"""Wheels, balls and ellipsoids that roll without slipping, on planes and on surfaces f = 0; where they touch these.

The point of contact is where f is least on what rolls. On a plane, and for a ball
where f is the distance to the surface, it lies straight below the centre; elsewhere it is searched for.

Source: Bloch, *Nonholonomic Mechanics and Control*, §1.4; Routh, *Advanced Rigid Dynamics*, §§ 214-224 (spheres on
surfaces).

**Where a body touches a surface**: at the point of the body where f is least.

The points of the body are c + uᵀS for unit vectors u: a sphere with S = R 1, a rim in the plane of the two rows of S.
With F(u) = f(c + uᵀS), at the point of contact

    ∇F = μ u,      a change y of ∇F turns u by x:      x·(∇²F - μ 1) x' + x'·y = 0 for all x' at right angles to u

u is found for numbers alone, by steps of Newton's without loops, so that the equations are written out in single
numbers. Its derivatives are those of the implicit function: `following` is u, and the rule for its derivative is
written with `following`, so that it has a derivative again, to any order. Those of the least value of F do not contain
those of u: x·∇F = 0.

Source: Krantz & Parks, *The Implicit Function Theorem*; Milgrom & Segal, Econometrica 70 (2002) 583 (envelopes).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Ground, Marker, SystemFunction, check_quantity, ground, valued
from lagjax.bodies.joints import check_two
from lagjax.display import Shape
from lagjax.jaxtools import is_traced, jaxpr_as_fun, rule_follows
from lagjax.refusals import must, must_be, must_be_function
from lagjax.shapes import disk, ellipsoid, level, sphere
from lagjax.system import Call, Holonomic, Nonholonomic, check_arguments

# Steps of Newton's to the point of contact from the one below the centre, of which the last turns u by less than
# `SETTLED`. A further one with its matrix leaves the third power of that.
STEPS, SETTLED = 4, 1e-5


class Touch(NamedTuple):
    """The point of contact and the way there from the centre; f, |∇f| and ∇f/|∇f| there."""

    point: Float[Array, "3"]
    arm: Float[Array, "3"]
    height: Float[Array, ""]
    slope: Float[Array, ""]
    normal: Float[Array, "3"]


def on_plane(centre: Array, shape: Array) -> Touch:
    """The point of contact with the plane z = 0, of which z is the height."""
    up = jnp.asarray((0.0, 0.0, 1.0), centre.dtype)
    arm = -unit(shape[:, 2]) @ shape
    return Touch(centre + arm, arm, centre[2] + arm[2], jnp.ones_like(centre[2]), up)


def below(f: Callable, centre: Array, radius: Array) -> Touch:
    """The point of contact of a sphere where f is the distance: straight below its centre, nearer by the radius."""
    height, normal = jax.value_and_grad(f)(centre)
    arm = -radius * normal
    return Touch(centre + arm, arm, height - radius, jnp.sqrt(jnp.sum(normal**2)), normal)


def searched(f: Callable, centre: Array, shape: Array) -> Touch:
    """The point of contact of any of these bodies, given its `shape` S (2, 3) or (3, 3)."""
    start = -unit(shape @ jax.grad(f)(lax.stop_gradient(centre)))
    u, height = least_of(lambda u: f(centre + u @ shape), lax.stop_gradient(start))
    arm = u @ shape
    gradient = jax.grad(f)(centre + arm)
    slope = jnp.sqrt(jnp.sum(gradient**2))
    return Touch(centre + arm, arm, height, slope, gradient / slope)


def least_of(f: Callable, start: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The unit vector of two or three numbers, near that at the start, for which a function is least; and its value.

    >>> import jax
    >>> import numpy as np
    >>> nearest = jax.jit(lambda to, start: least_of(lambda u: jnp.sum((u - to) ** 2), start))
    >>> u, value = nearest(np.array([3.0, 4.0]), np.array([0.8, 0.6]))
    >>> print(u.round(6), value.round(6))
    [0.6 0.8] 16.0

    Both are NaN where it is not found. They are differentiable in what f depends on, to any order.
    """
    program = jax.make_jaxpr(f)(start)
    traced = list(map(is_traced, program.consts))
    beside = [x for x, changes in zip(program.consts, traced) if changes]

    def value(u: Array, beside: Sequence[Array]) -> Array:
        rest = iter(beside)
        consts = [next(rest) if changes else x for x, changes in zip(program.consts, traced)]
        return jaxpr_as_fun(program.replace(consts=consts))(u)[0]

    gradient = jax.grad(value)

    def turning(u: Array, beside: Sequence[Array]) -> tuple[Callable[[Array], Array], Array]:
        """How u turns when the gradient there changes; whether F curves upward in all directions."""
        matrix = jax.jacfwd(gradient)(u, beside) - jnp.dot(u, gradient(u, beside)) * np.eye(len(u), dtype=u.dtype)
        if len(u) == 2:
            across = jnp.stack([-u[1], u[0]])
            curvature = jnp.dot(across, matrix @ across)
            return lambda y: -jnp.dot(across, y) / curvature * across, curvature > 0
        # The inverse of a symmetric matrix (2, 2) is that matrix, turned by a right angle, by its determinant.
        a, b, c = matrix
        cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
        determinant = jnp.dot(u, cofactors @ u)
        is_least = (determinant > 0) & (jnp.trace(matrix) > jnp.dot(u, matrix @ u))
        return lambda y: jnp.cross(u, matrix @ jnp.cross(u, y)) / determinant, is_least

    @rule_follows
    def following(u: Array, beside: Sequence[Array]) -> Array:
        return u

    @following.defjvp
    def _(primals: tuple, tangents: tuple):
        u, (_, beside), (_, moving) = following(*primals), primals, tangents
        y = jax.jvp(lambda beside: gradient(u, beside), (beside,), (moving,))[1]
        return u, turning(u, beside)[0](y)

    @rule_follows
    def least(u: Array, beside: Sequence[Array]) -> Array:
        return value(u, beside)

    @least.defjvp
    def _(primals: tuple, tangents: tuple):
        u, (_, beside), (_, moving) = following(*primals), primals, tangents
        # The value is `least` again: by `value` its derivative would contain that of u.
        return least(*primals), jax.jvp(lambda beside: value(u, beside), (beside,), (moving,))[1]

    held, found, before = lax.stop_gradient(beside), start, start
    turn, is_least = turning(found, held)
    for i in range(STEPS):
        before, found = found, unit(found + turn(gradient(found, held)))
        if i < STEPS - 1:
            turn, is_least = turning(found, held)
    is_found = is_least & (jnp.sum((found - before) ** 2) < SETTLED**2)
    found = unit(jnp.where(is_found, found, jnp.nan) + turn(gradient(found, held)))
    return following(found, beside), least(found, beside)


def unit(x: Array) -> Array:
    """The unit vector along another."""
    return x / jnp.sqrt(jnp.sum(x**2))


# By how much the slope of a distance may differ from one.
NOT_ONE = 1e-3


@dataclass(frozen=True)
class Surface:
    """A surface to roll on, f = 0, on the side where f > 0.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> bowl = lj.bodies.Surface(lambda r, params: params["radius"] ** 2 - jnp.sum(r**2))
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> contact = lj.bodies.rolling_sphere(ball.at(), bowl, radius=1.0)
    >>> q = {"ball": lj.bodies.Pose.at((0.0, 0.0, -3.5))}
    >>> print(jax.jit(contact["touches"].g)(0.0, q, {"radius": 5.0}).round(6))
    0.527778

    **Arguments:** `f`, a function of (r, params) with r (3,) a point; twice differentiable, of any unit, its gradient
    not zero near the surface nor at the centre of what rolls. `on`: the marker in whose frame r is, on a body that may
    move, or `lj.bodies.ground`. `is_distance`: whether f is the distance to the surface, |∇f| = 1. A ball then touches
    straight below its centre, and nothing is searched, which compiles in half the time.

    >>> pipe = lj.bodies.Surface(lambda r, params: 5.0 - jnp.sqrt(r[0] ** 2 + r[1] ** 2), is_distance=True)
    >>> contact = lj.bodies.rolling_sphere(ball.at(), pipe, radius=1.0)
    >>> print(jax.jit(contact["touches"].g)(0.0, {"ball": lj.bodies.Pose.at((0.0, 3.5, 0.0))}, None))
    0.5

    What rolls must be less curved inward than the surface, so that it touches in one point: a ball in a bowl is smaller
    than the bowl.

    **Raises:** `TypeError` for an `f` that is not a function, and for an `on` that is no marker. Where `is_distance`
    and |∇f| is not one, and where four steps of Newton's from straight below the centre do not reach a point of contact
    at which f is least (what rolls is nearly as large as the surface is curved, or far from it), "touches" is NaN.
    """

    f: Callable[[Float[Array, "3"], Any], Any]
    on: Any = ground
    is_distance: bool = False

    def __post_init__(self):
        fix = "lj.bodies.Surface(lambda r, params: r[2] - r[0] ** 2)"
        must_be_function(self.f, "f of a lj.bodies.Surface", "(r, params)", fix)
        check_arguments(Call("f", self.f, ("r", "params"), " of lj.bodies.Surface"), "x, y and z as three arguments")
        if isinstance(self.on, Ground):
            object.__setattr__(self, "on", self.on.at())
        must_be(Marker, self.on, "a lj.bodies.Surface must be on a marker", "lj.bodies.Surface(f, on=table.at())")

    @cached_property
    def drawing(self) -> tuple[Shape]:
        """What it looks like, for lists of shapes: the part of it about everything else."""
        return (level(self.on, self.f),)


def rolling(wheel: Marker, floor: "Marker | Surface", radius) -> dict[str, Holonomic | Nonholonomic]:
    """Let the rim of a thin wheel roll without slipping: one equation for positions, two for velocities.

    `wheel` is its centre and its axis, `floor` a point of a plane and the normal, or a `lj.bodies.Surface`, `radius` a
    number or a function of params. On a plane the rim's lowest point lies from the centre along d, the part of the
    normal at right angles to the axis a:

        d = n - (n·a) a,      g = (c - p)·n - R |d|,      phi = (velocity of the wheel - that of the floor, there)

    Not for a wheel that lies flat, where d = 0. On a surface f = 0 it is the point of the rim where f is least, found
    by Newton's method from there, and g = f/|∇f|, a length.

    >>> import lagjax as lj
    >>> wheel = lj.bodies.Body("wheel", 1.0, (1.0, 2.0, 1.0))
    >>> upright = lj.bodies.Pose.at((0.0, 0.0, 0.5))
    >>> q, v = {"wheel": upright}, {"wheel": upright.moving((2.0, 0.0, 0.0), spin=(0.0, 4.0, 0.0))}
    >>> contact = rolling(wheel.at(axis=(0.0, 1.0, 0.0)), lj.bodies.ground.at(), radius=0.5)
    >>> print(contact["touches"].g(0.0, q, None), contact["rolls"].phi(0.0, q, v, None))
    0.0 [0. 0.]

    **Returns:** {"touches": `Holonomic`, "rolls": `Nonholonomic`}.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.

    Source: Bloch, *Nonholonomic Mechanics and Control*, §1.4 (the rolling disk).
    """
    check_quantity("the radius", "lj.bodies.rolling", radius, above_zero=True)
    return _contact(Touching(wheel, floor, "rim", radius))


def rolling_sphere(ball: Marker, floor: "Marker | Surface", radius) -> dict[str, Holonomic | Nonholonomic]:
    """Let a sphere roll without slipping; `ball` is its centre, the rest as in `lj.bodies.rolling`.

    >>> import lagjax as lj
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> contact = rolling_sphere(ball.at(), lj.bodies.ground.at(), radius=1.0)
    >>> print(contact["touches"].g(0.0, {"ball": lj.bodies.Pose.at((3.0, 0.0, 1.25))}, None))
    0.25

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body.
    """
    check_quantity("the radius", "lj.bodies.rolling_sphere", radius, above_zero=True)
    return _contact(Touching(ball, floor, "sphere", radius))


def rolling_ellipsoid(stone: Marker, floor: "Marker | Surface", half_axes: Sequence):
    """Let an ellipsoid roll without slipping, as a rattleback does.

    `stone` is its centre, and the axes of its shape, which may be turned against the principal axes of inertia;
    `half_axes` three numbers or functions of params, along these axes; the rest as in `lj.bodies.rolling`. On a plane
    with normal n it touches at

        c - S² n / |S n|,      S² = Σ s_i² e_i e_iᵀ

    >>> import lagjax as lj
    >>> stone = lj.bodies.Body("stone", 1.0, (2.0, 16.0, 17.0))
    >>> contact = rolling_ellipsoid(stone.at(), lj.bodies.ground.at(), (2.0, 0.3, 0.2))
    >>> on_its_end = lj.bodies.Pose.at((0.0, 0.0, 2.25), (0.0, 1.0, 0.0), jnp.pi / 2)
    >>> print(contact["touches"].g(0.0, {"stone": on_its_end}, None).round(12))
    0.25

    **Returns:** as `lj.bodies.rolling`.

    **Raises:** `TypeError` unless both are markers; `ValueError` for two places on one body, and unless there are three
    half axes.

    Source: Garcia & Hubbard, Proc. R. Soc. A 418 (1988) 165 (the rattleback).
    """
    fix = "(a, b, c) along the axes of the marker; lj.bodies.rolling_sphere for a sphere"
    must(np.shape(half_axes) == (3,), "lj.bodies.rolling_ellipsoid takes three half axes", half_axes, fix, "one radius")
    for half_axis in half_axes:
        check_quantity("a half axis", "lj.bodies.rolling_ellipsoid", half_axis, above_zero=True)
    return _contact(Touching(stone, floor, "ellipsoid", tuple(half_axes)))


def _contact(touches: "Touching") -> dict[str, Holonomic | Nonholonomic]:
    check_two(touches.wheel, touches.at)
    return {"touches": Holonomic(touches), "rolls": Nonholonomic(touches.slip)}


@dataclass(frozen=True, eq=False)
class Touching(SystemFunction):
    """The gap between what rolls and the floor, a function of (t, q, params); `slip` is one of (t, q, v, params).

    `form`: "rim", "sphere" or "ellipsoid", of which `size` is the radius, or the half axes.

    >>> import lagjax as lj
    >>> ball = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4))
    >>> q = {"ball": lj.bodies.Pose.at((3.0, 0.0, 1.25))}
    >>> print(Touching(ball.at(), lj.bodies.ground.at(), "sphere", 1.0)(0.0, q, None))
    0.25
    """

    wheel: Marker
    floor: Any
    form: str
    size: Any

    def __call__(self, t, q: PyTree, params: PyTree) -> Float[Array, ""]:
        found = self._meeting(q, params)
        if self._is_plane:
            return found.height
        if self.floor.is_distance:
            return jnp.where(jnp.abs(lax.stop_gradient(found.slope) - 1) < NOT_ONE, found.height, jnp.nan)
        return found.height / found.slope

    def slip(self, t, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, "2"]:
        """The velocity of the wheel at the point of contact, less that of the floor there, along the floor."""
        found, at, wheel = self._meeting(q, params), self.at, self.wheel
        axes = at.axes(q)
        of_wheel = wheel.velocity(q, v, params) + jnp.cross(wheel.body.spin(q, v), found.arm @ axes)
        of_floor = at.velocity(q, v, params) + jnp.cross(at.body.spin(q, v), found.point @ axes)
        slip = axes @ (of_wheel - of_floor)
        return slip[:2] if self._is_plane else tangents(found.normal) @ slip

    @property
    def at(self) -> Marker:
        """The place in whose frame the floor is given."""
        return self.floor if self._is_plane else self.floor.on

    @property
    def drawing(self) -> tuple[Shape, ...]:
        """What it looks like, and the surface."""
        solid = {"rim": disk, "sphere": sphere, "ellipsoid": ellipsoid}[self.form]
        return solid(self.wheel, self.size), *getattr(self.floor, "drawing", ())

    @property
    def _is_plane(self) -> bool:
        return not isinstance(self.floor, Surface)

    def _meeting(self, q: PyTree, params: PyTree) -> Touch:
        """The point of contact in the frame of the floor."""
        axes = self.at.axes(q)
        centre = axes @ (self.wheel.position(q, params) - self.at.position(q, params))
        shape = self._shape(self.wheel.axes(q) @ axes.T, params)
        if self._is_plane:
            return on_plane(centre, shape)
        f = partial(_height, self.floor.f, params)
        if self.floor.is_distance and self.form == "sphere":
            return below(f, centre, valued(self.size, params))
        return searched(f, centre, shape)

    def _shape(self, axes: Float[Array, "3 3"], params: PyTree) -> Float[Array, "k 3"]:
        """The rows S, of which it consists of the points uᵀS about its centre, for unit vectors u."""
        if self.form == "ellipsoid":
            return jnp.stack([jnp.asarray(valued(x, params), axes.dtype) for x in self.size])[:, None] * axes
        return valued(self.size, params) * (axes[:2] if self.form == "rim" else np.eye(3, dtype=axes.dtype))


def _height(f: Callable, params: PyTree, r: Array) -> Array:
    return jnp.asarray(f(r, params))


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
