"""What L reads from outside: a change is seen by the next call, whatever holds the value."""

import types
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.outside import read_by, up_to_date

G = 9.81
TABLE = np.array([1.0, 2.0])
LARGE = np.zeros(100_000)
SETTINGS = {"nested": {"g": [1.0, 2.0]}}
MODULE = types.ModuleType("constants_of_the_user")
MODULE.__file__ = "/home/user/constants.py"
setattr(MODULE, "g", 1.0)
THING = types.SimpleNamespace(g=1.0)
NET = eqx.nn.MLP(1, 1, 2, 1, key=jnp.array([0, 1], jnp.uint32))


def strength():
    """A function that L calls."""
    return G


def weight():
    """Another one, which a test replaces."""
    return G


class Potential:
    """A callable object."""

    def __init__(self):
        self.g = 1.0

    def __call__(self, t, q, v, p):
        return 0.5 * v**2 - self.g * q


def closed_over(value):
    """An L that holds an array."""
    return lambda t, q, v, p: 0.5 * v**2 - value[0] * q


def set_global(name, value):
    """Set a global of this module, as a notebook does."""
    globals()[name] = value


held = np.array([1.0])
potential = Potential()
CHANGES = {
    "a global": (lambda t, q, v, p: -G * q, lambda: set_global("G", 1.62)),
    "a global of a function called": (lambda t, q, v, p: -strength() * q, lambda: set_global("G", 3.7)),
    "a global read inside": (lambda t, q, v, p: (lambda q: -G * q)(q), lambda: set_global("G", 8.87)),
    "an array changed in place": (lambda t, q, v, p: TABLE[1] * q, lambda: TABLE.__setitem__(1, 5.0)),
    "a large array put in place of another": (lambda t, q, v, p: LARGE[7] * q, lambda: set_global("LARGE", LARGE + 1)),
    "an array closed over": (closed_over(held), lambda: held.__setitem__(0, 2.0)),
    "a list in a dictionary": (
        lambda t, q, v, p: SETTINGS["nested"]["g"][0] * q, lambda: SETTINGS["nested"]["g"].__setitem__(0, 7.0)
    ),
    "a module": (lambda t, q, v, p: MODULE.g * q, lambda: setattr(MODULE, "g", 2.0)),
    "an attribute": (lambda t, q, v, p: THING.g * q, lambda: setattr(THING, "g", 2.0)),
    "an object that can be called": (potential, lambda: setattr(potential, "g", 2.0)),
    "a partial": (partial(lambda k, t, q, v, p: k["g"] * q, TABLED := {"g": 1.0}), lambda: TABLED.update(g=2.0)),
    "a default": (lambda t, q, v, p, k=held: k[0] * q, lambda: held.__setitem__(0, 3.0)),
    "a network": (lambda t, q, v, p: NET(q[None])[0], lambda: set_global("NET", eqx.tree_at(
        lambda n: n.layers[0].bias, NET, jnp.ones(2)))),
    "a function defined anew": (
        lambda t, q, v, p: -weight() * q, lambda: set_global("weight", lambda: 2.0)
    ),
}  # fmt: skip


@pytest.mark.parametrize("where", CHANGES)
def test_what_is_read_is_seen(where):
    """Two readings agree while nothing changes, and differ after the change."""
    function, change = CHANGES[where]
    before = read_by(function)
    assert before and read_by(function) == before and hash(before) == hash(read_by(function))
    change()
    assert read_by(function) != before


fall = lj.System(lambda t, q, v, p: 0.5 * v**2 - G * q)


def test_the_next_call_has_the_new_value():
    """After gravity changed in the globals, evaluations at one state use the new value."""
    for g in (9.81, 1.62):
        set_global("G", g)
        np.testing.assert_allclose(lj.jacobi_integral(fall, 0.0, 1.0, 0.0, None), g, rtol=1e-15)
        np.testing.assert_allclose(lj.momentum(fall, 0.0, 1.0, 3.0, None), 3.0, rtol=1e-15)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("error")
def test_the_next_motion_has_the_new_value():
    """The same for a motion, by its closed form, and for a sweep."""
    for g in (9.81, 1.62):
        set_global("G", g)
        np.testing.assert_allclose(lj.accelerations(fall, 0.0, 0.0, 0.0, None)[0], -g, rtol=1e-15)
        traj = lj.integrate(fall, 3.0, 0.0, ts=np.array([0.0, 2.0]))
        np.testing.assert_allclose(traj.q[-1], 3 - 2 * g, rtol=1e-12)
        run = lambda point: lj.integrate(fall, point["q"], 0.0, ts=np.array([0.0, 2.0])).q[-1]
        swept = lj.sweep(run, {"q": np.array([1.0, 3.0])}, progress=False)
        np.testing.assert_allclose(swept.values, [1 - 2 * g, 3 - 2 * g], rtol=1e-12)


def test_what_reads_nothing_is_left_alone():
    """A system that reads only JAX's functions and constants stays the same object."""
    plain = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.cos(q) * jnp.pi, force=lambda t, q, v, p: -v)
    assert up_to_date(plain) is plain


def test_a_look_calls_nothing():
    """Reading, which every call does, does not call the functions, and an unchanged system stays equal."""

    def lagrangian(t, q, v, p):
        raise AssertionError("called")

    def reads(t, q, v, p):
        return 0.5 * v**2 + G * jnp.cos(q) - strength() * jnp.sum(TABLE) * jnp.sin(q) + lagrangian(t, q, v, p)

    system = up_to_date(lj.System(reads))
    assert up_to_date(system) == system
    set_global("G", 2 * G)
    assert up_to_date(system) != system
    set_global("G", G / 2)


def test_a_global_that_has_gone_is_a_change():
    """Of two equal functions, the first has lost a global, as after `del jnp`: the second one is used."""

    def made():
        names = {"jnp": jnp}
        exec("def swing(t, q, v, params): return 0.5 * v**2 + 41.0 * jnp.cos(q)", names)
        return names, lj.System(names["swing"])

    names, first = made()
    np.testing.assert_allclose(lj.momentum(first, 0.0, 0.5, 2.0, None), 2.0)
    del names["jnp"]
    _, second = made()
    np.testing.assert_allclose(lj.jacobi_integral(second, 0.0, 0.5, 0.0, None), -41.0 * np.cos(0.5))
    # Twin: the first one itself fails.
    with pytest.raises(NameError):
        lj.jacobi_integral(first, 0.0, 0.5, 0.0, None)
