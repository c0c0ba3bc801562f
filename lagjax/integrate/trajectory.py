"""The result of an integration: times, states, multipliers, how it went; in phases also these, and the switches."""

import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.display import Animation, by_line, labelled
from lagjax.display import plots as plot
from lagjax.integrate import pictures, results
from lagjax.integrate.data import dataset, save
from lagjax.integrate.dense_output import at
from lagjax.integrate.events.event import Crossings
from lagjax.integrate.pictures import curves, finite, panels
from lagjax.integrate.results import (
    ENDED_WELL,
    NO_PHASE,
    RESULTS,
    Errors,
    Snapshot,
    SolveOptions,
    StaticPart,
    angle_mask,
    columns,
    is_among,
    item,
    message,
    mode_in_words,
)
from lagjax.integrate.stepping import rounded
from lagjax.jaxtools import compiled, is_traced, jitted, numpy_of
from lagjax.mechanics import what_changes_jacobi_integral, worst_residual
from lagjax.refusals import must_be_single
from lagjax.system import Hybrid, InModes, Model, System, UnknownSystem, known_system, model_of

# A line through fewer outputs says nothing of a drift.
ENOUGH_FOR_A_SLOPE = 8


class AccuracyWarning(UserWarning):
    """A motion was computed, and its own checks show that it is less accurate than its tolerance suggests."""


class Trajectory(eqx.Module):
    """A motion at the requested times. It prints its own quality, and can plot and animate itself.

    - `t` (T,): the requested times, increasing or decreasing.
    - `q`, `v`: in the structure of the initial state, each leaf with a leading axis T. NaN after an event
      or a failure ended the motion.
    - `multipliers`: by constraint name, (T, *shape of the constraint), from the projected states.
    - `end`: the last instant reached (`t`, `q`, `v`, `multipliers`): the event, where one ended the motion.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`; where forces jump, `num_jumps` (of those that
      depend on q or v) and `lost_jumps`, whether some were not followed.
    - `error`: estimates of the errors of `q`, `v`, `multipliers` and of the times of `events` (`Errors`); None if they
      were not made.
    - `scaled_error`: the worst error in units of what is allowed (10,000 tolerances, and a thousandth of each number);
      above 1 the motion is less accurate than that, and `integrate` warns. Without `error` it is the change of the
      Jacobi integral, if it must be constant, and of the constraints, in units of what the tolerance lets expect; 0 if
      nothing must be constant. Infinite for a motion that failed. A number that is zero throughout has its error as
      its size: no verdict depends on units. Errors, changes and sizes are those at the outputs: one that is larger
      between two of them is not seen.
    - `result`: a `RESULTS` item; `lj.RESULTS.successful`, `event_occurred`, or what went wrong.
    - `events`: by name, the `Crossings` of the requested events.
    - `params`, `system`: what was integrated; `asked`: the method and the steps that were asked for. `tolerance`:
      (rtol, atol), each (2,): for coordinates and for velocities. If no atol was given it is (2, n), one for each
      number: what is as good as zero in this motion.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, " T"]
    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    end: Snapshot
    stats: dict[str, Array]
    scaled_error: Float[Array, ""]
    result: RESULTS
    events: dict[str, Crossings]
    tolerance: tuple[Array, Array]
    arrays: PyTree
    static: StaticPart = eqx.field(static=True)
    error: Errors | None = None
    in_phases: ClassVar[bool] = False

    @property
    def system(self) -> System:
        return known_system(self.any_system)

    @property
    def any_system(self) -> System | UnknownSystem:
        """The system; for a trajectory that was read from a file without it, the description in the file."""
        return self._problem()[0]

    @property
    def params(self) -> PyTree:
        return self._problem()[1]

    @property
    def asked(self) -> SolveOptions:
        return self._problem()[2]

    def _problem(self):
        return self.static.rest.combine(jax.tree.leaves(self.arrays))

    def rows(self) -> dict:
        """The fields with one row per output, by name."""
        return {"t": self.t, "q": self.q, "v": self.v, "multipliers": self.multipliers}

    @property
    def model(self) -> Model:
        """The system prepared for states of this form. Not for batched trajectories."""
        states = self.t, self.q, self.v
        xp = numpy_of(states)
        return model_of(self.system, *jax.tree.map(lambda x: xp.asarray(x)[0], states), self.params)

    def jacobi_integral(self) -> Float[Array, " T"]:
        """The Jacobi integral `v·p - L` at every output, (T,), `[L]`. Not for batched trajectories."""
        return jacobi_and_scale(self.model, self.t, self.q, self.v)[0]

    def drift(self) -> Float[Array, ""]:
        """The largest change of the Jacobi integral at the outputs, relative to the largest `|v·p| + |L|` there.

        One that comes and goes between two outputs is not seen.
        """
        return _worst_drift(self.model, self.t, self.q, self.v)

    def residual(self) -> Float[Array, ""]:
        """The worst constraint residual over all outputs, positions and velocities, relative; 0 without constraints.

        Between outputs it is not computed: `at(t)` is on the constraints there.
        """
        if not self.system.constraints:
            return jnp.zeros_like(self.scaled_error)
        return _worst_residual(self.model, self.t, self.q, self.v)

    def at(self, t: ArrayLike) -> Snapshot:
        """Return the motion at any time, at the order of its method: continued from the output before by its own steps.

        >>> import lagjax as lj
        >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
        >>> traj = lj.integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=[0.0, 0.2, 0.5])
        >>> now = traj.at([0.1, 0.2])
        >>> print(now.q.round(9), now.v.round(9))
        [0.25 0.4 ] [2. 1.]

        **Arguments:** `t`: a time or an array of them, of any shape and in any order, `[t]`, between the first output
        and the end of the motion.

        **Returns:** a `Snapshot` (`t`, `q`, `v`, `multipliers`), each leaf with the shape of `t` in front; on the
        constraints. At an output it is that output. For a batch the batch's axes come first. It is differentiable
        in `t` and in everything the motion depends on. Under `jit` and in a batch it is NaN outside of the motion.

        Each time costs a short solve from the previous output: with outputs as dense as steps, one step.

        **Raises:** `ValueError` for a time outside of the motion, or after its end by an event or a failure; for
        outputs off the constraints (`drift="none"`), and for a controller that plans the steps of the whole motion.
        """
        return at(self, t)

    def save(self, path: str | os.PathLike) -> None:
        """Write the motion into a file, an npz; `lj.load_trajectory(path, system)` reads it, bit for bit.

        The functions of the system are not in it. If writing is interrupted, the previous file remains.

        **Raises:** `TypeError`, naming them, for entries of `params` or of the structure of q that are not data;
        `OSError` if there is no such folder.
        """
        save(self, path)

    def to_xarray(self, dims: Sequence[str] | None = None):
        """Return the motion as an `xarray.Dataset`.

        >>> import lagjax as lj
        >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
        >>> data = lj.integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=[0.0, 0.2, 0.5]).to_xarray()
        >>> print(data["q"].dims, data["q"].sel(t=0.2).item(), data.attrs["params.g"])
        ('t',) 0.4 10.0

        Variables are named as here, or `q.y`, `v.y`; their estimated errors `error.q.y`, and multipliers like their
        constraints. Their dimensions are `t` and, for a coordinate that is an array, `y_0` and so on. `result`, `end`
        and the numbers of steps are variables too; the method, tolerances and parameters are attributes.

        **Arguments:** `dims`: the names of a batch's axes, which come first; by default "batch", or "batch_0" and so
        on. The parameters of a batch are variables.

        **Raises:** `ImportError` without xarray; `ValueError` if the number of names differs from that of the axes.
        """
        return dataset(self, dims)

    def plot(self, charges: Any = False):
        """Plot coordinates, velocities and multipliers against time; returns a matplotlib `Figure`.

        `charges=True` adds the relative change of the quantities known to be conserved; `lj.symmetries(...)`, or
        functions of (t, q, v, params) by name, add that of others. The outputs are drawn, linked by straight lines:
        what happens between two of them is not seen.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batched trajectory, or without any charges.
        """
        self._check_alone("plot()")
        return plot.time_series(np.asarray(self.t), panels(self, charges), self._strips())

    def _strips(self) -> dict[str, list[tuple[float, float, str]]]:
        """What holds from when until when, by name: nothing without phases."""
        return {}

    def phase_portrait(self):
        """Plot velocities against coordinates, one panel per coordinate; returns a matplotlib `Figure`.

        A dot marks the start. An angle (a coordinate that enters only through sines and cosines) that goes around is
        drawn between -π and π. For a batched trajectory every lane is drawn. The outputs are linked by straight lines:
        what happens between two of them is not seen.

        **Raises:** `ImportError` without matplotlib.
        """
        lanes = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[self.t.ndim - 1 :]), self)
        lanes = [jax.tree.map(lambda x: x[i], lanes) for i in range(len(lanes.t))]
        is_angle = angle_mask(lanes[0])
        pairs = [(curves(lane.q), curves(lane.v)) for lane in lanes]
        drawn = {name: [finite(q[name], v[name]) for q, v in pairs] for name in pairs[0][0]}
        return plot.phase_portrait({name: (drawn[name], bool(yes)) for name, yes in zip(drawn, is_angle)})

    def animate(
        self, positions: Any = None, *, seconds: float | None = None, rate: float = 25.0, trail: float = 2.0
    ) -> Animation:
        """Animate the motion: points, lines that link them and trails, in the plane or in space; and bodies.

        >>> import lagjax as lj
        >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
        >>> traj = lj.integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=[0.0, 0.2, 0.5])
        >>> traj.animate(lambda t, q, params: (2.0 * t, q))  # thrown, at 2 along x
        Animation of 51 frames, 2 s, 10 kB: plays in a notebook, and with .save("motion.html") in a browser

        **Arguments:**

        - `positions`: `positions(t, q, params)` -> a point `(x, y)` or `(x, y, z)`; or points (k, 2) or (k, 3), linked
          by lines in order; or a dictionary of these, each name in its own colour. The last point of each leaves a
          trail. Plain NumPy works. Or shapes, `[lj.shapes.box(body, size), lj.shapes.trail(body)]`, functions among
          them; a `lj.shapes.Drawing`; or nothing for `lj.bodies.multibody`, whose bodies are drawn as boxes with their
          inertia.
        - `seconds`: how long it plays; by default as long as the motion takes in units of t, but 2 to 20 s.
        - `rate`: frames per second. Between outputs q is interpolated, cubically, with v as its slope: an impact or a
          pulse between two of them is smoothed away.
        - `trail`: how many seconds of playing the trails reach back.

        In space z is up. Drag to turn, wheel or pinch to zoom, shift and drag to move.

        **Returns:** an `Animation`. It ends with the motion: at an event, or at the last output before it failed.

        **Raises:** `ValueError` for a batched trajectory, positions that are not points, bodies whose pose is not
        known, and outputs too far apart to tell what happens between them; `TypeError` for what cannot be drawn.
        """
        self._check_alone("animate(positions)")
        ended_by_event = bool(self.result == RESULTS.event_occurred)
        return pictures.film(self, positions, seconds, rate, trail, ended_by_event)

    def draw(self, positions: Any = None, *, times: ArrayLike = 5, view: tuple[float, float] = (-60.0, 22.0)):
        """Draw several instants of the motion in one figure, earlier ones paler; returns a matplotlib `Figure`.

        **Arguments:**

        - `positions`: what is drawn, as in `animate`.
        - `times`: how many instants, equally far apart from the start to the end; or their times.
        - `view`: from where it is seen, in space: azimuth and elevation of the eye, in degrees. z is up, and all axes
          have one scale.

        **Raises:** `ImportError` without matplotlib; `ValueError` as `animate`, and for times outside of the motion.
        """
        self._check_alone("draw(positions)")
        ended_by_event = bool(self.result == RESULTS.event_occurred)
        return pictures.figure(self, positions, times, view, ended_by_event)

    def _of_system(self):
        """The printed rows on the system and its events."""
        of_events = [(f"event '{name}'", crossings.in_words()) for name, crossings in self.events.items()]
        if isinstance(self.any_system, UnknownSystem):
            return [("system", repr(self.any_system)), *of_events]
        found = []
        if self.system.constraints:
            found.append(("worst constraint residual", f"{float(self.residual()):.1e} (relative, at the outputs)"))
        changed_by = next(what_changes_jacobi_integral(self.model), None)
        as_it_may = "" if changed_by is None else f"; need not be conserved: {changed_by}"
        drift = f"{float(self.drift()):.1e} (relative, at the outputs)"
        found.append(("change of the Jacobi integral", drift + as_it_may))
        if self.static.how.steps == "fixed" and changed_by is None:
            found += _of_slope(self)
        return found + of_events

    def _check_alone(self, call: str):
        must_be_single(self.t.shape[:-1], "this trajectory", f"{{traj}}.{call}")

    def __repr__(self):
        if is_traced(self):
            return f"Trajectory({self.static.method}, being traced, t: {self.t.shape})"
        lanes = self.t.shape[:-1]
        return _batch_in_words(self, lanes) if lanes else _in_words(self)


@jitted
def jacobi_and_scale(model: Model, t: Array, q: PyTree, v: PyTree):
    """The Jacobi integral at each of a batch of states, and the size of its terms `|v·p| + |L|`."""

    def at(t: Array, q: PyTree, v: PyTree):
        x, u = model.vectors(q, v)
        value, p = jax.value_and_grad(model.lagrangian, argnums=2)(t, x, u)
        power = u @ p
        return power - value, jnp.abs(power) + jnp.abs(value)

    return jax.vmap(at)(t, q, v)


def worst_drift(model: Model, t: Array, q: PyTree, v: PyTree):
    """The largest change of the Jacobi integral from the first state on, relative to its largest terms."""
    h, scale = jacobi_and_scale(model, t, q, v)
    largest = jnp.nanmax(scale)
    return jnp.nanmax(jnp.abs(h - h[0])) / jnp.where(largest > 0, largest, 1.0)


_worst_drift, _worst_residual = compiled(worst_drift), compiled(worst_residual)


def _in_words(traj) -> str:
    """What one motion prints."""
    rows = [
        ("method", f"{traj.static.method}, {_lengths(traj)}"),
        ("result", message(traj.result) + _ended(traj)),
        *results.of_cost(traj),
        *(results.of_error(traj) or _not_estimated(traj)),
    ]
    rows += traj._of_system()
    if 1 < float(traj.scaled_error) < np.inf:
        times = f"{float(traj.scaled_error):.2g} times"
        rows.append(("WARNING", f"the error at the outputs is {times} what the tolerance lets expect"))
    rows += _shape_rows(traj)
    return labelled("Trajectory", rows)


def _of_slope(traj):
    """What fixed steps make of a Jacobi integral that stays constant: whether it only varies, or drifts."""
    t, h = np.asarray(traj.t, float), np.asarray(traj.jacobi_integral(), float)
    t, h = t[np.isfinite(h)], h[np.isfinite(h)]
    if len(h) < ENOUGH_FOR_A_SLOPE:
        return []
    slope = np.polyfit(t - t.mean(), h, 1)[0]
    rest = h - h.mean() - slope * (t - t.mean())
    # By the slopes of quarters. Around a line the values of a random walk, as of round-off, depend on each other.
    parts = zip(np.array_split(t - t.mean(), 4), np.array_split(h, 4))
    uncertain = np.std([np.polyfit(*part, 1)[0] for part in parts], ddof=1) / 2
    return [
        ("Jacobi integral", f"mean {h.mean():.12g}, varies by {np.ptp(rest) / 2:.1e}, "
         f"drifts by {slope:.1e} ± {uncertain:.1e} per unit of time")
    ]  # fmt: skip


def _not_estimated(traj):
    if traj.error is None or is_among(traj.error.result, ENDED_WELL):
        return []
    return [("error", message(traj.error.result))]


def _lengths(traj):
    """What chose the steps."""
    if traj.static.how.steps == "fixed":
        paced = getattr(traj.asked.method, "pace", None) is not None
        return f"steps of {float(traj.asked.dt0):.6g}{' times the pace' if paced else ''}"
    return f"rtol {_pair(traj.tolerance[0])}, atol {_absolute(traj.tolerance[1])}"


def _pair(tolerance):
    of_q, of_v = (f"{float(value):.3g}" for value in np.asarray(tolerance))
    return of_q if of_q == of_v else f"{of_q} (q), {of_v} (v)"


def _absolute(atol):
    return _pair(atol) if np.ndim(atol) == 1 else "by size"


def _batch_in_words(traj, lanes: tuple[int, ...]) -> str:
    """What a batch prints; `lanes`: its shape."""
    values, counts = np.unique(np.asarray(traj.result._value), return_counts=True)
    words = [f"{n} {message(item(traj.result, v))}" for v, n in zip(values, counts)]
    steps, errors = np.asarray(traj.stats["num_steps"]), np.asarray(traj.scaled_error)
    drifted = int(np.sum((errors > 1) & (errors < np.inf)))
    rows = [
        ("method", traj.static.method),
        ("lanes", " x ".join(map(str, lanes))),
        ("results", "; ".join(words)),
        *([("WARNING", f"{drifted} lanes are less accurate than the tolerance lets expect")] if drifted else []),
        ("steps a lane", f"{steps.min()} to {steps.max()}, {int(steps.sum())} in all" if steps.size else "no lanes"),
        *_shape_rows(traj),
    ]
    return labelled("Trajectory, a batch", rows)


def _ended(traj):
    first, last, end = *np.asarray(traj.t)[[0, -1]], float(traj.end.t)
    return "" if abs(end - first) >= abs(last - first) else f" (at t = {end:.9g} of {last:.6g})"


def _shape_rows(traj):
    rows = [("outputs", f"{traj.t.shape[-1]} times, {traj.t.dtype}")]
    for label, tree in (("q, v", traj.q), ("multipliers", traj.multipliers)):
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        if leaves:
            shown = [f"{jax.tree_util.keystr(p, simple=True, separator='.')} {x.shape}".strip() for p, x in leaves]
            rows.append((label, ", ".join(shown)))
    return rows


# What is struck jumps by more than so many round-offs of the velocities in the motion.
STRUCK = 1000
# The name under which switches are among the events of a motion; of what kind those of phases are.
SWITCHES, OF_PHASES = "switches", "switch"


class Switches(eqx.Module):
    """The switches of a motion, in order of time; it prints itself.

    - `t` (S,): their times, `[t]`; NaN beyond the last one. S is `most_switches` of the `lj.Hybrid`.
    - `way` (S,): which of the hybrid's switches each is, and `to` (S,): the number of the next phase; -1 beyond the
      last one. `names`: the names of all phases; `ways`: for each of the hybrid's switches, the phase it leaves.
    - `q`, `v`: the states before them, each leaf with a leading axis S; `q_after`, `v_after`: those after them.
    - `impulse`: the jump of the momentum, like v, `[L] [t]/[q]`; zero where nothing jumps.
    - `modes` (S, k): with elements, their modes after each (see `HybridTrajectory`). The last k of `ways` are then
      their names, and `kinds` what each of the `ways` is: a "switch" of phases, or the mode of a "gap", a "sliding
      velocity" (or one "in a plane"), a "spring", a "side" from which a normal force presses, or a "control".
    - `count`: how many there were.
    - `uncertain`: whether some may be missing: a guard touched zero within round-off, or changed too fast to be
      followed.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, " S"]
    way: Int[Array, " S"]
    to: Int[Array, " S"]
    q: PyTree[Float[Array, "S ..."]]
    v: PyTree[Float[Array, "S ..."]]
    q_after: PyTree[Float[Array, "S ..."]]
    v_after: PyTree[Float[Array, "S ..."]]
    impulse: PyTree[Float[Array, "S ..."]]
    count: Int[Array, ""]
    uncertain: Bool[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)
    ways: tuple[str, ...] = eqx.field(static=True)
    modes: Int[Array, "S k"] | None = None
    kinds: tuple[str, ...] = eqx.field(static=True, default=())

    def as_crossings(self) -> Crossings:
        """Return the switches as crossings of one guard, with the states before them."""
        return Crossings(self.t, self.q, self.v, {}, self.count, self.uncertain)

    def __len__(self):
        return int(self.count)

    def __repr__(self):
        if isinstance(self.t, Tracer) or not isinstance(self.t, jax.Array | np.ndarray):
            return "Switches, being traced"
        if np.ndim(self.count):
            low, high = int(np.min(self.count)), int(np.max(self.count))
            return f"Switches of {np.size(self.count)} lanes, {low} to {high} each"
        return by_line("\n".join(["Switches: " + self.in_words(), *self._rows()]))

    def in_words(self) -> str:
        """Return the number of switches, and whether some may be missing."""
        return f"{int(self.count)}" + ("; some may be missing" if bool(self.uncertain) else "")

    def in_rows(self, most: int = 6) -> list[str]:
        """Return a row for each of the first switches."""
        found = [row.strip() for row in self._rows()]
        return found[:most] + (["..."] if len(found) > most else [])

    def _rows(self):
        times, ways = np.asarray(self.t), np.asarray(self.way)
        return [f"  t = {times[k]:<12.9g} {self.ways[ways[k]]} {self._happened(k)}" for k in range(int(self.count))]

    @property
    def of_phases(self) -> int:
        """How many of the `ways` lead out of phases: the others are modes of elements."""
        return len(self.ways) - (0 if self.modes is None else np.shape(self.modes)[-1])

    @property
    def of_modes(self) -> list[tuple[str, str]]:
        """The name and the kind of each mode of elements."""
        return list(zip(self.ways[self.of_phases :], self.kinds[self.of_phases :]))

    def _happened(self, k: int) -> str:
        """What follows at switch k: the next phase, or what a mode does where it ends."""
        way = int(self.way[k])
        if way < self.of_phases:
            return f"-> {self.names[int(self.to[k])]}"
        if self.kinds[way] == "control":
            return "acts"
        mode = int(np.asarray(self.modes)[k, way - self.of_phases])
        after = mode_in_words(self.kinds[way], mode)
        if self.kinds[way] == "sliding velocity" and abs(mode) == 1:
            after += " forward" if mode > 0 else " back"
        return f"is struck, then {after}" if self.kinds[way] == "gap" and self._strikes(k, way) else after

    def _strikes(self, k: int, way: int) -> bool:
        """Whether velocities jump by more than round-off at switch k, where a gap that was open ends its mode."""
        if k and int(np.asarray(self.modes)[k - 1, way - self.of_phases]) > 0:
            return False
        before, after = (columns(np, x, rows=np.size(self.t))[: int(self.count)] for x in (self.v, self.v_after))
        jump, size = np.max(np.abs(after[k] - before[k])), np.max(np.abs([before, after]))
        return bool(jump > STRUCK * np.finfo(before.dtype).eps * size)


class HybridTrajectory(Trajectory):
    """A motion in phases, as `lj.integrate` returns it for a `lj.Hybrid`: a `Trajectory` with more.

    - `phase` (T,): the number of the phase at each output, in the order of `system.names`; -1 where none was reached.
      An output at the very time of a switch has the state and the phase before it.
    - `switches`: the `Switches`.
    - `modes` (T, k): with elements, the mode of each of them at each output, in the order of the last k of
      `switches.ways`: of a gap 0 (open) or 1 (closed); of a sliding velocity 1 or -1 (slides), 2 (sticks), or 0 (its
      gap is open), or 3 (others hold it); of a spring 0 (apart) or 1 (pressed); of a normal force of either sign 1 or
      -1, the side from which it presses; of a sampled control the number of its next instant. In a phase that does not
      have the element it is -1.
    - `multipliers`: of all phases by constraint name; NaN where the phase has no such constraint, and of `at(t)`
      between outputs while others hold what would slide (mode 3): which friction is at its bound is known at outputs.
    - `end`: the last instant; where the motion ended on a switch, the state after it.
    - `jacobi_integral()`, `residual()`: of each output's own phase. `drift()` is NaN: over all phases, in which forces
      and impacts do work, nothing has to be conserved.
    """

    phase: Int[Array, " T"] = eqx.field(kw_only=True)
    switches: Switches = eqx.field(kw_only=True)
    modes: Int[Array, "T k"] | None = eqx.field(kw_only=True, default=None)
    in_phases: ClassVar[bool] = True

    @property
    def system(self) -> Hybrid:  # pyright: ignore[reportIncompatibleVariableOverride]
        return known_system(self.any_system)

    @property
    def model(self) -> Model:
        first = jax.tree.map(lambda x: x[0], (self.t, self.q, self.v))
        return model_of(self.system, *first, self.params)

    def given(self, phase: int) -> InModes | None:
        """The modes of elements at each output as the functions of a phase take them; None without elements."""
        return None if self.modes is None else self.system.given(None, self.modes, phase)

    def named_phases(self) -> np.ndarray:
        """The name of the phase at each output; an empty one where none was reached. Not while JAX is tracing."""
        return np.array([*self.switches.names, ""])[np.asarray(self.phase)]

    def last_phase(self) -> int:
        """The number of the phase in which the motion ended, or failed. Not while JAX is tracing."""
        count = len(self.switches)
        return int(self.switches.to[count - 1] if count else self.system.first)

    def modes_entered(self) -> Any:
        """The modes of elements at the start and after each switch, (S + 1, k); None without elements. Not traced."""
        if self.modes is None:
            return None
        return np.concatenate([np.asarray(self.modes)[:1], np.asarray(self.switches.modes)[: len(self.switches)]])

    def jacobi_integral(self) -> Float[Array, " T"]:
        """The Jacobi integral of the phase at every output, (T,), `[L]`. Not for batched trajectories."""
        return _of_phases(_integral, self)

    def drift(self) -> Float[Array, ""]:
        """Return NaN: nothing is known to be conserved over all phases."""
        return jnp.full_like(self.scaled_error, jnp.nan)

    def residual(self) -> Float[Array, ""]:
        """The worst constraint residual over all outputs, but not between them, each in its own phase, relative."""
        worst = [_residual_in(model, i, self) for i, model in enumerate(self.model.phases) if model.m]
        return jnp.max(jnp.stack([*worst, jnp.zeros_like(self.scaled_error)]))

    def plot(self, charges: Any = False):
        """Plot coordinates, velocities and multipliers against time, with the switches; returns a matplotlib `Figure`.

        A strip below shows the phases; with elements, in a row each, when a gap is closed, and when what slides slides
        or sticks. Switches stand at their own times; else what happens between two outputs is not seen.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batched trajectory.
        """
        fig = super().plot(charges)
        for axis in fig.axes[:-1]:
            for t in np.asarray(self.switches.t)[: len(self.switches)]:
                axis.axvline(t, color=plot.COLOURS[-1], linewidth=0.6, linestyle=":", zorder=0)
        return fig

    def _strips(self) -> dict[str, list[tuple[float, float, str]]]:
        s = self.switches
        edges = np.array([self.t[0], *np.asarray(s.t)[: len(s)], self.end.t])
        first, rows = np.asarray(self.phase)[0], {}
        if s.of_phases or self.modes is None:
            rows["phase"] = [s.names[i] for i in (first, *np.asarray(s.to)[: len(s)])]
        for i, (name, kind) in enumerate(s.of_modes):
            rows[name] = [mode_in_words(kind, int(mode)) for mode in self.modes_entered()[:, i]]
        return {name: _merged(edges, words) for name, words in rows.items()}

    def rows(self) -> dict:
        return super().rows() | {"phase": self.phase, "modes": self.modes}

    def _of_system(self):
        if isinstance(self.any_system, UnknownSystem):
            lines = [("system", repr(self.any_system))]
        elif any(system.constraints for system in self.system.systems):
            lines = [("worst constraint residual", f"{float(self.residual()):.1e} (relative, at the outputs)")]
        else:
            lines = []
        return [
            *lines,
            *self._of_phases(),
            ("switches", self.switches.in_words()),
            *(("", row) for row in self.switches.in_rows()),
            *((f"event '{name}'", found.in_words()) for name, found in self.events.items() if name != SWITCHES),
        ]

    def _of_phases(self) -> Iterator[tuple[str, str]]:
        if self.switches.of_phases or self.modes is None:
            names, counts = np.unique(self.named_phases(), return_counts=True)
            yield "phases", "outputs: " + ", ".join(f"{n} in {name}" for name, n in zip(names, counts) if name)
        if self.modes is not None:
            last = zip(self.switches.of_modes, self.modes_entered()[-1])
            words = [f"{name} {mode_in_words(kind, int(mode))}" for (name, kind), mode in last if mode != NO_PHASE]
            yield "modes", f"at the end: {', '.join(words) or 'none'}"


def _merged(edges: np.ndarray, words: list[str]) -> list[tuple[float, float, str]]:
    """From when until when each word holds, (start, end, word), with equal neighbours as one."""
    found: list[tuple[float, float, str]] = []
    for start, end, word in zip(edges, edges[1:], words):
        if found and found[-1][2] == word:
            start = found.pop()[0]
        found.append((float(start), float(end), word))
    return found


def _integral(model: Model, t: Array, q: PyTree, v: PyTree):
    return jacobi_and_scale(model, t, q, v)[0]


def _of_phases(function: Callable, trajectory):
    """Return `function(model, t, q, v)` at all outputs, each with the model of its own phase."""
    found = jnp.full_like(trajectory.t, jnp.nan)
    for i, model in enumerate(trajectory.model.phases):
        values = function(model, trajectory.t, trajectory.q, trajectory.v)
        found = jnp.where(trajectory.phase == i, values, found)
    return found


def _residual_in(model: Model, i: int, trajectory):
    given = trajectory.given(i)
    motion = trajectory.phase, trajectory.t, trajectory.q, trajectory.v
    nothing = trajectory.tolerance[1]
    # What rests at zero has the size of which its round-off is that of the forces that hold it.
    least = rounded(jnp.min(nothing, axis=1)[:, None]) if given is not None and nothing.ndim == 2 else 0.0
    return _worst(model, i, *motion, given, least)


@compiled
def _worst(model: Model, i: int, phase: Array, t: Array, q: PyTree, v: PyTree, given: InModes | None, least: Any):
    in_phase = phase == i
    # Outputs of other phases are replaced by the first of this phase, which does not change the maximum.
    at = jnp.where(in_phase, jnp.arange(phase.size), jnp.argmax(in_phase))
    t, q, v, given = jax.tree.map(partial(jnp.take, indices=at, axis=0), (t, q, v, given))
    worst = lambda: worst_residual(model, t, q, v, given, least)
    return lax.cond(jnp.any(in_phase), worst, lambda: jnp.zeros_like(t[0]))
