"""Where the search for controls begins: a straight line, what is known of the path and the controls, an earlier answer,
and random starts beside it.

What is known in time is taken in parts of the whole time, so that an earlier answer fits another time; to other ends
its path is moved by the straight line between what is missing at both.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from lagjax.mechanics import listed
from lagjax.system import coordinates
from lagjax.two_points.layout import Layout
from lagjax.two_points.mesh import Mesh
from lagjax.two_points.path import FIXED, Ends
from lagjax.two_points.question import Question
from lagjax.two_points.starts import WAVES, Sizes, sizes_of
from lagjax.two_points.steering import Steering

# The waves on the path, in units of its sizes, and on controls, in units of half their bounds; and the parts of the
# time that a start waits for, in turn.
ON_PATH, ON_CONTROLS, WAITS = (0.5, 1.0, 0.25), 0.5, (0.0, 0.25, 0.0, 0.5)


class FirstPlan(NamedTuple):
    """Positions (m, n), controls (m, k) and multipliers of a start, as functions of parts (m,) of the time; its end."""

    path: Callable
    controls: Callable
    t_b: float
    name: str


def split_controls(controls: Any, t_a: float) -> tuple[Any, Callable | None]:
    """The controls at the start, and those of all times where a guess of them depends on time: `u(t)` -> controls.

    A guess in time is a function, a pair (times, values) between which it is linear, or one function of all controls.
    """
    if callable(controls):
        return controls(t_a), controls
    if not isinstance(controls, Mapping):
        return controls, None
    in_time = {name: known for name, guess in controls.items() if (known := _in_time(name, guess)) is not None}
    if not in_time:
        return controls, None

    def at(t: float) -> dict:
        return {name: in_time[name](t) if name in in_time else guess for name, guess in controls.items()}

    return at(t_a), at


def _in_time(name: str, guess: Any) -> Callable | None:
    if callable(guess):
        return guess
    if not (isinstance(guess, tuple) and len(guess) == 2 and np.ndim(guess[0]) == 1):
        return None
    times, values = (np.asarray(x, float) for x in guess)
    if len(times) < 2 or values.shape[:1] != times.shape or np.any(np.diff(times) <= 0):
        raise ValueError(
            f"the guess of the control '{name}' is a pair of {times.shape} times and {values.shape} values.\n"
            "Usual cause: times that do not increase, or another number of values.\n"
            f'Fix: {{"{name}": (times, values)}}, times (T,) and values (T, ...); or a function of t, or one number.'
        )

    def at(t: float) -> np.ndarray:
        return np.apply_along_axis(lambda column: np.interp(t, times, column), 0, values)

    return at


def first_plan(question: Question, guess: Callable | Steering | None, controls_at: Callable | None) -> FirstPlan:
    """The start that is asked for."""
    (low, high), t_a = question.t_b, question.t_a
    t_b, name = t_a + float(np.sqrt((low - t_a) * (high - t_a))), "the straight line" if guess is None else "the guess"
    path = straight(question)
    if isinstance(guess, Steering):
        _check_alike(question, guess)
        t_b, name = float(np.clip(guess.t_b, low, high)), "the earlier answer"
        path = _moved_to_ends(question, _path_of(guess))
        controls_at = controls_at or (lambda t: guess.controls(_as_before(guess, (t - t_a) / (t_b - t_a))))
    elif guess is not None:
        if not callable(guess):
            raise TypeError(
                f"guess is a function of t or an earlier Steering, not {type(guess).__name__}.\n"
                'Fix: guess=lambda t: {"x": 0.5 * t}, like the coordinates.'
            )

        def path(shares: np.ndarray) -> np.ndarray:
            return np.stack([coordinates.vector(guess(t)) for t in t_a + shares * (t_b - t_a)])

    return FirstPlan(path, _controls(question, controls_at, t_a, t_b), t_b, name)


def straight(question: Question) -> Callable:
    """The straight line between the ends, as a function of parts of the time."""
    first, last = (end.q for end in question.ends)
    # A free number is what it is at the other end.
    first, last = np.where(np.isnan(first), np.nan_to_num(last), first), np.where(np.isnan(last), first, last)
    last = np.where(np.isnan(last), first, last)
    return lambda shares: first + shares[:, None] * (last - first)


def _check_alike(question: Question, guess: Steering):
    ours, names = question.names, coordinates.names
    of_q, of_u = names(jax.tree.map(lambda x: np.asarray(x)[0], guess.trajectory.q)), names(guess.controls.example)
    for what, theirs, known in (("coordinates", of_q, ours["q"]), ("controls", of_u, ours["controls"])):
        if list(theirs) != list(known):
            raise ValueError(
                f"the guess is a Steering whose {what} are {listed(theirs)}, and here they are {listed(known)}.\n"
                "Usual cause: an answer for another system.\nFix: guess=lambda t: q of a path."
            )


def _as_before(guess: Steering, share: float) -> float:
    start, end = float(guess.controls.knots[0]), guess.t_b
    return start + share * (end - start)


def _path_of(guess: Steering) -> Callable:
    motion, flat = guess.trajectory, jax.vmap(lambda tree: coordinates.flatten(tree)[0])
    spline = CubicHermiteSpline(motion.t, np.asarray(flat(motion.q)), np.asarray(flat(motion.v)))
    return lambda shares: spline([_as_before(guess, share) for share in shares])


def _moved_to_ends(question: Question, path: Callable) -> Callable:
    edges = path(np.array([0.0, 1.0]))
    off = [np.nan_to_num(end.q - x) for end, x in zip(question.ends, edges)]
    return lambda shares: path(shares) + off[0] + shares[:, None] * (off[1] - off[0])


def _controls(question: Question, controls_at: Callable | None, t_a: float, t_b: float) -> Callable:
    if controls_at is None:
        return lambda shares: np.broadcast_to(question.controls, (len(shares), question.controls.size))
    return lambda shares: np.stack([coordinates.vector(controls_at(t)) for t in t_a + shares * (t_b - t_a)])


def random_plans(question: Question, first: FirstPlan, count: int, known: np.ndarray) -> list[FirstPlan]:
    """Starts beside the first one: random waves on the path and the controls, and waits before it.

    `known`: controls (m, k) of an answer, as large as which controls are that have no bounds.
    """
    sizes, random, plans = _sizes(question, first.t_b).sizes, np.random.default_rng(0), []
    low, high = question.limits["controls"]
    largest = np.maximum(np.max(np.abs(known), axis=0), np.abs(question.controls))
    with np.errstate(invalid="ignore"):
        of_controls = np.where(np.isfinite(high - low), (high - low) / 2, largest)
    falling = 1 / np.arange(1, WAVES + 1)[:, None]
    for i in range(count):
        on_path = ON_PATH[i % len(ON_PATH)] * falling * random.normal(size=(WAVES, sizes.size)) * sizes
        on_controls = ON_CONTROLS * falling * random.normal(size=(WAVES, of_controls.size)) * of_controls
        plans.append(_waved(first, on_path, on_controls, WAITS[i % len(WAITS)], f"random start {i + 1}"))
    return plans


def _waved(first: FirstPlan, on_path: np.ndarray, on_controls: np.ndarray, wait: float, name: str) -> FirstPlan:
    orders = np.arange(1, WAVES + 1)

    def later(shares: np.ndarray) -> np.ndarray:
        return np.clip((shares - wait) / (1 - wait), 0.0, 1.0)

    def path(shares: np.ndarray) -> np.ndarray:
        return first.path(later(shares)) + np.sin(np.pi * later(shares)[:, None] * orders) @ on_path

    def controls(shares: np.ndarray) -> np.ndarray:
        return first.controls(later(shares)) + np.cos(np.pi * shares[:, None] * orders) @ on_controls

    return FirstPlan(path, controls, first.t_b, name)


def _sizes(question: Question, t_b: float) -> Sizes:
    plant, path = question.plant, straight(question)(np.array([0.0, 1.0]))
    model = plant.model(jnp.asarray(question.controls))
    ends = Ends(plant.t_a, *map(jnp.asarray, (*path, t_b - question.t_a)), None, FIXED, False, 0)
    sizes = sizes_of(model, ends)
    low, high = question.limits["q"]
    with np.errstate(invalid="ignore"):
        return sizes._replace(
            sizes=np.minimum(sizes.sizes, np.where(np.isfinite(high - low), (high - low) / 2, np.inf))
        )


def unknowns(question: Question, layout: Layout, mesh: Mesh, plan: FirstPlan) -> np.ndarray:
    """The unknowns of a start."""
    plant, at, x = question.plant, layout.places, np.zeros(layout.size)
    x[at["end"]], x[at["parts"]] = plan.t_b, mesh.parts
    width = np.diff(mesh.parts)[:, None]
    shares = np.append((mesh.parts[:-1, None] + width * plant.rule.nodes[:-1]).ravel(), 1.0)
    path = np.asarray(plan.path(shares))
    x[at["q"]] = np.clip(path, *question.limits["q"])
    slopes = (path[1] - path[0]) / shares[1], (path[-1] - path[-2]) / (1 - shares[-2])
    x[at["v"]] = np.stack(slopes) / (plan.t_b - question.t_a)
    of_controls = mesh.parts
    if plant.interpolation != "linear":
        of_controls = (mesh.parts[:-1, None] + width * plant.control_nodes).ravel()
    x[at["controls"]] = np.clip(np.asarray(plan.controls(of_controls)), *question.limits["controls"])
    return x
