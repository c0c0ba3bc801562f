"""When exactly a guard is zero, and what the state is then, with their derivatives.

A crossing is the end of a step (`watching.py`): its time is not differentiated there, the state at that time is.
`_exact` gives both what follows from g(t, y(t)) = 0,

    dt = -dg / (dg/dt),    dy = ∂y + (dy/dt) dt,

and from their derivatives in turn, in which all that is written here is at a time that moves, ∂y too.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.6 (event location); Chen, Amos & Nickel, arXiv:2011.03902,
App. A (its derivative).
"""

from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.mechanics.equations import Equations
from lagjax.motion.crossings import Crossings, Guards
from lagjax.motion.pieces import Watched
from lagjax.motion.sight import uneven
from lagjax.motion.watching import Watching

# A guard that is this much farther from zero where it changes its sign than time can resolve jumps there.
JUMPS = 64


class Located(NamedTuple):
    """Where guards are zero: times (S,), NaN where there is no crossing, the states there, and the multipliers.

    `count`, `uncertain`: see `Crossings`, of each guard.
    """

    t: Float[Array, " S"]
    y: PyTree[Float[Array, "S ..."]]
    multipliers: dict[str, Array]
    count: Int[Array, " m"]
    uncertain: Bool[Array, " m"]


def locate(watching: Watching, watched: Watched) -> Located:
    """The crossings that were kept, with what follows from staying on the guards."""
    sight = watching.sight
    equations, guards = sight.motion.equations, sight.guards

    def found(owner, row):
        t, y = _exact((guards, equations), *row, owner, sight.resolution, _flow)
        return t, y, equations.multipliers(t, *y)

    t, y, multipliers = _each(found, guards, jnp.isfinite(watched.t), (watched.t, watched.y))
    counts, uncertain = (jnp.stack([getattr(f, name) for f in watched.followed]) for name in ("count", "uncertain"))
    return Located(t, y, multipliers, counts, uncertain)


def at_known_times(guards: Guards, equations: Equations, resolution, located: Located, y, bent: bool) -> Located:
    """The same with the derivatives of the states `y` (S, ...) at the times that were found, in reverse.

    `bent`: these derivatives may be differentiated in turn.
    Their values are those of the roots: `y` comes by other steps, and is on the guards to the tolerance only.
    """
    y = jtu.tree_map(lambda root, y: root + (y - lax.stop_gradient(y)), located.y, y)
    flow = _flow_twice if bent else _flow

    def found(owner, known):
        t, y = _exact((guards, equations), lax.stop_gradient(known[0]), known[1], owner, resolution, flow)
        return t, y, equations.accelerations(t, *y)[1]

    t, y, multipliers = _each(found, guards, jnp.isfinite(located.t), (located.t, y))
    return located._replace(t=t, y=y, multipliers=multipliers)


def _each(function, guards, there, rows):
    """`function(owner, row)` of each place where there is a crossing; NaN elsewhere."""
    owners = jnp.asarray(guards.owners)
    shapes = jax.eval_shape(function, owners[0], jtu.tree_map(lambda x: x[0], rows))
    nothing = jtu.tree_map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

    def one(place):
        owner, there, row = place
        found = lax.cond(eqxi.unvmap_any(there), lambda: function(owner, row), lambda: nothing)
        return jtu.tree_map(lambda x, y: jnp.where(there, x, y), found, nothing)

    return lax.map(one, (owners, there, rows))


def first_end(guards: Guards, t):
    """The first time in `t` (S,) at which a terminal guard is zero; infinite if at none."""
    return jnp.min(jnp.where(guards.terminal[guards.owners] & jnp.isfinite(t), t, jnp.inf))


def end_of(guards: Guards, located: Located, t, y):
    """The end of the motion, (1,): the first terminal crossing, or else the end that is given."""
    ends = jnp.where(guards.terminal[guards.owners] & jnp.isfinite(located.t), located.t, jnp.inf)
    first = jnp.argmin(ends)
    ended = jnp.isfinite(ends[first])
    return jtu.tree_map(lambda x, last: jnp.where(ended, x[first][None], last), (located.t, located.y), (t, y))


def all_known(located: Located) -> Bool[Array, ""]:
    """Whether nothing at the crossings is NaN, and none is uncertain."""
    there, known = jnp.isfinite(located.t), ~jnp.any(located.uncertain)
    for x in jtu.tree_leaves((located.y, located.multipliers)):
        known = known & jnp.all(jnp.isfinite(x) | ~_like(there, x))
    return known


def by_name(guards: Guards, located: Located, end, valid) -> dict[str, Crossings]:
    """What was found up to the end of the motion, by the name of the event; nothing if the motion is not `valid`."""
    there, found = valid & (located.t <= end), {}
    for i, kind in enumerate(guards.kinds):
        mine = guards.owners == i
        rows = jtu.tree_map(lambda x: x[mine], (located.t, *located.y, located.multipliers))
        masked = jtu.tree_map(lambda x: jnp.where(_like(there[mine], x), x, jnp.nan), rows)
        # The step in which the motion ended may have gone on to more.
        count = located.count[i] - jnp.sum(jnp.isfinite(rows[0]) & ~there[mine])
        found[kind.name] = Crossings(*masked, count, located.uncertain[i])
    return found


def _exact(live, t, y, owner, resolution, flow):
    """A time and a state on a guard as they are; with the derivatives that follow from staying on it."""
    z = lax.stop_gradient(t), y
    return flow(live, _wait(live, z, owner, resolution, flow=flow), z, rate=_rate)


def _rate(live, z):
    t, y = z
    return jnp.ones_like(t), (y[1], live[1].accelerations(t, *y)[0])


def _guard(live, z, owner):
    (guards, equations), (t, y) = live, z
    return jnp.stack(guards(t, *y, equations.accelerations(t, *y)[1], equations.params))[owner]


@eqx.filter_custom_jvp
def _flow(live, tau, z, *, rate):
    """Where `dz/dtau = rate(live, z)` takes z in a time that is zero: z, with all derivatives."""
    return z


@_flow.def_jvp
def _flow_jvp(primals, tangents, *, rate):
    (live, tau, z), (moves, dtau, dz) = primals, tangents
    still = lambda x, dx: jnp.zeros_like(x) if dx is None else dx
    filled = lambda z, dz: jtu.tree_map(still, z, dz, is_leaf=lambda x: x is None)
    dz = filled(z, dz)

    def of_both(live, z):
        value, change = eqx.filter_jvp(rate, (live[0], z[0]), (live[1], z[1]))
        return value, filled(value, change)

    # What is near flows along, by the linear equations.
    z, dz = _flow((live, moves), tau, (z, dz), rate=of_both)
    return z, dz if dtau is None else jtu.tree_map(lambda x, dx: x + dx * dtau, dz, rate(live, z))


def _flow_twice(live, tau, z, *, rate):
    """The same to second derivatives, of which the first may be transposed: by Taylor's polynomial."""
    once = rate(live, z)
    _, twice = jax.jvp(lambda z: rate(live, z), (z,), (once,))
    return jtu.tree_map(lambda x, d, dd: x + tau * d + tau**2 / 2 * dd, z, once, twice)


@eqx.filter_custom_jvp
def _wait(live, z, owner, resolution, *, flow):
    """The time until a state that is on a guard comes to it: zero."""
    # In lanes it has lanes, as its derivative has.
    return jnp.where(z[0] > 0, 0.0, jnp.zeros_like(z[0]))


@_wait.def_jvp
def _wait_jvp(primals, tangents, *, flow):
    (live, z, owner, resolution), (moves, dz, *_) = primals, tangents
    tau = _wait(live, z, owner, resolution, flow=flow)
    after = lambda live, tau, z: _guard(live, flow(live, tau, z, rate=_rate), owner)
    g, rate = jax.jvp(lambda tau: after(live, tau, z), (tau,), (jnp.ones_like(tau),))
    _, dg = eqx.filter_jvp(lambda live, z: after(live, tau, z), (live, z), (moves, dz))
    # Where it jumps, nothing follows.
    size = jnp.finfo(tau.dtype).eps * _terms(live, z, owner)
    jumps = jnp.abs(g) > JUMPS * (jnp.abs(rate) * resolution + size)
    return tau, -dg / jnp.where(jumps, jnp.nan, rate)


def _terms(live, z, owner):
    """How large the terms are whose sum the guard is."""
    t, y = z
    _, change = jax.jvp(lambda t, y: _guard(live, (t, y), owner), (t, y), (t, uneven(y)))
    return jnp.abs(change)


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))
