"""How a cycle changes with a parameter: a branch of cycles, its folds, and where it becomes unstable.

At a critical point a multiplier passes 1 or -1, or a pair leaves the unit circle.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.analysis.arclength import NUMBER, Along, no_such_number, numbers_in, range_from
from lagjax.analysis.balance import side_by_side
from lagjax.analysis.branches import (
    draw_by_stability,
    draw_critical,
    how_many,
    name_stability,
    number_in,
    stability_in_words,
    stable_along,
    verdicts_of,
)
from lagjax.analysis.cycle_equations import (
    ENERGY,
    ENTRY,
    PERIOD,
    CycleProblem,
    Guide,
    OrbitFrame,
    drive_by_parameter,
    sizes_at,
)
from lagjax.analysis.flow import any_flow
from lagjax.analysis.following import AT_EDGE, BranchFollower
from lagjax.analysis.monodromy import OrbitProblem, any_problem_of, tolerance_of, user_system
from lagjax.analysis.periodic_orbit import PeriodicOrbit
from lagjax.analysis.shooting import Goal, OrbitRequest, guessed
from lagjax.display import labelled
from lagjax.display import plots as plot
from lagjax.jaxtools import compiled, hashable_partition
from lagjax.refusals import must_be, must_be_single, must_have_values, must_name
from lagjax.system import State, checked, coordinates


class CriticalOrbit(eqx.Module):
    """A point where a branch of cycles folds, where others branch off, or where stability is lost.

    - `kind`: `"fold"`, where the parameter turns; `"branch point"`, where a multiplier passes 1 and the branch
      continues, or where the parameter turns as the branch meets another, of whose orbits it is a side branch;
      `"period doubling"`,
      where one passes -1; `"torus"`, where a pair leaves the unit circle (Neimark-Sacker; without damping two pairs
      meet).
    - `parameter`: its value; `accuracy`: how far off it may be; `located`: False where no more is known than that it
      lies between two points of the branch, since the equations are nearly singular there.
    - `index`: its index on the branch: `branch[index]` is the cycle.
    - `multipliers` (k,): the trivial ones (1 for a known reason) first.
    """

    kind: str = eqx.field(static=True)
    parameter: Float[Array, ""]
    accuracy: Float[Array, ""]
    index: int = eqx.field(static=True)
    multipliers: Complex[Array, " k"]
    located: bool = eqx.field(static=True, default=True)

    def __repr__(self):
        return f"{self.kind} at {float(self.parameter):.10g}{self.doubt}"

    @property
    def doubt(self) -> str:
        """In words, how far off the parameter may be, where it was not located."""
        return "" if self.located else f" (to {float(self.accuracy):.0e})"


class OrbitBranch(eqx.Module):
    """One curve of P cycles, in their order along it: `branch[i]` is a `PeriodicOrbit`.

    - `parameter`, `period` (P,); `q`, `v`: the state at the start of each, with a leading axis P.
    - `low`, `high`: the smallest and the largest value of each coordinate over a period, like `q`; accurate to 1e-6.
    - `stable` (P,): whether no multiplier is outside the unit circle; `multipliers` (P, k): the trivial ones first.
    - `critical`: a list of `CriticalOrbit`, in the order along the branch.
    - `along`, `first`, `last`: the parameter and its range. `status`: where and why the branch ends.
    """

    parameter: Float[Array, " P"]
    period: Float[Array, " P"]
    q: PyTree[Float[Array, "P ..."]]
    v: PyTree[Float[Array, "P ..."]]
    low: PyTree[Float[Array, "P ..."]]
    high: PyTree[Float[Array, "P ..."]]
    stable: Bool[Array, " P"]
    multipliers: Complex[Array, "P k"]
    nodes: Float[Array, "P K 2n"]
    critical: list[CriticalOrbit]
    orbit: PeriodicOrbit
    place: Along
    along: str = eqx.field(static=True)
    first: float = eqx.field(static=True)
    last: float = eqx.field(static=True)
    status: str = eqx.field(static=True)

    def __len__(self):
        return len(self.parameter)

    def __getitem__(self, i: int) -> PeriodicOrbit:
        if not -len(self) <= i < len(self):
            raise IndexError(f"there are {len(self)} cycles, branch[0] to branch[{len(self) - 1}].")

        def pick(tree: PyTree):
            return jax.tree.map(lambda x: x[i], tree)

        system, params = self.orbit.system, self.orbit.params
        if self.place.kind == NUMBER and self.place.number is not None:
            params = self.place.number.put(params, self.parameter[i])
        arrays, static = hashable_partition((system, coordinates.as_arrays(params, self.orbit.t.dtype)))
        return replace(
            self.orbit, q=pick(self.q), v=pick(self.v), period=self.period[i], nodes=self.nodes[i], arrays=arrays,
            static=static, switches=None,
        )  # fmt: skip

    def of_kind(self, kind: str) -> list[CriticalOrbit]:
        """The critical points of one kind, `"fold"`, `"period doubling"`, ..."""
        return [c for c in self.critical if c.kind == kind]

    @plot.names_as_they_are()
    def plot(self, *names: str):
        """Draw the largest value of coordinates against the parameter: stable solid, unstable dashed, with markers.

        **Arguments:** `names` of coordinates, or `"period"`, one panel each; by default the first six coordinates.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` for an unknown name; `ImportError` without matplotlib.
        """
        known = self._names()
        must_name(names, [*known, "period"], "plot names", "coordinate", "plot('{}')")
        shown = list(names) or known[:6]
        fig, axes = plot.panel_axes(len(shown), 2, (4.8, 3.4))
        for axis, name in zip(axes, shown):
            self.draw(axis, name)
        axes[0].legend(fontsize=8, frameon=False)
        return fig

    def draw(self, axis, name: str | None = None):
        """Draw the largest value of one coordinate, by default the first, or `"period"`, on matplotlib axes."""
        name = self._names()[0] if name is None else name
        y = self._values(name)
        draw_by_stability(axis, np.asarray(self.parameter), y, self.verdicts, plot.COLOURS[0])
        name_stability(axis, [self.verdicts])
        for c in self.critical:
            draw_critical(axis, c, y[c.index])
        axis.set(xlabel=self.along, ylabel=name if name == "period" else f"largest {name}")

    def _names(self):
        return coordinates.names(self.orbit.q)

    def _values(self, name: str):
        if name == "period":
            return np.asarray(self.period)
        return side_by_side(self.high)[:, self._names().index(name)]

    @property
    def verdicts(self) -> np.ndarray:
        """The stability of each cycle: STABLE, UNSTABLE or UNKNOWN."""
        return verdicts_of(self.stable, np.all(np.isfinite(self.multipliers), axis=1))

    def __repr__(self):
        def number(x) -> str:
            return number_in(x, self.last - self.first)

        reached = [float(np.min(self.parameter)), float(np.max(self.parameter))]
        reached = reached if self.first <= self.last else reached[::-1]
        # Of the range that was asked for, which ends may lie beside by round-off.
        whole = abs(reached[1] - self.last) < 1e-9 * abs(self.last - self.first)
        span = f"from {number(reached[0])} to {number(reached[1])}" + ("" if whole else f" (asked to {self.last:.6g})")
        rows = [
            (c.kind, f"{self.along} = {number(c.parameter) + c.doubt:<14} {_torus_angle(c)}") for c in self.critical
        ]
        low, high = np.min(self.period), np.max(self.period)
        rows.append(("periods", f"{low:.6g}" + (f" to {high:.6g}" if high - low > 1e-9 * high else "")))
        rows.append(("stability", stability_in_words(self.verdicts)))
        where = f", {self.along} = {number(self.parameter[-1])}" if self.status == AT_EDGE else ""
        rows.append(("ends at", f"{self.status}{where}"))
        return labelled(
            f"Branch of cycles along {self.along}, {span}: {len(self)} of them, with {how_many(self.critical)}", rows
        )


def _torus_angle(c: CriticalOrbit):
    """For a torus, the angle of its pair of multipliers; otherwise nothing."""
    if c.kind != "torus":
        return ""
    upper = np.asarray(c.multipliers)[np.imag(c.multipliers) > 1e-6]
    if not upper.size:
        return ""
    pair = upper[np.argmin(np.abs(np.abs(upper) - 1))]
    return f"a pair at ±{np.angle(pair):.6g} rad"


# Singular values of the equations below this fraction of the largest count as zero.
DEPENDENT = 1e-7
# The period of a drive counts as constant if its logarithm changes by less.
CONSTANT = 1e-9


def continue_orbits(
    orbit: PeriodicOrbit, *, along: str, to: float, rtol: float | None = None, most_points: int = 1000
) -> OrbitBranch:
    """Follow a periodic orbit as a parameter changes, through folds, with its stability.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    >>> orbit = lj.periodic_orbit(pendulum, (1.0, 0.0), 6.7, {"g": 1.0})
    >>> branch = lj.continue_orbits(orbit, along="q", to=2.0)
    >>> print(branch.period[[0, -1]].round(6))
    [6.699976 8.349753]

    **Arguments:**

    - `orbit`: the result of `lj.periodic_orbit` at which the branch begins; it may have switches. Then the branch ends
      where other switches occur in its cycles, as where a motion grazes, and `status` says so.
    - `along`: what changes, by its name in the orbit's parameters: `"omega"`, `"spring.k"`, `"k[1]"`. For a system that
      does not depend on time also `"period"`, or a coordinate or velocity of the start, `"theta"`, `"v.theta"`; where
      it is conserved, `"energy"` (the Jacobi integral). Along a number in the parameters the orbits hold what `orbit`
      was found with. The period of a drive follows its parameters.
    - `to`: its last value; the first is that of the orbit. The branch is followed within this range.
    - `rtol`: as in `lj.periodic_orbit`. `most_points`: the largest number of points of the branch.

    **Returns:** an `OrbitBranch`, with all points found before the branch ended; its `status` says why it ended.

    **Raises:**

    - `TypeError` for an `orbit` that is not a periodic orbit, and inside `jax.jit`, `vmap` or `grad`, because the
      number of points depends on values.
    - `ValueError` for an orbit that did not converge, for an `along` that names nothing or a held quantity, and where
      it changes the period of a drive that only guards, or other phases than the first, contain.

    Source: Seydel, *Practical Bifurcation and Stability Analysis*, ch. 7; Doedel, Keller & Kernévez, Int. J.
    Bifurcation Chaos 1 (1991) 745.
    """
    _check(orbit)
    system, s = orbit.system, State(orbit.t, orbit.q, orbit.v, orbit.params)
    if not system.in_phases and system.elements is None:
        # Integers in the parameters become floats, so that a branch may follow them too.
        system, s = checked(system, s)
    problem = any_problem_of(system, s)
    place, asked = _along(along, orbit, problem)
    frame, z = _frame(orbit, problem, place, asked, tolerance_of(rtol, s.t.dtype), to)
    first, last = float(z[-1] * frame.unit), float(to)
    run = _followed(frame, z, *sorted((float(z[-1]), last / float(frame.unit))), np.sign(last - first), most_points)
    return _result(orbit, problem, run, first, last)


def _check(orbit):
    fix = "orbit = lj.periodic_orbit(system, (q, v), period, params); lj.continue_orbits(orbit, along=..., to=...)"
    must_be(PeriodicOrbit, orbit, "orbit of lj.continue_orbits must be a periodic orbit", fix)
    fix = "call it outside jit, vmap and grad; lj.periodic_orbit works inside"
    must_have_values(orbit, "lj.continue_orbits needs values to choose its steps", fix, eager=True)
    must_be_single(np.shape(orbit.period), "this orbit, at which a branch begins,", "orbit = {orbit}")
    if not bool(orbit.converged):
        raise ValueError(
            f"this orbit does not close: its end is {float(orbit.residual):.2g} of its size away from its start.\n"
            "Usual cause: lj.periodic_orbit did not converge, and warned about it.\n"
            "Fix: another start or period, until orbit.converged."
        )


def _along(along, orbit: PeriodicOrbit, problem: OrbitProblem) -> tuple[Along, OrbitRequest]:
    """What changes along the branch, and what the orbits still hold."""
    asked, reasons, names = orbit.asked, problem.reasons, coordinates.names(orbit.q)
    numbers = numbers_in(problem.state.params)
    if along in numbers:
        return Along(along, NUMBER, numbers[along]), asked
    entries = [*names, *(f"v{name[1:]}" if name == "q" or name.startswith("q[") else f"v.{name}" for name in names)]
    if along not in (ENERGY, PERIOD, *entries):
        more = '"period", "energy", or a coordinate or velocity of the start, such as "' + names[0] + '"'
        raise no_such_number(along, problem.state.params, more)
    if not reasons.autonomous:
        raise ValueError(
            f"along={along!r}: the system depends on time, so its orbits are isolated, with the period of the drive.\n"
            f"Fix: a number in the parameters, along={next(iter(numbers), 'omega')!r}."
        )
    if along != PERIOD and not reasons.energy:
        raise ValueError(
            f"along={along!r}: the Jacobi integral is not conserved here, so the orbits at given parameters are "
            "isolated.\nUsual cause: a force or dissipation.\n"
            f"Fix: a number in the parameters, along={next(iter(numbers), 'omega')!r}."
        )
    free = asked._replace(free=True, energy=False, held=())
    if along == ENERGY:
        return Along(along, ENERGY), free._replace(energy=True)
    if along == PERIOD:
        if not reasons.energy:
            raise ValueError(
                "along='period': the system itself determines the period of its cycles.\n"
                f"Fix: a number in the parameters, along={next(iter(numbers), 'mu')!r}."
            )
        return Along(along, PERIOD), free._replace(free=False)
    entry = entries.index(along)
    return Along(along, ENTRY, None, entry), free._replace(held=(entry,))


@compiled
def _guess(flow, t, z, period, asked):
    return guessed(flow, t, z, period, asked, 1, None).scale


def _frame(orbit, problem, place: Along, asked, rtol, to) -> tuple[OrbitFrame, np.ndarray]:
    """The units, the held quantities, and the point at which the branch begins."""
    s, system = problem.state, problem.system
    params = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, s.params)
    flow = any_flow(system, coordinates.state(s.t, s.q, s.v, params), rtol, problem.rows)
    nodes, period = np.asarray(orbit.nodes, s.t.dtype), np.asarray(orbit.period, s.t.dtype)
    flat = coordinates.vector
    nodes = np.concatenate([np.concatenate([flat(s.q), flat(s.v)])[None], nodes[1:]])
    scale = _guess(flow, s.t, nodes[0], period, asked._replace(free=False))
    integral, slope, sizes, drive = sizes_at(flow.start, s.t, nodes[0], period, scale)
    first = {ENERGY: integral, PERIOD: period, ENTRY: nodes[0][place.entry]}.get(place.kind)
    first = place.number.get(s.params) if place.number is not None else first
    first = float(first)
    unit = np.asarray(abs(range_from(first, to, place.name, "that of the orbit") - first), s.t.dtype)
    y = np.append((nodes / np.asarray(scale)).reshape(-1), 0.0)
    no_rows, goal = jnp.zeros((0, y.size), s.t.dtype), Goal(integral, nodes[0])
    frame = OrbitFrame(
        flow, jnp.asarray(s.t), scale, period, unit, jnp.asarray(flat(orbit.turns), s.t.dtype), goal, slope, sizes,
        None, no_rows, y, place, asked, problem.reasons, len(nodes),
    )  # fmt: skip
    z = np.append(y, first / unit)
    if not problem.reasons.autonomous and place.kind == NUMBER:
        with_drive = replace(frame, drive=drive)
        moved = float(drive_by_parameter(with_drive, z))
        frame = with_drive if abs(moved) > CONSTANT else frame
    return frame, z


def _followed(frame, z, low, high, towards, most) -> BranchFollower:
    """Follow the branch from its start."""
    size = frame.scale.size
    guide = Guide(z[:size], np.zeros(size, z.dtype))
    problem = CycleProblem(frame, low, high, guide, True)
    problem.guide = problem.evaluated(z).guide
    if frame.drive is None and frame.along.kind == NUMBER and not problem.repeats(z)[1]:
        raise ValueError(
            f"along={frame.along.name!r}: the period of the drive changes with it, and is seen only in guards, resets "
            "or other phases than the first.\nUsual cause: a moving wall, whose frequency is the parameter.\n"
            "Fix: time in units of the period, with a drive such as cos(t) and the frequency in L; or "
            "lj.periodic_orbit for each value."
        )
    free = _free_directions(problem, z)
    if len(free):
        # Directions that are free at the start lead to other orbits at the same parameter; holding them selects one.
        frame = replace(frame, free=jnp.asarray(free, frame.t.dtype))
        problem = CycleProblem(frame, low, high, problem.guide, _free_are_trivial(frame, len(free)))
    begin = problem.begin(z, towards)
    if isinstance(begin, str):
        raise ValueError(f"a branch cannot begin at this orbit: {begin}.\nFix: find it again with a smaller rtol.")
    run = BranchFollower(problem, most)
    run.follow(begin)
    return run


def _free_directions(problem, z):
    """Directions from the start to neighbouring orbits at the same parameter, (d, N)."""
    _, jacobian, _ = problem.residual(z)
    _, sizes, right = np.linalg.svd(jacobian)
    rank = int(np.sum(sizes > max(DEPENDENT, 1e2 * problem.noise) * sizes[0]))
    kernel = right[rank:]
    if len(kernel) < 2:
        return np.zeros((0, z.size - 1))
    # One direction of the kernel changes the parameter, the others do not.
    lead = kernel[:, -1] / max(np.linalg.norm(kernel[:, -1]), 1e-300)
    across = np.linalg.svd(lead[None])[2][1:] @ kernel
    return across[:, :-1]


def _free_are_trivial(frame, count):
    """Whether all free directions belong to multipliers that are known to be trivial."""
    shifts = sum(frame.reasons.ignorable)
    known = frame.reasons.energy + shifts * (1 + frame.reasons.momenta)
    return count <= known


def _result(orbit, problem: OrbitProblem, run: BranchFollower, first: float, last: float) -> OrbitBranch:
    """The result in the user's structure."""
    (path,), cast, n = run.paths, run.problem.cast, len(coordinates.names(orbit.q))
    outputs = [p.outputs for p in path.points]

    def trees(rows: list[np.ndarray]):
        return coordinates.like(orbit.q, cast(rows)[0])

    critical = []
    for i, point in enumerate(path.points):
        if point.critical is not None:
            found, at = run.found[point.critical], point.outputs
            accuracy = np.asarray(found.accuracy * run.problem.unit)
            critical.append(
                CriticalOrbit(found.kind, np.asarray(at.parameter), accuracy, i, at.multipliers, found.located)
            )
    return OrbitBranch(
        *cast([s.parameter for s in outputs], [s.period for s in outputs]),
        trees([s.nodes[0][:n] for s in outputs]), trees([s.nodes[0][n:] for s in outputs]),
        trees([s.low for s in outputs]), trees([s.high for s in outputs]), stable_along(path.points),
        np.stack([s.multipliers for s in outputs]), cast([s.nodes for s in outputs])[0], critical,
        _with_floats(orbit, problem), run.problem.along, run.problem.along.name, first, last, path.status,
    )  # fmt: skip


def _with_floats(orbit, problem) -> PeriodicOrbit:
    """The orbit with its parameters as floats, as the branch has them."""
    arrays, static = hashable_partition((user_system(problem), coordinates.state(*problem.state).params))
    return replace(orbit, arrays=arrays, static=static)
