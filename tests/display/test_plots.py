"""Names in a plot: a dollar is no formula."""

import numpy as np
import pytest

from lagjax.display import plots


def test_in_a_plot():
    """A dollar is no formula, which could not be read; twin: without the decorator it cannot."""
    name = "$\\undefined{$"
    t = np.arange(3.0)
    panels = {name: {name: t, "y": t}}
    for figure in (plots.time_series(t, panels), plots.lines(name, t, {name: t}, t > 1)):
        assert len(getattr(figure, "_repr_png_")()) > 1000
    with pytest.raises(ValueError, match="undefined"):
        getattr(plots.time_series, "__wrapped__")(t, panels)._repr_png_()
