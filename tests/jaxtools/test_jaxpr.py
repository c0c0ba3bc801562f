"""Programs as data: tables of primitives, each by its name in the installed JAX; chains of one call become loops."""

import sys
from functools import cache

import diffrax  # noqa: F401  (with the primitives of equinox that it uses)
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Primitive, jaxpr_as_fun

from lagjax.jaxtools import dependence, fuse, jaxpr, scalarize
from lagjax.jaxtools.fuse import STAYS_A_CALL, marked
from lagjax.jaxtools.jaxpr import anywhere, applied, depends, interpreted, length, without_chains

# From jax 0.11.1 on there are none of these.
UP_TO_0_11_0 = {"closed_call"}
TABLES = {
    f"{module.__name__.removeprefix('lagjax.')}.{name}": set(table)
    for module in (jaxpr, fuse, scalarize, dependence)
    for name, table in vars(module).items()
    if name.isupper() and name not in ("ONE_KERNEL", "STAYS_A_CALL") and isinstance(table, (set, dict))
    if all(isinstance(key, str) for key in table)
}


def primitives():
    """The names of all primitives that JAX, equinox, lineax and lagjax have defined, in the modules that are loaded."""
    # The primitive of the marks is not a variable of any module.
    program = jax.make_jaxpr(lambda x: marked(jnp.sin(x), STAYS_A_CALL))(1.0)
    found = {equation.primitive.name for equation in program.eqns}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("jax", "equinox", "lagjax", "lineax"):
            found |= {x.name for x in list(vars(module).values()) if isinstance(x, Primitive)}
    return found


def unknown(table):
    """The names of a table that belong to no primitive."""
    gone = UP_TO_0_11_0 if jax.__version_info__ >= (0, 11, 1) else set()
    return sorted(table - primitives() - gone)


@pytest.mark.parametrize("table", TABLES)
def test_each_name_is_one(table):
    """Every name is known: a primitive that JAX has renamed would silently be treated as unknown, and be slower."""
    assert unknown(TABLES[table]) == []


def test_the_tables_are_found():
    """Twin: all of the modules have tables, and a misspelt name is noticed."""
    found = {name.rsplit(".", 1)[0].split(".")[-1] for name in TABLES}
    assert found == {"jaxpr", "fuse", "scalarize", "dependence"}
    assert unknown({"sin", "sine"}) == ["sine"]


OTHERWISE_CALLED = {"and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not}
OF_WHOLE_NUMBERS = {"and", "or", "not"}


def operands_of(name):
    """Some numbers of both signs, equal ones among them."""
    numbers = np.array([-3, 0, 2, 5]), np.array([4, -1, 2, -2])
    operands = numbers if name in OF_WHOLE_NUMBERS else tuple(0.7 * x for x in numbers)
    if name == "select_n":
        return np.array([True, False, True, False]), *operands
    return operands[:1] if name in ("abs", "neg", "not", "square") else operands


@cache
def by_jax():
    """What the primitives of the table give, by name, in the order of one program, which has them alone."""
    functions = [OTHERWISE_CALLED.get(name) or getattr(lax, name) for name in jaxpr.IN_NUMPY]
    all_of = lambda operands: [f(*x) for f, x in zip(functions, operands)]
    operands = list(map(operands_of, jaxpr.IN_NUMPY))
    assert [e.primitive.name for e in jax.make_jaxpr(all_of)(operands).eqns] == list(jaxpr.IN_NUMPY)
    return dict(zip(jaxpr.IN_NUMPY, jax.jit(all_of)(operands)))


def the_same_in_numpy(name):
    """Whether a primitive and the table's NumPy function agree."""
    return np.array_equal(by_jax()[name], jaxpr.IN_NUMPY[name](*operands_of(name)))


@pytest.mark.parametrize("name", jaxpr.IN_NUMPY)
def test_numpy_does_the_same(name):
    """NumPy's functions agree with the primitives on numbers of both signs, equal ones among them."""
    assert the_same_in_numpy(name)


def test_another_function_would_be_seen(monkeypatch):
    """Twin: "less" in place of "less or equal" is noticed."""
    monkeypatch.setitem(jaxpr.IN_NUMPY, "le", np.less)
    assert not the_same_in_numpy("le")


def below(x, count=100):
    """The floating-point number that is `count` places below x."""
    for _ in range(count):
        x = eqxi.prevbefore(x)
    return x


@jax.jit
def inside(x):
    """The chain in a function and in a loop."""
    return jax.lax.fori_loop(0, 2, lambda _, x: below(x, 50), x)


@pytest.mark.parametrize("function", [below, inside])
def test_a_chain_becomes_a_loop(function):
    """The same number and derivative, from a program less than a fifth as long."""
    program = jax.make_jaxpr(function)(1.0)
    looped = without_chains(program)
    assert length(looped.jaxpr) < 0.2 * length(program.jaxpr)
    (found,), (slope,) = jax.jit(lambda x: jax.jvp(jaxpr_as_fun(looped), (x,), (jnp.ones_like(x),)))(3.7)
    assert found == np.float64(3.7) - 100 * np.spacing(np.float64(3.0))
    assert slope == 1.0


def test_what_is_no_chain_stays():
    """Short chains, chains of different calls, and chains whose members are used elsewhere stay."""

    def used(x):
        every = [x]
        for _ in range(30):
            every.append(eqxi.prevbefore(every[-1]))
        return jnp.stack(every)

    def other(x):
        for _ in range(15):
            x = eqxi.nextafter(eqxi.prevbefore(x))
        return x

    for function in (lambda x: below(x, 15), used, other, lambda x: x):
        program = jax.make_jaxpr(function)(1.0)
        assert without_chains(program) is program


@jax.custom_jvp
def sine(x):
    """A call with a rule of its own."""
    return jnp.sin(x)


sine.defjvps(lambda dx, value, x: jnp.cos(x) * dx)
TABLE = np.arange(3.0)


def calls(x):
    """Calls of both kinds, one inside the other, a constant, and a loop, which is not a call."""
    inner = jax.jit(lambda x: sine(x) + TABLE)
    return inner(x) * 2.0, jax.lax.fori_loop(0, 3, lambda _, x: 2.0 * x, x)


def entered(enters=None):
    """The results of a program by `interpreted`, the primitives that it met, and JAX's results."""
    program, met = jax.make_jaxpr(calls)(np.ones(3)), []

    def rule(equation, operands):
        met.append(equation.primitive.name)
        return applied(program.jaxpr, equation, operands)

    in_turn = lambda x: interpreted(program, [x], rule, lambda x, aval: jnp.asarray(x, aval.dtype), enters)
    found, expected = jax.jit(lambda x: (in_turn(x), calls(x)))(np.array([0.1, 0.2, 0.3]))
    return found, met, expected


def test_a_program_is_interpreted():
    """With arrays as values it gives the program's results; calls are entered, a loop is one primitive."""
    found, met, expected = entered()
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    assert {"sin", "add", "mul"} <= set(met) and not {"jit", "custom_jvp_call"} & set(met)
    assert {"scan", "while"} & set(met)


def test_calls_that_are_not_entered():
    """Twin: calls that are not entered stay primitives, which the rule evaluates."""
    _, met, _ = entered(lambda equation: equation.primitive.name == "jit")
    assert "custom_jvp_call" in met and "sin" not in met


def test_what_is_anywhere_in_a_program():
    """An equation inside a loop is found, and a program is looked through once; twin: none in another one."""
    looked_at = []
    has_sine = anywhere(lambda equation: looked_at.append(equation) or equation.primitive.name == "sin")
    looped = jax.make_jaxpr(lambda x: jax.lax.fori_loop(0, 3, lambda _, x: jnp.sin(x), x))(1.0).jaxpr
    for _ in range(2):
        assert has_sine(looped) and not has_sine(jax.make_jaxpr(jnp.cos)(1.0).jaxpr)
    seen = len(looked_at)
    assert seen >= 3 and has_sine(looped) and len(looked_at) == seen


def test_what_depends_on_an_input():
    """A call is looked into: it may take an input that its results do not need; twin: a call that needs it."""
    first, both = (jax.jit(f) for f in (lambda x, t: 2 * x, lambda x, t: x + t))

    def seen(function):
        program = jax.make_jaxpr(lambda x, t: function(x, t)[None])(1.0, 2.0).jaxpr
        return [depends(program, [x]) for x in program.invars]

    assert seen(first) == [True, False] and seen(both) == [True, True]
