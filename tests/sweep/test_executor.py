"""Sweeps on executors: the same as in one process, whoever dies, joins or is refused."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display.terminal import Silent
from lagjax.sweep import executor
from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store

AXES = {"k": np.arange(1.0, 6.0), "x": np.linspace(0.1, 1.0, 64)}
LONG = {"k": np.arange(1.0, 9.0), "x": np.linspace(0.1, 1.0, 500)}
ROOT = Path(lj.__file__).parents[1]


def quick(point):
    """A few numbers in closed form; NaN at the last k."""
    return {"y": jnp.sqrt(4.5 - point["k"]) * point["x"], "n": (10 * point["k"]).astype(int)}


def slow(point):
    """Some milliseconds of work."""
    return jax.lax.fori_loop(0, 50_000, lambda i, x: jnp.sin(x) + point["k"], point["x"])


def rest(x):
    """Wait as long as the environment of a process says, which takes the same time on a busy machine."""
    time.sleep(float(os.environ.get("REST", 0)))
    return np.asarray(x)


def rested(point):
    """A sine, and a rest for each chunk."""
    shape = jax.ShapeDtypeStruct((), point["x"].dtype)
    return jnp.sin(point["k"] * jax.pure_callback(rest, shape, point["x"], vmap_method="broadcast_all"))


def quiet(run, axes=AXES, **settings):
    """A sweep in chunks of 16, without a progress bar."""
    return lj.sweep(run, axes, **{"chunk": 16, "progress": False} | settings)


def same(found, whole):
    """Check that two sweeps are the same, bit for bit."""
    jax.tree.map(np.testing.assert_array_equal, found.values, whole.values)
    np.testing.assert_array_equal(found.status.result, whole.status.result)


@pytest.fixture
def threads():
    """A pool of two threads."""
    with ThreadPoolExecutor(2) as pool:
        yield pool


def test_the_same_as_in_one_process(threads):
    """In memory and in a store, with points that fail; what is done is not done again, and the rest can be."""
    whole = quiet(quick)
    # Not a function of a module, but one that is sent as it is, with the module that it reads.
    found = quiet(lambda point: quick(point) if lj.__version__ else None, on=threads)
    same(found, whole)
    assert found.ran == 320 and whole.counts() == found.counts() and "ThreadPoolExecutor" in repr(found)
    again = found.resweep(where=found.axes.values["k"][:, None] > 3.0)
    assert again.ran == 128
    same(again, whole)
    stored = quiet(quick, on=threads, store="memory://lagjax/threads")
    same(stored, whole)
    assert quiet(quick, on=threads, store="memory://lagjax/threads").ran == 0
    assert quiet(quick, store="memory://lagjax/threads").ran == 0
    assert len(Store(Files("memory://lagjax/threads")).blocks) == 20


def test_interrupted(threads, monkeypatch):
    """Ctrl-C keeps what is finished, and what waits is cancelled. Twin: the same call computes the rest."""

    class Impatient(Silent):
        def update(self, count):
            raise KeyboardInterrupt

    monkeypatch.setattr(import_module("lagjax.sweep.sweep"), "_meter", lambda total, progress: Impatient())
    with pytest.warns(UserWarning, match="interrupted: 16 of 320 points are done and kept"):
        swept = quiet(quick, on=threads)
    monkeypatch.undo()
    assert swept.counts()["not run"] == 304 and swept.resweep().ran == 304


def refused(call):
    """The words of what a call raises."""
    with pytest.raises((TypeError, ValueError)) as told:
        call()
    return str(told.value)


def test_refused_in_words(threads, tmp_path, monkeypatch):
    """What is no executor, forks, cannot be sent, or does not agree. Nothing has run."""
    assert "on must be an executor, with a method submit, not int" in refused(lambda: quiet(quick, on=3))
    forked = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"))
    assert 'get_context("spawn")' in refused(lambda: quiet(quick, on=forked))
    with open(tmp_path / "table", "wb") as file:
        run = lambda point: point["x"] * file.fileno()
        assert "it reads 'file', a BufferedWriter, which cannot" in refused(lambda: quiet(run, on=threads))
    assert "leave devices out" in refused(lambda: quiet(quick, on=threads, devices=jax.local_devices()))
    here = executor.facts()
    for other, words in (
        ({"x64": "off"}, 'works in float32, and this process in float64.\nFix: os.environ["JAX_ENABLE_X64"] = "1"'),
        ({"jax": "0.1"}, f"has jax 0.1, not {jax.__version__}.\nFix: the same environment"),
    ):
        found = iter([here, here | other])
        monkeypatch.setattr(executor, "facts", lambda found=found: next(found))
        assert words in refused(lambda: quiet(quick, on=threads))


def test_without_the_extras(threads, tmp_path, monkeypatch):
    """Without zarr and cloudpickle sweeps in memory run, and all else says what to install."""
    for name in ("zarr", "cloudpickle", "fsspec", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    assert quiet(quick).ran == 320
    for settings, extra in (
        ({"store": tmp_path / "store"}, r'stores need zarr(.|\n)*pip install "lagjax\[data\]"'),
        ({"store": "s3://bucket/store"}, "s3://bucket/store needs fsspec(.|\n)*pip install fsspec"),
        ({"on": threads}, r'on= needs cloudpickle(.|\n)*pip install "lagjax\[cluster\]"'),
    ):
        with pytest.raises(ImportError, match=extra):
            quiet(quick, **settings)
    assert not list(tmp_path.iterdir())


class Lost(ThreadPoolExecutor):
    """An executor that loses one of its tasks in a way."""

    def __init__(self, error, which=5):
        super().__init__(1)
        self.error, self.count, self.which = error, 0, which

    def submit(self, function, *args):
        self.count += 1
        return super().submit(self.fail if self.count == self.which else function, *args)

    def fail(self, *args):
        raise self.error


class KilledWorker(Exception):
    """As that of Dask's."""


def test_what_is_lost_is_named():
    """A task that kills its workers is named with its points, and the rest is kept; a pool that breaks ends it."""
    with (
        Lost(KilledWorker()) as pool,
        pytest.warns(UserWarning, match="(?s)16 points are not computed.*k = 1, x = 0.7"),
    ):
        swept = quiet(quick, on=pool)
    assert swept.ran == 304 and swept.counts()["not run"] == 16
    with Lost(KilledWorker(), 2) as pool, pytest.warns(UserWarning, match="16 points are not computed"):
        with pytest.raises(executor.Stopped, match="each worker process that computed its first points died"):
            quiet(quick, on=pool, store="memory://lagjax/dead")
    with Lost(multiprocessing.ProcessError("no")) as pool, pytest.raises(multiprocessing.ProcessError):
        quiet(quick, on=pool)
    from concurrent.futures.process import BrokenProcessPool

    with Lost(BrokenProcessPool("gone")) as pool, pytest.warns(UserWarning, match="stopped: a worker process died"):
        swept = quiet(quick, on=pool)
    assert 0 < swept.ran < 320


@pytest.mark.slow
def test_a_pool_of_processes(monkeypatch, tmp_path):
    """New processes compute the same, also those of loky; a store that they cannot see is refused."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    whole = quiet(slow)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        same(quiet(slow, on=pool), whole)
        stored = quiet(slow, on=pool, store=tmp_path / "store")
        same(stored, whole)
        assert stored.ran == 320 and "worker process" in stored.how
        with pytest.warns(UserWarning, match="stopped: .* does not find the store memory://(.|\n)*Fix: store="):
            assert quiet(slow, on=pool, store="memory://lagjax/elsewhere").ran == 0
    loky = pytest.importorskip("loky")
    with loky.ProcessPoolExecutor(2) as pool:
        same(quiet(slow, on=pool), whole)


@pytest.fixture(scope="module")
def whole():
    """A sweep of four thousand points in one process."""
    return quiet(rested, LONG)


@pytest.fixture
def cluster(monkeypatch):
    """Dask's scheduler with three workers."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    # As long as a new worker needs to start: of 250 chunks, a third each.
    monkeypatch.setenv("REST", "0.1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        settings = {"distributed.scheduler.allowed-failures": 2, "logging.distributed": "critical"}
        with dask.config.set(settings), distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, dashboard_address=None, silence_logs=50
        ) as cluster:  # fmt: skip
            yield cluster


@pytest.mark.slow
@pytest.mark.parametrize("in_store", [False, True])
def test_workers_come_and_go(cluster, tmp_path, in_store, whole):
    """One of three is killed in the middle, and one joins: the results are those of one process, bit for bit."""
    from distributed import Client

    store = tmp_path / "store" if in_store else None

    class Eventful(Silent):
        done = 0

        def update(self, count):
            before, self.done = self.done, self.done + count
            if before < 500 <= self.done:
                pids: Any = client.run(os.getpid)
                os.kill(next(iter(pids.values())), signal.SIGKILL)
            if before < 800 <= self.done:
                cluster.scale(4)

    with Client(cluster) as client, pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("lagjax.sweep.sweep"), "_meter", lambda total, progress: Eventful())
        patch.delenv("REST")
        swept = quiet(rested, LONG, on=client, store=store)
        # Three, and the one that takes the place of the dead, or the one that joined, or both.
        assert swept.ran == 4000 and int(swept.how.split()[0]) >= 4
        assert "rested over k, x" in cluster.scheduler.task_prefixes
        same(swept, whole)


def deadly(point):
    """The process that computes x > 0.95 of the last k ends."""

    def kill(k, x):
        if k > 4.5 and x > 0.95:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.asarray(x)

    shape = jax.ShapeDtypeStruct((), point["x"].dtype)
    return slow(point) + 0.0 * jax.pure_callback(kill, shape, point["k"], point["x"], vmap_method="sequential")


@pytest.mark.slow
def test_a_task_that_kills_workers(cluster):
    """After three of them it is named with its points, and the rest of the sweep is kept."""
    from distributed import Client

    with Client(cluster) as client, pytest.warns(UserWarning, match="(?s)not computed.*k = 5, x = .* to  k = 5, x = 1"):
        swept = quiet(deadly, on=client)
    left = swept.status.result < 0
    assert left[-1, -1] and left.sum() <= 64
    np.testing.assert_array_equal(swept.values[~left], quiet(slow).values[~left])


def in_single_precision():
    """Switch a process to float32."""
    jax.config.update("jax_enable_x64", False)


@pytest.mark.slow
def test_workers_that_cannot(cluster, tmp_path, monkeypatch):
    """Without the user's module, or without float64, they are refused in words before anything runs."""
    from distributed import Client

    (tmp_path / "my_model.py").write_text('def run(point):\n    return point["x"] ** 2\n')
    monkeypatch.syspath_prepend(tmp_path)
    run = import_module("my_model").run
    with Client(cluster) as client:
        assert "cannot import what run needs: No module named 'my_model'" in refused(lambda: quiet(run, on=client))
        client.run(in_single_precision)
        assert "works in float32, and this process in float64" in refused(lambda: quiet(quick, on=client))


def started(folder, what, *options):
    """A process of Dask's command line."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", str(folder / "at.json")]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_ENABLE_X64": "1", "REST": "0.05"}
    return subprocess.Popen([*command, *options], env=environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def marked(store):
    """The blocks of a store that are finished, and when they were."""
    files = (store / "lagjax/marks/c").rglob("0")
    return {file.parent.parent.name: file.stat().st_mtime_ns for file in files if file.is_file()}


@pytest.mark.slow
def test_the_scheduler_is_killed(tmp_path, whole):
    """The same call on another one continues: no block that was finished is computed again."""
    distributed = pytest.importorskip("distributed")
    store, before, swept = tmp_path / "store", {}, None

    def end(scheduler):
        while not (store / "lagjax/marks/c").exists() or len(marked(store)) < 20:
            time.sleep(0.05)
        scheduler.kill()

    for turn in range(2):
        folder = tmp_path / str(turn)
        folder.mkdir()
        scheduler = started(folder, "scheduler", "--port", "0", "--no-dashboard")
        workers = [
            started(folder, "worker", "--nthreads", "1", "--no-dashboard", "--death-timeout", "60") for _ in range(2)
        ]
        try:
            with distributed.Client(scheduler_file=str(folder / "at.json"), timeout=60) as client:
                client.wait_for_workers(2, timeout=60)
                if turn == 0:
                    threading.Thread(target=end, args=(scheduler,)).start()
                    with pytest.warns(
                        UserWarning, match="stopped: .*points are done and kept; the same call continues"
                    ):
                        quiet(rested, LONG, on=client, store=store)
                else:
                    swept = quiet(rested, LONG, on=client, store=store)
        finally:
            for process in (*workers, scheduler):
                process.kill()
                process.wait()
        if turn == 0:
            before = marked(store)
    assert swept is not None and 0 < swept.ran < 4000 and len(before) >= 20
    assert before.items() <= marked(store).items()
    same(swept, whole)


MPI = """
import numpy as np
from mpi4py.futures import MPIPoolExecutor
import lagjax as lj
from tests.sweep.test_executor import AXES, quiet, same, slow

if __name__ == "__main__":
    with MPIPoolExecutor() as pool:
        found = quiet(slow, on=pool)
    same(found, quiet(slow))
    print(found.how)
"""


@pytest.mark.slow
def test_mpi(tmp_path):
    """Two workers of MPI compute the same."""
    pytest.importorskip("mpi4py")
    start = shutil.which("mpiexec") or pytest.skip("no MPI is installed")
    (tmp_path / "script.py").write_text(MPI)
    environment = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [start, "-n", "3", sys.executable, "-m", "mpi4py.futures", "script.py"]
    told = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert told.returncode == 0, told.stderr
    assert "worker processes of mpi4py" in told.stdout
