"""What does the right-hand side from L cost compared with one derived by hand?

For every system of the six scenes, alone and in 1,000 lanes, `lj.accelerations` is compared with accelerations and
multipliers written robustly by hand in `jax.numpy`, in the same coordinates and as the same function of the state, with
the multipliers eliminated by hand (`by_hand.py`). The double pendulum is also compared with numba.

Both run in a compiled loop in which every acceleration changes the next state a little, so that the compiler can
neither omit anything nor move anything out of the loop except what depends on `params` alone. Both loops are compiled
as `lj.integrate` compiles its own, as one machine function if possible: otherwise XLA would spend more time between
kernels than in them. Both include the loop's own cost; "net" is the ratio without it, measured with a loop that
evaluates nothing. Nanoseconds are minima. "error" is the largest difference of the two, relative to the largest value,
over 1,000 states.

    python -m benchmarks.speed.against_hand_written [--json FILE] [--only TEXT]
"""

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.accuracy.by_hand import CASES, DOUBLE_PENDULUM
from benchmarks.measure import in_turn, main, row, skipped
from lagjax.jaxtools.fuse import one_function

try:
    import numba
except ImportError:
    numba = None

jax.config.update("jax_enable_x64", True)

LANES = 1000
# Seconds of one measured loop: long compared with a call, short compared with other activity of the machine.
LOOP = 3e-3
REPEATS = 31
# How far a state moves along its velocity and acceleration from one evaluation to the next.
NUDGE = 1e-7


def loop(right_hand_side):
    """`count` evaluations, each at a state changed by the previous one; returns t, q, v and the sum of multipliers."""

    def run(count, q, v, params):
        def evaluate(_, carry):
            t, q, v, total = carry
            a, multipliers = right_hand_side(t, q, v, params)
            moved = [jax.tree.map(lambda x, rate: x + NUDGE * rate, x, rate) for x, rate in ((q, v), (v, a))]
            return t + NUDGE, *moved, total + sum(map(jnp.sum, jax.tree.leaves(multipliers)))

        return jax.lax.fori_loop(0, count, evaluate, (jnp.zeros(()), q, v, jnp.zeros(())))

    return run


def from_lagrangian(system):
    """The right-hand side by lagjax."""
    return lambda t, q, v, params: lj.accelerations(system, t, q, v, params)


def nothing(t, q, v, params):
    """An empty right-hand side, to measure the loop itself."""
    return v, {}


def lanes_of(case):
    """LANES random variations of the case's state."""
    random = np.random.default_rng(0)
    return [
        jax.tree.map(lambda x: jnp.asarray(x + 0.1 * random.standard_normal((LANES, *np.shape(x)))), state)
        for state in (case.q0, case.v0)
    ]


def in_all_lanes(right_hand_side, case, params):
    """Accelerations and multipliers of every lane."""
    return jax.jit(jax.vmap(right_hand_side, (None, 0, 0, None)))(0.5, *lanes_of(case), params)


def difference(found, right):
    """The largest difference of two pytrees of the same structure, relative to the largest value of the second."""
    largest = lambda tree: max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(tree))
    return largest(jax.tree.map(jnp.subtract, found, right)) / largest(right)


def evaluations_in(function):
    """The number of evaluations that take LOOP seconds; `function` takes this number."""
    many, seconds = 1, 0.0
    while seconds < 0.1 * LOOP:
        many *= 4
        seconds = in_turn(lambda: function(many), repeats=1).minima[0]
    return max(many, int(many * LOOP / seconds))


def calls(case, params, right_hand_sides, batched):
    """The compiled loops, each a function of the number of evaluations."""
    state = lanes_of(case) if batched else jax.tree.map(jnp.asarray, [case.q0, case.v0])
    whole = [lambda *inputs, f=f: one_function(loop(f), *inputs) for f in right_hand_sides]
    programs = [jax.jit(jax.vmap(f, (None, 0, 0, None)) if batched else f) for f in whole]
    return [lambda count, program=program: program(count, *state, params) for program in programs]


def compared(case, batched):
    """The row of one system, alone or in lanes."""
    params = jax.tree.map(jnp.asarray, case.params)
    both = calls(case, params, (from_lagrangian(case.system), case.by_hand, nothing), batched)
    count = evaluations_in(both[1])
    times = in_turn(*(lambda f=f: f(count) for f in both), repeats=REPEATS)
    ours, by_hand, empty = (1e9 * x / count / (LANES if batched else 1) for x in times.minima)
    ratio, of_minima = times.ratio()
    found, right = (in_all_lanes(f, case, params) for f in (from_lagrangian(case.system), case.by_hand))
    more = {"net": (ours - empty) / (by_hand - empty)} if by_hand > 1.2 * empty else {}
    return row(
        named(case, batched), ratio, 1.10, minima=of_minima, ns=ours, by_hand=by_hand, loop=empty, **more,
        error=difference(found, right),
    )  # fmt: skip


def named(case, batched):
    """The name of a row."""
    return f"{case.name}, {'a lane of 1000' if batched else 'single'}: from L / by hand"


def against_numba(batched):
    """The double pendulum's row: our time per lane over that of numba."""
    case, target = DOUBLE_PENDULUM, 0.5 if batched else 2.5
    what = f"{case.name}, {'a lane of 1000' if batched else 'single'}: from L / numba"
    if numba is None:
        return skipped(what, "numba is not installed")
    params = jax.tree.map(jnp.asarray, case.params)
    (ours,) = calls(case, params, [from_lagrangian(case.system)], batched)
    theirs = numba_lanes if batched else numba_single
    state = lanes_of(case) if batched else (case.q0, case.v0)
    numbers = [np.asarray(x) if batched else float(x) for x in jax.tree.leaves(state)]
    by_numba = lambda count: theirs(count, *numbers, *case.params.values())
    count = evaluations_in(by_numba)
    times = in_turn(lambda: ours(count), lambda: by_numba(count), repeats=REPEATS)
    scale = 1e9 / count / (LANES if batched else 1)
    ratio, of_minima = times.ratio()
    ns, numba_ns = (scale * x for x in times.minima)
    lanes = [np.asarray(x) for x in jax.tree.leaves(lanes_of(case))]
    one, two = numba_double_pendulum(*lanes, *case.params.values())
    error = difference(in_all_lanes(from_lagrangian(case.system), case, params)[0], {"one": one, "two": two})
    return row(what, ratio, target, minima=of_minima, ns=ns, numba=numba_ns, error=error)


if numba is not None:

    @numba.njit(inline="always", error_model="numpy")
    def numba_double_pendulum(one, two, rate1, rate2, m1, m2, l1, l2, g):
        """The formulas of `by_hand.double_pendulum`."""
        s, c = np.sin(one - two), np.cos(one - two)
        s1, s2 = g * np.sin(one), g * np.sin(two)
        first, second, total = l1 * rate1**2, l2 * rate2**2, m1 + m2
        share = 1 / (m1 + m2 * s**2)
        a1 = (m2 * (s2 * c - s * (first * c + second)) - total * s1) * share / l1
        a2 = (total * (first * s + s1 * c - s2) + m2 * second * s * c) * share / l2
        return a1, a2

    @numba.njit(error_model="numpy")
    def numba_single(count, one, two, rate1, rate2, m1, m2, l1, l2, g):
        """`loop` on one double pendulum."""
        for _ in range(count):
            a1, a2 = numba_double_pendulum(one, two, rate1, rate2, m1, m2, l1, l2, g)
            one, two = one + NUDGE * rate1, two + NUDGE * rate2
            rate1, rate2 = rate1 + NUDGE * a1, rate2 + NUDGE * a2
        return one, two, rate1, rate2

    @numba.njit(error_model="numpy")
    def numba_lanes(count, one, two, rate1, rate2, m1, m2, l1, l2, g):
        """`loop` on arrays of double pendulums: each evaluation treats all of them."""
        one, two, rate1, rate2 = one.copy(), two.copy(), rate1.copy(), rate2.copy()
        for _ in range(count):
            for i in range(one.size):
                a1, a2 = numba_double_pendulum(one[i], two[i], rate1[i], rate2[i], m1, m2, l1, l2, g)
                one[i] += NUDGE * rate1[i]
                two[i] += NUDGE * rate2[i]
                rate1[i] += NUDGE * a1
                rate2[i] += NUDGE * a2
        return one, two, rate1, rate2


def rows(wanted):
    """Every system of the scenes, then the double pendulum compared with numba."""
    for case in (*CASES, DOUBLE_PENDULUM):
        for batched in (False, True):
            if wanted(named(case, batched)):
                yield compared(case, batched)
    for batched in (False, True):
        if wanted(f"{DOUBLE_PENDULUM.name}, {'a lane of 1000' if batched else 'single'}: from L / numba"):
            yield against_numba(batched)


if __name__ == "__main__":
    main(rows, __doc__)
