"""What `connect` returns: a motion between two ends, and what kind of stationary path it is."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate import Trajectory

# Ends count as conjugate where an error of the path, but at least this round-off, decides what the start velocity is.
ROUND_OFF = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-5}

# The second variation of a path says nothing where its elements follow it less well than this.
UNRESOLVED = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}


class Connection(eqx.Module):
    """A motion between two ends; the answer of least action, where several were found.

    - `q`, `v`: the path at `t` (T,), in the structure of the ends; `multipliers` of its constraints by name.
    - `trajectory`: the motion of `integrate` from the start with `start_velocity`, on which the end is met; None where
      there is none: L is singular at the start, or an error there grows too much on the way (`alone` says which).
    - `start_velocity`, `end_velocity`: in the structure of the ends; `duration`: T = t_b - t_a.
    - `action`: S = ∫ L dt along the path, from which the motion is at no output farther than a thousandth of its
      extent; NaN where the motion was found by shooting alone (`lj.action` has it).
    - `index`: the Morse index, the number of independent variations with fixed ends that lower the action; -1 where
      there is no action principle. `kind`: the same in words. `conjugate_times`: the times of the points conjugate to
      the start, one for each direction; None while JAX traces.
    - `amplification`: the relative change of the start velocity by one of the end; large near a conjugate end.
    - `missed`: by how much `trajectory` misses the end, in units of the path's extent, and a condition in units of what
      it changes by on the way. `converged`: whether that is below 1e-6 (1e-3 in float32); where L is singular at the
      start, so that there is no motion, whether the path was found. A path that no motion follows is not `converged`:
      it is all that `q`, `v`, `action` and `index` are of.
    - `mesh_error`: the highest Legendre coefficients on its `elements`. By shooting alone there are none:
      `amplification` and `mesh_error` are NaN.
    - `others`: further answers, by rising action. `tried`: what was tried, in words. Where nothing was found, `q` and
      `v` are what came nearest, and there is no velocity, action, index or amplification.
    """

    t: Float[Array, " T"]
    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    trajectory: Trajectory | None
    start_velocity: PyTree[Float[Array, "..."]]
    end_velocity: PyTree[Float[Array, "..."]]
    duration: Float[Array, ""]
    action: Float[Array, ""]
    index: Int[Array, ""]
    amplification: Float[Array, ""]
    missed: Float[Array, ""]
    mesh_error: Float[Array, ""]
    converged: Bool[Array, ""]
    conjugate_times: Any
    others: "tuple[Connection, ...]" = ()
    tried: str = eqx.field(static=True, default="")
    elements: int = eqx.field(static=True, default=0)
    why_not_variational: str = eqx.field(static=True, default="")
    alone: str = eqx.field(static=True, default="")

    @property
    def kind(self) -> str:
        """ "minimum", "saddle of index 1", "degenerate: ends are conjugate", "not found", or why none."""
        if not bool(self.converged) and not self.alone:
            return "not found"
        if not bool(self.converged):
            return f"a path alone: {self.alone}"
        if self.why_not_variational:
            return f"not variational: {self.why_not_variational}"
        dtype = np.asarray(self.amplification).dtype
        if float(self.mesh_error) > UNRESOLVED[dtype]:
            return f"not resolved: the elements follow the path to {float(self.mesh_error):.0e}"
        if float(self.amplification) * max(float(self.mesh_error), ROUND_OFF[dtype]) > 0.1:
            return "degenerate: ends are conjugate"
        return "minimum" if int(self.index) == 0 else f"saddle of index {int(self.index)}"

    def plot(self, *names: str, **options):
        """Plot the motion: `Trajectory.plot`."""
        if self.trajectory is None:
            raise ValueError("there is a path and no motion to plot.\nFix: plot .t and .q yourself.")
        return self.trajectory.plot(*names, **options)

    def __repr__(self):
        if np.ndim(self.action) or not isinstance(self.action, (np.ndarray, np.generic, float)):
            try:
                action = np.asarray(self.action)
            except Exception:
                return "Connection(traced)"
            if action.ndim:
                return f"Connection({action.size} lanes)"
        if not bool(self.converged) and not self.alone:
            starts = f"; {self.tried.count('; ') + 1} starts, as `tried` says" if self.tried else ""
            return f"Connection(not found{starts})"
        motion = f"motion misses {float(self.missed):.0e}" if self.trajectory is not None else "no motion"
        more = f"; {len(self.others)} more" if self.others else ""
        found = f"action {float(self.action):.9g} in a time of {float(self.duration):.6g}; {self.elements} elements to "
        found += f"{float(self.mesh_error):.0e}"
        if not self.elements:
            found = f"in a time of {float(self.duration):.6g}; by shooting alone"
        return f"Connection({self.kind}; {found}, {motion}{more})"
