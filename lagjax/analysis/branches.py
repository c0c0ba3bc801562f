"""How equilibria change with a parameter: branches, where they fold and cross, and where they become unstable.

A branch is traced (`tracing.py`), the critical points between two of its points are solved for (`critical_points.py`),
and the branches that cross there are traced in turn, each once.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, PyTree

from lagjax.analysis.arclength import AGAIN, FIRST, BranchPath, BranchPoint
from lagjax.analysis.balance import OK, VELOCITY, WORDS, Steady
from lagjax.analysis.critical_points import (
    CriticalPoint,
    Frame,
    ParameterPlace,
    SteadyTracer,
    between,
    escape,
    full_jacobian,
    place_of,
)
from lagjax.analysis.degenerate import unknowns
from lagjax.analysis.equilibria import held_at, searched, stacked, stacked_one, symmetries_of
from lagjax.display import plots as plot
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.mechanics import are_angles, describe, is_autonomous
from lagjax.system import State, by_name, check_system, checked, coordinates, model_of

MARKS = {"fold": ("s", 1), "pitchfork": ("o", 2), "transcritical": ("D", 3), "flutter": ("^", 4)}
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
        return f"Branch of {len(self)} points, {stability_in_words(_verdicts(self))}; ends at {self.status}"


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
        count = len(self.critical)
        points = f"{count} critical point{'s' * (count != 1)}" if count else "no critical point"
        lines = [
            f"Branches of equilibria along {self.along}, from {self.first:.6g} to {self.last:.6g}: "
            f"{len(self.branches)}, with {points}"
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
                f"  {f'branch {i + 1}':<{width}}  {span:<19}  {stability_in_words(_verdicts(b))}; ends at {b.status}"
            )
        if self.status != "all followed":
            lines.append(f"  {self.status}")
        return "\n".join(lines)

    def _number(self, x, digits=10):
        # A value that is negligible compared with the range is round-off.
        return f"{0.0 if abs(x) < 1e-13 * abs(self.last - self.first) else float(x):.{digits}g}"

    @plot.names_as_they_are()
    def plot(self, *names: str):
        """Draw coordinates against the parameter: stable branches solid, unstable dashed, critical points marked.

        **Arguments:** `names` of coordinates, one panel each; by default those that vary, at most six.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` for a name that is not a coordinate; `ImportError` without matplotlib.
        """
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(
                f"plot({unknown[0]!r}) names no coordinate; there are {', '.join(self.names)}.\n"
                f"Fix: plot({self.names[0]!r})."
            )
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
        return [_columns(b.q, len(b)) for b in self.branches]

    def draw(self, axis, name: str | None = None):
        """Draw one coordinate, by default the first, on matplotlib axes, as `plot` does."""
        j, curves = 0 if name is None else self.names.index(name), self._curves()
        inner = []
        for i, (branch, x) in enumerate(zip(self.branches, curves)):
            colour = plot.COLOURS[i % (len(plot.COLOURS) - 1)]
            draw_by_stability(axis, branch.parameter, x[:, j], _verdicts(branch), colour)
            inner.append(x[:, j])
        name_stability(axis, [_verdicts(branch) for branch in self.branches])
        for c in self.critical:
            y = coordinates.flatten(c.q)[0][j]
            if c.kind == "escape":
                axis.axvline(float(c.parameter), color="0.4", linestyle=":", linewidth=1.2, label="escape to infinity")
                continue
            marker, colour = MARKS.get(c.kind, OTHER_MARK)
            axis.plot(
                float(c.parameter), float(y), marker, color=plot.COLOURS[colour], markeredgecolor="white",
                markersize=7, linestyle="", label=c.kind, zorder=4,
            )  # fmt: skip
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


def _columns(tree, rows):
    return np.concatenate([np.asarray(x).reshape(rows, -1) for x in jax.tree.leaves(tree)], axis=1)


UNKNOWN, UNSTABLE, STABLE = -1, 0, 1
LOOKS = {
    STABLE: ("stable", "-", 1.8), UNSTABLE: ("unstable", "--", 1.3), UNKNOWN: ("stability not known", ":", 1.3)
}  # fmt: skip


def _verdicts(branch):
    """The stability of each point: STABLE, UNSTABLE or UNKNOWN."""
    known = np.any(np.isfinite(branch.eigenvalues), axis=1)
    return np.where(known, np.asarray(branch.stable).astype(int), UNKNOWN)


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


def stability_in_words(verdicts):
    """The stability along a branch in words, from its first point to its last."""
    kinds = [LOOKS[verdict][0] for _, verdict in runs(verdicts)]
    if len(kinds) > 4:
        return f"stable and unstable in turn ({len(kinds)} times)"
    return ", then ".join(kinds)


# Critical points closer than this are the same.
SAME = 1e-5
MOST_BRANCHES = 24
# The rank of the equations is computed again this far along the parameter, as a fraction of its range.
NEARBY = 1.234e-3
DEPENDENT = 1e-9
# A start near zero does not show the size of the coordinates: a branch that goes to infinity in small units is traced
# again in larger ones, until a unit of the positions exceeds the second number.
UNITS, NOTHING = (1.0, 1e3, 1e6, 1e9, 1e12), 1e-2
# A branch whose last so many points agree in the parameter to this accuracy is a line of equilibria.
LINE, LINE_WITHIN = 40, 1e-9


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
    if not is_eager() or is_traced((q, v, params, t, to)):
        raise TypeError(
            "lj.continue_equilibria needs values to choose its steps, but JAX is tracing.\n"
            "Fix: call it outside jit, vmap and grad; critical points carry their derivatives, "
            "branches.critical[0].derivative, and lj.equilibria works inside."
        )
    system, s = checked(system, State(t, q, v, params))
    moving = np.concatenate([np.ravel(x) for x in jax.tree.leaves(s.v)]) != 0
    symmetries = symmetries_of(system, s, cyclic, hold, None if velocity is None else moving)
    model, x0 = model_of(system, *s), coordinates.vector(s.q)
    steady = Steady(model, s.t, np.zeros(symmetries.count, s.t.dtype), x0, symmetries)
    held = _held(steady, coordinates.vector(s.q), coordinates.vector(s.v)) if symmetries.count else steady.held
    steady = Steady(model, s.t, held, x0, symmetries)
    place = place_of(steady, along)
    first, last = float(place.get(steady)), float(to)
    if not np.isfinite(last) or first == last:
        raise ValueError(
            f"to={to} leaves the parameter {along!r} no range: it starts at {first:.6g}.\n"
            f"Fix: to={2 * first or 1.0:.6g}, and the first value in params."
        )
    runs = []
    for units in UNITS:
        frame, z = _frame(steady, place, first, last, s.v, units)
        # If the start is a critical point, the branch begins a little before it.
        low, high = sorted((float(z[-1]), last / abs(last - first)))
        runs.append(_Run(SteadyTracer(frame, low, high), most_points, crossings))
        runs[-1].main(z, np.sign(last - first))
        if "infinity" not in runs[-1].paths[0].status:
            return runs[-1].result(along, first, last, s)
        if np.max(frame.columns[: steady.n]) > NOTHING:
            break
    return runs[0].result(along, first, last, s)


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


def _frame(
    steady: Steady, place: ParameterPlace, first: float, last: float, v: PyTree, units
) -> tuple[Frame, np.ndarray]:
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
    nearby = place.put(nearby, first + NEARBY * (last - first))
    nearby_y = _solution(nearby, v)
    if not isinstance(nearby_y, str):
        _, _, *nearby_svd = _parts(nearby, nearby_y, positions, (rows, columns))
        if int(np.sum(nearby_svd[1] > DEPENDENT * nearby_svd[1][0])) > rank:
            u, sizes, vt = nearby_svd
            rank = int(np.sum(sizes > DEPENDENT * sizes[0]))
            before = first - NEARBY * (last - first)
            earlier = _solution(place.put(nearby, before), v)
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


class _Launch(NamedTuple):
    """A branch still to be traced, from a critical point in a direction."""

    critical: int
    direction: np.ndarray


class _Run:
    """The branches and critical points found so far, and the branches still to be traced."""

    def __init__(self, tracer: SteadyTracer, most: int, crossings: bool):
        self.tracer, self.most, self.crossings = tracer, most, crossings
        self.paths: list[BranchPath] = []
        self.found: list[CriticalPoint] = []
        self.branches_at: list[set[int]] = []
        self.waiting: list[_Launch] = []

    def main(self, z, towards):
        """Trace the first branch, and all that cross."""
        start = np.zeros_like(z)
        start[-1] = towards
        corrected = self.tracer.corrected(z, np.eye(z.size)[-1])
        begin = self.tracer.point(z if corrected is None else corrected, start)
        if isinstance(begin, str):
            raise ValueError(f"the branch cannot begin at the start: {begin}.")
        self._follow(begin)
        while self.waiting and len(self.paths) < MOST_BRANCHES:
            launch = self.waiting.pop(0)
            halves = [self._from(launch, sign) for sign in (1.0, -1.0)]
            whole = _joined(halves)
            if whole.points[1:]:
                self.paths.append(whole)
            else:
                for branches_at in self.branches_at:
                    branches_at.discard(len(self.paths))

    def _follow(self, begin: BranchPoint):
        path = self.tracer.trace(begin, self.most, self._step)
        self._describe_infinity(path)
        self.paths.append(path)

    def _from(self, launch: _Launch, sign: float) -> BranchPath:
        """Trace one half of a branch that crosses another."""
        critical = self.found[launch.critical]
        jacobian = self.tracer.at(critical.z)[1]
        point = self.tracer.point(critical.z, sign * launch.direction)
        if isinstance(point, str):
            return BranchPath([], point)
        begin = BranchPoint(
            critical.z, jacobian, sign * launch.direction, 0.0, point.outputs, None, point.negative, launch.critical
        )
        path = self.tracer.trace(begin, self.most, self._step, FIRST)
        self._describe_infinity(path)
        return path

    def _describe_infinity(self, path):
        """State where a branch goes to infinity, with a critical point if the parameter there can be solved for."""
        if path.status != "infinity":
            return
        point, name = path.points[-1], self.tracer.frame.place.name
        path.status = f"infinity, near {name} = {point.z[-1] * self.tracer.unit:.6g}"
        found = escape(self.tracer, point)
        if found:
            path.status = f"infinity, at {name} = {found.z[-1] * self.tracer.unit:.10g}"
            self.found.append(found)
            self.branches_at.append({len(self.paths)})

    def _step(self, before: BranchPoint, after: BranchPoint, path: BranchPath) -> str | None:
        """Put the critical points between two points into the path; return why the branch ends, or None."""
        points = path.points
        if len(points) >= LINE and points[0].critical is not None:
            last = np.array([p.z[-1] for p in points[-LINE:]])
            if np.ptp(last) < LINE_WITHIN:
                self.found[points[0].critical].kind = "line of equilibria"
                return "a line of equilibria, which goes on"
        ended = None
        # A turn that was not located, in a step past a crossing, is that crossing.
        all_critical = [c for c in between(self.tracer, before, after) if c.located or not self._crosses(before, after)]
        if before.sign * after.sign < 0 and not any(critical.directions for critical in all_critical):
            return AGAIN
        for critical in all_critical:
            number, known = self._number(critical)
            kept = self.found[number]
            along = (self.tracer.weights * (after.z - before.z)) / np.linalg.norm(after.z - before.z)
            self.branches_at[number].add(len(self.paths))
            if known and any(abs(_cosine(self.tracer, d, after.z - before.z)) > 0.95 for d in kept.used):
                if kept.directions:
                    ended = f"a known crossing, at {self._value(kept)}"
            followed = max(kept.directions, key=lambda d: abs(d @ along)) if kept.directions else None
            if followed is not None:
                kept.used.append(followed)
                self.waiting = [w for w in self.waiting if w.critical != number or abs(w.direction @ along) <
                                0.95 * np.sqrt(along @ along)]  # fmt: skip
                if not known and self.crossings:
                    others = [d for d in kept.directions if d is not followed]
                    self.waiting += [_Launch(number, d) for d in others]
                    kept.used += others
            path.points.append(self._point(kept, number, after))
        return ended

    def _crosses(self, before: BranchPoint, after: BranchPoint) -> bool:
        """Whether a known critical point is as near to a point as another one."""
        length = lambda z: np.sqrt(self.tracer.weights @ z**2)
        return any(length(found.z - before.z) <= 2 * length(after.z - before.z) for found in self.found)

    def _value(self, found):
        return f"{self.tracer.frame.place.name} = {found.z[-1] * self.tracer.unit:.6g}"

    def _point(self, found, number, after):
        """The point of a branch at a critical point."""
        point = self.tracer.point(found.z, after.tangent)
        if isinstance(point, str):
            point = after
        return BranchPoint(
            found.z, point.jacobian, after.tangent, after.sign, point.outputs, None, after.negative, number
        )

    def _number(self, found: CriticalPoint) -> tuple[int, bool]:
        """The number of a critical point among those found, and whether it was known already."""
        for i, other in enumerate(self.found):
            if np.max(np.abs(self.tracer.weights * (other.z - found.z))) < SAME * self.tracer.size(found.z):
                return i, True
        self.found.append(found)
        self.branches_at.append(set())
        return len(self.found) - 1, False

    def result(self, along, first, last, s) -> Branches:
        """The result in the user's structure."""
        branches = [_branch(path, self.tracer) for path in self.paths]
        critical = [self._critical(i) for i in range(len(self.found))]
        order = sorted(range(len(critical)), key=lambda i: abs(critical[i].parameter - first))
        names = coordinates.names(s.q)
        status = "all followed" if not self.waiting else f"{len(self.waiting)} crossing branches were not followed"
        return Branches(
            branches, [critical[i] for i in order], along, float(first), float(last), tuple(names), s.params,
            status,
        )  # fmt: skip

    def _critical(self, i) -> Critical:
        found = self.found[i]
        branches_at = {k for k in self.branches_at[i] if k < len(self.paths)}
        branches_at |= {k for k, path in enumerate(self.paths) if any(p.critical == i for p in path.points)}
        point = self.tracer.point(found.z, self._some_direction(found))
        outputs = point.outputs if not isinstance(point, str) else None
        outputs = outputs or jax.tree.map(lambda x: x * np.nan, self.paths[0].points[0].outputs)
        value = found.z[-1] * self.tracer.unit
        _, q, v, multipliers, _ = outputs
        if found.kind == "escape":
            q = jax.tree.map(lambda x: np.full_like(x, np.inf), q)
        return Critical(
            found.kind, np.asarray(value), q, v, multipliers, found.derivative, np.asarray(found.frequency),
            np.asarray(found.accuracy * self.tracer.unit), tuple(sorted(branches_at)),
        )  # fmt: skip

    def _some_direction(self, found):
        return found.directions[0] if found.directions else np.ones_like(found.z)


def _cosine(tracer, a, b):
    def inner(a: np.ndarray, b: np.ndarray) -> float:
        return (tracer.weights * a) @ b

    return inner(a, b) / np.sqrt(inner(a, a) * inner(b, b))


def _joined(halves: list[BranchPath]) -> BranchPath:
    """Join both halves of a branch, from one end through the critical point to the other end."""
    first, second = halves
    points = [*second.points[:0:-1], *first.points]
    status = first.status if not second.points[1:] else f"{second.status}, and {first.status}"
    if first.status == second.status:
        status = first.status
    return BranchPath(points, status)


def _branch(path: BranchPath, tracer: SteadyTracer) -> Branch:
    outputs = [p.outputs for p in path.points]
    parameter, q, v, multipliers, roots = jax.tree.map(lambda *x: np.stack(x), *outputs)
    stable = np.array([p.growing for p in path.points], object)
    # At a critical point a root is zero up to round-off, so the nearest other point decides the stability.
    known = [i for i, n in enumerate(stable) if n is not None]
    filled = [stable[min(known, key=lambda j: (abs(j - i), -j))] if known else 0 for i in range(len(stable))]
    critical = tuple(sorted({p.critical for p in path.points if p.critical is not None}))
    return Branch(parameter, q, v, multipliers, np.array([n == 0 for n in filled]), roots, path.status, critical)
