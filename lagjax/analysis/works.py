"""The works of all sources along a motion: the motion is integrated again, with outputs at the nodes of a quadrature.

The quadrature is refined until it is more accurate than the motion.

Source: Piessens et al., *QUADPACK* (1983), §2.2.
"""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.integrate import (
    ENDED_WELL,
    HybridTrajectory,
    Masked,
    Trajectory,
    WithElements,
    integrate,
    is_among,
    message,
)
from lagjax.jaxtools import compiled
from lagjax.mechanics import of_states, sees_time
from lagjax.numerics import quadrature
from lagjax.system import InModes, Model, System, constraints, given_in, model_of

FORCE, DISSIPATION, STATES, TIME = "force", "dissipation", "states", "explicit time"
# How often inaccurate intervals are halved, and the most intervals.
HALVINGS, MOST_INTERVALS = 12, 10_000
# The fewest outputs of a motion that is integrated again. A few hundred short steps are soon made, and a program of
# another length, as for other parameters with more steps, compiles as long as that of the motion.
ROOM = 256
# The outer nodes of an interval are two thousandths of it from its ends.
APART = 2e3


class Work(NamedTuple):
    """The work that one source does on a motion, at every output.

    `power`, like v: by coordinate, `[L]/[t]`; `work`, like v: its integral from the first output on, `[L]`. Those of
    explicit time, which belongs to no coordinate, are (T,). `total` (T,): the work summed over the coordinates.
    """

    power: PyTree[Float[Array, "T ..."]]
    work: PyTree[Float[Array, "T ..."]]
    total: Float[Array, " T"]


class InPhases(NamedTuple):
    """In which phase each row is, and the modes of elements as functions take them; None without elements."""

    phase: np.ndarray
    given: InModes | None = None


class Motion:
    """One computed motion, in NumPy arrays: its instants, the phase of each, and the instants of its switches.

    `t`, `q`, `v`, `multipliers`, `where`: at the outputs, and at the end if it lies `beyond` them. `systems`: those
    whose forces are accounted for, one per phase; `forward`: 1, or -1 if time decreases. `sources`: by name the size
    of each power. `switch_times` (S,), and `entered` (S + 1,): the phases, with modes of elements, in their order.
    """

    def __init__(self, trajectory: Trajectory, accounted):
        self.trajectory, self.systems, self.params = trajectory, accounted.phases, trajectory.params
        # The number of outputs when the motion is integrated again.
        self.room = 0
        rows, end = jax.tree.map(np.asarray, (trajectory.rows(), trajectory.end))
        states = [x.reshape(len(x), -1) for x in jax.tree.leaves((rows["q"], rows["v"]))]
        reached = np.all(np.isfinite(np.concatenate(states, axis=1)), axis=1)
        if not reached[:1].all():
            raise ValueError(
                f"the motion did not get beyond its start: {message(trajectory.result)}\nFix: see traj.result."
            )
        count = int(np.argmin(reached)) if not reached.all() else len(reached)
        rows = jax.tree.map(lambda x: x[:count], rows)
        self.forward = -1.0 if trajectory.t[-1] < trajectory.t[0] else 1.0
        self.beyond = bool(self.forward * (end.t - rows["t"][-1]) > 0)
        if self.beyond:
            last = {"t": end.t, "q": end.q, "v": end.v, "multipliers": end.multipliers}
            if isinstance(trajectory, HybridTrajectory):
                last |= {"phase": np.int32(trajectory.last_phase()), "modes": trajectory.modes_entered()[-1]}
            rows = jax.tree.map(lambda x, y: np.concatenate([x, y[None].astype(x.dtype)]), rows, last)
        self.t, self.q, self.v, self.multipliers = (rows[name] for name in ("t", "q", "v", "multipliers"))
        self.where = InPhases(rows.get("phase", np.zeros(len(self.t), int)))
        self.switches, self.switch_times, self.entered = None, np.zeros(0), InPhases(np.zeros(1, int))
        if isinstance(trajectory, HybridTrajectory):
            self.switches, count = trajectory.switches, len(trajectory.switches)
            self.switch_times, to = np.asarray(self.switches.t)[:count], np.asarray(self.switches.to)[:count]
            self.entered = InPhases(np.array([int(trajectory.system.first), *to]))
            if trajectory.modes is not None:
                self.where = self.where._replace(given=accounted.given(None, rows["modes"]))
                self.entered = self.entered._replace(given=accounted.given(None, trajectory.modes_entered()))
        self.sources: dict[str, int] = {}
        self.models = model_of(accounted, *self._at(0), self.params).phases
        for model in self.models:
            self.sources |= _sources(model)

    def _at(self, row):
        return jax.tree.map(lambda x: x[row], (self.t, self.q, self.v))

    def energies(self) -> "Energies":
        """The energies at each instant, by the system of its phase."""
        return self._energies(self.where.phase, self.t, self.q, self.v)

    def _energies(self, phase, *state):
        found = Energies(*(np.full(len(phase), np.nan, self.t.dtype) for _ in Energies._fields))
        for i in np.unique(phase):
            values = _energies(self.models[i], *state)
            found = Energies(*(np.where(phase == i, new, old) for new, old in zip(values, found)))
        return found

    def works(self, allowed) -> tuple[dict[str, Work], float]:
        """The work of each source, and the sum of the estimated errors of the integrals, which may exceed `allowed`."""
        powers = self._powers(self.where, self.t, self.q, self.v, self.multipliers)
        works, error = self._integrated(allowed) if len(self.t) > 1 and self.sources else (powers, 0.0)
        return {name: self._work(name, powers[name], works[name]) for name in self.sources}, error

    def _powers(self, where: InPhases, t, q: PyTree, v: PyTree, multipliers: PyTree):
        """The powers by source, (rows, n)."""
        powers = {name: np.zeros((len(t), size), self.t.dtype) for name, size in self.sources.items()}
        for i in np.unique(where.phase):
            model = self.models[i]
            # Other phases have other multipliers.
            of_phase = {name: multipliers[name] for name in model.zero_multipliers()}
            for name, power in _powers(model, t, q, v, of_phase, where.given).items():
                powers[name] = np.where((where.phase == i)[:, None], power, powers[name])
        return powers

    def _integrated(self, allowed):
        """The works until each instant, (T, n) by source, and the sum of their errors."""
        knots = self._knots()
        ends, sums, errors = self.integrals(knots, lambda a, b: self._at_nodes(self.again(a, b)), allowed)
        order, names = np.argsort(self.forward * ends), list(self.sources)
        until = np.concatenate([np.zeros((1, sums.shape[1])), np.cumsum(sums[order], axis=0)])
        place = np.searchsorted(self.forward * ends[order], self.forward * self.t, side="right")
        columns = np.cumsum([0, *self.sources.values()])
        works = {name: until[place, low:high] for name, low, high in zip(names, columns, columns[1:])}
        return works, float(np.sum(errors))

    def _at_nodes(self, rows):
        # As many as there are outputs, for which one program serves.
        count = len(rows[1])
        powers = self._powers(
            *jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], self.room - count, 0)]), rows)
        )
        return np.concatenate([powers[name][:count] for name in self.sources], axis=1)

    def integrals(self, knots, at_nodes, allowed):
        """The ends (m,), integrals (m, k) and errors (m,) of the intervals between knots, halved until accurate.

        `at_nodes(a, b)`: the k functions at the nodes of the intervals from a to b, one after the other.
        """
        apart = np.abs(np.diff(knots)) > self._shortest()
        a, b = self._cut(knots[:-1][apart], knots[1:][apart])
        done, span = [], abs(float(knots[-1] - knots[0]))
        for halving in range(HALVINGS + 1):
            rows = at_nodes(a, b)
            sums, errors, noise = quadrature.integrals(rows.reshape(len(a), len(quadrature.NODES), -1), a, b)
            good = errors <= np.maximum(allowed * np.abs(b - a) / span, noise)
            good |= np.abs(b - a) < 2 * self._shortest()
            if halving == HALVINGS or 2 * np.sum(~good) > MOST_INTERVALS:
                good[:] = True
            done.append((b[good], sums[good], errors[good]))
            if good.all():
                break
            middle = 0.5 * (a + b)[~good]
            a, b = np.concatenate([a[~good], middle]), np.concatenate([middle, b[~good]])
        return tuple(np.concatenate(x) for x in zip(*done))

    def between(self, t0: float, t1: float):
        """The instants between two times, these included, and the times at which forces may jump; from t0 to t1."""
        low, high = sorted((t0, t1))
        inside = np.unique([low, high, *(t for t in self._knots() if low < t < high)]).astype(self.t.dtype)
        return inside if t1 >= t0 else inside[::-1]

    def _knots(self):
        """The instants, and the times between them at which forces may jump."""
        jumps = self.trajectory.asked.jump_ts
        jumps = [] if jumps is None else np.asarray(jumps)
        low, high = sorted((self.t[0], self.t[-1]))
        more = [t for t in (*self.switch_times, *jumps) if low < t < high]
        return self.forward * np.unique(self.forward * np.concatenate([self.t, np.asarray(more, self.t.dtype)]))

    def _shortest(self):
        """The shortest interval whose nodes can be told apart."""
        return APART * np.finfo(self.t.dtype).eps * np.max(np.abs(self.t))

    def _cut(self, a, b):
        """Cut the intervals into about as many pieces as the motion had steps, if there are fewer."""
        steps = int(self.trajectory.stats["num_accepted_steps"])
        span = np.sum(np.abs(b - a))
        pieces = np.maximum(1, np.ceil(steps * np.abs(b - a) / span)).astype(int)
        cuts = [np.linspace(x, y, n + 1) for x, y, n in zip(a, b, pieces)]
        return np.concatenate([c[:-1] for c in cuts]), np.concatenate([c[1:] for c in cuts])

    def again(self, a, b):
        """Where they are, times, positions, velocities and multipliers at the nodes of intervals, integrated again."""
        t = quadrature.nodes(a, b).ravel()
        ts = self._with_others(t)
        traj, first = self.trajectory, self._at(0)[1:]
        rtol, atol = (np.asarray(x) for x in traj.tolerance)
        settings = traj.asked._asdict() | {"rtol": tuple(rtol), "atol": None if atol.ndim == 2 else tuple(atol)}
        if traj.asked.stepsize_controller is not None:
            del settings["max_step"], settings["jump_ts"]
        if isinstance(traj, HybridTrajectory) and traj.modes is None:
            settings["start"] = traj.system.names[self.entered.phase[0]]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            again = integrate(traj.system, *first, traj.params, ts=ts, throw=False, estimate_error=False, **settings)
        if not is_among(again.result, ENDED_WELL):
            raise ValueError(
                f"the motion could not be integrated again between its outputs: {message(again.result)}\n"
                "Usual cause: a motion that only just succeeds at its tolerance.\nFix: a tighter or looser rtol."
            )
        rows, place = again.rows(), np.searchsorted(self.forward * ts, self.forward * t)
        rows = jax.tree.map(lambda x: np.asarray(x)[place], {name: rows[name] for name in ("q", "v", "multipliers")})
        where = self._where(np.repeat(0.5 * (a + b), len(quadrature.NODES)))
        return where, t, rows["q"], rows["v"], rows["multipliers"]

    def _with_others(self, t):
        """These times in order, the first and last instant, and others: up to a length that one program serves."""
        self.room = max(self.room, ROOM, 2 ** (len(t) + 1).bit_length())
        others = np.linspace(self.t[0], self.t[-1], self.room - len(t), dtype=self.t.dtype)
        return self.forward * np.unique(self.forward * np.concatenate([t, others]))

    def _where(self, t) -> InPhases:
        """The phase and modes at times other than those of switches."""
        place = np.searchsorted(self.switch_times, t, side="right")
        return jax.tree.map(lambda x: np.asarray(x)[place], self.entered)

    def switches_until(self, row: int) -> int:
        """How many switches precede an instant: an output at the time of a switch is before it, an end after it."""
        side = "right" if self.beyond and row == len(self.t) - 1 else "left"
        return int(np.searchsorted(self.switch_times, self.t[row], side=side))

    def jumps(self) -> np.ndarray:
        """The jump of the Jacobi integral at each switch."""
        if self.switches is None or not len(self.switch_times):
            return np.zeros(0, self.t.dtype)
        s = self.switches
        before, after = jax.tree.map(lambda x: np.asarray(x)[: len(s)], ((s.q, s.v), (s.q_after, s.v_after)))
        phase = self.entered.phase
        h_before = self._energies(phase[:-1], self.switch_times, *before).h
        return self._energies(phase[1:], self.switch_times, *after).h - h_before

    def ways(self) -> tuple[str, ...]:
        """The phase before and after each switch, in words."""
        if self.switches is None:
            return ()
        if self.entered.given is not None:
            return tuple(self.switches.ways[i] for i in np.asarray(self.switches.way)[: len(self.switch_times)])
        names = [self.switches.names[i] for i in self.entered.phase]
        return tuple(f"{x} -> {y}" for x, y in zip(names, names[1:]))

    def elements(self) -> tuple[str, ...]:
        """The names of the modes of elements, those of a vector once."""
        laws = self.laws
        return () if laws is None else tuple(law.name for law in (*laws.normals, *laws.tangents, *laws.compliant))

    @property
    def laws(self) -> Any:
        """The laws of the elements, if there are any."""
        return getattr(self.trajectory.system, "laws", None)

    def element_of_switches(self) -> list[str]:
        """The element whose mode ended at each switch, a contact's friction counted to the contact."""
        if self.switches is None or self.laws is None:
            return []
        return [self.laws.elements[i] for i in np.asarray(self.switches.way)[: len(self.switch_times)]]

    def _work(self, name: str, power, work):
        total = np.sum(work, axis=1)
        if name == TIME:
            return Work(power[:, 0], total, total)
        return Work(*(self.models[0].tree(np.asarray(x)) for x in (power, work)), total)


class Energies(NamedTuple):
    """The Jacobi integral, T₂, V = -L at v = 0, and the size of the terms of h, (rows,)."""

    h: np.ndarray
    kinetic: np.ndarray
    potential: np.ndarray
    size: np.ndarray


@compiled
def _energies(model: Model, t, q: PyTree, v: PyTree):
    """The `Energies` at each of a batch of states."""

    def at(t, q: PyTree, v: PyTree):
        x, u = model.vectors(q, v)
        energy = jax.value_and_grad(model.lagrangian, argnums=2)
        (value, p), (rest, p_at_rest) = energy(t, x, u), energy(t, x, jnp.zeros_like(u))
        power = u @ p
        return power - value, 0.5 * u @ (p - p_at_rest), -rest, abs(power) + abs(value)

    return jax.vmap(at)(t, q, v)


def _sources(model: Model) -> dict[str, int]:
    """The sources of work in a system, and the size of each power."""
    system, n = model.system, model.n
    own = system.force.force if isinstance(system.force, WithElements) else system.force
    found = {FORCE: n} if own is not None else {}
    found |= {DISSIPATION: n} if system.dissipation is not None else {}
    found |= {STATES: n} if system.states else {}
    found |= {TIME: 1} if sees_time(system.lagrangian, model) else {}
    if isinstance(system.force, WithElements):
        found |= {element_in_words(law.name): n for law in (*system.force.tangents, *system.force.compliant)}
    return found | {_held_by(system, name): n for name in system.constraints}


def _held_by(system: System, name: str) -> str:
    """The name of a constraint among the sources."""
    return element_in_words(name) if is_element(system, name) else constraint_in_words(name)


def is_element(system: System, name: str) -> bool:
    """Whether a constraint is that of an element."""
    return isinstance(system.constraints[name].function, Masked)


@compiled
def _powers(model: Model, t, q: PyTree, v: PyTree, multipliers: PyTree, given: InModes | None):
    """The power of each source at each of a batch of states, (rows, n)."""
    system, timed = model.system, sees_time(model.system.lagrangian, model)
    of_all, is_split = model, isinstance(system.force, WithElements)

    def at(t, q: PyTree, v: PyTree, multipliers: PyTree, row: InModes | None):
        model = of_all if row is None else of_all.of(given_in(row, of_all.params.params))
        (x, u), stacked, powers = model.vectors(q, v), model.stacked(multipliers), {}
        if is_split:
            if system.force.force is not None:
                powers[FORCE] = model.vector(system.force.force(t, q, v, model.params.params)) * u
            for name, force in system.force.by_element(t, q, v, multipliers, model.params).items():
                powers[element_in_words(name)] = model.vector(force) * u
        elif system.force is not None:
            powers[FORCE] = model.force(t, x, u, stacked) * u
        if system.dissipation is not None:
            powers[DISSIPATION] = -jax.grad(model.dissipation, argnums=2)(t, x, u) * u
        if system.states:
            # What L stores in a state is not given by a force: as for time, -∂L/∂z z'.
            power = -jax.grad(model.lagrangian, argnums=1)(t, x, u) * u
            powers[STATES] = jnp.where(of_states(model), power, 0.0)
        if timed:
            powers[TIME] = -jax.grad(model.lagrangian)(t, x, u)[None]
        rows = constraints.jacobian(model, t, x, u)
        for name in system.constraints:
            key, held = _held_by(system, name), jnp.where(model.belongs_to(name), stacked, 0.0) @ rows
            powers[key] = powers.get(key, 0.0) + held * u
        return powers

    return jax.vmap(at)(t, q, v, multipliers, given)


def constraint_in_words(name: str) -> str:
    """The name of a constraint among the sources."""
    return f"constraint '{name}'"


def element_in_words(name: str) -> str:
    """The name of the force of an element among the sources."""
    return f"element '{name}'"
