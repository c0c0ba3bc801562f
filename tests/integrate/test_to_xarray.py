"""Trajectories with names: dimensions, coordinates and attributes of their datasets."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.by_hand import by_hand

TS = np.linspace(0.0, 1.0, 5)
system = lj.System(
    lambda t, q, v, params: 0.5 * v["r"] @ v["r"] + 0.5 * v["a"] ** 2 - params["g"] * q["r"][1],
    {"table": lj.Holonomic(lambda t, q, params: q["a"] - 2.0 * t)},
)


def thrown(g, ts=TS):
    """A thrown stone, and a second coordinate that moves at speed 2."""
    q = {"r": np.stack([3.0 * ts, 1.0 + 4.0 * ts - 0.5 * g * ts**2], axis=1), "a": 2.0 * ts}
    v = {"r": np.stack([3.0 + 0 * ts, 4.0 - g * ts], axis=1), "a": 2.0 + 0 * ts}
    params = {"g": np.asarray(g), "who": "me", "w": np.array([1.0, 2.0])}
    return by_hand(system, ts, q, v, params, off=(q, v), multipliers={"table": 0 * ts})


def test_one_motion():
    """Variables by name against time with the trajectory's values; attributes say what was integrated."""
    traj = thrown(10.0)
    data = traj.to_xarray()
    assert data["q.r"].dims == data["v.r"].dims == ("t", "r_0") and data["q.a"].dims == data["table"].dims == ("t",)
    np.testing.assert_array_equal(data["t"], TS)
    np.testing.assert_array_equal(data["v.r"], traj.v["r"])
    np.testing.assert_array_equal(data["error.q.a"], traj.error.q["a"])
    np.testing.assert_allclose(data["q.r"].sel(t=0.5), [1.5, 1.75], atol=1e-12)
    assert data.attrs["params.g"] == 10.0 and data.attrs["params.who"] == "me" and data.attrs["params.w"] == [1.0, 2.0]
    assert data.attrs["method"] == "Dopri8" and data.attrs["rtol"] == [1e-9, 1e-9]
    assert data.attrs["result"] == data["result"].attrs["flag_meanings"] == "successful"
    assert int(data["num_steps"]) == traj.stats["num_steps"]


def test_batches():
    """The batch's axes come first, under their names; parameters, and times that lanes do not share, are variables."""
    batch = lambda *lanes: jax.tree.map(lambda *x: np.stack(x), *lanes)
    lanes = batch(thrown(1.0), thrown(10.0))
    data, named = lanes.to_xarray(), lanes.to_xarray("g")
    assert data["q.r"].dims == ("batch", "t", "r_0") and data["params.g"].dims == ("batch",)
    np.testing.assert_array_equal(data["params.g"], [1.0, 10.0])
    assert named["q.a"].dims == ("g", "t") and named["params.w"].dims == ("g", "params.w_0")
    with pytest.raises(ValueError, match="2 names, 'g', 'm', but this trajectory has 1 axes"):
        lanes.to_xarray(("g", "m"))
    own = batch(thrown(1.0), thrown(1.0, 2 * TS)).to_xarray()
    assert "t" not in own.coords and own["times"].dims == ("batch", "t")


@pytest.mark.exhaustive
def test_phases_and_events():
    """The phase of each output as a number with its meaning, and the times of switches; of elements, their modes."""
    ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    floor = lj.Switch("air", to="air", when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -0.5 * v)
    data = lj.integrate(lj.Hybrid({"air": ball}, [floor], most_switches=3), 5.0, 0.0, ts=np.array([0.0, 1.5]))
    data = data.to_xarray()
    assert data["phase"].dims == ("t",) and data["phase"].attrs["flag_meanings"] == "air"
    np.testing.assert_allclose(data["events.switches"][0], 1.0, atol=1e-9)
