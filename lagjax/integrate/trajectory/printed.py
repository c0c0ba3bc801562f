"""The printed form of a trajectory: its method, result, cost and error, and the shapes of its outputs."""

import jax
import numpy as np

from lagjax.display.printable import printable
from lagjax.integrate.trajectory import error_report
from lagjax.integrate.trajectory.results import ENDED_WELL, is_among, item, message


def lines(traj) -> list[str]:
    """The printed lines of one motion."""
    rows = [
        ("method", f"{traj.static.method}, rtol {_pair(traj.tolerance[0])}, atol {_absolute(traj.tolerance[1])}"),
        ("result", message(traj.result) + _ended(traj)),
        *error_report.of_cost(traj),
        *(error_report.of_error(traj) or _not_estimated(traj)),
    ]
    rows += traj._of_system()
    if 1 < float(traj.scaled_error) < np.inf:
        times = f"{float(traj.scaled_error):.2g} times"
        rows.append(("WARNING", f"the error at the outputs is {times} what the tolerance lets expect"))
    rows += _shape_rows(traj)
    return ["Trajectory", *_aligned(rows)]


def _not_estimated(traj):
    if traj.error is None or is_among(traj.error.result, ENDED_WELL):
        return []
    return [("error", message(traj.error.result))]


def _pair(tolerance):
    of_q, of_v = (f"{float(value):.3g}" for value in np.asarray(tolerance))
    return of_q if of_q == of_v else f"{of_q} (q), {of_v} (v)"


def _absolute(atol):
    return _pair(atol) if np.ndim(atol) == 1 else "by size"


def batch_lines(traj, lanes: tuple[int, ...]) -> list[str]:
    """The printed lines of a batch; `lanes`: its shape."""
    values, counts = np.unique(np.asarray(traj.result._value), return_counts=True)
    words = [f"{n} {message(item(traj.result, v))}" for v, n in zip(values, counts)]
    steps, errors = np.asarray(traj.stats["num_steps"]), np.asarray(traj.scaled_error)
    drifted = int(np.sum((errors > 1) & (errors < np.inf)))
    rows = [
        ("method", traj.static.method),
        ("lanes", " x ".join(map(str, lanes))),
        ("results", "; ".join(words)),
        *([("WARNING", f"{drifted} lanes are less accurate than the tolerance lets expect")] if drifted else []),
        ("steps a lane", f"{steps.min()} to {steps.max()}, {int(steps.sum())} in all" if steps.size else "no lanes"),
        *_shape_rows(traj),
    ]
    return ["Trajectory, a batch", *_aligned(rows)]


def _ended(traj):
    first, last, end = *np.asarray(traj.t)[[0, -1]], float(traj.end.t)
    return "" if abs(end - first) >= abs(last - first) else f" (at t = {end:.9g} of {last:.6g})"


def _shape_rows(traj):
    rows = [("outputs", f"{traj.t.shape[-1]} times, {traj.t.dtype}")]
    for label, tree in (("q, v", traj.q), ("multipliers", traj.multipliers)):
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        if leaves:
            shown = [f"{jax.tree_util.keystr(p, simple=True, separator='.')} {x.shape}".strip() for p, x in leaves]
            rows.append((label, ", ".join(shown)))
    return rows


def _aligned(rows):
    width = max(len(label) for label, _ in rows)
    return [printable(f"  {label:<{width}}  {value}") for label, value in rows]
