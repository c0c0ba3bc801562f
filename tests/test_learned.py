"""The tools for learned Lagrangians, and the pitfalls that they avoid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.learned import Network, disagreement, positive_definite, same_motion

HARD = [np.zeros(6), np.full(6, -800.0), np.full(6, 50.0), np.array([-1e8, 0.0, 3.0, -5.0, 2.0, 1.0])]
SIZES = np.array([1.0, 4.0, 0.25])
curvatures = jax.jit(jax.hessian(lambda x: jnp.sum(positive_definite(x, SIZES, floor=1e-3))))


@pytest.mark.parametrize("numbers", HARD, ids=range(len(HARD)))
def test_no_direction_is_without_mass(numbers):
    """Relative to the sizes no eigenvalue is below the floor, whatever the numbers; slopes are finite."""
    scaled = np.asarray(positive_definite(numbers, SIZES, floor=1e-3)) / np.sqrt(SIZES[:, None] * SIZES[None, :])
    size = np.max(np.abs(scaled))
    assert np.min(np.linalg.eigvalsh(scaled)) > 1e-3 - 1e-14 * size
    assert np.all(np.isfinite(curvatures(numbers)))


def test_the_diagonal_is_the_formula():
    """(x + √(x² + 4))/2 and its second derivative 2/(x² + 4)^(3/2), also where the sum is only round-off."""
    root = lambda x: jnp.sqrt(positive_definite(x, floor=0.0)[0, 0])
    x = np.array([-1e8, -3.0, 0.0, 2.0, 1e6])
    exact = np.where(x > 0, (x + np.hypot(x, 2)) / 2, 2 / (np.hypot(x, 2) - x))
    np.testing.assert_allclose(jax.vmap(root)(x), exact, rtol=1e-14)
    x = np.array([-30.0, -1.0, 0.0, 5.0])
    found = jax.jit(jax.vmap(jax.grad(jax.grad(root))))(x)
    np.testing.assert_allclose(found, 2 / (x**2 + 4) ** 1.5, rtol=1e-6)


def _explained(matrix):
    """What `lj.explain` says of ½ v·M(q)·v - V(q) with a network in each, by the label of its line."""
    one, other = jax.random.split(jax.random.key(0))
    narrow = {"width": 6, "depth": 1}
    params = {"mass": Network(jnp.ones(2), key=one, out=3, **narrow), "potential": Network(jnp.ones(2), key=other)}
    system = lj.System(lambda t, q, v, p: 0.5 * v @ matrix(p["mass"](q), v) @ v - p["potential"](q))
    return dict(lj.explain(system, 0.0, jnp.array([0.3, 0.2]), jnp.array([1.0, 0.0]), params).rows)


def test_what_is_said_of_a_learned_mass_matrix():
    """M(q) by `positive_definite` depends on q alone and has no jump, at which steps would end and derivatives wait."""
    said = _explained(lambda numbers, v: positive_definite(numbers))
    assert said["mass matrix"] == "positive definite, dense, depends on q[0], q[1]"
    assert "jumps and kinks" not in said


def test_what_is_said_of_one_that_sees_velocities():
    """Twin: a matrix that depends on v is said to, and a diagonal made by a comparison is one."""
    said = _explained(lambda numbers, v: positive_definite(numbers + 0.1 * v[0] ** 2))
    assert said["mass matrix"].endswith("depends on q[0], q[1], velocities")
    by_comparison = lambda numbers, v: jnp.diag(jnp.where(numbers[:2] > 0, 1 + numbers[:2], 1 / (1 - numbers[:2])))
    said = _explained(by_comparison)
    assert said["mass matrix"].endswith("depends on q[0], q[1]") and "comparison" in said["jumps and kinks"]


def test_a_plain_square_becomes_singular():
    """Twin: with a free diagonal the mass matrix Λ Λᵀ of a training that passes zero has no inverse."""
    plain = lambda x: jnp.array([[x[0], 0.0], [x[2], x[1]]]) @ jnp.array([[x[0], x[2]], [0.0, x[1]]])
    state = (0.0, jnp.zeros(2), jnp.ones(2), jnp.array([0.0, 1.0, 0.5]))
    of = lambda matrix: lj.System(lambda t, q, v, x: 0.5 * v @ matrix(x) @ v - jnp.sum(q))
    with pytest.raises(ValueError, match="singular"):
        lj.accelerations(of(plain), *state)
    assert np.all(np.isfinite(lj.accelerations(of(positive_definite), *state)[0]))


def test_damping_never_pushes():
    """With R = ½ vᵀ D(q) v the power -v·∂R/∂v is never positive; twin: with a D of v, R > 0 as well, it may push."""
    matrix = lambda x: positive_definite(jnp.array([x[0], -x[1], x[0] * x[1]]), floor=0.0)
    power = lambda D: jax.jit(jax.vmap(lambda q, v: -v @ jax.grad(lambda v: 0.5 * v @ D(q, v) @ v)(v)))
    q, v = np.random.default_rng(0).normal(size=(2, 200, 2)) * 2
    assert np.max(power(lambda q, v: matrix(q))(q, v)) <= 0
    assert np.max(power(lambda q, v: matrix(q) / (1 + (v @ v) ** 2))(q, v)) > 0.01


def test_wrong_counts():
    """Two numbers do not make a symmetric matrix; neither do zero numbers."""
    for count in (0, 2, 4):
        with pytest.raises(ValueError, match=r"n\(n\+1\)/2 numbers"):
            positive_definite(np.zeros(count))


def test_an_angle_comes_back():
    """After a turn the network is the same; twin: one of the angle itself is not. It is zero at first."""
    sizes, at = {"angle": 1.0, "height": 50.0}, {"angle": 0.3, "height": 20.0}
    turned = at | {"angle": 0.3 + 2 * np.pi}
    made = lambda **options: Network(sizes, key=jax.random.key(0), **options)
    net, plain = made(angles="angle", first=1.0), made(first=1.0)
    np.testing.assert_allclose(net(at), net(turned), rtol=1e-13)
    assert abs(plain(at) - plain(turned)) > 0.01
    assert made()(at) == 0
    assert made(out=3)(at).shape == (3,)
    # Scaled heights: a tanh of a hundred would have no slope.
    slopes = jax.grad(net)(at)
    assert abs(slopes["height"]) > 1e-4
    # A fit changes only the weights.
    of_mlp = sum(x.size for x in jax.tree.leaves(net.mlp) if hasattr(x, "size"))
    assert sum(x.size for x in jax.tree.leaves(net) if hasattr(x, "size")) == of_mlp


def test_activations_need_curvature():
    """relu has none, elu jumps, log(1 + exp x) overflows; smooth ones, softplus far out as well, pass."""
    made = lambda activation: Network(1.0, key=jax.random.key(0), activation=activation)
    for wrong, words in (
        (jax.nn.relu, "zero, or jumps"),
        (jax.nn.elu, "zero, or jumps"),
        (lambda x: jnp.log(1 + jnp.exp(x)), "no finite curvature at 1000"),
    ):
        with pytest.raises(ValueError, match=words):
            made(wrong)
    for right in (jnp.tanh, jax.nn.softplus, jax.nn.silu, jax.nn.gelu, jnp.sin):
        made(right)


def test_other_mistakes():
    """Errors for sizes, names and calls."""
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="must be positive"):
        Network({"x": 0.0}, key=key)
    with pytest.raises(ValueError, match="angles names 'y', but the coordinates are 'x'"):
        Network({"x": 1.0}, angles="y", key=key)
    with pytest.raises(ValueError, match="takes 2 numbers, but was given 3"):
        Network(np.ones(2), key=key)(np.ones(3))
    with pytest.raises(ValueError, match="nothing to disagree"):
        disagreement(swing, [None], np.zeros(2), np.zeros(2))


swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
Q, V = np.linspace(-1.0, 1.0, 7), np.linspace(2.0, -1.0, 7)


def test_same_motion():
    """3 L + dF/dt has the same motion; twin: another potential has not, and the result says where."""
    other = lambda L: same_motion(swing, lj.System(L), Q, V)
    gauge = lambda t, q, v, params: (
        3 * (0.5 * v**2 + jnp.cos(q)) + v * jnp.exp(q) * jnp.cos(t) - jnp.exp(q) * jnp.sin(t)
    )
    assert other(gauge).same and abs(other(gauge).ratio - 3) < 1e-12
    assert abs(gauge(0.0, 0.5, 1.0, None) - swing.lagrangian(0.0, 0.5, 1.0, None)) > 1
    wrong = other(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q) + 1e-3 * q**4)
    assert not wrong.same and wrong.worst in (0, 6) and "NO" in repr(wrong)
    nan = other(lambda t, q, v, params: 0.5 * v**2 + jnp.sqrt(q))
    assert not nan.same


def test_other_lagrangians_of_the_same_motion():
    """For free motion v⁴ is as good as v², but their mass matrices are not proportional."""
    free = lj.System(lambda t, q, v, params: 0.5 * v**2)
    quartic = lj.System(lambda t, q, v, params: v**4)
    found = same_motion(free, quartic, Q, V + 3)
    assert found.same and np.isnan(found.ratio) and "not proportional" in repr(found)
