"""The Hamiltonian of any regular Lagrangian, by the Legendre transform, and Hamilton's equations.

    H(t, q, p) = p·v - L(t, q, v)        with v from p = ∂L/∂v
    q̇ = ∂H/∂p,    ṗ = -∂H/∂q + Q - ∂R/∂v

H is the Jacobi integral as a function of momenta. p = ∂L/∂v is solved for v numerically, for any regular L: if L is
quadratic in the velocities, p is linear in them and one solve with M = ∂²L/∂v∂v is exact; the program of L shows
whether this is so. Otherwise Newton's method finds v, with steps shortened until L is finite and the residual falls.
The derivatives of v, of any order and in both modes, are those of the implicit function: dv = M⁻¹ (dp - d(∂L/∂v) at
fixed v).

Source: Goldstein, *Classical Mechanics*, Eq. (8.15)-(8.18); Arnold, *Mathematical Methods of Classical Mechanics*, §14.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, depends, is_traced, judging
from lagjax.mechanics import SINGULAR_BELOW, applied_force, describe
from lagjax.numerics import dense, newton
from lagjax.system import System, check_system, coordinates, model_of, traced_system

ITERATIONS = 60
# The line search takes the best of these fractions of a Newton step, or none.
FRACTIONS = np.append(0.5 ** np.arange(16.0), 0.0)
# The momentum counts as reached if the residual is below this many round-offs of its terms.
ROUND_OFFS = 1e3


class SolvedVelocity(NamedTuple):
    """The velocity for a given momentum, whether M is regular there, and whether the momentum was reached."""

    v: Float[Array, " n"]
    mass: Float[Array, "n n"]
    regular: Bool[Array, ""]
    reached: Bool[Array, ""]


def velocity_of(momentum: Callable, p: Float[Array, " n"]) -> SolvedVelocity:
    """Solve `momentum(v) = p`, the gradient of a function of v, in vector form."""
    zero = jnp.zeros_like(p)
    mass = jax.jacfwd(momentum)
    if is_linear(momentum, zero):
        matrix = mass(zero)
        v = dense.solve(matrix, p - momentum(zero))
        reached = jnp.all(jnp.isfinite(v))
        return SolvedVelocity(v, matrix, _regular(matrix), reached)
    v = lax.custom_root(lambda v: momentum(v) - p, zero, _newton, _tangent)
    at, target = lax.stop_gradient(v), lax.stop_gradient(p)
    matrix = mass(at)
    return SolvedVelocity(v, matrix, _regular(matrix), _reached(momentum(at), target, matrix, at))


def is_linear(momentum: Callable, like) -> bool:
    """Whether ∂p/∂v is known not to depend on the velocities."""
    program = jax.make_jaxpr(jax.jacfwd(momentum))(like).jaxpr
    return not depends(program, program.invars)


@judging
def _regular(matrix):
    return dense.reciprocal_condition(lax.stop_gradient(matrix)) > SINGULAR_BELOW[np.dtype(matrix.dtype)]


@judging
def _reached(found, target, matrix, v: PyTree):
    terms = jnp.abs(target) + jnp.abs(matrix) @ jnp.abs(v)
    return jnp.max(jnp.abs(found - target)) <= ROUND_OFFS * jnp.finfo(v.dtype).eps * jnp.max(terms)


def _newton(residual, start):
    def step(v: PyTree, r, i):
        return dense.solve(jax.jacfwd(residual)(v), r)

    # Round-off ends the quadratic convergence: the residual no longer falls.
    return newton(residual, step, start, ITERATIONS, falls=1.0, fractions=FRACTIONS)


def _tangent(linear, y):
    return dense.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)


class Hamiltonian(eqx.Module):
    """The Hamiltonian `H(t, q, p, params)` of a system, returned by `lj.hamiltonian`."""

    system: System

    def __call__(self, t, q: PyTree, p, params: PyTree) -> Float[Array, ""]:
        """H at a position and a momentum, `[L]`."""
        return self._at(t, q, p, params)[0]

    def velocity(self, t, q: PyTree, p, params: PyTree) -> PyTree[Float[Array, "..."]]:
        """The velocity that belongs to a momentum, like q, `[q]/[t]`."""
        return self._at(t, q, p, params)[1]

    def rates(self, t, q: PyTree, p, params: PyTree) -> tuple[PyTree[Array], PyTree[Array]]:
        """Hamilton's equations: `(q̇, ṗ)`, each like q, including the forces that L does not contain."""
        if self.system.constraints:
            raise ValueError(
                f"Hamilton's equations need free coordinates, but {self.system} has constraints, whose forces "
                "H does not contain.\n"
                "Fix: lj.accelerations(system, t, q, v, params) with v = H.velocity(t, q, p, params), or coordinates "
                "that satisfy the constraints by themselves."
            )
        _, v, momentum_rate = self._at(t, q, p, params)
        return v, momentum_rate

    def _at(self, t, q: PyTree, p, params: PyTree):
        if jax.tree.structure(p) != jax.tree.structure(q):
            has = [", ".join(coordinates.names(tree)) for tree in (q, p)]
            raise ValueError(
                f"p must have the structure of q.\n  q: {has[0]}\n  p: {has[1]}\n"
                "Fix: p = lj.momentum(system, t, q, v, params)."
            )
        s = coordinates.state(t, q, p, params)
        system = traced_system(self.system, s)
        value, v, momentum_rate, mass, regular, reached = _hamiltonian(system, *s)
        if is_traced((value, regular)):
            known = regular & reached
            return jax.tree.map(lambda x: jnp.where(known, x, jnp.nan), (value, v, momentum_rate))
        if not (regular and reached):
            raise ValueError(_no_velocity(s, np.asarray(mass), bool(regular)))
        return value, v, momentum_rate

    def __repr__(self):
        return f"Hamiltonian of {self.system}"


def hamiltonian(system: System) -> Hamiltonian:
    """Return the Hamiltonian of a system, by a numerical Legendre transform of any regular L.

    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2 - params["k"] * q**2 / 2)
    >>> H = hamiltonian(pendulum)
    >>> print(H(0.0, 1.0, 6.0, {"m": 2.0, "k": 10.0}), H.velocity(0.0, 1.0, 6.0, {"m": 2.0, "k": 10.0}))
    14.0 3.0

    **Arguments:** `system`, whose L is transformed. Constraints and forces are not part of H.

    **Returns:** `H(t, q, p, params)` -> scalar, `[L]`, with p like q, `[L] [t]/[q]`. `H.velocity` with the same
    arguments gives v, and `H.rates` the pair (q̇, ṗ) of Hamilton's equations. All three have derivatives of any order
    in both modes, and work in batches. They take one linear solve where L is quadratic in v, else Newton's method.

    **Raises:** when H is called: `ValueError` where L is degenerate, naming the coordinate whose velocity the momenta
    do not determine, or where no velocity has this momentum (while JAX is tracing the values are NaN instead);
    `TypeError`, `ValueError` for a state of the wrong dtype or shape.

    Source: Goldstein, Eq. (8.15), (8.18).
    """
    check_system(system, states=False)
    return Hamiltonian(system)


@compiled
def _hamiltonian(system, t, q: PyTree, p, params: PyTree):
    model = model_of(system, t, q, q, params)
    x, momentum = model.vectors(q, p)

    def lagrangian_of(x: Array, u: Array):
        return model.lagrangian(t, x, u)

    found = velocity_of(lambda u: jax.grad(lagrangian_of, argnums=1)(x, u), momentum)
    value, slope = jax.value_and_grad(lagrangian_of)(x, found.v)
    # -∂H/∂q at constant p equals ∂L/∂q at constant v.
    if not model.m:
        slope = slope + applied_force(model, t, x, found.v)
    return momentum @ found.v - value, model.tree(found.v), model.tree(slope), found.mass, found.regular, found.reached


def _no_velocity(s, mass, regular):
    names = coordinates.names(s.q)
    at = f"at t = {float(s.t):.6g}, q = {describe(s.q)}, p = {describe(s.v)}"
    if regular:
        return (
            f"no velocity was found that has this momentum, {at}.\n"
            "Usual cause: a momentum outside the range of ∂L/∂v, or an L that is not finite at rest.\n"
            "Fix: take p from a velocity, p = lj.momentum(system, t, q, v, params)."
        )
    name = names[degenerate(mass)] if np.all(np.isfinite(mass)) else names[0]
    return (
        f"L is degenerate in '{name}', {at}: the momenta do not determine its velocity, so there is no Hamiltonian.\n"
        "Usual cause: a coordinate whose velocity is missing from L, or enters it only linearly; a zero mass; a "
        "coordinate singularity (an azimuth at the pole).\n"
        f"Fix: give '{name}' a kinetic energy, or leave it out of q; lj.explain(system, t, q, v, params) shows the "
        "masses."
    )


def degenerate(mass: np.ndarray) -> int:
    """The coordinate with the largest component in the null direction of a singular mass matrix."""
    scale = np.sqrt(np.max(np.abs(mass), axis=1))
    if not np.all(scale):
        return int(np.argmin(scale))
    return int(np.argmax(np.abs(np.linalg.svd(mass / np.outer(scale, scale))[2][-1])))
