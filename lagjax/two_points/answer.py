"""The answer of `connect` from one start: a motion between two ends, and what kind of stationary path it is.

It is found as a path, whose kind is known (`second_variation.py`), and then as a motion (`shoot.py`). With velocity
constraints, and forces that depend on multipliers, there is no path, and the motion is found alone (`shoot.py`).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate import Trajectory, in_turn
from lagjax.jaxtools import compiled, stop_gradient
from lagjax.system import Model
from lagjax.two_points import shoot
from lagjax.two_points.path import (
    COMPLETE,
    FINE,
    FIXED,
    NATURAL,
    Ends,
    FoundPath,
    extent,
    found_path,
    halved,
    path_through,
    states,
)
from lagjax.two_points.second_variation import conjugate_times, index_at_nodes
from lagjax.two_points.shoot import FoundVelocity, found_by_shooting, misses_of, shoots_alone
from lagjax.two_points.starts import DEGREE, PathGuess, nodes_of

# Ends count as conjugate where an error of the path, but at least this round-off, decides what the start velocity is.
ROUND_OFF = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-5}

# The second variation of a path says nothing where its elements follow it less well than this.
UNRESOLVED = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}


class Connection(eqx.Module):
    """A motion between two ends; the answer of least action, where several were found.

    - `q`, `v`: the path at `t` (T,), in the structure of the ends; `multipliers` of its constraints by name.
    - `trajectory`: the motion of `integrate` from the start with `start_velocity`, on which the end is met; None where
      there is none: L is singular at the start, or an error there grows too much on the way (`alone` says which).
    - `start_velocity`, `end_velocity`: in the structure of the ends; `duration`: T = t_b - t_a.
    - `action`: S = ∫ L dt along the path, from which the motion is at no output farther than a thousandth of its
      extent; NaN where the motion was found by shooting alone (`lj.action` has it).
    - `index`: the Morse index, the number of independent variations with fixed ends that lower the action; -1 where
      there is no action principle. `kind`: the same in words. `conjugate_times`: the times of the points conjugate to
      the start, one for each direction; None while JAX traces.
    - `amplification`: the relative change of the start velocity by one of the end; large near a conjugate end.
    - `missed`: by how much `trajectory` misses the end, in units of the path's extent, and a condition in units of what
      it changes by on the way. `converged`: whether that is below 1e-6 (1e-3 in float32); where L is singular at the
      start, so that there is no motion, whether the path was found. A path that no motion follows is not `converged`:
      it is all that `q`, `v`, `action` and `index` are of.
    - `mesh_error`: the highest Legendre coefficients on its `elements`. By shooting alone there are none:
      `amplification` and `mesh_error` are NaN.
    - `others`: further answers, by rising action. `tried`: what was tried, in words. Where nothing was found, `q` and
      `v` are what came nearest, and there is no velocity, action, index or amplification.
    """

    t: Float[Array, " T"]
    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    trajectory: Trajectory | None
    start_velocity: PyTree[Float[Array, "..."]]
    end_velocity: PyTree[Float[Array, "..."]]
    duration: Float[Array, ""]
    action: Float[Array, ""]
    index: Int[Array, ""]
    amplification: Float[Array, ""]
    missed: Float[Array, ""]
    mesh_error: Float[Array, ""]
    converged: Bool[Array, ""]
    conjugate_times: Any
    others: "tuple[Connection, ...]" = ()
    tried: str = eqx.field(static=True, default="")
    elements: int = eqx.field(static=True, default=0)
    why_not_variational: str = eqx.field(static=True, default="")
    alone: str = eqx.field(static=True, default="")

    @property
    def kind(self) -> str:
        """ "minimum", "saddle of index 1", "degenerate: ends are conjugate", "not found", or why none."""
        if not bool(self.converged) and not self.alone:
            return "not found"
        if not bool(self.converged):
            return f"a path alone: {self.alone}"
        if self.why_not_variational:
            return f"not variational: {self.why_not_variational}"
        dtype = np.asarray(self.amplification).dtype
        if float(self.mesh_error) > UNRESOLVED[dtype]:
            return f"not resolved: the elements follow the path to {float(self.mesh_error):.0e}"
        if float(self.amplification) * max(float(self.mesh_error), ROUND_OFF[dtype]) > 0.1:
            return "degenerate: ends are conjugate"
        return "minimum" if int(self.index) == 0 else f"saddle of index {int(self.index)}"

    def plot(self, *names: str, **options):
        """Plot the motion: `Trajectory.plot`."""
        if self.trajectory is None:
            raise ValueError("there is a path and no motion to plot.\nFix: plot .t and .q yourself.")
        return self.trajectory.plot(*names, **options)

    def __repr__(self):
        if np.ndim(self.action) or not isinstance(self.action, (np.ndarray, np.generic, float)):
            try:
                action = np.asarray(self.action)
            except Exception:
                return "Connection(traced)"
            if action.ndim:
                return f"Connection({action.size} lanes)"
        if not bool(self.converged) and not self.alone:
            starts = f"; {self.tried.count('; ') + 1} starts, as `tried` says" if self.tried else ""
            return f"Connection(not found{starts})"
        motion = f"motion misses {float(self.missed):.0e}" if self.trajectory is not None else "no motion"
        more = f"; {len(self.others)} more" if self.others else ""
        found = f"action {float(self.action):.9g} in a time of {float(self.duration):.6g}; {self.elements} elements to "
        found += f"{float(self.mesh_error):.0e}"
        if not self.elements:
            found = f"in a time of {float(self.duration):.6g}; by shooting alone"
        return f"Connection({self.kind}; {found}, {motion}{more})"


MOST_ELEMENTS = 128
# An answer with larger highest coefficients on its elements is none.
COARSE = 0.05
# Answers whose start velocities and times differ by less, relative, are the same.
SAME = 1e-6
# A path this small, in parts of its start, does not move.
AT_REST = 1e-9
# How often elements are halved once more where no motion follows the path.
FINER = 2


class SolvedPath(NamedTuple):
    """A path with what is known of it."""

    found: FoundPath
    part: Float[Array, ""]
    index: Int[Array, " K"]
    errors: Float[Array, " K"]
    action: Float[Array, ""]
    amplification: Float[Array, ""]
    aim: shoot.Aim
    response: Float[Array, "n+b N+b"]
    course: shoot.ShotCourse


@compiled
def _solved(model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"]) -> SolvedPath:
    last = found_path(model, ends, path_through(model, ends, x, parts))
    found = last.found
    at_nodes = index_at_nodes(model, found, ends.kind == NATURAL)
    response = shoot.response_of(model, ends, found)
    scale = extent(ends, found.path)
    sizes = jnp.abs(response[: model.n, : model.n]) * scale[None] / scale[:, None] * found.path.duration(ends)
    course = shoot.ShotCourse(found.path, scale, jnp.max(last.errors))
    return SolvedPath(
        found, last.part, at_nodes, last.errors, _action(model, ends, found), jnp.max(sizes),
        shoot.start_of(model, ends, found), response, course,
    )  # fmt: skip


def _action(model: Model, ends: Ends, found: FoundPath) -> Float[Array, ""]:
    """S of the path, whose inner nodes are held: the path is stationary, so S has its right first derivatives."""
    still = lax.stop_gradient(found.path)
    if ends.kind == FIXED:
        still = still._replace(y=still.y.at[-1, -1, : model.n].set(ends.x_b))
    return still.action(model, ends)


def why_not_variational(model: Model, ends: Ends) -> str:
    """Why there is no action principle; empty where there is one."""
    if ends.switching is not None:
        return "there are " + ("phases" if ends.switching.in_phases else "elements")
    of = [name for name in ("force", "dissipation") if getattr(model.system, name) is not None]
    of += [] if model.holonomic.all() else ["velocity constraint"]
    return f"there is a {' and a '.join(of)}" if of else ""


def answer_from(
    model: Model, ends: Ends, guess: PathGuess, count: int, outputs: int, rtol
) -> tuple[SolvedPath | FoundVelocity, Connection | None, str]:
    """The path from one start, the answer if it is one, and what became of it in words."""
    x, parts = nodes_of(model, ends, guess, count, DEGREE)
    if shoots_alone(model, ends.switching):
        shot = found_by_shooting(model, ends, x, parts, outputs, rtol)
        if not float(shot.part) >= 1:
            return shot, None, f"Newton's method by integration failed beyond {float(shot.part):.2g} of the way"
        answer = _by_shooting(model, ends, shot, outputs, rtol)
        if not bool(answer.converged):
            return shot, None, f"the motion misses the end by {float(answer.missed):.1g} of its extent"
        return shot, answer, "found"
    fine = FINE.get(np.dtype(x.dtype), 1e-3)
    solved, error = _refined(model, ends, x, parts, fine)
    reach = np.max(np.abs(np.asarray(x) - np.asarray(ends.x_a)), axis=(0, 1))
    if 0 < np.max(np.asarray(solved.course.sizes)[reach > 0] / reach[reach > 0], initial=0.0) < AT_REST:
        # All that is left of the start is round-off: it is the straight line, on which nothing moves.
        solved, error = _refined(model, ends, *nodes_of(model, ends, PathGuess("at rest"), count, DEGREE), fine)
    if float(solved.part) < 1 and len(solved.errors) == count:
        return solved, None, f"Newton's method failed beyond {float(solved.part):.2g} of the way"
    if not error < COARSE:
        return solved, None, f"{len(solved.errors)} elements do not follow the path"
    at_nodes = np.asarray(solved.index)
    if not why_not_variational(model, ends) and (at_nodes.min() < 0 or np.any(np.diff(at_nodes[:-1]) < 0)):
        return solved, None, "a path through a singular point"
    shot = shoot.shot(model, ends, solved.course, solved.aim, solved.response, outputs, rtol)
    # A motion that amplifies errors needs a start that is as good as the path can be.
    for i in range(1 + FINER if isinstance(shot, str) and shot != shoot.SINGULAR else 0):
        if i:
            x, parts = halved(ends, solved.found.path)
            finer = _solved(model, ends, x, parts)
            if 2 * len(x) > MOST_ELEMENTS or not float(finer.part) >= 1 or not float(finer.course.error) < error:
                break
            solved, error = finer, float(finer.course.error)
        solved = solved._replace(aim=shoot.start_by_momentum(model, ends, solved.found))
        shot = shoot.shot(model, ends, solved.course, solved.aim, solved.response, outputs, rtol)
        if not isinstance(shot, str):
            break
    resolved = error <= UNRESOLVED[np.dtype(ends.x_a.dtype)]
    if isinstance(shot, str) and shot != shoot.SINGULAR and not resolved:
        return solved, None, f"neither {len(solved.errors)} elements nor a motion follow the path"
    answer = _by_path(model, ends, solved, shot, outputs)
    return solved, answer, "found" if bool(answer.converged) else f"a path alone, {answer.alone}"


def _refined(model: Model, ends: Ends, x: Array, parts: Array, fine: float) -> tuple[SolvedPath, float]:
    """The path on as many elements as it takes, and the error of these."""
    before = np.inf
    while True:
        solved = _solved(model, ends, x, parts)
        part, error = float(solved.part), float(np.max(solved.errors))
        # Where twice as many elements are hardly better, the path has a corner: no more of them help.
        if part < 1 or error <= fine or 2 * len(x) > MOST_ELEMENTS or error > before / 2:
            return solved, error if part >= 1 else np.inf
        before = error
        x, parts = halved(ends, solved.found.path)


@compiled
def _states(model: Model, ends: Ends, found: FoundPath, t: Float[Array, " T"]):
    """Positions, velocities and multipliers of a path."""
    y, u = states(ends, found.path, t)
    split = jax.vmap(model.split)(y[:, model.n :]) if model.m else {}
    return model.tree(y[:, : model.n]), model.tree(u), split


def _connection(model: Model, ends: Ends, aim: shoot.Aim, course: tuple, **others) -> Connection:
    """An answer; `course`: t, q, v and multipliers at the outputs, and the motion if there is one."""
    return Connection(
        *course, start_velocity=model.tree(aim.u), end_velocity=jax.tree.map(lambda x: x[-1], course[2]),
        duration=shoot.duration(ends, aim), why_not_variational=why_not_variational(model, ends), **others,
    )  # fmt: skip


def _course(trajectory: Trajectory) -> tuple:
    return trajectory.t, trajectory.q, trajectory.v, trajectory.multipliers, trajectory


def _by_motion(model: Model, ends: Ends, shot: shoot.Shot, well: Array, action: Array, **measures) -> Connection:
    """A motion, without a start velocity and an action where it misses the end, or else is no answer."""
    converged = well & shoot.meets(shot.trajectory, shot.size)
    aim, action = jax.tree.map(lambda x: jnp.where(converged, x, jnp.nan), (shot.aim, action))
    fields = dict(action=action, missed=shot.size, converged=converged, conjugate_times=None, **measures)
    return _connection(model, ends, aim, _course(shot.trajectory), **fields)


def _by_path(model: Model, ends: Ends, solved: SolvedPath, shot: shoot.Shot | str, outputs: int) -> Connection:
    """The motion where it meets the end; else the path alone, and why."""
    error, at_nodes = np.max(solved.errors), np.asarray(solved.index)
    why, times = why_not_variational(model, ends), None
    if not why and ends.kind != COMPLETE:
        times = conjugate_times(model, ends, solved.found, at_nodes)
    measures = dict(
        action=solved.action, index=np.asarray(-1 if why else at_nodes[-1]), amplification=solved.amplification,
        mesh_error=error, elements=len(solved.found.path.y), conjugate_times=times,
    )  # fmt: skip
    if not isinstance(shot, str):
        found = dict(missed=shot.size, converged=np.asarray(True))
        return _connection(model, ends, shot.aim, _course(shot.trajectory), **found, **measures)
    t = shoot.times(ends, solved.aim, outputs)
    resolved = error <= UNRESOLVED[np.dtype(ends.x_a.dtype)]
    found = dict(missed=np.asarray(np.nan, t.dtype), converged=np.asarray(shot == shoot.SINGULAR and resolved))
    return _connection(
        model, ends, solved.aim, (t, *_states(model, ends, solved.found, t), None), **found, **measures, alone=shot
    )


def _by_shooting(model: Model, ends: Ends, found: FoundVelocity, outputs: int, rtol=None, **options) -> Connection:
    """The motion from a start that was found without a path, or that comes nearest."""
    trajectory = shoot.motion(model, ends, found.aim, outputs, rtol, **options)
    shot = shoot.Shot(found.aim, misses_of(model, ends, found.aim, trajectory), trajectory)
    unknown = jnp.full((), jnp.nan, found.aim.u.dtype)
    none = dict(index=jnp.asarray(-1), amplification=unknown, mesh_error=unknown)
    return _by_motion(model, ends, shot, found.part >= 1, unknown, **none)


def not_found(model: Model, ends: Ends, solved: SolvedPath | FoundVelocity, outputs: int, words: str) -> Connection:
    """What there is where no path is an answer."""
    if isinstance(solved, FoundVelocity):
        nearest = _by_shooting(model, ends, solved, outputs, throw=False, estimate_error=False)
    else:
        nearest = _by_path(model, ends, solved, "", outputs)
    nothing = np.asarray(np.nan, nearest.t.dtype)
    velocities = jax.tree.map(lambda x: np.full(np.shape(x), nothing), (nearest.start_velocity, nearest.end_velocity))
    return replace(
        nearest, start_velocity=velocities[0], end_velocity=velocities[1], action=nothing, index=np.asarray(-1),
        amplification=nothing, missed=nothing, mesh_error=nothing, converged=np.asarray(False), conjugate_times=None,
        duration=nothing if ends.free_time else nearest.duration, tried=words,
    )  # fmt: skip


def is_same(a: Connection, b: Connection) -> bool:
    """Whether two answers are the same: by start velocity and time, and at the outputs.

    Motions that amplify errors may start alike, and be others.
    """
    times, starts, q, v = (
        [np.concatenate([np.ravel(x) for x in jax.tree.leaves(getattr(c, name))]) for c in (a, b)]
        for name in ("duration", "start_velocity", "q", "v")
    )
    # At rest all velocities are round-off.
    speed = max(np.max(np.abs(v)), SAME * max(np.max(np.abs(q)), 1.0) / float(a.duration))
    return bool(
        abs(times[0] - times[1]) <= SAME * abs(times[0])
        and np.max(np.abs(starts[0] - starts[1])) <= SAME * speed
        and np.max(np.abs(q[0] - q[1])) <= shoot.ALONG * np.max(np.abs(q))
        and np.max(np.abs(v[0] - v[1])) <= shoot.ALONG * speed
    )


# -- In a program. --


@compiled
def inside(model: Model, ends: Ends, guess: PathGuess, count: int, outputs: int, rtol) -> Connection:
    """The answer from one start in a program, with derivatives in both modes."""
    start = stop_gradient(nodes_of(*stop_gradient((model, ends)), guess, count, DEGREE))
    if shoots_alone(model, ends.switching):
        found = found_by_shooting(model, ends, *start, 2, rtol)
        return _by_shooting(model, ends, found, outputs, rtol, throw=False, estimate_error=False)
    solved, shot = _search((model, ends), start, jnp.asarray(rtol, ends.x_a.dtype), outputs=outputs)
    error = jnp.max(solved.errors)
    return _by_motion(
        model, ends, shot, (solved.part >= 1) & (error < COARSE), _action(model, ends, solved.found),
        index=jnp.asarray(-1) if why_not_variational(model, ends) else solved.index[-1],
        amplification=solved.amplification, mesh_error=error, elements=count, tried=guess.name,
    )  # fmt: skip


@eqx.filter_custom_jvp
def _search(problem: tuple[Model, Ends], start: tuple[Array, Array], rtol: Array, *, outputs: int):
    """The path and its motion. Neither the search for it nor its steps are differentiated, but the equations of the
    end, at the answer."""

    def search(problem: tuple[Model, Ends], start: tuple[Array, Array], rtol: Array) -> tuple[SolvedPath, shoot.Shot]:
        solved = _solved(*problem, *start)
        return solved, shoot.shot_inside(*problem, solved.course, solved.aim, solved.response, outputs, rtol)

    return in_turn(search, problem, start, rtol)


@_search.def_jvp
def _search_jvp(primals: tuple, tangents: tuple, *, outputs: int):
    problem, start, rtol = primals
    solved, shot = _search(problem, start, rtol, outputs=outputs)

    def at_answer(problem: tuple[Model, Ends]) -> tuple[shoot.Aim, Trajectory]:
        aim = shoot.implicit(*problem, shot.aim, solved.response, 2, rtol)
        return aim, shoot.motion(*problem, aim, outputs, rtol, throw=False, estimate_error=False)

    _, (aim, trajectory) = eqx.filter_jvp(at_answer, (problem,), (tangents[0],))
    nothing = jax.tree.map(lambda _: None, (solved, shot.size))
    return (solved, shot), (nothing[0], shoot.Shot(aim, nothing[1], trajectory))
