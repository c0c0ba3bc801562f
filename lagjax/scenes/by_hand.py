"""The equations of motion of the scenes, derived by hand with care; lagjax's own are compared with them.

Each function returns accelerations like q and multipliers by constraint name, as `lj.accelerations` does. They are
functions of the whole state: a hoop's r is taken from q although the contact holds it at R + a, so they agree with the
equations from L even if the constraints are violated. Divisions by constants are written so that a compiler can move
them out of a loop. The potentials' gradients use simplifications that differentiation cannot find: terms inside the
logarithms and square roots cancel, and by Gauss's theorem a field is a surface integral.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.scenes import potentials


def geodesic(t, q: PyTree, v: PyTree, params: PyTree):
    """ψ'' = sin ψ cos ψ + 2 ψ'² cot ψ."""
    s, c = jnp.sin(q), jnp.cos(q)
    return c * (s + 2 * v**2 / s), {}


def on_sphere(t, q: PyTree, v: PyTree, params: PyTree):
    """r̈ = 2 λ r with λ = -½ v²/r²."""
    rate = -jnp.sum(v**2) / jnp.sum(q**2)
    return rate * q, {"sphere": 0.5 * rate}


def rolling(t, q: PyTree, v: PyTree, params: PyTree):
    """r̈ = 0, with the rolling constraint eliminated: (r² + β l²) θ̈ = -r (g cos θ + 2 ṙ θ̇)."""
    m, l, beta, g = params["m"], params["R"] + params["a"], params["beta"], params["g"]
    r = q["r"]
    theta = -r * (g * jnp.cos(q["theta"]) + 2 * v["r"] * v["theta"]) / (r**2 + beta * l**2)
    normal = m * (g * jnp.sin(q["theta"]) - r * v["theta"] ** 2)
    a = {"r": jnp.zeros_like(r), "theta": theta, "phi": -(l / params["a"]) * theta}
    return a, {"contact": normal, "rolling": -(beta * m * l) * theta}


def bead(t, q: PyTree, v: PyTree, params: PyTree):
    """ψ̈ = sin ψ (ω² cos ψ - g/a), Eq. (13)."""
    return jnp.sin(q) * (params["omega"] ** 2 * jnp.cos(q) - params["g"] / params["a"]), {}


def driven_bead(t, q: PyTree, v: PyTree, params: PyTree):
    """θ̈ = 0, and the motor's torque is the rate of change of m a² sin²ψ θ̇."""
    s, c = jnp.sin(q["psi"]), jnp.cos(q["psi"])
    psi = s * (v["theta"] ** 2 * c - params["g"] / params["a"])
    torque = (2 * params["m"] * params["a"] ** 2) * s * c * v["psi"] * v["theta"]
    return {"psi": psi, "theta": jnp.zeros_like(psi)}, {"motor": torque}


def rails_in_the_lab(t, q: PyTree, v: PyTree, params: PyTree):
    """Two rotating springs."""
    K, k = params["K"] / params["m"], params["k"] / params["m"]
    c, s = jnp.cos(params["omega"] * t), jnp.sin(params["omega"] * t)
    along, across = K * (q["x"] * c + q["y"] * s - params["R0"]), k * (q["y"] * c - q["x"] * s)
    return {"x": across * s - along * c, "y": -along * s - across * c}, {}


def rails_rotating(t, q: PyTree, v: PyTree, params: PyTree):
    """Eq. (15) without its misprints."""
    m, omega = params["m"], params["omega"]
    K, k = params["K"] / m, params["k"] / m
    return {
        "R": 2 * omega * v["r"] + (omega**2 - K) * q["R"] + K * params["R0"],
        "r": -2 * omega * v["R"] + (omega**2 - k) * q["r"],
    }, {}


def field_of_plane(q: PyTree, params: PyTree):
    """-2π G σ towards the plane."""
    z = -2 * jnp.pi * params["G"] * params["sigma"] * jnp.sign(q["z"])
    return jnp.zeros_like(z), jnp.zeros_like(z), z


def field_of_half_plane(q: PyTree, params: PyTree):
    """-G σ (ln(y² + z²), 2 atan2(|z|, -y)): the rest of the derivative cancels."""
    strength = -params["G"] * params["sigma"]
    y, z = q["y"], q["z"]
    turned = 2 * strength * jnp.sign(z) * jnp.arctan2(jnp.abs(z), -y)
    return jnp.zeros_like(y), strength * jnp.log(y**2 + z**2), turned


def field_of_cylinder(q: PyTree, params: PyTree):
    """-2π G ρ s inside, times a²/s² outside."""
    a2, s2 = params["a"] ** 2, q["x"] ** 2 + q["y"] ** 2
    strength = -2 * jnp.pi * params["G"] * params["rho"] * jnp.where(s2 < a2, 1.0, a2 / s2)
    return strength * q["x"], strength * q["y"], jnp.zeros_like(s2)


def field_of_finite_cylinder(q: PyTree, params: PyTree):
    """-G ρ ∮ n dS / |r' - r|: the z component from the lids, the others from the side. Inaccurate far away."""
    a, b, x, y, z = params["a"], params["b"], q["x"], q["y"], q["z"]
    angles, weights = potentials.clustered_nodes(96, 1e-4)
    azimuth = jnp.arctan2(y, x)
    c, s = jnp.cos(azimuth + angles), jnp.sin(azimuth + angles)
    d2 = (x - a * c) ** 2 + (y - a * s) ** 2
    surface = weights * a * (a - x * c - y * s)
    sides, lids = 0.0, []
    for height in (b - z, b + z):
        distance, root = jnp.abs(height), jnp.sqrt(d2 + height**2)
        sides += jnp.where(height < 0, -1.0, 1.0) * jnp.log((distance + root) / jnp.sqrt(d2))
        lids.append(jnp.sum(surface / (root + distance)))
    strength = -params["G"] * params["rho"]
    side = weights * a * sides
    return strength * jnp.sum(side * c), strength * jnp.sum(side * s), strength * (lids[0] - lids[1])


def field_of_elliptic_cylinder(q: PyTree, params: PyTree):
    """-4π G ρ a b (x/A, y/B) / (A + B): the potential is stationary in the confocal coordinate."""
    a, b, x, y = params["a"], params["b"], q["x"], q["y"]
    p = 0.5 * (x**2 + y**2 - a**2 - b**2)
    r = (x * b) ** 2 + (y * a) ** 2 - (a * b) ** 2
    confocal = jnp.where(r > 0, p + jnp.sqrt(p**2 + jnp.maximum(r, 0.0)), 0.0)
    A, B = jnp.sqrt(a**2 + confocal), jnp.sqrt(b**2 + confocal)
    strength = -4 * jnp.pi * params["G"] * params["rho"] * a * b / (A + B)
    return strength * x / A, strength * y / B, jnp.zeros_like(x)


def field_of_dumbbell(q: PyTree, params: PyTree):
    """Two balls (points outside, springs inside) and a rod, whose Φ depends on the sum of distances from its ends."""
    x, y, z, c, half = q["x"], q["y"], q["z"], params["c"], 0.5 * params["length"]
    s2, radius = x**2 + y**2, params["radius"]

    def ball(mass, height):
        r2 = s2 + height**2
        return mass / jnp.where(r2 < radius**2, radius**3, r2 * jnp.sqrt(r2))

    one, two = ball(params["M1"], z - c), ball(params["M2"], z + c)
    e1, e2 = 1 / jnp.sqrt(s2 + (z - half) ** 2), 1 / jnp.sqrt(s2 + (z + half) ** 2)
    total = 1 / e1 + 1 / e2
    rod = 2 * params["rod"] / (total**2 - 4 * half**2)
    across = -params["G"] * (one + two + rod * (e1 + e2))
    along = one * (z - c) + two * (z + c) + rod * ((z - half) * e1 + (z + half) * e2)
    return across * x, across * y, -params["G"] * along


def field_of_helix(q: PyTree, params: PyTree):
    """The derivative of the sum over turns with respect to A², times the derivative of A² by the coordinates."""
    a, h, x, y = params["a"], params["h"], q["x"], q["y"]
    angles, weights = potentials.clustered_nodes(256, 0.1)
    wire = 2 * jnp.pi / h * q["z"] - angles
    c, s = jnp.cos(wire), jnp.sin(wire)
    A2, t = ((x - a * c) ** 2 + (y - a * s) ** 2) / h**2, angles / (2 * np.pi)
    n = np.arange(-potentials.DIRECT_TURNS, potentials.DIRECT_TURNS + 1)
    D2 = A2[:, None] + (t[:, None] - n) ** 2
    edge = potentials.DIRECT_TURNS + 0.5
    turns = -0.5 * jnp.sum(1 / (D2 * jnp.sqrt(D2)), axis=1) + tail_rate(A2, edge - t) + tail_rate(A2, edge + t)
    line_density = params["line_density"] * jnp.sqrt(1 + (2 * jnp.pi * a / h) ** 2)
    common = params["G"] * line_density * 2 / h**2 * weights / (2 * np.pi) * turns
    return jnp.sum(common * (x - a * c)), jnp.sum(common * (y - a * s)), (
        2 * jnp.pi * a / h * jnp.sum(common * (x * s - y * c))
    )  # fmt: skip


def tail_rate(A2, m):
    """d/d(A²) of `potentials._tail`: that of P_n(u)/Dⁿ⁺¹ with u = m/D is -½ P'_{n+1}(u)/Dⁿ⁺³."""
    D2 = A2 + m**2
    D = jnp.sqrt(D2)
    u, inverse = m / D, 1 / D2
    legendre, slope = [1.0, u], [0.0, 1.0]
    for n in range(1, 2 * len(potentials.BERNOULLI)):
        slope.append(slope[n - 1] + (2 * n + 1) * legendre[n])
        legendre.append(((2 * n + 1) * u * legendre[n] - n * legendre[n - 1]) / (n + 1))
    total, power = -0.5 / (D * (m + D)), inverse
    for i, bernoulli in enumerate(potentials.BERNOULLI):
        n = 2 * i + 1
        power = power * inverse
        total += 0.5 * (1 - 2.0**-n) * bernoulli / (n + 1) * slope[n + 1] * power
    return total


def attracted(field):
    """The accelerations of a particle in a field."""
    return lambda t, q, v, params: (dict(zip("xyz", field(q, params))), {})


FIELDS = {
    "plane": field_of_plane,
    "half plane": field_of_half_plane,
    "cylinder": field_of_cylinder,
    "finite cylinder": field_of_finite_cylinder,
    "elliptic cylinder": field_of_elliptic_cylinder,
    "dumbbell": field_of_dumbbell,
    "helix": field_of_helix,
}
