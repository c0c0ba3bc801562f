"""Names are shown as they are: markup, dollars and control characters in them do nothing, wherever they are shown."""

import html
import re

import numpy as np

import lagjax as lj
from lagjax.analysis.formulations.latex import written

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
