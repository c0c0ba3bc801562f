"""The laws of a system's elements, with all functions of the user's checked and traced, and places among the modes.

Modes are those of gaps first, then of sliding velocities, of springs, and of sampled controls.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.integrate.coefficients import is_fixed, takes_of_coefficient
from lagjax.integrate.compliant import Compliant
from lagjax.integrate.laws import Normal, Tangent
from lagjax.integrate.sampled import Sampled
from lagjax.jaxtools import depends, is_linear, varies
from lagjax.system import (
    OF_POSITION,
    OF_STATE,
    Call,
    CompliantContact,
    Contact,
    Elements,
    Friction,
    SampledControl,
    State,
    System,
    Traced,
    coordinates,
    depends_on,
    traced_call,
)

WITH_GAPS = (Contact, CompliantContact)


class OfParamsAlone(eqx.Module):
    """A function of the state and the parameters that does not depend on the state, as one of the parameters."""

    function: Traced
    takes: tuple[str, ...] = eqx.field(static=True, default=("params",))

    def __call__(self, params: PyTree):
        state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if varies(x) else x, self.function.program.like[:3])
        return self.function(*state, params)


def laws_of(elements: Elements, plain: System, start: State):
    """The laws by kind, and for each sliding velocity the gap whose force is its normal force, -1 if it is another."""
    of = ElementLaws(elements, plain, start)
    normals = of.normals()
    tangents, owners = of.tangents(normals)
    compliant = of.compliant()
    return normals, of.sided(tangents), owners, compliant, of.sampled()


class ElementLaws:
    """Makes laws of elements; `plain`: the system without them; `place`: the first mode that is free."""

    def __init__(self, elements: Elements, plain: System, start: State):
        self.elements, self.plain, self.start, self.place = elements, plain, start, 0
        self.given: dict[str, Any] = dict(zip(OF_STATE, start)) | {"speed": start.t, "depth": start.t}
        self.gaps = {name: self.traced(name, "gap", x.gap, OF_POSITION) for name, x in self.of_kind(*WITH_GAPS)}
        for name, gap in self.gaps.items():
            _check_name(name, plain)
            _check_slope(name, gap, *start)

    def of_kind(self, *kinds: type):
        """The elements of these kinds, with their names."""
        return [(name, element) for name, element in self.elements.items() if isinstance(element, kinds)]

    def traced(self, name: str, role: str, f, takes: tuple[str, ...], shape: tuple | None = None) -> Any:
        """A function of the user's, called once; what is no function unchanged."""
        if not callable(f):
            return f
        call = Call(role, f, takes, f" of element '{name}'")
        return traced_call(call, self.given, lambda call, x: _check(call, x, shape))

    def coefficients(self, name: str, of: str, **laws) -> list:
        """Coefficients that may depend on `of`, traced."""
        takes = {role: takes_of_coefficient(f, of) if callable(f) else () for role, f in laws.items()}
        return [self.traced(name, role, f, takes[role], ()) for role, f in laws.items()]

    def places(self, count: int) -> tuple[int, int]:
        """The places of the next modes."""
        self.place += count
        return self.place - count, self.place

    def normals(self) -> tuple[Normal, ...]:
        """The gaps of contacts."""
        found = []
        for name, contact in self.of_kind(Contact):
            (e,) = self.coefficients(name, "speed", restitution=contact.restitution)
            gap = self.gaps[name]
            found.append(Normal(name, gap, e, contact.slower_than, self.places(_size(gap))))
        return tuple(found)

    def tangents(self, normals: tuple[Normal, ...]) -> tuple[tuple[Tangent, ...], tuple[int, ...]]:
        """Whatever slides, and its owners."""
        found, owners = [], []
        for name, element in self.of_kind(*WITH_GAPS, Friction):
            if element.sliding is None:
                continue
            law = self.tangent(name, element)
            first = [normal.at[0] for normal in normals if normal.name == law.source]
            owners += [first[0] + i // (1 + law.plane) if first else -1 for i in range(law.at[1] - law.at[0])]
            found.append(law)
        return tuple(found), tuple(owners)

    def tangent(self, name: str, element: Any) -> Tangent:
        """The friction of an element."""
        own = isinstance(element, WITH_GAPS)
        mu = element.friction if isinstance(element, WITH_GAPS) else element.coefficient
        mu, static = self.coefficients(name, "speed", coefficient=mu, static=element.static)
        source, normal = (name, None) if own else self.normal_force(name, element.normal)
        given: Any = normal
        if source:
            given = self.gaps[source] if source in self.gaps else self.plain.constraints[source].function
        shape = jnp.shape(given.program.value if isinstance(given, Traced) else given)
        call = Call("sliding", element.sliding, OF_STATE, f" of element '{name}'")
        sliding = traced_call(call, self.given, partial(_check_sliding, shape))
        check_linear(sliding, *self.start)
        key = f"{name} friction" if own else name
        _check_name(key, self.plain)
        if own and key in self.elements:
            raise ValueError(f"'{key}' is the name of the friction of '{name}'.\nFix: another name for the element.")
        plane = jnp.shape(sliding.program.value) == (*shape, 2)
        both = source in self.plain.constraints
        if isinstance(normal, Traced) and not depends_on(normal, *OF_STATE[:-1]):
            normal = OfParamsAlone(normal)
        return Tangent(key, sliding, mu, static, normal, source, self.places(_size(sliding)), plane, both)

    def sided(self, tangents: tuple[Tangent, ...]) -> tuple[Tangent, ...]:
        """The same with places for the sides from which they are pressed, where normal forces may fall below zero."""

        def with_side(law: Tangent) -> Tangent:
            if not law.both and is_fixed(law.normal):
                return law
            return replace(law, side=self.places((law.at[1] - law.at[0]) // (1 + law.plane)))

        return tuple(map(with_side, tangents))

    def normal_force(self, name: str, normal: Any) -> tuple[str, Any]:
        """The name of what presses, or the normal force itself."""
        if not isinstance(normal, str):
            return "", self.traced(name, "normal", normal, OF_STATE)
        known = [*self.plain.constraints, *self.gaps]
        if normal not in known:
            raise ValueError(
                f"normal='{normal}' of element '{name}' is no constraint and no contact; there "
                f"{'are ' + ', '.join(map(repr, known)) if known else 'are none'}.\n"
                "Fix: its name, a number, or a function of (t, q, v, params)."
            )
        return normal, None

    def compliant(self) -> tuple[Compliant, ...]:
        """Springs and dampers behind gaps."""
        found = []
        for name, element in self.of_kind(CompliantContact):
            k, c = self.coefficients(name, "depth", stiffness=element.stiffness, damping=element.damping)
            gap = self.gaps[name]
            found.append(Compliant(name, gap, k, c, self.places(_size(gap)), jnp.shape(gap.program.value)))
        return tuple(found)

    def sampled(self) -> tuple[Sampled, ...]:
        """Sampled controls."""
        found = []
        for name, element in self.of_kind(SampledControl):
            every, offset = self.coefficients(name, "speed", every=element.every, offset=element.offset)
            call = Call("controller", element.controller, OF_STATE, f" of element '{name}'")
            controller = traced_call(call, self.given, partial(_check_output, like=self.start.q[name]))
            found.append(Sampled(name, controller, every, offset, self.places(1)[0]))
        return tuple(found)


def check_linear(sliding: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    """Raise if a sliding velocity is not linear in v."""
    u, unflatten = coordinates.flatten(v)
    program = jax.make_jaxpr(jax.jacfwd(lambda u: sliding(t, q, unflatten(u), params)))(u).jaxpr
    arrays, rest = eqx.partition((t, q, params), eqx.is_array_like)

    def slips(u: Array, arrays: tuple):
        t, q, params = eqx.combine(arrays, rest)
        return jnp.ravel(sliding(t, q, unflatten(u), params))

    # A loop hides which of its numbers depend on which: what it makes is looked at.
    if depends(program, program.invars) and not is_linear(slips, u.size, u.dtype, arrays):
        raise ValueError(
            "sliding(t, q, v, params) must be linear in v, but its slope depends on v.\n"
            "Usual cause: a speed, jnp.abs of the velocity or its length.\n"
            'Fix: the velocity with its sign, v["x"] - params["R"] * v["phi"].'
        )


def _size(function) -> int:
    return int(np.prod(jnp.shape(function.program.value)))


def _check_slope(name: str, gap: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    """Raise if no motion changes a gap, as far as JAX sees."""
    program = jax.make_jaxpr(lambda v: jax.jvp(lambda q: gap(t, q, params), (q,), (v,))[1])(v).jaxpr
    if not depends(program, program.invars):
        raise ValueError(
            f"the gap of element '{name}' has no derivative by q: its rate is zero in every motion.\n"
            "Usual cause: jnp.floor, jnp.round, or a comparison, which is 0 or 1; a gap that does not depend on q.\n"
            'Fix: a length that changes as the bodies move, such as q["y"] - params["R"].'
        )


def _check_sliding(shape: tuple[int, ...], call: Call, value):
    found = jnp.shape(value)
    if found == shape or found == (*shape, 2):
        return
    raise ValueError(
        f"{call} must return {f'shape {shape}' if shape else 'a number'}, as its normal force, or {(*shape, 2)} for "
        f"sliding in a plane, and returned shape {found}.\n"
        "Usual cause: the velocity of a point in space, or several sliding velocities with one normal force.\n"
        "Fix: its components along the contact; jnp.full(k, N) for k sliding velocities with N each."
    )


def _check_name(name: str, plain: System):
    if name in plain.constraints:
        raise ValueError(
            f"'{name}' is the name of an element and of a constraint, whose multipliers would have one name.\n"
            "Fix: another name for one of them; a contact that always holds is a lj.Holonomic and no element."
        )


def _check_output(call: Call, value, like: Array):
    found = getattr(value, "shape", () if isinstance(value, float | int) else None)
    if found != like.shape:
        raise ValueError(
            f"{call} must return its output in the shape of its entry in q0, {like.shape}, and returned "
            f"{f'a {type(value).__name__}' if found is None else f'shape {found}'}.\n"
            "Usual cause: several outputs of one controller, or a missing return.\n"
            "Fix: an entry in q0 of that shape, as jnp.zeros(2) for two of them; or an element for each."
        )


def _check(call: Call, value, shape: tuple | None):
    found = jnp.shape(value)
    if shape is not None and found != shape or len(found) > 1:
        raise ValueError(
            f"{call} must return {'a number or a vector' if shape is None else 'a number'}, and returned shape {found}."
            "\nUsual cause: the velocity of a point in space.\n"
            "Fix: its component along the contact."
        )
