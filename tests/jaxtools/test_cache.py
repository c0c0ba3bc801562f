"""Programs of many systems in one process: only a limited number is kept, whatever they compute."""

import copy
import gc

import equinox as eqx
import jax
import numpy as np
import pytest

from lagjax.jaxtools import cache, compiled
from tests.counting import compiles
from tests.plain import not_plain


@eqx.filter_jit
def inside(function, x):
    """A part of a program whose traces JAX keeps."""
    return function(x)


@compiled
def called(function, x):
    """A compiled program that holds a function of the user's."""
    return inside(function, x)


def programs():
    """The number of compiled programs that this process holds."""
    gc.collect()
    return len(jax.local_devices()[0].client.live_executables())


@not_plain
def test_dropped_programs_are_freed(monkeypatch):
    """Of seven programs two stay, and the others are gone from XLA; twin: all stay where there is room."""
    held = []
    for room, x in ((16, np.ones(2)), (2, np.ones(3))):
        monkeypatch.setattr(cache, "PROGRAMS", cache.Recent(room))
        before = programs()
        for number in range(7):
            called(lambda x, number=number: number * x, x)
        held.append((programs() - before, len(cache.PROGRAMS)))
    assert held == [(7, 7), (2, 2)]


def test_traces_are_dropped_too(monkeypatch):
    """JAX's caches are cleared after as many programs were dropped as is said, and not before."""
    cleared = []
    monkeypatch.setattr(cache, "PROGRAMS", cache.Recent(5))
    monkeypatch.setattr(cache, "CLEAR_AFTER", 3)
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(number))
    for number in range(12):
        cache.program_of(number, object)
    assert cleared == [7, 10]


def test_the_last_ones_stay(monkeypatch):
    """The programs used last are not compiled again after others were dropped; twin: one unused for long is."""
    monkeypatch.setattr(cache, "PROGRAMS", cache.Recent(2))
    first, second, third = (lambda x, number=number: number * x for number in range(3))
    x = np.ones(10)
    compiled_now = []
    for function in (first, second, first, third, first, third, second):
        with compiles() as found:
            called(function, x)
        compiled_now.append(len(found) > 0)
    assert compiled_now == [True, True, False, True, False, False, True]


@pytest.mark.parametrize("of", ["function", "argument"])
def test_a_key_is_all_that_a_program_is_compiled_for(of):
    """Other static arguments, or another function, give another program."""
    other = compiled(lambda function, x: -function(x)) if of == "function" else called
    one, two = (lambda x: 2 * x), (lambda x: 3 * x)
    x = np.array(1.0)
    assert float(called(one, x)) != float(other(one if of == "function" else two, x))


def test_what_has_no_hash_is_found_each_time():
    """A result is remembered by its arguments; twin: for a list it is computed again."""
    asked = []
    ask = cache.once(lambda x: asked.append(x))
    for argument in (2.0, 2.0, [2.0], [2.0]):
        ask(argument)
    assert asked == [2.0, [2.0], [2.0]]


def test_a_tree_is_put_together_again():
    """Arrays and the rest give the tree, with `None` where it was; the rest is a key, also after a copy."""
    tree = {"a": np.ones(2), "b": None, "c": ("text", 3, np.float64(2.0))}
    arrays, rest = cache.hashable_partition(tree)
    again = copy.deepcopy(rest)
    assert again == rest and hash(again) == hash(rest) and len(arrays) == 2
    assert cache.same(again.combine(arrays), tree)
