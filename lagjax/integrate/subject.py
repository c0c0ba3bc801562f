"""What a picture of a state, a film or a figure of a motion shows: points that a function gives, and shapes fixed in
bodies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import Drawing, InSpace, Shape, Still, poses_in_q
from lagjax.system import Call, Traced, UnknownSystem, check_arguments, check_system, coordinates, is_traced

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
    if is_traced((q, params, t)):
        raise TypeError(
            "a picture needs numbers, and this state is being traced.\n"
            "Usual cause: lj.draw inside of jax.jit, jax.vmap or jax.grad.\nFix: draw what the function returns."
        )
    given = coordinates.state(t, q, q, params)
    return still(subject_of(what, system, given.params), given.t, given.q, frames, view)


def still(subject: Subject, t: ArrayLike, q: PyTree, frames: bool, view: tuple[float, float]) -> Still:
    """A subject at one state."""
    now, at = np.asarray(t, float)[None], jax.tree.map(lambda x: np.asarray(x)[None], q)
    found = subject.frames(now, at)
    return Still(found.finished(frames) if isinstance(found, InSpace) else found, view)
