"""`connect`: the motions from one configuration to another.

check the ends  ->  starts (`starts.py`)  ->  an answer from each (`answer.py`)  ->  sort, say what was found
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate import Trajectory
from lagjax.jaxtools import compiled, depends, is_eager, is_traced
from lagjax.mechanics import describe, listed
from lagjax.refusals import must_be_like, must_return
from lagjax.system import (
    OF_STATE,
    Call,
    Hybrid,
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
from lagjax.two_points import starts as descent
from lagjax.two_points.answer import Connection, answer_from, inside, is_same, not_found, why_not_variational
from lagjax.two_points.path import COMPLETE, FIXED, NATURAL, Ends, onto_constraints
from lagjax.two_points.shoot import launches_of, shoots_alone
from lagjax.two_points.starts import DEGREE, Nodes, PathGuess, Starts, guesses_of, nodes_of, sizes_of

ELEMENTS = 8
# Ends may be off the constraints by this part of their size.
OFF = 1e-6
# Starts that follow where the straight line leads nowhere; starts in all for each that is asked for, with ways down.
FURTHER, MOST_STARTS = 3, 5
# Motions from the start that follow where several starts lead nowhere.
LAUNCHES = 12
TOLERANCE = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}


class ConnectWarning(UserWarning):
    """No motion was found between two ends, or not as accurate a one as was asked for."""


def connect(
    system: System | Hybrid,
    q_a: PyTree[ArrayLike],
    q_b: PyTree[ArrayLike],
    t_a: ArrayLike,
    t_b: ArrayLike,
    params: PyTree = None,
    *,
    end: Callable | None = None,
    free_time: bool = False,
    starts: Starts = 1,
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

    - `system`, `params`: a `System`, with or without constraints, forces, dissipation and elements, or a `Hybrid`; its
      parameters. With elements or phases the start velocity is sought by integrating alone, and there is no action.
    - `q_a`, `q_b`: the ends, alike; `[q]`. An angle that goes round differs by its turns. They lie on the constraints.
    - `t_a`, `t_b`: the times of the ends, `[t]`, t_b > t_a.

    **Other arguments:**

    - `end`: conditions `end(t, q, v, params)` -> scalar or (c,) in place of the end q_b, which is then a guess. Of
      positions (and time) alone they are at most as many as coordinates, and the rest is transversality: no momentum
      along what they leave free. Of velocities, they are as many as the coordinates that constraints leave; so they
      are in any case with velocity constraints, where q_b alone is too much, and with forces that depend on
      multipliers. Then the start velocity is sought by integrating alone, from that of the start.
    - `free_time`: whether t_b is a guess. Without a further condition among those of `end` that depend on velocities,
      the time is that of stationary action, with no energy h at the end.
    - `starts`: how many starts: the straight line, and others with random waves on it, as large in each coordinate as
      its mass makes it comparable with the line (π for an angle whose turns L knows). With more than one, what lies
      below each saddle on both sides is looked for too, and what lies below a start that leads nowhere; where all of
      them lead nowhere, twelve motions from the start follow, at several speeds. Or a function q(t), or a motion of
      `integrate` with its outputs close together, or several. A start need not end at q_b: a fan of launches finds
      answers far from the straight line. Where the line alone leads to no answer, three random starts follow.
    - `elements`: of the path, at first. They are laid anew where the path needs them, and outside of `jit` and `vmap`
      doubled until it is followed.
    - `outputs`: the number of output times, equally spaced. `rtol`: the tolerance of the motion, 1e-13 in float64.
    - `quiet`: no warning where no motion is found.

    **Returns:** a `Connection`: of the answers that were found, the one of least action, the others in its `others`;
    there may be more, and one of less action, that none of the starts in `tried` led to. Differentiable in both modes
    by `params` and the ends (first derivatives), under `jit` and `vmap` from the first start.

    **Raises:** `TypeError`, `ValueError` for ends of different structure, off the constraints, or at the same time; for
    too many or too few conditions. Warns (`ConnectWarning`) where no motion was found, or a path that no motion
    follows to its end; under `jit` and `vmap` `converged` says so, and the start velocity and the action are NaN.

    Source: Milnor, *Morse Theory*, §15; Marsden & West, *Acta Numerica* 10 (2001) 357. See `path.py`.
    """
    goes_down = isinstance(starts, int | np.integer) and starts > 1
    return connected(
        system, (q_a, q_b), (t_a, t_b), params, end, free_time, starts, elements, outputs, rtol, quiet, goes_down
    )


def connected(
    system: System | Hybrid, configurations: tuple, times: tuple, params: PyTree, end: Callable | None, free_time: bool,
    starts: Starts, elements: int, outputs: int, rtol: ArrayLike | None, quiet: bool, goes_down: bool,
) -> Connection:  # fmt: skip
    """`connect`; with `goes_down` what lies below saddles, and below starts that lead nowhere, is looked for too."""
    check_system(system, *configurations, params, phases=True, states=False, elements=True)
    model, ends = _problem(system, *configurations, *times, params, end, free_time)
    dtype = np.dtype(ends.x_a.dtype)
    rtol = TOLERANCE.get(dtype, 1e-5) if rtol is None else rtol
    guesses = guesses_of(model, 1 + FURTHER if starts == 1 else starts)
    if not is_eager() or is_traced((model, ends)):
        return inside(model, ends, guesses[0], elements, outputs, rtol)
    found, tried, first, launched, most = [], [], None, False, MOST_STARTS * len(guesses)
    descends = not why_not_variational(model, ends) and descent.can_descend(model, ends, elements)
    # A straight line may lead through a singular point, as the centre of a sphere: others follow.
    while guesses and not (starts == 1 and found and not goes_down) and len(tried) < most:
        guess = guesses.pop(0)
        solved, answer, why = answer_from(model, ends, guess, elements, outputs, rtol)
        first = solved if first is None else first
        tried.append(f"{guess.name}: {why}")
        new = answer is not None and not any(is_same(answer, other) for other in found)
        found += [answer] if new else []
        if descends and (goes_down or starts == 1 and not found):
            guesses += _below(model, ends, guess, solved, answer if new else None, elements)
        if goes_down and not guesses and not found and not launched:
            guesses, launched = launches_of(model, ends, LAUNCHES, rtol), True
    words = "; ".join(tried)
    if not why_not_variational(model, ends):
        found.sort(key=lambda answer: float(answer.action))
    if not quiet and not (found and bool(found[0].converged)):
        _warn(model, ends, found[0] if found else None, words)
    if not found:
        return not_found(model, ends, first, outputs, words)
    return replace(found[0], others=tuple(found[1:]), tried=words)


def _below(
    model: Model, ends: Ends, guess: PathGuess, solved: Any, answer: Connection | None, elements: int
) -> list[PathGuess]:
    """Starts that lie below a saddle that is new, or below a start that leads nowhere."""
    if answer is not None and int(answer.index) > 0:
        nodes = descent.ways_down(model, ends, solved.found.path, sizes_of(model, ends), elements)
        return [PathGuess(f"down from the saddle of {guess.name}, way {i}", Nodes(x)) for i, x in enumerate(nodes, 1)]
    if answer is None and not float(solved.part) >= 1 and not isinstance(guess.path, Nodes | Trajectory):
        nodes = descent.down_from(model, ends, *nodes_of(model, ends, guess, elements, DEGREE), sizes_of(model, ends))
        return [] if nodes is None else [PathGuess(f"down from {guess.name}", Nodes(nodes))]
    return []


def _warn(model: Model, ends: Ends, nearest: Connection | None, words: str):
    between = f"from {describe(model.tree(ends.x_a))} to {describe(model.tree(ends.x_b))}"
    if nearest is None:
        text = (
            f"no motion was found {between} in a time of {float(ends.duration):.6g}. Tried: {words}.\n"
            "Usual cause: no such motion (an end out of reach), a path through a singularity of L, or a start too far "
            "away.\n"
            "Fix: starts=8 for more starts; starts=lambda t: ... for a path that you know, or motions of lj.integrate; "
            "a shorter time."
        )
    else:
        text = (
            f"a path was found {between}, and no motion that follows it: {nearest.alone}.\n"
            "Usual cause: an unstable motion over a long time: no start velocity is exact enough.\n"
            "Fix: take the path itself (.q, .v, .action); a shorter time; or lj.connect for parts of the way."
        )
    warnings.warn(text, ConnectWarning, stacklevel=4)


# -- The problem: checked arguments. --


def _problem(system, q_a, q_b, t_a, t_b, params, end, free_time) -> tuple[Model, Ends]:
    switching = system if system.in_phases or system.elements is not None else None
    system, s = checked(system.first_phase, State(t_a, q_a, q_a, params))
    model = model_of(system, *s)
    fix = "give both ends all coordinates; a coordinate that is free at the end needs end=..., not a gap"
    must_be_like(q_b, q_a, "q_b", "q_a", fix, "a coordinate left out of one end")
    other = coordinates.state(t_b, q_b, q_b, s.params)
    alone = shoots_alone(model, switching)
    if alone and end is None and (free_time or not model.holonomic.all()):
        raise ValueError(_too_many(model, free_time))
    dtype = s.t.dtype
    t_a, duration = s.t, jnp.asarray(other.t, dtype) - s.t
    (x_a, _), (x_b, _) = model.vectors(s.q, s.q), model.vectors(other.q, other.q)
    x_b = x_b.astype(dtype)
    _check_finite(model, {"q_a": x_a, "q_b": x_b}, {"t_a": t_a, "t_b": other.t})
    if not is_traced(duration) and not float(duration) > 0:
        raise ValueError(
            f"t_b = {float(other.t):.9g} is not after t_a = {float(s.t):.9g}.\n"
            "Fix: exchange the ends, or give another time."
        )
    condition, kind, count = None, FIXED, 0
    if end is not None:
        condition, kind, count = _conditions(model, s, end, free_time, alone)
    x_a = _on_constraints(model, t_a, x_a, "q_a")
    # In another phase other constraints may hold at the end.
    if kind == FIXED and switching is None:
        x_b = _on_constraints(model, t_a + duration, x_b, "q_b")
    elif switching is None:
        x_b = _onto_constraints(model, t_a + duration, x_b)
    return model, Ends(t_a, x_a, x_b, duration, condition, kind, bool(free_time), count, switching)


def _check_finite(model: Model, ends: dict[str, Array], times: dict[str, Array]):
    """Raise for a coordinate or a time that is NaN or infinite, by its name."""
    given = [(f"coordinate '{name}' of {end}", x[i]) for end, x in ends.items() for i, name in enumerate(model.names)]
    bad = [(what, x) for what, x in [*given, *times.items()] if not is_traced(x) and not np.isfinite(x)]
    if bad:
        raise ValueError(
            f"{bad[0][0]} is {float(bad[0][1])}, and a motion goes from one finite state to another.\n"
            "Usual cause: a division by zero where the end was computed, or an output of a motion that had ended.\n"
            "Fix: a number; a coordinate that is free at the end is left to end=..., and its entry is a guess."
        )


class EndCondition(NamedTuple):
    """A condition on the end as a function of vectors."""

    function: Callable
    model: Model

    def __call__(self, t: Array, x: Array, u: Array) -> Array:
        return jnp.atleast_1d(self.function(t, self.model.tree(x), self.model.tree(u), self.model.params))


def _conditions(model: Model, s: State, end: Callable, free_time: bool, alone: bool):
    """The condition on vectors, its kind, and how many equations it is."""
    call = Call("end", end, OF_STATE)
    function = traced_call(call, dict(zip(OF_STATE, s)), _check_condition)
    condition = EndCondition(function, model)
    x, u = model.vectors(s.q, s.v)
    count = jax.eval_shape(condition, s.t, x, u).shape[0]
    of_velocity = _depends_on_velocity(condition, s.t, x, u)
    left = model.n - model.m
    if not of_velocity and not alone:
        if count > left:
            raise ValueError(_count(count, f"at most {left}", model, "conditions of positions"))
        return condition, NATURAL, count
    wanted = left + free_time
    if count != wanted:
        what = "conditions with velocities" if of_velocity else "conditions"
        raise ValueError(_count(count, f"{wanted}", model, what, free_time))
    return condition, COMPLETE, count


def _depends_on_velocity(condition: Callable, t: Array, x: Array, u: Array) -> bool:
    program = jax.make_jaxpr(lambda u: condition(t, x, u))(u).jaxpr
    return depends(program, program.invars)


def _check_condition(call: Call, value):
    shape = getattr(value, "shape", None)
    wanted, fix = "a scalar or a vector that vanishes at the end", "return jnp.stack([...]) of the conditions"
    must_return(shape is not None and len(shape) <= 1 and 0 not in shape, call, wanted, value, fix)


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


def _too_many(model: Model, free_time: bool) -> str:
    """Why all of q_b cannot be asked for."""
    free, m = model.n - model.m, int(np.sum(~model.holonomic))
    names = [residual.name for residual in model.form.residuals if not residual.of_positions]
    because = "no path leads there"
    if m or model.reacts:
        because = f"{listed(names)} restricts velocities" if m else "the force depends on multipliers"
    return (
        f"q_b has {free + m} free coordinates, and the motion {free} free start velocities"
        f"{' and a free time' if free_time else ''}: {because}, and no transversality completes what is missing.\n"
        "Usual cause: all of q_b where only some of it can be reached in a given time.\n"
        f"Fix: end=lambda t, q, v, params: jnp.stack([...]) of {free + free_time} conditions; or lj.steer for a system "
        "with controls."
    )


_onto_constraints = compiled(onto_constraints)


def _on_constraints(model: Model, t: Array, x: Array, name: str) -> Array:
    """An end moved onto the constraints by round-off; raises where it is farther away."""
    if not model.m:
        return x
    near = _onto_constraints(model, t, x)
    if not is_traced((near, t)):
        off = float(jnp.max(jnp.abs(near - x))) / max(float(jnp.max(jnp.abs(x))), 1e-300)
        if not off < OFF:
            names = np.array(model.equation_names)[model.holonomic]
            worst = names[int(np.argmax(np.abs(constraints.position_residual(model, t, x))))]
            raise ValueError(
                f"{name} is off the constraints by {off:.2g} of its size; worst is '{worst}'.\n"
                "Usual cause: an end in rounded numbers, or one out of reach of the mechanism.\n"
                f"Fix: {name}, _ = lj.consistent_state(system, t, {name}, v, params), v of zeros."
            )
    return near
