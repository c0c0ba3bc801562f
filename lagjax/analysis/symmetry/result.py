"""The result of a search for symmetries: a mapping of names to charges, with a printed summary."""

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import equinox as eqx
import numpy as np

from lagjax.mechanics.noether import NoetherCharge

# With a smaller gap it is unclear which singular values are zero.
CLEAR_GAP = 1e3


class Found(NamedTuple):
    """A symmetry: its charge, the residual of its conservation relative to its terms, and whether it contains t.

    `coefficients`: those of the motions of the basis. `cyclic`: the charge is the momentum of a coordinate that L does
    not contain.
    """

    charge: NoetherCharge
    residual: float
    timed: bool
    coefficients: np.ndarray
    cyclic: bool


class Scaling(NamedTuple):
    """x → s^a x and t → s^b t multiply L by s^factor; exponents by name, without zeros."""

    exponents: dict[str, float]
    factor: float
    residual: float

    def __str__(self):
        of_q = {name: exponent for name, exponent in self.exponents.items() if name != "t"}
        if len(of_q) > 3 and len(set(of_q.values())) == 1:
            of_q = {f"{len(of_q)} coordinates x": next(iter(of_q.values()))}
        shown = of_q | {name: x for name, x in self.exponents.items() if name == "t"}
        moved = [f"{name} → {_power(exponent)} {name[-1] if ' ' in name else name}" for name, exponent in shown.items()]
        return f"{', '.join(moved)}: L → {_power(self.factor)} L" if self.factor else f"{', '.join(moved)}: L stays"


class Symmetries(eqx.Module):
    """The symmetries of a system within a basis: a mapping of names to charges; print it for a summary.

    `found["L_z"]` is a function of (t, q, v, params); `traj.plot(charges=found)` draws them all.

    - `details`: a `Found` for each name; those whose charge contains t (boosts, uniform forces) are `timed`.
    - `scalings`: motions that multiply L by a factor; they conserve nothing.
    - `basis`: the names of the motions of the search; `states`: the number of states at which they were tried.
    - `singular_values`: those of the motions without t, and those of all motions; `gap`: the ratio of the smallest
      nonzero one to the largest that counts as zero. Below 1000 it is unclear which are zero, and the symmetries are
      unreliable; 0 where too few states were found for so many motions.
    """

    details: dict[str, Found]
    scalings: tuple[Scaling, ...] = eqx.field(static=True)
    basis: tuple[str, ...] = eqx.field(static=True)
    states: int = eqx.field(static=True)
    singular_values: tuple[np.ndarray, np.ndarray]
    gap: float
    at: str = eqx.field(static=True)
    of: str = eqx.field(static=True)

    def __getitem__(self, name) -> NoetherCharge:
        if name not in self.details:
            raise KeyError(f"no symmetry '{name}' was found; there are {', '.join(map(repr, self.details)) or 'none'}")
        return self.details[name].charge

    def __iter__(self) -> Iterator[str]:
        return iter(self.details)

    def __len__(self) -> int:
        return len(self.details)

    def __contains__(self, name) -> bool:
        return name in self.details

    def keys(self):
        """The names of the charges."""
        return self.details.keys()

    def items(self):
        """Names and charges."""
        return {name: found.charge for name, found in self.details.items()}.items()

    @property
    def steady(self) -> tuple[str, ...]:
        """The names of the charges without t."""
        return tuple(name for name, found in self.details.items() if not found.timed)

    @property
    def timed(self) -> tuple[str, ...]:
        """The names of the charges that contain t."""
        return tuple(name for name, found in self.details.items() if found.timed)

    def __repr__(self):
        width = max([len(name) for name in self.details], default=0)
        lines = [f"Symmetries of {self.of} at {self.at}"]
        for title, names in (("conserved", self.steady), ("conserved, with t in it", self.timed)):
            if names or title == "conserved":
                lines.append(f"  {title}" + ("" if names else ": nothing"))
            for name in names:
                found = self.details[name]
                words = "exactly: cyclic" if found.cyclic else f"to {found.residual:.0e}"
                lines.append(f"    {name:<{width}}  {words}")
        if self.scalings:
            lines.append("  scalings, which conserve nothing")
            lines += [f"    {scaling}" for scaling in self.scalings]
        looked = f"looked among {len(self.basis)} motions at {self.states} states; "
        gap = "nothing is near zero" if not np.isfinite(self.gap) else f"singular values apart by {self.gap:.0e}"
        doubt = "" if self.gap > CLEAR_GAP else ": TOO LITTLE to tell what is zero"
        return "\n".join([*lines, f"  {looked}{gap}{doubt}"])


def _power(exponent):
    if exponent == 1:
        return "s"
    plain = Fraction(exponent).limit_denominator(12)
    if abs(plain - exponent) > 1e-12:
        return f"s^{exponent:.6g}"
    return f"s^{plain}" if plain.denominator == 1 else f"s^({plain})"
