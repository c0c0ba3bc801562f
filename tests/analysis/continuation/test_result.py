"""Branches of equilibria draw themselves."""

import pytest

from tests.analysis.continuation.test_equilibria import bead


def test_what_is_drawn():
    """Stable parts are solid, unstable dashed, the pitchfork is marked, axes are named; unknown names are refused."""
    found = bead(1.0, 0.0, 8.0)
    (axis,) = found.plot().axes
    dashes = {line.get_linestyle() for line in axis.get_lines() if len(line.get_xdata()) > 2}
    assert dashes == {"-", "--"} and axis.get_xlabel() == "omega" and axis.get_ylabel() == "q"
    labels = axis.get_legend_handles_labels()[1]
    assert {"stable", "unstable", "pitchfork"} <= set(labels)
    with pytest.raises(ValueError, match="names no coordinate"):
        found.plot("theta")
