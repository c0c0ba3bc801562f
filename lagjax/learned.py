"""For Lagrangians that contain a network: tools against the known pitfalls of learning one from motion.

`lj.fit` trains by Levenberg-Marquardt, and `lj.fit_loss` is trained by an optimiser of optax or another; any module of
equinox, or plain arrays in `params`, can be learned. This module only covers what otherwise goes wrong easily:

- A force is a slope of L, so a network in L needs two continuous derivatives: `Network`.
- A mass matrix M must stay regular during training, and dissipation must never supply energy. Both use

      M = S (floor 1 + Λ Λᵀ) S,

  with Λ lower triangular with a positive diagonal, and S² the typical sizes on the diagonal: `positive_definite`.
- L and c L + dF(t, q)/dt have the same motions, so two learned Lagrangians cannot be compared as functions:
  `same_motion` and `disagreement` compare accelerations.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.jaxtools import at_once
from lagjax.mechanics import accelerations, mass_matrix
from lagjax.refusals import must_name
from lagjax.system import Hybrid, System, coordinates

# The points at which an activation is checked, the distance over which its curvature may not jump, and the size of a
# jump relative to the largest curvature.
CHECKED_AT, DISTANCE, JUMP = np.concatenate([np.linspace(-8.0, 8.0, 1601), [-1e3, 1e3]]), 1e-5, 0.01
# Accelerations and ratios of mass matrices that differ by less than this, relative to their size, count as the same.
SAME_BELOW = 1e-6


class Network(eqx.Module):
    """A smooth network of coordinates, for a part of a Lagrangian such as a potential.

    >>> import jax
    >>> import lagjax as lj
    >>> potential = Network({"angle": 1.0, "height": 50.0}, angles="angle", key=jax.random.key(0))
    >>> print(potential({"angle": 0.3, "height": 20.0}))
    0.0

    It is an `equinox.nn.MLP` of the coordinates, each divided by its typical size, and of the sine and cosine of
    angles, so that it is the same after a whole turn. (A network of the angle itself would be outside its training data
    after a turn.) It is zero at first, so training starts from the motion of the known part. A fit changes only the
    weights of `mlp`.

    **Arguments:**

    - `sizes`: the typical size of each coordinate, in the structure of the argument of the network.
    - `key`: a key of `jax.random`. `width`, `depth`: of the hidden layers.
    - `out`: how many numbers it returns; a scalar by default.
    - `angles`: the names of coordinates that are angles, in radians, as `lj` prints them: `"angle"`, `["q[0]"]`.
    - `activation`: a function with two continuous derivatives, such as `jnp.tanh`, `jax.nn.softplus`, `jax.nn.silu`.
    - `first`: the initial size of the weights of the last layer, relative to those drawn by equinox.

    **Raises:** `ValueError` for an activation without curvature (`relu`), with a jump in its curvature (`elu`), or that
    overflows (`log(1 + exp(x))` instead of `jax.nn.softplus`); for a size that is not positive; for a name that is not
    a coordinate.
    """

    mlp: eqx.nn.MLP
    sizes: tuple[float, ...] = eqx.field(static=True)
    angular: tuple[bool, ...] = eqx.field(static=True)

    def __init__(
        self,
        sizes: PyTree[ArrayLike],
        *,
        key: Array,
        width: int = 16,
        depth: int = 2,
        out: int | None = None,
        angles: str | Iterable[str] = (),
        activation: Callable = jnp.tanh,
        first: float = 0.0,
    ):
        names = coordinates.names(sizes)
        flat = [float(x) for leaf in jax.tree.leaves(sizes) for x in np.ravel(leaf)]
        if not all(np.isfinite(x) and x > 0 for x in flat):
            raise ValueError(f"typical sizes must be positive, not {flat}.\nFix: 1.0 for unknown sizes.")
        angles = [angles] if isinstance(angles, str) else list(angles)
        # An array of angles may also be given by its name alone.
        accepted_names = [{name, name.partition("[")[0]} for name in names]
        for angle in angles:
            if not any(angle in x for x in accepted_names):
                must_name(angle, names, "angles names", "coordinate", "angles=['{}']")
        _check_activation(activation)
        self.sizes, self.angular = tuple(flat), tuple(not x.isdisjoint(angles) for x in accepted_names)
        mlp = eqx.nn.MLP(len(flat) + sum(self.angular), out or "scalar", width, depth, activation, key=key)
        last = jax.tree.map(lambda x: first * x, mlp.layers[-1])
        self.mlp = eqx.tree_at(lambda mlp: mlp.layers[-1], mlp, last)

    def __call__(self, q: PyTree[ArrayLike]) -> Array:
        """The network at coordinates `q`: a scalar, or `(out,)`."""
        x, _ = coordinates.flatten(q)
        if x.shape != (len(self.sizes),):
            raise ValueError(f"this network takes {len(self.sizes)} numbers, but was given {x.size}.")
        inputs = [
            part
            for i, (size, angular) in enumerate(zip(self.sizes, self.angular))
            for part in ((jnp.sin(x[i]), jnp.cos(x[i])) if angular else (x[i] / size,))
        ]
        return self.mlp(jnp.stack(inputs))


def positive_definite(
    numbers: Float[ArrayLike, " k"], sizes: ArrayLike = 1.0, floor: float = 1e-3
) -> Float[Array, "n n"]:
    """Return a positive definite matrix made of any numbers, for a mass or damping matrix.

    >>> import jax
    >>> import numpy as np
    >>> matrix = jax.jit(lambda numbers: positive_definite(numbers, sizes=np.array([1.0, 4.0]), floor=0.0))
    >>> print(matrix(np.array([0.0, 0.0, 0.5])))
    [[1. 1.]
     [1. 5.]]

    `M = S (floor 1 + Λ Λᵀ) S`: the first n numbers x make the diagonal of Λ, `(x + √(x² + 4))/2`, which is 1 at 0 and
    neither reaches zero nor overflows; the others are the entries below it, row by row. S² has the `sizes` on its
    diagonal; M is close to S² if all numbers are zero. Whatever the numbers are, no direction has less than `floor` of
    its size, so that accelerations stay finite while a network that returns the numbers is trained.

    For `R = ½ vᵀ D(q) v` with such a D, which may have `floor=0.0`, the power `-vᵀ D v` is never positive. If D depends
    on v, use the force `-D(q, v) v` instead; the force `-∂R/∂v` of R could then supply energy.

    **Arguments:** `numbers` (n(n+1)/2,), or a scalar for n = 1; `sizes`, one or (n,), in the unit of the diagonal.

    **Returns:** (n, n), symmetric.

    **Raises:** `ValueError` for a wrong number of `numbers`.

    Source: Pinheiro & Bates, *Stat. Comput.* 6 (1996) 289 (parametrisations by Cholesky).
    """
    numbers = jnp.ravel(jnp.asarray(numbers))
    n = int((np.sqrt(8 * numbers.size + 1) - 1) / 2)
    if n * (n + 1) // 2 != numbers.size or n == 0:
        raise ValueError(
            f"a symmetric matrix of n rows needs n(n+1)/2 numbers (1, 3, 6, 10, ...), but there are {numbers.size}.\n"
            "Fix: lj.learned.Network(..., out=n * (n + 1) // 2)."
        )
    sizes = jnp.broadcast_to(jnp.asarray(sizes, numbers.dtype), (n,))
    # (x + √(x² + 4))/2, without its cancellation at large negative x, and without a comparison: steps would end there.
    diagonal = jnp.exp(jnp.arcsinh(numbers[:n] / 2))
    triangle = jnp.diag(diagonal).at[np.tril_indices(n, -1)].set(numbers[n:])
    scale = jnp.sqrt(sizes)
    return scale[:, None] * (floor * jnp.eye(n, dtype=numbers.dtype) + triangle @ triangle.T) * scale[None, :]


@dataclass(frozen=True)
class SameMotion:
    """Whether two systems have the same motion.

    - `differences` (N,): the differences of the accelerations at each state, relative to their typical size.
    - `same`: whether they are all below 1e-6. `worst`: the state with the largest.
    - `ratio`: M of the other system divided by M of the first, if that is one number; else NaN.
    """

    differences: Float[np.ndarray, " N"]
    ratio: float

    @property
    def same(self) -> bool:
        return bool(np.all(self.differences < SAME_BELOW))

    @property
    def worst(self) -> int:
        # A difference that is not finite counts as the largest.
        return int(np.argmax(np.where(np.isfinite(self.differences), self.differences, np.inf)))

    def __repr__(self):
        size = f"{self.differences[self.worst]:.2g}"
        if not self.same:
            return f"SameMotion: NO, accelerations differ by up to {size} of their size, most at state {self.worst}"
        if np.isnan(self.ratio):
            return "SameMotion: yes, by Lagrangians whose mass matrices are not proportional"
        return f"SameMotion: yes; the other L is {self.ratio:.6g} times the first, up to a total derivative"


def same_motion(
    system: System | Hybrid,
    other: System | Hybrid,
    q: PyTree,
    v: PyTree,
    params: PyTree = None,
    other_params: PyTree = None,
    t: ArrayLike = 0.0,
) -> SameMotion:
    """Say whether two systems have the same accelerations, and whether their Lagrangians are the same up to a gauge.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
    >>> disguised = lj.System(lambda t, q, v, params: 1.5 * v**2 + 3.0 * jnp.cos(q) + v * jnp.exp(q) - 7.0)
    >>> same_motion(swing, disguised, np.linspace(-1.0, 1.0, 5), np.linspace(2.0, 0.0, 5))
    SameMotion: yes; the other L is 3 times the first, up to a total derivative

    The motion does not distinguish L from `c L + dF(t, q)/dt`: a multiple of L, an added constant, or added terms that
    are linear in v without a curl. So comparing learned L, V or weights says nothing; comparing accelerations does.

    **Arguments:** two systems with the same coordinates; states `q`, `v`, leaves (N, ...), at `t`, one or (N,); the
    parameters of each.

    **Returns:** a `SameMotion`.

    **Raises:** the errors of `lj.accelerations`.

    Source: Goldstein, §1.4 and derivation 8 of chapter 1 (total derivatives).
    """
    q, v = jax.tree.map(jnp.asarray, (q, v))
    times = _times(t, q)

    def at_states(system: System | Hybrid, params: PyTree):
        """Accelerations (N, n) and mass matrices (N, n, n)."""

        def at(t: ArrayLike, q: PyTree, v: PyTree):
            a, _ = accelerations(system, t, q, v, params)
            return coordinates.flatten(a)[0], mass_matrix(system, t, q, v, params)

        return map(np.asarray, jax.vmap(at)(times, q, v))

    (a, m), (b, other_m) = at_states(system, params), at_states(other, other_params)
    size = np.sqrt(np.mean(a**2, axis=0))
    size = np.where(size > 0, size, np.maximum(np.sqrt(np.mean(b**2, axis=0)), np.finfo(a.dtype).tiny))
    differences = np.max(np.abs(a - b) / size, axis=1)
    ratio = np.sum(m * other_m) / np.sum(m * m)
    proportional = np.max(np.abs(other_m - ratio * m)) < SAME_BELOW * np.max(np.abs(other_m))
    return SameMotion(differences, float(ratio) if proportional else np.nan)


def disagreement(
    system: System | Hybrid, members: Sequence[PyTree], q: PyTree, v: PyTree, t: ArrayLike = 0.0
) -> PyTree[Float[Array, "N ..."]]:
    """Return the spread of the accelerations of several trained models, which is large where they lack data.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    >>> print(disagreement(spring, [{"k": 1.0}, {"k": 3.0}], jnp.array([0.0, 0.5, 2.0]), jnp.zeros(3)))
    [0.         0.70710678 2.82842712]

    Members trained from different weights, or on different records, agree where the data determine them and differ
    elsewhere. This is their spread, not their error: effects that all members lack do not show.

    **Arguments:** the `system` with parameters of each of two `members` or more; states as for `same_motion`.

    **Returns:** the standard deviation of the accelerations, like `q`, `[q]/[t]²`.

    **Raises:** `ValueError` for fewer than two members.

    Source: Lakshminarayanan, Pritzel & Blundell, arXiv:1612.01474 (deep ensembles).
    """
    if len(members) < 2:
        raise ValueError(
            "a single model has nothing to disagree with.\nFix: several fits, with different keys of their networks."
        )
    times = _times(t, q)

    def at_states(params: PyTree):
        return jax.vmap(lambda t, q, v: accelerations(system, t, q, v, params)[0])(times, q, v)

    return jax.tree.map(lambda *a: jnp.std(jnp.stack(a), axis=0, ddof=1), *map(at_states, members))


def _times(t: ArrayLike, q: PyTree) -> Array:
    """The time of each state."""
    return jnp.broadcast_to(jnp.asarray(t, jnp.result_type(float)), jnp.shape(jax.tree.leaves(q)[0])[:1])


def _check_activation(activation: Callable):
    with at_once():
        curvature = jax.jit(jax.vmap(jax.grad(jax.grad(lambda x: activation(x)))))
        at, nearby = (np.asarray(curvature(x)) for x in (CHECKED_AT, CHECKED_AT + DISTANCE))
    if not np.all(np.isfinite(at)):
        raise ValueError(
            f"the activation {activation!r:.60} has no finite curvature at {CHECKED_AT[~np.isfinite(at)][0]:g}.\n"
            "Usual cause: log(1 + exp(x)), which overflows.\nFix: jax.nn.softplus, jnp.tanh, jax.nn.silu."
        )
    largest = np.max(np.abs(at))
    if largest == 0 or np.max(np.abs(nearby - at)) > JUMP * largest:
        raise ValueError(
            f"the activation {activation!r:.60} is not smooth: its second derivative is zero, or jumps.\n"
            "Forces would jump, so that a method loses its order, and a mass matrix made of it would be singular.\n"
            "Fix: jnp.tanh, jax.nn.softplus, jax.nn.silu."
        )
