"""Seven gravitational fields: reference values, Poisson's equation, Noether's table, gradients."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lagjax.integrate.integrate import integrate
from lagjax.report import relative_error
from lagjax.scenes import mass_distributions as scene
from lagjax.scenes import potentials
from tests.references import keys, reference
from tests.tiers import exhaustive_but

NAMES = tuple(scene.POTENTIALS)
# Other tests share the compiled orbits of the other fields.
COMPILED_ONLY_HERE = ("plane", "half plane", "finite cylinder", "helix")
HELIX_POINTS = ((1.5, 0.75, 2.0), (0.5, 0.75, 2.0), (1.25, 3.0, 0.5), (0.75, 1.0, 8.0))
# For s > a the reference used K_n instead of K_n' (mpmath's besselk ignores derivative=1): checked below.
WRONG = {"s4g.dPhi/ds(s=1.5,chi=0.75,h=2)": (1.5, 0.75, 2.0), "s4g.dPhi/ds(s=1.25,chi=3,h=0.5)": (1.25, 3.0, 0.5)}

value_and_gradient = jax.jit(lambda name, q, params: _both(name)(q, params), static_argnums=0)


def _both(name):
    return jax.value_and_grad({**scene.POTENTIALS, "strip": potentials.strip}[name])


def _cylindrical(name, s, z, params, azimuth=0.625):
    """Φ, and the force towards larger s and z, at a generic azimuth."""
    c, n = np.cos(azimuth), np.sin(azimuth)
    phi, g = value_and_gradient(name, scene.vector(s * c, s * n, z), params)
    return phi, -(c * g["x"] + n * g["y"]), -g["z"]


def _screw(s, chi, h):
    """Φ and its derivatives along s, φ and z, at a generic height."""
    z, params = 0.375, scene.PARAMS["helix"] | {"h": h}
    angle = chi + 2 * np.pi * z / h
    c, n = np.cos(angle), np.sin(angle)
    phi, g = value_and_gradient("helix", scene.vector(s * c, s * n, z), params)
    return phi, c * g["x"] + n * g["y"], s * (c * g["y"] - n * g["x"]), g["z"]


def _potentials_and_fields():
    """A dictionary of key: (value, the size relative to which its error is measured)."""
    params, got = scene.PARAMS, {}

    def put(names, values):
        # Errors of a component are relative to the field: a component that nearly vanishes is a sum that cancels.
        field = float(np.linalg.norm(values[1:]))
        for i, (name, value) in enumerate(zip(names, values, strict=True)):
            got[name] = (float(value), field if i else abs(float(value)))

    phi, g = value_and_gradient("plane", scene.vector(0.25, 0.5, -1.5), params["plane"])
    put(("s4a.Phi(z=-1.5)", "s4a.gz(z=-1.5)"), (phi, -g["z"]))
    for width in (8, 1024):
        strip = params["half plane"] | {"width": float(width)}
        phi, g = value_and_gradient("strip", scene.vector(0.25, 1.25, 0.5), strip)
        put([f"s4b.strip W={width} {x}" for x in ("Phi(1.25,0.5)", "gy", "gz")], (phi, -g["y"], -g["z"]))
    phi, g = value_and_gradient("half plane", scene.vector(0.25, 1.25, 0.5), params["half plane"])
    put(("s4b.renormalised Phi(1.25,0.5)", "s4b.renorm gy", "s4b.renorm gz"), (phi, -g["y"], -g["z"]))
    got["s4b.renorm limit check"] = got["s4b.renormalised Phi(1.25,0.5)"]
    phi, g = value_and_gradient("half plane", scene.vector(0.25, -1.25, 0.5), params["half plane"])
    put(("behind", "s4b.renorm gy(-1.25,0.5)", "s4b.renorm gz(-1.25,0.5)"), (phi, -g["y"], -g["z"]))
    del got["behind"]
    put(("s4c.Phi(s=0.75)", "s4c.gs(0.75)"), _cylindrical("cylinder", 0.75, 0.5, params["cylinder"])[:2])
    put(("s4c.Phi(s=2)", "s4c.gs(2)"), _cylindrical("cylinder", 2.0, 0.5, params["cylinder"])[:2])
    for at in ("(s=2,z=0.5)", "(s=0.5,z=0.25)", "(s=0.5,z=1.5)", "(s=4,z=-3)"):
        s, z = (float(x.split("=")[1]) for x in at.strip("()").split(","))
        values = _cylindrical("finite cylinder", s, z, params["finite cylinder"])
        put([f"s4d.{x}{at}" for x in ("Phi", "gs", "gz")], values)
    on_axis = _cylindrical("finite cylinder", 0.0, 2.0, params["finite cylinder"])
    put(("s4d.Phi axis z=2", "s4d.gz axis z=2"), on_axis[::2])
    far = _cylindrical("finite cylinder", 100.0, 0.0, params["finite cylinder"])[0]
    mass = 2 * np.pi * 0.5 * 1.25**2 * 0.75
    got["s4d.Phi far s=100,z=0 monopole ratio"] = (-float(far) * 100 / mass, 1.0)
    for at in ("(0.5,0.25)", "(3,1.5)", "(0.25,2)", "(2.5,0)"):
        x, y = (float(x) for x in at.strip("()").split(","))
        phi, g = value_and_gradient("elliptic cylinder", scene.vector(x, y, 0.5), params["elliptic cylinder"])
        put([f"s4e.{x}{at}" for x in ("Phi", "gx", "gy")], (phi, -g["x"], -g["y"]))
    ball = _cylindrical("dumbbell", 0.75, 0.5, params["dumbbell"])
    put(("s4f.Phi(s=0.75,z=0.5)", "s4f.gs", "s4f.gz"), ball)
    inside = _cylindrical("dumbbell", 0.25, 1.5, params["dumbbell"])[0]
    got["s4f.Phi inside ball (0.25,1.5)"] = (float(inside), abs(float(inside)))
    for s, chi, h in HELIX_POINTS:
        at = f"(s={s:g},chi={chi:g},h={h:g})"
        put([f"s4g.{x}{at}" for x in ("Phi", "dPhi/ds", "dPhi/dphi", "dPhi/dz")], _screw(s, chi, h))
    return got


def _elementary():
    params = scene.PARAMS
    along_x, along_y = scene.ellipse_frequencies(params["elliptic cylinder"])
    return {
        "s4a.bounce_period(vz0=2)": scene.bounce_period(params["plane"], 2.0),
        "s4c.inside radial-osc freq": scene.inside_frequency(params["cylinder"]),
        "s4c.circular speed outside": scene.circular_speed(params["cylinder"]),
        "s4e.inside freqs x": along_x,
        "s4e.inside freqs y": along_y,
    }


def _solve(name, q0, v0, duration, change=None):
    """Integrate with always nine outputs, so that each system is compiled once."""
    params, ts = scene.PARAMS[name] | (change or {}), np.linspace(0.0, duration, 9)
    return integrate(scene.SYSTEMS[name], q0, v0, params, ts=ts, rtol=1e-10, atol=1e-10)


def test_every_reference_value():
    """Potentials, fields, frequencies and speeds agree with all values of §4 to 1e-12, except two wrong ones."""
    got = _potentials_and_fields()
    got |= {key: (float(value), float(value)) for key, value in _elementary().items()}
    assert set(got) == set(keys("s4"))
    errors = {key: abs(value - reference(key)) / size for key, (value, size) in got.items() if key not in WRONG}
    assert max(errors.values()) < 1e-12, max(errors, key=errors.get)


def _bessel_slope(s, chi, h, derivative):
    """∂Φ/∂s outside the helix of unit radius and density, from the series in I_n K_n."""
    k = 2 * mpmath.pi / h
    terms = (n * mpmath.besseli(n, n * k) * derivative(n, n * k * s) * mpmath.cos(n * chi) for n in range(1, 60))
    return 2 * mpmath.sqrt(1 + k**2) * (1 / mpmath.mpf(s) - 2 * k * mpmath.fsum(terms))


@pytest.mark.parametrize("key", WRONG)
def test_the_slope_outside_the_helix(key):
    """∂Φ/∂s for s > a is the Bessel series with K_n'; the reference value is the same series with K_n."""
    point = WRONG[key]
    with mpmath.workdps(30):
        slope = float(_bessel_slope(*point, lambda n, x: -mpmath.besselk(n - 1, x) - n / x * mpmath.besselk(n, x)))
        mistaken = float(_bessel_slope(*point, mpmath.besselk))
    assert abs(float(_screw(*point)[1]) / slope - 1) < 1e-12
    assert abs(mistaken / reference(key) - 1) < 1e-14
    assert abs(mistaken / slope - 1) > 0.05


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.exhaustive] if name in COMPILED_ONLY_HERE else []) for name in NAMES]
)
def test_noether_table(name):
    """Along a generic orbit each charge of the table is constant to 1e-9, and every other momentum is not."""
    q0, v0, duration = scene.ORBITS[name]
    found = scene.charges_along(name, _solve(name, q0, v0, duration))
    for charge, values in found.items():
        change = np.ptp(np.asarray(values)) / max(1.0, np.max(np.abs(np.asarray(values))))
        assert change < 1e-9 if charge in scene.CONSERVED[name] else change > 0.02, (charge, change)


@pytest.mark.slow
def test_screw_charge_and_its_misprint():
    """h p_z + 2π L_z is constant for both hands (h < 0: left); h p_z + L_z changes by O(1), so does the wrong hand."""
    q0, v0, _ = scene.ORBITS["helix"]
    for h in (2.0, -2.0):
        orbit = _solve("helix", q0, v0, 8.0, {"h": h})
        found = jax.tree.map(np.asarray, scene.charges_along("helix", orbit))
        assert scene.drift(found["h p_z + 2 pi L_z"]) < 1e-9
        assert np.ptp(found["h p_z + L_z"]) > 0.3
        assert np.ptp(h * found["p_z"] - 2 * np.pi * found["L_z"]) > 0.5


@pytest.mark.exhaustive
def test_bounce_through_the_plane():
    """The fall onto the kink takes a quarter of the period 4 w/(2πGσ) and ends with the speed w."""
    for speed in (2.0, 0.5):
        fall = scene.fall_onto_plane(scene.PARAMS["plane"], speed)
        period = float(scene.bounce_period(scene.PARAMS["plane"], speed))
        assert abs(4 * float(fall.end.t) / period - 1) < 1e-9
        assert abs(float(fall.end.v["z"]) + speed) < 1e-9
        assert abs(2 * float(fall.end.t) / period - 1) > 0.1


def test_inside_the_ellipse():
    """The motion is two oscillations; E_x and E_y are separately constant inside, but not outside."""
    params = scene.PARAMS["elliptic cylinder"]
    inside = _solve("elliptic cylinder", *scene.INSIDE, 4.0)
    exact = scene.exact_inside_ellipse(params, *scene.INSIDE, np.linspace(0.0, 4.0, 9))
    assert relative_error((inside.q, inside.v), exact) < 1e-9
    outside = _solve("elliptic cylinder", *scene.ORBITS["elliptic cylinder"])
    for orbit, kept in ((inside, True), (outside, False)):
        for energy in scene.ellipse_energies(params, orbit.q, orbit.v):
            assert scene.drift(energy) < 1e-9 if kept else scene.drift(energy) > 0.05


def test_inside_and_around_the_cylinder():
    """Inside: an ellipse in the time 2π/√(2πGρ); outside: a circle at speed a √(2πGρ) for any radius."""
    params = scene.PARAMS["cylinder"]
    speed = float(scene.circular_speed(params))
    starts = [
        (
            scene.vector(0.75, 0.25, 0.0),
            scene.vector(0.25, 0.5, 0.0),
            2 * np.pi / float(scene.inside_frequency(params)),
        ),
        (scene.vector(2.0, 0.0, 0.0), scene.vector(0.0, speed, 0.0), 2 * np.pi * 2.0 / speed),
        (scene.vector(5.0, 0.0, 0.0), scene.vector(0.0, speed, 0.0), 2 * np.pi * 5.0 / speed),
    ]
    for q0, v0, period in starts:
        orbit = _solve("cylinder", q0, v0, period)
        end = jax.tree.map(lambda x: float(x[-1]), (orbit.q, orbit.v))
        # Errors are relative to the size of the orbit, since some numbers return to zero.
        assert max(abs(a - b) for a, b in zip(jax.tree.leaves(end), jax.tree.leaves((q0, v0)))) < 5e-9
        early = jax.tree.map(lambda x: float(x[-2]), orbit.q)
        assert max(abs(early[k] - q0[k]) for k in "xy") > 0.1


def test_euler_integral():
    """Kept by two balls on a massless rod; not with the rod's mass, nor with the sign of one ball turned."""
    q0, v0, duration = scene.ORBITS["dumbbell"]
    for rod in (0.0, 2.0):
        orbit = _solve("dumbbell", q0, v0, duration, {"rod": rod})
        params = scene.PARAMS["dumbbell"] | {"rod": rod}
        kept = scene.drift(scene.euler_integral(params, orbit.q, orbit.v))
        assert kept < 1e-9 if rod == 0.0 else kept > 1e-3
        if rod == 0.0:
            assert scene.drift(scene.euler_integral(params | {"M1": -2.0}, orbit.q, orbit.v)) > 1e-2


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", exhaustive_but((jax.grad,), (jax.jacfwd, jax.grad)))
def test_gradient_of_the_final_state(mode):
    """The gradient of a final state inside the ellipse by G, ρ, a, b: both modes against the closed form."""
    params = jax.tree.map(jnp.asarray, scene.PARAMS["elliptic cylinder"])
    q0, v0 = scene.INSIDE

    def final(params):
        ts = jnp.array([0.0, 2.0])
        orbit = integrate(scene.SYSTEMS["elliptic cylinder"], q0, v0, params, ts=ts, rtol=1e-10, atol=1e-10)
        return orbit.q["x"][-1] + orbit.v["y"][-1]

    def exact(params):
        q, v = scene.exact_inside_ellipse(params, q0, v0, 2.0)
        return q["x"] + v["y"]

    expected = jax.jit(jax.jacfwd(exact))(params)
    assert relative_error(jax.jit(mode(final))(params), expected) < 1e-8
    assert relative_error(expected, expected | {"a": expected["b"], "b": expected["a"]}) > 0.1


def test_misprints():
    """The misprints are listed."""
    assert any("2π L_z" in line for line in scene.MISPRINTS)
