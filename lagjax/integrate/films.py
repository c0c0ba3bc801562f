"""Films and figures of a motion: frames between its outputs.

Between outputs a film interpolates q by a cubic (Hermite's), with v as its slope:

    q(t_i + s h) = (1 + 2 s)(1 - s)² q_i + s² (3 - 2 s) q_{i+1} + h s (1 - s)² v_i - h s² (1 - s) v_{i+1}

The values at outputs are exact; between them the error falls with the fourth power of their distance, which is enough
for pictures if outputs are dense. To check this, every other output is left out and interpolated from the rest: it is
then wrong by about sixteen times the error.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import Animation, InSpace, plots, poses_in_q, stills_in_space
from lagjax.integrate.subject import Subject, check_positions, subject_of

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
