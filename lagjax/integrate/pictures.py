"""Pictures of a motion: curves by the user's names, figures, and films with frames between its outputs.

A picture of a state, a film or a figure shows points that a function gives, or shapes fixed in bodies. Between outputs
a film interpolates q by a cubic (Hermite's), with v as its slope:

    q(t_i + s h) = (1 + 2 s)(1 - s)² q_i + s² (3 - 2 s) q_{i+1} + h s (1 - s)² v_i - h s² (1 - s) v_{i+1}

The values at outputs are exact; between them the error falls with the fourth power of their distance, which is enough
for pictures if outputs are dense. To check this, every other output is left out and interpolated from the rest: it is
then wrong by about sixteen times the error.

Curves may be charges. Some follow from the structure of a system: the momenta of coordinates that neither L nor a
constraint contains, and the Jacobi integral if nothing depends on time. `lj.symmetries` finds the others.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import Animation, Drawing, InSpace, Shape, Still, plots, poses_in_q, stills_in_space
from lagjax.jaxtools import compiled
from lagjax.mechanics import Generator, NoetherCharge, conserved_momenta, conserves_jacobi_integral
from lagjax.refusals import must_be_function, must_have_values, must_return, shown, words
from lagjax.system import Call, Traced, UnknownSystem, check_arguments, check_system, coordinates

# States whose poses are computed together.
BLOCK = 256


class Subject(NamedTuple):
    """What is drawn: `functions` of (t, q, params) that give points, and `shapes`, with `poses` of their bodies."""

    functions: tuple[Callable, ...]
    shapes: tuple[Shape, ...]
    poses: Callable
    params: PyTree

    def frames(self, t: np.ndarray, q: PyTree) -> dict[str, np.ndarray] | InSpace:
        """What is drawn at times (F,) and states: points by name, (F, k, 2) or (F, k, 3); with shapes, an `InSpace`."""
        points: dict[str, np.ndarray] = {}
        for function in self.functions:
            points |= drawn(function, t, q, self.params)
        if len({x.shape[-1] for x in points.values()} | ({3} if self.shapes else set())) > 1:
            raise ValueError(
                "some of what is drawn is in the plane, and some in space.\nFix: three coordinates for each point."
            )
        if not self.shapes:
            return points
        names = tuple(dict.fromkeys(a.body for shape in self.shapes for a in shape.anchors if a.body is not None))
        return InSpace(self.shapes, self._poses(names, t, q), points)

    def _poses(self, names: tuple[str, ...], t: np.ndarray, q: PyTree) -> dict[str, np.ndarray]:
        def at(t: Any, q: PyTree):
            found = self.poses(t, q, self.params)
            return [_pose_of(name, found) for name in names]

        # In whole blocks, so that all calls for one film are compiled once.
        count = BLOCK * -(-len(t) // BLOCK)
        padded = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], count - len(t), axis=0)]), (t, q))
        poses = {}
        for name, pose in zip(names, (at if self.poses is poses_in_q else jax.jit(jax.vmap(at)))(*padded)):
            position, quaternion = (np.asarray(x, float)[: len(t)] for x in pose)
            if position.shape[1:] != (3,) or quaternion.shape[1:] != (4,):
                raise ValueError(
                    f"the pose of '{name}' must be a point of space (3,) and a quaternion (4,), and has the shapes "
                    f"{position.shape[1:]} and {quaternion.shape[1:]}."
                )
            poses[name] = np.concatenate([position, quaternion], axis=1)
            if not np.all(np.isfinite(poses[name])):
                first = t[~np.isfinite(poses[name]).all(axis=1)][0]
                raise ValueError(
                    f"the pose of '{name}' is NaN or infinite at t = {first:.6g}.\n"
                    "Fix: evaluate it there, term by term."
                )
        return poses


def _pose_of(name: str, poses: Any) -> tuple[Any, Any]:
    try:
        position, quaternion = poses[name]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"it is not known where the body '{name}' is.\n"
            "Usual cause: a body of another system, or coordinates that are not poses.\n"
            "Fix: lj.shapes.Drawing(shapes, poses), with poses(t, q, params) -> {name: (position, quaternion)}."
        ) from error
    return position, quaternion


def subject_of(what: Any, system: Any, params: PyTree) -> Subject:
    """The subject that a user asks for: None, a function, a shape, several of them, or a `lj.shapes.Drawing`."""
    if what is None:
        what = known_drawing(system)
        if what is None:
            raise ValueError(
                "nothing says how this system is drawn.\n"
                "Fix: give a function that gives points, lambda t, q, params: (q[0], q[1]), or shapes, "
                "[lj.shapes.box(body, (1.0, 0.2, 0.2))]."
            )
    # Where its bodies are is known of a system whatever is drawn of it.
    poses = (what if isinstance(what, Drawing) else known_drawing(system) or Drawing(())).poses
    check_arguments(Call("poses", poses, ("t", "q", "params")), "an argument left out that is not needed")
    parts = what.shapes if isinstance(what, Drawing) else [what] if callable(what) else what
    parts = parts(params) if callable(parts) else parts
    parts = [parts] if isinstance(parts, Shape) else parts
    if not isinstance(parts, Sequence) or not all(isinstance(x, Shape) or callable(x) for x in parts) or not parts:
        raise TypeError(
            f"what is drawn must be a function positions(t, q, params) or shapes, not {type(parts).__name__}"
            f"{' of ' + type(parts[0]).__name__ if isinstance(parts, Sequence) and len(parts) else ''}.\n"
            "Usual cause: bodies in place of their shapes.\nFix: [lj.shapes.box(body, (1.0, 0.2, 0.2))]."
        )
    functions = tuple(x for x in parts if not isinstance(x, Shape))
    for function in functions:
        check_positions(function)
    shapes = tuple(x.with_params(params) for x in parts if isinstance(x, Shape))
    if not functions and all(shape.owner is None for shape in shapes):
        raise ValueError(
            "nothing of what is drawn moves: all shapes are fixed in space.\n"
            "Fix: give the bodies, too, [lj.shapes.sphere(body, 0.1), lj.shapes.line(lj.bodies.ground, body)]."
        )
    return Subject(functions, shapes, poses, params)


def known_drawing(system: Any) -> Drawing | None:
    """How a system says that it is drawn: the attribute `drawing` of its Lagrangian, or None."""
    if isinstance(system, UnknownSystem):
        return None
    lagrangian = system.phases[0].lagrangian
    return getattr(lagrangian.program.function if isinstance(lagrangian, Traced) else lagrangian, "drawing", None)


def check_positions(positions: Any) -> None:
    """Raise unless this is a function of (t, q, params)."""
    check_arguments(Call("positions", positions, ("t", "q", "params")), "an argument left out that is not needed")


def drawn(positions: Callable, t: np.ndarray, q: PyTree, params: PyTree) -> dict[str, np.ndarray]:
    """Return the points that `positions` gives for each state: by name, (T, k, 2) or (T, k, 3)."""
    frames = []
    for i, now in enumerate(t):
        found = positions(now, jax.tree.map(lambda x: x[i], q), params)
        found = found if isinstance(found, Mapping) else {"": found}
        frames.append({name: _points(name, value) for name, value in found.items()})
    shapes = {tuple((name, x.shape) for name, x in frame.items()) for frame in frames}
    if len(shapes) != 1 or not frames[0]:
        raise ValueError(
            "positions(t, q, params) must return the same points, at least one, at all times.\n"
            "Fix: return NaN-free points of one shape for each name, without if."
        )
    drawn = {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}
    if len({x.shape[-1] for x in drawn.values()}) != 1:
        raise ValueError(
            "positions(t, q, params) must return points of the plane or points of space, not some of either.\n"
            "Fix: three coordinates for each point."
        )
    for name, x in drawn.items():
        if not np.all(np.isfinite(x)):
            first = t[~np.isfinite(x).all(axis=(1, 2))][0]
            raise ValueError(
                f"positions(t, q, params) returned NaN or infinity{_of(name)} at t = {first:.6g}.\n"
                "Usual cause: a root or a quotient outside its domain, or NaN in params.\n"
                "Fix: evaluate positions there, term by term."
            )
    return drawn


def _points(name: str, value):
    """Return one point or several as (k, 2) or (k, 3), or raise."""
    try:
        x = np.asarray(value, float)
        shape = f"an array of shape {x.shape}"
    except (TypeError, ValueError):
        x, shape = np.zeros(0), f"a {type(value).__name__} that is not an array of numbers"
    if x.shape[-1:] not in ((2,), (3,)) or x.ndim > 2 or x.size == 0:
        raise ValueError(
            f"positions(t, q, params) must return points of the plane or of space, but returned {shape}{_of(name)}.\n"
            "Usual cause: an angle in place of a point, or a coordinate of shape (1,).\n"
            "Fix: return (x, y) or (x, y, z), points (k, 2) or (k, 3) linked in order, or such points by name: "
            '{"rod": [(0, 0), (x, y)]}.'
        )
    return x.reshape(-1, x.shape[-1])


def _of(name: str):
    return f" for '{name}'" if name else ""


def draw(
    system: Any, q: PyTree, params: PyTree = None, what: Any = None, *, t: ArrayLike = 0.0, frames: bool = False,
    view: tuple[float, float] = (-60.0, 22.0),
) -> Still:  # fmt: skip
    """Draw one state, before anything moves: bodies and joints, or points, in the plane or in space.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + 9.81 * jnp.cos(q))
    >>> draw(pendulum, 0.3, what=lambda t, q, params: {"rod": [(0.0, 0.0), (jnp.sin(q), -jnp.cos(q))]})
    Picture of 'rod': shown in a notebook, and with .save("picture.html") in a browser; .figure() is for papers

    **Arguments:** `system`, of which `q` is a state, `params` its parameters.

    - `what`: as in `traj.animate`, a function `positions(t, q, params)`, shapes, or a `lj.shapes.Drawing`; nothing for
      systems of `lj.bodies.multibody`, `lj.bodies.Tree` and models from files.
    - `t`: the time that `positions` is given.
    - `frames`: whether each body's axes are drawn from its centre of mass (x red, y green, z blue), and the axes of
      joints in black.
    - `view`: from where it is seen first, in space: azimuth and elevation of the eye, in degrees.

    Two points that a joint should hold together and that are apart in this state are joined by a magenta line, and
    `print` says how far they are apart: so a drawing is checked before `lj.consistent_state` mends it.

    **Returns:** a `Still`.

    **Raises:** `TypeError` for what cannot be drawn, and inside of a JAX transformation; `ValueError` for positions
    that are not points, and bodies whose pose is not known.
    """
    check_system(system, phases=True, elements=True)
    fix = "draw what the function returns"
    must_have_values((q, params, t), "a picture needs numbers", fix, "lj.draw inside of jax.jit, jax.vmap or jax.grad")
    given = coordinates.state(t, q, q, params)
    return still(subject_of(what, system, given.params), given.t, given.q, frames, view)


def still(subject: Subject, t: ArrayLike, q: PyTree, frames: bool, view: tuple[float, float]) -> Still:
    """A subject at one state."""
    now, at = np.asarray(t, float)[None], jax.tree.map(lambda x: np.asarray(x)[None], q)
    found = subject.frames(now, at)
    return Still(found.finished(frames) if isinstance(found, InSpace) else found, view)


def curves(tree: PyTree):
    """Return one curve for each coordinate, by the user's names."""
    first = jax.tree.map(lambda x: np.asarray(x[0]), tree)
    columns = np.stack([np.ravel(x) for x in _rows(tree)])
    return dict(zip(coordinates.names(first), columns.T))


def finite(*curves):
    """Return the curves at the places where all are finite."""
    all_finite = np.isfinite(curves).all(axis=0)
    return tuple(x[all_finite] for x in curves)


def _rows(tree: PyTree):
    leaves = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def columns(values):
    """Return the columns of an array, each with the suffix of its name."""
    values = np.asarray(values)
    if values.ndim == 1:
        return [("", values)]
    return [(f"[{i}]", column) for i, column in enumerate(values.T)]


PANEL, LONG = "change of charges\nat the outputs", 28


def panels(trajectory, charges: Any) -> dict[str, dict[str, np.ndarray]]:
    """Return the curves of a trajectory, by panel: coordinates, velocities, multipliers, and charges if requested.

    `charges`: whether to draw the charges known to be conserved; or functions of (t, q, v, params), by name.
    """
    found = {"q": curves(trajectory.q), "v": curves(trajectory.v)}
    if trajectory.multipliers:
        found["multipliers"] = {
            name + suffix: curve for name, values in trajectory.multipliers.items() for suffix, curve in columns(values)
        }
    if charges is not False and charges is not None:
        drawn = changes(trajectory, charges)
        # Longer names would leave no room for the curves.
        short = [name.split(" with ")[0] for name in drawn]
        short = [name if len(name) <= LONG else f"{name[:LONG]}…" for name in short]
        found[PANEL] = dict(zip(short if len(set(short)) == len(short) else drawn, drawn.values()))
    return found


def changes(trajectory, charges: Any) -> dict[str, np.ndarray]:
    """Return the change of each charge since its first value, (T,), relative to its largest term at the outputs."""
    of_system = charges is True
    functions = known_charges(trajectory) if of_system else _by_name(charges)
    if not functions:
        raise ValueError(
            "nothing is known to be conserved: L and the constraints contain every coordinate, or a force acts, and "
            "the Jacobi integral may change.\n"
            "Fix: traj.plot(charges=lj.symmetries(system, q, v, params)), which finds further symmetries, or functions "
            "of (t, q, v, params) by name."
        )
    values = _along(functions, trajectory.t, trajectory.q, trajectory.v, trajectory.params)
    found = {}
    # Compiled programs sort the keys of their results.
    for name in functions:
        value, size = values[name]
        value, size = np.asarray(value), np.asarray(size)
        cause, fix = "the momentum of all coordinates, with the structure of q", "return one entry of it"
        must_return(value.ndim == 1, f"charge '{name}'", "one number", value[0], fix, cause)
        scale = max(np.nanmax(size), np.nanmax(np.abs(value)))
        found[name] = (value - value[0]) / (scale if scale > 0 else 1.0)
    return found


def known_charges(trajectory) -> dict[str, NoetherCharge]:
    """Return the charges that follow from the structure of the system."""
    model = trajectory.model
    if model.system.in_phases:
        raise ValueError(
            "it is not known what a motion conserves in all its phases.\n"
            'Fix: traj.plot(charges={"name": function}) with functions of (t, q, v, params), or draw one phase.'
        )
    found = [Generator.shift(name) for name in conserved_momenta(model)]
    if conserves_jacobi_integral(model):
        found.append(Generator.time_translation())
    return {generator.name: NoetherCharge(model.system, generator) for generator in found}


def _by_name(charges: Any) -> dict[str, Callable]:
    if isinstance(charges, Mapping) or hasattr(charges, "keys"):
        found = {name: charges[name] for name in charges.keys()}
    elif callable(charges):
        found = {getattr(charges, "__name__", "charge"): charges}
    else:
        fix = 'charges={"L_z": lj.noether_charge(system, lj.Generator.rotation("z"))}'
        raise TypeError(words(f"charges must be True, or functions by name, not {shown(charges)}", fix))
    for name, charge in found.items():
        must_be_function(charge, f"charge '{name}'", "(t, q, v, params)", "pass the function itself, not its value")
    return found


@compiled
def _along(functions, t: np.ndarray, q: PyTree, v: PyTree, params: PyTree):
    def at(t: np.ndarray, q: PyTree, v: PyTree):
        found = {}
        for name, charge in functions.items():
            value = charge(t, q, v, params)
            found[name] = value, charge.size(t, q, v, params) if isinstance(charge, NoetherCharge) else value * 0.0
        return found

    return jax.vmap(at)(t, q, v)


# Without every other output the picture may be wrong by this share of its size: with all of them by a hundredth.
MAY_MISS = 0.16
# The shortest and the longest film, in seconds, if the user does not give its length.
SHORTEST, LONGEST = 2.0, 20.0
# Instants that a trail is drawn through in a figure.
OF_A_PATH = 301


def film(traj, what: Any, seconds: float | None, rate: float, trail: float, ended_by_event: bool) -> Animation:
    """Return the frames of one trajectory as they are drawn."""
    subject = subject_of(what, traj.any_system, traj.params)
    t, q, v = _reached(traj, ended_by_event)
    at, kept = _frames(t[0], t[-1], seconds, rate, trail)
    frames = subject.frames(at, hermite(t, q, v, at))
    _check_dense(subject, t, q, v, frames)
    return Animation(at, frames.finished() if isinstance(frames, InSpace) else frames, rate, kept)


def figure(traj, what: Any, times: ArrayLike, view: tuple[float, float], ended_by_event: bool):
    """Return a matplotlib `Figure` of some instants of one trajectory."""
    subject = subject_of(what, traj.any_system, traj.params)
    t, q, v = _reached(traj, ended_by_event, least=1)
    if isinstance(times, int | np.integer):
        at = np.linspace(t[0], t[-1], max(int(times), 0))
    else:
        at = np.atleast_1d(np.asarray(times, float))
    low, high = min(t[0], t[-1]), max(t[0], t[-1])
    if at.ndim != 1 or not at.size or not np.all((at >= low) & (at <= high)):
        raise ValueError(
            f"times must be how many instants are drawn, or times between {low:.6g} and {high:.6g}, and is {times}.\n"
            "Usual cause: a motion that ended early, by an event or a failure (see traj.result).\n"
            "Fix: traj.draw(times=5)."
        )
    path = np.linspace(t[0], t[-1], OF_A_PATH) if len(t) > 1 else t
    motion, chosen = (subject.frames(some, hermite(t, q, v, some)) for some in (path, at))
    _check_dense(subject, t, q, v, motion)
    if isinstance(motion, dict) and next(iter(motion.values())).shape[-1] == 2:
        return plots.stills(motion, chosen)
    motion, chosen = (x if isinstance(x, InSpace) else InSpace((), {}, x) for x in (motion, chosen))
    motion = motion.finished()
    return stills_in_space(motion, chosen._replace(shapes=motion.shapes), *view)


def film_of_lanes(
    trajs: list, positions: Callable, seconds: float | None, rate: float, trail: float, by_event: Sequence[bool]
) -> tuple[np.ndarray, dict[str, np.ndarray], int]:
    """Return frames of several trajectories (None for a lane without one) at shared times, for `animation.film`.

    A motion that ends before the others stays where it ended; one with fewer than three outputs is NaN.
    """
    check_positions(positions)
    lanes = []
    for traj, ended in zip(trajs, by_event):
        try:
            lanes.append(None if traj is None else _reached(traj, ended))
        except ValueError:
            lanes.append(None)
    ends = [(lane[0][0], lane[0][-1]) for lane in lanes if lane is not None]
    if not ends:
        raise ValueError("no point has a motion to draw.\nUsual cause: all failed at their start; see swept.counts().")
    backward = ends[0][1] < ends[0][0]
    first, last = (max, min) if backward else (min, max)
    at, kept = _frames(first(start for start, _ in ends), last(end for _, end in ends), seconds, rate, trail)
    found = []
    for traj, lane in zip(trajs, lanes):
        if traj is None or lane is None:
            found.append(None)
            continue
        t, q, v = lane
        subject = Subject((positions,), (), poses_in_q, traj.params)
        here = np.clip(at, min(t[0], t[-1]), max(t[0], t[-1]))
        found.append(subject.frames(here, hermite(t, q, v, here)))
        _check_dense(subject, t, q, v, found[-1])
    like = next(points for points in found if points is not None)
    nothing = {name: np.full_like(x, np.nan) for name, x in like.items()}
    found = [nothing if points is None else points for points in found]
    shapes = {tuple((name, x.shape) for name, x in points.items()) for points in found}
    if len(shapes) != 1:
        raise ValueError(
            "positions(t, q, params) must return the same points for all motions.\n"
            "Fix: return points of one shape for each name, without if."
        )
    return at, {name: np.stack([points[name] for points in found]) for name in like}, kept


def _frames(start, end, seconds: float | None, rate: float, trail: float):
    """Return the times of the frames, and how many frames the trail keeps."""
    seconds = float(np.clip(abs(end - start), SHORTEST, LONGEST)) if seconds is None else seconds
    count = round(seconds * rate) + 1 if np.isfinite(seconds * rate) else 0
    if count < 2 or not trail >= 0:
        raise ValueError(
            f"seconds = {seconds:g} at rate = {rate:g} frames a second, with a trail of {trail:g} s, is not a film.\n"
            "Fix: traj.animate(positions, seconds=10.0), and a trail of zero or more seconds."
        )
    return np.linspace(start, end, count), int(min(trail * rate, count))


def hermite(t: np.ndarray, q: PyTree, v: PyTree, at):
    """Return q at the times `at`, from values and slopes at the times t; each leaf (T, ...) becomes (len(at), ...)."""
    if t[-1] < t[0]:
        t, q, v = jax.tree.map(lambda x: x[::-1], (t, q, v))
    if len(t) == 1:
        return jax.tree.map(lambda x: np.repeat(x, len(at), axis=0), q)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[i + 1] - t[i]

    def leaf(q: PyTree, v: PyTree):
        width, s = (x.reshape(-1, *(1,) * (q.ndim - 1)) for x in (h, (at - t[i]) / h))
        values = (1 + 2 * s) * (1 - s) ** 2 * q[i] + s**2 * (3 - 2 * s) * q[i + 1]
        return values + width * s * (1 - s) * ((1 - s) * v[i] - s * v[i + 1])

    return jax.tree.map(leaf, q, v)


def _reached(traj, ended_by_event: bool, least: int = 3):
    """Return times, q and v of the outputs that the motion reached, and of the event that ended it.

    If it failed, the last state is left out: when steps collapse, its velocity is too large for interpolation.
    """
    outputs, end = (traj.t, traj.q, traj.v), (traj.end.t, traj.end.q, traj.end.v)
    outputs, end = jax.tree.map(np.asarray, (outputs, end))
    there = np.isfinite(np.concatenate([x.reshape(len(x), -1) for x in jax.tree.leaves(outputs)], axis=1)).all(axis=1)
    t, q, v = jax.tree.map(lambda x: x[there], outputs)
    if ended_by_event and abs(end[0] - t[0]) > abs(t[-1] - t[0]):
        t, q, v = jax.tree.map(lambda x, last: np.concatenate([x, last[None]]), (t, q, v), end)
    if len(t) < least:
        raise ValueError(
            f"there are {len(t)} states to draw, but at least {least} are needed.\n"
            "Usual cause: ts of two times, or a motion that failed at its start (see traj.result).\n"
            "Fix: ts=jnp.linspace(t0, t1, 201)."
        )
    return t, q, v


def _check_dense(subject: Subject, t: np.ndarray, q: PyTree, v: PyTree, frames):
    """Raise if the outputs are too far apart to interpolate between them."""
    if len(t) < 3:
        return
    every_other, skipped = slice(None, None, 2), slice(1, len(t) - 1, 2)
    half_q, half_v = jax.tree.map(lambda x: x[every_other], (q, v))
    guessed = _tracked(subject.frames(t[skipped], hermite(t[every_other], half_q, half_v, t[skipped])))
    known = _tracked(subject.frames(t[skipped], jax.tree.map(lambda x: x[skipped], q)))
    size = max(np.ptp(x.reshape(-1, x.shape[-1]), axis=0).max() for x in _tracked(frames).values())
    missed = max(np.abs(guessed[name] - known[name]).max() for name in known)
    if missed > MAY_MISS * size:
        raise ValueError(
            f"{len(t)} outputs are too few to draw what happens between them: interpolated from every other one, the "
            f"rest would be misplaced by {missed / size:.0%} of the picture.\n"
            "Usual cause: fewer than about ten outputs for each oscillation.\n"
            f"Fix: ts=jnp.linspace({t[0]:.6g}, {t[-1]:.6g}, {8 * len(t) + 1})."
        )


def _tracked(frames: dict[str, np.ndarray] | InSpace) -> dict[str, np.ndarray]:
    """The points by which frames are compared."""
    return frames.tracked() if isinstance(frames, InSpace) else frames
