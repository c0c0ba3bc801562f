"""Where the unknowns and the equations of a nonlinear program stand, and which of them each block sees."""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from lagjax.two_points import transcription
from lagjax.two_points.transcription import Element, PlanEnds, Plant

# Elements that are differentiated together: a program serves any number of elements.
TOGETHER = 16


class Block(NamedTuple):
    """Parts of one kind: which unknowns (B, d) each sees, and to which equations (B, r) it adds."""

    plant: Plant
    form: tuple
    columns: np.ndarray
    rows: np.ndarray

    def _together(self, function: Callable, *arguments):
        size = TOGETHER if len(self.columns) > 1 else 1
        found = []
        for start in range(0, len(self.columns), size):
            pieces = [_filled(x[start : start + size], size) for x in arguments]
            found.append(jax.tree.map(np.asarray, function(self.plant, self.form, *pieces)))
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(self.columns)], *found)

    def values_and_slopes(self, x: np.ndarray):
        """Costs (B,) and rows (B, r), and their derivatives by what each part sees, (B, d) and (B, r, d)."""
        return self._together(transcription.values_and_slopes, x[self.columns])

    def curvatures(self, x: np.ndarray, share: float, multipliers: np.ndarray):
        """The second derivatives (B, d, d) of `share` times the cost plus the rows times `multipliers`."""

        def function(plant: Plant, form: tuple, *pieces):
            return transcription.curvatures(plant, form, pieces[0], np.asarray(share), pieces[1])

        return self._together(function, x[self.columns], multipliers[self.rows])


def _filled(x: np.ndarray, size: int):
    return np.concatenate([x, np.repeat(x[-1:], size - len(x), axis=0)]) if len(x) < size else x


class Layout:
    """The unknowns and equations of a plant on K elements.

    `places`: by kind, where unknowns stand in the vector of all, in the shapes of these; `rows`: the same of equations.
    """

    def __init__(self, plant: Plant, count: int):
        self.plant, self.count = plant, count
        n, s, k = plant.form.n, plant.degree, count
        controls = {"smooth": k * s, "linear": k + 1, "constant": k}[plant.interpolation]
        self.size, self.places = _numbered({
            "end": (1,), "parts": (k + 1,), "q": (s * k + 1, n), "v": (2, n), "controls": (controls, plant.n_controls),
            "node_multipliers": (s * k + 1, plant.of_positions), "point_multipliers": (s * k, plant.of_velocities),
            "impulse": (plant.of_velocities,),
        })  # fmt: skip
        g, phi = plant.of_positions, plant.of_velocities
        self.row_count, self.rows = _numbered({
            "motion": (s * k + 1, n), "positions": (k, s, g), "velocities": (k, s, phi),
            "bounded": (k, s, len(plant.bounded)), "start": (2 * g + phi,), "stop": (g + phi,),
            "end": (plant.conditions,),
        })  # fmt: skip

    @cached_property
    def of_nodes(self) -> np.ndarray:
        """Which nodes each element has, (K, s + 1)."""
        s = self.plant.degree
        return s * np.arange(self.count)[:, None] + np.arange(s + 1)

    @cached_property
    def of_points(self) -> np.ndarray:
        """Which points each element has, (K, s)."""
        return self.of_nodes[:, :-1]

    @cached_property
    def of_controls(self) -> np.ndarray:
        """Which rows of controls each element has, (K, r)."""
        each = np.arange(self.count)[:, None]
        return {"smooth": self.of_points, "linear": each + np.arange(2), "constant": each}[self.plant.interpolation]

    def blocks(self) -> tuple[Block, Block]:
        """The elements and the ends."""
        at, rows, k = self.places, self.rows, self.count
        elements = Element(
            np.repeat(at["end"][None], k, axis=0),
            np.stack([at["parts"][:-1], at["parts"][1:]], axis=1),
            at["q"][self.of_nodes],
            at["controls"][self.of_controls],
            at["node_multipliers"][self.of_nodes],
            at["point_multipliers"][self.of_points],
        )
        ends = PlanEnds(at["end"], at["q"][[0, -1]], at["v"], at["controls"][self.of_controls[[0, -1]]], at["impulse"])
        ends = PlanEnds(*(x[None] for x in ends))
        of_elements = rows["motion"][self.of_nodes], rows["positions"], rows["velocities"], rows["bounded"]
        of_ends = rows["motion"][[0, -1]], rows["start"], rows["stop"], rows["end"]
        return (
            Block(self.plant, _form(elements), _flat(elements, k), _flat(of_elements, k)),
            Block(self.plant, _form(ends), _flat(ends, 1), _flat(of_ends, 1)),
        )


def _numbered(shapes: dict[str, tuple[int, ...]]):
    found, start = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape))
        found[name] = np.arange(start, start + size).reshape(shape)
        start += size
    return start, found


def _form(seen: Element | PlanEnds):
    return type(seen), tuple(x.shape[1:] for x in seen)


def _flat(parts: tuple, count: int):
    return np.concatenate([x.reshape(count, -1) for x in parts], axis=1)
