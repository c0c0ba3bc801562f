"""The laws of contacts, friction and sampled controls: what holds in which mode, and the guards at which modes end.

A gap is open (0) or closed (1): a closed one is a holonomic constraint. A sliding velocity is free (0), slides to one
side (1, -1), with a force -μ N, or sticks (2): then it is a velocity constraint. Or it rests since others hold it (3),
with a force of size μ N and a fixed direction (`complementarity.py`), that of its slack. Where others hold it no
more it begins to move, and the mode ends. A spring behind a gap is apart (0) or pressed (1), with a force.

A sliding velocity in a plane is two rows with one mode: it slides (1) with a force -μ N s/|s|, which has no limit at
s = 0. Its sliding ends at a speed δ, the slack of its mode, and begins with 2 δ in the direction of the acceleration: a
step that passes zero and meets the opposite force is then longer than what the method's tolerance lets through.

The guard of a mode is above zero as long as it lasts:

    open: the gap        closed: λ_N        slides: ± the sliding velocity, or |s| - δ        sticks: μ N - |λ_T|
    held by others: δ - |s|        apart: -m            pressed: m

A normal force that is a multiplier of a constraint presses from either side (1, -1), with friction μ |λ|: the guard is
± λ. One that is a function presses from one side, and its guard is N: where it ends, so does the motion. What
rests without friction, since μ or N is zero in the whole motion, is free.

A contact with a spring and a damper has the force F = k d + c d' at the depth d = -gap, while both d and F are above
zero. One function decides between the two modes, of the unit of d:

    m = d + (c/k) min(d', 0)        pressed while m > 0, apart while m < 0

since F has the sign of d + (c/k) d', and is above zero where d is and d' is. At m = 0 a contact that comes is pressed,
and a contact that goes has F = 0: accelerations are the same in both modes, so that none leads back to the other. For
k ~ d^½ and c ~ d^(3/2), Hertz's and Hunt and Crossley's, m goes through zero as steeply as d does, and F does not.

Source: Schwager & Pöschel, Granular Matter 9 (2007) 465.

With sampled controls, at the instants offset + k every a held output becomes what its controller says. The mode is the
number k of the next instant, and its guard the time until then: legs end at instants.

Source: Åström & Wittenmark, *Computer-Controlled Systems*, §2.3.
"""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import dtypes
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.results import HELD_BY_OTHERS, mode_in_words
from lagjax.jaxtools import is_traced, numpy_of, stop_gradient
from lagjax.system import InModes, State


def is_fixed(law) -> bool:
    """Whether a law is the same in all of a motion: a number, or a function of the parameters alone."""
    return not callable(law) or takes_of_coefficient(law) == ("params",)


def fixed(law, params: PyTree) -> Array:
    """The value of one that is."""
    return jnp.asarray(law(params) if callable(law) else law)


def coefficient(law, of: Array, params: PyTree) -> Array:
    """The coefficient for each of the speeds, or depths, `of`."""
    found = fixed(law, params) if is_fixed(law) else jax.vmap(lambda x: law(x, params))(of)
    return jnp.broadcast_to(jnp.asarray(found, of.dtype), of.shape)


def takes_of_coefficient(law: Callable, of: str = "speed") -> tuple[str, ...]:
    """What a coefficient takes: the parameters, or `of` before them."""
    known = getattr(law, "takes", None)
    if known is not None:
        return known
    needed = [x for x in inspect.signature(law).parameters.values() if x.default is x.empty]
    return ("params",) if len(needed) == 1 else (of, "params")


APART, PRESSED = 0, 1
# m is zero below so many round-offs of what it is made of; and where its guard was found to be zero.
ZERO_BELOW, AT_ZERO = 16, 1000


class Compliant(eqx.Module):
    """The springs and dampers behind the gaps of an element; `at`: their places among the modes."""

    name: str = eqx.field(static=True)
    gap: Callable
    stiffness: Any
    damping: Any
    at: tuple[int, int] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def forces(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> Float[Array, " k"]:
        """F of each, zero where it is apart."""
        depth, speed = self._depths(t, q, v, given.params)
        k, c = self._law(depth, given.params)
        return jnp.where(given.modes[slice(*self.at)] == PRESSED, k * depth + c * speed, 0.0)

    def push(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> tuple[Float[Array, " k"], PyTree]:
        """F, and the generalized force, like q."""
        _, back = jax.vjp(lambda q: jnp.ravel(self.gap(t, q, given.params)), q)
        forces = self.forces(t, q, v, given)
        return forces, back(forces)[0]

    def last(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> Float[Array, " k"]:
        """The guard of each mode."""
        m = self._pressed(t, q, v, given.params)
        return jnp.where(given.modes[slice(*self.at)] == PRESSED, m, -m)

    def after(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, fired: Bool[Array, " k"], sizes: Float[Array, "2 n"]
    ) -> tuple[Array, Float[Array, " k"]]:
        """The modes after a meeting, and how far one round-off may take m; `sizes`: of coordinates and velocities.

        Where m is zero within that, a guard that has fired ends its mode; else what comes, or stays, is pressed.
        """
        t, q, v, params = stop_gradient((t, q, v, given.params))
        depth, speed = self._depths(t, q, v, params)
        k, c = self._law(depth, params)
        slope = jax.jacobian(lambda x: jnp.ravel(self.gap(t, x, params)))(q)
        by_row = jnp.concatenate([jnp.reshape(x, (depth.size, -1)) for x in jax.tree.leaves(slope)], axis=1)
        gaps, rates = sizes @ jnp.abs(by_row).T
        slack = jnp.finfo(t.dtype).eps * (gaps + jnp.abs(depth) + c / jnp.where(k > 0, k, jnp.inf) * rates)
        m = self._pressed(t, q, v, params)
        now = given.modes[slice(*self.at)] == PRESSED
        unclear = jnp.abs(m) <= jnp.where(fired, AT_ZERO, ZERO_BELOW) * slack
        presses = jnp.where(unclear, jnp.where(fired, ~now, speed >= 0), m > 0)
        return jnp.where(presses, PRESSED, APART), ZERO_BELOW * slack

    def _depths(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> tuple[Array, Array]:
        """d and d'."""
        gap, rate = jax.jvp(lambda t, q: jnp.ravel(self.gap(t, q, params)), (t, q), (jnp.ones_like(t), v))
        return -gap, -rate

    def _law(self, depth: Array, params: PyTree) -> tuple[Array, Array]:
        # Above zero, where powers have derivatives; without a comparison, which would count as a kink of the force.
        depth = jnp.sqrt(depth**2 + jnp.finfo(depth.dtype).tiny)
        return coefficient(self.stiffness, depth, params), coefficient(self.damping, depth, params)

    def _pressed(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Array:
        """m."""
        depth, speed = self._depths(t, q, v, params)
        k, c = self._law(depth, params)
        return depth + c / jnp.where(k > 0, k, jnp.inf) * jnp.minimum(speed, 0.0)


# Instants within this many round-offs of a time are at that time.
AT_ONCE = 8


class Sampled(eqx.Module):
    """A controller with its instants; `place`: that of its mode."""

    name: str = eqx.field(static=True)
    controller: Callable
    every: Any
    offset: Any
    place: int = eqx.field(static=True)

    def instant(self, k: Int[Array, ""], t: Array, params: PyTree) -> Float[Array, ""]:
        """The time of the k-th instant."""
        every, offset = (coefficient(x, t, params) for x in (self.every, self.offset))
        return offset + k * every

    def first(self, t: Array, params: PyTree) -> Int[Array, ""]:
        """The number of the first instant that is not before t."""
        t, params = stop_gradient((t, params))
        every, offset = (coefficient(x, t, params) for x in (self.every, self.offset))
        return jnp.maximum(jnp.ceil((t - offset - self.slack(t, params)) / every), 0.0).astype(int)

    def acts(self, k: Int[Array, ""], t: Array, params: PyTree) -> Bool[Array, ""]:
        """Whether the k-th instant is at t, or before."""
        t, params = stop_gradient((t, params))
        return self.instant(k, t, params) - t <= self.slack(t, params)

    def slack(self, t: Array, params: PyTree) -> Float[Array, ""]:
        """How far apart round-off may take two times that are one."""
        t, params = stop_gradient((t, params))
        sizes = jnp.abs(t) + jnp.abs(coefficient(self.offset, t, params))
        return AT_ONCE * jnp.finfo(t.dtype).eps * (sizes + coefficient(self.every, t, params))


OPEN, CLOSED = 0, 1
FREE, STICKS, LEANS = 0, 2, HELD_BY_OTHERS
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
    whether each two of the sliding velocities are components in a plane, with one normal force. `both`: whether that
    presses from both sides; `side`: the places of these among the modes; None for those of contacts, and numbers.
    """

    name: str = eqx.field(static=True)
    sliding: Callable
    coefficient: Any
    static: Any
    normal: Any
    source: str = eqx.field(static=True)
    at: tuple[int, int] = eqx.field(static=True)
    plane: bool = eqx.field(static=True)
    both: bool = eqx.field(static=True, default=False)
    side: tuple[int, int] | None = eqx.field(static=True, default=None)

    def sides(self, modes: Int[Array, " k"]) -> Int[Array, " k"] | int:
        """The side from which each sliding velocity is pressed."""
        if self.side is None or not self.both:
            return 1
        return jnp.repeat(modes[slice(*self.side)], 1 + self.plane)

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
            found = fixed(self.normal, params) if self.side is None else self.normal(t, q, v, params)
        return jnp.repeat(jnp.ravel(jnp.asarray(found, t.dtype)), 2 if self.plane else 1)

    def friction(self, t: Array, q: PyTree, slip: Array, v: PyTree, forces: dict, given: InModes) -> Float[Array, " k"]:
        """The force along each sliding velocity, `slip`, while it slides or others hold it; else zero."""
        params, mode = given.params, given.modes[slice(*self.at)]
        side = jnp.where(jnp.abs(mode) == 1, mode, 0).astype(t.dtype)
        speed = self.speeds(slip) if self.plane else side * slip
        side = side * slip / speed if self.plane else side
        leans, pressed = mode == LEANS, self.normal_forces(t, q, v, forces, params) * self.sides(given.modes)
        mu = jnp.where(leans, self.sticking(speed, params), self.kinetic(speed, params))
        held = directions(given.slack[slice(*self.at)].astype(t.dtype), self.partners)
        return jnp.where(leans, held, -side) * mu * pressed

    def never_rubs(self, params: PyTree) -> Bool[Array, " k"]:
        """Which have no friction in the whole motion: no coefficient, or no normal force."""
        never, every = jnp.zeros(self.at[1] - self.at[0], bool), (self.coefficient, self.static)
        if all(map(is_fixed, every)):
            never = never | (fixed(every[0], params) == 0) & (fixed(every[self.static is not None], params) == 0)
        if self.normal is not None and self.side is None:
            never = never | jnp.repeat(jnp.ravel(fixed(self.normal, params)) == 0, 1 + self.plane)
        return never

    def kinetic(self, speed: Float[Array, " k"], params: PyTree) -> Float[Array, " k"]:
        """μ while it slides with this speed."""
        return coefficient(self.coefficient, speed, params)

    def sticking(self, speed: Float[Array, " k"], params: PyTree) -> Float[Array, " k"]:
        """μ while it sticks."""
        return coefficient(self.coefficient if self.static is None else self.static, jnp.zeros_like(speed), params)


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
        return len(self.rows) + sum(law.at[1] - law.at[0] for law in self.compliant) + self.two_sides

    @property
    def sided(self) -> tuple[Tangent, ...]:
        """What slides under normal forces that may fall below zero."""
        return tuple(law for law in self.tangents if law.side is not None)

    @property
    def two_sides(self) -> int:
        """The number of normal forces that may fall below zero."""
        return sum(law.side[1] - law.side[0] for law in self.sided if law.side)

    @property
    def kinds(self) -> tuple[str, ...]:
        """What each mode is one of."""
        gaps, slips = self.count
        springs = self.guarded - gaps - slips - self.two_sides
        sliding = ["sliding velocity" + " in a plane" * bool(x) for x in self.in_planes]
        last = ["spring"] * springs + ["side"] * self.two_sides + ["control"] * len(self.sampled)
        return *["gap"] * gaps, *sliding, *last

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
        sides = tuple(
            f"{law.name} normal" + (f"[{i}]" if n > 1 else "") for law in self.sided for i, n in _places(law.side)
        )
        return guarded + sides + tuple(law.name for law in self.sampled)

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
        sides = [law.name for law in self.sided for _ in _places(law.side)]
        return *gaps, *slips, *springs, *sides, *(law.name for law in self.sampled)

    def modes_in_words(self, modes) -> list[str]:
        """Each of these modes in a word."""
        return [mode_in_words(kind, int(mode)) for kind, mode in zip(self.kinds, modes)]

    def holds(self, modes: Int[Array, " k"]) -> Any:
        """Which of the normals and tangents are constraints in these modes, (..., k); in NumPy where they are known."""
        of_rows = modes[..., : len(self.rows)]
        return numpy_of(modes).where(np.arange(len(self.rows)) < self.count[0], of_rows == CLOSED, of_rows == STICKS)

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

    def never_rubs(self, params: PyTree) -> Bool[Array, " kT"]:
        """Which sliding velocities have no friction in the whole motion."""
        return jnp.concatenate([*(law.never_rubs(params) for law in self.tangents), jnp.zeros(0, bool)])

    def given(self, params: PyTree, modes: Int[Array, " k"], slack: Float[Array, " k"] | None = None) -> InModes:
        """The parameters in these modes; rows of modes, (..., k), give rows of the rest."""
        of_rows, mine = np.array(self.rows, int), np.zeros(self.equations, bool)
        mine[of_rows], place = True, np.zeros(self.equations, int)
        place[of_rows] = np.arange(of_rows.size)
        off = ~self.holds(modes)[..., place] & mine if of_rows.size else np.zeros((*modes.shape[:-1], mine.size), bool)
        none = np.zeros(modes.shape, dtypes.canonicalize_dtype(float))
        return InModes(params, modes, off, none if slack is None else slack)

    def in_rows(self, given: InModes, modes: Int[Array, " kNT"], sides: Int[Array, " ks"] | None = None) -> InModes:
        """The same with these modes of normals and tangents; and, if given, from these sides."""
        every = jnp.concatenate([modes, given.modes[len(self.rows) :]])
        if sides is not None:
            every = every.at[self.guarded - self.two_sides : self.guarded].set(sides)
        return self.given(given.params, every)

    def at_first(self, t: Array, params: PyTree) -> InModes:
        """The parameters at the start of a motion, with all gaps open."""
        instants = [jnp.reshape(law.first(t, params), 1) for law in self.sampled]
        first = jnp.zeros(self.guarded, int).at[self.guarded - self.two_sides :].set(1)
        return self.given(params, jnp.concatenate([first, *instants]))

    def all_closed(self) -> dict[str, Int[Array, " k"]]:
        """All gaps closed, by whether what can slide sticks or slides."""
        gaps, slips = self.count
        springs = self.guarded - gaps - slips - self.two_sides
        rest = [PRESSED] * springs + [1] * self.two_sides + [0] * len(self.sampled)
        return {words: jnp.array([CLOSED] * gaps + [mode] * slips + rest, int) for words, mode in ALL_CLOSED.items()}

    def numbers(self, t: Array, params: PyTree) -> list[tuple[str, Array, Array]]:
        """Numbers that laws bound, and that depend on parameters alone: what each is, and whether it may be that.

        Coefficients that depend on a speed are looked at where they are used (`Meeting.met`).
        """
        found = []

        def bounded(role: str, law: Any, least: float = 0.0, most: float = np.inf, above: bool = False):
            if law is None or not is_fixed(law):
                return
            value = fixed(law, params).astype(t.dtype)
            found.append((role, value, (value > least if above else value >= least) & (value <= most)))

        for law in self.normals:
            bounded(f"the restitution of '{law.name}'", law.restitution, most=at_most_one(t.dtype))
            bounded(f"slower_than of '{law.name}'", law.slower_than)
        for law in self.tangents:
            bounded(f"the coefficient of '{law.name}'", law.coefficient)
            bounded(f"the static coefficient of '{law.name}'", law.static)
            if law.normal is not None and law.side is None:
                bounded(f"the normal force of '{law.name}'", law.normal)
        for law in self.compliant:
            bounded(f"the stiffness of '{law.name}'", law.stiffness, above=True)
            bounded(f"the damping of '{law.name}'", law.damping)
        for law in self.sampled:
            largest = float(np.finfo(t.dtype).max)
            bounded(f"every of '{law.name}'", law.every, most=largest, above=True)
            bounded(f"offset of '{law.name}'", law.offset, -largest, largest)
        return found

    def allow(self, t: Array, params: PyTree) -> Bool[Array, ""]:
        """Whether all `numbers` are what laws allow."""
        found = [jnp.all(allowed) for _, _, allowed in self.numbers(t, params)]
        return jnp.all(jnp.stack([jnp.asarray(True), *found]))

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
            most = law.sticking(slips, params) * law.normal_forces(t, q, v, forces, params) * law.sides(given.modes)
            holds = most - lengths(jnp.ravel(multipliers[law.name]), law.partners)
            slack = given.slack[slice(*law.at)]
            slides = law.speeds(slips) - 2 * slack if law.plane else mode * slips
            rests = lengths(slack, law.partners) - lengths(slips, law.partners)
            moves = jnp.where(mode == FREE, 2.0, jnp.where(mode == LEANS, rests, slides))
            found.append(jnp.where(mode == STICKS, holds, moves))
        for law in self.compliant:
            found.append(law.last(t, q, v, given))
        for law in self.sided:
            assert law.side is not None
            force = law.normal_forces(t, q, v, forces, params)[:: 1 + law.plane]
            # What does not press at all, as without friction, presses from neither side.
            found.append(jnp.where(force == 0, 1.0, given.modes[slice(*law.side)] * force))
        return jnp.concatenate([*found, jnp.zeros(0, t.dtype)])

    def rests(self, given: InModes) -> Bool[Array, " k"]:
        """Which guards rest: of gaps at zero that others hold, and of what is free or held by others."""
        modes, (gaps, slips) = given.modes[: self.guarded], self.count
        place = np.arange(self.guarded)
        of_slips = (place >= gaps) & (place < gaps + slips)
        return jnp.where(place < gaps, given.slack[: self.guarded] < 0, of_slips & ((modes == FREE) | (modes == LEANS)))

    def slack(self, given: InModes) -> Float[Array, " k"]:
        """How far below zero the guard of each mode may be: its slack, or the size of that where it is a vector,
        or says by its sign that the guard rests."""
        rows, (normals, _) = len(self.rows), self.count
        tangents = given.slack[normals:rows]
        size = jnp.where(given.modes[normals:rows] == LEANS, lengths(tangents, self.partners), tangents)
        return jnp.abs(given.slack).at[normals:rows].set(size)[: self.guarded]

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

    def acting(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes) -> dict[str, Array]:
        """The forces of elements by name, besides those of gaps: F of what is compliant, and friction."""
        found = self.forces(t, q, v, given)
        for law in self.tangents:
            slides, holds = jnp.abs(given.modes[slice(*law.at)]) == 1, multipliers[law.name]
            rubs = law.friction(t, q, law.slips(t, q, v, given.params), v, multipliers | found, given)
            found[law.name] = jnp.where(slides, rubs, jnp.ravel(holds)).reshape(jnp.shape(holds))
        return found

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
            # What no clock has is refused at the start of the motion.
            runs = [law.instant(1, ends[1], params) > law.instant(0, ends[1], params) for law in self.sampled]
            counted = [law.first(ends[1], params) - law.first(ends[0], params) for law in self.sampled]
            counted = [jnp.where(ticks, count, 0) for ticks, count in zip(runs, counted)]
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


def lengths(x: Float[Array, " k"], partners: np.ndarray) -> Float[Array, " k"]:
    """|x|: of each number by itself, or of both components of a plane; the derivative at zero is zero."""
    in_plane = partners != np.arange(x.size)
    if not in_plane.any():
        return jnp.abs(x)
    square = x**2 + x[partners] ** 2
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return jnp.where(in_plane, root, jnp.abs(x))


def directions(x: Float[Array, " k"], partners: np.ndarray) -> Float[Array, " k"]:
    """x / |x|: the sign of a number, the direction in a plane; zero at zero."""
    size = lengths(x, partners)
    return x / jnp.where(size > 0, size, 1.0)


def at_most_one(dtype) -> float:
    """The largest restitution, one but for round-off."""
    return 1 + 64 * float(jnp.finfo(dtype).eps)


def _places(at: tuple[int, int] | None) -> list[tuple[int, int]]:
    """The places within a law, each with how many there are."""
    count = 0 if at is None else at[1] - at[0]
    return [(i, count) for i in range(count)]
