"""Where a stiffness is zero, the first term that does not vanish decides."""

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.balance import NO_BALANCE

HILLS = lj.System(
    lambda t, q, v, p: 0.5 * v**2 - sum(c * (q - p["at"]) ** k for k, c in enumerate(p["c"], 1)),
    dissipation=lambda t, q, v, p: 0.5 * p["friction"] * v**2 + p["cubic"] * v**4,
)
FLATLAND = {"c": np.zeros(6), "at": 0.0, "friction": 0.0, "cubic": 0.0}


def hill(powers, **changes):
    """What three starts find where V = Σ c (q - at)^k."""
    params = FLATLAND | {"c": np.array([powers.get(k, 0.0) for k in range(1, 7)])} | changes
    return lj.equilibria(HILLS, params, starts=np.array([-1.0, 0.25, 0.75]) + params["at"])


def words(found):
    """The verdicts of the equilibria found: "stable", "unstable" or "undecided"."""
    named = zip(found.stable, found.undecided)
    return ["stable" if stable else "undecided" if undecided else "unstable" for stable, undecided in named]


@pytest.mark.parametrize(
    "power, factor, verdict, changes",
    [
        (4, -1.0, "unstable", {}),
        (4, 1.0, "stable", {"at": 0.75}),
        (3, 1.0, "unstable", {"friction": 0.5}),
        pytest.param(6, -1.0, "unstable", {"at": 0.75, "friction": 0.5}, marks=pytest.mark.exhaustive),
    ],
)
def test_hills_of_any_order(power, factor, verdict, changes):
    """V = c q^k at 0 and elsewhere: one equilibrium from all starts, stable exactly for even k and c > 0."""
    found = hill({power: factor}, **changes)
    assert words(found) == [verdict] and found.zero_modes.tolist() == [1]
    np.testing.assert_allclose(found.q, [changes.get("at", 0.0)], atol=1e-8)
    assert np.all(found.of_start[found.status == 0] == 0)


def test_what_decides_nothing():
    """Friction that gives energy is undecided; a term that is there decides; a free particle is a family."""
    assert words(hill({4: 1.0}, cubic=1.0)) == ["stable"]
    assert words(hill({4: 1.0}, cubic=-1.0)) == ["undecided"]
    assert words(hill({})) == ["stable"] * 3
    # Twin: with a stiffness there is no zero mode.
    assert hill({2: 1.0, 4: 1.0}).zero_modes.tolist() == [0]


def test_starts_that_lead_nowhere():
    """A nonzero minimum of the imbalance is no equilibrium; these starts are reported, and others find one."""
    none = hill({1: 1.0, 3: 1 / 3})
    assert len(none) == 0 and none.status.tolist() == [NO_BALANCE] * 3
    assert len(hill({1: -1.0, 3: 1 / 3})) == 2
    np.testing.assert_array_equal(none.starts, [-1.0, 0.25, 0.75])
    assert np.all(np.isfinite(none.last))
    assert "3 starts led to none: no equilibrium near it" in repr(none) and "from (q = -1) as far as" in repr(none)


@pytest.mark.slow
def test_in_a_batch():
    """Under `vmap` nothing is merged, a zero mode decides nothing, and the printed form shows the batch."""
    found = jax.jit(jax.vmap(lambda cubic: hill({4: 1.0}, cubic=cubic)))(np.array([0.0, 1.0]))
    assert found.undecided.all() and not found.stable.any()
    assert found.found.shape == (2, 3) and found.found.all() and "a batch of 2 with 3 starts each" in repr(found)


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


@pytest.mark.exhaustive
def test_a_multiple_root_on_a_constraint(at=1.0):
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
