"""A sweep called again compiles nothing, and never gives a stale answer."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.display import terminal as meter
from lagjax.jaxtools import jaxpr
from tests.counting import compiles

K = 2.0


def quiet(run, axes, **settings):
    """A sweep without a progress bar."""
    return lj.sweep(run, axes, progress=False, **settings)


def times_k(point):
    """A run that reads a global of the module."""
    return K * point["x"]


def xs(count):
    """An axis of `count` different points."""
    return {"x": np.linspace(1.0, 3.0, count)}


def test_called_again_it_compiles_nothing():
    """Other values or more points compile nothing, and repr says so. Twins: another dtype, shape, name, chunk."""
    run = lambda point: jnp.sin(point["x"])
    first = quiet(run, xs(1000))
    assert first.compiling > 0 and "; computed in" in repr(first) and "nothing had" not in repr(first)
    with compiles() as found:
        for count in (1000, 1200, 700):
            again = quiet(run, xs(count))
            np.testing.assert_allclose(again.values, np.sin(xs(count)["x"]), rtol=1e-15)
            assert again.compiling == 0 and "nothing had to be compiled; computed in" in repr(again)
        np.testing.assert_allclose(again.resweep(where=True).values, np.sin(xs(700)["x"]), rtol=1e-15)
    assert found == []
    others = [
        (xs(1000) | {"y": np.ones(1)}, {}),
        ({"x": np.arange(1000)}, {}),
        ({"x": np.ones((1000, 2))}, {}),
        (xs(1000), {"chunk": 100}),
        (xs(1000), {"layout": "map"}),
    ]
    for axes, settings in others:
        with compiles() as found:
            swept = quiet(run, axes, **settings)
        assert len(found) > 0 and swept.compiling > 0
        np.testing.assert_allclose(np.squeeze(swept.values), np.sin(axes["x"]), rtol=1e-15)


def closing_over(value):
    """A new function at each call."""
    return lambda point: value * point["x"]


def test_a_function_written_anew():
    """Functions that read the same values count as the same; another number makes another function."""
    assert closing_over(2.0) is not closing_over(2.0)
    quiet(closing_over(2.0), xs(40))
    with compiles() as found:
        np.testing.assert_array_equal(quiet(closing_over(2.0), xs(40)).values, 2 * xs(40)["x"])
    assert found == []
    for other in (3.0, -1, -2, np.float32(3.0), jnp.array(5.0)):
        np.testing.assert_array_equal(quiet(closing_over(other), xs(40)).values, other * xs(40)["x"])


def set_global(name, value):
    """Set a global, as a notebook cell does."""
    globals()[name] = value


held, inner = np.array([2.0]), {"k": 2.0}
pulled = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.0 * q, force=lambda t, q, v, p: -inner["k"] * q)
CHANGES = {
    "a derivative of a global": (
        lambda point: jax.vmap(jax.grad(lambda x: times_k({"x": x})))(jnp.ones(2))[0], lambda: set_global("K", 5.0)
    ),
    "an array closed over": (closing_over(held), lambda: held.__setitem__(0, 6.0)),
    "a number in a dictionary that a force reads": (
        lambda point: lj.accelerations(pulled, 0.0, point["x"], 0.0, None)[0], lambda: inner.update(k=11.0)
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", CHANGES)
def test_what_has_changed_is_seen(what):
    """After each change the values match the function; before it, a second sweep compiles nothing."""
    run, change = CHANGES[what]
    axes = xs(3)
    exact = lambda: [run({"x": x}) for x in axes["x"]]
    before = exact()
    np.testing.assert_allclose(quiet(run, axes).values, before, rtol=1e-14)
    with compiles() as found:
        quiet(run, axes)
    assert found == []
    change()
    assert not np.allclose(exact(), before)
    np.testing.assert_allclose(quiet(run, axes).values, exact(), rtol=1e-14)


def test_settings_of_jax_are_part_of_it():
    """In float32 the same function gives another program."""
    run = lambda point: jnp.asarray(0.1) * point["n"]
    in_double = quiet(run, {"n": np.arange(4, dtype=np.int32)})
    with jax.enable_x64(False):
        in_single = quiet(run, {"n": np.arange(4, dtype=np.int32)})
    assert (in_double.values.dtype, in_single.values.dtype) == (np.float64, np.float32)


def test_a_run_that_draws_numbers():
    """A function that computes something else each time is compiled each time: a new random number is drawn."""
    random = np.random.default_rng(0)
    run = lambda point: random.normal() * point["x"]
    assert quiet(run, xs(3)).values[0] != quiet(run, xs(3)).values[0]


def test_a_long_compile_is_announced(monkeypatch, capsys):
    """A message is shown while it lasts, if progress is shown; a program from the cache shows none."""
    monkeypatch.setattr(meter, "LONG", 0.05)
    monkeypatch.setattr(meter, "TICK", 0.05)

    def slow(point):
        threading.Event().wait(0.3)
        return point["x"]

    for progress, words in ((False, False), (True, True), (True, False)):
        # The first sweep uses another dtype than the second, so both compile.
        lj.sweep(slow, {"x": xs(3)["x"].astype(np.float64 if progress else np.float32)}, progress=progress)
        assert ("compiling" in capsys.readouterr().err) == words


def test_the_structure_of_the_values_counts():
    """The same numbers in another structure are not taken for the first; twin: the second compiles once, too."""
    one, two = (lambda point: {"a": 2.0 * point["x"]}), (lambda point: (2.0 * point["x"],))
    for run, structure in ((one, dict), (two, tuple), (one, dict)):
        assert isinstance(quiet(run, xs(3)).values, structure)
    with compiles() as found:
        quiet(two, xs(3))
    assert found == []


@pytest.mark.slow
def test_a_second_sweep_compares_little(monkeypatch):
    """Of a motion's program, which JAX traced before, a second sweep compares no equation; twin: the first."""
    # Programs inside it that earlier tests used are known already.
    jax.clear_caches()
    calls, whole = [], jaxpr.meaning_of
    monkeypatch.setattr(identity, "meaning_of", lambda jaxpr: calls.append(jaxpr) or whole(jaxpr))
    fall = lj.System(lambda t, q, v, p: 0.5 * v**2 - p * q)
    run = lambda point: lj.integrate(fall, 0.0, 0.0, point["x"], ts=jnp.array([0.0, 1.0])).q[-1]
    counts = []
    for _ in range(2):
        calls.clear()
        np.testing.assert_allclose(quiet(run, xs(5)).values, -xs(5)["x"] / 2, rtol=1e-12)
        counts.append(len(calls))
    assert counts[0] > 50 and counts[1] < 20


def test_values_that_are_traced():
    """A sweep in a derivative, a program or lanes of a value that its run reads is refused; twin: as an axis."""

    def total(k):
        return jnp.sum(quiet(lambda point: k * point["x"], xs(3)).values)

    for transformed in (jax.grad(total), jax.jit(total), lambda k: jax.vmap(total)(jnp.array([k]))):
        with pytest.raises(TypeError, match="(?s)uses a value from outside that is being traced.*jax.vmap in place"):
            transformed(2.0)
    slopes = quiet(lambda point: jax.grad(lambda k: k * point["x"])(point["k"]), xs(3) | {"k": np.array([2.0])})
    assert np.array_equal(slopes.values[:, 0], xs(3)["x"])
