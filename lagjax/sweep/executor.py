"""A sweep on an engine that people already run: its points as tasks for any executor, and what a worker does with them.

An executor is what has `submit(function, *arguments)` and gives futures (PEP 3148): of Dask, MPI, loky, executorlib, or
a pool of processes. `Remote` stands in the place of an `Engine`: it traces `run`, for what it returns and for what
identifies it, and compiles nothing. A task is some chunks of points, a few seconds of work; a worker process compiles
once for all tasks of a sweep. Arrays come back; with a store they go from the worker into it, and the numbers of the
blocks come back.

`run` travels by cloudpickle with all that it reads: functions of modules by name, so that workers need these modules;
those of a notebook or a script as they are.
"""

import concurrent.futures
import importlib
import inspect
import io
import itertools
import os
import platform
import queue
import socket
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.display import waiting
from lagjax.sweep.axes import Axes
from lagjax.sweep.engine import STEPS_TOGETHER, Engine, Status, not_run, program_for
from lagjax.sweep.metadata import DESCRIPTION, description_at, versions
from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store

NEEDS_CLOUDPICKLE = 'on= needs cloudpickle, an optional extra.\nFix: pip install "lagjax[cluster]".'
# A task takes about so long; there are at least so many, so that no worker waits long for the last, and, of a sweep of
# days, at most so many: each costs a scheduler a millisecond.
TASK_SECONDS, FEWEST_TASKS, MOST_TASKS = 2.0, 64, 10_000
# The sweeps that a worker process keeps compiled.
KEPT = 4
# How many tasks that were lost a message names.
SHOWN = 5


class Refused(RuntimeError):
    """What a worker process raises that cannot do a sweep, with the reason in words."""


class Stopped(Exception):
    """What ends a sweep before its end, with the reason in words; what is done is kept."""


class Job(NamedTuple):
    """A sweep for other processes: an `identity` of its own, what is sent, and in what a worker must agree."""

    identity: str
    data: bytes
    facts: dict[str, str]


class Done(NamedTuple):
    """What a task gives back.

    `points` and `seconds` of its work, without `compiling`; `worker` (host, process); `leaves` of values and status, or
    None where they are in a store.
    """

    points: int
    seconds: float
    compiling: float
    worker: tuple[str, int]
    leaves: list[np.ndarray] | None


class Named:
    """A function under another name, which Dask shows on its dashboard."""

    def __init__(self, name: str, function: Callable):
        self.__name__, self._function = name, function

    def __call__(self, *args: Any):
        return self._function(*args)


def facts() -> dict[str, str]:
    """What processes that share a sweep must agree in."""
    python = ".".join(platform.python_version_tuple()[:2])
    x64 = "on" if jax.config.read("jax_enable_x64") else "off"
    return {"python": python, **versions(), "x64": x64}


class Opened(NamedTuple):
    """A sweep in a worker process: its engine, and the stores that it writes to, by place and digest."""

    engine: Engine
    stores: dict[tuple[str, str], Store]


_OPENED: dict[str, Opened] = {}
_OPENING = threading.Lock()


def problem(job: Job) -> str:
    """Why this process cannot do a sweep, in words; "" if it can."""
    here, who = facts(), f"the worker process {os.getpid()} on {socket.gethostname()}"
    others = [f"{name} {here[name]}, not {x}" for name, x in job.facts.items() if here[name] != x]
    if others == ["x64 off, not on"]:
        return (
            f"{who} works in float32, and this process in float64.\n"
            'Fix: os.environ["JAX_ENABLE_X64"] = "1" before the workers are started, or that line in their environment.'
        )
    if others:
        return f"{who} has {', '.join(others)}.\nFix: the same environment for the workers as here."
    try:
        _unpickled(job)
    except ImportError as error:
        module = getattr(error, "name", None) or "the_module"
        return (
            f"{who} cannot import what run needs: {error}.\n"
            f"Fix: install {module} for the workers, or put its folder on their PYTHONPATH; or send it along: import "
            f"cloudpickle, {module}; cloudpickle.register_pickle_by_value({module})."
        )
    except Exception as error:
        return f"{who} cannot read what run is: {type(error).__name__}: {error}.\nFix: the same environment as here."
    return ""


def _unpickled(job: Job):
    cloudpickle = _cloudpickle()
    return cloudpickle.loads(job.data)


def _opened(job: Job) -> tuple[Opened, float]:
    """The sweep in this process, and the seconds that it took to compile it, 0 if that was done before."""
    with _OPENING:
        if job.identity in _OPENED:
            return _OPENED[job.identity], 0.0
        if wrong := problem(job):
            raise Refused(wrong)
        started = time.perf_counter()
        run, axes, *settings = _unpickled(job)
        engine = Engine(run, axes, *settings, jax.local_devices(), False)
        while len(_OPENED) >= KEPT:
            _OPENED.pop(next(iter(_OPENED)))
        _OPENED[job.identity] = Opened(engine, {})
        return _OPENED[job.identity], time.perf_counter() - started


def compute(job: Job, indices: np.ndarray | tuple[int, int]) -> Done:
    """Compute some points of a sweep, in a worker process; two numbers are the first index and that after the last."""
    opened, compiling = _opened(job)
    indices = np.arange(*indices) if isinstance(indices, tuple) else indices
    started = time.perf_counter()
    leaves = jax.tree.leaves(_results(opened.engine, indices))
    return Done(len(indices), time.perf_counter() - started, compiling, _worker(), leaves)


def fill(job: Job, place: str, digest: str, numbers: list[int]) -> Done:
    """Compute some blocks of a sweep, in a worker process, and write them to its store."""
    opened, compiling = _opened(job)
    with _OPENING:
        if (place, digest) not in opened.stores:
            opened.stores[place, digest] = _store(place, digest)
        store = opened.stores[place, digest]
    started, start = time.perf_counter(), 0
    points = [store.blocks.points(number) for number in numbers]
    results = _results(opened.engine, np.concatenate([np.arange(x.start, x.stop) for x in points]))
    for number, here in zip(numbers, points):
        end = start + here.stop - here.start
        store.write(number, *jax.tree.map(lambda x, start=start, end=end: x[start:end], results))
        start = end
    return Done(start, time.perf_counter() - started, compiling, _worker(), None)


def _store(place: str, digest: str):
    files = Files(place)
    try:
        # Only this file is read: a thousand workers would list all files a thousand times.
        about, _ = description_at(files, {DESCRIPTION: 0})
        if about["digest"] == digest:
            return Store(files, of_own_sweep=True, about=about)
    except (ValueError, OSError):
        pass
    raise Refused(
        f"the worker process {os.getpid()} on {socket.gethostname()} does not find the store {place}.\n"
        "Usual cause: a folder that only one machine has, or one without the rights to write.\n"
        'Fix: store="a folder or URL that all of them reach".'
    )


def _results(engine: Engine, indices: np.ndarray):
    results = not_run(engine.program, len(indices))
    for positions, *found in engine.over(indices):
        for whole, new in zip(jax.tree.leaves(results), jax.tree.leaves(tuple(found))):
            whole[positions] = new
    return results


def _worker():
    return socket.gethostname(), os.getpid()


def _cloudpickle() -> Any:
    try:
        import cloudpickle
    except ImportError as error:
        raise ImportError(NEEDS_CLOUDPICKLE) from error
    return cloudpickle


def _itself(job: Job):
    return job


class Remote:
    """A sweep on an executor; stands in the place of an `Engine`.

    **Raises:** `TypeError` if `on` is no executor, or `run` cannot be sent; `ValueError` if workers cannot do it.
    """

    # Blocks of a new store: at least so many.
    shares = FEWEST_TASKS

    def __init__(
        self,
        on: Any,
        run: Callable,
        axes: Axes,
        chunk: int,
        workers: int,
        sort: bool | None,
        layout: str,
        progress: Any,
    ):
        self._executor = _executor(on)
        self.run, self.axes, self.chunk, self.workers, self.sort, self.layout = run, axes, chunk, workers, sort, layout
        self.devices, self.progress = jax.local_devices(), progress
        patience = STEPS_TOGETHER if layout == "vmap" else None
        # Traced only, for what `run` returns, and for what identifies it.
        self.program, _ = program_for(
            run, axes, chunk, self.devices[:1], layout, patience, robust=False, compiles=False
        )
        job = Job(uuid.uuid4().hex, _pickled(run, (run, axes, chunk, workers, sort, layout)), facts())
        of_run = getattr(run, "__name__", "").strip("<>").replace("lambda", "")
        self._name = f"{of_run or 'sweep'} over {', '.join(axes.names)}"
        self._job: Any = job
        self._refuse(on, job)
        if _is_client(on):
            # A task of its own, which Dask sends to each worker once, and does again where it was lost.
            self._job = on.submit(_itself, job, pure=False, key=f"lagjax-{job.identity}")
        self._engine, self._workers, self._compiling = f"{type(on).__module__}.{type(on).__name__}", set(), 0.0
        # Seconds of one point in one worker, when that is known.
        self._pace = None

    def _refuse(self, on: Any, job: Job):
        """Ask the workers before anything runs: each of them where that can be done, else one."""
        with waiting(self.progress, "asking the workers"):
            if _is_client(on):
                answers = list(on.run(problem, job, on_error="return").values())
            else:
                answers = [_answer(self._executor.submit(problem, job))]
        for answer in filter(None, answers):
            raise ValueError(
                answer
                if isinstance(answer, str)
                else f"the workers cannot be used: {type(answer).__name__}: {answer}.\n"
                "Usual cause: they have no lagjax, or another version.\n"
                "Fix: the same environment for the workers as here."
            )

    @property
    def words(self) -> str:
        """A description of how the points are computed."""
        hosts = len({host for host, _ in self._workers})
        on_hosts = f" on {hosts} hosts" if hosts > 1 else ""
        of_workers = f"{len(self._workers)} worker process{'es' * (len(self._workers) != 1)}{on_hosts}"
        return f"{of_workers} of {self._engine}, lanes {self.layout}, chunks of {self.chunk}"

    def seconds_since(self, started: float) -> tuple[float, float]:
        """The seconds in which the first worker compiled, and the others since `started`."""
        compiling, self._compiling = self._compiling, 0.0
        return compiling, max(time.perf_counter() - started - compiling, 1e-9)

    def timed(self, indices: np.ndarray) -> tuple[float, PyTree, Status]:
        """(seconds of computing, values, status) at no more than `chunk` indices, by one worker."""
        with waiting(self.progress, "a worker compiles"):
            found = [done for _, done in self._done([(compute, (_short(indices),), indices)], indices)]
        if not found:
            raise Stopped("each worker process that computed its first points died")
        return found[0].seconds, *self._values(found[0])

    def first(self, indices: np.ndarray) -> tuple[PyTree, Status]:
        """(values, status) at no more than `chunk` indices."""
        return self.timed(indices)[1:]

    def over(self, indices: np.ndarray) -> Iterator[tuple[np.ndarray, PyTree, Status]]:
        """Yield (positions among the indices, values, status) of tasks as they are finished, in any order."""

        def tasks():
            start, each = 0, None
            while start < len(indices):
                # Of one chunk each until it is known how long a point takes (`_done`).
                each = self.points_of_task(len(indices) - start) if self._pace is not None and each is None else each
                piece = np.arange(start, min(start + (each or self.chunk), len(indices)))
                start += len(piece)
                yield compute, (_short(indices[piece]),), piece

        for positions, done in self._done(tasks(), indices):
            yield positions, *self._values(done)

    def points_of_task(self, count: int) -> int:
        """How many of `count` points make a task: whole chunks; one where it is not known how long they take."""
        if self._pace is None:
            return self.chunk
        pace = max(self._pace, 1e-9)
        seconds = max(min(TASK_SECONDS, pace * count / FEWEST_TASKS), pace * count / MOST_TASKS)
        return max(1, round(seconds / pace / self.chunk)) * self.chunk

    def fill(self, store: Store, groups: Iterable[list[int]]) -> Iterator[int]:
        """Have blocks computed and written by the workers; yield the points of each group that is."""
        place = store.place if isinstance(store.place, str) else os.path.abspath(store.place)
        tasks = ((fill, (place, store.about["digest"], numbers), numbers) for numbers in groups)
        for numbers, _ in self._done(tasks, store):
            yield store.blocks.size(numbers)

    def _values(self, done: Done):
        like = not_run(self.program, 0)
        return jax.tree.unflatten(jax.tree.structure(like), done.leaves)

    def _done(self, tasks: Iterable[tuple[Callable, tuple, Any]], named_by: Any = None) -> Iterator[tuple[Any, Done]]:
        """Yield (what a task is for, what it gave) as they are finished; what waits is cancelled at the end.

        Few are begun before one is finished, which tells how long a point takes.
        """
        futures, finished, lost, tasks = {}, queue.SimpleQueue(), [], iter(tasks)

        def send(most: int | None):
            for function, args, purpose in itertools.islice(tasks, most):
                try:
                    future = self._executor.submit(Named(self._name, function), self._job, *args)
                except RuntimeError as error:
                    raise Stopped(f"the executor takes no more tasks ({error})") from error
                futures[future] = purpose
                future.add_done_callback(finished.put)

        try:
            send(FEWEST_TASKS if self._pace is None else None)
            while futures:
                future = finished.get()
                purpose, error = futures.pop(future), _error(future)
                if error is None:
                    done = future.result()
                    self._workers.add(done.worker)
                    if self._pace is None:
                        self._compiling, self._pace = done.compiling, done.seconds / done.points
                    yield purpose, done
                elif type(error).__name__ == "KilledWorker":
                    lost.append(purpose)
                else:
                    raise error
                send(None)
        finally:
            for future in futures:
                future.cancel()
            if lost:
                self._tell_lost(lost, named_by)

    def _tell_lost(self, lost: list, named_by: Any):
        of_points = [x if not isinstance(named_by, Store) else _points(named_by, x) for x in lost]
        if isinstance(named_by, np.ndarray):
            of_points = [named_by[x] for x in of_points]
        lines = [f"    {self.axes.words(x[0])}  to  {self.axes.words(x[-1])}\n" for x in of_points[:SHOWN]]
        more = f"    and {len(lost) - SHOWN:,} more\n" if len(lost) > SHOWN else ""
        warnings.warn(
            f"{sum(map(len, of_points)):,} points are not computed: each worker process that ran them died:\n"
            f"{''.join(lines)}{more}Usual cause: they need more memory than a worker has.\n"
            "Fix: workers with more memory, or a smaller chunk=; all other points are kept.",
            stacklevel=6,
        )


def _points(store: Store, numbers: list[int]):
    return np.concatenate([np.r_[store.blocks.points(number)] for number in numbers])


def _error(future: Any) -> BaseException | None:
    """Why a task failed, as what the sweep raises; None if it did not."""
    if future.cancelled():
        return Stopped("the executor has cancelled its tasks (its scheduler may be gone)")
    error = future.exception()
    if isinstance(error, concurrent.futures.BrokenExecutor):
        return Stopped(f"a worker process died, and this executor gives its task to no other ({error})")
    if isinstance(error, (concurrent.futures.CancelledError, Refused)):
        return Stopped(str(error) or "the executor has cancelled its tasks (its scheduler may be gone)")
    return error


def _answer(future: Any):
    try:
        return future.result()
    except Exception as error:
        return error


def _is_client(on: Any) -> bool:
    """Whether it is a client of Dask's `distributed`, which makes an executor."""
    return callable(getattr(on, "get_executor", None)) and callable(getattr(on, "run", None))


def _executor(on: Any) -> Any:
    if _is_client(on):
        return on.get_executor(pure=False)
    if not callable(getattr(on, "submit", None)):
        raise TypeError(
            f"on must be an executor, with a method submit, not {type(on).__name__}.\n"
            'Fix: on=distributed.Client(), or on=ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")).'
        )
    context = getattr(on, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "on= is a pool of forked processes, and a fork of a process that has used JAX stands still.\n"
            'Fix: ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")).'
        )
    return on


def _short(indices: np.ndarray):
    """Indices as the first and the one after the last, if they are consecutive."""
    consecutive = len(indices) > 0 and np.array_equal(indices, np.arange(indices[0], indices[0] + len(indices)))
    return (int(indices[0]), int(indices[0]) + len(indices)) if consecutive else indices


def _pickled(run: Callable, what: Any) -> bytes:
    _cloudpickle()
    try:
        return _bytes_of(what)
    except Exception as error:
        culprits = [f"'{name}', a {type(x).__name__}" for name, x in _read_by(run) if not _can_be_sent(x)]
        of = f"it reads {', '.join(culprits)}, which cannot" if culprits else str(error)
        raise TypeError(
            f"run cannot be sent to other processes: {of}.\n"
            "Usual cause: an open file, a lock or a connection that run reads.\n"
            "Fix: read it into an array before the sweep, and use that in run."
        ) from error


def _bytes_of(what: Any) -> bytes:
    cloudpickle, to = _cloudpickle(), io.BytesIO()

    class Pickler(cloudpickle.Pickler):
        def reducer_override(self, obj: Any):
            # `lagjax` itself is a module of a class of lazy_loader's, for which cloudpickle has no rule.
            if isinstance(obj, ModuleType) and type(obj) is not ModuleType:
                return importlib.import_module, (obj.__name__,)
            return super().reducer_override(obj)

    Pickler(to).dump(what)
    return to.getvalue()


def _read_by(run: Callable):
    try:
        found = inspect.getclosurevars(run)
    except TypeError:
        return []
    return [*found.nonlocals.items(), *found.globals.items()]


def _can_be_sent(x: Any) -> bool:
    try:
        _bytes_of(x)
    except Exception:
        return False
    return True
