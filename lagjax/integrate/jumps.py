"""The jumps of a system, found in the programs of L, the force, the dissipation and the rates of states; and sliding.

In a given *mode* (the outcome of each comparison, see `open_jumps.py`) all of them are smooth. `found` traces them
once, on shapes, and gives the smooth system, the guard of each mode, and what is known of jumps that depend on t alone:
a pulse, a relay, a square wave.

The times of these become ends of steps (`with_jumps_in_time`). Where the program compares t itself with a number
(`t < off`), that number is the time. All other comparisons of functions of t are evaluated on a fine grid, and each
change is bisected; Newton's formula then gives the last digits, and the derivatives.

Where the forces on both sides of a jump push the motion back onto it, it slides along the jump. Dry friction
`-mu N sign(v)` holds a block as long as both of its values push v back to zero. By Filippov's rule the force is then
the mixture of its values on both sides, Q = Q₋ + α (Q₊ - Q₋) with 0 < α < 1, that keeps the motion on the
jump: with the difference g that is compared, dg/dt = 0. Accelerations are linear in α, so for several jumps

    dg_i/dt (a₀) + Σ_j α_j ∂g_i/∂v · D_j = 0

with the acceleration a₀ of one side and the change D_j that the other side of jump j makes. Where an α leaves [0, 1]
the motion leaves that jump, to the side where it does.

Source: Filippov, *Differential Equations with Discontinuous Righthand Sides*, §4; Utkin, *Sliding Modes in Control and
Optimization*, ch. 2.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import COMPARISONS, JumpOpening, JumpTable, KnownValue, Slot, Timed, has_jumps, outputs_of, run
from lagjax.mechanics import applied_force, completed, mass_and_forcing, with_first_order
from lagjax.numerics import dense
from lagjax.system import (
    OF_STATE,
    WITH_MULTIPLIERS,
    Given,
    Model,
    State,
    System,
    constraints,
    coordinates,
    model_of,
    rate_of,
    takes_of,
)

# More modes than this are not followed: each adds to the program that watches the motion.
MOST = 24
NAMES = {"lagrangian": "Lagrangian", "force": "force", "dissipation": "dissipation"}


class Smooth(eqx.Module):
    """One of the user's functions as a function of the state and of `Given`; or a number from its program."""

    function: Callable
    program: Any = eqx.field(static=True)
    shape: Any = eqx.field(static=True)
    takes: tuple[str, ...] = eqx.field(static=True)
    # The shapes of multipliers by name, for a number that does not depend on them but whose program takes them.
    multipliers: tuple = eqx.field(static=True, default=())

    def __call__(self, *arguments):
        *state, given = arguments
        if self.multipliers:
            state = [*state, {name: jnp.zeros(shape, state[0].dtype) for name, shape in self.multipliers}]
        leaves = leaves_of(self.function, (*state, given.params))
        return jtu.tree_unflatten(self.shape, run(self.program, [*leaves, given.modes, given.free]))


class OfParams(eqx.Module):
    """A user's function that no jump was found in, or looked for, as a function of `Given`."""

    function: Callable

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, *arguments):
        *state, given = arguments
        return self.function(*state, given.params)


@dataclass(frozen=True, eq=False)
class OpenedFunction:
    """The opened program of one function: its results, then the guards, the modes beyond and the differences.

    `places`: for each mode of the system whose guard this program gives, its number.
    """

    program: Any
    shape: Any
    takes: tuple[str, ...]
    places: tuple[int, ...]
    multipliers: tuple
    # For each jump in t alone, the first of its results in the program, and what is known of it.
    of_time: tuple[tuple[int, Timed], ...]

    def zeros(self, dtype: np.dtype):
        """Zero multipliers by name."""
        return {name: jnp.zeros(shape, dtype) for name, shape in self.multipliers}

    def no_modes(self, dtype: np.dtype):
        """Modes that do not count, since the comparisons are free."""
        return jnp.zeros(self.program.in_avals[-2].shape, dtype), jnp.asarray(True)


@dataclass(frozen=True, eq=False)
class Jumps:
    """What was found in a system: the slots of its modes, in order, and the traced functions by role.

    `missed`: what is not followed, in words.
    """

    slots: tuple[Slot, ...]
    traced: dict[str, OpenedFunction]
    missed: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number of modes."""
        return sum(int(np.prod(slot.shape)) for slot in self.slots)

    @property
    def in_time(self) -> bool:
        """Whether there are jumps that depend on t alone."""
        return any(traced.of_time for traced in self.traced.values())

    def in_words(self) -> list[str]:
        """What was found, in words, and in which function."""
        of_state = [
            f"{'a comparison' if slot.kind in COMPARISONS else slot.kind} of "
            f"{', '.join(x for x in 'tqv' if x in slot.depends)} "
            f"in the {' and the '.join(NAMES.get(role, role) for role in self.traced if role in slot.roles)}"
            for slot in self.slots
        ]
        of_time = [f"t in the {NAMES.get(role, role)}" for role, traced in self.traced.items() for _ in traced.of_time]
        counts = Counter(of_state + of_time)
        return [text if n == 1 else f"{text} ({n} times)" for text, n in counts.items()]

    def each(self) -> list[Slot]:
        """The slot of each mode."""
        return [slot for slot in self.slots for _ in range(int(np.prod(slot.shape)))]

    def smooth(self, system: System) -> System:
        """The system as a function of `Given` in place of its parameters."""
        return system.map(self._smooth)

    def _smooth(self, function: Callable, role: str):
        if role not in self.traced:
            return OfParams(function)
        traced = self.traced[role]
        program = outputs_of(traced.program, range(traced.shape.num_leaves))
        return Smooth(function, program, traced.shape, traced.takes)

    def numbers(self, system: System, which: int) -> list[Callable]:
        """For each mode a function of (t, q, v, given): its guard (0), the mode beyond (1), the difference (2)."""
        found: list[Any] = [None] * self.count
        for role, traced in self.traced.items():
            for k, place in enumerate(traced.places):
                output = traced.shape.num_leaves + 4 * k + which
                program = outputs_of(traced.program, [output])
                function, one = _functions(system)[role], jtu.tree_structure(0)
                found[place] = Smooth(function, program, one, OF_STATE, traced.multipliers)
        return found

    def modes(self, system: System, *state) -> Float[Array, " n"]:
        """The modes at a state, as the user's comparisons say."""
        *_, params = state
        dtype = jnp.result_type(state[0])
        free = Given(params, jnp.zeros(self.count, dtype), jnp.zeros(self.count, bool), jnp.asarray(True))
        return jnp.stack([f(*state[:-1], free).astype(dtype) for f in self.numbers(system, 3)])


def found(model: Model, state: State) -> Jumps | None:
    """The jumps and kinks of a system; None if there are none. Only shapes of the state count."""
    functions = _functions(model.system)
    given = state._asdict() | {"multipliers": model.zero_multipliers() if model.reacts else {}}
    programs = {role: _traced(function, given) for role, function in functions.items() if function is not None}
    programs = {role: traced for role, traced in programs.items() if has_jumps(traced.program.jaxpr)}
    if not programs:
        return None
    table = JumpTable()
    for role, traced in programs.items():
        _opened(traced, role, table, lambda key, actual: actual)
    missed = list(table.missed)
    sizes = {key: int(np.prod(slot.shape)) for key, slot in table.slots.items()}
    if sum(sizes.values()) > MOST:
        missed.append(f"{sum(sizes.values())} comparisons, of which at most {MOST} are followed")
        sizes = {}
    slots = {key: table.slots[key] for key in sizes}
    starts = dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist()))
    count, defined, opened = sum(sizes.values()), set(), {}
    for role, traced in programs.items():
        opened[role] = _with_modes(traced, role, table, starts, count, defined)
    known = Jumps(tuple(slots.values()), opened, tuple(missed))
    return known if known.count or known.in_time or known.missed else None


def _functions(system: System) -> dict[str, Callable | None]:
    """What may jump, by role."""
    return {role: getattr(system, role) for role in NAMES} | {rate_of(z): f for z, f in system.states.items()}


class _Program(NamedTuple):
    program: Any
    inputs: list[tuple[tuple, frozenset]]
    shape: Any
    takes: tuple[str, ...]
    multipliers: tuple


def _traced(function: Callable, given: dict[str, Any]) -> _Program:
    """The program of a function of what is `given`, with the numbers of its inputs, and on what each depends."""
    takes = takes_of(function)
    arguments = tuple(given[name] for name in takes)
    shapes = []

    def of_leaves(*leaves):
        filled = iter(leaves)
        arrays, static = eqx.partition((function, arguments), eqx.is_array)
        arrays = jtu.tree_map(lambda _: next(filled), arrays)
        function_, arguments_ = eqx.combine(arrays, static)
        result, shape = jtu.tree_flatten(function_(*arguments_))
        shapes.append(shape)
        return result

    leaves = leaves_of(function, arguments)
    program = jax.make_jaxpr(of_leaves)(*leaves)
    inputs = [(("function", id(function), i), frozenset()) for i in range(len(leaves_of(function, ())))]
    for name, argument in zip(takes, arguments):
        depends = frozenset() if name == "params" else frozenset({name})
        inputs += [((name, i) if name != "t" else ("t",), depends) for i in range(len(leaves_of(None, argument)))]
    zeros = given["multipliers"] if "multipliers" in takes else {}
    multipliers = tuple((name, x.shape) for name, x in zeros.items())
    return _Program(program, inputs, shapes[0], takes, multipliers)


def _opened(traced: _Program, role: str, table, mode: Callable):
    """Walk over a program on shapes: the walk."""
    walks = []

    def walk(*leaves):
        walks.append(JumpOpening(table, role, mode))
        known = [KnownValue(x, table.number(*key), depends) for x, (key, depends) in zip(leaves, traced.inputs)]
        return [x.value for x in walks[-1].run(traced.program, known)]

    jax.eval_shape(walk, *traced.program.in_avals)
    return walks[-1]


def _with_modes(traced: _Program, role: str, table, starts: dict[str, int], count: int, defined) -> OpenedFunction:
    dtype = next(x.dtype for x in traced.program.in_avals if jnp.issubdtype(x.dtype, jnp.floating))
    places, of_time = [], []

    def walk(*leaves):
        *leaves, modes, free = leaves

        def mode(key, actual):
            if key not in starts:
                return actual
            known = modes[starts[key] : starts[key] + actual.size].reshape(actual.shape)
            return jnp.where(free, actual, known)

        opening = JumpOpening(table, role, mode)
        known = [KnownValue(x, table.number(*key), depends) for x, (key, depends) in zip(leaves, traced.inputs)]
        results = [x.value for x in opening.run(traced.program, known)]
        for key, inside in opening.inside.items():
            if key not in starts or key in defined:
                continue
            defined.add(key)
            for i in range(inside.guard.size):
                places.append(starts[key] + i)
                results += [jnp.ravel(x)[i] for x in (inside.guard, inside.beyond, inside.raw, inside.actual)]
        for timed in opening.timed.values():
            of_time.append((len(results), timed._replace(actual=None, x=None, at=timed.at is not None, table=None)))
            given = (timed.actual, timed.x) if timed.at is None else (timed.at,)
            results += [jnp.ravel(x) for x in given]
            results += [] if timed.table is None else [timed.table]
        return results

    modes = jax.ShapeDtypeStruct((count,), dtype), jax.ShapeDtypeStruct((), bool)
    program = jax.make_jaxpr(walk)(*traced.program.in_avals, *modes)
    return OpenedFunction(program, traced.shape, traced.takes, tuple(places), traced.multipliers, tuple(of_time))


def leaves_of(function: Callable, arguments):
    """The arrays in a function and its arguments."""
    return jtu.tree_leaves(eqx.filter((function, arguments), eqx.is_array))


# Functions of t are evaluated at so many times of a motion; and the most of their jumps that are followed.
SAMPLES, ROOM = 4096, 256
BISECTIONS, NEWTON = 60, 2
# A step of Newton's formula beyond this part of the motion says that the number jumps, and has no zero there.
SMALL = 1e-9


class Results(NamedTuple):
    """The comparisons of functions of t at a time: their modes, the numbers that are compared, and the value of these
    at which the mode changes."""

    modes: Array
    x: Array
    changes_at: Array


def with_jumps_in_time(jumps: Jumps, jump_ts, system: System, q: PyTree, v: PyTree, params: PyTree, ts: Array):
    """The times of the jumps that the user named, and of those that were found, in no order; and whether there are too
    many of the latter, which are then left out."""
    found, sought, too_many = [] if jump_ts is None else [jump_ts], [], jnp.asarray(False)
    for role, traced in jumps.traced.items():
        arguments = {"q": q, "v": v, "params": params, "multipliers": traced.zeros(ts.dtype)}
        of_role = traced, _functions(system)[role], arguments
        found += [jnp.ravel(x) for x in _at(ts[0], [place for place, timed in traced.of_time if timed.at], *of_role)]
        sought += [of_role] if any(not timed.at for _, timed in traced.of_time) else []
    if sought:
        times, too_many = _sought(sought, ts)
        found.append(times)
    return jnp.concatenate([x.astype(ts.dtype) for x in found]), too_many


def _at(t: Array, outputs, traced: OpenedFunction, function: Callable, arguments):
    """Some results of the program at a time; jumps in t alone do not depend on the rest of the state."""
    if not outputs:
        return []
    state = tuple((arguments | {"t": t})[name] for name in traced.takes)
    modes, free = traced.no_modes(t.dtype)
    return run(outputs_of(traced.program, outputs), [*leaves_of(function, state), modes, free])


def _results(roles: Sequence, t: Array, before=None, after=None) -> Results:
    """All comparisons of all roles at a time, and where those whose modes are `before` and `after` it change."""
    modes, x, at, start = [], [], [], 0
    for traced, function, arguments in roles:
        listed = [(place, timed) for place, timed in traced.of_time if not timed.at]
        places = [place + i for place, timed in listed for i in range(3 if timed.rule == "place" else 2)]
        values = iter(_at(t, places, traced, function, arguments))
        for _, timed in listed:
            mode, number = (jnp.ravel(next(values)) for _ in range(2))
            table = next(values) if timed.rule == "place" else None
            here = slice(start, start + mode.size)
            modes, x, start = [*modes, mode], [*x, number], start + mode.size
            if before is None or after is None:
                at.append(mode)
            else:
                at.append(_between(timed.rule, before[here], after[here], table))
    return Results(*(jnp.concatenate(y).astype(t.dtype) for y in (modes, x, at)))


def _between(rule: str, before, after, table):
    """The number at which a mode changes."""
    if rule == "above":
        return jnp.zeros_like(before)
    if rule == "place":
        return table[jnp.maximum(before, after).astype(int) - 1]
    if rule == "floor":
        return jnp.maximum(before, after)
    if rule == "ceil":
        return jnp.minimum(before, after)
    if rule == "round":
        return 0.5 * (before + after)
    return jnp.where(jnp.abs(after) > jnp.abs(before), after, before)


def _sought(roles: Sequence, ts: Array):
    fixed = jax.tree.map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, (roles, ts))
    roles_fixed, (first, last) = fixed[0], (fixed[1][0], fixed[1][-1])

    def modes_at(t: Array):
        return _results(roles_fixed, t).modes

    grid = first + (last - first) * jnp.linspace(0.0, 1.0, SAMPLES + 1, dtype=ts.dtype)
    modes = jax.vmap(modes_at)(grid)
    changes = modes[1:] != modes[:-1]
    count = changes.shape[1]
    number = jnp.where(changes, jnp.arange(changes.size).reshape(changes.shape), changes.size)
    # The first ones, in order of time.
    number = jnp.sort(jnp.ravel(number))[:ROOM]
    too_many = jnp.sum(changes) > ROOM
    there, number = (number < changes.size) & ~too_many, jnp.minimum(number, changes.size - 1)
    low, high = grid[number // count], grid[number // count + 1]

    def mine(modes):
        return jnp.take_along_axis(modes, (number % count)[:, None], axis=1)[:, 0]

    each = jax.vmap(modes_at)
    before = mine(each(low))

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        same = mine(each(middle)) == before
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = lax.fori_loop(0, BISECTIONS, halve, (low, high))
    before, after = each(low), each(high)

    def difference(t: Array, component, before, after):
        found = _results(roles, t, before, after)
        return (found.x - found.changes_at)[component]

    def along(t: Array, *rest):
        return jax.jvp(lambda t: difference(t, *rest), (t,), (jnp.ones_like(t),))

    t = high
    for _ in range(NEWTON):
        g, rate = jax.vmap(along)(t, number % count, before, after)
        step = -g / jnp.where(rate != 0, rate, 1.0)
        near = (jnp.abs(step) <= SMALL * (last - first)) & (rate != 0)
        t = t + jnp.where(near, step, 0.0)
    return jnp.where(there, t, ts[-1]), too_many


# A force is evaluated once more for each jump along which a motion could slide.
MOST_SLIDING = 8


def slidable(jumps: Jumps, system: System) -> tuple[int, ...]:
    """The numbers of the modes along whose jumps a motion could slide: comparisons of velocities, in forces."""
    if system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS:
        return ()
    of_forces, rates = frozenset({"force", "dissipation"}), frozenset(map(rate_of, system.states))
    found = tuple(
        i
        for i, slot in enumerate(jumps.each())
        if "v" in slot.depends
        and not slot.levels
        # The rate of a state may have a kink there; for one that jumps, no side is right while the motion slides.
        and slot.roles - rates <= of_forces
        and not slot.jumps & rates
        # A kink of Rayleigh's function is a jump of its force.
        and (slot.jumps or "dissipation" in slot.roles)
    )
    return found if len(found) <= MOST_SLIDING else ()


class Mixture(NamedTuple):
    """How a motion slides: α of each jump (zero where it does not slide), and the rate of each difference."""

    shares: list[Float[Array, ""]]
    rates: list[Float[Array, ""]]


class Sliding(eqx.Module):
    """The mixture of forces; `system`: the smooth system, whose modes are those of one side; `which` of its modes may
    slide, with the `differences` that these compare."""

    system: System
    differences: tuple[Smooth, ...]
    which: tuple[int, ...] = eqx.field(static=True)

    def mixture(self, t: Array, q: PyTree, v: PyTree, given: Given) -> Mixture:
        """Solve for the shares."""
        model = with_first_order(model_of(self.system, t, q, v, given))
        x, u = model.vectors(q, v)
        a, solve = self._accelerations(model, t, x, u)
        changes = [solve(self._change(i, t, q, v, given)) for i in self.which]

        def difference(t: Array, x, u):
            return jnp.stack([f(t, model.tree(x), model.tree(u), given) for f in self.differences])

        _, rates = jax.jvp(difference, (t, x, u), (jnp.ones_like(t), u, a))
        pushes, count = (
            [jax.jvp(lambda u: difference(t, x, u), (u,), (change,))[1] for change in changes],
            len(self.which),
        )
        active = [given.slides[i] for i in self.which]
        rows = [[jnp.where(active[i], pushes[j][i], float(i == j)) for j in range(count)] for i in range(count)]
        rows = [[jnp.where(active[j] | (i == j), x, 0.0) for j, x in enumerate(row)] for i, row in enumerate(rows)]
        shares, _ = dense.solve_without_exchanges(rows, [jnp.where(active[i], -rates[i], 0.0) for i in range(count)])
        shares = [jnp.where(on, share, 0.0) for on, share in zip(active, shares)]
        total = [rates[i] + sum(share * pushes[j][i] for j, share in enumerate(shares)) for i in range(count)]
        return Mixture(shares, total)

    def _accelerations(self, model: Model, t: Array, x, u):
        """The accelerations without sliding, and the function that gives those of one more force."""
        linear = mass_and_forcing(model, t, x, u)
        if model.n == 1 and not model.m:
            return linear.forcing / linear.mass[0], lambda force: force / linear.mass[0]
        rows = constraints.acceleration_rows(model, t, x, u)
        solver = dense.Saddle(linear.mass, rows.jacobian)
        still = jnp.zeros_like(rows.gamma)
        a = completed(model, t, x, u, solver.solve(linear.forcing, rows.gamma)[0])
        return a, lambda force: solver.solve(force, still)[0]

    def _change(self, i, t: Array, q: PyTree, v: PyTree, given):
        """How the generalized force changes on the other side of jump i, as a vector."""
        beyond = given._replace(modes=given.modes.at[i].set(1 - given.modes[i]))
        return self._force(t, q, v, beyond) - self._force(t, q, v, given)

    def _force(self, t: Array, q: PyTree, v: PyTree, given):
        model = model_of(self.system, t, q, v, given)
        return applied_force(model, t, *model.vectors(q, v))

    def extra(self, t: Array, q: PyTree, v: PyTree, given):
        """The force that is added to that of the system, as a vector."""
        shares = self.mixture(t, q, v, given).shares
        found = [share * self._change(i, t, q, v, given) for i, share in zip(self.which, shares)]
        # A side whose force is infinite does not count where the motion does not slide.
        return sum(jnp.where(given.slides[i], x, 0.0) for i, x in zip(self.which, found))


class Mixed(eqx.Module):
    """The force of a system with its mixtures: (t, q, v, given) -> like q."""

    force: Callable | None
    sliding: Sliding
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t: Array, q: PyTree, v: PyTree, given):
        extra = coordinates.like(q, self.sliding.extra(t, q, v, given))
        if self.force is None:
            return extra
        return jax.tree.map(jnp.add, self.force(t, q, v, given), extra)
