"""The times at which a force jumps because of t alone: a pulse, a relay, a square wave.

Where the program compares t itself with a number (`t < off`), that number is the time. All other comparisons of
functions of t are evaluated on a fine grid, and each change is bisected; Newton's formula then gives the last digits,
and the derivatives. The times become ends of steps.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from lagjax.integrate.jumps.find import Jumps, OpenedFunction, leaves_of
from lagjax.jaxtools.jaxpr import outputs_of, run

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


def with_jumps_in_time(jumps: Jumps, jump_ts, system, q, v, params, ts):
    """The times of the jumps that the user named, and of those that were found, in no order; and whether there are too
    many of the latter, which are then left out."""
    found, sought, too_many = [] if jump_ts is None else [jump_ts], [], jnp.asarray(False)
    for role, traced in jumps.traced.items():
        arguments = {"q": q, "v": v, "params": params, "multipliers": traced.zeros(ts.dtype)}
        of_role = traced, getattr(system, role), arguments
        found += [jnp.ravel(x) for x in _at(ts[0], [place for place, timed in traced.of_time if timed.at], *of_role)]
        sought += [of_role] if any(not timed.at for _, timed in traced.of_time) else []
    if sought:
        times, too_many = _sought(sought, ts)
        found.append(times)
    return jnp.concatenate([x.astype(ts.dtype) for x in found]), too_many


def _at(t, outputs, traced: OpenedFunction, function, arguments):
    """Some results of the program at a time; jumps in t alone do not depend on the rest of the state."""
    if not outputs:
        return []
    state = tuple((arguments | {"t": t})[name] for name in traced.takes)
    modes, free = traced.no_modes(t.dtype)
    return run(outputs_of(traced.program, outputs), [*leaves_of(function, state), modes, free])


def _results(roles, t, before=None, after=None) -> Results:
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


def _between(rule, before, after, table):
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


def _sought(roles, ts):
    fixed = jax.tree.map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, (roles, ts))
    roles_fixed, (first, last) = fixed[0], (fixed[1][0], fixed[1][-1])
    modes_at = lambda t: _results(roles_fixed, t).modes
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
    mine = lambda modes: jnp.take_along_axis(modes, (number % count)[:, None], axis=1)[:, 0]
    each = jax.vmap(modes_at)
    before = mine(each(low))

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        same = mine(each(middle)) == before
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = lax.fori_loop(0, BISECTIONS, halve, (low, high))
    before, after = each(low), each(high)

    def difference(t, component, before, after):
        found = _results(roles, t, before, after)
        return (found.x - found.changes_at)[component]

    along = lambda t, *rest: jax.jvp(lambda t: difference(t, *rest), (t,), (jnp.ones_like(t),))
    t = high
    for _ in range(NEWTON):
        g, rate = jax.vmap(along)(t, number % count, before, after)
        step = -g / jnp.where(rate != 0, rate, 1.0)
        near = (jnp.abs(step) <= SMALL * (last - first)) & (rate != 0)
        t = t + jnp.where(near, step, 0.0)
    return jnp.where(there, t, ts[-1]), too_many
