"""Formulas in LaTeX, with names typeset as usual: `theta` becomes θ, `m1` becomes m with an index."""

import re
from fractions import Fraction

from lagjax.analysis.expressions import Formula, Function, Group, Symbol, atoms_in_order, order_of

GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi rho sigma tau phi chi psi omega "
    "Gamma Delta Theta Lambda Xi Sigma Phi Psi Omega"
).split()
NAMED = {"log": r"\ln", "asin": r"\arcsin", "acos": r"\arccos", "atan": r"\arctan", "sign": r"\operatorname{sgn}"}
PLAIN = {"sin", "cos", "tan", "sinh", "cosh", "tanh", "exp"}


def written(name: str) -> str:
    r"""A name in LaTeX.

    >>> written("theta"), written("m1"), written("r[0, 1]"), written("length")
    ('\\theta', 'm_{1}', 'r_{0,1}', '\\mathrm{length}')
    """
    # Letters of any alphabet, and digits: no other character of a name reaches the formula.
    parts = re.findall(r"[^\W\d_]+|\d+", name)
    if not parts:
        return r"\square"
    letters = lambda part: (
        rf"\{part}" if part in GREEK else part if len(part) == 1 or part.isdigit() else rf"\mathrm{{{part}}}"
    )
    first, *rest = map(letters, parts)
    return first + (f"_{{{','.join(rest)}}}" if rest else "")


def latex(formula: Formula) -> str:
    """A formula in LaTeX."""
    words = ""
    for term in sorted(formula.terms, key=order_of):
        c = formula.terms[term]
        text = _term(term, abs(c))
        words += (" - " if c < 0 else " + ") + text if words else ("-" if c < 0 else "") + text
    return words or "0"


def combined(terms) -> str:
    """The sum of formulas, each multiplied by its symbol, without those that are zero."""
    words = ""
    for formula, factor in terms:
        if not formula.terms:
            continue
        if len(formula.terms) > 1:
            text = rf"\left({latex(formula)}\right) {factor}"
        else:
            plain = latex(formula)
            text = factor if plain == "1" else f"-{factor}" if plain == "-1" else f"{plain} {factor}"
        words += plus(text) if words else text
    return words


def plus(text: str) -> str:
    """A term to be added, with its sign between spaces."""
    return f" - {text[1:]}" if text.startswith("-") else f" + {text}"


def _term(term, size: float) -> str:
    above, below = [], []
    for atom, power in atoms_in_order(term):
        (above if power > 0 else below).append(_power(atom, abs(power)))
    plain = Fraction(size).limit_denominator(64)
    whole = abs(plain - size) <= 1e-12 * size
    if whole:
        above = ([str(plain.numerator)] if plain.numerator != 1 else []) + above
        below = ([str(plain.denominator)] if plain.denominator != 1 else []) + below
    else:
        above = [f"{size:.9g}", *above]
    top = r" ".join(above) or "1"
    return rf"\frac{{{top}}}{{{' '.join(below)}}}" if below else top


def _power(atom, power: Fraction) -> str:
    if isinstance(atom, Group):
        inside = latex(atom.inside)
        if power == Fraction(1, 2):
            return rf"\sqrt{{{inside}}}"
        body = rf"\left({inside}\right)"
        return body if power == 1 else f"{body}^{{{_exponent(power)}}}"
    if isinstance(atom, Symbol):
        return atom.latex if power == 1 else f"{_braced(atom.latex)}^{{{_exponent(power)}}}"
    assert isinstance(atom, Function)
    raised = "" if power == 1 else f"^{{{_exponent(power)}}}"
    argument = latex(atom.argument)
    if atom.name == "abs":
        return rf"\left|{argument}\right|{raised}"
    name = NAMED.get(atom.name, rf"\{atom.name}" if atom.name in PLAIN else rf"\operatorname{{{atom.name}}}")
    # The argument is always in brackets, because another factor may follow.
    simple = "frac" not in argument and "^" not in argument
    return f"{name}{raised}({argument})" if simple else rf"{name}{raised}\left({argument}\right)"


def _braced(text):
    return f"{{{text}}}" if text.startswith((r"\dot", r"\ddot")) or "_" in text else text


def _exponent(power: Fraction) -> str:
    return str(power) if power.denominator == 1 else f"{power.numerator}/{power.denominator}"
