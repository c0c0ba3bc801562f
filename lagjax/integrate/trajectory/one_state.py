"""One state as a picture."""

from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import InSpace, Still
from lagjax.integrate.trajectory.subject import Subject, subject_of
from lagjax.system import check_system, coordinates, is_traced


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

    - `what`: as in `traj.animate`, a function `positions(t, q, params)`, shapes, or a `lj.Drawing`; nothing for systems
      of `lj.multibody`, `lj.Tree` and models from files.
    - `t`: the time that `positions` is given.
    - `frames`: whether each body's axes are drawn from its centre of mass (x red, y green, z blue), and the axes of
      joints in black.
    - `view`: from where it is seen first, in space: azimuth and elevation of the eye, in degrees.

    Two points that a joint should hold together and that are apart in this state are joined by a magenta line, and
    `print` says how far they are apart: so a drawing is checked before `lj.consistent_state` mends it.

    **Returns:** a `lj.Still`.

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
