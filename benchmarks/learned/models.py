"""The models of `learned.py`: different kinds with networks of the same size, behind one interface.

ours          L = ½ |Cᵀ(q) v|² - V(q): a positive-definite mass matrix C Cᵀ and a potential; if there is
              friction, also the force -D Dᵀ v. `lj.accelerations` and `lj.integrate` do the rest
free L        L(q, v) is one network, as in Cranmer et al. (2020), plus ½ |v|²
neural ODE    v' = f(q, v), one network; by diffrax
Hamiltonian   q' = ∂H/∂p, p' = -∂H/∂q - D Dᵀ q', H(q, p) one network plus ½ |p|². Its momenta are known: they come
              from velocities by the true mass matrix, which our model has to learn
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj


class Setting(NamedTuple):
    """What all models know about a system: `features(q)`, numbers of order one, and typical sizes.

    `mass(q)` is the true mass matrix, for momenta; `friction` says whether there is friction.
    """

    name: str
    coordinates: int
    features: Any
    speed: float
    energy: float
    mass: Any
    friction: bool = False


class Model(NamedTuple):
    """`first(random)` gives its weights; `accelerations(weights, q, v)`; and see `motion_by`.

    `mismatch(weights, q, v, a)` is the error at one state; `motion(weights, q0, v0, ts, tolerance)` gives q and v at
    the times, NaN or infinite if it fails.
    """

    name: str
    first: Any
    accelerations: Any
    mismatch: Any
    motion: Any


def layers(random, *sizes):
    """The initial weights of a network."""
    return [
        (random.normal(size=(n, m)) / np.sqrt(n), np.zeros(m)) for n, m in zip(sizes[:-1], sizes[1:], strict=True)
    ]  # fmt: skip


def network(weights, x):
    """Layers of tanh, the last one linear."""
    for matrix, shift in weights[:-1]:
        x = jnp.tanh(x @ matrix + shift)
    matrix, shift = weights[-1]
    return x @ matrix + shift


def count(weights):
    """How many numbers."""
    return sum(np.size(x) for x in jax.tree.leaves(weights))


def as_wide(numbers, inputs, depth, outputs):
    """The hidden sizes of a network with `depth` layers and about `numbers` weights."""
    of = lambda width: width * (inputs + 1) + (depth - 1) * width * (width + 1) + outputs * (width + 1)
    return (min(range(2, 1000), key=lambda width: abs(of(width) - numbers)),) * depth


def factor(weights, x, size):
    """A lower triangular matrix with a positive diagonal."""
    found = network(weights, x)
    diagonal, below = jnp.exp(found[:size]), found[size:]
    return jnp.diag(diagonal) + jnp.zeros((size, size), x.dtype).at[np.tril_indices(size, -1)].set(below)


def ours(setting, hidden):
    """A positive-definite mass matrix and a potential."""
    size = setting.coordinates
    inputs, entries = _inputs(setting), size * (size + 1) // 2

    def lagrangian(t, q, v, weights):
        x = setting.features(q)
        kinetic = 0.5 * jnp.sum((factor(weights["mass"], x, size).T @ v) ** 2)
        return kinetic - setting.energy * network(weights["potential"], x)[0]

    def dissipation(t, q, v, weights):
        return 0.05 * jnp.sum((factor(weights["friction"], setting.features(q), size).T @ v) ** 2)

    def first(random):
        weights = {"mass": layers(random, inputs, *hidden, entries), "potential": layers(random, inputs, *hidden, 1)}
        return weights | ({"friction": layers(random, inputs, 16, entries)} if setting.friction else {})

    return of_lagrangian("ours", lj.System(lagrangian, dissipation=dissipation if setting.friction else None), first)


def free(setting, hidden):
    """One network for L(q, v)."""

    def lagrangian(t, q, v, weights):
        x = jnp.concatenate([setting.features(q), v / setting.speed])
        return 0.5 * jnp.sum(v**2) + setting.energy * network(weights, x)[0]

    inputs = _inputs(setting) + setting.coordinates
    return of_lagrangian("free L", lj.System(lagrangian), lambda random: layers(random, inputs, *hidden, 1))


def of_lagrangian(name, system, first):
    """A model by lagjax."""

    def accelerations(weights, q, v):
        return lj.accelerations(system, jnp.zeros((), q.dtype), q, v, weights)[0]

    def motion(weights, q0, v0, ts, tolerance):
        found = lj.integrate(
            system, q0, v0, weights, ts=ts, rtol=tolerance, atol=tolerance, method=lj.Tsit5(), throw=False,
            max_steps=MOST_STEPS,
        )  # fmt: skip
        return found.q, found.v

    return Model(name, first, accelerations, _off(accelerations), motion)


def neural_ode(setting, numbers, depth):
    """The acceleration is a network."""
    size = setting.coordinates
    inputs = _inputs(setting) + size
    hidden = as_wide(numbers, inputs, depth, size)

    def accelerations(weights, q, v):
        scale = setting.speed**2
        return scale * network(weights, jnp.concatenate([setting.features(q), v / setting.speed]))

    def motion(weights, q0, v0, ts, tolerance):
        field = lambda t, y, weights: (y[1], accelerations(weights, *y))
        return by_diffrax(field, (q0, v0), weights, ts, tolerance)

    return Model("neural ODE", lambda random: layers(random, inputs, *hidden, size), accelerations, _off(accelerations),
                 motion)  # fmt: skip


def hamiltonian(setting, numbers, depth):
    """H is a network of q and p."""
    size = setting.coordinates
    inputs, entries = _inputs(setting) + size, size * (size + 1) // 2
    small = count(layers(np.random.default_rng(0), _inputs(setting), 16, entries)) if setting.friction else 0
    hidden = as_wide(numbers - small, inputs, depth, 1)

    def energy(weights, q, p):
        x = jnp.concatenate([setting.features(q), p / setting.speed])
        return 0.5 * jnp.sum(p**2) + setting.energy * network(weights["energy"], x)[0]

    def field(t, y, weights):
        q, p = y
        along, rate = jax.grad(energy, (1, 2))(weights, q, p)
        if setting.friction:
            damping = factor(weights["friction"], setting.features(q), size)
            along = along + 0.1 * damping @ (damping.T @ rate)
        return rate, -along

    def accelerations(weights, q, v):
        return _second(weights, q, setting.mass(q) @ v)[1]

    def _second(weights, q, p):
        rates = field(0.0, (q, p), weights)
        velocity = lambda q, p: jax.grad(energy, 2)(weights, q, p)
        return jax.jvp(velocity, (q, p), rates)

    def mismatch(weights, q, v, a):
        velocity, acceleration = _second(weights, q, setting.mass(q) @ v)
        return jnp.sum(jnp.abs(acceleration - a)) + jnp.sum(jnp.abs(velocity - v)) * setting.speed

    def motion(weights, q0, v0, ts, tolerance):
        q, p = by_diffrax(field, (q0, setting.mass(q0) @ v0), weights, ts, tolerance)
        return q, jax.vmap(lambda q, p: jax.grad(energy, 2)(weights, q, p))(q, p)

    def first(random):
        weights = {"energy": layers(random, inputs, *hidden, 1)}
        return weights | ({"friction": layers(random, _inputs(setting), 16, entries)} if setting.friction else {})

    return Model("Hamiltonian", first, accelerations, mismatch, motion)


# A motion that needs more steps counts as failed.
MOST_STEPS = 2**14


def by_diffrax(field, y0, weights, ts, tolerance):
    """The states at all times, by the same method as ours."""
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(field), diffrax.Tsit5(), ts[0], ts[-1], None, y0, args=weights, saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=MOST_STEPS, throw=False,
    )  # fmt: skip
    return found.ys


def _inputs(setting):
    return len(setting.features(np.zeros(setting.coordinates)))


def _off(accelerations):
    return lambda weights, q, v, a: jnp.sum(jnp.abs(accelerations(weights, q, v) - a))
