"""A test of a claimed symmetry, at states that satisfy the constraints.

A generator conserves its charge if L changes at most by a total derivative, forces do no work along the displacement
ξ - τ v, and every constraint allows this displacement (`mechanics/noether.py`). The last condition is checked on the
constraints and not on their forces, which may vanish by accident; for a holonomic one it means that the set g = 0 is
preserved. A velocity constraint may be invariant and still forbid the displacement: a rolling disk rolls in the same
way everywhere on the table, but its momentum changes.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.analysis.symmetry.charge_rates import Affine, precision_of, rates
from lagjax.analysis.symmetry.random_states import draws
from lagjax.jaxtools import is_traced, numpy_of
from lagjax.mechanics import accelerations_at, as_generator, describe
from lagjax.system import check_system, coordinates, model_of, traced_system

STATES, AT_LEAST = 64, 8


class SymmetryTest(eqx.Module):
    """Whether a generator is a symmetry that conserves its charge; `bool(test)` is True if it is. It prints itself.

    Each residual is the largest over `states` states, relative to the size that its terms could have. A broken symmetry
    has a residual of about 1, or as small as the term that breaks it.

    - `residual`: the largest of those below, without `invariance`.
    - `lagrangian`: how much L changes, beyond the gauge term; `force`: the work of force and dissipation along the
      displacement; `charge_rate`: both together, which may cancel; `displacement`: by constraint, how much of the
      displacement is forbidden.
    - `invariance`: by velocity constraint, how much the motion changes the constraint itself.
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
        """The residual up to which the symmetry counts as unbroken in this dtype."""
        return precision_of(self.residual.dtype).null

    @property
    def holds(self) -> Array:
        """Whether it is a symmetry, as an array; False where the residual is NaN."""
        return self.residual <= self.tolerance

    def __bool__(self):
        return bool(self.holds)

    def broken_by(self) -> list[str]:
        """The parts of the system that break the symmetry, in words."""
        parts = {"L": self.lagrangian, "the forces": self.force} if self.charge_rate > self.tolerance else {}
        forbidden = {f"constraint '{name}'": value for name, value in self.displacement.items()}
        return [name for name, value in (parts | forbidden).items() if not value <= self.tolerance]

    def __repr__(self):
        if is_traced(self.residual):
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


def is_symmetry(system, generator, q: PyTree, v: PyTree, params: PyTree = None, *, t=0.0) -> SymmetryTest:
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

    **Arguments:** `generator` as for `noether_charge`; `q` and `v` of the same structure, `params` as the system takes
    it, `t` scalar: a state. Others, the same at each call, are drawn around it on the constraints, on the scale of its
    size.

    **Returns:** a `SymmetryTest`, true for a symmetry, with the residual, what breaks it, and the rate of change of the
    charge that this predicts. A charge without a symmetry may still be constant, if the constraints happen to exert no
    force. Inside `jit`, `vmap` or a sweep use `.holds` or `.residual`.

    **Raises:** as `noether_charge`; `ValueError` if no states are found that satisfy the constraints and at which L is
    finite (while JAX is tracing the residual is NaN instead).

    Source: Goldstein, *Classical Mechanics*, §13.7; Neĭmark & Fufaev, *Dynamics of Nonholonomic Systems*, §III.6.
    """
    check_system(system, generator, q, v, params, states=False)
    generator = as_generator(generator)
    s = coordinates.state(t, q, v, params)
    model = model_of(traced_system(system, s), *s)
    generator.check(s)
    system, n = model.system, model.n
    empty = np.zeros((0, n))
    affine = Affine(empty, np.zeros((0, n, n)), empty, np.zeros(0), np.zeros(0))
    found = rates(model, affine, (generator,), s, draws(STATES, n))
    xp = numpy_of(found)
    count = xp.sum(found.states.found)
    if xp is np and count < AT_LEAST:
        raise ValueError(too_few(system, s, int(count)))

    def largest(y: Array):
        return xp.max(xp.abs(y))

    def by_name(y: Array):
        return {name: largest(value) for name, value in model.split(xp.max(xp.abs(y[:, :, 0]), axis=0)).items()}

    displacement, invariance = by_name(found.displacement), by_name(found.invariance)
    of_velocities = {name for name, c in system.constraints.items() if not c.of_positions}
    residual = xp.max(xp.stack([largest(found.charge), *displacement.values()]))
    at = s._replace(t=found.states.t[0], q=model.tree(found.states.x[0]), v=model.tree(found.states.u[0]))
    rate = found.first[0]
    if model.m:
        multipliers = accelerations_at(model, at)[1]
        rate = rate + xp.concatenate([xp.ravel(multipliers[name]) for name in system.constraints]) @ found.pushed[:, 0]
    return SymmetryTest(
        generator.name,
        xp.where(count < AT_LEAST, xp.full_like(residual, xp.nan), residual),
        largest(found.charge), largest(found.lagrangian), largest(found.force),
        system.is_forced,
        displacement, {name: invariance[name] for name in sorted(of_velocities)},
        found.charges[0, 0], rate, count,
        "" if xp is not np else f"t = {float(s.t):.6g}, q = {describe(at.q)}, v = {describe(at.v)}",
    )  # fmt: skip


def too_few(system, s, count) -> str:
    """The message that a symmetry could not be tested."""
    cause = "constraints that the given state is far from" if system.constraints else "a state where L is not finite"
    return (
        f"only {count} states were found around q = {describe(s.q)} that satisfy the constraints and where L is finite."
        f"\nUsual cause: {cause}, or a state at the edge of the domain of L.\n"
        "Fix: a state from the middle of the motion; lj.consistent_state(system, t, q, v, params) moves one onto the "
        "constraints."
    )
