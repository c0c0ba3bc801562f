"""What `explain` says of a motion in phases: each phase, the guards at the state, and the graph."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj


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


@pytest.fixture(scope="module")
def explanation():
    """The explanation of a stone that slides on the table at speed 2."""
    touches = lj.touches(lambda t, q, params: q["y"], 0.5)
    switches = [
        lj.Switch("flying", to="flying", when=touches, rest="sliding"),
        lj.Switch("sliding", to="flying", when=edge),
        lj.Switch("sliding", to="flying", when=lj.releases("table")),
    ]
    return lj.explain(lj.Hybrid(PHASES, switches), 0.0, {"x": 1.0, "y": 0.0}, {"x": 2.0, "y": 0.0})


def test_phases_and_guards(explanation):
    """Degrees of freedom of each phase, guards with its own multipliers, and phases without a way in or out."""
    assert [found.degrees_of_freedom for found in explanation.phases.values()] == [2, 1, 2]
    assert [(phase, to) for phase, to, _, _ in explanation.switches] == [
        ("flying", ("flying", "sliding")), ("sliding", ("flying",)), ("sliding", ("flying",)),
    ]  # fmt: skip
    assert [value for *_, value in explanation.switches] == [0.0, 2.0, 10.0]
    assert explanation.unreachable == explanation.final == ("lost",)
    words = repr(explanation)
    assert "-> flying, when edge reaches zero, now 2" in words
    assert "no switch leads here; no switch leaves it" in words and "held by 'table'" in words


def test_elsewhere_guards_have_no_value():
    """The guards of a phase to which the state does not belong are not evaluated."""
    hybrid = lj.Hybrid(PHASES, [lj.Switch("sliding", to="flying", when=lj.releases("table"))])
    found = lj.explain(hybrid, 0.0, {"x": 1.0, "y": 5.0}, {"x": 2.0, "y": 0.0})
    assert found.switches[0][3] is None and "now" not in repr(found)


def test_picture(explanation):
    """The picture has a name for each phase, and an arrow for each switch."""
    axis = explanation.plot().axes[0]
    words = [text.get_text() for text in axis.texts]
    assert [word for word in words if word] == ["touches", "touches", "edge", "releases", *PHASES]


def test_it_says_what_a_first_answer_costs():
    """One term for `vmap` is a fraction of the operations of forty terms in a loop, and of the time; twin: of two."""

    def springs(count):
        def in_a_loop(t, q, v, params):
            return 0.5 * v @ v - sum(0.25 * (q[i + 1] - q[i]) ** 4 for i in range(count - 1))

        return lj.System(in_a_loop), np.linspace(0.0, 1.0, count), np.zeros(count)

    def seconds(system, q, v):
        row = dict(lj.explain(system, 0.0, q, v).rows)["first answer"]
        assert "operations" in row
        return float(row.split()[1])

    (many, q, v), (few, *two) = springs(40), springs(2)
    once = lj.System(lambda t, q, v, params: 0.5 * v @ v - 0.25 * jnp.sum((q[1:] - q[:-1]) ** 4))
    assert seconds(many, q, v) > 2 * seconds(once, q, v) and seconds(few, *two) <= seconds(once, q, v)
