"""Where a stiffness is zero, the first term that does not vanish decides."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.equilibria.test_equilibria import HILLS, one, words

HILL = {"c": np.zeros(4), "at": 0.0, "friction": 0.0, "cubic": 0.0}


@pytest.mark.parametrize(
    "power, factor, verdict", [(4, -1.0, "unstable"), (4, 1.0, "stable"), (3, 1.0, "unstable"), (6, -1.0, "unstable")]
)
def test_hills_of_any_order(power, factor, verdict):
    """V = c q^k at 0 and elsewhere: one equilibrium from nine starts, stable exactly for even k and c > 0."""
    c = factor * np.eye(4)[power - 3]
    for changes in ({}, {"at": 0.75}, {"friction": 0.5}):
        found = one(HILL | {"c": c} | changes)
        assert words(found) == [verdict] and found.zero_modes.tolist() == [1]
        np.testing.assert_allclose(found.q, [changes.get("at", 0.0)], atol=1e-8)
        assert np.all(found.of_start[found.status == 0] == 0)


def test_what_decides_nothing():
    """Friction that gives energy is undecided; a term that is there decides; a free particle is a family."""
    quartic = HILL | {"c": np.array([0.0, 1.0, 0.0, 0.0])}
    assert words(one(quartic | {"cubic": 1.0})) == ["stable"]
    assert words(one(quartic | {"cubic": -1.0})) == ["undecided"]
    assert words(one(HILL)) == ["stable"] * 9
    traced = jax.jit(lambda p: one_traced(p))(quartic)
    assert bool(traced[1]) and not bool(traced[0])


def one_traced(params):
    """Stable, and undecided, from one start in a program."""
    found = lj.equilibria(HILLS, params, starts=[0.5])
    return found.stable[0], found.undecided[0]


VALLEY = lj.System(
    lambda t, q, v, p: (
        0.5 * (v["x"] ** 2 + v["y"] ** 2) + p["turn"] * q["x"] * v["y"]
        - p["k"] * (q["y"] - p["bend"] * q["x"] ** 2) ** 2 - p["x4"] * q["x"] ** 4 - p["y4"] * q["y"] ** 4
        - p["apart"] * (q["x"] - q["y"]) ** 4
    )
)  # fmt: skip


FLAT = {"turn": 0.0, "k": 0.0, "bend": 0.0, "x4": 0.0, "y4": 0.0, "apart": 0.0}


ON_A_LINE = lj.System(
    lambda t, q, v, p: (
        0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["x4"] * (q["x"] - p["at"]) ** 4 - p["x6"] * (q["x"] - p["at"]) ** 6
        - p["weight"] * q["y"]
    ),
    {"line": lj.Holonomic(lambda t, q, p: q["y"] - p["at"])},
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.0, 1.0])
def test_a_multiple_root_on_a_constraint(at):
    """V = c (x - a)^k on a line, with and without weight across it: one rest, at a, stable exactly for c > 0."""
    starts = [{"x": at + 0.3, "y": at}, {"x": at - 0.5, "y": at + 0.1}]
    for x4, x6, stable in ((1.0, 0.0, True), (-1.0, 0.0, False), (0.0, 1.0, True), (0.0, -1.0, False)):
        for weight in (0.0, 9.81):
            params = {"x4": x4, "x6": x6, "weight": weight, "at": at}
            found = lj.equilibria(ON_A_LINE, params, starts=starts)
            assert words(found) == ["stable" if stable else "unstable"] and found.zero_modes.tolist() == [1]
            np.testing.assert_allclose((found.q["x"][0], found.q["y"][0]), at, atol=1e-8)
            np.testing.assert_allclose(found.multipliers["line"][0], weight, atol=1e-8)


BESIDE = [{"x": 0.3, "y": 0.2}, {"x": -0.4, "y": 0.5}]


@pytest.mark.slow
def test_the_centre_manifold_decides():
    """V = (y - x²)² + c x⁴ has the reduced potential c x⁴, though c - 1 stands in its x⁴; twin: the other sign of c."""
    at = lambda **changes: lj.equilibria(VALLEY, FLAT | changes, starts=BESIDE)
    for c, verdict in ((0.5, "stable"), (-0.5, "unstable")):
        found = at(k=1.0, bend=1.0, x4=c)
        assert words(found) == [verdict] and abs(float(found.q["x"][0])) < 1e-6
    # All of the valley's floor is in equilibrium.
    assert words(at(k=1.0, bend=1.0)) == ["stable"] * 2
    # With gyroscopic forces a minimum is stable, a hill beside a valley unstable, and two hills are undecided.
    assert words(at(k=1.0, x4=1.0, turn=1.0)) == ["stable"]
    assert words(at(k=1.0, x4=-1.0, turn=1.0)) == ["unstable"]
    assert words(at(k=-1.0, x4=-1.0, turn=3.0)) == ["undecided"]


@pytest.mark.slow
def test_several_zero_modes():
    """x⁴ + y⁴ is stable, x⁴ - y⁴ not; of (x - y)⁴ the shift of both is a family, and the rest decides."""
    at = lambda **changes: lj.equilibria(VALLEY, FLAT | changes, starts=BESIDE)
    assert words(at(x4=1.0, y4=1.0)) == ["stable"]
    assert words(at(x4=1.0, y4=-1.0)) == ["unstable"]
    assert words(at(x4=-1.0, y4=-1.0, turn=1.0)) == ["undecided"]
    assert words(at(apart=1.0)) == ["stable"] * 2 and words(at(apart=-1.0)) == ["unstable"] * 2
