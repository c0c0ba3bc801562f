"""The times at which a force jumps because of t alone: a pulse, a relay, a square wave.

Where the program compares t itself with a number (`t < off`), that number is the time. Any other comparison of
functions of t is evaluated on a fine grid, and each change is bisected; Newton's formula then gives the last digits,
and the derivatives. The times become ends of steps.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from lagjax.jax_internals.programs import outputs_of, run
from lagjax.jumps.found import Jumps, Traced, leaves_of

# A function of t is evaluated at so many times of a motion; and the most jumps of one comparison that are followed.
SAMPLES, ROOM = 4096, 512
BISECTIONS, NEWTON = 60, 3
# A step of Newton's formula beyond this part of the motion says that the number jumps, and has no zero there.
SMALL = 1e-9


def with_jumps_in_time(jumps: Jumps, jump_ts, system, q, v, params, ts):
    """The times of the jumps that the user named, and of those that were found, in no order."""
    found = [] if jump_ts is None else [jump_ts]
    for role, traced in jumps.traced.items():
        arguments = {"q": q, "v": v, "params": params, "multipliers": traced.zeros(ts.dtype)}
        for place, timed in traced.of_time:
            rest = place, timed, getattr(system, role), arguments
            found.append(jnp.ravel(_named(traced, ts, *rest)) if timed.at else _sought(traced, ts, *rest))
    return jnp.concatenate([x.astype(ts.dtype) for x in found])


def _at(traced: Traced, outputs, t, function, arguments):
    """Some results of the program at a time; jumps in t alone do not depend on the rest of the state."""
    state = tuple((arguments | {"t": t})[name] for name in traced.takes)
    modes, free = traced.no_modes(t.dtype)
    return run(outputs_of(traced.program, outputs), [*leaves_of(function, state), modes, free])


def _named(traced, ts, place, timed, function, arguments):
    return _at(traced, [place], ts[0], function, arguments)[0]


def _sought(traced, ts, place, timed, function, arguments):
    outputs = [place, place + 1] + ([place + 2] if timed.rule == "place" else [])
    fixed = jax.tree.map(lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, (function, arguments))

    def modes_at(t):
        return _at(traced, outputs[:1], t, *fixed)[0]

    grid = lax.stop_gradient(ts[0] + (ts[-1] - ts[0]) * jnp.linspace(0.0, 1.0, SAMPLES + 1, dtype=ts.dtype))
    modes = jax.vmap(modes_at)(grid)
    changes = (modes[1:] != modes[:-1]).T.reshape(-1)
    (place_of,) = jnp.nonzero(changes, size=ROOM, fill_value=-1)
    component, interval = place_of // SAMPLES, place_of % SAMPLES

    def time(component, interval):
        low, high = grid[interval], grid[interval + 1]
        before = modes_at(low)[component]

        def halve(_, ends):
            low, high = ends
            middle = 0.5 * (low + high)
            same = modes_at(middle)[component] == before
            return jnp.where(same, middle, low), jnp.where(same, high, middle)

        low, high = lax.fori_loop(0, BISECTIONS, halve, (low, high))
        after = modes_at(high)[component]
        t = lax.stop_gradient(high)
        for _ in range(NEWTON):
            t = _newton(t, before, after, component)
        return t

    def _newton(t, before, after, component):
        value = lambda t: _difference(timed.rule, _at(traced, outputs, t, function, arguments), before, after, component)
        g, rate = jax.jvp(value, (t,), (jnp.ones_like(t),))
        step = -g / jnp.where(rate != 0, rate, 1.0)
        near = (jnp.abs(step) <= SMALL * jnp.abs(ts[-1] - ts[0])) & (rate != 0)
        return t + jnp.where(near, step, 0.0)

    times = jax.vmap(time)(jnp.maximum(component, 0), jnp.maximum(interval, 0))
    return jnp.where(place_of >= 0, times, ts[-1])


def _difference(rule, results, before, after, component):
    """The number that is zero where the mode changes from `before` to `after`."""
    x = results[1][component]
    if rule == "above":
        return x
    if rule == "place":
        return x - results[2][jnp.maximum(before, after).astype(int) - 1]
    if rule == "floor":
        return x - jnp.maximum(before, after)
    if rule == "ceil":
        return x - jnp.minimum(before, after)
    if rule == "round":
        return x - 0.5 * (before + after)
    return x - jnp.where(jnp.abs(after) > jnp.abs(before), after, before)
