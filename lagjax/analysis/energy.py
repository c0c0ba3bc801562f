"""The energy of a motion, and what changed it.

Along any motion of `d/dt ∂L/∂v - ∂L/∂q = Q - ∂R/∂v + Aᵀ λ` the Jacobi integral h = v·p - L changes by

    dh/dt = Q·v - (∂R/∂v)·v + λ·(A v) - ∂L/∂t

one term each for the force, the dissipation, the constraints and explicit time. Their works are integrated separately,
without using h, so that the remainder of the balance, the closure, tests the motion, the multipliers and the forces
together. A work is the integral of a power: the motion is integrated again, by the same method with the same
tolerances, with outputs at the nodes of a quadrature, which is refined until it is more accurate than the motion
(`works.py`).

Source: Goldstein, *Classical Mechanics*, Eq. (2.53), (2.54) and §2.7.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from lagjax.analysis.works import (
    DISSIPATION,
    FORCE,
    STATES,
    TIME,
    Motion,
    Work,
    constraint_in_words,
    element_in_words,
    is_element,
)
from lagjax.display import plots as plot
from lagjax.integrate import HybridTrajectory, Trajectory, traced_phases
from lagjax.jaxtools import is_traced
from lagjax.system import Hybrid, State, System, check_system, coordinates

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
        widths = [max(len(row[i]) for row in [heads, *cells] if i < len(row)) for i in range(len(heads))]
        width = max(len(name) for name, _ in rows)

        def line(name: str, cells: list[str]) -> str:
            return "  ".join([f"  {name:<{width}}", *(f"{x:>{w}}" for x, w in zip(cells, widths))])

        closure = f"{self.relative_closure:.0e} of the largest energy at the outputs, {self.scale:.6g}"
        verdict = "" if self.closes else f"; DOES NOT CLOSE: above {self.allowed:.0e}"
        return "\n".join([
            f"EnergyLedger, t = {self.t[0]:.6g} to {self.t[-1]:.6g}, {len(self.t)} instants",
            line("", heads),
            *(line(name, row) for (name, _), row in zip(rows, cells)),
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
    if not isinstance(trajectory, Trajectory) or is_traced(trajectory):
        raise TypeError(
            f"a ledger needs a motion that was computed, not {_kind(trajectory)}.\n"
            "Fix: lj.energy_ledger(lj.integrate(...)), outside jax.jit and jax.vmap."
        )
    if np.ndim(trajectory.t) != 1:
        raise ValueError(
            f"this trajectory is a batch of shape {trajectory.t.shape[:-1]}: account for one lane of it.\n"
            "Fix: lj.energy_ledger(jax.tree.map(lambda x: x[0], traj))."
        )
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


def _kind(x):
    return "one that JAX is tracing" if isinstance(x, Trajectory) else type(x).__name__
