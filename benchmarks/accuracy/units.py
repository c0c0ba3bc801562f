"""Does the accuracy of the default method depend on the user's units? All scenes in other units of length and time.

    metres to micrometres, to gigametres       lengths become a million times larger, a billion times smaller numbers
    seconds to years, to nanoseconds           likewise times

The same motion is integrated with only `ts` given, and its error against the scene's own closed form is compared with
that in the scene's units; an error within the tolerance always counts as right. Angles are not rescaled. The twin
passes `atol`, 1e-9 of whatever the unit is, and must miss. The exit status is 1 if a target is missed.

    python -m benchmarks.accuracy.units [--json FILE] [--twin]
"""

import sys
import warnings
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

import lagjax as lj
from benchmarks.measure import main, row
from lagjax.scenes import SCENES

jax.config.update("jax_enable_x64", True)

YEAR = 365.25 * 24 * 3600
# The new units of length and time, in units of the old ones.
UNITS = {
    "micrometres": (1e-6, 1.0),
    "gigametres": (1e9, 1.0),
    "years": (1.0, YEAR),
    "nanoseconds": (1.0, 1e-9),
    "micrometres, years": (1e-6, YEAR),
    "gigametres, nanoseconds": (1e9, 1e-9),
}
# Names of coordinates that are not lengths; a coordinate without a name is an angle in all scenes.
ANGLES = {"theta", "phi", "psi"}
RTOL, AT_MOST = 1e-9, 10.0
TWIN = "--twin"


class Units(NamedTuple):
    """The units of each coordinate, with the structure of q, and of time."""

    of_q: object
    of_t: float

    @property
    def of_v(self):
        return jax.tree.map(lambda c: c / self.of_t, self.of_q)


class Rescaled(NamedTuple):
    """A function of (t, q, v, params), or (t, q, params), that takes its arguments in other units."""

    function: object
    units: Units
    times_q: bool = False

    def __call__(self, t, q, *rest):
        *v, params = rest
        v = [_times(part, self.units.of_v) for part in v]
        value = self.function(t * self.units.of_t, _times(q, self.units.of_q), *v, params)
        return _times(value, self.units.of_q) if self.times_q else value


def _times(y, units):
    return jax.tree.map(lambda y, c: y * c, y, units)


def in_units(system, units):
    """The same system for numbers in other units."""
    constraints = {
        name: lj.Holonomic(lambda t, q, p, g=c.g: g(t * units.of_t, _times(q, units.of_q), p))
        if isinstance(c, lj.Holonomic)
        else lj.Nonholonomic(Rescaled(c.phi, units))
        for name, c in system.constraints.items()
    }
    force = None if system.force is None else Rescaled(system.force, units, times_q=True)
    dissipation = None if system.dissipation is None else Rescaled(system.dissipation, units)
    return lj.System(Rescaled(system.lagrangian, units), constraints, force, dissipation)


def units_of(run, of_length, of_time):
    """The units of a scene's motion."""
    q0 = jax.tree.map(lambda x: np.asarray(x, float), run.q0)
    if isinstance(q0, dict):
        return Units({name: 1.0 if name in ANGLES else of_length for name in q0}, of_time)
    return Units(jax.tree.map(lambda x: of_length if np.ndim(x) else 1.0, q0), of_time)


def solved(run, units=None, **options):
    """The motion of a scene, integrated in other units and converted back."""
    to = lambda y, c: jax.tree.map(lambda y, c: np.asarray(y, float) / c, y, c)
    units = units or units_of(run, 1.0, 1.0)
    of_q, of_t, of_v = *units, units.of_v
    system = in_units(run.system, units)
    # The guards of the scenes depend only on multipliers, which do not change.
    traj = lj.integrate(
        system, to(run.q0, of_q), to(run.v0, of_v), run.params, ts=run.ts / of_t, events=run.events, **options
    )
    end = traj.end._replace(t=traj.end.t * of_t, q=_times(traj.end.q, of_q), v=_times(traj.end.v, of_v))
    return replace(traj, t=traj.t * of_t, q=_times(traj.q, of_q), v=_times(traj.v, of_v), end=end)


def rows(wanted, options, missing):
    """The ratio of the error in other units to that in the scene's units, and the ratio of the steps."""
    for name, scene in SCENES.items():
        for run in scene.runs():
            if not wanted(f"{name}, {run.name}"):
                continue
            usual = solved(run, **options)
            expected = max(run.error(usual), RTOL)
            for which, factors in UNITS.items():
                other = solved(run, units_of(run, *factors), throw=False, **options)
                found = float(run.error(other))
                steps = int(other.stats["num_steps"]) / int(usual.stats["num_steps"])
                ratio = found / expected if np.isfinite(found) else np.inf
                line = row(f"{name}, {run.name}: {which}", ratio, AT_MOST, error=found, steps=steps)
                missing.extend([] if line["met"] else [line])
                yield line


if __name__ == "__main__":
    warnings.simplefilter("ignore", lj.AccuracyWarning)
    options = {"atol": RTOL} if TWIN in sys.argv else {}
    sys.argv = [word for word in sys.argv if word != TWIN]
    missing = []
    main(lambda wanted: rows(wanted, options, missing), __doc__)
    sys.exit(bool(missing))
