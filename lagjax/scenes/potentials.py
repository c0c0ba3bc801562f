"""Gravitational potentials of seven mass distributions, per unit of the attracted mass (source §4, a-g).

Each is a function `(q, params)` of Cartesian `q = {"x", "y", "z"}`; the force on a unit mass is -∇Φ. With
s² = x² + y² and G Newton's constant:

a  plane z = 0, σ:                 Φ = 2π G σ |z|
b  half plane y > 0, σ:            Φ = G σ [y ln(y² + z²) - 2y + 2|z| atan2(|z|, -y)]
c  cylinder of radius a, ρ:        Φ = π G ρ (s² - a²) inside, 2π G ρ a² ln(s/a) outside
d  cylinder |z| < b, ρ:            Φ = -½ G ρ ∮ (r' - r)·n / |r' - r| dS over the closed surface (below)
e  elliptic cylinder a, b, ρ:      confocal coordinate λ: x²/(a² + λ) + y²/(b² + λ) = 1 outside, λ = 0 inside;
                                   A = √(a² + λ), B = √(b² + λ):
                                   Φ = 2π G ρ a b [x²/(A(A+B)) + y²/(B(A+B)) + ln((A+B)/(a+b))]
f  balls M1, M2 at z = ±c, a rod:  -G m/ℓ ln[(e1 + e2 + ℓ)/(e1 + e2 - ℓ)], e1 and e2 to the ends of the rod
g  helix of radius a and pitch h:  Φ = -G λ ∫ (1/D - 1/D_axis) ds over the wire (below)

The half plane's force is infinite. A strip 0 < y < W has a finite one; its limit for W → ∞, after subtracting a
constant and a uniform pull 2Gσ ln W along y, is (b): only p_x and E are conserved, with or without the pull.

(d) Gauss's theorem on ∇'·(r' - r)/|r' - r| = 2/|r' - r| turns the volume integral into one over the surface.
The two radial integrals over the lids and the one along the side are elementary; one periodic integral remains.
With d² = s² + a² - 2 a s cos φ, φ measured from the particle, and D(ζ) = ∮ a(a - s cos φ)/(√(d² + ζ²) + |ζ|) dφ:

    Φ = -½ G ρ {(b - z) D(z - b) + (b + z) D(z + b) + ∮ a(a - s cos φ)[asinh((b - z)/d) + asinh((b + z)/d)] dφ}

(g) Parametrise the wire by the height h x of the particle above the wire point, |x| < ∞; k = 2π/h, χ = φ - k z:

    Φ = -G λ_z ∫ dx [1/√(A² + h² x²) - 1/√(a² + h² x²)] h,   A² = s² + a² - 2 a s cos(χ + 2π x),   λ_z = λ √(1 + k² a²)

The turns x = t - n are summed over n at fixed t: directly near the particle, by the Euler-Maclaurin formula
about half-integers far from it. The sum is periodic and analytic in t, so the trapezoidal rule over one turn converges
geometrically. For any number of nodes Φ depends only on s and χ: the screw symmetry is exact.

Nodes. A periodic integrand with all its singularities on the imaginary axis, none nearer than `nearest`, is
integrated best with nodes equally spaced in x, where dφ/dx is Jacobi's dn: a sum of hyperbolic secants. The
number of nodes grows only as the logarithm of `nearest`.

Elliptic functions by the arithmetic-geometric mean: differentiable, no loss of digits near m = 0 or m = 1.
"""

import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

# Enough for 1 - m down to 1e-150: the mean converges quadratically once the ratio is of order one.
AGM_STEPS = 12


def agm(a, b):
    """The arithmetic-geometric mean of two positive numbers."""
    for _ in range(AGM_STEPS):
        a, b = 0.5 * (a + b), jnp.sqrt(a * b)
    return a


def jacobi_elliptic(u, m, m1):
    """sn, cn and dn of u for m < 1, given with its complement m1 = 1 - m > 0 (Abramowitz & Stegun 16.4).

    Only m1 enters the recursion, so no digits are lost for m near 1; m may be negative.
    """
    a, b = jnp.ones_like(m1), jnp.sqrt(m1)
    ratios = []
    for _ in range(AGM_STEPS):
        a, b, c = 0.5 * (a + b), jnp.sqrt(a * b), 0.5 * (a - b)
        ratios.append(c / a)
    angle = 2.0**AGM_STEPS * a * u
    for ratio in reversed(ratios):
        angle = 0.5 * (angle + jnp.arcsin(ratio * jnp.sin(angle)))
    sn, cn = jnp.sin(angle), jnp.cos(angle)
    return sn, cn, jnp.sqrt(jnp.where(m < 0, 1 - m * sn**2, m1 + m * cn**2))


# Bernoulli numbers B_2, B_4, ... of the Euler-Maclaurin formula.
BERNOULLI = (1 / 6, -1 / 30, 1 / 42, -1 / 30, 5 / 66, -691 / 2730)
# Turns summed directly on each side: with six terms of Euler-Maclaurin for the rest, an error of 1e-13.
DIRECT_TURNS = 8
# Beyond this many radii the surface integral of (d) loses digits; multipoles to l = 4 have an error of 1e-12.
FAR = 100.0


def plane(q: PyTree, params: PyTree):
    """(a) The plane z = 0. On it, where the force jumps, its gradient is the mean: zero."""
    return 2 * jnp.pi * params["G"] * params["sigma"] * _absolute(q["z"])


def half_plane(q: PyTree, params: PyTree):
    """(b) The half plane z = 0, y > 0 without its uniform infinite pull; the field is singular at y = z = 0."""
    y, z = q["y"], _absolute(q["z"])
    # 2 |z| atan2(|z|, -y) is π|z| + 2z atan(y/z) without the division: smooth through z = 0 where y < 0.
    bracket = y * jnp.log(y**2 + z**2) - 2 * y + 2 * z * jnp.arctan2(z, -y)
    return params["G"] * params["sigma"] * bracket


def strip(q: PyTree, params: PyTree):
    """The strip z = 0, 0 < y < W, relative to line sources with the potential ln 1 = 0 at unit distance."""
    z = _absolute(q["z"])

    def primitive(u):
        return u * jnp.log(u**2 + z**2) - 2 * u + 2 * z * jnp.arctan2(u, z)

    return params["G"] * params["sigma"] * (primitive(params["width"] - q["y"]) - primitive(-q["y"]))


def cylinder(q: PyTree, params: PyTree):
    """(c) The infinite circular cylinder; Φ = 0 on its surface."""
    a = params["a"]
    s2 = q["x"] ** 2 + q["y"] ** 2
    inside = s2 < a**2
    outer = a**2 * jnp.log(jnp.where(inside, a**2, s2) / a**2)
    return jnp.pi * params["G"] * params["rho"] * jnp.where(inside, s2 - a**2, outer)


def finite_cylinder(q: PyTree, params: PyTree, nodes=96, nearest=1e-4):
    """(d) The circular cylinder |z| < b. On the side itself its field has an error of `nearest`/10."""
    a, b = params["a"], params["b"]
    r2 = q["x"] ** 2 + q["y"] ** 2 + q["z"] ** 2
    far = r2 > FAR**2 * (a**2 + b**2)
    near_q = jax.tree.map(lambda x: jnp.where(far, 0.0, x), q)
    far_q = {k: jnp.where(far, x, FAR * a) for k, x in q.items()}
    near = _finite_cylinder_near(near_q, a, b, *clustered_nodes(nodes, nearest))
    return params["G"] * params["rho"] * jnp.where(far, _finite_cylinder_far(far_q, a, b), near)


def elliptic_cylinder(q: PyTree, params: PyTree):
    """(e) The infinite elliptic cylinder with semi-axes a along x, b along y; Φ = 0 on the axis."""
    a, b, x2, y2 = params["a"], params["b"], q["x"] ** 2, q["y"] ** 2
    # λ² + p λ + r = 0, with r < 0 outside; for p > 0 the other form of the root avoids cancellation.
    p = a**2 + b**2 - x2 - y2
    r = a**2 * b**2 - x2 * b**2 - y2 * a**2
    outside = r < 0
    r = jnp.where(outside, r, -(a**4))
    root = jnp.sqrt(p**2 - 4 * r)
    positive = p > 0
    confocal = jnp.where(positive, -2 * r / (jnp.where(positive, p, 1.0) + root), (root - p) / 2)
    confocal = jnp.where(outside, confocal, 0.0)
    A, B = jnp.sqrt(a**2 + confocal), jnp.sqrt(b**2 + confocal)
    bracket = (x2 / A + y2 / B) / (A + B) + jnp.log((A + B) / (a + b))
    return 2 * jnp.pi * params["G"] * params["rho"] * a * b * bracket


def dumbbell(q: PyTree, params: PyTree):
    """(f) Balls of one radius, M1 at z = c and M2 at z = -c, joined by a thin rod; singular on the rod."""
    s2, z, length = q["x"] ** 2 + q["y"] ** 2, q["z"], params["length"]
    balls = _ball(s2 + (z - params["c"]) ** 2, params["M1"], params["radius"])
    balls += _ball(s2 + (z + params["c"]) ** 2, params["M2"], params["radius"])
    ends = jnp.sqrt(s2 + (z - length / 2) ** 2) + jnp.sqrt(s2 + (z + length / 2) ** 2)
    # 2 atanh(ℓ/(e1 + e2)) stays accurate far away, where the quotient in the logarithm tends to one.
    rod = -2 * params["rod"] / length * jnp.arctanh(length / ends)
    return params["G"] * (balls + rod)


def helix(q: PyTree, params: PyTree, nodes=256, nearest=0.1):
    """(g) The infinite wire x + i y = a exp(2πi z/h), right-handed for h > 0; Φ = 0 on the axis.

    By default the error of the field is 1e-12 at distances from the wire above a/10 if h >= a, above a/4 if h = a/2.
    For smaller distances `nearest` = distance/√(h² + 4π² a²) concentrates the nodes next to the particle. For a tight
    helix `nearest=None` spaces them equally, with an error of about exp(-2π nodes distance/√(h² + 4π² a²)).
    """
    a, h = params["a"], params["h"]
    angles, weights = uniform_nodes(nodes) if nearest is None else clustered_nodes(nodes, nearest)
    t = angles / (2 * np.pi)
    wire = 2 * jnp.pi * q["z"] / h - angles
    A2 = ((q["x"] - a * jnp.cos(wire)) ** 2 + (q["y"] - a * jnp.sin(wire)) ** 2) / h**2
    turns = jnp.sum(weights / (2 * np.pi) * _sum_over_turns(A2, t))
    line_density = params["line_density"] * jnp.sqrt(1 + (2 * jnp.pi * a / h) ** 2)
    return -params["G"] * line_density * (turns + jnp.log(a**2 / h**2))


@partial(jax.jit, static_argnums=0)
def gradient(potential, q: PyTree, params: PyTree):
    """∇Φ, like q."""
    return jax.grad(potential)(q, params)


@cache
def uniform_nodes(count) -> tuple[np.ndarray, np.ndarray]:
    """Angles in (-π, π) and weights of the trapezoidal rule."""
    return (np.arange(count) + 0.5 - count / 2) * (2 * np.pi / count), np.full(count, 2 * np.pi / count)


@cache
def clustered_nodes(count, nearest) -> tuple[np.ndarray, np.ndarray]:
    """Angles in (-π, π) and weights for an integrand with singularities at ±i y, y >= `nearest`."""
    period = 2 * np.log(4 / nearest)
    x = (np.arange(count) + 0.5 - count / 2) * (period / count)
    images = np.cosh((np.arange(int(40 / period) + 2) + 0.5) * period)
    # The sum of 2 sech(x - c) + 2 sech(x + c) over c = period/2, 3 period/2, ..., and its integral.
    steps = np.sinh(x)[:, None] / images
    weights = 4 * period / count * np.sum(np.cosh(x)[:, None] / images / (1 + steps**2), axis=1)
    return 4 * np.sum(np.arctan(steps), axis=1), weights


def _absolute(x):
    """|x|, with the derivative 0 at 0: that of `jnp.abs` is 1 there."""
    return x * jnp.sign(x)


def _finite_cylinder_near(q: PyTree, a, b, angles, weights):
    x, y, z = q["x"], q["y"], q["z"]
    # The position of the nodes does not change the integral, so they turn with the particle without a derivative.
    azimuth = jax.lax.stop_gradient(jnp.arctan2(y, x))
    c, s = jnp.cos(azimuth + angles), jnp.sin(azimuth + angles)
    d2 = (x - a * c) ** 2 + (y - a * s) ** 2
    d = jnp.sqrt(d2)
    surface = weights * a * (a - x * c - y * s)

    def lid_and_side(height):
        """A lid at this height above the particle and the side up to it."""
        sign = jnp.where(height < 0, -1.0, 1.0)
        distance = sign * height
        root = jnp.sqrt(d2 + height**2)
        lid = jnp.sum(surface / (root + distance))
        # asinh(|ζ|/d), using the root that the lid needs too; log1p because it is small far away.
        side = jnp.sum(surface * jnp.log1p(distance / d * (1 + distance / (root + d))))
        return height * lid + sign * side

    return -0.5 * (lid_and_side(b - z) + lid_and_side(b + z))


def _finite_cylinder_far(q: PyTree, a, b):
    """-V/r Σ <r'^l P_l> P_l(cos θ)/r^l with the volume V = 2π a² b."""
    r2 = q["x"] ** 2 + q["y"] ** 2 + q["z"] ** 2
    c2 = q["z"] ** 2 / r2
    second = (b**2 / 3 - a**2 / 4) * (3 * c2 - 1) / (2 * r2)
    fourth = (b**4 / 5 - a**2 * b**2 / 2 + a**4 / 8) * (35 * c2**2 - 30 * c2 + 3) / 8 * (1 / r2) ** 2
    return -2 * jnp.pi * a**2 * b / jnp.sqrt(r2) * (1 + second + fourth)


def _ball(r2, mass, radius):
    """-M/r outside, -M (3R² - r²)/(2R³) inside a uniform ball."""
    inside = r2 < radius**2
    outer = -mass / jnp.sqrt(jnp.where(inside, radius**2, r2))
    return jnp.where(inside, -mass * (3 * radius**2 - r2) / (2 * radius**3), outer)


def _sum_over_turns(A2, t):
    """Σ over |n| <= X of f(t - n) with f(x) = 1/√(A² + x²), less 2 ln(2X), as X → ∞; A and x in pitches."""
    n = np.arange(-DIRECT_TURNS, DIRECT_TURNS + 1)
    direct = jnp.sum(1 / jnp.sqrt(A2[:, None] + (t[:, None] - n) ** 2), axis=1)
    edge = DIRECT_TURNS + 0.5
    return direct + _tail(A2, edge - t) + _tail(A2, edge + t) - 2 * math.log(2)


def _tail(A2, m):
    """Σ of f(m + ½), f(m + 3/2), ...: its integral and the odd derivatives of f at m.

    f's derivatives are those of the potential of a point: the n-th is (-1)^n n! P_n(m/D)/D^(n+1), D² = A² + m².
    """
    D = jnp.sqrt(A2 + m**2)
    legendre = [jnp.ones_like(D), m / D]
    for n in range(1, 2 * len(BERNOULLI) - 1):
        legendre.append(((2 * n + 1) * legendre[1] * legendre[n] - n * legendre[n - 1]) / (n + 1))
    total = math.log(2) - jnp.log(m + D)
    for i, bernoulli in enumerate(BERNOULLI):
        n = 2 * i + 1
        total -= (1 - 2.0**-n) * bernoulli / (n + 1) * legendre[n] / D ** (n + 1)
    return total
