"""What `explain` says of a motion in phases: each phase, the guards at the state, and the graph."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.explain import Explanation, _first_answer, equations_of, explained
from lagjax.system import coordinates
from lagjax.system.model import model_of


def lagrangian(t, q, v, params):
    """A stone above a table, of unit mass."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 10.0 * q["y"]


TABLE = lj.Holonomic(lambda t, q, params: q["y"])
PHASES = {
    "flying": lj.System(lagrangian),
    "sliding": lj.System(lagrangian, constraints={"table": TABLE}),
    "lost": lj.System(lagrangian),
}


def edge(t, q, v, params):
    """The distance to the edge of the table."""
    return 3.0 - q["x"]


SWITCHES = [
    lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, params: q["y"], 0.5), rest="sliding"),
    lj.Switch("sliding", to="flying", when=edge),
    lj.Switch("sliding", to="flying", when=lj.guards.releases("table")),
]
STATE = {"x": 1.0, "y": 0.0}, {"x": 2.0, "y": 0.0}


def by_hand(freedoms, *rows):
    """What is said of a phase."""
    return Explanation(("x", "y"), (), freedoms, freedoms, (), "definite", None, None, (("at", "t = 0"), *rows))


def of_phases(switches=SWITCHES, off=()):
    """The explanation of a stone at speed 2 on the table, from what is said of its phases; `off` the table."""
    said = {"flying": by_hand(2), "sliding": by_hand(1, *off), "lost": by_hand(2)}
    return explained(lj.Hybrid(PHASES, switches), said, coordinates.state(0.0, *STATE, None))


def check(found):
    """Guards have the values by each phase's own multipliers; phases without a way in or out are named."""
    assert [explanation.degrees_of_freedom for explanation in found.phases.values()] == [2, 1, 2]
    assert [(phase, to) for phase, to, _, _ in found.switches] == [
        ("flying", ("flying", "sliding")), ("sliding", ("flying",)), ("sliding", ("flying",)),
    ]  # fmt: skip
    assert [value for *_, value in found.switches] == [0.0, 2.0, 10.0]
    assert found.unreachable == found.final == ("lost",)
    words = repr(found)
    assert "-> flying, when edge reaches zero, now 2" in words
    assert "no switch leads here; no switch leaves it" in words


def test_phases_and_guards():
    """Guards with the multipliers of a phase, and phases without a way in or out; off a phase they have no value."""
    found = of_phases()
    check(found)
    axis = found.plot().axes[0]
    words = [text.get_text() for text in axis.texts]
    assert [word for word in words if word] == ["touches", "touches", "edge", "releases", *PHASES]
    elsewhere = of_phases(SWITCHES[2:], off=[("off the constraints", "by 5")])
    assert elsewhere.switches[0][3] is None and "now" not in repr(elsewhere)


@pytest.mark.slow
def test_explained_phases():
    """The same of phases that are explained, with their constraints; off a constraint its guard has no value."""
    found = lj.explain(lj.Hybrid(PHASES, SWITCHES), 0.0, *STATE)
    check(found)
    assert "held by 'table'" in repr(found)
    found = lj.explain(lj.Hybrid(PHASES, SWITCHES[2:]), 0.0, {"x": 1.0, "y": 5.0}, STATE[1])
    assert found.switches[0][3] is None and "now" not in repr(found)


def springs(count, at_once):
    """Equal springs in a row, in one term for all or in one for each."""

    def lagrangian(t, q, v, params):
        if at_once:
            return 0.5 * v @ v - 0.25 * jnp.sum((q[1:] - q[:-1]) ** 4)
        return 0.5 * v @ v - sum(0.25 * (q[i + 1] - q[i]) ** 4 for i in range(count - 1))

    return lj.System(lagrangian)


def test_it_says_what_a_first_answer_costs():
    """One term for `vmap` is a fraction of the operations of many terms in a loop, and of the time; twin: of two."""

    def seconds(count, at_once):
        s = coordinates.state(0.0, np.linspace(0.0, 1.0, count), np.zeros(count), None)
        row = _first_answer(equations_of(model_of(springs(count, at_once), *s), fast=True), s)
        assert "operations" in row
        return float(row.split()[1])

    once = seconds(12, True)
    assert seconds(12, False) > 2 * once and seconds(2, False) <= once
