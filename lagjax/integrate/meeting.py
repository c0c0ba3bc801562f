"""What happens where the modes of elements change: contacts that touch are solved together, in three steps.

1. Impact: where a gap closes, velocities jump by the impulses of the contacts (`complementarity.py`).
2. Forces: with the accelerations W λ + b of all contacts, the forces λ obey for each gap that touches, and each sliding
   velocity on it

       0 ≤ λ_N ⊥ a_N ≥ 0        |λ_T| ≤ μ N        a_T = 0 or λ_T against it, of size μ N

   A gap stays closed where λ_N pushes, or where it does not open; a sliding velocity that is zero sticks where a_T is.
3. Velocities are moved onto what holds now.

With the rows A of all contacts, and the constraints that always hold, the response of the velocities to a unit of each
force is D: M D = Aᵀ + constraint forces, and W = A D.

Source: Glocker, *Set-Valued Force Laws*, §5, §6; Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*,
ch. 6-8.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.complementarity import (
    AtBound,
    ContactProblem,
    Forces,
    HeldByForces,
    HeldRows,
    Struck,
    pseudo_inverse,
    within_laws,
)
from lagjax.integrate.laws import CLOSED, FREE, LEANS, OPEN, STICKS, Laws, directions, lengths
from lagjax.integrate.results import Snapshot
from lagjax.integrate.stepping import FROM_NOTHING, Forced, rounding
from lagjax.jaxtools import stop_gradient
from lagjax.mechanics import mass_and_forcing, resolved, solve_saddle_point, with_first_order
from lagjax.numerics import independent_rows
from lagjax.system import InModes, Model, System, constraints, coordinates, model_of

# A gap is closed, and a velocity zero, below so many round-offs of the sizes that it is made of.
CLOSED_BELOW, STILL_BELOW = 16, 1000
# Ways along which gaps are looked at, in the smallest that counts; their bends are far smaller.
WAYS = 4.0 ** np.arange(11)
# A coordinate counts at least as heavy as this part of the heaviest, in √M_ii.
LIGHT = 1e-6
# A force is zero below so many round-offs of the forces in the motion.
NO_FORCE = 500
# What has let go, by its slack, opens at least by this part of its own response to that.
LET_GO = 0.01
# Where in the time of a motion its forces are looked at: not evenly, since these may be periodic.
LOOKED_AT = (0.0, 0.117, 0.241, 0.371, 0.487, 0.619, 0.743, 0.883, 1.0)
# Sliding in a plane ends at so many tolerances of the velocities in the motion, or at so many round-offs of them: below
# one tolerance steps jump over it, and the motion goes to and fro.
ENDS_AT, ENDS_AT_ROUND_OFFS = 3.0, 1000
# That of sliding which begins at rest, with twice this part of them, is no more than this.
BEGINS_AT = 1e-9


class AtMeeting(NamedTuple):
    """A state at which contacts meet, as vectors; `model`: with all contacts on; `given`: the modes before."""

    model: Model
    t: Float[Array, ""]
    x: Float[Array, " n"]
    u: Float[Array, " n"]
    given: InModes

    @property
    def state(self) -> tuple:
        """What functions of the user's take."""
        return self.t, self.model.tree(self.x), self.model.tree(self.u), self.given.params


class Met(NamedTuple):
    """Velocities and modes after a meeting; `found`: whether there are forces that obey the laws; `presses`: whether
    normal forces that press from one side are above zero; `allowed`: whether coefficients are what they may be."""

    v: PyTree[Float[Array, "..."]]
    modes: Int[Array, " k"]
    slack: Float[Array, " k"]
    found: Bool[Array, ""]
    presses: Bool[Array, ""] | bool = True
    allowed: Bool[Array, ""] | bool = True


class Decided(NamedTuple):
    """Which modes follow from the forces; `onto`: the velocities that contacts get; NaN, what they have; `sides`: those
    from which normal forces press, with `of_sides`, the slack of these."""

    modes: Int[Array, " k"]
    slack: Float[Array, " k"]
    onto: Float[Array, " k"]
    found: Bool[Array, ""]
    presses: Bool[Array, ""]
    allowed: Bool[Array, ""]
    sides: Int[Array, " ks"]
    of_sides: Float[Array, " ks"]


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

    def passed_on(self, a: Float[Array, " n"]) -> Float[Array, " n"]:
        """The accelerations by single forces, of those that give `a` and of contacts that pass them on to others."""
        own = jnp.diag(self.matrix)
        step = 1 / jnp.where(own > 0, own, jnp.inf)
        part = jnp.abs(self.matrix) * step[None]

        def next_to_next(_, found: Array) -> Array:
            return jnp.maximum(found, jnp.max(part * found[None], axis=1))

        of_rows = lax.fori_loop(0, own.size, next_to_next, jnp.abs(self.jacobian) @ jnp.abs(a))
        return jnp.maximum(jnp.abs(a), jnp.max(jnp.abs(self.response) * (step * of_rows)[:, None], axis=0))

    def sizes(self, known: Float[Array, "2 n"], a: Float[Array, " n"], span: Float[Array, ""]) -> Float[Array, "3 n"]:
        """How large coordinates and velocities become, where all share one size, measured in √M_ii times them; and the
        velocities that they have had, zero where nothing has moved.

        A motion that is at rest now, at x, has velocities of the size √(a x). What rests at zero, but for the round-off
        of accelerations `a` in the time `span`, has the size that a motion from there is given (`stepping.py`).
        """
        forced, free = jnp.max(self.root_mass * a), jnp.max(self.root_mass * jnp.abs(self.acceleration))
        least, faster = rounding(forced * jnp.stack([span**2, span])), jnp.maximum(free, forced)
        x, u = jnp.max(self.root_mass[None] * known, axis=1)
        u = jnp.where(u > least[1], u, 0.0)
        # What moves from zero goes as far as it comes until forces stop it.
        until = jnp.where(faster * span > u, u / jnp.where(faster > 0, faster, 1.0), span)
        starts, way = x <= least[0], u * until
        moved = jnp.maximum(u, jnp.sqrt(free * jnp.where(starts, way, x)))
        way = jnp.where(u > 0, jnp.maximum(way, least[0]), FROM_NOTHING[0] * forced * span**2)
        x = jnp.where(starts, way, x)
        u = jnp.maximum(u, jnp.sqrt(x * faster))
        light = LIGHT * jnp.max(self.root_mass)
        heavy = jnp.maximum(self.root_mass, jnp.where(light > 0, light, 1.0))
        return jnp.stack([x, u, moved])[:, None] / heavy[None]


class AsFound(NamedTuple):
    """The contacts as a meeting finds them, and below which size what they are made of is zero.

    - `closed` (k_N,), `fired` (k,): which gaps are closed; which modes end.
    - `gap` (k_N,): below which size a gap is zero.
    - `scale` (k, 2): the sizes of gaps, or ways, and of velocities; `forced` (k,): of the accelerations by forces that
      may cancel; `drift` (k,): how far the round-off of these may take a gap in the whole motion.
    - `velocity` (k,): still is what is slower; `ends` (k_T,): the speed at which sliding in a plane ends.
    - `below` (k_N,): how far gaps are below zero.
    """

    closed: Bool[Array, " kN"]
    fired: Bool[Array, " k"]
    gap: Float[Array, " kN"]
    scale: Float[Array, "k 2"]
    forced: Float[Array, " k"]
    drift: Float[Array, " k"]
    velocity: Float[Array, " k"]
    ends: Float[Array, " kT"]
    below: Float[Array, " kN"]


class ContactForces(NamedTuple):
    """Forces that obey the laws, if `found`, with the accelerations `a`; below which size either is zero, for each.

    `bound`: what has the bound of its law though it does not move (`complementarity.py`).
    """

    problem: ContactProblem
    bound: AtBound
    forces: Float[Array, " k"]
    a: Float[Array, " k"]
    no_force: Float[Array, " k"]
    no_acceleration: Float[Array, " k"]
    found: Bool[Array, ""]

    def stays(self) -> Bool[Array, " kN"]:
        """Which gaps that touch stay closed: those that are pushed, and those that do not open."""
        # Round-off may leave a force a little above zero: it pushes where it outweighs the acceleration.
        stays = (self.forces > self.problem.step * self.a) | (self.a <= self.no_acceleration)
        return self.problem.may_push & ~self.bound.lifted & stays[: self.problem.may_push.size]

    def sides(self) -> Float[Array, " kT"]:
        """The side, or direction, to which each sliding velocity slides on, or begins to slide; zero where it sticks.

        It begins against its friction, or as nothing holds it.
        """
        problem, normals = self.problem, self.problem.may_push.size
        most = problem.most(self.forces)
        # The force of friction is larger than its acceleration, and so says more about the direction.
        begins = directions(jnp.where(most > 0, -self.forces[normals:], self.a[normals:]), problem.partners)
        moves = lengths(self.a[normals:], problem.partners) > self.no_acceleration[normals:]
        return jnp.where(problem.given, problem.slides, jnp.where(moves, begins, 0.0))


class Meeting(eqx.Module):
    """Solves the contacts of a system in modes (`laws.py`) at one state; `rtol`, `forced`: those of the motion."""

    system: System
    laws: Laws
    rtol: Any = 1e-9
    forced: Forced | None = None

    def in_motion(self, rtol: Array, ts: Array, q: PyTree, v: PyTree, params: PyTree) -> "Meeting":
        """The same in a motion of this tolerance, over these times from this start."""
        rtol, ts, q, v, params = stop_gradient((rtol, ts, q, v, params))
        if not self.laws.rows:
            return Meeting(self.system, self.laws, rtol)
        given = self.laws.at_first(ts[0], params)
        times = ts[0] + np.array(LOOKED_AT, ts.dtype) * (ts[-1] - ts[0])
        rows = self._rows(self._at(ts[0], q, v, given))
        free = jax.vmap(lambda t: self._acceleration(self._at(t, q, v, given)))(times)
        forced = Forced(times, jax.vmap(rows.passed_on)(jnp.nan_to_num(free, posinf=0.0, neginf=0.0)))
        return Meeting(self.system, self.laws, rtol, stop_gradient(forced))

    def __call__(
        self, end: Snapshot, given: InModes, sizes: Float[Array, "2 n"], instant: Bool[Array, ""],
        begins: Bool[Array, ""],
    ) -> tuple[PyTree, Met, Int[Array, ""]]:  # fmt: skip
        """What happens at the end of a leg: q, and the first of the modes that end there, or are at an `instant`.

        Where a motion `begins` no mode ends, and gaps that close are left to their guards.
        """
        guards = self.laws.last(end.t, end.q, end.v, end.multipliers, given)
        slack = self.laws.slack(given)
        size = jnp.where(slack > 0, slack, 1.0)
        in_slacks = jnp.concatenate([guards / size, jnp.full(1, jnp.inf)])
        least = jnp.argmin(in_slacks)
        holds = jnp.concatenate([self.laws.holds(given.modes), jnp.zeros(guards.size - len(self.laws.rows), bool)])
        zero = jnp.where(holds, -slack / 2, 0.0)
        fired = (guards <= zero) | (in_slacks[:-1] == in_slacks[least]) & ~instant
        q, after = self.laws.acted(end.t, end.q, end.v, given)
        acts = after.modes[guards.size :] != given.modes[guards.size :]
        first = jnp.where(instant, guards.size + jnp.argmax(jnp.append(acts, True)), least)
        return q, self.met(end.t, q, end.v, after, fired & ~begins, sizes, ~begins), first.astype(jnp.int32)

    def met(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, fired: Bool[Array, " k"], sizes: Float[Array, "2 n"],
        impacts: Bool[Array, ""] | bool = True,
    ) -> Met:  # fmt: skip
        """The modes and velocities after a meeting. `fired`: the modes whose guards are zero; `sizes`: the largest
        coordinates and velocities of the motion. Without `impacts` gaps that close stay open."""
        at = self._at(t, q, v, given)
        rows = self._rows(at)
        forced, span = (jnp.zeros_like(at.x), jnp.zeros_like(t)) if self.forced is None else self.forced.around(t)
        sizes, moved = (known := rows.sizes(sizes, forced, span))[:2], known[2]
        contacts = stop_gradient(self._as_found(at, fired, rows.jacobian, sizes, moved))
        allowed = jnp.asarray(True)
        if impacts is not False and self.laws.normals:
            struck = self._struck(at, rows, contacts.closed)
            impulses = jnp.where(impacts, struck.impulses(), 0.0)
            at, allowed = at._replace(u=at.u + impulses @ rows.response), struck.allowed() | ~jnp.asarray(impacts)
        given, reach = self.laws.pressed(*at.state[:3], given, fired, sizes)
        at = at._replace(given=given)
        decided = self._decided(*stop_gradient((at, rows, contacts)))
        u = at.u + self._onto(at, rows, decided.onto) @ rows.response
        after = self.laws.in_rows(given, decided.modes, decided.sides)
        # The rates of states are those of the new velocities.
        u = resolved(at.model.of(after), t, at.x, u)
        slack = jnp.concatenate([decided.slack, reach, decided.of_sides, jnp.zeros(len(self.laws.sampled), u.dtype)])
        allowed = allowed & decided.allowed
        return Met(at.model.tree(u), after.modes, stop_gradient(slack), decided.found, decided.presses, allowed)

    def first(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> tuple[PyTree, Met]:
        """q and the modes that fit the start of a motion; gaps that close are left to their guards."""
        none = jnp.zeros(self.laws.guarded, bool)
        q, given = self.laws.acted(t, q, v, self.laws.at_first(t, params))
        sizes = stop_gradient(jnp.abs(jnp.stack([coordinates.flatten(y)[0] for y in (q, v)])))
        return q, self.met(t, q, v, given, none, sizes, impacts=False)

    def _at(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> AtMeeting:
        normals, tangents = self.laws.count
        modes = jnp.array([CLOSED] * normals + [STICKS] * tangents, int)
        model = with_first_order(model_of(self.system, t, q, v, self.laws.in_rows(given, modes)))
        return AtMeeting(model, t, *model.vectors(q, v), given)

    def _free(self, at: AtMeeting) -> Model:
        """The model with all gaps open."""
        return at.model.of(self.laws.in_rows(at.given, jnp.zeros(len(self.laws.rows), int)))

    def _places(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Which of the stacked constraint equations are those of contacts, and which always hold."""
        mine = np.array(self.laws.rows, int)
        return mine, np.setdiff1d(np.arange(model.m), mine)

    def _rows(self, at: AtMeeting) -> Rows:
        model, t, x, u, _ = at
        mine, always = self._places(model)
        every, linear = constraints.jacobian(model, t, x, u), mass_and_forcing(self._free(at), t, x, u)
        jacobian, held, mass = every[mine], every[always], linear.mass
        independent, still = independent_rows(held), jnp.zeros(always.size, x.dtype)
        # What has no inertia says nothing about the sizes of what has.
        light = model.form.first_order.mask(model.n) if model.form.first_order else np.zeros(model.n, bool)
        root_mass = jnp.where(light, 0.0, jnp.sqrt(jnp.max(jnp.abs(mass), axis=1)))
        loads = jnp.concatenate([jacobian, linear.forcing[None]])
        response, added = jax.vmap(lambda load: solve_saddle_point(mass, held, load, still, independent))(loads)
        return Rows(jacobian, response[:-1], jacobian @ response[:-1].T, added[:-1], root_mass, response[-1])

    def _acceleration(self, at: AtMeeting) -> Float[Array, " n"]:
        """The acceleration with all gaps open."""
        model, t, x, u, _ = at
        held, linear = (
            constraints.jacobian(model, t, x, u)[self._places(model)[1]],
            mass_and_forcing(self._free(at), t, x, u),
        )
        still = jnp.zeros(len(held), x.dtype)
        return solve_saddle_point(linear.mass, held, linear.forcing, still, independent_rows(held))[0]

    def _velocities(self, at: AtMeeting) -> Float[Array, " k"]:
        """The rates of gaps, and sliding velocities."""
        return constraints.velocity_residual(*at[:4])[self._places(at.model)[0]]

    def _as_found(
        self,
        at: AtMeeting,
        fired: Bool[Array, " k"],
        jacobian: Array,
        sizes: Float[Array, "2 n"],
        moved: Float[Array, " n"],
    ) -> AsFound:
        """The contacts before an impact; `jacobian` (k, n): A; `sizes`: of coordinates and velocities; `moved`: of
        velocities, zero where nothing has moved."""
        laws, (normals, _), t, rows = self.laws, self.laws.count, at.t, jnp.abs(jacobian)
        scale, forced, drift = rows @ sizes.T, jnp.zeros(len(rows), t.dtype), jnp.zeros(len(rows), t.dtype)
        if self.forced is not None:
            a, span = self.forced.around(t)
            forced = rows @ a
            drift = _round_offs(CLOSED_BELOW, rows @ jnp.max(self.forced.a, axis=0) * span**2)
        modes, slack, fired = (x[: len(laws.rows)] for x in (at.given.modes, jnp.abs(at.given.slack), fired))
        gaps, unevenness = self._gaps(at, jacobian[:normals], sizes[0])
        gap = jnp.maximum(_round_offs(CLOSED_BELOW, scale[:normals, 0]), CLOSED_BELOW * unevenness)
        closed = (modes == CLOSED)[:normals] | fired[:normals]
        # Also what forces close before the clock moves.
        at_once = jnp.finfo(t.dtype).eps * drift[:normals]
        zero = jnp.maximum(jnp.maximum(4 * gap, slack[:normals]), at_once)
        closed = closed | (jnp.abs(gaps) <= zero)
        # Where all velocities are zero whenever modes change, the slack of what has slid says how fast it was.
        slid = (jnp.abs(modes) == 1).at[:normals].set(False)
        before = jnp.where(slid, STILL_BELOW / CLOSED_BELOW * slack, 0.0)
        # What was held is still; and what slides, where its guard ends that, as near to zero as its time is known.
        still = laws.holds(modes) | slid & fired & ~self._in_planes
        reached = jnp.where(still, 2 * jnp.abs(self._velocities(at)), 0.0)
        velocity = jnp.maximum(jnp.maximum(_round_offs(STILL_BELOW, scale[:, 1]), before), reached)
        part = self._ends_at(t.dtype)
        ends = part * lengths((rows @ moved)[normals:], laws.partners)
        # Also where nothing has moved yet.
        return AsFound(
            closed, fired, gap, scale, forced, drift, velocity, jnp.where(ends > 0, ends, part), jnp.maximum(-gaps, 0.0)
        )

    def _gaps(self, at: AtMeeting, jacobian: Array, size: Float[Array, " n"]) -> tuple[Array, Array]:
        """The gaps, and how unevenly they grow over the smallest ways, by the round-off of what they are made of: of
        q + d - d with q near zero it is that of d."""
        t, _, _, params = at.state

        def gaps(x: Array) -> Array:
            every = [law.gaps(t, at.model.tree(x), params) for law in self.laws.normals]
            return jnp.concatenate([jnp.zeros(0, t.dtype), *every])

        found, near = gaps(at.x), _round_offs(CLOSED_BELOW, size) * jnp.cos(jnp.arange(size.size, dtype=t.dtype))
        x = at.x[None] + np.array(WAYS, t.dtype)[:, None] * near[None]
        straight = (x - at.x[None]) @ jacobian.T
        return found, jnp.max(jnp.abs(jax.vmap(gaps)(x) - found[None] - straight), axis=0, initial=0.0)

    def _ends_at(self, dtype) -> Float[Array, ""]:
        """At which part of the velocities in the motion sliding in a plane ends."""
        return jnp.maximum(jnp.asarray(ENDS_AT * self.rtol, dtype), ENDS_AT_ROUND_OFFS * jnp.finfo(dtype).eps)

    @property
    def _in_planes(self) -> np.ndarray:
        """Which rows slide in planes."""
        normals, _ = self.laws.count
        return np.concatenate([np.zeros(normals, bool), self.laws.in_planes])

    def _struck(self, at: AtMeeting, rows: Rows, closed: Bool[Array, " kN"]) -> Struck:
        """The contacts as an impact finds them."""
        normals, _ = self.laws.count
        c = self._velocities(at)
        still = STILL_BELOW * jnp.finfo(c.dtype).eps * (jnp.abs(rows.jacobian) @ jnp.abs(at.u))[:normals]
        # Forces that are no impulses of gaps do nothing in no time.
        by_gaps = np.array(self.laws.owners, int) >= 0
        mu = jnp.where(by_gaps, self._coefficients(at, c[normals:], sticking=False), 0.0)
        _, pressed_by = self._normal_forces(at, rows, jnp.zeros(rows.of_constraints.shape[1], c.dtype))
        return Struck(self.laws, at.given.params, rows.matrix, c, closed, still, mu, pressed_by)

    def _coefficients(self, at: AtMeeting, slips: Float[Array, " kT"], sticking: bool) -> Float[Array, " kT"]:
        """μ of sticking, or of sliding with these velocities."""
        found, normals, params = [slips[:0]], self.laws.count[0], at.given.params
        for law in self.laws.tangents:
            speeds = lengths(slips[law.at[0] - normals : law.at[1] - normals], law.partners)
            found.append(law.sticking(speeds, params) if sticking else law.kinetic(speeds, params))
        return jnp.concatenate(found)

    def _normal_forces(
        self, at: AtMeeting, rows: Rows, multipliers: Float[Array, " mb"]
    ) -> tuple[Float[Array, " kT"], Float[Array, "kT k"]]:
        """N of each sliding velocity as `constant + of_forces @ λ`; `multipliers`: of what always holds, at λ = 0."""
        t, q, v, params = at.state
        mine, always = self._places(at.model)
        by_springs = self.laws.forces(t, q, v, at.given)

        def of(forces: Float[Array, " k"]) -> Float[Array, " kT"]:
            held = multipliers + forces @ rows.of_constraints
            every = at.model.split(jnp.zeros(at.model.m, t.dtype).at[mine].set(forces).at[always].set(held))
            found = [law.normal_forces(t, q, v, every | by_springs, params) for law in self.laws.tangents]
            return jnp.concatenate([forces[:0], *found])

        zero = jnp.zeros(mine.size, t.dtype)
        return of(zero), jax.jacfwd(of)(zero)

    def _sliding(self, at: AtMeeting, contacts: AsFound) -> Float[Array, " kT"]:
        """The side, or direction, to which each sliding velocity slides; zero where it does not."""
        laws, (normals, _) = self.laws, self.laws.count
        modes, slack = (x[normals : len(laws.rows)] for x in (at.given.modes, at.given.slack))
        in_plane = 1.5 * jnp.where(modes == 1, jnp.maximum(contacts.ends, slack), contacts.ends)
        slow = jnp.where(laws.in_planes, in_plane, contacts.velocity[normals:])
        # What others held began to move as they let it: it is still, and moves as its own friction lets it.
        slow = jnp.where(modes == LEANS, 3 * contacts.ends, slow)
        slips = self._velocities(at)[normals:]
        return jnp.where(lengths(slips, laws.partners) > slow, directions(slips, laws.partners), 0.0)

    def _touching(self, at: AtMeeting, contacts: AsFound) -> Bool[Array, " kN"]:
        """Which gaps are closed and do not open."""
        normals, _ = self.laws.count
        slower = [jnp.broadcast_to(law.slower_than, law.at[1] - law.at[0]) for law in self.laws.normals]
        slower = jnp.maximum(jnp.concatenate([contacts.gap[:0], *slower]), contacts.velocity[:normals])
        return contacts.closed & (jnp.abs(self._velocities(at)[:normals]) <= slower)

    def _problem(self, at: AtMeeting, rows: Rows, touching: Bool[Array, " kN"], slides: Float[Array, " kT"]):
        """The complementarity problem of the forces at accelerations, and the rows that these hold."""
        model, t, x, u, _ = at
        mine, always = self._places(model)
        every, linear = constraints.acceleration_rows(model, t, x, u), mass_and_forcing(self._free(at), t, x, u)
        held, gamma = every.jacobian[always], every.gamma[always]
        a, multipliers = solve_saddle_point(linear.mass, held, linear.forcing, gamma, independent_rows(held))
        constant, of_forces = self._normal_forces(at, rows, multipliers)
        slips = self._velocities(at)[touching.size :]
        moving, resting = (self._coefficients(at, slips, sticking) for sticking in (False, True))
        mu = jnp.where(lengths(slides, self.laws.partners) > 0, moving, resting)
        free = rows.jacobian @ a - every.gamma[mine]
        both = np.concatenate(
            [np.zeros(0, bool), *(np.full(law.at[1] - law.at[0], law.both) for law in self.laws.tangents)]
        )
        problem = ContactProblem(rows.matrix, free, touching, of_forces, constant, mu, slides, self.laws.partners, both)
        return problem, HeldRows(rows.jacobian, held, multipliers, rows.of_constraints)

    def _contact_forces(self, at: AtMeeting, rows: Rows, contacts: AsFound) -> ContactForces:
        """The forces at accelerations."""
        problem, held = self._problem(at, rows, self._touching(at, contacts), self._sliding(at, contacts))
        # What has just let go, by its slack, is not closed where nothing pushes and nothing opens. It may open far more
        # slowly than by its own response, since others stay closed.
        let_go = contacts.fired & self.laws.holds(at.given.modes)
        # What it held, or what rests beside it, lets go with it.
        part = jnp.where(jnp.any(let_go), LET_GO, 1.0)

        def solution(bound: AtBound, forces: Forces) -> ContactForces:
            no_force = _no_force(problem, forces.forces, contacts)
            least = part * no_force
            least = jnp.where(let_go, LET_GO * jnp.abs(at.given.slack[: let_go.size]), least)
            a = problem.matrix @ forces.forces + problem.free
            return ContactForces(problem, bound, forces.forces, a, no_force, least / problem.step, forces.found)

        def holds(bound: AtBound, forces: Forces) -> HeldByForces:
            found = solution(bound, forces)
            closes = bound.lifted & (found.a < -found.no_acceleration)[: bound.lifted.size]
            begins = jnp.where(problem.given, 0.0, found.sides())
            return HeldByForces(self.laws.holds(self._modes(at, found)), found.no_force, closes, begins)

        return solution(*within_laws(problem, held, holds))

    def _modes(self, at: AtMeeting, solution: ContactForces) -> Int[Array, " kNT"]:
        """The modes of gaps and of sliding velocities that follow from forces."""
        laws, owners, stays, sides = self.laws, np.array(self.laws.owners, int), solution.stays(), solution.sides()
        rubs = jnp.where(owners >= 0, jnp.append(stays, True)[owners], laws.rubs(at.given.modes))
        slides = jnp.where(laws.in_planes, lengths(sides, laws.partners) > 0, sides).astype(int)
        rests = jnp.where(lengths(solution.bound.leans, laws.partners) > 0, LEANS, STICKS)
        # What slides without friction has derivatives by it.
        rests = jnp.where(laws.never_rubs(at.given.params), FREE, rests)
        tangents = jnp.where(rubs, jnp.where(slides != 0, slides, rests), FREE)
        return jnp.concatenate([jnp.where(stays, CLOSED, OPEN), tangents]).astype(at.given.modes.dtype)

    def _decided(self, at: AtMeeting, rows: Rows, contacts: AsFound) -> Decided:
        """The modes after a meeting, by the forces at accelerations."""
        laws, (normals, _) = self.laws, self.laws.count
        if not laws.rows:
            no_modes, nothing, yes = at.given.modes[:0], at.u[:0], jnp.asarray(True)
            return Decided(no_modes, nothing, nothing, yes, yes, yes, no_modes, nothing)
        solution = self._contact_forces(at, rows, contacts)
        sides = solution.sides()
        modes = self._modes(at, solution)
        holds, begins = laws.holds(modes), laws.in_planes & (modes[normals:] == 1) & ~solution.problem.given
        # What begins to slide in a plane needs a direction: it gets twice the speed at which it would end.
        ends_at, least = self._ends_at(at.u.dtype), ENDS_AT_ROUND_OFFS * jnp.finfo(at.u.dtype).eps
        slower = jnp.maximum(BEGINS_AT, least) / jnp.maximum(ends_at, BEGINS_AT)
        ends = jnp.where(begins, slower * contacts.ends, contacts.ends)
        released = (at.given.modes[normals : len(laws.rows)] == LEANS) & (jnp.abs(modes[normals:]) == 1)
        released = jnp.where(released & ~solution.problem.given, 0.0, jnp.nan)
        onto = jnp.concatenate([jnp.full(normals, jnp.nan), jnp.where(begins, 2 * ends * sides, released)])
        # A guard may begin as far below zero as it is: what rests is not zero, but its round-off.
        slips = jnp.abs(self._velocities(at)[normals:])
        slips = jnp.where(slips <= contacts.velocity[normals:], 2 * slips, 0.0)
        slowest = jnp.maximum(_round_offs(CLOSED_BELOW, contacts.scale[normals:, 1]), slips)
        slowest = jnp.where(laws.in_planes, ends, slowest)
        slowest = jnp.where(modes[normals:] == LEANS, contacts.ends * solution.bound.leans, slowest)
        nearest = jnp.where(solution.bound.lifted, contacts.gap + contacts.drift[:normals], contacts.gap)
        nearest = jnp.where(solution.problem.may_push, jnp.maximum(nearest, contacts.below), nearest)
        slack = jnp.where(holds, solution.no_force, jnp.concatenate([nearest, slowest]))
        # By its sign, that a guard rests.
        rests = jnp.concatenate([solution.bound.lifted, jnp.zeros(holds.size - normals, bool)])
        slack = jnp.where(rests, -slack, slack)
        # Of each normal force, not of both components of a plane.
        found, places = solution.problem.normal_forces(solution.forces), np.zeros(0, int)
        places = np.concatenate([places, *(np.arange(*law.at, 1 + law.plane) - normals for law in laws.sided)])
        both, pressed, of_sides = (
            np.asarray(solution.problem.both)[places],
            found[places],
            solution.no_force[normals:][places],
        )
        presses = jnp.all(both | (pressed >= -of_sides / 2))
        sides = jnp.where(both & (pressed < 0), -1, 1).astype(modes.dtype)
        onto = jnp.where(holds, 0.0, onto)
        allowed = jnp.all(solution.problem.coefficient >= 0)
        return Decided(modes, slack, onto, solution.found, presses, allowed, sides, of_sides)

    def _onto(self, at: AtMeeting, rows: Rows, wanted: Float[Array, " k"]) -> Float[Array, " k"]:
        """The impulses that give contacts the velocities `wanted`; NaN where they keep theirs."""
        if not self.laws.rows:
            return wanted
        on = jnp.isfinite(wanted)
        left = jnp.where(on, self._velocities(at) - jnp.where(on, wanted, 0.0), 0.0)
        matrix = stop_gradient(jnp.where(on[:, None] & on[None], rows.matrix, 0.0))
        return -pseudo_inverse(matrix) @ left


def _round_offs(count: float, x: Array) -> Array:
    """So many round-offs of x."""
    return count * jnp.finfo(x.dtype).eps * x


def _no_force(problem: ContactProblem, forces: Float[Array, " k"], contacts: AsFound) -> Float[Array, " k"]:
    """Below which size a force is zero."""
    normals, scale = problem.may_push.size, contacts.scale
    # The acceleration of a motion of this size and speed.
    faster = scale[:, 1] ** 2 / jnp.where(scale[:, 0] > 0, scale[:, 0], jnp.inf)
    accelerations = jnp.abs(problem.free) + jnp.abs(problem.matrix) @ jnp.abs(forces) + faster + contacts.forced
    found = NO_FORCE * jnp.finfo(forces.dtype).eps * problem.step * accelerations
    return jnp.concatenate([found[:normals], lengths(found[normals:], problem.partners)])
