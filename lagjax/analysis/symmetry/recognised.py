"""Numbers in words: a ratio of two coefficients as a whole number, a parameter of the user's, or a pitch over 2π.

`h p_z + 2π L_z with h = 0.5` says more than `0.0795774715 p_z + L_z`. A number is recognised if it agrees to round-off.
The recognised form is only a guess, so it is displayed but never used in computations.
"""

from fractions import Fraction
from typing import NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np

from lagjax.system import coordinates

# Parameters are recognised among at most so many, and at most so many terms of a combination are written.
MOST_PARAMETERS, MOST_TERMS = 30, 8
WHOLE = [Fraction(n) for n in (1, 2, 3, 4)] + [Fraction(1, 2)]
FRACTIONS = [Fraction(n, d) for d in range(1, 13) for n in range(1, 13)]


class RecognisedNumber(NamedTuple):
    """A fraction times a power of π times powers of parameters."""

    fraction: Fraction
    pi: int = 0
    params: tuple[tuple[str, int], ...] = ()

    def times(self, other: "RecognisedNumber") -> "RecognisedNumber":
        """The product of two numbers."""
        powers = dict(self.params)
        for name, power in other.params:
            powers[name] = powers.get(name, 0) + power
        params = tuple((name, power) for name, power in powers.items() if power)
        return RecognisedNumber(self.fraction * other.fraction, self.pi + other.pi, params)

    def __str__(self):
        above, below = self.fraction.numerator, self.fraction.denominator
        up = ([str(above)] if above != 1 else []) + ["π"] * max(self.pi, 0)
        up = ["".join(up)] if up else []
        up += [name if power == 1 else f"{name}^{power}" for name, power in self.params if power > 0]
        down = ([str(below)] if below != 1 else []) + ["π"] * max(-self.pi, 0)
        down = ["".join(down)] if down else []
        down += [name if power == -1 else f"{name}^{-power}" for name, power in self.params if power < 0]
        return (" ".join(up) or "1") + (f"/({' '.join(down)})" if len(down) > 1 else f"/{down[0]}" if down else "")


class Words(NamedTuple):
    """A combination in words, and the factor by which the original coefficients are multiplied there."""

    text: str
    factor: float


def named_parameters(params) -> dict[str, float]:
    """The numeric parameters, by name."""
    is_number = lambda x: isinstance(x, (float, int, np.number)) or np.issubdtype(getattr(x, "dtype", bool), np.number)
    leaves = jax.tree.map(lambda x: np.asarray(x) if is_number(x) else None, params)
    values = [float(x) for leaf in jax.tree.leaves(leaves) for x in np.ravel(leaf)]
    alone = jtu.treedef_is_leaf(jtu.tree_structure(leaves)) and len(values) == 1
    names = ["params"] if alone else coordinates.names(leaves)
    return dict(zip(names, values)) if len(values) <= MOST_PARAMETERS else {}


def in_words(coefficients, names, params: dict[str, float], agrees: float, first=()) -> Words:
    """A combination in words; `first`: the names whose coefficients are tried as parameters before whole numbers."""
    coefficients = np.asarray(coefficients, float)
    leading = coefficients[0]
    found = [_recognised(c / leading, params, agrees, name in first) for c, name in zip(coefficients, names)]
    known = [number for number in found if number is not None]
    # The combination is multiplied by its common denominator.
    below = {}
    for number in known:
        for name, power in number.params:
            below[name] = max(below.get(name, 0), -power)
    common = int(np.lcm.reduce([number.fraction.denominator for number in known]))
    pi = max(-number.pi for number in known)
    factor = RecognisedNumber(
        Fraction(common), max(pi, 0), tuple((name, power) for name, power in below.items() if power > 0)
    )
    size = _value(factor, params)
    text, used = "", []
    for i, (c, name, number) in enumerate(zip(coefficients, names, found)):
        if i == MOST_TERMS and len(names) > MOST_TERMS + 2:
            text += f" ... ({len(names)} terms)"
            break
        value = c / leading * size
        number = None if number is None else number.times(factor)
        word = f"{abs(value):.9g}" if number is None else str(number._replace(fraction=abs(number.fraction)))
        # The sign shown is that of the fraction, because a parameter may be negative.
        negative = value < 0 if number is None else number.fraction < 0
        used += [] if number is None else [p for p, _ in number.params]
        sign = (" - " if negative else " + ") if text else ("-" if negative else "")
        text += sign + (f"{word} " if word != "1" else "") + name
    values = ", ".join(f"{name} = {params[name]:.6g}" for name in dict.fromkeys(used))
    return Words(text + (f" with {values}" if values else ""), size / leading)


def _value(number: RecognisedNumber, params) -> float:
    return float(number.fraction) * np.pi**number.pi * float(np.prod([params[p] ** e for p, e in number.params]))


def _recognised(value: float, params, agrees, parameters_first) -> RecognisedNumber | None:
    """The form in which a number is recognised; None if there is none."""
    if abs(value - 1.0) <= agrees:
        return RecognisedNumber(Fraction(1))
    plain = [RecognisedNumber(fraction) for fraction in WHOLE]
    single = [RecognisedNumber(f, 0, ((name, e),)) for f in WHOLE for name in params for e in (1, -1)]
    pitch = [
        n
        for name in params
        for n in (RecognisedNumber(Fraction(2), 1, ((name, -1),)), RecognisedNumber(Fraction(1, 2), -1, ((name, 1),)))
    ]
    rest = [RecognisedNumber(f) for f in FRACTIONS] + [RecognisedNumber(f, pi) for pi in (1, -1) for f in FRACTIONS]
    pairs = [
        RecognisedNumber(f, 0, ((a, 1), (b, e)))
        for f in WHOLE for a in params for b in params if a != b for e in (1, -1)
    ]  # fmt: skip
    if parameters_first:
        order = [*plain[:1], *single, *pairs, *plain, *pitch, *rest]
    else:
        order = [*plain, *single, *pitch, *pairs, *rest]
    alike = [found for number in order if (found := _agreeing(value, number, params, agrees)) is not None]
    # If two parameters have the same value, it is ambiguous which one is meant.
    clear = [found for found in alike[:1] if not found.params or _only(found, alike)]
    return (clear or [found for found in alike if not found.params] or [None])[0]


def _agreeing(value, number: RecognisedNumber, params, agrees):
    recognised = _value(number, params) if all(params[p] for p, _ in number.params) else 0.0
    if not recognised or abs(abs(value) - abs(recognised)) > agrees * abs(value):
        return None
    return number._replace(fraction=number.fraction * int(np.sign(value * recognised)))


def _only(found: RecognisedNumber, alike):
    same = [other for other in alike if [power for _, power in other.params] == [power for _, power in found.params]
            and abs(other.fraction) == abs(found.fraction) and other.pi == found.pi]  # fmt: skip
    return len({frozenset(other.params) for other in same}) == 1
