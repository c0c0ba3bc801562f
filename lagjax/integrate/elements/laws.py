"""A system with elements as one system whose constraints and forces depend on modes.

A gap is open (0) or closed (1): a closed one is a holonomic constraint. A sliding velocity is free (0), slides to one
side (1, -1), with a force -μ N, or sticks (2): then it is a velocity constraint. A spring behind a gap is apart (0) or
pressed (1), with a force (`compliant.py`). The functions of the system take `InModes` in place of the parameters, so
that one program serves all modes; constraints that do not hold are off.

A sliding velocity in a plane is two rows with one mode: it slides (1) with a force -μ N s/|s|, which has no limit at
s = 0. Its sliding ends at a speed δ, the slack of its mode, and begins with 2 δ in the direction of the acceleration: a
step that passes zero and meets the opposite force is then longer than what the method's tolerance lets through.

The guard of a mode is above zero as long as it lasts:

    open: the gap        closed: λ_N        slides: ± the sliding velocity, or |s| - δ        sticks: μ N - |λ_T|
    apart: -m            pressed: m

Sampled controls (`sampled.py`) have the number of their next instant as a mode, and no guard: legs end at instants.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.elements.coefficients import coefficient, takes_of_coefficient
from lagjax.integrate.elements.complementarity import lengths
from lagjax.integrate.elements.compliant import PRESSED, Compliant
from lagjax.integrate.elements.sampled import Sampled
from lagjax.integrate.jumps.find import OfParams
from lagjax.integrate.trajectory.parts import mode_in_words
from lagjax.jaxtools import depends, is_traced, stop_gradient
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
    InModes,
    Nonholonomic,
    SampledControl,
    State,
    System,
    Traced,
    check_use,
    coordinates,
    model_of,
    takes_of,
    traced_call,
    traced_system,
)

OPEN, CLOSED = 0, 1
FREE, STICKS = 0, 2
ALL_CLOSED = {"where contacts stick": STICKS, "where contacts slide": 1}


class Normal(eqx.Module):
    """The gaps of a contact; `at`: their places among the modes."""

    name: str = eqx.field(static=True)
    gap: Callable
    restitution: Any
    slower_than: Any
    at: tuple[int, int] = eqx.field(static=True)

    def gaps(self, t: Array, q: PyTree, params: PyTree) -> Float[Array, " k"]:
        """The gaps as a vector."""
        return jnp.ravel(self.gap(t, q, params))

    def returned(self, closing: Float[Array, " k"], params: PyTree) -> Float[Array, " k"]:
        """The restitution at these speeds."""
        return coefficient(self.restitution, closing, params)


class Tangent(eqx.Module):
    """The sliding velocities of an element, and its friction; `name`: that of the constraint while it sticks.

    `source`: the constraint or contact whose multiplier is the normal force; if empty, `normal` is that. `plane`:
    whether each two of the sliding velocities are components in a plane, with one normal force.
    """

    name: str = eqx.field(static=True)
    sliding: Callable
    coefficient: Any
    static: Any
    normal: Any
    source: str = eqx.field(static=True)
    at: tuple[int, int] = eqx.field(static=True)
    plane: bool = eqx.field(static=True)

    @property
    def partners(self) -> np.ndarray:
        """For each sliding velocity the other component of its plane; itself, along a line."""
        place = np.arange(self.at[1] - self.at[0])
        return place ^ 1 if self.plane else place

    def speeds(self, slips: Float[Array, " k"]) -> Float[Array, " k"]:
        """|s| in each plane, in both of its rows; without a branch, and above zero."""
        return jnp.sqrt(slips**2 + slips[self.partners] ** 2 + jnp.finfo(slips.dtype).tiny)

    def slips(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, " k"]:
        """The sliding velocities as a vector."""
        return jnp.ravel(self.sliding(t, q, v, params))

    def normal_forces(self, t: Array, q: PyTree, v: PyTree, forces: dict, params: PyTree) -> Float[Array, " k"]:
        """N of each; `forces`: multipliers, and what is compliant, by name."""
        if self.source:
            found = forces[self.source]
        else:
            found = self.normal(t, q, v, params) if callable(self.normal) else self.normal
        return jnp.repeat(jnp.ravel(jnp.asarray(found, t.dtype)), 2 if self.plane else 1)

    def kinetic(self, speed: Float[Array, " k"], params: PyTree) -> Float[Array, " k"]:
        """μ while it slides with this speed."""
        return coefficient(self.coefficient, speed, params)

    def sticking(self, speed: Float[Array, " k"], params: PyTree) -> Float[Array, " k"]:
        """μ while it sticks."""
        return coefficient(self.coefficient if self.static is None else self.static, jnp.zeros_like(speed), params)


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
            mode = given.modes[slice(*law.at)]
            side = jnp.where(jnp.abs(mode) == 1, mode, 0).astype(t.dtype)
            slip, back = jax.vjp(lambda v, law=law: law.slips(t, q, v, params), v)
            speed = law.speeds(slip) if law.plane else side * slip
            side = side * slip / speed if law.plane else side
            size = law.kinetic(speed, params) * law.normal_forces(t, q, v, forces, params)
            found[law.name] = back(-side * size)[0]
        return found


class Laws(eqx.Module):
    """The elements of a system with their places among the modes: normals, tangents, compliant ones, sampled controls.

    `rows` (k,): which of the stacked constraint equations belongs to each normal and tangent. `owners` (k_T,): for each
    sliding velocity the gap whose force is its normal force, -1 if it is another.
    """

    normals: tuple[Normal, ...]
    tangents: tuple[Tangent, ...]
    compliant: tuple[Compliant, ...]
    sampled: tuple[Sampled, ...]
    rows: tuple[int, ...] = eqx.field(static=True)
    owners: tuple[int, ...] = eqx.field(static=True)
    equations: int = eqx.field(static=True)
    impacts: str = eqx.field(static=True)

    @property
    def count(self) -> tuple[int, int]:
        """The numbers of gaps and of sliding velocities."""
        return len(self.rows) - len(self.owners), len(self.owners)

    @property
    def size(self) -> int:
        """The number of modes."""
        return self.guarded + len(self.sampled)

    @property
    def guarded(self) -> int:
        """The number of modes that have guards."""
        return self.compliant[-1].at[1] if self.compliant else len(self.rows)

    @property
    def kinds(self) -> dict[str, int]:
        """How many modes are those of gaps, of springs and of controls."""
        return {"gaps": self.count[0], "springs": self.guarded - len(self.rows), "controls": len(self.sampled)}

    @property
    def is_sampled(self) -> np.ndarray:
        """Which modes are those of sampled controls."""
        return np.arange(self.size) >= self.guarded

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each mode."""
        guarded = tuple(
            law.name + (f"[{i}]" if law.at[1] - law.at[0] > 1 else "")
            for law in (*self.normals, *self.tangents, *self.compliant)
            for i in range(law.at[1] - law.at[0])
        )
        return guarded + tuple(law.name for law in self.sampled)

    @property
    def partners(self) -> np.ndarray:
        """For each sliding velocity the other component of its plane; itself, along a line."""
        normals = self.count[0]
        return np.concatenate([np.zeros(0, int), *(law.at[0] - normals + law.partners for law in self.tangents)])

    @property
    def in_planes(self) -> np.ndarray:
        """Which sliding velocities are components in a plane."""
        return self.partners != np.arange(self.count[1])

    @property
    def elements(self) -> tuple[str, ...]:
        """The name of each mode's element: a contact's friction belongs to the contact."""
        gaps = [law.name for law in self.normals for _ in range(law.at[1] - law.at[0])]
        slips = [
            law.source if law.name == f"{law.source} friction" else law.name
            for law in self.tangents
            for _ in range(law.at[1] - law.at[0])
        ]
        springs = [law.name for law in self.compliant for _ in range(law.at[1] - law.at[0])]
        return *gaps, *slips, *springs, *(law.name for law in self.sampled)

    def modes_in_words(self, modes) -> list[str]:
        """Each of these modes in a word."""
        return [mode_in_words(i, int(mode), self.size, **self.kinds) for i, mode in enumerate(modes)]

    def holds(self, modes: Int[Array, " k"]) -> Bool[Array, " kNT"]:
        """Which of the normals and tangents are constraints in these modes."""
        of_rows = modes[..., : len(self.rows)]
        return jnp.where(np.arange(len(self.rows)) < self.count[0], of_rows == CLOSED, of_rows == STICKS)

    def rubs(self, modes: Int[Array, " k"]) -> Bool[Array, " kT"]:
        """Which sliding velocities are not free for that the spring that presses them is apart."""
        pressed = {law.name: modes[slice(*law.at)] == PRESSED for law in self.compliant}
        found = [
            jnp.repeat(pressed[law.source], 1 + law.plane)
            if law.source in pressed
            else jnp.ones(law.at[1] - law.at[0], bool)
            for law in self.tangents
        ]
        return jnp.concatenate([*found, jnp.zeros(0, bool)])

    def given(self, params: PyTree, modes: Int[Array, " k"], slack: Float[Array, " k"] | None = None) -> InModes:
        """The parameters in these modes; rows of modes, (..., k), give rows of the rest."""
        off = jnp.zeros((*modes.shape[:-1], self.equations), bool)
        off = off.at[..., np.array(self.rows, int)].set(~self.holds(modes))
        return InModes(params, modes, off, jnp.zeros(modes.shape) if slack is None else slack)

    def in_rows(self, given: InModes, modes: Int[Array, " kNT"]) -> InModes:
        """The same with these modes of normals and tangents."""
        return self.given(given.params, jnp.concatenate([modes, given.modes[len(self.rows) :]]))

    def at_first(self, t: Array, params: PyTree) -> InModes:
        """The parameters at the start of a motion, with all gaps open."""
        instants = [jnp.reshape(law.first(t, params), 1) for law in self.sampled]
        return self.given(params, jnp.concatenate([jnp.zeros(self.guarded, int), *instants]))

    def all_closed(self) -> dict[str, Int[Array, " k"]]:
        """All gaps closed, by whether what can slide sticks or slides."""
        gaps, slips = self.count
        rest = [PRESSED] * (self.guarded - gaps - slips) + [0] * len(self.sampled)
        return {words: jnp.array([CLOSED] * gaps + [mode] * slips + rest, int) for words, mode in ALL_CLOSED.items()}

    def in_numbers(self, state: State) -> dict[str, Array]:
        """What the laws are besides the functions of the system, by role, at a state."""
        found = {}
        for law in self.normals:
            ones = jnp.ones(law.at[1] - law.at[0], state.t.dtype)
            slower = jnp.broadcast_to(jnp.asarray(law.slower_than, ones.dtype), ones.shape)
            found[f"the restitution of '{law.name}'"] = jnp.concatenate(
                [law.returned(ones, state.params), law.returned(2 * ones, state.params)]
            )
            found[f"slower_than of '{law.name}'"] = slower
        for law in self.tangents:
            ones = jnp.ones(law.at[1] - law.at[0], state.t.dtype)
            mu = law.sticking(ones, state.params), law.kinetic(ones, state.params), law.kinetic(2 * ones, state.params)
            found[f"the coefficients of '{law.name}'"] = jnp.concatenate(mu)
        for law in self.compliant:
            ones = jnp.ones(law.at[1] - law.at[0], state.t.dtype)
            both = (coefficient(f, x * ones, state.params) for f in (law.stiffness, law.damping) for x in (1, 2))
            found[f"stiffness and damping of '{law.name}'"] = jnp.concatenate([*both])
        for law in self.sampled:
            acts = jnp.ravel(law.controller(state.t, state.q, state.v, state.params))
            found[f"the controller of '{law.name}'"] = acts
            found[f"the instants of '{law.name}'"] = jnp.stack([law.instant(k, state.t, state.params) for k in (0, 1)])
        return found

    def last(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes) -> Float[Array, " k"]:
        """The guard of each mode: above zero, or no farther below than its slack, as long as the mode lasts."""
        params, found, forces = given.params, [], multipliers | self.forces(t, q, v, given)
        for law in self.normals:
            force = jnp.ravel(multipliers[law.name])
            found.append(jnp.where(given.modes[slice(*law.at)] == CLOSED, force, law.gaps(t, q, params)))
        for law in self.tangents:
            mode, slips = given.modes[slice(*law.at)], law.slips(t, q, v, params)
            most = law.sticking(slips, params) * law.normal_forces(t, q, v, forces, params)
            holds = most - lengths(jnp.ravel(multipliers[law.name]), law.partners)
            slides = law.speeds(slips) - 2 * given.slack[slice(*law.at)] if law.plane else mode * slips
            found.append(jnp.where(mode == STICKS, holds, jnp.where(mode == FREE, 1.0, slides)))
        for law in self.compliant:
            found.append(law.last(t, q, v, given))
        return jnp.concatenate([*found, jnp.zeros(0, t.dtype)])

    def pressed(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, fired: Bool[Array, " k"], sizes: Float[Array, "2 n"]
    ) -> tuple[InModes, Float[Array, " kC"]]:
        """The parameters in the modes of what is compliant, and the slack of these modes (`Compliant.after`)."""
        modes, slack = given.modes, [jnp.zeros(0, t.dtype)]
        for law in self.compliant:
            own, reach = law.after(t, q, v, given, fired[slice(*law.at)], sizes)
            modes = modes.at[slice(*law.at)].set(own.astype(modes.dtype))
            slack.append(reach)
        return self.given(given.params, modes, given.slack), jnp.concatenate(slack)

    def forces(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> dict[str, Array]:
        """F of what is compliant, by name."""
        return {law.name: jnp.reshape(law.forces(t, q, v, given), law.shape) for law in self.compliant}

    def acted(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> tuple[PyTree, InModes]:
        """q and the modes after the instants at this time, if any."""
        new, modes = {}, given.modes
        for law in self.sampled:
            k = modes[law.place]
            acts = law.acts(k, t, given.params)
            new[law.name] = jnp.where(acts, law.controller(t, q, v, given.params), q[law.name]).astype(
                q[law.name].dtype
            )
            modes = modes.at[law.place].add(acts)
        return ({**q, **new} if new else q), self.given(given.params, modes, given.slack)

    def instants(self, ts: Array | np.ndarray, params: PyTree) -> int:
        """How many instants there are between the first and the last time; zero where JAX is tracing what says so."""
        # While JAX traces something else, numbers that it does not trace can still be counted.
        with jax.ensure_compile_time_eval():
            ends = jnp.asarray(ts[0]), jnp.asarray(ts[-1])
            counted = [law.first(ends[1], params) - law.first(ends[0], params) for law in self.sampled]
        return 0 if is_traced(counted) else sum(map(int, counted))

    def next_instant(self, modes: Int[Array, " k"], ts: Float[Array, " T"], params: PyTree) -> Float[Array, ""]:
        """The first of the next instants; infinite where none comes before the end. One that is an output, within
        round-off, is that."""
        found = jnp.asarray(jnp.inf, ts.dtype)
        for law in self.sampled:
            t = law.instant(modes[law.place], ts[-1], params)
            near = jnp.abs(ts - t) <= law.slack(t, params)
            output = jnp.max(jnp.where(near, ts, -jnp.inf))
            t = t + stop_gradient(jnp.where(jnp.any(near), output - t, 0.0))
            found = jnp.where((t < ts[-1]) & (t < found), t, found)
        return found


class OneGuard(eqx.Module):
    """The guards of all modes as one: the least of them, each in units of its slack.

    Guards are followed one by one, so that many of them would take long to compile.
    """

    laws: Laws
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        slack = given.slack[: self.laws.guarded]
        size = jnp.where(slack > 0, slack, 1.0)
        return jnp.min((self.laws.last(t, q, v, multipliers, given) + slack) / size)


def in_modes(system: System, start: State) -> tuple[System, Laws]:
    """A system with elements as a system of `InModes`, with its laws; all functions checked and traced."""
    assert system.elements is not None
    plain = traced_system(replace(system, elements=None), start)
    if plain.force is not None and takes_of(plain.force) == WITH_MULTIPLIERS:
        raise ValueError(
            "a force that takes multipliers cannot stand beside elements.\n"
            'Fix: lj.Friction(sliding, coefficient, normal="name of the constraint") among the elements.'
        )
    normals, tangents, owners, compliant, sampled = _laws(system.elements, plain, start)
    # As constraints are, contacts are no place for states.
    as_constraints = {law.name: Holonomic(law.gap) for law in (*normals, *compliant)}
    as_constraints |= {law.name: Nonholonomic(law.sliding) for law in tangents}
    check_use(replace(plain, constraints=as_constraints, force=None))
    constraints: dict[str, Any] = {name: type(c)(OfParams(c.function)) for name, c in plain.constraints.items()}
    constraints |= {law.name: Holonomic(Masked(law.gap, law.at, CLOSED)) for law in normals}
    constraints |= {law.name: Nonholonomic(Masked(law.sliding, law.at, STICKS)) for law in tangents}
    force = None if plain.force is None else OfParams(plain.force)
    if tangents or compliant:
        force = WithElements(plain.force, tangents, compliant)
    dissipation = None if plain.dissipation is None else OfParams(plain.dissipation)
    states = {name: OfParams(f) for name, f in plain.states.items()}
    masked = System(OfParams(plain.lagrangian), constraints, force, dissipation, states)
    guarded = [law.at[1] for law in (*normals, *tangents, *compliant)]
    count = max(guarded, default=0) + len(sampled)
    # The order of the stacked equations is known only with their shapes.
    given = InModes(start.params, jnp.zeros(count, int), jnp.zeros(0, bool), jnp.zeros(count))
    form = model_of(masked, *start[:3], given).form
    places, first = {}, 0
    for residual in form.residuals:
        places[residual.name] = range(first, first + residual.size)
        first += residual.size
    rows = tuple(place for law in (*normals, *tangents) for place in places[law.name])
    return masked, Laws(normals, tangents, compliant, sampled, rows, owners, form.m, system.elements.impacts)


def _laws(elements: Elements, plain: System, start: State):
    given: dict[str, Any] = dict(zip(OF_STATE, start)) | {"speed": start.t, "depth": start.t}
    place, normals, tangents, owners, compliant, sampled = 0, [], [], [], [], []
    with_friction = (Contact, CompliantContact)

    def traced(name: str, role: str, f, takes: tuple[str, ...], shape: tuple | None = None):
        if not callable(f):
            return f
        return traced_call(Call(role, f, takes, f" of element '{name}'"), given, lambda call, x: _check(call, x, shape))

    def coefficients(name: str, of: str, **laws):
        takes = {role: takes_of_coefficient(f, of) if callable(f) else () for role, f in laws.items()}
        return [traced(name, role, f, takes[role], ()) for role, f in laws.items()]

    gaps = {
        name: traced(name, "gap", element.gap, OF_POSITION)
        for name, element in elements.items()
        if isinstance(element, with_friction)
    }
    for name, gap in gaps.items():
        _check_name(name, plain)
        _check_slope(name, gap, *start)
    for name, contact in elements.items():
        if not isinstance(contact, Contact):
            continue
        gap = gaps[name]
        (e,), size = coefficients(name, "speed", restitution=contact.restitution), _size(gap)
        normals.append(Normal(name, gap, e, contact.slower_than, (place, place + size)))
        place += size
    for name, element in elements.items():
        if isinstance(element, SampledControl) or isinstance(element, with_friction) and element.sliding is None:
            continue
        own = isinstance(element, with_friction)
        mu = element.friction if isinstance(element, with_friction) else element.coefficient
        mu, static = coefficients(name, "speed", coefficient=mu, static=element.static)
        normal = element.normal if isinstance(element, Friction) else None
        source = name if own else normal if isinstance(normal, str) else ""
        if not own:
            known = [*plain.constraints, *gaps]
            if source and source not in known:
                raise ValueError(
                    f"normal='{source}' of element '{name}' is no constraint and no contact; there "
                    f"{'are ' + ', '.join(map(repr, known)) if known else 'are none'}.\n"
                    "Fix: its name, a number, or a function of (t, q, v, params)."
                )
            normal = traced(name, "normal", normal, OF_STATE) if not source else None
        shape = _shape_of_normal_forces(normal, source, gaps, plain)
        sliding = traced_call(
            Call("sliding", element.sliding, OF_STATE, f" of element '{name}'"), given, partial(_check_sliding, shape)
        )
        check_linear(sliding, *start)
        size, plane = _size(sliding), jnp.shape(sliding.program.value) == (*shape, 2)
        key = f"{name} friction" if own else name
        _check_name(key, plain)
        if own and key in elements:
            raise ValueError(f"'{key}' is the name of the friction of '{name}'.\nFix: another name for the element.")
        tangents.append(Tangent(key, sliding, mu, static, normal, source, (place, place + size), plane))
        source_of = [law for law in normals if law.name == source]
        owners += [source_of[0].at[0] + i // (1 + plane) if source_of else -1 for i in range(size)]
        place += size
    for name, element in elements.items():
        if isinstance(element, CompliantContact):
            k, c = coefficients(name, "depth", stiffness=element.stiffness, damping=element.damping)
            size = _size(gaps[name])
            shape = jnp.shape(gaps[name].program.value)
            compliant.append(Compliant(name, gaps[name], k, c, (place, place + size), shape))
            place += size
    for name, element in elements.items():
        if isinstance(element, SampledControl):
            every, offset = coefficients(name, "speed", every=element.every, offset=element.offset)
            acts = Call("controller", element.controller, OF_STATE, f" of element '{name}'")
            controller = traced_call(acts, given, partial(_check_output, like=start.q[name]))
            sampled.append(Sampled(name, controller, every, offset, place))
            place += 1
    return tuple(normals), tuple(tangents), tuple(owners), tuple(compliant), tuple(sampled)


def check_linear(sliding: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    """Raise if a sliding velocity is not linear in v."""
    u, unflatten = coordinates.flatten(v)
    program = jax.make_jaxpr(jax.jacfwd(lambda u: sliding(t, q, unflatten(u), params)))(u).jaxpr
    if depends(program, program.invars):
        raise ValueError(
            "sliding(t, q, v, params) must be linear in v, but its slope depends on v.\n"
            "Usual cause: a speed, jnp.abs of the velocity or its length.\n"
            'Fix: the velocity with its sign, v["x"] - params["R"] * v["phi"].'
        )


def _check_slope(name: str, gap: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    """Raise if no motion changes a gap, as far as JAX sees."""
    program = jax.make_jaxpr(lambda v: jax.jvp(lambda q: gap(t, q, params), (q,), (v,))[1])(v).jaxpr
    if not depends(program, program.invars):
        raise ValueError(
            f"the gap of element '{name}' has no derivative by q: its rate is zero in every motion.\n"
            "Usual cause: jnp.floor, jnp.round, or a comparison, which is 0 or 1; a gap that does not depend on q.\n"
            'Fix: a length that changes as the bodies move, such as q["y"] - params["R"].'
        )


def _size(function) -> int:
    return int(np.prod(jnp.shape(function.program.value)))


def _shape_of_normal_forces(normal: Any, source: str, gaps: dict[str, Any], plain: System) -> tuple[int, ...]:
    given: Any = normal if not source else gaps[source] if source in gaps else plain.constraints[source].function
    return jnp.shape(given.program.value if isinstance(given, Traced) else given)


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
