"""The exact times at which guards are zero and the states there, with their derivatives.

A crossing is the end of a step (`detect.py`): its time is not differentiated there, the state at that time is.
`_exact` gives both the derivatives that follow from g(t, y(t)) = 0,

    dt = -dg / (dg/dt),    dy = ∂y + (dy/dt) dt,

and the higher ones, for which every term on the right, ∂y too, is taken at a time that itself moves.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.6 (event location); Chen, Amos & Nickel, arXiv:2011.03902,
App. A (its derivative).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.events.brackets import Watched, uneven
from lagjax.integrate.events.detect import Follower
from lagjax.integrate.events.event import Crossings, Guards
from lagjax.jaxtools import like
from lagjax.mechanics import Equations

# A guard jumps if, where its sign changes, it is this many times farther from zero than time resolution explains.
JUMP_FACTOR = 64


class Located(NamedTuple):
    """The zeros of guards: times (S,), NaN where there is no crossing, and the states and multipliers there.

    `count`, `uncertain`: for each guard, see `Crossings`.
    """

    t: Float[Array, " S"]
    y: PyTree[Float[Array, "S ..."]]
    multipliers: dict[str, Array]
    count: Int[Array, " m"]
    uncertain: Bool[Array, " m"]


def locate(follower: Follower, watched: Watched) -> Located:
    """Return the recorded crossings, with the derivatives that follow from staying on the guards."""
    sight = follower.sight
    equations, guards = sight.equations, sight.guards

    def exact(owner: Array, there: Array, row):
        t, y = _exact((guards, equations), *row, owner, there, sight.resolution, _flow)
        return t, y, equations.multipliers(t, *y)

    t, y, multipliers = _each(exact, guards, jnp.isfinite(watched.t), (watched.t, watched.y))
    counts, uncertain = (jnp.stack([getattr(f, name) for f in watched.followed]) for name in ("count", "uncertain"))
    return Located(t, y, multipliers, counts, uncertain)


def at_known_times(
    guards: Guards, equations: Equations, resolution: Array, located: Located, t: Array, y: PyTree, bent: bool
) -> Located:
    """Return the same with the derivatives of the states `y` (S, ...) at the known times, for reverse mode.

    `t` (S,): these times, and one of the motion where there is no crossing. `bent`: these derivatives may be
    differentiated again. The values stay those of the roots: `y` comes from other steps, and is on the guards only to
    the tolerance.
    """
    there, flow = jnp.isfinite(located.t), _flow_twice if bent else _flow
    # In a lane without a crossing a state of the motion: zero times the derivative at NaN would be NaN.
    y = jtu.tree_map(lambda root, y: jnp.where(like(there, y), root + (y - lax.stop_gradient(y)), y), located.y, y)

    def exact(owner: Array, there: Array, known):
        t, y = _exact((guards, equations), lax.stop_gradient(known[0]), known[1], owner, there, resolution, flow)
        return t, y, equations.accelerations(t, *y)[1]

    t, y, multipliers = _each(exact, guards, there, (t, y))
    return located._replace(t=t, y=y, multipliers=multipliers)


def _each(function: Callable, guards, there, rows):
    """Return `function(owner, there, row)` for each place with a crossing, and NaN for the others."""
    owners = jnp.asarray(guards.owners)
    shapes = jax.eval_shape(function, owners[0], there[0], jtu.tree_map(lambda x: x[0], rows))
    nothing = jtu.tree_map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    def one(place):
        owner, there, row = place
        found = lax.cond(eqxi.unvmap_any(there), lambda: function(owner, there, row), lambda: nothing)
        return jtu.tree_map(lambda x, y: jnp.where(there, x, y), found, nothing)

    return lax.map(one, (owners, there, rows))


def first_end(guards: Guards, t: Array):
    """Return the first time in `t` (S,) at which a terminal guard is zero; infinite if there is none."""
    return jnp.min(jnp.where(guards.terminal[guards.owners] & jnp.isfinite(t), t, jnp.inf))


def end_of(guards: Guards, located: Located, t: Array, y: PyTree):
    """Return the end of the motion, (1,): the first terminal crossing, or else the given `t` and `y`."""
    ends = jnp.where(guards.terminal[guards.owners] & jnp.isfinite(located.t), located.t, jnp.inf)
    first = jnp.argmin(ends)
    ended = jnp.isfinite(ends[first])
    return jtu.tree_map(lambda x, last: jnp.where(ended, x[first][None], last), (located.t, located.y), (t, y))


def all_known(located: Located) -> Bool[Array, ""]:
    """Whether nothing at the crossings is NaN, and none is uncertain."""
    there, known = jnp.isfinite(located.t), ~jnp.any(located.uncertain)
    for x in jtu.tree_leaves((located.y, located.multipliers)):
        known = known & jnp.all(jnp.isfinite(x) | ~like(there, x))
    return known


def by_name(guards: Guards, located: Located, end, valid) -> dict[str, Crossings]:
    """Return the crossings up to the end of the motion, by the name of the event; none if the motion is not `valid`."""
    there, found = valid & (located.t <= end), {}
    for i, kind in enumerate(guards.kinds):
        mine = guards.owners == i
        rows = jtu.tree_map(lambda x: x[mine], (located.t, *located.y, located.multipliers))
        masked = jtu.tree_map(lambda x: jnp.where(like(there[mine], x), x, jnp.nan), rows)
        # The step in which the motion ended may contain further crossings.
        count = located.count[i] - jnp.sum(jnp.isfinite(rows[0]) & ~there[mine])
        found[kind.name] = Crossings(*masked, count, located.uncertain[i])
    return found


def _exact(live: PyTree, t: Array, y: PyTree, owner: Array, there: Array, resolution: Array, flow: Callable):
    """Return a time and a state on a guard unchanged, with the derivatives that follow from staying on it."""
    z = lax.stop_gradient(t), y
    return flow(live, _wait(live, z, owner, there, resolution, flow=flow), z, rate=_rate)


def _rate(live: PyTree, z: PyTree):
    t, y = z
    return jnp.ones_like(t), (y[1], live[1].accelerations(t, *y)[0])


def _guard(live: PyTree, z: PyTree, owner: Array):
    (guards, equations), (t, y) = live, z
    return jnp.stack(guards(t, *y, equations.accelerations(t, *y)[1], equations.model.params))[owner]


@eqx.filter_custom_jvp
def _flow(live: PyTree, tau: Array, z: PyTree, *, rate):
    """Follow `dz/dtau = rate(live, z)` from z for a time tau of zero: return z, with all derivatives."""
    return z


@_flow.def_jvp
def _flow_jvp(primals: Sequence, tangents: Sequence, *, rate):
    (live, tau, z), (moves, dtau, dz) = primals, tangents

    def filled(z: PyTree, dz):
        return jtu.tree_map(lambda x, dx: jnp.zeros_like(x) if dx is None else dx, z, dz, is_leaf=lambda x: x is None)

    dz = filled(z, dz)

    def of_both(live: PyTree, z: PyTree):
        value, change = eqx.filter_jvp(rate, (live[0], z[0]), (live[1], z[1]))
        return value, filled(value, change)

    # A neighbouring state follows the linearised equations.
    z, dz = _flow((live, moves), tau, (z, dz), rate=of_both)
    return z, dz if dtau is None else jtu.tree_map(lambda x, dx: x + dx * dtau, dz, rate(live, z))


def _flow_twice(live: PyTree, tau: Array, z: PyTree, *, rate):
    """The same up to second derivatives, by Taylor's polynomial; the first derivatives may be transposed."""
    once = rate(live, z)
    _, twice = jax.jvp(lambda z: rate(live, z), (z,), (once,))
    return jtu.tree_map(lambda x, d, dd: x + tau * d + tau**2 / 2 * dd, z, once, twice)


@eqx.filter_custom_jvp
def _wait(live: PyTree, z: PyTree, owner: Array, there: Array, resolution: Array, *, flow: Callable):
    """Return the time until a state on a guard reaches it: zero, with derivatives (not if it is not `there`)."""
    # Under vmap the value must be batched, as its derivative is.
    return jnp.where(z[0] > 0, 0.0, jnp.zeros_like(z[0]))


@_wait.def_jvp
def _wait_jvp(primals: Sequence, tangents: Sequence, *, flow: Callable):
    (live, z, owner, there, resolution), (moves, dz, *_) = primals, tangents
    tau = _wait(live, z, owner, there, resolution, flow=flow)

    def after(live: PyTree, tau: Array, z: PyTree):
        return _guard(live, flow(live, tau, z, rate=_rate), owner)

    g, rate = jax.jvp(lambda tau: after(live, tau, z), (tau,), (jnp.ones_like(tau),))
    _, dg = eqx.filter_jvp(lambda live, z: after(live, tau, z), (live, z), (moves, dz))
    # Where the guard jumps, it determines no derivative.
    size = jnp.finfo(tau.dtype).eps * _terms(live, z, owner)
    jumps = jnp.abs(g) > JUMP_FACTOR * (jnp.abs(rate) * resolution + size)
    may_rest = jnp.asarray([kind.may_rest for kind in live[0].kinds])[owner]
    # The jump of a force in time is where a leg begins, whose time has its derivatives; they are taken there.
    none = jnp.where(may_rest, jnp.inf, jnp.nan)
    return tau, -dg / jnp.where(there, jnp.where(jumps, none, rate), jnp.inf)


def _terms(live: PyTree, z: PyTree, owner: Array):
    """Return the size of the terms whose sum is the guard."""
    t, y = z
    _, change = jax.jvp(lambda t, y: _guard(live, (t, y), owner), (t, y), (t, uneven(y)))
    return jnp.abs(change)
