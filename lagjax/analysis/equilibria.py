"""Where a system rests, and how it moves steadily: equilibria and relative equilibria.

The equations are those of `balance.py`; `numerics/newton.py` solves them from several starts at once. A solution counts
as an equilibrium if its imbalance is negligible compared with the effect of a displacement as large as the coordinates,

    |r_i| <= ε Σ_j |∂r_i/∂y_j| Y_j

so that neither a minimum of |r| that is not a root nor a far point where forces have merely faded is taken for one.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.analysis import balance as equations
from lagjax.analysis import degenerate
from lagjax.analysis.balance import (
    CONSTRAINED,
    MOMENTUM,
    NO_BALANCE,
    NOT_FINITE,
    NOT_LASTING,
    OK,
    UNFINISHED,
    VELOCITY,
    Equilibria,
    EquilibriumRow,
    Steady,
    SteadySymmetries,
    merged,
    side_by_side,
)
from lagjax.analysis.degenerate import CREEPS_BELOW, nearest, soft_below
from lagjax.jaxtools import compiled, is_eager, is_traced, numpy_of, stop_gradient
from lagjax.mechanics import are_angles, invariance, listed, structure
from lagjax.numerics import MOST, differentiable, lapack, least_squares_root, zero_below
from lagjax.refusals import must, must_be_among, must_be_like, must_name
from lagjax.system import State, by_name, check_system, checked, coordinates, model_of

AS_STARTS = 'starts=[{"theta": 0.1}, {"theta": 3.0}], or starts={"theta": jnp.linspace(-3.0, 3.0, 20)}'


def stacked(starts, what="starts") -> PyTree:
    """Starts as one tree whose leaves have a leading axis, from a list of states, such a tree, or one state."""
    if isinstance(starts, list):
        must(starts, f"{what} must hold a place to start from", starts, AS_STARTS)
        structures = {jtu.tree_structure(start) for start in starts}
        if len(structures) > 1:
            raise ValueError(f"the {what} differ in structure: each must be like q.\nFix: {AS_STARTS}.")
        # Concrete values stay in NumPy, which compiles nothing.
        starts = coordinates.as_floats(starts)
        xp = numpy_of(starts)
        return jtu.tree_map(lambda *x: xp.stack([xp.asarray(y) for y in x]), *starts)
    leaves = jtu.tree_leaves(starts)
    must(leaves, f"{what} must have coordinates", starts, AS_STARTS)
    starts = jtu.tree_map(lambda x: numpy_of(x).asarray(x), coordinates.as_floats(starts))
    leaves = jtu.tree_leaves(starts)
    if all(x.ndim == 0 for x in leaves):
        return jtu.tree_map(lambda x: x[None], starts)
    counts = {x.shape[:1] for x in leaves}
    if len(counts) > 1:
        raise ValueError(
            f"the leaves of {what} have leading axes of different lengths: "
            f"{listed(sorted(str(x.shape) for x in leaves))}.\n"
            "Usual cause: one start whose coordinates are arrays, where several are expected.\n"
            f"Fix: a list of states, {what}=[q]."
        )
    must(() not in counts and min(counts)[0] > 0, f"{what} must hold a start", starts, AS_STARTS)
    return starts


def stacked_one(q: PyTree):
    """A state of rest at q."""
    q = jax.tree.map(lambda x: x[0], stacked([q]))
    return q, _at_rest(q)


def _at_rest(q: PyTree) -> PyTree:
    return jax.tree.map(lambda x: numpy_of(x).zeros_like(x), q)


def symmetries_of(system, s: State, cyclic, hold, moving: np.ndarray | None) -> SteadySymmetries:
    """The symmetries along which the motion is steady: those that `cyclic` names, or the `moving` (n,) coordinates."""
    must_be_among((VELOCITY, MOMENTUM, None), hold, "hold")
    names = coordinates.names(s.q)
    if cyclic is None:
        if moving is None:
            return SteadySymmetries(hold=hold)
        chosen = [name for name, moves in zip(names, moving) if moves]
    else:
        given = [cyclic] if isinstance(cyclic, str) or callable(cyclic) else list(cyclic)
        if all(callable(x) for x in given) and given:
            _check_fields(given, s)
            return SteadySymmetries(fields=tuple(given), hold=hold)
        chosen = _names_in(names, given)
        still = [name for name, moves in zip(names, moving if moving is not None else []) if moves]
        if others := [name for name in still if name not in chosen]:
            raise ValueError(
                f"{listed(others)} moves in the starts but is not among the cyclic coordinates, {listed(chosen)}.\n"
                f"Fix: give it a velocity of zero, or pass cyclic={[*chosen, *others]}."
            )
    _check_cyclic(system, s, chosen)
    return SteadySymmetries(places=tuple(names.index(name) for name in chosen), hold=hold)


def _names_in(names, given: Iterable):
    """The coordinates with the given names; the name of an array means all its entries."""
    chosen = []
    for name in given:
        entries = [x for x in names if x == name or isinstance(name, str) and x.split("[")[0] == name]
        if not entries:
            fix = "'{}', or functions motion(q, params) that return a velocity like v"
            must_name([name], names, "cyclic names", "coordinate", fix)
        chosen += entries
    return list(dict.fromkeys(chosen))


def _check_cyclic(system, s, chosen):
    known = structure(model_of(system, *s)) if chosen else None
    not_cyclic = [name for name in chosen if known is not None and name not in known.cyclic]
    if not_cyclic:
        raise ValueError(
            f"L depends on {listed(not_cyclic)}, which moves at a constant rate: there is no steady motion along it.\n"
            "Usual cause: a start gives a velocity to a coordinate that is not cyclic, or the motion is a rotation of "
            "several coordinates.\n"
            "Fix: velocities of zero; or the symmetry as a function, cyclic=lambda q, params: {...}, which returns the "
            'velocity of a motion at a unit rate, such as {"x": -q["y"], "y": q["x"]}.'
        )


def _check_fields(fields: list[Callable], s: State):
    for field in fields:
        value = jax.eval_shape(lambda q, params, field=field: field(q, params), s.q, s.params)
        fix = "return the structure of q, with 0.0 for coordinates that do not move (0.0 * q[...] for arrays)"
        must_be_like(value, s.q, "the velocity that cyclic=motion(q, params) returns", "q", fix)


# The largest imbalance of an equilibrium, relative to the effect of a displacement as large as the coordinates.
BALANCED = {np.dtype("float64"): 1e-7, np.dtype("float32"): 1e-3}
# A search that moves this many times farther out than its start has failed: forces only fade there.
FAR = 1e9
# A growth rate below this fraction of the fastest root is round-off: double roots are off by the root of round-off.
GROWS_ABOVE = {np.dtype("float64"): 1e-7, np.dtype("float32"): 2e-3}


@by_name("lj.equilibria(system, params, starts=[q])", "starts")
def equilibria(
    system,
    params: PyTree = None,
    *,
    starts: PyTree[ArrayLike],
    velocities: PyTree[ArrayLike] | None = None,
    cyclic: str | Callable | Iterable | None = None,
    hold: str | None = VELOCITY,
    t: ArrayLike = 0.0,
) -> Equilibria:
    """Find where a system rests, or moves steadily, near each of the starts.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    >>> found = lj.equilibria(pendulum, {"g": 9.81}, starts=[0.3, 3.0])
    >>> print(found.q.round(6) + 0.0, found.stable)
    [0.       3.141593] [ True False]

    A bead on a hoop that turns freely, at 2 rad/s; the angle's cosine is g/(a ω²):

    >>> hoop = lj.System(lambda t, q, v, params: (0.5 * v["psi"]**2 + 0.5 * (jnp.sin(q["psi"]) * v["turn"])**2
    ...                                           + params["g"] * jnp.cos(q["psi"])))
    >>> steady = lj.equilibria(hoop, {"g": 2.0}, starts={"psi": 1.0, "turn": 0.0},
    ...                        velocities={"psi": 0.0, "turn": 2.0})
    >>> print(jnp.cos(steady.q["psi"]).round(6))
    [0.5]

    **Arguments:**

    - `params`: as the system takes it.
    - `starts`: a list of positions like q, `[q]` for one; or one tree like q whose leaves have a leading axis, with one
      entry for each start.
    - `velocities`: like v, one for all starts or one for each; zero by default. Coordinates with a nonzero velocity
      move steadily.
    - `cyclic`: what moves steadily: names of cyclic coordinates; or functions `motion(q, params)` -> like v, the
      velocity along a symmetry at unit rate, as `{"x": -q["y"], "y": q["x"]}` for a rotation. By default the
      coordinates with a nonzero velocity; while JAX traces `velocities` they must be named.
    - `hold`: `"velocity"` holds the rate of each cyclic motion at that of the start, `"momentum"` its momentum. `None`
      holds neither, where a constraint, or a force that depends on velocities, determines the rate.
    - `t`: the time of the balance; a balance that does not last is reported.

    **Returns:** `Equilibria`: the equilibria found, with duplicates merged (also angles that differ by whole turns),
    differentiable by `params`; and the outcome of each start. Where a stiffness is zero, the first term that does not
    vanish decides about stability. Under `jit`, `vmap` and `grad` nothing is merged, and such a point is undecided:
    there is one row for each start, and `found` says which of them are equilibria.

    **Raises:** `TypeError`, `ValueError` for starts of the wrong structure, for an L that depends on a coordinate named
    in `cyclic`, and what `lj.accelerations` raises about functions that cannot be called.

    Source: Marsden & Ratiu, *Introduction to Mechanics and Symmetry*, §8.9; Goldstein, Eq. (6.1); Nocedal & Wright,
    *Numerical Optimization*, §10.3.
    """
    check_system(system, params, starts, states=False)
    q = stacked(starts)
    count = jax.tree.leaves(q)[0].shape[0]
    v = _at_rest(q) if velocities is None else _velocities(velocities, q, count)
    first = jax.tree.map(lambda x: x[0], (q, v))
    try:
        system, s = checked(system, State(t, *first, params))
    except (TypeError, ValueError, IndexError):
        if isinstance(starts, list) or velocities is not None or not _is_a_state(system, t, starts, params):
            raise
        return equilibria(system, params, starts=[starts], cyclic=cyclic, hold=hold, t=t)
    moving = None if velocities is None or is_traced(v) else np.any(side_by_side(v) != 0, axis=0)
    if cyclic is None and velocities is not None and moving is None:
        raise ValueError(
            "JAX is tracing the velocities, so it is not known which coordinates move.\n"
            'Fix: name them, lj.equilibria(..., cyclic=["psi"]).'
        )
    symmetries = symmetries_of(system, s, cyclic, hold, moving)
    # A function may close over traced values although no argument is traced.
    model = model_of(system, *s)
    steady = Steady(model, s.t, np.zeros(symmetries.count, s.t.dtype), coordinates.vector(s.q), symmetries)
    q, v = jax.tree.map(lambda x: x.astype(s.t.dtype), (q, v))
    known = invariance(model)
    lasting, unseen = not symmetries.count and known.timeless, np.array(known.unseen)
    concrete = is_eager() and not is_traced((steady, q, v))
    expected = int(np.sum(np.delete(unseen, list(symmetries.places))))
    rows = searched(steady, q, v, lasting, expected, concrete)

    def as_table(rows: EquilibriumRow) -> Equilibria:
        return Equilibria(t=s.t, params=s.params, symmetries=symmetries, starts=q, **rows._asdict())

    if not concrete:
        return as_table(rows)
    unseen[list(symmetries.places)] = False

    def search(q: PyTree, v: PyTree) -> EquilibriumRow:
        return searched(steady, q, v, lasting, expected, True)

    rows, radii = _decided(steady, rows, q, lasting, unseen, search)
    return merged(as_table(rows), are_angles(model), radii)


def _decided(
    steady: Steady, rows: EquilibriumRow, starts, lasting, unseen, search
) -> tuple[EquilibriumRow, np.ndarray]:
    """The rows, those with an almost vanishing stiffness judged by the terms that decide there; and their radii.

    A root that several starts reached is moved to where it is exactly, to within its radius (S,) otherwise.
    """
    radii = np.zeros(len(rows.found))
    soft = rows.soft > int(np.sum(unseen))

    def pick(tree: PyTree, i: int):
        return jax.tree.map(lambda x: x[i], tree)

    def size_of(q: PyTree, i: int) -> float:
        return float(np.max(np.abs(_flat((q, pick(starts, i))))))

    def is_far(i: int) -> bool:
        return np.max(np.abs(_flat(pick(rows.last, i)))) > 3 * np.max(np.abs(_flat(pick(starts, i))))

    if np.any(lost := soft & (rows.status == NO_BALANCE)) and lasting and not steady.symmetries.count:
        # A search that went far away fades there.
        lost = [i for i in np.flatnonzero(lost) if not is_far(i)]
        rows = _from_valleys(steady, rows, np.array(lost, int), unseen, search, size_of)
    made = {}
    for i in np.flatnonzero(rows.found & (rows.soft > int(np.sum(unseen)))):
        row = pick(rows, i)
        y, size = degenerate.unknowns(row), size_of(row.q, i)
        at = degenerate.held_by_momentum(steady, y[: steady.n], row.rates)
        made[i] = degenerate.decide(at, y, size, row.eigenvalues, unseen)
    # Equilibria moved to where a multiple root is exactly are evaluated there.
    moved = {i: d.y for i, d in made.items() if d.y is not None}
    if moved:
        q = jax.tree.map(lambda start, x: np.where(np.isfinite(x), x, start), starts, rows.q)
        v = jax.tree.map(lambda x: np.nan_to_num(x), rows.v)
        for i, y in moved.items():
            _put(q, i, coordinates.like(pick(q, i), y[: steady.n].astype(steady.t.dtype)))
        again = search(q, v)
        for i in list(moved):
            if not again.found[i]:
                del moved[i]
        places = np.array(list(moved), int)
        rows = jax.tree.map(lambda old, new: _with(old, places, new), rows, again)
    for i, decision in made.items():
        if decision.verdict == degenerate.AS_LINEAR:
            # One of a family of equilibria: nothing leads away along it.
            stable, undecided = rows.stable[i] | rows.undecided[i], False
            rows = rows._replace(stable=_with(rows.stable, i, stable), undecided=_with(rows.undecided, i, undecided))
            continue
        radii[i] = decision.radius
        zero_modes = max(int(rows.zero_modes[i]), decision.zero_modes + int(np.sum(unseen)))
        cleaned = degenerate.without_zeros(rows.eigenvalues[i], decision)
        rows = rows._replace(
            stable=_with(rows.stable, i, decision.verdict == degenerate.STABLE),
            undecided=_with(rows.undecided, i, decision.verdict == degenerate.UNDECIDED),
            zero_modes=_with(rows.zero_modes, i, zero_modes),
            eigenvalues=_with(rows.eigenvalues, i, cleaned),
        )
    return rows, radii


def _from_valleys(steady: Steady, rows: EquilibriumRow, lost, unseen, search, size_of) -> EquilibriumRow:
    """The rows, with searches that crept along a valley towards a multiple root ended there."""
    q = jax.tree.map(np.array, rows.last)
    for i in lost:
        at = jax.tree.map(lambda x, i=i: x[i], q)
        x = nearest(steady, np.asarray(_flat(at), float), size_of(at, i), unseen)
        if x is not None:
            _put(q, i, coordinates.like(at, x.astype(steady.t.dtype)))
    again = search(q, jax.tree.map(np.zeros_like, q))
    # A search that starts at a multiple root does not see how small the stiffness is there.
    again = again._replace(soft=np.maximum(again.soft, rows.soft))
    reached = lost[again.found[lost]]
    return jax.tree.map(lambda old, new: _with(old, reached, new), rows, again)


def _flat(tree) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


def _put(trees, i, tree):
    """Write one tree into trees of arrays with a leading axis."""
    for x, new in zip(jax.tree.leaves(trees), jax.tree.leaves(tree)):
        x[i] = new


def _with(array, places, values):
    """A copy of an array with other values (given for all places, or one for these) at some places."""
    array = np.array(array)
    array[places] = values[places] if np.shape(values) == array.shape else values
    return array


def _is_a_state(system, t, q: PyTree, params: PyTree) -> bool:
    """Whether the argument `starts` is a single start."""
    try:
        checked(system, State(t, *stacked_one(q), params))
    except (TypeError, ValueError, IndexError):
        return False
    return True


def _velocities(velocities, q: PyTree, count):
    """One velocity for each start."""
    v = stacked([velocities] if _is_one(velocities, q) else velocities, "velocities")
    if jax.tree.structure(v) != jax.tree.structure(q):
        coordinates.state(0.0, jax.tree.map(lambda x: x[0], q), jax.tree.map(lambda x: x[0], v), None)
    return jax.tree.map(lambda x, of: numpy_of(x).broadcast_to(x, (count, *of.shape[1:])), v, q)


def _is_one(velocities, q: PyTree):
    if isinstance(velocities, list) or jax.tree.structure(velocities) != jax.tree.structure(q):
        return False
    return all(jnp.ndim(x) == y.ndim - 1 for x, y in zip(jax.tree.leaves(velocities), jax.tree.leaves(q)))


@partial(compiled, in_numpy=True)
def searched(steady: Steady, q: PyTree, v: PyTree, lasting, expected, concrete) -> EquilibriumRow:
    """Search from each start; one row each. `expected`: the number of coordinates at rest that nothing depends on."""
    return jax.vmap(lambda q, v: _search(steady, q, v, lasting, expected, concrete))(q, v)


def held_at(steady: Steady, x, u):
    """The rates of a velocity, and the held rates or momenta."""
    fields, k = steady.fields(x), steady.symmetries.count
    if steady.symmetries.places:
        rates = u[np.array(steady.symmetries.places)]
    else:
        rates = jnp.linalg.lstsq(fields.T, u)[0] if k else jnp.zeros(0, x.dtype)
    return rates, steady.momenta(x, steady.velocity(x, rates)) if steady.symmetries.hold == MOMENTUM and k else rates


def _search(steady: Steady, q: PyTree, v: PyTree, lasting, expected, concrete) -> EquilibriumRow:
    x0, u0 = coordinates.flatten(q)[0], coordinates.flatten(v)[0]
    rates, held = held_at(steady, x0, u0)
    steady = Steady(steady.model, steady.t, held, steady.x0, steady.symmetries)
    y0 = jnp.concatenate([x0, rates, jnp.zeros(steady.m, x0.dtype)])
    fixed, linear = stop_gradient(steady), np.arange(y0.size) >= steady.n + steady.symmetries.count
    root = least_squares_root(lambda y: equations.balance(fixed, y), lax.stop_gradient(y0), linear)
    y = root.y if concrete else differentiable(lambda y: equations.balance(steady, y), root)
    return _row(steady, y, root, y0, lasting, expected, concrete)


def _row(steady: Steady, y, root, y0, lasting, expected, concrete) -> EquilibriumRow:
    """The row of a root: the solution in the user's structure, its stability and its status."""
    x, rates, multipliers = steady.parts(y)
    u, a = steady.velocity_and_acceleration(x, rates)
    by_name: dict[str, Any] = {}
    if steady.m > 1:
        pushes = equations.forces(steady, steady.t, x, u)
        multipliers = equations.shortest_multipliers(pushes, multipliers @ pushes)
    if steady.m:
        by_name = steady.model.split(multipliers)
    jacobian = root.jacobian if concrete else jax.jacfwd(lambda y: equations.balance(steady, y))(y)
    roots = equations.characteristic_roots(steady, y, jacobian, derivatives=not concrete)
    status, imbalance, zero_modes, soft = _verdict(steady, root, y0, lasting)
    grows = GROWS_ABOVE[np.dtype(x.dtype)] * jnp.nanmax(jnp.abs(roots))
    settled = ~jnp.any(roots.real > grows) & jnp.any(jnp.isfinite(roots)) & (status == OK)
    # A zero root that no coordinate explains decides nothing.
    undecided = settled & (zero_modes > expected)
    momenta = steady.momenta(x, u) if steady.symmetries.count else jnp.zeros(0, x.dtype)
    is_found = status == OK

    def fill(tree: PyTree):
        return jax.tree.map(lambda x: jnp.where(is_found, x, jnp.nan), tree)

    return EquilibriumRow(
        fill(steady.model.tree(x)), fill(steady.model.tree(u)), fill(by_name), fill(rates), fill(momenta),
        settled & ~undecided, undecided, fill(roots), is_found, zero_modes, soft, imbalance, status,
        steady.model.tree(root.y[: steady.n]),
    )  # fmt: skip


def _verdict(steady: Steady, root, y0, lasting):
    """The status of a root, its imbalance, and the numbers of its zero modes and of its almost zero ones."""
    n, k = steady.n, steady.symmetries.count
    limit = BALANCED[np.dtype(y0.dtype)]
    larger = jnp.maximum(jnp.abs(root.y), jnp.abs(lax.stop_gradient(y0)))
    # Coordinates of zero have no size of their own, so all take that of the largest.
    of_x, of_rates, of_multipliers = (jnp.max(part, initial=0.0) for part in steady.parts(larger))
    size = jnp.concatenate([jnp.full(n, of_x), jnp.full(k, of_rates), jnp.full(steady.m, of_multipliers)])
    effect = jnp.abs(root.jacobian) @ size
    off = jnp.abs(root.r) / jnp.where(effect > 0, effect, 1.0)
    imbalance = jnp.max(off)
    at = slice(n, n + steady.m)
    status = jnp.asarray(OK)
    if not lasting:
        lost = jnp.abs(equations.drift_rates(steady, root.y))
        scale = jnp.maximum(effect[: n + steady.m], limit * jnp.max(lost))
        status = jnp.where(jnp.all(lost <= limit * scale), OK, NOT_LASTING)
    # Far away a fading force is almost zero, which is no equilibrium.
    far = of_x > FAR * jnp.max(jnp.abs(y0[:n])) if steady.n else False
    status = jnp.where((imbalance <= limit) & ~(far & (jnp.max(jnp.abs(y0[:n])) > 0)), status, NO_BALANCE)
    if steady.m:
        violated = jnp.max(off[at])
        status = jnp.where((violated > limit) & (violated >= jnp.max(off[:n])), CONSTRAINED, status)
    status = jnp.where((status == NO_BALANCE) & (root.steps >= MOST), UNFINISHED, status)
    status = jnp.where(jnp.isfinite(imbalance) & jnp.all(jnp.isfinite(root.y)), status, NOT_FINITE)
    zero, soft, softer = _zero_modes(steady, root)
    # A search that creeps along a curved valley stops farther from a multiple root than one that reaches it.
    return lax.stop_gradient((status, imbalance, zero, jnp.where(status == OK, soft, softer)))


def _zero_modes(steady: Steady, root):
    """In how many directions of positions, apart from the symmetries, the balance holds to first order, or almost."""
    n, k, least = steady.n, steady.symmetries.count, 1e3 * zero_below(root.y.dtype)
    matrix = root.jacobian[: n + steady.m]
    along = jnp.concatenate([steady.fields(root.y[:n]), jnp.zeros((k, steady.m), matrix.dtype)], axis=1)
    matrix = jnp.concatenate([jnp.concatenate([matrix[:, :n], matrix[:, n + k :]], axis=1), along])
    # Rows are compared with those at the start of the search too: a single number has no other scale.
    of_rows = jnp.max(jnp.abs(matrix), axis=1).at[: n + steady.m].max(root.rows[: n + steady.m])
    matrix = matrix / jnp.where(of_rows > 0, of_rows, 1.0)[:, None]
    columns = jnp.max(jnp.abs(matrix), axis=0)
    # A coordinate that is small now has small columns, so for almost zero modes all positions have one unit.
    units = jnp.where(np.arange(columns.size) < n, jnp.max(columns[:n], initial=0.0), columns)

    def sizes(matrix: Array):
        return lapack.singular_values(matrix) if matrix.size else jnp.zeros(0, matrix.dtype)

    def count(columns, below):
        scaled = matrix / jnp.where(columns > least, columns, 1.0)[None, :]
        scaled = jnp.where(jnp.isfinite(scaled), scaled, 0.0)
        return n + jnp.sum(sizes(scaled[:, n:]) > below) - jnp.sum(sizes(scaled) > below)

    soft = soft_below(root.y.dtype)
    return count(columns, least), count(units, soft), count(units, CREEPS_BELOW)
