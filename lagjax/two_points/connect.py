"""`connect`: the motions from one configuration to another.

check the ends  ->  a path for each start (`path_mesh.py`)  ->  its motion (`shoot.py`)  ->  sort, say what was found
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.jaxtools import compiled, is_eager, is_traced, stop_gradient
from lagjax.mechanics import describe, listed
from lagjax.system import (
    OF_STATE,
    Call,
    Model,
    State,
    System,
    check_system,
    checked,
    constraints,
    coordinates,
    model_of,
    traced_call,
)
from lagjax.two_points import elements, index, path, path_mesh, shoot
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import COMPLETE, FIXED, NATURAL, Ends, FoundPath
from lagjax.two_points.result import Connection

DEGREE, ELEMENTS, MOST_ELEMENTS = 6, 16, 128
# Elements are doubled until the highest coefficients on them are below this.
FINE = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# An answer with larger ones is none.
COARSE = 0.05
# Ends may be off the constraints by this part of their size.
OFF = 1e-6
# Answers whose start velocities and times differ by less, relative, are the same.
SAME = 1e-6
# Random waves on a straight start, in units of its length; and starts that follow where it leads nowhere.
WAVES, AMPLITUDES, FURTHER = 3, (1.0, 0.5, 0.25), 3
TOLERANCE = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}


class ConnectWarning(UserWarning):
    """No motion was found between two ends, or not as accurate a one as was asked for."""


def connect(
    system: System,
    q_a: PyTree[ArrayLike],
    q_b: PyTree[ArrayLike],
    t_a: ArrayLike,
    t_b: ArrayLike,
    params: PyTree = None,
    *,
    end: Callable | None = None,
    free_time: bool = False,
    starts: int | Callable | Sequence[Callable] = 1,
    elements: int = ELEMENTS,
    outputs: int = 33,
    rtol: ArrayLike | None = None,
    quiet: bool = False,
) -> Connection:
    """Find the motions that lead from one configuration to another in a given time, and say of what kind they are.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> throw = connect(fall, 0.0, 3.0, 0.0, 1.0, {"g": 10.0})
    >>> print(f"{throw.start_velocity:.9f} {throw.action:.9f}", throw.kind)
    8.000000000 -14.666666667 minimum

    **Main arguments:**

    - `system`, `params`: a `System`, with or without holonomic constraints, forces and dissipation; its parameters.
    - `q_a`, `q_b`: the ends, alike; `[q]`. An angle that goes round differs by its turns. They lie on the constraints.
    - `t_a`, `t_b`: the times of the ends, `[t]`, t_b > t_a.

    **Other arguments:**

    - `end`: conditions `end(t, q, v, params)` -> scalar or (c,) in place of the end q_b, which is then a guess. Of
      positions (and time) alone they are at most as many as coordinates, and the rest is transversality: no momentum
      along what they leave free. Of velocities, they are as many as the coordinates that constraints leave.
    - `free_time`: whether t_b is a guess. Without a further condition among those of `end` that depend on velocities,
      the time is that of stationary action, with no energy h at the end.
    - `starts`: how many starts: the straight line, and others with random waves on it; or a function q(t), or several.
      Where the straight line alone leads to no answer, three random starts follow.
    - `elements`: of the path, at first. They are laid anew where the path needs them, and outside of `jit` and `vmap`
      doubled until it is followed.
    - `outputs`: the number of output times, equally spaced. `rtol`: the tolerance of the motion, 1e-13 in float64.
    - `quiet`: no warning where no motion is found.

    **Returns:** a `Connection`; further answers in its `others`. Differentiable in both modes by `params` and the ends
    (first derivatives), under `jit` and `vmap` from the first start.

    **Raises:** `TypeError`, `ValueError` for ends of different structure, off the constraints, or at the same time; for
    too many or too few conditions; for velocity constraints. Warns (`ConnectWarning`) where no motion was found, which
    `converged` says under `jit` and `vmap`.

    Source: Milnor, *Morse Theory*, §15; Marsden & West, *Acta Numerica* 10 (2001) 357. See `path.py`, `index.py`.
    """
    check_system(system, q_a, q_b, params)
    model, ends = _problem(system, q_a, q_b, t_a, t_b, params, end, free_time)
    dtype = np.dtype(ends.x_a.dtype)
    rtol = TOLERANCE.get(dtype, 1e-5) if rtol is None else rtol
    guesses = _guesses(model, starts)
    if not is_eager() or is_traced((model, ends)):
        return _inside(model, ends, guesses[0], elements, outputs, rtol)
    found, tried, wanted = [], [], len(guesses)
    if starts == 1:
        # A straight line may lead through a singular point, as the centre of a sphere.
        guesses = _guesses(model, 1 + FURTHER)
    for i, (name, guess) in enumerate(guesses):
        if i >= wanted and found:
            break
        answer, why = _answer(model, ends, guess, elements, outputs, rtol)
        tried.append(f"{name}: {why}")
        if answer is not None and not any(_same(answer, other) for other in found):
            found.append(answer)
    words = "; ".join(tried)
    if not found and not quiet:
        warnings.warn(
            f"no motion was found from {describe(model.tree(ends.x_a))} to {describe(model.tree(ends.x_b))} in a time "
            f"of {float(ends.duration):.6g}. Tried: {words}.\n"
            "Usual cause: no such motion (an end out of reach), a path through a singularity of L, or a start too far "
            "away.\n"
            "Fix: starts=8 for more starts; starts=lambda t: ... for a path that you know; a shorter time.",
            ConnectWarning,
            stacklevel=2,
        )
    if not found:
        solved = _solved(model, stop_gradient(ends), *_straight(model, ends, guesses[0][1], elements))
        return replace(_connection(model, ends, solved, None, outputs, words), converged=jnp.asarray(False))
    if not _why_not_variational(model):
        found.sort(key=lambda answer: float(answer.action))
    first = found[0]
    return replace(first, others=tuple(found[1:]), tried=words)


# -- The problem: checked arguments. --


def _problem(system, q_a, q_b, t_a, t_b, params, end, free_time) -> tuple[Model, Ends]:
    system, s = checked(system, State(t_a, q_a, q_a, params))
    model = model_of(system, *s)
    _check_alike(q_a, q_b)
    other = coordinates.state(t_b, q_b, q_b, s.params)
    if any(not c.of_positions for c in system.constraints.values()):
        names = [name for name, c in system.constraints.items() if not c.of_positions]
        raise ValueError(
            f"constraint {listed(names)} restricts velocities, so only some ends can be reached in a given time, and "
            "connect does not find out which.\n"
            "Fix: lj.steer for a system with controls; a lj.Holonomic in place of a velocity constraint that can be "
            "integrated."
        )
    if model.reacts:
        raise ValueError(
            "the force depends on multipliers, which connect does not take.\nFix: leave the friction out of the guess, "
            "and shoot with lj.integrate."
        )
    dtype = s.t.dtype
    t_a, duration = s.t, jnp.asarray(other.t, dtype) - s.t
    (x_a, _), (x_b, _) = model.vectors(s.q, s.q), model.vectors(other.q, other.q)
    x_b = x_b.astype(dtype)
    if not is_traced(duration) and not float(duration) > 0:
        raise ValueError(
            f"t_b = {float(other.t):.9g} is not after t_a = {float(s.t):.9g}.\n"
            "Fix: exchange the ends, or give another time."
        )
    condition, kind, count = None, FIXED, 0
    if end is not None:
        condition, kind, count = _conditions(model, s, end, free_time)
    x_a, x_b = _on_constraints(model, t_a, x_a, "q_a"), (
        _on_constraints(model, t_a + duration, x_b, "q_b") if kind == FIXED
        else path_mesh.onto_constraints(model, t_a + duration, x_b)
    )  # fmt: skip
    return model, Ends(t_a, x_a, x_b, duration, condition, kind, bool(free_time), count)


def _check_alike(q_a: PyTree, q_b: PyTree):
    shapes = [jax.tree.map(jnp.shape, q) for q in (q_a, q_b)]
    if jax.tree.structure(q_a) != jax.tree.structure(q_b) or shapes[0] != shapes[1]:
        raise ValueError(
            f"q_b must have the structure and shapes of q_a.\n  q_a: {shapes[0]}\n  q_b: {shapes[1]}\n"
            "Usual cause: a coordinate left out of one end.\n"
            "Fix: give both ends all coordinates; a coordinate that is free at the end needs end=..., not a gap."
        )


class EndCondition(NamedTuple):
    """A condition on the end as a function of vectors."""

    function: Callable
    model: Model

    def __call__(self, t: Array, x: Array, u: Array) -> Array:
        return jnp.atleast_1d(self.function(t, self.model.tree(x), self.model.tree(u), self.model.params))


def _conditions(model: Model, s: State, end: Callable, free_time: bool):
    """The condition on vectors, its kind, and how many equations it is."""
    call = Call("end", end, OF_STATE)
    function = traced_call(call, dict(zip(OF_STATE, s)), _check_condition)
    condition = EndCondition(function, model)
    x, u = model.vectors(s.q, s.v)
    count = jax.eval_shape(condition, s.t, x, u).shape[0]
    of_velocity = _depends_on_velocity(condition, s.t, x, u)
    left = model.n - model.m
    if not of_velocity:
        if count > left:
            raise ValueError(_count(count, f"at most {left}", model, "conditions of positions"))
        return condition, NATURAL, count
    wanted = left + free_time
    if count != wanted:
        raise ValueError(_count(count, f"{wanted}", model, "conditions with velocities", free_time))
    return condition, COMPLETE, count


def _depends_on_velocity(condition: Callable, t: Array, x: Array, u: Array) -> bool:
    program = jax.make_jaxpr(lambda u: condition(t, x, u))(u)
    from_u = set(program.jaxpr.invars)
    for equation in program.jaxpr.eqns:
        if any(not hasattr(x, "val") and x in from_u for x in equation.invars):
            from_u.update(equation.outvars)
    return any(not hasattr(x, "val") and x in from_u for x in program.jaxpr.outvars)


def _check_condition(call: Call, value):
    shape = getattr(value, "shape", None)
    if shape is None or len(shape) > 1 or 0 in shape:
        raise ValueError(
            f"{call} must return a scalar or a vector that vanishes at the end, and returned "
            f"{'an array of shape ' + str(shape) if shape is not None else type(value).__name__}.\n"
            "Fix: return jnp.stack([...]) of the conditions."
        )


def _count(count: int, wanted: str, model: Model, what: str, free_time: bool = False) -> str:
    numbers = {0: "no", 1: "one"}
    there = f"{model.n} coordinates" if model.n != 1 else "one coordinate"
    less = f", {model.m} of them bound by constraints" if model.m else ""
    time = " and the free time" if free_time else ""
    verb, what = ("are", what) if count != 1 else ("is", what.replace("conditions", "condition"))
    return (
        f"there {verb} {numbers.get(count, count)} {what} on the end, and there must be {wanted}: {there}{less}"
        f"{time}.\n"
        "Usual cause: a condition that says the same twice, or a velocity forgotten.\n"
        "Fix: end(t, q, v, params) -> jnp.stack([...]) of that many."
    )


def _on_constraints(model: Model, t: Array, x: Array, name: str) -> Array:
    """An end moved onto the constraints by round-off; raises where it is farther away."""
    if not model.m:
        return x
    near = path_mesh.onto_constraints(model, t, x)
    if not is_traced((near, t)):
        off = float(jnp.max(jnp.abs(near - x))) / max(float(jnp.max(jnp.abs(x))), 1e-300)
        if not off < OFF:
            worst = model.equation_names[int(np.argmax(np.abs(constraints.position_residual(model, t, x))))]
            raise ValueError(
                f"{name} is off the constraints by {off:.2g} of its size; worst is '{worst}'.\n"
                "Usual cause: an end in rounded numbers, or one out of reach of the mechanism.\n"
                f"Fix: {name}, _ = lj.consistent_state(system, t, {name}, v, params), v of zeros."
            )
    return near


# -- Starts. --


def _guesses(model: Model, starts) -> list[tuple[str, Any]]:
    """Each start by name: a function of the part of the way, the times and the ends."""
    if callable(starts):
        return [("the given path", starts)]
    if not isinstance(starts, int):
        return [(f"given path {i + 1}", start) for i, start in enumerate(starts)]
    if starts < 1:
        raise ValueError(f"starts={starts}: there must be one at least.\nFix: starts=1, the straight line.")
    random = np.random.default_rng(0)
    falling = 1 / np.arange(1, WAVES + 1)[:, None]
    waves = [AMPLITUDES[i % 3] * falling * random.normal(size=(WAVES, model.n)) for i in range(starts - 1)]
    return [("straight line", None), *((f"random start {i + 1}", wave) for i, wave in enumerate(waves))]


def _straight(model: Model, ends: Ends, guess, count: int):
    """The nodes (K, s, n) of a start, and where its elements meet."""
    parts = jnp.linspace(0.0, 1.0, count + 1, dtype=ends.x_a.dtype)
    nodes = rule_of_degree(DEGREE).nodes[1:].astype(ends.x_a.dtype)
    at = parts[:-1, None] + jnp.diff(parts)[:, None] * nodes[None]
    if callable(guess):
        t = ends.t_a + ends.duration * at
        return jax.vmap(jax.vmap(lambda t: model.vector(coordinates.as_floats(guess(t)))))(t), parts
    x = ends.x_a[None, None] + at[..., None] * (ends.x_b - ends.x_a)[None, None]
    if guess is None:
        return x, parts
    size = jnp.max(jnp.abs(ends.x_b - ends.x_a))
    size = jnp.where(size > 0, size, jnp.maximum(jnp.max(jnp.abs(ends.x_a)), 1.0))
    shape = jnp.sin(jnp.pi * at[..., None] * np.arange(1, WAVES + 1, dtype=x.dtype)[None, None])
    return x + size * jnp.einsum("ksw,wn->ksn", shape, jnp.asarray(guess, x.dtype)), parts


# -- One answer. --


class SolvedPath(NamedTuple):
    """A path with what is known of it."""

    found: FoundPath
    part: Array
    attempts: Array
    index: Array
    errors: Array
    action: Array
    amplification: Array
    aim: shoot.Aim
    response: Array


@compiled
def _solved(model: Model, ends: Ends, x: Array, parts: Array) -> SolvedPath:
    start = path_mesh.path_through(model, ends, x, parts)
    last = path_mesh.found_path(model, ends, start)
    found = last.found
    at_nodes = index.index_at_nodes(model, found)
    at_nodes = at_nodes.at[-1].set(index.index_of_free_end(model, found)) if ends.kind == NATURAL else at_nodes
    response = shoot.response_of(model, ends, found)
    scale = path.extent(ends, found.path)
    sizes = jnp.abs(response[: model.n, : model.n]) * scale[None] / scale[:, None] * found.path.duration(ends)
    return SolvedPath(
        found, last.part, last.attempts, at_nodes, path_mesh.errors(ends, found.path), _action(model, ends, found),
        jnp.max(sizes), shoot.start_of(model, ends, found), response,
    )  # fmt: skip


def _action(model: Model, ends: Ends, found: FoundPath) -> Array:
    """S of the path, whose inner nodes are held: the path is stationary, so S has its right first derivatives."""
    still = lax.stop_gradient(found.path)
    n, rule = model.n, rule_of_degree(still.y.shape[1])
    if ends.kind == FIXED:
        still = still._replace(y=still.y.at[-1, -1, :n].set(ends.x_b))
    nodes, (t, h) = still.nodes(ends), still.times(ends)

    def of_element(t: Array, h: Array, nodes: Array) -> Array:
        s = elements.discrete_action(model, rule, t, h, nodes[:, :n])
        if nodes.shape[1] == n:
            return s
        times = t + h * rule.nodes.astype(nodes.dtype)
        g = jax.vmap(lambda t, x: constraints.position_residual(model, t, x))(times, nodes[:, :n])
        return s + h * jnp.sum(rule.node_weights.astype(nodes.dtype)[:, None] * g * nodes[:, n:])

    return jnp.sum(jax.vmap(of_element)(t, h, nodes))


def _why_not_variational(model: Model) -> str:
    of = [name for name in ("force", "dissipation") if getattr(model.system, name) is not None]
    return f"there is a {' and a '.join(of)}" if of else ""


def _answer(model: Model, ends: Ends, guess, count: int, outputs: int, rtol) -> tuple[Connection | None, str]:
    """The answer from one start, or None, and what became of it in words."""
    x, parts = _straight(model, ends, guess, count)
    fine, before = FINE.get(np.dtype(x.dtype), 1e-3), np.inf
    while True:
        solved = _solved(model, ends, x, parts)
        error = float(jnp.max(solved.errors))
        # Where twice as many elements are hardly better, the path has a corner: no more of them help.
        if float(solved.part) < 1 or error <= fine or 2 * len(x) > MOST_ELEMENTS or error > before / 2:
            break
        before = error
        x, parts = _halved(solved.found.path, ends)
    if float(solved.part) < 1 and len(x) == count:
        return None, f"Newton's method failed beyond {float(solved.part):.2g} of the way"
    error = error if float(solved.part) >= 1 else np.inf
    if not error < COARSE:
        return None, f"{len(x)} elements do not follow the path"
    at_nodes = np.asarray(solved.index)
    if not _why_not_variational(model) and (at_nodes.min() < 0 or np.any(np.diff(at_nodes[:-1]) < 0)):
        return None, "a path through a singular point"
    shot = shoot.shot(model, ends, solved.aim, solved.response, outputs, rtol)
    return _connection(model, ends, solved, shot, outputs, rtol=rtol), "found"


def _halved(of: path.Path, ends: Ends):
    """The nodes on elements of half the length."""
    s, n = of.y.shape[1], ends.x_a.size
    nodes, parts = np.asarray(of.nodes(ends))[..., :n], np.asarray(of.parts)
    rule = rule_of_degree(s)
    values, _ = elements.lagrange(rule.nodes, np.concatenate([rule.nodes[1:] / 2, (1 + rule.nodes[1:]) / 2]))
    x = np.einsum("pj,kjn->kpn", values, nodes).reshape(-1, s, n)
    middles = (parts[:-1] + parts[1:]) / 2
    return jnp.asarray(x, of.y.dtype), jnp.asarray(np.sort(np.concatenate([parts, middles])), of.y.dtype)


@compiled
def _states(model: Model, ends: Ends, found: FoundPath, aim: shoot.Aim, t: Array):
    """Positions, velocities and multipliers of a path."""
    y, u = path_mesh.states(ends, found.path, t)
    split = jax.vmap(model.split)(y[:, model.n :]) if model.m else {}
    return model.tree(y[:, : model.n]), model.tree(u), split


def _connection(
    model: Model, ends: Ends, solved: SolvedPath, shot: shoot.Shot | None, outputs: int, words: str = "", rtol=None
) -> Connection:
    aim = solved.aim if shot is None else shot.aim
    trajectory = None
    if shot is not None:
        trajectory = shoot.motion(model, ends, aim, outputs, rtol)
        t, q, v, multipliers = (getattr(trajectory, name) for name in ("t", "q", "v", "multipliers"))
    else:
        t = shoot.times(ends, aim, outputs)
        q, v, multipliers = _states(model, ends, solved.found, aim, t)
    why = _why_not_variational(model)
    at_nodes = np.asarray(solved.index)
    times = None if why or ends.kind == COMPLETE else index.conjugate_times(model, ends, solved.found, at_nodes)
    last = jax.tree.map(lambda x: x[-1], v)
    return Connection(
        t, q, v, multipliers, trajectory, model.tree(aim.u), last, shoot.duration(ends, aim), solved.action,
        jnp.asarray(-1 if why else at_nodes[-1]), solved.amplification,
        jnp.asarray(np.nan if shot is None else shot.size, aim.u.dtype), jnp.max(solved.errors),
        solved.part >= 1, times, (), words, len(solved.found.path.y), why,
    )  # fmt: skip


def _inside(model: Model, ends: Ends, start, count: int, outputs: int, rtol) -> Connection:
    """The first start in a program, with derivatives in both modes."""
    still, fixed = stop_gradient((model, ends))
    solved = stop_gradient(_solved(still, fixed, *_straight(still, fixed, start[1], count)))
    good = (solved.part >= 1) & (jnp.max(solved.errors) < COARSE)
    shot = shoot.shot_inside(model, ends, solved.aim, solved.response, rtol)
    aim = jax.tree.map(partial(jnp.where, good), shot.aim, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), shot.aim))
    trajectory = shoot.motion(model, ends, shot.aim, outputs, rtol, throw=False, estimate_error=False)
    why = _why_not_variational(model)
    return Connection(
        trajectory.t, trajectory.q, trajectory.v, trajectory.multipliers, trajectory, model.tree(aim.u),
        jax.tree.map(lambda x: x[-1], trajectory.v), shoot.duration(ends, aim),
        jnp.where(good, _action(model, ends, solved.found), jnp.nan), jnp.asarray(-1) if why else solved.index[-1],
        solved.amplification, shot.size, jnp.max(solved.errors), good, None, (), start[0], count, why,
    )  # fmt: skip


def _same(a: Connection, b: Connection) -> bool:
    """Whether two answers are the same: by start velocity and time."""
    flat = [np.concatenate([np.ravel(x) for x in jax.tree.leaves((c.start_velocity, c.duration))]) for c in (a, b)]
    return bool(np.max(np.abs(flat[0] - flat[1])) <= SAME * np.max(np.abs(flat)))
