"""Formulas as MathML, written by docutils while the site is built: no scripts, no fonts, no network access."""

import re

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

logger = logging.getLogger(__name__)
# Commands that docutils does not know, written with ones that it knows.
SPELT_OUT = {r"\tfrac": r"\frac", r"\dfrac": r"\frac", r"\lvert": "|", r"\rvert": "|", "°": r"^{\circ}"}
# docutils puts no space between a function and its argument.
FUNCTION = re.compile(r"\\(?:sin|cos|tan|cot|ln|log|exp|arcsin|arccos|arctan)(?=\\[a-zA-Z]| +\\?[a-zA-Z])")
# docutils reads the 12 of `\frac12` as one number.
SHORT_FRACTION = re.compile(r"\\frac\s*(\w)\s*(\w)")


def converted(source: str, block: bool) -> str:
    """LaTeX as MathML."""
    for name, known in SPELT_OUT.items():
        source = source.replace(name, known)
    source = SHORT_FRACTION.sub(r"\\frac{\1}{\2}", FUNCTION.sub(r"\g<0>\\,", source))
    return tex2mathml(source, as_block=block)


def mathml(translator, node, block: bool) -> str:
    """The formula of a node; if docutils cannot read it, a warning fails the build."""
    source = node.astext().strip()
    try:
        return converted(source, block)
    except MathError as error:
        logger.warning("formula %r: %s", source, error, location=node)
        return f"<code>{translator.encode(source)}</code>"


def inline(translator, node):
    """A formula in a line of text."""
    translator.body.append(mathml(translator, node, block=False))
    raise nodes.SkipNode


def displayed(translator, node):
    """A displayed formula, which scrolls on its own if the page is narrow."""
    translator.body.append('<div class="formula" tabindex="0" role="region" aria-label="Formula">')
    translator.body.append(mathml(translator, node, block=True) + "</div>\n")
    raise nodes.SkipNode


def setup(app):
    """Register the renderer under the name `mathml`."""
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
