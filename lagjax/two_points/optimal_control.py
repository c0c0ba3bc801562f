"""`steer`: the controls that bring a system from one state to another at the least cost.

check the question  ->  one nonlinear program a mesh (`transcription.py`)  ->  integrate what was found

**Where the search begins**: a straight line, what is known of the path and the controls, an earlier answer, and random
starts beside it.

What is known in time is taken in parts of the whole time, so that an earlier answer fits another time; to other ends
its path is moved by the straight line between what is missing at both.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from lagjax.mechanics import listed
from lagjax.refusals import must_be_function
from lagjax.system import System, coordinates
from lagjax.two_points.control_problem import Question, asked
from lagjax.two_points.mesh import Jump, Mesh, even, jumps_of, places
from lagjax.two_points.nonlinear_program import NonlinearProgram, SolverAnswer, import_casadi
from lagjax.two_points.path import FIXED, Ends
from lagjax.two_points.starts import WAVES, Sizes, course_of, sizes_of, waves_of
from lagjax.two_points.steering import (
    STATUS,
    Accuracy,
    SteeredMotion,
    Steering,
    compile_ahead,
    failure_in_words,
    is_found,
    steering_of,
)
from lagjax.two_points.transcription import Layout, moved

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
        fix = 'guess=lambda t: {"x": 0.5 * t}, like the coordinates'
        must_be_function(guess, "guess", "t, or an earlier Steering", fix)

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
    course = course_of(guess.trajectory)
    return lambda shares: course([_as_before(guess, share) for share in shares])


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
    for i in range(count):
        on_path = waves_of(random, ON_PATH[i % len(ON_PATH)], sizes)
        on_controls = waves_of(random, ON_CONTROLS, of_controls)
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
    shares, of_controls = (places(mesh.parts, nodes) for nodes in (plant.rule.nodes, plant.control_nodes))
    path = np.asarray(plan.path(shares))
    x[at["q"]] = np.clip(path, *question.limits["q"])
    slopes = (path[1] - path[0]) / shares[1], (path[-1] - path[-2]) / (1 - shares[-2])
    x[at["v"]] = np.stack(slopes) / (plan.t_b - question.t_a)
    x[at["controls"]] = np.clip(np.asarray(plan.controls(of_controls)), *question.limits["controls"])
    return x


# The solver's own tolerance of optimality; bounds are not widened, which would let the cost fall below the least.
EXACT = {"tol": 1e-10, "bound_relax_factor": 0.0, "max_iter": 1000}
# The most iterations of a further start.
OF_A_START = 300
# The most jumps of controls that elements are cut at.
CUTS = 8
# From a solution on another mesh, the barrier of Ipopt starts here.
WARM = {"mu_init": 1e-6}


def steer(
    system: System,
    controls: Mapping[str, ArrayLike | Callable] | Callable,
    start: tuple[PyTree, PyTree],
    end: tuple[PyTree, PyTree] | Callable,
    cost: Callable | None = None,
    params: PyTree = None,
    *,
    t_b: ArrayLike | tuple[float, float],
    t_a: ArrayLike = 0.0,
    end_cost: Callable | None = None,
    bounds: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    guess: Callable | Steering | None = None,
    starts: int = 1,
    interpolation: str = "smooth",
    elements: int = 8,
    most: int = 64,
    degree: int = 4,
    tol: float = 1e-6,
    with_control: Callable[[PyTree, PyTree], PyTree] | None = None,
    outputs: int = 201,
    rtol: float = 1e-10,
    throw: bool = True,
) -> Steering:
    """Find the controls that bring a system from `start` to `end` at the least cost.

    >>> import lagjax as lj
    >>> cart = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["push"])
    >>> found = steer(cart, {"push": 0.0}, (0.0, 0.0), (1.0, 0.0), lambda t, q, v, u, params: u["push"] ** 2, t_b=1.0)
    >>> print(round(found.cost, 9), found.controls(0.25)["push"].round(9))  # 12, and 6 - 12 t
    12.0 3.0

    A control is an entry of `params`, which L, the force, the dissipation and the constraints read by its name, as in
    `lj.rollout`. The cost is the integral of `cost`, plus `end_cost`; without either it is the time.

    **Main arguments:**

    - `system`: a `System`; holonomic constraints and velocity constraints are kept.
    - `controls`: by name, a first guess of each: a number or an array, for all times; a function of t; or a pair
      (times, values), linear in between. Or one function of t that returns them all, as `lj.steer(...).controls`.
    - `start`, `end`: (q, v), each like the coordinates; NaN stands for a number that is free, None for all of q or of
      v. `end` may be a function `end(t, q, v, params)` that returns what has to vanish.
    - `cost(t, q, v, u, params)` -> scalar, per unit of time; `u` is a dict of the controls.
    - `params`: what L takes, without the controls.
    - `t_b`: the time of the end, `[t]`, or a pair between which it is sought. `t_a`: that of the start.

    **Other arguments:**

    - `end_cost(t, q, v, params)` -> scalar.
    - `bounds`: by the name of a control, a coordinate ("x", "r[0]"; "q" for a single one) or a velocity ("v.x"; "v"),
      a pair (low, high), infinite where there is none. Coordinates are held to them at Lobatto's points of each
      element, controls and velocities at Gauss's; a control is cut off at its bounds in between.
    - `guess(t)` -> q, a path to start from, in place of the straight line; times of a free end run to the geometric
      mean of its limits. Or an earlier `Steering`, of other ends, times or parameters: its path, stretched to the time
      and moved to the ends, and its controls, unless those given depend on time.
    - `starts`: how many starts: the guess, and others with random waves on its path and controls, some of which wait
      first. All are solved on the first elements, and the least cost is refined; `tried` of the answer has the others.
    - `interpolation`: between the knots a control is a polynomial through Gauss's points ("smooth"), "linear" from knot
      to knot, or "constant".
    - `elements`, `most`: how many elements of the time to begin with, and the most. All are halved until the cost
      changes by less than `tol` of it; where `most` ends this before, the status says so. Where a control goes from one
      bound to the other in an element, that is cut in two at a time that is sought with the rest.
    - `degree`: of q on an element; the error of a smooth motion is of order 2 `degree` in their length.
    - `with_control(params, u)`: as in `lj.rollout`.
    - `outputs`: at how many times the motion is integrated for, with the tolerance `rtol`.
    - `throw`: raise if the solver finds nothing; with `throw=False` the status says why.

    **Returns:** a `Steering`: the controls as functions of time, the motion that they cause by `lj.integrate`, how far
    it ends from the end, and the cost.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind or shape; ends outside of bounds or off the constraints;
      unknown names; a control that nothing reads; nothing to minimise; more conditions than unknown numbers.
    - `RuntimeError` if the solver finds no motion, with the condition that is violated most.
    - `ImportError` without casadi, an extra: `pip install "lagjax[steer]"`.

    Found is a local minimum, the one near the guess, or the least of those near `starts`. It needs float64, and is
    called from Python alone: derivatives by parameters are those of the motion with the plan held, from
    `lj.integrate(found.system, q0, v0, found.params, ...)`.

    Source: Betts, *Practical Methods for Optimal Control*, ch. 4; Leyendecker et al. (2010).
    """
    times, options = (t_a, t_b), (degree, interpolation)
    counts = (
        ("elements", elements, 1), ("most", most, 1), ("degree", degree, 1), ("outputs", outputs, 2),
        ("starts", starts, 1),
    )  # fmt: skip
    controls, controls_at = split_controls(controls, t_a)
    question = asked(system, controls, start, end, cost, params, times, end_cost, bounds, with_control, options, counts)
    motion = SteeredMotion(outputs, rtol, max(most, elements) + CUTS, throw)
    plan = first_plan(question, guess, controls_at)
    import_casadi()
    ahead = compile_ahead(question, motion)
    try:
        layout, solved, accuracy, iterations, tried = _searched(question, elements, plan, starts, most, tol)
    finally:
        ahead.join()
    if throw and not is_found(solved):
        raise RuntimeError(failure_in_words(question, layout, solved, _limits_of_rows(question, layout)))
    return steering_of(question, layout, solved, motion, accuracy, iterations, tried)


def _searched(
    question: Question, elements: int, plan: FirstPlan, starts: int, most: int, tol: float
) -> tuple[Layout, SolverAnswer, Accuracy, int, str]:
    """The solution on the last mesh, how much its cost changed there, all iterations, and what was tried."""
    mesh = Mesh(even(elements), {})
    layout = Layout(question.plant, mesh.count)
    solved = _solve(question, layout, mesh, unknowns(question, layout, mesh, plan), {})
    found, plans = [(plan, solved)], []
    if starts > 1:
        plans = random_plans(question, plan, starts - 1, solved.x[layout.places["controls"]])
    for other in plans:
        x = unknowns(question, layout, mesh, other)
        found.append((other, _solve(question, layout, mesh, x, {"max_iter": OF_A_START})))
    iterations = sum(answer.iterations for _, answer in found)
    tried = "; ".join(f"{plan.name}: {_in_words(answer)}" for plan, answer in found)
    # The least one on few elements need not be one on many: the next ones follow.
    ordered = sorted((x for _, x in found if is_found(x)), key=lambda x: x.cost) or [solved]
    while True:
        layout = Layout(question.plant, mesh.count)
        layout, fine, accuracy, more = _refined(question, mesh, layout, ordered.pop(0), most, tol)
        iterations += more
        if is_found(fine) or not ordered:
            return layout, fine, accuracy, iterations, tried


def _in_words(answer: SolverAnswer) -> str:
    return f"cost {answer.cost:.9g}" if is_found(answer) else STATUS.get(answer.status, answer.status)


def _refined(
    question: Question, mesh: Mesh, layout: Layout, solved: SolverAnswer, most: int, tol: float
) -> tuple[Layout, SolverAnswer, Accuracy, int]:
    """A solution on ever finer meshes, until its cost no longer changes."""
    iterations, change = 0, np.inf
    while is_found(solved):
        # Where a control jumps is looked for once: afterwards the bound of two elements is there.
        jumps = [] if mesh.jumps else _jumps(question, layout, solved.x)[:CUTS]
        if not jumps and 2 * mesh.count > most:
            break
        mesh = mesh._replace(parts=solved.x[layout.places["parts"]])
        mesh = mesh.cut_at(jumps) if jumps else mesh.halved()
        coarse, (layout, x) = solved, moved(layout, solved.x, mesh)
        solved = _solve(question, layout, mesh, x, WARM)
        if not is_found(solved):
            solved = _solve(question, layout, mesh, x, {})
        iterations, change = iterations + solved.iterations, abs(solved.cost - coarse.cost)
        if not jumps and change <= _allowed(solved, tol):
            break
    return layout, solved, Accuracy(change, bool(change <= _allowed(solved, tol)), tol), iterations


def _jumps(question: Question, layout: Layout, x: np.ndarray) -> list[Jump]:
    """Where controls jump; those that are linear between knots do not."""
    plant, at = layout.plant, layout.places
    weights = {"smooth": plant.rule.weights, "constant": np.ones(1)}.get(plant.interpolation)
    return [] if weights is None else jumps_of(x[at["parts"]], weights, x[at["controls"]], *question.limits["controls"])


def _allowed(solved: SolverAnswer, tol: float) -> float:
    # A cost of zero is so to the solver's own tolerance.
    return tol * max(abs(solved.cost), EXACT["tol"])


def _limits_of(question: Question, layout: Layout, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Between what each unknown lies; what is known lies between two equal numbers."""
    at, limits = layout.places, question.limits
    low, high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    (low[at["end"]], high[at["end"]]), parts = question.t_b, mesh.limits()
    low[at["parts"]], high[at["parts"]] = parts
    for name in ("q", "controls", "v"):
        low[at[name]], high[at[name]] = limits[name]
    for i, jumps in mesh.jumps.items():
        for jump in jumps:
            before, after = (at["controls"][layout.of_controls[k], jump.control] for k in (i - 1, i))
            if jump.falls:
                before, after = after, before
            high[before], low[after] = low[before], high[after]
    for i, end in ((0, question.ends[0]), (-1, question.ends[1])):
        for kind, asked_for in zip("qv", end):
            fixed = np.isfinite(asked_for)
            low[at[kind][i][fixed]] = high[at[kind][i][fixed]] = asked_for[fixed]
    return low, high


def _limits_of_rows(question: Question, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Between what each equation lies; what fixed ends satisfy by themselves is not asked for again."""
    rows, plant = layout.rows, question.plant
    low, high = np.zeros(layout.row_count), np.zeros(layout.row_count)
    low[rows["bounded"]], high[rows["bounded"]] = question.limits["v"][:, list(plant.bounded)]
    (start_q, start_v), (stop_q, stop_v) = (end.fixes for end in question.ends)
    g = plant.of_positions
    left_out = [
        (start_q, rows["start"][:g]), (start_v, rows["start"][g:]),
        (stop_q, rows["positions"][-1, -1]), (stop_v, rows["stop"]),
    ]  # fmt: skip
    for is_known, left in left_out:
        if is_known:
            low[left], high[left] = -np.inf, np.inf
    return low, high


def _solve(question: Question, layout: Layout, mesh: Mesh, x: np.ndarray, options: dict) -> SolverAnswer:
    limits, of_rows = _limits_of(question, layout, mesh), _limits_of_rows(question, layout)
    unknowns, equations = int(np.sum(limits[0] < limits[1])), int(np.sum(of_rows[0] == of_rows[1]))
    if equations > unknowns:
        raise ValueError(
            f"too many conditions: {equations} equations for {unknowns} unknown numbers on {layout.count} elements.\n"
            "Usual cause: an end that fixes more than the controls can bring about, as position and velocity by one "
            "constant control, or a start or an end that is free to no purpose.\n"
            "Fix: NaN in the end for what may be free; more elements; t_b=(low, high)."
        )
    program = NonlinearProgram(layout.blocks(), layout.size, layout.row_count)
    return program.solve(np.clip(x, *limits), limits, of_rows, {**EXACT, **options})
