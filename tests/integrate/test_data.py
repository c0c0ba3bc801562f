"""Trajectories in files come back bit for bit, with the system passed again; interrupted writing does no harm.

Trajectories with names: dimensions, coordinates and attributes of their datasets.
"""

from dataclasses import replace
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.solve.phases import traced_phases
from lagjax.system import coordinates
from tests.by_hand import by_hand, with_problem
from tests.by_numpy import network
from tests.systems import HORIZONTAL, PARAMS, motion, rod_pendulum

TS = np.linspace(0.0, 1.0, 4)


class Pair(NamedTuple):
    """Coordinates by name."""

    x: object
    y: object


class Place(eqx.Module):
    """Coordinates in an object."""

    x: jax.Array
    label: str = eqx.field(static=True)


def free(t, q, v, params):
    """A spring in every coordinate."""
    numbers = lambda tree: jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])
    return 0.5 * jnp.sum(numbers(v) ** 2) - 0.5 * jnp.sum(numbers(q) ** 2)


springs = lj.System(free)


def swing(g=9.81):
    """The pendulum released from the side."""
    return lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS | {"g": g}, ts=TS)


def of_springs(q0, params=None, **fields):
    """A motion with coordinates in this structure, irregular numbers, and their errors."""
    rng = np.random.default_rng(0)
    rows = lambda: jax.tree.map(lambda x: rng.normal(size=(4, *np.shape(x))).astype(np.result_type(x)), q0)
    start = coordinates.prepared(0.0, q0, q0, params)
    return by_hand(traced_phases(springs, start), TS, rows(), rows(), start.params, off=(rows(), rows()), **fields)


def check(traj, system, path):
    """Check that a trajectory comes back: arrays bit for bit and of the same kind, and all else equal."""
    traj.save(path)
    again = lj.load_trajectory(path, system, classes=[Pair, Place])
    for a, b in zip(jax.tree.leaves(traj), jax.tree.leaves(again), strict=True):
        assert type(a) is type(b)
        if isinstance(a, (jax.Array, np.ndarray)):
            assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()
        else:
            assert a == b
    assert jax.tree.structure(traj) == jax.tree.structure(again)
    return again


STRUCTURES = {
    "all": {
        "a/b": 1.0, "a.b": [2.0, Pair(1.0, (2.0, np.ones((2, 2))))], "A.B": {"b": np.ones(3)}, "å": 4.0,
        "t": Place(np.array(1.0), "here"),
    },
    "float32": {"x": np.float32(1.0), "y": np.float32(2.0)},
}  # fmt: skip


@pytest.mark.parametrize("name", STRUCTURES)
def test_structures(name, tmp_path):
    """Every structure that coordinates may have, and both dtypes, come back."""
    check(of_springs(STRUCTURES[name]), springs, tmp_path / "x.npz")


def test_how_it_ended(tmp_path):
    """After an event or a failure, the result, the end and NaN beyond it come back."""
    traj = motion("rod pendulum")
    q = {name: np.append(np.asarray(x)[:3], np.nan) for name, x in traj.q.items()}
    end = traj.end._replace(t=np.asarray(0.875))
    for result in (lj.RESULTS.event_occurred, lj.RESULTS.max_steps_reached):
        again = check(replace(traj, q=q, end=end, result=result), rod_pendulum, tmp_path / "x.npz")
        assert bool(again.result == result) and np.isnan(again.q["x"][-1]) and again.end.t == 0.875


def test_the_method_asked_for(tmp_path):
    """A method, a controller and limits on steps come back, each of its kind."""
    pid = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    times = dict(max_step=np.asarray(0.1), jump_ts=np.array([0.5]))
    for asked in (dict(method=diffrax.Dopri5(), stepsize_controller=pid), dict(method=lj.Radau5(), **times)):
        check(with_problem(of_springs(1.0), **asked), springs, tmp_path / "x.npz")


@pytest.mark.exhaustive
def test_many_motions(tmp_path):
    """Batches and the values of sweeps (NumPy arrays) come back."""
    check(jax.vmap(swing)(jnp.array([1.0, 9.81])), rod_pendulum, tmp_path / "x.npz")
    swept = lj.sweep(lambda point: swing(point["g"]), {"g": np.array([1.0, 9.81])}, progress=False)
    check(swept.values, rod_pendulum, tmp_path / "x.npz")


def test_a_million_outputs(tmp_path):
    """A million outputs come back bit for bit, with NaN and the sign of zero; twin: a single changed bit is seen."""
    x = np.random.default_rng(0).normal(size=1_000_000)
    x[:3] = np.nan, -0.0, 5e-324
    fields = np.linspace(0.0, 1.0, len(x)), {"x": x}, {"x": -x}
    by_hand(springs, *fields).save(tmp_path / "long.npz")
    again = lj.load_trajectory(tmp_path / "long.npz")
    bits = lambda tree: [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]
    assert bits((again.t, again.q, again.v)) == bits(fields)
    x[-1] = np.nextafter(x[-1], 9.0)
    assert bits(again.q) != bits({"x": x})


def test_parameters(tmp_path):
    """All data in params come back, and networks with functions of JAX; a function of the user's is refused by name."""
    net = network(1, 1, 4, 1)
    params = {"f": jnp.cos, "net": net, "half": np.ones(2, jnp.bfloat16), "n": 3, "x": 2.5, "who": "me", "no": None}
    params |= {"many": [True, (1, np.float32(2.0))], "inf": float("inf"), "by number": {7: np.arange(3)}}
    check(of_springs(1.0, {"of": params}), springs, tmp_path / "x.npz")
    with pytest.raises(TypeError, match=r"params.f\[0\] is a function \(<lambda>\), and functions are not data"):
        of_springs(1.0, {"f": [lambda x: x]}).save(tmp_path / "y.npz")
    assert not (tmp_path / "y.npz").exists()


TIMES = np.linspace(0.0, 1.0, 5)
system = lj.System(
    lambda t, q, v, params: 0.5 * v["r"] @ v["r"] + 0.5 * v["a"] ** 2 - params["g"] * q["r"][1],
    {"table": lj.Holonomic(lambda t, q, params: q["a"] - 2.0 * t)},
)


def thrown(g, ts=TIMES):
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
    np.testing.assert_array_equal(data["t"], TIMES)
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
    own = batch(thrown(1.0), thrown(1.0, 2 * TIMES)).to_xarray()
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
