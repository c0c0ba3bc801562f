"""`steer`: the controls that bring a system from one state to another at the least cost.

check the question  ->  one nonlinear program a mesh (`transcription.py`)  ->  integrate what was found
"""

from collections.abc import Callable, Mapping

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from lagjax.system import System
from lagjax.two_points.first_plan import FirstPlan, first_plan, random_plans, split_controls, unknowns
from lagjax.two_points.layout import Layout
from lagjax.two_points.mesh import Mesh, jumps_of, moved
from lagjax.two_points.nonlinear_program import NonlinearProgram, SolverAnswer, import_casadi
from lagjax.two_points.question import Question, asked
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
    mesh = Mesh.even(elements)
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
    layout, fine, accuracy, more = _refined(question, mesh, layout, ordered[0], most, tol)
    iterations += more
    for coarse in ordered[1:]:
        if is_found(fine):
            break
        layout = Layout(question.plant, mesh.count)
        layout, fine, accuracy, more = _refined(question, mesh, layout, coarse, most, tol)
        iterations += more
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
        jumps = [] if mesh.jumps else jumps_of(layout, solved.x, *question.limits["controls"])[:CUTS]
        if not jumps and 2 * mesh.count > most:
            break
        mesh = mesh.at(solved.x[layout.places["parts"]])
        mesh = mesh.cut(jumps) if jumps else mesh.halved()
        coarse, (layout, x) = solved, moved(layout, solved.x, mesh)
        solved = _solve(question, layout, mesh, x, WARM)
        if not is_found(solved):
            solved = _solve(question, layout, mesh, x, {})
        iterations, change = iterations + solved.iterations, abs(solved.cost - coarse.cost)
        if not jumps and change <= _allowed(solved, tol):
            break
    return layout, solved, Accuracy(change, bool(change <= _allowed(solved, tol)), tol), iterations


def _allowed(solved: SolverAnswer, tol: float) -> float:
    # A cost of zero is so to the solver's own tolerance.
    return tol * max(abs(solved.cost), EXACT["tol"])


def _limits_of(question: Question, layout: Layout, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Between what each unknown lies; what is known lies between two equal numbers."""
    at, limits = layout.places, question.limits
    low, high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    (low[at["end"]], high[at["end"]]), parts = question.t_b, mesh.limits()
    low[at["parts"]], high[at["parts"]] = parts
    for name, places in (("q", at["q"]), ("controls", at["controls"]), ("v", at["v"])):
        low[places], high[places] = limits[name]
    for i, jumps in mesh.jumps.items():
        for jump in jumps:
            before, after = (at["controls"][layout.of_controls[k], jump.control] for k in (i - 1, i))
            if jump.falls:
                before, after = after, before
            high[before], low[after] = low[before], high[after]
    for i, end in ((0, question.ends[0]), (-1, question.ends[1])):
        for places, asked_for in ((at["q"][i], end.q), (at["v"][i], end.v)):
            fixed = np.isfinite(asked_for)
            low[places[fixed]] = high[places[fixed]] = asked_for[fixed]
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
    for is_known, places in left_out:
        if is_known:
            low[places], high[places] = -np.inf, np.inf
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
