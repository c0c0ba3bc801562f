"""Names are shown as they are: markup, dollars and control characters in them do nothing, wherever they are shown."""

import html
import re

import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.latex import written
from lagjax.display import plots
from lagjax.display.terminal import by_line, printable
from lagjax.system import coordinates

BAD = "a$\\frac$\x1b[2J</script><!--<b>\u202e"


def test_on_a_page(monkeypatch):
    """No name ends a script or begins a tag. Twin: without escapes one does."""
    run = lambda point: {BAD: point[BAD], "z<i>": np.ones((2, 200)) * point[BAD]}
    swept = lj.sweep(run, {BAD: np.arange(3.0)}, progress=False)
    page = swept.to_html().html
    assert all(part not in page for part in ("</script><!--", "<!--", "<b>", "<i>", "\x1b"))
    assert len(re.findall("<script", page)) == len(re.findall("</script>", page)) == 2 and "z&lt;i&gt;" in page
    assert all(line.isprintable() for line in repr(swept).splitlines())
    monkeypatch.setattr(html, "escape", lambda text: text)
    assert "<i>" in swept.to_html().html


def test_in_a_formula():
    """Only letters and digits of a name reach a formula."""
    assert written("theta") == "\\theta" and written("θ1") == "θ_{1}"
    for name in (BAD, "}\\input{x}", "}{", "\\", "$", "a_b^c"):
        assert re.fullmatch(r"(\\(mathrm|square|alpha)|[\w{}_,])+", written(name)), name
        assert written(name).count("{") == written(name).count("}")


def test_in_a_terminal():
    """Control characters and those that turn the direction are escaped; others, of any alphabet, are not."""
    assert printable("a\x1b[2J\u202eb\nc") == "a\\x1b[2J\\u202eb\\nc" and by_line("a\nb\r") == "a\nb\\r"
    assert printable("θ, ё and 速度") == "θ, ё and 速度"
    assert all(name.isprintable() for name in coordinates.names({BAD: 1.0, "x": {BAD: 2.0}}))
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, {BAD: lj.Holonomic(lambda t, q, params: q)})
    assert repr(system).isprintable() and "\\x1b[2J" in repr(system)


def test_in_a_plot():
    """A dollar is no formula, which could not be read; twin: without the decorator it cannot."""
    name = "$\\undefined{$"
    t = np.arange(3.0)
    panels = {name: {name: t, "y": t}}
    for figure in (plots.time_series(t, panels), plots.lines(name, t, {name: t}, t > 1)):
        assert len(getattr(figure, "_repr_png_")()) > 1000
    with pytest.raises(ValueError, match="undefined"):
        getattr(plots.time_series, "__wrapped__")(t, panels)._repr_png_()
