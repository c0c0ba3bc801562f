"""What happens where the modes of elements change: contacts that touch are solved together, in three steps.

1. Impact: where a gap closes, velocities jump by the impulses of the contacts, until no gap closes any more.
2. Forces: of the gaps that are closed and do not open, those stay closed that have to push (`complementarity.py`), and
   of the sliding velocities that are zero, those stick whose friction can hold them.
3. Velocities are moved onto what holds now.

With the rows A of all contacts, and the constraints that always hold, the response of the velocities to a unit of each
force is D: M D = Aᵀ + constraint forces, and W = A D.

Impacts one after the other: always the gap that closes fastest, with its restitution, until none with a restitution
closes; what then still closes is stopped all at once. Simultaneous impacts: Newton's law for all at once,
0 ≤ Λ ⊥ γ' + e γ ≥ 0.

Source: Glocker, *Set-Valued Force Laws*, §6; Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*,
ch. 6-8.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.elements.complementarity import DEPENDENT, ContactProblem, directions, lengths, solved
from lagjax.integrate.elements.laws import CLOSED, FREE, OPEN, STICKS, Laws
from lagjax.integrate.trajectory.parts import Snapshot
from lagjax.jaxtools import stop_gradient
from lagjax.mechanics import mass_and_forcing, resolved, solve_saddle_point, with_first_order
from lagjax.numerics import independent_rows
from lagjax.system import InModes, Model, System, constraints, coordinates, model_of

# A gap is closed, and a velocity zero, below so many round-offs of the sizes that it is made of.
CLOSED_BELOW, STILL_BELOW = 16, 1000
# A coordinate counts at least as heavy as this part of the heaviest, in √M_ii.
LIGHT = 1e-6
# A force is zero below so many round-offs of the forces in the motion.
NO_FORCE = 500
# What has let go, by its slack, opens at least by this part of its own response to that.
LET_GO = 0.01
# Sliding in a plane ends at this part of the velocities in the motion, or at so many round-offs of them. Below some ten
# times rtol steps may jump over it: at 1e-9, 400 of them are rejected in place of 40, and at 1e-12 thousands.
ENDS_AT, ENDS_AT_ROUND_OFFS = 3e-8, 1000
# That of sliding which begins at rest, with twice this speed.
BEGINS_AT = 1e-9
# Impacts one after the other, at most: so many for each pair of gaps, and a few more.
MORE_IMPACTS = 8


class Met(NamedTuple):
    """Velocities and modes after a meeting; `found`: whether there are forces that obey the laws."""

    v: PyTree[Float[Array, "..."]]
    modes: Int[Array, " k"]
    slack: Float[Array, " k"]
    found: Bool[Array, ""]


class Decided(NamedTuple):
    """Which modes follow from the forces; `onto`: the velocities that contacts get; NaN, what they have."""

    modes: Int[Array, " k"]
    slack: Float[Array, " k"]
    onto: Float[Array, " k"]
    found: Bool[Array, ""]


class Rows(NamedTuple):
    """The rows of all contacts at one state, and how velocities respond to their forces.

    `of_constraints` (k, m_b): what each force adds to the multipliers of the constraints that always hold.
    `root_mass`: √M_ii; `acceleration`: that with all gaps open.
    """

    jacobian: Float[Array, "k n"]
    response: Float[Array, "k n"]
    matrix: Float[Array, "k k"]
    of_constraints: Float[Array, "k mb"]
    root_mass: Float[Array, " n"]
    acceleration: Float[Array, " n"]

    def sizes(self, known: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
        """How large coordinates and velocities become, where all share one size, measured in √M_ii times them.

        A motion that is at rest now, at x, has velocities of the size √(a x).
        """
        x, u = jnp.max(self.root_mass[None] * known, axis=1)
        u = jnp.maximum(u, jnp.sqrt(x * jnp.max(self.root_mass * jnp.abs(self.acceleration))))
        least = LIGHT * jnp.max(self.root_mass)
        heavy = jnp.maximum(self.root_mass, jnp.where(least > 0, least, 1.0))
        return jnp.stack([x, u])[:, None] / heavy[None]


class Meeting(eqx.Module):
    """Solves the contacts of a system in modes (`laws.py`) at one state."""

    system: System
    laws: Laws

    def __call__(
        self, end: Snapshot, given: InModes, sizes: Float[Array, "2 n"], instant: Bool[Array, ""]
    ) -> tuple[PyTree, Met, Int[Array, ""]]:
        """What happens at the end of a leg: q, and the first of the modes that end there, or are at an `instant`."""
        guards = self.laws.last(end.t, end.q, end.v, end.multipliers, given)
        size = jnp.where(given.slack > 0, given.slack, 1.0)[: guards.size]
        in_slacks = jnp.concatenate([guards / size, jnp.full(1, jnp.inf)])
        least = jnp.argmin(in_slacks)
        holds = jnp.concatenate([self.laws.holds(given.modes), jnp.zeros(guards.size - len(self.laws.rows), bool)])
        zero = jnp.where(holds, -given.slack[: guards.size] / 2, 0.0)
        fired = (guards <= zero) | (in_slacks[:-1] == in_slacks[least]) & ~instant
        q, after = self.laws.acted(end.t, end.q, end.v, given)
        acts = after.modes[guards.size :] != given.modes[guards.size :]
        first = jnp.where(instant, guards.size + jnp.argmax(jnp.append(acts, True)), least)
        return q, self.met(end.t, q, end.v, after, fired, sizes), first.astype(jnp.int32)

    def met(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, fired: Bool[Array, " k"], sizes: Float[Array, "2 n"],
        impacts: bool = True,
    ) -> Met:  # fmt: skip
        """The modes and velocities after a meeting. `fired`: the modes whose guards are zero; `sizes`: the largest
        coordinates and velocities of the motion. Without `impacts` gaps that close stay open."""
        laws, (normals, _) = self.laws, self.laws.count
        model = self._all_on(t, q, v, given)
        x, u = model.vectors(q, v)
        eps, rows = jnp.finfo(x.dtype).eps, self._rows(model, t, x, u, given)
        scale = jnp.abs(rows.jacobian) @ rows.sizes(sizes).T
        gaps = jnp.concatenate([law.gaps(t, q, given.params) for law in laws.normals] or [jnp.zeros(0, t.dtype)])
        closed = (
            (given.modes == CLOSED)[:normals]
            | fired[:normals]
            | (jnp.abs(gaps) <= 4 * CLOSED_BELOW * eps * scale[:normals, 0])
        )
        if impacts:
            u = u + self._impact(model, t, x, u, given, rows, stop_gradient(closed)) @ rows.response
        given, reach = laws.pressed(t, q, model.tree(u), given, fired, rows.sizes(sizes))
        decided = self._forces(model, t, x, u, given, rows, stop_gradient(closed), fired, stop_gradient(scale))
        u = u + self._onto(model, t, x, u, rows, decided.onto) @ rows.response
        slack = jnp.concatenate([decided.slack, reach, jnp.zeros(len(laws.sampled), x.dtype)])
        # The rates of states are those of the new velocities.
        after = laws.in_rows(given, decided.modes)
        u = resolved(model.of(after), t, x, u)
        return Met(model.tree(u), after.modes, stop_gradient(slack), decided.found)

    def first(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> tuple[PyTree, Met]:
        """q and the modes that fit the start of a motion; gaps that close are left to their guards."""
        none = jnp.zeros(self.laws.guarded, bool)
        q, given = self.laws.acted(t, q, v, self.laws.at_first(t, params))
        sizes = stop_gradient(jnp.abs(jnp.stack([coordinates.flatten(y)[0] for y in (q, v)])))
        return q, self.met(t, q, v, given, none, sizes, impacts=False)

    def _all_on(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> Model:
        normals, tangents = self.laws.count
        modes = jnp.array([CLOSED] * normals + [STICKS] * tangents, int)
        return with_first_order(model_of(self.system, t, q, v, self.laws.in_rows(given, modes)))

    def _rows(self, model: Model, t: Array, x: Array, u: Array, given: InModes) -> Rows:
        every, mine = constraints.jacobian(model, t, x, u), np.array(self.laws.rows, int)
        always = np.setdiff1d(np.arange(model.m), mine)
        linear = mass_and_forcing(self._free(model, given), t, x, u)
        mass = linear.mass
        jacobian, held = every[mine], every[always]
        independent = independent_rows(held)
        still = jnp.zeros(held.shape[0], x.dtype)
        # What has no inertia says nothing about the sizes of what has.
        light = model.form.first_order.mask(model.n) if model.form.first_order else np.zeros(model.n, bool)
        root_mass = jnp.where(light, 0.0, jnp.sqrt(jnp.max(jnp.abs(mass), axis=1)))
        every = jnp.concatenate([jacobian, linear.forcing[None]])
        response, added = jax.vmap(lambda row: solve_saddle_point(mass, held, row, still, independent))(every)
        return Rows(jacobian, response[:-1], jacobian @ response[:-1].T, added[:-1], root_mass, response[-1])

    def _free(self, model: Model, given: InModes) -> Model:
        """The model with all gaps open."""
        return model.of(self.laws.in_rows(given, jnp.zeros(len(self.laws.rows), int)))

    def _slopes(self, model: Model, t: Array, x: Array, u: Array) -> Array:
        return constraints.velocity_residual(model, t, x, u)[np.array(self.laws.rows, int)]

    def _coefficients(self, t: Array, q: PyTree, v: PyTree, params: PyTree, slips: Array, sticking: bool) -> Array:
        parts = []
        first = self.laws.count[0]
        for law in self.laws.tangents:
            own = slips[law.at[0] - first : law.at[1] - first]
            speeds = lengths(own, law.partners)
            parts.append(law.sticking(speeds, params) if sticking else law.kinetic(speeds, params))
        return jnp.concatenate([*parts, jnp.zeros(0, t.dtype)])

    def _impact(self, model, t: Array, x: Array, u: Array, given: InModes, rows: Rows, closed: Array) -> Array:
        """The impulses of the contacts."""
        laws, (normals, tangents) = self.laws, self.laws.count
        if not normals:
            return jnp.zeros(tangents, x.dtype)
        q, v = model.tree(x), model.tree(u)
        before = self._slopes(model, t, x, u)
        mu = self._coefficients(t, q, v, given.params, before[normals:], sticking=False)
        owners = np.array(laws.owners, int)
        still = STILL_BELOW * jnp.finfo(x.dtype).eps * (jnp.abs(rows.jacobian) @ jnp.abs(u))[:normals]

        def closing_at(c: Array) -> Array:
            return closed & (stop_gradient(c[:normals]) < -still)

        def restitution(closing: Array) -> Array:
            return jnp.concatenate([law.returned(closing[slice(*law.at)], given.params) for law in laws.normals])

        def at_once(c: Array, bounce: Array, closed: Array = closed) -> Array:
            """The impulses of all closed contacts together; `bounce`: e γ."""
            free = jnp.concatenate([c[:normals] + bounce, c[normals:]])
            problem = ContactProblem(
                rows.matrix, free, closed, self._of_contacts(x.dtype), jnp.zeros(tangents, x.dtype),
                jnp.where(owners >= 0, mu, 0.0), jnp.zeros(tangents, x.dtype), laws.partners,
            )  # fmt: skip
            return solved(problem).forces

        def alone(c: Array, i: Array, bounce: Array) -> Array:
            """The impulses of gap i."""
            if laws.in_planes.any():
                return at_once(c, -bounce, jnp.arange(normals) == i)
            return self._one(rows.matrix, c, i, bounce[i] - c[i], mu)

        if laws.impacts == "simultaneous":
            struck = jnp.any(closing_at(before))
            closing = jnp.where(closed, jnp.maximum(-before[:normals], 0.0), 0.0)
            return lax.cond(
                struck, lambda: at_once(before, -restitution(closing) * closing), lambda: jnp.zeros_like(before)
            )

        def next_impact(impulses: Array, _) -> tuple[Array, None]:
            c = before + rows.matrix @ impulses
            closing = jnp.maximum(-c[:normals], 0.0)
            e = restitution(closing)
            # One that is NaN strikes, so that the motion fails.
            struck = closing_at(c) & ~(stop_gradient(e) <= 0)
            i = jnp.argmax(jnp.where(struck, stop_gradient(closing), 0.0))
            return impulses + jnp.where(jnp.any(struck), alone(c, i, e * closing), 0.0), None

        most = normals * (normals + 1) + MORE_IMPACTS if normals > 1 else 1
        impulses, _ = lax.scan(next_impact, jnp.zeros_like(before), None, length=most)
        left = before + rows.matrix @ impulses
        rest = lax.cond(
            jnp.any(closing_at(left)), lambda: at_once(left, jnp.zeros(normals, x.dtype)), lambda: jnp.zeros_like(left)
        )
        return impulses + rest

    def _one(self, matrix: Array, c: Array, i: Array, jump: Array, mu: Array) -> Array:
        """The impulses of gap i alone, whose velocity changes by `jump`: see `contacts/impacts.py`."""
        normals, tangents = self.laws.count
        unit = jnp.zeros(normals + tangents, c.dtype).at[i].set(1.0)
        smooth = jump / matrix[i, i]
        if not tangents:
            return smooth * unit
        owners = np.array(self.laws.owners, int)
        j = normals + jnp.argmax(owners == i)
        n, k, h = matrix[i, i], matrix[i, j], matrix[j, j]
        after = c[j] + smooth * k
        det = n * h - k * k
        held_t = (-c[j] * n - jump * k) / jnp.where(det > 0, det, 1.0)
        held_n = (jump - k * held_t) / n
        most, side = mu[j - normals], jnp.sign(after)
        room = n - side * most * k
        slid_n = jump / jnp.where(room > 0, room, 1.0)
        sticks = (jnp.abs(held_t) <= most * held_n) & (det > DEPENDENT[c.dtype] * n * h) | (room <= 0)
        normal = jnp.where(sticks, held_n, slid_n)
        tangential = jnp.where(sticks, held_t, -side * most * slid_n)
        both = normal * unit + tangential * jnp.zeros_like(unit).at[j].set(1.0)
        return jnp.where(jnp.any(owners == i), both, smooth * unit)

    def _of_contacts(self, dtype) -> np.ndarray:
        """Which normal force belongs to each sliding velocity, (k_T, k)."""
        normals, tangents = self.laws.count
        found = np.zeros((tangents, normals + tangents), dtype)
        for j, owner in enumerate(self.laws.owners):
            if owner >= 0:
                found[j, owner] = 1.0
        return found

    def _forces(
        self, model: Model, t: Array, x: Array, u: Array, given: InModes, rows: Rows, closed: Array, fired: Array,
        scale: Array,
    ) -> Decided:  # fmt: skip
        """The modes after a meeting, by the forces at accelerations."""
        laws, (normals, _), partners, in_planes = self.laws, self.laws.count, self.laws.partners, self.laws.in_planes
        count = len(laws.rows)
        if not count:
            none = jnp.zeros(0, x.dtype)
            return Decided(given.modes[:0], none, none, jnp.asarray(True))
        model, t, x, u, given, rows = stop_gradient((model, t, x, u, given, rows))
        q, v, params = model.tree(x), model.tree(u), given.params
        every = constraints.acceleration_rows(model, t, x, u)
        mine = np.array(laws.rows, int)
        always = np.setdiff1d(np.arange(model.m), mine)
        linear = mass_and_forcing(self._free(model, given), t, x, u)
        held = every.jacobian[always]
        gamma, independent = every.gamma[always], independent_rows(held)
        a, multipliers = solve_saddle_point(linear.mass, held, linear.forcing, gamma, independent)
        free = rows.jacobian @ a - every.gamma[mine]
        slopes = self._slopes(model, t, x, u)
        eps = jnp.finfo(x.dtype).eps
        # Where all velocities are zero whenever modes change, the slack of what has slid says how fast it was.
        slid = jnp.where(jnp.abs(given.modes) == 1, given.slack, 0.0)[: slopes.size].at[:normals].set(0.0)
        still = STILL_BELOW * jnp.maximum(eps * scale[:, 1], slid / CLOSED_BELOW)
        slower = jnp.concatenate(
            [*(jnp.broadcast_to(law.slower_than, law.at[1] - law.at[0]) for law in laws.normals), jnp.zeros(0, x.dtype)]
        )
        touching = closed & (jnp.abs(slopes[:normals]) <= jnp.maximum(slower, still[:normals]))
        slips = slopes[normals:]
        by_motion = CLOSED_BELOW * eps * jnp.concatenate([scale[:normals, 0], scale[normals:, 1]])
        # Where sliding in a plane ends, also where nothing has moved yet.
        ends_at = max(ENDS_AT, ENDS_AT_ROUND_OFFS * eps) * lengths(scale[normals:, 1], partners)
        ends_at = jnp.where(ends_at > 0, ends_at, ENDS_AT)
        slid = given.modes[normals:count] == 1
        slow = 1.5 * jnp.where(slid, jnp.maximum(ends_at, given.slack[normals:count]), ends_at)
        slow = jnp.where(in_planes, slow, still[normals:])
        slides = jnp.where(lengths(slips, partners) > slow, directions(slips, partners), 0.0)
        given_side = lengths(slides, partners) > 0
        constant, of_forces = self._normal_forces(t, q, v, given, model, multipliers, rows, always)
        mu_slides, mu_sticks = (self._coefficients(t, q, v, params, slips, sticking) for sticking in (False, True))
        problem = ContactProblem(
            rows.matrix, free, touching, of_forces, constant, jnp.where(given_side, mu_slides, mu_sticks), slides,
            partners,
        )  # fmt: skip
        forces, found = solved(problem)
        accelerations = rows.matrix @ forces + free
        # The acceleration of a motion of this size and speed.
        faster = scale[:, 1] ** 2 / jnp.where(scale[:, 0] > 0, scale[:, 0], jnp.inf)
        slack = NO_FORCE * eps * problem.step * (jnp.abs(free) + jnp.abs(rows.matrix) @ jnp.abs(forces) + faster)
        slack = jnp.concatenate([slack[:normals], lengths(slack[normals:], partners)])
        # Where nothing pushes and nothing opens, a contact is closed; what has just let go, by its slack, is not. It
        # may open far more slowly than by its own response, since others stay closed.
        let_go = fired[:count] & laws.holds(given.modes)
        nothing = jnp.where(let_go, LET_GO * given.slack[:count], slack) / problem.step
        # Round-off may leave a force a little above zero: it pushes where it outweighs the acceleration.
        pushes = forces > problem.step * accelerations
        stays = touching & (pushes[:normals] | (accelerations[:normals] <= nothing[:normals]))
        normal_modes = jnp.where(stays, CLOSED, OPEN)
        # The force of friction is larger than its acceleration, and so says more about the direction.
        most = problem.coefficient * jnp.maximum(problem.normal_forces(forces), 0.0)
        moves = lengths(accelerations[normals:], partners) > nothing[normals:]
        starts = jnp.where(
            moves, directions(jnp.where(most > 0, -forces[normals:], accelerations[normals:]), partners), 0.0
        )
        side = jnp.where(given_side, slides, starts)
        one_mode = jnp.where(in_planes, lengths(side, partners) > 0, side).astype(int)
        owners = np.array(laws.owners, int)
        present = jnp.where(owners >= 0, jnp.concatenate([stays, jnp.ones(1, bool)])[owners], laws.rubs(given.modes))
        tangent_modes = jnp.where(present, jnp.where(one_mode != 0, one_mode, STICKS), FREE)
        modes = jnp.concatenate([normal_modes, tangent_modes]).astype(given.modes.dtype)
        begins = in_planes & (tangent_modes == 1) & ~given_side
        begins_at = max(BEGINS_AT, ENDS_AT_ROUND_OFFS * eps) / max(ENDS_AT, ENDS_AT_ROUND_OFFS * eps)
        ends_at = jnp.where(begins, begins_at * ends_at, ends_at)
        onto = jnp.concatenate([jnp.full(normals, jnp.nan), jnp.where(begins, 2 * ends_at * side, jnp.nan)])
        onto = jnp.where(laws.holds(modes), 0.0, onto)
        if_not_held = jnp.concatenate([by_motion[:normals], jnp.where(in_planes, ends_at, by_motion[normals:])])
        return Decided(modes, jnp.where(laws.holds(modes), slack, if_not_held), onto, found)

    def _normal_forces(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, model: Model, multipliers: Array, rows: Rows, always
    ) -> tuple[Array, Array]:
        """N of each sliding velocity as `constant + of_forces @ λ`."""
        constant, of_forces = [], []
        names = model.equation_names
        place = {names[i].split("[")[0]: k for k, i in reversed(list(enumerate(always)))}
        for law in self.laws.tangents:
            count, width = law.at[1] - law.at[0], 1 + law.plane
            if law.source in place:
                first = place[law.source]
                constant += [multipliers[first + i // width] for i in range(count)]
                of_forces += [rows.of_constraints[:, first + i // width] for i in range(count)]
                continue
            gaps = [normal for normal in self.laws.normals if normal.name == law.source]
            if not gaps:
                constant += [*law.normal_forces(t, q, v, self.laws.forces(t, q, v, given), given.params)]
            else:
                constant += [jnp.zeros((), t.dtype)] * count
            unit = np.eye(len(self.laws.rows))
            of_forces += [
                jnp.asarray(unit[gaps[0].at[0] + i // width] if gaps else 0 * unit[0], t.dtype) for i in range(count)
            ]
        if not constant:
            return jnp.zeros(0, t.dtype), jnp.zeros((0, len(self.laws.rows)), t.dtype)
        return jnp.stack(constant), jnp.stack(of_forces)

    def _onto(self, model: Model, t: Array, x: Array, u: Array, rows: Rows, wanted: Array) -> Array:
        """The impulses that give contacts the velocities `wanted`; NaN where they keep theirs."""
        if not self.laws.rows:
            return jnp.zeros(0, x.dtype)
        on = jnp.isfinite(wanted)
        left = jnp.where(on, self._slopes(model, t, x, u) - jnp.where(on, wanted, 0.0), 0.0)
        matrix = stop_gradient(jnp.where(on[:, None] & on[None], rows.matrix, 0.0))
        return -jnp.linalg.pinv(matrix, rtol=DEPENDENT[left.dtype]) @ left
