"""What a function computes is its jaxpr: whatever its values come from, an answer is that of a fresh process."""

import contextvars
import copy
import functools
import gc
import os
import sys
import threading
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events.event import traced_guard
from lagjax.jaxtools import cache
from lagjax.system import coordinates, traced
from lagjax.system.checks import traced_system
from tests.by_numpy import network
from tests.counting import compiles
from tests.systems import PARAMS, TS, pendulum_lagrangian

VALUES = (9.81, 1.62, 3.7)
G = 9.81
BOX = types.SimpleNamespace(inner=None)
CONTEXT: contextvars.ContextVar = contextvars.ContextVar("gravity", default=0.0)


def weight():
    """A function that is defined anew."""
    return G


def helper(q):
    """Another one."""
    return q


class Planet:
    """A number below attributes and tables."""

    factor = 1.0

    def __init__(self):
        self.table, self.inner = {"g": 0.0}, types.SimpleNamespace(g=0.0)

    def by_table(self, t, q, v, p):
        return 0.5 * v**2 - self.table["g"] * q

    def __call__(self, t, q, v, p):
        return 0.5 * v**2 - self.inner.g * q


class Module(eqx.Module):
    """A module with a static number."""

    g: float = eqx.field(static=True)

    def __call__(self, t, q, v, p):
        return 0.5 * v**2 - self.g * q


def falling(read):
    """L with the number that `read()` returns."""
    return lambda t, q, v, p: 0.5 * v**2 - read() * q


def into(kept, key):
    """The function that puts a number into a list, a dictionary or an array."""
    return lambda g: kept.__setitem__(key, g)


def onto(thing, name, make=lambda g: g):
    """The function that sets an attribute to a number, or to what holds it."""
    return lambda g: setattr(thing, name, make(g))


# Each returns L and the function that sets the number which it reads, here or there.
in_a_global = lambda: (lambda t, q, v, p: 0.5 * v**2 - G * q, into(globals(), "G"))


def in_a_function_defined_anew():
    """In a function defined anew."""
    return falling(lambda: weight()), lambda g: globals().__setitem__("weight", lambda: g)


def in_a_cell():
    """In a cell."""
    number = 0.0

    def put(g):
        nonlocal number
        number = g

    return falling(lambda: number), put


def made(held, read, put):
    """In what is made anew each time: L with what `read` finds there, and what puts a number there."""
    return lambda: (lambda kept: (falling(lambda: read(kept)), put(kept)))(held())


def inside(kept, key, read=lambda kept, key: kept[key]):
    """In something with entries."""
    return made(lambda: copy.deepcopy(kept), lambda held: read(held, key), lambda held: into(held, key))


in_a_large_array = inside(np.zeros(20_000), 12_345)
inside_a_jitted_helper = inside(np.zeros(300), 3, lambda kept, key: jax.jit(lambda q: jnp.sum(kept * q))(1.0))


new = types.SimpleNamespace
in_a_list_of_a_dictionary = made(lambda: {"x": [0.0]}, lambda held: held["x"][0], lambda held: into(held["x"], 0))
in_a_new_object = made(new, lambda held: held.inner.g, lambda held: onto(held, "inner", lambda g: new(g=g)))
in_a_class = made(lambda: type("OfOne", (Planet,), {}), lambda cls: cls.factor, lambda cls: onto(cls, "factor"))
in_a_module = made(lambda: types.ModuleType("users"), lambda module: module.g, lambda module: onto(module, "g"))
# Threads have contexts of their own, and see the default.
in_a_context_variable = made(lambda: CONTEXT, lambda name: name.get(), lambda name: name.set)
in_a_static_field = made(lambda: BOX, lambda box: box.inner.g, lambda box: onto(box, "inner", Module))
in_an_array_of_jax = made(
    lambda: [jnp.zeros(300)],
    lambda held: held[0][250],
    lambda held: lambda g: held.__setitem__(0, held[0].at[250].set(g)),
)


def in_a_table_of_a_method():
    """In a table of a method."""
    planet = Planet()
    return planet.by_table, into(planet.table, "g")


def in_an_object_that_is_called():
    """In an object that is called."""
    planet = Planet()
    return planet, onto(planet, "inner", lambda g: types.SimpleNamespace(g=g))


def in_an_import():
    """In an import."""
    sys.modules["lagjax_test_constants"] = module = types.ModuleType("lagjax_test_constants")

    def lagrangian(t, q, v, p):
        import lagjax_test_constants  # pyright: ignore

        return 0.5 * v**2 - lagjax_test_constants.g * q

    return lagrangian, onto(module, "g")


def in_the_environment():
    """In the environment."""
    return falling(lambda: float(os.environ["LAGJAX_TEST_G"])), lambda g: os.environ.update(LAGJAX_TEST_G=str(g))


def in_a_default():
    """In a default."""
    held = np.zeros(1)
    return lambda t, q, v, p, k=held: 0.5 * v**2 - k[0] * q, into(held, 0)


def in_defaults_that_are_replaced():
    """In defaults that are replaced."""

    def lagrangian(t, q, v, p, k=0.0, *, more=0.0):
        return 0.5 * v**2 - (k + more) * q

    def put(g):
        lagrangian.__defaults__, lagrangian.__kwdefaults__ = (g - 1.0,), {"more": 1.0}

    return lagrangian, put


def in_a_partial():
    """In a partial."""
    held = {"g": 0.0}
    return functools.partial(lambda k, t, q, v, p: 0.5 * v**2 - k["g"] * q, held), into(held, "g")


def in_an_attribute_of_the_function():
    """In an attribute of the function."""

    def lagrangian(t, q, v, p):
        return 0.5 * v**2 - getattr(lagrangian, "g") * q

    return lagrangian, onto(lagrangian, "g")


def in_code_that_is_replaced():
    """In code that is replaced."""

    def lagrangian(t, q, v, p):
        return 0.5 * v**2

    return lagrangian, onto(
        lagrangian, "__code__", lambda g: eval(f"lambda t, q, v, p: 0.5 * v**2 - {g!r} * q").__code__
    )


def in_a_rule_of_differentiation():
    """In a rule of differentiation."""
    held = [0.0]

    @jax.custom_jvp
    def potential(q):
        return held[0] * q

    potential.defjvp(lambda primals, tangents: (held[0] * primals[0], held[0] * tangents[0]))
    return lambda t, q, v, p: 0.5 * v**2 - potential(q), into(held, 0)


HOLDERS = [f for name, f in list(globals().items()) if name.startswith(("in_", "inside_"))]
# A thread has a context of its own.
NO_THREADS = {in_a_context_variable}


def weight_at(system):
    """The weight of a unit mass, V(1)."""
    return float(lj.jacobi_integral(system, 0.0, 1.0, 0.0, None))


def in_a_thread(function, *args):
    """The result of a function called in another thread."""
    found = []
    thread = threading.Thread(target=lambda: found.append(function(*args)))
    thread.start()
    thread.join()
    return found[0]


def wrong_answers(rng, histories):
    """How many of the answers in so many random histories differ from the number that L then reads."""
    wrong, asked = 0, 0
    for number in range(histories):
        holder = HOLDERS[number % len(HOLDERS)]
        lagrangian, put = holder()
        system, g = lj.System(lagrangian), VALUES[rng.integers(3)]
        put(g)
        for _ in range(5):
            action = rng.integers(6)
            if action == 0:
                lagrangian, put = holder()
                g = VALUES[rng.integers(3)]
                put(g)
                system = lj.System(lagrangian)
            elif action == 1:
                system = copy.copy(system)
            elif action == 2:
                system = lj.System(lagrangian)
                gc.collect(0)
            else:
                g = VALUES[rng.integers(3)]
                put(g)
            apart = action == 3 and holder not in NO_THREADS
            found = in_a_thread(weight_at, system) if apart else weight_at(system)
            wrong, asked = wrong + (abs(found - g) > 1e-12), asked + 1
    return wrong, asked


def forget():
    """Drop all programs and facts."""
    for kept in (cache.PROGRAMS, cache.FACTS):
        kept.clear()


@pytest.mark.parametrize("histories", [2 * len(HOLDERS), pytest.param(320, marks=pytest.mark.exhaustive)])
def test_answers_of_random_histories(histories):
    """In random histories of changes every answer is that of a fresh process."""
    wrong, asked = wrong_answers(np.random.default_rng(0), histories)
    assert asked == 5 * histories and wrong == 0


def test_histories_would_show_it(monkeypatch):
    """Twin: if programs were kept by the shapes of arguments alone, answers would be wrong."""
    forget()
    with monkeypatch.context() as patched:
        patched.setattr(traced, "meaning_of", lambda jaxpr: len(jaxpr.eqns))
        wrong, _ = wrong_answers(np.random.default_rng(0), 15)
    forget()
    assert wrong > 15


def test_equal_functions_share_a_program():
    """What computes the same compiles once, however it is written; twins: another number, type, sign or array."""
    holders = [in_a_list_of_a_dictionary, in_a_new_object, in_a_cell]
    ones = [lj.System(lagrangian) for lagrangian, put in (holder() for holder in holders) for _ in [put(8.87)]]
    weight_at(ones[0])
    with compiles() as found:
        assert [weight_at(system) for system in ones] == [8.87] * 3
    assert found == []
    s = coordinates.state(0.0, 1.0, 0.0, None)
    arrays = np.ones(2), np.ones((2, 1)), np.ones(2, np.float32), np.ones(2, int), np.zeros(2), -np.zeros(2)
    systems = [lj.System(lambda t, q, v, p, k=k: 0.5 * v**2 + jnp.sum(k) * q) for k in (1.0, 2.0, 0.0, -0.0, *arrays)]
    programs = {getattr(traced_system(system, s).lagrangian, "program") for system in systems}
    assert len(programs) == 10


def test_large_arrays_are_arguments():
    """Other values of a large array compile nothing; twin: those of a small one do."""
    for size, most in ((5_000, 0), (3, 99)):
        held = np.zeros(size)
        system = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.sum(held) * q)
        weight_at(system)
        held[1] = 2.5
        with compiles() as found:
            assert weight_at(system) == 2.5
        assert (found == []) == (most == 0)


def test_what_names_nothing_outside_is_traced_once():
    """Libraries, builtins, numbers and functions like itself may be named; twins: tables, imports, random numbers."""
    names = {"jnp": jnp, "np": np}
    source = """
def helper(q): return sum([jnp.cos(q), np.pi])
def plain(t, q, v, params): return 0.5 * v**2 + helper(q) + params["k"] * q
def with_number(t, q, v, params): return 0.5 * v**2 + constant * q
def with_table(t, q, v, params): return 0.5 * v**2 + table[0] * q
def with_import(t, q, v, params):
    import time
    return 0.5 * v**2 + time.time() * q
def with_random(t, q, v, params): return 0.5 * v**2 + np.random.normal() * q
def with_default(t, q, v, params, k=1.0): return 0.5 * v**2 + k * q
def with_eval(t, q, v, params): return eval("constant") * q
"""
    exec(source, names)
    assert traced.names_outside(names["plain"]) is not None
    names |= {"constant": 1.0, "table": [1.0]}
    for name in ("with_table", "with_import", "with_random", "with_default", "with_eval"):
        assert traced.names_outside(names[name]) is None, name
    # The same number is the same function, in a cell too; another one is another.
    of = lambda g: lambda t, q, v, params: 0.5 * v**2 + g * q
    celled, first = of(1.0), traced.names_outside(names["with_number"])
    assert first is not None and first == traced.names_outside(names["with_number"])
    assert traced.names_outside(celled) is not None and traced.names_outside(of([1.0])) is None
    names["constant"] = 2.0
    assert first != traced.names_outside(names["with_number"])
    plain = lj.System(names["plain"])
    at = lambda: float(lj.jacobi_integral(plain, 0.0, 0.0, 0.0, {"k": 1.0}))
    np.testing.assert_allclose(at(), -1 - np.pi)
    # A function that is called may be another one the next time.
    exec("def helper(q): return 2.0 * jnp.cos(q)", names)
    np.testing.assert_allclose(at(), -2.0)
    del names["helper"]
    with pytest.raises(NameError):
        at()


def test_what_bodies_and_joints_compute_is_traced_once():
    """A joint and the energy of bodies hold numbers that nobody changes; twins: a mass from outside, another number."""
    held, ground = {"mass": 2.0}, lj.bodies.ground.at()
    energies = []
    for mass in (2.0, 2.0, 3.0, lambda params: params, lambda params: held["mass"]):
        bob = lj.bodies.Body("bob", mass, (1.0, 1.0, 1.0))
        system = lj.bodies.multibody([bob], {"pivot": lj.bodies.spherical(ground, bob.at((0.0, 0.0, 1.0)))})
        assert traced.names_outside(system.constraints["pivot"].function) is not None or callable(mass)
        energies.append(traced.names_outside(system.lagrangian))
    assert energies[0] == energies[1] and energies[2] not in (None, energies[0]) and energies[3] is not None
    assert energies[4] is None
    pose = lj.bodies.Pose.at((0.0, 0.0, -1.0))
    s = coordinates.state(0.0, {"bob": pose}, {"bob": pose.moving((1.0, 0.0, 0.0))}, None)
    first = traced_system(system, s).lagrangian
    held["mass"] = 4.0
    assert traced_system(system, s).lagrangian != first


def test_code_in_params_is_run():
    """A function among the parameters may read another number each time."""
    held = [1.0]
    params = {"potential": lambda q: held[0] * q}
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["potential"](q))
    for g in VALUES:
        held[0] = g
        assert float(lj.jacobi_integral(system, 0.0, 1.0, 0.0, params)) == g


def test_networks_in_params_are_code_of_libraries():
    """With them a force is traced once for all weights; twin: an activation of the user's own is run each time."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: params["net"](q[None]))
    cube = lambda x: x**3

    def program(activation):
        params = {"net": network(1, "scalar", 2, 1, activation=activation)}
        return getattr(traced_system(system, coordinates.state(0.0, 1.0, 0.0, params)).force, "program")

    assert program(jnp.tanh) is program(jnp.tanh)
    assert program(cube) is not program(cube)


def test_a_function_called_at_run_time():
    """What a program calls on the host reads its values then; equal callbacks share a program."""
    held = [1.0]
    shape = jax.ShapeDtypeStruct((), np.float64)
    read = lambda x: np.asarray(held[0] * x)

    def lagrangian(t, q, v, p):
        return 0.5 * v**2 - jax.lax.stop_gradient(jax.pure_callback(lambda x: read(x), shape, 1.0)) * q

    system = lj.System(lagrangian)
    for number, g in enumerate(VALUES):
        held[0] = g
        with compiles() as found:
            assert weight_at(system) == g
        assert number == 0 or found == []


def test_a_trajectory_keeps_what_was_read():
    """Its Jacobi integral is that of the function that it was integrated with; twin: the system has another one now."""
    held = [pendulum_lagrangian]
    system = lj.System(lambda *state: held[0](*state))
    motion = lj.integrate(system, 1.0, 0.0, PARAMS, ts=TS)
    held[0] = lambda t, q, v, p: 0.5 * v**2 - p["g"] * q
    np.testing.assert_allclose(motion.jacobi_integral(), -PARAMS["g"] / PARAMS["l"] * np.cos(1.0), rtol=1e-7)
    assert lj.jacobi_integral(system, 0.0, 1.0, 0.0, PARAMS) == PARAMS["g"]


def test_constraints_and_guards_are_read_again():
    """A constraint's residual and an event's guard, after a number that they read has changed."""
    held, state = {"length": 1.0}, coordinates.state(0.0, 3.0, 0.0, None)
    on_rod = lj.System(lambda t, q, v, p: 0.5 * v**2, {"rod": lj.Holonomic(lambda t, q, p: q - held["length"])})
    level = lambda t, q, v, p: q - held["length"]
    for held["length"] in (1.0, 2.0):
        residual = lj.constraint_residual(on_rod, *state)["rod"]
        guard = traced_guard("level", level, state._asdict())(*state)
        np.testing.assert_array_equal([residual, guard], 3.0 - held["length"])


SPRING = types.SimpleNamespace(k=1.0)


def by_default(k):
    """A spring's L with its stiffness by default."""
    return lambda t, q, v, p, k=k: 0.5 * v**2 - 0.5 * k * q**2


def by_keyword(k):
    """A spring's L with its stiffness by keyword."""

    def lagrangian(t, q, v, p, *, k=k):
        return 0.5 * v**2 - 0.5 * k * q**2

    return lagrangian


def by_attribute(k):
    """A spring's L with its stiffness by attribute."""
    SPRING.k = k
    return lambda t, q, v, p: 0.5 * v**2 - 0.5 * SPRING.k * q**2


def by_helper(k):
    """A spring's L with its stiffness by helper."""
    globals()["helper"] = lambda q: 0.5 * k * q**2
    return lambda t, q, v, p: 0.5 * v**2 - helper(q)


@pytest.mark.parametrize("lagrangian", [by_default, by_keyword, by_attribute, by_helper])
def test_traced_numbers_from_outside(lagrangian):
    """Derivatives by a number that L reads from outside, in both modes and in lanes: a = -k q."""
    acceleration = lambda k: lj.accelerations(lj.System(lagrangian(k)), 0.0, 2.0, 0.0, None)[0]
    slopes = lambda k: (jax.grad(acceleration)(k), jax.jacfwd(acceleration)(k), jax.vmap(acceleration)(k * np.ones(2)))
    for found in (*jax.jit(slopes)(3.0)[:2], jax.grad(acceleration)(3.0), jax.jit(slopes)(3.0)[2] / 3.0):
        np.testing.assert_allclose(found, -2.0, rtol=1e-14)


@pytest.mark.exhaustive
def test_motions_with_traced_numbers_from_outside():
    """d/dk cos(sqrt k) at k = 3, and the time 0.5 c of an event at q = c, for defaults of L and of a guard."""
    ts = np.array([0.0, 1.0])
    end = lambda k: lj.integrate(lj.System(by_default(k)), 1.0, 0.0, ts=ts).q[-1]
    exact = -np.sin(np.sqrt(3.0)) / (2 * np.sqrt(3.0))
    np.testing.assert_allclose([jax.grad(end)(3.0), jax.jit(jax.grad(end))(3.0)], exact, rtol=1e-9)
    free = lj.System(lambda t, q, v, p: 0.5 * v**2)
    level = lambda c: {"level": lj.Crossing(lambda t, q, v, p, c=c: q - c)}
    when = lambda c: lj.integrate(free, 0.0, 2.0, ts=10 * ts, events=level(c)).end.t
    np.testing.assert_allclose([jax.grad(when)(3.0), jax.jit(jax.grad(when))(3.0)], 0.5, rtol=1e-12)


TABLE_SHAPE = jax.ShapeDtypeStruct((), float)


@jax.custom_jvp
def table(q):
    """q / 8 by a table of the host's."""
    return jax.pure_callback(lambda q: np.asarray(q / 8), TABLE_SHAPE, q)


@table.defjvp
def _slope_of_table(at, tangents):
    slope = jax.pure_callback(lambda q: np.asarray(1 / 8 + 0 * q), TABLE_SHAPE, at[0])
    return table(at[0]), tangents[0] * slope


@pytest.mark.slow
def test_a_table_with_its_own_derivative():
    """A spring by a table of the host's, as a force: its acceleration, alone and in lanes, and cos(t/√8) over time."""
    spring = lj.System(lambda t, q, v, p: 0.5 * v**2, force=lambda t, q, v, p: -table(q))
    assert float(lj.accelerations(spring, 0.0, 0.7, 0.0, None)[0]) == -0.0875
    lanes = jax.jit(jax.vmap(lambda q: lj.accelerations(spring, 0.0, q, 0.0, None)[0]))(jnp.array([0.7, 0.2]))
    np.testing.assert_allclose(lanes, [-0.0875, -0.025], rtol=1e-15)
    ts = np.linspace(0.0, 9.0, 4)
    np.testing.assert_allclose(lj.integrate(spring, 0.7, 0.0, ts=ts).q, 0.7 * np.cos(ts / np.sqrt(8)), atol=1e-7)
