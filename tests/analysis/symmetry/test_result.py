"""Symmetries that were found, as charges of a trajectory."""

import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.symmetry.result import Ratios, in_words
from lagjax.scenes import sliding_wedge
from tests.symmetric_systems import OF_STONE, STONE


def test_names_of_coefficients_hold_at_other_values():
    """-3/2 is -e B/2 and not -3/m, which it is only here; what agrees with nothing elsewhere is a number."""
    here, there = {"m": 2.0, "e": 1.0, "B": 3.0}, {"m": 2.12, "e": 1.05, "B": 3.2}
    words = lambda elsewhere: in_words([1.0, -1.5], ["p_x", "y"], here, 1e-9, first=["y"], elsewhere=elsewhere).text
    assert words(Ratios(np.array([1.0, -1.05 * 3.2 / 2]), there)) == "2 p_x - e B y with e = 1, B = 3"
    assert words(Ratios(np.array([1.0, -1.5]), there)) == "2 p_x - 3 y"
    assert words(Ratios(np.array([1.0, -7.7]), there)) == "p_x - 1.5 y"
    assert words(None) == "m p_x - 3 y with m = 2"


@pytest.mark.exhaustive
def test_charges_of_a_trajectory_are_drawn():
    """`True` draws charges that the structure shows, a mapping the given ones. Twins: none known, not a function."""
    params = sliding_wedge.PARAMS
    start = sliding_wedge.start_on_incline(params, along=1.0, along_rate=0.25)
    motion = lj.integrate(sliding_wedge.system, *start, params, ts=np.linspace(0.0, 1.0, 9))
    found = lj.symmetries(sliding_wedge.system, *start, params)
    panel = motion.plot(charges=found).axes[-1]
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert "p_X + p_x" in labels and all(np.max(np.abs(line.get_ydata())) < 1e-12 for line in panel.get_lines())
    label = motion.plot(charges=True).axes[-1].get_ylabel()
    assert "Jacobi integral" in label and "at the outputs" in label
    moved = motion.plot(charges={"p_x": lj.noether_charge(sliding_wedge.system, lj.Generator.shift("x"))})
    assert np.max(np.abs(moved.axes[-1].get_lines()[0].get_ydata())) > 0.1
    with pytest.raises(TypeError, match="charge 'p' must be a function"):
        motion.plot(charges={"p": 1.0})
    rubbed = lj.System(STONE.lagrangian, dissipation=lambda t, q, v, params: 0.5 * v["x"] ** 2)
    stone = lj.integrate(rubbed, {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}, OF_STONE, ts=np.linspace(0.0, 1.0, 3))
    with pytest.raises(ValueError, match="nothing is known to be conserved"):
        stone.plot(charges=True)
