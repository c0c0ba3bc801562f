"""Programs found again in a new process: the same bits, and never those of another program."""

import os
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive

import lagjax as lj
from lagjax.jaxtools import LATER, KeptProgram, Said, digest, folder, kept
from lagjax.jaxtools.digest import NotKept, digest_of
from lagjax.jaxtools.jaxpr import Meaning, meaning_of
from lagjax.jaxtools.outline import NoOutline, outlined, rebuilt
from lagjax.system.user_errors import warn


class Pair(NamedTuple):
    """A state in a class of the user's."""

    x: float
    y: float


class Network(eqx.Module):
    """Parameters in a class of the user's."""

    weight: object
    width: int = eqx.field(static=True)


def written(x, of_user=False) -> str:
    """The digest of one thing."""
    return digest_of([(x, of_user)])


def meaning(function, *args) -> Meaning:
    """What a function computes."""
    closed = jax.make_jaxpr(function)(*args)
    return Meaning((meaning_of(closed.jaxpr), tuple(np.asarray(x).tobytes() for x in closed.consts)))


def test_different_things_are_written_differently():
    """Things that are alike in one way have different digests; equal ones, made anew, have the same."""
    make = lambda: [
        0, 1, -1, 10, False, True, 0.0, -0.0, 1.0, float("nan"), 0j, None, ..., "", "0", b"0", b"", (), [], {}, (0,),
        [0], ((),), ((), ()), ("ab", "c"), ("a", "bc"), ("abc",), {"a": 1}, {"a": 2}, {"b": 1}, {1: "a"}, frozenset(),
        frozenset({1}), frozenset({1, 2}), slice(1), slice(0, 1), range(1), range(2), np.float32(1), np.float64(1),
        np.array(1), np.array([1.0]), np.array([[1.0]]), np.array([1.0, 2.0]), np.array([1.0, 2.0], np.float32),
        jnp.asarray(1.0), np.dtype("float32"), np.dtype("int32"), jax.ShapeDtypeStruct((2,), np.float64),
        jax.ShapeDtypeStruct((2, 1), np.float64), int, float, np.sum, jnp.sum, len, partial(jnp.sum, axis=0),
        partial(jnp.sum, axis=1), lj.Dopri8(), lj.Tsit5(), lj.Dopri8, Meaning((1,)), Meaning((1.0,)), Meaning(("1",)),
        jax.lax.Precision.HIGHEST, jax.lax.Precision.DEFAULT, jax.tree.structure((1, 2)), jax.tree.structure([1, 2]),
        jax.tree.structure({"a": 1}), jax.tree.structure({"b": 1}), jax.tree.structure(None), jax.tree.structure(1),
    ]  # fmt: skip
    first = [written(x) for x in make()]
    assert [name for name, count in Counter(first).items() if count > 1] == []
    assert [written(x) for x in make()] == first


def test_programs_are_written_by_what_they_compute():
    """A function written again has the same digest; twins: another constant, a table, an axis, a shape, an order."""
    x, table = np.ones(3), np.arange(3.0)
    make = lambda c=2.0, t=table, axis=0: lambda x: jnp.sum(c * jnp.sin(x) + t, axis=axis)
    same = written(meaning(make(), x))
    assert written(meaning(make(), x)) == same
    others = [make(c=np.nextafter(2.0, 3.0)), make(t=table[::-1].copy()), lambda x: jnp.sum(jnp.sin(x) + table)]
    found = {written(meaning(f, x)) for f in others} | {written(meaning(make(), np.ones(3, np.float32)))}
    loop = lambda n: lambda x: jax.lax.fori_loop(0, n, lambda i, x: jnp.cos(x), x)
    solve = lambda x: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), x)
    found |= {written(meaning(f, x)) for f in (loop(3), loop(4), solve, lambda x: jnp.where(x > 0, x, 0.0))}
    assert len(found | {same}) == 9


def test_what_cannot_be_written():
    """Code of the user's outside of jaxprs, callbacks and objects of unknown classes are refused, never guessed."""

    class Unknown:
        pass

    class Method(lj.Dopri8):
        pass

    scale = 2.0
    called = lambda x: jax.pure_callback(lambda x: scale * x, jax.ShapeDtypeStruct((), x.dtype), x)
    own = Primitive("add")
    things = [
        lambda x: x, partial(written), Unknown(), Unknown, object(), Method(), meaning(called, 1.0), own,
        np.array([None]), np.array([(1, 2.0)], "i4,f8"), [Unknown()], Pair(0.0, 1.0), iter([]),
        type("int", (int,), {})(3),
    ]  # fmt: skip
    for x in things:
        with pytest.raises(NotKept):
            written(x)
    nested: list = []
    nested.append(nested)
    with pytest.raises(NotKept, match="deeply"):
        written(nested)


def test_classes_of_the_user():
    """They count by name and fields where they hold numbers, and are refused elsewhere; twin: another class."""

    class Other(NamedTuple):
        x: float
        y: float

    structures = [jax.tree.structure(x) for x in (Pair(0.0, 1.0), Other(0.0, 1.0), Network(0.0, 3), Network(0.0, 4))]
    assert len({written(x, of_user=True) for x in structures}) == 4
    for x in structures:
        with pytest.raises(NotKept):
            written(x)


def test_the_surroundings_count(monkeypatch):
    """Another processor, jaxlib, source, setting of JAX or flag of XLA: another digest; twin: nothing changed."""
    before = written(1)
    found = set()
    for name, value in (("machine", ("Linux", "flags: sse")), ("versions", {"jaxlib": "0.0"}), ("source", "another")):
        with monkeypatch.context() as patched:
            patched.setattr(digest, name, lambda value=value: value)
            found.add(written(1))
    for name in ("XLA_FLAGS", "LAGJAX_ANY"):
        with monkeypatch.context() as patched:
            patched.setenv(name, "--xla_cpu_enable_fast_math=true")
            found.add(written(1))
    with jax.default_matmul_precision("float32"):
        found.add(written(1))
    with jax.numpy_dtype_promotion("strict"):
        found.add(written(1))
    with jax.enable_x64(False):
        found.add(written(1))
    assert len(found | {before}) == 9 and written(1) == before
    monkeypatch.setenv("LAGJAX_CACHE", "elsewhere")
    with jax.log_compiles(False):
        assert written(1) == before
    assert all(len(x) > 1 for x in (digest.machine(), digest.devices(), digest.versions()))


def test_outlines():
    """A tree comes back from its outline, with 0 in place of leaves; twin: what is not known has none."""
    traj = lj.integrate(lj.System(lambda t, q, v, params: 0.5 * v**2), 0.0, 1.0, ts=[0.0, 1.0])
    known = {"static": traj.static, "arrays": traj.arrays}
    outline = outlined(traj, known)
    assert jax.tree.structure(rebuilt(outline, known)) == jax.tree.structure(traj)
    for x in (traj, {1: 2.0}, {"a": Pair(0.0, 1.0)}):
        with pytest.raises(NoOutline):
            outlined(x, {})


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder, which is used."""
    if kept.jaxlib.version.__version__ not in kept.TRIED or jax.default_backend() != "cpu":
        pytest.skip("programs are not kept here")
    monkeypatch.setenv("LAGJAX_CACHE", str(tmp_path))
    monkeypatch.setattr(kept, "TALLY", kept.Tally(Counter(), Counter()))
    yield tmp_path
    LATER.wait()


def program(function, traced=None):
    """A program of arrays, as one process after the other would make it; `traced` counts how often it is traced."""

    def counted(arrays):
        if traced is not None:
            traced.append(len(arrays))
        return function(*arrays)

    def parts():
        closed = jax.make_jaxpr(function)(*(np.ones(3), np.ones(3)))
        return [(Meaning((meaning_of(closed.jaxpr), tuple(np.asarray(x).tobytes() for x in closed.consts))), False)]

    outline = lambda tree: outlined(tree, {})
    return KeptProgram(counted, Said(parts, outline, lambda outline, arrays: rebuilt(outline, {})), None)


def factor(x, y):
    """Something that calls LAPACK, does not read all of y, and gives a tree."""
    a = jnp.outer(x, x) + jnp.eye(3)
    return {"root": jnp.linalg.cholesky(a), "rest": (jnp.sin(x), [None, x[0] > 0])}


def same(a, b) -> bool:
    """Whether two trees are the same, bit for bit."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    equal = all(x.dtype == y.dtype and np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)
    return equal and jax.tree.structure(a) == jax.tree.structure(b)


def test_a_program_is_found(place):
    """Made again, it is not traced, and gives the same bits; for other values, and for JAX's arrays; twin: a shape."""
    x, y, traced = np.array([1.0, 2.0, 4.0]), np.ones(3), []
    first = program(factor)([x, y])
    assert LATER.wait() and kept.TALLY.found == {"written": 1} and kept.TALLY.not_kept == {}
    again = program(factor, traced)
    assert same(again([x, y]), first) and traced == [] and kept.TALLY.found["found"] == 1
    assert same(again([2 * x, y]), program(factor)([2 * x, y])) and same(again([jnp.asarray(x), jnp.asarray(y)]), first)
    assert traced == [] and again.is_ready
    assert again([x, np.ones(2)])["root"].shape == (3, 3) and traced == [2]
    with jax.default_matmul_precision("float32"):
        again([x, y])
    assert traced == [2, 2]


def test_a_program_that_sorts(place, monkeypatch):
    """It is written as it was before its first run; twin: afterwards, this XLA may have no form for it."""
    later = []
    monkeypatch.setattr(LATER, "do", later.append)
    x, y = np.array([3.0, 1.0, 2.0]), np.zeros(3)
    for sorts in (lambda jaxpr: False, kept._sorts):
        monkeypatch.setattr(kept, "_sorts", sorts)
        assert program(lambda x, y: jnp.sort(x))([x, y]).tolist() == [1.0, 2.0, 3.0]
        later.pop()()
    assert kept.TALLY.found == {"written": 1} and "LessThan" in str(kept.TALLY.not_kept)


def test_never_another_program(place, monkeypatch):
    """Another function, a damaged file and another processor are compiled anew, with their own results."""
    x, y, traced = np.array([1.0, 2.0, 4.0]), np.ones(3), []
    make = lambda c, table: lambda x, y: c * x + table
    run = lambda c, table: program(make(c, np.full(3, table)), traced)([x, y])
    for c, table in ((2.0, 0.0), (3.0, 0.0), (2.0, 1.0)):
        assert np.array_equal(run(c, table), c * x + table)
        LATER.wait()
    assert len(traced) == 3 and np.array_equal(run(3.0, 0.0), 3.0 * x) and len(traced) == 3
    for file in place.glob("*" + folder.SUFFIX):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    assert np.array_equal(run(3.0, 0.0), 3.0 * x) and len(traced) == 4
    LATER.wait()
    assert np.array_equal(run(3.0, 0.0), 3.0 * x) and len(traced) == 4
    monkeypatch.setattr(digest, "machine", lambda: ("another",))
    run(3.0, 0.0)
    assert len(traced) == 5 and kept.TALLY.found["found"] == 2


def test_what_is_not_kept(place, monkeypatch):
    """Programs with checks, callbacks, warnings, of a version that was not tried, and all while it is off."""
    x, y = np.ones(3), np.ones(3)
    checked = lambda x, y: eqx.error_if(x, x[0] > 1, "above one")
    shown = lambda x, y: (jax.debug.callback(print, x[0]), x)[1]
    for function in (checked, shown):
        assert np.array_equal(program(function)([x, y]), x)
        LATER.wait()

    def warns(x, y):
        warn("of this x", UserWarning)
        return x

    with pytest.warns(UserWarning, match="of this x"):
        program(warns)([x, y])
    with monkeypatch.context() as patched:
        patched.setattr(kept, "TRIED", set())
        program(factor)([x, y])
    with monkeypatch.context() as patched:
        patched.setenv("LAGJAX_CACHE", "off")
        program(factor)([x, y])
    for name in ("serialize_executable", "hlo_modules"):
        # Parts of JAX that are not there any more.
        with monkeypatch.context() as patched:
            patched.setattr(kept, "_parts_of", lambda call, name=name: getattr(None, name))
            program(factor)([x, y])
            LATER.wait()
    assert folder.size(place) == (0, 0) and kept.TALLY.found == {} and sum(kept.TALLY.not_kept.values()) == 7
    assert "LAGJAX_CACHE=off" in kept.TALLY.not_kept


def test_one_that_cannot_be_loaded(place, monkeypatch):
    """Where JAX or XLA refuse an executable it is compiled; twin: it is found where they do not."""
    x, y = np.ones(3), np.ones(3)
    first = program(factor)([x, y])
    LATER.wait()

    def refuse(*args):
        raise RuntimeError("the wrong machine")

    traced: list = []
    with monkeypatch.context() as patched:
        patched.setattr(kept, "_call_of", refuse)
        assert same(program(factor, traced)([x, y]), first) and len(traced) == 1
    assert any("the wrong machine" in why for why in kept.TALLY.not_kept)
    LATER.wait()
    assert same(program(factor, traced)([x, y]), first) and len(traced) == 1


def test_the_cache_shows_itself(place):
    """`lj.cache()` says where, how many and how often it helped; it empties itself, and says why it is off."""
    x, y = np.ones(3), np.ones(3)
    for _ in range(2):
        program(factor)([x, y])
        LATER.wait()
    lj.cache().clear()
    assert lj.cache().programs == 0 and lj.cache().path == place and str(place) in repr(lj.cache())
    place.chmod(0o770)
    assert lj.cache().path is None and "others" in repr(lj.cache())
    place.chmod(0o700)


def test_what_takes_long_is_explained(monkeypatch, capsys):
    """A first answer that takes long says so before XLA does; twins: a quick one, and the next, do not."""
    outline, tree = lambda x: None, lambda outline, arrays: 0

    def noted(arrays):
        time.sleep(0.3)
        return arrays[0]

    for slow, words in ((0.1, ["Very slow compile", "it is none"]), (100.0, [])):
        monkeypatch.setattr(kept, "SLOW", slow)
        program = KeptProgram(noted, Said(lambda: [], outline, tree), None)
        for expected in (words, []):
            assert float(program([np.asarray(2.0)])) == 2.0
            told = capsys.readouterr().err
            assert all(x in told for x in expected) and bool(told) == bool(expected)


MOTION = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import lagjax as lj
from typing import NamedTuple
table = np.linspace(0.0, 1e-3, 2000) * float(sys.argv[2])
class Q(NamedTuple):
    x: float
    y: float
def lagrangian(t, q, v, params):
    kinetic = 0.5 * params["m"] * (v.x**2 + v.y**2)
    return kinetic - params["m"] * (CONSTANT * q.y + jnp.interp(q.x, jnp.linspace(-2.0, 2.0, 2000), table))
CONSTANT = float(sys.argv[1])
rod = lj.Holonomic(lambda t, q, params: q.x**2 + q.y**2 - 1.0)
low = {"low": lj.Crossing(lambda t, q, v, params: q.x, terminal=False)}
system = lj.System(lagrangian, constraints={"rod": rod})
traj = lj.integrate(system, Q(1.0, 0.0), Q(0.0, 0.0), {"m": 2.0}, ts=np.linspace(0.0, 1.0, 7), events=low)
found = lj.cache()
print(found.found, found.written, *(np.asarray(x).tobytes().hex() for x in jax.tree.leaves(traj)))
print(type(traj.q).__name__, traj.asked, traj.at(0.5).q.x, repr(traj).split("error")[0])
"""


DOORS = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import lagjax as lj
def lagrangian(t, q, v, params):
    swing = params["l"] * v["a"]
    return 0.5 * (swing**2 + v["b"] ** 2 - q["b"] ** 2) + params["l"] * jnp.cos(q["a"]) + 0.1 * v["a"] * v["b"]
system = lj.System(lagrangian)
rest, q, v, ts = {"a": 0.0, "b": 0.0}, {"a": 0.3, "b": 0.1}, {"a": 0.0, "b": 0.2}, np.linspace(0.0, 1.0, 5)
def end(l):
    return lj.integrate(system, q, v, {"l": l}, ts=ts).q["a"][-1]
def record():
    swing = 0.3 * np.cos(np.linspace(0.0, 2.0, 12))
    return lj.Record(np.linspace(0.0, 2.0, 12), q={"a": swing, "b": 0.5 * swing}, q0=q, v0=v, sigma=0.1)
lengths = {"l": np.linspace(1.0, 2.0, 16)}
doors = {
    "accelerations": lambda: lj.accelerations(system, 0.0, q, v, {"l": 2.0}),
    "rollout": lambda: lj.rollout(system, q, v, {"l": 2.0}, 10, 0.01),
    "normal_modes": lambda: lj.normal_modes(system, 0.0, rest, rest, {"l": 2.0}).frequency,
    "sweep": lambda: lj.sweep(lambda at: end(at["l"]), lengths).values,
    "equilibria": lambda: lj.equilibria(system, {"l": 2.0}, starts=[q]).q,
    "orbit": lambda: lj.periodic_orbit(system, (rest | {"a": 0.3}, rest), 8.8, {"l": 2.0}).period,
    "exponents": lambda: lj.lyapunov_exponents(system, q, v, {"l": 2.0}, ts=np.linspace(0.0, 30.0, 31)).exponents,
    "fit": lambda: lj.fit(system, record(), {"l": 1.0}, free="l").params,
    "slope": lambda: jax.value_and_grad(end)(1.5),
    "pushes": lambda: jax.jacfwd(end)(1.5),
    "curvature": lambda: jax.hessian(end)(1.5),
    "lanes of slopes": lambda: jax.vmap(jax.grad(end))(jnp.array([1.0, 1.5])),
    "slope of lanes": lambda: jax.grad(lambda l: jnp.sum(jax.vmap(end)(l * jnp.array([1.0, 1.5]))))(1.5),
    "slope of accelerations": lambda: jax.grad(
        lambda l: lj.accelerations(system, 0.0, q, v, {"l": l})[0]["a"]
    )(2.0),
    "sweep of slopes": lambda: lj.sweep(lambda at: jax.grad(end)(at["l"]), lengths).values,
    "sweep of curvatures": lambda: lj.sweep(lambda at: jax.hessian(end)(at["l"]), lengths).values,
    "sweep of pushes": lambda: lj.sweep(lambda at: jax.jacfwd(end)(at["l"]), lengths).values,
    "sweep of lanes": lambda: lj.sweep(lambda at: jax.vmap(end)(at["l"] + jnp.arange(3.0)).sum(), lengths).values,
    "sweep of rests": lambda: lj.sweep(lambda at: lj.equilibria(system, at, starts=[q]).q, lengths).values,
}
answers = [doors[name]() for name in sys.argv[1].split(",")]
found = lj.cache()
print(found.found, found.written, *(np.asarray(x).tobytes().hex() for x in jax.tree.leaves(answers)))
print(found.not_kept)
"""


def run(*args, cache, script=MOTION):
    """What new processes print, which run at once."""
    environment = {**os.environ, "LAGJAX_CACHE": str(cache)}
    ask = [sys.executable, "-c", script]
    started = [
        subprocess.Popen(
            [*ask, *map(str, one)], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for one in args
    ]
    answers = [process.communicate() for process in started]
    assert [process.returncode for process in started] == [0] * len(args), answers
    lines = [out.split("\n", 1) for out, _ in answers]
    counts = [tuple(map(int, first.split()[:2])) for first, _ in lines]
    return [count[:2] for count in counts], [(first.split()[2:], rest) for first, rest in lines]


@pytest.mark.slow
def test_motions_in_new_processes(tmp_path):
    """The same bits and words without the folder, with an empty one, and from it, by several processes at once.

    Twins: another constant in L is another program; another table of 2,000 numbers the same one, with other results.
    """
    (off,) = run((9.81, 1), cache="off")[1]
    counts, (first,) = run((9.81, 1), cache=tmp_path)
    assert counts == [(0, 1)] and first == off
    counts, answers = run(*[(9.81, 1)] * 4, (9.81, 2), cache=tmp_path)
    assert counts == [(1, 0)] * 5 and answers[:4] == [off] * 4 and answers[4] != off
    counts, others = run((9.82, 1), (9.81, 2), cache="off")
    assert counts == [(0, 0)] * 2 and others[1] == answers[4]
    counts, (changed,) = run((9.82, 1), cache=tmp_path)
    assert counts == [(0, 1)] and changed == others[0] and folder.size(tmp_path)[0] == 2


FEW = "accelerations,rollout,normal_modes,sweep,slope"
MORE = "equilibria,orbit,exponents,fit,sweep of slopes,sweep of pushes,sweep of lanes,sweep of rests"
FROM_PYTHON = "pushes,curvature,lanes of slopes,slope of lanes,slope of accelerations"


@pytest.mark.slow
@pytest.mark.parametrize(
    "doors, count",
    [(FEW, 7), pytest.param(f"{MORE},{FROM_PYTHON},sweep of curvatures", 16, marks=pytest.mark.exhaustive)],
)
def test_doors_in_new_processes(tmp_path, doors, count):
    """The same bits without the folder, with an empty one, and from it, where nothing is compiled any more."""
    (off,) = run((doors,), cache="off", script=DOORS)[1]
    counts, (first,) = run((doors,), cache=tmp_path, script=DOORS)
    assert counts[0][1] >= count - 1 and first[0] == off[0] and first[1] == "{}\n", first[1]
    counts, (again,) = run((doors,), cache=tmp_path, script=DOORS)
    assert counts == [(counts[0][0], 0)] and counts[0][0] >= count - 1 and again == first


HISTORIES = """
import sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
from tests.system import test_traced_functions as histories
answer = histories.weight_at
def from_the_folder(system):
    histories.forget()
    return answer(system)
histories.weight_at = from_the_folder
wrong, asked = histories.wrong_answers(np.random.default_rng(int(sys.argv[2])), int(sys.argv[1]))
found = lj.cache()
print(found.found, found.written, wrong, asked)
"""


@pytest.mark.slow
@pytest.mark.parametrize("count", [40, pytest.param(320, marks=pytest.mark.exhaustive)])
def test_random_histories_from_the_folder(tmp_path, count):
    """Every answer of random histories of changes is that of L as it is then, with each program from the folder."""
    for seed in (0, 1):
        ((found, _),), ((answers, _),) = run((count, seed), cache=tmp_path, script=HISTORIES)
        wrong, asked = map(int, answers)
        assert wrong == 0 and asked == 5 * count and found > count
