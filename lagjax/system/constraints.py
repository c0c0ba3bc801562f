"""Constraints at three levels: position, velocity, acceleration; and elements, contacts and dry friction.

A holonomic constraint `g(t, q) = 0` is differentiated twice, a velocity constraint `phi(t, q, v) = 0`
once (index reduction); both end as a linear equation for the acceleration,

    A a = gamma,        holonomic:    A = ∂g/∂q,    gamma = -(d/dt)² g with a = 0
                        velocity:     A = ∂phi/∂v,  gamma = -∂phi/∂t - (∂phi/∂q) v

and the force that keeps it is `Aᵀ λ` (for a velocity constraint, Chetaev's rule). Total derivatives along
the motion are Jacobian-vector products along `(1, v)`; no second-derivative array is ever formed.

Source: Goldstein, *Classical Mechanics*, §1.3 and §2.4; Hairer & Wanner, *Solving ODEs II*, §VII.1.

Contacts and dry friction are elements, which a person writes down in a line each:

    Contact             a gap that may close: impact, rest, sliding, letting go
    CompliantContact    a spring and a damper behind a gap, which push and do not pull
    Friction            Coulomb's friction on a sliding velocity
    Stop                a contact at each end of the way of a coordinate
    SampledControl      a controller that acts at instants and holds its output between them

A `System` with elements moves in modes: each gap is open or closed, and each sliding velocity slides to one side,
or sticks, or is free since its gap is open or it rests without friction. `integrate` finds the modes that fit the state
and changes them.

Source: Glocker, *Set-Valued Force Laws*, §5, §6; Brogliato, *Nonsmooth Mechanics*, §4, §5.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.refusals import (
    must,
    must_be,
    must_be_among,
    must_be_finite,
    must_be_function,
    must_be_whole,
    must_go_together,
)
from lagjax.system.traced import OF_POSITION, OF_STATE, vectors


class Holonomic(eqx.Module):
    """Constrain positions: `g(t, q, params) = 0`.

    >>> import jax.numpy as jnp
    >>> Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)
    Holonomic(<lambda>)

    **Arguments:** `g(t, q, params)` -> scalar or (m,), smooth, with ∂g/∂q of full rank where it vanishes.
    Its multiplier λ has the shape of `g` and `[energy]/[g]`; λ > 0 pushes along +∂g/∂q.

    **Raises:** `TypeError` if `g` is not a function.
    """

    g: Callable
    kind: ClassVar[str] = "holonomic"
    role: ClassVar[str] = "g"
    takes: ClassVar[tuple[str, ...]] = OF_POSITION
    of_positions: ClassVar[bool] = True

    def __check_init__(self):
        must_be_function(self.g, "g of lj.Holonomic(g)", "(t, q, params)", "lj.Holonomic(g), with def g(t, q, params)")

    @property
    def function(self) -> Callable:
        return self.g

    def residual(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        """`g` at a state, as the user wrote it."""
        return self.g(t, q, params)

    def __repr__(self):
        return f"Holonomic({getattr(self.g, '__name__', 'g')})"


class Nonholonomic(eqx.Module):
    """Constrain velocities: `phi(t, q, v, params) = 0`, linear in v or not, integrable or not.

    >>> Nonholonomic(lambda t, q, v, params: v["x"] - params["radius"] * v["angle"])
    Nonholonomic(<lambda>)

    **Arguments:** `phi(t, q, v, params)` -> scalar or (m,), smooth, with ∂phi/∂v of full rank where it
    vanishes. Its multiplier μ has the shape of `phi` and `[energy]/([phi] [t])`; the force is `(∂phi/∂v)ᵀ μ`.

    **Raises:** `TypeError` if `phi` is not a function.
    """

    phi: Callable
    kind: ClassVar[str] = "velocity"
    role: ClassVar[str] = "phi"
    takes: ClassVar[tuple[str, ...]] = OF_STATE
    of_positions: ClassVar[bool] = False

    def __check_init__(self):
        fix = "lj.Nonholonomic(phi), with def phi(t, q, v, params)"
        must_be_function(self.phi, "phi of lj.Nonholonomic(phi)", "(t, q, v, params)", fix)

    @property
    def function(self) -> Callable:
        return self.phi

    def residual(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        """`phi` at a state, as the user wrote it."""
        return self.phi(t, q, v, params)

    def __repr__(self):
        return f"Nonholonomic({getattr(self.phi, '__name__', 'phi')})"


class ConstraintRows(NamedTuple):
    """All constraints of a system at one state, stacked: the linear equation `A a = gamma`."""

    jacobian: Float[Array, "m n"]
    gamma: Float[Array, " m"]


def position_residual(model, t: Array, x: Array) -> Float[Array, " mh"]:
    """`g(t, q)` of the holonomic constraints, stacked."""
    return _stack(_positions(model, t, x), x.dtype)


def velocity_residual(model, t: Array, x: Array, u: Array) -> Float[Array, " m"]:
    """`dg/dt` or `phi(t, q, v)` of each constraint, stacked in the order of their names."""
    return _stack(_velocities(model, t, x, u), x.dtype)


def residuals(model, t: Array, x: Array, u: Array) -> Float[Array, "2 m"]:
    """What each constraint asks to vanish of positions, `g` or nothing, and of velocities, `dg/dt` or `phi`."""
    if not model.m:
        return jnp.zeros((2, 0), x.dtype)
    position, velocities = iter(_positions(model, t, x)), _velocities(model, t, x, u)
    given = zip(model.system.constraints.values(), velocities)
    positions = [next(position) if c.of_positions else jnp.zeros_like(velocity) for c, velocity in given]
    return jnp.stack([_stack(positions, x.dtype), _stack(velocities, x.dtype)])


def jacobian(model, t: Array, x: Array, u: Array) -> Float[Array, "m n"]:
    """`A` of all constraints."""
    return jax.jacfwd(lambda u: velocity_residual(model, t, x, u))(u)


def acceleration_rows(model, t: Array, x: Array, u: Array) -> ConstraintRows:
    """`A` and `gamma` of all constraints."""
    _, rate = jax.jvp(lambda t, x: velocity_residual(model, t, x, u), (t, x), (jnp.ones_like(t), u))
    return ConstraintRows(jacobian(model, t, x, u), -rate)


def baumgarte_feedback(model, t: Array, x: Array, u: Array, rate: Array):
    """Baumgarte's term in gamma, with which g'' + 2 rate g' + rate² g = 0, or phi' + rate phi = 0.

    Source: Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1.
    """
    position, terms = iter(_positions(model, t, x)), []
    for c, velocity in zip(model.system.constraints.values(), _velocities(model, t, x, u)):
        of_position = -2 * rate * velocity - rate**2 * next(position) if c.of_positions else -rate * velocity
        terms.append(of_position)
    return _stack(terms, x.dtype)


def _positions(model, t: Array, x: Array) -> list[Float[Array, " k"]]:
    """`g(t, q)` of each holonomic constraint."""
    holonomic = [c.g for c in model.system.constraints.values() if c.of_positions]
    return vectors(holonomic, (t, model.tree(x), model.params))


def _velocities(model, t: Array, x: Array, u: Array) -> list[Float[Array, " k"]]:
    """`dg/dt` or `phi(t, q, v)` of each constraint."""
    given = list(model.system.constraints.values())
    of_positions = of_velocities = iter(())
    if any(c.of_positions for c in given):
        _, rates = jax.jvp(lambda t, x: _positions(model, t, x), (t, x), (jnp.ones_like(t), u))
        of_positions = iter(rates)
    if not all(c.of_positions for c in given):
        phis = [c.phi for c in given if not c.of_positions]
        of_velocities = iter(vectors(phis, (t, model.tree(x), model.tree(u), model.params)))
    return [next(of_positions if c.of_positions else of_velocities) for c in given]


def _stack(parts: Sequence, dtype: DTypeLike):
    if not parts:
        return jnp.zeros((0,), dtype)
    return jnp.concatenate([part.astype(dtype) for part in parts])


MOST_SWITCHES = 256
IMPACTS = ("sequential", "simultaneous")


class Friction(eqx.Module):
    """Coulomb's friction: a force against the sliding velocity, of size μ N; while nothing slides, whatever holds it.

    >>> import lagjax as lj
    >>> spring = lambda t, q, v, params: 0.5 * v**2 - 50.0 * q**2
    >>> lj.System(spring, elements={"floor": Friction(lambda t, q, v, params: v, 0.3, normal=9.81)})
    System(<lambda>; elements: floor (Friction))

    **Arguments:**

    - `sliding`: `sliding(t, q, v, params)`, the sliding velocity s, linear in v, of the shape of its normal force: a
      number, or (k,) for k lines with k normal forces. With (2,) behind that shape it is a velocity in a plane, where
      the force is -μ N s/|s|: (2,) with one normal force, (k, 2) with k of them. The force acts along `∂sliding/∂v`.
    - `coefficient`: μ of sliding: a number, a function of `params`, or `mu(speed, params)` (Stribeck's law), with the
      speed |s|.
    - `normal`: the normal force N: a number, a function of (t, q, v, params), or the name of a constraint whose
      multiplier it is, or of a contact among the elements.
    - `static`: μ of sticking, a number or a function of `params`; by default `coefficient`, at speed zero.

    A multiplier presses from both sides, as the wire of a bead does: the force is μ |λ|. A function is a normal force
    from one side, and where it falls below zero the motion ends.

    **Raises:** `TypeError` for a sliding velocity that is no function, or another kind of normal force; `ValueError`
    for a sliding velocity of another shape, and for numbers below zero, and NaN, also from params, by `lj.integrate`;
    `RuntimeError`, by `lj.integrate`, for a normal force from a function that falls below zero.

    Sliding in a plane ends at 3e-8 of the velocities in the motion (1e-4 in float32), where s/|s| is lost in round-off:
    its time is early by as much of them over μ N, and the place of rest by the square.

    Source: Glocker, *Set-Valued Force Laws*, §5.3.
    """

    sliding: Callable
    coefficient: Callable | ArrayLike
    normal: Callable | ArrayLike | str
    static: Callable | ArrayLike | None

    def __init__(
        self,
        sliding: Callable,
        coefficient: Callable | ArrayLike,
        normal: Callable | ArrayLike | str,
        static: Callable | ArrayLike | None = None,
    ):
        must_be_function(sliding, "sliding", "(t, q, v, params)", 'sliding=lambda t, q, v, params: v["x"]')
        for role, number in (("coefficient", coefficient), ("static", static), ("normal", normal)):
            if not isinstance(number, str):
                _check_not_negative(role, number)
        self.sliding, self.coefficient, self.static = sliding, _number(coefficient), _number(static)
        self.normal = normal if isinstance(normal, str) else _number(normal)

    def __repr__(self):
        return "Friction()"


class Contact(eqx.Module):
    """A gap that may close: an impact; then rest, rolling or sliding; and letting go.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lambda t, q, v, params: 0.5 * v**2 - params["g"] * q
    >>> ball = lj.System(fall, elements={"floor": Contact(lambda t, q, params: q, restitution=0.5)})
    >>> traj = lj.integrate(ball, 5.0, 0.0, {"g": 10.0}, ts=jnp.array([0.0, 1.5, 4.0]))
    >>> print(abs(traj.q.round(9)), traj.switches.t[:2].round(9))
    [5.   1.25 0.  ] [1. 2.]

    **Arguments:**

    - `gap`: `gap(t, q, params)`, above zero as long as nothing touches, a length where there is friction: a number,
      or (k,) for k gaps, such as those of a row of balls. The constraint `gap = 0` has the element's name, and its
      multiplier is the normal force.
    - `restitution`: the speed at which a gap opens after an impact over that at which it closed, 0 to 1: a number, a
      function of `params`, or `e(speed, params)` of the closing speed.
    - `friction`, `static`: Coulomb's coefficients of sliding and of sticking, as for `lj.Friction`; the normal force
      is that of the contact. None: the contact is smooth.
    - `sliding`: `sliding(t, q, v, params)`, the sliding velocity, `[gap]/[t]`, of the shape of the gap: along a line;
      or of that shape with (2,) behind: in a plane, as for `lj.Friction`.
    - `slower_than`: a contact that opens more slowly than this after an impact stays closed, `[gap]/[t]`: this ends
      infinitely many impacts in finite time. The part of the motion left out is of the size of its square.

    **Raises:** `TypeError` for a gap or a sliding velocity that is no function; `ValueError` for a restitution that is
    not 0 to 1, friction below zero, and NaN, also from params, by `lj.integrate`; and for friction without a sliding
    velocity.

    Source: Glocker, *Set-Valued Force Laws*, §6 (Newton's law of impact).
    """

    gap: Callable
    restitution: Callable | ArrayLike
    friction: Callable | ArrayLike | None
    sliding: Callable | None
    static: Callable | ArrayLike | None
    slower_than: ArrayLike

    def __init__(
        self,
        gap: Callable,
        restitution: Callable | ArrayLike = 0.0,
        friction: Callable | ArrayLike | None = None,
        sliding: Callable | None = None,
        static: Callable | ArrayLike | None = None,
        slower_than: ArrayLike = 1e-6,
    ):
        must_be_function(gap, "gap", "(t, q, params)", 'gap=lambda t, q, params: q["y"]')
        _check_pair(friction, sliding)
        numbers = {"restitution": restitution, "friction": friction, "static": static, "slower_than": slower_than}
        for role, number in numbers.items():
            _check_not_negative(role, number)
        self.gap, self.restitution, self.sliding = gap, _number(restitution), sliding
        self.friction, self.static = _number(friction), _number(static)
        self.slower_than = _number(slower_than)

    def __repr__(self):
        return f"Contact({'smooth' if self.friction is None else 'with friction'})"


class Stop(Contact):
    """A coordinate, or anything else that depends on positions, that moves between two stops: a `Contact` with each.

    >>> play = Stop(lambda t, q, params: q, low=-1.0, high=1.0, restitution=0.5)
    >>> print(play.gap(0.0, 0.25, None))
    [1.25 0.75]

    **Arguments:** `coordinate(t, q, params)` -> a number; `low`, `high`: the smallest and the largest it may be, one
    of them or both; `restitution`, `slower_than` as in `lj.Contact`. Backlash is a stop of a difference of two
    coordinates.

    **Raises:** `ValueError` without any stop, and where low is above high.
    """

    def __init__(
        self,
        coordinate: Callable,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        restitution: Callable | ArrayLike = 0.0,
        slower_than: ArrayLike = 1e-6,
    ):
        must_be_function(coordinate, "coordinate", "(t, q, params)", 'coordinate=lambda t, q, params: q["x"]')
        if low is None and high is None:
            raise ValueError("a stop needs low, high, or both.\nFix: lj.Stop(coordinate, low=0.0, high=1.0).")
        if low is not None and high is not None and np.any(np.asarray(low) > np.asarray(high)):
            raise ValueError(f"low = {low} is above high = {high}.\nFix: exchange them.")
        super().__init__(StopGaps(coordinate, _number(low), _number(high)), restitution, slower_than=slower_than)


class StopGaps(eqx.Module):
    """How far a coordinate is from its stops: a gap (1,) or (2,)."""

    coordinate: Callable
    low: Any
    high: Any

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        x = self.coordinate(t, q, params)
        ends = [x - self.low] if self.low is not None else []
        return jnp.stack(ends + ([self.high - x] if self.high is not None else []))


class CompliantContact(eqx.Module):
    """A spring and a damper behind a gap: F = k d + c d' at the depth d = -gap, while both d and F are above zero.

    It pushes and does not pull: a damped contact lets go before its gap opens. Velocities do not jump.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> free = lambda t, q, v, params: 0.5 * v**2
    >>> ball = lj.System(free, elements={"mat": CompliantContact(lambda t, q, params: q, stiffness=100.0)})
    >>> traj = lj.integrate(ball, 1.0, -1.0, ts=jnp.array([0.0, 1.0 + jnp.pi / 20, 2.0]))
    >>> print(traj.q[1].round(9), traj.multipliers["mat"][1].round(9), traj.v[2].round(9))
    -0.1 10.0 1.0

    **Arguments:**

    - `gap`: `gap(t, q, params)`, above zero as long as nothing touches: a number, or (k,) for k gaps.
    - `stiffness`, `damping`: k > 0 and c ≥ 0, `[L]/[gap]²` and `[L] [t]/[gap]²`: numbers, functions of `params`, or
      functions of `(depth, params)`. Hertz's law is `lambda depth, params: params["k"] * depth**0.5`, and Hunt and
      Crossley's damping `lambda depth, params: params["c"] * depth**1.5`.
    - `friction`, `sliding`, `static`: as for `lj.Contact`, with F as the normal force.

    F is `traj.multipliers` of the element's name. A restitution is not given: it follows from k and c.

    **Raises:** `TypeError` for a gap or a sliding velocity that is no function; `ValueError` for a stiffness that is
    not above zero, a damping below zero, and for friction without a sliding velocity.

    Source: Schwager & Pöschel, Granular Matter 9 (2007) 465 (Eq. 8, the end of a damped contact); Hunt & Crossley, J.
    Appl. Mech. 42 (1975) 440.
    """

    gap: Callable
    stiffness: Callable | ArrayLike
    damping: Callable | ArrayLike
    friction: Callable | ArrayLike | None
    sliding: Callable | None
    static: Callable | ArrayLike | None

    def __init__(
        self,
        gap: Callable,
        stiffness: Callable | ArrayLike,
        damping: Callable | ArrayLike = 0.0,
        friction: Callable | ArrayLike | None = None,
        sliding: Callable | None = None,
        static: Callable | ArrayLike | None = None,
    ):
        must_be_function(gap, "gap", "(t, q, params)", 'gap=lambda t, q, params: q["y"]')
        _check_pair(friction, sliding)
        for role, number in (("damping", damping), ("friction", friction), ("static", static)):
            _check_not_negative(role, number)
        _check_above_zero("stiffness", stiffness, "a spring that pulls, or none: a rigid contact is lj.Contact(gap)")
        self.gap, self.sliding = gap, sliding
        self.stiffness, self.damping, self.friction, self.static = map(_number, (stiffness, damping, friction, static))

    def __repr__(self):
        return f"CompliantContact({'smooth' if self.friction is None else 'with friction'})"


class SampledControl(eqx.Module):
    """A controller that acts at instants and holds its output between them, as a state of the element's name.

    The state is read as `q[name]` in L, forces and elements, and is constant between instants; at the instants
    offset + k every, k = 0, 1, ..., it becomes `controller(t, q, v, params)`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> brake = SampledControl(lambda t, q, v, params: -v["x"], every=0.5)
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 + q["u"] * q["x"], elements={"u": brake})
    >>> traj = lj.integrate(cart, {"x": 0.0, "u": 0.0}, {"x": 1.0}, ts=jnp.array([0.0, 0.25, 0.5, 0.75]))
    >>> print(traj.q["u"].round(9), traj.v["x"].round(9))
    [-1.  -1.  -0.5 -0.5] [1.    0.75  0.5   0.375]

    **Arguments:**

    - `controller`: `controller(t, q, v, params)` -> like `q[name]`, whose entry in `q0` holds before the first instant.
      A controller with memory reads its own last output there. Controllers that act at one instant all read what was
      before it.
    - `every`, `offset`: the time between instants, and the first one, `[t]`: numbers, or functions of `params`. A start
      of the motion at an instant is one.

    At an output that is an instant, `traj.q[name]` is the new value; the end of the motion is none, so that it may be
    continued from there. An instant is a switch of the motion (`traj.switches`): `lj.Elements(most_switches=)` makes
    room for them, and `lj.integrate` for those that it can count, if `every`, `offset` and `ts` are numbers.

    **Raises:** `TypeError` for a controller that is no function; `ValueError` for `every` that is not above zero,
    also from params, by `lj.integrate`.

    Source: Åström & Wittenmark, *Computer-Controlled Systems*, §2.3 (zero-order hold).
    """

    controller: Callable
    every: Callable | ArrayLike
    offset: Callable | ArrayLike

    def __init__(self, controller: Callable, every: Callable | ArrayLike, offset: Callable | ArrayLike = 0.0):
        fix = 'controller=lambda t, q, v, params: -params["gain"] * v["x"]'
        must_be_function(controller, "controller", "(t, q, v, params)", fix)
        _check_above_zero("every", every, "a rate, 1 / every, in place of the time between two instants")
        if not callable(offset):
            must_be_finite(offset, "offset", "offset=0.0, the first instant")
        self.controller, self.every, self.offset = controller, _number(every), _number(offset)

    def __repr__(self):
        return "SampledControl()"


class Held(eqx.Module):
    """The rate of a held output: zero."""

    name: str = eqx.field(static=True)

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        return jnp.zeros_like(q[self.name])


Element = Contact | CompliantContact | Friction | SampledControl


class Elements(Mapping):
    """Elements by name, with how their impacts are solved; a dict of them is the same with the defaults.

    >>> import lagjax as lj
    >>> floor = lj.Contact(lambda t, q, params: q)
    >>> Elements({"floor": floor}, impacts="simultaneous")
    Elements(floor: Contact(smooth); impacts simultaneous)

    **Arguments:**

    - `elements`: by name, `Contact`, `CompliantContact`, `Friction`, `SampledControl`.
    - `impacts`: where several contacts are struck at once: "sequential", one after the other, always the one that
      closes fastest (Newton's cradle sends on as many balls as came); or "simultaneous", all at once by Newton's law
      (in the cradle all balls move on).
    - `most_switches`: the largest number of changes of modes in a motion; memory is reserved for so many.

    **Raises:** `TypeError` for what is no element; `ValueError` for other `impacts`.
    """

    def __init__(
        self,
        elements: Mapping[str, Element],
        impacts: str = "sequential",
        most_switches: int = MOST_SWITCHES,
    ):
        example = 'elements={"floor": lj.Contact(gap)}'
        must_be(Mapping, elements, "elements must be given by name", example)
        for name, element in elements.items():
            claim = f"element {name!r} must be a lj.Contact, lj.CompliantContact, lj.Friction or lj.SampledControl"
            must_be(Element, element, claim, example)
            must_be(str, name, "the name of an element must be text", example)
        must_be_among(IMPACTS, impacts, "impacts")
        must_be_whole(most_switches, "most_switches", fix="100")
        self.by_name = dict(sorted(elements.items()))
        self.impacts, self.most_switches = impacts, most_switches

    def __getitem__(self, name: str) -> Element:
        return self.by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.by_name)

    def __len__(self) -> int:
        return len(self.by_name)

    def __repr__(self):
        return f"Elements({', '.join(f'{k}: {x!r}' for k, x in self.items())}; impacts {self.impacts})"


def _flatten(elements: Elements):
    return tuple(elements.by_name.values()), (tuple(elements.by_name), elements.impacts, elements.most_switches)


def _unflatten(static: tuple, children: tuple) -> Elements:
    elements = object.__new__(Elements)
    names, elements.impacts, elements.most_switches = static
    elements.by_name = dict(zip(names, children))
    return elements


jax.tree_util.register_pytree_node(Elements, _flatten, _unflatten)


def _check_pair(friction, sliding):
    fix = 'lj.Contact(gap, friction=0.3, sliding=lambda t, q, v, params: v["x"])'
    must_go_together({"friction": friction, "sliding": sliding}, "friction needs a coefficient and a velocity", fix)
    must_be_function(sliding, "sliding", "(t, q, v, params)", 'sliding=lambda t, q, v, params: v["x"]', optional=True)


def _check_above_zero(role: str, number, cause: str):
    if not (callable(number) or isinstance(number, Tracer)):
        given = np.asarray(number)
        fix = f"{role}={np.where(given == 0, 1.0, abs(given))}"
        must(np.all(given > 0), f"{role} must be above zero", number, fix, cause)


def _check_not_negative(role: str, number):
    if number is None or callable(number) or isinstance(number, Tracer):
        return
    given = np.asarray(number)
    if np.any(np.isnan(given)):
        raise ValueError(f"{role} = {number} is no number.\nUsual cause: a division by zero.\nFix: a number.")
    if np.any(given < 0):
        raise ValueError(
            f"{role} = {number} is below zero.\n"
            "Usual cause: a sign that the law has already (friction acts against the sliding velocity by itself).\n"
            f"Fix: {role}={abs(given)}."
        )
    if role == "restitution" and np.any(given > 1):
        raise ValueError(
            f"restitution = {number} is above 1: the impact would give energy.\n"
            "Usual cause: the square of a speed in place of the speed, a percentage; a bumper that kicks.\n"
            f"Fix: restitution={np.minimum(1 / given, 1.0)}; for a kick, lj.Hybrid with a reset."
        )


def _number(x: Any) -> Any:
    """A number as an array, so that no program is compiled for its value; a function unchanged."""
    return x if x is None or callable(x) or isinstance(x, jax.Array) else np.asarray(x, float)
