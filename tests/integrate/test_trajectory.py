"""A trajectory prints itself, plots itself, and carries its system and parameters."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.structure import what_changes_jacobi_integral
from lagjax.system.model import model_of
from tests.by_hand import by_hand
from tests.systems import PARAMS, TS, motion, pendulum


@pytest.fixture(scope="module")
def traj():
    """The rod pendulum."""
    return motion("rod pendulum")


INSTRUMENT = "Dopri8", "rtol 1e-09", "successful", "accepted", "rejected", "residual", "Jacobi", "float64", "rod (4,)"


def test_prints_like_an_instrument(traj):
    """The print has method, tolerance, steps, residual, Jacobi integral, shapes and dtype; results have messages."""
    text = repr(traj)
    assert [part for part in INSTRUMENT if part not in text] == [] and "need not be conserved" not in text
    assert "RESULTS<successful>" in repr(traj.result)


def test_says_what_need_not_be_conserved():
    """If the Jacobi integral may change, its change is not an error, and the print says why; of NumPy arrays too."""
    swing = by_hand(lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.cos(t) * q), TS, TS, TS)
    assert "(relative, at the outputs); need not be conserved: L depends on t" in repr(swing)
    assert "need not be conserved: there is a force" in repr(motion("driven"))


CHANGES = {
    "there is a force": {"force": lambda t, q, v, params: -q},
    "there is dissipation": {"dissipation": lambda t, q, v, params: v**2},
    "constraint 'c' restricts velocities": {"constraints": {"c": lj.Nonholonomic(lambda t, q, v, params: v)}},
    "constraint 'c' depends on t": {"constraints": {"c": lj.Holonomic(lambda t, q, params: q - t)}},
}


@pytest.mark.parametrize("words", CHANGES)
def test_what_changes_the_jacobi_integral(words):
    """Each cause is named, and a system that conserves the Jacobi integral has none."""
    state = *map(np.asarray, (0.0, 1.0, 1.0)), None
    free = lambda t, q, v, params: 0.5 * v**2
    assert list(what_changes_jacobi_integral(model_of(lj.System(free, **CHANGES[words]), *state))) == [words]
    assert not list(what_changes_jacobi_integral(model_of(lj.System(free), *state)))


def test_carries_its_system_and_parameters(traj):
    """`system` and `params` return what was passed in, and the Jacobi integral is that of the trajectory's states."""
    assert traj.system.constraints.keys() == {"rod"}
    assert {name: float(x) for name, x in traj.params.items()} == PARAMS
    (_, y), (u, w) = (map(np.asarray, (of["x"], of["y"])) for of in (traj.q, traj.v))
    np.testing.assert_allclose(traj.jacobi_integral(), 0.5 * (u**2 + w**2) + PARAMS["g"] * y, atol=1e-14)
    assert float(traj.drift()) < 1e-8


def test_plot_has_a_panel_for_each_kind(traj):
    """Panels of coordinates, velocities and multipliers, named; one fewer without constraints. A batch refuses."""
    axes = traj.plot().axes
    assert [axis.get_ylabel() for axis in axes] == ["q", "v", "multipliers: rod"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["x", "y"]
    free = [by_hand(pendulum, TS, a + TS, TS, PARAMS) for a in (0.5, 1.0)]
    assert [axis.get_ylabel() for axis in free[0].plot().axes] == ["q", "v"]
    batch = jax.tree.map(lambda *x: np.stack(x), *free)
    with pytest.raises(ValueError, match="(?s)batch of shape.*Fix:"):
        batch.plot()
    assert "2" in repr(batch).splitlines()[2]
    starts = [np.asarray(line.get_xdata())[0] for line in batch.phase_portrait().axes[0].lines[::2]]
    assert starts == [0.5, 1.0]


def test_phase_portrait_of_a_rotation_stays_in_a_turn():
    """An angle that goes around is drawn between -π and π, cut at the ends; one that only swings is left alone."""
    # v² is that of the pendulum's energy at each angle.
    q = np.linspace(1.0, 16.0, 101)
    v = np.sqrt(9.0**2 + 2 * PARAMS["g"] / PARAMS["l"] * (np.cos(q) - np.cos(1.0)))
    (axis,) = by_hand(pendulum, q, q, v, PARAMS).phase_portrait().axes
    x, y = map(np.asarray, axis.lines[0].get_data())
    assert np.nanmax(np.abs(x)) <= np.pi and np.nanmax(x) == np.pi and np.nanmin(x) == -np.pi
    assert np.isnan(x).sum() == int(np.ptp(np.floor((q + np.pi) / (2 * np.pi)))) == 3
    # At the cut the curve is still the orbit: ½ v² - (g/l) cos q is the start's, within the spacing of outputs.
    energy = 0.5 * y**2 - PARAMS["g"] / PARAMS["l"] * np.cos(x)
    np.testing.assert_allclose(energy[np.isfinite(energy)], energy[0], rtol=2e-3)
    assert [label.get_text() for label in axis.get_xticklabels() if abs(label.get_position()[0]) < 3.2] == [
        "-π", "-π/2", "0", "π/2", "π"]  # fmt: skip
    swing = motion("pendulum")
    drawn = swing.phase_portrait().axes[0].lines[0].get_data()
    np.testing.assert_array_equal(drawn, [swing.q, swing.v])


def test_phase_portrait_has_a_panel_a_coordinate(traj):
    """Panels have the user's names; lengths keep their ticks and are never cut; NaN after an event is not drawn."""
    axes = [axis for axis in traj.phase_portrait().axes if axis.get_visible()]
    assert [(axis.get_xlabel(), axis.get_ylabel()) for axis in axes] == [("q: x", "v: x"), ("q: y", "v: y")]
    np.testing.assert_array_equal(axes[1].lines[0].get_data(), [traj.q["y"], traj.v["y"]])
    far = by_hand(lj.System(lambda t, q, v, p: 0.5 * v**2 - q), TS, 100.0 * TS, 100.0 + 0 * TS)
    far = replace(far, q=np.append(far.q, np.nan), v=np.append(far.v, np.nan)).phase_portrait().axes[0]
    assert np.asarray(far.lines[0].get_xdata()).tolist() == [*100.0 * TS] and "π" not in str(far.get_xticklabels()[0])
