"""For Lagrangians with a network in them: what saves from the known traps of learning one from motion.

`lj.fit` trains, with an optimiser of optax or by Levenberg-Marquardt; any module of equinox, or plain arrays in
`params`, can be learned. What is here is only what goes wrong by itself otherwise:

- A force is a slope of L, so a network inside of it needs two continuous derivatives: `Network`.
- A mass matrix M must stay regular on the way, and what takes energy away must not give any. Both are

      M = S (floor 1 + Λ Λᵀ) S,

  Λ lower triangular with a positive diagonal, S² the typical sizes on the diagonal: `positive_definite`.
- L and c L + dF(t, q)/dt have the same motions, so that two that were learned cannot be compared as functions:
  `same_motion` and `disagreement` compare accelerations.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.mechanics import coordinates
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.lagrangian import mass_matrix
from lagjax.mechanics.multipliers import accelerations

# Where an activation is looked at, and what is a jump of its curvature there, as a part of the largest.
LOOKED_AT, NEAR, JUMP = np.concatenate([np.linspace(-8.0, 8.0, 1601), [-1e3, 1e3]]), 1e-5, 0.01
# Accelerations that differ by less, relative to their size, are the same; so are ratios of mass matrices.
SAME = 1e-6


class Network(eqx.Module):
    """A smooth network of coordinates, for a part of a Lagrangian: a potential, say.

    >>> import jax
    >>> import lagjax as lj
    >>> potential = Network({"angle": 1.0, "height": 50.0}, angles="angle", key=jax.random.key(0))
    >>> print(potential({"angle": 0.3, "height": 20.0}))
    0.0

    It is an `equinox.nn.MLP` of the coordinates, each over its typical size, and of angles their sine and cosine, so
    that it is the same after a whole turn. (A network of the angle itself, after a turn, is outside of what it has
    seen.) It begins as zero: the motion from which training starts is that of what is known. Only the weights of `mlp`
    are numbers that a fit finds.

    **Arguments:**

    - `sizes`: the typical size of each coordinate, in the structure of what the network is called with.
    - `key`: a key of `jax.random`. `width`, `depth`: of the hidden layers.
    - `out`: how many numbers it returns; a scalar by default.
    - `angles`: the names of coordinates that are angles, in radians, as `lj` writes them: `"angle"`, `["q[0]"]`.
    - `activation`: with two continuous derivatives, as `jnp.tanh`, `jax.nn.softplus`, `jax.nn.silu`.
    - `first`: how large the weights of the last layer are at first, relative to those that equinox draws.

    **Raises:** `ValueError` for an activation without curvature (`relu`), with a jump in it (`elu`), or that overflows
    (`log(1 + exp(x))`, which is `jax.nn.softplus` written out); for a size that is not positive; for a name that no
    coordinate has.
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
            raise ValueError(f"typical sizes must be positive, not {flat}.\nFix: 1.0 where nothing is known.")
        angles = [angles] if isinstance(angles, str) else list(angles)
        # An array of angles by its name, too.
        called = [{name, name.partition("[")[0]} for name in names]
        wrong = [angle for angle in angles if not any(angle in x for x in called)]
        if wrong:
            raise ValueError(f"angles names {listed(wrong)}, and the coordinates are {listed(names)}.")
        _check_activation(activation)
        self.sizes, self.angular = tuple(flat), tuple(not x.isdisjoint(angles) for x in called)
        mlp = eqx.nn.MLP(len(flat) + sum(self.angular), out or "scalar", width, depth, activation, key=key)
        last = lambda mlp: (mlp.layers[-1].weight, mlp.layers[-1].bias)
        self.mlp = eqx.tree_at(last, mlp, tuple(first * x for x in last(mlp)))

    def __call__(self, q: PyTree[ArrayLike]) -> Array:
        """The network at coordinates `q`: a scalar, or `(out,)`."""
        x, _ = coordinates.flatten(q)
        if x.shape != (len(self.sizes),):
            raise ValueError(f"this network takes {len(self.sizes)} numbers, and was given {x.size}.")
        of = [
            part
            for i, (size, angular) in enumerate(zip(self.sizes, self.angular))
            for part in ((jnp.sin(x[i]), jnp.cos(x[i])) if angular else (x[i] / size,))
        ]
        return self.mlp(jnp.stack(of))


def positive_definite(
    numbers: Float[ArrayLike, " k"], sizes: ArrayLike = 1.0, floor: float = 1e-3
) -> Float[Array, "n n"]:
    """Return a positive definite matrix made of any numbers: a mass matrix, or one of damping.

    >>> import jax.numpy as jnp
    >>> print(positive_definite(jnp.array([0.0, 0.0, 0.5]), sizes=jnp.array([1.0, 4.0]), floor=0.0))
    [[1. 1.]
     [1. 5.]]

    `M = S (floor 1 + Λ Λᵀ) S`: the first n numbers x make the diagonal of Λ, `(x + √(x² + 4))/2`, which is 1 at 0 and
    neither reaches zero nor overflows; the others stand below it, row by row. S² has the `sizes` on its diagonal, to
    which M is near where all numbers are zero. Whatever the numbers are, no direction has less than `floor` of its
    size, so that the accelerations stay finite while a network that gives the numbers is being trained.

    For `R = ½ vᵀ D(q) v` with such a D, which may have `floor=0.0`, the power `-vᵀ D v` is never positive. Where D is
    to depend on v, give the force `-D(q, v) v`; R would have the force `-∂R/∂v`, which may then push.

    **Arguments:** `numbers` (n(n+1)/2,), or a scalar for n = 1; `sizes`, one or (n,), in the unit of the diagonal.

    **Returns:** (n, n), symmetric.

    **Raises:** `ValueError` for another number of them.

    Source: Pinheiro & Bates, *Stat. Comput.* 6 (1996) 289 (parametrisations by Cholesky).
    """
    numbers = jnp.ravel(jnp.asarray(numbers))
    n = int((np.sqrt(8 * numbers.size + 1) - 1) / 2)
    if n * (n + 1) // 2 != numbers.size or n == 0:
        raise ValueError(
            f"a symmetric matrix of n rows has n(n+1)/2 numbers (1, 3, 6, 10, ...), and there are {numbers.size}.\n"
            "Fix: lj.learned.Network(..., out=n * (n + 1) // 2)."
        )
    sizes = jnp.broadcast_to(jnp.asarray(sizes, numbers.dtype), (n,))
    x = numbers[:n]
    root = jnp.sqrt(x**2 + 4)
    # Of a large negative number the sum would be what rounding leaves. (`minimum` has half a slope at 0.)
    diagonal = jnp.where(x > 0, (x + root) / 2, 2 / (root - jnp.where(x > 0, 0.0, x)))
    triangle = jnp.diag(diagonal).at[np.tril_indices(n, -1)].set(numbers[n:])
    scale = jnp.sqrt(sizes)
    return scale[:, None] * (floor * jnp.eye(n, dtype=numbers.dtype) + triangle @ triangle.T) * scale[None, :]


@dataclass(frozen=True)
class SameMotion:
    """Whether two systems mean the same motion.

    - `differences` (N,): of the accelerations at each state, relative to their typical size.
    - `same`: whether they are all below 1e-6. `worst`: the state with the largest.
    - `ratio`: M of the other over M of the first, where that is one number; else NaN.
    """

    differences: Float[np.ndarray, " N"]
    ratio: float

    @property
    def same(self) -> bool:
        return bool(np.all(self.differences < SAME))

    @property
    def worst(self) -> int:
        # Where one is not finite, that.
        return int(np.argmax(np.where(np.isfinite(self.differences), self.differences, np.inf)))

    def __repr__(self):
        size = f"{self.differences[self.worst]:.2g}"
        if not self.same:
            return f"SameMotion: NO, accelerations differ by up to {size} of their size, most at state {self.worst}"
        if np.isnan(self.ratio):
            return "SameMotion: yes, by Lagrangians whose mass matrices are not proportional"
        return f"SameMotion: yes; the other L is {self.ratio:.6g} times the first, but for a total derivative"


def same_motion(
    system, other, q, v, params: PyTree = None, other_params: PyTree = None, t: ArrayLike = 0.0
) -> SameMotion:
    """Say whether two systems have the same accelerations, and whether their Lagrangians are the same up to a gauge.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))
    >>> disguised = lj.System(lambda t, q, v, params: 1.5 * v**2 + 3.0 * jnp.cos(q) + v * jnp.exp(q) - 7.0)
    >>> same_motion(swing, disguised, jnp.linspace(-1.0, 1.0, 5), jnp.linspace(2.0, 0.0, 5))
    SameMotion: yes; the other L is 3 times the first, but for a total derivative

    The motion does not tell L from `c L + dF(t, q)/dt`: a number times L, a constant, what is linear in v and has no
    curl. So L, V or weights that were learned say nothing where they stand side by side; accelerations do.

    **Arguments:** two systems with the same coordinates; states `q`, `v`, leaves (N, ...), at `t`, one or (N,); the
    parameters of each.

    **Returns:** a `SameMotion`.

    **Raises:** as `lj.accelerations`.

    Source: Goldstein, §1.4 and derivation 8 of chapter 1 (total derivatives).
    """
    a, m = _at_states(system, t, q, v, params)
    b, other_m = _at_states(other, t, q, v, other_params)
    size = np.sqrt(np.mean(a**2, axis=0))
    size = np.where(size > 0, size, np.maximum(np.sqrt(np.mean(b**2, axis=0)), np.finfo(a.dtype).tiny))
    differences = np.max(np.abs(a - b) / size, axis=1)
    ratio = np.sum(m * other_m) / np.sum(m * m)
    proportional = np.max(np.abs(other_m - ratio * m)) < SAME * np.max(np.abs(other_m))
    return SameMotion(differences, float(ratio) if proportional else np.nan)


def disagreement(system, members: Sequence[PyTree], q, v, t: ArrayLike = 0.0) -> PyTree[Float[Array, "N ..."]]:
    """Return how far the accelerations of several trained models are apart: where they have not seen enough.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    >>> print(disagreement(spring, [{"k": 1.0}, {"k": 3.0}], jnp.array([0.0, 0.5, 2.0]), jnp.zeros(3)))
    [0.         0.70710678 2.82842712]

    Members that start from other weights, or see other records, agree where the data decide and go apart where they do
    not. It is the spread that is left, not the error: what all members leave out does not show.

    **Arguments:** the `system` with parameters of each of two `members` or more; states as for `same_motion`.

    **Returns:** the standard deviation of the accelerations, like `q`, `[q]/[t]²`.

    **Raises:** `ValueError` for fewer than two members.

    Source: Lakshminarayanan, Pritzel & Blundell, arXiv:1612.01474 (deep ensembles).
    """
    if len(members) < 2:
        raise ValueError(
            "one model has nothing to disagree with.\nFix: several fits, with other keys of their networks."
        )
    times = jnp.broadcast_to(jnp.asarray(t, jnp.result_type(float)), (jnp.shape(jax.tree.leaves(q)[0])[0],))
    each = lambda params: jax.vmap(lambda t, q, v: accelerations(system, t, q, v, params)[0])(times, q, v)
    return jax.tree.map(lambda *a: jnp.std(jnp.stack(a), axis=0, ddof=1), *map(each, members))


def _at_states(system, t, q, v, params):
    """Accelerations (N, n) and mass matrices (N, n, n)."""
    q, v = jax.tree.map(jnp.asarray, (q, v))
    times = jnp.broadcast_to(jnp.asarray(t, jnp.result_type(float)), (jax.tree.leaves(q)[0].shape[0],))

    def at(t, q, v):
        a, _ = accelerations(system, t, q, v, params)
        return coordinates.flatten(a)[0], mass_matrix(system, t, q, v, params)

    return tuple(map(np.asarray, jax.vmap(at)(times, q, v)))


def _check_activation(activation):
    with jax.ensure_compile_time_eval():
        curvature = jax.vmap(jax.grad(jax.grad(lambda x: activation(x))))
        at = np.asarray(curvature(jnp.asarray(LOOKED_AT)))
        beside = np.asarray(curvature(jnp.asarray(LOOKED_AT + NEAR)))
    if not np.all(np.isfinite(at)):
        raise ValueError(
            f"the activation {activation!r:.60} has no finite curvature at {LOOKED_AT[~np.isfinite(at)][0]:g}.\n"
            "Usual cause: log(1 + exp(x)), which overflows.\nFix: jax.nn.softplus, jnp.tanh, jax.nn.silu."
        )
    largest = np.max(np.abs(at))
    if largest == 0 or np.max(np.abs(beside - at)) > JUMP * largest:
        raise ValueError(
            f"the activation {activation!r:.60} is not smooth: its second derivative is zero, or jumps.\n"
            "Then forces jump, where a method loses its order, and a mass matrix that is made of it is singular.\n"
            "Fix: jnp.tanh, jax.nn.softplus, jax.nn.silu."
        )
