"""Mechanisms in space: Bricard's, Watt's governor, and Fekete's points, particles on a sphere.

The Lagrangian of each is derived in its docstring, in the symbols of the source.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism, rod_kinetic_energy, squared_distance
from lagjax.system import Holonomic, System


class Chain(NamedTuple):
    """Points and axes of the moving hinges, each (4, 3)."""

    points: Float[Array, "4 3"]
    axes: Float[Array, "4 3"]


BRICARD_PARAMS = {"m": 1.0, "l": 1.0, "a": 0.1, "g": 9.81}
# Handedness: u_(i+1) = HANDS[i] r_i × u_i / l, for the rods; the ground is left-handed.
HANDS = (1, -1, 1, -1, 1)


def closed(q: PyTree, params: PyTree):
    """All six points and axes, (6, 3) each, including those of the ground."""
    length = params["l"]
    first, last = jnp.zeros((1, 3), q.points.dtype), jnp.stack([0.0 * length, 0.0 * length, length])[None]
    points = jnp.concatenate([first, q.points, last])
    axes = jnp.concatenate([np.array([[0.0, 1.0, 0.0]]), q.axes, np.array([[1.0, 0.0, 0.0]])])
    return points, axes


def bricard_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Five rods of square section.

    The rectangular Bricard mechanism: six links and six hinges, mobile although the count of freedoms says it is not.

    Five rods of length l and the ground form a closed chain. The two hinges of a link are at right angles to it and to
    each other, and the handedness alternates along the chain. The start is six edges of a cube: P_0 = (0, 0, 0),
    P_1 = (1, 0, 0), P_2 = (1, -1, 0), P_3 = (1, -1, 1), P_4 = (0, -1, 1), P_5 = (0, 0, 1), with the hinges' axes
    u_0 ... u_5 along y, z, x, y, z, x. The rod i goes from P_i to P_(i+1), the ground from P_5 to P_0.

    Natural coordinates: the points P_1 ... P_4 and the unit vectors u_1 ... u_4, 24 in all (both ends of the ground are
    fixed). A rod is rigid with its two hinges fixed in it if for i = 0 ... 4

        |r_i|² = l²,    r_i·u_i = 0,    r_i·u_(i+1) = 0,    u_i·u_(i+1) = 0,    |u_i|² = 1 (i = 1 ... 4)

    with r_i = P_(i+1) - P_i: 24 equations for 24 coordinates. Only 23 are independent: one, no particular one, follows
    from the others, and one degree of freedom remains. Grübler's count for a spatial chain of six hinges gives none.

    A rod of square section has a width a, and so a second moment m a²/12, along each of its two hinges' axes,

        L = Σ_i m (|Ṗ_i|² + Ṗ_i·Ṗ_(i+1) + |Ṗ_(i+1)|²)/6 + m a² (|u̇_i|² + |u̇_(i+1)|²)/24 - ½ m g (y_i + y_(i+1))

    constant in the coordinates, and regular for a > 0.

    Hinge angles: α_0 = α_2 = α_4 = θ and α_1 = α_3 = α_5 = φ, which turn r_(i-1) into r_i about u_i, close the chain if

        cos θ + cos φ + cos θ cos φ = 0

    (`chain` builds it). This is a closed curve; the motion has one coordinate along it, which the tests integrate.

    Source: González et al., *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library, A04 (section 0.1 m:
    Simbody's and Exudyn's models); Chen, You & Tarnai, *Int. J. Solids Struct.* 42 (2005) 2287 (closure).
    """
    m, a = params["m"], params["a"]
    ground = np.zeros((1, 3))
    moves = jnp.concatenate([ground, v.points, ground])
    points, _ = closed(q, params)
    along = jnp.sum(rod_kinetic_energy(m, moves[:-1], moves[1:]))
    # Each moving axis belongs to two rods.
    across = m * a**2 / 24 * 2 * jnp.sum(v.axes**2)
    return along + across - 0.5 * m * params["g"] * jnp.sum(points[:-1, 1] + points[1:, 1])


def lengths(t, q: PyTree, params: PyTree):
    """|r_i|² = l², (5,)."""
    points, _ = closed(q, params)
    return squared_distance(points[:-1], points[1:]) - params["l"] ** 2


def hinges_across_rods(t, q: PyTree, params: PyTree):
    """r_i·u_i = 0 and r_i·u_(i+1) = 0, (10,)."""
    points, axes = closed(q, params)
    rods = points[1:] - points[:-1]
    return jnp.concatenate([jnp.sum(rods * axes[:-1], axis=1), jnp.sum(rods * axes[1:], axis=1)])


def hinges_crossed(t, q: PyTree, params: PyTree):
    """u_i·u_(i+1) = 0 on each rod, (5,)."""
    _, axes = closed(q, params)
    return jnp.sum(axes[:-1] * axes[1:], axis=1)


def unit_axes(t, q: PyTree, params: PyTree):
    """|u_i|² = 1, (4,)."""
    return jnp.sum(q.axes**2, axis=1) - 1.0


def closure(theta, phi):
    """Zero if the chain with these hinge angles closes."""
    return jnp.cos(theta) + jnp.cos(phi) + jnp.cos(theta) * jnp.cos(phi)


def chain(theta, phi, params: PyTree):
    """The chain built from its hinge angles, starting at the ground: a `Chain`, and the resulting P_5 and u_5."""
    rod, axis, point = jnp.array([0.0, 0.0, -1.0]), jnp.array([0.0, 1.0, 0.0]), jnp.zeros(3)
    points, axes = [], []
    for i, hand in enumerate(HANDS):
        angle = theta if i % 2 == 0 else phi
        rod = jnp.cos(angle) * rod + jnp.sin(angle) * jnp.cross(axis, rod)
        axis = hand * jnp.cross(rod, axis)
        point = point + params["l"] * rod
        points.append(point)
        axes.append(axis)
    return Chain(jnp.stack(points[:4]), jnp.stack(axes[:4])), points[4], axes[4]


bricard = Mechanism(
    name="bricard",
    title="Rectangular Bricard mechanism",
    source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A04",
    system=System(
        bricard_lagrangian,
        {
            "lengths": Holonomic(lengths),
            "hinges_across_rods": Holonomic(hinges_across_rods),
            "hinges_crossed": Holonomic(hinges_crossed),
            "unit_axes": Holonomic(unit_axes),
        },
    ),
    params=BRICARD_PARAMS,
    q0=Chain(
        points=np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -1.0, 1.0], [0.0, -1.0, 1.0]]),
        axes=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ),
    v0=Chain(points=np.zeros((4, 3)), axes=np.zeros((4, 3))),
    # The library uses 10 s, when it is almost at rest at the cube and has no velocity to compare.
    end=9.0,
    freedom=1,
    reference=(
        Chain(
            points=np.array(
                [
                    [0.5390642884948138, 0.0, -0.8422646216419043],
                    [0.29260958613772714, -0.8893691432776416, -0.45718981505015427],
                    [0.5390642884948141, -1.638453308240369, 0.15773537835809542],
                    [0.0, -0.8893691432776419, 0.5428101849498461],
                ]
            ),
            axes=np.array(
                [
                    [0.8422646216419043, 0.0, 0.5390642884948138],
                    [0.479427144430204, -0.4571898150501539, -0.7490841649627273],
                    [0.8422646216419043, 0.47942714443020407, 0.2464547023570869],
                    [0.0, -0.4571898150501546, 0.8893691432776415],
                ]
            ),
        ),
        Chain(
            points=np.array(
                [
                    [1.6947447523121018, 0.0, 1.084666683855869],
                    [1.092203909327236, -0.16428834928202965, 0.31958933388625],
                    [1.6947447523121029, 0.6620064657324634, 1.08466668385587],
                    [0.0, -0.16428834928202918, 0.31958933388625155],
                ]
            ),
            axes=np.array(
                [
                    [-1.084666683855869, 0.0, 1.6947447523121018],
                    [1.5958156705517976, 0.31958933388624977, 0.826294815014493],
                    [-1.0846666838558687, 1.5958156705517983, 0.6025408429848664],
                    [0.0, 0.319589333886249, 0.16428834928203218],
                ]
            ),
        ),
    ),
    origin="SciPy's DOP853 at 3e-14 on the curve of closed chains; the tests recompute it",
    digits=12,
)


class GovernorParts(NamedTuple):
    """The shaft's angle, the slider's height, and the two balls, (3,) each."""

    psi: Float[Array, ""] | float
    z: Float[Array, ""] | float
    C: Float[Array, "3"]
    D: Float[Array, "3"]


# Density 3000 kg/m³: shaft and rods 1 x 0.01 x 0.01 m, slider a cube of 0.1 m; `I` includes shaft and slider.
GOVERNOR_PARAMS = {
    "I": 0.3 * 0.01**2 / 6 + 3.0 * 0.1**2 / 6, "slider": 3.0, "rod": 0.3, "ball": 5.0, "l": 1.0, "b": 0.05, "h": 1.0,
    "k": 8e5, "c": 4e4, "l0": 0.5, "g": 9.81,
}  # fmt: skip


def frame(psi):
    """The unit vectors e, along the plane of the rods, and n, across it."""
    cos, sin, zero = jnp.cos(psi), jnp.sin(psi), jnp.zeros_like(psi)
    return jnp.stack([cos, sin, zero]), jnp.stack([-sin, cos, zero])


def rods(q: PyTree, params: PyTree):
    """(start, end) of both rods, (2, 3) each."""
    e, _ = frame(q.psi)
    top = jnp.stack([0.0 * params["h"], 0.0 * params["h"], params["h"]])
    return jnp.stack([top + params["b"] * e, top - params["b"] * e]), jnp.stack([q.C, q.D])


def springs(q: PyTree, params: PyTree):
    """The lengths of both springs, (2,)."""
    start, end = rods(q, params)
    e, _ = frame(q.psi)
    slider = jnp.stack([jnp.zeros_like(q.z), jnp.zeros_like(q.z), q.z])
    feet = jnp.stack([slider + params["b"] * e, slider - params["b"] * e])
    return jnp.sqrt(squared_distance(feet, 0.5 * (start + end)))


def governor_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Shaft and slider, two rods, two balls, gravity along -z, two springs.

    Watt's flyball governor with stiff links: a freely turning shaft, two hinged rods with balls, and a slider.

    The shaft turns by ψ about z. Two rods of mass m and length l are hinged to its top at

        A = (b e, h),    B = (-b e, h),     e = (cos ψ, sin ψ, 0)

    in the plane that turns with it, with a ball of mass M at their far ends C and D. A slider of mass m_s slides along
    the shaft at the height z and turns with it. A spring-damper (stiffness k, damping c, rest length l0) joins each
    rod's middle to the slider at ±b e:

        L = ½ I ψ̇² + ½ m_s ż² + Σ [½ M |Ċ|² + m (|Ȧ|² + Ȧ·Ċ + |Ċ|²)/6]
            - g [m_s z + Σ (M z_C + ½ m (h + z_C))] - ½ k Σ (s - l0)²,          R = ½ c Σ ṡ²

    with s the length of a spring and I the inertia of shaft and slider about the axis. ψ, z, C, D are eight
    coordinates; each rod keeps its length and stays in the plane (n = (-sin ψ, cos ψ, 0)):

        |C - A|² = l²,    C·n = 0,        |D - B|² = l²,    D·n = 0

    There are four degrees of freedom, two of which are not excited, by symmetry: with both rods at the angle α below
    the horizontal, p = ∂L/∂ψ̇ is constant and the reference integrates two equations for (α, z). The springs'
    relaxation rate is about c/m_s, 10⁴ times that of the motion. The rods are slender here (their section would add
    10⁻⁶ of the inertia).

    Source: González et al., *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library, A05
    (the hinges' offset b and the rods below the horizontal: as in Exudyn's model of it).
    """
    p = params
    (start, end), (start_velocity, end_velocity) = jax.jvp(lambda q: rods(q, params), (q,), (v,))
    kinetic = 0.5 * p["I"] * v.psi**2 + 0.5 * p["slider"] * v.z**2
    kinetic += 0.5 * p["ball"] * jnp.sum(end_velocity**2)
    kinetic += jnp.sum(rod_kinetic_energy(p["rod"], start_velocity, end_velocity))
    heights = p["slider"] * q.z + jnp.sum(p["ball"] * end[:, 2] + 0.5 * p["rod"] * (start[:, 2] + end[:, 2]))
    return kinetic - p["g"] * heights - 0.5 * p["k"] * jnp.sum((springs(q, p) - p["l0"]) ** 2)


def governor_dissipation(t, q: PyTree, v: PyTree, params: PyTree):
    """Rayleigh's function of the two dampers."""
    _, rates = jax.jvp(lambda q: springs(q, params), (q,), (v,))
    return 0.5 * params["c"] * jnp.sum(rates**2)


def rod_lengths(t, q: PyTree, params: PyTree):
    """Each ball is one length from its hinge, (2,)."""
    return squared_distance(*rods(q, params)) - params["l"] ** 2


def rod_planes(t, q: PyTree, params: PyTree):
    """Each ball is in the plane that turns with the shaft, (2,)."""
    _, n = frame(q.psi)
    return jnp.stack([q.C @ n, q.D @ n])


# Rods 30 degrees below the horizontal, springs at their rest length, everything turning with the shaft at 2 π rad/s.
REACH = 0.05 + 0.5 * 3.0**0.5
RATE = 2 * np.pi

governor = Mechanism(
    name="governor",
    title="Stiff flyball governor",
    source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A05",
    system=System(
        governor_lagrangian,
        {"rod_lengths": Holonomic(rod_lengths), "rod_planes": Holonomic(rod_planes)},
        dissipation=governor_dissipation,
    ),
    params=GOVERNOR_PARAMS,
    q0=GovernorParts(psi=0.0, z=0.5, C=np.array([REACH, 0.0, 0.5]), D=np.array([-REACH, 0.0, 0.5])),
    v0=GovernorParts(psi=RATE, z=0.0, C=np.array([0.0, RATE * REACH, 0.0]), D=np.array([0.0, -RATE * REACH, 0.0])),
    end=10.0,
    freedom=4,
    reference=(
        GovernorParts(
            psi=55.93539999404147,
            z=0.6196198224120089,
            C=np.array([0.7972290289444487, -0.5610850470625497, 0.6197403232129428]),
            D=np.array([-0.7972290289444487, 0.5610850470625497, 0.6197403232129428]),
        ),
        GovernorParts(
            psi=5.548217317680775,
            z=-0.7476045185405928,
            C=np.array([2.8616156116529217, 4.6001380663079114, -0.7477370057722393]),
            D=np.array([-2.8616156116529217, -4.6001380663079114, -0.7477370057722393]),
        ),
    ),
    origin="SciPy's Radau at 1e-13 on the equations of α and z, DOP853 agrees; the tests recompute it",
    digits=12,
)


FEKETE_PARAMS = {"alpha": 0.5}


def fekete_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Unit masses at p (N, 3), with a logarithmic potential between each pair.

    Fekete points: twenty particles on a sphere push each other apart until they rest.

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
    first, second = np.triu_indices(q.shape[0], 1)
    return 0.5 * jnp.sum(v**2) + 0.5 * jnp.sum(jnp.log(jnp.sum((q[first] - q[second]) ** 2, axis=1)))


def fekete_friction(t, q: PyTree, v: PyTree, params: PyTree):
    """Rayleigh's function of a viscous medium."""
    return 0.5 * params["alpha"] * jnp.sum(v**2)


def sphere(t, q: PyTree, params: PyTree):
    """Every particle stays on the unit sphere, (N,)."""
    return jnp.sum(q**2, axis=1) - 1.0


# For each ring: number of points, latitude, offset of longitude, and index of its first point.
RINGS = ((3, 3 / 8, 1 / 13, 1), (7, 1 / 8, 1 / 29, 1), (6, -2 / 15, 1 / 7, 1), (4, -3 / 10, 1 / 17, 0))


def fekete_start():
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

fekete = Mechanism(
    name="fekete",
    title="Fekete points",
    source="Bari test set for IVP solvers, problem 'fekete'",
    system=System(fekete_lagrangian, {"sphere": Holonomic(sphere)}, dissipation=fekete_friction),
    params=FEKETE_PARAMS,
    q0=fekete_start(),
    v0=np.zeros((20, 3)),
    end=1000.0,
    freedom=40,
    reference=(REST, np.zeros((20, 3))),
    origin="RADAU5 at tolerance 1e-12 (Bari test set)",
    digits=10,
    # The reference velocity is zero, so its error is absolute.
)
