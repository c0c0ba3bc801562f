"""The elements: how they are made finer, where a control jumps, and the same motion on other elements.

Two rules. All elements are halved until the cost no longer changes. And where a control goes from one of its bounds to
the other within an element, this is cut in two at a time that the program then finds, and the control stays at the
one bound before the cut and at the other after it.

Without the second half of that rule the cut would not be where the control jumps: a polynomial is held to its bounds at
Gauss's points alone, and one that is beyond them in between costs less.
"""

from typing import NamedTuple

import numpy as np

from lagjax.two_points.layout import Layout
from lagjax.two_points.transcription import through

# A control this near to a bound, in parts of the distance between both, is at it.
AT_BOUND = 0.02
# How near to a neighbour a bound of elements may move, in parts of their distance.
APART = 0.02


class Jump(NamedTuple):
    """Where a control jumps, as a part of the whole time; which one, and whether it is at its upper bound before."""

    at: float
    control: int
    falls: bool


class Mesh(NamedTuple):
    """The bounds of K elements (K + 1,) as parts of the whole time, and the jumps at which they may move, by number."""

    parts: np.ndarray
    jumps: dict[int, list[Jump]]

    @property
    def moves(self) -> np.ndarray:
        """Which of the bounds may move, (K + 1,)."""
        return np.isin(np.arange(len(self.parts)), list(self.jumps))

    @classmethod
    def even(cls, count: int) -> "Mesh":
        """Elements of one length."""
        return cls(np.linspace(0.0, 1.0, count + 1), {})

    @property
    def count(self) -> int:
        """The number of elements."""
        return len(self.parts) - 1

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Between which values each bound of elements may move."""
        low, high, moves = self.parts.copy(), self.parts.copy(), self.moves
        for i in self.jumps:
            before, after = self.parts[i] - self.parts[i - 1], self.parts[i + 1] - self.parts[i]
            # Two neighbours that both move each have half of what lies between them.
            low[i] -= before * ((0.5 if moves[i - 1] else 1.0) - APART)
            high[i] += after * ((0.5 if moves[i + 1] else 1.0) - APART)
        return low, high

    def at(self, parts: np.ndarray) -> "Mesh":
        """The same mesh after its bounds have moved."""
        return Mesh(parts, self.jumps)

    def halved(self) -> "Mesh":
        """Each element cut in two."""
        middle = (self.parts[:-1] + self.parts[1:]) / 2
        parts = np.append(np.stack([self.parts[:-1], middle], axis=1).ravel(), self.parts[-1])
        return Mesh(parts, {2 * i: jumps for i, jumps in self.jumps.items()})

    def cut(self, jumps: list[Jump]) -> "Mesh":
        """With a bound of elements at each jump; one that is nearby is moved there."""
        parts = list(self.parts)
        for jump in jumps:
            i = int(np.clip(np.searchsorted(parts, jump.at), 1, len(parts) - 1))
            share = (jump.at - parts[i - 1]) / (parts[i] - parts[i - 1])
            near = i - 1 if share < 0.1 else i if share > 0.9 else None
            if near is not None and 0 < near < len(parts) - 1:
                parts[near] = jump.at
            elif near is None:
                parts.insert(i, jump.at)
        found = {}
        for jump in jumps:
            found.setdefault(int(np.argmin(np.abs(np.array(parts) - jump.at))), []).append(jump)
        return Mesh(np.array(parts), {i: found[i] for i in sorted(found) if 0 < i < len(parts) - 1})


def jumps_of(layout: Layout, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[Jump]:
    """Where a control goes from one bound to the other within an element, in their order."""
    plant, at = layout.plant, layout.places
    if plant.interpolation == "linear":
        return []
    parts, smooth = x[at["parts"]], plant.interpolation == "smooth"
    nodes, weights = (plant.rule.points, plant.rule.weights) if smooth else (np.array([0.5]), np.array([1.0]))
    width = np.diff(parts)[:, None]
    # To each value the time that it counts for.
    ends = (parts[:-1, None] + width * np.cumsum(weights)).ravel()
    widths, found = (width * weights).ravel(), []
    for control, (u, a, b) in enumerate(zip(x[at["controls"]].T, low, high)):
        if not np.isfinite(b - a):
            continue
        share = (u - a) / (b - a)
        side = np.where(share < AT_BOUND, -1, np.where(share > 1 - AT_BOUND, 1, 0))
        (places,) = np.nonzero(side)
        for i, j in zip(places, places[1:]):
            if side[i] != side[j] and j - i <= len(nodes) + 1:
                # The time of a jump that has the same integral as what lies between.
                as_before = share[i + 1 : j] if side[i] > 0 else 1 - share[i + 1 : j]
                place = float(ends[i] + np.sum(as_before * widths[i + 1 : j]))
                found.append(Jump(place, control, bool(side[i] > 0)))
    return sorted(found)


def moved(layout: Layout, x: np.ndarray, mesh: Mesh) -> tuple[Layout, np.ndarray]:
    """The same motion on other elements: the new layout and its unknowns."""
    plant, old, k = layout.plant, layout.places, layout.count
    new = Layout(plant, mesh.count)
    rule, parts, at, y = plant.rule, x[old["parts"]], new.places, np.zeros(new.size)
    for name in ("end", "v", "impulse"):
        y[at[name]] = x[old[name]]
    y[at["parts"]] = mesh.parts

    def resample(name: str, of_elements: np.ndarray, nodes: np.ndarray, last: bool):
        where = mesh.parts[:-1, None] + np.diff(mesh.parts)[:, None] * (nodes[:-1] if last else nodes)
        where = np.append(where.ravel(), 1.0) if last else where.ravel()
        place = np.clip(np.searchsorted(parts, where, side="right") - 1, 0, k - 1)
        inside = (where - parts[place]) / (parts[place + 1] - parts[place])
        y[at[name]] = np.einsum("mr,mrn->mn", through(nodes, inside), x[old[name]][of_elements][place])

    resample("q", layout.of_nodes, rule.nodes, True)
    resample("node_multipliers", layout.of_nodes, rule.nodes, True)
    resample("point_multipliers", layout.of_points, rule.points, False)
    resample("controls", layout.of_controls, plant.control_nodes, plant.interpolation == "linear")
    return new, y
