"""`explain`: what a system amounts to at one state, in words and numbers; a motion in phases as a graph of them."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from typing import NamedTuple, overload

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.display import labelled
from lagjax.display import plots as plot
from lagjax.integrate import found as jumps_found
from lagjax.integrate import modes_at, nystrom_for, traced_phases
from lagjax.jaxtools import compiled
from lagjax.mechanics import (
    Structure,
    accelerations,
    are_angles,
    consistent_state,
    departures,
    dependencies,
    describe,
    equations_of,
    examined,
    explain_failure,
    has_networks,
    is_free_of_velocities,
    listed,
    residuals_and_slopes,
    structure,
    within,
)
from lagjax.numerics import DEPENDENT_BELOW, independent_rows
from lagjax.system import (
    Hybrid,
    Model,
    State,
    System,
    check_system,
    constraints,
    coordinates,
    model_of,
    traced_system,
    with_rates,
)


@dataclass(frozen=True, repr=False)
class HybridExplanation:
    """The explanation of a hybrid system at one state; it prints itself and draws its graph.

    - `phases`: by name, the `Explanation` of each phase.
    - `switches`: for each switch the phase that it ends, the phases to which it leads, the name of its guard, and the
      value of the guard at the state; None if the state does not belong to that phase.
    - `unreachable`: phases to which no switch leads, except the first. `final`: phases that no switch leaves.

    >>> import lagjax as lj
    >>> ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    >>> bounce = lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, params: q, restitution=0.5))
    >>> found = lj.explain(lj.Hybrid({"flying": ball}, [bounce]), 0.0, 5.0, 0.0)
    >>> print(list(found.phases), found.final)
    ['flying'] ()
    """

    phases: dict
    switches: tuple[tuple[str, tuple[str, ...], str, float | None], ...]
    unreachable: tuple[str, ...]
    final: tuple[str, ...]

    def plot(self):
        """Draw the phases, with an arrow for each switch; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        arrows = [(phase, to, guard) for phase, targets, guard, _ in self.switches for to in targets]
        return plot.graph(list(self.phases), arrows)

    def __repr__(self):
        rows = []
        for name, found in self.phases.items():
            held = ", ".join(map(repr, found.structure.constraints)) if found.structure is not None else ""
            count = found.degrees_of_freedom
            words = [f"{count} degree{'' if count == 1 else 's'} of freedom", *([f"held by {held}"] if held else [])]
            words += ["no switch leads here"] if name in self.unreachable else []
            words += ["no switch leaves it"] if name in self.final else []
            rows.append((name, "; ".join(words)))
            for _, targets, guard, value in (switch for switch in self.switches if switch[0] == name):
                now = "" if value is None else f", now {value:.6g}"
                rows.append(("", f"  -> {' or '.join(targets)}, when {guard} reaches zero{now}"))
            if found.problem:
                rows.append(("", f"  problem: {found.problem.splitlines()[0]}"))
        return labelled("Hybrid", rows)


def explained(hybrid: Hybrid, phases: dict, state: State) -> HybridExplanation:
    """Build the explanation of a hybrid from the explanations of its phases at a state."""
    at = {name: _multipliers(system, phases[name], state) for name, system in zip(hybrid.names, hybrid.systems)}
    switches = []
    for switch in hybrid.switches:
        multipliers = at[switch.phase]
        value = None if multipliers is None else float(switch.value(*state[:3], multipliers, state.params))
        targets = (switch.to,) if switch.rest in (None, switch.to) else (switch.to, switch.rest)
        switches.append((switch.phase, targets, _name(switch.when), value))
    reached = {to for _, targets, _, _ in switches for to in targets} | {hybrid.names[int(hybrid.first)]}
    left = {phase for phase, *_ in switches}
    return HybridExplanation(
        phases, tuple(switches), tuple(name for name in hybrid.names if name not in reached),
        tuple(name for name in hybrid.names if name not in left),
    )  # fmt: skip


def _multipliers(system, explanation, state):
    """The multipliers of a phase; None if the state does not belong to it."""
    if explanation.problem or any(label == "off the constraints" for label, _ in explanation.rows):
        return None
    return accelerations(system, *state)[1] if system.constraints else {}


def _name(guard):
    name = getattr(guard, "__name__", type(guard).__name__.lower())
    return "its guard" if name == "<lambda>" else name


# A state this near to the constraints is taken for a rounded state on them, and moved there.
ROUNDED = 1e-4
# It is on them if it is so many round-offs of the largest coordinate off, as what `lj.consistent_state` returns.
ROUND_OFFS, NEWTON_STEPS = 1e3, 8


@dataclass(frozen=True, repr=False)
class Explanation:
    """What a system amounts to at one state; it prints itself.

    - `coordinates`: their names; `equations`: the name of each constraint equation.
    - `degrees_of_freedom`: velocities left free: coordinates minus independent constraint equations.
    - `position_freedoms`: positions left free; more than the former if some constraints restrict only velocities.
    - `dependent`: each dependent equation, followed by those of which it is a combination.
    - `structure`: what holds at every state, a `Structure`; None for large systems, long programs and forward dynamics.
    - `mass_matrix`: its definiteness in words; `problem`: why the equations fail there, or None.
    - `modes`: of a system with elements, by name the mode that fits the state: "open", "closed", "free", "slides" or
      "sticks". The other fields are those with all gaps open and no friction.
    """

    coordinates: tuple[str, ...]
    equations: tuple[str, ...]
    degrees_of_freedom: int
    position_freedoms: int
    dependent: tuple[tuple[str, ...], ...]
    mass_matrix: str
    structure: Structure | None
    problem: str | None
    rows: tuple[tuple[str, str], ...]
    modes: tuple[tuple[str, str], ...] = ()

    def __repr__(self):
        return labelled("System", self.rows)


@overload
def explain(system: System, t, q: PyTree, v: PyTree, params: PyTree = None) -> Explanation:
    """Explain one system."""


@overload
def explain(system: Hybrid, t, q: PyTree, v: PyTree, params: PyTree = None) -> HybridExplanation:
    """Explain a motion in phases."""


def explain(system, t, q: PyTree, v: PyTree, params: PyTree = None):
    """Say what a system amounts to at a state: freedoms, dependent constraints, mass matrix, problems.

    >>> import lagjax as lj
    >>> rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - 1.0)
    >>> again = lj.Holonomic(lambda t, q, params: 2.0 * (q["x"] ** 2 + q["y"] ** 2) - 2.0)
    >>> free = lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2)
    >>> twice = lj.System(free, constraints={"rod": rod, "again": again})
    >>> explain(twice, 0.0, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 1.0})
    System
      at                  t = 0, q = (x = 1, y = 0), v = (x = 0, y = 1)
      coordinates         2: x, y
      constraints         'again' (position), 'rod' (position)
      equations           2, of which 1 independent
      dependent           'rod' restricts the same motion as 'again'; their multipliers are the shortest
      degrees of freedom  1
      mass matrix         positive definite, diagonal, constant
      cyclic in L         x, y
      solved              2 accelerations and 2 multipliers by elimination without the zeros
      first answer        some 3 s of processor time, to a factor of 2: 337 operations number by number

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as the system takes it. A state off the constraints is first
    moved onto them, as dependent constraints agree only there; the result says so if it was not near.

    **Returns:** an `Explanation`; of a `Hybrid` a `HybridExplanation`: its phases, each explained, and its graph. Of a
    system with elements it says in which modes they are there, and which forces are solved together.

    **Raises:** `TypeError`, `ValueError` for a state of the wrong shape or dtype, or an L that is not scalar.

    Source: García de Jalón & Bayo, *Kinematic and Dynamic Simulation of Multibody Systems*, §3.2 (rank and freedoms).
    """
    check_system(system, t, q, v, params, phases=True, elements=True)
    s = coordinates.state(t, q, with_rates(system, q, v), params)
    if system.in_phases:
        return explained(system, {name: _of_phase(phase, s) for name, phase in zip(system.names, system.systems)}, s)
    return _of_phase(system, s)


def _of_phase(system: System, s: coordinates.State) -> Explanation:
    return _explain(system, s) if system.elements is None else _with_elements(system, s)


def _with_elements(system: System, s: coordinates.State) -> Explanation:
    """The explanation of the system without elements, and of their modes."""
    assembly, found = traced_phases(system, s), _explain(replace(system, elements=None), s)
    (laws,), met = assembly.laws, modes_at(assembly, s)
    kinds = dict(zip(laws.names, laws.modes_in_words(np.asarray(met.modes))))
    values, holds, held = _held(assembly, s._replace(v=met.v), met.modes)
    now = [
        f"{name} {mode}" + (f" (gap {value:.6g})" if mode == "open" else "")
        for (name, mode), value in zip_longest(kinds.items(), values)
    ]
    here, open_rank = (int(np.linalg.matrix_rank(rows)) for rows in held)
    free = found.degrees_of_freedom - here + open_rank
    equations = int(np.sum(holds)) + laws.equations - len(laws.rows)
    at_once = "one after the other" if laws.impacts == "sequential" else "all at once"
    gaps, slips = laws.count
    together = f"up to {gaps + slips} forces of contacts that touch, as a complementarity problem"
    counted = ", ".join(f"{kind}: {count}" for kind, count in Counter(laws.kinds).items())
    rows = [
        ("elements", ", ".join(f"'{name}' ({type(x).__name__})" for name, x in assembly.user.elements.items())),
        ("modes", f"{laws.size} ({counted}); here {', '.join(now)}"),
        ("in these modes", f"{free} degree{'' if free == 1 else 's'} of freedom"),
        *([("solved together", together)] if gaps + slips > 1 else []),
        *([("forces", f"not unique: {equations} hold, {here} of them independent")] if equations > here else []),
        *([("impacts", f"of contacts that are struck together: {at_once}")] if gaps > 1 else []),
    ]
    problem = found.problem
    inside = [name for name, value, slack in zip(laws.names[:gaps], values, met.slack) if value < -slack]
    if inside and not problem:
        problem = f"inside a contact: {', '.join(f'the gap {name!r} is below zero' for name in inside)}"
        rows.append(("problem", problem))
    elif not bool(met.found):
        problem = "no forces of these contacts obey their laws (Painlevé's paradox)"
        rows.append(("problem", problem))
    # Of the equations without elements.
    kept = [row for row in found.rows if row[0] not in ("solved", "first answer", "velocities", "network")]
    return replace(found, rows=(*kept, *rows), modes=tuple(kinds.items()), problem=problem)


# One program: its operations one by one take XLA a second.
@partial(compiled, in_numpy=True)
def _held(assembly, s: coordinates.State, modes):
    """The guards in these modes, which of them hold, and the rows of what holds in these and in none."""
    here, open_ones = assembly.given(s.params, modes), assembly.given(s.params)
    model = model_of(assembly.systems[0], *s[:3], here)
    x, u = model.vectors(s.q, s.v)
    rows, (laws,) = [constraints.jacobian(model.of(given), s.t, x, u) for given in (here, open_ones)], assembly.laws
    return laws.last(*s[:3], model.zero_multipliers(), here), laws.holds(modes), rows


def _explain(system: System, s: coordinates.State) -> Explanation:
    system = traced_system(system, s)
    model = model_of(system, *s)
    place = _on_the_constraints(model, s) if model.m else _Place(s)
    s = place.state
    found = examined(model, s)
    names, equations, holonomic = model.names, model.equation_names, model.holonomic
    jacobian = found.rows.jacobian
    independent = int(found.independent.sum())
    groups = tuple(dependencies(jacobian, found.independent, equations)) if independent < len(equations) else ()
    problem = place.unreachable or explain_failure(model, s)
    first = equations_of(model).model.form.first_order
    heavy = [i for i in range(len(names)) if first is None or not first.mask(len(names))[i]]
    mass = _definiteness(np.asarray(found.linear.mass)[np.ix_(heavy, heavy)], [names[i] for i in heavy])

    rows = [("at", f"t = {float(s.t):.6g}, q = {describe(s.q)}, v = {describe(s.v)}")]
    if place.off:
        rows.append(("off the constraints", place.off))
    rows.append(("coordinates", f"{len(names)}: {', '.join(names)}"))
    if turned := _in_turns(model, s):
        rows.append(("angles", f"in radians: {turned}; for degrees use jnp.radians(...)"))
    if equations:
        kinds = {name: "position" if c.of_positions else "velocity" for name, c in system.constraints.items()}
        rows.append(("constraints", ", ".join(f"'{name}' ({kind})" for name, kind in kinds.items())))
        rows.append(("equations", f"{len(equations)}, of which {independent} independent"))
    rows += [("dependent", _in_words(group)) for group in groups]
    if first is not None:
        massless = [f"{names[i]} (no mass)" for i in first.massless]
        rows.append(("of first order", ", ".join([*(f"{name} (state)" for name, _ in first.states), *massless])))
    free = len(heavy) - independent
    rows.append(("degrees of freedom", f"{free}"))
    found_structure = structure(model)
    rows.append(("mass matrix", mass if found_structure is None else f"{mass}, {_of_mass(found_structure)}"))
    if found_structure is not None:
        rows += _of_structure(found_structure)
    rows += [(name, "yes") for name in ("force", "dissipation") if getattr(system, name) is not None]
    if (jumps := jumps_found(model, s)) is not None:
        rows += [("jumps and kinks", "; ".join(words))] if (words := jumps.in_words()) else []
        rows += [("not followed", "; ".join(jumps.missed))] if jumps.missed else []
    solved = equations_of(model, fast=True)
    rows.append(("solved", _how_solved(solved, found_structure)))
    rows.append(("first answer", _first_answer(solved, s)))
    networks = has_networks(model)
    loose = ", by Tsit5 at rtol of 1e-6 and above" if networks else ""
    if is_free_of_velocities(model):
        by = type(nystrom_for(model)).__name__
        rows.append(("velocities", f"accelerations do not depend on them: stepped by {by}{loose}"))
    elif networks:
        rows.append(("network", f"stepped by Dopri8{loose}"))
    if problem:
        rows.append(("problem", problem.replace("\n", "\n    ")))
    return Explanation(
        coordinates=tuple(names),
        equations=tuple(equations),
        degrees_of_freedom=free,
        position_freedoms=len(names) - int(compiled(independent_rows)(np.asarray(jacobian)[holonomic]).sum()),
        dependent=groups,
        mass_matrix=mass,
        structure=found_structure,
        problem=problem,
        rows=tuple(rows),
    )


class _Place(NamedTuple):
    """The state to examine, the constraints that the given one violates, and why no state on them was found."""

    state: coordinates.State
    off: str = ""
    unreachable: str | None = None


def _on_the_constraints(model: Model, s) -> _Place:
    """Find the nearest state on the constraints; off them, dependent constraints contradict each other that much."""
    tolerance = jnp.asarray(ROUNDED, s.t.dtype)
    equations = equations_of(model)
    if within(equations, *s[:3], tolerance, tolerance):
        return _Place(_returned(model, s))
    off = departures(model, s, ROUNDED, ROUNDED)
    try:
        q, v = consistent_state(model.system, *s)
    except ValueError as error:
        return _Place(s, f"by {off}, and no state near it is on them", str(error))
    return _Place(s._replace(q=q, v=v), f"by {off} as given; everything here describes the nearest state on them")


def _returned(model: Model, s: coordinates.State) -> coordinates.State:
    """A state near the constraints, moved onto them by Newton's method, by M and A as they are examined anyway.

    Not by the program for motions: that would take longer to compile than all else here.
    """
    for _ in range(NEWTON_STEPS):
        residuals, slopes = map(np.asarray, residuals_and_slopes(equations_of(model), *s[:3]))
        x, u = map(np.asarray, model.vectors(s.q, s.v))
        off = np.max(np.abs(residuals) / np.where(slopes > 0, slopes, np.inf), axis=1)
        if np.all(off <= ROUND_OFFS * np.finfo(x.dtype).eps * np.max(np.abs([x, u]), axis=1)):
            break
        found = examined(model, s)
        mass, rows = np.asarray(found.linear.mass, float), np.asarray(found.rows.jacobian, float)
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        length = np.where(length > 0, length, 1.0)
        mass, rows = mass / (np.max(np.abs(mass)) or 1.0), rows / length
        matrix = np.block([[mass, rows.T], [rows, np.zeros((len(rows), len(rows)))]])
        wanted = np.concatenate([np.zeros((len(x), 2)), -residuals.T / length])
        # Constraints that depend on each other are equations of it, too.
        step = np.linalg.lstsq(matrix, wanted, rcond=DEPENDENT_BELOW[np.dtype(x.dtype)])[0][: len(x)].T.astype(x.dtype)
        s = s._replace(q=model.tree(x + step[0]), v=model.tree(u + step[1]))
    return s


def _in_turns(model: Model, s):
    """List angles of more than a turn, which may have been meant in degrees."""
    x = np.asarray(model.vector(s.q))
    large = np.abs(x) > 2 * np.pi
    if not large.any():
        return ""
    found = [(name, float(y)) for name, y, show in zip(model.names, x, large & are_angles(model)) if show]
    return ", ".join(f"{name} = {y:.6g} is {y / (2 * np.pi):.3g} turns" for name, y in found)


def _in_words(group):
    dependent, *others = group
    if not others:
        return f"'{dependent}' restricts nothing"
    return f"'{dependent}' restricts the same motion as {listed(others)}; their multipliers are the shortest"


def _of_mass(found):
    shape = "diagonal" if all(len(block) == 1 for block in found.blocks) else "dense"
    if shape == "dense" and len(found.blocks) > 1:
        shape = "in blocks (" + "), (".join(", ".join(block) for block in found.blocks) + ")"
    depends = f"depends on {', '.join(found.mass_depends_on)}" if found.mass_depends_on else "constant"
    return f"{shape}, {depends}"


def _of_structure(found):
    rows = [("time", "explicit")] if found.explicit_time else []
    if found.cyclic:
        rows.append(("cyclic in L", ", ".join(found.cyclic)))
    if found.linear_terms:
        rows.append(("linear in velocity", f"L has such terms in {', '.join(found.linear_terms)} (gyroscopic forces)"))
    for name, constraint in found.constraints.items():
        words = [word for word, holds in (("linear", constraint.linear), ("moving", constraint.moving)) if holds]
        rows += [(f"constraint '{name}'", ", ".join(words))] if words else []
    return rows


def _how_solved(equations, found):
    """Say what the compiled program does at each evaluation."""
    if not equations.are_written or found is None:
        return str(equations.form)
    n = sum(map(len, found.blocks))
    m = equations.form.unknowns - n
    if n == 1 and not m:
        return "one division"
    if m:
        return f"{n} accelerations and {m} multiplier{'s' * (m > 1)} by elimination without the zeros"
    once = " before the loop" if not found.mass_depends_on else ""
    if all(len(block) == 1 for block in found.blocks):
        return f"{n} divisions{once}"
    return f"{n} equations by elimination without the zeros"


# Processor time of a first motion in a new process, in seconds: at least, and per thousand operations. Measured on a
# busy machine by `benchmarks/speed/mechanisms.py`: all of its ten results are within a factor of two.
FIRST_AT_LEAST, FIRST_WRITTEN, FIRST_IN_ARRAYS = 1.5, 4.5, 13.0


def _first_answer(equations, s) -> str:
    """Say what a first motion will roughly cost in a new process, and why."""
    count = equations.operations(s.t, equations.inside(s.q), equations.inside(s.v))
    seconds = FIRST_AT_LEAST + (FIRST_WRITTEN if equations.are_written else FIRST_IN_ARRAYS) * count / 1000
    how = "number by number" if equations.are_written else "in arrays"
    rounded, plural = float(f"{seconds:.1g}"), "s" * (count != 1)
    return f"some {rounded:g} s of processor time, to a factor of 2: {count:,} operation{plural} {how}"


def _definiteness(mass, names):
    scale = np.sqrt(np.abs(np.diag(mass)))
    scale = np.where(scale > 0, scale, 1.0)
    if not mass.size:
        return "zero"
    if not np.all(np.isfinite(mass)):
        return "not finite"
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    zero = np.abs(values) <= 1e3 * np.finfo(mass.dtype).eps * np.max(np.abs(values), initial=0.0)
    negative = int(np.sum(values[~zero] < 0))
    if zero.any():
        massless = sorted({names[int(np.argmax(np.abs(vector)))] for vector in vectors.T[zero]})
        return f"singular in {listed(massless)}"
    return f"indefinite, {negative} of {len(values)} directions negative" if negative else "positive definite"
