"""Is any Lagrangian solved wrongly, or does any crash the process? Random expressions against naive equations and
SciPy.

Each case is a random system: energies and forces are expression trees, with arrays that are closed over, given in
`params` or written as NumPy constants; with tables, indices, integers, mixed dtypes, conditionals, loops, checkpoints
and derivative rules. It is passed to `accelerations`, `integrate`, and to one of `jvp`, `vjp` and `vmap` of 3 and of
300 (to all of them with `--all`). With `--quick` only its equations are tested, written out and in a loop of a few
steps that is compiled as one function, which takes a third of the time.

The reference is the Euler-Lagrange equation, written naively with JAX's derivatives and a linear solve, and its
derivative, integrated by SciPy's DOP853.

Every case runs in a separate process, which may die. Seeds are printed:

    python -m benchmarks.campaigns.fuzz --cases 150 --seed 0
    python -m benchmarks.campaigns.fuzz --only 17 --all
    python -m benchmarks.campaigns.fuzz --quick --cases 1000

Forking is cheap as long as JAX has not started its backend, so nothing in this module creates an array before.
"""

import argparse
import os
import select
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.jaxtools.fuse import one_function

jax.config.update("jax_enable_x64", True)

END, OUTPUTS = 0.8, 5
# A motion whose reference needs more evaluations (most take a millisecond) counts as not solvable.
PATIENCE = 50_000
# Allowed differences, relative to 1 + the largest value; at a tolerance of 1e-9 this leaves room for kinks.
VALUES_AGREE, DERIVATIVES_AGREE = 1e-6, 1e-5
TRANSFORMATIONS = ("jvp", "vjp", "vmap3", "vmap300")


class Case(NamedTuple):
    """A random system with a start."""

    system: Any
    q0: Any
    v0: Any
    params: Any
    features: tuple[str, ...]


class Env(NamedTuple):
    """The inputs of an expression: the time, single coordinates and velocities, and the parameters."""

    t: Any
    q: Any
    v: Any
    p: Any


class Writer:
    """Writes random expressions, and stores their arrays in `params`, in closures or as constants."""

    def __init__(self, rng, n):
        self.rng, self.n, self.params, self.features = rng, n, {}, []

    def one_of(self, *choices):
        return choices[self.rng.integers(len(choices))]

    def held(self, array):
        """A function that returns an array, wherever it is stored."""
        array = np.asarray(array)
        where = self.one_of("params", "closed", "constant")
        if where == "params":
            name = f"a{len(self.params)}"
            self.params[name] = array
            return lambda env: env.p[name]
        if where == "constant":
            return lambda env: array
        kept = []

        def closed(env):
            # The array is created at the first call, so that nothing starts JAX before the fork.
            with jax.ensure_compile_time_eval():
                kept[:] = kept or [jnp.asarray(array)]
            return kept[0]

        return closed

    def number(self, low=-1.0, high=1.0):
        return self.held(self.rng.uniform(low, high))

    def leaf(self, velocities):
        i = int(self.rng.integers(self.n))
        choices = [lambda env: env.q[i], lambda env: env.q[i], lambda env: env.t, self.number()]
        if velocities:
            choices.append(lambda env: env.v[i])
        return self.one_of(*choices)

    def scalar(self, depth, velocities=False):
        """An expression whose value is a number, of moderate size if its leaves are."""
        if depth <= 0:
            return self.leaf(velocities)
        name = self.one_of(*SCALARS)
        self.features.append(name)
        return SCALARS[name](self, depth, velocities)

    def vector(self, depth, velocities, size):
        """An expression whose value is a vector: a few numbers spread over `size` entries."""
        parts = [self.scalar(depth - 1, velocities) for _ in range(self.rng.integers(1, 3))]
        spread = self.held(self.rng.normal(size=(size, len(parts))))
        inside = lambda env: spread(env) @ jnp.stack([part(env) for part in parts])
        return lambda env: jnp.tanh(inside(env))

    def size(self):
        return int(self.one_of(1, 2, 3, 5, 16, 17, 33, 63, 64, 65))


def unary(*functions):
    """One of some functions of a number."""

    def write(w, depth, velocities):
        f, x = w.one_of(*functions), w.scalar(depth - 1, velocities)
        return lambda env: f(x(env))

    return write


def binary(*functions):
    """One of some functions of two numbers."""

    def write(w, depth, velocities):
        f, x, y = w.one_of(*functions), w.scalar(depth - 1, velocities), w.scalar(depth - 1, velocities)
        return lambda env: f(x(env), y(env))

    return write


def of_vector(*functions):
    """One of some functions of a vector."""

    def write(w, depth, velocities):
        f, x = w.one_of(*functions), w.vector(depth, velocities, w.size())
        return lambda env: f(x(env))

    return write


def network(w, depth, velocities):
    """Two layers of any width."""
    sizes = [w.size(), w.size()]
    x = w.vector(depth, velocities, sizes[0])
    first, second = (w.held(w.rng.normal(size=(b, a)) / np.sqrt(a)) for a, b in zip(sizes, [sizes[1], sizes[0]]))
    activation = w.one_of(jnp.tanh, jax.nn.softplus, jax.nn.gelu, jax.nn.silu, jnp.sin)
    return lambda env: jnp.mean(second(env) @ activation(first(env) @ x(env)))


def mixed_kinds(w, depth, velocities):
    """A product with a matrix of integers, booleans or lower precision."""
    size = w.size()
    kind = w.one_of(int, bool, np.float32, np.int32)
    matrix = w.held((w.rng.uniform(-1, 2, size=(size, size)) / (1 if kind in (int, np.int32) else 2)).astype(kind))
    x = w.vector(depth, velocities, size)
    return lambda env: x(env) @ (matrix(env) @ x(env)) / size


def table(w, depth, velocities):
    """An entry of a table, long or short, by an integer."""
    size = int(w.one_of(3, 100, 1000, 1300, 2001))
    entries, index = w.held(w.rng.uniform(-1, 1, size=size)), w.held(np.array(int(w.rng.integers(-size, size))))
    x = w.scalar(depth - 1, velocities)
    return w.one_of(
        lambda env: jnp.asarray(entries(env))[index(env)] * x(env),
        lambda env: jnp.sin(jnp.asarray(entries(env)) + x(env))[index(env)],
        lambda env: jnp.asarray(entries(env))[(index(env) * 3 + 7) // 2 % size] + x(env),
        lambda env: jnp.asarray(entries(env))[lax.div(index(env), 2) % size] - x(env),
        lambda env: jnp.mean(jnp.take(jnp.asarray(entries(env)), jnp.arange(5) + index(env), mode="wrap")) * x(env),
        lambda env: jnp.interp(jnp.tanh(x(env)), jnp.linspace(-1, 1, size), jnp.cos(jnp.linspace(-1, 1, size))),
    )


def conditional(w, depth, velocities):
    """Branches that meet smoothly."""
    x, c = w.scalar(depth - 1, velocities), w.number(-0.3, 0.3)
    cube = lambda y: y**3
    return w.one_of(
        lambda env: lax.cond(x(env) > c(env), cube, lambda y: -(y**3), x(env) - c(env)),
        lambda env: jnp.where(x(env) > c(env), (x(env) - c(env)) ** 3, 0.0),
        lambda env: lax.cond(env.t < 0.4, lambda y: (env.t - 0.4) ** 2 * y, lambda y: 0.0 * y, x(env)),
        lambda env: lax.select(x(env) > 9.0, jnp.log(-1.0 - x(env) ** 2), jnp.sin(x(env))),
        lambda env: jnp.clip(x(env), -50.0, 50.0),
        lambda env: lax.switch(jnp.asarray(c(env) > 0, int), [jnp.sin, lambda y: y / (1 + y**2)], x(env)),
    )


def loop(w, depth, velocities):
    """Loops, scans and maps of a few iterations."""
    x, count = w.scalar(depth - 1, velocities), int(w.rng.integers(1, 6))
    weights = w.held(w.rng.uniform(-0.5, 0.5, size=count))
    return w.one_of(
        lambda env: lax.fori_loop(0, count, lambda i, y: jnp.sin(y + 0.1 * i), x(env)),
        lambda env: lax.scan(lambda y, k: (jnp.cos(k * y), y * k), x(env), jnp.asarray(weights(env)))[1].sum(),
        lambda env: jax.vmap(lambda k: jnp.sin(k + x(env)))(jnp.asarray(weights(env))).sum(),
        lambda env: lax.map(lambda k: jnp.cos(k * x(env)), jnp.asarray(weights(env))).mean(),
    )


def integers(w, depth, velocities):
    """Integers that scale or select."""
    x, n = w.scalar(depth - 1, velocities), w.held(np.array(int(w.rng.integers(1, 12))))
    return w.one_of(
        lambda env: x(env) * (29 // n(env)) / 29,
        # As far as the program shows, the dividend depends on the state.
        lambda env: x(env) * lax.div(jnp.floor(env.t + 29.0).astype(int), jnp.asarray(n(env), int)) / 29.0,
        lambda env: x(env) * (jnp.asarray(n(env)) % 5) / 5,
        lambda env: x(env) * jnp.asarray(n(env) > 5, float),
        lambda env: jnp.sin(x(env)) ** int(w.n + 1),
        lambda env: x(env) + (jnp.floor(env.t + 29.0).astype(int) - 29 - (jnp.floor(env.t).astype(int))) * 1.0,
        lambda env: x(env) * jnp.sign(1.0 + jnp.asarray(n(env))),
        lambda env: jnp.where((jnp.asarray(n(env), int) & 3) == 1, x(env), -x(env)),
    )


def rules(w, depth, velocities):
    """Functions with derivative rules, checkpoints and jits."""
    x, kept = w.scalar(depth - 1, velocities), w.number()

    @jax.custom_jvp
    def sine(y):
        return jnp.sin(y)

    sine.defjvp(lambda primals, tangents: (sine(*primals), jnp.cos(primals[0]) * tangents[0]))
    matrix = w.held(w.rng.normal(size=(9, 9)) / 9)
    return w.one_of(
        lambda env: sine(x(env)),
        lambda env: jax.checkpoint(lambda y: jnp.sin(y) * jnp.cos(y))(x(env)),
        lambda env: jax.checkpoint(lambda y: jnp.sum(jnp.asarray(matrix(env)) @ jnp.full(9, y)))(x(env)),
        lambda env: jax.jit(lambda y, k: jnp.tanh(k * y))(x(env), kept(env)),
        lambda env: x(env) + lax.stop_gradient(jnp.asarray(kept(env)) ** 2),
        lambda env: jax.nn.relu(x(env)) ** 3,
        lambda env: jax.grad(lambda y: jnp.sin(y) ** 2)(x(env)),
    )


def known_beforehand(w, depth, velocities):
    """Constants that are infinite, zero or one."""
    x = w.scalar(depth - 1, velocities)
    return w.one_of(
        lambda env: jnp.sum(jnp.minimum(1 / jnp.array([1.0, 0.0]), 5.0)) * x(env) / 5,
        lambda env: jnp.sum(jnp.eye(3)[1] * jnp.stack([x(env), 2 * x(env), env.t])),
        lambda env: jnp.linalg.det(jnp.diag(jnp.array([1.0, 2.0]))) * x(env) / 2,
        lambda env: jnp.exp(-jnp.inf) + x(env),
        lambda env: jnp.max(jnp.array([0.5, jnp.inf])) ** -1.0 + x(env),
    )


def linear_algebra(w, depth, velocities):
    """Small solves, norms and contractions."""
    size = int(w.rng.integers(2, 5))
    matrix = w.held(np.eye(size) * 3 + w.rng.uniform(-0.5, 0.5, size=(size, size)))
    x = w.vector(depth, velocities, size)
    return w.one_of(
        lambda env: jnp.linalg.solve(jnp.asarray(matrix(env)), x(env))[0],
        lambda env: jnp.linalg.norm(jnp.asarray(matrix(env)) @ x(env) + 3.0),
        lambda env: jnp.einsum("i,ij,j->", x(env), jnp.asarray(matrix(env)), x(env)) / size,
        lambda env: jnp.trace(jnp.outer(x(env), x(env)) @ jnp.asarray(matrix(env))) / size,
        lambda env: jnp.kron(x(env), x(env))[1],
    )


SCALARS = {
    "unary": unary(
        jnp.sin, jnp.cos, jnp.tanh, jnp.arctan, lambda x: jnp.exp(-(x**2)), lambda x: jnp.log1p(x**2), lax.erf,
        lambda x: jnp.sqrt(1 + x**2), jax.nn.sigmoid, lambda x: jnp.sinh(jnp.tanh(x)), lambda x: jnp.expm1(jnp.sin(x)),
        lambda x: lax.rsqrt(2 + x**2), lambda x: jnp.cbrt(8 + jnp.sin(x)), lambda x: jnp.arcsinh(x), jnp.square,
        lambda x: jnp.cos(x) ** 4, lambda x: jnp.exp2(jnp.sin(x)),
        lambda x: lax.lgamma(2 + jnp.tanh(x)), lambda x: jnp.arccos(0.5 * jnp.sin(x)), lambda x: jnp.tan(jnp.sin(x)),
        lambda x: jnp.logaddexp(x, 0.3), lambda x: jnp.cosh(jnp.sin(x)),
    ),
    "binary": binary(
        jnp.add, jnp.subtract, lambda x, y: jnp.sin(x) * y, lambda x, y: x / (2 + jnp.cos(y)), jnp.multiply,
        lambda x, y: jnp.arctan2(x, 2 + y**2), lambda x, y: (1 + x**2) ** jnp.sin(y),
        lambda x, y: jnp.hypot(1 + x**2, y),
    ),
    "vector": of_vector(
        jnp.mean, lambda x: jnp.mean(jnp.cumsum(x)) / x.size, lambda x: jnp.dot(x, x[::-1]) / x.size,
        lambda x: jax.nn.softmax(x)[0], lambda x: jnp.concatenate([x, x[:1]])[1:].mean(), lambda x: jnp.roll(x, 1)[0],
        lambda x: jnp.mean(jnp.outer(x, x)), lambda x: x.at[0].set(0.5).mean(), lambda x: jnp.prod(1 + 0.1 * x[:3]),
        lambda x: jnp.pad(x, (1, 2))[1], lambda x: jnp.flip(x)[0], lambda x: jax.nn.logsumexp(x),
        lambda x: jnp.mean(x.reshape(-1, 1).T @ x.reshape(-1, 1)) / x.size, lambda x: x[jnp.array([0, -1])].sum(),
        lambda x: x.at[jnp.array([0, -1])].add(1.0).mean(), lambda x: jnp.mean(jnp.tile(x, 3)), lambda x: x.std() ** 2,
        lambda x: jnp.stack(jnp.split(jnp.tile(x, 2), 2))[1].mean(), lambda x: lax.dynamic_slice(x, (0,), (1,))[0],
    ),
    "network": network, "mixed kinds": mixed_kinds, "table": table, "conditional": conditional, "loop": loop,
    "integers": integers, "rules": rules, "known": known_beforehand, "linear algebra": linear_algebra,
}  # fmt: skip


def random_case(seed: int) -> Case:
    """The system of a seed, as plain functions and NumPy arrays."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([1, 1, 2, 2, 3, 9]))
    shape = str(rng.choice(["scalar", "vector", "dict"] if n == 1 else ["vector", "dict"]))
    w = Writer(rng, n)
    depth = int(rng.integers(1, 4))
    inertia = w.scalar(depth - 1) if rng.uniform() < 0.5 else None
    linear = w.scalar(1) if rng.uniform() < 0.3 else None
    potential = w.scalar(depth)
    force = [w.scalar(depth - 1, velocities=True) for _ in range(n)] if rng.uniform() < 0.6 else None
    dissipation = w.number(0.1, 0.5) if rng.uniform() < 0.3 else None
    masses, stiffness = w.held(rng.uniform(0.5, 2.0, size=n)), w.number(0.2, 2.0)
    parts = {
        "scalar": lambda x: jnp.reshape(x, (1,)),
        "vector": lambda x: x,
        "dict": lambda x: jnp.stack([x[f"x{i}"] for i in range(n)]),
    }[shape]
    shaped = {
        "scalar": lambda x: x[0],
        "vector": lambda x: x,
        "dict": lambda x: {f"x{i}": x[i] for i in range(n)},
    }[shape]
    env = lambda t, q, v, p: Env(t, parts(q), parts(v), p)

    def lagrangian(t, q, v, p):
        e = env(t, q, v, p)
        scale = 1.0 if inertia is None else 1.0 + 0.3 * jnp.tanh(inertia(e)) ** 2
        kinetic = 0.5 * scale * jnp.sum(masses(e) * e.v**2)
        if linear is not None:
            kinetic = kinetic + jnp.sin(linear(e)) * e.v[0]
        return kinetic - 0.5 * stiffness(e) * jnp.sum(e.q**2) - jnp.sin(potential(e))

    def generalized_force(t, q, v, p):
        return shaped(jnp.stack([jnp.tanh(one(env(t, q, v, p))) for one in force]))

    def rayleigh(t, q, v, p):
        return 0.5 * dissipation(env(t, q, v, p)) * jnp.sum(parts(v) ** 2)

    system = lj.System(
        lagrangian,
        force=None if force is None else generalized_force,
        dissipation=None if dissipation is None else rayleigh,
    )
    q0, v0 = shaped(rng.uniform(-1, 1, size=n)), shaped(rng.uniform(-1, 1, size=n))
    return Case(system, q0, v0, w.params or None, tuple(w.features))


class Reference:
    """The equations written naively on flat states, and SciPy's solution of them."""

    def __init__(self, case):
        self.case = case
        flat, self.unflatten = jax.flatten_util.ravel_pytree(case.q0)
        self.n, self.start = flat.size, np.concatenate([flat, jax.flatten_util.ravel_pytree(case.v0)[0]])
        self.floating, self.rest = eqx.partition(case.params, lambda x: np.issubdtype(np.asarray(x).dtype, np.floating))
        self.rate = jax.jit(self._rate)
        pushed = lambda t, y, dy, dp: jax.jvp(lambda y, p: self._rate(t, y, p), (y, self.floating), (dy, dp))
        self.pushed = jax.jit(lambda t, y, dp: jnp.concatenate(pushed(t, *jnp.split(y, 2), dp)))
        self.lanes = jax.jit(jax.vmap(lambda t, y: self._rate(t, y, self.floating), (None, 0)))

    def acceleration(self, t, x, u, floating):
        s, p = self.case.system, eqx.combine(floating, self.rest)
        lagrangian = lambda t, x, u: s.lagrangian(t, self.unflatten(x), self.unflatten(u), p)
        momentum = jax.grad(lagrangian, 2)
        right = jax.grad(lagrangian, 1)(t, x, u) - jax.jacfwd(momentum, 0)(t, x, u)
        right -= jax.jacfwd(momentum, 1)(t, x, u) @ u
        if s.force is not None:
            right += jax.flatten_util.ravel_pytree(s.force(t, self.unflatten(x), self.unflatten(u), p))[0]
        if s.dissipation is not None:
            right -= jax.grad(lambda u: s.dissipation(t, self.unflatten(x), self.unflatten(u), p))(u)
        return jnp.linalg.solve(jax.jacfwd(momentum, 2)(t, x, u), right)

    def _rate(self, t, y, floating):
        x, u = jnp.split(y, 2)
        return jnp.concatenate([u, self.acceleration(t, x, u, floating)])

    def solved(self, rate, y):
        evaluations = iter(range(PATIENCE))

        def patiently(t, y):
            if next(evaluations, None) is None:
                raise NotFollowed
            return rate(t, y)

        found = solve_ivp(patiently, (0, END), y, "DOP853", np.linspace(0, END, OUTPUTS), rtol=1e-10, atol=1e-11)
        if not found.success or not np.all(np.isfinite(found.y)) or np.max(np.abs(found.y)) > 1e4:
            raise NotFollowed
        return found.y


class NotFollowed(Exception):
    """A motion that SciPy cannot follow."""


def flat(tree, leading=0):
    """All numbers of a pytree by name, as rows."""
    leaves = [np.asarray(x).reshape(*np.shape(x)[:leading], -1) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=-1)


def difference(found, expected):
    """The largest error, relative to 1 + the largest value."""
    return float(np.max(np.abs(found - expected)) / (1 + np.max(np.abs(expected))))


def run_quickly(seed: int) -> str:
    """Test only the equations, written out in a loop compiled as one function, with its derivative and lanes."""
    case = random_case(seed)
    reference = Reference(case)
    rng = np.random.default_rng([seed, 1])

    def stepped(accelerations, y, floating):
        def step(i, y):
            x, u = jnp.split(y, 2)
            return y + 0.05 * jnp.concatenate([u, accelerations(0.05 * i, x, u, floating)])

        return lax.fori_loop(0, 10, step, y)

    def ours(t, x, u, floating):
        params = eqx.combine(floating, reference.rest)
        a, _ = lj.accelerations(case.system, t, reference.unflatten(x), reference.unflatten(u), params)
        return jax.flatten_util.ravel_pytree(a)[0]

    inputs = reference.start, reference.floating
    along = jax.tree.map(lambda x: rng.normal(size=np.shape(x)).astype(np.asarray(x).dtype), inputs)
    expected, slope = jax.jit(lambda x, dx: jax.jvp(partial(stepped, reference.acceleration), x, dx))(inputs, along)
    if not np.all(np.isfinite(expected)) or np.max(np.abs(expected)) > 1e4:
        return "skipped: SciPy cannot follow it"
    # Once with the values known at compile time, once with the values passed as arguments.
    marked = lambda *x: one_function(partial(stepped, ours), *x, checked=True)
    known = jax.jit(lambda y: marked(y, jax.tree.map(jnp.asarray, reference.floating)))(reference.start)
    found, pushed = jax.jit(lambda x, dx: jax.jvp(marked, x, dx))(inputs, along)
    lanes = jax.jit(jax.vmap(marked, (0, None)))(np.stack([reference.start] * 3), reference.floating)
    checks = {
        "known": (difference(known, expected), 1e-9),
        "value": (difference(found, expected), 1e-9),
        "derivative": (difference(pushed, slope), 1e-8),
        "lanes": (difference(lanes, np.asarray(expected)), 1e-9),
    }
    return _verdict(checks)


def run(seed: int, every: bool) -> str:
    """Return "ok" or what is wrong with a case."""
    try:
        return _run(seed, every)
    except NotFollowed:
        return "skipped: SciPy cannot follow it"


def _run(seed, every):
    case = random_case(seed)
    reference = Reference(case)
    n, rng = reference.n, np.random.default_rng([seed, 1])
    ts = jnp.linspace(0.0, END, OUTPUTS)
    y = reference.solved(lambda t, y: np.asarray(reference.rate(t, y, reference.floating)), reference.start)
    a = lj.accelerations(case.system, 0.0, case.q0, case.v0, case.params)[0]
    rate = reference.rate(0.0, reference.start, reference.floating)
    checks = {"accelerations": (difference(flat(a), rate[n:]), 1e-9)}

    def end(q0, v0, floating):
        traj = lj.integrate(case.system, q0, v0, eqx.combine(floating, reference.rest), ts=ts)
        return traj.q, traj.v

    q, v = end(case.q0, case.v0, reference.floating)
    checks["integrate"] = (difference(np.hstack([flat(q, 1), flat(v, 1)]), y.T), VALUES_AGREE)
    chosen = TRANSFORMATIONS if every else rng.permutation(TRANSFORMATIONS)[:1]
    inputs = (case.q0, case.v0, reference.floating)
    along = jax.tree.map(lambda x: rng.normal(size=np.shape(x)).astype(np.asarray(x).dtype), inputs)
    if {"jvp", "vjp"} & set(chosen):
        both = np.concatenate([reference.start, flat(along[:2])])
        dy = reference.solved(lambda t, y: np.asarray(reference.pushed(t, y, along[2])), both)[2 * n :].T
        weights = rng.normal(size=dy.shape)
    if "jvp" in chosen:
        _, (dq, dv) = jax.jit(lambda x, dx: jax.jvp(end, x, dx))(inputs, along)
        checks["jvp"] = (difference(np.hstack([flat(dq, 1), flat(dv, 1)]), dy), DERIVATIVES_AGREE)
    if "vjp" in chosen:
        pulled = lambda *x: sum(jnp.sum(w * _rows(y)) for w, y in zip(jnp.split(weights, 2, axis=1), end(*x)))
        gradient = jax.jit(jax.grad(pulled, argnums=(0, 1, 2)))(*inputs)
        found = sum(float(np.sum(g * d)) for g, d in zip(*map(jax.tree.leaves, (gradient, along))))
        checks["vjp"] = (difference(found, np.sum(weights * dy)), DERIVATIVES_AGREE)
    for lanes in (3, 300):
        if f"vmap{lanes}" in chosen:
            shift = np.linspace(-0.1, 0.1, lanes)
            starts = jax.tree.map(lambda x: np.asarray(x) + shift.reshape(-1, *(1,) * np.ndim(x)), case.q0)
            q, v = jax.jit(jax.vmap(lambda q0: end(q0, case.v0, reference.floating)))(starts)
            looked_at = [0, 1, lanes - 1]
            y0 = reference.start + np.outer(shift[looked_at], np.arange(2 * n) < n)
            rate = lambda t, y: np.asarray(reference.lanes(t, y.reshape(3, -1))).reshape(-1)
            y = reference.solved(rate, y0.reshape(-1)).reshape(3, 2 * n, OUTPUTS).swapaxes(1, 2)
            found = np.concatenate([flat(q, 2), flat(v, 2)], axis=-1)[looked_at]
            checks[f"vmap{lanes}"] = (difference(found, y), VALUES_AGREE)
    return _verdict(checks)


def _verdict(checks):
    wrong = {name: error for name, (error, limit) in checks.items() if not error <= limit}
    return f"ok: {', '.join(checks)}" if not wrong else f"WRONG: {wrong}"


def _rows(tree):
    return jnp.concatenate([x.reshape(x.shape[0], -1) for x in jax.tree.leaves(tree)], axis=-1)


def in_a_process(function, seed: int, verbose: bool, seconds: float = 300) -> str:
    """Run a function in a separate process."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        os.close(read)
        if not verbose:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", lj.AccuracyWarning)
                verdict = function(seed)
        except BaseException as error:
            if verbose:
                traceback.print_exc()
            verdict = f"RAISED: {type(error).__name__}: {' '.join(str(error).split())[:160]}"
        os.write(write, verdict.encode())
        os._exit(0)
    os.close(write)
    ready, _, _ = select.select([read], [], [], seconds)
    if not ready:
        os.kill(child, signal.SIGKILL)
    verdict = os.read(read, 65536).decode() if ready else ""
    os.close(read)
    _, status = os.waitpid(child, 0)
    if not ready:
        return f"SLOW: over {seconds:g} s"
    return verdict or f"DIED: {signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else status}"


def main():
    """Run the cases, print the result of each, and fail if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first case; the others follow")
    parser.add_argument("--only", type=int, nargs="*", help="these seeds, with their tracebacks")
    parser.add_argument("--all", action="store_true", help="test all transformations of each case instead of one")
    parser.add_argument("--quick", action="store_true", help="test only the equations in a loop, which compiles fast")
    parser.add_argument("--seconds", type=float, default=300, help="limit of a case; more on a loaded machine")
    options = parser.parse_args()
    function = run_quickly if options.quick else partial(run, every=options.all)
    seeds = options.only or range(options.seed, options.seed + options.cases)
    verdicts = Counter()
    for seed in seeds:
        start = time.perf_counter()
        verdict = in_a_process(function, seed, bool(options.only), options.seconds)
        verdicts[verdict.split(":")[0]] += 1
        print(f"{seed:6d}  {time.perf_counter() - start:5.1f} s  {verdict}", flush=True)
        if options.only:
            print("        ", Counter(random_case(seed).features), flush=True)
    print(dict(verdicts))
    sys.exit(any(name.isupper() for name in verdicts))


if __name__ == "__main__":
    main()
