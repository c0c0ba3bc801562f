"""How equilibria change with a parameter: branches, where they fold and cross, and where they become unstable.

`critical_points.py` has the equations and what is watched along a branch, `following.py` follows all branches; here
they get a beginning, units and a table.
"""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, PyTree

from lagjax.analysis.arclength import Along, BranchPoint, range_from
from lagjax.analysis.balance import OK, VELOCITY, WORDS, Steady, side_by_side
from lagjax.analysis.critical_points import Frame, SteadyProblem, along_named, full_jacobian, value_in, with_value
from lagjax.analysis.degenerate import unknowns
from lagjax.analysis.equilibria import held_at, searched, stacked, stacked_one, symmetries_of
from lagjax.analysis.following import BranchFollower, BranchPath
from lagjax.display import plots as plot
from lagjax.jaxtools import compiled
from lagjax.mechanics import are_angles, describe, is_autonomous
from lagjax.refusals import must_have_values, must_name
from lagjax.system import State, by_name, check_system, checked, coordinates, model_of

MARKS = {
    "fold": ("s", 1), "pitchfork": ("o", 2), "transcritical": ("D", 3), "flutter": ("^", 4),
    "branch point": ("o", 2), "period doubling": ("D", 3), "torus": ("^", 4),
}  # fmt: skip
OTHER_MARK = ("X", 6)


class Critical(eqx.Module):
    """A critical point: a branch folds, branches cross, or stability is lost.

    - `kind`: `"fold"`; `"pitchfork"` and `"transcritical"`, where branches cross; `"line of equilibria"`, where the
      crossing branch exists at this parameter value only; `"flutter"`, where a pair of roots leaves the imaginary axis,
      alone (Hopf) or as two frequencies meet (without damping); `"multiple zero"`, where the stiffness vanishes in
      several directions at once, for example by symmetry (the branches that leave it are not followed);
      `"divergence"`, where a root becomes positive and no branch crosses; `"escape"`, where the solution of linear
      equations goes to infinity.
    - `parameter`: its value; `accuracy`: the last step of Newton's method for it.
    - `q`, `v`, `multipliers`: the state there. `frequency`: that of flutter, `1/[t]`.
    - `derivative`: the derivative of `parameter` by every number in `params`, a tree like `params`; 0 for the parameter
      itself. None where the point is located by bisection only.
    - `branches`: the indices of the branches through it.
    """

    kind: str = eqx.field(static=True)
    parameter: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    multipliers: dict[str, Array]
    derivative: Any
    frequency: Float[Array, ""]
    accuracy: Float[Array, ""]
    branches: tuple[int, ...] = eqx.field(static=True)

    def __repr__(self):
        return f"{self.kind} at {float(self.parameter):.10g}"


class Branch(eqx.Module):
    """One curve of equilibria with P points, in order along it.

    - `parameter` (P,); `q`, `v`, `multipliers`: each leaf with a leading axis P.
    - `stable` (P,): no small departure grows; `eigenvalues` (P, 2n), `1/[t]`: their roots, padded with NaN.
    - `status`: where the branch ends, and why.
    """

    parameter: Float[Array, " P"]
    q: PyTree[Float[Array, "P ..."]]
    v: PyTree[Float[Array, "P ..."]]
    multipliers: dict[str, Array]
    stable: Bool[Array, " P"]
    eigenvalues: Complex[Array, "P s"]
    status: str = eqx.field(static=True)
    critical: tuple[int, ...] = eqx.field(static=True)

    def __len__(self):
        return len(self.parameter)

    def __repr__(self):
        return f"Branch of {len(self)} points, {stability_in_words(self.verdicts)}; ends at {self.status}"

    @property
    def verdicts(self) -> np.ndarray:
        """The stability of each point: STABLE, UNSTABLE or UNKNOWN."""
        return verdicts_of(self.stable, np.any(np.isfinite(self.eigenvalues), axis=1))


class Branches(eqx.Module):
    """All branches found from a start, and their critical points; print it for a table.

    - `branches`: a list of `Branch`, the one through the start first. `critical`: a list of `Critical`, the nearest
      to the start first.
    - `along`, `first`, `last`: the parameter and its range. `status`: whether all crossing branches were followed.
    """

    branches: list[Branch]
    critical: list[Critical]
    along: str = eqx.field(static=True)
    first: float = eqx.field(static=True)
    last: float = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    params: PyTree
    status: str = eqx.field(static=True)

    def __len__(self):
        return len(self.branches)

    def __getitem__(self, i: int) -> Branch:
        return self.branches[i]

    def of_kind(self, kind: str) -> list[Critical]:
        """The critical points of one kind: `"fold"`, `"pitchfork"`, ..."""
        return [c for c in self.critical if c.kind == kind]

    def __repr__(self):
        lines = [
            f"Branches of equilibria along {self.along}, from {self.first:.6g} to {self.last:.6g}: "
            f"{len(self.branches)}, with {how_many(self.critical)}"
        ]
        width = max([12, *(len(c.kind) for c in self.critical)])
        for c in self.critical:
            value = f"{self.along} = {self._number(c.parameter)}"
            on = ", ".join(str(i + 1) for i in c.branches)
            more = f", frequency {float(c.frequency):.6g}" if c.kind == "flutter" else ""
            doubt = "" if c.derivative is not None else f" (to {float(c.accuracy):.0e})"
            lines.append(f"  {c.kind:<{width}}  {value + doubt:<19}  branch{'es' * (len(c.branches) > 1)} {on}{more}")
        for i, b in enumerate(self.branches):
            low, high = np.min(b.parameter), np.max(b.parameter)
            ends = self._number(low, 6), self._number(high, 6)
            span = f"{self.along} {ends[0]} to {ends[1]}" if ends[0] != ends[1] else f"{self.along} {ends[0]}"
            lines.append(
                f"  {f'branch {i + 1}':<{width}}  {span:<19}  {stability_in_words(b.verdicts)}; ends at {b.status}"
            )
        if self.status != "all followed":
            lines.append(f"  {self.status}")
        return "\n".join(lines)

    def _number(self, x, digits=10):
        return number_in(x, self.last - self.first, digits)

    @plot.names_as_they_are()
    def plot(self, *names: str):
        """Draw coordinates against the parameter: stable branches solid, unstable dashed, critical points marked.

        **Arguments:** `names` of coordinates, one panel each; by default those that vary, at most six.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` for a name that is not a coordinate; `ImportError` without matplotlib.
        """
        must_name(names, self.names, "plot names", "coordinate", "plot('{}')")
        shown = list(names) or self._varying(self._curves())
        fig, axes = plot.panel_axes(len(shown), 2, (4.8, 3.4))
        for axis, name in zip(axes, shown):
            self.draw(axis, name)
        handles = dict(zip(*reversed(_all_handles(axes))))
        fig.legend(
            handles.values(), handles.keys(), fontsize=8, frameon=False, ncols=min(4, len(handles)),
            loc="outside lower center",
        )  # fmt: skip
        return fig

    def _in_view(self, branch):
        """Which points determine the limits of the plot: not those of a branch on its way to infinity."""
        ends = np.concatenate([branch.parameter[:1], branch.parameter[-1:]])
        off = np.min(np.abs(branch.parameter[:, None] - ends), axis=1)
        far = "infinity" in branch.status
        return (off > 0.03 * abs(self.last - self.first)) | (not far)

    def _varying(self, curves):
        values = np.concatenate(curves)
        spread = np.ptp(values, axis=0)
        largest = np.max(spread, initial=0.0)
        return [name for name, x in zip(self.names, spread) if x > 1e-9 * largest][:6] or list(self.names[:1])

    def _curves(self):
        return [side_by_side(b.q) for b in self.branches]

    def draw(self, axis, name: str | None = None):
        """Draw one coordinate, by default the first, on matplotlib axes, as `plot` does."""
        j, curves = 0 if name is None else self.names.index(name), self._curves()
        inner = []
        for i, (branch, x) in enumerate(zip(self.branches, curves)):
            colour = plot.COLOURS[i % (len(plot.COLOURS) - 1)]
            draw_by_stability(axis, branch.parameter, x[:, j], branch.verdicts, colour)
            inner.append(x[:, j])
        name_stability(axis, [branch.verdicts for branch in self.branches])
        for c in self.critical:
            y = coordinates.flatten(c.q)[0][j]
            if c.kind == "escape":
                axis.axvline(float(c.parameter), color="0.4", linestyle=":", linewidth=1.2, label="escape to infinity")
                continue
            draw_critical(axis, c, y)
        if any("infinity" in b.status for b in self.branches):
            near = np.concatenate([x[self._in_view(b)] for b, x in zip(self.branches, inner)])
            middle, half = 0.5 * (near.min() + near.max()), 0.55 * np.ptp(near)
            axis.set_ylim(middle - max(half, 1e-12), middle + max(half, 1e-12))
        axis.set(xlabel=self.along, ylabel=self.names[j])


def _all_handles(axes):
    handles, labels = [], []
    for axis in axes:
        new_handles, new_labels = axis.get_legend_handles_labels()
        handles += new_handles
        labels += new_labels
    return handles, labels


UNKNOWN, UNSTABLE, STABLE = -1, 0, 1
LOOKS = {
    STABLE: ("stable", "-", 1.8), UNSTABLE: ("unstable", "--", 1.3), UNKNOWN: ("stability not known", ":", 1.3)
}  # fmt: skip


def verdicts_of(stable, known) -> np.ndarray:
    """The stability of each point: STABLE, UNSTABLE or UNKNOWN."""
    return np.where(known, np.where(stable, STABLE, UNSTABLE), UNKNOWN)


def runs(verdicts):
    """Runs of points with the same verdict, each including the first point of the next run: (slice, verdict)."""
    edges = [0, *(np.flatnonzero(np.diff(verdicts)) + 1), len(verdicts)]
    for start, end in zip(edges, edges[1:]):
        yield slice(start, min(end + 1, len(verdicts))), int(verdicts[start])


def draw_by_stability(axis, x, y, verdicts, colour):
    """Draw a curve with its stable parts solid and its unstable parts dashed."""
    for where, verdict in runs(verdicts):
        _, dash, width = LOOKS[verdict]
        axis.plot(x[where], y[where], dash, color=colour, linewidth=width, zorder=2)


def name_stability(axis, verdicts):
    """Add the line styles that occur to the legend."""
    for verdict, (label, dash, _) in LOOKS.items():
        if any(np.any(of_one == verdict) for of_one in verdicts):
            axis.plot([], [], dash, color="0.2", label=label)


def draw_critical(axis, critical, y):
    """Mark a critical point at this height; the first of its kind gets a name."""
    marker, colour = MARKS.get(critical.kind, OTHER_MARK)
    axis.plot(
        float(critical.parameter), float(y), marker, color=plot.COLOURS[colour], markeredgecolor="white",
        markersize=7, linestyle="", zorder=4,
        label=None if critical.kind in axis.get_legend_handles_labels()[1] else critical.kind,
    )  # fmt: skip


def how_many(critical: list) -> str:
    """The number of critical points in words."""
    count = len(critical)
    return f"{count} critical point{'s' * (count != 1)}" if count else "no critical point"


def number_in(x, extent, digits=10) -> str:
    """A value of a parameter; one that is negligible compared with the extent of its range is round-off."""
    return f"{0.0 if abs(x) < 1e-13 * abs(extent) else float(x):.{digits}g}"


def stability_in_words(verdicts):
    """The stability along a branch in words, from its first point to its last."""
    kinds = [LOOKS[verdict][0] for _, verdict in runs(verdicts)]
    if len(kinds) > 4:
        return f"stable and unstable in turn ({len(kinds)} times)"
    return ", then ".join(kinds)


# The rank of the equations is computed again this far along the parameter, as a fraction of its range.
NEARBY = 1.234e-3
DEPENDENT = 1e-9
# A start near zero does not show the size of the coordinates: a branch that goes to infinity in small units is traced
# again in larger ones, until a unit of the positions exceeds the second number.
UNITS, NOTHING = (1.0, 1e3, 1e6, 1e9, 1e12), 1e-2


@by_name('lj.continue_equilibria(system, params, start, along="omega", to=5.0)', "along", "to")
def continue_equilibria(
    system,
    params: PyTree,
    start: PyTree[ArrayLike],
    *,
    along: str,
    to: float,
    velocity: PyTree[ArrayLike] | None = None,
    cyclic: str | Callable | Iterable | None = None,
    hold: str | None = VELOCITY,
    t: ArrayLike = 0.0,
    crossings: bool = True,
    most_points: int = 1000,
) -> Branches:
    """Follow an equilibrium as a parameter changes, through folds and onto crossing branches.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def bead_on_hoop(t, q, v, params):
    ...     height = -params["g"] * jnp.cos(q)
    ...     return 0.5 * (v**2 + (params["omega"] * jnp.sin(q)) ** 2) - height
    >>> system = lj.System(bead_on_hoop)
    >>> found = lj.continue_equilibria(system, {"omega": 1.0, "g": 9.0}, 0.0, along="omega", to=5.0)
    >>> print(found)
    Branches of equilibria along omega, from 1 to 5: 2, with 1 critical point
      pitchfork     omega = 3            branches 1, 2
      branch 1      omega 1 to 5         stable, then unstable; ends at the end of the range
      branch 2      omega 3 to 5         stable; ends at the end of the range

    **Arguments:**

    - `params`, `start`: where the branch begins: a position like q, near an equilibrium for `params`.
    - `along`: the number that changes, by its name in `params`: `"omega"`, `"spring.k"`, `"k[1]"`. `"v.psi"` for the
      held velocity of a cyclic coordinate psi, `"p.psi"` for its momentum (with `hold="momentum"`).
    - `to`: its last value; the first is that in `params`. Branches are followed within this range.
    - `velocity`, `cyclic`, `hold`, `t`: as in `lj.equilibria`.
    - `crossings`: whether crossing branches are followed, too. `most_points`: the largest number of points of a branch.

    **Returns:** `Branches`, with all points found before each branch ended; its `status` says why it ended.

    **Raises:** `ValueError` where no equilibrium is near the start, for an `along` that is not a number in `params`,
    and everything that `lj.equilibria` raises. `TypeError` inside `jax.jit`, `vmap` or `grad`, because the number of
    points depends on values; the result contains the derivatives of critical parameters.

    Source: Keller, in *Applications of Bifurcation Theory* (1977) 359; Govaerts, *Numerical Methods for Bifurcations of
    Dynamical Equilibria*, ch. 2-4.
    """
    check_system(system, params, start, states=False)
    q, v = stacked_one(start)
    if velocity is not None:
        v = jax.tree.map(lambda x: x[0], stacked([velocity], "velocity"))
    fix = "call it outside jit, vmap and grad; critical points carry their derivatives, branches.critical[0].derivative"
    what = "lj.continue_equilibria needs values to choose its steps"
    must_have_values((q, v, params, t, to), what, f"{fix}, and lj.equilibria works inside", eager=True)
    system, s = checked(system, State(t, q, v, params))
    moving = np.concatenate([np.ravel(x) for x in jax.tree.leaves(s.v)]) != 0
    symmetries = symmetries_of(system, s, cyclic, hold, None if velocity is None else moving)
    model, x0 = model_of(system, *s), coordinates.vector(s.q)
    steady = Steady(model, s.t, np.zeros(symmetries.count, s.t.dtype), x0, symmetries)
    held = _held(steady, coordinates.vector(s.q), coordinates.vector(s.v)) if symmetries.count else steady.held
    steady = Steady(model, s.t, held, x0, symmetries)
    place = along_named(steady, along)
    first = float(value_in(steady, place))
    last = range_from(first, to, along, "params")
    runs = []
    for units in UNITS:
        frame, z = _frame(steady, place, first, last, s.v, units)
        # If the start is a critical point, the branch begins a little before it.
        problem = SteadyProblem(frame, *sorted((float(z[-1]), last / abs(last - first))))
        begin = problem.begin(z, np.sign(last - first))
        if isinstance(begin, str):
            raise ValueError(f"the branch cannot begin at the start: {begin}.")
        runs.append(BranchFollower(problem, most_points, crossings))
        runs[-1].follow(begin)
        if "infinity" not in runs[-1].paths[0].status:
            return _result(runs[-1], first, last, s)
        if np.max(frame.columns[: steady.n]) > NOTHING:
            break
    return _result(runs[0], first, last, s)


@compiled
def _held(steady, x, u):
    return held_at(steady, x, u)[1]


@compiled
def _velocity(steady, x):
    return steady.velocity(x, steady.held)


def _solution(steady: Steady, v: PyTree) -> np.ndarray | str:
    """The unknowns of the equilibrium near `steady.x0`, or a message that says why there is none."""
    if steady.symmetries.count and steady.symmetries.hold == VELOCITY:
        v = coordinates.like(v, np.asarray(_velocity(steady, steady.x0)))

    def one(tree: PyTree):
        return jax.tree.map(lambda x: np.asarray(x)[None], tree)

    lasting = not steady.symmetries.count and is_autonomous(steady.model)
    q = steady.model.tree(np.asarray(steady.x0))
    row = jax.tree.map(lambda x: np.asarray(x)[0], searched(steady, one(q), one(v), lasting, 0, True))
    if row.status != OK:
        return WORDS[row.status]

    return unknowns(row)


def _frame(steady: Steady, place: Along, first: float, last: float, v: PyTree, units) -> tuple[Frame, np.ndarray]:
    """The units and the combinations of equations that are solved; and the point at which the branch begins."""
    y, x0 = _solution(steady, v), steady.model.tree(steady.x0)
    if isinstance(y, str):
        raise ValueError(
            f"no equilibrium was found from the start {describe(x0)}, {place.name} = {first:.6g}: {y}.\n"
            "Usual cause: a start far from an equilibrium, or a parameter at which there is none.\n"
            "Fix: found = lj.equilibria(system, params, starts=[...]) from several starts lists the equilibria; "
            "start from one of them."
        )
    unit = abs(last - first)
    n = steady.n
    angle = are_angles(steady.model)
    length = np.max(np.abs(y[:n])[~angle], initial=0.0)
    positions = np.where(angle, 1.0, units * length if length > 0 else 1.0)
    rows, columns, u, sizes, vt = _parts(steady, y, positions)
    rank = int(np.sum(sizes > DEPENDENT * sizes[0]))
    # More equations are dependent at a critical point than elsewhere, so the rank is computed again close by.
    nearby = Steady(steady.model, steady.t, steady.held, np.asarray(y[:n], steady.t.dtype), steady.symmetries)
    nearby = with_value(nearby, place, first + NEARBY * (last - first))
    nearby_y = _solution(nearby, v)
    if not isinstance(nearby_y, str):
        _, _, *nearby_svd = _parts(nearby, nearby_y, positions, (rows, columns))
        if int(np.sum(nearby_svd[1] > DEPENDENT * nearby_svd[1][0])) > rank:
            u, sizes, vt = nearby_svd
            rank = int(np.sum(sizes > DEPENDENT * sizes[0]))
            before = first - NEARBY * (last - first)
            earlier = _solution(with_value(nearby, place, before), v)
            first, y = (first, y) if isinstance(earlier, str) else (before, earlier)
    dtype = steady.t.dtype
    arrays = [np.asarray(a, dtype) for a in (u[:, :rank].T, vt[rank:], y / columns, rows, columns, unit)]
    frame = Frame(steady, *arrays, place)
    return frame, np.append(y / columns, first / unit)


def _parts(steady, y, positions, units=None):
    """The units of equations and unknowns, and the singular value decomposition of the Jacobian in these units."""
    jacobian = np.asarray(full_jacobian(steady, np.asarray(y, steady.t.dtype))[1], float)
    if units is None:
        n = steady.n

        def positive(x: np.ndarray):
            return np.where(x > 0, x, 1.0)

        rows = np.max(np.abs(jacobian[:, :n] * positions), axis=1)
        rows = positive(np.where(rows > 0, rows, np.max(np.abs(jacobian), axis=1)))
        # A row that is small where the branch begins may be large elsewhere.
        rows[:n] = np.maximum(rows[:n], 1e-6 * np.max(rows[:n]))
        columns = positive(np.max(np.abs(jacobian / rows[:, None]), axis=0))
        columns = np.concatenate([positions, 1 / columns[n:]])
        units = rows, columns
    rows, columns = units
    u, sizes, vt = np.linalg.svd(jacobian / rows[:, None] * columns[None, :])
    sizes = np.append(sizes, np.zeros(max(0, vt.shape[0] - sizes.size)))
    return rows, columns, u, sizes, vt


def _result(run: BranchFollower, first: float, last: float, s: State) -> Branches:
    """The result in the user's structure."""
    critical = [_critical(run, i) for i in range(len(run.found))]
    critical.sort(key=lambda c: abs(c.parameter - first))
    status = "all followed" if not run.waiting else f"{len(run.waiting)} crossing branches were not followed"
    return Branches(
        [_branch(path) for path in run.paths], critical, run.problem.along.name, float(first), float(last),
        tuple(coordinates.names(s.q)), s.params, status,
    )  # fmt: skip


def _critical(run: BranchFollower, i: int) -> Critical:
    found, unit = run.found[i], run.problem.unit
    if found.point is not None:
        outputs = found.point.outputs
    else:
        outputs = jax.tree.map(lambda x: x * np.nan, run.paths[0].points[0].outputs)
    q = jax.tree.map(lambda x: np.full_like(x, np.inf), outputs.q) if found.kind == "escape" else outputs.q
    return Critical(
        found.kind, np.asarray(found.z[-1] * unit), q, outputs.v, outputs.multipliers, found.derivative,
        np.asarray(found.frequency), np.asarray(found.accuracy * unit),
        tuple(k for k, path in enumerate(run.paths) if i in path.through),
    )  # fmt: skip


def _branch(path: BranchPath) -> Branch:
    parameter, q, v, multipliers, roots = jax.tree.map(lambda *x: np.stack(x), *(p.outputs for p in path.points))
    critical = tuple(sorted({p.critical for p in path.points if p.critical is not None}))
    return Branch(parameter, q, v, multipliers, stable_along(path.points), roots, path.status, critical)


def stable_along(points: list[BranchPoint]) -> np.ndarray:
    """Whether each point of a branch is known to be stable, by the nearest point that is not critical."""
    known = [i for i, point in enumerate(points) if point.growing is not None]
    nearest = [min(known, key=lambda j: (abs(j - i), -j), default=None) for i in range(len(points))]
    return np.array([j is not None and points[j].growing == 0 for j in nearest])
