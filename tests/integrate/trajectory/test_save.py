"""Trajectories in files come back bit for bit, with the system passed again; interrupted writing does no harm."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

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


def falling(t, q, v, params):
    """A unit mass falling in a plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


def on_rod(t, q, params):
    """A rod of length 1."""
    return q["x"] ** 2 + q["y"] ** 2 - 1.0


springs, rod = lj.System(free), lj.System(falling, {"rod": lj.Holonomic(on_rod)})
START = {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}


def swing(g=9.81, **settings):
    """The pendulum released from the side."""
    return lj.integrate(rod, *START, {"g": g}, ts=TS, **settings)


def check(traj, system, path):
    """Check that a trajectory comes back: arrays bit for bit and of the same kind, all else equal, and its print."""
    traj.save(path)
    again = lj.load_trajectory(path, system, classes=[Pair, Place])
    pairs = list(zip(jax.tree.leaves(traj), jax.tree.leaves(again), strict=True))
    for a, b in pairs:
        assert type(a) is type(b)
        if isinstance(a, (jax.Array, np.ndarray)):
            assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()
        else:
            assert a == b
    assert jax.tree.structure(traj) == jax.tree.structure(again) and repr(traj) == repr(again)
    return again


@pytest.mark.parametrize(
    "q0",
    [
        1.0,
        jnp.array([1.0, 2.0]),
        (1.0, jnp.ones((2, 2))),
        [1.0, 2.0],
        Pair(1.0, 2.0),
        {"a": {"b": [1.0, Pair(1.0, (2.0,))]}, "t": jnp.ones(3)},
        {"a/b": 1.0, "a.b": 2.0, "A.B": 3.0, "å": 4.0},
        Place(jnp.array(1.0), "here"),
        {"x": np.float32(1.0), "y": np.float32(2.0)},
    ],
    ids=["number", "vector", "tuple", "list", "named", "nested", "odd names", "object", "float32"],
)
@pytest.mark.slow
def test_structures(q0, tmp_path):
    """Every structure that coordinates may have, and both dtypes, come back."""
    traj = lj.integrate(springs, q0, jax.tree.map(jnp.zeros_like, q0), ts=TS)
    check(traj, springs, tmp_path / "x.npz")


@pytest.mark.slow
def test_how_it_ended(tmp_path):
    """After an event or a failure, the result, the end and NaN beyond it come back."""
    low = {"low": lj.Crossing(lambda t, q, v, params: q["y"] + 0.9)}
    for traj, result in (
        (swing(events=low), lj.RESULTS.event_occurred),
        (swing(max_steps=5, throw=False), lj.RESULTS.max_steps_reached),
    ):
        again = check(traj, rod, tmp_path / "x.npz")
        assert bool(again.result == result) and np.isnan(again.q["x"][-1]) and again.end.t == traj.end.t


@pytest.mark.exhaustive
def test_methods_and_controllers(tmp_path):
    """The method and the steps asked for come back, so that `at` continues the motion as before."""
    pid = dict(method=diffrax.Dopri5(), stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6))
    implicit = dict(method=lj.Radau5(), max_step=0.1, jump_ts=[0.5])
    for settings in (pid, implicit):
        traj = swing(**settings)
        again = check(traj, rod, tmp_path / "x.npz")
        np.testing.assert_array_equal(again.at(0.3).q["x"], traj.at(0.3).q["x"])


@pytest.mark.exhaustive
def test_many_motions(tmp_path):
    """Batches, the values of sweeps (NumPy arrays), and motions in phases come back."""
    check(jax.vmap(swing)(jnp.array([1.0, 9.81])), rod, tmp_path / "x.npz")
    swept = lj.sweep(lambda point: swing(point["g"]), {"g": np.array([1.0, 9.81])}, progress=False)
    check(swept.values, rod, tmp_path / "x.npz")
    floor = lj.Switch("air", to="air", when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -0.5 * v)
    bouncing = lj.Hybrid({"air": springs}, [floor], most_switches=3)
    traj = lj.integrate(bouncing, 1.0, 0.0, ts=np.array([0.0, 1.0, 2.5]))
    traj.save(tmp_path / "x.npz")
    again = lj.load_trajectory(tmp_path / "x.npz", bouncing)
    assert isinstance(again, lj.HybridTrajectory) and isinstance(traj, lj.HybridTrajectory)
    assert repr(again) == repr(traj) and "not given" in repr(lj.load_trajectory(tmp_path / "x.npz"))
    np.testing.assert_array_equal(again.switches.t, traj.switches.t)
    np.testing.assert_array_equal(again.at(2.0).q, traj.at(2.0).q)
    with pytest.raises(ValueError, match="switch 0: air -> air, None is missing"):
        lj.load_trajectory(tmp_path / "x.npz", lj.Hybrid({"air": springs}))


def test_a_million_outputs(tmp_path):
    """A million outputs come back bit for bit, with NaN and the sign of zero; twin: a single changed bit is seen."""
    traj, rng = lj.integrate(springs, {"x": 1.0}, {"x": 0.0}, ts=TS), np.random.default_rng(0)
    x = rng.normal(size=1_000_000)
    x[:3] = np.nan, -0.0, 5e-324
    fields = {"t": np.linspace(0.0, 1.0, len(x)), "q": {"x": x}, "v": {"x": -x}}
    long = type(traj)(**(vars(traj) | jax.tree.map(jnp.asarray, fields) | {"error": None}))
    long.save(tmp_path / "long.npz")
    again = lj.load_trajectory(tmp_path / "long.npz")
    bits = lambda tree: [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]
    assert bits((again.t, again.q, again.v)) == bits(tuple(fields.values()))
    x[-1] = np.nextafter(x[-1], 9.0)
    assert bits(again.q) != bits({"x": x})


def test_parameters(tmp_path):
    """All data in params come back, and networks with functions of JAX; a function of the user's is refused by name."""
    net = eqx.nn.MLP(1, 1, 4, 1, key=jax.random.key(0))
    params = {"f": jnp.cos, "net": net, "half": jnp.ones(2, jnp.bfloat16), "n": 3, "x": 2.5, "who": "me", "no": None}
    params |= {"many": [True, (1, np.float32(2.0))], "inf": float("inf"), "by number": {7: np.arange(3)}}
    traj = lj.integrate(springs, 1.0, 0.0, {"of": params}, ts=TS)
    check(traj, springs, tmp_path / "x.npz")
    traj = lj.integrate(springs, 1.0, 0.0, {"f": [lambda x: x]}, ts=TS)
    with pytest.raises(TypeError, match=r"params.f\[0\] is a function \(<lambda>\), and functions are not data"):
        traj.save(tmp_path / "y.npz")
    assert not (tmp_path / "y.npz").exists()
