"""Sweeps on disk: resumed, refused, killed, shared."""

import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import lagjax as lj
from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store
from tests.sweep import worker

POINTS = 2000


def swept(run, store=None, **settings):
    """The worker's sweep, or a quicker one, in this process."""
    return lj.sweep(run, worker.axes(POINTS), store=store, chunk=32, workers=1, progress=False, **settings)


def same(found, whole):
    """Check equality bit for bit: a resumed sweep runs the same program."""
    np.testing.assert_array_equal(found.values, whole.values)
    np.testing.assert_array_equal(found.status.result, whole.status.result)


def started(store, k=0, n=1, *port):
    """Start a worker process."""
    root = Path(lj.__file__).parents[1]
    # What the first process compiles the others read.
    environment = os.environ | {"PYTHONPATH": str(root), "JAX_COMPILATION_CACHE_DIR": str(store.parent / "compiled")}
    command = [sys.executable, worker.__file__, str(store), str(k), str(n), str(POINTS), *map(str, port)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def test_written_resumed_and_read(tmp_path):
    """A second call computes nothing; the store opens without the function that ran it."""
    path, whole = tmp_path / "sweep", swept(worker.quick)
    first = swept(worker.quick, path)
    assert first.ran == POINTS
    same(first, whole)
    second = swept(worker.quick, path)
    assert second.ran == 0
    same(second, whole)
    alone = lj.open_sweep(path)
    assert alone.dims == whole.dims and alone.counts() == whole.counts()
    np.testing.assert_array_equal(alone.values, whole.values)
    assert alone.to_xarray()["value"].dims == ("g", "angle")
    with pytest.raises(ValueError, match="does not know the function that ran it"):
        alone.resweep(where=True)


def whole_life(url):
    """A store at a URL: begun, read by xarray, continued, damaged, read, mended."""
    import fsspec
    import xarray

    axes = {"k": np.arange(1.0, 4.0), "x": np.linspace(0.1, 1.0, 8)}
    call = lambda: lj.sweep(lambda p: p["k"] * p["x"], axes, store=url, chunk=8, workers=1, progress=False)
    exact = axes["k"][:, None] * axes["x"]
    first, fs = call(), fsspec.core.url_to_fs(url)[0]
    assert first.ran == 24 and call().ran == 0 and str(url) in repr(first)
    for found in (first.values, lj.open_sweep(url).values, xarray.open_zarr(url)["value"].values):
        np.testing.assert_array_equal(found, exact)
    fs.rm(f"{url}/lagjax/marks/c/2/0/0")
    fs.pipe_file(f"{url}/value/c/1/0", fs.cat_file(f"{url}/value/c/0/0"))
    with pytest.warns(UserWarning, match="value/c/1/0 is not as it was written"):
        opened = lj.open_sweep(url)
        np.testing.assert_array_equal(np.isfinite(opened.values), [[True] * 8, [False] * 8, [False] * 8])
    assert opened.counts() == {"successful": 8, "lost from the store": 8, "not run": 8}
    with pytest.warns(UserWarning, match="computed again: 1 of 3"):
        mended = call()
    assert mended.ran == 16
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(mended)).values, exact)


def test_anywhere():
    """A store may be at any URL that fsspec opens; another is refused in words."""
    whole_life("memory://lagjax/swept")
    with pytest.raises(ValueError, match="(?s)nowhere://x cannot be opened.*Fix: a path, or a URL of fsspec"):
        lj.open_sweep("nowhere://x")


@pytest.mark.slow
def test_in_a_bucket(monkeypatch):
    """The same in an object store that speaks the protocol of Amazon's S3."""
    moto, s3fs = pytest.importorskip("moto.server"), pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "ACCESS_KEY_ID": "x",
        "SECRET_ACCESS_KEY": "x",
        "ENDPOINT_URL": f"http://{host}:{port}",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    try:
        s3fs.S3FileSystem().mkdir("lagjax")
        whole_life("s3://lagjax/swept")
    finally:
        server.stop()


@pytest.mark.slow
def test_with_networks(tmp_path):
    """A network may stand in a sweep's function, with its weights as a part of what identifies the store, or weights be
    an axis; a module with its functions is no result."""
    nets = [lj.learned.Network(1.0, key=jax.random.key(k), width=4, depth=1, first=1.0) for k in (0, 1, 0)]

    def force(m, net):
        return -m * jax.grad(net)(1.0)

    def stored(net, of=lambda force, net: force):
        axes, store = {"m": np.linspace(1.0, 2.0, 3)}, tmp_path / "store"
        return lj.sweep(lambda point: of(force(point["m"], net), net), axes, store=store, progress=False)

    first, expected = stored(nets[0]), [force(m, nets[0]) for m in (1.0, 1.5, 2.0)]
    np.testing.assert_allclose(first.values, expected, rtol=1e-12)
    np.testing.assert_array_equal(stored(nets[2]).values, first.values)
    with pytest.raises(ValueError, match="run is another function"):
        stored(nets[1])
    with pytest.raises(TypeError, match=r"Fix: return a module without its functions, eqx.filter\(net, eqx.is_array\)"):
        stored(nets[0], of=lambda force, net: net)
    arrays, rest = eqx.partition(nets[0], eqx.is_array)
    _, module_of = ravel_pytree(arrays)
    weights = np.stack([ravel_pytree(eqx.filter(net, eqx.is_array))[0] for net in nets[:2]])
    run = lambda point: force(1.0, eqx.combine(module_of(point["weights"]), rest))
    several = lj.sweep(run, {"weights": weights}, store=tmp_path / "several", progress=False)
    np.testing.assert_allclose(several.values, [force(1.0, net) for net in nets[:2]], rtol=1e-12)


def test_another_sweep_is_refused(tmp_path):
    """Other values, another function, other settings: each is named, and the store stays unchanged."""
    path, axes = tmp_path / "sweep", {"x": jnp.arange(6.0)}
    run = lambda scale: lambda point: scale * point["x"]
    lj.sweep(run(2.0), axes, store=path, chunk=2, progress=False)
    cases = [
        (run(3.0), axes, {}, "run is another function"),
        (run(2.0), {"x": jnp.arange(6.0) + 1}, {}, "axis 'x' has other values"),
        (run(2.0), {"x": jnp.arange(7.0)}, {}, "points: x: 6 there, x: 7 here"),
        (run(2.0), axes, {"chunk": 3}, "chunk: 2 there, 3 here"),
        (lambda point: (2.0 * point["x"], 1.0), axes, {}, "values 0: None there"),
    ]
    for other, over, settings, words in cases:
        with pytest.raises(ValueError, match="belongs to another sweep") as refusal:
            lj.sweep(other, over, store=path, progress=False, **settings)
        assert words in str(refusal.value)
    assert lj.sweep(run(2.0), axes, store=path, progress=False).ran == 0
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="is not the store of a sweep"):
        lj.sweep(run(2.0), axes, store=tmp_path / "other", progress=False)


def points_there(path):
    """The number of points in the marked blocks."""
    store = Store(Files(path))
    there = set(range(len(store.blocks))) - set(store.missing().tolist())
    return sum(len(np.r_[store.blocks.points(number)]) for number in there)


def kill_when(process, path, count):
    """`kill -9` once `count` blocks are marked."""
    deadline = time.monotonic() + 120
    while (
        not (path / "lagjax" / "zarr.json").exists()
        or len(Store(Files(path)).blocks) - len(Store(Files(path)).missing()) < count
    ):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()


@pytest.mark.optimised
@pytest.mark.slow
def test_killed_and_resumed(tmp_path):
    """At any moment only the block in progress is lost, and nothing is corrupted."""
    path = tmp_path / "sweep"
    kill_when(started(path), path, 1)
    kill_when(started(path), path, 2)
    there = points_there(path)
    rest = started(path)
    computed = int(rest.communicate()[0])
    assert 0 < computed <= POINTS - there
    same(swept(worker.run, path), swept(worker.run))


@pytest.mark.exhaustive
def test_two_processes_by_jax_distributed(tmp_path):
    """On loopback: each process finds its part, and together they compute all points."""
    path = tmp_path / "sweep"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [started(path, k, 2, port) for k in range(2)]
    computed = [int(process.communicate(timeout=300)[0]) for process in processes]
    assert sum(computed) == POINTS and min(computed) > 0
    same(swept(worker.run, path), swept(worker.run))
