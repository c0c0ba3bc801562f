"""A motion in phases: a trajectory that knows the phase of each output, and its switches."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.display import by_line
from lagjax.display import plots as plot
from lagjax.integrate.error_report import columns
from lagjax.integrate.events.event import Crossings
from lagjax.integrate.parts import NO_PHASE, mode_in_words
from lagjax.integrate.tolerances import rounded
from lagjax.integrate.trajectory import Trajectory, jacobi_and_scale
from lagjax.jaxtools import compiled
from lagjax.mechanics import worst_residual
from lagjax.system import Hybrid, InModes, Model, UnknownSystem, known_system, model_of

# What is struck jumps by more than so many round-offs of the velocities in the motion.
STRUCK = 1000
# The name under which switches are among the events of a motion; of what kind those of phases are.
SWITCHES, OF_PHASES = "switches", "switch"


class Switches(eqx.Module):
    """The switches of a motion, in order of time; it prints itself.

    - `t` (S,): their times, `[t]`; NaN beyond the last one. S is `most_switches` of the `lj.Hybrid`.
    - `way` (S,): which of the hybrid's switches each is, and `to` (S,): the number of the next phase; -1 beyond the
      last one. `names`: the names of all phases; `ways`: for each of the hybrid's switches, the phase it leaves.
    - `q`, `v`: the states before them, each leaf with a leading axis S; `q_after`, `v_after`: those after them.
    - `impulse`: the jump of the momentum, like v, `[L] [t]/[q]`; zero where nothing jumps.
    - `modes` (S, k): with elements, their modes after each (see `HybridTrajectory`). The last k of `ways` are then
      their names, and `kinds` what each of the `ways` is: a "switch" of phases, or the mode of a "gap", a "sliding
      velocity" (or one "in a plane"), a "spring", a "side" from which a normal force presses, or a "control".
    - `count`: how many there were.
    - `uncertain`: whether some may be missing: a guard touched zero within round-off, or changed too fast to be
      followed.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, " S"]
    way: Int[Array, " S"]
    to: Int[Array, " S"]
    q: PyTree[Float[Array, "S ..."]]
    v: PyTree[Float[Array, "S ..."]]
    q_after: PyTree[Float[Array, "S ..."]]
    v_after: PyTree[Float[Array, "S ..."]]
    impulse: PyTree[Float[Array, "S ..."]]
    count: Int[Array, ""]
    uncertain: Bool[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)
    ways: tuple[str, ...] = eqx.field(static=True)
    modes: Int[Array, "S k"] | None = None
    kinds: tuple[str, ...] = eqx.field(static=True, default=())

    def as_crossings(self) -> Crossings:
        """Return the switches as crossings of one guard, with the states before them."""
        return Crossings(self.t, self.q, self.v, {}, self.count, self.uncertain)

    def __len__(self):
        return int(self.count)

    def __repr__(self):
        if isinstance(self.t, Tracer) or not isinstance(self.t, jax.Array | np.ndarray):
            return "Switches, being traced"
        if np.ndim(self.count):
            low, high = int(np.min(self.count)), int(np.max(self.count))
            return f"Switches of {np.size(self.count)} lanes, {low} to {high} each"
        return by_line("\n".join(["Switches: " + self.in_words(), *self._rows()]))

    def in_words(self) -> str:
        """Return the number of switches, and whether some may be missing."""
        return f"{int(self.count)}" + ("; some may be missing" if bool(self.uncertain) else "")

    def in_rows(self, most: int = 6) -> list[str]:
        """Return a row for each of the first switches."""
        found = [row.strip() for row in self._rows()]
        return found[:most] + (["..."] if len(found) > most else [])

    def _rows(self):
        times, ways = np.asarray(self.t), np.asarray(self.way)
        return [f"  t = {times[k]:<12.9g} {self.ways[ways[k]]} {self._happened(k)}" for k in range(int(self.count))]

    @property
    def of_phases(self) -> int:
        """How many of the `ways` lead out of phases: the others are modes of elements."""
        return len(self.ways) - (0 if self.modes is None else np.shape(self.modes)[-1])

    @property
    def of_modes(self) -> list[tuple[str, str]]:
        """The name and the kind of each mode of elements."""
        return list(zip(self.ways[self.of_phases :], self.kinds[self.of_phases :]))

    def _happened(self, k: int) -> str:
        """What follows at switch k: the next phase, or what a mode does where it ends."""
        way = int(self.way[k])
        if way < self.of_phases:
            return f"-> {self.names[int(self.to[k])]}"
        if self.kinds[way] == "control":
            return "acts"
        mode = int(np.asarray(self.modes)[k, way - self.of_phases])
        after = mode_in_words(self.kinds[way], mode)
        if self.kinds[way] == "sliding velocity" and abs(mode) == 1:
            after += " forward" if mode > 0 else " back"
        return f"is struck, then {after}" if self.kinds[way] == "gap" and self._strikes(k, way) else after

    def _strikes(self, k: int, way: int) -> bool:
        """Whether velocities jump by more than round-off at switch k, where a gap that was open ends its mode."""
        if k and int(np.asarray(self.modes)[k - 1, way - self.of_phases]) > 0:
            return False
        before, after = (columns(np, x, rows=np.size(self.t))[: int(self.count)] for x in (self.v, self.v_after))
        jump, size = np.max(np.abs(after[k] - before[k])), np.max(np.abs([before, after]))
        return bool(jump > STRUCK * np.finfo(before.dtype).eps * size)


class HybridTrajectory(Trajectory):
    """A motion in phases, as `lj.integrate` returns it for a `lj.Hybrid`: a `Trajectory` with more.

    - `phase` (T,): the number of the phase at each output, in the order of `system.names`; -1 where none was reached.
      An output at the very time of a switch has the state and the phase before it.
    - `switches`: the `Switches`.
    - `modes` (T, k): with elements, the mode of each of them at each output, in the order of the last k of
      `switches.ways`: of a gap 0 (open) or 1 (closed); of a sliding velocity 1 or -1 (slides), 2 (sticks), or 0 (its
      gap is open), or 3 (others hold it); of a spring 0 (apart) or 1 (pressed); of a normal force of either sign 1 or
      -1, the side from which it presses; of a sampled control the number of its next instant. In a phase that does not
      have the element it is -1.
    - `multipliers`: of all phases by constraint name; NaN where the phase has no such constraint, and of `at(t)`
      between outputs while others hold what would slide (mode 3): which friction is at its bound is known at outputs.
    - `end`: the last instant; where the motion ended on a switch, the state after it.
    - `jacobi_integral()`, `residual()`: of each output's own phase. `drift()` is NaN: over all phases, in which forces
      and impacts do work, nothing has to be conserved.
    """

    phase: Int[Array, " T"] = eqx.field(kw_only=True)
    switches: Switches = eqx.field(kw_only=True)
    modes: Int[Array, "T k"] | None = eqx.field(kw_only=True, default=None)
    in_phases: ClassVar[bool] = True

    @property
    def system(self) -> Hybrid:  # pyright: ignore[reportIncompatibleVariableOverride]
        return known_system(self.any_system)

    @property
    def model(self) -> Model:
        first = jax.tree.map(lambda x: x[0], (self.t, self.q, self.v))
        return model_of(self.system, *first, self.params)

    def given(self, phase: int) -> InModes | None:
        """The modes of elements at each output as the functions of a phase take them; None without elements."""
        return None if self.modes is None else self.system.given(None, self.modes, phase)

    def named_phases(self) -> np.ndarray:
        """The name of the phase at each output; an empty one where none was reached. Not while JAX is tracing."""
        return np.array([*self.switches.names, ""])[np.asarray(self.phase)]

    def last_phase(self) -> int:
        """The number of the phase in which the motion ended, or failed. Not while JAX is tracing."""
        count = len(self.switches)
        return int(self.switches.to[count - 1] if count else self.system.first)

    def modes_entered(self) -> Any:
        """The modes of elements at the start and after each switch, (S + 1, k); None without elements. Not traced."""
        if self.modes is None:
            return None
        return np.concatenate([np.asarray(self.modes)[:1], np.asarray(self.switches.modes)[: len(self.switches)]])

    def jacobi_integral(self) -> Float[Array, " T"]:
        """The Jacobi integral of the phase at every output, (T,), `[L]`. Not for batched trajectories."""
        return _of_phases(_integral, self)

    def drift(self) -> Float[Array, ""]:
        """Return NaN: nothing is known to be conserved over all phases."""
        return jnp.full_like(self.scaled_error, jnp.nan)

    def residual(self) -> Float[Array, ""]:
        """The worst constraint residual over all outputs, but not between them, each in its own phase, relative."""
        worst = [_residual_in(model, i, self) for i, model in enumerate(self.model.phases) if model.m]
        return jnp.max(jnp.stack([*worst, jnp.zeros_like(self.scaled_error)]))

    def plot(self, charges: Any = False):
        """Plot coordinates, velocities and multipliers against time, with the switches; returns a matplotlib `Figure`.

        A strip below shows the phases; with elements, in a row each, when a gap is closed, and when what slides slides
        or sticks. Switches stand at their own times; else what happens between two outputs is not seen.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batched trajectory.
        """
        fig = super().plot(charges)
        for axis in fig.axes[:-1]:
            for t in np.asarray(self.switches.t)[: len(self.switches)]:
                axis.axvline(t, color=plot.COLOURS[-1], linewidth=0.6, linestyle=":", zorder=0)
        return fig

    def _strips(self) -> dict[str, list[tuple[float, float, str]]]:
        s = self.switches
        edges = np.array([self.t[0], *np.asarray(s.t)[: len(s)], self.end.t])
        first, rows = np.asarray(self.phase)[0], {}
        if s.of_phases or self.modes is None:
            rows["phase"] = [s.names[i] for i in (first, *np.asarray(s.to)[: len(s)])]
        for i, (name, kind) in enumerate(s.of_modes):
            rows[name] = [mode_in_words(kind, int(mode)) for mode in self.modes_entered()[:, i]]
        return {name: _merged(edges, words) for name, words in rows.items()}

    def rows(self) -> dict:
        return super().rows() | {"phase": self.phase, "modes": self.modes}

    def _of_system(self):
        if isinstance(self.any_system, UnknownSystem):
            lines = [("system", repr(self.any_system))]
        elif any(system.constraints for system in self.system.systems):
            lines = [("worst constraint residual", f"{float(self.residual()):.1e} (relative, at the outputs)")]
        else:
            lines = []
        return [
            *lines,
            *self._of_phases(),
            ("switches", self.switches.in_words()),
            *(("", row) for row in self.switches.in_rows()),
            *((f"event '{name}'", found.in_words()) for name, found in self.events.items() if name != SWITCHES),
        ]

    def _of_phases(self) -> Iterator[tuple[str, str]]:
        if self.switches.of_phases or self.modes is None:
            names, counts = np.unique(self.named_phases(), return_counts=True)
            yield "phases", "outputs: " + ", ".join(f"{n} in {name}" for name, n in zip(names, counts) if name)
        if self.modes is not None:
            last = zip(self.switches.of_modes, self.modes_entered()[-1])
            words = [f"{name} {mode_in_words(kind, int(mode))}" for (name, kind), mode in last if mode != NO_PHASE]
            yield "modes", f"at the end: {', '.join(words) or 'none'}"


def _merged(edges: np.ndarray, words: list[str]) -> list[tuple[float, float, str]]:
    """From when until when each word holds, (start, end, word), with equal neighbours as one."""
    found: list[tuple[float, float, str]] = []
    for start, end, word in zip(edges, edges[1:], words):
        if found and found[-1][2] == word:
            start = found.pop()[0]
        found.append((float(start), float(end), word))
    return found


def _integral(model: Model, t: Array, q: PyTree, v: PyTree):
    return jacobi_and_scale(model, t, q, v)[0]


def _of_phases(function: Callable, trajectory):
    """Return `function(model, t, q, v)` at all outputs, each with the model of its own phase."""
    found = jnp.full_like(trajectory.t, jnp.nan)
    for i, model in enumerate(trajectory.model.phases):
        values = function(model, trajectory.t, trajectory.q, trajectory.v)
        found = jnp.where(trajectory.phase == i, values, found)
    return found


def _residual_in(model: Model, i: int, trajectory):
    given = trajectory.given(i)
    motion = trajectory.phase, trajectory.t, trajectory.q, trajectory.v
    nothing = trajectory.tolerance[1]
    # What rests at zero has the size of which its round-off is that of the forces that hold it.
    least = rounded(jnp.min(nothing, axis=1)[:, None]) if given is not None and nothing.ndim == 2 else 0.0
    return _worst(model, i, *motion, given, least)


@compiled
def _worst(model: Model, i: int, phase: Array, t: Array, q: PyTree, v: PyTree, given: InModes | None, least: Any):
    in_phase = phase == i
    # Outputs of other phases are replaced by the first of this phase, which does not change the maximum.
    at = jnp.where(in_phase, jnp.arange(phase.size), jnp.argmax(in_phase))
    t, q, v, given = jax.tree.map(partial(jnp.take, indices=at, axis=0), (t, q, v, given))
    worst = lambda: worst_residual(model, t, q, v, given, least)
    return lax.cond(jnp.any(in_phase), worst, lambda: jnp.zeros_like(t[0]))
