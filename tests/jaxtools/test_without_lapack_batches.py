"""On a CPU, LAPACK is called for one matrix at a time: in batches, and in derivatives of both modes."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax
import numpy as np
import pytest
from jax import lax

from lagjax.jaxtools.jaxpr import LAPACK
from lagjax.jaxtools.primitives import one_by_one
from tests.library_calls import batches_in, calls_in, text_of
from tests.tiers import exhaustive_but

RANDOM = np.random.default_rng(0)
A, B = RANDOM.normal(size=(5, 3, 3)) + 3 * np.eye(3), RANDOM.normal(size=(5, 3))


def by_lineax(a, b):
    """A solver that is hidden in a primitive of equinox's."""
    return lineax.linear_solve(lineax.MatrixLinearOperator(a), b, lineax.LU()).value


@jax.custom_vjp
def with_way_back(a, b):
    """Σ a² b, whose derivative has LAPACK in both passes though its values have none."""
    return jnp.sum(a**2) * b


def forward(a, b):
    """The values, and what the backward pass needs."""
    return with_way_back(a, b), (a, b, jnp.linalg.inv(a))


def backward(residuals, slope):
    """2 a b = 2 (a (a⁻¹ a) a⁻¹) a b, and Σ a²."""
    a, b, inverse = residuals
    return 2 * a @ jnp.linalg.solve(a, a) @ inverse @ a * jnp.sum(slope * b), jnp.sum(a**2) * slope


with_way_back.defvjp(forward, backward)
FUNCTIONS = {
    "solve": jnp.linalg.solve,
    "cholesky": lambda a, b: jnp.linalg.cholesky(a @ a.T) @ b,
    "eigh": lambda a, b: jnp.linalg.eigvalsh(a + a.T) * b,
    "eig": lambda a, b: jnp.linalg.eigvals(a).real * b,
    "svd": lambda a, b: jnp.linalg.svd(a, compute_uv=False) * b,
    "qr": lambda a, b: jnp.linalg.qr(a)[1] @ b,
    "rules of its own": lambda a, b: jnp.linalg.pinv(a) @ b + jnp.linalg.slogdet(a)[1],
    "triangular": jsl.solve_triangular,
    "tridiagonal": lambda a, b: lax.linalg.tridiagonal_solve(a[0].at[0].set(0), a[1] + 9, a[2], b[:, None])[:, 0],
    "lineax": by_lineax,
}
KINDS = {
    "batch": jax.vmap,
    "forward": lambda f: jax.vmap(jax.jacfwd(f)),
    "reverse": lambda f: jax.vmap(jax.grad(lambda *x: jnp.sum(jnp.sin(f(*x))))),
    "second": lambda f: jax.vmap(jax.jacfwd(jax.grad(lambda *x: jnp.sum(jnp.sin(f(*x)))))),
}
# The derivatives of eigenvectors of a general matrix are not known to JAX.
POSSIBLE = [(name, kind) for name in FUNCTIONS for kind in KINDS if (name, kind) != ("eig", "second")]
# The others, which contain them or are of another decomposition, are slow.
FAST = [(name, "batch") for name in FUNCTIONS if name not in ("lineax", "rules of its own")]
FAST += [("solve", "forward"), *((name, "reverse") for name in ("solve", "lineax", "rules of its own"))]
POSSIBLE_FAST = [x if x in FAST else pytest.param(*x, marks=pytest.mark.slow) for x in POSSIBLE]


@pytest.mark.parametrize("name, kind", POSSIBLE_FAST)
def test_no_batch_is_left(name, kind):
    """Rewritten outside of `vmap` and derivatives, or before them, a program has calls of LAPACK, each for one matrix.

    Twin: JAX's own program has batches of them.
    """
    function, transform = FUNCTIONS[name], KINDS[kind]
    assert batches_in(text_of(transform(function), A, B)) != []
    for rewritten in (one_by_one(transform(function)), transform(one_by_one(function))):
        text = text_of(rewritten, A, B)
        assert calls_in(text) != [] and batches_in(text) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(["solve", "lineax", "rules of its own"], FUNCTIONS))
def test_the_same_values(name):
    """They equal those of JAX's own program, which uses the same library, to round-off."""
    transforms = [KINDS[kind] for other, kind in POSSIBLE if other == name]
    function = FUNCTIONS[name]
    own = jax.jit(lambda a, b: [transform(function)(a, b) for transform in transforms])(A, B)
    outside = lambda a, b: [one_by_one(transform(function))(a, b) for transform in transforms]
    before = lambda a, b: [transform(one_by_one(function))(a, b) for transform in transforms]
    for rewritten in jax.jit(lambda a, b: (outside(a, b), before(a, b)))(A, B):
        for found, expected in zip(rewritten, own, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


def test_a_backward_pass_of_the_users():
    """LAPACK that only a backward pass calls is one matrix at a time too, however often rewritten; the slope is 2 a b.

    Twin: JAX's own program has batches.
    """
    slopes = lambda function: jax.jit(jax.vmap(jax.grad(lambda a, b: jnp.sum(function(a, b))))).lower(A, B)
    assert batches_in(slopes(with_way_back).as_text()) != []
    once = one_by_one(with_way_back)
    for function, factor in ((once, 1), (one_by_one(lambda a, b: once(a, 2 * b)), 2)):
        lowered = slopes(function)
        assert calls_in(lowered.as_text()) != [] and batches_in(lowered.as_text()) == []
        expected = 2 * factor * A * np.sum(B, axis=1)[:, None, None]
        np.testing.assert_allclose(lowered.compile()(A, B), expected, rtol=1e-12)
    # An operand that does not vary, and a result that is not used.
    both = one_by_one(lambda a, b: (with_way_back(a, 1.0), with_way_back(a, b)[0]))
    np.testing.assert_allclose(jax.jit(jax.grad(lambda a: both(a, B[0])[0]))(A[0]), 2 * A[0], rtol=1e-12)


def test_a_batch_of_solves_and_its_derivative():
    """x = A⁻¹ b and dx/db = A⁻¹ for each matrix, by NumPy's solve one by one; also for a batch of batches and none."""
    x = one_by_one(jax.vmap(jnp.linalg.solve))
    slope = jax.vmap(jax.jacrev(one_by_one(jnp.linalg.solve), argnums=1))
    all_of = jax.jit(lambda a, b, *two: (x(a, b), slope(a, b), jax.vmap(x)(*two), x(a[:0], b[:0])))
    once, slopes, twice, none = all_of(A, B, np.stack([A, 2 * A]), np.stack([B, B]))
    np.testing.assert_allclose(once, [np.linalg.solve(a, b) for a, b in zip(A, B)], rtol=1e-13)
    np.testing.assert_allclose(slopes, np.linalg.inv(A), rtol=1e-12)
    np.testing.assert_allclose(twice[1], np.asarray(once) / 2, rtol=1e-13)
    assert none.shape == (0, 3)


def test_on_a_gpu_the_batch_stays():
    """For another platform nothing is changed: one call takes the whole batch."""
    exported = jax.export.export(jax.jit(one_by_one(jax.vmap(jnp.linalg.cholesky))), platforms=["cuda"])
    assert "while" not in exported(A).mlir_module()
    exported = jax.export.export(jax.jit(one_by_one(jax.vmap(jnp.linalg.cholesky))), platforms=["cpu"])
    assert "while" in exported(A).mlir_module()


def test_any_number_of_matrices():
    """An exported program of any number of lanes has a loop as well."""
    (count,) = jax.export.symbolic_shape("n")
    like = jax.ShapeDtypeStruct((count, 3, 3), A.dtype)
    exported = jax.export.export(jax.jit(one_by_one(jax.vmap(jnp.linalg.inv))), platforms=["cpu"])(like)
    np.testing.assert_allclose(exported.call(A), np.linalg.inv(A), rtol=1e-12)


def test_every_decomposition_is_listed():
    """Each function of `jax.lax.linalg` that calls LAPACK is rewritten; twin: JAX's own batch of it is one call."""
    calls = {
        "cholesky": lax.linalg.cholesky, "eig": lax.linalg.eig, "eigh": lax.linalg.eigh, "lu": lax.linalg.lu,
        "hessenberg": lax.linalg.hessenberg, "schur": lax.linalg.schur, "svd": lax.linalg.svd, "qr": lax.linalg.qr,
        "geqp3": lambda a: lax.linalg.qr(a, pivoting=True), "tridiagonal": lax.linalg.tridiagonal,
        "householder_product": lambda a: lax.linalg.householder_product(a, a[0]),
        "triangular_solve": lambda a: lax.linalg.triangular_solve(a, a),
        "tridiagonal_solve": lambda a: lax.linalg.tridiagonal_solve(a[0], a[1], a[2], a),
    }  # fmt: skip
    for name, call in calls.items():
        assert batches_in(text_of(jax.vmap(call), A)) != [], name
        assert batches_in(text_of(one_by_one(jax.vmap(call)), A)) == [], name
    # Two are part of others.
    assert set(LAPACK) - set(calls) == {"geqrf", "ormqr"}
