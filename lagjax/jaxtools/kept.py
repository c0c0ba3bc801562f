"""Compiled programs that outlast their process: found again by what they mean, run without tracing or compiling.

A program belongs to what it computes (`digest.py`), wherever and whenever it was compiled. It takes and gives flat
lists of arrays; what its results are put into is made outside of it, from an outline in the entry. An entry is one file
of `folder.py`: a header in JSON, then XLA's executable. Nothing is pickled.

JAX's public `serialize_executable` pickles, and so do its trees. So this module takes its executable and puts it into
JAX's own call, which is private: `jax.stages.Compiled` with the fields of `_unloaded_executable` of
`jax._src.interpreters.pxla`, and the client's `serialize_executable` and `deserialize_executable`. XLA's executables
call LAPACK at addresses that JAX looks up when it lowers a call: without `initialize_lapack` a process would end. It is
done with the versions of `TRIED` alone; where anything of it is missing or refuses, the program is compiled, as it
would be anyway. A program in whose first run a process ended is not run again (`folder.tried`).

Not kept: programs that call Python while they run (checks, callbacks, progress meters), those that give a warning while
they are traced, those for several devices or in one of JAX's contexts, and those that depend on something which
`digest.py` cannot write.
"""

import atexit
import json
import os
import queue
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import jaxlib.version
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr
from jaxtyping import PyTree

from lagjax.jaxtools import folder
from lagjax.jaxtools.digest import NotKept, digest_of, trace_context
from lagjax.jaxtools.jaxpr import anywhere
from lagjax.jaxtools.outline import NoOutline
from lagjax.jaxtools.tracing import HAPPENED

PRIVATE: Any = None
try:
    from jax._src.interpreters.pxla import UnloadedMeshExecutable
    from jax._src.lax.linalg import initialize_lapack
    from jaxlib._jax import DeviceList

    PRIVATE = UnloadedMeshExecutable, DeviceList, initialize_lapack
except ImportError:
    pass

# The versions of jax and jaxlib with which the tests of this module were run.
TRIED = {"0.10.1", "0.10.2"}
# What a version of JAX without these parts raises, and XLA for an executable that it does not take.
REFUSED = (AttributeError, TypeError, ValueError, KeyError, LookupError, RuntimeError, NotImplementedError)
# What an executable may call: JAX's own LAPACK. Anything else may be there in one process and not in the next.
CALLS, LAPACK = re.compile(r'custom_call_target="([^"]*)"'), re.compile(r"lapack_\w+_ffi")
# How long the end of a process waits for programs that are being written, in seconds.
AT_THE_END = 5.0


# After so many seconds a first answer says why it takes long: after 120, XLA asks users for a bug report.
SLOW = 100.0
WHY_SLOW = """lagjax: a first answer has taken {:.0f} s so far, of JAX, XLA's compiler and its run, and goes on.
If XLA then says "Very slow compile?" and asks for a bug report: it is none.
Usual cause: a Lagrangian or constraints of many terms, written one by one; second derivatives of a motion.
Fix: wait, since the next answer has no such wait; or jax.vmap over terms of one kind.
lj.explain(system, t, q, v, params) says what a first answer costs, docs/waiting-for-the-compiler.md why.
"""


@contextmanager
def explained_if_slow() -> Iterator[None]:
    """Say on the error stream why it takes long what is done in here, if it does."""
    timer = threading.Timer(SLOW, lambda: sys.stderr.write(WHY_SLOW.format(SLOW)))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class Tally(NamedTuple):
    """What the folder did for this process: programs found there, written, and those not kept, by why."""

    found: Counter
    not_kept: Counter


TALLY = Tally(Counter(), Counter())


class Said(NamedTuple):
    """How a program's results are put together without tracing it.

    `parts`: what it means, for `digest_of`; `outline(tree)`: the structure of its results as data; `tree(outline,
    arrays)`: results of that structure, whatever their leaves; `facts(jaxpr)`: what else is kept of it, as JSON.
    """

    parts: Callable[[], Sequence[tuple[Any, bool]]]
    outline: Callable[[PyTree], Any]
    tree: Callable[[Any, list], PyTree]
    facts: Callable[[ClosedJaxpr], dict[str, Any]] = lambda jaxpr: {}


class Ready(NamedTuple):
    """A program for arrays of one kind: `call` of them gives a flat list, whose tree has this `structure`, with kinds
    `outputs`; of `jax.jit` itself these are not known."""

    call: Callable[[list], list]
    structure: Any = None
    outputs: Sequence[ShapedArray] = ()
    facts: Mapping[str, Any] = MappingProxyType({})
    compiled: Any = None


class KeptProgram:
    """`jax.jit` of a function of a list of arrays, whose programs are kept in the user's folder as well.

    `is_ready`: whether it has run.
    """

    def __init__(self, function: Callable[[list], PyTree], said: Said, options: dict | None):
        self._said, self._structure, self.is_ready = said, None, False

        def flat(arrays: list) -> list:
            leaves, self._structure = jtu.tree_flatten(function(arrays))
            return leaves

        self._jit = jax.jit(flat, compiler_options=options)
        self._known: dict[tuple, Ready] = {}

    def __call__(self, arrays: list) -> PyTree:
        signature = _signature(arrays)
        ready = self._known.get(signature)
        if ready is None:
            with explained_if_slow():
                place = self._place(arrays)
                # One of `jax.jit` serves all devices; it is compiled as it is called first.
                ready = Ready(self._jit) if place is None else self._ready_at(place, arrays)
                self._known[signature] = ready
                return self._results(signature, ready, arrays)
        return self._results(signature, ready, arrays)

    def _results(self, signature: tuple, ready: Ready, arrays: list) -> PyTree:
        try:
            found = ready.call(arrays)
        except Unusable:
            self._known[signature] = ready = self._made(self._place(arrays), arrays)
            found = ready.call(arrays)
        except (TypeError, ValueError):
            # On another device.
            if ready.call is self._jit:
                raise
            found = self._jit(arrays)
        self.is_ready = True
        if ready.structure is None:
            # That of `jax.jit` is known once it has traced.
            self._known[signature] = ready = ready._replace(structure=self._structure)
        return jtu.tree_unflatten(ready.structure, found)

    def ready_for(self, arrays: list) -> Ready:
        """The program of arrays, or shapes, of this kind, which is not run yet; its first call may say `Unusable`."""
        place = self._place(arrays)
        return self._made(None, arrays) if place is None else self._ready_at(place, arrays)

    def made_for(self, arrays: list) -> Ready:
        """The program of arrays, or shapes, of this kind, compiled here."""
        return self._made(self._place(arrays), arrays)

    def traced_for(self, arrays: list) -> Ready:
        """What is known of the program of arrays, or shapes, of this kind, without compiling it: it has no call."""
        return self._described(self._jit.trace(arrays))

    def _described(self, traced: Any) -> Ready:
        outputs = [ShapedArray(x.shape, x.dtype, weak_type=x.weak_type) for x in traced.jaxpr.out_avals]
        return Ready(_without_call, self._structure, outputs, self._said.facts(traced.jaxpr))

    def _place(self, arrays: list) -> tuple[Path, str] | None:
        """The folder and the digest of the program; None if it is not kept."""
        where = folder.place()
        try:
            if where.path is None:
                raise NotKept(where.why_not)
            return where.path, digest_of([(kept_here(arrays), False), *self._said.parts()])
        except NotKept as reason:
            TALLY.not_kept[str(reason)] += 1
            return None

    def _ready_at(self, place: tuple[Path, str], arrays: list) -> Ready:
        with folder.tried(*place) as entry:
            found = None if entry is None else self._loaded(place, *entry, arrays)
        return self._made(place, arrays) if found is None else found

    def _made(self, place: tuple[Path, str] | None, arrays: list) -> Ready:
        before = HAPPENED.copy()
        traced = self._jit.trace(arrays)
        compiled = traced.lower().compile()
        made = self._described(traced)._replace(call=compiled, compiled=compiled)
        if HAPPENED != before:
            TALLY.not_kept[f"while it was traced, {' and '.join(HAPPENED - before)}"] += 1
        elif place is not None:
            self._write(place, made, arrays, at_once=_sorts(traced.jaxpr.jaxpr))
        return made

    def _loaded(
        self, place: tuple[Path, str], header: dict[str, Any], program: memoryview, arrays: list
    ) -> Ready | None:
        try:
            structure = jtu.tree_structure(self._said.tree(header["outline"], arrays))
            call, outputs = _call_of(header, bytes(program), arrays)
            if structure.num_leaves != len(outputs):
                return None
            return Ready(_Unproved(place, call), structure, outputs, header["facts"], call)
        except REFUSED as error:
            _refuse(error)
            return None

    def _write(self, place: tuple[Path, str], made: Ready, arrays: list, at_once: bool) -> None:
        """Write the program, in another thread; what is kept of it can be made out `at_once`."""
        parts = _parts_now(made.compiled) if at_once else None

        def write() -> None:
            try:
                outline = outline_of(self._said, made.structure, arrays)
                header, program = parts or _parts_of(made.compiled)
                if folder.write(*place, {"outline": outline, "facts": made.facts, **header}, program):
                    TALLY.found["written"] += 1
            except (NotKept, NoOutline) as reason:
                TALLY.not_kept[str(reason)] += 1
            except REFUSED as error:
                TALLY.not_kept[f"{type(error).__name__}: {str(error)[:200]}"] += 1

        LATER.do(write)


# In its first run such a program of XLA's before jax 0.12 takes a form that cannot be written.
_sorts = anywhere(lambda equation: equation.primitive.name in ("sort", "top_k"))


def _parts_now(call: Any) -> tuple[dict[str, Any], bytes] | None:
    """`_parts_of`, or None where that says why not: it is asked again."""
    try:
        return _parts_of(call)
    except (NotKept, *REFUSED):
        return None


def outline_of(said: Said, structure: Any, arrays: list) -> Any:
    """The outline of results, from which they come back; or `NotKept`."""
    tree = jtu.tree_unflatten(structure, range(structure.num_leaves))
    outline = json.loads(json.dumps(said.outline(tree)))
    if jtu.tree_structure(said.tree(outline, arrays)) != structure:
        raise NotKept("its results are of a structure that has no outline")
    return outline


def _without_call(arrays: list) -> list:
    raise AssertionError("this program was traced only, and is not compiled")


class Unusable(Exception):
    """A program that was kept and cannot be run here."""


class _Unproved:
    """The call of a kept program: what is wrong with it shows when it runs first, and not in the middle of something
    else."""

    def __init__(self, place: tuple[Path, str], call: Callable[[list], list]):
        self._place, self._call, self._proved = place, call, False

    def __call__(self, arrays: list) -> list:
        if self._proved:
            return self._call(arrays)
        try:
            with folder.marked(*self._place):
                results = jax.block_until_ready(self._call(arrays))
        except REFUSED as error:
            _refuse(error)
            raise Unusable from error
        TALLY.found["found"] += 1
        self._proved = True
        return results


def _refuse(error: Exception) -> None:
    TALLY.not_kept[f"it could not be loaded: {type(error).__name__}: {str(error)[:200]}"] += 1


def kind(x: Any) -> tuple:
    """What JAX compiles another program of an array for."""
    return x.shape, x.dtype, getattr(x, "weak_type", False)


def _signature(arrays: list) -> tuple:
    """What JAX compiles another program for, but for devices."""
    context = None if trace_context is None else trace_context()
    return context, *map(kind, arrays)


def kept_here(arrays: list) -> tuple:
    """The kinds of arrays on the one device where programs are kept; or `NotKept`."""
    for name, version in (("jax", jax.__version__), ("jaxlib", jaxlib.version.__version__)):
        if version not in TRIED or PRIVATE is None:
            raise NotKept(f"this was not tried with {name} {version}")
    if jax.default_backend() != "cpu":
        raise NotKept(f"this was not tried on a {jax.default_backend()}")
    first = jax.devices()[:1]
    known = [x for x in arrays if isinstance(x, jax.Array) and not isinstance(x, Tracer)]
    if any(list(x.devices()) != first for x in known):
        raise NotKept("it runs on another device than the first, or on several")
    # Results are as committed to the device as what they are computed from.
    committed = any(getattr(x, "committed", False) for x in known)
    return committed, *map(kind, arrays)


def _parts_of(call: Any) -> tuple[dict[str, Any], bytes]:
    """What is kept of a compiled program of JAX's: a header, and XLA's executable; or `NotKept`."""
    parts: Any = call._executable._unloaded_executable
    if parts.host_callbacks or parts.keepalive or parts.unordered_effects or parts.ordered_effects:
        raise NotKept("it calls Python while it runs, as for a check or a callback")
    if parts.mut or call._params.const_args or len(parts.device_list) != 1:
        raise NotKept("it is more than a function of its arguments")
    calls = {name for module in parts.xla_executable.hlo_modules() for name in CALLS.findall(module.to_string())}
    if others := sorted(name for name in calls if not LAPACK.fullmatch(name)):
        raise NotKept(f"it calls {others[0]}")
    program = parts.backend.serialize_executable(parts.xla_executable)
    header = {
        "name": parts.name,
        "committed": bool(parts.committed),
        "lapack": bool(calls),
        "reads": sorted(parts.kept_var_idx),
        "outputs": [as_data(x) for x in parts.output_avals],
    }
    return header, program


def as_data(x: Any) -> list:
    """The kind of a result, as JSON has it; or `NotKept`."""
    if jnp.issubdtype(x.dtype, jax.dtypes.extended) or x != ShapedArray(x.shape, x.dtype, weak_type=x.weak_type):
        raise NotKept(f"it gives a {x}")
    return [list(x.shape), x.dtype.name, bool(x.weak_type)]


def kinds_from(said: Iterable) -> list[ShapedArray]:
    """The kinds of results that `as_data` says."""
    return [ShapedArray(tuple(shape), jnp.dtype(name), weak_type=weak) for shape, name, weak in said]


def _call_of(header: dict[str, Any], program: bytes, arrays: list) -> tuple[Any, list[ShapedArray]]:
    """JAX's own call of a kept program, and the kinds of its results."""
    device = jax.devices()[0]
    client: Any = device.client
    unloaded, list_of, find_lapack = PRIVATE
    devices = list_of((device,))
    sharding = jax.sharding.SingleDeviceSharding(device)
    given = [ShapedArray(arrays[i].shape, jnp.dtype(arrays[i].dtype)) for i in header["reads"]]
    results = kinds_from(header["outputs"])
    if header["lapack"]:
        find_lapack()
    parts = unloaded(
        xla_executable=client.deserialize_executable(program, executable_devices=devices),
        device_list=devices,
        backend=client,
        input_avals=given,
        input_shardings=[sharding for _ in given],
        output_avals=results,
        output_shardings=[sharding for _ in results],
        committed=header["committed"],
        name=header["name"],
        unordered_effects=[],
        ordered_effects=[],
        keepalive=[],
        host_callbacks=[],
        kept_var_idx=set(header["reads"]),
        mut=None,
        xla_in_layouts=[None for _ in given],
        dispatch_in_layouts=[None for _ in given],
        xla_out_layouts=[None for _ in results],
        all_args_info=None,
        pgle_profiler=None,
    )
    taken = (([jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays],), {})
    return jax.stages.Compiled(parts.load(), [], taken, jtu.tree_structure([0 for _ in results])), results


class Later:
    """Does things in another thread, in order; the end of the process waits for them, though not long."""

    def __init__(self):
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._left, self._changed, self._thread = 0, threading.Condition(), None

    def do(self, job: Callable[[], None]) -> None:
        """Do this soon."""
        with self._changed:
            self._left += 1
            if self._thread is None or not self._thread.is_alive():
                # After a fork there is no thread any more.
                self._thread = threading.Thread(target=self._work, name="lagjax writes programs", daemon=True)
                self._thread.start()
        self._todo.put(job)

    def _work(self) -> None:
        while True:
            job = self._todo.get()
            try:
                job()
            finally:
                with self._changed:
                    self._left -= 1
                    self._changed.notify_all()

    def wait(self, seconds: float = AT_THE_END) -> bool:
        """Wait until all is done; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._left == 0, seconds)


LATER = Later()
atexit.register(LATER.wait)
if hasattr(os, "register_at_fork"):
    # A forked process has neither the thread nor what it was about to do.
    os.register_at_fork(after_in_child=LATER.__init__)
