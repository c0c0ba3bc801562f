"""Derivatives and lanes from Python: what JAX gives, each in one program; and JAX's own way for the rest."""

import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools import Said, columns, from_python, outlined, rebuilt
from tests.tiers import exhaustive_but

X, Y = jnp.array([0.3, -0.7, 1.1]), jnp.asarray(2.0)
SAID = Said(lambda: [], lambda tree: outlined(tree, {}), lambda outline, arrays: rebuilt(outline, {}))


def of(total, x, count):
    """Results of several kinds; LAPACK is called for some."""
    solved = jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(x.size), x)
    return {"total": total, "count": count, "energy": jnp.sum(total**2) + solved[0]}


def reference(x, y):
    """What JAX can differentiate in both modes."""
    total = x
    for _ in range(4):
        total = total + jnp.sin(x * y) * total
    return of(total, x, 4)


def in_a_loop(arrays):
    """The same in a loop of unknown length, which has forward derivatives only."""
    x, y, n = arrays
    turn = lambda s: (s[0] + 1, s[1] + jnp.sin(x * y) * s[1])
    count, total = jax.lax.while_loop(lambda s: s[0] < n, turn, (0, x))
    return of(total, x, count)


def ours(x, y, function=in_a_loop):
    """The same from Python."""
    arrays = [jnp.asarray(x), jnp.asarray(y), jnp.asarray(4)]
    found = from_python(function, SAID, function, arrays)
    return function(arrays) if found is None else found


@pytest.fixture(autouse=True)
def off(monkeypatch):
    """Nothing is kept: what these programs mean is not said."""
    monkeypatch.setenv("LAGJAX_CACHE", "off")


@pytest.fixture
def run(monkeypatch):
    """The steps of each program that has run."""
    found = []

    class Counted(columns.KeptProgram):
        def __init__(self, function, *args):
            super().__init__(function, *args)
            self.steps = [type(step).__name__ for step in function.__wrapped__.steps]

        def __call__(self, arrays):
            found.append(self.steps)
            return super().__call__(arrays)

    monkeypatch.setattr(columns, "KeptProgram", Counted)
    columns.program_of.__globals__["PROGRAMS"].clear()
    return found


energy = lambda f: lambda x, y: f(x, y)["energy"]
WAYS = {
    "slope": (lambda f: jax.grad(energy(f), 1)(X, Y), ["Columns"]),
    "slopes": (lambda f: jax.value_and_grad(energy(f), (0, 1))(X, Y), ["Columns"]),
    "rows": (lambda f: jax.jacrev(lambda x: f(x, Y)["total"])(X), ["Columns"]),
    "columns": (lambda f: jax.jacfwd(lambda x: f(x, Y)["total"])(X), ["Columns"]),
    "push": (lambda f: jax.jvp(lambda y: f(X, y)["total"], (Y,), (Y,)), ["Columns"]),
    "lanes": (lambda f: jax.vmap(energy(f), (None, 0))(X, jnp.arange(1.0, 4.0)), ["Lanes"]),
    "lanes of slopes": (
        lambda f: jax.vmap(jax.grad(energy(f), 1), (None, 0))(X, jnp.arange(1.0, 4.0)), ["Columns", "Lanes"],
    ),
    "slope of lanes": (
        lambda f: jax.grad(lambda y: jnp.mean(jax.vmap(energy(f), (0, None))(jnp.stack([X, -X, X**2]), y)))(Y),
        ["Lanes", "Columns"],
    ),
    "curvature": (lambda f: jax.hessian(energy(f))(X, Y), ["Columns", "Columns"]),
    "curvature in reverse": (lambda f: jax.jacrev(jax.jacrev(energy(f)))(X, Y), ["Columns", "Columns"]),
    "linear map": (lambda f: jax.jit(jax.linearize(lambda x: f(x, Y)["total"], X)[1])(X), ["Columns"]),
}  # fmt: skip
FAST = "slopes", "lanes of slopes", "slope of lanes", "curvature in reverse"


@pytest.mark.parametrize("way", exhaustive_but(FAST, WAYS))
def test_as_by_jax(way, run):
    """Every way gives what JAX gives, in one program and one run; again, by the same program."""
    act, steps = WAYS[way]
    expected = jax.jit(lambda: act(reference))()
    for _ in range(2):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13), act(ours), expected)
        assert run == [steps]
        run.clear()
    assert len(columns.program_of.__globals__["PROGRAMS"]) <= 3


def test_what_has_no_columns(run):
    """Many numbers, a direction by several, and all that is in a program of the user's: JAX's own way."""
    reverse = lambda arrays: reference(*arrays[:2])
    many = jnp.linspace(0.1, 1.0, columns.FEW + 1)
    both = lambda x: [energy(f)(x, Y) for f in (partial(ours, function=reverse), jax.jit(reference))]
    ways = [
        lambda i: jax.grad(lambda x: both(x)[i])(many),
        lambda i: jax.jvp(lambda x: both(x)[i], (X,), (X**2,)),
        lambda i: jax.jit(jax.grad(lambda x: both(x)[i]))(X),
        lambda i: jax.jit(lambda y: y * jax.grad(lambda x: both(x)[i])(X))(Y),
    ]
    for act in ways:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), act(0), act(1))
    assert run == []
    assert "from_python" not in str(jax.make_jaxpr(lambda x: ours(x, Y, reverse))(X))
    # Many numbers, in reverse, of a slope by one.
    slopes = lambda f: jax.grad(lambda x: jax.grad(energy(f), 1)(x, Y))(many)
    np.testing.assert_allclose(
        slopes(partial(ours, function=reverse)), jax.jit(lambda: slopes(reference))(), rtol=1e-11
    )


@jax.custom_vjp
def squared(x):
    """A function of the user's with a derivative of its own, in reverse only."""
    return x**2


squared.defvjp(lambda x: (x**2, x), lambda x, slope: (3 * slope * x,))


def test_derivatives_in_reverse_only():
    """They are taken JAX's way, and are the user's own."""
    function = lambda arrays: {"energy": jnp.sum(squared(arrays[0]))}
    np.testing.assert_allclose(jax.grad(lambda x: ours(x, Y, function)["energy"])(X), 3 * X)


AFTERWARDS = """
import jax
import jax.numpy as jnp
import lagjax as lj
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **more: compiled.append(more.get("fun_name")) if "backend_compile" in name else None
)
mine = jax.jit(lambda x: 2 * x)
mine(jnp.ones(3))
for name in lj.__all__:
    getattr(lj, name)
jax.grad(lambda g: lj.integrate(lj.System(lambda t, q, v, p: 0.5 * v**2 - g * q), 1.0, 0.0, ts=[0.0, 1.0]).q[-1])(9.81)
compiled.clear()
mine(jnp.ones(3))
assert compiled == [], compiled
"""


@pytest.mark.slow
def test_the_programs_of_the_user_stay():
    """No room that is imported later makes JAX compile again what it has compiled (a new context would)."""
    subprocess.run([sys.executable, "-c", AFTERWARDS], check=True)
