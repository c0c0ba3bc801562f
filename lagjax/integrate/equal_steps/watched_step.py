"""Steps of equal length, or at a pace, during which guards are watched.

A crossing does not end a step: the steps are those of the motion without guards, so that what they keep they still keep
(in numbers too, but for the round-off with which XLA compiles one step in two programs). The guards are followed from
node to node as in `events/detect.py`; a node inside a step is the end of one step of the method aside, from the start
of the step, with a shorter length. A crossing has so the order of the method, and is on the guard to round-off. The
derivative of its time is that along the motion (`event_times.py`), and so that of the steps only up to their error.

All looks, whole steps and those aside, are passes of one loop: a program has one copy of the step, and in a batch no
lane waits for one that looks closer. Steps aside to outputs are not watched, since the step around them is; only the
one to the last output is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.events.brackets import Watched
from lagjax.integrate.events.detect import Follower
from lagjax.jaxtools import stop_gradient, where
from lagjax.mechanics import all_finite
from lagjax.system import Model


class Due(NamedTuple):
    """The next step: from t0, of the length h, to the time `until`.

    `onward`: the motion goes on from its end, and not from its start as after one aside to an output; `arrives`: it
    ends at the output; `watched`: whether guards are followed; `spent`: whether there would be too many steps.
    """

    t0: Float[Array, ""]
    h: Float[Array, ""]
    until: Float[Array, ""]
    onward: Bool[Array, ""]
    arrives: Bool[Array, ""]
    watched: Bool[Array, ""]
    spent: Bool[Array, ""]


class Between(NamedTuple):
    """What is carried from step to step: the state between two of them."""

    way: Any


class Watching(NamedTuple):
    """The last node, at t, with the state y; `at`: the next one, infinite for the end of the step; `ended`: whether a
    guard ended the motion."""

    watched: Watched
    t: Float[Array, ""]
    y: PyTree[Float[Array, "..."]]
    at: Float[Array, ""]
    ended: Bool[Array, ""]


class WatchedSteps(NamedTuple):
    """Steps as `steps` makes them (`EquallyLong`, `PacedSteps`), with a `follower` of guards."""

    steps: Any
    model: Model
    follower: Follower
    loop: Callable

    def first(self, t: Array, x: Array, u: Array) -> tuple[Any, Any, Watching]:
        """The start of the motion: the place to go on from, the state at the last output, and what is watched."""
        place, y = self.steps.place(t, x, u), (self.model.tree(x), self.model.tree(u))
        infinite = jnp.full_like(t, jnp.inf)
        watching = Watching(self.follower.first(t, y), *stop_gradient((t, y)), infinite, jnp.asarray(False))
        return place, place.way, watching

    def interval(self, carried: tuple[Any, Any, Watching], row: Any):
        """The same at the end of an interval, and the output there, as of steps that are not watched."""
        place, there, watching = carried
        begun, last = ~there.unsolved & ~watching.ended, self.follower.last

        def goes_on(state: tuple) -> Array:
            k, place, there, watching, arrived = state
            return ~(arrived | there.unsolved | watching.ended | self.steps.due(k, place, row, last).spent)

        def one(state: tuple) -> tuple:
            k, place, there, watching, arrived = state
            due = self.steps.due(k, place, row, last)
            new, done, unsolved, watching = self._look(place.way, watching, due)
            onward, goes = self.steps.onward(place, new, due), done & due.onward
            unsolved = unsolved | (goes & onward.way.unsolved)
            # A step that was not solved is where the motion ends.
            there = where(unsolved, place.way._replace(unsolved=jnp.asarray(True)), where(done, new, there))
            k = jnp.where((done | watching.ended) & ~unsolved, k + 1, k)
            return k, where(goes & ~unsolved, onward, place), there, watching, arrived | (done & due.arrives)

        start = jnp.asarray(0), place, there, watching, self.steps.is_still(row)
        k, place, there, watching, arrived = self.loop(
            goes_on, one, start, lambda state: self.steps.due(state[0], state[1], row, last).t0
        )
        used_up = begun & ~(arrived | there.unsolved | watching.ended)
        there, end = there._replace(unsolved=there.unsolved | used_up), self.steps.end(row)
        t = jnp.where(there.unsolved, jnp.minimum(self.steps.due(k, place, row, last).t0, end), end)
        return (place, there, watching), (t, there.x, self.steps.step.velocity(there, t), there.unsolved, k, used_up)

    def _look(self, way: Any, watching: Watching, due: Due) -> tuple[Any, Array, Array, Watching]:
        """The state at the next node, whether it is the end of a step that is done, whether it could not be had, and
        what is known then."""
        whole = watching.at >= due.until
        at = jnp.where(whole, due.until, watching.at)
        # A whole step has its own length, and not that of a difference of times.
        least = 0.5 * self.follower.resolution
        new = self.steps.step.advanced(way, due.t0, jnp.where(whole, due.h, jnp.maximum(at - due.t0, least)))
        y = self.model.tree(new.x), self.model.tree(self.steps.step.velocity(new, at))
        failed = new.unsolved | ~all_finite(y)
        follows, since = due.watched & ~failed, watching.t
        takes, onward, ended, watched = self.follower.follow(
            follows, since, at, watching.y, y, self.model.params, watching.watched, due.until
        )
        done = ~failed & whole & (takes | ~due.watched)
        # A node inside a step that fails, though the whole step did not, is tried nearer to the one before.
        # `at` is NaN where a guard misleads.
        unsolved = failed & (whole | ~(at - since > self.follower.resolution))
        nodes = jnp.where(failed, since + 0.5 * (at - since), onward)
        watching = Watching(
            watched,
            *where(follows & takes, stop_gradient((at, y)), (since, watching.y)),
            jnp.where(done, jnp.inf, stop_gradient(nodes)),
            watching.ended | (follows & ended),
        )
        return new, done, unsolved, watching
