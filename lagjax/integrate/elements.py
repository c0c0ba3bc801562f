"""A motion with elements: their laws, checked and traced, and with them in each phase one system in modes.

Modes are those of gaps first, then of sliding velocities, of springs, and of sampled controls.

In a system in modes constraints are on or off, and forces depend on the modes. Its functions take `InModes` in place of
the parameters, so that one program serves all modes.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import dtypes
from jaxtyping import Array, PyTree

from lagjax.integrate.jumps import OfParams
from lagjax.integrate.laws import (
    CLOSED,
    STICKS,
    Compliant,
    Laws,
    Normal,
    Sampled,
    Tangent,
    is_fixed,
    takes_of_coefficient,
)
from lagjax.integrate.meeting import Meeting, Met
from lagjax.jaxtools import compiled, depends, is_linear, varies, without_init
from lagjax.refusals import must_differ, must_name, must_return
from lagjax.system import (
    OF_POSITION,
    OF_STATE,
    WITH_MULTIPLIERS,
    Call,
    CompliantContact,
    Contact,
    Elements,
    Friction,
    Holonomic,
    Hybrid,
    InModes,
    Nonholonomic,
    SampledControl,
    State,
    System,
    Traced,
    check_use,
    coordinates,
    depends_on,
    model_of,
    replace_fields,
    takes_of,
    traced_call,
    traced_system,
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
        must_differ([*[key] * own, *self.elements], f"an element and the friction of '{name}'", "another name for it")
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
        fix = "normal='{}', a number, or a function of (t, q, v, params)"
        must_name(normal, known, f"normal of element '{name}' names", "constraint or contact", fix)
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
    wanted = (
        f"{f'shape {shape}' if shape else 'a number'}, as its normal force, or {(*shape, 2)} for sliding in a plane"
    )
    cause = "the velocity of a point in space, or several sliding velocities with one normal force"
    fix = "its components along the contact; jnp.full(k, N) for k sliding velocities with N each"
    must_return(jnp.shape(value) in (shape, (*shape, 2)), call, wanted, value, fix, cause)


def _check_name(name: str, plain: System):
    fix = "another name for one of them; a contact that always holds is a lj.Holonomic and no element"
    must_differ([name, *plain.constraints], "an element and a constraint, and the multipliers of both,", fix)


def _check_output(call: Call, value, like: Array):
    found = getattr(value, "shape", () if isinstance(value, float | int) else None)
    fix = "an entry in q0 of that shape, as jnp.zeros(2) for two of them; or an element for each"
    wanted = f"its output in the shape of its entry in q0, {like.shape}"
    must_return(found == like.shape, call, wanted, value, fix, "several outputs of one controller, or a missing return")


def _check(call: Call, value, shape: tuple | None):
    found, wanted = jnp.shape(value), "a number or a vector" if shape is None else "a number"
    holds = shape in (None, found) and len(found) < 2
    must_return(holds, call, wanted, value, "its component along the contact", "the velocity of a point in space")


class Masked(eqx.Module):
    """A gap, or a sliding velocity, as the residual of a constraint: zero where it does not hold."""

    function: Callable
    at: tuple[int, int] = eqx.field(static=True)
    holds: int = eqx.field(static=True)

    def __call__(self, *arguments):
        *state, given = arguments
        value = self.function(*state, given.params)
        on = given.modes[slice(*self.at)] == self.holds
        return jnp.where(on.reshape(jnp.shape(value)), value, 0.0)


class WithElements(eqx.Module):
    """The force of a system with those of everything that slides, or is pressed."""

    force: Callable | None
    tangents: tuple[Tangent, ...]
    compliant: tuple[Compliant, ...]
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        params = given.params
        total = jax.tree.map(jnp.zeros_like, q) if self.force is None else self.force(t, q, v, params)
        for force in self.by_element(t, q, v, multipliers, given).values():
            total = jax.tree.map(jnp.add, total, force)
        return total

    def by_element(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        """The forces that elements add, each like q, by the names of their modes: of friction, while it slides."""
        found, params, forces = {}, given.params, dict(multipliers)
        for law in self.compliant:
            forces[law.name], found[law.name] = law.push(t, q, v, given)
        for law in self.tangents:
            slip, back = jax.vjp(lambda v, law=law: law.slips(t, q, v, params), v)
            found[law.name] = back(law.friction(t, q, slip, v, forces, given))[0]
        return found


class OneGuard(eqx.Module):
    """The guards of all modes as one: the least of them, each in units of its slack.

    Guards are followed one by one, so that many of them would take long to compile. One that rests at zero counts as
    far from its end: else the least of all would be that, until another one is as near to zero.
    """

    laws: Laws
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        slack, last = self.laws.slack(given), self.laws.last(t, q, v, multipliers, given)
        size = jnp.where(slack > 0, slack, 1.0)
        values, far = (last + slack) / size, 1 / jnp.finfo(last.dtype).eps
        return jnp.min(jnp.where(self.laws.rests(given) & (values > 0.5), jnp.maximum(values, far), values))


def in_modes(system: System, start: State) -> tuple[System, Laws]:
    """A system with elements as a system of `InModes`, with its laws; all functions checked and traced."""
    assert system.elements is not None
    plain = traced_system(replace(system, elements=None), start)
    if plain.force is not None and takes_of(plain.force) == WITH_MULTIPLIERS:
        raise ValueError(
            "a force that takes multipliers cannot stand beside elements.\n"
            'Fix: lj.Friction(sliding, coefficient, normal="name of the constraint") among the elements.'
        )
    normals, tangents, owners, compliant, sampled = laws_of(system.elements, plain, start)
    # As constraints are, contacts are no place for states.
    as_constraints = {law.name: Holonomic(law.gap) for law in (*normals, *compliant)}
    as_constraints |= {law.name: Nonholonomic(law.sliding) for law in tangents}
    check_use(replace(plain, constraints=as_constraints, force=None))
    always = plain.map(lambda function, role: OfParams(function))
    constraints: dict[str, Any] = dict(always.constraints)
    constraints |= {law.name: Holonomic(Masked(law.gap, law.at, CLOSED)) for law in normals}
    constraints |= {law.name: Nonholonomic(Masked(law.sliding, law.at, STICKS)) for law in tangents}
    force = WithElements(plain.force, tangents, compliant) if tangents or compliant else always.force
    masked = replace(always, constraints=constraints, force=force)
    guarded = [law.at[1] for law in (*normals, *tangents, *compliant)]
    guarded += [law.side[1] for law in tangents if law.side]
    count = max(guarded, default=0) + len(sampled)
    # The order of the stacked equations is known only with their shapes.
    none = np.zeros(count, dtypes.canonicalize_dtype(int)), np.zeros(0, bool), np.zeros(count, start.t.dtype)
    given = InModes(start.params, *none)
    form = model_of(masked, *start[:3], given).form
    places, first = {}, 0
    for residual in form.residuals:
        places[residual.name] = range(first, first + residual.size)
        first += residual.size
    rows = tuple(place for law in (*normals, *tangents) for place in places[law.name])
    return masked, Laws(normals, tangents, compliant, sampled, rows, owners, form.m, system.elements.impacts)


MOTION = "motion"


class InElements(Hybrid):
    """The motion of `user`, a system with elements or a hybrid some of whose phases have some, as a hybrid whose
    functions take modes in these phases. `laws`: those of each phase, or None."""

    laws: tuple[Laws | None, ...]
    user: System | Hybrid

    @property
    def elements(self) -> Elements | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.user.elements

    @property
    def places(self) -> tuple[tuple[int, int], ...]:
        """Where the modes of each phase are among those of all."""
        ends = np.cumsum([0, *(0 if laws is None else laws.size for laws in self.laws)]).tolist()
        return tuple(zip(ends, ends[1:]))

    @property
    def modes(self) -> list[tuple[str, str]]:
        """The name and the kind of each mode, in the order of the phases."""
        several = isinstance(self.user, Hybrid) and len(list(filter(None, self.laws))) > 1
        return [
            (f"{phase}: {name}" if several else name, kind)
            for phase, laws in zip(self.names, self.laws)
            if laws is not None
            for name, kind in zip(laws.names, laws.kinds)
        ]

    def given(self, params: PyTree, modes: Array | None = None, phase: int = 0) -> Any:
        """What the functions of a phase take as `params`, in these modes of all phases, or rows of them; without any,
        with all gaps open."""
        laws = self.laws[phase]
        if laws is None or isinstance(params, InModes):
            return params
        open_ones = np.zeros(laws.size, dtypes.canonicalize_dtype(int))
        return laws.given(params, open_ones if modes is None else modes[..., slice(*self.places[phase])])

    @property
    def first_phase(self) -> System:
        """The user's system without its elements."""
        return self.user.first_phase

    def cases(self, params: PyTree, phase: int = 0) -> dict[str, PyTree]:
        """The parameters where every contact holds, and where every one that can slide does."""
        laws = self.laws[phase]
        if laws is None:
            return {"": params}
        return {f" {words}": laws.given(params, modes) for words, modes in laws.all_closed().items()}

    def laws_in_numbers(self, state: State) -> dict[str, np.ndarray]:
        found: dict[str, Any] = {}
        for phase, laws in zip(self.names, self.laws):
            if laws is None:
                continue
            of = "" if isinstance(self.user, System) else f" of phase '{phase}'"
            numbers = {f"elements, impacts {laws.impacts}": np.zeros(0)}
            numbers |= jax.tree.map(np.asarray, laws.in_numbers(state))
            found |= {f"{role}{of}": x for role, x in numbers.items()}
        return found

    def __repr__(self):
        return repr(self.user)


def assembled(user: System | Hybrid, start: State, ts: Array | np.ndarray | None) -> InElements:
    """The assembly for a motion over these times, with the functions of all phases checked and traced."""
    hybrid = user if isinstance(user, Hybrid) else Hybrid({MOTION: user})
    most, systems, laws = hybrid.most_switches if isinstance(user, Hybrid) else 0, [], []
    for system in hybrid.systems:
        if system.elements is None:
            systems.append(traced_system(system, start))
            laws.append(None)
            continue
        masked, of_phase = in_modes(system, start)
        systems.append(masked)
        laws.append(of_phase)
        most += system.elements.most_switches
        if ts is not None and (instants := of_phase.instants(ts, start.params)):
            # A power of two, so that a few instants more do not compile again.
            most = 1 << (most + instants - 1).bit_length()
    hybrid = replace_fields(hybrid, systems=tuple(systems), most_switches=most)
    return without_init(InElements, vars(hybrid) | {"laws": tuple(laws), "user": user})


@compiled
def modes_at(assembly: InElements, start: State) -> Met:
    """The modes that fit a state, and the velocities on what holds in them; of a system with elements."""
    (laws,) = assembly.laws
    assert laws is not None
    return Meeting(assembly.systems[0], laws).first(*start)[1]
