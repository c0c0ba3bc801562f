"""What the programs of motions with switches show: time, coordinates on which nothing depends, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.monodromy import any_problem_of
from lagjax.system import State
from tests.analysis.test_flow import BELT, block, bouncing, bouncing_by_element, wheel

DRIVEN = {"A": 0.1, "omega": 2.0, "e": 0.5}
WALKS = {"l": 1.0, "g": 9.8125, "slope": 0.1, "alpha": 0.3}


def flat_lagrangian(t, q, v, p):
    """A unit mass in a vertical plane."""
    return 0.5 * jnp.sum(v**2) - q[1]


def height(t, q, p):
    """That over the floor."""
    return q[1]


def slope(t, q, p):
    """That over a slope."""
    return q[1] - 0.1 * q[0]


def on_touch(gap):
    """A ball that falls on a surface."""
    return lj.Hybrid(
        {"flies": lj.System(flat_lagrangian)}, [lj.Switch("flies", to="flies", when=lj.guards.touches(gap, 0.5))]
    )


@pytest.mark.parametrize(
    "system, state, timeless, unseen",
    [
        (bouncing, (2.0, 0.0, DRIVEN), False, [False]),
        (bouncing_by_element, (2.0, 0.0, DRIVEN), False, [False]),
        (block, (0.1, 0.25, BELT), True, [False]),
        (wheel, (0.0, 1.0, WALKS), True, [False]),
        (on_touch(height), (np.ones(2), np.ones(2), None), True, [False, False]),
        (lj.System(flat_lagrangian, elements={"floor": lj.Contact(height)}), (np.ones(2), np.ones(2), None), True,
         [True, False]),
        (lj.System(flat_lagrangian, elements={"floor": lj.Contact(slope)}), (np.ones(2), np.ones(2), None), True,
         [False, False]),
    ],
    ids=["table", "table by element", "belt", "wheel", "floor", "floor by element", "slope by element"],
)  # fmt: skip
def test_what_programs_show(system, state, timeless, unseen):
    """Guards, resets and gaps count like L: a moving table depends on time, and on a slope x matters.

    Of a hybrid whole leaves are looked at: x counts as seen with y.
    """
    q, v, params = state
    found = any_problem_of(system, State(0.0, q, v, params)).reasons
    assert (found.autonomous, list(found.ignorable)) == (timeless, unseen)
    assert not found.energy and not found.momenta


REFUSED = {
    "parts": (bouncing, {"parts": 4}, ValueError, "parts=4: a motion with switches is not divided"),
    "no such phase": (bouncing, {"phase": "rolling"}, ValueError, "phase names 'rolling', which is no phase"),
    "no phases": (block, {"phase": "sticks"}, ValueError, "phase= names the first phase of a lj.Hybrid"),
    "energy": (wheel, {"hold": "energy"}, ValueError, "the Jacobi integral is not conserved here"),
    "relative": (block, {"relative": "q"}, ValueError, "the system depends on it"),
}


@pytest.mark.parametrize("system, given, error, words", REFUSED.values(), ids=REFUSED)
def test_refused_in_words(system, given, error, words):
    """Bad arguments are refused before anything is compiled, with what there is instead."""
    with pytest.raises(error, match=words):
        lj.periodic_orbit(system, (0.1, 0.25), 1.0, DRIVEN | BELT | WALKS, **given)


def test_a_traced_phase_is_refused():
    """The phase of the start must be known."""
    with pytest.raises(ValueError, match="must be known while JAX is tracing"):
        jax.vmap(lambda phase: lj.periodic_orbit(wheel, (0.1, 2.0), 1.0, WALKS, phase=phase).q)(jnp.array([0, 0]))
