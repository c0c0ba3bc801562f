"""Poincaré sections, periods and turning points, from the recorded crossings of a motion.

A section is a surface `s(t, q, v, params) = 0` of phase space that the motion keeps crossing. The points of the section
are those where it crosses upward, `ds/dt > 0`. A map takes each point to the next; a periodic motion is a fixed point
of that map or of its iterates, and the times between crossings are its periods,

    T[k] = t[k+1] - t[k].

A coordinate has a turning point where its velocity changes sign: for a central motion of unit mass, where the energy
equals the effective potential, `E = U(r) + h²/(2r²)`.

All of this comes from the crossings that `lj.integrate` records; `event_times.py` has their derivatives.
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.display import labelled
from lagjax.display import plots as plot
from lagjax.integrate import Crossing, Crossings, Trajectory, angle_mask, crossings_of, curves, integrate
from lagjax.jaxtools import is_traced
from lagjax.refusals import must_be, must_be_function, must_differ, must_go_together, must_name
from lagjax.system import Hybrid, System, by_name, coordinates

SECTION = "section"
# The number of crossings that are kept if the section is given as a function.
ROOM = 500
TURN = 2 * np.pi
# A coordinate varies in a section if its range exceeds this part of what it can move between two crossings.
VARIES = 1e-7
AS_CROSSING = 'lj.Crossing(lambda t, q, v, params: q["x"], direction=1, terminal=False, most=1000)'


class PoincareSection(eqx.Module):
    """The crossings of a section in the order of time, and the motion. It prints and plots itself.

    - `trajectory`: the `Trajectory`; `event`: the name of the crossings in its `events`. So
      `lj.PoincareSection(traj, "apex").plot()` draws any recorded event of a motion.
    - `t` (C,): the times of the crossings, `[t]`; NaN beyond the last one. C is `most` of the `lj.Crossing`.
    - `q`, `v`: the states there, each leaf with a leading axis C, padded in the same way; `[q]`, `[q]/[t]`.
    - `count`: how many crossings there were, including those that were not kept.
    - `uncertain`: whether some may be missing; see `Crossings`.

    Crossings are found along the steps: they do not depend on the outputs of the motion. Under `vmap` every array
    has the batch's axes in front.

    **Raises:** `ValueError` for an event that the trajectory did not record.
    """

    trajectory: Trajectory
    event: str = eqx.field(static=True, default=SECTION)

    def __check_init__(self):
        fix = f"lj.integrate(..., events={{'{self.event}': {AS_CROSSING}}}), or lj.poincare(..., section=...)"
        must_name(self.event, self.trajectory.events, "a section names", "event of the trajectory", fix)

    @property
    def crossings(self) -> Crossings:
        """The crossings, as they were recorded."""
        return self.trajectory.events[self.event]

    @property
    def t(self) -> Float[Array, " C"]:
        return self.crossings.t

    @property
    def q(self) -> PyTree[Float[Array, "C ..."]]:
        return self.crossings.q

    @property
    def v(self) -> PyTree[Float[Array, "C ..."]]:
        return self.crossings.v

    @property
    def count(self) -> Int[Array, ""]:
        return self.crossings.count

    @property
    def uncertain(self) -> Bool[Array, ""]:
        return self.crossings.uncertain

    def plot(self, x: str | None = None, y: str | None = None):
        """Plot velocities against coordinates at the crossings, a panel per coordinate; returns a matplotlib `Figure`.

        A coordinate that the section holds fixed has no panel if another one varies. An angle (a coordinate that enters
        only through sines and cosines) that goes around is drawn between -π and π. The lanes of a batch differ in
        colour.

        **Arguments:** `x`, `y`: for a single panel, what is drawn to the right and what upward, by names such as
        `"q.theta"`, `"v.theta"`, `"q[0]"` and `"t"`.

        **Raises:** `ImportError` without matplotlib; `ValueError` if nothing was crossed, for unknown names, and for
        `x` without `y`.
        """
        lanes = self._lanes()
        drawn = {name: [lane[name] for lane in lanes] for name in lanes[0]}
        if not any(map(len, drawn["t"])):
            raise ValueError(
                "there is nothing to plot: the motion did not cross the section.\n"
                "Usual cause: times that end too soon, a level that is not reached, or the wrong direction.\n"
                "Fix: a later ts[-1], or section=lj.Crossing(..., direction=0, terminal=False)."
            )
        must_go_together({"x": x, "y": y}, "a panel needs both", 'plot(x="q.theta", y="v.theta")')
        must_name([name for name in (x, y) if name is not None], drawn, "plot was given", "column", "'{}'")
        pairs, angles = self._pairs(lanes[0])
        pairs = _varying(drawn, pairs, angles) if x is None else [(x, y)]
        # All lanes are wrapped or none: they share the picture.
        around = [name for name in angles if np.ptp(np.concatenate(drawn[name])) > TURN]
        drawn |= {name: [_within_half_turns(values) for values in drawn[name]] for name in around}
        panels = {(a, b): (list(zip(drawn[a], drawn[b])), a in angles) for a, b in pairs}
        return plot.section(panels, self._not_kept())

    def _lanes(self):
        """The values of each lane that can be drawn, by name, up to its last crossing."""
        found = []
        for t, q, v in _lanes_of(self, (self.t, self.q, self.v)):
            of_rows = {"t": t} | {f"{kind}{_entry(name)}": x for kind, tree in (("q", q), ("v", v))
                                  for name, x in curves(tree).items()}  # fmt: skip
            found.append({name: x[np.isfinite(t)] for name, x in of_rows.items()})
        return found

    def _pairs(self, names):
        """The names of each coordinate and its velocity, and the set of names of angles."""
        q, v = ([name for name in names if name[0] == kind] for kind in "qv")
        is_angle = angle_mask(_lanes_of(self, self.trajectory)[0])
        return list(zip(q, v)), {name for name, yes in zip(q, is_angle) if yes}

    def _not_kept(self):
        """A note on crossings for which there was no room, or an empty string."""
        room, counts = self.t.shape[-1], np.ravel(self.count)
        most, more = counts.max(initial=0), np.count_nonzero(counts > room)
        if not more:
            return ""
        return f"{f'of {more} lanes ' if np.ndim(self.count) else ''}the first {room} of up to {most} crossings"

    def __repr__(self):
        if is_traced(self):
            return f"Poincaré section, being traced, room for {self.t.shape[-1]} crossings"
        rows = _batch_rows(self) if np.ndim(self.count) else _rows(self)
        return labelled("Poincaré section", rows)


@by_name("lj.poincare(system, q0, v0, params, section=section, ts=ts)", "section", "ts")
def poincare(
    system: System | Hybrid,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    section: Callable | Crossing,
    ts: ArrayLike,
    events: Mapping[str, Crossing] | None = None,
    **settings,
) -> PoincareSection:
    """Record where a motion crosses a surface of phase space, in one direction: a Poincaré section.

    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    >>> middle = lambda t, q, v, params: q
    >>> section = poincare(spring, 1.0, 0.0, {"k": 4.0}, section=middle, ts=[0.0, 10.0])
    >>> print(section.count, section.v[:3].round(6), periods(section)[:2].round(6))
    3 [2. 2. 2.] [3.141593 3.141593]

    **Arguments:**

    - `system`, `q0`, `v0`, `params`: as in `lj.integrate`.
    - `section`: `section(t, q, v, params)` -> a number in any unit, zero on the surface. Crossings from below zero are
      counted, and the first 500 kept. Or an `lj.Crossing` with `terminal=False`, for another `direction` and for more
      crossings (`most`; in a batch each lane takes the time for all of them). A start on the surface is not a crossing.
      For once per period of a drive cos(ωt): `lambda t, q, v, params: jnp.sin(params["omega"] * t)`, which comes from
      below at ωt = 2π, 4π, ...
    - `ts`: as in `lj.integrate`; `[0.0, 1000.0]` is enough: crossings are found between outputs too.
    - `events`: other events, for instance one that ends the motion when it escapes.
    - `settings`: other arguments of `lj.integrate`, such as `rtol`.

    **Returns:** a `PoincareSection`. Both modes differentiate its times and states, which stay on the surface.

    **Raises:**

    - `TypeError` for a section that is not a function; `ValueError` for a section that ends the motion, and in a motion
      in phases for one that takes multipliers; and what `lj.integrate` raises.
    - Warns (`lj.EventWarning`) if crossings may be missing, and if there were more than are kept. In batches and under
      `jit` look at `uncertain` and `count`, which are printed and drawn too.

    Source: Hénon & Heiles, *Astron. J.* 69 (1964) 73, §4; Hénon, *Physica D* 5 (1982) 412 (points that are exactly on
    the surface).
    """
    others = crossings_of(events, None)
    must_differ([SECTION, *others], "an event in events= and the section itself", "another name in events=")
    recorded = {SECTION: _recorded(section), **others}
    return PoincareSection(integrate(system, q0, v0, params, ts=ts, events=recorded, **settings))


def periods(crossings: Crossings | PoincareSection) -> Float[Array, " C-1"]:
    """The times between consecutive crossings, which are the periods of a periodic motion; outputs do not matter.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> t = jnp.array([0.5, 2.5, 4.75, jnp.nan])
    >>> print(periods(Crossings(t, q=t, v=t, multipliers={}, count=3, uncertain=False)))
    [2.   2.25  nan]

    **Arguments:** `crossings`: `traj.events["apex"]`, or what `lj.poincare` returns. For crossings in both directions
    (`direction=0`) the times between are parts of a period.

    **Returns:** (C-1,), `[t]`, positive even if the motion ran backward; NaN beyond the last one, which `jnp.nanmean`
    leaves out, and which does not affect derivatives of the others in either mode. Under `vmap` with the batch's axes
    in front.

    **Raises:** `TypeError` for arguments that are not crossings; `ValueError` if only one crossing is kept.

    Source: Landau & Lifshitz, *Mechanics*, §11.
    """
    example = 'lj.periods(traj.events["apex"]), with events={"apex": lj.turning_points(direction=-1)} in lj.integrate'
    claim = "the argument of lj.periods must be crossings"
    must_be(Crossings | PoincareSection, crossings, claim, f"{example}; or lj.periods(lj.poincare(...))")
    if crossings.t.shape[-1] < 2:
        raise ValueError(
            "only one crossing was kept, and a period is the time from one to the next.\n"
            "Usual cause: a crossing that ends the motion, as lj.Crossing does by default.\n"
            f"Fix: {AS_CROSSING}."
        )
    return jnp.abs(crossings.t[..., 1:] - crossings.t[..., :-1])


def turning_points(
    coordinate: str | None = None, direction: int = 0, terminal: bool = False, most: int = 32
) -> Crossing:
    """An event for `lj.integrate`: a coordinate turns, that is, its velocity changes sign, at outputs or between them.

    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    >>> events = {"top": turning_points(direction=-1)}
    >>> traj = lj.integrate(spring, 0.0, 3.0, {"k": 4.0}, ts=[0.0, 10.0], events=events)
    >>> print(traj.events["top"].found().q.round(6))
    [1.5 1.5 1.5]

    **Arguments:**

    - `coordinate`: its name, as `lj.explain` and messages write it: `"theta"`, `"r[0]"`, `"body.x"`, and `"q[1]"` of a
      vector. None if the system has only one.
    - `direction`: -1 for the greatest values (an apex, an aphelion), 1 for the smallest, 0 for both.
    - `terminal`, `most`: see `lj.Crossing`; by default this event does not end the motion.

    **Returns:** an `lj.Crossing`; `traj.events["top"].q` are then the turning points. A start at rest is not one.

    **Raises:** `TypeError` for a coordinate that is not a name; `ValueError`, from `lj.integrate`, for an unknown name,
    and for None if there are several coordinates.

    Source: Landau & Lifshitz, *Mechanics*, §11 and eq. (14.9).
    """
    fix = 'lj.turning_points("theta"), or lj.turning_points("q[0]") of a vector'
    must_be(str | None, coordinate, "a coordinate must be given by its name", fix)
    return Crossing(Velocity(coordinate), direction, terminal, most)


class Velocity(eqx.Module):
    """The velocity of one coordinate, as a guard."""

    coordinate: str | None = eqx.field(static=True)

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        names, wanted = coordinates.names(v), self.coordinate
        if wanted is None and len(names) > 1:
            raise ValueError(
                f"turning points of which coordinate? There are {', '.join(names)}.\n"
                f'Fix: lj.turning_points("{names[0]}").'
            )
        wanted = names[0] if wanted is None else wanted
        must_name(wanted, names, "turning points of", "coordinate", "lj.turning_points('{}')")
        return coordinates.numbers(v)[names.index(wanted)]


def _recorded(section):
    """Return the section as a crossing to be recorded."""
    if not isinstance(section, Crossing):
        example = 'section=lambda t, q, v, params: q["x"]'
        must_be_function(section, "a section", "(t, q, v, params), or a lj.Crossing", example)
        return Crossing(section, direction=1, terminal=False, most=ROOM)
    if section.terminal:
        raise ValueError(
            "this section ends the motion at its first crossing, as lj.Crossing does by default.\n"
            f"Fix: section={AS_CROSSING}."
        )
    return section


def _entry(name: str):
    """The part of a coordinate's name after "q" or "v": `theta` -> `.theta`, `q[0]` -> `[0]`."""
    return name[1:] if name == "q" or name.startswith("q[") else f".{name}"


def _lanes_of(section, tree):
    """The lanes of a batch, in NumPy; one motion is a single lane."""
    axes = np.ndim(section.t) - 1
    flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *np.shape(x)[axes:]), tree)
    return [jax.tree.map(lambda x: x[i], flat) for i in range(np.size(section.count))]


def _varying(drawn, pairs, angles):
    """The pairs whose coordinate the section does not hold fixed; all pairs if it holds all of them."""
    gaps = np.concatenate([np.abs(np.diff(t)) for t in drawn["t"]])
    gap, found = np.mean(gaps) if gaps.size else 0.0, []
    for x, y in pairs:
        q, v = np.concatenate(drawn[x]), np.concatenate(drawn[y])
        # Relative to the first one, so that angles are compared as angles.
        off = _within_half_turns(q - q[0]) if x in angles else q
        if np.ptp(off) > VARIES * gap * np.max(np.abs(v)):
            found.append((x, y))
    return found or pairs


def _within_half_turns(angle):
    # Round-off must not separate values at half a turn, as on sin(q) = 0.
    cut = np.pi + 1e-6
    return (angle + cut) % TURN - cut


def _known_periods(section):
    found = np.asarray(periods(section)) if section.t.shape[-1] > 1 else np.zeros(0)
    return found[np.isfinite(found)]


def _rows(section):
    found = _known_periods(section)
    yield "crossings", section.crossings.in_words()
    if found.size:
        low, high = (f"{x:.9g}" for x in (found.min(), found.max()))
        yield "period", f"{found.mean():.9g} on average, {low} to {high}, standard deviation {found.std():.2g}"
    errors = section.trajectory.error
    if errors is not None:
        of_times = np.asarray(errors.events[section.event])
        known = of_times[~np.isnan(of_times)]
        if known.size:
            yield "error", f"of the times at most {known.max():.1e} (estimated)"
    yield "uncertain", "yes" if bool(section.uncertain) else "no"


def _batch_rows(section):
    counts, found, doubtful = np.ravel(section.count), _known_periods(section), int(np.sum(section.uncertain))
    yield "lanes", " x ".join(map(str, np.shape(section.count)))
    kept = f"; {section._not_kept()} are kept" if section._not_kept() else ""
    yield "crossings", f"{counts.min()} to {counts.max()} a lane{kept}" if counts.size else "no lanes"
    if found.size:
        yield "period", f"{found.mean():.9g} on average, {found.min():.9g} to {found.max():.9g}"
    yield "uncertain", f"{doubtful} of {counts.size} lanes: crossings may be missing" if doubtful else "no"
