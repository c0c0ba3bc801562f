"""Programs as data: tables of primitives, each by its name in the installed JAX; chains of one call become loops.

Programs with the same meaning are equal, whatever objects they consist of; others are not.
"""

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
from lagjax.jaxtools.jaxpr import (
    Itself,
    anywhere,
    applied,
    callbacks_in_turn,
    content_of,
    depends,
    interpreted,
    length,
    meaning_of,
    rule_follows,
    rules_of,
    with_own_constants,
    without_chains,
    without_repeats,
)
from tests.jaxtools.in_numpy import evaluated, run

# From jax 0.11.1 on there are none of these.
UP_TO_0_11_0 = {"closed_call"}
TABLES = {
    f"{module.__name__.removeprefix('lagjax.')}.{name}": set(table)
    for module in (jaxpr, fuse, scalarize, dependence)
    for name, table in vars(module).items()
    if name.isupper() and name not in ("ONE_KERNEL", "STAYS_A_CALL") and isinstance(table, (set, dict))
    # The rules of functions with rules of their own are known by their names in older versions, too.
    if all(isinstance(key, str) for key in table) and (module, name) != (jaxpr, "RULES")
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


RULES = np.arange(300.0)


def meaning(function, *args):
    """The meaning of a function at some arguments, with the content of its constants."""
    closed = jax.make_jaxpr(function)(*(args or (1.0,)))
    return meaning_of(closed.jaxpr), tuple(map(content_of, closed.consts))


def scaled(factor):
    """A function that is made anew at each call, with a function and a loop inside."""
    inner = jax.jit(lambda x: jnp.sin(x) * factor)
    return lambda x: jax.lax.fori_loop(0, 3, lambda _, x: inner(x), x)


def test_the_same_again():
    """Functions made anew with the same numbers are equal, and so are their hashes."""
    assert meaning(scaled(2.0)) == meaning(scaled(2.0)) and hash(meaning(scaled(2.0))) == hash(meaning(scaled(2.0)))
    assert meaning(lambda x: x + RULES) == meaning(lambda x: x + RULES.copy())


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (scaled(2.0), scaled(3.0)),
        (lambda x: x - 1.0, lambda x: 1.0 - x),
        (lambda x: x * 0.0, lambda x: x * -0.0),
        (lambda x: x + RULES, lambda x: x + RULES[::-1]),
        (lambda x: (x, 2 * x), lambda x: (2 * x, x)),
        (lambda x: jnp.sum(x * jnp.ones((2, 3)), axis=0), lambda x: jnp.sum(x * jnp.ones((2, 3)), axis=1)),
    ],
    ids=["number", "order", "sign of zero", "table", "results", "axis"],
)
def test_others_differ(one, other):
    """Twins: another number, order, sign of zero, table, order of results, or parameter of a primitive."""
    assert meaning(one) != meaning(other)


def test_types_count():
    """1 is not True, and single precision is not double."""
    assert content_of(1) != content_of(True) and content_of(np.float32(1.0)) != content_of(1.0)
    assert meaning(lambda x: 2 * x, 1.0) != meaning(lambda x: 2 * x, np.float32(1.0))
    assert Itself(RULES) == Itself(RULES) != Itself(RULES.copy())


def test_constants_of_inner_functions_become_its_own():
    """An array that a function inside holds is then a constant of the program, which computes the same."""
    inner = jax.jit(lambda x: x + RULES)
    own = with_own_constants(jax.make_jaxpr(lambda x: 2 * inner(x))(1.0))
    assert any(np.array_equal(x, RULES) for x in own.consts)
    np.testing.assert_array_equal(run(own, 1.0)[0], 2 * (1.0 + RULES))


def with_rule(slope):
    """x², with a rule of its own for the derivative."""
    square = jax.custom_jvp(lambda x: x * x)
    square.defjvps(lambda dx, value, x: slope(x) * dx)
    return square


def test_rules_that_follow_do_not_count():
    """A function whose rule follows from the program has it, and none that is compared; another's is compared."""

    def twice(kind):
        function = kind(lambda x: 1.0 * x)
        function.defjvp(lambda primals, tangents: (primals[0], 2 * tangents[0]))
        return function

    known, other = twice(rule_follows), twice(jax.custom_jvp)
    assert evaluated(jax.grad(known), 1.0) == [2.0]
    assert rules_of(known, jax.make_jaxpr(known)(1.0), 1.0) == ()
    assert rules_of(other, jax.make_jaxpr(other)(1.0), 1.0) != ()


def test_rules_of_differentiation_count():
    """Equal values with other rules are told apart by `rules_of` alone; without rules there is nothing to compare."""
    right, wrong = with_rule(lambda x: 2 * x), with_rule(lambda x: 3 * x)
    rules = lambda function: rules_of(function, jax.make_jaxpr(function)(1.0), 1.0)
    assert meaning(right) == meaning(wrong) and rules(right) != rules(wrong)
    assert rules(right) == rules(with_rule(lambda x: 2 * x)) and rules(jnp.sin) == ()


def on_host(function):
    """A function of the host's, which JAX cannot differentiate."""
    shape = jax.ShapeDtypeStruct((), float)
    return lambda x: jax.pure_callback(lambda x: np.asarray(function(x)), shape, x)


def with_slope(function, slope):
    """A function of the host's with its own derivative, which is of the host's too."""
    known = jax.custom_jvp(on_host(function))
    known.defjvp(lambda primals, tangents: (known(primals[0]), tangents[0] * on_host(slope)(primals[0])))
    return known


def test_rules_without_a_derivative_of_their_own():
    """A rule that calls the host has no second derivative, and one beside a loop none in reverse: nothing is refused,
    and functions are told apart."""
    half, other = with_slope(lambda x: x / 2, lambda x: 0.5), with_slope(lambda x: x / 2, lambda x: 0.7)
    rules = lambda function, user: rules_of(function, jax.make_jaxpr(function)(1.0), 1.0, user=user)
    assert rules(half, half) == rules(lambda x: half(x), half) != rules(other, other)

    def beside_a_loop(function):
        shrunk = lambda x: jax.lax.while_loop(lambda c: c > 2.0, lambda c: c / 2, x)
        return lambda x: function(x) + shrunk(x)

    relu = rules(beside_a_loop(jax.nn.relu), None)
    assert relu == rules(beside_a_loop(jax.nn.relu), None) != rules(beside_a_loop(jax.nn.softplus), None)


def test_callbacks_in_lanes():
    """A callback that does not say how it is put in lanes is called for one after the other; twin: JAX refuses."""
    function = lambda x: jax.lax.cond(x > 0, on_host(lambda x: x / 2), jnp.negative, x)
    lanes, closed = np.array([4.0, -1.0]), jax.make_jaxpr(function)(1.0)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jaxpr_as_fun(callbacks_in_turn(closed))))(lanes)[0], [2.0, 1.0])
    with pytest.raises(NotImplementedError, match="vmap is only supported"):
        jax.make_jaxpr(jax.vmap(jaxpr_as_fun(closed)))(lanes)


def repeated(q):
    """Sums of squares of partial sums, each built anew: the double loop of a chain."""
    total = 0.0
    for i in range(len(q)):
        partial_sum = 0.0
        for j in range(i + 1):
            partial_sum = partial_sum + jnp.where(q[j] > 0, jnp.cos(q[j]), 1.0)
        total = total + partial_sum**2
    return total


def test_repeats_are_written_once():
    """A double loop has as many operations as a single one, and gives the same bits; derivatives differ by round-off,
    as they are summed in another order."""
    q = np.linspace(-0.3, 1.2, 5)
    closed = jax.make_jaxpr(repeated)(q)
    short = closed.replace(jaxpr=without_repeats(closed.jaxpr))
    assert len(closed.eqns) > 15 * 5 and len(short.eqns) < 5 * 9
    assert run(short, q) == run(closed, q)
    for order in (jax.grad, lambda f: jax.jacfwd(jax.grad(f))):
        again, expected = (evaluated(order(f), q) for f in (lambda q: jaxpr_as_fun(short)(q)[0], repeated))
        np.testing.assert_allclose(again, expected, rtol=1e-13, atol=1e-13)


@jax.custom_jvp
def bent(x):
    """A square whose rule of differentiation says 5."""
    return x**2


@jax.custom_jvp
def bent_otherwise(x):
    """The same with 7."""
    return x**2


bent.defjvp(lambda x, dx: (bent(*x), 5.0 * dx[0]))
bent_otherwise.defjvp(lambda x, dx: (bent_otherwise(*x), 7.0 * dx[0]))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.arctan2(x * 0.0, -1.0) - jnp.arctan2(x * -0.0, -1.0),
        lambda x: bent(x) + bent_otherwise(x),
        lambda x: jax.jit(lambda y: bent(y))(x) + jax.jit(lambda y: bent_otherwise(y))(x),
        lambda x: (x / 7).astype(jnp.float32).astype(float) - 2 * (x / 7).astype(jnp.float16).astype(float),
        lambda x: x**2 - 2 * x**3,
    ],
    ids=["signs of zero", "rules", "rules inside", "dtypes", "parameters"],
)
def test_what_differs_is_not_a_repeat(function):
    """Zeros of other signs, rules of differentiation, dtypes and parameters keep operations apart."""
    closed = jax.make_jaxpr(function)(1.5)
    short = closed.replace(jaxpr=without_repeats(closed.jaxpr))
    value_and_slope = lambda f: evaluated(jax.value_and_grad(f), 1.5)
    assert value_and_slope(lambda x: jaxpr_as_fun(short)(x)[0]) == value_and_slope(function)
