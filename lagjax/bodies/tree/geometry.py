"""What is known of a tree's links independently of their motion, as arrays over links, for given params.

Masses, inertias and places that are functions of params are called once for each function, however many links have it.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import valued
from lagjax.bodies.driven import Driven
from lagjax.bodies.tree.links import Entry, Link, Slots, slots_of


class FixedNumbers(NamedTuple):
    """What no params change, as operands, since programs that hold arrays of their own are traced again when used.

    - `turns`, `slides` (n, k): which freedoms turn, and which slide; `axes` (n, 3, k): theirs along those of parents,
      zero where there is none.
    - `turned`: E = E_0 + cos s E_1 + sin s E_2 for a coordinate s, each (n, 3, 3).
    - `read`, `write`, `root`: for the passes over the links (`Slots`), and which hang on the ground.
    """

    turns: Float[Array, "n k"]
    slides: Float[Array, "n k"]
    axes: Float[Array, "n 3 k"]
    turned: Float[Array, "3 n 3 3"]
    read: Float[Array, "n slots"]
    write: Float[Array, "n slots"]
    root: Float[Array, " n"]


class GivenMotion(NamedTuple):
    """How the links that are driven move, R, r and their rates; zero for the others."""

    turn: Float[Array, "n 3 3"]
    centre: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    acceleration: Float[Array, "n 6"]


class LinkNumbers(NamedTuple):
    """The numbers of links for some t and params: `a` and `b` are the places of joints on parents and on links.

    `armature`: the inertia that the rate of each freedom has besides, of its rotor. `driven`: None where no body is.
    """

    fixed: FixedNumbers

    mass: Float[Array, " n"]
    inertia: Float[Array, "n 3 3"]
    a: Float[Array, "n 3"]
    b: Float[Array, "n 3"]
    armature: Float[Array, "n k"]
    driven: GivenMotion | None


class Geometry:
    """The links of a tree as arrays.

    `frames`: what turns the axes of joints into those of parents, and of links into those of joints, each (n, 3, 3).
    `turns` (n, k): which freedoms turn, `slides` which slide; k is the largest number of freedoms of a joint.
    """

    def __init__(self, links: Sequence[Link], entries: Sequence[Entry], armature: Mapping[str, ArrayLike | Callable]):
        self.links, self.entries, self.armature = links, entries, armature
        kinds = np.array([link.kind for link in links])
        self.n, self.k = len(links), 3 if "ball" in kinds else 1
        self.frames = np.array([np.transpose(link.a.frame) for link in links]), np.array([x.b.frame for x in links])
        first = np.arange(self.k) == 0
        self.turns = (((kinds == "turn")[:, None] & first) | (kinds == "ball")[:, None]).astype(float)
        self.slides = ((kinds == "slide")[:, None] & first).astype(float)
        self.free, self.ball, self.driven = kinds == "free", kinds == "ball", kinds == "driven"
        self.root = np.array([link.parent < 0 for link in links], float)
        self.slots: Slots = slots_of([link.parent for link in links])
        self.body_at = {link.body.name: i for i, link in enumerate(links) if link.body is not None}

    @cached_property
    def axes(self) -> np.ndarray:
        """The axes of freedoms along those of parents, (n, 3, k), zero where there is none."""
        axes = self.frames[0] if self.k == 3 else self.frames[0][:, :, 2:]
        if self.k == 3:
            # The axis of a hinge or slide comes first.
            axes = np.where(self.ball[:, None, None], axes, axes[:, :, ::-1])
        return axes * (self.turns + self.slides)[:, None, :]

    @cached_property
    def turned(self) -> np.ndarray:
        """How a coordinate turns each link (`FixedNumbers`): a hinge about the third axis."""
        before, after = self.frames
        still, cosine, sine = np.diag([0.0, 0.0, 1.0]), np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3))
        sine[1, 0], sine[0, 1] = 1.0, -1.0
        hinges = (self.turns[:, :1] * ~self.ball[:, None])[:, :, None]
        fixed = before @ (hinges * still + (1 - hinges) * np.eye(3)) @ after
        return np.stack([fixed, hinges * (before @ cosine @ after), hinges * (before @ sine @ after)])

    @cached_property
    def numbers(self) -> np.ndarray:
        """The place of each link's number among all numbers, (n,); that behind the last one if it has none."""
        has = [link.kind in ("turn", "slide") for link in self.links]
        return np.array([link.place if x else sum(has) for link, x in zip(self.links, has)])

    @cached_property
    def quaternions(self) -> np.ndarray:
        """The place of each link's quaternion among all of them, (n,); 0 if it has none."""
        return np.array([link.place if link.kind in ("ball", "free") else 0 for link in self.links])

    @cached_property
    def links_of_numbers(self) -> np.ndarray:
        """The link of each number."""
        has = np.flatnonzero([link.kind in ("turn", "slide") for link in self.links])
        return has[np.argsort(self.numbers[has])]

    @cached_property
    def links_of_quaternions(self) -> np.ndarray:
        """The link of each quaternion."""
        has = np.flatnonzero(self.ball | self.free)
        return has[np.argsort(self.quaternions[has])]

    def at(self, t: Any, params: PyTree, dtype: DTypeLike) -> LinkNumbers:
        """The numbers of links for these params."""
        # What is driven needs no inertia.
        bodies = [None if link.kind == "driven" else link.body for link in self.links]

        def inertia(x: Any) -> Any:
            of = np if isinstance(x, np.ndarray) else jnp
            return of.diag(x) if np.ndim(x) == 1 else x

        def values(given: Sequence, form: Callable = lambda x: x) -> Array:
            constants = [None if callable(x) else form(np.array(x)) for x in given]
            like = next((x for x in constants if x is not None), None)
            functions = {x for x in given if callable(x)}
            found = {f: form(jnp.asarray(f(params), dtype)) for f in functions}
            shape = np.shape(like if like is not None else next(iter(found.values())))
            total = jnp.asarray(np.array([np.zeros(shape) if x is None else x for x in constants]), dtype)
            for f, value in found.items():
                of_f = np.array([x is f for x in given], dtype).reshape(-1, *[1] * len(shape))
                total = total + of_f * value[None]
            return total

        fixed = self.turns, self.slides, self.axes, self.turned, *self.slots, self.root
        return LinkNumbers(
            FixedNumbers(*(jnp.asarray(x, dtype) for x in fixed)),
            values([0.0 if body is None else body.mass for body in bodies]),
            values([(0.0, 0.0, 0.0) if body is None else body.inertia for body in bodies], inertia),
            values([link.a.place for link in self.links]),
            values([link.b.place for link in self.links]),
            jnp.asarray(self._armatures(params), dtype),
            self._given_motion(t, params, dtype) if self.driven.any() else None,
        )

    def _given_motion(self, t: Any, params: PyTree, dtype: DTypeLike) -> GivenMotion:
        links = np.flatnonzero(self.driven)
        bodies = [body for i in links if (body := self.links[i].body) is not None]
        driven = Driven(tuple(bodies))

        def moving(t: Array) -> tuple[Array, ...]:
            q, v = driven.placed(t, {}, {}, params)
            poses, rates = [x.pose(q) for x in bodies], [x.rates(v) for x in bodies]
            spins = [x.spin(rate) for x, rate in zip(poses, rates)]
            rows = [x.matrix for x in poses], [x.position for x in poses], spins, [x.position for x in rates]
            return tuple(jnp.zeros((self.n, *row[0].shape)).at[links].set(jnp.stack(row)) for row in rows)

        t = jnp.asarray(t, float)
        now, rate = jax.jvp(moving, (t,), (jnp.ones_like(t),))
        every = *now, jnp.concatenate(rate[2:], axis=1)
        return GivenMotion(*(x.astype(dtype) for x in every))

    def _armatures(self, params: PyTree) -> Any:
        """Those of the freedoms of each link, (n, k)."""
        of: Any = jnp if any(map(callable, self.armature.values())) else np
        numbers, balls = [of.zeros(0)], [of.zeros(0)]
        for entry in self.entries:
            given = of.asarray(valued(self.armature.get(entry.name, 0.0), params))
            rotors = of.broadcast_to(given, entry.rotors).ravel()
            (balls if entry.kinds in (("ball",), ("free",)) else numbers).append(rotors)
        # Behind the last one that of links without a number.
        first = of.concatenate([*numbers, of.zeros(1)])[self.numbers]
        if self.k == 1:
            return first[:, None]
        of_balls = of.concatenate(balls)[self.quaternions]
        return of.where(self.ball[:, None], of_balls[:, None], of.stack([first, 0 * first, 0 * first], 1))
