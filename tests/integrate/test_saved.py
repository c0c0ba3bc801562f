"""Trajectories in files come back bit for bit, with the system passed again; interrupted writing does no harm."""

import json
import os
import subprocess
import sys
import zipfile
from collections import namedtuple
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.files import npz

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


def test_system_given_again(tmp_path):
    """With its system a trajectory works as before; without, it has the computed values and says what is missing."""
    path = tmp_path / "swing.npz"
    traj = swing(events={"low": lj.Crossing(lambda t, q, v, params: q["y"] + 0.9, terminal=False)})
    again = check(traj, rod, path)
    assert again.drift() == traj.drift() and again.residual() == traj.residual()
    np.testing.assert_array_equal(again.jacobi_integral(), traj.jacobi_integral())
    without = lj.load_trajectory(path)
    assert "System(falling; constraints: rod (holonomic)), not given" in repr(without)
    assert without.params["g"] == 9.81 and without.events["low"].t[0] == traj.events["low"].t[0]
    assert len(without.plot().axes) == len(traj.plot().axes)
    for ask in (without.drift, without.residual, without.jacobi_integral, lambda: lj.energy_ledger(without)):
        with pytest.raises(ValueError, match=r"needs the functions of the system .*\n.*load_trajectory\(path, system="):
            ask()
    # A trajectory read without its system is written again with all that is known of the system.
    check(without, None, path)
    assert repr(lj.load_trajectory(path, rod)) == repr(traj)


def test_another_system_is_told(tmp_path):
    """Another system is refused by what differs at a state; twin: the same functions, redefined, are accepted."""
    path = tmp_path / "swing.npz"
    swing().save(path)
    pull = lambda t, q, v, params: {"x": 0.0 * q["x"], "y": 0.0 * q["y"]}
    for other, words in (
        (lj.System(falling), "the constraint 'rod' is missing"),
        (lj.System(falling, {"bar": lj.Holonomic(on_rod)}), "the constraint 'bar' is there, but was not before"),
        (lj.System(falling, {"rod": lj.Holonomic(lambda t, q, params: q["x"])}), "the constraint 'rod': its value was"),
        (lj.System(lambda *state: falling(*state) + 0.1 * state[1]["x"], rod.constraints), "Lagrangian: its value was"),
        (lj.System(falling, rod.constraints, force=pull), "the force is there, but was not before"),
        (lj.System(lambda t, q, v, params: params["mass"]), "cannot be evaluated at a state of that motion"),
    ):
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path, other)
    with pytest.raises(TypeError, match="system must be a lj.System, not function"):
        lj.load_trajectory(path, falling)
    made_anew = lj.System(lambda *state: falling(*state), {"rod": lj.Holonomic(lambda *at: on_rod(*at))})
    assert lj.load_trajectory(path, made_anew).drift() < 1e-6


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


def test_classes_of_the_user_are_passed(tmp_path):
    """An object comes back if its class is passed; twins: without it, with another of other fields, with no class."""
    of = lambda q0, v0: lj.integrate(springs, q0, v0, ts=TS)
    of(Pair(1.0, 2.0), Pair(0.0, 0.0)).save(tmp_path / "pair.npz")
    of(Place(jnp.array(1.0), "here"), Place(jnp.array(0.0), "here")).save(tmp_path / "place.npz")
    for name, cls in (("pair", Pair), ("place", Place)):
        assert type(lj.load_trajectory(tmp_path / f"{name}.npz", springs, classes=[cls]).q) is cls
        words = rf"of class {__name__}.{cls.__name__}(.|\n)*Fix: classes=\[{cls.__name__}\]"
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(tmp_path / f"{name}.npz")
    another = namedtuple("Pair", ["x", "z"])
    with pytest.raises(ValueError, match="class Pair has no field y"):
        lj.load_trajectory(tmp_path / "pair.npz", classes=[another])
    with pytest.raises(TypeError, match=r"classes holds \(1, 2\), which is not the class of a named tuple"):
        lj.load_trajectory(tmp_path / "pair.npz", classes=[(1, 2)])


def test_files_that_are_not_whole(tmp_path):
    """Files that are missing, cut off, changed, of another kind or a newer version are refused with the reason."""
    path, traj = tmp_path / "x.npz", lj.integrate(springs, {"x": 1.0}, {"x": 0.0}, ts=TS)
    traj.save(path)
    whole = path.read_bytes()
    place = whole.index(np.asarray(traj.q["x"]).tobytes())
    changed = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
    for content, words in (
        (changed, "is damaged: Bad CRC-32"),
        (whole[: len(whole) // 2], "is damaged: its end is missing"),
        (b"", "is not a trajectory saved by lagjax"),
        (b"t,x\n0,1\n", "is not a trajectory saved by lagjax"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path)
    np.savez(path, x=np.ones(3))
    with pytest.raises(ValueError, match="is not a trajectory saved by lagjax"):
        lj.load_trajectory(path)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        lj.load_trajectory(tmp_path / "other.npz")
    for header, words in (
        ({"format": npz.FORMAT + 1, "versions": {"lagjax": "9.0"}}, "written by lagjax 9.0, .*\nFix: pip install -U"),
        ({"format": npz.FORMAT, "kind": "fit"}, r"holds a fit, not a trajectory.\nFix: lj.load_fit\(path\)"),
        ({"format": npz.FORMAT, "kind": "trajectory", "trajectory": {}}, "is damaged: its description is incomplete"),
    ):
        with zipfile.ZipFile(path, "w") as entries:
            entries.writestr(npz.HEADER, json.dumps(header))
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path)
    path.write_bytes(whole)
    assert lj.load_trajectory(path, springs).q["x"][0] == 1.0


def test_a_failure_leaves_the_file_of_before(tmp_path, monkeypatch):
    """If writing fails, the new file leaves nothing and the old one is intact; folders that do not exist are named."""
    path, traj = tmp_path / "x.npz", lj.integrate(springs, {"x": 1.0}, {"x": 0.0}, ts=TS)
    traj.save(path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array", full)
        with pytest.raises(OSError, match="No space left"):
            traj.save(path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["x.npz"]
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        traj.save(tmp_path / "none" / "x.npz")
    with pytest.raises(IsADirectoryError, match="is a folder"):
        traj.save(tmp_path)


KILLED = """
import os, signal, sys
import numpy as np
from lagjax.files import npz as files
write_array = np.lib.format.write_array
def killed(entry, x, **kwargs):
    write_array(entry, x, **kwargs)
    if x.size > 1:
        os.kill(os.getpid(), signal.SIGKILL)
np.lib.format.write_array = killed
files.write(sys.argv[1], "trajectory", {}, {"a": np.zeros(1), "b": np.zeros(1000), "c": np.zeros(1000)})
"""


@pytest.mark.slow
def test_a_killed_process_leaves_the_file_of_before(tmp_path):
    """A process killed while writing leaves the previous file, and the next write succeeds."""
    path, traj = tmp_path / "x.npz", lj.integrate(springs, {"x": 1.0}, {"x": 0.0}, ts=TS)
    traj.save(path)
    before = path.read_bytes()
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)]).returncode == -9
    assert path.read_bytes() == before and len(os.listdir(tmp_path)) == 2
    traj.save(path)
    assert lj.load_trajectory(path, springs).q["x"][0] == 1.0


@pytest.mark.slow
def test_float64_where_jax_works_in_float32(tmp_path):
    """It is refused, rather than silently losing half of the digits."""
    lj.integrate(springs, 1.0, 0.0, ts=TS).save(tmp_path / "x.npz")
    with jax.enable_x64(False), pytest.raises(ValueError, match="holds float64 arrays, and JAX works in 32 bits"):
        lj.load_trajectory(tmp_path / "x.npz")
