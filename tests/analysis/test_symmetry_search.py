"""`symmetries` finds exactly the known symmetries of each system, in words, with the right numbers.

Generators that are tried: gauge terms of tilted and magnetic fields, waves that travel, scalings.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.symmetry_result import Ratios, in_words
from lagjax.scenes import cross_rails, mass_distributions, sliding_wedge
from tests.symmetric_systems import DISK, IN_SPACE, KEPLER, OF_KEPLER, OF_STONE, ON_PLANE, RADIUS, STONE, rolling

SOON, LATER = ("cylinder",), ("plane", "helix")
TABLE = {
    "plane": {"p_x", "p_y", "L_z", "Jacobi integral"},
    "half plane": {"p_x", "Jacobi integral"},
    "cylinder": {"p_z", "L_z", "Jacobi integral"},
    "finite cylinder": {"L_z", "Jacobi integral"},
    "elliptic cylinder": {"p_z", "Jacobi integral"},
    "dumbbell": {"L_z", "Jacobi integral"},
    "helix": {"h p_z + 2π L_z with h = 0.5", "Jacobi integral"},
}
# Directions of free flight also have boosts.
BOOSTED = {"plane": {"t p_x - x", "t p_y - y"}, "half plane": {"t p_x - x"}} | dict.fromkeys(
    ("cylinder", "elliptic cylinder"), {"t p_z - z"}
)


def cases():
    """Names, and how many systems with other numbers."""
    yield from ((name, 1) for name in SOON)
    yield from (pytest.param(name, 1, marks=pytest.mark.slow) for name in LATER)
    yield from (pytest.param(name, 4, marks=pytest.mark.exhaustive) for name in TABLE)


@pytest.mark.parametrize("name, others", list(cases()))
def test_the_seven_mass_distributions(name, others):
    """Goldstein, Exercise 2-19: exactly the entries of the table; for the helix with its pitch."""
    q, v, _ = mass_distributions.ORBITS[name]
    params = mass_distributions.PARAMS[name] | ({"h": 0.5} if name == "helix" else {})
    found = lj.symmetries(mass_distributions.SYSTEMS[name], q, v, params)
    assert set(found.steady) == TABLE[name], found
    assert set(found.timed) == BOOSTED.get(name, set()), found
    assert found.gap > 1e10 and all(one.residual < 1e-13 for one in found.details.values())
    exact = mass_distributions.charges(name, q, v, params)
    words = {"Jacobi integral": "E", "h p_z + 2π L_z with h = 0.5": "h p_z + 2 pi L_z"}
    for key in found.steady:
        np.testing.assert_allclose(found[key](0.0, q, v, params), exact[words.get(key, key)], rtol=1e-12)
    random = np.random.default_rng(7)
    for _ in range(others):
        other = {key: value * random.uniform(0.7, 1.3) for key, value in params.items()}
        q, v = (mass_distributions.vector(*random.uniform(-3.0, 3.0, 3)) for _ in range(2))
        found = lj.symmetries(mass_distributions.SYSTEMS[name], q, v, other)
        assert {key.split(" with ")[0] for key in found.steady} == {key.split(" with ")[0] for key in TABLE[name]}


@pytest.mark.slow
def test_the_wedge():
    """p_X + p_x and E, and with t the centre of mass M X + m x; neither momentum alone is conserved."""
    params = sliding_wedge.PARAMS
    start = sliding_wedge.start_on_incline(params, along=1.0, along_rate=0.25)
    found = lj.symmetries(sliding_wedge.system, *start, params)
    assert set(found.steady) == {"p_X + p_x", "Jacobi integral"}
    assert "t p_X + t p_x - M X - m x with M = 4, m = 1.5" in found.timed
    state = 0.0, *start, params
    np.testing.assert_allclose(found["p_X + p_x"](*state), sliding_wedge.horizontal_momentum(params, start[1]))
    np.testing.assert_allclose([found[name].rate(*state) for name in found.steady], 0.0, atol=1e-10)


@pytest.mark.slow
def test_the_rails_in_both_frames():
    """The rotating frame conserves its Jacobi integral; the lab conserves only E - ω L_z, which is equal to it."""
    params = cross_rails.PARAMS
    inside = lj.symmetries(cross_rails.rotating_system, cross_rails.Q0, cross_rails.V0, params)
    assert list(inside) == ["Jacobi integral"]
    at_t = 0.75
    state = cross_rails.to_lab(params, at_t, cross_rails.Q0, cross_rails.V0)
    outside = lj.symmetries(cross_rails.lab_system, *state, params, t=at_t)
    assert list(outside) == ["Jacobi integral - omega L_z with omega = 2.5"]
    h = cross_rails.balance(params, cross_rails.Q0, cross_rails.V0).h
    np.testing.assert_allclose(outside[list(outside)[0]](at_t, *state, params), h, rtol=1e-12)
    np.testing.assert_allclose(inside["Jacobi integral"](0.0, cross_rails.Q0, cross_rails.V0, params), h, rtol=1e-12)


@pytest.mark.slow
def test_free_fall():
    """Of a falling stone also those with t, in words with its numbers."""
    stone = lj.symmetries(STONE, {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}, OF_STONE)
    assert stone.steady == ("p_x", "Jacobi integral") and stone.details["p_x"].cyclic
    assert (
        "p_y + m g t with m = 1.5, g = 9.8125" in stone.timed or "p_y + g m t with g = 9.8125, m = 1.5" in stone.timed
    )


@pytest.mark.slow
def test_constraints_of_velocities():
    """A rolling disk pulled along x conserves E and its spin about the vertical; the plane's symmetries are broken."""
    found = lj.symmetries(DISK, ON_PLANE, rolling(), RADIUS)
    assert set(found.steady) == {"p_theta", "Jacobi integral"}
    assert found.timed == ("4 t p_theta - theta",)


@pytest.mark.slow
def test_own_generators_come_first():
    """A user's generator keeps its name and is not repeated; one that is no symmetry changes nothing."""
    own = {"turn": lambda t, q, params: jnp.stack([-q[1], q[0], 0.0 * q[2]]), "stretch": lambda t, q, params: q}
    found = lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER, basis=own)
    assert set(found) == {"turn", "L_x", "L_y", "Jacobi integral"}
    np.testing.assert_allclose(found["turn"](0.0, *IN_SPACE, OF_KEPLER), 1.25 * np.cross(*IN_SPACE)[2], rtol=1e-13)


def test_small_angles_are_no_small_system():
    """Near rest a pendulum on a cart looks linear; angles drawn over radians avoid spurious symmetries."""

    def cart(t, q, v, p):
        bob = 2.0 * p["l"] * v["x"] * v["theta"] * jnp.cos(q["theta"]) + (p["l"] * v["theta"]) ** 2
        return 0.5 * (p["M"] + p["m"]) * v["x"] ** 2 + 0.5 * p["m"] * bob + p["m"] * p["l"] * jnp.cos(q["theta"])

    state, params = ({"x": 0.0, "theta": 1e-4}, {"x": 0.0, "theta": 0.0}), {"M": 2.0, "m": 0.3, "l": 0.7}
    assert list(lj.symmetries(lj.System(cart), *state, params)) == ["p_x", "Jacobi integral"]


def test_bad_input():
    """Errors for tracing, a wrong generator, no states, and an unknown name."""
    with pytest.raises(TypeError, match="symmetries are found from values"):
        jax.jit(lambda k: len(lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER | {"k": k})))(2.0)
    with pytest.raises(TypeError, match="a generator must be a function of .*, or a lj.Generator"):
        lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER, basis=[1.0])
    undefined = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.log(-1.0 - q**2))
    with pytest.raises(ValueError, match="where L is not finite"):
        lj.symmetries(undefined, 0.5, 0.5)
    found = lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER)
    with pytest.raises(KeyError, match="no symmetry 'p_x' was found; there are 'L_x'"):
        found["p_x"]


@pytest.mark.slow
@pytest.mark.parametrize("values", [(2.0, 1.0, 3.0), (3, 3, 3)])
def test_a_coefficient_is_no_parameter_because_it_has_its_value(values):
    """For any mass 2 p_x - e B y is conserved in a magnetic field, whatever m, e and B are here."""

    def charge(t, q, v, p):
        kinetic = 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2)
        return kinetic + 0.5 * p["e"] * p["B"] * (q["x"] * v["y"] - q["y"] * v["x"])

    at = {"x": 0.3, "y": 0.2}, {"x": 1.0, "y": -0.4}
    found = list(lj.symmetries(lj.System(charge), *at, dict(zip("meB", values))))
    assert [name.split(" with")[0] for name in found[:2]] == ["2 p_x - B e y", "2 p_y + B e x"]


def test_names_of_coefficients_hold_at_other_values():
    """-3/2 is -e B/2 and not -3/m, which it is only here; what agrees with nothing elsewhere is a number."""
    here, there = {"m": 2.0, "e": 1.0, "B": 3.0}, {"m": 2.12, "e": 1.05, "B": 3.2}
    words = lambda elsewhere: in_words([1.0, -1.5], ["p_x", "y"], here, 1e-9, first=["y"], elsewhere=elsewhere).text
    assert words(Ratios(np.array([1.0, -1.05 * 3.2 / 2]), there)) == "2 p_x - e B y with e = 1, B = 3"
    assert words(Ratios(np.array([1.0, -1.5]), there)) == "2 p_x - 3 y"
    assert words(Ratios(np.array([1.0, -7.7]), there)) == "p_x - 1.5 y"
    assert words(None) == "m p_x - 3 y with m = 2"


@pytest.mark.exhaustive
def test_charges_of_a_trajectory_are_drawn():
    """`True` draws charges that the structure shows, a mapping the given ones. Twins: none known, not a function."""
    params = sliding_wedge.PARAMS
    start = sliding_wedge.start_on_incline(params, along=1.0, along_rate=0.25)
    motion = lj.integrate(sliding_wedge.system, *start, params, ts=np.linspace(0.0, 1.0, 9))
    found = lj.symmetries(sliding_wedge.system, *start, params)
    panel = motion.plot(charges=found).axes[-1]
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert "p_X + p_x" in labels and all(np.max(np.abs(line.get_ydata())) < 1e-12 for line in panel.get_lines())
    label = motion.plot(charges=True).axes[-1].get_ylabel()
    assert "Jacobi integral" in label and "at the outputs" in label
    moved = motion.plot(charges={"p_x": lj.noether_charge(sliding_wedge.system, lj.Generator.shift("x"))})
    assert np.max(np.abs(moved.axes[-1].get_lines()[0].get_ydata())) > 0.1
    with pytest.raises(TypeError, match="charge 'p' must be a function"):
        motion.plot(charges={"p": 1.0})
    rubbed = lj.System(STONE.lagrangian, dissipation=lambda t, q, v, params: 0.5 * v["x"] ** 2)
    stone = lj.integrate(rubbed, {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}, OF_STONE, ts=np.linspace(0.0, 1.0, 3))
    with pytest.raises(ValueError, match="nothing is known to be conserved"):
        stone.plot(charges=True)


def test_kepler_and_what_is_no_motion_of_points():
    """Only L and E are found, not the Runge-Lenz vector; the scaling of Kepler's third law is listed separately."""
    found = lj.symmetries(KEPLER, *IN_SPACE, OF_KEPLER)
    assert list(found) == ["L_x", "L_y", "L_z", "Jacobi integral"]
    (third,) = found.scalings
    assert third.exponents == {"q[0]": 1.0, "q[1]": 1.0, "q[2]": 1.0, "t": 1.5} and third.factor == -1.0
    rubbed = lj.System(KEPLER.lagrangian, dissipation=lambda t, q, v, params: 0.05 * v @ v)
    assert len(lj.symmetries(rubbed, *IN_SPACE, OF_KEPLER)) == 0
    # For an inverse square potential the scaling leaves the action unchanged, so it is a symmetry: x·p - 2 t E.
    square = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v @ v - p["k"] / (q @ q))
    found = lj.symmetries(square, *IN_SPACE, OF_KEPLER)
    assert found.timed == ("q·p - 2 t (Jacobi integral)",) and not found.scalings
    charge, (q, v), t = found[found.timed[0]], IN_SPACE, 0.25
    energy = lj.jacobi_integral(square, t, q, v, OF_KEPLER)
    np.testing.assert_allclose(charge(t, q, v, OF_KEPLER), OF_KEPLER["m"] * q @ v - 2 * t * energy, rtol=1e-12)


def test_fields_that_are_tilted():
    """The momentum across a tilted uniform force is conserved; a magnetic field allows shifts up to a gauge."""
    tilted = lj.System(lambda t, q, v, p: 0.5 * v @ v + 3 * q[0] + 4 * q[1])
    found = lj.symmetries(tilted, np.array([1.0, 2.0]), np.array([0.25, 0.5]))
    assert found.steady == ("4 p_q[0] - 3 p_q[1]", "Jacobi integral")
    magnetic = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v @ v + p["B"] * q[0] * v[1])
    found = lj.symmetries(magnetic, *IN_SPACE, {"m": 1.3, "B": 2.5})
    words = "p_q[0] - B q[1] with B = 2.5", "2 L_z - B q[0]^2 + B q[1]^2 with B = 2.5"
    assert set(found.steady) == {"p_q[1]", "p_q[2]", "Jacobi integral", *words}
    # p_x - B y and p_y are the centres of the circles: their rates of change vanish.
    np.testing.assert_allclose([found[w].rate(0.0, *IN_SPACE, {"m": 1.3, "B": 2.5}) for w in words], 0.0, atol=1e-13)


def test_a_wave_that_travels():
    """In a travelling wave neither p nor E is conserved, but ω p - k E is."""
    wave = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.cos(p["k"] * q - p["w"] * t))
    found = lj.symmetries(wave, 0.3, 0.5, {"k": 2.1, "w": 3.3})
    assert list(found) == ["w p_q - k Jacobi integral with w = 3.3, k = 2.1"]


def test_a_weak_disturbance_is_seen():
    """A field of 1e-6 breaks rotations, and the gap shows that it is small."""
    disturbed = lambda size: lj.System(lambda t, q, v, p: KEPLER.lagrangian(t, q, v, p) + size * q[0])
    found = lj.symmetries(disturbed(1e-6), *IN_SPACE, OF_KEPLER)
    assert list(found) == ["L_x", "Jacobi integral"] and found.gap < 1e10
