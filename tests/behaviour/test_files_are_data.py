"""Files and stores are data: a changed one is read right or refused in words, and runs, imports, writes, takes nothing.

Whoever wrote a file may have chosen each of its bytes. `tests.mutated` changes good ones at random, with a seed.
"""

import importlib
import json
import os
import shutil
import sys
import tracemalloc
import warnings
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.files import npz
from lagjax.files import table as file_table
from lagjax.sweep import metadata, objects, store
from tests import mutated
from tests.by_hand import with_problem
from tests.mutated import describe, mutated_file, mutated_store
from tests.systems import motion

T = np.linspace(0.0, 3.0, 16)
AXES = {"k": np.arange(1.0, 3.0), "x": np.linspace(0.1, 1.0, 8)}
# What Python announces to an audit hook, and reading data never does.
FORBIDDEN = {"os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "import", "exec"}
FORBIDDEN |= {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod"}
FORBIDDEN |= {"socket.connect", "ctypes.dlopen", "shutil.rmtree", "shutil.copyfile", "pickle.find_class"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Besides twice the numbers of an honest file: Python's objects for a description of a few kilobytes.
SPARE = 1_500_000

watched: list | None = None
opened: list = []


def _announced(event, args):
    if watched is not None and (event in FORBIDDEN or event == "open" and args[2] & WRITING):
        watched.append((event, str(args)[:200]))
    if watched is not None and event == "open" and isinstance(args[0], (str, bytes)):
        opened.append(os.fsdecode(args[0]))


sys.addaudithook(_announced)


def attempt(read, folder, honest, inside=None):
    """What is wrong with reading a file, as a list of lines, and what came of it: a value or an error in words.

    Nothing in `folder` may change, and no file outside of `inside` may be opened.
    """
    global watched
    opened.clear()
    before = {x: (x.lstat().st_size, x.lstat().st_mtime_ns) for x in folder.rglob("*")}
    modules, wrong, found = set(sys.modules), [], None
    tracemalloc.start()
    watched = events = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = read()
    except ValueError as error:
        found, said = error, str(error)
        if not all(c.isprintable() or c == "\n" for c in said) or len(said) < 30 or len(said) > 3000:
            wrong.append(f"said {said!r:.300}")
    except BaseException as error:
        wrong.append(f"raised {error!r:.300}")
    finally:
        watched = None
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    if peak > 2 * honest + SPARE:
        wrong.append(f"took {peak:,} bytes, not {honest:,}")
    wrong += [f"announced {event}" for event in events]
    # Python's own files tell the versions of packages.
    allowed = *map(os.path.realpath, (inside or folder, sys.prefix, sys.base_prefix)), sys.prefix
    wrong += [f"opened {x}" for x in opened if not os.path.realpath(x).startswith(allowed)]
    wrong += [f"imported {name}" for name in sorted(set(sys.modules) - modules)]
    after = {x: (x.lstat().st_size, x.lstat().st_mtime_ns) for x in folder.rglob("*")}
    wrong += [f"wrote {x}" for x in sorted(set(before.items()) ^ set(after.items()))]
    return wrong, found


def read_file(load, path):
    """Read a file and print it, as a user would; returns the arrays of the result."""
    found = load(path)
    repr(found)
    return [np.asarray(x) for x in jax.tree.leaves(found) if isinstance(x, (jax.Array, np.ndarray, np.generic))]


def honest_bytes(path):
    """The bytes of a file, and ten times those of its description: what Python's objects for an honest one take."""
    try:
        with zipfile.ZipFile(path) as entries:
            return path.stat().st_size + 10 * entries.getinfo("lagjax.json").compress_size
    except (zipfile.BadZipFile, KeyError, ValueError, NotImplementedError, OSError):
        return path.stat().st_size


def is_from(path, arrays):
    """Whether each array is one of the file, as NumPy reads it."""
    with np.load(path) as stored:
        there = {stored[name].tobytes() for name in stored.files if name != "lagjax.json"}
    return all(x.tobytes() in there for x in arrays)


def attack_files(kind, load, good, folder, numbers):
    """Everything that is wrong with reading changed copies of a file; how many were read, how many refused."""
    path, wrong, read = folder / f"{kind}.npz", [], 0
    # Once before, so that everything is imported.
    read_file(load, good)
    attempt(lambda: read_file(load, good), folder, good.stat().st_size)
    for number in numbers:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            how = mutated_file(good, path, np.random.default_rng(number))
        lines, found = attempt(lambda: read_file(load, path), folder, honest_bytes(path))
        if isinstance(found, list):
            read += 1
            lines += [] if is_from(path, found) else ["has other numbers"]
        wrong += [f"{kind} {number} ({how}): {line}" for line in lines]
    return wrong, read


def read_store(path):
    """Open a store, read and print it; returns its sweep and its values."""
    opened = lj.open_sweep(path)
    values = opened.values
    repr(opened)
    return opened, values


def attack_stores(good, folder, numbers):
    """Everything that is wrong with opening changed copies of a store; how many were read."""
    wrong, read, honest = [], 0, sum(x.stat().st_size for x in good.rglob("*") if x.is_file())
    right = np.unique(np.concatenate([np.ravel(x) for x in jax.tree.leaves(lj.open_sweep(good).values)]))
    attempt(lambda: read_store(good), folder, honest)
    for number in numbers:
        path, outside = folder / "store", folder / "outside"
        shutil.copytree(good, path)
        outside.mkdir()
        how = mutated_store(path, outside, np.random.default_rng(number))
        lines, found = attempt(lambda: read_store(path), folder, honest, inside=path)
        if isinstance(found, tuple):
            read += 1
            opened, values = found
            for x in jax.tree.leaves(values):
                lines += [] if np.isin(x[opened.ok], right).all() else ["has other numbers"]
        wrong += [f"store {number} ({how}): {line}" for line in lines]
        for there in (path, outside):
            shutil.rmtree(there)
    return wrong, read


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A trajectory and a store to be changed."""
    folder = tmp_path_factory.mktemp("good")
    found = motion("rod pendulum")
    with_problem(found, params=found.params | {"kind": "steel"}).save(folder / "trajectory.npz")
    run = lambda point: {"y": jnp.stack([point["x"] * point["k"]] * 2), "n": (10 * point["k"]).astype(int)}
    lj.sweep(run, AXES, store=folder / "store", chunk=8, workers=1, progress=False)
    return folder


@pytest.mark.parametrize("numbers", [range(70), pytest.param(range(1000, 1500), marks=pytest.mark.exhaustive)])
def test_changed_files(good, tmp_path, numbers):
    """Changed trajectory files, some of which can be read."""
    wrong, read = attack_files("trajectory", lj.load_trajectory, good / "trajectory.npz", tmp_path, numbers)
    assert wrong == [] and 0 < read < 0.6 * len(numbers)


@pytest.mark.parametrize("numbers", [range(30), pytest.param(range(1000, 1300), marks=pytest.mark.exhaustive)])
def test_changed_stores(good, tmp_path, numbers):
    """Changed stores, some of which can be read."""
    wrong, read = attack_stores(good / "store", tmp_path, numbers)
    assert wrong == [] and 0 < read < 0.85 * len(numbers)


def changed(good, path, change):
    """A trajectory file with another description."""
    with zipfile.ZipFile(good) as entries, zipfile.ZipFile(path, "w") as others:
        header = json.loads(entries.read("lagjax.json"))
        change(header["trajectory"])
        others.writestr("lagjax.json", json.dumps(header))
        for name in entries.namelist():
            if name != "lagjax.json":
                others.writestr(name, entries.read(name))
    return path


def of_params(node):
    """A change of a trajectory's params."""
    return lambda said: said.update(params=node)


def of_norm(node):
    """A controller that measures errors by a function of the file's author."""
    fields = {name: {"float": "0x1p+0"} for name in "pcoeff icoeff dcoeff factormin factormax safety rtol atol".split()}
    fields |= {"norm": node, "dtmin": None, "dtmax": None, "force_dtmin": True, "error_order": None}
    controller = {"object": {"module": "diffrax", "name": "PIDController"}, "fields": fields}
    return lambda said: said["asked"]["dict"][1].__setitem__(1, controller)


SEQUENCE = {
    "object": {"module": "equinox.nn", "name": "Sequential"},
    "fields": {"layers": {"tuple": [mutated.PARTIAL]}},
}
# What an author may try, by hand: classes, modules and functions by name, and one array in very many places.
TRIED = [of_params(node) for node in (mutated.CODE, mutated.MODULE, mutated.PROGRAM, mutated.OPENER, mutated.LAYER)]
TRIED += [of_norm(node) for node in (SEQUENCE, mutated.PARTIAL, mutated.CODE, "text")]
TRIED += [of_params({"tuple": [{"array": "t", "of": "jax"}] * 10_000})]


def test_code_in_files(good, tmp_path, monkeypatch):
    """Code that is named in a file is refused. Twin: a reader that imports by name runs it, which is told."""
    read_file(lj.load_trajectory, good / "trajectory.npz")

    def all_wrong():
        wrong = []
        for change in TRIED:
            path = changed(good / "trajectory.npz", tmp_path / "x.npz", change)
            lines, found = attempt(lambda p=path: read_file(lj.load_trajectory, p), tmp_path, honest_bytes(path))
            wrong += lines if isinstance(found, ValueError) else [*lines, "was read"]
        return wrong

    assert all_wrong() == []

    def by_name(self, module, name):
        cls = getattr(importlib.import_module(module), name)
        return cls, file_table.fields_of(cls) or (), False

    monkeypatch.setattr(file_table.Table, "class_of", by_name)
    monkeypatch.setitem(sys.modules, "antigravity", None)
    # Another test may have imported it.
    for name in [name for name in sys.modules if name.startswith("numpy.f2py")]:
        monkeypatch.delitem(sys.modules, name)
    assert any("numpy.f2py" in line for line in all_wrong())


LARGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (3000000,), }"
BOMBS = {"deflated": (zipfile.ZIP_DEFLATED, bytes(24_000_000)), "shape": (zipfile.ZIP_STORED, bytes(8))}


def test_bombs_of_a_kilobyte(good, tmp_path, monkeypatch):
    """An array that grows when it is read is refused before it does. Twin: without the check of entries it is told."""
    with zipfile.ZipFile(good / "trajectory.npz") as entries:
        contents = {name: entries.read(name) for name in entries.namelist()}
    for name, (compression, data) in BOMBS.items():
        with zipfile.ZipFile(tmp_path / "x.npz", "w", compression) as to:
            for entry, content in contents.items():
                to.writestr(entry, mutated.npy(LARGE, data) if entry == "t.npy" else content)
        attack = lambda: attempt(lambda: read_file(lj.load_trajectory, tmp_path / "x.npz"), tmp_path, 20_000)
        wrong, found = attack()
        assert wrong == [] and isinstance(found, ValueError)
        if name == "deflated":
            with monkeypatch.context() as patch:
                patch.setattr(npz, "_entries", lambda entries, path: {x.filename: x for x in entries.infolist()})
                assert any(line.startswith("took ") for line in attack()[0])


def larger_grid(path, n):
    """A store that claims n times n points, in every part of its description, of which none were computed."""
    folder, axes = path / "lagjax/marks/c", {"k": np.zeros(n), "x": np.zeros(n)}
    shutil.rmtree(folder)
    specs = {name: objects.Spec(x.shape, x.shape, x.dtype, np.nan, [name]) for name, x in axes.items()}
    objects.Files(path).write(metadata.axis_files(specs, axes))

    def change(said):
        said["block"] = [1, n]
        said["fingerprint"]["axes"] = {name: metadata.of_axis(x) for name, x in axes.items()}
        return said

    describe(path, change)


def outside(path):
    """A store that names an array outside of it."""

    def change(said):
        said["places"]["values"]["n"], said["dims"]["../outside"] = "../outside", said["dims"].pop("n")
        return said

    describe(path, change)


def by_link(path):
    """A store one of whose blocks is a link to a file outside of it."""
    os.rename(path / "n/c/1/0", path.parent / "moved")
    (path / "n/c/1/0").symlink_to(path.parent / "moved")


@pytest.mark.exhaustive
def test_a_store_that_claims_more(good, tmp_path, monkeypatch):
    """It takes no more memory than its files have room for; twin: without that check it does."""
    read_store(good / "store")
    shutil.copytree(good / "store", tmp_path / "store")
    larger_grid(tmp_path / "store", 1500)
    attack = lambda: attempt(lambda: read_store(tmp_path / "store"), tmp_path, 20_000, inside=tmp_path / "store")[0]
    assert attack() == []
    monkeypatch.setattr(store, "check_room", lambda *args: None)
    assert any(line.startswith("took ") for line in attack())


def test_a_sweep_continues_inside_its_store(good, tmp_path):
    """A sweep that continues refuses a store that reaches out, and writes nothing; twin: it restores its own."""
    run = lambda point: {"y": jnp.stack([point["x"] * point["k"]] * 2), "n": (10 * point["k"]).astype(int)}
    again = lambda: lj.sweep(run, AXES, store=tmp_path / "in" / "store", chunk=8, workers=1, progress=False)
    for change in (outside, by_link):
        shutil.copytree(good / "store", tmp_path / "in" / "store")
        change(tmp_path / "in" / "store")
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(ValueError, match="is not inside of it|is a link"):
            again()
        assert sorted(tmp_path.rglob("*")) == before
        shutil.rmtree(tmp_path / "in")
    shutil.copytree(good / "store", tmp_path / "in" / "store")
    (tmp_path / "in" / "store" / "y" / "zarr.json").unlink()
    with pytest.warns(UserWarning, match="It has been restored"):
        assert again().ok.all()


@pytest.mark.exhaustive
def test_changed_fits(tmp_path):
    """A hundred changed fits, some of which can be read."""
    spring = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 - 0.5 * params["k"] * q["x"] ** 2)
    noise = 1e-3 * np.random.default_rng(0).normal(size=len(T))
    found = lj.fit(spring, lj.Record(T, q={"x": np.cos(2.0 * T) + noise}, sigma=1e-3), {"k": 3.5})
    found.save(tmp_path / "good.npz")
    folder = tmp_path / "changed"
    folder.mkdir()
    wrong, read = attack_files("fit", lj.load_fit, tmp_path / "good.npz", folder, range(2000, 2100))
    assert wrong == [] and 0 < read < 60
