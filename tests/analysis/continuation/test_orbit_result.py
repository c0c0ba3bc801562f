"""Branches of cycles are drawn; names that they do not have are refused."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.closed_forms import duffing
from tests.analysis.continuation.test_orbits import DRIVEN


@pytest.mark.exhaustive
def test_what_is_drawn_and_refused():
    """Stable parts are solid, unstable dashed, folds are marked; unknown names and an empty range are refused."""
    orbit = lj.periodic_orbit(duffing, (0.4, 0.0), 2 * np.pi / DRIVEN["omega"], DRIVEN)
    branch = lj.continue_orbits(orbit, along="omega", to=1.7, most_points=400)
    (axis,) = branch.plot().axes
    dashes = {line.get_linestyle() for line in axis.get_lines() if len(line.get_xdata()) > 2}
    assert dashes == {"-", "--"} and axis.get_ylabel() == "largest q" and axis.get_xlabel() == "omega"
    assert {"stable", "unstable", "fold"} <= set(axis.get_legend_handles_labels()[1])
    assert branch.plot("period").axes[0].get_ylabel() == "period" and "fold" in repr(branch)
    short = lj.continue_orbits(orbit, along="omega", to=1.7, most_points=5)
    assert short.status == "the limit of 5 points" and len(short) == 5
    with pytest.raises(ValueError, match="names no coordinate; there are q, and 'period'"):
        branch.plot("theta")
    with pytest.raises(ValueError, match="along='speed' is no number in params; there are 'b', 'c', 'f' and 'omega'"):
        lj.continue_orbits(orbit, along="speed", to=1.0)
    with pytest.raises(ValueError, match="along='period': the system depends on time"):
        lj.continue_orbits(orbit, along="period", to=1.0)
    with pytest.raises(ValueError, match="leaves the parameter 'omega' no range: it starts at 0.5"):
        lj.continue_orbits(orbit, along="omega", to=0.5)
    with pytest.raises(TypeError, match="JAX is tracing"):
        jax.jit(lambda orbit: lj.continue_orbits(orbit, along="omega", to=1.0).period)(orbit)
    with pytest.raises(IndexError, match="branch\\[0\\] to branch"):
        branch[len(branch)]
