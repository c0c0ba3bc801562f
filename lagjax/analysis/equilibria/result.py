"""The result of a search for steady motions: a table of equilibria, and the outcome of each start."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from lagjax.analysis.equilibria.balance import SteadySymmetries
from lagjax.display import by_line
from lagjax.jaxtools import is_traced
from lagjax.mechanics import describe
from lagjax.system import coordinates

OK, NO_BALANCE, CONSTRAINED, NOT_FINITE, NOT_LASTING, UNFINISHED = range(6)
WORDS = (
    "found",
    "no equilibrium near it: the imbalance of forces has a nonzero minimum there, or fades far away",
    "the constraints cannot be met there: they contradict each other, or the held velocity",
    "L, a force or a constraint is not finite on the way, or the search goes to infinity",
    "a balance at this instant only: it depends on t, or the motion leaves it",
    "the search has not finished: start again from where it stopped, `last`",
)
# Coordinates that agree to this fraction of the largest are the same.
SAME = 1e-6


class EquilibriumRow(NamedTuple):
    """The result of one start; the names are those of `Equilibria`."""

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    multipliers: dict[str, Float[Array, "..."]]
    rates: Float[Array, " k"]
    momenta: Float[Array, " k"]
    stable: Bool[Array, ""]
    undecided: Bool[Array, ""]
    eigenvalues: Complex[Array, " s"]
    found: Bool[Array, ""]
    zero_modes: Int[Array, ""]
    soft: Int[Array, ""]
    imbalance: Float[Array, ""]
    status: Int[Array, ""]
    last: PyTree[Float[Array, "..."]]


class Equilibria(eqx.Module):
    """States of rest and of steady motion, one row each (E,), and the outcome of each start (S,); print it for a table.

    - `t`; `q`, `v`: the states, each leaf with a leading axis E, `[q]`, `[q]/[t]`.
    - `multipliers`: by constraint name, (E, ...), `[L]/[g]`; with dependent constraints those of least norm.
    - `rates`, `momenta` (E, k): those of each cyclic motion, `1/[t]` (`[q]/[t]` for a coordinate) and `[L][t]`.
    - `stable` (E,): no small departure grows. (If none decays either, as without friction, and forces are gyroscopic or
      circulatory, this holds for the linear equations only: roots on the imaginary axis are the limit of stability.)
      At a point with a zero mode that is no family, the first term that does not vanish along it decides.
    - `undecided` (E,): neither stable nor unstable for what the library can show: several zero modes, velocity
      constraints, or forces beside a zero mode that neither conserve nor lose energy; while JAX traces, any zero mode
      but those of coordinates that nothing depends on.
    - `eigenvalues` (E, 2n): the roots s of departures e^(st), `1/[t]`, padded with NaN; the derivative of a double root
      is that of the mean.
    - `zero_modes` (E,): in how many directions, besides the cyclic ones, the balance holds to first order: the
      equilibrium is the member of a family nearest to its start, or a critical point where branches meet.
      `soft` (E,): the same for directions whose stiffness is so small that the root may be a multiple one.
    - `imbalance` (E,): the imbalance, relative to the effect of a displacement as large as the coordinates.
    - `found` (E,): whether the row is an equilibrium; `status` (S,): 0 where a start led to one, and
      `describe(status)` says what another number means.
    - `of_start` (S,): the row to which each start led, -1 for none. `starts`, `last`: leaves with a leading axis S,
      where each search began and ended, including those that found nothing.

    While JAX traces, E is S and rows that are not equilibria are NaN.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "E ..."]]
    v: PyTree[Float[Array, "E ..."]]
    multipliers: dict[str, Float[Array, "E ..."]]
    rates: Float[Array, "E k"]
    momenta: Float[Array, "E k"]
    stable: Bool[Array, " E"]
    undecided: Bool[Array, " E"]
    eigenvalues: Complex[Array, "E s"]
    found: Bool[Array, " E"]
    zero_modes: Int[Array, " E"]
    soft: Int[Array, " E"]
    imbalance: Float[Array, " E"]
    status: Int[Array, " S"]
    last: PyTree[Float[Array, "S ..."]]
    starts: PyTree[Float[Array, "S ..."]]
    params: PyTree
    symmetries: SteadySymmetries = eqx.field(static=True)
    of_start: Int[Array, " S"] | None = None

    def __len__(self):
        return self.found.shape[0]

    def describe(self, status: int) -> str:
        """The meaning of a status in words."""
        return WORDS[int(status)]

    def __getitem__(self, i: int) -> tuple:
        """The state (t, q, v, params) of one equilibrium, as other functions take it."""
        q, v = jax.tree.map(lambda x: x[i], (self.q, self.v))
        return self.t, q, v, self.params

    def __repr__(self):
        if is_traced((self.q, self.found)):
            return f"Equilibria, being traced, of {self.found.shape[-1]} starts"
        if self.found.ndim > 1:
            shape = " x ".join(map(str, self.found.shape[:-1]))
            return (
                f"Equilibria, {int(np.sum(self.found))} from a batch of {shape} with {self.found.shape[-1]} starts each"
            )
        return by_line("\n".join(_lines(self)))


def merged(rows: Equilibria, angle: np.ndarray, radii: np.ndarray) -> Equilibria:
    """Merge duplicates; equilibria keep the order in which starts led to them.

    `angle` (n,): which coordinates are angles. `radii` (S,): how far from each other searches may end at the same
    multiple root; 0 at simple ones.
    """
    found_rows = np.flatnonzero(np.asarray(rows.found))
    angle = angle & ~np.isin(np.arange(angle.size), rows.symmetries.places)
    x, u = _columns(rows.q), _columns(rows.v)
    x[:, list(rows.symmetries.places)] = 0.0
    other = np.concatenate([u, _columns(rows.multipliers)], axis=1) if rows.multipliers else u
    roots = np.asarray(rows.eigenvalues)
    kept: list[int] = []
    of_start = np.full(len(x), -1)
    for i in found_rows:
        for place, j in enumerate(kept):
            off = x[i] - x[j]
            off = np.where(angle, off - 2 * np.pi * np.round(off / (2 * np.pi)), off)
            radius = max(radii[i], radii[j])
            same = _close(off, np.maximum(np.abs(x[i]), np.abs(x[j])), angle) or np.max(np.abs(off)) <= radius
            # With half an angle in L, for example, states a whole turn apart can differ.
            alike = _close(other[i] - other[j], np.abs(other[i]), np.zeros(other.shape[1], bool))
            verdicts = rows.stable[i] == rows.stable[j] and rows.undecided[i] == rows.undecided[j]
            # Roots near zero are the root of a stiffness that is round-off.
            if same and alike and verdicts and (radius > 0 or _same_roots(roots[i], roots[j])):
                of_start[i] = place
                break
        else:
            of_start[i] = len(kept)
            kept.append(i)
    row_fields = [name for name in EquilibriumRow._fields if name not in ("status", "last")]
    return replace(
        rows,
        **{name: jax.tree.map(lambda x: x[np.array(kept, int)], getattr(rows, name)) for name in row_fields},
        of_start=of_start,
    )


def _close(off, size, angle):
    largest = max(np.max(size, initial=0.0), 1e-300)
    return bool(np.all(np.abs(off) <= SAME * np.where(angle, 1.0, largest)))


def _same_roots(a, b):
    a, b = (np.sort_complex(x[np.isfinite(x)]) for x in (a, b))
    return a.size == b.size and np.all(np.abs(np.abs(a) - np.abs(b)) <= 1e-3 * max(np.abs(a).max(initial=0.0), 1e-300))


def _columns(tree):
    leaves = [np.array(x, float) for x in jax.tree.leaves(tree)]
    return np.concatenate([x.reshape(x.shape[0], -1) for x in leaves], axis=1)


def _lines(found: Equilibria):
    count, starts = int(np.sum(found.found)), found.status.shape[0]
    kind = "steady motions" if found.symmetries.count else "equilibria"
    yield f"{kind.capitalize()}: {count} from {starts} start{'s' * (starts != 1)}"
    rows = [_row(found, i) for i in range(len(found)) if found.found[i]]
    if rows:
        heads = list(rows[0])
        widths = [max(len(head), *(len(row[head]) for row in rows)) for head in heads]
        yield "  " + "  ".join(head.rjust(width) for head, width in zip(heads, widths)).rstrip()
        for row in rows:
            yield "  " + "  ".join(row[head].rjust(width) for head, width in zip(heads, widths)).rstrip()
    if any(found.zero_modes[i] for i in range(len(found)) if found.found[i]):
        yield "  A zero mode: one of a family of equilibria, the nearest to its start; or branches meet there."
    status = np.asarray(found.status)
    for code in range(1, len(WORDS)):
        lost = np.flatnonzero(status == code)
        if lost.size:
            yield f"  {lost.size} start{'s' * (lost.size > 1)} led to none: {WORDS[code]}"
            for i in lost[:3]:

                def at(tree: PyTree, i: int = i):
                    return describe(jax.tree.map(lambda x: x[i], tree))

                yield f"    from {at(found.starts)} as far as {at(found.last)}"
            if lost.size > 3:
                yield "    ..."


def _row(found, i):
    """One row of the table, by the heads of its columns."""

    def pick(tree: PyTree):
        return jax.tree.map(lambda x: x[i], tree)

    q, v = pick(found.q), pick(found.v)
    x = np.asarray(coordinates.flatten(q)[0])
    row = {name: _number(x, np.abs(x).max()) for name, x in zip(coordinates.names(q), x)}
    moves = np.any(np.concatenate([np.asarray(x).reshape(len(found), -1) for x in jax.tree.leaves(found.v)], 1), axis=0)
    u = coordinates.flatten(v)[0]
    for name, x, shown in zip(coordinates.names(v), u, moves):
        if shown:
            row[f"v{name[1:]}" if name == "q" or name.startswith("q[") else f"v.{name}"] = _number(x)
    for name, value in pick(found.multipliers).items():
        entries = np.ravel(value)
        for j, x in enumerate(entries):
            row[f"λ {name}" + (f"[{j}]" if np.ndim(value) else "")] = _number(x)
    roots = np.asarray(found.eigenvalues[i])
    known = np.any(np.isfinite(roots))
    verdict = "stable" if found.stable[i] else "undecided" if found.undecided[i] else "unstable"
    row[""] = verdict if known else "stability not known"
    if found.zero_modes[i]:
        count = int(found.zero_modes[i])
        row[""] += f", {count} zero mode{'s' * (count > 1)}"
    return row


def _number(x, largest=0.0):
    # A value that is negligible compared with the others, and with one radian, is round-off.
    return "0" if abs(x) < 1e-12 * max(largest, 1.0) else f"{float(x):.6g}"
