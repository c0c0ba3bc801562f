"""A trajectory prints itself, plots itself, and carries its system and parameters."""

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.structure import what_changes_jacobi_integral
from lagjax.system.model import model_of
from tests.systems import HORIZONTAL, PARAMS, TS, pendulum, rod_pendulum

matplotlib.use("agg")


@pytest.fixture(scope="module")
def traj():
    """The rod pendulum."""
    return lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS)


def test_prints_like_an_instrument(traj):
    """The print has method, tolerance, steps, residual, Jacobi integral, shapes and dtype."""
    text = repr(traj)
    for part in (
        "Dopri8",
        "rtol 1e-09",
        "successful",
        "accepted",
        "rejected",
        "residual",
        "Jacobi",
        "float64",
        "rod (4,)",
    ):
        assert part in text, part


def test_says_what_need_not_be_conserved(traj):
    """If the Jacobi integral may change, its change is not an error, and the print says why; results have messages."""
    assert "need not be conserved" not in repr(traj)
    driven = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2 + jnp.cos(t) * q)
    swing = lj.integrate(driven, 1.0, 0.0, None, ts=TS)
    assert "(relative, at the outputs); need not be conserved: L depends on t" in repr(swing)
    assert "L depends on t" in repr(jax.tree.map(np.asarray, swing)), "of a sweep's trajectories, too"
    assert "RESULTS<successful>" in repr(traj.result)


CHANGES = {
    "there is a force": {"force": lambda t, q, v, params: -q},
    "there is dissipation": {"dissipation": lambda t, q, v, params: v**2},
    "constraint 'c' restricts velocities": {"constraints": {"c": lj.Nonholonomic(lambda t, q, v, params: v)}},
    "constraint 'c' depends on t": {"constraints": {"c": lj.Holonomic(lambda t, q, params: q - t)}},
}


@pytest.mark.parametrize("words", CHANGES)
def test_what_changes_the_jacobi_integral(words):
    """Each cause is named, and a system that conserves the Jacobi integral has none."""
    state = jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray(1.0), None
    free = lambda t, q, v, params: 0.5 * v**2
    assert list(what_changes_jacobi_integral(model_of(lj.System(free, **CHANGES[words]), *state))) == [words]
    assert not list(what_changes_jacobi_integral(model_of(lj.System(free), *state)))


def test_carries_its_system_and_parameters(traj):
    """`system` and `params` return what was passed in, and the Jacobi integral is that of the trajectory's states."""
    assert traj.system.constraints.keys() == {"rod"}
    assert {name: float(x) for name, x in traj.params.items()} == PARAMS
    at = jax.tree.map(lambda x: x[2], (traj.t, traj.q, traj.v))
    h = lj.jacobi_integral(rod_pendulum, *at, PARAMS)
    np.testing.assert_allclose(traj.jacobi_integral()[2], h, atol=1e-14)
    assert float(traj.drift()) < 1e-8


def test_plot_has_a_panel_for_each_kind(traj):
    """Panels of coordinates, velocities and multipliers, named; one fewer without constraints."""
    axes = traj.plot().axes
    assert [axis.get_ylabel() for axis in axes] == ["q", "v", "multipliers: rod"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["x", "y"]
    free = lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS)
    assert [axis.get_ylabel() for axis in free.plot().axes] == ["q", "v"]


@pytest.mark.exhaustive
def test_a_batch_is_plotted_lane_by_lane():
    """A batch refuses to plot itself and says how to select a lane."""
    batch = jax.vmap(lambda q0: lj.integrate(pendulum, q0, 0.0, PARAMS, ts=TS))(np.array([0.5, 1.0]))
    with pytest.raises(ValueError, match="(?s)batch of shape.*Fix:"):
        batch.plot()
    assert len(jax.tree.map(lambda x: x[0], batch).plot().axes) == 2
    assert "2" in repr(batch).splitlines()[2]


@pytest.mark.slow
def test_phase_portrait_of_a_rotation_stays_in_a_turn():
    """An angle that goes around is drawn between -π and π, cut at the ends; one that only swings is left alone."""
    spin = lj.integrate(pendulum, 1.0, 9.0, PARAMS, ts=np.linspace(0.0, 3.0, 101))
    assert float(np.ptp(spin.q)) > 2 * 2 * np.pi
    (axis,) = spin.phase_portrait().axes
    x, y = map(np.asarray, axis.lines[0].get_data())
    assert np.nanmax(np.abs(x)) <= np.pi and np.nanmax(x) == np.pi and np.nanmin(x) == -np.pi
    assert np.isnan(x).sum() == int(np.ptp(np.floor((np.asarray(spin.q) + np.pi) / (2 * np.pi))))
    # At the cut the curve is still the orbit: ½ v² - (g/l) cos q is the start's, within the spacing of outputs.
    energy = 0.5 * y**2 - PARAMS["g"] / PARAMS["l"] * np.cos(x)
    np.testing.assert_allclose(energy[np.isfinite(energy)], energy[0], rtol=2e-3)
    assert [label.get_text() for label in axis.get_xticklabels() if abs(label.get_position()[0]) < 3.2] == [
        "-π", "-π/2", "0", "π/2", "π"]  # fmt: skip
    swing = lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS)
    drawn = swing.phase_portrait().axes[0].lines[0].get_data()
    np.testing.assert_array_equal(drawn, [swing.q, swing.v])


@pytest.mark.exhaustive
def test_phase_portrait_has_a_panel_a_coordinate(traj):
    """Panels have the user's names; lengths keep their ticks and are never cut; a batch has one curve per lane."""
    axes = [axis for axis in traj.phase_portrait().axes if axis.get_visible()]
    assert [(axis.get_xlabel(), axis.get_ylabel()) for axis in axes] == [("q: x", "v: x"), ("q: y", "v: y")]
    np.testing.assert_array_equal(axes[1].lines[0].get_data(), [traj.q["y"], traj.v["y"]])
    free = lj.System(lambda t, q, v, params: 0.5 * v**2)
    far = lj.integrate(free, 0.0, 100.0, ts=TS).phase_portrait().axes[0]
    assert np.asarray(far.lines[0].get_xdata())[-1] == 100.0 and "π" not in far.get_xticklabels()[0].get_text()
    batch = jax.vmap(lambda q0: lj.integrate(pendulum, q0, 0.0, PARAMS, ts=TS))(np.array([0.5, 1.0]))
    starts = [np.asarray(line.get_xdata())[0] for line in batch.phase_portrait().axes[0].lines[::2]]
    assert starts == [0.5, 1.0]


@pytest.mark.slow
def test_phase_portrait_ends_with_the_motion():
    """NaN after an event is not drawn."""
    down = diffrax.Event(lambda t, y, params, **kwargs: y[0])
    ended = lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=np.linspace(0.0, 2.0, 41), event=down)
    x, _ = ended.phase_portrait().axes[0].lines[0].get_data()
    assert np.isfinite(x).all() and len(x) == int(np.isfinite(ended.q).sum()) < 41
