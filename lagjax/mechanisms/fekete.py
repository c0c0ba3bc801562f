"""Fekete points: twenty particles on a sphere push each other apart until they rest.

Particles p_i of unit mass on the unit sphere, with a logarithmic potential between each pair and friction α:

    L = ½ Σ |ṗ_i|² + Σ_(i<j) log |p_i - p_j|,     R = ½ α Σ |ṗ_i|²,     |p_i|² = 1

    p̈_i = Σ_(j≠i) (p_i - p_j)/|p_i - p_j|² - α ṗ_i + 2 λ_i p_i

They come to rest where Π |p_i - p_j| is stationary: the elliptic Fekete points. There, since
p_i·(p_i - p_j) = ½ |p_i - p_j|², every multiplier is

    λ_i = -(N - 1)/4

for any arrangement. The start is four rings of 3, 7, 6 and 4 points, at rest. 60 coordinates, 20 equations.

Source: Shub & Smale, *J. Complexity* 9 (1993) 4 (the points); Mazzia & Magherini, *Test Set for Initial
Value Problem Solvers* (Bari), problem "fekete" (there with a second set of multipliers, in index 2).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanisms.mechanism import Mechanism
from lagjax.system import Holonomic, System

PARAMS = {"alpha": 0.5}


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Unit masses at p (N, 3), with a logarithmic potential between each pair."""
    first, second = np.triu_indices(q.shape[0], 1)
    return 0.5 * jnp.sum(v**2) + 0.5 * jnp.sum(jnp.log(jnp.sum((q[first] - q[second]) ** 2, axis=1)))


def friction(t, q: PyTree, v: PyTree, params: PyTree):
    """Rayleigh's function of a viscous medium."""
    return 0.5 * params["alpha"] * jnp.sum(v**2)


def sphere(t, q: PyTree, params: PyTree):
    """Every particle stays on the unit sphere, (N,)."""
    return jnp.sum(q**2, axis=1) - 1.0


system = System(lagrangian, {"sphere": Holonomic(sphere)}, dissipation=friction)

# For each ring: number of points, latitude, offset of longitude, and index of its first point.
RINGS = ((3, 3 / 8, 1 / 13, 1), (7, 1 / 8, 1 / 29, 1), (6, -2 / 15, 1 / 7, 1), (4, -3 / 10, 1 / 17, 0))


def start():
    """The four rings, (20, 3)."""
    points = []
    for count, latitude, offset, from_ in RINGS:
        longitude = 2 * np.pi * (np.arange(count) + from_) / count + np.pi * offset
        height = np.full(count, np.sin(np.pi * latitude))
        points.append(np.stack([np.cos(longitude), np.sin(longitude), height], axis=1))
        points[-1][:, :2] *= np.cos(np.pi * latitude)
    return np.concatenate(points)


# At t = 1000; the velocities there are below 1e-15.
REST = np.array(
    [
        [-0.4070263380333202, 0.3463758772791802, 0.8451942450030429],
        [0.0775293475252155, -0.2628662719972299, 0.9617122871829146],
        [0.7100577833343567, 0.121294805558612, 0.6936177005172217],
        [0.2348267744557627, 0.7449277976923311, 0.6244509285956391],
        [-0.4341114738782885, 0.8785430442262876, 0.199272044423766],
        [-0.9515059600312596, 0.2203508762787005, 0.2146669498274008],
        [-0.6385191643609878, -0.4310833259390688, 0.6375425027722121],
        [-0.1464175087914336, -0.9380871635228862, 0.313933729874469],
        [0.5666974065069942, -0.6739221885076542, 0.4740073135462156],
        [0.9843259538440293, -0.1696995357819996, -0.0480050429060909],
        [0.1464175087914331, 0.9380871635228875, -0.3139337298744656],
        [-0.7092757549979014, 0.5264062637139616, -0.4688542938854929],
        [-0.8665731819284478, -0.4813878059756024, -0.1315929352982178],
        [-0.2347897778700538, -0.859434040801313, -0.4541441287957579],
        [0.5530976940074118, -0.7674370265615124, -0.3242273140037833],
        [0.7711050969896927, 0.6357041816577034, 0.03573685519777001],
        [0.7103951209379591, 0.2403570431280519, -0.6614886725910596],
        [-0.0303820873873566, 0.4501923293640461, -0.8924145871442046],
        [-0.5772996158107093, -0.1766763414971813, -0.7971892020969544],
        [0.2414481766969039, -0.3416456818373135, -0.908284650344625],
    ]
)

MECHANISM = Mechanism(
    name="fekete",
    title="Fekete points",
    source="Bari test set for IVP solvers, problem 'fekete'",
    system=system,
    params=PARAMS,
    q0=start(),
    v0=np.zeros((20, 3)),
    end=1000.0,
    freedom=40,
    reference=(REST, np.zeros((20, 3))),
    origin="RADAU5 at tolerance 1e-12 (Bari test set)",
    digits=10,
    # The reference velocity is zero, so its error is absolute.
)
