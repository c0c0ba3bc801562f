"""Formulas with numerical coefficients: sums of products of powers, expanded, with sin² + cos² simplified.

A `Formula` is a sum of terms, each a number times powers of atoms. An atom is a symbol, a function of a formula, or a
formula in a denominator or under a root. Results of arithmetic are expanded, and terms cancel; no more algebra is
needed to read a Lagrangian back from its program.
"""

from collections.abc import Mapping
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np

# A coefficient up to this fraction of the largest addend is round-off.
ROUND_OFF = 1e-13
# A formula with more terms is not readable.
LONG = 400
FUNCTIONS = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sinh": np.sinh, "cosh": np.cosh,
    "tanh": np.tanh, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "asinh": np.arcsinh, "abs": np.abs,
    "acosh": np.arccosh, "atanh": np.arctanh, "sign": np.sign,
}  # fmt: skip


class TooLong(Exception):
    """A formula has more terms than anyone reads."""


class Symbol(NamedTuple):
    """A parameter, a coordinate or a velocity: its name, its LaTeX, and its rank in the order of factors."""

    name: str
    latex: str
    order: int


class Function(NamedTuple):
    """A function of a formula."""

    name: str
    argument: "Formula"


class Group(NamedTuple):
    """A formula as a factor, with a power that is not a positive integer."""

    inside: "Formula"


Atom = Symbol | Function | Group
Term = frozenset


class Formula:
    """A sum of terms: each is a set of (atom, power) pairs with a coefficient."""

    def __init__(self, terms: Mapping[Term, float]):
        if len(terms) > LONG:
            raise TooLong
        largest = max(map(abs, terms.values()), default=0.0)
        self.terms = {term: c for term, c in terms.items() if abs(c) > ROUND_OFF * largest}

    @cached_property
    def key(self):
        """A key that is the same for equal formulas."""
        return frozenset((term, float(f"{c:.12g}")) for term, c in self.terms.items())

    def __eq__(self, other):
        return isinstance(other, Formula) and self.key == other.key

    def __hash__(self):
        return hash(self.key)

    def __add__(self, other: "Formula") -> "Formula":
        total, size = dict(self.terms), dict.fromkeys(self.terms, 0.0)
        for term, c in other.terms.items():
            size[term] = abs(c)
            total[term] = total.get(term, 0.0) + c
        return Formula({term: c for term, c in total.items() if abs(c) > ROUND_OFF * size[term]})

    def __mul__(self, other: "Formula") -> "Formula":
        if len(self.terms) * len(other.terms) > LONG:
            raise TooLong
        total = number(0.0)
        for one, a in self.terms.items():
            for two, b in other.terms.items():
                total = total + _product(one, two, a * b)
        return total

    def __neg__(self):
        return self * number(-1.0)

    def __sub__(self, other):
        return self + -other

    @property
    def constant(self) -> float | None:
        """The value of the formula if it is a number, else None."""
        if not self.terms:
            return 0.0
        return self.terms[frozenset()] if set(self.terms) == {frozenset()} else None

    def power(self, exponent) -> "Formula":
        """The formula to a power; expanded if the power is a nonnegative integer."""
        exponent = Fraction(exponent).limit_denominator(64)
        if exponent.denominator == 1 and exponent >= 0:
            result = number(1.0)
            for _ in range(int(exponent)):
                result = result * self
            return result
        if self.constant is not None:
            return number(float(self.constant) ** float(exponent))
        if len(self.terms) == 1 and exponent.denominator == 1:
            ((term, c),) = self.terms.items()
            return Formula({frozenset((atom, p * exponent) for atom, p in term): c ** int(exponent)})
        return Formula({frozenset({(Group(tidy(self)), exponent)}): 1.0})

    def value(self, at: Mapping[str, float]) -> float:
        """The value of the formula with numbers in place of symbols."""
        return sum(c * float(np.prod([_value(a, at) ** float(p) for a, p in term])) for term, c in self.terms.items())


def number(value: float) -> Formula:
    """A number as a formula."""
    return Formula({frozenset(): float(value)} if value else {})


def symbol(name: str, latex: str, order: int) -> Formula:
    """A symbol as a formula."""
    return Formula({frozenset({(Symbol(name, latex, order), Fraction(1))}): 1.0})


def function(name: str, argument: Formula) -> Formula:
    """A function of a formula; the sign of the argument of an odd or even function is moved in front."""
    if argument.constant is not None:
        return number(float(FUNCTIONS[name](argument.constant)))
    sign = 1.0
    if name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "abs") and _is_negative(argument):
        argument, sign = -argument, 1.0 if name in ("cos", "cosh", "abs") else -1.0
    return Formula({frozenset({(Function(name, tidy(argument)), Fraction(1))}): sign})


def tidy(formula: Formula) -> Formula:
    """Replace sin² + cos² by 1 wherever both have the same factors and coefficient."""
    changed = True
    while changed:
        changed = False
        for term, c in list(formula.terms.items()):
            for atom, power in term:
                if not (isinstance(atom, Function) and atom.name == "sin" and power >= 2):
                    continue
                rest = _without(term, atom, power, 2)
                cosine = Function("cos", atom.argument)
                partner = _with(rest, cosine, 2)
                other = formula.terms.get(partner)
                if other is not None and abs(other - c) <= ROUND_OFF * abs(c):
                    left = {t: x for t, x in formula.terms.items() if t not in (term, partner)}
                    formula = Formula(left) + Formula({rest: c})
                    changed = True
                    break
            if changed:
                break
    return formula


def _with(term, atom, power):
    powers = dict(term)
    powers[atom] = powers.get(atom, Fraction(0)) + power
    return frozenset((a, p) for a, p in powers.items() if p)


def _without(term, atom, power, less):
    left = frozenset(pair for pair in term if pair[0] != atom)
    return left if power == less else left | {(atom, power - less)}


def _product(one: Term, two: Term, c: float) -> Formula:
    powers = dict(one)
    for atom, power in two:
        powers[atom] = powers.get(atom, Fraction(0)) + power
    # A group with a positive integer power is expanded into a sum again.
    whole = {a: p for a, p in powers.items() if isinstance(a, Group) and p.denominator == 1 and p > 0}
    result = Formula({frozenset((a, p) for a, p in powers.items() if p and a not in whole): c})
    for group, power in whole.items():
        result = result * group.inside.power(power)
    return result


def _is_negative(formula):
    first = min(formula.terms.items(), key=lambda item: order_of(item[0]))
    return first[1] < 0


def order_of(term: Term):
    """The sort key of a term in a sum."""
    return sorted(((_order(atom), -power) for atom, power in term), reverse=True)


def _order(atom: Atom):
    if isinstance(atom, Symbol):
        return 0, atom.order, atom.name
    inside = atom.inside if isinstance(atom, Group) else atom.argument
    terms = sorted(str(order_of(term)) for term in inside.terms)
    return 1, 0, (atom.name if isinstance(atom, Function) else "") + str(terms)


def atoms_in_order(term: Term) -> list[tuple[Atom, Fraction]]:
    """The factors of a term in the order in which they are written."""
    return sorted(term, key=lambda pair: _order(pair[0]))


def _value(atom: Atom, at) -> float:
    if isinstance(atom, Symbol):
        return at[atom.name]
    if isinstance(atom, Group):
        return atom.inside.value(at)
    return float(FUNCTIONS[atom.name](atom.argument.value(at)))
