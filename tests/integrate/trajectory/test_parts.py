"""Parts of a trajectory: what is no array is hashable, and put together again with the arrays."""

import jax
import numpy as np

from lagjax.integrate.trajectory.parts import SolveInfo, SolveOptions, pack

HOW = SolveInfo("Dopri8", 8, 13, "tolerance")
ASKED = SolveOptions(None, None, None, None, None, "project")


def problem(g=9.81, name="steel"):
    """A system, for which its name stands, its parameters, and what was asked for."""
    return "system", {"g": np.array(g), "name": name}, ASKED


def test_arrays_and_a_hashable_rest():
    """Packed and combined it is the same; another number changes the arrays alone, another name the rest."""
    arrays, static = pack(problem(), HOW, max)
    assert jax.tree.leaves(arrays) == [9.81] and hash(static) == hash(pack(problem(1.62), HOW, max)[1])
    # A sweep labels the parameters by their place.
    assert arrays[1] == {"g": 9.81, "name": None}
    system, params, asked = static.rest.combine(jax.tree.leaves(arrays))
    assert (system, params["name"], asked) == ("system", "steel", ASKED) and params["g"] == 9.81
    assert static == pack(problem(1.62), HOW, max)[1] != pack(problem(name="brass"), HOW, max)[1]
    assert static.method == "Dopri8" and static.integrate is max


def test_what_was_not_asked_for_is_the_default():
    """Jumps are followed, and time goes forward, unless it is said."""
    assert ASKED.jumps == "found" and not HOW.backward
    assert pack(problem(), HOW._replace(backward=True), max)[1] != pack(problem(), HOW, max)[1]
