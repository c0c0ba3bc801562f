"""What rests under forces that change until something gives; normal forces of either sign; numbers that are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from lagjax.integrate.elements import OneGuard, in_modes
from lagjax.integrate.trajectory import Switches
from lagjax.system import State
from tests.by_numpy import by_numpy
from tests.integrate.elements.test_motions import moved

G = 9.81


# A block of mass 1 at a wall, held by a friction of 1 too, and pulled off by a + b t.
held = lj.System(
    lambda t, q, v, p: 0.5 * v**2 + (p["a"] + p["b"] * t) * q,
    elements={"wall": lj.Contact(lambda t, q, p: q), "floor": lj.Friction(lambda t, q, v, p: v, 1.0, normal=1.0)},
)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("start", "a", "b"),
    [((0.0, 0.0), 0.6, 0.2), ((0.0, 0.0), 0.0, 0.2), ((0.1, -1.0), 0.6, 0.2), ((0.0, 0.0), -0.6, 0.4)],
)
def test_a_wall_and_friction_along_one_line(start, a, b):
    """The block rests while a + b t < 1, then q = b (t - t₁)³/6. Twin: with more friction it is elsewhere."""
    gives = (1 - a) / b
    traj = moved(held, *start, {"a": a, "b": b}, ts=jnp.array([0.0, 1.0, 4.0]))
    np.testing.assert_allclose(traj.q[-1], b * max(4.0 - gives, 0.0) ** 3 / 6, rtol=1e-9, atol=1e-12)
    if gives < 4.0:
        assert np.min(np.abs(np.asarray(traj.switches.t)[: len(traj.switches)] - gives)) < 1e-9
        assert b * (4.0 - gives - 0.1 / b) ** 3 / 6 < 0.9 * float(traj.q[-1])


@pytest.mark.exhaustive
def test_squeezed_at_rest():
    """A capsule of 45 g between two pads that squeeze with 12 - 6 t slips where 2 μ F = m g, and then falls with
    -g (t - t₁)/(2 - t₁)."""
    m, mu, r = 0.045, 0.7, 0.004
    rise = lambda t, q, v, p: v["z"]

    def energy(t, q, v, p):
        pads = 0.05 * (v["left"] ** 2 + v["right"] ** 2) + (12.0 - 6.0 * t) * (q["left"] - q["right"])
        return pads + 0.5 * m * (v["x"] ** 2 + v["z"] ** 2) - m * G * q["z"]

    gaps = {"left": lambda t, q, p: q["x"] - q["left"] - r, "right": lambda t, q, p: q["right"] - q["x"] - r}
    pads = {name: lj.Contact(gap, friction=mu, sliding=rise) for name, gap in gaps.items()}
    q0 = {"left": -r, "right": r, "x": 0.0, "z": 0.0}
    traj = lj.integrate(
        lj.System(energy, elements=pads), q0, dict.fromkeys(q0, 0.0), ts=jnp.array([0.0, 1.0, 1.9, 1.96, 2.0])
    )
    slips = 2 - m * G / (2 * mu) / 6
    fallen = -G * np.maximum(np.asarray(traj.t) - slips, 0.0) ** 3 / (6 * (2 - slips))
    np.testing.assert_allclose(traj.q["z"], fallen, rtol=1e-9, atol=1e-15)
    assert isinstance(traj, HybridTrajectory)
    np.testing.assert_allclose(traj.switches.t[0], slips, atol=1e-9)


@pytest.mark.exhaustive
def test_a_normal_force_that_holds_from_both_sides():
    """A bead on a wire, which first carries and then pulls it: friction is μ |N|, by SciPy; the side is a mode. Twin:
    with the multiplier as it is, friction drives the bead."""
    wire = lj.Holonomic(lambda t, q, p: 1.0 - jnp.sqrt(jnp.sum(q**2)))
    along = lambda t, q, v, p: (q[0] * v[1] - q[1] * v[0]) / jnp.sqrt(jnp.sum(q**2))
    rub = lj.Friction(along, 0.2, normal="wire")
    bead = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - G * q[1], {"wire": wire}, elements={"rub": rub})
    place, ts = np.pi / 2 - 0.3, np.array([0.0, 0.3, 0.45])
    start = np.array([np.cos(place), np.sin(place)]), np.array([np.sin(place), -np.cos(place)])
    traj = moved(bead, *start, ts=ts)

    def field(t, y):
        normal = G * np.sin(y[0]) - y[1] ** 2
        return [y[1], -G * np.cos(y[0]) - 0.2 * np.abs(normal) * np.sign(y[1])]

    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12, "max_step": 1e-3}
    angle, rate = solve_ivp(field, (0.0, 0.45), [place, -1.0], t_eval=ts, **options).y
    energies = 0.5 * np.sum(np.asarray(traj.v) ** 2, axis=1) + G * np.asarray(traj.q)[:, 1]
    np.testing.assert_allclose(energies, rate**2 / 2 + G * np.sin(angle), rtol=1e-7)
    assert traj.switches.ways == ("rub", "rub normal") and "rub normal presses" in repr(traj.switches)
    assert np.asarray(traj.modes)[:, 1].tolist() == [-1, -1, 1]
    pressed = np.asarray(traj.multipliers["wire"])
    np.testing.assert_allclose(traj.multipliers["rub"], 0.2 * np.abs(pressed), rtol=1e-12)
    assert pressed[0] * pressed[-1] < 0 and np.ptp(energies) > 0.1


@pytest.mark.exhaustive
def test_what_presses_from_one_side():
    """Friction under N = 1 - p t opposes with μ N, also in `multipliers`; where N falls below zero the motion ends, and
    says so by name. The same of friction below zero, a start of NaN, and in lanes."""
    rub = lj.Friction(lambda t, q, v, p: v, lambda p: p["mu"], normal=lambda t, q, v, p: 1.0 - p["fade"] * t)
    block = lj.System(lambda t, q, v, p: 0.5 * v**2, elements={"floor": rub})

    def run(v0, fade, mu=0.3, q0=0.0, **options):
        return lj.integrate(block, q0, v0, {"fade": fade, "mu": mu}, ts=np.array([0.0, 0.9]), **options)

    for way in (1.0, -1.0):
        traj = run(3.0 * way, 0.5)
        np.testing.assert_allclose(traj.v[-1], way * (3.0 - 0.3 * (0.9 - 0.5 * 0.405)), rtol=1e-9)
        np.testing.assert_allclose(traj.multipliers["floor"], -0.3 * way * np.array([1.0, 0.55]), rtol=1e-12)
    for wrong, error, words in (
        ({"fade": 2.0}, RuntimeError, "normal force of 'floor' falls below zero at t = 0.5"),
        ({"fade": 0.5, "mu": -0.3}, ValueError, "the coefficient of 'floor' is -0.3"),
        ({"fade": 0.5, "q0": np.nan}, ValueError, "of q0 is nan"),
    ):
        with pytest.raises(error, match=words):
            run(3.0, **wrong)
    lanes = jax.vmap(lambda mu: run(3.0, 0.5, mu, throw=False))(np.array([0.3, -0.3]))
    assert np.isnan(lanes.v[:, -1]).tolist() == [False, True]
    refused, codes = lj.RESULTS.element_refused, np.asarray(lanes.result._value)
    assert codes[1] == int(refused._value) != codes[0]


def test_numbers_that_no_law_allows():
    """Each is told by name, from params and as numbers; what is at its bound is allowed."""
    energy = lambda t, q, v, p: 0.5 * jnp.sum(v["x"] ** 2) + q["x"][0] * q["u"]
    slip = lambda t, q, v, p: v["x"][1]
    every = {
        "ball": lj.Contact(lambda t, q, p: q["x"][0], lambda p: p["e"], friction=lambda p: p["mu"], sliding=slip),
        "mat": lj.CompliantContact(lambda t, q, p: q["x"][1], lambda p: p["k"], lambda p: p["c"]),
        "u": lj.SampledControl(lambda t, q, v, p: 0.0, lambda p: p["T"], lambda p: p["from"]),
    }
    right = {"e": 1.0, "mu": 0.0, "k": 1.0, "c": 0.0, "T": 0.1, "from": -1.0}
    x, v, u = np.zeros(2), {"x": np.zeros(2), "u": np.zeros(())}, np.zeros(())
    start = State(np.zeros(()), {"x": x, "u": u}, v, {name: np.array(value) for name, value in right.items()})
    _, laws = in_modes(lj.System(energy, elements=every), start)
    roles = []

    @by_numpy
    def are_allowed(params):
        roles[:], _, allowed = zip(*laws.numbers(start.t, params))
        return allowed

    def refused(**wrong):
        allowed = are_allowed(start.params | wrong)
        return [role for role, right in zip(roles, allowed, strict=True) if not right]

    assert refused() == [] and refused(e=1.5) == refused(e=np.nan) == ["the restitution of 'ball'"]
    assert refused(mu=-0.1) == ["the coefficient of 'ball friction'"] and refused(k=0.0) == ["the stiffness of 'mat'"]
    assert refused(T=np.nan) == refused(T=0.0) == refused(T=-0.1) == ["every of 'u'"]
    assert refused(c=-1.0, **{"from": np.inf}) == ["the damping of 'mat'", "offset of 'u'"]


def test_guards_that_rest_hide_no_others():
    """The least guard, in slacks, of a block that leans at a gap which others hold, is that of its friction. Twin: of a
    gap that does not rest, the gap's."""
    given = {name: np.array(1.0) for name in "ab"}
    start = State(*np.zeros((3, 1))[:, 0], given)
    _, laws = in_modes(held, start)
    # Open and sticking: the friction has 0.4 to spare.
    forces = {"wall": np.zeros(()), "floor": np.array(0.6)}
    least = by_numpy(lambda x: OneGuard(laws)(*start[:3], forces, laws.given(given, np.array([0, 2]), x)))
    found = [float(least(np.array([slack, 1e-3]))) for slack in (-1e-15, 1e-15)]
    np.testing.assert_allclose(found, [401.0, 1.0], rtol=1e-9)


def test_switches_in_words():
    """A gap is struck where velocities jump by more than round-off, and was open; what slides goes forward or back."""
    v, after = np.array([1.0, -2.0, 0.5, 0.0]), np.array([1.0 + 1e-15, 1.0, 0.5, 0.0])
    t, way, none = np.arange(4.0), np.array([0, 0, 1, 1]), np.zeros(4, int)
    modes = np.array([[0, 0], [0, 0], [1, 1], [1, -1]])
    found = Switches(
        t, way, none, v, v, v, after, after - v, np.array(4), np.array(False), ("motion",), ("cam", "cam friction"),
        modes, ("gap", "sliding velocity"),
    )  # fmt: skip
    words = [row.split(" cam")[-1].strip() for row in found.in_rows()]
    assert words == ["open", "is struck, then open", "friction slides forward", "friction slides back"]
