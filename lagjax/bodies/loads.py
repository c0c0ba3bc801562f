"""Springs, dampers, motors and weight: terms of L, of Rayleigh's function and of the forces.

A force F on a point and a torque N on a body do the power F·v + N·Ω, which is linear in the rates of the coordinates:
the generalized force is its derivative by these (Goldstein, §1.4, Eq. 1.49).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import (
    Body,
    Marker,
    SystemFunction,
    check_bodies,
    check_markers,
    check_quantity,
    check_takes_state,
    valued,
)
from lagjax.display import Shape
from lagjax.jaxtools import numpy_of
from lagjax.refusals import must_be
from lagjax.shapes import line


class Load(NamedTuple):
    """What acts on bodies; each part a function of (t, q, v, params) or None.

    `potential` is subtracted from L, `dissipation` a term of Rayleigh's function, `power` a function of
    (t, q, w, v, params) that is linear in the rates w: the power of the forces in a motion with rates w instead of v.

    >>> Load(potential=lambda t, q, v, params: params["k"] * q["rod"].position[2] ** 2).power is None
    True
    """

    potential: Callable | None = None
    dissipation: Callable | None = None
    power: Callable | None = None


def weight(bodies: Iterable[Body], g: ArrayLike | Callable = (0.0, 0.0, -9.81)) -> Load:
    """The weight of bodies in a uniform field `g`, `[length]/[t]²`, (3,) numbers or a function of params.

    >>> import lagjax as lj
    >>> stone = lj.bodies.Body("stone", 2.0, (1.0, 1.0, 1.0))
    >>> print(weight([stone]).potential(0.0, {"stone": lj.bodies.Pose.at((0.0, 0.0, 3.0))}, None, None))
    58.86

    **Raises:** `TypeError` unless `bodies` is a list of them and `g` takes params if it is a function.
    """
    check_quantity("the field g", "lj.bodies.weight", g, (3,))
    return Load(Weight(check_bodies("lj.bodies.weight", bodies), g))


class Weight(NamedTuple):
    """The potential energy of bodies in a uniform field.

    >>> Weight((), (0.0, 0.0, -9.81)).bodies
    ()
    """

    bodies: tuple[Body, ...]
    g: ArrayLike | Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        masses = [valued(body.mass, params) for body in self.bodies]
        centres = jnp.concatenate([body.pose(q).position for body in self.bodies]).reshape(-1, 3)
        masses = numpy_of(masses).asarray(masses, centres.dtype)
        return -jnp.dot(masses @ centres, jnp.asarray(valued(self.g, params), centres.dtype))


def spring(
    a: Marker, b: Marker, stiffness: ArrayLike | Callable, length: ArrayLike | Callable = 0.0,
    damping: ArrayLike | Callable = 0.0,
) -> Load:  # fmt: skip
    """A spring between two points, with a damper beside it.

        V = ½ k (d - l)²,      R = ½ c ḋ²,      d = |b - a|

    `stiffness` k, `length` l without load and `damping` c are numbers or functions of params. With l = 0 the points may
    meet, without a damper.

    >>> import lagjax as lj
    >>> stone = lj.bodies.Body("stone", 2.0, (1.0, 1.0, 1.0))
    >>> pull = spring(lj.bodies.ground.at(), stone.at(), stiffness=lambda params: params["k"], length=1.0)
    >>> print(pull.potential(0.0, {"stone": lj.bodies.Pose.at((0.0, 0.0, 3.0))}, None, {"k": 10.0}))
    20.0

    **Raises:** `TypeError` unless both are markers, and for a function of anything but params.
    """
    check_markers("a spring is held at two places on bodies", a, b)
    for role, given in {"stiffness": stiffness, "length": length, "damping": damping}.items():
        check_quantity(f"the {role}", "lj.bodies.spring", given)

    pull = Spring(a, b, stiffness, length, damping)
    return Load(pull, None if _is_zero(damping) else pull.dissipation)


@dataclass(frozen=True, eq=False)
class Spring(SystemFunction):
    """The potential energy of a spring between two points, a function of (t, q, v, params); `dissipation` another one.

    >>> import lagjax as lj
    >>> stone = lj.bodies.Body("stone", 2.0, (1.0, 1.0, 1.0))
    >>> pull = Spring(lj.bodies.ground.at(), stone.at(), 10.0, 1.0, 0.0)
    >>> print(pull(0.0, {"stone": lj.bodies.Pose.at((0.0, 0.0, 3.0))}, None, None))
    20.0
    """

    a: Marker
    b: Marker
    stiffness: ArrayLike | Callable
    length: ArrayLike | Callable
    damping: ArrayLike | Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        k, squared = valued(self.stiffness, params), jnp.sum(self._gap(q, params) ** 2)
        if _is_zero(self.length):
            return k * squared / 2
        return k * (jnp.sqrt(squared) - valued(self.length, params)) ** 2 / 2

    def dissipation(self, t, q: PyTree, v: PyTree, params: PyTree):
        """What the damper adds to Rayleigh's function."""
        gap = self._gap(q, params)
        moving = self.b.velocity(q, v, params) - self.a.velocity(q, v, params)
        rate = jnp.dot(gap, moving) / jnp.sqrt(jnp.sum(gap**2))
        return valued(self.damping, params) * rate**2 / 2

    def _gap(self, q: PyTree, params: PyTree) -> Float[Array, "3"]:
        return self.b.position(q, params) - self.a.position(q, params)

    @property
    def drawing(self) -> tuple[Shape]:
        """What it looks like: a line."""
        return (line(self.a, self.b),)


def torsion(
    a: Marker, b: Marker, stiffness: ArrayLike | Callable, angle: ArrayLike | Callable = 0.0,
    damping: ArrayLike | Callable = 0.0,
) -> Load:  # fmt: skip
    """A spring about the axis of a hinge, with a damper beside it.

        V = ½ k (θ - α)²,      R = ½ c (n·(Ω_b - Ω_a))²

    θ is the angle about a's axis n from the first vector of a's frame to that of b's (`lj.bodies.Marker`), between -π
    and π: the spring of a hinge that turns further than that is one of a coordinate of its own. `stiffness` k, `angle`
    α without load and `damping` c are numbers or functions of params.

    >>> import lagjax as lj
    >>> door = lj.bodies.Body("door", 1.0, (1.0, 1.0, 1.0))
    >>> closer = torsion(lj.bodies.ground.at(), door.at(), stiffness=3.0, angle=0.5)
    >>> print(closer.potential(0.0, {"door": lj.bodies.Pose.at(angle=2.5)}, None, None))
    6.0

    **Raises:** `TypeError` unless both are markers, and for a function of anything but params.
    """
    check_markers("a spring is held at two places on bodies", a, b)
    for role, given in {"stiffness": stiffness, "angle": angle, "damping": damping}.items():
        check_quantity(f"the {role}", "lj.bodies.torsion", given)

    turns = Torsion(a, b, stiffness, angle, damping)
    return Load(turns, None if _is_zero(damping) else turns.dissipation)


@dataclass(frozen=True, eq=False)
class Torsion(SystemFunction):
    """The potential energy of a spring about an axis, a function of (t, q, v, params); `dissipation` another one.

    >>> import lagjax as lj
    >>> door = lj.bodies.Body("door", 1.0, (1.0, 1.0, 1.0))
    >>> closer = Torsion(lj.bodies.ground.at(), door.at(), 3.0, 0.5, 0.0)
    >>> print(closer(0.0, {"door": lj.bodies.Pose.at(angle=2.5)}, None, None))
    6.0
    """

    a: Marker
    b: Marker
    stiffness: ArrayLike | Callable
    angle: ArrayLike | Callable
    damping: ArrayLike | Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        along, across, _ = self.a.axes(q)
        first = self.b.axes(q)[0]
        turned = jnp.arctan2(jnp.dot(across, first), jnp.dot(along, first))
        return valued(self.stiffness, params) * (turned - valued(self.angle, params)) ** 2 / 2

    def dissipation(self, t, q: PyTree, v: PyTree, params: PyTree):
        """What the damper adds to Rayleigh's function."""
        return valued(self.damping, params) * _turning(self.a, self.b, q, v) ** 2 / 2


def motor(a: Marker, b: Marker, torque: ArrayLike | Callable) -> Load:
    """A torque from body a on body b about the axis of a: a number, or a function of (t, q, v, params).

    >>> import lagjax as lj
    >>> wheel, pose = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 2.0)), lj.bodies.Pose.at()
    >>> turning = {"wheel": pose.moving(spin=(0.0, 0.0, 3.0))}
    >>> print(motor(lj.bodies.ground.at(), wheel.at(), 5.0).power(0.0, {"wheel": pose}, turning, turning, None))
    15.0

    **Raises:** `TypeError` unless both are markers, and for a function of anything but the state.
    """
    check_markers("a motor is held at two places on bodies", a, b)
    check_takes_state("torque", "lj.bodies.motor", torque)

    return Load(power=TurningPower(a, b, torque))


@dataclass(frozen=True, eq=False)
class TurningPower(SystemFunction):
    """The power of a torque about the axis of a, a function of (t, q, w, v, params).

    >>> import lagjax as lj
    >>> wheel, pose = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 2.0)), lj.bodies.Pose.at()
    >>> turning = {"wheel": pose.moving(spin=(0.0, 0.0, 3.0))}
    >>> print(TurningPower(lj.bodies.ground.at(), wheel.at(), 5.0)(0.0, {"wheel": pose}, turning, turning, None))
    15.0
    """

    a: Marker
    b: Marker
    torque: ArrayLike | Callable

    def __call__(self, t, q: PyTree, w: PyTree, v: PyTree, params: PyTree):
        torque = self.torque(t, q, v, params) if callable(self.torque) else self.torque
        return torque * _turning(self.a, self.b, q, w)


def _turning(a: Marker, b: Marker, q: PyTree, v: PyTree) -> Float[Array, ""]:
    """The rate at which b turns about the axis of a."""
    return jnp.dot(a.axis(q), b.body.spin(q, v) - a.body.spin(q, v))


def applied(at: Marker, force: ArrayLike | Callable) -> Load:
    """A force in space on a point of a body: (3,) numbers, or a function of (t, q, v, params).

    >>> import lagjax as lj
    >>> wheel, pose = lj.bodies.Body("wheel", 1.0, (1.0, 1.0, 2.0)), lj.bodies.Pose.at()
    >>> turning = {"wheel": pose.moving(spin=(0.0, 0.0, 3.0))}
    >>> rim = wheel.at((1.0, 0.0, 0.0))
    >>> print(applied(rim, (0.0, 2.0, 0.0)).power(0.0, {"wheel": pose}, turning, turning, None))
    6.0

    **Raises:** `TypeError` unless `at` is a marker, and for a function of anything but the state.
    """
    check_markers("a force acts at a place on a body", at)
    check_takes_state("force", "lj.bodies.applied", force)

    return Load(power=PointPower(at, force))


@dataclass(frozen=True, eq=False)
class PointPower(SystemFunction):
    """The power of a force on a point, a function of (t, q, w, v, params).

    >>> import lagjax as lj
    >>> cart, pose = lj.bodies.Body("cart", 1.0, (1.0, 1.0, 2.0)), lj.bodies.Pose.at()
    >>> moving = {"cart": pose.moving((0.0, 3.0, 0.0))}
    >>> print(PointPower(cart.at(), (0.0, 2.0, 0.0))(0.0, {"cart": pose}, moving, moving, None))
    6.0
    """

    at: Marker
    force: ArrayLike | Callable

    def __call__(self, t, q: PyTree, w: PyTree, v: PyTree, params: PyTree):
        given = self.force(t, q, v, params) if callable(self.force) else self.force
        velocity = self.at.velocity(q, w, params)
        return jnp.dot(jnp.asarray(given, velocity.dtype), velocity)


class Acting(NamedTuple):
    """What acts beside L: a generalized force and Rayleigh's function, each None where there is none.

    >>> Acting(None, None).force is None
    True
    """

    force: Callable | None
    dissipation: Callable | None

    def with_loads(self, loads: Iterable[Load], placed: Callable) -> "Acting":
        """The same with the powers and dissipations of loads, which read q and v as `placed(t, q, v, params)`."""
        powers = tuple(load.power for load in loads if load.power is not None)
        losses = tuple(load.dissipation for load in loads if load.dissipation is not None)
        force = Driving(powers, self.force, placed) if powers else self.force
        return Acting(force, Losing(losses, self.dissipation, placed) if losses else self.dissipation)


@dataclass(frozen=True, eq=False)
class Driving(SystemFunction):
    """The generalized force of some powers, and of what else acts.

    >>> pulling = Driving((lambda t, q, w, v, params: 3.0 * w,), None, lambda t, q, v, params: (q, v))
    >>> print(pulling(0.0, 1.0, 2.0, None))
    3.0
    """

    powers: tuple[Callable, ...]
    beside: Callable | None
    placed: Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        at, moving = self.placed(t, q, v, params)

        def power(w):
            rates = self.placed(t, q, w, params)[1]
            return sum(of_load(t, at, rates, moving, params) for of_load in self.powers)

        given = jax.grad(power)(v)
        return given if self.beside is None else jax.tree.map(jnp.add, given, self.beside(t, q, v, params))


@dataclass(frozen=True, eq=False)
class Losing(SystemFunction):
    """Rayleigh's function of some dampers, and of what else takes energy.

    >>> print(Losing((lambda t, q, v, params: 3.0 * v**2,), None, lambda t, q, v, params: (q, v))(0.0, 1.0, 2.0, None))
    12.0
    """

    losses: tuple[Callable, ...]
    beside: Callable | None
    placed: Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        at, moving = self.placed(t, q, v, params)
        lost = sum(of_load(t, at, moving, params) for of_load in self.losses)
        return jnp.asarray(lost if self.beside is None else lost + self.beside(t, q, v, params))


def check_loads(whose: str, loads: Iterable[Load]) -> tuple[Load, ...]:
    """The loads as a tuple; a `TypeError` in the name of `whose` unless they are a list of some."""
    if isinstance(loads, Load):
        raise TypeError(
            f"the loads of {whose} are a list, and one load was given.\nFix: loads=[lj.bodies.weight([rod])]."
        )
    loads = tuple(loads)
    for i, load in enumerate(loads):
        fix = "lj.bodies.Load(potential=f), or lagrangian=f for a term of L, force=f for a generalized force"
        cause = "a function of (t, q, v, params) by itself, or a joint among the loads"
        must_be(Load, load, f"load {i} of {whose} must be a lj.bodies.Load", fix, cause)
    return loads


def _is_zero(x: ArrayLike | Callable) -> bool:
    """Whether something was given as the number 0, and not as an array that may be traced."""
    return isinstance(x, int | float) and x == 0
