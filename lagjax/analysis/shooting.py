"""Newton's method for periodic orbits: motions that return to their start.

The unknowns are the states z_j at K equal parts of the period T and, where it is free, T itself. A motion closes if

    Φ(z_j, T/K) - z_{j+1} = 0,        z_K = z_0 + turns + shifts.

With tangent coordinates w_j, so that z_j moves to z_j + B_j w_j, and θ = log T, the linear equations of a step are

    Y_j w_j - B_{j+1} w_{j+1} + f(z_{j+1}) (T/K) θ = -residual

where the flow maps the frames B_j to Y_j. These equations fix neither where on the orbit it starts nor, in a family of
orbits, which member it is. A step orthogonal to the motion, f·w = 0, settles the first, and held quantities (an energy,
a coordinate) settle the second, with one row each. For directions that are still free, such as a rotation of the whole
system, the shortest step is taken.

The step is that of Levenberg and Marquardt with a damping proportional to the residual, which converges quadratically
also to orbits that are not isolated (Yamashita & Fukushima, *Computing Suppl.* 15 (2001) 239). A step that does not
reduce the residual is repeated with more damping.

The first candidate comes from the guess, followed with low accuracy for a period, and for two more if the period is
unknown. If it is not near its start after the given period, the time at which it comes nearest is taken instead.

Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.4-7.5; Muñoz-Almaraz et al., *Physica D* 181 (2003) 1
(families of conservative systems); Stoer & Bulirsch, §7.3.5 (multiple shooting).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.analysis.flow import Flow, SwitchingFlow, any_flow, no_switches, scale_of
from lagjax.integrate import Switches
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.numerics import damped_newton, while_in_python
from lagjax.system import coordinates

TURN = 2 * np.pi
# Points of the path in a given period, and the number of given periods searched for a better one.
PIECES, REACH = 48, 3
# A guess comes back where its distance is below this fraction of its size; a return replaces the given period only if
# it is nearer by the second factor.
NEAR, BETTER = 0.2, 0.5
# A coordinate that moves less than this fraction of the others hardly moves.
STILL = 1e-6
# Returns in this first fraction of a period are ignored: the motion has hardly left its start.
BEGINNING = 0.4


class OrbitRequest(NamedTuple):
    """The kind of orbit that is searched; all fields are static.

    - `free`: whether the period is unknown; `moves`: whether the start may move along the orbit (no dependence on t).
    - `energy`: whether the Jacobi integral is held; `held`: the indices of the held entries of (q, v).
    - `relative` (n,): coordinates that need not come back; `angles` (n,): those that come back up to whole turns.
    """

    free: bool
    moves: bool
    energy: bool
    held: tuple[int, ...]
    relative: tuple[bool, ...]
    angles: tuple[bool, ...]


class Guess(NamedTuple):
    """The start on the constraints, states at equal parts of a period, the period, and the sizes and turns."""

    z: Float[Array, " 2n"]
    nodes: Float[Array, "K 2n"]
    period: Float[Array, ""]
    scale: Float[Array, " 2n"]
    turns: Float[Array, " n"]


def guessed(flow: Flow | SwitchingFlow, t, z, period, asked: OrbitRequest, parts: int, turns) -> Guess:
    """Follow a guess; `turns` (n,): the turns of the angles, or None to count those of the guess."""
    z = flow.onto_constraints(t, z, scale_of(z, period))
    if isinstance(flow, SwitchingFlow):
        # The rates of one phase do not lead through a period.
        return Guess(z, z[None], period, scale_of(z, period), jnp.zeros(flow.size, z.dtype) if turns is None else turns)
    find_period = asked.free and parts == 1
    reach = REACH if find_period else 1
    path = lax.stop_gradient(flow.path(t, z, reach * period, reach * PIECES))
    finite = jnp.all(jnp.isfinite(path))
    path = jnp.where(finite, path, z[None])
    scale = _extent(path, period, scale_of(z, period), np.array(asked.angles) | np.array(asked.relative))
    index, (displacement, _) = PIECES, jnp.split(path - z[None], 2, axis=1)
    around = np.array(asked.angles) & ~np.array(asked.relative)
    path_turns = jnp.where(around[None], jnp.round(displacement / TURN), 0.0)
    if find_period:
        index = _nearest(
            path - z[None],
            TURN * (path_turns if turns is None else jnp.asarray(turns)[None] + 0 * path_turns),
            scale,
            asked,
        )
    # In a driven system an unstable guess may go anywhere, so all parts begin at the given state.
    nodes = path[np.arange(parts) * PIECES // parts] if asked.moves else jnp.broadcast_to(z, (parts, z.size))
    nodes = jnp.stack([z, *(flow.onto_constraints(t, node, scale) for node in nodes[1:])])
    chosen_turns = path_turns[index] if turns is None else jnp.asarray(turns)
    return Guess(z, nodes, period * jnp.asarray(index, z.dtype) / PIECES, scale, chosen_turns)


def _extent(path, period, otherwise, advances):
    """Half the range of each coordinate and velocity; never zero.

    A coordinate that advances steadily, such as a turning angle, counts by its deviation from that advance.
    """
    rate, x = TURN / period, path[:, : len(advances)]
    steady = jnp.linspace(0.0, 1.0, len(path), dtype=x.dtype)[:, None] * (x[-1] - x[0])[None]
    x = jnp.where(advances[None], x - steady, x)
    x, u = (0.5 * jnp.ptp(y, axis=0) for y in (x, path[:, len(advances) :]))
    both = jnp.stack([x, u / rate])
    # Each takes its own size; one that hardly moves, that of its partner, or else of the coordinate that moves most.
    sizes, largest = jnp.max(both, axis=0), jnp.max(both)
    sizes = jnp.where(sizes > STILL * largest, sizes, largest)[None]
    x, u = jnp.where(both > STILL * sizes, both, sizes)
    return lax.stop_gradient(jnp.where(largest > 0, jnp.concatenate([x, u * rate]), otherwise))


def _nearest(difference, turn_shifts, scale, asked):
    """The index of the point nearest to the start, if it is much nearer than that after the given period."""
    mask = 1.0 - np.concatenate([np.array(asked.relative, float), np.zeros(turn_shifts.shape[1])])
    difference = difference - jnp.concatenate([turn_shifts, jnp.zeros_like(turn_shifts)], axis=1)
    apart = jnp.sqrt(jnp.mean((difference / scale[None]) ** 2 * mask[None], axis=1))
    place = np.arange(len(difference))
    off = jnp.pad(apart, 1, constant_values=np.inf)
    lowest = (apart <= off[:-2]) & (apart <= off[2:]) & (place > BEGINNING * PIECES)
    # Of several returns, such as after one and two periods, the one nearest to the given period.
    near = jnp.where(lowest & (apart < NEAR), np.abs(np.log(np.maximum(place, 0.5) / PIECES)), jnp.inf)
    nearest = jnp.where(jnp.any(jnp.isfinite(near)), jnp.argmin(near), jnp.argmin(jnp.where(lowest, apart, jnp.inf)))
    nearest = jnp.where(jnp.any(lowest), nearest, PIECES)
    return jnp.where(apart[nearest] > BETTER * apart[PIECES], PIECES, nearest)


# The equations of a cycle, which branches of cycles have too (`cycle_equations.py`).

# Times, in periods, at which the rates of a driven system are compared.
SAMPLED_AT = (0.0, 0.137, 0.291, 0.443, 0.618, 0.787, 0.912)


class Goal(NamedTuple):
    """The values that may be held: the Jacobi integral, and the entries of the state."""

    integral: Float[Array, ""]
    z: Float[Array, " 2n"]


def times_of(t, period, count):
    """The times of the nodes, (K,)."""
    return t + period * jnp.arange(count, dtype=period.dtype) / count


def in_parts(part: Callable, *given):
    """What `part(*one)` returns of each of K parts of a period, in lanes where there are several."""
    if len(given[0]) > 1:
        return jax.vmap(part)(*given)
    return jax.tree.map(lambda x: x[None], part(*(x[0] for x in given)))


def comes_back(asked: OrbitRequest, dtype):
    """A mask of (q, v): 1 for the entries that have to come back, 0 for relative coordinates."""
    return jnp.asarray(np.concatenate([1.0 - np.array(asked.relative), np.ones(len(asked.relative))]), dtype)


def left_open(asked: OrbitRequest, nodes, ends, turns, scale) -> Float[Array, "K 2n"]:
    """How far the end of each part is from the next node, in units of `scale`."""
    first = nodes[0] + jnp.concatenate([TURN * turns, jnp.zeros_like(turns)])
    left = (ends - jnp.concatenate([nodes[1:], first[None]])) / scale[None]
    return left.at[-1].multiply(comes_back(asked, left.dtype))


def closing_rows(frames: Float[Array, "K s k+e"], bases: Float[Array, "K s k"]) -> Float[Array, "K*s K*k+e"]:
    """The derivative of what is left open: by coordinates along the `bases` at each node, then by e other numbers.

    `frames`: how the end of each part changes. Relative coordinates count like all others.
    """
    (count, size, k), others = bases.shape, frames.shape[2] - bases.shape[2]
    rows = jnp.zeros((count, size, count * k + others), bases.dtype)
    for j in range(count):
        after = (j + 1) % count
        rows = rows.at[j, :, j * k : (j + 1) * k].add(frames[j, :, :k])
        rows = rows.at[j, :, after * k : (after + 1) * k].add(-bases[after])
    return rows.at[:, :, count * k :].set(frames[:, :, k:]).reshape(count * size, -1)


def held_off(flow: Flow | SwitchingFlow, t, z, asked: OrbitRequest, goal: Goal, size, scale) -> list[Array]:
    """How far what is held is from its goal: the energy in units of `size`, entries of z in those of `scale`."""
    off = [(integral_at(flow, t, z) - goal.integral) / size] if asked.energy else []
    return off + [(z[i] - goal.z[i]) / scale[i] for i in asked.held]


def integral_at(flow: Flow | SwitchingFlow, t, z):
    """The Jacobi integral v·p - L."""
    x, u = jnp.split(z, 2)
    value, p = jax.value_and_grad(flow.model.lagrangian, argnums=2)(t, x, u)
    return u @ p - value


def slope_of_integral(flow: Flow | SwitchingFlow, t, z, scale):
    """The gradient of the Jacobi integral, with z in units of `scale`, and its size; 1 where it is zero."""
    slope = jax.grad(partial(integral_at, flow, t))(z) * scale
    size = jnp.linalg.norm(slope)
    return slope, jnp.where(size > 0, size, 1.0)


def change_in_a_period(rate: Callable, t, period):
    """How a function of time changes from one period to the next, at the same phases of every period."""
    times = t + period * jnp.asarray(SAMPLED_AT, period.dtype)
    return jax.vmap(rate)(times + period) - jax.vmap(rate)(times)


MOST = 40
# The damping in units of the residual: its least and first values, its growth after a failed step, where to give up.
LEAST_DAMPING, FIRST_DAMPING, DAMPING_FACTOR, TOO_MUCH_DAMPING = 0.01, 0.03, 8.0, 1e4
# Residuals in units of the tolerance: the search stops at once at the first; the second still counts as an orbit.
STOP_BELOW, CONVERGED_BELOW = 1.0, 1e3
# Singular values below this many tolerances, or below the second number if that is larger, count as zero.
ZERO_TOLERANCES, ZERO_BELOW = 1e4, 1e-8
# A held integral counts as met when it is off by at most this many round-offs of its terms.
ROUND_OFFS = 16.0
# A step that shrinks the motion below this fraction of the first one is rejected.
SHRUNK_BELOW = 0.1
# No step changes the logarithm of the period, or the state in units of its size, by more than this.
LONGEST_STEP = 0.5
# The weight of held quantities relative to closing the orbit: far from a solution both cannot be satisfied.
HELD_WEIGHT = 100.0


class OrbitCandidate(NamedTuple):
    """A candidate orbit: its states (K, 2n) and its period."""

    nodes: Float[Array, "K 2n"]
    period: Float[Array, ""]


class OrbitEvaluation(NamedTuple):
    """The flow evaluated at a candidate: the residual, its root mean square `size`, and the matrix of a Newton step.

    The columns of `matrix` are coordinates along the `bases`. `amplified`: the largest entry of a tangent frame.
    `displacement`: the state at the end minus that at the start. `moves`: how far the state would go in a period at its
    initial rate, without relative coordinates. Of a motion with switches these, and whether it `returns` to the phase
    of its start.
    """

    size: Float[Array, ""]
    residual: Float[Array, " r"]
    matrix: Float[Array, "r c"]
    bases: Float[Array, "K 2n k"]
    amplified: Float[Array, ""]
    displacement: Float[Array, " 2n"]
    moves: Float[Array, ""]
    switches: Switches | None
    returns: Bool[Array, ""] | None


class SearchResult(NamedTuple):
    """The best candidate and how the search went; `apart`: how much a driven system changes from period to period."""

    candidate: OrbitCandidate
    guess: Guess
    evaluation: OrbitEvaluation
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    apart: Float[Array, ""]


class OrbitSearch(NamedTuple):
    """What the next step depends on: the damping to try, and how far the guess moves in its period."""

    damping: Float[Array, ""]
    moves: Float[Array, ""]


class Step(NamedTuple):
    """A step of the nodes, in units of the state, and of log T; and the change of `displacement` that it causes."""

    moves: Float[Array, "K 2n"]
    log_period: Float[Array, ""]
    displacement: Float[Array, " 2n"]


def closed(system, s, period, rtol, asked: OrbitRequest, rows, parts, turns, most) -> SearchResult:
    """Search for an orbit near a state; `turns` (n,): the turns of the angles, or None for those of the guess."""
    if system.in_phases and is_eager() and not is_traced((s, period)):
        # Only the flow, which takes long to compile, is a program, which Floquet multipliers share.
        given = coordinates.state(*s), jnp.asarray(period), jnp.asarray(rtol)
        return _searched(system, *given, asked, rows, parts, turns, most, while_in_python)
    return _closed(system, s, period, rtol, asked, rows, parts, turns, most)


@compiled
def _closed(*given) -> SearchResult:
    return _searched(*given, lax.while_loop)


def _searched(system, s, period, rtol, asked: OrbitRequest, rows, parts, turns, most, loop) -> SearchResult:
    flow, t = any_flow(system, s, rtol, rows), s.t
    guess = guessed(flow, t, flow.vector(s.q, s.v), period, asked, parts, turns)
    goal = Goal(integral_at(flow, t, guess.z), guess.z)
    zero, size = jnp.zeros((), t.dtype), flow.dimension
    rows_of = parts * 2 * flow.size + asked.moves + asked.energy + len(asked.held)
    matrix, bases = jnp.zeros((rows_of, parts * size + 1), t.dtype), jnp.zeros((parts, 2 * flow.size, size), t.dtype)
    returns = zero > 0 if system.in_phases else None
    unevaluated = OrbitEvaluation(
        zero + jnp.inf, matrix[:, 0], matrix, bases, zero + 1, guess.z, zero, no_switches(system, s), returns
    )

    def unfinished(search):
        limit, damping = rtol * jnp.maximum(1.0, search.at.amplified), search.memory.damping
        improving = (search.at.size > STOP_BELOW * limit) & (damping < TOO_MUCH_DAMPING)
        near = (search.at.size <= CONVERGED_BELOW * limit) & (damping > FIRST_DAMPING)
        return ((search.steps == 0) | (improving & ~near)) & (search.steps < most)

    def judge(search, candidate, evaluation):
        damping, moves = search.memory
        # Shrinking towards a state of rest is no progress, although a state of rest comes back after any time.
        better = (evaluation.size < search.at.size) & ~(evaluation.moves < SHRUNK_BELOW * moves)
        less, more = jnp.maximum(LEAST_DAMPING, damping / DAMPING_FACTOR), DAMPING_FACTOR * damping
        moves = jnp.where(search.steps == 0, evaluation.moves, moves)
        return better, OrbitSearch(jnp.where(better, less, more), moves)

    search = damped_newton(
        lambda candidate: _evaluate(flow, t, candidate, asked, goal, guess),
        lambda search: _next_candidate(flow, t, search, asked, guess.scale),
        judge, unfinished, OrbitCandidate(guess.nodes, guess.period), unevaluated,
        OrbitSearch(zero + FIRST_DAMPING, zero), loop,
    )  # fmt: skip
    # What a motion amplifies is forgiven, as long as it still comes back.
    allowed = CONVERGED_BELOW * rtol * jnp.maximum(1.0, search.at.amplified)
    converged = search.at.size <= jnp.minimum(allowed, jnp.sqrt(rtol))
    if asked.moves:
        # A state of rest comes back after any time.
        converged = converged & (search.at.moves > jnp.sqrt(rtol))
    if isinstance(flow, SwitchingFlow):
        converged = converged & search.at.returns
        apart = zero if asked.moves or loop is lax.while_loop else _changed_flow(flow, t, search, guess.scale)
    else:
        apart = zero if asked.moves else _changed(flow, t, search.y, guess.scale)
    return SearchResult(search.y, guess, search.at, converged, search.steps, apart)


@compiled
def implicit(system, s, rtol, asked: OrbitRequest, rows, found: SearchResult) -> SearchResult:
    """The same orbit with its derivatives by the system, parameters and held quantities, from one more Newton step."""
    flow, t = any_flow(system, s, rtol, rows), s.t
    found = lax.stop_gradient(found)
    evaluation, scale = found.evaluation, found.guess.scale
    goal_z = flow.onto_constraints(t, flow.vector(s.q, s.v), scale)
    goal = Goal(integral_at(flow, t, goal_z), goal_z)
    nodes = jax.vmap(lambda z: flow.onto_constraints(t, z, scale))(found.candidate.nodes)
    candidate = OrbitCandidate(nodes, found.candidate.period)
    no_frame = jnp.zeros((flow.size * 2, 0), nodes.dtype)
    passage = partial(flow.passage, span=found.candidate.period / len(nodes), frame=no_frame, scale=scale)
    times = times_of(t, candidate.period, len(nodes))
    ends = jnp.stack([passage(t, z, differentiable=True).z for t, z in zip(times, nodes)])
    residual = _residual(flow, t, candidate, ends, asked, goal, found.guess)
    # The value is that of the search, the derivative that of the step.
    change = residual - lax.stop_gradient(residual)
    step = _step(evaluation.matrix, change, evaluation.bases, asked, lax.stop_gradient(flow.rtol), 0.0)
    candidate = OrbitCandidate(nodes + scale[None] * step.moves, candidate.period * (1 + step.log_period))
    displacement = ends[-1] - nodes[0] + scale * step.displacement
    return found._replace(candidate=candidate, evaluation=evaluation._replace(displacement=displacement))


def _next_candidate(flow, t, search, asked, scale):
    """The candidate to which the next step leads."""
    evaluation, best = search.at, search.y
    damping = jnp.where(search.steps == 0, 0.0, search.memory.damping * evaluation.size)
    moves, log_period, _ = _step(evaluation.matrix, evaluation.residual, evaluation.bases, asked, flow.rtol, damping)
    longest = jnp.maximum(jnp.max(jnp.abs(moves)), jnp.abs(log_period))
    part = jnp.minimum(1.0, LONGEST_STEP / jnp.where(longest > 0, longest, 1.0))
    candidate = OrbitCandidate(best.nodes + part * scale[None] * moves, best.period * jnp.exp(part * log_period))
    onto = jax.vmap(partial(flow.onto_constraints, scale=scale))
    return candidate._replace(nodes=onto(times_of(t, candidate.period, len(best.nodes)), candidate.nodes))


def _evaluate(flow, t, candidate, asked, goal, guess) -> OrbitEvaluation:
    """Follow the flow from each node to the next, with the tangent spaces."""
    count, scale = len(candidate.nodes), guess.scale
    times, span = times_of(t, candidate.period, count), candidate.period / count
    bases = jax.vmap(lambda t, z: flow.tangent_space(t, z, scale))(times, candidate.nodes)
    passed = in_parts(lambda t, z, basis: flow.passage(t, z, span, basis, scale), times, candidate.nodes, bases)
    displacement = passed.z[-1] - candidate.nodes[0]
    residual = _residual(flow, t, candidate, passed.z, asked, goal, guess)
    matrix, moves = _equations(flow, t, candidate, passed, bases, scale, asked)
    # Root mean square rather than the largest entry, because a step reduces the sum of squares.
    size = jnp.sqrt(jnp.mean(residual**2))
    finished = jnp.all(passed.ended) & jnp.isfinite(size) & jnp.all(jnp.isfinite(matrix))

    def clean(x: Array):
        return jnp.where(finished, x, 0.0)

    amplified, size = clean(jnp.max(jnp.abs(passed.frame))), jnp.where(finished, size, jnp.inf)
    of_switches = jax.tree.map(lambda x: x[-1], (passed.switches, passed.returns))
    return OrbitEvaluation(size, clean(residual), clean(matrix), bases, amplified, displacement, moves, *of_switches)


def _equations(flow, t, candidate, passed, bases, scale, asked):
    """The matrix (rows, K k + 1) of a Newton step, in units of `scale`, and how far the state moves in a period."""
    count, _, k = bases.shape
    rates = flow.rates(times_of(t, candidate.period, count), candidate.nodes, passed, candidate.period / count)
    rates = rates * candidate.period / scale[None]
    here, by_log_period = rates[0], rates[count:] / count if asked.free else jnp.zeros_like(rates[count:])
    blocks = [closing_rows(jnp.concatenate([passed.frame, by_log_period[:, :, None]], axis=2), bases)]

    def on_first_node(gradient: Array):
        return jnp.append(gradient @ bases[0], jnp.zeros((count - 1) * k + 1, t.dtype))[None]

    if asked.moves:
        blocks.append(on_first_node(here / jnp.where(jnp.any(here != 0), jnp.linalg.norm(here), 1.0)))
    # Held quantities have priority over the closing residual.
    blocks += [HELD_WEIGHT * on_first_node(row) for row in _held_slopes(flow, t, candidate, scale, asked)]
    return jnp.concatenate(blocks), jnp.max(jnp.abs(here * comes_back(asked, t.dtype)))


def _residual(flow, t, candidate, ends, asked, goal, guess):
    """The residual, in the order of the matrix rows."""
    z, scale = candidate.nodes[0], guess.scale
    parts = [left_open(asked, candidate.nodes, ends, guess.turns, scale).reshape(-1)]
    if asked.moves:
        parts.append(jnp.zeros(1, scale.dtype))
    size = lax.stop_gradient(slope_of_integral(flow, t, lax.stop_gradient(z), scale)[1]) if asked.energy else 1.0
    held = held_off(flow, t, z, asked, goal, size, scale)
    if asked.energy:
        # A value below the round-off of its terms is set to zero, but keeps its derivative.
        terms = jnp.abs(goal.integral) + jnp.abs(flow.model.lagrangian(t, *jnp.split(goal.z, 2)))
        round_off = ROUND_OFFS * jnp.finfo(terms.dtype).eps * terms / size
        fixed = lax.stop_gradient(held[0])
        held[0] = jnp.where(jnp.abs(fixed) <= round_off, held[0] - fixed, held[0])
    return jnp.concatenate([*parts, *(HELD_WEIGHT * off[None] for off in held)])


def _held_slopes(flow, t, candidate, scale, asked):
    """The gradients of the held quantities, normalised, in units of `scale`."""
    if asked.energy:
        slope, size = slope_of_integral(flow, t, candidate.nodes[0], scale)
        yield slope / size
    for i in asked.held:
        yield jnp.eye(2 * flow.size, dtype=scale.dtype)[i]


def _step(matrix, residual, bases, asked, rtol, damping):
    """The Levenberg-Marquardt step."""
    count, size = bases.shape[:2]
    last = slice((count - 1) * size, count * size)
    masked = matrix.at[last].multiply(comes_back(asked, matrix.dtype)[:, None])
    left, sizes, right = jnp.linalg.svd(masked, full_matrices=False)
    zero_below = jnp.maximum(ZERO_TOLERANCES * rtol, ZERO_BELOW) * jnp.maximum(1.0, sizes[0] / HELD_WEIGHT)
    counts = sizes > zero_below
    inverse = jnp.where(counts, sizes / jnp.where(counts, sizes**2 + damping**2, 1.0), 0.0)
    solved = -right.T @ (inverse * (left.T @ residual))
    moves = jnp.einsum("jik,jk->ji", bases, solved[:-1].reshape(count, -1))
    return Step(moves, solved[-1] if asked.free else jnp.zeros_like(rtol), matrix[last] @ solved)


def _changed(flow: Flow, t, candidate, scale):
    """The largest change of the rate of one state over a period, at some times, in units of `scale` per period."""
    change = change_in_a_period(lambda t: flow.rate(t, candidate.nodes[0]) / scale, t, candidate.period)
    return jnp.max(jnp.abs(change)) * candidate.period


def _changed_flow(flow: SwitchingFlow, t, search, scale):
    """How far apart motions from one state end that begin a period apart, in units of `scale`."""
    candidate, evaluation = search.y, search.at
    later = flow.passage(t + candidate.period, candidate.nodes[0], candidate.period, evaluation.bases[0], scale)
    return jnp.max(jnp.abs(later.z - candidate.nodes[0] - evaluation.displacement) / scale)
