"""A periodic orbit, the result of `lj.periodic_orbit`."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.analysis.orbits.shooting import OrbitRequest
from lagjax.integrate import Switches, Trajectory, integrate
from lagjax.jaxtools import HashablePart, is_traced
from lagjax.mechanics import describe
from lagjax.system import Hybrid, System, coordinates

POINTS = 401


class PeriodicOrbit(eqx.Module):
    """A motion that comes back to its start. It prints and plots itself.

    - `t`, `q`, `v`: a state on the orbit; `period`, `[t]`.
    - `turns`: the number of whole turns of each angle in a period, in the structure of `q`.
    - `shift`: how far the coordinates named in `relative` move in a period, in the structure of `q`; 0 elsewhere.
    - `residual`: how far the end is from the start, and held quantities from their values, in units of the motion's
      size.
    - `converged`: whether the residual is within the tolerance times what the motion amplifies, and below its square
      root; if not, this is the best orbit that was found.
    - `iterations`: the number of steps of Newton's method.
    - `nodes` (K, 2n): the states q and v, in the order of their names, at K equal parts of the period.
    - `switches`: the `Switches` in one period, where the system has phases or elements; else None.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    period: Float[Array, ""]
    turns: PyTree[Float[Array, "..."]]
    shift: PyTree[Float[Array, "..."]]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    nodes: Float[Array, "K 2n"]
    arrays: PyTree
    static: HashablePart = eqx.field(static=True)
    asked: OrbitRequest = eqx.field(static=True)
    switches: Switches | None = None

    @property
    def system(self) -> System | Hybrid:
        return self._problem()[0]

    @property
    def params(self) -> PyTree:
        return self._problem()[1]

    def _problem(self):
        return self.static.combine(self.arrays)

    @property
    def trajectory(self) -> Trajectory:
        """The motion over one period, 401 states, by `lj.integrate`; not available for a batch.

        It starts at `q`, `v`, and leaves an unstable orbit by as much as that amplifies its tolerance: what lies on the
        orbit throughout are its `nodes`.
        """
        self._check_alone("trajectory")
        ts = float(self.t) + float(self.period) * np.linspace(0.0, 1.0, POINTS)
        return integrate(self.system, self.q, self.v, self.params, ts=ts.astype(self.t.dtype))

    def plot(self):
        """Plot velocities against coordinates, one panel each, with a dot at the start; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batch.
        """
        return self.trajectory.phase_portrait()

    def _check_alone(self, what):
        if np.ndim(self.period):
            raise ValueError(
                f"this is a batch of orbits of shape {np.shape(self.period)}: select one of them.\n"
                f"Fix: jax.tree.map(lambda x: x[0], orbit).{what}"
            )

    def __repr__(self):
        if is_traced(self):
            return "PeriodicOrbit(being traced)"
        if np.ndim(self.period):
            shape, good = " x ".join(map(str, np.shape(self.period))), int(np.sum(np.asarray(self.converged)))
            low, high = np.min(self.period), np.max(self.period)
            return f"Periodic orbits, {shape} lanes, {good} converged, periods {low:.9g} to {high:.9g}"
        rows = [("period", f"{float(self.period):.12g}")]
        rows.append(("start", f"t = {float(self.t):.6g}, q = {describe(self.q)}, v = {describe(self.v)}"))
        rows += [
            (label, moved) for label, tree in (("turns", self.turns), ("shift", self.shift)) if (moved := _moved(tree))
        ]
        rows.append(("residual", f"{float(self.residual):.1e} (relative), after {int(self.iterations)} iterations"))
        if self.switches is not None:
            rows.append(("switches", self.switches.in_words()))
            rows += [("", row) for row in self.switches.in_rows()]
        if not bool(self.converged):
            rows.append(("WARNING", "not converged: this is the best that was found"))
        return "\n".join(["Periodic orbit", *(f"  {label:<9}  {value}" for label, value in rows)])


def _moved(tree):
    values, names = np.asarray(coordinates.flatten(tree)[0]), coordinates.names(tree)
    return ", ".join(f"{name} {value:+.9g}" for name, value in zip(names, values) if value)
