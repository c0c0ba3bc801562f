"""Each rule refuses what is wrong with the value, the usual cause and the fix in its words, and lets the rest pass."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax import refusals as rules
from lagjax.refusals import shown

SPEED = lambda t, q: q
SOLVER = diffrax.AbstractSolver
PAIR = {"x": 1.0, "y": np.zeros(2)}
IDS = lambda row: getattr(row, "__name__", "") if callable(row) else ""
# A rule, arguments that pass, such that are refused, the error, and the message.
RULES = [
    (rules.must, (True, "dt must be positive", 1.0), (False, "dt must be positive", -1.0, "dt=0.1", "a sign"),
     ValueError,
     "dt must be positive, not -1.0.\nUsual cause: a sign.\nFix: dt=0.1."),
    (rules.must_be, (int | None, None, "n must be a number"), (int, "3", "n must be a number", "n=3"), TypeError,
     "n must be a number, not '3'.\nFix: n=3."),
    (rules.must_be, (SOLVER, diffrax.Tsit5(), ""), (SOLVER, diffrax.Tsit5, "method must be one"), TypeError,
     "method must be one, not the class Tsit5.\nUsual cause: missing brackets.\nFix: method=diffrax.Tsit5()."),
    (rules.must_be_function, (SPEED, "gap", "(t, q)"), (0.5, "gap", "(t, q)"), TypeError,
     "gap must be a function of (t, q), not 0.5.\nFix: gap=lambda t, q: ..., the function itself and not its value."),
    (rules.must_be_function, (None, "gap", "t", "", "", True), (None, "gap", "t", "f"), TypeError,
     "gap must be a function of t, not None.\nFix: f."),
    (rules.must_be_among, (("found", None), None, "jumps"), (("ignored", "found"), "fuond", "jumps"), ValueError,
     "jumps must be 'ignored' or 'found', not 'fuond'.\nFix: jumps='found'."),
    (rules.must_be_among, ((2, 4), np.int64(4).item(), "order"), ((2, 4), np.zeros(2), "order"), ValueError,
     "order must be 2 or 4, not [0.0, 0.0].\nFix: order=2."),
    (rules.must_be_whole, (np.int32(1), "most"), (1e6, "most"), ValueError,
     "most must be a whole number above zero, not 1000000.0.\nUsual cause: 1e6, which is a float.\nFix: most=1000000."),
    (rules.must_be_whole, (0, "n", 0), (True, "n", 0), ValueError,
     "n must be a whole number of at least 0, not True.\nFix: n=1."),
    (rules.must_be_whole, (2000, "n", 1, 2000), (2**70, "n", 1, 2000), ValueError,
     f"n must be a whole number from 1 to 2,000, not {2**70}.\nFix: n=2000."),
    (rules.must_be_finite, (np.ones(3), "ts"), ([[0.0, np.nan]], "ts", "finite times"), ValueError,
     "there is NaN or infinity in ts: nan at [0, 1].\nFix: finite times."),
    (rules.must_be_like, (PAIR, PAIR, "v", "q", ""), ({"x": 0}, PAIR, "v", "q", "both", "one left out"), ValueError,
     "v must be like q, in structure and shapes: q has {'x': (), 'y': (2,)}, and it has {'x': ()}.\n"
     "Usual cause: one left out.\nFix: both."),
    (rules.must_be_single, ((), "this motion", ""), ((3, 2), "this motion", "{traj}.draw()"), ValueError,
     "this motion is a batch of shape (3, 2): take one lane of it.\nFix: jax.tree.map(lambda x: x[0], traj).draw()."),
    (rules.must_name, ([], (), "angles names", "angle"), (["psi"], (), "angles names", "angle"), ValueError,
     "angles names 'psi', which is no angle; there are none.\nFix: leave it out."),
    (rules.must_name, ("psi", PAIR | {"psi": 0}, "hold names", "angle"), 
     (["y", "thte"], {"y": 0, "theta": 1}, "hold names", "angle", "hold='{}'", "a letter", TypeError), TypeError,
     "hold names 'thte', which is no angle; there are 'y' and 'theta'.\nUsual cause: a letter.\nFix: hold='theta'."),
    (rules.must_differ, (["a", "b"], ""), (["b", "a", "b"], "two bodies"), ValueError,
     "two bodies are called 'b'.\nFix: a name for each."),
    (rules.must_return, (True, "L(t, q)", "a number", 1.0, ""), 
     (False, "L(t, q)", "a number", jax.ShapeDtypeStruct((2,), "int32"), "jnp.sum", "a vector"), ValueError,
     "L(t, q) must return a number, and returned shape (2,), int32.\nUsual cause: a vector.\nFix: jnp.sum."),
    (rules.must_not_meet, ({"a": None, "b": 0.0}, ""), ({"a": 1, "b": 0.0}, "one is enough"), ValueError,
     "a and b exclude each other: one is enough.\nFix: leave one of them out."),
    (rules.must_go_together, ({"a": 1, "b": 2}, "", ""), ({"a": 1, "b": None}, "it takes two", "b=2"), ValueError,
     "a is given, but b is not: it takes two.\nFix: b=2."),
    (rules.installed, ("math", "this", "data"), ("no_such_package", "this", "data"), ImportError,
     'this needs no_such_package, an optional extra.\nFix: pip install "lagjax[data]".'),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "well", "bad", "error", "message"), RULES, ids=IDS)
def test_rules(rule, well, bad, error, message):
    """What is right passes, what is wrong raises exactly this."""
    rule(*well)
    with pytest.raises(error) as caught:
        rule(*bad)
    assert type(caught.value) is error and str(caught.value) == message


def test_traced():
    """Values that JAX traces are refused where they are needed, and pass where only they could be wrong."""
    for eager, given in ((False, lambda x: x), (True, lambda x: None)):
        rules.must_have_values(1.0, "a picture needs numbers", eager=eager)
        with pytest.raises(
            TypeError, match=re.escape("needs numbers, and JAX is tracing.\nFix: call it outside of jax.jit")
        ):
            jax.make_jaxpr(lambda x: rules.must_have_values(given(x), "a picture needs numbers", eager=eager))(1.0)
    assert jax.make_jaxpr(lambda x: rules.must_be_finite(x, "ts"))(np.nan)


def test_shown():
    """What was given is told in a few words."""
    long = "x" * 100
    told = {
        "a function": lambda: 0, "the function 'shown'": shown, "the class Tsit5": diffrax.Tsit5,
        "a Tsit5": diffrax.Tsit5(), "an Event": diffrax.Event(SPEED), "[1.0, 2.0]": jnp.array([1.0, 2.0]),
        "0.5": np.float64(0.5), "{'a': 1}": {"a": 1}, f"shape (20,), {np.dtype(float)}": np.zeros(20),
        repr(long)[:60]: long, "None": None,
    }  # fmt: skip
    assert {words: shown(x) for words, x in told.items()} == {words: words for words in told}
