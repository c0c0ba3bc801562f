"""The links of a tree: its bodies in an order in which each comes after its parent, and what joins it to that.

A joint of several freedoms that turn about or slide along axes is a row of links, of which all but the last have no
body. A body on which no joint ends is free. Links without mass need not have a body: what hangs on them has inertia.

Both passes over the links, outward and inward, need only what belongs to few links at a time: those that still have
children to come. Each of these has a slot, which its last child takes over; a chain has one, and a tree of n links that
always fork at most log2(n), as the largest branch comes last.

**What is known of links independently of their motion**: arrays over links, for given params. Masses, inertias and
places that are functions of params are called once for each function, however many links have it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, PyTree

from lagjax.bodies.body import Body, Driven, Ground, Marker, check_takes_params, ground, valued
from lagjax.bodies.joints import Joined, above, apart, aside, cross, tilt, turn
from lagjax.refusals import must, must_differ, must_name
from lagjax.system import Holonomic

# The freedoms that a joint leaves, from the rows that it has as a constraint.
FREEDOMS = {
    (apart, tilt): ("turn",),
    (aside, turn): ("slide",),
    (aside, tilt): ("slide", "turn"),
    (apart, cross): ("turn", "turn"),
    (above, tilt): ("slide", "slide", "turn"),
    (apart,): ("ball",),
    (apart, turn): ("held",),
}
# What a joint of each kind has in q: numbers, or a quaternion.
SIZES = {("turn",): (), ("slide",): (), ("slide", "turn"): (2,), ("turn", "turn"): (2,),
         ("slide", "slide", "turn"): (3,), ("ball",): (4,), ("held",): None}  # fmt: skip
# Both ends of a link without a body; and where the second axis of a cross is on it, along the first one's first vector.
BETWEEN = Marker(Ground("between"), (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
CROSSED = replace(BETWEEN, frame=((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)))


@dataclass(frozen=True)
class Link:
    """A body, or None where it has no mass, and how it moves from its parent (-1: the ground).

    `kind`: "turn" and "slide" about or along the axis of a, "ball", "free", "held" or "driven"; `a` is a place on the
    parent and `b` on the body. `place`: of its coordinate among all numbers, or among all quaternions.
    """

    body: Body | None
    parent: int
    kind: str
    a: Marker
    b: Marker
    place: int


class Entry(NamedTuple):
    """An entry of q: its name, its kinds of freedoms, and how many joints it lists (None for a single one)."""

    name: str
    kinds: tuple[str, ...]
    count: int | None

    @property
    def shape(self) -> tuple[int, ...]:
        """Its shape in q; of a free body, that of its quaternion."""
        one = (4,) if self.kinds == ("free",) else SIZES[self.kinds]
        assert one is not None
        return one if self.count is None else (self.count, *one)

    @property
    def rotors(self) -> tuple[int, ...]:
        """The shape of its armature: one for a ball, one for each other freedom."""
        return self.shape[:-1] if self.kinds in (("ball",), ("free",)) else self.shape


def links_of(bodies: Sequence[Body], joints: Mapping[str, Holonomic | Sequence]) -> tuple[list[Link], list[Entry]]:
    """The links in order, and the entries of q; raises where joints and bodies do not make a tree."""
    entries, held_by, every = [], {}, set(bodies)
    numbers = quaternions = 0
    for name, given in joints.items():
        listed = isinstance(given, list | tuple)
        row = [_joint(name, joint, every) for joint in (given if listed else [given])]
        kinds = {kinds for _, kinds in row}
        if len(kinds) != 1:
            raise ValueError(
                f"the list of joints '{name}' has joints of several kinds, or none.\n"
                "Fix: a name for each kind; a list is one array in q."
            )
        of_all = kinds.pop()
        for joined, kinds in row:
            child = joined.b.body
            if isinstance(child, Body) and child.motion is not None:
                raise ValueError(
                    f"body '{child.name}' moves as given, and hangs on the joint '{name}'.\n"
                    "Usual cause: the places of the joint in the wrong order, which is the parent's first.\n"
                    f"Fix: leave the joint out, or give it to tree.system(closures={{'{name}': ...}})."
                )
            if child.name in held_by:
                raise ValueError(
                    f"body '{child.name}' hangs on two joints, '{held_by[child.name][0]}' and '{name}'.\n"
                    "Usual cause: a closed loop; or the places of one of them in the wrong order, which is the "
                    "parent's first.\n"
                    f"Fix: lj.bodies.revolute(parent.at(...), child.at(...)); a joint that closes a loop goes into "
                    f"tree.system(closures={{'{name}': ...}})."
                )
            at = quaternions if kinds == ("ball",) else numbers
            held_by[child.name] = name, joined, kinds, at
            quaternions += kinds == ("ball",)
            numbers += 0 if kinds in (("ball",), ("held",)) else len(kinds)
        if of_all != ("held",):
            entries.append(Entry(name, of_all, len(row) if listed else None))
    for body in bodies:
        if body.motion is not None:
            held_by[body.name] = body.name, Joined(ground.at(), body.at(), ()), ("driven",), 0
        elif body.name not in held_by:
            held_by[body.name] = body.name, Joined(ground.at(), body.at(), ()), ("free",), quaternions
            entries.append(Entry(body.name, ("free",), None))
            quaternions += 1
    must_differ([entry.name for entry in entries], "a joint and a free body")
    return _in_order(bodies, held_by), entries


def check_armature(entries: Sequence[Entry], armature: Mapping) -> dict[str, Any]:
    """The armature by the names of joints; raises where it is of none, or no inertia."""
    shapes = {entry.name: entry.rotors for entry in entries if entry.kinds != ("free",)}
    must_name(armature, shapes, "armature names", "joint with a coordinate")
    for name, given in armature.items():
        if callable(given):
            check_takes_params("armature", f"'{name}'", given)
            continue
        numbers, shape = np.asarray(given), shapes[name]
        well, several = numbers.shape in ((), shape) and np.all(numbers >= 0), f", or {shape} of them" * bool(shape)
        must(well, f"the armature of '{name}' must be a moment of inertia that is not negative{several}", given)
    return dict(armature)


def _joint(name: str, joint: Holonomic, bodies: Set[Body]) -> tuple[Joined, tuple[str, ...]]:
    joined = joint.g if isinstance(joint, Holonomic) else None
    kinds = FREEDOMS.get(joined.rows) if isinstance(joined, Joined) else None
    if kinds is None or not isinstance(joined, Joined):
        raise TypeError(
            f"joint '{name}' is none that a tree has coordinates for: revolute, prismatic, cylindrical, spherical, "
            "universal, planar or fixed of lj.bodies, or a list of some of one kind.\n"
            "Fix: a constraint of another kind goes into tree.system(closures={...})."
        )
    for marker in (joined.a, joined.b):
        if marker.body not in bodies and not isinstance(marker.body, Ground):
            raise ValueError(
                f"joint '{name}' holds on to '{marker.body.name}', which is not among the bodies of the tree.\n"
                "Fix: lj.bodies.Tree([..., body], joints)."
            )
    if isinstance(joined.b.body, Ground):
        raise ValueError(
            f"the second place of joint '{name}' is on the ground, and must be on the body that hangs there.\n"
            "Fix: lj.bodies.revolute(lj.bodies.ground.at(...), body.at(...)), the parent's first."
        )
    return joined, kinds


def _steps(joined: Joined, kinds: tuple[str, ...]) -> list[tuple[str, Marker, Marker]]:
    """The links of a joint in order: the freedom of each, its place on the link before, and on the link itself."""
    if kinds == ("turn", "turn"):
        return [("turn", joined.a, BETWEEN), ("turn", CROSSED, joined.b)]
    if kinds == ("slide", "slide", "turn"):
        first, second = (_along(BETWEEN, i) for i in (0, 1))
        return [("slide", _along(joined.a, 0), first), ("slide", second, second), ("turn", BETWEEN, joined.b)]
    between = [BETWEEN] * (len(kinds) - 1)
    return list(zip(kinds, [joined.a, *between], [*between, joined.b]))


def _along(marker: Marker, i: int) -> Marker:
    """The same place with vector i of its frame as the axis."""
    return replace(marker, frame=tuple(marker.frame[(i + j) % 3] for j in (1, 2, 3)))


def _check_masses(body: Body, kinds: tuple[str, ...], mass: bool):
    """`mass`: whether the body, or one that hangs on it, has any."""
    if kinds not in (("held",), ("driven",)) and not mass:
        raise ValueError(
            f"the body '{body.name}' moves and has no mass, and nothing that has some hangs on it.\n"
            "Usual cause: a frame that should be fixed.\nFix: its mass and inertia, or lj.bodies.fixed(parent, child)."
        )


def _in_order(bodies: Sequence[Body], held_by: Mapping) -> list[Link]:
    """The links, each branch in one piece after its parent, the largest last."""
    children: dict[Body | Ground, list[Body]] = {}
    for body in bodies:
        children.setdefault(held_by[body.name][1].a.body, []).append(body)
    # Outward from the ground; what is not met hangs on itself.
    met, ahead = [], list(children.get(ground, ()))
    while ahead:
        met.append(ahead.pop())
        ahead += children.get(met[-1], ())
    reached = set(met)
    if lost := [body.name for body in bodies if body not in reached]:
        raise ValueError(
            f"bodies {', '.join(map(repr, lost[:4]))} hang on each other in a ring, and on nothing else.\n"
            "Usual cause: a closed loop, or the places of a joint in the wrong order, which is the parent's first.\n"
            "Fix: leave a joint out and give it to tree.system(closures={...})."
        )
    size: dict[Body | Ground, int] = {}
    for body in reversed(met):
        size[body] = 1 + sum(size[child] for child in children.get(body, ()))
    has_mass: dict[Body, bool] = {}
    for body in reversed(met):
        own = callable(body.mass) or body.mass > 0
        has_mass[body] = own or any(has_mass[child] for child in children.get(body, ()))
        _check_masses(body, held_by[body.name][2], has_mass[body])
    links, last, ahead = [], {ground: -1}, _smallest_first(children.get(ground, ()), size)
    while ahead:
        body = ahead.pop()
        _, joined, kinds, at = held_by[body.name]
        parent = last[joined.a.body]
        for i, (kind, a, b) in enumerate(_steps(joined, kinds)):
            links.append(Link(body if b is joined.b else None, parent, kind, a, b, at + i))
            parent = len(links) - 1
        last[body] = parent
        ahead += _smallest_first(children.get(body, ()), size)
    return links


def _smallest_first(children: Iterable[Body], size: Mapping) -> list[Body]:
    """Such that the smallest branch is the first to be taken from the end."""
    return sorted(children, key=lambda body: -size[body])


class Slots(NamedTuple):
    """Where each link finds its parent's numbers, and where it leaves its own for its children, (n, slots)."""

    read: np.ndarray
    write: np.ndarray


def slots_of(parents: Sequence[int]) -> Slots:
    """Slots for links whose parents come before them, each branch in one piece."""
    last_child = {parent: i for i, parent in enumerate(parents)}
    slot_of, free, used = {}, [], 0
    pairs = []
    for i, parent in enumerate(parents):
        read = slot_of.get(parent)
        if read is not None and last_child[parent] == i:
            free.append(read)
        write = None
        if i in last_child:
            if not free:
                free.append(used)
                used += 1
            write = slot_of[i] = free.pop()
        pairs.append((read, write))
    numbers = np.arange(max(used, 1))
    return Slots(*(np.array([numbers == (-1 if x is None else x) for x in row], float) for row in zip(*pairs)))


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
