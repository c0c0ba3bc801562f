"""Redundant constraints, and constraints that contradict each other."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.scenes import bead_on_hoop
from lagjax.stability.trial import REFUSED, Trial, by_parameter
from lagjax.system import Holonomic, System


def free_fall(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ |ṙ|² - g y."""
    return 0.5 * jnp.sum(v**2) - params["g"] * q[1]


def rod(t, q: PyTree, params: PyTree):
    """|r|² - a²."""
    return q @ q - params["a"] ** 2


def rod_again(t, q: PyTree, params: PyTree):
    """The same rod, expressed by its length."""
    return 3.0 * (jnp.sqrt(q @ q) - params["a"])


def level(t, q: PyTree, params: PyTree):
    """y stays where it is."""
    return q[1]


def lift(t, q: PyTree, params: PyTree):
    """y rises as ½ t²."""
    return q[1] - 0.5 * t**2


twice = System(free_fall, {"rod": Holonomic(rod), "rod_again": Holonomic(rod_again)})
torn = System(free_fall, {"level": Holonomic(level), "lift": Holonomic(lift)})


def _on_the_rod(q0: PyTree, v0: PyTree, params: PyTree, ts):
    psi, rate = bead_on_hoop.exact_motion(params | {"omega": 0.0}, jnp.arctan2(q0[0], -q0[1]), ts)
    a, (cos, sin) = params["a"], (jnp.cos(psi), jnp.sin(psi))
    return a * jnp.stack([sin, -cos], axis=-1), a * jnp.stack([rate * cos, rate * sin], axis=-1)


def redundant():
    """A rod given twice; two rods of different length; and a point that is both held level and lifted."""
    params, ts = {"a": 0.75, "g": 9.8125}, np.linspace(0.0, 3.0, 5)
    q0, v0 = 0.75 * np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2)
    along = by_parameter(q0, v0, params, "g")
    origin, other = np.zeros(2), {"a": 1.5, "g": 9.8125}
    return [
        Trial("redundant", "a rod given twice", twice, q0, v0, params, ts, _on_the_rod, along, periods=1.6),
        Trial("contradictory", "a rod of another length", twice, q0, v0, other, ts, expected=REFUSED),
        Trial("contradictory", "held level and lifted", torn, origin, origin, params, ts, expected=REFUSED),
    ]
