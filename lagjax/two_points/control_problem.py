"""The optimal-control problem of `steer`, checked: ends, times, controls, bounds and costs by the user's names."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanics import constraint_residual
from lagjax.refusals import must, must_be_among, must_be_like, must_be_whole, must_have_values, must_name, must_return
from lagjax.steps import check_names, check_read, merge_by_name
from lagjax.system import (
    OF_STATE,
    Call,
    Form,
    State,
    System,
    check_system,
    coordinates,
    model_of,
    traced_call,
    traced_system,
)
from lagjax.two_points.transcription import INTERPOLATIONS, Plant

OF_COST = ("t", "q", "v", "u", "params")
# An end may miss a constraint by this much of one.
ON_CONSTRAINTS = 1e-6


class End(NamedTuple):
    """What is asked of one end: q and v (n,), NaN where they are free."""

    q: np.ndarray
    v: np.ndarray

    @property
    def fixes(self) -> tuple[bool, bool]:
        """Whether it fixes all of q, and all of v."""
        return bool(np.all(np.isfinite(self.q))), bool(np.all(np.isfinite(self.v)))


class Question(NamedTuple):
    """What is asked, in vectors: the plant, both ends, the limits of the end's time, of controls and of states.

    `system`: the user's, checked; `names`: of coordinates, velocities and controls.
    """

    plant: Plant
    system: System
    params: PyTree
    ends: tuple[End, End]
    t_b: tuple[float, float]
    controls: np.ndarray
    limits: dict[str, np.ndarray]
    names: dict[str, list[str]]

    @property
    def t_a(self) -> float:
        """The time of the start."""
        return float(self.plant.t_a)


class Controlled(eqx.Module):
    """A traced system, a state without controls, the controls, and how both make the parameters: `merge(params, u)`."""

    system: System
    state: State
    controls: PyTree
    merge: Callable = eqx.field(static=True)
    form: Form = eqx.field(static=True)


def asked(
    system: System, controls: Any, start: Any, end: Any, cost: Callable | None, params: PyTree, times: tuple,
    end_cost: Callable | None, bounds: Mapping | None, with_control: Callable | None, options: tuple[int, str],
    counts: tuple[tuple[str, Any, int], ...],
) -> Question:  # fmt: skip
    """The question, after all that can be wrong with it was looked for."""
    check_system(system, states=False)
    what = "lj.steer is called from Python alone, as its solver is not a JAX program"
    again = "lj.integrate(found.system, q0, v0, found.params, ts=ts)"
    fix = f"steer first; derivatives of the motion with the plan held are those of {again}"
    must_have_values((controls, start, end, params, times), what, fix, "jit, vmap or grad around it")
    fix = 'interpolation="linear", for a control that is linear between knots'
    must_be_among(INTERPOLATIONS, options[1], "interpolation", fix)
    for name, value, least in counts:
        must_be_whole(value, name, least, fix="leave it out")
    t_a, t_b = _times(*times)
    start, end_function = _pair(start, "start"), end if callable(end) else None
    q_like = _example(start, system)
    first = _end(start, q_like, "start")
    last = _end((None, None) if callable(end) else _pair(end, "end"), q_like, "end")
    zero = coordinates.like(q_like, np.zeros(first.q.size))
    s = coordinates.prepared(t_a, zero, zero, params)
    if s.t.dtype != np.float64:
        raise TypeError(
            f"lj.steer needs float64, and this is {s.t.dtype}: its solver asks for ten digits.\n"
            'Fix: jax.config.update("jax_enable_x64", True) before the first array, and starts in Python floats.'
        )
    given = controlled(system, controls, s, with_control)
    t_free = t_b[1] > t_b[0]
    if cost is None and end_cost is None and not t_free:
        raise ValueError(
            "there is nothing to minimise: neither cost nor end_cost is given, and t_b is one number.\n"
            'Fix: cost=lambda t, q, v, u, params: u["push"] ** 2; or t_b=(low, high) for the shortest time.'
        )
    if cost is None and end_cost is None:
        end_cost = _time
    of_path = None if cost is None else checked_cost(cost, given)
    of_end, state = None, s._asdict()
    if end_cost is not None:
        of_end = traced_call(Call("end_cost", end_cost, OF_STATE), state, check_number)
    condition = None
    if end_function is not None:
        condition = traced_call(Call("end", end_function, OF_STATE), state, _check_conditions)
    names_of_q, names_of_u = coordinates.names(s.q), coordinates.names(given.controls)
    names = {"q": names_of_q, "v": [velocity_name(name) for name in names_of_q], "controls": names_of_u}
    limits = _limits(names, bounds or {})
    plant = Plant(
        given.system, s.params, s.t, of_path, of_end, condition, given.controls, given.merge, given.form,
        options[1], options[0],
        tuple(int(i) for i in np.flatnonzero(np.any(np.isfinite(limits["v"]), axis=0))),
        sum(int(np.prod(np.shape(x))) for x in jtu.tree_leaves(condition.program.value)) if condition else 0,
    )  # fmt: skip
    question = Question(plant, system, s.params, (first, last), t_b, coordinates.vector(given.controls), limits, names)
    _check_ends(question)
    return question


def controlled(system: System, controls: PyTree, s: State, with_control: Callable | None) -> Controlled:
    """The system checked and traced with its controls among the parameters."""
    if with_control is None:
        check_names(s.params, controls)
    merge = with_control or merge_by_name
    controls = jtu.tree_map(lambda x: np.asarray(x, s.t.dtype), controls)
    merged = s._replace(params=coordinates.given_params(merge(s.params, controls), s.t.dtype))
    found = traced_system(system, merged)
    check_read(found, s, jtu.tree_map(lambda x: jnp.asarray(x)[None], controls), merge)
    return Controlled(found, s, controls, merge, model_of(found, *merged).form)


def checked_cost(cost: Callable, given: Controlled) -> Callable:
    """The cost per unit of time, traced."""
    arguments = given.state._asdict() | {"u": given.controls}
    return traced_call(Call("cost", cost, OF_COST), arguments, check_number)


def velocity_name(name: str) -> str:
    """The name of a coordinate's velocity: "v.x", "v[0]", "v"."""
    return "v" + name[1:] if name == "q" or name.startswith("q[") else f"v.{name}"


def _time(t, q, v, params):
    return t


def _times(t_a: Any, t_b: Any) -> tuple[float, tuple[float, float]]:
    pair = t_b if isinstance(t_b, (tuple, list)) else (t_b, t_b)
    well = len(pair) == 2 and all(np.ndim(x) == 0 and np.isfinite(x) for x in (t_a, *pair))
    claim = "t_b must be a time, or a pair of times between which the end is sought"
    must(well, claim, t_b, "t_b=2.0, or t_b=(0.1, 10.0)")
    low, high = (float(x) for x in pair)
    if not float(t_a) < low <= high:
        raise ValueError(
            f"the end must come after the start: t_a = {float(t_a):.6g}, t_b = {t_b!r:.80}.\n"
            "Fix: t_b > t_a, and for a pair (low, high) t_a < low < high; a free end cannot start at t_a itself."
        )
    return float(t_a), (low, high)


def _pair(given: Any, which: str):
    if isinstance(given, (tuple, list)) and len(given) == 2:
        return given
    also = ", or a function end(t, q, v, params) of what has to vanish" if which == "end" else ""
    raise TypeError(
        f"{which} must be a pair (q, v){also}, not {type(given).__name__}.\n"
        f"Fix: {which}=(q, v); None in the place of v leaves all velocities free, NaN a single number."
    )


def _example(start: tuple, system: System):
    known = [x for x in start if x is not None]
    if not known:
        raise TypeError(
            "start gives neither q nor v, so that nothing says what the coordinates are.\n"
            'Fix: start=({"x": jnp.nan}, None), NaN for what is free.'
        )
    return jtu.tree_map(lambda x: np.asarray(x, float), known[0])


def _end(pair: tuple, like: PyTree, which: str) -> End:
    found = []
    for x, name in zip(pair, "qv"):
        if x is None:
            found.append(np.full(coordinates.vector(like).size, np.nan))
            continue
        x = jtu.tree_map(lambda x: np.asarray(x, float), x)
        fix = "all coordinates, NaN for those that are free"
        must_be_like(x, like, f"{name} of the {which}", "the start", fix, "a coordinate left out")
        found.append(coordinates.vector(x).astype(float))
    return End(*found)


def check_number(call: Call, value: Any):
    """Raise where a function of the user's does not return one number."""
    well = np.shape(value) == () and np.issubdtype(getattr(value, "dtype", type(value)), np.number)
    cause = "a control that is an array, squared and not summed"
    must_return(well, call, "one number", value, 'jnp.sum(u["push"] ** 2)', cause)


def _check_conditions(call: Call, value: Any):
    well = jtu.tree_leaves(value) and all(np.ndim(x) < 2 for x in jtu.tree_leaves(value))
    must_return(well, call, "numbers that vanish at the end", value, "q - jnp.array([1.0, 0.0])")


def _limits(names: dict[str, list[str]], bounds: Mapping) -> dict[str, np.ndarray]:
    """Bounds (2, n) of coordinates, velocities and controls."""
    found = {kind: np.stack([np.full(len(x), -np.inf), np.full(len(x), np.inf)]) for kind, x in names.items()}
    for name, pair in bounds.items():
        places = [
            (kind, i)
            for kind in ("controls", "q", "v")
            for i, known in enumerate(names[kind])
            if known == name or known.startswith((f"{name}[", f"{name}."))
        ]
        kinds = {kind for kind, _ in places}
        if not places:
            every = [x for known in names.values() for x in known]
            must_name(name, every, "bounds names", "control, coordinate or velocity")
        if len(kinds) > 1:
            raise ValueError(
                f"'{name}' is the name of a control and of a coordinate.\nFix: another name for the control."
            )
        well, claim = isinstance(pair, (tuple, list)) and len(pair) == 2, f"the bounds of '{name}' must be a pair"
        must(well, claim, pair, f"'{name}': (low, high), with jnp.inf for none", error=TypeError)
        kind, at = places[0][0], [i for _, i in places]
        low, high = (np.broadcast_to(np.ravel(np.asarray(x, float)), len(at)) for x in pair)
        must(np.all(low <= high), f"the lower bound of '{name}' must be below the upper one", pair, "(low, high)")
        found[kind][:, at] = low, high
    return found


def _check_ends(question: Question):
    """Raise where an end contradicts a bound, or a constraint."""
    for which, end in zip(("start", "end"), question.ends):
        for kind, x in zip("qv", end):
            low, high = question.limits[kind]
            for i in np.flatnonzero((x < low) | (x > high)):
                name = question.names[kind][i]
                raise ValueError(
                    f"the {which} asks for {name} = {x[i]:.6g}, and its bounds are {low[i]:.6g} and {high[i]:.6g}.\n"
                    f"Fix: bounds that hold the {which}, or NaN for '{name}' there."
                )
        if not question.plant.of_positions or not end.fixes[0]:
            continue
        q, v = (question.plant.form.tree(np.nan_to_num(x)) for x in end)
        t = question.t_a if which == "start" or question.t_b[0] < question.t_b[1] else question.t_b[0]
        off = constraint_residual(
            question.system, t, q, v, question.plant.merge(question.params, question.plant.controls)
        )
        for residual in question.plant.form.residuals:
            worst = float(np.max(np.abs(np.asarray(off[residual.name]))))
            if residual.of_positions and worst > ON_CONSTRAINTS:
                raise ValueError(
                    f"the {which} is off the constraint '{residual.name}' by {worst:.3g}.\n"
                    f"Fix: q, v = lj.consistent_state(system, t, q, v, params), or NaN where the {which} is free."
                )
