"""Branches of equilibria and their critical points: the results, with their printing and plotting."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.display import plots as plot
from lagjax.system import coordinates

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
