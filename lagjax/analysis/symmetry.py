"""Is a claimed symmetry one? Tested on states that satisfy the constraints, and against these.

A generator conserves its charge where L does not change by more than a total derivative, forces do no work along the
displacement ξ - τ v, and every constraint allows it (`mechanics/noether.py`). The last is asked of the constraints
alone and not of their forces, which may vanish by accident: for a holonomic one it says that the set g = 0 stays. A
constraint of velocities may look the same from everywhere and still forbid the displacement: a rolling disk rolls alike
on all of the table, and its momentum changes.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from lagjax.analysis.precision import precision_of
from lagjax.analysis.rates import Affine, rates
from lagjax.analysis.states import draws
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.diagnosis import describe
from lagjax.mechanics.first_call import looked_at
from lagjax.mechanics.generators import as_generator
from lagjax.mechanics.multipliers import accelerations
from lagjax.mechanics.refusals import check_system

STATES, AT_LEAST = 64, 8


class SymmetryTest(eqx.Module):
    """Whether a generator is a symmetry that conserves its charge; true where it is. It prints itself.

    All residuals are the largest over `states` states, relative to what the terms could be: a broken symmetry has one
    of about 1, or as small as what breaks it.

    - `residual`: the largest of those below, but for `invariance`.
    - `lagrangian`: by how much L changes, beyond the gauge term; `force`: the work of force and dissipation along it;
      `charge_rate`: of both together, which may cancel; `displacement`: by constraint, how much of it is forbidden.
    - `invariance`: by constraint of velocities, how much that itself is changed by the motion.
    - `charge`, `rate`: the charge at the given state, `[L] [t]`, and its predicted rate of change there, `[L]`.
    """

    name: str = eqx.field(static=True)
    residual: Float[Array, ""]
    charge_rate: Float[Array, ""]
    lagrangian: Float[Array, ""]
    force: Float[Array, ""]
    has_forces: bool = eqx.field(static=True)
    displacement: dict[str, Array]
    invariance: dict[str, Array]
    charge: Float[Array, ""]
    rate: Float[Array, ""]
    states: Array
    at: str = eqx.field(static=True)

    @property
    def tolerance(self) -> float:
        """Up to which residual nothing counts as broken, of the dtype."""
        return precision_of(self.residual.dtype).null

    @property
    def holds(self) -> Array:
        """Whether it is a symmetry, as an array: NaN is none."""
        return self.residual <= self.tolerance

    def __bool__(self):
        return bool(self.holds)

    def broken_by(self) -> list[str]:
        """What breaks the symmetry, in words."""
        parts = {"L": self.lagrangian, "the forces": self.force} if self.charge_rate > self.tolerance else {}
        forbidden = {f"constraint '{name}'": value for name, value in self.displacement.items()}
        return [name for name, value in (parts | forbidden).items() if not value <= self.tolerance]

    def __repr__(self):
        if coordinates.is_traced(self.residual):
            return f"SymmetryTest({self.name}, being traced)"
        if np.ndim(self.residual):
            kept = np.asarray(self.holds)
            return f"SymmetryTest({self.name}: a symmetry in {kept.sum()} of {kept.size} lanes)"
        rows = [("L", f"changes by {float(self.lagrangian):.0e} of what it could")]
        if self.has_forces:
            rows.append(("forces", f"do work along it, {float(self.force):.0e} of what they could"))
        for name, value in self.displacement.items():
            allowed = value <= self.tolerance
            words = "allows it" if allowed else "forbids it"
            unchanged = name in self.invariance and self.invariance[name] <= self.tolerance and not allowed
            rows.append((f"constraint '{name}'", words + (", though it looks the same" if unchanged else "")))
        rows.append(("charge", f"{float(self.charge):.9g}" + (f", at {self.at}" if self.at else "")))
        rows.append(("its rate there", "0" if self else f"{float(self.rate):.9g}"))
        width = max(len(name) for name, _ in rows)
        verdict = "conserved by a symmetry" if self else f"no symmetry: broken by {' and '.join(self.broken_by())}"
        return "\n".join([
            f"{self.name}: {verdict}; residual {float(self.residual):.0e} over {int(self.states)} states",
            *(f"  {name:<{width}}  {words}" for name, words in rows),
        ])  # fmt: skip


def is_symmetry(system, generator, q, v, params=None, *, t=0.0) -> SymmetryTest:
    """Test whether a one-parameter group is a symmetry of a system and conserves its charge.

    >>> import lagjax as lj
    >>> def falling(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]
    >>> start = {"x": 0.0, "y": 1.0}, {"x": 2.0, "y": 0.0}
    >>> print(bool(is_symmetry(lj.System(falling), lj.Generator.shift("x"), *start, {"g": 10.0})))
    True
    >>> is_symmetry(lj.System(falling), lj.Generator.shift("y"), *start, {"g": 10.0})
    p_y: no symmetry: broken by L; residual 1e+00 over 64 states
      L               changes by 1e+00 of what it could
      charge          0, at t = 0, q = (x = 0, y = 1), v = (x = 2, y = 0)
      its rate there  -10

    **Arguments:** `generator` as for `noether_charge`; `q` and `v` alike, `params` as the system takes it, `t` scalar:
    a state, around which others are drawn, always the same, on the constraints. Its size sets theirs.

    **Returns:** a `SymmetryTest`, true where it is one, with the residual, what breaks it, and the rate of change of
    the charge that this predicts; a charge that no symmetry keeps may still stay, where constraints happen not to push.
    Inside `jit`, `vmap` or a sweep ask for `.holds` or `.residual`.

    **Raises:** as `noether_charge`; `ValueError` where no states are found that satisfy the constraints and where L is
    finite (while JAX is tracing the residual is NaN instead).

    Source: Goldstein, *Classical Mechanics*, §13.7; Neĭmark & Fufaev, *Dynamics of Nonholonomic Systems*, §III.6.
    """
    check_system(system, generator, q, v, params)
    generator = as_generator(generator)
    s = coordinates.state(t, q, v, params)
    system = looked_at(system, s)
    generator.check(s)
    n = len(coordinates.names(s.q))
    none = np.zeros((0, n))
    affine = Affine(none, np.zeros((0, n, n)), none, np.zeros(0), np.zeros(0))
    found = rates(system, affine, (generator,), s, draws(STATES, n))
    xp = coordinates.numpy_of(found)
    count = xp.sum(found.states.found)
    if xp is np and count < AT_LEAST:
        raise ValueError(too_few(system, s, int(count)))
    largest = lambda y: xp.max(xp.abs(y))
    by_name = lambda y: {
        name: largest(value)
        for name, value in constraints.split(system, xp.max(xp.abs(y[:, :, 0]), axis=0), *s).items()
    }
    displacement, invariance = by_name(found.displacement), by_name(found.invariance)
    of_velocities = {name for name, c in system.constraints.items() if not isinstance(c, Holonomic)}
    residual = xp.max(xp.stack([largest(found.charge), *displacement.values()]))
    _, unflatten = coordinates.flatten(s.q)
    at = s._replace(t=found.states.t[0], q=unflatten(found.states.x[0]), v=unflatten(found.states.u[0]))
    rate = found.first[0]
    if system.constraints:
        multipliers = accelerations(system, *at)[1]
        rate = rate + xp.concatenate([xp.ravel(multipliers[name]) for name in system.constraints]) @ found.pushed[:, 0]
    return SymmetryTest(
        generator.name,
        xp.where(count < AT_LEAST, xp.full_like(residual, xp.nan), residual),
        largest(found.charge), largest(found.lagrangian), largest(found.force),
        system.force is not None or system.dissipation is not None,
        displacement, {name: invariance[name] for name in sorted(of_velocities)},
        found.charges[0, 0], rate, count,
        "" if xp is not np else f"t = {float(s.t):.6g}, q = {describe(at.q)}, v = {describe(at.v)}",
    )  # fmt: skip


def too_few(system, s, count) -> str:
    """Why a claim could not be tested."""
    cause = "constraints that the given state is far from" if system.constraints else "a state where L is not finite"
    return (
        f"only {count} states were found around q = {describe(s.q)} that satisfy the constraints and where L is finite."
        f"\nUsual cause: {cause}, or a state at the edge of where L is defined.\n"
        "Fix: a state amid the motion; lj.consistent_state(system, t, q, v, params) moves one onto the constraints."
    )
