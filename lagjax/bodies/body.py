"""Rigid bodies, as functions of q and v to write Lagrangians and constraints with; rotations; bodies moved as given.

    T = ½ m |ṙ|² + ½ Ωᵀ I Ω + ½ k (2 e·ė)²,      Ω = 2 vec(e* ė),      k = tr(I)/3

r is the centre of mass, e the quaternion, I the inertia about the centre of mass along the body's axes.
The last term vanishes with the constraint |e|² = 1. It is there so that the mass matrix is regular for all rates of e.

**Rotations** are unit quaternions e = (w, x, y, z), which turn a body's axes into those of space.

    r_space = R(e) r_body,      Ω_space = 2 vec(ė e*),      Ω_body = 2 vec(e* ė),      ė = ½ Ω_space e = ½ e Ω_body

R is written without dividing by |e|²: it is a rotation where |e| = 1, which a constraint of the body sees to, and a
Lagrangian need be right there alone. Three numbers would need no constraint, and have poses where they stop: charts
that move would have to be known to all that reads q (outputs, events, fits), where a constraint is known already.

Source: Goldstein, *Classical Mechanics*, §4.5; Diebel, *Representing Attitude* (2006), Eqs. 125, 146 and 160.

**Bodies whose motion is given**: the turning table, the shaken base, the crank that is driven.

Such a body has no coordinates. Its pose P(t, params) and its rates ∂P/∂t are put beside q and v where functions of
these are called, so that joints, loads and L read them as those of any other body:

    L(t, {q, P}, {v, ∂P/∂t}, params),      g(t, {q, P}, params),      phi(t, {q, P}, {v, ∂P/∂t}, params)

Derivatives by q and v are those of the coordinates alone, and derivatives by time run through P.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.display import Anchor
from lagjax.jaxtools import is_traced, judging, numpy_of, to_jax
from lagjax.refusals import must, must_be, must_have_values
from lagjax.system import OF_STATE, Call, Holonomic, Nonholonomic, check_arguments

# Not a jump of a force that reads a quaternion: e and -e are one rotation.
_is_larger = judging(jnp.greater)


def unit_vector(x: np.ndarray) -> np.ndarray:
    """A vector of length one, zero for zero; its numbers may be the largest or the least there are."""
    size = np.abs(x).max()
    return x if size == 0 else x / size / np.linalg.norm(x / size)


def product(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion that turns as `b` and then as `a`."""
    if not is_traced((a, b)):
        return to_jax(_product_of_numbers(np.asarray(a), np.asarray(b)))
    real = a[0] * b[0] - jnp.dot(a[1:], b[1:])
    return jnp.concatenate([real[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def conjugate(e: Float[Array, "4"]) -> Float[Array, "4"]:
    """The rotation back."""
    return jnp.concatenate([e[:1], -e[1:]])


def rotation_matrix(e: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R(e), whose columns are the body's axes in space."""
    w, x, y, z = e
    return jnp.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _product_of_numbers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.append(a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))


# Coefficients of the bilinear forms below: what is many operations on single numbers is a product of arrays, for which
# XLA compiles far less, in derivatives above all.
# (a b)_k = PRODUCT_abk a_a b_b
PRODUCT = np.array([[_product_of_numbers(a, b) for b in np.eye(4)] for a in np.eye(4)])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
# R_ij = TURNED_jiab e_a e_b, from e r e*
TURNED = np.einsum("ajm,mbi,b->jiab", PRODUCT, PRODUCT, CONJUGATE)[1:, 1:]
SPIN_IN_BODY = 2 * np.einsum("abk,a->kab", PRODUCT, CONJUGATE)[1:]
SPIN_IN_SPACE = 2 * np.einsum("bak,a->kab", PRODUCT, CONJUGATE)[1:]


def turned(e: Float[Array, "4"], r: ArrayLike) -> Float[Array, "... 3"]:
    """R(e) r in space, for vectors r (..., 3) that are given along the body's axes."""
    of = numpy_of(r)
    return _bilinear(of.tensordot(of.asarray(r), TURNED, 1), e, e)


def spin_in_body(e: Float[Array, "4"], rate: Float[Array, "4"]) -> Float[Array, "3"]:
    """The angular velocity along the body's axes."""
    return _bilinear(SPIN_IN_BODY, e, rate)


def spin_in_space(e: Float[Array, "4"], rate: Float[Array, "4"]) -> Float[Array, "3"]:
    """The angular velocity along the axes of space."""
    return _bilinear(SPIN_IN_SPACE, e, rate)


def _bilinear(form: ArrayLike, a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "... 3"]:
    """`Σ form_ab a_a b_b` over the last two axes of a form, with all digits on an accelerator too."""
    # One product, of the form and all a_a b_b: its derivatives compile in two thirds of the time of two products.
    form = numpy_of(form).asarray(form, a.dtype)
    return jnp.dot(form.reshape(*form.shape[:-2], 16), (a[:, None] * b[None, :]).reshape(16), precision="highest")


def about(axis: ArrayLike, angle: ArrayLike) -> Float[Array, "4"]:
    """The rotation by an angle about an axis of any length."""
    xp, dtype = numpy_of((axis, angle)), jax.dtypes.canonicalize_dtype(float)
    axis, half = xp.asarray(axis, dtype), xp.asarray(angle, dtype) / 2
    with np.errstate(all="ignore"):
        found = xp.concatenate([xp.cos(half)[None], xp.sin(half) * axis / xp.sqrt(xp.sum(axis**2))])
    return to_jax(found)


def quaternion_of(turned: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The unit quaternion of a rotation matrix, of the two the one whose largest part is positive."""
    (a, b, c), (d, f, g), (h, i, j) = turned
    # The rows of 4 e eᵀ, of which that with the largest diagonal entry is divided by the root of that.
    rows = [
        jnp.stack([1 + a + f + j, i - g, c - h, d - b]),
        jnp.stack([i - g, 1 + a - f - j, b + d, c + h]),
        jnp.stack([c - h, b + d, 1 - a + f - j, g + i]),
        jnp.stack([d - b, c + h, g + i, 1 - a - f + j]),
    ]
    best, largest = rows[0], rows[0][0]
    for k in (1, 2, 3):
        is_larger = _is_larger(rows[k][k], largest)
        best, largest = (jnp.where(is_larger, x, y) for x, y in ((rows[k], best), (rows[k][k], largest)))
    return best / (2 * jnp.sqrt(largest))


# By how much of their sum moments of inertia may miss the triangle inequality: those of thin plates reach it.
ROUNDED = 1e-9


class Pose(NamedTuple):
    """Where a body is: its centre of mass, and the unit quaternion (w, x, y, z) that turns its axes into space's.

    >>> pose = Pose.at((0.0, 0.0, 1.0), axis=(1.0, 0.0, 0.0), angle=jnp.pi)
    >>> print(pose.quaternion.round(6))
    [0. 1. 0. 0.]

    In `v`, the same fields hold their rates; `moving` gives them for a velocity and an angular velocity.
    """

    position: Float[Array, "3"]
    quaternion: Float[Array, "4"]

    @classmethod
    def at(cls, position: ArrayLike = (0.0, 0.0, 0.0), axis: ArrayLike = (0.0, 0.0, 1.0), angle: ArrayLike = 0.0):
        """The pose at a position, turned by an angle about an axis through it, of any length, both in space.

        **Raises:** `ValueError` unless both are three numbers, and for an axis that is zero.
        """
        along = _three("the axis of a pose", axis)
        well = is_traced(along) or 0 < np.max(np.abs(np.asarray(along))) < np.inf
        must(well, "the axis of a pose must be finite and not zero", along, "axis=(0.0, 0.0, 1.0), of any length")
        return cls(_three("the position of a pose", position), about(along, angle))

    def turned(self, axis: ArrayLike, angle: ArrayLike) -> "Pose":
        """The pose after a further turn about an axis of space through the centre of mass."""
        return Pose(self.position, product(about(axis, angle).astype(floats(self)), self.quaternion))

    def moving(self, velocity: ArrayLike = (0.0, 0.0, 0.0), spin: ArrayLike = (0.0, 0.0, 0.0)) -> "Pose":
        """The rates, for `v`, of a body here, by its centre's velocity and its angular velocity in space."""
        dtype = floats(self)
        velocity = _three("the velocity of a pose", velocity).astype(dtype)
        spin = jnp.concatenate([jnp.zeros(1, dtype), _three("the spin of a pose", spin).astype(dtype)])
        return Pose(velocity, product(spin, self.quaternion) / 2)

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """R, whose columns are the body's axes in space."""
        return rotation_matrix(self.quaternion)

    def spin(self, rates: Any) -> Float[Array, "3"]:
        """The angular velocity along the axes of space, of a body here with these rates."""
        return spin_in_space(self.quaternion, rates.quaternion)

    def spin_in_body(self, rates: Any) -> Float[Array, "3"]:
        """The angular velocity along the body's axes."""
        return spin_in_body(self.quaternion, rates.quaternion)

    def directed(self, r: ArrayLike) -> Float[Array, "... 3"]:
        """Vectors (..., 3) in space that are fixed in the body."""
        return turned(self.quaternion, r)

    def velocity(self, rates: Any, r: Array) -> Float[Array, "3"]:
        """The velocity of a point of the body."""
        return rates.position + jnp.cross(self.spin(rates), self.directed(r))


class PoseOnTree(NamedTuple):
    """A pose with its rotation matrix, from which the bodies of a `lj.bodies.Tree` take points and velocities.

    As rates it holds those of all three. What is read of it is short: places of bodies of a tree are functions of all
    joints on the way there, of which two derivatives are taken in a contact.

    >>> pose = PoseOnTree(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(3))
    >>> about_z = jnp.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    >>> turning = PoseOnTree(jnp.zeros(3), jnp.zeros(4), about_z)
    >>> print(pose.spin(turning), pose.velocity(turning, jnp.array([1.0, 0.0, 0.0])))
    [0. 0. 2.] [0. 2. 0.]
    """

    position: Float[Array, "3"]
    quaternion: Float[Array, "4"]
    matrix: Float[Array, "3 3"]

    def spin(self, rates: "PoseOnTree") -> Float[Array, "3"]:
        """The angular velocity along the axes of space: Ṙ Rᵀ is Ω×."""
        return _turning(self.matrix @ rates.matrix.T)

    def spin_in_body(self, rates: "PoseOnTree") -> Float[Array, "3"]:
        """The angular velocity along the body's axes: Rᵀ Ṙ is Ω×."""
        return _turning(rates.matrix.T @ self.matrix)

    def directed(self, r: ArrayLike) -> Float[Array, "... 3"]:
        """Vectors (..., 3) in space that are fixed in the body."""
        return jnp.asarray(r, self.matrix.dtype) @ self.matrix.T

    def velocity(self, rates: "PoseOnTree", r: Array) -> Float[Array, "3"]:
        """The velocity of a point of the body."""
        return rates.position + rates.matrix @ r


def _turning(crossed: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Ω of (Ω×)ᵀ."""
    return jnp.stack([crossed[1, 2] - crossed[2, 1], crossed[2, 0] - crossed[0, 2], crossed[0, 1] - crossed[1, 0]]) / 2


def floats(q: PyTree) -> Any:
    """The dtype of the numbers in q; JAX's usual one for whole numbers and where there are none."""
    return jnp.result_type(1.0, *jax.tree.leaves(q))


def valued(x: ArrayLike | Callable, params: PyTree) -> Any:
    """A quantity that was given as numbers or as a function of params."""
    return x(params) if callable(x) else x


def check_takes_params(role: str, owner: str, given):
    """Raise a `TypeError`, where a function is given, unless it takes params alone."""
    if callable(given):
        check_arguments(
            Call(role, given, ("params",), f" of {owner}"), "a function of the state, as a force may be one"
        )


def check_quantity(role: str, owner: str, given, shape: tuple[int, ...] = (), above_zero: bool = False):
    """Raise unless a quantity is finite numbers of a shape, above zero if so asked, or a function of params."""
    check_takes_params(role, owner, given)
    if callable(given) or is_traced(given):
        return
    numbers = np.asarray(given)
    well = numbers.shape == shape and np.issubdtype(numbers.dtype, np.number) and np.all(np.isfinite(numbers))
    wanted = ("a finite number" if shape == () else f"{shape[0]} finite numbers") + " above zero" * above_zero
    cause = "a number that was computed before, and is NaN or has another sign"
    holds = well and (not above_zero or np.all(numbers > 0))
    must(holds, f"{role} of {owner} must be {wanted}", given, "numbers, or a function of params", cause)


def check_takes_state(role: str, owner: str, given):
    """Raise a `TypeError`, where a function is given, unless it takes (t, q, v, params)."""
    if callable(given):
        check_arguments(Call(role, given, OF_STATE, f" of {owner}"), "a function of params alone, as a mass may be one")


@dataclass(frozen=True)
class Body:
    """A rigid body in space, whose coordinates are `q[name]`, a `lj.bodies.Pose`.

    >>> import lagjax as lj
    >>> top = lj.bodies.Body("top", mass=2.0, inertia=(1.0, 1.0, 0.5))
    >>> pose = lj.bodies.Pose.at((0.0, 0.0, 3.0))
    >>> q, v = {"top": pose}, {"top": pose.moving(velocity=(1.0, 0.0, 0.0), spin=(0.0, 0.0, 2.0))}
    >>> print(top.kinetic(q, v), top.point(q, (0.0, 1.0, 0.0)))
    2.0 [0. 1. 3.]

    **Arguments:** `name`, its entry in q; `mass`; `inertia` about the centre of mass, `[mass] [length]²`: the three
    principal moments, if the body's axes are the principal ones, or the symmetric (3, 3) matrix. Both may be functions
    of params.

    Where all of them are zero it is a frame, as between two joints of a `lj.bodies.Tree`. `motion`, a function of (t,
    params) that returns a `lj.bodies.Pose`, is for a body that moves as given, a turning table: it has no entry in q,
    nor mass and inertia, and bodies are joined to it as to any other; in a `lj.bodies.Tree` it is one from which others
    hang.

    >>> table = lj.bodies.Body("table", motion=lambda t, params: lj.bodies.Pose.at(angle=params["rate"] * t))

    **Raises:** `ValueError` for a mass or an inertia that no body has: each principal moment is at most the sum of the
    two others; `TypeError` for numbers that JAX is tracing, which belong into params.

    Source: Goldstein, *Classical Mechanics*, §5.3.
    """

    name: str
    mass: float | Callable = 0.0
    inertia: tuple | Callable = (0.0, 0.0, 0.0)
    motion: Callable[[Any, Any], Pose] | None = None

    def __post_init__(self):
        check_takes_params("mass", f"'{self.name}'", self.mass)
        check_takes_params("inertia", f"'{self.name}'", self.inertia)
        _check_not_traced(f"mass and inertia of '{self.name}'", "mass", self.mass, self.inertia)
        if not callable(self.inertia):
            given = np.asarray(self.inertia, float)
            _check_inertia(self.name, given)
            object.__setattr__(self, "inertia", tuple(tuple(x) if np.ndim(x) else x for x in given.tolist()))
        massless = not callable(self.inertia) and not np.any(self.inertia)
        if self.motion is not None:
            check_arguments(
                Call("motion", self.motion, ("t", "params"), f" of '{self.name}'"),
                "an argument left out that is not needed",
            )
        well = callable(self.mass) or _is_mass(self.mass, massless)
        fix = "its mass; of a frame in a lj.bodies.Tree, mass=0.0 and inertia=(0.0, 0.0, 0.0)"
        must(well, f"the mass of '{self.name}' must be a positive number", self.mass, fix)

    @property
    def unit(self) -> Holonomic:
        """The constraint |e|² = 1 of its quaternion, which `lj.bodies.multibody` puts into the system."""
        return Holonomic(UnitQuaternion(self))

    @property
    def anchor(self) -> Anchor:
        """Its centre of mass and axes, to which shapes hold on."""
        return Anchor(self.name, (0.0, 0.0, 0.0))

    def pose(self, q: PyTree) -> Pose:
        """Where it is."""
        return self._entry(q)

    def rates(self, v: PyTree) -> Pose:
        """The rates of its pose."""
        return self._entry(v)

    def point(self, q: PyTree, r: ArrayLike) -> Float[Array, "3"]:
        """Where a point of the body is in space, given from the centre of mass along the body's axes."""
        return self.pose(q).position + self.direction(q, r)

    def direction(self, q: PyTree, r: ArrayLike) -> Float[Array, "3"]:
        """A vector in space that is fixed in the body."""
        return self.pose(q).directed(r)

    def directions(self, q: PyTree, rows: ArrayLike) -> Float[Array, "k 3"]:
        """Vectors in space that are fixed in the body, each a row."""
        return self.pose(q).directed(rows)

    def velocity(self, q: PyTree, v: PyTree, r: ArrayLike = (0.0, 0.0, 0.0)) -> Float[Array, "3"]:
        """The velocity in space of a point of the body."""
        pose = self.pose(q)
        return pose.velocity(self.rates(v), jnp.asarray(r, pose.quaternion.dtype))

    def spin(self, q: PyTree, v: PyTree) -> Float[Array, "3"]:
        """The angular velocity along the axes of space, `1/[t]`."""
        return self.pose(q).spin(self.rates(v))

    def spin_in_body(self, q: PyTree, v: PyTree) -> Float[Array, "3"]:
        """The angular velocity along the body's axes, `1/[t]`."""
        return self.pose(q).spin_in_body(self.rates(v))

    def angular_momentum(self, q: PyTree, v: PyTree, params: PyTree = None) -> Float[Array, "3"]:
        """The angular momentum about the centre of mass, in space."""
        spin = self.spin_in_body(q, v)
        return self.direction(q, self._inertia(params, spin.dtype) @ spin)

    def kinetic(self, q: PyTree, v: PyTree, params: PyTree = None) -> Float[Array, ""]:
        """The kinetic energy; `params` where mass or inertia are functions of them."""
        return kinetic_energy(*self.given(params, floats(q)), self.pose(q), self.rates(v))

    def given(self, params: PyTree, dtype) -> tuple[Any, Float[Array, "3 3"]]:
        """Mass and inertia by the values of the parameters."""
        return valued(self.mass, params), self._inertia(params, dtype)

    def at(self, point: ArrayLike | Callable = (0.0, 0.0, 0.0), axis: ArrayLike = (0.0, 0.0, 1.0)) -> "Marker":
        """A place on the body for joints and springs: see `lj.bodies.Marker`."""
        return Marker.on(self, point, axis)

    def _entry(self, q: PyTree) -> Pose:
        entry: Any = None
        if isinstance(q, Mapping) and self.name not in q:
            given = f"missing beside {', '.join(map(repr, q)) or 'nothing'}"
            if self.motion is not None:
                raise TypeError(
                    f"'{self.name}' moves as given, and has no entry in q and v.\n"
                    f"Fix: its pose is {self.name}.motion(t, params), which joints and loads know, and functions of q "
                    "alone do not."
                )
        else:
            entry = q[self.name]
            is_array = isinstance(entry, jax.Array | np.ndarray)
            given = f"an array of shape {entry.shape}" if is_array else type(entry).__name__
        if not hasattr(entry, "quaternion"):
            raise TypeError(
                f"the entry '{self.name}' of q and v must be a lj.bodies.Pose, and is {given}.\n"
                f"Fix: q0 = {{'{self.name}': pose}}, v0 = {{'{self.name}': pose.moving(velocity, spin)}}, with "
                "pose = lj.bodies.Pose.at(position, axis, angle)."
            )
        return entry

    def _inertia(self, params: PyTree, dtype) -> Float[Array, "3 3"]:
        given = valued(self.inertia, params)
        of: Any = numpy_of(given)
        inertia = of.asarray(given, dtype)
        return of.diag(inertia) if inertia.ndim == 1 else inertia


class SystemFunction:
    """A function of a system that is an object and no closure, so that it can be pickled.

    As a function is, it is equal to itself alone, and its own copy.

    >>> import copy
    >>> halved = SystemFunction()
    >>> copy.deepcopy(halved) == halved
    True
    """

    def __deepcopy__(self, memo: dict) -> "SystemFunction":
        return self


@dataclass(frozen=True, eq=False)
class UnitQuaternion(SystemFunction):
    """(|e|² - 1)/2 of a body's quaternion, as a function of (t, q, params).

    >>> UnitQuaternion(Body("bob", 1.0, (1.0, 1.0, 1.0)))(0.0, {"bob": Pose.at()}, None).tolist()
    0.0
    """

    body: Body

    def __call__(self, t, q: PyTree, params: PyTree) -> Float[Array, ""]:
        return (jnp.sum(self.body.pose(q).quaternion ** 2) - 1) / 2

    def restored(self, q: PyTree) -> PyTree:
        """How `lj.consistent_state` looks for a state if none was found otherwise."""
        pose = self.body.pose(q)
        unit = pose._replace(quaternion=pose.quaternion / jnp.sqrt(jnp.sum(pose.quaternion**2)))
        return {**q, self.body.name: unit}


def together(poses: Sequence[Pose]) -> Pose:
    """Poses of several bodies along a new first axis; `jnp.stack` has an operation for each."""
    return Pose(*(jnp.concatenate(x).reshape(len(poses), -1) for x in zip(*poses)))


def kinetic_energy(mass: Float[Array, ""], inertia: Float[Array, "3 3"], pose: Pose, rates: Pose) -> Float[Array, ""]:
    """The kinetic energy of one body."""
    spin = pose.spin_in_body(rates)
    growth = 2 * jnp.dot(pose.quaternion, rates.quaternion)
    of_rotation = jnp.dot(spin, inertia @ spin) + jnp.trace(inertia) / 3 * growth**2
    return (mass * jnp.sum(rates.position**2) + of_rotation) / 2


@dataclass(frozen=True)
class Ground:
    """What does not move: joints, springs and wheels hold on to it as to a body.

    `lj.bodies.ground` is the one there is.

    >>> print(Ground().at((1.0, 0.0, 0.0)).position({}))
    [1. 0. 0.]
    """

    name: str = "ground"

    @property
    def anchor(self) -> Anchor:
        """The origin and the axes of space, to which shapes hold on."""
        return Anchor(None, (0.0, 0.0, 0.0))

    def pose(self, q: PyTree) -> Pose:
        """The origin."""
        return Pose(jnp.zeros(3, floats(q)), jnp.array([1.0, 0.0, 0.0, 0.0], floats(q)))

    def rates(self, v: PyTree) -> Pose:
        """Zero."""
        return Pose(jnp.zeros(3, floats(v)), jnp.zeros(4, floats(v)))

    def point(self, q: PyTree, r: ArrayLike) -> Float[Array, "3"]:
        """The point itself."""
        return jnp.asarray(r, floats(q))

    def direction(self, q: PyTree, r: ArrayLike) -> Float[Array, "3"]:
        """The vector itself."""
        return jnp.asarray(r, floats(q))

    def directions(self, q: PyTree, rows: ArrayLike) -> Float[Array, "k 3"]:
        """The rows themselves."""
        return jnp.asarray(rows, floats(q))

    def velocity(self, q: PyTree, v: PyTree, r: ArrayLike = (0.0, 0.0, 0.0)) -> Float[Array, "3"]:
        """Zero."""
        return jnp.zeros(3, floats(q))

    def spin(self, q: PyTree, v: PyTree) -> Float[Array, "3"]:
        """Zero."""
        return jnp.zeros(3, floats(q))

    def at(self, point: ArrayLike | Callable = (0.0, 0.0, 0.0), axis: ArrayLike = (0.0, 0.0, 1.0)) -> "Marker":
        """A place in space: see `lj.bodies.Marker`."""
        return Marker.on(self, point, axis)


ground = Ground()


@dataclass(frozen=True)
class Marker:
    """A place on a body, with an axis: what joints join and springs pull. `body.at(point, axis)` makes one.

    `point` is given from the centre of mass along the body's axes (for `lj.bodies.ground`, in space), and may be a
    function of params; `frame` holds three unit vectors of the body, at right angles, of which the last is the axis.
    The first is the nearest to the body's first coordinate axis, or to its second where the axis lies along the first.

    >>> import lagjax as lj
    >>> rod = lj.bodies.Body("rod", 1.0, (1.0, 1.0, 0.1))
    >>> end, q = rod.at((0.0, 0.0, 0.5)), {"rod": lj.bodies.Pose.at((2.0, 0.0, 0.0), (1.0, 0.0, 0.0), jnp.pi)}
    >>> print(end.position(q).round(6), end.axis(q).round(6))
    [ 2.  -0.  -0.5] [ 0. -0. -1.]
    """

    body: Body | Ground
    place: tuple[float, float, float] | Callable
    frame: tuple[tuple[float, float, float], ...]

    @classmethod
    def on(cls, body: Body | Ground, point: ArrayLike | Callable, axis: ArrayLike) -> "Marker":
        """A marker on a body."""
        _check_not_traced(f"place and axis of a marker on '{body.name}'", "point", point, axis)
        along = np.asarray(axis, float)
        well = along.shape == (3,) and 0 < np.max(np.abs(along)) < np.inf
        must(well, f"the axis of a marker on '{body.name}' must be three numbers that are not all zero", axis)
        along = unit_vector(along)
        near = np.eye(3)[1 if abs(along[0]) > 0.9 else 0]
        first = unit_vector(near - (near @ along) * along)
        rows = np.stack([first, np.cross(along, first), along])
        check_takes_params("a point", f"'{body.name}'", point)
        place = point if callable(point) else tuple(np.ravel(np.asarray(point, float)).tolist())
        if not callable(place) and (np.shape(place) != (3,) or not np.all(np.isfinite(place))):
            raise ValueError(f"a point of '{body.name}' must be three numbers, not {point}.")
        return cls(body, place, tuple(map(tuple, rows.tolist())))

    @property
    def anchor(self) -> Anchor:
        """The place and its axes, to which shapes hold on."""
        return Anchor(self.body.anchor.body, self.place, self.frame)

    def position(self, q: PyTree, params: PyTree = None) -> Float[Array, "3"]:
        """Where it is in space."""
        return self.body.point(q, valued(self.place, params))

    def velocity(self, q: PyTree, v: PyTree, params: PyTree = None) -> Float[Array, "3"]:
        """Its velocity in space."""
        return self.body.velocity(q, v, valued(self.place, params))

    def axes(self, q: PyTree) -> Float[Array, "3 3"]:
        """Its three unit vectors in space, as rows; the last one is the axis."""
        return self.body.directions(q, self.frame)

    def axis(self, q: PyTree) -> Float[Array, "3"]:
        """Its axis in space."""
        return self.body.direction(q, self.frame[2])


def check_markers(what: str, *given):
    """Raise a `TypeError` that begins with `what`, unless all are markers."""
    for x in given:
        fix = "lj.bodies.spherical(crank.at((0.5, 0.0, 0.0)), rod.at((-1.0, 0.0, 0.0)))"
        must_be(Marker, x, f"{what}: a lj.bodies.Marker", fix)


def check_bodies(what: str, given: Iterable[Body]) -> tuple[Body, ...]:
    """The bodies as a tuple; a `TypeError` that begins with `what`, unless they are a list of some."""
    bodies = tuple(given) if isinstance(given, Iterable) else ()
    if not bodies and isinstance(given, Iterable):
        raise ValueError(
            f"{what} was given no bodies.\n"
            "Usual cause: a generator that was used up before, or a filter that nothing passes.\n"
            f"Fix: {what}([crank, rod]); of a motion without bodies, lj.System with L by hand."
        )
    if not all(isinstance(body, Body) for body in bodies) or not bodies:
        listed = ", ".join(type(body).__name__ for body in bodies) or type(given).__name__
        raise TypeError(f"{what} takes a list of lj.bodies.Body, and was given {listed}.\nFix: {what}([crank, rod]).")
    return bodies


def _three(what: str, given: ArrayLike) -> Float[Array, "3"]:
    """A vector; a `ValueError` that begins with `what`, unless it has three numbers."""
    found = numpy_of(given).asarray(given, jax.dtypes.canonicalize_dtype(float))
    fix, cause = "all of them, (0.0, 0.0, 1.0)", "a plane, or one number about an axis"
    must(found.shape == (3,), f"{what} must be three numbers", given, fix, cause)
    return to_jax(found)


def _check_not_traced(what: str, role: str, *given: Any):
    fix = f"{role}=lambda params: params['{role}'], with the value among the parameters"
    cause = "a body made inside of jit, vmap or grad, compiled again for each value"
    must_have_values(given, f"{what} must be numbers", fix, cause)


def _is_mass(given: Any, massless: bool) -> bool:
    number = np.ndim(given) == 0 and np.issubdtype(np.asarray(given).dtype, np.number)
    return bool(number and np.isfinite(given) and (given > 0 or massless and given == 0))


def _check_inertia(name: str, given: np.ndarray):
    is_symmetric = given.ndim == 1 or given.shape == (3, 3) and np.allclose(given, given.T)
    well = given.shape in ((3,), (3, 3)) and is_symmetric and np.all(np.isfinite(given))
    must(well, f"the inertia of '{name}' must be three principal moments or a symmetric matrix (3, 3)", given)
    # Sums of the largest numbers overflow, those of shares of them do not.
    size = np.abs(given).max() or 1.0
    moments = np.sort(given / size if given.ndim == 1 else np.linalg.eigvalsh(given / size))
    if moments[0] < 0 or moments[2] > (moments[0] + moments[1]) * (1 + ROUNDED):
        listed = ", ".join(f"{x:.6g}" for x in moments * size)
        raise ValueError(
            f"no body has the moments of inertia of '{name}', {listed}: each is at most the sum of the two others.\n"
            "Usual cause: moments about a point that is not the centre of mass, or products of inertia with the wrong "
            "sign.\n"
            "Fix: inertia=(I_1, I_2, I_3) about the centre of mass."
        )


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
    fix = f'lj.bodies.Body("{body.name}", motion=lambda t, params: lj.bodies.Pose.at(angle=params["rate"] * t))'
    must_be(Pose, pose, f"the motion of '{body.name}' must return a lj.bodies.Pose", fix)
    position, e = (jnp.asarray(x, dtype) for x in cast(Pose, pose))
    return Pose(position, e / jnp.sqrt(jnp.sum(e**2)))
