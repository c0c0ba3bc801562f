"""The laws at states, without a motion: impacts, what sticks, slides and lets go, springs, instants of controls."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.integrate.elements import in_modes
from lagjax.integrate.laws import Compliant, Laws, Normal, Sampled
from lagjax.integrate.meeting import Meeting, Rows, Struck
from lagjax.system import State

OPEN, CLOSED, FREE, SLIDES, STICKS = 0, 1, 0, 1, 2
M, G = 2.0, 10.0


def yard() -> lj.System:
    """A mass m over a rough floor, pushed; beside it one on a belt with static friction 1 and kinetic 0.4, N = 1."""

    def energy(t, q, v, p):
        return 0.5 * M * jnp.sum(v**2) - M * G * q[1] + p["push"] @ q

    floor = lj.Contact(
        lambda t, q, p: q[1], restitution=lambda p: p["e"], friction=lambda p: p["mu"], sliding=lambda t, q, v, p: v[0]
    )
    belt = lj.Friction(lambda t, q, v, p: v[2] - 0.5, 0.4, normal=1.0, static=1.0)
    return lj.System(energy, elements={"belt": belt, "floor": floor})


# Height, velocities, pushes and parameters; the velocities after, and the modes of the floor, the belt and the floor's
# friction.
CASES = {
    "flies": (1.0, [3, -2, 0.5], [0, 0, 0], {}, [3, -2, 0.5], [OPEN, STICKS, FREE]),
    "strikes and slides": (0.0, [3, -2, 0.5], [0, 0, 0], {}, [3 - 0.9, 1, 0.5], [OPEN, STICKS, FREE]),
    "strikes and slides back": (0.0, [-3, -2, 0.5], [0, 0, 0], {}, [-3 + 0.9, 1, 0.5], [OPEN, STICKS, FREE]),
    "strikes and sticks": (0.0, [0.8, -2, 0.5], [0, 0, 0], {}, [0, 1, 0.5], [OPEN, STICKS, FREE]),
    "stays": (0.0, [3, -2, 0.5], [0, 0, 0], {"e": 0.0}, [3 - 0.6, 0, 0.5], [CLOSED, STICKS, SLIDES]),
    "opens": (0.0, [3, 2, 0.5], [0, 0, 0], {}, [3, 2, 0.5], [OPEN, STICKS, FREE]),
    "slides back": (0.0, [-1, 0, 0.4], [0, 0, 0], {}, [-1, 0, 0.4], [CLOSED, -SLIDES, -SLIDES]),
    "rests": (0.0, [0, 0, 0.6], [5.9, 0, 0], {}, [0, 0, 0.6], [CLOSED, SLIDES, STICKS]),
    "begins to slide": (0.0, [0, 0, 0.5], [6.1, 0, 0.9], {}, [0, 0, 0.5], [CLOSED, STICKS, SLIDES]),
    "begins to slide back": (0.0, [0, 0, 0.5], [-6.1, 0, 1.1], {}, [0, 0, 0.5], [CLOSED, SLIDES, -SLIDES]),
    "lifted": (0.0, [0, 0, 0.5], [0, 20.1, -1.1], {}, [0, 0, 0.5], [OPEN, -SLIDES, FREE]),
    "slides without friction": (0.0, [3, 0, 0.5], [0, 0, 0], {"mu": 0.0}, [3, 0, 0.5], [CLOSED, STICKS, SLIDES]),
    "rests without friction": (0.0, [0, 0, 0.5], [0, 0, 0], {"mu": 0.0}, [0, 0, 0.5], [CLOSED, STICKS, FREE]),
    "held down": (0.0, [0, 0, 0.5], [0, 19.9, 0], {}, [0, 0, 0.5], [CLOSED, STICKS, STICKS]),
}


def test_a_block_on_a_floor_and_one_on_a_belt():
    """An impact takes (1 + e) of the closing velocity, and μ of that, or all, of the sliding; at rest friction holds
    what is below μ N, or below the static μ, and slides to the side of the push; a lift above the weight opens."""
    rows = list(CASES.values())
    q = np.array([[0.2, y, 0.3] for y, *_ in rows])
    v, push = (np.array([row[i] for row in rows], float) for i in (1, 2))
    params = {name: np.array([row[3].get(name, x) for row in rows]) for name, x in (("mu", 0.3), ("e", 0.5))}
    params |= {"push": push}
    start = State(np.array(0.0), q[0], v[0], jax.tree.map(lambda x: x[0], params))
    masked, laws = in_modes(yard(), start)
    assert laws.names == ("floor", "belt", "floor friction")

    @jax.jit
    @jax.vmap
    def met(q, v, params):
        given, sizes = laws.at_first(start.t, params), jnp.abs(jnp.stack([q, v]))
        return Meeting(masked, laws).met(start.t, q, v, given, jnp.zeros(laws.guarded, bool), sizes)

    found = jax.tree.map(np.asarray, met(q, v, params))
    assert np.all(found.found)
    for name, row, after, modes in zip(CASES, rows, found.v, found.modes):
        np.testing.assert_allclose(after, row[4], atol=1e-12, err_msg=name)
        assert modes.tolist() == row[5], name


def laws(*compliant, sampled=(), impacts="sequential"):
    """The laws of a row of three balls, whose restitution is the parameters, or of something else."""
    gaps = () if compliant else (Normal("balls", lambda t, q, d: q[1:] - q[:-1], lambda e: e, 0.0, (0, 2)),)
    return Laws(gaps, (), compliant, sampled, (0, 1) if gaps else (), (), 2, impacts)


def test_a_row_of_balls():
    """One ball strikes two that touch: the impulses of the textbook, one after the other, all at once, and without
    restitution. Twin: what is apart, or struck slower than counts, gets none."""
    response, none = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.zeros(0)

    @jax.jit
    @jax.vmap
    def impulses(e, before, closed):
        of = [laws(impacts=impacts) for impacts in ("sequential", "simultaneous")]
        still, free = jnp.full(2, 1e-9), jnp.zeros((0, 2))
        return [Struck(law, e, jnp.asarray(response), before, closed, still, none, free).impulses() for law in of]

    e, both, last = np.array([1.0, 1.0, 0.0, 1.0]), [True, True], [False, True]
    before = np.array([[-1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0], [-1e-10, 0.0]])
    one_by_one, at_once = map(np.asarray, impulses(e, before, np.array([both, last, both, both])))
    np.testing.assert_allclose(one_by_one, [[1.0, 1.0], [0, 0], [2 / 3, 1 / 3], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(at_once, [[4 / 3, 2 / 3], [0, 0], [2 / 3, 1 / 3], [0, 0]], atol=1e-12)


def test_a_spring_with_a_damper():
    """It pushes with k d + c d' while pressed; the guard of its mode is d + c/k min(d', 0), where it lets go. Twin: the
    force of what is apart is zero."""
    mat = Compliant("mat", lambda t, q, p: q, lambda p: p, 8.0, (0, 1), ())
    q, v, k = np.array([-0.1, -0.1, -0.1, 0.1]), np.array([-0.5, 0.5, 6.0, 0.5]), np.full(4, 400.0)

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, 0, None))
    def forces(q, v, k, mode):
        law, t = laws(mat), jnp.zeros(())
        given = law.given(k, jnp.array([mode]))
        (force,), back = mat.push(t, q, v, given)
        after, _ = mat.after(t, q, v, given, jnp.array([False]), jnp.abs(jnp.stack([q, v]))[:, None])
        return force, back, law.last(t, q, v, {}, given)[0], after[0]

    force, back, guard, after = map(np.asarray, forces(q, v, k, 1))
    np.testing.assert_allclose(force, [44.0, 36.0, -8.0, -44.0], rtol=1e-12)
    np.testing.assert_allclose(back, force)
    np.testing.assert_allclose(guard, [0.1, 0.09, -0.02, -0.11], rtol=1e-12)
    assert after.tolist() == [1, 1, 0, 0]
    np.testing.assert_allclose(forces(q, v, k, 0)[2], -guard)
    assert not np.any(forces(q, v, k, 0)[0])


def test_instants_of_a_control():
    """The k-th is at offset + k T; the first is not before the start, and acts at its time but for round-off."""
    control = Sampled("u", lambda t, q, v, p: 2.0 * q["x"] + p, lambda p: p, 0.1, 0)
    t, period = np.array([0.0, 0.1, 0.1 + 1e-16, 0.2, 0.7]), np.full(5, 0.3)

    @jax.jit
    @jax.vmap
    def at(t, period):
        first, law = control.first(t, period), laws(sampled=(control,))
        q, given = law.acted(t, {"u": -1.0 * t, "x": t}, {"x": t}, law.given(period, jnp.array([1, 1, 1])[:1]))
        return first, control.instant(first, t, period), q["u"], given.modes[0]

    first, instant, output, number = map(np.asarray, at(t, period))
    assert first.tolist() == [0, 0, 0, 1, 2]
    np.testing.assert_allclose(instant, [0.1, 0.1, 0.1, 0.4, 0.7], rtol=1e-15)
    np.testing.assert_allclose(output, np.where(t >= 0.4 - 1e-12, 2 * t + period, -t), rtol=1e-15)
    assert number.tolist() == [1, 1, 1, 1, 2]


def test_sizes_of_what_rests_and_of_what_starts_from_zero():
    """What starts from zero with v goes v²/a, however long it is followed, or v T, in any units; velocities of
    round-off move nothing. Twins: in a shorter time it goes less far, and a velocity above round-off moves."""

    @jax.jit
    @jax.vmap
    def sizes(v, T, unit):
        root_mass, a, one = jnp.array([1.0, 2.0]) / unit, jnp.array([0.0, 10.0]) * unit, jnp.eye(2)
        rows = Rows(one, one, one, jnp.zeros((2, 0)), root_mass, a)
        return rows.sizes(jnp.zeros((2, 2)).at[1, 1].set(v), a, T)[:, 1]

    speeds, times, units = np.array([0.3, 0.3, 0.3e6, 0.3, 1e-81, 0.0, 1e-12]), np.full(7, 3.0), np.ones(7)
    times[1], times[3], units[2] = 1e4, 0.01, 1e6
    brief, long, small, short, round_off, nothing, slow = np.asarray(sizes(speeds, times, units))
    np.testing.assert_allclose(brief, [0.3**2 / 10, 0.3, 0.3], rtol=1e-14)
    np.testing.assert_allclose([long, small / 1e6], [brief, brief], rtol=1e-14)
    np.testing.assert_allclose(short[0], 0.003, rtol=1e-14)
    np.testing.assert_array_equal(round_off, nothing)
    assert nothing[2] == 0 and nothing[0] > 0 and slow[2] > 0
