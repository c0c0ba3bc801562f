"""Bodies whose motion is given: the turning table, the shaken base, the crank that is driven.

Such a body has no coordinates. Its pose P(t, params) and its rates ∂P/∂t are put beside q and v where functions of
these are called, so that joints, loads and L read them as those of any other body:

    L(t, {q, P}, {v, ∂P/∂t}, params),      g(t, {q, P}, params),      phi(t, {q, P}, {v, ∂P/∂t}, params)

Derivatives by q and v are those of the coordinates alone, and derivatives by time run through P.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lagjax.bodies.body import Body, Pose, SystemFunction, floats
from lagjax.system import Holonomic, Nonholonomic


class Driven(NamedTuple):
    """The bodies of a system whose motion is given.

    >>> import lagjax as lj
    >>> table = lj.bodies.Body("table", motion=lambda t, params: lj.bodies.Pose.at(angle=params["rate"] * t))
    >>> q, v = Driven((table,)).placed(2.0, {}, {}, {"rate": 3.0})
    >>> print(table.spin(q, v), Driven(()).placed(2.0, {}, {}, None))
    [0. 0. 3.] ({}, {})
    """

    bodies: tuple[Body, ...]

    @classmethod
    def among(cls, bodies: Iterable[Body]) -> "Driven":
        """Those of some bodies that are driven."""
        return cls(tuple(body for body in bodies if body.motion is not None))

    def placed(self, t, q: PyTree, v: PyTree, params: PyTree) -> tuple[PyTree, PyTree]:
        """q and v with the poses and rates of these bodies."""
        if not self.bodies:
            return q, v
        dtype = floats(q)

        def poses(t):
            return {body.name: _pose(body, t, params, dtype) for body in self.bodies}

        for body in self.bodies:
            if body.name in q:
                raise ValueError(
                    f"'{body.name}' moves as given, and has no coordinates.\n"
                    f"Fix: q0 and v0 without the entry '{body.name}'."
                )
        t = jnp.asarray(t, dtype)
        there, moving = jax.jvp(poses, (t,), (jnp.ones_like(t),))
        return {**q, **there}, {**v, **moving}

    def seen_by(self, joint: Holonomic | Nonholonomic) -> Holonomic | Nonholonomic:
        """A constraint that reads these bodies' poses, as one of the coordinates."""
        if not self.bodies:
            return joint
        seen = OfPlaced(joint.function, self.placed)
        return Holonomic(seen.of_positions) if isinstance(joint, Holonomic) else Nonholonomic(seen)

    def seen_by_all(self, function: Callable | None) -> Callable | None:
        """A function of (t, q, v, params) that reads these bodies' poses and rates, as one of the coordinates."""
        if function is None or not self.bodies:
            return function
        return OfPlaced(function, self.placed)


@dataclass(frozen=True, eq=False)
class OfPlaced(SystemFunction):
    """A function of the poses and rates that `placed(t, q, v, params)` gives, as one of q and v.

    >>> height = OfPlaced(lambda t, q, params: q["bob"], lambda t, q, v, params: ({"bob": 2.0 * q}, v))
    >>> height.of_positions(0.0, 3.0, None)
    6.0
    """

    function: Callable
    placed: Callable

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree) -> Any:
        return self.function(t, *self.placed(t, q, v, params), params)

    def of_positions(self, t, q: PyTree, params: PyTree) -> Any:
        """The same for a function of (t, q, params)."""
        return self.function(t, self.placed(t, q, {}, params)[0], params)


def _pose(body: Body, t, params: PyTree, dtype) -> Pose:
    pose = body.motion(t, params) if body.motion is not None else None
    if not isinstance(pose, Pose):
        raise TypeError(
            f"the motion of '{body.name}' must return a lj.bodies.Pose, and returned {type(pose).__name__}.\n"
            f'Fix: lj.bodies.Body("{body.name}", motion=lambda t, params: lj.bodies.Pose.at(angle=params["rate"] * t)).'
        )
    position, e = (jnp.asarray(x, dtype) for x in pose)
    return Pose(position, e / jnp.sqrt(jnp.sum(e**2)))
