"""Elements: contacts and dry friction, which a person writes down in a line each.

    Contact     a gap that may close: impact, rest, sliding, letting go
    Friction    Coulomb's friction on a sliding velocity
    Stop        a contact at each end of the way of a coordinate

A `System` with elements moves in modes: each gap is open or closed, and each sliding velocity slides to one side,
or sticks, or is free since its gap is open. `integrate` finds the modes that fit the state and changes them.

Source: Glocker, *Set-Valued Force Laws*, §5, §6; Brogliato, *Nonsmooth Mechanics*, §4, §5.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, PyTree

MOST_SWITCHES = 256
IMPACTS = ("sequential", "simultaneous")


class Friction(eqx.Module):
    """Coulomb's friction: a force against the sliding velocity, of size μ N; while nothing slides, whatever holds it.

    >>> import lagjax as lj
    >>> spring = lambda t, q, v, params: 0.5 * v**2 - 50.0 * q**2
    >>> lj.System(spring, elements={"floor": Friction(lambda t, q, v, params: v, 0.3, normal=9.81)})
    System(<lambda>; elements: floor (Friction))

    **Arguments:**

    - `sliding`: `sliding(t, q, v, params)`, the sliding velocity, linear in v: a number, or (k,) for k of them, each
      with friction of its own. The force acts along `∂sliding/∂v`.
    - `coefficient`: μ of sliding: a number, a function of `params`, or `mu(speed, params)` (Stribeck's law).
    - `normal`: the normal force N: a number, a function of (t, q, v, params), or the name of a constraint whose
      multiplier it is, above zero where it presses.
    - `static`: μ of sticking, a number or a function of `params`; by default `coefficient`, at speed zero.

    **Raises:** `TypeError` for a sliding velocity that is no function, or another kind of normal force.

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
        _check_function("sliding", sliding, "(t, q, v, params)", 'v["x"]')
        for role, number in (("coefficient", coefficient), ("static", static)):
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
    - `restitution`: the speed at which a gap opens after an impact over that at which it closed, 0 to 1: a number, or
      a function of the closing speed.
    - `friction`, `static`: Coulomb's coefficients of sliding and of sticking, as for `lj.Friction`; the normal force
      is that of the contact. None: the contact is smooth.
    - `sliding`: `sliding(t, q, v, params)`, the sliding velocity, `[gap]/[t]`, of the shape of the gap.
    - `slower_than`: a contact that opens more slowly than this after an impact stays closed, `[gap]/[t]`: this ends
      infinitely many impacts in finite time. The part of the motion left out is of the size of its square.

    **Raises:** `TypeError` for a gap or a sliding velocity that is no function; `ValueError` for a restitution below
    zero, and for friction without a sliding velocity.

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
        _check_function("gap", gap, "(t, q, params)", 'q["y"]')
        if (friction is None) != (sliding is None):
            given, missing = ("friction", "sliding") if sliding is None else ("sliding", "friction")
            raise ValueError(
                f"{given} is given, but {missing} is not: friction needs a coefficient and a velocity.\n"
                'Fix: lj.Contact(gap, friction=0.3, sliding=lambda t, q, v, params: v["x"]).'
            )
        if sliding is not None:
            _check_function("sliding", sliding, "(t, q, v, params)", 'v["x"]')
        for role, number in (("restitution", restitution), ("friction", friction), ("static", static)):
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
        _check_function("coordinate", coordinate, "(t, q, params)", 'q["x"]')
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


class Elements(Mapping):
    """Elements by name, with how their impacts are solved; a dict of them is the same with the defaults.

    >>> import lagjax as lj
    >>> floor = lj.Contact(lambda t, q, params: q)
    >>> Elements({"floor": floor}, impacts="simultaneous")
    Elements(floor: Contact(smooth); impacts simultaneous)

    **Arguments:**

    - `elements`: by name, `Contact` or `Friction`.
    - `impacts`: where several contacts are struck at once: "sequential", one after the other, always the one that
      closes fastest (Newton's cradle sends on as many balls as came); or "simultaneous", all at once by Newton's law
      (in the cradle all balls move on).
    - `most_switches`: the largest number of changes of modes in a motion; memory is reserved for so many.

    **Raises:** `TypeError` for what is no element; `ValueError` for other `impacts`.
    """

    def __init__(
        self,
        elements: Mapping[str, Contact | Friction],
        impacts: str = "sequential",
        most_switches: int = MOST_SWITCHES,
    ):
        if not isinstance(elements, Mapping):
            raise TypeError(
                f"elements must be given by name, not as {type(elements).__name__}.\n"
                'Fix: elements={"floor": lj.Contact(gap)}.'
            )
        for name, element in elements.items():
            if not isinstance(name, str) or not isinstance(element, Contact | Friction):
                raise TypeError(
                    f"element {name!r} is a {type(element).__name__}, and must be a lj.Contact or a lj.Friction with "
                    'a name.\nFix: elements={"floor": lj.Contact(gap)}.'
                )
        if impacts not in IMPACTS:
            raise ValueError(f"impacts must be one of {', '.join(map(repr, IMPACTS))}, not {impacts!r}.")
        if not (isinstance(most_switches, int) and most_switches > 0):
            raise ValueError(f"most_switches must be a whole number above zero, not {most_switches!r}.\nFix: 100.")
        self.by_name = dict(sorted(elements.items()))
        self.impacts, self.most_switches = impacts, most_switches

    def __getitem__(self, name: str) -> Contact | Friction:
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


def _check_function(role: str, function, arguments: str, example: str):
    if not callable(function):
        raise TypeError(
            f"{role} must be a function of {arguments}, not {type(function).__name__}.\n"
            f"Fix: {role}=lambda {arguments[1:-1]}: {example}"
        )


def _check_not_negative(role: str, number):
    if number is None or callable(number) or isinstance(number, Tracer):
        return
    if np.any(np.asarray(number) < 0):
        raise ValueError(
            f"{role} = {number} is below zero.\n"
            "Usual cause: a sign that the law has already (friction acts against the sliding velocity by itself).\n"
            f"Fix: {role}={abs(np.asarray(number))}."
        )


def _number(x: Any) -> Any:
    """A number as an array, so that no program is compiled for its value; a function unchanged."""
    return x if x is None or callable(x) or isinstance(x, jax.Array) else np.asarray(x, float)
