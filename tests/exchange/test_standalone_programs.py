"""Exported programs that integrate, run by a process that has only JAX and NumPy."""

import json
import subprocess
import sys
import textwrap
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import lagjax as lj
from lagjax.exchange.standalone_programs import plain
from tests.systems import HORIZONTAL, PARAMS, motion, pendulum, rod_pendulum

TS = np.linspace(0.0, 1.0, 5)
# Reads each program and the arguments of its calls, runs them, and writes the results.
ELSEWHERE = textwrap.dedent("""
    import json, pathlib, sys
    import jax, numpy as np
    from jax import export
    jax.config.update("jax_enable_x64", True)
    folder = pathlib.Path(sys.argv[1])
    for name, calls in json.loads((folder / "calls.json").read_text()).items():
        program = export.deserialize(bytearray((folder / name).read_bytes()))
        as_floats = lambda tree: jax.tree.map(lambda x: np.asarray(x, float), tree, is_leaf=lambda x: type(x) is list)
        for i, arguments in enumerate(calls):
            leaves = jax.tree.leaves(program.call(*(as_floats(x) for x in arguments)))
            np.savez(folder / f"{name}-{i}.npz", *leaves)
    mine = {"lagjax", "diffrax", "equinox", "lineax", "optimistix"} & {name.split(".")[0] for name in sys.modules}
    assert not mine, mine
""")


def swing(angle, speed, params, **options):
    """The pendulum by its angle."""
    return lj.integrate(pendulum, angle, speed, params, ts=TS, **options)


def slope(angle, params):
    """The last angle and its derivatives with respect to all arguments."""
    return jax.value_and_grad(lambda angle, params: swing(angle, 0.5, params).q[-1], (0, 1))(angle, params)


def by_jax_alone(angle, params):
    """Exportable by `jax.export` itself: no exceptions, and only arrays are returned."""
    motion = swing(angle, 0.0, params, throw=False)
    return motion.q, motion.v


OTHER = PARAMS | {"g": 9.0}
LOW = {"low": lj.Crossing(lambda t, q, v, params: q)}
# The function and two calls of it.
CASES = {
    "rod": (
        lambda q, v, params: lj.integrate(rod_pendulum, q, v, params, ts=TS),
        (*HORIZONTAL, PARAMS),
        ({"x": 0.75, "y": -1.0}, HORIZONTAL[1], PARAMS),
    ),
    "event": (lambda *state: swing(*state, events=LOW), (1.0, 0.0, PARAMS), (0.5, 0.5, OTHER)),
    "slope": (slope, (1.0, PARAMS), (1.0, OTHER)),
}


def written(folder, name, exported, *calls):
    """Write a program and the arguments of its calls; returns the size of its file."""
    (folder / name).write_bytes(exported.serialize())
    listed = jax.tree.map(lambda x: np.asarray(x).tolist(), calls)
    known = json.loads((folder / "calls.json").read_text()) if (folder / "calls.json").exists() else {}
    (folder / "calls.json").write_text(json.dumps(known | {name: listed}))
    return (folder / name).stat().st_size


def read(folder, name, call):
    """The results of the other process."""
    with np.load(folder / f"{name}-{call}.npz") as file:
        return [file[f"arr_{i}"] for i in range(len(file.files))]


@pytest.mark.optimised
@pytest.mark.exhaustive
def test_another_process_without_lagjax(tmp_path):
    """Motions, forces, events and derivatives equal those here bit for bit; twin: other arguments change them."""
    for name, (run, *calls) in CASES.items():
        assert written(tmp_path, name, lj.export(run, *calls[0]), *calls) < 150_000
    jitted = jax.jit(by_jax_alone)
    assert written(tmp_path, "jax", export.export(jitted)(1.0, PARAMS), (1.0, PARAMS)) < 100_000
    # A batch of any size uses other kernels than a single motion, with another round-off.
    (size,) = export.symbolic_shape("size")
    many, batch = jax.ShapeDtypeStruct((size,), np.float64), jax.vmap(swing, (0, None, None))
    angles = np.linspace(0.5, 1.5, 300)
    written(tmp_path, "batch", lj.export(batch, many, 0.0, PARAMS), (angles[:3], 0.0, PARAMS), (angles, 0.0, PARAMS))
    subprocess.run([sys.executable, "-c", ELSEWHERE, str(tmp_path)], check=True, cwd=tmp_path, timeout=300)
    for name, (run, *calls) in CASES.items():
        here = [jax.tree.leaves(plain(jax.jit(run)(*call))) for call in calls]
        for call, expected in enumerate(here):
            found = read(tmp_path, name, call)
            assert len(found) == len(expected)
            for x, y in zip(found, expected):
                np.testing.assert_array_equal(x, y)
        assert any(not np.array_equal(x, y, equal_nan=True) for x, y in zip(*here))
    for x, y in zip(read(tmp_path, "jax", 0), jitted(1.0, PARAMS)):
        np.testing.assert_array_equal(x, y)
    every = plain(jax.jit(batch)(angles, 0.0, PARAMS))
    for call, start in enumerate((angles[:3], angles)):
        expected = jax.tree.map(lambda x: x[: len(start)], every)
        found = jax.tree.unflatten(jax.tree.structure(expected), read(tmp_path, "batch", call))
        np.testing.assert_allclose(found["q"], expected["q"], atol=1e-12)
        assert found["q"].shape == (len(start), len(TS)) and not found["result"].any()


@pytest.mark.exhaustive
def test_derivatives_of_what_was_written():
    """With `vjp_order=1` the derivative is exported as well, and equals that of the motion here."""
    exported = lj.export(lambda angle, params: swing(angle, 0.5, params).q[-1], 1.0, PARAMS)
    read_again = export.deserialize(exported.serialize(vjp_order=1))
    found = jax.grad(lambda *x: read_again.call(*x), (0, 1))(1.0, PARAMS)
    _, expected = slope(1.0, PARAMS)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(x, y, rtol=1e-12)


def test_a_motion_is_a_dictionary():
    """Whatever a trajectory has is an array by name, its result a code; a failing check gives NaN."""
    traj = motion("pendulum")
    codes = lj.RESULTS.successful._value, lj.RESULTS.max_steps_reached._value

    def run(angle):
        new = angle * traj.q, jnp.where(angle > 1.5, codes[1], codes[0])
        return eqx.tree_at(lambda x: (x.q, x.result._value), traj, new), eqx.error_if(angle, angle > 2, "too far")

    exported = lj.export(run, 1.0)
    for angle, code, words in ((1.0, codes[0], "successful"), (1.75, codes[1], "The maximum number of solver steps")):
        found, checked = exported.call(angle)
        np.testing.assert_array_equal(found["q"], angle * np.asarray(traj.q))
        np.testing.assert_array_equal(found["t"], traj.t)
        assert found["result"] == code and checked == angle and lj.result_codes()[int(code)].startswith(words)
    assert np.isnan(exported.call(3.0)[1])


@pytest.mark.slow
def test_failures_are_codes():
    """A motion that would raise gives a code instead and keeps its first outputs; a failing check gives NaN."""

    def run(angle, params):
        return swing(angle, 0.0, params, max_steps=5), eqx.error_if(angle, angle > 2, "too far")

    exported = lj.export(run, 1.0, PARAMS)
    motion, checked = exported.call(1.0, PARAMS)
    assert lj.result_codes()[int(motion["result"])].startswith("The maximum number of solver steps was reached")
    assert motion["q"][0] == 1.0 and np.isfinite(motion["q"][1]) and np.isnan(motion["q"][-1]) and checked == 1.0
    assert np.isnan(exported.call(3.0, PARAMS)[1])


def test_result_codes():
    """Each item of `lj.RESULTS` has a description."""
    codes = lj.result_codes()
    assert codes[int(lj.RESULTS.start_off_constraints._value)] == "The initial state does not satisfy the constraints."
    assert codes[int(lj.RESULTS.event_occurred._value)] == "ended by its event" and len(codes) == len(lj.RESULTS)


def prints(x):
    """A function that calls Python."""
    jax.debug.print("{}", x)
    return x


REFUSED = {
    "no function": (lambda: lj.export(motion("pendulum")), "takes a function, not Trajectory"),
    "a class": (lambda: lj.export(lambda x: x, lj.RESULTS.successful), "an argument of an exported program"),
    "a system": (lambda: lj.export(lambda system, x: x, pendulum, 1.0), "and not System"),
    "text": (lambda: lj.export(lambda x: x, {"a": "text"}), "and not str"),
    "text back": (lambda: lj.export(lambda x: {"a": "text"}, 1.0), "returned 'text', a str"),
    "any number of times": (
        lambda: lj.export(
            lambda ts: lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=ts),
            jax.ShapeDtypeStruct(export.symbolic_shape("n"), np.float64),
        ),
        "number of output times must be known .* is n",
    ),
    "a print": (lambda: lj.export(prints, 1.0), "calls Python while it runs"),
    "a callback": (
        lambda: lj.export(lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), np.float64), x), 1.0),
        "calls Python while it runs",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    """The error says what is refused."""
    ask, words = REFUSED[case]
    with pytest.raises((TypeError, ValueError), match=words):
        ask()


def test_whole_numbers_and_structures():
    """Python integers become floats in the program; lists, tuples, None and integer arrays stay the same."""
    exported = lj.export(lambda a, b: (a["x"] + b[0], [b[1], None]), {"x": 1}, (2, np.arange(3)))
    found, (whole, nothing) = exported.call({"x": 0.5}, (0.25, np.array([4, 5, 6])))
    assert found == 0.75 and whole.dtype == jnp.int64 and nothing is None


class Layer(eqx.Module):
    """A network of one layer."""

    weights: np.ndarray
    activation: Callable

    def __call__(self, x):
        return jnp.sum(self.activation(self.weights * x))


def test_weights_are_arguments():
    """A network among the arguments is a list of arrays there: other weights give what they give here; twin: others."""
    first, other = (Layer(np.array(weights), jnp.tanh) for weights in ([0.5, -0.25], [1.0, 2.0]))

    def run(x, params):
        return {"y": params["net"](x) + params["k"]}

    program = lj.export(run, np.ones(2), {"net": first, "k": 1.0})
    arrays = {"net": jax.tree.leaves(eqx.filter(other, eqx.is_array)), "k": 2.0}
    found = export.deserialize(bytearray(program.serialize())).call(0.5 * np.ones(2), arrays)["y"]
    of = lambda net: np.sum(np.tanh(0.5 * net.weights)) + 2.0
    assert np.isclose(found, of(other)) and not np.isclose(found, of(first))
    with pytest.raises(TypeError, match="must be a number or an array"):
        lj.export(run, np.ones(2), {"net": eqx.nn.Identity(), "k": 1.0})
