"""What `steer` found: the plan, the motion that it causes, its cost, and how far it ends from where it was to end.

**Plans** are controls as functions of time. A plan is a polynomial on each element, held, linear or through the values
at Gauss's points, and stays between its bounds. It travels in the parameters, so that the steered motion is one of a
system like any other, which can be integrated, differentiated and swept.
"""

from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.display import labelled, plots
from lagjax.integrate import Trajectory, integrate
from lagjax.jaxtools import has_jumps
from lagjax.system import System, Traced, coordinates, takes_of
from lagjax.two_points.control_problem import Question
from lagjax.two_points.elements import basis
from lagjax.two_points.mesh import stacked
from lagjax.two_points.nonlinear_program import SolverAnswer
from lagjax.two_points.transcription import Layout


class Plan(eqx.Module):
    """Controls as functions of time: `plan(t)` is a control in the user's structure.

    - `starts` (M,): when each element begins, `[t]`, infinite beyond the last one, so that one program serves plans of
      different lengths. `widths` (M,): how long elements are.
    - `rows` (M, r, n): the controls at `nodes`, parts of an element.
    - `low`, `high` (n,): bounds, at which a polynomial is cut off where it leaves them between its points.
    """

    starts: Float[Array, " M"]
    widths: Float[Array, " M"]
    rows: Float[Array, "M r n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    example: PyTree
    nodes: tuple[float, ...] = eqx.field(static=True)
    cut_off: bool = eqx.field(static=True)

    @property
    def knots(self) -> np.ndarray:
        """The times between which a control is one polynomial, `[t]`."""
        starts = np.asarray(self.starts)
        last = int(np.sum(np.isfinite(starts))) - 1
        return np.append(starts[: last + 1], starts[last] + np.asarray(self.widths)[last])

    def __call__(self, t: ArrayLike) -> PyTree:
        return coordinates.like(self.example, self._vectors(jnp.asarray(t, self.starts.dtype), jnp))

    def at(self, t: ArrayLike) -> np.ndarray:
        """The controls at times (T,), as vectors (T, n)."""
        return self._vectors(np.asarray(t), np)

    def _vectors(self, t: ArrayLike, xp: Any) -> Any:
        starts, widths, rows = (xp.asarray(x) for x in (self.starts, self.widths, self.rows))
        place = xp.searchsorted(starts[1:], t, side="right")
        values = basis(np.array(self.nodes), (t - starts[place]) / widths[place])
        u = xp.einsum("...r,...rn->...n", values, rows[place])
        return xp.clip(u, self.low, self.high) if self.cut_off else u


def plan_of(knots: np.ndarray, rows: np.ndarray, limits: np.ndarray, example: PyTree, nodes: np.ndarray, room: int):
    """The plan with these knots (K + 1,) and rows (K, r, n) between `limits` (2, n), filled up to `room` elements."""
    more = room - len(rows)
    starts = np.append(knots[:-1], np.full(more, np.inf))
    widths, rows = np.append(np.diff(knots), np.ones(more)), np.concatenate([rows, np.zeros((more, *rows.shape[1:]))])
    # What is linear or constant between its bounds stays there.
    cut_off = len(nodes) > 2 and bool(np.any(np.isfinite(limits)))
    return Plan(*map(jnp.asarray, (starts, widths, rows, *limits)), example, tuple(nodes.tolist()), cut_off)


class Planned(eqx.Module):
    """The parameters of a system that follows a plan."""

    params: PyTree
    plan: Plan

    def controlled(self, t: Array, merge: Callable) -> PyTree:
        """The user's parameters with the controls at a time."""
        return merge(self.params, self.plan(t))


class Follows(eqx.Module):
    """One of the user's functions, whose controls follow the plan in its parameters."""

    function: Callable
    merge: Callable = eqx.field(static=True)

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, *arguments):
        *state, planned = arguments
        return self.function(*state, planned.controlled(state[0], self.merge))


def following(system: System, merge: Callable) -> System:
    """The system as a function of `Planned` in place of its parameters."""
    return system.map(lambda function, role: Follows(function, merge))


STATUS = {
    "Solve_Succeeded": "least cost near the guess found",
    "Solved_To_Acceptable_Level": "found to the precision that rounding allows",
    "Infeasible_Problem_Detected": "no motion satisfies all conditions, as far as the solver sees",
    "Restoration_Failed": "no motion that satisfies all conditions was found",
    "Maximum_Iterations_Exceeded": "not found within the largest number of iterations",
    "Search_Direction_Becomes_Too_Small": "the solver could not go on",
    "Error_In_Step_Computation": "the solver could not go on",
    "Diverging_Iterates": "the cost falls without limit",
    "Invalid_Number_Detected": "L, a force, a constraint or the cost is not finite on the way",
    "Not_Enough_Degrees_Of_Freedom": "there are more conditions than unknown numbers",
}
# A motion that ends further from the end than this part of the way is none.
MISSED = 1e-2
# What is usually behind it, and what helps: for conditions that contradict each other, and for the rest.
CONTRADICTORY = ("Infeasible_Problem_Detected", "Restoration_Failed")
OF_CONDITIONS = (
    "Usual cause: bounds too narrow for the time, an end that no control reaches, or a guess far away.\n"
    "Fix: wider bounds or t_b=(low, high); guess=lambda t: q of a path; a first answer of an easier question."
)
OF_COST = (
    "Usual cause: a cost that falls without limit, or has a kink where it is least (jnp.abs(u)), or a guess far away.\n"
    "Fix: bounds on what the cost rewards; u**2, or a control for each sign; guess=lambda t: q of a path."
)
OF_NUMBERS = (
    "Usual cause: a root or a logarithm of what is negative, or a division by zero, along the first guess.\n"
    "Fix: a guess where all is finite: other numbers in controls, guess=lambda t: q, and bounds that keep it so."
)
FOUND = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


class Steering(eqx.Module):
    """The controls that bring a system from one state to another, and the motion that they cause.

    >>> import lagjax as lj
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["push"])
    >>> found = lj.steer(cart, {"push": 0.0}, (0.0, 0.0), (1.0, 0.0), lambda t, q, v, u, p: u["push"] ** 2, t_b=1.0)
    >>> print(found.status, found.trajectory.q[100].round(9))
    least cost near the guess found 0.5

    - `controls`: `controls(t)` is a dict of the controls at a time; `controls.knots`, `controls.rows` are the numbers.
    - `trajectory`: the motion by `lj.integrate`, from the start found, under these controls.
    - `cost`: that of the program, on its elements; `cost_change`: by how much it changed when they were halved last,
      infinite where they were not.
    - `defect`: the largest distance of the integrated end from the end that was asked, in the units of each number;
      `defects`: by name, the integrated number less the asked one.
    - `system`, `params`: the system with its plan, which `lj.integrate` and all else take.
    - `t_b`: the time of the end, `[t]`.
    - `status`: what the solver says, in words, and whether `tol` was reached on the last elements; `success`: whether a
      motion that meets the end was found. `iterations` (of all meshes), `elements` (of the last).
    - `tried`: what each start led to on the first elements, in words.
    """

    controls: Plan
    trajectory: Trajectory
    cost: float
    cost_change: float
    defects: dict[str, float]
    system: System
    params: PyTree
    t_b: float
    status: str
    success: bool
    iterations: int
    elements: int
    tried: str = ""

    @property
    def defect(self) -> float:
        """The largest distance of the integrated end from the asked one."""
        return max((abs(x) for x in self.defects.values()), default=0.0)

    def plot(self):
        """Draw controls, coordinates and velocities against time.

        **Returns:** a matplotlib `Figure`.
        """
        t = np.linspace(float(self.controls.knots[0]), float(self.controls.knots[-1]), 1001)
        u = self.controls.at(t)
        controls = dict(zip(coordinates.names(self.controls.example), u.T))
        q, v = (_columns(x) for x in (self.trajectory.q, self.trajectory.v))
        at = np.asarray(self.trajectory.t)
        panels = {"controls": controls}
        panels |= {
            kind: {name: np.interp(t, at, x) for name, x in values.items()} for kind, values in (("q", q), ("v", v))
        }
        return plots.time_series(t, panels)

    def __repr__(self):
        worst = max(self.defects, key=lambda name: abs(self.defects[name]), default=None)
        rows = [
            ("status", self.status),
            ("cost", f"{self.cost:.12g}{self._change_in_words()}"),
            ("end", f"t = {self.t_b:.12g}"),
            ("defect", "nothing asked" if worst is None else f"{self.defect:.2g}, of {worst}: integrated less asked"),
            ("controls", ", ".join(coordinates.names(self.controls.example))),
            ("elements", f"{self.elements}, {self.iterations} iterations on all meshes"),
        ]
        rows += [("tried", self.tried)] if "; " in self.tried else []
        return labelled("Steering", rows)

    def _change_in_words(self) -> str:
        if not np.isfinite(self.cost_change):
            return ", on these elements alone"
        return f", which changed by {self.cost_change:.2g} from the elements before"


class Accuracy(NamedTuple):
    """By how much the cost changed on the last mesh, whether that is below `tol` of it, and `tol`."""

    change: float
    reached: bool
    tol: float

    def in_words(self, cost: float) -> str:
        """What there is to say beside the status."""
        if self.reached:
            return ""
        if not np.isfinite(self.change):
            return "; on one mesh alone, so that its error is not known: a larger `most` halves the elements"
        part = self.change / abs(cost) if cost else np.inf
        return f"; tol={self.tol:.0e} was not reached: the cost changed by {part:.1e} of it on the last elements"


class SteeredMotion(NamedTuple):
    """How the motion is integrated: outputs, tolerance, the most elements of a plan, and whether to raise."""

    outputs: int
    rtol: float
    room: int
    throw: bool


def steering_of(
    question: Question, layout: Layout, solved: SolverAnswer, motion: SteeredMotion, accuracy: Accuracy,
    iterations: int, tried: str,
) -> Steering:  # fmt: skip
    """The integrated motion under the controls that were found, beside what was asked."""
    plant, at = question.plant, layout.places
    t_a, t_b = question.t_a, float(solved.x[at["end"]][0])
    knots = t_a + (t_b - t_a) * solved.x[at["parts"]]
    rows = solved.x[at["controls"]][layout.of_controls]
    plan = plan_of(knots, rows, question.limits["controls"], plant.controls, plant.control_nodes, motion.room)
    system, params = following(question.system, plant.merge), Planned(question.params, plan)
    q, v = (plant.form.tree(solved.x[at[name]][0]) for name in "qv")
    trajectory = _integrated(question, system, params, (q, v), t_b, motion)
    defects = _defects(question, trajectory)
    status, success = STATUS.get(solved.status, solved.status), is_found(solved)
    if len(tried.split("; ")) > 1:
        status = status.replace("near the guess", f"of {len(tried.split('; '))} starts")
    status += accuracy.in_words(solved.cost) if success else ""
    path = solved.x[at["q"]]
    size = max(float(np.max(np.ptp(path, axis=0))), float(np.max(np.abs(path[-1]))))
    worst = max((abs(x) for name, x in defects.items() if name in question.names["q"]), default=0.0)
    if success and not worst <= MISSED * size:
        success, status = False, "what was found is no motion: under its controls the system ends elsewhere"
        if motion.throw:
            raise RuntimeError(
                f"lj.steer: {status}, {worst:.3g} from the end.\n"
                "Usual cause: a guess that runs through a singular configuration (a straight line through the pivot of "
                "a rod), or elements too long for what happens in one; or a motion that amplifies every error.\n"
                "Fix: guess=lambda t: q, a path along which the motion could go; elements=32."
            )
    return Steering(
        plan, trajectory, solved.cost, accuracy.change, defects, system, params, t_b, status, success, iterations,
        layout.count, tried,
    )  # fmt: skip


def _integrated(
    question: Question, system: System, params: Planned, start: tuple, t_b: float, motion: SteeredMotion
) -> Trajectory:
    # Times at which a plan is cut off at its bounds are many, and no more than kinks: only the user's own are sought.
    plant = question.plant
    own = (plant.system.lagrangian, plant.system.force, plant.system.dissipation)
    own_jumps = any(isinstance(f, Traced) and has_jumps(f.program.jaxpr) for f in own)
    jumps = "found" if own_jumps else "ignored"
    knots = params.plan.knots[1:-1]
    ends = np.append(knots, np.full(motion.room - len(knots), t_b))
    ts = np.linspace(question.t_a, t_b, motion.outputs)
    return integrate(system, *start, params, ts=ts, rtol=motion.rtol, jump_ts=ends, jumps=jumps, throw=motion.throw)


def compile_ahead(question: Question, motion: SteeredMotion) -> Thread:
    """Compile what integrates the motion beside the solver's own programs, on the first instants of a motion at rest.

    Neither needs the other's result, and both take seconds.
    """
    plant, t_a = question.plant, question.t_a
    t_b = t_a + 1e-6 * (question.t_b[0] - t_a)
    rows = np.broadcast_to(question.controls, (1, len(plant.control_nodes), plant.n_controls))
    knots = np.array([t_a, t_b])
    plan = plan_of(knots, rows, question.limits["controls"], plant.controls, plant.control_nodes, motion.room)
    system, params = following(question.system, plant.merge), Planned(question.params, plan)
    start = tuple(plant.form.tree(np.nan_to_num(x)) for x in question.ends[0])

    def run():
        # What goes wrong here goes wrong again in the motion itself, or never.
        with suppress(Exception):
            _integrated(question, system, params, start, t_b, motion._replace(throw=False))

    thread = Thread(target=run, daemon=True)
    thread.start()
    return thread


def _defects(question: Question, trajectory: Trajectory) -> dict[str, float]:
    """The integrated end less the asked one, by name."""
    plant, end, found = question.plant, trajectory.end, {}
    if plant.end is not None:
        values = coordinates.vector(plant.end(end.t, end.q, end.v, plant.params))
        found = {f"end[{i}]": float(x) for i, x in enumerate(np.asarray(values))}
    for kind, wanted, at_end in zip("qv", question.ends[1], (end.q, end.v)):
        off = np.asarray(coordinates.vector(at_end)) - wanted
        found |= {question.names[kind][i]: float(off[i]) for i in np.flatnonzero(np.isfinite(wanted))}
    return found


def _columns(tree: PyTree) -> dict[str, np.ndarray]:
    names = coordinates.names(jtu.tree_map(lambda x: np.asarray(x)[0], tree))
    return dict(zip(names, stacked(tree).T))


def is_found(solved: SolverAnswer) -> bool:
    """Whether the solver found a solution."""
    return solved.status in FOUND


def failure_in_words(question: Question, layout: Layout, solved: SolverAnswer, of_rows: tuple) -> str:
    """Why there is no solution, and the condition that is violated most."""
    text = f"lj.steer: {STATUS.get(solved.status, solved.status)}, after {solved.iterations} iterations.\n"
    low, high = of_rows
    off = np.maximum(np.maximum(low - solved.rows, solved.rows - high), 0.0)
    off = np.where(np.isfinite(off), off, np.inf)
    worst = int(np.argmax(off))
    if off[worst] > 1e-6:
        text += f"Violated most: {_row_in_words(question, layout, solved.x, worst)}, by {off[worst]:.3g}.\n"
    if solved.status == "Invalid_Number_Detected":
        return text + OF_NUMBERS
    return text + (OF_CONDITIONS if solved.status in CONTRADICTORY else OF_COST)


def _row_in_words(question: Question, layout: Layout, x: np.ndarray, row: int) -> str:
    kind, at = next((kind, at) for kind, at in layout.rows.items() if at.size and at.ravel()[-1] >= row)
    place = tuple(int(i[0]) for i in np.nonzero(at == row))
    parts, plant = x[layout.places["parts"]], question.plant
    t_b = float(x[layout.places["end"]][0])

    def time(element: int, part: float):
        return question.t_a + (t_b - question.t_a) * (parts[element] + part * (parts[element + 1] - parts[element]))

    if kind == "motion":
        element, node = divmod(place[0], plant.degree)
        element, node = (element, node) if element < layout.count else (element - 1, plant.degree)
        name, t = question.names["q"][place[1]], time(element, plant.rule.nodes[node])
        return f"the equation of motion of '{name}' at t = {t:.4g}"
    if kind == "bounded":
        name = question.names["v"][plant.bounded[place[2]]]
        return f"the bounds of '{name}' at t = {time(place[0], plant.rule.points[place[1]]):.4g}"
    if kind in ("positions", "velocities"):
        names = [
            residual.name
            for residual in plant.form.residuals
            for _ in range(residual.size)
            if residual.of_positions == (kind == "positions")
        ]
        return f"the constraint '{names[place[2]]}' at t = {time(place[0], plant.rule.points[place[1]]):.4g}"
    return f"condition {place[0]} of end(t, q, v, params)" if kind == "end" else f"the constraints at the {kind}"
