"""The answer prints itself, plots itself, and carries what it was made of."""

import jax
import matplotlib
import numpy as np
import pytest

import lagjax as lj
from tests.systems import HORIZONTAL, PARAMS, TS, pendulum, rod_pendulum

matplotlib.use("agg")


@pytest.fixture(scope="module")
def traj():
    """The rod pendulum."""
    return lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS)


def test_prints_like_an_instrument(traj):
    """Method, tolerance, steps, residual, Jacobi integral, shapes and dtype stand in the print."""
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


def test_carries_its_system_and_parameters(traj):
    """`system` and `params` give back what went in, and the Jacobi integral is that of its own states."""
    assert traj.system.constraints.keys() == {"rod"}
    assert {name: float(x) for name, x in traj.params.items()} == PARAMS
    at = jax.tree.map(lambda x: x[2], (traj.t, traj.q, traj.v))
    h = lj.jacobi_integral(rod_pendulum, *at, PARAMS)
    np.testing.assert_allclose(traj.jacobi_integral()[2], h, atol=1e-14)
    assert float(traj.drift()) < 1e-8


def test_plot_has_a_panel_for_each_kind(traj):
    """Coordinates, velocities and multipliers, named; one panel less without constraints."""
    axes = traj.plot().axes
    assert [axis.get_ylabel() for axis in axes] == ["q", "v", "multipliers: rod"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["x", "y"]
    free = lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS)
    assert [axis.get_ylabel() for axis in free.plot().axes] == ["q", "v"]


def test_a_batch_is_plotted_lane_by_lane():
    """A batch refuses to plot itself and says how to take a lane."""
    batch = jax.vmap(lambda q0: lj.integrate(pendulum, q0, 0.0, PARAMS, ts=TS))(np.array([0.5, 1.0]))
    with pytest.raises(ValueError, match="(?s)batch of shape.*Fix:"):
        batch.plot()
    assert len(jax.tree.map(lambda x: x[0], batch).plot().axes) == 2
    assert "2" in repr(batch).splitlines()[2]


def test_progress_is_shown(capfd):
    """`progress=True` shows a meter."""
    jax.block_until_ready(lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, progress=True))
    jax.effects_barrier()
    shown = capfd.readouterr()
    assert "100.00%" in shown.out + shown.err
