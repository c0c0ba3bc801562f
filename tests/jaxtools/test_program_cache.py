"""Programs of many systems in one process: only a limited number is kept, whatever they compute."""

import gc
import weakref
from importlib import import_module

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools import memory_maps, program_cache
from lagjax.jaxtools.compiled import compiled
from lagjax.jaxtools.tracing import TRACES
from tests.counting import compiles
from tests.plain import not_plain

MANY = 24


@eqx.filter_jit
def inside(function, x):
    """A part of a program whose traces JAX keeps."""
    return function(x)


@compiled
def called(function, x):
    """A compiled program that holds a function of the user's."""
    return inside(function, x)


def waves(number):
    """A function unlike any other, with more than one kernel."""
    return lambda x: jnp.cumsum(jnp.sin(x + number)) @ jnp.sort(jnp.cos(number * x))


def maps():
    """The number of memory maps of this process."""
    gc.collect()
    return memory_maps.MAPS.read_bytes().count(b"\n") if memory_maps.MAPS.exists() else 0


def call(number, x):
    """Call a function that nothing here keeps; return a weak reference to it."""
    function = waves(number)
    called(function, x)
    return weakref.ref(function)


def after_many(x):
    """How many of many functions, each called once, still exist, and how many maps the later half added."""
    functions = [call(number, x) for number in range(MANY // 2)]
    before = maps()
    functions += [call(number, x) for number in range(MANY // 2, MANY)]
    grown = maps() - before
    return sum(function() is not None for function in functions), grown


@not_plain
def test_programs_are_bounded(monkeypatch):
    """Functions are released and maps freed; the twin, without a limit, keeps all."""
    monkeypatch.setattr(program_cache, "_programs", program_cache.OrderedDict())
    there, grown_at_all = after_many(np.ones(8))
    assert there == MANY
    monkeypatch.setattr(program_cache, "AT_MOST", 5)
    there, grown = after_many(np.ones(9))
    assert there <= 5 >= len(program_cache._programs)
    if memory_maps.MAPS.exists():
        assert grown_at_all > MANY / 2 and grown < grown_at_all / 3


def test_traces_would_keep_functions(monkeypatch):
    """Twin: if only the program is dropped, JAX's traces still keep its functions."""
    monkeypatch.setattr(program_cache, "AT_MOST", 5)
    monkeypatch.setattr(program_cache, "forget_traces", lambda: None)
    assert after_many(np.ones(7))[0] == MANY


def test_the_last_ones_stay(monkeypatch):
    """The programs used last are not compiled again after others were dropped; twin: one unused for long is."""
    monkeypatch.setattr(program_cache, "_programs", program_cache.OrderedDict())
    monkeypatch.setattr(program_cache, "AT_MOST", 5)
    x, functions = np.ones(10), [waves(number) for number in range(9)]
    for function in functions:
        called(functions[0], x)
        called(function, x)
    with compiles() as found:
        called(functions[0], x)
        called(functions[-1], x)
    assert not found
    with compiles() as found:
        called(functions[1], x)
    assert found


def test_scarce_maps_drop_more(monkeypatch):
    """Half of many programs are dropped; the last few stay even then."""
    monkeypatch.setattr(
        program_cache, "_programs", program_cache.OrderedDict((number, object()) for number in range(100))
    )
    monkeypatch.setattr(program_cache, "share_used", lambda: 0.9)
    counts = []
    for number in range(100, 105):
        assert program_cache.kept(number, lambda number=number: number) == number
        counts.append(len(program_cache._programs))
    assert counts == [51, 26, 14, 9, 9] and [*program_cache._programs][-5:] == [100, 101, 102, 103, 104]
    monkeypatch.setattr(program_cache, "share_used", lambda: 0.1)
    assert program_cache.kept("another", object) and len(program_cache._programs) == counts[-1] + 1


@pytest.mark.parametrize("of", ["function", "argument"])
def test_a_key_is_all_that_a_program_is_compiled_for(of):
    """Other static arguments, or another function, give another program."""
    other = compiled(lambda function, x: -function(x)) if of == "function" else called
    one, two = waves(1), waves(1 if of == "function" else 2)
    x = np.ones(4)
    assert float(called(one, x)) != float(other(one if of == "function" else two, x))


@pytest.mark.parametrize(("module", "name"), TRACES)
def test_what_is_forgotten_is_there(module, name):
    """A cache that JAX has renamed would silently not be cleared."""
    assert callable(getattr(import_module(module), name).cache_clear)
