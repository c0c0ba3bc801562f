"""The tools for learned Lagrangians, and the pitfalls that they avoid."""

from contextlib import nullcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import lagjax as lj
from lagjax.integrate import found as jumps_found
from lagjax.learned import Network, _check_activation, disagreement, positive_definite, same_motion
from lagjax.mechanics.structure import structure
from lagjax.system import coordinates
from lagjax.system.model import model_of

SIZES = np.array([1.0, 4.0, 0.25])
HARD = np.array([[0.0] * 6, [-800.0] * 6, [50.0] * 6, [-1e8, 0.0, 3.0, -5.0, 2.0, 1.0]])


def test_no_direction_is_without_mass():
    """Relative to the sizes no eigenvalue is below the floor, whatever the numbers; slopes are finite. Twin: one of
    Λ Λᵀ with a free diagonal is zero where a training passes zero."""
    of = lambda x: positive_definite(x, SIZES, floor=1e-3)
    made, curvatures = jax.jit(jax.vmap(lambda x: (of(x), jax.hessian(lambda x: jnp.sum(of(x)))(x))))(HARD)
    scaled = np.asarray(made) / np.sqrt(SIZES[:, None] * SIZES[None, :])
    least, size = np.linalg.eigvalsh(scaled).min(axis=1), np.abs(scaled).max(axis=(1, 2))
    assert np.all(least > 1e-3 - 1e-14 * size) and np.all(np.isfinite(curvatures))
    free = np.array([[0.0, 0.0], [0.5, 1.0]])
    assert np.linalg.eigvalsh(free @ free.T)[0] == 0


def test_the_diagonal_is_the_formula():
    """(x + √(x² + 4))/2 and its second derivative 2/(x² + 4)^(3/2), also where the sum is only round-off."""
    root = lambda x: jnp.sqrt(positive_definite(x, floor=0.0)[0, 0])
    x = np.array([-1e8, -30.0, -3.0, -1.0, 0.0, 2.0, 5.0, 1e6])
    found, curved = jax.jit(jax.vmap(lambda x: (root(x), jax.grad(jax.grad(root))(x))))(x)
    exact = np.where(x > 0, (x + np.hypot(x, 2)) / 2, 2 / (np.hypot(x, 2) - x))
    np.testing.assert_allclose(found, exact, rtol=1e-14)
    near = np.abs(x) < 100
    np.testing.assert_allclose(curved[near], (2 / (x**2 + 4) ** 1.5)[near], rtol=1e-6)


COMPARED = lambda numbers, v: jnp.diag(jnp.where(numbers[:2] > 0, 1 + numbers[:2], 1 / (1 - numbers[:2])))


@pytest.mark.parametrize(
    ("matrix", "depends", "comparison"),
    [
        (lambda numbers, v: positive_definite(numbers), ("q[0]", "q[1]"), False),
        (lambda numbers, v: positive_definite(numbers + 0.1 * v[0] ** 2), ("q[0]", "q[1]", "velocities"), False),
        (COMPARED, ("q[0]", "q[1]"), True),
    ],
)
def test_what_is_said_of_a_learned_mass_matrix(matrix, depends, comparison):
    """M(q) by `positive_definite` depends on q alone and has no jump, at which steps would end and derivatives wait.

    Twins: a matrix that depends on v is said to, and a diagonal made by a comparison is one.
    """
    numbers = lambda q: jnp.stack([jnp.sin(q[0]), q[0] * q[1], jnp.cos(q[1])])
    system = lj.System(lambda t, q, v, p: 0.5 * v @ matrix(numbers(q), v) @ v)
    s = coordinates.state(0.0, np.array([0.3, 0.2]), np.array([1.0, 0.0]), None)
    model = model_of(system, *s)
    jumps, said = jumps_found(model, s), structure(model)
    assert said is not None and said.mass_depends_on == depends
    assert ("comparison" in "".join(jumps.in_words() if jumps else [])) == comparison


def test_damping_never_pushes():
    """With R = ½ vᵀ D(q) v the power -v·∂R/∂v is never positive; twin: with a D of v, R > 0 as well, it may push."""
    matrix = lambda x: positive_definite(jnp.array([x[0], -x[1], x[0] * x[1]]), floor=0.0)
    power = lambda D, q, v: -v @ jax.grad(lambda v: 0.5 * v @ D(q, v) @ v)(v)
    of_both = lambda q, v: [
        power(D, q, v) for D in (lambda q, v: matrix(q), lambda q, v: matrix(q) / (1 + (v @ v) ** 2))
    ]
    q, v = np.random.default_rng(0).normal(size=(2, 200, 2)) * 2
    never, may = jax.jit(jax.vmap(of_both))(q, v)
    assert np.max(never) <= 0 and np.max(may) > 0.01


def test_an_angle_comes_back():
    """After a turn the network is the same; twin: one of the angle itself is not. It is zero at first."""
    sizes, at = {"angle": 1.0, "height": 50.0}, {"angle": 0.3, "height": 20.0}
    made = lambda **options: Network(sizes, key=jax.random.key(0), **options)

    @jax.jit
    def numbers(at, turned):
        net, plain = made(angles="angle", first=1.0), made(first=1.0)
        others = made()(at), made(out=3)(at)
        # Scaled heights: a tanh of a hundred would have no slope.
        return net(at), net(turned), plain(at), plain(turned), *others, jax.grad(net)(at)["height"]

    one, same, plain, other, zero, three, slope = numbers(at, at | {"angle": 0.3 + 2 * np.pi})
    np.testing.assert_allclose(one, same, rtol=1e-13)
    assert abs(float(plain) - float(other)) > 0.01 and abs(float(slope)) > 1e-4
    assert float(zero) == 0 and three.shape == (3,)
    # A fit changes only the weights.
    net = eqx.filter_eval_shape(made)
    of_mlp, of_all = (sum(x.size for x in jax.tree.leaves(tree) if hasattr(x, "size")) for tree in (net.mlp, net))
    assert of_mlp == of_all > 0


@pytest.mark.parametrize(
    ("activation", "words"),
    [
        (jax.nn.relu, "zero, or jumps"),
        (jax.nn.elu, "zero, or jumps"),
        (lambda x: jnp.log(1 + jnp.exp(x)), "no finite curvature at 1000"),
        (jnp.tanh, None),
        (jax.nn.softplus, None),
    ],
)
def test_activations_need_curvature(activation, words):
    """relu has none, elu jumps, log(1 + exp x) overflows; smooth ones, softplus far out as well, pass."""
    with pytest.raises(ValueError, match=words) if words else nullcontext():
        _check_activation(activation)


def test_mistakes():
    """Errors for sizes, names, calls and counts: two numbers make no symmetric matrix, nor do none."""
    key = jax.random.key(0)
    for act, words in (
        (lambda: Network({"x": 0.0}, key=key), "must be positive"),
        (lambda: Network({"x": 1.0}, angles="y", key=key), "angles names 'y', which is no coordinate; there is 'x'"),
        (lambda: Network(np.ones(2), key=key)(np.ones(3)), "takes 2 numbers, but was given 3"),
        (lambda: disagreement(swing, [None], np.zeros(2), np.zeros(2)), "nothing to disagree"),
        *((lambda n=n: positive_definite(np.zeros(n)), r"n\(n\+1\)/2 numbers") for n in (0, 2, 4)),
    ):
        with pytest.raises(ValueError, match=words):
            act()


swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
Q, V = np.linspace(-1.0, 1.0, 7), np.linspace(2.0, -1.0, 7)


def test_same_motion():
    """3 L + dF/dt has the same motion; twin: another potential has not, and the result says where."""
    other = lambda L: same_motion(swing, lj.System(L), Q, V)
    plain = swing.lagrangian
    gauge = lambda t, q, v, p: 3 * plain(t, q, v, p) + v * jnp.exp(q) * jnp.cos(t) - jnp.exp(q) * jnp.sin(t)
    same, wrong = other(gauge), other(lambda t, q, v, p: plain(t, q, v, p) + 1e-3 * q**4)
    assert same.same and abs(same.ratio - 3) < 1e-12
    assert abs(gauge(0.0, 0.5, 1.0, None) - plain(0.0, 0.5, 1.0, None)) > 1
    assert not wrong.same and wrong.worst in (0, 6) and "NO" in repr(wrong)
    assert not other(lambda t, q, v, p: 0.5 * v**2 + jnp.sqrt(q)).same
    # For free motion v⁴ is as good as v², but their mass matrices are not proportional.
    free, quartic = lj.System(lambda t, q, v, params: 0.5 * v**2), lj.System(lambda t, q, v, params: v**4)
    found = same_motion(free, quartic, Q, V + 3)
    assert found.same and np.isnan(found.ratio) and "not proportional" in repr(found)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lagjax.FitWarning")
def test_a_missing_force_is_found_from_unfitted_starts():
    """The recipe of `docs/learned.md` on its bead, whose friction L lacks; twin: with the starts of the windows fitted
    first, and the rate that the page had for them, they absorb most of that force."""
    known = lambda t, q, v, p: 0.5 * v**2 + 0.5 * jnp.sin(q) ** 2 + 2.0 * jnp.cos(q)
    friction = lambda q, v: -0.4 * v * (1 + jnp.cos(q))
    truth = lj.System(known, force=lambda t, q, v, p: friction(q, v))
    system = lj.System(known, force=lambda t, q, v, p: p["force"]((q, v)))
    random, ts, steps = np.random.default_rng(0), np.linspace(0.0, 4.0, 81), 200
    starts = random.uniform([-1.5, -2.0], [1.5, 2.0], (36, 2))
    moved = lambda q, v: (lambda traj: (traj.q, traj.v))(lj.integrate(truth, q, v, ts=ts))
    q, v = map(np.asarray, jax.jit(jax.vmap(moved))(*starts.T))
    records = [lj.Record(ts, q=x + 0.01 * random.normal(size=len(ts)), sigma=0.01) for x in q[:30]]
    params = {"force": Network((1.0, 2.0), key=jax.random.key(1), width=32, depth=2)}
    cut = {"window": 1.0, "joined": False, "rtol": 1e-6, "atol": 1e-6}
    loss = lj.fit_loss(system, records, params, **cut)
    adam: Any = optax.scale_by_adam()

    @jax.jit
    def train(unknowns, rate):
        def step(carry, given):
            (unknowns, state), (key, decay) = carry, given
            batch = jax.random.choice(key, loss.windows, (32,), replace=False)
            changes, state = adam.update(jax.grad(loss)(unknowns, batch), state, unknowns)
            by = {"params": 2e-2 * decay, "starts": rate * decay}
            moved = {part: jax.tree.map(lambda x, c: x - by[part] * c, unknowns[part], changes[part]) for part in by}
            return (moved, state), None

        keys = jax.random.split(jax.random.split(jax.random.key(0))[0], steps)
        decay = 0.5 * (1 + jnp.cos(jnp.pi * jnp.arange(steps) / steps))
        return jax.lax.scan(step, (unknowns, adam.init(unknowns)), (keys, decay))[0][0]

    def missed(unknowns):
        found: Any = loss.params(unknowns)
        force = jax.vmap(lambda q, v: found["force"]((q, v)))(q[30:].ravel(), v[30:].ravel())
        true = friction(q[30:].ravel(), v[30:].ravel())
        return np.sqrt(np.mean((force - true) ** 2) / np.mean(true**2))

    first = lj.fit(system, records, params, free=[], progress=False, **cut).sampling["starts"]
    assert missed(train(loss.guess, 2e-3)) < 0.25
    assert missed(train(loss.guess | {"starts": jnp.asarray(first)}, 5e-3)) > 0.45
