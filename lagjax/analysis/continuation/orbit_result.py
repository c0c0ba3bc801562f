"""A branch of cycles and its critical points; they print and draw themselves."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.analysis.continuation.arclength import AT_EDGE
from lagjax.analysis.continuation.orbit_equations import NUMBER, Along
from lagjax.analysis.continuation.result import (
    OTHER_MARK,
    STABLE,
    UNKNOWN,
    UNSTABLE,
    draw_by_stability,
    name_stability,
    stability_in_words,
)
from lagjax.analysis.orbits.result import PeriodicOrbit
from lagjax.display import plots as plot
from lagjax.jaxtools import hashable_partition
from lagjax.system import coordinates

MARKS = {"fold": ("s", 1), "branch point": ("o", 2), "period doubling": ("D", 3), "torus": ("^", 4)}


class CriticalOrbit(eqx.Module):
    """A point where a branch of cycles folds, where others branch off, or where stability is lost.

    - `kind`: `"fold"`, where the parameter turns; `"branch point"`, where a multiplier passes 1 and the branch
      continues, or where the parameter turns as the branch meets another, of whose orbits it is a side branch;
      `"period doubling"`,
      where one passes -1; `"torus"`, where a pair leaves the unit circle (Neimark-Sacker; without damping two pairs
      meet).
    - `parameter`: its value; `accuracy`: how far off it may be; `located`: False where no more is known than that it
      lies between two points of the branch, since the equations are nearly singular there.
    - `index`: its index on the branch: `branch[index]` is the cycle.
    - `multipliers` (k,): the trivial ones (1 for a known reason) first.
    """

    kind: str = eqx.field(static=True)
    parameter: Float[Array, ""]
    accuracy: Float[Array, ""]
    index: int = eqx.field(static=True)
    multipliers: Complex[Array, " k"]
    located: bool = eqx.field(static=True, default=True)

    def __repr__(self):
        return f"{self.kind} at {float(self.parameter):.10g}{self.doubt}"

    @property
    def doubt(self) -> str:
        """In words, how far off the parameter may be, where it was not located."""
        return "" if self.located else f" (to {float(self.accuracy):.0e})"


class OrbitBranch(eqx.Module):
    """One curve of P cycles, in their order along it: `branch[i]` is a `PeriodicOrbit`.

    - `parameter`, `period` (P,); `q`, `v`: the state at the start of each, with a leading axis P.
    - `low`, `high`: the smallest and the largest value of each coordinate over a period, like `q`; accurate to 1e-6.
    - `stable` (P,): whether no multiplier is outside the unit circle; `multipliers` (P, k): the trivial ones first.
    - `critical`: a list of `CriticalOrbit`, in the order along the branch.
    - `along`, `first`, `last`: the parameter and its range. `status`: where and why the branch ends.
    """

    parameter: Float[Array, " P"]
    period: Float[Array, " P"]
    q: PyTree[Float[Array, "P ..."]]
    v: PyTree[Float[Array, "P ..."]]
    low: PyTree[Float[Array, "P ..."]]
    high: PyTree[Float[Array, "P ..."]]
    stable: Bool[Array, " P"]
    multipliers: Complex[Array, "P k"]
    nodes: Float[Array, "P K 2n"]
    critical: list[CriticalOrbit]
    orbit: PeriodicOrbit
    place: Along
    along: str = eqx.field(static=True)
    first: float = eqx.field(static=True)
    last: float = eqx.field(static=True)
    status: str = eqx.field(static=True)

    def __len__(self):
        return len(self.parameter)

    def __getitem__(self, i: int) -> PeriodicOrbit:
        if not -len(self) <= i < len(self):
            raise IndexError(f"there are {len(self)} cycles, branch[0] to branch[{len(self) - 1}].")

        def pick(tree: PyTree):
            return jax.tree.map(lambda x: x[i], tree)

        system, params = self.orbit.system, self.orbit.params
        if self.place.kind == NUMBER and self.place.number is not None:
            params = self.place.number.put(params, self.parameter[i])
        arrays, static = hashable_partition((system, coordinates.as_arrays(params, self.orbit.t.dtype)))
        return replace(
            self.orbit, q=pick(self.q), v=pick(self.v), period=self.period[i], nodes=self.nodes[i], arrays=arrays,
            static=static, switches=None,
        )  # fmt: skip

    def of_kind(self, kind: str) -> list[CriticalOrbit]:
        """The critical points of one kind, `"fold"`, `"period doubling"`, ..."""
        return [c for c in self.critical if c.kind == kind]

    @plot.names_as_they_are()
    def plot(self, *names: str):
        """Draw the largest value of coordinates against the parameter: stable solid, unstable dashed, with markers.

        **Arguments:** `names` of coordinates, or `"period"`, one panel each; by default the first six coordinates.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` for an unknown name; `ImportError` without matplotlib.
        """
        known = self._names()
        if unknown := [name for name in names if name not in (*known, "period")]:
            raise ValueError(
                f"plot({unknown[0]!r}) names no coordinate; there are {', '.join(known)}, and 'period'.\n"
                f"Fix: plot({known[0]!r})."
            )
        shown = list(names) or known[:6]
        fig, axes = plot.panel_axes(len(shown), 2, (4.8, 3.4))
        for axis, name in zip(axes, shown):
            self.draw(axis, name)
        axes[0].legend(fontsize=8, frameon=False)
        return fig

    def draw(self, axis, name: str | None = None):
        """Draw the largest value of one coordinate, by default the first, or `"period"`, on matplotlib axes."""
        name = self._names()[0] if name is None else name
        y, verdicts = self._values(name), self._verdicts()
        draw_by_stability(axis, np.asarray(self.parameter), y, verdicts, plot.COLOURS[0])
        name_stability(axis, [verdicts])
        for c in self.critical:
            marker, colour = MARKS.get(c.kind, OTHER_MARK)
            axis.plot(
                float(c.parameter), y[c.index], marker, color=plot.COLOURS[colour], markeredgecolor="white",
                markersize=7, linestyle="", zorder=4,
                label=None if c.kind in axis.get_legend_handles_labels()[1] else c.kind,
            )  # fmt: skip
        axis.set(xlabel=self.along, ylabel=name if name == "period" else f"largest {name}")

    def _names(self):
        return coordinates.names(self.orbit.q)

    def _values(self, name: str):
        if name == "period":
            return np.asarray(self.period)
        leaves = [np.asarray(x).reshape(len(self), -1) for x in jax.tree.leaves(self.high)]
        return np.concatenate(leaves, axis=1)[:, self._names().index(name)]

    def _verdicts(self):
        known = np.all(np.isfinite(self.multipliers), axis=1)
        return np.where(known, np.where(self.stable, STABLE, UNSTABLE), UNKNOWN)

    def __repr__(self):
        count = len(self.critical)
        points = f"{count} critical point{'s' * (count != 1)}" if count else "no critical point"

        def number(x: float) -> str:
            return f"{0.0 if abs(x) < 1e-13 * abs(self.last - self.first) else float(x):.10g}"

        reached = [float(np.min(self.parameter)), float(np.max(self.parameter))]
        reached = reached if self.first <= self.last else reached[::-1]
        # Of the range that was asked for, which ends may lie beside by round-off.
        whole = abs(reached[1] - self.last) < 1e-9 * abs(self.last - self.first)
        span = f"from {number(reached[0])} to {number(reached[1])}" + ("" if whole else f" (asked to {self.last:.6g})")
        lines = [f"Branch of cycles along {self.along}, {span}: {len(self)} of them, with {points}"]
        lines += [
            f"  {c.kind:<16}{self.along} = {number(c.parameter) + c.doubt:<14} {_torus_angle(c)}" for c in self.critical
        ]
        low, high = np.min(self.period), np.max(self.period)
        lines.append(f"  {'periods':<16}{low:.6g}" + (f" to {high:.6g}" if high - low > 1e-9 * high else ""))
        lines.append(f"  {'stability':<16}{stability_in_words(self._verdicts())}")
        where = f", {self.along} = {number(self.parameter[-1])}" if self.status == AT_EDGE else ""
        lines.append(f"  {'ends at':<16}{self.status}{where}")
        return "\n".join(lines)


def _torus_angle(c: CriticalOrbit):
    """For a torus, the angle of its pair of multipliers; otherwise nothing."""
    if c.kind != "torus":
        return ""
    upper = np.asarray(c.multipliers)[np.imag(c.multipliers) > 1e-6]
    if not upper.size:
        return ""
    pair = upper[np.argmin(np.abs(np.abs(upper) - 1))]
    return f"a pair at ±{np.angle(pair):.6g} rad"
