"""Conserved momenta in the field of seven mass distributions (Goldstein, Exercise 2-19; source §4).

A particle of unit mass in Cartesian coordinates, L = ½ |v|² - Φ(q), with the potentials of
`lagjax.scenes.potentials`. A symmetry of the masses is also a symmetry of Φ and of L; Noether's theorem gives

    translation along x, y, z   ->  p_x, p_y, p_z
    rotation about z            ->  L_z = x ẏ - y ẋ
    translation in time         ->  E = ½ |v|² + Φ
    screw, right-handed: z + hε/2π together with φ + ε, for every ε   ->  h p_z + 2π L_z

    a plane               p_x, p_y, L_z, E        e elliptic cylinder   p_z, E
    b half plane          p_x, E                  f dumbbell            L_z, E
    c cylinder            p_z, L_z, E             g helix               h p_z + 2π L_z, E
    d finite cylinder     L_z, E

Three more come from no spatial symmetry: inside the elliptic cylinder Φ is a quadratic form, and the energies of
the motions along x and y are separately conserved; the dumbbell with a massless rod is Euler's problem of two
centres, with the integral (r1 x v)·(r2 x v) + 2 c G (M2 cos θ2 - M1 cos θ1), r1 and r2 from the balls' centres.

Inside c the particle oscillates with √(2πGρ) in any direction, inside e with √(4πGρ b/(a+b)) along x and √(4πGρ
a/(a+b)) along y. A circular orbit around c has the speed a √(2πGρ) at every radius. Falling through a from z = 0 with
speed w, the particle is back, with the same velocity, after 4 w/(2πGσ).
"""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.symmetry_search import symmetries
from lagjax.display import plots
from lagjax.integrate import integrate
from lagjax.report import FULL, QUICK, Case, Run, Scene, relative_error
from lagjax.scenes import by_hand, potentials
from lagjax.system import System

PARAMS = {
    "plane": {"G": 1.0, "sigma": 0.75},
    "half plane": {"G": 1.0, "sigma": 0.75},
    "cylinder": {"G": 1.0, "rho": 0.5, "a": 1.25},
    "finite cylinder": {"G": 1.0, "rho": 0.5, "a": 1.25, "b": 0.75},
    "elliptic cylinder": {"G": 1.0, "rho": 0.5, "a": 2.0, "b": 0.75},
    "dumbbell": {"G": 1.0, "M1": 2.0, "M2": 3.0, "radius": 0.5, "c": 1.5, "rod": 0.25, "length": 2.0},
    "helix": {"G": 1.0, "line_density": 1.0, "a": 1.0, "h": 2.0},
}

POTENTIALS = {
    "plane": potentials.plane,
    "half plane": potentials.half_plane,
    "cylinder": potentials.cylinder,
    "finite cylinder": potentials.finite_cylinder,
    "elliptic cylinder": potentials.elliptic_cylinder,
    "dumbbell": potentials.dumbbell,
    "helix": potentials.helix,
}

CONSERVED = {
    "plane": ("p_x", "p_y", "L_z", "E"),
    "half plane": ("p_x", "E"),
    "cylinder": ("p_z", "L_z", "E"),
    "finite cylinder": ("L_z", "E"),
    "elliptic cylinder": ("p_z", "E"),
    "dumbbell": ("L_z", "E"),
    "helix": ("h p_z + 2 pi L_z", "E"),
}

MISPRINTS = (
    "§4g prints that h p_z + L_z is conserved: it is h p_z + 2π L_z (right-handed helix; left-handed: minus).",
    "§4g names a translation by h with a rotation by 2π: that is a discrete translation, without a charge; the "
    "symmetry is a translation by hε/2π with a rotation by ε, for every ε.",
    "§4b treats the half plane like the rest: its force is infinite; a uniform pull has to be dropped first.",
    "§4 says 'only' p_x, L_z or p_z: energy too, and beyond these E_x and E_y inside the elliptic cylinder and "
    "Euler's integral for two balls on a massless rod.",
)


def lagrangian_of(potential):
    """L = ½ |v|² - Φ(q) of a particle of unit mass."""

    def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2) - potential(q, params)

    lagrangian.__name__ = potential.__name__
    return lagrangian


SYSTEMS = {name: System(lagrangian_of(potential)) for name, potential in POTENTIALS.items()}


def vector(x, y, z):
    """A position or a velocity."""
    return {"x": x, "y": y, "z": z}


# Orbits without any symmetry of their own that avoid kinks and singular lines: q0, v0, duration.
ORBITS = {
    "plane": (vector(0.5, -0.25, 1.5), vector(0.25, 0.5, 1.0), 1.0),
    "half plane": (vector(0.5, -0.5, 1.5), vector(0.25, 0.5, 1.0), 1.0),
    "cylinder": (vector(1.5, -1.0, 0.25), vector(1.25, 1.75, 0.5), 4.0),
    "finite cylinder": (vector(2.25, 0.5, 0.75), vector(-0.25, 1.125, 0.375), 4.0),
    "elliptic cylinder": (vector(3.0, 1.5, 0.25), vector(-0.875, 2.0, 0.25), 4.0),
    "dumbbell": (vector(2.5, 0.5, 0.75), vector(-0.25, 1.25, 0.25), 4.0),
    "helix": (vector(1.75, 0.5, 0.25), vector(-0.25, 2.5, 0.75), 2.0),
}
# An orbit that stays inside the elliptic cylinder.
INSIDE = vector(0.75, 0.25, 0.0), vector(0.5, -0.5, 0.25)


def charges(name: str, q: PyTree, v: PyTree, params: PyTree) -> dict[str, jax.Array]:
    """Momenta and energy at one state; for the helix also the screw's charge, correct and as printed."""
    p_z, L_z = v["z"], q["x"] * v["y"] - q["y"] * v["x"]
    energy = 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2) + POTENTIALS[name](q, params)
    found = {"p_x": v["x"], "p_y": v["y"], "p_z": p_z, "L_z": L_z, "E": energy}
    if name == "helix":
        found["h p_z + 2 pi L_z"] = params["h"] * p_z + 2 * jnp.pi * L_z
        found["h p_z + L_z"] = params["h"] * p_z + L_z
    return found


def bounce_period(params: PyTree, speed):
    """The time between two upward passages of the plane with this speed."""
    return 4 * speed / (2 * jnp.pi * params["G"] * params["sigma"])


def inside_frequency(params: PyTree):
    """√(2πGρ): the frequency of every motion perpendicular to the axis inside the circular cylinder."""
    return jnp.sqrt(2 * jnp.pi * params["G"] * params["rho"])


def circular_speed(params: PyTree):
    """a √(2πGρ): the speed of a circular orbit around the circular cylinder, at every radius s >= a."""
    return params["a"] * inside_frequency(params)


def ellipse_frequencies(params: PyTree):
    """The frequencies along x and y inside the elliptic cylinder; their squares add up to 4πGρ."""
    a, b = params["a"], params["b"]
    density = 4 * jnp.pi * params["G"] * params["rho"] / (a + b)
    return jnp.sqrt(density * b), jnp.sqrt(density * a)


def exact_inside_ellipse(params: PyTree, q0: PyTree, v0: PyTree, t):
    """q(t) and v(t) inside the elliptic cylinder: an oscillation along x, one along y, free flight along z."""
    q, v = {"z": q0["z"] + v0["z"] * t}, {"z": v0["z"] + 0 * t}
    for k, frequency in zip("xy", ellipse_frequencies(params)):
        c, s = jnp.cos(frequency * t), jnp.sin(frequency * t)
        q[k] = q0[k] * c + v0[k] / frequency * s
        v[k] = v0[k] * c - q0[k] * frequency * s
    return q, v


def ellipse_energies(params: PyTree, q: PyTree, v: PyTree):
    """E_x and E_y, separately conserved inside the elliptic cylinder."""
    return tuple(0.5 * (v[k] ** 2 + (w * q[k]) ** 2) for k, w in zip("xy", ellipse_frequencies(params)))


def euler_integral(params: PyTree, q: PyTree, v: PyTree):
    """(r1 x v)·(r2 x v) + 2 c G (M2 cos θ2 - M1 cos θ1), conserved outside the balls if the rod has no mass."""
    c = params["c"]
    r1 = jnp.stack([q["x"], q["y"], q["z"] - c], axis=-1)
    r2 = jnp.stack([q["x"], q["y"], q["z"] + c], axis=-1)
    velocity = jnp.stack([v["x"], v["y"], v["z"]], axis=-1)
    product = jnp.sum(jnp.cross(r1, velocity) * jnp.cross(r2, velocity), axis=-1)
    cosine1 = r1[..., 2] / jnp.linalg.norm(r1, axis=-1)
    cosine2 = r2[..., 2] / jnp.linalg.norm(r2, axis=-1)
    return product + 2 * c * params["G"] * (params["M2"] * cosine2 - params["M1"] * cosine1)


def drift(values) -> float:
    """The largest change from the first value, relative to the largest value."""
    values = np.asarray(values)
    return float(np.max(np.abs(values - values[0])) / np.max(np.abs(values)))


def runs():
    """A closed form, and two integrals of the motion that are not the energy."""
    return [_ellipse_run(), _helix_run(), _two_balls_run()]


def _ellipse_run():
    params, ts = PARAMS["elliptic cylinder"], np.linspace(0.0, 80.0, 9)

    def error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_inside_ellipse(params, *INSIDE, ts))

    words = "q and v against two oscillations"
    acceleration = by_hand.attracted(by_hand.field_of_elliptic_cylinder)
    return Run(
        "inside the ellipse",
        SYSTEMS["elliptic cylinder"],
        params,
        *INSIDE,
        ts,
        error,
        words,
        1e-8,
        by_hand=acceleration,
    )


def _helix_run():
    q0, v0, duration = ORBITS["helix"]
    ts = np.linspace(0.0, duration, 9)

    def error(trajectory):
        return drift(charges_along("helix", trajectory)["h p_z + 2 pi L_z"])

    words = "change of h p_z + 2π L_z"
    return Run("around the helix", SYSTEMS["helix"], PARAMS["helix"], q0, v0, ts, error, words, drawn=False, tier=FULL)


def _two_balls_run():
    q0, v0, duration = ORBITS["dumbbell"]
    params, ts = PARAMS["dumbbell"] | {"rod": 0.0}, np.linspace(0.0, 10 * duration, 9)

    def error(trajectory):
        return drift(euler_integral(params, trajectory.q, trajectory.v))

    words, acceleration = "change of Euler's integral", by_hand.attracted(by_hand.field_of_dumbbell)
    return Run("two balls", SYSTEMS["dumbbell"], params, q0, v0, ts, error, words, by_hand=acceleration, tier=FULL)


def charges_along(name: str, trajectory):
    """`charges` at every output of a trajectory."""
    return _charges(name, trajectory.q, trajectory.v, trajectory.params)


@partial(jax.jit, static_argnums=0)
def _charges(name: str, q: PyTree, v: PyTree, params: PyTree):
    return jax.vmap(partial(charges, name), in_axes=(0, 0, None))(q, v, params)


def cases(tier=FULL):
    """Kinks, surfaces, rims, wires, and the limiting cases of each shape."""
    fields = [_strip_case(), _surface_case(), _far_case(), _flat_case()]
    if tier == QUICK:
        return fields
    found = [*fields, *_helix_cases(), _left_handed_case(), _symmetries_case()]
    # An event at a jump of the force, and an integral of 400 nodes: they compile for as long as all others.
    return [*found, _plane_case(), _rim_case()] if tier == FULL else found


def fall_onto_plane(params: PyTree, speed, tolerance=1e-10):
    """Fall from the highest point until an event finds the plane, reached with this speed: a quarter of a bounce."""
    height = speed**2 / (4 * np.pi * params["G"] * params["sigma"])
    start = vector(0.0, 0.0, height), vector(0.25, 0.5, 0.0)
    event = diffrax.Event(lambda t, y, params, **kwargs: y[0]["z"], direction=False)
    ts = np.linspace(0.0, 2.0, 3)
    return integrate(SYSTEMS["plane"], *start, params, ts=ts, rtol=tolerance, atol=tolerance, event=event)


def _plane_case():
    period = 4 * float(fall_onto_plane(PARAMS["plane"], 2.0).end.t)
    error = abs(period / float(bounce_period(PARAMS["plane"], 2.0)) - 1)
    return Case("a: onto the kink", f"event at z = 0, period of the bounce {period:.12f}", error, 1e-9)


def _strip_case():
    q, params = vector(0.0, 1.25, 0.5), PARAMS["half plane"] | {"width": 2.0**40}
    wide = potentials.gradient(potentials.strip, q, params)
    pull = 2 * params["G"] * params["sigma"] * np.log(params["width"])
    wide["y"] += pull
    exact = potentials.gradient(potentials.half_plane, q, params)
    error = relative_error([wide["y"], wide["z"]], [exact["y"], exact["z"]])
    happened = f"a pull of {pull:.1f} along y taken off, the half plane's field is left"
    return Case("b: strip of width 2^40", happened, error, 1e-11)


def _surface_case():
    params = PARAMS["elliptic cylinder"]
    field = jax.vmap(lambda x: potentials.gradient(potentials.elliptic_cylinder, vector(x, 0.0, 0.0), params)["x"])
    x = params["a"] * (1 + np.array([-1e-12, 0.0, 1e-12]))
    exact = float(ellipse_frequencies(params)[0]) ** 2 * params["a"]
    happened = "on the vertex, and 1e-12 a to both sides of it: one field"
    return Case("e: through the surface", happened, relative_error(field(x), np.full(3, exact)), 1e-11)


def _rim_case():
    params = PARAMS["finite cylinder"]
    a, b = params["a"], params["b"]

    def fine(q: dict, params: dict):
        return potentials.finite_cylinder(q, params, 400, 1e-11)

    points = jax.tree.map(lambda *x: np.array(x), vector(a, 0.0, b), vector(a, 0.0, 0.0), vector(a * 1.001, 0.0, b))
    got, exact = (
        jax.jit(jax.vmap(lambda q: potentials.gradient(f, q, params)))(points)
        for f in (potentials.finite_cylinder, fine)
    )
    error = relative_error([got["x"], got["z"]], [exact["x"], exact["z"]])
    return Case("d: on rim and side", "96 nodes against 400: finite, with a logarithm in the integrand", error, 1e-4)


def _far_case():
    params, distance = PARAMS["finite cylinder"], 1e8
    away = vector(0.6 * distance, 0.0, 0.8 * distance)
    mass = 2 * np.pi * params["rho"] * params["a"] ** 2 * params["b"]
    pull = potentials.gradient(potentials.finite_cylinder, away, params)
    got, exact = [pull["x"], pull["z"]], [0.6 * mass / distance**2, 0.8 * mass / distance**2]
    return Case("d: at r = 1e8", "the pull of a point", relative_error(got, exact), 1e-12)


def _flat_case():
    params = PARAMS["elliptic cylinder"] | {"b": 2.0**-40, "rho": 0.5 * 2.0**40}
    q = vector(3.0, 1.5, 0.0)
    got = potentials.gradient(potentials.elliptic_cylinder, q, params)
    # b = 0: the elliptic coordinates x + i y = a cosh(u + i w) give g = 4πGρab/a e^(-u) (cos w, sin w).
    w = np.arccosh((3.0 + 1.5j) / params["a"])
    size = 4 * np.pi * params["rho"] * params["b"] * np.exp(-w.real)
    exact = [size * np.cos(w.imag), size * np.sin(w.imag)]
    return Case("e: flat, b = 2^-40", "the field of a ribbon", relative_error([got["x"], got["y"]], exact), 1e-11)


def _helix_cases():
    value = jax.jit(potentials.helix, static_argnums=(2, 3))
    params = PARAMS["helix"]
    near = vector(1.001, 0.0, 0.0)
    got, fine = value(near, params, 256, 1e-4), value(near, params, 1200, 1e-6)
    wire = Case("g: 0.001 a off the wire", "256 nodes against 1200", relative_error(got, fine), 1e-12)
    tight = params | {"h": 2.0**-10, "line_density": 2.0**-10}
    outside = 2 * tight["line_density"] * np.hypot(1, 2 * np.pi / tight["h"]) * np.log(1.5)
    got = [value(vector(1.5 * 0.6, 1.5 * 0.8, 0.1), tight, 96, None)]
    sheet = Case("g: h = 2^-10 a", "a cylindrical sheet: 2Gλ_z ln(s/a)", relative_error(got, [outside]), 1e-12)
    stretched = params | {"h": 2.0**24}
    got = value(vector(0.6, 0.8, 0.0), stretched, 400, 2.0**-28)
    exact = 2 * np.log(np.hypot(0.4, 0.8))
    happened = "a straight wire: 2Gλ ln(d/a); two logarithms of 33 cancel"
    straight = Case("g: h = 2^24 a", happened, relative_error(got, exact), 1e-10)
    return [wire, sheet, straight]


def helix_orbit(params: PyTree):
    """The generic orbit around the helix, 201 outputs."""
    q0, v0, _ = ORBITS["helix"]
    ts = np.linspace(0.0, 12.0, 201)
    return integrate(SYSTEMS["helix"], q0, v0, params, ts=ts, rtol=1e-10, atol=1e-10)


def _left_handed_case():
    params = PARAMS["helix"] | {"h": -2.0}
    found = charges_along("helix", helix_orbit(params))
    printed = float(np.ptp(found["h p_z + L_z"]))
    happened = f"|h| p_z - 2π L_z kept; h p_z + L_z moves by {printed:.1f}"
    return Case("g: left-handed, h = -2", happened, drift(found["h p_z + 2 pi L_z"]), 1e-9)


def _symmetries_case():
    lines = {name: set(found_conserved(name)) == set(CONSERVED[name]) for name in SYSTEMS}
    happened = f"found: {sum(lines.values())} of {len(lines)} lists of constants, none longer or shorter"
    return Case("a-g: symmetries", happened, float(len(lines) - sum(lines.values())), 0.5)


def found_conserved(name: str) -> list[str]:
    """What `symmetries` finds, with the names of `CONSERVED`; boosts along free directions are left out."""
    q, v, _ = ORBITS[name]
    words = {"Jacobi integral": "E", f"h p_z + 2π L_z with h = {PARAMS['helix']['h']:g}": "h p_z + 2 pi L_z"}
    return [words.get(key, key) for key in symmetries(SYSTEMS[name], q, v, PARAMS[name]).steady]


def picture(tier=FULL):
    """A generic orbit around the helix: conserved quantities and others."""
    orbit = helix_orbit(PARAMS["helix"])
    a, h = PARAMS["helix"]["a"], PARAMS["helix"]["h"]
    fig, axes = plots.figure(1, 2, size=(4.6, 3.8))
    left, right = axes[0]
    low, high = float(jnp.min(orbit.q["z"])), float(jnp.max(orbit.q["z"]))
    z = np.linspace(low, high, 600)
    left.plot(a * np.cos(2 * np.pi * z / h), z, label="wire", color="0.6", linewidth=1.0)
    left.plot(orbit.q["x"], orbit.q["z"], label="particle", **plots.style(0))
    left.set(xlabel="x / a", ylabel="z / a", title="Around the helix")
    left.legend(fontsize=8, frameon=False, loc="upper left")
    found = charges_along("helix", orbit)
    shown = {
        "p_z": "p_z",
        "L_z": "L_z",
        "h p_z + L_z": "h p_z + L_z, as printed",
        "h p_z + 2 pi L_z": "h p_z + 2π L_z",
    }
    for i, (key, label) in enumerate(shown.items()):
        right.plot(orbit.t, found[key] - found[key][0], label=label, **plots.style(i))
    right.set(xlabel="t", ylabel="change since t = 0", title="One combination is conserved")
    right.legend(fontsize=8, frameon=False)
    return fig


SCENE = Scene(
    name="mass_distributions",
    title="Conserved momenta in seven gravitational fields",
    source="Goldstein, Classical Mechanics, Exercise 2-19; source document §4",
    misprints=MISPRINTS,
    runs=runs,
    cases=cases,
    picture=picture,
)
