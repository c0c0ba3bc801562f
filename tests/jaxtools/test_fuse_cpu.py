"""A program as one machine function: same results and derivatives, and compiled in this way only where XLA can."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun

import lagjax.jaxtools.fuse as one_function_module
from lagjax.jaxtools.fuse import (
    ONE_KERNEL,
    calls_host,
    fits,
    kept_as_call,
    one_function,
    without_checks,
    without_library,
)
from lagjax.jaxtools.tracing import is_plain

pytestmark = [
    pytest.mark.optimised,
    pytest.mark.skipif(is_plain(), reason="LAGJAX_PLAIN: no program is compiled as one function"),
]


def grown(x, y):
    """A loop over numbers whose length depends on them."""
    return lax.while_loop(lambda s: s[0] < 100.0, lambda s: (1.5 * s[0] + s[1], jnp.sin(s[0]) + s[1]), (x, y))


def entry(function, *args):
    """The outermost part of a compiled program."""
    text = jax.jit(function).lower(*args).compile().as_text()
    return text[text.index("ENTRY") :]


whole = lambda x, y: one_function(grown, x, y)
TWO = 2.0, 0.3


def both(one, plain, *args):
    """What two functions give, in one program."""
    return jax.tree.map(np.asarray, jax.jit(lambda *args: (one(*args), plain(*args)))(*args))


def test_same_results_and_derivatives():
    """Value and forward derivative are those of the function; reverse mode raises."""
    found, expected = both(*(lambda *x, f=f: (f(*x), jax.jacfwd(f)(*x)) for f in (whole, grown)), *TWO)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-14)
    with pytest.raises(ValueError, match="Linearization failed"):
        jax.make_jaxpr(jax.grad(lambda x: one_function(lambda x: x**3, x)))(TWO[0])


@pytest.mark.parametrize("block", [4, *(pytest.param(block, marks=pytest.mark.slow) for block in (2, 256))])
def test_lanes_in_blocks(monkeypatch, block):
    """A batch, and a batch of batches, of lanes of different lengths, in blocks that they fill and do not fill."""
    monkeypatch.setattr(one_function_module, "TOGETHER", block)
    in_blocks = lambda x, y: one_function(grown, x, y, in_blocks=True)
    lanes = lambda f: jax.vmap(f, (0, None))
    of_lanes = lambda x, y: (lanes(in_blocks)(x, y), jax.vmap(lanes(in_blocks), (None, 0))(x, jnp.stack([y, y])))
    (once, nested), expected = both(of_lanes, lanes(grown), np.linspace(1.0, 50.0, 6), TWO[1])
    np.testing.assert_allclose(once, expected, rtol=1e-14)
    np.testing.assert_allclose(nested[0][1], expected[0], rtol=1e-14)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="one function is for CPUs")
def test_compiled_as_one_call():
    """The loop is inside the marked call; a program without marks, or with a library call, has none."""
    marked = entry(whole, *TWO)
    assert 'inlineable="false"' in marked and "while(" not in marked
    assert 'inlineable="false"' not in entry(grown, *TWO)
    solve = lambda a: one_function(lambda a: jnp.linalg.solve(a, a[0]), a)
    assert 'inlineable="false"' not in entry(solve, np.eye(9))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="one function is for CPUs")
def test_in_parts():
    """Only the part that asks for it is one function, not the loop around it; values, derivatives and lanes stay."""

    def in_turn(x, y):
        step = lambda s: one_function(lambda a, b: (1.5 * a + b, jnp.sin(a) + b), *s)
        return lax.while_loop(lambda s: s[0] < 100.0, step, (x, y))

    def outermost(function):
        text = jax.jit(function).lower(*TWO).as_text()
        return text[: text.index("func.func private")]

    parts = lambda x, y: one_function(in_turn, x, y, in_parts=True)
    assert "stablehlo.while" in outermost(parts) and "stablehlo.while" not in outermost(whole)
    loop = outermost(parts).index("stablehlo.while")
    assert outermost(parts).index('inlineable = "false"') > loop
    all_of = lambda f: lambda x, y, lanes: (f(x, y), jax.jacfwd(f)(x, y), jax.vmap(f, (0, None))(lanes, y))
    for found, expected in zip(*both(all_of(parts), all_of(grown), *TWO, np.linspace(1.0, 5.0, 3))):
        np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_operands_that_are_not_needed():
    """An unused operand, and one that XLA finds to be unused: either would end the process if it were dropped."""
    never = jax.jit(lambda x, y: one_function(lambda x, y: 2 * x, x, y))
    found_out = jax.jit(lambda x, y: one_function(lambda x, y: jnp.where(jnp.asarray(1.0) > 0, 2 * x, y), x, y))
    assert never(*TWO) == found_out(*TWO) == 4.0


def test_checks_are_left_out_where_they_are_known_to_pass():
    """`error_if` calls the host; without it the program fits, and gives the same result."""

    def checked(x):
        return 3 * eqx.error_if(x, x < 0, "negative")

    program = jax.make_jaxpr(checked)(TWO[0])
    assert not fits(program.jaxpr) and fits(without_checks(program).jaxpr)
    assert one_function(checked, TWO[0], checked=True) == 6.0
    with pytest.raises(Exception, match="negative"):
        jax.block_until_ready(jax.jit(lambda x: one_function(checked, x))(-TWO[0]))


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x: jnp.sort(x), False),
        (lambda x: jnp.sum(jnp.outer(x, x) @ x), True),
        (lambda x: jnp.sum(jnp.tile(x, 1000)), False),
        (lambda x: jnp.outer(x, x) @ x, True),
        (lambda x: jnp.outer(x, x) @ jnp.outer(x, x), True),
        (lambda x: jnp.outer(jnp.tile(x, 4), x) @ jnp.outer(x, jnp.tile(x, 50)), False),
        (lambda x: x.at[2].set(1.0), True),
        (lambda x: x.at[np.array([0, 2])].add(1.0), True),
        (lambda x: x.at[np.array([0, 2])].set(1.0), False),
        (lambda x: jax.pure_callback(lambda x: x, x, x), False),
        (lambda x: lax.scan(lambda c, x: (c + x, jnp.linalg.cholesky(jnp.eye(3) * c)), x[0], x)[1], False),
    ],
)
def test_what_fits(function, expected):
    """Library calls, large reductions and general scatters do not fit, nor inside a loop."""
    assert fits(without_library(jax.make_jaxpr(function)(np.arange(5.0))).jaxpr) is expected


def test_products_of_matrices():
    """Sums of multiplications replace library products, whatever is contracted; several products share an operand."""
    rng = np.random.default_rng(0)
    args = [rng.normal(size=shape) for shape in ((3, 4, 5), (5, 3, 4, 2), (3, 5, 6))]

    def products(a, b, c, xp=jnp):
        sums = (("ijk,kilm->jlm", b), ("ijk,kijm->im", b), ("ijk,ikm->ijm", c), ("ijk,ikm->mji", c))
        squares = [product for x in a[:2] for product in (x @ x.T, x.T @ x)]
        return [*(xp.einsum(text, a, other) for text, other in sums), *squares, a[0, :, :0] @ c[0, :0]]

    assert fits(without_library(jax.make_jaxpr(products)(*args)).jaxpr)
    found = jax.jit(lambda *x: one_function(products, *x))(*args)
    for mine, plain in zip(found, products(*args, xp=np), strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-13, atol=1e-13)


def test_entries_added_at_many_places():
    """Derivatives of `q[i]`, in rows, columns and lanes, with places that repeat or lie outside, fit as sums."""
    i, outside = np.array([0, 2, 2, 1, 2]), np.array([0, 7, -1])
    q, t = np.arange(6.0).reshape(3, 2) ** 2, np.arange(12.0).reshape(4, 3)

    def derivatives(q, t):
        of_rows = jax.grad(lambda q: jnp.sum(jnp.sin(q[i] * jnp.arange(1.0, 6.0)[:, None])))
        of_columns = jax.grad(lambda t: jnp.sum(jnp.cos(t[:, i] ** 2 * jnp.arange(1.0, 6.0)[None])))
        lanes = jax.vmap(jax.grad(lambda x: jnp.sum(jnp.sin(x[i] * jnp.arange(1.0, 6.0)))))
        ones = jnp.ones((3, 2))
        dropped, clipped = (q.at[outside].add(ones, mode=mode) for mode in ("drop", "clip"))
        return of_rows(q), of_columns(t), lanes(t), dropped, clipped

    program = jax.make_jaxpr(derivatives)(q, t)
    assert not fits(program.jaxpr) and fits(without_library(program).jaxpr)
    for mine, plain in zip(*both(lambda *x: one_function(derivatives, *x), derivatives, q, t)):
        np.testing.assert_allclose(mine, plain, rtol=1e-14, atol=1e-14)


def test_a_linear_solve_of_functions():
    """Its programs are in a named tuple, which the rewriting keeps."""

    def solve(x):
        return lax.custom_linear_solve(lambda y: 3 * y, x, lambda _, b: b / 3, symmetric=True)

    np.testing.assert_allclose(jax.jit(lambda x: one_function(solve, x))(TWO[0]), 2 / 3, rtol=1e-15)


def test_what_is_no_check_stays():
    """A host call that computes something stays; only one that does nothing but raise is left out."""
    host = lambda x: jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((), jnp.float64), x)
    works = jax.make_jaxpr(lambda x: lax.cond(x > 0, host, lambda x: x, x))(TWO[0])
    assert calls_host(without_checks(works).jaxpr) and jaxpr_as_fun(without_checks(works))(TWO[0])[0] == 4.0
    check = jax.make_jaxpr(lambda x: eqx.error_if(x, x < 0, "negative"))(TWO[0])
    assert calls_host(check.jaxpr) and not calls_host(without_checks(check).jaxpr)


@pytest.mark.parametrize("size", [1251, *(pytest.param(size, marks=pytest.mark.slow) for size in (1, 1000, 5000))])
def test_large_arrays_that_are_known(size):
    """Arrays closed over, captured or made inside: above 10 kB XLA ended the process."""
    known = np.linspace(0.0, 1.0, size)

    def looked_up(x, table):
        return lax.while_loop(lambda s: s < 100.0, lambda s: 3 * s + (table - s)[s.astype(int) % size], x)

    closed = lambda x: one_function(looked_up, x, jnp.asarray(known))
    captured = lambda x: one_function(lambda x: looked_up(x, jnp.asarray(known)), x)
    made = lambda x: one_function(lambda x: looked_up(x, jnp.linspace(0.0, 1.0, size)), x)
    program = jax.jit(lambda x: (closed(x), captured(x), made(x), looked_up(x, known))).lower(2.0).compile()
    assert len(re.findall(r' call\(.*inlineable="false"', program.as_text())) == 3
    *found, expected = program(2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def layer(x, w):
    """Two products with a matrix, done twice in a loop."""
    return lax.while_loop(lambda s: s[0] < 2, lambda s: (s[0] + 1, jnp.tanh(w.T @ (w @ s[1]))), (0, x))[1]


def test_products_of_many_multiplications():
    """Around 4,096 multiplications, where XLA may take a sum for a library product, which must not occur."""
    rng, square = np.random.default_rng(0), lambda a: a @ a @ a.T
    layers = [(rng.normal(size=size), rng.normal(size=(size, size)) / size) for size in (64, 65)]
    squares = [rng.normal(size=(9, 9)) for _ in layers]
    found = jax.jit(
        lambda layers, squares: ([one_function(layer, *x) for x in layers], [one_function(square, a) for a in squares])
    )(layers, squares)
    for one, (x, w) in zip(found[0], layers):
        np.testing.assert_allclose(one, np.tanh(w.T @ (w @ np.tanh(w.T @ (w @ x)))), rtol=1e-12, atol=1e-14)
    for one, a in zip(found[1], squares):
        np.testing.assert_allclose(one, square(a), rtol=1e-12, atol=1e-12)


def test_a_checkpoint_is_looked_into():
    """A checkpoint holds its program in another way; products in it are replaced too."""
    w = np.random.default_rng(0).normal(size=(9, 9))
    inside = jax.checkpoint(lambda x: w @ x)
    program = without_library(jax.make_jaxpr(inside)(w[0]))
    assert fits(program.jaxpr) and "dot_general" not in str(program)
    one = jax.jit(lambda x: one_function(inside, x))(w[0])
    np.testing.assert_allclose(one, w @ w[0], rtol=1e-14)


def test_products_of_mixed_kinds():
    """Integers, booleans and lower precision times float64, as `@` passes them."""
    x, kinds = np.arange(1.0, 4.0), (2 * np.eye(3, dtype=int), np.eye(3, dtype=bool), np.eye(3, dtype=np.float32) / 3)
    found = jax.jit(lambda x: [one_function(lambda x: jnp.asarray(matrix) @ x, x) for matrix in kinds])(x)
    for one, matrix in zip(found, kinds, strict=True):
        assert one.dtype == x.dtype
        np.testing.assert_allclose(one, np.asarray(matrix, float) @ x, rtol=1e-15)


def branches(x, count=12):
    """Branches in a row, none of them in a loop, since XLA may choose a loop by itself."""
    for i in range(count):
        x = jnp.sin(x) + lax.cond(x > i, lambda x: x, lambda x: 2 * x, x)
    return x


def kernels(function, folder):
    """How many pieces of machine code XLA makes of a function of one number, and the compiled program."""
    lowered = jax.jit(function).lower(2.0)
    compiled = lowered.compile(compiler_options={"xla_dump_to": str(folder)})
    return len(list(folder.glob("*.obj-file.*"))), compiled


def test_one_kernel(tmp_path):
    """A program compiled as one function is one kernel, with the same result; plainly compiled it is many."""
    one, compiled = kernels(lambda x: one_function(branches, x), tmp_path / "one")
    many, plain = kernels(branches, tmp_path / "many")
    assert one == 1 and many > 10
    np.testing.assert_allclose(compiled(2.0), plain(2.0), rtol=1e-14)


@pytest.mark.parametrize("mark", ONE_KERNEL)
def test_each_mark_is_needed(monkeypatch, tmp_path, mark):
    """Twin: with either mark misspelt the same program is many kernels."""
    misspelt = {f"{name}_" if name == mark else name: value for name, value in ONE_KERNEL.items()}
    monkeypatch.setattr(one_function_module, "ONE_KERNEL", misspelt)
    assert kernels(lambda x: one_function(branches, x), tmp_path)[0] > 10


def test_a_call_stays_one():
    """A marked call stays a call in the compiled program; twin: without the mark it is inlined."""

    def twice(mark):
        part = jax.jit(lambda x: (branches(x, 3), x))
        return lambda x: branches(mark(part(x))[0], 3) + mark(part(x + 1))[0]

    calls = lambda mark: jax.jit(twice(mark)).lower(2.0).compile().as_text().count(" call(")
    assert calls(kept_as_call) == 2 and calls(lambda results: results) == 0


def test_the_derivative_of_a_branch_fits():
    """In reverse mode a branch leaves what the other one would keep empty, which is no reason against one function."""
    branch = lambda s, _: (lax.cond(s > 0, jnp.sin, lambda s: 2 * s**3 * jnp.exp(s), s), None)
    program = jax.make_jaxpr(jax.grad(lambda x: lax.scan(branch, x, None, 3)[0]))(1.0)
    assert "empty" in str(program) and fits(program.jaxpr)
