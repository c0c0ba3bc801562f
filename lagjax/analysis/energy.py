"""The energy of a motion and the works of all sources along it: what changed it.

Along any motion of `d/dt ∂L/∂v - ∂L/∂q = Q - ∂R/∂v + Aᵀ λ` the Jacobi integral h = v·p - L changes by

    dh/dt = Q·v - (∂R/∂v)·v + λ·(A v) - ∂L/∂t

one term each for the force, the dissipation, the constraints and explicit time. Their works are integrated separately,
without using h, so that the remainder of the balance, the closure, tests the motion, the multipliers and the forces
together. A work is the integral of a power: the motion is integrated again, by the same method with the same
tolerances, with outputs at the nodes of a quadrature, which is refined until it is more accurate than the motion.

Source: Goldstein, *Classical Mechanics*, Eq. (2.53), (2.54) and §2.7; Piessens et al., *QUADPACK* (1983), §2.2.
"""

import warnings
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.display import columns
from lagjax.display import plots as plot
from lagjax.integrate import (
    ENDED_WELL,
    HybridTrajectory,
    Masked,
    Trajectory,
    WithElements,
    integrate,
    is_among,
    message,
    traced_phases,
)
from lagjax.jaxtools import compiled
from lagjax.mechanics import of_states, sees_time
from lagjax.numerics import quadrature
from lagjax.refusals import must_be, must_be_single, must_have_values
from lagjax.system import (
    Hybrid,
    InModes,
    Model,
    State,
    System,
    check_system,
    constraints,
    coordinates,
    given_in,
    model_of,
)

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
    """In which phase each row is, and the modes of elements; None without elements."""

    phase: np.ndarray
    modes: np.ndarray | None = None


class Motion:
    """One computed motion, in NumPy arrays: its instants, the phase of each, and the instants of its switches.

    `t`, `q`, `v`, `multipliers`, `where`: at the outputs, and at the end if it lies `beyond` them. `systems`: those
    whose forces are accounted for, one per phase; `forward`: 1, or -1 if time decreases. `sources`: by name the size
    of each power. `switch_times` (S,), and `entered` (S + 1,): the phases, with modes of elements, in their order.
    """

    def __init__(self, trajectory: Trajectory, accounted):
        self.trajectory, self.systems, self.params = trajectory, accounted.phases, trajectory.params
        self.accounted = accounted
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
                self.where = self.where._replace(modes=rows["modes"])
                self.entered = self.entered._replace(modes=trajectory.modes_entered())
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
            given = None if where.modes is None else self.accounted.given(None, where.modes, int(i))
            for name, power in _powers(model, t, q, v, of_phase, given).items():
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
        if isinstance(traj, HybridTrajectory) and traj.switches.of_phases:
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
        s, names = self.switches, [self.switches.names[i] for i in self.entered.phase]
        ways = np.asarray(s.way)[: len(self.switch_times)]
        both = zip(ways, names, names[1:])
        return tuple(f"{x} -> {y}" if way < s.of_phases else s.ways[way] for way, x, y in both)

    def elements(self) -> tuple[str, ...]:
        """The names of the modes of elements, those of a vector once."""
        every = [law.name for of in self.laws for law in (*of.normals, *of.tangents, *of.compliant)]
        return tuple(dict.fromkeys(every))

    @property
    def laws(self) -> list:
        """The laws of the elements of each phase that has some."""
        return [laws for laws in getattr(self.trajectory.system, "laws", ()) if laws is not None]

    def element_of_switches(self) -> list[str]:
        """The element whose mode ended at each switch, a contact's friction counted to the contact; "" at those of
        phases. Nothing without elements."""
        if self.switches is None or not self.laws:
            return []
        names = [*[""] * self.switches.of_phases, *(name for laws in self.laws for name in laws.elements)]
        return [names[i] for i in np.asarray(self.switches.way)[: len(self.switch_times)]]

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


# Quadrature may be wrong by this many tolerances of the largest energy.
QUADRATURE = 3.0
# Terms that cancel to this, in units of the last place, are equal.
ROUND_OFFS = 1e3


class EnergyLedger(eqx.Module):
    """The energy of a motion and what changed it; it prints itself as a table and can be plotted.

    - `t` (T,): the outputs that were reached, and the end if it lies beyond them.
    - `jacobi_integral` (T,): h = v·p - L, `[L]`.
    - `kinetic`, `potential` (T,): T₂, the part of L of second degree in v, and V = -L at v = 0, with h = T₂ + V; None
      if L has terms other than up to second degree. In coordinates that move, V contains the centrifugal part,
      and h is not the energy: on a hoop that turns at ω it is E - ω L_z.
    - `works`: a `Work` for each source: "force", "dissipation", "states" (what changes L by those that it contains),
      "explicit time", as far as the system has them.
    - `constraints`: by name a `Work`, of the force Aᵀ λ. Summed over all coordinates, the work of a constraint that
      neither moves nor is inhomogeneous in v is zero.
    - `elements`: by the name of its mode (`traj.switches.ways`) a `Work`, of the force of each element: of a contact's
      normal force, zero unless the gap moves; and of friction, whether it slides or sticks.
    - `impacts` (S,): the jump of h at each switch, at the times `impact_times`; `switches`: from which phase to which,
      or which mode ended; `impact_total` (T,): the sum of the jumps until each output. `element_impacts`: of that the
      part of each element; where several are struck at once, it is the one whose mode ended there.
    - `closure` (T,): the change of h less all works and jumps, `[L]`; `scale`: the largest energy, to which it is
      compared; `allowed`: 100 tolerances.
    - `quadrature`: the estimated error of the works by quadrature, relative to `scale`.

    Works are integrated along the motion, however far apart its outputs lie; energies, `closure` and `scale` are those
    at the outputs, so an imbalance that comes and goes between two of them is not seen.
    """

    t: np.ndarray
    jacobi_integral: np.ndarray
    kinetic: np.ndarray | None
    potential: np.ndarray | None
    works: dict[str, Work]
    constraints: dict[str, Work]
    impact_times: np.ndarray
    impacts: np.ndarray
    switches: tuple[str, ...]
    impact_total: np.ndarray
    closure: np.ndarray
    scale: float
    allowed: float
    quadrature: float
    elements: dict[str, Work]
    element_impacts: dict[str, np.ndarray]

    @property
    def relative_closure(self) -> float:
        """The largest `closure` at the outputs, relative to `scale`."""
        return float(np.max(np.abs(self.closure)) / self.scale)

    @property
    def closes(self) -> bool:
        """Whether the relative closure is no larger than `allowed`."""
        return self.relative_closure <= self.allowed

    def sources(self) -> Iterator[tuple[str, Work]]:
        """Yield all sources of work, with their names in words."""
        yield from self.works.items()
        yield from ((constraint_in_words(name), work) for name, work in self.constraints.items())
        yield from ((element_in_words(name), work) for name, work in self.elements.items())

    def _jumps(self) -> dict[str, np.ndarray]:
        """The jumps until each output, by what they are called."""
        if self.element_impacts:
            words = {name: "impacts" if name in self.elements else "steps" for name in self.element_impacts}
            found = {f"{words[name]} of '{name}'": jumps for name, jumps in self.element_impacts.items()}
            others = self.impact_total - sum(self.element_impacts.values())
            noise = self.allowed * self.scale
            return found | ({"switches of phases": others} if np.max(np.abs(others)) > noise else {})
        return {_count(len(self.impacts), "switch"): self.impact_total} if len(self.impacts) else {}

    def plot(self):
        """Draw the work of each source and the jumps, stacked, against time, with the change of the Jacobi integral.

        **Returns:** a matplotlib `Figure`. **Raises:** `ImportError` without matplotlib.
        """
        stacked = {name: work.total for name, work in self.sources()}
        stacked |= self._jumps() if self.element_impacts else {"impacts": x for x in self._jumps().values()}
        return plot.stacked(self.t, stacked, self.jacobi_integral - self.jacobi_integral[0], "change of h")

    def __repr__(self):
        def change(x: np.ndarray):
            return [x[-1] - x[0]]

        rows = [("Jacobi integral h", change(self.jacobi_integral))]
        if self.kinetic is not None and self.potential is not None:
            rows += [("  kinetic", change(self.kinetic)), ("  potential", change(self.potential))]
        names = []
        for name, work in self.sources():
            last = jax.tree.map(lambda x: np.asarray(x)[-1], work.work)
            names = names if name == TIME else coordinates.names(last)
            parts = [] if name == TIME or len(names) == 1 else coordinates.flatten(last)[0]
            rows.append((name, [work.total[-1], *parts]))
        rows += [(name, [jumps[-1]]) for name, jumps in self._jumps().items()]
        heads = ["change", *(f"by {name}" for name in names)] if len(names) > 1 else ["change"]
        cells = [[self._number(x) for x in numbers] for _, numbers in rows]
        lines = columns([["", *heads], *([name, *row] for (name, _), row in zip(rows, cells))], "<>")
        width = max(len(name) for name, _ in rows)
        closure = f"{self.relative_closure:.0e} of the largest energy at the outputs, {self.scale:.6g}"
        verdict = "" if self.closes else f"; DOES NOT CLOSE: above {self.allowed:.0e}"
        return "\n".join([
            f"EnergyLedger, t = {self.t[0]:.6g} to {self.t[-1]:.6g}, {len(self.t)} instants",
            *(f"  {line}" for line in lines),
            f"  {'closure':<{width}}  {closure}{verdict}",
            *(f"  {note}" for note in self._odd()),
        ])  # fmt: skip

    def _number(self, x):
        """Return a number in words; round-off as 0."""
        return f"{float(x):+.8g}" if abs(x) > ROUND_OFFS * np.finfo(self.t.dtype).eps * self.scale else "0"

    def _odd(self):
        """Yield notes on sources that behave as they hardly ever should."""
        noise = self.allowed * self.scale
        forward = self.t[-1] > self.t[0]
        given = self.works[DISSIPATION].total[-1] if DISSIPATION in self.works else 0.0
        if forward and given > noise:
            yield f"NOTE: the dissipation gave {given:.3g}, but it should only take energy. Is its sign right?"


def energy_ledger(trajectory: Trajectory, system: System | Hybrid | None = None) -> EnergyLedger:
    """Account for the energy of a motion: what each force, constraint and impact gave to it, and whether that adds up.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> drop = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q, dissipation=lambda t, q, v, params: 0.5 * v**2)
    >>> traj = lj.integrate(drop, 5.0, 0.0, ts=jnp.array([0.0, 1.0]))
    >>> ledger = energy_ledger(traj)
    >>> print(f"{ledger.works['dissipation'].total[-1]:.9f}")
    -16.809124072

    **Arguments:**

    - `trajectory`: one motion, outside of traced code.
    - `system`: the system whose forces are accounted for; by default that of the motion. With another one, the closure
      says whether the motion is also one of that system.

    **Returns:** an `EnergyLedger`. Print it, or `.plot()` it.

    **Raises:** `TypeError` for anything but a trajectory, and for one that is being traced; `ValueError` for a batch,
    for one that did not get beyond its start, and if the motion cannot be run again.

    The motion is run again, with 15 outputs in each interval, in a program of its own, which takes two to six times the
    time of the motion.

    Source: Goldstein, Eq. (2.54): dh/dt = -∂L/∂t, with the forces that L does not contain.
    """
    fix = "lj.energy_ledger(lj.integrate(...)), outside jax.jit and jax.vmap"
    must_be(Trajectory, trajectory, "a ledger needs a motion that was computed", fix)
    must_have_values(trajectory, "a ledger needs a motion that was computed", fix)
    must_be_single(np.shape(trajectory.t)[:-1], "this trajectory", "lj.energy_ledger({traj})")
    accounted = trajectory.system if system is None else system
    check_system(accounted, phases=True, elements=True)
    if accounted.elements is not None:
        first = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
        accounted = traced_phases(accounted, State(*first, trajectory.params))
    modes = trajectory.modes if isinstance(trajectory, HybridTrajectory) else None
    if accounted.in_phases != trajectory.in_phases or (accounted.elements is None) != (modes is None):
        raise TypeError(
            "a motion in phases is accounted for by a lj.Hybrid, one with elements by a lj.System with elements, any "
            "other one by a lj.System without, not "
            f"{type(accounted).__name__}.\nFix: leave system out, or give one like traj.system."
        )
    return _ledger(Motion(trajectory, accounted))


def _ledger(motion: Motion) -> EnergyLedger:
    rtol = float(np.max(np.asarray(motion.trajectory.tolerance[0])))
    h, kinetic, potential, size = motion.energies()
    jumps = motion.jumps()
    scale = max(float(np.max(size)), np.finfo(float).tiny)
    works, error = motion.works(QUADRATURE * max(rtol, np.finfo(h.dtype).eps) * scale)
    total = sum((work.total for work in works.values()), np.zeros(len(h)))
    until = [motion.switches_until(row) for row in range(len(h))]

    def summed(jumps: np.ndarray) -> np.ndarray:
        return np.array([np.sum(jumps[:count]) for count in until])

    jumped = summed(jumps)
    split = bool(np.all(np.abs(h - kinetic - potential) <= ROUND_OFFS * np.finfo(h.dtype).eps * size))
    names = [(name, system) for system in motion.systems for name in system.constraints]
    constraint = {name: works[constraint_in_words(name)] for name, of in names if not is_element(of, name)}
    by = np.array(motion.element_of_switches())
    jumped_there = np.abs(jumps[: len(by)]) > ROUND_OFFS * np.finfo(h.dtype).eps * scale
    return EnergyLedger(
        t=motion.t, jacobi_integral=h, kinetic=kinetic if split else None, potential=potential if split else None,
        works={name: works[name] for name in (FORCE, DISSIPATION, STATES, TIME) if name in works},
        constraints=constraint,
        impact_times=motion.switch_times, impacts=jumps, switches=motion.ways(), impact_total=jumped,
        closure=h - h[0] - total - jumped, scale=scale, allowed=100 * rtol, quadrature=error / scale,
        elements={name: works[words] for name in motion.elements() if (words := element_in_words(name)) in works},
        element_impacts={
            str(name): summed(np.where(by == name, jumps, 0.0)) for name in sorted(set(by[jumped_there]) - {""})
        },
    )  # fmt: skip


def _count(n, word):
    return f"{n} {word}" + ("" if n == 1 else "es")
